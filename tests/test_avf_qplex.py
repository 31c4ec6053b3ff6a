"""AVF-QPLEX: replay, target, mixer and learning, on the code itself."""

import copy
from itertools import product

import numpy as np
import pytest
import torch

import avf_qplex
import envs
from avf_qplex import Agents, Args, Batch, QPLEXMixer, ReplayBuffer, act, defaults, evaluate, td_loss, train
from tests.curves import scalars
from tests.matrix_game import MatrixGame


def collect(env_id, episodes, num_envs=3, seed=0, mixer_state="joint", capacity=None, gamma=0.9, epsilon=0.7):
    """Plays with random networks into a buffer that stores the recurrent states; returns it, the agents and a log of
    each episode, in the order in which they ended: (obs, state, free, actions, reward, hidden) per step and the final
    (obs, state, terminated)."""
    torch.manual_seed(seed)
    env, rng = envs.make(env_id, num_envs), np.random.default_rng(seed)
    agents = Agents(env.n_actions, env.single_observation_space.shape[1], hidden_size=8)
    buffer = ReplayBuffer(env, capacity or episodes + num_envs, gamma, mixer_state, hidden_size=8)
    obs, infos = env.reset(seed=seed)
    hidden = torch.zeros(env.n_agents, num_envs, 8)
    running, ended = [[] for _ in range(num_envs)], []
    while len(ended) < episodes:
        actions, moved = act(agents, obs, infos, hidden, epsilon, rng)
        buffer.decide(infos["macro_done"], obs, actions, infos["state"], hidden)
        before = obs, infos["state"], infos["macro_done"], actions
        state = infos["state"]
        obs, rewards, terminations, truncations, infos = env.step(actions)
        buffer.reward(rewards, state)
        for e in range(num_envs):
            running[e].append([*(x[e] for x in before), rewards[e], moved[:, e].clone()])
        hidden, over = moved, terminations | truncations
        if over.any():
            buffer.finish(over, terminations, obs, infos["state"], hidden)
            for e in np.flatnonzero(over):
                ended.append((running[e], (obs[e], infos["state"][e], terminations[e])))
                running[e] = []
            obs, infos = env.reset(options={"reset_mask": over})
            hidden[:, over] = 0.0
    return env, agents, buffer, ended


# ---- replay -------------------------------------------------------------------------------------------------------


def test_decision_rows_are_the_steps_at_which_somebody_chose():
    """The buffer's rows against the same rows worked out step by step from a log of the episode."""
    gamma = 0.9
    env, _, buffer, ended = collect("wtd-s", 6, gamma=gamma)
    for episode, (steps, (_, final_state, terminated)) in enumerate(ended):
        starts = [t for t, (_, _, free, *_) in enumerate(steps) if free.any()]
        assert buffer.data["rows"][episode] == len(starts) + 1, "the final observation is a row as well"
        latest = np.zeros(env.n_agents, int) - 1
        for k, (t, until) in enumerate(zip(starts, [*starts[1:], len(steps)], strict=True)):
            obs, state, free, actions, _, _ = steps[t]
            np.testing.assert_array_equal(buffer.data["state"][episode, k], state)
            latest += free
            np.testing.assert_array_equal(buffer.data["latest"][episode, k], latest)
            for agent in range(env.n_agents):
                own = episode, agent, latest[agent]
                assert buffer.data["action"][own] == actions[agent]
                if free[agent]:
                    np.testing.assert_array_equal(buffer.data["obs"][own], obs[agent])
                    assert buffer.data["row"][own] == k
            reward = sum(gamma**i * step[4] for i, step in enumerate(steps[t:until]))
            assert buffer.data["reward"][episode, k] == pytest.approx(reward, abs=1e-4)
            discount = 0.0 if terminated and until == len(steps) else gamma ** (until - t)
            assert buffer.data["discount"][episode, k] == pytest.approx(discount, abs=1e-6)
        np.testing.assert_array_equal(buffer.data["state"][episode, len(starts)], final_state)


class Draws:
    """Stands in for a generator whose `integers` are known: which episodes, then which first rows."""

    def __init__(self, *draws):
        self.draws = iter(draws)

    def integers(self, *args, **kwargs):
        return next(self.draws)


@pytest.mark.parametrize("stored", [False, True])
@pytest.mark.parametrize("env_id", ["wtd-s", "bp-10", "ct-10"])
def test_replayed_hidden_states_are_those_of_acting(env_id, stored):
    """Row by row, with other agents' rows in between: from an episode's start, and with stored states from any row."""
    env, agents, buffer, ended = collect(env_id, 8)
    episodes = np.arange(8)
    final = buffer.data["rows"][:8] - 1
    start = np.random.default_rng(0).integers(final) if stored else np.zeros(8, int)
    batch = buffer.sample(8, env.horizon, Draws(episodes, start))
    with torch.no_grad():
        _, _, states = agents(batch.obs, batch.previous, batch.hidden if stored else None, batch.sizes)
    rows, ongoing = iter(range(len(batch.entry))), 0
    for episode in episodes:
        steps, own = ended[episode][0], np.zeros(env.n_agents, int)
        decision_steps = [t for t, step in enumerate(steps) if step[2].any()]
        for k, t in enumerate(decision_steps):
            own[steps[t][2]] = t
            if k >= start[episode]:
                row = next(rows)
                acted = torch.stack([steps[own[i]][5][i] for i in range(env.n_agents)])  # [agents, hidden]
                torch.testing.assert_close(states[torch.arange(env.n_agents), batch.entry[row]], acted)
                np.testing.assert_array_equal(batch.chosen[row], steps[t][2])
                ongoing += env.n_agents - steps[t][2].sum()
    assert next(rows, None) is None and ongoing > 50


def test_hidden_state_starts_at_zero_in_every_episode():
    _, _, buffer, _ = collect("wtd-s", 12)
    assert not buffer.data["hidden"][: buffer.size, :, 0].any()
    assert buffer.data["hidden"][: buffer.size, :, 1].any(axis=(1, 2)).all()


def test_windows_never_mix_episodes():
    """A ring far smaller than what is played, so that slots are overwritten; all that is stored tells its episode."""
    env = envs.make("bp-10", 4)
    buffer, rng, tag, hidden = ReplayBuffer(env, 7, 0.9), np.random.default_rng(0), np.arange(4.0), torch.zeros(2, 4, 0)
    _, infos = env.reset(seed=0)

    def tagged(shape):
        return np.broadcast_to(tag.reshape(4, *[1] * (len(shape) - 1)), shape).astype(np.float32)

    checked = 0
    for _ in range(600):
        actions = rng.integers(0, 8, (4, 2))
        buffer.decide(infos["macro_done"], tagged((4, 2, 5)), actions, tagged((4, env.state_size)), hidden)
        _, rewards, terminations, truncations, infos = env.step(actions)
        buffer.reward(rewards, infos["state"])
        over = terminations | truncations
        if over.any():
            buffer.finish(over, terminations, tagged((4, 2, 5)), tagged((4, env.state_size)), hidden)
            tag[over] = tag.max() + 1 + np.arange(over.sum())
            _, infos = env.reset(options={"reset_mask": over})
        if buffer.size > 2:
            batch = buffer.sample(8, 6, rng)
            b, _ = np.nonzero(batch.valid.numpy())
            for window in range(8):
                rows = np.flatnonzero(b == window)
                tags = {batch.obs[i, e, 0].item() for r in rows for i, e in enumerate(batch.entry[r])}
                tags |= {batch.obs[i, e, 0].item() for r in rows for i, e in enumerate(batch.next_entry[r])}
                tags |= set(batch.state[rows].flatten().tolist()) | set(batch.next_state[rows].flatten().tolist())
                assert len(tags) == 1
                checked += 1
    assert checked > 1000 and tag.max() > 20


def test_every_row_of_an_episode_is_replayed_equally_often():
    """The first and the last too, where the reward often is: were all windows to fit in, one start in 15 would do."""
    env = envs.make("bp-10", 2)
    buffer, hidden, obs = ReplayBuffer(env, 4, 0.9), torch.zeros(2, 2, 0), np.zeros((2, 2, 5), np.float32)
    for t in range(20):
        buffer.decide(np.ones((2, 2), bool), obs, np.zeros((2, 2), int), np.zeros((2, 27), np.float32), hidden)
        buffer.reward(np.full(2, t), None)
        ends = np.array([t == 19, t == 3])  # episodes of 20 rows and of 4, the second followed by another of 16
        if ends.any():
            buffer.finish(ends, ends, obs, np.zeros((2, 27), np.float32), hidden)
    assert buffer.data["rows"][:2].tolist() == [5, 21]
    batch = buffer.sample(24_000, 6, np.random.default_rng(0))
    windows = batch.valid.sum(1)
    assert windows.min() == 1 and windows.max() == 6
    counts = np.bincount(batch.reward.numpy().astype(int), minlength=20)
    # half of the windows are of each episode; 6 starts of 25 reach a row of the long one, 6 of 9 one of the short one
    expected = 12_000 * 6 / 25 + (np.arange(20) < 4) * 12_000 * 6 / 9
    assert np.abs(counts - expected).max() < 5 * np.sqrt(expected.max()), counts


@pytest.mark.parametrize("mixer_state", ["joint", "single", "real", "decision"])
def test_mixer_state_feeds_the_rows_it_says(mixer_state):
    """Two agents, decisions worked out by hand; the state is the time step.

    t        0     1     2     3     4     5 (end, truncated)
    agent 0  a0          a1          a2
    agent 1  b0    b1          b2
    row      0     1     2     3     4     5
    """
    env = envs.make("bp-10", 1)
    buffer = ReplayBuffer(env, 2, 1.0, mixer_state)
    hidden, obs = torch.zeros(2, 1, 0), np.zeros((1, 2, 5), np.float32)
    free = [(True, True), (False, True), (True, False), (False, True), (True, False)]

    def state(t):
        return np.full((1, env.state_size), t, np.float32)

    for t in range(5):
        buffer.decide(np.array([free[t]]), obs, np.zeros((1, 2), int), state(t), hidden)
        buffer.reward(np.zeros(1), state(t))
    buffer.finish(np.array([True]), np.array([False]), obs, state(5), hidden)
    batch = buffer.windows(np.array([0]), np.array([0]), 5)
    got = batch.state.reshape(5, -1, env.state_size)[..., 0].tolist()
    later = batch.next_state.reshape(5, -1, env.state_size)[..., 0].tolist()
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


def test_real_state_is_that_of_the_last_step_of_the_interval():
    env = envs.make("bp-10", 1)
    buffer = ReplayBuffer(env, 2, 1.0, "real")
    hidden, obs = torch.zeros(2, 1, 0), np.zeros((1, 2, 5), np.float32)
    for t in range(6):  # agents choose at steps 0 and 4, the episode ends after step 5
        buffer.decide(np.full((1, 2), t in (0, 4)), obs, np.zeros((1, 2), int), np.full((1, 27), t, np.float32), hidden)
        buffer.reward(np.zeros(1), np.full((1, 27), t, np.float32))
    buffer.finish(np.array([True]), np.array([True]), obs, np.full((1, 27), 6, np.float32), hidden)
    batch = buffer.windows(np.array([0]), np.array([0]), 5)
    assert batch.state[:, 0].tolist() == [3, 5] and batch.next_state[:, 0].tolist() == [4, 6]


# ---- target -------------------------------------------------------------------------------------------------------


def hand_made_batch():
    """Two agents, two macro-actions, two windows of two rows.

    Window 0 (rows 0, 1; terminates after row 1). Row 0: both choose. Row 1: only agent 1 chooses, agent 0 is ongoing.
    Window 1 (rows 2, 3; truncated after row 3). Row 2: both choose. Row 3: only agent 0 chooses, agent 1 is ongoing.
    Entries: 0, 1 the windows' first decisions, 2, 3 the second ones, 4, 5 the third ones. Agent 0 has in window 0
    entries 0 and 4 (the end), in window 1 entries 1, 3 and 5 (the end); agent 1 in window 0 0, 2, 4 (end) and in window
    1 1, 3 (end).
    """
    entry = torch.tensor([[0, 0], [0, 2], [1, 1], [3, 1]])
    next_entry = torch.tensor([[0, 2], [4, 4], [3, 1], [5, 3]])
    chosen = torch.tensor([[True, True], [False, True], [True, True], [True, False]])
    next_chosen = torch.tensor([[False, True], [True, True], [True, False], [True, True]])
    action = torch.tensor([[1, 0, 0, 1, 0, 0], [0, 1, 1, 0, 0, 0]])  # [agents, entries]
    return Batch(
        obs=torch.zeros(2, 6, 1), previous=action, action=action, hidden=None, sizes=[2, 2, 2], entry=entry,
        next_entry=next_entry, chosen=chosen, next_chosen=next_chosen, state=torch.zeros(4, 1),
        next_state=torch.zeros(4, 1), reward=torch.tensor([1.0, 2.0, 3.0, 4.0]),
        discount=torch.tensor([0.81, 0.0, 0.9, 0.729]), valid=torch.ones(2, 2, dtype=torch.bool),
    )  # fmt: skip


ONLINE = torch.tensor([[[1.0, 2.0], [3.0, 1.0], [9.0, 9.0], [0.0, 5.0], [7.0, 6.0], [2.0, 4.0]],
                       [[5.0, 4.0], [1.0, 2.0], [6.0, 8.0], [3.0, 2.0], [1.0, 9.0], [9.0, 9.0]]])  # fmt: skip
TARGET = torch.tensor([[[10.0, 20.0], [30.0, 40.0], [0.0, 0.0], [50.0, 60.0], [1.0, 2.0], [70.0, 80.0]],
                       [[15.0, 25.0], [35.0, 45.0], [55.0, 65.0], [75.0, 85.0], [3.0, 4.0], [0.0, 0.0]]])  # fmt: skip


def vdn(utilities, values, actions, chosen, state):
    return utilities.sum(-1)


def test_td_target_by_hand():
    """Row 0: agent 0 goes on with macro-action 1 of entry 0 (target 20, though the online argmax there is 1 as well by
    chance: see the next test), agent 1 chooses at entry 2, online argmax 1, target 65: y = 1 + 0.81 * 85 = 69.85.
    Row 1: terminated: y = 2. Row 2: agent 0 chooses at entry 3, argmax 1, target 60; agent 1 goes on with macro-action
    1 of entry 1, target 45: y = 3 + 0.9 * 105 = 97.5. Row 3: truncated, so it bootstraps from the final observation:
    agent 0 at entry 5, argmax 1, 80; agent 1 at entry 3, argmax 0, 75: y = 4 + 0.729 * 155 = 116.995.
    Joint values: row 0: 2 + 5 = 7, row 1: 2 + 8 = 10, row 2: 3 + 2 = 5, row 3: 5 + 2 = 7."""
    batch = hand_made_batch()
    loss, q, target = td_loss(ONLINE, ONLINE.amax(2), TARGET, TARGET.amax(2), vdn, vdn, batch)
    torch.testing.assert_close(target, torch.tensor([69.85, 2.0, 97.5, 116.995]))
    torch.testing.assert_close(q, torch.tensor([7.0, 10.0, 5.0, 7.0]))
    errors = torch.tensor([62.85, -8.0, 92.5, 109.995])
    torch.testing.assert_close(loss, errors.square().mean())
    # Hysteresis scales the one negative error.
    loss, _, _ = td_loss(ONLINE, ONLINE.amax(2), TARGET, TARGET.amax(2), vdn, vdn, batch, hysteresis=0.5)
    torch.testing.assert_close(loss, torch.tensor([62.85, -4.0, 92.5, 109.995]).square().mean())


def test_conditional_argmax_never_changes_an_ongoing_macro_action():
    """Make the other macro-action of the ongoing agents far better: the target must not move."""
    batch, tempting = hand_made_batch(), ONLINE.clone()
    tempting[0, 0, 0], tempting[1, 1, 0] = (
        1000.0,
        1000.0,
    )  # agent 0 at entry 0 and agent 1 at entry 1 run macro-action 1
    seen = []

    def target_mixer(utilities, values, actions, chosen, state):
        seen.append((actions, chosen))
        return utilities.sum(-1)

    _, _, target = td_loss(tempting, tempting.amax(2), TARGET, TARGET.amax(2), vdn, target_mixer, batch)
    torch.testing.assert_close(target, torch.tensor([69.85, 2.0, 97.5, 116.995]))
    actions, chosen = seen[0]
    assert actions.tolist() == [[1, 1], [0, 1], [1, 1], [1, 0]] and chosen.equal(batch.next_chosen)


def test_q_lambda_by_hand():
    """lambda = 0.5. Window 0: G[1] = 2; G[0] = 1 + 0.81 (0.5 * 85 + 0.5 * 2) = 36.235. Window 1: G[3] = 116.995;
    G[2] = 3 + 0.9 (0.5 * 105 + 0.5 * 116.995) = 102.89775. A window cut after row 0 keeps the one-row target."""
    batch = hand_made_batch()
    _, _, target = td_loss(ONLINE, ONLINE.amax(2), TARGET, TARGET.amax(2), vdn, vdn, batch, td_lambda=0.5)
    torch.testing.assert_close(target, torch.tensor([36.235, 2.0, 102.89775, 116.995]))
    rows = [0, 2, 3]  # window 0 without its second row
    cut = {key: getattr(batch, key)[rows] for key in ("entry", "next_entry", "chosen", "next_chosen", "state")}
    cut |= {key: getattr(batch, key)[rows] for key in ("next_state", "reward", "discount")}
    batch = batch._replace(**cut, valid=torch.tensor([[True, False], [True, True]]))
    _, _, target = td_loss(ONLINE, ONLINE.amax(2), TARGET, TARGET.amax(2), vdn, vdn, batch, td_lambda=0.5)
    torch.testing.assert_close(target, torch.tensor([69.85, 102.89775, 116.995]))


def test_primitive_target_is_the_textbook_one():
    """Where every macro-action ends after a step, rows are steps, everybody chooses and the discount is gamma."""
    _, agents, buffer, _ = collect("bp-10-primitive", 6, gamma=0.9)
    batch = buffer.sample(8, 10, np.random.default_rng(0))
    assert batch.chosen.all() and batch.next_chosen.all()
    assert set(batch.discount.unique().tolist()) <= {0.0, np.float32(0.9)}
    other = copy.deepcopy(agents)
    with torch.no_grad():
        for parameter in other.parameters():
            parameter.add_(0.1 * torch.randn_like(parameter))
    q, v, _ = agents(batch.obs, batch.previous, None, batch.sizes)
    next_q, next_v, _ = other(batch.obs, batch.previous, None, batch.sizes)
    _, _, target = td_loss(q, v, next_q, next_v, vdn, vdn, batch)
    for row in range(0, len(target), 5):
        later = [(q[i, e], next_q[i, e]) for i, e in enumerate(batch.next_entry[row])]
        textbook = batch.reward[row] + batch.discount[row] * sum(
            evaluated[online.argmax()] for online, evaluated in later
        )
        torch.testing.assert_close(target[row], textbook)


def test_gradients_reach_everything_and_never_the_target():
    env, _, buffer, _ = collect("wtd-s", 6)
    learner, _ = avf_qplex.make_learner(Args(hidden_size=8), env)
    target = copy.deepcopy(learner).requires_grad_(False)
    batch = buffer.sample(8, 10, np.random.default_rng(0))
    q, v, _ = learner["agents"](batch.obs, batch.previous, None, batch.sizes)
    next_q, next_v, _ = target["agents"](batch.obs, batch.previous, None, batch.sizes)
    td_loss(q, v, next_q, next_v, learner["mixer"], target["mixer"], batch)[0].backward()
    for name, parameter in learner.named_parameters():
        assert parameter.grad is not None and parameter.grad.abs().sum() > 0, name


# ---- networks -----------------------------------------------------------------------------------------------------


def test_agents_are_separate_gru_networks():
    """Each agent's slice equals PyTorch's own layers with its weights; padding actions are never available."""
    agents = Agents([2, 4], obs_size=3, hidden_size=8)
    obs, previous = torch.randn(2, 5, 3), torch.tensor([[-1, 0, 1, 1, 0], [-1, 3, 2, 1, 0]])
    with torch.no_grad():
        utilities, values, states = agents(obs, previous, None, [1] * 5)
        for i in range(2):
            x = torch.cat([obs[i], torch.eye(5)[previous[i], :4]], 1)  # row -1 of the identity is cut to zeros
            x = torch.relu(x @ agents.encoder.weight[i] + agents.encoder.bias[i])
            gru = torch.nn.GRUCell(8, 8)
            gru.weight_ih.copy_(agents.gru_input.weight[i].T)
            gru.bias_ih.copy_(agents.gru_input.bias[i, 0])
            gru.weight_hh.copy_(agents.gru_hidden[i].T)
            gru.bias_hh.zero_()
            hidden = torch.zeros(1, 8)
            for t in range(5):
                hidden = gru(x[t : t + 1], hidden)
                torch.testing.assert_close(states[i, t], hidden[0])
                head = torch.relu(hidden @ agents.head.weight[i] + agents.head.bias[i])
                expected = (head @ agents.output.weight[i] + agents.output.bias[i])[0, : [2, 4][i]]
                torch.testing.assert_close(utilities[i, t, : [2, 4][i]], expected)
                torch.testing.assert_close(values[i, t], expected.max())
    assert (utilities[0, :, 2:] == -torch.inf).all()


def joint_table(mixer, tables, values, chosen, actions, state):
    """Q_tot of every joint macro-action of the agents that choose, the others' being given."""
    sizes = [len(table) if free else 1 for table, free in zip(tables, chosen, strict=True)]
    joint = {}
    for choice in product(*map(range, sizes)):
        m = [c if free else a for c, free, a in zip(choice, chosen, actions, strict=True)]
        utilities = torch.stack([table[a] for table, a in zip(tables, m, strict=True)])
        with torch.no_grad():
            joint[tuple(m)] = mixer(utilities, values, torch.tensor(m), torch.tensor(chosen), state).item()
    return joint


@pytest.mark.parametrize("advantage", ["max", "dueling"])
def test_greedy_utilities_maximise_the_joint_value(advantage):
    """Mac-IGM at random weights, for every set of ongoing agents; and the literal mixer breaks it."""
    torch.manual_seed(0)
    broken = {True: 0, False: 0}
    for _ in range(150):
        tables = [torch.randn(3) for _ in range(3)]
        values = torch.stack([t.max() for t in tables]) if advantage == "max" else torch.randn(3)
        actions, chosen = torch.randint(3, (3,)).tolist(), (torch.rand(3) < 0.6).tolist()
        for mask_ongoing in (True, False):
            mixer = QPLEXMixer([3, 3, 3], 4, 8, mask_ongoing=mask_ongoing, joint_action=advantage == "max")
            joint = joint_table(mixer, tables, values, chosen, actions, torch.randn(4))
            greedy = tuple(int(t.argmax()) if c else a for t, c, a in zip(tables, chosen, actions, strict=True))
            broken[mask_ongoing] += joint[greedy] < max(joint.values()) - 1e-5
    assert broken[True] == 0
    assert advantage == "dueling" or broken[False] > 0


# ---- acting and learning ------------------------------------------------------------------------------------------


def test_acting():
    """Ongoing agents keep macro-action and recurrent state; epsilon 1 is uniform over an agent's own macro-actions."""
    torch.manual_seed(0)
    agents, rng = Agents([2, 4], 3, 8), np.random.default_rng(0)
    obs, hidden = np.random.default_rng(1).random((4000, 2, 3), np.float32), torch.randn(2, 4000, 8)
    infos = {"macro_done": rng.random((4000, 2)) < 0.5, "macro_action": np.ones((4000, 2), int)}
    free = infos["macro_done"]
    actions, moved = act(agents, obs, infos, hidden, 1.0, rng)
    assert (actions[~free] == 1).all()
    still = (moved == hidden).all(2).T.numpy()
    np.testing.assert_array_equal(still, ~free)
    for agent, n in enumerate((2, 4)):
        counts = np.bincount(actions[free[:, agent], agent], minlength=n)
        assert len(counts) == n and (abs(counts / counts.sum() - 1 / n) < 0.05).all()
    greedy, _ = act(agents, obs, infos, hidden)
    again, _ = act(agents, obs, infos, hidden, 0.0, rng)
    np.testing.assert_array_equal(greedy, again)


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


TINY = dict(num_envs=4, total_timesteps=1_200, learning_starts=200, train_frequency=40, batch_size=8, window=6,
            hidden_size=16, eval_frequency=400, eval_episodes=2, checkpoint_frequency=400)  # fmt: skip


@pytest.mark.parametrize(
    "env_id, options",
    [("ct-10", {})]
    + [("wtd-s", dict(mixer_state=m)) for m in ("joint", "single", "real", "decision")]
    + [
        ("bp-10", dict(advantage="dueling", see_ongoing=True)),
        ("bp-10", dict(mask_ongoing=False, hidden_state="stored")),
    ]
    + [("bp-10-primitive", {}), ("wtd-s-primitive", {}), ("ct-10-primitive", {})],
)
def test_smoke_run_takes_gradient_steps(tmp_path, env_id, options):
    args = defaults(env_id, runs_dir=str(tmp_path), **{**TINY, **options})
    folder = train(args)
    checkpoint = torch.load(folder / "checkpoint.pt", weights_only=True)
    assert checkpoint["updates"] == (1_200 - 200) // 40 and checkpoint["step"] == 1_200
    torch.manual_seed(args.seed)
    start = avf_qplex.make_learner(args, envs.make(env_id))[0].state_dict()
    changed = [name for name, value in checkpoint["learner"].items() if not torch.equal(value, start[name])]
    assert len(changed) == len(start), "every parameter was updated"
    assert len(scalars(folder)["eval/return"]) == 3


def test_same_seed_same_curve_and_seed_zero_counts(tmp_path):
    curves = []
    for run, seed in enumerate((0, 0, 1)):
        folder = train(defaults("wtd-s", seed=seed, runs_dir=str(tmp_path / str(run)), **TINY))
        curves.append(scalars(folder))
    assert curves[0] == curves[1] and curves[0] != curves[2]


def test_epsilon_falls(tmp_path):
    options = {**TINY, "total_timesteps": 8_000, "learning_starts": 10_000, "exploration_timesteps": 6_000}
    epsilon = scalars(train(defaults("bp-10", runs_dir=str(tmp_path), **options)))["charts/epsilon"]
    assert [round(value, 2) for _, value in epsilon] == [0.68, 0.37, 0.05, 0.05]


def test_first_update_moves_the_target_by_polyak(tmp_path):
    args = defaults(
        "bp-10", runs_dir=str(tmp_path), polyak=0.9, **{**TINY, "total_timesteps": 400, "train_frequency": 200}
    )
    checkpoint = torch.load(train(args) / "checkpoint.pt", weights_only=True)
    assert checkpoint["updates"] == 1
    torch.manual_seed(args.seed)
    start = avf_qplex.make_learner(args, envs.make("bp-10"))[0].state_dict()
    for name, value in checkpoint["target"].items():
        torch.testing.assert_close(value, 0.9 * start[name] + 0.1 * checkpoint["learner"][name])


def test_training_resets_the_hidden_state_with_the_episode(tmp_path):
    args = defaults("bp-10", runs_dir=str(tmp_path), hidden_state="stored", **{**TINY, "total_timesteps": 4_000})
    saved = torch.load(train(args) / "checkpoint.pt", weights_only=True)
    _, buffer = avf_qplex.make_learner(args, envs.make("bp-10", args.num_envs))
    buffer.load(saved["buffer"])
    hidden, decisions = buffer.data["hidden"][: buffer.size], buffer.data["decisions"][: buffer.size]
    assert buffer.size > 10 and (decisions > 1).all()
    assert not hidden[:, :, 0].any() and hidden[:, :, 1].any(axis=2).all()


def test_training_passes_on_what_it_should(tmp_path, monkeypatch):
    """Evaluation seeds differ from point to point and from run to run; hysteresis is annealed; rewards are scaled."""
    seeds, betas, rewards = [], [], []
    real_evaluate, real_loss, real_reward = avf_qplex.evaluate, avf_qplex.td_loss, ReplayBuffer.reward
    monkeypatch.setattr(avf_qplex, "evaluate", lambda *a: seeds.append(a[3]) or real_evaluate(*a))
    monkeypatch.setattr(avf_qplex, "td_loss", lambda *a: betas.append(a[8]) or real_loss(*a))
    monkeypatch.setattr(ReplayBuffer, "reward", lambda self, r, s: rewards.append(r) or real_reward(self, r, s))
    options = dict(hysteresis_start=0.2, hysteresis_end=0.8, exploration_timesteps=600, reward_scale=10.0)
    for seed in (0, 1):
        train(defaults("bp-10", seed=seed, runs_dir=str(tmp_path), **{**TINY, **options}))
    assert len(seeds) == len(set(seeds)) == 6
    assert betas[0] == pytest.approx(0.2 + 0.6 * 236 / 600) and betas[24] == 0.8 and sorted(betas[:25]) == betas[:25]
    assert rewards[0].tolist() == [-1.0] * 4


def test_finds_the_optimum_of_a_non_monotonic_game(tmp_path, monkeypatch):
    """Payoff 8 for (a, a), -12 beside it, 0 elsewhere: the average over what the other does speaks against a.

    With mildly hysteretic errors, as on Box Pushing: with the plain loss QPLEX stays at 0 for thousands of updates.
    """
    monkeypatch.setitem(envs._TASKS, "matrix", (MatrixGame, {}))
    monkeypatch.setattr(envs, "IDS", (*envs.IDS, "matrix"))
    args = Args(env="matrix", runs_dir=str(tmp_path), total_timesteps=18_000, learning_starts=500, train_frequency=24,
                exploration_timesteps=100_000, end_e=1.0, learning_rate=1e-3, batch_size=32, window=4, polyak=0.95,
                td_lambda=1.0, hysteresis_start=0.7, hysteresis_end=0.7, eval_frequency=6_000,
                eval_episodes=1)  # fmt: skip
    for seed in (1, 2):
        args.seed = seed
        assert scalars(train(args))["eval/return"][-1][1] == 8.0
