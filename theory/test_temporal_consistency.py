"""Section 3.2's temporal consistency, by exact enumeration: which mixer input determines the joint value?"""

from fractions import Fraction
from functools import cache
from itertools import product

import pytest

from theory.process import (
    CARRIER,
    INPUTS,
    KEEPER,
    PAY,
    SHOWS,
    STEPS,
    TRIPS,
    VIEWS,
    Delivery,
    Interval,
    Row,
    is_function_of_row,
    learned,
    mixer_state,
    target_error,
    uniform,
    value_error,
    view,
    witness,
)

HALF = Fraction(1, 2)
delivery = cache(Delivery)

# Whether an input determines the value, by what the mixer sees besides: m only, and who chose, and the histories.
NEVER = (False, False, False)
WITH_HISTORIES = (False, False, True)
WITH_CHOSEN = (False, True, True)
ALWAYS = (True, True, True)
RANDOM = {
    "joint": (ALWAYS, ALWAYS, NEVER),  # in the order of SHOWS: position, clock, trips
    "single_chose": (WITH_CHOSEN, WITH_HISTORIES, NEVER),
    "single_ends": (NEVER, NEVER, NEVER),
    "real": (NEVER, NEVER, NEVER),
    "real-both": (NEVER, NEVER, NEVER),
    "decision": (WITH_CHOSEN, WITH_HISTORIES, NEVER),
    "decision+elapsed": (ALWAYS, ALWAYS, ALWAYS),
}
DETERMINISTIC = {  # gamma = 1/2
    "joint": (ALWAYS, ALWAYS, WITH_HISTORIES),
    "single_chose": (WITH_CHOSEN, WITH_HISTORIES, WITH_HISTORIES),
    "single_ends": (WITH_HISTORIES, WITH_HISTORIES, WITH_HISTORIES),
    "real": (WITH_HISTORIES, WITH_HISTORIES, WITH_HISTORIES),
    "real-both": (WITH_HISTORIES, WITH_HISTORIES, WITH_HISTORIES),
    "decision": (WITH_CHOSEN, WITH_HISTORIES, WITH_HISTORIES),
    "decision+elapsed": (ALWAYS, ALWAYS, ALWAYS),
}


def determines(process, state_name):
    return tuple(witness(process, state_name, view_name) is None for view_name in VIEWS)


every_input = pytest.mark.parametrize("name", INPUTS)
every_state = pytest.mark.parametrize("shows", SHOWS)
of_uniform_and_best_play = pytest.mark.parametrize("optimal", [False, True])


# ---- the process itself ---------------------------------------------------------------------------------------------
@pytest.mark.parametrize("random_tidy", [True, False])
@pytest.mark.parametrize("gamma", [1, HALF])
@of_uniform_and_best_play
def test_values_against_a_recursion_over_single_steps(random_tidy, gamma, optimal):
    def by_steps(trips, walked, ran, trip, keeping):
        """Expected return just before a step, the keeper's macro-action having run for `ran` steps."""
        arrives = walked + 1 == STEPS[trip]
        if keeping == "open" or ran == 1:
            ends_with = Fraction(1)  # probability
        else:
            ends_with = HALF if random_tidy else Fraction(0)
        total = Fraction(PAY[trip] if arrives and keeping == "open" else 0)
        if arrives and trips + 1 == TRIPS:
            return total
        for ends, chance in ((True, ends_with), (False, 1 - ends_with)):
            if chance:
                then = (trips + 1, 0) if arrives else (trips, walked + 1)
                new_trips = STEPS if arrives else [trip]
                new_keepings = ("open", "tidy") if ends else [keeping]
                values = []
                for new_trip, new_keeping in product(new_trips, new_keepings):
                    values.append(by_steps(*then, 0 if ends else ran + 1, new_trip, new_keeping))
                best_or_mean = max(values) if optimal else sum(values) / len(values)
                total += chance * gamma * best_or_mean
        return total

    process = delivery("trips", random_tidy, gamma, optimal=optimal)
    assert len(process.rows) == (404 if random_tidy else 96)
    for row in process.rows:
        assert process.value(row) == by_steps(row.trips, row.walked, row.elapsed[KEEPER], *row.macros)
        assert sum(i.probability for i in process.intervals(row)) == 1


def test_values_by_hand():
    process = delivery("trips")
    last_trip = {}
    for row in process.rows:
        if row.trips == 1:
            last_trip[row.macros, row.walked, row.chosen] = process.value(row)
    assert last_trip[("cart", "open"), 2, (False, True)] == 2
    assert last_trip[("cart", "open"), 1, (False, True)] == 1  # opens again with probability 1/2
    assert last_trip[("cart", "tidy"), 1, (False, True)] == HALF  # 1/2 done in time, 1/2 opens, pays 2
    assert last_trip[("hand", "tidy"), 0, (True, True)] == Fraction(1, 4)


def test_every_row_is_a_decision_and_macro_states_date_from_the_last_choice():
    for row in delivery("clock").rows:
        assert any(row.chosen)
        assert row.state == (row.trips, row.time)
        for i in (CARRIER, KEEPER):
            assert row.chosen[i] == (row.elapsed[i] == 0)
            assert row.macro_states[i][1] == row.time - row.elapsed[i]


class TwoSituations:
    """As much of a process as errors need: two rows that look alike but for time, and are visited 3 times and once.

    The first is worth 2. The second ends in one of two ways, with returns 4 (probability 1/4) and 0, so it is worth 1.
    Each of the first leads to the second.
    """

    def __init__(self):
        macros = ("cart", "open")
        chosen = (False, True)
        looks = (("cart",), ("open",)), (1,), ((0,), (1,))  # histories, state, macro_states
        often, seldom = (Row(1, 1, time, macros, chosen, (1, 0), *looks) for time in (3, 4))
        self.rows = {often: Fraction(3), seldom: Fraction(1)}
        self.values = {often: Fraction(2), seldom: Fraction(1)}
        ended = (False, True)
        one = Fraction(1)
        self.ways = {
            often: [Interval(one, Fraction(2), one, (1,), ended, {seldom: one})],
            seldom: [
                Interval(Fraction(1, 4), Fraction(4), one, (1,), ended, {}),
                Interval(Fraction(3, 4), Fraction(0), one, (1,), ended, {}),
            ],
        }

    def intervals(self, row):
        return self.ways[row]

    def value(self, row):
        return self.values[row]

    def outcome(self, interval):
        return interval.reward


def test_errors_by_hand_are_weighted_by_visits():
    """Learned is (3 x 2 + 1 x 1) / 4 = 7/4; the error (3 x 1/16 + 1 x 9/16) / 4 = 3/16.

    Without weights these were 3/2 and 1/4. The target asks for the second row alone, worth 1: an error of 9/16.
    """
    process = TwoSituations()
    fit = learned(process, "decision", "histories")
    assert list(fit.values()) == [Fraction(7, 4)]
    assert value_error(process, "decision", "histories") == Fraction(3, 16)
    assert target_error(process, "decision", "histories") == (0, Fraction(9, 16))


# ---- which input determines the joint value -------------------------------------------------------------------------
@every_input
@every_state
@pytest.mark.parametrize("gamma", [1, HALF])
@of_uniform_and_best_play
def test_what_each_input_determines(name, shows, gamma, optimal):
    assert determines(delivery(shows, True, gamma, optimal=optimal), name) == RANDOM[name][SHOWS.index(shows)]


@every_input
@every_state
@of_uniform_and_best_play
def test_what_each_input_determines_without_chance(name, shows, optimal):
    assert determines(delivery(shows, False, HALF, optimal=optimal), name) == DETERMINISTIC[name][SHOWS.index(shows)]


@every_input
@every_state
def test_which_inputs_are_functions_of_the_situation(name, shows):
    """The real state and the macro-state of whoever ends tell how the interval will turn out."""
    leaks = name in ("real", "real-both", "single_ends") and shows != "trips"
    assert is_function_of_row(delivery(shows), name) != leaks
    assert is_function_of_row(delivery(shows, False), name)


@every_input
@every_state
def test_a_perfect_fit_is_right_iff_the_input_determines_the_value_and_leaks_nothing(name, shows):
    process = delivery(shows)
    leaks_nothing = is_function_of_row(process, name)
    for view_name, determined in zip(VIEWS, determines(process, name), strict=True):
        is_right = value_error(process, name, view_name) == 0
        assert is_right == (determined and leaks_nothing)


@pytest.mark.parametrize(
    ("shows", "name", "view_name"), [("trips", "joint", "histories"), ("clock", "decision", "chosen")]
)
def test_elapsed_time_is_missing(shows, name, view_name):
    """Second trip, by cart, the keeper opens now: worth 2 if this is the last step, 1 if it is the one before."""
    process = delivery(shows)
    pairs = {}
    for row in process.rows:
        if row.trips == 1 and row.macros == ("cart", "open") and row.chosen == (False, True):
            key = mixer_state(name, row), view(view_name, row)
            pair = row.elapsed[CARRIER], process.value(row)
            pairs.setdefault(key, set()).add(pair)
    assert {(1, 1), (2, 2)} in pairs.values()  # (steps for which the cart has run, value)


def test_a_mixer_that_does_not_know_who_is_ongoing():
    """Second trip begins by cart, the keeper tidies: 7/8 if it has just begun to, 3/4 if it is at its second step."""
    process = delivery("position")
    found = {}
    for row in process.rows:
        if (row.trips, row.walked, row.macros) == (1, 0, ("cart", "tidy")):
            assert mixer_state("decision", row) == (1, 0)
            found.setdefault(row.chosen, set()).add(process.value(row))
    assert found == {(True, True): {Fraction(7, 8)}, (True, False): {Fraction(3, 4)}}
    assert witness(process, "joint", "actions") is None  # the joint macro-state tells who chose, here


@every_state
def test_macro_state_of_an_agent_that_chose_is_the_decision_state(shows):
    """So `single_chose` is `decision`, and the joint macro-state with who chose contains it."""
    for row in delivery(shows).rows:
        assert mixer_state("single_chose", row) == mixer_state("decision", row) == row.state
        for macro_state, chose in zip(row.macro_states, row.chosen, strict=True):
            assert macro_state == row.state or not chose


def test_macro_state_of_the_agent_that_ends_can_be_worse_than_the_real_state():
    """In mean squared error: worse if the mixer sees m only, better if it sees who chose; exact in neither."""
    process = delivery("position")
    error = {}
    for name in ("single_ends", "real"):
        for view_name in ("actions", "chosen"):
            error[name, view_name] = value_error(process, name, view_name)
    assert error["single_ends", "actions"] > error["real", "actions"]
    assert 0 < error["single_ends", "chosen"] < error["real", "chosen"]


def test_temporal_inconsistency_does_no_harm_by_itself():
    """The decision state is of another date than the ongoing agents' histories, and still determines every value."""
    process = delivery("position")
    dated_otherwise = [row for row in process.rows if row.macro_states != (row.state, row.state)]
    assert dated_otherwise
    assert value_error(process, "decision", "chosen") == 0


@every_state
def test_histories_matter_if_policies_use_them(shows):
    def opens_once(agent, history):
        if agent == KEEPER and ("open",) in history:
            return {"tidy": Fraction(1)}
        return uniform(agent, history)

    process = Delivery(shows, policy=opens_once)
    assert determines(process, "decision+elapsed") == WITH_HISTORIES
    assert determines(process, "joint") == (NEVER if shows == "trips" else WITH_HISTORIES)


# ---- a macro-action that ends by chance -----------------------------------------------------------------------------
def test_the_joint_macro_history_tells_who_is_free_only_without_chance():
    """Eq. 6 has M^+ as a function of macro-histories. It is one where terminations are certain, and not by chance.

    By hand: the first trip is made by hand, and the keeper has tidied. If this took 2 steps both choose now. If it took
    1, the keeper has begun something else and goes on. So one joint macro-history has two sets M^+. The next trip by
    cart, while the keeper tidies, is worth 7/8 with the first and 3/4 with the second.
    """
    together = (True, True)
    carrier_alone = (True, False)
    values = {}  # by joint macro-history, then by who chose
    for row in delivery("position").rows:
        value = delivery("position").value(row)
        values.setdefault(row.histories, {}).setdefault(row.chosen, {})[row.macros] = value
    of_one = values[(("hand", False),), (("tidy",),)]
    assert set(of_one) == {together, carrier_alone}
    assert of_one[together]["cart", "tidy"] == Fraction(7, 8)
    assert of_one[carrier_alone]["cart", "tidy"] == Fraction(3, 4)
    certain = {}
    for row in delivery("position", False).rows:
        certain.setdefault(row.histories, set()).add(row.chosen)
    assert all(len(chosen) == 1 for chosen in certain.values())


# ---- the real state -------------------------------------------------------------------------------------------------
def return_explained(process, name, view_name):
    """Second moment of E[return | input]: the higher, the better the input predicts the return."""
    fit = learned(process, name, view_name)
    total = Fraction(0)
    for row, visits in process.rows.items():
        for interval in process.intervals(row):
            guess = fit[mixer_state(name, row, interval), view(view_name, row)]
            total += visits * interval.probability * guess**2
    return total / sum(process.rows.values())


@pytest.mark.parametrize("view_name", VIEWS)
def test_the_real_state_is_not_noise_it_tells_the_outcome(view_name):
    """It predicts the return better than all there is to know at the decision, and the decision's value worse."""
    process = delivery("position")
    all_there_is = return_explained(process, "decision+elapsed", "histories")
    assert return_explained(process, "real", view_name) > all_there_is
    assert value_error(process, "real", view_name) > value_error(process, "decision", view_name)


def test_one_situation_two_real_states():
    """First trip, by cart, one step walked, the keeper tidies: worth 281/256, learned as two other values."""
    process = delivery("position")
    macros = ("cart", "tidy")
    histories = ((), (("tidy",),))
    (row,) = [row for row in process.rows if (row.time, row.macros, row.histories) == (1, macros, histories)]
    assert process.value(row) == Fraction(281, 256)
    fit = learned(process, "real", "histories")
    found = {}
    for interval in process.intervals(row):
        state = mixer_state("real", row, interval)
        found[state] = fit[state, view("histories", row)]
    assert found == {(0, 1): Fraction(205, 128), (0, 2): Fraction(29, 48)}


@pytest.mark.parametrize("name", INPUTS)
@pytest.mark.parametrize("random_tidy", [True, False])
def test_only_real_and_single_ends_mean_another_state_in_the_target(name, random_tidy):
    """Where the prediction is right, so is the target, unless Q and Q' are fed states of different dates."""
    process = delivery("position", random_tidy)
    for view_name in VIEWS:
        unseen, error = target_error(process, name, view_name)
        if name in ("real", "single_ends"):
            assert unseen > 0 or error > 0
        else:
            assert unseen == 0
            assert (error == 0) == (value_error(process, name, view_name) == 0)


def test_real_state_without_chance_predicts_exactly_and_bootstraps_wrongly():
    """Deterministic, undiscounted, progress visible: no noise. The target still takes the input for another row's."""
    process = delivery("position", False)
    for view_name in VIEWS:
        assert value_error(process, "real", view_name) == 0
    unseen, error = target_error(process, "real", "actions")
    assert unseen == 0
    assert error > Fraction(1, 8)  # it answers, with the value of a later moment
    unseen, error = target_error(process, "real", "chosen")
    assert unseen > Fraction(1, 5)  # it has never been asked
    assert error == 0


@pytest.mark.parametrize("view_name", VIEWS)
def test_real_state_in_both_predicts_as_wrongly_and_bootstraps_rightly(view_name):
    """Q' is fed the end of its own interval, too: the leak averages out, so the dates are what spoils the target."""
    assert target_error(delivery("position", False), "real-both", view_name) == (0, 0)
    process = delivery("position")
    assert value_error(process, "real-both", view_name) == value_error(process, "real", view_name) > Fraction(3, 100)
    _, error_of_real = target_error(process, "real", view_name)
    unseen, error = target_error(process, "real-both", view_name)
    assert unseen == 0
    assert 0 < 5_000 * error < error_of_real


def test_the_real_state_depends_on_the_macro_action_it_is_to_value():
    """So Mac-IGM, a demand at one fixed input, compares it with joint actions that would have led to another input."""
    process = delivery("position", False)
    first = {}
    for row in process.start_rows():
        (interval,) = process.intervals(row)
        first[row.macros] = mixer_state("real", row, interval)
    assert first["hand", "open"] == (0, 0)
    assert first["hand", "tidy"] == (0, 1)
