"""AVF-QMIX: asynchronous value factorization with QMIX's monotonic mixer.

The agents of a team run macro-actions. These last for different numbers of steps, so the agents decide at different
times. Each agent has a recurrent utility network Q_i over its own macro-history. A mixer combines the utilities of all
agents into one joint value, which is trained on the team's reward ("the paper" below: "Value Factorization for
Asynchronous Multi-Agent Reinforcement Learning"). Three ideas carry the whole file:

    row        A time step at which at least one agent is free and starts a macro-action. Only rows are stored (Fig. 2
               of the paper). The steps between two rows are summed up in a reward and a discount.
    available  What an agent can do at a row. A free agent chooses among the macro-actions that it can start. A busy
               agent can only go on. So the paper's argmax given the macro-actions of the busy agents (Eqs. 5 and 7)
               is simply an argmax over what is available.
    target     y = r + gamma^tau Q'(h', s', m*) (Eq. 14). h', s' and m* are of the next row, tau steps later. Q' is the
               target network, and m* is the argmax of the online network over what is available there (double Q).

Shapes: N environments, B episodes, T rows, L decisions of an agent, n agents, A macro-actions of the agent that has
most (an agent with fewer never has the rest available), d numbers of a macro-observation, S of a state, H hidden units.

Numbered deviations from the paper:
 1. An episode that is cut by the horizon bootstraps from its final observation, where every agent counts as free.
 2. Whole episodes are replayed, drawn with replacement, not windows of 25 rows. Targets are Q(lambda) returns. Negative
    TD errors count less at first (--hysteresis, on Box Pushing). docs/defaults.md explains all values.
"""

import argparse
import copy
import json
import sys
import time
from collections import deque
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Literal
from zipfile import ZipFile

import numpy as np
import torch
import tyro
from torch import nn
from torch.utils.tensorboard import SummaryWriter
from tqdm import tqdm

import envs

ALGORITHM = Path(__file__).stem
AT_MOST_1 = ("learning_rate", "gamma", "polyak", "end_e", "td_lambda", "hysteresis")


@dataclass
class Args:
    env: str = "wtd-s"  # task, one of envs.IDS or "module:id", see docs/your-own-task.md
    seed: int = 1  # of networks, exploration, replay and environments; at least 0
    total_timesteps: int = 250_000  # environment steps of the run, over all environments
    num_envs: int = 32  # environments stepped side by side
    eval_frequency: int = 10_000  # environment steps between greedy evaluations
    eval_episodes: int = 20  # episodes of an evaluation, freshly seeded each time
    checkpoint_frequency: float = 60.0  # seconds between checkpoints; --resume goes on exactly
    runs_dir: str = "runs"  # folder in which each run makes its own
    resume: str | None = None  # folder of an interrupted run to go on with, with its own settings
    device: Literal["cpu", "cuda"] = "cpu"  # where networks learn and act
    track: bool = False  # log to Weights & Biases too

    # Algorithm
    learning_rate: float = 1e-3  # Adam's step size
    anneal_lr: bool = True  # let it fall linearly to 0 at total_timesteps
    gamma: float = 0.95  # discount factor of an environment step, in [0, 1]
    buffer_size: int = 2_500  # episodes in the replay buffer
    batch_size: int = 16  # episodes in an update
    polyak: float = 0.995  # share of the target network kept at each update; higher is slower
    learning_starts: int = 5_000  # environment steps with random macro-actions, before the first update
    exploration_timesteps: int = 60_000  # environment steps over which epsilon then falls from 1
    end_e: float = 0.05  # final epsilon
    train_frequency: int = 64  # environment steps per update
    max_grad_norm: float = 10.0  # the gradient is scaled down to this norm
    obs_scale: float = 1.0  # factor on macro-observations in the networks; larger separates similar ones
    reward_scale: float = 0.1  # factor on rewards inside the loss; logged returns are unscaled
    td_lambda: float = 0.8  # lambda of Q(lambda) returns, in [0, 1]; 0 bootstraps as early as possible
    hysteresis: float = 1.0  # factor on negative TD errors; rises to 1 after epsilon's fall, in as many steps
    hidden_size: int = 64  # width of the networks' layers
    ongoing: Literal["update", "detach", "zero"] = "update"  # busy agents' utilities learn, are constants, or are 0
    mixer_state: Literal["joint", "single", "real", "real-both", "decision"] = "joint"  # see mixer_states

    def __post_init__(self):
        for name, value in vars(self).items():
            kind = type(getattr(Args, name))  # of the default
            low = 1 if kind is int and name not in ("seed", "learning_starts") else 0
            high = 1 if name in AT_MOST_1 else 10**15
            if kind in (int, float) and not low <= value <= high:
                raise SystemExit(f"--{name.replace('_', '-')} must be from {low} to {high}, got {value}")


# Other values for the tasks whose ids begin with the key. docs/defaults.md says how they were chosen.
DEFAULTS = {
    "bp-": dict(
        total_timesteps=600_000,
        learning_starts=150_000,
        exploration_timesteps=200_000,
        hysteresis=0.1,
    ),
    "wtd-t": dict(
        total_timesteps=800_000,
        exploration_timesteps=150_000,
        train_frequency=128,
    ),
    "ct-": dict(
        total_timesteps=600_000,
        exploration_timesteps=150_000,
        num_envs=128,
        eval_episodes=400,
        train_frequency=256,
        gamma=0.9,
        obs_scale=4.0,
        reward_scale=10.0,
    ),
}


class AgentLinear(nn.Module):
    """One linear layer for each agent, as a batched product: [n, ..., inputs] -> [n, ..., outputs]."""

    def __init__(self, n_agents, inputs, outputs):
        super().__init__()
        bound = inputs**-0.5
        self.weight = nn.Parameter(torch.empty(n_agents, inputs, outputs).uniform_(-bound, bound))
        self.bias = nn.Parameter(torch.empty(n_agents, 1, outputs).uniform_(-bound, bound))

    def forward(self, x):
        return torch.baddbmm(self.bias, x.flatten(1, -2), self.weight).unflatten(1, x.shape[1:-1])


class Agents(nn.Module):
    """The agents' utility networks Q_i(h_i, .): Linear, ReLU, GRU, Linear, ReLU, Linear.

    Agents share no weights, but their networks have one shape. So they run side by side, as batched products, and the
    GRU is written out. With an nn.GRU for each agent an update would take up to twice as long.
    """

    def __init__(self, n_agents, n_actions, obs_size, hidden_size, obs_scale=1.0):
        super().__init__()
        self.n_actions = n_actions
        self.obs_scale = obs_scale
        self.encoder = AgentLinear(n_agents, obs_size + n_actions, hidden_size)
        self.input_layer = AgentLinear(n_agents, hidden_size, 3 * hidden_size)
        bound = hidden_size**-0.5
        weight = torch.empty(n_agents, hidden_size, 3 * hidden_size).uniform_(-bound, bound)
        self.hidden_weight = nn.Parameter(weight)  # without a bias of its own
        self.head = AgentLinear(n_agents, hidden_size, hidden_size)
        self.output = AgentLinear(n_agents, hidden_size, n_actions)

    def start(self, n_episodes):
        """Hidden states before the first decision: zeros, float32 [n, B, H]."""
        n_agents, hidden_size, _ = self.hidden_weight.shape
        return self.hidden_weight.new_zeros(n_agents, n_episodes, hidden_size)

    def forward(self, obs, previous, hidden):
        """Utilities float32 [n, B, L, A] at the L decisions of each agent in each episode, and the last hidden states.

        obs: float32 [n, B, L, d]. previous: int64 [n, B, L], the macro-action before, or -1. hidden: float32 [n, B, H].
        """
        one_hot = nn.functional.one_hot(previous + 1, self.n_actions + 1)[..., 1:]  # zeros for none
        inputs = torch.cat([self.obs_scale * obs, one_hot], -1)
        encoded = torch.relu(self.encoder(inputs))  # [n, B, L, H]
        states = []
        for from_input in self.input_layer(encoded).unbind(2):  # [n, B, 3 H], decision by decision
            from_hidden = torch.bmm(hidden, self.hidden_weight)  # [n, B, 3 H]
            reset_input, update_input, new_input = from_input.chunk(3, -1)
            reset_hidden, update_hidden, new_hidden = from_hidden.chunk(3, -1)
            reset = torch.sigmoid(reset_input + reset_hidden)
            update = torch.sigmoid(update_input + update_hidden)
            new = torch.tanh(new_input + reset * new_hidden)
            hidden = torch.lerp(new, hidden, update)  # (1 - update) * new + update * hidden
            states.append(hidden)
        states = torch.stack(states, 2)  # [n, B, L, H]
        return self.output(torch.relu(self.head(states))), hidden


def utilities_at_rows(agents, batch):
    """Q_i(h_i, .) of every agent at every row of a batch, float32 [B, T, n, A].

    A macro-history grows only where its own agent chooses, so an agent's network runs over its own decisions alone.
    At a row at which the agent is busy, its utilities are those of its latest decision.
    """
    free = batch["free"].movedim(2, 0)  # [n, B, T]
    decision = free.cumsum(2) - 1  # [n, B, T], index of the latest decision: 0 0 1 if free is 1 0 1
    row = torch.argsort(~free, dim=2, stable=True)  # [n, B, T], decisions' rows, then the others: 0 2 1
    row = row[:, :, : int(decision.max()) + 1]  # [n, B, L]; after an agent's last decision come busy rows, never read
    obs = batch["obs"].movedim(2, 0).take_along_dim(row[..., None], 2)  # from rows to decisions
    previous = batch["previous"].movedim(2, 0).take_along_dim(row, 2)
    utilities, _ = agents(obs, previous, agents.start(len(batch["obs"])))  # [n, B, L, A]
    return utilities.take_along_dim(decision[..., None], 2).movedim(0, 2)  # and back to rows


class QMIXMixer(nn.Module):
    """Q = w_2(s) . ELU(W_1(s) q + b_1(s)) + b_2(s), with q = (Q_1(h_1, m_1), ..., Q_n(h_n, m_n)) (Rashid et al. 2018).

    W_1 and w_2 are absolute values and ELU rises, so Q never falls when a utility rises (Eq. 1 of the paper). What is
    best for an agent is best for the team.
    """

    def __init__(self, n_agents, state_size, embed=32):
        super().__init__()

        def hypernetwork(outputs):
            return nn.Sequential(nn.Linear(state_size, embed), nn.ReLU(), nn.Linear(embed, outputs))

        self.weight_1 = hypernetwork(n_agents * embed)
        self.bias_1 = nn.Linear(state_size, embed)
        self.weight_2 = hypernetwork(embed)
        self.bias_2 = hypernetwork(1)

    def forward(self, utilities, actions, available, state):
        """Joint values float32 [B, T].

        utilities: float32 [B, T, n, A]. actions: int64 [B, T, n]. available: bool [B, T, n, A], for other mixers.
        state: float32 [B, T, S].
        """
        q = utilities.gather(-1, actions[..., None])[..., 0]  # [B, T, n], Q_i(h_i, m_i)
        weight_1 = self.weight_1(state).abs().unflatten(-1, (q.shape[-1], -1))  # [B, T, n, embed]
        weight_2 = self.weight_2(state).abs()  # [B, T, embed]
        mixed = nn.functional.elu((q[..., None] * weight_1).sum(-2) + self.bias_1(state))  # [B, T, embed]
        return (mixed * weight_2).sum(-1) + self.bias_2(state)[..., 0]


class ReplayBuffer:
    """The running episodes of N environments and the last `capacity` that ended. A row is a record of a NumPy array."""

    def __init__(self, env, capacity):
        n_agents, obs_size = env.single_observation_space.shape
        fields = [
            ("obs", np.float32, (n_agents, obs_size)),  # what each agent last saw
            ("available", bool, (n_agents, max(env.n_actions))),  # what it can do
            ("action", np.int64, (n_agents,)),  # the macro-action that it runs from here on
            ("since", np.int64, (n_agents,)),  # the row at which it chose that macro-action
            ("state", np.float32, (env.state_size,)),  # the true state
            ("last_state", np.float32, (env.state_size,)),  # the true state a step before the next row
            ("reward", np.float32),  # the sum of gamma^t r_t over the tau steps until the next row
            ("discount", np.float32),  # gamma^tau, or 0 if the episode terminates at the next row
        ]
        # An episode has at most a row for each step, and a last one for its final observation.
        self.running = np.zeros((env.num_envs, env.horizon + 1), fields)
        self.running_rows = np.zeros(env.num_envs, np.int64)  # rows that each running episode has so far
        self.ended = deque(maxlen=capacity)  # arrays of rows, one for each episode, the oldest first

    def begin_rows(self, obs, infos, actions, free):
        """Begins a row in every environment in which an agent is free.

        obs, infos: of the last reset or step. actions: int64 [N, n], what agents run from now on. free: bool [N, n].
        """
        e = np.flatnonzero(free.any(1))  # the environments that get a row
        k = self.running_rows[e]  # and its number
        rows = np.zeros(len(e), self.running.dtype)
        rows["obs"] = obs[e]
        rows["available"] = infos["available"][e]
        rows["action"] = actions[e]
        rows["since"] = np.where(free[e], k[:, None], self.running["since"][e, k - 1])  # at row 0 all are free
        rows["state"] = infos["state"][e]
        rows["last_state"] = infos["state"][e]  # stays so at a final row
        rows["discount"] = 1.0
        self.running[e, k] = rows
        self.running_rows[e] += 1

    def add_step(self, state, rewards, discounts):
        """Adds a time step to the latest row of every running episode.

        state: float32 [N, S], before the step. rewards: float64 [N]. discounts: float64 [N], gamma, or 0 if terminal.
        """
        latest = np.arange(len(rewards)), self.running_rows - 1
        rows = self.running[latest]
        rows["last_state"] = state
        rows["reward"] += rows["discount"] * rewards
        rows["discount"] *= discounts
        self.running[latest] = rows

    def end_episodes(self, over, obs, infos):
        """Ends episodes that are over, bool [N], with a row whose actions are not used, and moves them to `ended`."""
        self.begin_rows(obs, infos, infos["macro_action"], free=over[:, None] & infos["macro_done"])
        for e in np.flatnonzero(over):
            self.ended.append(self.running[e, : self.running_rows[e]].copy())
        self.running_rows[over] = 0

    def sample(self, batch_size, rng):
        """Random ended episodes, drawn with replacement: a list of arrays of rows."""
        return [self.ended[number] for number in rng.integers(len(self.ended), size=batch_size)]

    def state_dict(self):
        """The rows that were written, for each episode as a tensor of bytes. The running episodes come first."""
        running = [self.running[e, :length] for e, length in enumerate(self.running_rows)]
        return [torch.from_numpy(rows.view(np.uint8)) for rows in [*running, *self.ended]]

    def load_state_dict(self, saved):
        """Goes on with what `state_dict` returned."""
        episodes = [in_bytes.numpy().view(self.running.dtype) for in_bytes in saved]
        for e, rows in enumerate(episodes[: len(self.running)]):
            self.running[e, : len(rows)] = rows
            self.running_rows[e] = len(rows)
        self.ended.extend(episodes[len(self.running) :])


def make_batch(episodes, device="cpu"):
    """Tensors [B, T, ...]: the fields of a row, and those below. Shorter episodes repeat their final row.

    valid: bool [B, T], false at an episode's final row and its repeats. free: bool [B, T, n], agents that choose at the
    row. previous: int64 [B, T, n], what an agent ran before its present macro-action, -1 for nothing.
    macro_state: float32 [B, T, n, S], the state at the row at which an agent chose its present macro-action.
    """
    length = np.array([len(episode) for episode in episodes])  # [B]
    row = np.arange(length.max())  # [T]
    rows = np.stack([episode[np.minimum(row, len(episode) - 1)] for episode in episodes])  # [B, T]
    batch = {name: np.ascontiguousarray(rows[name]) for name in rows.dtype.names}
    since = batch["since"]  # [B, T, n]
    previous = np.take_along_axis(batch["action"], since - 1, axis=1)  # that of the row before `since`
    batch["valid"] = row < length[:, None] - 1
    batch["free"] = since == row[:, None]
    batch["previous"] = np.where(since > 0, previous, -1)
    episode = np.arange(len(episodes))[:, None, None]
    batch["macro_state"] = batch["state"][episode, since]  # [B, T, n, S]
    return {name: torch.as_tensor(array, device=device) for name, array in batch.items()}


def mixer_states(batch, kind):
    """Two mixer states for each row: one for its Q, one for its Q', the bootstrap of the row before.

    Both are float32 [B, T, S], or [B, T, n * S] for "joint". The last row's Q is never used.
    """
    state = batch["state"]
    last_state = batch["last_state"]
    joint = batch["macro_state"].flatten(2)
    agent = batch["free"].roll(-1, 1).int().argmax(2)  # [B, T], the first that is free at the next row
    single = batch["macro_state"].take_along_dim(agent[..., None, None], 2)[:, :, 0]
    return {
        "joint": (joint, joint),  # the macro-states of all agents, the paper's method
        "single": (single, state),  # that of an agent free at the next row, where it is `state`
        "real": (last_state, state),  # the state a step before the next row; for Q' the row's state
        "real-both": (last_state, last_state),  # for Q', too, a step before the row after its own
        "decision": (state, state),  # the row's state for both
    }[kind]


def td_loss(utilities, target_utilities, mixer, target_mixer, batch, args, hysteresis=1.0):
    """The loss of Eq. 14 with Q(lambda) targets, and joint values and targets, float32 [number of valid rows].

    utilities, target_utilities: float32 [B, T, n, A], of the online and of the target networks.
    """
    available = batch["available"]
    best = utilities.masked_fill(~available, -torch.inf).argmax(-1)  # [B, T, n], m*
    free = batch["free"][..., None]
    if args.ongoing == "detach":
        utilities = torch.where(free, utilities, utilities.detach())
    if args.ongoing == "zero":
        utilities = utilities * free
        target_utilities = target_utilities * free
    state, target_state = mixer_states(batch, args.mixer_state)
    q = mixer(utilities, batch["action"], available, state)[:, :-1]  # [B, T - 1]
    with torch.no_grad():
        next_q = target_mixer(target_utilities, best, available, target_state)[:, 1:]  # [B, T - 1], of the next row
        reward, discount, valid = (batch[name][:, :-1] for name in ("reward", "discount", "valid"))
        target = reward + discount * next_q
        # Backwards: y[k] = r[k] + gamma^tau ((1 - lambda) next_q[k] + lambda y[k + 1]), lambda = 0 if k + 1 is final.
        for k in reversed(range(target.shape[1] - 1)):
            bootstrap = torch.lerp(next_q[:, k], target[:, k + 1], args.td_lambda * valid[:, k + 1])
            target[:, k] = reward[:, k] + discount[:, k] * bootstrap
    error = (target - q)[valid]
    error = torch.where(error < 0, hysteresis * error, error)
    return error.square().mean(), q[valid], target[valid]


def act(agents, obs, infos, hidden, epsilon=0.0, rng=None):
    """Epsilon-greedy macro-actions int64 [N, n] and new hidden states. A busy agent can only go on.

    obs: float32 [N, n, d]. infos: those of the last reset or step. hidden: float32 [n, N, H]; only those of free
    agents change. A busy agent has one choice, so its utilities do not matter.
    """
    free = infos["macro_done"]
    available = infos["available"]
    own_obs = torch.as_tensor(obs, device=hidden.device).transpose(0, 1)[:, :, None]  # [n, N, 1, d]
    previous = torch.as_tensor(infos["macro_action"].T[..., None], device=hidden.device)
    with torch.no_grad():
        utilities, new_hidden = agents(own_obs, previous, hidden)
    is_free = torch.as_tensor(free.T[..., None], device=hidden.device)  # [n, N, 1]
    hidden = torch.where(is_free, new_hidden, hidden)
    utilities = utilities[:, :, 0].transpose(0, 1).cpu().numpy()  # [N, n, A]
    actions = np.where(available, utilities, -np.inf).argmax(2)
    if epsilon > 0:
        random_actions = np.where(available, rng.random(available.shape), -1.0).argmax(2)  # uniform
        explores = rng.random(free.shape) < epsilon
        actions = np.where(explores, random_actions, actions)
    return actions, hidden


def evaluate(agents, env, gamma, seed):
    """Greedy play of one episode in each environment: return, discounted_return, length, success, float64 [N] each."""
    obs, infos = env.reset(seed=seed)
    hidden = agents.start(env.num_envs)
    running = np.ones(env.num_envs, bool)
    result = dict.fromkeys(("return", "discounted_return", "length", "success"), 0.0)  # arrays [N] soon
    while running.any():
        actions, hidden = act(agents, obs, infos, hidden)
        obs, rewards, terminations, truncations, infos = env.step(actions)
        result["return"] += running * rewards
        result["discounted_return"] += running * gamma ** result["length"] * rewards
        result["length"] += running
        result["success"] += running & infos["success"]  # true in one step of an episode at most
        over = terminations | truncations
        running &= ~over
        obs, infos = env.reset(options={"reset_mask": over})  # the next ones do not count
        hidden[:, over] = 0.0
    return result


def make_learner(args, env):
    """The agents' networks and the mixer, as one module on the device."""
    agents = Agents(env.n_agents, max(env.n_actions), max(env.obs_sizes), args.hidden_size, args.obs_scale)
    state_size = env.state_size * env.n_agents if args.mixer_state == "joint" else env.state_size
    mixer = QMIXMixer(env.n_agents, state_size)
    return nn.ModuleDict({"agents": agents, "mixer": mixer}).to(args.device)


@contextmanager
def one_line(message):
    """An error in its block ends the program with one line: the message and the first sentence of the error."""
    try:
        yield
    except Exception as error:
        raise SystemExit(f"{message}: {error}".partition(". ")[0].splitlines()[0]) from None


def train(args):
    """Trains, or goes on with the run in args.resume, and returns the run's folder."""
    torch.set_num_threads(1)  # fastest for networks of this size
    if args.device == "cuda" and not torch.cuda.is_available():
        raise SystemExit("--device cuda: there is none")
    seeds = np.random.SeedSequence(args.seed).generate_state(5, np.uint64).tolist()
    network_seed, explore_seed, replay_seed, env_seed, eval_seed = seeds  # no two purposes share random numbers
    torch.manual_seed(network_seed)
    explore_rng = np.random.default_rng(explore_seed)
    replay_rng = np.random.default_rng(replay_seed)
    with one_line("--env"):
        env = envs.make(args.env, args.num_envs)
        eval_env = envs.make(args.env, args.eval_episodes)
    learner = make_learner(args, env)
    agents = learner["agents"]
    mixer = learner["mixer"]
    target = copy.deepcopy(learner).requires_grad_(False)  # the target networks, without gradients
    optimizer = torch.optim.Adam(learner.parameters(), args.learning_rate, fused=True)
    buffer = ReplayBuffer(env, args.buffer_size)
    parts = {"learner": learner, "target": target, "optimizer": optimizer, "buffer": buffer}
    obs, infos = env.reset(seed=env_seed)
    hidden = agents.start(args.num_envs)
    step = 0
    best_return = -np.inf
    run_name = f"{args.env}__{ALGORITHM}__{args.seed}__{time.time_ns() // 1000}".replace(":", "-")
    if args.resume is not None:
        folder = Path(args.resume)
        saved = load(folder / "checkpoint.pt")
        with one_line(f"cannot resume {folder}"):  # the task is not what it was, or the file was edited
            for name, part in parts.items():
                part.load_state_dict(saved[name])
            obs, infos = env.load_state(saved["env"])
            hidden = saved["hidden"].to(args.device)
            explore_rng.bit_generator.state, replay_rng.bit_generator.state = saved["rngs"]
            step, best_return = saved["progress"]
    else:
        folder = Path(args.runs_dir) / run_name
        folder.mkdir(parents=True)
        (folder / "args.json").write_text(json.dumps({"algorithm": ALGORITHM, **asdict(args)}, indent=2))
    if args.track:
        with one_line("--track"):
            import wandb  # optional: pip install -e '.[track]'

            wandb.init(name=folder.name, id=folder.name, resume="allow", config=asdict(args), sync_tensorboard=True)
    writer = SummaryWriter(folder, purge_step=step + 1)  # drops what was logged after the checkpoint
    print(folder, flush=True)
    bar = tqdm(total=args.total_timesteps, initial=step, disable=None)  # no bar without a terminal
    saved_at = -np.inf  # so there is a checkpoint from the first step on

    while step < args.total_timesteps:
        # ---- act: one time step in every environment ----
        phase = (step - args.learning_starts) / args.exploration_timesteps  # epsilon falls while this is in [0, 1]
        epsilon = np.interp(phase, [0, 1], [1.0, args.end_e])
        actions, hidden = act(agents, obs, infos, hidden, epsilon, explore_rng)
        buffer.begin_rows(obs, infos, actions, free=infos["macro_done"])
        state = infos["state"]
        obs, rewards, terminations, truncations, infos = env.step(actions)
        buffer.add_step(state, args.reward_scale * rewards, np.where(terminations, 0.0, args.gamma))
        step += args.num_envs
        bar.update(args.num_envs)
        over = terminations | truncations
        if over.any():
            buffer.end_episodes(over, obs, infos)
            writer.add_scalar("charts/episodic_return", env.episode_return[over].mean(), step)
            obs, infos = env.reset(options={"reset_mask": over})
            hidden[:, over] = 0.0

        # ---- learn: an update for each multiple of train_frequency that was just passed ----
        due = step // args.train_frequency - (step - args.num_envs) // args.train_frequency
        can_learn = step > args.learning_starts and buffer.ended
        for _ in range(due if can_learn else 0):
            if args.anneal_lr:
                optimizer.param_groups[0]["lr"] = args.learning_rate * max(0.0, 1 - step / args.total_timesteps)
            hysteresis = np.interp(phase, [1, 2], [args.hysteresis, 1.0])
            batch = make_batch(buffer.sample(args.batch_size, replay_rng), args.device)
            utilities = utilities_at_rows(agents, batch)
            target_utilities = utilities_at_rows(target["agents"], batch)
            loss, q, _ = td_loss(utilities, target_utilities, mixer, target["mixer"], batch, args, hysteresis)
            optimizer.zero_grad()
            loss.backward()
            grad_norm = nn.utils.clip_grad_norm_(learner.parameters(), args.max_grad_norm)
            if not grad_norm.isfinite():
                raise SystemExit(f"the gradient at step {step} is not finite: {folder} keeps the models before it")
            optimizer.step()
            for slow, fast in zip(target.parameters(), learner.parameters(), strict=True):
                slow.lerp_(fast.detach(), 1 - args.polyak)
            if not step // args.train_frequency % 100:  # one in a hundred
                writer.add_scalar("losses/td_loss", loss, step)
                writer.add_scalar("losses/q_values", q.mean(), step)

        # ---- evaluate at each multiple of eval_frequency that was just passed; log, save ----
        if step % args.eval_frequency < args.num_envs or step >= args.total_timesteps:
            episodes = evaluate(agents, eval_env, args.gamma, eval_seed + step)
            result = {name: values.mean().item() for name, values in episodes.items()}
            for name, value in result.items():
                writer.add_scalar(f"eval/{name}", value, step)
            bar.write(f"step {step}: greedy return {result['return']:.2f}, success {result['success']:.2f}", sys.stderr)
            model = dict(step=step, networks=learner.state_dict(), **result)
            save(folder / "last.pt", args, **model)
            if result["return"] >= best_return:
                best_return = result["return"]
                save(folder / "best.pt", args, **model)
        if time.monotonic() - saved_at > args.checkpoint_frequency:
            writer.flush()  # what was logged up to here outlives a kill
            save(
                folder / "checkpoint.pt",
                args,
                **{name: part.state_dict() for name, part in parts.items()},
                env=env.save_state(),
                hidden=hidden,
                rngs=(explore_rng.bit_generator.state, replay_rng.bit_generator.state),
                progress=(step, best_return),
            )
            saved_at = time.monotonic()

    bar.close()
    writer.close()
    (folder / "checkpoint.pt").unlink()
    return folder


def save(path, args, **content):
    """Writes beside the file and swaps, so that a kill or a full disk leaves the old file or the new one."""
    new = Path(f"{path}.new")
    with one_line(f"cannot write {path}"):
        try:
            torch.save({"algorithm": ALGORITHM, "args": asdict(args), **content}, new)
            new.replace(path)
        finally:
            new.unlink(missing_ok=True)  # half a file, where the disk is full


def load(path):
    """What `save` wrote, on the CPU. Nothing that the file names is run or imported."""
    with one_line(f"cannot read {path}"):
        with ZipFile(path) as archive:
            if archive.testzip():
                raise ValueError("its checksums are wrong")
        saved = torch.load(path, map_location="cpu", weights_only=True)
        if saved["algorithm"] != ALGORITHM or saved["args"].keys() != vars(Args()).keys():
            raise ValueError(f"it is of {saved['algorithm']}, or of another version of {ALGORITHM}")
    return saved


def parse_args(argv=None):
    """The task's defaults, overridden by the command line, or with --resume the settings of that run."""
    peek = argparse.ArgumentParser(add_help=False)
    peek.add_argument("--env")
    peek.add_argument("--resume")
    known, others = peek.parse_known_args(argv)
    if known.resume is not None:
        checkpoint = Path(known.resume) / "checkpoint.pt"
        if not checkpoint.exists():
            raise SystemExit(f"{known.resume} has no checkpoint: it is finished, nothing to resume, or it is not a run")
        saved = load(checkpoint)["args"]
        with one_line(f"cannot resume {known.resume}"):
            own_task = saved["env"] if ":" in saved["env"] else None  # no file decides which module is imported
            if others or known.env != own_task:
                raise ValueError("no other flag can be given, but a task of your own has to be: --env module:id")
            saved["resume"] = known.resume
            return Args(**saved)
    env = known.env or Args.env
    defaults = envs.defaults(env, Args)  # of a task of your own, if it brings some
    for beginning, values in DEFAULTS.items():
        if env.startswith(beginning):
            defaults = values
    return tyro.cli(Args, default=Args(env=env, **defaults), args=argv)


if __name__ == "__main__":
    args = parse_args()
    try:
        train(args)
    except (OSError, envs.TaskError) as error:  # a folder that cannot be written, a task that goes wrong
        raise SystemExit(error) from None
    except KeyboardInterrupt:
        print("stopped; --resume with its folder goes on from its last checkpoint", file=sys.stderr)
        sys.exit(130)
