"""Cen-MADDRQN: one recurrent Q-network over the team's joint macro-history and joint macro-actions.

The fully centralised baseline of Xiao et al. (2020, "Macro-action-based deep multi-agent reinforcement learning"), in
Section 2.2 of the paper. It sees every macro-observation and chooses for every free agent: an upper bound on what there
is to know, but exponential in the number of agents, and nothing that agents could execute on their own.

    the team as one agent   it decides at every row, that is, whenever a macro-action of any agent ends
    macro-history           the latest macro-observation of every agent, who is free, and the macro-actions before
    target (Eq. 5)          y = r + gamma^tau Q'(h', m*), m* the best joint macro-action that leaves the macro-actions
                            of ongoing agents as they are: the conditional argmax

With one agent that decides at every row, replay, loss and training loop are those of avf_vdn.py, to the letter; what is
new is the network `Team`, whose joint macro-actions that would change an ongoing macro-action have the value -inf.

Numbered deviations from the paper and its baseline:
 1. Discounts: gamma^tau between rows, on Box Pushing gamma once a row (--discount). Truncated episodes bootstrap.
 2. The network is told which agents are free and the macro-actions before; the published one sees macro-observations.
 3. Ours (docs/defaults.md): values, whole episodes, random start, Q(lambda), hysteresis, scales, falling step size.
"""

import argparse
import copy
import json
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


@dataclass
class Args:
    env: str = "wtd-s"  # task, one of envs.IDS or "module:id", see envs.register
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
    learning_rate: float = 1e-3  # Adam's step size
    learning_rate_end: float = 0.0  # share of the step size left at total_timesteps, reached linearly
    gamma: float = 0.95  # discount factor, in [0, 1]
    discount: Literal["step", "decision"] = "step"  # gamma for each step of a row, or once a row however long it is
    buffer_size: int = 2_500  # episodes in the replay buffer
    batch_size: int = 16  # episodes in an update
    window: int = 100  # rows of an episode at most; where it begins later on, recurrent states are zeros too
    polyak: float = 0.995  # share of the target network kept at each update; higher is slower
    learning_starts: int = 5_000  # environment steps at random before the first update
    exploration_timesteps: int = 150_000  # steps after these over which the exploration rate falls from 1, linearly
    end_e: float = 0.05  # exploration rate from then on
    train_frequency: int = 64  # environment steps per gradient update
    max_grad_norm: float = 10.0  # the gradient is scaled down to this norm
    obs_scale: float = 1.0  # factor on macro-observations inside the networks; more resolves small differences
    reward_scale: float = 0.1  # factor on rewards inside the loss; logged returns are unscaled
    td_lambda: float = 0.8  # lambda of Q(lambda) returns over a window, in [0, 1]; 0 is the paper's one-row target
    hysteresis: float = 1.0  # factor on negative TD errors while exploring, 1 from twice as many steps on; 1: none
    hidden_size: int = 64  # width of the agents' layers

    def __post_init__(self):
        if problem := envs.problem(self.env):
            raise SystemExit(f"--env: {problem}")
        shares = "learning_rate learning_rate_end gamma polyak end_e td_lambda hysteresis"
        for name, value in vars(self).items():
            low = type(value) is int and name not in ("seed", "learning_starts")
            high = 1 if name in shares.split() else float("inf")
            if type(value) in (int, float) and not low <= value <= high:  # tyro has checked the others' types
                raise SystemExit(f"--{name.replace('_', '-')} must be from {int(low)} to {high}, got {value}")


# Where tasks whose ids start so need other values; docs/defaults.md says how they were chosen.
DEFAULTS = {
    "bp": dict(discount="decision", learning_starts=150_000, exploration_timesteps=250_000, total_timesteps=600_000,
               td_lambda=0.8, hysteresis=0.1),
    "wtd-t": dict(total_timesteps=800_000, train_frequency=128),
    "ct": dict(num_envs=128, train_frequency=256, gamma=0.9, obs_scale=4.0, reward_scale=10.0, td_lambda=0.8,
               total_timesteps=600_000, eval_episodes=400),
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


class Team(nn.Module):
    """The team's network, H = hidden_size wide: a value for each of the J joint macro-actions."""

    def __init__(self, n_actions, obs_size, hidden_size, obs_scale=1.0):
        super().__init__()
        self.n_actions, self.hidden_size, self.obs_scale = np.array(n_actions), hidden_size, obs_scale
        self.parts = np.indices(n_actions).reshape(len(n_actions), -1).T  # [J, n], each agent's macro-action
        bound, columns = hidden_size**-0.5, np.arange(max(n_actions))
        one_hot = torch.tensor(self.parts[..., None] == columns, dtype=torch.float32)  # [J, n, A]
        one_hot = nn.functional.pad(one_hot, (0, 0, 0, 0, 0, 1))  # [J + 1, n, A], zeros for -1
        self.register_buffer("one_hot", one_hot, persistent=False)
        self.encoder = AgentLinear(1, len(n_actions) * (obs_size + 1 + len(columns)), hidden_size)
        self.gru_input = AgentLinear(1, hidden_size, 3 * hidden_size)
        self.gru_hidden = nn.Parameter(torch.empty(1, hidden_size, 3 * hidden_size).uniform_(-bound, bound))
        self.head = AgentLinear(1, hidden_size, hidden_size)
        self.output = AgentLinear(1, hidden_size, len(self.parts))

    def join(self, actions):
        """The number of a joint macro-action, int64 [...], of its parts, int64 [..., n]; -1 where they are -1."""
        strides = torch.tensor(np.append(self.n_actions[:0:-1].cumprod()[::-1], 1), device=actions.device)
        return torch.where(actions[..., 0] < 0, -1, (actions * strides).sum(-1))

    def start(self, count):
        """The recurrent states before the first decisions of count episodes: zeros, float32 [n, count, H]."""
        return self.gru_hidden.new_zeros(len(self.gru_hidden), count, self.hidden_size)

    def forward(self, obs, previous, hidden, sizes):
        """Values float32 [1, M, J], -inf for what would change an ongoing macro-action, and recurrent states [1, M, H].
        Sequences are packed step by step: sizes[t] entries of step t, the longest first, M in all. obs: float32
        [1, M, n * d + n], all agents' and who is free. previous: int64 [1, M], the joint macro-action before, -1 for
        none. hidden: float32 [1, sizes[0], H]."""
        before = self.one_hot[previous]  # [1, M, n, A]
        inputs = torch.cat([self.obs_scale * obs, before.flatten(2)], 2)
        gates = self.gru_input(torch.relu(self.encoder(inputs)))  # [1, M, 3 H]
        states = []
        for step in gates.split(sizes, 1):
            hidden = hidden[:, : step.shape[1]]
            in_reset, in_update, in_new = step.chunk(3, 2)  # [1, size, H] each
            h_reset, h_update, h_new = torch.bmm(hidden, self.gru_hidden).chunk(3, 2)
            reset, update = torch.sigmoid(in_reset + h_reset), torch.sigmoid(in_update + h_update)
            hidden = torch.lerp(torch.tanh(torch.addcmul(in_new, reset, h_new)), hidden, update)
            states.append(hidden)
        states = torch.cat(states, 1)  # [1, M, H]
        ongoing = 1 - obs[..., -before.shape[2] :]  # [1, M, n]
        # how many ongoing macro-actions each joint macro-action leaves as they are: it must be all
        kept = (ongoing[..., None] * before).flatten(2) @ self.one_hot[:-1].flatten(1).T  # [1, M, J]
        changed = kept < ongoing.sum(2, keepdim=True) - 0.5  # [1, M, J]
        return self.output(torch.relu(self.head(states))).masked_fill(changed, -torch.inf), states


def over_rows(batch, *networks):
    """Utilities float32 [B, T, n, A] of each network at the rows of a batch.
    A macro-history moves where its agent chooses: networks run over own decisions, packed; rows look up the last."""
    chosen = batch["chosen"].movedim(2, 0)  # [n, B, T]
    step = chosen.cumsum(2) - chosen[..., :1].int()  # [n, B, T], a window begins with what its agents saw last
    length = step[..., -1:]  # [n, B, 1]
    rank = length.argsort(dim=1, descending=True, stable=True).argsort(dim=1)  # [n, B, 1]
    sizes = (length >= torch.arange(step.shape[2], device=step.device)).sum(1).amax(0)  # [T]
    entry = (sizes.cumsum(0) - sizes)[step] + rank  # [n, B, T], where the latest decision is packed
    agents = torch.arange(len(step), device=step.device)[:, None, None]
    obs = batch["obs"].new_zeros(len(step), int(sizes.sum()), batch["obs"].shape[3])  # [n, M, d]
    previous = batch["previous"].new_zeros(obs.shape[:2])  # [n, M]
    obs[agents, entry] = batch["obs"].movedim(2, 0)  # rows with the same latest decision write the same
    previous[agents, entry] = batch["previous"].movedim(2, 0)
    sizes = sizes[sizes > 0].tolist()
    return [net(obs, previous, net.start(sizes[0]), sizes)[0][agents, entry].movedim(0, 2) for net in networks]


def team_batch(batch, team):
    """The batch of the team as one agent, which decides at every row."""
    inside = (batch["valid"] | batch["valid"].roll(1, 1))[..., None]  # [B, T, 1], with the row after the window
    last = (inside.cumsum(1) - 1).expand_as(batch["chosen"])  # [B, T, n], beyond the window that at its end
    free = batch["chosen"].gather(1, last)  # [B, T, n]
    before = torch.where(free, batch["previous"], batch["action"])  # [B, T, n]
    obs = torch.cat([batch["obs"].flatten(2), free], 2)[:, :, None]  # [B, T, 1, n * d + n]
    action, previous = team.join(batch["action"])[..., None], team.join(before)[..., None]  # [B, T, 1]
    return batch | dict(obs=obs, action=action, previous=previous, chosen=inside)


class ReplayBuffer:
    """Whole episodes of rows (Fig. 2), one array [capacity + N, horizon + 1, ...] for each field of a row.
    writing: the N episodes that run in the environments. queue: ended ones, the oldest first, after free places."""

    def __init__(self, env, capacity):
        n, d = env.single_observation_space.shape
        fields = {
            "obs": (n, d),  # what every agent last saw
            "action": (n,),  # the macro-action that it runs
            "since": (n,),  # and since which row: its macro-history moves where that is this one
            "reward": (),  # sum of gamma^t r_t until the next row
            "discount": (),  # gamma^tau (1 with --discount decision), 0 where the episode terminated
        }
        for name, shape in fields.items():
            kind = int if name in ("action", "since") else np.float32
            setattr(self, name, np.zeros((capacity + env.num_envs, env.horizon + 1, *shape), kind))
        self.rows = np.zeros(capacity + env.num_envs, int)  # of each episode
        self.queue, self.writing = np.split(np.arange(len(self.rows)), [capacity])

    def add(self, obs, actions, chosen):
        """Notes a row wherever an agent chooses: float32 [N, n, d], int64 [N, n], bool [N, n]."""
        env = np.flatnonzero(chosen.any(1))
        at = episode, row = self.writing[env], self.rows[self.writing[env]]
        since = np.where(chosen[env], row[:, None], self.since[episode, row - 1])
        self.obs[at], self.action[at], self.since[at] = obs[env], actions[env], since
        self.reward[at], self.discount[at] = 0.0, 1.0
        self.rows[episode] += 1

    def step(self, rewards, discounts, over, obs, infos):
        """Adds a step to the running rows, r += gamma^t r_t, and ends the episodes in over, bool [N], with a row for
        their final observation. rewards, discounts: float64 [N], the latter gamma, 0 at a terminal step."""
        at = self.writing, self.rows[self.writing] - 1
        self.reward[at] += self.discount[at] * rewards
        self.discount[at] *= discounts
        self.add(obs, infos["macro_action"], infos["macro_done"] & over[:, None])
        self.writing[over], self.queue = np.split(np.append(self.queue, self.writing[over]), [over.sum()])
        self.rows[self.writing[over]] = 0

    def sample(self, batch_size, window, rng, device="cpu"):
        """Random episodes, of longer ones a window: tensors [B, T, ...] by name, `valid` marks rows with a next one.
        Windows reach over both ends and are cut there: every row of an episode is as likely as any other."""
        episode = rng.choice(self.queue[self.rows[self.queue] > 0], (batch_size, 1))
        last = self.rows[episode] - 1  # [B, 1], the row of the final observation
        start = (last > window) * rng.integers(1 - window, last)  # 0 where the whole episode fits
        end = np.minimum(start + window, last)
        row = np.maximum(start, 0) + np.arange(min(window, last.max()) + 1)  # [B, T]
        at = episode, np.minimum(row, end)
        since = self.since[at]  # [B, T, n]
        before = episode[..., None], since - 1, np.arange(since.shape[2])
        batch = {key: getattr(self, key)[at] for key in ("obs", "action", "reward", "discount")}
        previous = np.where(since > 0, self.action[before], -1)  # [B, T, n]
        batch |= dict(valid=row < end, chosen=since == row[..., None], previous=previous)
        return {key: torch.from_numpy(value).to(device) for key, value in batch.items()}


def td_loss(utilities, target_utilities, batch, td_lambda=0.0, hysteresis=1.0):
    """The loss of Eq. 5, with double Q-learning; values and targets float32 [R] of the R valid rows of a team's batch.
    utilities, target_utilities: float32 [B, T, 1, J]. td_lambda: 0 for one-row targets, up to 1.
    hysteresis: factor on negative TD errors, 1 for none."""
    here = batch["valid"]  # [B, T], rows that have a next one
    there = here.roll(1, 1)  # [B, T], the rows after them: a window's last row has none
    chosen, action = batch["chosen"], batch["action"]  # [B, T, n]
    taken = utilities.gather(3, action[..., None])[..., 0]  # [B, T, n]
    q = taken[here].squeeze(1)  # [R]
    with torch.no_grad():
        # The conditional argmax: joint macro-actions that would change an ongoing one have the value -inf.
        best = torch.where(chosen, utilities.argmax(3), action)  # [B, T, n]
        best_q = target_utilities.gather(3, best[..., None])[..., 0]  # [B, T, n]
        bootstrap = best_q[there].squeeze(1)  # [R]
        following = torch.zeros_like(batch["reward"]).masked_scatter(here, bootstrap)  # [B, T]
        returns = list((batch["reward"] + batch["discount"] * following).unbind(1))  # one-row ones, [B] each
        longer = (td_lambda * batch["discount"] * here.roll(-1, 1)).unbind(1)  # none beyond a window's last row
        # G[k] = r[k] + gamma^tau ((1 - lambda) Q'[k + 1] + lambda G[k + 1])
        for k in reversed(range(len(returns) - 1) if td_lambda else ()):
            returns[k] = torch.addcmul(returns[k], longer[k], returns[k + 1] - following[:, k])
        target = torch.stack(returns, 1)[here]  # [R]
    error = target - q
    return torch.where(error < 0, hysteresis * error, error).square().mean(), q, target


def act(team, obs, infos, hidden, epsilon=0.0, rng=None):
    """Epsilon-greedy macro-actions int64 [N, n], the team's best or, with probability epsilon, random ones of all free
    agents, and recurrent states float32 [1, N, H], moved where an agent is free. obs, float32 [N, n, d], and infos are
    those of the environment's last reset or step."""
    free, running = infos["macro_done"], infos["macro_action"]
    team_obs = np.concatenate([obs.reshape(len(obs), -1), free], 1, dtype=np.float32)  # [N, n * d + n]
    inputs = (torch.from_numpy(x).to(hidden.device)[None] for x in (team_obs, running, free.any(1)))  # [1, N, ...]
    team_obs, before, moved = inputs
    with torch.no_grad():
        utilities, states = team(team_obs, team.join(before), hidden, [len(obs)])
    actions = team.parts[utilities.argmax(2)[0].cpu().numpy()]  # [N, n]
    if epsilon > 0:
        explore = rng.random((len(obs), 1)) < epsilon
        actions = np.where(explore, rng.integers(team.n_actions, size=free.shape), actions)
    return np.where(free, actions, running), torch.where(moved[..., None], states, hidden)


def evaluate(agents, env, gamma, seed):
    """Greedy play: return, discounted_return, length, success of each environment's first episode, float64 [N] each."""
    obs, infos = env.reset(seed=seed)
    hidden, live, step, result = agents.start(env.num_envs), np.ones(env.num_envs, bool), 0, {}
    while live.any():
        actions, hidden = act(agents, obs, infos, hidden)
        obs, rewards, terminations, truncations, infos = env.step(actions)
        new = {"return": rewards, "discounted_return": gamma**step * rewards, "length": 1, "success": infos["success"]}
        result = {key: result.get(key, 0.0) + live * value for key, value in new.items()}
        over = terminations | truncations
        live &= ~over
        step += 1
        obs, infos = env.reset(options={"reset_mask": over})  # play on in ended environments without looking
        hidden[:, over] = 0.0
    return result


def make_learner(args, env):
    """The team's network in a module on the device."""
    if (joint := np.prod(env.n_actions, dtype=float)) > 2**15:
        raise SystemExit(f"{args.env} has {joint:,.0f} joint macro-actions, the limit is {2**15:,}")
    team = Team(env.n_actions, env.single_observation_space.shape[1], args.hidden_size, args.obs_scale)
    return nn.ModuleDict({"agents": team}).to(args.device)


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
    buffer = ReplayBuffer(env, args.buffer_size)
    step_gamma, row_gamma = (args.gamma, 1.0) if args.discount == "step" else (1.0, args.gamma)
    obs, infos = env.reset(seed=args.seed)
    hidden, step, updates, recent, best = agents.start(args.num_envs), 0, 0, [], -np.inf
    folder = Path(args.resume or f"{args.runs_dir}/{args.env}__{ALGORITHM}__{args.seed}__{time.time_ns() // 1000}")
    if args.track:
        import wandb  # optional: pip install -e '.[track]'

        wandb.init(name=folder.name, id=folder.name, resume="allow", config=asdict(args), sync_tensorboard=True)
    if args.resume:
        saved = load(folder / "checkpoint.pt")
        for part, state in zip((learner, target, optimizer), saved["parts"], strict=True):
            part.load_state_dict(state)
        vars(buffer).update({key: value.numpy() for key, value in saved["buffer"].items()})
        obs, infos = env.load_state(saved["env"])
        rng.bit_generator.state, hidden = saved["rng"], saved["hidden"].to(args.device)
        step, updates, recent, best = saved["counts"]
    else:
        folder.mkdir(parents=True)
        (folder / "args.json.new").write_text(json.dumps({"algorithm": ALGORITHM, **asdict(args)}, indent=2))
        (folder / "args.json.new").replace(folder / "args.json")
    writer = SummaryWriter(folder, purge_step=step + 1)
    bar = tqdm(total=args.total_timesteps, initial=step, disable=None)  # none where there is no terminal
    time0, step0, saved_at = time.time(), step, time.time()

    def log(group, **values):
        for key, value in values.items():
            writer.add_scalar(f"{group}/{key}", value, step)

    while step < args.total_timesteps:
        # Choose and step
        epsilon = np.interp(step - args.learning_starts, [0, args.exploration_timesteps], [1.0, args.end_e])
        done = step / args.total_timesteps
        optimizer.param_groups[0]["lr"] = args.learning_rate * (1 + done * (args.learning_rate_end - 1))
        actions, hidden = act(agents, obs, infos, hidden, epsilon, rng)
        buffer.add(obs, actions, infos["macro_done"])
        obs, rewards, terminations, truncations, infos = env.step(actions)
        over = terminations | truncations
        buffer.step(args.reward_scale * rewards, step_gamma * ~terminations, over, obs, infos)
        step += args.num_envs
        bar.update(args.num_envs)
        if over.any():
            recent += env.episode_return[over].tolist()
            obs, infos = env.reset(options={"reset_mask": over})
            hidden[:, over] = 0.0

        # Learn
        while updates < (step - args.learning_starts) // args.train_frequency and buffer.rows[buffer.queue].any():
            batch = team_batch(buffer.sample(args.batch_size, args.window, rng, args.device), agents)
            batch["discount"] *= row_gamma
            utilities = over_rows(batch, agents, target["agents"])
            beta = np.interp((step - args.learning_starts) / args.exploration_timesteps, [1, 2], [args.hysteresis, 1.0])
            loss, joint_q, _ = td_loss(*utilities, batch, args.td_lambda, beta)
            optimizer.zero_grad()
            loss.backward()
            grad_norm = nn.utils.clip_grad_norm_(fast, args.max_grad_norm)
            optimizer.step()
            torch.optim.swa_utils.get_ema_multi_avg_fn(args.polyak)(slow, fast, None)
            updates += 1
            if updates % 100 == 0:
                log("losses", td_loss=loss, q_values=joint_q.mean(), grad_norm=grad_norm)

        # Log, evaluate, save
        if step % 2_000 < args.num_envs and recent:
            log("charts", SPS=(step - step0) / (time.time() - time0), epsilon=epsilon, episodic_return=np.mean(recent))
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
            parts = [part.state_dict() for part in (learner, target, optimizer)]
            memory = {key: torch.from_numpy(value) for key, value in vars(buffer).items()}
            save(folder / "checkpoint.pt", args, parts=parts, buffer=memory, env=arrays, hidden=hidden,
                 rng=rng.bit_generator.state, counts=(step, updates, recent, best))  # fmt: skip
            saved_at = time.time()
            if stop:
                break

    bar.close()
    writer.close()
    if step >= args.total_timesteps:
        (folder / "checkpoint.pt").unlink(missing_ok=True)
    return folder


def save(path, args, **content):
    """Writes beside the file and swaps, so that a kill at any moment leaves the old one or the new one."""
    torch.save({"algorithm": ALGORITHM, "args": asdict(args), **content}, f"{path}.new")
    Path(f"{path}.new").replace(path)


def load(path):
    """What `save` wrote, on the CPU."""
    try:
        saved = torch.load(path, map_location="cpu", weights_only=True)  # runs no code of the file
        if saved["algorithm"] != ALGORITHM:
            raise SystemExit(f"{path} is of {saved['algorithm']}, not of {ALGORITHM}")
        Args(**saved["args"])  # fails where a setting is not one of this version
        return saved
    except Exception as error:  # torch names no common class for what a damaged file raises
        raise SystemExit(f"cannot read {path}: {error}".splitlines()[0]) from None


def parse_args(argv=None):
    """Args from the command line, over the defaults of the task or the settings of the run to go on with."""
    peek = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
    peek.add_argument("--env")
    peek.add_argument("--resume")
    known, others = peek.parse_known_args(argv)
    if known.resume and (known.env or others):
        raise SystemExit("--resume goes on with the run's own settings: no other flag can be given with it")
    if known.resume:
        return Args(**load(Path(known.resume) / "checkpoint.pt")["args"] | {"resume": known.resume})
    env = known.env or Args.env
    defaults = next((row for start, row in DEFAULTS.items() if env.startswith(start)), {})
    args = tyro.cli(Args, default=Args(env=env, **defaults), args=argv)
    if args.device == "cuda" and not torch.cuda.is_available():
        raise SystemExit("--device cuda: there is none")
    return args


if __name__ == "__main__":
    stop = []  # Ctrl-C or a termination signal: end between two steps, where a checkpoint is whole
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda number, _: stop.append(number))
    try:
        print(folder := train(parse_args(), stop))
    except (OSError, ImportError) as error:  # a folder that cannot be written, a full disk, no wandb
        raise SystemExit(error) from None
    if (folder / "checkpoint.pt").exists():
        print(f"stopped; go on with: python {ALGORITHM}.py --resume {folder}", file=sys.stderr)
        sys.exit(128 + stop[0])
