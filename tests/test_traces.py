"""Recorded episodes of the published benchmark, reproduced number by number."""

from pathlib import Path

import numpy as np
import pytest

import envs

HERE = Path(__file__).parent
FOLDERS = (HERE.parents[1] / "shared" / "traces", HERE / "traces")  # all ten, and three small ones kept here


BOX_PUSHING = ["bp-10", "bp-20", "bp-30"]
WAREHOUSE = ["wtd-s", "wtd-d", "wtd-t", "wtd-t1"]
OVERCOOKED = [pytest.param(f"overcooked-{layout}", marks=pytest.mark.slow) for layout in "abc"]


@pytest.mark.parametrize("env_id", BOX_PUSHING + WAREHOUSE + OVERCOOKED)
def test_recorded_episodes(env_id):
    path = next((folder / f"{env_id}.npz" for folder in FOLDERS if (folder / f"{env_id}.npz").exists()), None)
    if path is None:
        pytest.skip(f"no recording of {env_id}: it is not in this repository")
    trace = np.load(path)
    episodes = len(trace["length"])
    env = envs.make(env_id, episodes)
    assert env.obs_sizes == trace["obs_size"].tolist() and env.n_actions == trace["n_actions"].tolist()
    obs, infos = env.reset(seed=0)
    np.testing.assert_array_equal(obs, trace["obs"][:, 0])
    assert infos["macro_done"].all()
    for t in range(trace["length"].max()):
        live, last = trace["length"] > t, trace["length"] == t + 1
        # An episode that is over is reset and given anything: agents that are free in the recording may not be here.
        actions = np.where(live[:, None], trace["action"][:, t], 0).astype(int)
        obs, rewards, terminations, truncations, infos = env.step(actions)
        rewards = rewards.astype(trace["reward"].dtype)  # some recordings have float32
        np.testing.assert_array_equal(rewards[live], trace["reward"][live, t])
        np.testing.assert_array_equal(terminations[live], trace["terminated"][live, t])
        np.testing.assert_array_equal(truncations[live], (last & ~trace["terminated"][:, t])[live])
        np.testing.assert_array_equal(infos["macro_action"][live], trace["macro_action"][live, t])
        # The recordings do not end macro-actions with the episode, the environments do.
        recorded_done = trace["macro_done"][:, t]
        np.testing.assert_array_equal(infos["macro_done"][live & ~last], recorded_done[live & ~last])
        assert infos["macro_done"][last].all()
        same = live[:, None] & (~last[:, None] | recorded_done)
        np.testing.assert_array_equal(obs[same], trace["obs"][:, t + 1][same])
        over = terminations | truncations
        if over.any():
            env.reset(options={"reset_mask": over})
