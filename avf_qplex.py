"""AVF-QPLEX: asynchronous value factorization with QPLEX's duplex dueling mixer.

Agents run macro-actions of different lengths and decide at different times. Each has a recurrent utility network Q_i over its
own macro-history; the mixer combines the utilities of all, those of ongoing macro-actions included, into one joint value that
is trained on the joint reward (paper: "Value Factorization for Asynchronous Multi-Agent Reinforcement Learning"):

    decision row k    a time step at which at least one agent starts a macro-action; only these are stored (Section 3.2)
    target (Eq. 14)   y = r + gamma^tau Q'(h', s', m*), m*_i = argmax Q_i(h'_i, .) for agents that choose at the next row and
                      the running macro-action for the others: the conditional argmax of Eqs. 5 and 7
    mixer (Eqs. 3-4)  Q(h, s, m) = sum_i V_i + lambda_i(s, m) A_i, lambda_i >= 0, over transformed V_i, A_i (see QPLEXMixer)

Numbered deviations from the paper:
 1. Ongoing agents are conditioned on what they can still choose: V_i = Q_i(h_i, m_i), so A_i = 0. The literal mixer
    (--no-mask-ongoing) breaks Mac-IGM: an ongoing agent's negative advantage is weighted by the others' choices.
 2. A_i = Q_i - max Q_i (Eq. 4) by default, not a dueling head with advantages of any sign (Def. 3.3). --advantage dueling gives
    that head, with lambda_i(s): with lambda_i(s, m) free signs break the consistency of greedy choices.
 3. Discounting is gamma^tau between decision rows; an episode that is truncated by the horizon bootstraps from its final
    observation, a terminated one does not.
 4. Learning rate, gamma, replay and the values the paper does not give (epsilon, update frequency, episodes) were chosen
    by measurement, see DEFAULTS and the README. On Box Pushing they include hysteretic TD errors and Q(lambda), which the
    paper does not use; --td-lambda 0 --hysteresis-start 1 --hysteresis-end 1 is the paper's loss.
"""

import argparse
import copy
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


@dataclass
class Args:
    env: str = "wtd-s"
    """task, one of envs.IDS"""
    seed: int = 1
    """seed of networks, exploration, replay and environments (any integer from 0 on)"""
    total_timesteps: int = 400_000
    """environment steps of the run, over all environments"""
    num_envs: int = 32
    """environments stepped side by side"""
    eval_frequency: int = 10_000
    """environment steps between greedy evaluations"""
    eval_episodes: int = 20
    """episodes of an evaluation, each in a freshly seeded environment"""
    checkpoint_frequency: int = 100_000
    """environment steps between checkpoints, from which --resume continues exactly"""
    runs_dir: str = "runs"
    """folder in which each run makes its own"""
    device: str = "cpu"
    """torch device: cpu or cuda"""
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

    # Algorithm
    learning_rate: float = 5e-4
    """Adam's step size"""
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
    mixer_state: Literal["joint", "single", "real", "decision"] = "joint"
    """mixer input: the joint macro-state, one agent's macro-state, the state at the interval's end, the state at the row"""
    mixing_embed: int = 32
    """width of the mixer's hypernetworks"""
    attention_heads: int = 4
    """heads that add up to lambda_i"""
    advantage: Literal["max", "dueling"] = "max"
    """A_i = Q_i - max Q_i with lambda_i(s, m), or a dueling head of any sign with lambda_i(s)"""
    mask_ongoing: bool = True
    """ongoing agents have advantage 0 (deviation 1)"""


# What differs between the environment families; the README says how these were chosen.
DEFAULTS = {
    "wtd": {},
    "bp": dict(
        total_timesteps=800_000, gamma=0.95, learning_rate=3e-4, buffer_size=30_000, exploration_timesteps=500_000,
        td_lambda=0.5, hysteresis_start=0.2, hysteresis_end=1.0,
    ),
    "ct": dict(total_timesteps=1_000_000, gamma=0.98, buffer_size=10_000, train_frequency=192, reward_scale=10.0,
               exploration_timesteps=400_000, td_lambda=0.8, hysteresis_start=0.2, hysteresis_end=1.0, eval_episodes=100),
}  # fmt: skip


def defaults(env_id, **overrides):
    """The Args in force for a task; overrides are fields by name."""
    return Args(**{"env": env_id, **DEFAULTS.get(env_id.split("-")[0], {}), **overrides})


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

    Args of the constructor: n_actions: list of n ints; obs_size: width d of the padded macro-observation; dueling: Q_i = V_i +
    A_i from two heads instead of one.
    """

    def __init__(self, n_actions, obs_size, hidden_size, dueling=False):
        super().__init__()
        n, widest = len(n_actions), max(n_actions)
        self.n_agents, self.widest, self.hidden_size, self.dueling = n, widest, hidden_size, dueling
        self.encoder = AgentLinear(n, obs_size + widest, hidden_size)
        self.gru_input = AgentLinear(n, hidden_size, 3 * hidden_size)
        bound = hidden_size**-0.5
        self.gru_hidden = nn.Parameter(torch.empty(n, hidden_size, 3 * hidden_size).uniform_(-bound, bound))
        self.head = AgentLinear(n, hidden_size, hidden_size)
        self.output = AgentLinear(n, hidden_size, widest + dueling)
        padding = torch.arange(widest) >= torch.tensor(n_actions)[:, None]
        self.register_buffer("padding", padding[:, None], persistent=False)  # [agents, 1, actions]

    def forward(self, obs, previous, hidden, sizes):
        """Runs sequences packed step by step: sizes[t] entries of step t, those of the longest sequences first.

        Args:
            obs: float32 [n, M, d], M = sum(sizes). previous: int64 [n, M], last macro-action of the agent, -1 before its first.
            hidden: float32 [n, sizes[0], H], recurrent state before the first step. sizes: falling list of ints.

        Returns:
            utilities float32 [n, M, A] (-inf for padding actions), values V_i float32 [n, M], hidden states float32 [n, M, H].
        """
        action = (previous[..., None] == torch.arange(self.widest, device=obs.device)).float()  # [agents, M, actions]
        gates = self.gru_input(F.relu(self.encoder(torch.cat([obs, action], 2))))  # [agents, M, 3 hidden]
        if hidden is None:
            hidden = obs.new_zeros(self.n_agents, sizes[0], self.hidden_size)
        states = []
        for step in gates.split(sizes, 1):
            hidden = hidden[:, : step.shape[1]]
            in_reset, in_update, in_new = step.chunk(3, 2)  # [agents, size, hidden] each
            h_reset, h_update, h_new = torch.bmm(hidden, self.gru_hidden).chunk(3, 2)
            reset, update = torch.sigmoid(in_reset + h_reset), torch.sigmoid(in_update + h_update)
            hidden = torch.lerp(torch.tanh(torch.addcmul(in_new, reset, h_new)), hidden, update)
            states.append(hidden)
        states = torch.cat(states, 1)  # [agents, M, hidden]
        output = self.output(F.relu(self.head(states)))  # [agents, M, actions (+ 1)]
        if self.dueling:
            values, utilities = output[..., -1], output[..., :-1] + output[..., -1:]
            return utilities.masked_fill(self.padding, -torch.inf), values, states
        utilities = output.masked_fill(self.padding, -torch.inf)
        return utilities, utilities.amax(2), states


class QPLEXMixer(nn.Module):
    """Duplex dueling (Wang et al. 2021) for agents some of which are ongoing.

    Transformed: Q_i <- w_i(s) Q_i + b_i(s), V_i <- w_i(s) V_i + b_i(s), w_i > 0, and A_i = Q_i - V_i. Then
    Q(h, s, m) = sum_i Q_i + sum_i (lambda_i - 1) stopgrad(A_i), which is sum_i V_i + lambda_i A_i, with
    lambda_i = sum over heads of |key(s)| sigmoid(agents_i(s)) sigmoid(action_i(s, m)) >= 0.

    Args of the constructor: n_actions: list of n ints. state_size: width of the mixer input. embed: width of the
    hypernetworks. heads: attention heads. mask_ongoing: A_i = 0 for ongoing agents. joint_action: lambda_i depends on m.
    """

    def __init__(self, n_actions, state_size, embed=32, heads=4, mask_ongoing=True, joint_action=True):
        super().__init__()
        n, self.widest, self.heads = len(n_actions), max(n_actions), heads
        self.mask_ongoing, self.joint_action = mask_ongoing, joint_action

        def hypernetwork(inputs, outputs):
            return nn.Sequential(nn.Linear(inputs, heads * embed), nn.ReLU(True), nn.Linear(heads * embed, outputs))

        self.of_state = hypernetwork(state_size, 2 * n + heads + heads * n)
        if joint_action:
            self.of_action = hypernetwork(state_size + n * self.widest, heads * n)

    def forward(self, utilities, values, actions, chosen, state):
        """utilities Q_i(h_i, m_i) and values V_i: float32 [..., n]; actions m: int64 [..., n]; chosen: bool [..., n], False
        for ongoing agents; state: float32 [..., S]. Returns the joint values, float32 [...]."""
        if self.mask_ongoing:  # an ongoing agent can only go on: its value is that of its macro-action
            values = torch.where(chosen, values, utilities)
        n = utilities.shape[-1]
        weight, bias, key, agents = self.of_state(state).split([n, n, self.heads, self.heads * n], -1)
        weight = weight.abs() + 1e-10  # positive: the transform keeps each agent's order of macro-actions
        advantages = (weight * (utilities - values)).detach()
        attention = key.abs()[..., None] * torch.sigmoid(agents.unflatten(-1, (self.heads, n)))  # [..., heads, agents]
        if self.joint_action:
            joint = (actions[..., None] == torch.arange(self.widest, device=actions.device)).float()
            inputs = torch.cat([state, joint.flatten(-2)], -1)  # [..., S + agents * actions]
            attention = attention * torch.sigmoid(self.of_action(inputs).unflatten(-1, (self.heads, n)))
        lambdas = attention.sum(-2)  # [..., agents], not negative
        return (weight * utilities + bias + (lambdas - 1) * advantages).sum(-1)


class Batch(NamedTuple):
    """A batch of B windows of up to W decision rows: R rows in all, n agents.

    The agents' own decisions, M entries, are packed as Agents.forward wants them; rows look up their agents' by entry.
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
    state: torch.Tensor  # float32 [R, S], mixer input for the row
    next_state: torch.Tensor  # float32 [R, S], and for its target
    reward: torch.Tensor  # float32 [R], discounted sum until the next row
    discount: torch.Tensor  # float32 [R], gamma^tau, 0 where the episode terminated
    valid: torch.Tensor  # bool [B, W], where the R rows stand in their windows


class ReplayBuffer:
    """Whole episodes as arrays: each agent's own decisions, and joint decision rows that point at them.

    An agent's macro-history moves only when it chooses, so its macro-observations and macro-actions are stored once per
    decision. Row k holds, for each agent, the number of its latest decision; `row` of that decision is the row whose state is
    the agent's macro-state. Episodes are collected in one part of each array (an episode per environment) and copied to the
    other when they end, so a window can never reach into another episode.
    """

    def __init__(self, env, capacity, num_envs, gamma, mixer_state="joint", hidden_size=0):
        """capacity: episodes kept. hidden_size: width of stored recurrent states, 0 to store none."""
        n, rows, d = env.n_agents, env.horizon + 1, env.single_observation_space.shape[1]
        self.capacity, self.gamma, self.mixer_state = capacity, gamma, mixer_state
        self.per_decision = {"obs": (np.float32, d), "action": (np.int16,), "row": (np.int16,)}
        self.per_row = {"decision": (np.int16, n), "state": (np.float32, env.state_size), "reward": (np.float32,)}
        self.per_row |= {"discount": (np.float32,)}
        if hidden_size:
            self.per_decision["hidden"] = (np.float32, hidden_size)
        if mixer_state == "real":
            self.per_row["last_state"] = (np.float32, env.state_size)

        def arrays(episodes):
            data = {key: np.zeros((episodes, n, rows, *shape), dtype) for key, (dtype, *shape) in self.per_decision.items()}
            data |= {key: np.zeros((episodes, rows, *shape), dtype) for key, (dtype, *shape) in self.per_row.items()}
            return data | {"decisions": np.zeros((episodes, n), np.int64), "rows": np.zeros(episodes, np.int64)}

        self.current, self.data = arrays(num_envs), arrays(capacity)
        self.size, self.next = 0, 0

    def decide(self, free, obs, actions, state, hidden=None):
        """Notes a decision row wherever an agent is free: bool [N, n], float32 [N, n, d], int [N, n], float32 [N, S]; hidden:
        recurrent states before the decision, float32 [N, n, H]."""
        now = self.current
        env, agent = np.nonzero(free)
        decision = now["decisions"][env, agent]
        now["obs"][env, agent, decision] = obs[env, agent]
        now["action"][env, agent, decision] = actions[env, agent]
        now["row"][env, agent, decision] = now["rows"][env]
        if "hidden" in now:
            now["hidden"][env, agent, decision] = hidden[env, agent]
        now["decisions"] += free
        env = np.flatnonzero(free.any(1))
        row = now["rows"][env]
        now["decision"][env, row] = now["decisions"][env] - 1
        now["state"][env, row] = state[env]
        now["reward"][env, row], now["discount"][env, row] = 0.0, 1.0
        now["rows"][env] += 1

    def reward(self, rewards, state):
        """Adds a step's rewards, float64 [N], to the running rows: r += gamma^t r_t. state: that before the step."""
        now, env = self.current, np.arange(len(rewards))
        row = now["rows"] - 1
        now["reward"][env, row] += now["discount"][env, row] * rewards
        now["discount"][env, row] *= self.gamma
        if "last_state" in now:
            now["last_state"][env, row] = state

    def finish(self, over, terminated, obs, state, hidden=None):
        """Ends the episodes in over, bool [N], with their final observation, and moves them to the replay memory."""
        now, env = self.current, np.flatnonzero(over)
        last = now["rows"][env] - 1
        now["discount"][env, last] *= ~terminated[env]  # a truncated episode bootstraps
        everybody = np.repeat(over[:, None], now["decisions"].shape[1], 1)
        self.decide(everybody, obs, np.zeros_like(everybody, np.int16), state, hidden)
        slots = (self.next + np.arange(len(env))) % self.capacity
        for key, array in self.data.items():
            array[slots] = now[key][env]
        now["decisions"][env], now["rows"][env] = 0, 0
        self.size, self.next = min(self.size + len(env), self.capacity), (self.next + len(env)) % self.capacity

    def sample(self, batch_size, window, rng, device="cpu"):
        """A Batch of windows, each from a random episode and a random row of it; a short episode starts at row 0."""
        data, agents = self.data, np.arange(self.data["decisions"].shape[1])
        episode = rng.integers(self.size, size=batch_size)
        final = data["rows"][episode] - 1  # the row of the final observation
        start = rng.integers(np.maximum(final - window, 0) + 1)
        end = np.minimum(start + window, final)

        # Each agent's own decisions, from its latest one at the first row, which may precede it, to that at the last row
        first, last = data["decision"][episode, start].astype(int), data["decision"][episode, end]  # [B, agents]
        length = last - first + 1
        rank = np.argsort(np.argsort(-length, axis=0, kind="stable"), axis=0)
        alive = np.arange(length.max()) < length[..., None]  # [B, agents, steps]
        sizes = alive.sum(0).max(0)
        offset = np.cumsum(sizes) - sizes
        b, i, t = np.nonzero(alive)
        decision, at = first[b, i] + t, (i, offset[t] + rank[b, i])
        obs = np.zeros((len(agents), sizes.sum(), data["obs"].shape[-1]), np.float32)
        action, previous = np.zeros(obs.shape[:2], np.int64), np.full(obs.shape[:2], -1)
        obs[at], action[at] = data["obs"][episode[b], i, decision], data["action"][episode[b], i, decision]
        previous[at] = np.where(decision > 0, data["action"][episode[b], i, decision - 1], -1)
        hidden = None
        if "hidden" in data:
            hidden = np.zeros((len(agents), batch_size, data["hidden"].shape[-1]), np.float32)
            hidden[agents, rank] = data["hidden"][episode[:, None], agents, first]

        # The joint rows
        valid = start[:, None] + np.arange(window) < end[:, None]  # [B, W]
        b, k = np.nonzero(valid)  # [R] each
        episode, row = episode[b], start[b] + k
        decision, next_decision = data["decision"][episode, row], data["decision"][episode, row + 1]  # [R, agents]
        entry, next_entry = (offset[of - first[b]] + rank[b] for of in (decision, next_decision))
        own_row = data["row"][episode[:, None], agents, decision]  # [R, agents], where each made its latest decision
        next_own_row = data["row"][episode[:, None], agents, next_decision]
        chosen, next_chosen = own_row == row[:, None], next_own_row == row[:, None] + 1
        if self.mixer_state == "joint":
            state = data["state"][episode[:, None], own_row].reshape(len(row), -1)  # [R, agents * S]
            next_state = data["state"][episode[:, None], next_own_row].reshape(len(row), -1)
        else:
            next_state = data["state"][episode, row + 1]
            if self.mixer_state == "single":  # of the first agent whose macro-action ends at the end of the row
                state = data["state"][episode, own_row[np.arange(len(row)), next_chosen.argmax(1)]]
            else:
                state = data["last_state" if self.mixer_state == "real" else "state"][episode, row]
        reward, discount = data["reward"][episode, row], data["discount"][episode, row]
        batch = Batch(obs, previous, action, hidden, sizes.tolist(), entry, next_entry, chosen, next_chosen, state,
                      next_state, reward, discount, valid)  # fmt: skip
        return Batch(*(torch.from_numpy(x).to(device) if isinstance(x, np.ndarray) else x for x in batch))

    def save(self):
        """The buffer as a dict of tensors without padding, for checkpoints."""
        saved = {"size": self.size, "next": self.next}
        for name, data, count in (("current", self.current, None), ("data", self.data, self.size)):
            masks = self._masks(data, count)
            saved[name] = {key: torch.from_numpy(array[:count][masks[key]]) for key, array in data.items()}
        return saved

    def load(self, saved):
        """Continues from what `save` returned."""
        self.size, self.next = saved["size"], saved["next"]
        for name, data, count in (("current", self.current, None), ("data", self.data, self.size)):
            for key in ("decisions", "rows"):  # first: the masks are made of them
                data[key][:count] = saved[name][key].numpy()
            for key, mask in self._masks(data, count).items():
                data[key][:count][mask] = saved[name][key].numpy()

    def _masks(self, data, count):
        """For each array, where its first `count` episodes hold something."""
        steps = np.arange(data["row"].shape[2])
        filled = {key: steps < data["decisions"][:count, :, None] for key in self.per_decision}
        filled |= {key: steps < data["rows"][:count, None] for key in self.per_row}
        return filled | {"decisions": ..., "rows": ...}


def td_loss(utilities, values, target_utilities, target_values, mixer, target_mixer, batch, td_lambda=0.0, hysteresis=1.0):
    """The loss of Eq. 14 over the valid rows, with double Q-learning.

    Args:
        utilities, target_utilities: float32 [n, M, A], and values, target_values: float32 [n, M], of the batch's decisions.
        mixer, target_mixer: callables (utilities, values, actions, chosen, state) -> joint values [...].
        td_lambda: 0 for one-row targets, up to 1. hysteresis: factor on negative TD errors, 1 for none.

    Returns:
        the loss (scalar tensor), joint values and targets of the valid rows, float32 [rows] each.
    """
    agents = torch.arange(len(utilities), device=utilities.device)
    taken = utilities.gather(2, batch.action[..., None])[..., 0]  # [agents, M]
    action, later_action = batch.action[agents, batch.entry], batch.action[agents, batch.next_entry]  # [R, agents]
    q = mixer(taken[agents, batch.entry], values[agents, batch.entry], action, batch.chosen, batch.state)  # [R]

    with torch.no_grad():
        # The conditional argmax: agents that choose at the next row take the online network's best, the others go on.
        best = torch.where(batch.next_chosen, utilities.argmax(2)[agents, batch.next_entry], later_action)
        next_q, next_v = target_utilities[agents, batch.next_entry, best], target_values[agents, batch.next_entry]
        bootstrap = target_mixer(next_q, next_v, best, batch.next_chosen, batch.next_state)  # [R]
        target = batch.reward + batch.discount * bootstrap
        if td_lambda > 0:  # G[k] = r[k] + gamma^tau ((1 - lambda) Q'[k + 1] + lambda G[k + 1])

            def windows(x):  # [R] -> [B, W]
                return torch.zeros(batch.valid.shape, device=x.device).masked_scatter(batch.valid, x)

            returns, next_values, decay = windows(target), windows(bootstrap), td_lambda * windows(batch.discount)
            decay[:, :-1] *= batch.valid[:, 1:]  # the last row of a window has no further return
            for k in range(returns.shape[1] - 2, -1, -1):
                returns[:, k] += decay[:, k] * (returns[:, k + 1] - next_values[:, k])
            target = returns[batch.valid]
    error = target - q
    return torch.where(error < 0, hysteresis * error, error).square().mean(), q, target


def act(agents, obs, infos, hidden, epsilon, rng):
    """Epsilon-greedy macro-actions of the free agents.

    Args:
        obs: float32 [N, n, d] and infos of the environment's last reset or step. hidden: float32 [n, N, H].
        epsilon: exploration rate. rng: NumPy generator, drawn from only if epsilon > 0.

    Returns:
        actions int64 [N, n] (running agents': the running one) and the new recurrent states, which move only where an agent
        is free.
    """
    free, running = infos["macro_done"], infos["macro_action"]
    inputs = torch.from_numpy(obs).to(hidden.device).transpose(0, 1)  # [agents, N, d]
    previous = torch.from_numpy(running).to(hidden.device).T  # [agents, N]
    with torch.no_grad():
        utilities, _, states = agents(inputs, previous, hidden, [len(obs)])
    moved = torch.from_numpy(free).to(hidden.device).T[..., None]  # [agents, N, 1]
    actions = utilities.argmax(2).T.cpu().numpy()  # [N, agents]
    if epsilon > 0:
        n_actions = (~agents.padding).sum((1, 2)).cpu().numpy()
        draws = rng.random((2, *free.shape))
        actions = np.where(draws[0] < epsilon, (draws[1] * n_actions).astype(np.int64), actions)
    return np.where(free, actions, running), torch.where(moved, states, hidden)


def evaluate(agents, env, gamma, seed, frames=None):
    """Greedy returns: the first episode of each environment in a batch.

    Args:
        env: MacroVectorEnv, reset with the seed. gamma: of the discounted return. frames: a list that receives the pictures
            of environment 0.

    Returns:
        a dict of float64 [N]: return, discounted_return, length, success (0 or 1).
    """
    obs, infos = env.reset(seed=seed)
    device = agents.padding.device
    hidden = torch.zeros(env.n_agents, env.num_envs, agents.hidden_size, device=device)
    live, discount = np.ones(env.num_envs, bool), 1.0
    result = {key: np.zeros(env.num_envs) for key in ("return", "discounted_return", "length", "success")}
    while live.any():
        if frames is not None and live[0]:
            frames.append(env.render()[0])
        actions, hidden = act(agents, obs, infos, hidden, 0.0, None)
        obs, rewards, terminations, truncations, infos = env.step(actions)
        result["return"] += rewards * live
        result["discounted_return"] += discount * rewards * live
        result["length"] += live
        over = terminations | truncations
        result["success"] += infos["success"] & live
        discount *= gamma
        if frames is not None and live[0] and over[0]:
            frames.append(env.render()[0])
        live &= ~over
        if over.any() and live.any():  # ended ones run on unheeded
            obs, infos = env.reset(options={"reset_mask": over})
            hidden[:, torch.from_numpy(over).to(device)] = 0.0
    return result


def make_networks(args, env):
    """Agents and mixer for an environment, on the device, as one module."""
    width = env.n_agents * env.state_size if args.mixer_state == "joint" else env.state_size
    agents = Agents(env.n_actions, env.single_observation_space.shape[1], args.hidden_size, args.advantage == "dueling")
    mixer = QPLEXMixer(
        env.n_actions, width, args.mixing_embed, args.attention_heads, args.mask_ongoing, args.advantage == "max"
    )
    return nn.ModuleDict({"agents": agents, "mixer": mixer}).to(args.device)


def fail(message):
    """Ends the program with one line."""
    raise SystemExit(f"{ALGORITHM}: {message}")


def check(args):
    """Ends the program with one line if an argument is out of range."""
    if args.env not in envs.IDS:
        fail(f"unknown --env {args.env!r}; valid ids: {' '.join(envs.IDS)}")
    at_least = {
        1: "total_timesteps num_envs eval_frequency eval_episodes checkpoint_frequency torch_threads buffer_size batch_size "
        "window exploration_timesteps train_frequency hidden_size mixing_embed attention_heads",
        0: "seed learning_starts learning_rate max_grad_norm reward_scale gamma polyak start_e end_e td_lambda "
        "hysteresis_start hysteresis_end",
    }
    for low, names in at_least.items():
        for name in names.split():
            if not getattr(args, name) >= low:
                fail(f"--{name.replace('_', '-')} must be at least {low}, got {getattr(args, name)}")
    for name in "gamma polyak start_e end_e td_lambda hysteresis_start hysteresis_end".split():
        if getattr(args, name) > 1:
            fail(f"--{name.replace('_', '-')} must be at most 1, got {getattr(args, name)}")
    try:
        torch.zeros(1, device=args.device)
    except (RuntimeError, AssertionError) as error:
        fail(f"--device {args.device} is not available: {str(error).splitlines()[0]}")


def save_atomically(saved, path):
    """Writes beside the file and swaps, so that a kill at any moment leaves the old or the new one whole."""
    torch.save(saved, f"{path}.new")
    os.replace(f"{path}.new", path)


def load_file(folder, name):
    """A dict saved in a run folder, on the CPU."""
    try:
        return torch.load(Path(folder) / name, map_location="cpu", weights_only=True)
    except FileNotFoundError:
        fail(f"there is no {name} in {folder}")
    except Exception as error:
        fail(f"{Path(folder) / name} cannot be read: {str(error).splitlines()[0]}")


def make_run_folder(args):
    """A new folder runs_dir/<env>__<script>__<seed>__<time>, never one that exists."""
    stem, suffix = f"{args.env}__{ALGORITHM}__{args.seed}__{int(time.time())}", 0
    while True:
        folder = Path(args.runs_dir) / (f"{stem}-{suffix}" if suffix else stem)
        try:
            folder.mkdir(parents=True)
            (folder / "args.json").write_text(json.dumps({"algorithm": ALGORITHM, **asdict(args)}, indent=2) + "\n")
            return folder
        except FileExistsError as error:
            if not folder.is_dir():
                fail(f"cannot make the run folder {folder}: {error.strerror}")
            suffix += 1
        except OSError as error:
            fail(f"cannot make the run folder {folder}: {error.strerror}")


def train(args):
    """Trains from Args, or goes on from args.resume, and returns the run folder."""
    check(args)
    torch.set_num_threads(args.torch_threads)
    torch.manual_seed(args.seed)
    rng = np.random.default_rng(args.seed)
    env, eval_env = envs.make(args.env, args.num_envs), envs.make(args.env, args.eval_episodes)
    learner = make_networks(args, env)
    target = copy.deepcopy(learner).requires_grad_(False)
    agents, mixer = learner["agents"], learner["mixer"]
    optimizer = torch.optim.Adam(learner.parameters(), lr=args.learning_rate, fused=True)
    stored = args.hidden_size if args.hidden_state == "stored" else 0
    buffer = ReplayBuffer(env, args.buffer_size, args.num_envs, args.gamma, args.mixer_state, stored)

    step, updates, recent, models = 0, 0, [], {}
    if args.resume:
        folder, saved = Path(args.resume), load_file(args.resume, "checkpoint.pt")
        obs, infos = env.load_state(saved["env"])
        learner.load_state_dict(saved["learner"])
        target.load_state_dict(saved["target"])
        optimizer.load_state_dict(saved["optimizer"])
        buffer.load(saved["buffer"])
        hidden = saved["hidden"].to(args.device)
        rng.bit_generator.state = saved["rng"]
        step, updates, recent, models = saved["step"], saved["updates"], saved["recent"], saved["models"]
    else:
        folder = make_run_folder(args)
        obs, infos = env.reset(seed=args.seed)
        hidden = torch.zeros(env.n_agents, args.num_envs, args.hidden_size, device=args.device)
    writer = SummaryWriter(folder, purge_step=step + 1)
    if not args.resume:
        writer.add_text("hyperparameters", "|name|value|\n|-|-|\n" + "\n".join(f"|{k}|{v}|" for k, v in asdict(args).items()))

    def save_checkpoint():
        arrays = {k: torch.from_numpy(v) if isinstance(v, np.ndarray) else v for k, v in env.save_state().items()}
        saved = dict(learner=learner.state_dict(), target=target.state_dict(), optimizer=optimizer.state_dict(), env=arrays)
        saved |= dict(buffer=buffer.save(), hidden=hidden, rng=rng.bit_generator.state, models=models, recent=recent)
        save_atomically(saved | dict(step=step, updates=updates), folder / "checkpoint.pt")

    # Ctrl-C or a termination signal takes effect between two steps, where a checkpoint is whole; a second one at once.
    stop = []

    def request_stop(number, frame):
        stop.append(number)
        signal.signal(number, previous_handlers[number])

    previous_handlers = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    for number in previous_handlers:
        signal.signal(number, request_stop)

    bar = tqdm(total=args.total_timesteps, initial=step, unit="step", disable=not sys.stderr.isatty(), dynamic_ncols=True)
    started, first_step = time.time(), step
    while step < args.total_timesteps and not stop:
        # Choose and step
        progress = min(1.0, step / args.exploration_timesteps)
        epsilon = args.start_e + progress * (args.end_e - args.start_e)
        state, hidden_before = infos["state"], hidden
        actions, hidden = act(agents, obs, infos, hidden, epsilon, rng)
        if stored:
            buffer.decide(infos["macro_done"], obs, actions, state, hidden_before.transpose(0, 1).cpu().numpy())
        else:
            buffer.decide(infos["macro_done"], obs, actions, state)
        obs, rewards, terminations, truncations, infos = env.step(actions)
        buffer.reward(args.reward_scale * rewards, state)
        step += args.num_envs

        # Store episodes that ended, start new ones
        over = terminations | truncations
        if over.any():
            buffer.finish(over, terminations, obs, infos["state"], hidden.transpose(0, 1).cpu().numpy() if stored else None)
            recent += zip(env.episode_return[over].tolist(), env.elapsed[over].tolist(), strict=True)
            obs, infos = env.reset(options={"reset_mask": over})
            hidden[:, torch.from_numpy(over).to(args.device)] = 0.0

        # Learn
        while updates < (step - args.learning_starts) // args.train_frequency and buffer.size:
            batch = buffer.sample(args.batch_size, args.window, rng, args.device)
            with torch.no_grad():
                next_q, next_v, _ = target["agents"](batch.obs, batch.previous, batch.hidden, batch.sizes)
            q, v, _ = agents(batch.obs, batch.previous, batch.hidden, batch.sizes)
            beta = args.hysteresis_start + progress * (args.hysteresis_end - args.hysteresis_start)
            loss, joint_q, _ = td_loss(q, v, next_q, next_v, mixer, target["mixer"], batch, args.td_lambda, beta)
            optimizer.zero_grad()
            loss.backward()
            grad_norm = nn.utils.clip_grad_norm_(learner.parameters(), args.max_grad_norm)
            optimizer.step()
            with torch.no_grad():
                for slow, fast in zip(target.parameters(), learner.parameters(), strict=True):
                    slow.lerp_(fast, 1 - args.polyak)
            updates += 1
            if updates % 100 == 0:
                writer.add_scalar("losses/td_loss", loss.item(), step)
                writer.add_scalar("losses/q_values", joint_q.mean().item(), step)
                writer.add_scalar("losses/grad_norm", grad_norm.item(), step)

        # Log, evaluate, save
        def due(frequency, step=step):
            return step // frequency > (step - args.num_envs) // frequency or step >= args.total_timesteps

        if due(2_000):
            sps = (step - first_step) / (time.time() - started)
            writer.add_scalar("charts/SPS", sps, step)
            writer.add_scalar("charts/epsilon", epsilon, step)
            bar.update(step - bar.n)
            bar.set_postfix(epsilon=f"{epsilon:.2f}", sps=f"{sps:.0f}", refresh=False)
            if recent:
                mean_return, mean_length = np.mean(recent, 0)
                writer.add_scalar("charts/episodic_return", mean_return, step)
                writer.add_scalar("charts/episodic_length", mean_length, step)
                bar.set_postfix_str(f"return={mean_return:.1f}, {bar.postfix}", refresh=False)
                recent = []
        if due(args.eval_frequency):
            eval_seed = int(np.random.SeedSequence([args.seed, step]).generate_state(1)[0])
            result = {key: x.mean().item() for key, x in evaluate(agents, eval_env, args.gamma, eval_seed).items()}
            for key, value in result.items():
                writer.add_scalar(f"eval/{key}", value, step)
            model = {"step": step, "return": result["return"], "networks": copy.deepcopy(learner.state_dict())}
            models = {"last": model, "best": max(models.get("best", model), model, key=lambda m: m["return"])}
            save_atomically(models, folder / "model.pt")
            bar.write(f"step {step}: greedy return {result['return']:.2f}, success {result['success']:.2f}", file=sys.stderr)
        if due(args.checkpoint_frequency):
            save_checkpoint()

    for number, handler in previous_handlers.items():
        signal.signal(number, handler)
    bar.close()
    save_checkpoint()
    writer.close()
    if stop:
        print(f"stopped at step {step}; go on with: python {ALGORITHM}.py --resume {folder}", file=sys.stderr)
    return folder


def load_args(folder):
    """The Args of a run folder."""
    try:
        saved = json.loads((Path(folder) / "args.json").read_text())
    except OSError as error:
        fail(f"{folder} is not a run folder: args.json: {error.strerror}")
    except json.JSONDecodeError:
        fail(f"{folder} is not a run folder: its args.json is damaged")
    if saved.pop("algorithm", None) != ALGORITHM:
        fail(f"{folder} is a run of another algorithm, not of {ALGORITHM}")
    return Args(**{field.name: saved[field.name] for field in fields(Args) if field.name in saved})


def parse_args(argv=None):
    """Args from the command line; defaults are those of the environment family, or of the run folder that is continued."""
    peek = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
    for flag in ("--env", "--resume", "--evaluate"):
        peek.add_argument(flag)
    known = peek.parse_known_args(argv)[0]
    folder = known.resume or known.evaluate
    base = load_args(folder) if folder else defaults(known.env or Args.env)
    args = tyro.cli(Args, default=base, args=argv)
    free = {"resume", "evaluate", "device", "torch_threads"}
    free |= {"eval_episodes", "gif", "model", "seed"} if known.evaluate else {"total_timesteps", "checkpoint_frequency"}
    for field in fields(Args):
        if folder and field.name not in free and getattr(args, field.name) != getattr(base, field.name):
            fail(f"--{field.name.replace('_', '-')} cannot change: {folder} has {getattr(base, field.name)}")
    return args


def report(args):
    """Evaluates the model of a run folder, prints the result and writes the animation."""
    check(args)
    torch.set_num_threads(args.torch_threads)
    env = envs.make(args.env, args.eval_episodes, render_mode="rgb_array" if args.gif else None)
    learner = make_networks(args, env)
    model = load_file(args.evaluate, "model.pt")[args.model]
    learner.load_state_dict(model["networks"])
    frames = [] if args.gif else None
    result = evaluate(learner["agents"], env, args.gamma, args.seed, frames)
    n = args.eval_episodes
    print(f"{args.env}, {ALGORITHM}, {args.model} model (step {model['step']}), {n} greedy episodes from seed {args.seed}")
    for key, value in result.items():
        error = value.std(ddof=1) / n**0.5 if n > 1 else float("nan")
        print(f"{key.replace('_', ' '):18s}{value.mean():10.3f} +- {error:.3f} (standard error)")
    if args.gif:
        try:
            pictures = [Image.fromarray(frame).quantize(64) for frame in frames]
            pictures[0].save(args.gif, save_all=True, append_images=pictures[1:], duration=1000 // 6, loop=0)
        except (OSError, ValueError) as error:
            fail(f"cannot write {args.gif}: {error}")
        print(f"wrote {args.gif}: {len(frames)} frames")


def main():
    args = parse_args()
    if args.evaluate:
        report(args)
    else:
        print(train(args))


if __name__ == "__main__":
    main()
