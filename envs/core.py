"""The step contract shared by every domain: batched macro-action environments and their single-environment view."""

import json
from abc import ABC, abstractmethod

import gymnasium as gym
import numpy as np
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space

from envs import checks


class TaskError(ValueError):
    """A domain returned something invalid.

    It is an array of a wrong shape or dtype, a number that is not finite, or an empty initiation set.
    """


class MacroVectorEnv(VectorEnv, ABC):
    """A batch of cooperative environments whose agents run macro-actions of different lengths.

    One step is one primitive time step. `step` takes a macro-action for every agent. An agent is free when its last
    macro-action has ended: it starts the one that it is given. An agent is busy while its macro-action is running: it
    goes on with it, and what it is given is ignored. A macro-observation changes only in the step in which its agent's
    macro-action ends. The end of an episode ends all macro-actions, so every agent gets a macro-observation then.

    Environments are not reset by themselves (`AutoresetMode.DISABLED`). After a step that ended episodes, call
    `reset(options={"reset_mask": terminations | truncations})`.

    Attributes:
        num_envs: number of environments N.
        n_agents: number of agents n.
        n_actions: macro-actions of each agent, n ints.
        obs_sizes: length of each agent's macro-observation, n ints. The largest is d. Shorter ones are padded with 0.
        state_size: length S of the true state. The domain's docstring says what is in it.
        horizon: steps after which an episode is truncated.
        macro_action_names: for each agent the names of its macro-actions.
        macro_done: bool [N, n], whether the agent is free, so that it starts a macro-action in the next step.
        macro_action: int64 [N, n], the macro-action that is running or ran last, -1 before the first.
        own_actions: bool [n, A], which macro-actions each agent has. A is the largest of `n_actions`.
        available: bool [N, n, A], what each agent can do next. An agent that is free can start the macro-actions of its
            initiation set. An agent that is busy can only go on with the macro-action it runs.
        elapsed: int64 [N], steps taken in the episode.
        episode_return: float64 [N], the undiscounted return of the episode so far.
        cut: bool [N], False before each step. `_advance` may set it to True where the episode is truncated in this step
            by something else than the horizon.
        over: bool [N], whether the episode has ended. It is True before the first reset, too.
        success: bool [N], whether the task's goal was reached in the last step.

    A domain calls `super().__init__` and implements `_reset`, `_advance`, `_observe`, `_state` and `_draw`. If its
    macro-actions have initiation sets, it overrides `_can_start`. It names the arrays that hold its simulator state in
    `sim_arrays`; the first axis of each is the environment. What these methods return is checked in every step and
    reset: another shape or dtype, or a number that is not finite, raises a TaskError.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 8, "autoreset_mode": AutoresetMode.DISABLED}
    sim_arrays: tuple[str, ...] = ()

    def __init__(self, num_envs, macro_action_names, obs_low, obs_high, obs_sizes, state_size, horizon, render_mode):
        """Sets the attributes and the spaces.

        Args:
            num_envs: N, at least 1.
            macro_action_names: a list of names for each agent.
            obs_low, obs_high: bounds of the macro-observations, [n, d].
            obs_sizes: n ints, at most d.
            state_size: S.
            horizon: at least 1 step.
            render_mode: None or "rgb_array".

        Raises:
            ValueError: an argument is out of range.
        """
        modes = self.metadata["render_modes"]
        if render_mode is not None and not (isinstance(render_mode, str) and render_mode in modes):
            raise ValueError(f"render_mode must be None or one of {modes}, got {checks.shown(render_mode)}")
        num_envs = checks.whole("num_envs", num_envs)
        self.num_envs = num_envs
        self.horizon = checks.whole("horizon", horizon)
        self.render_mode = render_mode
        self.macro_action_names = [list(names) for names in macro_action_names]
        self.n_agents = len(macro_action_names)
        self.n_actions = [len(names) for names in macro_action_names]
        self.obs_sizes = list(obs_sizes)
        self.state_size = state_size
        low = np.float32(obs_low)
        high = np.float32(obs_high)
        self.single_observation_space = gym.spaces.Box(low, high, dtype=np.float32)
        self.single_action_space = gym.spaces.MultiDiscrete(self.n_actions)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self._action_index = np.arange(max(self.n_actions))  # [A]
        self.own_actions = self._action_index < np.array(self.n_actions)[:, None]
        self._own_everywhere = np.broadcast_to(self.own_actions, (num_envs, *self.own_actions.shape))  # read-only
        self._env_index = np.arange(num_envs)[:, None]
        self._agent_index = np.arange(self.n_agents)

        self.macro_done = np.ones((num_envs, self.n_agents), bool)
        self.macro_action = np.full((num_envs, self.n_agents), -1)
        self.elapsed = np.zeros(num_envs, np.int64)
        self.episode_return = np.zeros(num_envs)
        self.cut = np.zeros(num_envs, bool)
        self.over = np.ones(num_envs, bool)
        self.success = np.zeros(num_envs, bool)
        self.available = self._own_everywhere.copy()
        self._obs = np.zeros((num_envs, *self.single_observation_space.shape), np.float32)

    # ---- what a domain implements -------------------------------------------------------------------------------
    @abstractmethod
    def _reset(self, mask):
        """Sets the simulator arrays to the start of an episode in those environments where mask, bool [N], is True."""

    @abstractmethod
    def _advance(self):
        """Takes one step of the macro-action that each agent runs.

        `macro_done` is still that of the step before: where it is True, the agent starts its `macro_action` in this
        step. `elapsed` already counts this step.

        Returns:
            rewards float64 [N]
            terminations bool [N]
            ended bool [N, n]: whether the agent's macro-action ends in this step
            success bool [N]: whether the task's goal is reached in this step. It must be True in one step of an episode
                at most, because evaluation adds it up.
        """

    @abstractmethod
    def _observe(self, start):
        """Macro-observations float32 [N, n, d] of the current simulator state.

        Args:
            start: True in a reset, False in a step. In a reset only the environments that were reset use the result.
        """

    @abstractmethod
    def _state(self):
        """The true state, a new float32 array [N, S]."""

    def _can_start(self):
        """Initiation sets, bool [N, n, A]: which macro-actions each agent can start now if it is free.

        By default these are all that it has. A free agent must have at least one that it can start.
        """
        return self._own_everywhere

    def _restore(self):
        """Called by `load_state` after the arrays are set.

        A domain whose simulator state is not only in `sim_arrays` rebuilds the rest from them here.
        """

    @abstractmethod
    def _draw(self, index):
        """A picture, uint8 [height, width, 3], of one environment."""

    # ---- Gymnasium's interface ----------------------------------------------------------------------------------
    def reset(self, *, seed=None, options=None):
        """Starts new episodes.

        Args:
            seed: an int reseeds the generator of the whole batch, None goes on with the one in use.
            options: `{"reset_mask": bool [N]}` resets only those environments and leaves the others as they are. There
                is no other option.

        Returns:
            obs float32 [N, n, d] and infos: those of `step`. `macro_action` is -1 in the environments that were reset.

        Raises:
            ValueError: the mask has another shape or dtype, or there is another option.
            TaskError: the domain's observations or states are not what they must be.
        """
        super().reset(seed=seed)
        options = options or {}
        if not options.keys() <= {"reset_mask"}:
            raise ValueError(f"the only option of a reset is 'reset_mask', got {list(options)}")
        mask = options.get("reset_mask")
        if mask is None:
            mask = np.ones(self.num_envs, bool)
        mask = np.asarray(mask)
        if mask.shape != (self.num_envs,) or mask.dtype != bool:
            raise ValueError(f"options['reset_mask'] must be a bool array of shape ({self.num_envs},)")
        self._reset(mask)
        self.macro_done[mask] = True
        self.macro_action[mask] = -1
        self.elapsed[mask] = 0
        self.episode_return[mask] = 0.0
        self.over[mask] = False
        self.success[mask] = False
        obs = self._checked("_observe", self._observe(start=True), np.float32, self._obs.shape)
        self._obs[mask] = obs[mask]
        self._update_available()
        return self._obs.copy(), self._infos()

    def step(self, actions):
        """Takes one primitive time step in every environment.

        Args:
            actions: int [N, n], the macro-action of each free agent; other entries are ignored.

        Returns:
            obs float32 [N, n, d], rewards float64 [N], terminations bool [N], truncations bool [N] and infos, a dict:

            - `macro_done` bool [N, n]: whether the agent's macro-action ended in this step, so that it chooses next
            - `macro_action` int64 [N, n]: the macro-action that ran in this step
            - `available` bool [N, n, A]: what the agent can do next
            - `state` float32 [N, S]
            - `success` bool [N]: whether the task's goal was reached in this step

        Raises:
            ValueError: the array has another shape or is not of integers, an environment's episode has ended, or a free
                agent's macro-action is out of range or not in its initiation set.
            TaskError: what the domain returns is not what it must be.
        """
        actions = np.asarray(actions)
        if actions.shape != self.macro_done.shape or actions.dtype.kind not in "iu":
            raise ValueError(
                f"actions must be integers of shape {self.macro_done.shape}, got {actions.dtype} {actions.shape}"
            )
        if self.over.any():
            raise ValueError(
                f"environments {np.flatnonzero(self.over)[:10].tolist()} have ended (or were never reset): "
                "reset them first, with options={'reset_mask': terminations | truncations}"
            )
        self._check_free_agents(actions)
        # "unsafe" lets actions be of any integer dtype. They are in range where they are copied.
        np.copyto(self.macro_action, actions, where=self.macro_done, casting="unsafe")
        self.elapsed += 1
        self.cut = np.zeros(self.num_envs, bool)
        rewards, terminations, ended, success = self._advance()
        self._checked("_advance: rewards", rewards, np.float64, self.elapsed.shape)
        self._checked("_advance: terminations", terminations, bool, self.elapsed.shape)
        self._checked("_advance: ended", ended, bool, self.macro_done.shape)
        self._checked("_advance: success", success, bool, self.elapsed.shape)
        self._checked("cut", self.cut, bool, self.elapsed.shape)
        self.success = success.copy()  # a reset writes into it, and it may be the same array as `terminations`
        truncations = (self.cut | (self.elapsed >= self.horizon)) & ~terminations
        self.over = terminations | truncations
        self.macro_done = ended | self.over[:, None]
        self.episode_return += rewards
        obs = self._checked("_observe", self._observe(start=False), np.float32, self._obs.shape)
        np.copyto(self._obs, obs, where=self.macro_done[:, :, None])
        self._update_available()
        return self._obs.copy(), rewards, terminations, truncations, self._infos()

    def render(self):
        """A tuple of N pictures, uint8 [height, width, 3], or None without a render mode."""
        if self.render_mode is None:
            return None
        return tuple(self._draw(index) for index in range(self.num_envs))

    def _check_free_agents(self, actions):
        """Raises ValueError for the first free agent that is given a macro-action which it cannot start."""
        in_range = (actions >= 0) & (actions < len(self._action_index))
        index = np.where(in_range, actions, 0)
        is_available = self.available[self._env_index, self._agent_index, index]  # [N, n]
        bad = self.macro_done & ~(in_range & is_available)
        if not bad.any():
            return

        env, agent = np.argwhere(bad)[0]
        given = actions[env, agent]
        count = self.n_actions[agent]
        if 0 <= given < count:
            name = self.macro_action_names[agent][given]
            can_start = np.flatnonzero(self.available[env, agent]).tolist()
            problem = f"{name} is not available, it can start {can_start}"
        else:
            problem = f"it has 0..{count - 1}"
        raise ValueError(f"agent {agent} of environment {env} was given macro-action {given}: {problem}")

    def _update_available(self):
        """Sets `available`: for a free agent its initiation set, for a busy one only its running macro-action."""
        is_running = self.macro_action[:, :, None] == self._action_index  # [N, n, A]
        self.available = np.where(self.macro_done[:, :, None], self._initiation_sets(), is_running)

    def _initiation_sets(self):
        """What `_can_start` returns, within what agents have. Raises TaskError if a free agent can start nothing."""
        can_start = self._can_start()
        if can_start is self._own_everywhere:
            return can_start  # the default needs no check
        self._checked("_can_start", can_start, bool, self.available.shape)
        can_start = can_start & self.own_actions
        is_empty = ~can_start.any(axis=2)  # [N, n]
        is_stuck = is_empty & self.macro_done & ~self.over[:, None]
        if is_stuck.any():
            env, agent = np.argwhere(is_stuck)[0]
            raise TaskError(f"agent {agent} of environment {env} is free, but its initiation set is empty")
        # A set may be empty where an agent is busy or its episode is over: nobody chooses there. It becomes all that
        # the agent has, so that an argmax or softmax over `available` is defined after the end of an episode, too.
        return can_start | (is_empty[:, :, None] & self.own_actions)

    def _checked(self, name, array, dtype, shape):
        """Returns an array of the domain's. Raises TaskError if it is not of this dtype and shape, or not finite."""
        domain = type(self).__name__
        if not isinstance(array, np.ndarray) or array.dtype != dtype or array.shape != shape:
            got = f"{array.dtype} {array.shape}" if isinstance(array, np.ndarray) else type(array).__name__
            raise TaskError(f"{domain}.{name} must be {np.dtype(dtype)} {shape}, got {got}")
        if array.dtype.kind == "f" and not np.isfinite(array).all():
            index = tuple(np.argwhere(~np.isfinite(array))[0])
            agent = f"agent {index[1]} of " if array.ndim == 3 else ""
            where = f"{agent}environment {index[0]} at step {self.elapsed[index[0]]}"
            raise TaskError(f"{domain}.{name} must be finite, got {array[index]} for {where}")
        return array

    def _infos(self):
        return {
            "macro_done": self.macro_done.copy(),
            "macro_action": self.macro_action.copy(),
            "available": self.available.copy(),
            "state": self._checked("_state", self._state(), np.float32, (self.num_envs, self.state_size)),
            "success": self.success.copy(),
        }

    # ---- checkpoints --------------------------------------------------------------------------------------------
    def _checkpointed(self):
        """The names of the arrays that make up a saved state."""
        base = ("macro_done", "macro_action", "elapsed", "episode_return", "over", "success", "_obs")
        return base + self.sim_arrays

    def save_state(self):
        """All that the simulator needs to go on: for each array its bytes, and as "np_random" the generator's JSON."""
        state = {name: getattr(self, name).tobytes() for name in self._checkpointed()}
        state["np_random"] = json.dumps(self.np_random.bit_generator.state)
        return state

    def load_state(self, saved):
        """Continues from what `save_state` returned.

        Returns:
            obs and infos, those of the last reset or step before it was saved.

        Raises:
            ValueError: it was saved by another domain, or by one with other sizes or another number of environments, or
                an entry is missing.
        """
        arrays = {name: getattr(self, name) for name in self._checkpointed()}
        for name, array in arrays.items():
            if len(saved.get(name, b"")) != array.nbytes:
                raise ValueError(f"the saved state is of another environment: {name!r} is missing or of another size")
        if "np_random" not in saved:
            raise ValueError("the saved state has no random generator, 'np_random'")
        for name, array in arrays.items():
            loaded = np.frombuffer(saved[name], array.dtype).reshape(array.shape)
            setattr(self, name, loaded.copy())
        self.np_random.bit_generator.state = json.loads(saved["np_random"])
        self._restore()
        self._update_available()
        return self._obs.copy(), self._infos()


class SingleMacroEnv(gym.Env):
    """One environment of a domain as a `gymnasium.Env`: a batch of one, without the batch's axis.

    `obs` is float32 [n, d] and the reward a float. The info has the entries of `MacroVectorEnv.step`: arrays, but
    `success` is a bool. `reset` takes the options of the batch.

    The batch truncates by itself, so tasks are registered without a step limit and `gymnasium.make` of an id adds no
    `TimeLimit`. The `spec` of the environment that was made has the horizon as its `max_episode_steps`.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 8}
    _spec = None

    def __init__(self, vector_env):
        self.vector_env = vector_env
        self.render_mode = vector_env.render_mode
        self.observation_space = vector_env.single_observation_space
        self.action_space = vector_env.single_action_space

    @property
    def spec(self):
        return self._spec

    @spec.setter
    def spec(self, spec):  # gymnasium.make sets it, without a step limit
        spec.max_episode_steps = self.vector_env.horizon
        self._spec = spec

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)  # Gymnasium asks for it; vector_env has a generator of its own
        obs, infos = self.vector_env.reset(seed=seed, options=options)
        return obs[0], self._info(infos)

    def step(self, action):
        obs, reward, terminated, truncated, infos = self.vector_env.step(np.asarray(action)[None])
        return obs[0], float(reward[0]), bool(terminated[0]), bool(truncated[0]), self._info(infos)

    def _info(self, infos):
        """The entries of the only environment. What is a number for each environment becomes a Python number."""
        return {name: array[0] if array.ndim > 1 else array[0].item() for name, array in infos.items()}

    def render(self):
        frames = self.vector_env.render()
        return frames[0] if frames else None

    def close(self):
        self.vector_env.close()
