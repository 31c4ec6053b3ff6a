"""How fast the scripts and the environments are on this machine.

    python benchmark/speed.py                               a table
    python benchmark/speed.py --against ../other-checkout   update and train here and there, in turn
    python benchmark/speed.py --scaling                     Capture Target of other sizes: the tables of docs/scaling.md

    act      a script's choice for one environment
    env      a step of one environment, with random macro-actions; resets included
    update   a gradient update: training less training without updates; of Mac-IAICC, an environment step's share
    train    an environment step of training that updates as often as by default, without the start of the program

CPU milliseconds of one thread, the median of several rounds. Training goes through the command line, so the other
checkout may be of any age. A run plays one episode in each environment first, so that there is something to learn
from, and then takes --steps. What takes little of a run, such as the updates of Mac-IAICC, needs more of them.

With --scaling, every measure is taken in a process of its own, with a full replay buffer: env and act as above in
microseconds, update in milliseconds (one thread, medians), then the weights of the mixer in thousands, the replay
buffer and the most memory that the process held, in MB.
"""

import argparse
import copy
import itertools
import multiprocessing
import os
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
import torch

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))  # run as a script, Python looks in this folder only

import envs
from benchmark import record
from envs.capture_target import CaptureTarget

CALLS = 200
SIZE = {"agents": 10, "envs": 32, "grid": 10, "horizon": 60}  # where nothing else is said
STATES = [("avf_vdn", None), *itertools.product(("avf_qmix", "avf_qplex"), ("joint", "decision"))]
SCALING = {  # what grows, over which values
    "agents": (2, 5, 10, 20, 50),
    "envs": (32, 128, 512, 2_048),
    "grid": (10, 20, 40),
    "horizon": (60, 120, 240),
}


def play(script, args, env, agents, steps, buffer=None):
    """Seconds of each choice and of each step, resets included, of a batch of environments, float64 [2, steps].

    args: the script's. buffer: a replay buffer that records what is played, or None.
    """
    rng = np.random.default_rng(0)
    seconds = np.zeros((2, steps))
    obs, infos = env.reset(seed=0)
    hidden = agents.start(env.num_envs)
    for i in range(steps):
        start = time.process_time()
        actions, hidden = script.act(agents, obs, infos, hidden, 1.0, rng)
        seconds[0, i] = time.process_time() - start
        if buffer:
            buffer.begin_rows(obs, infos, actions, infos["macro_done"])
        state = [infos["state"]] if hasattr(args, "mixer_state") else []  # only mixers see it
        start = time.process_time()
        obs, rewards, terminations, truncations, infos = env.step(actions)
        seconds[1, i] = time.process_time() - start
        if buffer:
            buffer.add_step(*state, rewards, np.where(terminations, 0.0, args.gamma))
        over = terminations | truncations
        if over.any():
            if buffer:
                buffer.end_episodes(over, obs, infos)
            start = time.process_time()
            obs, infos = env.reset(options={"reset_mask": over})
            seconds[1, i] += time.process_time() - start
    return seconds


def run(checkout, name, flags):
    """CPU seconds of a script of a checkout, in a process of its own."""
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    with tempfile.TemporaryDirectory() as folder:
        command = [sys.executable, f"{name}.py", f"--runs-dir={folder}", *(f"--{k}={v}" for k, v in flags.items())]
        threads = os.environ | {"OMP_NUM_THREADS": "1"}
        done = subprocess.run(command, cwd=checkout, env=threads, capture_output=True, text=True, check=False)
    if done.returncode:
        sys.exit(f"speed: {checkout}/{name}.py: {(done.stderr.strip().splitlines() or ['no output'])[-1]}")
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


def plan(name, args, steps):
    """The flags of three runs, of one step, without updates and with, their steps, updates, and updates a step.

    args: the script's. steps: how many the latter two take once every environment has ended an episode.
    """
    first = envs.make(args.env).horizon * args.num_envs  # steps after which an episode has ended everywhere
    total = first + -(-steps // args.num_envs) * args.num_envs
    common = {"env": args.env, "num-envs": args.num_envs, "total-timesteps": total, "eval-episodes": 1}
    common |= {"eval-frequency": 10**9, "checkpoint-frequency": 10**9}
    if hasattr(args, "train_frequency"):
        common["train-frequency"] = args.train_frequency
        idle = {"learning-starts": total}
        learning = {"learning-starts": first}
        updates = total // args.train_frequency - first // args.train_frequency
        updates_per_step = 1 / args.train_frequency
    else:  # an actor-critic learns from every batch of episodes: it does not where the batch is never full
        idle = {"batch-size": total}
        learning = {}
        updates = total
        updates_per_step = 1
    if not updates:
        sys.exit(f"speed: {name} makes no update in {steps} steps on {args.env}: give it more --steps")
    runs = common | {"total-timesteps": 1}, common | idle, common | learning
    return runs, total, updates, updates_per_step


def training(checkouts, name, args, steps, rounds):
    """Seconds of an update and of a step of training, by measure: float64 [rounds, checkouts]. args: the script's."""
    runs, total, updates, updates_per_step = plan(name, args, steps)
    seconds = [[[run(checkout, name, flags) for checkout in checkouts] for flags in runs] for _ in range(rounds)]
    begin, without, whole = np.moveaxis(seconds, 1, 0)
    update = (whole - without) / updates
    return {"update": update, "train": (without - begin) / total + updates_per_step * update}


def scale(name, mixer_state, size, updates):
    """The numbers of --scaling, six floats, of a script on Capture Target of a size, to be run in a process of its own.

    mixer_state: None for a script without a mixer. size: as SIZE. updates: how many are timed.
    """
    torch.set_num_threads(1)
    script = record.load_script(name)
    env_id = "ct-" + "-".join(str(size[key]) for key in ("agents", "grid", "horizon"))
    if envs.problem(env_id):
        envs.register(env_id, CaptureTarget, n_agents=size["agents"], grid=size["grid"], horizon=size["horizon"])
    args = script.parse_args([f"--env={env_id}", *([f"--mixer-state={mixer_state}"] if mixer_state else [])])
    env = envs.make(env_id, size["envs"])
    rng = np.random.default_rng(0)
    learner = script.make_learner(args, env)
    buffer = script.ReplayBuffer(env, args.buffer_size)
    playing = play(script, args, env, learner["agents"], env.horizon, buffer)
    for episode in itertools.cycle(list(buffer.ended)):  # the same ones again, until the buffer is full
        if len(buffer.ended) == args.buffer_size:
            break
        buffer.ended.append(episode.copy())
    target = copy.deepcopy(learner).requires_grad_(False)
    optimizer = torch.optim.Adam(learner.parameters(), fused=True)
    mixers = [part["mixer"] for part in (learner, target)] if mixer_state else []
    learning = []
    for _ in range(updates):  # as in `train` of the script
        start = time.process_time()
        batch = script.make_batch(buffer.sample(args.batch_size, rng))
        utilities = script.utilities_at_rows(learner["agents"], batch)
        target_utilities = script.utilities_at_rows(target["agents"], batch)
        loss, _, _ = script.td_loss(utilities, target_utilities, *mixers, batch, args)
        optimizer.zero_grad()
        loss.backward()
        torch.nn.utils.clip_grad_norm_(learner.parameters(), args.max_grad_norm)
        optimizer.step()
        for slow, fast in zip(target.parameters(), learner.parameters(), strict=True):
            slow.lerp_(fast.detach(), 1 - args.polyak)
        learning.append(time.process_time() - start)
    weights = sum(x.numel() for x in mixers[0].parameters()) if mixers else 0
    replay = buffer.running.nbytes + sum(episode.nbytes for episode in buffer.ended)
    unit = 2**10 if sys.platform == "linux" else 1  # of ru_maxrss, in bytes
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit / 1e6
    act, step = 1e6 * np.median(playing, axis=1) / env.num_envs
    return step, act, 1e3 * np.median(learning), weights / 1e3, replay / 1e6, peak


def print_scaling(updates):
    """The tables of --scaling, in Markdown."""
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(["gymnasium", "pandas", "torch", "torch.utils.tensorboard"])  # once for all measures
    for axis, values in SCALING.items():
        titles = "script", "mixer state", axis, "env, us", "act, us", "update, ms", "mixer, k", "replay, MB", "peak, MB"
        print(f"\n| {' | '.join(titles)} |\n|{' --- |' * len(titles)}")
        for (name, mixer_state), value in itertools.product(STATES, values):
            with context.Pool(1) as pool:  # a process for each measure
                found = pool.apply(scale, (name, mixer_state, {**SIZE, axis: value}, updates))
            cells = name, mixer_state or "none", f"{value:,}", *(f"{x:,.0f}" if x >= 10 else f"{x:.1f}" for x in found)
            print("| " + " | ".join(cells) + " |", flush=True)


def count(text):
    """The number that a word is, from 1 to a million."""
    number = int(text)
    if not 1 <= number <= 1_000_000:
        raise ValueError
    return number


def main(argv=None):
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.error = lambda message: sys.exit(f"speed: {message}")
    add = parser.add_argument
    tasks = ["wtd-s", "bp-10", "ct-10"]
    add("--scripts", nargs="+", default=record.scripts(), choices=record.scripts(), metavar="NAME", help="default: all")
    add("--envs", nargs="+", default=tasks, choices=envs.IDS, metavar="ID", help=f"default: {' '.join(tasks)}")
    add("--num-envs", type=count, help="environments side by side (default: the script's)")
    add("--steps", type=count, default=10_000, help="of a training run after its first episodes (default: %(default)s)")
    add("--rounds", type=count, default=3, help="default: %(default)s")
    add("--against", metavar="FOLDER", type=record.folder, help="another checkout to compare with")
    add("--scaling", action="store_true", help="tables of cost and memory by size instead; goes with --rounds alone")
    args = parser.parse_args(argv)
    if args.scaling:
        if any(v != parser.get_default(k) for k, v in vars(args).items() if k not in ("scaling", "rounds")):
            sys.exit("speed: --scaling measures sizes of its own: only --rounds goes with it")
        return print_scaling(5 * args.rounds)
    checkouts = [record.ROOT, *([args.against] if args.against else [])]
    cells = []
    for name, env_id in itertools.product(args.scripts, args.envs):
        if not (checkouts[-1] / f"{name}.py").is_file():
            sys.exit(f"speed: there is no {checkouts[-1] / name}.py")
        usual = record.load_script(name).parse_args([f"--env={env_id}"])
        usual.num_envs = args.num_envs or usual.num_envs
        plan(name, usual, args.steps)  # what cannot be measured is told before the first measure
        cells.append((record.load_script(name), usual))
    torch.set_num_threads(1)
    print(f"{'measure':34} {'ms each':>9}", f"{'there':>9}  median ratio (of all rounds)" if args.against else "")
    for script, usual in cells:
        name = script.__name__
        env_id = usual.env
        measures = {}
        if not args.against:
            env = envs.make(env_id, usual.num_envs)
            agents = script.make_learner(usual, env)["agents"]
            means = np.mean([play(script, usual, env, agents, CALLS) for _ in range(5 * args.rounds)], axis=2)
            measures = dict(zip(("act", "env"), means.T[..., None] / usual.num_envs, strict=True))  # [rounds, 1] each
        measures |= training(checkouts, name, usual, args.steps, args.rounds)
        for kind, seconds in measures.items():
            row = f"{kind} {name} {env_id} x {usual.num_envs}"
            row = f"{row:34}" + "".join(f" {1000 * each:9.4f}" for each in np.median(seconds, axis=0))
            if args.against:
                ratios = seconds[:, 0] / seconds[:, 1]
                row += f"  {np.median(ratios):.3f} ({ratios.min():.3f} to {ratios.max():.3f})"
            print(row, flush=True)


if __name__ == "__main__":
    main()
