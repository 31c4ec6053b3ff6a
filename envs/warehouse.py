"""Warehouse Tool Delivery: mobile robots fetch tools from an arm and bring them to human workers, just in time."""

import itertools

import numpy as np

from envs.core import MacroVectorEnv

TOOLS, PHASES = 3, 4
MAX_CAPACITY = 6  # the staging queue is looked up in a table of 4 ** capacity rows

# Positions in metres; one entry per human in workshops and phase_lengths, one per robot in tables and starts.
LAYOUTS = {
    "s": {
        "workshops": [(6.0, 3.0)],
        "tool_room": (2.5, 3.5),
        "tables": [(0.8, 3.0), (1.2, 3.0)],
        "starts": [(3.0, 1.5), (3.0, 2.5)],
        "arm": (0.9, 1.8),
        "robot_speed": 0.6,
        "copies": 1,
        "phase_lengths": [(20, 20, 20, 20)],
    },
    "d": {
        "workshops": [(6.0, 3.0), (6.0, 2.0)],
        "tool_room": (3.0, 2.5),
        "tables": [(1.2, 3.7), (1.2, 1.3)],
        "starts": [(3.0, 3.5), (3.0, 1.5)],
        "arm": (0.9, 2.5),
        "robot_speed": 0.8,
        "copies": 2,
        "phase_lengths": [(27, 20, 20, 20), (27, 20, 20, 20)],
    },
    "t": {
        "workshops": [(6.0, 3.0), (8.0, 3.0), (8.0, 2.0)],
        "tool_room": (3.0, 2.5),
        "tables": [(1.2, 3.7), (1.2, 1.3)],
        "starts": [(3.0, 3.5), (3.0, 1.5)],
        "arm": (0.9, 2.5),
        "robot_speed": 0.8,
        "copies": 3,
        "phase_lengths": [(40, 40, 40, 40), (40, 40, 40, 40), (40, 40, 40, 40)],
    },
    "t1": {
        "workshops": [(6.0, 3.0), (8.0, 3.0), (8.0, 2.0)],
        "tool_room": (3.0, 2.5),
        "tables": [(0.8, 3.7), (1.2, 3.7), (1.2, 1.3)],
        "starts": [(3.0, 4.0), (3.0, 2.5), (3.0, 1.0)],
        "arm": (0.9, 2.5),
        "robot_speed": 0.8,
        "copies": 3,
        "phase_lengths": [(38, 38, 38, 38), (38, 38, 38, 38), (27, 27, 27, 27)],
    },
}


class Warehouse(MacroVectorEnv):
    """Warehouse Tool Delivery (WTD), a batch of N environments.

    ## Description
    Each of H human workers, one to a workshop, works through four phases. It starts with the tool for the first phase
    and needs tools 0, 1 and 2, in that order, for the other three. An arm finds the tools, stages them beside its table
    and passes the oldest staged one to a robot that waits there; R mobile robots take them to the workshops. The team
    should bring every tool before its human has to wait for it.

    Layouts (`LAYOUTS`): "s" 2 robots and 1 human, "d" 2 and 2, "t" 2 and 3, "t1" 3 and 3.
    Agents are ordered robots first, arm last. Everything is deterministic.

    ## Macro-actions
    A robot has H + 2:

    - 0..H-1: Go-W(i), go to workshop i and, once there, give human i its next tool if the robot carries it
    - H: Go-TR, go to the tool room
    - H+1: Get-Tool, go to the robot's own place at the table and wait there for a tool, for 10 steps at most

    A robot moves `robot_speed` a step, straight to its waypoint. The arm has 1 + R + 3:

    - 0: Wait-M, 1 step
    - 1..R: Pass-to-M(j), 4 steps: at its end the oldest staged tool goes to robot j, which ends that robot's Get-Tool
      (also when nothing is staged). It fails if robot j is not waiting at the table when it begins, or when it ends
    - R+1..R+3: Search-Tool(k), 6 steps: at its end a copy of tool k is staged, if one is left and there is room for it

    With `primitive=True` every macro-action ends after one step: a robot moves one step and is asked again, Search and
    Pass advance by one step and begin anew when the arm was given anything else in between.

    ## Macro-observations
    A robot observes H + 3 + 4H + 3 + C numbers (C is the staging capacity, 2):

    - where it is, one-hot: workshop 0..H-1, tool room, table, "nowhere yet" (before it reached a first waypoint)
    - for each human its phase, one-hot, shown only while the robot is at that human's workshop
    - how many of each of the three tools it carries
    - the number of staged tools, one-hot over 1..C, shown only in the tool room, at the table and "nowhere yet"

    The arm observes 3 + R numbers: how many of each tool are staged, and for each robot whether it stands at its table
    place. At reset a robot observes only "nowhere yet" and the arm zeros.

    ## Rewards
    - -1 each step
    - +100 for a tool delivered, or +80 if its human's phase clock has already run down
    - -10 for a failed Pass

    ## Episode end
    - Termination: every human has got the tool for its fourth phase; those that got it before the last one may
      meanwhile have gone on to that phase, or finished it. This is also `success`.
    - Truncation: after `horizon` steps.

    ## State
    For each robot r, from 5r: x / room width, y / room depth (2), tools carried (3). Then the arm, from a = 5R:

    - a..a+2 staged tools, counts (a tool being passed stays among them until the Pass ends)
    - a+3..a+5 the tool in its hand during a Pass that has not failed at its beginning, one-hot
    - a+6..a+8 tools found so far, counts
    - a+9 steps left of its macro-action / those of its longest one
    - a+10..a+13+R its running macro-action, one-hot, zeros when none is running

    For each human h, from a + 14 + R + 6h: phase, one-hot (4); clock / phase length, clipped to [-1, 1]; whether it has
    its next tool (always so in the fourth phase).

    ## Arguments
    - layout: a key of `LAYOUTS`. Each of its entries can be replaced by the keyword of the same name, and all of them
      together are a new layout: `workshops` [H, 2], `tool_room` [2], `tables` [R, 2], `starts` [R, 2], `arm` [2] (only
      drawn), `robot_speed` (metres per step), `copies` (of each tool, an int or three), `phase_lengths` [H, 4] (steps)
    - primitive: every macro-action ends after one step; horizon: steps until truncation
    - delivery_reward, late_penalty (what a late delivery loses of it), failed_pass_penalty, step_cost: given as
      positive numbers
    - search_steps, pass_steps, arm_wait_steps: durations of the arm's macro-actions; tool_wait_steps: how long Get-Tool
      waits at the table
    - staging_capacity: 1 to 6 tools; room_size: width and depth in metres, by which the state divides positions

    ## Attributes
    Besides those of `MacroVectorEnv`: the arguments, lists as arrays; n_humans H, n_robots R; waypoints [R, H + 2, 2],
    by robot and macro-action; and the simulator's state:

    - position float64 [N, R, 2]; location int [N, R], the last waypoint reached: 0..H-1 workshops, H tool room,
      H+1 table, H+2 nowhere yet; carried int [N, R, 3], copies of each tool
    - time_left int [N, R]: 1 on the way, 0 on arrival or when a tool was handed over, -k after k steps of waiting at
      the table, -1 after a wait in vain
    - staged int [N, C], queue of tools, oldest first, -1 empty; found int [N, 3], copies found so far
    - arm_task int [N], the arm's macro-action, -1 before its first; arm_left int [N], steps left of it; pass_ready
      bool [N], whether the robot was waiting when the Pass began
    - phase int [N, H], 0..3; clock int [N, H], steps left of the phase, <= 0 while the human waits for its tool (or, in
      the fourth phase, has finished); has_next_tool bool [N, H]

    ## Irregularities of the published code that are not kept
    The paper states one rule for all rooms. In the published single room Get-Tool waits 11 steps and a delivery counts
    as late one step later; in the published four-agent room the arm does not check robot 2 at the start of a Pass.

    ## Source
    Y. Xiao, J. Hoffman, T. Xia, C. Amato, "Learning Multi-Robot Decentralized Macro-Action-Based Policies via a
    Centralized Q-Net", ICRA 2020; Y. Xiao, W. Tan, C. Amato, "Asynchronous Actor-Critic for Multi-Agent Reinforcement
    Learning", NeurIPS 2022. Variants, rewards and constants are those of Appendix D of the asynchronous value
    factorization paper.
    """

    sim_arrays = (
        *("position", "location", "carried", "time_left", "staged", "found"),
        *("arm_task", "arm_left", "pass_ready", "phase", "clock", "has_next_tool"),
    )

    def __init__(
        self,
        num_envs=1,
        layout="s",
        *,
        primitive=False,
        horizon=150,
        render_mode=None,
        workshops=None,
        tool_room=None,
        tables=None,
        starts=None,
        arm=None,
        robot_speed=None,
        copies=None,
        phase_lengths=None,
        room_size=(9.0, 5.0),
        delivery_reward=100.0,
        late_penalty=20.0,
        failed_pass_penalty=10.0,
        step_cost=1.0,
        search_steps=6,
        pass_steps=4,
        arm_wait_steps=1,
        tool_wait_steps=10,
        staging_capacity=2,
    ):
        """Raises ValueError: the layout is unknown, or an argument is out of range or does not fit the others."""
        if layout not in list(LAYOUTS):
            raise ValueError(f"unknown layout {layout!r}; valid layouts: {' '.join(LAYOUTS)}")

        def given(name, value):
            return LAYOUTS[layout][name] if value is None else value

        self.layout, self.primitive = layout, primitive
        self.workshops = _rows("workshops", given("workshops", workshops), 2)
        self.tables = _rows("tables", given("tables", tables), 2)
        self.starts = _rows("starts", given("starts", starts), 2)
        lengths = _rows("phase_lengths", given("phase_lengths", phase_lengths), PHASES)
        self.phase_lengths = _whole("phase_lengths", lengths, lengths.shape)
        self.tool_room = _numbers("tool_room", given("tool_room", tool_room), (2,))
        self.arm = _numbers("arm", given("arm", arm), (2,))
        self.room_size = _numbers("room_size", room_size, (2,), positive=True)
        self.robot_speed = float(_numbers("robot_speed", given("robot_speed", robot_speed), (), positive=True))
        self.n_humans, self.n_robots = humans, robots = len(self.workshops), len(self.tables)
        if len(self.starts) != robots:
            raise ValueError(f"tables and starts need one entry per robot, got {robots} and {len(self.starts)}")
        if len(lengths) != humans:
            raise ValueError(f"workshops and phase_lengths need one entry per human, got {humans} and {len(lengths)}")
        copies = given("copies", copies)
        self.copies = _whole("copies", copies if hasattr(copies, "__len__") else [copies] * TOOLS, (TOOLS,))
        self.search_steps = int(_whole("search_steps", search_steps))
        self.pass_steps = int(_whole("pass_steps", pass_steps))
        self.arm_wait_steps = int(_whole("arm_wait_steps", arm_wait_steps))
        self.tool_wait_steps = int(_whole("tool_wait_steps", tool_wait_steps))
        self.staging_capacity = capacity = int(_whole("staging_capacity", staging_capacity))
        if capacity > MAX_CAPACITY:
            raise ValueError(f"staging_capacity must be at most {MAX_CAPACITY}, got {capacity}")
        self.delivery_reward = float(_numbers("delivery_reward", delivery_reward))
        self.late_penalty = float(_numbers("late_penalty", late_penalty))
        self.failed_pass_penalty = float(_numbers("failed_pass_penalty", failed_pass_penalty))
        self.step_cost = float(_numbers("step_cost", step_cost))

        workshop_names, robot_names = range(humans), range(robots)
        moves = [*(f"Go-W({i})" for i in workshop_names), "Go-TR", "Get-Tool"]
        tasks = ["Wait-M", *(f"Pass-to-M({j})" for j in robot_names), *(f"Search-Tool({k})" for k in range(TOOLS))]
        robot_size, arm_size = (humans + 3) + PHASES * humans + TOOLS + capacity, TOOLS + robots
        high = np.ones((robots + 1, max(robot_size, arm_size)))
        high[:-1, robot_size - TOOLS - capacity : robot_size - capacity] = self.copies
        high[-1, :TOOLS] = np.minimum(self.copies, capacity)
        state_size = (2 + TOOLS) * robots + 3 * TOOLS + 1 + len(tasks) + (PHASES + 2) * humans
        super().__init__(
            num_envs,
            [moves] * robots + [tasks],
            np.zeros_like(high),
            high,
            [robot_size] * robots + [arm_size],
            state_size,
            horizon,
            render_mode,
        )
        self._build_tables()
        self.position = np.empty((num_envs, robots, 2))
        self.location, self.time_left = np.empty((2, num_envs, robots), np.int64)
        self.carried = np.empty((num_envs, robots, TOOLS), np.int64)
        self.staged = np.empty((num_envs, capacity), np.int64)
        self.found = np.empty((num_envs, TOOLS), np.int64)
        self.arm_task, self.arm_left = np.empty((2, num_envs), np.int64)
        self.pass_ready = np.empty(num_envs, bool)
        self.phase, self.clock = np.empty((2, num_envs, humans), np.int64)
        self.has_next_tool = np.empty((num_envs, humans), bool)
        self._reset(np.ones(num_envs, bool))

    def _build_tables(self):
        """Look-up tables: one gather is several times faster than the arithmetic on short axes that it replaces."""
        envs, humans, robots, capacity = self.num_envs, self.n_humans, self.n_robots, self.staging_capacity
        self.waypoints = np.stack([np.vstack([self.workshops, self.tool_room, table]) for table in self.tables])
        self._waypoints = self.waypoints.reshape(-1, 2)
        self._first_waypoint = np.tile(np.arange(robots) * (humans + 2), (envs, 1))  # of each robot, in _waypoints
        self._is_workshop = np.eye(humans + 2, humans, dtype=bool)  # [macro-action, human]

        # By the arm's macro-action: its duration, the robot of a Pass (0 for the others), whether it is a Pass.
        self._task_steps = np.array([self.arm_wait_steps] + [self.pass_steps] * robots + [self.search_steps] * TOOLS)
        self._task_robot = np.array([0, *range(robots), 0, 0, 0])
        self._is_pass = np.array([False] + [True] * robots + [False] * TOOLS)
        self._task_one_hot = np.eye(1 + robots + TOOLS + 1, 1 + robots + TOOLS, dtype=np.float32)  # last row: none

        # Flat positions, by environment, in arrays [N, R], [N, R, TOOLS], [N, R, H] and, by human, in phase_lengths.
        self._first_robot = np.arange(envs) * robots
        self._first_carried = np.repeat(np.arange(envs) * robots * TOOLS, humans).reshape(envs, humans)
        self._first_human = np.repeat(np.arange(envs) * humans, robots).reshape(envs, robots)
        self._first_phase = np.tile(np.arange(humans) * PHASES, (envs, 1))

        # All observations, a row each: a robot's by location, phase there and number of staged tools (what it carries
        # is filled in later), then the arm's by queue (which robots stand at the table is filled in later).
        # A queue is known by its number in base 4, the oldest tool being the lowest digit and 0 an empty place.
        self._queue_base = (TOOLS + 1) ** np.arange(capacity)
        queues = [queue[::-1] for queue in itertools.product(range(TOOLS + 1), repeat=capacity)]
        staged = np.array([[queue.count(1 + tool) for tool in range(TOOLS)] for queue in queues])  # [queue, tool]
        self._n_staged = staged.sum(axis=1)
        robot_rows = (humans + 3) * PHASES * (capacity + 1)
        self._arm_row = robot_rows
        self._obs_rows = np.zeros((robot_rows + len(queues), *self.single_observation_space.shape[1:]), np.float32)
        place, phase, number = np.unravel_index(np.arange(robot_rows), (humans + 3, PHASES, capacity + 1))
        here, rows = place < humans, self._obs_rows
        rows[np.arange(robot_rows), place] = 1
        rows[:robot_rows][here, humans + 3 + PHASES * place[here] + phase[here]] = 1
        shown = ~here & (number > 0)
        rows[:robot_rows][shown, self.obs_sizes[0] - capacity - 1 + number[shown]] = 1
        rows[robot_rows:, :TOOLS] = staged
        self._start_obs = np.zeros((envs, robots + 1, rows.shape[1]), np.float32)
        self._start_obs[:, :-1, humans + 2] = 1

        # Parts of the state: staged tools and tool in the hand, by queue and whether the arm holds the oldest; a
        # human's phase and whether it has its next tool (the clock between them is filled in later).
        in_hand = np.eye(TOOLS + 1, dtype=np.float32)[[queue[0] for queue in queues], 1:]
        in_hand = np.stack([np.zeros_like(in_hand), in_hand], axis=1)  # [queue, held?, tool]
        self._queue_rows = np.concatenate([np.stack([staged, staged], axis=1), in_hand], axis=2).reshape(-1, 2 * TOOLS)
        self._human_rows = np.zeros((2 * PHASES, PHASES + 2), np.float32)
        self._human_rows[np.arange(2 * PHASES), np.arange(2 * PHASES) // 2] = 1
        self._human_rows[1::2, -1] = 1

    def _reset(self, mask):
        self.position[mask], self.location[mask], self.time_left[mask] = self.starts, self.n_humans + 2, 0
        self.carried[mask], self.staged[mask], self.found[mask] = 0, -1, 0
        self.arm_task[mask], self.arm_left[mask], self.pass_ready[mask] = -1, 0, False
        self.phase[mask], self.clock[mask], self.has_next_tool[mask] = 0, self.phase_lengths[:, 0], False

    def _advance(self):
        moves, task = self.macro_action[:, :-1], self.macro_action[:, -1]
        get_tool = moves == self.n_humans + 1
        ended = np.empty(self.macro_action.shape, bool)

        # Robots move. Distances are rounded as in np.round(distance, 2).
        target = self._waypoints.take(moves + self._first_waypoint, axis=0)  # [N, R, 2]
        to_target = target - self.position
        squared = to_target * to_target
        distance = np.sqrt(squared[:, :, 0] + squared[:, :, 1])
        distance *= 100.0
        np.rint(distance, out=distance)
        distance /= 100.0
        arrived = distance <= self.robot_speed
        to_target *= (self.robot_speed / np.maximum(distance, self.robot_speed))[:, :, None]
        self.position += to_target
        np.copyto(self.position, target, where=arrived[:, :, None])
        np.copyto(self.location, moves, where=arrived)

        # Get-Tool waits from the step after its arrival on; only the sign of the time left on the way ever matters.
        waits = arrived & get_tool & (self.time_left <= 0)
        np.minimum(self.time_left, 0, out=self.time_left)
        self.time_left -= waits
        np.copyto(self.time_left, 1, where=~arrived)
        timed_out = waits & (self.time_left <= -self.tool_wait_steps)
        np.copyto(self.time_left, -1, where=timed_out)
        ended[:, :-1] = timed_out | (arrived & ~get_tool)

        # Robots deliver, in order: two may bring a human the same tool. `arrived` says that the robot stands at the
        # workshop; `location` alone would not, since in the primitive version a robot can turn round on its way.
        visits = self._is_workshop.take(np.where(arrived, moves, self.n_humans), axis=0)  # [N, R, H]
        carried, had_tool = self.carried.reshape(-1), self.has_next_tool.copy()
        for robot in range(self.n_robots):
            needed = self.phase + (self._first_carried + TOOLS * robot)  # out of range in phase 4, which needs none
            delivers = visits[:, robot] & ~self.has_next_tool & (carried.take(needed, mode="clip") > 0)
            carried[needed[delivers]] -= 1
            self.has_next_tool |= delivers
        value = self.delivery_reward - self.late_penalty * (self.clock <= 0)
        rewards = np.add.reduce(value * (self.has_next_tool ^ had_tool), axis=1) - self.step_cost

        # The arm. `partner` is the flat index of the robot that a Pass is for.
        starts = (task != self.arm_task) | (self.arm_left == 0) if self.primitive else self.macro_done[:, -1]
        partner = self._task_robot.take(task) + self._first_robot
        waiting = (self.location == self.n_humans + 1) & (self.time_left < 0)
        self.arm_task[:] = task
        np.copyto(self.pass_ready, waiting.take(partner), where=starts)
        np.copyto(self.arm_left, self._task_steps.take(task), where=starts)
        self.arm_left -= 1
        ended[:, -1] = arm_ended = self.arm_left == 0

        search_ended = np.flatnonzero(arm_ended & (task > self.n_robots))
        if search_ended.size:
            tool = task[search_ended] - (self.n_robots + 1)
            number = np.count_nonzero(self.staged[search_ended] >= 0, axis=1)
            finds = (number < self.staging_capacity) & (self.found[search_ended, tool] < self.copies[tool])
            env, tool = search_ended[finds], tool[finds]
            self.staged[env, number[finds]] = tool
            self.found[env, tool] += 1

        pass_ended = arm_ended & self._is_pass.take(task)
        receives = pass_ended & self.pass_ready & (get_tool & (self.time_left < 0)).take(partner)
        rewards -= self.failed_pass_penalty * (pass_ended ^ receives)
        env = np.flatnonzero(receives)
        if env.size:
            robot, tool = task[env] - 1, self.staged[env, 0]
            self.time_left[env, robot], ended[env, robot] = 0, True
            is_staged = tool >= 0
            self.carried[env[is_staged], robot[is_staged], tool[is_staged]] += 1
            self.staged[env, :-1], self.staged[env, -1] = self.staged[env, 1:], -1

        # Termination, then the humans' clocks. From the last phase on there is nothing more to fetch.
        terminations = np.logical_and.reduce((self.phase >= PHASES - 2) & self.has_next_tool, axis=1)
        in_last_phase = self.phase == PHASES - 1
        self.clock -= ~in_last_phase | (self.clock > 0)
        begins = (self.clock <= 0) & self.has_next_tool & ~in_last_phase
        if begins.any():
            self.phase += begins
            np.copyto(self.clock, self.phase_lengths.take(self.phase + self._first_phase), where=begins)
            np.copyto(self.has_next_tool, self.phase == PHASES - 1, where=begins)
        if self.primitive:
            ended[:] = True
        return rewards, terminations, ended, terminations

    def _observe(self, start):
        if start:
            return self._start_obs
        queue = self._queue_number()
        phase_here = self.phase.take(self.location + self._first_human, mode="clip")  # unused away from the workshops
        rows = np.empty(self.macro_done.shape, np.int64)
        rows[:, :-1] = (self.location * PHASES + phase_here) * (self.staging_capacity + 1)
        rows[:, :-1] += self._n_staged.take(queue)[:, None]
        rows[:, -1] = queue + self._arm_row
        obs = self._obs_rows.take(rows, axis=0)
        after = self.obs_sizes[0] - self.staging_capacity
        obs[:, :-1, after - TOOLS : after] = self.carried
        at_table = self.position == self.tables
        obs[:, -1, TOOLS : TOOLS + self.n_robots] = at_table[:, :, 0] & at_table[:, :, 1]
        return obs

    def _queue_number(self):
        return (self.staged + 1) @ self._queue_base

    def _state(self):
        state = np.empty((self.num_envs, self.state_size), np.float32)
        arm, humans = (2 + TOOLS) * self.n_robots, self.state_size - (PHASES + 2) * self.n_humans
        robot_part = state[:, :arm].reshape(self.num_envs, self.n_robots, 2 + TOOLS)
        robot_part[:, :, :2] = self.position / self.room_size
        robot_part[:, :, 2:] = self.carried
        is_running = self.arm_left > 0
        task = np.where(is_running, self.arm_task, -1)
        in_hand = is_running & self.pass_ready & self._is_pass.take(self.arm_task)
        state[:, arm : arm + 2 * TOOLS] = self._queue_rows.take(2 * self._queue_number() + in_hand, axis=0)
        state[:, arm + 2 * TOOLS : arm + 3 * TOOLS] = self.found
        state[:, arm + 3 * TOOLS] = self.arm_left / self._task_steps.max()
        state[:, arm + 3 * TOOLS + 1 : humans] = self._task_one_hot.take(task, axis=0)
        human_part = state[:, humans:].reshape(self.num_envs, self.n_humans, PHASES + 2)
        human_part[:] = self._human_rows.take(2 * self.phase + self.has_next_tool, axis=0)
        length = self.phase_lengths.take(self.phase + self._first_phase)
        human_part[:, :, PHASES] = np.maximum(self.clock / length, -1.0)
        return state

    def _draw(self, index):
        from envs.rendering import draw_warehouse  # only needed, and only imports pillow, for pictures

        return draw_warehouse(self, index)


def _numbers(name, value, shape=(), positive=False):
    try:
        array = np.array(value, np.float64)
    except (TypeError, ValueError):  # not numbers at all, or rows of different lengths
        array = np.array([np.nan])
    if array.shape != shape or not np.isfinite(array).all() or (positive and (array <= 0).any()):
        kind = "finite positive" if positive else "finite"
        what = f"{kind} numbers of shape {shape}" if shape else f"a {kind} number"
        raise ValueError(f"{name} must be {what}, got {value!r}")
    return array


def _rows(name, value, width):
    """At least one row, one per robot or human."""
    count = len(value) if hasattr(value, "__len__") else 0
    if count == 0:
        raise ValueError(f"{name} must be a list with at least one entry, got {value!r}")
    return _numbers(name, value, (count, width))


def _whole(name, value, shape=()):
    """Counts and durations: whole numbers of at least 1."""
    array = _numbers(name, value, shape)
    if (array < 1).any() or (array != np.rint(array)).any():
        raise ValueError(f"{name} must be whole and at least 1, got {np.asarray(value).tolist()}")
    return array.astype(np.int64)
