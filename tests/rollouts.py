"""Episodes that are played and logged step by step, and the rows and utilities that they must give."""

import dataclasses
import inspect
import types

import numpy as np
import torch

import envs

torch.set_num_threads(1)  # as in training: fastest for networks of this size

# A run of about a second that takes gradient steps.
TINY = dict(
    num_envs=4,
    total_timesteps=1_200,
    learning_starts=200,
    train_frequency=40,
    batch_size=8,
    hidden_size=16,
    buffer_size=50,
    eval_frequency=400,
    eval_episodes=2,
)


def args_for(script, env_id, **options):
    """The script's Args for a task, with its defaults for it."""
    return dataclasses.replace(script.parse_args([f"--env={env_id}"]), **options)


@dataclasses.dataclass
class Step:
    """One step of one environment: what there was before it, what the agents did and what it paid."""

    obs: np.ndarray  # [n, d]
    state: np.ndarray  # [S]
    free: np.ndarray  # bool [n]
    available: np.ndarray  # bool [n, A]
    action: np.ndarray  # int [n], what each agent runs in this step
    reward: float
    utilities: torch.Tensor | None = None  # [n, A], those of every agent's latest decision
    hidden: torch.Tensor | None = None  # [n, H], after the agents have acted


@dataclasses.dataclass
class Episode:
    """All steps of an episode, and what there was after the last one."""

    steps: list
    obs: np.ndarray
    state: np.ndarray
    available: np.ndarray
    terminated: bool


def play(script, env_id, episodes, num_envs=3, seed=0, gamma=0.9, epsilon=0.7, **keywords):
    """Plays at least so many episodes with random networks, and stores them as `train` does.

    keywords: of the task, such as a short horizon. Returns env, agents, buffer and the logged episodes in the order in
    which they ended. Where several end at once, their order is that of their environments.
    """
    torch.manual_seed(seed)
    env = envs.make(env_id, num_envs, **keywords)
    rng = np.random.default_rng(seed)
    agents = script.Agents(env.n_agents, max(env.n_actions), env.single_observation_space.shape[1], hidden_size=8)
    buffer = script.ReplayBuffer(env, capacity=100)
    with_state = "state" in buffer.running.dtype.names
    obs, infos = env.reset(seed=seed)
    hidden = agents.start(num_envs)
    latest = torch.zeros(env.n_agents, num_envs, max(env.n_actions))
    running = [[] for _ in range(num_envs)]
    ended = []
    while len(ended) < episodes:
        free = torch.from_numpy(infos["macro_done"]).T  # [n, N]
        own_obs = torch.from_numpy(obs).transpose(0, 1)[:, :, None]
        previous = torch.from_numpy(infos["macro_action"]).T[:, :, None]
        with torch.no_grad():
            utilities, _ = agents(own_obs, previous, hidden)
        latest = torch.where(free[..., None], utilities[:, :, 0], latest)
        actions, hidden = script.act(agents, obs, infos, hidden, epsilon, rng)
        before = obs, infos
        buffer.begin_rows(obs, infos, actions, infos["macro_done"])
        obs, rewards, terminations, truncations, infos = env.step(actions)
        states = [before[1]["state"]] if with_state else []
        buffer.add_step(*states, rewards, np.where(terminations, 0.0, gamma))
        over = terminations | truncations
        for e in range(num_envs):
            known = before[0][e], *(before[1][name][e] for name in ("state", "macro_done", "available"))
            running[e].append(Step(*known, actions[e], rewards[e], latest[:, e], hidden[:, e].clone()))
            if over[e]:
                ended.append(Episode(running[e], obs[e], infos["state"][e], infos["available"][e], terminations[e]))
                running[e] = []
        if over.any():
            buffer.end_episodes(over, obs, infos)
            obs, infos = env.reset(options={"reset_mask": over})
            hidden[:, over] = 0.0
    return env, agents, buffer, ended


def expected_rows(episode, gamma, reward_scale=1.0):
    """The rows of an episode, worked out step by step: a list of dicts, the last for the final observation."""
    steps = episode.steps
    starts = [t for t, step in enumerate(steps) if step.free.any()]
    since = np.full(len(steps[0].free), -1)
    rows = []
    for k, (t, until) in enumerate(zip(starts, [*starts[1:], len(steps)], strict=True)):
        since = np.where(steps[t].free, k, since)
        terminal = episode.terminated and until == len(steps)
        rows.append(
            {
                "step": t,
                "obs": steps[t].obs,
                "available": steps[t].available,
                "action": steps[t].action,
                "since": since,
                "state": steps[t].state,
                "last_state": steps[until - 1].state,
                "reward": sum(gamma**i * reward_scale * step.reward for i, step in enumerate(steps[t:until])),
                "discount": 0.0 if terminal else gamma ** (until - t),
            }
        )
    rows.append(
        {
            "step": len(steps),
            "obs": episode.obs,
            "available": episode.available,
            "action": steps[-1].action,
            "since": np.full_like(since, len(starts)),
            "state": episode.state,
            "last_state": episode.state,
            "reward": 0.0,
            "discount": 1.0,
        }
    )
    return rows


def check_rows(stored, rows):
    """The stored rows of an episode, a structured array, are the expected ones, and they have no field besides."""
    assert len(stored) == len(rows)
    for name in stored.dtype.names:
        expected = np.stack([row[name] for row in rows])
        np.testing.assert_allclose(stored[name], expected, rtol=1e-5, atol=1e-5, err_msg=name)


def step_by_step(agents, batch):
    """What utilities_at_rows must give, [B, T, n, A]: each agent of each episode alone, one decision after another."""
    result = torch.zeros(*batch["action"].shape, agents.n_actions)
    for b, i in np.ndindex(len(result), result.shape[2]):
        hidden = agents.start(1)
        for k in range(result.shape[1]):
            if batch["free"][b, k, i]:
                obs = batch["obs"][b, k][:, None, None]  # [n, 1, 1, d]; what the others saw is not read
                utilities, hidden = agents(obs, batch["previous"][b, k][:, None, None], hidden)
            result[b, k, i] = utilities[i, 0, 0]
    return result


class Spy:
    """Notes the arguments by name of every call of a function of a script, and what it returned."""

    def __init__(self, monkeypatch, owner, name):
        self.function = getattr(owner, name)
        self.calls = []
        self.results = []
        signature = inspect.signature(self.function)

        def spied(*args, **kwargs):
            bound = signature.bind(*args, **kwargs)
            bound.apply_defaults()
            self.calls.append(types.SimpleNamespace(**bound.arguments))
            self.results.append(self.function(*args, **kwargs))
            return self.results[-1]

        monkeypatch.setattr(owner, name, spied)
