"""deviations.py: replacements are made where and when it says, and bring what they bring by hand."""

import dataclasses

import numpy as np
import pytest

import avf_vdn
import envs
import play
from benchmark.scripted import push_big_box
from tests.rollouts import TINY, args_for
from theory import deviations


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    args = args_for(avf_vdn, "bp-10", **TINY)
    return avf_vdn.train(dataclasses.replace(args, runs_dir=str(tmp_path_factory.mktemp("runs"))))


class Walks:
    """A script whose greedy agents walk below the big box and push: optimal with each other."""

    @staticmethod
    def evaluate(agents, env, gamma, seed):
        env.reset(seed=seed)
        total, discounted, live, step = np.zeros(env.num_envs), np.zeros(env.num_envs), np.ones(env.num_envs, bool), 0
        while live.any():
            _, rewards, terminations, truncations, _ = env.step(push_big_box(env, None))
            total, discounted, step = total + live * rewards, discounted + live * gamma**step * rewards, step + 1
            live &= ~(terminations | truncations)
            env.reset(options={"reset_mask": terminations | truncations})
        return {"return": total, "discounted_return": discounted}


def test_a_replacement_costs_what_it_does_by_hand():
    """On bp-10 both robots choose at step 0, and a Stay of one there is a step of delay for both: 0.1."""
    args = avf_vdn.parse_args(["--env=bp-10"])
    stay = envs.make("bp-10").macro_action_names[0].index("Stay")
    changes = [(), ((0, 0, stay),), ((0, 0, stay), (0, 1, stay)), ((0, 0, stay), (1, 0, stay))]
    found = deviations.returns(Walks, args, {"agents": None}, changes)
    assert found[:, 0] == pytest.approx([98.9, 98.8, 98.8, 98.7])
    assert (np.diff(found[:, 1]) <= 0).all()


def test_only_free_agents_are_replaced():
    """In step 1 both walk: what they are given does not matter."""
    args = avf_vdn.parse_args(["--env=bp-10"])
    found = deviations.returns(Walks, args, {"agents": None}, [(), ((1, 0, 4),)])
    assert found[0].tolist() == found[1].tolist()


def test_all_replacements_are_listed(run):
    script, args, learner, _ = play.load_run(run, "last")
    episode = play.watch(script, args, learner, 1, args.seed)[1].episode()
    counts = [8, 8]
    changes = deviations.singles(episode, counts)
    assert len(set(changes)) == len(changes) == 7 * episode.chosen.sum()
    assert all(episode.chosen[t, i] and episode.running[t, i] != m for t, i, m in changes)
    both = deviations.pairs(changes, 10**7)
    assert len(both) == 49 * np.prod(episode.chosen.sum(0)) and all(a[0] <= b[0] for a, b in both)
    some = deviations.pairs(changes, 50)
    assert len(set(some)) == 50 and set(some) <= set(both)


def test_the_program(run, capsys):
    deviations.main([str(run), "--show", "1", "--pairs", "30"])
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].startswith("bp-10 avf_vdn, last model of step") and lines[1].startswith("greedy: return ")
    assert lines[2].startswith("one replaced: ") and lines[3].startswith("  return ") and len(lines) == 6
    assert lines[4].startswith("two replaced: 30, ")


def test_a_task_with_chance_is_refused(tmp_path):
    args = args_for(avf_vdn, "ct-10", **TINY)
    run = avf_vdn.train(dataclasses.replace(args, runs_dir=str(tmp_path)))
    with pytest.raises(SystemExit, match="ct-10 has chance"):
        deviations.main([str(run)])
