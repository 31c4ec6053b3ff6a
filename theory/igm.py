"""IGM, Mac-IGM, Adv-IGM and MacAdv-IGM on value tables, by enumeration (Eqs. 2-4, 6, 7 and 11 of the paper).

One joint macro-history is fixed, so that a value function is a table. Names used throughout, for n agents:

    q            joint table Q(h, .): ndarray with one axis per agent, shape [|M^1|, ..., |M^n|]
    utilities    Q_i(h^i, .): n one-dimensional arrays, the i-th of shape [|M^i|]
    terminated   M^+ (Eq. 6) as n bools: True where agent i's macro-action has ended, so that it chooses a new one
    ongoing      m^- (Eq. 5) as n ints: the macro-action agent i is still executing; ignored where terminated[i]

Tables may be real (compared exactly, no tolerance), integer, or object arrays of `fractions.Fraction`.

Ties. An argmax is a set. The left side of Eqs. 2, 7 and 11 is a set of joint actions, the right side a tuple of sets,
which stands for their product: the tuples that agents can reach when each breaks its own ties as it likes. `ties` picks
the reading of the equation between the two:

    "equal"   the two sets are the same: the equation as written, and the default
    "every"   every tuple of local greedy choices is a joint maximiser; joint maximisers that no such tuple reaches are
              allowed. This is what decentralised execution needs, and what Eq. 1 gives: a mixer with a derivative
              of 0 somewhere (Eq. 1 allows it) can be flat where utilities differ, which "equal" rejects
    "some"    some tuple of local greedy choices is a joint maximiser: enough only if agents agree on how to break ties

"equal" implies "every" implies "some"; without ties in any of the tables the three are one.
"""

import itertools
from fractions import Fraction
from typing import NamedTuple

import numpy as np

TIES = ("equal", "every", "some")


class Verdict(NamedTuple):
    """What a definition says of a table; true in a condition when it holds.

    Attributes:
        holds: bool.
        action: None if it holds, else the joint action that shows the failure, n ints: the worst tuple of local greedy
            choices ("some": the best one); or, if all are joint maximisers, a joint maximiser that none of them is.
        margin: what `action` loses against the conditional maximum of the table compared (Q or A): > 0 in the first
            case, 0 in the second and when the verdict holds.
    """

    holds: bool
    action: tuple[int, ...] | None = None
    margin: float | Fraction = 0

    def __bool__(self):
        return self.holds


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
    return np.asarray(np.frompyfunc(Fraction, 1, 1)(table), dtype=object)


def conditional_argmax(q, terminated, ongoing):
    """argmax_m Q(h, m | m^-), the left side of Eq. 7: only agents that have terminated are maximised over.

    Args:
        q, terminated, ongoing: as in the module's docstring.

    Returns:
        Set of joint actions (n ints each) that agree with m^- and have the highest value among those that do.
    """
    choices = [range(size) if done else (int(m),) for size, done, m in zip(q.shape, terminated, ongoing, strict=True)]
    value = {m: q.item(m) for m in itertools.product(*choices)}
    top = max(value.values())
    return {m for m in value if value[m] == top}


def local_choices(utilities, terminated, ongoing):
    """The right side of Eq. 7: each terminated agent's greedy macro-actions, each ongoing agent's own one.

    Args:
        utilities, terminated, ongoing: as in the module's docstring.

    Returns:
        Set of joint actions (n ints each): the product of the agents' sets.
    """
    greedy = [
        np.flatnonzero(u == u.max()).tolist() if done else [int(m)]
        for u, done, m in zip(utilities, terminated, ongoing, strict=True)
    ]
    return set(itertools.product(*greedy))


def igm(q, utilities, ties="equal"):
    """IGM (Eq. 2): the joint maximisers of Q are the tuples of the agents' maximisers.

    Args:
        q, utilities, ties: as in the module's docstring.

    Returns:
        Verdict.

    Raises:
        ValueError: shapes do not match, a value is not finite, or `ties` is unknown.
    """
    q, utilities = _tables(q, utilities)
    joint = set(map(tuple, np.argwhere(q == q.max()).tolist()))
    local = set(itertools.product(*(np.flatnonzero(u == u.max()).tolist() for u in utilities)))
    return _compare(q, joint, local, ties)


def mac_igm(q, utilities, terminated, ongoing, ties="equal"):
    """Mac-IGM (Def. 3.1, Eq. 7): IGM on the part of Q that the ongoing macro-actions leave open.

    Args:
        q, utilities, terminated, ongoing, ties: as in the module's docstring.

    Returns:
        Verdict.

    Raises:
        ValueError: as `igm`, or an ongoing macro-action is out of range.
    """
    q, utilities = _tables(q, utilities)
    _check_situation(q.shape, terminated, ongoing)
    joint = conditional_argmax(q, terminated, ongoing)
    return _compare(q, joint, local_choices(utilities, terminated, ongoing), ties)


def adv_igm(q, utilities, ties="equal"):
    """Adv-IGM of QPLEX (Eqs. 3, 4): with V = max Q and A = Q - V <= 0, jointly and for each agent, IGM holds for A.

    As A <= 0 and its maximum is 0, the maximisers are the actions without a disadvantage, A = 0.

    Args:
        q, utilities, ties: as in the module's docstring. Differences are taken exactly.

    Returns:
        Verdict, its margin in units of A.

    Raises:
        ValueError: as `igm`.
    """
    q, utilities = _tables(q, utilities)
    advantage = exact(q) - exact(q).max()
    joint = set(map(tuple, np.argwhere(advantage == 0).tolist()))
    local = set(itertools.product(*(np.flatnonzero(exact(u) - exact(u).max() == 0).tolist() for u in utilities)))
    return _compare(advantage, joint, local, ties)


def macadv_igm(q, utilities, terminated, ongoing, value=None, values=None, ties="equal"):
    """MacAdv-IGM (Def. 3.3, Eq. 11): Mac-IGM for A = Q - V and A_i = Q_i - V_i, for any V and V_i.

    Unlike Adv-IGM it bounds no advantage: V and V_i are free. Differences are taken exactly: in floating point
    Q - V rounds, which makes ties that Q does not have, and Prop. 3.4 fails (`test_rounding_breaks_prop_3_4`).

    Args:
        q, utilities, terminated, ongoing, ties: as in the module's docstring.
        value: V(h), a finite number; None: max Q (Eq. 4).
        values: V_i(h^i), n finite numbers; None: max Q_i (Eq. 4).

    Returns:
        Verdict, its margin in units of A.

    Raises:
        ValueError: as `mac_igm`.
    """
    q, utilities = _tables(q, utilities)
    value = np.max(q) if value is None else value
    values = [np.max(u) for u in utilities] if values is None else values
    advantages = [exact(u) - exact(v) for u, v in zip(utilities, values, strict=True)]
    return mac_igm(exact(q) - exact(value), advantages, terminated, ongoing, ties)


def situations(sizes):
    """Every terminated set with every m^- of the ongoing agents: prod_i (1 + |M^i|) pairs, all agents terminated first.

    Args:
        sizes: |M^i| for each agent, n ints.

    Yields:
        (terminated, ongoing): n bools and n ints, 0 where terminated.
    """
    for state in itertools.product(*(range(-1, size) for size in sizes)):
        yield tuple(m < 0 for m in state), tuple(max(m, 0) for m in state)


def mac_igm_batch(q, utilities, terminated, ongoing, ties="equal", tolerance=0.0):
    """`mac_igm` for many tables at once, vectorised, in floating point; agrees with it exactly (a test says so).

    Args:
        q: float [batch, |M^1|, ..., |M^n|]. utilities: n float arrays [batch, |M^i|].
        terminated: bool [batch, n] or [n]. ongoing: int [batch, n] or [n]. ties: as in the module's docstring.
        tolerance: float or float [batch]; a joint action that loses no more is a joint maximiser.

    Returns:
        holds: bool [batch].
        loss: float [batch] >= 0, the conditional maximum less the value of the worst tuple of local greedy choices: 0
            exactly where ties="every" holds. For a mixer, whose rounding breaks ties, compare it with a tolerance.

    Raises:
        ValueError: `ties` is unknown or shapes do not match.
    """
    batch, sizes = q.shape[0], q.shape[1:]
    if [u.shape for u in utilities] != [(batch, size) for size in sizes]:
        raise ValueError(f"utilities must have shapes {[(batch, size) for size in sizes]}")
    terminated, ongoing = (np.broadcast_to(x, (batch, len(sizes))) for x in (terminated, ongoing))
    open_, greedy = np.ones(q.shape, bool), np.ones(q.shape, bool)  # agrees with m^-; is a tuple of local choices
    for i, u in enumerate(utilities):
        own_axis = [batch] + [size if j == i else 1 for j, size in enumerate(sizes)]
        done, running = terminated[:, i, None], np.arange(sizes[i]) == ongoing[:, i, None]  # [batch, 1], [batch, |M^i|]
        open_ &= (done | running).reshape(own_axis)
        greedy &= np.where(done, u == u.max(axis=1, keepdims=True), running).reshape(own_axis)
    joint_axes = tuple(range(1, q.ndim))
    top = np.where(open_, q, -np.inf).max(axis=joint_axes, keepdims=True)
    best = open_ & (q >= top - np.reshape(tolerance, (-1,) + (1,) * len(sizes)))
    holds = {
        "equal": (best == greedy).all(axis=joint_axes),
        "every": (best | ~greedy).all(axis=joint_axes),
        "some": (best & greedy).any(axis=joint_axes),
    }
    worst = np.where(greedy, q, np.inf).min(axis=joint_axes)
    return holds[_known(ties)], top.reshape(batch) - worst


def _compare(table, joint, local, ties):
    missed, unreached = local - joint, joint - local
    holds = {"equal": not missed and not unreached, "every": not missed, "some": len(missed) < len(local)}
    if holds[_known(ties)]:
        return Verdict(True)
    if missed:
        pick = max if ties == "some" else min
        action = pick(missed, key=lambda m: (table.item(m), m))
    else:
        action = min(unreached)
    return Verdict(False, action, table.item(next(iter(joint))) - table.item(action))


def _tables(q, utilities):
    q, utilities = np.asarray(q), [np.asarray(u) for u in utilities]
    if [u.shape for u in utilities] != [(size,) for size in q.shape] or q.size == 0:
        raise ValueError(f"a table of shape {q.shape} needs utilities {[(s,) for s in q.shape]}, each with an action")
    if not all(np.isfinite(x).all() for x in [q, *utilities] if x.dtype.kind == "f"):
        raise ValueError("values must be finite")
    return q, utilities


def _check_situation(sizes, terminated, ongoing):
    if not len(sizes) == len(terminated) == len(ongoing):
        raise ValueError(f"terminated and ongoing must have one entry for each of the {len(sizes)} agents")
    for i, (size, done, m) in enumerate(zip(sizes, terminated, ongoing, strict=True)):
        if not done and not 0 <= m < size:
            raise ValueError(f"agent {i} has macro-actions 0..{size - 1}, ongoing is {m}")


def _known(ties):
    if ties not in TIES:
        raise ValueError(f"ties must be one of {TIES}, got {ties!r}")
    return ties
