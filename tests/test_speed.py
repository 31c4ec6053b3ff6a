"""The speed table: every measure is taken, a slowdown is found, and two checkouts are compared fairly."""

import json

import pandas as pd
import pytest

import avf_qplex
import mac_iaicc
from benchmark import speed

TINY = ["--scripts", "avf_qplex", "--envs", "bp-10", "--steps", "1500", "--rounds", "1"]
NAMES = [f"env bp-10 x {n}" for n in speed.BATCHES]
NAMES += ["act avf_qplex bp-10 x 32", "update avf_qplex bp-10", "train avf_qplex bp-10"]

# Writes down its flags, and burns processor time: to start, for each step, and for each update
STAND_IN = """
import json, sys, time
from pathlib import Path

ALGORITHM = "stand-in"
start, each_step, each_update = {costs}
flags = {{k: int(v) if v.isdigit() else v for k, _, v in (flag[2:].partition("=") for flag in sys.argv[1:])}}
with open(Path(__file__).with_suffix(".log"), "a") as log:
    log.write(json.dumps(flags) + "\\n")
n = flags["total-timesteps"]
updates = (n - flags["learning-starts"]) // flags["train-frequency"] if "learning-starts" in flags else 0
while time.process_time() < start + each_step * n + each_update * updates:
    pass
"""


def flags_of_runs(checkout, script):
    """The flags of each run of a stand-in, all of which the script itself takes."""
    runs = [json.loads(line) for line in (checkout / f"{script.ALGORITHM}.log").read_text().splitlines()]
    for flags in runs:
        script.parse_args([f"--{name}={value}" for name, value in flags.items()])
    return runs


def stand_in(place, *costs, name="avf_qplex"):
    place.mkdir(exist_ok=True)
    (place / f"{name}.py").write_text(STAND_IN.format(costs=costs))
    return place


def test_every_measure_is_taken(tmp_path, capsys, monkeypatch):
    """Acting is the script's, training a stand-in's: the tests below have the real script's word on its flags."""
    monkeypatch.setattr(speed, "SHORT", 1)
    monkeypatch.setattr(speed.record, "ROOT", stand_in(tmp_path / "a", 0.0, 0.0001, 0.002))
    speed.main([*TINY, "-o", str(tmp_path / "file.csv")])
    saved = pd.read_csv(tmp_path / "file.csv", index_col="measure")
    assert list(saved.index) == NAMES and set(saved["steps"]) == {1500}
    each = saved["seconds"]
    assert (each > 0).all() and (each < 1).all() and (saved["relative"] > each).all()
    assert each["env bp-10 x 1"] > 3 * each["env bp-10 x 32"] > 3 * each["env bp-10 x 256"]
    printed = capsys.readouterr().out
    assert all(printed.count(name) == 1 for name in NAMES)


def test_an_update_and_a_step_are_differences_of_runs(tmp_path):
    """100 ms to start, 0.2 ms a step and 5 ms an update, 15 of them in 1,000 steps: 75 ms of 375 ms."""
    checkout = stand_in(tmp_path / "a", 0.1, 0.0002, 0.005)
    measures, reference = speed.training([checkout], "avf_qplex", "bp-10", 1000, 3)
    assert measures["update"].shape == measures["train"].shape == (3, 1) and reference.shape == (3,)
    assert measures["update"].min() == pytest.approx(0.005, rel=0.5)
    assert measures["train"].min() == pytest.approx(0.000275, rel=0.5)
    begin, idle, learning = flags_of_runs(checkout, avf_qplex)[:3]
    assert begin["total-timesteps"] == 1 and idle["total-timesteps"] == learning["total-timesteps"] == 1000
    assert idle["learning-starts"] == 1000 and learning["learning-starts"] == 0
    assert learning["train-frequency"] == avf_qplex.Args.train_frequency
    assert learning["env"] == "bp-10" and learning["eval-episodes"] == 1 and learning["eval-frequency"] > 10**6


def test_an_actor_critic_is_idle_where_its_batch_is_never_full(tmp_path):
    checkout = stand_in(tmp_path / "a", 0.0, 0.0, 0.0, name="mac_iaicc")
    speed.training([checkout], "mac_iaicc", "bp-10", 1000, 1)
    _, idle, learning = flags_of_runs(checkout, mac_iaicc)
    assert idle["batch-size"] == 1000 and "batch-size" not in learning and "train-frequency" not in learning


def test_two_checkouts_take_turns(tmp_path, monkeypatch, capsys):
    """Here an update takes 20 ms, there 10 ms."""
    here, there = stand_in(tmp_path / "here", 0.0, 0.0, 0.02), stand_in(tmp_path / "there", 0.0, 0.0, 0.01)
    turns, real = [], speed.train
    monkeypatch.setattr(speed.record, "ROOT", here)
    monkeypatch.setattr(speed, "train", lambda *arguments: turns.append(arguments[0]) or real(*arguments))
    speed.main([*TINY, "--rounds", "3", "--against", str(there)])
    assert turns == [here, there] * 9
    update, train = (line.split() for line in capsys.readouterr().out.splitlines()[1:])
    assert update[:3] == ["update", "avf_qplex", "bp-10"] and train[0] == "train"
    assert 1.4 < float(update[5]) < 2.8 and 1.4 < float(update[6]) < 2.8


def test_a_script_that_fails_is_named(tmp_path, monkeypatch):
    monkeypatch.setattr(speed.record, "ROOT", tmp_path)
    (tmp_path / "avf_qplex.py").write_text("\nALGORITHM = 1\nraise SystemExit('avf_qplex: this is why')")
    with pytest.raises(SystemExit, match=r"^speed: .*/avf_qplex\.py: avf_qplex: this is why$"):
        speed.main([*TINY, "--against", str(tmp_path)])


def measured(monkeypatch, factor):
    """Makes every measure return the same, `factor` times as slow, so that nothing depends on noise."""
    each = [(name, factor * (1 + k) * 1e-3, factor * (1 + k) / 30) for k, name in enumerate(NAMES)]
    monkeypatch.setattr(speed, "measure", lambda *_: iter(each))


def test_a_slowdown_is_found(monkeypatch, tmp_path, capsys):
    path = str(tmp_path / "file.csv")
    measured(monkeypatch, 1.0)
    speed.main([*TINY, "-o", path])
    for factor, printed in ((1.0, " 1.00\n"), (1.25, " 1.25\n"), (0.5, " 0.50\n")):
        measured(monkeypatch, factor)
        capsys.readouterr()
        speed.main([*TINY, "--compare", path])
        assert capsys.readouterr().out.count(printed) == len(NAMES)
    measured(monkeypatch, 1.25)
    with pytest.raises(SystemExit, match=r"^more than 1\.2 times as long: env bp-10 x 1, .*, train avf_qplex bp-10$"):
        speed.main([*TINY, "--compare", path, "--tolerance", "1.2"])


def test_a_slow_processor_is_no_slowdown(monkeypatch):
    """Twice the time for the measure and for the reference workload beside it is a ratio of 1."""
    seconds = iter([0.1, 0.8, 0.05, 0.6, 0.2, 1.6] + [1.0] * 100)
    monkeypatch.setattr(speed, "cpu_seconds", lambda *_: next(seconds))
    monkeypatch.setattr(speed, "SHORT", 3)
    name, each, relative = next(speed.measure([], ["bp-10"], 1, 1))
    assert name == NAMES[0] and each == pytest.approx(0.6 / speed.CALLS) and relative == pytest.approx(each / 0.05)


def test_bad_input_is_one_line(tmp_path):
    (tmp_path / "wrong.csv").write_text("a,b\n1,2\n")
    (tmp_path / "other.csv").write_text("measure,seconds,relative,steps\nenv,1,1,7\n")
    for flags, message in (
        (["--rounds", "0"], "--steps and --rounds"),
        (["--scripts", "dqn"], "argument --scripts: invalid choice: 'dqn'"),
        (["--compare", str(tmp_path / "none.csv")], "is not such a file"),
        (["--compare", str(tmp_path / "wrong.csv")], "is not such a file"),
        (["--compare", str(tmp_path / "other.csv")], "was measured with other --steps"),
        (["--against", str(tmp_path / "nowhere")], "is no folder"),
    ):
        with pytest.raises(SystemExit) as error:
            speed.main([*TINY, *flags])
        assert str(error.value).startswith("speed: ") and message in str(error.value)
        assert "\n" not in str(error.value)
