"""The definitions on random value tables: ties, the degenerate case, Prop. 3.2 and Prop. 3.4."""

import itertools
from random import Random

import numpy as np
import pytest
from hypothesis import find, given, settings
from hypothesis import strategies as st

from theory.igm import (
    TIES,
    adv_igm,
    conditional_argmax,
    exact,
    igm,
    local_choices,
    mac_igm,
    mac_igm_batch,
    macadv_igm,
    situations,
)

HUGE = [0.0, 1.0, 1.0 + 2**-52, 1e16, 1e308, -1e308, 5e-324]
NUMBERS = st.one_of(
    st.integers(-2, 2).map(float),  # ties
    st.floats(-10, 10),
    st.sampled_from(HUGE),
    st.floats(allow_nan=False, allow_infinity=False),
)
FORMS = ("free", "equal rows", "additive", "additive but one", "maximum at the greedy tuple")
MANY, SOME = settings(deadline=None, max_examples=200), settings(deadline=None, max_examples=60)


@st.composite
def tables(draw, max_agents=4, max_actions=5):
    """(q, utilities): float64 tables of 1..max_agents agents; some forms often satisfy IGM, so that verdicts differ."""
    sizes = draw(st.lists(st.integers(2, max_actions), min_size=1, max_size=max_agents))
    pool, form = draw(st.lists(NUMBERS, min_size=1, max_size=6)), draw(st.sampled_from(FORMS))
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    if draw(st.booleans()):
        pool = [*pool, *rng.normal(size=20)]
    utilities = [rng.choice(pool, size) for size in sizes]
    q = rng.choice(pool, sizes)
    if form == "equal rows":
        q = np.broadcast_to(rng.choice(pool, sizes[-1]), sizes).copy()
    if form.startswith("additive"):
        utilities = [np.clip(u, -1e300, 1e300) for u in utilities]
        q = sum(np.ix_(*utilities))
        if form == "additive but one":
            q.flat[rng.integers(q.size)] = pool[0]
    if form == "maximum at the greedy tuple":
        q[tuple(u.argmax() for u in utilities)] = q.max()
    return q, utilities


def random_situation(data, sizes):
    terminated = data.draw(st.tuples(*[st.booleans()] * len(sizes)))
    return terminated, data.draw(st.tuples(*[st.integers(0, size - 1) for size in sizes]))


ties_of_every_kind = pytest.mark.parametrize("ties", TIES)


# What a verdict says.


def test_conditional_argmax_by_hand():
    q = np.array([[3, 0, 1], [2, 5, 1]])
    assert conditional_argmax(q, (True, True), (0, 0)) == {(1, 1)}
    assert conditional_argmax(q, (True, False), (0, 0)) == {(0, 0)}  # column 0: 3, 2
    assert conditional_argmax(q, (True, False), (0, 2)) == {(0, 2), (1, 2)}  # column 2: 1, 1
    assert conditional_argmax(q, (False, True), (0, 1)) == {(0, 0)}  # row 0: 3, 0, 1
    assert conditional_argmax(q, (False, False), (1, 2)) == {(1, 2)}


def test_local_choices_by_hand():
    utilities = [np.array([1, 1]), np.array([0, 2, 1])]
    assert local_choices(utilities, (True, True), (0, 0)) == {(0, 1), (1, 1)}
    assert local_choices(utilities, (False, True), (1, 0)) == {(1, 1)}
    assert local_choices(utilities, (True, False), (0, 2)) == {(0, 2), (1, 2)}


def test_verdict_shows_the_joint_action_and_what_it_loses():
    q, utilities = np.array([[2.0, 0.0], [0.0, 1.0]]), [np.array([1.0, 0.0])] * 2
    assert igm(q, utilities) == (True, None, 0)
    verdict = mac_igm(q, utilities, (True, False), (0, 1))
    assert not verdict and verdict == (False, (0, 1), 1.0)  # with agent 2 on macro-action 1, agent 1 should choose 1
    assert not igm(q, [np.array([0.0, 1.0])] * 2) and igm(q, [np.array([0.0, 1.0])] * 2).margin == 1.0


TIE_CASES = {  # table and utilities: (holds under "equal", "every", "some")
    "no ties": ([[3, 1], [2, 0]], [[1, 0], [1, 0]], (True, True, True)),
    "the same ties on both sides": ([[3, 3], [0, 0]], [[1, 0], [1, 1]], (True, True, True)),
    "a flat mixer over utilities that differ": ([[3, 3], [3, 3]], [[1, 0], [1, 0]], (False, True, True)),
    "a joint optimum that no one reaches": ([[3, 0], [0, 3]], [[1, 0], [1, 0]], (False, True, True)),
    "local ties that need an agreement": ([[3, 0], [0, 3]], [[1, 1], [1, 1]], (False, False, True)),
    "one greedy tuple loses": ([[3, 0], [0, 0]], [[1, 0], [1, 1]], (False, False, True)),
    "all greedy tuples lose": ([[3, 0], [0, 0]], [[0, 1], [1, 1]], (False, False, False)),
}


@pytest.mark.parametrize("name", TIE_CASES)
def test_what_ties_mean(name):
    q, utilities, holds = TIE_CASES[name]
    q, utilities = np.array(q), [np.array(u) for u in utilities]
    for verdict in (
        lambda ties: igm(q, utilities, ties),
        lambda ties: adv_igm(q, utilities, ties),
        lambda ties: mac_igm(q, utilities, (True, True), (0, 0), ties),
        lambda ties: macadv_igm(q, utilities, (True, True), (0, 0), 7, [-1, 5], ties),
    ):
        assert tuple(verdict(ties).holds for ties in TIES) == holds


def test_margin_is_zero_only_for_a_maximiser_that_nobody_reaches():
    utilities = [np.array([1, 0]), np.array([1, 0])]
    assert igm(np.array([[3, 0], [0, 3]]), utilities) == (False, (1, 1), 0)
    assert igm(np.array([[3, 0], [0, 4]]), utilities) == (False, (0, 0), 1)


@MANY
@given(tables(), st.data())
def test_readings_of_ties_are_nested_and_a_failure_can_be_checked(table, data):
    q, utilities = table
    terminated, ongoing = random_situation(data, q.shape)
    equal, every, some = (mac_igm(q, utilities, terminated, ongoing, ties) for ties in TIES)
    assert (not equal or every) and (not every or some)
    joint, local = conditional_argmax(q, terminated, ongoing), local_choices(utilities, terminated, ongoing)
    top = q.item(next(iter(joint)))
    for verdict in (equal, every, some):
        assert bool(verdict) == verdict.holds
        if verdict:
            assert verdict.action is None and verdict.margin == 0
        else:
            assert verdict.margin == top - q.item(verdict.action) >= 0
            assert (verdict.action in local and verdict.margin > 0) != (verdict.action in joint - local)


@pytest.mark.parametrize(
    "change",
    [
        dict(utilities=[np.zeros(2)]),
        dict(utilities=[np.zeros(2), np.zeros(3)]),
        dict(q=np.array([[0, np.nan], [0, 0]])),
        dict(q=np.array([[0, -np.inf], [0, 0]])),
        dict(terminated=(True,)),
        dict(ongoing=(0, 2)),
        dict(ongoing=(0, -1)),
        dict(ties="any"),
    ],
)
def test_bad_input_is_refused(change):
    good = dict(q=np.zeros((2, 2)), utilities=[np.zeros(2)] * 2, terminated=(True, False), ongoing=(9, 0), ties="equal")
    assert mac_igm(**good)
    with pytest.raises(ValueError):
        mac_igm(**{**good, **change})


# Item 1: the degenerate case.


@ties_of_every_kind
@MANY
@given(table=tables(), data=st.data())
def test_all_terminated_mac_igm_is_igm(ties, table, data):
    """Every macro-action has ended: Mac-IGM is IGM and MacAdv-IGM, with any V, is Adv-IGM. For all tables."""
    q, utilities = table
    done, (_, anything) = (True,) * q.ndim, random_situation(data, q.shape)
    value, values = data.draw(NUMBERS), data.draw(st.tuples(*[NUMBERS] * q.ndim))
    assert mac_igm(q, utilities, done, anything, ties) == igm(q, utilities, ties)
    assert macadv_igm(q, utilities, done, anything, value, values, ties) == adv_igm(q, utilities, ties)


@ties_of_every_kind
@MANY
@given(table=tables(), data=st.data())
def test_all_ongoing_is_no_demand(ties, table, data):
    q, utilities = table
    _, ongoing = random_situation(data, q.shape)
    assert mac_igm(q, utilities, (False,) * q.ndim, ongoing, ties)


# Item 2: Prop. 3.4.


@ties_of_every_kind
@MANY
@given(table=tables(), data=st.data())
def test_prop_3_4_mac_igm_is_macadv_igm(ties, table, data):
    """Same verdict and same joint action for every table, terminated set, m^- and choice of V and V_i."""
    q, utilities = table
    terminated, ongoing = random_situation(data, q.shape)
    value, values = data.draw(NUMBERS), data.draw(st.tuples(*[NUMBERS] * q.ndim))
    mac = mac_igm(q, utilities, terminated, ongoing, ties)
    assert macadv_igm(q, utilities, terminated, ongoing, value, values, ties)[:2] == mac[:2]
    assert macadv_igm(q, utilities, terminated, ongoing, ties=ties)[:2] == mac[:2]  # V = max (Eq. 4)


@SOME
@given(tables(max_agents=3, max_actions=3), st.data())
def test_prop_3_4_in_every_situation(table, data):
    q, utilities = table
    value, values = data.draw(NUMBERS), data.draw(st.tuples(*[NUMBERS] * q.ndim))
    for terminated, ongoing in situations(q.shape):
        mac = mac_igm(q, utilities, terminated, ongoing)
        assert macadv_igm(q, utilities, terminated, ongoing, value, values).holds == mac.holds


@MANY
@given(tables())
def test_igm_is_adv_igm(table):
    """The primitive half of Prop. 3.5, from QPLEX."""
    for ties in TIES:
        assert igm(*table, ties)[:2] == adv_igm(*table, ties)[:2]


def test_rounding_breaks_prop_3_4():
    """A dueling head in floating point: next to a large V the advantages round to a tie that Q does not have."""
    q, utilities, v = np.array([[1.0, 0.0], [0.0, 0.0]]), [np.array([1.0, 0.0])] * 2, 2.0**60
    situation = (True, True), (0, 0)
    assert mac_igm(q, utilities, *situation) and macadv_igm(q, utilities, *situation, v, [v, v])
    assert len(conditional_argmax(q - v, *situation)) == 4
    assert not mac_igm(q - v, utilities, *situation)
    assert not mac_igm(q, [u - v for u in utilities], *situation, ties="every")


@MANY
@given(st.floats(allow_nan=False, allow_infinity=False), st.floats(allow_nan=False, allow_infinity=False), NUMBERS)
def test_rounding_makes_ties_but_breaks_and_reverses_none(a, b, v):
    low, high = sorted((a, b))
    assert low - v <= high - v
    assert exact(low) - exact(v) < exact(high) - exact(v) or low == high


# Item 3: Prop. 3.2.


def embed(q, utilities, extra, below=True):
    """Add extra[i] durative macro-actions to each agent's primitive ones; exact tables in, exact tables out.

    A joint action with a durative part is worth the sum of the utilities, plus a constant that puts it below (or above)
    every primitive joint action; a durative macro-action's utility is below every primitive one's.
    """
    wide = [np.append(u, [u.min() - 1 - k for k in range(n)]) for u, n in zip(utilities, extra, strict=True)]
    table = sum(np.ix_(*wide))
    table = table + (q.min() - table.max() - 1 if below else q.max() - table.min() + 1)
    table[tuple(slice(size) for size in q.shape)] = q
    return table, wide


@ties_of_every_kind
@MANY
@given(table=tables(max_agents=3, max_actions=3), data=st.data())
def test_prop_3_2_embedding_preserves_igm(ties, table, data):
    """F^IGM embeds into F^Mac-IGM: primitives take one step, so an ongoing macro-action is one of the added ones."""
    q, utilities = exact(table[0]), [exact(u) for u in table[1]]
    extra = data.draw(st.tuples(*[st.integers(0, 2)] * q.ndim))
    wide_q, wide_utilities = embed(q, utilities, extra)
    for terminated, ongoing in situations(wide_q.shape):
        if all(done or m >= size for done, m, size in zip(terminated, ongoing, q.shape, strict=True)):
            expected = igm(q, utilities, ties).holds if all(terminated) else True
            assert mac_igm(wide_q, wide_utilities, terminated, ongoing, ties).holds == expected


def test_prop_3_2_a_larger_domain_is_not_enough():
    """The proof compares the sizes of the domains. The same larger domain, filled differently, loses the verdict."""
    q, utilities = exact([[2, 0], [0, 1]]), [exact([1, 0])] * 2
    assert igm(q, utilities)
    wide_q, wide_utilities = embed(q, utilities, (1, 1), below=False)
    assert not mac_igm(wide_q, wide_utilities, (True, True), (0, 0), ties="some")


def test_prop_3_2_inclusion_is_strict():
    """A Mac-IGM pair that is no embedded IGM pair: its primitive part fails IGM. One durative macro-action suffices."""
    q, utilities = np.array([[0, 1], [1, 0], [2, 1]]), [np.array([1, 0, 2]), np.array([1, 0])]
    assert mac_igm(q, utilities, (True, True), (0, 0))
    assert not igm(q[:2], [utilities[0][:2], utilities[1]], ties="some")


SMALLEST = np.array([[2.0, 0.0], [0.0, 1.0]]), [np.array([1.0, 0.0]), np.array([1.0, 0.0])]


def all_tables(sizes, levels):
    """Every (q, utilities) with values in 0..levels-1, as float arrays with a batch axis."""
    cells = int(np.prod(sizes))
    grid = np.indices([levels] * (cells + sum(sizes))).reshape(cells + sum(sizes), -1).T.astype(float)
    q, *utilities = np.split(grid, np.cumsum([cells, *sizes[:-1]]), axis=1)
    return q.reshape(-1, *sizes), utilities


def igm_and_mac_igm(sizes, levels, ties="equal"):
    """Of `all_tables`: where IGM holds, and where Mac-IGM holds for every terminated set and m^-; bool [batch] each."""
    tables = all_tables(sizes, levels)
    verdicts = [mac_igm_batch(*tables, *situation, ties)[0] for situation in situations(sizes)]
    return verdicts[0], np.all(verdicts, axis=0)


@ties_of_every_kind
@pytest.mark.parametrize("sizes", [(2,), (5,), (1, 3), (3, 1), (1, 1, 2)])
def test_with_one_agent_that_has_a_choice_igm_is_mac_igm(ties, sizes):
    holds, everywhere = igm_and_mac_igm(sizes, 3 if sum(sizes) < 6 else 2, ties)
    assert 0 < holds.sum() < len(holds) and np.array_equal(holds, everywhere)


def test_smallest_table_with_igm_but_not_mac_igm():
    """Two agents with two macro-actions and three values: smaller there is none that does not rest on a tie."""
    for levels in (1, 2):  # with two values, the failures are ties: joint maximisers that no greedy tuple reaches
        tables = all_tables((2, 2), levels)
        weakest = [mac_igm_batch(*tables, *situation, "some")[0] for situation in situations((2, 2))]
        assert not (igm_and_mac_igm((2, 2), levels)[0] & ~np.all(weakest, axis=0)).any()
    q, utilities = SMALLEST
    assert igm(q, utilities)
    failing = [s for s in situations(q.shape) if not mac_igm(q, utilities, *s, ties="some")]
    assert failing == [((True, False), (0, 1)), ((False, True), (1, 0))]
    assert mac_igm(q, utilities, *failing[0]) == (False, (0, 1), 1.0)


@ties_of_every_kind
@pytest.mark.parametrize(("sizes", "levels"), [((2, 2), 3), ((2, 3), 2), ((2, 2, 2), 2)])
def test_mac_igm_everywhere_is_stronger_than_igm_on_a_table(ties, sizes, levels):
    holds, everywhere = igm_and_mac_igm(sizes, levels, ties)
    assert 0 < everywhere.sum() < holds.sum() and not (everywhere & ~holds).any()


def test_two_thirds_of_two_by_two_tables_with_igm_fail_mac_igm():
    """The four cells in random order, no ties, and utilities that satisfy IGM: 16 of the 24 orders fail some m^-."""
    failing = 0
    for order in itertools.permutations(range(4)):
        q = np.array(order).reshape(2, 2)
        utilities = [(np.arange(2) == best).astype(int) for best in np.argwhere(q == 3)[0]]
        assert igm(q, utilities)
        failing += not all(mac_igm(q, utilities, *situation) for situation in situations(q.shape))
    assert failing == 16


def dominant(q, utilities, ties):
    """Whether each agent's greedy choices answer whatever the others do: Eq. 7 with that agent alone terminated."""
    lone = [s for s in situations(q.shape) if sum(s[0]) == 1]
    return all(mac_igm(q, utilities, *s, ties) for s in lone)


@ties_of_every_kind
@SOME
@given(table=tables(max_agents=3, max_actions=3))
def test_mac_igm_everywhere_is_dominance_of_each_agents_greedy_choice(ties, table):
    everywhere = all(mac_igm(*table, *situation, ties) for situation in situations(table[0].shape))
    assert everywhere == dominant(*table, ties)


# The bulk path.


@ties_of_every_kind
@SOME
@given(table=tables(max_agents=3, max_actions=4))
def test_batch_agrees_with_the_definition(ties, table):
    q, utilities = table
    terminated, ongoing = map(np.array, zip(*situations(q.shape), strict=True))
    copies = [np.repeat(x[None], len(ongoing), axis=0) for x in (q, *utilities)]
    with np.errstate(over="ignore"):  # a loss of inf is one
        holds, loss = mac_igm_batch(copies[0], copies[1:], terminated, ongoing, ties)
    for k, situation in enumerate(zip(terminated, ongoing, strict=True)):
        assert holds[k] == mac_igm(q, utilities, *situation, ties).holds
        every = mac_igm(q, utilities, *situation, "every")
        assert loss[k] == every.margin and (loss[k] == 0) == every.holds


def test_batch_takes_one_situation_for_all_and_refuses_wrong_shapes():
    q, utilities = SMALLEST[0][None].repeat(3, 0), [u[None].repeat(3, 0) for u in SMALLEST[1]]
    holds, loss = mac_igm_batch(q, utilities, (True, False), (0, 1))
    assert holds.tolist() == [False] * 3 and loss.tolist() == [1.0] * 3
    with pytest.raises(ValueError):
        mac_igm_batch(q, [u[:2] for u in utilities], (True, False), (0, 1))
    with pytest.raises(ValueError):
        mac_igm_batch(q, utilities, (True, False), (0, 1), ties="any")


@pytest.mark.parametrize("readings", [(True,) * 3, (False, True, True), (False, False, True), (False,) * 3])
def test_the_strategy_reaches_both_verdicts_in_every_reading(readings):
    """Else equal verdicts would say little."""

    def found(table):
        agents = table[0].ndim
        last_ongoing = (True,) * (agents - 1) + (False,)
        return agents > 2 and tuple(mac_igm(*table, last_ongoing, (0,) * agents, t).holds for t in TIES) == readings

    find(tables(), found, random=Random(0), settings=MANY)
