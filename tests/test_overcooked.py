"""Overcooked in hand-made scenarios: the rules one by one.

The recorded episodes are compared in test_traces.py.
"""

import numpy as np
import pytest

from envs.overcooked import (
    BOARD,
    CHOP,
    COOK,
    COUNTER,
    DELIVER,
    DELIVERY,
    GET_FOOD,
    GET_PLATE,
    GO_TO_BOARD,
    GO_TO_COUNTER,
    LAYOUTS,
    LETTUCE,
    NOTHING,
    ONION,
    PLATE,
    STAY,
    TOMATO,
    WAIT,
    Overcooked,
    first_move,
)

GET_TOMATO, GET_LETTUCE, GET_ONION = range(GET_FOOD, GET_FOOD + 3)
COOK_0, COOK_1, COOK_2 = range(COOK, COOK + 3)


def at(row, column):
    return 7 * row + column


def started(layout="a", places=(), strikes=(0, 0, 0)):
    """A batch of one. places: {thing: (row, column)}, where things are that are not at their places of the start.

    All cooks remember everything as it is.
    """
    env = Overcooked(1, layout)
    env.reset(seed=0)
    for thing, place in dict(places).items():
        env.cell[0, thing] = at(*place)
    env.memory[:] = env.cell[:, None]
    env.strikes[:] = strikes
    return env


def run(env, *actions):
    """Steps a batch of one; the rewards, and whose macro-action ended in the last step."""
    rewards = []
    for action in actions:
        rewards.append(env.step(np.array([action]))[1][0])
    return rewards, env.macro_done[0].tolist()


def cell_of(env, *things):
    return [divmod(int(env.cell[0, thing]), 7) for thing in things]


def held(env):
    return env._held()[0].tolist()


# ---- what is there --------------------------------------------------------------------------------------------------
@pytest.mark.parametrize("layout", LAYOUTS)
def test_the_start(layout):
    env = Overcooked(2, layout)
    obs, infos = env.reset()
    assert env.n_actions == [14 if layout == "a" else 15] * 3 and env.obs_sizes == [32] * 3
    assert [divmod(int(cell), 7) for cell in env.cell[1]] == [
        *[(0, 5), (1, 6), (2, 6), (5, 6), (6, 5), (1, 0), (2, 0), (3, 0)],
        *[(1, 2), (1, 4), (5, 2)],
    ]
    middle = {"a": [], "b": [(3, 3), (2, 3), (4, 3), (1, 3), (5, 3)], "c": [(3, 3), (2, 3), (4, 3), (1, 3)]}
    assert [divmod(int(cell), 7) for cell in env.middle_counters] == middle[layout]
    names = env.macro_action_names[0]
    assert (names[STAY], names[DELIVER], names[CHOP], names[-4:]) == (
        *("Stay", "Deliver", "Chop"),
        ["Right", "Down", "Left", "Up"],
    )
    assert layout == "a" or names[GO_TO_COUNTER] == "Go-to-Counter"
    expected = np.zeros((3, 32))
    expected[:, 31] = 1
    expected[0, 13:23] = np.array([1, 0, 2, 0, 3, 0, 1, 2, 1, 4]) / 7  # boards, delivery counter, cooks 0 and 1
    expected[1, :2] = np.array([0, 5]) / 7  # the tomato
    expected[1, [3, 4, 6, 7]] = np.array([1, 6, 2, 6]) / 7  # lettuce and onion
    expected[1, 19:23] = np.array([1, 2, 1, 4]) / 7  # cooks 0 and 1
    expected[2, 17:19] = np.array([3, 0]) / 7  # the delivery counter
    expected[2, 23:25] = np.array([5, 2]) / 7  # itself
    np.testing.assert_allclose(obs[0], expected, rtol=1e-6)
    assert infos["state"].shape == (2, env.state_size)


def test_the_state_by_hand():
    places = {COOK_0: (2, 2), TOMATO: (2, 2), PLATE: (2, 2), LETTUCE: (2, 0), COOK_1: (5, 5)}
    env = started("b", places, strikes=(3, 1, 0))
    run(env, (CHOP, GET_PLATE + 1, STAY))
    env.chop_moves[0, 2] = 2
    state = env._state()[0]
    cells = np.array([2, 2, 2, 0, 2, 6, 2, 2, 5, 5, 2, 2, 5, 5, 5, 2]) / 7  # cook 1 has taken plate 1
    np.testing.assert_allclose(state[:16], cells, rtol=1e-6)
    np.testing.assert_allclose(state[16:19], [1, 1 / 3, 0], rtol=1e-6)
    ones = np.flatnonzero(state[19:50]).tolist()
    assert ones == [3, 5 + 4, 15 + 5 + 1, 25], "plate 0, plate 1; lettuce on board 1; tomato on plate 0"
    np.testing.assert_allclose(state[50:53], [0, 0, 2 / 3], rtol=1e-6)
    assert not state[53:].any()
    run(env, (GO_TO_BOARD, STAY, STAY))
    assert np.flatnonzero(env._state()[0, 53:]).tolist() == [GO_TO_BOARD]


# ---- single rules ---------------------------------------------------------------------------------------------------
def test_a_vegetable_is_fetched_and_chopped_in_three_strikes():
    env = started()
    assert run(env, (STAY, GET_TOMATO, STAY)) == ([-0.1], [True, False, True])
    assert run(env, (STAY, STAY, STAY)) == ([-0.1], [True, True, True])
    assert held(env) == [NOTHING, TOMATO, NOTHING] and cell_of(env, TOMATO, COOK_1) == [(1, 5), (1, 5)]
    run(env, *[(STAY, GO_TO_BOARD, STAY)] * 2)
    assert cell_of(env, TOMATO, COOK_1) == [(1, 3), (1, 3)]
    env = started(places={COOK_0: (1, 1), TOMATO: (1, 1)})
    assert run(env, (GO_TO_BOARD, STAY, STAY))[1][0] and cell_of(env, TOMATO) == [(1, 0)]
    rewards, done = run(env, *[(CHOP, STAY, STAY)] * 2)
    assert rewards == [-0.1, -0.1] and not done[0] and env.strikes[0].tolist() == [2, 0, 0]
    rewards, done = run(env, (CHOP, STAY, STAY))
    np.testing.assert_allclose(rewards, [9.9])
    assert done[0] and env.strikes[0].tolist() == [3, 0, 0] and held(env) == [NOTHING] * 3
    assert run(env, (CHOP, STAY, STAY)) == ([-0.1], [True] * 3), "it is chopped already"
    run(env, (GET_TOMATO, STAY, STAY))
    assert held(env)[0] == TOMATO


def test_the_count_of_chop_outlives_an_interrupted_one():
    env = started(places={COOK_0: (1, 1), TOMATO: (1, 0)}, strikes=(1, 0, 0))
    rewards, done = run(env, (CHOP, STAY, STAY), (CHOP, STAY, STAY))
    np.testing.assert_allclose(rewards, [-0.1, 9.9])
    assert not done[0] and env.chop_moves[0, 0] == 2
    assert run(env, (CHOP, STAY, STAY))[1][0] and env.chop_moves[0, 0] == 2, "nothing to chop: it ends"
    env.cell[0, :2] = at(4, 0), at(1, 0)
    assert run(env, (CHOP, STAY, STAY))[1][0], "the third move ends it after a single strike"
    assert env.strikes[0].tolist() == [3, 1, 0] and env.chop_moves[0, 0] == 0


def test_a_chop_with_a_full_hand_is_counted_and_does_nothing():
    env = started(places={COOK_0: (1, 1), TOMATO: (1, 0), PLATE: (1, 1)})
    _, done = run(env, *[(CHOP, STAY, STAY)] * 3)
    assert done[0] and env.strikes.sum() == 0 and held(env)[0] == PLATE


def test_a_chopped_vegetable_goes_on_a_plate_and_the_plate_into_the_hand():
    env = started(places={COOK_1: (4, 5), TOMATO: (4, 5)}, strikes=(3, 0, 0))
    assert not run(env, *[(STAY, GET_PLATE, STAY)] * 2)[1][1]
    assert cell_of(env, COOK_1, TOMATO, PLATE) == [(5, 5), (5, 6), (5, 6)] and held(env)[1] == NOTHING
    assert run(env, (STAY, GET_PLATE, STAY))[1][1]
    assert cell_of(env, COOK_1, TOMATO, PLATE) == [(5, 5)] * 3 and held(env)[1] == PLATE


def test_a_plate_in_the_hand_takes_what_is_chopped_on_a_board_or_a_counter():
    env = started("c", {COOK_0: (1, 1), PLATE: (1, 1), TOMATO: (1, 0), ONION: (2, 3)}, strikes=(3, 0, 3))
    assert run(env, (GO_TO_BOARD, STAY, STAY))[1][0]
    assert cell_of(env, TOMATO, PLATE) == [(1, 1), (1, 1)] and held(env)[0] == PLATE
    run(env, *[(GET_ONION, STAY, STAY)] * 3)
    assert cell_of(env, TOMATO, ONION, PLATE) == [(2, 2)] * 3
    run(env, (env.first_single_step, STAY, STAY), (STAY, STAY, STAY))
    assert cell_of(env, COOK_0, TOMATO, ONION, PLATE) == [(2, 2)] * 4, "there is no floor on the right"


def test_a_vegetable_goes_on_a_plate_on_a_board_and_the_cook_has_both():
    places = {COOK_0: (1, 1), TOMATO: (1, 1), PLATE: (1, 0)}
    for strikes, place in ((3, (1, 1)), (2, (1, 0))):
        env = started(places=places, strikes=(strikes, 0, 0))
        assert run(env, (GO_TO_BOARD, STAY, STAY))[1][0]
        assert cell_of(env, PLATE, TOMATO) == [place, (1, 1)], "only if it is chopped"


def test_an_unchopped_vegetable_is_not_put_where_another_cook_has_just_taken_the_plate():
    env = started("c", {COOK_0: (3, 2), COOK_1: (3, 4), TOMATO: (3, 4), PLATE: (3, 3)})
    run(env, (GET_PLATE, GET_PLATE, STAY))
    assert held(env) == [PLATE, TOMATO, NOTHING]


def test_an_unchopped_vegetable_is_not_plated_and_not_exchanged():
    env = started(places={COOK_1: (5, 5), TOMATO: (5, 5)}, strikes=(2, 0, 0))
    assert run(env, (STAY, GET_PLATE, STAY))[1][1] and held(env)[1] == TOMATO
    env = started(places={COOK_0: (1, 1), TOMATO: (1, 1), LETTUCE: (1, 0)}, strikes=(3, 3, 0))
    assert run(env, (GO_TO_BOARD, STAY, STAY))[1][0] and held(env)[0] == TOMATO
    env = started(places={COOK_0: (1, 1), PLATE + 1: (1, 1), PLATE: (1, 0)})
    assert run(env, (GO_TO_BOARD, STAY, STAY))[1][0] and held(env)[0] == PLATE + 1


def test_the_right_dish_ends_the_episode():
    places = {COOK_0: (3, 1), TOMATO: (3, 1), LETTUCE: (3, 1), ONION: (3, 1), PLATE + 1: (3, 1)}
    env = started(places=places, strikes=(3, 3, 3))
    _, rewards, terminations, _, infos = env.step(np.array([[DELIVER, STAY, STAY]]))
    np.testing.assert_allclose(rewards, [199.9])
    assert terminations[0] and infos["success"][0] and infos["macro_done"].all()


@pytest.mark.parametrize("things", [[TOMATO], [PLATE], [TOMATO, ONION, PLATE]])
def test_after_a_wrong_delivery_things_return_unchopped_and_chopping_pays_again(things):
    places = {thing: (3, 1) for thing in things}
    env = started(places={COOK_0: (3, 1), **places, LETTUCE: (2, 0)}, strikes=(3, 3, 3))
    _, rewards, terminations, _, infos = env.step(np.array([[DELIVER, STAY, STAY]]))
    np.testing.assert_allclose(rewards, [-5.1])
    assert not terminations[0] and not infos["success"][0] and infos["macro_done"][0, 0]
    assert env.cell[0, things].tolist() == env.starts[things].tolist() and held(env)[0] == NOTHING
    expected = [0 if thing in things else 3 for thing in range(3)]
    assert env.strikes[0].tolist() == expected and cell_of(env, LETTUCE) == [(2, 0)]
    env.cell[0, TOMATO], env.strikes[0, TOMATO] = at(1, 0), 2
    env.cell[0, COOK_0] = at(1, 1)
    np.testing.assert_allclose(run(env, (CHOP, STAY, STAY))[0], [9.9])


def test_deliver_and_go_to_board_end_beside_their_target_if_the_hand_is_empty():
    env = started(places={COOK_0: (3, 2), COOK_2: (1, 1)})
    assert run(env, (DELIVER, STAY, GO_TO_BOARD)) == ([-0.1], [True] * 3)
    assert cell_of(env, COOK_0, COOK_2) == [(3, 1), (1, 1)] and env.episode_return[0] == -0.1
    env = started(places={COOK_0: (3, 2), TOMATO: (3, 2)})
    assert not run(env, (DELIVER, STAY, STAY))[1][0]


# ---- cooks meet -----------------------------------------------------------------------------------------------------
def test_a_cook_waits_for_one_that_moves_on():
    row = {COOK_0: (1, 2), COOK_1: (1, 3), COOK_2: (1, 4)}
    env = started(places=row)
    run(env, [GET_LETTUCE] * 3)
    assert cell_of(env, COOK_0, COOK_1, COOK_2) == [(1, 3), (1, 4), (1, 5)]
    env = started(places=row)
    run(env, (GET_LETTUCE, GET_LETTUCE, STAY))
    assert cell_of(env, COOK_0, COOK_1, COOK_2) == [(1, 2), (1, 3), (1, 4)], "all wait for one that does not move"
    env = started(places={COOK_0: (1, 4), COOK_1: (1, 2), COOK_2: (1, 3)})
    run(env, (STAY, GET_LETTUCE, GET_LETTUCE))
    assert cell_of(env, COOK_0, COOK_1, COOK_2) == [(1, 4), (1, 2), (1, 3)], "it has moved, which was to stay"


def test_the_first_of_two_gets_the_free_cell():
    env = started(places={COOK_0: (2, 4), COOK_1: (1, 3), COOK_2: (5, 5)})
    run(env, (env.first_single_step + 3, env.first_single_step, STAY))  # up, right
    assert cell_of(env, COOK_0, COOK_1) == [(1, 4), (1, 3)]


def test_two_cooks_in_each_others_way_swap_with_what_they_hold():
    for first, second in ((COOK_0, COOK_1), (COOK_1, COOK_0), (COOK_2, COOK_0)):
        env = started(places={COOK_1: (5, 5), first: (1, 2), second: (1, 3), TOMATO: (1, 3), PLATE: (1, 2)})
        actions = [STAY] * 3
        actions[first - COOK], actions[second - COOK] = GET_LETTUCE, GO_TO_BOARD
        run(env, actions)
        assert cell_of(env, first, PLATE, second, TOMATO) == [(1, 3), (1, 3), (1, 2), (1, 2)]


def test_a_single_step_needs_floor():
    right = started().first_single_step
    env = started(places={COOK_0: (1, 2), COOK_1: (1, 3)})
    assert run(env, (right, right, STAY))[1] == [True] * 3
    assert cell_of(env, COOK_0, COOK_1) == [(1, 2), (1, 4)], "a cook is believed there"
    env.memory[0, 0, TOMATO] = at(2, 2)  # it believes a thing to be on the floor
    run(env, (right + 1, right + 1, STAY))
    assert cell_of(env, COOK_0, COOK_1) == [(1, 2), (2, 4)]


def test_a_cook_makes_room_at_the_boards():
    loaded = {COOK_0: (1, 1), PLATE: (1, 1), COOK_1: (2, 1)}
    env = started(places=loaded)
    assert not run(env, (DELIVER, STAY, STAY))[1][0]
    assert cell_of(env, COOK_0) == [(1, 2)]
    env = started(places={COOK_0: (3, 1), TOMATO: (3, 1), COOK_1: (2, 1)})
    assert not run(env, (GO_TO_BOARD, STAY, STAY))[1][0]
    assert cell_of(env, COOK_0) == [(3, 2)]
    env = started(places={COOK_0: (3, 1), TOMATO: (3, 1), COOK_1: (2, 2)})
    run(env, (GO_TO_BOARD, STAY, STAY))
    assert cell_of(env, COOK_0) == [(2, 1)]


# ---- memory ---------------------------------------------------------------------------------------------------------
def test_a_stale_memory_ends_get_after_a_step():
    env = started()
    env.cell[0, TOMATO] = at(1, 0)  # cook 2, at (5, 2), does not see it
    assert env.memory[0, 2, TOMATO] == at(0, 5)
    assert run(env, (STAY, STAY, GET_TOMATO))[1][2]
    assert cell_of(env, COOK_2) != [(5, 2)] and env.memory[0, 2, TOMATO] == at(0, 5)


def test_a_thing_that_is_missed_is_believed_at_its_start():
    env = started("c", {TOMATO: (3, 3), COOK_2: (5, 1)})
    assert (env.memory[0, :, TOMATO] == at(3, 3)).all()
    env.cell[0, TOMATO] = at(1, 6)
    run(env, [STAY] * 3)
    assert env.memory[0, :, TOMATO].tolist() == [at(0, 5), at(1, 6), at(0, 5)], "cook 1 sees it, the others miss it"
    env.cell[0, [COOK_1, TOMATO]] = at(1, 4), at(2, 0)
    run(env, (STAY, STAY, STAY))
    assert env.memory[0, :, TOMATO].tolist() == [at(2, 0), at(0, 5), at(0, 5)]
    run(env, (STAY, STAY, STAY))
    assert env.memory[0, 1, TOMATO] == at(0, 5), "it goes on believing, although it sees the empty place"


def test_the_last_move_needs_the_thing_to_be_there():
    env = started(places={COOK_1: (1, 5)})
    env.cell[0, TOMATO] = at(5, 0)  # the cook looks only after the move
    assert run(env, (STAY, GET_TOMATO, STAY))[1][1] and held(env)[1] == NOTHING
    env = started(places={COOK_1: (1, 5), PLATE: (1, 5)}, strikes=(3, 0, 0))
    assert run(env, (STAY, GET_TOMATO, STAY))[1][1]
    assert cell_of(env, TOMATO, PLATE) == [(1, 5)] * 2


def test_get_ends_at_once_if_the_thing_is_in_sight_and_out_of_reach():
    env = started(places={COOK_0: (2, 2), COOK_1: (2, 4), LETTUCE: (2, 4), ONION: (2, 0), PLATE: (2, 0)})
    before = cell_of(env, COOK_0)
    for action, why in ((GET_LETTUCE, "in a hand"), (GET_ONION, "on a plate")):
        assert run(env, (action, STAY, STAY)) == ([-0.1], [True] * 3), why
        assert cell_of(env, COOK_0) == before
    env = started(places={COOK_0: (1, 1), LETTUCE: (1, 1)})
    assert run(env, (GET_LETTUCE, STAY, STAY))[1][0] and held(env)[0] == LETTUCE, "in its own hand"
    env = started("b")
    assert run(env, (GET_TOMATO, STAY, STAY))[1][0] and cell_of(env, COOK_0) == [(1, 2)], "no way"


def test_get_ends_beside_a_board_with_an_unchopped_vegetable():
    env = started(places={COOK_0: (1, 2), TOMATO: (1, 0)}, strikes=(2, 0, 0))
    assert run(env, (GET_TOMATO, STAY, STAY))[1][0] and cell_of(env, COOK_0) == [(1, 1)]
    assert run(env, (GET_TOMATO, STAY, STAY))[1][0] and env.strikes[0, 0] == 2, "it does not strike"
    env = started(places={COOK_0: (1, 2), TOMATO: (1, 0)}, strikes=(3, 0, 0))
    assert not run(env, (GET_TOMATO, STAY, STAY))[1][0]
    assert run(env, (GET_TOMATO, STAY, STAY))[1][0] and held(env)[0] == TOMATO


# ---- counters and ways ----------------------------------------------------------------------------------------------
def test_go_to_counter_takes_the_free_one_nearest_to_the_middle():
    env = started("b", {COOK_1: (3, 4), TOMATO: (3, 4)})
    assert run(env, (STAY, GO_TO_COUNTER, STAY))[1][1]
    assert cell_of(env, TOMATO) == [(3, 3)] and held(env)[1] == NOTHING
    env.cell[0, LETTUCE] = env.cell[0, COOK_1]
    run(env, *[(STAY, GO_TO_COUNTER, STAY)] * 2)
    assert cell_of(env, LETTUCE, COOK_1) == [(2, 3), (2, 4)]
    full = {TOMATO: (1, 3), LETTUCE: (2, 3), ONION: (3, 3), PLATE: (4, 3), PLATE + 1: (5, 3), COOK_1: (3, 4)}
    assert run(started("b", full), (STAY, GO_TO_COUNTER, STAY)) == ([-0.1], [True] * 3)


def test_go_to_counter_goes_on_where_there_is_no_way():
    env = started("b", {COOK_1: (3, 4), TOMATO: (3, 3)})
    env.memory[0, 1, [LETTUCE, ONION, PLATE]] = at(2, 4), at(4, 4), at(3, 5)
    env.cell[0, [LETTUCE, ONION, PLATE]] = env.memory[0, 1, [LETTUCE, ONION, PLATE]]
    assert not run(env, (STAY, GO_TO_COUNTER, STAY))[1][1] and cell_of(env, COOK_1) == [(3, 4)]


def test_two_cooks_hand_over_across_a_counter():
    env = started("b", {COOK_0: (3, 2), COOK_1: (3, 4), PLATE: (3, 4), TOMATO: (3, 3)}, strikes=(3, 0, 0))
    run(env, (STAY, GET_TOMATO, STAY))
    assert cell_of(env, TOMATO) == [(3, 4)]
    run(env, (STAY, GO_TO_COUNTER, STAY), (GET_PLATE, STAY, STAY))
    assert cell_of(env, TOMATO, PLATE, COOK_0) == [(3, 2)] * 3


def test_the_first_move_of_a_way():
    env = started("c")
    kinds = env._believed_kitchen()[0, 0].astype(np.uint8)
    moves = [first_move(at(*start), at(*end), kinds.tobytes()) for start, end in (
        ((3, 1), (3, 0)),  # beside the target: into it
        ((1, 2), (1, 0)),
        ((1, 2), (1, 4)),  # round the counters, by row 5
        ((3, 3), (3, 3)),  # already there
    )]  # fmt: skip
    assert moves == [2, 2, 1, WAIT]
    kinds[[at(1, 1), at(2, 2)]] = COUNTER
    assert first_move(at(1, 2), at(3, 2), kinds.tobytes()) == WAIT, "shut in"


# ---- arguments ------------------------------------------------------------------------------------------------------
def test_rewards_are_arguments():
    keywords = {"chop_reward": 3, "delivery_reward": 50, "wrong_delivery": -2, "step_cost": -1, "horizon": 2}
    env = Overcooked(2, "c", **keywords)
    env.reset(seed=0)
    env.cell[:, :PLATE], env.strikes[:] = env.cell[:, PLATE, None], 3
    env.cell[:, COOK_0], env.cell[:, : PLATE + 1] = at(3, 1), at(3, 1)
    env.cell[1, ONION], env.strikes[1, ONION], env.cell[:, COOK_1] = at(1, 0), 2, at(1, 1)
    _, rewards, terminations, _, _ = env.step(np.array([[DELIVER, CHOP, STAY]] * 2))
    assert rewards.tolist() == [49, 0] and terminations.tolist() == [True, False]
    env.reset(options={"reset_mask": terminations})
    assert env.step(np.zeros((2, 3), int))[3].tolist() == [False, True]


@pytest.mark.parametrize(("keyword", "value", "message"), [
    ("layout", "d", "unknown layout 'd'; valid layouts: a b c"),
    ("layout", ["a"], "unknown layout"),
    ("horizon", 0, "horizon must be a finite number of at least 1, got 0"),
    ("chop_reward", "10", "chop_reward must be a finite number, got '10'"),
    ("delivery_reward", None, "delivery_reward must be a finite number, got None"),
    ("wrong_delivery", float("nan"), "wrong_delivery must be a finite number, got nan"),
    ("step_cost", [1], "step_cost must be a finite number"),
])  # fmt: skip
def test_a_bad_argument_is_one_line(keyword, value, message):
    with pytest.raises(ValueError, match=message) as error:
        Overcooked(**{keyword: value})
    assert "\n" not in str(error.value)


@pytest.mark.slow
def test_random_play_keeps_things_apart():
    """A thing in a cook's cell is in its hand, one in a plate's cell on the plate, and no other two share a cell."""
    rng = np.random.default_rng(0)
    for layout in LAYOUTS:
        env = Overcooked(64, layout)
        env.reset(seed=0)
        for _ in range(150):
            _, _, terminations, _, _ = env.step(rng.integers(env.n_actions, size=(64, 3)))
            cells = env.cell[:, :BOARD]
            same = cells[:, :, None] == cells[:, None]
            assert not np.triu(same[:, :PLATE, :PLATE], 1).any(where=~same[:, :PLATE, PLATE:].any(2)[:, :, None])
            assert not same[:, PLATE, PLATE + 1].any()
            assert (env.strikes[same[:, :PLATE, PLATE:].any(2)] == 3).all(), "only chopped ones are on plates"
            cooks = env.cell[:, COOK:]
            assert env.is_floor[cooks].all() and (np.diff(np.sort(cooks, axis=1), axis=1) > 0).all()
            on_floor = env.is_floor[cells]
            assert (cells[:, :, None] == cooks[:, None]).any(2)[on_floor].all()
            if terminations.any():
                env.reset(options={"reset_mask": terminations})
    assert env.cell[0, DELIVERY] == at(3, 0)
