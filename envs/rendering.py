"""Pictures of the three domains, drawn with Pillow: a scene, and beside or below it what every agent is doing.

Everything is drawn at twice the size and then reduced, which smooths the edges. Lengths and positions are in pixels of
the finished picture, y downwards.
"""

from copy import copy
from functools import lru_cache
from itertools import combinations
from math import ceil, cos, hypot, pi, sin, sqrt

import numpy as np
from PIL import Image, ImageDraw, ImageFont

MARGIN, BOARD, PANEL, ROOM = 20, 560, 260, (860, 640)  # the margin, the widest grid, the panel, the widest warehouse
HEADER, ROW = 150, 36  # heights of a panel's head and of an agent's entry
METRE = 95  # of the warehouse, before it is made to fit

# Okabe and Ito's colours, which can be told apart with any kind of colour vision, and neutral ones around them.
GREEN, PURPLE, SKY, YELLOW, SLATE = "#009e73", "#cc79a7", "#56b4e9", "#f0e442", "#46525e"
INK, MUTED, LINE, PAPER, WHITE = "#22303c", "#6e7b87", "#dbe2e8", "#f4f6f8", "#ffffff"
ALARM, ALARM_PALE, GREEN_PALE, GREEN_DARK = "#c8102e", "#fbe1e1", "#d9f0e6", "#00604a"
WOOD, WOOD_DARK = "#e5c79c", "#8a6534"
AGENTS = [("#0072b2", WHITE), ("#e69f00", INK), (GREEN, WHITE), ("#d55e00", WHITE), (PURPLE, INK), (SKY, INK)]
AGENTS += [(YELLOW, INK), (SLATE, WHITE), ("#004a75", WHITE), ("#8f6300", WHITE)]  # (disc, number)
TOOLS = ((3, 1.25, PURPLE), (4, 1.15, YELLOW), (6, 1.05, SKY))  # corners, relative size and colour of each kind
PILLS = {"free": (LINE, MUTED), "ended": (GREEN_PALE, GREEN_DARK), "running": (SLATE, WHITE)}
ARM = "A"

_font = lru_cache(ImageFont.load_default)


class Canvas:
    """A picture of even width and height, or a part of it with an origin and a unit of length of its own."""

    def __init__(self, width, height):
        self.image = Image.new("RGB", (4 * ceil(width / 2), 4 * ceil(height / 2)), PAPER)
        self.draw = ImageDraw.Draw(self.image)
        self.x, self.y, self.unit = 0.0, 0.0, 2.0

    def at(self, x, y, unit=1.0):
        """The part with the origin (x, y)."""
        part = copy(self)
        part.x, part.y, part.unit = self.x + x * self.unit, self.y + y * self.unit, self.unit * unit
        return part

    def _points(self, points):
        return [(self.x + x * self.unit, self.y + y * self.unit) for x, y in points]

    def _width(self, line):
        return max(1, round(line * self.unit))

    def box(self, x, y, width, height, fill=None, outline=None, line=1.0, radius=0.0):
        """(x, y) is the upper left corner."""
        (x0, y0), (x1, y1) = self._points([(x, y), (x + width, y + height)])
        corners = (round(x0), round(y0), max(round(x1), round(x0) + 1) - 1, max(round(y1), round(y0) + 1) - 1)
        self.draw.rounded_rectangle(corners, radius * self.unit, fill, outline, self._width(line))

    def disc(self, x, y, radius, fill=None, outline=None, line=1.0):
        corners = self._points([(x - radius, y - radius), (x + radius, y + radius)])
        self.draw.ellipse(corners, fill, outline, self._width(line))

    def line(self, points, fill, width=1.0):
        self.draw.line(self._points(points), fill, self._width(width))

    def dashes(self, start, end, fill):
        count = int(hypot(end[0] - start[0], end[1] - start[1]) / 12) + 1
        for dash in np.linspace(start, end, 2 * count).reshape(count, 2, 2).tolist():
            self.line(dash, fill, 2)

    def polygon(self, points, fill, outline=None, line=1.0):
        self.draw.polygon(self._points(points), fill, outline, self._width(line))

    def text(self, x, y, words, size=14.0, fill=INK, anchor="l", bold=False):
        """anchor: "l", "m" or "r", whether x is the left end, the middle or the right end; y is the middle."""
        size = max(size * self.unit, 10)
        (at,), stroke = self._points([(x, y)]), round(size / 44) if bold else 0
        self.draw.text(at, str(words), fill, _font(size), anchor + "m", stroke_width=stroke)

    def pixels(self):
        """uint8 [height, width, 3]."""
        return np.array(self.image.reduce(2))  # LANCZOS looks the same and takes several times as long


# ---- what the pictures are made of ----------------------------------------------------------------------------------
def _colours(label):
    return (SLATE, WHITE) if label == ARM else AGENTS[label % len(AGENTS)]


def _agent(canvas, x, y, radius, label, heading=None):
    """A disc with the label, an agent's number or ARM; heading: (dx, dy) of length 1 gives it a nose."""
    if heading is not None:
        dx, dy = np.multiply(heading, radius)
        canvas.polygon([(x + a * dx - b * dy, y + a * dy + b * dx) for a, b in ((0.3, 1), (1.6, 0), (0.3, -1))], INK)
    fill, ink = _colours(label)
    canvas.disc(x, y, radius, fill, INK, radius / 12)
    canvas.text(x, y, label, radius * 1.2, ink, "m", bold=radius > 12)


def _tool(canvas, x, y, radius, kind, ghost=False):
    """A tool: its number in its shape and colour; a ghost is one that is not there."""
    corners, size, colour = TOOLS[kind]
    y += 0.18 * radius * (corners == 3)  # a triangle's centre is below the middle of its height
    first = pi / 4 if corners == 4 else -pi / 2
    angles = [first + 2 * pi * corner / corners for corner in range(corners)]
    shape = [(x + size * radius * cos(angle), y + size * radius * sin(angle)) for angle in angles]
    canvas.polygon(shape, PAPER if ghost else colour, MUTED if ghost else INK, radius / 10)
    canvas.text(x, y, kind, radius * 1.05, MUTED if ghost else INK, "m", bold=not ghost)


def _cross(canvas, x, y, radius):
    for slant in (-radius, radius):
        canvas.line([(x - radius, y - slant), (x + radius, y + slant)], ALARM, radius / 3)


def _bar(canvas, x, y, width, height, share, colour):
    canvas.box(x, y, width, height, LINE, radius=height / 2)
    if share > 0:
        canvas.box(x, y, max(width * min(share, 1), height), height, colour, radius=height / 2)


def _spread(points, gap):
    """Points (x, y), pushed apart until no two are closer than the gap."""
    points = np.array(points, float)
    for _ in range(20):
        for first, second in combinations(range(len(points)), 2):
            apart = points[second] - points[first] + (1e-6, 0)  # those on the same spot are put side by side
            push = apart * max(gap / hypot(*apart) - 1, 0) / 2
            points[first] -= push
            points[second] += push
    return points.tolist()


def _header(canvas, env, index, title, subtitle):
    """Title, step, return and how the episode stands."""
    elapsed, over, success = env.elapsed[index], env.over[index], env.success[index]
    status = "success" if success else "not started" if over and not elapsed else "ended" if over else "running"
    values = f"{elapsed} / {env.horizon}", f"{env.episode_return[index]:.1f}", status
    canvas.text(0, 11, title, 21, bold=True)
    canvas.text(0, 37, subtitle + (", primitive actions" if env.primitive else ""), fill=MUTED)
    for name, value, y in zip(("step", "return", "episode"), values, (68, 104, 128), strict=True):
        canvas.text(0, y, name, fill=MUTED)
        canvas.text(PANEL, y, value, fill=GREEN_DARK if value == "success" else INK, anchor="r")
    _bar(canvas, 0, 79, PANEL, 6, elapsed / env.horizon, MUTED)


def _agents(canvas, env, index, labels, notes):
    """An entry for each agent: what it runs, whether that has just ended, and a note."""
    for agent, (label, note) in enumerate(zip(labels, notes, strict=True)):
        entry, action = canvas.at(0, ROW * agent), env.macro_action[index, agent]
        status = "free" if action < 0 else "ended" if env.macro_done[index, agent] else "running"
        _agent(entry, 12, 18, 11, label)
        entry.text(32, 10, "none yet" if action < 0 else env.macro_action_names[agent][action])
        entry.text(32, 26, note, 12, MUTED)
        entry.box(PANEL - 54, 2, 54, 18, PILLS[status][0], radius=9)
        entry.text(PANEL - 27, 11, status, 12, PILLS[status][1], "m")


def _board(grid, panel_height):
    """An empty grid with room for a panel on its right.

    Returns:
        canvas, the panel's canvas, the cells' size, and a function from (x, y) in cells, y to the north, to pixels.
    """
    cell = max(2, BOARD // grid)  # whole pixels keep the grid lines sharp
    side = cell * grid
    canvas = Canvas(side + PANEL + 3.5 * MARGIN, max(side, panel_height) + 2 * MARGIN)
    canvas.box(MARGIN, MARGIN, side, side, WHITE)
    for place in range(0, side + 1, cell):
        canvas.box(MARGIN + place - 0.5, MARGIN, 1, side, LINE)
        canvas.box(MARGIN, MARGIN + place - 0.5, side, 1, LINE)
    panel = canvas.at(side + 2.5 * MARGIN, MARGIN)
    return canvas, panel, cell, lambda x, y: (MARGIN + x * cell, MARGIN + side - y * cell)


# ---- Box Pushing ----------------------------------------------------------------------------------------------------
def draw_box_pushing(env, index):
    """Picture, uint8 [height, width, 3], of one environment of a `BoxPushing` batch."""
    canvas, panel, cell, pixel = _board(env.grid, HEADER + 2 * ROW + 140)
    canvas.box(*pixel(0, env.goal_y + 0.5), cell * env.grid, cell, GREEN_PALE, LINE)
    for waypoint in env.waypoints:
        canvas.disc(*pixel(*waypoint), max(3, cell * 0.14), None, MUTED, 1.5)
    box_y, together = env.box_y[index], bool(env.pushing_big[index])
    for number in range(2):
        _crate(canvas, *pixel(env.cell_x[number], box_y[number]), cell, str(number))
    _crate(canvas, *pixel(env.cell_x[2:].mean(), box_y[2]), cell, "LR", together)

    radius = max(9, cell * 0.29)
    for agent, (x, y) in enumerate(_spread([pixel(*position) for position in env.position[index]], 1.5 * radius)):
        heading = ((0, -1), (1, 0), (0, 1), (-1, 0))[env.orientation[index, agent]]
        _agent(canvas, x, y, radius, agent, heading)

    _header(panel, env, index, "Box Pushing", f"grid: {env.grid} x {env.grid}")
    last = ("small box 0", "small box 1", "big box, left", "big box, right", "none yet")
    notes = [f"last waypoint: {last[waypoint]}" for waypoint in env.last_waypoint[index]]
    _agents(panel.at(0, HEADER), env, index, range(2), notes)
    legend = panel.at(0, HEADER + 2 * ROW + 30)
    lines = ("small boxes", "big box, pushed by both" if together else "big box", "waypoints", "goal row")
    for row, words in enumerate(lines):
        legend.text(66, 30 * row, words)
    _crate(legend, 13, 0, 26, "0")
    _crate(legend, 39, 0, 26, "1")
    _crate(legend, 26, 30, 26, "LR", together)
    legend.disc(26, 60, 6, None, MUTED, 1.5)
    legend.box(2, 80, 48, 20, GREEN_PALE, LINE)
    return canvas.pixels()


def _crate(canvas, x, y, size, labels, lit=False):
    """A box around (x, y), with a label for each of its cells; size: that of a cell."""
    wide, high, line = size * (len(labels) - 0.14), size * 0.86, max(1, size / 18)
    canvas.box(x - wide / 2, y - high / 2, wide, high, YELLOW if lit else WOOD, WOOD_DARK, line, size / 12)
    for number, label in enumerate(labels):
        canvas.text(x + size * (number + 0.5 - len(labels) / 2), y, label, size * 0.38, anchor="m")


# ---- Warehouse Tool Delivery ----------------------------------------------------------------------------------------
def draw_warehouse(env, index):
    """Picture, uint8 [height, width, 3], of one environment of a `Warehouse` batch."""
    points = np.vstack([env.waypoints.reshape(-1, 2), env.starts, env.arm])
    low, high = np.minimum(points.min(0) - 0.5, 0), np.maximum(points.max(0) + 0.5, env.room_size)
    scale = min(ROOM / (high - low)) / METRE
    width, height = (high - low) * METRE
    canvas = Canvas(ROOM[0] + 2 * MARGIN, height * scale + max(HEADER, ROW * env.n_agents) + 3.25 * MARGIN)
    room = canvas.at(MARGIN + (ROOM[0] - width * scale) / 2, MARGIN, scale)

    def place(point):
        return (point[0] - low[0]) * METRE, (high[1] - point[1]) * METRE

    room.box(0, 0, width, height, WHITE, MUTED, 2, 6)
    inside = np.vstack([env.tables, env.arm, env.tool_room])
    left, bottom = place((inside.min(0) - 0.65).clip(low + 0.1, high - 0.1))
    right, top = place((inside.max(0) + 0.65).clip(low + 0.1, high - 0.1))
    room.box(left, top, right - left, bottom - top, PAPER, LINE, 1.5, 6)
    room.text(left + 12, bottom - 12, "Tool room", fill=MUTED)
    for human in range(env.n_humans):
        _workshop(room.at(*place(env.workshops[human])), env, index, human)
    for x, y in {place(point) for point in env.waypoints.reshape(-1, 2)}:
        room.disc(x, y, 7, WHITE, MUTED, 1.5)
    robots = _spread([place(position) for position in env.position[index]], 37)
    headings, notes = zip(*(_robot_note(env, index, robot) for robot in range(env.n_robots)), strict=True)
    for robot, heading in enumerate(headings):
        if heading:
            goal = env.waypoints[robot, env.macro_action[index, robot]]
            room.dashes(robots[robot], place(goal), _colours(robot)[0])
    _arm(room.at(*place(env.arm)), env, index)
    for robot, (x, y) in enumerate(robots):
        _agent(room, x, y, 16, robot, headings[robot])
        carried = env.carried[index, robot]
        kinds = np.flatnonzero(carried)
        pitch = min(19, 37 / max(len(kinds), 1))  # three kinds are as wide as the robot
        for column, kind in enumerate(kinds):
            tool_x = x + (column - (len(kinds) - 1) / 2) * pitch
            _tool(room, tool_x, y - 27, pitch * 0.46, kind)
            if carried[kind] > 1:
                room.text(tool_x, y - 42, f"x{carried[kind]}", 11, anchor="m")

    panel = canvas.at(MARGIN, height * scale + 2 * MARGIN)
    _header(panel, env, index, "Warehouse Tool Delivery", f"robots: {env.n_robots}, humans: {env.n_humans}")
    notes += (f"steps left: {env.arm_left[index]}",)
    _agents(panel.at(310, 0), env, index, [*range(env.n_robots), ARM], notes)
    panel.text(630, 11, "tools still to be found", fill=MUTED)
    for kind, count in enumerate(env.copies - env.found[index]):
        _tool(panel, 642 + 76 * kind, 40, 12, kind, ghost=count == 0)
        panel.text(662 + 76 * kind, 40, f"x {count}", fill=INK if count else MUTED)
    return canvas.pixels()


def _robot_note(env, index, robot):
    """The direction in which a robot moves, (dx, dy) or None, and in words how far it is or where."""
    position, running = env.position[index, robot], not env.macro_done[index, robot]
    to_go = env.waypoints[robot, env.macro_action[index, robot]] - position
    distance, location, waited = hypot(*to_go), env.location[index, robot], env.waited[index, robot]
    if running and distance > 0:
        return (to_go[0] / distance, -to_go[1] / distance), f"{distance:.1f} m to go"
    places = [*(f"at workshop {human}" for human in range(env.n_humans)), "in the tool room", "at the table"]
    if location == env.nowhere_yet or env.under_way[index, robot]:
        return None, "at no waypoint"
    waits = places[location] == "at the table" and waited > 0 and (running or env.primitive)
    return None, f"waits for a tool, {waited} of {env.tool_wait_steps}" if waits else places[location]


def _workshop(canvas, env, index, human):
    """The room around its waypoint, the origin; its human works on the side away from the middle of the warehouse."""
    phase, clock, has_tool = env.phase[index, human], env.clock[index, human], env.has_next_tool[index, human]
    last = phase == 3
    finished, late = last and clock <= 0, clock <= 0 and not has_tool
    floor, strong, ink = (ALARM_PALE, ALARM, ALARM) if late else (PAPER, GREEN if finished else SLATE, INK)
    above = env.workshops[human, 1] >= env.room_size[1] / 2
    canvas.box(-88, -148 if above else -46, 176, 194, floor, ALARM if late else LINE, 1.5, 6)
    desk = canvas.at(-76, -148 if above else 38)
    desk.text(0, 18, f"W({human})", fill=MUTED)
    for number in range(4):
        colour = GREEN if number < phase or finished else strong if number == phase else LINE
        desk.box(84 + 18 * number, 12, 14, 12, colour, radius=3)
    desk.box(2, 55, 32, 26, strong, radius=13)
    desk.disc(18, 47, 9, strong, floor, 1.5)
    words = "finished" if finished else "last phase" if last else "has tool" if has_tool else "needs tool"
    desk.text(50, 58, words, fill=ink)
    if not last:
        _tool(desk, 138, 57, 13, phase, ghost=not has_tool)
    _bar(desk, 0, 89, 104, 8, 1 - clock / env.phase_lengths[human, phase], strong)
    if not finished:
        desk.text(152, 93, f"{-clock} late" if late else f"{clock} left", 12, ink, "r")


def _arm(canvas, env, index):
    """The arm at the origin: what it is doing and for how long, what its hand holds, and the staged tools."""
    task, steps_left, staged = env.macro_action[index, -1], env.arm_left[index], env.staged[index]
    passes, searches = steps_left > 0 and 1 <= task <= env.n_robots, steps_left > 0 and task > env.n_robots
    ready = passes and env.pass_ready[index]
    holds = ready and staged[0] >= 0
    canvas.box(-40, -38, 168, 76, WOOD, WOOD_DARK, 1.5, 6)
    if passes or searches:
        hand = 0.6 * METRE * (env.tables[task - 1] - env.arm) * (1, -1) if passes else (-24, -22)
        canvas.line([(0, 0), hand], SLATE, 7)
        canvas.disc(*hand, 12, WHITE, SLATE if ready or searches else ALARM, 2)
        if holds or searches:
            _tool(canvas, *hand, 8, staged[0] if holds else task - env.n_robots - 1, ghost=searches)
    _agent(canvas, 0, 0, 16, ARM)
    pitch = min(34, 96 / len(staged))
    for place, tool in enumerate(staged):
        x, size = 28 + (place + 0.44) * pitch, pitch * 0.88
        canvas.box(x - size / 2, -14 - size / 2, size, size, WHITE, WOOD_DARK, 1, 3)
        if tool >= 0:
            _tool(canvas, x, -14, pitch * 0.32, tool, ghost=holds and place == 0)
    duration = env.pass_steps if passes else env.search_steps if searches else env.arm_wait_steps
    canvas.text(28, 13, env.macro_action_names[-1][task] if steps_left > 0 else "at rest", 12)
    _bar(canvas, 28, 24, 92, 6, 1 - steps_left / duration if steps_left > 0 else 0, SLATE)


# ---- Capture Target -------------------------------------------------------------------------------------------------
def draw_capture_target(env, index):
    """Picture, uint8 [height, width, 3], of one environment of a `CaptureTarget` batch."""
    canvas, panel, cell, pixel = _board(env.grid, HEADER + 40 + ROW * env.n_agents)
    position, target = env.position[index], env.target[index]
    corners = [pixel(*corner) for corner in ((0, 0), (env.grid, 0), (env.grid, env.grid), (0, env.grid))]
    for start, end in zip(corners, corners[1:] + corners[:1], strict=True):
        canvas.dashes(start, end, MUTED)  # an open border: the world wraps around

    x, y = pixel(*(target + 0.5))
    canvas.box(x - cell / 2, y - cell / 2, cell, cell, ALARM_PALE)
    _cross(canvas, x, y, cell * 0.56)  # its ends are seen however many agents stand on it
    for place in np.unique(position, axis=0):
        here = np.flatnonzero((position == place).all(1))
        columns = ceil(sqrt(len(here)))
        rows, pitch = ceil(len(here) / columns), max(cell, 26) / max(columns, 1.6)
        x, y = pixel(*(place + 0.5))
        for number, agent in enumerate(here):
            across, down = number % columns - (columns - 1) / 2, number // columns - (rows - 1) / 2
            _agent(canvas, x + across * pitch, y + down * pitch, pitch * 0.47, agent)

    _header(panel, env, index, "Capture Target", f"agents: {env.n_agents}, torus: {env.grid} x {env.grid}")
    count, arrived = panel.at(0, HEADER), int((position == target).all(1).sum())
    _cross(count, 8, 6, 7)
    count.text(24, 6, "on the target", fill=MUTED)
    count.text(PANEL, 6, f"{arrived} / {env.n_agents}", anchor="r")
    _bar(count, 0, 18, PANEL, 6, arrived / env.n_agents, ALARM)
    notes = []
    for sees, (goal_x, goal_y) in zip(env.visible[index], env.goal[index], strict=True):
        goal = f", heads for {goal_x}, {goal_y}" if goal_x >= 0 else ""
        notes.append(("sees the target" if sees else "target hidden") + goal)
    _agents(count.at(0, 36), env, index, range(env.n_agents), notes)
    return canvas.pixels()
