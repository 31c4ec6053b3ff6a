"""Dec-MADDRQN: each agent's returns, by hand and against the primitive rewards; networks over rows; runs."""

import copy
from itertools import pairwise

import numpy as np
import pytest
import torch

import dec_maddrqn
from dec_maddrqn import own_loss, own_returns
from tests.episodes import PLAN, by_hand, own_values, played, random_windows
from tests.rollouts import windows
from tests.short_runs import check_gradient_steps, check_lambda_and_hysteresis, check_seeds

# Utilities of each agent where it last saw (episode, step); the target's are 90 where the online argmax is not.
ONLINE = ({(0, 0): (1.0, 5.0), (0, 3): (18.0, 19.0), (0, 6): (7.0, 1.0), (1, 0): (6.0, 0.0), (1, 1): (0.0, 3.0)},
          {(0, 0): (12.0, 1.0), (0, 1): (3.0, 2.0), (0, 4): (1.0, 30.0), (0, 6): (0.0, 1.0), (1, 0): (0.0, 2.0),
           (1, 1): (5.0, 1.0)})  # fmt: skip
TARGET = ({(0, 3): (90.0, 24.0), (0, 6): (32.0, 90.0), (1, 1): (90.0, 8.0)},
          {(0, 1): (4.0, 90.0), (0, 4): (90.0, 40.0), (0, 6): (90.0, 20.0), (1, 1): (6.0, 90.0)})  # fmt: skip


def table(obs, values):
    """Utilities [B, T, 2, 2]; -90 where the example never looks."""
    find = [[[values[i].get(tuple(x), (-90.0, -90.0)) for i, x in enumerate(row)] for row in rows]
            for rows in obs.int().tolist()]  # fmt: skip
    return torch.tensor(find)


def loss_by_hand(batch, **options):
    """The loss and, agent by agent and then in order of time, values and returns where they count."""
    loss, q, returns, own = own_loss(table(batch["obs"], ONLINE), table(batch["obs"], TARGET), batch, **options)
    own = own.movedim(2, 0)
    return loss.item(), q.movedim(2, 0)[own].tolist(), returns.movedim(2, 0)[own].tolist(), own.tolist()


# of agent 0 and 1, in the first episode's rows 0 to 4 and in the second one's, which is padded
OWN = [[[True, False, True, False, False], [True, False, False, False, False]],
       [[True, True, False, True, False], [True, False, False, False, False]]]  # fmt: skip


def test_returns_by_hand():
    """r_i + gamma^tau_i Q'_i at the online argmax.

    Agent 0: 10.5 + 24/8 = 13.5 at row 0, 12 + 32/8 = 16 at row 2, 3 + 8/2 = 7. Values 5, 18, 6, errors 8.5, -2, 1.
    Agent 1: 8 + 4/2 = 10, 6.5 + 40/8 = 11.5, 12 + 20/4 = 17, 3 + 6/2 = 6. Values 12, 2, 1, 2, errors -2, 9.5, 16, 4.
    """
    batch = windows(by_hand(dec_maddrqn)[1], [0, 1], [0, 0], 4)
    loss, q, returns, own = loss_by_hand(batch)
    assert own == OWN
    assert returns == [13.5, 16.0, 7.0, 10.0, 11.5, 17.0, 6.0]
    assert q == [5.0, 18.0, 6.0, 12.0, 2.0, 1.0, 2.0]
    # means over an agent's own transitions, 3 and 4, summed
    assert loss == pytest.approx((72.25 + 4 + 1) / 3 + (4 + 90.25 + 256 + 16) / 4)
    # the one negative error of each agent is halved
    assert loss_by_hand(batch, hysteresis=0.5)[0] == pytest.approx(74.25 / 3 + 363.25 / 4)


def test_bootstraps_from_a_truncated_end_only():
    """Terminated: 12 at agent 0's row 2, 12 at agent 1's row 3, 3 in the short episode; what is before is as it was."""
    _, _, returns, own = loss_by_hand(windows(by_hand(dec_maddrqn, terminated=True)[1], [0, 1], [0, 0], 4))
    assert own == OWN
    assert returns == [13.5, 12.0, 3.0, 10.0, 11.5, 12.0, 3.0]


def test_lambda_returns_by_hand():
    """lambda = 1/2. Agent 0: 16 at row 2, 10.5 + (24 + 16) / 2 / 8 = 13 at row 0.
    Agent 1: 17 at row 3, 6.5 + (40 + 17) / 2 / 8 = 10.0625 at row 1, 8 + (4 + 10.0625) / 2 / 2 = 11.515625 at row 0."""
    _, _, returns, _ = loss_by_hand(windows(by_hand(dec_maddrqn)[1], [0, 1], [0, 0], 4), td_lambda=0.5)
    assert returns == [13.0, 16.0, 7.0, 11.515625, 10.0625, 17.0, 6.0]


@pytest.mark.parametrize("td_lambda, first", [(0.0, 10.0), (0.5, 11.875)])
def test_leaves_out_what_a_window_cuts(td_lambda, first):
    """Rows 0 to 2: the macro-actions of row 2 (agent 0) and row 3 (agent 1) do not end in the window.
    Rows 1 and 2: agent 0's first began before it, its second ends after it.
    Row 0, by a window that begins before the episode: agent 1's alone.

    lambda = 1/2 in the first: agent 0 keeps 13.5, and agent 1 11.5 at row 1, as no further return is known; at row 0
    it has 8 + (4 + 11.5) / 2 / 2 = 11.875.
    """
    _, buffer = by_hand(dec_maddrqn)
    _, _, returns, own = loss_by_hand(windows(buffer, [0], [0], 3), td_lambda=td_lambda)
    assert own == [[[True, False, False, False]], [[True, True, False, False]]]
    assert returns == [13.5, first, 11.5]
    loss, _, returns, own = loss_by_hand(windows(buffer, [0], [1], 2), td_lambda=td_lambda)
    assert own == [[[False] * 3], [[True, False, False]]] and returns == [11.5]
    assert loss == pytest.approx(9.5**2), "an agent without transitions adds nothing"
    _, _, returns, own = loss_by_hand(windows(buffer, [0], [-2], 3), td_lambda=td_lambda)
    assert own == [[[False] * 4], [[True, False, False, False]]] and returns == [10.0]


@pytest.mark.parametrize("td_lambda", [0.0, 0.5])
@pytest.mark.parametrize("env_id", ["wtd-s", "ct-10", "bp-10"])
def test_returns_are_those_of_the_primitive_rewards(env_id, td_lambda):
    """Real play, random windows: each agent's sum over its own steps, whatever the others do in between."""
    env, _, buffer, ended = played(dec_maddrqn, env_id)
    batch, spans = random_windows(buffer, ended, 60, 9)
    bootstrap = 10 * torch.randn(60, 10, env.n_agents, generator=torch.Generator().manual_seed(0))
    expected, several, terminal = np.full(bootstrap.shape, np.nan), 0, 0
    for b, (episode, begin, end) in enumerate(spans):
        for i in range(env.n_agents):
            chose = [k for k in range(begin, end + 1) if episode.rows[k].free[i]]
            following = None
            for k, until in reversed(list(pairwise(chose))):
                value = bootstrap[b, until - begin, i].item()
                if following is not None:
                    value = (1 - td_lambda) * value + td_lambda * following
                following = episode.reward(k, until, 0.9) + episode.discount(k, until, 0.9) * value
                expected[b, k - begin, i] = following
                several += until > k + 1
                terminal += episode.discount(k, until, 0.9) == 0
    returns, own = own_returns(batch, bootstrap, td_lambda)
    np.testing.assert_array_equal(own, ~np.isnan(expected))
    np.testing.assert_allclose(returns[own], expected[own], rtol=1e-4, atol=1e-4)
    assert several > 20 and terminal > 3


@pytest.mark.parametrize("td_lambda", [0.0, 0.5])
def test_another_agents_splitting_of_a_macro_action_changes_nothing(td_lambda):
    """Agent 1's macro-action of steps 1 to 3 against one of step 1 and one of steps 2 and 3, the same rewards: one more
    row, but agent 0's returns, and the gradients of its network, are what they were."""
    found = []
    for plan in (PLAN, (PLAN[0], {0: 0, 1: 1, 2: 1, 4: 0})):
        learner, buffer = by_hand(dec_maddrqn, plan=plan)
        agents, target = learner["agents"], copy.deepcopy(learner["agents"])
        for parameter in target.parameters():
            parameter.data.add_(torch.randn_like(parameter))
        batch = windows(buffer, [0, 1], [0, 0], 5)
        own_loss(*dec_maddrqn.over_rows(batch, agents, target), batch, td_lambda, 0.4)[0].backward()
        assert all(parameter.grad is None for parameter in target.parameters())
        gradients = [parameter.grad for parameter in agents.parameters()]
        _, _, returns, _ = loss_by_hand(batch, td_lambda=td_lambda)
        found.append((batch["valid"].sum(), returns[:3], gradients))
    (rows, returns, gradients), (more_rows, same_returns, same_gradients) = found
    assert more_rows == rows + 1
    assert returns == same_returns == [13.0 if td_lambda else 13.5, 16.0, 7.0]
    for one, other in zip(gradients, same_gradients, strict=True):
        torch.testing.assert_close(one[0], other[0])
        assert one[0].any() and not torch.allclose(one[1], other[1])


@pytest.mark.parametrize("env_id", ["wtd-s", "ct-10", "bp-10"])
def test_networks_over_rows_say_what_they_said_while_acting(env_id):
    """In windows that begin with an episode; in others, what they say when fed with its rows one by one."""
    _, learner, buffer, ended = played(dec_maddrqn, env_id)
    batch, spans = random_windows(buffer, ended, 20, 9)
    with torch.no_grad():
        (utilities,) = dec_maddrqn.over_rows(batch, learner["agents"])
    for got, span in zip(utilities, spans, strict=True):
        torch.testing.assert_close(got[: span.end - span.begin + 1], own_values(learner["agents"], span))
        if span.begin == 0:
            for k, row in enumerate(span.episode.rows[: span.end]):
                torch.testing.assert_close(got[k, row.free], row.values[row.free])


@pytest.mark.parametrize("env_id", ["wtd-s", "bp-10", "ct-10"])
def test_a_run_takes_gradient_steps(tmp_path, monkeypatch, env_id):
    assert check_gradient_steps(dec_maddrqn, env_id, tmp_path, monkeypatch, "agents") == (1_200 - 200) // 40


def test_same_seed_same_curve(tmp_path):
    check_seeds(dec_maddrqn, "ct-10", tmp_path, train_frequency=16, window=3)


def test_training_passes_on_what_it_should(tmp_path, monkeypatch):
    check_lambda_and_hysteresis(dec_maddrqn, "own_loss", tmp_path, monkeypatch)
