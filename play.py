"""Watches what a script has saved: figures of merit, an animation and a timeline of macro-actions.

    python play.py runs/<folder> --gif team.gif --timeline team.png

The model plays --episodes greedy episodes side by side, of which means and standard errors are printed. The animation
and the timeline show the first of them, that of environment 0 (so, where a task has chance, another one for another
--episodes).
"""

import argparse
import importlib
import json
import os
import re
from pathlib import Path

import numpy as np
import torch
from PIL import Image

import envs
import timeline
from envs import rendering

SCRIPTS = ("avf_vdn", "avf_qmix", "avf_qplex", "dec_maddrqn", "cen_maddrqn", "mac_iaicc")


# ---- watching an episode --------------------------------------------------------------------------------------------
class Recorder:
    """Behaves as the batch of environments it is given and records the first episode of environment 0.

    frames: a list that receives its pictures, or None.
    """

    def __init__(self, env, frames=None):
        self.env, self.frames = env, frames
        self.steps, self.free, self.said, self.over = [], None, None, False

    def __getattr__(self, name):
        return getattr(self.env, name)

    def listen(self, module, inputs, output):
        """A forward hook for the agents' networks, which run before each step."""
        self.said = output[0][:, 0].detach()  # [n, A], of environment 0

    def reset(self, **options):
        obs, infos = self.env.reset(**options)
        if self.free is None:
            self._look(infos)
        return obs, infos

    def step(self, actions):
        obs, rewards, terminations, truncations, infos = self.env.step(actions)
        if not self.over:
            self.steps.append((self.free, infos["macro_action"][0], rewards[0], self.said))
            self._look(infos)
            self.over = bool(terminations[0] or truncations[0])
        return obs, rewards, terminations, truncations, infos

    def _look(self, infos):
        self.free = infos["macro_done"][0]
        if self.frames is not None:
            self.frames.append(self.env._draw(0))  # render() would draw the whole batch

    def episode(self, probabilities=False):
        """The Episode up to now, without utilities if one network speaks for the whole team.

        probabilities: what the networks say are logits.
        """
        chosen, running, rewards, said = zip(*self.steps, strict=True)
        utilities, meaning = None, "probability" if probabilities else "utility"
        if all(one is not None and len(one) == self.n_agents for one in said):
            utilities = torch.stack(said)  # [T, n, A]
            utilities = (utilities.softmax(2) if probabilities else utilities).numpy()
        robots = getattr(self.env, "n_robots", self.n_agents)  # the warehouse's last agent is the arm
        labels = [agent if agent < robots else rendering.ARM for agent in range(self.n_agents)]
        arrays = np.array(chosen), np.array(running), np.array(rewards)
        return timeline.Episode(labels, self.macro_action_names, *arrays, utilities, meaning)


# ---- the command line -----------------------------------------------------------------------------------------------
def fail(message):
    """Ends the program with one line."""
    raise SystemExit(f"play: {message}")


def load_run(folder, name):
    """A run folder's script and Args (on the CPU), the learner with its "best" or "last" model, and that one's step."""
    if not Path(folder).is_dir():
        fail(f"there is no folder {folder}")
    try:
        algorithm = json.loads((Path(folder) / "args.json").read_text())["algorithm"]
    except (OSError, ValueError, KeyError, TypeError) as error:
        fail(f"{folder} is not a run folder: args.json: {error}")
    if algorithm not in SCRIPTS:
        fail(f"{folder} is a run of {algorithm!r}, which is none of {' '.join(SCRIPTS)}")
    script, path = importlib.import_module(algorithm), Path(folder) / f"{name}.pt"
    try:
        model = script.load(path)
        args = script.Args(**model["args"] | {"device": "cpu"})
        learner = script.make_learner(args, envs.make(args.env))
        learner.load_state_dict(model["networks"])
    except SystemExit as error:  # the script's own line
        fail(error)
    except (KeyError, TypeError, RuntimeError) as error:
        fail(f"{path} does not fit its settings: {str(error).splitlines()[0]}")
    return script, args, learner, model["step"]


def watch(script, args, learner, episodes, seed, frames=None):
    """Plays greedily: the script's results, a dict of float64 [episodes], and the Episode of the first.

    frames: a list that receives its pictures, or None.
    """
    recorder = Recorder(envs.make(args.env, episodes), frames)
    hook = learner["agents"].register_forward_hook(recorder.listen)
    result = script.evaluate(learner["agents"], recorder, args.gamma, seed)
    hook.remove()
    return result, recorder.episode(probabilities="critics" in learner)


def write(path, picture, kind, **options):
    """Writes a picture beside the file and swaps, so that a failure leaves the file that was there."""
    new = Path(f"{path}.new")
    try:
        picture.save(new, kind, **options)
        os.replace(new, path)
    except OSError as error:
        new.unlink(missing_ok=True)
        fail(f"cannot write {path}: {error.strerror or error}")


def parse_args(argv=None):
    """The command line; its errors are one line."""
    parser = argparse.ArgumentParser(prog="play.py", description=__doc__.partition("\n")[0], allow_abbrev=False)
    parser.error = fail
    parser.add_argument("run", help="folder of a run of any script")
    parser.add_argument("--episodes", type=int, default=100, help="how many to play (default: 100)")
    parser.add_argument("--model", choices=("best", "last"), default="best", help="of which evaluation (default: best)")
    parser.add_argument("--seed", type=int, help="of the episodes, from 0 on (default: that of the run)")
    parser.add_argument("--gif", metavar="FILE", help="write an animation of the first episode")
    parser.add_argument("--timeline", metavar="FILE", help="write a picture of its macro-actions and rows, a PNG")
    parser.add_argument("--steps", metavar="A-B", help="with --timeline: only time A to B, enlarged, with utilities")
    options = parser.parse_args(argv)
    if options.episodes < 1:
        fail(f"--episodes must be at least 1, got {options.episodes}")
    if options.seed is not None and options.seed < 0:
        fail(f"--seed must not be negative, got {options.seed}")
    for kind, path in ((".gif", options.gif), (".png", options.timeline)):
        if path is not None and (Path(path).suffix.lower() != kind or not Path(path).parent.is_dir()):
            fail(f"cannot write {path}: it has to be a {kind} file in a folder that exists")
    if options.steps is not None:
        if not options.timeline:
            fail("--steps needs --timeline")
        ends = re.fullmatch(r"(\d{1,9})-(\d{1,9})", options.steps)
        options.steps = tuple(map(int, ends.groups())) if ends else (0, 0)
        if options.steps[0] >= options.steps[1]:
            fail("--steps must be two times, the second after the first, such as 0-40")
    return options


def main(argv=None):
    """Plays, prints and writes what the command line asks for."""
    options = parse_args(argv)
    torch.set_num_threads(1)  # fastest for networks of this size
    script, args, learner, step = load_run(options.run, options.model)
    seed, frames = args.seed if options.seed is None else options.seed, [] if options.gif else None
    result, episode = watch(script, args, learner, options.episodes, seed, frames)
    length, name = len(episode.rewards), f"{args.env} {script.__name__}"
    if options.steps and options.steps[1] > length:
        fail(f"--steps {options.steps[0]}-{options.steps[1]} is out of range: the episode has {length} steps")
    print(f"{name} {options.model} model of step {step}: {options.episodes} greedy episodes")
    for key, value in result.items():
        error = value.std(ddof=1) / len(value) ** 0.5 if len(value) > 1 else float("nan")
        print(f"{key.replace('_', ' '):17s} {value.mean():9.3f} +- {error:.3f} (standard error)")
    if options.gif:
        pictures = [Image.fromarray(frame).quantize(dither=0) for frame in frames]
        times = [150] * (len(frames) - 1) + [1500]  # milliseconds
        write(options.gif, pictures[0], "GIF", save_all=True, append_images=pictures[1:], duration=times, loop=0)
    if options.timeline:
        facts = f"A greedy episode of {length} steps, {len(episode.rows())} of them rows: "
        facts += f"return {result['return'][0]:.4g}{', success' * bool(result['success'][0])}"
        picture = Image.fromarray(timeline.draw(episode, name.replace(" ", ", "), facts, options.steps))
        write(options.timeline, picture.quantize(256, Image.Quantize.MAXCOVERAGE), "PNG", optimize=True)


if __name__ == "__main__":
    main()
