"""OptionsEnv: macro-actions written as generators, on two small simulators, one of each kind."""

import numpy as np
import pytest
from gymnasium import Env
from gymnasium.spaces import Box, Discrete, MultiDiscrete, Tuple

from envs.options import Option, OptionError, OptionsEnv
from tests.test_envs import assert_same


class Corridor:
    """A PettingZoo ParallelEnv in all but name: two agents walk from the left end of a corridor to its right end.

    Ann walks cells 0 to 5, by -1, 0 or 1, and starts in cell 0 or 1. Bob walks metres, by -1 to 1, and pays 0.5 a step.
    Who reaches 5 earns 10 and leaves. After 12 steps the episode is truncated.
    """

    possible_agents = ["ann", "bob"]
    unwrapped = property(lambda self: self)
    spaces = {"ann": Discrete(6), "bob": Box(0, 5, (2,))}
    moves = {"ann": Discrete(3, start=-1), "bob": Box(-1, 1, (1,))}

    def observation_space(self, agent):
        return self.spaces[agent]

    def action_space(self, agent):
        return self.moves[agent]

    def _observe(self, agents):
        seen = {"ann": int(self.at["ann"]), "bob": np.float32([self.at["bob"], self.time / 10])}
        return {agent: seen[agent] for agent in agents}

    def reset(self, seed=None, options=None):
        self.agents = list(self.possible_agents)
        self.time = 0
        self.at = {"ann": int(np.random.default_rng(seed).integers(2)), "bob": 0.0}
        return self._observe(self.agents), {agent: {} for agent in self.agents}

    def step(self, actions):
        assert actions.keys() == set(self.agents), "agents that have left are given nothing"
        self.time += 1
        for agent, action in actions.items():
            assert self.moves[agent].contains(action)
            self.at[agent] = min(5, max(0, self.at[agent] + np.sum(action)))
        terminations = {agent: bool(self.at[agent] >= 5) for agent in self.agents}
        truncations = {agent: self.time >= 12 and not terminations[agent] for agent in self.agents}
        rewards = {agent: 10.0 * terminations[agent] - 0.5 * (agent == "bob") for agent in self.agents}
        obs = self._observe(self.agents)
        self.agents = [agent for agent in self.agents if not terminations[agent] and not truncations[agent]]
        return obs, rewards, terminations, truncations, {agent: {} for agent in obs}

    def render(self):
        return np.zeros((4, 8, 3), np.uint8)


class Lamps(Env):
    """A Gymnasium environment with Tuple spaces: three agents, each with a lamp of two dials that it must set to 2, 1.

    An agent earns 1 in each step in which its lamp is set. The episode terminates when all are, is truncated at step 9.
    """

    observation_space = Tuple([MultiDiscrete([3, 2])] * 3)
    action_space = Tuple([MultiDiscrete([3, 2])] * 3)

    def reset(self, seed=None, options=None):
        super().reset(seed=seed)
        self.dials = self.np_random.integers(0, [2, 2], (3, 2))
        self.time = 0
        return tuple(self.dials), {}

    def step(self, actions):
        assert self.action_space.contains(actions)
        self.dials = np.array(actions)
        self.time += 1
        is_set = (self.dials == [2, 1]).all(1)
        return tuple(self.dials), is_set.astype(float).tolist(), bool(is_set.all()), self.time == 9, {}


def walk(steps, speed=1):
    """An option of the corridor that walks so many steps."""

    def run(sim, agent):
        for _ in range(steps):
            yield speed if agent == 0 else [speed]

    return Option(f"Walk({steps})", run)


def to_the_end(sim, agent):
    while True:
        yield 1 if agent == 0 else [1.0]


def is_near(sim, agent):
    return sim.at[sim.possible_agents[agent]] >= 3


REST = walk(1, speed=0)
OPTIONS = [[walk(2), walk(3), REST], [walk(2), Option("End", to_the_end, is_near)]]


def corridor(num_envs=1, options=OPTIONS, horizon=20, **keywords):
    return OptionsEnv(num_envs, make=Corridor, options=options, horizon=horizon, **keywords)


def random_play(env, steps, seed=0):
    """What each step of random play gave, with the environments that ended reset."""
    rng = np.random.default_rng(seed)
    history = []
    for _ in range(steps):
        actions = np.where(env.available, rng.random(env.available.shape), -1.0).argmax(2)
        history.append(env.step(actions))
        _, _, terminations, truncations, infos = history[-1]
        assert history[-1][0] in env.observation_space and infos["state"].shape == (env.num_envs, env.state_size)
        over = terminations | truncations
        if over.any():
            history.append(env.reset(options={"reset_mask": over}))
    return history


# ---- the step contract ----------------------------------------------------------------------------------------------
def test_sizes_and_what_is_seen():
    """Ann's cell is one-hot, Bob's two numbers are padded; both are scaled, and the state is as the docstring says."""
    env = corridor(2, scale=0.5, observe=lambda sim, agent: [agent, sim.time])
    assert env.n_actions == [3, 2] and env.macro_action_names == [["Walk(2)", "Walk(3)", "Walk(1)"], ["Walk(2)", "End"]]
    assert env.obs_sizes == [8, 4] and env.state_size == 6 + 2 + 2 * (3 + 1)
    obs, infos = env.reset(seed=0)
    start = [sim.env.at["ann"] for sim in env.sims]
    for e in range(2):
        assert obs[e, 0].tolist() == [*(0.5 * np.eye(6)[start[e]]), 0, 0]
        assert obs[e, 1].tolist() == [0, 0, 0.5, 0, 0, 0, 0, 0]
        assert infos["state"][e].tolist() == [*(0.5 * np.eye(6)[start[e]]), *[0] * 10]
    obs, _, _, _, infos = env.step(np.array([[1, 0], [2, 0]]))
    at = start  # the first Ann is busy, so she has seen nothing new; the second rested, and is free
    for e in range(2):
        assert obs[e, 0].tolist() == [*(0.5 * np.eye(6)[at[e]]), 0, 0.5 * e]
    bob = [0.5, 0.05]
    busy = [1, 0, 0, 0.1]
    first = [*(0.5 * np.eye(6)[start[0] + 1]), *bob, *[0, 1, 0, 0.1], *busy]
    second = [*(0.5 * np.eye(6)[start[1]]), *bob, *[0, 0, 0, 0], *busy]
    np.testing.assert_allclose(infos["state"], [first, second], rtol=1e-6)
    env.step(np.array([[1, 0], [2, 0]]))
    _, _, _, _, infos = env.step(np.array([[1, 0], [2, 0]]))
    np.testing.assert_allclose(infos["state"][:, -4:], [busy, busy], err_msg="Bob has begun his second walk", rtol=1e-6)


def test_a_state_of_ones_own():
    env = corridor(state=lambda sim: [sim.at["ann"], sim.at["bob"], sim.time], scale=2.0)
    _, infos = env.reset(seed=1)
    _, _, _, _, infos = env.step(np.array([[0, 0]]))
    assert env.state_size == 3 + 8
    np.testing.assert_allclose(infos["state"][0, :3], [2 * env.sims[0].env.at["ann"], 2, 2])


def test_options_end_where_their_generators_return():
    env = corridor(options=[[walk(3, speed=0)], [walk(2, speed=0)]])
    env.reset(seed=0)
    done = [env.step(np.zeros((1, 2), int))[4]["macro_done"][0].tolist() for _ in range(6)]
    assert done == [[False, False], [False, True], [True, False], [False, True], [False, False], [True, True]]


def test_initiation_sets_are_available():
    env = corridor()
    _, infos = env.reset(seed=0)
    assert infos["available"][0].tolist() == [[True, True, True], [True, False, False]]
    for _ in range(4):
        _, _, _, _, infos = env.step(np.array([[2, 0]]))
    assert infos["available"][0].tolist() == [[True, True, True], [True, True, False]], "Bob is at 4"
    with pytest.raises(ValueError, match="End is not available"):
        env.reset(seed=0)
        env.step(np.array([[0, 1]]))


def test_an_agent_that_leaves_early_is_busy_until_the_end():
    """Bob leaves at step 5, in the middle of his second walk; Ann rests on, and step 12 truncates."""
    env = corridor(options=[[REST], [walk(3)]])
    env.reset(seed=0)
    rewards = []
    for step in range(1, 13):
        obs, reward, terminations, truncations, infos = env.step(np.zeros((1, 2), int))
        rewards.append(reward[0])
        is_last = step == 12
        assert infos["macro_done"][0].tolist() == [True, is_last or step == 3]
        assert not terminations[0] and truncations[0] == is_last
    assert rewards == [-0.5] * 4 + [9.5] + [0.0] * 7
    assert obs[0, 1].tolist() == [0.0] * 6, "who has left observes zeros"


class Late(Corridor):
    """Bob comes after the first step."""

    def reset(self, seed=None, options=None):
        super().reset(seed)
        self.agents = ["ann"]
        return self._observe(self.agents), {"ann": {}}

    def step(self, actions):
        result = super().step(actions)
        if self.time == 1:
            self.agents.append("bob")
        return result


def test_an_agent_that_comes_late_chooses_when_it_is_there():
    """Nobody asks for its initiation set before, and in the second episode nothing of the first goes on."""
    walks = Option("Walk", walk(4, speed=0).run, lambda sim, agent: sim.agents.index("bob") == 1)
    env = OptionsEnv(make=Late, options=[[REST], [walks]], horizon=20)
    env.reset(seed=0)
    for _ in range(2):
        free = [env.step(np.zeros((1, 2), int))[4]["macro_done"][0, 1] for _ in range(12)]
        assert np.flatnonzero(free).tolist() == [0, 4, 8, 11]
        env.reset()


def at_the_last_moment(sim, agent):
    while True:
        yield 1 if 12 - sim.time <= 5 - sim.at["ann"] else 0


def test_terminated_and_truncated_are_kept_apart():
    """If all reach the end, it is terminated. The simulator's limit of 12 steps and the horizon truncate."""
    hurry = [Option("End", to_the_end)]
    linger = [Option("Linger", at_the_last_moment)]
    ends = []
    for options, horizon in ((hurry, 20), ([REST], 20), ([linger, [REST]], 20), ([linger, hurry], 20), ([REST], 7)):
        env = corridor(options=options, horizon=horizon)
        env.reset(seed=0)
        while not env.over[0]:
            _, _, terminations, truncations, _ = env.step(np.zeros((1, 2), int))
        ends.append((int(env.elapsed[0]), bool(terminations[0]), bool(truncations[0])))
    cut = (12, False, True)
    assert ends == [(5, True, False), cut, cut, (12, True, False), (7, False, True)]


def test_success_is_asked_for_at_the_end_of_an_episode():
    env = corridor(horizon=4, options=[walk(1)], success=lambda sim: sim.at["bob"] >= 3)
    env.reset(seed=0)
    assert [env.step(np.zeros((1, 2), int))[4]["success"][0] for _ in range(4)] == [False, False, False, True]


def set_dials(a, b):
    def run(sim, agent):
        yield [a, b]

    return Option(f"Set({a},{b})", run)


def test_a_gymnasium_environment_with_tuple_spaces():
    """The team's reward is the sum of the agents', observations are one-hot, ends are the simulator's."""
    env = OptionsEnv(2, make=Lamps, options=[set_dials(2, 1), set_dials(0, 0)], horizon=30)
    assert env.n_agents == 3 and env.obs_sizes == [5, 5, 5]
    env.reset(seed=0)
    obs, rewards, terminations, truncations, _ = env.step(np.array([[0, 1, 0], [0, 0, 0]]))
    assert obs[0, 1].tolist() == [1, 0, 0, 1, 0] and obs[0, 2].tolist() == [0, 0, 1, 0, 1]
    assert rewards.tolist() == [2.0, 3.0] and terminations.tolist() == [False, True] and not truncations.any()
    env.reset(options={"reset_mask": terminations})
    for _ in range(8):
        _, _, terminations, truncations, _ = env.step(np.ones((2, 3), int))
    assert not terminations.any() and truncations.tolist() == [True, False], "the simulator's own limit, of 9 steps"


def test_random_play_repeats_itself():
    one, other = corridor(3), corridor(3)
    one.reset(seed=5)
    other.reset(seed=5)
    history = random_play(one, 60)
    assert_same(history, random_play(other, 60))
    other.reset(seed=6)
    with pytest.raises(AssertionError):
        assert_same(history, random_play(other, 60))


def test_pictures_are_the_simulators():
    env = corridor(2, render_mode="rgb_array")
    env.reset(seed=0)
    assert [frame.shape for frame in env.render()] == [(4, 8, 3)] * 2
    dark = OptionsEnv(make=Lamps, options=[set_dials(0, 0)], horizon=9, render_mode="rgb_array")
    dark.reset(seed=0)
    dark.sims[0].env.render = lambda: None
    with pytest.raises(ValueError, match="the simulator draws no picture"):
        dark.render()


# ---- checkpoints ----------------------------------------------------------------------------------------------------
@pytest.mark.parametrize("steps", [0, 4, 9, 31])
def test_a_saved_state_is_played_again(capsys, steps):
    """Agents that are busy, agents that have left, and episodes of different ages go on as if nothing had happened."""
    env, other = corridor(4), corridor(4)
    env.reset(seed=1)
    random_play(env, steps)
    saved = env.save_state()
    assert {type(value) for value in saved.values()} == {bytes, str}, "no pickles"
    other.reset(seed=2)
    random_play(other, 3)
    obs, infos = other.load_state(saved)
    np.testing.assert_array_equal(obs, env._obs)
    assert_same(infos, env._infos())
    assert_same(random_play(env, 40), random_play(other, 40))
    assert not capsys.readouterr().err
    with pytest.raises(ValueError, match="another environment"):
        corridor(3).load_state(saved)
    assert_same(random_play(env, 10), random_play(other, 10))


def test_a_simulator_that_does_not_repeat_itself_is_noticed(capsys, monkeypatch):
    """Ann starts elsewhere when one of three episodes is played again. It is cut, and the others go on."""
    reset = Corridor.reset
    odd_seeds = set()

    def forgetful(self, seed=None, options=None):
        _, infos = reset(self, seed)
        self.at["ann"] = 3 if seed in odd_seeds else 0
        return self._observe(self.agents), infos

    monkeypatch.setattr(Corridor, "reset", forgetful)
    env, other = corridor(3), corridor(3)
    env.reset(seed=1)
    actions = np.array([[1, 0]] * 3)
    env.step(actions)
    saved = env.save_state()
    odd_seeds.add(int(env.seeds[2]))
    views = env.views.copy()
    obs, infos = other.load_state(saved)
    said = "1 of 3 episodes did not repeat themselves from their seeds: they are cut, and new ones begin\n"
    assert capsys.readouterr().err == said
    np.testing.assert_array_equal(obs, env._obs)
    assert infos["available"].sum(2).tolist() == [[1, 1]] * 3, "all are busy"
    expected, *_ = env.step(actions)
    obs, rewards, terminations, truncations, infos = other.step(actions)
    assert not terminations.any() and truncations.tolist() == [False, False, True]
    assert infos["macro_done"][2].all() and rewards.tolist() == [-0.5, -0.5, 0.0]
    np.testing.assert_array_equal(obs[2], views[2])
    np.testing.assert_array_equal(obs[:2], expected[:2])
    odd_seeds.clear()
    obs, _ = other.reset(options={"reset_mask": truncations})
    assert other.elapsed.tolist() == [2, 2, 0] and obs[2, 0].tolist() == [1, 0, 0, 0, 0, 0]
    assert not other.step(actions)[3].any()


@pytest.mark.parametrize("harm", ["raises", "ends", "pays", "shows", "hides"])
def test_whatever_comes_out_otherwise_is_noticed(capsys, monkeypatch, harm):
    """An option that fails, an episode that is over before, another return, observation or state."""
    monkeypatch.setattr(Corridor, "light", 0.0, raising=False)
    sees = dict(
        observe=lambda sim, agent: [sim.light if harm == "shows" else 0.0],
        state=lambda sim: [sim.light if harm == "hides" else 0.0],
    )
    env = corridor(2, **sees)
    env.reset(seed=1)
    env.step(np.array([[2, 0], [1, 0]]))
    env.step(np.array([[1, 0], [1, 0]]))
    saved = env.save_state()
    step = Corridor.step

    def other_step(self, actions):
        obs, rewards, terminations, truncations, infos = step(self, actions)
        if harm == "ends":
            truncations = dict.fromkeys(truncations, True)
        if harm == "pays":
            rewards["ann"] += 1
        return obs, rewards, terminations, truncations, infos

    monkeypatch.setattr(Corridor, "step", other_step)
    other = corridor(2, options=[[Option("Silent", silent)] * 3, OPTIONS[1]] if harm == "raises" else OPTIONS, **sees)
    monkeypatch.setattr(Corridor, "light", 1.0)
    _, infos = other.load_state(saved)
    np.testing.assert_array_equal(other.views, env.views)
    assert infos["available"].tolist() == [[[False, True, False], [True, True, False]]] * 2
    assert capsys.readouterr().err.startswith("2 of 2 episodes did not repeat themselves")


# ---- errors ---------------------------------------------------------------------------------------------------------
def silent(sim, agent):
    return
    yield


def broken(sim, agent):
    yield 0
    yield [][0]


def never(sim, agent):
    return False


def unsure(sim, agent):
    return sim.belief > 0.5


BAD_OPTIONS = [
    (walk(3, speed=2), "option Walk(3) of agent 0 at step 1: it yields 2, which is not in Discrete(3, start=-1)"),
    (Option("None", lambda sim, agent: iter([1, None])), "option None of agent 0 at step 2: it yields None, which"),
    (Option("Silent", silent), "option Silent of agent 0 at step 1: its generator yields nothing"),
    (Option("Broken", broken), "option Broken of agent 0 at step 2: IndexError: list index out of range (test"),
    (
        Option("Plain", lambda sim, agent: 3),
        "option Plain of agent 0 at step 1: TypeError: 'int' object is not",
    ),
    (
        Option("Unsure", walk(1).run, unsure),
        "option Unsure of agent 0 at step 0: available: AttributeError: ",
    ),
]


@pytest.mark.parametrize(("option", "message"), BAD_OPTIONS, ids=lambda value: getattr(value, "name", ""))
def test_an_error_in_an_option_names_it_and_the_agent_and_the_step(option, message):
    """Agent 0 rests for one step and then starts the option."""
    env = corridor(options=[[option, REST], [REST]])
    with pytest.raises(OptionError) as error:
        env.reset(seed=0)
        env.step(np.array([[1, 0]]))
        while not env.over[0]:
            env.step(np.array([[0, 0]]))
    assert str(error.value).startswith(message) and "\n" not in str(error.value)


def test_an_agent_must_be_able_to_start_something():
    options = [[REST], [Option("Never", REST.run, never), Option("End", REST.run, lambda sim, agent: sim.time < 2)]]
    env = corridor(options=options)
    env.reset(seed=0)
    env.step(np.array([[0, 1]]))
    with pytest.raises(OptionError, match=r"^agent 1 at step 2 can start none of its options: Never, End$"):
        env.step(np.array([[0, 1]]))


def test_bad_arguments_are_refused_in_one_line():
    for keywords, message in (
        (dict(options=[]), "options must be a list of Options, or a list of 2 such lists"),
        (dict(options=[[REST]]), "options must be a list of Options, or a list of 2 such lists"),
        (dict(options=[[REST], []]), "none of them empty, got"),
        (dict(options=[[REST], [walk]]), "options must be a list of Options, or a list of 2 such lists"),
        (
            dict(make=lambda: Box(0, 1)),
            "make() must return a PettingZoo ParallelEnv or a gymnasium.Env with Tuple spaces",
        ),
        (dict(horizon=0), "horizon must be a finite number of at least 1, got 0"),
        (dict(num_envs=0), "num_envs must be a finite number of at least 1, got 0"),
        (dict(scale=None), "scale must be a finite number, got None"),
    ):
        with pytest.raises(ValueError) as error:
            OptionsEnv(**{**dict(make=Corridor, options=OPTIONS, horizon=9), **keywords})
        assert message in str(error.value) and "\n" not in str(error.value)
