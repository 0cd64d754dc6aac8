"""The simulated camera: what it shows, what it loses, and that all of it hangs on the rally's seed."""

import numpy as np
import pytest

from common.physics.constants import GRID_STEP
from common.physics.fly import NO_ROBOT, fly_step
from common.physics.table_bounce import table_bounce
from common.physics.touch import NONE
from common.rally.camera import MAX_RATE_HZ, SHOTS, shot_moment, shot_position
from common.rally.launch import draw_rallies
from common.rally.noise import CONDITIONS, MAX_LATENCY_STEPS, PROFILES, Condition, draw_conditions
from tests.unit.rally.filmed import CONTROL_STEPS, filmed_rallies

STANDARD = PROFILES["standard"]
SHARP = STANDARD._replace(camera_noise=0.0, outlier_share=0.0, loss=0.0, burst_share=0.0)
SLOWEST_CONTROL = 0.040  # s


def moments(seed: int, count: int = 200) -> np.ndarray:
    return np.array([shot_moment(np.uint64(seed), k, STANDARD) for k in range(count)])


def shots_of(filmed, row: int) -> np.ndarray:
    return filmed.shots[row][np.isfinite(filmed.shots[row, :, 0])]


def true_position(record: np.ndarray, condition: np.ndarray, moment: float) -> tuple[float, ...]:
    """Return where the ball is, flown in steps of half a millisecond, and a last one that ends there."""
    pos, vel, spin = (tuple(record[k : k + 3].tolist()) for k in (0, 3, 6))
    drag, lift = record[9], record[10]
    left = moment
    while left > 1e-12:
        pos, vel, flown, what, normal = fly_step(
            pos, vel, spin, min(left, 5e-4), drag, lift, 0, NO_ROBOT, 0.0, 1.0, 0.0
        )
        left -= flown
        if what != NONE:
            vel, spin = table_bounce(vel, spin, normal, condition[2], condition[3])
    return pos


@pytest.mark.parametrize("profile", PROFILES)
def test_the_ring_holds_every_shot_that_is_under_way(profile):
    rate = PROFILES[profile].camera_rate_hz

    assert rate <= MAX_RATE_HZ
    assert (MAX_LATENCY_STEPS * GRID_STEP + SLOWEST_CONTROL) * MAX_RATE_HZ + 2 < SHOTS


def test_a_shot_shows_the_ball_at_its_own_moment_also_where_a_touch_lies_within_the_grid_step():
    filmed = filmed_rallies(20, noise=SHARP, hit=False)
    block = draw_rallies(20, seed=0)
    condition = np.empty(CONDITIONS)
    checked = 0
    for row in range(20):
        draw_conditions(block.seeds[row], block.launches[row, 9], block.launches[row, 10], SHARP, condition)
        for shot in shots_of(filmed, row)[::3]:
            true = true_position(block.launches[row], condition, shot[0])

            # two integrations of the same flight, with steps of 5 and 0.5 ms, differ by less than 1 um
            np.testing.assert_allclose(shot[1:4], true, atol=2e-6)
            checked += 1
    assert checked > 200


def test_shots_are_taken_at_the_cameras_rate_and_jitter_and_never_change_places():
    period = 1.0 / STANDARD.camera_rate_hz
    taken = np.array([moments(seed) for seed in range(50)])
    jitter = taken - period * np.arange(taken.shape[1])

    assert np.all(np.diff(taken, axis=1) > 0.0)
    assert jitter.std() == pytest.approx(STANDARD.camera_jitter, rel=0.03)  # 10,000 draws: 1 % is 1.4 sigma
    assert np.abs(jitter).max() < 0.46 * period


def test_shots_are_a_function_of_seed_and_index():
    pos = (1.0, 0.2, 0.3)
    once, again = ([shot_position(np.uint64(7), k, pos, STANDARD) for k in range(50)] for _ in range(2))
    other = [shot_position(np.uint64(8), k, pos, STANDARD) for k in range(50)]

    assert once == again
    assert not set(once) & set(other)


def test_shots_have_the_profiles_noise_and_share_of_gross_errors():
    off = np.array([shot_position(np.uint64(3), k, (0.0, 0.0, 0.0), STANDARD) for k in range(20_000)])
    gross = np.abs(off).max(axis=1) > 0.012  # six sigmas

    # of +-0.3 m in three axes all but 1 in 15,000 lie beyond; 20,000 shots hold 100 +- 10 gross errors
    assert gross.mean() == pytest.approx(STANDARD.outlier_share, rel=0.35)
    np.testing.assert_allclose(off[~gross].std(axis=0), STANDARD.camera_noise, rtol=0.02)
    assert np.abs(off).max() < STANDARD.outlier_size + 0.012


def test_three_percent_of_shots_are_lost_and_none_of_the_launch():
    noise = STANDARD._replace(burst_share=0.0)
    filmed = filmed_rallies(400, noise=noise, hit=False)
    watched = np.isfinite(filmed.truth[:, :, 0]).sum(axis=1)
    long = watched >= 25
    until = 72.5 / noise.camera_rate_hz  # 0.4 s: the launch's shot and 72 that may be lost
    kept = np.array([(filmed.shots[row, :, 0] < until).sum() - 1 for row in np.flatnonzero(long)])

    assert np.all(filmed.shots[:, 0, 0] == 0.0)
    assert 1.0 - kept.mean() / 72 == pytest.approx(noise.loss, abs=0.004)


def test_in_a_burst_no_shot_is_kept():
    noise = STANDARD._replace(burst_share=1.0)
    block, filmed = draw_rallies(50, seed=0), filmed_rallies(50, noise=noise)
    condition = np.empty(CONDITIONS)
    for row in range(50):
        draw_conditions(block.seeds[row], 1.0, 1.0, noise, condition)
        stamps = shots_of(filmed, row)[1:, 0]
        start, end = condition[Condition.BURST_START], condition[Condition.BURST_END]

        assert not np.any((stamps >= start) & (stamps < end))


def test_without_noise_the_camera_is_perfect():
    filmed = filmed_rallies(30, noise=PROFILES["off"], latency=0.0)
    stamps = shots_of(filmed, 0)[:, 0]

    np.testing.assert_allclose(np.diff(stamps), 1.0 / PROFILES["off"].camera_rate_hz, atol=1e-12)
    assert filmed.truth.shape[1] == CONTROL_STEPS
