"""The smallest counterexample to Mac-IGM as a picture: QPLEX's formula to the letter beside the script's.

    python theory/picture.py -o docs/images/counterexample.png

Every number in it is a value of `avf_qplex.QPLEXMixer` with the weights of `variants.two_by_two`, and the verdicts are
those of `igm.mac_igm`.
"""

import argparse
import importlib.util
import os
import sys
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))  # run as a script, Python looks in this folder only

from theory.expressiveness import joint_tables
from theory.igm import conditional_argmax, local_choices, mac_igm
from theory.variants import two_by_two

UTILITIES = np.array([1.0, 0.0]), np.array([1.0, 0.0])  # of a and b
BUSY_WITH = 1  # agent 2 goes on with b
AVAILABLE = (True, True), (False, True)
GREEDY = "#d55e00"
BEST = "#0072b2"
SHUT = "0.75"
RADII = {GREEDY: 0.40, BEST: 0.34}  # concentric where both are in one place


def table(mixer):
    """The mixer's values float64 [2, 2]; a column has those for an agent 2 that goes on with its macro-action."""
    utilities = [u[None] for u in UTILITIES]
    state = np.zeros((1, 1))
    columns = []
    for running in range(2):
        available = [np.ones(2, bool), np.arange(2) == running]
        (q,) = joint_tables(mixer, utilities, available, state)
        columns.append(q[:, running])
    return np.stack(columns, 1).round(6) + 0.0  # 1e-10 is added to some weights of the mixer; + 0.0: not -0


def panels():
    """What the picture shows: for each panel its title, the table and the Verdict on it."""
    literal = table(two_by_two(mask_ongoing=False))
    shipped = table(two_by_two())
    return [
        ("QPLEX to the letter (Eq. 4)", literal, mac_igm(literal, UTILITIES, AVAILABLE)),
        ("avf_qplex.py", shipped, mac_igm(shipped, UTILITIES, AVAILABLE)),
    ]


def draw(path):
    """Writes the picture, PNG, 1,350 x 720 pixels."""
    import matplotlib  # optional: pip install -e '.[report]'

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, all_axes = plt.subplots(1, 2, figsize=(9, 4.8), layout="constrained")
    figure.get_layout_engine().set(h_pad=0.12)
    for axes, (title, q, verdict) in zip(all_axes, panels(), strict=True):
        shut = plt.Rectangle((-0.5, -0.5), 1, 2, color="0.93")  # what agent 2's choice has shut
        axes.add_patch(shut)
        for (row, column), value in np.ndenumerate(q):
            colour = "k" if column == BUSY_WITH else SHUT
            axes.text(column, row, f"{value:g}", ha="center", va="center", fontsize=24, color=colour)
        marks = {
            GREEDY: local_choices(UTILITIES, AVAILABLE),
            BEST: conditional_argmax(q, AVAILABLE),
        }
        for colour, ((row, column),) in marks.items():
            ring = plt.Circle((column, row), RADII[colour], fill=False, color=colour, linewidth=3.5)
            axes.add_patch(ring)
        says = "Mac-IGM holds"
        if not verdict:
            says = f"Mac-IGM fails: agent 1's choice loses {verdict.margin:g}"
        axes.set_title(f"{title}\n{says}", fontsize=12)
        axes.set_xticks([0, 1], ["a", "b, ongoing"], fontsize=11)
        axes.set_yticks([0, 1], ["a, utility 1", "b, utility 0"], fontsize=11)
        axes.set(xlim=(-0.5, 1.5), ylim=(1.5, -0.5), aspect="equal")
        axes.set(xlabel="agent 2", ylabel="agent 1 chooses")
        axes.set_xticks([0.5], minor=True)
        axes.set_yticks([0.5], minor=True)
        axes.grid(which="minor", color="0.4")
        axes.tick_params(which="both", length=0)
    legend = {
        GREEDY: "what the agents' own greedy choices lead to",
        BEST: "the best that agent 2's ongoing b leaves open",
    }
    handles = []
    for colour, label in legend.items():
        ring = dict(marker="o", linestyle="", markersize=14, markerfacecolor="none", markeredgewidth=3)
        handles.append(plt.Line2D([], [], markeredgecolor=colour, label=label, **ring))
    figure.legend(handles=handles, loc="outside lower center", ncols=2, frameon=False, fontsize=11)
    figure.savefig(path, dpi=150)
    plt.close(figure)


def png(words):
    """The path of a picture on the command line, of a PNG file that can be written, or argparse's one line."""
    path = Path(words)
    if importlib.util.find_spec("matplotlib") is None:
        raise argparse.ArgumentTypeError("pictures need matplotlib: pip install -e '.[report]'")
    target = path if path.exists() else path.parent
    if path.suffix.lower() != ".png" or path.is_dir() or not os.access(target, os.W_OK):
        raise argparse.ArgumentTypeError(f"cannot write {words!r}: it has to be a .png file in a folder that exists")
    return path


def main(argv=None):
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.error = lambda message: sys.exit(f"picture: {message}")
    parser.add_argument("-o", "--output", type=png, help="the picture, PNG; without it the numbers are printed alone")
    options = parser.parse_args(argv)
    for title, q, verdict in panels():
        print(f"{title}: {q.tolist()}, {verdict}")
    if options.output:
        draw(options.output)


if __name__ == "__main__":
    try:
        main()
    except OSError as error:  # a full disk
        sys.exit(f"picture: {error}")
