"""AVF-QPLEX: rows, target, networks, acting and learning; what tests/test_sync.py keeps identical is tested here once.

Where a definition differs between avf_vdn.py, avf_qmix.py and avf_qplex.py, tests run for each kind.
"""

import copy
import types
from itertools import product

import numpy as np
import pytest
import torch

import avf_qplex
import avf_vdn
import envs
from avf_qplex import Agents, Args, QPLEXMixer, ReplayBuffer, act, evaluate, over_rows, td_loss, train
from tests.curves import scalars
from tests.matrix_game import MatrixGame
from tests.rollouts import (
    TINY,
    Episode,
    Spy,
    Step,
    args_for,
    check_rows,
    expected_rows,
    play,
    step_by_step,
    windows,
)

# ---- rows ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("script", [avf_vdn, avf_qplex])
@pytest.mark.parametrize("env_id", ["wtd-s", "bp-10"])
def test_rows_are_the_steps_at_which_somebody_chose(script, env_id):
    """The memory's rows against the same rows worked out step by step from a log of the episodes."""
    _, _, buffer, ended = play(script, env_id, 8, lambda env: script.ReplayBuffer(env, 12))
    places = buffer.queue[-len(ended) :]
    assert len(ended) < 12 and not buffer.rows[buffer.queue[: -len(ended)]].any(), "free places come first"
    longest = 0
    for place, episode in zip(places, ended, strict=True):
        rows = expected_rows(episode, 0.9)
        check_rows(buffer, place, rows)
        longest = max(longest, *np.diff([row["step"] for row in rows[:-1]]))
    assert longest > 2, "intervals of several steps occur"


@pytest.mark.parametrize("env_id", ["wtd-s", "bp-10", "ct-10"])
def test_replayed_utilities_are_those_of_acting(env_id):
    """Row by row from an episode's start, with other agents' rows in between."""
    env, agents, buffer, ended = play(avf_qplex, env_id, 8, lambda env: ReplayBuffer(env, 12))
    count = len(ended)
    batch = windows(buffer, range(count), [0] * count, env.horizon)
    with torch.no_grad():
        (utilities,) = over_rows(batch, agents)
    ongoing = 0
    for b, episode in enumerate(ended):
        rows = [step for step in episode.steps if step.free.any()]
        acted = torch.stack([step.utilities for step in rows])  # [rows, n, A]
        torch.testing.assert_close(utilities[b, : len(rows)], acted)
        assert batch["valid"][b].sum() == len(rows)
        chosen = np.stack([step.free for step in rows])
        np.testing.assert_array_equal(batch["chosen"][b, : len(rows)], chosen)
        ongoing += (~chosen).sum()
    assert ongoing > 50


@pytest.mark.parametrize("env_id", ["wtd-s", "ct-10"])
def test_packing_changes_nothing(env_id):
    """Windows that begin anywhere, against every agent of every window run on its own; for two networks at once."""
    env, agents, buffer, _ = play(avf_qplex, env_id, 6, lambda env: ReplayBuffer(env, 9))
    other = Agents(env.n_actions, env.single_observation_space.shape[1], hidden_size=4)
    batch = buffer.sample(12, 7, "joint", np.random.default_rng(0))
    inside = batch["valid"] | batch["valid"].roll(1, 1)  # rows beyond a window are of no meaning
    assert not batch["chosen"][:, 0].all() and not inside.all()
    with torch.no_grad():
        for utilities, network in zip(over_rows(batch, agents, other), (agents, other), strict=True):
            torch.testing.assert_close(utilities[inside], step_by_step(network, batch)[inside])


def test_windows_reach_over_both_ends_and_are_cut_there():
    """Rows, validity and the macro-action before, of windows that begin before, within and near the end."""
    _, _, buffer, ended = play(avf_qplex, "wtd-s", 1, lambda env: ReplayBuffer(env, 4), num_envs=1)
    rows = expected_rows(ended[0], 0.9)
    last = len(rows) - 1
    first = [-3, 2, last - 2]
    batch = windows(buffer, [0, 0, 0], first, 5, "decision")
    for b, (start, end) in enumerate(((0, 2), (2, 7), (last - 2, last))):
        for t in range(6):
            row = start + t
            assert batch["valid"][b, t] == (row < end)
            if row > end:
                assert not batch["chosen"][b, t].any(), "nobody chooses beyond a window"
                continue
            for key in ("obs", "action", "state", "reward", "discount"):
                torch.testing.assert_close(batch[key][b, t], torch.as_tensor(rows[row][key], dtype=batch[key].dtype))
            since = rows[row]["since"]
            assert batch["chosen"][b, t].tolist() == (since == row).tolist()
            previous = [rows[k - 1]["action"][i] if k else -1 for i, k in enumerate(since)]
            assert batch["previous"][b, t].tolist() == previous


@pytest.mark.parametrize("script", [avf_vdn, avf_qplex])
@pytest.mark.parametrize("capacity", [2, 7])
def test_windows_never_mix_episodes(script, capacity):
    """A memory far smaller than what is played, so that places are used again; all that is stored tells its episode.
    With capacity 2, more episodes end at once than it holds."""
    env = envs.make("bp-10", 4, horizon=12)
    buffer, rng, tag = script.ReplayBuffer(env, capacity), np.random.default_rng(0), np.arange(4.0)
    with_state = script is avf_qplex
    _, infos = env.reset(seed=0)

    def tagged(*shape):
        return np.broadcast_to(tag.reshape(4, *[1] * len(shape)), (4, *shape)).astype(np.float32)

    checked, at_once, seen = 0, 0, set()
    for _ in range(150):
        actions = rng.integers(0, env.n_actions, (4, 2))
        state = [tagged(env.state_size)] if with_state else []
        buffer.add(tagged(2, env.single_observation_space.shape[1]), actions, infos["macro_done"], *state)
        _, _, terminations, truncations, infos = env.step(actions)
        over = terminations | truncations | (rng.random(4) < 0.02)
        infos["state"], infos["macro_done"] = tagged(env.state_size), infos["macro_done"] | over[:, None]
        final = tagged(2, env.single_observation_space.shape[1])
        buffer.step(*state, tag, 0.9 * ~terminations, over, final, infos)
        if over.any():
            at_once = max(at_once, over.sum())
            tag[over] = tag.max() + 1 + np.arange(over.sum())
            _, infos = env.reset(options={"reset_mask": over})
        assert sorted([*buffer.queue, *buffer.writing]) == list(range(capacity + 4)), "every place is in one list"
        if not buffer.rows[buffer.queue].any():
            continue
        for mixer_state in ("joint", "single", "real") if with_state else ("",):
            batch = buffer.sample(8, 6, *([mixer_state] if with_state else []), rng)
            valid = batch["valid"]
            after = valid.roll(1, 1)
            for b in range(8):
                tags = set(batch["obs"][b][valid[b] | after[b]].flatten().tolist())
                if with_state:
                    tags |= set(batch["state"][b][valid[b]].flatten().tolist())
                    tags |= set(batch["next_state"][b][after[b]].flatten().tolist())
                assert len(tags) == 1
                checked, seen = checked + 1, seen | tags
    ended = [buffer.obs[place, 0, 0, 0] for place in buffer.queue[buffer.rows[buffer.queue] > 0]]
    assert checked > 1000 and len(seen) > 20 and len(ended) == capacity
    # The newest stay, the oldest first; those that end together have neighbouring numbers, in any order.
    assert at_once > 2 and min(ended) > max(seen | set(ended)) - capacity - 8 and len(set(ended)) == capacity


def test_the_oldest_episode_makes_place():
    env = envs.make("bp-10", 1)
    buffer, shape = ReplayBuffer(env, 3), (1, *env.single_observation_space.shape)
    for number in range(8):
        obs, state = np.full(shape, number, np.float32), np.zeros((1, env.state_size), np.float32)
        infos = {"macro_action": np.zeros((1, 2), int), "macro_done": np.ones((1, 2), bool), "state": state}
        buffer.add(obs, infos["macro_action"], infos["macro_done"], state)
        buffer.step(state, np.ones(1), np.ones(1), np.ones(1, bool), obs, infos)
        ended = buffer.queue[buffer.rows[buffer.queue] > 0]
        assert buffer.obs[ended, 0, 0, 0].tolist() == list(range(max(0, number - 2), number + 1))


def chosen_by_hand(choices, ends_at, states=None, gamma=1.0, capacity=2):
    """A memory of one Box Pushing episode in which agents choose at given steps; reward and state are the step."""
    env = envs.make("bp-10", 1)
    buffer, obs = ReplayBuffer(env, capacity), np.zeros((1, *env.single_observation_space.shape), np.float32)
    for t in range(ends_at):
        state, later = (np.full((1, env.state_size), time, np.float32) for time in (t, t + 1))
        over = np.array([t + 1 == ends_at])
        infos = {"macro_action": np.zeros((1, 2), int), "macro_done": np.ones((1, 2), bool), "state": later}
        buffer.add(obs, infos["macro_action"], np.array([choices.get(t, (False, False))]), state)
        buffer.step(state, np.full(1, t), np.full(1, gamma), over, obs, infos)
    return buffer


def test_every_row_of_an_episode_is_replayed_equally_often():
    """The first and the last too, where the reward often is: were all windows to fit in, one start in 15 would do."""
    buffer = chosen_by_hand(dict.fromkeys(range(20), (True, True)), 20)
    batch = buffer.sample(24_000, 6, "joint", np.random.default_rng(0))
    length = batch["valid"].sum(1)
    assert length.min() == 1 and length.max() == 6
    counts = np.bincount(batch["reward"][batch["valid"]].int(), minlength=20)
    expected = 24_000 * 6 / 25  # a row is in 6 of the 25 windows
    assert np.abs(counts - expected).max() < 5 * np.sqrt(expected), counts


def test_short_episodes_are_drawn_as_often_as_long_ones():
    env = envs.make("bp-10", 2)
    buffer, shape = ReplayBuffer(env, 4), (2, *env.single_observation_space.shape)
    obs, state = np.zeros(shape, np.float32), np.zeros((2, env.state_size), np.float32)
    infos = {"macro_action": np.zeros((2, 2), int), "macro_done": np.ones((2, 2), bool), "state": state}
    for t in range(20):
        buffer.add(obs, infos["macro_action"], infos["macro_done"], state)
        buffer.step(state, np.array([1, 2]), np.ones(2), np.array([t == 19, t == 3]), obs, infos)
    assert sorted(buffer.rows[buffer.queue].tolist()) == [0, 0, 5, 21]
    batch = buffer.sample(10_000, 6, "joint", np.random.default_rng(0))
    short = batch["reward"][:, 0] == 2
    assert abs(short.float().mean() - 0.5) < 0.03
    assert (batch["valid"][short].sum(1) == 4).all(), "what fits is whole"
    whole = buffer.sample(100, 60, "joint", np.random.default_rng(0))["valid"]
    assert whole.shape == (100, 21) and set(whole.sum(1).tolist()) == {4, 20}


@pytest.mark.parametrize("mixer_state", ["joint", "single", "real", "decision"])
def test_mixer_state_feeds_the_rows_it_says(mixer_state):
    """Two agents, decisions worked out by hand; the state is the time step.

    t        0     1     2     3     4     5 (end, truncated)
    agent 0  a0          a1          a2
    agent 1  b0    b1          b2
    row      0     1     2     3     4     5
    """
    choices = {0: (True, True), 1: (False, True), 2: (True, False), 3: (False, True), 4: (True, False)}
    buffer = chosen_by_hand(choices, 5)
    batch = windows(buffer, [0], [0], 5, mixer_state)
    size = buffer.state.shape[2]
    got = batch["state"][0, :5].unflatten(-1, (-1, size))[..., 0].tolist()
    later = batch["next_state"][0, 1:].unflatten(-1, (-1, size))[..., 0].tolist()
    # joint: when each agent last chose. single: that of the agent whose macro-action ends with the row's interval,
    # agent 1 at row 0, 0 at row 1, 1 at row 2, 0 at row 3, both, so 0, at row 4. Every row lasts one step: see the next
    # test for `real`.
    expected = {
        "joint": ([[0, 0], [0, 1], [2, 1], [2, 3], [4, 3]], [[0, 1], [2, 1], [2, 3], [4, 3], [5, 5]]),
        "single": ([[0], [0], [1], [2], [4]], [[1], [2], [3], [4], [5]]),
        "real": ([[0], [1], [2], [3], [4]], [[1], [2], [3], [4], [5]]),
        "decision": ([[0], [1], [2], [3], [4]], [[1], [2], [3], [4], [5]]),
    }
    assert (got, later) == expected[mixer_state]


@pytest.mark.parametrize(("mixer_state", "times"), [("decision", [0, 4]), ("real", [3, 5])])
def test_real_state_is_that_of_the_last_step_and_decision_of_the_first(mixer_state, times):
    """Agents choose at steps 0 and 4, the episode ends after step 5."""
    buffer = chosen_by_hand({0: (True, True), 4: (True, True)}, 6, gamma=0.5)
    batch = windows(buffer, [0], [0], 5, mixer_state)
    assert batch["valid"].sum() == 2
    assert batch["state"][0, :2, 0].tolist() == times and batch["next_state"][0, 1:3, 0].tolist() == [4, 6]
    assert batch["reward"][0, :2].tolist() == [0 + 0.5 * 1 + 0.25 * 2 + 0.125 * 3, 4 + 0.5 * 5]
    assert batch["discount"][0, :2].tolist() == [0.5**4, 0.5**2]


# ---- target -------------------------------------------------------------------------------------------------------


def hand_made_batch():
    """Two agents, two macro-actions, two windows of two rows and the row after them, which is the episode's end.

    Window 0 (terminates after row 1). Row 0: both choose. Row 1: only agent 1 chooses, agent 0 is ongoing.
    Window 1 (truncated after row 1). Row 0: both choose. Row 1: only agent 0 chooses, agent 1 is ongoing.
    """
    both, first, second = [True, True], [True, False], [False, True]
    return {
        "chosen": torch.tensor([[both, second, both], [both, first, both]]),
        "action": torch.tensor([[[1, 0], [1, 1], [1, 1]], [[0, 1], [1, 1], [1, 1]]]),
        "valid": torch.tensor([[True, True, False]] * 2),
        "reward": torch.tensor([[1.0, 2.0, 0.0], [3.0, 4.0, 0.0]]),
        "discount": torch.tensor([[0.81, 0.0, 1.0], [0.9, 0.729, 1.0]]),
        "state": torch.zeros(2, 3, 1),
        "next_state": torch.zeros(2, 3, 1),
    }


# Utilities [window, row, agent, macro-action]: where an agent is ongoing, those of its latest decision.
ONLINE = torch.tensor([[[[1.0, 2.0], [5.0, 4.0]], [[1.0, 2.0], [6.0, 8.0]], [[7.0, 6.0], [1.0, 9.0]]],
                       [[[3.0, 1.0], [1.0, 2.0]], [[0.0, 5.0], [1.0, 2.0]], [[2.0, 4.0], [3.0, 2.0]]]])  # fmt: skip
TARGET = torch.tensor([[[[10.0, 20.0], [15.0, 25.0]], [[10.0, 20.0], [55.0, 65.0]], [[1.0, 2.0], [3.0, 4.0]]],
                       [[[30.0, 40.0], [35.0, 45.0]], [[50.0, 60.0], [35.0, 45.0]],
                        [[70.0, 80.0], [75.0, 85.0]]]])  # fmt: skip


def add(utilities, values, actions, chosen, state):
    return utilities.sum(-1)


def qplex_loss(*utilities, batch, **options):
    return td_loss(*utilities, add, add, batch, **options)


def vdn_loss(*utilities, batch, **options):
    return avf_vdn.td_loss(*utilities, batch, **options)


both_losses = pytest.mark.parametrize("loss_of", [qplex_loss, vdn_loss])


@both_losses
def test_td_target_by_hand(loss_of):
    """Window 0, row 0: agent 0 goes on with macro-action 1 (target 20), agent 1 chooses, online argmax 1, target 65:
    y = 1 + 0.81 * 85 = 69.85. Row 1: terminated: y = 2. Window 1, row 0: agent 0 chooses, argmax 1, target 60; agent 1
    goes on with macro-action 1, target 45: y = 3 + 0.9 * 105 = 97.5. Row 1: truncated, so it bootstraps from the final
    observation: agent 0 argmax 1, 80; agent 1 argmax 0, 75: y = 4 + 0.729 * 155 = 116.995.
    Joint values: 2 + 5 = 7, 2 + 8 = 10; 3 + 2 = 5, 5 + 2 = 7."""
    loss, q, target = loss_of(ONLINE, TARGET, batch=hand_made_batch())
    torch.testing.assert_close(target, torch.tensor([69.85, 2.0, 97.5, 116.995]))
    torch.testing.assert_close(q, torch.tensor([7.0, 10.0, 5.0, 7.0]))
    torch.testing.assert_close(loss, torch.tensor([62.85, -8.0, 92.5, 109.995]).square().mean())
    # Hysteresis scales the one negative error.
    loss, _, _ = loss_of(ONLINE, TARGET, batch=hand_made_batch(), hysteresis=0.5)
    torch.testing.assert_close(loss, torch.tensor([62.85, -4.0, 92.5, 109.995]).square().mean())


@both_losses
def test_conditional_argmax_never_changes_an_ongoing_macro_action(loss_of):
    """Make the other macro-action of the ongoing agents far better: the target must not move."""
    tempting = ONLINE.clone()
    tempting[0, 1, 0, 0] = tempting[1, 1, 1, 0] = 1000.0  # both are ongoing there, with macro-action 1
    _, _, target = loss_of(tempting, TARGET, batch=hand_made_batch())
    torch.testing.assert_close(target, torch.tensor([69.85, 2.0, 97.5, 116.995]))


def test_mixers_see_the_valid_rows_only_and_the_conditional_argmax():
    """What mixer and target mixer are given for each row; whatever stands beyond a window never reaches one."""
    seen, batch = {}, hand_made_batch()
    batch["state"] = torch.arange(6.0).reshape(2, 3, 1)
    batch["next_state"] = 10 + batch["state"]

    def mixer(name):
        def mix(utilities, values, actions, chosen, state):
            seen[name] = {"q": utilities, "v": values, "m": actions, "chosen": chosen, "state": state}
            return utilities.sum(-1)

        return mix

    td_loss(ONLINE, TARGET, mixer("online"), mixer("target"), batch)
    tell = {name: {key: value.tolist() for key, value in inputs.items()} for name, inputs in seen.items()}
    both, first, second = [True, True], [True, False], [False, True]
    assert tell["online"] == {
        "q": [[2, 5], [2, 8], [3, 2], [5, 2]],
        "v": [[2, 5], [2, 8], [3, 2], [5, 2]],
        "m": [[1, 0], [1, 1], [0, 1], [1, 1]],
        "chosen": [both, second, both, first],
        "state": [[0], [1], [3], [4]],
    }
    assert tell["target"] == {
        "q": [[20, 65], [1, 4], [60, 45], [80, 75]],
        "v": [[20, 65], [2, 4], [60, 45], [80, 85]],
        "m": [[1, 1], [0, 1], [1, 1], [1, 0]],
        "chosen": [second, both, first, both],
        "state": [[11], [12], [14], [15]],
    }


@both_losses
def test_rows_beyond_a_window_count_nowhere(loss_of):
    """Window 0 is cut after its first row. Anything in the rows beyond changes neither loss nor gradients."""
    batch = hand_made_batch()
    batch["valid"] = torch.tensor([[True, False, False], [True, True, False]])
    clean = ONLINE.clone().requires_grad_()
    loss, q, target = loss_of(clean, TARGET, batch=batch, td_lambda=0.5)
    loss.backward()
    torch.testing.assert_close(target, torch.tensor([69.85, 102.89775, 116.995]))
    assert len(q) == 3
    garbage = {key: batch[key].clone() for key in batch}
    garbage["reward"][0, 1:], garbage["discount"][0, 2:] = 1e6, 1e6
    garbage["state"][0, 1:], garbage["next_state"][0, 2:] = torch.nan, torch.nan
    dirty, dirty_target = ONLINE.clone(), TARGET.clone()
    dirty[0, 2:] = dirty_target[0, 2:] = torch.nan
    dirty.requires_grad_()
    other, _, other_target = loss_of(dirty, dirty_target, batch=garbage, td_lambda=0.5)
    other.backward()
    torch.testing.assert_close(other, loss)
    torch.testing.assert_close(other_target, target)
    torch.testing.assert_close(dirty.grad, clean.grad)


@both_losses
def test_q_lambda_by_hand(loss_of):
    """lambda = 0.5. Window 0: G[1] = 2; G[0] = 1 + 0.81 (0.5 * 85 + 0.5 * 2) = 36.235. Window 1: G[1] = 116.995;
    G[0] = 3 + 0.9 (0.5 * 105 + 0.5 * 116.995) = 102.89775. lambda = 1: G[0] = 1 + 0.81 * 2, 3 + 0.9 * 116.995.
    The row before the end of a window keeps the one-row target: there is no further return in it."""
    _, _, target = loss_of(ONLINE, TARGET, batch=hand_made_batch(), td_lambda=0.5)
    torch.testing.assert_close(target, torch.tensor([36.235, 2.0, 102.89775, 116.995]))
    _, _, target = loss_of(ONLINE, TARGET, batch=hand_made_batch(), td_lambda=1.0)
    torch.testing.assert_close(target, torch.tensor([2.62, 2.0, 108.2955, 116.995]))


@both_losses
def test_primitive_target_is_the_textbook_one(loss_of):
    """Where every macro-action ends after a step, rows are steps, everybody chooses and the discount is gamma."""
    _, agents, buffer, _ = play(avf_qplex, "bp-10-primitive", 6, lambda env: ReplayBuffer(env, 9))
    batch = buffer.sample(8, 10, "joint", np.random.default_rng(0))
    valid = batch["valid"]
    assert batch["chosen"][valid | valid.roll(1, 1)].all()
    assert set(batch["discount"][valid].unique().tolist()) <= {0.0, np.float32(0.9)}
    other = copy.deepcopy(agents)
    with torch.no_grad():
        for parameter in other.parameters():
            parameter.add_(0.1 * torch.randn_like(parameter))
        online, evaluated = over_rows(batch, agents, other)
    _, _, target = loss_of(online, evaluated, batch=batch)
    for number, (b, k) in enumerate(np.argwhere(valid.numpy())):
        best = sum(evaluated[b, k + 1, i, online[b, k + 1, i].argmax()] for i in range(online.shape[2]))
        torch.testing.assert_close(target[number], batch["reward"][b, k] + batch["discount"][b, k] * best)


def test_gradients_reach_everything_and_never_the_target():
    env, _, buffer, _ = play(avf_qplex, "wtd-s", 6, lambda env: ReplayBuffer(env, 9))
    learner = avf_qplex.make_learner(Args(hidden_size=8), env)
    target = copy.deepcopy(learner)  # with gradients required, so that one that flows is seen
    batch = buffer.sample(8, 10, "joint", np.random.default_rng(0))
    utilities = over_rows(batch, learner["agents"], target["agents"])
    td_loss(*utilities, learner["mixer"], target["mixer"], batch)[0].backward()
    for name, parameter in learner.named_parameters():
        assert parameter.grad is not None and parameter.grad.abs().sum() > 0, name
    assert all(parameter.grad is None for parameter in target.parameters())


# ---- networks -----------------------------------------------------------------------------------------------------


def test_agents_are_separate_gru_networks():
    """Each agent's slice equals PyTorch's own layers with its weights; padding actions are never available."""
    agents = Agents([2, 4], obs_size=3, hidden_size=8)
    obs, previous = torch.randn(2, 5, 3), torch.tensor([[-1, 0, 1, 1, 0], [-1, 3, 2, 1, 0]])
    start = torch.randn(2, 1, 8)
    with torch.no_grad():
        utilities, states = agents(obs, previous, start, [1] * 5)
        for i in range(2):
            x = torch.cat([obs[i], torch.eye(5)[previous[i], :4]], 1)  # row -1 of the identity is cut to zeros
            x = torch.relu(x @ agents.encoder.weight[i] + agents.encoder.bias[i])
            gru = torch.nn.GRUCell(8, 8)
            gru.weight_ih.copy_(agents.gru_input.weight[i].T)
            gru.bias_ih.copy_(agents.gru_input.bias[i, 0])
            gru.weight_hh.copy_(agents.gru_hidden[i].T)
            gru.bias_hh.zero_()
            hidden = start[i]
            for t in range(5):
                hidden = gru(x[t : t + 1], hidden)
                torch.testing.assert_close(states[i, t], hidden[0])
                head = torch.relu(hidden @ agents.head.weight[i] + agents.head.bias[i])
                expected = (head @ agents.output.weight[i] + agents.output.bias[i])[0, : [2, 4][i]]
                torch.testing.assert_close(utilities[i, t, : [2, 4][i]], expected)
    assert (utilities[0, :, 2:] == -torch.inf).all() and not agents.start(3).any()


def test_obs_scale_reaches_the_macro_observation_only():
    torch.manual_seed(0)
    plain, scaled = (Agents([3, 3], 4, 8, obs_scale) for obs_scale in (1.0, 5.0))
    scaled.load_state_dict(plain.state_dict())
    obs, previous, hidden = torch.randn(2, 6, 4), torch.randint(-1, 3, (2, 6)), torch.randn(2, 6, 8)
    with torch.no_grad():
        torch.testing.assert_close(scaled(obs, previous, hidden, [6]), plain(5 * obs, previous, hidden, [6]))
        assert not torch.allclose(scaled(obs, previous, hidden, [6])[0], plain(obs, previous, hidden, [6])[0])
    learner = avf_qplex.make_learner(args_for(avf_qplex, "ct-10", hidden_size=32), envs.make("ct-10"))
    assert learner["agents"].obs_scale == 4.0 and learner["agents"].hidden_size == 32


def literal_qplex(mixer, utilities, values, actions, chosen, state):
    """Eqs. 3 and 4 one agent and one head after the other, with the mixer's weights; ongoing agents have A_i = 0."""
    n, heads = len(utilities), mixer.heads
    out = mixer.of_state(state)
    weight, bias, key = out[:n].abs() + 1e-10, out[n : 2 * n], out[2 * n : 2 * n + heads].abs()
    agent = out[2 * n + heads :].reshape(heads, n)
    one_hot = torch.cat([torch.eye(mixer.widest)[a] for a in actions])
    action = mixer.of_action(torch.cat([state, one_hot])).reshape(heads, n)
    total = 0.0
    for i in range(n):
        strength = sum(key[h] * torch.sigmoid(agent[h, i]) * torch.sigmoid(action[h, i]) for h in range(heads))
        value = values[i] if chosen[i] else utilities[i]
        total += weight[i] * value + bias[i] + strength * weight[i] * (utilities[i] - value)
    return total


def test_qplex_mixer_is_the_duplex_formula():
    """And the advantages teach lambda_i, not the utilities: their derivative is the transform's weight alone."""
    torch.manual_seed(0)
    for _ in range(20):
        mixer, state = QPLEXMixer([3, 2, 3], 4, embed=8), torch.randn(4)
        utilities = torch.randn(3).requires_grad_()
        values, actions = utilities.detach() + torch.rand(3), torch.tensor([2, 0, 1])
        chosen = torch.rand(3) < 0.5
        joint = mixer(utilities, values, actions, chosen, state)
        torch.testing.assert_close(joint, literal_qplex(mixer, utilities, values, actions, chosen, state))
        (slopes,) = torch.autograd.grad(joint, utilities)
        torch.testing.assert_close(slopes, mixer.of_state(state)[:3].abs() + 1e-10)


def joint_table(mixer, tables, chosen, actions, state):
    """Q_tot of every joint macro-action of the agents that choose, the others' being given."""
    values = torch.stack([table.max() for table in tables])
    sizes = [len(table) if free else 1 for table, free in zip(tables, chosen, strict=True)]
    joint = {}
    for choice in product(*map(range, sizes)):
        m = [c if free else a for c, free, a in zip(choice, chosen, actions, strict=True)]
        utilities = torch.stack([table[a] for table, a in zip(tables, m, strict=True)])
        with torch.no_grad():
            joint[tuple(m)] = mixer(utilities, values, torch.tensor(m), torch.tensor(chosen), state).item()
    return joint


@pytest.mark.parametrize("mixer_state", ["joint", "real"])
def test_greedy_utilities_maximise_the_joint_value(mixer_state):
    """Mac-IGM at random weights, for every set of ongoing agents, with the mixer as the script builds it; and the
    literal mixer breaks it."""
    torch.manual_seed(0)
    env = envs.make("wtd-s")
    width = env.state_size * (env.n_agents if mixer_state == "joint" else 1)
    broken = {True: 0, False: 0}
    for chosen in product([True, False], repeat=env.n_agents):
        for _ in range(4):
            # Close calls for those who choose, far apart for the others: where lambda's changes weigh most.
            scales = [0.1 if free else 5.0 for free in chosen]
            tables = [scale * torch.randn(size) for size, scale in zip(env.n_actions, scales, strict=True)]
            actions, state = [int(torch.randint(size, ())) for size in env.n_actions], torch.randn(width)
            for mask_ongoing in (True, False):
                args = Args(mixer_state=mixer_state, mask_ongoing=mask_ongoing)
                mixer = avf_qplex.make_learner(args, env)["mixer"]
                for parameter in mixer.parameters():
                    parameter.data *= 3  # weights as they grow: at the start lambda hardly depends on m
                joint = joint_table(mixer, tables, chosen, actions, state)
                greedy = tuple(int(t.argmax()) if c else a for t, c, a in zip(tables, chosen, actions, strict=True))
                broken[mask_ongoing] += joint[greedy] < max(joint.values()) - 1e-4
    assert broken[True] == 0 and broken[False] > 2


# ---- acting and learning ------------------------------------------------------------------------------------------


def test_acting():
    """Ongoing agents keep macro-action and recurrent state; epsilon 1 is uniform over an agent's own macro-actions."""
    torch.manual_seed(0)
    agents, rng = Agents([2, 4], 3, 8), np.random.default_rng(0)
    obs, hidden = np.random.default_rng(1).random((4000, 2, 3), np.float32), torch.randn(2, 4000, 8)
    running = rng.integers(2, size=(4000, 2))
    infos = {"macro_done": rng.random((4000, 2)) < 0.5, "macro_action": running}
    free = infos["macro_done"]
    actions, moved = act(agents, obs, infos, hidden, 1.0, rng)
    np.testing.assert_array_equal(actions[~free], running[~free])
    np.testing.assert_array_equal((moved == hidden).all(2).T.numpy(), ~free)
    for agent, n in enumerate((2, 4)):
        counts = np.bincount(actions[free[:, agent], agent], minlength=n)
        assert len(counts) == n and (abs(counts / counts.sum() - 1 / n) < 0.05).all()
    greedy, moved = act(agents, obs, infos, hidden)
    with torch.no_grad():
        inputs = torch.from_numpy(obs).transpose(0, 1), torch.from_numpy(running).T
        utilities, states = agents(*inputs, hidden, [4000])
    best = utilities.argmax(2).T.numpy()
    np.testing.assert_array_equal(greedy, np.where(free, best, running))
    torch.testing.assert_close(moved[torch.from_numpy(free).T], states[torch.from_numpy(free).T])
    # epsilon 0.4: the greedy one with probability 0.6 plus its share of the random ones
    actions, _ = act(agents, obs, infos, hidden, 0.4, rng)
    for agent, n in enumerate((2, 4)):
        same = (actions == best)[free[:, agent], agent].mean()
        assert same == pytest.approx(0.6 + 0.4 / n, abs=0.05)


def test_evaluation_counts_the_first_episode_of_each_environment():
    """Agents that always move to the target, against the same episodes played without the evaluation's code."""
    env = envs.make("ct-10", 40)
    agents = Agents(env.n_actions, 4, 8)
    agents.output.bias.data[..., 0] = 100.0  # Move-to-T
    result = evaluate(agents, env, 0.9, seed=3)
    env.reset(seed=3)
    length, success = np.zeros(40), np.zeros(40)
    while (length == 0).any():
        _, _, terminations, truncations, _ = env.step(np.zeros((40, 10), int))
        over = terminations | truncations
        first = over & (length == 0)
        length[first], success[first] = env.elapsed[first], terminations[first]
        env.reset(options={"reset_mask": over})
    np.testing.assert_array_equal(result["length"], length)
    np.testing.assert_array_equal(result["success"], success)
    np.testing.assert_array_equal(result["return"], success)
    np.testing.assert_allclose(result["discounted_return"], success * 0.9 ** (length - 1))
    assert 0 < success.mean() < 1
    assert evaluate(agents, env, 0.9, seed=4)["length"].tolist() != length.tolist()


class Recorder:
    """Logs what training does: the learner and its target, the environment's first reset on, actions, buffer."""

    def __init__(self, monkeypatch, script):
        self.envs, self.log, self.copies = [], [], []
        make = envs.make

        def recording(*args, **kwargs):
            env = make(*args, **kwargs)
            self.envs.append(env)
            if len(self.envs) == 1:  # the second one is for evaluation
                step = env.step

                def logged(actions):
                    before = env._obs.copy(), env._state(), env.macro_done.copy()
                    result = step(actions)
                    self.log.append((*before, env.macro_action.copy(), *(np.copy(x) for x in result[:4]), result[4]))
                    return result

                env.step = logged
            return env

        def deepcopy(module):
            self.copies.append((module, copy.deepcopy(module)))
            return self.copies[-1][1]

        monkeypatch.setattr(envs, "make", recording)
        monkeypatch.setattr(script, "copy", types.SimpleNamespace(deepcopy=deepcopy))
        self.buffers = Spy(monkeypatch, script, "ReplayBuffer").results

    def episodes(self):
        """Those that ended, in that order, as `tests.rollouts.play` gives them."""
        count = len(self.log[0][0])
        running, ended = [[] for _ in range(count)], []
        for obs, state, free, action, after, reward, terminated, truncated, infos in self.log:
            for e in range(count):
                running[e].append(Step(obs[e], state[e], free[e], action[e], reward[e], None))
                if terminated[e] or truncated[e]:
                    ended.append(Episode(running[e], after[e], infos["state"][e], terminated[e]))
                    running[e] = []
        return ended


@pytest.mark.parametrize("script", [avf_vdn, avf_qplex])
def test_training_stores_what_was_played(tmp_path, monkeypatch, script):
    """Rows of the memory at the end of a run against its environment's log: discounts, scaled rewards, states before
    each step, terminations; and a recurrent state starts from zero with every episode."""
    recorder, acted = Recorder(monkeypatch, script), Spy(monkeypatch, script, "act")
    options = dict(total_timesteps=800, learning_starts=400, reward_scale=10.0, gamma=0.9, eval_frequency=800)
    train_args = args_for(script, "wtd-s", runs_dir=str(tmp_path), **{**TINY, **options})
    script.train(train_args)
    ended, buffer = recorder.episodes(), recorder.buffers[0]
    assert 1 < len(ended) < 50
    for place, episode in zip(buffer.queue[-len(ended) :], ended, strict=True):
        check_rows(buffer, place, expected_rows(episode, 0.9, reward_scale=10.0))
    exploring = [call for call in acted.calls if call.rng is not None]
    assert len(exploring) == 200 and len(recorder.log) == 200
    restarts = 0
    for call in exploring:
        fresh = (call.infos["macro_action"] < 0).all(1)
        restarts += fresh.sum()
        assert not call.hidden[:, fresh].any() and call.hidden[:, ~fresh].abs().sum((0, 2)).bool().all()
    assert restarts == 4 + len(ended) - sum(len(log[0]) for log in recorder.log[-1:] if (log[6] | log[7]).any())


@pytest.mark.parametrize(
    "env_id, options",
    [("ct-10", {})]
    + [("wtd-s", dict(mixer_state=m)) for m in ("single", "real", "decision")]
    + [("bp-10", dict(mask_ongoing=False)), ("bp-10", dict(td_lambda=0.8, hysteresis=0.5, learning_rate_end=0.0))]
    + [("bp-10-primitive", {}), ("wtd-s-primitive", {}), ("ct-10-primitive", {})],
)
def test_smoke_run_takes_gradient_steps(tmp_path, monkeypatch, env_id, options):
    smoke(tmp_path, monkeypatch, avf_qplex, env_id, options)


def smoke(tmp_path, monkeypatch, script, env_id, options):
    losses = Spy(monkeypatch, script, "td_loss")
    args = args_for(script, env_id, runs_dir=str(tmp_path), **{**TINY, "total_timesteps": 800, **options})
    folder = script.train(args)
    assert len(losses.calls) == (800 - 200) // 40
    assert all(torch.isfinite(x).all() for result in losses.results for x in result)
    torch.manual_seed(args.seed)
    start = script.make_learner(args, envs.make(env_id)).state_dict()
    networks = script.load(folder / "last.pt")["networks"]
    assert networks.keys() == start.keys()
    same = [name for name, value in networks.items() if torch.equal(value, start[name])]
    assert not same, "every parameter was updated"
    assert [step for step, _ in scalars(folder)["eval/return"]] == [400, 800]


def test_same_seed_same_curve_and_seed_zero_counts(tmp_path):
    curves = []
    for run, seed in enumerate((0, 0, 1)):
        options = {**TINY, "train_frequency": 6, "total_timesteps": 800, "eval_frequency": 800}
        folder = train(args_for(avf_qplex, "wtd-s", seed=seed, runs_dir=str(tmp_path / str(run)), **options))
        curves.append(scalars(folder))
    assert "losses/td_loss" in curves[0]
    assert curves[0] == curves[1] and curves[0] != curves[2]


def test_epsilon_falls(tmp_path, monkeypatch):
    acted = Spy(monkeypatch, avf_qplex, "act")
    options = {**TINY, "total_timesteps": 8_000, "learning_starts": 2_000, "exploration_timesteps": 4_000}
    options |= dict(num_envs=20, eval_frequency=8_000)
    folder = train(args_for(avf_qplex, "bp-10", runs_dir=str(tmp_path), **options))
    logged = scalars(folder)["charts/epsilon"]
    assert [step for step, _ in logged] == [2_000, 4_000, 6_000, 8_000]
    assert [round(value, 2) for _, value in logged] == [1.0, 0.53, 0.05, 0.05]
    epsilon = [call.epsilon for call in acted.calls if call.rng is not None]
    assert set(epsilon[:101]) == {1.0} and epsilon[200] == pytest.approx(0.525) and epsilon[-1] == 0.05
    assert all(call.epsilon == 0 for call in acted.calls if call.rng is None), "evaluation is greedy"


@pytest.mark.parametrize("script", [avf_vdn, avf_qplex])
def test_first_update_moves_the_target_by_polyak(tmp_path, monkeypatch, script):
    recorder, losses = Recorder(monkeypatch, script), Spy(monkeypatch, script, "td_loss")
    options = {**TINY, "total_timesteps": 400, "train_frequency": 200, "polyak": 0.9, "learning_rate": 0.01}
    options["learning_rate_end"] = 1.0
    script.train(args_for(script, "bp-10", runs_dir=str(tmp_path), **options))
    assert len(losses.calls) == 1
    ((learner, target),) = recorder.copies
    torch.manual_seed(1)
    start = script.make_learner(args_for(script, "bp-10", **options), recorder.envs[0]).state_dict()
    for name, value in target.state_dict().items():
        expected = 0.9 * start[name] + 0.1 * learner.state_dict()[name]
        torch.testing.assert_close(value, expected)
        assert not torch.allclose(expected, start[name], atol=1e-5), name


def test_training_passes_on_what_it_should(tmp_path, monkeypatch):
    """Evaluation seeds differ from point to point and from run to run; hysteresis and step size follow their schedules;
    the gradient is clipped; loss and networks get the settings."""
    evaluated, losses = Spy(monkeypatch, avf_qplex, "evaluate"), Spy(monkeypatch, avf_qplex, "td_loss")
    optimizers, rates, norms = [], [], []

    class Adam(torch.optim.Adam):
        def __init__(self, *args, **kwargs):
            super().__init__(*args, **kwargs)
            optimizers.append(self)

        def step(self, closure=None):
            parameters = self.param_groups[0]["params"]
            rates.append(self.param_groups[0]["lr"])
            norms.append(sum(p.grad.square().sum() for p in parameters).sqrt().item())
            return super().step(closure)

    monkeypatch.setattr(torch.optim, "Adam", Adam)
    options = dict(hysteresis=0.2, exploration_timesteps=400, learning_rate=1e-3, learning_rate_end=0.0,
                   max_grad_norm=1e-3, td_lambda=0.25)  # fmt: skip
    for seed in (0, 1):
        train(args_for(avf_qplex, "bp-10", seed=seed, runs_dir=str(tmp_path), **{**TINY, **options}))
    seeds = [call.seed for call in evaluated.calls]
    assert len(seeds) == len(set(seeds)) == 6 and all(call.gamma == 0.95 for call in evaluated.calls)
    # The first updates wait for an episode to end; the 25th is made after the step from 1,196 to 1,200.
    learned = [call for call in losses.calls if call.td_lambda == 0.25]
    assert len(learned) == 50 and len(learned[0].utilities) == 8 and learned[0].utilities.shape[1] == 7
    steps = np.array([236 + 40 * k for k in range(25)])
    betas = [call.hysteresis for call in learned[:25]]
    assert betas == pytest.approx(np.interp((steps + 4 - 200) / 400, [1, 2], [0.2, 1.0]))
    assert betas[0] == 0.2 and 0.2 < betas[10] < 1 and betas[-1] == 1.0
    assert rates[:25] == pytest.approx(1e-3 * (1 - steps / 1_200))
    assert len(optimizers) == 2 and max(norms) == pytest.approx(1e-3, rel=1e-3)


def test_step_size_is_constant_without_an_end(tmp_path, monkeypatch):
    rates, step = [], torch.optim.Adam.step
    monkeypatch.setattr(torch.optim.Adam, "step", lambda self: rates.append(self.param_groups[0]["lr"]) or step(self))
    options = {**TINY, "total_timesteps": 600, "learning_rate": 3e-4, "learning_rate_end": 1.0}
    train(args_for(avf_qplex, "bp-10", runs_dir=str(tmp_path), **options))
    assert rates == [3e-4] * 10


def test_finds_the_optimum_of_a_non_monotonic_game(tmp_path, monkeypatch):
    """Payoff 8 for (a, a), -12 beside it, 0 elsewhere: the average over what the other does speaks against a.

    With hysteretic errors, as on Box Pushing: with the plain loss QPLEX stays at 0 for thousands of updates.
    """
    monkeypatch.setitem(envs._TASKS, "matrix", (MatrixGame, {}))
    args = Args(env="matrix", runs_dir=str(tmp_path), total_timesteps=6_000, learning_starts=500, train_frequency=24,
                exploration_timesteps=100_000, end_e=1.0, learning_rate=1e-3, batch_size=32, window=4, polyak=0.95,
                td_lambda=1.0, hysteresis=0.5, eval_frequency=1_000, eval_episodes=1)  # fmt: skip
    for seed in (1, 2):
        args.seed = seed
        assert [value for _, value in scalars(train(args))["eval/return"][-3:]] == [8.0] * 3
