"""deviations.py: replacements are made where and when it says, and bring what they bring by hand."""

import dataclasses

import numpy as np
import pytest

import avf_vdn
import envs
import play
from benchmark.scripted import push_big_box
from envs.box_pushing import STAY
from tests.rollouts import TINY, args_for
from theory import deviations


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    args = args_for(avf_vdn, "bp-10", **TINY)
    folder = tmp_path_factory.mktemp("runs")
    return avf_vdn.train(dataclasses.replace(args, runs_dir=str(folder)))


class Walks:
    """A script whose greedy agents walk below the big box and push: optimal with each other."""

    @staticmethod
    def evaluate(agents, env, gamma, seed):
        env.reset(seed=seed)
        total = np.zeros(env.num_envs)
        discounted = np.zeros(env.num_envs)
        running = np.ones(env.num_envs, bool)
        step = 0
        while running.any():
            actions = push_big_box(env, None)
            _, rewards, terminations, truncations, _ = env.step(actions)
            total += running * rewards
            discounted += running * gamma**step * rewards
            step += 1
            over = terminations | truncations
            running &= ~over
            env.reset(options={"reset_mask": over})
        return {"return": total, "discounted_return": discounted}


def returns(changes):
    args = avf_vdn.parse_args(["--env=bp-10"])
    return deviations.returns(Walks, args, {"agents": None}, changes)


def test_a_replacement_costs_what_it_does_by_hand():
    """On bp-10 both robots choose at step 0, and a Stay of one there is a step of delay for both: 0.1."""
    changes = [
        (),
        ((0, 0, STAY),),
        ((0, 0, STAY), (0, 1, STAY)),
        ((0, 0, STAY), (1, 0, STAY)),
    ]
    found = returns(changes)
    assert found[:, 0] == pytest.approx([98.9, 98.8, 98.8, 98.7])
    assert (np.diff(found[:, 1]) <= 0).all()


def test_only_free_agents_are_replaced():
    """In step 1 both walk: what they are given does not matter."""
    found = returns([(), ((1, 0, 4),)])
    assert found[0].tolist() == found[1].tolist()


def test_what_an_agent_cannot_start_replaces_nothing(monkeypatch):
    """After another replacement an initiation set may be another one."""
    everything = envs.BoxPushing._can_start

    def all_but_stay(env):
        can_start = everything(env).copy()
        can_start[..., STAY] = env.elapsed[:, None] > 0
        return can_start

    monkeypatch.setattr(envs.BoxPushing, "_can_start", all_but_stay)
    found = returns([(), ((0, 0, STAY),)])
    assert found[0].tolist() == found[1].tolist()


@pytest.mark.slow
def test_all_replacements_are_listed(run):
    script, args, learner, _ = play.load_run(run, "last")
    _, recorder = play.watch(script, args, learner, 1, args.seed)
    episode = recorder.episode()
    changes = deviations.singles(episode, [8, 8])
    assert len(set(changes)) == len(changes) == 7 * episode.chosen.sum()
    for t, agent, action in changes:
        assert episode.chosen[t, agent]
        assert episode.running[t, agent] != action
    both = deviations.pairs(changes, 10**7)
    assert len(both) == 49 * np.prod(episode.chosen.sum(0))
    assert all(one[0] <= other[0] for one, other in both)
    some = deviations.pairs(changes, 50)
    assert len(set(some)) == 50
    assert set(some) <= set(both)


def test_the_program(run, capsys):
    deviations.main([str(run), "--show", "1", "--pairs", "30"])
    lines = capsys.readouterr().out.splitlines()
    beginnings = [
        "bp-10 avf_vdn, last model of step",
        "greedy: return ",
        "one replaced: ",
        "  return ",
        "two replaced: 30, ",
        "  return ",
    ]
    assert len(lines) == len(beginnings)
    for line, beginning in zip(lines, beginnings, strict=True):
        assert line.startswith(beginning)


def test_a_task_with_chance_is_refused(tmp_path):
    args = args_for(avf_vdn, "ct-10", **TINY)
    run = avf_vdn.train(dataclasses.replace(args, runs_dir=str(tmp_path)))
    with pytest.raises(SystemExit, match="ct-10 has chance"):
        deviations.main([str(run)])
