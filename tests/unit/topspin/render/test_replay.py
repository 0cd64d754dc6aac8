import numpy as np
import pytest

from common.physics.constants import BALL_RADIUS
from tests.unit.topspin.render.recorded import make_rally, make_recorded
from topspin.render.film import AROUND_HIT_S, FilmOptions, caption_at, picture_times
from topspin.render.replay import moment_at, path_of, path_until, position_at, spin_word
from topspin.render.scene import corners_of
from topspin.render.stills import _STRIP_SHARE, part_times, showpiece


def test_the_path_bends_on_the_table_not_between_two_samples():
    bounced = [rally for rally in make_recorded(12) if rally.state.max() > 0]
    for rally in bounced:
        path = path_of(rally)
        bounce = int(np.flatnonzero(np.diff(path.state))[0])  # the last point of tau_01

        # straight for at most 5 ms: gravity alone bends that by 0.1 mm
        assert path.pos[bounce, 2] == pytest.approx(BALL_RADIUS, abs=1e-3)
    assert len(bounced) > 5


def test_a_path_goes_through_every_sample_in_order():
    for rally in make_recorded(6):
        path = path_of(rally)

        assert (np.diff(path.time) >= 0.0).all()
        assert len(path.time) <= len(rally.time) + 6
        for k in range(len(rally.time)):
            np.testing.assert_allclose(position_at(path, rally.time[k]), rally.ball_pos[k], atol=1e-9)


def test_the_trail_ends_at_the_ball():
    rally = make_rally()
    path = path_of(rally)

    for time in (0.0, 0.0049, 0.005, 0.0321, 0.095, 9.0):
        trail, moment = path_until(path, time), moment_at(rally, path, time)

        np.testing.assert_allclose(trail.pos[-1], moment.ball_pos)
        assert trail.time[-1] == pytest.approx(min(time, 0.095))


def test_a_thinned_trail_keeps_its_ends_and_its_corners():
    for rally in make_recorded(6):
        path = path_of(rally)
        corners = corners_of(path)

        assert corners[0] == 0
        assert corners[-1] == len(path.time) - 1
        assert set(np.flatnonzero(np.diff(path.state))) <= set(corners)
        assert len(corners) < 0.5 * len(path.time)


def test_a_moment_between_samples_lies_between_its_neighbours():
    joints = np.linspace(0.0, 1.0, 20)[:, None] * np.ones(7)
    rally = make_rally(joints=joints)

    moment = moment_at(rally, path_of(rally), 0.0125)

    np.testing.assert_allclose(moment.joints, 0.5 * (joints[2] + joints[3]))
    np.testing.assert_allclose(moment.ball_pos, [0.45, 0.0, 0.3])


@pytest.mark.parametrize(
    ("vel", "spin", "word"),
    [
        ((-5, 0, 0), (0, -80, 10), "topspin"),
        ((5, 0, 0), (0, 80, 10), "topspin"),
        ((-5, 0, 1), (0, 80, 10), "backspin"),
        ((-5, 0, 0), (0, 20, -50), "sidespin"),
        ((0, -5, 0), (0, 60, 10), "corkscrew"),
        ((-5, 0, 0), (0, 1, 0), "no spin"),
        ((0, 0, -5), (0, 0, 50), "corkscrew"),
    ],
)
def test_spin_is_named_by_its_largest_part(vel, spin, word):
    assert spin_word(np.array(vel, float), np.array(spin, float)) == word


@pytest.mark.parametrize(("slow", "count"), [(1.0, 6), (0.5, 11), (0.25, 20)])
def test_slow_motion_takes_more_pictures_of_the_same_time(slow, count):
    times = picture_times(make_rally(), FilmOptions(slow=slow))

    assert len(times) == count
    assert times[-1] == pytest.approx(0.095)
    np.testing.assert_allclose(np.diff(times)[:-1], 0.02 * slow)


def test_the_film_is_slow_only_around_the_hit():
    hit_at_half_a_second = np.where(np.arange(201) < 100, 1, 2)
    rally, options = make_rally(201, state=hit_at_half_a_second), FilmOptions(slow_at_hit=0.25)

    times = np.array(picture_times(rally, options))

    steps, near = np.diff(times)[:-1], np.abs(times[:-2] - 0.5) < AROUND_HIT_S
    np.testing.assert_allclose(steps[near], 0.005)
    np.testing.assert_allclose(steps[~near], 0.02)
    assert times[-1] == 1.0
    assert "0.25 x real time" in caption_at([rally], 0, 0.5, options).note
    assert caption_at([rally], 0, 0.2, options).note == ""
    assert len(picture_times(rally, FilmOptions())) == 51
    assert len(picture_times(make_rally(201), options)) == 51  # nobody hit it


def test_the_verdict_is_written_once_the_rally_is_over():
    rallies = [make_rally()]

    before, after = (caption_at(rallies, 0, time, FilmOptions()) for time in (0.05, 0.095))

    assert (before.verdict, after.verdict) == ("", "missed")
    assert after.lines == ("ball 4.0 m/s", "spin 0 rad/s, no spin")


def test_a_rallys_parts_follow_one_another():
    for rally in make_recorded(6):
        parts = part_times(rally)

        assert list(parts) == list(range(int(rally.state.max()) + 1))
        for state in list(parts)[1:]:
            assert parts[state][0] == pytest.approx(parts[state - 1][1] + 0.005)


def test_the_parts_of_a_served_ball_begin_with_the_serve():
    served = make_rally(9, state=np.array([4, 4, 4, 0, 0, 1, 1, 2, 3]))
    bounced = make_rally(9, state=np.array([0, 0, 0, 0, 0, 0, 1, 1, 1]))

    assert list(part_times(served)) == [4, 0, 1, 2, 3]
    assert set(_STRIP_SHARE) >= set(part_times(served))
    assert showpiece([make_rally(9, state=np.array([4] * 9)), bounced]) is bounced
