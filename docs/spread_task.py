"""MPE's simple_spread, a PettingZoo environment, with macro-actions: two agents shall cover two landmarks.

docs/your-own-simulator.md explains how such a file is written. Train with `--env docs.spread_task:spread`.
"""

import itertools

import numpy as np
from mpe2 import simple_spread_v3

import envs
from envs.options import Option, OptionsEnv

NEAR = 0.1  # who is as near to a landmark as this covers it


def away(sim, agent, number):
    """The way from an agent to a landmark, [2]."""
    return sim.world.landmarks[number].state.p_pos - sim.world.agents[agent].state.p_pos


def steer(sim, agent, way):
    """The primitive action that goes this way and brakes in time: 0 nothing, 1 left, 2 right, 3 down, 4 up."""
    push = way - 0.4 * sim.world.agents[agent].state.p_vel
    axis = int(abs(push[1]) > abs(push[0]))
    if abs(push[axis]) < NEAR / 2:
        return 0
    return 1 + 2 * axis + int(push[axis] > 0)


def go(number):
    """Goes to a landmark for at most 10 steps."""

    def is_away(sim, agent):
        return np.hypot(*away(sim, agent, number)) > NEAR

    def run(sim, agent):
        for _ in range(10):
            yield steer(sim, agent, away(sim, agent, number))
            if not is_away(sim, agent):
                return

    return Option(f"Go({number})", run, is_away)


def stay(sim, agent):
    """Stays where it is for 3 steps."""
    start = sim.world.agents[agent].state.p_pos.copy()
    for _ in range(3):
        yield steer(sim, agent, start - sim.world.agents[agent].state.p_pos)


def is_covered(sim):
    """Whether there is an agent at each landmark."""
    agents = range(len(sim.world.agents))
    distances = np.array([[np.hypot(*away(sim, agent, number)) for number in agents] for agent in agents])
    return bool((distances.min(axis=0) <= NEAR).all())


def scripted(sim):
    """The landmark of each agent in the assignment with the shortest ways, n ints."""
    agents = range(len(sim.world.agents))

    def length(landmarks):
        return sum(np.hypot(*away(sim, agent, number)) for agent, number in zip(agents, landmarks, strict=True))

    return min(itertools.permutations(agents), key=length)


envs.register(
    "spread",
    OptionsEnv,
    make=lambda: simple_spread_v3.parallel_env(N=2, local_ratio=0.0, render_mode="rgb_array"),
    options=[go(0), go(1), Option("Stay", stay)],
    horizon=25,
    success=is_covered,
    defaults=dict(
        total_timesteps=80_000,
        learning_starts=2_000,
        exploration_timesteps=30_000,
        num_envs=16,
        train_frequency=32,
        polyak=0.99,
    ),
)
