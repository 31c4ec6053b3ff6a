"""Mac-IAICC: n-step returns, the losses' gradients by hand, soft policies, what critics see, acting, on-policy runs."""

import functools
from math import log
from types import SimpleNamespace

import numpy as np
import pytest
import torch

import mac_iaicc
from mac_iaicc import EpisodeBuffer, act, actor_critic_loss, joint_batch, over_rows, own_returns, soft_policy
from tests.episodes import by_hand, own_values, play, step_by_step, take_all
from tests.rollouts import Spy
from tests.short_runs import SHORT, TAGS, check_gradient_steps, check_seeds, short, watch_play

# V'_i at the rows of the example's first and second episode, [agents, rows]; 99 where the agent does not choose.
VALUES = torch.tensor([[[99.0, 99.0, 24.0, 99.0, 32.0], [99.0, 8.0, 99.0, 99.0, 99.0]],
                       [[99.0, 4.0, 99.0, 40.0, 20.0], [99.0, 6.0, 99.0, 99.0, 99.0]]]).movedim(0, 2)  # fmt: skip


@pytest.mark.parametrize(
    "n_step, terminated, expected",
    [
        # Agent 0: 10.5 + 24/8, 12 + 32/8, 3 + 8/2. Agent 1: 8 + 4/2, 6.5 + 40/8, 12 + 20/4, 3 + 6/2.
        (1, False, [13.5, 16.0, 7.0, 10.0, 11.5, 17.0, 6.0]),
        # 10.5 + 16/8: the episode ends after two. Agent 1: 8 + 11.5/2, 6.5 + 17/8.
        (2, False, [12.5, 16.0, 7.0, 13.75, 8.625, 17.0, 6.0]),
        # Agent 1: 8 + 8.625/2.
        (10, False, [12.5, 16.0, 7.0, 12.3125, 8.625, 17.0, 6.0]),
        # Nothing follows the last ones: 12, 3; 12, 3.
        (1, True, [13.5, 12.0, 3.0, 10.0, 11.5, 12.0, 3.0]),
        # 10.5 + 12/8; 8 + 11.5/2, 6.5 + 12/8.
        (2, True, [12.0, 12.0, 3.0, 13.75, 8.0, 12.0, 3.0]),
        # 8 + 8/2
        (10, True, [12.0, 12.0, 3.0, 12.0, 8.0, 12.0, 3.0]),
    ],
)
def test_n_step_returns_by_hand(n_step, terminated, expected):
    batch = by_hand(mac_iaicc, terminated)[1].take()
    own = (batch["chosen"] & batch["valid"][..., None]).movedim(2, 0)
    assert own.tolist() == [[[True, False, True, False, False], [True, False, False, False, False]],
                            [[True, True, False, True, False], [True, False, False, False, False]]]  # fmt: skip
    assert own_returns(batch, VALUES, n_step).movedim(2, 0)[own].tolist() == expected


@pytest.mark.parametrize("env_id", ["wtd-s", "ct-10", "bp-10"])
def test_returns_are_those_of_the_primitive_rewards(env_id):
    """Real play: from the first step of a macro-action to the first after the agent's n-th, or to the episode's end."""
    env, _, buffer, ended = play(mac_iaicc, env_id)
    batch, spans = take_all(buffer, ended)
    values = 10 * torch.randn(*batch["chosen"].shape, generator=torch.Generator().manual_seed(0))
    for n_step in (1, 3, 1_000):
        expected = np.full(values.shape, np.nan)
        for b, (episode, _, end) in enumerate(spans):
            for i in range(env.n_agents):
                own = [k for k in range(end + 1) if episode.rows[k].free[i]]
                for number, k in enumerate(own[:-1]):
                    until = own[min(number + n_step, len(own) - 1)]
                    bootstrap = episode.discount(k, until, 0.9) * values[b, until, i].item()
                    expected[b, k, i] = episode.reward(k, until, 0.9) + bootstrap
        own = batch["chosen"] & batch["valid"][..., None]
        np.testing.assert_array_equal(own, ~np.isnan(expected))
        np.testing.assert_allclose(own_returns(batch, values, n_step)[own], expected[own], rtol=1e-4, atol=1e-4)


def test_gradients_by_hand():
    """Softmax (3/4, 1/4) everywhere and epsilon 0.2 give the policy (0.7, 0.3), whose slope in its own logit is
    0.8 * 3/4 * 1/4 = 0.15: grad log pi(0) = 0.15 / 0.7 (1, -1), grad log pi(1) = 0.5 (-1, 1).

    Returns (n = 1) minus values: agent 0, that chose 1 and 0: 13.5 - 11.5 = 2, 16 - 20 = -4; two decisions.
    Agent 1, that chose 0, 1 and 0: 10 - 7 = 3, 11.5 - 14.5 = -3, 17 - 17 = 0; three decisions.
    """
    batch = {key: value[:1] for key, value in by_hand(mac_iaicc)[1].take().items()}
    logits = torch.tensor([log(3), 0.0]).expand(1, 5, 2, 2).clone().requires_grad_()
    # 1000 where an agent is ongoing and at the end: no loss there
    values = torch.tensor([[[11.5, 7.0], [1e3, 14.5], [20.0, 1e3], [1e3, 17.0], [1e3, 1e3]]], requires_grad=True)
    returns = own_returns(batch, VALUES[:1], 1)

    def losses(coefficient):
        return actor_critic_loss(soft_policy(logits, 0.2), values, returns, batch, coefficient)

    loss, actor, critic, entropy = losses(0.0)
    (slopes,) = torch.autograd.grad(loss, logits, retain_graph=True)
    score = [0.15 / 0.7, -0.5]  # of logit 0, macro-action 0 or 1 being taken; that of logit 1 is the opposite
    expected = torch.tensor([[-2 * score[1] / 2, 0, 4 * score[0] / 2, 0, 0],
                             [-3 * score[0] / 3, 3 * score[1] / 3, 0, 0, 0]]).T[None]  # fmt: skip
    torch.testing.assert_close(slopes, torch.stack([expected, -expected], 3))
    assert actor.item() == pytest.approx(-(2 * log(0.3) - 4 * log(0.7)) / 2 - (3 * log(0.7) - 3 * log(0.3)) / 3)
    assert critic.item() == pytest.approx((4 + 16) / 2 + (9 + 9) / 3)
    assert loss.item() == pytest.approx(actor.item() + critic.item())
    (slopes,) = torch.autograd.grad(loss, values, retain_graph=True)  # -2 (G - V) / decisions
    assert slopes.tolist() == [[[-2.0, -2.0], [0.0, 2.0], [4.0, 0.0], [0.0, 0.0], [0.0, 0.0]]]
    assert torch.autograd.grad(actor, values, allow_unused=True, retain_graph=True) == (None,)
    assert torch.autograd.grad(critic, logits, allow_unused=True) == (None,)

    # The entropy of (0.7, 0.3), subtracted: its slope in logit 0 is -0.15 log(0.7 / 0.3).
    uncertainty = -0.7 * log(0.7) - 0.3 * log(0.3)
    assert entropy.item() == pytest.approx(uncertainty)
    with_entropy = losses(2.0)[0]
    assert with_entropy.item() == pytest.approx(loss.item() - 2.0 * 2 * uncertainty)
    (slopes,) = torch.autograd.grad(with_entropy - losses(0.0)[0], logits)
    slope = 2.0 * 0.15 * log(0.7 / 0.3)
    expected = torch.tensor([[slope / 2, 0, slope / 2, 0, 0], [slope / 3, slope / 3, 0, slope / 3, 0]]).T[None]
    torch.testing.assert_close(slopes, torch.stack([expected, -expected], 3))


def test_gradients_stay_with_their_networks():
    """Actors learn from the actors' loss, critics from the critics', each agent's from its own decisions."""
    env, learner, buffer, ended = play(mac_iaicc, "wtd-s", 4)
    batch, _ = take_all(buffer, ended)
    values = over_rows(joint_batch(batch, max(env.n_actions)), learner["critics"])[0][..., 0]
    policy = soft_policy(over_rows(batch, learner["agents"])[0], 0.1)
    returns = own_returns(batch, values.detach() + 1, 5)
    _, actor, critic, _ = actor_critic_loss(policy, values, returns, batch, 0.0)
    for part, own, other in ((actor, "agents", "critics"), (critic, "critics", "agents")):
        learner.zero_grad()
        part.backward(retain_graph=True)
        assert all(parameter.grad is None for parameter in learner[other].parameters())
        assert all(parameter.grad.flatten(1).any(1).all() for parameter in learner[own].parameters())
    learner.zero_grad()
    only = batch | {"chosen": batch["chosen"] & (torch.arange(env.n_agents) == 0)}
    actor_critic_loss(policy, values, returns, only, 0.1)[0].backward()
    for name, parameter in learner.named_parameters():
        assert parameter.grad[0].any() and parameter.grad.isfinite().all() and not parameter.grad[1:].any(), name


def test_soft_policy():
    """Sums to 1, leaves out padding macro-actions, and gives each other one at least epsilon / |A_i|."""
    torch.manual_seed(0)
    n_actions, logits = [2, 4, 3], 10 * torch.randn(50, 3, 4)
    for agent, n in enumerate(n_actions):
        logits[:, agent, n:] = -torch.inf
    for epsilon in (0.0, 0.3, 1.0):
        policy = soft_policy(logits, epsilon)
        torch.testing.assert_close(policy.sum(2), torch.ones(50, 3))
        for agent, n in enumerate(n_actions):
            assert not policy[:, agent, n:].any()
            assert (policy[:, agent, :n] >= epsilon / n - 1e-6).all()
            softmax = torch.exp(logits[:, agent, :n]) / torch.exp(logits[:, agent, :n]).sum(1, keepdim=True)
            torch.testing.assert_close(policy[:, agent, :n], (1 - epsilon) * softmax + epsilon / n)


def test_acting():
    """Macro-actions are drawn from the epsilon-soft policy, greedily without a generator; ongoing agents go on."""
    torch.manual_seed(0)
    count, rng = 20_000, np.random.default_rng(0)
    agents = mac_iaicc.Agents([2, 4], 3, 8)
    agents.output.weight.data[:] = 0.0
    agents.output.bias.data[:, 0] = torch.tensor([[0.5, 1.0, 99.0, 99.0], [1.0, -1.0, 2.0, 0.0]])  # 99: padding
    obs, hidden = rng.random((count, 2, 3), np.float32), torch.randn(2, count, 8)
    free = rng.random((count, 2)) < 0.7
    infos = {"macro_done": free, "macro_action": np.ones((count, 2), int)}
    actions, moved = act(agents, obs, infos, hidden, 0.2, rng)
    assert (actions[~free] == 1).all()
    np.testing.assert_array_equal((moved == hidden).all(2).T, ~free)
    for agent, logits in enumerate(([0.5, 1.0], [1.0, -1.0, 2.0, 0.0])):
        expected = 0.8 * np.exp(logits) / np.exp(logits).sum() + 0.2 / len(logits)
        shares = np.bincount(actions[free[:, agent], agent], minlength=len(logits)) / free[:, agent].sum()
        assert shares == pytest.approx(expected, abs=0.015)
    # agents draw independently: agent 0's shares do not depend on what agent 1 draws
    together = actions[free.all(1)]
    for drawn in range(4):
        first = together[together[:, 1] == drawn, 0]
        sigma = 0.5 / len(first) ** 0.5
        assert first.mean() == pytest.approx(0.8 / (1 + np.exp(-0.5)) + 0.1, abs=4 * sigma)
    greedy, same = act(agents, obs, infos, hidden)
    assert (greedy == np.where(free, [1, 2], 1)).all()
    torch.testing.assert_close(same, moved)
    # no number that a generator gives reaches the padding
    for number, first, second in ((0.0, 0, 0), (np.nextafter(1.0, 0.0), 1, 3)):
        always = SimpleNamespace(random=functools.partial(np.full, fill_value=number))
        actions, _ = act(agents, obs, infos, hidden, 0.0, always)
        assert (actions == np.where(free, [first, second], 1)).all()


def critic_inputs(row, width):
    """What the critics of n agents see at a row, spelled out: [n, n * (d + 1 + width)] and [n]."""
    seen = []
    for obs, free, before in zip(row.obs, row.free, row.before, strict=True):
        seen += [*obs, float(free), *(float(before == action) for action in range(width))]
    n = len(row.obs)
    return np.tile(np.array(seen, np.float32), (n, 1)), [-1] * n


@pytest.mark.parametrize("env_id", ["wtd-s", "ct-10", "bp-10"])
def test_critics_see_the_joint_history_and_actors_their_own(env_id):
    """Whole episodes of different lengths. Values at all rows, the final one included, are those of the critics when
    they are fed with what all agents saw, row by row; and actors say what they said while acting."""
    env, learner, buffer, ended = play(mac_iaicc, env_id)
    batch, spans = take_all(buffer, ended)
    assert len({span.end for span in spans}) > 2 or env_id == "ct-10", "somebody chooses at every step there"
    width, ongoing = max(env.n_actions), 0
    with torch.no_grad():
        (values,) = over_rows(joint_batch(batch, width), learner["critics"])
        (logits,) = over_rows(batch, learner["agents"])
    for value, logit, span in zip(values, logits, spans, strict=True):
        rows = span.episode.rows
        inputs, moves = [critic_inputs(row, width) for row in rows], np.ones((len(rows), env.n_agents), bool)
        torch.testing.assert_close(value[: len(rows)], step_by_step(learner["critics"], inputs, moves))
        torch.testing.assert_close(logit[: len(rows)], own_values(learner["agents"], span))
        for k, row in enumerate(rows[:-1]):
            torch.testing.assert_close(logit[k, row.free], row.values[row.free])
            ongoing += (~row.free).sum()
    assert ongoing > 50


def test_episodes_are_learned_from_once(tmp_path, monkeypatch):
    """Whole episodes, at least batch_size of them, and then they are forgotten; returns carry no gradient; the policy
    is as soft as it acts; n and the entropy's weight are passed on."""
    acted = watch_play(mac_iaicc, EpisodeBuffer, monkeypatch, 0.9, 0.5)
    returns, losses = (Spy(monkeypatch, mac_iaicc, name) for name in ("own_returns", "actor_critic_loss"))
    ended, learned, buffers, take, step = [], [], set(), EpisodeBuffer.take, EpisodeBuffer.step

    def spy_take(self, *args):
        buffers.add(self)
        waiting = np.sort(self.rows[self.queue])
        batch = take(self, *args)
        assert not self.rows[self.queue].any(), "forgotten"
        assert np.sort(batch["valid"].sum(1) + 1).tolist() == waiting[waiting > 0].tolist(), "whole"
        learned.append(len(batch["valid"]))
        return batch

    def spy_step(self, rewards, discounts, over, *args):
        ended.append(over.sum())
        step(self, rewards, discounts, over, *args)

    def spy_policy(logits, epsilon):
        assert epsilon == acted[-1] or not logits.requires_grad
        return soft_policy(logits, epsilon)

    monkeypatch.setattr(EpisodeBuffer, "take", spy_take)
    monkeypatch.setattr(EpisodeBuffer, "step", spy_step)
    monkeypatch.setattr(mac_iaicc, "soft_policy", spy_policy)
    options = dict(n_step=3, entropy_coef=0.2, start_e=0.9, end_e=0.1, exploration_timesteps=1_000)
    options |= dict(gamma=0.9, reward_scale=0.5)
    mac_iaicc.train(short(mac_iaicc, "bp-10", tmp_path, **options))
    (buffer,) = buffers
    left = np.count_nonzero(buffer.rows[buffer.queue])
    assert len(learned) > 3 and min(learned) >= SHORT["batch_size"] > left
    assert sum(learned) + left == sum(ended), "none twice, none lost"
    assert {(call.n_step, call.values.requires_grad) for call in returns.calls} == {(3, False)}
    for call in losses.calls:
        assert call.policy.requires_grad and call.values.requires_grad and not call.returns.requires_grad
        assert call.entropy_coef == 0.2
    assert acted[0] == 0.9 and acted[125] == pytest.approx(0.5) and max(acted[250:]) == pytest.approx(0.1)


@pytest.mark.parametrize("env_id", ["wtd-s", "bp-10", "ct-10"])
def test_a_run_takes_gradient_steps_and_target_critics_follow(tmp_path, monkeypatch, env_id):
    assert check_gradient_steps(mac_iaicc, env_id, tmp_path, monkeypatch, "critics", learning_rate=0.01) >= 2


def test_same_seed_same_curve(tmp_path):
    check_seeds(mac_iaicc, "bp-10", tmp_path, TAGS | {"losses/actor_loss", "losses/entropy"}, batch_size=1)
