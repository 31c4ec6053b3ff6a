"""Pictures: size and type for every id, and that each piece of the simulator's state can be seen in them."""

import subprocess
import sys
import warnings

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from PIL import ImageColor

import envs
from envs import overcooked, rendering
from envs.warehouse import LAYOUTS
from tests import fonts
from tests.sync import ROOT

DOMAINS = {"bp-10", "wtd-s", "ct-10", "overcooked-c"}
CUSTOM = [
    ("bp-10", {"grid": 6}),
    ("bp-10", {"grid": 8, "small_boxes": [(0.5, 2.5), (6.5, 5.5)], "big_box": (4, 3.5)}),
    ("wtd-s", {"starts": [(4, 1)] * 2, "staging_capacity": 6, "room_size": (12.0, 8.0), "search_steps": 9}),
    ("wtd-s", {"tables": [(1, 4)], "starts": [(5, 5)], "room_size": (3.0, 9.0)}),
    ("wtd-t1", {"workshops": [(6, 3), (8, 3), (8, 2), (6, 2)], "phase_lengths": [(9, 9, 9, 9)] * 4}),
    ("wtd-d", {"tables": [(0.5 * robot, 3) for robot in range(12)], "starts": [(3, 3)] * 12}),
    ("ct-10", {"grid": 2, "n_agents": 1}),
    ("ct-10", {"grid": 3, "n_agents": 40}),
    ("ct-10", {"grid": 60, "n_agents": 12}),
]


def started(env_id, num_envs=1, **kwargs):
    env = envs.make(env_id, num_envs=num_envs, render_mode="rgb_array", **kwargs)
    env.reset(seed=0)
    return env


def picture(env):
    frame = env.render()[0].astype(int)
    assert not (frame == frame[0, 0]).all()
    return frame


def episode(env, rng):
    """Pictures of an episode of random macro-actions: after the reset and each 20th step, and at the end."""
    yield picture(env)
    while not env.over[0]:
        env.step(rng.integers(env.n_actions, size=(env.num_envs, env.n_agents)))
        if env.elapsed[0] % 20 == 0 or env.over[0]:
            yield picture(env)


def pixels_of(frame, colour):
    return np.count_nonzero((frame == ImageColor.getrgb(colour)).all(2))


@pytest.mark.slow
@pytest.mark.parametrize("env_id", envs.IDS)
def test_the_frames_of_an_episode_have_one_size_and_show_something_new(env_id):
    env = started(env_id)
    (first,) = env.render()
    height, width, _ = first.shape
    assert first.dtype == np.uint8 and first.shape == (height, width, 3)
    assert 640 <= width <= 900 and 400 <= height <= 900 and width % 2 == 0 and height % 2 == 0
    before = None
    for frame in episode(env, np.random.default_rng(0)):
        assert frame.shape == first.shape
        assert before is None or (frame != before).any()
        before = frame
    assert env.elapsed[0] > 1


@pytest.mark.slow
@pytest.mark.parametrize(("env_id", "changes"), CUSTOM)
def test_custom_layouts_are_drawn_from_reset_to_end_at_one_size(env_id, changes):
    sizes = {frame.shape for frame in episode(started(env_id, **changes), np.random.default_rng(1))}
    assert len(sizes) == 1
    height, width, _ = sizes.pop()
    assert width % 2 == 0 and height % 2 == 0


@pytest.mark.parametrize("env_id", envs.IDS)
def test_the_single_environment_renders_one_frame(env_id):
    env = gym.make(f"{env_id}-v0", render_mode="rgb_array")
    env.reset(seed=0)
    frame = env.render()
    assert frame.ndim == 3 and frame.dtype == np.uint8
    np.testing.assert_array_equal(frame, env.unwrapped.vector_env.render()[0])


@pytest.mark.parametrize("env_id", envs.IDS)
def test_gymnasiums_checker_has_nothing_to_say_about_rendering(env_id):
    env = gym.make(f"{env_id}-v0", render_mode="rgb_array")
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        check_env(env.unwrapped)
    assert not [str(warning.message) for warning in caught if "render" in str(warning.message).lower()]


@pytest.mark.parametrize("env_id", sorted(DOMAINS))
def test_render_gives_a_frame_for_each_environment_and_none_without_a_render_mode(env_id):
    env = started(env_id, num_envs=3)
    before = env.render()
    assert isinstance(before, tuple) and len(before) == 3
    env.episode_return[1] += 7.0
    same = [(old == new).all() for old, new in zip(before, env.render(), strict=True)]
    assert same == [True, False, True]
    blind = envs.make(env_id)
    blind.reset(seed=0)
    assert blind.render() is None


@pytest.mark.slow
@pytest.mark.parametrize("env_id", sorted(DOMAINS))
def test_drawing_changes_neither_the_environment_nor_its_random_numbers(env_id):
    drawn, plain = started(env_id), started(env_id)
    for _ in episode(drawn, np.random.default_rng(2)):
        pass
    rng = np.random.default_rng(2)
    while not plain.over[0]:
        plain.step(rng.integers(plain.n_actions, size=(1, plain.n_agents)))
    saved = drawn.save_state()
    expected = plain.save_state()
    assert [name for name in expected if saved[name] != expected[name]] == []


PANEL = [("elapsed", 0, 40), ("episode_return", 0, 12.3), ("success", 0, True), ("over", 0, True)]
PANEL += [("macro_done", (0, 1), True), ("macro_action", (0, 1), 1)]
SEEN = {
    "bp-10": [
        *PANEL,
        *[("position", (0, 1, 0), 3.5), ("position", (0, 0, 1), 2.5), ("orientation", (0, 1), 2)],
        *[("box_y", (0, 0), 8.5), ("box_y", (0, 1), 8.5), ("box_y", (0, 2), 8.5)],
        *[("last_waypoint", (0, 1), 3), ("pushing_big", 0, True)],
    ],
    "wtd-t1": [
        *PANEL,
        *[("position", (0, 0, 0), 5.0), ("position", (0, 2, 1), 4.5), ("location", (0, 0), 5)],
        *[("carried", (0, 1, 2), 1), ("carried", (0, 1, 0), 2), ("waited", (0, 0), 5), ("under_way", (0, 0), True)],
        *[("staged", (0, 0), 2), ("staged", (0, 1), 0), ("found", (0, 1), 2), ("found", (0, 2), 3)],
        *[("macro_action", (0, -1), 1), ("arm_left", 0, 2), ("pass_ready", 0, True)],
        *[("phase", (0, 1), 2), ("clock", (0, 2), 5), ("clock", (0, 0), 0), ("has_next_tool", (0, 1), True)],
    ],
    "ct-10": [
        *PANEL,
        *[("position", (0, 9, 0), 1), ("target", (0, 1), 8), ("visible", (0, 4), False), ("goal", (0, 3, 1), 2)],
    ],
    "overcooked-c": [
        *PANEL,
        *[("cell", (0, overcooked.COOK), 22), ("cell", (0, overcooked.TOMATO), 20)],
        *[("cell", (0, overcooked.ONION), 9), ("cell", (0, overcooked.LETTUCE), 41)],  # in a hand, on a plate
        *[("cell", (0, overcooked.PLATE), 7), ("memory", (0, 0, overcooked.TOMATO), 24)],
        *[("strikes", (0, 1), 1), ("strikes", (0, 2), 3), ("chop_moves", (0, 1), 2)],
    ],
}


def busy(env_id):
    """An environment in the middle of things: everybody runs macro-action 0, the arm passes to an absent robot 2."""
    env = started(env_id)
    env.step(np.array([[0] * env.n_agents]))
    env.macro_action[:], env.macro_done[:] = 0, False
    if env_id == "wtd-t1":
        env.macro_action[0, 0], env.macro_action[0, -1] = env.n_humans + 1, 3
        env.position[0, 0], env.location[0, 0], env.waited[0, 0] = env.tables[0], env.n_humans + 1, 2
        env.under_way[0, 0] = False
        env.macro_done[0, 1] = True
        env.arm_left[:], env.staged[:] = 3, 1
    if env_id == "ct-10":
        env.position[:], env.target[:], env.goal[:], env.visible[:] = 4, 6, 6, True
    if env_id == "overcooked-c":
        env.macro_action[0, 0] = overcooked.GET_FOOD
    return env


@pytest.mark.slow
@pytest.mark.parametrize(
    ("env_id", "name", "where", "value"),
    [(env_id, *change) for env_id, changes in SEEN.items() for change in changes],
)
def test_each_piece_of_the_state_is_seen(env_id, name, where, value):
    env = busy(env_id)
    if (env_id, name) == ("wtd-t1", "macro_done"):
        where, value = (0, 1), False
    before = picture(env)
    assert getattr(env, name)[where] != value
    getattr(env, name)[where] = value
    assert (picture(env) != before).any()


def test_every_array_of_the_simulator_is_among_those_tested():
    for env_id, changes in SEEN.items():
        assert set(envs.make(env_id).sim_arrays) <= {name for name, *_ in changes}


@pytest.mark.slow
@pytest.mark.parametrize("env_id", [env_id for env_id in envs.IDS if not env_id.startswith("overcooked")])
def test_agents_on_one_spot_are_all_visible(env_id):
    env = started(env_id)
    env.position[:] = env.position[:, :1]
    apart = {
        agent: pixels_of(picture(env), rendering.agent_colours(agent)[0]) for agent in range(env.position.shape[1])
    }
    env.position[:] += 1000  # far outside: what is left of each colour is that of the panel and the scenery
    for agent, count in apart.items():
        assert count > pixels_of(picture(env), rendering.agent_colours(agent)[0]) + 20


def test_points_are_pushed_apart_and_left_alone_where_there_is_room():
    spread = np.array(rendering._spread([(5.0, 5.0)] * 3, 10))
    gaps = np.linalg.norm(spread[:, None] - spread, axis=2)[np.triu_indices(3, 1)]
    assert gaps.min() > 9.5 and gaps.max() < 25
    assert rendering._spread([(0.0, 0.0), (30.0, 40.0)], 49) == [[0, 0], [30, 40]]


def test_a_late_human_is_red_until_it_gets_its_tool():
    env = started("wtd-t1")
    assert pixels_of(picture(env), rendering.ALARM) == 0
    env.clock[0, 1] = -3
    assert pixels_of(picture(env), rendering.ALARM) > 500
    env.has_next_tool[0, 1] = True
    assert pixels_of(picture(env), rendering.ALARM) == 0
    env.has_next_tool[0, 1], env.phase[0, 1] = True, 3  # finished, so not late
    assert pixels_of(picture(env), rendering.ALARM) == 0


@pytest.mark.slow
def test_the_big_box_lights_up_while_both_push_it():
    env = started("bp-30")
    while not (env.last_waypoint[0] >= 2).all():
        assert pixels_of(picture(env), rendering.YELLOW) == 0
        env.step(np.array([[2, 3]]))
    env.step(np.array([[4, 4]]))
    assert pixels_of(picture(env), rendering.YELLOW) > 300


def test_the_red_cross_is_seen_under_all_agents():
    env = started("ct-10")
    env.position[:], env.target[:] = 3, 8
    free = pixels_of(picture(env)[:, :600], rendering.ALARM)
    env.target[:] = 3
    assert 0.25 * free < pixels_of(picture(env)[:, :600], rendering.ALARM)


def test_a_tool_being_passed_is_in_the_hand_and_no_longer_on_the_table():
    env = started("wtd-s")
    nowhere = pixels_of(picture(env), rendering.SKY)
    env.staged[0, 0], env.macro_action[:, -1], env.arm_left[:] = 2, 1, 3
    on_table = pixels_of(picture(env), rendering.SKY)
    env.pass_ready[:] = True
    assert nowhere < pixels_of(picture(env), rendering.SKY) < on_table


def test_where_a_robot_is_said_to_be():
    env = started("wtd-s-primitive")
    note, said = rendering._robot_note, []
    for action in (2,) * 6 + (0,):  # 2.66 m to the table, a step of waiting, away again
        env.step(np.array([[action, 1, 0]]))
        said.append(note(env, 0, 0)[1])
    assert said[0] == said[-1] == "at no waypoint" and said[4:6] == ["at the table", "waits for a tool, 1 of 10"]
    env = started("wtd-s")
    env.step(np.array([[1, 2, 0]]))
    direction, words = note(env, 0, 0)
    assert np.allclose(direction, np.array([-0.5, -2.0]) / np.hypot(0.5, 2.0)) and words == "1.5 m to go"


def test_the_number_of_carried_tools_is_seen():
    env = started("wtd-t1")
    env.carried[0, 0] = [0, 2, 0]
    two = picture(env)
    env.carried[0, 0] = [0, 3, 0]
    assert (picture(env) != two).any()


@pytest.mark.slow
@pytest.mark.parametrize("layout", LAYOUTS)
def test_staged_and_carried_tools_are_drawn_in_their_colours(layout):
    env = started(f"wtd-{layout}")
    empty = [pixels_of(picture(env), colour) for _, _, colour in rendering.TOOLS]
    env.staged[0], env.carried[0, 0] = [0, 2], [0, 1, 0]
    for (_, _, colour), before in zip(rendering.TOOLS, empty, strict=True):
        assert pixels_of(picture(env), colour) > before + 20


# ---- names in all scripts -------------------------------------------------------------------------------------------
def written(words):
    """The pixels of words."""
    canvas = rendering.Canvas.blank(200, 40)
    canvas.text(10, 20, words, 20)
    return canvas.pixels().astype(int)


@pytest.mark.parametrize("pair", [("иди", "дом"), ("Πας", "Ένα"), ("Üß", "éø"), ("لكم", "نبق"), ("→", "∅")])
def test_words_that_are_not_ascii_are_no_boxes(pair):
    one, other = map(written, pair)
    assert (one != other).any()


def test_letters_that_dejavu_sans_lacks_are_of_another_font(tmp_path):
    with fonts.installed(tmp_path / "font.ttf"):
        assert rendering.find_font("·Wait").name == "DejaVu Sans"
        assert rendering.find_font("去·工").name == "Rectangles"
        assert rendering.find_font("문으로").name == "DejaVu Sans", "nothing has them"
        heights = [np.ptp(np.nonzero((written(letter) < 100).any((1, 2)))) for letter in fonts.LETTERS]
        assert heights == sorted(set(heights))


def test_ascii_is_drawn_without_matplotlib():
    """It takes a while to import."""
    code = "import sys, envs; envs.make('ct-10')._draw(0); print('matplotlib' in sys.modules)"
    program = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=ROOT)
    assert program.stdout == "False\n", program.stderr


def test_what_is_held_is_at_its_cook_and_what_is_on_a_plate_on_it():
    env = started("overcooked-a")
    kitchen = picture(env)[:, :580]
    side, margin = 80, rendering.MARGIN

    def of_cell(frame, cell):
        top, left = margin + side * overcooked.ROW[cell], margin + side * overcooked.COLUMN[cell]
        return frame[top : top + side, left : left + side]

    plate, tomato = env.starts[overcooked.PLATE], env.starts[overcooked.TOMATO]
    red, _, _ = rendering.FOODS[overcooked.TOMATO]
    for cell in (plate, env.starts[overcooked.COOK]):
        assert pixels_of(of_cell(kitchen, cell), red) == 0
        env.cell[0, overcooked.TOMATO] = cell
        moved = picture(env)[:, :580]
        assert pixels_of(of_cell(moved, cell), red) > 50 and pixels_of(of_cell(moved, tomato), red) == 0
