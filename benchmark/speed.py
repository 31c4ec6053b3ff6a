"""How fast environments and scripts are on this machine, and whether a change made them slower.

    python benchmark/speed.py -o before.csv               a table, and a file of it
    python benchmark/speed.py --compare before.csv        the table with ratios; exit code 1 beyond --tolerance
    python benchmark/speed.py --against ../other-checkout  update and train of the scripts here and there, in turn

    env      a step of one environment with random macro-actions, drawn before; resets included
    act      what a script takes to choose for one environment, at the default number of environments
    update   a gradient update: a training run less the same without updates, by their number. Mac-IAICC learns from
             whole episodes: its update is what it spends on learning for each environment step
    train    an environment step of a training run that updates as often as by default, less the start of the program

Times are CPU seconds of one thread, so programs beside it that want the processor do not count; the fastest of several
rounds counts. A file has them as multiples of a fixed reference workload that was measured in turn with them, because a
processor that is slower for the moment changes both. Training is measured through the command line, so the other
checkout may be of any age; what takes little of a run, such as the updates of Mac-IAICC, needs more --steps.
"""

import argparse
import os
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
import pandas as pd
import torch

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))  # run as a script, Python looks in this folder only

import envs
from benchmark import record

TRAINED = ("wtd-s", "bp-10", "ct-10")
BATCHES = (1, 32, 256)
CALLS = 200
SHORT = 5  # times as many rounds as of training runs: noise weighs more on what takes a fraction of a second


def fail(message):
    """Ends the program with one line."""
    raise SystemExit(f"speed: {message}")


def reference_workload():
    """A fixed piece of work of the kinds that are measured: short NumPy operations, small products with gradients."""
    x, index = np.linspace(0.0, 1.0, 600).reshape(200, 3), np.arange(200) % 50
    weight = torch.full((3, 64, 192), 0.01, requires_grad=True)
    hidden = torch.full((3, 64, 64), 0.5)
    for _ in range(60):
        for _ in range(30):
            y = np.where(x > 0.5, x.take(index, axis=0), -x)
            (y * y).sum(1)
        gates = torch.bmm(hidden, weight).chunk(3, 2)
        torch.lerp(torch.tanh(gates[0]), hidden, torch.sigmoid(gates[1])).sum().backward()


def cpu_seconds(function, *arguments):
    """CPU seconds of this process and of those that it started and waited for, in a call."""

    def now():
        children = resource.getrusage(resource.RUSAGE_CHILDREN)
        return time.process_time() + children.ru_utime + children.ru_stime

    start = now()
    function(*arguments)
    return now() - start


def play(env, actions):
    """Takes the steps of actions, int [steps, N, n], from a reset on; returns the last obs and infos."""
    obs, infos = env.reset(seed=0)
    for action in actions:
        obs, _, terminations, truncations, infos = env.step(action)
        if (over := terminations | truncations).any():
            obs, infos = env.reset(options={"reset_mask": over})
    return obs, infos


def stepping(env_id, num_envs, steps=CALLS):
    """A function that takes steps, and its environments."""
    env = envs.make(env_id, num_envs)
    actions = np.random.default_rng(0).integers(env.n_actions, size=(steps, num_envs, env.n_agents))
    return lambda: play(env, actions), env


def acting(script, env_id):
    """A function that chooses CALLS times, and the environments for which it does."""
    args = script.parse_args([f"--env={env_id}"])
    some_steps, env = stepping(env_id, args.num_envs, 10)
    obs, infos = some_steps()  # agents decide at different times now
    agents, rng = script.make_learner(args, env)["agents"], np.random.default_rng(0)
    hidden = agents.start(args.num_envs)
    return lambda: [script.act(agents, obs, infos, hidden, 0.5, rng) for _ in range(CALLS)], env


def train(checkout, name, flags):
    """Runs a script of a checkout, in a process of its own."""
    with tempfile.TemporaryDirectory() as folder:
        command = [sys.executable, f"{name}.py", f"--runs-dir={folder}", *(f"--{k}={v}" for k, v in flags.items())]
        threads = os.environ | {"OMP_NUM_THREADS": "1"}
        done = subprocess.run(command, cwd=checkout, env=threads, capture_output=True, text=True, check=False)
    if done.returncode:
        fail(f"{checkout}/{name}.py: {(done.stderr.strip().splitlines() or ['no output'])[-1]}")


def training(checkouts, name, env_id, steps, rounds):
    """Seconds of an update and of a step of training, {measure: float64 [rounds, checkouts]}, and the reference's."""
    args = record.load_script(name).parse_args([f"--env={env_id}"])
    common = {"env": env_id, "total-timesteps": steps, "eval-frequency": 10**9, "eval-episodes": 1,
              "checkpoint-frequency": 10**9}  # fmt: skip
    if hasattr(args, "train_frequency"):
        updates, common["train-frequency"] = steps // args.train_frequency, args.train_frequency
        idle, learning = {"learning-starts": steps}, {"learning-starts": 0}
    else:  # an actor-critic learns from every batch of episodes: it does not where the batch is never full
        updates, idle, learning = steps, {"batch-size": steps}, {}
    seconds, reference = np.zeros((3, rounds, len(checkouts))), np.zeros(rounds)
    for i in range(rounds):
        reference[i] = cpu_seconds(reference_workload)
        for k, flags in enumerate((common | {"total-timesteps": 1}, common | idle, common | learning)):
            for j, checkout in enumerate(checkouts):
                seconds[k, i, j] = cpu_seconds(train, checkout, name, flags)
    begin, without, total = seconds
    return {"update": (total - without) / updates, "train": (total - begin) / steps}, reference


def measure(names, env_ids, steps, rounds):
    """Yields (name of a measure, seconds each, the same in reference workloads) of all that is asked for."""

    def short(name, function, env):
        pairs = [(cpu_seconds(reference_workload), cpu_seconds(function)) for _ in range(SHORT * rounds)]
        reference, seconds = np.min(pairs, axis=0)
        seconds /= CALLS * env.num_envs
        return f"{name} x {env.num_envs}", seconds, seconds / reference

    for env_id in env_ids or envs.IDS:
        for num_envs in BATCHES:
            yield short(f"env {env_id}", *stepping(env_id, num_envs))
    for name in names:
        for env_id in env_ids or TRAINED:
            yield short(f"act {name} {env_id}", *acting(record.load_script(name), env_id))
            found, reference = training([record.ROOT], name, env_id, steps, rounds)
            for kind, seconds in found.items():
                yield f"{kind} {name} {env_id}", seconds.min(), seconds.min() / reference.min()


def compare_checkouts(other, names, env_ids, steps, rounds):
    """Prints update and train here and in the other checkout."""
    print(f"{'measure':30} {'ms here':>9} {'there':>9} {'ratio':>7}  median of the rounds' ratios (lowest to highest)")
    for name in names:
        for env_id in env_ids or TRAINED:
            for kind, x in training([record.ROOT, other], name, env_id, steps, rounds)[0].items():
                (here, there), ratios = 1000 * x.min(axis=0), x[:, 0] / x[:, 1]
                row = f"{kind + ' ' + name + ' ' + env_id:30} {here:9.4f} {there:9.4f} {here / there:7.3f}"
                print(f"{row}  {np.median(ratios):.3f} ({ratios.min():.3f} to {ratios.max():.3f})", flush=True)


def main(argv=None):
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.error = fail
    add = parser.add_argument
    add("--scripts", nargs="*", default=record.scripts(), choices=record.scripts(), metavar="NAME", help="default: all")
    add("--envs", nargs="+", choices=envs.IDS, metavar="ID", help=f"default: all; of scripts {' '.join(TRAINED)}")
    add("--steps", type=int, default=10_000, help="environment steps of a training run (%(default)s)")
    add("--rounds", type=int, default=3, help="of training runs (%(default)s); 5 times as many of what is short")
    add("-o", "--output", type=Path, help="file to write")
    add("--compare", metavar="FILE", type=Path, help="such a file to compare with")
    add("--tolerance", type=float, default=1.3, help="ratio beyond which that fails (%(default)s)")
    add("--against", metavar="FOLDER", type=Path, help="another checkout to compare with")
    args = parser.parse_args(argv)
    if min(args.steps, args.rounds) < 1 or not args.tolerance > 0:
        fail("--steps and --rounds must be at least 1 and --tolerance above 0")
    selected = args.scripts, args.envs, args.steps, args.rounds
    if args.against:
        if not args.against.is_dir():
            fail(f"--against {args.against} is no folder")
        return compare_checkouts(args.against.resolve(), *selected)
    before = pd.Series(dtype=float)
    if args.compare:
        try:
            table = pd.read_csv(args.compare, index_col="measure")
            before, steps = table["relative"].astype(float), set(table["steps"])
        except (OSError, ValueError, KeyError) as error:
            fail(f"{args.compare} is not such a file: {error}")
        if steps != {args.steps}:
            fail(f"{args.compare} was measured with other --steps")
    torch.set_num_threads(1)
    rows, slower = [], []
    print(f"{'measure':34} {'per second':>11} {'ms each':>10} {'now / before':>13}")
    for name, seconds, relative in measure(*selected):
        rows.append({"measure": name, "seconds": seconds, "relative": relative, "steps": args.steps})
        ratio = relative / before.get(name, np.nan)
        print(f"{name:34} {1 / seconds:11,.0f} {1000 * seconds:10.4f} {ratio:13.2f}", flush=True)
        slower += [name] if ratio > args.tolerance else []
    if args.output:
        try:
            pd.DataFrame(rows).to_csv(args.output, index=False)
        except OSError as error:
            fail(f"cannot write {args.output}: {error}")
    if slower:
        raise SystemExit(f"more than {args.tolerance} times as long: {', '.join(slower)}")


if __name__ == "__main__":
    main()
