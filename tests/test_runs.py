"""Run folders, checkpoints and the command line of the scripts, in processes of their own where one is killed."""

import importlib
import json
import os
import re
import runpy
import signal
import subprocess
import sys
import time
import types
from pathlib import Path

import numpy as np
import pytest
import torch

import avf_qplex
import envs
from avf_qplex import Args, load, parse_args, save, train
from tests.curves import scalars
from tests.rollouts import TINY, Spy, args_for
from tests.sync import SCRIPTS

ROOT = Path(__file__).parents[1]


def flags(options):
    return [f"--{key.replace('_', '-')}={value}" for key, value in options.items()]


def start(script, *arguments):
    """The script in a process of its own."""
    command = [sys.executable, str(ROOT / f"{script}.py"), *map(str, arguments)]
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    pipes = dict(stdout=subprocess.PIPE, stderr=subprocess.PIPE)
    return subprocess.Popen(command, cwd=ROOT, env=environment, text=True, **pipes)


def run_as_program(monkeypatch, *arguments, script="avf_qplex"):
    """The script as a program, in this process: the exit code and what it says last, as the interpreter would."""
    monkeypatch.setattr(sys, "argv", [f"{script}.py", *map(str, arguments)])
    handlers = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        runpy.run_path(str(ROOT / f"{script}.py"), run_name="__main__")
        return 0, ""
    except SystemExit as stopped:
        code = stopped.code
        return (code, "") if isinstance(code, int) else (1, str(code))
    finally:
        for number, handler in handlers.items():
            signal.signal(number, handler)


def one_line(text):
    return bool(text) and "\n" not in text.strip() and "Traceback" not in text


def stop_in(monkeypatch, module, steps):
    """A list of signals, in which one arrives in that step of training."""
    stop, act, taken = [], module.act, []

    def counted(*args):
        taken.extend([1] * (len(args) > 4))  # evaluation gives neither epsilon nor generator
        stop.extend([signal.SIGINT] * (len(taken) == steps))
        return act(*args)

    monkeypatch.setattr(module, "act", counted)
    return stop


class ArrivesAt:
    """In the place of the list of signals: one arrives just before the n-th time that somebody looks."""

    def __init__(self, look):
        self.looks_left = look

    def __bool__(self):
        self.looks_left -= 1
        return self.looks_left <= 0


def reached(folder):
    """The step of a run's checkpoint."""
    return torch.load(folder / "checkpoint.pt", weights_only=True)["counts"][0]


def same_run(one, other):
    """Every logged number and every weight of two run folders."""
    expected, got = scalars(one), scalars(other)
    assert expected.keys() == got.keys()
    for tag in expected:
        assert dict(got[tag]) == dict(expected[tag]), tag
    for name in ("last.pt", "best.pt"):
        models = [torch.load(folder / name, weights_only=True) for folder in (one, other)]
        assert models[0]["step"] == models[1]["step"], name
        for key, value in models[0]["networks"].items():
            assert torch.equal(value, models[1]["networks"][key]), f"{name} {key}"


@pytest.mark.parametrize(
    "script, env_id, number",
    [
        ("avf_qplex", "wtd-s", signal.SIGKILL),
        ("avf_qmix", "bp-10", signal.SIGTERM),
        ("avf_vdn", "ct-10", signal.SIGINT),
    ],
)
def test_killed_and_resumed_equals_undisturbed(tmp_path, script, env_id, number):
    """A kill takes the process down wherever it is, an interrupt between two steps."""
    module = importlib.import_module(script)
    steps = {"wtd-s": 1_600, "bp-10": 4_000, "ct-10": 1_600}[env_id]
    options = {**TINY, "total_timesteps": steps, "buffer_size": 8, "exploration_timesteps": 400}
    undisturbed = module.train(args_for(module, env_id, seed=5, runs_dir=str(tmp_path / "whole"), **options))
    # Checkpoints at every step where the process is killed, so that it happens in the middle of one as well.
    frequency = 0.0 if number == signal.SIGKILL else 60.0
    process = start(script, f"--env={env_id}", "--seed=5", f"--runs-dir={tmp_path / 'cut'}",
                    f"--checkpoint-frequency={frequency}", *flags(options))  # fmt: skip
    for _ in range(2_400):  # after the first evaluation
        if any((tmp_path / "cut").glob("*/last.pt")) and (frequency or any((tmp_path / "cut").glob("*/checkpoint.pt"))):
            break
        assert process.poll() is None, process.communicate()[1]
        time.sleep(0.025)
    process.send_signal(number)
    printed, errors = process.communicate(timeout=60)
    (folder,) = (tmp_path / "cut").iterdir()
    assert process.returncode == (-number if number == signal.SIGKILL else 128 + number)
    if number != signal.SIGKILL:
        assert printed == f"{folder}\n" and f"go on with: python {script}.py --resume {folder}" in errors
    cut_at = reached(folder)
    assert 0 < cut_at < steps, "the run was cut before its end"
    time.sleep(1.1)  # TensorBoard orders event files by the second in which they were made
    assert module.train(module.parse_args([f"--resume={folder}"])) == folder
    same_run(undisturbed, folder)
    assert not (folder / "checkpoint.pt").exists()


@pytest.mark.parametrize("script", SCRIPTS)
def test_stopped_and_resumed_equals_undisturbed(tmp_path, monkeypatch, script):
    """In this process, for each script; learning goes on where it was, with what was in the replay memory."""
    module = importlib.import_module(script)
    options = {key: value for key, value in TINY.items() if hasattr(module.Args, key)}
    options |= dict(learning_rate_end=0.0, total_timesteps=1_200, train_frequency=20)
    options |= dict(exploration_timesteps=400)  # random macro-actions would not tell what the networks remember
    if script == "mac_iaicc":
        options = {key: value for key, value in options.items() if key != "train_frequency"} | dict(batch_size=4)
    undisturbed = module.train(args_for(module, "bp-10", seed=0, runs_dir=str(tmp_path / "whole"), **options))
    args = args_for(module, "bp-10", seed=0, runs_dir=str(tmp_path / "cut"), **options)
    folder = module.train(args, stop_in(monkeypatch, module, 130))
    assert reached(folder) == 520
    monkeypatch.undo()
    time.sleep(1.1)  # TensorBoard orders event files by the second in which they were made
    remembered, acted = module.load(folder / "checkpoint.pt")["hidden"], Spy(monkeypatch, module, "act")
    assert module.train(module.parse_args([f"--resume={folder}"])) == folder
    assert remembered.any() and torch.equal(acted.calls[0].hidden, remembered)
    same_run(undisturbed, folder)


def test_a_run_that_is_stopped_before_its_first_step_can_go_on(tmp_path):
    """Or it would look like one that is finished, with no model in it."""
    folder = train(args_for(avf_qplex, "bp-10", runs_dir=str(tmp_path), **TINY), [signal.SIGINT])
    assert reached(folder) <= TINY["num_envs"] and not (folder / "last.pt").exists()
    assert train(parse_args([f"--resume={folder}"])) == folder and (folder / "last.pt").exists()


@pytest.mark.parametrize("look", [1, 3, 5])
def test_a_stop_is_never_without_a_checkpoint_of_its_step(tmp_path, monkeypatch, look):
    """Wherever the signal arrives: here just before each of the first times that the loop looks for it."""
    acted = Spy(monkeypatch, avf_qplex, "act")
    args = args_for(avf_qplex, "bp-10", runs_dir=str(tmp_path), **TINY)
    folder = train(args, ArrivesAt(look))
    assert reached(folder) == 4 * len(acted.calls)


def test_a_finished_run(tmp_path, monkeypatch, capsys):
    """What is in its folder, what it printed, and that it cannot be resumed."""
    code, _ = run_as_program(monkeypatch, "--env=bp-10", "--seed=3", f"--runs-dir={tmp_path}",
                             "--checkpoint-frequency=0.05", *flags(TINY))  # fmt: skip
    printed = capsys.readouterr()
    (folder,) = tmp_path.iterdir()
    assert code == 0 and printed.out == f"{folder}\n" and folder.name.startswith("bp-10__avf_qplex__3__")
    assert "it/s" not in printed.err, "no progress bar where there is no terminal"
    assert re.findall(r"step (\d+): greedy return", printed.err) == ["400", "800", "1200"]
    names = {path.name.split(".tfevents")[0] for path in folder.iterdir()}
    assert names == {"args.json", "best.pt", "last.pt", "events.out"}
    saved = json.loads((folder / "args.json").read_text())
    assert saved.pop("algorithm") == "avf_qplex"
    args = args_for(avf_qplex, "bp-10", seed=3, runs_dir=str(tmp_path), checkpoint_frequency=0.05, **TINY)
    assert Args(**saved) == args
    last, best, curve = load(folder / "last.pt"), load(folder / "best.pt"), scalars(folder)
    assert last["step"] == 1_200 and last["return"] == pytest.approx(curve["eval/return"][-1][1])
    assert best["return"] == pytest.approx(max(value for _, value in curve["eval/return"]), rel=1e-6)
    assert Args(**last["args"]) == Args(**best["args"]) == args
    assert {"charts/episodic_return", "charts/epsilon"} - curve.keys() <= {"charts/episodic_return", "charts/epsilon"}
    assert {f"eval/{key}" for key in ("return", "discounted_return", "length", "success")} <= curve.keys()
    code, message = run_as_program(monkeypatch, f"--resume={folder}")
    assert code == 1 and one_line(message) and message.startswith(f"cannot read {folder}/checkpoint.pt: ")


@pytest.mark.parametrize("script", SCRIPTS)
def test_discount_for_each_step_or_once_a_row(tmp_path, monkeypatch, script):
    """What is learned from: gamma^tau and rewards discounted within a row, or gamma and their sum."""
    module = importlib.import_module(script)
    over_rows, rows = module.over_rows, {}

    def spy(batch, *networks):
        if "reward" in batch:  # not the critics' joint batch of mac_iaicc
            rows[discount] += torch.stack([batch["discount"], batch["reward"]], 2)[batch["valid"]].tolist()
        return over_rows(batch, *networks)

    monkeypatch.setattr(module, "over_rows", spy)
    options = {key: value for key, value in TINY.items() if hasattr(module.Args, key)} | dict(gamma=0.9, reward_scale=1)
    for discount in ("step", "decision"):
        rows[discount] = []
        module.train(args_for(module, "bp-10", runs_dir=str(tmp_path), discount=discount, **options))
    walks = [row for row in rows["step"] if row[0] < 0.9 and -1 < row[1] < 0]  # some steps at -0.1, nothing else
    assert walks and all(reward == pytest.approx(once - 1, abs=1e-5) for once, reward in walks)
    walks = [row for row in rows["decision"] if -1 < row[1] < 0]
    assert min(reward for _, reward in walks) < -0.25 and all(once == pytest.approx(0.9) for once, _ in walks)
    assert all(reward * 10 == pytest.approx(round(reward * 10), abs=1e-4) for _, reward in walks)


def test_what_is_logged(tmp_path):
    """Of training every 2,000 steps, of the loss every 100 updates, and evaluations at the end in any case."""
    options = {**TINY, "total_timesteps": 4_100, "train_frequency": 20, "learning_starts": 2_000}
    curve = scalars(train(args_for(avf_qplex, "bp-10", runs_dir=str(tmp_path), **{**options, "eval_frequency": 2_050})))
    assert [step for step, _ in curve["charts/episodic_return"]] == [2_000, 4_000]
    assert [step for step, _ in curve["eval/return"]] == [2_052, 4_100]
    for key in ("td_loss", "q_values", "grad_norm"):
        assert [step for step, _ in curve[f"losses/{key}"]] == [4_000], key


def test_best_is_the_best_and_the_latest_of_equals(tmp_path, monkeypatch):
    returns = iter([1.0, 3.0, 2.0, 3.0, 0.5, 1.0])
    result = {"discounted_return": np.zeros(2), "length": np.ones(2), "success": np.zeros(2)}
    monkeypatch.setattr(avf_qplex, "evaluate", lambda *args: result | {"return": np.full(2, next(returns))})
    folder = train(args_for(avf_qplex, "bp-10", runs_dir=str(tmp_path), **{**TINY, "eval_frequency": 200}))
    best, last = load(folder / "best.pt"), load(folder / "last.pt")
    assert (best["step"], best["return"]) == (800, 3.0) and (last["step"], last["return"]) == (1_200, 1.0)
    assert any(not torch.equal(value, last["networks"][key]) for key, value in best["networks"].items())


def test_the_best_model_outlives_a_resume(tmp_path, monkeypatch):
    returns = iter([3.0, 2.0, 1.0])
    result = {"discounted_return": np.zeros(2), "length": np.ones(2), "success": np.zeros(2)}
    monkeypatch.setattr(avf_qplex, "evaluate", lambda *args: result | {"return": np.full(2, next(returns))})
    args = args_for(avf_qplex, "bp-10", runs_dir=str(tmp_path), **TINY)
    folder = train(args, stop_in(monkeypatch, avf_qplex, 120))
    train(parse_args([f"--resume={folder}"]))
    assert load(folder / "best.pt")["step"] == 400 and load(folder / "last.pt")["step"] == 1_200


def test_a_kill_costs_at_most_a_minute(tmp_path, monkeypatch):
    """By default a checkpoint is written every minute: with a clock that moves on by 7 s at each step."""
    assert Args.checkpoint_frequency <= 60 and all(
        importlib.import_module(script).Args.checkpoint_frequency <= 60 for script in SCRIPTS
    )
    clock, saved_at = [1e9], []
    monkeypatch.setattr(avf_qplex, "time", types.SimpleNamespace(time=lambda: clock[0], time_ns=time.time_ns))
    saves, acted = Spy(monkeypatch, avf_qplex, "save"), avf_qplex.act

    def act(*args):
        clock[0] += 7 * (len(args) > 4)  # a step of training, not of evaluation
        saved_at.extend([clock[0]] * (len([c for c in saves.calls if c.path.name == "checkpoint.pt"]) - len(saved_at)))
        return acted(*args)

    monkeypatch.setattr(avf_qplex, "act", act)
    train(args_for(avf_qplex, "bp-10", runs_dir=str(tmp_path), **{**TINY, "total_timesteps": 400}))
    times = np.array([1e9, *saved_at])
    assert len(saved_at) >= 700 // 70 and np.diff(times).max() <= 60 + 2 * 7
    assert 1e9 + 700 - times[-1] <= 60 + 2 * 7


def test_runs_never_share_a_folder(tmp_path, monkeypatch):
    """Two of the same microsecond: the second is refused in one line, and the first is left as it is."""
    monkeypatch.setattr(avf_qplex, "time", types.SimpleNamespace(time=time.time, time_ns=lambda: 123_456))
    args = args_for(avf_qplex, "bp-10", runs_dir=str(tmp_path), **{**TINY, "total_timesteps": 40})
    folder = train(args)
    before = {path.name: path.read_bytes() for path in folder.iterdir()}
    with pytest.raises(FileExistsError):  # which the program turns into one line
        train(args)
    assert {path.name: path.read_bytes() for path in folder.iterdir()} == before
    monkeypatch.undo()
    assert len({train(args) for _ in range(3)} | {folder}) == 4


def test_a_task_in_a_module_of_its_own(tmp_path):
    """Found through --env module:id, trained and played, each in a process of its own."""
    module = (
        "import envs\nfrom tests.matrix_game import MatrixGame\n\nenvs.register('my-task', MatrixGame, tell=True)\n"
    )
    (tmp_path / "my_module.py").write_text(module)
    path = os.pathsep.join([str(ROOT), str(tmp_path)])
    tiny = dict(total_timesteps=400, learning_starts=100, num_envs=4, eval_episodes=2, hidden_size=8, runs_dir=tmp_path)
    command = [sys.executable, ROOT / "avf_qmix.py", "--env=my_module:my-task", *flags(tiny)]
    done = subprocess.run(command, env=os.environ | {"PYTHONPATH": path}, capture_output=True, text=True, check=True)
    folder = done.stdout.strip()
    assert Path(folder).name.startswith("my_module:my-task__avf_qmix__1__")
    command = [sys.executable, ROOT / "play.py", folder, "--episodes=2"]
    done = subprocess.run(command, env=os.environ | {"PYTHONPATH": path}, capture_output=True, text=True, check=True)
    assert done.stdout.startswith("my_module:my-task avf_qmix best model of step 400: 2 greedy episodes")


@pytest.mark.parametrize(
    "arguments, message",
    [
        (["--env=wtd-x"], "--env: unknown environment 'wtd-x' (did you mean 'wtd-t'?); valid ids: bp-10 bp-20"),
        (["--env=no_such_module:my-task"], "--env: No module named 'no_such_module'"),
        (["--env=envs:my-task"], "--env: unknown environment 'envs:my-task'"),
        (["--gamma=1.5"], "--gamma must be from 0 to 1, got 1.5"),
        (["--end-e=-0.1"], "--end-e must be from 0 to 1, got -0.1"),
        (["--polyak=1.01"], "--polyak must be from 0 to 1, got 1.01"),
        (["--td-lambda=2"], "--td-lambda must be from 0 to 1, got 2.0"),
        (["--hysteresis=-1"], "--hysteresis must be from 0 to 1, got -1.0"),
        (["--learning-rate=-1"], "--learning-rate must be from 0 to 1, got -1.0"),
        (["--learning-rate=nan"], "--learning-rate must be from 0 to 1, got nan"),
        (["--learning-rate-end=-1"], "--learning-rate-end must be from 0 to 1, got -1.0"),
        (["--reward-scale=-1"], "--reward-scale must be from 0 to inf, got -1.0"),
        (["--max-grad-norm=nan"], "--max-grad-norm must be from 0 to inf, got nan"),
        (["--checkpoint-frequency=-1"], "--checkpoint-frequency must be from 0 to inf, got -1.0"),
        (["--batch-size=0"], "--batch-size must be from 1 to inf, got 0"),
        (["--num-envs=0"], "--num-envs must be from 1 to inf, got 0"),
        (["--window=0"], "--window must be from 1 to inf, got 0"),
        (["--seed=-1"], "--seed must be from 0 to inf, got -1"),
        (["--learning-starts=-1"], "--learning-starts must be from 0 to inf, got -1"),
        (["--resume=nowhere"], "cannot read nowhere/checkpoint.pt: "),
        (["--resume=nowhere", "--gamma=0.5"], "no other flag can be given with it"),
        (["--env=bp-10", "--resume=nowhere"], "no other flag can be given with it"),
        (["--resume=nowhere", "--track"], "no other flag can be given with it"),
        (["--resume=nowhere", "elsewhere"], "no other flag can be given with it"),
    ],
)
def test_bad_arguments_are_told_in_one_line(tmp_path, monkeypatch, arguments, message):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit) as stopped:
        parse_args(arguments)
    assert message in str(stopped.value) and one_line(str(stopped.value))
    assert not any(tmp_path.iterdir()), "nothing was written"


@pytest.mark.parametrize("script", SCRIPTS)
def test_every_script_checks_its_arguments(script):
    module = importlib.import_module(script)
    for field, value in module.Args.__dataclass_fields__.items():
        if value.type in (int, float, float | None):
            with pytest.raises(SystemExit, match=f"--{field.replace('_', '-')} must be from [01] to (1|inf), got -2"):
                module.Args(**{field: value.type(-2) if value.type in (int, float) else -2.0})
    assert module.parse_args(["--seed=0"]) == module.Args(seed=0)
    for start, changes in module.DEFAULTS.items():
        ids = [env_id for env_id in envs.IDS if env_id.startswith(start)]
        assert ids and all(module.parse_args([f"--env={i}"]) == module.Args(env=i, **changes) for i in ids), start


def test_unknown_flags_and_values_are_refused(capsys):
    for arguments in (["--gama=0.9"], ["--evaluate=x"], ["--device=abacus"], ["--batch-size=many"], ["bp-10"]):
        with pytest.raises(SystemExit) as stopped:
            parse_args(arguments)
        assert stopped.value.code == 2 and not capsys.readouterr().out
    if not torch.cuda.is_available():
        with pytest.raises(SystemExit, match="--device cuda: there is none"):
            parse_args(["--device=cuda"])


def test_help_shows_the_defaults_in_force(capsys):
    for env_id in ("bp-10", "wtd-s", "ct-10"):
        with pytest.raises(SystemExit) as stopped:
            parse_args(["--env", env_id, "--help"])
        text = " ".join(capsys.readouterr().out.replace("│", " ").split())
        assert stopped.value.code == 0 and "discount factor, in [0, 1]" in text
        for name in ("gamma", "buffer_size", "td_lambda", "train_frequency"):
            value = getattr(args_for(avf_qplex, env_id), name)
            assert f"--{name.replace('_', '-')}" in text and f"(default: {value})" in text, (env_id, name)


def test_a_folder_that_cannot_be_written(tmp_path):
    """In a process of its own: exit code 1, one line, no traceback."""
    (tmp_path / "file").write_text("kept")
    process = start("avf_qplex", f"--runs-dir={tmp_path / 'file'}")
    printed, errors = process.communicate(timeout=60)
    assert process.returncode == 1 and not printed and one_line(errors) and str(tmp_path / "file") in errors
    assert (tmp_path / "file").read_text() == "kept"


def test_other_runs_and_damaged_checkpoints_are_refused(tmp_path, monkeypatch):
    folder = train(args_for(avf_qplex, "bp-10", runs_dir=str(tmp_path), **TINY), stop_in(monkeypatch, avf_qplex, 3))
    path = folder / "checkpoint.pt"
    whole = path.read_bytes()
    args = load(path)["args"]
    torch.save({"algorithm": "avf_vdn", "args": args}, path)
    code, message = run_as_program(monkeypatch, f"--resume={folder}")
    assert code == 1 and message == f"{path} is of avf_vdn, not of avf_qplex"
    damaged = [whole[:1000], whole[:-100], b"\x80", b"text\n", whole[: len(whole) // 2] + bytes(2000), bytes(99)]
    torch.save({"step": 3}, path)  # of something else
    damaged.append(path.read_bytes())
    for content in damaged:
        path.write_bytes(content)
        code, message = run_as_program(monkeypatch, f"--resume={folder}")
        assert code == 1 and one_line(message) and message.startswith(f"cannot read {path}: "), content[:20]
        assert path.read_bytes() == content and not (folder / "last.pt").exists()
    path.unlink()
    code, message = run_as_program(monkeypatch, f"--resume={folder}")
    assert code == 1 and one_line(message) and message.startswith(f"cannot read {path}: ")
    path.write_bytes(whole)
    assert run_as_program(monkeypatch, f"--resume={folder}")[0] == 0


def test_an_empty_checkpoint_is_refused(tmp_path):
    """What a power cut may leave behind."""
    (tmp_path / "checkpoint.pt").touch()
    with pytest.raises(SystemExit, match="cannot read"):
        parse_args([f"--resume={tmp_path}"])


class Malicious:
    def __init__(self, victim):
        self.victim = victim

    def __reduce__(self):
        return Path.touch, (self.victim,)


def test_loading_runs_no_code(tmp_path):
    folder, victim = tmp_path / "run", tmp_path / "victim"
    folder.mkdir()
    content = {"algorithm": "avf_qplex", "args": {}, "parts": Malicious(victim)}
    torch.save(content, folder / "checkpoint.pt")
    with pytest.raises(SystemExit) as stopped:
        parse_args([f"--resume={folder}"])
    assert one_line(str(stopped.value)) and "cannot read" in str(stopped.value) and not victim.exists()
    torch.load(folder / "checkpoint.pt", weights_only=False)
    assert victim.exists(), "the file is as malicious as it looks"


def test_files_are_whole_or_not_there(tmp_path, monkeypatch):
    """A failure while writing leaves the old model or checkpoint whole, and no half of an args.json."""
    path, args = tmp_path / "checkpoint.pt", Args()
    save(path, args, step=1)

    def broken(content, file):
        Path(file).write_bytes(b"half")
        raise OSError("disk full")

    monkeypatch.setattr(torch, "save", broken)
    with pytest.raises(OSError, match="disk full"):
        save(path, args, step=2)
    monkeypatch.undo()
    assert load(path)["step"] == 1 and Args(**load(path)["args"]) == args
    save(path, args, step=3)
    assert load(path)["step"] == 3 and [p.name for p in tmp_path.iterdir()] == ["checkpoint.pt"]

    write = Path.write_text

    def full(self, text):
        write(self, text[: len(text) // 2])
        raise OSError("disk full")

    monkeypatch.setattr(Path, "write_text", full)
    with pytest.raises(OSError, match="disk full"):
        train(args_for(avf_qplex, "bp-10", runs_dir=str(tmp_path / "runs"), **TINY))
    assert not any(tmp_path.glob("runs/*/args.json"))


def test_track_copies_the_curves(tmp_path, monkeypatch):
    """With a stand-in for wandb, which is optional: what it is told, and the one line where it is missing."""
    calls, module = [], types.ModuleType("wandb")
    module.init = lambda **options: calls.append(options)
    monkeypatch.setitem(sys.modules, "wandb", module)
    args = args_for(avf_qplex, "bp-10", runs_dir=str(tmp_path), track=True, **TINY)
    folder = train(args, stop_in(monkeypatch, avf_qplex, 10))
    train(parse_args([f"--resume={folder}"]))
    told, again = calls
    assert told["sync_tensorboard"] and told["config"]["track"] and told["config"]["env"] == "bp-10"
    assert told["id"] == told["name"] == again["id"] == folder.name and told["resume"] == again["resume"] == "allow"
    monkeypatch.setitem(sys.modules, "wandb", None)  # as if it were not installed
    code, message = run_as_program(monkeypatch, "--track", f"--runs-dir={tmp_path}")
    assert code == 1 and one_line(message) and "wandb" in message and len(list(tmp_path.iterdir())) == 1
