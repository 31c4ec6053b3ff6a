"""timeline.py: what it draws is what was recorded, and it can be read."""

import numpy as np
import pytest
import torch

import envs
import play
import timeline
from envs.rendering import AGENTS, Canvas
from tests.recording import scripted


@pytest.fixture
def episode():
    return scripted().episode()


@pytest.fixture
def spy(monkeypatch):
    """What is drawn, in pixels of the whole picture: texts as (words, left, top, right, bottom), dots as (x, y)."""
    texts, dots = [], []
    text, dot = Canvas.text, timeline._draw_dot

    def spy_text(self, x, y, words, size=14.0, fill=None, anchor="l", **options):
        width, high = self.width(words, size) * self.unit, 0.72 * size * self.unit  # as high as capital letters
        left = self.x + x * self.unit - {"l": 0, "m": width / 2, "r": width}[anchor]
        middle = self.y + y * self.unit
        if words != "":
            texts.append((str(words), left, middle - high / 2, left + width, middle + high / 2))
        text(self, x, y, words, size, *([fill] if fill else []), anchor=anchor, **options)

    def spy_dot(canvas, x, y):
        dots.append((canvas.x + x * canvas.unit, canvas.y + y * canvas.unit))
        dot(canvas, x, y)

    monkeypatch.setattr(Canvas, "text", spy_text)
    monkeypatch.setattr(timeline, "_draw_dot", spy_dot)
    return texts, dots


def said(texts):
    return [words for words, *_ in texts]


def test_a_dot_and_a_name_for_each_macro_action_and_a_number_for_each_row(episode, spy):
    texts, dots = spy
    timeline.draw(episode, "title", "facts")
    words, pitch = said(texts), (timeline.WIDTH - timeline.LEFT - timeline.RIGHT) / 8
    lanes = sorted({y for _, y in dots})[-2:]  # the others are in the legend and in the example
    for agent, lane in enumerate(lanes):
        times = [(x / 4 - timeline.LEFT) / pitch for x, y in dots if y == lane]
        np.testing.assert_allclose(times, [start for start, _, _ in episode.bars(agent)], atol=1e-6)
    assert words.count("Stay · 1") == 1 + 5, "one in the legend"
    for name in ("Go-to-Small-Box(0) · 4", "Go-to-Small-Box(1) · 4", "Turn-left · 1", "Turn-right · 1"):
        assert name in words
    start = words.index("row")
    assert words[start + 1 : start + 9] == ["0", "1", "2", "3", "4", "5", "6", "end"]
    assert "mostly -0.1" in words and words[words.index("return so far") + 1] == "-0.8"


def test_the_marked_row_says_who_chooses_and_who_is_ongoing(episode, spy):
    texts, _ = spy
    assert timeline.example_row(episode, 0, 8) == 1
    assert timeline.example_row(episode, 1, 8) == 2
    assert timeline.example_row(episode, 5, 8) is None  # at 6 and 7 both choose
    wide = np.zeros((20, 2), bool)
    wide[[0, 4, 5, 11, 18], 0] = wide[[0, 18], 1] = True
    assert timeline.example_row(episode._replace(chosen=wide), 0, 20) == 11, "far from other rows"
    timeline.draw(episode, "title", "facts")
    words = said(texts)
    start = words.index("row 1, t = 1")
    assert words[words.index("chosen now:", start) + 2] == "Stay"
    assert words[words.index("running macro-actions of the ongoing agents, which have no dot:") + 2] == (
        "Go-to-Small-Box(1)"
    )
    assert words.count("m") == 2  # in the explanation and on the one ongoing agent's bar
    together = episode._replace(chosen=np.ones_like(episode.chosen))
    timeline.draw(together, "title", "facts")
    assert "Up to t = 8 all agents choose at every row: nobody is ongoing." in said(texts)


def test_an_enlarged_part_shows_the_best_utilities_and_only_that_part(episode, spy):
    texts, dots = spy
    episode = episode._replace(utilities=np.tile(np.arange(8.0) / 4 - 1, (8, 2, 1)))
    timeline.draw(episode, "title", "facts", steps=(3, 7))
    words = said(texts)
    lanes = sorted({y for _, y in dots})[-2:]
    assert [sum(y == lane for _, y in dots) for lane in lanes] == [1, 3]
    start = words.index("0.75") - 1
    assert words[start : start + 6] == ["Stay", "0.75", "Turn-right", "0.50", "Turn-left", "0.25"]
    assert "... Go-to-Small-Box(0) · 4" in words and "the 3 of highest utility" in words
    assert not {"0.00", "-1.00", "end"} & set(words)
    times = [float(word) for word in words[words.index("time t") + 1 :]]
    assert times == [3, 4, 5, 6, 7]


@pytest.mark.parametrize("env_id", ["bp-10", "wtd-s", "wtd-t1", "ct-10", "wtd-s-primitive"])
@pytest.mark.parametrize("steps", [None, (0, 40), (3, 8)])
def test_no_text_covers_another_or_leaves_the_picture(env_id, steps, spy):
    recorder, rng, (texts, _) = play.Recorder(envs.make(env_id)), np.random.default_rng(1), spy
    recorder.reset(seed=1)
    while not recorder.over:
        utilities = torch.tensor(rng.normal(0, 60, (recorder.n_agents, 1, max(recorder.n_actions))))
        for agent, count in enumerate(recorder.n_actions):
            utilities[agent, :, count:] = -torch.inf
        recorder.listen(None, None, (utilities, None))
        recorder.step(rng.integers(recorder.n_actions, size=(1, recorder.n_agents)))
    episode = recorder.episode()
    episode = episode._replace(rewards=rng.integers(-120, 120, len(episode.rewards)) / 10)
    if steps:
        steps = (steps[0], min(steps[1], len(episode.rewards)))
    picture = timeline.draw(episode, f"{env_id} avf_qplex", "A greedy episode", steps)
    height, width, _ = picture.shape
    boxes = np.array([box for _, *box in texts])
    assert (boxes[:, :2] >= 0).all() and (boxes[:, 2:] <= (2 * width, 2 * height)).all()
    left, top, right, bottom = boxes.T
    apart = (left[:, None] >= right) | (left >= right[:, None]) | (top[:, None] >= bottom) | (top >= bottom[:, None])
    covered = [(texts[one][0], texts[other][0]) for one, other in np.argwhere(~apart) if one < other]
    assert not covered
    assert ("A: the arm" in texts[-1][0]) == env_id.startswith("wtd")


def test_the_colours_are_those_of_the_rendering(episode):
    picture = timeline.draw(episode, "title", "facts")
    middle = picture.shape[0] - 2 * (timeline.FOOT + 14)
    lanes = [
        picture[middle - 2 * timeline.LANE * (2 - agent) + 12] for agent in range(2)
    ]  # in the upper part of the bars
    for lane, (colour, _) in zip(lanes, AGENTS[:2], strict=True):
        rgb = tuple(bytes.fromhex(colour[1:]))
        assert (lane == rgb).all(1).mean() > 0.7


def test_abbreviations_of_one_agents_macro_actions_differ():
    for env_id in envs.IDS:
        for names in envs.make(env_id).macro_action_names:
            assert len({timeline.shorten(name) for name in names}) == len(names)
    assert [timeline.shorten(name) for name in ("Pass-to-M(0)", "Go-TR", "Stay", "N")] == ["PtM(0)", "GTR", "St", "N"]


def test_names_without_room_are_shortened_or_put_below_and_explained(episode, spy):
    """17 pixels a step: too few for a name of one step (those of one kind share a bracket) and, often, of three."""
    texts, _ = spy
    chosen, running = np.ones((50, 2), bool), np.full((50, 2), 4)
    chosen[[10, 11, 13, 14], 1], running[9:12, 1], running[12:15, 1] = False, 0, 6
    episode = episode._replace(chosen=chosen, running=running, rewards=np.zeros(50))
    timeline.draw(episode, "title", "facts")
    words = said(texts)
    assert "Push x50" in words and "Push x9" in words and "Push x35" in words
    assert words.count("Push · 1") == 1, "in the legend"
    assert not {"Go-to-Small-Box(0) · 3", "Turn-right · 3"} & set(words)
    assert "GtSB(0)" in words and "Tr" in words and words[-1] == "GtSB: Go-to-Small-Box · Tr: Turn-right"
