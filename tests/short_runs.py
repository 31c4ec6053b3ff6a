"""Short training runs of the baselines, and what has to hold in the run of any of them."""

import copy
import dataclasses
from itertools import pairwise

import numpy as np
import pytest
import torch

import envs
from envs.box_pushing import BoxPushing
from tests.curves import scalars

SHORT = dict(num_envs=4, total_timesteps=1_200, batch_size=3, hidden_size=16, eval_frequency=400, eval_episodes=2)
REPLAY = dict(learning_starts=200, train_frequency=40, batch_size=8, window=6)
TAGS = {"charts/episodic_return", "charts/epsilon", "eval/return", "eval/discounted_return", "eval/length",
        "eval/success", "losses/td_loss", "losses/q_values", "losses/grad_norm"}  # fmt: skip


def short(script, env_id, folder, **options):
    args = script.parse_args([f"--env={env_id}"])
    replay = REPLAY if hasattr(args, "learning_starts") else {}
    return dataclasses.replace(args, runs_dir=str(folder), **{**SHORT, **replay, **options})


def watch_play(script, buffer_class, monkeypatch, gamma, reward_scale):
    """A list that fills with the exploration rates of a run in Box Pushing. Recurrent states have to be zero where
    episodes begin, and the buffer has to hear of rewards and terminal ends."""
    act, step, advance, acted, results = script.act, buffer_class.step, BoxPushing._advance, [], []

    def spy(agents, obs, infos, hidden, epsilon=0.0, rng=None):
        if rng is not None:
            begins = (infos["macro_action"] < 0).all(1)
            assert not hidden[:, begins].any() and hidden[:, ~begins].any(2).all()
            acted.append(epsilon)
        return act(agents, obs, infos, hidden, epsilon, rng)

    def spy_advance(self):
        results.append(advance(self))
        return results[-1]

    def spy_step(self, scaled, discounts, over, obs, infos):
        rewards, terminations, *_ = results[-1]
        np.testing.assert_allclose(scaled, reward_scale * rewards)
        np.testing.assert_allclose(discounts, gamma * ~terminations)
        assert over[terminations].all() and infos["macro_done"][over].all()
        step(self, scaled, discounts, over, obs, infos)

    monkeypatch.setattr(script, "act", spy)
    monkeypatch.setattr(BoxPushing, "_advance", spy_advance)
    monkeypatch.setattr(buffer_class, "step", spy_step)
    return acted


def check_gradient_steps(script, env_id, folder, monkeypatch, part, **options):
    """Trains; every weight moves, and at every update the targets of a part follow by polyak. Returns the number of
    updates."""
    seen, over_rows = [], script.over_rows

    def spy(batch, *networks):
        if len(networks) == 2:
            seen.append([copy.deepcopy(network.state_dict()) for network in networks])
        return over_rows(batch, *networks)

    monkeypatch.setattr(script, "over_rows", spy)
    args = short(script, env_id, folder, seed=0, polyak=0.8, **options)
    run = script.train(args)
    torch.manual_seed(args.seed)
    start = script.make_learner(args, envs.make(env_id))
    for pair in seen[0]:
        torch.testing.assert_close(pair, dict(start[part].state_dict()), msg="targets begin as copies")
    for (_, target), (network, following) in pairwise(seen):
        for name, value in following.items():
            torch.testing.assert_close(value, 0.8 * target[name] + 0.2 * network[name])
    saved = torch.load(run / "last.pt", weights_only=True)
    assert saved["step"] == 1_200 and len(scalars(run)["eval/return"]) == 3
    assert not (run / "checkpoint.pt").exists()
    for name, value in saved["networks"].items():
        assert value.isfinite().all() and not torch.allclose(value, start.state_dict()[name]), name
    return len(seen)


def check_seeds(script, env_id, folder, tags=TAGS, **many):
    """The same seed gives the same curve, another one another; 0 is a seed. many: options for so many updates that
    losses are logged."""
    curves = []
    for run, seed in enumerate((0, 0, 1)):
        options = dict(seed=seed, num_envs=20, total_timesteps=2_000, eval_frequency=2_000, **many)
        args = short(script, env_id, folder / str(run), **options)
        curves.append(scalars(script.train(args)))
    assert curves[0] == curves[1] and curves[0]["losses/td_loss"] != curves[2]["losses/td_loss"]
    assert curves[0].keys() == tags


def check_lambda_and_hysteresis(script, name, folder, monkeypatch):
    """What training passes to the loss of this name: lambda, and a factor on negative errors that is held while
    exploring, which begins with learning, and then let go by linear interpolation, until twice as many steps."""
    acted, loss, seen = watch_play(script, script.ReplayBuffer, monkeypatch, 0.9, 0.5), getattr(script, name), []

    def spy_loss(utilities, target_utilities, batch, td_lambda, hysteresis):
        assert utilities.requires_grad and not target_utilities.requires_grad
        seen.append((4 * (len(acted) - 1), td_lambda, hysteresis))
        return loss(utilities, target_utilities, batch, td_lambda, hysteresis)

    monkeypatch.setattr(script, name, spy_loss)
    options = dict(td_lambda=0.3, hysteresis=0.2, exploration_timesteps=400, end_e=0.1, gamma=0.9, discount="step")
    script.train(short(script, "bp-10", folder, reward_scale=0.5, **options))
    assert set(acted[:51]) == {1.0} and acted[100] == pytest.approx(0.55) and set(acted[150:]) == {0.1}
    assert len({step for step, *_ in seen}) > 15 and seen[-1][0] > 900
    for step, td_lambda, hysteresis in seen:
        share = min(max((step + 4 - 200) / 400 - 1, 0), 1)
        assert td_lambda == 0.3 and hysteresis == pytest.approx(0.2 * (1 - share) + share)
