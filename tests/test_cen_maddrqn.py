"""Cen-MADDRQN: joint macro-actions, the conditional argmax, targets, what the team sees, exploration and runs."""

import copy
from itertools import product

import numpy as np
import pytest
import torch

import cen_maddrqn
import envs
from cen_maddrqn import Team, act, over_rows, td_loss, team_batch
from tests.episodes import by_hand, make_args, played, random_windows, step_by_step
from tests.rollouts import windows
from tests.short_runs import check_gradient_steps, check_lambda_and_hysteresis, check_seeds


def test_joint_macro_actions_are_numbered_through():
    """Agents of 2, 4 and 3 macro-actions: 24 joint ones, the last agent's counting fastest, there and back."""
    team = Team([2, 4, 3], 5, 8)
    assert team.parts.tolist() == [list(parts) for parts in product(range(2), range(4), range(3))]
    actions = torch.tensor([*team.parts.tolist(), [-1, -1, -1]])
    assert team.join(actions).tolist() == [*range(24), -1], "-1 before the first"
    assert team.join(actions.reshape(5, 5, 3)).equal(team.join(actions).reshape(5, 5))


def keeping(team, free, running):
    """bool [J]: the joint macro-actions that leave the macro-actions of agents that are not free as they are."""
    return torch.from_numpy((team.parts == running)[:, ~free].all(1))


def record_unmasked(team):
    """A list that fills with what the team's last layer says, [1, M, J], before the mask."""
    said = []
    team.output.register_forward_hook(lambda module, inputs, output: said.append(output.detach()))
    return said


@pytest.mark.parametrize("n_actions", [envs.make("ct-10").n_actions, envs.make("wtd-t1").n_actions, [2, 4, 3]])
def test_conditional_argmax_never_changes_an_ongoing_macro_action(n_actions):
    """Random networks and macro-histories, any set of free agents, everybody and only one of them included."""
    assert np.prod(n_actions) in (1_024, 875, 24)
    torch.manual_seed(0)
    n, rng, team = len(n_actions), np.random.default_rng(0), Team(n_actions, 3, 16)
    said = record_unmasked(team)
    free = np.vstack([np.ones((1, n), bool), np.eye(n, dtype=bool), rng.random((40, n)) < 0.5])
    free[free.sum(1) == 0, 0] = True
    obs, hidden = rng.standard_normal((len(free), n, 3)).astype(np.float32), torch.randn(1, len(free), 16)
    infos = {"macro_done": free, "macro_action": rng.integers(n_actions, size=free.shape)}
    running = infos["macro_action"]
    actions, states = act(team, obs, infos, hidden)
    kept = torch.stack([keeping(team, *row) for row in zip(free, running, strict=True)])
    assert kept.sum(1).tolist() == [np.prod(np.array(n_actions)[row]) for row in free]
    best = said[0][0].masked_fill(~kept, -torch.inf).argmax(1)
    np.testing.assert_array_equal(actions, team.parts[best])
    # without the mask other macro-actions would often be best: the test would see it
    assert (team.parts[said[0][0].argmax(1)] != running)[~free].any()
    for epsilon in (0.5, 1.0):
        actions, same = act(team, obs, infos, hidden, epsilon, rng)
        np.testing.assert_array_equal(actions[~free], running[~free])
        assert (actions >= 0).all() and (actions < n_actions).all()
        torch.testing.assert_close(same, states)
    actions, moved = act(team, obs, infos | {"macro_done": np.zeros_like(free)}, hidden, 1.0, rng)
    np.testing.assert_array_equal(actions, running)
    assert moved.equal(hidden), "the team's history moves when somebody chooses"
    assert not torch.isclose(states, hidden).all(2).any()


def test_explores_as_a_team():
    """With probability epsilon all free agents draw at random, otherwise none does."""
    n_actions, count, epsilon = [2, 4, 3], 20_000, 0.3
    team, rng = Team(n_actions, 1, 4), np.random.default_rng(0)
    team.output.bias.data[0, 0, 17] = 100.0  # 1, 1, 2 is best
    obs, hidden = np.zeros((count, 3, 1), np.float32), torch.zeros(1, count, 4)
    for free in ([True, True, True], [True, False, True]):
        infos = {"macro_done": np.tile(free, (count, 1)), "macro_action": np.tile([0, 1, 0], (count, 1))}
        actions, _ = act(team, obs, infos, hidden, epsilon, rng)
        options = list(product(*(range(n) if f else [1] for n, f in zip(n_actions, free, strict=True))))
        expected = dict.fromkeys(options, epsilon / len(options))
        expected[1, 1, 2] += 1 - epsilon
        drawn, shares = np.unique(actions, axis=0, return_counts=True)
        assert set(map(tuple, drawn.tolist())) == set(options)
        for option, share in zip(drawn.tolist(), shares / count, strict=True):
            assert share == pytest.approx(expected[*option], abs=4 * (expected[*option] / count) ** 0.5)


# In the place of the last layer at rows 0 to 4 of the first episode; columns are joint macro-actions 00, 01, 10, 11.
ONLINE = [[5.0, 1.0, 3.0, 2.0], [90.0, 80.0, 1.0, 6.0], [90.0, 7.0, 80.0, 2.0], [4.0, 5.0, 90.0, 80.0],
          [1.0, 2.0, 9.0, 3.0]]  # fmt: skip
TARGET = [[99.0] * 4, [99.0, 99.0, 99.0, 10.0], [99.0, -4.0, 99.0, 99.0], [99.0, 4.0, 99.0, 99.0],
          [99.0, 99.0, 12.0, 99.0]]  # fmt: skip


@pytest.mark.parametrize("terminated", [False, True])
def test_target_by_hand(terminated):
    """Each row lasts until anybody chooses again: rewards 8, 5, 6, 12, after 1, 2, 1 and 2 steps.

    The best that leaves ongoing macro-actions as they are; others would be better (90). Row 1: agent 0 runs 1, so 10
    (1) or 11 (6), valued 10 by the target. Row 2: agent 1 runs 1, so 01 (7) or 11 (2), valued -4. Row 3: agent 0 runs
    0, so 00 (4) or 01 (5), valued 4. Row 4: all are free, 10 (9), valued 12.

    Targets 8 + 10/2 = 13, 5 - 4/4 = 4, 6 + 4/2 = 8, 12 + 12/4 = 15 or, terminated, 12. Values 3, 6, 7, 4.
    lambda = 1/2: 6 + (4 + 15) / 2 / 2 = 10.75, 5 + (-4 + 10.75) / 2 / 4 = 5.84375, 8 + (10 + 5.84375) / 2 / 2 =
    11.9609375; terminated, 6 + (4 + 12) / 2 / 2 = 10, 5 + (-4 + 10) / 2 / 4 = 5.75, 8 + (10 + 5.75) / 2 / 2 = 11.9375.
    """
    learner, buffer = by_hand(cen_maddrqn, terminated)
    team = learner["agents"]
    batch, other = team_batch(windows(buffer, [0], [0], 4), team), copy.deepcopy(team)
    valid = batch["valid"]
    assert batch["reward"][valid].tolist() == [8.0, 5.0, 6.0, 12.0]
    assert batch["discount"][valid].tolist() == [0.5, 0.25, 0.5, 0.0 if terminated else 0.25]
    team.output.register_forward_hook(lambda *_: torch.tensor([ONLINE]))
    other.output.register_forward_hook(lambda *_: torch.tensor([TARGET]))
    utilities = over_rows(batch, team, other)
    loss, q, target = td_loss(*utilities, batch)
    last = 12.0 if terminated else 15.0
    assert q.tolist() == [3.0, 6.0, 7.0, 4.0] and target.tolist() == [13.0, 4.0, 8.0, last]
    assert loss.item() == pytest.approx((100 + 4 + 1 + (last - 4) ** 2) / 4)
    assert td_loss(*utilities, batch, 0.0, 0.5)[0].item() == pytest.approx((100 + 1 + 1 + (last - 4) ** 2) / 4)
    _, _, target = td_loss(*utilities, batch, 0.5)
    assert target.tolist() == ([11.9375, 5.75, 10.0, 12.0] if terminated else [11.9609375, 5.84375, 10.75, 15.0])


def team_inputs(team, row):
    """What the team sees at a row, spelled out: [1, n * d + n] and [1]."""
    before = -1 if (row.before < 0).any() else np.ravel_multi_index(row.before, team.n_actions)
    return np.concatenate([row.obs.ravel(), row.free], dtype=np.float32)[None], [before]


@pytest.mark.parametrize("env_id", ["wtd-s", "wtd-t1", "bp-10", "ct-10"])
def test_values_and_targets_on_real_play(env_id):
    """Random windows, with other episodes' and windows' ends beside them. Values of all their rows, the one after the
    last included, are those of the network when it is fed with what the team saw, row by row, and those of acting where
    the window begins with the episode. -inf is where a joint macro-action would change an ongoing one, by brute force.
    Targets, also over several rows, are sums over primitive rewards."""
    _, learner, buffer, ended = played(cen_maddrqn, env_id)
    team = learner["agents"]
    target_team, count = copy.deepcopy(team), 24
    for parameter in target_team.parameters():
        parameter.data.add_(0.3 * torch.randn(parameter.shape, generator=torch.Generator().manual_seed(0)))
    samples, spans = random_windows(buffer, ended, count, 7)
    batch = team_batch(samples, team)
    with torch.no_grad():
        utilities = over_rows(batch, team, target_team)
    expected, ongoing, tempting, terminal = {"q": [], 0.0: [], 0.6: []}, 0, 0, 0
    # what is said before the mask; the hooks go with the copies
    team, target_team = copy.deepcopy(team), copy.deepcopy(target_team)
    said = record_unmasked(team), record_unmasked(target_team)
    for b, (episode, begin, end) in enumerate(spans):
        rows = episode.rows[begin : end + 1]
        unmasked = []
        for network, heard in ((team, said[0]), (target_team, said[1])):
            heard.clear()
            step_by_step(network, [team_inputs(team, row) for row in rows], [[True]] * len(rows))
            unmasked.append(torch.stack([output[0, 0] for output in heard]))  # [rows, J]
        kept = torch.stack([keeping(team, row.free, row.actions) for row in rows])
        for got, values in zip(utilities, unmasked, strict=True):
            torch.testing.assert_close(got[b, : len(rows), 0], values.masked_fill(~kept, -torch.inf))
        if begin == 0:
            for k, row in enumerate(rows[:-1]):
                torch.testing.assert_close(utilities[0][b, k, 0], row.values[0])
        best = unmasked[0].masked_fill(~kept, -torch.inf).argmax(1)
        bootstrap = unmasked[1][torch.arange(len(rows)), best].tolist()
        tempting += (best != unmasked[0].argmax(1)).sum()
        for td_lambda in (0.0, 0.6):
            returns = [bootstrap[-1]]
            for k in reversed(range(begin, end)):
                value = (1 - td_lambda) * bootstrap[k + 1 - begin] + td_lambda * returns[-1]
                value = bootstrap[-1] if k + 1 == end else value
                returns.append(episode.reward(k, k + 1, 0.9) + episode.discount(k, k + 1, 0.9) * value)
            expected[td_lambda] += returns[:0:-1]
        for k, row in enumerate(rows[:-1]):
            expected["q"].append(unmasked[0][k, np.ravel_multi_index(row.actions, team.n_actions)])
            ongoing += (~row.free).sum()
        terminal += episode.discount(end - 1, end, 0.9) == 0
    assert ongoing > 50 and tempting > 20 and terminal
    for td_lambda in (0.0, 0.6):
        _, q, target = td_loss(*utilities, batch, td_lambda)
        torch.testing.assert_close(q, torch.stack(expected["q"]))
        np.testing.assert_allclose(target, expected[td_lambda], rtol=1e-4, atol=1e-4)


def test_gradients_reach_everything_and_never_the_target():
    _, learner, buffer, ended = played(cen_maddrqn, "wtd-s")
    team, target = copy.deepcopy(learner["agents"]), copy.deepcopy(learner["agents"])
    batch = team_batch(random_windows(buffer, ended, 24, 7)[0], team)
    td_loss(*over_rows(batch, team, target), batch)[0].backward()
    assert all(parameter.grad.isfinite().all() and parameter.grad.any() for parameter in team.parameters())
    assert all(parameter.grad is None for parameter in target.parameters())


def test_too_many_joint_macro_actions_are_refused_in_one_line(tmp_path):
    with pytest.raises(SystemExit) as stopped:
        cen_maddrqn.train(make_args(cen_maddrqn, "ct-10-primitive", runs_dir=str(tmp_path)))
    assert str(stopped.value) == f"ct-10-primitive has {5**10:,} joint macro-actions, the limit is 32,768"
    assert not any(tmp_path.iterdir()), "nothing was written"


@pytest.mark.parametrize("env_id", ["wtd-s", "bp-10", "ct-10", "wtd-t1"])
def test_a_run_takes_gradient_steps(tmp_path, monkeypatch, env_id):
    assert check_gradient_steps(cen_maddrqn, env_id, tmp_path, monkeypatch, "agents") == (1_200 - 200) // 40


def test_same_seed_same_curve(tmp_path):
    check_seeds(cen_maddrqn, "bp-10", tmp_path, train_frequency=16, window=3)


def test_training_passes_on_what_it_should(tmp_path, monkeypatch):
    check_lambda_and_hysteresis(cen_maddrqn, "td_loss", tmp_path, monkeypatch)
