"""AVF-QPLEX: asynchronous value factorization with QPLEX's duplex dueling mixer.

Agents run macro-actions of different lengths and decide at different times. Each has a recurrent utility network Q_i
over its own macro-history; a mixer combines the utilities of all of them, of ongoing macro-actions too, into one joint
value, trained on the joint reward (paper: "Value Factorization for Asynchronous Multi-Agent Reinforcement Learning").

    row k             a time step at which at least one agent starts a macro-action; only these are stored (Fig. 2)
    target (Eq. 14)   y = r + gamma^tau Q'(h', s', m*), m*_i = argmax Q_i(h'_i, .) for agents that choose at the next
                      row and the running macro-action for the others: the conditional argmax of Eqs. 5 and 7
    mixer (Eqs. 3-4)  Q(h, s, m) = sum_i V_i + lambda_i(s, m) A_i with lambda_i >= 0, see QPLEXMixer

Numbered deviations from the paper:
 1. Ongoing agents are conditioned on what they can still choose: V_i = Q_i(h_i, m_i), hence A_i = 0. The literal mixer
    (--no-mask-ongoing) breaks Mac-IGM: an ongoing agent's negative advantage is weighted by what the others choose.
 2. A_i = Q_i - max Q_i (Eq. 4), not a dueling head with advantages of any sign (Def. 3.3): with lambda_i(s, m) free
    signs break the consistency of greedy choices (theory/README.md).
 3. The mixer's hypernetworks share one hidden layer of the same total width instead of having one each.
 4. Rewards and values are discounted by gamma^tau between rows. An episode truncated by the horizon bootstraps from its
    final observation, a terminated one does not.
 5. Hyperparameters are ours (docs/defaults.md). They include what the paper does not have: Q(lambda) on Box Pushing and
    Capture Target, hysteretic TD errors on Box Pushing, a falling step size on Capture Target. --td-lambda 0
    --hysteresis-start 1 is the paper's loss.
"""

import argparse
import copy
import importlib.util
import json
import os
import signal
import sys
import time
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np
import torch
import tyro
from torch import nn
from torch.nn import functional as F
from torch.utils.tensorboard import SummaryWriter
from tqdm import tqdm

import envs

ALGORITHM = Path(__file__).stem


def fail(message):
    """Ends the program with one line."""
    raise SystemExit(f"{ALGORITHM}: {message}")


@dataclass
class Args:
    env: str = "wtd-s"  # task, one of envs.IDS
    seed: int = 1  # seed of networks, exploration, replay and environments, from 0 on
    total_timesteps: int = 400_000  # environment steps of the run, over all environments
    num_envs: int = 32  # environments stepped side by side
    eval_frequency: int = 10_000  # environment steps between greedy evaluations
    eval_episodes: int = 20  # episodes of an evaluation, freshly seeded each time
    checkpoint_frequency: float = 60.0  # seconds between checkpoints, from which --resume continues exactly
    runs_dir: str = "runs"  # folder in which each run makes its own
    resume: str | None = None  # run folder of an interrupted run to go on with, with its own settings
    device: str = "cpu"  # torch device, cpu or cuda
    track: bool = False  # log to Weights & Biases too, which takes project and entity from its environment variables

    # Algorithm
    learning_rate: float = 5e-4  # Adam's step size
    learning_rate_end: float | None = None  # step size at total_timesteps, reached linearly; None keeps it constant
    gamma: float = 0.99  # discount per environment step, in [0, 1]
    buffer_size: int = 2_500  # episodes in the replay buffer
    batch_size: int = 64  # windows in an update
    window: int = 25  # consecutive rows in a window
    polyak: float = 0.995  # share of the target network kept at each update; higher is slower
    start_e: float = 1.0  # exploration rate at the start
    end_e: float = 0.05  # exploration rate after exploration_timesteps
    exploration_timesteps: int = 300_000  # environment steps over which the exploration rate falls linearly
    learning_starts: int = 5_000  # environment steps before the first update
    train_frequency: int = 64  # environment steps per gradient update
    max_grad_norm: float = 10.0  # the gradient is scaled down to this norm
    td_lambda: float = 0.0  # lambda of Q(lambda) returns over a window, in [0, 1]; 0 is the paper's one-row target
    hysteresis_start: float = (
        1.0  # factor on negative TD errors at the start; 1 is the paper's loss, less is optimistic
    )
    hysteresis_end: float = 1.0  # that factor from exploration_timesteps on, reached linearly
    hidden_size: int = 64  # width of the agents' layers
    mixing_embed: int = 32  # width of the mixer's hypernetworks
    # mixer input: joint macro-state, one agent's macro-state, true state at the end of the row's interval or at the row
    mixer_state: Literal["joint", "single", "real", "decision"] = "joint"
    mask_ongoing: bool = True  # ongoing agents have advantage 0 (deviation 1)

    def __post_init__(self):
        if self.env not in envs.IDS:
            fail(f"unknown --env {self.env!r}; valid ids: {' '.join(envs.IDS)}")
        shares = "learning_rate learning_rate_end gamma polyak start_e end_e td_lambda hysteresis_start hysteresis_end"
        for name, value in vars(self).items():
            if type(value) in (int, float):
                low = 1 if type(value) is int and name not in ("seed", "learning_starts") else 0
                high = 1 if name in shares.split() else float("inf")
                if not low <= value <= high:
                    fail(f"--{name.replace('_', '-')} must be from {low} to {high}, got {value}")


# Where the environment families need other values; docs/defaults.md says how they were chosen.
DEFAULTS = {
    "wtd": {},
    "bp": dict(total_timesteps=600_000, gamma=0.95, learning_rate=3e-4, exploration_timesteps=500_000,
               td_lambda=0.5, hysteresis_start=0.3),
    "ct": dict(total_timesteps=600_000, num_envs=128, learning_rate=1e-3, learning_rate_end=0.0, gamma=0.9,
               buffer_size=5_000, exploration_timesteps=150_000, train_frequency=256, td_lambda=0.8,
               hidden_size=32, eval_frequency=40_000, eval_episodes=400),
}  # fmt: skip


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

    n_actions: a list of n ints. obs_size: width d of the padded macro-observation. hidden_size: H.
    """

    def __init__(self, n_actions, obs_size, hidden_size):
        super().__init__()
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

    def forward(self, obs, previous, hidden, sizes):
        """Runs sequences packed step by step: sizes[t] entries of step t, those of the longest sequences first.

        obs: float32 [n, M, d], M = sum(sizes). previous: int64 [n, M], the agent's last macro-action, -1 for none.
        hidden: float32 [n, sizes[0], H], the recurrent states before. sizes: falling list of ints.

        Returns utilities float32 [n, M, A], -inf for macro-actions an agent does not have, and states [n, M, H].
        """
        one_hot = previous[..., None] == self.actions  # [n, M, A]
        gates = self.gru_input(F.relu(self.encoder(torch.cat([obs, one_hot], 2))))  # [n, M, 3 H]
        states = []
        for step in gates.split(sizes, 1):
            hidden = hidden[:, : step.shape[1]]
            in_reset, in_update, in_new = step.chunk(3, 2)  # [n, size, H] each
            h_reset, h_update, h_new = torch.bmm(hidden, self.gru_hidden).chunk(3, 2)
            reset, update = torch.sigmoid(in_reset + h_reset), torch.sigmoid(in_update + h_update)
            hidden = torch.lerp(torch.tanh(torch.addcmul(in_new, reset, h_new)), hidden, update)
            states.append(hidden)
        states = torch.cat(states, 1)  # [n, M, H]
        return self.output(F.relu(self.head(states))).masked_fill(self.padding, -torch.inf), states


def over_rows(batch, *networks):
    """Utilities float32 [B, T, n, A] of each network at the rows of a batch.

    A macro-history moves only where its agent chooses, so the networks run over each agent's own decisions, a fraction
    of the rows: packed as Agents.forward wants them, and unpacked to the rows, which look up the latest decision.
    """
    own = batch["chosen"].permute(2, 0, 1).clone()  # [n, B, T]
    own[..., 0] = True  # a window starts with what every agent saw last
    count = own.cumsum(2)  # [n, B, T], decisions up to the row
    length, agents = count[..., -1], torch.arange(len(own), device=own.device)[:, None, None]  # [n, B], [n, 1, 1]
    rank = length.argsort(dim=1, descending=True, stable=True).argsort(dim=1)  # [n, B]
    sizes = (length[..., None] > torch.arange(own.shape[2], device=own.device)).sum(1).amax(0)  # [T]
    entry = (sizes.cumsum(0) - sizes)[count - 1] + rank[..., None]  # [n, B, T], where the latest decision is packed
    obs = batch["obs"].new_zeros(len(own), int(sizes.sum()), batch["obs"].shape[3])  # [n, M, d]
    previous = batch["previous"].new_zeros(obs.shape[:2])  # [n, M]
    # rows with the same latest decision write the same, what the agent saw and did before it
    obs[agents, entry], previous[agents, entry] = batch["obs"].permute(2, 0, 1, 3), batch["previous"].permute(2, 0, 1)
    sizes = sizes[sizes > 0].tolist()
    packed = (network(obs, previous, network.start(sizes[0]), sizes)[0] for network in networks)
    return [utilities[agents, entry].permute(1, 2, 0, 3) for utilities in packed]


class QPLEXMixer(nn.Module):
    """Duplex dueling (Wang et al. 2021) for agents some of which are ongoing.

    Transformed: Q_i <- w_i(s) Q_i + b_i(s), V_i <- w_i(s) V_i + b_i(s), w_i > 0, and A_i = Q_i - V_i. Then
    Q(h, s, m) = sum_i Q_i + sum_i (lambda_i - 1) stopgrad(A_i), which equals sum_i V_i + lambda_i A_i, with
    lambda_i = sum over heads of |key(s)| sigmoid(agent_i(s)) sigmoid(action_i(s, m)) >= 0.

    n_actions: a list of n ints. state_size: width of the mixer input. mask_ongoing: A_i = 0 for ongoing agents.
    """

    def __init__(self, n_actions, state_size, embed=32, heads=4, mask_ongoing=True):
        super().__init__()
        n, widest = len(n_actions), max(n_actions)
        self.heads, self.mask_ongoing = heads, mask_ongoing

        def hypernetwork(inputs, outputs):
            return nn.Sequential(nn.Linear(inputs, heads * embed), nn.ReLU(True), nn.Linear(heads * embed, outputs))

        self.of_state = hypernetwork(state_size, 2 * n + heads + heads * n)
        self.of_action = hypernetwork(state_size + n * widest, heads * n)
        self.register_buffer("actions", torch.arange(widest), persistent=False)

    def forward(self, utilities, values, actions, chosen, state):
        """The joint value, float32 [...].

        utilities, values: Q_i(h_i, m_i) and V_i(h_i), float32 [..., n]. actions: m, int64 [..., n].
        chosen: bool [..., n], False for ongoing agents. state: float32 [..., S].
        """
        n = utilities.shape[-1]
        if self.mask_ongoing:  # an ongoing agent can only go on: its value is that of its macro-action
            values = torch.where(chosen, values, utilities)
        weight, bias, key, agent = self.of_state(state).split([n, n, self.heads, self.heads * n], -1)
        weight = weight.abs() + 1e-10  # positive: the transform keeps each agent's order of macro-actions
        advantages = (weight * (utilities - values)).detach()
        one_hot = (actions[..., None] == self.actions).flatten(-2)  # [..., n * A]
        action = self.of_action(torch.cat([state, one_hot], -1))
        lambdas = key.abs()[..., None] * torch.sigmoid(agent.unflatten(-1, (self.heads, n)))  # [..., heads, n]
        lambdas = lambdas * torch.sigmoid(action.unflatten(-1, (self.heads, n)))  # [..., heads, n]
        lambdas = lambdas.sum(-2)  # [..., n], not negative: no agent gains by a worse advantage
        return (weight * utilities + bias + (lambdas - 1) * advantages).sum(-1)


class ReplayBuffer:
    """Whole episodes of rows (Fig. 2): in each, for every agent, what it last saw, what it runs and since which row.

    The macro-state of an agent is the state of that row. Episodes are collected in `current`, one per environment, and
    copied to `data` when they end: a window cannot reach into another episode.

    capacity: episodes kept. mixer_state: as in Args.
    """

    def __init__(self, env, capacity, gamma, mixer_state):
        self.capacity, self.gamma, self.mixer_state, self.size, self.next = capacity, gamma, mixer_state, 0, 0
        (n, d), state_size = env.single_observation_space.shape, env.state_size
        shapes = {"obs": (n, d), "action": (n,), "since": (n,), "reward": (), "discount": (), "state": (state_size,)}
        if mixer_state == "real":
            shapes["real"] = (state_size,)

        def arrays(episodes):
            rows = {key: (episodes, env.horizon + 1, *shape) for key, shape in shapes.items()}
            kinds = dict.fromkeys(("action", "since", "rows"), np.int64)
            return {k: np.zeros(shape, kinds.get(k, np.float32)) for k, shape in (rows | {"rows": episodes}).items()}

        self.current, self.data = arrays(env.num_envs), arrays(capacity)

    def add(self, obs, actions, chosen, state):
        """Notes a row wherever an agent chooses: float32 [N, n, d], int64 [N, n], bool [N, n], float32 [N, S]."""
        now, env = self.current, np.flatnonzero(chosen.any(1))
        row = now["rows"][env]
        since = np.where(chosen[env], row[:, None], now["since"][env, row - 1])
        new = {"obs": obs[env], "action": actions[env], "since": since, "reward": 0, "discount": 1, "state": state[env]}
        for key, value in new.items():
            now[key][env, row] = value
        now["rows"][env] += 1

    def reward(self, rewards, state):
        """Adds a step's rewards, float64 [N], to the running rows: r += gamma^t r_t. state: the one before the step."""
        now, row = self.current, (np.arange(len(rewards)), self.current["rows"] - 1)
        now["reward"][row] += now["discount"][row] * rewards
        now["discount"][row] *= self.gamma
        if self.mixer_state == "real":
            now["real"][row] = state

    def finish(self, over, terminated, obs, state):
        """Ends the episodes in over, bool [N], with their final observation, and moves them to the replay memory."""
        now, env = self.current, np.flatnonzero(over)
        now["discount"][env, now["rows"][env] - 1] *= ~terminated[env]  # a truncated episode bootstraps
        everybody = np.repeat(over[:, None], obs.shape[1], 1)  # [N, n]
        self.add(obs, np.zeros(everybody.shape, int), everybody, state)
        slots = (self.next + np.arange(len(env))) % self.capacity
        for key, array in self.data.items():
            array[slots] = now[key][env]
        now["rows"][env] = 0
        self.size, self.next = min(self.size + len(env), self.capacity), (self.next + len(env)) % self.capacity

    def sample(self, batch_size, window, rng, device="cpu"):
        """Windows of random episodes, in which every row is as likely as any other: a dict of tensors [B, T, ...].

        T = window + 1: `valid` marks the rows that have a next one, at which the target looks. Windows reach over both
        ends of an episode and are cut there: had all to fit in, the last row, which often has the reward, would be rare.
        """
        data, episode = self.data, rng.integers(self.size, size=(batch_size, 1))
        last = data["rows"][episode] - 1  # [B, 1], the row of the final observation
        start = rng.integers(1 - window, last)
        end, row = np.minimum(start + window, last), np.maximum(start, 0) + np.arange(window + 1)  # [B, 1], [B, T]
        valid, inside, row = row < end, row <= end, np.minimum(row, end)
        batch = {key: data[key][episode, row] for key in ("obs", "action", "reward", "discount")}
        since, episodes = data["since"][episode, row], episode[..., None]  # [B, T, n], [B, 1, 1]
        before = data["action"][episodes, since - 1, np.arange(since.shape[2])]  # [B, T, n]
        batch |= {"valid": valid, "chosen": (since == row[..., None]) & inside[..., None]}
        batch |= {"previous": np.where(since > 0, before, -1), "next_state": data["state"][episode, row]}
        if self.mixer_state == "joint":
            batch["state"] = batch["next_state"] = data["state"][episodes, since].reshape(*row.shape, -1)
        elif self.mixer_state == "single":  # of the first agent whose macro-action ends with the row's interval
            agent = np.roll(batch["chosen"], -1, 1).argmax(2)[..., None]  # [B, T, 1]
            batch["state"] = data["state"][episode, np.take_along_axis(since, agent, 2)[..., 0]]
        else:
            batch["state"] = data["real" if self.mixer_state == "real" else "state"][episode, row]
        return {key: torch.from_numpy(value).to(device) for key, value in batch.items()}


def td_loss(utilities, target_utilities, mixer, target_mixer, batch, td_lambda=0.0, hysteresis=1.0):
    """The loss of Eq. 14 over the R valid rows of a batch, with double Q-learning.

    utilities, target_utilities: float32 [B, T, n, A], of the online and the target networks at the batch's rows.
    mixer, target_mixer: callables (utilities, values, actions, chosen, state) -> joint values [R].
    td_lambda: 0 for one-row targets, up to 1. hysteresis: factor on negative TD errors, 1 for none.

    Returns the loss (scalar tensor), joint values and targets, float32 [R] each.
    """
    here = batch["valid"]  # [B, T], rows that have a next one
    there = F.pad(here, (1, -1))  # [B, T], the rows after them
    chosen, action = batch["chosen"], batch["action"]  # [B, T, n]
    taken = utilities.gather(3, action[..., None])[..., 0]  # [B, T, n]
    q = mixer(*(x[here] for x in (taken, utilities.amax(3), action, chosen, batch["state"])))  # [R]

    with torch.no_grad():
        # The conditional argmax: agents that choose take the online network's best, the others go on.
        best = torch.where(chosen, utilities.argmax(3), action)  # [B, T, n]
        best_q, best_v = target_utilities.gather(3, best[..., None])[..., 0], target_utilities.amax(3)  # [B, T, n]
        bootstrap = target_mixer(*(x[there] for x in (best_q, best_v, best, chosen, batch["next_state"])))  # [R]
        target = batch["reward"][here] + batch["discount"][here] * bootstrap  # [R]
        if td_lambda > 0:  # G[k] = r[k] + gamma^tau ((1 - lambda) Q'[k + 1] + lambda G[k + 1])
            returns, later = torch.zeros(2, *here.shape, device=q.device)  # [B, T] each
            returns[here], later[here] = target, bootstrap
            decay = td_lambda * batch["discount"] * here.roll(-1, 1)  # the last row has no further return
            for k in reversed(range(here.shape[1] - 1)):
                returns[:, k] += decay[:, k] * (returns[:, k + 1] - later[:, k])
            target = returns[here]
    error = target - q
    return torch.where(error < 0, hysteresis * error, error).square().mean(), q, target


def act(agents, obs, infos, hidden, epsilon=0.0, rng=None):
    """Epsilon-greedy macro-actions of the free agents.

    obs: float32 [N, n, d] and infos of the environment's last reset or step. hidden: float32 [n, N, H].
    epsilon: exploration rate. rng: NumPy generator, needed if epsilon > 0.

    Returns actions int64 [N, n] (of ongoing agents the running one), recurrent states that moved where an agent is free.
    """
    free, running = infos["macro_done"], infos["macro_action"]
    by_agent = [torch.from_numpy(x).to(hidden.device).transpose(0, 1) for x in (obs, running, free)]  # [n, N, ...]
    with torch.no_grad():
        utilities, states = agents(*by_agent[:2], hidden, [len(obs)])
    actions = utilities.argmax(2).T.cpu().numpy()  # [N, n]
    if epsilon > 0:
        explore, any_action = rng.random((2, *free.shape))
        actions = np.where(explore < epsilon, (any_action * agents.n_actions).astype(np.int64), actions)
    return np.where(free, actions, running), torch.where(by_agent[2][..., None], states, hidden)


def evaluate(agents, env, gamma, seed):
    """Greedy play: the first episode of each environment of a batch, reset with the seed.

    Returns a dict of float64 [N]: return, discounted_return, length, success (0 or 1).
    """
    obs, infos = env.reset(seed=seed)
    hidden, live, step = agents.start(env.num_envs), np.ones(env.num_envs, bool), 0
    result = {key: np.zeros(env.num_envs) for key in ("return", "discounted_return", "length", "success")}
    while live.any():
        actions, hidden = act(agents, obs, infos, hidden)
        obs, rewards, terminations, truncations, infos = env.step(actions)
        for key, value in zip(result, (rewards, gamma**step * rewards, 1, infos["success"]), strict=True):
            result[key] += live * value
        over, step = terminations | truncations, step + 1
        live &= ~over
        if over.any():  # play on in ended environments without looking
            obs, infos = env.reset(options={"reset_mask": over})
            hidden[:, over] = 0.0
    return result


def make_learner(args, env):
    """Agents and mixer as one module on the device."""
    agents = Agents(env.n_actions, env.single_observation_space.shape[1], args.hidden_size)
    width = env.state_size * (env.n_agents if args.mixer_state == "joint" else 1)
    mixer = QPLEXMixer(env.n_actions, width, args.mixing_embed, mask_ongoing=args.mask_ongoing)
    return nn.ModuleDict({"agents": agents, "mixer": mixer}).to(args.device)


def train(args):
    """Trains from Args, or goes on with the run args.resume; returns the run folder."""
    torch.set_num_threads(1)  # fastest for networks of this size
    torch.manual_seed(args.seed)
    rng = np.random.default_rng(args.seed)
    env, eval_env = envs.make(args.env, args.num_envs), envs.make(args.env, args.eval_episodes)
    learner = make_learner(args, env)
    target, agents = copy.deepcopy(learner).requires_grad_(False), learner["agents"]
    optimizer = torch.optim.Adam(learner.parameters(), lr=args.learning_rate, fused=True)
    buffer = ReplayBuffer(env, args.buffer_size, args.gamma, args.mixer_state)
    obs, infos = env.reset(seed=args.seed)
    hidden, step, updates, recent, models = agents.start(args.num_envs), 0, 0, [], {}
    folder = Path(args.resume) if args.resume else make_run_folder(args)
    if args.resume:
        saved = load(folder, "checkpoint.pt", args.env)
        for part, state in zip((learner, target, optimizer), saved["networks"], strict=True):
            part.load_state_dict(state)
        buffer.size, buffer.next = saved["buffer"]
        for part, arrays in zip((buffer.current, buffer.data), saved["episodes"], strict=True):
            for key, value in arrays.items():
                part[key][: len(value)] = value
        obs, infos = env.load_state(saved["env"])
        rng.bit_generator.state, hidden = saved["rng"], saved["hidden"].to(args.device)
        step, updates, recent, models = saved["progress"]
    if args.track:
        import wandb

        wandb.init(name=folder.name, id=folder.name, resume="allow", config=asdict(args), sync_tensorboard=True)
    writer = SummaryWriter(folder, purge_step=step + 1)

    def checkpoint():
        def tensors(arrays, count=None):
            return {k: torch.from_numpy(v[:count]) if isinstance(v, np.ndarray) else v for k, v in arrays.items()}

        writer.flush()  # what was logged up to here is not logged again after a resume
        save({"run": [ALGORITHM, args.env], "networks": [x.state_dict() for x in (learner, target, optimizer)],
              "buffer": (buffer.size, buffer.next), "env": tensors(env.save_state()),
              "episodes": (tensors(buffer.current), tensors(buffer.data, buffer.size)), "hidden": hidden,
              "rng": rng.bit_generator.state, "progress": (step, updates, recent, models)},
             folder / "checkpoint.pt")  # fmt: skip

    def due(frequency):
        return step // frequency > (step - args.num_envs) // frequency or step >= args.total_timesteps

    stop = []  # Ctrl-C or a termination signal: end between two steps, where a checkpoint is whole
    handlers = {s: signal.signal(s, lambda number, _: stop.append(number)) for s in (signal.SIGINT, signal.SIGTERM)}
    bar = tqdm(total=args.total_timesteps, initial=step, disable=not sys.stderr.isatty())
    started, first_step, saved_at = time.time(), step, time.time()
    while step < args.total_timesteps and not stop:
        # Choose and step
        progress, done = min(1.0, step / args.exploration_timesteps), step / args.total_timesteps
        epsilon = args.start_e + progress * (args.end_e - args.start_e)
        if args.learning_rate_end is not None:
            optimizer.param_groups[0]["lr"] = (1 - done) * args.learning_rate + done * args.learning_rate_end
        actions, moved = act(agents, obs, infos, hidden, epsilon, rng)
        state = infos["state"]
        buffer.add(obs, actions, infos["macro_done"], state)
        obs, rewards, terminations, truncations, infos = env.step(actions)
        buffer.reward(rewards, state)
        hidden, step = moved, step + args.num_envs

        # Store the episodes that ended and start new ones
        over = terminations | truncations
        if over.any():
            buffer.finish(over, terminations, obs, infos["state"])
            recent += zip(env.episode_return[over].tolist(), env.elapsed[over].tolist(), strict=True)
            obs, infos = env.reset(options={"reset_mask": over})
            hidden[:, over] = 0.0

        # Learn
        while updates < (step - args.learning_starts) // args.train_frequency and buffer.size:
            batch = buffer.sample(args.batch_size, args.window, rng, args.device)
            utilities, target_utilities = over_rows(batch, agents, target["agents"])
            beta = args.hysteresis_start + progress * (args.hysteresis_end - args.hysteresis_start)
            mixers = learner["mixer"], target["mixer"]
            loss, joint_q, _ = td_loss(utilities, target_utilities, *mixers, batch, args.td_lambda, beta)
            optimizer.zero_grad()
            loss.backward()
            grad_norm = nn.utils.clip_grad_norm_(learner.parameters(), args.max_grad_norm)
            optimizer.step()
            for slow, fast in zip(target.parameters(), learner.parameters(), strict=True):
                slow.data.lerp_(fast.data, 1 - args.polyak)
            updates += 1
            if updates % 100 == 0:
                for key, value in (("td_loss", loss), ("q_values", joint_q.mean()), ("grad_norm", grad_norm)):
                    writer.add_scalar(f"losses/{key}", value.item(), step)

        # Log, evaluate, save
        if due(2_000) and recent:
            sps, (mean_return, mean_length) = (step - first_step) / (time.time() - started), np.mean(recent, 0)
            for key, value in (("SPS", sps), ("epsilon", epsilon), ("episodic_return", mean_return),
                               ("episodic_length", mean_length)):  # fmt: skip
                writer.add_scalar(f"charts/{key}", value, step)
            bar.set_postfix_str(f"return {mean_return:.1f}, epsilon {epsilon:.2f}", refresh=False)
            bar.update(step - bar.n)
            recent = []
        if due(args.eval_frequency):
            eval_seed = int(np.random.SeedSequence([args.seed, step]).generate_state(1)[0])
            result = {key: x.mean().item() for key, x in evaluate(agents, eval_env, args.gamma, eval_seed).items()}
            for key, value in result.items():
                writer.add_scalar(f"eval/{key}", value, step)
            model = {"step": step, "return": result["return"], "networks": copy.deepcopy(learner.state_dict())}
            models = {"last": model, "best": max(models.get("best", model), model, key=lambda m: m["return"])}
            save({"run": [ALGORITHM, args.env], **models}, folder / "model.pt")
            bar.write(f"step {step}: greedy return {result['return']:.2f}, success {result['success']:.2f}", sys.stderr)
        if time.time() - saved_at > args.checkpoint_frequency or stop:
            checkpoint()
            saved_at = time.time()

    for number, handler in handlers.items():
        signal.signal(number, handler)
    bar.close()
    writer.close()
    if step < args.total_timesteps:
        print(f"stopped at step {step}; go on with: python {ALGORITHM}.py --resume {folder}", file=sys.stderr)
        sys.exit(128 + stop[0])
    (folder / "checkpoint.pt").unlink(missing_ok=True)
    return folder


def save(saved, path):
    """Writes beside the file and swaps, so that a kill at any moment leaves the old one or the new one."""
    torch.save(saved, f"{path}.new")
    os.replace(f"{path}.new", path)


def load(folder, name, env_id):
    """What `save` wrote in a run folder, on the CPU; it must be of this algorithm and task."""
    try:
        saved = torch.load(Path(folder) / name, map_location="cpu", weights_only=True)  # runs no code of the file
    except FileNotFoundError:
        fail(f"there is no {name} in {folder}")
    except Exception as error:  # torch names no common class for what a damaged file raises
        fail(f"{Path(folder) / name} is damaged: {str(error).splitlines()[0]}")
    if saved["run"] != [ALGORITHM, env_id]:
        fail(f"{Path(folder) / name} is of {' on '.join(saved['run'])}, not of {ALGORITHM} on {env_id}")
    return saved


def make_run_folder(args):
    """Makes runs_dir/<env>__<script>__<seed>__<microseconds> with args.json in it."""
    folder = Path(args.runs_dir) / f"{args.env}__{ALGORITHM}__{args.seed}__{time.time_ns() // 1000}"
    try:
        folder.mkdir(parents=True)
        (folder / "args.json.new").write_text(json.dumps({"algorithm": ALGORITHM, **asdict(args)}, indent=2) + "\n")
        os.replace(folder / "args.json.new", folder / "args.json")
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


def parse_args(argv=None):
    """Args from the command line, over the defaults of the task's family or the settings of the run to go on with."""
    peek = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
    peek.add_argument("--env", default=Args.env)
    peek.add_argument("--resume")
    known = peek.parse_known_args(argv)[0]
    family = DEFAULTS.get(known.env.split("-")[0], {})
    base = load_args(known.resume) if known.resume else Args(env=known.env, **family)
    args = tyro.cli(Args, default=base, args=argv)
    if args.resume and replace(args, resume=None, device=base.device) != base:
        fail("--resume goes on with the run's own settings: only --device can be given with it")
    if args.track and importlib.util.find_spec("wandb") is None:
        fail("--track needs Weights & Biases: pip install -e '.[track]'")
    try:
        torch.zeros(1, device=args.device)
    except (RuntimeError, AssertionError) as error:
        fail(f"--device {args.device} is not available: {str(error).splitlines()[0]}")
    return args


if __name__ == "__main__":
    print(train(parse_args()))
