"""The speed table: every measure is taken, and a slowdown against a baseline file is found."""

import json

import numpy as np
import pytest

import avf_vdn
import mac_iaicc
from benchmark import speed

TINY = ["--scripts", "avf_vdn", "--envs", "bp-10", "--steps", "1500", "--repeats", "1"]
NAMES = [f"env bp-10 x {n}" for n in speed.BATCHES]
NAMES += ["act avf_vdn bp-10 x 32", "train avf_vdn bp-10", "update avf_vdn bp-10"]


@pytest.fixture(scope="module", autouse=True)
def measured_once():
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(speed, "SHORT", 1)
        yield


@pytest.fixture(scope="module")
def baseline(tmp_path_factory):
    """A baseline file and what was printed beside it."""
    path = tmp_path_factory.mktemp("speed") / "baseline.json"
    speed.main([*TINY, "-o", str(path)])
    return path


def altered(path, folder, factor):
    """A copy of a baseline file in which everything took `factor` of the time."""
    saved = json.loads(path.read_text())
    for measure in saved["measures"].values():
        measure["relative"] *= factor
    copy = folder / "altered.json"
    copy.write_text(json.dumps(saved))
    return copy


def test_every_measure_is_taken(baseline):
    saved = json.loads(baseline.read_text())
    assert saved["steps"] == 1500 and list(saved["measures"]) == NAMES
    for name, x in saved["measures"].items():
        assert 0 < x["seconds"] < 1 and 0 < x["relative"] < np.inf, name
        assert (x["rows"] is not None) == name.startswith("update")
    # 64 windows of up to 25 rows, from episodes that are rarely shorter than two rows
    assert 64 * 2 < saved["measures"][NAMES[-1]]["rows"] <= 64 * 25


def test_a_bigger_batch_costs_less_for_each_environment(baseline):
    each = {name: x["seconds"] for name, x in json.loads(baseline.read_text())["measures"].items()}
    assert each["env bp-10 x 1"] > 3 * each["env bp-10 x 32"] > 3 * each["env bp-10 x 256"]


def measured(monkeypatch, factor):
    """Makes every measure return what the baseline has, `factor` times as slow, so that nothing depends on noise."""
    seconds = {name: factor * (1 + k) * 1e-3 for k, name in enumerate(NAMES)}
    measures = [{name: speed.entry(x, 0.03, 400.0 if "update" in name else None)} for name, x in seconds.items()]
    monkeypatch.setattr(speed, "measure", lambda *_: iter(measures))


def test_a_slowdown_is_found(monkeypatch, tmp_path, capsys):
    path = tmp_path / "baseline.json"
    measured(monkeypatch, 1.0)
    speed.main([*TINY, "-o", str(path)])
    speed.main([*TINY, "--compare", str(path)])
    assert capsys.readouterr().out.count("x1.00 slower") == len(NAMES)
    measured(monkeypatch, 1.25)
    speed.main([*TINY, "--compare", str(path)])
    assert capsys.readouterr().out.count("x1.25 slower") == len(NAMES)
    with pytest.raises(SystemExit, match=r"more than x1\.2 slower: env bp-10 x 1, "):
        speed.main([*TINY, "--compare", str(path), "--tolerance", "1.2"])
    measured(monkeypatch, 2.0)
    with pytest.raises(SystemExit, match=r"more than x1\.3 slower: env bp-10 x 1, .*, update avf_vdn bp-10$"):
        speed.main([*TINY, "--compare", str(path)])
    capsys.readouterr()
    measured(monkeypatch, 0.5)
    speed.main([*TINY, "--compare", str(path)])
    assert capsys.readouterr().out.count("x2.00 faster") == len(NAMES)


def test_a_measured_slowdown_is_found(baseline, tmp_path, capsys):
    """Against a file that claims a fifth of the time: far beyond the noise of such short runs."""
    only_env = ["--scripts", "--envs", "bp-10", "--steps", "1500"]
    with pytest.raises(SystemExit) as error:
        speed.main([*only_env, "--compare", str(altered(baseline, tmp_path, 0.2)), "--tolerance", "2"])
    assert error.value.code == "more than x2.0 slower: " + ", ".join(NAMES[:3])
    assert capsys.readouterr().out.count(" slower") == 3


def test_a_slow_processor_is_no_slowdown(monkeypatch):
    """Twice the time for the measure and for the reference workload beside it is a ratio of 1."""
    assert speed.entry(2.0, 0.06)["relative"] == pytest.approx(speed.entry(1.0, 0.03)["relative"])
    clock = iter(np.cumsum([0, 0.2, 0, 0.8, 0, 0.1, 0, 0.6]))
    monkeypatch.setattr(speed.time, "process_time", lambda: next(clock))
    np.testing.assert_allclose(speed.fastest(2, lambda: None), [0.1, 0.6])


def test_an_update_is_the_difference_of_two_runs(monkeypatch):
    """The runs get made-up durations: 1 s of overhead, 2 s of collecting, 3 s of updating."""
    runs, real = [], avf_vdn.train
    monkeypatch.setattr(avf_vdn, "train", lambda args: runs.append(args) or real(args))

    def fastest(repeats, *functions):
        for function in functions:
            function()
        return np.array([0.5, 1.0, 3.0, 6.0])

    monkeypatch.setattr(speed, "fastest", fastest)
    measures = speed.measure_training(avf_vdn, "bp-10", 1500, 1)
    _, begin, idle, learning = runs  # the first is thrown away
    assert begin.total_timesteps == 1 and idle.total_timesteps == learning.total_timesteps == 1500
    assert learning.train_frequency == avf_vdn.defaults("bp-10").train_frequency
    steps = 32 * 47  # whole steps of 32 environments, the first number from 1,500 on
    assert measures["train avf_vdn bp-10"]["seconds"] == pytest.approx(5 / steps)
    assert measures["update avf_vdn bp-10"]["seconds"] == pytest.approx(3 / (steps // 64))
    assert measures["update avf_vdn bp-10"]["relative"] == pytest.approx(3 / (steps // 64) / 0.5)


def test_runs_without_updates_make_none(monkeypatch):
    """Of both kinds of scripts; otherwise the differences would be of nothing."""
    for script, env_id in ((avf_vdn, "bp-10"), (mac_iaicc, "bp-10")):
        updates, real = [], script.train

        def train(args, real=real, updates=updates):
            folder = real(args)
            updates.append(speed.torch.load(folder / "checkpoint.pt", weights_only=True)["updates"])
            return folder

        monkeypatch.setattr(script, "train", train)
        measures = speed.measure_training(script, env_id, 1_500, 1)
        assert updates[:3] == [0, 0, 0] and updates[3] > 0, script.__name__
        assert f"train {script.__name__} {env_id}" in measures


def test_bad_input_is_one_line(tmp_path, capsys):
    wrong = tmp_path / "wrong.json"
    wrong.write_text('{"steps": 1500, "measures": {"env": {}}}')
    other = tmp_path / "other.json"
    other.write_text('{"steps": 7, "measures": {}}')
    for flags, message in (
        (["--repeats", "0"], "--repeats"),
        (["--compare", str(tmp_path / "none.json")], "not a baseline file"),
        (["--compare", str(wrong)], "not a baseline file"),
        (["--compare", str(other)], "--steps 7"),
    ):
        with pytest.raises(SystemExit) as error:
            speed.main([*TINY, *flags])
        assert error.value.code == 2 and message in capsys.readouterr().err.splitlines()[-1]
