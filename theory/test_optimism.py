"""The predictions of optimism.py for Box Pushing, which docs/defaults.md tells, and what it reads of a trained team."""

import re
from pathlib import Path

import numpy as np
import pytest
import torch

from envs.box_pushing import PUSH
from tests.rollouts import TINY, args_for
from theory import optimism

ROOT = Path(__file__).parents[1]
TOLD = {  # p and the bound
    "bp-10": (0.0063, 0.21),
    "bp-20": (0.0039, 0.17),
    "bp-30": (0.0025, 0.13),
}


@pytest.mark.slow
@pytest.mark.parametrize("env_id", TOLD)
def test_the_page_tells_what_is_counted(env_id):
    p, bound = TOLD[env_id]
    counted, share = optimism.push_beside_random_partner(env_id)
    assert counted == pytest.approx(p, abs=5e-5)
    assert share < 0.3
    found = optimism.bound(counted, optimism.BIG, optimism.FAILS, optimism.SAFE, 0.95)
    assert found == pytest.approx(bound, abs=5e-3)
    page = (ROOT / "docs" / "defaults.md").read_text()
    assert re.search(rf"\b{p}\b.*{bound}", " ".join(page.split()))


def test_the_value_is_a_balance_and_crosses_at_the_bound():
    p = 0.0063
    gamma = 0.95
    big, fails, safe = optimism.BIG, optimism.FAILS, optimism.SAFE
    highest = optimism.bound(p, big, fails, safe, gamma)
    for beta in np.geomspace(0.02, 1, 40):
        e = optimism.value(beta, p, big, fails, safe, gamma)
        assert (e > safe) == (beta < highest)
        after_failing = gamma * max(e, safe) - fails
        assert p * (big - e) == pytest.approx(beta**2 * (1 - p) * (e - after_failing))


def test_the_best_other_macro_action_is_no_push():
    utilities = torch.arange(8.0).expand(2, 8).clone()
    utilities[0, PUSH] = 9.0
    utilities[1, 2] = 8.0
    assert optimism.best_other(utilities).tolist() == [7, 2]


@pytest.mark.slow
@pytest.mark.parametrize("script", optimism.SCRIPTS, ids=lambda script: script.__name__)
def test_what_a_team_has_learned_is_read(tmp_path, script):
    """Values of two choices that are not the same, in units of rewards, not of scaled ones."""
    found = []
    for reward_scale in (0.1, 0.01):
        options = {**TINY, "total_timesteps": 600, "runs_dir": str(tmp_path), "reward_scale": reward_scale}
        found.append(optimism.learned(script, args_for(script, "bp-10", **options)))
    assert np.isfinite(found).all()
    assert found[0][0] != found[0][1]
    assert abs(found[1][0]) > 2 * abs(found[0][0]), "networks say about the same, whatever a reward is scaled to"


def test_the_figure_is_drawn(tmp_path, capsys, monkeypatch):
    """With values that need no training."""
    monkeypatch.setattr(optimism, "learned", lambda script, args: (30.0 * args.hysteresis, 20.0))
    monkeypatch.setattr(optimism, "push_beside_random_partner", lambda env_id: (0.0063, 0.25))
    optimism.main(["--steps", "10", "-o", str(tmp_path / "figure.png")])
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) == 3 + 2 * len(optimism.BETAS)
    assert lines[3].startswith("avf_vdn beta=0.05 push 1.5, predicted ")
    assert (tmp_path / "figure.png").stat().st_size > 10_000
