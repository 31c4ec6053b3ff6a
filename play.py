"""Watches what a script has saved: figures of merit, an animation, a timeline of macro-actions, rows for learning.

    python play.py runs/<folder> --gif team.gif --timeline team.png
    python play.py runs/<folder> --rows 0-8

The model plays --episodes greedy episodes side by side, of which means and standard errors are printed. Animation,
timeline and rows are those of the first of them, that of environment 0 (so, where a task has chance, of another one for
another --episodes).
"""

import argparse
import importlib
import json
import os
import re
import sys
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from PIL import Image

import envs
from envs import rendering

SCRIPTS = ("avf_vdn", "avf_qmix", "avf_qplex", "dec_maddrqn", "cen_maddrqn", "mac_iaicc")
COLUMNS = 120  # of the terminal in which rows are printed


# ---- watching an episode --------------------------------------------------------------------------------------------
class Step(NamedTuple):
    """A step of environment 0 and what stands before and after it, arrays [1, ...] as of a batch of one."""

    obs: np.ndarray
    infos: dict
    said: torch.Tensor | None  # float32 [n, A], what the agents' networks said before it
    rewards: np.ndarray
    terminated: np.ndarray
    over: np.ndarray  # terminated or truncated
    next_obs: np.ndarray
    next_infos: dict


class Bar(NamedTuple):
    """A macro-action of an agent."""

    start: int  # times
    end: int
    action: int


class Episode(NamedTuple):
    """T steps of n agents. Step t leads from time t to time t + 1; macro-actions start and end at times."""

    labels: list  # [n], what the agents are called
    names: list  # [n][A], the names of the macro-actions
    chosen: np.ndarray  # bool [T, n], the agent started a macro-action at time t
    running: np.ndarray  # int64 [T, n], its macro-action in step t
    rewards: np.ndarray  # float64 [T]
    utilities: np.ndarray | None  # float32 [T, n, A], what its network said at time t, -inf for what it cannot start
    meaning: str  # of the utilities: "utility" or "probability"

    def rows(self):
        """The decision rows: times at which at least one agent started a macro-action."""
        return np.flatnonzero(self.chosen.any(1)).tolist()

    def bars(self, agent):
        """The agent's macro-actions in their order."""
        starts = np.flatnonzero(self.chosen[:, agent]).tolist()
        ends = [*starts[1:], len(self.chosen)]
        actions = self.running[starts, agent].tolist()
        return [Bar(*bar) for bar in zip(starts, ends, actions, strict=True)]


class Recorder:
    """Behaves as the batch of environments it is given and records the first episode of environment 0.

    frames: a list that receives its pictures, or None. probabilities: what the networks say are logits.
    """

    def __init__(self, env, frames=None, probabilities=False):
        self.env, self.frames, self.probabilities = env, frames, probabilities
        self.steps, self.before, self.said = [], None, None

    def __getattr__(self, name):
        return getattr(self.env, name)

    def listen(self, module, inputs, output):
        """A forward hook for the agents' networks, which run before each step."""
        values = output[0]  # [n, N, 1, A], or [N, 1, J] of one network for the whole team
        self.said = values[:, 0, 0].detach() if values.dim() == 4 else None  # [n, A], of environment 0

    def reset(self, **options):
        obs, infos = self.env.reset(**options)
        if self.before is None:
            self._look(obs, infos)
        return obs, infos

    def step(self, actions):
        obs, rewards, terminations, truncations, infos = self.env.step(actions)
        if not (self.steps and self.steps[-1].over[0]):
            done = terminations[:1], (terminations | truncations)[:1]
            before = *self.before, self.said, rewards[:1], *done
            self.steps.append(Step(*before, *self._look(obs, infos)))
        return obs, rewards, terminations, truncations, infos

    def _look(self, obs, infos):
        self.before = obs[:1], {key: value[:1] for key, value in infos.items()}
        if self.frames is not None:
            self.frames.append(self.env._draw(0))  # render() would draw the whole batch
        return self.before

    def episode(self):
        """The Episode up to now, without utilities if one network speaks for the whole team."""
        chosen = np.concatenate([step.infos["macro_done"] for step in self.steps])  # [T, n]
        running = np.concatenate([step.next_infos["macro_action"] for step in self.steps])  # [T, n]
        rewards = np.concatenate([step.rewards for step in self.steps])  # [T]
        utilities, said = None, [step.said for step in self.steps]
        if all(one is not None for one in said):
            available = np.concatenate([step.infos["available"] for step in self.steps])  # [T, n, A]
            utilities = torch.stack(said).masked_fill(~torch.from_numpy(available), -torch.inf)
            utilities = (utilities.softmax(2) if self.probabilities else utilities).numpy()
        robots = getattr(self.env, "n_robots", self.n_agents)  # the warehouse's last agent is the arm
        labels = [agent if agent < robots else rendering.ARM for agent in range(self.n_agents)]
        meaning = "probability" if self.probabilities else "utility"
        return Episode(labels, self.macro_action_names, chosen, running, rewards, utilities, meaning)


def watch(script, args, learner, episodes, seed, frames=None):
    """Plays greedily: the script's results, a dict of float64 [episodes], and the Recorder of the first.

    frames: a list that receives its pictures, or None.
    """
    recorder = Recorder(envs.make(args.env, episodes), frames, probabilities="critics" in learner)
    hook = learner["agents"].register_forward_hook(recorder.listen)
    result = script.evaluate(learner["agents"], recorder, args.gamma, seed)
    hook.remove()
    return result, recorder


# ---- its rows -------------------------------------------------------------------------------------------------------
def remember(script, args, steps):
    """The rows of an ended episode of Steps as the script's training loop and replay buffer make them, an array [T]."""
    env = envs.make(args.env)
    buffer = script.ReplayBuffer(env, 1) if hasattr(script, "ReplayBuffer") else script.EpisodeBuffer(env)
    for step in steps:
        buffer.begin_rows(step.obs, step.infos, step.next_infos["macro_action"], step.infos["macro_done"])
        state = [step.infos["state"]] if "state" in buffer.running.dtype.names else []  # only mixers need it
        buffer.add_step(*state, args.reward_scale * step.rewards, np.where(step.terminated, 0.0, args.gamma))
    buffer.end_episodes(step.over, step.next_obs, step.next_infos)
    return buffer.ended[0]


def describe_rows(script, args, recorder, first, last):
    """Lines of at most COLUMNS characters: the rows from one number to another as the script's replay buffer holds
    them (Fig. 2 of the paper), each with a line for every agent. The row after the last choice is the final one.

    Raises:
        ValueError: the episode has no such rows.
    """
    rows, episode = remember(script, args, recorder.steps), recorder.episode()
    times = [*episode.rows(), len(episode.rewards)]
    if last >= len(times):
        raise ValueError(f"the episode has rows 0 to {len(times) - 1}")
    wide = max(len(name) for names in episode.names for name in names)
    lines = [
        "since: the row at which the agent chose its macro-action; if it is an earlier one, the agent is ongoing here",
        f"r: rewards until the next row, discounted and summed, times --reward-scale {args.reward_scale:g}",
        "discount: gamma^tau of the next row's value, 0 at a terminal end",
        "",
        f"{'row':>4}{'t':>5}{'tau':>5}{'r':>10}{'discount':>10} | {'agent':6}{'runs':{wide + 2}}{'since':>5}"
        f"  {'here':9}last saw",
    ]
    for row in range(first, last + 1):
        final = row == len(times) - 1
        tau = "end" if final else times[row + 1] - times[row]
        left = f"{row:4}{times[row]:5}{tau:>5}"
        left += "" if final else f"{rows['reward'][row]:10.4f}{rows['discount'][row]:10.4f}"
        for agent, label in enumerate(episode.labels):
            since, action = rows["since"][row, agent], rows["action"][row, agent]
            name = "-" if final else episode.names[agent][action]
            here = "free" if final else "chosen" if since == row else "ongoing"
            saw = rows["obs"][row, agent, : recorder.obs_sizes[agent]]
            saw = " ".join(f"{round(float(x), 2) + 0.0:g}" for x in saw)  # + 0.0: not -0
            line = f"{left:34} | {label:<6}{name:{wide + 2}}{since:5}  {here:9}{saw}"
            lines.append(line if len(line) <= COLUMNS else line[: COLUMNS - 4] + " ...")
            left = ""
    return lines


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


def write(path, save):
    """Lets `save` write a file beside the path and swaps, so that a failure leaves the file that was there."""
    new = Path(f"{path}.new")
    try:
        save(new)
        os.replace(new, path)
    except (OSError, ValueError) as error:  # ValueError: a timeline is too high for a PNG
        new.unlink(missing_ok=True)
        fail(f"cannot write {path}: {getattr(error, 'strerror', None) or error}")


def span(words):
    """The two numbers of "A-B", or (1, 0) for anything else."""
    ends = re.fullmatch(r"(\d{1,9})-(\d{1,9})", words)
    return tuple(map(int, ends.groups())) if ends else (1, 0)


def parse_args(argv=None):
    """The command line; its errors are one line."""
    parser = argparse.ArgumentParser(prog="play.py", description=__doc__.partition("\n")[0], allow_abbrev=False)
    parser.error = fail
    parser.add_argument("run", help="folder of a run of any script")
    parser.add_argument("--episodes", type=int, default=100, help="how many to play (default: 100)")
    parser.add_argument("--model", choices=("best", "last"), default="best", help="of which evaluation (default: best)")
    parser.add_argument("--seed", type=int, help="of the episodes, from 0 on (default: that of the run)")
    parser.add_argument("--gif", metavar="FILE", help="write an animation of the first episode")
    parser.add_argument("--timeline", metavar="FILE", help="draw its macro-actions and rows, as .png, .svg or .pdf")
    parser.add_argument("--rows", metavar="A-B", help="print its rows A to B as the replay buffer holds them")
    parser.add_argument("--steps", metavar="A-B", help="with --timeline: only time A to B, enlarged, with utilities")
    options = parser.parse_args(argv)
    if options.episodes < 1:
        fail(f"--episodes must be at least 1, got {options.episodes}")
    if options.seed is not None and options.seed < 0:
        fail(f"--seed must not be negative, got {options.seed}")
    for path, kinds in ((options.gif, [".gif"]), (options.timeline, [".png", ".svg", ".pdf"])):
        if path is not None and (Path(path).suffix.lower() not in kinds or not Path(path).parent.is_dir()):
            fail(f"cannot write {path}: it has to be a {' or '.join(kinds)} file in a folder that exists")
    if options.steps is not None:
        if not options.timeline:
            fail("--steps needs --timeline")
        options.steps = span(options.steps)
        if options.steps[0] >= options.steps[1]:
            fail("--steps must be two times, the second after the first, such as 0-40")
    if options.rows is not None:
        options.rows = span(options.rows)
        if options.rows[0] > options.rows[1]:
            fail("--rows must be two rows, the second not before the first, such as 0-8")
    return options


def main(argv=None):
    """Plays, prints and writes what the command line asks for."""
    options = parse_args(argv)
    torch.set_num_threads(1)  # fastest for networks of this size
    script, args, learner, step = load_run(options.run, options.model)
    seed, frames = args.seed if options.seed is None else options.seed, [] if options.gif else None
    result, recorder = watch(script, args, learner, options.episodes, seed, frames)
    episode, name = recorder.episode(), f"{args.env} {script.__name__}"
    length = len(episode.rewards)
    if options.steps and options.steps[1] > length:
        fail(f"--steps {options.steps[0]}-{options.steps[1]} is out of range: the episode has {length} steps")
    try:
        rows = describe_rows(script, args, recorder, *options.rows) if options.rows else []
    except ValueError as error:
        fail(f"--rows {options.rows[0]}-{options.rows[1]} is out of range: {error}")
    print(f"{name} {options.model} model of step {step}: {options.episodes} greedy episodes")
    for key, value in result.items():
        error = value.std(ddof=1) / len(value) ** 0.5 if len(value) > 1 else float("nan")
        print(f"{key.replace('_', ' '):17s} {value.mean():9.3f} +- {error:.3f} (standard error)")
    if rows:
        print("", *rows, sep="\n")
    if options.gif:
        pictures = [Image.fromarray(frame).quantize(dither=0) for frame in frames]
        times = [150] * (len(frames) - 1) + [1500]  # milliseconds
        animation = {"save_all": True, "append_images": pictures[1:], "duration": times, "loop": 0}
        write(options.gif, lambda file: pictures[0].save(file, "GIF", **animation))
    if options.timeline:
        import timeline  # here, since it takes a while to import matplotlib

        facts = f"A greedy episode of {length} steps, {len(episode.rows())} of them rows: "
        facts += f"return {result['return'][0]:.4g}{', success' * bool(result['success'][0])}"
        figure = timeline.draw(episode, name.replace(" ", ", "), facts, options.steps)
        kind = Path(options.timeline).suffix.lower().removeprefix(".")
        write(options.timeline, lambda file: timeline.save(figure, file, kind))


if __name__ == "__main__":
    try:
        main()
        sys.stdout.flush()
    except BrokenPipeError:  # what reads it, such as head, has seen enough; Python flushes once more when it exits
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
