"""How fast the scripts and the environments are on this machine.

    python benchmark/speed.py                               a table
    python benchmark/speed.py --against ../other-checkout   update and train here and there, in turn

    act      a script's choice for one environment
    env      a step of one environment, with random macro-actions; resets included
    update   a gradient update: training less training without updates; of Mac-IAICC, an environment step's share
    train    an environment step of training that updates as often as by default, less the start of the program

CPU milliseconds of one thread, the median of several rounds. Training goes through the command line, so the other
checkout may be of any age; what takes little of a run, such as the updates of Mac-IAICC, needs more --steps.
"""

import argparse
import itertools
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

CALLS = 200


def acting(script, args, rounds):
    """Seconds of a choice and of a step for one environment, by measure: float64 [rounds, 1]. args: the script's."""
    env, rng = envs.make(args.env, args.num_envs), np.random.default_rng(0)
    agents, seconds = script.make_learner(args, env)["agents"], np.zeros((2, rounds, 1))
    for i in range(rounds):
        (obs, infos), hidden = env.reset(seed=0), agents.start(args.num_envs)
        for _ in range(CALLS):
            start = time.process_time()
            actions, hidden = script.act(agents, obs, infos, hidden, 1.0, rng)
            chosen = time.process_time()
            obs, _, terminations, truncations, infos = env.step(actions)
            if (over := terminations | truncations).any():
                obs, infos = env.reset(options={"reset_mask": over})
            seconds[:, i, 0] += chosen - start, time.process_time() - chosen
    return dict(zip(("act", "env"), seconds / (CALLS * args.num_envs), strict=True))


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


def training(checkouts, name, args, steps, rounds):
    """Seconds of an update and of a step of training, by measure: float64 [rounds, checkouts]. args: the script's."""
    common = {"env": args.env, "num-envs": args.num_envs, "total-timesteps": steps, "eval-episodes": 1}
    common |= {"eval-frequency": 10**9, "checkpoint-frequency": 10**9}
    if hasattr(args, "train_frequency"):
        updates, common["train-frequency"] = steps // args.train_frequency, args.train_frequency
        idle, learning = {"learning-starts": steps}, {"learning-starts": 0}
    else:  # an actor-critic learns from every batch of episodes: it does not where the batch is never full
        updates, idle, learning = steps, {"batch-size": steps}, {}
    runs = common | {"total-timesteps": 1}, common | idle, common | learning
    seconds = [[[run(checkout, name, flags) for checkout in checkouts] for flags in runs] for _ in range(rounds)]
    begin, without, total = np.moveaxis(seconds, 1, 0)
    return {"update": (total - without) / updates, "train": (total - begin) / steps}


def main(argv=None):
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.error = lambda message: sys.exit(f"speed: {message}")
    add, tasks = parser.add_argument, ["wtd-s", "bp-10", "ct-10"]
    add("--scripts", nargs="+", default=record.scripts(), choices=record.scripts(), metavar="NAME", help="default: all")
    add("--envs", nargs="+", default=tasks, choices=envs.IDS, metavar="ID", help=f"default: {' '.join(tasks)}")
    add("--num-envs", type=int, help="environments side by side (default: the script's)")
    add("--steps", type=int, default=10_000, help="environment steps of a training run (default: %(default)s)")
    add("--rounds", type=int, default=3, help="default: %(default)s")
    add("--against", metavar="FOLDER", type=Path, help="another checkout to compare with")
    args = parser.parse_args(argv)
    if min(args.steps, args.rounds, 1 if args.num_envs is None else args.num_envs) < 1:
        sys.exit("speed: --num-envs, --steps and --rounds must be at least 1")
    if args.against and not args.against.is_dir():
        sys.exit(f"speed: --against {args.against} is no folder")
    torch.set_num_threads(1)
    print(f"{'measure':34} {'ms each':>9}", f"{'there':>9}  median ratio (of all rounds)" if args.against else "")
    for name, env_id in itertools.product(args.scripts, args.envs):
        script = record.load_script(name)
        usual = script.parse_args([f"--env={env_id}"])
        usual.num_envs = args.num_envs or usual.num_envs
        checkouts = [record.ROOT, args.against] if args.against else [record.ROOT]
        measures = {} if args.against else acting(script, usual, 5 * args.rounds)
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
