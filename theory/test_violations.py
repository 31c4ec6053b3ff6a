"""violations.py by hand, and on tiny runs: the literal mixer breaks Mac-IGM on rows that it replays, as shipped not."""

import pytest
import torch

import avf_qplex
from tests.rollouts import TINY, args_for
from theory import violations
from theory.variants import two_by_two

BOTH = [True, True]
# Of an episode with one valid row and a final one: agent 1 chooses there, and agent 2 goes on with b.
BATCH = {
    "valid": torch.tensor([[True, False]]),
    "free": torch.tensor([[[True, False], BOTH]]),
    "available": torch.tensor([[[BOTH, [False, True]], [BOTH, BOTH]]]),
}


@pytest.mark.parametrize(("mask_ongoing", "expected"), [(False, 1.0), (True, 0.0)])
def test_the_smallest_counterexample_is_counted(mask_ongoing, expected):
    """README.md opens with it: Q(a, b) = -1 is the greedy choice, Q(b, b) = 0 the best of the open column."""
    utilities = torch.tensor([1.0, 0.0]).double()
    utilities = utilities.expand(1, 2, 2, 2)
    state = torch.zeros(1, 2, 1).double()
    mixer = two_by_two(mask_ongoing=mask_ongoing)
    lost, tolerance, busy = violations.value_lost(utilities, mixer, state, BATCH)
    assert lost.tolist() == pytest.approx([expected], abs=1e-8)
    assert busy.tolist() == [True]
    assert 0 < tolerance < 1e-3


@pytest.mark.parametrize("mask_ongoing", [False, True])
def test_a_run_is_counted(mask_ongoing, monkeypatch):
    """New networks hardly differ: what they lose is little, but more than rounding."""
    monkeypatch.setattr(violations, "TOLERANCE", 2e-6)
    args = args_for(avf_qplex, "wtd-s", mask_ongoing=mask_ongoing, **TINY)
    found, result = violations.count(args, every=5)
    assert found["update"].tolist() == [0, 5, 10, 15]
    assert -500 < result < 300
    assert (found["rows"] >= found["busy"]).all()
    assert (found["busy"] > 0).all()
    if mask_ongoing:
        assert found["differ"].sum() == 0
        assert found["lost"].sum() == 0
    else:
        assert found["differ"].sum() > 0
        assert found["lost"].sum() > 0


def test_the_program(capsys):
    flags = [f"--{key.replace('_', '-')}={value}" for key, value in TINY.items()]
    command = ["--seeds", "3-4", "--every", "5", "--parts", "2", "--env=bp-10", "--no-mask-ongoing"]
    violations.main([*command, *flags])
    _, *lines = capsys.readouterr().out.splitlines()
    words = [line.split() for line in lines]
    assert [line[0] for line in words] == ["3"] * 4 + ["4"] * 4
    first, second, whole, result = words[:4]
    assert int(first[2]) + int(second[2]) == int(whole[2])
    assert result[1] == "return"
