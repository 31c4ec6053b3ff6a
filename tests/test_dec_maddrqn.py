"""Dec-MADDRQN: each agent's returns, by hand and against the primitive rewards; networks at rows; runs."""

import copy
from itertools import pairwise
from types import SimpleNamespace

import pytest
import torch

import dec_maddrqn
from dec_maddrqn import own_loss, own_returns, utilities_at_rows
from tests.episodes import BY_HAND, PLAN, by_hand, make_args, own_decisions, played, said_at_rows
from tests.short_runs import check_gradient_steps, check_schedules, check_seeds

# Utilities of each agent where it last saw (episode, time). The target networks say 90 where the online ones do not
# have their argmax. At (0, 3) the online argmax of agent 0 is 1, but it can only start 0.
ONLINE = (
    {(0, 0): (1, 5), (0, 3): (18, 19), (0, 6): (7, 1), (1, 0): (6, 0), (1, 1): (0, 3)},
    {(0, 0): (12, 1), (0, 1): (3, 2), (0, 4): (1, 30), (0, 6): (0, 1), (1, 0): (0, 2), (1, 1): (5, 1)},
)
TARGET = (
    {(0, 3): (24, 90), (0, 6): (32, 90), (1, 1): (90, 8)},
    {(0, 1): (4, 90), (0, 4): (90, 40), (0, 6): (90, 20), (1, 1): (6, 90)},
)


def table(obs, values):
    """Utilities [B, T, 2, 2]; -90 where the example never looks."""
    rows = [[[values[i].get(tuple(x), (-90, -90)) for i, x in enumerate(row)] for row in rows] for rows in obs.tolist()]
    return torch.tensor(rows, dtype=torch.float32)


def loss_by_hand(batch, td_lambda=0.0, hysteresis=1.0):
    """The loss, and values and returns as lists: row by row, and in a row agent 0 before agent 1."""
    args = SimpleNamespace(td_lambda=td_lambda)
    loss, q, returns = own_loss(table(batch["obs"], ONLINE), table(batch["obs"], TARGET), batch, args, hysteresis)
    return loss.item(), q.tolist(), returns.tolist()


def test_own_transitions_by_hand():
    """An agent's return is r_i + gamma^tau_i Q'_i, at the argmax of the online network over what is available.

    Agent 0: 10.5 + 24/8 = 13.5 at row 0, 12 + 32/8 = 16 at row 2, 3 + 8/2 = 7. Values 5, 18, 6, errors 8.5, -2, 1.
    Agent 1: 8 + 4/2 = 10, 6.5 + 40/8 = 11.5, 12 + 20/4 = 17, 3 + 6/2 = 6. Values 12, 2, 1, 2, errors -2, 9.5, 16, 4.
    """
    batch = by_hand(dec_maddrqn)
    loss, q, returns = loss_by_hand(batch)
    assert returns == [13.5, 10.0, 11.5, 16.0, 17.0, 7.0, 6.0]
    assert q == [5.0, 12.0, 2.0, 18.0, 1.0, 6.0, 2.0]
    # The loss is a sum over agents of means over an agent's own transitions, 3 and 4.
    assert loss == pytest.approx((72.25 + 4 + 1) / 3 + (4 + 90.25 + 256 + 16) / 4)
    # Hysteresis halves the one negative error of each agent.
    assert loss_by_hand(batch, hysteresis=0.5)[0] == pytest.approx((72.25 + 1 + 1) / 3 + (1 + 90.25 + 256 + 16) / 4)


def test_a_terminated_episode_has_no_bootstrap_at_its_end():
    """12 at agent 0's row 2, 12 at agent 1's row 3, 3 in the short episode; what is before is as it was."""
    _, _, returns = loss_by_hand(by_hand(dec_maddrqn, terminated=True))
    assert returns == [13.5, 10.0, 11.5, 12.0, 12.0, 3.0, 3.0]


def test_lambda_returns_by_hand():
    """lambda = 1/2, over the agents' own macro-actions.

    Agent 0: 16 at row 2, 10.5 + (24 + 16) / 2 / 8 = 13 at row 0.
    Agent 1: 17 at row 3, 6.5 + (40 + 17) / 2 / 8 = 10.0625 at row 1, 8 + (4 + 10.0625) / 2 / 2 = 11.515625 at row 0.
    """
    _, _, returns = loss_by_hand(by_hand(dec_maddrqn), td_lambda=0.5)
    assert returns == [13.0, 11.515625, 10.0625, 16.0, 17.0, 7.0, 6.0]


@pytest.mark.parametrize("td_lambda", [0.0, 0.6])
@pytest.mark.parametrize("env_id", ["wtd-s", "ct-10", "bp-10"])
def test_returns_are_those_of_the_primitive_rewards(env_id, td_lambda):
    """On real play a return sums up the agent's own steps, whatever the others do in between."""
    env, _, batch, ended = played(dec_maddrqn, env_id)
    bootstrap = 10 * torch.randn(batch["free"].shape, generator=torch.Generator().manual_seed(0))
    returns = own_returns(bootstrap, batch, td_lambda)
    lasting = 0  # macro-actions during which others chose
    for b, episode in enumerate(ended):
        for i in range(env.n_agents):
            expected = bootstrap[b, len(episode.rows) - 1, i].item()
            for k, until in reversed(list(pairwise(own_decisions(episode, i)))):
                is_last = until == len(episode.rows) - 1
                weight = 0.0 if is_last else td_lambda
                later = (1 - weight) * bootstrap[b, until, i].item() + weight * expected
                expected = episode.reward(k, until, 0.9) + episode.discount(k, until, 0.9) * later
                assert returns[b, k, i].item() == pytest.approx(expected, rel=1e-4, abs=1e-4)
                lasting += until > k + 1
    assert lasting > 20


@pytest.mark.parametrize("td_lambda", [0.0, 0.5])
def test_what_another_agent_starts_in_between_changes_nothing(td_lambda):
    """Agent 1's macro-action of times 1 to 3 becomes two, with the same rewards.

    There is one more row, but agent 0's returns, and the gradients of its network, are what they were.
    """
    torch.manual_seed(0)
    agents = dec_maddrqn.make_learner(make_args(dec_maddrqn, "wtd-s"), BY_HAND)["agents"]
    target = copy.deepcopy(agents)
    for parameter in target.parameters():
        parameter.data.add_(torch.randn_like(parameter))
    found = []
    for plan in (PLAN, (PLAN[0], {0: 0, 1: 1, 2: 1, 4: 0})):
        batch = by_hand(dec_maddrqn, plan=plan)
        agents.zero_grad()
        utilities = utilities_at_rows(agents, batch)
        args = SimpleNamespace(td_lambda=td_lambda)
        own_loss(utilities, utilities_at_rows(target, batch), batch, args, 0.4)[0].backward()
        assert all(parameter.grad is None for parameter in target.parameters())
        gradients = [parameter.grad.clone() for parameter in agents.parameters()]
        _, _, returns = loss_by_hand(batch, td_lambda)
        found.append((batch["valid"].sum(), returns, gradients))
    (rows, returns, gradients), (more_rows, more_returns, more_gradients) = found
    assert more_rows == rows + 1 and len(more_returns) == len(returns) + 1
    assert [returns[0], returns[3]] == [more_returns[0], more_returns[4]] == [13.0 if td_lambda else 13.5, 16.0]
    for one, other in zip(gradients, more_gradients, strict=True):
        torch.testing.assert_close(one[0], other[0])
        assert one[0].any() and not torch.allclose(one[1], other[1])


@pytest.mark.parametrize("env_id", ["wtd-s", "ct-10", "bp-10"])
def test_networks_say_at_rows_what_they_said_while_acting(env_id):
    """An agent's history moves where it chooses. The final row is included, at which all agents are free."""
    _, learner, batch, ended = played(dec_maddrqn, env_id)
    with torch.no_grad():
        utilities = utilities_at_rows(learner["agents"], batch)
    for got, episode in zip(utilities, ended, strict=True):
        torch.testing.assert_close(got[: len(episode.rows)], said_at_rows(episode))


@pytest.mark.parametrize("env_id", ["wtd-s", "ct-10"])
def test_a_run_takes_gradient_steps(tmp_path, monkeypatch, env_id):
    assert check_gradient_steps(dec_maddrqn, env_id, tmp_path, monkeypatch) == (1_200 - 200) // 40


@pytest.mark.slow
def test_same_seed_same_curve(tmp_path, monkeypatch):
    check_seeds(dec_maddrqn, "bp-10", tmp_path, monkeypatch, train_frequency=16)


def test_training_passes_on_what_it_should(tmp_path, monkeypatch):
    check_schedules(dec_maddrqn, "own_loss", tmp_path, monkeypatch)
