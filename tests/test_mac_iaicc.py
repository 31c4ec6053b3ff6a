"""Mac-IAICC: n-step returns, losses and gradients by hand, soft policies, the critics' history, on-policy runs."""

import copy
import functools
from math import log
from types import SimpleNamespace

import numpy as np
import pytest
import torch

import mac_iaicc
from mac_iaicc import EpisodeBuffer, act, actor_critic_loss, logits_at_rows, own_returns, soft_policy
from tests.episodes import by_hand, own_decisions, play, said_at_rows
from tests.short_runs import (
    SHORT,
    check_gradient_steps,
    check_seeds,
    cut_episodes,
    short,
    watch_learning_rate,
    watch_play,
)

# V'_i of agents 0 and 1 at the rows of the example's two episodes, [2, 5, 2]. It is 99 where agent i does not choose.
VALUES = torch.tensor(
    [
        [[99, 99], [99, 4], [24, 99], [99, 40], [32, 20]],
        [[99, 99], [8, 6], [99, 99], [99, 99], [99, 99]],
    ],
).float()


@pytest.mark.parametrize(
    ("n_step", "terminated", "of_agent_0", "of_agent_1"),
    [
        # One macro-action. Agent 0: 10.5 + 24/8, 12 + 32/8, 3 + 8/2. Agent 1: 8 + 4/2, 6.5 + 40/8, 12 + 20/4, 3 + 6/2.
        (1, False, [13.5, 16.0, 7.0], [10.0, 11.5, 17.0, 6.0]),
        # Two. Agent 0: 10.5 + 16/8, and then the episode ends. Agent 1: 8 + 11.5/2, 6.5 + 17/8.
        (2, False, [12.5, 16.0, 7.0], [13.75, 8.625, 17.0, 6.0]),
        # Up to ten. Agent 1: 8 + 8.625/2.
        (10, False, [12.5, 16.0, 7.0], [12.3125, 8.625, 17.0, 6.0]),
        # Nothing follows the last ones: 12, 3; 12, 3.
        (1, True, [13.5, 12.0, 3.0], [10.0, 11.5, 12.0, 3.0]),
        # Agent 0: 10.5 + 12/8. Agent 1: 8 + 11.5/2, 6.5 + 12/8.
        (2, True, [12.0, 12.0, 3.0], [13.75, 8.0, 12.0, 3.0]),
        # Agent 1: 8 + 8/2.
        (10, True, [12.0, 12.0, 3.0], [12.0, 8.0, 12.0, 3.0]),
    ],
)
def test_n_step_returns_by_hand(n_step, terminated, of_agent_0, of_agent_1):
    batch = by_hand(mac_iaicc, terminated)
    returns = own_returns(VALUES, batch, n_step)
    own = batch["free"] & batch["valid"][..., None]
    for agent, expected in enumerate((of_agent_0, of_agent_1)):
        assert returns[..., agent][own[..., agent]].tolist() == expected


@pytest.mark.parametrize("env_id", ["wtd-s", "ct-10", "bp-10"])
def test_returns_are_those_of_the_primitive_rewards(env_id):
    """Real play: from the first step of a macro-action to the agent's n-th choice after it, or to the end."""
    env, _, batch, ended = play(mac_iaicc, env_id)
    values = 10 * torch.randn(batch["free"].shape, generator=torch.Generator().manual_seed(0))
    for n_step in (1, 3, 1_000):
        returns = own_returns(values, batch, n_step)
        for b, episode in enumerate(ended):
            for i in range(env.n_agents):
                own = own_decisions(episode, i)
                for number, k in enumerate(own[:-1]):
                    until = own[min(number + n_step, len(own) - 1)]
                    bootstrap = episode.discount(k, until, 0.9) * values[b, until, i].item()
                    expected = episode.reward(k, until, 0.9) + bootstrap
                    assert returns[b, k, i].item() == pytest.approx(expected, rel=1e-4, abs=1e-4)


def test_losses_and_gradients_by_hand():
    """Softmax (3/4, 1/4) where both can start and epsilon 0.2 give the policy (0.7, 0.3). Its slope in its own logit is
    0.8 * 3/4 * 1/4 = 0.15: grad log pi(0) = 0.15 / 0.7 (1, -1), grad log pi(1) = 0.5 (-1, 1).

    Returns (n = 1) minus values. Agent 0 chose 1 and 0, the second time without an alternative: 13.5 - 11.5 = 2,
    16 - 20 = -4; two decisions. Agent 1 chose 0, 1 and 0: 10 - 7 = 3, 11.5 - 14.5 = -3, 17 - 17 = 0; three decisions.
    """
    batch = {name: value[:1] for name, value in by_hand(mac_iaicc).items()}
    logits = torch.tensor([log(3), 0.0]).expand(1, 5, 2, 2).clone().requires_grad_()
    # The values are 1000 where an agent is busy and at the end: there is no loss there.
    values = torch.tensor([[[11.5, 7.0], [1e3, 14.5], [20.0, 1e3], [1e3, 17.0], [1e3, 1e3]]], requires_grad=True)
    returns = own_returns(VALUES[:1], batch, 1)

    def losses(entropy_coef=0.0, hysteresis=1.0):
        policy = soft_policy(logits, batch["available"], 0.2)
        return actor_critic_loss(policy, values, returns, batch, entropy_coef, hysteresis)

    def slopes(loss, inputs):
        return torch.autograd.grad(loss, inputs, retain_graph=True)[0]

    loss, actor, critic, entropy = losses()
    score = [0.15 / 0.7, -0.5]  # slope of log pi in logit 0, if 0 or 1 was taken; that in logit 1 is the opposite
    expected = [[-2 * score[1] / 2, -3 * score[0] / 3], [0, 3 * score[1] / 3], [0, 0], [0, 0], [0, 0]]
    expected = torch.tensor([expected])
    torch.testing.assert_close(slopes(loss, logits), torch.stack([expected, -expected], 3))
    assert actor.item() == pytest.approx(-2 * log(0.3) / 2 - (3 * log(0.7) - 3 * log(0.3)) / 3)
    assert critic.item() == pytest.approx((4 + 16) / 2 + (9 + 9) / 3)
    assert loss.item() == pytest.approx(actor.item() + critic.item())
    assert slopes(loss, values).tolist() == [[[-2, -2], [0, 2], [4, 0], [0, 0], [0, 0]]], "-2 (G - V) / decisions"
    assert not slopes(actor, values).any() and not slopes(critic, logits).any()

    # Hysteresis halves the negative errors of critics, one of each agent, and no advantage of an actor.
    _, same_actor, careful_critic, _ = losses(hysteresis=0.5)
    assert careful_critic.item() == pytest.approx((4 + 4) / 2 + (9 + 2.25) / 3)
    assert same_actor.item() == actor.item()

    # The entropy of (0.7, 0.3) is subtracted. Its slope in logit 0 is -0.15 log(0.7 / 0.3).
    uncertainty = -0.7 * log(0.7) - 0.3 * log(0.3)
    assert entropy.item() == pytest.approx(uncertainty / 2 + uncertainty)
    with_entropy = losses(entropy_coef=2.0)[0]
    assert with_entropy.item() == pytest.approx(loss.item() - 2.0 * 1.5 * uncertainty)
    slope = 2.0 * 0.15 * log(0.7 / 0.3)
    expected = torch.tensor([[[slope / 2, slope / 3], [0, slope / 3], [0, 0], [0, slope / 3], [0, 0]]])
    torch.testing.assert_close(slopes(with_entropy - losses()[0], logits), torch.stack([expected, -expected], 3))


def test_gradients_stay_with_their_networks():
    """Actors learn from the actors' loss, critics from the critics', and no agent's networks from another's outputs."""
    _, learner, batch, _ = play(mac_iaicc, "wtd-s", 4)

    def gradients(loss, part):
        learner.zero_grad(set_to_none=False)
        loss.backward(retain_graph=True)
        return [parameter.grad.flatten(1).any(1) for parameter in learner[part].parameters()]  # bool [n] each

    logits, values = logits_at_rows(learner["agents"], batch), learner["critics"](batch)
    policy = soft_policy(logits, batch["available"], 0.1)
    (logits.sum() + values.sum()).backward(retain_graph=True)  # from here on all have gradients, perhaps zeros
    _, actor, critic, _ = actor_critic_loss(policy, values, values.detach() + 1, batch, 0.0)
    assert all(moved.all() for moved in gradients(actor, "agents"))
    assert not any(moved.any() for moved in gradients(actor, "critics"))
    assert all(moved.all() for moved in gradients(critic, "critics"))
    assert not any(moved.any() for moved in gradients(critic, "agents"))
    for output, part in ((logits[:, :, 0].sum(), "agents"), (values[:, :, 0].sum(), "critics")):
        assert all(moved.tolist() == [True, False, False] for moved in gradients(output, part))


def test_soft_policy():
    """It sums to 1, leaves out what is not available, and gives the rest at least epsilon over their number."""
    torch.manual_seed(0)
    logits = 10 * torch.randn(50, 3, 4)
    available = torch.tensor([[True, True, False, False], [True, True, True, True], [False, True, False, False]])
    for epsilon in (0.0, 0.3, 1.0):
        policy = soft_policy(logits, available, epsilon)
        for agent, own in enumerate(available):
            exponentials = logits[:, agent, own].exp()
            softmax = exponentials / exponentials.sum(1, keepdim=True)
            torch.testing.assert_close(policy[:, agent, own], (1 - epsilon) * softmax + epsilon / own.sum())
            assert not policy[:, agent, ~own].any()
        assert (policy[:, 2, 1] == 1).all(), "a busy agent goes on with probability 1"


def test_acting():
    """Macro-actions are drawn from the epsilon-soft policy, greedily without a generator; busy agents go on."""
    torch.manual_seed(0)
    count = 20_000
    rng = np.random.default_rng(0)
    agents = mac_iaicc.Agents(2, 4, 3, 8)
    agents.output.weight.data[:] = 0.0
    agents.output.bias.data[:, 0] = torch.tensor([[0.5, 1.0, 99.0, 99.0], [1.0, -1.0, 99.0, 2.0]])
    own = np.array([[True, True, False, False], [True, True, False, True]])  # 99: never available
    obs, hidden = rng.random((count, 2, 3), np.float32), torch.randn(2, count, 8)
    free = rng.random((count, 2)) < 0.7
    running = np.tile([False, True, False, False], (count, 2, 1))
    infos = {
        "macro_done": free,
        "macro_action": np.ones((count, 2), int),
        "available": np.where(free[..., None], own, running),
    }
    actions, moved = act(agents, obs, infos, hidden, 0.2, rng)
    assert (actions[~free] == 1).all()
    np.testing.assert_array_equal((moved == hidden).all(2).T, ~free)
    for agent, logits in enumerate(([0.5, 1.0, -np.inf, -np.inf], [1.0, -1.0, -np.inf, 2.0])):
        expected = 0.8 * np.exp(logits) / np.exp(logits).sum() + 0.2 * own[agent] / own[agent].sum()
        shares = np.bincount(actions[free[:, agent], agent], minlength=4) / free[:, agent].sum()
        assert shares == pytest.approx(expected, abs=0.015)
    # Agents draw independently: agent 0's shares do not depend on what agent 1 draws.
    together = actions[free.all(1)]
    for drawn in (0, 1, 3):
        first = together[together[:, 1] == drawn, 0]
        assert first.mean() == pytest.approx(0.8 / (1 + np.exp(-0.5)) + 0.1, abs=4 * 0.5 / len(first) ** 0.5)
    greedy, same = act(agents, obs, infos, hidden)
    assert (greedy == np.where(free, [1, 3], 1)).all()
    torch.testing.assert_close(same, moved)
    # No number that a generator gives reaches what is not available.
    for number, first, second in ((0.0, 0, 0), (np.nextafter(1.0, 0.0), 1, 3)):
        always = SimpleNamespace(random=functools.partial(np.full, fill_value=number))
        actions, _ = act(agents, obs, infos, hidden, 0.0, always)
        assert (actions == np.where(free, [first, second], 1)).all()


def critic_input(row, obs_scale):
    """What critics see at a row, spelled out: what each agent saw last, whether it is free, what it did last."""
    seen = []
    for obs, free, before in zip(row.obs, row.free, row.before, strict=True):
        did = [float(before == action) for action in range(row.available.shape[1])]
        seen += [*(obs_scale * obs), float(free), *did]
    return torch.tensor(seen, dtype=torch.float32)


@pytest.mark.parametrize("env_id", ["wtd-s", "ct-10", "bp-10"])
def test_critics_see_the_joint_history_and_actors_their_own(env_id):
    """Whole episodes of real play, the final row included.

    Critics say what they say when they are fed row by row: their history moves at every row. Actors say what they said
    while acting: theirs moves where the agent itself chooses.
    """
    env, learner, batch, ended = play(mac_iaicc, env_id)
    with torch.no_grad():
        values = learner["critics"](batch)
        logits = logits_at_rows(learner["agents"], batch)
    obs_scale = learner["critics"].obs_scale
    networks = learner["critics"].networks
    none = torch.full((env.n_agents, 1, 1), -1)
    for value, logit, episode in zip(values, logits, ended, strict=True):
        torch.testing.assert_close(logit[: len(episode.rows)], said_at_rows(episode))
        hidden = networks.start(1)
        for k, row in enumerate(episode.rows):
            with torch.no_grad():
                said, hidden = networks(critic_input(row, obs_scale).expand(env.n_agents, 1, 1, -1), none, hidden)
            torch.testing.assert_close(value[k], said[:, 0, 0, 0])


def test_each_episode_is_learned_from_once(tmp_path, monkeypatch):
    """An update takes all ended episodes, when there are batch_size of them, and then they are forgotten."""
    ended = []  # episodes, in the order in which they ended
    learned = []  # those of every update
    end_episodes, make_batch = EpisodeBuffer.end_episodes, mac_iaicc.make_batch

    def spy_end_episodes(self, over, obs, infos):
        already = len(self.ended)
        end_episodes(self, over, obs, infos)
        ended.extend(self.ended[already:])

    def spy_make_batch(episodes, device):
        learned.append(list(episodes))
        return make_batch(episodes, device)

    cut_episodes(monkeypatch, 25)
    monkeypatch.setattr(EpisodeBuffer, "end_episodes", spy_end_episodes)
    monkeypatch.setattr(mac_iaicc, "make_batch", spy_make_batch)
    mac_iaicc.train(short(mac_iaicc, "wtd-s", tmp_path, num_envs=2, total_timesteps=800, eval_frequency=800))
    together = [episode for episodes in learned for episode in episodes]
    assert len(learned) > 3 and min(map(len, learned)) >= SHORT["batch_size"] > len(ended) - len(together)
    assert [id(episode) for episode in together] == [id(episode) for episode in ended[: len(together)]]


def test_training_passes_on_what_it_should(tmp_path, monkeypatch):
    """The policy that learns is as soft as the one that acts, returns carry no gradient, and settings arrive.

    Epsilon is 1 for 200 steps, then it falls from 0.9 over 400. The factor on negative errors is held as long and then
    rises to 1 over as many.
    """
    acted = watch_play(mac_iaicc, EpisodeBuffer, monkeypatch, gamma=0.9, reward_scale=0.5)
    rates = watch_learning_rate(monkeypatch)
    seen = []

    def spy_policy(logits, available, epsilon):
        assert epsilon == acted[-1] or not logits.requires_grad
        return soft_policy(logits, available, epsilon)

    def spy_returns(values, batch, n_step):
        assert n_step == 3 and not values.requires_grad
        return own_returns(values, batch, n_step)

    def spy_loss(policy, values, returns, batch, entropy_coef, hysteresis):
        assert policy.requires_grad and values.requires_grad and not returns.requires_grad and entropy_coef == 0.2
        seen.append((4 * len(acted), hysteresis))
        return actor_critic_loss(policy, values, returns, batch, entropy_coef, hysteresis)

    cut_episodes(monkeypatch, 25)
    monkeypatch.setattr(mac_iaicc, "soft_policy", spy_policy)
    monkeypatch.setattr(mac_iaicc, "own_returns", spy_returns)
    monkeypatch.setattr(mac_iaicc, "actor_critic_loss", spy_loss)
    options = dict(random_timesteps=200, start_e=0.9, end_e=0.1, exploration_timesteps=400, hysteresis=0.2)
    options |= dict(n_step=3, entropy_coef=0.2, gamma=0.9, reward_scale=0.5, learning_rate=0.01)
    mac_iaicc.train(short(mac_iaicc, "bp-10", tmp_path, **options))
    assert set(acted[:50]) == {1.0} and acted[50] == 0.9
    assert acted[100] == pytest.approx(0.5) and acted[150:] == pytest.approx([0.1] * 150)
    assert len(seen) > 10
    for (step, hysteresis), rate in zip(seen, rates, strict=True):
        share = np.clip((step - 4 - 600) / 400, 0, 1)  # epsilon and this factor are those of the step before
        assert hysteresis == pytest.approx(0.2 * (1 - share) + share)
        assert rate == pytest.approx(0.01 * (1 - step / 1_200))


def test_while_agents_play_at_random_only_critics_learn(tmp_path, monkeypatch):
    """Until random_timesteps are over, every weight of the critics changes and none of the actors; then all do."""
    start = {}
    make_learner = mac_iaicc.make_learner

    def spy_make_learner(*args):
        learner = make_learner(*args)
        start.update(copy.deepcopy(learner.state_dict()))
        return learner

    cut_episodes(monkeypatch, 25)
    monkeypatch.setattr(mac_iaicc, "make_learner", spy_make_learner)
    for random_timesteps in (400, 300):
        options = dict(random_timesteps=random_timesteps, total_timesteps=408)
        run = mac_iaicc.train(short(mac_iaicc, "wtd-s", tmp_path, **options))
        for name, value in torch.load(run / "last.pt", weights_only=True)["networks"].items():
            is_same = name.startswith("agents.") and random_timesteps == 400
            assert torch.equal(value, start[name]) == is_same, name


@pytest.mark.parametrize("env_id", ["wtd-s", "ct-10"])
def test_a_run_takes_gradient_steps_and_target_critics_follow(tmp_path, monkeypatch, env_id):
    """All four episodes end every 25 steps, 12 times, in time for an update each."""
    assert check_gradient_steps(mac_iaicc, env_id, tmp_path, monkeypatch, learning_rate=0.01) == 12


def test_same_seed_same_curve(tmp_path, monkeypatch):
    names = ("actor_loss", "critic_loss", "entropy", "values")
    check_seeds(mac_iaicc, "bp-10", tmp_path, monkeypatch, {f"losses/{name}" for name in names})
