"""Cen-MADDRQN: joint macro-actions, what is available to the team, targets, the joint history, exploration and runs."""

import copy
from itertools import product
from types import SimpleNamespace

import numpy as np
import pytest
import torch

import cen_maddrqn
import envs
from cen_maddrqn import Team, act, td_loss, values_at_rows
from tests.episodes import BY_HAND, by_hand, make_args, played
from tests.short_runs import check_gradient_steps, check_schedules, check_seeds

N_ACTIONS = {
    "ct-10": envs.make("ct-10").n_actions,
    "wtd-t1": envs.make("wtd-t1").n_actions,
    "small": [2, 4, 3],
}


def test_joint_macro_actions_are_numbered_through():
    """Agents of 2, 4 and 3 macro-actions have 24 joint ones. The last agent's count fastest, there and back."""
    team = Team([2, 4, 3], 5, 8)
    assert team.parts.tolist() == [list(parts) for parts in product(range(2), range(4), range(3))]
    assert team.index(team.parts).tolist() == list(range(24))
    assert team.index(torch.tensor([[[0, 0, 2], [1, 3, 0]]])).tolist() == [[2, 21]]


def test_a_joint_macro_action_is_available_if_each_part_is():
    """Agent 0 has two macro-actions, agent 1 three, so 00, 01, 02, 10, 11, 12 are the joint ones."""
    team = Team([2, 3], 5, 8)
    available = torch.tensor(
        [
            [[True, True, False], [True, True, True]],  # both are free; agent 0 has no third one
            [[False, True, False], [True, True, True]],  # agent 0 is busy with 1
            [[True, True, False], [True, False, True]],  # agent 1 cannot start 1
            [[True, False, False], [False, False, True]],  # both are busy
        ]
    )
    expected = [[1, 1, 1, 1, 1, 1], [0, 0, 0, 1, 1, 1], [1, 0, 1, 1, 0, 1], [0, 0, 1, 0, 0, 0]]
    assert team.all_available(available).int().tolist() == expected
    assert team.all_available(available[None]).shape == (1, 4, 6)


def random_situations(n_actions, count, rng):
    """infos of a batch with any sets of free agents, also with all of them, and any initiation sets."""
    free = rng.random((count, len(n_actions))) < 0.5
    free[0] = True
    free[~free.any(1), 0] = True
    running = rng.integers(n_actions, size=free.shape)
    own_actions = np.arange(max(n_actions)) < np.array(n_actions)[:, None]
    can_start = own_actions & (rng.random((*free.shape, max(n_actions))) < 0.7)
    can_start[..., 0] |= ~can_start.any(-1)
    is_running = np.eye(max(n_actions), dtype=bool)[running]
    available = np.where(free[..., None], can_start, is_running)
    return {"macro_done": free, "macro_action": running, "available": available}


@pytest.mark.parametrize("name", N_ACTIONS)
def test_the_team_chooses_the_best_of_what_is_available(name):
    """With random networks and histories, by brute force over the joint macro-actions: 1,024, 875 and 24."""
    n_actions = N_ACTIONS[name]
    torch.manual_seed(0)
    rng = np.random.default_rng(0)
    team = Team(n_actions, 3, 16)
    assert len(team.parts) == {"ct-10": 1_024, "wtd-t1": 875, "small": 24}[name]
    count = 40
    infos = random_situations(n_actions, count, rng)
    obs = rng.standard_normal((count, len(n_actions), 3)).astype(np.float32)
    hidden = torch.randn(1, count, 16)
    heard = []
    team.register_forward_hook(lambda module, inputs, output: heard.append(output[0][:, 0]))
    actions, _ = act(team, obs, infos, hidden)
    joint = list(product(*map(range, n_actions)))
    tempting = 0
    for values, available, chosen in zip(heard[0].tolist(), infos["available"], actions, strict=True):
        allowed = [j for j, parts in enumerate(joint) if all(available[i, part] for i, part in enumerate(parts))]
        assert joint[max(allowed, key=values.__getitem__)] == tuple(chosen)
        tempting += max(range(len(joint)), key=values.__getitem__) not in allowed
    assert tempting > 10, "without the mask other joint macro-actions would be chosen"
    for epsilon in (0.5, 1.0):
        actions, _ = act(team, obs, infos, hidden, epsilon, rng)
        assert np.take_along_axis(infos["available"], actions[..., None], 2).all()


def test_the_joint_history_moves_where_an_agent_is_free():
    torch.manual_seed(0)
    team = Team([2, 4, 3], 3, 16)
    obs = np.ones((2, 3, 3), np.float32)
    infos = random_situations([2, 4, 3], 2, np.random.default_rng(0))
    infos["macro_done"] = np.array([[False, True, False], [False, False, False]])
    hidden = torch.randn(1, 2, 16)
    _, moved = act(team, obs, infos, hidden)
    assert not torch.isclose(moved[:, 0], hidden[:, 0]).all() and moved[:, 1].equal(hidden[:, 1])


def test_explores_as_a_team():
    """With probability epsilon all free agents draw at random from what is available, otherwise none does."""
    count, epsilon = 20_000, 0.3
    rng = np.random.default_rng(0)
    team = Team([2, 4, 3], 1, 4)
    team.output.bias.data[17] = 100.0  # 1, 1, 2 is best
    obs, hidden = np.zeros((count, 3, 1), np.float32), torch.zeros(1, count, 4)
    everything = [[1, 1, 0, 0], [1, 1, 1, 1], [1, 1, 1, 0]]
    agent_1_busy = [[1, 1, 0, 0], [0, 1, 0, 0], [0, 1, 1, 0]]  # and agent 2 cannot start 0
    for available in (np.array(everything, bool), np.array(agent_1_busy, bool)):
        infos = {
            "macro_done": np.ones((count, 3), bool),
            "macro_action": np.zeros((count, 3), int),
            "available": np.tile(available, (count, 1, 1)),
        }
        actions, _ = act(team, obs, infos, hidden, epsilon, rng)
        options = list(product(*(np.flatnonzero(own).tolist() for own in available)))
        expected = dict.fromkeys(options, epsilon / len(options))
        expected[1, 1, 2] += 1 - epsilon
        drawn, counts = np.unique(actions, axis=0, return_counts=True)
        assert set(map(tuple, drawn.tolist())) == set(options)
        for option, share in zip(map(tuple, drawn.tolist()), counts / count, strict=True):
            assert share == pytest.approx(expected[option], abs=4 * (expected[option] / count) ** 0.5)


# Values at rows 0 to 4 of the first episode by hand; columns are the joint macro-actions 00, 01, 10, 11.
ONLINE = torch.tensor([[[5, 1, 3, 2], [90, 80, 1, 6], [90, 7, 80, 8], [4, 5, 90, 80], [1, 2, 9, 3]]]).float()
TARGET = torch.tensor(
    [[[99, 99, 99, 99], [99, 99, 99, 10], [99, -4, 99, 99], [99, 4, 99, 99], [99, 99, 12, 99]]]
).float()


@pytest.mark.parametrize("terminated", [False, True])
def test_target_by_hand(terminated):
    """Each row lasts until any agent chooses again: rewards 8, 5, 6, 12, after 1, 2, 1 and 2 steps.

    The best of what is available; others would be better (90). Row 1: agent 0 runs 1, so 10 (1) or 11 (6), whose target
    value is 10. Row 2: agent 1 runs 1 and agent 0 can only start 0, so 01 (7), not 11 (8), with target value -4. Row 3:
    agent 0 runs 0, so 00 (4) or 01 (5), with 4. Row 4: all are free, 10 (9), with 12.

    Targets 8 + 10/2 = 13, 5 - 4/4 = 4, 6 + 4/2 = 8, 12 + 12/4 = 15 or, terminated, 12. Values 3, 6, 7, 4.
    lambda = 1/2: 6 + (4 + 15) / 2 / 2 = 10.75, 5 + (-4 + 10.75) / 2 / 4 = 5.84375, 8 + (10 + 5.84375) / 2 / 2 =
    11.9609375; terminated, 6 + (4 + 12) / 2 / 2 = 10, 5 + (-4 + 10) / 2 / 4 = 5.75, 8 + (10 + 5.75) / 2 / 2 = 11.9375.
    """
    team = cen_maddrqn.make_learner(make_args(cen_maddrqn, "wtd-s"), BY_HAND)["agents"]
    batch = {name: value[:1] for name, value in by_hand(cen_maddrqn, terminated).items()}
    assert batch["reward"][batch["valid"]].tolist() == [8.0, 5.0, 6.0, 12.0]
    assert batch["discount"][batch["valid"]].tolist() == [0.5, 0.25, 0.5, 0.0 if terminated else 0.25]

    def loss_by_hand(td_lambda=0.0, hysteresis=1.0):
        loss, q, target = td_loss(ONLINE, TARGET, team, batch, SimpleNamespace(td_lambda=td_lambda), hysteresis)
        return loss.item(), q.tolist(), target.tolist()

    last = 12.0 if terminated else 15.0
    loss, q, target = loss_by_hand()
    assert q == [3.0, 6.0, 7.0, 4.0] and target == [13.0, 4.0, 8.0, last]
    assert loss == pytest.approx((100 + 4 + 1 + (last - 4) ** 2) / 4)
    assert loss_by_hand(hysteresis=0.5)[0] == pytest.approx((100 + 1 + 1 + (last - 4) ** 2) / 4)
    _, _, target = loss_by_hand(td_lambda=0.5)
    assert target == ([11.9375, 5.75, 10.0, 12.0] if terminated else [11.9609375, 5.84375, 10.75, 15.0])


@pytest.mark.slow
@pytest.mark.parametrize("env_id", ["wtd-s", "wtd-t1", "bp-10", "ct-10"])
def test_values_at_rows_are_those_of_acting(env_id):
    """Real play: the joint history moves at every row, the final one included. Shorter episodes are padded."""
    _, learner, batch, ended = played(cen_maddrqn, env_id)
    with torch.no_grad():
        values = values_at_rows(learner["agents"], batch)
    for got, episode in zip(values, ended, strict=True):
        torch.testing.assert_close(got[: len(episode.rows)], torch.stack([row.said for row in episode.rows]))


@pytest.mark.parametrize("env_id", ["wtd-s", "ct-10"])
def test_targets_are_those_of_the_primitive_rewards(env_id):
    """Real play with lambda 0.6, in episodes of different lengths, which terminate or are truncated."""
    env, learner, batch, ended = played(cen_maddrqn, env_id)
    team = learner["agents"]
    generator = torch.Generator().manual_seed(0)
    online, bootstrap = torch.randn((2, *batch["valid"].shape, len(team.parts)), generator=generator)
    _, q, target = td_loss(online, bootstrap, team, batch, SimpleNamespace(td_lambda=0.6))
    expected_q, expected = [], []
    for b, episode in enumerate(ended):
        last = len(episode.rows) - 1
        targets = []
        for k in reversed(range(last)):
            available = torch.from_numpy(episode.rows[k + 1].available)
            allowed = available[torch.arange(env.n_agents), team.parts].all(1)  # [J]
            best = online[b, k + 1].masked_fill(~allowed, -torch.inf).argmax()
            later = bootstrap[b, k + 1, best].item()
            if k + 1 < last:
                later = 0.4 * later + 0.6 * targets[-1]
            targets.append(episode.reward(k, k + 1, 0.9) + episode.discount(k, k + 1, 0.9) * later)
        expected += reversed(targets)
        expected_q += [online[b, k, np.ravel_multi_index(episode.rows[k].actions, env.n_actions)] for k in range(last)]
    torch.testing.assert_close(q, torch.stack(expected_q))
    np.testing.assert_allclose(target, expected, rtol=1e-4, atol=1e-4)


def test_gradients_reach_everything_and_never_the_target():
    _, learner, batch, _ = played(cen_maddrqn, "wtd-s")
    team, target = copy.deepcopy(learner["agents"]), copy.deepcopy(learner["agents"])
    args = SimpleNamespace(td_lambda=0.8)
    td_loss(values_at_rows(team, batch), values_at_rows(target, batch), team, batch, args)[0].backward()
    assert all(parameter.grad.isfinite().all() and parameter.grad.any() for parameter in team.parameters())
    assert all(parameter.grad is None for parameter in target.parameters())


def test_too_many_joint_macro_actions_are_refused_in_one_line(tmp_path):
    with pytest.raises(SystemExit) as stopped:
        cen_maddrqn.train(make_args(cen_maddrqn, "ct-10-primitive", runs_dir=str(tmp_path)))
    assert str(stopped.value) == f"ct-10-primitive has {5**10:,} joint macro-actions, the limit is 32,768"
    assert not any(tmp_path.iterdir()), "nothing was written"


@pytest.mark.parametrize("env_id", ["wtd-s", "ct-10"])
def test_a_run_takes_gradient_steps(tmp_path, monkeypatch, env_id):
    assert check_gradient_steps(cen_maddrqn, env_id, tmp_path, monkeypatch) == (1_200 - 200) // 40


@pytest.mark.slow
def test_same_seed_same_curve(tmp_path, monkeypatch):
    check_seeds(cen_maddrqn, "bp-10", tmp_path, monkeypatch, train_frequency=16)


def test_training_passes_on_what_it_should(tmp_path, monkeypatch):
    check_schedules(cen_maddrqn, "td_loss", tmp_path, monkeypatch)
