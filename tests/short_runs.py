"""Short training runs of the baselines, and what has to hold in the run of any of them."""

import copy
import dataclasses
from itertools import pairwise
from types import SimpleNamespace

import numpy as np
import pytest
import torch

import envs
from envs.box_pushing import BoxPushing
from tests.curves import scalars

SHORT = dict(
    num_envs=4,
    total_timesteps=1_200,
    batch_size=3,
    hidden_size=16,
    eval_frequency=400,
    eval_episodes=2,
)
REPLAY = dict(learning_starts=200, train_frequency=40, batch_size=8)  # for scripts with a replay buffer
CHARTS = {"charts/episodic_return"}
EVAL = {"eval/return", "eval/discounted_return", "eval/length", "eval/success"}
LOSSES = {"losses/td_loss", "losses/q_values"}


def short(script, env_id, folder, **options):
    """The Args of a short run, with the script's defaults for the task where nothing else is said."""
    args = script.parse_args([f"--env={env_id}"])
    replay = REPLAY if hasattr(args, "learning_starts") else {}
    return dataclasses.replace(args, runs_dir=str(folder), **{**SHORT, **replay, **options})


def cut_episodes(monkeypatch, horizon):
    """Lets all episodes end after so many steps."""
    make = envs.make
    monkeypatch.setattr(envs, "make", lambda env_id, num_envs: make(env_id, num_envs, horizon=horizon))


def check_gradient_steps(script, env_id, folder, monkeypatch, **options):
    """Trains in short episodes: all weights move, and at each update the targets follow by Polyak averaging.

    Returns the number of updates.
    """
    pairs = []  # the networks that have targets, and these
    seen = []  # the weights of both before every update, and at the end
    start = {}
    make_learner, make_batch = script.make_learner, script.make_batch

    def spy_make_learner(*args):
        learner = make_learner(*args)
        start.update(copy.deepcopy(learner.state_dict()))
        return learner

    def spy_deepcopy(networks):
        pairs.append((networks, copy.deepcopy(networks)))
        return pairs[-1][1]

    def note_weights():
        ((networks, targets),) = pairs
        seen.append((copy.deepcopy(networks.state_dict()), copy.deepcopy(targets.state_dict())))

    def spy_make_batch(*args):
        note_weights()
        return make_batch(*args)

    cut_episodes(monkeypatch, 25)
    monkeypatch.setattr(script, "make_learner", spy_make_learner)
    monkeypatch.setattr(script, "copy", SimpleNamespace(deepcopy=spy_deepcopy))
    monkeypatch.setattr(script, "make_batch", spy_make_batch)
    run = script.train(short(script, env_id, folder, seed=0, polyak=0.8, **options))
    note_weights()
    first_network, first_target = seen[0]
    torch.testing.assert_close(first_target, first_network, msg="targets begin as copies")
    for (_, target), (network, following) in pairwise(seen):
        for name, value in following.items():
            torch.testing.assert_close(value, 0.8 * target[name] + 0.2 * network[name])
    saved = torch.load(run / "last.pt", weights_only=True)
    assert saved["step"] == 1_200 and [step for step, _ in scalars(run)["eval/return"]] == [400, 800, 1_200]
    assert saved["networks"].keys() == start.keys()
    for name, value in saved["networks"].items():
        assert value.isfinite().all() and not torch.allclose(value, start[name]), name
    return len(seen) - 1


def check_seeds(script, env_id, folder, monkeypatch, losses=LOSSES, **options):
    """The same seed gives the same curve, another one another; 0 is a seed. Everything is logged, and nothing else.

    options: those for so many updates that losses are logged.
    """
    cut_episodes(monkeypatch, 10)
    many = dict(num_envs=20, total_timesteps=2_000, eval_frequency=2_000, batch_size=2, **options)
    runs = [script.train(short(script, env_id, folder, seed=seed, **many)) for seed in (0, 0, 1)]
    curves = [scalars(run) for run in runs]
    assert curves[0] == curves[1]
    assert all(curves[0][name] != curves[2][name] for name in losses)
    assert curves[0].keys() == CHARTS | EVAL | losses


def watch_play(script, buffer_class, monkeypatch, gamma, reward_scale):
    """A list that fills with the exploration rates of a run in Box Pushing.

    Recurrent states have to be zero where episodes begin and nowhere else. The buffer has to hear of scaled rewards, of
    discounts that are 0 at a terminal end only, and of every end.
    """
    acted = []
    results = []  # of the environments' steps
    act, advance = script.act, BoxPushing._advance
    add_step, end_episodes = buffer_class.add_step, buffer_class.end_episodes

    def spy_act(agents, obs, infos, hidden, epsilon=0.0, rng=None):
        if rng is not None:  # training, not evaluation
            begins = (infos["macro_action"] < 0).all(1)
            assert not hidden[:, begins].any() and hidden[:, ~begins].any(2).all()
            acted.append(epsilon)
        return act(agents, obs, infos, hidden, epsilon, rng)

    def spy_advance(self):
        results.append(advance(self))
        return results[-1]

    def spy_add_step(self, rewards, discounts):
        unscaled, terminations, *_ = results[-1]
        np.testing.assert_allclose(rewards, reward_scale * unscaled)
        np.testing.assert_allclose(discounts, np.where(terminations, 0.0, gamma))
        add_step(self, rewards, discounts)

    def spy_end_episodes(self, over, obs, infos):
        _, terminations, *_ = results[-1]
        assert over[terminations].all() and infos["macro_done"][over].all()
        end_episodes(self, over, obs, infos)

    monkeypatch.setattr(script, "act", spy_act)
    monkeypatch.setattr(BoxPushing, "_advance", spy_advance)
    monkeypatch.setattr(buffer_class, "add_step", spy_add_step)
    monkeypatch.setattr(buffer_class, "end_episodes", spy_end_episodes)
    return acted


def watch_learning_rate(monkeypatch):
    """A list that fills with the learning rates of all updates."""
    rates = []

    class Adam(torch.optim.Adam):
        def step(self):
            rates.append(self.param_groups[0]["lr"])
            super().step()

    monkeypatch.setattr(torch.optim, "Adam", Adam)
    return rates


def check_schedules(script, loss_name, folder, monkeypatch):
    """What a Q-learner passes to its loss, when it learns and how fast.

    Epsilon is 1 until learning starts, at step 200, and falls over 400 steps. The factor on negative errors is held as
    long and then rises to 1 over as many. An update is made at each multiple of 40 steps, from the first after learning
    starts at which an episode has ended.
    """
    acted = watch_play(script, script.ReplayBuffer, monkeypatch, gamma=0.9, reward_scale=0.5)
    rates = watch_learning_rate(monkeypatch)
    loss = getattr(script, loss_name)
    seen = []

    def spy_loss(values, target_values, *others):
        *_, settings, hysteresis = others
        assert values.requires_grad and not target_values.requires_grad
        seen.append((4 * len(acted), settings.td_lambda, hysteresis))
        return loss(values, target_values, *others)

    monkeypatch.setattr(script, loss_name, spy_loss)
    cut_episodes(monkeypatch, 25)
    options = dict(exploration_timesteps=400, end_e=0.1, hysteresis=0.2, td_lambda=0.3, gamma=0.9, reward_scale=0.5)
    script.train(short(script, "bp-10", folder, learning_rate=0.01, **options))
    assert set(acted[:51]) == {1.0} and acted[100] == pytest.approx(0.55) and set(acted[150:]) == {0.1}
    assert [step for step, *_ in seen] == list(range(240, 1_201, 40))
    for (step, td_lambda, hysteresis), rate in zip(seen, rates, strict=True):
        share = np.clip((step - 4 - 600) / 400, 0, 1)  # epsilon and this factor are those of the step before
        assert td_lambda == 0.3 and hysteresis == pytest.approx(0.2 * (1 - share) + share)
        assert rate == pytest.approx(0.01 * (1 - step / 1_200))
