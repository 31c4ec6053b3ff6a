"""The mixers of AVF-VDN, AVF-QMIX and AVF-QPLEX: what they compute, what they see, and what busy agents add to a loss.

tests/test_avf_qplex.py covers the rest of the three scripts.
"""

import copy
import dataclasses
from itertools import product
from types import SimpleNamespace

import numpy as np
import pytest
import torch

import avf_qmix
import avf_qplex
import avf_vdn
import envs
from avf_qmix import QMIXMixer
from avf_qplex import QPLEXMixer
from tests.rollouts import play
from tests.test_avf_qplex import ONLINE, TARGET, hand_made_batch, loss_of, smoke

with_mixer = pytest.mark.parametrize("script", [avf_qmix, avf_qplex], ids=lambda script: script.ALGORITHM)


def random_rows(n_rows, own_actions, state_size, unavailable=0.0):
    """Utilities, macro-actions, what is available and states, random, where some agents are busy."""
    n, n_actions = own_actions.shape
    utilities = 3 * torch.randn(n_rows, n, n_actions)
    can_start = own_actions & (torch.rand(n_rows, n, n_actions) >= unavailable)
    can_start[..., 0] = True
    actions = torch.distributions.Categorical(can_start.float()).sample()
    busy = torch.rand(n_rows, n, 1) < 0.5
    available = torch.where(busy, torch.nn.functional.one_hot(actions, n_actions).bool(), can_start)
    return utilities, actions, available, torch.randn(n_rows, state_size)


OWN_ACTIONS = torch.tensor([[True, True, True], [True, True, False], [True, True, True]])

# ---- VDN ----------------------------------------------------------------------------------------------------------


def test_vdn_is_the_sum():
    utilities = torch.tensor([[[1.0, 5.0], [2.0, 3.0], [4.0, 0.0]], [[-1.0, 7.0], [9.0, 0.5], [0.0, 6.0]]])
    actions = torch.tensor([[0, 1, 0], [0, 1, 1]])
    assert avf_vdn.mix(utilities, actions).tolist() == [8.0, 5.5]


def test_vdn_keeps_no_state():
    """Nothing in its rows, its batches or its networks has the state's width: it has no use for one."""
    env, _, buffer, _ = play(avf_vdn, "wtd-s", 2, horizon=10)
    assert not {"state", "last_state"} & set(buffer.running.dtype.names)
    assert not {"state", "last_state", "macro_state"} & avf_vdn.make_batch(list(buffer.ended)).keys()
    learner = avf_vdn.make_learner(avf_vdn.Args(), env)
    assert list(learner) == ["agents"] and not hasattr(avf_vdn.Args(), "mixer_state")


# ---- QMIX ---------------------------------------------------------------------------------------------------------


def test_qmix_is_monotone_in_every_utility():
    """Eq. 1 at random weights and states, the derivatives by autograd; and it does depend on the state."""
    torch.manual_seed(0)
    smallest, largest = torch.inf, 0.0
    for _ in range(50):
        mixer = QMIXMixer(3, 5)
        utilities, actions, available, state = random_rows(40, OWN_ACTIONS, 5)
        utilities.requires_grad_()
        joint = mixer(utilities, actions, available, state)
        assert joint.shape == (40,)
        (slopes,) = torch.autograd.grad(joint.sum(), utilities)
        taken = torch.nn.functional.one_hot(actions, 3).bool()
        assert not slopes[~taken].any(), "what was not chosen does not count"
        smallest, largest = min(smallest, slopes.min().item()), max(largest, slopes.max().item())
        assert not torch.allclose(joint, mixer(utilities, actions, available, state.flip(0)))
    assert smallest >= 0 and largest > 0.1


def test_qmix_is_the_published_formula():
    """|w_2| ELU(|W_1| q + b_1) + b_2, one row after the other, with any leading axes."""
    torch.manual_seed(0)
    mixer = QMIXMixer(3, 5, embed=8)
    utilities, actions, available, state = random_rows(6, OWN_ACTIONS, 5)
    joint = mixer(*(x.unflatten(0, (2, 3)) for x in (utilities, actions, available, state)))
    assert joint.shape == (2, 3)
    for row in range(6):
        q = torch.stack([utilities[row, i, actions[row, i]] for i in range(3)])
        weight = mixer.weight_1(state[row]).abs().reshape(3, 8)
        hidden = torch.nn.functional.elu(q @ weight + mixer.bias_1(state[row]))
        expected = hidden @ mixer.weight_2(state[row]).abs() + mixer.bias_2(state[row]).squeeze()
        torch.testing.assert_close(joint.flatten()[row], expected)


# ---- QPLEX --------------------------------------------------------------------------------------------------------


def literal_qplex(mixer, utilities, actions, choices, state):
    """Eqs. 3 and 4 for one agent and one head after the other, with the mixer's weights.

    choices: for each agent a list of the macro-actions of which V_i is the best.
    """
    n, n_actions = utilities.shape
    heads = mixer.heads
    out = mixer.state_net(state)
    weight, bias, key = out[:n].abs() + 1e-10, out[n : 2 * n], out[2 * n : 2 * n + heads].abs() + 1e-10
    agent = out[2 * n + heads :].reshape(heads, n)
    one_hot = torch.cat([torch.eye(n_actions)[action] for action in actions])
    action = mixer.action_net(torch.cat([state, one_hot])).reshape(heads, n)
    total = 0.0
    for i in range(n):
        strength = sum(key[h] * torch.sigmoid(agent[h, i]) * torch.sigmoid(action[h, i]) for h in range(heads))
        value = max(utilities[i, m] for m in choices[i])
        advantage = utilities[i, actions[i]] - value
        total += weight[i] * value + bias[i] + strength * weight[i] * advantage
    return total


@pytest.mark.parametrize("mask_ongoing", [True, False])
def test_qplex_is_the_duplex_formula(mask_ongoing):
    """V_i is the best of what is available or, literally, of all macro-actions that an agent has.

    The utilities of padding, which are the highest here, never count. The advantages teach lambda_i and not the
    utilities: the derivative by Q_i is the transform's weight alone.
    """
    torch.manual_seed(0)
    mixer = QPLEXMixer(OWN_ACTIONS, 4, hidden=8, mask_ongoing=mask_ongoing)
    utilities, actions, available, state = random_rows(60, OWN_ACTIONS, 4, unavailable=0.3)
    utilities[:, ~OWN_ACTIONS] = 1e3
    utilities.requires_grad_()
    joint = mixer(utilities, actions, available, state)
    choices = available if mask_ongoing else OWN_ACTIONS.expand_as(available)
    for row in range(60):
        lists = [np.flatnonzero(own).tolist() for own in choices[row].numpy()]
        expected = literal_qplex(mixer, utilities[row], actions[row], lists, state[row])
        torch.testing.assert_close(joint[row], expected)
    (slopes,) = torch.autograd.grad(joint.sum(), utilities)
    weight = mixer.state_net(state)[:, :3].abs() + 1e-10
    taken = torch.nn.functional.one_hot(actions, 3).bool()
    torch.testing.assert_close(slopes, torch.where(taken, weight[..., None], 0.0))


def test_qplex_advantages_teach_lambda():
    """Where an agent did not take its best macro-action, the networks behind lambda_i get a gradient."""
    torch.manual_seed(0)
    mixer = QPLEXMixer(OWN_ACTIONS, 4)
    utilities, actions, _, state = random_rows(5, OWN_ACTIONS, 4)
    for worse, expected in ((0.0, False), (1.0, True)):
        best = torch.where(torch.nn.functional.one_hot(actions, 3).bool(), 5.0 - 10.0 * worse, utilities.clamp(max=4))
        mixer.zero_grad()
        mixer(best, actions, OWN_ACTIONS.expand(5, 3, 3), state).sum().backward()
        assert all(parameter.grad.any() == expected for parameter in mixer.action_net.parameters())


@pytest.mark.parametrize("mixer_state", ["joint", "real"])
def test_greedy_utilities_maximise_the_joint_value(mixer_state):
    """Mac-IGM at random weights, for every set of busy agents, with initiation sets and the mixer that a run has.

    The greedy choice of each agent among what is available gives the best joint value of all that the team can do. The
    literal mixer breaks that.
    """
    torch.manual_seed(0)
    env = envs.make("wtd-s")
    own = torch.from_numpy(env.own_actions)
    n, n_actions = own.shape
    state_size = env.state_size * (n if mixer_state == "joint" else 1)
    broken = {True: 0, False: 0}
    for free in product([True, False], repeat=n):
        for case in range(4):
            # Close calls for those who choose, far apart for the others: where lambda's changes weigh most.
            spread = torch.tensor([0.1 if is_free else 5.0 for is_free in free])
            utilities = spread[:, None] * torch.randn(n, n_actions)
            can_start = own & ((torch.rand(n, n_actions) < 0.6) if case % 2 else True)
            can_start[:, 0] = True
            runs = torch.distributions.Categorical(own.float()).sample()
            only_goes_on = torch.nn.functional.one_hot(runs, n_actions).bool()
            available = torch.where(torch.tensor(free)[:, None], can_start, only_goes_on)
            joint_actions = torch.tensor(list(product(*map(np.flatnonzero, available))))
            greedy = [max(np.flatnonzero(can), key=lambda m, i=i: utilities[i, m]) for i, can in enumerate(available)]
            is_greedy = (joint_actions == torch.tensor(greedy)).all(1)
            state = torch.randn(state_size).expand(len(joint_actions), -1)
            for mask_ongoing in (True, False):
                args = avf_qplex.Args(mixer_state=mixer_state, mask_ongoing=mask_ongoing)
                mixer = avf_qplex.make_learner(args, env)["mixer"]
                for parameter in mixer.parameters():
                    parameter.data *= 3  # weights as they grow: at the start lambda hardly depends on m
                with torch.no_grad():
                    values = mixer(
                        utilities.expand(len(joint_actions), -1, -1),
                        joint_actions,
                        available.expand(len(joint_actions), -1, -1),
                        state,
                    )
                broken[mask_ongoing] += bool(values[is_greedy].item() < values.max() - 1e-4)
    assert broken[True] == 0 and broken[False] > 2


# ---- what the mixers see ------------------------------------------------------------------------------------------


def by_hand(choices, length, first_state=0):
    """The rows of an episode in which two agents choose at given steps, {step: (bool, bool)}. The state is the step."""
    space = SimpleNamespace(shape=(2, 1))
    task = SimpleNamespace(num_envs=1, n_actions=[1, 1], state_size=1, horizon=9, single_observation_space=space)
    buffer = avf_qplex.ReplayBuffer(task, 1)
    nothing = {"available": np.ones((1, 2, 1), bool), "macro_action": np.zeros((1, 2), int)}
    for t in range(length + 1):
        free = np.array([choices.get(t, (t == length, t == length))])
        infos = {**nothing, "macro_done": free, "state": np.full((1, 1), first_state + t, np.float32)}
        if t == length:
            buffer.end_episodes(np.array([True]), np.zeros((1, 2, 1)), infos)
        else:
            buffer.begin_rows(np.zeros((1, 2, 1)), infos, nothing["macro_action"], free)
            buffer.add_step(infos["state"], np.zeros(1), np.ones(1))
    return buffer.ended[0]


# What the mixer gets for Q at rows 0 to 4 and for Q' at the rows after these, the final one included.
MIXER_STATES = {
    "joint": ([[0, 0], [0, 1], [2, 1], [2, 4], [5, 4]], [[0, 1], [2, 1], [2, 4], [5, 4], [7, 7]]),
    "single": ([[0], [0], [1], [2], [5]], [[1], [2], [4], [5], [7]]),
    "real": ([[0], [1], [3], [4], [6]], [[1], [2], [4], [5], [7]]),
    "real-both": ([[0], [1], [3], [4], [6]], [[1], [3], [4], [6], [7]]),
    "decision": ([[0], [1], [2], [4], [5]], [[1], [2], [4], [5], [7]]),
}
SHORT_EPISODE = {
    "joint": ([[20, 20]], [[23, 23]]),
    "single": ([[20]], [[23]]),
    "real": ([[22]], [[23]]),
    "real-both": ([[22]], [[23]]),
    "decision": ([[20]], [[23]]),
}


@with_mixer
@pytest.mark.parametrize("kind", MIXER_STATES)
def test_mixer_states_by_hand(script, kind):
    """Two agents who choose at these steps. The state is the step.

    t        0     1     2     3     4     5     6     7 (end)
    agent 0  a0          a1                a2
    agent 1  b0    b1                b2
    row      0     1     2           3     4           5

    joint: the steps at which the agents chose. single: of these, that of the agent that is free at the next row, which
    is agent 1 at row 0, 0 at row 1, 1 at row 2 and 0 at row 3. At row 4 both are, so it is agent 0. real and real-both:
    the last step before the next row. The final row has no such step, and its own state stands in for it.
    Beside it stands a shorter episode, in which both choose at step 20 alone and which ends at step 23.
    """
    long = by_hand({0: (True, True), 1: (False, True), 2: (True, False), 4: (False, True), 5: (True, False)}, 7)
    short = by_hand({0: (True, True)}, 3, first_state=20)
    states, next_states = script.mixer_states(script.make_batch([long, short]), kind)
    assert (states[0, :-1].tolist(), next_states[0, 1:].tolist()) == MIXER_STATES[kind]
    assert (states[1, :1].tolist(), next_states[1, 1:2].tolist()) == SHORT_EPISODE[kind]


@with_mixer
@pytest.mark.parametrize("kind", MIXER_STATES)
def test_the_loss_gives_the_mixers_what_the_setting_says(script, kind):
    """And a run's mixers are made for it."""
    env, _, buffer, _ = play(script, "wtd-s", 3, horizon=20)
    args = script.Args(mixer_state=kind, hidden_size=8)
    learner = script.make_learner(args, env)
    target = copy.deepcopy(learner)
    batch = script.make_batch(list(buffer.ended))
    fed = {}
    for name, module in (("online", learner), ("target", target)):
        module["mixer"].register_forward_hook(lambda _, inputs, __, name=name: fed.__setitem__(name, inputs))
    utilities = script.utilities_at_rows(learner["agents"], batch)
    script.td_loss(utilities, utilities.detach(), learner["mixer"], target["mixer"], batch, args)
    state, next_state = script.mixer_states(batch, kind)
    assert state.shape[2] == env.state_size * (env.n_agents if kind == "joint" else 1)
    torch.testing.assert_close((fed["online"][3], fed["target"][3]), (state, next_state))
    torch.testing.assert_close(fed["online"][1], batch["action"])
    torch.testing.assert_close((fed["online"][2], fed["target"][2]), (batch["available"], batch["available"]))


# ---- what busy agents add to the loss -----------------------------------------------------------------------------

# In the batch made by hand, agent 0 is busy at row 1 of episode 0, and agent 1 at row 1 of episode 1. Where a utility
# of ONLINE enters Q: [episode, row, agent, macro-action], in the order of the rows.
TAKEN = [
    [(0, 0, 0, 1), (0, 0, 1, 0)],
    [(0, 1, 0, 1), (0, 1, 1, 1)],
    [(1, 0, 0, 0), (1, 0, 1, 1)],
    [(1, 1, 0, 1), (1, 1, 1, 1)],
    [(2, 0, 0, 0), (2, 0, 1, 0)],
]
BUSY = [(0, 1, 0, 1), (1, 1, 1, 1)]


@pytest.mark.parametrize("script", [avf_vdn, avf_qplex], ids=lambda script: script.ALGORITHM)
@pytest.mark.parametrize(
    ("ongoing", "q", "target"),
    [
        ("update", [7.0, 10.0, 5.0, 7.0, 6.0], [69.85, 2.0, 97.5, 116.995, 12.0]),
        ("detach", [7.0, 10.0, 5.0, 7.0, 6.0], [69.85, 2.0, 97.5, 116.995, 12.0]),
        # Q without the busy agents: 8 instead of 2 + 8, and 5 instead of 5 + 2. Q' of the rows before without them:
        # 1 + 0.81 * 65 instead of 1 + 0.81 * (20 + 65), and 3 + 0.9 * 60 instead of 3 + 0.9 * (60 + 45).
        ("zero", [7.0, 8.0, 5.0, 5.0, 6.0], [53.65, 2.0, 57.0, 116.995, 12.0]),
    ],
)
def test_what_busy_agents_add_by_hand(script, ongoing, q, target):
    """Values, targets, loss and gradients of the batch made by hand, at lambda 0.

    The derivative by each utility that enters a Q is -2 (y - Q) / 5. A busy agent's has one under "update" alone.
    """
    utilities = ONLINE.clone().requires_grad_()
    loss, got_q, got_target = loss_of(script, utilities, ongoing=ongoing)
    error = torch.tensor(target) - torch.tensor(q)
    torch.testing.assert_close((got_q, got_target), (torch.tensor(q), torch.tensor(target)))
    torch.testing.assert_close(loss, error.square().mean())
    loss.backward()
    expected = torch.zeros_like(ONLINE)
    for row, places in enumerate(TAKEN):
        for place in places:
            if ongoing == "update" or place not in BUSY:
                expected[place] = -2 * error[row] / 5
    torch.testing.assert_close(utilities.grad, expected)


@pytest.mark.parametrize("script", [avf_vdn, avf_qplex], ids=lambda script: script.ALGORITHM)
def test_zero_leaves_busy_agents_out_of_lambda_returns(script):
    """Episode 0: y[1] = 2; y[0] = 1 + 0.81 (0.5 * 65 + 0.5 * 2). Episode 1: 3 + 0.9 (0.5 * 60 + 0.5 * 116.995)."""
    _, _, target = loss_of(script, ongoing="zero", td_lambda=0.5)
    torch.testing.assert_close(target, torch.tensor([28.135, 2.0, 82.64775, 116.995, 12.0]))


@with_mixer
@pytest.mark.parametrize("mask_ongoing", [True, False])
def test_what_busy_agents_add_with_the_mixers(script, mask_ongoing):
    """With the scripts' own mixers at random weights, on the batch made by hand.

    detach: the loss and the free agents' gradients are those of "update", a busy agent has none. zero: they are those
    of "update" with zeros in place of the busy agents' utilities, online and target, whatever these were.
    """
    torch.manual_seed(0)
    task = SimpleNamespace(n_agents=2, n_actions=[2, 2], state_size=1, own_actions=np.ones((2, 2), bool))
    task.obs_sizes = [1, 1]
    settings = dict(mask_ongoing=mask_ongoing) if script is avf_qplex else {}
    learner = script.make_learner(script.Args(**settings), task)
    target = script.make_learner(script.Args(**settings), task)
    free = hand_made_batch()["free"][..., None]

    def run(ongoing, utilities=ONLINE, target_utilities=TARGET):
        utilities = utilities.clone().requires_grad_()
        args = script.Args(ongoing=ongoing, **settings)
        mixers = learner["mixer"], target["mixer"]
        loss, _, targets = script.td_loss(utilities, target_utilities, *mixers, hand_made_batch(), args)
        loss.backward()
        return loss, targets, utilities.grad

    loss, targets, gradient = run("update")
    assert all(gradient[place] != 0 for place in BUSY)
    detached = run("detach")
    torch.testing.assert_close(detached, (loss, targets, torch.where(free, gradient, 0.0)))
    without = run("update", torch.where(free, ONLINE, 0.0), torch.where(free, TARGET, 0.0))
    for change in (0.0, 100.0):
        zero = run("zero", torch.where(free, ONLINE, ONLINE + change), torch.where(free, TARGET, TARGET - change))
        torch.testing.assert_close(zero, (*without[:2], torch.where(free, without[2], 0.0)))


# ---- training -----------------------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize(
    ("script", "env_id", "options"),
    [
        (avf_vdn, "ct-10", {}),
        (avf_vdn, "wtd-s", dict(ongoing="detach")),
        (avf_vdn, "wtd-s", dict(ongoing="zero")),
        (avf_vdn, "ct-10-onestep", {}),
        (avf_vdn, "bp-10-primitive", dict(hysteresis=0.5, td_lambda=0.0)),
        (avf_qmix, "ct-10", {}),
        (avf_qmix, "wtd-s-primitive", {}),
        (avf_qmix, "wtd-s", dict(ongoing="detach")),
        (avf_qmix, "wtd-s", dict(ongoing="zero", mixer_state="decision")),
        *((avf_qmix, "bp-10", dict(mixer_state=kind)) for kind in MIXER_STATES),
        *((avf_qplex, "bp-10", dict(mixer_state=kind)) for kind in MIXER_STATES if kind != "joint"),
        (avf_qplex, "wtd-s", dict(ongoing="detach")),
        (avf_qplex, "wtd-s", dict(ongoing="zero")),
        (avf_qplex, "wtd-s", dict(mask_ongoing=False)),
    ],
)
def test_smoke_run_takes_gradient_steps(tmp_path, monkeypatch, script, env_id, options):
    """The settings reach the loss and the mixer."""
    call = smoke(tmp_path, monkeypatch, script, env_id, **options)
    for name, value in options.items():
        assert getattr(call.args, name) == value
    if script is avf_qplex:
        assert call.mixer.mask_ongoing == call.target_mixer.mask_ongoing == call.args.mask_ongoing


def test_settings_differ_by_the_mixer_only():
    fields = {s: {f.name for f in dataclasses.fields(s.Args)} for s in (avf_vdn, avf_qmix, avf_qplex)}
    assert fields[avf_qmix] - fields[avf_vdn] == {"mixer_state"} and fields[avf_vdn] < fields[avf_qmix]
    assert fields[avf_qplex] - fields[avf_qmix] == {"mask_ongoing"} and fields[avf_qmix] < fields[avf_qplex]
