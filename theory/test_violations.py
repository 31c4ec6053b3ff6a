"""violations.py by hand, and on tiny runs: the literal mixer breaks Mac-IGM on rows that it replays, as shipped not."""

import pytest
import torch

import avf_qplex
from tests.rollouts import TINY, args_for
from theory import violations


def smallest(mask_ongoing):
    """The smallest counterexample of README.md: agent 1 chooses, agent 2 goes on with b; Q_i = (1, 0), and A_2 weighs 3
    if agent 1 takes a, its best, and 1 if b."""

    def mixer(utilities, values, actions, chosen, state):
        values = torch.where(chosen, values, utilities) if mask_ongoing else values
        weight = torch.stack([torch.ones(actions.shape[:-1]), 3.0 - 2 * actions[..., 0]], -1)
        return (values + weight * (utilities - values)).sum(-1)

    batch = {
        "valid": torch.tensor([[True, False]]),
        "chosen": torch.tensor([[[True, False], [True, True]]]),
        "action": torch.tensor([[[0, 1], [0, 0]]]),
        "state": torch.zeros(1, 2, 1),
    }
    utilities = torch.tensor([1.0, 0.0]).expand(1, 2, 2, 2)
    return utilities, mixer, batch


def test_the_smallest_counterexample_is_counted():
    """Q(a, b) = -1 is the local choice, Q(b, b) = 0 the best of the open column."""
    lost, tolerance, ongoing = violations.value_lost(*smallest(False))
    assert lost.tolist() == [1.0] and ongoing.tolist() == [True] and 0 < tolerance < 1e-3
    lost, _, _ = violations.value_lost(*smallest(True))
    assert lost.tolist() == [0.0]


@pytest.mark.parametrize("mask_ongoing", [False, True])
def test_a_run_is_counted(mask_ongoing, monkeypatch):
    """New networks hardly differ: what they lose is little, but more than rounding."""
    monkeypatch.setattr(violations, "TOLERANCE", 2e-6)
    args = args_for(avf_qplex, "wtd-s", mask_ongoing=mask_ongoing, **TINY)
    found, result = violations.count(args, every=5)
    assert found["update"].tolist() == list(range(0, 25, 5)) and -500 < result < 300
    assert (found["rows"] >= found["ongoing"]).all() and (found["ongoing"] > 0).all()
    assert (found["differ"].sum() == 0) == mask_ongoing and (found["lost"].sum() > 0) != mask_ongoing


def test_the_program(monkeypatch, capsys):
    flags = [f"--{key.replace('_', '-')}={value}" for key, value in TINY.items()]
    violations.main(["--seeds", "3-4", "--every", "5", "--parts", "2", "--env=bp-10", "--no-mask-ongoing", *flags])
    lines = [line.split() for line in capsys.readouterr().out.splitlines()[1:]]
    assert [line[0] for line in lines] == ["3"] * 4 + ["4"] * 4
    assert int(lines[0][2]) + int(lines[1][2]) == int(lines[2][2]) and lines[3][1] == "return"
