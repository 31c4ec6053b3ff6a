"""The sweep: what it skips, resumes, retries and records, and that no way of stopping it loses or doubles a run.

Most tests run a script that counts steps instead of learning, so that they take no time. It does what the sweep relies
on: parse_args, exit codes, a run folder with args.json and events, and a checkpoint from the first step on that is
there until the run is finished. Like the scripts it catches no signal, but tells of Ctrl-C by exit code 130.
"""

import fcntl
import multiprocessing
import os
import shlex
import shutil
import signal
import subprocess
import sys
import threading
import time
import types
from pathlib import Path

import pandas as pd
import pytest
import torch
from torch.utils.tensorboard import SummaryWriter

import envs
from benchmark import record, sweep

ROOT = Path(__file__).parents[1]
COUNTER = """
import argparse, json, os, shutil, sys, time
from dataclasses import asdict, dataclass
from pathlib import Path

ALGORITHM = "counter"
STEPS = Path(__file__).parent / "steps"  # events as the test wrote them: no TensorBoard, so a quick start
HOLD = Path(__file__).parent / "hold"  # while it is there, no run ends but by a signal

@dataclass
class Args:
    env: str = "wtd-s"
    seed: int = 1
    total_timesteps: int = 4
    checkpoint_frequency: int = 1
    runs_dir: str = "runs"
    resume: str = None
    note: str = ""
    pause: float = 0.0  # seconds of a step
    crashes: int = 0  # at step 2
    ends: str = ""  # how it ends itself at step 2: by Ctrl-C or by the number of a signal, but not if resumed

def parse_args(argv=None):
    parser = argparse.ArgumentParser()
    for name, value in asdict(Args()).items():
        parser.add_argument("--" + name.replace("_", "-"), type=str if value is None else type(value), default=value)
    args = Args(**vars(parser.parse_args(argv)))
    if args.pause < 0:
        raise SystemExit(f"counter: --pause must not be negative, got {args.pause}")
    return args

def main():
    args = parse_args()
    print("pid", os.getpid(), "threads", os.environ["OMP_NUM_THREADS"], flush=True)
    resumed = args.resume is not None
    if resumed:
        folder = Path(args.resume)
        args = Args(**{k: v for k, v in json.loads((folder / "args.json").read_text()).items() if k != "algorithm"})
        step = int((folder / "checkpoint.pt").read_text())
    else:
        folder, step = Path(args.runs_dir) / f"{args.env}__counter__{args.seed}__{time.time_ns() // 1000}", 0
        folder.mkdir()
        (folder / "new").write_text(json.dumps({"algorithm": "counter", **asdict(args)}))
        os.replace(folder / "new", folder / "args.json")
    while step < args.total_timesteps:
        crashed = folder / f"crash-{sum(1 for _ in folder.glob('crash-*'))}"
        if step == 2 and int(crashed.name[6:]) < args.crashes:
            crashed.touch()
            raise RuntimeError("boom")
        if step == 2 and args.ends and not resumed:
            if args.ends == "Ctrl-C":
                raise KeyboardInterrupt
            os.kill(os.getpid(), int(args.ends))
        time.sleep(args.pause)
        if step + 1 == args.total_timesteps and HOLD.exists():
            continue
        step += 1
        shutil.copy(STEPS / str(step), folder / f"events.out.tfevents.{step}")
        if step == 1 or step % args.checkpoint_frequency == 0:
            (folder / "new").write_text(str(step))
            os.replace(folder / "new", folder / "checkpoint.pt")
    (folder / "checkpoint.pt").unlink(missing_ok=True)

if __name__ == "__main__":
    try:
        main()
    except KeyboardInterrupt:
        sys.exit(130)
"""


@pytest.fixture(scope="module")
def events(tmp_path_factory):
    """Event files, each with the evaluation of a step: a return of 10 a step."""
    place = tmp_path_factory.mktemp("steps")
    for step in range(1, 41):
        with SummaryWriter(place / "new") as writer:
            for name in record.VALUES:
                writer.add_scalar(f"eval/{name}", 10 * step, step)
        os.replace(next((place / "new").iterdir()), place / str(step))
    return place


@pytest.fixture
def place(tmp_path, events, monkeypatch):
    """A folder with the counting script and a copy of the sweep, in which sweeps of this process run, too."""
    (tmp_path / "counter.py").write_text(COUNTER)
    (tmp_path / "benchmark").mkdir()
    for module in (sweep, record):
        shutil.copy(module.__file__, tmp_path / "benchmark")
    (tmp_path / "steps").symlink_to(events)
    monkeypatch.setattr(record, "ROOT", tmp_path)
    monkeypatch.setattr(sys, "path", list(sys.path))
    monkeypatch.delitem(sys.modules, "counter", raising=False)
    return tmp_path


@pytest.fixture(autouse=True)
def signals():
    """A sweep in this process leaves its handlers behind, and the signals that it got."""
    handlers = {number: signal.getsignal(number) for number in sweep.SIGNALS}
    yield
    sweep.stop.clear()
    for number, handler in handlers.items():
        signal.signal(number, handler)


def command(place, *extra, seeds="1", envs=("wtd-s",), own=("--workers", "2")):
    """The sweep's arguments for the counting script."""
    given = ["--algos", "counter", "--envs", *envs, "--seeds", seeds, "--runs-dir", str(place / "runs")]
    return [*given, *own, *(["--", *extra] if extra else [])]


def run_folders(place):
    return sorted(path.parent for path in (place / "runs").glob("*/*/args.json"))


def unfinished(place):
    return [folder for folder in run_folders(place) if (folder / "checkpoint.pt").exists()]


def logs(place):
    return "".join(path.read_text() for path in sorted((place / "runs").glob("*/log.txt")))


def results(printed, algorithm="counter"):
    """The column `result` of the closing table."""
    return [line.split()[3] for line in printed.splitlines() if line.split()[:1] == [algorithm] and ": " not in line]


def start(script, arguments):
    """The sweep as a program, in a process group of its own as a shell gives it one."""
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    streams = dict(stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    return subprocess.Popen([sys.executable, str(script), *arguments], env=environment, process_group=0, **streams)


def wait_for(condition, process=None, seconds=180):
    """Returns what the condition gives once that is true."""
    end = time.time() + seconds
    while not (value := condition()):
        assert process is None or process.poll() is None, process.communicate()
        assert time.time() < end, "waited too long"
        time.sleep(0.02)
    return value


def test_finished_runs_are_skipped(place, capsys):
    assert sweep.main(command(place, seeds="1-2", envs=("wtd-s", "bp-10"))) == 0
    printed, told = capsys.readouterr()
    rows = [line.split() for line in printed.splitlines()]
    assert rows[0] == ["algorithm", "env", "seed", "result", "return", "time", "attempts", "folder"]
    assert [row[:5] for row in rows[1:]] == [
        ["counter", env, seed, "finished", "40"] for seed in "12" for env in ("wtd-s", "bp-10")
    ]
    assert all(row[6] == "1" and Path(row[7]) in run_folders(place) for row in rows[1:])
    assert told.count("finished, 0:00:0") == 4 and "[4/4] counter" in told and "return 40" in told
    assert "%|" not in told, "no progress bar where there is no terminal"
    assert logs(place).count("threads 1\n") == 4
    before = logs(place), run_folders(place)
    assert sweep.main(command(place, seeds="1-2", envs=("bp-10", "wtd-s"))) == 0
    assert results(capsys.readouterr().out) == ["skipped"] * 4
    assert (logs(place), run_folders(place)) == before


@pytest.mark.parametrize(
    "change, message",
    [
        ({"--algos": "dqn"}, "sweep: argument --algos: invalid choice: 'dqn' (choose from "),
        ({"--envs": "wtd-x"}, "sweep: argument --envs: unknown environment 'wtd-x' (did you mean "),
        ({"--envs": "no_module:my-task"}, "sweep: argument --envs: No module named 'no_module'"),
        ({"--seeds": "5-1"}, "sweep: argument --seeds: invalid seeds value: '5-1'"),
        ({"--seeds": "1-2-3"}, "sweep: argument --seeds: invalid seeds value: '1-2-3'"),
        ({"--seeds": "x"}, "sweep: argument --seeds: invalid seeds value: 'x'"),
        ({"--workers": "0"}, "sweep: --workers must be at least 1, got 0"),
        ({"--address": "auto"}, "sweep: --address needs --engine ray"),
        ({"--seeds": "1-99999999999999999999"}, "sweep: argument --seeds: invalid seeds value: '1-9999"),
        ({"--seeds": "1000000000000001"}, "sweep: argument --seeds: invalid seeds value: '1000000000000001'"),
        ({"--runs-dir": ""}, "sweep: argument --runs-dir: invalid folder value: ''"),
        ({"--record": ""}, "sweep: argument --record: invalid folder value: ''"),
        ({"--runs-dir": "/proc"}, "sweep: cannot use --record or --runs-dir: "),  # a folder, but nothing can be written
        ({"--runs-dir": __file__}, "sweep: cannot use --record or --runs-dir: "),
        ({"--record": __file__}, "sweep: cannot use --record or --runs-dir: "),
        ({"--": "--seed=1"}, "sweep: --env, --seed and --runs-dir cannot stand behind --"),
        ({"--": "--runs-dir=x"}, "sweep: --env, --seed and --runs-dir cannot stand behind --"),
        ({"--": "--pose=1"}, "sweep: counter does not take --pose=1"),
        ({"--": "--pause=-1"}, "counter: --pause must not be negative, got -1.0"),
    ],
)
def test_bad_input_is_told_in_one_line(place, change, message):
    given = {"--algos": "counter", "--envs": "wtd-s", "--seeds": "1", "--runs-dir": str(place / "runs")} | change
    with pytest.raises(SystemExit) as stopped:
        sweep.main([word for pair in given.items() for word in pair])
    assert message in str(stopped.value) and "\n" not in str(stopped.value)
    assert not run_folders(place)


def test_seeds(place, capsys):
    given = command(place, own=["--dry-run"])
    given[given.index("--seeds") + 1 : given.index("--seeds") + 2] = ["3", "1", "2-4"]
    sweep.main(given)
    assert [line.split()[3] for line in capsys.readouterr().out.splitlines()] == ["3:", "1:", "2:", "4:"]


def test_ray_not_installed(place, monkeypatch):
    monkeypatch.setitem(sys.modules, "ray", None)
    with pytest.raises(SystemExit, match=r"sweep: --engine ray needs Ray: pip install -e '\.\[cluster\]'"):
        sweep.main(command(place, own=["--engine", "ray"]))


def test_progress_bar_on_a_terminal(place, capsys, monkeypatch):
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True)
    assert sweep.main(command(place, seeds="1-2")) == 0
    assert "2/2" in capsys.readouterr().err


@pytest.mark.slow
def test_a_run_is_known_by_its_flags_and_code(place, capsys):
    """Another value of a flag is another run, a default in words is not; nor are runs started by hand the sweep's."""
    for extra, runs in (((), 1), (("--note=a",), 2), (("--note=b",), 3), (("--note", "a"), 3), (("--crashes=0",), 3)):
        assert sweep.main(command(place, *extra)) == 0
        assert len(run_folders(place)) == runs, extra
    (place / "counter.py").write_text(COUNTER + "# a comment\n")
    assert sweep.main(command(place)) == 0
    assert len(run_folders(place)) == 3
    (place / "counter.py").write_text(COUNTER + "changed = True\n")
    assert sweep.main(command(place)) == 0
    assert len(run_folders(place)) == 4
    by_hand = [sys.executable, str(place / "counter.py"), "--seed=2", f"--runs-dir={place / 'runs'}"]
    subprocess.run(by_hand, env={**os.environ, "OMP_NUM_THREADS": "1"}, check=True)
    assert sweep.main(command(place, seeds="2")) == 0
    assert len(run_folders(place)) == 5
    (own,) = (place / "runs").glob("*__2__*/args.json")
    assert record.describe(own.parent)["checksum"] == "" != record.describe(run_folders(place)[-1])["checksum"]


@pytest.mark.slow
def test_a_value_of_another_family_leaves_the_checksum(tmp_path, monkeypatch):
    """A value of Args or DEFAULTS counts on the tasks on which it is in force, anything else on all."""
    monkeypatch.setattr(record, "ROOT", tmp_path)
    text = (ROOT / "avf_vdn.py").read_text()
    for edit, changes in (
        (("obs_scale=4.0", "obs_scale=3.0"), {"ct-10"}),
        (("hysteresis=0.1", "hysteresis=0.2"), {"bp-10"}),
        (("# ---- act: one", "# ---- act, one"), set()),
        (("Numbered deviations", "The deviations"), set()),
        (("step += args.num_envs", "step += args.num_envs + 0"), {"bp-10", "wtd-s", "ct-10"}),
        (("gamma: float = 0.95", "gamma: float = 0.94"), {"bp-10", "wtd-s"}),
        (("# discount factor of", "# the discount factor of"), set()),
    ):
        found = []
        for text_now in (text, text.replace(*edit)):
            assert (text_now == text) == (len(found) == 0)
            (tmp_path / "avf_vdn.py").write_text(text_now)
            script = types.ModuleType("avf_vdn")
            monkeypatch.setitem(sys.modules, "avf_vdn", script)
            script.__file__ = "avf_vdn.py"
            exec(text_now, vars(script))
            monkeypatch.setattr(record, "load_script", lambda name, script=script: script)
            found.append({env: record.checksum("avf_vdn", env) for env in ("bp-10", "wtd-s", "ct-10")})
        before, after = found
        assert {env for env in before if before[env] != after[env]} == changes, edit


TASKS = ["bp-10", "wtd-s", "ct-10", "own:x"]


@pytest.mark.slow
@pytest.mark.parametrize(
    "file, edit, changes",
    [
        ("envs/core.py", ("One step is one primitive time step.", "A step is a primitive time step."), set()),
        ("envs/core.py", ("self.num_envs = num_envs", "self.num_envs = num_envs  # N"), set()),
        ("envs/core.py", ("self.num_envs = num_envs", "self.num_envs = num_envs + 0"), {*TASKS}),
        ("envs/capture_target.py", ("slip=0.1,", "slip=0.2,"), {"ct-10", "own:x"}),
        ("envs/checks.py", ("np.mod(number, 1)", "np.mod(number, 2)"), {*TASKS}),
        ("envs/rendering.py", ("import", "import sys\nimport"), set()),
        ("envs/__init__.py", ("def make(", "def new():\n    pass\n\n\ndef make("), set()),
        ("own.py", ("n_agents=2", "n_agents=3"), {"own:x"}),
        ("own.py", ("import envs", "import envs  # all tasks"), set()),
    ],
)
def test_the_checksum_is_of_what_a_run_executes(tmp_path, monkeypatch, file, edit, changes):
    """Comments, docstrings, drawing and other tasks are not: modules whose files are copies, one of them edited."""
    monkeypatch.setattr(envs, "_TASKS", dict(envs._TASKS))
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, "own", raising=False)
    (tmp_path / "own.py").write_text(
        "import envs\nfrom envs.capture_target import CaptureTarget\n\n"
        "envs._TASKS['x'] = CaptureTarget, dict(n_agents=2, key=lambda x: x)\n"
    )
    shutil.copytree(ROOT / "envs", tmp_path / "envs")
    for module in [module for module in sys.modules if module.partition(".")[0] == "envs"]:
        copy = tmp_path / "envs" / Path(sys.modules[module].__file__).name
        monkeypatch.setattr(sys.modules[module], "__file__", str(copy))
    before = [record.checksum("avf_vdn", task) for task in TASKS]
    path = tmp_path / file
    assert edit[0] in path.read_text()
    path.write_text(path.read_text().replace(edit[0], edit[1], 1))
    after = [record.checksum("avf_vdn", task) for task in TASKS]
    assert {task for task, *pair in zip(TASKS, before, after, strict=True) if pair[0] != pair[1]} == changes


def test_the_checksum_is_of_the_keywords_of_the_task(monkeypatch):
    before = record.checksum("avf_vdn", "bp-10"), record.checksum("avf_vdn", "bp-20")
    monkeypatch.setitem(envs._TASKS, "bp-10", (envs.BoxPushing, {"grid": 12}))
    after = record.checksum("avf_vdn", "bp-10"), record.checksum("avf_vdn", "bp-20")
    assert before[0] != after[0] and before[1] == after[1]


def test_a_task_of_ones_own_is_swept_and_recorded(place, capsys, monkeypatch):
    (place / "my_task.py").write_text(
        "import envs\nfrom envs.capture_target import CaptureTarget\nenvs.register('own', CaptureTarget, n_agents=2)\n"
    )
    monkeypatch.syspath_prepend(place)
    own = ["--record", str(place / "kept")]
    assert sweep.main(command(place, envs=("my_task:own",), own=own)) == 0
    assert results(capsys.readouterr().out) == ["finished"] and recorded(place)[0]["env"].tolist() == ["my_task:own"]
    assert "my_task-own__counter__1__" in str(run_folders(place)[0])
    assert sweep.main(command(place, envs=("my_task:own",), own=own)) == 0
    assert results(capsys.readouterr().out) == ["recorded"]


def test_code_that_changes_during_a_sweep_is_not_run(place, capsys, monkeypatch):
    real = sweep.run_script

    def run_script(*arguments):
        (place / "counter.py").write_text(COUNTER + "changed = True\n")
        return real(*arguments)

    monkeypatch.setattr(sweep, "run_script", run_script)
    assert sweep.main(command(place, seeds="1-2", own=["--workers", "1"])) == 1
    printed = capsys.readouterr().out
    assert results(printed) == ["finished", "failed"] and "the code was changed since the sweep began" in printed


def test_dry_run_writes_nothing(place, capsys):
    assert sweep.main(command(place, own=["--dry-run"])) == 0
    assert capsys.readouterr().out == "counter wtd-s seed 1: run\n" and not (place / "runs").exists()
    sweep.main(command(place, seeds="1-3"))
    finished, stopped, lost = run_folders(place)
    (stopped / "checkpoint.pt").write_text("3")
    (lost / "events.out.tfevents.4").unlink()  # killed before its first checkpoint: nothing to go on with
    capsys.readouterr()
    assert sweep.main(command(place, seeds="1-3", own=["--dry-run"])) == 0
    assert capsys.readouterr().out.splitlines() == [
        f"counter wtd-s seed 1: skip {finished}",
        f"counter wtd-s seed 2: resume {stopped}",
        "counter wtd-s seed 3: run",
    ]


@pytest.mark.slow
@pytest.mark.parametrize("text", ["", "{", "[]", "{}", '{"total_timesteps": "many"}'])
def test_a_run_that_was_killed_while_it_began_is_begun_again(place, capsys, text):
    """It has no checkpoint, and an args.json that is cut short."""
    sweep.main(command(place))
    (place / "runs").rename(place / "old")
    (killed,) = (path for path in (place / "old").glob("*/*") if path.is_dir())
    begun = place / "runs" / killed.parent.name / killed.name
    begun.mkdir(parents=True)
    (begun / "args.json").write_text(text)
    assert sweep.main(command(place, own=["--dry-run"])) == 0
    assert capsys.readouterr().out.splitlines()[-1] == "counter wtd-s seed 1: run"
    assert sweep.main(command(place)) == 0 and results(capsys.readouterr().out) == ["finished"]


def test_a_crash_is_retried_once_from_the_checkpoint(place, capsys):
    assert sweep.main(command(place, "--crashes=1")) == 0
    printed, told = capsys.readouterr()
    assert "counter wtd-s seed 1: exit code 1: RuntimeError: boom; tried once more" in told
    assert printed.splitlines()[1].split()[3:7:3] == ["finished", "2"] and len(run_folders(place)) == 1
    assert f"--resume={run_folders(place)[0]}" in logs(place)


@pytest.mark.slow
@pytest.mark.parametrize("how, code", [("Ctrl-C", 130), (signal.SIGTERM, -15), (signal.SIGKILL, -9)])
def test_a_script_that_somebody_else_stops_is_not_tried_again(place, capsys, how, code):
    """Nor has it failed: the next call of the same command goes on with it."""
    assert sweep.main(command(place, f"--ends={how if how == 'Ctrl-C' else how.value}")) == 1
    printed, told = capsys.readouterr()
    assert results(printed) == ["stopped"] and "tried once more" not in told
    assert f"counter wtd-s seed 1 stopped: exit code {code}: " in printed.splitlines()[-1]
    assert sweep.main(command(place, f"--ends={how if how == 'Ctrl-C' else how.value}")) == 0
    assert results(capsys.readouterr().out) == ["finished"] and logs(place).count("--resume") == 1
    assert len(run_folders(place)) == 1


@pytest.mark.slow
def test_a_run_that_crashes_again_is_reported_and_the_others_go_on(place, capsys):
    sweep.main(command(place, "--crashes=9", "--total-timesteps=2"))  # ends before the crash
    assert sweep.main(command(place, "--crashes=3", seeds="1-2")) == 1
    printed = capsys.readouterr().out.splitlines()
    assert printed[-1].startswith("counter wtd-s seed 2 failed: exit code 1: RuntimeError: boom (log: ")
    assert [line.split()[3:7:3] for line in printed[-4:-2]] == [["failed", "2"]] * 2
    assert logs(place).count("=== ") == 5 and Path(printed[-1].split("log: ")[1][:-1]).exists()
    assert sweep.main(command(place, "--crashes=3", seeds="1-2")) == 0, "the same command tries again"
    assert results(capsys.readouterr().out) == ["finished"] * 2


@pytest.mark.slow
def test_a_run_that_another_process_works_on_is_left_to_it(place, capsys, monkeypatch):
    sweep.main(command(place))
    shutil.rmtree(run_folders(place)[0])
    (log,) = (place / "runs").glob("*/log.txt")
    monkeypatch.setattr(sweep, "LOCK_SECONDS", 0.5)
    with open(log) as other:
        fcntl.flock(other, fcntl.LOCK_EX)
        assert sweep.main(command(place)) == 1
        assert "busy" in capsys.readouterr().out and not run_folders(place)
        monkeypatch.setattr(sweep, "LOCK_SECONDS", 60)
        threading.Timer(0.5, lambda: fcntl.flock(other, fcntl.LOCK_UN)).start()
        assert sweep.main(command(place)) == 0, "waits a while for it to end"


def pids(place):
    """The processes of all scripts that have been started."""
    return [int(line.split()[1]) for line in logs(place).splitlines() if line.startswith("pid ")]


def are_gone(numbers):
    return not any(Path(f"/proc/{number}").exists() for number in numbers)


@pytest.mark.slow
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_a_stopped_sweep_ends_its_scripts_and_can_go_on(place, number, capsys):
    """Ctrl-C reaches the whole process group of a sweep. Two runs have a checkpoint then, the third has not begun."""
    arguments = command(place, "--pause=0.1", seeds="1-3")
    (place / "hold").touch()  # no machine is too slow: what is to be stopped is running until it is
    process = start(place / "benchmark" / "sweep.py", arguments)
    wait_for(lambda: len(unfinished(place)) == 2, process)
    os.killpg(process.pid, number)
    printed, told = process.communicate(timeout=180)
    assert process.returncode == 128 + number
    assert told.strip().endswith("with: python " + " ".join([process.args[1], *arguments])), told
    assert results(printed) == ["stopped"] * 3 and are_gone(pids(place))
    assert "exit code" not in printed, "it was the sweep itself that stopped them"
    assert len(unfinished(place)) == 2
    (place / "hold").unlink()
    assert sweep.main(arguments) == 0
    assert results(capsys.readouterr().out) == ["finished"] * 3 and logs(place).count("--resume") == 2
    assert len(run_folders(place)) == 3 and not unfinished(place)


def test_under_nohup_a_closed_terminal_stops_nothing(place, capsys):
    signal.signal(signal.SIGHUP, signal.SIG_IGN)
    assert sweep.main(command(place)) == 0
    assert signal.getsignal(signal.SIGHUP) == signal.SIG_IGN and results(capsys.readouterr().out) == ["finished"]


@pytest.mark.slow
@pytest.mark.parametrize("way", ["2>&-", "2>/dev/full"])
def test_a_closed_or_full_stderr_stops_nothing(place, way):
    words = shlex.join([sys.executable, str(place / "benchmark" / "sweep.py"), *command(place, "--crashes=1")])
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    done = subprocess.run(f"{words} {way}", shell=True, env=environment, stdout=subprocess.PIPE, text=True, check=False)
    assert done.returncode == 0 and results(done.stdout) == ["finished"]
    assert len(done.stdout.splitlines()) == 2, "the closing table alone"


@pytest.mark.slow
def test_killing_the_sweep_leaves_no_process_and_loses_little(place):
    """A script that has just been killed still holds the lock for a moment: a sweep started at once has to wait."""
    arguments = command(place, "--pause=0.1")
    (place / "hold").touch()
    process = start(place / "benchmark" / "sweep.py", arguments)
    wait_for(lambda: unfinished(place), process)
    process.kill()
    process.wait()
    (place / "hold").unlink()
    assert sweep.main(arguments) == 0
    first, second = pids(place)
    wait_for(lambda: are_gone([first, second]), seconds=30)
    assert "--resume" in logs(place) and len(run_folders(place)) == 1


# Recording


def recorded(place):
    return [pd.read_csv(place / "kept" / name, keep_default_na=False) for name in ("runs.csv", "evaluations.csv")]


@pytest.mark.slow
def test_recorded_runs_are_kept_and_skipped_without_their_folders(place, capsys):
    keep = ["--record", str(place / "kept"), "--workers", "2"]
    assert sweep.main(command(place, seeds="1-2")) == 0
    assert sweep.main(command(place, seeds="1-3", own=keep)) == 0, "those that were finished before are recorded, too"
    runs, evaluations = recorded(place)
    assert sorted(runs["seed"]) == [1, 2, 3] and list(runs) == record.RUNS
    assert set(runs["checksum"]) == {record.checksum("counter", "wtd-s")} and set(runs["steps"]) == {4}
    assert set(runs["flags"]) == set(runs["variant"]) == {""}
    assert all(text.endswith(f", {torch.backends.cpu.get_cpu_capability()}") for text in runs["processor"])
    one = evaluations[evaluations["seed"] == 2]
    assert list(one["step"]) == [1, 2, 3, 4] and list(one["return"]) == list(one["success"]) == [10, 20, 30, 40]
    shutil.rmtree(place / "runs")
    assert sweep.main(command(place, seeds="1-4", own=[*keep, "--dry-run"])) == 0
    assert [line.split(": ")[1] for line in capsys.readouterr().out.splitlines()[-4:]] == ["recorded"] * 3 + ["run"]
    assert sweep.main(command(place, seeds="1-4", own=keep)) == 0
    assert results(capsys.readouterr().out) == ["recorded"] * 3 + ["finished"]
    assert len(run_folders(place)) == 1 and len(recorded(place)[0]) == 4

    assert sweep.main(command(place, "--note=a", seeds="1", own=[*keep, "--variant", "mine"])) == 0, "other flags"
    (place / "counter.py").write_text(COUNTER + "changed = True\n")
    assert sweep.main(command(place, seeds="1", own=keep)) == 0, "other code"
    assert results(capsys.readouterr().out) == ["finished"] * 2
    runs, evaluations = recorded(place)
    assert len(runs) == 6 and len(evaluations) == 24
    assert runs[["variant", "flags"]].iloc[4].tolist() == ["mine", "note=a"]


def add_runs(folder, first):
    for seed in range(first, first + 10):
        key = dict(algorithm="a", env="e", flags="x=1", seed=str(seed), checksum="c")
        run = {name: "" for name in record.RUNS} | key
        rows = [key | {"step": str(step)} | dict.fromkeys(record.VALUES, "1") for step in range(5)]
        record.add(folder, run, pd.DataFrame(rows))


def test_recording_from_several_processes_loses_no_row(tmp_path):
    processes = [multiprocessing.Process(target=add_runs, args=(tmp_path, 10 * k)) for k in range(3)]
    for process in processes:
        process.start()
    add_runs(tmp_path, 0)  # those of the first process again: no run is there twice
    for process in processes:
        process.join()
    runs, evaluations = record.load(tmp_path)
    assert sorted(map(int, runs["seed"])) == list(range(30)) and len(evaluations) == 150
    assert {path.name for path in tmp_path.iterdir()} == {"runs.csv", "evaluations.csv"}


def test_a_kill_while_recording_leaves_nothing_half_done(tmp_path, monkeypatch):
    add_runs(tmp_path, 0)
    real = record.replace_text
    monkeypatch.setattr(record, "replace_text", lambda path, text: real(path, text) if "eval" in str(path) else 1 / 0)
    with pytest.raises(ZeroDivisionError):
        add_runs(tmp_path, 10)
    assert len(record.load(tmp_path)[0]) == 10 and len(record.load_runs(tmp_path)) == 10
    monkeypatch.setattr(record, "replace_text", real)
    add_runs(tmp_path, 10)
    assert len(record.load(tmp_path)[0]) == 20 and len(record.load(tmp_path)[1]) == 100


@pytest.mark.slow
def test_a_real_script_is_stopped_continued_and_recorded(tmp_path, capsys):
    tiny = "--total-timesteps=3000 --eval-frequency=1000 --eval-episodes=2 --learning-starts=100000".split()
    own = ["--record", str(tmp_path / "kept"), "--runs-dir", str(tmp_path / "runs"), "--", *tiny]
    arguments = ["--algos", "avf_qplex", "--envs", "wtd-s", "--seeds", "3", *own]

    def interrupt():
        wait_for(lambda: unfinished(tmp_path))
        os.kill(os.getpid(), signal.SIGINT)

    threading.Thread(target=interrupt).start()
    assert sweep.main(arguments) == 130 and results(capsys.readouterr().out, "avf_qplex") == ["stopped"]
    sweep.stop.clear()
    assert not (tmp_path / "kept" / "runs.csv").exists()
    assert sweep.main(arguments) == 0
    runs, evaluations = recorded(tmp_path)
    assert list(evaluations["step"]) == [1024, 2016, 3008] and runs["steps"].tolist() == [3008]
    assert evaluations[record.VALUES].apply(pd.to_numeric).notna().all(axis=None)
    (folder,) = run_folders(tmp_path)
    assert f"--resume={folder}" in logs(tmp_path) and record.is_finished(folder)


# Ray


@pytest.fixture(scope="module")
def cluster():
    """A Ray cluster of two nodes of one CPU, on this machine."""
    pytest.importorskip("ray", reason="Ray is not installed: pip install -e '.[cluster]'")
    from ray.cluster_utils import Cluster

    for attempt in range(3):
        cluster = Cluster()
        try:
            cluster.add_node(num_cpus=1)
            cluster.add_node(num_cpus=1)
            break
        except Exception:  # Ray gives a node 30 seconds to start, too little on a busy machine
            cluster.shutdown()
            if attempt == 2:
                raise
    yield cluster
    cluster.shutdown()


@pytest.mark.slow
def test_a_sweep_on_ray_is_stopped_and_survives_the_loss_of_a_node(place, cluster):
    """Of three runs on two nodes the first two are stopped; continued, one of the nodes is killed under its run."""
    options = ["--pause=0.1", "--total-timesteps=20", "--checkpoint-frequency=2"]
    own = ["--engine", "ray", "--address", cluster.address]
    arguments = command(place, *options, seeds="1-3", own=own)
    (place / "hold").touch()
    process = start(place / "benchmark" / "sweep.py", arguments)
    wait_for(lambda: len(unfinished(place)) == 2, process)
    os.killpg(process.pid, signal.SIGINT)
    printed, told = process.communicate(timeout=180)
    assert process.returncode == 130 and "go on from" in told, told
    assert results(printed) == ["stopped"] * 3, printed
    assert len(unfinished(place)) == 2 and are_gone(pids(place)), logs(place)

    process = start(place / "benchmark" / "sweep.py", arguments)
    wait_for(lambda: len(pids(place)) == 4, process)
    cluster.remove_node(cluster.worker_nodes.copy().pop(), allow_graceful=False)
    wait_for(lambda: sum(Path(f"/proc/{number}").exists() for number in pids(place)) == 1, process)
    (place / "hold").unlink()
    printed, told = process.communicate(timeout=180)
    assert process.returncode == 0, told
    assert results(printed) == ["finished"] * 3, printed
    assert len(run_folders(place)) == 3 and logs(place).count("--resume") == 3


@pytest.mark.parametrize(
    ("env", "again"), [("wtd-s", ["--resume=runs/x"]), ("my:task", ["--resume=runs/x", "--env=my:task"])]
)
def test_a_run_of_a_task_of_ones_own_is_resumed_with_its_name(tmp_path, monkeypatch, env, again):
    """A script imports no module that only its checkpoint names."""
    commands = []

    class Ended:
        def __init__(self, command, **options):
            commands.append(command)

        def poll(self):
            return 0

    monkeypatch.setattr(sweep.subprocess, "Popen", Ended)
    monkeypatch.setattr(record, "commit", lambda: "")
    job = dict(
        algorithm="avf_vdn", env=env, seed="1", place=str(tmp_path), options=[], flags="", variant="", checksum=""
    )
    with open(tmp_path / "log.txt", "w") as log:
        assert sweep.run_script(job, "runs/x", log) == 0
    assert commands[0][-len(again) :] == again
