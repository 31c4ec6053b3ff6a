"""The task of docs/your-own-task.md, as it is printed: it is short, passes the page's checks, and is learned."""

import inspect
import itertools
import re
import shlex
import sys

import gymnasium
import numpy as np
import pytest
import torch

import avf_qmix
import envs
from tests.sync import ROOT

PAGE = (ROOT / "docs" / "your-own-task.md").read_text()
CODE, CHECKS = re.findall(r"^```python\n(.*?)^```$", PAGE, re.M | re.S)
COMMAND = re.search(r"^    python avf_qmix\.py ((?:.*\\\n)*.*)$", PAGE, re.M)[1].replace("\\\n", "")


@pytest.fixture(scope="module", autouse=True)
def module(tmp_path_factory):
    """A folder on the path that holds the file; the task is forgotten in the end."""
    folder = tmp_path_factory.mktemp("beside")
    (folder / "my_task.py").write_text(CODE)
    sys.path.insert(0, str(folder))
    yield
    sys.path.remove(str(folder))
    sys.modules.pop("my_task", None)
    envs._TASKS.pop("my-task", None)
    gymnasium.registry.pop("my-task-v0", None)


def optimum(env, gamma=1.0):
    """The undiscounted return of the best team that sees everything, by trying all; float."""
    known = {}

    def best(saved):
        """(discounted, undiscounted) return from a state on."""
        key = tuple(np.concatenate([np.ravel(x) for name, x in saved.items() if name not in ("np_random", "_obs")]))
        if key not in known:
            found = []
            _, infos = env.load_state(saved)
            for actions in itertools.product(*(np.flatnonzero(choices) for choices in infos["available"][0])):
                env.load_state(saved)
                _, (reward,), (over,), _, _ = env.step(np.array([actions]))
                later, sum_later = (0.0, 0.0) if over else best(env.save_state())
                found.append((reward + gamma * later, reward + sum_later))
            known[key] = max(found)
        return known[key]

    env.reset(seed=0)
    return best(env.save_state())[1]


def test_the_file_is_short():
    assert sum(bool(line.strip()) for line in CODE.splitlines()) < 60


def test_the_checks_of_the_page(monkeypatch):
    page = {}
    exec(compile(CHECKS, "docs/your-own-task.md", "exec"), page)
    tests = [value for name, value in page.items() if name.startswith("test_")]
    assert len(tests) == 4
    for test in tests:
        test(*([monkeypatch] if inspect.signature(test).parameters else []))


@pytest.mark.slow
def test_the_greedy_team_reaches_the_optimum(tmp_path):
    """One seed of three, at one evaluation: rounding takes runs elsewhere on other processors."""
    args = avf_qmix.parse_args(shlex.split(COMMAND))
    env = envs.make(args.env)
    best = optimum(env)
    assert best == optimum(env, args.gamma), "the best team is not one that gives something up for the discount"
    assert f"earns {best:g}:" in PAGE
    for seed in (1, 2, 3):
        flags = [*shlex.split(COMMAND), f"--seed={seed}", f"--runs-dir={tmp_path}"]
        saved = torch.load(avf_qmix.train(avf_qmix.parse_args(flags)) / "best.pt", weights_only=True)
        if saved["return"] == best and saved["success"] == 1:
            return
    pytest.fail(f"the best greedy return of seed {seed} is {saved['return']}, the optimum {best}")
