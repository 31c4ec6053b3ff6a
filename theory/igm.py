"""IGM, Mac-IGM, Adv-IGM and MacAdv-IGM on value tables, by enumeration (Eqs. 2-4, 6, 7 and 11 of the paper).

One joint macro-history is fixed, so that a value function is a table. These names are used throughout, for n agents:

    q            the joint table Q(h, .): an ndarray with one axis for each agent, shape [|M^1|, ..., |M^n|]
    utilities    Q_i(h^i, .): n one-dimensional arrays, the i-th of shape [|M^i|]
    available    what each agent can do: n bool arrays, the i-th of shape [|M^i|], at least one True in each

The paper has two kinds of agents. One whose macro-action has terminated (M^+, Eq. 6) is free and chooses among all its
macro-actions. One whose macro-action is ongoing (m^-, Eq. 5) is busy and goes on with it. In terms of what is available
these are two cases of one thing: everything, or only the running macro-action. `paper_available` translates. Eq. 7 then
needs no cases, and Eq. 11 is the same for A and A_i:

    argmax over available m of Q(h, m) = (argmax over available m^1 of Q_1(h^1, m^1), ..., the same for agent n)

Read like this, Defs. 3.1 and 3.3 cover initiation sets, too. Every macro-action has one (I in Section 2.2 of the
paper), which Eq. 7 leaves out. A free agent then has available what it can start.

Tables may be real (compared exactly, without a tolerance), integer, or object arrays of `fractions.Fraction`.

An argmax is a set. The left side of Eqs. 2, 7 and 11 is a set of joint actions. The right side is a tuple of sets. It
stands for their product: the tuples that agents can reach when each breaks its own ties as it likes. `ties` says how
the equation between the two is read:

    "equal"   The two sets are the same. This is the equation as written, and the default.
    "every"   Every tuple of local greedy choices is a joint maximiser. Joint maximisers that no such tuple reaches are
              allowed. This is what decentralised execution needs. It is also what Eq. 1 gives: a mixer whose derivative
              is 0 somewhere can be flat where utilities differ, which "equal" rejects.
    "some"    Some tuple of local greedy choices is a joint maximiser. This is enough only if agents agree on how to
              break ties.

"equal" implies "every", and "every" implies "some". Without ties in any of the tables the three are one.
"""

import itertools
from fractions import Fraction
from typing import NamedTuple

import numpy as np

TIES = ("equal", "every", "some")


class Verdict(NamedTuple):
    """What a definition says of a table. It is true in a condition when the definition holds.

    Attributes:
        holds: bool.
        action: None if it holds, else the joint action that shows the failure, n ints. This is the worst tuple of local
            greedy choices ("some": the best one). If all of these are joint maximisers, it is a joint maximiser that
            none of them is.
        margin: what `action` loses against the conditional maximum of the table compared (Q or A). It is > 0 in the
            first case, 0 in the second and when the verdict holds.
    """

    holds: bool
    action: tuple[int, ...] | None = None
    margin: float | Fraction = 0

    def __bool__(self):
        return self.holds


# ---- what agents can do ---------------------------------------------------------------------------------------------
def paper_available(sizes, free, running):
    """What is available to the paper's free and busy agents (Eqs. 5 and 6).

    Args:
        sizes: |M^i| for each agent, n ints.
        free: bool [..., n], M^+.
        running: int [..., n], m^-; ignored for free agents.

    Returns:
        n bool arrays, the i-th of shape [..., |M^i|].
    """
    free = np.asarray(free)
    running = np.asarray(running)
    available = []
    for i, size in enumerate(sizes):
        goes_on_with = np.arange(size) == running[..., i, None]
        available.append(free[..., i, None] | goes_on_with)
    return available


def situations(sizes):
    """Every M^+ with every m^- of the others, as what is available: the one in which all agents are free comes first.

    Args:
        sizes: |M^i| for each agent, n ints.

    Returns:
        List of `available`, each a tuple of n tuples of bools. These are prod_i (1 + |M^i|) if all sizes are above 1.
    """
    options = []
    for size in sizes:
        everything = (True,) * size
        one_alone = [tuple(m == running for m in range(size)) for running in range(size)]
        options.append([everything, *one_alone] if size > 1 else [everything])
    return list(itertools.product(*options))


def initiation_sets(sizes):
    """Every combination of what could be available, in the form of `situations`: prod_i (2^|M^i| - 1)."""
    options = []
    for size in sizes:
        subsets = itertools.product((True, False), repeat=size)
        options.append([subset for subset in subsets if any(subset)])
    return list(itertools.product(*options))


def open_actions(available):
    """The joint actions that are available, a list of tuples of n ints in ascending order."""
    own = [np.flatnonzero(can).tolist() for can in available]
    return list(itertools.product(*own))


# ---- the definitions ------------------------------------------------------------------------------------------------
def conditional_argmax(q, available):
    """argmax Q(h, m | m^-), the left side of Eq. 7: the maximum is taken over what is available.

    Returns:
        Set of joint actions, n ints each.
    """
    value = {m: q.item(m) for m in open_actions(available)}
    top = max(value.values())
    return {m for m in value if value[m] == top}


def local_choices(utilities, available):
    """The right side of Eq. 7: each agent's best macro-actions among those that are available to it.

    Returns:
        Set of joint actions, n ints each: the product of the agents' sets.
    """
    greedy = []
    for u, can in zip(utilities, available, strict=True):
        can = np.asarray(can)
        is_best = can & (u == u[can].max())
        greedy.append(np.flatnonzero(is_best).tolist())
    return set(itertools.product(*greedy))


def igm(q, utilities, ties="equal"):
    """IGM (Eq. 2): the joint maximisers of Q are the tuples of the agents' maximisers.

    Returns:
        Verdict.

    Raises:
        ValueError: shapes do not match, a value is not finite, or `ties` is unknown.
    """
    q, utilities = _tables(q, utilities)
    joint = set(map(tuple, np.argwhere(q == q.max()).tolist()))
    greedy = [np.flatnonzero(u == u.max()).tolist() for u in utilities]
    return _compare(q, joint, set(itertools.product(*greedy)), ties)


def mac_igm(q, utilities, available, ties="equal"):
    """Mac-IGM (Def. 3.1, Eq. 7): IGM on the part of Q that is available.

    Returns:
        Verdict.

    Raises:
        ValueError: as `igm`, or nothing is available to some agent.
    """
    q, utilities = _tables(q, utilities)
    available = _masks([(size,) for size in q.shape], available)
    joint = conditional_argmax(q, available)
    local = local_choices(utilities, available)
    return _compare(q, joint, local, ties)


def adv_igm(q, utilities, ties="equal"):
    """Adv-IGM of QPLEX (Eqs. 3, 4): with V = max Q and A = Q - V <= 0, jointly and for each agent, IGM holds for A.

    As A <= 0 and its maximum is 0, the maximisers are the actions without a disadvantage, A = 0. Differences are taken
    exactly.

    Returns:
        Verdict, its margin in units of A.

    Raises:
        ValueError: as `igm`.
    """
    advantage, own_advantages = advantages(q, utilities)
    joint = set(map(tuple, np.argwhere(advantage == 0).tolist()))
    greedy = [np.flatnonzero(a == 0).tolist() for a in own_advantages]
    return _compare(advantage, joint, set(itertools.product(*greedy)), ties)


def macadv_igm(q, utilities, available, value=None, values=None, ties="equal"):
    """MacAdv-IGM (Def. 3.3, Eq. 11): Mac-IGM for A = Q - V and A_i = Q_i - V_i, for any V and V_i.

    Unlike Adv-IGM it bounds no advantage: V and V_i are free. They are constants of the tables compared, so no argmax
    sees them, which is the whole of Prop. 3.4. In floating point Q - V rounds, which makes ties that Q does not have,
    and Prop. 3.4 fails (`test_rounding_breaks_prop_3_4`).

    Args:
        q, utilities, available, ties: as in the module's docstring.
        value, values: V(h) and the V_i(h^i), as in `advantages`.

    Returns:
        Verdict, its margin in units of A.

    Raises:
        ValueError: as `mac_igm`.
    """
    advantage, own_advantages = advantages(q, utilities, value, values)
    return mac_igm(advantage, own_advantages, available, ties)


def advantages(q, utilities, value=None, values=None):
    """A = Q - V and A_i = Q_i - V_i (Eq. 3), exactly.

    Args:
        q, utilities: as in the module's docstring.
        value: V(h), a finite number; None: max Q (Eq. 4).
        values: V_i(h^i), n finite numbers; None: max Q_i (Eq. 4).

    Returns:
        A, and a list of the n A_i: object arrays of Fractions, of the shapes of q and utilities.

    Raises:
        ValueError: as `igm`.
    """
    q, utilities = _tables(q, utilities)
    if value is None:
        value = np.max(q)
    if values is None:
        values = [np.max(u) for u in utilities]
    own_advantages = [exact(u) - exact(v) for u, v in zip(utilities, values, strict=True)]
    return exact(q) - exact(value), own_advantages


def mac_igm_batch(q, utilities, available, ties="equal", tolerance=0.0):
    """`mac_igm` for many tables at once, vectorised, in floating point; agrees with it exactly (a test says so).

    Args:
        q: float [batch, |M^1|, ..., |M^n|].
        utilities: n float arrays [batch, |M^i|].
        available: n bool arrays [batch, |M^i|] or [|M^i|].
        ties: as in the module's docstring.
        tolerance: float or float [batch]. A joint action that loses no more is a joint maximiser.

    Returns:
        holds: bool [batch].
        loss: float [batch] >= 0, the conditional maximum less the value of the worst tuple of local greedy choices. It
            is 0 exactly where ties="every" holds. For a mixer, whose rounding breaks ties, compare it with a tolerance.

    Raises:
        ValueError: `ties` is unknown, shapes do not match, or nothing is available to some agent.
    """
    batch = q.shape[0]
    sizes = q.shape[1:]
    shapes = [(batch, size) for size in sizes]
    if [u.shape for u in utilities] != shapes:
        raise ValueError(f"utilities must have shapes {shapes}")
    masks = [np.broadcast_to(can, shape) for can, shape in zip(available, shapes, strict=True)]
    is_open = np.ones(q.shape, bool)
    is_greedy = np.ones(q.shape, bool)
    for i, can in enumerate(_masks(shapes, masks)):
        utility = np.where(can, utilities[i], -np.inf)  # [batch, |M^i|]
        is_best = can & (utility == utility.max(axis=1, keepdims=True))
        own_axis = [batch] + [1] * len(sizes)
        own_axis[i + 1] = sizes[i]
        is_open &= can.reshape(own_axis)
        is_greedy &= is_best.reshape(own_axis)
    joint_axes = tuple(range(1, q.ndim))
    top = np.where(is_open, q, -np.inf).max(axis=joint_axes, keepdims=True)
    worst = np.where(is_greedy, q, np.inf).min(axis=joint_axes)
    tolerance = np.reshape(tolerance, (-1,) + (1,) * len(sizes))
    is_maximiser = is_open & (q >= top - tolerance)
    holds = {
        "equal": (is_maximiser == is_greedy).all(axis=joint_axes),
        "every": (is_maximiser | ~is_greedy).all(axis=joint_axes),
        "some": (is_maximiser & is_greedy).any(axis=joint_axes),
    }
    return holds[_known(ties)], top.reshape(batch) - worst


# ---- numbers and checks ---------------------------------------------------------------------------------------------
def exact(table):
    """The same numbers as an object array of Fractions, in which sums and differences are exact.

    Args:
        table: finite numbers of any real dtype (or an object array of Fractions), any shape.

    Returns:
        Object ndarray of the same shape.
    """
    table = np.asarray(table)
    if table.dtype.kind == "f":
        table = table.astype(np.float64)
    to_fraction = np.frompyfunc(Fraction, 1, 1)
    return np.asarray(to_fraction(table), dtype=object)


def _compare(table, joint, local, ties):
    """The Verdict on a set of joint maximisers and one of tuples of local greedy choices."""
    missed = local - joint
    unreached = joint - local
    holds = {
        "equal": not missed and not unreached,
        "every": not missed,
        "some": len(missed) < len(local),
    }
    if holds[_known(ties)]:
        return Verdict(True)
    if missed:
        pick = max if ties == "some" else min
        action = pick(missed, key=lambda m: (table.item(m), m))
    else:
        action = min(unreached)
    top = table.item(min(joint))
    return Verdict(False, action, top - table.item(action))


def _tables(q, utilities):
    """Both as arrays, after a look at their shapes and values."""
    q = np.asarray(q)
    utilities = [np.asarray(u) for u in utilities]
    shapes = [(size,) for size in q.shape]
    if [u.shape for u in utilities] != shapes or q.size == 0:
        raise ValueError(f"a table of shape {q.shape} needs utilities {shapes}, each with an action")
    for table in (q, *utilities):
        if table.dtype.kind == "f" and not np.isfinite(table).all():
            raise ValueError("values must be finite")
    return q, utilities


def _masks(shapes, available):
    """What is available as arrays, after a look at their shapes and that each agent can do something."""
    masks = [np.asarray(can) for can in available]
    if [can.shape for can in masks] != shapes:
        raise ValueError(f"what is available must have shapes {shapes}")
    for i, can in enumerate(masks):
        if can.dtype != bool or not can.any(axis=-1).all():
            raise ValueError(f"what is available to agent {i} must be bools, at least one of them True")
    return masks


def _known(ties):
    if ties not in TIES:
        raise ValueError(f"ties must be one of {TIES}, got {ties!r}")
    return ties
