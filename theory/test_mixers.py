"""The mixers of the scripts: which satisfy Mac-IGM, how QPLEX breaks it, and what each can represent."""

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

import avf_qmix
import avf_qplex
import envs
from avf_qmix import QMIXMixer
from avf_qplex import QPLEXMixer
from theory.expressiveness import (
    CLASSES,
    FAMILIES,
    MIXERS,
    breaks,
    cone,
    duplex_tables,
    fit,
    joint_tables,
    literal_qplex,
    random_family,
    represent,
    residuals,
    rows,
    standardised,
)
from theory.igm import (
    TIES,
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
from theory.test_igm import NUMBERS, SEEDS, all_free, can, matrix, own
from theory.variants import Dueling, ToldAvailable, own_actions, two_by_two, with_lambda_of_state


def literal_with_lambda_of_state(own_actions, state_size):
    return with_lambda_of_state(literal_qplex(own_actions, state_size))


def dueling_with_lambda_of_state(own_actions, state_size):
    return with_lambda_of_state(Dueling(own_actions, state_size))


ALWAYS = {  # what satisfies Mac-IGM at any weights
    "VDN": MIXERS["VDN"],
    "QMIX": MIXERS["QMIX"],
    "as shipped": MIXERS["as shipped"],
    "b told": MIXERS["b told"],
    "lambda told": MIXERS["lambda told"],
    "told available": MIXERS["told available"],
    "lambda(s), literal": literal_with_lambda_of_state,
    "lambda(s), dueling": dueling_with_lambda_of_state,
}
# lambda(s) is a sum over agents in disguise, so it rises with every utility.
MONOTONE = ("VDN", "QMIX", "lambda(s), literal", "lambda(s), dueling")
TOLERANCE = 1e-9  # of the table's values: floating point breaks ties of the exact numbers
SIZES = [
    (2, 2),
    (3, 3),
    (5, 2),
    (2, 2, 2),
    (3, 2, 4),
    (2, 2, 2, 2),
]
every_consistent_mixer = pytest.mark.parametrize("name", ALWAYS)
of_many_sizes = pytest.mark.parametrize("sizes", SIZES, ids=str)


def random_network(make, sizes, rng, gain=1.0, width=3):
    """A mixer in float64 with weights N(0, gain^2 / inputs), for states of the given width."""
    return randomised(make(own_actions(sizes), width), rng, gain)


def randomised(mixer, rng, gain):
    mixer = mixer.double().requires_grad_(False)
    for parameter in mixer.parameters():
        inputs = parameter.shape[-1] if parameter.ndim > 1 else 1
        weights = torch.from_numpy(rng.normal(size=parameter.shape))
        parameter.copy_(gain * weights / inputs**0.5)
    return mixer


def zeroed(mixer):
    mixer = mixer.double().requires_grad_(False)
    for parameter in mixer.parameters():
        parameter.zero_()
    return mixer


def one_table(mixer, utilities, available, state=(0.0,), values=None):
    """The table of a mixer for one set of utilities, n arrays [|M^i|]."""
    batch_of_one = [u[None] for u in utilities]
    (q,) = joint_tables(mixer, batch_of_one, available, np.array([state]), values)
    return q


def verdicts_of(q, utilities, available, tolerance):
    """Whether Mac-IGM holds in each reading. Joint values that differ by no more than the tolerance count as equal."""
    batch = [u[None] for u in utilities]
    return [mac_igm_batch(q[None], batch, available, ties, tolerance)[0].item() for ties in TIES]


def close(q, *rows):
    return np.allclose(q, matrix(*rows), rtol=0, atol=1e-8)


def interaction(q):
    """By how much two changes together bring more than the sum of both alone; q: [batch, 2, 2]."""
    both = q[:, 1, 1] - q[:, 0, 0]
    one = q[:, 1, 0] - q[:, 0, 0]
    other = q[:, 0, 1] - q[:, 0, 0]
    return both - one - other


def relative_loss(q, utilities, available):
    """What the worst tuple of greedy choices loses (ties="every"), over the size of the values; float64 [batch]."""
    _, loss = mac_igm_batch(q, utilities, available)
    size = np.abs(q).reshape(len(q), -1).max(1)
    for u in utilities:
        size = np.maximum(size, np.abs(u).max(1))
    return loss / np.maximum(size, 1e-300)


def random_utilities(sizes, count, rng):
    """N(0, 1), n arrays [count, |M^i|]."""
    return [rng.normal(size=(count, size)) for size in sizes]


def random_available(sizes, count, rng):
    """What is available: to each agent all macro-actions, one (as if it were busy), or any set.

    These are n arrays [count, |M^i|]. In the first of the batch everything is available.
    """
    running = rng.integers(sizes, size=(count, len(sizes)))
    available = paper_available(sizes, rng.random(running.shape) < 0.5, running)
    for i, size in enumerate(sizes):
        any_set = rng.random((count, size)) < 0.5
        any_set[np.arange(count), running[:, i]] = True  # not the empty one
        has_initiation_set = rng.random(count) < 0.4
        available[i] = np.where(has_initiation_set[:, None], any_set, available[i])
        available[i][0] = True
    return available


def random_free_or_busy(sizes, count, rng):
    """What is available in the paper's situations, at random."""
    free = rng.random((count, len(sizes))) < 0.5
    return paper_available(sizes, free, rng.integers(sizes, size=free.shape))


# ---- what holds at any weights --------------------------------------------------------------------------------------
@pytest.mark.slow
@every_consistent_mixer
@settings(deadline=None, max_examples=100)
@given(data=st.data())
def test_mac_igm_at_any_weights(name, data):
    """Adversarial utilities, at random states, all agents free (IGM), some busy, some with initiation sets."""
    sizes = data.draw(st.lists(st.integers(2, 5), min_size=1, max_size=4))
    pool = data.draw(st.lists(NUMBERS, min_size=1, max_size=6))
    rng = np.random.default_rng(data.draw(SEEDS))
    more_numbers = rng.normal(size=data.draw(st.sampled_from([0, 9])))
    pool = np.clip([*pool, *more_numbers], -1e290, 1e290)
    gain = data.draw(st.sampled_from([0.0, 0.1, 1.0, 10.0]))
    mixer = random_network(ALWAYS[name], sizes, rng, gain)
    utilities = [np.repeat(rng.choice(pool, (1, size)), 16, axis=0) for size in sizes]
    available = random_available(sizes, 16, rng)
    state = rng.normal(size=(16, 3))
    values = rng.choice(pool, len(sizes)) if name.endswith("dueling") else None
    q = joint_tables(mixer, utilities, available, state, values)
    assert (relative_loss(q, utilities, available) <= TOLERANCE).all()


@pytest.mark.slow
@every_consistent_mixer
@of_many_sizes
def test_mac_igm_on_many_tables(name, sizes):
    rng = np.random.default_rng(0)
    for gain in (0.5, 2.0, 8.0):
        mixer = random_network(ALWAYS[name], sizes, rng, gain)
        utilities = random_utilities(sizes, 300, rng)
        state = rng.normal(size=(300, 3))
        values = rng.normal(size=(300, len(sizes))) if name.endswith("dueling") else None
        for draw in (random_free_or_busy, random_available):
            available = draw(sizes, 300, rng)
            q = joint_tables(mixer, utilities, available, state, values)
            assert (relative_loss(q, utilities, available) <= TOLERANCE).all()


@pytest.mark.parametrize("name", ["VDN", "QMIX", "as shipped"])
def test_mac_igm_with_every_combination_of_initiation_sets(name):
    """All 49 of two agents with three macro-actions each, by the definition; literal QPLEX fails most of them."""
    rng = np.random.default_rng(13)
    sizes = (3, 3)
    mixer = random_network(MIXERS[name], sizes, rng, 2.0)
    literal = random_network(MIXERS["literal"], sizes, rng, 2.0)
    utilities = random_utilities(sizes, 40, rng)
    state = rng.normal(size=(40, 3))
    broken = set()
    for available in initiation_sets(sizes):
        q = joint_tables(mixer, utilities, available, state)
        for table, *of_agents in zip(q, *utilities, strict=True):
            assert mac_igm(table, of_agents, available, "every")
        q = joint_tables(literal, utilities, available, state)
        if (relative_loss(q, utilities, available) > TOLERANCE).any():
            broken.add(available)
    assert len(broken) > 20
    nobody_is_busy = [available for available in broken if min(map(sum, available)) > 1]
    assert nobody_is_busy, "literal QPLEX fails there, too"


@pytest.mark.parametrize("env_id", ["bp-10", "wtd-d"])
@pytest.mark.parametrize("script", [avf_qmix, avf_qplex], ids=lambda script: script.__name__)
def test_mac_igm_of_the_mixer_that_a_run_trains(script, env_id):
    """All settings as shipped: the mixer of `make_learner`, for the tasks' macro-actions and states."""
    env = envs.make(env_id)
    args = script.parse_args([f"--env={env_id}"])
    rng = np.random.default_rng(12)
    mixer = randomised(script.make_learner(args, env)["mixer"], rng, 2.0)
    utilities = random_utilities(env.n_actions, 300, rng)
    state = rng.normal(size=(300, env.n_agents * env.state_size))  # joint, the default
    for draw in (random_free_or_busy, random_available):
        available = draw(env.n_actions, 300, rng)
        q = joint_tables(mixer, utilities, available, state)
        assert (relative_loss(q, utilities, available) <= TOLERANCE).all()


@pytest.mark.parametrize("name", MONOTONE)
def test_rises_with_every_utility(name):
    """Eq. 1, by the derivative and by differences, in the chosen macro-actions' utilities; V_i is held."""
    rng = np.random.default_rng(1)
    sizes = (4, 4, 4)
    for gain in (0.5, 2.0, 8.0):
        mixer = random_network(ALWAYS[name], sizes, rng, gain)
        actions = torch.from_numpy(rng.integers(4, size=(500, 3)))
        columns = 5 if name.endswith("dueling") else 4
        utilities = torch.from_numpy(rng.normal(size=(500, 3, columns)))
        if name.endswith("literal"):
            # V_i is the maximum, which is to stay where it is: the last macro-action is highest, and not chosen.
            utilities[..., 3] = 10.0
            actions = actions.clamp(max=2)
        available = torch.from_numpy(np.stack(random_free_or_busy(sizes, 500, rng), 1))
        state = torch.from_numpy(rng.normal(size=(500, 3)))
        chosen = torch.nn.functional.one_hot(actions, columns)
        utilities.requires_grad_()
        q = mixer(utilities, actions, available, state)
        (slope,) = torch.autograd.grad(q.sum(), utilities)
        slope = slope.gather(-1, actions[..., None])
        assert (slope >= 0).all()
        assert (slope > 0).any()
        rise = torch.from_numpy(rng.random((500, 3, 1)))
        with torch.no_grad():
            change = mixer(utilities + rise * chosen, actions, available, state) - q
        assert change.min() >= -1e-12 * change.max()
        assert change.max() > 0


# ---- the ties of the mixers ("equal") -------------------------------------------------------------------------------
@pytest.mark.parametrize("what", ["w_i", "key"])
def test_epsilon_keeps_apart_what_utilities_keep_apart(what):
    """Where the network says 0, w_i and the key are 1e-10: QPLEX has no tie that utilities do not have ("equal").

    All other terms are of the size of 1, so such a difference is well above the rounding of float64.
    """
    rng = np.random.default_rng(2)
    mixer = random_network(QPLEXMixer, (3, 3), rng)
    outputs = {"w_i": slice(0, 2), "key": slice(4, 4 + mixer.heads)}[what]
    last = mixer.state_net[-1]
    last.weight[outputs] = 0.0
    last.bias[outputs] = 0.0
    utilities = own("2 1 0", "0 1 2")
    for available in initiation_sets((3, 3)):
        q = one_table(mixer, utilities, available, (1.0, 1.0, 1.0))
        assert mac_igm(q, utilities, available, "equal")


@pytest.mark.parametrize(
    ("what", "in_float64"),
    [("key", True), ("w_i", True), ("agent_i", False)],
)
def test_epsilon_is_lost_in_the_rounding_of_float32(what, in_float64):
    """In which the scripts train. A key or w_i of 0 makes all that is open worth the same: "equal" fails.

    The sigmoid of agent_i = -1000 is 0 in both. The tolerances are above the rounding of sums, and in float64 below the
    1e-10 that keep joint values apart.
    """
    utilities = own("2 1 0", "0 1 2")
    everything = all_free((3, 3))
    mixer = zeroed(QPLEXMixer(own_actions((3, 3)), 1))
    outputs = {"w_i": slice(0, 2), "b_i": slice(2, 4), "key": slice(4, 8), "agent_i": slice(8, 16)}
    bias = mixer.state_net[-1].bias
    bias.fill_(1.0)
    bias[outputs[what]] = -1000.0 if what == "agent_i" else 0.0
    for dtype, tolerance, holds in ((np.float64, 1e-13, in_float64), (np.float32, 1e-5, False)):
        own_part = [u[None].astype(dtype) for u in utilities]
        state = np.zeros((1, 1), dtype)
        mixer = mixer.to(torch.from_numpy(state).dtype)
        (q,) = joint_tables(mixer, own_part, everything, state)
        assert verdicts_of(q, utilities, everything, tolerance) == [holds, True, True]


@every_consistent_mixer
@of_many_sizes
def test_has_the_ties_of_its_utilities_and_no_others(name, sizes):
    """Weights of random networks are positive, so "equal" holds: the equation as written.

    Rounding is below the first tolerance and all differences are above the second: no value lies between them.
    """
    rng = np.random.default_rng(11)
    utilities = [np.round(u) for u in random_utilities(sizes, 300, rng)]
    available = random_available(sizes, 300, rng)
    state = rng.normal(size=(300, 3))
    values = np.round(rng.normal(size=len(sizes))) if name.endswith("dueling") else None
    mixer = random_network(ALWAYS[name], sizes, rng)
    q = joint_tables(mixer, utilities, available, state, values)
    scale = np.abs(q).reshape(300, -1).max(1)
    for tolerance in (1e-13, 1e-8):
        assert mac_igm_batch(q, utilities, available, "equal", tolerance * scale)[0].all()


def test_qmix_is_equal_where_each_agent_has_a_unit_with_positive_weights():
    """And only there: with other weights of 0 a utility moves nothing, and joint maximisers are not greedy."""
    rng = np.random.default_rng(14)
    utilities = own("1 0", "1 0")
    found = set()
    for _ in range(100):
        mixer = zeroed(QMIXMixer(2, 1, embed=3))
        weight_1 = rng.integers(2, size=(2, 3)).astype(float)
        weight_2 = rng.integers(2, size=3).astype(float)
        mixer.weight_1[-1].bias.copy_(torch.from_numpy(weight_1.ravel()))
        mixer.weight_2[-1].bias.copy_(torch.from_numpy(weight_2))
        q = one_table(mixer, utilities, all_free((2, 2)))
        each_has_one = (weight_1 * weight_2 > 0).any(1).all()
        assert verdicts_of(q, utilities, all_free((2, 2)), 1e-9) == [each_has_one, True, True]
        found.add(bool(each_has_one))
    assert found == {True, False}


@pytest.mark.parametrize("why", ["a weight is 0", "ELU is saturated"])
def test_qmix_can_be_flat_where_utilities_differ(why):
    """Then a joint maximiser is not greedy: "equal" fails and "every" holds."""
    mixer = zeroed(MIXERS["QMIX"](own_actions((2, 2)), 1))
    mixer.weight_2[-1].bias.fill_(1.0)
    mixer.weight_1[-1].bias.fill_(1.0)
    if why == "a weight is 0":
        of_agent_1 = mixer.weight_1[-1].bias.view(2, -1)[0]
        of_agent_1.zero_()
    else:
        mixer.bias_1.bias.fill_(-100.0)
    utilities = own("1 0", "1 0")
    q = one_table(mixer, utilities, all_free((2, 2)))
    assert verdicts_of(q, utilities, all_free((2, 2)), 1e-9) == [False, True, True]


# ---- how QPLEX breaks it --------------------------------------------------------------------------------------------
def test_smallest_counterexample_of_literal_qplex():
    """Q_1 = Q_2 = (1, 0), agent 2 goes on with b: greedy agent 1 takes a, worth -1; b: 0. README opens with it."""
    utilities = own("1 0", "1 0")
    goes_on = can("xx", ".x")
    q = one_table(two_by_two(mask_ongoing=False), utilities, goes_on)
    assert close(q, "2 -1", "1 0")
    lambda_1 = matrix("1 1", "1 1")  # [m_1, m_2]
    lambda_2 = matrix("3 3", "1 1")
    lambdas = np.stack([lambda_1, lambda_2])
    by_hand = 2 + duplex_tables([u[None] for u in utilities], lambdas[None])  # V_1 + V_2 = 2
    assert close(by_hand[0], "2 -1", "1 0")
    verdict = mac_igm(q, utilities, goes_on)
    assert not verdict
    assert verdict.action == (0, 1)
    assert verdict.margin == pytest.approx(1)
    assert igm(q, utilities)  # nothing is wrong with all agents free
    q = one_table(two_by_two(), utilities, goes_on)
    assert close(q[:, 1:], "1", "0")  # the same weights, as shipped
    assert mac_igm(q, utilities, goes_on)


def lambda_grows_threefold(make, sizes, place):
    """A QPLEX mixer with w_i = 1, b_i = 0 and lambda_i = 1, or 3 where an entry of the one-hot joint action is 1."""
    mixer = zeroed(make(own_actions(sizes), 1))
    log3 = np.log(3.0)  # sigmoid(log 3) = 3/4, sigmoid(-log 3) = 1/4
    n = len(sizes)
    last = mixer.state_net[-1]
    last.bias[:n] = 1.0  # w_i
    last.bias[2 * n : 2 * n + mixer.heads] = 8.0 / mixer.heads  # the keys
    mixer.action_net[0].weight[0, 1 + place] = 1.0  # behind the state
    mixer.action_net[-1].weight[:, 0] = 2 * log3
    mixer.action_net[-1].bias.fill_(-log3)
    return mixer


def test_the_same_with_an_initiation_set_and_nobody_busy():
    """Agent 2 has a third macro-action c, its best, which it cannot start. Both lambdas are 3 if agent 1 takes a."""
    mixer = lambda_grows_threefold(literal_qplex, (2, 3), place=0)
    utilities = own("1 0", "0.1 0 1.5")
    q = one_table(mixer, utilities, all_free((2, 3)))
    assert close(q, "-1.7 -2 2.5", "0.1 0 1.5")
    assert igm(q, utilities)
    verdict = mac_igm(q, utilities, can("xx", "xx."), "some")
    assert verdict.action == (0, 0)
    assert verdict.margin == pytest.approx(1.8)
    shipped = lambda_grows_threefold(QPLEXMixer, (2, 3), place=0)
    q = one_table(shipped, utilities, can("xx", "xx."))
    assert close(q[:, :2], "1.1 0.8", "0.1 0")
    assert mac_igm(q, utilities, can("xx", "xx."))


def test_there_is_no_smaller_counterexample():
    """lambda_i(m) in 1..L: none for L = 2; for L = 3 only if lambda_2(a, b) > lambda_1(b, b) + lambda_2(b, b)."""
    for levels in (2, 3):
        lambdas = 1.0 + np.indices((levels,) * 8).reshape(2, 2, 2, -1)
        lambdas = lambdas.transpose(3, 0, 1, 2)  # [batch, agent, m_1, m_2]
        utilities = [np.tile([1.0, 0.0], (len(lambdas), 1))] * 2
        q = duplex_tables(utilities, lambdas)
        goes_on_with_a, _ = mac_igm_batch(q, utilities, can("xx", "x."), "every")
        goes_on_with_b, _ = mac_igm_batch(q, utilities, can("xx", ".x"), "every")
        breaking = lambdas[:, 1, 0, 1] > lambdas[:, 0, 1, 1] + lambdas[:, 1, 1, 1]
        assert goes_on_with_a.all()
        assert np.array_equal(~goes_on_with_b, breaking)
        assert breaking.any() == (levels == 3)
    rng = np.random.default_rng(3)
    for sizes in [(5,), (5, 1), (1, 5)]:  # with one agent that has a choice
        utilities = random_utilities(sizes, 500, rng)
        q = duplex_tables(utilities, rng.random((500, len(sizes), *sizes)))
        for available in situations(sizes):
            assert mac_igm_batch(q, utilities, available, "every")[0].all()


@of_many_sizes
def test_literal_qplex_holds_if_busy_agents_run_greedy_macro_actions(sizes):
    rng = np.random.default_rng(4)
    for gain in (0.5, 2.0, 8.0):
        mixer = random_network(MIXERS["literal"], sizes, rng, gain)
        utilities = random_utilities(sizes, 300, rng)
        free = rng.random((300, len(sizes))) < 0.5
        running = np.stack([u.argmax(1) for u in utilities], -1)
        available = paper_available(sizes, free, running)
        q = joint_tables(mixer, utilities, available, rng.normal(size=(300, 3)))
        assert (relative_loss(q, utilities, available) <= TOLERANCE).all()


def told_but_not_conditioned(own_actions, state_size):
    return ToldAvailable(own_actions, state_size, mask_ongoing=False)


LITERAL = MIXERS["literal"]
SHIPPED = MIXERS["as shipped"]


@pytest.mark.parametrize(
    ("sizes", "busy_agents", "make", "low", "high"),
    [
        ((2, 2), 1, None, 0.09, 0.13),  # None: lambda free
        ((3, 3), 1, None, 0.20, 0.26),
        ((5, 5), 1, None, 0.35, 0.45),
        ((2, 2, 2), 2, None, 0.16, 0.24),
        ((3, 3, 3), 2, None, 0.31, 0.39),
        ((2, 2), 1, LITERAL, 0.002, 0.03),
        ((3, 3), 1, LITERAL, 0.005, 0.05),
        ((3, 3, 3), 2, LITERAL, 0.01, 0.08),
        ((3, 3, 3), 2, told_but_not_conditioned, 0.01, 0.08),
        ((3, 3, 3), 2, SHIPPED, 0, 0),
        ((3, 3, 3), 2, ToldAvailable, 0, 0),
    ],
)
def test_how_often_literal_qplex_breaks(sizes, busy_agents, make, low, high):
    """More with more macro-actions and agents; a fresh network, whose lambda varies little, 10 times less."""
    count = breaks(sizes, busy_agents, 2_000, 0, make)
    assert low <= count / 2_000 <= high


class Against(torch.nn.Module):
    """A joint value that falls with the utility of one agent and sees no other."""

    def __init__(self, agent):
        super().__init__()
        self.agent = agent

    def forward(self, utilities, actions, available, state):
        return -utilities.gather(-1, actions[..., None])[..., self.agent, 0]


@pytest.mark.parametrize(("agent", "count"), [(0, 0), (1, 30), (2, 30)])
def test_breaks_has_the_first_agents_busy_and_the_others_choose(agent, count):
    """By hand, agent 1 busy: a value against what agent 1 does breaks nothing, one against another agent each time."""
    assert breaks((3, 2, 4), 1, 30, 0, lambda own, state_size: Against(agent)) == count


# ---- dueling heads --------------------------------------------------------------------------------------------------
def test_free_signs_with_lambda_of_the_joint_action_break_igm_with_one_agent():
    """V = 0, A = (2, 1), lambda = (1, 3): Q = (2, 3). With V = max and the same lambda: Q = (2, -1)."""
    utilities = own("2 1")
    mixer = lambda_grows_threefold(Dueling, (2,), place=1)
    q = one_table(mixer, utilities, all_free((2,)), values=[0.0])
    assert close(q, "2 3")
    assert not igm(q, utilities, "some")
    mixer = lambda_grows_threefold(literal_qplex, (2,), place=1)
    q = one_table(mixer, utilities, all_free((2,)))
    assert close(q, "2 -1")
    assert igm(q, utilities)


def test_free_signs_break_the_architecture_and_not_the_definition():
    """Def. 3.3 with V = 0 and A = (2, 1): a sum satisfies it, the duplex formula with lambda(s, m) does not."""
    utilities = own("2 1")
    everything = all_free((2,))
    mixer = lambda_grows_threefold(Dueling, (2,), place=1)
    duplex = one_table(mixer, utilities, everything, values=[0.0])
    a_sum = one_table(MIXERS["VDN"](None, 1), utilities, everything)
    for ties in TIES:
        assert macadv_igm(a_sum, utilities, everything, 0.0, [0.0], ties)
        assert not macadv_igm(duplex, utilities, everything, 0.0, [0.0], ties)


def test_free_signs_with_lambda_of_the_joint_action_break_most_tables():
    rng = np.random.default_rng(5)
    sizes = (3, 3)
    utilities = random_utilities(sizes, 1_000, rng)
    values = rng.normal(size=(1_000, 2))
    lambda_1, lambda_2 = np.abs(rng.normal(size=(2, 1_000, *sizes)))
    advantage_1 = utilities[0] - values[:, :1]
    advantage_2 = utilities[1] - values[:, 1:]
    free = lambda_1 * advantage_1[:, :, None] + lambda_2 * advantage_2[:, None, :]  # V_1 + V_2 changes nothing
    holds, _ = mac_igm_batch(free, utilities, all_free(sizes), "every")
    assert holds.mean() < 0.5
    mixer = random_network(Dueling, sizes, rng, 2.0)
    state = rng.normal(size=(1_000, 3))
    q = joint_tables(mixer, utilities, all_free(sizes), state, values)
    breaks_it = relative_loss(q, utilities, all_free(sizes)) > TOLERANCE
    assert breaks_it.mean() > 0.1


# ---- expressiveness -------------------------------------------------------------------------------------------------
@st.composite
def consistent_families(draw):
    """(utilities, {available: table}) that satisfy Mac-IGM with ties="every"; ties in both, tables of any size.

    They are for all situations, and for some combinations of initiation sets.
    """
    sizes = draw(st.lists(st.integers(1, 3), min_size=1, max_size=3))
    rng = np.random.default_rng(draw(SEEDS))
    scale = draw(st.sampled_from([1e-6, 1.0, 1e6]))
    levels = draw(st.sampled_from([2, 3, 10**6]))
    utilities = [scale * rng.integers(levels, size=size) for size in sizes]
    every = initiation_sets(sizes)
    some = [every[k] for k in rng.integers(len(every), size=10)]
    tables = {}
    for available in situations(sizes) + some:
        unit = draw(st.sampled_from([1e-3, 1.0]))
        table = unit * rng.integers(-levels, levels, size=sizes)
        for greedy in local_choices(utilities, available):
            table[greedy] = levels * unit
        tables[available] = table
    return utilities, tables


@settings(deadline=None, max_examples=60)
@given(consistent_families())
def test_qplex_told_what_is_available_represents_every_mac_igm_family(family):
    """A table of its own for every situation, one set of utilities and weights, in the mixer of the script."""
    utilities, tables = family
    mixer = represent(utilities, tables)
    largest_utility = max(np.abs(u).max() for u in utilities)
    for available, table in tables.items():
        q = one_table(mixer, utilities, available)
        size = np.abs(table).max() + largest_utility
        for m in open_actions(available):
            assert abs(q[m] - table[m]) <= 1e-7 * size


def test_the_revisions_lambda_loses_a_part_where_not_all_agents_deviate():
    """Its proof (Appendix B) charges each of n agents a share 1/n of the loss, which those with A_i = 0 do not carry.

    By hand, V = 4, so at (b, a) agent 1 alone carries 1/2 of the loss of 1. Shared among those who deviate it is right.
    """
    q = matrix("4 3", "3 0")
    utilities = [u[None] for u in own("1 0", "1 0")]
    advantage = matrix("0 0", "-1 -1"), matrix("0 -1", "0 -1")  # A_1, A_2 by [m_1, m_2]
    deviators = sum(a < 0 for a in advantage)
    for shares, expected in ((2, ["4 3.5", "3.5 0"]), (np.maximum(deviators, 1), ["4 3", "3 0"])):
        lambdas = []
        for a in advantage:
            own_loss = np.where(a < 0, a, 1.0)
            lambdas.append(np.where(a < 0, (q - 4) / shares / own_loss, 1.0))
        made = 4 + duplex_tables(utilities, np.stack(lambdas)[None])
        assert close(made[0], *expected)


@pytest.mark.slow
@pytest.mark.parametrize("name", CLASSES)
def test_networks_lie_in_the_class_stated_for_them(name):
    """The cones that `residuals` measures against contain what the mixers compute, in all situations together."""
    rng = np.random.default_rng(6)
    sizes = (3, 2)
    make = MIXERS["QMIX" if name == "monotone" else name]
    families = []
    for _ in range(6):
        mixer = random_network(make, sizes, rng, 2.0)
        utilities = random_utilities(sizes, 1, rng)
        state = rng.normal(size=(1, 3))
        tables = {}
        for available in situations(sizes):
            (tables[available],) = joint_tables(mixer, utilities, available, state)
        families.append([tables[available][m] for available, m in rows(sizes)])
    families = np.array(families)
    families = families / families.std(axis=1, keepdims=True)
    assert residuals(name, sizes, families).max() < 1e-3


@pytest.mark.parametrize("sizes", [(2, 2), (3, 3), (2, 3, 2)], ids=str)
def test_as_shipped_only_additive_tables_serve_all_situations(sizes):
    """The tables that are the same in every situation: as shipped the additive ones, 1 + sum_i (|M^i| - 1).

    So it is if the b_i see the situation. If the lambda_i see it, a table is additive where some agent is greedy, and
    free elsewhere, which 2 agents can make up for by their utilities.
    """
    joint_actions = list(np.ndindex(*sizes))
    one_table = np.array([[m == joint for joint in joint_actions] for _, m in rows(sizes)], float)
    order = [tuple(range(size))[::-1] for size in sizes]
    columns = {}
    dimension = {}
    for name in ("VDN", "literal", "as shipped", "b told", "lambda told", "told available"):
        columns[name], _ = cone(name, sizes, order)
        together = np.hstack([columns[name], one_table])
        ranks = [np.linalg.matrix_rank(x) for x in (columns[name], one_table, together)]
        dimension[name] = ranks[0] + ranks[1] - ranks[2]  # of the intersection
    additive = 1 + sum(sizes) - len(sizes)
    everything = np.prod(sizes)
    nobody_greedy = np.prod([size - 1 for size in sizes])
    assert dimension == {
        "VDN": additive,
        "literal": everything,
        "as shipped": additive,
        "b told": additive,
        "lambda told": additive + nobody_greedy,
        "told available": everything,
    }
    assert (additive + nobody_greedy == everything) == (len(sizes) == 2)
    assert np.linalg.matrix_rank(columns["VDN"]) == additive
    both = np.hstack([columns["VDN"], columns["as shipped"]])
    assert np.linalg.matrix_rank(both) == np.linalg.matrix_rank(columns["as shipped"])


@pytest.mark.parametrize("name", ["as shipped", "b told", "lambda told", "told available"])
def test_as_shipped_a_situations_value_is_additive_in_m_minus(name):
    """Agent 1 chooses, 2 and 3 go on. The best value for each m^- = (x, y), as shipped: v00 + v11 = v01 + v10.

    Only b_i (or w_i) that sees m^- changes that, not lambda_i.
    """
    rng = np.random.default_rng(7)
    sizes = (3, 2, 2)
    mixer = random_network(MIXERS[name], sizes, rng, 2.0)
    utilities = random_utilities(sizes, 50, rng)
    state = rng.normal(size=(50, 3))
    v = np.zeros((50, 2, 2))
    for x, y in np.ndindex(2, 2):
        available = paper_available(sizes, (True, False, False), (0, x, y))
        q = joint_tables(mixer, utilities, available, state)
        v[:, x, y] = q[:, :, x, y].max(1)
    found = np.abs(interaction(v)) / np.abs(v).max()
    if name in ("as shipped", "lambda told"):
        assert found.max() < 1e-12
    else:
        assert np.median(found) > 1e-3


def one_head(own_actions, state_size):
    return QPLEXMixer(own_actions, state_size, heads=1)


def one_head_told(own_actions, state_size):
    return ToldAvailable(own_actions, state_size, heads=1)


@pytest.mark.parametrize(
    ("make", "state_tells", "is_free"),
    [
        (QPLEXMixer, False, False),
        (one_head, True, True),
        (MIXERS["b told"], False, False),
        (MIXERS["lambda told"], False, True),
        (one_head_told, False, True),
    ],
    ids=["as shipped", "as shipped, who is free in s", "b told", "lambda told", "told available"],
)
def test_weights_that_do_not_see_the_situation_tie_situations_together(make, state_tells, is_free):
    """Agent 1 deviates alone, agent 2 greedy or going on with it: as shipped its losses keep their proportions.

    However many heads there are; one is free as soon as it sees who chose.
    """
    rng = np.random.default_rng(8)
    utilities = own("2 1 0", "1 0 0")
    mixer = random_network(make, (3, 3), rng, 2.0)
    ratios = []
    for available in (can("xxx", "xxx"), can("xxx", "x..")):
        second_is_free = available[1].all()
        told = (1.0, second_is_free) if state_tells else (0.0, 0.0)
        q = one_table(mixer, utilities, available, (1.0, *told))
        loss_of_b = q[0, 0] - q[1, 0]
        loss_of_c = q[0, 0] - q[2, 0]
        ratios.append(loss_of_b / loss_of_c)
    differs = abs(ratios[0] / ratios[1] - 1) > 1e-3
    assert differs == is_free


def test_qmix_has_rising_differences():
    """One layer of ELU, which is convex, under positive weights: at a fixed state utilities are no substitutes."""
    rng = np.random.default_rng(9)
    for gain in (0.5, 2.0, 8.0):
        utilities = [np.sort(u) for u in random_utilities((2, 2), 500, rng)]
        mixer = random_network(MIXERS["QMIX"], (2, 2), rng, gain)
        state = rng.normal(size=(500, 3))
        found = interaction(joint_tables(mixer, utilities, all_free((2, 2)), state))
        assert found.min() >= -1e-12 * found.max()
        assert found.max() > 0


def test_qmix_represents_both_are_needed_but_not_one_is_enough():
    """Of the monotone tables (Eq. 1), [[1, 0], [0, 0]] by one unit; [[1, 1], [1, 0]] lacks rising differences."""
    mixer = zeroed(MIXERS["QMIX"](own_actions((2, 2)), 1))
    weight_1 = mixer.weight_1[-1].bias.view(2, -1)
    weight_1[:, 0] = 1.0  # ELU(Q_1 + Q_2 - 80) + 1 with Q_i = (40, 0)
    mixer.bias_1.bias[0] = -80.0
    mixer.weight_2[-1].bias[0] = 1.0
    mixer.bias_2[-1].bias[0] = 1.0
    q = one_table(mixer, own("40 0", "40 0"), all_free((2, 2)))
    assert close(q, "1 0", "0 0")
    one_is_enough = [0.0 if m == (1, 1) else 1.0 for _, m in rows((2, 2))]
    one_is_enough = np.array([one_is_enough])
    assert residuals("monotone", (2, 2), one_is_enough)[0] < 1e-4
    assert residuals("QMIX", (2, 2), one_is_enough)[0] > 0.2


@pytest.fixture(scope="module")
def families():
    """{kind: float64 [4, rows]} of mean 0 and variance 1, 2 agents x 3 macro-actions."""
    rng = np.random.default_rng(0)
    result = {}
    for kind in FAMILIES:
        drawn = [random_family(kind, (3, 3), rng) for _ in range(4)]
        result[kind] = standardised(drawn)
    return result


REPRESENTED = {  # by which classes
    "additive": set(CLASSES),
    "one table": {"literal", "lambda told", "told available"},  # lambda told: of 2 agents
    "a table each": {"told available"},
}


WIDER = [  # pairs of classes of which the second contains the first
    ("VDN", "QMIX"),
    ("VDN", "as shipped"),
    ("QMIX", "monotone"),
    ("monotone", "literal"),
    ("as shipped", "b told"),
    ("as shipped", "lambda told"),
    ("b told", "told available"),
    ("lambda told", "told available"),
]


@pytest.mark.slow
@pytest.mark.parametrize("kind", FAMILIES)
def test_classes_side_by_side(kind, families):
    error = {}
    for name in CLASSES:
        error[name] = residuals(name, (3, 3), families[kind])
        if name in REPRESENTED[kind]:
            assert error[name].max() < 1e-3
        else:
            assert np.median(error[name]) > 0.02
    for narrow, wide in WIDER:
        assert (error[narrow] >= error[wide] - 1e-4).all()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "kind"),
    [("told available", "one table"), ("told available", "a table each"), ("as shipped", "one table")],
)
def test_trained_mixers_reach_their_class_and_no_more(name, kind, families):
    target = families[kind][:2]
    bound = residuals(name, (3, 3), target)
    trained = fit(MIXERS[name], (3, 3), target, 500, 0.01)
    assert (trained >= bound - 1e-4).all()
    assert (trained <= bound + 0.1).all()


def test_conditioning_changes_nothing_where_all_are_free():
    """Then it is the published QPLEX. It is another one wherever a busy agent runs what is not its best."""
    rng = np.random.default_rng(10)
    sizes = (3, 2, 4)
    shipped = random_network(MIXERS["as shipped"], sizes, rng)
    literal = MIXERS["literal"](own_actions(sizes), 3).double()
    literal.load_state_dict(shipped.state_dict())
    utilities = random_utilities(sizes, 20, rng)
    state = rng.normal(size=(20, 3))
    for available in situations(sizes):
        first = joint_tables(shipped, utilities, available, state)
        second = joint_tables(literal, utilities, available, state)
        best_is_available = np.ones(20, bool)
        for u, mask in zip(utilities, available, strict=True):
            best_is_available &= np.array(mask)[u.argmax(1)]
        for k in range(20):
            same = [first[k][m] == second[k][m] for m in open_actions(available)]
            assert all(same) if best_is_available[k] else not any(same)
