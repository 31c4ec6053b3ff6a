"""Episodes for tests of the baselines: played with random networks, or made by hand, into a script's own buffer."""

import dataclasses
from functools import cache
from types import SimpleNamespace
from typing import NamedTuple

import numpy as np
import torch

import envs

torch.set_num_threads(1)  # fastest for networks of this size


def make_args(script, env_id, **options):
    """The script's Args for a task, with its defaults for it and a narrow network."""
    return dataclasses.replace(script.parse_args([f"--env={env_id}"]), **{"hidden_size": 8, **options})


def make_buffer(script, env):
    """The script's buffer; if it has a capacity, all episodes of a test fit in."""
    return script.EpisodeBuffer(env) if hasattr(script, "EpisodeBuffer") else script.ReplayBuffer(env, 100)


# ---- episodes that are played ---------------------------------------------------------------------------------------
class Row(NamedTuple):
    """A step at which an agent was free, or an episode's end, and what was known there."""

    t: int
    obs: np.ndarray  # [n, d]
    free: np.ndarray  # bool [n]
    before: np.ndarray  # int [n], infos["macro_action"]: what each agent ran in the step before
    available: np.ndarray  # bool [n, A]
    actions: np.ndarray  # int [n], what each agent runs from here on; at the end nothing of meaning
    said: torch.Tensor  # what the acting networks said: [n, A] or, of a team's network, [J]


class Episode(NamedTuple):
    rows: list
    rewards: list  # of every step
    terminated: bool

    def reward(self, k, until, gamma):
        """The sum of gamma^(t - t_k) r_t over the steps from row k to another one."""
        return sum(gamma**s * reward for s, reward in enumerate(self.rewards[self.rows[k].t : self.rows[until].t]))

    def discount(self, k, until, gamma):
        """gamma^tau between two rows, 0 if the episode terminated at the second."""
        is_over = self.terminated and until == len(self.rows) - 1
        return 0.0 if is_over else gamma ** (self.rows[until].t - self.rows[k].t)


def play(script, env_id, episodes=8, num_envs=3, gamma=0.9):
    """Plays with random networks and half of all macro-actions at random, as `train` does.

    Returns env, learner, the batch of all ended episodes, and these Episodes in the same order. So that both kinds of
    ends are everywhere, the episodes of environment 0 count as terminated and those of environment 1 as truncated.
    """
    torch.manual_seed(0)
    env = envs.make(env_id, num_envs)
    rng = np.random.default_rng(0)
    learner = script.make_learner(make_args(script, env_id), env)
    agents = learner["agents"]
    buffer = make_buffer(script, env)
    heard = []
    hook = agents.register_forward_hook(lambda module, inputs, output: heard.append(output[0]))
    running = [([], []) for _ in range(num_envs)]
    ended = []

    def look(e, obs, infos, actions):
        """Notes a row of environment e."""
        said = heard[-1][e, 0] if heard[-1].ndim == 3 else heard[-1][:, e, 0]
        known = obs[e], infos["macro_done"][e], infos["macro_action"][e], infos["available"][e], actions[e]
        running[e][0].append(Row(len(running[e][1]), *known, said))

    obs, infos = env.reset(seed=0)
    hidden = agents.start(num_envs)
    while len(ended) < episodes:
        actions, hidden = script.act(agents, obs, infos, hidden, 0.5, rng)
        buffer.begin_rows(obs, infos, actions, infos["macro_done"])
        for e in np.flatnonzero(infos["macro_done"].any(1)):
            look(e, obs, infos, actions)
        obs, rewards, terminations, truncations, infos = env.step(actions)
        over = terminations | truncations
        terminations[:2] = over[0], False
        buffer.add_step(rewards, np.where(terminations, 0.0, gamma))
        for e in range(num_envs):
            running[e][1].append(rewards[e])
        if over.any():
            script.act(agents, obs, infos, hidden)  # what the networks say at the end
            buffer.end_episodes(over, obs, infos)
            for e in np.flatnonzero(over):
                look(e, obs, infos, actions)
                ended.append(Episode(*running[e], bool(terminations[e])))
                running[e] = [], []
            obs, infos = env.reset(options={"reset_mask": over})
            hidden[:, over] = 0.0
    hook.remove()
    assert {episode.terminated for episode in ended} == {True, False}
    batch = script.make_batch(buffer.ended)
    assert batch["valid"].sum(1).tolist() == [len(episode.rows) - 1 for episode in ended]
    return env, learner, batch, ended


played = cache(play)  # for tests that change nothing of it


def own_decisions(episode, agent):
    """The rows at which an agent was free, the final row included."""
    return [k for k, row in enumerate(episode.rows) if row.free[agent]]


def said_at_rows(episode):
    """What the agents' networks said at each row, [T, n, A]; of a busy agent that at its latest decision."""
    latest = episode.rows[0].said
    values = []
    for row in episode.rows:
        latest = torch.where(torch.from_numpy(row.free)[:, None], row.said, latest)
        values.append(latest)
    return torch.stack(values)


# ---- two episodes by hand -------------------------------------------------------------------------------------------
# gamma = 1/2. There are two agents with two macro-actions each. At time 3 agent 0 can only start macro-action 0.
#
# t        0     1     2     3     4     5     6 (end)
# reward   8     4     2     6    10     4
# agent 0  1                 0                              rewards 8 + 4/2 + 2/4 = 10.5 and 6 + 10/2 + 4/4 = 12
# agent 1  0     1                 0                        rewards 8, 4 + 2/2 + 6/4 = 6.5 and 10 + 4/2 = 12
# row      0     1           2     3           4 (final)    rewards 8, 4 + 2/2 = 5, 6 and 10 + 4/2 = 12
#
# The second episode has a single step with reward 3: agent 0 chooses 0, agent 1 chooses 1.
PLAN = ({0: 1, 3: 0}, {0: 0, 1: 1, 4: 0})  # of each agent, {t: macro-action}
REWARDS = (8, 4, 2, 6, 10, 4)
SECOND_PLAN = ({0: 0}, {0: 1})
SECOND_REWARDS = (3,)
BY_HAND = SimpleNamespace(
    num_envs=1,
    n_agents=2,
    n_actions=[2, 2],
    obs_sizes=[2, 2],
    horizon=6,
    single_observation_space=SimpleNamespace(shape=(2, 2)),
)


def by_hand(script, terminated=False, plan=PLAN):
    """The batch of the two episodes. What an agent saw last is (episode, time), 0 and 0 at first."""
    buffer = make_buffer(script, BY_HAND)
    for episode, (choices, rewards) in enumerate(((plan, REWARDS), (SECOND_PLAN, SECOND_REWARDS))):
        obs = np.zeros((1, 2, 2), np.float32)
        actions = np.full((1, 2), -1)
        for t in range(len(rewards) + 1):
            over = t == len(rewards)
            free = np.array([[over or t in own for own in choices]])
            obs[free] = episode, t
            running = np.eye(2, dtype=bool)[actions]  # [1, 2, 2]
            available = np.where(free[..., None], True, running)
            if episode == 0 and t == 3:
                available[0, 0] = True, False
            infos = {"macro_done": free, "macro_action": actions.copy(), "available": available}
            if over:
                buffer.end_episodes(np.array([True]), obs, infos)
                break
            actions = np.array([[own.get(t, action) for own, action in zip(choices, actions[0], strict=True)]])
            buffer.begin_rows(obs, infos, actions, free)
            is_terminal = terminated and t == len(rewards) - 1
            buffer.add_step(np.array([rewards[t]], float), np.array([0.0 if is_terminal else 0.5]))
    return script.make_batch(buffer.ended)
