"""Three 3 x 3 games: each algorithm reaches what its function class allows and no more.

Value-based algorithms play uniformly while they learn, so that the data do not depend on the learner, with the plain
loss: one-row targets, no hysteresis. What was learned is read twice: the payoff of the greedy choices, and the joint
values of the nine first joint macro-actions, as the script's own loss says them. With `tell`, all of them can value the
later rows exactly: the first row is the game and nothing else.

Not shown: that QPLEX finds the optimum of every non-monotonic game by the plain loss. It can represent Son et al.'s (8,
-12, 0), risky for both agents, but seldom learns it in so few updates (test_avf_qplex.py uses hysteresis). Mac-IAICC
has no joint values and learns from its own policy's play; it is here for completeness.
"""

import numpy as np
import pytest

import avf_qmix
import avf_qplex
import avf_vdn
import cen_maddrqn
import dec_maddrqn
import envs
import mac_iaicc
from tests.curves import scalars
from tests.matrix_game import MatrixGame, WaitingGame
from theory import optimism

ADDITIVE = np.add.outer([0.0, 3.0, 1.0], [2.0, 0.0, 5.0])  # best (b, c): 8
MONOTONIC = np.array([(8.0, 0.0, 0.0), (0.0, 0.0, 0.0), (0.0, 0.0, 0.0)])  # both are needed
RISKY = np.array([(8.0, -12.0, -12.0), (0.0, 0.0, 0.0), (0.0, 0.0, 0.0)])  # agent 0 risks something, agent 1 nothing

VALUES = [avf_vdn, avf_qmix, avf_qplex, cen_maddrqn]  # those that have a joint value
SEED = 1
# One setting per game, the same for every algorithm that learns values: payoffs, updates and learning rate.
SETTINGS = {
    "additive": (ADDITIVE, 140, 0.01),
    "monotonic": (MONOTONIC, 160, 0.01),
    "risky": (RISKY, 240, 0.005),
}


@pytest.fixture
def play(monkeypatch, tmp_path):
    """play(script, game, **options) trains and returns the payoff of the greedy choices and the joint values [3, 3]."""

    def play(script, game, **options):
        payoff, updates, learning_rate = SETTINGS[game]
        monkeypatch.setitem(envs._TASKS, "matrix", (MatrixGame, dict(payoff=payoff, tell=True), {}))
        settings = dict(
            learning_rate=learning_rate,
            anneal_lr=False,
            gamma=1.0,
            hidden_size=32,
            eval_episodes=1,
            reward_scale=1.0,
        )
        if script is not mac_iaicc:
            settings |= dict(
                total_timesteps=512 + 8 * updates,
                learning_starts=512,
                train_frequency=8,
                end_e=1.0,
                batch_size=32,
                buffer_size=500,
                polyak=0.95,
                td_lambda=0.0,
            )
        values = record_values(script, monkeypatch) if script in VALUES else None
        args = script.Args(env="matrix", seed=SEED, runs_dir=str(tmp_path), **{**settings, **options})
        return scalars(script.train(args))["eval/return"][-1][1], values

    return play


def record_values(script, monkeypatch):
    """Q of the nine first joint macro-actions, [3, 3], which training fills in: what the loss last said of each."""
    values = np.full((3, 3), np.nan)
    td_loss = script.td_loss

    def recording(*args):
        loss, q, target = td_loss(*args)
        (batch,) = (x for x in args if isinstance(x, dict))
        actions = batch["action"][:, 0].numpy()  # [B, 2]
        first = (batch["previous"] < 0).all(2)[batch["valid"]]  # which of the valid rows begin an episode
        values[tuple(actions.T)] = q.detach()[first].numpy()
        return loss, q, target

    monkeypatch.setattr(script, "td_loss", recording)
    return values


def worst(values, payoff):
    return abs(values - payoff).max()


def best_sum(payoff):
    """The sum q_0(m_0) + q_1(m_1) with the least squared error under uniform play: row mean + column mean - mean."""
    return payoff.mean(1, keepdims=True) + payoff.mean(0) - payoff.mean()


def rms(error):
    return np.sqrt(np.square(error).mean())


# ---- what the classes allow ---------------------------------------------------------------------------------------


def monotone_bound(payoff):
    """The largest error of anything that rises with the utilities is at least this: an agent puts a above b or below,
    and where the payoffs differ by d the wrong way, one of the two errs by d / 2."""

    def wrong_way(difference):
        return min(max(difference.max(), 0), max((-difference).max(), 0)) / 2

    return max(wrong_way(payoff[0] - payoff[1]), wrong_way(payoff[:, 0] - payoff[:, 1]))


def test_bounds_by_hand():
    """Sums: e = Q - payoff has e_aa - e_ab - e_ba + e_bb = -(payoff's), so one of the four is at least a quarter of it.

    Monotonic: 8 / 4 = 2, least squares 8 * (2/3, -1/3, -1/3) x (same), root mean square 8 * (6/9) / 3 = 16/9.
    Risky: (8 + 12) / 4 = 5; 20 (2/3, -1/3, -1/3) x (same), 20 * (6/9) / 3 = 40/9. Row means -16/3, 0, 0, column means
    8/3, -4, -4: the best sum plays b or c and a, for 0. Anything monotone errs by 4: if agent 0 ranks a above b, then
    Q_ab >= Q_bb, payoffs -12 and 0 (6 each), if below, Q_aa <= Q_ba, payoffs 8 and 0 (4 each).
    To find the optimum, agent 0 has to rank a highest: in columns b and c the best fit then pools -12, 0 and 0, squared
    error 2 * (8^2 + 4^2 + 4^2) = 192. The best sum errs by 9 * (40/9)^2 = 177.8: so the best fit of QMIX, whose class
    contains the sums, misses the optimum as well.
    """
    assert worst(best_sum(ADDITIVE), ADDITIVE) < 1e-9 and monotone_bound(ADDITIVE) == monotone_bound(MONOTONIC) == 0
    assert rms(best_sum(MONOTONIC) - MONOTONIC) == pytest.approx(16 / 9)
    assert rms(best_sum(RISKY) - RISKY) == pytest.approx(40 / 9)
    assert monotone_bound(RISKY) == 4 and 9 * (40 / 9) ** 2 < 192
    assert np.unravel_index(best_sum(MONOTONIC).argmax(), (3, 3)) == (0, 0)
    assert RISKY.flat[best_sum(RISKY).argmax()] == 0


# ---- what they learn ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("script", VALUES, ids=lambda s: s.__name__)
def test_additive_game_is_fitted_by_all(play, script):
    greedy, values = play(script, "additive")
    assert greedy == 8 and worst(values, ADDITIVE) < 0.8


@pytest.mark.parametrize("script", VALUES[1:], ids=lambda s: s.__name__)
def test_monotonic_game_is_fitted_by_a_monotone_mixer(play, script):
    greedy, values = play(script, "monotonic")
    assert greedy == 8 and worst(values, MONOTONIC) < 1


def test_monotonic_game_is_beyond_a_sum(play):
    """VDN's greedy choice is right, its values cannot be: 2 is the least largest error of any sum."""
    greedy, values = play(avf_vdn, "monotonic")
    assert greedy == 8 and worst(values, MONOTONIC) > 2
    assert rms(values - best_sum(MONOTONIC)) < 0.8, "no worse than it must be"


@pytest.mark.slow
@pytest.mark.parametrize("script", VALUES[2:], ids=lambda s: s.__name__)
def test_risky_game_is_solved_beyond_monotone_mixers(play, script):
    greedy, values = play(script, "risky")
    assert greedy == 8 and worst(values, RISKY) < 1.5


@pytest.mark.slow
@pytest.mark.parametrize("script, bound", [(avf_vdn, 5), (avf_qmix, 4)], ids=["avf_vdn", "avf_qmix"])
def test_risky_game_is_missed_by_monotone_mixers(play, script, bound):
    """Both end near the best sum, which prefers agent 0's safe choices."""
    greedy, values = play(script, "risky")
    assert greedy == 0 and worst(values, RISKY) > bound
    assert rms(values - RISKY) > 4 and rms(values - best_sum(RISKY)) < 2


@pytest.mark.slow
def test_independent_learners_average_over_the_other(play):
    """Under uniform play a is worth -16/3 to agent 0, as for VDN. With hysteresis, as on Box Pushing, it finds the
    optimum: that is optimism about the other agent, not a richer class."""
    assert play(dec_maddrqn, "additive")[0] == play(dec_maddrqn, "monotonic")[0] == 8
    assert play(dec_maddrqn, "risky")[0] == 0
    assert play(dec_maddrqn, "risky", hysteresis=0.2)[0] == 8


@pytest.mark.slow
@pytest.mark.parametrize("game", SETTINGS)
def test_actors_and_critics_find_the_optimum(play, game):
    """On policy: agent 1's a is best as long as agent 0 sometimes takes a, and then so is a for agent 0."""
    settings = dict(total_timesteps=4_000, batch_size=16, exploration_timesteps=2_400, learning_rate=5e-3)
    assert play(mac_iaicc, game, reward_scale=0.1, **settings)[0] == 8


@pytest.mark.slow
@pytest.mark.parametrize("script", [avf_vdn, avf_qmix, avf_qplex], ids=lambda s: s.__name__)
def test_optimism_below_the_bound_pushes_and_above_it_leaves(script, monkeypatch, tmp_path):
    """What theory/optimism.py predicts, on a game in which nothing else matters. By hand: below beta = 0.527 it pays to
    push; for beta 0.3, 0.1 (10 - e) = 0.081 (e - 0.9 e + 3) gives e = 7.0, and for 1, 0.1 (10 - e) = 0.9 (e - 0.9 * 2
    + 3) gives -0.08."""
    game = dict(joins=0.1, big=10.0, fails=3.0, safe=2.0)
    gamma = 0.9
    assert optimism.bound(*game.values(), gamma) == pytest.approx(0.527, abs=1e-3)
    monkeypatch.setitem(envs._TASKS, "waiting", (WaitingGame, game, {}))
    td_loss = script.td_loss
    found = {}

    def recording(*args):
        loss, q, target = td_loss(*args)
        (batch,) = (x for x in args if isinstance(x, dict))
        pushes = batch["action"][..., 0][batch["valid"]] == 0
        found[beta].append([q[pushes].mean().item(), q[~pushes].mean().item()])
        return loss, q, target

    monkeypatch.setattr(script, "td_loss", recording)
    shared = dict(
        env="waiting",
        seed=SEED,
        runs_dir=str(tmp_path),
        gamma=gamma,
        hidden_size=16,
        eval_episodes=1,
        reward_scale=1.0,
        total_timesteps=4_800,
        learning_starts=1_600,
        train_frequency=16,
        end_e=1.0,
        batch_size=64,
        polyak=0.95,
        learning_rate=0.01,
        exploration_timesteps=10**6,
        td_lambda=0.0,
    )
    for beta in (0.3, 1.0):
        found[beta] = []
        script.train(script.Args(hysteresis=beta, **shared))
        push, leave = np.mean(found[beta][-60:], 0)
        assert optimism.value(beta, *game.values(), gamma) == pytest.approx({0.3: 7.0, 1.0: -0.08}[beta], abs=0.01)
        assert push == pytest.approx({0.3: 7.0, 1.0: -0.08}[beta], abs=1) and leave == pytest.approx(2, abs=0.3)
