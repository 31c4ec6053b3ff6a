"""The benchmark tasks of asynchronous multi-agent reinforcement learning, batched in NumPy.

`make("wtd-s", num_envs=32)` gives a `MacroVectorEnv`. Every id is registered with Gymnasium, too: `gymnasium.make(
"wtd-s-v0")` gives one environment and `gymnasium.make_vec("wtd-s-v0", num_envs=32)` the batch. `register` adds a task.
"""

import difflib
import importlib

import gymnasium as gym

from envs.box_pushing import BoxPushing
from envs.capture_target import CaptureTarget
from envs.core import MacroVectorEnv, SingleMacroEnv
from envs.overcooked import Overcooked
from envs.warehouse import Warehouse

_TASKS = {}  # id: (domain, its keywords)


def register(env_id, domain, **kwargs):
    """Makes a task known to `make`, to `--env` of the scripts and, as `env_id` + "-v0", to Gymnasium.

    `make("module:id")` imports the module first, so a task may be registered in a file of its own.

    Args:
        env_id: letters, digits, and "-", "_", "." between them.
        domain: a `MacroVectorEnv`, called as `domain(num_envs=..., **kwargs)`.

    Raises:
        ValueError: there is a task of this id.
        gymnasium.error.Error: the id has other characters.
    """
    if env_id in _TASKS:
        raise ValueError(f"there is an environment {env_id!r} already")
    gym.register(f"{env_id}-v0", "envs:make_single", vector_entry_point="envs:make", kwargs={"env_id": env_id})
    _TASKS[env_id] = domain, kwargs


def _find(env_id):
    """The domain of a task and its keywords; raises as `make`."""
    module, _, name = str(env_id).rpartition(":")
    if module:
        importlib.import_module(module)
    if name not in _TASKS:
        close = difflib.get_close_matches(name, _TASKS, n=1)
        hint = f" (did you mean {close[0]!r}?)" if close else ""
        raise ValueError(f"unknown environment {env_id!r}{hint}; valid ids: {' '.join(_TASKS)}")
    return _TASKS[name]


def problem(env_id):
    """Why `make` would not know an id, one line, or None if it does."""
    try:
        _find(env_id)
    except (ValueError, ImportError) as error:
        return str(error)


def make(env_id, num_envs=1, **kwargs) -> MacroVectorEnv:
    """Makes a batch of environments.

    Args:
        env_id: one of `IDS`, one that was registered, or "module:id" for one that the import of a module registers.
        num_envs: how many, at least 1.
        kwargs: constructor keywords of the domain, over the task's own (`make("wtd-s", robot_speed=0.8)`).

    Raises:
        ValueError: the id is unknown or an argument is out of range.
        ImportError: there is no such module.
    """
    domain, task = _find(env_id)
    return domain(num_envs=num_envs, **{**task, **kwargs})


def make_single(env_id, **kwargs) -> SingleMacroEnv:
    """Makes one environment as a `gymnasium.Env`; arguments and errors as `make`."""
    return SingleMacroEnv(make(env_id, **kwargs))


register("bp-10", BoxPushing, grid=10)
register("bp-20", BoxPushing, grid=20)
register("bp-30", BoxPushing, grid=30)
register("wtd-s", Warehouse, layout="s")
register("wtd-d", Warehouse, layout="d")
register("wtd-t", Warehouse, layout="t")
register("wtd-t1", Warehouse, layout="t1")
register("ct-10", CaptureTarget, n_agents=10)
register("bp-10-primitive", BoxPushing, grid=10, primitive=True)
register("wtd-s-primitive", Warehouse, layout="s", primitive=True)
register("ct-10-primitive", CaptureTarget, n_agents=10, primitive=True)
register("ct-10-onestep", CaptureTarget, n_agents=10, one_step=True)
register("overcooked-a", Overcooked, layout="a")
register("overcooked-b", Overcooked, layout="b")
register("overcooked-c", Overcooked, layout="c")

IDS = tuple(_TASKS)  # the benchmark's tasks, without those that are registered later
