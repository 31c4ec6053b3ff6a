"""Runs algorithms x tasks x seeds: each run is one of the scripts in a process of its own.

    python benchmark/sweep.py --algos avf_vdn avf_qmix --envs wtd-s bp-10 --seeds 1-5 --workers 2
    python benchmark/sweep.py --algos avf_qmix --envs wtd-s --seeds 1-3 -- --mixer-state single

What follows -- goes to every script. Runs with a checkpoint of their last step are skipped, others go on from their
checkpoint, a crashed one is tried once more. Ctrl-C, SIGTERM and, on Linux, even the death of this program make the
scripts write a checkpoint and end; the same command goes on where it stopped.

With --engine ray each run is a Ray task of one CPU, on this machine or on the cluster at --address, whose nodes must
have this repository and the runs folder under the same paths. A run whose worker is lost goes on elsewhere.

A run is known by the args.json in its folder: the same algorithm and arguments, but for those that do not change the
result. While a process works on it, its log is locked (flock), so several sweeps may share a runs folder. The log is
<runs-dir>/logs/<env>__<script>__<seed>__<checksum of the arguments>.log.
"""

import argparse
import fcntl
import importlib
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
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import torch
from tqdm import tqdm

ROOT = Path(__file__).resolve().parents[1]
ATTEMPTS = 2  # of a run that crashes
LOST_WORKERS = 10  # times that a run is moved to another Ray worker
LOCK_SECONDS = 120  # to wait for another process to leave a run; NFS needs 90 to give up the locks of a lost machine
FREE = {"runs_dir", "device", "torch_threads", "resume", "checkpoint_frequency"}  # these do not tell runs apart
FREE |= {"track", "wandb_project_name", "wandb_entity"}
OWN = {"--env", "--seed", "--runs-dir", "--resume", "--evaluate"}  # flags that the sweep sets

# The signals to pass on to the scripts: those this program received, or in a Ray worker the cancellations of its task.
stop = []

# A script is started by this program, which passes signals on. On Linux it dies with the process that started it, and
# the script gets SIGTERM when it dies. Not directly: a dying process sends one for each of its threads, and to a script
# the second one means to end at once.
GUARD = """import ctypes, os, signal, subprocess, sys
prctl = ctypes.CDLL(None).prctl if sys.platform == "linux" else lambda option, number: None
prctl(1, signal.SIGKILL)
if os.getppid() == int(sys.argv[1]):
    script = subprocess.Popen([sys.executable, *sys.argv[2:]], preexec_fn=lambda: prctl(1, signal.SIGTERM))
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda number, frame: script.send_signal(number))
    code = script.wait()
    sys.exit(code if code >= 0 else 128 - code)"""


@dataclass(frozen=True)
class Job:
    """A run to be made. arguments: those that tell runs apart, see `key`. flags: those behind --. steps: of the run."""

    algorithm: str
    env: str
    seed: int
    runs_dir: str
    arguments: str
    flags: tuple
    steps: int

    def __str__(self):
        return f"{self.algorithm} {self.env} seed {self.seed}"

    @property
    def log(self):
        checksum = zlib.crc32(self.arguments.encode())
        return Path(self.runs_dir) / "logs" / f"{self.env}__{self.algorithm}__{self.seed}__{checksum:08x}.log"


@dataclass
class Result:
    """How a job ended: skipped, finished, failed, stopped, or busy where another process works on it."""

    status: str
    attempts: int = 0
    seconds: float = 0.0
    error: str = ""


def fail(message):
    """Ends the program with one line."""
    raise SystemExit(f"sweep: {message}")


def key(arguments):
    """The arguments that tell runs apart, as one string."""
    return json.dumps({name: value for name, value in arguments.items() if name not in FREE}, sort_keys=True)


def read(path):
    """What a script saved, or None if there is no whole file. The tensors stay on the disk, so any size is quick."""
    try:
        return torch.load(path, map_location="cpu", weights_only=True, mmap=True)
    except Exception:  # torch names no common class for what a damaged file raises
        return None


def read_all(job, name):
    """[(folder, what is saved in its file of that name), ...] of the run folders with a job's arguments."""
    found = []
    for path in Path(job.runs_dir).glob(f"{job.env}__{job.algorithm}__{job.seed}__*/args.json"):
        try:
            if key(json.loads(path.read_text())) == job.arguments:
                found.append((path.parent, read(path.parent / name)))
        except ValueError:  # killed while the file was written
            pass
    return [(folder, saved) for folder, saved in found if saved]


def find_run(job):
    """The folder and the step of a job's furthest checkpoint, (None, 0) if there is none."""
    saved = [(folder, saved["step"]) for folder, saved in read_all(job, "checkpoint.pt")]
    return max(saved, key=lambda run: run[1], default=(None, 0))


def evaluated(job):
    """The step and the greedy return of a job's last evaluation, (0, nan) before the first."""
    models = [(saved["last"]["step"], saved["last"]["return"]) for _, saved in read_all(job, "model.pt")]
    return max(models, default=(0, float("nan")))


def run_job(job):
    """Runs a job to its end, from its checkpoint if there is one; the same on this machine and in a Ray task.

    Args:
        job: Job.

    Returns:
        Result, of a run that failed as well.

    Raises:
        OSError: the log cannot be written or locked.
    """
    started, code, error = time.time(), None, ""
    with open(job.log, "a") as log:
        # The script inherits the lock with its output: the run is free when the script has ended, too.
        while not stop:
            try:
                fcntl.flock(log, fcntl.LOCK_EX | fcntl.LOCK_NB)
                break
            except BlockingIOError:
                if time.time() - started > LOCK_SECONDS:
                    return Result("busy")
                time.sleep(0.2)
        for attempt in range(ATTEMPTS + 1):
            folder, step = find_run(job)
            if step >= job.steps:
                return Result("finished", attempt, time.time() - started)
            if stop or code == 0:
                return Result("stopped", attempt, time.time() - started)
            if attempt:
                output = job.log.read_text(errors="replace").rpartition("\n=== ")[2].strip().splitlines()[1:]
                how = f"killed by {signal.Signals(code - 128).name}" if code > 128 else f"exit code {code}"
                error = f"{how}: {output[-1] if output else 'no output'}"
                tqdm.write(f"{job}: crash {attempt} of at most {ATTEMPTS}, {error}", sys.stderr)
            if attempt < ATTEMPTS:
                new = [f"--env={job.env}", f"--seed={job.seed}", f"--runs-dir={job.runs_dir}"]
                code = run_script(job, [f"--resume={folder}"] if folder else new, log)
    return Result("failed", ATTEMPTS, time.time() - started, error)


def run_ray_job(job):
    """`run_job` in a Ray task, which is cancelled by a KeyboardInterrupt."""
    # Workers of a cluster that was started in the background ignore SIGINT, and Python then raises nothing.
    signal.signal(signal.SIGINT, signal.default_int_handler)
    return run_job(job)


def run_script(job, flags, log):
    """Runs a job's script with its flags and these, passes the signals in `stop` on, and returns its exit code."""
    command = [str(ROOT / f"{job.algorithm}.py"), *flags, "--torch-threads=1", *job.flags]
    print(time.strftime("=== %F %T"), socket.gethostname(), shlex.join(command), file=log, flush=True)
    # In a process group of its own: Ctrl-C would reach it from the terminal, too, and a second signal ends it at once.
    streams = dict(stdin=subprocess.DEVNULL, stdout=log, stderr=log)
    threads = {**os.environ, "OMP_NUM_THREADS": "1"}
    guarded = [sys.executable, "-c", GUARD, str(os.getpid()), *command]
    process = subprocess.Popen(guarded, env=threads, process_group=0, **streams)
    passed = 0
    while process.poll() is None:
        try:
            for number in stop[passed:]:
                process.send_signal(number)
                passed += 1
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
    """Runs jobs side by side and shows how far they are; returns {job: Result}."""
    start, interrupt = start_engine(args)
    handlers = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    for number in handlers:
        signal.signal(number, lambda number, frame: stop.append(number))
    results, pending, interrupted, looked = {}, {start(job): job for job in jobs}, 0, time.time()
    quiet = not sys.stderr.isatty()
    steps = {job: 0 if quiet else evaluated(job)[0] for job in jobs}
    look = dict(disable=quiet, bar_format="{percentage:3.0f}%|{bar:20}| {desc} [{elapsed}<{remaining}]")
    with tqdm(desc="starting", total=sum(job.steps for job in jobs), initial=sum(steps.values()), **look) as bar:
        while pending:
            for future in wait(pending, timeout=1, return_when=FIRST_COMPLETED).done:
                job = pending.pop(future)
                try:
                    result = future.result()
                except Exception as error:  # the engine's own: an unwritable log, or workers lost once too often
                    reason = str(error).strip().rpartition("\n")[2]
                    result = Result("stopped" if stop else "failed", error=f"{type(error).__name__}: {reason}")
                results[job], steps[job] = result, job.steps
                line = f"[{len(results)}/{len(jobs)}] {job}: {result.status}, {clock(result.seconds)}"
                line += f", greedy return {evaluated(job)[1]:.2f}" if result.status == "finished" else ""
                tqdm.write(line, sys.stderr)
            if len(stop) > interrupted:
                interrupted = len(stop)
                interrupt()
                tqdm.write("sweep: stopping, the scripts write their checkpoints", sys.stderr)
            if not quiet and time.time() - looked > 10:
                looked, steps = time.time(), steps | {job: evaluated(job)[0] for job in pending.values()}
            bar.set_description_str(f"{len(results)} of {len(jobs)} runs", refresh=False)
            bar.update(sum(steps.values()) - bar.n)
    for number, handler in handlers.items():
        signal.signal(number, handler)
    return results


def clock(seconds):
    """Seconds as h:mm:ss."""
    return f"{seconds // 3600:.0f}:{seconds // 60 % 60:02.0f}:{seconds % 60 // 1:02.0f}"


def table(results):
    """{job: Result} as a table in aligned columns, and below it a line for each failure."""
    rows = [("algorithm", "env", "seed", "result", "return", "time", "attempts", "folder")]
    for job, result in results.items():
        value = f"{evaluated(job)[1]:.2f}" if result.status in ("finished", "skipped") else "-"
        spent = (clock(result.seconds), result.attempts) if result.attempts else ("-", "-")
        rows.append((job.algorithm, job.env, job.seed, result.status, value, *spent, find_run(job)[0] or "-"))
    widths = [max(len(str(cell)) for cell in column) for column in zip(*rows, strict=True)]
    lines = ["  ".join(f"{cell!s:{width}}" for cell, width in zip(row, widths, strict=True)).rstrip() for row in rows]
    failed = [(job, result.error) for job, result in results.items() if result.status == "failed"]
    return "\n".join(lines + [f"{job} failed: {error} (log: {job.log})" for job, error in failed])


def parse_seeds(texts):
    """Seeds from texts such as 1-5, 0,2,7 or 3, each once."""
    seeds = []
    for part in ",".join(texts).split(","):
        match = re.fullmatch(r"(\d+)(?:-(\d+))?", part)
        if not match or int(match[1]) > int(match[2] or match[1]):
            fail(f"--seeds takes 1-5 or 0,2,7 or 1 2 3, not {' '.join(texts)!r}")
        seeds += range(int(match[1]), int(match[2] or match[1]) + 1)
    return list(dict.fromkeys(seeds))


def make_jobs(args, flags):
    """The jobs of a sweep. Bad names and flags end the program, values of flags in the words of the script."""
    sys.path.insert(0, str(ROOT))
    import envs

    scripts, arguments = sorted(path.stem for path in ROOT.glob("*.py")), {}
    for what, names, valid in (("algorithm", args.algos, scripts), ("environment", args.envs, envs.IDS)):
        for name in names:
            if name not in valid:
                fail(f"unknown {what} {name!r}; valid names: {' '.join(valid)}")
    for flag in flags:
        if flag.split("=")[0].replace("_", "-") in OWN:
            fail(f"{flag} is set by the sweep and cannot stand behind --")
    for algorithm in dict.fromkeys(args.algos):
        script = importlib.import_module(algorithm)
        for env in dict.fromkeys(args.envs):
            try:
                parsed = script.parse_args([f"--env={env}", *flags])
            except SystemExit as stopped:
                if stopped.code == 2:  # the parser has told what it does not know, but not whose it is
                    fail(f"{algorithm} does not take {shlex.join(flags)}")
                raise
            # The nodes of a cluster may have devices that this machine has not.
            script.check(replace(parsed, device="cpu") if args.engine == "ray" else parsed)
            arguments[algorithm, env] = {"algorithm": algorithm, **asdict(parsed)}
    return [  # all of the first seed before the second, so that a sweep of days soon shows something of everything
        Job(algorithm, env, seed, args.runs_dir, key(a | {"seed": seed}), tuple(flags), a["total_timesteps"])
        for seed in parse_seeds(args.seeds)
        for (algorithm, env), a in arguments.items()
    ]


def parse_args(argv):
    """The sweep's own arguments, and the list of the scripts' flags behind --."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--algos", nargs="+", required=True, help="names of scripts, without .py")
    parser.add_argument("--envs", nargs="+", required=True, help="ids of tasks")
    parser.add_argument("--seeds", nargs="+", required=True, help="1-5 or 0,2,7 or 1 2 3")
    parser.add_argument("--workers", type=int, help="runs side by side (default: CPU cores of this machine)")
    parser.add_argument("--runs-dir", default="runs", help="folder of the run folders (default: runs)")
    parser.add_argument("--engine", choices=("local", "ray"), default="local", help="default: local")
    parser.add_argument("--address", help="with --engine ray: of a cluster, or auto (default: starts one here)")
    parser.add_argument("--dry-run", action="store_true", help="only list what would be run, resumed and skipped")
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
    args, flags = parse_args(argv)
    plan = {job: find_run(job) for job in make_jobs(args, flags)}
    if args.dry_run:
        for job, (folder, step) in plan.items():
            how = f"skip {folder}" if step >= job.steps else f"resume at step {step} {folder}" if folder else "run"
            print(f"{job}: {how}")
        return 0
    logs = Path(args.runs_dir) / "logs"
    try:
        logs.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        fail(f"cannot write to --runs-dir {args.runs_dir}: {error.strerror}")
    if not os.access(logs, os.W_OK):
        fail(f"cannot write to {logs}: Permission denied")
    stop.clear()
    results = {job: Result("skipped") for job, (_, step) in plan.items() if step >= job.steps}
    todo = [job for job in plan if job not in results]
    results |= run_jobs(todo, args) if todo else {}
    print(table({job: results[job] for job in plan}))
    if stop:
        command = shlex.join([sys.argv[0], *argv])
        print(f"sweep: stopped, nothing is lost; go on with: python {command}", file=sys.stderr)
        return 128 + stop[0]
    return 0 if all(result.status in ("finished", "skipped") for result in results.values()) else 1


if __name__ == "__main__":
    sys.exit(main())
