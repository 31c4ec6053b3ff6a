"""Tasks as PettingZoo environments: PettingZoo's own tests, its masks, and a library that knows them."""

import warnings

import numpy as np
import pytest

import envs

pytest.importorskip("pettingzoo", reason="pip install -e '.[simulators]'")

from pettingzoo.test import parallel_api_test, parallel_seed_test

every_task = pytest.mark.parametrize("env_id", envs.IDS)


def has_initiation_sets(env_id):
    """PettingZoo's two tests try every action at any time."""
    return type(envs.make(env_id))._can_start is not envs.MacroVectorEnv._can_start


@pytest.mark.slow
@every_task
def test_pettingzoo_finds_nothing_wrong(env_id, monkeypatch):
    if has_initiation_sets(env_id):
        monkeypatch.setattr(type(envs.make(env_id)), "_can_start", envs.MacroVectorEnv._can_start)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        parallel_api_test(envs.to_pettingzoo(env_id), num_cycles=150)
        parallel_seed_test(lambda: envs.to_pettingzoo(env_id), num_cycles=100)


def masked(infos, rng):
    """A random action of each agent that its mask allows."""
    return {agent: int(rng.choice(np.flatnonzero(info["action_mask"]))) for agent, info in infos.items()}


@pytest.mark.slow
@every_task
def test_it_is_the_task_of_the_scripts(env_id):
    """The same seed and the same macro-actions give the same episode, and a mask is what is available."""
    env, exported = envs.make(env_id), envs.to_pettingzoo(env_id)
    rng = np.random.default_rng(0)
    obs, infos = env.reset(seed=3)
    exported_obs, exported_infos = exported.reset(seed=3)
    assert exported.agents == exported.possible_agents
    while exported.agents:
        for number, agent in enumerate(exported.possible_agents):
            info = exported_infos[agent]
            mask = info["action_mask"]
            assert mask.shape == (env.n_actions[number],)
            assert exported_obs[agent] in exported.observation_space(agent)
            np.testing.assert_array_equal(mask, infos["available"][0, number, : len(mask)])
            assert info["macro_done"] == infos["macro_done"][0, number]
            if not info["macro_done"]:
                assert np.flatnonzero(mask).tolist() == [info["macro_action"]], "a busy agent can only go on"
            np.testing.assert_array_equal(exported_obs[agent], obs[0, number, : env.obs_sizes[number]])
        np.testing.assert_array_equal(exported.state(), infos["state"][0])
        actions = masked(exported_infos, rng)
        given = np.array([[actions[agent] for agent in exported.possible_agents]])
        obs, rewards, terminations, truncations, infos = env.step(given)
        exported_obs, *others, exported_infos = exported.step(actions)
        for ours, theirs in zip((rewards, terminations, truncations), others, strict=True):
            assert theirs == dict.fromkeys(exported.possible_agents, ours[0])
    assert env.over[0]
    assert exported.step({}) == ({}, {}, {}, {}, {})


def test_keywords_pictures_and_errors():
    env = envs.to_pettingzoo("bp-10", render_mode="rgb_array", horizon=7)
    env.reset(seed=0)
    assert env.render().dtype == np.uint8 and env.env.horizon == 7
    assert envs.to_pettingzoo("bp-10").render() is None
    with pytest.raises(ValueError, match=r"agent 1 .* was given macro-action -1: it has 0\.\.7"):
        env.step({"agent_0": 1})
    with pytest.raises(ValueError, match="unknown environment"):
        envs.to_pettingzoo("bp")


@pytest.mark.slow
@every_task
def test_torchrl_steps_the_task(env_id):
    """Random play by TorchRL, which draws what the masks allow: a busy agent's action is what it runs."""
    pytest.importorskip("torchrl", reason="pip install -e '.[torchrl]'")
    from torchrl.envs import PettingZooWrapper

    exported = envs.to_pettingzoo(env_id, horizon=12)
    wrapped = PettingZooWrapper(exported, group_map={agent: [agent] for agent in exported.possible_agents})
    wrapped.set_seed(0)
    played = wrapped.rollout(30, break_when_any_done=False)
    assert played.batch_size == (30,)
    for number, agent in enumerate(exported.possible_agents):
        actions = played[agent, "action"][:, 0]
        masks = played[agent, "action_mask"][:, 0]  # [30, A]
        assert masks.shape == (30, exported.env.n_actions[number])
        assert masks.gather(1, actions[:, None]).all()
