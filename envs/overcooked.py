"""Overcooked with macro-actions: three cooks fetch, chop and plate three vegetables and deliver the salad."""

from functools import lru_cache
from heapq import heappop, heappush
from typing import NamedTuple

import numpy as np

from envs import checks
from envs.core import MacroVectorEnv

# Things have numbers, and those of one kind follow each other. A kind has the number of its first thing: things 3 and 4
# are of the kind PLATE, 3.
TOMATO, LETTUCE, ONION = range(3)
PLATE = 3  # and 4
BOARD = 5  # and 6
DELIVERY = 7
COOK = 8  # to 10
THINGS = 11
KIND_OF_THING = np.array([TOMATO, LETTUCE, ONION, PLATE, PLATE, BOARD, BOARD, DELIVERY, COOK, COOK, COOK])
THING_NAMES = ["tomato", "lettuce", "onion", "plate 0", "plate 1", "board 0", "board 1", "delivery counter"]
NOTHING = -1  # what is in an empty hand or on an empty board

# Two more kinds of cells, which are no things.
COUNTER, FLOOR = 11, 12

# Things of one kind are numbered row by row.
SYMBOLS = {
    "t": TOMATO,
    "l": LETTUCE,
    "o": ONION,
    "p": PLATE,
    "b": BOARD,
    "d": DELIVERY,
    "c": COOK,
    "#": COUNTER,
    ".": FLOOR,
}
LAYOUTS = {
    "a": [
        "#####t#",
        "b.c.c.l",
        "b.....o",
        "d.....#",
        "#.....#",
        "#.c...p",
        "#####p#",
    ],
    "b": [
        "#####t#",
        "b.c#c.l",
        "b..#..o",
        "d..#..#",
        "#..#..#",
        "#.c#..p",
        "#####p#",
    ],
    "c": [
        "#####t#",
        "b.c#c.l",
        "b..#..o",
        "d..#..#",
        "#..#..#",
        "#.c...p",
        "#####p#",
    ],
}

# Cells are numbered row by row.
SIDE = 7
ROW, COLUMN = np.divmod(np.arange(SIDE * SIDE), SIDE)
ROWS_APART = np.abs(ROW[:, None] - ROW)  # [cells, cells]
COLUMNS_APART = np.abs(COLUMN[:, None] - COLUMN)
DISTANCE = ROWS_APART + COLUMNS_APART
IN_VIEW = (ROWS_APART <= 2) & (COLUMNS_APART <= 2)  # whether a cook in one cell sees the other cell

# Moves, and what each of them adds to the number of a cook's cell.
RIGHT, DOWN, LEFT, UP, WAIT = range(5)
STEP = np.array([1, SIDE, -1, -SIDE, 0])

# Macro-action k + 1 leads to thing k: to a vegetable, a plate, a board or the delivery counter.
MACRO_ACTION_NAMES = [
    "Stay",
    "Get-Tomato",
    "Get-Lettuce",
    "Get-Onion",
    "Get-Plate(0)",
    "Get-Plate(1)",
    "Go-to-Board(0)",
    "Go-to-Board(1)",
    "Deliver",
    "Chop",
]
STAY = 0
GET_FOOD = 1  # to 3
GET_PLATE = 4  # and 5
GO_TO_BOARD = 6  # and 7
DELIVER = 8
CHOP = 9
GO_TO_COUNTER = 10  # only in layouts with counters in the middle
SINGLE_STEPS = ["Right", "Down", "Left", "Up"]  # the last macro-actions, in the order of the moves

COOKS = 3
FOODS = 3
STRIKES = 3  # that a vegetable needs, and moves of a Chop
DISHES = 7  # of the published code; the last of them is asked for


class Node(NamedTuple):
    """A cell that the search for a way has reached."""

    length: int  # steps to here plus the distance from here to the target
    meets_cook: bool  # whether a cook is here
    steps: int  # from the start to here
    cell: int
    first: int  # the first move of the way to here

    def __lt__(self, other):
        """Whether a heap may give this node out before the other one. It compares `length`, then `meets_cook`.

        Of two nodes that are equal in both, each is "less" than the other. The published code compares in the same way,
        so `heapq` breaks ties as it does there.
        """
        return self[:2] <= other[:2]


@lru_cache(maxsize=100_000)
def first_move(cell, target, kinds):
    """The first move of the way that an A* search finds, WAIT if there is none.

    Args:
        cell: of the cook, an int.
        target: the cell that it wants to reach. A way there ends beside it if it cannot be entered.
        kinds: for each cell its kind, as bytes. FLOOR and COOK can be entered.
    """
    target_distance = DISTANCE[target].tolist()
    reached = {cell}
    heap = [Node(target_distance[cell], False, 0, cell, WAIT)]
    while heap:
        node = heappop(heap)
        for move in (RIGHT, LEFT, DOWN, UP):
            neighbour = node.cell + int(STEP[move])
            first = move if node.cell == cell else node.first
            if neighbour in reached:
                continue
            if neighbour == target:
                return first
            if kinds[neighbour] in (FLOOR, COOK):
                reached.add(neighbour)
                steps = node.steps + 1
                length = steps + target_distance[neighbour]
                heappush(heap, Node(length, kinds[neighbour] == COOK, steps, neighbour, first))
    return WAIT


class Overcooked(MacroVectorEnv):
    """Three cooks prepare a salad of a tomato, a lettuce and an onion (`overcooked-a`, `overcooked-b`, `overcooked-c`).

    ## Description
    The kitchen has 7 x 7 cells, (row, column) from the upper left one: floor, and counters around it. `LAYOUTS` shows
    where everything is at the start. In layout "b" the counters of column 3 divide the kitchen. In "c" they leave a
    passage in row 5, and "a" does not have them. A vegetable is chopped when a cook has struck it three times on a
    board. The right dish is a plate with all three vegetables, chopped.

    A cook sees what is within two rows and two columns of its own cell. It goes to where it saw a thing last: each cook
    remembers the place of each thing, at first that of the start. If it sees the remembered place and the thing is not
    there, it believes from then on that the thing is at its place of the start, even if it sees that the thing is not
    there either.

    Each step, in this order:

    1. The macro-actions give each cook a move: right, down, left, up or none.
    2. Cooks 0, 1 and 2 do their moves, one after the other. What a move does depends on the cell to which it leads:
        - Floor: the cook goes there with what it holds.
        - Another cook: if that one has not moved yet and its move leads to this cook's cell, they swap. If it has not
          moved yet and its move leads elsewhere, this cook waits, and moves when the others have. If it has moved, this
          cook stays where it is.
        - A vegetable or a plate on a counter: a cook that holds nothing takes it, with what is on it. If one of the two
          things is a plate and the other one a chopped vegetable, the vegetable goes on the plate: on the counter if
          the cook holds the vegetable, in its hand if it holds the plate.
        - A board: a cook that holds nothing strikes an unchopped vegetable once, and takes anything else. A cook that
          holds something puts it on an empty board. If the cook holds a plate and a chopped vegetable is on the board,
          or the other way round, the vegetable goes on the plate, and the cook holds the plate then.
        - The delivery counter: a cook delivers what it holds. If this is not the right dish, the thing and what is on
          it are at their places of the start again, unchopped. Chopping them pays again.
        - Any other counter: a cook puts down what it holds.
        - In all other cases nothing happens.
    3. Each cook looks around.

    ## Macro-actions
    A cook finds its way by an A* search in the kitchen as it remembers it. Cooks are not in the way. Other things that
    it believes to be on the floor are. `first_move` says which of several ways it takes.

    - 0 Stay: no move. It lasts one step.
    - 1, 2, 3 Get-Tomato, Get-Lettuce, Get-Onion, 4, 5 Get-Plate(0, 1), 6, 7 Go-to-Board(0, 1), 8 Deliver: the cook
      walks to the cell beside its target, which is the remembered place of the vegetable, plate, board or delivery
      counter. The next move leads into the target, and the macro-action ends with it.
        - There is no such last move, and the macro-action ends without it, in four cases: Get-Plate and the cook holds
          an unchopped vegetable; Go-to-Board and it holds nothing; Get-(a vegetable) and an unchopped vegetable is on
          the board that is its target; Get-... and the thing is not where the cook remembers it.
        - If the cook holds a chopped vegetable, Get-Plate does not end with this move, which puts the vegetable on the
          plate. The next one takes the plate. Nor does it end here if there is no such move because the plate is not
          where the cook remembers it.
        - It ends without a move if there is no way. If the cook has the target in view, it also ends without a move in
          two cases: the cook believes that a cook, possibly itself, is in the target's cell; a plate is in the target's
          cell and the macro-action is Get-(a vegetable).
        - After all moves of a step it ends if the thing of Get-... is not where the cook remembers it, even if the cook
          cannot know this. If the cook is beside its target then, Get-(a vegetable) also ends if an unchopped vegetable
          is on the board that is its target, and Go-to-Board and Deliver also end if the cook holds nothing.
        - A cook makes room for a cook that it believes to be beside board 1: it moves right instead of towards its
          target. It does so beside board 0 with Deliver, and beside the delivery counter with board 0 as its target.
    - 9 Chop: the cook moves towards the board beside it, and strikes what is there. It ends without a move if there is
      no unchopped vegetable on a board beside it. It ends with the third move. If a Chop ends earlier, the cook's next
      Chop goes on with its count of moves. A cook that holds something cannot strike, but its moves count, too.
    - 10 Go-to-Counter, in "b" and "c" only: the cook goes to the counter of column 3 that it believes to be empty, of
      several the nearest to row 3. It ends with the move that leads into the counter, or without a move if there is no
      such counter. It goes on without a move while there is no way.
    - The last four, Right, Down, Left and Up: one step, if the cook believes that there is floor.

    These are the rules of the published code with all its quirks.

    ## Macro-observations
    32 numbers. All those of a thing that the cook does not see are 0; what it remembers serves its macro-actions only.

    - 0 to 8: row / 7, column / 7, strikes / 3 of tomato, lettuce and onion
    - 9 to 24: row / 7, column / 7 of the two plates, the two boards, the delivery counter and the three cooks
    - 25 to 31: the dish, one-hot. It is always the last one of the seven dishes of the published code.

    ## Rewards
    The reward of a step is the sum of these. By default `step_cost` and `wrong_delivery` are negative.

    - `step_cost` every step
    - `chop_reward` for each vegetable that gets its third strike
    - `delivery_reward` for the right dish, `wrong_delivery` for anything else that is delivered

    ## Episode end
    The episode is terminated when the right dish is delivered, which is a `success`. It is truncated after `horizon`
    steps.

    ## State
    53 + 3 A numbers; A is the number of macro-actions, 14 in "a" and 15 in "b" and "c". What the cooks remember is not
    among them.

    - 0 to 15: row / 7, column / 7 of tomato, lettuce, onion, plates and cooks
    - 16 to 18: strikes / 3 of each vegetable
    - 19 to 33: what each cook holds, one-hot (tomato, lettuce, onion, plates), zeros for nothing
    - 34 to 43: what is on each board, one-hot as above
    - 44 to 49: on which plate each vegetable is, one-hot, zeros for none
    - 50 to 52: each cook's count of moves of Chop / 3
    - from 53 on: the macro-action that each cook is running, one-hot, zeros when it is free

    ## Arguments
    - num_envs: the number of environments N, at least 1
    - layout: a key of `LAYOUTS`
    - horizon: steps until truncation, at least 1
    - chop_reward, delivery_reward, wrong_delivery, step_cost: as above
    - render_mode: None or "rgb_array"

    A bad argument raises a ValueError.

    ## Simulator arrays
    Cells are numbered row by row. The numbers of things are 0 to 2 tomato, lettuce and onion, 3 and 4 plates, 5 and 6
    boards, 7 the delivery counter, 8 to 10 cooks.

    - cell int64 [N, 11]: the cell of each thing. A thing in a cook's cell is in its hand, and a vegetable in a plate's
      cell is on the plate. No other things share a cell, because no macro-action puts a thing on a counter on which
      another one was at the start.
    - memory int64 [N, 3, 11]: the cell in which each cook believes each thing
    - strikes int64 [N, 3] that each vegetable has got, 0 to 3
    - chop_moves int64 [N, 3]: each cook's count of moves of Chop, 0 to 2

    ## Source
    Y. Xiao, W. Tan, C. Amato, "Asynchronous Actor-Critic for Multi-Agent Reinforcement Learning", NeurIPS 2022. The
    published code is the repository WeihaoTan/gym-macro-overcooked; this is its 7 x 7 kitchen with three agents that
    see two cells far and are asked for the salad of all three vegetables.
    """

    primitive = False  # there is no version with primitive actions
    sim_arrays = ("cell", "memory", "strikes", "chop_moves")

    def __init__(
        self,
        num_envs=1,
        layout="a",
        *,
        horizon=200,
        chop_reward=10.0,
        delivery_reward=200.0,
        wrong_delivery=-5.0,
        step_cost=-0.1,
        render_mode=None,
    ):
        if layout not in list(LAYOUTS):  # a list: an argument without a hash would make a dict raise TypeError
            raise ValueError(f"unknown layout {layout!r}; valid layouts: {' '.join(LAYOUTS)}")
        self.layout = layout
        self.chop_reward = checks.numbers("chop_reward", chop_reward)
        self.delivery_reward = checks.numbers("delivery_reward", delivery_reward)
        self.wrong_delivery = checks.numbers("wrong_delivery", wrong_delivery)
        self.step_cost = checks.numbers("step_cost", step_cost)
        self._read_layout(layout)
        names = MACRO_ACTION_NAMES.copy()
        if self.middle_counters.size > 0:
            names.append("Go-to-Counter")
        self.first_single_step = len(names)
        names += SINGLE_STEPS
        super().__init__(
            num_envs=num_envs,
            macro_action_names=[names] * COOKS,
            obs_low=np.zeros((COOKS, 32)),
            obs_high=np.ones((COOKS, 32)),
            obs_sizes=[32] * COOKS,
            state_size=53 + COOKS * len(names),
            horizon=horizon,
            render_mode=render_mode,
        )
        self.cell = np.zeros((self.num_envs, THINGS), np.int64)
        self.memory = np.zeros((self.num_envs, COOKS, THINGS), np.int64)
        self.strikes = np.zeros((self.num_envs, FOODS), np.int64)
        self.chop_moves = np.zeros((self.num_envs, COOKS), np.int64)
        self._reset(np.ones(self.num_envs, bool))  # valid arrays even before the first reset

    def _read_layout(self, layout):
        """Sets where everything is at the start, and the counters of column 3, the nearest to row 3 first."""
        symbols = "".join(LAYOUTS[layout])
        kinds = np.array([SYMBOLS[symbol] for symbol in symbols])  # [cells]
        cells_by_kind = np.argsort(kinds, kind="stable")  # "stable": row by row within a kind
        self.starts = cells_by_kind[:THINGS]  # the cell of each thing; counters and floor come after the things
        self.is_floor = (kinds == FLOOR) | (kinds == COOK)  # [cells]
        is_inside = (ROW > 0) & (ROW < SIDE - 1)
        counters = np.flatnonzero(~self.is_floor & is_inside & (COLUMN == 3))
        order = np.argsort(np.abs(ROW[counters] - 3), kind="stable")
        self.middle_counters = counters[order]

    def _reset(self, mask):
        self.cell[mask] = self.starts
        self.memory[mask] = self.starts
        self.strikes[mask] = 0
        self.chop_moves[mask] = 0

    def _advance(self):
        moves, ended = self._choose_moves()
        rewards = np.full(self.num_envs, self.step_cost)
        success = np.zeros(self.num_envs, bool)
        to_move = np.ones(moves.shape, bool)
        # A cook may have to wait until another one has moved. Three cooks on a grid cannot wait in a circle.
        while to_move.any():
            for cook in np.flatnonzero(to_move.any(axis=0)):
                reward, is_right = self._move(cook, moves, to_move)
                rewards += reward
                success |= is_right
        self._look_around()
        ended |= self._ends_after_moves()
        return rewards, success, ended, success  # success terminates the episode

    # ---- what the macro-actions do ------------------------------------------------------------------------------
    def _choose_moves(self):
        """Returns the move of each cook, int [N, cooks], and whether its macro-action ends with it, bool [N, cooks].

        The methods below enter the moves of their macro-actions and return where these end. `believed` is the kitchen
        as each cook remembers it, int [N, cooks, cells].
        """
        moves = np.full(self.macro_action.shape, WAIT)
        believed = self._believed_kitchen()
        ended = self.macro_action == STAY
        ended |= self._take_single_step(moves, believed)
        ended |= self._chop(moves)
        ended |= self._go(moves, believed)
        return moves, ended

    def _take_single_step(self, moves, believed):
        """Right, Down, Left and Up."""
        steps = self.macro_action >= self.first_single_step
        move = np.where(steps, self.macro_action - self.first_single_step, WAIT)
        front = self._cook_cells() + STEP[move]
        is_floor = _kind_at(believed, front) == FLOOR
        moves[steps] = np.where(is_floor, move, WAIT)[steps]
        return steps

    def _chop(self, moves):
        """Chop. The boards are at the left wall, so a cook that is beside a board has it on its left.

        A cook that holds something goes on, too: its move is counted here, though it will not be a strike.
        """
        chops = self.macro_action == CHOP
        left = self._cook_cells() + STEP[LEFT]
        goes_on = chops & self._is_raw_on_board(left)
        moves[goes_on] = LEFT
        self.chop_moves[goes_on] += 1
        is_last = self.chop_moves == STRIKES
        self.chop_moves[is_last] = 0
        return chops & (is_last | ~goes_on)

    def _go(self, moves, believed):
        """Get-..., Go-to-... and Deliver."""
        own = self._cook_cells()
        to_thing = (self.macro_action > STAY) & (self.macro_action <= DELIVER)
        has_counters = self.middle_counters.size > 0  # without them the number of Go-to-Counter is that of Right
        to_counter = (self.macro_action == GO_TO_COUNTER) & has_counters
        target = np.where(to_counter, self._free_counter(believed), self._remembered_target())

        # Who does not walk, and why. Where the target is NOTHING, `no_counter` is all that counts.
        no_counter = to_counter & (target == NOTHING)
        sees_target = IN_VIEW[own, target]
        plate_is_there = self._gets_food() & sees_target & self._is_plate_at(target)
        cook_is_there = to_thing & sees_target & (_kind_at(believed, target) == COOK)
        makes_room = to_thing & ~(plate_is_there | cook_is_there) & self._makes_room(target, believed)

        walks = (to_thing | to_counter) & ~(no_counter | plate_is_there | cook_is_there | makes_room)
        moves[makes_room] = RIGHT
        moves[walks] = _first_moves(own[walks], target[walks], believed[walks])
        cannot_go = to_thing & (moves == WAIT)  # a plate or a cook is there, or there is no way

        arrives = walks & (DISTANCE[own, target] == 1)  # the move leads into the target
        plates_food = arrives & self._gets_plate() & self._is_chopped(self._held())
        moves[arrives & self._skips_last_move(target)] = WAIT
        return cannot_go | no_counter | (arrives & ~plates_food)

    def _free_counter(self, believed):
        """The counter to which Go-to-Counter leads, NOTHING if there is none, int [N, cooks]."""
        counter = np.full(self.macro_action.shape, NOTHING)
        for cell in self.middle_counters[::-1]:  # the nearest one is the last, so that it wins
            counter[believed[:, :, cell] == COUNTER] = cell
        return counter

    def _makes_room(self, target, believed):
        """Whether a cook beside board 0 or the delivery counter steps aside for one that is beside board 1."""
        own = self._cook_cells()
        beside_board_0, beside_board_1 = self.starts[BOARD:DELIVERY] + STEP[RIGHT]
        beside_delivery = self.starts[DELIVERY] + STEP[RIGHT]
        meets = believed[:, :, beside_board_1] == COOK
        leaves_board = (own == beside_board_0) & (self.macro_action == DELIVER)
        comes_to_board = (own == beside_delivery) & (target == self.starts[BOARD])
        return meets & (leaves_board | comes_to_board)

    def _skips_last_move(self, target):
        """Whether a cook that is beside its target leaves out its last move, bool [N, cooks]."""
        plate_for_raw = self._gets_plate() & self._is_raw(self._held())
        board_for_nothing = self._goes_to_board() & (self._held() == NOTHING)
        to_be_chopped = self._gets_food() & self._is_raw_on_board(target)
        return plate_for_raw | board_for_nothing | to_be_chopped | self._is_wrong_about_target()

    def _ends_after_moves(self):
        """Whether a cook's macro-action ends because of where things are after the moves, bool [N, cooks]."""
        target = self._remembered_target()
        is_beside = DISTANCE[self._cook_cells(), target] == 1
        brings_something = self._goes_to_board() | (self.macro_action == DELIVER)
        has_nothing = is_beside & brings_something & (self._held() == NOTHING)
        to_be_chopped = is_beside & self._gets_food() & self._is_raw_on_board(target)
        return has_nothing | to_be_chopped | self._is_wrong_about_target()

    # ---- what the moves do; masks are bool [N] from here on ---------------------------------------------------------
    def _move(self, cook, moves, to_move):
        """Does a cook's move where the cook has not moved yet, unless it has to wait for another cook.

        Args:
            cook: 0, 1 or 2.
            moves: int [N, cooks].
            to_move: bool [N, cooks], who has not moved yet. The method changes it.

        Returns:
            rewards float64 [N] and is_right bool [N], whether the cook delivers the right dish.
        """
        acts = self._meet(cook, moves, to_move)
        own = self.cell[:, COOK + cook].copy()
        front = own + STEP[moves[:, cook]]  # its own cell if it has no move; "walking" there changes nothing
        things = self._thing_in(np.column_stack([own, front]))  # [N, 2]: what it holds, and what is in front
        held, thing = things.T
        held_is_chopped, thing_is_chopped = self._is_chopped(things).T
        _, thing_is_raw = self._is_raw(things).T
        to_floor = self.is_floor[front]
        to_board = self._is_board(front)
        to_delivery = front == self.starts[DELIVERY]

        walks = acts & to_floor
        works = acts & ~to_floor  # at a counter
        chops = works & (held == NOTHING) & to_board & thing_is_raw
        takes = works & (held == NOTHING) & (thing != NOTHING) & ~chops
        puts_down = works & (held != NOTHING) & (thing == NOTHING) & ~to_delivery
        fills_held_plate = works & _is_plate(held) & thing_is_chopped
        fills_other_plate = works & held_is_chopped & _is_plate(thing)
        delivers = works & (held != NOTHING) & to_delivery
        has_all_foods = (self.cell[:, :PLATE] == own[:, None]).all(axis=1)
        has_whole_dish = _is_plate(held) & has_all_foods  # what is on a plate is chopped
        is_right = delivers & has_whole_dish
        is_wrong = delivers & ~has_whole_dish

        self._bring(takes | fills_held_plate | (fills_other_plate & to_board), front, own)
        self._bring(walks | puts_down | is_right | (fills_other_plate & ~to_board), own, front)
        self.cell[walks, COOK + cook] = front[walks]
        self._return_to_start(is_wrong, own)
        self.strikes[chops, thing[chops]] += 1
        _, thing_is_chopped_now = self._is_chopped(things).T
        is_done = chops & thing_is_chopped_now

        rewards = np.where(is_done, self.chop_reward, 0.0)
        rewards += np.where(is_right, self.delivery_reward, 0.0)
        rewards += np.where(is_wrong, self.wrong_delivery, 0.0)
        return rewards, is_right

    def _meet(self, cook, moves, to_move):
        """Swaps two cooks whose moves lead to each other's cells, and lets a cook wait for another one.

        The arguments are those of `_move`. Returns bool [N]: whether the cook still has to do its move now, because it
        had not moved yet and its move does not lead to another cook.
        """
        acts = to_move[:, cook].copy()
        to_move[:, cook] = False
        own = self.cell[:, COOK + cook].copy()
        front = own + STEP[moves[:, cook]]
        for other in range(COOKS):
            if other == cook:
                continue
            others_cell = self.cell[:, COOK + other].copy()
            others_front = others_cell + STEP[moves[:, other]]
            meets = acts & (front == others_cell)
            swaps = meets & to_move[:, other] & (others_front == own)
            waits = meets & to_move[:, other] & ~swaps
            goes = swaps[:, None] & (self.cell == own[:, None])  # the cook and what it holds
            comes = swaps[:, None] & (self.cell == others_cell[:, None])
            self.cell = np.where(goes, others_cell[:, None], self.cell)
            self.cell = np.where(comes, own[:, None], self.cell)
            to_move[swaps, other] = False
            to_move[waits, cook] = True
            acts = acts & ~meets
        return acts

    def _bring(self, mask, source, goal):
        """All vegetables and plates in the cell `source`, int [N], go to the cell `goal`, int [N]."""
        comes = mask[:, None] & (self.cell[:, :BOARD] == source[:, None])
        self.cell[:, :BOARD] = np.where(comes, goal[:, None], self.cell[:, :BOARD])

    def _return_to_start(self, mask, source):
        """All vegetables and plates in the cell `source`, int [N], go to their places of the start, unchopped."""
        returns = mask[:, None] & (self.cell[:, :BOARD] == source[:, None])
        self.cell[:, :BOARD] = np.where(returns, self.starts[:BOARD], self.cell[:, :BOARD])
        self.strikes[returns[:, :PLATE]] = 0

    # ---- what the cooks see and remember ------------------------------------------------------------------------
    def _sees(self):
        """Which things each cook sees, bool [N, cooks, things]."""
        return IN_VIEW[self._cook_cells()[:, :, None], self.cell[:, None]]

    def _look_around(self):
        """Sets each cook's memory after the moves."""
        sees = self._sees()
        sees_its_place = IN_VIEW[self._cook_cells()[:, :, None], self.memory]  # the place that it remembers
        unless_seen = np.where(sees_its_place, self.starts, self.memory)
        self.memory = np.where(sees, self.cell[:, None], unless_seen)

    def _believed_kitchen(self):
        """The kind of each cell as each cook remembers it, int [N, cooks, cells]."""
        believed = np.tile(np.where(self.is_floor, FLOOR, COUNTER), (self.num_envs, COOKS, 1))
        for thing in range(THINGS):  # if several are in a cell, the last one counts
            np.put_along_axis(believed, self.memory[:, :, thing, None], KIND_OF_THING[thing], axis=2)
        return believed

    def _remembered_target(self):
        """Where each cook remembers the thing to which its macro-action leads; without such a thing any cell."""
        thing = np.clip(self.macro_action - 1, TOMATO, DELIVERY)
        return np.take_along_axis(self.memory, thing[:, :, None], axis=2)[:, :, 0]

    def _is_wrong_about_target(self):
        """Whether the vegetable or plate that a cook gets is not where the cook remembers it."""
        thing = np.clip(self.macro_action - 1, TOMATO, DELIVERY)
        cell = np.take_along_axis(self.cell, thing, axis=1)
        gets_something = self._gets_food() | self._gets_plate()
        return gets_something & (cell != self._remembered_target())

    # ---- small helpers; they take and return [N, cooks], or [N, k] for any k cells or things ----------------------
    def _cook_cells(self):
        return self.cell[:, COOK:]

    def _gets_food(self):
        return (self.macro_action >= GET_FOOD) & (self.macro_action < GET_PLATE)

    def _gets_plate(self):
        return (self.macro_action >= GET_PLATE) & (self.macro_action < GO_TO_BOARD)

    def _goes_to_board(self):
        return (self.macro_action >= GO_TO_BOARD) & (self.macro_action < DELIVER)

    def _is_board(self, cell):
        return (cell == self.starts[BOARD]) | (cell == self.starts[BOARD + 1])

    def _is_plate_at(self, cell):
        return (self.cell[:, None, PLATE:BOARD] == cell[:, :, None]).any(axis=2)

    def _thing_in(self, cell):
        """What is in a cell: NOTHING, a vegetable, or a plate; of a plate and what is on it, the plate."""
        is_there = self.cell[:, None, :BOARD] == cell[:, :, None]  # [N, k, vegetables and plates]
        return np.where(is_there, np.arange(BOARD), NOTHING).max(axis=2)

    def _held(self):
        return self._thing_in(self._cook_cells())

    def _is_raw_on_board(self, cell):
        """Whether there is a board in a cell and an unchopped vegetable on it."""
        return self._is_board(cell) & self._is_raw(self._thing_in(cell))

    def _strikes_of(self, thing):
        """How many strikes a thing has got, -1 if it is no vegetable."""
        is_food = (thing != NOTHING) & (thing < PLATE)
        strikes = np.take_along_axis(self.strikes, np.where(is_food, thing, TOMATO), axis=1)
        return np.where(is_food, strikes, -1)

    def _is_raw(self, thing):
        """Whether a thing is a vegetable that is not chopped."""
        strikes = self._strikes_of(thing)
        return (strikes >= 0) & (strikes < STRIKES)

    def _is_chopped(self, thing):
        """Whether a thing is a chopped vegetable."""
        return self._strikes_of(thing) == STRIKES

    # ---- observations, the state and the picture ----------------------------------------------------------------
    def _observe(self, start):
        sees = self._sees()
        places = np.stack([ROW[self.cell], COLUMN[self.cell]], axis=2) / SIDE  # [N, things, 2]
        strikes = self.strikes[:, :, None] / STRIKES
        foods = np.concatenate([places[:, :PLATE], strikes], axis=2)  # [N, 3, 3]
        foods_seen = sees[:, :, :PLATE, None] * foods[:, None]
        others_seen = sees[:, :, PLATE:, None] * places[:, None, PLATE:]
        dish = np.zeros((self.num_envs, COOKS, DISHES))
        dish[:, :, -1] = 1.0
        parts = [foods_seen, others_seen, dish]
        flat = [part.reshape(self.num_envs, COOKS, -1) for part in parts]
        return np.concatenate(flat, axis=2, dtype=np.float32)

    def _state(self):
        movable = np.delete(self.cell, np.arange(BOARD, COOK), axis=1)
        places = np.stack([ROW[movable], COLUMN[movable]], axis=2) / SIDE
        held = self._held()[:, :, None] == np.arange(BOARD)
        on_board = self._thing_in(self.cell[:, BOARD:DELIVERY])[:, :, None] == np.arange(BOARD)
        on_plate = self.cell[:, :PLATE, None] == self.cell[:, None, PLATE:BOARD]
        runs = self.macro_action[:, :, None] == np.arange(self.n_actions[0])
        running = runs & ~self.macro_done[:, :, None]
        parts = [places, self.strikes / STRIKES, held, on_board, on_plate, self.chop_moves / STRIKES, running]
        flat = [part.reshape(self.num_envs, -1) for part in parts]
        return np.concatenate(flat, axis=1, dtype=np.float32)

    def _draw(self, index):
        from envs.rendering import draw_overcooked

        return draw_overcooked(self, index)


def _kind_at(kitchen, cell):
    """The kind of a cell for each cook, int [N, cooks]. kitchen: int [N, cooks, cells], cell: int [N, cooks]."""
    return np.take_along_axis(kitchen, cell[:, :, None], axis=2)[:, :, 0]


def _is_plate(thing):
    return (thing == PLATE) | (thing == PLATE + 1)


def _first_moves(own, target, believed):
    """`first_move` for M cooks at once, int [M]. own and target: cells, int [M]. believed: kinds, int [M, cells].

    Which thing is in the way does not matter, so each becomes COUNTER. Then more searches are equal and made only once.
    """
    is_way = (believed == FLOOR) | (believed == COOK)
    kinds = np.where(is_way, believed, COUNTER)
    searches = np.column_stack([own, target, kinds]).astype(np.uint8)
    distinct, which = np.unique(searches, axis=0, return_inverse=True)
    moves = [first_move(int(row[0]), int(row[1]), row[2:].tobytes()) for row in distinct]
    return np.array(moves, np.int64)[which.reshape(-1)]  # NumPy 2.0 gives it a second axis
