"""Writes the numbers of docs/how-it-works.md: its marked blocks, from the models in docs/models.

python docs/how_it_works.py
"""

import re
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

DOCS = Path(__file__).resolve().parent
sys.path.insert(0, str(DOCS.parent))

import play  # noqa: E402

PAGE = DOCS / "how-it-works.md"
RUNS = DOCS / "models"
BLOCK = re.compile(r"(<!-- (\w+) -->\n```text\n)(.*?)(```\n)", re.DOTALL)  # (opening, name, text, end)
MODELS = ("avf_vdn", "avf_qmix", "avf_qplex")
MIXERS = MODELS[1:]  # those that see a state
ROW = 4  # the page follows the transition from this row
NEXT = 5  # to this one


class Reader:
    """What the model of a script says about the rows of an episode, a batch of one.

    utilities: float32 [T, n, A]. best: int64 [T, n], the conditional argmax. q, target: float32 [T - 1], those of
    td_loss with lambda 0.
    """

    def __init__(self, name, batch):
        self.script, args, learner, self.step = play.load_run(RUNS / name, "best")
        self.result, self.recorder = play.watch(self.script, args, learner, 1, args.seed)
        self.batch = batch
        self.mixer = learner["mixer"] if "mixer" in learner else None
        mixers = [self.mixer, self.mixer] if self.mixer else []  # each network is also its own target network
        with torch.no_grad():
            utilities = self.script.utilities_at_rows(learner["agents"], batch)
            one_row = replace(args, td_lambda=0.0)
            _, self.q, self.target = self.script.td_loss(utilities, utilities, *mixers, batch, one_row)
        self.utilities = utilities[0]
        self.best = self.utilities.masked_fill(~batch["available"][0], -torch.inf).argmax(2)

    def joint(self, row, actions, states=None):
        """The joint value of macro-actions int64 [n] at a row and its derivatives by their utilities, float32 [n].

        Busy agents are taken to run these macro-actions, whatever they really run. states: float32 [n, S], None for the
        macro-states of the row.
        """
        utilities = self.utilities[row].clone().requires_grad_()
        if self.mixer:
            free = self.batch["free"][0, row, :, None]
            runs = torch.nn.functional.one_hot(actions, utilities.shape[1]).bool()
            available = torch.where(free, self.batch["available"][0, row], runs)
            states = self.batch["macro_state"][0, row] if states is None else states
            value = self.mixer(utilities, actions, available, states.flatten())
        else:
            value = self.script.mix(utilities, actions)
        (slopes,) = torch.autograd.grad(value, utilities)
        return value.item(), slopes.gather(1, actions[:, None])[:, 0].tolist()


def table(*lines):
    """Lines of cells, padded to columns: text to the left, numbers to the right and with three decimals."""
    cells = [[f"{cell:.3f}" if isinstance(cell, float) else str(cell) for cell in line] for line in lines]
    widths = [max(map(len, column)) for column in zip(*cells, strict=True)]
    right = [any(isinstance(line[column], int | float) for line in lines) for column in range(len(widths))]
    pads = [str.rjust if is_right else str.ljust for is_right in right]
    return ["  ".join(pad(cell, width) for pad, cell, width in zip(pads, line, widths, strict=True)).rstrip()
            for line in cells]  # fmt: skip


def make_blocks():
    """The blocks of the page by name."""
    torch.set_num_threads(1)  # fastest for networks of this size
    script, args, learner, _ = play.load_run(RUNS / "avf_qplex", "best")
    _, recorder = play.watch(script, args, learner, 1, args.seed)
    episode = recorder.episode()
    stored = play.remember(script, args, recorder.steps)
    batch = script.make_batch([stored])
    readers = {name: Reader(name, batch) for name in MODELS}
    since = stored["since"]  # [T, n]
    states = stored["state"]  # [T, S]
    agents = [f"agent {label}" for label in episode.labels]
    times = episode.rows()

    def name(agent, action):
        return episode.names[agent][action]

    def here(agent, row=NEXT):
        return "chosen" if since[row, agent] == row else f"ongoing since row {since[row, agent]}"

    played = [("model", "of step", "return", "steps", "rows", "success")]
    for model, reader in readers.items():
        result = {key: value.item() for key, value in reader.result.items()}
        steps = int(result["length"])
        count = len(reader.recorder.episode().rows())
        played.append((model, reader.step, result["return"], steps, count, "yes" if result["success"] else "no"))

    # Row by row, and the conditional argmax with its target
    qplex = readers["avf_qplex"]
    rows = play.describe_rows(script, args, recorder, 0, 8)
    best = [("", f"at row {NEXT}", "m*", "utilities", "", "")]
    for agent, label in enumerate(agents):
        q = qplex.utilities[NEXT, agent].tolist()
        told = [f"{word} {value:.3f}" for word, value in zip(episode.names[agent], q, strict=False)]
        best.append((label, here(agent), name(agent, qplex.best[NEXT, agent]), *told[:3]))
        best += [("", "", "", *told[3:])] if told[3:] else []
    following, _ = qplex.joint(NEXT, qplex.best[NEXT])
    reward, discount = batch["reward"][0, ROW].item(), batch["discount"][0, ROW].item()
    target = [
        f"Q'(h', s', m*)           = {following:.3f}",
        f"y = r + gamma^tau Q'     = {reward:.4f} + {discount:.4f} x {following:.3f} = {qplex.target[ROW]:.3f}",
        f"Q(h, s, m) at row {ROW}      = {qplex.q[ROW]:.3f}",
        f"TD error                 = {qplex.target[ROW] - qplex.q[ROW]:.3f}",
    ]

    # Where an ongoing agent runs something else than the model would choose now
    other = [("model", "row", "agent", "runs", "its argmax", "Q' with what runs", "Q' with its argmax")]
    for model, reader in readers.items():
        own_actions = torch.from_numpy(recorder.own_actions)
        liked = reader.utilities.masked_fill(~own_actions, -torch.inf).argmax(2)  # [T, n]
        for row, agent in (~batch["free"][0] & (liked != reader.best)).nonzero().tolist():
            instead = reader.best[row].clone()
            instead[agent] = liked[row, agent]
            values = reader.joint(row, reader.best[row])[0], reader.joint(row, instead)[0]
            runs = name(agent, reader.best[row, agent])
            other.append((model, row, agents[agent], runs, name(agent, liked[row, agent]), *values))

    # What the mixers do with the choices of the agent that chooses, while the others go on
    (chooser,) = np.flatnonzero(batch["free"][0, NEXT])
    mix = [("model", f"{agents[chooser]} runs", *(f"Q of {label}" for label in agents), "joint Q'",
            *(f"dQ'/dQ {label[-1]}" for label in agents), "lambda")]  # fmt: skip
    for model, reader in readers.items():
        top, slopes = reader.joint(NEXT, reader.best[NEXT])
        for action, word in enumerate(episode.names[chooser]):
            actions = reader.best[NEXT].clone()
            actions[chooser] = action
            taken = reader.utilities[NEXT].gather(1, actions[:, None])[:, 0].tolist()
            value, derivatives = reader.joint(NEXT, actions)
            best_taken = reader.utilities[NEXT, chooser, reader.best[NEXT, chooser]].item()
            below = slopes[chooser] * (taken[chooser] - best_taken)  # w A
            attention = (value - top) / below if model == "avf_qplex" and below else ""
            mix.append((model, word, *taken, value, *derivatives, attention))

    # The joint macro-state, and what the mixers say with another one in its place
    part = [("part of", "state of row", "t", "x, y of robot 0", "robot 1", "tools of robot 1", "staged")]
    for agent, label in enumerate(agents):
        row = since[NEXT, agent]
        numbers = np.round(states[row], 2)
        spans = ((0, 2), (5, 7), (7, 10), (10, 13))
        part.append((label, int(row), times[row], *(" ".join(f"{x:g}" for x in numbers[a:b]) for a, b in spans)))
    fed = [("states of rows", *MIXERS)]
    for rows_fed in (since[NEXT].tolist(), [NEXT] * 3, [ROW] * 3):
        seen = torch.from_numpy(states[rows_fed])  # [n, S]
        values = (readers[model].joint(NEXT, readers[model].best[NEXT], seen)[0] for model in MIXERS)
        fed.append((", ".join(map(str, rows_fed)), *values))
    fed.append((f"target y of row {NEXT}", *(readers[model].target[NEXT].item() for model in MIXERS)))

    blocks = dict(played=table(*played), rows=rows, argmax=table(*best), target=target, others=table(*other),
                  mixers=table(*mix), states=table(*part), fed=table(*fed))  # fmt: skip
    return {key: "\n".join(lines) + "\n" for key, lines in blocks.items()}


def main():
    """Rewrites the page's blocks."""
    blocks = make_blocks()
    PAGE.write_text(BLOCK.sub(lambda match: match[1] + blocks[match[2]] + match[4], PAGE.read_text()))


if __name__ == "__main__":
    main()
