"""The benchmark tasks of asynchronous multi-agent reinforcement learning, batched in NumPy.

`make("wtd-s", num_envs=32)` gives a `MacroVectorEnv`; importing the package also registers every id with Gymnasium, so
that `gymnasium.make("wtd-s-v0")` gives one environment and `gymnasium.make_vec("wtd-s-v0", num_envs=32)` the batch.
"""

import difflib

import gymnasium as gym

from envs.box_pushing import BoxPushing
from envs.capture_target import CaptureTarget
from envs.core import MacroVectorEnv, SingleMacroEnv
from envs.warehouse import Warehouse

_TASKS = {
    "bp-10": (BoxPushing, {"grid": 10}),
    "bp-20": (BoxPushing, {"grid": 20}),
    "bp-30": (BoxPushing, {"grid": 30}),
    "wtd-s": (Warehouse, {"layout": "s"}),
    "wtd-d": (Warehouse, {"layout": "d"}),
    "wtd-t": (Warehouse, {"layout": "t"}),
    "wtd-t1": (Warehouse, {"layout": "t1"}),
    "ct-10": (CaptureTarget, {"n_agents": 10}),
    "bp-10-primitive": (BoxPushing, {"grid": 10, "primitive": True}),
    "wtd-s-primitive": (Warehouse, {"layout": "s", "primitive": True}),
    "ct-10-primitive": (CaptureTarget, {"n_agents": 10, "primitive": True}),
}
IDS = tuple(_TASKS)


def make(env_id, num_envs=1, **kwargs) -> MacroVectorEnv:
    """Makes a batch of environments.

    Args:
        env_id: one of `IDS`.
        num_envs: how many, at least 1.
        kwargs: constructor keywords of the domain, over the task's own (`make("wtd-s", robot_speed=0.8)`).

    Raises:
        ValueError: the id is unknown or an argument is out of range.
    """
    if env_id not in _TASKS:
        close = difflib.get_close_matches(str(env_id), IDS, n=1)
        hint = f" (did you mean {close[0]!r}?)" if close else ""
        raise ValueError(f"unknown environment {env_id!r}{hint}; valid ids: {' '.join(IDS)}")
    domain, task = _TASKS[env_id]
    return domain(num_envs=num_envs, **{**task, **kwargs})


def make_single(env_id, **kwargs) -> SingleMacroEnv:
    """Makes one environment as a `gymnasium.Env`; arguments and errors as `make`."""
    return SingleMacroEnv(make(env_id, **kwargs))


for _id in IDS:
    gym.register(f"{_id}-v0", "envs:make_single", vector_entry_point="envs:make", kwargs={"env_id": _id})
