"""The random policy and the scripts: what they reach is what benchmark/references.json and the docstring say."""

import json
from functools import partial
from pathlib import Path

import numpy as np
import pytest

import envs
from benchmark.scripted import LOADS, deliver, go_to_target, main, play, random_policy, reference, script_of

REFERENCES = json.loads((Path(__file__).parents[1] / "benchmark" / "references.json").read_text())
OPTIMA = {
    **{"bp-10": 98.9, "bp-20": 97.4, "bp-30": 95.9, "bp-10-primitive": 98.9},
    **{"wtd-s": 259, "wtd-d": 533, "wtd-t": 803, "wtd-t1": 803, "wtd-s-primitive": 259},
}


@pytest.mark.parametrize("env_id", OPTIMA)
def test_the_script_reaches_the_optimum(env_id):
    result = play(env_id, script_of(env_id)[1], 3, seed=7, gamma=1.0)
    np.testing.assert_allclose(result["return"], OPTIMA[env_id], rtol=0, atol=1e-9)
    np.testing.assert_allclose(result["discounted_return"], result["return"], rtol=0, atol=1e-9)
    assert (result["success"] == 1).all()


@pytest.mark.parametrize("grid", [6, 8, 14])
@pytest.mark.parametrize("env_id", ["bp-10", "bp-10-primitive"])
def test_the_box_is_pushed_on_other_grids(env_id, grid):
    env = envs.make(env_id, 2, grid=grid)
    env.reset(seed=0)
    while not env.over.any():
        env.step(script_of(env_id)[1](env, None))
    np.testing.assert_allclose(env.episode_return, 100 - 0.1 * (1.5 * grid - 4))


@pytest.mark.parametrize("env_id", ["bp-10", "bp-10-primitive"])
def test_a_robot_that_is_there_first_waits(env_id):
    env = envs.make(env_id, agent_starts=[(3.5, 4.5), (8.5, 1.5)])
    env.reset(seed=0)
    while not env.over.any():
        env.step(script_of(env_id)[1](env, None))
    np.testing.assert_allclose(env.episode_return, 98.9)


@pytest.mark.parametrize(("layout", "expected"), [("s", 259), ("d", 552), ("t", 817), ("t1", 823)])
def test_the_script_with_primitive_actions(layout, expected):
    """Search and Pass take one step each, so three layouts are done earlier than with macro-actions."""
    env = envs.make(f"wtd-{layout}", primitive=True)
    env.reset(seed=0)
    while not env.over.any():
        env.step(deliver(env, None, LOADS[layout]))
    np.testing.assert_allclose(env.episode_return, expected)


@pytest.mark.parametrize("env_id", ["wtd-t", "wtd-s-primitive", "bp-10"])
def test_environments_out_of_step_do_not_disturb_each_other(env_id):
    env, policy, returns = envs.make(env_id, 3), script_of(env_id)[1], []
    env.reset(seed=0)
    for step in range(2 * env.horizon):
        if step in (5, 13):
            env.reset(options={"reset_mask": np.array([False, step == 5, step == 13])})
        _, _, terminations, truncations, _ = env.step(policy(env, None))
        over = terminations | truncations
        returns += env.episode_return[over].tolist()
        env.reset(options={"reset_mask": over})
    assert len(returns) >= 6
    np.testing.assert_allclose(returns, OPTIMA[env_id])


@pytest.mark.parametrize("layout", LOADS)
def test_every_human_is_brought_three_tools(layout):
    env = envs.make(f"wtd-{layout}")
    humans = [human for _, load in LOADS[layout] for human in load]
    assert sorted(humans) == sorted(3 * list(range(env.n_humans)))


def test_one_robot_alone_is_late():
    """Counted by hand: handed over in steps 10, 32 and 54, 9 steps to the human, 9 back and 4 for the next Pass.

    The second tool arrives in step 41, the phase being over in step 40; the third in step 63, the phase being over in
    step 61. So both are late, and the episode is 63 steps long.
    """
    result = play("wtd-s", partial(deliver, loads=[(0, [0])] * 3), 1, seed=0, gamma=1.0)
    assert result["length"][0] == 63 and result["return"][0] == 100 + 80 + 80 - 63


@pytest.mark.slow
def test_always_move_to_target():
    result = play("ct-10", go_to_target, 4000, seed=1, gamma=0.98)
    assert 0.50 < result["return"].mean() < 0.55
    assert np.array_equal(result["return"], result["success"])


@pytest.mark.slow
@pytest.mark.parametrize("env_id", envs.IDS)
def test_references_are_those_of_the_code(env_id):
    entry = REFERENCES[env_id]
    numbers = {"return", "se", "discounted_return", "length", "success", "episodes"}
    assert entry.keys() == {"random", "scripted"} and entry["random"].keys() == numbers
    assert entry["scripted"].keys() == {"name", "optimal"} | numbers
    name, script, optimal = script_of(env_id)
    assert (entry["scripted"]["name"], entry["scripted"]["optimal"]) == (name, optimal)
    assert optimal == (env_id in OPTIMA) and entry["scripted"]["return"] == OPTIMA.get(
        env_id, entry["scripted"]["return"]
    )
    for saved, policy in ((entry["random"], random_policy), (entry["scripted"], script)):
        few = 200
        got = reference(env_id, policy, few, seed=11)
        if saved["se"] == 0:
            assert {**got, "episodes": 0} == {key: saved[key] for key in got} | {"episodes": 0}
        else:
            error = saved["se"] * (1 + saved["episodes"] / few) ** 0.5
            assert abs(got["return"] - saved["return"]) < 4 * error
    assert entry["random"]["return"] < entry["scripted"]["return"]


def test_means_and_standard_error():
    result, got = play("wtd-s", random_policy, 50, seed=3, gamma=0.95), reference("wtd-s", random_policy, 50, seed=3)
    for key, values in result.items():
        assert got[key] == pytest.approx(values.mean(), abs=1e-6), key
    assert got["se"] == pytest.approx(np.sqrt(np.square(result["return"] - got["return"]).sum() / 49 / 50), abs=1e-5)


def test_all_tasks_have_references():
    assert tuple(REFERENCES) == envs.IDS


def test_command_line(tmp_path, capsys):
    path = tmp_path / "references.json"
    main(["--envs", "bp-10", "wtd-s", "--episodes", "3", "-o", str(path)])
    written = json.loads(path.read_text())
    assert list(written) == ["bp-10", "wtd-s"]
    bp = written["bp-10"]["scripted"]
    assert bp["episodes"] == 3 and bp["return"] == 98.9 and bp["length"] == 11
    by_hand = -0.1 * (1 - 0.95**11) / 0.05 + 100 * 0.95**10
    assert bp["discounted_return"] == pytest.approx(by_hand, abs=1e-5)
    printed = capsys.readouterr().out.splitlines()
    assert len(printed) == 5 and "both push the big box" in printed[2] and "98.900" in printed[2]


def test_what_cannot_be_written_is_told_before_anything_is_played(tmp_path, monkeypatch):
    monkeypatch.setattr("benchmark.scripted.reference", lambda *_: pytest.fail("played"))
    with pytest.raises(SystemExit, match="scripted: cannot write"):
        main(["-o", str(tmp_path / "no" / "file.json")])


def test_bad_input_is_one_line(tmp_path):
    for flags, message in (
        (["--episodes", "1"], "--episodes must be from 2 to 100,000"),
        (["--episodes", "100001"], "--episodes must be from 2 to 100,000"),
        (["--envs", "bp-11"], "argument --envs: invalid choice: 'bp-11'"),
        (["--envs", "bp-10", "--episodes", "2", "-o", str(tmp_path / "no" / "file.json")], "cannot write"),
        (["--envs", "bp-10", "--episodes", "2", "-o", str(tmp_path)], "cannot write"),
        (["--envs", "bp-10", "--episodes", "2", "-o", ""], "cannot write"),
    ):
        with pytest.raises(SystemExit) as error:
            main(flags)
        assert str(error.value).startswith("scripted: ") and message in str(error.value)
        assert "\n" not in str(error.value)
