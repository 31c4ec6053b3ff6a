"""The mixers of the scripts: which satisfy Mac-IGM, how QPLEX breaks it, and what each can represent."""

import itertools
from functools import partial

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

import avf_qmix
import avf_qplex
import envs
from avf_qplex import QPLEXMixer
from theory.expressiveness import (
    CLASSES,
    FAMILIES,
    MIXERS,
    breaks,
    duplex_tables,
    fit,
    joint_tables,
    random_family,
    represent,
    residuals,
    rows,
)
from theory.expressiveness import cone as cone_of
from theory.igm import TIES, igm, mac_igm, mac_igm_batch, situations
from theory.test_igm import NUMBERS
from theory.variants import SeeOngoing, StateOnly, two_by_two

ALWAYS = {
    **{name: MIXERS[name] for name in ("VDN", "QMIX", "as shipped", "told m^-")},
    "lambda(s), literal": partial(StateOnly, mask_ongoing=False),
    "lambda(s), dueling": StateOnly,
}
TOLERANCE = 1e-9  # of the table's values: floating point breaks ties of the exact numbers
every_consistent_mixer = pytest.mark.parametrize("name", ALWAYS)
SIZES = [(2, 2), (3, 3), (5, 2), (2, 2, 2), (3, 2, 4), (2, 2, 2, 2)]


def random_network(make, sizes, rng, gain=1.0, width=3):
    """A mixer in float64 with weights N(0, gain^2 / inputs), for states of the given width."""
    mixer = make(sizes, width).double().requires_grad_(False)
    for parameter in mixer.parameters():
        inputs = parameter.shape[-1] if parameter.ndim > 1 else 1
        parameter.copy_(torch.from_numpy(rng.normal(size=parameter.shape)) * gain / inputs**0.5)
    return mixer


def relative_loss(q, utilities, terminated, ongoing):
    """What the worst tuple of greedy choices loses (ties="every"), over the size of the values; float64 [batch]."""
    _, loss = mac_igm_batch(q, utilities, terminated, ongoing)
    size = np.abs(q).reshape(len(q), -1).max(1) + np.max([np.abs(u).max(1) for u in utilities], axis=0)
    return loss / np.maximum(size, 1e-300)


def random_batch(sizes, count, rng):
    """utilities N(0, 1) [count, |M^i|], terminated, ongoing [count, n] uniform, states [count, 3]."""
    utilities = [rng.normal(size=(count, size)) for size in sizes]
    terminated = rng.random((count, len(sizes))) < 0.5
    return utilities, terminated, rng.integers(sizes, size=terminated.shape), rng.normal(size=(count, 3))


# Items 4 and 5: what holds at any weights.


@every_consistent_mixer
@settings(deadline=None, max_examples=100)
@given(data=st.data())
def test_mac_igm_at_any_weights(name, data):
    """Adversarial utilities, all agents terminated (IGM) and random other situations, at one random state each."""
    sizes = data.draw(st.lists(st.integers(2, 5), min_size=1, max_size=4))
    pool, seed = data.draw(st.lists(NUMBERS, min_size=1, max_size=6)), data.draw(st.integers(0, 2**32 - 1))
    rng, batch = np.random.default_rng(seed), 16
    pool = np.clip([*pool, *rng.normal(size=data.draw(st.sampled_from([0, 9])))], -1e290, 1e290)
    mixer = random_network(ALWAYS[name], sizes, rng, data.draw(st.sampled_from([0.0, 0.1, 1.0, 10.0])))
    utilities = [np.repeat(rng.choice(pool, (1, size)), batch, axis=0) for size in sizes]
    _, terminated, ongoing, state = random_batch(sizes, batch, rng)
    terminated[0] = True
    values = rng.choice(pool, len(sizes)) if name.endswith("dueling") else None
    q = joint_tables(mixer, utilities, terminated, state, values)
    assert (relative_loss(q, utilities, terminated, ongoing) <= TOLERANCE).all()


@every_consistent_mixer
@pytest.mark.parametrize("sizes", SIZES, ids=str)
def test_mac_igm_on_many_tables(name, sizes):
    rng = np.random.default_rng(0)
    for gain in (0.5, 2.0, 8.0):
        utilities, terminated, ongoing, state = random_batch(sizes, 300, rng)
        values = rng.normal(size=terminated.shape) if name.endswith("dueling") else None
        q = joint_tables(random_network(ALWAYS[name], sizes, rng, gain), utilities, terminated, state, values)
        assert (relative_loss(q, utilities, terminated, ongoing) <= TOLERANCE).all()


@pytest.mark.parametrize("env_id", ["bp-10", "wtd-d"])
@pytest.mark.parametrize("script", [avf_qmix, avf_qplex], ids=lambda script: script.__name__)
def test_mac_igm_of_the_mixer_that_a_run_trains(script, env_id):
    """All settings as shipped: the mixer of `make_learner`, for the tasks' macro-actions and states."""
    env, args, rng = envs.make(env_id), script.parse_args([f"--env={env_id}"]), np.random.default_rng(12)
    mixer = random_network(lambda *_: script.make_learner(args, env)["mixer"], env.n_actions, rng, 2.0)
    utilities, terminated, ongoing, _ = random_batch(env.n_actions, 300, rng)
    state = rng.normal(size=(300, env.n_agents * env.state_size))  # joint, the default
    q = joint_tables(mixer, utilities, terminated, state)
    assert (relative_loss(q, utilities, terminated, ongoing) <= TOLERANCE).all()


@pytest.mark.parametrize("name", ["VDN", "QMIX", "lambda(s), literal", "lambda(s), dueling"])
def test_rises_with_every_utility(name):
    """Eq. 1, by the derivative and by differences; of QPLEX only with lambda(s), and at given V_i."""
    rng, n = np.random.default_rng(1), 3
    for gain in (0.5, 2.0, 8.0):
        mixer = random_network(ALWAYS[name], (4,) * n, rng, gain)
        own, values, state = (torch.from_numpy(rng.normal(size=(500, k))) for k in (n, n, 3))
        actions = torch.from_numpy(rng.integers(4, size=(500, n)))
        chosen = torch.from_numpy(rng.random((500, n)) < 0.5)
        own.requires_grad_()
        (slope,) = torch.autograd.grad(mixer(own, values, actions, chosen, state).sum(), own)
        assert (slope >= 0).all() and (slope > 0).any()
        rise = torch.from_numpy(rng.random((500, n)))
        with torch.no_grad():
            change = mixer(own + rise, values, actions, chosen, state) - mixer(own, values, actions, chosen, state)
        assert change.min() >= -1e-12 * change.max() and change.max() > 0


def test_epsilon_keeps_apart_what_utilities_keep_apart():
    """Where the weights' network says 0, w_i = 1e-10: no tie that the utilities do not have, so "equal" holds."""
    mixer = random_network(QPLEXMixer, (3, 3), np.random.default_rng(2))
    last = mixer.of_state[-1]
    last.weight[:4], last.bias[:4] = 0.0, 0.0  # weights and biases of the two agents
    utilities = [np.array([[2.0, 1.0, 0.0]]), np.array([[0.0, 1.0, 2.0]])]
    for terminated, ongoing in situations((3, 3)):
        q = joint_tables(mixer, utilities, terminated, np.ones((1, 3)))
        assert mac_igm_batch(q, utilities, terminated, ongoing, "equal")[0].all()


@pytest.mark.parametrize("name", ["as shipped", "told m^-"])
@pytest.mark.parametrize("sizes", SIZES, ids=str)
def test_conditioned_qplex_has_the_ties_of_its_utilities_and_no_others(name, sizes):
    """Weights and lambdas of a network are positive, so "equal" holds: the equation as written.

    Rounding is below the first tolerance and all differences are above the second: no value lies between them.
    """
    rng = np.random.default_rng(11)
    _, terminated, ongoing, state = random_batch(sizes, 300, rng)
    utilities = [rng.integers(3, size=(300, size)).astype(float) for size in sizes]
    mixer = random_network(MIXERS[name], sizes, rng)
    q = joint_tables(mixer, utilities, terminated, state)
    scale = np.abs(q).reshape(300, -1).max(1)
    for tolerance in (1e-13, 1e-8):
        assert mac_igm_batch(q, utilities, terminated, ongoing, "equal", tolerance * scale)[0].all()
    last, keys = mixer.of_state[-1], slice(2 * len(sizes), 2 * len(sizes) + mixer.heads)
    last.weight[keys], last.bias[keys] = 0.0, 0.0  # lambda = 0: everything that is open is as good
    q = joint_tables(mixer, utilities, terminated, state)
    holds = {ties: mac_igm_batch(q, utilities, terminated, ongoing, ties, 1e-13 * scale)[0] for ties in TIES}
    assert holds["every"].all() and not holds["equal"].all()


# Item 5: what QPLEX needs.


def test_smallest_counterexample_of_literal_qplex():
    """Q_1 = Q_2 = (1, 0), agent 2 goes on with b: greedy agent 1 takes a, worth -1; b: 0. README opens with it."""
    utilities, situation = [np.array([[1.0, 0.0]])] * 2, ((True, False), (0, 1))
    (q,) = joint_tables(two_by_two(mask_ongoing=False), utilities, situation[0], np.zeros((1, 1)))
    assert np.allclose(q, [[2, -1], [1, 0]], rtol=0, atol=1e-9)
    lambdas = np.array([[[[1.0, 1], [1, 1]], [[3, 3], [1, 1]]]])  # [1, agent, m_1, m_2]
    assert np.allclose(q, 2 + duplex_tables(utilities, lambdas)[0], rtol=0, atol=1e-9)  # V_1 + V_2 = 2
    verdict = mac_igm(q, [u[0] for u in utilities], *situation)
    assert not verdict and verdict.action == (0, 1) and verdict.margin == pytest.approx(1)
    assert igm(q, [u[0] for u in utilities])  # nothing is wrong with all agents terminated
    (q,) = joint_tables(two_by_two(), utilities, situation[0], np.zeros((1, 1)))
    assert np.allclose(q, [[2, 1], [1, 0]], rtol=0, atol=1e-9)  # the same weights, as shipped
    assert mac_igm(q, [u[0] for u in utilities], *situation)


def test_there_is_no_smaller_counterexample():
    """lambda_i(m) in 1..L: none for L = 2; for L = 3 only if lambda_2(a, b) > lambda_1(b, b) + lambda_2(b, b)."""
    for levels in (2, 3):
        lambdas = np.indices((levels,) * 8).reshape(2, 2, 2, -1).transpose(3, 0, 1, 2) + 1.0  # [batch, agent, m_1, m_2]
        utilities = [np.tile([1.0, 0.0], (len(lambdas), 1))] * 2
        q = duplex_tables(utilities, lambdas)
        for ongoing in (0, 1):  # what agent 2 goes on with
            holds, _ = mac_igm_batch(q, utilities, (True, False), (0, ongoing), "every")
            breaking = lambdas[:, 1, 0, 1] > lambdas[:, 0, 1, 1] + lambdas[:, 1, 1, 1]
            assert np.array_equal(~holds, breaking & (ongoing == 1)) and (~holds).any() == (
                levels == 3 and ongoing == 1
            )
    rng = np.random.default_rng(3)
    for sizes in [(5,), (5, 1), (1, 5)]:  # with one agent that has a choice
        utilities = [rng.normal(size=(500, size)) for size in sizes]
        q = duplex_tables(utilities, rng.random((500, len(sizes), *sizes)))
        for situation in situations(sizes):
            assert mac_igm_batch(q, utilities, *situation, "every")[0].all()


@pytest.mark.parametrize("sizes", SIZES, ids=str)
def test_literal_qplex_holds_if_ongoing_agents_run_greedy_macro_actions(sizes):
    rng = np.random.default_rng(4)
    for gain in (0.5, 2.0, 8.0):
        utilities, terminated, _, state = random_batch(sizes, 300, rng)
        ongoing = np.stack([u.argmax(1) for u in utilities], -1)
        q = joint_tables(random_network(MIXERS["literal"], sizes, rng, gain), utilities, terminated, state)
        assert (relative_loss(q, utilities, terminated, ongoing) <= TOLERANCE).all()


FREE = "lambda free"


@pytest.mark.parametrize(
    ("sizes", "ongoing_agents", "name", "low", "high"),
    [
        ((2, 2), 1, FREE, 0.09, 0.13),
        ((3, 3), 1, FREE, 0.20, 0.26),
        ((5, 5), 1, FREE, 0.35, 0.45),
        ((2, 2, 2), 2, FREE, 0.16, 0.24),
        ((3, 3, 3), 2, FREE, 0.31, 0.39),
        ((2, 2), 1, "literal", 0.002, 0.03),
        ((3, 3), 1, "literal", 0.005, 0.05),
        ((3, 3, 3), 2, "literal", 0.01, 0.08),
        ((3, 3, 3), 2, "told m^-, not conditioned", 0.01, 0.08),
        ((3, 3, 3), 2, "as shipped", 0, 0),
        ((3, 3, 3), 2, "told m^-", 0, 0),
    ],
)
def test_how_often_literal_qplex_breaks(sizes, ongoing_agents, name, low, high):
    """More with more macro-actions and agents; a fresh network, whose lambda varies little, 10 times less."""
    makes = {FREE: None, "told m^-, not conditioned": partial(SeeOngoing, mask_ongoing=False), **MIXERS}
    assert low <= breaks(sizes, ongoing_agents, 2_000, 0, makes[name]) / 2_000 <= high


def test_free_signs_with_lambda_of_the_joint_action_break_igm_with_one_agent():
    """V = 0, A = (2, 1), lambda = (1, 3): Q = (2, 3). With V = max and the same lambda: Q = (2, -1)."""
    mixer = QPLEXMixer([2], 1, embed=1, heads=1).double().requires_grad_(False)
    for parameter in mixer.parameters():
        parameter.zero_()
    mixer.of_state[-1].bias.copy_(torch.tensor([1, 0, 8, 0]))  # w, b, key, agent
    mixer.of_action[0].weight.copy_(torch.tensor([[0, 0, 1]]))  # of state, m = a, m = b
    mixer.of_action[-1].weight.fill_(2 * np.log(3.0))
    mixer.of_action[-1].bias.fill_(-np.log(3.0))
    utilities = [np.array([[2.0, 1.0]])]
    for values, expected in (([0.0], [2, 3]), (None, [2, -1])):
        (q,) = joint_tables(mixer, utilities, (True,), np.zeros((1, 1)), values)
        assert np.allclose(q, expected, rtol=0, atol=1e-8) and bool(igm(q, [utilities[0][0]])) == (values is None)


def test_free_signs_with_lambda_of_the_joint_action_break_most_tables():
    rng, sizes, count = np.random.default_rng(5), (3, 3), 1_000
    utilities = [rng.normal(size=(count, size)) for size in sizes]
    values = rng.normal(size=(count, 2))
    free = sum(v.reshape(-1, 1, 1) for v in values.T)
    for i, u in enumerate(utilities):
        lambdas = np.abs(rng.normal(size=(count, *sizes)))
        free = free + lambdas * np.expand_dims(u - values[:, i : i + 1], 2 - i)
    failing = [~mac_igm_batch(free, utilities, (True, True), (0, 0), "every")[0]]
    mixer = random_network(QPLEXMixer, sizes, rng, 2.0)
    q = joint_tables(mixer, utilities, (True, True), rng.normal(size=(count, 3)), values)
    failing.append(relative_loss(q, utilities, (True, True), (0, 0)) > TOLERANCE)
    assert failing[0].mean() > 0.5 and failing[1].mean() > 0.1


# Item 6: expressiveness.


@st.composite
def consistent_families(draw):
    """(utilities, {situation: table}) that satisfy Mac-IGM with ties="every"; ties in both, tables of any size."""
    sizes = draw(st.lists(st.integers(1, 3), min_size=1, max_size=3))
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    scale, levels = draw(st.sampled_from([1e-6, 1.0, 1e6])), draw(st.sampled_from([2, 3, 10**6]))
    utilities = [scale * rng.integers(levels, size=size).astype(float) for size in sizes]
    tables = {}
    for situation in situations(sizes):
        tables[situation] = table = rng.integers(-levels, levels, size=sizes) * draw(st.sampled_from([1e-3, 1.0]))
        greedy = [
            np.flatnonzero(u == u.max()) if done else [on] for u, done, on in zip(utilities, *situation, strict=True)
        ]
        table[np.ix_(*greedy)] = table.max()
    return utilities, tables


@settings(deadline=None, max_examples=60)
@given(consistent_families())
def test_qplex_told_m_minus_represents_every_mac_igm_family(family):
    """A table of its own for every situation, one set of utilities and weights, in the mixer of the script."""
    utilities, tables = family
    mixer, sizes = represent(utilities, tables), tuple(map(len, utilities))
    for (terminated, ongoing), table in tables.items():
        if any(terminated):
            (q,) = joint_tables(mixer, [u[None] for u in utilities], terminated, np.zeros((1, 1)))
            open_ = np.ix_(*(range(s) if t else [m] for s, t, m in zip(sizes, terminated, ongoing, strict=True)))
            size = np.abs(table).max() + max(np.abs(u).max() for u in utilities)
            assert np.allclose(q[open_], table[open_], rtol=0, atol=1e-7 * size + 1e-300)  # size can be 0


@pytest.mark.parametrize("name", CLASSES)
def test_networks_lie_in_the_class_stated_for_them(name):
    """The cones that `residuals` measures against contain what the mixers compute, in all situations together."""
    rng, sizes, families = np.random.default_rng(6), (3, 2), []
    for _ in range(6):
        mixer = random_network(MIXERS["QMIX" if name == "monotone" else name], sizes, rng, 2.0)
        utilities, state = [rng.normal(size=(1, size)) for size in sizes], rng.normal(size=(1, 3))
        tables = {s: joint_tables(mixer, utilities, s[0], state)[0] for s in situations(sizes)}
        families.append([tables[terminated, ongoing][m] for terminated, ongoing, m in rows(sizes)])
    families = np.array(families) / np.std(families, axis=1, keepdims=True)
    assert residuals(name, sizes, families).max() < 1e-3


@pytest.mark.parametrize("sizes", [(2, 2), (3, 3), (2, 3, 2)], ids=str)
def test_as_shipped_only_additive_tables_serve_all_situations(sizes):
    """The tables that are the same in every situation: as shipped the additive ones, 1 + sum_i (|M^i| - 1)."""
    one_table = np.array([[m == joint for joint in np.ndindex(*sizes)] for *_, m in rows(sizes)], float)
    order = [tuple(range(size))[::-1] for size in sizes]
    dimension = {}
    for name in ("VDN", "literal", "as shipped", "told m^-"):
        columns, _ = cone_of(name, sizes, order)
        ranks = [np.linalg.matrix_rank(x) for x in (columns, one_table, np.hstack([columns, one_table]))]
        dimension[name] = ranks[0] + ranks[1] - ranks[2]
    additive, all_of_them = 1 + sum(sizes) - len(sizes), np.prod(sizes)
    assert dimension == {"VDN": additive, "as shipped": additive, "literal": all_of_them, "told m^-": all_of_them}
    columns = {name: cone_of(name, sizes, order)[0] for name in ("VDN", "as shipped")}
    assert np.linalg.matrix_rank(columns["VDN"]) == additive
    assert np.linalg.matrix_rank(np.hstack(list(columns.values()))) == np.linalg.matrix_rank(columns["as shipped"])


@pytest.mark.parametrize("name", ["as shipped", "told m^-"])
def test_as_shipped_a_situations_value_is_additive_in_m_minus(name):
    """Agent 1 chooses, 2 and 3 go on. The best value for each m^- = (x, y), as shipped: v00 + v11 = v01 + v10."""
    rng, sizes = np.random.default_rng(7), (3, 2, 2)
    utilities, _, _, state = random_batch(sizes, 50, rng)
    q = joint_tables(random_network(MIXERS[name], sizes, rng, 2.0), utilities, (True, False, False), state)
    v = q.max(1)
    interaction = np.abs(v[:, 0, 0] + v[:, 1, 1] - v[:, 0, 1] - v[:, 1, 0]) / np.abs(v).max()
    assert interaction.max() < 1e-12 if name == "as shipped" else np.median(interaction) > 1e-3


@pytest.mark.parametrize(
    ("make", "tell", "free"),
    [(QPLEXMixer, False, False), (QPLEXMixer, True, True), (SeeOngoing, False, True)],
    ids=["as shipped", "as shipped, who chose in s", "told m^-"],
)
def test_weights_that_do_not_see_the_situation_tie_situations_together(make, tell, free):
    """Agent 1 deviates alone, agent 2 greedy or going on with it: as shipped its losses keep their proportions.

    However many heads there are; one is free as soon as it sees who chose.
    """
    rng, utilities = np.random.default_rng(8), [np.array([[2.0, 1.0, 0.0]]), np.array([[1.0, 0.0, 0.0]])]
    mixer = random_network(partial(make, heads=1 if free else 4), (3, 3), rng, 2.0)
    ratios = []
    for terminated in ((True, True), (True, False)):
        state = np.array([[1.0, *(terminated if tell else (0, 0))]])
        (q,) = joint_tables(mixer, utilities, terminated, state)
        ratios.append((q[0, 0] - q[1, 0]) / (q[0, 0] - q[2, 0]))
    assert (abs(ratios[0] / ratios[1] - 1) > 1e-3) == free


def test_qmix_has_rising_differences():
    """One layer of ELU, which is convex, under positive weights: at a fixed state utilities are no substitutes."""
    rng = np.random.default_rng(9)
    for gain in (0.5, 2.0, 8.0):
        utilities, _, _, state = random_batch((2, 2), 500, rng)
        utilities = [np.sort(u) for u in utilities]
        q = joint_tables(random_network(MIXERS["QMIX"], (2, 2), rng, gain), utilities, (True, True), state)
        rise = q[:, 1, 1] + q[:, 0, 0] - q[:, 0, 1] - q[:, 1, 0]
        assert rise.min() >= -1e-12 * np.abs(q).max() and rise.max() > 0


def test_qmix_represents_both_are_needed_but_not_one_is_enough():
    """Of the monotone tables (Eq. 1), [[1, 0], [0, 0]] by one unit; [[1, 1], [1, 0]] lacks rising differences."""
    mixer, c = MIXERS["QMIX"]((2, 2), 1).double().requires_grad_(False), 40.0
    for parameter in mixer.parameters():
        parameter.zero_()
    mixer.weight_1[-1].bias.view(2, -1)[:, 0] = 1.0  # ELU(Q_1 + Q_2 - 2 c) + 1 with Q_i = (c, 0)
    mixer.bias_1.bias[0] = -2 * c
    mixer.weight_2[-1].bias[0] = mixer.bias_2[-1].bias[0] = 1.0
    (q,) = joint_tables(mixer, [np.array([[c, 0.0]])] * 2, (True, True), np.zeros((1, 1)))
    assert np.allclose(q, [[1, 0], [0, 0]], rtol=0, atol=1e-12)
    one_is_enough = np.array([[1.0 - (m == (1, 1)) for *_, m in rows((2, 2))]])
    assert residuals("monotone", (2, 2), one_is_enough)[0] < 1e-4
    assert residuals("QMIX", (2, 2), one_is_enough)[0] > 0.2


@pytest.fixture(scope="module")
def families():
    """{kind: float64 [4, rows]} of mean 0 and variance 1, 2 agents x 3 macro-actions."""
    rng, result = np.random.default_rng(0), {}
    for kind in FAMILIES:
        drawn = np.array([random_family(kind, (3, 3), rng) for _ in range(4)])
        result[kind] = (drawn - drawn.mean(1, keepdims=True)) / drawn.std(1, keepdims=True)
    return result


@pytest.mark.parametrize("kind", FAMILIES)
def test_classes_side_by_side(kind, families):
    error = {name: residuals(name, (3, 3), families[kind]) for name in CLASSES}
    exact = {
        "additive": set(CLASSES),
        "one table": {"literal", "told m^-"},
        "a table each": {"told m^-"},
    }[kind]
    for name in CLASSES:
        assert error[name].max() < 1e-3 if name in exact else np.median(error[name]) > 0.02
    slack = 1e-4
    assert (error["VDN"] >= error["QMIX"] - slack).all() and (error["VDN"] >= error["as shipped"] - slack).all()
    assert (error["QMIX"] >= error["monotone"] - slack).all()
    assert (error["monotone"] >= error["literal"] - slack).all()


@pytest.mark.parametrize(
    ("name", "kind"), [("told m^-", "one table"), ("told m^-", "a table each"), ("as shipped", "one table")]
)
def test_trained_mixers_reach_their_class_and_no_more(name, kind, families):
    target = families[kind][:2]
    bound, trained = residuals(name, (3, 3), target), fit(MIXERS[name], (3, 3), target, 500, 0.01)
    assert (trained >= bound - 1e-4).all() and (trained <= bound + 0.1).all()


def test_conditioning_changes_nothing_where_all_have_terminated():
    """Then it is the published QPLEX; in every other situation it is not."""
    rng, sizes = np.random.default_rng(10), (3, 2, 4)
    mixer = random_network(MIXERS["as shipped"], sizes, rng)
    literal = MIXERS["literal"](sizes, 3).double()
    literal.load_state_dict(mixer.state_dict())
    utilities, _, _, state = random_batch(sizes, 20, rng)
    tables = [joint_tables(m, utilities, (True,) * 3, state) for m in (mixer, literal)]
    assert np.array_equal(*tables)
    for situation in itertools.islice(situations(sizes), 1, 20):
        assert not np.array_equal(*(joint_tables(m, utilities, situation[0], state) for m in (mixer, literal)))
