"""The timeline of an episode: who runs which macro-action when, at which rows agents choose, rewards and return.

A long episode is cut into strips, one below another. In the axes of a strip, x is time and y is the distance from the
top of the strip in points, 1/72 of an inch. All other lengths are in points, too.
"""

from dataclasses import dataclass
from itertools import groupby
from math import ceil
from textwrap import wrap
from unicodedata import east_asian_width

import numpy as np
from matplotlib import rc_context, style
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MultipleLocator

from envs.rendering import ALARM, ARM, GREEN_DARK, INK, MUTED, WHITE, agent_colours, find_font

WIDTH = 800  # of the figure
LEFT = 80  # from the left edge of the figure to the strips
RIGHT = 66  # from the strips to its right edge
MARGIN = 17  # from its left edge to the text above and below the strips
FOOT = 18  # from the last strip to its lower edge
ROWS = 10  # from the top of a strip to the numbers of its rows
LANES = 30  # from the top of a strip to the bars of the first agent
TIME = 88  # from the top of a strip to its axis of time, less the height of the lanes between them
STRIP = 122  # height of a strip, less that of its lanes
LANE = 30  # height of an agent's lane: a bar and the names below it
LANE_WITH_UTILITIES = 57  # height of a lane with room for three utilities, too
SMALL = 7  # sizes of text
LARGE = 8.5

# Matplotlib's options. MONO is for text whose letters are equally wide, on white. TAG is for the box around ONGOING.
# DOT is for the dot where an agent chooses.
MONO = {"family": "monospace", "bbox": {"facecolor": WHITE, "edgecolor": "none", "pad": 1}}
LETTER = 0.63 * SMALL  # width of a letter of MONO at size SMALL
TAG = {"boxstyle": "round,pad=0.15,rounding_size=0.5", "facecolor": WHITE}
DOT = {"marker": "o", "markersize": 7, "color": INK, "markeredgecolor": WHITE, "clip_on": False, "zorder": 3}
RULE = "#aab5bf"  # colour of the lines at rows

ONGOING = "m⁻"  # the paper's sign for a macro-action that goes on while others are chosen
WORDS = "Asynchronous: macro-actions end at different times, so at a row some agents choose and the others go on."
LEGEND = [
    "▬ macro-action · its steps (6, 1: twice in a row)",  # of 6 steps, then the same one again, of 1 step
    "● an agent chooses",
    "│ row: a time at which at least one agent chooses",
]


@style.context("default")  # whatever the user's own settings of matplotlib are
def draw(episode, title, facts, steps=None):
    """The timeline of a play.Episode as a matplotlib Figure. title, facts: its first two lines.

    steps: (first, last) for the part between two times, enlarged and with utilities; None for the whole episode.
    """
    first, last = steps or (0, len(episode.rewards))
    most_steps = 12 if steps else 45  # in a strip
    count = ceil((last - first) / most_steps)  # of strips
    length = ceil((last - first) / count)  # of a strip in steps
    first_end = min(first + length, last)  # of the first strip
    # The lines above the strips explain one row, the example row. It is in the first strip.
    example = example_row(episode, first, first_end)
    utilities = episode.utilities if steps else None
    lane = LANE if utilities is None else LANE_WITH_UTILITIES
    lines = [facts, WORDS, *LEGEND]
    if utilities is not None:
        lines.append(f"0.50 {episode.meaning}, highest first, 3 at most")  # 0.50 is a sample
    lines += ["", *describe(episode, example, first, first_end)]
    head = 40 + 14 * len(lines)  # from the upper edge of the figure to the strips
    strip_height = STRIP + lane * len(episode.labels)
    height = head + strip_height * count + FOOT

    figure = Figure((WIDTH / 72, height / 72), dpi=180)
    page = figure.add_axes((0, 0, 1, 1))  # for the text above and below the strips
    page.set(xlim=(0, WIDTH), ylim=(height, 0))
    page.set_axis_off()
    write(page, MARGIN, 22, title, size=15, weight="bold")
    for number, line in enumerate(lines):
        write(page, MARGIN, 42 + 14 * number, line, size=LARGE)
    page.hlines(head, MARGIN, WIDTH - MARGIN, INK, linewidth=1)

    column = figure.subplots(count, squeeze=False)[:, 0]  # the axes of the strips, from the top down
    figure.subplots_adjust(left=LEFT / WIDTH, right=1 - RIGHT / WIDTH, hspace=0)
    figure.subplots_adjust(top=1 - head / height, bottom=FOOT / height)
    pitch = (WIDTH - LEFT - RIGHT) / length
    shortened = set()
    for axes, start in zip(column, range(first, last, length), strict=True):
        end = min(start + length, last)
        axes.set(xlim=(start, start + length), ylim=(strip_height, 0), facecolor="none")
        strip = Strip(axes, episode, start, end, pitch, lane, utilities, shortened)
        strip.draw()
        if example in range(start, end):
            strip.mark(example)
    write(page, MARGIN, height - 5, explain(episode.labels, shortened), color=MUTED, va="bottom")
    return figure


def save(figure, path, kind):
    """Writes a figure as "png", "svg" or "pdf". The same figure gives the same bytes, and its text can be selected."""
    settings = {
        "svg.fonttype": "none",  # text, not outlines of letters
        "pdf.fonttype": 42,
        "svg.hashsalt": "timeline",  # instead of a random one
    }
    no_date = {"svg": {"Date": None}, "pdf": {"CreationDate": None}}
    with rc_context(settings):
        figure.savefig(path, format=kind, metadata=no_date.get(kind))


# ---- what is said ---------------------------------------------------------------------------------------------------
def example_row(episode, first, last):
    """The time of the row between two times that shows best what ongoing means, or None if nobody is ongoing at any.

    Two ongoing agents show it better than one. Among equals, a row that is three steps from its neighbours or more has
    the most room for marks.
    """
    rows = episode.rows()

    def score(row):
        ongoing = np.count_nonzero(~episode.chosen[row])
        distance = min(abs(row - time) for time in (first, *rows, last) if time != row)
        return min(ongoing, 2), min(distance, 3)

    candidates = [row for row in rows if first < row < last and not episode.chosen[row].all()]
    return max(candidates, key=score, default=None)


def describe(episode, row, first, last):
    """Lines about the example row. If there is none, one that says that nobody is ongoing at any row between."""
    if row is None:
        return [f"At no row between t = {first} and t = {last} an agent is ongoing."]
    chosen = []
    ongoing = []
    for agent, label in enumerate(episode.labels):
        name = episode.names[agent][episode.running[row, agent]]
        group = chosen if episode.chosen[row, agent] else ongoing
        group.append(f"agent {label} {name}")
    words = f"{ONGOING} running macro-actions of the ongoing agents, which have no dot:"
    number = episode.rows().index(row)
    lines = [f"row {number}, t = {row}"]
    lines += fold(f"● chosen now: {', '.join(chosen)}")
    lines += fold(f"{words} {', '.join(ongoing)}")
    return lines


def shorten(name):
    """A macro-action's initials and arguments, or two letters: Pass-to-M(0) is PtM(0), Go-TR is GTR, Stay is St."""
    stem, bracket, arguments = name.partition("(")
    words = [word for word in stem.split("-") if word]
    initials = [word if word.isupper() else word[:1] for word in words]
    short = "".join(initials) if len(words) > 1 else stem[:2]
    return short + bracket + arguments


def explain(labels, names):
    """What abbreviations mean, such as "A: the arm · GW: Go-W" for the name Go-W(0)."""
    stems = {name.partition("(")[0] for name in names}
    entries = sorted(f"{shorten(stem)}: {stem}" for stem in stems)
    if ARM in labels:
        entries.insert(0, f"{ARM}: the arm")
    return "\n".join(fold(" · ".join(entries)))


def fold(words):
    """The words as a list of lines that are not wider than the figure."""
    return wrap(words, 140, break_on_hyphens=False)


def wide(words):
    """How many letters of the Latin alphabet are as wide as the words. Those of East Asia are twice as wide."""
    return sum(2 if east_asian_width(letter) in "WF" else 1 for letter in words)


def write(axes, x, y, words, family="sans-serif", **options):
    """Writes words at (x, y), where y is the middle of their height. The options are those of matplotlib's text."""
    options = {"size": SMALL, "color": INK, "va": "center", **options}
    families = [family, find_font(str(words)).name]  # the second is for letters that the first lacks
    axes.text(x, y, words, family=families, parse_math=False, **options)  # a name may contain dollar signs


# ---- strips ---------------------------------------------------------------------------------------------------------
@dataclass
class Strip:
    """The part of an episode between two times, and the axes in which it is drawn."""

    axes: Axes
    episode: object  # a play.Episode
    first: int
    last: int
    pitch: float  # width of a step; points divided by it are steps, the unit of x
    lane: int  # height of an agent's lane
    utilities: np.ndarray | None  # those of the episode, or None if they are not shown
    shortened: set  # receives the names that are abbreviated

    def draw(self):
        """Draws everything from the numbers of the rows down to the axis of time."""
        self.draw_rows()
        for agent in range(len(self.episode.labels)):
            self.draw_lane(agent)
        self.draw_rewards()
        self.draw_return()
        self.draw_time()

    def middle(self, agent):
        """How far the middle of an agent's bars is from the top."""
        return LANES + self.lane * agent

    def bottom(self):
        """How far the axis of time is from the top."""
        return TIME + self.lane * len(self.episode.labels)

    def label(self, y, words):
        """Writes words on the left of the strip."""
        write(self.axes, self.first - 11 / self.pitch, y, words, color=MUTED, ha="right")

    def draw_rows(self):
        """Draws a number and a line for each row."""
        self.label(ROWS, "row")
        for number, time in enumerate(self.episode.rows()):
            if self.first <= time < self.last:
                self.axes.vlines(time, ROWS + 8, self.bottom(), RULE, linewidth=0.8)
                write(self.axes, time, ROWS, number, color=MUTED, ha="center", **MONO)
        if self.last == len(self.episode.rewards):
            write(self.axes, self.last, ROWS, "end", color=MUTED)

    def mark(self, row):
        """Draws a line from the example row up to its description, and a tag on the bar of each ongoing agent."""
        self.axes.vlines(row, 0, self.bottom(), INK, linewidth=1.6)
        for agent in np.flatnonzero(~self.episode.chosen[row]):
            write(self.axes, row, self.middle(agent), ONGOING, ha="center", weight="bold", bbox=TAG)

    def draw_lane(self, agent):
        """Draws an agent's bars, dots where it chooses, and below the bars their names and the utilities."""
        label = self.episode.labels[agent]
        names = self.episode.names[agent]
        color, _ = agent_colours(label)
        y = self.middle(agent)
        self.label(y, f"agent {label}")
        bars = [bar for bar in self.episode.bars(agent) if bar.start < self.last and bar.end > self.first]
        for bar in bars:
            self.axes.barh(y, bar.end - bar.start, 12, bar.start, color=color)
            if bar.start >= self.first:
                self.axes.plot(bar.start, y, **DOT)
                if self.utilities is not None:
                    self.write_utilities(agent, bar, y + 22)
        for action, group in groupby(bars, key=lambda bar: bar.action):
            self.write_names(names[action], list(group), y + 12)

    def write_names(self, name, bars, y):
        """Writes the name that successive bars have in common: below each of them if there is room, otherwise once."""
        shortest = min(bar.end - bar.start for bar in bars)
        if wide(name) <= self.letters(shortest):
            for bar in bars:
                self.write_name(name, [bar], y)
        else:
            self.write_name(name, bars, y)

    def write_name(self, name, bars, y):
        """Writes a name once below successive bars, with the steps of each or, for want of room, how many bars."""
        start = max(bars[0].start, self.first)
        end = min(bars[-1].end, self.last)
        steps = ", ".join(str(bar.end - bar.start) for bar in bars)
        whole = f"{name} · {steps}" if bars[0].start == start else f"... {name} · {steps}"
        times = f" x{len(bars)}" if len(bars) > 1 else ""
        short = shorten(name)
        words = self.fit(name, [whole, name + times, short + times, short], end - start)
        write(self.axes, start, y, words, **MONO)

    def write_utilities(self, agent, bar, y):
        """Writes below the dot of a bar what the agent's network liked best there, and how much."""
        names = self.episode.names[agent]
        utilities = self.utilities[bar.start, agent, : len(names)]
        room = min(bar.end, self.last) - bar.start
        order = np.argsort(-utilities, kind="stable")
        could_start = [action for action in order if utilities[action] > -np.inf]
        for line, action in enumerate(could_start[:3]):
            name = names[action]
            value = f"{utilities[action]:z.2f}"  # z: 0.00, never -0.00
            candidates = [f"{value} {name}", f"{value} {shorten(name)}", value]
            words = self.fit(name, candidates, room)
            write(self.axes, bar.start, y + 9 * line, words, color=MUTED, **MONO)

    def letters(self, steps):
        """How many letters fit in the width of some steps and leave a little space, a float."""
        return steps * self.pitch / LETTER - 0.5

    def fit(self, name, candidates, steps):
        """The first of the candidates that is not wider than some steps, or "" if there is none.

        If it abbreviates the name, the name is added to `shortened`.
        """
        words = next((candidate for candidate in candidates if wide(candidate) <= self.letters(steps)), "")
        if shorten(name) in words and name not in words:
            self.shortened.add(name)
        return words

    def draw_rewards(self):
        """Draws a mark for each reward. Where there is room, one that is neither 0 nor the usual one has a number."""
        rewards = self.episode.rewards
        values, counts = np.unique(rewards, return_counts=True)
        usual = values[counts.argmax()]
        largest = np.abs(values).max() or 1.0
        y = self.bottom() - 52
        self.label(y, f"reward\nmostly {usual:+.4g}" if usual else "reward")
        self.axes.axhline(y, color=RULE, linewidth=0.8)
        free = self.first  # the time from which on there is room
        for step in range(self.first, self.last):
            reward = rewards[step]
            side = -np.sign(reward)  # -1 draws above the line, 1 below it
            color = GREEN_DARK if reward > 0 else ALARM
            tip = y + side * (2 + 10 * abs(reward) / largest)
            self.axes.vlines(step + 0.5, y, tip, color, linewidth=2.5)
            if reward not in (0, usual) and step >= free:
                words = f"{reward:+.4g}"
                write(self.axes, step + 0.5 + 4 / self.pitch, y + side * 8, words, color=color, family="monospace")
                free = step + (len(words) + 1) * LETTER / self.pitch

    def draw_return(self):
        """Draws the sum of the rewards so far."""
        total = np.append(0.0, self.episode.rewards.cumsum())
        share = (total - total.min()) / max(np.ptp(total), 1e-9)
        y = self.bottom() - 8 - 22 * share
        times = range(self.first, self.last + 1)
        self.label(self.bottom() - 19, "return so far")
        self.axes.plot(times, y[times], color=INK, linewidth=1.2)
        words = f"{total[self.last]:z.4g}"
        write(self.axes, self.last + 6 / self.pitch, y[self.last], words, size=LARGE, weight="bold")

    def draw_time(self):
        """Draws the axis of time."""
        axes = self.axes
        self.label(self.bottom() + 9, "time t")
        axes.xaxis.set_major_locator(MultipleLocator(1 if self.pitch >= 20 else 5))
        axes.xaxis.set_minor_locator(MultipleLocator(1))
        axes.set_yticks([])
        axes.tick_params(labelcolor=MUTED, labelsize=SMALL)
        axes.spines[:].set_visible(False)
        axes.spines["bottom"].set(visible=True, position=("data", self.bottom()))
