"""Does AVF-QPLEX break Mac-IGM while it learns, and does it cost anything? Counted on the rows that a run replays.

    python theory/violations.py --env bp-10 --seeds 41-45 --no-mask-ongoing      the literal mixer (Eq. 4)
    python theory/violations.py --env bp-10 --seeds 41-45                        as shipped: none but rounding

Every so many updates the online mixer's value of every joint macro-action that agrees with what ongoing agents do is
compared with that of the agents' own greedy choices (Eq. 7). Where the best is higher by more than a tolerance, the
choices differ, and the difference is the value lost by acting on utilities. Returns are the run's last evaluation.
"""

import argparse
import itertools
import sys
import tempfile
from dataclasses import replace
from pathlib import Path
from unittest.mock import patch

import numpy as np
import pandas as pd
import torch
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

sys.path.insert(0, str(Path(__file__).parents[1]))  # run as a script, Python looks in this folder only

import avf_qplex

TOLERANCE = 1e-4  # of the value, or of 1 where that is less


def value_lost(utilities, mixer, batch, rows=200):
    """Of at most so many valid rows of a batch at which an agent chooses: value lost, its tolerance, float32 [R], and
    whether some agent is ongoing, bool [R]. utilities: float32 [B, T, n, A]."""
    at = torch.nonzero(batch["valid"])  # [R, 2]
    at = at[:: -(-len(at) // rows)].unbind(1)
    utilities, chosen, action, state = (x[at] for x in (utilities, batch["chosen"], batch["action"], batch["state"]))
    counts = torch.isfinite(utilities[0]).sum(1).tolist()  # macro-actions of each agent
    joint = torch.tensor(list(itertools.product(*map(range, counts))))  # [J, n]
    greedy = torch.where(chosen, utilities.argmax(2), action)  # [R, n]
    joint = torch.cat([greedy[:, None], joint.expand(len(greedy), -1, -1)], 1)  # [R, 1 + J, n], the greedy one first
    same = [x[:, None].expand(-1, joint.shape[1], *x.shape[1:]) for x in (utilities, chosen, state)]
    taken = same[0].gather(3, joint[..., None])[..., 0]  # [R, 1 + J, n]
    q = mixer(taken, same[0].amax(3), joint, same[1], same[2])  # [R, 1 + J]
    agrees = ((joint == action[:, None]) | same[1]).all(2)
    best = q.masked_fill(~agrees, -torch.inf).amax(1)
    return best - q[:, 0], TOLERANCE * best.abs().clamp(min=1), ~chosen.all(1)


def count(args, every):
    """Trains from args and counts every so many updates: a DataFrame with a line for each time."""
    lines, updates, real = [], itertools.count(), avf_qplex.td_loss

    def td_loss(utilities, target_utilities, mixer, target_mixer, batch, *options):
        if (update := next(updates)) % every == 0:
            with torch.no_grad():
                lost, tolerance, ongoing = value_lost(utilities, mixer, batch)
            differ = lost > tolerance
            counts = len(lost), int(ongoing.sum()), int(differ.sum()), float(lost[differ].sum()) / args.reward_scale
            lines.append(dict(zip(("rows", "ongoing", "differ", "lost"), counts, strict=True)) | {"update": update})
        return real(utilities, target_utilities, mixer, target_mixer, batch, *options)

    with tempfile.TemporaryDirectory() as runs, patch.object(avf_qplex, "td_loss", td_loss):
        events = EventAccumulator(str(avf_qplex.train(replace(args, runs_dir=runs)))).Reload()
        return pd.DataFrame(lines), events.Scalars("eval/return")[-1].value


def main(argv=None):
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", default="41", help="such as 41 or 41-45 (default: %(default)s)")
    parser.add_argument("--every", type=int, default=100, help="updates between two counts (default: %(default)s)")
    parser.add_argument("--parts", type=int, default=5, help="of a run, each with a line (default: %(default)s)")
    options, flags = parser.parse_known_args(argv)  # the others are the script's
    first, _, last = options.seeds.partition("-")
    print("seed  updates from    rows  with ongoing agents  choices differ  share of those  mean value lost there")
    for seed in range(int(first), int(last or first) + 1):
        found, result = count(avf_qplex.parse_args([*flags, f"--seed={seed}"]), options.every)
        for at in [*np.array_split(np.arange(len(found)), options.parts), np.arange(len(found))]:
            part = found.iloc[at]
            rows, ongoing, differ, lost, _ = part.sum()
            share = differ / max(ongoing, 1)
            text = f"{int(part['update'].min()):12} {rows:7.0f} {ongoing:20.0f} {differ:15.0f} {share:15.4f}"
            print(f"{seed:4}  {text} {lost / max(differ, 1):22.3f}", flush=True)
        print(f"{seed:4}  return {result:.1f}")


if __name__ == "__main__":
    main()
