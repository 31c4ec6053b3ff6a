"""The definitions on random value tables: what is available, ties, the degenerate case, Prop. 3.2 and Prop. 3.4."""

import itertools
from random import Random

import numpy as np
import pytest
from hypothesis import find, given, settings
from hypothesis import strategies as st

from theory.igm import (
    TIES,
    adv_igm,
    advantages,
    conditional_argmax,
    exact,
    igm,
    initiation_sets,
    local_choices,
    mac_igm,
    mac_igm_batch,
    macadv_igm,
    open_actions,
    paper_available,
    situations,
)

HUGE = [0.0, 1.0, 1.0 + 2**-52, 1e16, 1e308, -1e308, 5e-324]
FINITE = st.floats(allow_nan=False, allow_infinity=False)
NUMBERS = st.one_of(
    st.integers(-2, 2).map(float),  # ties
    st.floats(-10, 10),
    st.sampled_from(HUGE),
    FINITE,
)
SEEDS = st.integers(0, 2**32 - 1)
FORMS = ("free", "equal rows", "additive", "additive but one", "maximum at the greedy tuple")
MANY = settings(deadline=None, max_examples=200)
SOME = settings(deadline=None, max_examples=60)
ties_of_every_kind = pytest.mark.parametrize("ties", TIES)


def matrix(*rows):
    """A joint table of two agents: matrix("3 0 1", "2 5 1") has a row for each macro-action of the first."""
    return np.array([row.split() for row in rows], float)


def own(*agents):
    """Utilities: own("1 0", "0 2 1") are those of two agents."""
    return [np.array(numbers.split(), float) for numbers in agents]


def can(*agents):
    """What is available: with can("xx", "x.x") all but the second macro-action of the second agent is."""
    return [np.array(list(marks)) == "x" for marks in agents]


@st.composite
def tables(draw, max_agents=4, max_actions=5):
    """(q, utilities): float64 tables of 1..max_agents agents; some forms often satisfy IGM, so that verdicts differ."""
    sizes = draw(st.lists(st.integers(2, max_actions), min_size=1, max_size=max_agents))
    pool = draw(st.lists(NUMBERS, min_size=1, max_size=6))
    form = draw(st.sampled_from(FORMS))
    rng = np.random.default_rng(draw(SEEDS))
    if draw(st.booleans()):
        pool = [*pool, *rng.normal(size=20)]
    utilities = [rng.choice(pool, size) for size in sizes]
    q = rng.choice(pool, sizes)
    if form == "equal rows":
        row = rng.choice(pool, sizes[-1])
        q = np.broadcast_to(row, sizes).copy()
    if form.startswith("additive"):
        utilities = [np.clip(u, -1e300, 1e300) for u in utilities]
        q = sum(np.ix_(*utilities))
        if form == "additive but one":
            q.flat[rng.integers(q.size)] = pool[0]
    if form == "maximum at the greedy tuple":
        greedy = tuple(u.argmax() for u in utilities)
        q[greedy] = q.max()
    return q, utilities


def draw_each(data, sizes, strategy):
    """A draw for each agent, a tuple. strategy: a function of its number of macro-actions."""
    return tuple(data.draw(strategy(size)) for size in sizes)


def macro_actions(size):
    return st.integers(0, size - 1)


def sets_of_macro_actions(size):
    """What is available to an agent: all macro-actions, one (as if it were busy), or any set of them; bool [size]."""
    place = np.arange(size)
    return st.one_of(
        st.just(place >= 0),
        macro_actions(size).map(lambda running: place == running),
        st.integers(1, 2**size - 1).map(lambda bits: (bits >> place) % 2 == 1),
    )


def draw_values(data, sizes):
    """V and V_i, any numbers."""
    return data.draw(NUMBERS), draw_each(data, sizes, lambda _: NUMBERS)


def all_free(sizes):
    return [np.ones(size, bool) for size in sizes]


# ---- what is available ----------------------------------------------------------------------------------------------
def same(available, expected):
    return all(np.array_equal(a, b) for a, b in zip(available, expected, strict=True))


def test_what_is_available_by_hand():
    available = paper_available((2, 3), (True, False), (9, 1))
    assert same(available, can("xx", ".x."))
    assert open_actions(available) == [(0, 1), (1, 1)]
    free = [[True, False], [False, True]]
    running = [[0, 2], [1, 0]]
    first_agent, second_agent = paper_available((2, 3), free, running)
    assert same(first_agent, can("xx", ".x"))
    assert same(second_agent, can("..x", "xxx"))


@pytest.mark.parametrize("sizes", [(2,), (3, 2), (2, 2, 2)])
def test_situations_are_those_of_the_paper_and_are_among_the_initiation_sets(sizes):
    expected = set()
    for running in itertools.product(*(range(-1, size) for size in sizes)):  # -1: the agent is free
        free = [m < 0 for m in running]
        available = paper_available(sizes, free, running)
        expected.add(tuple(tuple(mask.tolist()) for mask in available))
    found = situations(sizes)
    assert set(found) == expected
    assert len(found) == len(expected) == np.prod([1 + size for size in sizes])
    assert np.all([np.all(mask) for mask in found[0]])
    every = initiation_sets(sizes)
    assert set(found) <= set(every)
    assert len(set(every)) == len(every) == np.prod([2**size - 1 for size in sizes])


@pytest.mark.slow
@MANY
@given(tables(), st.data())
def test_with_what_is_available_eq_7_is_the_papers_for_free_and_busy_agents(table, data):
    """Both sides of Eq. 7, written with its two cases, are those written with what is available."""
    q, utilities = table
    free = draw_each(data, q.shape, lambda _: st.booleans())
    running = draw_each(data, q.shape, macro_actions)
    right_side = []
    agrees_with_running = np.ones(q.shape, bool)
    for i, u in enumerate(utilities):
        if free[i]:
            right_side.append(np.flatnonzero(u == u.max()))
        else:
            right_side.append([running[i]])
            agrees_with_running &= np.indices(q.shape)[i] == running[i]
    top = q[agrees_with_running].max()
    left_side = np.argwhere(agrees_with_running & (q == top))
    available = paper_available(q.shape, free, running)
    assert conditional_argmax(q, available) == set(map(tuple, left_side))
    assert local_choices(utilities, available) == set(itertools.product(*right_side))


def test_conditional_argmax_by_hand():
    q = matrix("3 0 1", "2 5 1")
    for available, expected in (
        (can("xx", "xxx"), {(1, 1)}),
        (can("xx", "x.."), {(0, 0)}),  # 3, 2
        (can("xx", "..x"), {(0, 2), (1, 2)}),  # 1, 1
        (can("x.", "xxx"), {(0, 0)}),  # 3, 0, 1
        (can(".x", "..x"), {(1, 2)}),
        (can("xx", "x.x"), {(0, 0)}),  # 3, 1 and 2, 1
    ):
        assert conditional_argmax(q, available) == expected


def test_local_choices_by_hand():
    utilities = own("1 1", "0 2 1")
    for available, expected in (
        (can("xx", "xxx"), {(0, 1), (1, 1)}),
        (can(".x", "xxx"), {(1, 1)}),
        (can("xx", "..x"), {(0, 2), (1, 2)}),
        (can("xx", "x.x"), {(0, 2), (1, 2)}),
    ):
        assert local_choices(utilities, available) == expected


def test_eq_7_over_all_macro_actions_is_not_eq_7_over_what_can_be_started():
    """Agent 2 is free and cannot start a. Read over all of M^2, as written, Defs. 3.1 and 3.3 can name a as its choice.

    By hand: as written Eq. 7 holds in the first case and fails in the second. Over what can be started it is reversed.
    """
    q = matrix("4 0 3", "0 2 1")
    everything = all_free((2, 3))
    can_start = can("xx", ".xx")
    first = own("1 0", "2 1 0")
    assert conditional_argmax(q, everything) == local_choices(first, everything) == {(0, 0)}
    assert (0, 0) not in open_actions(can_start)
    second = own("1 0", "0 0 1")
    for ties in TIES:
        for holds in (mac_igm, macadv_igm):
            assert holds(q, first, everything, ties=ties)
            assert not holds(q, first, can_start, ties=ties)  # takes (a, b), worth 0
            assert not holds(q, second, everything, ties=ties)  # takes (a, c), worth 3
            assert holds(q, second, can_start, ties=ties)


def test_an_initiation_set_can_break_mac_igm():
    """By hand, with agent 1 free to do both: it depends on which two of its three macro-actions agent 2 can start."""
    q = matrix("4 0 3", "0 2 1")
    assert igm(q, own("1 0", "2 1 0"))
    assert mac_igm(q, own("1 0", "2 1 0"), can("xx", "x.x"))
    assert mac_igm(q, own("1 0", "2 0 1"), can("xx", ".xx"))  # 0 3, 2 1
    assert mac_igm(q, own("1 0", "2 1 0"), can("xx", ".xx")) == (False, (0, 1), 3)


# ---- what a verdict says --------------------------------------------------------------------------------------------
def test_verdict_shows_the_joint_action_and_what_it_loses():
    q = matrix("2 0", "0 1")
    assert igm(q, own("1 0", "1 0")) == (True, None, 0)
    verdict = mac_igm(q, own("1 0", "1 0"), can("xx", ".x"))
    assert not verdict
    assert verdict == (False, (0, 1), 1.0)  # with agent 2 on macro-action 1, agent 1 should choose 1
    other = igm(q, own("0 1", "0 1"))
    assert not other
    assert other.margin == 1.0


TIE_CASES = {  # table and utilities: (holds under "equal", "every", "some")
    "no ties": (
        matrix("3 1", "2 0"),
        own("1 0", "1 0"),
        (True, True, True),
    ),
    "the same ties on both sides": (
        matrix("3 3", "0 0"),
        own("1 0", "1 1"),
        (True, True, True),
    ),
    "a flat mixer over utilities that differ": (
        matrix("3 3", "3 3"),
        own("1 0", "1 0"),
        (False, True, True),
    ),
    "a joint optimum that no one reaches": (
        matrix("3 0", "0 3"),
        own("1 0", "1 0"),
        (False, True, True),
    ),
    "local ties that need an agreement": (
        matrix("3 0", "0 3"),
        own("1 1", "1 1"),
        (False, False, True),
    ),
    "one greedy tuple loses": (
        matrix("3 0", "0 0"),
        own("1 0", "1 1"),
        (False, False, True),
    ),
    "all greedy tuples lose": (
        matrix("3 0", "0 0"),
        own("0 1", "1 1"),
        (False, False, False),
    ),
}


@pytest.mark.parametrize("name", TIE_CASES)
def test_what_ties_mean(name):
    q, utilities, expected = TIE_CASES[name]
    everything = all_free(q.shape)
    for ties, holds in zip(TIES, expected, strict=True):
        assert igm(q, utilities, ties).holds == holds
        assert adv_igm(q, utilities, ties).holds == holds
        assert mac_igm(q, utilities, everything, ties).holds == holds
        assert macadv_igm(q, utilities, everything, 7, [-1, 5], ties).holds == holds


def test_margin_is_zero_only_for_a_maximiser_that_nobody_reaches():
    utilities = own("1 0", "1 0")
    assert igm(matrix("3 0", "0 3"), utilities) == (False, (1, 1), 0)
    assert igm(matrix("3 0", "0 4"), utilities) == (False, (0, 0), 1)


@MANY
@given(tables(), st.data())
def test_readings_of_ties_are_nested_and_a_failure_can_be_checked(table, data):
    q, utilities = table
    available = draw_each(data, q.shape, sets_of_macro_actions)
    equal, every, some = (mac_igm(q, utilities, available, ties) for ties in TIES)
    assert every or not equal
    assert some or not every
    joint = conditional_argmax(q, available)
    local = local_choices(utilities, available)
    top = q.item(min(joint))
    for verdict in (equal, every, some):
        assert bool(verdict) == verdict.holds
        if verdict:
            assert verdict.action is None
            assert verdict.margin == 0
        else:
            assert verdict.margin == top - q.item(verdict.action) >= 0
            is_bad_choice = verdict.action in local and verdict.margin > 0
            assert is_bad_choice != (verdict.action in joint - local)


@pytest.mark.parametrize(
    "change",
    [
        dict(utilities=own("0 0")),
        dict(utilities=own("0 0", "0 0 0")),
        dict(q=matrix("0 nan", "0 0")),
        dict(q=matrix("0 -inf", "0 0")),
        dict(available=can("xx")),
        dict(available=can("xx", "x.x")),
        dict(available=can("xx", "..")),
        dict(available=[can("xx", "xx"), can("x.", "x.")]),  # of two environments
        dict(available=own("1 1", "1 0")),  # no bools
        dict(ties="any"),
    ],
)
def test_bad_input_is_refused(change):
    good = dict(
        q=matrix("0 0", "0 0"),
        utilities=own("0 0", "0 0"),
        available=can("xx", "x."),
        ties="equal",
    )
    assert mac_igm(**good)
    with pytest.raises(ValueError):
        mac_igm(**{**good, **change})


# ---- the degenerate case --------------------------------------------------------------------------------------------
@pytest.mark.slow
@ties_of_every_kind
@MANY
@given(table=tables(), data=st.data())
def test_all_terminated_mac_igm_is_igm(ties, table, data):
    """Every macro-action has ended: Mac-IGM is IGM and MacAdv-IGM, with any V, is Adv-IGM. For all tables."""
    q, utilities = table
    available = all_free(q.shape)
    value, values = draw_values(data, q.shape)
    assert mac_igm(q, utilities, available, ties) == igm(q, utilities, ties)
    assert macadv_igm(q, utilities, available, value, values, ties) == adv_igm(q, utilities, ties)


@pytest.mark.slow
@ties_of_every_kind
@MANY
@given(table=tables(), data=st.data())
def test_all_busy_is_no_demand(ties, table, data):
    q, utilities = table
    running = draw_each(data, q.shape, macro_actions)
    available = paper_available(q.shape, [False] * q.ndim, running)
    assert mac_igm(q, utilities, available, ties)


# ---- Prop. 3.4 ------------------------------------------------------------------------------------------------------
@pytest.mark.slow
@ties_of_every_kind
@MANY
@given(table=tables(), data=st.data())
def test_prop_3_4_mac_igm_is_macadv_igm(ties, table, data):
    """Same verdict and same joint action for every table, whatever is available, and for any V and V_i.

    This is a remark: V and V_i are constants, which no argmax sees, so no table can tell the two definitions apart. The
    test guards the code alone. What can fail is tested below: rounding, and the form of Adv-IGM, which sees V.
    """
    q, utilities = table
    available = draw_each(data, q.shape, sets_of_macro_actions)
    value, values = draw_values(data, q.shape)
    mac = mac_igm(q, utilities, available, ties)
    with_any_value = macadv_igm(q, utilities, available, value, values, ties)
    with_the_maximum = macadv_igm(q, utilities, available, ties=ties)  # Eq. 4
    assert mac[:2] == with_any_value[:2] == with_the_maximum[:2]


@SOME
@given(tables(max_agents=3, max_actions=3), st.data())
def test_prop_3_4_in_every_situation(table, data):
    q, utilities = table
    value, values = draw_values(data, q.shape)
    for available in situations(q.shape):
        mac = mac_igm(q, utilities, available)
        assert macadv_igm(q, utilities, available, value, values).holds == mac.holds


def test_advantages_by_hand():
    q = matrix("3 1", "2 0")
    utilities = own("1 0", "5 7")
    everything = all_free((2, 2))
    joint, of_agents = advantages(q, utilities)  # Eq. 4: V = 3, V_i = 1 and 7
    assert joint.tolist() == [[0, -2], [-1, -3]]
    assert [a.tolist() for a in of_agents] == [[0, -1], [-2, 0]]
    joint, of_agents = advantages(q, utilities, 2, [0, 6])
    assert joint.tolist() == [[1, -1], [0, -2]]
    assert [a.tolist() for a in of_agents] == [[1, 0], [-1, 1]]
    assert macadv_igm(q, utilities, everything, 2, [0, 6]) == (False, (0, 1), 2)


def without_disadvantage(q, utilities, available, value=None, values=None):
    """The two sets that Adv-IGM compares, of what is available: A = 0, and A_i = 0 for every agent."""
    joint, of_agents = advantages(q, utilities, value, values)
    actions = open_actions(available)
    jointly = {m for m in actions if joint.item(m) == 0}
    locally = {m for m in actions if all(a[m_i] == 0 for a, m_i in zip(of_agents, m, strict=True))}
    return jointly, locally


@pytest.mark.slow
@ties_of_every_kind
@MANY
@given(table=tables(), data=st.data())
def test_adv_igms_form_carries_over_if_v_is_of_what_is_available(ties, table, data):
    """Mac-IGM is: A = 0 where all A_i = 0, if V and V_i are maxima over what is available (the authors' revision)."""
    q, utilities = table
    available = draw_each(data, q.shape, sets_of_macro_actions)
    value = max(q.item(m) for m in open_actions(available))
    values = [u[mask].max() for u, mask in zip(utilities, available, strict=True)]
    jointly, locally = without_disadvantage(q, utilities, available, value, values)
    holds = {
        "equal": jointly == locally,
        "every": jointly >= locally,
        "some": bool(jointly & locally),
    }
    assert mac_igm(q, utilities, available, ties).holds == holds[ties]


def test_adv_igms_form_does_not_carry_over_with_eq_4():
    """With V = max Q and V_i = max Q_i over everything, nothing that is available need be without a disadvantage.

    Agent 2 is busy with b. In the first table Mac-IGM holds and both sets are empty. In the second it holds, too, and
    the sets differ: the best of all joint actions is available, agent 2's best macro-action is not.
    """
    goes_on = can("xx", ".x")
    q = matrix("2 1", "1 0")
    assert mac_igm(q, own("1 0", "1 0"), goes_on)
    assert without_disadvantage(q, own("1 0", "1 0"), goes_on) == (set(), set())
    q = matrix("0 2", "0 1")
    assert mac_igm(q, own("1 0", "1 0"), goes_on)
    assert without_disadvantage(q, own("1 0", "1 0"), goes_on) == ({(0, 1)}, set())


@MANY
@given(tables())
def test_igm_is_adv_igm(table):
    """The primitive half of Prop. 3.5, from QPLEX."""
    for ties in TIES:
        assert igm(*table, ties)[:2] == adv_igm(*table, ties)[:2]


def test_rounding_breaks_prop_3_4():
    """A dueling head in floating point: next to a large V the advantages round to a tie that Q does not have."""
    q = matrix("1 0", "0 0")
    utilities = own("1 0", "1 0")
    v = 2.0**60
    available = all_free(q.shape)
    assert mac_igm(q, utilities, available)
    assert macadv_igm(q, utilities, available, v, [v, v])
    assert len(conditional_argmax(q - v, available)) == 4
    assert not mac_igm(q - v, utilities, available)
    rounded = [u - v for u in utilities]
    assert not mac_igm(q, rounded, available, ties="every")
    q = matrix("0 0", "0 1")  # where Mac-IGM fails, to which a tie helps
    assert not mac_igm(q, utilities, available, ties="some")
    assert mac_igm(q - v, utilities, available, ties="some")


@MANY
@given(FINITE, FINITE, NUMBERS)
def test_rounding_makes_ties_but_breaks_and_reverses_none(a, b, v):
    low, high = sorted((a, b))
    assert low - v <= high - v
    assert exact(low) - exact(v) < exact(high) - exact(v) or low == high


# ---- Prop. 3.2 ------------------------------------------------------------------------------------------------------
def embed(q, utilities, extra, below=True):
    """Adds extra[i] durative macro-actions to each agent's primitive ones; exact tables in, exact tables out.

    A joint action with a durative part is worth the sum of the utilities, plus a constant that puts it below (or above)
    every primitive joint action. A durative macro-action's utility is below every primitive one's.
    """
    wide = []
    for u, count in zip(utilities, extra, strict=True):
        durative = [u.min() - 1 - k for k in range(count)]
        wide.append(np.append(u, durative))
    table = sum(np.ix_(*wide))
    if below:
        table = table + (q.min() - table.max() - 1)
    else:
        table = table + (q.max() - table.min() + 1)
    primitive_block = tuple(slice(size) for size in q.shape)
    table[primitive_block] = q
    return table, wide


def busy_agents_run_durative_ones(available, sizes):
    """Whether no agent is busy with one of its first `sizes` macro-actions. All agents have two or more."""
    for of_agent, size in zip(available, sizes, strict=True):
        is_busy = sum(of_agent) == 1
        if is_busy and any(of_agent[:size]):
            return False
    return True


@pytest.mark.slow
@ties_of_every_kind
@MANY
@given(table=tables(max_agents=3, max_actions=3), data=st.data())
def test_prop_3_2_embedding_preserves_igm(ties, table, data):
    """F^IGM embeds into F^Mac-IGM: primitives take one step, so a busy agent runs one of the added macro-actions."""
    q = exact(table[0])
    utilities = [exact(u) for u in table[1]]
    extra = draw_each(data, q.shape, lambda _: st.integers(0, 2))
    wide_q, wide_utilities = embed(q, utilities, extra)
    primitive = igm(q, utilities, ties)
    for available in situations(wide_q.shape):
        if busy_agents_run_durative_ones(available, q.shape):
            everybody_is_free = np.all([np.all(mask) for mask in available])
            expected = primitive.holds if everybody_is_free else True
            assert mac_igm(wide_q, wide_utilities, available, ties).holds == expected


def test_prop_3_2_a_larger_domain_is_not_enough():
    """The proof compares the sizes of the domains. The same larger domain, filled differently, loses the verdict."""
    q = exact(matrix("2 0", "0 1"))
    utilities = [exact(u) for u in own("1 0", "1 0")]
    assert igm(q, utilities)
    wide_q, wide_utilities = embed(q, utilities, (1, 1), below=False)
    assert not mac_igm(wide_q, wide_utilities, all_free(wide_q.shape), ties="some")


def test_prop_3_2_inclusion_is_strict():
    """A Mac-IGM pair that is no embedded IGM pair: its primitive part fails IGM. One durative macro-action suffices."""
    q = matrix("0 1", "1 0", "2 1")
    assert mac_igm(q, own("1 0 2", "1 0"), all_free(q.shape))
    assert not igm(q[:2], own("1 0", "1 0"), ties="some")


# ---- one table for all situations -----------------------------------------------------------------------------------
CASES = [  # sizes, and how many different values tables have
    ((2, 2), 3),
    ((2, 3), 2),
    ((2, 2, 2), 2),
]


def all_tables(sizes, levels):
    """Every (q, utilities) with values in 0..levels-1, as float arrays with a batch axis."""
    cells = int(np.prod(sizes))
    numbers = cells + sum(sizes)
    grid = np.indices([levels] * numbers).reshape(numbers, -1).T.astype(float)
    ends = np.cumsum([cells, *sizes])
    q, *utilities, _ = np.split(grid, ends, axis=1)
    return q.reshape(-1, *sizes), utilities


def mac_igm_in_each(q, utilities, ties, cases):
    """Of many tables, whether each satisfies Mac-IGM in each case of what is available; bool [cases, batch]."""
    verdicts = [mac_igm_batch(q, utilities, available, ties)[0] for available in cases]
    return np.array(verdicts)


def igm_and_mac_igm(sizes, levels, ties="equal"):
    """Of `all_tables`: where IGM holds, and where Mac-IGM holds for every M^+ and m^-; bool [batch] each."""
    verdicts = mac_igm_in_each(*all_tables(sizes, levels), ties, situations(sizes))
    return verdicts[0], verdicts.all(0)


@ties_of_every_kind
@pytest.mark.parametrize("sizes", [(2,), (5,), (1, 3), (3, 1), (1, 1, 2)])
def test_with_one_agent_that_has_a_choice_igm_is_mac_igm(ties, sizes):
    levels = 3 if sum(sizes) < 6 else 2
    holds, everywhere = igm_and_mac_igm(sizes, levels, ties)
    assert 0 < holds.sum() < len(holds)
    assert np.array_equal(holds, everywhere)


def test_smallest_table_with_igm_but_not_mac_igm():
    """Two agents with two macro-actions and three values: smaller there is none that does not rest on a tie."""
    cases = situations((2, 2))
    for levels in (1, 2):  # with two values, the failures are ties: joint maximisers that no greedy tuple reaches
        weakest = mac_igm_in_each(*all_tables((2, 2), levels), "some", cases)
        holds, _ = igm_and_mac_igm((2, 2), levels)
        assert not (holds & ~weakest.all(0)).any()
    q = matrix("2 0", "0 1")
    utilities = own("1 0", "1 0")
    assert igm(q, utilities)
    failing = [available for available in cases if not mac_igm(q, utilities, available, ties="some")]
    assert len(failing) == 2
    for available in failing:
        assert same(available, can("xx", ".x")) or same(available, can(".x", "xx"))
    assert mac_igm(q, utilities, can("xx", ".x")) == (False, (0, 1), 1.0)


@ties_of_every_kind
@pytest.mark.parametrize(("sizes", "levels"), CASES)
def test_mac_igm_everywhere_is_stronger_than_igm_on_a_table(ties, sizes, levels):
    holds, everywhere = igm_and_mac_igm(sizes, levels, ties)
    assert 0 < everywhere.sum() < holds.sum()
    assert not (everywhere & ~holds).any()


def test_two_thirds_of_two_by_two_tables_with_igm_fail_mac_igm():
    """The four cells in random order, no ties, and utilities that satisfy IGM: 16 of the 24 orders fail some m^-."""
    failing = 0
    for order in itertools.permutations(range(4)):
        q = np.array(order).reshape(2, 2)
        row, column = np.argwhere(q == 3)[0]
        utilities = [np.eye(2)[row], np.eye(2)[column]]
        assert igm(q, utilities)
        if not all(mac_igm(q, utilities, available) for available in situations(q.shape)):
            failing += 1
    assert failing == 16


def is_dominant(q, utilities, ties):
    """Whether each agent's greedy choices answer whatever the others do: Eq. 7 with that agent alone free."""
    for available in situations(q.shape):
        agents_with_a_choice = sum(sum(mask) > 1 for mask in available)
        if agents_with_a_choice == 1 and not mac_igm(q, utilities, available, ties):
            return False
    return True


@ties_of_every_kind
@SOME
@given(table=tables(max_agents=3, max_actions=3))
def test_mac_igm_everywhere_is_dominance_of_each_agents_greedy_choice(ties, table):
    q, utilities = table
    verdicts = [mac_igm(q, utilities, available, ties).holds for available in situations(q.shape)]
    assert all(verdicts) == is_dominant(q, utilities, ties)


def rises_with_every_utility(q, utilities, ties):
    """Eq. 1 by differences, of many tables: when one agent alone changes its choice, Q moves as its utility does.

    "equal": up, down, or not at all. "every": it does not fall where the utility does not. "some": it does not fall
    where the utility rises. bool [batch].
    """
    rises = np.ones(len(q), bool)
    for agent, u in enumerate(utilities):
        for a, b in itertools.permutations(range(u.shape[1]), 2):
            change = q.take(a, agent + 1) - q.take(b, agent + 1)
            change = change.reshape(len(q), -1)  # [batch, what the others do]
            own_change = u[:, a, None] - u[:, b, None]
            if ties == "equal":
                as_it_should = np.sign(change) == np.sign(own_change)
            elif ties == "every":
                as_it_should = (change >= 0) | (own_change < 0)
            else:
                as_it_should = (change >= 0) | (own_change <= 0)
            rises &= as_it_should.all(1)
    return rises


@ties_of_every_kind
@pytest.mark.parametrize(("sizes", "levels"), [((3,), 4), *CASES])
def test_mac_igm_with_every_initiation_set_is_monotonicity(ties, sizes, levels):
    """A table satisfies it whatever is available if and only if it rises with every utility (Eq. 1)."""
    q, utilities = all_tables(sizes, levels)
    everywhere = mac_igm_in_each(q, utilities, ties, initiation_sets(sizes)).all(0)
    assert np.array_equal(everywhere, rises_with_every_utility(q, utilities, ties))
    assert 0 < everywhere.sum() < len(q)


def test_mac_igm_for_every_m_minus_is_not_enough_for_initiation_sets():
    """One agent, no tie: its best macro-action is best, and of the two others it takes the worse one."""
    q = np.array([3, 1, 2])
    utilities = own("3 2 1")
    assert all(mac_igm(q, utilities, available) for available in situations((3,)))
    assert mac_igm(q, utilities, can(".xx"), "some") == (False, (1,), 1)


# ---- many tables at once --------------------------------------------------------------------------------------------
@pytest.mark.slow
@ties_of_every_kind
@SOME
@given(table=tables(max_agents=3, max_actions=4), data=st.data())
def test_batch_agrees_with_the_definition(ties, table, data):
    q, utilities = table
    cases = situations(q.shape)
    for _ in range(5):
        cases.append(draw_each(data, q.shape, sets_of_macro_actions))
    masks = [np.array(of_agent) for of_agent in zip(*cases, strict=True)]  # [batch, |M^i|] each
    many_q = np.repeat(q[None], len(cases), axis=0)
    many_utilities = [np.repeat(u[None], len(cases), axis=0) for u in utilities]
    with np.errstate(over="ignore"):  # a loss of inf is one
        holds, loss = mac_igm_batch(many_q, many_utilities, masks, ties)
    for k, available in enumerate(cases):
        assert holds[k] == mac_igm(q, utilities, available, ties).holds
        every = mac_igm(q, utilities, available, "every")
        assert loss[k] == every.margin
        assert (loss[k] == 0) == every.holds


def test_batch_takes_one_situation_for_all_and_refuses_wrong_shapes():
    q = np.stack([matrix("2 0", "0 1")] * 3)
    utilities = [np.stack([u] * 3) for u in own("1 0", "1 0")]
    holds, loss = mac_igm_batch(q, utilities, can("xx", ".x"))
    assert holds.tolist() == [False] * 3
    assert loss.tolist() == [1.0] * 3
    with pytest.raises(ValueError):
        mac_igm_batch(q, [u[:2] for u in utilities], can("xx", ".x"))
    with pytest.raises(ValueError):
        mac_igm_batch(q, utilities, can("xx", ".x"), ties="any")
    for available in (can("xx", ".."), can("xx"), can("xx", "xxx")):
        with pytest.raises(ValueError):
            mac_igm_batch(q, utilities, available)


@pytest.mark.slow
@pytest.mark.parametrize("failing", range(4))
def test_the_strategy_reaches_both_verdicts_in_every_reading(failing):
    """Else equal verdicts would say little. failing: in how many of the readings, the strictest first."""

    def found(drawn):
        q, utilities = drawn
        if q.ndim < 3:
            return False
        available = all_free(q.shape)
        available[-1][1:] = False  # the last agent is busy
        verdicts = [mac_igm(q, utilities, available, ties).holds for ties in TIES]
        return verdicts == [reading >= failing for reading in range(3)]

    find(tables(), found, random=Random(0), settings=MANY)
