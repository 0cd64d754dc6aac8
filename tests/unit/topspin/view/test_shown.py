"""What the page shows of a ball: picture, texts and score."""

import math

import numpy as np
import pytest

from common.evaluation.rally_recorder import INTERCEPTION_IN, INTERCEPTION_POS
from common.task.states import Outcome
from tests.unit.topspin.render.recorded import HOME, make_rally, make_recorded
from topspin.render.replay import path_of, position_at
from topspin.view import words
from topspin.view.picture import estimate_at, picture_at
from topspin.view.playback import Pace, Playback
from topspin.view.score import Score
from topspin.view.words import Playing

PLAYING = Playing("default", "rails", "rails", "paper")


@pytest.fixture(scope="module")
def recorded():
    return make_recorded(24)


def picture(rally, time, before=HOME, approach=1.0):
    return picture_at(rally, path_of(rally), time, before, approach)


def test_the_robot_moves_from_where_it_was_to_its_start(recorded):
    before = HOME + 0.3

    np.testing.assert_array_equal(picture(recorded[0], -0.6, before, 0.0).joints, before)
    np.testing.assert_allclose(picture(recorded[0], 0.0, before, 1.0).joints, recorded[0].joints[0])
    np.testing.assert_allclose(
        picture(recorded[0], -0.3, before, 0.5).joints, (before + recorded[0].joints[0]) / 2
    )


def test_the_trail_reaches_from_the_launch_to_the_ball_through_its_states(recorded):
    rally = next(rally for rally in recorded if rally.outcome == Outcome.RETURNED or 2 in rally.state)
    shown = picture(rally, rally.time[-1])

    np.testing.assert_array_equal(shown.trail[0, 0], rally.ball_pos[0])
    np.testing.assert_array_equal(shown.trail[-1, 1], shown.ball_pos)
    np.testing.assert_array_equal(shown.trail[1:, 0], shown.trail[:-1, 1])
    assert list(dict.fromkeys(shown.trail_states.tolist())) == list(dict.fromkeys(rally.state.tolist()))


def test_nothing_is_drawn_of_a_ball_before_its_launch(recorded):
    shown = picture(recorded[0], -0.3)

    assert len(shown.trail) == 0
    np.testing.assert_array_equal(shown.ball_pos, recorded[0].ball_pos[0])


def test_the_spins_arrow_grows_with_the_spin():
    lengths = [
        np.linalg.norm(np.diff(picture(make_rally(spin=(0.0, rate, 0.0)), 0.05).spin, axis=0))
        for rate in (50.0, 200.0)
    ]

    assert lengths[1] > lengths[0] + 0.1
    assert picture(make_rally(), 0.05).spin is None


def test_the_prediction_is_where_the_ball_then_is(recorded):
    """After the bounce the flight filter knows the ball: most predictions are right to a few centimetres."""
    errors = []
    for rally in recorded:
        bounced = rally.time[rally.state == 1]
        if not len(bounced):
            continue
        time = bounced[0] + 0.06  # the camera's latency is over
        row = estimate_at(rally, float(time))
        if row is not None and row.interception_in > 0.0 and time + row.interception_in <= bounced[-1]:
            errors.append(
                np.linalg.norm(row.interception_pos - position_at(path_of(rally), time + row.interception_in))
            )
            np.testing.assert_array_equal(picture(rally, float(time)).prediction, row.interception_pos)

    assert len(errors) >= 5
    assert np.median(errors) < 0.04


def test_nothing_is_predicted_after_the_hit_and_by_a_policy_that_predicts_nothing(recorded):
    hit = next(rally for rally in recorded if 2 in rally.state)

    assert picture(hit, float(hit.time[hit.state == 2][0])).prediction is None
    assert estimate_at(make_rally(), 0.05) is None


def test_estimates_have_the_times_of_the_control_steps(recorded):
    for rally in recorded:
        steps = np.diff(rally.estimates[:, 0])
        np.testing.assert_allclose(steps, 0.02)
        assert rally.time[-1] <= rally.estimates[-1, 0] + 1e-9
    assert INTERCEPTION_POS.start == INTERCEPTION_IN + 1


def test_the_score_counts_balls_by_outcome():
    score = Score()
    for outcome, error, state in (
        (Outcome.RETURNED, 0.10, 2),
        (Outcome.NET, math.nan, 2),
        (Outcome.NET, math.nan, 2),
        (Outcome.RETURNED, 0.30, 2),
        (Outcome.MISS, math.nan, 0),
    ):
        score = score.with_rally(
            make_rally(outcome=outcome, landing_error=error, state=np.full(20, state, np.int64))
        )

    assert (score.balls, score.returned, score.return_rate) == (5, 2, 0.4)
    assert score.catch_rate == 0.8
    assert score.landing_error == pytest.approx(0.2)
    assert score.by_outcome() == [(Outcome.RETURNED, 2), (Outcome.NET, 2), (Outcome.MISS, 1)]
    assert math.isnan(Score().return_rate)


def test_the_outcome_is_told_when_the_ball_shows_it():
    rally = make_rally(outcome=Outcome.NET, state=np.full(20, 2, np.int64))

    before = words.status(PLAYING, 3, rally, Playback(0.095, time=0.05), Pace())
    after = words.status(PLAYING, 3, rally, Playback(0.095, time=0.2), Pace())

    assert "hit by the robot" in before
    assert "into the net" not in before
    assert "into the net" in after
    assert "Ball 3" in after


def test_a_robot_that_the_policy_does_not_know_is_named():
    rally, playback = make_rally(), Playback(0.1)

    assert "trained on" not in words.status(PLAYING, 1, rally, playback, Pace())
    other = Playing("<b>", "arm", "rails", "paper")
    text = words.status(other, 1, rally, playback, Pace())
    assert "trained on rails, not on this robot" in text
    assert "<b>" not in text


def test_the_pace_is_told():
    playback = Playback(1.0, speed=0.25)

    assert words.pace_line(playback, Pace(0.25, 50.0)) == (
        "plays at 0.25 x real time, 50 pictures/s, slow motion 0.25 x"
    )
    assert words.pace_line(Playback(1.0, is_paused=True), Pace()) == "paused"
