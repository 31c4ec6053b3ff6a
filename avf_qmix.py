"""AVF-QMIX: asynchronous value factorization with QMIX's monotonic mixer.

Agents run macro-actions of different lengths and decide at different times. Each has a recurrent utility network Q_i
over its own macro-history; a mixer combines the utilities of all of them, of ongoing macro-actions too, into one joint
value, trained on the joint reward (paper: "Value Factorization for Asynchronous Multi-Agent Reinforcement Learning").

    decision row k    a time step at which at least one agent starts a macro-action; only these are stored (Section 3.2)
    target (Eq. 14)   y = r + gamma^tau Q'(h', s', m*), m*_i = argmax Q_i(h'_i, .) for agents that choose at the next
                      row and the running macro-action for the others: the conditional argmax of Eqs. 5 and 7
    mixer (Eq. 1)     Q(h, s, m) = f_s(Q_1(h_1, m_1), ..., Q_n(h_n, m_n)), not falling in any utility, see QMIXMixer

Numbered deviations from the paper:
 1. Rewards and values are discounted by gamma^tau between decision rows. An episode truncated by the horizon bootstraps
    from its final observation, a terminated one does not.
 2. Hyperparameters are AVF-QPLEX's, see docs/defaults.md. They include what the paper does not have: Q(lambda) on Box
    Pushing and Capture Target, hysteretic TD errors on Box Pushing, scaled inputs and a falling step size on Capture
    Target. --td-lambda 0 --hysteresis-start 1 is the paper's loss.
"""

# >>> imports, identical to avf_vdn.py
import argparse
import copy
import importlib.util
import json
import os
import signal
import sys
import time
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np
import torch
import tyro
from PIL import Image
from torch import nn
from torch.nn import functional as F
from torch.utils.tensorboard import SummaryWriter
from tqdm import tqdm

import envs

ALGORITHM = Path(__file__).stem
# <<< imports


@dataclass
class Args:
    # >>> run arguments, identical to avf_vdn.py
    env: str = "wtd-s"
    """task, one of envs.IDS"""
    seed: int = 1
    """seed of networks, exploration, replay and environments, from 0 on"""
    total_timesteps: int = 400_000
    """environment steps of the run, over all environments"""
    num_envs: int = 32
    """environments stepped side by side"""
    eval_frequency: int = 10_000
    """environment steps between greedy evaluations"""
    eval_episodes: int = 20
    """episodes of an evaluation, freshly seeded each time"""
    checkpoint_frequency: int = 100_000
    """environment steps between checkpoints, from which --resume continues exactly"""
    runs_dir: str = "runs"
    """folder in which each run makes its own"""
    device: str = "cpu"
    """torch device, cpu or cuda"""
    torch_threads: int = 1
    """CPU threads of torch; one is fastest for networks of this size"""
    resume: str | None = None
    """run folder to continue from its checkpoint, with its own settings"""
    evaluate: str | None = None
    """run folder whose model is evaluated, without training"""
    model: Literal["best", "last"] = "best"
    """with --evaluate: the model of the best greedy evaluation or of the last one"""
    gif: str | None = None
    """with --evaluate: file for an animation of one episode"""
    track: bool = False
    """log to Weights & Biases too, which needs the extra `track`; with WANDB_MODE=offline no account"""
    wandb_project_name: str = "avf"
    """with --track: the project there"""
    wandb_entity: str | None = None
    """with --track: the team there"""
    # <<< run arguments

    # >>> learning arguments, identical to avf_vdn.py
    # Algorithm
    learning_rate: float = 5e-4
    """Adam's step size"""
    learning_rate_end: float | None = None
    """step size at total_timesteps, reached linearly; None keeps it constant"""
    gamma: float = 0.99
    """discount per environment step, in [0, 1]"""
    buffer_size: int = 2_500
    """episodes in the replay buffer"""
    batch_size: int = 64
    """windows in an update"""
    window: int = 25
    """consecutive decision rows in a window"""
    polyak: float = 0.995
    """share of the target network kept at each update; higher is slower"""
    start_e: float = 1.0
    """exploration rate at the start"""
    end_e: float = 0.05
    """exploration rate after exploration_timesteps"""
    exploration_timesteps: int = 300_000
    """environment steps over which the exploration rate falls linearly"""
    learning_starts: int = 5_000
    """environment steps before the first update"""
    train_frequency: int = 64
    """environment steps per gradient update"""
    max_grad_norm: float = 10.0
    """the gradient is scaled down to this norm"""
    reward_scale: float = 1.0
    """factor on rewards inside the loss; logged returns are unscaled"""
    obs_scale: float = 1.0
    """factor on macro-observations and states where they enter a network; more resolves small differences"""
    td_lambda: float = 0.0
    """lambda of Q(lambda) returns over a window; 0 is the paper's one-row target"""
    hysteresis_start: float = 1.0
    """factor on negative TD errors at the start; 1 is the paper's loss, less is optimistic"""
    hysteresis_end: float = 1.0
    """that factor from exploration_timesteps on, reached linearly"""
    hidden_state: Literal["zero", "stored"] = "zero"
    """recurrent state at the start of a window: zeros, or the one stored when acting"""
    hidden_size: int = 64
    """width of the agents' layers"""
    # <<< learning arguments
    mixing_embed: int = 32
    """width of the mixer's hypernetworks"""
    mixer_state: Literal["joint", "single", "real", "decision"] = "joint"
    """mixer input: joint macro-state, one agent's macro-state, true state at the end of the interval or at the row"""


# Where the environment families need other values; docs/defaults.md says how they were chosen.
DEFAULTS = {
    "wtd": {},
    "bp": dict(total_timesteps=600_000, gamma=0.95, learning_rate=3e-4, exploration_timesteps=500_000,
               td_lambda=0.5, hysteresis_start=0.3),
    "ct": dict(total_timesteps=600_000, num_envs=128, learning_rate=1e-3, learning_rate_end=0.0, gamma=0.9,
               buffer_size=5_000, exploration_timesteps=150_000, train_frequency=256, td_lambda=0.8, reward_scale=10.0,
               obs_scale=4.0, hidden_state="stored", hidden_size=32, eval_frequency=40_000, eval_episodes=400),
}  # fmt: skip


# >>> agents, identical to avf_vdn.py
class AgentLinear(nn.Module):
    """A linear layer for each agent, as one batched product: [n, M, inputs] -> [n, M, outputs]."""

    def __init__(self, n_agents, inputs, outputs):
        super().__init__()
        bound = inputs**-0.5
        self.weight = nn.Parameter(torch.empty(n_agents, inputs, outputs).uniform_(-bound, bound))
        self.bias = nn.Parameter(torch.empty(n_agents, 1, outputs).uniform_(-bound, bound))

    def forward(self, x):
        return torch.baddbmm(self.bias, x, self.weight)


class Agents(nn.Module):
    """The agents' utility networks, one each: Linear, ReLU, GRU, Linear, ReLU, Linear.

    n_actions: a list of n ints. obs_size: width d of the padded macro-observation, which is multiplied by obs_scale.
    """

    def __init__(self, n_actions, obs_size, hidden_size, obs_scale=1.0):
        super().__init__()
        self.obs_scale = obs_scale
        n, widest, bound = len(n_actions), max(n_actions), hidden_size**-0.5
        self.n_actions, self.hidden_size = np.array(n_actions), hidden_size
        self.encoder = AgentLinear(n, obs_size + widest, hidden_size)
        self.gru_input = AgentLinear(n, hidden_size, 3 * hidden_size)
        self.gru_hidden = nn.Parameter(torch.empty(n, hidden_size, 3 * hidden_size).uniform_(-bound, bound))
        self.head = AgentLinear(n, hidden_size, hidden_size)
        self.output = AgentLinear(n, hidden_size, widest)
        self.register_buffer("actions", torch.arange(widest), persistent=False)
        self.register_buffer("padding", self.actions >= torch.tensor(n_actions)[:, None, None], persistent=False)

    def start(self, count):
        """The recurrent states before the first decisions of count episodes: zeros, float32 [n, count, H]."""
        return self.gru_hidden.new_zeros(len(self.gru_hidden), count, self.hidden_size)

    def inputs(self, obs, previous):
        """Macro-observations and the one-hot macro-actions before them: [n, M, d + A]."""
        return torch.cat([self.obs_scale * obs, (previous[..., None] == self.actions).float()], 2)

    def forward(self, obs, previous, hidden, sizes):
        """Runs sequences packed step by step: sizes[t] entries of step t, those of the longest sequences first.

        Args:
            obs: float32 [n, M, d], M = sum(sizes). previous: int64 [n, M], the agent's last macro-action, -1 for none.
            hidden: float32 [n, sizes[0], H], recurrent state before, or None for zeros. sizes: falling list of ints.

        Returns:
            utilities float32 [n, M, A] (-inf for padding actions), values V_i float32 [n, M], states float32 [n, M, H].
        """
        gates = self.gru_input(F.relu(self.encoder(self.inputs(obs, previous))))  # [agents, M, 3 hidden]
        if hidden is None:
            hidden = self.start(sizes[0])
        states = []
        for step in gates.split(sizes, 1):
            hidden = hidden[:, : step.shape[1]]
            in_reset, in_update, in_new = step.chunk(3, 2)  # [agents, size, hidden] each
            h_reset, h_update, h_new = torch.bmm(hidden, self.gru_hidden).chunk(3, 2)
            reset, update = torch.sigmoid(in_reset + h_reset), torch.sigmoid(in_update + h_update)
            hidden = torch.lerp(torch.tanh(torch.addcmul(in_new, reset, h_new)), hidden, update)
            states.append(hidden)
        states = torch.cat(states, 1)  # [agents, M, hidden]
        utilities = self.output(F.relu(self.head(states)))  # [agents, M, actions]
        utilities = utilities.masked_fill(self.padding, -torch.inf)
        return utilities, utilities.amax(2), states


# <<< agents


class QMIXMixer(nn.Module):
    """A network of the utilities whose weights are made from the state, none of them negative (Rashid et al. 2018).

    Q(h, s, m) = |w_2(s)| ELU(|W_1(s)| q + b_1(s)) + b_2(s), q = (Q_1(h_1, m_1), ..., Q_n(h_n, m_n)).

    n_agents: n. state_size: width of the mixer input. embed: width of the mixing layer and of the hypernetworks.
    """

    def __init__(self, n_agents, state_size, embed=32):
        super().__init__()
        self.n_agents, self.embed = n_agents, embed

        def hypernetwork(outputs):
            return nn.Sequential(nn.Linear(state_size, embed), nn.ReLU(True), nn.Linear(embed, outputs))

        self.weight_1, self.bias_1 = hypernetwork(n_agents * embed), nn.Linear(state_size, embed)
        self.weight_2, self.bias_2 = hypernetwork(embed), hypernetwork(1)

    def forward(self, utilities, values, actions, chosen, state):
        """The joint value, float32 [...].

        utilities: Q_i(h_i, m_i), float32 [..., n]. state: float32 [..., S]. The rest is for other mixers.
        """
        # absolute weights and a rising ELU: monotone in every utility, so what is best for an agent is best for all
        weight = self.weight_1(state).abs().unflatten(-1, (self.n_agents, self.embed))  # [..., agents, embed]
        mixed = F.elu((utilities[..., None] * weight).sum(-2) + self.bias_1(state))  # [..., embed]
        return (mixed * self.weight_2(state).abs()).sum(-1) + self.bias_2(state)[..., 0]


# >>> replay, identical to avf_vdn.py
class Batch(NamedTuple):
    """A batch of B windows of up to W decision rows: R rows in all, n agents.

    The agents' own decisions, M entries, are packed as Agents.forward wants them; a row looks up its agents' by entry.
    """

    obs: torch.Tensor  # float32 [n, M, d]
    previous: torch.Tensor  # int64 [n, M], the macro-action before, -1 for none
    action: torch.Tensor  # int64 [n, M], the macro-action chosen there (0 in padding and at an episode's end)
    hidden: torch.Tensor | None  # float32 [n, B, H], None for zeros
    sizes: list  # entries of each step
    entry: torch.Tensor  # int64 [R, n], the latest decision of each agent at the row
    next_entry: torch.Tensor  # int64 [R, n], and at the row after it
    chosen: torch.Tensor  # bool [R, n], False for agents that are ongoing at the row
    next_chosen: torch.Tensor  # bool [R, n]
    state: torch.Tensor  # float32 [R, S], mixer input of the row
    next_state: torch.Tensor  # float32 [R, S], and of its target
    reward: torch.Tensor  # float32 [R], discounted sum until the next row
    discount: torch.Tensor  # float32 [R], gamma^tau, 0 where the episode terminated
    valid: torch.Tensor  # bool [B, W], where the R rows stand in their windows

    def by_window(self, x):
        """Values of the rows, [R, ...], as [W, B, ...], zero where a window has no row."""
        padded = x.new_zeros(*self.valid.shape, *x.shape[1:])  # [B, W, ...]
        padded[self.valid] = x
        return padded.transpose(0, 1)


class ReplayBuffer:
    """Whole episodes as arrays: each agent's own decisions, and joint decision rows that point at them.

    A macro-history moves only when its agent chooses, so macro-observations and macro-actions are stored once per
    decision. Row k holds the number of each agent's latest decision; `row` of that decision is the row whose state is
    the agent's macro-state. Episodes are collected in `current`, one per environment, and copied to `data` when they
    end: a window cannot reach into another episode.

    capacity: episodes kept. hidden_size: width of the recurrent states stored with the decisions, 0 for none.
    state_scale: factor on the states of a batch.
    """

    def __init__(self, env, capacity, gamma, mixer_state="joint", hidden_size=0, state_scale=1.0):
        self.capacity, self.gamma, self.mixer_state, self.hidden_size = capacity, gamma, mixer_state, hidden_size
        self.state_scale = state_scale
        n, rows, real = env.n_agents, env.horizon + 1, env.state_size * (mixer_state == "real")
        obs_size = env.single_observation_space.shape[1]
        self.per_decision = {"obs": (obs_size,), "action": (), "row": (), "hidden": (hidden_size,)}
        self.per_row = {"latest": (n,), "state": (env.state_size,), "last_state": (real,), "reward": (), "discount": ()}

        def arrays(episodes):
            dtypes = dict.fromkeys(("action", "row", "latest"), np.int16)
            sizes = {key: (n, rows, *size) for key, size in self.per_decision.items()}
            sizes |= {key: (rows, *size) for key, size in self.per_row.items()}
            data = {key: np.zeros((episodes, *size), dtypes.get(key, np.float32)) for key, size in sizes.items()}
            return data | {"decisions": np.zeros((episodes, n), np.int64), "rows": np.zeros(episodes, np.int64)}

        self.current, self.data, self.size, self.next = arrays(env.num_envs), arrays(capacity), 0, 0

    def decide(self, free, obs, actions, state, hidden):
        """Notes a decision row wherever an agent is free: bool [N, n], float32 [N, n, d], int [N, n], float32 [N, S].
        hidden: the recurrent states before the decision, float32 [n, N, H]."""
        now = self.current
        env, agent = np.nonzero(free)
        decision = now["decisions"][env, agent]
        now["obs"][env, agent, decision] = obs[env, agent]
        now["action"][env, agent, decision] = actions[env, agent]
        now["row"][env, agent, decision] = now["rows"][env]
        if self.hidden_size:
            now["hidden"][env, agent, decision] = hidden.cpu().numpy()[agent, env]
        now["decisions"] += free
        env = np.flatnonzero(free.any(1))
        row = now["rows"][env]
        now["latest"][env, row], now["state"][env, row] = now["decisions"][env] - 1, state[env]
        now["reward"][env, row], now["discount"][env, row] = 0.0, 1.0
        now["rows"][env] += 1

    def reward(self, rewards, state):
        """Adds a step's rewards, float64 [N], to the running rows: r += gamma^t r_t. state: the one before the step."""
        now, env = self.current, np.arange(len(rewards))
        row = now["rows"] - 1
        now["reward"][env, row] += now["discount"][env, row] * rewards
        now["discount"][env, row] *= self.gamma
        if self.mixer_state == "real":
            now["last_state"][env, row] = state

    def finish(self, over, terminated, obs, state, hidden):
        """Ends the episodes in over, bool [N], with their final observation, and moves them to the replay memory."""
        now, env = self.current, np.flatnonzero(over)
        now["discount"][env, now["rows"][env] - 1] *= ~terminated[env]  # a truncated episode bootstraps
        everybody = np.repeat(over[:, None], obs.shape[1], 1)
        self.decide(everybody, obs, np.zeros(everybody.shape, int), state, hidden)
        slots = (self.next + np.arange(len(env))) % self.capacity
        for key, array in self.data.items():
            array[slots] = now[key][env]
        now["decisions"][env], now["rows"][env] = 0, 0
        self.size, self.next = min(self.size + len(env), self.capacity), (self.next + len(env)) % self.capacity

    def sample(self, batch_size, window, rng, device="cpu"):
        """A Batch of windows, each from a random episode, in which every row of the episode is as likely as any other.

        Windows therefore reach over both ends of the episode and are cut there: had all of them to fit in, the first
        row and the last, which often has the reward, would be in one of final - window + 1 only.
        """
        episode = rng.integers(self.size, size=batch_size)
        start = rng.integers(1 - window, self.data["rows"][episode] - 1)
        return self.windows(episode, np.maximum(start, 0), np.minimum(start, 0) + window, device)

    def windows(self, episode, start, window, device="cpu"):
        """The Batch of windows of these episodes from these rows on, int [B] each; window: their rows, int or [B]."""
        data, agents, batch_size = self.data, np.arange(self.data["decisions"].shape[1]), len(episode)
        end = np.minimum(start + window, data["rows"][episode] - 1)  # the last row is that of the final observation

        # Each agent's own decisions: from its latest one at the first row, which may precede it, to that at the last
        first, last = data["latest"][episode, start].astype(int), data["latest"][episode, end]  # [B, agents]
        length = last - first + 1
        rank = np.argsort(np.argsort(-length, axis=0, kind="stable"), axis=0)
        alive = np.arange(length.max()) < length[..., None]  # [B, agents, steps]
        sizes = alive.sum(0).max(0)
        offset = np.cumsum(sizes) - sizes
        b, agent, step = np.nonzero(alive)
        decision, at = (episode[b], agent, first[b, agent] + step), (agent, offset[step] + rank[b, agent])
        obs = np.zeros((len(agents), sizes.sum(), data["obs"].shape[-1]), np.float32)
        action, previous = np.zeros(obs.shape[:2], np.int64), np.full(obs.shape[:2], -1)
        obs[at], action[at] = data["obs"][decision], data["action"][decision]
        before = data["action"][episode[b], agent, decision[2] - 1]
        previous[at] = np.where(decision[2] > 0, before, -1)
        hidden = None
        if self.hidden_size:
            hidden = np.zeros((len(agents), batch_size, self.hidden_size), np.float32)
            hidden[agents, rank] = data["hidden"][episode[:, None], agents, first]

        # The joint rows
        valid = start[:, None] + np.arange(np.max(end - start)) < end[:, None]  # [B, W]
        b, k = np.nonzero(valid)  # [R] each
        episode, row = episode[b], start[b] + k
        latest, next_latest = data["latest"][episode, row], data["latest"][episode, row + 1]  # [R, agents]
        entry, next_entry = (offset[of - first[b]] + rank[b] for of in (latest, next_latest))
        own_row = data["row"][episode[:, None], agents, latest]  # [R, agents], where each made its latest decision
        next_own_row = data["row"][episode[:, None], agents, next_latest]
        chosen, next_chosen = own_row == row[:, None], next_own_row == row[:, None] + 1
        next_state = data["state"][episode, row + 1]
        if self.mixer_state == "joint":
            state = data["state"][episode[:, None], own_row].reshape(len(row), -1)  # [R, agents * S]
            next_state = data["state"][episode[:, None], next_own_row].reshape(len(row), -1)  # the same
        elif self.mixer_state == "single":  # of the first agent whose macro-action ends with the row's interval
            state = data["state"][episode, own_row[np.arange(len(row)), next_chosen.argmax(1)]]
        else:
            state = data["last_state" if self.mixer_state == "real" else "state"][episode, row]
        state, next_state = np.float32(self.state_scale) * state, np.float32(self.state_scale) * next_state
        batch = Batch(obs, previous, action, hidden, sizes.tolist(), entry, next_entry, chosen, next_chosen, state,
                      next_state, data["reward"][episode, row], data["discount"][episode, row], valid)  # fmt: skip
        return Batch(*(torch.from_numpy(x).to(device) if isinstance(x, np.ndarray) else x for x in batch))

    def _parts(self):
        """(collected or replayed, array's name, array, what of it is filled): all that a checkpoint needs."""
        for part, data, count in (("current", self.current, len(self.current["rows"])), ("data", self.data, self.size)):
            yield from ((part, key, data[key][:count], ...) for key in ("rows", "decisions"))  # first: masks need them
            steps = np.arange(data["row"].shape[2])
            decisions, rows = steps < data["decisions"][:count, :, None], steps < data["rows"][:count, None]
            yield from ((part, key, data[key][:count], decisions) for key in self.per_decision)
            yield from ((part, key, data[key][:count], rows) for key in self.per_row)

    def save(self):
        """The buffer as a dict of tensors, for checkpoints."""
        arrays = {f"{part}/{key}": torch.from_numpy(array[filled]) for part, key, array, filled in self._parts()}
        return {"size": self.size, "next": self.next, **arrays}

    def load(self, saved):
        """Continues from what `save` returned."""
        self.size, self.next = saved["size"], saved["next"]
        for part, key, array, filled in self._parts():
            array[filled] = saved[f"{part}/{key}"].numpy()


# <<< replay


# >>> td loss, identical to avf_vdn.py
def td_loss(utilities, values, target_utilities, target_values, mixer, target_mixer, batch, td_lambda=0, hysteresis=1):
    """The loss of Eq. 14 over the rows of a batch, with double Q-learning.

    Args:
        utilities, target_utilities: float32 [n, M, A], values, target_values: float32 [n, M], of the batch's decisions.
        mixer, target_mixer: callables (utilities, values, actions, chosen, state) -> joint values [R].
        td_lambda: 0 for one-row targets, up to 1. hysteresis: factor on negative TD errors, 1 for none.

    Returns:
        the loss (scalar tensor), joint values and targets, float32 [R] each.
    """
    agents, entry, next_entry = torch.arange(len(utilities), device=utilities.device), batch.entry, batch.next_entry
    taken = utilities.gather(2, batch.action[..., None])[..., 0]  # [agents, M]
    action, running = batch.action[agents, entry], batch.action[agents, next_entry]  # [R, agents]
    q = mixer(taken[agents, entry], values[agents, entry], action, batch.chosen, batch.state)  # [R]

    with torch.no_grad():
        # The conditional argmax: agents that choose at the next row take the online network's best, the others go on.
        best = torch.where(batch.next_chosen, utilities.argmax(2)[agents, next_entry], running)
        next_q, next_v = target_utilities[agents, next_entry, best], target_values[agents, next_entry]
        bootstrap = target_mixer(next_q, next_v, best, batch.next_chosen, batch.next_state)  # [R]
        target = batch.reward + batch.discount * bootstrap
        if td_lambda > 0:  # G[k] = r[k] + gamma^tau ((1 - lambda) Q'[k + 1] + lambda G[k + 1])
            returns, next_values, decay = map(batch.by_window, (target, bootstrap, td_lambda * batch.discount))
            decay[:-1] *= batch.valid.T[1:]  # the last row of a window has no further return
            for k in range(len(returns) - 2, -1, -1):
                returns[k] += decay[k] * (returns[k + 1] - next_values[k])
            target = returns.T[batch.valid]
    error = target - q
    return torch.where(error < 0, hysteresis * error, error).square().mean(), q, target


def batch_loss(learner, target, batch, td_lambda, hysteresis):
    """`td_loss` of a learner and its target network on a batch: the loss and the joint values [R]."""
    history = (batch.obs, batch.previous, batch.hidden, batch.sizes)
    with torch.no_grad():
        next_q, next_v, _ = target["agents"](*history)  # over the same rows, so that it has the same histories
    q, v, _ = learner["agents"](*history)
    return td_loss(q, v, next_q, next_v, learner["mixer"], target["mixer"], batch, td_lambda, hysteresis)[:2]


# <<< td loss


# >>> acting, identical to avf_vdn.py
def act(agents, obs, infos, hidden, epsilon=0.0, rng=None):
    """Epsilon-greedy macro-actions of the free agents.

    Args:
        obs: float32 [N, n, d] and infos of the environment's last reset or step. hidden: float32 [n, N, H].
        epsilon: exploration rate. rng: NumPy generator, needed if epsilon > 0.

    Returns:
        actions int64 [N, n] (of ongoing agents the running one), recurrent states that moved where an agent is free.
    """
    free, running = infos["macro_done"], infos["macro_action"]
    by_agent = [torch.from_numpy(x).to(hidden.device).transpose(0, 1) for x in (obs, running, free)]  # [n, N, ...]
    with torch.no_grad():
        utilities, _, states = agents(*by_agent[:2], hidden, [len(obs)])
    actions = utilities.argmax(2).T.cpu().numpy()  # [N, agents]
    if epsilon > 0:
        explore, any_action = rng.random((2, *free.shape))
        actions = np.where(explore < epsilon, (any_action * agents.n_actions).astype(np.int64), actions)
    return np.where(free, actions, running), torch.where(by_agent[2][..., None], states, hidden)


# <<< acting


# >>> evaluation, identical to avf_vdn.py
def evaluate(agents, env, gamma, seed, frames=None):
    """Greedy play: the first episode of each environment of a batch, reset with the seed.

    Returns a dict of float64 [N]: return, discounted_return, length, success (0 or 1). frames: a list that receives the
    pictures of environment 0.
    """
    obs, infos = env.reset(seed=seed)
    hidden = agents.start(env.num_envs)
    result = {key: np.zeros(env.num_envs) for key in ("return", "discounted_return", "length", "success")}
    live, step = np.ones(env.num_envs, bool), 0
    if frames is not None:
        frames.append(env.render()[0])
    while live.any():
        actions, hidden = act(agents, obs, infos, hidden)
        obs, rewards, terminations, truncations, infos = env.step(actions)
        result["return"] += live * rewards
        result["discounted_return"] += live * gamma**step * rewards
        result["length"] += live
        result["success"] += live & infos["success"]
        if frames is not None and live[0]:
            frames.append(env.render()[0])
        over, step = terminations | truncations, step + 1
        live &= ~over
        if over.any():  # play on in ended environments without looking
            obs, infos = env.reset(options={"reset_mask": over})
            hidden[:, over] = 0.0
    return result


# <<< evaluation


def make_learner(args, env):
    """Agents and mixer as one module on the device, and the replay buffer."""
    agents = Agents(env.n_actions, env.single_observation_space.shape[1], args.hidden_size, args.obs_scale)
    width = env.state_size * (env.n_agents if args.mixer_state == "joint" else 1)
    mixer = QMIXMixer(env.n_agents, width, args.mixing_embed)
    stored_hidden = args.hidden_size if args.hidden_state == "stored" else 0
    buffer = ReplayBuffer(env, args.buffer_size, args.gamma, args.mixer_state, stored_hidden, args.obs_scale)
    return nn.ModuleDict({"agents": agents, "mixer": mixer}).to(args.device), buffer


# >>> training, identical to avf_vdn.py
def train(args):
    """Trains from Args, or goes on with the run args.resume; returns the run folder."""
    check(args)
    torch.set_num_threads(args.torch_threads)
    torch.manual_seed(args.seed)
    rng = np.random.default_rng(args.seed)
    env, eval_env = envs.make(args.env, args.num_envs), envs.make(args.env, args.eval_episodes)
    learner, buffer = make_learner(args, env)
    target = copy.deepcopy(learner).requires_grad_(False)
    agents = learner["agents"]
    optimizer = torch.optim.Adam(learner.parameters(), lr=args.learning_rate, fused=True)
    if args.resume:
        folder, saved = Path(args.resume), load_file(args.resume, "checkpoint.pt", args.env)
        for name, part in (("learner", learner), ("target", target), ("optimizer", optimizer)):
            part.load_state_dict(saved[name])
        buffer.load(saved["buffer"])
        obs, infos = env.load_state(saved["env"])
        hidden, rng.bit_generator.state = saved["hidden"].to(args.device), saved["rng"]
        step, updates, recent, models = saved["step"], saved["updates"], saved["recent"], saved["models"]
    else:
        folder = make_run_folder(args)
        obs, infos = env.reset(seed=args.seed)
        hidden = agents.start(args.num_envs)
        step, updates, recent, models = 0, 0, [], {}
    tracker = start_tracking(args, folder) if args.track else None
    writer = SummaryWriter(folder, purge_step=step + 1)
    table = "\n".join(f"|{name}|{value}|" for name, value in asdict(args).items())
    writer.add_text("hyperparameters", f"|name|value|\n|-|-|\n{table}", step)

    def save_checkpoint():
        saved = {"learner": learner.state_dict(), "target": target.state_dict(), "optimizer": optimizer.state_dict()}
        arrays = {k: torch.from_numpy(v) if isinstance(v, np.ndarray) else v for k, v in env.save_state().items()}
        saved |= {"buffer": buffer.save(), "env": arrays, "hidden": hidden, "rng": rng.bit_generator.state}
        writer.flush()  # what was logged up to here is not logged again after a resume
        saved |= {"step": step, "updates": updates, "recent": recent, "models": models, "run": [ALGORITHM, args.env]}
        save(saved, folder / "checkpoint.pt")

    # Ctrl-C and a termination signal take effect between two steps, where a checkpoint is whole; a second one at once.
    stop = []

    def request_stop(number, frame):
        stop.append(number)
        signal.signal(number, handlers[number])

    handlers = {number: signal.signal(number, request_stop) for number in (signal.SIGINT, signal.SIGTERM)}
    layout = "{percentage:3.0f}%|{bar:10}| {n_fmt}/{total_fmt} [{elapsed}<{remaining}{postfix}]"
    bar = tqdm(total=args.total_timesteps, initial=step, disable=not sys.stderr.isatty(), bar_format=layout)
    started, first_step = time.time(), step
    while step < args.total_timesteps and not stop:
        # Choose and step
        progress = min(1.0, step / args.exploration_timesteps)
        epsilon = args.start_e + progress * (args.end_e - args.start_e)
        if args.learning_rate_end is not None:
            done = step / args.total_timesteps
            optimizer.param_groups[0]["lr"] = (1 - done) * args.learning_rate + done * args.learning_rate_end
        actions, moved = act(agents, obs, infos, hidden, epsilon, rng)
        state = infos["state"]
        buffer.decide(infos["macro_done"], obs, actions, state, hidden)
        obs, rewards, terminations, truncations, infos = env.step(actions)
        buffer.reward(args.reward_scale * rewards, state)
        hidden, step = moved, step + args.num_envs

        # Store the episodes that ended and start new ones
        over = terminations | truncations
        if over.any():
            buffer.finish(over, terminations, obs, infos["state"], hidden)
            recent += zip(env.episode_return[over].tolist(), env.elapsed[over].tolist(), strict=True)
            obs, infos = env.reset(options={"reset_mask": over})
            hidden[:, over] = 0.0

        # <<< training
        # >>> learning, identical to avf_vdn.py
        # Learn
        while updates < (step - args.learning_starts) // args.train_frequency and buffer.size:
            batch = buffer.sample(args.batch_size, args.window, rng, args.device)
            beta = args.hysteresis_start + progress * (args.hysteresis_end - args.hysteresis_start)
            loss, joint_q = batch_loss(learner, target, batch, args.td_lambda, beta)
            optimizer.zero_grad()
            loss.backward()
            grad_norm = nn.utils.clip_grad_norm_(learner.parameters(), args.max_grad_norm)
            optimizer.step()
            for slow, fast in zip(target.parameters(), learner.parameters(), strict=True):
                slow.data.lerp_(fast.data, 1 - args.polyak)
            updates += 1
            if updates % 100 == 0:
                writer.add_scalar("losses/td_loss", loss.item(), step)
                writer.add_scalar("losses/q_values", joint_q.mean().item(), step)
                writer.add_scalar("losses/grad_norm", grad_norm.item(), step)

        # <<< learning
        # >>> logging, identical to avf_vdn.py
        # Log, evaluate, save
        due = {f: step // f > (step - args.num_envs) // f or step >= args.total_timesteps
               for f in (2_000, args.eval_frequency, args.checkpoint_frequency)}  # fmt: skip
        if due[2_000] and recent:
            sps, (mean_return, mean_length) = (step - first_step) / (time.time() - started), np.mean(recent, 0)
            for key, value in (("SPS", sps), ("epsilon", epsilon), ("episodic_return", mean_return)):
                writer.add_scalar(f"charts/{key}", value, step)
            writer.add_scalar("charts/episodic_length", mean_length, step)
            bar.set_postfix_str(f"return {mean_return:.1f}, epsilon {epsilon:.2f}, {sps:.0f} steps/s", refresh=False)
            bar.update(step - bar.n)
            recent = []
        if due[args.eval_frequency]:
            eval_seed = int(np.random.SeedSequence([args.seed, step]).generate_state(1)[0])
            result = {key: x.mean().item() for key, x in evaluate(agents, eval_env, args.gamma, eval_seed).items()}
            for key, value in result.items():
                writer.add_scalar(f"eval/{key}", value, step)
            model = {"step": step, "return": result["return"], "networks": copy.deepcopy(learner.state_dict())}
            models = {"last": model, "best": max(models.get("best", model), model, key=lambda m: m["return"])}
            save({"run": [ALGORITHM, args.env], **models}, folder / "model.pt")
            bar.write(f"step {step}: greedy return {result['return']:.2f}, success {result['success']:.2f}", sys.stderr)
        if due[args.checkpoint_frequency]:
            save_checkpoint()

    for number, handler in handlers.items():
        signal.signal(number, handler)
    bar.close()
    if stop:
        save_checkpoint()
        print(f"stopped at step {step}; go on with: python {ALGORITHM}.py --resume {folder}", file=sys.stderr)
    writer.close()
    if tracker:
        tracker.finish()
    return folder


# <<< logging


# >>> runs, identical to avf_vdn.py
def report(args):
    """Evaluates the model of the run folder args.evaluate, prints the result and writes the animation args.gif."""
    check(args)
    torch.set_num_threads(args.torch_threads)
    env = envs.make(args.env, args.eval_episodes, render_mode="rgb_array" if args.gif else None)
    (learner, _), model = make_learner(args, env), load_file(args.evaluate, "model.pt", args.env)[args.model]
    learner.load_state_dict(model["networks"])
    frames = [] if args.gif else None
    result = evaluate(learner["agents"], env, args.gamma, args.seed, frames)
    print(f"{args.env} {ALGORITHM} {args.model} model of step {model['step']}: {args.eval_episodes} greedy episodes")
    for key, value in result.items():
        error = value.std(ddof=1) / len(value) ** 0.5 if len(value) > 1 else float("nan")
        print(f"{key.replace('_', ' '):17s} {value.mean():9.3f} +- {error:.3f} (standard error)")
    if args.gif:
        pictures = [Image.fromarray(frame).quantize(dither=0) for frame in frames]
        try:
            pictures[0].save(args.gif, save_all=True, append_images=pictures[1:], duration=150, loop=0)
        except (OSError, ValueError) as error:
            fail(f"cannot write {args.gif}: {error}")


def fail(message):
    """Ends the program with one line."""
    raise SystemExit(f"{ALGORITHM}: {message}")


def check(args):
    """Ends the program with one line if an argument is out of range."""
    if args.env not in envs.IDS:
        fail(f"unknown --env {args.env!r}; valid ids: {' '.join(envs.IDS)}")
    zero_to_one = "gamma polyak start_e end_e td_lambda hysteresis_start hysteresis_end".split()
    from_zero = ["seed", "learning_starts", "learning_rate", "learning_rate_end", "max_grad_norm", "reward_scale"]
    from_zero += ["obs_scale", "entropy_coef"]
    for field in fields(args):
        value, name = getattr(args, field.name), "--" + field.name.replace("_", "-")
        if field.name in zero_to_one and not 0 <= value <= 1:
            fail(f"{name} must be between 0 and 1, got {value}")
        if field.name in from_zero and value is not None and not 0 <= value < float("inf"):
            fail(f"{name} must not be negative, got {value}")
        if type(value) is int and field.name not in from_zero and value < 1:
            fail(f"{name} must be at least 1, got {value}")
    if args.track and importlib.util.find_spec("wandb") is None:
        fail("--track needs Weights & Biases: pip install -e '.[track]'")
    try:
        torch.zeros(1, device=args.device)
    except (RuntimeError, AssertionError) as error:
        fail(f"--device {args.device} is not available: {str(error).splitlines()[0]}")


def start_tracking(args, folder):
    """A Weights & Biases run that copies what is written to TensorBoard; a resumed run goes on in its own."""
    import wandb  # optional

    return wandb.init(project=args.wandb_project_name, entity=args.wandb_entity, name=folder.name, id=folder.name,
                      resume="allow", config=asdict(args), sync_tensorboard=True, dir=folder.parent)  # fmt: skip


def save(saved, path):
    """Writes beside the file and swaps, so that a kill at any moment leaves the old one or the new one."""
    torch.save(saved, f"{path}.new")
    os.replace(f"{path}.new", path)


def load_file(folder, name, env_id):
    """What `save` wrote in a run folder, on the CPU; it must be of this algorithm and task."""
    try:
        saved = torch.load(Path(folder) / name, map_location="cpu", weights_only=True)
    except FileNotFoundError:
        fail(f"there is no {name} in {folder}")
    except Exception as error:  # torch names no common class for what a damaged file raises
        fail(f"{Path(folder) / name} is damaged: {str(error).splitlines()[0]}")
    if saved["run"] != [ALGORITHM, env_id]:
        fail(f"{Path(folder) / name} is of {' on '.join(saved['run'])}, not of {ALGORITHM} on {env_id}")
    return saved


def make_run_folder(args):
    """Makes runs_dir/<env>__<script>__<seed>__<time>, a new folder for each run, with args.json in it."""
    stem, tries = f"{args.env}__{ALGORITHM}__{args.seed}__{int(time.time())}", 0
    try:
        Path(args.runs_dir).mkdir(parents=True, exist_ok=True)
        while True:
            folder = Path(args.runs_dir) / (f"{stem}-{tries}" if tries else stem)
            try:
                folder.mkdir()
                break
            except FileExistsError:  # another run of the same second
                tries += 1
        (folder / "args.json").write_text(json.dumps({"algorithm": ALGORITHM, **asdict(args)}, indent=2) + "\n")
    except OSError as error:
        fail(f"cannot write to --runs-dir {args.runs_dir}: {error.strerror}")
    return folder


def load_args(folder):
    """The Args of a run folder."""
    try:
        saved = json.loads((Path(folder) / "args.json").read_text())
        algorithm = saved.pop("algorithm")
        if algorithm != ALGORITHM:
            fail(f"{folder} is a run of {algorithm}, not of {ALGORITHM}")
        return Args(**saved)
    except (OSError, ValueError, KeyError, TypeError) as error:
        fail(f"{folder} is not a run folder: args.json: {error}")


def defaults(env_id, **overrides):
    """The Args in force for a task; overrides are fields by name."""
    return Args(**{"env": env_id, **DEFAULTS.get(env_id.split("-")[0], {}), **overrides})


def parse_args(argv=None):
    """Args from the command line, over the defaults of the environment family or the settings of the run continued."""
    peek = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
    for flag in ("--env", "--resume", "--evaluate"):
        peek.add_argument(flag)
    known = peek.parse_known_args(argv)[0]
    if known.resume and known.evaluate:
        fail("--resume and --evaluate exclude each other")
    folder = known.resume or known.evaluate
    base = load_args(folder) if folder else defaults(known.env or Args.env)
    args = tyro.cli(Args, default=base, args=argv)
    may_change = {"resume", "evaluate", "device", "torch_threads", "track", "wandb_project_name", "wandb_entity"}
    evaluation, training = {"eval_episodes", "gif", "model", "seed"}, {"total_timesteps", "checkpoint_frequency"}
    may_change |= evaluation if args.evaluate else training
    for field in fields(Args):
        old, new = getattr(base, field.name), getattr(args, field.name)
        if folder and old != new and field.name not in may_change:
            fail(f"--{field.name.replace('_', '-')} {new} does not fit: {folder} is a run with {old}")
    return args


def main():
    args = parse_args()
    if args.evaluate:
        report(args)
    else:
        print(train(args))


if __name__ == "__main__":
    main()
# <<< runs
