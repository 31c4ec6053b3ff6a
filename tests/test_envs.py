"""The step contract, for every task."""

import json
import warnings

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AutoresetMode
from hypothesis import given, settings
from hypothesis import strategies as st

import envs
from envs import checks
from tests.matrix_game import MatrixGame, WaitingGame

every_task = pytest.mark.parametrize("env_id", envs.IDS)


def play(env, steps, seed, action_seed=0):
    """Random macro-actions; returns what every step gave, with the environments that ended reset."""
    rng, history = np.random.default_rng(action_seed), []
    history.append(env.reset(seed=seed))
    for _ in range(steps):
        actions = rng.integers(0, env.n_actions, (env.num_envs, env.n_agents))
        history.append(env.step(actions))
        over = history[-1][2] | history[-1][3]
        if over.any():
            history.append(env.reset(options={"reset_mask": over}))
    return history


def assert_same(first, second):
    assert type(first) is type(second)
    if isinstance(first, dict):
        assert first.keys() == second.keys()
        first, second = list(first.values()), list(second.values())
    if isinstance(first, (list, tuple)):
        assert len(first) == len(second)
        for one, other in zip(first, second, strict=True):
            assert_same(one, other)
    else:
        np.testing.assert_array_equal(first, second)


@pytest.mark.slow
@every_task
@settings(max_examples=8, deadline=None)
@given(seed=st.integers(0, 2**31), num_envs=st.integers(1, 5), stay_away=st.booleans())
def test_step_contract(env_id, seed, num_envs, stay_away):
    """Random actions never crash, never leave the spaces and keep the promises of MacroVectorEnv."""
    env, rng = envs.make(env_id, num_envs), np.random.default_rng(seed)
    obs, infos = env.reset(seed=seed)
    elapsed, returns = np.zeros(num_envs, int), np.zeros(num_envs)
    assert infos["macro_done"].all() and (infos["macro_action"] == -1).all()
    for _ in range(env.horizon + 20):
        free, before, running = infos["macro_done"], obs.copy(), infos["macro_action"]
        actions = rng.integers(0, env.n_actions, (num_envs, env.n_agents))
        actions[~free] = 99 if stay_away else -7  # entries of ongoing agents are ignored, whatever they are
        obs, rewards, terminations, truncations, infos = env.step(actions)
        elapsed, returns = elapsed + 1, returns + rewards
        over = terminations | truncations
        assert obs in env.observation_space and obs.dtype == np.float32 and obs.shape == env.observation_space.shape
        assert rewards.dtype == np.float64 and rewards.shape == (num_envs,) and np.isfinite(rewards).all()
        assert terminations.dtype == bool and truncations.dtype == bool and not (terminations & truncations).any()
        np.testing.assert_array_equal(truncations, (elapsed == env.horizon) & ~terminations)
        np.testing.assert_array_equal(infos["macro_action"], np.where(free, actions, running))
        assert infos["state"].shape == (num_envs, env.state_size) and infos["state"].dtype == np.float32
        assert np.isfinite(infos["state"]).all()
        assert infos["macro_done"][over].all(), "the end of an episode ends every macro-action"
        ongoing = ~infos["macro_done"]
        np.testing.assert_array_equal(obs[ongoing], before[ongoing])
        if env_id.endswith(("-primitive", "-onestep")):
            assert infos["macro_done"].all()
        for agent, size in enumerate(env.obs_sizes):
            assert not obs[:, agent, size:].any(), "padding is 0"
        np.testing.assert_allclose(env.episode_return, returns)
        if over.any():
            kept = obs[~over].copy()
            obs, infos = env.reset(options={"reset_mask": over})
            np.testing.assert_array_equal(obs[~over], kept)
            assert infos["macro_done"][over].all() and (infos["macro_action"][over] == -1).all()
            elapsed[over], returns[over] = 0, 0.0


@pytest.mark.slow
@every_task
def test_every_macro_action_ends(env_id):
    """No macro-action outlives the episode, and names, sizes and spaces agree."""
    env = envs.make(env_id, 3)
    assert [len(names) for names in env.macro_action_names] == env.n_actions
    assert env.single_observation_space.shape == (env.n_agents, max(env.obs_sizes))
    assert env.single_action_space.nvec.tolist() == env.n_actions
    assert env.metadata["autoreset_mode"] is AutoresetMode.DISABLED
    history = play(env, 2 * env.horizon, seed=3)
    done = np.stack([step[4]["macro_done"] for step in history if len(step) == 5])
    assert done.any(0).all()


@every_task
def test_gymnasium_checker(env_id):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_env(gym.make(f"{env_id}-v0").unwrapped, skip_render_check=True)
        check_env(gym.make(f"{env_id}-v0", render_mode="rgb_array").unwrapped)
        batch = gym.make_vec(f"{env_id}-v0", num_envs=3)
    assert isinstance(batch, envs.MacroVectorEnv) and batch.num_envs == 3


@pytest.mark.slow
@every_task
def test_same_seed_same_trajectory(env_id):
    history = play(envs.make(env_id, 3), 120, seed=0)
    assert_same(history, play(envs.make(env_id, 3), 120, seed=0))
    if env_id.startswith("ct"):  # the other domains are deterministic
        for other_seed in (1, 2):
            with pytest.raises(AssertionError):
                assert_same(history, play(envs.make(env_id, 3), 120, seed=other_seed))
        assert (history[0][0][0] != history[0][0][1]).any(), "environments of a batch differ"


@every_task
def test_no_call_changes_what_another_returned(env_id):
    env = envs.make(env_id, 2)
    first = env.reset(seed=1)
    kept = [first[0].copy(), {key: value.copy() for key, value in first[1].items()}]
    rng = np.random.default_rng(0)
    for _ in range(5):
        step = env.step(rng.integers(0, env.n_actions, (2, env.n_agents)))
        copies = [np.copy(part) for part in step[:4]] + [value.copy() for value in step[4].values()]
        env.reset(options={"reset_mask": np.array([True, False])})
        assert_same([*step[:4], *step[4].values()], copies)
    assert_same(list(first), kept)


@pytest.mark.slow
@every_task
def test_single_view_is_the_batch_of_one(env_id):
    batch, single = envs.make(env_id, 1), gym.make(f"{env_id}-v0").unwrapped
    rng = np.random.default_rng(5)
    obs, infos = batch.reset(seed=7)
    single_obs, info = single.reset(seed=7)
    for _ in range(batch.horizon):
        np.testing.assert_array_equal(obs[0], single_obs)
        assert info.keys() == infos.keys() and type(info["success"]) is bool
        for name, value in infos.items():
            np.testing.assert_array_equal(value[0], info[name])
        actions = rng.integers(0, batch.n_actions, (1, batch.n_agents))
        obs, rewards, terminations, truncations, infos = batch.step(actions)
        single_obs, reward, terminated, truncated, info = single.step(actions[0])
        assert (reward, terminated, truncated) == (rewards[0], terminations[0], truncations[0])
        if terminated or truncated:
            break
    assert terminated or truncated


@every_task
def test_saved_state_continues_exactly(env_id):
    env = envs.make(env_id, 4)
    play(env, 37, seed=2)
    saved = env.save_state()
    rng, steps = np.random.default_rng(1), []
    for _ in range(25):
        steps.append(rng.integers(0, env.n_actions, (4, env.n_agents)))
    other = envs.make(env_id, 4)
    other.reset(seed=99)

    def go_on(env):
        history = []
        for actions in steps:
            history.append(env.step(actions))
            over = history[-1][2] | history[-1][3]
            if over.any():
                history.append(env.reset(options={"reset_mask": over}))
        return history

    expected = go_on(env)
    obs, infos = other.load_state(saved)
    assert obs.tobytes() == saved["_obs"] and infos["macro_done"].tobytes() == saved["macro_done"]
    assert_same(expected, go_on(other))
    with pytest.raises(ValueError, match="another environment"):
        envs.make(env_id, 5).load_state(saved)
    for missing in ("elapsed", "np_random"):
        with pytest.raises(ValueError, match=missing):
            other.load_state({name: value for name, value in saved.items() if name != missing})


@every_task
def test_infos_of_one_environment_can_be_written_down(env_id):
    """A number is a Python number, so Gymnasium's own batches make an array of bools of `success`."""
    env = gym.make(f"{env_id}-v0")
    _, info = env.reset(seed=0)
    for _ in range(3):
        assert type(info["success"]) is bool
        assert json.loads(json.dumps(info, default=np.ndarray.tolist)).keys() == info.keys()
        _, reward, terminated, truncated, info = env.step(env.action_space.sample())
        assert (type(reward), type(terminated), type(truncated)) == (float, bool, bool)
    batch = gym.make_vec(f"{env_id}-v0", 2, vectorization_mode="sync")
    _, infos = batch.reset(seed=0)
    assert infos["success"].dtype == bool and not infos["success"].any()


def test_a_reset_takes_its_option_and_no_other():
    batch = envs.make("bp-10", 2)
    for env in (batch, gym.make("bp-10-v0").unwrapped):
        env.reset(seed=0, options={})
        with pytest.raises(ValueError, match=r"the only option of a reset is 'reset_mask', got \['mask'\]"):
            env.reset(options={"mask": np.array([True])})
    single = gym.make("bp-10-v0").unwrapped
    single.reset(seed=0)
    single.step((7, 7))
    single.reset(options={"reset_mask": np.array([False])})
    assert single.vector_env.elapsed.tolist() == [1]
    single.reset()
    assert single.vector_env.elapsed.tolist() == [0]


# ---- what a domain returns ------------------------------------------------------------------------------------------
def spoil(monkeypatch, method, change):
    """A started batch of three waiting games in which a method's result is changed from the second step on."""
    env = WaitingGame(3, joins=0)
    real = getattr(WaitingGame, method)

    def spoiled(self, **arguments):
        result = real(self, **arguments)
        return change(result) if self.elapsed[0] == 2 else result

    monkeypatch.setattr(WaitingGame, method, spoiled)
    env.reset(seed=0)
    env.step(np.zeros((3, 2), int))
    return env


def at(index, value):
    """A function that gives a copy of an array with another value at the index."""

    def change(array):
        array = array.copy()
        array[index] = value
        return array

    return change


def part(number, change):
    """A function that changes one of the arrays that `_advance` returns."""
    return lambda arrays: tuple(change(array) if i == number else array for i, array in enumerate(arrays))


@pytest.mark.parametrize(
    ("method", "change", "line"),
    [
        ("_observe", at((1, 0, 0), np.nan), "_observe must be finite, got nan for agent 0 of environment 1 at step 2"),
        ("_observe", at((2, 1, 0), np.inf), "_observe must be finite, got inf for agent 1 of environment 2 at step 2"),
        ("_observe", lambda obs: obs[:, :1], "_observe must be float32 (3, 2, 1), got float32 (3, 1, 1)"),
        ("_observe", np.float64, "_observe must be float32 (3, 2, 1), got float64 (3, 2, 1)"),
        ("_state", at((0, 0), -np.inf), "_state must be finite, got -inf for environment 0 at step 2"),
        ("_state", lambda state: state[:, 0], "_state must be float32 (3, 1), got float32 (3,)"),
        ("_state", lambda state: state.tolist(), "_state must be float32 (3, 1), got list"),
        ("_advance", part(0, at(2, np.nan)), "_advance: rewards must be finite, got nan for environment 2 at step 2"),
        ("_advance", part(0, np.float32), "_advance: rewards must be float64 (3,), got float32 (3,)"),
        ("_advance", part(0, np.sum), "_advance: rewards must be float64 (3,), got float64"),
        ("_advance", part(1, np.int64), "_advance: terminations must be bool (3,), got int64 (3,)"),
        ("_advance", part(2, lambda x: x[:, 0]), "_advance: ended must be bool (3, 2), got bool (3,)"),
        ("_advance", part(3, lambda x: False), "_advance: success must be bool (3,), got bool"),
        ("_can_start", lambda x: x[0], "_can_start must be bool (3, 2, 2), got bool (2, 2)"),
        ("_can_start", np.int64, "_can_start must be bool (3, 2, 2), got int64 (3, 2, 2)"),
    ],
)
def test_what_a_domain_returns_is_checked(monkeypatch, method, change, line):
    env = spoil(monkeypatch, method, change)
    with pytest.raises(ValueError) as error:
        env.step(np.zeros((3, 2), int))
    assert str(error.value) == f"WaitingGame.{line}"


@pytest.mark.parametrize("method", ["_observe", "_state"])
def test_a_reset_is_checked_too(monkeypatch, method):
    env = WaitingGame(3, joins=0)
    real = getattr(WaitingGame, method)
    monkeypatch.setattr(WaitingGame, method, lambda self, **start: real(self, **start) * np.float32(np.nan))
    with pytest.raises(
        ValueError, match=rf"WaitingGame\.{method} must be finite, got nan for .*environment 0 at step 0"
    ):
        env.reset(seed=0)


class Restless(MatrixGame):
    """In environment 0 somebody ends the game in the second step."""

    def _advance(self):
        self.cut[0] = self.elapsed[0] == 2
        return super()._advance()


def test_a_domain_may_cut_an_episode():
    env = Restless(2)
    env.reset(seed=0)
    ends = []
    for _ in range(3):
        _, _, terminations, truncations, infos = env.step(np.zeros((2, 2), int))
        ends.append((terminations.tolist(), truncations.tolist()))
        over = terminations | truncations
        if over.any():
            assert infos["macro_done"][over].all()
            env.reset(options={"reset_mask": over})
    running = [False, False]
    assert ends == [(running, running), (running, [True, False]), ([False, True], running)]


def test_reset_mask_touches_only_its_environments():
    env = envs.make("ct-10", 3)
    play(env, 5, seed=0)
    names = ("position", "target", "elapsed", "episode_return", "_obs")
    before = {name: getattr(env, name).copy() for name in names}
    env.reset(options={"reset_mask": np.array([False, True, False])})
    for name in names:
        np.testing.assert_array_equal(before[name][[0, 2]], getattr(env, name)[[0, 2]])
    assert env.elapsed.tolist() == [5, 0, 5]


def test_a_registered_task_is_known_everywhere(monkeypatch):
    monkeypatch.setattr(envs, "_TASKS", dict(envs._TASKS))
    monkeypatch.setattr(gym.envs.registration, "registry", dict(gym.registry))
    envs.register("matrix", MatrixGame, tell=True)
    assert envs.problem("matrix") is None and "matrix" not in envs.IDS
    assert envs.make("matrix", num_envs=3).tell and not envs.make("matrix", tell=False).tell
    assert gym.make("matrix-v0").reset(seed=0)[0].shape == (2, 9)
    assert envs.make("tests.matrix_game:matrix", 2).num_envs == 2
    with pytest.raises(ValueError, match=r"there is an environment .* already, of tests\.matrix_game:MatrixGame"):
        envs.register("matrix", WaitingGame)
    for env_id in ("a b", "", "-", "a-", "a:b", "a/b", "a\n", None):
        with pytest.raises(ValueError, match="an id must be of letters, digits and '_'"):
            envs.register(env_id, MatrixGame)
    assert envs.problem("a b") == f"unknown environment 'a b'; valid ids: {' '.join(envs.IDS)} matrix"
    with pytest.raises(ImportError, match="No module named 'nowhere'"):
        envs.make("nowhere:matrix")


def test_bad_input_says_what_is_wrong():
    with pytest.raises(ValueError, match=r"unknown environment 'wtd'.*valid ids: bp-10"):
        envs.make("wtd")
    for arguments, message in (
        (dict(num_envs=0), "num_envs must be a finite number of at least 1, got 0"),
        (dict(horizon=0), "horizon must be a finite number of at least 1, got 0"),
        (dict(render_mode="human"), "render_mode must be None or one of"),
        (dict(grid=7), "grid must be even, got 7"),
        (dict(small_boxes=[(1.5, 9.5), (8.5, 5.5)]), r"small_boxes must be cell centres .* to \(9.5, 8.5\), got"),
        (dict(agent_starts=[(1.0, 1.5), (8.5, 1.5)]), r"agent_starts must be cell centres .* to \(9.5, 9.5\), got"),
    ):
        with pytest.raises(ValueError, match=message):
            envs.make("bp-10", **arguments)
    env = envs.make("bp-10", 2)
    with pytest.raises(ValueError, match="never reset"):
        env.step(np.zeros((2, 2), int))
    env.reset(seed=0)
    with pytest.raises(ValueError, match=r"agent 1 of environment 0 was given macro-action 8: it has 0..7"):
        env.step(np.array([[0, 8], [0, 0]]))
    with pytest.raises(ValueError, match="was given macro-action -1"):
        env.step(np.array([[0, 0], [-1, 0]]))
    with pytest.raises(ValueError, match="must be integers of shape"):
        env.step(np.zeros((2, 2)))
    with pytest.raises(ValueError, match="must be integers of shape"):
        env.step(np.zeros((1, 2), int))
    with pytest.raises(ValueError, match="reset_mask"):
        env.reset(options={"reset_mask": [1, 0]})
    for _ in range(100):
        _, _, terminations, truncations, _ = env.step(np.full((2, 2), 7))
    assert truncations.all() and not terminations.any()
    with pytest.raises(ValueError, match="have ended"):
        env.step(np.full((2, 2), 7))


NAN = float("nan")
BAD_KEYWORDS = {
    "bp-10": {
        "num_envs": [0, 2.5, NAN, "2", [2], None, 2e15, 10**20],
        "grid": [4, 7, 10.5, NAN, "10", True, None],
        "primitive": ["False", 1, None],
        "horizon": [0, 7.5, NAN, float("inf"), 1e300],
        "render_mode": ["human", "rgb_array_list", ["rgb_array"], np.array(["rgb_array", "human"]), True],
        "penalty": [NAN, float("-inf"), "-10", [-10.0], True, None],
        "step_cost": [NAN, np.array([-0.1, -0.1])],
        "small_reward": [NAN, 1j],
        "big_reward": [NAN, {}],
        "agent_starts": [
            *[5, [], "there", [(1.5, 1.5)], [(1.5,), (8.5, 1.5)], [(1.0, 1.5), (8.5, 1.5)], np.full((2, 2), NAN)],
            *[[(1.5, 1.5), (10.5, 1.5)], [(1.5, 1.5), (8.5, -0.5)], np.full((2, 3), 1.5)],
        ],
        "agent_orientations": [1, (0,), (0, 4), (-1, 0), (0.5, 1), (NAN, 0), "NE", np.array([1, 4])],
        "small_boxes": [
            *[5.5, [(1.5, 5.5)], [(1.5, 5.5), (8.5, None)], [(1.5, 5.5), (8.5, 0.5)], [(1.5, 9.5), (8.5, 5.5)]],
            *[[(1.5, 5.5), (8.5, 5.0)], np.full((3, 2), 5.5)],
        ],
        "big_box": [5, (5,), [(5, 5.5)], (5.5, 5.5), (5, 5), (0, 5.5), (10, 5.5), (5, 0.5), (5, 9.5), (NAN, 5.5)],
    },
    "ct-10": {
        "num_envs": [0, 2.5, NAN, "2"],
        "n_agents": [0, 2.5, NAN, "ten", [10], True],
        "grid": [1, 9.5, NAN, (10, 10)],
        "primitive": ["yes", 0],
        "one_step": [1, None],
        "slip": [-0.1, 1.5, NAN, None],
        "flicker": [-0.1, 1.1, NAN, "0.3"],
        "capture_reward": [NAN, float("inf"), [1.0]],
        "horizon": [0, 60.5, NAN],
        "render_mode": ["human"],
    },
}


@pytest.mark.parametrize(
    ("env_id", "name", "value"),
    [
        (env_id, name, value)
        for env_id, keywords in BAD_KEYWORDS.items()
        for name, values in keywords.items()
        for value in values
    ],
)
def test_a_bad_keyword_gets_one_line_with_its_name_and_value(env_id, name, value):
    with pytest.raises(ValueError) as error:
        envs.make(env_id, **{name: value})
    message = str(error.value)
    assert f"{name} must be" in message and message.endswith(f", got {checks.shown(value)}") and "\n" not in message


def test_a_keyword_may_be_an_array_or_a_number_of_another_type():
    given = {
        "grid": np.int32(12),
        "horizon": 40.0,
        "penalty": np.float32(-3.0),
        "agent_starts": [(2.5, 2.5), (9.5, 3.5)],
        "agent_orientations": [0, 2],
        "small_boxes": [(2.5, 6.5), (9.5, 5.5)],
        "big_box": (6, 7.5),
    }
    arrays = {name: np.array(value) for name, value in given.items()}
    assert_same(play(envs.make("bp-10", 3, **given), 90, seed=0), play(envs.make("bp-10", 3, **arrays), 90, seed=0))
    env = envs.make("ct-10", np.int64(3), n_agents=2.0, grid=np.array(6), slip=0, flicker=1)
    assert env.obs_sizes == [4, 4] and env.reset(seed=0)[0].shape == (3, 2, 4) and type(env.grid) is int


def test_checks_of_lists_and_of_what_must_be_positive():
    np.testing.assert_array_equal(checks.rows("tables", [(1, 2)], 2), [[1.0, 2.0]])
    np.testing.assert_array_equal(checks.positive("speeds", [1, 2], (2,)), [1.0, 2.0])
    for check, message in (
        (lambda: checks.rows("tables", [], 2), "tables must be a list with at least one entry, got []"),
        (lambda: checks.rows("tables", 3, 2), "tables must be a list with at least one entry, got 3"),
        (
            lambda: checks.rows("tables", [(1, 2, 3)], 2),
            "tables must be finite numbers of shape (1, 2), got [(1, 2, 3)]",
        ),
        (lambda: checks.positive("speed", 0), "speed must be above 0, got 0"),
        (lambda: checks.numbers("slip", 2, low=0, high=1), "slip must be a finite number from 0 to 1, got 2"),
        (lambda: checks.whole("copies", [1, 2.5], (2,)), "copies must be whole, got [1, 2.5]"),
    ):
        with pytest.raises(ValueError) as error:
            check()
        assert str(error.value) == message


def test_keywords_change_the_task():
    env = envs.make("bp-10", step_cost=-0.5, penalty=-3.0, horizon=12)
    env.reset(seed=0)
    _, reward, _, _, _ = env.step(np.array([[5, 4]]))  # the west-facing agent is eight steps from the wall
    assert reward[0] == -0.5
    for _ in range(7):
        _, _, _, _, infos = env.step(np.array([[7, 7]]))
    assert infos["macro_done"].all(), "Push ended on reaching the border"
    _, reward, _, _, _ = env.step(np.array([[7, 4]]))
    assert reward[0] == -3.5, "and walking into it costs a penalty"


def test_primitive_big_box_needs_both():
    env = envs.make("bp-10-primitive", agent_starts=[(4.5, 4.5), (5.5, 4.5)], agent_orientations=(0, 0))
    env.reset(seed=0)
    _, reward, _, _, infos = env.step(np.array([[0, 3]]))
    assert reward[0] == pytest.approx(-10.1) and infos["state"][0, 17] == pytest.approx(0.55)
    total = 0.0
    for _ in range(4):
        _, reward, terminations, _, infos = env.step(np.array([[0, 0]]))
        total += reward[0]
    assert terminations[0] and infos["success"][0] and total == pytest.approx(100 - 0.4)


def push(agent_start, orientation, steps=1, **arguments):
    """Agent 0 pushes from a cell while agent 1 stays: the environment, the rewards and the last step's infos."""
    env = envs.make("bp-10", agent_starts=[agent_start, (5.5, 0.5)], agent_orientations=(orientation, 0), **arguments)
    env.reset(seed=0)
    rewards = []
    for _ in range(steps):
        _, reward, _, _, infos = env.step(np.array([[4, 7]]))
        rewards.append(round(reward[0], 6))
    return env, rewards, infos


def test_pushing_rules():
    """The big box alone, small boxes from the side and walls cost a penalty and move nothing."""
    for start, orientation in (((4.5, 4.5), 0), ((2.5, 5.5), 3), ((0.5, 5.5), 1), ((3.5, 5.5), 1), ((5.5, 0.5), 2)):
        env, rewards, infos = push(start, orientation)
        assert rewards == [-10.1] and infos["macro_done"][0, 0], (start, orientation)
        assert env.position[0, 0].tolist() == list(start) and (env.box_y == 5.5).all()
    env, rewards, infos = push((1.5, 4.5), 0, steps=4)
    assert rewards == [-0.1, -0.1, -0.1, 9.9] and infos["macro_done"].all(), "small box 0 reaches the goal row"
    assert env.box_y[0].tolist() == [9.5, 5.5, 5.5] and not infos["success"][0]


def test_agent_1_goes_after_agent_0_has_pushed_and_not_the_other_way_round():
    """One pushes small box 0 out of row 5.5. The other wants to go south through that row, where a cell is blocked."""
    below_the_box, above_the_row = (1.5, 4.5), (4.5, 6.5)
    for pusher, faces, place in ((0, 2, [4.5, 5.5]), (1, 1, [4.5, 6.5])):
        starts = [below_the_box, above_the_row] if pusher == 0 else [above_the_row, below_the_box]
        orientations = (0, 2) if pusher == 0 else (2, 0)
        env = envs.make("bp-10", agent_starts=starts, agent_orientations=orientations)
        env.reset(seed=0)
        env.step(np.array([[4, 2]]) if pusher == 0 else np.array([[2, 4]]))
        assert env.box_y[0, 0] == 6.5
        assert env.position[0, 1 - pusher].tolist() == place and env.orientation[0, 1 - pusher] == faces


def test_both_may_push_one_small_box_beyond_the_goal_row():
    """Agent 1 stands in the box's own cell, so that the box is in front of it after agent 0 has pushed it."""
    places = {"small_boxes": [(1.5, 8.5), (8.5, 5.5)], "agent_starts": [(1.5, 7.5), (1.5, 8.5)]}
    env = envs.make("bp-10", agent_orientations=(0, 0), **places)
    env.reset(seed=0)
    _, rewards, terminations, _, infos = env.step(np.array([[4, 4]]))
    assert env.box_y[0].tolist() == [10.5, 5.5, 5.5] and env.position[0, :, 1].tolist() == [8.5, 9.5]
    assert rewards[0] == pytest.approx(9.9) and terminations[0] and not infos["success"][0]


def test_joint_push_needs_both_waypoints():
    """Where the agents stand does not count, the last waypoint does; 2 and 2 do not do."""
    env = envs.make("bp-10", 3)
    env.reset(seed=0)
    env.position[:], env.orientation[:] = [(4.5, 4.5), (5.5, 4.5)], 0
    env.last_waypoint[:] = [(2, 3), (3, 2), (2, 2)]
    _, rewards, _, _, infos = env.step(np.full((3, 2), 4))
    assert rewards.round(6).tolist() == [-0.1, -0.1, -20.1]
    assert env.box_y[:, 2].tolist() == [6.5, 6.5, 5.5] and infos["macro_done"].any(1).tolist() == [False, False, True]
