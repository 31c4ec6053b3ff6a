"""How optimistic must a team be to find out that the big box pays? Predicted and measured on bp-10.

    python theory/optimism.py --steps 150000 -o docs/images/optimism.png       the figure of docs/defaults.md
    python theory/optimism.py --steps 0                                        the predictions alone

With negative TD errors times beta (--hysteresis) a learned value e of a macro-action is where the weights of errors
balance, an expectile. Push below the big box: with probability p the partner pushes in the same step, which pays G;
else it costs F, and one can push again, or take the safe small boxes, worth S:

    p (G - e) = beta^2 (1 - p) (e - L),  L = gamma max(e, S) - F
    e = (p G - w F) / (p + w (1 - gamma)) where e >= S, else (p G + w (gamma S - F)) / (p + w),  w = beta^2 (1 - p)
    e > S  if and only if  beta^2 < p (G - S) / ((1 - p) (F + (1 - gamma) S))

p is counted beside a partner who plays at random, as all do in the beginning. Measured: a team that plays at random
throughout learns with each beta; then its utilities are read where agent 0 waits below the big box and pushes.
"""

import argparse
import sys
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

sys.path.insert(0, str(Path(__file__).parents[1]))  # run as a script, Python looks in this folder only

import avf_qmix
import avf_vdn
import envs
from envs.box_pushing import PUSH, WAYPOINT_BIG_LEFT

BIG, FAILS = 99.6, 10.1  # four steps to the goal row; a push in vain
BETAS = 0.05, 0.1, 0.2, 0.3, 0.5, 1.0


def value(beta, p, big, fails, safe, gamma):
    """The expectile e above; floats."""
    weight = beta**2 * (1 - p)
    again = (p * big - weight * fails) / (p + weight * (1 - gamma))
    return again if again >= safe else (p * big + weight * (gamma * safe - fails)) / (p + weight)


def bound(p, big, fails, safe, gamma):
    """The largest beta for which e > safe."""
    return (p * (big - safe) / ((1 - p) * (fails + (1 - gamma) * safe))) ** 0.5


def push_beside_random_partner(env_id, episodes=2_000, seed=0, buffer=None):
    """Agent 0 goes below the big box and pushes at every decision, agent 1 plays at random; notes what happens in a
    replay buffer, if there is one. Returns p: successes a push, and the share of episodes with a success."""
    env, rng = envs.make(env_id, episodes), np.random.default_rng(seed)
    (obs, infos), live = env.reset(seed=seed), np.ones(episodes, bool)
    pushes = successes = 0
    while live.any():
        actions = rng.integers(env.n_actions, size=(episodes, 2))
        there = env.last_waypoint[:, 0] == WAYPOINT_BIG_LEFT
        actions[:, 0] = np.where(there, PUSH, WAYPOINT_BIG_LEFT)
        pushes += (live & there & env.macro_done[:, 0]).sum()
        if buffer:
            actions = np.where(infos["macro_done"], actions, infos["macro_action"])
            state = (infos["state"],) if hasattr(buffer, "state") else ()
            buffer.add(obs, actions, infos["macro_done"], *state)
        obs, rewards, terminations, truncations, infos = env.step(actions)
        over = terminations | truncations
        if buffer:
            buffer.step(*state, rewards, 1.0 * ~terminations, over, obs, infos)
        successes += (live & terminations & (rewards > 50)).sum()
        live &= ~over
        obs, infos = env.reset(options={"reset_mask": over})
    return successes / pushes, successes / episodes


def learned(script, args):
    """What a trained team thinks the joint value is, where agent 0 pushes below the big box and where it takes its best
    other macro-action there, each a mean over what a random partner does. args: of a run that is made here."""
    folder = script.train(args)
    env = envs.make(args.env, args.num_envs)
    learner, buffer = script.make_learner(args, env), script.ReplayBuffer(env, 1_000)
    learner.load_state_dict(script.load(folder / "last.pt")["networks"])
    push_beside_random_partner(args.env, args.num_envs, args.seed, buffer)
    mixer_state = [args.mixer_state] if hasattr(args, "mixer_state") else []
    batch = buffer.sample(500, args.window, *mixer_state, np.random.default_rng(args.seed))
    with torch.no_grad():
        (utilities,) = script.over_rows(batch, learner["agents"])  # [B, T, n, A]
        pushes = batch["chosen"][..., 0] & (batch["action"][..., 0] == PUSH) & batch["valid"]  # [B, T]
        other = utilities[..., 0, :].clone()  # [B, T, A]
        other[..., PUSH] = -torch.inf
        found = []
        for choice in (batch["action"][..., 0], other.argmax(2)):
            action = torch.stack([choice, batch["action"][..., 1]], 2)  # [B, T, n]
            taken = utilities.gather(3, action[..., None])[..., 0]  # [B, T, n]
            if script is avf_vdn:
                q = script.mix(taken[pushes])
            else:
                inputs = (taken, utilities.amax(3), action, batch["chosen"], batch["state"])
                q = learner["mixer"](*(x[pushes] for x in inputs))
            found.append(q.mean().item() / args.reward_scale)
    return found


def main(argv=None):
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--steps", type=int, default=150_000, help="of each run, at random (default: %(default)s)")
    parser.add_argument("--seed", type=int, default=101, help="default: %(default)s")
    parser.add_argument("-o", "--output", type=Path, help="the figure, PNG")
    options = parser.parse_args(argv)
    gamma, safe = avf_qmix.parse_args(["--env=bp-10"]).gamma, 20.0
    for env_id in ("bp-10", "bp-20", "bp-30"):
        p, share = push_beside_random_partner(env_id)
        print(f"{env_id}: p {p:.4f} a push, {share:.3f} an episode; bound {bound(p, BIG, FAILS, safe, gamma):.3f}")
    if not options.steps:
        return
    p, _ = push_beside_random_partner("bp-10")
    scripts, found = (avf_vdn, avf_qmix), {}
    with tempfile.TemporaryDirectory() as folder:
        for script in scripts:
            for beta in BETAS:
                args = replace(script.parse_args(["--env=bp-10"]), hysteresis=beta, total_timesteps=options.steps,
                               seed=options.seed, end_e=1.0, exploration_timesteps=10**9, learning_starts=5_000,
                               runs_dir=folder, eval_frequency=10**9)  # fmt: skip
                found[script, beta] = learned(script, args)
                push, other = found[script, beta]
                predicted = value(beta, p, BIG, FAILS, other, gamma)
                print(f"{script.ALGORITHM} {beta=} push {push:.1f}, predicted {predicted:.1f}, best other {other:.1f}")
    if options.output:
        draw(found, p, gamma, safe, options.output)


def draw(found, p, gamma, safe, path):
    """The joint value of pushing and of the best other macro-action against beta, beside what the latter predicts."""
    import matplotlib  # optional: pip install -e '.[report]'

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(figsize=(7, 4), layout="constrained")
    axes.axvline(bound(p, BIG, FAILS, safe, gamma), color="0.7", label="bound")
    for k, script in enumerate(dict.fromkeys(script for script, _ in found)):
        push, other = np.array([found[script, beta] for beta in BETAS]).T
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
    main()
