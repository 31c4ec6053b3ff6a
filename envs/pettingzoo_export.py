"""A task as a PettingZoo environment, for libraries that know PettingZoo. `envs.to_pettingzoo` makes one."""

import numpy as np
from gymnasium.spaces import Box, Discrete
from pettingzoo import ParallelEnv

from envs.core import MacroVectorEnv


class MacroParallelEnv(ParallelEnv):
    """One environment of a task as a PettingZoo `ParallelEnv`, with the agents agent_0, agent_1, ...

    A step is one primitive time step, and an agent's action is the number of a macro-action, `Discrete`. A busy agent
    goes on with what it runs, whatever it is given. Observations are macro-observations, float32 [obs_size]. Every
    agent is given the team's reward, and all agents leave at the end of the episode. The info of an agent has

    - `action_mask` int8 [n_actions]: what the agent can do next. For a busy agent it is only what it runs.
    - `macro_done` bool: whether the agent is free, so that its next action starts a macro-action
    - `macro_action` int: the macro-action that it runs or ran last, -1 before the first
    """

    metadata = {**MacroVectorEnv.metadata, "name": "macro_actions", "is_parallelizable": True}

    def __init__(self, env):
        """env: a `MacroVectorEnv` of one environment."""
        self.env = env
        self.render_mode = env.render_mode
        self.possible_agents = [f"agent_{number}" for number in range(env.n_agents)]
        self.agents = []
        bounds = env.single_observation_space
        self.observation_spaces = {}
        self.action_spaces = {}
        for number, agent in enumerate(self.possible_agents):
            size = env.obs_sizes[number]
            self.observation_spaces[agent] = Box(bounds.low[number, :size], bounds.high[number, :size])
            self.action_spaces[agent] = Discrete(env.n_actions[number])
        self.state_space = Box(-np.inf, np.inf, (env.state_size,), np.float32)

    def observation_space(self, agent):
        return self.observation_spaces[agent]

    def action_space(self, agent):
        return self.action_spaces[agent]

    def state(self):
        """The task's true state, float32 [state_size]."""
        return self.env._state()[0]

    def render(self):
        """A picture, uint8 [height, width, 3], or None without a render mode."""
        pictures = self.env.render()
        return None if pictures is None else pictures[0]

    def reset(self, seed=None, options=None):
        """Starts an episode. options have no effect."""
        obs, infos = self.env.reset(seed=seed)
        self.agents = list(self.possible_agents)
        return self._by_agent(obs, infos)

    def step(self, actions):
        """actions: the macro-action of each agent, by name.

        Raises:
            ValueError: a free agent is given nothing, or what it cannot start.
        """
        if not self.agents:
            return {}, {}, {}, {}, {}

        given = [[actions.get(agent, -1) for agent in self.possible_agents]]
        obs, rewards, terminations, truncations, infos = self.env.step(np.array(given))
        obs, infos = self._by_agent(obs, infos)
        rewards = dict.fromkeys(self.agents, float(rewards[0]))
        terminations = dict.fromkeys(self.agents, bool(terminations[0]))
        truncations = dict.fromkeys(self.agents, bool(truncations[0]))
        if self.env.over[0]:
            self.agents = []
        return obs, rewards, terminations, truncations, infos

    def _by_agent(self, obs, infos):
        """Observations and infos of a batch of one as dicts, by agent."""
        obs_of = {}
        info_of = {}
        for number, agent in enumerate(self.possible_agents):
            obs_of[agent] = obs[0, number, : self.env.obs_sizes[number]]
            info_of[agent] = {
                "action_mask": infos["available"][0, number, : self.env.n_actions[number]].astype(np.int8),
                "macro_done": bool(infos["macro_done"][0, number]),
                "macro_action": int(infos["macro_action"][0, number]),
            }
        return obs_of, info_of
