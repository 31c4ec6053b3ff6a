"""timeline.py: what it draws is what was recorded, and it can be read."""

import re

import numpy as np
import pytest
import torch
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import to_hex

import envs
import play
import timeline
from envs.rendering import AGENTS, ALARM, GREEN_DARK, INK
from tests import fonts
from tests.recording import scripted


@pytest.fixture
def episode():
    return scripted().episode()


def said(axes):
    """The words of one or several axes, in the order in which they were written."""
    return [text.get_text() for one in np.atleast_1d(axes) for text in one.texts if text.get_text()]


def strips(figure):
    return figure.axes[1:]


def dots(strip, y):
    """The times of the dots at a height of a strip."""
    return [line.get_xdata()[0] for line in strip.lines if line.get_marker() == "o" and line.get_ydata()[0] == y]


def bars(strip, y):
    """(start, end, colour) of the bars around a height of a strip."""
    boxes = [patch for patch in strip.patches if patch.get_y() < y < patch.get_y() + patch.get_height()]
    return [(box.get_x(), box.get_x() + box.get_width(), to_hex(box.get_facecolor())) for box in boxes]


def places(strip, words):
    """Where words stand in a strip: (time, height) each."""
    return [text.get_position() for text in strip.texts if text.get_text() == words]


def lines(strip, colour):
    """The upright lines of a colour: (time, from one height, to another) each."""
    found = []
    for lines in strip.collections:
        (start, top), (end, bottom) = lines.get_segments()[0]
        if to_hex(lines.get_color()[0]) == colour:
            assert start == end
            found.append((start, top, bottom))
    return found


def lane(strip, label):
    """The height at which the lane of an agent is."""
    ((_, y),) = places(strip, f"agent {label}")
    return y


def test_a_bar_a_dot_and_a_name_for_each_macro_action(episode):
    (strip,) = strips(timeline.draw(episode, "title", "facts"))
    for agent in range(2):
        y = lane(strip, agent)
        expected = episode.bars(agent)
        colour, _ = AGENTS[agent]
        assert bars(strip, y) == [(start, end, colour) for start, end, _ in expected]
        assert dots(strip, y) == [start for start, _, _ in expected]
        for start, end, action in expected:
            name = f"{episode.names[agent][action]} · {end - start}"
            assert [place for place in places(strip, name) if place[0] == start and y < place[1] < y + 20], name
    assert said(strip).count("Stay · 1") == 5


def test_a_line_and_a_number_for_each_row(episode):
    (strip,) = strips(timeline.draw(episode, "title", "facts"))
    words = said(strip)
    start = words.index("row")
    assert words[start + 1 : start + 9] == ["0", "1", "2", "3", "4", "5", "6", "end"]
    rows = lines(strip, timeline.RULE)
    assert [time for time, _, _ in rows] == episode.rows() == [0, 1, 2, 4, 5, 6, 7]
    assert [places(strip, str(number))[0][0] for number in range(7)] == episode.rows()
    assert all(top < lane(strip, 0) and bottom > lane(strip, 1) for _, top, bottom in rows)


def test_rewards_and_return(episode):
    rewards = np.array([-1.0, -1.0, 99.0, 0.0, -1.0, -11.0, -1.0, -1.0])
    (strip,) = strips(timeline.draw(episode._replace(rewards=rewards), "title", "facts"))
    ((_, line),) = places(strip, "reward\nmostly -1")
    down = [(time, end - start) for time, start, end in lines(strip, ALARM) if start != end]
    up = [(time, end - start) for time, start, end in lines(strip, GREEN_DARK)]
    assert [time for time, _ in down] == [0.5, 1.5, 4.5, 5.5, 6.5, 7.5] and [time for time, _ in up] == [2.5]
    assert all(height > 0 for _, height in down) and up[0][1] == -12 and down[3][1] == max(height for _, height in down)
    assert [words for words in said(strip) if words[0] in "+-"] == ["+99", "-11"]
    assert places(strip, "+99")[0][1] < line < places(strip, "-11")[0][1]
    (total,) = [one for one in strip.lines if len(one.get_xdata()) == 9]
    heights = -total.get_ydata()
    assert total.get_xdata().tolist() == list(range(9)) and np.ptp(heights) == pytest.approx(22)
    returns = np.append(0, rewards.cumsum())
    np.testing.assert_allclose((heights - heights[0]) / 22, (returns - returns[0]) / np.ptp(returns), atol=1e-6)
    ((time, height),) = places(strip, "83")
    assert time > 8 and height == pytest.approx(total.get_ydata()[-1])


def test_the_marked_row_says_who_chooses_and_who_is_ongoing(episode):
    assert timeline.example_row(episode, 0, 8) == 1
    assert timeline.example_row(episode, 1, 8) == 2
    assert timeline.example_row(episode, 5, 8) is None  # at 6 and 7 both choose
    wide = np.zeros((20, 2), bool)
    wide[[0, 4, 5, 11, 18], 0] = wide[[0, 18], 1] = True
    assert timeline.example_row(episode._replace(chosen=wide), 0, 20) == 11, "far from other rows"
    page, strip = timeline.draw(episode, "title", "facts").axes
    words = said(page)
    start = words.index("row 1, t = 1")
    assert words[start + 1] == "● chosen now: agent 0 Stay"
    ongoing = "m⁻ running macro-actions of the ongoing agents, which have no dot: agent 1 Go-to-Small-Box(1)"
    assert words[start + 2] == ongoing
    assert places(strip, "m⁻") == [(1, lane(strip, 1))]
    assert [(time, top) for time, top, _ in lines(strip, INK)] == [(1, 0)]
    together = episode._replace(chosen=np.ones_like(episode.chosen))
    page, strip = timeline.draw(together, "title", "facts").axes
    assert "At no row between t = 0 and t = 8 an agent is ongoing." in said(page)
    assert not places(strip, "m⁻") and not lines(strip, INK)
    page, _ = timeline.draw(episode, "title", "facts", (1, 2)).axes
    assert "At no row between t = 1 and t = 2 an agent is ongoing." in said(page), "at row 1 itself one is"


def test_title_facts_and_legend(episode):
    page, _ = timeline.draw(episode, "title", "facts").axes
    assert said(page)[:3] == ["title", "facts", timeline.WORDS]
    legend = ["▬ macro-action · its steps (6, 1: twice in a row)", "● an agent chooses"]
    legend.append("│ row: a time at which at least one agent chooses")
    assert said(page)[3:6] == legend
    assert not any("utility" in words for words in said(page))


def test_an_enlarged_part_shows_the_best_utilities_and_only_that_part(episode):
    episode = episode._replace(utilities=np.tile(np.arange(8.0) / 4 - 1, (8, 2, 1)))
    page, strip = timeline.draw(episode, "title", "facts", steps=(3, 7)).axes
    assert dots(strip, lane(strip, 0)) == [6] and dots(strip, lane(strip, 1)) == [4, 5, 6]
    words = said(strip)
    start = words.index("0.75 Stay")
    assert words[start : start + 3] == ["0.75 Stay", "0.50 Turn-right", "0.25 Turn-left"]
    assert [time for time, _ in places(strip, "0.75 Stay")] == [6, 4, 5, 6]
    assert lane(strip, 0) < places(strip, "0.75 Stay")[0][1] < lane(strip, 1)
    assert "... Go-to-Small-Box(0) · 4" in words and "0.50 utility, highest first, 3 at most" in said(page)
    assert not any(number in "".join(words) for number in ("0.00", "-1.00", "end"))
    assert strip.get_xlim() == (3, 7) and [number for number in "0123456" if number in words] == ["3", "4", "5"]
    assert [tick.get_text() for tick in shown_ticks(strip)] == ["3", "4", "5", "6", "7"]


def test_what_an_agent_could_not_start_is_not_listed(episode):
    utilities = np.tile(np.arange(8.0) / 4 - 1, (8, 2, 1))
    utilities[:, :, 1:7] = -np.inf
    _, strip = timeline.draw(episode._replace(utilities=utilities), "title", "facts", steps=(3, 7)).axes
    listed = {words for words in said(strip) if re.match(r"-?\d\S* [A-Z]", words)}
    assert listed == {"0.75 Stay", "-1.00 Go-to-Small-Box(0)"}


def test_without_utilities_an_enlarged_part_has_none(episode):
    page, strip = timeline.draw(episode._replace(utilities=None), "title", "facts", steps=(3, 7)).axes
    assert not any("utility" in words for words in said(page)) and "Turn-right · 1" in said(strip)


def shown_ticks(strip):
    """The labels of the axis of time that lie in the strip."""
    left, right = strip.get_xlim()
    return [tick for tick in strip.get_xticklabels() if left <= tick.get_position()[0] <= right]


def random_episode(env_id):
    """An episode of random macro-actions, with random rewards and, for padding, utilities of -inf."""
    recorder, rng = play.Recorder(envs.make(env_id)), np.random.default_rng(1)
    recorder.reset(seed=1)
    while not recorder.over:
        utilities = torch.tensor(rng.normal(0, 60, (recorder.n_agents, 1, 1, max(recorder.n_actions))))
        for agent, count in enumerate(recorder.n_actions):
            utilities[agent, :, :, count:] = -torch.inf
        recorder.listen(None, None, (utilities, None))
        recorder.step(rng.integers(recorder.n_actions, size=(1, recorder.n_agents)))
    episode = recorder.episode()
    return episode._replace(rewards=rng.integers(-120, 120, len(episode.rewards)) / 10)


def covered(figure):
    """Pairs of words of which one covers the other, and words that are not wholly in the picture or lie under a dot."""
    canvas = FigureCanvasAgg(figure)
    renderer = canvas.get_renderer()
    texts = [text for axes in figure.axes for text in axes.texts if text.get_text()]
    texts += [tick for strip in strips(figure) for tick in shown_ticks(strip)]
    words = [text.get_text() for text in texts]
    boxes = np.array([text.get_window_extent(renderer).extents for text in texts])
    left, bottom, right, top = boxes.T
    apart = (left[:, None] >= right) | (left >= right[:, None]) | (bottom[:, None] >= top) | (bottom >= top[:, None])
    found = [(words[one], words[other]) for one, other in np.argwhere(~apart) if one < other]
    width, height = canvas.get_width_height()
    outside = (boxes[:, :2] < 0).any(1) | (boxes[:, 2:] > (width, height)).any(1)
    found += [words[one] for one in np.flatnonzero(outside)]
    for strip in strips(figure):
        for line in strip.lines:
            if line.get_marker() == "o":
                x, y = strip.transData.transform(line.get_xydata()[0])
                found += [words[one] for one in np.flatnonzero((left < x) & (x < right) & (bottom < y) & (y < top))]
    return found


@pytest.mark.slow
@pytest.mark.parametrize("env_id", ["bp-10", "wtd-s", "wtd-t1", "ct-10", "wtd-s-primitive"])
@pytest.mark.parametrize("steps", [None, (0, 40), (3, 8)])
def test_no_text_covers_another_or_leaves_the_picture(env_id, steps):
    episode = random_episode(env_id)
    if steps:
        steps = (steps[0], min(steps[1], len(episode.rewards)))
    figure = timeline.draw(episode, f"{env_id} avf_qplex", "A greedy episode", steps)
    assert not covered(figure)
    assert ("A: the arm" in said(figure.axes[0])[-1]) == env_id.startswith("wtd")
    first, last = steps or (0, len(episode.rewards))
    numbers = [number for number, time in enumerate(episode.rows()) if first <= time < last]
    at_rows = [text for strip in strips(figure) for text in strip.texts if text.get_position()[1] == timeline.ROWS]
    assert [int(text.get_text()) for text in at_rows if text.get_text().isdigit()] == numbers


@pytest.mark.slow
@pytest.mark.parametrize("steps", [None, (0, 1)])
def test_odd_episodes_can_be_read(episode, steps):
    one_step = episode._replace(chosen=episode.chosen[:1], running=episode.running[:1], rewards=episode.rewards[:1])
    assert not covered(timeline.draw(one_step, "title", "facts", steps))
    figure = timeline.draw(episode._replace(rewards=np.zeros(8)), "title", "facts", steps)
    assert not covered(figure) and {"reward", "0"} <= set(said(strips(figure)))
    figure = timeline.draw(episode._replace(rewards=episode.rewards * 1234567), "title", "facts", steps)
    assert not covered(figure)
    crowd = [f"Carry-a-very-heavy-load-to-place({number})" for number in range(8)]
    many = episode._replace(labels=list(range(12)), names=[crowd] * 12, utilities=None)
    many = many._replace(chosen=np.tile(episode.chosen, 6), running=np.tile(episode.running, 6))
    figure = timeline.draw(many, "title", "facts", steps)
    assert not covered(figure)
    if steps is None:
        everything = " ".join(said(figure.axes[0]))
        assert all(f"agent {agent} Carry-a-very-heavy-load-to-place(" in everything for agent in range(12))


def test_abbreviations_of_one_agents_macro_actions_differ():
    for env_id in envs.IDS:
        for names in envs.make(env_id).macro_action_names:
            assert len({timeline.shorten(name) for name in names}) == len(names)
    assert [timeline.shorten(name) for name in ("Pass-to-M(0)", "Go-TR", "Stay", "N")] == ["PtM(0)", "GTR", "St", "N"]
    odd = {"-1": "-1", "Wait-": "Wa", "": "", "-": "-", "A--B": "AB", "-(0)": "-(0)", "Иди-к-двери(0)": "Икд(0)"}
    assert {name: timeline.shorten(name) for name in odd} == odd


ODD = ["-1", "Wait-", "", "A--B", "$x^$ costs $5", "Иди-к-двери(0)", "去工作室", "去-工(0)"]


@pytest.mark.slow
@pytest.mark.parametrize("steps", [None, (0, 40), (3, 8)])
def test_odd_names_and_other_scripts_are_drawn_and_cover_nothing(steps, tmp_path, recwarn):
    episode = random_episode("bp-10")._replace(names=[ODD, ODD])
    with fonts.installed(tmp_path / "font.ttf"):
        figure = timeline.draw(episode, "去工作室 и $x^$", "facts", steps)
        assert not covered(figure)
        timeline.save(figure, tmp_path / "team.svg", "svg")
    assert not [str(warning.message) for warning in recwarn if "missing" in str(warning.message)]
    text = (tmp_path / "team.svg").read_text()
    assert "$x^$ costs $5" in text and "去工作室 и $x^$" in text


def test_names_without_room_are_shortened_or_written_once_and_explained(episode):
    """15 points a step: too few for a name of one step, and often for one of three."""
    chosen, running = np.ones((90, 2), bool), np.full((90, 2), 4)
    chosen[[10, 11, 13, 14], 1], running[9:12, 1], running[12:15, 1] = False, 0, 6
    running[20, 1] = 0
    chosen[[31, 32], 1], running[30:33, 1] = False, 7
    chosen[44:47, 0] = False
    episode = episode._replace(chosen=chosen, running=running, rewards=np.zeros(90))
    figure = timeline.draw(episode, "title", "facts")
    first, second = strips(figure)
    assert len(bars(first, lane(first, 0))) == 44 and bars(first, lane(first, 0))[-1][:2] == (43, 47)
    assert bars(second, lane(second, 0))[0][:2] == (43, 47) and len(dots(second, lane(second, 0))) == 43
    each = ", ".join(["1"] * 43)
    words = [text for text in said(first) if text.startswith("Push")]
    assert words == [f"Push · {each}, 4", "Push x9", "Push x5", "Push x9", "Push x12"]
    assert f"... Push · 4, {each}" in said(second)
    assert places(first, "GtSB(0)") == [(9, lane(first, 1) + 12)] and places(first, "Tr") == [(12, lane(first, 1) + 12)]
    assert len(places(first, "Stay · 3")) == 1
    assert not any(text.startswith(("Go-to", "Turn")) for text in said(first)), "no room, and none at all at time 20"
    assert said(figure.axes[0])[-1] == "GtSB: Go-to-Small-Box · Tr: Turn-right"


@pytest.mark.slow
def test_files_are_vectors_with_text_and_the_same_each_time(episode, tmp_path):
    def written(name):
        path = tmp_path / name
        timeline.save(timeline.draw(episode, "title", "facts"), path, path.suffix[1:])
        return path.read_bytes()

    for kind in ("png", "svg", "pdf"):
        assert written(f"one.{kind}") == written(f"two.{kind}")
    svg, pdf = written("team.svg").decode(), written("team.pdf")
    assert svg.count("<text") > 30 and "Go-to-Small-Box(1) · 4</text>" in svg and "<image" not in svg
    assert pdf.startswith(b"%PDF") and b"/FontFile2" in pdf and b"/Subtype /Image" not in pdf and b"/Type3" not in pdf
    assert not any(word in svg + str(pdf) for word in ("CreationDate", "<dc:date>"))
    assert written("team.png").startswith(b"\x89PNG")
