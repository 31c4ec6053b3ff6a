"""AVF-VDN and AVF-QMIX: what they do not share with AVF-QPLEX, whose tests cover the definitions that all share."""

import copy
import dataclasses

import numpy as np
import pytest
import torch

import avf_qmix
import avf_qplex
import avf_vdn
from avf_qmix import QMIXMixer
from tests.rollouts import play
from tests.test_avf_qplex import smoke


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


def test_qmix_is_the_published_formula():
    """|w_2| ELU(|W_1| q + b_1) + b_2, one row after the other."""
    torch.manual_seed(0)
    mixer, state, utilities = QMIXMixer(3, 5, embed=8), torch.randn(6, 5), torch.randn(6, 3)
    joint = mixer(utilities, None, None, None, state)
    for row in range(6):
        weight = mixer.weight_1(state[row]).abs().reshape(3, 8)
        hidden = torch.nn.functional.elu(utilities[row] @ weight + mixer.bias_1(state[row]))
        expected = hidden @ mixer.weight_2(state[row]).abs() + mixer.bias_2(state[row]).squeeze()
        torch.testing.assert_close(joint[row], expected)


def test_vdn_is_the_sum():
    utilities = torch.tensor([[1.0, 2.0, 4.0], [-1.0, 0.5, 0.0]])
    assert avf_vdn.mix(utilities).tolist() == [7.0, -0.5]


def test_vdn_keeps_no_state():
    """Nothing in its memory, its batches or its networks has the state's width: it has no use for one."""
    env, _, buffer, _ = play(avf_vdn, "wtd-s", 3, lambda env: avf_vdn.ReplayBuffer(env, 6))
    assert not hasattr(buffer, "state") and not hasattr(buffer, "real")
    assert "state" not in buffer.sample(2, 4, np.random.default_rng(0))
    learner = avf_vdn.make_learner(avf_vdn.Args(), env)
    assert list(learner) == ["agents"] and not hasattr(avf_vdn.Args(), "mixer_state")


@pytest.mark.parametrize("mixer_state", ["joint", "single", "real", "decision"])
@pytest.mark.parametrize("script", [avf_qmix, avf_qplex])
def test_mixer_state_reaches_mixer_and_target_mixer(script, mixer_state):
    """What `test_mixer_state_feeds_the_rows_it_says` checks in the batch is what the mixers are given, valid rows only;
    and they are made for it."""
    env, _, buffer, _ = play(script, "wtd-s", 4, lambda env: script.ReplayBuffer(env, 9))
    learner = script.make_learner(script.Args(mixer_state=mixer_state, hidden_size=8), env)
    target, fed = copy.deepcopy(learner), {}
    batch = buffer.sample(6, 6, mixer_state, np.random.default_rng(1))
    for name, module in (("online", learner), ("target", target)):
        module["mixer"].register_forward_hook(lambda _, inputs, __, name=name: fed.__setitem__(name, inputs))
    script.td_loss(
        *script.over_rows(batch, learner["agents"], target["agents"]), learner["mixer"], target["mixer"], batch
    )
    here, n = batch["valid"], env.n_agents
    there = here.roll(1, 1)
    assert 6 < here.sum() < 36
    assert batch["state"].shape[2] == env.state_size * (n if mixer_state == "joint" else 1)
    for name, rows, state in (("online", here, "state"), ("target", there, "next_state")):
        utilities, values, actions, chosen, given = fed[name]
        torch.testing.assert_close(given, batch[state][rows])
        assert torch.equal(chosen, batch["chosen"][rows])
        assert {x.shape for x in (utilities, values, actions, chosen)} == {(int(here.sum()), n)}
    assert not torch.allclose(fed["online"][4], fed["target"][4])


def test_training_asks_for_the_mixer_state_of_its_settings(tmp_path, monkeypatch):
    asked = []
    sample = avf_qmix.ReplayBuffer.sample

    def spied(self, batch_size, window, mixer_state, rng, device):
        asked.append((batch_size, window, mixer_state))
        return sample(self, batch_size, window, mixer_state, rng, device)

    monkeypatch.setattr(avf_qmix.ReplayBuffer, "sample", spied)
    smoke(tmp_path, monkeypatch, avf_qmix, "wtd-s", dict(mixer_state="single"))
    assert set(asked) == {(8, 6, "single")}


@pytest.mark.parametrize(
    "script, env_id, options",
    [(avf_vdn, "wtd-s", {}), (avf_vdn, "ct-10", {}), (avf_vdn, "bp-10-primitive", {}), (avf_qmix, "ct-10", {})]
    + [(avf_qmix, "bp-10", dict(mixer_state=m)) for m in ("joint", "real", "decision")],
)
def test_smoke_run_takes_gradient_steps(tmp_path, monkeypatch, script, env_id, options):
    smoke(tmp_path, monkeypatch, script, env_id, options)


def test_settings_differ_by_the_mixer_only():
    fields = {s: {f.name for f in dataclasses.fields(s.Args)} for s in (avf_vdn, avf_qmix, avf_qplex)}
    assert fields[avf_qmix] - fields[avf_vdn] == {"mixer_state"} and fields[avf_vdn] < fields[avf_qmix]
    assert fields[avf_qplex] - fields[avf_qmix] == {"mask_ongoing"} and fields[avf_qmix] < fields[avf_qplex]
