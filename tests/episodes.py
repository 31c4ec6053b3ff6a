"""Episodes for tests of the baselines: played with random networks, or made by hand, into a script's own buffer."""

import dataclasses
from functools import cache
from types import SimpleNamespace
from typing import NamedTuple

import numpy as np
import torch

import envs
from tests.rollouts import windows

torch.set_num_threads(1)  # fastest for networks of this size


class Row(NamedTuple):
    """A step at which some agent chose, or an episode's final row, and what was known there; [n, ...] each."""

    t: int
    obs: np.ndarray
    free: np.ndarray
    before: np.ndarray  # infos["macro_action"], what runs or ran last
    actions: np.ndarray
    values: torch.Tensor | None = None  # what the acting network said


class Episode(NamedTuple):
    rows: list
    rewards: list  # of every step
    terminated: bool

    def reward(self, k, until, gamma):
        """Sum of gamma^(t - t_k) r_t over the steps from row k to another one."""
        return sum(gamma**s * reward for s, reward in enumerate(self.rewards[self.rows[k].t : self.rows[until].t]))

    def discount(self, k, until, gamma):
        over = self.terminated and until == len(self.rows) - 1
        return 0.0 if over else gamma ** (self.rows[until].t - self.rows[k].t)


class Span(NamedTuple):
    """A window: rows begin to end - 1 of an episode, and its row end after them."""

    episode: Episode
    begin: int
    end: int


def make_args(script, env_id, **options):
    return dataclasses.replace(script.parse_args([f"--env={env_id}"]), **{"hidden_size": 8, **options})


def make_buffer(script, env, capacity):
    return (script.EpisodeBuffer if hasattr(script, "EpisodeBuffer") else script.ReplayBuffer)(env, capacity)


def play(script, env_id, episodes=8, num_envs=3, gamma=0.9, epsilon=0.7):
    """Plays with random networks; returns env, learner, buffer and the episodes in the order in which they ended. For
    both kinds of ends everywhere, those of environment 0 count as terminal and those of environment 1 do not."""
    torch.manual_seed(0)
    env, rng = envs.make(env_id, num_envs), np.random.default_rng(0)
    learner, buffer = script.make_learner(make_args(script, env_id), env), make_buffer(script, env, episodes + num_envs)
    said, (obs, infos) = [], env.reset(seed=0)
    hook = learner["agents"].register_forward_hook(lambda module, inputs, output: said.append(output[0]))
    hidden, running, ended = learner["agents"].start(num_envs), [([], []) for _ in range(num_envs)], []
    while len(ended) < episodes:
        actions, hidden = script.act(learner["agents"], obs, infos, hidden, epsilon, rng)
        buffer.add(obs, actions, infos["macro_done"])
        for e, (rows, rewards) in enumerate(running):
            if infos["macro_done"][e].any():
                known = (x[e].copy() for x in (obs, infos["macro_done"], infos["macro_action"], actions))
                rows.append(Row(len(rewards), *known, said[-1][:, e]))
        obs, step_rewards, terminations, truncations, infos = env.step(actions)
        over = terminations | truncations
        terminations[:2] = over[0], False
        buffer.step(step_rewards, gamma * ~terminations, over, obs, infos)
        for e, (rows, rewards) in enumerate(running):
            rewards.append(step_rewards[e])
            if over[e]:
                ran = infos["macro_action"][e]
                rows.append(Row(len(rewards), obs[e], infos["macro_done"][e], ran, ran))
                ended.append(Episode(rows, rewards, bool(terminations[e])))
                running[e] = [], []
        if over.any():
            obs, infos = env.reset(options={"reset_mask": over})
            hidden[:, over] = 0.0
    hook.remove()
    assert {episode.terminated for episode in ended} == {True, False}
    return env, learner, buffer, ended


played = cache(play)  # for tests that change nothing of it


def random_windows(buffer, ended, count, window):
    """A batch of windows from anywhere, and what they are. Some are cut at the beginning of their episode, some at its
    end, some by their own length; the last are episodes that fit, if there are any, and are whole."""
    rng, length = np.random.default_rng(0), np.array([len(episode.rows) - 1 for episode in ended])
    longer, whole = np.flatnonzero(length > window), np.flatnonzero(length <= window)[:3]
    number = np.append(rng.choice(longer, count - len(whole)), whole)
    number[:2] = [next(e for e in longer if ended[e].terminated == kind) for kind in (True, False)]
    last = length[number]
    first = rng.integers(1 - window, last)
    first[:6] = [*(last[:3] - [1, 2, 3]), *(1 - window + np.arange(3))]
    begin = np.where(last > window, first, 0)
    spans = [Span(ended[e], max(k, 0), min(k + window, n)) for e, k, n in zip(number, begin, last, strict=True)]
    cut = {(k < 0, k + window > n) for k, n in zip(begin, last, strict=True)}
    assert {(True, False), (False, True), (False, False)} <= cut
    batch = windows(buffer, number, first, window)
    assert batch["valid"].sum(1).tolist() == [span.end - span.begin for span in spans]
    return batch, spans


def take_all(buffer, ended):
    """The batch of all episodes of an on-policy buffer, and what it is."""
    batch = buffer.take()
    spans = [Span(episode, 0, len(episode.rows) - 1) for episode in ended]
    assert batch["valid"].sum(1).tolist() == [span.end for span in spans]
    return batch, spans


def step_by_step(network, inputs, moves):
    """Values [rows, n, A] of a network that is fed row by row. inputs: obs [n, d] and previous [n] of each row. moves:
    bool [rows, n], where an agent's history moves; elsewhere it has the values that it had."""
    hidden, found = network.start(1), []
    with torch.no_grad():
        for (obs, previous), move in zip(inputs, torch.as_tensor(np.array(moves)), strict=True):
            obs, previous = (torch.as_tensor(np.array(x))[:, None] for x in (obs, previous))
            values, states = network(obs, previous, hidden, [1])
            hidden = torch.where(move[:, None, None], states, hidden)
            found.append(torch.where(move[:, None], values[:, 0], found[-1]) if found else values[:, 0])
    return torch.stack(found)


def own_values(network, span):
    """What each agent's own network says at the rows of a window, which it enters with what it saw last."""
    inputs, moves = [], []
    for k in range(span.begin, span.end + 1):
        rows = span.episode.rows
        latest = [next(rows[j] for j in range(k, -1, -1) if rows[j].free[i]) for i in range(len(rows[k].free))]
        inputs.append(([row.obs[i] for i, row in enumerate(latest)], [row.before[i] for i, row in enumerate(latest)]))
        moves.append(rows[k].free | (k == span.begin))
    return step_by_step(network, inputs, moves)


# The example by hand: gamma = 1/2, two agents with two macro-actions each.
#
# t        0     1     2     3     4     5     6 (end)
# reward   8     4     2     6    10     4
# agent 0  1                 0                              rewards 8 + 4/2 + 2/4 = 10.5 and 6 + 10/2 + 4/4 = 12
# agent 1  0     1                 0                        rewards 8, 4 + 2/2 + 6/4 = 6.5 and 10 + 4/2 = 12
# row      0     1           2     3           4 (final)    rewards 8, 4 + 2/2 = 5, 6 and 10 + 4/2 = 12
#
# A second episode of a single step, reward 3: agent 0 chooses 0, agent 1 chooses 1.
PLAN, REWARDS = ({0: 1, 3: 0}, {0: 0, 1: 1, 4: 0}), (8, 4, 2, 6, 10, 4)
SPACE = SimpleNamespace(shape=(2, 2))
BY_HAND = SimpleNamespace(num_envs=1, n_actions=[2, 2], horizon=6, single_observation_space=SPACE)


def by_hand(script, terminated=False, plan=PLAN):
    """A learner and a buffer with the example's two episodes; an agent's observation is (episode, step)."""
    torch.manual_seed(0)
    learner, buffer = script.make_learner(make_args(script, "wtd-s"), BY_HAND), make_buffer(script, BY_HAND, 2)
    for episode, (choices, rewards) in enumerate(((plan, REWARDS), (({0: 0}, {0: 1}), (3,)))):
        obs, actions = np.zeros((1, 2, 2), np.float32), np.zeros((1, 2), int)
        for t in range(len(rewards) + 1):
            over = t == len(rewards)
            free = np.array([[over or t in own for own in choices]])
            obs[free] = episode, t
            if t:
                discount = 0.0 if over and terminated else 0.5
                infos = {"macro_done": free, "macro_action": actions.copy()}
                buffer.step(np.array([rewards[t - 1]]), np.array([discount]), np.array([over]), obs, infos)
            if not over:
                actions[:] = [[own.get(t, action) for own, action in zip(choices, actions[0], strict=True)]]
                buffer.add(obs, actions, free)
    return learner, buffer
