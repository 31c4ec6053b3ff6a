"""Box Pushing: two robots push boxes north.

Each alone can push a small box, for a small reward. Both together can push the big box, for a large reward.
"""

import numpy as np

from envs import checks
from envs.core import MacroVectorEnv

# Orientations, and one step forward (x, y) in each of them: x to the east, y to the north.
NORTH, EAST, SOUTH, WEST = range(4)
FORWARD = np.array([(0.0, 1.0), (1.0, 0.0), (0.0, -1.0), (-1.0, 0.0)])

# Macro-actions 0 to 3 are the Go-tos. Each has the number of the waypoint to which it leads.
MACRO_ACTION_NAMES = [
    "Go-to-Small-Box(0)",
    "Go-to-Small-Box(1)",
    "Go-to-Big-Box(left)",
    "Go-to-Big-Box(right)",
    "Push",
    "Turn-left",
    "Turn-right",
    "Stay",
]
WAYPOINT_BIG_LEFT, WAYPOINT_BIG_RIGHT = 2, 3
PUSH, TURN_LEFT, TURN_RIGHT, STAY = 4, 5, 6, 7

# Primitive action i does one step of macro-action PRIMITIVE_TO_MACRO[i].
PRIMITIVE_NAMES = ["Forward", "Turn-left", "Turn-right", "Stay"]
PRIMITIVE_TO_MACRO = np.array([PUSH, TURN_LEFT, TURN_RIGHT, STAY])

# Go-to chooses its next cell by cost, which is not a reward. Entry k is the cost of k quarter turns to the right.
# Three to the right cost 0.1, because they are the same as one to the left.
TURN_COST = np.array([0.0, 0.1, 0.2, 0.1])
SMALL, BIG = slice(0, 2), 2  # boxes 0 and 1 are small, box 2 is big


def is_same_cell(first, second):
    """Whether two cells [..., (x, y)] are the same, bool [...]."""
    is_equal = first == second
    return is_equal[..., 0] & is_equal[..., 1]  # faster than .all(axis=-1)


class BoxPushing(MacroVectorEnv):
    """Two agents push boxes to the northernmost row of a grid x grid world (`bp-10`, `bp-20`, `bp-30`).

    ## Description
    One agent alone can push a small box. The big box is two cells wide and moves only when both agents push it.
    Boxes move north only. Agents do not block each other. Positions are cell centres (0.5, 1.5, ...), x to the east
    and y to the north. The goal row is the northernmost row. Each step, in this order:

    1. If the agents begin a joint push (see below), they are locked onto the big box from this step on.
    2. Agent 0 acts, then agent 1. Agents that are locked onto the big box do nothing here.
    3. If the agents are locked onto the big box, it moves one cell north, and both agents move with it.
    4. The episode terminates if a box stands on the goal row.

    ## Macro-actions
    - 0, 1 Go-to-Small-Box(0, 1) and 2, 3 Go-to-Big-Box(left, right): the agent walks to its waypoint. The waypoint is
      the cell below the place where the small box, or that half of the big box, was at the start. It does not move with
      the box. Go-to ends as soon as the agent is at its waypoint and faces north. An agent that arrives with another
      orientation turns north in the next step, in one turn. An agent that is not there yet looks at its four neighbour
      cells in the order N, E, S, W:
        - The cost of a cell is its Manhattan distance to the waypoint, plus 0.1 for each quarter turn that the agent
          needs to face it.
        - Four cells are blocked: their cost is infinite. All are in the row in which small box 0 is now, one in the
          column of each small box and one in the column of each half of the big box. At the published start these are
          the boxes' own cells; later on they need not be. A cell outside the grid is not blocked. Both rules are quirks
          of the published benchmark, and they are kept.
        - The agent chooses the cheapest cell, the first of equals. If it faces the cell, it moves there. If the cell is
          behind it, it makes one quarter turn to the right. Otherwise it turns to face the cell.
    - 4 Push: what it does depends on the cell in front of the agent.
        - A small box, and the agent faces north: the box and the agent move one cell north. Push ends when the box is
          on the goal row.
        - The boundary of the grid, the big box, or a small box while the agent does not face north: the agent stays
          where it is, gets a penalty, and Push ends.
        - Anything else: the agent moves one cell forward. Push ends when it then has the boundary in front of it.
    - Joint push: it begins if both agents start Push in the same step, both face north, and the last Go-to that they
      finished was Go-to-Big-Box(left) for one of them and Go-to-Big-Box(right) for the other. The agents may have left
      these waypoints since. This is a quirk of the published benchmark, and it is kept. A joint push goes on until the
      big box is on the goal row.
    - 5 Turn-left, 6 Turn-right, 7 Stay: they last one step.

    With `primitive=True` the actions are 0 Forward, 1 Turn-left, 2 Turn-right and 3 Stay, one step each. Forward is one
    step of Push. A joint push lasts one step: the big box moves one cell if one agent stands below its left half and
    the other one below its right half, and both face north and move Forward in the same step.

    ## Macro-observations
    Five bits say what is in the cell in front of the agent: a small box, the big box, nothing, the boundary, the
    teammate. At a reset every agent observes "nothing".

    ## Rewards
    The reward of a step is the sum of these. By default `step_cost` and `penalty` are negative.

    - `step_cost` every step. The paper of AVF (see Source) does not mention it, but the published benchmark has it.
    - `penalty` for each agent that gets a penalty in the step.
    - `small_reward` for each small box on the goal row, `big_reward` for the big one.

    ## Episode end
    The episode is terminated when any box stands on the goal row; it is a `success` if the big box does. It is
    truncated after `horizon` steps.

    ## State
    27 numbers. The published benchmark's state has only the first 18. The other nine are there to make it Markov.

    - 0 to 11: for each agent x / grid, y / grid and its orientation, one-hot (4)
    - 12 to 17: for each box (small 0, small 1, big) x / grid, y / grid
    - 18 to 25: for each agent the Go-to that it finished last, one-hot (4), all 0 before the first
    - 26: whether the agents are locked onto the big box

    ## Arguments
    - num_envs: the number of environments N, at least 1
    - grid: cells along each axis, an even number of at least 6
    - primitive: whether to use the primitive actions
    - horizon: steps until truncation, at least 1
    - big_reward, small_reward, penalty, step_cost: as above
    - agent_starts: the cells of the two agents at the start [2, (x, y)]
    - agent_orientations: their orientations at the start [2], 0 N, 1 E, 2 S, 3 W
    - small_boxes: the cells of the two small boxes at the start [2, (x, y)]
    - big_box: the middle of the big box's two cells at the start (x, y)
    - render_mode: None or "rgb_array"

    None for `agent_starts`, `small_boxes` or `big_box` means the places of the published benchmark. A box must start
    below the goal row. It must start above the lowest row, too, because its waypoint is the cell below it. A bad
    argument raises a ValueError.

    ## Simulator arrays
    - position float64 [N, 2, (x, y)] and orientation int64 [N, 2] of the agents
    - box_y float64 [N, 3] of the boxes, whose x never changes
    - last_waypoint int64 [N, 2]: the Go-to that each agent finished last, -1 before the first
    - pushing_big bool [N]: whether the agents are locked onto the big box

    ## Source
    Y. Xiao, J. Hoffman, C. Amato, "Macro-Action-Based Deep Multi-Agent Reinforcement Learning", CoRL 2019. Rewards and
    constants are those of Appendix D.1 of the paper of AVF, "Value Factorization for Asynchronous Multi-Agent
    Reinforcement Learning".
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
        agent_orientations=(EAST, WEST),
        small_boxes=None,
        big_box=None,
        render_mode=None,
    ):
        self.primitive = checks.flag("primitive", primitive)
        self.grid = checks.whole("grid", grid, low=6)
        if self.grid % 2 == 1:
            raise ValueError(f"grid must be even, got {grid}")
        self.goal_y = self.grid - 0.5
        self.penalty = checks.numbers("penalty", penalty)
        self.step_cost = checks.numbers("step_cost", step_cost)
        self.small_reward = checks.numbers("small_reward", small_reward)
        self.big_reward = checks.numbers("big_reward", big_reward)
        self._place_agents_and_boxes(agent_starts, agent_orientations, small_boxes, big_box)
        names = PRIMITIVE_NAMES if self.primitive else MACRO_ACTION_NAMES
        super().__init__(
            num_envs=num_envs,
            macro_action_names=[names, names],
            obs_low=np.zeros((2, 5)),
            obs_high=np.ones((2, 5)),
            obs_sizes=(5, 5),
            state_size=27,
            horizon=horizon,
            render_mode=render_mode,
        )
        self.position = np.zeros((self.num_envs, 2, 2))
        self.orientation = np.zeros((self.num_envs, 2), np.int64)
        self.box_y = np.zeros((self.num_envs, 3))
        self.last_waypoint = np.full((self.num_envs, 2), -1)
        self.pushing_big = np.zeros(self.num_envs, bool)

    def _place_agents_and_boxes(self, agent_starts, agent_orientations, small_boxes, big_box):
        """Sets where agents and boxes start, and the waypoints. The arguments are those of the constructor."""
        right_x = self.grid - 1.5
        box_y = self.grid / 2 + 0.5
        if agent_starts is None:
            agent_starts = [(1.5, 1.5), (right_x, 1.5)]
        if small_boxes is None:
            small_boxes = [(1.5, box_y), (right_x, box_y)]
        if big_box is None:
            big_box = (self.grid / 2, box_y)

        self.starts = checks.numbers("agent_starts", agent_starts, (2, 2))
        self.start_orientations = checks.whole("agent_orientations", agent_orientations, (2,), low=NORTH, high=WEST)
        small = checks.numbers("small_boxes", small_boxes, (2, 2))
        big = checks.numbers("big_box", big_box, (2,))
        half_a_cell = np.array([0.5, 0.0])
        big_halves = np.stack([big - half_a_cell, big + half_a_cell])  # [left and right, (x, y)]

        last = self.grid - 0.5  # the centre of the last cell along an axis
        _check_cells("agent_starts", agent_starts, self.starts, lowest=(0.5, 0.5), highest=(last, last))
        _check_cells("small_boxes", small_boxes, small, lowest=(0.5, 1.5), highest=(last, last - 1))
        _check_cells("the two cells of big_box", big_box, big_halves, lowest=(0.5, 1.5), highest=(last, last - 1))

        box_cells = np.concatenate([small, big_halves])  # [4, (x, y)]: small 0 and 1, left and right half
        self.cell_x = box_cells[:, 0]  # [4], in the order of the waypoints
        self.waypoints = box_cells - (0.0, 1.0)  # [4, (x, y)], below these cells
        boxes = np.concatenate([small, big[None]])  # [3, (x, y)]: small 0, small 1, big
        self.box_x = boxes[:, 0]
        self.start_box_y = boxes[:, 1]

    def _reset(self, mask):
        self.position[mask] = self.starts
        self.orientation[mask] = self.start_orientations
        self.box_y[mask] = self.start_box_y
        self.last_waypoint[mask] = -1
        self.pushing_big[mask] = False

    # ---- the rules, in the order of a step ----------------------------------------------------------------------
    def _advance(self):
        action = self.macro_action  # [N, agents]
        if self.primitive:
            action = PRIMITIVE_TO_MACRO[self.macro_action]
        self._lock_onto_big_box(action)

        # Agent 0 acts before agent 1. What it pushes matters to agent 1, whether agent 1 pushes or goes.
        ended = np.zeros((self.num_envs, 2), bool)
        penalised = np.zeros((self.num_envs, 2), bool)
        ended[:, 0], penalised[:, 0] = self._push(0, action[:, 0])
        go_to_ended = self._go_to(action)
        ended[:, 1], penalised[:, 1] = self._push(1, action[:, 1])
        ended |= go_to_ended | self._turn_or_stay(action)

        self._push_big_box()
        # Not ==, because a small box can move two cells in a step, and so beyond the goal row. It does if agent 1 is in
        # the same cell as the box: agent 0 pushes the box into the cell in front of agent 1, which then pushes it on.
        on_goal_row = self.box_y >= self.goal_y  # [N, boxes]
        small_on_goal_row = on_goal_row[:, SMALL]
        big_on_goal_row = on_goal_row[:, BIG]
        joint_push_ended = self.pushing_big & big_on_goal_row
        ended |= joint_push_ended[:, None]
        if self.primitive:  # every action ends after its step, and so does a joint push
            ended[:] = True
            self.pushing_big[:] = False

        rewards = self.penalty * penalised.sum(axis=1)
        rewards += self.small_reward * small_on_goal_row.sum(axis=1)
        rewards += np.where(big_on_goal_row, self.big_reward, 0.0)
        rewards += self.step_cost
        terminations = on_goal_row.any(axis=1)
        return rewards, terminations, ended, big_on_goal_row

    def _lock_onto_big_box(self, action):
        """Begins a joint push where both agents start Push and face north, one at each half of the big box."""
        starts = self.macro_done  # still that of the step before: who was free then starts an action now
        both_start_push = (starts & (action == PUSH)).all(axis=1)
        both_face_north = (self.orientation == NORTH).all(axis=1)
        if self.primitive:  # it matters where the agents are now
            x = self.position[:, :, 0]
            y = self.position[:, :, 1]
            is_below = y == self.box_y[:, BIG, None] - 1  # [N, agents]
            at_left_half = is_below & (x == self.cell_x[WAYPOINT_BIG_LEFT])
            at_right_half = is_below & (x == self.cell_x[WAYPOINT_BIG_RIGHT])
        else:  # it matters which Go-to each agent finished last
            at_left_half = self.last_waypoint == WAYPOINT_BIG_LEFT
            at_right_half = self.last_waypoint == WAYPOINT_BIG_RIGHT
        one_at_each_half = at_left_half.any(axis=1) & at_right_half.any(axis=1)
        self.pushing_big |= both_start_push & both_face_north & one_at_each_half

    def _go_to(self, action):
        """One step of Go-to for the agents that run it; returns where it ends, bool [N, agents]."""
        goes = action < PUSH  # macro-actions 0 to 3
        waypoint = self.waypoints[np.where(goes, action, 0)]  # [N, agents, (x, y)]; not used by those who do not go
        cheapest = self._cheapest_direction(waypoint)

        is_there = goes & is_same_cell(self.position, waypoint)
        walks = goes & ~is_there
        is_ahead = cheapest == self.orientation
        is_behind = cheapest == (self.orientation + 2) % 4
        moves = walks & is_ahead
        turns_right = walks & is_behind
        turns_to_it = walks & ~is_ahead & ~is_behind
        self.orientation[is_there] = NORTH
        self.position[moves] += FORWARD[cheapest[moves]]
        self.orientation[turns_right] += 1
        self.orientation[turns_to_it] = cheapest[turns_to_it]
        self.orientation %= 4

        is_now_there = is_same_cell(self.position, waypoint)
        ends = goes & is_now_there & (self.orientation == NORTH)
        self.last_waypoint[ends] = action[ends]
        return ends

    def _cheapest_direction(self, waypoint):
        """The direction, int64 [N, agents], of the neighbour cell with the lowest cost, the first of equals."""
        x = self.position[:, :, :1] + FORWARD[:, 0]  # [N, agents, directions], of the neighbour cells
        y = self.position[:, :, 1:] + FORWARD[:, 1]
        distance = np.abs(x - waypoint[:, :, :1]) + np.abs(y - waypoint[:, :, 1:])
        quarter_turns = (np.arange(4) - self.orientation[:, :, None]) % 4  # to the right
        cost = distance + TURN_COST[quarter_turns]
        in_box_row = y == self.box_y[:, :1, None]  # the row of small box 0
        in_box_column = np.zeros(x.shape, bool)
        for box_x in self.cell_x:
            in_box_column |= x == box_x
        cost[in_box_row & in_box_column] = np.inf
        return cost.argmin(axis=2)

    def _push(self, agent, action):
        """One step of Push in the environments where the agent runs it and is not locked onto the big box.

        Returns:
            ends bool [N], where Push ends, and penalised bool [N], where the agent gets a penalty.
        """
        position = self.position[:, agent]  # a view: writing to it moves the agent
        orientation = self.orientation[:, agent]
        small_y = self.box_y[:, SMALL]  # a view, too: writing to it moves a small box
        pushes = (action == PUSH) & ~self.pushing_big
        step = FORWARD[orientation]
        front = position + step  # [N, (x, y)]
        small_box_in_front = self._small_boxes_at(front)  # [N, small boxes]
        any_small_box = small_box_in_front.any(axis=1)
        any_box = any_small_box | self._big_box_at(front)

        hits_boundary = pushes & self._is_outside(front)
        pushes_small = pushes & any_small_box & (orientation == NORTH)
        hits_box = pushes & any_box & ~pushes_small
        penalised = hits_boundary | hits_box
        walks = pushes & ~penalised  # alone, or behind the small box that it pushes
        moved_boxes = small_box_in_front & pushes_small[:, None]
        position[walks] += step[walks]
        small_y[moved_boxes] += 1

        box_arrives = (moved_boxes & (small_y >= self.goal_y)).any(axis=1)
        # An agent that walks is in the cell `front` now, so `front + step` is the cell that it has in front of it.
        reaches_boundary = walks & ~pushes_small & self._is_outside(front + step)
        ends = penalised | box_arrives | reaches_boundary
        return ends, penalised

    def _turn_or_stay(self, action):
        """Turn-left, Turn-right and Stay of both agents; returns where they run one of them, bool [N, agents]."""
        turns_left = action == TURN_LEFT
        turns_right = action == TURN_RIGHT
        stays = action == STAY
        self.orientation[turns_left] -= 1
        self.orientation[turns_right] += 1
        self.orientation %= 4
        return turns_left | turns_right | stays

    def _push_big_box(self):
        """The big box and both agents move one cell north where the agents are locked onto it."""
        step = np.where(self.pushing_big, 1.0, 0.0)
        self.position[:, :, 1] += step[:, None]
        self.box_y[:, BIG] += step

    # ---- what is in a cell; each environment has its own, float64 [N, (x, y)] -----------------------------------
    def _small_boxes_at(self, cell):
        """Which of the small boxes is in the cell, bool [N, 2]."""
        same_x = self.box_x[SMALL] == cell[:, :1]
        same_y = self.box_y[:, SMALL] == cell[:, 1:]
        return same_x & same_y

    def _big_box_at(self, cell):
        """Whether one half of the big box is in the cell, bool [N]."""
        same_x = np.abs(self.box_x[BIG] - cell[:, 0]) == 0.5
        same_y = self.box_y[:, BIG] == cell[:, 1]
        return same_x & same_y

    def _is_outside(self, cell):
        """Whether the cell is outside the grid. This one takes cells [..., (x, y)] and returns bool [...]."""
        is_outside = (cell < 0) | (cell > self.grid)
        return is_outside[..., 0] | is_outside[..., 1]

    # ---- observations, the state and the picture ----------------------------------------------------------------
    def _observe(self, start):
        obs = np.zeros((self.num_envs, 2, 5), np.float32)
        if start:
            obs[:] = (0, 0, 1, 0, 0)  # "nothing"
            return obs
        front = self.position + FORWARD[self.orientation]  # [N, agents, (x, y)]
        for agent in range(2):
            obs[:, agent, 0] = self._small_boxes_at(front[:, agent]).any(axis=1)
            obs[:, agent, 1] = self._big_box_at(front[:, agent])
        obs[:, :, 3] = self._is_outside(front)
        obs[:, :, 4] = is_same_cell(front, self.position[:, ::-1])  # where the teammate is
        obs[:, :, 2] = ~obs.any(axis=2)  # nothing of these
        return obs

    def _state(self):
        facing = self.orientation[:, :, None] == np.arange(4)  # [N, agents, orientations]
        agents = np.concatenate([self.position / self.grid, facing], axis=2)
        boxes = np.zeros((self.num_envs, 3, 2))  # [N, boxes, (x, y)]
        boxes[:, :, 0] = self.box_x / self.grid
        boxes[:, :, 1] = self.box_y / self.grid
        last_waypoint = self.last_waypoint[:, :, None] == np.arange(4)  # [N, agents, waypoints]
        parts = [agents, boxes, last_waypoint, self.pushing_big]
        flat = [part.reshape(self.num_envs, -1) for part in parts]
        return np.concatenate(flat, axis=1, dtype=np.float32)

    def _draw(self, index):
        from envs.rendering import draw_box_pushing

        return draw_box_pushing(self, index)


def _check_cells(name, value, cells, lowest, highest):
    """Raises a ValueError unless cells, [..., (x, y)], are cell centres from lowest (x, y) to highest (x, y)."""
    are_centres = (cells % 1 == 0.5).all()
    are_inside = (cells >= lowest).all() and (cells <= highest).all()
    if not (are_centres and are_inside):
        raise ValueError(f"{name} must be cell centres from {lowest} to {highest}, got {checks.shown(value)}")
