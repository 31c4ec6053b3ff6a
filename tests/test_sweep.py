"""The sweep: what it skips, resumes, retries and reports, and that no way of stopping it loses or doubles a run.

Most tests run a script that counts steps instead of learning, so that they take no time; it does what the sweep relies
on: parse_args, check, a run folder with args.json, checkpoint.pt and model.pt, and a checkpoint after a signal.
"""

import fcntl
import json
import os
import shutil
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest
import torch

from avf_vdn import defaults, train
from benchmark import sweep
from tests.curves import scalars
from tests.test_runs import TINY, flags

ROOT = Path(__file__).parents[1]
COUNTER = """
import argparse, json, os, shutil, signal, sys, time
from dataclasses import asdict, dataclass
from pathlib import Path

STEPS = Path(__file__).parent / "steps"  # checkpoints and models as the test saved them: no torch, so a quick start

@dataclass
class Args:
    env: str = "wtd-s"
    seed: int = 1
    total_timesteps: int = 4
    checkpoint_frequency: int = 1
    runs_dir: str = "runs"
    device: str = "cpu"
    torch_threads: int = 2
    resume: str = None
    note: str = ""
    pause: float = 0.0  # seconds of a step
    crashes: int = 0  # at step 2
    writing: float = 0.0  # seconds to write the checkpoint of a signal

def parse_args(argv=None):
    parser = argparse.ArgumentParser()
    for name, value in asdict(Args()).items():
        parser.add_argument("--" + name.replace("_", "-"), type=str if value is None else type(value), default=value)
    return Args(**vars(parser.parse_args(argv)))

def check(args):
    if args.pause < 0:
        raise SystemExit(f"counter: --pause must not be negative, got {args.pause}")

def put(folder, name, step):
    shutil.copy(STEPS / f"{name}-{step}.pt", folder / "new")
    os.replace(folder / "new", folder / f"{name}.pt")

if __name__ == "__main__":
    args, stop = parse_args(), []
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda number, frame: stop.append(number))
    print("pid", os.getpid(), "threads", os.environ["OMP_NUM_THREADS"], args.torch_threads, flush=True)
    if args.resume:
        folder = Path(args.resume)
        args = Args(**{k: v for k, v in json.loads((folder / "args.json").read_text()).items() if k != "algorithm"})
        step = json.loads((folder / "step.json").read_text())
    else:
        folder, step = Path(args.runs_dir) / f"{args.env}__counter__{args.seed}__{time.time_ns()}", 0
        folder.mkdir()
        (folder / "args.json").write_text(json.dumps({"algorithm": "counter", **asdict(args)}))
    while step < args.total_timesteps and not stop:
        crashed = folder / f"crash-{sum(1 for _ in folder.glob('crash-*'))}"
        if step == 2 and int(crashed.name[6:]) < args.crashes:
            crashed.touch()
            raise RuntimeError("boom")
        time.sleep(args.pause)
        step += 1
        put(folder, "model", step)
        if step % args.checkpoint_frequency == 0 or step == args.total_timesteps:
            (folder / "step.json").write_text(json.dumps(step))
            put(folder, "checkpoint", step)
    if stop:
        time.sleep(args.writing)
        (folder / "step.json").write_text(json.dumps(step))
        put(folder, "checkpoint", step)
        print(len(stop), "signals, stopped at step", step)
"""


@pytest.fixture
def place(tmp_path, monkeypatch):
    """A folder with the counting script and a copy of the sweep, in which sweeps of this process run, too."""
    (tmp_path / "counter.py").write_text(COUNTER)
    (tmp_path / "benchmark").mkdir()
    shutil.copy(sweep.__file__, tmp_path / "benchmark")
    (tmp_path / "steps").mkdir()
    for step in range(41):
        torch.save({"step": step}, tmp_path / "steps" / f"checkpoint-{step}.pt")
        torch.save({"last": {"step": step, "return": 10.0 * step}}, tmp_path / "steps" / f"model-{step}.pt")
    monkeypatch.setattr(sweep, "ROOT", tmp_path)
    monkeypatch.setattr(sys, "path", list(sys.path))
    monkeypatch.delitem(sys.modules, "counter", raising=False)
    return tmp_path


def command(place, *extra, seeds="1", envs=("wtd-s",), own=()):
    """The sweep's arguments for the counting script."""
    given = ["--algos", "counter", "--envs", *envs, "--seeds", seeds, "--workers", "2"]
    return [*given, "--runs-dir", str(place / "runs"), *own, *(["--", *extra] if extra else [])]


def run_folders(place):
    return sorted(path.parent for path in (place / "runs").glob("*/args.json"))


def logs(place):
    return "".join(path.read_text() for path in sorted((place / "runs" / "logs").glob("*.log")))


def start(script, arguments, **options):
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


def steps(runs):
    """Steps of all checkpoints of a runs folder."""
    return [torch.load(path, weights_only=True)["step"] for path in runs.glob("*/checkpoint.pt")]


def test_finished_runs_are_skipped(place, capsys):
    assert sweep.main(command(place, seeds="1-2", envs=("wtd-s", "bp-10"))) == 0
    printed, told = capsys.readouterr()
    rows = [line.split() for line in printed.splitlines()]
    assert rows[0] == ["algorithm", "env", "seed", "result", "return", "time", "attempts", "folder"]
    assert [row[:5] for row in rows[1:]] == [
        ["counter", env, seed, "finished", "40.00"] for seed in "12" for env in ("wtd-s", "bp-10")
    ]
    assert all(row[6] == "1" and Path(row[7]) in run_folders(place) for row in rows[1:])
    assert told.count("finished, 0:00:0") == 4 and "[4/4] counter" in told and "greedy return 40.00" in told
    assert "%|" not in told, "no progress bar where there is no terminal"
    assert logs(place).count("threads 1 1\n") == 4, "one thread each, whatever the script's own default"
    before = logs(place), run_folders(place)
    assert sweep.main(command(place, seeds="1-2", envs=("bp-10", "wtd-s"))) == 0
    assert capsys.readouterr().out.count("skipped  40.00") == 4
    assert (logs(place), run_folders(place)) == before


def test_seeds():
    assert sweep.parse_seeds(["1-3"]) == [1, 2, 3] and sweep.parse_seeds(["0,2,7"]) == [0, 2, 7]
    assert sweep.parse_seeds(["3", "1", "2-4,9"]) == [3, 1, 2, 4, 9]


@pytest.mark.parametrize(
    "change, message",
    [
        ({"--algos": "dqn"}, "sweep: unknown algorithm 'dqn'; valid names: counter"),
        ({"--envs": "wtd-x"}, "sweep: unknown environment 'wtd-x'; valid names: bp-10 bp-20"),
        ({"--seeds": "5-1"}, "sweep: --seeds takes 1-5 or 0,2,7 or 1 2 3, not '5-1'"),
        ({"--seeds": "1,,2"}, "not '1,,2'"),
        ({"--seeds": "-1"}, "not '-1'"),
        ({"--workers": "0"}, "sweep: --workers must be at least 1, got 0"),
        ({"--address": "auto"}, "sweep: --address needs --engine ray"),
        ({"--runs-dir": __file__}, f"sweep: cannot write to --runs-dir {__file__}: "),
        ({"--": "--seed=3"}, "sweep: --seed=3 is set by the sweep"),
        ({"--": "--runs_dir=x"}, "sweep: --runs_dir=x is set by the sweep"),
        ({"--": "--pose=1"}, "sweep: counter does not take --pose=1"),
        ({"--": "--pause=-1"}, "counter: --pause must not be negative, got -1.0"),
    ],
)
def test_bad_input_is_told_in_one_line(place, change, message):
    given = {"--algos": "counter", "--envs": "wtd-s", "--seeds": "1", "--runs-dir": str(place / "runs")} | change
    with pytest.raises(SystemExit) as stopped:
        sweep.main([word for pair in given.items() for word in pair])
    assert message in str(stopped.value) and "\n" not in str(stopped.value)
    assert not (place / "runs").exists()


def test_ray_not_installed(place, monkeypatch):
    monkeypatch.setitem(sys.modules, "ray", None)
    with pytest.raises(SystemExit, match=r"sweep: --engine ray needs Ray: pip install -e '\.\[cluster\]'"):
        sweep.main(command(place, own=["--engine", "ray"]))


def test_progress_bar_on_a_terminal(place, capsys, monkeypatch):
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True)
    assert sweep.main(command(place, seeds="1-2")) == 0
    assert "2 of 2 runs" in capsys.readouterr().err


def test_dry_run_writes_nothing(place, capsys):
    assert sweep.main(command(place, own=["--dry-run"])) == 0
    assert capsys.readouterr().out == "counter wtd-s seed 1: run\n" and not (place / "runs").exists()
    sweep.main(command(place))
    (finished,) = run_folders(place)
    shutil.copytree(finished, other := Path(str(finished).replace("__1__", "__2__")))
    saved = json.loads((other / "args.json").read_text())
    (other / "args.json").write_text(json.dumps(saved | {"seed": 2}))
    torch.save({"step": 3}, other / "checkpoint.pt")
    shutil.copytree(other, shorter := Path(f"{other}-1"))
    torch.save({"step": 2}, shorter / "checkpoint.pt")
    capsys.readouterr()
    assert sweep.main(command(place, seeds="1-2", own=["--dry-run"])) == 0
    assert capsys.readouterr().out.splitlines() == [
        f"counter wtd-s seed 1: skip {finished}",
        f"counter wtd-s seed 2: resume at step 3 {other}",
    ]


def test_a_run_is_known_by_its_arguments(place, capsys):
    """Another value of a flag is another run; device, threads and checkpoint frequency are not."""
    for extra, runs in (((), 1), (("--note=a",), 2), (("--note=b",), 3), (("--note", "a"), 3), (("--device=gpu",), 3)):
        assert sweep.main(command(place, *extra)) == 0
        assert len(run_folders(place)) == runs, extra
    assert sweep.main(command(place, "--checkpoint-frequency=2", "--torch-threads=3")) == 0
    assert len(run_folders(place)) == 3 and len(list((place / "runs" / "logs").iterdir())) == 3
    for folder in run_folders(place):  # as an older version of the script may have written it
        saved = json.loads((folder / "args.json").read_text())
        (folder / "args.json").write_text(json.dumps(saved | {"forgotten": 1}))
    assert sweep.main(command(place)) == 0
    assert len(run_folders(place)) == 4


def test_a_folder_without_a_whole_checkpoint_does_not_count(place, capsys):
    sweep.main(command(place))
    (old,) = run_folders(place)
    for damage in (lambda path: path.unlink(), lambda path: path.write_bytes(b"half")):
        damage(old / "checkpoint.pt")
        before = {path.name: path.read_bytes() for path in old.iterdir()}
        assert sweep.main(command(place)) == 0
        assert {path.name: path.read_bytes() for path in old.iterdir()} == before, "left alone"
        (new,) = set(run_folders(place)) - {old}
        assert str(new) in capsys.readouterr().out and "--resume" not in logs(place)
        shutil.rmtree(new)
        (old / "checkpoint.pt").write_bytes(b"")


def test_a_crash_is_retried_once_from_the_checkpoint(place, capsys):
    assert sweep.main(command(place, "--crashes=1")) == 0
    printed, told = capsys.readouterr()
    assert "crash 1 of at most 2, exit code 1: RuntimeError: boom" in told
    assert printed.splitlines()[1].split()[3:7:3] == ["finished", "2"] and len(run_folders(place)) == 1
    assert f"--resume={run_folders(place)[0]}" in logs(place)


def test_a_run_that_crashes_again_is_reported_and_the_others_go_on(place, capsys):
    sweep.main(command(place, "--crashes=9", "--total-timesteps=2"))  # ends before the crash
    assert sweep.main(command(place, "--crashes=3", seeds="1-2")) == 1
    printed = capsys.readouterr().out.splitlines()
    assert printed[-1].startswith("counter wtd-s seed 2 failed: exit code 1: RuntimeError: boom (log: ")
    assert [line.split()[3:7:3] for line in printed[-4:-2]] == [["failed", "2"]] * 2
    assert logs(place).count("=== ") == 5 and Path(printed[-1].split("log: ")[1][:-1]).exists()
    assert sweep.main(command(place, "--crashes=3", seeds="1-2")) == 0, "the same command tries again"
    assert [line.split()[3] for line in capsys.readouterr().out.splitlines()[1:]] == ["finished"] * 2


def test_a_run_that_another_process_works_on_is_left_to_it(place, capsys, monkeypatch):
    sweep.main(command(place))
    shutil.rmtree(run_folders(place)[0])
    (log,) = (place / "runs" / "logs").iterdir()
    monkeypatch.setattr(sweep, "LOCK_SECONDS", 0.5)
    with open(log) as other:
        fcntl.flock(other, fcntl.LOCK_EX)
        assert sweep.main(command(place)) == 1
        assert "busy" in capsys.readouterr().out and not run_folders(place)
        monkeypatch.setattr(sweep, "LOCK_SECONDS", 60)
        threading.Timer(0.5, lambda: fcntl.flock(other, fcntl.LOCK_UN)).start()
        assert sweep.main(command(place)) == 0, "waits a while for it to end"


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_stopping_loses_nothing(place, number):
    """Ctrl-C reaches the whole process group; the scripts must get it once, from the sweep."""
    options = ["--pause=0.2", "--total-timesteps=40", "--checkpoint-frequency=40"]
    arguments = command(place, *options, seeds="1-3")
    process = start(place / "benchmark" / "sweep.py", arguments)
    wait_for(lambda: len(list((place / "runs").glob("*/model.pt"))) == 2, process)
    os.killpg(process.pid, number)
    printed, told = process.communicate(timeout=180)
    assert process.returncode == 128 + number
    assert told.strip().endswith("go on with: python " + " ".join([process.args[1], *arguments])), told
    assert [line.split()[3] for line in printed.splitlines()[1:]] == ["stopped"] * 3
    assert len(steps(place / "runs")) == 2 and logs(place).count("1 signals, stopped at step") == 2, logs(place)


def test_killing_the_sweep_leaves_no_process_and_loses_nothing(place, capsys):
    """The script needs a second to write its checkpoint: a sweep started at once has to wait for it."""
    arguments = command(place, "--pause=0.3", "--total-timesteps=10", "--checkpoint-frequency=100", "--writing=1")
    process = start(place / "benchmark" / "sweep.py", arguments)
    wait_for(lambda: list((place / "runs").glob("*/model.pt")), process)
    pid = int(logs(place).split("pid ")[1].split()[0])
    process.kill()
    process.wait()
    assert not steps(place / "runs")
    assert sweep.main(arguments) == 0
    assert not Path(f"/proc/{pid}").exists()
    assert "1 signals, stopped at step" in logs(place), logs(place)
    assert "--resume" in logs(place) and len(run_folders(place)) == 1
    assert steps(place / "runs") == [10]


def assert_equals_undisturbed(folder, tmp_path, seed, options):
    undisturbed = train(defaults("wtd-s", seed=seed, runs_dir=str(tmp_path / "whole"), **options))
    expected, got = scalars(undisturbed), scalars(folder)
    assert len(expected["eval/return"]) == options["total_timesteps"] // options["eval_frequency"]
    assert expected.keys() == got.keys()
    for tag in expected:  # a killed run logs again, with equal values, what it had logged after its checkpoint
        assert dict(got[tag]) == dict(expected[tag]), tag


def test_a_stopped_and_continued_run_equals_an_undisturbed_one(tmp_path):
    options = {**TINY, "total_timesteps": 3_200, "checkpoint_frequency": 800}
    given = f"--algos avf_vdn --envs wtd-s --seeds 3 --workers 1 --runs-dir {tmp_path / 'runs'} --".split()
    process = start(sweep.__file__, given + flags(options))
    wait_for(lambda: steps(tmp_path / "runs"), process)
    process.send_signal(signal.SIGINT)
    _, told = process.communicate(timeout=180)
    assert process.returncode == 130 and steps(tmp_path / "runs")[0] < 3_200, told
    assert sweep.main(given + flags(options)) == 0
    (folder,) = (tmp_path / "runs").glob("*/checkpoint.pt")
    assert_equals_undisturbed(folder.parent, tmp_path, 3, options)


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


def test_stopping_a_sweep_on_ray_loses_nothing(place, cluster):
    options = ["--pause=2", "--total-timesteps=40", "--checkpoint-frequency=40", "--writing=1"]  # 80 s, if not stopped
    arguments = command(place, *options, seeds="1-3", own=["--engine", "ray", "--address", cluster.address])
    arguments.remove("--workers"), arguments.remove("2")
    process = start(place / "benchmark" / "sweep.py", arguments)
    wait_for(lambda: len(list((place / "runs").glob("*/model.pt"))) == 2, process)
    os.killpg(process.pid, signal.SIGINT)
    printed, told = process.communicate(timeout=180)
    assert process.returncode == 130 and "go on with" in told, told
    assert [line.split()[3] for line in printed.splitlines() if line.startswith("counter")] == ["stopped"] * 3, printed
    assert len(steps(place / "runs")) == 2 and logs(place).count("1 signals, stopped at step") == 2, logs(place)


def test_a_run_on_a_lost_ray_node_goes_on_on_another(tmp_path, cluster):
    """A run on each of two nodes; that of the killed node equals an undisturbed one."""
    options = {**TINY, "total_timesteps": 8_000, "eval_frequency": 800, "checkpoint_frequency": 800}
    given = f"--algos avf_vdn --envs wtd-s --seeds 1-2 --runs-dir {tmp_path / 'runs'} --engine ray".split()
    process = start(sweep.__file__, [*given, "--address", cluster.address, "--", *flags(options)])
    wait_for(lambda: len(steps(tmp_path / "runs")) == 2, process)
    cluster.remove_node(cluster.worker_nodes.copy().pop(), allow_graceful=False)
    assert max(steps(tmp_path / "runs")) < 8_000, "both were running"
    printed, told = process.communicate(timeout=180)
    assert process.returncode == 0, told
    assert printed.count("finished") == 2 and steps(tmp_path / "runs") == [8_000] * 2
    (log,) = [path for path in (tmp_path / "runs" / "logs").iterdir() if "--resume" in path.read_text()]
    seed = int(log.name.split("__")[2])
    (folder,) = (tmp_path / "runs").glob(f"wtd-s__avf_vdn__{seed}__*")
    assert_equals_undisturbed(folder, tmp_path, seed, options)
