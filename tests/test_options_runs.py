"""Runs on OptionsEnv that are interrupted and go on."""

import pytest

import avf_vdn
import envs
from envs.options import OptionsEnv
from tests.short_runs import short
from tests.test_options import OPTIONS, Corridor
from tests.test_runs import assert_same_run, interrupted, resume


@pytest.mark.slow
def test_a_run_that_is_resumed_equals_one_that_is_not(tmp_path, monkeypatch):
    """Interrupted in the middle of episodes. The same curves and weights come out."""
    task = dict(make=Corridor, options=OPTIONS, horizon=20)
    monkeypatch.setitem(envs._TASKS, "corridor", (OptionsEnv, task, {}))
    undisturbed = avf_vdn.train(short(avf_vdn, "corridor", tmp_path / "one"))
    args = short(avf_vdn, "corridor", tmp_path / "other", checkpoint_frequency=0.0)
    folder = interrupted(monkeypatch, avf_vdn, args, 177)
    resume(avf_vdn, folder)
    assert_same_run(undisturbed, folder)
