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
import json
import os
import signal
import sys
import time
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Literal

import numpy as np
import torch
import tyro
from torch import nn
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
    device: Literal["cpu", "cuda"] = "cpu"  # where networks learn and act
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
    obs_scale: float = 1.0  # factor on macro-observations inside the networks; more resolves small differences
    reward_scale: float = 1.0  # factor on rewards inside the loss; logged returns are unscaled
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
            low = type(value) is int and name not in ("seed", "learning_starts")
            high = 1 if name in shares.split() else float("inf")
            if type(value) in (int, float) and not low <= value <= high:  # tyro has checked the others' types
                fail(f"--{name.replace('_', '-')} must be from {int(low)} to {high}, got {value}")


# Where the environment families need other values; docs/defaults.md says how they were chosen.
DEFAULTS = {
    "bp": dict(total_timesteps=600_000, gamma=0.95, learning_rate=3e-4, exploration_timesteps=500_000,
               td_lambda=0.5, hysteresis_start=0.3),
    "ct": dict(total_timesteps=600_000, num_envs=128, learning_rate=1e-3, learning_rate_end=0.0, gamma=0.9,
               buffer_size=5_000, exploration_timesteps=150_000, train_frequency=256, td_lambda=0.8,
               obs_scale=4.0, reward_scale=10.0,               hidden_size=32, eval_frequency=40_000, eval_episodes=400),
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

    def __init__(self, n_actions, obs_size, hidden_size, obs_scale=1.0):
        super().__init__()
        n, widest, bound = len(n_actions), max(n_actions), hidden_size**-0.5
        self.n_actions, self.hidden_size, self.obs_scale = np.array(n_actions), hidden_size, obs_scale
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
        gates = self.gru_input(torch.relu(self.encoder(torch.cat([self.obs_scale * obs, one_hot], 2))))  # [n, M, 3 H]
        states = []
        for step in gates.split(sizes, 1):
            hidden = hidden[:, : step.shape[1]]
            in_gates, in_new = step.tensor_split([2 * self.hidden_size], 2)  # [n, size, 2 H], [n, size, H]
            h_gates, h_new = torch.bmm(hidden, self.gru_hidden).tensor_split([2 * self.hidden_size], 2)
            reset, update = torch.sigmoid(in_gates + h_gates).chunk(2, 2)
            hidden = torch.lerp(torch.tanh(torch.addcmul(in_new, reset, h_new)), hidden, update)
            states.append(hidden)
        states = torch.cat(states, 1)  # [n, M, H]
        return self.output(torch.relu(self.head(states))).masked_fill(self.padding, -torch.inf), states


def over_rows(batch, *networks):
    """Utilities float32 [B, T, n, A] of each network at the rows of a batch.

    A macro-history moves only where its agent chooses, so the networks run over each agent's own decisions, a fraction
    of the rows: packed as Agents.forward wants them, and unpacked to the rows, which look up the latest decision.
    """
    own = batch["chosen"].movedim(2, 0).clone()  # [n, B, T]
    own[..., 0] = True  # a window starts with what every agent saw last
    count = own.cumsum(2)  # [n, B, T], decisions up to the row
    length, agents = count[..., -1], torch.arange(len(own), device=own.device)[:, None, None]  # [n, B], [n, 1, 1]
    rank = length.argsort(dim=1, descending=True, stable=True).argsort(dim=1)  # [n, B]
    sizes = (length[..., None] > torch.arange(own.shape[2], device=own.device)).sum(1).amax(0)  # [T]
    entry = (sizes.cumsum(0) - sizes)[count - 1] + rank[..., None]  # [n, B, T], where the latest decision is packed
    obs = batch["obs"].new_zeros(len(own), int(sizes.sum()), batch["obs"].shape[3])  # [n, M, d]
    previous = batch["previous"].new_zeros(obs.shape[:2])  # [n, M]
    # rows with the same latest decision write the same, what the agent saw and did before it
    obs[agents, entry], previous[agents, entry] = batch["obs"].movedim(2, 0), batch["previous"].movedim(2, 0)
    sizes = sizes[sizes > 0].tolist()
    packed = (network(obs, previous, network.start(sizes[0]), sizes)[0] for network in networks)
    return [utilities[agents, entry].movedim(0, 2) for utilities in packed]


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
        agent, action = (torch.sigmoid(x.unflatten(-1, (self.heads, n))) for x in (agent, action))  # [..., heads, n]
        lambdas = (key.abs()[..., None] * agent * action).sum(-2)  # [..., n], not negative: no gain by being worse
        return (weight * utilities + bias + (lambdas - 1) * advantages).sum(-1)


class ReplayBuffer:
    """Whole episodes of rows (Fig. 2), one array [capacity + N, horizon + 1, ...] for each field of a row.

    An agent's macro-state is the state of the row since which it runs its macro-action. `writing` are the episodes that
    run in the environments, `queue` the ended ones (and free places, of no rows), the oldest first.
    """

    def __init__(self, env, capacity):
        (n, d), state = env.single_observation_space.shape, (env.state_size,)
        fields = {
            "obs": ((n, d), np.float32),  # what every agent last saw
            "action": ((n,), np.int64),  # the macro-action that it runs
            "since": ((n,), np.int64),  # and since which row: its macro-history moves where that is this one
            "state": (state, np.float32),
            "real": (state, np.float32),  # the state a step before the next row
            "reward": ((), np.float32),  # sum of gamma^t r_t until the next row
            "discount": ((), np.float32),  # gamma^tau, 0 where the episode terminated
        }
        for name, (shape, kind) in fields.items():
            setattr(self, name, np.zeros((capacity + env.num_envs, env.horizon + 1, *shape), kind))
        self.rows = np.zeros(capacity + env.num_envs, int)  # of each episode
        self.queue, self.writing = np.split(np.arange(len(self.rows)), [capacity])

    def add(self, obs, actions, chosen, state):
        """Notes a row wherever an agent chooses: float32 [N, n, d], int64 [N, n], bool [N, n], float32 [N, S]."""
        env = np.flatnonzero(chosen.any(1))
        at = episode, row = self.writing[env], self.rows[self.writing[env]]
        since = np.where(chosen[env], row[:, None], self.since[episode, row - 1])
        self.obs[at], self.action[at], self.since[at], self.state[at] = obs[env], actions[env], since, state[env]
        self.reward[at], self.discount[at] = 0.0, 1.0
        self.rows[episode] += 1

    def step(self, rewards, discounts, state):
        """Adds a step to the running rows: r += gamma^t r_t. float64 [N] (0 at a terminal step), state before it."""
        at = self.writing, self.rows[self.writing] - 1
        self.reward[at] += self.discount[at] * rewards
        self.discount[at] *= discounts
        self.real[at] = state

    def finish(self, over, obs, infos):
        """Ends the episodes in over, bool [N], with a row for their final observation."""
        self.add(obs, infos["macro_action"], infos["macro_done"] & over[:, None], infos["state"])
        queue = np.append(self.queue, self.writing[over])
        self.writing[over], self.queue = np.split(queue, [over.sum()])
        self.rows[self.writing[over]] = 0

    def sample(self, batch_size, window, mixer_state, rng, device="cpu"):
        """Windows of random episodes, in which every row is as likely as any other: a dict of tensors [B, T, ...].

        T = window + 1: `valid` marks the rows that have a next one, at which the target looks. Windows reach over both
        ends of an episode and are cut there: had all to fit in, the last row, often the one with the reward, were rare.
        """
        ended = self.queue[self.rows[self.queue] > 0]
        episode = ended[rng.integers(len(ended), size=(batch_size, 1))]
        last = self.rows[episode] - 1  # [B, 1], the row of the final observation
        start = rng.integers(1 - window, last)
        end, row = np.minimum(start + window, last), np.maximum(start, 0) + np.arange(window + 1)  # [B, 1], [B, T]
        at, episodes = (episode, np.minimum(row, end)), episode[..., None]
        since, agents = self.since[at], np.arange(self.since.shape[2])  # [B, T, n], [n]
        batch = {key: getattr(self, key)[at] for key in ("obs", "action", "state", "reward", "discount")}
        previous = np.where(since > 0, self.action[episodes, since - 1, agents], -1)  # [B, T, n]
        batch |= dict(valid=row < end, chosen=since == row[..., None], previous=previous, next_state=batch["state"])
        if mixer_state == "joint":
            batch["state"] = batch["next_state"] = self.state[episodes, since].reshape(*row.shape, -1)
        elif mixer_state == "single":  # of the first agent whose macro-action ends with the row's interval
            agent = np.roll(batch["chosen"], -1, 1).argmax(2)[..., None]  # [B, T, 1]
            batch["state"] = self.state[episode, np.take_along_axis(since, agent, 2)[..., 0]]
        elif mixer_state == "real":
            batch["state"] = self.real[at]
        return {key: torch.from_numpy(value).to(device) for key, value in batch.items()}


def td_loss(utilities, target_utilities, mixer, target_mixer, batch, td_lambda=0.0, hysteresis=1.0):
    """The loss of Eq. 14 over the R valid rows of a batch, with double Q-learning.

    utilities, target_utilities: float32 [B, T, n, A], of the online and the target networks at the batch's rows.
    mixer, target_mixer: callables (utilities, values, actions, chosen, state) -> joint values [R].
    td_lambda: 0 for one-row targets, up to 1. hysteresis: factor on negative TD errors, 1 for none.

    Returns the loss (scalar tensor), joint values and targets, float32 [R] each.
    """
    here = batch["valid"]  # [B, T], rows that have a next one
    there = here.roll(1, 1)  # [B, T], the rows after them: a window's last row has none
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
    hidden, live, step, result = agents.start(env.num_envs), np.ones(env.num_envs, bool), 0, {}
    while live.any():
        actions, hidden = act(agents, obs, infos, hidden)
        obs, rewards, terminations, truncations, infos = env.step(actions)
        gains = {
            "return": rewards,
            "discounted_return": gamma**step * rewards,
            "length": 1,
            "success": infos["success"],
        }
        result = {key: result.get(key, 0.0) + live * gain for key, gain in gains.items()}
        over, step = terminations | truncations, step + 1
        live &= ~over
        if over.any():  # play on in ended environments without looking
            obs, infos = env.reset(options={"reset_mask": over})
            hidden[:, over] = 0.0
    return result


def make_learner(args, env):
    """Agents and mixer as one module on the device."""
    sizes = env.single_observation_space.shape[1], args.hidden_size, args.obs_scale
    agents = Agents(env.n_actions, *sizes)
    width = env.state_size * (env.n_agents if args.mixer_state == "joint" else 1)
    mixer = QPLEXMixer(env.n_actions, width, args.mixing_embed, mask_ongoing=args.mask_ongoing)
    return nn.ModuleDict({"agents": agents, "mixer": mixer}).to(args.device)


def train(args, stop=()):
    """Trains from Args, or goes on with the run args.resume, until something is in stop; returns the run folder."""
    torch.set_num_threads(1)  # fastest for networks of this size
    torch.manual_seed(args.seed)
    rng = np.random.default_rng(args.seed)
    env, eval_env = envs.make(args.env, args.num_envs), envs.make(args.env, args.eval_episodes)
    learner = make_learner(args, env)
    target, agents = copy.deepcopy(learner).requires_grad_(False), learner["agents"]
    fast, slow = list(learner.parameters()), list(target.parameters())
    optimizer = torch.optim.Adam(fast, lr=args.learning_rate, fused=True)
    average = torch.optim.swa_utils.get_ema_multi_avg_fn(args.polyak)
    networks, buffer = (learner, target, optimizer), ReplayBuffer(env, args.buffer_size)
    obs, infos = env.reset(seed=args.seed)
    hidden, step, updates, recent, best = agents.start(args.num_envs), 0, 0, [], -np.inf
    folder = Path(args.resume or f"{args.runs_dir}/{args.env}__{ALGORITHM}__{args.seed}__{time.time_ns() // 1000}")
    if args.track:
        import wandb  # optional: pip install -e '.[track]'

        wandb.init(name=folder.name, id=folder.name, resume="allow", config=asdict(args), sync_tensorboard=True)
    if args.resume:
        saved = load(folder / "checkpoint.pt")
        for part, state in zip(networks, saved["networks"], strict=True):
            part.load_state_dict(state)
        vars(buffer).update({key: value.numpy() for key, value in saved["buffer"].items()})
        obs, infos = env.load_state(saved["env"])
        rng.bit_generator.state, hidden = saved["rng"], saved["hidden"].to(args.device)
        step, updates, recent, best = saved["progress"]
    else:
        folder.mkdir(parents=True)
        (folder / "args.json.new").write_text(json.dumps({"algorithm": ALGORITHM, **asdict(args)}, indent=2))
        os.replace(folder / "args.json.new", folder / "args.json")
    writer, bar = (
        SummaryWriter(folder, purge_step=step + 1),
        tqdm(total=args.total_timesteps, initial=step, disable=None),
    )
    started, first_step, saved_at = time.time(), step, time.time()

    def log(group, **values):
        for key, value in values.items():
            writer.add_scalar(f"{group}/{key}", value, step)

    while step < args.total_timesteps and not stop:
        # Choose and step
        progress, done = min(1.0, step / args.exploration_timesteps), step / args.total_timesteps
        epsilon = args.start_e + progress * (args.end_e - args.start_e)
        if args.learning_rate_end is not None:
            optimizer.param_groups[0]["lr"] = (1 - done) * args.learning_rate + done * args.learning_rate_end
        actions, hidden = act(agents, obs, infos, hidden, epsilon, rng)
        state = infos["state"]
        buffer.add(obs, actions, infos["macro_done"], state)
        obs, rewards, terminations, truncations, infos = env.step(actions)
        buffer.step(args.reward_scale * rewards, np.float32(args.gamma) * ~terminations, state)
        step += args.num_envs
        bar.update(args.num_envs)

        # Store the episodes that ended and start new ones
        over = terminations | truncations
        if over.any():
            buffer.finish(over, obs, infos)
            recent += env.episode_return[over].tolist()
            obs, infos = env.reset(options={"reset_mask": over})
            hidden[:, over] = 0.0

        # Learn
        while updates < (step - args.learning_starts) // args.train_frequency and buffer.rows[buffer.queue].any():
            batch = buffer.sample(args.batch_size, args.window, args.mixer_state, rng, args.device)
            utilities = over_rows(batch, agents, target["agents"])
            beta = args.hysteresis_start + progress * (args.hysteresis_end - args.hysteresis_start)
            loss, joint_q, _ = td_loss(*utilities, learner["mixer"], target["mixer"], batch, args.td_lambda, beta)
            optimizer.zero_grad()
            loss.backward()
            grad_norm = nn.utils.clip_grad_norm_(fast, args.max_grad_norm)
            optimizer.step()
            average(slow, fast, None)
            updates += 1
            if updates % 100 == 0:
                log("losses", td_loss=loss, q_values=joint_q.mean(), grad_norm=grad_norm)

        # Log, evaluate, save
        if step % 2_000 < args.num_envs and recent:
            sps = (step - first_step) / (time.time() - started)
            log("charts", SPS=sps, epsilon=epsilon, episodic_return=np.mean(recent))
            recent = []
        if step % args.eval_frequency < args.num_envs or step >= args.total_timesteps:
            seed = args.seed * 10**9 + step  # fresh episodes
            result = {key: x.mean().item() for key, x in evaluate(agents, eval_env, args.gamma, seed).items()}
            log("eval", **result)
            model = dict(step=step, networks=learner.state_dict(), **result)
            save(folder / "last.pt", args, **model)
            if result["return"] >= best:
                best = result["return"]
                save(folder / "best.pt", args, **model)
            bar.write(f"step {step}: greedy return {result['return']:.2f}, success {result['success']:.2f}", sys.stderr)
        if time.time() - saved_at > args.checkpoint_frequency or stop:
            writer.flush()  # what was logged up to here is not logged again after a resume
            arrays = {k: torch.from_numpy(v) if isinstance(v, np.ndarray) else v for k, v in env.save_state().items()}
            save(folder / "checkpoint.pt", args, networks=[part.state_dict() for part in networks], hidden=hidden,
                 buffer={key: torch.from_numpy(value) for key, value in vars(buffer).items()}, env=arrays,
                 rng=rng.bit_generator.state, progress=(step, updates, recent, best))  # fmt: skip
            saved_at = time.time()

    bar.close()
    writer.close()
    if step >= args.total_timesteps:
        (folder / "checkpoint.pt").unlink(missing_ok=True)
    return folder


def save(path, args, **content):
    """Writes beside the file and swaps, so that a kill at any moment leaves the old one or the new one."""
    torch.save({"algorithm": ALGORITHM, "args": asdict(args), **content}, f"{path}.new")
    os.replace(f"{path}.new", path)


def load(path):
    """What `save` wrote, on the CPU."""
    try:
        saved = torch.load(path, map_location="cpu", weights_only=True)  # runs no code of the file
        if saved["algorithm"] != ALGORITHM:
            fail(f"{path} is of {saved['algorithm']}, not of {ALGORITHM}")
        return saved
    except Exception as error:  # torch names no common class for what a damaged file raises
        fail(f"cannot read {path}: {str(error).splitlines()[0]}")


def parse_args(argv=None):
    """Args from the command line, over the defaults of the task's family or the settings of the run to go on with."""
    peek = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
    peek.add_argument("--env")
    peek.add_argument("--resume")
    known, others = peek.parse_known_args(argv)
    if known.resume:
        if known.env or others:
            fail("--resume goes on with the run's own settings: no other flag can be given with it")
        args = Args(**load(Path(known.resume) / "checkpoint.pt")["args"] | {"resume": known.resume})
    else:
        env = known.env or Args.env
        args = tyro.cli(Args, default=Args(env=env, **DEFAULTS.get(env.split("-")[0], {})), args=argv)
    if args.device == "cuda" and not torch.cuda.is_available():
        fail("--device cuda: there is none")
    return args


if __name__ == "__main__":
    stop = []  # Ctrl-C or a termination signal: end between two steps, where a checkpoint is whole
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda number, _: stop.append(number))
    try:
        print(folder := train(parse_args(), stop))
    except (OSError, ImportError) as error:  # a folder that cannot be written, a full disk, no wandb
        fail(error)
    if (folder / "checkpoint.pt").exists():
        print(f"stopped; go on with: python {ALGORITHM}.py --resume {folder}", file=sys.stderr)
        sys.exit(128 + stop[0])
