"""Is a learned team at a local optimum? What its greedy episode brings if one macro-action is another, or two are.

    python theory/deviations.py runs/<folder>              the last model of a run of any script
    python theory/deviations.py runs/<folder> --model best --show 10

Every choice of the greedy episode is replaced by every other macro-action of the agent. This is done alone, and with
every replacement of a later or simultaneous choice of another agent. All other choices stay greedy, by what the agents
then observe. Where no single replacement brings more, no agent has a reason to change alone. A replacement is without
effect if, after another, the agent is not free then or cannot start the macro-action. For tasks without chance.
"""

import argparse
import itertools
import random
import sys
from pathlib import Path

import numpy as np
import torch

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))  # run as a script, Python looks in this folder only

import envs
import play

BATCH = 2_000  # episodes side by side


class Replacing:
    """Behaves as a batch of environments and replaces macro-actions of their first episodes.

    replacements: for each environment a tuple of (step, agent, macro-action).
    """

    def __init__(self, env, replacements):
        self.env = env
        self.time = 0
        self.at = {}  # by step: a list of (environment, agent, macro-action)
        for e, changes in enumerate(replacements):
            for step, agent, action in changes:
                self.at.setdefault(step, []).append((e, agent, action))

    def __getattr__(self, name):
        return getattr(self.env, name)

    def step(self, actions):
        for e, agent, action in self.at.get(self.time, ()):
            if self.env.available[e, agent, action]:
                actions[e, agent] = action
        self.time += 1
        return self.env.step(actions)


def returns(script, args, learner, replacements):
    """Return and discounted return of a greedy episode with each of the replacements: float64 [episodes, 2]."""
    found = [np.zeros((0, 2))]
    for first in range(0, len(replacements), BATCH):
        some = replacements[first : first + BATCH]
        env = Replacing(envs.make(args.env, len(some)), some)
        result = script.evaluate(learner["agents"], env, args.gamma, args.seed)
        both = np.stack([result["return"], result["discounted_return"]], 1)
        found.append(both.round(6))
    return np.concatenate(found)


def singles(episode, n_actions):
    """Every (step, agent, macro-action) that is not a timeline's Episode's. n_actions: of each agent."""
    changes = []
    for step, agent in np.argwhere(episode.chosen).tolist():
        for action in range(n_actions[agent]):
            if action != episode.running[step, agent]:
                changes.append((step, agent, action))
    return changes


def pairs(changes, most, seed=0):
    """Every two of them by different agents, the earlier one first; of more than `most` that many, drawn at random."""
    found = [(one, other) for one, other in itertools.combinations(changes, 2) if one[1] != other[1]]
    if len(found) > most:
        found = random.Random(seed).sample(found, most)
    return found


def parse_args(argv=None):
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.error = lambda message: sys.exit(f"deviations: {message}")
    parser.add_argument("run", help="folder of a run of any script")
    parser.add_argument("--model", choices=("best", "last"), default="last", help="default: %(default)s")
    parser.add_argument("--show", type=int, default=3, help="how many of the best to print (default: %(default)s)")
    parser.add_argument("--pairs", type=int, default=50_000, help="most pairs to try, at random (default: %(default)s)")
    options = parser.parse_args(argv)
    if min(options.show, options.pairs) < 0:
        sys.exit("deviations: --show and --pairs must not be negative")
    return options


def main(argv=None):
    options = parse_args(argv)
    torch.set_num_threads(1)
    script, args, learner, step = play.load_run(options.run, options.model)
    result, recorder = play.watch(script, args, learner, 20, args.seed)
    begin, _ = envs.make(args.env, 20).reset(seed=0)
    if np.ptp(result["return"]) > 0 or (begin != begin[0]).any():
        sys.exit(f"deviations: {args.env} has chance: one episode says nothing of another")
    episode = recorder.episode()
    (greedy,) = returns(script, args, learner, [()])
    print(f"{args.env} {script.__name__}, {options.model} model of step {step}")
    print(f"greedy: return {greedy[0]:.4g}, discounted {greedy[1]:.4g}")
    changes = singles(episode, recorder.n_actions)
    by_count = {
        "one": [(change,) for change in changes],
        "two": pairs(changes, options.pairs),
    }
    for title, replacements in by_count.items():
        found = returns(script, args, learner, replacements)
        more, more_discounted = (found > greedy + 1e-6).sum(0)
        print(f"{title} replaced: {len(found)}, of which higher return {more}, discounted {more_discounted}")
        best_first = np.argsort(-found[:, 0], kind="stable")
        for k in best_first[: options.show]:
            words = []
            for t, agent, action in replacements[k]:
                words.append(f"t = {t}: {episode.labels[agent]} {episode.names[agent][action]}")
            print(f"  return {found[k, 0]:.4g}, discounted {found[k, 1]:.4g}: {'; '.join(words)}")


if __name__ == "__main__":
    main()
