"""An episode that is known by heart, as play.py records it."""

import numpy as np
import torch

import envs
import play

PLAN = (  # two robots on bp-10, what each starts next: four steps to a small box, the others last for one
    [7, 7, 0, 5, 7],
    [1, 6, 6, 7, 7],
)


def scripted():
    """The Recorder of an episode of eight steps on environment 0, beside another one, and of what comes after it."""
    recorder = play.Recorder(envs.make("bp-10", num_envs=2, horizon=8), frames=[])
    left, said = [list(actions) for actions in PLAN], np.arange(2 * 2 * 8.0)
    _, infos = recorder.reset(seed=0)
    for step in range(12):
        actions = np.full((2, 2), 7)
        if step < 8:
            actions[0] = [left[agent].pop(0) if infos["macro_done"][0, agent] else 3 for agent in range(2)]
        recorder.listen(None, None, (torch.tensor(said + step).reshape(2, 2, 1, 8), None))
        _, _, terminations, truncations, infos = recorder.step(actions)
        if (over := terminations | truncations).any():
            _, infos = recorder.reset(options={"reset_mask": over})
    assert not any(left)
    return recorder
