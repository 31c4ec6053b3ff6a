"""Capture Target: every rule of its docstring by hand-placed agents, and the published statistics of a fixed policy."""

import math

import numpy as np
import pytest

import envs

MOVE_TO_TARGET, STAY = 0, 1
HIDDEN = [-1.0, -1.0]


def make(num_envs=1, n_agents=2, slip=0.0, flicker=0.0, **kwargs):
    """A batch after its reset, without noise unless asked for."""
    env = envs.make("ct-10", num_envs=num_envs, n_agents=n_agents, slip=slip, flicker=flicker, **kwargs)
    env.reset(seed=0)
    return env


def place(env, position, target, visible=True):
    """Puts the agents and the target of every environment where the test wants them."""
    env.position[:], env.target[:], env.visible[:] = position, target, visible


def step(env, action):
    """A step in which every free agent is given the same action (or the actions of a list of n)."""
    return env.step(np.broadcast_to(action, env.macro_done.shape))


def within(counts, total, probabilities, sigmas=4.5):
    """Are these counts binomial with these probabilities?"""
    probabilities = np.asarray(probabilities)
    spread = np.sqrt(total * probabilities * (1 - probabilities))
    return bool(np.all(np.abs(np.asarray(counts) - total * probabilities) <= sigmas * spread))


def first_episodes(env, choose):
    """Whether the first episode of each environment captures, bool [N], and how long it is, int [N]."""
    captured, length = np.zeros(env.num_envs, bool), np.zeros(env.num_envs, int)
    for t in range(1, env.horizon + 1):
        *_, terminations, truncations, _ = env.step(choose())
        ends = terminations | truncations
        first = ends & (length == 0)
        captured[first], length[first] = terminations[first], t
        if ends.any():
            env.reset(options={"reset_mask": ends})
    assert (length > 0).all()
    return captured, length


# ---- statistics -----------------------------------------------------------------------------------------------------
@pytest.mark.slow
@pytest.mark.parametrize(
    "n_agents, slip, capture_rate, rate_error, mean_length, length_error",
    [(10, 0.1, 0.525, 0.009, 46.0, 0.3), (10, 0.0, 0.891, 0.006, 30.3, 0.3), (5, 0.1, 0.902, 0.005, 29.5, 0.3)],
)
def test_always_move_to_target_is_as_good_as_on_the_published_benchmark(
    n_agents, slip, capture_rate, rate_error, mean_length, length_error
):
    episodes = 4000
    env = envs.make("ct-10", num_envs=episodes, n_agents=n_agents, slip=slip)
    env.reset(seed=1)
    captured, length = first_episodes(env, lambda: np.full((episodes, n_agents), MOVE_TO_TARGET))
    for here, published, error in ((captured, capture_rate, rate_error), (length, mean_length, length_error)):
        assert abs(here.mean() - published) < 3 * math.hypot(here.std() / math.sqrt(episodes), error)


@pytest.mark.slow
def test_one_step_versions_of_the_macro_actions_capture_as_often_as_measured():
    """Random play captures in 0.7% of all episodes, always Move-to-T in 53%."""
    env, rng = envs.make("ct-10-onestep", num_envs=2000), np.random.default_rng(2)
    env.reset(seed=2)
    captured, _ = first_episodes(env, lambda: np.full((2000, 10), MOVE_TO_TARGET))
    assert within(captured.sum(), 2000, 0.53)
    env.reset(seed=3)
    captured, _ = first_episodes(env, lambda: rng.integers(2, size=(2000, 10)))
    assert 3 <= captured.sum() <= 34


# ---- Move-to-T ------------------------------------------------------------------------------------------------------
@pytest.mark.parametrize(
    "start, target, end",
    [
        ((2, 3), (2, 7), (2, 4)),
        ((2, 7), (2, 3), (2, 6)),
        ((7, 3), (2, 3), (6, 3)),
        ((2, 3), (7, 3), (3, 3)),
        ((2, 3), (3, 7), (2, 4)),  # along the longer axis: the Euclidean distance falls most
        ((0, 4), (9, 4), (9, 4)),  # over the border onto the goal
        ((3, 9), (3, 1), (3, 0)),  # over the border, one cell short of it
        ((1, 0), (8, 0), (2, 0)),  # shorter the other way round, but the distance does not wrap
        ((5, 5), (5, 5), (5, 5)),  # there already
    ],
)
def test_moves_to_the_cell_nearest_to_the_goal(start, target, end):
    env = make(num_envs=20)
    place(env, start, target)
    step(env, MOVE_TO_TARGET)
    assert (env.position == end).all()


@pytest.mark.parametrize("grid", [2, 3, 10])
def test_every_pair_of_cells_leads_to_one_of_the_nearest_cells(grid):
    cells = np.stack(np.divmod(np.arange(grid**2), grid), axis=1)
    env = make(num_envs=grid**2, n_agents=grid**2, grid=grid)  # environment: target, agent: position
    reached = np.zeros((grid**2, grid**2, grid**2), bool)  # [target, start, end]
    for _ in range(60):
        env.reset()
        place(env, cells, cells)
        step(env, MOVE_TO_TARGET)
        ends = env.position @ [grid, 1]
        reached[np.arange(grid**2)[:, None], np.arange(grid**2), ends] = True
    for start in range(grid**2):
        x, y = cells[start]
        around = {(x, (y + 1) % grid), (x, (y - 1) % grid), ((x - 1) % grid, y), ((x + 1) % grid, y), (x, y)}
        for target in range(grid**2):
            distance = {cell: math.dist(cell, cells[target]) for cell in around}
            nearest = {cell for cell, value in distance.items() if value == min(distance.values())}
            assert {tuple(cells[end]) for end in np.flatnonzero(reached[target, start])} == nearest


@pytest.mark.parametrize(
    "start, target, ends",
    [
        ((2, 2), (4, 4), [(3, 2), (2, 3)]),
        ((0, 4), (5, 9), [(9, 4), (1, 4), (0, 5)]),  # both ways round along x, and north
        ((0, 0), (5, 5), [(9, 0), (1, 0), (0, 9), (0, 1)]),
    ],
)
def test_ties_are_broken_evenly(start, target, ends):
    env = make(num_envs=3000)
    place(env, start, target)
    step(env, MOVE_TO_TARGET)
    counts = [(env.position == end).all(-1).sum() for end in ends]
    assert sum(counts) == env.position[:, :, 0].size and within(counts, sum(counts), 1 / len(ends))
    assert (env.position[:, 0] != env.position[:, 1]).any()  # each agent on its own


def test_the_goal_is_the_target_of_the_step_before():
    env = make(num_envs=1000)
    place(env, [(0, 0), (9, 9)], (4, 5))
    step(env, MOVE_TO_TARGET)
    assert (env.goal == (4, 5)).all()
    moved_to = env.target.copy()
    assert (moved_to != (4, 5)).any()
    step(env, MOVE_TO_TARGET)
    assert (env.goal == moved_to[:, None]).all()


def test_a_hidden_target_leaves_the_last_goal_over_macro_actions():
    env = make(num_envs=50)
    place(env, [(0, 0), (0, 1)], (0, 5))
    step(env, [MOVE_TO_TARGET, STAY])
    assert (env.goal[:, 0] == (0, 5)).all() and (env.goal[:, 1] == -1).all()  # Stay sets no goal, though it saw one
    place(env, [(0, 4), (0, 1)], (7, 7), visible=False)
    *_, infos = step(env, [MOVE_TO_TARGET, STAY])
    assert (env.position[:, 0] == (0, 5)).all() and infos["macro_done"].all()  # the old goal reached
    place(env, [(0, 8), (0, 1)], (7, 7), visible=False)
    *_, infos = step(env, MOVE_TO_TARGET)
    assert (env.position[:, 0] == (0, 7)).all() and not infos["macro_done"][:, 0].any()  # a new macro-action, same goal
    env.reset()
    assert (env.goal == -1).all()


def test_without_a_goal_it_ends_at_once_where_it_is():
    env = make(num_envs=200, slip=1.0, flicker=1.0)
    start = env.position.copy()
    for _ in range(3):
        obs, *_, infos = step(env, MOVE_TO_TARGET)
        assert infos["macro_done"].all()
        assert (env.position == start).all() and (obs[:, :, 2:] == HIDDEN).all()


def test_it_ends_on_the_goal_and_observes_only_then():
    env = make()
    place(env, [(3, 3), (8, 8)], (3, 6))
    before, *_ = step(env, [MOVE_TO_TARGET, STAY])
    for y in (5, 6):
        place(env, [(3, y - 1), (8, 8)], (3, 6))
        obs, *_, infos = step(env, [STAY, STAY])  # the first agent is running: its entry is ignored
        assert (env.position[0, 0] == (3, y)).all() and infos["macro_action"][0, 0] == MOVE_TO_TARGET
        assert infos["macro_done"].tolist() == [[y == 6, True]]
        np.testing.assert_array_equal(obs[0, 0], env._observe(start=False)[0, 0] if y == 6 else before[0, 0])
    assert not (obs[0, 0] == before[0, 0]).all()


def test_it_ends_on_the_goal_though_the_target_is_gone():
    env = make(num_envs=500)
    place(env, [(3, 5), (8, 8)], (3, 6))
    *_, infos = step(env, [MOVE_TO_TARGET, STAY])
    assert infos["macro_done"].all() and (env.target != (3, 6)).any() and not infos["success"].any()


def test_stay_lasts_one_step():
    env = make(num_envs=200, slip=1.0)
    place(env, [(0, 0), (5, 5)], (9, 9))
    for _ in range(3):
        obs, *_, infos = step(env, STAY)
        assert infos["macro_done"].all() and (env.position == [(0, 0), (5, 5)]).all()
        np.testing.assert_array_equal(obs, env._observe(start=False))


# ---- slip -----------------------------------------------------------------------------------------------------------
@pytest.mark.parametrize("slip", [1.0, 0.1])
@pytest.mark.parametrize("primitive", [False, True])
def test_a_move_slips_to_either_side_evenly(slip, primitive):
    env = make(num_envs=10000, n_agents=4, slip=slip, primitive=primitive)
    place(env, [(5, 1), (5, 9), (9, 5), (1, 5)], (5, 5))
    start = env.position.copy()
    step(env, [0, 1, 2, 3] if primitive else MOVE_TO_TARGET)  # towards the middle: N, S, W, E
    moved = env.position - start
    forward = np.array([(0, 1), (0, -1), (-1, 0), (1, 0)])
    left = np.array([(-1, 0), (1, 0), (0, -1), (0, 1)])
    for agent in range(4):
        ends = [(moved[:, agent] == way[agent]).all(-1).sum() for way in (left, forward, -left)]
        assert sum(ends) == 10000 and within(ends, 10000, [slip / 2, 1 - slip, slip / 2])
    straight = (moved == forward).all(-1)
    assert slip == 1 or within((straight[:, 0] & straight[:, 1]).sum(), 10000, (1 - slip) ** 2)  # each agent on its own


@pytest.mark.parametrize("primitive", [False, True])
def test_staying_never_slips(primitive):
    env = make(num_envs=200, slip=1.0, primitive=primitive)
    place(env, [(3, 3), (3, 3)], (3, 3))
    *_, infos = step(env, 4 if primitive else MOVE_TO_TARGET)
    assert (env.position == (3, 3)).all() and infos["macro_done"].all()


# ---- the target, capture and the end of an episode ------------------------------------------------------------------
def test_the_target_moves_evenly_and_wraps():
    env = make(num_envs=10000)
    place(env, [(5, 5), (6, 6)], (0, 9))
    step(env, STAY)
    counts = [(env.target == cell).all(-1).sum() for cell in ((0, 0), (0, 8), (9, 9), (1, 9), (0, 9))]
    assert sum(counts) == 10000 and within(counts, 10000, 1 / 5)


def test_capture_by_the_agents_comes_before_the_targets_move():
    env = make(num_envs=300, capture_reward=2.5)
    place(env, [(4, 5), (5, 5)], (5, 5))
    _, rewards, terminations, truncations, infos = step(env, [MOVE_TO_TARGET, STAY])
    assert (env.target == (5, 5)).all()
    assert (rewards == 2.5).all() and rewards.dtype == np.float64
    assert terminations.all() and infos["success"].all() and infos["macro_done"].all() and not truncations.any()


def test_capture_by_the_targets_move():
    env = make(num_envs=5000)
    place(env, (5, 5), (6, 5))
    _, rewards, terminations, truncations, infos = step(env, STAY)
    captured = (env.target == (5, 5)).all(-1)
    assert within(captured.sum(), 5000, 1 / 5)
    np.testing.assert_array_equal(terminations, captured)
    np.testing.assert_array_equal(infos["success"], captured)
    np.testing.assert_array_equal(rewards, captured * 1.0)
    assert not truncations.any()


def test_one_agent_elsewhere_is_no_capture():
    env = make(num_envs=300, n_agents=10)
    place(env, [(5, 5)] * 9 + [(0, 0)], (5, 5))
    _, rewards, terminations, _, infos = step(env, STAY)
    assert not rewards.any() and not terminations.any() and not infos["success"].any()
    assert (env.target != (5, 5)).any()


def test_truncated_after_60_steps():
    env = make(num_envs=5)
    place(env, [(0, 0), (5, 5)], (9, 9))  # apart for ever, as both stay
    for t in range(1, 61):
        _, rewards, terminations, truncations, infos = step(env, STAY)
        assert not rewards.any() and not terminations.any() and (truncations == (t == 60)).all()
    assert not infos["success"].any() and infos["macro_done"].all()
    with pytest.raises(ValueError, match="reset"):
        step(env, STAY)


def test_terminations_outlive_the_reset_they_lead_to():
    env = make(num_envs=4)
    place(env, (5, 5), (5, 5))
    *_, terminations, _, infos = step(env, STAY)
    env.reset(options={"reset_mask": terminations})
    assert terminations.all() and infos["success"].all() and not env.success.any()


# ---- observations, state and reset ----------------------------------------------------------------------------------
def test_observations_and_state_are_cells_over_the_grid():
    env = make()
    place(env, [(1, 2), (8, 3)], (6, 9))
    obs, *_, infos = step(env, STAY)
    target = env.target[0] / 10
    np.testing.assert_array_equal(obs[0], np.float32([[0.1, 0.2, *target], [0.8, 0.3, *target]]))
    np.testing.assert_array_equal(infos["state"], np.float32([[0.1, 0.2, 0.8, 0.3, *target]]))
    assert obs.dtype == infos["state"].dtype == np.float32 and obs in env.observation_space
    assert (env.obs_sizes, env.state_size) == ([4, 4], 6)


@pytest.mark.parametrize("primitive", [False, True])
def test_the_target_is_hidden_by_flicker_for_each_agent_and_step(primitive):
    env = make(num_envs=20000, flicker=0.3, primitive=primitive)
    last = None
    for take in (lambda: env.reset(), lambda: step(env, 4 if primitive else STAY)):
        place(env, [(0, 0), (5, 5)], (9, 9))
        hidden = (take()[0][:, :, 2:] == HIDDEN).all(-1)
        assert within(hidden.sum(axis=0), 20000, 0.3) and within(hidden.all(-1).sum(), 20000, 0.3**2)
        assert last is None or within((hidden & last).sum(axis=0), 20000, 0.3**2)
        np.testing.assert_array_equal(hidden, ~env.visible)
        last = hidden


@pytest.mark.parametrize("flicker", [0.0, 1.0])
def test_flicker_always_or_never(flicker):
    env = make(num_envs=500, flicker=flicker)
    for obs in (env.reset()[0], step(env, STAY)[0]):
        assert ((obs[:, :, 2:] == HIDDEN) == bool(flicker)).all()
        np.testing.assert_array_equal(obs[:, :, :2], np.float32(env.position / 10))  # itself it always sees


def test_reset_is_uniform_and_gives_the_primitive_observation():
    env = make(num_envs=20000)
    obs, infos = env.reset()
    for cells in (env.position[:, 0], env.position[:, 1], env.target):
        assert within(np.bincount(cells @ [10, 1], minlength=100), 20000, 1 / 100)
    cells = np.concatenate([env.position, np.broadcast_to(env.target[:, None], env.position.shape)], axis=-1)
    np.testing.assert_array_equal(obs, np.float32(cells / 10))
    assert infos["macro_done"].all() and (env.goal == -1).all()


def test_reset_of_some_leaves_the_others_as_they_are():
    env = make(num_envs=100, flicker=0.3)
    step(env, MOVE_TO_TARGET)
    mask = np.arange(100) < 50
    before = {name: getattr(env, name).copy() for name in env.sim_arrays}
    env.reset(options={"reset_mask": mask})
    for name, array in before.items():
        np.testing.assert_array_equal(getattr(env, name)[~mask], array[~mask])
        assert (getattr(env, name)[mask] != array[mask]).any()


# ---- randomness and checkpoints -------------------------------------------------------------------------------------
def rollout(env, steps=30):
    """Observations, rewards and states of random play, which is the same for every batch."""
    actions, record = np.random.default_rng(0), []
    for _ in range(steps):
        obs, rewards, terminations, truncations, infos = env.step(
            actions.integers(env.n_actions[0], size=env.macro_done.shape)
        )
        record.append(np.concatenate([obs.reshape(env.num_envs, -1), rewards[:, None], infos["state"]], axis=1))
        if env.over.any():
            env.reset(options={"reset_mask": terminations | truncations})
    return np.stack(record, axis=1)


@pytest.mark.parametrize("env_id", ["ct-10", "ct-10-primitive", "ct-10-onestep"])
def test_the_seed_decides_the_trajectory(env_id):
    records = []
    for seed in (0, 0, 1):
        env = envs.make(env_id, num_envs=3)
        env.reset(seed=seed)
        records.append(rollout(env))
    np.testing.assert_array_equal(records[0], records[1])
    assert (records[0] != records[2]).any()
    assert (records[0][0] != records[0][1]).any()  # environments of one batch differ


def test_the_single_view_is_the_batch_of_one():
    batch, single = envs.make("ct-10"), envs.SingleMacroEnv(envs.make("ct-10"))
    obs, _ = batch.reset(seed=5)
    single_obs, _ = single.reset(seed=5)
    np.testing.assert_array_equal(single_obs, obs[0])
    for _ in range(20):
        obs, *_, infos = step(batch, MOVE_TO_TARGET)
        single_obs, *_, info = single.step(np.zeros(10, int))
        np.testing.assert_array_equal(single_obs, obs[0])
        np.testing.assert_array_equal(info["state"], infos["state"][0])


@pytest.mark.parametrize("env_id", ["ct-10", "ct-10-primitive", "ct-10-onestep"])
def test_a_saved_batch_goes_on_as_it_would_have(env_id):
    env, copy = envs.make(env_id, num_envs=8), envs.make(env_id, num_envs=8)
    env.reset(seed=3)
    rollout(env, steps=20)
    copy.reset(seed=4)
    copy.load_state(env.save_state())
    np.testing.assert_array_equal(rollout(env), rollout(copy))


# ---- the primitive and the one-step version -------------------------------------------------------------------------
def test_primitive_actions_move_one_cell_and_end_each_step():
    env = envs.make("ct-10-primitive", num_envs=3, n_agents=5, slip=0.0)
    assert env.macro_action_names == [["N", "S", "W", "E", "Stay"]] * 5 and env.n_actions == [5] * 5
    env.reset(seed=0)
    place(env, [(0, 9), (0, 0), (0, 0), (9, 0), (4, 4)], (7, 7))
    obs, *_, infos = step(env, [0, 1, 2, 3, 4])
    assert (env.position == [(0, 0), (0, 9), (9, 0), (0, 0), (4, 4)]).all() and infos["macro_done"].all()
    np.testing.assert_array_equal(obs, env._observe(start=False))


def test_the_macro_actions_and_defaults():
    env = envs.make("ct-10")
    assert env.macro_action_names == [["Move-to-T", "Stay"]] * 10
    assert (env.grid, env.slip, env.flicker, env.capture_reward, env.horizon) == (10, 0.1, 0.3, 1.0, 60)


def test_one_step_asks_every_step_and_keeps_the_goal():
    env = envs.make("ct-10-onestep", num_envs=3, n_agents=2, slip=0.0, flicker=1.0)
    assert env.macro_action_names == [["Move-to-T", "Stay"]] * 2
    env.reset(seed=0)
    place(env, [(0, 0), (5, 5)], (0, 5))
    for x, y, action in ((0, 1, MOVE_TO_TARGET), (0, 1, STAY), (0, 2, MOVE_TO_TARGET), (0, 3, MOVE_TO_TARGET)):
        obs, *_, infos = step(env, [action, STAY])
        assert infos["macro_done"].all() and (env.position[:, 0] == (x, y)).all() and (env.goal[:, 0] == (0, 5)).all()
        np.testing.assert_array_equal(obs, env._observe(start=False))


def test_always_move_to_target_is_the_same_walk_with_and_without_one_step():
    states = []
    for one_step in (False, True):
        env = envs.make("ct-10", num_envs=20, one_step=one_step)
        env.reset(seed=4)
        states.append([])
        while not env.over.any():
            states[-1].append(step(env, MOVE_TO_TARGET)[-1]["state"])
    np.testing.assert_array_equal(states[0], states[1])


def test_primitive_and_one_step_exclude_each_other():
    with pytest.raises(ValueError, match="primitive=True and one_step=True exclude each other"):
        envs.make("ct-10-onestep", primitive=True)
