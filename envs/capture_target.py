"""Capture Target: agents chase one randomly moving target on a torus, and each of them sees it only now and then."""

import numpy as np

from envs import checks
from envs.core import MacroVectorEnv

# Directions of a move: x to the east, y to the north. The primitive actions are these five.
NORTH, SOUTH, WEST, EAST, STAY = range(5)
MOVES = np.array([(0, 1), (0, -1), (-1, 0), (1, 0), (0, 0)])
LEFT_OF = np.array([WEST, EAST, SOUTH, NORTH, STAY])
RIGHT_OF = np.array([EAST, WEST, NORTH, SOUTH, STAY])
PRIMITIVE_NAMES = ["N", "S", "W", "E", "Stay"]

MOVE_TO_TARGET = 0  # the other macro-action is Stay
MACRO_ACTION_NAMES = ["Move-to-T", "Stay"]


def is_same_cell(first, second):
    """Whether two cells [..., (x, y)] are the same, bool [...]."""
    is_equal = first == second
    return is_equal[..., 0] & is_equal[..., 1]  # faster than .all(axis=-1)


class CaptureTarget(MacroVectorEnv):
    """All agents must stand on the cell of a randomly moving target at the same time (`ct-10`: ten agents).

    ## Description
    Agents and target live on a grid x grid torus with cells (0, 0) to (grid - 1, grid - 1), x to the east and y to the
    north. They do not block each other. Each step, in this order:

    1. The agents move.
    2. If every agent stands on the target's cell, the target stays there. Otherwise it moves north, south, west, east
       or stays, each with probability 1/5.
    3. If every agent stands on the target's cell now, the target is captured and the episode terminates.
    4. Every agent gets a new primitive observation: its own position and that of the target. The target is hidden with
       probability `flicker`, drawn anew for each agent and step.

    ## Macro-actions
    - 0 Move-to-T: the agent moves towards its goal. It ends when the agent stands on its goal, wherever the target is
      by then. Each step:
        - If the primitive observation of the step before shows the target, the target's position in it becomes the
          goal. Otherwise the agent keeps its old goal. A goal is kept from one Move-to-T to the next and is forgotten
          only at a reset.
        - An agent that still has no goal does not move, and its macro-action ends in this step.
        - An agent with a goal moves to the one of five cells that is nearest to the goal: its own cell and those to the
          N, S, W and E of it, wrapped around the border. The distance is the plain Euclidean one, which does not wrap.
          So an agent crosses the border only from a cell beside it, if it lands nearer to the goal; from farther away
          it takes the long way. Ties are broken evenly at random.
    - 1 Stay: the agent stays for one step.

    A move goes to the left or to the right of its direction instead (it slips) with probability `slip` / 2 each.
    Staying never slips.

    With `one_step=True` both macro-actions end after one step. With `primitive=True` the actions are 0 N, 1 S, 2 W, 3 E
    and 4 Stay, one step each, with the same slip.

    ## Macro-observations
    Four numbers, those of the primitive observation: own x / grid and y / grid, the target's x / grid and y / grid. The
    last two are -1 if the target is hidden. At a reset every agent gets such an observation, too.

    ## Rewards
    `capture_reward` in the step of the capture, and 0 in all others.

    ## Episode end
    The episode is terminated by the capture, which is a `success`. It is truncated after `horizon` steps.

    ## State
    2 (n + 1) numbers: x / grid, y / grid of each agent, then of the target.

    ## Arguments
    - num_envs: the number of environments N, at least 1
    - n_agents: the number of agents n, at least 1
    - grid: cells along each axis, at least 2
    - primitive: whether to use the primitive actions
    - one_step: whether the macro-actions end after one step; it excludes `primitive`
    - slip, flicker: probabilities, as above
    - capture_reward: as above
    - horizon: steps until truncation, at least 1
    - render_mode: None or "rgb_array"

    A bad argument raises a ValueError.

    ## Simulator arrays
    - position int64 [N, n, (x, y)] of the agents and target int64 [N, (x, y)]
    - visible bool [N, n]: whether the agent's latest primitive observation shows the target
    - goal int64 [N, n, (x, y)]: the goal of the agent's latest Move-to-T, -1 before the first

    ## Statistics
    Results of the policy "always Move-to-T" with standard errors, on a grid of 10 x 10 cells with a horizon of 60. The
    published benchmark was run for 3,000 episodes a row, this class ("here") for 100,000. Each "here" belongs to the
    column on its left. `tests/test_capture_target.py` compares them.

    | agents | slip | capture rate   | here           | mean length  | here          |
    |--------|------|----------------|----------------|--------------|---------------|
    | 10     | 0.1  | 0.525 +- 0.009 | 0.528 +- 0.002 | 46.0 +- 0.3  | 45.74 +- 0.05 |
    | 10     | 0.0  | 0.891 +- 0.006 | 0.888 +- 0.001 | 30.3 +- 0.3  | 30.52 +- 0.05 |
    | 5      | 0.1  | 0.902 +- 0.005 | 0.893 +- 0.001 | 29.5 +- 0.3  | 29.74 +- 0.05 |

    With `one_step=True` the policy moves in the same way, so it captures as often. Random play with `one_step=True`
    captures in 0.7% of 20,000 episodes.

    ## Source
    Y. Xiao, J. Hoffman, C. Amato, "Macro-Action-Based Deep Multi-Agent Reinforcement Learning", CoRL 2019, with two
    agents. The task with ten is that of Appendix D.3 of the paper of AVF, "Value Factorization for
    Asynchronous Multi-Agent Reinforcement Learning".
    """

    sim_arrays = ("position", "target", "visible", "goal")

    def __init__(
        self,
        num_envs=1,
        n_agents=10,
        *,
        grid=10,
        primitive=False,
        one_step=False,
        slip=0.1,
        flicker=0.3,
        capture_reward=1.0,
        horizon=60,
        render_mode=None,
    ):
        self.primitive = checks.flag("primitive", primitive)
        self.one_step = checks.flag("one_step", one_step)
        if self.primitive and self.one_step:
            raise ValueError("primitive=True and one_step=True exclude each other")
        self.grid = checks.whole("grid", grid, low=2)
        self.slip = checks.numbers("slip", slip, low=0, high=1)
        self.flicker = checks.numbers("flicker", flicker, low=0, high=1)
        self.capture_reward = checks.numbers("capture_reward", capture_reward)
        agents = checks.whole("n_agents", n_agents)
        names = PRIMITIVE_NAMES if self.primitive else MACRO_ACTION_NAMES
        super().__init__(
            num_envs=num_envs,
            macro_action_names=[names] * agents,
            obs_low=np.full((agents, 4), -1.0),
            obs_high=np.full((agents, 4), 1.0),
            obs_sizes=[4] * agents,
            state_size=2 * (agents + 1),
            horizon=horizon,
            render_mode=render_mode,
        )
        self.position = np.zeros((self.num_envs, agents, 2), np.int64)
        self.target = np.zeros((self.num_envs, 2), np.int64)
        self.visible = np.zeros((self.num_envs, agents), bool)
        self.goal = np.full((self.num_envs, agents, 2), -1)

    def _reset(self, mask):
        count = np.count_nonzero(mask)
        self.position[mask] = self.np_random.integers(self.grid, size=(count, self.n_agents, 2))
        self.target[mask] = self.np_random.integers(self.grid, size=(count, 2))
        self.visible[mask] = self._draw_visible(count)
        self.goal[mask] = -1

    # ---- the rules, in the order of a step ----------------------------------------------------------------------
    def _advance(self):
        if self.primitive:
            self._move_agents(self.macro_action)
            ended = np.ones((self.num_envs, self.n_agents), bool)
        else:
            ended = self._run_macro_actions()
        self._move_target()
        captured = self._is_captured()
        self.visible = self._draw_visible(self.num_envs)
        rewards = np.where(captured, self.capture_reward, 0.0)
        return rewards, captured, ended, captured

    def _run_macro_actions(self):
        """One step of Move-to-T and Stay; returns where they end, bool [N, n]."""
        chases = self.macro_action == MOVE_TO_TARGET
        gets_goal = chases & self.visible  # the target has not moved since it was seen
        self.goal = np.where(gets_goal[:, :, None], self.target[:, None], self.goal)
        has_goal = self.goal[:, :, 0] >= 0
        direction = np.where(chases & has_goal, self._nearest_to_goal(), STAY)
        self._move_agents(direction)
        on_goal = is_same_cell(self.position, self.goal)
        goes_on = chases & has_goal & ~on_goal
        if self.one_step:
            return np.ones_like(goes_on)
        return ~goes_on

    def _nearest_to_goal(self):
        """The direction, int64 [N, n], to the one of five cells that is nearest to the agent's goal."""
        cells = (self.position[:, :, None] + MOVES) % self.grid  # [N, n, directions, (x, y)]
        offset = cells - self.goal[:, :, None]
        x = offset[..., 0]
        y = offset[..., 1]
        distance = x * x + y * y  # squared, so that it is a whole number
        tie_break = self.np_random.random(distance.shape)  # below 1: it decides only between equal distances
        return np.argmin(distance + tie_break, axis=2)

    def _move_agents(self, direction):
        """Each agent moves in its direction, int [N, n], or slips to the left or right of it."""
        random = self.np_random.random(direction.shape)  # in [0, 1)
        slips_left = random < self.slip / 2
        slips_right = random >= 1 - self.slip / 2
        taken = np.where(slips_left, LEFT_OF[direction], direction)
        taken = np.where(slips_right, RIGHT_OF[direction], taken)
        moved = self.position + MOVES[taken]
        self.position = moved % self.grid

    def _move_target(self):
        """The target moves at random, unless every agent stands on its cell."""
        direction = self.np_random.integers(len(MOVES), size=self.num_envs)
        direction[self._is_captured()] = STAY
        moved = self.target + MOVES[direction]
        self.target = moved % self.grid

    def _is_captured(self):
        """Whether every agent stands on the target's cell, bool [N]."""
        on_target = is_same_cell(self.position, self.target[:, None])  # [N, n]
        return on_target.all(axis=1)

    def _draw_visible(self, count):
        """Draws whether each agent's new primitive observation shows the target, bool [count, n]."""
        random = self.np_random.random((count, self.n_agents))  # in [0, 1)
        return random >= self.flicker

    # ---- observations, the state and the picture ----------------------------------------------------------------
    def _observe(self, start):  # a reset is observed like any other step
        own = self.position / self.grid
        target = np.where(self.visible[:, :, None], self.target[:, None] / self.grid, -1.0)
        return np.concatenate([own, target], axis=2, dtype=np.float32)

    def _state(self):
        cells = np.concatenate([self.position, self.target[:, None]], axis=1)  # [N, n + 1, (x, y)]
        return (cells / self.grid).reshape(self.num_envs, -1).astype(np.float32)

    def _draw(self, index):
        from envs.rendering import draw_capture_target

        return draw_capture_target(self, index)
