"""Runs algorithms x tasks x seeds: each run is one of the scripts in a process of its own.

    python benchmark/sweep.py --algos avf_vdn avf_qmix --envs wtd-s bp-10 --seeds 1-5 --workers 2
    python benchmark/sweep.py --algos avf_qmix --envs wtd-s --seeds 1-3 --record -- --mixer-state single

What follows -- goes to every script. Finished runs are skipped, others go on from their checkpoint, a crashed one is
tried once more. Ctrl-C, SIGTERM and, on Linux, even the death of this program make the scripts write a checkpoint and
end; the same command goes on where it stopped. A run is the same if algorithm, task, flags, seed and code are the same
(record.py); runs that were started by hand are left alone. Needs the extra `report`.

With --record finished runs are added to runs.csv and evaluations.csv, in benchmark/results or a folder of your own, and
what is in there is skipped, even where its run folder is gone: so a large grid is made in several sittings.

With --engine ray each run is a Ray task of one CPU, on this machine or on the cluster at --address, whose nodes must
have this repository and the runs folder under the same paths. A run whose worker is lost goes on elsewhere.

While a process works on a run, its log in <runs-dir>/logs is locked (flock), so several sweeps may share a runs folder.
"""

import argparse
import fcntl
import itertools
import json
import os
import re
import shlex
import signal
import socket
import subprocess
import sys
import time
import zlib
from concurrent.futures import FIRST_COMPLETED, ThreadPoolExecutor, wait
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
LOCK_SECONDS = 120  # to wait for another process to leave a run; NFS needs 90 to give up the locks of a lost machine

# The signals to pass on to the scripts: those this program received, or in a Ray worker the cancellations of its task.
stop = []

# A script is started by this program, which passes signals on. On Linux it dies with the process that started it, and
# the script gets SIGTERM when it dies. Not directly: a dying process sends one for each of its threads, and to a script
# the second one may mean to end at once.
GUARD = """import ctypes, os, signal, subprocess, sys
prctl = ctypes.CDLL(None).prctl if sys.platform == "linux" else lambda option, number: None
prctl(1, signal.SIGKILL)
if os.getppid() == int(sys.argv[1]):
    script = subprocess.Popen([sys.executable, *sys.argv[2:]], preexec_fn=lambda: prctl(1, signal.SIGTERM))
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda number, frame: script.send_signal(number))
    code = script.wait()
    sys.exit(code if code >= 0 else 128 - code)"""


# A job is a dict: the KEY of a run (see record.py), as text, with variant, options (the words behind --), runs_dir and
# arguments (the content of args.json), and how it ended: recorded, skipped, finished, failed, stopped, or busy where
# another process works on it.
NOT_RUN = {"result": "recorded", "return": "-", "time": "-", "attempts": 0, "folder": "-", "error": ""}


def fail(message):
    """Ends the program with one line."""
    raise SystemExit(f"sweep: {message}")


def key(run):
    """Which run a job or a row of runs.csv is of."""
    return tuple(run[name] for name in record.KEY)


def name(job):
    return f"{job['algorithm']} {job['env']} seed {job['seed']}"


def log_path(job):
    checksum = zlib.crc32(repr(key(job)).encode())
    return Path(job["runs_dir"]) / "logs" / "{env}__{algorithm}__{seed}__{:08x}.log".format(checksum, **job)


def run_folders(job):
    """Run folders of a job's algorithm, task and seed, the newest last."""
    found = Path(job["runs_dir"]).glob("{env}__{algorithm}__{seed}__*/args.json".format(**job))
    return sorted(path.parent for path in found)


def find_run(job):
    """The folder of a job's run and whether the run is finished; (None, False) if there is nothing to go on with."""
    unfinished = None
    for folder in run_folders(job):
        if (folder / record.ORIGIN).exists() and key(record.describe(folder)) == key(job):
            if record.is_finished(folder):
                return folder, True
            unfinished = folder if (folder / "checkpoint.pt").exists() else unfinished
    return unfinished, False


def run_job(job):
    """Runs a job to its end, from its checkpoint if there is one, and returns it as it ended; also in a Ray task."""
    started, attempts, code, error, folder = time.time(), 0, None, "", None

    def ended(result):
        spent = str(timedelta(seconds=round(time.time() - started)))
        return job | dict(result=result, folder=folder or "-", attempts=attempts, time=spent, error=error)

    with open(log_path(job), "a") as log:
        # The script inherits the lock with its output: the run is free when the script has ended, too.
        while not stop:
            try:
                fcntl.flock(log, fcntl.LOCK_EX | fcntl.LOCK_NB)
                break
            except BlockingIOError:
                if time.time() - started > LOCK_SECONDS:
                    return ended("busy")
                time.sleep(0.2)
        while True:
            folder, finished = find_run(job)
            if finished:
                return ended("finished" if attempts else "skipped")
            if stop or code in (128 + signal.SIGINT, 128 + signal.SIGTERM):
                return ended("stopped")
            if attempts:
                output = log_path(job).read_text(errors="replace").rpartition("\n=== ")[2].strip().splitlines()[1:]
                how = f"killed by {signal.Signals(code - 128).name}" if code > 128 else f"exit code {code}"
                error = f"{how}: {output[-1] if output else 'no output'}"
                print(f"{name(job)}: crash {attempts} of at most {ATTEMPTS}, {error}", file=sys.stderr)
            if record.checksum(job["algorithm"]) != job["checksum"]:
                error = "the code was changed since the sweep began"
                return ended("failed")
            if attempts == ATTEMPTS:
                return ended("failed")
            attempts += 1
            code = run_script(job, folder, log)


def run_ray_job(job):
    """`run_job` in a Ray task, which is cancelled by a KeyboardInterrupt."""
    # Workers of a cluster that was started in the background ignore SIGINT, and Python then raises nothing.
    signal.signal(signal.SIGINT, signal.default_int_handler)
    return run_job(job)


def run_script(job, folder, log):
    """Runs a job's script, or goes on with a run folder, passes the signals in `stop` on, returns its exit code."""
    flags = ["--env={env}", "--seed={seed}", "--runs-dir={runs_dir}"]
    new = [flag.format(**job) for flag in flags] + job["options"]
    command = [str(record.ROOT / f"{job['algorithm']}.py"), *([f"--resume={folder}"] if folder else new)]
    print(time.strftime("=== %F %T"), socket.gethostname(), shlex.join(command), file=log, flush=True)
    origin = {name: job[name] for name in ("flags", "variant", "checksum")}
    origin |= {"commit": record.commit(), "processor": record.processor()}
    before, passed, ended = set(run_folders(job)), 0, False
    # In a process group of its own: Ctrl-C would reach it from the terminal, too, and the scripts want it once.
    streams = dict(stdin=subprocess.DEVNULL, stdout=log, stderr=log)
    guarded = [sys.executable, "-c", GUARD, str(os.getpid()), *command]
    process = subprocess.Popen(guarded, env={**os.environ, "OMP_NUM_THREADS": "1"}, process_group=0, **streams)
    while not ended:
        try:
            ended = process.poll() is not None
            for number in stop[passed:]:
                process.send_signal(number)
                passed += 1
            for made in set(run_folders(job)) - before:  # by this script, or by one with other flags beside it
                if job["arguments"].items() <= json.loads((made / "args.json").read_text()).items():
                    record.replace_text(made / record.ORIGIN, json.dumps(origin, indent=2) + "\n")
                before.add(made)
            time.sleep(0.1)
        except KeyboardInterrupt:  # how Ray cancels a task, in processes that block SIGINT
            stop.append(signal.SIGTERM)
    return process.returncode


def start_engine(args):
    """Two functions: one starts a job and returns its concurrent.futures.Future, one interrupts all of them."""
    if args.engine == "local":
        pool = ThreadPoolExecutor(args.workers)
        return lambda job: pool.submit(run_job, job), lambda: None  # the threads look at `stop`
    try:
        import ray

        ray.cloudpickle.register_pickle_by_value(record)  # workers do not find this repository's modules
        ray.init(args.address, num_cpus=args.workers)
    except ImportError:
        fail("--engine ray needs Ray: pip install -e '.[cluster]'")
    except (ConnectionError, ValueError, RuntimeError) as error:
        fail(f"cannot reach Ray: {str(error).splitlines()[0]}")
    task, references = ray.remote(num_cpus=1, max_retries=LOST_WORKERS)(run_ray_job), []

    def start(job):
        references.append(task.remote(job))
        return references[-1].future()

    return start, lambda: [ray.cancel(reference) for reference in references]


def run_jobs(jobs, args):
    """Runs jobs side by side, shows how far they are and records finished runs; returns what `run_job` returns."""
    start, interrupt = start_engine(args)
    handlers = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    for number in handlers:
        signal.signal(number, lambda number, frame: stop.append(number))
    results, pending, interrupted = [], {start(job): job for job in jobs}, 0
    with tqdm(total=len(jobs), unit="run", smoothing=0, disable=not sys.stderr.isatty()) as bar:
        while pending:
            for future in wait(pending, timeout=1, return_when=FIRST_COMPLETED).done:
                job = pending.pop(future)
                try:
                    job = future.result()
                    if job["result"] in ("finished", "skipped"):
                        run, evaluations = record.read_folder(job["folder"])
                        job["return"] = evaluations["return"].iloc[-1]
                        if args.record:
                            record.add(args.record, run | {"variant": job["variant"]}, evaluations)
                except Exception as error:  # the engine's own: an unwritable log, or workers lost once too often
                    job |= {"result": "stopped" if stop else "failed", "error": repr(error).strip().splitlines()[-1]}
                results.append(job)
                place = f"[{len(results)}/{len(jobs)}] {name(job)}"
                tqdm.write(f"{place}: {job['result']}, {job['time']}, greedy return {job['return']}", sys.stderr)
                bar.update()
            if len(stop) > interrupted:
                interrupted = len(stop)
                interrupt()
                tqdm.write("sweep: stopping, the scripts write their checkpoints", sys.stderr)
            bar.refresh()
    for number, handler in handlers.items():
        signal.signal(number, handler)
    return results


def table(results):
    """Results as a table, and below it a line for each failure."""
    columns = ["algorithm", "env", "seed", "result", "return", "time", "attempts", "folder"]
    failed = [job for job in results if job["result"] == "failed"]
    lines = [f"{name(job)} failed: {job['error']} (log: {log_path(job)})" for job in failed]
    return "\n".join([pd.DataFrame(results)[columns].to_string(index=False), *lines])


def parse_seeds(text):
    """The seeds in a word such as 1-5 or 0,2,7 or 3."""
    seeds = []
    for part in text.split(","):
        first, _, last = part.partition("-")
        if not re.fullmatch(r"\d+(-\d+)?", part) or int(first) > int(last or first):
            raise argparse.ArgumentTypeError(f"takes 1-5 or 0,2,7 or 1 2 3, not {text!r}")
        seeds += range(int(first), int(last or first) + 1)
    return seeds


def make_jobs(args, options):
    """The jobs of a sweep. Bad flags behind -- end the program, bad values of them in the words of the script."""
    cells = []
    for algorithm, env in dict.fromkeys((algorithm, env) for algorithm in args.algos for env in args.envs):
        usual = {"env": env, "seed": 2**31 - 1, "runs_dir": args.runs_dir}  # a seed that differs from any behind --
        own = [f"--{name.replace('_', '-')}={value}" for name, value in usual.items()]
        try:
            arguments = asdict(record.load_script(algorithm).parse_args([*own, *options]))
        except SystemExit as stopped:
            if stopped.code == 2:  # the parser has told what it does not know, but not whose it is
                fail(f"{algorithm} does not take {shlex.join(options)}")
            raise
        if not usual.items() <= arguments.items():
            fail("--env, --seed and --runs-dir cannot stand behind --, the sweep sets them")
        cells.append((algorithm, env, record.flags_of(algorithm, arguments), record.checksum(algorithm), arguments))
    jobs = []  # all of the first seed before the second, so that a sweep of days soon shows something of everything
    for seed in dict.fromkeys(itertools.chain.from_iterable(args.seeds)):
        for algorithm, env, flags, checksum, arguments in cells:
            jobs.append({"algorithm": algorithm, "env": env, "flags": flags, "seed": str(seed), "checksum": checksum,
                         "variant": flags if args.variant is None else args.variant, "options": options,
                         "runs_dir": args.runs_dir, "arguments": {"algorithm": algorithm, **arguments, "seed": seed},
                         **NOT_RUN})  # fmt: skip
    return jobs


def parse_args(argv):
    """The sweep's own arguments, and the list of the scripts' flags behind --."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.error = fail
    add, names = parser.add_argument, dict(nargs="+", required=True, metavar="NAME")
    add("--algos", choices=record.scripts(), help="names of scripts, without .py", **names)
    add("--envs", choices=envs.IDS, help="ids of tasks", **names)
    add("--seeds", type=parse_seeds, nargs="+", required=True, help="1-5 or 0,2,7 or 1 2 3")
    add("--workers", type=int, help="runs side by side (default: CPU cores of this machine)")
    add("--runs-dir", default="runs", help="folder of the run folders (default: runs)")
    add("--record", type=Path, nargs="?", const=record.RESULTS, metavar="FOLDER", help="keep results in a folder")
    add("--variant", help="what reports call runs with these flags (default: the flags)")
    add("--engine", choices=("local", "ray"), default="local", help="default: local")
    add("--address", help="with --engine ray: of a cluster, or auto (default: starts one here)")
    add("--dry-run", action="store_true", help="only list what would be run, resumed and skipped")
    cut = argv.index("--") if "--" in argv else len(argv)
    args = parser.parse_args(argv[:cut])
    if args.workers is not None and args.workers < 1:
        fail(f"--workers must be at least 1, got {args.workers}")
    if args.address and (args.engine != "ray" or args.workers):
        fail("--address needs --engine ray, and no --workers: the cluster has the CPUs it has")
    args.workers = args.workers or (None if args.address else os.cpu_count())
    args.runs_dir = str(Path(args.runs_dir).resolve())
    return args, argv[cut + 1 :]


def main(argv=None):
    """Runs a sweep; returns 0 if every run is finished, 128 + the signal if it was stopped, 1 otherwise."""
    argv = sys.argv[1:] if argv is None else argv
    args, options = parse_args(argv)
    jobs, recorded = make_jobs(args, options), set()
    try:
        if not args.dry_run:
            for folder in filter(None, (args.record, Path(args.runs_dir) / "logs")):
                folder.mkdir(parents=True, exist_ok=True)
        if args.record:
            recorded = {key(run) for run in record.load(args.record)[0].to_dict("records")}
    except (OSError, ValueError) as error:
        fail(f"cannot use --record or --runs-dir: {error}")
    todo = [job for job in jobs if key(job) not in recorded]
    if args.dry_run:
        for job in jobs:
            folder, finished = find_run(job)
            how = "recorded" if job not in todo else "skip" if finished else "resume" if folder else "run"
            print(f"{name(job)}: {how} {folder or ''}".rstrip())
        return 0
    stop.clear()
    ended = {key(job): job for job in jobs + run_jobs(todo, args)}  # those that were not run, too
    print(table([ended[key(job)] for job in jobs]))
    if stop:
        command = shlex.join([sys.argv[0], *argv])
        print(f"sweep: stopped, nothing is lost; go on with: python {command}", file=sys.stderr)
        return 128 + stop[0]
    return 0 if all(job["result"] in ("recorded", "skipped", "finished") for job in ended.values()) else 1


if __name__ == "__main__":
    sys.exit(main())
