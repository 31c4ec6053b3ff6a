"""Small games of two agents, for tests of what a learner can represent and of what it values."""

import numpy as np

from envs import MacroVectorEnv

NON_MONOTONIC = np.array([(8.0, -12.0, -12.0), (-12.0, 0.0, 0.0), (-12.0, 0.0, 0.0)])  # Son et al. 2019


class MatrixGame(MacroVectorEnv):
    """Both agents choose at the reset and are paid `payoff[m_0, m_1]` three steps later, which ends the episode.

    Agent 0's macro-actions last one step and agent 1's three. So agent 0 chooses twice more, to no effect, while agent
    1 is busy. The state tells the step.

    tell: from the second step on, macro-observations and state tell what was chosen at the reset. Without that, the
    later rows have to value what only the histories hold by a mixer that sees the step alone.
    """

    sim_arrays = ("first_choice",)

    def __init__(self, num_envs=1, payoff=NON_MONOTONIC, tell=False, render_mode=None):
        names = [["a", "b", "c"]] * 2
        width = 9 if tell else 3
        super().__init__(
            num_envs, names, np.zeros((2, width)), np.ones((2, width)), (width, width), width, 10, render_mode
        )
        self.payoff = np.array(payoff, float)
        self.tell = tell
        self.first_choice = np.zeros((num_envs, 2), int)

    def _reset(self, mask):
        self.first_choice[mask] = 0

    def _advance(self):
        is_first = self.elapsed == 1
        is_last = self.elapsed == 3
        self.first_choice[is_first] = self.macro_action[is_first]
        rewards = np.where(is_last, self.payoff[tuple(self.first_choice.T)], 0.0)
        ended = np.stack([np.ones(self.num_envs, bool), is_last], axis=1)
        return rewards, is_last, ended, is_last & (rewards == self.payoff.max())

    def _observe(self, start):
        return np.repeat(self._state()[:, None], 2, axis=1)

    def _state(self):
        step = np.eye(4, 3, dtype=np.float32)[self.elapsed]
        if not self.tell:
            return step
        chosen = np.eye(3, dtype=np.float32)[self.first_choice].reshape(self.num_envs, 6)
        return np.concatenate([step, chosen * (self.elapsed > 0)[:, None]], axis=1)

    def _draw(self, index):
        raise NotImplementedError


class WaitingGame(MacroVectorEnv):
    """Agent 0 stands below a big box. It pushes, or leaves for a safe one.

    A partner who plays at random, and whom no observation and no state shows, joins a push with probability `joins`.
    Then the box moves, which ends the episode and pays `big`. Otherwise the push costs `fails` and can be tried again.
    Leaving ends the episode and pays `safe`. Agent 1 only watches: its macro-actions, one step long, do nothing.
    """

    def __init__(self, num_envs=1, joins=0.1, big=8.0, fails=1.0, safe=2.0, render_mode=None):
        names = [["push", "leave"]] * 2
        super().__init__(num_envs, names, np.zeros((2, 1)), np.ones((2, 1)), (1, 1), 1, 50, render_mode)
        self.joins = joins
        self.big = big
        self.fails = fails
        self.safe = safe

    def _reset(self, mask):
        pass

    def _advance(self):
        pushes = self.macro_action[:, 0] == 0
        joins = self.np_random.random(self.num_envs) < self.joins
        rewards = np.where(pushes, np.where(joins, self.big, -self.fails), self.safe)
        return rewards, ~pushes | joins, np.ones((self.num_envs, 2), bool), pushes & joins

    def _observe(self, start):
        return np.ones((self.num_envs, 2, 1), np.float32)

    def _state(self):
        return np.ones((self.num_envs, 1), np.float32)

    def _draw(self, index):
        raise NotImplementedError
