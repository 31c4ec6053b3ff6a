"""Watches what a script has saved: figures of merit, an animation, a timeline of macro-actions, rows for learning.

    python play.py runs/<folder> --gif team.gif --timeline team.png
    python play.py runs/<folder> --rows 0-8

The model plays --episodes greedy episodes side by side, one in each environment, and the program prints means and
standard errors over them. Animation, timeline and rows show the first episode, the one in environment 0. Where a task
has chance, that episode changes with --episodes. No code of a run folder runs, and a module that it names is imported
only if --env names it, too.
"""

import argparse
import dataclasses
import importlib
import io
import os
import re
import sys
import zipfile
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from PIL import Image

import envs
from envs.rendering import ARM
from envs.warehouse import Warehouse

SCRIPTS = ("avf_vdn", "avf_qmix", "avf_qplex", "dec_maddrqn", "cen_maddrqn", "mac_iaicc")
COLUMNS = 120  # of the terminal in which rows are printed
MOST_FRAMES = 301  # of an animation, which takes 1 MB each in memory; overcooked needs 201
MOST_STEPS = 1_000  # of a timeline, which takes half a minute then
MOST_EPISODES = 100_000  # that are played side by side


# ---- watching an episode --------------------------------------------------------------------------------------------
class Step(NamedTuple):
    """A step of environment 0, with what was seen before and after it. Arrays are [1, ...], as of a batch of one."""

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

    frames: a list that receives its pictures, MOST_FRAMES at most, or None. probabilities: whether the networks say
    logits, which the Episode then holds as probabilities. Any other attribute is that of the batch.
    """

    def __init__(self, env, frames=None, probabilities=False):
        self.env = env
        self.frames = frames
        self.probabilities = probabilities
        self.steps = []
        self.seen = None  # the latest observation and infos of environment 0
        self.said = None  # what the agents' networks said about it, float32 [n, A]

    def __getattr__(self, name):
        return getattr(self.env, name)

    def listen(self, module, inputs, output):
        """A forward hook for the agents' networks, which run before each step."""
        values = output[0]  # [n, N, 1, A] of N environments, or [N, 1, J] of one network over J joint macro-actions
        self.said = values[:, 0, 0].detach() if values.dim() == 4 else None

    def reset(self, **options):
        obs, infos = self.env.reset(**options)
        if self.seen is None:
            self._look(obs, infos)
        return obs, infos

    def step(self, actions):
        obs, rewards, terminations, truncations, infos = self.env.step(actions)
        if not self.steps or not self.steps[-1].over[0]:  # in the first episode
            before = self.seen
            self._look(obs, infos)
            over = terminations | truncations
            self.steps.append(Step(*before, self.said, rewards[:1], terminations[:1], over[:1], *self.seen))
        return obs, rewards, terminations, truncations, infos

    def _look(self, obs, infos):
        infos_of_first = {key: value[:1] for key, value in infos.items()}
        self.seen = (obs[:1], infos_of_first)
        if self.frames is not None and len(self.frames) < MOST_FRAMES:
            self.frames.append(draw(self.env, self.frames))

    def episode(self):
        """The Episode up to now."""
        labels = list(range(self.env.n_agents))
        if isinstance(self.env, Warehouse):
            labels[-1] = ARM
        return Episode(
            labels=labels,
            names=self.env.macro_action_names,
            # An agent that is free before a step chooses. What it then runs is known after the step.
            chosen=np.concatenate([step.infos["macro_done"] for step in self.steps]),
            running=np.concatenate([step.next_infos["macro_action"] for step in self.steps]),
            rewards=np.concatenate([step.rewards for step in self.steps]),
            utilities=self._utilities(),
            meaning="probability" if self.probabilities else "utility",
        )

    def _utilities(self):
        """The utilities of the Episode, or None if one network speaks for the whole team."""
        if self.steps[0].said is None:
            return None
        said = torch.stack([step.said for step in self.steps])  # [T, n, A]
        available = np.concatenate([step.infos["available"] for step in self.steps])
        utilities = torch.where(torch.from_numpy(available), said, -torch.inf)
        if self.probabilities:
            utilities = utilities.softmax(2)
        return utilities.numpy()


def draw(env, earlier):
    """A picture of environment 0, a Pillow image with at most 256 colours. earlier: those before it, a list."""
    try:
        pixels = env._draw(0)  # render() would draw the whole batch
    except NotImplementedError:  # a task need not draw anything
        pixels = None
    is_picture = isinstance(pixels, np.ndarray) and pixels.dtype == np.uint8 and pixels.shape[2:] == (3,)
    if not is_picture or pixels.size == 0:
        fail("--gif: _draw of this task does not give a picture, uint8 [height, width, 3]")
    picture = Image.fromarray(pixels).quantize(dither=0)
    if earlier and picture.size != earlier[0].size:
        fail("--gif: the pictures of this task have different sizes")
    return picture


def watch(script, args, learner, episodes, seed, frames=None):
    """Plays greedily: the script's results, a dict of float64 [episodes], and the Recorder of the first episode.

    frames: a list that receives the pictures of the first episode, or None.
    """
    has_actors = "critics" in learner  # then the agents' networks are actors, which say logits
    recorder = Recorder(envs.make(args.env, episodes), frames, probabilities=has_actors)
    hook = learner["agents"].register_forward_hook(recorder.listen)
    result = script.evaluate(learner["agents"], recorder, args.gamma, seed)
    hook.remove()
    return result, recorder


# ---- rows of the episode --------------------------------------------------------------------------------------------
def remember(script, args, steps):
    """The rows of an ended episode of Steps as the script's training loop and buffer make them, a structured array."""
    env = envs.make(args.env)
    buffer = script.ReplayBuffer(env, 1) if hasattr(script, "ReplayBuffer") else script.EpisodeBuffer(env)
    for step in steps:
        buffer.begin_rows(step.obs, step.infos, step.next_infos["macro_action"], step.infos["macro_done"])
        state = [step.infos["state"]] if "state" in buffer.running.dtype.names else []  # only mixers need it
        discount = np.where(step.terminated, 0.0, args.gamma)
        buffer.add_step(*state, args.reward_scale * step.rewards, discount)
    buffer.end_episodes(steps[-1].over, steps[-1].next_obs, steps[-1].next_infos)
    return buffer.ended[0]  # the only episode in it


def describe_rows(script, args, recorder, first, last):
    """Lines of at most COLUMNS characters: the rows from one number to another as the script's replay buffer holds
    them (Fig. 2 of the paper), each with a line for every agent. The final row is the end of the episode.

    Raises:
        ValueError: the episode has no such rows.
    """
    rows = remember(script, args, recorder.steps)
    episode = recorder.episode()
    times = [*episode.rows(), len(episode.rewards)]
    final = len(times) - 1
    if last > final:
        raise ValueError(f"the episode has rows 0 to {final}")
    wide = 2 + max(len(name) for names in episode.names for name in names)
    lines = [
        "since: the row at which the agent chose its macro-action; if it is an earlier one, the agent is ongoing here",
        f"r: rewards until the next row, discounted and summed, times --reward-scale {args.reward_scale:g}",
        "discount: gamma^tau of the next row's value, 0 at a terminal end",
        "",
        f"{'row':>4}{'t':>5}{'tau':>5}{'r':>10}{'discount':>10} | {'agent':6}{'runs':{wide}}since  {'here':9}last saw",
    ]
    for row in range(first, last + 1):
        left = f"{row:4}{times[row]:5}"
        if row == final:
            left += f"{'end':>5}"
        else:
            tau = times[row + 1] - times[row]
            left += f"{tau:5}{rows['reward'][row]:10.4f}{rows['discount'][row]:10.4f}"
        for agent, label in enumerate(episode.labels):
            since = rows["since"][row, agent]
            name = episode.names[agent][rows["action"][row, agent]]
            here = "chosen" if since == row else "ongoing"
            if row == final:
                name = "-"
                here = "free"
            obs = rows["obs"][row, agent, : recorder.env.obs_sizes[agent]]
            saw = " ".join(f"{round(number, 2) + 0.0:g}" for number in obs.tolist())  # + 0.0: not -0
            lines.append(f"{left:34} | {label:<6}{name:{wide}}{since:5}  {here:9}{saw}")
            left = ""
    return [line if len(line) <= COLUMNS else line[: COLUMNS - 4] + " ..." for line in lines]


# ---- the run --------------------------------------------------------------------------------------------------------
def fail(message):
    """Ends the program with one line."""
    raise SystemExit(f"play: {message}")


def reason(error):
    """An error in one line: its class and the end of its message."""
    lines = str(error).strip().splitlines()
    return ": ".join([type(error).__name__, *lines[-1:]])


def read_model(path):
    """Algorithm, settings, networks and training step of a model that a script saved. No code of the file runs."""
    if not path.is_file():  # to read from a pipe could take for ever
        fail(f"there is no model {path}")
    try:
        with zipfile.ZipFile(path) as archive:
            if archive.testzip():  # the name of a part whose checksum is wrong
                raise zipfile.BadZipFile
        saved = torch.load(path, map_location="cpu", weights_only=True)
        return saved["algorithm"], dict(saved["args"]), saved["networks"], int(saved["step"])
    except OSError as error:
        fail(error)
    except Exception:  # of many classes; some messages of torch advise to load the file unsafely
        fail(f"{path} is damaged, or not the model of a script")


def load_run(folder, name, env=None):
    """A run folder's script and Args (on the CPU), the learner with its "best" or "last" model, and its training step.

    env: the run's task. It has to be given if it is a "module:id".
    """
    path = Path(folder) / f"{name}.pt"
    algorithm, settings, networks, step = read_model(path)
    if algorithm not in SCRIPTS:
        fail(f"{path} is of {algorithm!r}, which is none of {' '.join(SCRIPTS)}")
    script = importlib.import_module(algorithm)
    differing = settings.keys() ^ {field.name for field in dataclasses.fields(script.Args)}
    if differing:
        fail(f"{path} is of another version of {algorithm}.py: {sorted(map(str, differing))} differ")
    saved_env = str(settings["env"])
    if env is None and ":" in saved_env:
        fail(f"{path} names a module, which is imported only if you add --env {saved_env!r}")
    if env not in (None, saved_env):
        fail(f"{path} is of the task {saved_env!r}, not of {env!r}")
    try:
        args = script.Args(**{**settings, "device": "cpu"})
        learner = script.make_learner(args, envs.make(args.env))
        learner.load_state_dict(networks)
    except (Exception, SystemExit) as error:  # a setting out of range, or what a task of one's own raises
        fail(f"{path} does not fit its settings: {reason(error)}")
    return script, args, learner, step


# ---- the command line -----------------------------------------------------------------------------------------------
def write(path, save):
    """Writes to the path what `save` writes into a stream. A failure leaves what was there."""
    # A new file beside it takes its place when it is complete.
    new = Path(f"{path}.new")
    content = io.BytesIO()
    try:
        save(content)
        new.unlink(missing_ok=True)  # it could be a pipe
        new.write_bytes(content.getvalue())
        new.replace(path)
    except Exception as error:  # such as a full disk, or a timeline that is too high for a PNG
        fail(f"cannot write {path}: {error}")
    finally:
        with suppress(OSError):
            new.unlink()  # what is left of a failure


def span(words):
    """The two numbers of "A-B", or None for anything else."""
    match = re.fullmatch("([0-9]{1,9})-([0-9]{1,9})", words)
    return (int(match[1]), int(match[2])) if match else None


def parse_args(argv=None):
    """The command line; its errors are one line."""
    summary = __doc__.partition("\n")[0]
    parser = argparse.ArgumentParser(prog="play.py", description=summary, allow_abbrev=False)
    parser.error = fail
    add = parser.add_argument
    add("run", help="folder of a run of any script")
    add("--env", help="the run's task; needed if it is a module:id, which is then imported")
    add("--episodes", type=int, default=100, help="how many to play (default: 100)")
    add("--model", choices=("best", "last"), default="best", help="which saved model (default: best)")
    add("--seed", type=int, help="of the episodes, from 0 on (default: that of the run)")
    add("--gif", metavar="FILE", help=f"animate the first episode, up to {MOST_FRAMES - 1} steps")
    add("--timeline", metavar="FILE", help="draw its macro-actions and rows (.png, .svg or .pdf)")
    add("--rows", metavar="A-B", help="print its rows A to B as the replay buffer holds them")
    add("--steps", metavar="A-B", help="with --timeline: only time A to B, enlarged, with utilities")
    options = parser.parse_args(argv)
    if not 1 <= options.episodes <= MOST_EPISODES:
        fail(f"--episodes must be from 1 to {MOST_EPISODES}, got {options.episodes}")
    if options.seed is not None and options.seed < 0:
        fail(f"--seed must not be negative, got {options.seed}")
    for path, kinds in ((options.gif, [".gif"]), (options.timeline, [".png", ".svg", ".pdf"])):
        if path is None:
            continue
        if Path(path).suffix.lower() not in kinds or not Path(path).parent.is_dir():
            fail(f"cannot write {path}: it has to be a {' or '.join(kinds)} file in a folder that exists")
    if options.steps is not None:
        if not options.timeline:
            fail("--steps needs --timeline")
        options.steps = span(options.steps)
        if options.steps is None or options.steps[0] >= options.steps[1]:
            fail("--steps must be two times, the second after the first, such as 0-40")
    if options.rows is not None:
        options.rows = span(options.rows)
        if options.rows is None or options.rows[0] > options.rows[1]:
            fail("--rows must be two rows, the second not before the first, such as 0-8")
    return options


def main(argv=None):
    """Plays, prints and writes what the command line asks for."""
    options = parse_args(argv)
    torch.set_num_threads(1)  # fastest for networks of this size
    script, args, learner, step = load_run(options.run, options.model, options.env)
    seed = args.seed if options.seed is None else options.seed
    frames = [] if options.gif else None
    try:
        result, recorder = watch(script, args, learner, options.episodes, seed, frames)
    except Exception as error:  # a task of one's own may raise anything
        fail(f"{args.env} cannot be played: {reason(error)}")
    episode = recorder.episode()
    length = len(episode.rewards)
    first, last = options.steps or (0, length)
    if last > length:
        fail(f"--steps {first}-{last} is out of range: the episode has {length} steps")
    if options.timeline and last - first > MOST_STEPS:
        fail(f"--timeline can show {MOST_STEPS} steps, the episode has {length}: choose some with --steps")
    rows = []
    if options.rows:
        try:
            rows = describe_rows(script, args, recorder, *options.rows)
        except ValueError as error:
            fail(f"--rows {options.rows[0]}-{options.rows[1]} is out of range: {error}")

    print(f"{args.env} {script.__name__} {options.model} model of step {step}: {options.episodes} greedy episodes")
    for key, value in result.items():
        error = value.std(ddof=1) / len(value) ** 0.5 if len(value) > 1 else np.nan
        print(f"{key.replace('_', ' '):17s} {value.mean():9.3f} +- {error:.3f} (standard error)")
    if rows:
        print("", *rows, sep="\n")
    if options.gif and len(frames) <= length:
        print(f"{options.gif} ends at time {len(frames) - 1} of {length}, since a longer one would be too large")
    print(end="", flush=True)  # a full disk is noticed here
    if options.gif:
        times = [150] * (len(frames) - 1) + [1500]  # milliseconds
        animation = {"save_all": True, "append_images": frames[1:], "duration": times, "loop": 0}
        write(options.gif, lambda file: frames[0].save(file, "GIF", **animation))
    if options.timeline:
        import timeline  # here, since it takes a while to import matplotlib

        end = ", success" if result["success"][0] else ""
        facts = f"A greedy episode of {length} steps, {len(episode.rows())} of them rows: "
        facts += f"return {result['return'][0]:.4g}{end}"
        figure = timeline.draw(episode, f"{args.env}, {script.__name__}", facts, options.steps)
        kind = Path(options.timeline).suffix.lower().removeprefix(".")
        write(options.timeline, lambda file: timeline.save(figure, file, kind))


if __name__ == "__main__":
    if sys.stdout is not None:  # None if it is closed
        sys.stdout.reconfigure(errors="replace")  # letters that the terminal lacks become question marks
    try:
        main()
    except KeyboardInterrupt:
        sys.exit(130)
    except OSError as error:
        os.dup2(os.open(os.devnull, os.O_WRONLY), 1)  # Python flushes standard output once more when it exits
        if not isinstance(error, BrokenPipeError):  # what reads it, such as head, has seen enough
            fail(error)
