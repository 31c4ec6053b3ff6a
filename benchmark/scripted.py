"""What a learner is compared with: the random policy (the floor) and a policy written by hand (the ceiling).

    python benchmark/scripted.py                                   a table, all tasks
    python benchmark/scripted.py -o benchmark/references.json      and the file that benchmark/report.py reads

The scripts see the whole simulator. Those of Box Pushing and Warehouse are optimal for the undiscounted return:

- Box Pushing: both robots walk to the big box at once and push it, the shortest way, so on a g x g grid the return is
  100 - 0.1 (1.5 g - 4).
- Warehouse: no episode that delivers every tool ends earlier than with these `LOADS`, found by search. wtd-s: the human
  begins the third phase in step 40, so the last tool is given in step 41 at the earliest: 300 - 41 = 259. The others:
  the arm needs 10 steps a tool and a robot 7 more to the nearest human, so the last of 6 or 9 tools arrives in step 67
  or 97 at the earliest: 600 - 67 = 533, 900 - 97 = 803.
- Capture Target: always Move-to-T (with primitive actions: towards the target) is not optimal, only simple.
- Overcooked: each cook has a part of the work, and idle ones walk about at random, so that nobody is in the way for
  long. It is not optimal: a wrong delivery, after which chopping pays again, is worth more than it costs.

A policy is a function of (env, rng) that gives the macro-actions, int [N, n], of N environments with n agents; those of
agents that are not free do not matter.
"""

import argparse
import json
import os
import sys
from functools import partial
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1]))  # run as a script, Python looks in this folder only

import envs
from envs import overcooked as kitchen
from envs.box_pushing import NORTH, PUSH, STAY, WAYPOINT_BIG_LEFT, WAYPOINT_BIG_RIGHT

# As in the algorithm scripts, so that discounted returns can be put side by side
GAMMA = {"bp": 0.95, "wtd": 0.95, "ct": 0.9, "overcooked": 0.95}

# In the order in which the arm hands them out: a robot, and the humans to whom it goes. A human gets its tools in
# the order in which it needs them. Three robots can always take one tool at a time, in turn.
LOADS = {
    "s": [(1, [0]), (0, [0]), (1, [0])],
    "d": [(0, [0]), (1, [1]), (0, [0]), (1, [1]), (0, [0]), (1, [1])],
    "t": [(0, [0]), (1, [1]), (0, [2]), (1, [0, 2]), (0, [1]), (1, [2, 1]), (0, [0])],
    "t1": [(1, [2]), (2, [1]), (0, [0]), (1, [2]), (2, [0]), (0, [1]), (1, [2]), (2, [1]), (0, [0])],
}


def random_policy(env, rng):
    return rng.integers(env.n_actions, size=(env.num_envs, env.n_agents))


def push_big_box(env, rng):
    """Box Pushing: walk to the cells below the big box, wait for the other robot, push together."""
    waypoint = np.array([WAYPOINT_BIG_LEFT, WAYPOINT_BIG_RIGHT])
    if not env.primitive:
        placed = env.last_waypoint == waypoint  # [N, agents]
        return np.where(placed.all(1, keepdims=True), PUSH, np.where(placed, STAY, waypoint))
    forward, left, right, stay = range(4)
    dx = env.cell_x[waypoint] - env.position[..., 0]  # first along the row, then up
    dy = env.box_y[:, 2:] - 1 - env.position[..., 1]
    heading = np.where(dx > 0, 1, np.where(dx < 0, 3, np.where(dy < 0, 2, NORTH)))
    turn = (heading - env.orientation) & 3
    placed = (dx == 0) & (dy == 0) & (turn == 0)
    waits = placed & ~placed.all(1, keepdims=True)
    return np.where(waits, stay, np.choose(turn, [forward, right, right, left]))


def deliver(env, rng, loads):
    """Warehouse: the arm hands out the tools of `loads`, [(robot, [human, ...]), ...], in this order.

    The arm passes the oldest staged tool as soon as its robot waits at the table, else searches the next one if there
    is room. A robot waits until its load is complete, delivers it in order and comes back.
    """
    get_tool = env.n_humans + 1
    capacity = env.staging_capacity
    robot = np.array([robot for robot, humans in loads for _ in humans])  # [tools], of each tool in the arm's order
    human = np.array([human for _, humans in loads for human in humans])
    completes = np.concatenate([np.arange(len(humans)) == len(humans) - 1 for _, humans in loads])
    tool = np.array([(human[:k] == human[k]).sum() for k in range(len(human))])

    found = env.found.sum(1)  # [N]
    staged = (env.staged >= 0).sum(1)  # [N]
    handed = np.arange(len(tool)) < (found - staged)[:, None]  # [N, tools]
    received = env.phase + env.has_next_tool  # [N, humans]
    to_deliver = handed & (tool >= received[:, human])
    actions = np.zeros(env.macro_done.shape, np.int64)
    for r in range(env.n_robots):
        latest = len(tool) - 1 - (handed & (robot == r))[:, ::-1].argmax(1)  # any, if none was handed to it
        mine = to_deliver & (robot == r)
        actions[:, r] = np.where(mine.any(1) & completes[latest], human[mine.argmax(1)], get_tool)

    move = np.where(env.macro_done, actions, env.macro_action)[:, :-1]
    waits = (move == get_tool) & (env.position == env.tables).all(-1)  # [N, robots]
    receiver = robot.take(found - staged, mode="clip")
    passes = (staged > 0) & np.take_along_axis(waits, receiver[:, None], 1)[:, 0]
    searches = (found < len(tool)) & (staged < capacity)
    task = np.where(searches, 1 + env.n_robots + tool.take(found, mode="clip"), 0)
    actions[:, -1] = np.where(passes, 1 + receiver, task)
    return actions


def go_to_target(env, rng):
    """Capture Target: Move-to-T or, primitive, a step along the axis on which the target is further away."""
    if not env.primitive:
        return np.zeros(env.macro_done.shape, np.int64)
    north, south, west, east, stay = range(5)
    half = env.grid // 2
    to_go = (env.target[:, None] - env.position + half) % env.grid - half  # [N, agents, (x, y)], the short way round
    dx, dy = to_go[..., 0], to_go[..., 1]
    along_y = np.where(dy > 0, north, np.where(dy < 0, south, stay))
    return np.where(np.abs(dx) > np.abs(dy), np.where(dx > 0, east, west), along_y)


def cook_salad(env, rng):
    """Overcooked: cooks 0 and 2 chop at boards 0 and 1, and one cook collects what is chopped on plate 0.

    In layout "a" cook 1 collects. In the others cook 0 does, and cook 1 puts everything on the counters in the middle.
    """
    has_counters = env.middle_counters.size > 0
    collector = 0 if has_counters else 1
    is_near = kitchen.COLUMN[env.cell] <= 3 if has_counters else np.ones(env.cell.shape, bool)  # [N, things]
    actions = env.first_single_step + rng.integers(4, size=env.macro_done.shape)  # of cooks that have nothing to do
    chop(env, actions[:, 0], 0, 0, [kitchen.TOMATO], is_near)
    chop(env, actions[:, 2], 2, 1, [kitchen.LETTUCE, kitchen.ONION], is_near)
    collect(env, actions[:, collector], collector, is_near)
    if has_counters:
        hand_over(env, actions[:, 1])
    return actions


def chop(env, actions, cook, board, foods, is_near):
    """Gets one of the foods after the other, puts it on the board and chops it. Enters its macro-actions, [N]."""
    chopped = env.strikes == kitchen.STRIKES
    food = np.where(chopped[:, foods[0]], foods[-1], foods[0])  # [N]
    is_raw = ~np.take_along_axis(chopped, food[:, None], 1)[:, 0]
    food_cell = np.take_along_axis(env.cell, food[:, None], 1)[:, 0]
    is_here = np.take_along_axis(is_near, food[:, None], 1)[:, 0]
    cook_cell, board_cell = env.cell[:, kitchen.COOK + cook], env.starts[kitchen.BOARD + board]
    has_nothing = env._held()[:, cook] == kitchen.NOTHING
    is_beside = cook_cell == board_cell + kitchen.STEP[kitchen.RIGHT]
    board_is_full = (env.cell[:, : kitchen.BOARD] == board_cell).any(1)
    for mask, action in (
        (is_raw & is_here & has_nothing, 1 + food),
        (is_raw & (food_cell == cook_cell), np.where(board_is_full, kitchen.STAY, kitchen.GO_TO_BOARD + board)),
        (is_raw & (food_cell == board_cell) & is_beside, kitchen.CHOP),
    ):
        np.copyto(actions, action, where=mask)


def collect(env, actions, cook, is_near):
    """Gets plate 0, goes to boards with a chopped vegetable and delivers the salad. Enters its macro-actions, [N]."""
    held = env._held()[:, cook]
    has_plate, has_nothing = held == kitchen.PLATE, held == kitchen.NOTHING
    on_boards = env._thing_in(env.cell[:, kitchen.BOARD : kitchen.DELIVERY])  # [N, boards]
    to_collect = env._is_chopped(on_boards)
    is_whole = (env.cell[:, : kitchen.PLATE] == env.cell[:, kitchen.PLATE, None]).all(1)
    is_idle = actions >= env.first_single_step
    for mask, action in (
        (has_nothing & is_idle & is_near[:, kitchen.PLATE], kitchen.GET_PLATE),
        (has_plate & to_collect.any(1), kitchen.GO_TO_BOARD + to_collect.argmax(1)),
        (has_plate & is_whole, kitchen.DELIVER),
    ):
        np.copyto(actions, action, where=mask)


def hand_over(env, actions):
    """Cook 1 puts the vegetables and plate 0 on the counters in the middle. Enters its macro-actions, [N]."""
    things = np.array([kitchen.TOMATO, kitchen.LETTUCE, kitchen.PLATE, kitchen.ONION])
    is_waiting = env.cell[:, things] == env.starts[things]  # at its place of the start
    has_something = env._held()[:, 1] != kitchen.NOTHING
    np.copyto(actions, 1 + things[is_waiting.argmax(1)], where=is_waiting.any(1))
    np.copyto(actions, kitchen.GO_TO_COUNTER, where=has_something)


def script_of(env_id):
    """(name, policy, whether it is optimal) of the script for a task."""
    if env_id.startswith("bp"):
        return "both push the big box", push_big_box, True
    if env_id.startswith("wtd"):
        return "fixed loads", partial(deliver, loads=LOADS[env_id.split("-")[1]]), True
    if env_id.startswith("overcooked"):
        return "cooks with fixed parts", cook_salad, False
    name = "always towards the target" if env_id.endswith("primitive") else "always Move-to-T"
    return name, go_to_target, False


def play(env_id, policy, episodes, seed, gamma):
    """Plays episodes side by side: a dict of return, discounted_return, length and success, float64 [episodes] each."""
    env = envs.make(env_id, episodes)
    rng = np.random.default_rng(seed)
    env.reset(seed=seed)
    result = {key: np.zeros(episodes) for key in ("return", "discounted_return", "length", "success")}
    live = np.ones(episodes, bool)
    step = 0
    while live.any():
        _, rewards, terminations, truncations, infos = env.step(policy(env, rng))
        for key, value in zip(result, (rewards, gamma**step * rewards, 1, infos["success"]), strict=True):
            result[key] += live * value
        over = terminations | truncations
        step = step + 1
        live &= ~over
        if over.any():  # play on in ended environments without looking
            env.reset(options={"reset_mask": over})
    return result


def reference(env_id, policy, episodes, seed=0):
    """Means over episodes, with the standard error of the return; rounded, so that files can be compared."""
    result = play(env_id, policy, episodes, seed, GAMMA[env_id.split("-")[0]])
    means = {key: x.mean() for key, x in result.items()} | {"se": result["return"].std(ddof=1) / episodes**0.5}
    return {key: round(float(x), 6) for key, x in means.items()} | {"episodes": episodes}


def main(argv=None):
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.error = lambda message: sys.exit(f"scripted: {message}")
    parser.add_argument("--envs", nargs="+", default=envs.IDS, choices=envs.IDS, metavar="ID", help="tasks (all)")
    parser.add_argument("--episodes", type=int, default=2000, help="of each policy on each task (%(default)s)")
    parser.add_argument("-o", "--output", type=Path, help="JSON file to write, with the tasks that were played")
    args = parser.parse_args(argv)
    if not 2 <= args.episodes <= 100_000:
        sys.exit("scripted: --episodes must be from 2 to 100,000")
    if args.output and (args.output.is_dir() or not os.access(args.output.parent, os.W_OK)):
        sys.exit(f"scripted: cannot write {args.output}: it has to be a file in a folder that can be written")
    references = {}
    print(f"{'task':16} {'policy':26} return, its standard error, discounted return, length, success")
    for env_id in args.envs:
        name, script, optimal = script_of(env_id)
        scripted = {"name": name, "optimal": optimal, **reference(env_id, script, args.episodes)}
        references[env_id] = {"random": reference(env_id, random_policy, args.episodes), "scripted": scripted}
        for kind, x in references[env_id].items():
            numbers = " ".join(f"{x[key]:10.3f}" for key in ("return", "se", "discounted_return", "length", "success"))
            print(f"{env_id:16} {x.get('name', kind):26} {numbers}", flush=True)
    if args.output:
        new = Path(f"{args.output}.new")
        try:
            new.write_text(json.dumps(references, indent=1) + "\n")
            new.replace(args.output)
        except OSError as error:
            new.unlink(missing_ok=True)
            sys.exit(f"scripted: cannot write {args.output}: {error.strerror}")


if __name__ == "__main__":
    main()
