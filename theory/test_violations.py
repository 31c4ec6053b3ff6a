"""violations.py by hand, and on tiny runs: the literal mixer breaks Mac-IGM on rows that it replays, as shipped not."""

import numpy as np
import pandas as pd
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


def test_valid_rows_are_looked_at_and_a_row_is_busy_if_an_agent_is():
    """Three valid rows: both agents choose, agent 2 goes on, agent 1 goes on; the last row is not valid."""
    free = torch.tensor([[BOTH, [True, False], [False, True], BOTH]])
    batch = {
        "valid": torch.tensor([[True, True, True, False]]),
        "free": free,
        "available": torch.ones(1, 4, 2, 2, dtype=torch.bool),
    }
    utilities = torch.zeros(1, 4, 2, 2).double()
    lost, tolerance, busy = violations.value_lost(utilities, two_by_two(), torch.zeros(1, 4, 1).double(), batch)
    assert len(lost) == len(tolerance) == 3
    assert busy.tolist() == [False, True, True]


def test_the_tally_by_hand():
    """Of five rows three have a busy agent, and at two of these the choices differ: 3 + 1 is lost, scaled by 0.1."""
    lost = torch.tensor([3.0, 1.0, 0.1, 8.0, 0.0])
    busy = torch.tensor([True, True, True, False, False])
    tolerance = torch.full((5,), 0.2)
    line = violations.tally(700, lost, tolerance, busy, reward_scale=0.1)
    assert line == {"update": 700, "rows": 5, "busy": 3, "differ": 2, "lost": pytest.approx(40.0)}


def test_the_share_and_the_mean_by_hand():
    """The table of README.md has these two: of 8 rows with a busy agent 2 differ (25%), where 30 is lost (15 each)."""
    found = pd.DataFrame(
        {"update": [100, 200], "rows": [10, 20], "busy": [3, 5], "differ": [2, 0], "lost": [30.0, 0.0]}
    )
    assert violations.describe(found).split() == ["100", "30", "8", "2", "0.2500", "15.000"]
    assert violations.describe(found[1:]).split() == ["200", "20", "5", "0", "0.0000", "0.000"]


def test_what_a_run_loses_is_in_units_of_unscaled_rewards(monkeypatch):
    """Its mixer loses 2 at each of 3 rows: 6, or 60 as rewards are scaled to a tenth."""

    def loses_2(utilities, mixer, state, batch):
        rows = torch.ones(3)
        return 2 * rows, 0 * rows, rows.bool()

    monkeypatch.setattr(violations, "value_lost", loses_2)
    found, _ = violations.count(args_for(avf_qplex, "bp-10", reward_scale=0.1, **TINY), every=10)
    assert found["lost"].tolist() == pytest.approx([60.0] * len(found))


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


@pytest.mark.parametrize(
    ("command", "says"),
    [
        (["--seeds", "x"], "violations: .*--seeds"),
        (["--seeds", "5-3"], "violations: .*--seeds"),
        (["--every", "0"], "violations: --every and --parts must be at least 1"),
        (["--parts", "-1"], "violations: --every and --parts must be at least 1"),
        (["--env", "nowhere"], "unknown environment 'nowhere'"),
        (["--env", "ct-10-primitive"], "violations: ct-10-primitive has 9,765,625 joint macro-actions"),
        (["--gamma", "2"], "--gamma must be from 0 to 1"),
    ],
)
def test_bad_options_are_refused_in_a_line_before_a_run(monkeypatch, command, says):
    monkeypatch.delattr(violations, "count")
    with pytest.raises(SystemExit, match=says) as refused:
        violations.main(command)
    assert len(str(refused.value).splitlines()) == 1


def test_what_was_found_of_earlier_seeds_is_kept(monkeypatch, capsys):
    def stopped_at_seed_4(args, every):
        if args.seed == 4:
            raise KeyboardInterrupt
        return pd.DataFrame({name: np.ones(2) for name in ("update", "rows", "busy", "differ", "lost")}), 7.0

    monkeypatch.setattr(violations, "count", stopped_at_seed_4)
    with pytest.raises(KeyboardInterrupt):
        violations.main(["--seeds", "3-5"])
    _, *lines = capsys.readouterr().out.splitlines()
    assert [line.split()[0] for line in lines] == ["3"] * 4  # two parts with a line each, the whole run, the return
    assert lines[-1].split() == ["3", "return", "7.0"]


def test_a_run_without_an_update_has_its_return(monkeypatch, capsys):
    monkeypatch.setattr(violations, "count", lambda args, every: (pd.DataFrame([]), 7.0))
    violations.main(["--seeds", "3"])
    assert capsys.readouterr().out.splitlines()[1:] == ["   3  return 7.0"]
