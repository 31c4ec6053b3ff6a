"""The smallest counterexample to Mac-IGM as a picture: QPLEX's formula to the letter beside the script's.

    python theory/picture.py -o docs/images/counterexample.png

Every number in it is a value of `avf_qplex.QPLEXMixer` with the weights of `variants.two_by_two`, and the verdicts are
those of `igm.mac_igm`.
"""

import argparse
import sys
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))  # run as a script, Python looks in this folder only

from theory.expressiveness import joint_tables
from theory.igm import conditional_argmax, local_choices, mac_igm
from theory.variants import two_by_two

UTILITIES = np.array([1.0, 0.0]), np.array([1.0, 0.0])  # of a and b
TERMINATED, ONGOING = (True, False), (0, 1)  # agent 2 goes on with b
GREEDY, BEST, SHUT = "#d55e00", "#0072b2", "0.75"
RADII = {GREEDY: 0.40, BEST: 0.34}  # concentric where both are in one place


def tables():
    """What the picture shows: for each panel its title, the mixer's table float64 [2, 2] and the Verdict on it."""
    found = []
    for title, options in (("QPLEX to the letter (Eq. 4)", dict(mask_ongoing=False)), ("avf_qplex.py", {})):
        (q,) = joint_tables(two_by_two(**options), [u[None] for u in UTILITIES], TERMINATED, np.zeros((1, 1)))
        q = q.round(6)  # 1e-10 is added to the mixer's weights
        found.append((title, q, mac_igm(q, UTILITIES, TERMINATED, ONGOING)))
    return found


def draw(path):
    """Writes the picture, PNG, 1,350 x 720 pixels."""
    import matplotlib  # optional: pip install -e '.[report]'

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, panels = plt.subplots(1, 2, figsize=(9, 4.8), layout="constrained")
    figure.get_layout_engine().set(h_pad=0.12)
    for axes, (title, q, verdict) in zip(panels, tables(), strict=True):
        axes.add_patch(plt.Rectangle((-0.5, -0.5), 1, 2, color="0.93"))  # what agent 2's choice has shut
        for m, value in np.ndenumerate(q):
            closed = m[1] != ONGOING[1]
            axes.text(m[1], m[0], f"{value:g}", ha="center", va="center", fontsize=24, color=SHUT if closed else "k")
        marks = (
            (GREEDY, local_choices(UTILITIES, TERMINATED, ONGOING)),
            (BEST, conditional_argmax(q, TERMINATED, ONGOING)),
        )
        for colour, ((row, column),) in marks:
            axes.add_patch(plt.Circle((column, row), RADII[colour], fill=False, color=colour, linewidth=3.5))
        says = "Mac-IGM holds" if verdict else f"Mac-IGM fails: agent 1's choice loses {verdict.margin:g}"
        axes.set_title(f"{title}\n{says}", fontsize=12)
        names = [f"a, utility {UTILITIES[0][0]:g}", f"b, utility {UTILITIES[0][1]:g}"]
        axes.set_xticks([0, 1], ["a", "b, ongoing"], fontsize=11)
        axes.set_yticks([0, 1], names, fontsize=11)
        axes.set(xlim=(-0.5, 1.5), ylim=(1.5, -0.5), aspect="equal", xlabel="agent 2", ylabel="agent 1 chooses")
        axes.set_xticks([0.5], minor=True)
        axes.set_yticks([0.5], minor=True)
        axes.grid(which="minor", color="0.4")
        axes.tick_params(which="both", length=0)
    handles = [plt.Line2D([], [], marker="o", linestyle="", mfc="none", mec=colour, mew=3, ms=14, label=label)
               for colour, label in ((GREEDY, "what the agents' own greedy choices lead to"),
                                     (BEST, "the best that agent 2's ongoing b leaves open"))]  # fmt: skip
    figure.legend(handles=handles, loc="outside lower center", ncols=2, frameon=False, fontsize=11)
    figure.savefig(path, dpi=150)
    plt.close(figure)


def main(argv=None):
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("-o", "--output", type=Path, help="the picture, PNG; without it the numbers are printed alone")
    options = parser.parse_args(argv)
    for title, q, verdict in tables():
        print(f"{title}: {q.tolist()}, {verdict}")
    if options.output:
        draw(options.output)


if __name__ == "__main__":
    main()
