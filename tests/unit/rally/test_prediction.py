"""What a flight tells: the fit is a slow least squares, the bounce a Monte Carlo's, and rallies bear both out."""

from typing import get_args

import numpy as np
import pytest

from common.env.rally_env import EnvConfig, RallyEnv
from common.physics.constants import AIR_FACTOR, BALL_RADIUS, GRAVITY
from common.physics.flight import SIMPLE, SIMPLE_DRAG, SIMPLE_LIFT_SLOPE, flight_step
from common.physics.fly import NO_ROBOT, fly_to_touch
from common.physics.table_bounce import table_bounce
from common.rally import prediction
from common.rally.launch import draw_rallies
from common.rally.observation import Expectation
from common.rally.prediction import (
    BOUNCED,
    EXPECTED,
    FACTOR_SIGMA,
    FORESEEN,
    FOUND,
    MEETING,
    MEETING_AFTER,
    NOMINAL_DRAG,
    PRESENT,
    SPIN,
    SPIN_SIGMA,
    TRACK,
    begin_track,
    follow,
    new_tracks,
    predict,
)
from tests.unit.env.rallies import Deck

START, FLYING = (1.0, 0.2, 0.3), (-6.0, 1.0, 1.0)
FASTER = (1.2, 0.2)  # by what mild balls spin faster than they show
NOISE = (0.003, 0.08)  # [m], [m/s] of the profile `standard`
UP = (0.0, 0.0, 1.0)
HERE, GOING = slice(PRESENT, PRESENT + 3), slice(PRESENT + 3, PRESENT + 6)
MET, MET_GOING, SPINNING = (
    slice(MEETING + 1, MEETING + 4),
    slice(MEETING + 4, MEETING + 7),
    slice(SPIN, SPIN + 3),
)
FLIGHT_SPIN = slice(FOUND + 6, FOUND + 9)


def flown(spin, moment, pos=START, vel=FLYING, drag=1.0, step=0.001):
    """Return a ball's position and velocity after ``moment`` seconds of flight."""
    for _ in range(round(moment / step)):
        pos, vel = flight_step(pos, vel, spin, step, drag, 1.0, SIMPLE)
    return pos, vel


def samples(spin, moments, drag=1.0, noise=(0.0, 0.0), seed=0, vel=FLYING) -> np.ndarray:
    """Return what is seen (n, 6) of a ball at ``moments``, all before its bounce."""
    rng = np.random.default_rng(seed)
    seen = np.array([np.concatenate(flown(spin, moment, vel=vel, drag=drag)) for moment in moments])
    return seen + rng.standard_normal(seen.shape) * np.repeat(noise, 3)


def tracked(seen, moments, noise=(0.0, 0.0)) -> np.ndarray:
    """Return the track of samples (n, 6) from before the bounce."""
    track = new_tracks(1)[0]
    begin_track(track, seen[0], moments[0], *noise)
    for sample, moment in zip(seen[1:], moments[1:], strict=True):
        follow(track, sample, moment, False, *noise)
    return track


def spin_found(seen, moments, noise=(0.0, 0.0)) -> np.ndarray:
    return SPIN_SIGMA * tracked(seen, moments, noise)[FLIGHT_SPIN]


def least_squares(seen, moments, noise) -> np.ndarray:
    """Return the spin by NumPy's least squares, all that is summed along the nominal ball in steps of 0.1 ms."""
    h, lift, drag = 1e-4, AIR_FACTOR * SIMPLE_LIFT_SLOPE * BALL_RADIUS, AIR_FACTOR * SIMPLE_DRAG
    position, velocity = max(noise[0], 0.001), max(noise[1], 0.02)
    p, v = seen[0, :3].copy(), seen[0, 3:].copy()
    way, path, slowed, slowed_path = np.zeros(3), np.zeros(3), np.zeros(3), np.zeros(3)
    left, left_path = 1.0, 0.0
    rows, rest, k = [], [], 0
    for sample, moment in zip(seen[1:], moments[1:], strict=True):
        while k < round(moment / h):
            rate = drag * np.linalg.norm(v)
            path += h * way
            way += h * (v - rate * way)
            slowed_path += h * slowed
            slowed += h * (-rate * v - 2.0 * rate * slowed)
            left_path += h * left
            left -= h * rate * left
            brake = -rate * v
            p = p + h * v + 0.5 * h * h * (brake - [0, 0, GRAVITY])
            v = v + h * (brake - [0, 0, GRAVITY])
            k += 1
        for i in range(3):
            turned = [np.cross(axis, path)[i] * lift for axis in np.eye(3)]
            bent = [np.cross(axis, way)[i] * lift for axis in np.eye(3)]
            rows.append(np.r_[np.eye(3)[i], left_path * np.eye(3)[i], turned, slowed_path[i]] / position)
            rest.append((sample[i] - p[i]) / position)
            rows.append(np.r_[np.zeros(3), left * np.eye(3)[i], bent, slowed[i]] / velocity)
            rest.append((sample[3 + i] - v[i]) / velocity)
    prior = 1.0 / np.array([position] * 3 + [velocity] * 3 + [50.0] * 3 + [0.09])
    found, *_ = np.linalg.lstsq(np.vstack([rows, np.diag(prior)]), np.r_[rest, np.zeros(10)])
    return found[6:9]


@pytest.mark.parametrize("noise", [(0.0, 0.0), NOISE])
@pytest.mark.parametrize("seed", [0, 1, 2])
def test_the_fit_is_the_least_squares_solution(noise, seed):
    moments = np.arange(0, 0.32, 0.02)
    spin = tuple(np.random.default_rng(seed).uniform(-60, 60, 3))
    seen = samples(spin, moments, noise=noise, seed=seed)

    # What is summed along the nominal ball is summed once a sample, by the reference 200 times
    np.testing.assert_allclose(
        spin_found(seen, moments, noise), least_squares(seen, moments, noise), atol=0.5, rtol=0.01
    )


ACROSS = {
    "topspin": np.cross(FLYING, UP) / np.hypot(FLYING[0], FLYING[1]),
    "sidespin": np.array([0, 0, 1.0]),
}


@pytest.mark.parametrize("drag", [0.9, 1.0, 1.1])
@pytest.mark.parametrize("rate", [-50.0, 20.0, 50.0])
@pytest.mark.parametrize("axis", ACROSS)
def test_spin_across_the_flight_is_found_to_6_percent_without_noise(axis, rate, drag):
    """What drag does to a ball's way aside is in the model; the priors cost 2 % of it."""
    moments = np.arange(0, 0.32, 0.02)
    spin = rate * ACROSS[axis]

    assert np.dot(spin_found(samples(tuple(spin), moments, drag), moments), spin) == pytest.approx(
        rate**2, rel=0.06
    )


def test_spin_along_the_flight_hardly_shows_in_it():
    """Only as far as gravity turns the flight, and in the camera's noise not even that."""
    moments = np.arange(0, 0.22, 0.02)
    middle = samples((0.0, 0.0, 0.0), [0.1])[0, 3:]
    along = 60.0 * middle / np.linalg.norm(middle)
    seen = samples(tuple(along), moments)

    assert np.linalg.norm(spin_found(seen, moments)) < 0.6 * 60.0
    assert np.linalg.norm(spin_found(seen, moments, NOISE)) < 0.2 * 60.0


def test_lost_samples_take_away_from_the_estimate_and_dont_corrupt_it():
    moments = np.arange(0, 0.32, 0.02)
    seen = samples((20.0, -40.0, 30.0), moments)
    kept = np.array([0, 1, 4, 5, 6, 9, 15])

    np.testing.assert_allclose(spin_found(seen[kept], moments[kept]), spin_found(seen, moments), atol=4.0)


def test_a_sample_that_is_held_says_nothing_new():
    moments = np.arange(0, 0.22, 0.02)
    seen = samples((20.0, -40.0, 30.0), moments)
    held = np.repeat(np.arange(len(seen)), 3)

    np.testing.assert_array_equal(tracked(seen, moments), tracked(seen[held], moments[held]))


def test_before_the_second_sample_the_spin_is_taken_to_be_none():
    np.testing.assert_array_equal(spin_found(samples((90.0, 0.0, 0.0), [0.0]), [0.0]), 0.0)


def bounce_of(spin, vel=FLYING):
    """Return when and how the ball of ``samples`` meets the table: moment, position, velocity."""
    pos, vel, moment, what, _ = fly_to_touch(START, vel, spin, 2.0, 1.0, 1.0, SIMPLE, NO_ROBOT)
    assert what != 0
    return moment, pos, vel


@pytest.mark.parametrize("spin", [(5.0, -40.0, 20.0), (-50.0, 60.0, 0.0)])
def test_the_prior_behind_the_bounce_is_a_monte_carlos(spin):
    """Ten points stand for the spin's spread and the table's: mean and spread of 20,000 draws to a tenth."""
    moments = np.arange(0, 0.3, 0.02)
    track = tracked(samples(spin, moments, noise=NOISE), moments, NOISE)
    normal = track[FOUND + 10 : FOUND + 110].reshape(10, 10)
    normal = np.tril(normal) + np.tril(normal, -1).T
    variance = np.linalg.inv(normal)
    shown = SPIN_SIGMA * track[FLIGHT_SPIN]
    _, _, vel = bounce_of(spin)
    rng = np.random.default_rng(0)
    spins = rng.multivariate_normal(shown, SPIN_SIGMA**2 * variance[6:9, 6:9], 20_000)
    spins *= rng.normal(*FASTER, (20_000, 1))
    after = np.array(
        [
            np.concatenate(table_bounce(vel, tuple(turned), UP, restitution, friction))
            for turned, restitution, friction in zip(
                spins,
                rng.normal(0.975, 0.0144, 20_000),
                rng.normal(0.25, 0.029, 20_000),
                strict=True,
            )
        ]
    )
    covariance = np.empty((6, 6))
    expected = np.concatenate(prediction._through_bounce(vel, tuple(shown), *FASTER, variance, covariance))
    covariance -= np.diag([prediction.BOUNCE_SPEED_SIGMA**2] * 3 + [prediction.BOUNCE_SPIN_SIGMA**2] * 3)
    sigma = after.std(axis=0)

    assert (np.abs(expected - after.mean(axis=0)) < 0.1 * sigma).all()
    np.testing.assert_allclose(covariance / np.outer(sigma, sigma), np.corrcoef(after.T), atol=0.15)


def bounced(spin, vel=FLYING, factor_sigma=None, noise=(0.0, 0.0)):
    """Return the track 0.09 s behind the bounce, and the ball's spin there."""
    rng = np.random.default_rng(3)
    moment, place, falling = bounce_of(spin, vel)
    rising, turned = table_bounce(falling, spin, UP, 0.975, 0.25)
    moments = np.arange(0.0, moment, 0.02)
    track = tracked(samples(spin, moments, vel=vel, noise=noise), moments, noise)
    track[FACTOR_SIGMA] = track[FACTOR_SIGMA] if factor_sigma is None else factor_sigma
    for later in np.arange(0.01, 0.1, 0.02):
        seen = np.concatenate(flown(turned, later, place, rising)) + rng.normal(size=6) * np.repeat(noise, 3)
        follow(track, seen, moment + later, True, *noise)
    return track, turned


@pytest.mark.parametrize("along", [-50.0, 50.0])
def test_after_a_rolling_bounce_the_spin_in_the_tables_plane_is_known_even_what_the_flight_hid(along):
    """A ball that leaves without slip turns as fast as it goes: a spin along x, hidden till then, pushed it."""
    vel = (-3.0, 0.3, 1.0)
    spin = (along, -20.0, 10.0)
    moments = np.arange(0, 0.3, 0.02)
    hidden = spin_found(samples(spin, moments, vel=vel), moments)
    track, turned = bounced(spin, vel)
    predict(track, track[prediction.MOMENT])

    assert abs(hidden[0] - along) > 15.0
    assert np.abs(track[SPINNING] - turned)[:2].max() < 5.0


def test_the_meeting_is_where_the_ball_comes_to():
    """Without noise, an average table: from the flight alone to 2 cm, behind the bounce to 3 mm."""
    spin = (10.0, -45.0, 20.0)
    moment, place, vel = bounce_of(spin)
    vel, turned = table_bounce(vel, spin, UP, 0.975, 0.25)
    there, going = flown(turned, MEETING_AFTER, place, vel)
    moments = np.arange(0, moment, 0.02)
    before = tracked(samples(spin, moments), moments)
    predict(before, moments[-1] + 0.03)
    behind, _ = bounced(spin)
    predict(behind, moment + 0.08)

    assert np.linalg.norm(before[MET] - there) < 0.02
    assert before[MEETING] == pytest.approx(moment + MEETING_AFTER - moments[-1] - 0.03, abs=1e-3)
    assert np.linalg.norm(behind[MET] - there) < 0.003
    assert np.linalg.norm(behind[MET_GOING] - going) < 0.05
    assert behind[MEETING] == pytest.approx(MEETING_AFTER - 0.08, abs=1e-3)


def test_the_present_makes_up_for_latency_through_the_bounce_too():
    spin = (10.0, -45.0, 20.0)
    moment, place, vel = bounce_of(spin)
    vel, turned = table_bounce(vel, spin, UP, 0.975, 0.25)
    moments = np.arange(0, moment, 0.02)
    track = tracked(samples(spin, moments), moments)
    for now in (moments[-1] + 0.005, moment + 0.02):
        pos, going = flown(spin, now) if now < moment else flown(turned, now - moment, place, vel)
        predict(track, now)

        np.testing.assert_allclose(track[HERE], pos, atol=0.01)
        np.testing.assert_allclose(track[GOING], going, atol=0.3)


def test_a_bounce_that_was_not_foreseen_is_believed():
    """A net cord, say: the ball is suddenly elsewhere. The fit begins anew from what is seen."""
    moments = np.arange(0, 0.1, 0.02)
    track = tracked(samples((0.0, 0.0, 0.0), moments), moments)
    follow(track, np.array([-0.3, 0.5, 0.05, -2.0, 0.5, 2.0]), 0.12, True, *NOISE)
    predict(track, 0.12)

    np.testing.assert_allclose(track[HERE], [-0.3, 0.5, 0.05], atol=0.01)
    np.testing.assert_allclose(track[GOING], [-2.0, 0.5, 2.0], atol=1e-6)
    assert track[BOUNCED] == 1.0


def test_what_was_known_of_drag_before_the_bounce_is_known_behind_it_and_no_more():
    moments = np.arange(0, 0.3, 0.02)
    seen = samples((5.0, -40.0, 20.0), moments, drag=1.1, noise=NOISE)
    track = tracked(seen, moments, NOISE)
    normal = track[FOUND + 10 : FOUND + 110].reshape(10, 10)
    known = 1.0 / np.linalg.inv(np.tril(normal) + np.tril(normal, -1).T)[9, 9]
    moment, place, falling = bounce_of((5.0, -40.0, 20.0))
    rising, _ = table_bounce(falling, (5.0, -40.0, 20.0), UP, 0.975, 0.25)
    follow(track, np.array([*place, *rising]), moment + 1e-3, True, *NOISE)

    assert track[FOUND + 109] == pytest.approx(known, rel=0.01)


def test_of_a_lob_the_present_is_foretold_and_the_meeting_is_a_second_off():
    """It stays up for longer than anything is foretold."""
    lob = (-0.5, 0.1, 6.0)
    moments = np.arange(0, 0.1, 0.02)
    track = tracked(samples((0.0, 0.0, 0.0), moments, vel=lob), moments)
    predict(track, 0.12)
    here, going = flown((0.0, 0.0, 0.0), 0.12, vel=lob)

    np.testing.assert_allclose(track[HERE], here, atol=0.005)
    np.testing.assert_allclose(track[GOING], going, atol=0.03)
    there, _ = flown((0.0, 0.0, 0.0), 1.08, vel=lob)
    assert track[MEETING] == pytest.approx(0.96)
    np.testing.assert_allclose(track[MET], there, atol=0.02)


@pytest.mark.parametrize("vertical", [-3.0, 0.0, 2.0])
@pytest.mark.parametrize("height", [-0.1, 0.0, 0.3, 3.0])
def test_a_single_wild_sample_leads_to_no_wild_prediction(height, vertical):
    track = new_tracks(1)[0]
    begin_track(track, np.array([0.8, 0.3, height, -6.0, 0.0, vertical]), 0.0, *NOISE)
    follow(track, np.array([-5.0, 2.0, -1.0, 30.0, -20.0, 40.0]), 0.02, False, *NOISE)
    predict(track, 0.045)

    assert np.isfinite(track).all()
    assert np.abs(track[PRESENT:FORESEEN]).max() < 1500.0
    follow(track, np.array([0.5, 0.3, 0.1, -5.0, 0.0, 2.0]), 0.06, True, *NOISE)
    predict(track, 0.08)

    assert np.isfinite(track).all()
    assert 0.5 <= track[NOMINAL_DRAG] <= 1.5
    assert np.abs(track[PRESENT:FORESEEN]).max() < 1500.0


def make_env(count, noise="standard", preset="paper", first=0, deck=300, **observation) -> RallyEnv:
    block = draw_rallies(deck, seed=1, noise=noise, preset=preset)
    config = EnvConfig(noise=noise, foresee=0.0, go_on=0.0, observation=observation)
    env = RallyEnv(count, config, Deck(block, first))
    env.reset()
    return env


def hold(env: RallyEnv) -> np.ndarray:
    return np.tile(env.home_action, (env.count, 1))


def test_on_paper_balls_with_standard_noise_the_present_is_known_to_millimetres():
    """Medians over all steps up to the first hit. Measured: 3.7 mm, 0.06 m/s; samples are 126 mm and .27 m/s off."""
    env, errors = make_env(300), []
    in_play = np.ones(300, np.bool_)
    for _ in range(30):
        in_play[env.step(hold(env)).ended] = False
        rows = in_play & (env.rallies.seen[:, 6] <= 1) & (env.rallies.state < 4)
        errors.append(env.rallies.track[rows, PRESENT : PRESENT + 6] - env.rallies.ball[rows, :6])
    error = np.concatenate(errors)

    assert np.median(np.linalg.norm(error[:, :3], axis=1)) < 0.006
    assert np.median(np.linalg.norm(error[:, 3:], axis=1)) < 0.10


def test_on_paper_balls_the_spin_is_found_to_half_before_and_to_a_third_behind_the_bounce():
    """Root mean squares behind the bounce. Measured: 22, 16, 17 of 41, 44, 45 rad/s; 80 ms later 7, 9, 12."""
    first, later = spin_errors(make_env(300))

    assert (first < [30, 25, 25]).all()
    assert (later < [10, 13, 16]).all()


def test_who_expects_what_comes_is_nearest_to_it_and_who_expects_either_is_near_to_both():
    """80 ms behind the bounce. Measured, as strong, mixed and mild spin was expected: of `strong` balls 20, 27, 42;
    23, 35, 49; 53, 72, 90 rad/s; of `paper` balls 21, 46, 55; 11, 22, 28; 6, 9, 11."""
    errors = {
        (preset, expected): spin_errors(make_env(300, preset=preset, spin_expected=expected))[1]
        for preset in ("paper", "strong")
        for expected in ("mild", "mixed", "strong")
    }

    for own, other in (("strong", "mild"), ("mild", "strong")):
        preset = "paper" if own == "mild" else own
        assert (errors[preset, own] < 0.6 * errors[preset, other]).all()
        assert (errors[preset, "mixed"] < 0.7 * errors[preset, other]).all()


@pytest.mark.parametrize(("preset", "own"), [("paper", "mild"), ("strong", "strong")])
def test_the_other_side_becomes_known_from_ball_to_ball(preset, own):
    """How likely a mild ball is thought to be. Measured: .8 of the first one, .92 and .33 of the second, then .98
    and .12, .99 and .06, .99 and .04.
    """
    env = make_env(60, preset=preset, deck=900, spin_expected="learnt")
    beliefs, balls = [], np.zeros(60, int)
    for _ in range(220):
        before = env.rallies.clock.copy()
        env.step(hold(env))
        began = env.rallies.clock < before
        balls[began] += 1
        beliefs.append(np.where(began & (balls == 3), env.rallies.track[:, prediction.MILD], np.nan))
    fourth = np.nanmean(beliefs)

    assert (balls >= 3).all()
    assert fourth > 0.9 if own == "mild" else fourth < 0.15
    env.reset()
    np.testing.assert_array_equal(env.rallies.track[:, prediction.MILD], 0.8)


def test_every_expectation_is_in_the_table():
    assert set(EXPECTED) == set(get_args(Expectation))
    assert all(0.0 <= mild <= 1.0 and 0.0 < renewed <= 1.0 for mild, renewed in EXPECTED.values())


def test_the_guess_a_fit_begins_with_behind_the_bounce_isnt_taken_for_evidence():
    """However tight it is: with what it says taken out of the fit, what the bounce did is the samples' to say."""
    tight, wide = (bounced((60.0, -45.0, 20.0), factor_sigma=sigma, noise=NOISE)[0] for sigma in (0.05, 3.0))

    assert np.abs(tight[FOUND + 3 : FOUND + 5] - wide[FOUND + 3 : FOUND + 5]).max() > 0.02  # the fits differ
    np.testing.assert_allclose(tight[SPINNING], wide[SPINNING], atol=2.0)


def test_who_learns_nothing_expects_the_same_of_every_ball():
    env = make_env(20, preset="strong", deck=300, spin_expected="mixed")
    for _ in range(120):
        env.step(hold(env))

        np.testing.assert_array_equal(env.rallies.track[:, prediction.MILD], 0.5)


def spin_errors(env: RallyEnv) -> tuple[np.ndarray, np.ndarray]:
    """Return root mean squares a axis [rad/s] as the bounce is seen, and 80 ms later."""
    found = {False: [], True: []}
    in_play = np.ones(300, np.bool_)
    since = np.zeros(300)
    for _ in range(45):
        in_play[env.step(hold(env)).ended] = False
        after = in_play & (env.rallies.state >= 2) & (env.rallies.state < 4)
        first = after & (since == 0.0)
        since[after] += 0.02
        for rows, is_late in ((first, False), (after & (np.abs(since - 0.1) < 1e-6), True)):
            found[is_late].append(env.rallies.track[rows, SPIN : SPIN + 3] - env.rallies.ball[rows, 6:9])
    first, later = (np.sqrt((np.concatenate(found[is_late]) ** 2).mean(axis=0)) for is_late in (False, True))
    return first, later


def test_the_prediction_is_a_function_of_the_rally_alone():
    batch, alone = make_env(6), [make_env(1, first=b) for b in range(6)]
    for _ in range(12):
        for env in (batch, *alone):
            env.step(hold(env))

    for b, env in enumerate(alone):
        np.testing.assert_array_equal(env.rallies.track[0], batch.rallies.track[b])


@pytest.mark.parametrize(
    ("noise", "preset"), [("off", "paper"), ("hard", "paper"), ("hard", "match"), ("hard", "strong")]
)
def test_the_prediction_is_finite_whatever_is_played(noise, preset):
    env = make_env(100, noise, preset)
    for _ in range(60):
        obs = env.step(hold(env)).obs

        assert np.isfinite(env.rallies.track).all()
        assert np.isfinite(obs).all()
        assert np.abs(env.rallies.track[:, SPINNING]).max() < 1500.0  # the observation's stated range


def test_who_is_told_neither_spin_nor_prediction_keeps_no_track():
    config = EnvConfig()
    told = {"spin": "hidden", "prediction": False}
    hidden = config.model_copy(update={"observation": config.observation.model_copy(update=told)})

    assert RallyEnv(2, hidden, Deck(draw_rallies(8, seed=1))).rallies.track.shape == (0, TRACK)
