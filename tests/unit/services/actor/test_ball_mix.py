"""Which kinds of ball an actor's environments play."""

from collections import Counter
from types import SimpleNamespace

import numpy as np
import pytest

from common.task.launch_presets import Kind
from common.task.randomization import RALLY_PARAMETERS, RallyParameter
from common.task.states import Outcome
from services.actor.ball_mix import BallMix

ALL_IN_STOCK = np.ones(len(Kind), np.bool_)
PLAYED = [Kind.PAPER, Kind.STRONG, Kind.MATCH, Kind.ELITE, Kind.SERVE]


def finished(kind, returned, lost, validated=True):
    """Return rallies of one kind that ended."""
    parameters = np.zeros((returned + lost, RALLY_PARAMETERS))
    parameters[:, RallyParameter.KIND] = kind
    outcomes = np.array([Outcome.RETURNED] * returned + [Outcome.MISS] * lost, np.uint8)
    return SimpleNamespace(
        parameters=parameters, outcomes=outcomes, validated=np.full(len(outcomes), validated)
    )


def played(mix, balls=4000, envs=8):
    return [mix.next_kind(k % envs, ALL_IN_STOCK) for k in range(balls)]


def test_before_any_ball_each_kind_is_played_as_the_preset_says():
    counts = Counter(played(BallMix("all", 8, 1)))

    assert set(counts) == set(PLAYED)
    for kind in PLAYED:  # an opponent plays 16 balls on average: 250 opponents, a standard error of 0.03
        assert counts[kind] / 4000 == pytest.approx(0.2, abs=0.08)


@pytest.mark.parametrize("preset", ["paper", "serve"])
def test_a_preset_of_one_kind_gives_that_kind_alone(preset):
    assert set(played(BallMix(preset, 8, 1), 200)) == {Kind[preset.upper()]}


def test_a_kind_that_is_lost_more_often_is_played_more_often_and_none_is_forgotten():
    mix = BallMix("all", 8, 1)
    for kind, returned, lost in ((Kind.PAPER, 4000, 0), (Kind.STRONG, 2000, 2000), (Kind.MATCH, 0, 4000)):
        mix.note(finished(kind, returned, lost))

    shares = mix.shares
    assert shares.sum() == pytest.approx(1.0)
    assert shares[Kind.PAPER] > 0.04
    assert shares[Kind.MATCH] / shares[Kind.PAPER] == pytest.approx(1.25 / 0.25, rel=0.05)
    assert shares[Kind.PAPER] < shares[Kind.STRONG] < shares[Kind.MATCH]
    assert shares[Kind.RECORDED] == 0.0


def test_launches_that_no_generator_validated_change_nothing():
    mix = BallMix("all", 8, 1)
    mix.note(finished(Kind.PAPER, 4000, 0, validated=False))

    assert mix.shares[Kind.PAPER] == pytest.approx(0.2)


def test_an_opponent_plays_one_kind_for_sixteen_balls_on_average():
    mix = BallMix("all", 1, 1)
    kinds = played(mix, 8000, envs=1)
    changes = sum(kinds[k] != kinds[k - 1] for k in range(1, len(kinds)))

    # a new opponent has the kind of the last one in up to a fifth of the cases
    assert 12 < 8000 / changes < 24


def test_a_kind_that_is_not_in_stock_is_replaced():
    stock = ALL_IN_STOCK.copy()
    stock[[Kind.ELITE, Kind.SERVE]] = False
    mix = BallMix("all", 8, 1)

    assert {mix.next_kind(k % 8, stock) for k in range(400)} == {Kind.PAPER, Kind.STRONG, Kind.MATCH}


def test_the_choice_is_a_function_of_the_seed():
    assert played(BallMix("all", 8, 3)) == played(BallMix("all", 8, 3))
    assert played(BallMix("all", 8, 3)) != played(BallMix("all", 8, 4))
