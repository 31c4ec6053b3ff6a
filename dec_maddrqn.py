"""Dec-MADDRQN: independent recurrent Q-learners over macro-actions, each on its own transitions.

The decentralised baseline of Xiao et al. (2020, "Macro-action-based deep multi-agent reinforcement learning"), in
Section 2.2 of the paper. Every agent sums up the joint reward over its own macro-action and learns as if the others
were part of its environment.

    transition of agent i   from a row where it chose to the next row where it chooses: r_i = sum of gamma^t r_t over
                            its own macro-action of tau_i steps, whatever the others start or end in between
    target                  y_i = r_i + gamma^tau_i Q'_i(h'_i, argmax Q_i(h'_i, .))
    hysteresis              negative TD errors are multiplied by a factor below 1, which rises: each agent stays
                            optimistic while the others explore

The replay buffer holds joint rows like avf_vdn.py's; `own_returns` folds a window of them into each agent's own
transitions, so that all agents learn from the same windows (concurrent experience replay).

Numbered deviations from the published baseline:
 1. An episode truncated by the horizon bootstraps from its final observation, a terminated one does not.
 2. A macro-action that is running at the first row of a window or still running at its last gives no transition there.
 3. One gradient norm is clipped over all agents. Their losses are summed, each a mean over the agent's transitions.
 4. Values are ours (docs/defaults.md), as are returns over several macro-actions, scaled inputs and rewards; on Box
    Pushing gamma counts once a row of the team (--discount), the published code once an agent's decision.
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


class Agents(nn.Module):
    """The agents' utility networks, one each: Linear, ReLU, GRU, Linear, ReLU, Linear, H = hidden_size wide."""

    def __init__(self, n_actions, obs_size, hidden_size, obs_scale=1.0):
        super().__init__()
        n, widest, bound = len(n_actions), max(n_actions), hidden_size**-0.5
        self.n_actions, self.hidden_size, self.obs_scale = np.array(n_actions), hidden_size, obs_scale
        self.encoder = AgentLinear(n, obs_size + widest, hidden_size)
        self.gru_input = AgentLinear(n, hidden_size, 3 * hidden_size)
        self.gru_hidden = nn.Parameter(torch.empty(n, hidden_size, 3 * hidden_size).uniform_(-bound, bound))
        self.head = AgentLinear(n, hidden_size, hidden_size)
        self.output = AgentLinear(n, hidden_size, widest)
        padding = torch.arange(widest) >= torch.tensor(n_actions)[:, None, None]  # [n, 1, A]
        self.register_buffer("padding", padding, persistent=False)

    def start(self, count):
        """The recurrent states before the first decisions of count episodes: zeros, float32 [n, count, H]."""
        return self.gru_hidden.new_zeros(len(self.gru_hidden), count, self.hidden_size)

    def forward(self, obs, previous, hidden, sizes):
        """Utilities float32 [n, M, A], -inf for macro-actions an agent does not have, and recurrent states [n, M, H].
        Sequences are packed step by step: sizes[t] entries of step t, the longest first, M in all. obs: float32
        [n, M, d]. previous: int64 [n, M], the macro-action before, -1 for none. hidden: float32 [n, sizes[0], H]."""
        one_hot = previous[..., None] == torch.arange(self.padding.shape[2], device=obs.device)  # [n, M, A]
        gates = self.gru_input(torch.relu(self.encoder(torch.cat([self.obs_scale * obs, one_hot], 2))))  # [n, M, 3 H]
        states = []
        for step in gates.split(sizes, 1):
            hidden = hidden[:, : step.shape[1]]
            in_reset, in_update, in_new = step.chunk(3, 2)  # [n, size, H] each
            h_reset, h_update, h_new = torch.bmm(hidden, self.gru_hidden).chunk(3, 2)
            reset, update = torch.sigmoid(in_reset + h_reset), torch.sigmoid(in_update + h_update)
            hidden = torch.lerp(torch.tanh(torch.addcmul(in_new, reset, h_new)), hidden, update)
            states.append(hidden)
        states = torch.cat(states, 1)  # [n, M, H]
        return self.output(torch.relu(self.head(states))).masked_fill(self.padding, -torch.inf), states


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


def own_returns(batch, bootstrap, td_lambda=0.0):
    """Each agent's own returns, float32 [B, T, n], and where they count, bool [B, T, n]: where a macro-action of
    the agent starts that ends within the window. X[k], of the macro-action that runs at row k, from row k on, is
    r[k] + gamma^tau X[k + 1] if it still runs at the next row, else r[k] + gamma^tau ((1 - lambda) Q'_i[k + 1] +
    lambda X[k + 1]), with lambda = 0 where the next macro-action does not end within the window.
    bootstrap: float32 [B, T, n], each agent's target value at the row. td_lambda: 0 for one macro-action's return."""
    returns, own = torch.zeros_like(bootstrap), torch.zeros_like(batch["chosen"])
    later, ends = returns[:, -1], own[:, -1]  # of the row after: [B, n]
    for k in reversed(range(returns.shape[1] - 1)):
        chosen = batch["chosen"][:, k + 1]
        mixed = torch.lerp(bootstrap[:, k + 1], later, td_lambda * ends)
        later = batch["reward"][:, k, None] + batch["discount"][:, k, None] * torch.where(chosen, mixed, later)
        ends = chosen | ends
        returns[:, k], own[:, k] = later, ends & batch["chosen"][:, k]
    return returns, own


def own_loss(utilities, target_utilities, batch, td_lambda=0.0, hysteresis=1.0):
    """The sum of the agents' losses, each a mean over its own transitions; values, returns and which count [B, T, n].
    utilities, target_utilities: float32 [B, T, n, A]. td_lambda: 0 for one macro-action's return, up to 1.
    hysteresis: factor on negative TD errors, 1 for none."""
    q = utilities.gather(3, batch["action"][..., None])[..., 0]  # [B, T, n]
    with torch.no_grad():
        bootstrap = target_utilities.gather(3, utilities.argmax(3)[..., None])[..., 0]  # [B, T, n], double Q-learning
        returns, own = own_returns(batch, bootstrap, td_lambda)
    error = torch.where(own, returns - q, 0.0)
    error = torch.where(error < 0, hysteresis * error, error)
    return (error.square().sum((0, 1)) / own.sum((0, 1)).clamp(min=1)).sum(), q, returns, own


def act(agents, obs, infos, hidden, epsilon=0.0, rng=None):
    """Epsilon-greedy macro-actions int64 [N, n] and recurrent states float32 [n, N, H], moved where agents are free.
    obs, float32 [N, n, d], and infos are those of the environment's last reset or step."""
    free, running = infos["macro_done"], infos["macro_action"]
    by_agent = [torch.from_numpy(x).to(hidden.device).transpose(0, 1) for x in (obs, running, free)]  # [n, N, ...]
    with torch.no_grad():
        utilities, states = agents(*by_agent[:2], hidden, [len(obs)])
    actions = utilities.argmax(2).T.cpu().numpy()  # [N, n]
    if epsilon > 0:
        actions = np.where(rng.random(free.shape) < epsilon, rng.integers(agents.n_actions, size=free.shape), actions)
    return np.where(free, actions, running), torch.where(by_agent[2][..., None], states, hidden)


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
    """Agents as a module on the device."""
    agents = Agents(env.n_actions, env.single_observation_space.shape[1], args.hidden_size, args.obs_scale)
    return nn.ModuleDict({"agents": agents}).to(args.device)


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
            batch = buffer.sample(args.batch_size, args.window, rng, args.device)
            batch["discount"] *= row_gamma
            utilities = over_rows(batch, agents, target["agents"])
            beta = np.interp((step - args.learning_starts) / args.exploration_timesteps, [1, 2], [args.hysteresis, 1.0])
            loss, q, _, _ = own_loss(*utilities, batch, args.td_lambda, beta)
            optimizer.zero_grad()
            loss.backward()
            grad_norm = nn.utils.clip_grad_norm_(fast, args.max_grad_norm)
            optimizer.step()
            torch.optim.swa_utils.get_ema_multi_avg_fn(args.polyak)(slow, fast, None)
            updates += 1
            if updates % 100 == 0:
                log("losses", td_loss=loss, q_values=q[batch["valid"]].mean(), grad_norm=grad_norm)

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
