"""Random play and scripts on the two tasks of docs/your-own-simulator.md: `python -m docs.simulators`."""

import numpy as np

import envs


def play_at_random(env, rng):
    """Macro-actions int64 [N, n], drawn from what is available."""
    return np.where(env.available, rng.random(env.available.shape), -1.0).argmax(2)


def first_food(env, rng):
    """Both agents go to the first food and try to load it."""
    to_food = env.available[:, :, 0]
    can_load = env.available[:, :, 3]
    return np.where(to_food, 0, np.where(can_load, 3, 4))


def shortest_ways(env, rng):
    """Each agent goes to its landmark in the assignment with the shortest ways, and stays there."""
    from docs.spread_task import scripted

    plans = np.array([scripted(sim.env.unwrapped) for sim in env.sims])  # [N, n]
    can_go = np.take_along_axis(env.available, plans[:, :, None], axis=2)[:, :, 0]
    return np.where(can_go, plans, env.n_actions[0] - 1)


def returns(env_id, policy, episodes=400):
    """The returns of one episode in each of so many environments, float64 [episodes]."""
    env = envs.make(env_id, episodes)
    rng = np.random.default_rng(0)
    env.reset(seed=0)
    earned = np.full(episodes, np.nan)
    while np.isnan(earned).any():
        _, _, terminations, truncations, _ = env.step(policy(env, rng))
        over = terminations | truncations
        first = over & np.isnan(earned)
        earned[first] = env.episode_return[first]
        env.reset(options={"reset_mask": over})
    return earned


if __name__ == "__main__":
    for env_id, script in (("foraging:foraging", first_food), ("docs.spread_task:spread", shortest_ways)):
        for policy in (play_at_random, script):
            earned = returns(env_id, policy)
            error = earned.std(ddof=1) / len(earned) ** 0.5
            print(f"{env_id:24} {policy.__name__:15} {earned.mean():8.3f} +- {error:.3f} (standard error)")
