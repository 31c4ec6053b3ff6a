"""Does AVF-QPLEX break Mac-IGM while it learns, and does it cost anything? Counted on the rows that a run replays.

    python theory/violations.py --env bp-10 --seeds 41-45 --no-mask-ongoing      the literal mixer (Eq. 4)
    python theory/violations.py --env bp-10 --seeds 41-45                        as shipped: none but rounding

Every so many updates the online mixer's value of every joint macro-action that is available is compared with that of
the agents' own greedy choices (Eq. 7), at rows with a busy agent. Where the best is higher by more than a tolerance,
the choices differ. The difference is the value lost by acting on utilities. Returns are the run's last evaluation. A
seed is printed as soon as its run has ended, so stopping the program loses only the run that it is in.
"""

import argparse
import contextlib
import itertools
import math
import sys
import tempfile
from dataclasses import replace
from pathlib import Path
from unittest.mock import patch

import numpy as np
import pandas as pd
import torch
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))  # run as a script, Python looks in this folder only

import avf_qplex
import envs
from benchmark.sweep import seeds

TOLERANCE = 1e-4  # of the value, or of 1 where that is less
MOST_ROWS = 200  # of a batch
MOST_JOINT = 10_000  # macro-actions that are tried at a row


def value_lost(utilities, mixer, state, batch):
    """Compares the greedy choices with the best joint macro-action at valid rows of a batch, at most MOST_ROWS.

    utilities: float32 [B, T, n, A]. state: float32 [B, T, S], what the mixer sees.

    Returns:
        lost: float32 [R], the value that the greedy choices lose.
        tolerance: float32 [R], what is rounding.
        busy: bool [R], whether some agent is busy.
    """
    valid = torch.nonzero(batch["valid"])  # [rows, 2]
    every = math.ceil(len(valid) / MOST_ROWS)
    b, t = valid[::every].unbind(1)
    utilities = utilities[b, t]  # [R, n, A]
    available = batch["available"][b, t]  # [R, n, A]
    state = state[b, t]  # [R, S]
    busy = ~batch["free"][b, t].all(1)

    n_rows, n_agents, n_actions = utilities.shape
    everything = itertools.product(range(n_actions), repeat=n_agents)
    joint = torch.tensor(list(everything)).expand(n_rows, -1, -1)  # [R, J, n]
    is_open = available.gather(2, joint.mT).all(1)  # [R, J]
    greedy = utilities.masked_fill(~available, -torch.inf).argmax(2)  # [R, n]

    q_greedy = mixer(utilities, greedy, available, state)  # [R]
    inputs = []
    for x in (utilities, available, state):
        inputs.append(x[:, None].expand(-1, joint.shape[1], *x.shape[1:]))
    q = mixer(inputs[0], joint, inputs[1], inputs[2])  # [R, J]
    best = q.masked_fill(~is_open, -torch.inf).amax(1)
    return best - q_greedy, TOLERANCE * best.abs().clamp(min=1), busy


def tally(update, lost, tolerance, busy, reward_scale):
    """A line of `count` from what `value_lost` says of a batch.

    Returns:
        Dict of update; the number of rows; of those with a busy agent; of those of them at which the choices differ,
        and the sum of what is lost at the last, in units of unscaled rewards.
    """
    differ = busy & (lost > tolerance)
    return {
        "update": update,
        "rows": len(lost),
        "busy": int(busy.sum()),
        "differ": int(differ.sum()),
        "lost": float(lost[differ].sum()) / reward_scale,
    }


def count(args, every):
    """Trains from args and counts every so many updates.

    Returns:
        DataFrame with a line for each time.
        The return of the last evaluation.
    """
    lines = []
    updates = itertools.count()
    td_loss = avf_qplex.td_loss

    def counting(utilities, target_utilities, mixer, target_mixer, batch, *options):
        update = next(updates)
        if update % every == 0:
            state, _ = avf_qplex.mixer_states(batch, args.mixer_state)
            seen = utilities.detach()
            if args.ongoing == "zero":
                seen = torch.where(batch["free"][..., None], seen, 0.0)
            with torch.no_grad():
                lost, tolerance, busy = value_lost(seen, mixer, state, batch)
            lines.append(tally(update, lost, tolerance, busy, args.reward_scale))
        return td_loss(utilities, target_utilities, mixer, target_mixer, batch, *options)

    with tempfile.TemporaryDirectory() as runs, patch.object(avf_qplex, "td_loss", counting):
        with contextlib.redirect_stdout(sys.stderr):  # train prints the folder
            folder = avf_qplex.train(replace(args, runs_dir=runs))
        events = EventAccumulator(str(folder)).Reload()
    return pd.DataFrame(lines), events.Scalars("eval/return")[-1].value


def describe(part):
    """A line of the output from some lines of `count`."""
    rows, busy, differ, lost = part[["rows", "busy", "differ", "lost"]].sum()
    share = differ / max(busy, 1)
    mean_lost = lost / max(differ, 1)
    return f"{part['update'].min():12} {rows:7.0f} {busy:17.0f} {differ:15.0f} {share:15.4f} {mean_lost:22.3f}"


def parse_args(argv=None):
    """Options and the script's flags; errors are one line, before anything is trained."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.error = lambda message: sys.exit(f"violations: {message}")
    parser.add_argument("--seeds", type=seeds, default="41", help="such as 41 or 41-45 (default: %(default)s)")
    parser.add_argument("--every", type=int, default=100, help="updates between two counts (default: %(default)s)")
    parser.add_argument("--parts", type=int, default=5, help="of a run, each with a line (default: %(default)s)")
    options, flags = parser.parse_known_args(argv)  # the others are the script's
    if min(options.every, options.parts) < 1:
        parser.error("--every and --parts must be at least 1")
    args = avf_qplex.parse_args([*flags, f"--seed={options.seeds[-1]}"])
    n_actions = envs.make(args.env).n_actions
    joint = max(n_actions) ** len(n_actions)
    if joint > MOST_JOINT:
        parser.error(f"{args.env} has {joint:,} joint macro-actions, at most {MOST_JOINT:,} can be tried")
    return options, flags


def main(argv=None):
    options, flags = parse_args(argv)
    header = "seed  updates from    rows  with busy agents  choices differ  share of those  mean value lost there"
    print(header, flush=True)
    for seed in options.seeds:
        args = avf_qplex.parse_args([*flags, f"--seed={seed}"])
        found, result = count(args, options.every)
        if len(found):  # else the run was too short for an update
            n_parts = min(options.parts, len(found))
            for part in np.array_split(np.arange(len(found)), n_parts):
                print(f"{seed:4}  {describe(found.iloc[part])}")
            print(f"{seed:4}  {describe(found)}")  # the whole run
        print(f"{seed:4}  return {result:.1f}", flush=True)


if __name__ == "__main__":
    try:
        main()
    except (OSError, ImportError) as error:  # a full disk, no wandb
        sys.exit(f"violations: {error}")
    except KeyboardInterrupt:
        print("violations: stopped; what is printed stays", file=sys.stderr)
        sys.exit(130)
