"""The benchmark tasks of asynchronous multi-agent reinforcement learning, batched in NumPy.

`make("wtd-s", num_envs=32)` gives a `MacroVectorEnv`. Every id is registered with Gymnasium, too: `gymnasium.make(
"wtd-s-v0")` gives one environment and `gymnasium.make_vec("wtd-s-v0", num_envs=32)` the batch. `register` adds a task.
"""

import difflib
import functools
import importlib
import operator
import os
import re
import sys

import gymnasium as gym

from envs.box_pushing import BoxPushing
from envs.capture_target import CaptureTarget
from envs.core import MacroVectorEnv, SingleMacroEnv, TaskError  # noqa: F401, the scripts need TaskError
from envs.overcooked import Overcooked
from envs.warehouse import Warehouse

_TASKS = {}  # id: (domain, its constructor keywords, default settings of the training scripts)


def register(env_id, domain, defaults=None, **kwargs):
    """Makes a task known to `make`, to `--env` of the training scripts and, as `env_id` + "-v0", to Gymnasium.

    `make("module:id")` imports the module first, so a task may be registered in a file of its own. An id may be
    registered again if the domain is the same class of the same file. The keywords may be others. Gymnasium warns, and
    the new task replaces the old one. This lets a module be reloaded. It also lets a file that registers a task run as
    a script and be imported as a module by `make("module:id")` in the same process.

    Gymnasium's spec names the domain's module and class, so that another process can make the task. A class of the main
    module, or one that is defined in a function, has no such name: then `EnvSpec.to_json` raises an error.

    Args:
        env_id: letters, digits and "_", with "-" and "." between them.
        domain: a `MacroVectorEnv`, called as `domain(num_envs=..., **kwargs)`.
        defaults: settings of the scripts for this task, such as {"gamma": 0.98}. Flags on the command line win. A
            setting that a script does not have is ignored by it.

    Raises:
        ValueError: the id has other characters, or it is one of `IDS`, the tasks registered at the end of this file, or
            that of a task of another domain.
    """
    if not isinstance(env_id, str) or not re.fullmatch(r"\w+([.-]+\w+)*", env_id):
        raise ValueError(f"an id must be of letters, digits and '_', with '-' and '.' between them, got {env_id!r}")
    if env_id in _TASKS:
        known, _, _ = _TASKS[env_id]
        if env_id in IDS or _definition(known) != _definition(domain):
            raise ValueError(f"there is an environment {env_id!r} already, of {_path(known)}")
    spec_kwargs = {"env_id": env_id, **kwargs}
    if _is_importable(domain):
        single = "envs:make_single"
        batch = "envs:make_batch"
        spec_kwargs["domain"] = _path(domain)
    else:
        single = functools.partial(make_single, domain=domain)
        single.metadata = make_single.metadata
        batch = functools.partial(make_batch, domain=domain)
    gym.register(f"{env_id}-v0", single, vector_entry_point=batch, kwargs=spec_kwargs)
    _TASKS[env_id] = domain, kwargs, defaults or {}


def _path(domain):
    """The module and the name of a domain, "module:Class"."""
    return f"{domain.__module__}:{domain.__qualname__}"


def _definition(domain):
    """Where a domain is defined: file and name.

    Not the module and name, because a file that runs as a script is the module `__main__` and can be imported under its
    own name, too.
    """
    module = sys.modules.get(domain.__module__)
    return getattr(module, "__file__", domain.__module__), domain.__qualname__


def _is_importable(domain):
    """Whether other processes can import the domain."""
    return domain.__module__ != "__main__" and "<locals>" not in domain.__qualname__


def _import(module):
    """Imports a module, from the current folder, too. Raises ImportError, one line, whatever goes wrong in it."""
    if os.getcwd() not in sys.path:
        sys.path.append(os.getcwd())
    try:
        return importlib.import_module(module)
    except (Exception, SystemExit) as error:
        kind = "" if isinstance(error, ImportError) else f"{type(error).__name__}: "
        message = " ".join(f"{kind}{error}".split())
        raise ImportError(f"{message} (in the import of {module!r})") from error


def _find(env_id):
    """The domain of a task, its keywords and its default settings; raises as `make`."""
    module, colon, name = str(env_id).rpartition(":")
    if colon:
        if not module or module.startswith("."):
            raise ValueError(f"{env_id!r} must begin with the full name of a module")
        if name in IDS:
            raise ValueError(f"{name!r} is a task of the benchmark: give it without {module + colon!r}")
        _import(module)
    if name not in _TASKS:
        close = difflib.get_close_matches(name, _TASKS, n=1)
        hint = f" (did you mean {close[0]!r}?)" if close else ""
        raise ValueError(f"unknown environment {env_id!r}{hint}; valid ids: {' '.join(_TASKS)}")
    return _TASKS[name]


def problem(env_id):
    """Why a script cannot use a task, one line, or None if it can. Makes the task once and takes a step."""
    try:
        domain, kwargs, _ = _find(env_id)
    except (ValueError, ImportError) as error:
        return str(error)
    try:
        env = domain(num_envs=1, **kwargs)
        env.reset()
        env.step(env.available.argmax(axis=2))
        env.close()
    except Exception as error:
        message = " ".join(str(error).split())
        return f"{env_id}: {type(error).__name__}: {message}"


def defaults(env_id, args_class):
    """Settings that a task was registered with, {name: value}, without those that a script's `Args` does not have.

    The dict is empty for an id that `make` does not know.
    """
    try:
        _, _, settings = _find(env_id)
    except (ValueError, ImportError):
        return {}
    return {name: value for name, value in settings.items() if hasattr(args_class, name)}


def make(env_id, num_envs=1, **kwargs) -> MacroVectorEnv:
    """Makes a batch of environments.

    Args:
        env_id: one of `IDS`, one that was registered, or "module:id" for one that the import of a module registers.
        num_envs: how many, at least 1.
        kwargs: constructor keywords of the domain, over the task's own (`make("wtd-s", robot_speed=0.8)`).

    Raises:
        ValueError: the id is unknown or an argument is out of range.
        TypeError: the domain has no such keyword.
        ImportError: the module cannot be imported.
    """
    domain, task_kwargs, _ = _find(env_id)
    return domain(num_envs=num_envs, **{**task_kwargs, **kwargs})


def make_batch(num_envs, env_id, domain, max_episode_steps=None, **kwargs) -> MacroVectorEnv:
    """Makes a batch for `gymnasium.make_vec`.

    Args:
        domain: a `MacroVectorEnv` or its "module:Class".
        max_episode_steps: None or the horizon. Gymnasium passes it on from a spec.

    Raises:
        ValueError, TypeError, ImportError: as `make`, and if `max_episode_steps` is not the horizon.
    """
    if isinstance(domain, str):
        module, _, name = domain.partition(":")
        domain = operator.attrgetter(name)(_import(module))  # a name may have dots: Outer.Domain
    env = domain(num_envs=num_envs, **kwargs)
    if max_episode_steps not in (None, env.horizon):
        raise ValueError(f"{env_id} ends after its horizon, {env.horizon} steps, not after {max_episode_steps}")
    return env


def make_single(env_id, domain, **kwargs) -> SingleMacroEnv:
    """Makes one environment for `gymnasium.make`; arguments and errors as `make_batch`."""
    if "num_envs" in kwargs:
        raise ValueError(f"gymnasium.make makes one {env_id}: for a batch use gymnasium.make_vec(..., num_envs=...)")
    return SingleMacroEnv(make_batch(1, env_id, domain, **kwargs))


# gymnasium.make reads the render modes from the entry point. From "rgb_array" it makes "human" and "rgb_array_list".
make_single.metadata = SingleMacroEnv.metadata


def to_pettingzoo(env_id, **kwargs):
    """Makes one environment as a PettingZoo `ParallelEnv`, see `envs.pettingzoo_export.MacroParallelEnv`.

    Arguments and errors as `make`. It needs PettingZoo: `pip install -e '.[simulators]'`.
    """
    from envs.pettingzoo_export import MacroParallelEnv  # here, since PettingZoo is optional

    return MacroParallelEnv(make(env_id, **kwargs))


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
