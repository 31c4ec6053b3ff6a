"""The speed table: every measure is taken, and two checkouts are compared fairly."""

import json
import time

import numpy as np
import pytest

import avf_qplex
import envs
import mac_iaicc
from benchmark import speed

TINY = ["--scripts", "avf_qplex", "--envs", "bp-10", "--steps", "1500", "--rounds", "1"]
NAMES = [f"{kind} avf_qplex bp-10 x 32" for kind in ("act", "env", "update", "train")]

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
updates = 0
if "learning-starts" in flags and n > 1:
    updates = n // flags["train-frequency"] - flags["learning-starts"] // flags["train-frequency"]
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


def table(capsys):
    """The cells of the printed table: by measure its numbers."""
    lines = capsys.readouterr().out.splitlines()
    return {line[:34].strip(): line[34:].split() for line in lines[1:]}


def test_every_measure_is_taken(tmp_path, capsys, monkeypatch):
    """Acting is the script's, training a stand-in's: the tests below have the real script's word on its flags."""
    monkeypatch.setattr(speed.record, "ROOT", stand_in(tmp_path, 0.0, 0.00001, 0.001))
    monkeypatch.setattr(speed, "CALLS", 300)
    speed.main(TINY)
    measured = {name: float(each) for name, (each,) in table(capsys).items()}
    assert list(measured) == NAMES and all(0 < each < 1000 for each in measured.values())
    speed.main([*TINY, "--num-envs", "1"])
    alone = table(capsys)
    assert float(alone["env avf_qplex bp-10 x 1"][0]) > 3 * measured["env avf_qplex bp-10 x 32"]
    assert [flags["num-envs"] for flags in flags_of_runs(tmp_path, avf_qplex)] == [32] * 3 + [1] * 3


@pytest.mark.slow
def test_an_update_and_a_step_are_differences_of_runs(tmp_path):
    """100 ms to start, 0.05 ms a step and 5 ms an update, one of them in 40 steps, so a step takes 0.175 ms.

    An episode of bp-10 has 100 steps. So with 20 environments all have one after 2,000 steps, and 1,000 follow.
    """
    checkout = stand_in(tmp_path / "a", 0.1, 0.00005, 0.005)
    args = avf_qplex.parse_args(["--env=bp-10", "--num-envs=20", "--train-frequency=40"])
    seconds = speed.training([checkout], "avf_qplex", args, 990, 3)
    assert {kind: x.shape for kind, x in seconds.items()} == {"update": (3, 1), "train": (3, 1)}
    assert np.median(seconds["update"]) == pytest.approx(0.005, rel=0.5)
    assert np.median(seconds["train"]) == pytest.approx(0.000175, rel=0.5)
    begin, idle, learning = flags_of_runs(checkout, avf_qplex)[:3]
    assert begin["total-timesteps"] == 1 and idle["total-timesteps"] == learning["total-timesteps"] == 3000
    assert idle["learning-starts"] == 3000 and learning["learning-starts"] == 2000
    assert learning["train-frequency"] == 40
    assert learning["env"] == "bp-10" and learning["eval-episodes"] == 1 and learning["eval-frequency"] > 10**6


@pytest.mark.slow
def test_updates_are_counted_as_the_script_makes_them(tmp_path, monkeypatch):
    """With 12 environments and an update per 50 steps none of the numbers is a multiple of another."""
    made, found, args = [], [], avf_qplex.parse_args(["--env=bp-10", "--num-envs=12", "--train-frequency=50"])
    real = avf_qplex.make_batch

    def run(checkout, name, flags):
        if flags["total-timesteps"] > 1:
            made.clear()
            given = [f"--{key}={value}" for key, value in flags.items()]
            more = ["--batch-size=1", "--hidden-size=1", f"--runs-dir={tmp_path}"]
            avf_qplex.train(avf_qplex.parse_args([*given, *more]))
            found.append(len(made))
        return 2.0 * len(made)

    monkeypatch.setattr(speed, "run", run)
    monkeypatch.setattr(avf_qplex, "make_batch", lambda *batch: made.append(batch) or real(*batch))
    seconds = speed.training([tmp_path], "avf_qplex", args, 210, 1)
    assert found[0] == 0 and found[1] in (4, 5) and seconds["update"] == 2.0


def test_a_run_without_an_update_is_refused(tmp_path, monkeypatch):
    args = avf_qplex.parse_args(["--env=bp-10", "--train-frequency=1000000"])
    with pytest.raises(SystemExit, match=r"^speed: avf_qplex makes no update in 100 steps on bp-10"):
        speed.training([tmp_path], "avf_qplex", args, 100, 1)
    # before anything is measured, even if it is the last of many
    monkeypatch.setattr(speed, "play", lambda *_: pytest.fail("measured"))
    monkeypatch.setattr(speed, "training", lambda *_: pytest.fail("measured"))
    with pytest.raises(SystemExit, match=r"^speed: avf_qplex makes no update in 10 steps on wtd-s"):
        speed.main(["--scripts", "mac_iaicc", "avf_qplex", "--envs", "wtd-s", "wtd-t", "--steps", "10"])


@pytest.mark.parametrize("env_id", envs.IDS)
def test_every_task_can_be_measured(env_id):
    args = avf_qplex.parse_args([f"--env={env_id}"])
    env = envs.make(env_id, 3, horizon=4)
    learner = avf_qplex.make_learner(args, env)
    buffer = avf_qplex.ReplayBuffer(env, 10)
    assert (speed.play(avf_qplex, args, env, learner["agents"], 5, buffer) > 0).all()
    assert len(buffer.ended) == 3


def test_an_actor_critic_is_idle_where_its_batch_is_never_full(tmp_path):
    checkout = stand_in(tmp_path / "a", 0.0, 0.0, 0.0, name="mac_iaicc")
    speed.training([checkout], "mac_iaicc", mac_iaicc.parse_args(["--env=bp-10", "--num-envs=4"]), 1000, 1)
    _, idle, learning = flags_of_runs(checkout, mac_iaicc)
    assert idle["batch-size"] == idle["total-timesteps"] == 1400, "more episodes than steps"
    assert "batch-size" not in learning and "train-frequency" not in learning


def test_two_checkouts_take_turns(tmp_path, monkeypatch, capsys):
    """Here an update takes 10 ms, there 5 ms."""
    here, there = stand_in(tmp_path / "here", 0.0, 0.0, 0.01), stand_in(tmp_path / "there", 0.0, 0.0, 0.005)
    turns, real = [], speed.run
    monkeypatch.setattr(speed.record, "ROOT", here)
    monkeypatch.setattr(speed, "run", lambda *arguments: turns.append(arguments[0]) or real(*arguments))
    speed.main([*TINY, "--rounds", "3", "--against", str(there)])
    assert turns == [here, there] * 9
    (update, train), names = table(capsys).values(), NAMES[2:]
    assert len(update) == len(train) == 6 and len(names) == 2
    assert float(update[0]) == pytest.approx(10, rel=0.4) and float(update[1]) == pytest.approx(5, rel=0.4)
    assert 1.4 < float(update[2]) < 2.8 and float(train[0]) > float(train[1])


def test_a_script_that_fails_is_named(tmp_path, monkeypatch):
    monkeypatch.setattr(speed.record, "ROOT", tmp_path)
    (tmp_path / "avf_qplex.py").write_text("\nALGORITHM = 1\nraise SystemExit('avf_qplex: this is why')")
    with pytest.raises(SystemExit, match=r"^speed: .*/avf_qplex\.py: avf_qplex: this is why$"):
        speed.main([*TINY, "--against", str(tmp_path)])


SMALL = {"agents": 2, "envs": 4, "grid": 4, "horizon": 6}


@pytest.mark.slow
def test_scaling_prints_a_table_for_each_axis(capsys, monkeypatch):
    """Each measure in a process of its own: the most memory that it held is more than the replay buffer."""
    monkeypatch.setattr(speed, "SIZE", SMALL)
    monkeypatch.setattr(speed, "SCALING", {"agents": (2,), "horizon": (6,)})
    monkeypatch.setattr(speed, "STATES", [("avf_vdn", None), ("avf_qmix", "joint")])
    speed.main(["--scaling", "--rounds", "1"])
    blank, agents, rule, _, qmix, _, horizon, _, vdn, _ = capsys.readouterr().out.splitlines()
    assert blank == "" and rule == "|" + " --- |" * 9
    assert agents.split(" | ")[2] == "agents" and horizon.split(" | ")[2] == "horizon"
    for line, start in ((qmix, ["avf_qmix", "joint", "2"]), (vdn, ["avf_vdn", "none", "6"])):
        cells = line.strip("| ").split(" | ")
        assert cells[:3] == start and len(cells) == 9
        env, act, update, weights, replay, peak = (float(cell.replace(",", "")) for cell in cells[3:])
        assert 0 < env < 1e5 and 0 < act < 1e5 and 0 < update < 1e5 and (weights > 0) == (start[0] == "avf_qmix")
        assert peak > replay + 50


def test_scaling_counts_weights_and_bytes():
    """QMIX: the hypernetworks of W_1, w_2 and b_2, and b_1, for a state of n or 1 times 2 (n + 1) numbers.

    A row of the replay buffer has an observation of 4, two flags and two integers for each agent, two states, reward
    and discount. There are 4 running episodes with a place for each of 6 steps and the end, and 2,500 ended ones that
    have at least a row for the start and one for the end.
    """
    for agents in (2, 3):
        for state, width in (("joint", agents * 2 * (agents + 1)), ("decision", 2 * (agents + 1))):
            *_, weights, replay, peak = speed.scale("avf_qmix", state, {**SMALL, "agents": agents}, 1)
            outputs = (agents * 32, 32, 1)
            assert 1e3 * weights == pytest.approx(sum((width + 1) * 32 + 33 * n for n in outputs) + (width + 1) * 32)
            row = agents * (4 * 4 + 2 + 2 * 8) + 2 * 4 * 2 * (agents + 1) + 2 * 4
            rows = 1e6 * replay / row
            assert 2_500 * 2 + 4 * 7 < rows <= (2_500 + 4) * 7 and rows == pytest.approx(round(rows))
            assert peak > replay
    assert speed.scale("avf_vdn", None, SMALL, 1)[3] == 0


def test_a_measure_times_the_script(monkeypatch):
    """An update that takes 20 ms longer is seen to, in the update alone."""
    script = speed.record.load_script("avf_vdn")
    real = script.td_loss

    def slow(*arguments):
        start = time.process_time()
        while time.process_time() < start + 0.02:
            pass
        return real(*arguments)

    before = speed.scale("avf_vdn", None, SMALL, 3)
    monkeypatch.setattr(script, "td_loss", slow)
    after = speed.scale("avf_vdn", None, SMALL, 3)
    assert after[2] > 20 and after[2] - before[2] > 10


def test_bad_input_is_one_line(tmp_path):
    for flags, message in (
        (["--rounds", "0"], "argument --rounds: invalid count value: '0'"),
        (["--steps", "1000001"], "argument --steps: invalid count value: '1000001'"),
        (["--scripts", "dqn"], "argument --scripts: invalid choice: 'dqn'"),
        (["--num-envs", "0"], "argument --num-envs: invalid count value: '0'"),
        (["--scaling"], "--scaling measures sizes of its own"),  # beside the others
        (["--against", str(tmp_path / "nowhere")], "there is no "),
        (["--against", ""], "argument --against: invalid folder value: ''"),
    ):
        with pytest.raises(SystemExit) as error:
            speed.main([*TINY, *flags])
        assert str(error.value).startswith("speed: ") and message in str(error.value)
        assert "\n" not in str(error.value)
