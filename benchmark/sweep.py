"""Runs algorithms x tasks x seeds, each in a process of its own.

    python benchmark/sweep.py --algos avf_vdn avf_qmix --envs wtd-s bp-10 --seeds 1-5 --workers 2
    python benchmark/sweep.py --algos avf_qmix --envs wtd-s --seeds 1-3 --record -- --mixer-state single

What follows -- goes to every script. Finished runs are skipped, others go on from their checkpoint, a crashed one is
tried once more. Ctrl-C, SIGTERM, a closed terminal and, on Linux, even the death of this program end the scripts, too.
The same command then goes on from their checkpoints, so each run loses a minute at most. A run is the same if
algorithm, task, flags, seed and code are. With --record finished runs are added to runs.csv and evaluations.csv, and
what is in there is skipped. With --engine ray each run is a Ray task of one CPU, whose nodes must have this repository
and the runs folder under the same paths.
"""

import argparse
import contextlib
import fcntl
import itertools
import json
import os
import shlex
import signal
import subprocess
import sys
import time
import zlib
from concurrent.futures import ThreadPoolExecutor, as_completed
from dataclasses import asdict
from datetime import timedelta
from pathlib import Path

import pandas as pd
from tqdm import tqdm

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))  # run as a script, Python looks in this folder only

import envs
from benchmark import record

ATTEMPTS = 2  # of a run that crashes
LOST_WORKERS = 10  # times that a run is moved to another Ray worker
LOG = "log.txt"
LOCK_SECONDS = 120  # to wait for another process to leave a run; NFS needs 90 to give up the locks of a lost machine

SIGNALS = signal.SIGINT, signal.SIGTERM, signal.SIGHUP  # the last one is of a terminal that is closed

# The signals that this program received, or in a Ray worker the cancellations of its task: the first one ends scripts.
stop = []

# What runs a script: on Linux it is killed when the process that started it dies (PR_SET_PDEATHSIG), even by SIGKILL
LAUNCHER = """import ctypes, os, signal, sys
if sys.platform == "linux":
    ctypes.CDLL(None).prctl(1, signal.SIGKILL)
if os.getppid() == int(sys.argv[1]):
    os.execv(sys.executable, [sys.executable, *sys.argv[2:]])"""


# A job is a dict: the KEY of a run (see record.py), also as a tuple, key, and in words, name; variant; options, the
# words behind --; place, the folder of its log and runs; and how it ended: result, such as skipped or busy (elsewhere)
NOT_RUN = {"result": "recorded", "return": "-", "time": "-", "attempts": 0, "folder": "-", "error": ""}


def find_run(job):
    """The folder of a job's run and whether the run is finished; (None, False) if there is nothing to go on with."""
    found = None, False
    for folder in sorted(path.parent for path in Path(job["place"]).glob("*/args.json")):
        with contextlib.suppress(ValueError, KeyError, TypeError):  # of an args.json that a kill has cut short
            if record.is_finished(folder):
                return folder, True
        if (folder / "checkpoint.pt").exists():
            found = folder, False
    return found


def lock(log):
    """Whether no other process works on a log's run. Scripts inherit the lock, so it is free when they have ended."""
    end = time.time() + LOCK_SECONDS
    while not stop:
        try:
            fcntl.flock(log, fcntl.LOCK_EX | fcntl.LOCK_NB)
            return True
        except BlockingIOError:
            if time.time() > end:
                return False
            time.sleep(0.2)
    return True


def was_stopped(code):
    """Whether a script's exit code, as of subprocess, None before the first one, is that of Ctrl-C or of a signal."""
    return code is not None and (code < 0 or code == 128 + signal.SIGINT)


def run_job(job):
    """Runs a job to its end, from its checkpoint if there is one, and returns it as it ended; also in a Ray task."""
    started = time.time()
    attempts = 0
    code = None
    error = ""
    folder = None
    result = None
    path = Path(job["place"]) / LOG
    path.parent.mkdir(exist_ok=True)
    with open(path, "a") as log:
        if not lock(log):
            result = "busy"
        while not result:
            folder, finished = find_run(job)
            if finished:
                result = "finished" if attempts else "skipped"
            elif stop or was_stopped(code):
                result = "stopped"
            elif record.checksum(job["algorithm"], job["env"]) != job["checksum"]:
                result, error = "failed", "the code was changed since the sweep began"
            elif attempts == ATTEMPTS:
                result = "failed"
            else:
                if attempts:
                    record.tell(f"{job['name']}: {error}; tried once more")
                attempts += 1
                code = run_script(job, folder, log)
                error = f"exit code {code}: {path.read_text(errors='replace').splitlines()[-1]}"
    spent = str(timedelta(seconds=round(time.time() - started)))
    return job | dict(result=result, folder=folder or "-", attempts=attempts, time=spent, error=error)


def run_script(job, folder, log):
    """Runs a job's script, or goes on with a folder, until it ends or `stop` has a signal; returns its exit code."""
    new = [f"--env={job['env']}", f"--seed={job['seed']}", f"--runs-dir={job['place']}", *job["options"]]
    again = [f"--resume={folder}"]
    if ":" in job["env"]:  # a script imports no module that only its checkpoint names
        again.append(f"--env={job['env']}")
    command = [str(record.ROOT / f"{job['algorithm']}.py"), *(again if folder else new)]
    print(time.strftime("=== %F %T"), os.uname().nodename, shlex.join(command), file=log, flush=True)
    origin = {name: job[name] for name in ("flags", "variant", "checksum")}
    origin |= {"commit": record.commit(), "processor": record.processor()}
    record.replace_text(Path(job["place"]) / record.ORIGIN, json.dumps(origin, indent=2) + "\n")
    # In a process group of its own, which Ctrl-C in a terminal does not reach: the sweep decides how a script ends
    options = dict(stdin=subprocess.DEVNULL, stdout=log, stderr=log, env=os.environ | {"OMP_NUM_THREADS": "1"})
    launched = [sys.executable, "-c", LAUNCHER, str(os.getpid()), *command]
    process = subprocess.Popen(launched, process_group=0, **options)
    code = None
    while code is None:
        try:
            if stop:
                process.terminate()
            time.sleep(0.1)
            code = process.poll()
        except KeyboardInterrupt:  # how Ray cancels a task
            stop.append(signal.SIGTERM)
    return code


def start_ray(args):
    """Starts Ray; returns a function that runs a job there."""

    def run(job):  # workers of a cluster that was started in the background ignore SIGINT, with which Ray cancels tasks
        signal.signal(signal.SIGINT, signal.default_int_handler)
        return run_job(job)

    def run_there(job):
        task = ray.remote(num_cpus=1, max_retries=LOST_WORKERS)(run).remote(job)
        cancelled = 0
        while not ray.wait([task], timeout=0.2)[0]:
            if len(stop) > cancelled:
                cancelled = len(stop)
                ray.cancel(task)
        return ray.get(task)

    try:
        import ray

        ray.cloudpickle.register_pickle_by_value(record)  # workers do not find this repository's modules
        ray.init(args.address, num_cpus=args.workers)
    except ImportError:
        sys.exit("sweep: --engine ray needs Ray: pip install -e '.[cluster]'")
    except (ConnectionError, ValueError, RuntimeError) as error:
        sys.exit(f"sweep: cannot reach Ray: {str(error).splitlines()[0]}")
    return run_there


def run_jobs(jobs, args):
    """Runs jobs side by side, shows how far they are, records finished runs; puts into the jobs how they ended."""
    run = start_ray(args) if args.engine == "ray" else run_job
    for number in SIGNALS:
        if number != signal.SIGHUP or signal.getsignal(number) != signal.SIG_IGN:  # under nohup it is ignored
            signal.signal(number, lambda number, frame: stop.append(number))
    with (
        ThreadPoolExecutor(args.workers or len(jobs) + 1) as pool,
        tqdm(total=len(jobs), unit="run", smoothing=0, disable=not (sys.stderr and sys.stderr.isatty())) as bar,
    ):
        pending = {pool.submit(run, job): job for job in jobs}
        for done, future in enumerate(as_completed(pending), 1):
            job = pending[future]
            try:
                job |= future.result()
                if job["result"] in ("finished", "skipped"):
                    found, evaluations = record.read_folder(job["folder"])
                    job["return"] = evaluations["return"].iloc[-1]
                    if args.record:
                        record.add(args.record, found | {"variant": job["variant"]}, evaluations)
            except Exception as error:  # the engine's own: an unwritable log, or workers lost once too often
                job |= {"result": "stopped" if stop else "failed", "error": repr(error).strip().splitlines()[-1]}
            bar.update()
            ended = f"{job['name']}: {job['result']}, {job['time']}, return {job['return']}"
            record.tell(f"[{done}/{len(jobs)}] {ended}")


def task(text):
    """The id of a task, or "module:id", whose module is imported."""
    problem = envs.problem(text)
    if problem:
        raise argparse.ArgumentTypeError(problem)
    return text


def seeds(text):
    """Those of a word such as 3 or 1-5."""
    first, _, last = text.partition("-")
    first, last = int(first), int(last or first)
    if not first <= last < first + 10_000 or last > 10**15:
        raise ValueError
    return range(first, last + 1)


def make_jobs(args, options):
    """The jobs of a sweep. Bad flags behind -- end the program, bad values of them in the words of the script."""
    cells = []
    jobs = []
    for algorithm, env in dict.fromkeys(itertools.product(args.algos, args.envs)):
        usual = {"env": env, "seed": 2**31 - 1, "runs_dir": "runs of a sweep"}  # that differ from any behind --
        own = [f"--{name.replace('_', '-')}={value}" for name, value in usual.items()]
        try:
            arguments = asdict(record.load_script(algorithm).parse_args([*own, *options]))
        except SystemExit as stopped:
            if stopped.code == 2:  # the parser has told what it does not know, but not whose it is
                sys.exit(f"sweep: {algorithm} does not take {shlex.join(options)}")
            raise
        if not usual.items() <= arguments.items():
            sys.exit("sweep: --env, --seed and --runs-dir cannot stand behind --, the sweep sets them")
        flags = record.flags_of(record.values_of(algorithm, env), arguments)
        cells.append((algorithm, env, flags, record.checksum(algorithm, env)))
    # All of the first seed before the second, so that a sweep of days soon shows something of everything
    for seed, cell in itertools.product(dict.fromkeys(itertools.chain.from_iterable(args.seeds)), cells):
        algorithm, env, flags, code = cell
        key = algorithm, env, flags, str(seed), code
        name = f"{env}__{algorithm}__{seed}__{zlib.crc32(repr(key).encode()):08x}".replace(":", "-")
        place = args.runs_dir.resolve() / name
        job = dict(zip(record.KEY, key, strict=True)) | dict(key=key, name=f"{algorithm} {env} seed {seed}")
        job |= dict(variant=flags if args.variant is None else args.variant, options=options, place=str(place))
        jobs.append(job | NOT_RUN)
    return jobs


def main(argv=None):
    """Runs a sweep; returns 0 if every run is finished, 128 + the signal if it was stopped, 1 otherwise."""
    argv = sys.argv[1:] if argv is None else argv
    cut = argv.index("--") if "--" in argv else len(argv)
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.error = lambda message: sys.exit(f"sweep: {message}")
    add = parser.add_argument
    names = dict(nargs="+", required=True, metavar="NAME")
    add("--algos", choices=record.scripts(), help="names of scripts, without .py", **names)
    add("--envs", type=task, help="ids of tasks, or module:id", **names)
    add("--seeds", type=seeds, nargs="+", required=True, help="such as 1-5 or 1 3 7-9")
    add("--workers", type=int, help="runs side by side (default: CPU cores of this machine)")
    add("--runs-dir", type=record.folder, default=Path("runs"), help="folder of the run folders (default: runs)")
    add("--record", type=record.folder, nargs="?", const=record.RESULTS, metavar="FOLDER", help="keep results there")
    add("--variant", help="what reports call runs with these flags (default: the flags)")
    add("--engine", choices=("local", "ray"), default="local", help="default: local")
    add("--address", help="with --engine ray: of a cluster, or auto (default: starts one here)")
    add("--dry-run", action="store_true", help="only list what would be run, resumed and skipped")
    args = parser.parse_args(argv[:cut])
    if args.workers is not None and args.workers < 1:
        sys.exit(f"sweep: --workers must be at least 1, got {args.workers}")
    if args.address and (args.engine != "ray" or args.workers):
        sys.exit("sweep: --address needs --engine ray, and no --workers: the cluster has the CPUs it has")
    args.workers = args.workers or (None if args.address else os.cpu_count())
    jobs = make_jobs(args, argv[cut + 1 :])
    recorded = set()
    try:
        for folder in [] if args.dry_run else filter(None, (args.runs_dir, args.record)):
            record.make_folder(folder)
        if args.record:
            recorded = set(record.load(args.record)[0][record.KEY].itertuples(index=False, name=None))
    except (OSError, ValueError) as error:
        sys.exit(f"sweep: cannot use --record or --runs-dir: {error}")
    todo = [job for job in jobs if job["key"] not in recorded]
    for job in jobs if args.dry_run else ():
        folder, finished = find_run(job)
        how = "recorded" if job not in todo else "skip" if finished else "resume" if folder else "run"
        print(f"{job['name']}: {how} {folder or ''}".rstrip())
    if args.dry_run:
        return 0
    run_jobs(todo, args)
    columns = ["algorithm", "env", "seed", "result", "return", "time", "attempts", "folder"]
    print(pd.DataFrame(jobs)[columns].to_string(index=False))
    for job in jobs:
        if job["result"] == "failed" or (job["result"] == "stopped" and not stop):  # by whom, if not by the sweep?
            print(f"{job['name']} {job['result']}: {job['error']} (log: {Path(job['place']) / LOG})")
    if stop:
        command = shlex.join([sys.argv[0], *argv])
        record.tell(f"sweep: stopped; go on from the last checkpoints with: python {command}")
        return 128 + stop[0]
    return 0 if all(job["result"] in ("recorded", "skipped", "finished") for job in jobs) else 1


if __name__ == "__main__":
    sys.exit(main())
