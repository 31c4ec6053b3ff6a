"""The task of docs/your-own-simulator.md, as it is printed, and the page's second example."""

import re
import shlex
import sys

import gymnasium
import numpy as np
import pytest
import torch

import avf_qmix
import avf_vdn
import envs
import play
from docs.simulators import first_food, play_at_random, returns, shortest_ways
from tests.short_runs import short
from tests.sync import ROOT
from tests.test_envs import assert_same
from tests.test_options import random_play
from tests.test_runs import assert_same_run, interrupted, resume

REASON = "pip install -e '.[simulators]'"
pytest.importorskip("lbforaging", reason=REASON)
pytest.importorskip("mpe2", reason=REASON)

PAGE = (ROOT / "docs" / "your-own-simulator.md").read_text()
(CODE,) = re.findall(r"^```python\n(.*?)^```$", PAGE, re.M | re.S)
(COMMAND,) = re.findall(r"^    python path/to/avf_qmix\.py (.*)$", PAGE, re.M)
FORAGING = "foraging:foraging"
SPREAD = "docs.spread_task:spread"


@pytest.fixture(scope="module", autouse=True)
def tasks(tmp_path_factory):
    """A folder on the path that holds the file; the tasks are forgotten in the end."""
    folder = tmp_path_factory.mktemp("beside")
    (folder / "foraging.py").write_text(CODE)
    sys.path.insert(0, str(folder))
    yield
    sys.path.remove(str(folder))
    for module, name in (("foraging", "foraging"), ("docs.spread_task", "spread")):
        sys.modules.pop(module, None)
        envs._TASKS.pop(name, None)
        gymnasium.registry.pop(f"{name}-v0", None)


def test_the_page_is_short():
    assert len(PAGE.splitlines()) <= 150


def test_foraging_is_what_the_page_says():
    """The script earns most of what there is; if nothing is left, that is 1, and a success."""
    env = envs.make(FORAGING, 8)
    assert env.macro_action_names == [["Food(0)", "Food(1)", "Food(2)", "Load", "Wait"]] * 2
    env.reset(seed=0)
    for _ in range(49):
        _, _, terminations, truncations, infos = env.step(first_food(env, None))
        np.testing.assert_array_equal(terminations, infos["success"])
        np.testing.assert_array_equal(np.isclose(env.episode_return, 1.0), infos["success"])
        over = terminations | truncations
        env.reset(options={"reset_mask": over})
    assert over.any(), "the horizon"
    assert returns(FORAGING, first_food, 20).mean() > 0.5 > returns(FORAGING, play_at_random, 20).mean()


def test_spread_is_what_the_page_says():
    """Macro-actions last up to ten steps, and the simulator truncates at step 25. The script is better than chance."""
    env = envs.make(SPREAD, 2, horizon=40, render_mode="rgb_array")
    env.reset(seed=0)
    assert all(frame.shape == (700, 700, 3) for frame in env.render())
    for step in range(1, 26):
        _, _, terminations, truncations, _ = env.step(shortest_ways(env, None))
        assert not terminations.any() and (truncations == (step == 25)).all()
        assert env.age.max() <= 10
    assert returns(SPREAD, shortest_ways, 10).mean() > returns(SPREAD, play_at_random, 10).mean() + 10


def test_spread_repeats_itself_and_foraging_is_noticed(capsys):
    """Agents of level-based foraging begin where none stood before the reset, so after the same episode elsewhere."""
    for env_id, says in ((SPREAD, ""), (FORAGING, "3 of 3 episodes did not repeat themselves")):
        env, other = envs.make(env_id, 3), envs.make(env_id, 3)
        env.reset(seed=1)
        random_play(env, 60)
        saved = env.save_state()
        for sim, seed in zip(other.sims, env.seeds, strict=True):
            sim.reset(int(seed))
        other.load_state(saved)
        said = capsys.readouterr().err
        assert said.startswith(says) and bool(said) == bool(says)
        if not says:
            assert_same(random_play(env, 30), random_play(other, 30))
    _, _, terminations, truncations, _ = other.step(other.available.argmax(2))
    assert truncations.all() and not terminations.any()


@pytest.mark.slow
@pytest.mark.parametrize("env_id", [SPREAD, FORAGING])
def test_runs_go_on_after_an_interruption(tmp_path, monkeypatch, env_id):
    """A run equals one that was not interrupted if its simulator repeats itself. Otherwise it comes to its end."""
    options = dict(total_timesteps=480, eval_frequency=240, eval_episodes=1)
    args = short(avf_vdn, env_id, tmp_path / "one", checkpoint_frequency=0.0, **options)
    folder = interrupted(monkeypatch, avf_vdn, args, 70)
    resume(avf_vdn, folder, f"--env={env_id}")
    assert torch.load(folder / "last.pt", weights_only=True)["step"] == 480
    if env_id == SPREAD:
        undisturbed = avf_vdn.train(short(avf_vdn, env_id, tmp_path / "other", **options))
        assert_same_run(undisturbed, folder)


@pytest.mark.slow
def test_the_page_as_it_is_printed(tmp_path, monkeypatch, capsys):
    """Trains for a twentieth of the time and draws the timeline, for the second example, too."""
    for command, env_id in ((COMMAND, FORAGING), (f"--env {SPREAD}", SPREAD)):
        args = avf_qmix.parse_args([*shlex.split(command), f"--runs-dir={tmp_path}"])
        assert args.env == env_id and args.total_timesteps == 80_000, "the task's own values"
        args.total_timesteps //= 20
        args.learning_starts = 1_000
        args.eval_episodes = 4
        folder = avf_qmix.train(args)
        assert torch.load(folder / "last.pt", weights_only=True)["step"] == args.total_timesteps
        play.main([str(folder), f"--env={env_id}", "--episodes=2", f"--timeline={tmp_path}/team.png"])
        assert (tmp_path / "team.png").stat().st_size > 10_000
    assert "2 greedy episodes" in capsys.readouterr().out
