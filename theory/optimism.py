"""How optimistic must a team be to find out that the big box pays? Predicted and measured on bp-10.

    python theory/optimism.py --steps 150000 -o docs/images/optimism.png       the figure of docs/defaults.md
    python theory/optimism.py --steps 0                                        the predictions alone

With negative TD errors times beta (--hysteresis) a learned value e of a macro-action is where the weights of errors
balance, an expectile. Consider a push below the big box. With probability p the partner pushes in the same step, which
pays G. Else it costs F, and one can push again, or take the safe small boxes, worth S:

    p (G - e) = beta^2 (1 - p) (e - L),  L = gamma max(e, S) - F
    e = (p G - w F) / (p + w (1 - gamma)) where e >= S, else (p G + w (gamma S - F)) / (p + w),  w = beta^2 (1 - p)
    e > S  if and only if  beta^2 < p (G - S) / ((1 - p) (F + (1 - gamma) S))

p is counted beside a partner who plays at random, as all do in the beginning. To measure e, a team that plays at random
throughout learns with each beta. Then its utilities are read where agent 0 waits below the big box and pushes.
"""

import argparse
import contextlib
import sys
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))  # run as a script, Python looks in this folder only

import avf_qmix
import avf_vdn
import envs
from envs.box_pushing import PUSH, WAYPOINT_BIG_LEFT
from theory.picture import png

BIG = 99.6  # G: four steps to the goal row
FAILS = 10.1  # F: a push in vain
SAFE = 20.0  # S
BETAS = (0.05, 0.1, 0.2, 0.3, 0.5, 1.0)
SCRIPTS = (avf_vdn, avf_qmix)


def value(beta, p, big, fails, safe, gamma):
    """The expectile e above; floats."""
    weight = beta**2 * (1 - p)
    again = (p * big - weight * fails) / (p + weight * (1 - gamma))
    if again >= safe:
        return again
    return (p * big + weight * (gamma * safe - fails)) / (p + weight)


def bound(p, big, fails, safe, gamma):
    """The largest beta for which e > safe."""
    gain = p * (big - safe)
    loss = (1 - p) * (fails + (1 - gamma) * safe)
    return (gain / loss) ** 0.5


# ---- what happens beside a random partner ---------------------------------------------------------------------------
def push_beside_random_partner(env_id, episodes=2_000, seed=0, buffer=None):
    """Agent 0 goes below the big box and pushes at every decision, agent 1 plays at random.

    buffer: a script's replay buffer that is to hold the episodes, or None.

    Returns:
        p: successes a push.
        The share of episodes with a success.
    """
    env = envs.make(env_id, episodes)
    rng = np.random.default_rng(seed)
    obs, infos = env.reset(seed=seed)
    running = np.ones(episodes, bool)
    pushes = 0
    successes = 0
    while running.any():
        free = infos["macro_done"]
        is_there = env.last_waypoint[:, 0] == WAYPOINT_BIG_LEFT
        actions = rng.integers(env.n_actions, size=(episodes, 2))
        actions[:, 0] = np.where(is_there, PUSH, WAYPOINT_BIG_LEFT)
        pushes += (running & is_there & free[:, 0]).sum()
        state = infos["state"]
        if buffer:
            actions = np.where(free, actions, infos["macro_action"])
            buffer.begin_rows(obs, infos, actions, free)
        obs, rewards, terminations, truncations, infos = env.step(actions)
        over = terminations | truncations
        if buffer:
            state = [state] if "state" in buffer.running.dtype.names else []  # only mixers need it
            buffer.add_step(*state, rewards, np.where(terminations, 0.0, 1.0))
            buffer.end_episodes(over, obs, infos)
        successes += (running & terminations & (rewards > 50)).sum()
        running &= ~over
        obs, infos = env.reset(options={"reset_mask": over})
    return successes / pushes, successes / episodes


# ---- what a team has learned ----------------------------------------------------------------------------------------
def learned(script, args):
    """What a trained team thinks the joint value is where agent 0 pushes below the big box, and where it does not.

    args: of a run that is made here.

    Returns:
        A mean over what a random partner does, of pushing and of the best other macro-action there.
    """
    with contextlib.redirect_stdout(sys.stderr):  # train prints the folder
        folder = script.train(args)
    env = envs.make(args.env, args.num_envs)
    learner = script.make_learner(args, env)
    learner.load_state_dict(script.load(folder / "last.pt")["networks"])
    buffer = script.ReplayBuffer(env, 1_000)
    push_beside_random_partner(args.env, args.num_envs, args.seed, buffer)
    batch = script.make_batch(buffer.sample(500, np.random.default_rng(args.seed)))
    action = batch["action"]  # [B, T, n]
    pushes = batch["valid"] & batch["free"][..., 0] & (action[..., 0] == PUSH)  # [B, T]
    with torch.no_grad():
        utilities = script.utilities_at_rows(learner["agents"], batch)  # [B, T, n, A]
        other_action = torch.stack([best_other(utilities[..., 0, :]), action[..., 1]], 2)
        push = joint_values(script, args, learner, utilities, action, batch)
        other = joint_values(script, args, learner, utilities, other_action, batch)
    return push[pushes].mean().item(), other[pushes].mean().item()


def best_other(utilities):
    """The best macro-action that is not a push, from float32 [..., A]."""
    is_push = torch.arange(utilities.shape[-1]) == PUSH
    return utilities.masked_fill(is_push, -torch.inf).argmax(-1)


def joint_values(script, args, learner, utilities, actions, batch):
    """The joint values of macro-actions at the rows of a batch, float32 [B, T], in units of unscaled rewards."""
    if script is avf_vdn:
        q = script.mix(utilities, actions)
    else:
        state, _ = script.mixer_states(batch, args.mixer_state)
        q = learner["mixer"](utilities, actions, batch["available"], state)
    return q / args.reward_scale


# ---- the program ----------------------------------------------------------------------------------------------------
def parse_args(argv=None):
    """The options; errors are one line, before anything is played or trained."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.error = lambda message: sys.exit(f"optimism: {message}")
    parser.add_argument("--steps", type=int, default=150_000, help="of each run, at random (default: %(default)s)")
    parser.add_argument("--seed", type=int, default=101, help="default: %(default)s")
    parser.add_argument("-o", "--output", type=png, help="the figure, PNG")
    options = parser.parse_args(argv)
    if options.steps < 0:
        parser.error(f"--steps must not be negative, got {options.steps}")
    if options.output and not options.steps:
        parser.error("the figure of --output needs runs, and --steps 0 makes none")
    avf_qmix.parse_args(["--env=bp-10", f"--seed={options.seed}", f"--total-timesteps={options.steps or 1}"])
    return options


def main(argv=None):
    options = parse_args(argv)
    gamma = avf_qmix.parse_args(["--env=bp-10"]).gamma
    for env_id in ("bp-10", "bp-20", "bp-30"):
        p, share = push_beside_random_partner(env_id)
        highest = bound(p, BIG, FAILS, SAFE, gamma)
        print(f"{env_id}: p {p:.4f} a push, {share:.3f} an episode; bound {highest:.3f}")
    if not options.steps:
        return
    p, _ = push_beside_random_partner("bp-10")
    found = {}
    with tempfile.TemporaryDirectory() as folder:
        for script in SCRIPTS:
            for beta in BETAS:
                args = replace(
                    script.parse_args(["--env=bp-10"]),
                    seed=options.seed,
                    runs_dir=folder,
                    total_timesteps=options.steps,
                    eval_frequency=10**9,
                    learning_starts=5_000,
                    exploration_timesteps=10**9,
                    end_e=1.0,
                    hysteresis=beta,
                )
                push, other = learned(script, args)
                found[script, beta] = push, other
                predicted = value(beta, p, BIG, FAILS, other, gamma)
                print(f"{script.ALGORITHM} {beta=} push {push:.1f}, predicted {predicted:.1f}, best other {other:.1f}")
    if options.output:
        draw(found, p, gamma, options.output)


def draw(found, p, gamma, path):
    """The joint value of pushing and of the best other macro-action against beta, beside what the latter predicts."""
    import matplotlib  # optional: pip install -e '.[report]'

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(figsize=(7, 4), layout="constrained")
    axes.axvline(bound(p, BIG, FAILS, SAFE, gamma), color="0.7", label="bound")
    for k, script in enumerate(SCRIPTS):
        push, other = np.transpose([found[script, beta] for beta in BETAS])
        predicted = [value(beta, p, BIG, FAILS, o, gamma) for beta, o in zip(BETAS, other, strict=True)]
        axes.plot(BETAS, push, "o-", color=f"C{k}", label=f"{script.ALGORITHM}: push, measured")
        axes.plot(BETAS, predicted, "o--", color=f"C{k}", mfc="none", label="push, predicted")
        axes.plot(BETAS, other, "x:", color=f"C{k}", label="best other, measured")
    axes.set(xscale="log", xlabel="beta: factor on negative TD errors (--hysteresis)", ylabel="joint value")
    axes.set_xticks(BETAS, [str(beta) for beta in BETAS], minor=False)
    axes.minorticks_off()
    axes.legend(fontsize=8)
    figure.savefig(path, dpi=150)


if __name__ == "__main__":
    try:
        main()
    except OSError as error:  # a full disk
        sys.exit(f"optimism: {error}")
    except KeyboardInterrupt:
        print("optimism: stopped; what is printed stays", file=sys.stderr)
        sys.exit(130)
