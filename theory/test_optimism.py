"""The predictions of optimism.py for Box Pushing, which docs/defaults.md tells, and what it reads of a trained team."""

import re
from pathlib import Path

import numpy as np
import pytest

from tests.rollouts import TINY, args_for
from theory import optimism

ROOT = Path(__file__).parents[1]


@pytest.mark.parametrize(
    "env_id, p, bound", [("bp-10", 0.0063, 0.21), ("bp-20", 0.0039, 0.17), ("bp-30", 0.0025, 0.13)]
)
def test_the_page_tells_what_is_counted(env_id, p, bound):
    counted, share = optimism.push_beside_random_partner(env_id)
    assert counted == pytest.approx(p, abs=5e-5) and share < 0.3
    assert optimism.bound(counted, optimism.BIG, optimism.FAILS, 20.0, 0.95) == pytest.approx(bound, abs=5e-3)
    page = " ".join((ROOT / "docs" / "defaults.md").read_text().split())
    assert re.search(rf"\b{p}\b.*{bound}", page)


def test_the_value_is_a_balance_and_crosses_at_the_bound():
    p, gamma = 0.0063, 0.95
    game = optimism.BIG, optimism.FAILS, 20.0
    for beta in np.geomspace(0.02, 1, 40):
        e = optimism.value(beta, p, *game, gamma)
        assert (e > 20) == (beta < optimism.bound(p, *game, gamma))
        short = gamma * max(e, 20) - optimism.FAILS
        assert p * (optimism.BIG - e) == pytest.approx(beta**2 * (1 - p) * (e - short))


@pytest.mark.parametrize("script", [optimism.avf_vdn, optimism.avf_qmix], ids=lambda s: s.__name__)
def test_what_a_team_has_learned_is_read(tmp_path, script):
    """Values of two choices that are not the same, in units of rewards, not of scaled ones."""
    found = [
        optimism.learned(script, args_for(script, "bp-10", runs_dir=str(tmp_path), reward_scale=scale, **TINY))
        for scale in (0.1, 0.01)
    ]
    assert np.isfinite(found).all() and found[0][0] != found[0][1]
    assert abs(found[1][0]) > 2 * abs(found[0][0]), "networks say about the same, whatever a reward is scaled to"
