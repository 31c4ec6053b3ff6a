"""Warehouse Tool Delivery in hand-made scenarios: the rules one by one, layouts, arguments, the primitive version.

The recorded episodes are compared in test_traces.py.
"""

import numpy as np
import pytest

from envs.warehouse import LAYOUTS, Warehouse

GO_W, GO_TR, GET_TOOL = 0, 1, 2  # of a robot in a layout with one human
WAIT, PASS_0, PASS_1, SEARCH_0, SEARCH_1, SEARCH_2 = range(6)  # of the arm beside two robots


def started(*args, **kwargs):
    env = Warehouse(*args, **kwargs)
    env.reset(seed=0)
    return env


def run(env, *actions):
    """Steps a batch of one; rewards and the last step's observation, terminated and infos."""
    rewards = []
    for action in actions:
        obs, reward, terminated, _, infos = env.step(np.array([action]))
        rewards.append(reward[0])
    return rewards, obs[0], terminated[0], infos


def until_done(env, action, agent):
    """Gives the same actions until the agent's macro-action ends; the number of steps it took and the last rewards."""
    for count in range(1, 100):
        rewards, *_ = run(env, action)
        if env.macro_done[0, agent]:
            return count, rewards[-1]
    raise AssertionError("the macro-action never ended")


def bits(text):
    return [int(digit) for digit in text if digit != " "]


def place(env, robot, waypoint, carried=(0, 0, 0)):
    env.position[0, robot], env.location[0, robot] = env.waypoints[robot, waypoint], waypoint
    env.under_way[0, robot], env.waited[0, robot], env.carried[0, robot] = False, 0, carried


def set_free(env, agent):
    env.macro_done[0, agent] = True
    env._update_available()


@pytest.mark.parametrize(("layout", "agents", "actions", "obs_sizes", "state_size"), [
    ("s", 3, [3, 3, 6], [13, 13, 5], 32),
    ("d", 3, [4, 4, 6], [18, 18, 5], 38),
    ("t", 3, [5, 5, 6], [23, 23, 5], 44),
    ("t1", 4, [5, 5, 5, 7], [23, 23, 23, 6], 50),
])  # fmt: skip
def test_sizes_and_reset(layout, agents, actions, obs_sizes, state_size):
    env = Warehouse(4, layout)
    obs, infos = env.reset()
    assert (env.n_agents, env.n_actions, env.obs_sizes, env.state_size) == (agents, actions, obs_sizes, state_size)
    nowhere = env.n_humans + 2
    assert (obs[:, :-1, nowhere] == 1).all() and obs.sum() == 4 * (agents - 1)
    assert infos["state"].shape == (4, state_size) and infos["state"].dtype == np.float32
    assert env.macro_action_names[0][-2:] == ["Go-TR", "Get-Tool"] and env.macro_action_names[-1][0] == "Wait-M"


@pytest.mark.parametrize("primitive", [False, True])
@pytest.mark.parametrize("layout", LAYOUTS)
def test_random_play_stays_in_bounds(layout, primitive):
    env, rng = started(32, layout, primitive=primitive), np.random.default_rng(1)
    for _ in range(150):
        obs, _, terminations, truncations, infos = env.step(rng.integers(0, env.n_actions, (32, env.n_agents)))
        assert env.observation_space.contains(obs)
        assert np.isfinite(infos["state"]).all() and np.abs(infos["state"]).max() <= 3
        assert (env.carried.sum(axis=(1, 2)) + (env.staged >= 0).sum(axis=1) <= env.found.sum(axis=1)).all()
        if (terminations | truncations).any():
            env.reset(options={"reset_mask": terminations | truncations})


def test_robot_moves_straight_and_stands_on_its_waypoint():
    env = started()
    rewards, *_ = run(env, (GO_TR, GO_TR, WAIT))
    gap = np.array([-0.5, 2.0])  # 2.06 rounded to centimetres: that is what the speed is divided by
    np.testing.assert_allclose(env.position[0, 0], [3, 1.5] + 0.6 / 2.06 * gap, atol=1e-12)
    assert rewards == [-1] and not env.macro_done[0, 0]
    assert until_done(env, (GO_TR, GO_TR, WAIT), agent=0)[0] == 3
    assert (env.position[0, 0] == (2.5, 3.5)).all() and env.location[0, 0] == 1


@pytest.mark.parametrize(("clock", "reward"), [(1, 99), (0, 79), (-7, 79)])
def test_delivery_on_time_or_late(clock, reward):
    env = started()
    place(env, 0, GO_W, carried=(1, 0, 0))
    env.clock[0, 0] = clock
    rewards, obs, *_ = run(env, (GO_W, GO_TR, WAIT))
    assert rewards == [reward]
    assert env.phase[0, 0] == 1 and env.clock[0, 0] == 20 and not env.has_next_tool[0, 0] and env.carried.sum() == 0
    assert obs[0].tolist() == bits("1000 0100 000 00")


def test_delivery_needs_go_w_and_the_tool_of_the_next_phase_once():
    env = started(copies=2)
    place(env, 0, GO_W, carried=(0, 1, 1))
    place(env, 1, GO_W, carried=(1, 0, 0))
    assert run(env, (GO_W, GO_TR, WAIT))[0] == [-1]  # robot 0 has other tools, robot 1 is not on Go-W
    env = started(copies=2)
    place(env, 0, GO_W, carried=(1, 0, 0))
    place(env, 1, GO_W, carried=(1, 0, 0))
    assert run(env, (GO_W, GO_W, WAIT), (GO_W, GO_W, WAIT))[0] == [99, -1]
    assert env.carried[0].tolist() == [[0, 0, 0], [1, 0, 0]]


def test_get_tool_waits_ten_steps():
    env = started()
    arrival = 5  # 2.66 m at 0.6 m a step
    assert until_done(env, (GET_TOOL, GET_TOOL, WAIT), agent=0)[0] == arrival + 10
    assert env.waited[0, 0] == 1
    assert until_done(env, (GET_TOOL, GET_TOOL, WAIT), agent=0)[0] == 9  # one step of waiting is counted already
    short = started(tool_wait_steps=3)
    assert until_done(short, (GET_TOOL, GET_TOOL, WAIT), agent=0)[0] == arrival + 3


def test_steps_of_waiting_are_counted_from_the_step_after_the_arrival():
    env, seen = started(), []
    for _ in range(7):
        run(env, (GET_TOOL, GO_TR, WAIT))
        seen.append((env.under_way[0, 0], env.waited[0, 0]))
    assert seen == [(True, 0)] * 4 + [(False, 0), (False, 1), (False, 2)]
    set_free(env, 0)
    run(env, (GO_W, GO_TR, WAIT))
    assert env.under_way[0, 0] and env.waited[0, 0] == 0
    near = started(starts=LAYOUTS["s"]["tables"])  # a single step to the table is a step of waiting already
    run(near, (GET_TOOL, GO_W, WAIT))
    assert near.waited[0].tolist() == [1, 0] and near.under_way[0].tolist() == [False, True]
    assert until_done(near, (GET_TOOL, GO_W, WAIT), agent=0)[0] == 9


def test_a_detour_of_one_step_does_not_begin_the_wait_anew():
    """Only a step that ends short of the waypoint does. Here the tool room is a step from the table."""
    near = started(tables=[(0.8, 3.0), (1.2, 3.0)], starts=[(0.8, 3.0), (1.2, 3.0)], tool_room=(0.8, 3.5))
    assert until_done(near, (GET_TOOL, GET_TOOL, WAIT), agent=0)[0] == 10
    assert until_done(near, (GO_TR, GET_TOOL, WAIT), agent=0)[0] == 1
    assert until_done(near, (GET_TOOL, GET_TOOL, WAIT), agent=0)[0] == 9
    far = started(tables=[(0.8, 3.0), (1.2, 3.0)], starts=[(0.8, 3.0), (1.2, 3.0)], tool_room=(0.8, 4.1))
    assert until_done(far, (GET_TOOL, GET_TOOL, WAIT), agent=0)[0] == 10
    assert until_done(far, (GO_TR, GET_TOOL, WAIT), agent=0)[0] == 2
    assert until_done(far, (GET_TOOL, GET_TOOL, WAIT), agent=0)[0] == 2 + 10


def test_search_then_pass_ends_get_tool():
    env = started()
    assert until_done(env, (GET_TOOL, GET_TOOL, SEARCH_1), agent=2)[0] == 6
    assert env.staged[0].tolist() == [1, -1] and env.found[0].tolist() == [0, 1, 0]
    assert env._state()[0, 19:26].tolist() == bits("0 000000")  # nothing is running
    rewards, _, _, infos = run(env, (GET_TOOL, GET_TOOL, PASS_1))
    arm = infos["state"][0, 10:26]
    assert arm[:9].tolist() == bits("010 010 010")  # staged, in its hand, found
    assert arm[9] == np.float32(3 / 6) and arm[10:].tolist() == [0, 0, 1, 0, 0, 0]
    rewards, obs, _, infos = run(env, *[(GET_TOOL, GET_TOOL, PASS_1)] * 3)
    assert rewards == [-1, -1, -1] and infos["macro_done"][0].tolist() == [False, True, True]
    assert env.carried[0].tolist() == [[0, 0, 0], [0, 1, 0]] and env.staged[0].tolist() == [-1, -1]
    assert env.waited[0, 1] == 0 and obs[2].tolist() == bits("000 11 00000000")
    assert obs[1].tolist() == bits("0010 0000 010 00")


def test_oldest_tool_is_passed_first():
    env = started()
    for tool in (SEARCH_2, SEARCH_0):
        until_done(env, (GET_TOOL, GO_TR, tool), agent=2)
    assert env.staged[0].tolist() == [2, 0]
    until_done(env, (GET_TOOL, GO_TR, PASS_0), agent=2)
    assert env.carried[0, 0].tolist() == [0, 0, 1] and env.staged[0].tolist() == [0, -1]


def test_pass_of_nothing_ends_get_tool_without_penalty():
    env = started()
    for _ in range(8):
        run(env, (GET_TOOL, GET_TOOL, WAIT))
    assert until_done(env, (GET_TOOL, GET_TOOL, PASS_0), agent=2) == (4, -1)
    assert env.macro_done[0, 0] and not env.macro_done[0, 1] and env.carried.sum() == 0


def test_pass_fails_if_the_robot_is_not_there_at_its_first_step():
    env = started()
    until_done(env, (GO_TR, GO_TR, SEARCH_0), agent=2)
    place(env, 0, GET_TOOL)
    set_free(env, 0)
    run(env, (GET_TOOL, GO_TR, WAIT))
    until_done(env, (GET_TOOL, GO_TR, PASS_1), agent=2)
    assert until_done(env, (GET_TOOL, GO_TR, PASS_1), agent=2) == (4, -11)
    assert env.staged[0].tolist() == [0, -1]
    # A robot that arrives during the Pass gets nothing either.
    env = started()
    until_done(env, (GO_TR, GET_TOOL, SEARCH_0), agent=2)
    env.waited[0, 1], env.under_way[0, 1] = 0, True
    _, _, _, infos = run(env, (GO_TR, GET_TOOL, PASS_1))
    assert infos["state"][0, 10:16].tolist() == bits("100 000")  # nothing in its hand
    assert until_done(env, (GO_TR, GET_TOOL, PASS_1), agent=2) == (3, -11)


def test_pass_fails_if_the_robot_leaves():
    env = started()
    until_done(env, (GET_TOOL, GET_TOOL, SEARCH_0), agent=2)
    env.waited[0, 0] = 8  # robot 0 gives up in the second step of the Pass
    assert until_done(env, (GET_TOOL, GET_TOOL, PASS_0), agent=0)[0] == 2
    assert run(env, (GO_W, GET_TOOL, PASS_0), (GO_W, GET_TOOL, PASS_0))[0] == [-1, -11]
    assert env.staged[0].tolist() == [0, -1]


def test_pass_fails_if_the_robot_is_not_in_get_tool_at_its_end():
    env = started(tool_room=(0.8, 3.1))  # so near to robot 0's table that going there leaves its count as it is
    place(env, 0, GET_TOOL)
    env.waited[0, 0] = 8
    assert until_done(env, (GET_TOOL, GO_TR, PASS_0), agent=0)[0] == 2
    assert run(env, (GO_TR, GO_TR, PASS_0), (GO_TR, GO_TR, PASS_0))[0] == [-1, -11]
    assert env.waited[0, 0] == 1


def test_arm_sees_who_stands_exactly_at_the_table():
    env = started(starts=LAYOUTS["s"]["tables"])
    obs, _ = env.reset()
    assert obs[0, 2].sum() == 0  # nothing is observed at reset
    assert run(env, (GET_TOOL, GO_W, WAIT))[1][2, :5].tolist() == bits("000 10")
    for near in [(0.8, 3.3), (1.1, 3.0)]:  # only one coordinate is the table's
        env.position[0, 0] = near
        assert env._observe(start=False)[0, 2, :5].tolist() == bits("000 00")


def test_a_large_staging_area():
    env = started(staging_capacity=40, copies=20)
    for count in range(1, 4):
        until_done(env, (GO_TR, GO_TR, SEARCH_1), agent=2)
        assert env.staged[0].tolist() == [1] * count + [-1] * (40 - count)
    _, obs, *_ = run(env, (GO_TR, GO_TR, WAIT))
    assert obs[0, 11:].tolist() == [0, 0, 1] + [0] * 37 and obs[2, :3].tolist() == [0, 3, 0]


def test_staging_area_and_copies_limit_the_search():
    env = started()
    for tool in (SEARCH_0, SEARCH_0, SEARCH_1, SEARCH_2):
        assert until_done(env, (GO_TR, GO_TR, tool), agent=2) == (6, -1)
    assert env.staged[0].tolist() == [0, 1] and env.found[0].tolist() == [1, 1, 0]
    wide = started(staging_capacity=3, copies=(2, 1, 1))
    for tool in (SEARCH_0, SEARCH_0, SEARCH_2, SEARCH_1):
        until_done(wide, (GO_TR, GO_TR, tool), agent=2)
    _, obs, *_ = run(wide, (GO_TR, GO_TR, WAIT))
    assert wide.staged[0].tolist() == [0, 0, 2] and obs[2, :3].tolist() == [2, 0, 1]
    assert obs[0].tolist() == bits("0100 0000 000 001")


def test_human_waits_for_its_tool_and_finishes():
    env = started(layout="d", phase_lengths=[(2, 2, 2, 2), (9, 9, 9, 9)])
    idle = (2, 2, 0)
    run(env, idle, idle, idle)
    assert env.phase[0].tolist() == [0, 0] and env.clock[0].tolist() == [-1, 6]
    env.phase[0], env.clock[0], env.has_next_tool[0] = (2, 2), (1, 9), (True, False)
    _, _, terminated, infos = run(env, idle)
    assert env.phase[0].tolist() == [3, 2] and env.clock[0].tolist() == [2, 8] and not terminated
    assert infos["state"][0, 26:].tolist() == [*bits("0001 1 1 0010"), np.float32(8 / 9), 0]
    run(env, idle, idle, idle)
    assert env.clock[0].tolist() == [0, 5]


def test_termination_when_every_human_has_its_last_tool():
    env = started(layout="d")
    env.phase[0], env.has_next_tool[0] = (2, 2), (True, False)
    place(env, 1, 1, carried=(0, 0, 1))
    env.macro_done[0, 1] = False  # on Get-Tool, so that nothing is delivered in the first step
    env.macro_action[0, 1] = 3
    _, _, terminated, infos = run(env, (2, 3, 0))
    assert not terminated and not infos["success"][0]
    env.phase[0, 0], env.clock[0, 0] = 3, 0  # the first human's work is over: that does not matter
    place(env, 1, 1, carried=(0, 0, 1))
    set_free(env, 1)
    rewards, _, terminated, infos = run(env, (2, 1, 0))
    assert rewards == [99] and terminated and infos["success"][0] and infos["macro_done"].all()


def test_success_is_no_alias_of_what_step_returned():
    env = started()
    env.phase[0], env.has_next_tool[0] = 2, True
    terminations = env.step(np.zeros((1, 3), int))[2]
    env.reset(options={"reset_mask": terminations})
    assert terminations[0]


def test_phases_are_seen_only_at_their_workshop():
    env = started(layout="d")
    env.phase[0] = (1, 2)
    place(env, 0, 1)
    place(env, 1, 2)
    env.staged[0] = (0, 2)
    _, obs, *_ = run(env, (1, 2, 0))
    assert obs[0].tolist() == bits("01000 0000 0010 000 00")
    assert obs[1].tolist() == bits("00100 0000 0000 000 01")


def test_custom_layout_with_one_robot_and_one_human():
    env = started(
        workshops=[(4, 1)], tool_room=(2, 1), tables=[(1, 1)], starts=[(1, 2)], arm=(0.5, 1), robot_speed=0.5, copies=1,
        phase_lengths=[(5, 6, 7, 8)], room_size=(5, 2), delivery_reward=10, late_penalty=4, failed_pass_penalty=3,
        step_cost=0.5, search_steps=2, pass_steps=1, arm_wait_steps=2,
    )  # fmt: skip
    assert env.macro_action_names[0] == ["Go-W(0)", "Go-TR", "Get-Tool"]
    assert env.macro_action_names[1][:3] == ["Wait-M", "Pass-to-M(0)", "Search-Tool(0)"] and env.n_actions == [3, 5]
    get_tool, go_w, wait, hand_over, search_0 = 2, 0, 0, 1, 2
    assert run(env, (get_tool, hand_over))[0] == [-3.5]
    assert until_done(env, (get_tool, search_0), agent=1) == (2, -0.5)
    assert until_done(env, (get_tool, wait), agent=1) == (2, -0.5)
    assert until_done(env, (get_tool, hand_over), agent=0) == (1, -0.5) and env.carried[0, 0, 0] == 1
    assert until_done(env, (go_w, wait), agent=0) == (6, 5.5)  # 10 - 4 for the delay - 0.5
    _, _, _, infos = run(env, (go_w, wait))
    assert infos["state"][0, :5].tolist() == [np.float32(4 / 5), np.float32(1 / 2), 0, 0, 0]
    assert infos["state"][0, -2] == np.float32(5 / 6)


def test_keyword_overrides_the_layout():
    fast = started(robot_speed=1.0)
    run(fast, (GO_W, GO_W, WAIT))
    np.testing.assert_allclose(np.linalg.norm(fast.position[0, 0] - (3, 1.5)), 1.0, atol=2e-3)
    assert (fast.tables == LAYOUTS["s"]["tables"]).all()


@pytest.mark.parametrize(("kwargs", "message"), [
    ({"layout": "x"}, "unknown layout 'x'; valid layouts: s d t t1"),
    ({"robot_speed": 0}, "robot_speed must be above 0, got 0"),
    ({"robot_speed": "fast"}, "robot_speed must be a finite number, got 'fast'"),
    ({"delivery_reward": float("nan")}, "delivery_reward must be a finite number, got nan"),
    ({"tables": [(1, 1)]}, "tables and starts need one entry per robot, got 1 and 2"),
    ({"workshops": [(1, 1), (2, 2)]}, "workshops and phase_lengths need one entry per human, got 2 and 1"),
    ({"phase_lengths": [(20, 20)]}, "phase_lengths must be finite numbers of shape (1, 4), got [(20, 20)]"),
    ({"phase_lengths": [(20, 20, 0, 20)]}, "phase_lengths must be finite numbers of shape (1, 4) of at least 1"),
    ({"phase_lengths": [(20, 20, 1.5, 20)]}, "phase_lengths must be whole, got [(20, 20, 1.5, 20)]"),
    ({"phase_lengths": [(20, 20, 20), (20,)]}, "phase_lengths must be finite numbers of shape (2, 4), got"),
    ({"primitive": "yes"}, "primitive must be True or False, got 'yes'"),
    ({"num_envs": 0}, "num_envs must be a finite number of at least 1, got 0"),
    ({"horizon": 2.5}, "horizon must be whole, got 2.5"),
    ({"workshops": []}, "workshops must be a list with at least one entry, got []"),
    ({"tool_room": (1, 2, 3)}, "tool_room must be finite numbers of shape (2,), got (1, 2, 3)"),
    ({"room_size": (9, 0)}, "room_size must be above 0, got (9, 0)"),
    ({"layout": np.array(["s", "d"])}, "unknown layout array(['s', 'd'], dtype='<U1'); valid layouts: s d t t1"),
    ({"copies": 2**63}, "copies must be at most 10**15, got [9223372036854775808"),
    ({"pass_steps": 1e300}, "pass_steps must be at most 10**15, got 1e+300"),
    ({"copies": 0}, "copies must be finite numbers of shape (3,) of at least 1, got [0, 0, 0]"),
    ({"copies": (1, 1)}, "copies must be finite numbers of shape (3,) of at least 1, got (1, 1)"),
    ({"search_steps": 2.5}, "search_steps must be whole, got 2.5"),
    ({"pass_steps": 0}, "pass_steps must be a finite number of at least 1, got 0"),
    ({"tool_wait_steps": "10"}, "tool_wait_steps must be a finite number of at least 1, got '10'"),
    ({"staging_capacity": 0}, "staging_capacity must be a finite number of at least 1, got 0"),
    ({"primitive": True, "search_steps": 6}, "search_steps must be 1 with primitive=True, got 6"),
    ({"primitive": True, "pass_steps": 4}, "pass_steps must be 1 with primitive=True, got 4"),
    ({"primitive": True, "arm_wait_steps": 2}, "arm_wait_steps must be 1 with primitive=True, got 2"),
])  # fmt: skip
def test_bad_arguments(kwargs, message):
    with pytest.raises(ValueError) as error:
        Warehouse(**kwargs)
    assert str(error.value).startswith(message) and "\n" not in str(error.value)


def test_primitive_asks_everybody_every_step():
    env = started(primitive=True)
    for _ in range(8):
        *_, infos = run(env, (GET_TOOL, GO_W, SEARCH_0))
        assert infos["macro_done"].all()
    run(env, (GO_W, GO_W, WAIT))  # robot 0 turns round at the table
    np.testing.assert_allclose(env.position[0, 0], (1.4, 3))


@pytest.mark.parametrize(("actions", "found"), [
    ([SEARCH_0], [1, 0, 0]),
    ([SEARCH_0, WAIT, SEARCH_1], [1, 1, 0]),
    ([SEARCH_0, SEARCH_0], [2, 0, 0]),
    ([SEARCH_0, SEARCH_2, SEARCH_1], [1, 0, 1]),  # there is room for two
])  # fmt: skip
def test_primitive_search_finds_its_tool_in_one_step(actions, found):
    env = started(primitive=True, copies=2)
    rewards, *_ = run(env, *[(GO_TR, GO_TR, action) for action in actions])
    assert env.found[0].tolist() == found and rewards == [-1] * len(actions)
    assert (env.staged[0] >= 0).sum() == sum(found)


def test_primitive_copies_limit_the_search():
    env = started(primitive=True)
    run(env, *[(GO_TR, GO_TR, SEARCH_0)] * 3)
    assert env.found[0].tolist() == [1, 0, 0] and env.staged[0].tolist() == [0, -1]


def test_primitive_pass_hands_over_in_one_step():
    env = started(primitive=True)
    run(env, (GET_TOOL, GET_TOOL, SEARCH_2), *[(GET_TOOL, GET_TOOL, WAIT)] * 3)
    assert run(env, (GET_TOOL, GET_TOOL, PASS_0))[0] == [-11]  # it arrives in this step and waits from the next one on
    rewards, _, _, infos = run(env, (GET_TOOL, GET_TOOL, PASS_0))
    assert rewards == [-1] and env.carried[0].tolist() == [[0, 0, 1], [0, 0, 0]] and env.staged[0].tolist() == [-1, -1]
    assert infos["state"][0, 10:26].tolist() == [0] * 8 + [1] + [0] * 7  # tool 2 is found, and nothing is running
    assert run(env, (GO_W, GET_TOOL, PASS_0))[0] == [-11]  # robot 0 is leaving


def test_primitive_durations_are_one_step():
    env = Warehouse(primitive=True, search_steps=1, pass_steps=1, arm_wait_steps=1)
    assert env.task_steps.tolist() == Warehouse(primitive=True).task_steps.tolist() == [1] * 6
    assert Warehouse().task_steps.tolist() == [1, 4, 4, 6, 6, 6]


def test_primitive_random_play_delivers_now_and_then():
    """About 2.3% of random episodes see a positive reward, so there is something to learn from."""
    env, rng = started(1500, primitive=True), np.random.default_rng(0)
    delivers, live = np.zeros(1500, bool), np.ones(1500, bool)
    while live.any():
        _, rewards, terminations, truncations, _ = env.step(rng.integers(0, env.n_actions, (1500, 3)))
        delivers |= live & (rewards > 0)
        over = terminations | truncations
        live &= ~over
        env.reset(options={"reset_mask": over})
    assert 0.01 < delivers.mean() < 0.045


def test_primitive_delivery_needs_the_robot_at_the_workshop():
    env = started(primitive=True)
    place(env, 0, GO_W)
    run(env, (GO_TR, GO_TR, WAIT), (GO_TR, GO_TR, WAIT))
    env.carried[0, 0, 0] = 1
    assert env.location[0, 0] == GO_W  # the last waypoint reached is still the workshop
    assert run(env, *[(GO_W, GO_TR, WAIT)] * 2)[0] == [-1, 99]


@pytest.mark.parametrize("primitive", [False, True])
def test_saved_state_continues_the_same_episode(primitive):
    env, rng = started(32, "t1", primitive=primitive), np.random.default_rng(3)
    actions = rng.integers(0, env.n_actions, (80, 32, 4))
    actions[20:44, 16:] = (4, 4, 4, 1)  # step 40 is in the middle of a Pass to a waiting robot
    actions[38:44, :16, 3] = 6  # or of a Search
    for action in actions[:40]:
        env.step(action)
    saved = env.save_state()
    rest = [env.step(action) for action in actions[40:]]
    other = started(32, "t1", primitive=primitive)
    other.load_state(saved)
    for action, (obs, rewards, _, _, infos) in zip(actions[40:], rest, strict=True):
        again = other.step(action)
        assert (again[0] == obs).all() and (again[1] == rewards).all() and (again[4]["state"] == infos["state"]).all()
