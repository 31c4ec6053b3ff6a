"""A simulator that somebody else wrote, and macro-actions of your own, as a batch of environments.

The simulator is a PettingZoo `ParallelEnv`, or a `gymnasium.Env` whose observation space and action space are `Tuple`s
with an entry for each agent. A macro-action is an `Option`. `OptionsEnv` steps N copies of the simulator in a Python
loop. docs/your-own-simulator.md builds a task with it.
"""

import sys
import traceback
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from gymnasium.spaces import Box, Tuple, flatdim, flatten

from envs import checks
from envs.core import MacroVectorEnv, TaskError


class OptionError(TaskError):
    """An option is wrong. The message is one line with the option, the agent and the step."""


class Option(NamedTuple):
    """A macro-action: a policy, a termination condition and an initiation set (Section 2.2 of the paper).

    In the calls, sim is the simulator without its wrappers (`env.unwrapped`), and agent counts from 0.

    name: the macro-action's name in messages and timelines.
    run: `run(sim, agent)` is a generator. It yields the agent's primitive actions, at least one, and returns where the
        macro-action ends. After each step it is asked for the next action at once, so it sees what the step led to.
    available: `available(sim, agent)` is true if the agent can start the macro-action now. By default it always can.
    """

    name: str
    run: Callable[[Any, int], Iterator]
    available: Callable[[Any, int], bool] = lambda sim, agent: True


class Simulator:
    """One simulator with agents 0..n-1, whatever it calls them.

    Attributes:
        env: the PettingZoo or Gymnasium environment.
        names: what it calls the agents, a list of n.
        observation_spaces, action_spaces: those of the agents, lists of n.
        here: bool [n], which agents take part at present. In PettingZoo agents may leave before the episode ends.
    """

    def __init__(self, env):
        """Raises ValueError if env is of another kind."""
        self.env = env
        # PettingZoo's other kind of environment, an `AECEnv`, has `possible_agents` and `agent_iter`.
        self.is_parallel = hasattr(env, "possible_agents") and not hasattr(env, "agent_iter")
        spaces = [getattr(env, name, None) for name in ("observation_space", "action_space")]
        if self.is_parallel:
            self.names = list(env.possible_agents)
            self.observation_spaces = [env.observation_space(name) for name in self.names]
            self.action_spaces = [env.action_space(name) for name in self.names]
        elif all(isinstance(space, Tuple) for space in spaces):
            self.observation_spaces, self.action_spaces = map(list, spaces)
            self.names = list(range(len(self.action_spaces)))
        else:
            kinds = "a PettingZoo ParallelEnv or a gymnasium.Env with Tuple spaces"
            raise ValueError(f"make() must return {kinds}, got {checks.shown(env)}")
        self.here = np.ones(len(self.names), bool)

    def reset(self, seed):
        """Starts an episode. Returns what each agent observes: a list of n flat arrays, None for an absent agent."""
        obs, _ = self.env.reset(seed=seed)
        if self.is_parallel:
            self.here = np.array([name in self.env.agents for name in self.names])
        return self._flat(obs)

    def step(self, actions):
        """Takes a step with a list of n primitive actions. Those of absent agents are ignored.

        Returns what `reset` returns, the sum of the agents' rewards, whether the episode terminated, and whether it was
        truncated. In PettingZoo an episode is over when no agent is left. It terminated if all agents that were there
        in its last step terminated. Otherwise it was truncated. A Gymnasium environment says both itself. Where it says
        so for each agent, it must be true for all agents.
        """
        if not self.is_parallel:
            obs, rewards, terminated, truncated, _ = self.env.step(tuple(actions))
            return self._flat(obs), float(np.sum(rewards)), bool(np.all(terminated)), bool(np.all(truncated))

        given = {name: action for name, action, here in zip(self.names, actions, self.here, strict=True) if here}
        obs, rewards, terminations, truncations, _ = self.env.step(given)
        left = {name for name in given if terminations.get(name) or truncations.get(name)}
        self.here = np.array([name in self.env.agents and name not in left for name in self.names])
        is_over = not self.here.any()
        terminated = is_over and all(terminations.values())
        return self._flat(obs), float(sum(rewards.values())), terminated, is_over and not terminated

    def _flat(self, obs):
        flat = []
        for name, space in zip(self.names, self.observation_spaces, strict=True):
            is_absent = self.is_parallel and name not in obs
            flat.append(None if is_absent else flatten(space, obs[name]))
        return flat


class OptionsEnv(MacroVectorEnv):
    """N copies of a simulator whose agents run `Option`s.

    Macro-observations: what the simulator lets the agent observe, flattened, and what `observe` adds. An agent that has
        left the episode observes zeros.
    State: it begins with what `state` gives, or with the observations of all agents. For each agent it then has which
        option it is running (one-hot) and for how long (in tens of steps). Both are zeros for a free agent.
    Rewards: the sum of the agents' rewards.
    Episode end: when the simulator terminates or truncates the episode, or at the horizon. An agent that leaves early
        ends no macro-action and chooses nothing more. It counts as busy until the episode ends or it comes back. If it
        comes back, it is free.

    Checkpoints hold arrays alone: the seed of each running episode and the macro-actions that were chosen in it. When a
    saved state is loaded, these episodes are played again. Some simulators do not repeat themselves for a seed. Where
    an episode does not come out as it was, `load_state` says so on standard error. The episode is then truncated at its
    next step, so that a new one begins.
    """

    # A checkpoint holds these arrays.
    sim_arrays = ("seeds", "choices", "age", "views", "sim_state")

    def __init__(
        self,
        num_envs=1,
        *,
        make,
        options,
        horizon,
        observe=None,
        state=None,
        success=None,
        scale=1.0,
        render_mode=None,
    ):
        """Makes the simulators.

        Args:
            num_envs: N, at least 1.
            make: `make()` returns a simulator.
            options: a list of Options for all agents, or a list of such lists, one for each agent.
            horizon: steps after which an episode is truncated, at least 1.
            observe: `observe(sim, agent)` returns numbers that are appended to what the simulator lets the agent
                observe. For one agent they are always equally many.
            state: `state(sim)` returns numbers, the simulator's true state. They are always equally many.
            success: `success(sim)` says at the end of an episode whether the task's goal is reached. Without it,
                success is never reported.
            scale: factor on macro-observations and on the simulator's part of the state. The products should be of the
                order of 1.
            render_mode: None or "rgb_array". Pictures are those of the simulator's own `render()`.

        Raises:
            ValueError: an argument is out of range, or `make` returns something else than a simulator.
        """
        num_envs = checks.whole("num_envs", num_envs)
        self.observe = observe
        self.state = state
        self.succeeded = success
        self.scale = checks.numbers("scale", scale)
        first = Simulator(make())
        self.sims = [first, *(Simulator(make()) for _ in range(num_envs - 1))]
        self.options = options_of_agents(options, len(first.names))

        seen = first.reset(seed=0)  # only to learn how long observations and state are
        sizes = []
        for agent, space in enumerate(first.observation_spaces):
            sizes.append(flatdim(space) + len(self._more(first, agent)))
        bound = np.full((len(sizes), max(sizes)), np.inf)
        names = [[option.name for option in own] for own in self.options]
        sim_state = self._simulator_state(first, seen)
        most_options = max(map(len, names))
        state_size = len(sim_state) + len(names) * (most_options + 1)  # one-hot and time
        super().__init__(num_envs, names, -bound, bound, sizes, state_size, horizon, render_mode)

        self.seeds = np.zeros(num_envs, np.int64)
        self.choices = np.zeros((num_envs, self.horizon, self.n_agents), np.int32)  # who ran which option in each step
        self.age = np.zeros((num_envs, self.n_agents), np.int64)  # steps taken of the option that runs or ran last
        self.views = np.zeros((num_envs, *bound.shape), np.float32)  # what each agent would observe if it were free
        self.sim_state = np.zeros((num_envs, len(sim_state)), np.float32)  # the simulator's part of the state
        self.running = [[None] * self.n_agents for _ in self.sims]  # generators, None where an agent has started none
        self.actions = [[None] * self.n_agents for _ in self.sims]  # the primitive actions of the next step
        self.lost = np.zeros(num_envs, bool)  # whether a loaded episode did not come out as it was

    # ---- what there is to see -----------------------------------------------------------------------------------
    def _more(self, sim, agent):
        """What `observe` adds to an agent's observation."""
        return [] if self.observe is None else self.observe(sim.env.unwrapped, agent)

    def _simulator_state(self, sim, seen):
        """The simulator's part of the state.

        seen: what each agent observes, a list of n flat arrays, None for an absent agent.
        """
        if self.state is not None:
            return self.scale * np.asarray(self.state(sim.env.unwrapped), np.float32)
        parts = []
        for space, flat in zip(sim.observation_spaces, seen, strict=True):
            parts.append(np.zeros(flatdim(space)) if flat is None else flat)
        return self.scale * np.concatenate(parts, dtype=np.float32)

    def _look(self, e, seen):
        """Sets `views` and `sim_state` of environment e. seen: as for `_simulator_state`."""
        sim = self.sims[e]
        self.views[e] = 0.0
        for agent, flat in enumerate(seen):
            if flat is not None:
                view = np.concatenate([flat, self._more(sim, agent)])
                self.views[e, agent, : self.obs_sizes[agent]] = self.scale * view
        self.sim_state[e] = self._simulator_state(sim, seen)

    def _observe(self, start):
        return self.views.copy()

    def _state(self):
        runs = self.macro_action[:, :, None] == np.arange(self.own_actions.shape[1])  # [N, n, A]
        progress = np.concatenate([runs, self.age[:, :, None] / 10], axis=2)  # [N, n, A + 1]
        progress[self.macro_done] = 0
        flat = progress.reshape(self.num_envs, -1)
        return np.concatenate([self.sim_state, flat], axis=1, dtype=np.float32)

    def _draw(self, index):
        picture = self.sims[index].env.render()
        if not isinstance(picture, np.ndarray):
            raise ValueError("the simulator draws no picture: does make() give it render_mode='rgb_array'?")
        return picture

    def close_extras(self, **kwargs):
        """Closes the simulators."""
        for sim in self.sims:
            sim.env.close()

    # ---- episodes -----------------------------------------------------------------------------------------------
    def _reset(self, mask):
        for e in np.flatnonzero(mask):
            self.seeds[e] = self.np_random.integers(2**31)
            self._begin(e)

    def _begin(self, e):
        """Begins the episode of environment e from its seed."""
        seen = self.sims[e].reset(int(self.seeds[e]))
        self.running[e] = [None] * self.n_agents
        self.age[e] = 0
        self.lost[e] = False
        self._look(e, seen)

    def _can_start(self):
        can_start = np.tile(self.own_actions, (self.num_envs, 1, 1))
        chooses = self.macro_done & ~self.over[:, None] & ~self.lost[:, None]
        for e, agent in np.argwhere(chooses):
            if self.sims[e].here[agent]:
                can_start[e, agent, : self.n_actions[agent]] = self._initiation_set(e, agent)
        return can_start

    def _initiation_set(self, e, agent):
        """Which of its options the agent can start, a list of bools."""
        step = self.elapsed[e]
        unwrapped = self.sims[e].env.unwrapped
        can_start = []
        for option in self.options[agent]:
            try:
                can_start.append(bool(option.available(unwrapped, agent)))
            except Exception as error:
                raise OptionError(describe(option, agent, step, f"available: {error_and_line(error)}")) from error
        if not any(can_start):
            names = ", ".join(option.name for option in self.options[agent])
            raise OptionError(f"agent {agent} at step {step} can start none of its options: {names}")
        return can_start

    def _advance(self):
        rewards = np.zeros(self.num_envs)
        terminations = np.zeros(self.num_envs, bool)
        ended = np.zeros(self.macro_done.shape, bool)
        success = np.zeros(self.num_envs, bool)
        for e, sim in enumerate(self.sims):
            step = self.elapsed[e] - 1  # elapsed counts this step already
            self.choices[e, step] = self.macro_action[e]
            if self.lost[e]:
                self.cut[e] = True
                continue
            starts = self.macro_done[e]  # who was free before this step starts its option in it
            rewards[e], terminations[e], self.cut[e], ended[e] = self._play(e, step, self.macro_action[e], starts)
            is_over = terminations[e] or self.cut[e] or step + 1 == self.horizon
            if is_over and self.succeeded is not None:
                success[e] = self.succeeded(sim.env.unwrapped)
        return rewards, terminations, ended, success

    def _play(self, e, step, choices, starts):
        """Takes one step of environment e.

        step: how many steps the episode had before. choices: int [n], the option that each agent runs. starts: bool
        [n], which agents start it in this step.

        Returns the reward, whether the episode terminated, whether it was truncated, and whose options ended, bool [n].
        """
        sim = self.sims[e]
        running = self.running[e]
        actions = self.actions[e]
        self.age[e] = np.where(starts, 0, self.age[e]) + 1
        for agent in np.flatnonzero(starts & sim.here):
            option = self.options[agent][choices[agent]]
            running[agent] = primitive_actions(option, sim, agent, step)
            actions[agent] = next(running[agent])
        seen, reward, terminated, truncated = sim.step(actions)
        self._look(e, seen)
        ended = np.zeros(self.n_agents, bool)
        if terminated or truncated:
            return reward, terminated, truncated, ended

        # Generators go on at once to the action of the next step. One that returns instead ends its option.
        for agent, generator in enumerate(running):
            if not sim.here[agent]:
                running[agent] = None
                continue
            if generator is None:  # the agent has just come
                ended[agent] = True
                continue
            actions[agent] = next(generator, None)
            ended[agent] = actions[agent] is None
        return reward, terminated, truncated, ended

    # ---- checkpoints --------------------------------------------------------------------------------------------
    def _restore(self):
        """Plays the episodes again that were running when the state was saved."""
        unfinished = np.flatnonzero(~self.over)
        for e in unfinished:
            self.lost[e] = not self._replay(e)
        count = np.count_nonzero(self.lost[unfinished])
        if count:
            words = "episodes did not repeat themselves from their seeds: they are cut, and new ones begin"
            print(f"{count} of {len(unfinished)} {words}", file=sys.stderr)

    def _replay(self, e):
        """Plays the episode of environment e again. Returns whether it came out as it was saved."""
        views = self.views[e].copy()  # as they were saved; playing changes these arrays
        sim_state = self.sim_state[e].copy()
        age = self.age[e].copy()
        earned = 0.0
        free = np.ones(self.n_agents, bool)
        is_over = False
        try:
            self._begin(e)
            for step in range(self.elapsed[e]):
                reward, terminated, truncated, free = self._play(e, step, self.choices[e, step], free)
                earned += reward
                is_over = terminated or truncated
                if is_over:
                    break
        except OptionError:  # an option met a state that it does not expect
            is_over = True
        is_same = not is_over and np.array_equal(free, self.macro_done[e]) and np.array_equal(age, self.age[e])
        is_same = is_same and np.allclose([earned], self.episode_return[e])
        is_same = is_same and np.allclose(views, self.views[e]) and np.allclose(sim_state, self.sim_state[e])
        # The agents last saw what was saved, also where the episode is lost.
        self.views[e] = views
        self.sim_state[e] = sim_state
        self.age[e] = age
        return is_same


# ---- options --------------------------------------------------------------------------------------------------------
def options_of_agents(options, n_agents):
    """A list of Options for each agent.

    Raises:
        ValueError: options is neither a list of Options nor a list of such lists, one for each agent.
    """
    if all(isinstance(option, Option) for option in options):
        options = [options] * n_agents
    is_right = len(options) == n_agents
    for own in options:
        is_right = is_right and len(own) > 0 and all(isinstance(option, Option) for option in own)
    if not is_right:
        kinds = f"a list of Options, or a list of {n_agents} such lists, one for each agent, none of them empty"
        raise ValueError(f"options must be {kinds}, got {checks.shown(options)}")
    return [list(own) for own in options]


def primitive_actions(option, sim, agent, step):
    """Yields what an option's generator yields, checked.

    sim: a `Simulator`. step: how many steps the episode had when the option starts.

    Raises:
        OptionError: the generator yields nothing or an action outside of the agent's space, or raises an error.
    """
    space = sim.action_spaces[agent]
    problem = "its generator yields nothing"  # until it yields something
    cause = None
    try:
        for action in option.run(sim.env.unwrapped, agent):
            if isinstance(space, Box):
                action = np.asarray(action, space.dtype)
            problem = None
            if not space.contains(action):
                problem = f"it yields {checks.shown(action)}, which is not in {space}"
                break
            yield action
            step += 1
    except Exception as error:
        problem = error_and_line(error)
        cause = error
    if problem:
        raise OptionError(describe(option, agent, step, problem)) from cause


def describe(option, agent, step, problem):
    """The message of an OptionError."""
    return f"option {option.name} of agent {agent} at step {step}: {problem}"


def error_and_line(error):
    """An exception and where it was raised, on one line."""
    last = traceback.extract_tb(error.__traceback__)[-1]
    message = " ".join(str(error).split())
    return f"{type(error).__name__}: {message} ({Path(last.filename).name}, line {last.lineno})"
