"""What the AVF scripts share: rows, batches, targets, networks, acting and training.

tests/test_sync.py keeps the definitions of the same name identical. So each is tested once, in avf_qplex.py, and in
avf_vdn.py too where that one differs. tests/test_avf_mixers.py has the mixers and what they see, and
tests/test_available.py the macro-actions that cannot be started.
"""

import copy
import types
from itertools import combinations

import numpy as np
import pytest
import torch

import avf_qmix
import avf_qplex
import avf_vdn
import cen_maddrqn
import dec_maddrqn
import envs
import mac_iaicc
from avf_qplex import Agents, Args, ReplayBuffer, act, evaluate, make_batch, td_loss, utilities_at_rows
from tests.curves import scalars
from tests.matrix_game import MatrixGame
from tests.rollouts import TINY, Episode, Spy, Step, args_for, check_rows, expected_rows, play, step_by_step

Q_LEARNERS = [avf_vdn, avf_qmix, avf_qplex, dec_maddrqn, cen_maddrqn]
with_and_without_state = pytest.mark.parametrize("script", [avf_vdn, avf_qplex], ids=lambda script: script.ALGORITHM)
every_q_learner = pytest.mark.parametrize("script", Q_LEARNERS, ids=lambda script: script.ALGORITHM)

# ---- rows ---------------------------------------------------------------------------------------------------------


@with_and_without_state
@pytest.mark.parametrize("env_id", ["wtd-s", "bp-10"])
def test_rows_are_the_steps_at_which_somebody_chose(script, env_id):
    """The stored rows are the rows worked out step by step from a log of the episodes."""
    _, _, buffer, ended = play(script, env_id, 5, horizon=60)
    assert {episode.terminated for episode in ended} == ({False} if env_id == "wtd-s" else {True, False})
    assert len(buffer.ended) == len(ended)
    longest = 0
    for stored, episode in zip(buffer.ended, ended, strict=True):
        rows = expected_rows(episode, 0.9)
        check_rows(stored, rows)
        longest = max(longest, *np.diff([row["step"] for row in rows]))
        only_goes_on = np.eye(stored["available"].shape[2], dtype=bool)[stored["action"]]
        busy = stored["since"] < np.arange(len(rows))[:, None]
        np.testing.assert_array_equal(stored["available"][busy], only_goes_on[busy])
    assert longest > 2, "intervals of several steps occur"


@pytest.mark.parametrize("env_id", ["wtd-s", "bp-10", "ct-10"])
def test_replayed_utilities_are_those_of_acting(env_id):
    """They are equal at every row, with other agents' rows in between; hidden states move at own decisions alone."""
    _, agents, buffer, ended = play(avf_qplex, env_id, 5, horizon=50)
    with torch.no_grad():
        utilities = utilities_at_rows(agents, make_batch(list(buffer.ended)))
    busy = 0
    for b, episode in enumerate(ended):
        rows = [step for step in episode.steps if step.free.any()]
        acted = torch.stack([step.utilities for step in rows])  # [rows, n, A]
        torch.testing.assert_close(utilities[b, : len(rows)], acted)
        before = torch.zeros_like(episode.steps[0].hidden)
        for step in episode.steps:
            np.testing.assert_array_equal((step.hidden != before).any(1), step.free)
            before = step.hidden
        busy += sum((~step.free).sum() for step in rows)
    assert busy > 50


@pytest.mark.parametrize("env_id", ["wtd-s", "ct-10"])
def test_networks_run_over_own_decisions_alone(env_id):
    """Episodes of different lengths side by side give what every agent of every episode gives on its own."""
    _, agents, buffer, _ = play(avf_qplex, env_id, 4, seed=2, horizon=20)
    batch = make_batch(list(buffer.ended))
    assert len({len(episode) for episode in buffer.ended}) > 1
    with torch.no_grad():
        torch.testing.assert_close(utilities_at_rows(agents, batch), step_by_step(agents, batch))


def test_a_batch_has_whole_episodes_and_repeats_their_final_rows():
    """All fields, and valid, free, previous and macro_state, against the log of the episodes."""
    _, _, buffer, ended = play(avf_qplex, "bp-10", 5, horizon=60)
    batch = make_batch(list(buffer.ended))
    lengths = [len(expected_rows(episode, 0.9)) for episode in ended]
    assert min(lengths) < max(lengths) == batch["valid"].shape[1]
    for b, episode in enumerate(ended):
        rows = expected_rows(episode, 0.9)
        repeated = rows + rows[-1:] * (max(lengths) - len(rows))
        for name in buffer.running.dtype.names:
            np.testing.assert_allclose(batch[name][b], np.stack([row[name] for row in repeated]), 1e-5, 1e-5)
        assert batch["valid"][b].tolist() == [True] * (len(rows) - 1) + [False] * (max(lengths) - len(rows) + 1)
        free = [step.free for step in episode.steps if step.free.any()]
        np.testing.assert_array_equal(batch["free"][b, : len(rows)], [*free, [True] * 2])
        assert not batch["free"][b, len(rows) :].any(), "nobody chooses after the end"
        for k, i in np.ndindex(len(repeated), 2):
            last = repeated[k]["step"]
            if last < len(episode.steps):
                last = max(t for t in range(last + 1) if episode.steps[t].free[i])  # the step of agent i's last choice
            ran = episode.steps[last - 1].action[i] if last > 0 else -1
            assert batch["previous"][b, k, i] == ran
            state = episode.steps[last].state if last < len(episode.steps) else episode.state
            np.testing.assert_array_equal(batch["macro_state"][b, k, i], state)


@with_and_without_state
@pytest.mark.parametrize("capacity", [2, 7])
def test_batches_never_mix_episodes(script, capacity):
    """All that is stored tells its episode, in far more episodes than the buffer holds.

    With capacity 2, more episodes end at once than it holds. The oldest one makes place.
    """
    env = envs.make("bp-10", 4, horizon=12)
    buffer = script.ReplayBuffer(env, capacity)
    rng = np.random.default_rng(0)
    tag = np.arange(4.0)  # the number of the episode that runs in each environment
    order = []
    at_once = 0
    _, infos = env.reset(seed=0)

    def tagged(*shape):
        return np.broadcast_to(tag.reshape(4, *[1] * len(shape)), (4, *shape)).astype(np.float32)

    for _ in range(150):
        obs = tagged(2, env.single_observation_space.shape[1])
        state = tagged(env.state_size)
        actions = rng.integers(0, env.n_actions, (4, 2))
        buffer.begin_rows(obs, {**infos, "state": state}, actions, infos["macro_done"])
        _, _, terminations, truncations, infos = env.step(actions)
        over = terminations | truncations | (rng.random(4) < 0.02)
        buffer.add_step(*([state] if script is avf_qplex else []), tag, 0.9 * ~terminations)
        if over.any():
            all_free = infos["macro_done"] | over[:, None]
            buffer.end_episodes(over, obs, {**infos, "state": state, "macro_done": all_free})
            order += tag[over].tolist()
            at_once = max(at_once, over.sum())
            tag[over] = tag.max() + 1 + np.arange(over.sum())
            _, infos = env.reset(options={"reset_mask": over})
        assert [episode["obs"][0, 0, 0] for episode in buffer.ended] == order[-capacity:]
        if order:
            batch = script.make_batch(buffer.sample(8, rng))
            for name in batch.keys() & {"obs", "state", "last_state", "macro_state"}:
                of_episode = batch["obs"][:, :1, 0, 0].reshape(8, *[1] * (batch[name].dim() - 1))
                assert (batch[name] == of_episode).all()
    assert at_once > 2 and len(order) > 30


def test_every_episode_is_drawn_equally_often_and_is_whole():
    """An episode's length does not matter, and neither does its age."""
    env = envs.make("bp-10", 20)
    buffer = ReplayBuffer(env, 20)
    _, infos = env.reset(seed=0)
    obs = np.zeros((20, *env.single_observation_space.shape), np.float32)
    obs += np.arange(20)[:, None, None]  # every row tells its episode
    state = np.zeros((20, env.state_size), np.float32)
    for t in range(20):  # environment e's episode has e + 1 rows and a final one
        buffer.begin_rows(obs, infos, np.zeros((20, 2), int), np.ones((20, 2), bool) & (np.arange(20) >= t)[:, None])
        buffer.add_step(state, np.zeros(20), np.ones(20))
        buffer.end_episodes(np.arange(20) == t, obs, {**infos, "macro_action": np.zeros((20, 2), int)})
    drawn = buffer.sample(20_000, np.random.default_rng(0))
    counts = np.bincount([int(episode["obs"][0, 0, 0]) for episode in drawn], minlength=20)
    assert np.abs(counts - 1_000).max() < 5 * np.sqrt(1_000), counts
    batch = make_batch(drawn[:500])
    assert batch["valid"].shape == (500, 21)
    torch.testing.assert_close(batch["valid"].sum(1), batch["obs"][:, 0, 0, 0].long() + 1)


# ---- target -------------------------------------------------------------------------------------------------------


def hand_made_batch():
    """Three episodes of two agents that have two macro-actions each.

    Episode 0 terminates after row 1. Row 0: both choose. Row 1: agent 1 chooses, agent 0 goes on.
    Episode 1 is truncated after row 1. Row 0: both choose. Row 1: agent 0 chooses, agent 1 goes on.
    Episode 2 is truncated after its only row. Its final row is repeated.
    """
    both, first, second, none = [True, True], [True, False], [False, True], [False, False]
    free = torch.tensor([[both, second, both], [both, first, both], [both, both, none]])
    action = torch.tensor([[[1, 0], [1, 1], [1, 1]], [[0, 1], [1, 1], [1, 1]], [[0, 0], [0, 0], [0, 0]]])
    available = free[..., None] | torch.nn.functional.one_hot(action, 2).bool()
    available[2, 2] = True  # a repeated row is the final one, at which both are free
    return {
        "free": free,
        "action": action,
        "available": available,
        "valid": torch.tensor([[True, True, False], [True, True, False], [True, False, False]]),
        "reward": torch.tensor([[1.0, 2.0, 0.0], [3.0, 4.0, 0.0], [5.0, 0.0, 0.0]]),
        "discount": torch.tensor([[0.81, 0.0, 1.0], [0.9, 0.729, 1.0], [0.5, 1.0, 1.0]]),
        "state": torch.zeros(3, 3, 1),
        "last_state": torch.zeros(3, 3, 1),
        "macro_state": torch.zeros(3, 3, 2, 1),
    }


# Utilities [episode, row, agent, macro-action]. Those of a busy agent are those of its latest decision.
ONLINE = torch.tensor(
    [
        [[[1.0, 2.0], [5.0, 4.0]], [[1.0, 2.0], [6.0, 8.0]], [[7.0, 6.0], [1.0, 9.0]]],
        [[[3.0, 1.0], [1.0, 2.0]], [[0.0, 5.0], [1.0, 2.0]], [[2.0, 4.0], [3.0, 2.0]]],
        [[[4.0, 9.0], [2.0, 9.0]], [[1.0, 0.0], [0.0, 1.0]], [[1.0, 0.0], [0.0, 1.0]]],
    ]
)
TARGET = torch.tensor(
    [
        [[[10.0, 20.0], [15.0, 25.0]], [[10.0, 20.0], [55.0, 65.0]], [[1.0, 2.0], [3.0, 4.0]]],
        [[[30.0, 40.0], [35.0, 45.0]], [[50.0, 60.0], [35.0, 45.0]], [[70.0, 80.0], [75.0, 85.0]]],
        [[[99.0, 99.0], [99.0, 99.0]], [[6.0, 99.0], [99.0, 8.0]], [[6.0, 99.0], [99.0, 8.0]]],
    ]
)
Q = torch.tensor([7.0, 10.0, 5.0, 7.0, 6.0])
ONE_ROW_TARGET = torch.tensor([69.85, 2.0, 97.5, 116.995, 12.0])


def add(utilities, actions, available, state):
    """A mixer that is as plain as VDN's."""
    return utilities.gather(-1, actions[..., None])[..., 0].sum(-1)


def loss_of(script, utilities=ONLINE, target_utilities=TARGET, batch=None, hysteresis=1.0, td_lambda=0.0, **options):
    """What the script's td_loss says of the batch made by hand, or of another one."""
    mixers = [] if script is avf_vdn else [add, add]
    args = script.Args(td_lambda=td_lambda, **options)
    return script.td_loss(utilities, target_utilities, *mixers, batch or hand_made_batch(), args, hysteresis)


@with_and_without_state
def test_td_target_by_hand(script):
    """Joint values: 2 + 5 = 7, 2 + 8 = 10; 3 + 2 = 5, 5 + 2 = 7; 4 + 2 = 6. Targets:

    Episode 0, row 0: agent 0 goes on with macro-action 1 (target 20). Agent 1 chooses, online argmax 1, target 65:
    y = 1 + 0.81 * 85 = 69.85. Row 1: it terminated: y = 2.
    Episode 1, row 0: agent 0 chooses, online argmax 1, target 60. Agent 1 goes on with macro-action 1, target 45:
    y = 3 + 0.9 * 105 = 97.5. Row 1: it was truncated, so it bootstraps from the final observation: agent 0 argmax 1,
    80; agent 1 argmax 0, 75: y = 4 + 0.729 * 155 = 116.995.
    Episode 2, row 0: agent 0 argmax 0, 6; agent 1 argmax 1, 8: y = 5 + 0.5 * 14 = 12.
    """
    loss, q, target = loss_of(script)
    torch.testing.assert_close(q, Q)
    torch.testing.assert_close(target, ONE_ROW_TARGET)
    torch.testing.assert_close(loss, torch.tensor([62.85, -8.0, 92.5, 109.995, 6.0]).square().mean())


@with_and_without_state
def test_hysteresis_scales_negative_errors(script):
    loss, q, target = loss_of(script, hysteresis=0.5)
    torch.testing.assert_close(loss, torch.tensor([62.85, -4.0, 92.5, 109.995, 6.0]).square().mean())
    torch.testing.assert_close((q, target), (Q, ONE_ROW_TARGET), msg="nothing else changes")


@with_and_without_state
def test_the_target_never_changes_what_a_busy_agent_runs(script):
    """Make the other macro-action of the busy agents far better: the target must not move."""
    tempting = ONLINE.clone()
    tempting[0, 1, 0, 0] = tempting[1, 1, 1, 0] = 1000.0  # both are busy there, with macro-action 1
    torch.testing.assert_close(loss_of(script, tempting)[2], ONE_ROW_TARGET)


@with_and_without_state
def test_q_lambda_by_hand(script):
    """lambda = 0.5. Episode 0: G[1] = 2; G[0] = 1 + 0.81 (0.5 * 85 + 0.5 * 2) = 36.235. Episode 1: G[1] = 116.995;
    G[0] = 3 + 0.9 (0.5 * 105 + 0.5 * 116.995) = 102.89775. lambda = 1: G[0] = 1 + 0.81 * 2, 3 + 0.9 * 116.995.
    The last row of an episode keeps the one-row target, because there is no further return. That holds for episode 2,
    too, which is shorter than the others.
    """
    half = loss_of(script, td_lambda=0.5)[2]
    torch.testing.assert_close(half, torch.tensor([36.235, 2.0, 102.89775, 116.995, 12.0]))
    whole = loss_of(script, td_lambda=1.0)[2]
    torch.testing.assert_close(whole, torch.tensor([2.62, 2.0, 108.2955, 116.995, 12.0]))


@with_and_without_state
@pytest.mark.parametrize(
    ("td_lambda", "expected"),
    [
        (0.0, [6.0, 12.0, 23.0, 8.0, 13.0]),
        (0.5, [6.6875, 12.75, 23.0, 9.25, 13.0]),
        (1.0, [7.75, 13.5, 23.0, 10.5, 13.0]),
    ],
)
def test_q_lambda_reaches_back_to_the_first_row(script, td_lambda, expected):
    """One agent with one macro-action. Episode 0 has three rows and a final one, episode 1 only two, and both are cut.

    Rewards 1, 2, 3 and 4, 5. Discounts 0.5. Q' at the rows after these: 10, 20, 40 and 8, 16. With lambda 0.5:
    G[2] = 3 + 20 = 23; G[1] = 2 + 0.5 (10 + 11.5) = 12.75; G[0] = 1 + 0.5 (5 + 6.375) = 6.6875; and in the shorter
    one G[1] = 5 + 8 = 13; G[0] = 4 + 0.5 (4 + 6.5) = 9.25.
    """
    batch = {
        "free": torch.tensor([[True] * 4, [True, True, True, False]])[..., None],
        "action": torch.zeros(2, 4, 1, dtype=torch.int64),
        "available": torch.ones(2, 4, 1, 1, dtype=torch.bool),
        "valid": torch.tensor([[True, True, True, False], [True, True, False, False]]),
        "reward": torch.tensor([[1.0, 2.0, 3.0, 0.0], [4.0, 5.0, 0.0, 0.0]]),
        "discount": torch.tensor([[0.5, 0.5, 0.5, 1.0], [0.5, 0.5, 1.0, 1.0]]),
        **{name: torch.zeros(2, 4, 1) for name in ("state", "last_state")},
        "macro_state": torch.zeros(2, 4, 1, 1),
    }
    target_utilities = torch.tensor([[99.0, 10.0, 20.0, 40.0], [99.0, 8.0, 16.0, 16.0]])[..., None, None]
    _, _, target = loss_of(script, torch.zeros(2, 4, 1, 1), target_utilities, batch, td_lambda=td_lambda)
    torch.testing.assert_close(target, torch.tensor(expected))


def test_mixers_see_the_choices_of_the_row_and_the_best_choices():
    """The mixer gets what was run, the target mixer what is best, and both what is available and their states."""
    batch = hand_made_batch()
    batch["state"] = torch.arange(9.0).reshape(3, 3, 1)
    batch["last_state"] = 10 + batch["state"]
    seen = {}

    def mixer(name):
        def mix(utilities, actions, available, state):
            seen[name] = utilities, actions, available, state
            return add(utilities, actions, available, state)

        return mix

    td_loss(ONLINE, TARGET, mixer("online"), mixer("target"), batch, Args(mixer_state="real"))
    given = batch["available"]
    torch.testing.assert_close(seen["online"], (ONLINE, batch["action"], given, batch["last_state"]))
    best = torch.tensor([[[1, 0], [1, 1], [0, 1]], [[0, 1], [1, 1], [1, 0]], [[1, 1], [0, 1], [0, 1]]])
    torch.testing.assert_close(seen["target"], (TARGET, best, given, batch["state"]))


@with_and_without_state
def test_rows_after_the_end_count_nowhere(script):
    """Whatever stands in the repeats of a final row, and in its own reward, discount and macro-actions, is not read."""
    clean = ONLINE.clone().requires_grad_()
    loss, _, target = loss_of(script, clean, td_lambda=0.5)
    loss.backward()
    batch = hand_made_batch()
    dirty = ONLINE.clone()
    dirty_target = TARGET.clone()
    dirty[2, 2] = dirty_target[2, 2] = 1e6
    batch["reward"][:2, 2] = batch["reward"][2, 1:] = 1e6
    batch["discount"][:2, 2] = batch["discount"][2, 1:] = 1e6
    batch["action"][:2, 2] = batch["action"][2, 1:] = 0
    batch["available"][2, 2, :, 1] = False
    dirty.requires_grad_()
    dirty_loss, q, got = loss_of(script, dirty, dirty_target, batch, td_lambda=0.5)
    dirty_loss.backward()
    torch.testing.assert_close((dirty_loss, q, got), (loss, Q, target))
    torch.testing.assert_close(dirty.grad, clean.grad)


@with_and_without_state
def test_primitive_target_is_the_textbook_one(script):
    """Where every macro-action ends after a step, rows are steps, everybody chooses and the discount is gamma."""
    _, agents, buffer, _ = play(avf_qplex, "bp-10-primitive", 3, horizon=10)
    batch = make_batch(list(buffer.ended))
    assert batch["free"].all() and batch["available"].all()
    assert set(batch["discount"][batch["valid"]].tolist()) == {np.float32(0.9)}, "all were cut by the horizon"
    other = copy.deepcopy(agents)
    with torch.no_grad():
        for parameter in other.parameters():
            parameter.add_(0.1 * torch.randn_like(parameter))
        online = utilities_at_rows(agents, batch)
        evaluated = utilities_at_rows(other, batch)
    _, _, target = loss_of(script, online, evaluated, batch)
    for number, (b, k) in enumerate(np.argwhere(batch["valid"].numpy())):
        best = sum(evaluated[b, k + 1, i, online[b, k + 1, i].argmax()] for i in range(online.shape[2]))
        torch.testing.assert_close(target[number], batch["reward"][b, k] + batch["discount"][b, k] * best)


@pytest.mark.parametrize("script", [avf_qmix, avf_qplex], ids=lambda script: script.ALGORITHM)
def test_gradients_reach_everything_and_never_the_target(script):
    env, _, buffer, _ = play(script, "wtd-s", 3, horizon=40)
    learner = script.make_learner(script.Args(hidden_size=8), env)
    target = copy.deepcopy(learner)  # with gradients required, so that one that flows is seen
    batch = make_batch(list(buffer.ended))
    utilities = utilities_at_rows(learner["agents"], batch)
    target_utilities = utilities_at_rows(target["agents"], batch)
    loss, _, _ = script.td_loss(utilities, target_utilities, learner["mixer"], target["mixer"], batch, script.Args())
    loss.backward()
    for name, parameter in learner.named_parameters():
        assert parameter.grad is not None and parameter.grad.abs().sum() > 0, name
    assert all(parameter.grad is None for parameter in target.parameters())


# ---- networks -----------------------------------------------------------------------------------------------------


def test_agents_are_separate_gru_networks():
    """Each agent's slice equals PyTorch's own layers with its weights."""
    torch.manual_seed(0)
    agents = Agents(2, 4, obs_size=3, hidden_size=8)
    obs = torch.randn(2, 3, 5, 3)  # two agents, three episodes, five decisions
    previous = torch.randint(-1, 4, (2, 3, 5))
    start = torch.randn(2, 3, 8)
    with torch.no_grad():
        utilities, last = agents(obs, previous, start)
        for i in range(2):
            x = torch.cat([obs[i], torch.eye(5)[previous[i], :4]], -1)  # row -1 of the identity is cut to zeros
            x = torch.relu(x @ agents.encoder.weight[i] + agents.encoder.bias[i])
            gru = torch.nn.GRU(8, 8, batch_first=True)
            gru.weight_ih_l0.copy_(agents.input_layer.weight[i].T)
            gru.bias_ih_l0.copy_(agents.input_layer.bias[i, 0])
            gru.weight_hh_l0.copy_(agents.hidden_weight[i].T)
            gru.bias_hh_l0.zero_()
            states, end = gru(x, start[i : i + 1])
            head = torch.relu(states @ agents.head.weight[i] + agents.head.bias[i])
            torch.testing.assert_close(utilities[i], head @ agents.output.weight[i] + agents.output.bias[i])
            torch.testing.assert_close(last[i], end[0])
    assert agents.start(3).shape == (2, 3, 8) and not agents.start(3).any()


def test_obs_scale_reaches_the_macro_observation_only():
    torch.manual_seed(0)
    plain, scaled = (Agents(2, 3, 4, 8, obs_scale) for obs_scale in (1.0, 5.0))
    scaled.load_state_dict(plain.state_dict())
    obs, previous, hidden = torch.randn(2, 1, 6, 4), torch.randint(-1, 3, (2, 1, 6)), torch.randn(2, 1, 8)
    with torch.no_grad():
        torch.testing.assert_close(scaled(obs, previous, hidden), plain(5 * obs, previous, hidden))
        assert not torch.allclose(scaled(obs, previous, hidden)[0], plain(obs, previous, hidden)[0])
    learner = avf_qplex.make_learner(Args(env="ct-10", obs_scale=4.0, hidden_size=32), envs.make("ct-10"))
    assert learner["agents"].obs_scale == 4.0 and learner["agents"].start(1).shape == (10, 1, 32)


# ---- acting -------------------------------------------------------------------------------------------------------


def test_acting():
    """Busy agents keep macro-action and hidden state. Epsilon 1 is uniform over what is available."""
    torch.manual_seed(0)
    rng = np.random.default_rng(0)
    agents = Agents(2, 4, 3, 8)
    obs = rng.random((4000, 2, 3), np.float32)
    hidden = torch.randn(2, 4000, 8)
    n_actions = (2, 4)  # agent 0 has two macro-actions, the other two are padding
    running = rng.integers(n_actions, size=(4000, 2))
    free = rng.random((4000, 2)) < 0.5
    own = np.arange(4) < np.array(n_actions)[:, None]
    available = np.where(free[..., None], own, np.eye(4, dtype=bool)[running])
    infos = {"macro_done": free, "macro_action": running, "available": available}
    actions, moved = act(agents, obs, infos, hidden, 1.0, rng)
    np.testing.assert_array_equal(actions[~free], running[~free])
    np.testing.assert_array_equal((moved == hidden).all(2).T.numpy(), ~free)
    for agent, n in enumerate(n_actions):
        counts = np.bincount(actions[free[:, agent], agent], minlength=n)
        assert len(counts) == n and (abs(counts / counts.sum() - 1 / n) < 0.05).all()
    greedy, moved = act(agents, obs, infos, hidden)
    with torch.no_grad():
        own_obs = torch.from_numpy(obs).transpose(0, 1)[:, :, None]
        utilities, states = agents(own_obs, torch.from_numpy(running).T[:, :, None], hidden)
    utilities = utilities[:, :, 0].transpose(0, 1)
    best = torch.stack([utilities[:, 0, :2].argmax(1), utilities[:, 1].argmax(1)], 1).numpy()
    np.testing.assert_array_equal(greedy, np.where(free, best, running))
    torch.testing.assert_close(moved[torch.from_numpy(free).T], states[torch.from_numpy(free).T])
    # With epsilon 0.4 the greedy one has probability 0.6 plus its share of the random ones, for each agent by itself.
    actions, _ = act(agents, obs, infos, hidden, 0.4, rng)
    same = actions == best
    for agent, n in enumerate(n_actions):
        assert same[free[:, agent], agent].mean() == pytest.approx(0.6 + 0.4 / n, abs=0.05)
    together = same[free.all(1)].all(1).mean()
    assert together == pytest.approx((0.6 + 0.4 / 2) * (0.6 + 0.4 / 4), abs=0.06)


def test_evaluation_counts_the_first_episode_of_each_environment(monkeypatch):
    """Agents that always move to the target, against the same episodes played without the evaluation's code.

    Their play is greedy, and hidden states are zero where an episode begins.
    """
    acted = Spy(monkeypatch, avf_qplex, "act")
    env = envs.make("ct-10", 40)
    agents = Agents(10, 2, 4, 8)
    agents.output.bias.data[..., 0] = 100.0  # Move-to-T
    result = evaluate(agents, env, 0.9, seed=3)
    env.reset(seed=3)
    length = np.zeros(40)
    success = np.zeros(40)
    while (length == 0).any():
        _, _, terminations, truncations, _ = env.step(np.zeros((40, 10), int))
        over = terminations | truncations
        first = over & (length == 0)
        length[first] = env.elapsed[first]
        success[first] = terminations[first]
        env.reset(options={"reset_mask": over})
    np.testing.assert_array_equal(result["length"], length)
    np.testing.assert_array_equal(result["success"], success)
    np.testing.assert_array_equal(result["return"], success)
    np.testing.assert_allclose(result["discounted_return"], success * 0.9 ** (length - 1))
    assert 0 < success.mean() < 1
    restarts = 0
    for call in acted.calls:
        begins = (call.infos["macro_action"] < 0).all(1)
        restarts += begins.sum()
        assert call.epsilon == 0
        assert not call.hidden[:, begins].any() and call.hidden[:, ~begins].any(2).all()
    assert restarts > 60
    assert evaluate(agents, env, 0.9, seed=4)["length"].tolist() != length.tolist()


# ---- training -----------------------------------------------------------------------------------------------------


@pytest.fixture
def matrix_game(monkeypatch):
    """Makes the task "matrix" known: episodes of three steps, so that runs are fast."""
    monkeypatch.setitem(envs._TASKS, "matrix", (MatrixGame, {}, {}))


class Recorder:
    """Logs what training does: the steps of its environments, the learner and its target, the buffer."""

    def __init__(self, monkeypatch, script):
        self.envs = []
        self.log = []
        self.copies = []
        make = envs.make

        def recording(*args, **kwargs):
            env = make(*args, **kwargs)
            self.envs.append(env)
            if len(self.envs) == 1:  # the second one is for evaluation
                step = env.step

                def logged(actions):
                    before = env._obs.copy(), env._state(), env.macro_done.copy(), env.available.copy()
                    result = step(actions)
                    self.log.append((*before, env.macro_action.copy(), *result))
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
        running = [[] for _ in self.log[0][0]]
        ended = []
        for *before, after, rewards, terminations, truncations, infos in self.log:
            for e, steps in enumerate(running):
                steps.append(Step(*(x[e] for x in before), rewards[e]))
                if terminations[e] or truncations[e]:
                    after_it = after[e], infos["state"][e], infos["available"][e]
                    ended.append(Episode(steps, *after_it, terminations[e]))
                    running[e] = []
        return ended


@with_and_without_state
def test_training_stores_what_was_played(tmp_path, monkeypatch, script):
    """Rows at the end of a run against its environment's log: discounts, scaled rewards, states before each step,
    terminations. A hidden state starts from zero with every episode."""
    recorder = Recorder(monkeypatch, script)
    acted = Spy(monkeypatch, script, "act")
    options = dict(total_timesteps=680, learning_starts=600, reward_scale=10.0, gamma=0.9, eval_frequency=800)
    script.train(args_for(script, "bp-10", runs_dir=str(tmp_path), **{**TINY, **options}))
    ended = recorder.episodes()
    assert 1 < len(ended) < 50 and len(recorder.buffers[0].ended) == len(ended)
    assert {episode.terminated for episode in ended} == {True, False}
    for stored, episode in zip(recorder.buffers[0].ended, ended, strict=True):
        check_rows(stored, expected_rows(episode, 0.9, reward_scale=10.0))
    exploring = [call for call in acted.calls if call.rng is not None]
    assert len(exploring) == len(recorder.log) == 170
    restarts = 0
    for call in exploring:
        fresh = (call.infos["macro_action"] < 0).all(1)
        restarts += fresh.sum()
        assert not call.hidden[:, fresh].any() and call.hidden[:, ~fresh].abs().sum((0, 2)).bool().all()
    *_, terminations, truncations, _ = recorder.log[-1]
    assert restarts == 4 + len(ended) - (terminations | truncations).sum()


def smoke(folder, monkeypatch, script, env_id, **options):
    """A short run makes the updates that are due, changes every parameter and stays finite; it logs evaluations.

    Returns the arguments of the first call of td_loss. Episodes are cut after 20 steps.
    """
    domain, keywords, defaults = envs._TASKS[env_id]
    monkeypatch.setitem(envs._TASKS, env_id, (domain, {**keywords, "horizon": 20}, defaults))
    losses = Spy(monkeypatch, script, "td_loss")
    short = dict(num_envs=5, total_timesteps=200, learning_starts=80, train_frequency=20, eval_frequency=100)
    args = args_for(script, env_id, runs_dir=str(folder), **{**TINY, **short, **options})
    run = script.train(args)
    assert len(losses.calls) == 6, "one for each multiple of 20 after step 80; episodes end at step 100 or before"
    assert all(torch.isfinite(x).all() for result in losses.results for x in result)
    torch.manual_seed(np.random.SeedSequence(args.seed).generate_state(1, np.uint64).item())
    start = script.make_learner(args, envs.make(env_id)).state_dict()
    networks = script.load(run / "last.pt")["networks"]
    assert networks.keys() == start.keys()
    same = [name for name, value in networks.items() if torch.equal(value, start[name])]
    assert not same, "every parameter was updated"
    assert [step for step, _ in scalars(run)["eval/return"]] == [100, 200]
    return losses.calls[0]


@pytest.mark.slow
@pytest.mark.parametrize("env_id", envs.IDS)
def test_smoke_run_takes_gradient_steps(tmp_path, monkeypatch, env_id):
    smoke(tmp_path, monkeypatch, avf_qplex, env_id)


@pytest.mark.slow
def test_same_seed_same_curve_and_seed_zero_counts(tmp_path, matrix_game):
    """A seed changes what is played and what is learned."""
    curves = []
    for run, seed in enumerate((0, 0, 1)):
        short = {**TINY, "total_timesteps": 1_020, "learning_starts": 100, "train_frequency": 4, "batch_size": 2}
        args = Args(env="matrix", seed=seed, runs_dir=f"{tmp_path}/{run}", **short)
        curves.append(scalars(avf_qplex.train(args)))
    assert curves[0] == curves[1]
    tags = {"charts/episodic_return", "losses/td_loss", "losses/q_values"}
    rest = {"eval/return", "eval/discounted_return", "eval/length", "eval/success"}
    assert curves[0].keys() == tags | rest
    for tag in tags:
        assert curves[0][tag] != curves[2][tag], tag


def test_epsilon_falls(tmp_path, monkeypatch, matrix_game):
    acted = Spy(monkeypatch, avf_qplex, "act")
    options = dict(total_timesteps=8_000, learning_starts=2_000, exploration_timesteps=4_000, end_e=0.05)
    options |= dict(num_envs=20, eval_frequency=2_000, train_frequency=10_000)
    avf_qplex.train(Args(env="matrix", runs_dir=str(tmp_path), **{**TINY, **options}))
    epsilon = [call.epsilon for call in acted.calls if call.rng is not None]
    assert set(epsilon[:101]) == {1.0} and epsilon[200] == pytest.approx(0.525) and epsilon[-1] == 0.05
    assert all(call.epsilon == 0 for call in acted.calls if call.rng is None), "evaluation is greedy"


@with_and_without_state
def test_first_update_moves_the_target_by_polyak(tmp_path, monkeypatch, matrix_game, script):
    recorder = Recorder(monkeypatch, script)
    losses = Spy(monkeypatch, script, "td_loss")
    short = {**TINY, "total_timesteps": 480, "train_frequency": 400}
    args = script.Args(env="matrix", runs_dir=str(tmp_path), polyak=0.9, learning_rate=0.1, **short)
    script.train(args)
    assert len(losses.calls) == 1
    ((learner, target),) = recorder.copies
    torch.manual_seed(np.random.SeedSequence(args.seed).generate_state(1, np.uint64).item())
    start = script.make_learner(args, recorder.envs[0]).state_dict()
    for name, value in target.state_dict().items():
        expected = 0.9 * start[name] + 0.1 * learner.state_dict()[name]
        torch.testing.assert_close(value, expected)
        assert not torch.allclose(expected, start[name], atol=1e-5), name
    assert not any(parameter.requires_grad for parameter in target.parameters())


@pytest.fixture
def adam(monkeypatch):
    """Notes the learning rate and the norm of the gradient at every step of an optimizer."""
    seen = types.SimpleNamespace(rates=[], norms=[])
    step = torch.optim.Adam.step

    def spied(self, closure=None):
        seen.rates.append(self.param_groups[0]["lr"])
        seen.norms.append(sum(p.grad.square().sum() for p in self.param_groups[0]["params"]).sqrt().item())
        return step(self, closure)

    monkeypatch.setattr(torch.optim.Adam, "step", spied)
    return seen


def test_training_passes_on_what_it_should(tmp_path, monkeypatch, matrix_game, adam):
    """Hysteresis and step size follow their schedules, the gradient is clipped, loss and networks get the settings.

    Evaluation seeds differ from point to point and from run to run.
    """
    evaluated = Spy(monkeypatch, avf_qplex, "evaluate")
    losses = Spy(monkeypatch, avf_qplex, "td_loss")
    options = dict(hysteresis=0.2, exploration_timesteps=200, learning_rate=1e-3, max_grad_norm=1e-3, td_lambda=0.25)
    options |= TINY | dict(learning_starts=600)
    for seed in (0, 1):
        avf_qplex.train(Args(env="matrix", seed=seed, runs_dir=str(tmp_path), gamma=0.97, **options))
    seeds = [call.seed for call in evaluated.calls]
    assert len(seeds) == len(set(seeds)) == 6 and {call.gamma for call in evaluated.calls} == {0.97}
    assert [call.args.seed for call in losses.calls] == [0] * 15 + [1] * 15
    steps = np.arange(640, 1_201, 40)
    for call in losses.calls:
        assert call.args.td_lambda == 0.25 and call.batch["valid"].shape[0] == 8
        assert call.utilities.requires_grad and not call.target_utilities.requires_grad
        assert call.mixer is not call.target_mixer
    # The schedule is that of the step before which the agents acted.
    factors = [call.hysteresis for call in losses.calls[:15]]
    assert factors == pytest.approx(np.interp((steps - 4 - 600) / 200, [1, 2], [0.2, 1.0]))
    assert factors[0] == 0.2 and 0.2 < factors[7] < 1 and factors[-1] == 1.0
    assert adam.rates[:15] == pytest.approx(1e-3 * (1 - steps / 1_200))
    assert max(adam.norms) == pytest.approx(1e-3, rel=1e-3)


def test_the_learning_rate_is_never_negative(tmp_path, matrix_game, adam):
    """The last step may go beyond total_timesteps, here to 1,208."""
    options = {**TINY, "num_envs": 8, "total_timesteps": 1_201, "train_frequency": 8, "learning_starts": 1_150}
    avf_qplex.train(Args(env="matrix", runs_dir=str(tmp_path), learning_rate=1e-3, **options))
    assert adam.rates[-2] == pytest.approx(1e-3 / 1_201) and adam.rates[-1] == 0.0 and min(adam.rates) == 0.0


def test_the_learning_rate_may_be_constant(tmp_path, matrix_game, adam):
    options = {**TINY, "learning_starts": 400, "total_timesteps": 600, "learning_rate": 3e-4, "anneal_lr": False}
    avf_qplex.train(Args(env="matrix", runs_dir=str(tmp_path), **options))
    assert adam.rates == [3e-4] * 5


@pytest.mark.slow
@every_q_learner
@pytest.mark.parametrize(
    ("learning_starts", "train_frequency", "steps"),
    [
        (0, 1, [6, 6, 8, 8, 10, 10, 12, 12, 14, 14, 16, 16, 18, 18, 20, 20]),
        (9, 2, [10, 12, 14, 16, 18, 20]),
        (10, 2, [12, 14, 16, 18, 20]),
        (0, 3, [6, 10, 12, 16, 18]),
        (0, 4, [8, 12, 16, 20]),
        (8, 4, [12, 16, 20]),
        (0, 20, [20]),
    ],
)
def test_no_update_is_owed(tmp_path, monkeypatch, matrix_game, script, learning_starts, train_frequency, steps):
    """Two environments whose episodes take three steps: the first ones end at step 6 of the run.

    An update is due for each multiple of train_frequency that a step passes. What was passed up to learning_starts, or
    before an episode had ended, is not made up for.
    """
    recorder = Recorder(monkeypatch, script)
    updated = []
    make_batch = script.make_batch

    def spied(*args):
        updated.append(2 * len(recorder.log))
        return make_batch(*args)

    monkeypatch.setattr(script, "make_batch", spied)
    options = dict(num_envs=2, total_timesteps=20, eval_episodes=1, batch_size=2, hidden_size=4, buffer_size=10)
    args = script.Args(env="matrix", runs_dir=str(tmp_path), **options)
    args.learning_starts = learning_starts
    args.train_frequency = train_frequency
    script.train(args)
    assert updated == steps


@pytest.mark.parametrize("script", [*Q_LEARNERS, mac_iaicc], ids=lambda script: script.ALGORITHM)
def test_random_streams_share_no_numbers(tmp_path, monkeypatch, matrix_game, script):
    """Exploration, replay, environments and evaluations of two runs draw different numbers, and so do networks.

    Nothing is seeded with the run's seed itself, because a user may do that elsewhere.
    """
    seeds = {}
    generators = {}
    default_rng = np.random.default_rng
    reset = envs.MacroVectorEnv.reset

    def spied_rng(seed=None):
        generators[f"{run}: generator {len(generators)}"] = default_rng(seed)
        return default_rng(seed)

    def spied_reset(self, *, seed=None, options=None):
        result = reset(self, seed=seed, options=options)
        if seed is not None:
            generators[f"{run}: environments {len(generators)}"] = copy.deepcopy(self.np_random)
        return result

    monkeypatch.setattr(np.random, "default_rng", spied_rng)
    monkeypatch.setattr(envs.MacroVectorEnv, "reset", spied_reset)
    monkeypatch.setattr(torch, "manual_seed", lambda seed: seeds.setdefault(run, seed))
    for run in (0, 1):
        options = dict(total_timesteps=6, num_envs=2, eval_frequency=2, eval_episodes=1, hidden_size=4)
        script.train(script.Args(env="matrix", seed=run, runs_dir=str(tmp_path), **options))
    own = 1 if script is mac_iaicc else 2  # exploration, and replay where there is one
    assert len(generators) == 2 * (own + 1 + 3), "in each run the environment has one and each evaluation"
    for seed in (0, 1):
        generators[f"default_rng({seed})"] = default_rng(seed)
    for seed in seeds.values():
        generators[f"default_rng of the networks' seed {seed}"] = default_rng(seed)
    drawn = {name: set(rng.bit_generator.random_raw(10_000).tolist()) for name, rng in generators.items()}
    for one, other in combinations(drawn, 2):
        assert not drawn[one] & drawn[other], (one, other)


@pytest.mark.slow
@every_q_learner
def test_the_default_run_ends_without_hysteresis(tmp_path, monkeypatch, matrix_game, script):
    """By the schedule on all tasks, and by the last update of a run with lengths of a 500th of those on bp-10."""
    for env_id in envs.IDS:
        args = args_for(script, env_id)
        phase = (args.total_timesteps - args.num_envs - args.learning_starts) / args.exploration_timesteps
        assert np.interp(phase, [1, 2], [args.hysteresis, 1.0]) == 1.0, env_id
    args = args_for(script, "bp-10", runs_dir=str(tmp_path), num_envs=4, hidden_size=4, batch_size=2, eval_episodes=1)
    args.env = "matrix"
    assert args.hysteresis < 1
    for name in ("total_timesteps", "learning_starts", "exploration_timesteps"):
        setattr(args, name, getattr(args, name) // 500)
    losses = Spy(monkeypatch, script, "own_loss" if script is dec_maddrqn else "td_loss")
    script.train(args)
    assert losses.calls[0].hysteresis == args.hysteresis and losses.calls[-1].hysteresis == 1.0


@pytest.mark.slow
def test_finds_the_optimum_of_a_non_monotonic_game(tmp_path, matrix_game):
    """Payoff 8 for (a, a), -12 beside it, 0 elsewhere: the average over what the other does speaks against a.

    Errors are hysteretic, as on Box Pushing. With the plain loss QPLEX misses the optimum in as many updates.
    """
    args = Args(
        env="matrix",
        runs_dir=str(tmp_path),
        total_timesteps=3_600,
        learning_starts=500,
        train_frequency=24,
        exploration_timesteps=100_000,
        end_e=1.0,
        learning_rate=2e-3,
        anneal_lr=False,
        batch_size=32,
        polyak=0.95,
        td_lambda=1.0,
        hysteresis=0.5,
        eval_frequency=600,
        eval_episodes=1,
    )
    for seed in (1, 2):
        args.seed = seed
        assert [value for _, value in scalars(avf_qplex.train(args))["eval/return"][-3:]] == [8.0] * 3
