"""Which value tables the mixers represent, and how often QPLEX without conditioning breaks Mac-IGM.

One joint macro-history h and one mixer state are fixed, so that a mixer is a family of tables Q(h, . | m^-), one for
each situation: who has terminated, and what the others are doing. Names, besides those of `igm.py`:

    rows         every (situation, m): a situation in which someone chooses, and an m that agrees with its m^-
    family       a value for each row
    greedy       what is best by an agent's own utilities

`python -m theory.expressiveness` prints the tables of README.md.
"""

import itertools
from functools import cache, partial

import numpy as np
import torch
from torch.func import functional_call, stack_module_state, vmap

from avf_qmix import QMIXMixer
from avf_qplex import QPLEXMixer
from theory.igm import mac_igm_batch, situations
from theory.variants import SeeOngoing, VDNMixer


def joint_tables(mixer, utilities, terminated, state, values=None):
    """The mixer's value of every joint action; those that do not agree with an m^- belong to other situations.

    Args:
        mixer: a mixer of the scripts, in float64.
        utilities: n float64 arrays [batch, |M^i|]. terminated: bool [batch, n] or [n]. state: float64 [batch, S].
        values: V_i, float64 [batch, n]; None: max Q_i (Eq. 4).

    Returns:
        float64 [batch, |M^1|, ..., |M^n|].
    """
    sizes = [u.shape[1] for u in utilities]
    actions = torch.from_numpy(np.indices(sizes).reshape(len(sizes), -1).T.copy())  # [joint, n]
    own = np.stack([u[:, m] for u, m in zip(utilities, actions.T.numpy(), strict=True)], -1)  # [batch, joint, n]
    values = np.stack([u.max(axis=1) for u in utilities], -1) if values is None else values
    values, terminated = (np.broadcast_to(np.asarray(x)[..., None, :], own.shape) for x in (values, terminated))
    state = np.broadcast_to(state[:, None], (*own.shape[:2], state.shape[-1]))
    own, values, terminated, state = (torch.from_numpy(x.copy()) for x in (own, values, terminated, state))
    with torch.no_grad():
        q = mixer(own, values, actions.expand(own.shape), terminated, state)
    return q.reshape(-1, *sizes).numpy()


MIXERS = {  # (sizes, width of the state) -> mixer
    "VDN": lambda sizes, width: VDNMixer(),
    "QMIX": lambda sizes, width: QMIXMixer(len(sizes), width),
    "literal": partial(QPLEXMixer, mask_ongoing=False),
    "as shipped": QPLEXMixer,  # conditioned on ongoing agents
    "told m^-": SeeOngoing,  # conditioned, and its weights see what they are doing
}


# How often the literal mixer breaks Mac-IGM.


def duplex_tables(utilities, lambdas):
    """sum_i lambda_i(m) A_i(m_i), literal QPLEX up to a constant, with lambdas given instead of computed.

    Args:
        utilities: n arrays [batch, |M^i|]. lambdas: [batch, n, |M^1|, ..., |M^n|].

    Returns:
        Array [batch, |M^1|, ..., |M^n|].
    """
    q = np.zeros_like(lambdas[:, 0])
    for i, u in enumerate(utilities):
        own_axis = [len(u)] + [u.shape[1] if j == i else 1 for j in range(len(utilities))]
        q = q + lambdas[:, i] * (u - u.max(axis=1, keepdims=True)).reshape(own_axis)
    return q


def breaks(sizes, ongoing_agents, count, seed, mixer=None, per_network=100):
    """How many random situations violate Mac-IGM ("every"): utilities N(0, 1), m^- uniform.

    Args:
        sizes: |M^i|, n ints. ongoing_agents: the first so many are ongoing. count: of situations.
        mixer: as in MIXERS; networks as initialised, `per_network` situations for each, states N(0, 1) of width 4.
            None: the literal formula, with independent lambda_i(m), |N(0, 1)|.

    Returns:
        int.
    """
    rng, n = np.random.default_rng(seed), len(sizes)
    utilities = [rng.normal(size=(count, size)) for size in sizes]
    terminated = np.arange(n) >= ongoing_agents
    ongoing = rng.integers(sizes, size=(count, n))
    if mixer is None:
        q = duplex_tables(utilities, np.abs(rng.normal(size=(count, n, *sizes))))
    else:
        state, parts = rng.normal(size=(count, 4)), []
        with torch.random.fork_rng():
            torch.manual_seed(seed)
            for start in range(0, count, per_network):
                part = slice(start, start + per_network)
                network = mixer(sizes, 4).double()
                parts.append(joint_tables(network, [u[part] for u in utilities], terminated, state[part]))
        q = np.concatenate(parts)
    _, loss = mac_igm_batch(q, utilities, terminated, ongoing)
    return int((loss > 1e-9 * np.abs(q).max()).sum())


# Families of tables, and the classes of mixers as cones.


def rows(sizes):
    """Every (terminated, ongoing, m): each situation with a chooser, all terminated first, each m it leaves open."""
    return [
        (terminated, ongoing, m)
        for terminated, ongoing in situations(sizes)
        if any(terminated)
        for m in itertools.product(
            *(range(size) if done else [on] for size, done, on in zip(sizes, terminated, ongoing, strict=True))
        )
    ]


FAMILIES = ("additive", "one table", "a table each")


def random_family(kind, sizes, rng):
    """A family that satisfies Mac-IGM with macro-action 0 the greedy one of each agent; float64 [rows].

    "additive": one table for all situations, a sum of utilities. "one table": one for all situations, N(0, 1) under the
    condition that Mac-IGM holds. "a table each": N(0, 1) for each situation, its maximum moved to the greedy choices.
    """
    index = rows(sizes)
    if kind == "a table each":
        family = rng.normal(size=len(index))
        for situation in dict.fromkeys(row[:2] for row in index):
            here = [k for k, row in enumerate(index) if row[:2] == situation]  # the greedy choice comes first
            family[here] = np.roll(family[here], -family[here].argmax())
        return family
    while True:
        q = rng.normal(size=sizes)
        if kind == "additive":
            q = sum(np.ix_(*(np.sort(rng.normal(size=size))[::-1] for size in sizes)))
        if all((q.take([0], axis=i) == q.max(axis=i, keepdims=True)).all() for i in range(len(sizes))):
            return np.array([q[m] for _, _, m in index])


CLASSES = ("VDN", "QMIX", "monotone", "literal", "as shipped", "told m^-")


def cone(name, sizes, ranks):
    """The families that a mixer represents, utilities free: {columns @ x}. The entries are 1, -1 and 0.

    "VDN": sums of utilities. "monotone": whatever rises with every utility (Eq. 1), a sum of indicators of upper sets.
    "QMIX": rises, and has rising differences (one layer of ELU is convex); a bound, for 2 agents. The others are QPLEX
    with w_i > 0, b_i and lambda_i >= 0 free: b + sum_i w_i V_i gives a 1; each disadvantage of a macro-action that is
    not greedy a -1, in V_i if the agent is ongoing and conditioned, else in lambda_i A_i. "literal": not conditioned,
    its weights see neither who is ongoing nor m^-. "as shipped": conditioned, same weights. "told m^-": they see both.

    Args:
        ranks: for each agent the order of its utilities, a permutation of 0 .. |M^i| - 1; the highest is greedy.

    Returns:
        columns: float64 [rows, parameters]. free: bool [parameters], False where x must not be negative.
    """

    def entry(terminated, ongoing, m):
        """The coefficients of a row, by parameter."""
        rank = tuple(order[m_i] for order, m_i in zip(ranks, m, strict=True))
        worse = [i for i, size in enumerate(sizes) if rank[i] < size - 1]
        worse_choice, situation = [i for i in worse if terminated[i]], (terminated, ongoing)
        if name == "VDN":
            return {("value", i, m_i): 1 for i, m_i in enumerate(m)}
        if name == "QMIX":
            steps = [range(1, r + 1) for r in rank]
            alone = {("gain", i, k): 1 for i, ks in enumerate(steps) for k in ks}
            return {("value",): 1} | alone | {("joint gain", *ks): 1 for ks in itertools.product(*steps)}
        if name == "monotone":
            return {("value",): 1} | {("gain", upper): 1 for upper in _upper_sets(sizes) if rank in upper}
        if name == "literal":
            return {("value",): 1} | ({("loss", m): -1} if worse else {})
        if name == "as shipped":
            return {("value",): 1} | {("loss", i, m if terminated[i] else m[i]): -1 for i in worse}
        return {("value", situation): 1} | ({("loss", situation, m): -1} if worse_choice else {})

    entries = [entry(*row) for row in rows(sizes)]
    names = list(dict.fromkeys(key for entry in entries for key in entry))
    columns = np.array([[entry.get(key, 0.0) for key in names] for entry in entries])
    return columns, np.array([key[0] == "value" for key in names])


@cache
def _upper_sets(sizes):
    grid = list(np.ndindex(*sizes))
    above = {a: {b for b in grid if all(x >= y for x, y in zip(b, a, strict=True))} for a in grid}
    subsets = (frozenset(itertools.compress(grid, bits)) for bits in itertools.product((0, 1), repeat=len(grid)))
    return [subset for subset in subsets if all(above[a] <= subset for a in subset)]


def residuals(name, sizes, families, steps=2_000):
    """The least root mean squared error of a mixer's class (`cone`), over all orders of the utilities.

    Args:
        families: float64 [batch, rows]. steps: of an accelerated projected gradient.

    Returns:
        float64 [batch], exact to about 1e-9.
    """
    best, seen = np.full(len(families), np.inf), set()
    for ranks in itertools.product(*(itertools.permutations(range(size)) for size in sizes)):
        columns, free = cone(name, sizes, ranks)
        if (key := columns.tobytes()) in seen:
            continue
        seen.add(key)
        rate = np.linalg.norm(columns, 2) ** -2
        x = ahead = np.zeros((columns.shape[1], len(families)))
        for k in range(steps):
            moved = ahead - rate * columns.T @ (columns @ ahead - families.T)
            moved = np.where(free[:, None], moved, np.maximum(moved, 0))
            ahead, x = moved + k / (k + 3) * (moved - x), moved
        best = np.minimum(best, np.sqrt(np.square(columns @ x - families.T).mean(axis=0)))
    return best


def fit(mixer, sizes, families, steps=2_000, learning_rate=0.005, seed=0):
    """Trains the utilities and a mixer for each family, by the mixer's own gradient; the state is a constant.

    Args:
        mixer: as in MIXERS. families: float64 [batch, rows], macro-action 0 greedy. The rest: of Adam and its start.

    Returns:
        float64 [batch], the root mean squared error at the end.
    """
    index, agents = rows(sizes), torch.arange(len(sizes))
    chosen, actions = (torch.tensor([row[k] for row in index]) for k in (0, 2))  # [rows, n] each
    state, families = torch.ones(len(index), 1, dtype=torch.float64), torch.from_numpy(families)
    with torch.random.fork_rng():
        torch.manual_seed(seed)
        networks = [mixer(sizes, 1).double() for _ in families]
        utilities = torch.rand(len(families), len(sizes), max(sizes), dtype=torch.float64)
    utilities[:, :, 0] += 1.0  # start from the greedy choices of the family
    for i, size in enumerate(sizes):
        utilities[:, i, size:] = -1e9
    parameters, buffers = stack_module_state(networks)

    def forward(parameters, buffers, utilities):
        own = utilities[agents, actions]  # [rows, n]
        return functional_call(
            networks[0], (parameters, buffers), (own, utilities.amax(-1).expand(own.shape), actions, chosen, state)
        )

    optimizer = torch.optim.Adam([utilities.requires_grad_(), *parameters.values()], learning_rate)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, steps)
    for _ in range(steps):
        error = (vmap(forward)(parameters, buffers, utilities) - families).square().mean(1)
        optimizer.zero_grad()
        error.sum().backward()
        optimizer.step()
        schedule.step()
    return error.detach().sqrt().numpy()


# The construction of the proof.


def represent(utilities, tables):
    """A SeeOngoing mixer that has the given table in every situation (README: the proof), for a state of width 1.

    A hidden unit for each situation, and one for each joint action in each. The first agent that deviates is charged
    the whole loss. One head is enough, as every weight sees the situation.

    Args:
        utilities: n arrays [|M^i|]. tables: {(terminated, ongoing): array [|M^1|, ..., |M^n|]}, satisfying Mac-IGM
            (ties="every"); entries that do not agree with m^- are ignored.

    Returns:
        SeeOngoing, float64.
    """
    sizes = [len(u) for u in utilities]
    n, widest, index = len(sizes), max(sizes), [row for row in rows(sizes) if row[:2] in tables]
    mixer = SeeOngoing(sizes, 1, max(len(tables), len(index)), heads=1).double().requires_grad_(False)
    for parameter in mixer.parameters():
        parameter.zero_()
    (state_in, _, state_out), (action_in, _, action_out) = mixer.of_state, mixer.of_action

    def fire(layer, unit, terminated, ongoing, m=None):
        """A hidden unit that is 1 where m^-, and m if given, are these, and 0 elsewhere."""
        weights = layer.weight[unit, 1:].view(-1, n, widest)  # of m^-, and of m
        for i in range(n):
            if terminated[i]:
                weights[0, i] = -1.0
            else:
                weights[0, i, ongoing[i]] = 1.0
        layer.bias[unit] = 1.0 - (n - sum(terminated))
        if m is not None:
            weights[1, range(n), m] = 1.0
            layer.bias[unit] -= n

    def greedy(terminated, ongoing):
        return tuple(int(u.argmax()) if t else on for u, t, on in zip(utilities, terminated, ongoing, strict=True))

    lambdas = np.zeros((n, len(index)))
    for k, (*situation, m) in enumerate(index):
        fire(action_in, k, *situation, m)
        table, top = tables[tuple(situation)], greedy(*situation)
        losses = [u[best] - u[own] for u, best, own in zip(utilities, top, m, strict=True)]
        if any(losses):
            i = int(np.flatnonzero(losses)[0])
            lambdas[i, k] = (table[top] - table[m]) / losses[i]
    scale = 2.0 * lambdas.max(initial=0.0) or 1.0
    share = np.maximum(lambdas / scale, 1e-20)  # at most 1/2
    action_out.weight[:, : len(index)] = torch.from_numpy(np.log(share / (1 - share)))

    for unit, (situation, table) in enumerate(tables.items()):
        fire(state_in, unit, *situation)
        top = greedy(*situation)
        state_out.weight[n : 2 * n, unit] = (table[top] - sum(u[m] for u, m in zip(utilities, top, strict=True))) / n
    state_out.bias[:n], state_out.bias[2 * n], state_out.bias[2 * n + 1 :] = 1.0, scale, 40.0  # sigmoid(40) = 1
    return mixer


# The README's tables.


def main():
    torch.set_num_threads(1)
    print("Mac-IGM violations in 2,000 random situations: lambda free / literal at initialisation / as shipped")
    cases = [(agents, size, going) for agents in (2, 3, 4) for size in (2, 3, 5) for going in range(1, agents)]
    for agents, size, going in cases:
        makes = (None, MIXERS["literal"], MIXERS["as shipped"])
        counts = [breaks([size] * agents, going, 2_000, 0, make) for make in makes]
        print(f"{agents} agents, {size} macro-actions, {going} ongoing: {' / '.join(map(str, counts))}", flush=True)
    print(
        "\nError of the best fit, families of variance 1, 2 agents x 3 macro-actions: class / mixer as trained (worst)"
    )
    sizes, rng = (3, 3), np.random.default_rng(0)
    for kind in FAMILIES:
        families = np.array([random_family(kind, sizes, rng) for _ in range(8)])
        families = (families - families.mean(1, keepdims=True)) / families.std(1, keepdims=True)
        for name in CLASSES:
            text = f"{np.median(residuals(name, sizes, families)):.3f}"
            if name in MIXERS:
                trained = fit(MIXERS[name], sizes, families)
                text += f" / {np.median(trained):.3f} ({trained.max():.3f})"
            print(f"{kind}, {name}: {text}", flush=True)


if __name__ == "__main__":
    main()
