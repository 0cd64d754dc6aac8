"""The clock of a show."""

from dataclasses import replace

import pytest

from topspin.view.playback import APPROACH_S, HOLD_S, Pace, Playback


def played(playback, step, most=10_000):
    """Return the real time that a show takes in steps of ``step`` seconds."""
    passed = 0.0
    for _ in range(most):
        if playback.is_over:
            return passed
        playback, passed = playback.after(step), passed + step
    raise AssertionError("it never ends")


@pytest.mark.parametrize("step", [0.003, 0.02, 0.1])
@pytest.mark.parametrize(("speed", "flight"), [(1.0, 1.5), (0.25, 6.0)])
def test_only_the_flight_is_slow(step, speed, flight):
    assert played(Playback(1.5, speed=speed), step) == pytest.approx(
        APPROACH_S + flight + HOLD_S, abs=2 * step
    )


def test_the_robot_stands_at_its_start_when_the_ball_comes():
    show = Playback(1.0)

    assert show.approach == 0.0
    assert replace(show, time=0.0).approach == replace(show, time=0.4).approach == 1.0
    assert 0.0 < replace(show, time=-APPROACH_S / 2).approach < 1.0


def test_a_paused_show_stays():
    show = Playback(1.0, time=0.3, is_paused=True)

    assert show.after(0.05) == show


def test_a_stall_of_the_program_is_not_caught_up():
    assert Playback(5.0, time=1.0).after(3.0).time == pytest.approx(1.1)


def test_the_pace_is_what_was_shown_by_the_time_it_took():
    pace = Pace()
    for _ in range(400):
        pace = pace.after(shown=0.01, passed=0.04)

    assert pace.speed == pytest.approx(0.25, abs=1e-3)
    assert pace.rate_hz == pytest.approx(25.0)
