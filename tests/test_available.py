"""Macro-actions that an agent cannot always start: initiation sets in the step contract and in all six scripts.

The task of these tests is an orchard. Who does not respect what is available is stopped by an error of the environment,
or learns of fruit that nobody can take.
"""

import numpy as np
import pytest
import torch

import avf_qmix
import avf_qplex
import avf_vdn
import cen_maddrqn
import dec_maddrqn
import envs
import mac_iaicc
from tests.curves import scalars
from tests.rollouts import Spy, check_rows, expected_rows, play

Q_LEARNERS = [avf_vdn, avf_qmix, avf_qplex, dec_maddrqn, cen_maddrqn]
every_q_learner = pytest.mark.parametrize("script", Q_LEARNERS, ids=lambda script: script.ALGORITHM)
every_script = pytest.mark.parametrize("script", [*Q_LEARNERS, mac_iaicc], ids=lambda script: script.ALGORITHM)

TAKE, WAIT, NAP = 0, 1, 2
DURATION = np.array([[2, 1, 5], [3, 1, 0]])  # of each agent's macro-actions; agent 1 never naps


class Orchard(envs.MacroVectorEnv):
    """Fruit is ripe at every fourth step of a day of seven, and only then can an agent start to take some.

    Taking pays 2 when it ends, a nap pays 0.5 and waiting nothing. So the team earns 8 a day if both agents take fruit
    whenever it is ripe and wait in between. A nap is always possible, but who naps then misses the next ripe fruit.
    """

    sim_arrays = ("left",)

    def __init__(self, num_envs=1, render_mode=None):
        names = [["take", "wait", "nap"], ["take", "wait"]]
        super().__init__(num_envs, names, np.zeros((2, 7)), np.ones((2, 7)), (7, 7), 7, 7, render_mode)
        self.left = np.zeros((num_envs, 2), int)  # steps until each agent's macro-action ends

    def _reset(self, mask):
        self.left[mask] = 0

    def _can_start(self):
        can_start = np.ones(self.available.shape, bool)
        can_start[:, :, TAKE] = (self.elapsed % 4 == 0)[:, None]
        return can_start

    def _advance(self):
        self.left = np.where(self.macro_done, DURATION[[0, 1], self.macro_action], self.left) - 1
        ended = self.left == 0
        pay = np.array([2.0, 0.0, 0.5])[self.macro_action]
        return (pay * ended).sum(1), self.elapsed == 7, ended, np.zeros(self.num_envs, bool)

    def _observe(self, start):
        return np.repeat(self._state()[:, None], 2, axis=1)

    def _state(self):
        return np.eye(8, 7, dtype=np.float32)[self.elapsed]

    def _draw(self, index):
        raise NotImplementedError


BEST_RETURN = 8.0


@pytest.fixture(autouse=True)
def orchard(monkeypatch):
    """Makes the task known."""
    monkeypatch.setitem(envs._TASKS, "orchard", (Orchard, {}, {}))


# ---- the step contract --------------------------------------------------------------------------------------------


def test_infos_tell_what_is_available():
    """A free agent's row is its initiation set, a busy agent's the macro-action that it runs; worked out by hand."""
    env = envs.make("orchard", 2)
    _, infos = env.reset(seed=0)
    both = [[True, True, True], [True, True, False]]
    unripe = [[False, True, True], [False, True, False]]
    assert infos["available"].tolist() == [both, both]
    _, _, _, _, infos = env.step(np.array([[TAKE, WAIT], [WAIT, TAKE]]))  # now it is step 1
    busy = [True, False, False]
    assert infos["available"].tolist() == [[busy, unripe[1]], [unripe[0], busy]]
    _, _, _, _, infos = env.step(np.array([[-1, WAIT], [NAP, -1]]))  # busy agents may be given anything
    assert infos["macro_done"].tolist() == [[True, True], [False, False]]
    assert infos["available"].tolist() == [unripe, [[False, False, True], busy]]
    _, _, _, _, infos = env.step(np.array([[WAIT, WAIT], [-1, -1]]))
    _, _, _, _, infos = env.step(np.array([[WAIT, WAIT], [-1, WAIT]]))  # now it is step 4
    assert infos["available"].tolist() == [both, [[False, False, True], both[1]]]
    kept = infos["available"].copy()
    _, infos = env.reset(options={"reset_mask": np.array([False, True])})
    assert infos["available"].tolist() == [both, both]
    np.testing.assert_array_equal(kept[0], infos["available"][0])


def test_what_cannot_be_started_is_refused():
    """A busy agent may be given anything, a free one only what it can start. The message says what that is."""
    env = envs.make("orchard", 2)
    env.reset(seed=0)
    env.step(np.array([[WAIT, TAKE], [WAIT, TAKE]]))
    given = np.array([[WAIT, TAKE], [TAKE, TAKE]])
    message = r"agent 0 of environment 1 was given macro-action 0: take is not available, it can start \[1, 2\]"
    with pytest.raises(ValueError, match=message):
        env.step(given)
    for outside in (-1, 3, 99):
        with pytest.raises(ValueError, match=rf"agent 0 .* was given macro-action {outside}: it has 0\.\.2"):
            env.step(np.array([[WAIT, TAKE], [outside, TAKE]]))
    assert env.elapsed.tolist() == [1, 1], "a step that was refused has not been taken"
    env.reset(seed=0)
    with pytest.raises(ValueError, match=r"agent 1 .* was given macro-action 2: it has 0\.\.1"):
        env.step(np.array([[NAP, NAP], [NAP, TAKE]]))


def test_a_free_agent_must_be_able_to_start_something(monkeypatch):
    """A busy agent needs no initiation set, and neither does an agent whose episode is over."""
    env = envs.make("orchard", 2)

    def only_when_ripe(self):
        return np.ones((2, 2, 3), bool) & (self.elapsed % 4 == 0)[:, None, None]

    env.reset(seed=0)
    monkeypatch.setattr(Orchard, "_can_start", only_when_ripe)
    with pytest.raises(ValueError, match="agent 1 of environment 0 is free, but its initiation set is empty"):
        env.step(np.array([[TAKE, WAIT], [TAKE, TAKE]]))

    def never_at_the_end(self):
        return np.ones((2, 2, 3), bool) & (self.elapsed < 7)[:, None, None]

    monkeypatch.setattr(Orchard, "_can_start", never_at_the_end)
    env.reset(seed=0)
    for _ in range(7):
        _, _, terminations, _, infos = env.step(np.full((2, 2), WAIT))
    assert terminations.all() and (infos["available"] == env.own_actions).all()


def test_a_saved_state_knows_what_is_available():
    env = envs.make("orchard", 3)
    rng = np.random.default_rng(0)
    env.reset(seed=0)
    for _ in range(3):
        actions = np.where(env.available, rng.random(env.available.shape), -1.0).argmax(2)
        _, _, _, _, infos = env.step(actions)
    assert not infos["macro_done"].all() and infos["macro_done"].any()
    other = envs.make("orchard", 3)
    _, loaded = other.load_state(env.save_state())
    np.testing.assert_array_equal(loaded["available"], infos["available"])
    np.testing.assert_array_equal(other.available, infos["available"])


# ---- acting -------------------------------------------------------------------------------------------------------


def random_infos(rng, n_envs=3_000):
    """Infos of environments in which each agent is free or busy, and free ones can start some of what they have."""
    env = envs.make("orchard")
    can_start = env.own_actions & (rng.random((n_envs, 2, 3)) < 0.5)
    can_start[..., WAIT] |= ~can_start.any(2)
    running = rng.integers(0, env.n_actions, (n_envs, 2))
    free = rng.random((n_envs, 2)) < 0.7
    available = np.where(free[..., None], can_start, np.eye(3, dtype=bool)[running])
    return {"macro_done": free, "macro_action": running, "available": available}


def tempted(script, learner, infos, rng, monkeypatch):
    """Lets the network say random values, absurdly high ones for what is not available. Returns the values' table.

    For the team's network this is [N, J], for the others [N, n, A].
    """
    if script is cen_maddrqn:
        parts = learner["agents"].parts.numpy()  # [J, 2]
        available = infos["available"][:, [0, 1], parts].all(2)  # [N, J]
    else:
        available = infos["available"]
    values = np.where(available, rng.standard_normal(available.shape), 1e6)
    said = torch.from_numpy(values).float()
    said = said[:, None] if script is cen_maddrqn else said.transpose(0, 1)[:, :, None]
    monkeypatch.setattr(learner["agents"], "forward", lambda *inputs: (said, inputs[-1]))
    return np.where(available, values, -np.inf)


@every_script
def test_greedy_choices_are_the_best_of_what_is_available(monkeypatch, script):
    rng = np.random.default_rng(0)
    infos = random_infos(rng)
    learner = script.make_learner(script.Args(env="orchard"), envs.make("orchard"))
    values = tempted(script, learner, infos, rng, monkeypatch)
    hidden = learner["agents"].start(len(values))
    actions, _ = script.act(learner["agents"], np.zeros((len(values), 2, 7), np.float32), infos, hidden)
    best = values.argmax(-1)
    if script is cen_maddrqn:
        best = learner["agents"].parts.numpy()[best]
    np.testing.assert_array_equal(actions, best)


@every_script
@pytest.mark.parametrize("epsilon", [0.5, 1.0])
def test_random_choices_are_uniform_over_what_is_available(monkeypatch, script, epsilon):
    """With epsilon 1, how often a macro-action is chosen is the sum of 1 / (number available) over the free agents."""
    rng = np.random.default_rng(0)
    infos = random_infos(rng)
    learner = script.make_learner(script.Args(env="orchard"), envs.make("orchard"))
    tempted(script, learner, infos, rng, monkeypatch)
    hidden = learner["agents"].start(3_000)
    obs = np.zeros((3_000, 2, 7), np.float32)
    actions, _ = script.act(learner["agents"], obs, infos, hidden, epsilon, rng)
    chosen = np.eye(3, dtype=bool)[actions]
    free = infos["macro_done"]
    available = infos["available"]
    assert not (chosen & ~available).any()
    np.testing.assert_array_equal(actions[~free], infos["macro_action"][~free])
    if epsilon == 1:
        share = available / available.sum(2, keepdims=True)
        for agent in range(2):
            counts = chosen[free[:, agent], agent].sum(0)
            expected = share[free[:, agent], agent].sum(0)
            np.testing.assert_allclose(counts, expected, atol=5 * np.sqrt(expected.max()))


# ---- learning -----------------------------------------------------------------------------------------------------


def test_rows_tell_what_was_available():
    """The stored rows are those worked out from the log, and all choices in them were available."""
    _, _, buffer, ended = play(avf_qplex, "orchard", 6, epsilon=1.0)
    for stored, episode in zip(buffer.ended, ended, strict=True):
        check_rows(stored, expected_rows(episode, 0.9))
    rows = np.concatenate([episode[:-1] for episode in buffer.ended])
    assert np.take_along_axis(rows["available"], rows["action"][..., None], 2).all()
    free = np.concatenate([episode["since"][:-1] == np.arange(len(episode) - 1)[:, None] for episode in buffer.ended])
    unripe = free & ~rows["available"][..., TAKE]
    assert 0.2 < unripe.mean() < 0.8 and (rows["available"][~free].sum(1) == 1).all()


def loss_and_targets(script, learner, target, batch, args, tempting):
    """Loss, targets and gradient by the networks' output, where what is unavailable is raised by `tempting`."""
    networks = learner["agents"], target["agents"]
    if script is cen_maddrqn:
        available = learner["agents"].all_available(batch["available"])
        values = [script.values_at_rows(network, batch) for network in networks]
    else:
        available = batch["available"]
        values = [script.utilities_at_rows(network, batch) for network in networks]
    online, evaluated = (torch.where(available, v.detach(), v.detach() + tempting) for v in values)
    online.requires_grad_()
    if script is dec_maddrqn:
        loss, _, targets = script.own_loss(online, evaluated, batch, args)
    elif script is cen_maddrqn:
        loss, _, targets = script.td_loss(online, evaluated, learner["agents"], batch, args)
    elif script is avf_vdn:
        loss, _, targets = script.td_loss(online, evaluated, batch, args)
    else:
        loss, _, targets = script.td_loss(online, evaluated, learner["mixer"], target["mixer"], batch, args)
    loss.backward()
    return loss, targets, online.grad


@every_q_learner
@pytest.mark.parametrize("td_lambda", [0.0, 0.8])
def test_nothing_unavailable_is_bootstrapped_from(script, td_lambda):
    """What is not available may be worth anything: neither loss, targets nor gradients change.

    Here the episodes count as truncated, so that they bootstrap from their final rows, where no fruit is ripe.
    """
    env, _, buffer, _ = play(avf_qplex, "orchard", 6, epsilon=1.0)  # its rows have all that any script reads
    batch = avf_qplex.make_batch(list(buffer.ended))
    batch["discount"][batch["discount"] == 0] = 0.9
    assert not batch["available"][:, -1, :, TAKE].any() and not batch["available"].all()
    args = script.Args(env="orchard", hidden_size=8, td_lambda=td_lambda)
    learner = script.make_learner(args, env)
    target = script.make_learner(args, env)
    plain = loss_and_targets(script, learner, target, batch, args, 0.0)
    for tempting in (1e3, -1e3):
        torch.testing.assert_close(loss_and_targets(script, learner, target, batch, args, tempting), plain)


def test_a_policy_gives_nothing_to_what_is_unavailable():
    """Neither its softmax nor its uniform share, whatever the logits; and the entropy and its gradient stay finite."""
    torch.manual_seed(0)
    available = torch.from_numpy(random_infos(np.random.default_rng(0), 200)["available"])
    logits = torch.randn(200, 2, 3)
    plain = mac_iaicc.soft_policy(logits, available, 0.25)
    tempting = torch.where(available, logits, 1e6).requires_grad_()
    policy = mac_iaicc.soft_policy(tempting, available, 0.25)
    torch.testing.assert_close(policy, plain)
    torch.testing.assert_close(policy.sum(-1), torch.ones(200, 2))
    assert not policy[~available].any()
    assert (policy[available] >= 0.25 / 3 - 1e-6).all()
    entropy = -(policy * policy.clamp(min=1e-8).log()).sum()
    entropy.backward()
    assert tempting.grad.isfinite().all() and not tempting.grad[~available].any()


@pytest.mark.slow
@every_script
def test_every_script_takes_all_the_fruit(monkeypatch, tmp_path, script):
    """The team earns all that can be earned, and no batch has a choice that was not available."""
    batches = Spy(monkeypatch, script, "make_batch")
    settings = dict(num_envs=8, hidden_size=32, eval_episodes=1, reward_scale=0.2, gamma=0.97, eval_frequency=1_200)
    if script is mac_iaicc:
        settings |= dict(total_timesteps=6_000, exploration_timesteps=4_000, start_e=1.0, batch_size=16)
        settings |= dict(learning_rate=0.01)
    else:
        settings |= dict(total_timesteps=4_800, learning_starts=400, exploration_timesteps=2_000, learning_rate=0.005)
        settings |= dict(train_frequency=20, polyak=0.95)
    folder = script.train(script.Args(env="orchard", runs_dir=str(tmp_path), **settings))
    assert scalars(folder)["eval/return"][-1][1] == BEST_RETURN
    for batch in batches.results:
        chosen = batch["available"].gather(3, batch["action"][..., None])
        assert chosen[batch["valid"]].all()
