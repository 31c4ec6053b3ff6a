"""AVF-VDN and AVF-QMIX: what they do not share with AVF-QPLEX, whose tests cover the shared blocks."""

import copy

import numpy as np
import pytest
import torch

import avf_qmix
import avf_qplex
import avf_vdn
import envs
from avf_qmix import QMIXMixer
from avf_vdn import VDNMixer
from tests.curves import scalars
from tests.test_avf_qplex import TINY


def test_qmix_is_monotone_in_every_utility():
    """Eq. 1 at random weights and states, the derivatives by autograd; and it does depend on the state."""
    torch.manual_seed(0)
    smallest, largest = torch.inf, 0.0
    for _ in range(50):
        mixer, state = QMIXMixer(3, 5), 3 * torch.randn(40, 5)
        utilities = (10 * torch.randn(40, 3)).requires_grad_()
        joint = mixer(utilities, None, None, None, state)
        assert joint.shape == (40,)
        (slopes,) = torch.autograd.grad(joint.sum(), utilities)
        smallest, largest = min(smallest, slopes.min().item()), max(largest, slopes.max().item())
        assert not torch.allclose(joint, mixer(utilities, None, None, None, state.flip(0)))
    assert smallest >= 0 and largest > 0.1


def test_vdn_is_the_sum():
    utilities = torch.tensor([[1.0, 2.0, 4.0], [-1.0, 0.5, 0.0]])
    assert VDNMixer()(utilities, None, None, None, None).tolist() == [7.0, -0.5]


@pytest.mark.parametrize("mixer_state", ["joint", "single", "real", "decision"])
@pytest.mark.parametrize("script", [avf_qmix, avf_qplex])
def test_mixer_state_reaches_mixer_and_target_mixer(script, mixer_state):
    """What `test_mixer_state_feeds_the_rows_it_says` checks in the buffer is what the mixers are given."""
    env = envs.make("wtd-s", 2, horizon=20)
    learner, buffer = script.make_learner(script.Args(mixer_state=mixer_state, hidden_size=8), env)
    target, rng, (obs, infos) = copy.deepcopy(learner), np.random.default_rng(0), env.reset(seed=0)
    assert buffer.mixer_state == mixer_state
    hidden = learner["agents"].start(2)
    for _ in range(20):
        actions, moved = script.act(learner["agents"], obs, infos, hidden, 1.0, rng)
        state = infos["state"]
        buffer.decide(infos["macro_done"], obs, actions, state, hidden)
        obs, rewards, terminations, truncations, infos = env.step(actions)
        buffer.reward(rewards, state)
        hidden = moved
    buffer.finish(terminations | truncations, terminations, obs, infos["state"], hidden)
    batch, fed = buffer.sample(4, 6, rng), {}
    for name, module in (("online", learner), ("target", target)):
        module["mixer"].register_forward_hook(lambda _, inputs, __, name=name: fed.__setitem__(name, inputs[-1]))
    script.batch_loss(learner, target, batch, 0.0, 1.0)
    width = env.state_size * (3 if mixer_state == "joint" else 1)
    assert torch.equal(fed["online"], batch.state) and batch.state.shape[1] == width
    assert torch.equal(fed["target"], batch.next_state) and not torch.equal(batch.state, batch.next_state)


@pytest.mark.parametrize(
    "script, env_id, options",
    [(avf_vdn, "wtd-s", {}), (avf_vdn, "ct-10", {})]
    + [(avf_qmix, "bp-10", dict(mixer_state=m)) for m in ("joint", "single", "real", "decision")],
)
def test_smoke_run_takes_gradient_steps(tmp_path, script, env_id, options):
    args = script.defaults(env_id, runs_dir=str(tmp_path), **TINY, **options)
    folder = script.train(args)
    checkpoint = torch.load(folder / "checkpoint.pt", weights_only=True)
    assert checkpoint["updates"] == (1_200 - 200) // 40 and len(scalars(folder)["eval/return"]) == 3
    torch.manual_seed(args.seed)
    start = script.make_learner(args, envs.make(env_id))[0].state_dict()
    assert all(not torch.equal(value, start[name]) for name, value in checkpoint["learner"].items())
