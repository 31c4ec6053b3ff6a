"""Dec-MADDRQN, Cen-MADDRQN, Mac-IAICC: what they do not share with AVF-QPLEX, whose tests cover the shared blocks."""

import copy
from functools import cache
from itertools import pairwise, product
from math import log
from types import SimpleNamespace
from typing import NamedTuple

import numpy as np
import pytest
import torch
from PIL import Image

import avf_qmix
import avf_vdn
import cen_maddrqn
import dec_maddrqn
import envs
import mac_iaicc
from tests.curves import scalars
from tests.test_avf_qplex import TINY

SCRIPTS = [dec_maddrqn, cen_maddrqn, mac_iaicc]
torch.set_num_threads(1)  # fastest for networks of this size


class Row(NamedTuple):
    """What is known of an environment before a step, and that step: of the final one only the first four."""

    obs: np.ndarray
    state: np.ndarray
    free: np.ndarray
    before: np.ndarray  # infos["macro_action"], what runs or ran last
    actions: np.ndarray | None = None
    reward: float = 0.0
    hidden: torch.Tensor | None = None  # after choosing


class Episode(NamedTuple):
    steps: list
    final: Row
    terminated: bool

    def starts(self):
        """The steps of its decision rows, and its length, where the row of the final observation stands."""
        return [t for t, step in enumerate(self.steps) if step.free.any()] + [len(self.steps)]

    def row(self, t):
        return self.steps[t] if t < len(self.steps) else self.final

    def own_reward(self, t, until, gamma):
        """Sum of gamma^(s - t) r_s over the steps from t until another one."""
        return sum(gamma**s * step.reward for s, step in enumerate(self.steps[t:until]))


@cache  # no test changes what it returns for good
def play(script, env_id, episodes, num_envs=3, gamma=0.9, epsilon=0.7, terminal=False, **options):
    """Plays with a script's random networks into its buffer; returns env, learner, buffer and the episodes, in the
    order in which they ended and are stored. terminal: the ends in environment 0 count as terminal."""
    torch.manual_seed(0)
    env, rng = envs.make(env_id, num_envs), np.random.default_rng(0)
    room = {"batch_size": episodes} if script is mac_iaicc else {"buffer_size": episodes + num_envs}
    learner, buffer = script.make_learner(script.Args(env=env_id, gamma=gamma, hidden_size=8, **room, **options), env)
    obs, infos = env.reset(seed=0)
    hidden = learner["agents"].start(num_envs)
    running, ended = [[] for _ in range(num_envs)], []
    while len(ended) < episodes:
        actions, moved = script.act(learner["agents"], obs, infos, hidden, epsilon, rng)
        before = obs, infos["state"], infos["macro_done"], infos["macro_action"], actions
        buffer.decide(infos["macro_done"], obs, actions, infos["state"], hidden)
        obs, rewards, terminations, truncations, infos = env.step(actions)
        buffer.reward(rewards, before[1])
        for e in range(num_envs):
            running[e].append(Row(*(x[e] for x in before), rewards[e], moved[:, e].clone()))
        hidden, over = moved, terminations | truncations
        if over.any():
            terminations[0] |= terminal and over[0]
            buffer.finish(over, terminations, obs, infos["state"], hidden)
            for e in np.flatnonzero(over):
                final = Row(obs[e], infos["state"][e], infos["macro_done"][e], infos["macro_action"][e])
                ended.append(Episode(running[e], final, bool(terminations[e])))
                running[e] = []
            obs, infos = env.reset(options={"reset_mask": over})
            hidden[:, over] = 0.0
    return env, learner, buffer, ended


def random_windows(buffer, count, window, seed=0):
    """Episodes and first rows anywhere, so that some windows are cut short by their episode's end; and the batch."""
    rng = np.random.default_rng(seed)
    episode = rng.integers(buffer.size, size=count)
    start = rng.integers(buffer.data["rows"][episode] - 1)
    start[:3] = buffer.data["rows"][episode[:3]] - 2 - np.arange(3)  # the last one to three rows of an episode
    return episode, start, buffer.windows(episode, start, window)


def whole_episodes(buffer, count):
    return buffer.windows(np.arange(count), np.zeros(count, int), buffer.data["latest"].shape[1])


# The example by hand: gamma = 1/2, two agents with two macro-actions each.
#
# t        0     1     2     3     4     5     6 (end)
# reward   8     4     2     6    10     4
# agent 0  1                 0                              rewards 8 + 4/2 + 2/4 = 10.5 and 6 + 10/2 + 4/4 = 12
# agent 1  0     1                 0                        rewards 8, 4 + 2/2 + 6/4 = 6.5 and 10 + 4/2 = 12
# row      0     1           2     3           4 (final)    rewards 8, 4 + 2/2 = 5, 6 and 10 + 4/2 = 12
#
# A second episode of a single step, reward 3: agent 0 chooses 0, agent 1 chooses 1.
PLAN, REWARDS = ({0: 1, 3: 0}, {0: 0, 1: 1, 4: 0}), (8, 4, 2, 6, 10, 4)


def by_hand(script, terminated=False, plan=PLAN, **options):
    """A script's learner and its buffer with the example's two episodes; an agent's observation is (episode, step)."""
    torch.manual_seed(0)
    space = SimpleNamespace(shape=(2, 2))
    env = SimpleNamespace(num_envs=1, n_agents=2, n_actions=[2, 2], horizon=6, state_size=1)
    env.single_observation_space = space
    learner, buffer = script.make_learner(script.Args(gamma=0.5, hidden_size=8, **options), env)
    state, hidden = np.zeros((1, 1), np.float32), torch.zeros(2, 1, 0)
    for episode, (choices, rewards) in enumerate(((plan, REWARDS), (({0: 0}, {0: 1}), (3,)))):
        obs, actions = np.zeros((1, 2, 2), np.float32), np.zeros((1, 2), int)
        for t, reward in enumerate(rewards):
            free = np.array([[t in own for own in choices]])
            for i, own in enumerate(choices):
                if t in own:
                    obs[0, i], actions[0, i] = (episode, t), own[t]
            buffer.decide(free, obs, actions, state, hidden)
            buffer.reward(np.array([float(reward)]), state)
        obs[:] = episode, len(rewards)
        buffer.finish(np.array([True]), np.array([terminated]), obs, state, hidden)
    return learner, buffer


def table(obs, values):
    """Utilities [agents, entries, 2] of values[agent][episode, step]; -90 where the example never looks."""
    found = [[values[i].get(tuple(o), (-90.0, -90.0)) for o in own] for i, own in enumerate(obs.int().tolist())]
    return torch.tensor(found)


ONLINE = ({(0, 0): (1.0, 5.0), (0, 3): (18.0, 19.0), (0, 6): (7.0, 1.0), (1, 0): (6.0, 0.0), (1, 1): (0.0, 3.0)},
          {(0, 0): (12.0, 1.0), (0, 1): (3.0, 2.0), (0, 4): (1.0, 30.0), (0, 6): (0.0, 1.0), (1, 0): (0.0, 2.0),
           (1, 1): (5.0, 1.0)})  # fmt: skip
TARGET = ({(0, 3): (90.0, 24.0), (0, 6): (32.0, 90.0), (1, 1): (90.0, 8.0)},
          {(0, 1): (4.0, 90.0), (0, 4): (90.0, 40.0), (0, 6): (90.0, 20.0), (1, 1): (6.0, 90.0)})  # fmt: skip


def stub(values):
    """In the place of the agents' networks."""
    return lambda obs, previous, hidden, sizes: (table(obs, values), None, None)


# ---- Dec-MADDRQN --------------------------------------------------------------------------------------------------


def own_loss_by_hand(batch, **options):
    online = table(batch.obs, ONLINE)
    best = online.argmax(2)[torch.arange(2), batch.next_entry]
    return dec_maddrqn.own_loss(online, table(batch.obs, TARGET), best, batch, **options)


OWN = [[True, True], [False, True], [True, False], [False, True], [True, True]]


def test_dec_returns_by_hand():
    """r_i + gamma^tau_i Q'_i at the online argmax; the last row is the second episode's.

    Agent 0: 10.5 + 24/8 = 13.5 at row 0, 12 + 32/8 = 16 at row 2, 3 + 8/2 = 7. Values 5, 18, 6, errors 8.5, -2, 1.
    Agent 1: 8 + 4/2 = 10, 6.5 + 40/8 = 11.5, 12 + 20/4 = 17, 3 + 6/2 = 6. Values 12, 2, 1, 2, errors -2, 9.5, 16, 4.
    """
    _, buffer = by_hand(dec_maddrqn)
    batch = whole_episodes(buffer, 2)
    loss, q, returns, own = own_loss_by_hand(batch)
    assert own.tolist() == OWN
    assert returns.T[own.T].tolist() == [13.5, 16.0, 7.0, 10.0, 11.5, 17.0, 6.0]
    assert q.T[own.T].tolist() == [5.0, 18.0, 6.0, 12.0, 2.0, 1.0, 2.0]
    # means over an agent's own transitions, 3 and 4, summed: (72.25 + 4 + 1) / 3 + (4 + 90.25 + 256 + 16) / 4
    assert loss.item() == pytest.approx(77.25 / 3 + 366.25 / 4)
    # the one negative error of each agent is halved
    loss, *_ = own_loss_by_hand(batch, hysteresis=0.5)
    assert loss.item() == pytest.approx(74.25 / 3 + 363.25 / 4)


def test_dec_bootstraps_from_a_truncated_end_only():
    """Terminated: 12 at agent 0's row 2, 12 at agent 1's row 3, 3 in the short episode; what is before is as it was."""
    _, buffer = by_hand(dec_maddrqn, terminated=True)
    _, _, returns, own = own_loss_by_hand(whole_episodes(buffer, 2))
    assert own.tolist() == OWN
    assert returns.T[own.T].tolist() == [13.5, 12.0, 3.0, 10.0, 11.5, 12.0, 3.0]


@pytest.mark.parametrize("td_lambda", [0.0, 0.5])
def test_dec_leaves_out_what_a_window_cuts(td_lambda):
    """Rows 0 to 2: the macro-actions of row 2 (agent 0) and row 3 (agent 1) do not end in the window.
    Rows 1 and 2: agent 0's first began before it, its second ends after it.

    lambda = 1/2 in the first: agent 0 keeps 13.5, and agent 1 11.5 at row 1, as no further return is known; at row 0
    it has 8 + (4 + 11.5) / 2 / 2 = 11.875.
    """
    _, buffer = by_hand(dec_maddrqn)
    _, _, returns, own = own_loss_by_hand(buffer.windows(np.array([0]), np.array([0]), 3), td_lambda=td_lambda)
    assert own.tolist() == [[True, True], [False, True], [False, False]]
    assert returns.T[own.T].tolist() == [13.5, 11.875 if td_lambda else 10.0, 11.5]
    loss, _, returns, own = own_loss_by_hand(buffer.windows(np.array([0]), np.array([1]), 2), td_lambda=td_lambda)
    assert own.tolist() == [[False, True], [False, False]] and returns[own].tolist() == [11.5]
    assert loss.item() == pytest.approx(9.5**2), "an agent without transitions adds nothing"


def test_dec_lambda_returns_by_hand():
    """lambda = 1/2. Agent 0: 16 at row 2, 10.5 + (24 + 16) / 2 / 8 = 13 at row 0.
    Agent 1: 17 at row 3, 6.5 + (40 + 17) / 2 / 8 = 10.0625 at row 1, 8 + (4 + 10.0625) / 2 / 2 = 11.515625 at row 0."""
    _, buffer = by_hand(dec_maddrqn)
    _, _, returns, own = own_loss_by_hand(whole_episodes(buffer, 2), td_lambda=0.5)
    assert returns.T[own.T].tolist() == [13.0, 16.0, 7.0, 11.515625, 10.0625, 17.0, 6.0]


@pytest.mark.parametrize("env_id", ["wtd-s", "ct-10", "bp-10"])
def test_dec_returns_are_those_of_the_primitive_rewards(env_id):
    """Real play, random windows: each agent's sum over its own steps, whatever the others do in between."""
    gamma, window = 0.9, 9
    env, _, buffer, ended = play(dec_maddrqn, env_id, 8)
    episodes, first, batch = random_windows(buffer, 40, window)
    bootstrap = 10 * torch.randn(len(batch.reward), env.n_agents)
    returns, own = (x.numpy() for x in dec_maddrqn.own_returns(batch, bootstrap))
    offset, several, cut, at_end, terminal = 0, 0, 0, 0, 0
    for number, begin in zip(episodes, first, strict=True):
        episode, starts = ended[number], ended[number].starts()
        end = min(begin + window, len(starts) - 1)  # the row after the window
        for k, i in product(range(begin, end), range(env.n_agents)):
            row = offset + k - begin
            later = [j for j in range(k + 1, end + 1) if episode.row(starts[j]).free[i]]
            chose = episode.steps[starts[k]].free[i]
            assert own[row, i] == (chose and bool(later))
            cut += chose and not later
            if not own[row, i]:
                continue
            t, until = starts[k], starts[later[0]]
            over = until == len(episode.steps)
            expected = episode.own_reward(t, until, gamma)
            if not (over and episode.terminated):
                expected += gamma ** (until - t) * bootstrap[offset + later[0] - 1 - begin, i].item()
            assert abs(returns[row, i] - expected) < 1e-4 + 1e-4 * abs(expected)
            several, at_end, terminal = (
                several + (later[0] > k + 1),
                at_end + over,
                terminal + (over and episode.terminated),
            )
        offset += end - begin
    assert offset == len(batch.reward) and several > 20 and cut > 5 and at_end > 3
    assert terminal > 3 or env_id != "bp-10", "random play reaches the goal there"


@pytest.mark.parametrize("td_lambda", [0.0, 0.5])
def test_dec_return_does_not_change_when_another_agent_splits_a_macro_action(td_lambda):
    """Agent 1's macro-action of steps 1 to 3 against one of step 1 and one of steps 2 and 3, the same rewards: one more
    row, but agent 0's returns, and the gradients of its network, are what they were."""
    found = []
    for plan in (PLAN, (PLAN[0], {0: 0, 1: 1, 2: 1, 4: 0})):
        learner, buffer = by_hand(dec_maddrqn, plan=plan)
        target = copy.deepcopy(learner)
        with torch.no_grad():
            for parameter in target.parameters():
                parameter.add_(torch.randn_like(parameter))
        batch = whole_episodes(buffer, 2)
        dec_maddrqn.batch_loss(learner, target, batch, td_lambda, 0.4)[0].backward()
        gradients = [parameter.grad for parameter in learner["agents"].parameters()]
        _, _, returns, own = own_loss_by_hand(batch, td_lambda=td_lambda)
        found.append((len(batch.reward), returns[:, 0][own[:, 0]], gradients))
    (rows, returns, gradients), (more_rows, same_returns, same_gradients) = found
    assert more_rows == rows + 1
    assert returns.tolist() == same_returns.tolist() == [13.0 if td_lambda else 13.5, 16.0, 7.0]
    for one, other in zip(gradients, same_gradients, strict=True):
        torch.testing.assert_close(one[0], other[0])
        assert one[0].any() and not torch.allclose(one[1], other[1])


class Table(torch.nn.Module):
    """In the place of the team's last layer: fixed utilities, [rows, 4]."""

    def __init__(self, rows):
        super().__init__()
        self.rows = torch.tensor([rows])

    def forward(self, x):
        return self.rows


# Rows 0 to 4 of the first episode; columns are the joint macro-actions 00, 01, 10, 11.
TEAM = [[5.0, 1.0, 3.0, 2.0], [90.0, 80.0, 1.0, 6.0], [90.0, 7.0, 80.0, 2.0], [4.0, 5.0, 90.0, 80.0],
        [1.0, 2.0, 9.0, 3.0]]  # fmt: skip
TARGET_TEAM = [[99.0] * 4, [99.0, 99.0, 99.0, 10.0], [99.0, -4.0, 99.0, 99.0], [99.0, 4.0, 99.0, 99.0],
               [99.0, 99.0, 12.0, 99.0]]  # fmt: skip


def test_dec_centralized_choice_by_hand():
    """The best joint macro-action among those that leave ongoing ones as they are, agent by agent.

    Row 1: agent 0 runs 1, so 10 (1) or 11 (6): agent 1 is valued with 1 there, 4. Row 2: agent 1 runs 1, so 01 (7) or
    11 (2): agent 0 is valued with 0, 16. Row 3: agent 0 runs 0, so 00 (4) or 01 (5): agent 1 with 1, 40. Row 4: all are
    free, 10 (9): agent 0 with 1, 32, agent 1 with 0, 20. The agents' own networks would choose otherwise (90).

    Agent 0: 10.5 + 16/8 = 12.5 and 12 + 32/8 = 16, values 5 and 18: errors 7.5 and -2.
    Agent 1: 10, 11.5 and 17 as above, values 12, 2 and 1: errors -2, 9.5 and 16.
    Team: 8 + 10/2 = 13, 5 - 4/4 = 4, 6 + 4/2 = 8, 12 + 12/4 = 15, values 3, 6, 7, 4: errors 10, -2, 1, 11.
    """
    target_q = (
        {(0, 3): (16.0, 90.0), (0, 6): (90.0, 32.0)},
        {(0, 1): (90.0, 4.0), (0, 4): (90.0, 40.0), (0, 6): (20.0, 90.0)},
    )
    learner, buffer = by_hand(dec_maddrqn, double_q="centralized")
    batch, target = whole_episodes(buffer, 1), copy.deepcopy(learner)
    learner["team"].output, target["team"].output = Table(TEAM), Table(TARGET_TEAM)
    learner = {"agents": stub(ONLINE), "team": learner["team"]}
    target = {"agents": stub(target_q), "team": target["team"]}
    team_loss, choice = dec_maddrqn.team_loss_and_choice(learner["team"], target["team"], batch, 1.0)
    assert choice.tolist() == [[1, 1], [0, 1], [0, 1], [1, 0]]
    assert team_loss.item() == pytest.approx((100 + 4 + 1 + 121) / 4)
    loss, _ = dec_maddrqn.batch_loss(learner, target, batch, 0.0, 1.0)
    own = (56.25 + 4) / 2 + (4 + 90.25 + 256) / 3
    assert loss.item() == pytest.approx(own + team_loss.item())
    loss, _ = dec_maddrqn.batch_loss(learner, target, batch, 0.0, 0.5)  # negative errors, of the team as well, halved
    assert loss.item() == pytest.approx((56.25 + 1) / 2 + (1 + 90.25 + 256) / 3 + (100 + 1 + 1 + 121) / 4)


@pytest.mark.parametrize("env_id", ["wtd-s", "ct-10", "bp-10"])
def test_dec_team_loss_is_that_of_cen(env_id):
    """The same team, the same episodes stored in both ways, random windows of different lengths."""
    env, _, buffer, ended = play(dec_maddrqn, env_id, 8)
    torch.manual_seed(1)
    learner, _ = cen_maddrqn.make_learner(cen_maddrqn.Args(hidden_size=8), env)
    target = copy.deepcopy(learner)
    for parameter in target.parameters():
        parameter.data.add_(0.1 * torch.randn_like(parameter))
    team_buffer = cen_maddrqn.TeamBuffer(envs.make(env_id), learner["agents"], 12, 0.9, 0)
    for episode in ended:
        for step in episode.steps:
            team_buffer.decide(step.free[None], step.obs[None], step.actions[None], step.state[None], None)
            team_buffer.reward(np.array([step.reward]), step.state[None])
        over, final = np.array([True]), episode.final
        team_buffer.finish(over, np.array([episode.terminated]), final.obs[None], final.state[None], None)
    episodes, start, batch = random_windows(buffer, 24, 7)
    team_batch = team_buffer.windows(episodes, start, 7)
    assert len(set(batch.valid.sum(1).tolist())) > 1 and batch.valid.equal(team_batch.valid)
    teams = []
    for module in (learner, target):
        team = dec_maddrqn.Team(env.n_actions, env.single_observation_space.shape[1], 8)
        team.load_state_dict(module["agents"].state_dict())
        teams.append(team)
    for hysteresis in (1.0, 0.3):
        loss, choice = dec_maddrqn.team_loss_and_choice(*teams, batch, hysteresis)
        expected, values = cen_maddrqn.batch_loss(learner, target, team_batch, 0.0, hysteresis)
        torch.testing.assert_close(loss, expected)
        assert values.isfinite().all()
    running = batch.action[torch.arange(env.n_agents), batch.next_entry]
    ongoing = ~batch.next_chosen
    assert ongoing.any() and choice[ongoing].equal(running[ongoing])


@pytest.mark.parametrize("script", [dec_maddrqn, cen_maddrqn])
def test_stored_states_reach_both_networks(script):
    _, learner, buffer, _ = play(script, "bp-10", 4, hidden_state="stored")
    _, _, batch = random_windows(buffer, 6, 4)
    assert batch.hidden.any()
    seen = []

    def spy(*history):
        seen.append(history)
        return learner["agents"](*history)

    networks = {**learner, "agents": spy}
    script.batch_loss(networks, networks, batch, 0.0, 1.0)
    assert len(seen) == 2 and all(history[0] is batch.obs and history[2] is batch.hidden for history in seen)


# ---- Cen-MADDRQN --------------------------------------------------------------------------------------------------


def test_joint_macro_actions_are_numbered_through():
    """Agents of 2, 4 and 3 macro-actions: 24 joint ones, the last agent's counting fastest, there and back."""
    team = cen_maddrqn.Team([2, 4, 3], 5, 8)
    assert team.digits.tolist() == [list(digits) for digits in product(range(2), range(4), range(3))]
    obs, free = np.random.default_rng(0).random((25, 3, 5), np.float32), np.ones((25, 3), bool)
    free[::2, 1] = False
    actions = np.vstack([team.digits, [[-1, -1, -1]]])
    team_obs, joint = team.join(obs, free, actions)
    assert joint.tolist() == [*range(24), -1], "-1 before the first"
    assert team_obs.dtype == np.float32
    np.testing.assert_array_equal(team_obs, np.concatenate([obs[:, 0], obs[:, 1], obs[:, 2], free], 1))
    inputs = team.inputs(torch.from_numpy(team_obs)[None], torch.from_numpy(joint)[None])[0, :, 18:].numpy()
    for row, digits in zip(inputs, actions, strict=True):
        blocks = np.split(row, [2, 6])
        assert [block.argmax() if block.any() else -1 for block in blocks] == digits.tolist()
        assert row.sum() == (digits[0] >= 0) * 3


@pytest.mark.parametrize("n_actions", [envs.make("ct-10").n_actions, envs.make("wtd-t1").n_actions, [2, 4, 3]])
def test_conditional_argmax_never_changes_an_ongoing_macro_action(n_actions):
    """Random networks and macro-histories, any set of free agents, everybody and only one of them included."""
    assert np.prod(n_actions) in (1_024, 875, 24)
    torch.manual_seed(0)
    n, rng = len(n_actions), np.random.default_rng(0)
    team = cen_maddrqn.Team(n_actions, 3, 16)
    free = np.vstack([np.ones((1, n), bool), np.eye(n, dtype=bool), rng.random((40, n)) < 0.5])
    free[free.sum(1) == 0, 0] = True
    obs = rng.standard_normal((len(free), n, 3)).astype(np.float32)
    running = rng.integers(n_actions, size=free.shape)
    hidden = torch.randn(1, len(free), 16)
    team_obs, joint = (torch.from_numpy(x)[None] for x in team.join(obs, free, running))
    with torch.no_grad():
        utilities, best, states = team(team_obs, joint, hidden, [len(free)])
        unmasked, _, same_states = super(cen_maddrqn.Team, team).forward(team_obs, joint, hidden, [len(free)])
    assert states.equal(same_states)
    for row, allowed in enumerate(utilities[0].isfinite().numpy()):
        kept = (team.digits == running[row])[:, ~free[row]].all(1)
        np.testing.assert_array_equal(allowed, kept)
        assert allowed.sum() == np.prod(np.array(n_actions)[free[row]])
        assert utilities[0, row, allowed].equal(unmasked[0, row, allowed])
        assert best[0, row] == unmasked[0, row, kept].max()
    # without the mask other macro-actions would often be best: the test would see it
    assert (team.digits[unmasked[0].argmax(1)] != running)[~free].any()
    infos = {"macro_done": free, "macro_action": running}
    for epsilon in (0.0, 0.5, 1.0):
        actions, moved = cen_maddrqn.act(team, obs, infos, hidden, epsilon, rng)
        np.testing.assert_array_equal(actions[~free], running[~free])
        assert (actions >= 0).all() and (actions < n_actions).all()
        assert moved.equal(states)
        if epsilon == 0:
            np.testing.assert_array_equal(actions, team.digits[utilities[0].argmax(1)])
    nobody = {"macro_done": np.zeros_like(free), "macro_action": running}
    actions, moved = cen_maddrqn.act(team, obs, nobody, hidden, 1.0, rng)
    np.testing.assert_array_equal(actions, running)
    assert moved.equal(hidden), "the team's history moves when somebody chooses"


def test_cen_explores_as_a_team():
    """With probability epsilon all free agents draw at random, otherwise none does."""
    n_actions, count, epsilon = [2, 4, 3], 20_000, 0.3
    team, rng = cen_maddrqn.Team(n_actions, 1, 4), np.random.default_rng(0)
    team.output.bias.data[0, 0, 17] = 100.0  # 1, 1, 2 is best
    obs, hidden = np.zeros((count, 3, 1), np.float32), torch.zeros(1, count, 4)
    for free in (np.array([True, True, True]), np.array([True, False, True])):
        infos = {"macro_done": np.tile(free, (count, 1)), "macro_action": np.tile([0, 1, 0], (count, 1))}
        actions, _ = cen_maddrqn.act(team, obs, infos, hidden, epsilon, rng)
        joint, shares = np.unique(actions @ team.strides, return_counts=True)
        expected = dict.fromkeys(range(24), 0.0)
        options = list(product(*(range(n) if f else [1] for n, f in zip(n_actions, free, strict=True))))
        for m in options:
            expected[m @ team.strides] = epsilon / len(options)
        expected[17] += 1 - epsilon
        assert set(joint) == {m for m, share in expected.items() if share}
        for m, share in zip(joint, shares / count, strict=True):
            assert share == pytest.approx(expected[m], abs=4 * (expected[m] / count) ** 0.5)


@pytest.mark.parametrize("terminated", [False, True])
def test_cen_target_by_hand(terminated):
    """Each row lasts until anybody chooses again: rewards 8, 5, 6, 12, after 1, 2, 1 and 2 steps.

    Targets as the team's in test_dec_centralized_choice_by_hand: 8 + 10/2 = 13, 5 - 4/4 = 4, 6 + 4/2 = 8, and the last
    12 + 12/4 = 15 or, terminated, 12. Values 3, 6, 7, 4.
    """
    learner, buffer = by_hand(cen_maddrqn, terminated)
    batch, target = whole_episodes(buffer, 1), copy.deepcopy(learner)
    assert batch.reward.tolist() == [8.0, 5.0, 6.0, 12.0]
    assert batch.discount.tolist() == [0.5, 0.25, 0.5, 0.0 if terminated else 0.25]
    learner["agents"].output, target["agents"].output = Table(TEAM), Table(TARGET_TEAM)
    last = 64 if terminated else 121
    loss, q = cen_maddrqn.batch_loss(learner, target, batch, 0.0, 1.0)
    assert q.tolist() == [3.0, 6.0, 7.0, 4.0]
    assert loss.item() == pytest.approx((100 + 4 + 1 + last) / 4)
    loss, _ = cen_maddrqn.batch_loss(learner, target, batch, 0.0, 0.5)
    assert loss.item() == pytest.approx((100 + 1 + 1 + last) / 4)


@pytest.mark.parametrize("stored", [False, True])
@pytest.mark.parametrize("env_id", ["wtd-s", "bp-10", "ct-10"])
def test_team_buffer_holds_what_the_team_saw(env_id, stored):
    """Joint observation, who is free, joint macro-action; and replayed recurrent states equal those of acting, row by
    row, from an episode's start or, where they are stored, from any row."""
    env, learner, buffer, ended = play(cen_maddrqn, env_id, 6, hidden_state="stored" if stored else "zero")
    team, n, d = learner["agents"], *env.single_observation_space.shape
    start = np.random.default_rng(0).integers(buffer.data["rows"][:6] - 1) if stored else np.zeros(6, int)
    batch = buffer.windows(np.arange(6), start, env.horizon)
    with torch.no_grad():
        _, _, states = team(batch.obs, batch.previous, batch.hidden, batch.sizes)
    row, ongoing = 0, 0
    for number, begin in enumerate(start):
        episode, starts = ended[number], ended[number].starts()
        for k, (t, until) in enumerate(pairwise(starts)):
            if k < begin:
                continue
            step, now, later = episode.steps[t], batch.entry[row, 0], batch.next_entry[row, 0]
            for entry, at in ((now, step), (later, episode.row(until))):
                obs = batch.obs[0, entry].numpy()
                np.testing.assert_array_equal(obs[: n * d].reshape(n, d), at.obs)
                np.testing.assert_array_equal(obs[n * d :], at.free)
                previous = batch.previous[0, entry].item()
                assert (team.digits[previous].tolist() if previous >= 0 else [-1] * n) == at.before.tolist()
            assert team.digits[batch.action[0, now]].tolist() == step.actions.tolist()
            reward, over = episode.own_reward(t, until, 0.9), until == len(episode.steps)
            assert batch.reward[row].item() == pytest.approx(reward, rel=1e-4, abs=1e-4)
            discount = 0.0 if over and episode.terminated else 0.9 ** (until - t)
            assert batch.discount[row].item() == pytest.approx(discount, rel=1e-4)
            torch.testing.assert_close(states[0, now], step.hidden[0])
            row, ongoing = row + 1, ongoing + (~step.free).sum()
    assert row == len(batch.reward) and ongoing > 50


@pytest.mark.parametrize("script, options", [(cen_maddrqn, {}), (dec_maddrqn, dict(double_q="centralized"))])
def test_too_many_joint_macro_actions_are_refused_in_one_line(tmp_path, script, options):
    with pytest.raises(SystemExit) as stopped:
        script.train(script.defaults("ct-10-primitive", runs_dir=str(tmp_path), **options))
    message = str(stopped.value)
    assert message.startswith(f"{script.ALGORITHM}: ") and "ct-10-primitive" in message and "\n" not in message
    assert "joint macro-actions" in message and "32,768" in message
    assert not any(tmp_path.iterdir()), "nothing was written"


# ---- Mac-IAICC ----------------------------------------------------------------------------------------------------

# V'_i at the row after each of the rows, [rows, agents]; 99 where the agent does not choose there. Last: episode two.
NEXT_VALUES = [[99.0, 4.0], [24.0, 99.0], [99.0, 40.0], [32.0, 20.0], [8.0, 6.0]]


@pytest.mark.parametrize(
    "n_step, terminated, expected",
    [
        # Agent 0: 10.5 + 24/8, 12 + 32/8, 3 + 8/2. Agent 1: 8 + 4/2, 6.5 + 40/8, 12 + 20/4, 3 + 6/2.
        (1, False, [13.5, 16.0, 7.0, 10.0, 11.5, 17.0, 6.0]),
        # 10.5 + 16/8: the episode ends after two. Agent 1: 8 + 11.5/2, 6.5 + 17/8.
        (2, False, [12.5, 16.0, 7.0, 13.75, 8.625, 17.0, 6.0]),
        # Agent 1: 8 + 8.625/2.
        (10, False, [12.5, 16.0, 7.0, 12.3125, 8.625, 17.0, 6.0]),
        # Nothing follows the last ones: 12, 3; 12, 3.
        (1, True, [13.5, 12.0, 3.0, 10.0, 11.5, 12.0, 3.0]),
        # 10.5 + 12/8; 8 + 11.5/2, 6.5 + 12/8.
        (2, True, [12.0, 12.0, 3.0, 13.75, 8.0, 12.0, 3.0]),
        # 8 + 8/2
        (10, True, [12.0, 12.0, 3.0, 12.0, 8.0, 12.0, 3.0]),
    ],
)
def test_mac_n_step_returns_by_hand(n_step, terminated, expected):
    _, buffer = by_hand(mac_iaicc, terminated)
    batch = whole_episodes(buffer, 2)
    assert batch.chosen.tolist() == OWN
    returns = mac_iaicc.own_returns(batch, torch.tensor(NEXT_VALUES), n_step)
    assert returns.T[batch.chosen.T].tolist() == expected


@pytest.mark.parametrize("env_id", ["wtd-s", "ct-10", "bp-10"])
@pytest.mark.parametrize("n_step", [1, 3, 1_000])
def test_mac_returns_are_those_of_the_primitive_rewards(env_id, n_step):
    """Real play: from the first step of a macro-action to the first after the agent's n-th."""
    gamma = 0.9
    env, _, buffer, ended = play(mac_iaicc, env_id, 8)
    batch = whole_episodes(buffer, 6)
    values = 10 * torch.randn(len(batch.reward), env.n_agents)
    returns = mac_iaicc.own_returns(batch, values, n_step).numpy()
    offset = 0
    for episode in ended[:6]:
        starts = episode.starts()
        for i in range(env.n_agents):
            own = [k for k, t in enumerate(starts) if episode.row(t).free[i]]
            for number, k in enumerate(own[:-1]):
                until = own[min(number + n_step, len(own) - 1)]
                expected = episode.own_reward(starts[k], starts[until], gamma)
                if not (episode.terminated and until == own[-1]):
                    expected += gamma ** (starts[until] - starts[k]) * values[offset + until - 1, i].item()
                assert abs(returns[offset + k, i] - expected) < 1e-4 + 1e-4 * abs(expected)
        offset += len(starts) - 1
    assert offset == len(batch.reward)


def test_mac_gradients_by_hand():
    """Softmax (3/4, 1/4) everywhere and epsilon 0.2 give the policy (0.7, 0.3), whose slope in its own logit is
    0.8 * 3/4 * 1/4 = 0.15: grad log pi(0) = 0.15 / 0.7 (1, -1), grad log pi(1) = 0.5 (-1, 1).

    Returns (n = 1) minus values: agent 0, that chose 1 and 0: 13.5 - 11.5 = 2, 16 - 20 = -4; two decisions.
    Agent 1, that chose 0, 1 and 0: 10 - 7 = 3, 11.5 - 14.5 = -3, 17 - 17 = 0; three decisions.
    """
    _, buffer = by_hand(mac_iaicc)
    batch = whole_episodes(buffer, 1)
    logits = torch.tensor([log(3), 0.0]).expand(2, len(batch.obs[0]), 2).clone().requires_grad_()
    # 1000 where an agent is ongoing: no loss there
    values = torch.tensor([[11.5, 7.0], [1e3, 14.5], [20.0, 1e3], [1e3, 17.0]], requires_grad=True)
    returns = mac_iaicc.own_returns(batch, torch.tensor(NEXT_VALUES[:4]), 1)

    def parts(coefficient):
        policy = mac_iaicc.soft_policy(logits, [2, 2], 0.2)
        return mac_iaicc.actor_critic_loss(policy, values, returns, batch, coefficient)

    loss, (actor, critic, entropy) = parts(0.0)
    steps = batch.obs[:, :, 1].int().tolist()
    assert steps == [[0, 3, 6, 0], [0, 1, 4, 6]], "agent 0 has one decision less, its last entry is padding"
    (slopes,) = torch.autograd.grad(loss, logits, retain_graph=True)
    score = [0.15 / 0.7, -0.5]  # of logit 0, macro-action 0 or 1 being taken; that of logit 1 is the opposite
    expected = torch.tensor([[-2 * score[1] / 2, 4 * score[0] / 2, 0, 0], [-3 * score[0] / 3, 3 * score[1] / 3, 0, 0]])
    torch.testing.assert_close(slopes, torch.stack([expected, -expected], 2))
    assert actor.item() == pytest.approx(-(2 * log(0.3) - 4 * log(0.7)) / 2 - (3 * log(0.7) - 3 * log(0.3)) / 3)
    assert critic.item() == pytest.approx((4 + 16) / 2 + (9 + 9) / 3) and loss.item() == pytest.approx(
        actor.item() + critic.item()
    )
    (slopes,) = torch.autograd.grad(loss, values, retain_graph=True)  # -2 (G - V) / decisions
    assert slopes.tolist() == [[-2.0, -2.0], [0.0, 2.0], [4.0, 0.0], [0.0, 0.0]]
    assert torch.autograd.grad(actor, values, allow_unused=True, retain_graph=True) == (None,)
    assert torch.autograd.grad(critic, logits, allow_unused=True) == (None,)

    # The entropy of (0.7, 0.3), subtracted: its slope in logit 0 is -0.15 log(0.7 / 0.3).
    uncertainty = -0.7 * log(0.7) - 0.3 * log(0.3)
    assert entropy.item() == pytest.approx(uncertainty)
    with_entropy, _ = parts(2.0)
    assert with_entropy.item() == pytest.approx(loss.item() - 2.0 * 2 * uncertainty)
    (slopes,) = torch.autograd.grad(with_entropy - parts(0.0)[0], logits)
    slope = 2.0 * 0.15 * log(0.7 / 0.3)
    expected = torch.tensor([[slope / 2, slope / 2, 0, 0], [slope / 3, slope / 3, slope / 3, 0]])
    torch.testing.assert_close(slopes, torch.stack([expected, -expected], 2))


def test_mac_gradients_stay_with_their_networks():
    """Actors learn from the actors' loss, critics from the critics', each agent's from its own, targets from none."""
    _, learner, buffer, _ = play(mac_iaicc, "wtd-s", 4)
    target, batch = copy.deepcopy(learner).requires_grad_(False), whole_episodes(buffer, 4)
    joint = mac_iaicc.joint_history(batch)
    logits, _, _ = learner["agents"](batch.obs, batch.previous, None, batch.sizes)
    policy = mac_iaicc.soft_policy(logits, learner["agents"].n_actions, 0.1)
    values = learner["critics"].values(joint)[:, joint.row].T
    returns = mac_iaicc.own_returns(batch, target["critics"].values(joint)[:, joint.next_row].T, 5)
    _, (actor, critic, _) = mac_iaicc.actor_critic_loss(policy, values, returns, batch, 0.0)
    for part, own, other in ((actor, "agents", "critics"), (critic, "critics", "agents")):
        learner.zero_grad()
        part.backward(retain_graph=True)
        assert all(parameter.grad is None for parameter in learner[other].parameters())
        assert all(parameter.grad.flatten(1).any(1).all() for parameter in learner[own].parameters())
    # a loss of agent 0's decisions only
    learner.zero_grad()
    only = batch._replace(chosen=batch.chosen & torch.tensor([True] + [False] * (len(batch.obs) - 1)))
    mac_iaicc.actor_critic_loss(policy, values, returns, only, 0.1)[0].backward()
    for name, parameter in learner.named_parameters():
        assert parameter.grad[0].any() and not parameter.grad[1:].any(), name


def test_soft_policy():
    """Sums to 1, leaves out padding macro-actions, and gives each other one at least epsilon / |A_i|."""
    torch.manual_seed(0)
    n_actions = [2, 4, 3]
    logits = 10 * torch.randn(3, 50, 4)
    for agent, n in enumerate(n_actions):
        logits[agent, :, n:] = -torch.inf
    for epsilon in (0.0, 0.3, 1.0):
        policy = mac_iaicc.soft_policy(logits, n_actions, epsilon)
        torch.testing.assert_close(policy.sum(2), torch.ones(3, 50))
        for agent, n in enumerate(n_actions):
            assert not policy[agent, :, n:].any()
            assert (policy[agent, :, :n] >= epsilon / n).all()
            softmax = torch.exp(logits[agent, :, :n]) / torch.exp(logits[agent, :, :n]).sum(1, keepdim=True)
            torch.testing.assert_close(policy[agent, :, :n], (1 - epsilon) * softmax + epsilon / n)


class Always:
    """Stands in for a generator: `random` gives one number."""

    def __init__(self, number):
        self.number = number

    def random(self, shape):
        return np.full(shape, self.number)


def test_mac_acting():
    """Macro-actions are drawn from the epsilon-soft policy, greedily without a generator; ongoing agents go on."""
    torch.manual_seed(0)
    count, rng = 20_000, np.random.default_rng(0)
    agents = mac_iaicc.Agents([2, 4], 3, 8)
    agents.output.weight.data[:] = 0.0
    agents.output.bias.data[:, 0] = torch.tensor([[0.5, 1.0, 99.0, 99.0], [1.0, -1.0, 2.0, 0.0]])  # 99: padding
    obs, hidden = rng.random((count, 2, 3), np.float32), torch.randn(2, count, 8)
    infos = {"macro_done": rng.random((count, 2)) < 0.7, "macro_action": np.ones((count, 2), int)}
    free = infos["macro_done"]
    actions, moved = mac_iaicc.act(agents, obs, infos, hidden, 0.2, rng)
    assert (actions[~free] == 1).all()
    np.testing.assert_array_equal((moved == hidden).all(2).T.numpy(), ~free)
    for agent, logits in enumerate(([0.5, 1.0], [1.0, -1.0, 2.0, 0.0])):
        expected = 0.8 * np.exp(logits) / np.exp(logits).sum() + 0.2 / len(logits)
        shares = np.bincount(actions[free[:, agent], agent], minlength=len(logits)) / free[:, agent].sum()
        assert shares == pytest.approx(expected, abs=0.015)
    # agents draw independently: agent 0's shares do not depend on what agent 1 draws
    together = actions[free.all(1)]
    for drawn in range(4):
        first = together[together[:, 1] == drawn, 0]
        sigma = 0.5 / len(first) ** 0.5
        assert first.mean() == pytest.approx(0.8 / (1 + np.exp(-0.5)) + 0.1, abs=4 * sigma)
    greedy, same = mac_iaicc.act(agents, obs, infos, hidden)
    assert (greedy == np.where(free, [1, 2], 1)).all() and same.equal(moved)
    # no number that a generator gives reaches the padding
    for number, first, second in ((0.0, 0, 0), (np.nextafter(1.0, 0.0), 1, 3)):
        actions, _ = mac_iaicc.act(agents, obs[:9], {k: v[:9] for k, v in infos.items()}, hidden[:, :9], 0.0,
                                   Always(number))  # fmt: skip
        assert (actions == np.where(free[:9], [first, second], 1)).all()


def test_mac_critics_see_observations_who_is_free_and_macro_actions():
    """Of every agent: a change of any of them at the last of three rows moves all critics' values there only."""
    torch.manual_seed(0)
    critics = mac_iaicc.Critics([2, 4, 3], 5, 16)
    sizes, rows = [2, 2, 2], torch.arange(6)  # two windows of three rows
    obs, free = torch.randn(6, 3, 5), torch.rand(6, 3) < 0.5
    before = torch.stack([torch.randint(n, (6,)) for n in (2, 4, 3)], 1)
    before[:2] = -1
    joint = mac_iaicc.JointHistory(obs, free, before, sizes, rows[:4], rows[2:])
    with torch.no_grad():
        values = critics.values(joint)
        assert values.shape == (3, 6)
        for agent in range(3):
            for key in ("obs", "free", "before"):
                changed = getattr(joint, key).clone()
                old = changed[5, agent]
                changed[5, agent] = ~old if key == "free" else (old + 1) % (2, 4, 3)[agent] if key == "before" else -old
                moved = critics.values(joint._replace(**{key: changed})) != values
                assert moved[:, 5].all() and not moved[:, :5].any(), (agent, key)


@pytest.mark.parametrize("env_id", ["wtd-s", "ct-10", "bp-10"])
def test_joint_history_is_what_the_agents_saw(env_id):
    """Real play, random windows of different lengths: observations, who is free and the macro-actions before of every
    row and of the one after the window; rows of a window stand in the same place of consecutive steps."""
    _, _, buffer, ended = play(mac_iaicc, env_id, 8)
    episodes, first, batch = random_windows(buffer, 24, 9)
    lengths = batch.valid.sum(1)
    assert len(set(lengths.tolist())) > 2
    joint = mac_iaicc.joint_history(batch)
    assert joint.sizes == [int((lengths + 1 > k).sum()) for k in range(lengths.max() + 1)]
    assert sum(joint.sizes) == len(joint.obs) == len(batch.reward) + 24
    offset, row, seen = np.cumsum([0, *joint.sizes]), 0, set()
    for number, begin, length in zip(episodes, first, lengths.tolist(), strict=True):
        episode, starts = ended[number], ended[number].starts()
        places = set()
        for k in range(length + 1):
            entry = (joint.row[row + k] if k < length else joint.next_row[row + k - 1]).item()
            if 0 < k < length:
                assert joint.next_row[row + k - 1] == entry
            places.add(entry - offset[k])
            seen.add(entry)
            assert 0 <= entry - offset[k] < joint.sizes[k]
            at = episode.row(starts[begin + k])
            np.testing.assert_array_equal(joint.obs[entry], at.obs)
            np.testing.assert_array_equal(joint.free[entry], at.free)
            np.testing.assert_array_equal(joint.before[entry], at.before)
        assert len(places) == 1
        row += length
    assert len(seen) == len(joint.obs) and not joint.free.all()


def test_mac_critics_see_the_joint_past_and_actors_their_own():
    """A macro-action or observation is changed in the buffer. Critics: what is chosen at a row moves all values from
    the next row on and none before. Actors: only those of the agent itself, from its next decision on; an observation,
    from the decision itself on."""
    env, learner, buffer, _ = play(mac_iaicc, "wtd-s", 3)
    rows, agents = buffer.data["rows"][:3] - 1, torch.arange(env.n_agents)
    offset = np.concatenate([[0], np.cumsum(rows)])

    def look():
        batch = whole_episodes(buffer, 3)
        joint = mac_iaicc.joint_history(batch)
        with torch.no_grad():
            logits, _, _ = learner["agents"](batch.obs, batch.previous, None, batch.sizes)
            values = learner["critics"].values(joint)
        return logits[agents, batch.entry], values[:, joint.row].T  # [R, agents, actions], [R, agents]

    logits, values = look()
    rng = np.random.default_rng(0)
    for what in ("action", "obs"):
        for _ in range(12):
            episode, agent = rng.integers(3), rng.integers(env.n_agents)
            decision = rng.integers(2, buffer.data["decisions"][episode, agent] - 3)
            place = episode, agent, decision
            k, later = (offset[episode] + buffer.data["row"][episode, agent, decision + j] for j in (0, 1))
            old = buffer.data[what][place].copy()
            buffer.data[what][place] = (old + 1) % env.n_actions[agent] if what == "action" else old + 1.0
            new_logits, new_values = look()
            buffer.data[what][place] = old
            changed = (new_values != values).numpy()
            start = k + (what == "action")
            expected = np.zeros(changed.shape, bool)
            expected[start : offset[episode + 1]] = True
            assert not changed[~expected].any() and changed[start].all()
            changed = (new_logits != logits).any(2).numpy()
            start = later if what == "action" else k
            expected = np.zeros(changed.shape, bool)
            expected[start : offset[episode + 1], agent] = True
            assert not changed[~expected].any() and changed[start, agent]


def test_mac_learns_once_from_every_episode(tmp_path, monkeypatch):
    """Whole episodes, at least batch_size of them, and then they are forgotten; returns carry no gradient; the policy
    is as soft as it acts; n and the entropy's weight are passed on."""
    ended, learned, soft, acted, n_steps, weights = [], [], [], [], [], []
    finish, windows = mac_iaicc.ReplayBuffer.finish, mac_iaicc.ReplayBuffer.windows
    loss, policy, act, returns = (
        getattr(mac_iaicc, name) for name in ("actor_critic_loss", "soft_policy", "act", "own_returns")
    )

    def spy_windows(self, episode, start, *args):
        assert episode.tolist() == list(range(self.size)) and not start.any()
        batch = windows(self, episode, start, *args)
        learned.append(self.size)
        assert batch.valid.sum(1).tolist() == (self.data["rows"][: self.size] - 1).tolist(), "to the end"
        return batch

    def spy_loss(policy, values, returns, batch, entropy_coef):
        assert policy.requires_grad and values.requires_grad and not returns.requires_grad
        soft.append(acted[-1])
        weights.append(entropy_coef)
        return loss(policy, values, returns, batch, entropy_coef)

    def spy_act(agents, obs, infos, hidden, epsilon=None, rng=None):
        if rng is None:
            return act(agents, obs, infos, hidden)
        begins = (infos["macro_action"] < 0).all(1)
        assert not hidden[:, begins].any() and (not (~begins).any() or hidden[:, ~begins].any()), "reset with episodes"
        acted.append(epsilon)
        return act(agents, obs, infos, hidden, epsilon, rng)

    def spy_policy(logits, n_actions, epsilon):
        if logits.requires_grad:
            assert epsilon == acted[-1]
        return policy(logits, n_actions, epsilon)

    def spy_returns(batch, next_values, n_step):
        n_steps.append(n_step)
        return returns(batch, next_values, n_step)

    spy_finish = lambda self, over, *args: ended.append(over.sum()) or finish(self, over, *args)  # noqa: E731
    monkeypatch.setattr(mac_iaicc.ReplayBuffer, "finish", spy_finish)
    monkeypatch.setattr(mac_iaicc.ReplayBuffer, "windows", spy_windows)
    for name, spy in (("actor_critic_loss", spy_loss), ("act", spy_act)):
        monkeypatch.setattr(mac_iaicc, name, spy)
    monkeypatch.setattr(mac_iaicc, "soft_policy", spy_policy)
    monkeypatch.setattr(mac_iaicc, "own_returns", spy_returns)
    args = mac_iaicc.defaults("bp-10", runs_dir=str(tmp_path), n_step=3, entropy_coef=0.2, start_e=0.9, end_e=0.1,
                              exploration_timesteps=1_000, **MAC)  # fmt: skip
    saved = torch.load(mac_iaicc.train(args) / "checkpoint.pt", weights_only=True)
    assert len(learned) == saved["updates"] > 3 and min(learned) >= args.batch_size
    assert sum(learned) + saved["buffer"]["size"] == sum(ended) and saved["buffer"]["size"] < args.batch_size
    assert set(n_steps) == {3} and set(weights) == {0.2}
    assert acted[0] == 0.9 and acted[-1] == pytest.approx(0.1) and sorted(soft, reverse=True) == soft


@pytest.mark.parametrize("polyak", [0.0, 1.0])
def test_mac_target_critics_move_by_polyak_only(tmp_path, monkeypatch, polyak):
    """With polyak 0 the targets are the critics themselves, a row later; with 1 they stay what they were."""
    following, same = [], []
    returns, loss = mac_iaicc.own_returns, mac_iaicc.actor_critic_loss

    def spy_returns(batch, next_values, n_step):
        following.append(next_values)
        return returns(batch, next_values, n_step)

    def spy_loss(policy, values, returns, batch, entropy_coef):
        inside = batch.valid.clone()
        inside[:, :-1] &= batch.valid[:, 1:]  # rows that are not the last of their episode
        inside[:, -1] = False
        row = inside[batch.valid].nonzero()[:, 0]
        same.append(torch.allclose(following[-1][row], values[row + 1], atol=1e-6))
        return loss(policy, values, returns, batch, entropy_coef)

    monkeypatch.setattr(mac_iaicc, "own_returns", spy_returns)
    monkeypatch.setattr(mac_iaicc, "actor_critic_loss", spy_loss)
    args = mac_iaicc.defaults("bp-10", runs_dir=str(tmp_path), polyak=polyak, **MAC)
    saved = torch.load(mac_iaicc.train(args) / "checkpoint.pt", weights_only=True)
    torch.manual_seed(args.seed)
    start = mac_iaicc.make_learner(args, envs.make("bp-10"))[0].state_dict()
    for name, value in saved["target"].items():
        torch.testing.assert_close(value, start[name] if polyak else saved["learner"][name])
        assert not value.equal(saved["learner"][name]) or not polyak
    assert same[0] and len(same) > 2 and all(now is not bool(polyak) for now in same[1:])


# ---- primitive environments ---------------------------------------------------------------------------------------


def textbook_qmix(mixer, utilities, state):
    """QMIX of Rashid et al. (2018) with a mixer's weights, for one joint macro-action."""

    def hypernetwork(net):
        return net[2].weight @ torch.relu(net[0].weight @ state + net[0].bias) + net[2].bias

    weight = hypernetwork(mixer.weight_1).abs().reshape(len(utilities), -1)
    hidden = torch.nn.functional.elu(utilities @ weight + mixer.bias_1.weight @ state + mixer.bias_1.bias)
    return hidden @ hypernetwork(mixer.weight_2).abs() + hypernetwork(mixer.bias_2)[0]


@pytest.mark.parametrize("env_id", ["bp-10-primitive", "wtd-s-primitive"])
@pytest.mark.parametrize("script, options", [(avf_vdn, {}), (avf_qmix, dict(mixer_state="joint"))])
def test_primitive_loss_is_that_of_the_textbook(script, options, env_id):
    """y_t = r_t + gamma Q'(s_t+1, argmax of each agent's own Q), without the second part at a terminal step, and the
    mean squared error; from the log of play, step by step. All macro-states are the current state, n times."""
    gamma, window = 0.9, 10
    env, learner, buffer, ended = play(script, env_id, 6, terminal=True, **options)
    target = copy.deepcopy(learner)
    for parameter in target.parameters():
        parameter.data.add_(0.5 * torch.randn_like(parameter))
    episodes, first, batch = random_windows(buffer, 20, window)
    # the last steps of each episode as well
    episodes, first = np.append(episodes, range(6)), np.append(first, buffer.data["rows"][:6] - 4)
    batch = buffer.windows(episodes, first, window)
    assert batch.chosen.all() and batch.next_chosen.all()

    def utilities(agents, episode, begin, end):  # of steps begin to end, [steps, agents, actions]
        hidden, found = agents.start(1), []
        for t in range(begin, end + 1):
            previous = episode.steps[t - 1].actions if t else np.full(env.n_agents, -1)
            obs = torch.from_numpy(episode.row(t).obs)[:, None]
            one, _, hidden = agents(obs, torch.from_numpy(previous)[:, None], hidden, [1])
            found.append(one[:, 0])
        return torch.stack(found)

    def mix(module, chosen, state):
        if script is avf_vdn:
            return chosen.sum()
        return textbook_qmix(module["mixer"], chosen, torch.from_numpy(np.tile(state, env.n_agents)))

    joint_values, targets, agents, other_best = [], [], torch.arange(env.n_agents), 0
    with torch.no_grad():
        for number, begin in zip(episodes, first, strict=True):
            episode = ended[number]
            end = min(begin + window, len(episode.steps))
            q, next_q = (utilities(module["agents"], episode, begin, end) for module in (learner, target))
            for t in range(begin, end):
                step, later, last = episode.steps[t], episode.row(t + 1), t + 1 == len(episode.steps)
                joint_values.append(mix(learner, q[t - begin][agents, torch.from_numpy(step.actions)], step.state))
                best = next_q[t - begin + 1][agents, q[t - begin + 1].argmax(1)]
                other_best += (q[t - begin + 1].argmax(1) != next_q[t - begin + 1].argmax(1)).sum().item()
                bootstrap = 0.0 if last and episode.terminated else gamma * mix(target, best, later.state).item()
                targets.append(step.reward + bootstrap)
        loss, joint_q = script.batch_loss(learner, target, batch, 0.0, 1.0)
    assert other_best > 10 and 0 < sum(episode.terminated for episode in ended[:6]) < 6
    joint_values, targets = torch.stack(joint_values), torch.tensor(targets, dtype=torch.float32)
    torch.testing.assert_close(joint_q, joint_values, rtol=1e-4, atol=1e-4)
    torch.testing.assert_close(loss, (targets - joint_values).square().mean(), rtol=1e-4, atol=1e-4)
    history = (batch.obs, batch.previous, None, batch.sizes)
    (q, v, _), (next_q, next_v, _) = learner["agents"](*history), target["agents"](*history)
    _, _, got = script.td_loss(q, v, next_q, next_v, learner["mixer"], target["mixer"], batch)
    torch.testing.assert_close(got, targets, rtol=1e-4, atol=1e-4)


# ---- runs ---------------------------------------------------------------------------------------------------------

MAC = dict(num_envs=4, total_timesteps=1_200, batch_size=3, hidden_size=16, eval_frequency=400, eval_episodes=2,
           checkpoint_frequency=400)  # fmt: skip


def tiny(script, env_id, **options):
    return script.defaults(env_id, **{**(MAC if script is mac_iaicc else TINY), **options})


CENTRALIZED = dict(double_q="centralized")


@pytest.mark.parametrize(
    "script, env_id, options",
    [(script, env_id, {}) for script in SCRIPTS for env_id in ("wtd-s", "bp-10", "ct-10")]
    + [(dec_maddrqn, "wtd-s", CENTRALIZED), (dec_maddrqn, "ct-10", CENTRALIZED), (cen_maddrqn, "wtd-t1", {})]
    + [
        (dec_maddrqn, "bp-10", {**CENTRALIZED, "hidden_state": "stored"}),
        (dec_maddrqn, "wtd-s", dict(hidden_state="stored", td_lambda=0.5)),
        (cen_maddrqn, "ct-10", dict(hidden_state="stored", td_lambda=0.5)),
    ],
)
def test_smoke_run_takes_gradient_steps(tmp_path, script, env_id, options):
    args = tiny(script, env_id, runs_dir=str(tmp_path), **options)
    folder = script.train(args)
    saved = torch.load(folder / "checkpoint.pt", weights_only=True)
    assert saved["step"] == 1_200 and len(scalars(folder)["eval/return"]) == 3
    assert saved["updates"] >= 2 if script is mac_iaicc else saved["updates"] == (1_200 - 200) // 40
    torch.manual_seed(args.seed)
    start = script.make_learner(args, envs.make(env_id))[0].state_dict()
    for name, value in saved["learner"].items():
        assert value.isfinite().all() and not value.equal(start[name]), name


TAGS = {"charts/episodic_return", "charts/episodic_length", "charts/epsilon", "eval/return", "eval/discounted_return",
        "eval/length", "eval/success", "losses/td_loss", "losses/q_values", "losses/grad_norm"}  # fmt: skip


@pytest.mark.parametrize("script, env_id", [(dec_maddrqn, "wtd-s"), (cen_maddrqn, "ct-10"), (mac_iaicc, "bp-10")])
def test_same_seed_same_curve_and_seed_zero_counts(tmp_path, script, env_id):
    curves = []
    # losses are not logged at every update
    often = dict(batch_size=1) if script is mac_iaicc else dict(batch_size=4, window=3, train_frequency=8)
    often["total_timesteps"] = 1_000
    for run, seed in enumerate((0, 0, 1)):
        curves.append(
            scalars(script.train(tiny(script, env_id, seed=seed, runs_dir=str(tmp_path / str(run)), **often)))
        )
    assert curves[0] == curves[1] and curves[0] != curves[2]
    assert curves[0]["losses/td_loss"] != curves[2]["losses/td_loss"]
    more = {"losses/actor_loss", "losses/entropy"} if script is mac_iaicc else set()
    assert curves[0].keys() == TAGS | more


@pytest.mark.parametrize(
    "script, env_id, options",
    [(dec_maddrqn, "bp-10", {}), (dec_maddrqn, "wtd-s", CENTRALIZED), (cen_maddrqn, "ct-10", {}),
     (mac_iaicc, "bp-10", {})],
)  # fmt: skip
def test_resumed_equals_undisturbed(tmp_path, script, env_id, options):
    """Cut before its end: every weight, the memory, every evaluation; for Mac-IAICC between two of its updates."""
    if script is mac_iaicc:
        options = dict(batch_size=7)
    else:
        options = {**options, "hidden_state": "stored", "window": 4}
    options["learning_rate_end"] = None  # a falling step size depends on the steps a run is meant to take
    whole = script.train(tiny(script, env_id, seed=0, runs_dir=str(tmp_path / "whole"), **options))
    options["total_timesteps"] = 800
    cut = script.train(tiny(script, env_id, seed=0, runs_dir=str(tmp_path), **options))
    half = torch.load(cut / "checkpoint.pt", weights_only=True)
    assert half["step"] == 800 and half["updates"] > 0 and half["env"]["elapsed"].any(), "in the middle of episodes"
    if script is mac_iaicc:
        assert 0 < half["buffer"]["size"] < 7, "in the middle of collecting"
    assert script.train(script.parse_args([f"--resume={cut}", "--total-timesteps=1200"])) == cut
    one, other = (torch.load(folder / "checkpoint.pt", weights_only=True) for folder in (whole, cut))
    assert one["step"] == other["step"] and one["updates"] == other["updates"] > half["updates"]
    assert one["rng"] == other["rng"] and one["hidden"].equal(other["hidden"])
    for part in ("learner", "target", "buffer", "env"):
        for key, value in one[part].items():
            same = torch.equal(value, other[part][key]) if torch.is_tensor(value) else value == other[part][key]
            assert same, f"{part} {key}"
    expected, got = scalars(whole), scalars(cut)
    for tag in expected.keys() - {"charts/episodic_return", "charts/episodic_length", "charts/epsilon"}:
        assert dict(got[tag]) == dict(expected[tag]), tag


@pytest.mark.parametrize("script", SCRIPTS)
def test_evaluate_prints_and_animates(tmp_path, capsys, monkeypatch, script):
    monkeypatch.setitem(envs._TASKS, "bp-10", (envs.BoxPushing, {"grid": 10, "horizon": 12}))  # few pictures to draw
    folder = script.train(tiny(script, "bp-10", runs_dir=str(tmp_path), total_timesteps=800))
    assert folder.name.startswith(f"bp-10__{script.ALGORITHM}__1__")
    gif = tmp_path / "policy.gif"
    script.report(script.parse_args([f"--evaluate={folder}", "--eval-episodes=1", f"--gif={gif}", "--model=last"]))
    printed = capsys.readouterr().out
    expected = torch.load(folder / "model.pt", weights_only=True)["last"]["return"]
    line = next(line for line in printed.splitlines() if line.startswith("return"))
    assert float(line.split()[1]) == pytest.approx(expected, abs=1e-3), "Box Pushing is deterministic"
    assert f"{script.ALGORITHM} last model of step 800" in printed
    with Image.open(gif) as animation:
        assert 5 < animation.n_frames <= 13


def test_defaults_of_the_families_are_arguments():
    for script in SCRIPTS:
        for env_id in envs.IDS:
            script.check(script.defaults(env_id))
        for family, changes in script.DEFAULTS.items():
            assert set(changes) <= set(script.Args.__dataclass_fields__), (script.ALGORITHM, family)
