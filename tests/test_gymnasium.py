"""Tasks as Gymnasium sees them: registration, specs that other processes use, and what its wrappers ask for."""

import importlib
import json
import subprocess
import sys
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest

import envs
from envs.box_pushing import BoxPushing
from envs.capture_target import CaptureTarget
from tests.matrix_game import MatrixGame, WaitingGame
from tests.sync import ROOT

TASK = """
import envs
from envs.box_pushing import BoxPushing


class Mine(BoxPushing):
    pass


envs.register("mine", Mine, grid=6, horizon={horizon})
"""


@pytest.fixture(autouse=True)
def forgotten(monkeypatch):
    """What a test registers is forgotten after it."""
    monkeypatch.setattr(envs, "_TASKS", dict(envs._TASKS))
    monkeypatch.setattr(gym.envs.registration, "registry", dict(gym.registry))


@pytest.fixture
def module(tmp_path, monkeypatch):
    """The file of a module `my_module`, which registers "mine"."""
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, "my_module", raising=False)
    path = tmp_path / "my_module.py"
    path.write_text(TASK.format(horizon=7))
    yield path
    sys.modules.pop("my_module", None)


def rewrite(path, text):
    """Writes a module anew, so that no compiled file of the old text is taken for it."""
    path.write_text(text)
    importlib.invalidate_caches()
    cached = Path(importlib.util.cache_from_source(str(path)))
    cached.unlink(missing_ok=True)


def run(folder, *arguments):
    """Runs Python in another process, which knows this repository and the folder: its output."""
    paths = {"PYTHONPATH": f"{ROOT}:{folder}"}
    done = subprocess.run([sys.executable, *arguments], capture_output=True, text=True, env=paths, cwd=folder)
    assert done.returncode == 0, done.stderr
    return done.stdout.strip()


# ---- specs --------------------------------------------------------------------------------------------------------


def test_a_spec_in_json_makes_the_task_in_another_process(module):
    importlib.import_module("my_module")
    specs = [gym.make("mine-v0", penalty=-3.0).spec, gym.spec("mine-v0"), gym.spec("wtd-t1-v0")]
    (module.parent / "specs.json").write_text(json.dumps([spec.to_json() for spec in specs]))
    program = """
import gymnasium, json
for text in json.load(open("specs.json")):
    env = gymnasium.make(gymnasium.envs.registration.EnvSpec.from_json(text)).unwrapped.vector_env
    print(type(env).__module__, type(env).__name__, env.horizon, env.n_agents, getattr(env, "penalty", None))
"""
    found = run(module.parent, "-c", program).splitlines()
    assert found == ["my_module Mine 7 2 -3.0", "my_module Mine 7 2 -10.0", "envs.warehouse Warehouse 150 4 None"]


@pytest.mark.parametrize("context", ["spawn", "forkserver"])
def test_processes_that_start_anew_make_a_registered_task(module, context):
    """So success is an array of bools, as it is without processes, and play is the same."""
    importlib.import_module("my_module")
    infos = []
    for mode, vector_kwargs in (("async", {"context": context}), ("sync", {})):
        batch = gym.make_vec("mine-v0", num_envs=2, vectorization_mode=mode, vector_kwargs=vector_kwargs)
        batch.reset(seed=3)
        for _ in range(5):
            infos.append(batch.step(np.full((2, 2), 4))[4])
        batch.close()
    for one, other in zip(infos[:5], infos[5:], strict=True):
        assert one["success"].dtype == bool and one["macro_done"].dtype == bool
        assert one["macro_action"].shape == (2, 2) and one["state"].shape == (2, 27)
        for name in one:
            np.testing.assert_array_equal(one[name], other[name])


SCRIPT = """
import gymnasium
import envs

class Mine(envs.BoxPushing):
    pass

envs.register("mine", Mine, grid=6)

if __name__ == "__main__":
    batch = gymnasium.make_vec("mine-v0", 1, vectorization_mode="async", vector_kwargs=dict(context="spawn"))
    batch.reset(seed=0)
    batch.close()
    try:
        gymnasium.spec("mine-v0").to_json()
    except ValueError as error:
        print(error)
    print(envs.problem("script:mine"), type(envs.make("mine")).__module__)
"""


def test_a_script_registers_its_own_class_and_uses_it(tmp_path):
    """A class of the main module has no name elsewhere. JSON says so, processes get it all the same."""
    (tmp_path / "script.py").write_text(SCRIPT)
    refused, known = run(tmp_path, "script.py").splitlines()
    assert refused.startswith("Callable found in mine-v0 for entry_point") and "__main__.Mine" in refused
    assert known == "None script", "importing the script as a module registers the same definition again"


def test_a_class_of_a_function_can_be_registered():
    class Local(MatrixGame):
        pass

    envs.register("local", Local, tell=True)
    assert gym.make("local-v0").unwrapped.vector_env.tell and gym.make_vec("local-v0", 2).num_envs == 2


# ---- registering again ----------------------------------------------------------------------------------------------


def test_the_same_definition_replaces_the_old_one(module):
    mine = importlib.import_module("my_module")
    old = mine.Mine
    rewrite(module, TASK.format(horizon=9))
    with pytest.warns(UserWarning, match="Overriding environment mine-v0"):
        importlib.reload(mine)
    assert mine.Mine is not old and type(envs.make("mine")) is mine.Mine
    assert envs.make("mine").horizon == gym.make("mine-v0").unwrapped.vector_env.horizon == 9


def test_an_import_that_failed_can_be_tried_again(module):
    rewrite(module, TASK.format(horizon=7) + "\n1 / 0\n")
    line = "ZeroDivisionError: division by zero (in the import of 'my_module')"
    assert envs.problem("my_module:mine") == line
    rewrite(module, TASK.format(horizon=8))
    with pytest.warns(UserWarning, match="Overriding"):
        assert envs.make("my_module:mine").horizon == 8


def test_another_definition_is_refused(module):
    importlib.import_module("my_module")
    with pytest.raises(ValueError, match=r"there is an environment 'mine' already, of my_module:Mine"):
        envs.register("mine", BoxPushing)
    with pytest.raises(ValueError, match=r"there is an environment 'bp-10' already, of envs\.box_pushing:BoxPushing"):
        envs.register("bp-10", CaptureTarget)
    with pytest.raises(ValueError, match="there is an environment 'bp-10' already"):
        envs.register("bp-10", BoxPushing, grid=12)  # a task of the benchmark stays what it is
    assert envs.make("bp-10").grid == 10


# ---- ids, and tasks with mistakes -----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("env_id", "line"),
    [
        (".my:x", "'.my:x' must begin with the full name of a module"),
        ("..:x", "'..:x' must begin with the full name of a module"),
        (":bp-10", "':bp-10' must begin with the full name of a module"),
        ("envs:bp-10", "'bp-10' is a task of the benchmark: give it without 'envs:'"),
        ("my_module:wtd-s", "'wtd-s' is a task of the benchmark: give it without 'my_module:'"),
        ("", "unknown environment ''; valid ids: bp-10"),
        ("my_module:", "unknown environment 'my_module:'; valid ids: bp-10"),
        ("my_module:other", "unknown environment 'my_module:other'; valid ids: bp-10"),
        ("no_module:mine", "No module named 'no_module' (in the import of 'no_module')"),
    ],
)
def test_an_id_that_is_no_task_gets_one_line(module, env_id, line):
    assert envs.problem(env_id).startswith(line) and "\n" not in envs.problem(env_id)
    with pytest.raises((ValueError, ImportError)) as error:
        envs.make(env_id)
    assert str(error.value).startswith(line)


@pytest.mark.parametrize(
    ("code", "line"),
    [
        ("raise RuntimeError('no\\nluck')", "RuntimeError: no luck"),
        ("import sys; sys.exit('bye')", "SystemExit: bye"),
        ("raise SystemExit", "SystemExit:"),
        ("import no_such_thing", "No module named 'no_such_thing'"),
        ("x = = 1", "SyntaxError: invalid syntax"),
        ("import envs; envs.register('', envs.BoxPushing)", "ValueError: an id must be of letters"),
    ],
)
def test_a_module_that_fails_gets_one_line(module, code, line):
    rewrite(module, code)
    problem = envs.problem("my_module:mine")
    assert problem.startswith(line) and problem.endswith("(in the import of 'my_module')") and "\n" not in problem
    with pytest.raises(ImportError):
        envs.make("my_module:mine")


class Broken(MatrixGame):
    def _advance(self):
        rewards, *others = super()._advance()
        return rewards.astype(np.float32), *others


def test_a_task_with_a_mistake_gets_one_line():
    envs.register("unknown-keyword", WaitingGame, horzon=5)
    envs.register("bad-value", BoxPushing, grid=7)
    envs.register("bad-step", Broken)
    message = "unexpected keyword argument 'horzon'"
    assert envs.problem("unknown-keyword") == f"unknown-keyword: TypeError: WaitingGame.__init__() got an {message}"
    assert envs.problem("bad-value") == "bad-value: ValueError: grid must be even, got 7"
    line = "Broken._advance: rewards must be float64 (1,), got float32 (1,)"
    assert envs.problem("bad-step") == f"bad-step: TaskError: {line}"


# ---- what gymnasium.make takes --------------------------------------------------------------------------------------


def test_render_modes_that_gymnasium_wraps():
    env = gym.make("bp-10-v0", render_mode="rgb_array_list")
    env.reset(seed=0)
    env.step(env.action_space.sample())
    frames = env.render()
    assert len(frames) == 2 and frames[0].ndim == 3
    with pytest.raises(ValueError, match="render_mode must be None or one of"), pytest.warns(UserWarning):
        gym.make("bp-10-v0", render_mode="ansi")

    class OfAFunction(BoxPushing):
        pass

    envs.register("of-a-function", OfAFunction, grid=6)
    of_a_function = gym.make("of-a-function-v0", render_mode="rgb_array_list")
    of_a_function.reset(seed=0)
    assert len(of_a_function.render()) == 1
    of_a_function.close()


def test_human_rendering_shows_pictures_or_says_what_is_missing():
    try:
        with pytest.warns(UserWarning, match="HumanRendering wrapper is being applied"):
            env = gym.make("bp-10-v0", render_mode="human")
    except gym.error.DependencyNotInstalled as error:
        assert "pygame is not installed" in str(error)
    else:
        assert isinstance(env, gym.wrappers.HumanRendering)


def test_gymnasium_make_makes_one_environment():
    with pytest.raises(ValueError, match=r"gymnasium\.make makes one bp-10: for a batch use gymnasium\.make_vec"):
        gym.make("bp-10-v0", num_envs=3)


def test_the_spec_tells_the_horizon_and_no_wrapper_cuts_episodes():
    assert gym.make("wtd-s-v0").spec.max_episode_steps == 150
    env = gym.make("bp-10-v0", horizon=103)
    assert env.spec.max_episode_steps == 103
    for made in (env, gym.make(env.spec)):  # a spec that has the number makes a TimeLimit, at the same step
        made.reset(seed=0)
        ends = [made.step((7, 7))[2:4] for _ in range(103)]
        assert ends == [(False, False)] * 102 + [(False, True)]
    assert gym.make_vec(env.spec, num_envs=2).horizon == 103
    with pytest.raises(ValueError, match="bp-10 ends after its horizon, 103 steps, not after 50"):
        gym.make_vec(env.spec, num_envs=2, max_episode_steps=50)


def test_vector_kwargs_reach_gymnasiums_own_batch():
    mode = gym.vector.AutoresetMode.SAME_STEP
    kwargs = dict(autoreset_mode=mode)
    batch = gym.make_vec("bp-10-v0", 2, vectorization_mode="sync", vector_kwargs=kwargs, horizon=3)
    batch.reset(seed=0)
    ended = [batch.step(np.full((2, 2), 7))[3].tolist() for _ in range(6)]
    assert ended == [[False] * 2, [False] * 2, [True] * 2] * 2
    assert batch.metadata["autoreset_mode"] is mode
