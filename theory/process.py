"""A two-agent macro-action process small enough to enumerate, and what each mixer input says of its joint values.

The delivery process. A carrier makes two trips, each by `hand` (2 steps) or by `cart` (3 steps). A keeper holds the
door: `open` (1 step) or `tidy` (1 or 2 steps with probability 1/2 each, or 2 for sure), the door being shut meanwhile.
A trip whose last step finds the door open pays 1 by hand, 2 by cart. Both choose uniformly at random unless told
otherwise. The episode ends with the second trip. The same process is looked at through three state vectors:

    "position"   (trips made, steps walked on this trip): a running trip's progress shows in the state
    "clock"      (trips made, time): progress shows only in comparison with the state at the trip's start
    "trips"      (trips made): progress does not show at all

All numbers are Fractions, so equal means equal.
"""

from collections import defaultdict
from fractions import Fraction
from functools import cached_property
from itertools import product
from typing import NamedTuple

CARRIER = 0
KEEPER = 1
STEPS = {"hand": 2, "cart": 3}
PAY = {"hand": 1, "cart": 2}
TRIPS = 2
SHOWS = ("position", "clock", "trips")
INPUTS = ("joint", "single_chose", "single_ends", "real", "real-both", "decision", "decision+elapsed")
VIEWS = ("actions", "chosen", "histories")


class Row(NamedTuple):
    """A decision situation: all there is to know at a decision row k, once the agents that are free have chosen.

    Attributes:
        trips, walked, time: trips made, steps walked on the running one, steps since the start: int.
        macros: joint macro-action m, 2 strings. chosen: who started its macro-action at this row, 2 bools; the others
            are ongoing, so m^- is `macros` where `chosen` is False.
        elapsed: steps for which each macro-action has run, 2 ints, 0 where chosen.
        histories: macro-history of each agent when it last chose: a tuple of its own macro-actions, and for the carrier
            of what it then observed (was the door open?). state: the true state. macro_states: joint macro-state.
    """

    trips: int
    walked: int
    time: int
    macros: tuple
    chosen: tuple
    elapsed: tuple
    histories: tuple
    state: tuple
    macro_states: tuple


class Interval(NamedTuple):
    """One way in which the steps from a row up to the next one can turn out.

    Attributes:
        probability: Fraction. reward: discounted sum over the interval. discount: gamma^tau, 0 at the episode's end.
        last_state: the true state at the interval's last step. ended: whose macro-action ended with it, 2 bools.
        next_rows: {Row: probability} of the next decision row, empty at the episode's end.
    """

    probability: Fraction
    reward: Fraction
    discount: Fraction
    last_state: tuple
    ended: tuple
    next_rows: dict


def uniform(agent, history):
    """Policy of the process: {macro-action: probability} for an agent with this macro-history."""
    names = ("hand", "cart") if agent == CARRIER else ("open", "tidy")
    return {name: Fraction(1, 2) for name in names}


class Delivery:
    """The delivery process under a decentralised policy.

    Args:
        shows: what the state vector shows, one of SHOWS.
        random_tidy: tidy takes 1 or 2 steps at random; False: always 2, the process is then deterministic.
        gamma: discount per step, Fraction or int.
        policy: maps (agent, macro-history) to {macro-action: probability}: how rows are visited, and
            the value of what follows a row.
        optimal: value what follows a row by the conditional maximum of Eq. 5 instead, taken by a team that knows all.

    Raises:
        ValueError: `shows` is unknown.
    """

    def __init__(self, shows, random_tidy=True, gamma=1, policy=uniform, optimal=False):
        if shows not in SHOWS:
            raise ValueError(f"shows must be one of {SHOWS}, got {shows!r}")
        self.shows = shows
        self.random_tidy = random_tidy
        self.gamma = Fraction(gamma)
        self.policy = policy
        self.optimal = optimal
        self._intervals = {}  # those that were asked for, by row
        self._values = {}

    def state(self, trips, walked, time):
        """The true state as the environment reports it: a tuple of ints."""
        vectors = {
            "position": (trips, walked),
            "clock": (trips, time),
            "trips": (trips,),
        }
        return vectors[self.shows]

    def start_rows(self):
        """{Row: probability} of the first decision row."""
        nothing = (None, None)
        return self._choose(0, 0, 0, nothing, (True, True), (0, 0), ((), ()), nothing)

    def _choose(self, trips, walked, time, macros, chosen, elapsed, histories, macro_states):
        """{Row: probability} of what the agents that choose here can choose."""
        state = self.state(trips, walked, time)
        macro_states = tuple(state if new else old for new, old in zip(chosen, macro_states, strict=True))
        options = []
        for agent in (CARRIER, KEEPER):
            goes_on = {macros[agent]: Fraction(1)}
            options.append(self.policy(agent, histories[agent]) if chosen[agent] else goes_on)
        rows = {}
        for (trip, p), (keeping, q) in product(options[CARRIER].items(), options[KEEPER].items()):
            if p * q:
                row = Row(trips, walked, time, (trip, keeping), chosen, elapsed, histories, state, macro_states)
                rows[row] = p * q
        return rows

    def intervals(self, row):
        """Every way in which the interval that starts at `row` can turn out: a list of Interval."""
        if row not in self._intervals:
            certain = Fraction(1)
            steps = self._run(row, row.time, row.walked, row.elapsed[KEEPER], certain, discount=certain)
            self._intervals[row] = list(steps)
        return self._intervals[row]

    def _run(self, row, time, walked, tidied, probability, discount):
        """Yields the Intervals that begin with a step at `time`. walked, tidied: for how many steps so far."""
        trip, keeping = row.macros
        arrives = walked + 1 == STEPS[trip]
        if keeping == "open" or tidied == 1:
            keeper_ends = Fraction(1)
        else:
            keeper_ends = Fraction(1, 2) if self.random_tidy else Fraction(0)
        for ends, chance in ((True, keeper_ends), (False, 1 - keeper_ends)):
            if not chance:
                continue
            p = probability * chance
            after_step = discount * self.gamma
            if not arrives and not ends:
                yield from self._run(row, time + 1, walked + 1, tidied + 1, p, after_step)
                continue
            trips = row.trips + 1 if arrives else row.trips
            last = trips == TRIPS
            ended = (arrives or last, ends or last)
            reward = discount * PAY[trip] if arrives and keeping == "open" else Fraction(0)
            next_rows = {}
            if not last:
                elapsed = (0 if arrives else walked + 1, 0 if ends else tidied + 1)
                histories = self._grown(row, ended)
                there = (trips, elapsed[CARRIER], time + 1)
                next_rows = self._choose(*there, row.macros, ended, elapsed, histories, row.macro_states)
            last_state = self.state(row.trips, walked, time)
            yield Interval(p, reward, Fraction(0) if last else after_step, last_state, ended, next_rows)

    def _grown(self, row, ended):
        """The macro-histories after a row's interval. They grow by what ended, the carrier's also by what it sees."""
        trip, keeping = row.macros
        news = ((trip, keeping == "open"), (keeping,))
        return tuple((*old, new) if end else old for old, new, end in zip(row.histories, news, ended, strict=True))

    def value(self, row):
        """Joint value of the situation: the expected discounted return from `row` on, given all there is to know."""
        if row not in self._values:
            outcomes = [i.probability * self.outcome(i) for i in self.intervals(row)]
            self._values[row] = sum(outcomes)
        return self._values[row]

    def outcome(self, interval):
        """Expected return from the interval's row on, given that the interval turns out like this."""
        values = {row: self.value(row) for row in interval.next_rows}
        if self.optimal:
            then = max(values.values(), default=0)
        else:
            then = sum(p * values[row] for row, p in interval.next_rows.items())
        return interval.reward + interval.discount * then

    @cached_property
    def rows(self):
        """{Row: expected visits per episode} of every reachable decision situation."""
        visits = defaultdict(Fraction)
        wave = self.start_rows()
        while wave:
            following = defaultdict(Fraction)
            for row, weight in wave.items():
                visits[row] += weight
                for interval in self.intervals(row):
                    for after, p in interval.next_rows.items():
                        following[after] += weight * interval.probability * p
            wave = following
        return dict(visits)


def mixer_state(name, row, interval=None):
    """What a mixer is fed as its state for Q(h, s, m) at `row` (Eq. 14).

    Args:
        name: one of INPUTS. "joint": the joint macro-state. "single_chose": the macro-state of the agent whose last
            macro-action ended just before the row, so that it chose there. "single_ends": of the agent whose
            macro-action ends with the row's interval, as in the worked example on Fig. 2. (Of several agents, the
            first.) "real" and "real-both": the true state at the interval's last step. "decision": the true state at
            the row. "decision+elapsed": and the steps for which each macro-action has run.
        row: Row.
        interval: the Interval that followed `row`, for the prediction Q. None: for the target Q', where it is not
            used. "real" is then the state right after the interval before, and "single_ends" the macro-state just
            taken by the agent that ended with it (Fig. 2): both are the state at the row. ("real-both" does use it.)

    Returns:
        A tuple.
    """
    if name == "joint":
        return row.macro_states
    if name == "single_chose":
        return row.macro_states[row.chosen.index(True)]
    if name == "decision+elapsed":
        return row.state, row.elapsed
    if name == "decision" or interval is None:
        return row.state
    if name == "single_ends":
        return row.macro_states[interval.ended.index(True)]
    return interval.last_state


def view(name, row):
    """What else a mixer sees at `row`, through the utilities or beside them.

    Args:
        name: one of VIEWS: "actions": the joint macro-action m; "chosen": and which agents chose, so m^-; "histories":
            and the individual macro-histories (utilities are functions of those: this is the most they can carry).
        row: Row.

    Returns:
        A tuple.
    """
    views = {
        "actions": row.macros,
        "chosen": (row.macros, row.chosen),
        "histories": (row.macros, row.chosen, row.histories),
    }
    return views[name]


def witness(process, state_name, view_name):
    """Two situations that a mixer cannot tell apart though their joint values differ.

    Returns:
        (Row, Row) or None: the input determines the joint value of every reachable situation.
    """
    seen = {}
    for row in process.rows:
        for interval in process.intervals(row):
            key = mixer_state(state_name, row, interval), view(view_name, row)
            other = seen.setdefault(key, row)
            if process.value(other) != process.value(row):
                return other, row
    return None


def is_function_of_row(process, state_name):
    """Whether each situation has one input: False if the input tells how the interval turned out."""
    for row in process.rows:
        inputs = {mixer_state(state_name, row, i) for i in process.intervals(row)}
        if len(inputs) > 1:
            return False
    return True


def learned(process, state_name, view_name):
    """The best prediction of the return from the mixer's input, E[return | input]: what a perfect fit converges to.

    Returns:
        {(state, view): Fraction} over every input that occurs in training.
    """
    weight = defaultdict(Fraction)
    total = defaultdict(Fraction)
    for row, visits in process.rows.items():
        for interval in process.intervals(row):
            key = mixer_state(state_name, row, interval), view(view_name, row)
            mass = visits * interval.probability
            weight[key] += mass
            total[key] += mass * process.outcome(interval)
    return {key: total[key] / weight[key] for key in weight}


def value_error(process, state_name, view_name):
    """Mean squared distance, over visited rows, between `learned` and the joint value: 0 iff it gets every value right.

    Returns:
        Fraction.
    """
    fit = learned(process, state_name, view_name)
    error = Fraction(0)
    for row, visits in process.rows.items():
        for interval in process.intervals(row):
            guess = fit[mixer_state(state_name, row, interval), view(view_name, row)]
            error += visits * interval.probability * (guess - process.value(row)) ** 2
    return error / sum(process.rows.values())


def target_error(process, state_name, view_name):
    """What goes wrong when the target Q' of Eq. 14 asks `learned` for the value of the next row.

    With "real-both" the answer depends on how that row's interval turns out. The mean over that is taken.

    Returns:
        unseen: share of the rows asked about whose input never occurs in training, Fraction.
        error: mean squared distance from the joint value over the other rows asked about, Fraction.
    """
    fit = learned(process, state_name, view_name)
    asked = defaultdict(Fraction)
    for row, visits in process.rows.items():
        for interval in process.intervals(row):
            for after, p in interval.next_rows.items():
                asked[after] += visits * interval.probability * p
    answered = Fraction(0)
    error = Fraction(0)
    for row, visits in asked.items():
        answer = Fraction(0)
        for interval in process.intervals(row):
            known = interval if state_name == "real-both" else None
            key = mixer_state(state_name, row, known), view(view_name, row)
            if key not in fit:
                break
            answer += interval.probability * fit[key]
        else:
            answered += visits
            error += visits * (answer - process.value(row)) ** 2
    return 1 - answered / sum(asked.values()), error / answered
