"""Warehouse Tool Delivery: mobile robots fetch tools from an arm and bring them to human workers, just in time."""

import numpy as np

from envs import checks
from envs.core import MacroVectorEnv

TOOLS = 3  # kinds of tools
PHASES = 4  # 0 to 3, of a human's work. It has the tool for phase 0 and needs tool k for phase k + 1.
LAST_PHASE = PHASES - 1
NO_TOOL = -1  # an empty place in the queue of staged tools

# Positions are in metres. There is one entry per human in `workshops` and `phase_lengths`, and one per robot in
# `tables` (its place at the arm's table) and `starts`. `copies` is the number of copies of each tool. `arm` is only
# drawn.
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
        "phase_lengths": [(27, 20, 20, 20)] * 2,
    },
    "t": {
        "workshops": [(6.0, 3.0), (8.0, 3.0), (8.0, 2.0)],
        "tool_room": (3.0, 2.5),
        "tables": [(1.2, 3.7), (1.2, 1.3)],
        "starts": [(3.0, 3.5), (3.0, 1.5)],
        "arm": (0.9, 2.5),
        "robot_speed": 0.8,
        "copies": 3,
        "phase_lengths": [(40, 40, 40, 40)] * 3,
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


def one_hot(numbers, size):
    """Bool [..., size], True at each number and all False for a number out of range."""
    return numbers[..., None] == np.arange(size)


class Warehouse(MacroVectorEnv):
    """Warehouse Tool Delivery (WTD), a batch of N environments.

    ## Description
    Each of H human workers has a workshop and works through four phases. A human starts with the tool for the first
    phase. It needs tools 0, 1 and 2, in that order, for the other three. An arm finds the tools and stages them beside
    its table. It passes the oldest staged tool to a robot that waits at the table. R mobile robots take the tools to
    the workshops. The team should bring every tool before its human has to wait for it.

    There are four layouts (`LAYOUTS`): "s" has 2 robots and 1 human, "d" 2 and 2, "t" 2 and 3, "t1" 3 and 3.
    The agents are the robots, in their order, and then the arm. Everything is deterministic. Each step, in this order:

    1. Every robot moves. A robot that is on Get-Tool and at the table waits.
    2. Robots that reach a workshop in this step deliver, robot 0 first.
    3. The arm works. If its macro-action ends, it stages the tool that it has found or hands a tool over.
    4. The episode terminates if every human has all its tools (see "Episode end").
    5. Every human works: its clock counts down. If the clock has run down and the human has its next tool, its next
       phase begins.

    ## Macro-actions
    A robot has H + 2 macro-actions:

    - 0..H-1: Go-W(i). The robot goes to workshop i. On its arrival it gives human i the tool for the human's next
      phase, if the robot carries that tool and the human does not have it yet.
    - H: Go-TR. The robot goes to the tool room.
    - H+1: Get-Tool. The robot goes to its own place at the table and waits there for a tool, for 10 steps at most.

    A robot moves `robot_speed` a step, straight to the waypoint of its macro-action. The last step is shorter, so that
    the robot ends exactly on the waypoint. When does its waiting at the table begin? If its way took two steps or more,
    it begins in the step after the arrival. If its way took one step, or none, it begins in the first step of Get-Tool.
    So a Get-Tool in vain lasts 3 + 10 steps if the way takes 3 steps, and 10 steps if it takes 1. If a robot that has
    waited in vain chooses Get-Tool again at once, it waits for 9 more steps, not for 10.

    The arm has 1 + R + 3 macro-actions:

    - 0: Wait-M takes 1 step and does nothing.
    - 1..R: Pass-to-M(j) takes 4 steps. At its end robot j gets the oldest staged tool, and the robot's Get-Tool ends.
      If nothing is staged, the Get-Tool ends all the same, without a penalty. The Pass fails unless robot j waits at
      the table both in the first and in the last step of the Pass. In each of these two steps the arm looks for the
      robot after the robots have moved. A Pass that fails takes its 4 steps, too, and is penalised at their end.
    - R+1..R+3: Search-Tool(k) takes 6 steps. At its end a copy of tool k is staged if not all of its copies have been
      found and there is room for one more tool.

    With `primitive=True` every macro-action lasts one step. A robot moves for one step, or waits for one step, and
    chooses again; it delivers in the step in which it arrives. Search finds its tool in one step and Pass hands a tool
    over in one step.

    ## Macro-observations
    A robot observes H + 3 + 4H + 3 + C numbers (C is `staging_capacity`, 2 by default):

    - H + 3: the place that it has reached last, one-hot: workshop 0..H-1, tool room, table, or "nowhere yet" (before it
      has reached any)
    - 4H: for each human its phase, one-hot, or zeros if the robot's place is not that human's workshop
    - 3: how many of each tool it carries
    - C: the number of staged tools, one-hot over 1..C, or zeros if there is none or the robot's place is a workshop

    The arm observes 3 + R numbers:

    - 3: how many of each tool are staged
    - R: for each robot whether it stands at its place at the table

    At a reset a robot's place is "nowhere yet" and all else is 0. The arm observes only zeros.

    ## Rewards
    - -1 each step
    - +100 for each tool delivered, or +80 if the clock of the human's phase has already run down
    - -10 for a failed Pass

    ## Episode end
    - Termination: every human has got the tool for its fourth phase. It does not matter whether a human has already
      begun or finished that phase. Termination is also `success`.
    - Truncation: after `horizon` steps.

    ## State
    For each robot five numbers:

    - (2) x / room width, y / room depth
    - (3) how many of each tool it carries

    Then for the arm 14 + R numbers:

    - (3) how many of each tool are staged; a tool that is being passed counts until the Pass ends
    - (3) the tool in the arm's hand, one-hot. During a Pass whose robot j waited in the first step, this is the oldest
      staged tool. Otherwise it is zeros.
    - (3) how many of each tool have been found so far
    - (1) steps left of its macro-action / length of its longest macro-action
    - (4 + R) its running macro-action, one-hot, zeros when none is running

    Then for each human six numbers:

    - (4) its phase, one-hot
    - (1) its clock / length of the phase, at least -1
    - (1) whether it has the tool for its next phase; always 1 in the fourth phase

    ## Arguments
    - layout: a key of `LAYOUTS`. Each of its entries can be replaced by the keyword of the same name: `workshops`
      [H, 2], `tool_room` [2], `tables` [R, 2], `starts` [R, 2], `arm` [2] (only drawn), `robot_speed` (metres per
      step), `copies` (of each tool, one number for all or three), `phase_lengths` [H, 4] (steps). With all of them you
      have a layout of your own.
    - primitive: whether every macro-action takes one step
    - horizon: steps until truncation
    - render_mode: None or "rgb_array"
    - delivery_reward: for a tool that is delivered in time
    - late_penalty, failed_pass_penalty, step_cost: positive numbers that are subtracted. A late delivery earns
      `delivery_reward - late_penalty`.
    - search_steps, pass_steps, arm_wait_steps: how long the arm's macro-actions take, 6, 4 and 1 by default. With
      `primitive=True` they are 1, and any other number is an error.
    - tool_wait_steps: how long Get-Tool waits at the table
    - staging_capacity: how many tools can be staged at once
    - room_size: width and depth in metres, by which the state divides positions

    ## Attributes
    Besides those of `MacroVectorEnv`:

    - the arguments, lists as arrays; n_humans H and n_robots R
    - the numbers of places: 0..H-1 workshops, tool_room_place H, table_place H+1, nowhere_yet H+2. A robot's
      macro-action has the number of the place to which it leads.
    - waypoints float64 [R, H + 2, (x, y)], where each robot finds these places (all but "nowhere yet")
    - task_steps int [1 + R + 3], how long each of the arm's macro-actions takes
    - passes_to bool [1 + R + 3, R] and searches_for bool [1 + R + 3, 3], the robot to which each of the arm's
      macro-actions passes and the tool for which it searches, one-hot

    The simulator's state is in these arrays:

    - position float64 [N, R, (x, y)]
    - location int [N, R], the number of the place that the robot has reached last
    - under_way bool [N, R], whether the robot was still short of its waypoint after the last step
    - waited int [N, R], for how many steps the robot has waited at the table. The count is set to 0 when a Pass serves
      the robot and in each step in which the robot is under way. It is set to 1 when a Get-Tool ends in vain, because
      its last step also counts as the first one of a next wait. In a layout of your own a robot can go elsewhere in one
      step and come back in another one. It is never under way then, so the count stays.
    - carried int [N, R, 3], copies of each tool
    - staged int [N, C], queue of tools, oldest first, -1 for an empty place
    - found int [N, 3], copies of each tool found so far
    - arm_left int [N], steps left of the arm's macro-action
    - pass_ready bool [N], whether the arm's macro-action is a Pass whose robot j waited in the first step. It keeps its
      value until the arm starts its next macro-action.
    - phase int [N, H], 0..3
    - clock int [N, H], steps left of the phase. It is 0 or less while the human waits for its tool and when it has
      finished the fourth phase.
    - has_next_tool bool [N, H], whether the human has the tool for its next phase (always True in the fourth phase)

    ## Irregularities of the published code that are not kept
    The paper of AVF (see Source) states one rule for all layouts. In the published code
    for "s" Get-Tool waits 11 steps and a delivery counts as late one step later. In the published code for "t1" the arm
    does not check robot 2 at the start of a Pass.

    ## Source
    Y. Xiao, J. Hoffman, T. Xia, C. Amato, "Learning Multi-Robot Decentralized Macro-Action-Based Policies via a
    Centralized Q-Net", ICRA 2020; Y. Xiao, W. Tan, C. Amato, "Asynchronous Actor-Critic for Multi-Agent Reinforcement
    Learning", NeurIPS 2022. Variants, rewards and constants are those of Appendix D of the paper of AVF,
    "Value Factorization for Asynchronous Multi-Agent Reinforcement Learning".
    """

    sim_arrays = (
        "position",
        "location",
        "under_way",
        "waited",
        "carried",
        "staged",
        "found",
        "arm_left",
        "pass_ready",
        "phase",
        "clock",
        "has_next_tool",
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
        search_steps=None,
        pass_steps=None,
        arm_wait_steps=None,
        tool_wait_steps=10,
        staging_capacity=2,
    ):
        """Raises ValueError: the layout is unknown, or an argument is out of range or does not fit the others."""
        if not isinstance(layout, str) or layout not in LAYOUTS:
            raise ValueError(f"unknown layout {checks.shown(layout)}; valid layouts: {' '.join(LAYOUTS)}")

        self.layout = layout
        self.primitive = checks.flag("primitive", primitive)

        def given(name, value):
            """The keyword's value or, if it was not given, that of the layout."""
            return LAYOUTS[layout][name] if value is None else value

        def duration(name, value, usual):
            """How many steps a macro-action of the arm takes: the keyword's value, else 1 if primitive, else usual."""
            if value is None:
                return 1 if self.primitive else usual
            steps = checks.whole(name, value)
            if self.primitive and steps != 1:
                raise ValueError(f"{name} must be 1 with primitive=True, got {steps}")
            return steps

        self.workshops = checks.rows("workshops", given("workshops", workshops), 2)
        self.tool_room = checks.numbers("tool_room", given("tool_room", tool_room), (2,))
        self.tables = checks.rows("tables", given("tables", tables), 2)
        self.starts = checks.rows("starts", given("starts", starts), 2)
        self.arm = checks.numbers("arm", given("arm", arm), (2,))
        self.robot_speed = checks.positive("robot_speed", given("robot_speed", robot_speed))
        copies = given("copies", copies)
        self.copies = checks.whole("copies", copies if np.iterable(copies) else [copies] * TOOLS, (TOOLS,))
        lengths = given("phase_lengths", phase_lengths)
        shape = checks.rows("phase_lengths", lengths, PHASES).shape  # [H, 4]
        self.phase_lengths = checks.whole("phase_lengths", lengths, shape)
        self.room_size = checks.positive("room_size", room_size, (2,))
        self.delivery_reward = checks.numbers("delivery_reward", delivery_reward)
        self.late_penalty = checks.numbers("late_penalty", late_penalty)
        self.failed_pass_penalty = checks.numbers("failed_pass_penalty", failed_pass_penalty)
        self.step_cost = checks.numbers("step_cost", step_cost)
        self.search_steps = duration("search_steps", search_steps, 6)
        self.pass_steps = duration("pass_steps", pass_steps, 4)
        self.arm_wait_steps = duration("arm_wait_steps", arm_wait_steps, 1)
        self.tool_wait_steps = checks.whole("tool_wait_steps", tool_wait_steps)
        self.staging_capacity = checks.whole("staging_capacity", staging_capacity)

        humans = len(self.workshops)
        robots = len(self.tables)
        if len(self.starts) != robots:
            got = f"got {robots} and {len(self.starts)}"
            raise ValueError(f"tables and starts need one entry per robot, {got}")
        if len(self.phase_lengths) != humans:
            got = f"got {humans} and {len(self.phase_lengths)}"
            raise ValueError(f"workshops and phase_lengths need one entry per human, {got}")
        self.n_humans = humans
        self.n_robots = robots

        # The numbers of the places, which are also those of the robots' macro-actions.
        self.tool_room_place = humans
        self.table_place = humans + 1
        self.nowhere_yet = humans + 2
        shared_waypoints = np.vstack([self.workshops, self.tool_room])  # [H + 1, (x, y)]
        waypoints = [np.vstack([shared_waypoints, table]) for table in self.tables]
        self.waypoints = np.stack(waypoints)  # [R, H + 2, (x, y)]
        go_names = [f"Go-W({human})" for human in range(humans)]
        robot_names = [*go_names, "Go-TR", "Get-Tool"]

        # The arm's macro-actions and how long they take.
        durations = [self.arm_wait_steps] + [self.pass_steps] * robots + [self.search_steps] * TOOLS
        self.task_steps = np.array(durations)
        arm_actions = np.arange(len(durations))
        self.passes_to = one_hot(arm_actions - 1, robots)
        self.searches_for = one_hot(arm_actions - 1 - robots, TOOLS)
        pass_names = [f"Pass-to-M({robot})" for robot in range(robots)]
        search_names = [f"Search-Tool({tool})" for tool in range(TOOLS)]
        arm_names = ["Wait-M", *pass_names, *search_names]

        # The upper bounds of the observations and the length of the state, in the order of the class docstring.
        place_and_phases = np.ones(humans + 3 + PHASES * humans)
        robot_high = np.concatenate([place_and_phases, self.copies, np.ones(self.staging_capacity)])
        arm_high = np.concatenate([np.minimum(self.copies, self.staging_capacity), np.ones(robots)])
        obs_high = np.ones((robots + 1, max(len(robot_high), len(arm_high))))
        obs_high[:-1, : len(robot_high)] = robot_high
        obs_high[-1, : len(arm_high)] = arm_high
        robots_size = robots * (2 + TOOLS)
        arm_size = 3 * TOOLS + 1 + len(arm_names)
        humans_size = humans * (PHASES + 2)
        super().__init__(
            num_envs=num_envs,
            macro_action_names=[robot_names] * robots + [arm_names],
            obs_low=np.zeros_like(obs_high),
            obs_high=obs_high,
            obs_sizes=[len(robot_high)] * robots + [len(arm_high)],
            state_size=robots_size + arm_size + humans_size,
            horizon=horizon,
            render_mode=render_mode,
        )
        self.position = np.zeros((self.num_envs, robots, 2))
        self.location = np.zeros((self.num_envs, robots), np.int64)
        self.under_way = np.zeros((self.num_envs, robots), bool)
        self.waited = np.zeros((self.num_envs, robots), np.int64)
        self.carried = np.zeros((self.num_envs, robots, TOOLS), np.int64)
        self.staged = np.zeros((self.num_envs, self.staging_capacity), np.int64)
        self.found = np.zeros((self.num_envs, TOOLS), np.int64)
        self.arm_left = np.zeros(self.num_envs, np.int64)
        self.pass_ready = np.zeros(self.num_envs, bool)
        self.phase = np.zeros((self.num_envs, humans), np.int64)
        self.clock = np.zeros((self.num_envs, humans), np.int64)
        self.has_next_tool = np.zeros((self.num_envs, humans), bool)
        self._reset(np.ones(self.num_envs, bool))  # valid arrays even before the first reset

    def _reset(self, mask):
        self.position[mask] = self.starts
        self.location[mask] = self.nowhere_yet
        self.under_way[mask] = False
        self.waited[mask] = 0
        self.carried[mask] = 0
        self.staged[mask] = NO_TOOL
        self.found[mask] = 0
        self.arm_left[mask] = 0
        self.pass_ready[mask] = False
        self.phase[mask] = 0
        self.clock[mask] = self.phase_lengths[:, 0]
        self.has_next_tool[mask] = False

    # ---- the rules, in the order of a step ----------------------------------------------------------------------
    def _advance(self):
        destination = self.macro_action[:, :-1]  # [N, R], the place to which each robot goes
        arm_action = self.macro_action[:, -1]  # [N]
        gets_tool = destination == self.table_place

        arrived = self._move_robots(destination)
        gives_up = self._wait_at_table(at_table=arrived & gets_tool, under_way=~arrived)
        rewards = self._deliver(arrived, destination) - self.step_cost

        arm_ends = self._run_arm(arm_action)
        self._stage_found_tool(arm_action, arm_ends)
        served, pass_fails = self._hand_over(arm_action, arm_ends, gets_tool)
        rewards -= np.where(pass_fails, self.failed_pass_penalty, 0.0)

        robot_ends = (arrived & ~gets_tool) | gives_up | served
        ended = np.column_stack([robot_ends, arm_ends])
        if self.primitive:
            ended[:] = True

        # In the third phase with the tool for the fourth, or in the fourth, where has_next_tool is always True.
        has_last_tool = (self.phase >= LAST_PHASE - 1) & self.has_next_tool  # [N, H]
        all_supplied = has_last_tool.all(axis=1)
        self._advance_humans()
        return rewards, all_supplied, ended, all_supplied

    def _move_robots(self, destination):
        """Moves each robot one step towards its waypoint and returns whether it stands on it now, bool [N, R]."""
        waypoint = self.waypoints[np.arange(self.n_robots), destination]  # [N, R, (x, y)]
        way = waypoint - self.position
        length = np.sqrt(way[:, :, 0] ** 2 + way[:, :, 1] ** 2)
        distance = np.round(length, 2)  # to the centimetre, as in the published benchmark
        arrived = distance <= self.robot_speed
        share = self.robot_speed / np.maximum(distance, self.robot_speed)  # the part of the way to go now
        moved = self.position + share[:, :, None] * way
        self.position = np.where(arrived[:, :, None], waypoint, moved)
        self.location = np.where(arrived, destination, self.location)
        return arrived

    def _wait_at_table(self, at_table, under_way):
        """Counts the steps that robots wait at the table.

        Args:
            at_table: bool [N, R], whether the robot is on Get-Tool and at the table.
            under_way: bool [N, R], whether the robot has not reached its waypoint.

        Returns:
            gives_up bool [N, R], whether the robot's Get-Tool ends because it has waited in vain for long enough.
        """
        was_under_way = self.under_way  # in the step before
        waits = at_table & ~was_under_way  # one that was under way arrives now; its waiting begins in the next step
        self.waited[waits] += 1
        self.waited[under_way] = 0
        self.under_way = under_way
        gives_up = waits & (self.waited >= self.tool_wait_steps)
        self.waited[gives_up] = 1  # this step also counts as the first one of a next wait
        return gives_up

    def _deliver(self, arrived, destination):
        """Robots that have reached a workshop give its human the next tool; returns the rewards, float64 [N]."""
        visits = arrived[:, :, None] & one_hot(destination, self.n_humans)  # [N, R, H]
        needed = np.minimum(self.phase, TOOLS - 1)  # [N, H]: in phase p tool p is next; not used in the last phase
        env = np.arange(self.num_envs)[:, None, None]
        robot = np.arange(self.n_robots)[:, None]
        carries = self.carried[env, robot, needed[:, None]] > 0  # [N, R, H]
        brings = visits & carries & ~self.has_next_tool[:, None]
        delivers = brings & (brings.cumsum(axis=1) == 1)  # if two bring a human the same tool, the first one gives it
        env, robot, human = np.nonzero(delivers)
        self.carried[env, robot, needed[env, human]] -= 1  # a robot visits one workshop, so no pair occurs twice
        receives = delivers.any(axis=1)
        self.has_next_tool |= receives
        late = self.clock <= 0
        value = np.where(late, self.delivery_reward - self.late_penalty, self.delivery_reward)
        return np.where(receives, value, 0.0).sum(axis=1)

    def _run_arm(self, arm_action):
        """Takes one step of the arm's macro-action; returns where it ends, bool [N]."""
        starts = self.macro_done[:, -1]
        is_waiting = (self.location == self.table_place) & (self.waited >= 1)  # [N, R]
        can_pass = (self.passes_to[arm_action] & is_waiting).any(axis=1)
        self.pass_ready = np.where(starts, can_pass, self.pass_ready)
        self.arm_left = np.where(starts, self.task_steps[arm_action], self.arm_left) - 1
        return self.arm_left == 0

    def _stage_found_tool(self, arm_action, arm_ends):
        """Where a Search ends: puts a copy of the tool, if one is left, at the end of the queue, if there is room."""
        n_staged = self._n_staged()
        has_room = n_staged < self.staging_capacity
        search_ends = self.searches_for[arm_action] & arm_ends[:, None]  # [N, TOOLS]
        finds = search_ends & has_room[:, None] & (self.found < self.copies)
        env, tool = np.nonzero(finds)
        self.found[env, tool] += 1
        self.staged[env, n_staged[env]] = tool

    def _hand_over(self, arm_action, arm_ends, gets_tool):
        """Where a Pass ends: gives the oldest staged tool, if there is one, to the robot, and the queue moves up.

        Returns:
            served bool [N, R], whether the Pass ends the robot's Get-Tool, and fails bool [N], whether the Pass fails.
        """
        pass_ends = self.passes_to[arm_action] & arm_ends[:, None]  # [N, R]
        # A robot on Get-Tool with a count of 1 or more is at the table, because under way the count is 0.
        served = pass_ends & self.pass_ready[:, None] & gets_tool & (self.waited >= 1)
        fails = (pass_ends & ~served).any(axis=1)
        self.waited[served] = 0

        oldest = self.staged[:, 0]
        has_tool = oldest != NO_TOOL
        env, robot = np.nonzero(served & has_tool[:, None])
        self.carried[env, robot, oldest[env]] += 1
        self.staged[env, :-1] = self.staged[env, 1:]
        self.staged[env, -1] = NO_TOOL
        return served, fails

    def _advance_humans(self):
        """Counts down the clocks and begins the next phase where the clock has run down and the next tool is there."""
        in_last_phase = self.phase == LAST_PHASE
        finished = in_last_phase & (self.clock <= 0)
        self.clock[~finished] -= 1
        begins = ~in_last_phase & (self.clock <= 0) & self.has_next_tool
        self.phase[begins] += 1
        self.clock[begins] = self._phase_length()[begins]
        self.has_next_tool[begins] = self.phase[begins] == LAST_PHASE  # it needs no other tool

    # ---- small helpers ------------------------------------------------------------------------------------------
    def _n_staged(self):
        """How many tools are staged, int [N]."""
        return (self.staged != NO_TOOL).sum(axis=1)

    def _phase_length(self):
        """How many steps each human's present phase takes, int [N, H]."""
        return self.phase_lengths[np.arange(self.n_humans), self.phase]

    # ---- observations and the state, in the order of the class docstring ----------------------------------------
    def _observe(self, start):
        robots = self._observe_robots()
        arm = self._observe_arm()
        obs = np.zeros(self._obs.shape, np.float32)
        obs[:, :-1, : robots.shape[2]] = robots
        obs[:, -1, : arm.shape[1]] = arm
        if start:
            obs[:, -1] = 0.0  # the arm does not see who stands at the table at a reset
        return obs

    def _observe_robots(self):
        place = one_hot(self.location, self.nowhere_yet + 1)
        at_workshop = place[:, :, : self.n_humans]
        phase = one_hot(self.phase, PHASES)
        phase_here = at_workshop[:, :, :, None] & phase[:, None]  # [N, R, H, PHASES]
        phases_seen = phase_here.reshape(self.num_envs, self.n_robots, -1)

        sees_queue = self.location >= self.tool_room_place  # not at a workshop
        n_staged = one_hot(self._n_staged() - 1, self.staging_capacity)  # [N, C], zeros if none is staged
        n_staged_seen = sees_queue[:, :, None] & n_staged[:, None]
        return np.concatenate([place, phases_seen, self.carried, n_staged_seen], axis=2)

    def _observe_arm(self):
        stands_at_table = (self.position == self.tables).all(axis=2)
        return np.concatenate([self._staged_counts(), stands_at_table], axis=1)

    def _staged_counts(self):
        """How many of each tool are staged, int [N, TOOLS]."""
        return one_hot(self.staged, TOOLS).sum(axis=1)

    def _state(self):
        robots = np.concatenate([self.position / self.room_size, self.carried], axis=2)

        is_running = self.arm_left > 0
        is_passing = is_running & self.pass_ready
        in_hand = one_hot(self.staged[:, 0], TOOLS) & is_passing[:, None]
        share_left = self.arm_left / self.task_steps.max()
        arm_action = one_hot(self.macro_action[:, -1], len(self.task_steps)) & is_running[:, None]
        arm = [self._staged_counts(), in_hand, self.found, share_left[:, None], arm_action]

        phase = one_hot(self.phase, PHASES)
        clock = np.maximum(self.clock / self._phase_length(), -1.0)
        humans = np.concatenate([phase, clock[..., None], self.has_next_tool[..., None]], axis=2)

        parts = [robots.reshape(self.num_envs, -1), *arm, humans.reshape(self.num_envs, -1)]
        return np.concatenate(parts, axis=1, dtype=np.float32)

    def _draw(self, index):
        from envs.rendering import draw_warehouse

        return draw_warehouse(self, index)
