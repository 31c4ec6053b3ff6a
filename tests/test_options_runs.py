"""Runs on OptionsEnv that are interrupted or go wrong, and play in the robotic warehouse."""

import gymnasium
import pytest

import avf_vdn
import envs
from envs.options import Option, OptionsEnv
from tests.short_runs import short
from tests.test_envs import assert_same
from tests.test_options import OPTIONS, REST, Corridor, random_play, walk
from tests.test_runs import assert_same_run, interrupted, resume


@pytest.mark.slow
def test_a_run_that_is_resumed_equals_one_that_is_not(tmp_path, monkeypatch):
    """Interrupted in the middle of episodes. The same curves and weights come out."""
    task = dict(make=Corridor, options=OPTIONS, horizon=20)
    monkeypatch.setitem(envs._TASKS, "corridor", (OptionsEnv, task, {}))
    options = dict(total_timesteps=480, eval_frequency=240, eval_episodes=1)
    undisturbed = avf_vdn.train(short(avf_vdn, "corridor", tmp_path / "one", **options))
    args = short(avf_vdn, "corridor", tmp_path / "other", checkpoint_frequency=0.0, **options)
    folder = interrupted(monkeypatch, avf_vdn, args, 77)
    resume(avf_vdn, folder)
    assert_same_run(undisturbed, folder)


def test_an_option_that_goes_wrong_ends_a_run_with_one_line(tmp_path, monkeypatch):
    """Ann may be too fast from the fifth step on, so the task passes the look that a script takes at it first."""
    fast = Option("Fast", walk(1, speed=2).run, lambda sim, agent: sim.time >= 5)
    task = dict(make=Corridor, options=[[REST, fast], [REST]], horizon=20)
    monkeypatch.setitem(envs._TASKS, "corridor", (OptionsEnv, task, {}))
    with pytest.raises(envs.TaskError, match=r"^option Fast of agent 0 at step \d+: it yields 2, which is"):
        avf_vdn.train(short(avf_vdn, "corridor", tmp_path))


def keep_doing(action):
    """An option of the warehouse that does the same for three steps."""

    def run(sim, agent):
        for _ in range(3):
            yield action

    return Option(f"Do({action})", run)


def test_the_robotic_warehouse_repeats_itself(capsys):
    pytest.importorskip("rware", reason="pip install -e '.[simulators]'")
    task = dict(
        make=lambda: gymnasium.make("rware:rware-tiny-2ag-v2", disable_env_checker=True),
        options=[keep_doing(action) for action in range(5)],
        horizon=30,
    )
    env, other = OptionsEnv(2, **task), OptionsEnv(2, **task)
    env.reset(seed=0)
    random_play(env, 50)
    other.load_state(env.save_state())
    assert_same(random_play(env, 30), random_play(other, 30))
    assert not capsys.readouterr().err
