"""Which value tables the mixers represent, and how often QPLEX without conditioning breaks Mac-IGM.

One joint macro-history h and one mixer state are fixed, so that a mixer is a family of tables Q(h, .), one for each
situation. A situation says what is available to each agent. Names, besides those of `igm.py`:

    rows         every (situation, m): a situation in which an agent is free, and a joint action m that it leaves open
    family       a value for each row
    greedy       what is best by an agent's own utilities

`python -m theory.expressiveness` prints the tables of README.md.
"""

import argparse
import itertools
import sys
from functools import cache

import numpy as np
import torch
from torch.func import functional_call, stack_module_state, vmap

from avf_qmix import QMIXMixer
from avf_qplex import QPLEXMixer
from theory.igm import mac_igm_batch, open_actions, paper_available, situations
from theory.variants import ToldAvailable, ToldB, ToldLambda, VDNMixer, own_actions


def qplex(own, state_size):
    return QPLEXMixer(own, state_size)


def literal_qplex(own, state_size):
    return QPLEXMixer(own, state_size, mask_ongoing=False)


def qmix(own, state_size):
    return QMIXMixer(len(own), state_size)


def vdn(own, state_size):
    return VDNMixer()


# Each makes a mixer from the agents' own macro-actions, bool [n, A], and the size of the state.
MIXERS = {
    "VDN": vdn,
    "QMIX": qmix,
    "literal": literal_qplex,
    "as shipped": qplex,  # conditioned on what is available
    "b told": ToldB,  # conditioned, and b_i sees what is available
    "lambda told": ToldLambda,  # conditioned, and lambda_i sees it
    "told available": ToldAvailable,  # conditioned, and all weights see it
}


def padded(arrays, filler):
    """n arrays [batch, |M^i|] as one tensor [batch, n, A]."""
    widest = max(array.shape[-1] for array in arrays)
    columns = []
    for array in arrays:
        missing = widest - array.shape[-1]
        columns.append(np.pad(array, ((0, 0), (0, missing)), constant_values=filler))
    return torch.from_numpy(np.stack(columns, 1))


def joint_tables(mixer, utilities, available, state, values=None):
    """The mixer's value of every joint action. Values of those that are not available mean nothing.

    Args:
        mixer: called as the mixers of the scripts are, in float64. (All can be float32, too.)
        utilities: n float64 arrays [batch, |M^i|].
        available: n bool arrays [batch, |M^i|] or [|M^i|].
        state: float64 [batch, S].
        values: V_i, float64 [batch, n] or [n], for a `Dueling` mixer.

    Returns:
        float64 [batch, |M^1|, ..., |M^n|].
    """
    sizes = [u.shape[1] for u in utilities]
    batch = len(state)
    available = [np.broadcast_to(can, u.shape) for can, u in zip(available, utilities, strict=True)]
    utilities = padded(utilities, np.nan)  # no mixer may read the padding
    if values is not None:
        values = torch.from_numpy(np.broadcast_to(values, (batch, len(sizes))).copy())
        utilities = torch.cat([utilities, values[..., None]], -1)
    actions = torch.tensor(list(np.ndindex(*sizes)))  # [joint, n]

    def for_each_action(x):
        return x[:, None].expand(-1, len(actions), *x.shape[1:])

    with torch.no_grad():
        q = mixer(
            for_each_action(utilities),
            actions.expand(batch, -1, -1),
            for_each_action(padded(available, False)),
            for_each_action(torch.from_numpy(state)),
        )
    return q.reshape(batch, *sizes).numpy()


# ---- how often the literal mixer breaks Mac-IGM ---------------------------------------------------------------------
def duplex_tables(utilities, lambdas):
    """sum_i lambda_i(m) A_i(m_i), literal QPLEX up to a constant, with lambdas given instead of computed.

    Args:
        utilities: n arrays [batch, |M^i|].
        lambdas: [batch, n, |M^1|, ..., |M^n|].

    Returns:
        Array [batch, |M^1|, ..., |M^n|].
    """
    q = np.zeros_like(lambdas[:, 0])
    for i, u in enumerate(utilities):
        advantage = u - u.max(axis=1, keepdims=True)
        own_axis = [len(u)] + [1] * len(utilities)
        own_axis[i + 1] = u.shape[1]
        q = q + lambdas[:, i] * advantage.reshape(own_axis)
    return q


def breaks(sizes, busy_agents, count, seed, make=None, per_network=100):
    """How many random situations violate Mac-IGM ("every"): utilities N(0, 1), m^- uniform.

    Args:
        sizes: |M^i|, n ints.
        busy_agents: the first so many are busy.
        count: of situations.
        make: as in MIXERS. Networks are as initialised, with `per_network` situations for each, and states are N(0, 1)
            of width 4. None: the literal formula, with independent lambda_i(m), |N(0, 1)|.

    Returns:
        int.
    """
    rng = np.random.default_rng(seed)
    n = len(sizes)
    utilities = [rng.normal(size=(count, size)) for size in sizes]
    free = np.arange(n) >= busy_agents
    running = rng.integers(sizes, size=(count, n))
    available = paper_available(sizes, free, running)
    if make is None:
        lambdas = np.abs(rng.normal(size=(count, n, *sizes)))
        q = duplex_tables(utilities, lambdas)
    else:
        state = rng.normal(size=(count, 4))
        q = fresh_network_tables(make, utilities, available, state, seed, per_network)
    _, loss = mac_igm_batch(q, utilities, available)
    return int((loss > 1e-9 * np.abs(q).max()).sum())


def fresh_network_tables(make, utilities, available, state, seed, per_network):
    """`joint_tables` with a new network, as initialised, for every `per_network` of the batch."""
    own = own_actions([u.shape[1] for u in utilities])
    tables = []
    with torch.random.fork_rng():
        torch.manual_seed(seed)
        for start in range(0, len(state), per_network):
            part = slice(start, start + per_network)
            network = make(own, state.shape[1]).double()
            own_part = [u[part] for u in utilities], [can[part] for can in available]
            tables.append(joint_tables(network, *own_part, state[part]))
    return np.concatenate(tables)


# ---- families of tables ---------------------------------------------------------------------------------------------
def rows(sizes):
    """Every (available, m) of the paper's situations with a free agent; first come those in which all are free."""
    result = []
    for available in situations(sizes):
        somebody_is_free = any(sum(can) > 1 for can in available)
        if somebody_is_free:
            result.extend((available, m) for m in open_actions(available))
    return result


FAMILIES = ("additive", "one table", "a table each")


def random_family(kind, sizes, rng):
    """A family that satisfies Mac-IGM with macro-action 0 the greedy one of each agent; float64 [rows].

    "additive": one table for all situations, a sum of utilities. "one table": one for all situations, N(0, 1) under the
    condition that Mac-IGM holds. "a table each": N(0, 1) for each situation, its maximum moved to the greedy choices.
    """
    index = rows(sizes)
    if kind == "a table each":
        family = rng.normal(size=len(index))
        for situation in dict.fromkeys(available for available, _ in index):
            here = [k for k, (available, _) in enumerate(index) if available == situation]
            values = family[here]
            family[here] = np.roll(values, -values.argmax())  # the greedy choices come first
        return family
    while True:
        if kind == "additive":
            utilities = [np.sort(rng.normal(size=size))[::-1] for size in sizes]
            q = sum(np.ix_(*utilities))
        else:
            q = rng.normal(size=sizes)
        if is_consistent(q):
            return np.array([q[m] for _, m in index])


def is_consistent(q):
    """Whether macro-action 0 is best for each agent whatever the others do: Mac-IGM for every M^+ and m^-."""
    for axis in range(q.ndim):
        best = q.max(axis=axis, keepdims=True)
        if (q.take([0], axis=axis) < best).any():
            return False
    return True


# ---- the classes of mixers as cones ---------------------------------------------------------------------------------
CLASSES = ("VDN", "QMIX", "monotone", "literal", "as shipped", "b told", "lambda told", "told available")


def cone(name, sizes, ranks):
    """The families that a mixer represents, utilities free: {columns @ x}. The entries are 1, -1 and 0.

    Args:
        name: one of CLASSES, see `coefficients`.
        ranks: for each agent the order of its utilities, a permutation of 0 .. |M^i| - 1; the highest is greedy.

    Returns:
        columns: float64 [rows, parameters].
        free: bool [parameters], False where x must not be negative.
    """
    by_row = [coefficients(name, sizes, ranks, *row) for row in rows(sizes)]
    place = {}  # of each parameter
    for entry in by_row:
        for parameter in entry:
            place.setdefault(parameter, len(place))
    columns = np.zeros((len(by_row), len(place)))
    for k, entry in enumerate(by_row):
        for parameter, coefficient in entry.items():
            columns[k, place[parameter]] = coefficient
    free = [parameter[0] == "value" for parameter in place]
    return columns, np.array(free)


def coefficients(name, sizes, ranks, available, m):
    """The coefficients of a row, by parameter. Those that begin with "value" may be negative.

    "VDN": sums of utilities. "monotone": whatever rises with every utility (Eq. 1), a sum of indicators of upper sets.
    "QMIX": rises, and has rising differences (one layer of ELU is convex); a bound, for 2 agents. The others are QPLEX
    with w_i > 0, b_i and lambda_i >= 0 free: b + sum_i w_i V_i gives a 1. Each disadvantage of a macro-action that is
    not greedy gives a -1, in V_i if the agent is busy and conditioned, else in lambda_i A_i. "literal": not
    conditioned, its weights do not see what is available. "as shipped": conditioned, same weights. "b told", "lambda
    told", "told available": the b_i, the lambda_i, all weights see it, too.
    """
    rank = tuple(order[m_i] for order, m_i in zip(ranks, m, strict=True))
    worse = [i for i, size in enumerate(sizes) if rank[i] < size - 1]
    is_free = [sum(can) > 1 for can in available]
    if name == "VDN":
        return {("value", i, m_i): 1 for i, m_i in enumerate(m)}
    if name == "QMIX":
        entry = {("value",): 1}
        steps = [range(1, r + 1) for r in rank]
        for i, own_steps in enumerate(steps):
            for k in own_steps:
                entry["gain", i, k] = 1
        for ks in itertools.product(*steps):
            entry["joint gain", *ks] = 1
        return entry
    if name == "monotone":
        entry = {("value",): 1}
        for upper in upper_sets(sizes):
            if rank in upper:
                entry["gain", upper] = 1
        return entry
    if name == "literal":
        entry = {("value",): 1}
        if worse:
            entry["loss", m] = -1
        return entry
    if name == "as shipped":
        entry = {("value",): 1}
        for i in worse:
            cause = m if is_free[i] else m[i]
            entry["loss", i, cause] = -1
        return entry
    if name == "b told":
        entry = {("value", available): 1}  # with V_i of busy agents
        for i in worse:
            if is_free[i]:
                entry["loss", i, m] = -1
        return entry
    entry = {("value", available): 1}
    if name == "lambda told":
        entry = {("value",): 1}
        for i in worse:
            if not is_free[i]:
                entry["loss", i, m[i]] = -1
    if any(is_free[i] for i in worse):
        entry["loss", available, m] = -1
    return entry


@cache
def upper_sets(sizes):
    """Every set of joint ranks that holds with a joint rank all those that are nowhere lower; frozensets."""
    grid = list(np.ndindex(*sizes))
    above = {}
    for low in grid:
        above[low] = {high for high in grid if all(h >= x for h, x in zip(high, low, strict=True))}
    result = []
    for bits in itertools.product((0, 1), repeat=len(grid)):
        subset = frozenset(itertools.compress(grid, bits))
        if all(above[rank] <= subset for rank in subset):
            result.append(subset)
    return result


def residuals(name, sizes, families, steps=2_000):
    """The least root mean squared error of a mixer's class (`cone`), over all orders of the utilities.

    Args:
        families: float64 [batch, rows].
        steps: of an accelerated projected gradient.

    Returns:
        float64 [batch], exact to about 1e-9.
    """
    best = np.full(len(families), np.inf)
    seen = set()
    orders = [itertools.permutations(range(size)) for size in sizes]
    for ranks in itertools.product(*orders):
        columns, free = cone(name, sizes, ranks)
        key = columns.tobytes()
        if key in seen:
            continue
        seen.add(key)
        error = columns @ nearest(columns, free, families, steps) - families.T
        rms = np.sqrt(np.square(error).mean(axis=0))
        best = np.minimum(best, rms)
    return best


def nearest(columns, free, families, steps):
    """The x, float64 [parameters, batch], for which columns @ x is nearest to the families, x >= 0 where not free."""
    rate = np.linalg.norm(columns, 2) ** -2
    x = np.zeros((columns.shape[1], len(families)))
    ahead = x
    for k in range(steps):
        moved = ahead - rate * columns.T @ (columns @ ahead - families.T)
        moved = np.where(free[:, None], moved, np.maximum(moved, 0))
        ahead = moved + k / (k + 3) * (moved - x)
        x = moved
    return x


def fit(make, sizes, families, steps=2_000, learning_rate=0.005, seed=0):
    """Trains the utilities and a mixer for each family, by the mixer's own gradient. The state is a constant.

    Args:
        make: as in MIXERS.
        families: float64 [batch, rows], macro-action 0 greedy.
        steps, learning_rate, seed: of Adam and its start.

    Returns:
        float64 [batch], the root mean squared error at the end.
    """
    index = rows(sizes)
    own = own_actions(sizes)
    actions = torch.tensor([m for _, m in index])  # [rows, n]
    masks = [np.array([available[i] for available, _ in index]) for i in range(len(sizes))]
    available = padded(masks, False)  # [rows, n, A]
    state = torch.ones(len(index), 1, dtype=torch.float64)
    families = torch.from_numpy(families)
    with torch.random.fork_rng():
        torch.manual_seed(seed)
        networks = [make(own, 1).double() for _ in families]
        utilities = torch.rand(len(families), *own.shape, dtype=torch.float64)
    utilities[:, :, 0] += 1.0  # start from the greedy choices of the family
    utilities.requires_grad_()
    parameters, buffers = stack_module_state(networks)

    def forward(parameters, buffers, utilities):
        at_each_row = utilities.expand(len(index), -1, -1)
        inputs = (at_each_row, actions, available, state)
        return functional_call(networks[0], (parameters, buffers), inputs)

    optimizer = torch.optim.Adam([utilities, *parameters.values()], learning_rate)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, steps)
    for _ in range(steps):
        q = vmap(forward)(parameters, buffers, utilities)  # [batch, rows]
        error = (q - families).square().mean(1)
        optimizer.zero_grad()
        error.sum().backward()
        optimizer.step()
        schedule.step()
    return error.detach().sqrt().numpy()


# ---- the construction of the proof ----------------------------------------------------------------------------------
def represent(utilities, tables):
    """A ToldAvailable mixer that has the given table in every situation (README: the proof), for a state of width 1.

    A hidden unit stands for each situation, and one for each joint action that is open in it. The first agent that
    deviates is charged the whole loss. One head is enough, as every weight sees the situation.

    Args:
        utilities: n arrays [|M^i|].
        tables: {available: array [|M^1|, ..., |M^n|]} for some situations, or for some combinations of initiation sets.
            Each satisfies Mac-IGM (ties="every"). Entries that are not available are ignored.

    Returns:
        ToldAvailable, float64.
    """
    own = own_actions([len(u) for u in utilities])
    n = len(utilities)
    index = []
    for available in tables:
        index.extend((available, m) for m in open_actions(available))
    mixer = ToldAvailable(own, 1, hidden=len(index), heads=1).double().requires_grad_(False)
    for parameter in mixer.parameters():
        parameter.zero_()
    state_in, _, state_out = mixer.state_net
    action_in, _, action_out = mixer.action_net

    lambdas = np.zeros((n, len(index)))
    for unit, (available, m) in enumerate(index):
        fire(action_in, unit, own, available, m)
        best = greedy_choice(utilities, available)
        loss = tables[available][best] - tables[available][m]
        own_losses = [u[b] - u[a] for u, b, a in zip(utilities, best, m, strict=True)]
        deviators = np.flatnonzero(own_losses)
        if len(deviators):
            first = deviators[0]
            lambdas[first, unit] = loss / own_losses[first]
    scale = 2.0 * lambdas.max() or 1.0
    share = np.maximum(lambdas / scale, 1e-20)  # at most 1/2
    logits = np.log(share / (1 - share))
    action_out.weight.copy_(torch.from_numpy(logits))

    for unit, (available, table) in enumerate(tables.items()):
        fire(state_in, unit, own, available)
        best = greedy_choice(utilities, available)
        missing = table[best] - sum(u[b] for u, b in zip(utilities, best, strict=True))
        state_out.weight[n : 2 * n, unit] = missing / n  # b_i
    state_out.bias[:n] = 1.0  # w_i
    state_out.bias[2 * n] = scale  # the key
    state_out.bias[2 * n + 1 :] = 40.0  # agent_i, and sigmoid(40) = 1
    return mixer


def greedy_choice(utilities, available):
    """A tuple of local greedy choices, n ints."""
    best = [np.where(can, u, -np.inf).argmax() for u, can in zip(utilities, available, strict=True)]
    return tuple(map(int, best))


def fire(layer, unit, own, available, m=None):
    """Makes a hidden unit 1 where just this is available (and m, if given, is the joint action), and 0 elsewhere.

    Its inputs are a state of width 1, what is available and, if m is given, the joint action, one-hot.
    """
    seen = torch.zeros(own.shape)
    for i, can in enumerate(available):
        seen[i, : len(can)] = torch.tensor(can)
    weights = [torch.zeros(1), (2 * seen - 1).flatten()]  # 1 for what is available, -1 for what is not
    matches = seen.sum()
    if m is not None:
        one_hot = torch.nn.functional.one_hot(torch.tensor(m), own.shape[1])
        weights.append(one_hot.flatten())
        matches += len(m)
    layer.weight[unit] = torch.cat(weights)
    layer.bias[unit] = 1 - matches


# ---- the tables of README.md ----------------------------------------------------------------------------------------
def main(argv=None):
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.error = lambda message: sys.exit(f"expressiveness: {message}")
    parser.parse_args(argv)  # there are no options but --help
    torch.set_num_threads(1)
    print("Mac-IGM violations in 2,000 random situations: lambda free / literal at initialisation / as shipped")
    for agents, size in itertools.product((2, 3, 4), (2, 3, 5)):
        for busy in range(1, agents):
            makes = (None, MIXERS["literal"], MIXERS["as shipped"])
            counts = [breaks([size] * agents, busy, 2_000, 0, make) for make in makes]
            text = " / ".join(map(str, counts))
            print(f"{agents} agents, {size} macro-actions, {busy} busy: {text}", flush=True)
    print("\nError of the best fit, families of variance 1, 2 agents x 3 macro-actions: class / as trained (worst)")
    sizes = (3, 3)
    rng = np.random.default_rng(0)
    for kind in FAMILIES:
        families = standardised([random_family(kind, sizes, rng) for _ in range(8)])
        for name in CLASSES:
            text = f"{np.median(residuals(name, sizes, families)):.3f}"
            if name in MIXERS:
                trained = fit(MIXERS[name], sizes, families)
                text += f" / {np.median(trained):.3f} ({trained.max():.3f})"
            print(f"{kind}, {name}: {text}", flush=True)


def standardised(families):
    """Families as an array [batch, rows], each of mean 0 and variance 1."""
    families = np.array(families)
    families = families - families.mean(1, keepdims=True)
    return families / families.std(1, keepdims=True)


if __name__ == "__main__":
    main()
