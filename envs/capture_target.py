"""Capture Target: n agents chase one randomly moving target that they see only now and then, on a torus."""

import numpy as np

from envs.core import MacroVectorEnv

_HEADING_NAMES = ["N", "S", "W", "E", "Stay"]
_NORTH, _SOUTH, _WEST, _EAST, _STAY = range(5)
_HEADINGS = np.array([[0, 1], [0, -1], [-1, 0], [1, 0], [0, 0]])  # (dx, dy), y to the north
_LEFT = np.stack([-_HEADINGS[:, 1], _HEADINGS[:, 0]], axis=1)  # a quarter turn; Stay turned is still Stay
_MOVES = np.stack([_LEFT, _HEADINGS, -_LEFT], axis=1)  # [heading, turn: left, none, right; (dx, dy)]

_MOVE_TO_TARGET = 0

# One of 12 equally likely slots is an even choice among 1, 2, 3 or 4 equally near cells. The table's first index is the
# sum of the bits of these cells; no bit is Stay.
_TIE_SLOTS = 12
_BITS = {_WEST: 1, _EAST: 2, _SOUTH: 4, _NORTH: 8}
_NEAREST = [[heading for heading, bit in _BITS.items() if code & bit] or [_STAY] for code in range(16)]
_PICK = np.array([[cells[slot * len(cells) // _TIE_SLOTS] for slot in range(_TIE_SLOTS)] for cells in _NEAREST])


def _axis_tables(grid):
    """What one step can do along one axis, by coordinate and goal coordinate (the extra one, grid, stands for no goal).

    The squared distance is a sum over the axes and a step changes one of its terms, so that two look-ups and their
    comparison tell the nearest of the five cells.

    Returns:
        change: int [grid, grid + 1], the lowest change of the squared distance; 0 at the goal and without one.
        ways: int [grid, grid + 1], 1 for the lower neighbour + 2 for the upper one, those that give it; 0 for neither.
    """
    here, goal = np.arange(grid)[:, None], np.arange(grid)
    lower, upper = (np.square((here + step) % grid - goal) - np.square(here - goal) for step in (-1, 1))
    change, ways = np.zeros((grid, grid + 1), np.int64), np.zeros((grid, grid + 1), np.int64)
    change[:, :-1] = np.minimum(np.minimum(lower, upper), 0)
    ways[:, :-1] = (lower == change[:, :-1]) + 2 * (upper == change[:, :-1])
    return change, ways


class CaptureTarget(MacroVectorEnv):
    """
    All agents have to stand on the cell of a randomly moving target at the same time. This is the task CT-10 of the
    paper on asynchronous value factorization (Appendix D.3), which took it, with more agents, from Xiao, Hoffman and
    Amato, "Macro-Action-Based Deep Multi-Agent Reinforcement Learning" (CoRL 2019).

    ## Description
    Agents and target live on a grid x grid torus with cells (0, 0) to (grid - 1, grid - 1), x to the east and y to the
    north; they do not block each other. Each step, in this order:

    1. The agents move.
    2. Unless captured, the target moves to one of N, S, W, E or stays, each with probability 1/5.
    3. The target is captured if every agent stands on its cell.
    4. Every agent gets a new primitive observation, in which the target is hidden with probability `flicker`, drawn for
       each agent and step on its own.

    ## Macro-actions
    - 0 Move-to-T: each step the agent's goal becomes the target's position in its primitive observation of the step
      before, or stays what it was if the target was hidden in it (goals last over macro-actions, within the episode;
      only Move-to-T sets them). An agent that has had no goal yet does not move and the macro-action ends at once.
      Otherwise it heads for that one of the five cells N, S, W, E and its own (neighbours wrapped around the border)
      which is nearest to the goal; the distance is the plain Euclidean one, which does not wrap, and ties are broken
      evenly at random. The move slips to the neighbouring direction on its left or right with probability slip / 2
      each; staying never slips. The macro-action ends when the agent stands on its goal, wherever the target is by
      then.
    - 1 Stay: one step.

    With `primitive=True` the actions are 0 N, 1 S, 2 W, 3 E, 4 Stay, one step each, with the same slip.

    ## Macro-observations
    Four numbers, those of the primitive observation: own x / grid, own y / grid, the target's x / grid, y / grid; the
    last two are -1, -1 when it is hidden. Every agent gets its own at the reset, in which the target may be hidden too.

    ## Rewards
    `capture_reward` in the step of the capture, 0 in all others.

    ## Episode end
    Terminated by the capture (then also `success`), truncated after `horizon` steps.

    ## State
    2 (n + 1) numbers: x / grid, y / grid of each agent in turn, then of the target.

    ## Statistics
    The fixed policy "always Move-to-T" on the published benchmark (10 x 10, 60 steps, 3,000 episodes a row) and here
    (100,000 episodes a row: the first of each of that many environments, seed 0), with standard errors;
    `tests/test_capture_target.py` compares them anew:

    | agents | slip | capture rate   | here             | mean length  | here           |
    |--------|------|----------------|------------------|--------------|----------------|
    | 10     | 0.1  | 0.525 +- 0.009 | 0.526 +- 0.002   | 46.0 +- 0.3  | 45.81 +- 0.05  |
    | 10     | 0.0  | 0.891 +- 0.006 | 0.887 +- 0.001   | 30.3 +- 0.3  | 30.53 +- 0.05  |
    | 5      | 0.1  | 0.902 +- 0.005 | 0.894 +- 0.001   | 29.5 +- 0.3  | 29.74 +- 0.05  |

    ## Attributes (beside those of `MacroVectorEnv`)
    position: int64 [N, n, 2], the agents' cells. target: int64 [N, 2]. visible: bool [N, n], the target is shown in the
    agent's latest primitive observation, which is that of the positions as they are. goal: int64 [N, n, 2], where
    Move-to-T last headed, -1 for none yet.
    """

    sim_arrays = ("position", "target", "visible", "goal")

    def __init__(
        self,
        num_envs=1,
        n_agents=10,
        *,
        grid=10,
        primitive=False,
        slip=0.1,
        flicker=0.3,
        capture_reward=1.0,
        horizon=60,
        render_mode=None,
    ):
        """Args:
        num_envs: number of environments, >= 1. n_agents: >= 1. grid: cells along each axis, >= 2.
        primitive: the five moves instead of the macro-actions.
        slip: probability that a move goes to one side, half of it to each, in [0, 1].
        flicker: probability that an agent does not see the target in a step, in [0, 1].
        capture_reward: finite. horizon: steps, >= 1. render_mode: None or "rgb_array".

        Raises:
            ValueError: an argument is out of range.
        """
        if n_agents < 1:
            raise ValueError(f"n_agents must be at least 1, got {n_agents}")
        if grid < 2:
            raise ValueError(f"grid must be at least 2 cells wide, got {grid}")
        for name, probability in (("slip", slip), ("flicker", flicker)):
            if not 0 <= probability <= 1:
                raise ValueError(f"{name} is a probability and must be in [0, 1], got {probability}")
        if not np.isfinite(capture_reward):
            raise ValueError(f"capture_reward must be finite, got {capture_reward}")
        bound = np.ones((n_agents, 4))
        super().__init__(
            num_envs,
            [_HEADING_NAMES if primitive else ["Move-to-T", "Stay"]] * n_agents,
            obs_low=-bound,
            obs_high=bound,
            obs_sizes=[4] * n_agents,
            state_size=2 * (n_agents + 1),
            horizon=horizon,
            render_mode=render_mode,
        )
        self.grid, self.primitive, self.slip, self.flicker = grid, primitive, slip, flicker
        self.capture_reward = capture_reward
        self._change, self._ways = _axis_tables(grid)
        self.position = np.zeros((num_envs, n_agents, 2), np.int64)
        self.target = np.zeros((num_envs, 2), np.int64)
        self.visible = np.zeros((num_envs, n_agents), bool)
        self.goal = np.full((num_envs, n_agents, 2), -1)

    def _reset(self, mask):
        fresh = np.count_nonzero(mask)
        self.position[mask] = self.np_random.integers(self.grid, size=(fresh, self.n_agents, 2))
        self.target[mask] = self.np_random.integers(self.grid, size=(fresh, 2))
        self.visible[mask] = self.np_random.random((fresh, self.n_agents)) >= self.flicker
        self.goal[mask] = -1

    def _advance(self):
        tie, side, hidden = self.np_random.random((3, self.num_envs, self.n_agents))
        if self.primitive:
            heading, ended = self.macro_action, np.ones_like(self.macro_done)
        else:
            chasing = self.macro_action == _MOVE_TO_TARGET
            np.copyto(self.goal, self.target[:, None], where=(chasing & self.visible)[:, :, None])
            heading = np.where(chasing, self._nearest_heading(tie), _STAY)

        slips_left, slips_right = side < self.slip / 2, side >= 1 - self.slip / 2
        turn = 1 - slips_left + slips_right  # 0 left, 1 none, 2 right
        self.position = (self.position + _MOVES[heading, turn]) % self.grid
        if not self.primitive:
            has_goal, on_goal = self.goal[:, :, 0] >= 0, (self.position == self.goal).all(-1)
            ended = ~chasing | ~has_goal | on_goal

        target_heading = self.np_random.integers(len(_HEADINGS), size=self.num_envs)
        target_heading[self._captured()] = _STAY
        self.target = (self.target + _HEADINGS[target_heading]) % self.grid
        captured = self._captured()
        self.visible = hidden >= self.flicker
        return captured * float(self.capture_reward), captured, ended, captured

    def _nearest_heading(self, tie):
        """Heading int [N, n] to the cell nearest to the goal, one of equals by tie, uniform [N, n]; Stay if no goal."""
        index = self.position * (self.grid + 1) + self.goal  # goal -1 gives the row before's last entry: "no goal" too
        change, ways = self._change.take(index), self._ways.take(index)  # [N, n, (x, y)]
        along_x, along_y = change[:, :, 0] <= change[:, :, 1], change[:, :, 0] >= change[:, :, 1]
        code = ways[:, :, 0] * along_x + 4 * ways[:, :, 1] * along_y
        return _PICK[code, (tie * _TIE_SLOTS).astype(np.int64)]

    def _captured(self):
        return (self.position == self.target[:, None]).all((1, 2))

    def _observe(self, start):
        obs = np.empty((self.num_envs, self.n_agents, 4), np.float32)
        obs[:, :, :2] = self.position / self.grid
        obs[:, :, 2:] = np.where(self.visible[:, :, None], self.target[:, None] / self.grid, -1.0)
        return obs

    def _state(self):
        cells = np.concatenate([self.position, self.target[:, None]], axis=1)  # [N, n + 1, (x, y)]
        return (cells / self.grid).astype(np.float32).reshape(self.num_envs, self.state_size)

    def _draw(self, index):
        from envs.rendering import draw_capture_target

        return draw_capture_target(self, index)
