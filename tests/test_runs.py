"""Run folders, checkpoints and the command line of the scripts, in processes of their own where one is killed."""

import importlib.util
import json
import os
import re
import signal
import subprocess
import sys
import time
import types
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

import avf_qplex
from avf_qplex import Args, defaults, load_args, make_run_folder, parse_args, report, train
from tests.curves import scalars

ROOT = Path(__file__).parents[1]
TINY = dict(num_envs=4, total_timesteps=2_400, learning_starts=200, train_frequency=20, batch_size=8, window=6,
            hidden_size=16, eval_frequency=400, eval_episodes=3, checkpoint_frequency=400)  # fmt: skip


def flags(options):
    return [f"--{key.replace('_', '-')}={value}" for key, value in options.items()]


def start(*arguments, cwd=ROOT):
    command = [sys.executable, str(ROOT / "avf_qplex.py"), *map(str, arguments)]
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    return subprocess.Popen(
        command, cwd=cwd, env=environment, text=True, stdout=subprocess.PIPE, stderr=subprocess.PIPE
    )


def wait_for_checkpoint(runs, process, step):
    """Returns the run folder once its checkpoint has reached a step."""
    for _ in range(1_200):
        for path in runs.glob("*/checkpoint.pt"):
            if torch.load(path, weights_only=True)["step"] >= step:
                return path.parent
        assert process.poll() is None, process.communicate()[1]
        time.sleep(0.05)
    raise AssertionError("no checkpoint within a minute")


@pytest.mark.parametrize("env_id, how", [("wtd-s", "kill"), ("ct-10", "kill"), ("bp-10", "interrupt")])
def test_killed_and_resumed_equals_undisturbed(tmp_path, env_id, how):
    """Every logged number, the replay memory and every weight; `kill` takes the process down wherever it is."""
    options = {**TINY, "total_timesteps": 1_200 if env_id == "ct-10" else 4_000, "hidden_state": "stored"}
    undisturbed = train(defaults(env_id, seed=5, runs_dir=str(tmp_path / "whole"), **options))
    process = start(f"--env={env_id}", "--seed=5", f"--runs-dir={tmp_path / 'cut'}", *flags(options))
    folder = wait_for_checkpoint(tmp_path / "cut", process, 400)
    process.send_signal(signal.SIGKILL if how == "kill" else signal.SIGINT)
    _, errors = process.communicate(timeout=60)
    if how == "interrupt":
        assert process.returncode == 0 and "stopped at step" in errors and f"--resume {folder}" in errors, errors
    cut_at = torch.load(folder / "checkpoint.pt", weights_only=True)["step"]
    assert cut_at < options["total_timesteps"], "the run was cut before its end"
    time.sleep(1.1)  # TensorBoard orders event files by the second in which they were made
    assert train(parse_args([f"--resume={folder}"])) == folder
    one, other = (torch.load(f / "checkpoint.pt", weights_only=True) for f in (undisturbed, folder))
    assert one["step"] == other["step"] and one["updates"] == other["updates"] and one["rng"] == other["rng"]
    for part in ("learner", "target", "buffer", "env"):
        for key, value in one[part].items():
            same = torch.equal(value, other[part][key]) if torch.is_tensor(value) else value == other[part][key]
            assert same, f"{part} {key}"
    # A killed run may have logged steps after its last checkpoint: the resumed one logs them again, with equal values.
    expected, got = scalars(undisturbed), scalars(folder)
    assert expected.keys() == got.keys()
    for tag in expected:
        assert dict(got[tag]) == dict(expected[tag]), tag


def test_resume_can_extend_a_finished_run(tmp_path):
    long = train(defaults("wtd-s", seed=0, runs_dir=str(tmp_path / "long"), **TINY))
    short = train(defaults("wtd-s", seed=0, runs_dir=str(tmp_path), **{**TINY, "total_timesteps": 1_200}))
    assert train(parse_args([f"--resume={short}", "--total-timesteps=2400"])) == short
    expected, got = scalars(long), scalars(short)
    assert dict(got["eval/return"]) == dict(expected["eval/return"])
    assert dict(got["losses/td_loss"]) == dict(expected["losses/td_loss"])


def test_run_folder_holds_what_it_should(tmp_path, capsys):
    folder = train(defaults("bp-10", seed=3, runs_dir=str(tmp_path), **TINY))
    assert folder.name.startswith("bp-10__avf_qplex__3__")
    assert json.loads((folder / "args.json").read_text())["algorithm"] == "avf_qplex"
    assert load_args(folder) == defaults("bp-10", seed=3, runs_dir=str(tmp_path), **TINY)
    models = torch.load(folder / "model.pt", weights_only=True)
    curve = scalars(folder)
    assert models["last"]["step"] == 2_400 and models["last"]["return"] == pytest.approx(curve["eval/return"][-1][1])
    assert models["best"]["return"] == pytest.approx(max(value for _, value in curve["eval/return"]), rel=1e-6)
    assert {"charts/episodic_return", "charts/epsilon", "eval/return", "eval/discounted_return"} <= curve.keys()
    assert {"eval/length", "losses/td_loss", "losses/q_values", "losses/grad_norm"} <= curve.keys()
    assert not capsys.readouterr().err.count("it/s"), "no progress bar where there is no terminal"


def test_runs_never_share_a_folder(tmp_path):
    folders = {make_run_folder(Args(runs_dir=str(tmp_path))) for _ in range(5)}
    assert len(folders) == 5 and all((folder / "args.json").exists() for folder in folders)


def test_evaluate_prints_and_animates(tmp_path, capsys):
    folder = train(defaults("bp-10", runs_dir=str(tmp_path), **TINY))
    gif = tmp_path / "policy.gif"
    report(parse_args([f"--evaluate={folder}", "--eval-episodes=5", f"--gif={gif}", "--model=last", "--seed=9"]))
    printed = capsys.readouterr().out
    expected = torch.load(folder / "model.pt", weights_only=True)["last"]["return"]
    line = next(line for line in printed.splitlines() if line.startswith("return"))
    assert float(line.split()[1]) == pytest.approx(expected, abs=1e-3), "Box Pushing is deterministic"
    assert "success" in printed and "discounted return" in printed and "last model of step 2400" in printed
    with Image.open(gif) as animation:
        assert animation.n_frames > 5 and np.asarray(animation.convert("RGB")).std() > 10
    assert sorted(p.name for p in tmp_path.iterdir()) == sorted([folder.name, gif.name]), (
        "evaluating makes no run folder"
    )


@pytest.mark.parametrize(
    "arguments, message",
    [
        (["--env=wtd-x"], "unknown --env 'wtd-x'; valid ids: bp-10 bp-20"),
        (["--gamma=1.5"], "--gamma must be between 0 and 1, got 1.5"),
        (["--start-e=-0.1"], "--start-e must be between 0 and 1"),
        (["--learning-rate=-1"], "--learning-rate must not be negative"),
        (["--learning-rate=nan"], "--learning-rate must not be negative"),
        (["--batch-size=0"], "--batch-size must be at least 1, got 0"),
        (["--seed=-1"], "--seed must not be negative, got -1"),
        (["--device=cuda:99"], "--device cuda:99 is not available"),
        (["--device=abacus"], "--device abacus is not available"),
        (["--resume=nowhere"], "nowhere is not a run folder"),
        (["--evaluate=nowhere"], "nowhere is not a run folder"),
        (["--evaluate=here", "--resume=there"], "--resume and --evaluate exclude each other"),
    ],
)
def test_bad_arguments_are_told_in_one_line(tmp_path, arguments, message):
    with pytest.raises(SystemExit) as stopped:
        args = parse_args([*arguments, f"--runs-dir={tmp_path}"])
        train(args)
    assert str(stopped.value).startswith("avf_qplex: ") and message in str(stopped.value)
    assert "\n" not in str(stopped.value)
    assert not any(tmp_path.iterdir()), "nothing was written"


def test_unwritable_runs_folder(tmp_path):
    (tmp_path / "file").write_text("kept")
    with pytest.raises(SystemExit, match="cannot write to --runs-dir"):
        train(Args(runs_dir=str(tmp_path / "file")))
    assert (tmp_path / "file").read_text() == "kept"


def test_folders_of_other_runs_are_refused(tmp_path):
    folder = train(defaults("wtd-s", runs_dir=str(tmp_path), **{**TINY, "total_timesteps": 400}))
    before = {path.name: path.read_bytes() for path in folder.iterdir()}
    for arguments, message in (
        (["--env=bp-10"], f"--env bp-10 does not fit: {folder} is a run with wtd-s"),
        (["--gamma=0.5"], "--gamma 0.5 does not fit"),
        (["--seed=8"], "--seed 8 does not fit"),
    ):
        with pytest.raises(SystemExit, match=re.escape(message)):
            parse_args([f"--resume={folder}", *arguments])
    (folder / "args.json").write_text((folder / "args.json").read_text().replace("avf_qplex", "avf_other", 1))
    with pytest.raises(SystemExit, match="is a run of avf_other, not of avf_qplex"):
        parse_args([f"--evaluate={folder}"])
    (folder / "args.json").write_bytes(before["args.json"])
    (folder / "checkpoint.pt").write_bytes(before["checkpoint.pt"][:1000])
    with pytest.raises(SystemExit, match=r"checkpoint\.pt is damaged"):
        train(parse_args([f"--resume={folder}", "--total-timesteps=800"]))
    (folder / "model.pt").unlink()
    with pytest.raises(SystemExit, match=r"there is no model\.pt"):
        report(parse_args([f"--evaluate={folder}"]))
    assert {path.name: path.read_bytes() for path in folder.iterdir() if path.name != "checkpoint.pt"} == {
        name: content for name, content in before.items() if name not in ("checkpoint.pt", "model.pt")
    }


def test_track_copies_the_curves(tmp_path, monkeypatch):
    """With a stand-in for wandb, which is optional: what it is told, and the one line where it is missing."""
    calls = []
    tracker = types.SimpleNamespace(finish=lambda: calls.append("finish"))
    module = types.ModuleType("wandb")
    module.init = lambda **options: calls.append(options) or tracker
    module.__spec__ = importlib.util.spec_from_loader("wandb", loader=None)
    monkeypatch.setitem(sys.modules, "wandb", module)
    options = {**TINY, "total_timesteps": 400, "runs_dir": str(tmp_path), "track": True, "wandb_project_name": "mine"}
    folder = train(defaults("wtd-s", **options))
    train(parse_args([f"--resume={folder}", "--total-timesteps=800"]))
    told, finished, again, _ = calls
    assert finished == "finish" and told["project"] == "mine" and told["sync_tensorboard"] and told["config"]["track"]
    assert told["id"] == again["id"] == folder.name and told["resume"] == "allow"
    monkeypatch.undo()
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    with pytest.raises(SystemExit, match=re.escape("--track needs Weights & Biases: pip install -e '.[track]'")):
        train(defaults("wtd-s", **options))
    assert len(list(tmp_path.iterdir())) == 1


def test_help_shows_the_defaults_in_force():
    for env_id in ("bp-10", "wtd-s", "ct-10"):
        process = start("--env", env_id, "--help")
        output, _ = process.communicate(timeout=60)
        text = " ".join(output.replace("│", " ").split())
        for name in ("gamma", "buffer_size", "td_lambda", "train_frequency"):
            value = getattr(defaults(env_id), name)
            assert f"--{name.replace('_', '-')}" in text and f"(default: {value})" in text, (env_id, name)
    for family, changes in avf_qplex.DEFAULTS.items():
        assert set(changes) <= set(Args.__dataclass_fields__), family


def test_checkpoints_replace_the_old_one_at_once(tmp_path, monkeypatch):
    """A failure while writing leaves the old checkpoint whole."""
    path = tmp_path / "checkpoint.pt"
    saved = {"run": ["avf_qplex", "wtd-s"], "step": 1}
    avf_qplex.save(saved, path)

    def broken(saved, file):
        Path(file).write_bytes(b"half")
        raise OSError("disk full")

    monkeypatch.setattr(torch, "save", broken)
    with pytest.raises(OSError, match="disk full"):
        avf_qplex.save({"step": 2}, path)
    assert avf_qplex.load_file(tmp_path, "checkpoint.pt", "wtd-s") == saved
    with pytest.raises(SystemExit, match="is of avf_qplex on wtd-s, not of avf_qplex on bp-10"):
        avf_qplex.load_file(tmp_path, "checkpoint.pt", "bp-10")
