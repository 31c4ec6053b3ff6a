"""How fast environments and scripts are on this machine, and whether they have become slower.

    python benchmark/speed.py                               a table: some minutes, everything
    python benchmark/speed.py -o before.json                and a baseline file
    python benchmark/speed.py --compare before.json         the table with ratios; exit code 1 beyond --tolerance

What is measured, several times in turn with a fixed reference workload, of which the fastest counts:

    env         environment steps per second with random macro-actions, which are drawn before; resets included
    act         environment steps per second that `act` can choose for, at the default number of environments
    update      gradient updates per second: a training run less the same run without updates, by the number of updates;
                rows/s are the decision rows replayed in them (Mac-IAICC replays none)
    train       environment steps per second of a training run that updates as often as by default, from the start on;
                what a run of one step costs (folder, networks, last evaluation, checkpoint) is taken off

Times are CPU seconds of this process, which uses one thread: programs beside it that want the processor do not count.
A baseline file holds every time as a multiple of that of the reference workload beside it, and ratios are those of such
multiples, because a processor that is slower for the moment, or another one, changes both. Kinds of machines differ in
more than that, so compare with a baseline of the same kind; how much of a ratio is noise, two runs of the same code
tell.
"""

import argparse
import contextlib
import importlib
import io
import json
import sys
import tempfile
import time
from dataclasses import fields
from pathlib import Path

import numpy as np
import torch

sys.path.insert(0, str(Path(__file__).parents[1]))  # run as a script, Python looks in this folder only

import envs

SCRIPTS = tuple(sorted(path.stem for path in Path(__file__).parents[1].glob("*.py")))
TRAINED = ("wtd-s", "bp-10", "ct-10")
BATCHES = (1, 32, 256)
CALLS = 200
SHORT = 5  # times as often as training runs: noise weighs more on what takes a fraction of a second


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


def fastest(repeats, *functions):
    """Lowest CPU seconds of the reference workload and of each function, called in turn: float64 [1 + functions]."""

    def seconds(function):
        start = time.process_time()
        function()
        return time.process_time() - start

    return np.min([[seconds(f) for f in (reference_workload, *functions)] for _ in range(repeats)], axis=0)


def play(env, actions):
    """Takes the steps of actions, int [steps, N, n], from a reset on; returns the last obs and infos."""
    obs, infos = env.reset(seed=0)
    for action in actions:
        obs, _, terminations, truncations, infos = env.step(action)
        over = terminations | truncations
        if over.any():
            obs, infos = env.reset(options={"reset_mask": over})
    return obs, infos


def measure_env(env_id, num_envs, repeats):
    """{name: entry of an environment step}."""
    env, rng = envs.make(env_id, num_envs), np.random.default_rng(0)
    actions = rng.integers(env.n_actions, size=(CALLS, num_envs, env.n_agents))
    reference, seconds = fastest(SHORT * repeats, lambda: play(env, actions))
    return {f"env {env_id} x {num_envs}": entry(seconds / (CALLS * num_envs), reference)}


def measure_act(script, env_id, repeats):
    """As measure_env, of one environment's macro-actions; half of them random."""
    args = script.defaults(env_id)
    env, rng = envs.make(env_id, args.num_envs), np.random.default_rng(0)
    agents = script.make_learner(args, env)[0]["agents"]
    # After a few steps agents decide at different times.
    obs, infos = play(env, rng.integers(env.n_actions, size=(10, args.num_envs, env.n_agents)))

    def choose():
        hidden = agents.start(args.num_envs)
        for _ in range(CALLS):
            _, hidden = script.act(agents, obs, infos, hidden, 0.5, rng)

    reference, seconds = fastest(SHORT * repeats, choose)
    name = f"act {script.ALGORITHM} {env_id} x {args.num_envs}"
    return {name: entry(seconds / (CALLS * args.num_envs), reference)}


def measure_training(script, env_id, steps, repeats):
    """As measure_env, of an update (with the mean number of rows in it) and of a step of training."""
    common = dict(total_timesteps=steps, eval_frequency=10**9, eval_episodes=1, checkpoint_frequency=10**9)
    replays = "window" in {field.name for field in fields(script.Args)}
    # An actor-critic learns from every batch of episodes: it does not where the batch is never full.
    learning, idle = ({"learning_starts": 0}, {"learning_starts": steps}) if replays else ({}, {"batch_size": steps})
    saved = {}

    with tempfile.TemporaryDirectory() as folder, contextlib.redirect_stderr(io.StringIO()):

        def run(**options):
            args = script.defaults(env_id, runs_dir=folder, **{**common, **options})
            saved.update(torch.load(script.train(args) / "checkpoint.pt", weights_only=True))
            if saved["step"] < args.total_timesteps:
                raise KeyboardInterrupt  # which train takes as a wish to stop

        run(total_timesteps=1)  # the first of a process imports things
        reference, begin, without, total = fastest(
            repeats, lambda: run(total_timesteps=1), lambda: run(**idle), lambda: run(**learning)
        )
    measures = {f"train {script.ALGORITHM} {env_id}": entry((total - begin) / saved["step"], reference)}
    if saved["updates"] and total > without:  # else the run was too short to tell
        rows = None
        if replays:
            args = script.defaults(env_id)
            buffer, rng = script.make_learner(args, envs.make(env_id, args.num_envs))[1], np.random.default_rng(0)
            buffer.load(saved["buffer"])
            rows = np.mean([buffer.sample(args.batch_size, args.window, rng).valid.sum() for _ in range(20)]).item()
        update = entry((total - without) / saved["updates"], reference, rows)
        measures[f"update {script.ALGORITHM} {env_id}"] = update
    return measures


def entry(seconds, reference, rows=None):
    """What is kept of a measure: seconds each, the same in reference workloads, rows replayed each (None: none)."""
    return {"seconds": seconds, "relative": seconds / reference, "rows": rows}


def measure(scripts, env_ids, steps, repeats):
    """Yields {name: entry} for all that is asked for; env_ids None: every environment, and the scripts on TRAINED."""
    for env_id in env_ids or envs.IDS:
        for num_envs in BATCHES:
            yield measure_env(env_id, num_envs, repeats)
    for name in scripts:
        script = importlib.import_module(name)
        for env_id in env_ids or TRAINED:
            yield measure_act(script, env_id, repeats)
            yield measure_training(script, env_id, steps, repeats)


def verdict(ratio):
    """Time now by time before, in words."""
    return f"x{ratio:.2f} slower" if ratio >= 1 else f"x{1 / ratio:.2f} faster"


def main(argv=None):
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--scripts", nargs="*", default=SCRIPTS, choices=SCRIPTS, metavar="NAME", help="scripts (all)")
    parser.add_argument("--envs", nargs="+", choices=envs.IDS, metavar="ID",
                        help=f"tasks (environments: all; scripts: {' '.join(TRAINED)})")  # fmt: skip
    parser.add_argument("--steps", type=int, default=10_000, help="environment steps of a training run (%(default)s)")
    parser.add_argument(
        "--repeats",
        type=int,
        default=3,
        help=f"of a training run (%(default)s); {SHORT} times as many of what is short",
    )
    parser.add_argument("-o", "--output", help="baseline file to write")
    parser.add_argument("--compare", metavar="FILE", help="baseline file to compare with")
    parser.add_argument("--tolerance", type=float, default=1.3, help="ratio beyond which it fails (%(default)s)")
    args = parser.parse_args(argv)
    if min(args.steps, args.repeats) < 1 or not args.tolerance > 0:
        parser.error("--steps and --repeats must be at least 1 and --tolerance above 0")
    before = None
    if args.compare:
        try:
            baseline = json.loads(Path(args.compare).read_text())
            before = {name: float(x["relative"]) for name, x in baseline["measures"].items()}
            steps = baseline["steps"]
        except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
            parser.error(f"{args.compare} is not a baseline file: {type(error).__name__}: {error}")
        if steps != args.steps:
            parser.error(f"{args.compare} was measured with --steps {steps}")

    torch.set_num_threads(1)
    measures, slower = {}, []
    print(f"{'measure':34} {'per second':>11} {'ms each':>10} {'rows/s':>9}" + "  against the baseline" * bool(before))
    for found in measure(args.scripts, args.envs, args.steps, args.repeats):
        measures |= found
        for name, x in found.items():
            rows = f"{x['rows'] / x['seconds']:,.0f}" if x["rows"] else ""
            row = f"{name:34} {1 / x['seconds']:11,.0f} {1000 * x['seconds']:10.4f} {rows:>9}"
            if before is not None:
                ratio = x["relative"] / before[name] if name in before else None
                row += f"  {verdict(ratio) if ratio else 'not in the baseline'}"
                slower += [name] if ratio and ratio > args.tolerance else []
            print(row, flush=True)
    if args.output:
        try:
            Path(args.output).write_text(json.dumps({"steps": args.steps, "measures": measures}, indent=1) + "\n")
        except OSError as error:
            parser.error(f"cannot write {args.output}: {error.strerror}")
    if before is not None and not measures.keys() & before.keys():
        parser.error(f"{args.compare} has none of these measures")
    if slower:
        raise SystemExit(f"more than x{args.tolerance} slower: {', '.join(slower)}")


if __name__ == "__main__":
    main()
