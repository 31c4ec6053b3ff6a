"""Episodes played and logged without the replay memory, and the rows and utilities that they must give."""

import dataclasses
import inspect
import types

import numpy as np
import torch

import envs

torch.set_num_threads(1)  # as in training: fastest for networks of this size

# A run of a few seconds that takes gradient steps. The replay memory is small because checkpoints hold all of it.
TINY = dict(num_envs=4, total_timesteps=1_200, learning_starts=200, train_frequency=40, batch_size=8, window=6,
            hidden_size=16, buffer_size=50, eval_frequency=400, eval_episodes=2)  # fmt: skip


def args_for(script, env_id, **options):
    """The script's Args for a task, with its defaults for it."""
    return dataclasses.replace(script.parse_args([f"--env={env_id}"]), **options)


@dataclasses.dataclass
class Step:
    """One step of one environment: what was there before it, what was done and what it paid."""

    obs: np.ndarray  # [n, d]
    state: np.ndarray
    free: np.ndarray  # bool [n]
    action: np.ndarray  # int [n]
    reward: float
    utilities: torch.Tensor  # [n, A], of every agent's latest decision


@dataclasses.dataclass
class Episode:
    steps: list
    obs: np.ndarray  # the final one
    state: np.ndarray
    terminated: bool


def play(script, env_id, episodes, buffer=None, num_envs=3, seed=0, gamma=0.9, epsilon=0.7):
    """Plays at least so many episodes with random networks, as `train` does, into the buffer if there is one; returns
    env, agents and the episodes in the order in which they ended, environments in their order where several end at
    once. buffer: the script's, made for an environment."""
    torch.manual_seed(seed)
    env, rng = envs.make(env_id, num_envs), np.random.default_rng(seed)
    agents = script.Agents(env.n_actions, env.single_observation_space.shape[1], hidden_size=8)
    buffer = buffer(env) if buffer else None
    takes_state = "state" in inspect.signature(script.ReplayBuffer.add).parameters
    obs, infos = env.reset(seed=seed)
    hidden, latest = agents.start(num_envs), torch.zeros(env.n_agents, num_envs, max(env.n_actions))
    running, ended = [[] for _ in range(num_envs)], []
    while len(ended) < episodes:
        free = torch.from_numpy(infos["macro_done"]).T  # [n, N]
        with torch.no_grad():
            inputs = torch.from_numpy(obs).transpose(0, 1), torch.from_numpy(infos["macro_action"]).T
            utilities, _ = agents(*inputs, hidden, [num_envs])
        latest = torch.where(free[..., None], utilities, latest)
        actions, hidden = script.act(agents, obs, infos, hidden, epsilon, rng)
        before = obs, infos["state"], infos["macro_done"], actions
        if buffer:
            buffer.add(obs, actions, infos["macro_done"], *([infos["state"]] if takes_state else []))
        obs, rewards, terminations, truncations, infos = env.step(actions)
        over, discounts = terminations | truncations, gamma * ~terminations
        if buffer:
            buffer.step(*([before[1]] if takes_state else []), rewards, discounts, over, obs, infos)
        for e in range(num_envs):
            running[e].append(Step(*(x[e] for x in before), rewards[e], latest[:, e]))
            if over[e]:
                ended.append(Episode(running[e], obs[e], infos["state"][e], terminations[e]))
                running[e] = []
        if over.any():
            obs, infos = env.reset(options={"reset_mask": over})
            hidden[:, over] = 0.0
    return env, agents, buffer, ended


def expected_rows(episode, gamma, reward_scale=1.0):
    """The rows of an episode, worked out step by step: a list of dicts, the last for the final observation."""
    steps = episode.steps
    starts = [t for t, step in enumerate(steps) if step.free.any()]
    since, rows = np.full(len(steps[0].free), -1), []
    for k, (t, until) in enumerate(zip(starts, [*starts[1:], len(steps)], strict=True)):
        since = np.where(steps[t].free, k, since)
        reward = sum(gamma**i * reward_scale * step.reward for i, step in enumerate(steps[t:until]))
        discount = 0.0 if episode.terminated and until == len(steps) else gamma ** (until - t)
        row = {"obs": steps[t].obs, "action": steps[t].action, "since": since, "state": steps[t].state}
        rows.append(row | {"real": steps[until - 1].state, "reward": reward, "discount": discount, "step": t})
    final = {"obs": episode.obs, "action": steps[-1].action, "since": np.full_like(since, len(starts))}
    rows.append(final | {"state": episode.state, "reward": 0.0, "discount": 1.0})
    return rows


def check_rows(buffer, place, rows):
    """The rows at one place of the replay memory are those; `real` of the final row is of no meaning."""
    assert buffer.rows[place] == len(rows)
    for k, row in enumerate(rows):
        for key in row.keys() - {"step"}:
            if hasattr(buffer, key):  # scripts without a mixer store no states
                np.testing.assert_allclose(getattr(buffer, key)[place, k], row[key], 1e-5, 1e-5, err_msg=f"{key} {k}")


class Draws:
    """Stands in for a generator whose draws are known: which of the episodes, then which first rows, [B] each."""

    def __init__(self, *draws):
        self.draws = iter(draws)

    def choice(self, values, size):
        return values[self.integers()]

    def integers(self, *args, **kwargs):
        return np.asarray(next(self.draws))[:, None]


def windows(buffer, episodes, first, window, mixer_state="joint"):
    """Windows of the ended episodes with these numbers, the oldest being 0, from these rows on."""
    state = [mixer_state] if "mixer_state" in inspect.signature(buffer.sample).parameters else []
    return buffer.sample(len(episodes), window, *state, Draws(episodes, first))


def step_by_step(agents, batch):
    """What over_rows must give, [B, T, n, A]: every agent of every window on its own, one decision after the other."""
    result = torch.zeros(*batch["action"].shape, agents.padding.shape[2])
    for b, i in np.ndindex(len(result), result.shape[2]):
        hidden = agents.start(1)
        for k in range(result.shape[1]):
            if k == 0 or batch["chosen"][b, k, i]:
                obs, previous = (batch[key][b, k][:, None] for key in ("obs", "previous"))  # [n, 1, ...]
                utilities, hidden = agents(obs, previous, hidden, [1])  # the others' states are not read
            result[b, k, i] = utilities[i, 0]
    return result


class Spy:
    """Notes the arguments by name of every call of a function of a script, and what it returned."""

    def __init__(self, monkeypatch, owner, name):
        self.function, self.calls, self.results = getattr(owner, name), [], []
        signature = inspect.signature(self.function)

        def spied(*args, **kwargs):
            bound = signature.bind(*args, **kwargs)
            bound.apply_defaults()
            self.calls.append(types.SimpleNamespace(**bound.arguments))
            self.results.append(self.function(*args, **kwargs))
            return self.results[-1]

        monkeypatch.setattr(owner, name, spied)
