"""The timeline of an episode: who runs which macro-action when, at which rows agents choose, rewards and return.

Lengths and positions are in pixels of a picture of WIDTH, which is doubled in the end.
"""

from dataclasses import dataclass
from math import ceil
from typing import NamedTuple

import numpy as np

from envs import rendering
from envs.rendering import ALARM, GREEN_DARK, INK, MUTED, PAPER, WHITE, Canvas


class Episode(NamedTuple):
    """T steps of n agents. Step t leads from time t to time t + 1; macro-actions start and end at times."""

    labels: list  # [n], what the agents' discs say
    names: list  # [n][A], the names of the macro-actions
    chosen: np.ndarray  # bool [T, n], the agent started a macro-action at time t
    running: np.ndarray  # int64 [T, n], its macro-action in step t
    rewards: np.ndarray  # float64 [T]
    utilities: np.ndarray | None  # float32 [T, n, A], what its network said at time t, -inf for padding
    meaning: str  # of the utilities: "utility" or "probability"

    def rows(self):
        """The decision rows: times at which at least one agent started a macro-action."""
        return np.flatnonzero(self.chosen.any(1)).tolist()

    def bars(self, agent):
        """The agent's macro-actions in their order, (start, end, macro-action) each."""
        starts = np.flatnonzero(self.chosen[:, agent]).tolist()
        ends = [*starts[1:], len(self.chosen)]
        return list(zip(starts, ends, self.running[starts, agent].tolist(), strict=True))


WIDTH, LEFT, RIGHT = 1000, 92, 56  # the picture and its margins, in pixels before the picture is doubled
HEAD, LANES, FOOT = 206, 26, 124  # heights above the first strip, in a strip above its lanes and below them
BAR, LANE = 22, 38  # heights of a bar and of its lane, which is higher where it has utilities below the bar
RULE = "#aab5bf"
WORDS = "Asynchronous: macro-actions end at different times, so at a row some agents choose and the others go on."


def shorten(name):
    """A macro-action's initials and arguments, or two letters: Pass-to-M(0) is PtM(0), Go-TR is GTR, Stay is St."""
    stem, bracket, arguments = name.partition("(")
    words = stem.split("-")
    initials = "".join(word if word.isupper() else word[0] for word in words)
    return (initials if len(words) > 1 else stem[:2]) + bracket + arguments


def example_row(episode, first, last):
    """The row between two times that shows best what ongoing means, or None: one at which an agent is ongoing.

    Better are two ongoing ones, and other rows at a distance of three steps.
    """
    rows, scores = episode.rows(), {}
    for before, row, after in zip([first, *rows], rows, [*rows[1:], last], strict=False):
        if first < row < last and not episode.chosen[row].all():
            ongoing = np.count_nonzero(~episode.chosen[row])
            scores[row] = min(ongoing, 2), min(row - before, after - row, last - row, 3), -row
    return max(scores, key=scores.get, default=None)


def draw(episode, title, facts, steps=None):
    """The timeline of an episode: a lane for each agent, a line for each decision row, rewards and return.

    title, facts: its first lines. steps: None for the whole episode, or (first, last) for the part between two times,
    enlarged, with what the agents' networks said.

    Returns uint8 [height, width, 3].
    """
    first, last = steps or (0, len(episode.rewards))
    length = ceil((last - first) / ceil((last - first) / (12 if steps else 50)))  # steps in a strip
    spans = [(start, min(start + length, last)) for start in range(first, last, length)]
    best = min(3, max(map(len, episode.names))) if steps and episode.utilities is not None else 0
    lane = BAR + 10 + 12 * best if best else LANE
    height = LANES + lane * len(episode.labels) + FOOT
    canvas = Canvas(2 * WIDTH, 2 * (HEAD + height * len(spans) + 14)).at(0, 0, 2)
    canvas.text(24, 30, title, 20, bold=True)
    canvas.text(24, 56, facts, 13, MUTED)
    canvas.text(24, 80, WORDS, 13)
    _draw_legend(canvas.at(24, 106), episode, f"the {best} of highest {episode.meaning}" if best else None)
    row, pitch = example_row(episode, *spans[0]), (WIDTH - LEFT - RIGHT) / length
    key = {rendering.ARM: "the arm"} if rendering.ARM in episode.labels else {}
    _draw_example(canvas.at(0, 126), episode, row, spans[0], pitch)
    for number, span in enumerate(spans):
        _Strip(canvas.at(LEFT, HEAD + height * number), episode, *span, pitch, lane, best, row, key).draw()
    words = " · ".join(f"{short}: {name}" for short, name in sorted(key.items()))
    canvas.text(24, HEAD + height * len(spans) - 6, words, 11, MUTED)
    return canvas.pixels()


def _draw_legend(canvas, episode, utilities):
    """What the marks mean. The example of a macro-action is the longest one of agent 0 with its shortest name."""
    bars = [(episode.names[0][action], start, end - start) for start, end, action in episode.bars(0)]
    name, start, steps = min(bars, key=lambda bar: (len(bar[0]), -bar[2]))
    name = name if len(name) < 12 else shorten(name)
    _draw_dot(canvas, 6, 0)
    x = _draw_words(canvas, 17, 0, "an agent chooses") + 22
    canvas.box(x, -9, 1, 18, RULE)
    x = _draw_words(canvas, x + 8, 0, "row: a time at which at least one agent chooses") + 22
    words = f"{name} · {steps}"
    canvas.box(x, -9, canvas.width(words, 12) + 16, 18, rendering.AGENTS[0][0], radius=3)
    canvas.text(x + 8, 0, words, 12, WHITE)
    x = _draw_words(canvas, x + canvas.width(words, 12) + 24, 0, "macro-action and its steps") + 22
    if utilities:
        words = f"{name}  {episode.utilities[start, 0].max():.2f}"
        canvas.text(x, 0, words, 10)
        _draw_words(canvas, x + canvas.width(words, 10) + 8, 0, utilities)


def _draw_example(canvas, episode, row, span, pitch):
    """A box that explains one row of the first strip."""
    canvas.box(24, 0, WIDTH - 48, 52, WHITE, INK, 1, 6)
    if row is None:
        canvas.text(40, 26, f"Up to t = {span[1]} all agents choose at every row: nobody is ongoing.", 12)
        return
    x = LEFT + pitch * (row - span[0])
    canvas.polygon([(x - 7, 51), (x, 62), (x + 7, 51)], WHITE, INK)
    canvas.box(x - 5.5, 48, 11, 3.5, WHITE)
    canvas.text(40, 26, f"row {episode.rows().index(row)}, t = {row}", 13, bold=True)
    _draw_dot(canvas, 172, 15)
    _draw_tag(canvas, 172, 37)
    running = [names[action] for names, action in zip(episode.names, episode.running[row], strict=True)]
    agents, chosen = list(zip(episode.labels, running, strict=True)), episode.chosen[row]
    _draw_words(canvas, 190, 15, "chosen now:", *(agents[agent] for agent in np.flatnonzero(chosen)))
    words = "running macro-actions of the ongoing agents, which have no dot:"
    _draw_words(canvas, 190, 37, words, *(agents[agent] for agent in np.flatnonzero(~chosen)))


def _draw_words(canvas, x, y, words, *agents):
    """Words and agents, (label, macro-action) each, one after the other; returns where they end."""
    canvas.text(x, y, words, 12)
    x += canvas.width(words, 12) + 8
    for number, (label, name) in enumerate(agents):
        end = x + 20 + canvas.width(name, 12)
        if end > WIDTH - (40 if number == len(agents) - 1 else 110):
            canvas.text(x, y, f"and {len(agents) - number} more", 12)
            break
        rendering._agent(canvas, x + 8, y, 8, label)
        canvas.text(x + 20, y, name, 12)
        x = end + 8
    return x


def _draw_dot(canvas, x, y):
    canvas.disc(x, y, 5.7, WHITE)
    canvas.disc(x, y, 4.5, INK)


def _draw_tag(canvas, x, y):
    """The mark of an ongoing agent: m with a raised minus, which the font does not have."""
    canvas.box(x - 12, y - 8, 24, 16, WHITE, INK, 1, 8)
    canvas.text(x - 8, y, "m", 12, bold=True)
    canvas.box(x + 3, y - 4.3, 5, 1.2, INK)


def _fit(canvas, size, rooms, *candidates):
    """The first of the candidates that fits into one of the rooms, (left, right) each, and where it begins."""
    for words in candidates:
        for left, right in rooms:
            if canvas.width(words, size) <= right - left:
                return words, left
    return "", 0


@dataclass
class _Strip:
    """The part of a timeline between two times, as wide as the picture; its canvas begins at the first one."""

    canvas: Canvas
    episode: Episode
    first: int
    last: int
    pitch: float  # pixels of a step
    lane: int  # height of a lane
    best: int  # how many utilities are shown
    example: int | None  # the marked row
    key: dict  # what abbreviations stand for; collected

    def x(self, time):
        """Where a time is; one outside the strip is put to its end."""
        return (min(max(time, self.first), self.last) - self.first) * self.pitch

    def draw(self):
        bottom = LANES + self.lane * len(self.episode.labels)
        for agent, label in enumerate(self.episode.labels):
            top = LANES + self.lane * agent
            self.canvas.box(0, top + 2, self.x(self.last), self.lane - 4, WHITE, radius=4)
            rendering._agent(self.canvas, -26, top + 4 + BAR / 2, 11, label)
        self.draw_rows(bottom + 86)
        for agent in range(len(self.episode.labels)):
            self.draw_lane(self.canvas.at(0, LANES + self.lane * agent + 4), agent)
        self.draw_rewards(self.canvas.at(0, bottom))
        self.draw_return(self.canvas.at(0, bottom + 48))
        self.draw_time(self.canvas.at(0, bottom + 86))

    def draw_rows(self, bottom):
        self.canvas.text(-16, 12, "row", 12, MUTED, "r")
        free = -10  # where there is room for the next number
        for number, row in enumerate(self.episode.rows()):
            if self.first <= row < self.last:
                x, half, marked = self.x(row), self.canvas.width(number, 11) / 2, row == self.example
                self.draw_line(self.canvas, row, 20, bottom, RULE)
                if marked:
                    self.canvas.box(x - 11, 4, 22, 16, INK, radius=8)
                if x - half > free or marked:
                    self.canvas.text(x, 12, number, 11, WHITE if marked else MUTED, "m")
                    free = x + half + 3
        if self.last == len(self.episode.rewards):
            self.canvas.text(max(self.x(self.last), free + 12), 12, "end", 11, MUTED, "m")

    def draw_line(self, canvas, row, top, bottom, colour):
        width, colour = (1.8, INK) if row == self.example else (1, colour)
        canvas.box(self.x(row) - width / 2, top, width, bottom - top, colour)

    def draw_lane(self, canvas, agent):
        fill, ink = rendering._colours(self.episode.labels[agent])
        bars = [bar for bar in self.episode.bars(agent) if bar[0] < self.last and bar[1] > self.first]
        unnamed = []  # runs of bars too short for their name: [start, end, name, how many]
        for start, end, action in bars:
            name, left, right = self.episode.names[agent][action], self.x(start), self.x(end) - 1.5
            left -= 8 * (start < self.first)  # one that is cut sticks out
            right += 9.5 * (end > self.last)
            canvas.box(left, 0, right - left, BAR, fill, radius=3)
            rooms = [(left + 8, right - 6)]
            for row in self.episode.rows():
                if max(start, self.first - 1) < row < min(end, self.last):
                    self.draw_line(canvas, row, 0, BAR, RULE if ink == WHITE else MUTED)
                    if row == self.example:
                        _draw_tag(canvas, self.x(row), BAR / 2)
                        rooms = [(left + 8, self.x(row) - 13), (self.x(row) + 14, right - 6)]
            whole = ("... " if start < self.first else "") + name
            words, at = _fit(canvas, 12, rooms, f"{whole} · {end - start}", whole, shorten(name))
            if words:
                canvas.box(at - 1, 4, canvas.width(words, 12) + 2, BAR - 8, fill)  # no line through the words
                self.draw_name(canvas, at, BAR / 2, words, name, 12, ink)
            elif unnamed and unnamed[-1][1:3] == [start, name]:
                unnamed[-1][1], unnamed[-1][3] = end, unnamed[-1][3] + 1
            else:
                unnamed.append([start, end, name, 1])
        for start, end, _ in bars:
            if start >= self.first:
                _draw_dot(canvas, self.x(start), BAR / 2)
                if self.best:
                    part = canvas.at(self.x(start) + 4, BAR + 8)
                    self.draw_utilities(part, agent, start, self.x(end) - self.x(start) - 8)
        for start, end, name, count in () if self.best else unnamed:
            self.draw_names(canvas.at(0, BAR + 6), self.x(start), self.x(end) - 1.5, name, count)

    def draw_name(self, canvas, x, y, words, name, size, ink):
        """Words that stand for a name; an abbreviation goes into the key."""
        canvas.text(x, y, words, size, ink)
        if words and name not in words:
            self.key[shorten(name).partition("(")[0]] = name.partition("(")[0]

    def draw_names(self, canvas, left, right, name, count):
        """The name of bars that have no room for it, below them; of several with a bracket."""
        times = f" x{count}" if count > 1 else ""
        words, _ = _fit(canvas, 10, [(left - 2, right)], name + times, shorten(name) + times, shorten(name))
        if words and count > 1:
            canvas.box(left, 0, right - left, 1, INK)
            canvas.box(left, -4, 1, 5, INK)
            canvas.box(right, -4, 1, 5, INK)
        if words:
            width = canvas.width(words, 10)
            start = (left + right - width) / 2
            canvas.box(start - 3, -4, width + 6, 11, WHITE)
            self.draw_name(canvas, start, 2, words, name, 10, INK)

    def draw_utilities(self, canvas, agent, time, room):
        """The best macro-actions and their utilities, or as much of that as there is room for."""
        said, names = self.episode.utilities[time, agent], self.episode.names[agent]
        best = np.argsort(-said[: len(names)], kind="stable")[: self.best]
        digits = 1 if np.abs(said[: len(names)]).max() >= 10 else 2
        values = [f"{round(float(said[action]), digits) + 0.0:.{digits}f}" for action in best]  # + 0.0: not -0.0
        full = [names[action] for action in best]
        for words in (full, [shorten(name) for name in full], [""] * len(best)):
            width = max(canvas.width(f"{word}  {value}", 10) for word, value in zip(words, values, strict=True))
            if width <= room:
                break
        canvas.box(-1, -6, width + 2, 12 * len(best) - 1, WHITE)
        for line, (word, value, name) in enumerate(zip(words, values, full, strict=True)):
            ink = MUTED if line else INK
            self.draw_name(canvas, 0, 12 * line, word, name, 10, ink)
            canvas.text(width, 12 * line, value, 10, ink, "r")

    def draw_rewards(self, canvas):
        """A mark for each reward that is not 0, with a number where it is not the usual one."""
        values, counts = np.unique(self.episode.rewards, return_counts=True)
        usual, largest, free = values[counts.argmax()], np.abs(values).max(), 0
        canvas.text(-16, 22, "reward", 12, MUTED, "r")
        canvas.text(-16, 36, f"mostly {usual:+.4g}" if usual else "", 10, MUTED, "r")
        canvas.box(0, 24, self.x(self.last), 1, RULE)
        for step in range(self.first, self.last):
            reward, x, words = self.episode.rewards[step], self.x(step + 0.5), f"{self.episode.rewards[step]:+.4g}"
            colour, place = (GREEN_DARK, 14) if reward > 0 else (ALARM, 35)
            if reward:
                height = 2 + 14 * abs(reward) / largest
                canvas.box(x - 1.5, 24 - height if reward > 0 else 25, 3, height, colour)
            if reward not in (0, usual) and x > free:
                canvas.box(x + 3, place - 6, canvas.width(words, 11) + 2, 12, PAPER)
                canvas.text(x + 4, place, words, 11, colour)
                free = x + 6 + canvas.width(words, 11)

    def draw_return(self, canvas):
        total = np.append(0.0, self.episode.rewards.cumsum())
        heights = 28 - 28 * (total - total.min()) / max(np.ptp(total), 1e-9)
        canvas.text(-16, 14, "return so far", 12, MUTED, "r")
        canvas.line([(self.x(time), heights[time]) for time in range(self.first, self.last + 1)], INK, 1.5)
        canvas.disc(self.x(self.last), heights[self.last], 3, INK)
        canvas.text(self.x(self.last) + 8, heights[self.last], f"{total[self.last]:.4g}", 12, bold=True)

    def draw_time(self, canvas):
        canvas.text(-16, 13, "time t", 12, MUTED, "r")
        canvas.box(0, 0, self.x(self.last), 1, MUTED)
        every = 1 if self.pitch >= 24 else 5
        for time in range(self.first, self.last + 1):
            labelled = time % every == 0
            canvas.box(self.x(time) - 0.5, 0, 1, 6 if labelled else 3, MUTED)
            canvas.text(self.x(time), 13, time if labelled else "", 11, MUTED, "m")
