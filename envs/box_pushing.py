"""Box Pushing: two robots on a grid, two small boxes that pay a little and a big one that takes both and pays a lot."""

import numpy as np

from envs.core import MacroVectorEnv

# Orientations 0 N, 1 E, 2 S, 3 W and the step forward in each, x to the east and y to the north.
NORTH = 0
FORWARD = np.array([(0.0, 1.0), (1.0, 0.0), (0.0, -1.0), (-1.0, 0.0)])
TURN_COST = np.array([np.roll([0.0, 0.1, 0.2, 0.1], turned) for turned in range(4)])  # [orientation, direction]
PUSH, TURN_LEFT, TURN_RIGHT, STAY = 4, 5, 6, 7  # below: Go-to, numbered as the waypoints
WAYPOINT_BIG_LEFT, WAYPOINT_BIG_RIGHT = 2, 3
PRIMITIVE_TO_MACRO = np.array([PUSH, TURN_LEFT, TURN_RIGHT, STAY])


class BoxPushing(MacroVectorEnv):
    """Two agents push boxes to the north wall of a `grid` x `grid` world (`bp-10`, `bp-20`, `bp-30`).

    ## Description
    Either agent can push a small box alone; the big box, two cells wide, moves only when both push it at once.
    Positions are cell centres (0.5, 1.5, ...), x to the east, y to the north. Agents do not block each other.

    ## Macro-actions
    0, 1 Go-to-Small-Box(0, 1), 2, 3 Go-to-Big-Box(left, right): walk to the cell below the box and face it. 4 Push:
    walk forward until a wall, or with a small box to the goal row; bumping into the big box, or into any box from the
    side, costs a penalty and ends it. If both agents start Push in the same step, both facing north, and the last
    waypoints they reached are 2 and 3, they push the big box together to the goal row (the last waypoint, not the
    position, is what
    counts: a quirk of the published benchmark, kept). 5 Turn-left, 6 Turn-right, 7 Stay last one step.
    `primitive=True`: 0 forward, 1 turn left, 2 turn right, 3 stay; the big box moves while both agents stand below its
    two cells, face north and move forward together.

    ## Macro-observations
    Five bits about the cell in front: small box, big box, empty, boundary, teammate. At a reset: empty.

    ## Rewards
    `step_cost` every step (the published benchmark has it, the paper does not mention it), `penalty` for each agent
    that walks into a wall or bumps into a box it cannot move, `small_reward` for each small box on the goal row and
    `big_reward` for the big one.

    ## Episode end
    Terminated when any box stands on the goal row (`success`: the big one); truncated after `horizon` steps.

    ## State (27 numbers)
    0-11 for each agent x/grid, y/grid and its orientation one-hot (4); 12-17 for each box (small 0, small 1, big)
    x/grid, y/grid; 18-25 for each agent the last waypoint it reached, one-hot (4, all 0 before the first); 26 whether
    the two are pushing the big box. The last nine are not in the benchmark's state: without them it would not be
    Markov.

    ## Arguments
    grid: even, at least 6. primitive: the primitive-action version. horizon, big_reward, small_reward, penalty,
    step_cost: as above. agent_starts, agent_orientations, small_boxes, big_box: the layout, cell centres (the big box:
    the middle of its two cells); None for the published one. The waypoints are the cells below the boxes.

    ## Simulator arrays
    position float64 [N, 2, 2], orientation int64 [N, 2], box_y float64 [N, 3] (boxes only ever move north),
    last_waypoint int64 [N, 2] (-1: none), pushing_big bool [N].

    Source: Xiao et al., Macro-Action-Based Deep Multi-Agent RL (CoRL 2019); the paper's Appendix D.1.
    """

    sim_arrays = ("position", "orientation", "box_y", "last_waypoint", "pushing_big")

    def __init__(
        self,
        num_envs=1,
        grid=10,
        *,
        primitive=False,
        horizon=100,
        big_reward=100.0,
        small_reward=10.0,
        penalty=-10.0,
        step_cost=-0.1,
        agent_starts=None,
        agent_orientations=(1, 3),
        small_boxes=None,
        big_box=None,
        render_mode=None,
    ):
        if grid < 6 or grid % 2:
            raise ValueError(f"grid must be an even number of at least 6 cells, got {grid}")
        names = ["Go-to-Small-Box(0)", "Go-to-Small-Box(1)", "Go-to-Big-Box(left)", "Go-to-Big-Box(right)"]
        names += ["Push", "Turn-left", "Turn-right", "Stay"]
        names = ["Forward", "Turn-left", "Turn-right", "Stay"] if primitive else names
        super().__init__(num_envs, [names] * 2, np.zeros((2, 5)), np.ones((2, 5)), (5, 5), 27, horizon, render_mode)
        self.grid, self.primitive = grid, primitive
        self.penalty, self.step_cost = penalty, step_cost
        self._box_rewards = np.array([small_reward, small_reward, big_reward])
        self.goal_y = grid - 0.5
        row = grid / 2 + 0.5
        self._starts = np.array(agent_starts or [(1.5, 1.5), (grid - 1.5, 1.5)], float)  # [2, (x, y)]
        self._orientations = np.array(agent_orientations)
        boxes = [*(small_boxes or [(1.5, row), (grid - 1.5, row)]), big_box or (grid / 2, row)]
        self._boxes = np.array(boxes, float)  # [3, (x, y)]
        if self._starts.shape != (2, 2) or self._orientations.shape != (2,) or self._boxes.shape != (3, 2):
            raise ValueError("a layout has two agents with an orientation each, two small boxes and one big box")
        # The four box cells in the order of the waypoints below them: small 0, small 1, big left, big right.
        self.cell_x = np.append(self._boxes[:2, 0], self._boxes[2, 0] + np.array([-0.5, 0.5]))
        self._cell_box = np.array([0, 1, 2, 2])
        self.waypoints = np.stack([self.cell_x, self._boxes[self._cell_box, 1] - 1.0], axis=1)  # [4, (x, y)]
        cells = np.concatenate([self._starts, self.waypoints, np.stack([self.cell_x, self.waypoints[:, 1] + 1], 1)])
        if (cells % 1 != 0.5).any() or (cells < 0).any() or (cells > grid).any():
            raise ValueError("agents, boxes and the cells below the boxes must be cell centres inside the grid")
        if (self._boxes[:, 1] >= self.goal_y).any():
            raise ValueError("boxes must start below the goal row")

        self._box_column = np.isin(np.arange(grid + 1) + 0.5, self.cell_x)  # by floor(x), one more beyond the wall

        self.position, self.orientation = np.zeros((num_envs, 2, 2)), np.zeros((num_envs, 2), np.int64)
        self.box_y = np.zeros((num_envs, 3))
        self.last_waypoint, self.pushing_big = np.full((num_envs, 2), -1), np.zeros(num_envs, bool)

    def _reset(self, mask):
        self.position[mask], self.orientation[mask] = self._starts, self._orientations
        self.box_y[mask] = self._boxes[:, 1]
        self.last_waypoint[mask], self.pushing_big[mask] = -1, False

    def _advance(self):
        action = PRIMITIVE_TO_MACRO[self.macro_action] if self.primitive else self.macro_action  # [N, agents]
        self._lock_onto_big_box(action)
        locked = self.pushing_big[:, None]
        ended = (action >= TURN_LEFT) | self.primitive
        # Agents act in turn. Go-to reads boxes, Push moves them, and an agent does one of the two: agent 0's push, both
        # walks, agent 1's push have the same outcome as agent 0, then agent 1.
        push = (action == PUSH) & ~locked
        penalties = self._push(0, push[:, 0], ended)
        if not self.primitive:
            self._go_to(action, ended)
        penalties += self._push(1, push[:, 1], ended)
        turn = (action == TURN_RIGHT).view(np.int8) - (action == TURN_LEFT).view(np.int8)
        self.orientation += turn
        self.orientation &= 3

        self.position[:, :, 1] += locked
        self.box_y[:, 2] += self.pushing_big
        arrived = self.box_y >= self.goal_y  # [N, boxes]
        ended |= locked & arrived[:, 2:]
        terminated = arrived.any(1)
        if self.primitive:
            self.pushing_big[:] = False
        rewards = self.penalty * penalties + arrived @ self._box_rewards + self.step_cost
        return rewards, terminated, ended, arrived[:, 2]

    def _lock_onto_big_box(self, action):
        """Both agents start to push the big box together."""
        both = ((action == PUSH) & (self.orientation == NORTH) & self.macro_done).all(1)
        if self.primitive:
            below = (self.position[:, :, 1] == self.box_y[:, 2:] - 1).all(1)
            x = self.position[:, :, 0]
            left, right = self.cell_x[WAYPOINT_BIG_LEFT], self.cell_x[WAYPOINT_BIG_RIGHT]
            placed = below & ((x == (left, right)).all(1) | (x == (right, left)).all(1))
        else:
            # Waypoints are at most 3, so this sum is that of 2 and 3 only.
            placed = self.last_waypoint.sum(1) == WAYPOINT_BIG_LEFT + WAYPOINT_BIG_RIGHT
        self.pushing_big |= both & placed

    def _outside(self, cell):
        """Whether cells, [..., (x, y)], lie outside the grid."""
        out = (cell < 0) | (cell > self.grid)
        return out[..., 0] | out[..., 1]

    def _box_ahead(self, front):
        """Whether the cell in front, [N, ..., (x, y)], holds each of the four box cells: bool [N, ..., 4]."""
        cell_y = self.box_y[:, self._cell_box]  # [N, 4]
        cell_y = cell_y.reshape(self.num_envs, *[1] * (front.ndim - 2), 4)  # [N, 1 ..., 4]
        return (front[..., :1] == self.cell_x) & (front[..., 1:] == cell_y)

    def _push(self, agent, push, ended):
        """Push (or primitive forward) of one agent where `push`; marks what ended, returns the penalties, float [N]."""
        step = FORWARD[self.orientation[:, agent]]  # [N, (x, y)]
        front = self.position[:, agent] + step
        at_wall = self._outside(front)
        box = self._box_ahead(front)  # [N, 4]
        blocked = box[:, 0] | box[:, 1] | box[:, 2] | box[:, 3]
        pushes_small = push & (box[:, 0] | box[:, 1]) & (self.orientation[:, agent] == NORTH)
        blocked &= ~pushes_small
        walks = push & ~at_wall & ~blocked
        self.position[:, agent] += step * walks[:, None]
        self.box_y[:, :2] += box[:, :2] & pushes_small[:, None]
        on_goal_row = self.position[:, agent, 1] == self.goal_y - 1  # of the pushed box, one cell ahead
        at_border = self._outside(front + step)
        ended[:, agent] |= push & (at_wall | blocked | np.where(pushes_small, on_goal_row, at_border))
        return (push & (at_wall | blocked)).astype(float)

    def _go_to(self, action, ended):
        """One step of Go-to for both agents: the cheapest neighbour cell by distance and turning."""
        goes = action < PUSH
        target = np.where(goes, action, 0)
        waypoint = self.waypoints[target]  # [N, agents, (x, y)]
        to_go = np.abs(waypoint - self.position)
        was_there = (to_go[..., 0] < 0.1) & (to_go[..., 1] < 0.1)
        cells = self.position[:, :, None] + FORWARD  # [N, agents, directions, (x, y)]
        distance = np.abs(cells - waypoint[:, :, None])
        cost = distance[..., 0] + distance[..., 1] + TURN_COST[self.orientation]  # [N, agents, directions]
        # The published rule: every box cell counts as an obstacle in the row of small box 0.
        in_row = cells[..., 1] == self.box_y[:, None, :1]
        cost[in_row & self._box_column[cells[..., 0].astype(np.int64)]] = np.inf
        best = cost.argmin(2)  # the first of equals
        turn = (best - self.orientation) & 3
        walks = goes & ~was_there & (turn == 0)
        self.position += FORWARD[self.orientation] * walks[:, :, None]
        turned = np.where(turn == 2, (self.orientation + 1) & 3, best)
        turned = np.where(was_there, NORTH, turned)
        self.orientation = np.where(goes, turned, self.orientation)
        to_go = np.abs(waypoint - self.position)
        arrived = goes & (to_go[..., 0] < 0.1) & (to_go[..., 1] < 0.1) & (self.orientation == NORTH)
        ended |= arrived
        self.last_waypoint = np.where(arrived, target, self.last_waypoint)

    def _observe(self, start):
        obs = np.zeros((self.num_envs, 2, 5), np.float32)
        if start:
            obs[:, :, 2] = 1.0
            return obs
        front = self.position + FORWARD[self.orientation]  # [N, agents, (x, y)]
        box = self._box_ahead(front)  # [N, agents, 4]
        small, big, boundary = box[..., 0] | box[..., 1], box[..., 2] | box[..., 3], self._outside(front)
        same = front == self.position[:, ::-1]
        teammate = same[..., 0] & same[..., 1]
        empty = ~(small | big | boundary | teammate)
        for bit, value in enumerate((small, big, empty, boundary, teammate)):
            obs[:, :, bit] = value
        return obs

    def _state(self):
        state = np.zeros((self.num_envs, self.state_size), np.float32)
        agents = state[:, :12].reshape(self.num_envs, 2, 6)  # [N, agents, (x, y, orientation)]
        agents[..., :2] = self.position / self.grid
        agents[..., 2:] = np.eye(4)[self.orientation]
        state[:, 12:18:2] = self._boxes[:, 0] / self.grid
        state[:, 13:18:2] = self.box_y / self.grid
        waypoints = state[:, 18:26].reshape(self.num_envs, 2, 4)  # [N, agents, waypoints]
        waypoints[:] = np.eye(5)[self.last_waypoint, :4]
        state[:, 26] = self.pushing_big
        return state

    def _draw(self, index):
        from envs.rendering import draw_box_pushing

        return draw_box_pushing(self, index)
