"""Pictures of the domains, drawn with Pillow: a scene, and beside or below it a panel about every agent.

Lengths and positions are in pixels of the finished picture, and y grows downwards. A `Canvas` draws everything larger
and reduces it at the end, which smooths the edges.
"""

from dataclasses import dataclass, replace
from functools import cache
from itertools import combinations
from math import ceil, cos, dist, hypot, pi, sin, sqrt

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from envs.overcooked import (
    BOARD,
    COLUMN,
    COOK,
    COOKS,
    DELIVERY,
    LETTUCE,
    NOTHING,
    ONION,
    PLATE,
    ROW,
    SIDE,
    STRIKES,
    THING_NAMES,
    TOMATO,
)
from envs.warehouse import LAST_PHASE, NO_TOOL, PHASES

ENLARGED = 2  # how many times larger everything is drawn
MARGIN = 20  # around the scene and the panel
GRID_SIDE = 560  # of the largest grid
ROOM_WIDTH = 860  # of the largest warehouse
ROOM_HEIGHT = 640
METRE = 95  # in a warehouse, before the warehouse is scaled to fit
PANEL = 260  # width of a panel, or of one of its columns
HEADER = 150  # height of a panel's head
ENTRY = 36  # height of an agent's entry in a panel
SMALL = 12  # size of small text

# Okabe and Ito's colours, which can be told apart with any kind of colour vision.
GREEN = "#009e73"
PURPLE = "#cc79a7"
SKY = "#56b4e9"
YELLOW = "#f0e442"
# Neutral colours, from dark to light.
INK = "#22303c"
SLATE = "#46525e"
MUTED = "#6e7b87"
LINE = "#dbe2e8"
PAPER = "#f4f6f8"
WHITE = "#ffffff"
# Other colours.
ALARM = "#c8102e"
ALARM_PALE = "#fbe1e1"
GREEN_DARK = "#00604a"
GREEN_PALE = "#d9f0e6"
WOOD = "#e5c79c"
WOOD_DARK = "#8a6534"

ARM = "A"  # the label of the warehouse's arm; the label of any other agent is its number
AGENTS = [  # colours of an agent's disc and of the label on it
    ("#0072b2", WHITE),
    ("#e69f00", INK),
    (GREEN, WHITE),
    ("#d55e00", WHITE),
    (PURPLE, INK),
    (SKY, INK),
    (YELLOW, INK),
    (SLATE, WHITE),
    ("#004a75", WHITE),
    ("#8f6300", WHITE),
]
STATUS = {  # colours of the field that says how an agent's macro-action stands, and of the word in it
    "free": (LINE, MUTED),
    "running": (SLATE, WHITE),
    "ended": (GREEN_PALE, GREEN_DARK),
}
TOOLS = [  # corners, relative size and colour of each kind of tool
    (3, 1.25, PURPLE),
    (4, 1.15, YELLOW),
    (6, 1.05, SKY),
]
FOODS = {  # colour of a vegetable and of the letter on it, and this letter
    TOMATO: ("#d1383d", WHITE, "T"),
    LETTUCE: ("#7cb342", INK, "L"),
    ONION: ("#f3e3ec", INK, "O"),
}
HEADINGS = [  # (dx, dy) in a picture of the orientations of Box Pushing
    (0, -1),  # north
    (1, 0),  # east
    (0, 1),  # south
    (-1, 0),  # west
]


@cache
def find_font(words):
    """A font for words that are not only ASCII, a FontEntry of Matplotlib with a `name` and a file `fname`.

    DejaVu Sans, which comes with Matplotlib, has most alphabets. For letters that it lacks, the font is another one of
    this machine that has all of these. If there is none, they are drawn as boxes.
    """
    from matplotlib import font_manager  # here, since the names of most tasks are ASCII

    def rank(font):
        is_regular = font.style == "normal" and font.stretch == "normal" and font.weight == 400
        return font.name != "DejaVu Sans", not is_regular

    fonts = [font for font in font_manager.fontManager.ttflist if not font.name.startswith("Last Resort")]  # only boxes
    fonts.sort(key=rank)
    missing = set(map(ord, words)) - _letters(fonts[0].fname)
    return next((font for font in fonts if missing <= _letters(font.fname)), fonts[0])


@cache
def _letters(file):
    """The code points of the letters that a font has."""
    from matplotlib import ft2font

    return ft2font.FT2Font(file).get_charmap().keys()


@cache
def _font(size, file=None):
    """A font in a size. By default it is the one that comes with Pillow, which has no letters beyond ASCII."""
    return ImageFont.truetype(file, size) if file else ImageFont.load_default(size)


@dataclass
class Canvas:
    """A picture, or a part of one that has an origin and a unit of length of its own.

    The methods that draw take positions and lengths in this unit. `edge` and `thickness` say how thick a line is.
    """

    image: Image.Image  # the whole picture, enlarged
    draw: ImageDraw.ImageDraw
    origin_x: float = 0.0  # in pixels of the enlarged picture
    origin_y: float = 0.0
    unit: float = ENLARGED  # in pixels of the enlarged picture

    @classmethod
    def blank(cls, width, height):
        """An empty picture. Width and height are rounded up to even numbers, which videos need."""
        even_width = 2 * ceil(width / 2)
        even_height = 2 * ceil(height / 2)
        size = (ENLARGED * even_width, ENLARGED * even_height)
        image = Image.new("RGB", size, PAPER)
        return cls(image, ImageDraw.Draw(image))

    def part(self, x, y, unit=1.0):
        """The part of the picture whose origin is at (x, y) and whose unit of length is `unit`."""
        left, top = self._enlarge(x, y)
        return replace(self, origin_x=left, origin_y=top, unit=self.unit * unit)

    def box(self, x, y, width, height, fill, outline=None, edge=1.0, radius=0.0):
        """Draws a rectangle with its upper left corner at (x, y). `radius` rounds its corners."""
        left, top = self._enlarge(x, y)
        right, bottom = self._enlarge(x + width, y + height)
        left = round(left)
        top = round(top)
        right = max(round(right), left + 1)
        bottom = max(round(bottom), top + 1)
        corners = (left, top, right - 1, bottom - 1)  # Pillow draws the right column and the bottom row, too
        self.draw.rounded_rectangle(corners, radius * self.unit, fill, outline, self._line_width(edge))

    def disc(self, x, y, radius, fill, outline, edge=1.5):
        """Draws a disc around (x, y). If `fill` is None, it is only a circle."""
        upper_left = self._enlarge(x - radius, y - radius)
        lower_right = self._enlarge(x + radius, y + radius)
        self.draw.ellipse([upper_left, lower_right], fill, outline, self._line_width(edge))

    def polygon(self, points, fill, outline=None, edge=1.0):
        """Draws a polygon whose corners are points (x, y)."""
        corners = [self._enlarge(x, y) for x, y in points]
        self.draw.polygon(corners, fill, outline, self._line_width(edge))

    def line(self, start, end, colour, thickness):
        """Draws a straight line between two points (x, y)."""
        ends = [self._enlarge(*start), self._enlarge(*end)]
        self.draw.line(ends, colour, self._line_width(thickness))

    def dashes(self, start, end, colour):
        """Draws a dashed line between two points (x, y)."""
        count = int(dist(start, end) / 12) + 1
        points = np.linspace(start, end, 2 * count)
        for dash_start, dash_end in points.reshape(count, 2, 2):
            self.line(dash_start, dash_end, colour, thickness=2)

    def text(self, x, y, words, size=14.0, colour=INK, anchor="l", bold=False):
        """Writes words. y is the middle of their height, and `anchor` says what x is.

        With "l" x is the left end of the words, with "m" their middle and with "r" their right end.
        """
        font_size = max(size * self.unit, 10)
        words = str(words)
        font = _font(font_size) if words.isascii() else _font(font_size, find_font(words).fname)
        stroke = round(font_size / 44) if bold else 0
        place = self._enlarge(x, y)
        self.draw.text(place, words, colour, font, anchor + "m", stroke_width=stroke)

    def pixels(self):
        """The finished picture, uint8 [height, width, 3]."""
        reduced = self.image.reduce(ENLARGED)  # LANCZOS looks the same and takes several times as long
        return np.array(reduced)

    def _enlarge(self, x, y):
        """Where the point (x, y) is in the enlarged picture."""
        return self.origin_x + x * self.unit, self.origin_y + y * self.unit

    def _line_width(self, thickness):
        """How many pixels of the enlarged picture a line is wide."""
        return max(1, round(thickness * self.unit))


# ---- what several pictures are made of ------------------------------------------------------------------------------
def agent_colours(label):
    """The colours of an agent's disc and of the label on it. `label` is a number or ARM."""
    if label == ARM:
        return SLATE, WHITE
    return AGENTS[label % len(AGENTS)]


def _agent(canvas, x, y, radius, label, heading=None):
    """Draws an agent as a disc with its label. A heading, which is a direction (dx, dy) of length 1, adds a nose."""
    if heading is not None:
        centre = np.array([x, y])
        forward = radius * np.array(heading)
        dx, dy = forward
        sideways = np.array([-dy, dx])
        base = centre + 0.3 * forward
        tip = centre + 1.6 * forward
        canvas.polygon([base + sideways, tip, base - sideways], INK)
    disc_colour, label_colour = agent_colours(label)
    is_large = radius > 12
    canvas.disc(x, y, radius, disc_colour, INK, edge=radius / 12)
    canvas.text(x, y, label, radius * 1.2, label_colour, anchor="m", bold=is_large)


def _bar(canvas, x, y, width, height, share, colour):
    """Draws a bar of which a share is filled: nothing from 0 down, all of it from 1 up."""
    radius = height / 2
    canvas.box(x, y, width, height, LINE, radius=radius)
    if share > 0:
        filled = max(width * min(share, 1), height)
        canvas.box(x, y, filled, height, colour, radius=radius)


def _spread(points, gap):
    """Moves points (x, y) apart until no two are closer than the gap, as far as twenty rounds can do it."""
    points = np.array(points, float)
    for _ in range(20):
        for first, second in combinations(range(len(points)), 2):
            way = points[second] - points[first]
            way += (1e-6, 0)  # points on the same spot move apart sideways
            lacking = max(gap / hypot(*way) - 1, 0)  # as a share of the way
            push = way * lacking / 2
            points[first] -= push
            points[second] += push
    return points.tolist()


def _header(panel, env, index, title, subtitle):
    """Writes the title, the step, the return and how the episode stands."""
    if env.primitive:
        subtitle += ", primitive actions"
    panel.text(0, 11, title, size=21, bold=True)
    panel.text(0, 37, subtitle, colour=MUTED)

    elapsed = env.elapsed[index]
    _fact(panel, 68, "step", f"{elapsed} / {env.horizon}")
    _bar(panel, 0, 79, PANEL, 6, elapsed / env.horizon, MUTED)
    _fact(panel, 104, "return", f"{env.episode_return[index]:.1f}")
    status = _episode_status(env, index)
    status_colour = GREEN_DARK if status == "success" else INK
    _fact(panel, 128, "episode", status, status_colour)


def _fact(panel, y, name, value, colour=INK):
    """Writes a name at the left end of a panel and a value at its right end."""
    panel.text(0, y, name, colour=MUTED)
    panel.text(PANEL, y, value, colour=colour, anchor="r")


def _episode_status(env, index):
    """How the episode stands, in words."""
    if env.success[index]:
        return "success"
    if not env.over[index]:
        return "running"
    if env.elapsed[index] == 0:
        return "not started"
    return "ended"


def _agent_list(panel, env, index, labels, notes):
    """Draws an entry for each agent: its label, its macro-action and how that stands, and a note."""
    for agent, label in enumerate(labels):
        entry = panel.part(0, ENTRY * agent)
        action = env.macro_action[index, agent]
        if action < 0:
            name = "none yet"
            status = "free"
        else:
            name = env.macro_action_names[agent][action]
            status = "ended" if env.macro_done[index, agent] else "running"
        _agent(entry, 12, 18, 11, label)
        entry.text(32, 10, name)
        entry.text(32, 26, notes[agent], SMALL, MUTED)
        field_colour, word_colour = STATUS[status]
        field = entry.part(PANEL - 54, 2)
        field.box(0, 0, 54, 18, field_colour, radius=9)
        field.text(27, 9, status, SMALL, word_colour, anchor="m")


class Board:
    """A picture with an empty grid of cells and with room for a panel on its right.

    Attributes:
        canvas: the whole picture.
        panel: the part of it on the right.
        cell_side: the side of a cell.
        side: the side of the grid.
    """

    def __init__(self, cells, panel_height):
        """`cells` is how many there are along each axis."""
        self.cell_side = max(2, GRID_SIDE // cells)  # whole pixels keep the lines sharp
        self.side = self.cell_side * cells
        width = self.side + PANEL + 3.5 * MARGIN
        height = max(self.side, panel_height) + 2 * MARGIN
        self.canvas = Canvas.blank(width, height)
        self.panel = self.canvas.part(self.side + 2.5 * MARGIN, MARGIN)
        grid = self.canvas.part(MARGIN, MARGIN)
        grid.box(0, 0, self.side, self.side, WHITE)
        for offset in range(0, self.side + 1, self.cell_side):
            grid.box(offset - 0.5, 0, 1, self.side, LINE)
            grid.box(0, offset - 0.5, self.side, 1, LINE)

    def locate(self, point):
        """Where a point of the grid is in the picture. It is given in cells from the lower left corner, y upwards."""
        x, y = point
        return MARGIN + x * self.cell_side, MARGIN + self.side - y * self.cell_side


# ---- Box Pushing ----------------------------------------------------------------------------------------------------
def draw_box_pushing(env, index):
    """A picture, uint8 [height, width, 3], of one environment of a `BoxPushing` batch."""
    board = Board(env.grid, HEADER + 2 * ENTRY + 140)
    both_push = env.pushing_big[index]
    _goal_row_and_waypoints(board, env)
    _boxes(board, env, index, both_push)
    _pushers(board, env, index)

    names = ["small box 0", "small box 1", "big box, left", "big box, right"]
    notes = []
    for waypoint in env.last_waypoint[index]:
        name = "none yet" if waypoint < 0 else names[waypoint]
        notes.append(f"last waypoint: {name}")
    panel = board.panel
    _header(panel, env, index, "Box Pushing", f"grid: {env.grid} x {env.grid}")
    _agent_list(panel.part(0, HEADER), env, index, range(2), notes)
    _legend(panel.part(0, HEADER + 2 * ENTRY + 30), both_push)
    return board.canvas.pixels()


def _goal_row_and_waypoints(board, env):
    """Draws what stays the same."""
    left, top = board.locate((0, env.goal_y + 0.5))
    board.canvas.box(left, top, board.side, board.cell_side, GREEN_PALE, LINE)
    radius = max(3, board.cell_side * 0.14)
    for waypoint in env.waypoints:
        x, y = board.locate(waypoint)
        board.canvas.disc(x, y, radius, fill=None, outline=MUTED)


def _boxes(board, env, index, both_push):
    """Draws the two small boxes and the big one, which is lit while both agents push it."""
    labels = ["0", "1", "LR"]
    for number in range(3):
        x, y = board.locate((env.box_x[number], env.box_y[index, number]))
        is_big = number == 2
        _crate(board.canvas, x, y, board.cell_side, labels[number], is_lit=is_big and both_push)


def _pushers(board, env, index):
    """Draws the agents, side by side if they are in the same cell."""
    radius = max(9, board.cell_side * 0.29)
    centres = [board.locate(position) for position in env.position[index]]
    centres = _spread(centres, 1.5 * radius)
    for agent, (x, y) in enumerate(centres):
        orientation = env.orientation[index, agent]
        _agent(board.canvas, x, y, radius, agent, HEADINGS[orientation])


def _crate(canvas, x, y, cell_side, labels, is_lit=False):
    """Draws a box around (x, y). It is as many cells wide as it has labels."""
    count = len(labels)
    width = cell_side * (count - 0.14)
    height = cell_side * 0.86
    left = x - width / 2
    top = y - height / 2
    colour = YELLOW if is_lit else WOOD
    edge = max(1, cell_side / 18)
    canvas.box(left, top, width, height, colour, WOOD_DARK, edge, radius=cell_side / 12)
    for number, label in enumerate(labels):
        label_x = x + cell_side * (number + 0.5 - count / 2)
        canvas.text(label_x, y, label, cell_side * 0.38, anchor="m")


def _legend(panel, both_push):
    """Explains what is in the grid."""
    _crate(panel, 13, 0, 26, "0")
    _crate(panel, 39, 0, 26, "1")
    panel.text(66, 0, "small boxes")
    _crate(panel, 26, 30, 26, "LR", both_push)
    panel.text(66, 30, "big box, pushed by both" if both_push else "big box")
    panel.disc(26, 60, 6, fill=None, outline=MUTED)
    panel.text(66, 60, "waypoints")
    panel.box(2, 80, 48, 20, GREEN_PALE, LINE)
    panel.text(66, 90, "goal row")


# ---- Warehouse Tool Delivery ----------------------------------------------------------------------------------------
def draw_warehouse(env, index):
    """A picture, uint8 [height, width, 3], of one environment of a `Warehouse` batch."""
    plan = FloorPlan(env)
    headings = []
    notes = []
    for robot in range(env.n_robots):
        heading, note = _robot_note(env, index, robot)
        headings.append(heading)
        notes.append(note)
    notes.append(f"steps left: {env.arm_left[index]}")

    _tool_room(plan, env)
    _workshops(plan, env, index)
    _waypoints(plan, env)
    _arm_and_robots(plan, env, index, headings)

    panel = plan.panel
    labels = [*range(env.n_robots), ARM]
    subtitle = f"robots: {env.n_robots}, humans: {env.n_humans}"
    _header(panel, env, index, "Warehouse Tool Delivery", subtitle)
    _agent_list(panel.part(310, 0), env, index, labels, notes)
    _tools_to_find(panel.part(630, 0), env.copies - env.found[index])
    return plan.canvas.pixels()


class FloorPlan:
    """A picture with an empty warehouse, as large as it fits, and with room for a panel below it.

    Attributes:
        canvas: the whole picture.
        panel: the part of it below.
        room: the warehouse, a canvas on which a metre is METRE long.
        low, high: the warehouse's lower left and upper right corners (x, y) in metres.
    """

    def __init__(self, env):
        points = np.vstack([env.waypoints.reshape(-1, 2), env.starts, env.arm])
        lowest = points.min(axis=0)
        highest = points.max(axis=0)
        self.low = np.minimum(lowest - 0.5, 0)
        self.high = np.maximum(highest + 0.5, env.room_size)
        metres_wide, metres_deep = self.high - self.low
        width = metres_wide * METRE
        height = metres_deep * METRE
        scale = min(ROOM_WIDTH / metres_wide, ROOM_HEIGHT / metres_deep) / METRE
        panel_height = max(HEADER, ENTRY * env.n_agents)
        total_height = height * scale + panel_height + 3.25 * MARGIN
        self.canvas = Canvas.blank(ROOM_WIDTH + 2 * MARGIN, total_height)
        self.panel = self.canvas.part(MARGIN, height * scale + 2 * MARGIN)
        left = MARGIN + (ROOM_WIDTH - width * scale) / 2
        self.room = self.canvas.part(left, MARGIN, scale)
        _area(self.room, 0, 0, width, height, WHITE, MUTED, edge=2)

    def locate(self, point):
        """Where a point of the warehouse is in the room. It is given in metres, y upwards."""
        x, y = point
        return (x - self.low[0]) * METRE, (self.high[1] - y) * METRE


def _area(canvas, x, y, width, height, fill, outline, edge=1.5):
    """Draws a part of the warehouse with its upper left corner at (x, y)."""
    canvas.box(x, y, width, height, fill, outline, edge, radius=6)


def _tool_room(plan, env):
    """Draws the tool room around the arm, the robots' places at its table and the waypoint of Go-TR."""
    inside = np.vstack([env.tables, env.arm, env.tool_room])
    low = inside.min(axis=0) - 0.65
    high = inside.max(axis=0) + 0.65
    low = np.maximum(low, plan.low + 0.1)  # it ends before the walls of the warehouse
    high = np.minimum(high, plan.high - 0.1)
    left, bottom = plan.locate(low)
    right, top = plan.locate(high)
    _area(plan.room, left, top, right - left, bottom - top, PAPER, LINE)
    plan.room.text(left + 12, bottom - 12, "Tool room", colour=MUTED)


def _workshops(plan, env, index):
    """Draws every workshop with its human."""
    for human in range(env.n_humans):
        x, y = plan.locate(env.workshops[human])
        _workshop(plan.room.part(x, y), env, index, human)


def _waypoints(plan, env):
    """Draws the places to which the robots go."""
    for waypoint in env.waypoints.reshape(-1, 2):
        x, y = plan.locate(waypoint)
        plan.room.disc(x, y, 7, WHITE, MUTED)


def _arm_and_robots(plan, env, index, headings):
    """Draws the ways that the robots have to go, and on top of them the arm and then the robots."""
    room = plan.room
    centres = [plan.locate(position) for position in env.position[index]]
    centres = _spread(centres, 37)
    for robot in range(env.n_robots):
        if headings[robot] is not None:
            action = env.macro_action[index, robot]
            goal = plan.locate(env.waypoints[robot, action])
            colour, _ = agent_colours(robot)
            room.dashes(centres[robot], goal, colour)

    arm_x, arm_y = plan.locate(env.arm)
    _arm(room.part(arm_x, arm_y), env, index)
    for robot, (x, y) in enumerate(centres):
        _agent(room, x, y, 16, robot, headings[robot])
        _carried_tools(room, x, y, env.carried[index, robot])


def _robot_note(env, index, robot):
    """The direction in which a robot moves, (dx, dy) or None, and words about how far it has to go or where it is."""
    is_running = not env.macro_done[index, robot]
    if is_running:
        action = env.macro_action[index, robot]
        way = env.waypoints[robot, action] - env.position[index, robot]
        distance = hypot(*way)
        if distance > 0:
            east, north = way / distance
            return (east, -north), f"{distance:.1f} m to go"

    location = env.location[index, robot]
    if location == env.nowhere_yet or env.under_way[index, robot]:
        return None, "at no waypoint"
    if location == env.tool_room_place:
        return None, "in the tool room"
    if location != env.table_place:
        return None, f"at workshop {location}"
    waited = env.waited[index, robot]
    if waited > 0 and (is_running or env.primitive):
        return None, f"waits for a tool, {waited} of {env.tool_wait_steps}"
    return None, "at the table"


def _carried_tools(room, x, y, counts):
    """Draws above the robot at (x, y) each kind of tool that it carries, with a number if there are several."""
    kinds = np.flatnonzero(counts)
    columns = len(kinds)
    pitch = min(19, 37 / max(columns, 1))  # three kinds are as wide as the robot
    for column, kind in enumerate(kinds):
        tool_x = x + (column - (columns - 1) / 2) * pitch
        _tool(room, tool_x, y - 27, pitch * 0.46, kind)
        if counts[kind] > 1:
            room.text(tool_x, y - 42, f"x{counts[kind]}", 11, anchor="m")


def _tool(canvas, x, y, radius, kind, is_ghost=False):
    """Draws a tool: its number in its shape and colour. A ghost is a tool that is not there; it is pale."""
    corners, relative_size, colour = TOOLS[kind]
    if corners == 3:
        y += 0.18 * radius  # a triangle's centre is below the middle of its height
    reach = relative_size * radius
    first_angle = pi / 4 if corners == 4 else -pi / 2  # a square stands on a side, the others have a corner at the top
    shape = []
    for corner in range(corners):
        angle = first_angle + 2 * pi * corner / corners
        dx = reach * cos(angle)
        dy = reach * sin(angle)
        shape.append((x + dx, y + dy))
    fill = PAPER if is_ghost else colour
    ink = MUTED if is_ghost else INK
    canvas.polygon(shape, fill, ink, edge=radius / 10)
    canvas.text(x, y, kind, radius * 1.05, ink, anchor="m", bold=not is_ghost)


def _workshop(canvas, env, index, human):
    """Draws a workshop around its waypoint, the origin. It is red while its human is late."""
    is_late = _is_late(env, index, human)
    wall = ALARM if is_late else LINE
    floor = ALARM_PALE if is_late else PAPER
    is_north = env.workshops[human, 1] >= env.room_size[1] / 2
    top = -148 if is_north else -46
    desk_top = -148 if is_north else 38  # on the side away from the middle of the warehouse
    _area(canvas, -88, top, 176, 194, floor, wall)
    desk = canvas.part(-76, desk_top)
    desk.text(0, 18, f"W({human})", colour=MUTED)
    _human(desk, env, index, human, floor)


def _is_late(env, index, human):
    """Whether a human has to wait for its next tool."""
    return env.clock[index, human] <= 0 and not env.has_next_tool[index, human]


def _human(desk, env, index, human, floor):
    """Draws a human, how far its work is, and the tool for its next phase. `floor` is the colour around it."""
    phase = env.phase[index, human]
    clock = env.clock[index, human]
    has_tool = env.has_next_tool[index, human]
    is_late = _is_late(env, index, human)
    is_finished = phase == LAST_PHASE and clock <= 0
    ink = ALARM if is_late else INK
    colour = SLATE
    if is_finished:
        colour = GREEN
    if is_late:
        colour = ALARM

    _phase_lights(desk, PHASES if is_finished else phase, colour)
    desk.box(2, 55, 32, 26, colour, radius=13)  # the human's body
    desk.disc(18, 47, 9, colour, floor)  # and head
    desk.text(50, 58, _human_note(phase, is_finished, has_tool), colour=ink)
    if phase < LAST_PHASE:
        _tool(desk, 138, 57, 13, phase, is_ghost=not has_tool)
    share = 1 - clock / env.phase_lengths[human, phase]
    _bar(desk, 0, 89, 104, 8, share, colour)
    if not is_finished:
        countdown = f"{-clock} late" if is_late else f"{clock} left"
        desk.text(152, 93, countdown, SMALL, ink, anchor="r")


def _phase_lights(desk, done, colour):
    """Draws a light for each phase. Those that are done are green, and the present one has the given colour."""
    for phase in range(PHASES):
        light = LINE
        if phase < done:
            light = GREEN
        if phase == done:
            light = colour
        desk.box(84 + 18 * phase, 12, 14, 12, light, radius=3)


def _human_note(phase, is_finished, has_tool):
    """How far a human is, in words."""
    if is_finished:
        return "finished"
    if phase == LAST_PHASE:
        return "last phase"
    return "has tool" if has_tool else "needs tool"


def _arm(canvas, env, index):
    """Draws the arm at the origin, its table with the staged tools, its hand, and what it is doing and for how long."""
    action = env.macro_action[index, -1]
    steps_left = env.arm_left[index]
    staged = env.staged[index]
    is_running = steps_left > 0
    passes = is_running and 1 <= action <= env.n_robots
    searches = is_running and action > env.n_robots
    hands_over = passes and env.pass_ready[index]  # the robot was waiting when the Pass began
    _area(canvas, -40, -38, 168, 76, WOOD, WOOD_DARK)
    if passes:
        robot = action - 1
        east, north = env.tables[robot] - env.arm
        # The hand is at six tenths of the way to the robot's place.
        hand_x = 0.6 * METRE * east
        hand_y = 0.6 * METRE * -north
        if hands_over:
            _hand(canvas, hand_x, hand_y, SLATE, staged[0])
        else:
            _hand(canvas, hand_x, hand_y, ALARM, NO_TOOL)
    if searches:
        tool = action - 1 - env.n_robots
        _hand(canvas, -24, -22, SLATE, tool, is_ghost=True)
    _agent(canvas, 0, 0, 16, ARM)
    _staged_tools(canvas, staged, hands_over)
    words = "at rest"
    share = 0.0
    if is_running:
        words = env.macro_action_names[-1][action]
        share = 1 - steps_left / env.task_steps[action]
    canvas.text(28, 13, words, SMALL)
    _bar(canvas, 28, 24, 92, 6, share, SLATE)


def _hand(canvas, x, y, colour, tool, is_ghost=False):
    """Draws the arm from the origin to its hand at (x, y) and a tool in it."""
    canvas.line((0, 0), (x, y), SLATE, thickness=7)
    canvas.disc(x, y, 12, WHITE, colour, edge=2)
    if tool != NO_TOOL:
        _tool(canvas, x, y, 8, tool, is_ghost)


def _staged_tools(canvas, staged, hands_over):
    """Draws the places for staged tools and the tools in them. The first one is a ghost while the hand has it."""
    pitch = min(34, 96 / len(staged))
    side = pitch * 0.88
    for number, tool in enumerate(staged):
        x = 28 + (number + 0.44) * pitch
        left = x - side / 2
        top = -14 - side / 2
        canvas.box(left, top, side, side, WHITE, WOOD_DARK, radius=3)
        if tool != NO_TOOL:
            in_hand = hands_over and number == 0
            _tool(canvas, x, -14, pitch * 0.32, tool, is_ghost=in_hand)


def _tools_to_find(panel, counts):
    """Says how many copies of each tool the arm has not found yet."""
    panel.text(0, 11, "tools still to be found", colour=MUTED)
    for kind, count in enumerate(counts):
        column = panel.part(76 * kind, 0)
        ink = INK if count else MUTED
        _tool(column, 12, 40, 12, kind, is_ghost=count == 0)
        column.text(32, 40, f"x {count}", colour=ink)


# ---- Capture Target -------------------------------------------------------------------------------------------------
def draw_capture_target(env, index):
    """A picture, uint8 [height, width, 3], of one environment of a `CaptureTarget` batch."""
    board = Board(env.grid, HEADER + 40 + ENTRY * env.n_agents)
    position = env.position[index]
    target = env.target[index]
    _open_border(board, env.grid)
    _target(board, target)
    for cell in np.unique(position, axis=0):
        stands_here = (position == cell).all(axis=1)
        _crowd(board, cell, np.flatnonzero(stands_here))

    notes = []
    for agent in range(env.n_agents):
        note = "sees the target" if env.visible[index, agent] else "target hidden"
        goal_x, goal_y = env.goal[index, agent]
        if goal_x >= 0:
            note += f", heads for {goal_x}, {goal_y}"
        notes.append(note)
    panel = board.panel
    subtitle = f"agents: {env.n_agents}, torus: {env.grid} x {env.grid}"
    on_target = (position == target).all(axis=1)
    arrivals = panel.part(0, HEADER)
    _header(panel, env, index, "Capture Target", subtitle)
    _arrivals(arrivals, np.count_nonzero(on_target), env.n_agents)
    _agent_list(arrivals.part(0, 36), env, index, range(env.n_agents), notes)
    return board.canvas.pixels()


def _open_border(board, cells):
    """Draws the border dashed, because the world wraps around there."""
    lower_left = board.locate((0, 0))
    lower_right = board.locate((cells, 0))
    upper_right = board.locate((cells, cells))
    upper_left = board.locate((0, cells))
    board.canvas.dashes(lower_left, lower_right, MUTED)
    board.canvas.dashes(lower_right, upper_right, MUTED)
    board.canvas.dashes(upper_right, upper_left, MUTED)
    board.canvas.dashes(upper_left, lower_left, MUTED)


def _target(board, target):
    """Draws a red cross on the target's cell, so large that it is seen however many agents stand on it."""
    side = board.cell_side
    x, y = board.locate(target + 0.5)
    board.canvas.box(x - side / 2, y - side / 2, side, side, ALARM_PALE)
    _cross(board.canvas, x, y, side * 0.56)


def _cross(canvas, x, y, radius):
    """Draws a red cross around (x, y)."""
    left = x - radius
    right = x + radius
    top = y - radius
    bottom = y + radius
    canvas.line((left, bottom), (right, top), ALARM, radius / 3)
    canvas.line((left, top), (right, bottom), ALARM, radius / 3)


def _crowd(board, cell, agents):
    """Draws the agents that stand on one cell, in rows and columns."""
    x, y = board.locate(cell + 0.5)
    columns = ceil(sqrt(len(agents)))
    rows = ceil(len(agents) / columns)
    pitch = max(board.cell_side, 26) / max(columns, 1.6)
    for number, agent in enumerate(agents):
        row, column = divmod(number, columns)
        agent_x = x + (column - (columns - 1) / 2) * pitch
        agent_y = y + (row - (rows - 1) / 2) * pitch
        _agent(board.canvas, agent_x, agent_y, pitch * 0.47, agent)


def _arrivals(panel, count, agents):
    """Says how many of the agents stand on the target."""
    _cross(panel, 8, 6, 7)
    panel.text(24, 6, "on the target", colour=MUTED)
    panel.text(PANEL, 6, f"{count} / {agents}", anchor="r")
    _bar(panel, 0, 18, PANEL, 6, count / agents, ALARM)


# ---- Overcooked -----------------------------------------------------------------------------------------------------
def draw_overcooked(env, index):
    """A picture, uint8 [height, width, 3], of one environment of an `Overcooked` batch."""
    board = Board(SIDE, HEADER + COOKS * ENTRY + 150)
    cells = env.cell[index]
    held = env._held()[index]
    _counters(board, env)
    _remembered_targets(board, env, index)
    for cook in range(COOKS):
        x, y = _centre(board, cells[COOK + cook])
        _agent(board.canvas, x, y, board.cell_side * 0.3, cook)

    for cell in np.unique(cells[:BOARD]):
        things = np.flatnonzero(cells[:BOARD] == cell)
        x, y = _centre(board, cell)
        if cell in cells[COOK:]:  # in a hand, upper right of the cook's middle
            _things(board.canvas.part(x + 22, y - 22, 0.85), things, env.strikes[index])
        else:
            _things(board.canvas.part(x, y), things, env.strikes[index])

    notes = []
    for cook in range(COOKS):
        note = "holds nothing" if held[cook] == NOTHING else f"holds {THING_NAMES[held[cook]]}"
        chop_moves = env.chop_moves[index, cook]
        if chop_moves > 0:
            note += f", chop moves: {chop_moves}"
        notes.append(note)
    panel = board.panel
    _header(panel, env, index, "Overcooked", f"layout: {env.layout}")
    _agent_list(panel.part(0, HEADER), env, index, range(COOKS), notes)
    _salad(panel.part(0, HEADER + COOKS * ENTRY + 30), env.strikes[index])
    return board.canvas.pixels()


def _centre(board, cell):
    """The middle of a cell of the kitchen."""
    return board.locate((COLUMN[cell] + 0.5, SIDE - ROW[cell] - 0.5))


def _counters(board, env):
    """Draws the counters, the boards with a knife each, and the delivery counter with a star."""
    side = board.cell_side
    for cell in np.flatnonzero(~env.is_floor):
        x, y = _centre(board, cell)
        board.canvas.box(x - side / 2, y - side / 2, side, side, WOOD, WOOD_DARK)
    for cell in env.starts[BOARD:DELIVERY]:
        x, y = _centre(board, cell)
        board.canvas.box(x - 0.38 * side, y - 0.38 * side, 0.76 * side, 0.76 * side, PAPER, MUTED, radius=6)
        board.canvas.line((x - 0.3 * side, y - 0.28 * side), (x - 0.3 * side, y + 0.06 * side), MUTED, thickness=5)
        board.canvas.line((x - 0.3 * side, y + 0.06 * side), (x - 0.3 * side, y + 0.28 * side), INK, thickness=5)
    x, y = _centre(board, env.starts[DELIVERY])
    board.canvas.box(x - side / 2, y - side / 2, side, side, GREEN_PALE, GREEN_DARK)
    _star(board.canvas, x, y, side * 0.34)


def _star(canvas, x, y, radius):
    """Draws a star around (x, y)."""
    corners = []
    for number in range(10):
        reach = radius if number % 2 == 0 else 0.45 * radius
        angle = pi * number / 5 - pi / 2
        corners.append((x + reach * cos(angle), y + reach * sin(angle)))
    canvas.polygon(corners, YELLOW, GREEN_DARK)


def _remembered_targets(board, env, index):
    """Draws a line from each cook that goes for a thing to the place where it remembers the thing."""
    for cook in range(COOKS):
        thing = env.macro_action[index, cook] - 1  # the thing to which a macro-action leads
        is_running = not env.macro_done[index, cook]
        if is_running and TOMATO <= thing <= DELIVERY:
            start = _centre(board, env.cell[index, COOK + cook])
            goal = _centre(board, env.memory[index, cook, thing])
            colour, _ = agent_colours(cook)
            board.canvas.dashes(start, goal, colour)


def _things(canvas, things, strikes):
    """Draws what is in a cell around the origin: a vegetable, or a plate with what is on it."""
    foods = [thing for thing in things if thing < PLATE]
    has_plate = len(foods) < len(things)
    if has_plate:
        canvas.disc(0, 0, 26, WHITE, SLATE, edge=2)
        canvas.disc(0, 0, 18, fill=None, outline=LINE)
    places = [(0, 0), (-11, 0), (11, 0)] if len(foods) < 3 else [(0, -11), (-11, 8), (11, 8)]
    if len(foods) == 2:
        places = places[1:]
    for food, (x, y) in zip(foods, places, strict=False):
        _food(canvas, x, y, 11 if has_plate else 18, food, strikes[food])


def _food(canvas, x, y, radius, food, strikes):
    """Draws a vegetable, with a cut for each strike that it has got and, when it is chopped, a ring."""
    colour, letter_colour, letter = FOODS[food]
    canvas.disc(x, y, radius, colour, INK)
    for cut in range(2 * strikes):
        angle = pi * (cut // 2 / STRIKES + 1 / 6 + cut % 2)
        dx = radius * cos(angle)
        dy = radius * sin(angle)
        canvas.line((x + 0.6 * dx, y + 0.6 * dy), (x + dx, y + dy), INK, thickness=radius / 8)
    if strikes == STRIKES:
        canvas.disc(x, y, radius * 1.2, fill=None, outline=GREEN, edge=2)
    canvas.text(x, y, letter, radius, letter_colour, anchor="m", bold=True)


def _salad(panel, strikes):
    """Says how far the vegetables of the salad are chopped."""
    panel.text(0, 0, "strikes of a vegetable", colour=MUTED)
    for food in FOODS:
        entry = panel.part(0, 34 + 36 * food)
        _food(entry, 13, 0, 13, food, strikes[food])
        entry.text(36, 0, THING_NAMES[food])
        _bar(entry, 110, -4, 90, 8, strikes[food] / STRIKES, GREEN)
        entry.text(PANEL, 0, f"{strikes[food]} / {STRIKES}", anchor="r")
