"""The least change of the last actions, against a solution by numpy, and which hits are corrected."""

import numpy as np
import pytest

from common.physics.flight import SIMPLE
from common.rally.hit_correction import (
    BACK,
    BALL_POS,
    BALL_SPIN,
    BALL_VEL,
    BOUNCE,
    CONTACT,
    FRESH,
    GOALS,
    JOINT_POS,
    JOINT_VEL,
    LARGEST_MISS,
    LARGEST_SHORTFALL,
    LEFT_POS,
    LEFT_SPIN,
    LEFT_VEL,
    LEVENBERG,
    MARGIN,
    MOMENT,
    SOONEST,
    TRUST,
    DriveHistories,
    back_through_drives,
    corrections,
    hit_sensitivity,
    least_change,
)
from common.robot.chain_of import chain_of
from common.task.landing_point import landing_and_clearance
from common.task.randomization import RallyParameter, air_of, rubber_of
from tests.unit.rally.hits import DRIVES, FRICTION, SUBSTEPS, H, history_of, leave, make_hit, make_parameters

CHAIN = chain_of("rails")


@pytest.mark.parametrize("met", [[], [4], [4, 5]])
def test_the_least_change_is_the_ridge_solution_and_a_large_one_counts_less(met):
    """Goals that are already met are rows of zeros and do not count."""
    rng = np.random.default_rng(len(met))
    sensitivity, wanted = rng.normal(size=(GOALS, BACK, 7)), 0.3 * rng.normal(size=GOALS)
    sensitivity[met], wanted[met] = 0.0, 0.0
    out = np.empty((BACK, 7))
    is_good = least_change(sensitivity, wanted, out)
    left = [goal for goal in range(GOALS) if goal not in met]
    flat, want = sensitivity[left].reshape(len(left), -1), wanted[left]
    expected = flat.T @ np.linalg.solve(flat @ flat.T + LEVENBERG * np.eye(len(left)), want)

    def cost(change):
        return ((flat @ change - want) ** 2).sum() + LEVENBERG * (change**2).sum()

    assert is_good
    np.testing.assert_allclose(out.ravel(), expected / (1.0 + expected @ expected / TRUST**2), atol=1e-12)
    others = expected + 0.02 * rng.normal(size=(200, BACK * 7))
    assert all(cost(other) > cost(expected) for other in others)
    # it has the least norm: no part of it leaves the result unchanged
    useless = expected - flat.T @ np.linalg.lstsq(flat.T, expected)[0]
    assert np.abs(useless).max() < 1e-12


def test_no_change_is_larger_than_half_of_trust():
    rng = np.random.default_rng(0)
    out = np.empty((BACK, 7))

    for size in (0.1, 1.0, 10.0, 100.0):
        assert least_change(rng.normal(size=(GOALS, BACK, 7)), np.full(GOALS, size), out)
        assert np.linalg.norm(out) <= 0.5 * TRUST + 1e-12


def corrected(hits, parameters=None) -> tuple[np.ndarray, np.ndarray]:
    """Return corrections (B, BACK, 7), 7 where nothing was written, and how far back they reach (B,)."""
    count = len(hits)
    if parameters is None:
        parameters = np.array([make_parameters(b) for b in range(count)])
    out, steps = np.full((count, BACK, 7), 7.0), np.full(count, -1)
    limited = np.zeros((count, BACK, SUBSTEPS, 7), np.int8)
    losses = np.broadcast_to(FRICTION, limited.shape).astype(np.float32)
    corrections(CHAIN, hits, parameters, SIMPLE, DriveHistories(limited, losses, 3, DRIVES, H), out, steps)
    return out, steps


def test_a_fresh_hit_is_corrected_as_far_back_as_the_ring_reaches():
    found, steps = corrected(np.array([make_hit(b) for b in range(6)]))

    np.testing.assert_array_equal(steps, BACK)
    assert np.isfinite(found).all()
    assert (np.abs(found).max(axis=(1, 2)) > 1e-3).all()
    assert np.linalg.norm(found, axis=(1, 2)).max() <= 0.5 * TRUST + 1e-12


def test_without_a_fresh_hit_there_is_no_correction():
    hits = np.array([make_hit(b) for b in range(3)])
    hits[1, FRESH] = 0.0
    found, steps = corrected(hits)

    np.testing.assert_array_equal(steps, [BACK, 0, BACK])
    assert (found[1] == 7.0).all()


def test_a_correction_reaches_back_to_the_rallys_beginning_at_most():
    found, steps = corrected(np.array([make_hit(step=0), make_hit(step=4), make_hit(step=BACK)]))

    np.testing.assert_array_equal(steps, [1, 5, BACK])
    np.testing.assert_array_equal(found[0, 1:], 0.0)
    np.testing.assert_array_equal(found[1, 5:], 0.0)


@pytest.mark.parametrize("wrong", [np.nan, np.inf, -np.inf, 1e200])
@pytest.mark.parametrize(
    "column", [LEFT_VEL, BALL_POS, BALL_VEL + 1, BALL_SPIN + 2, JOINT_POS + 3, JOINT_VEL + 6]
)
def test_a_number_that_is_not_finite_never_reaches_a_correction(column, wrong):
    hits = np.array([make_hit(0), make_hit(1), make_hit(2)])
    whole, _ = corrected(hits)
    hits[1, column] = wrong
    found, steps = corrected(hits)

    assert np.isfinite(found).all()
    assert np.abs(found[steps > 0]).max() <= TRUST
    np.testing.assert_array_equal(found[[0, 2]], whole[[0, 2]])


def test_a_correction_depends_on_the_ball_that_left_and_not_on_our_contact_law():
    """A ball that left for a point 0.2 m farther is corrected as if the target were 0.2 m nearer."""
    hit, parameters = make_hit(0), make_parameters(0)
    parameters[[RallyParameter.TARGET_X, RallyParameter.TARGET_Y]] = 0.8, 0.0
    nearer = parameters.copy()
    nearer[RallyParameter.TARGET_X] -= 0.2
    left = hit.copy()
    for _ in range(20):  # iteration to the speed of that landing point
        x, y, _ = landing_of(left, parameters)
        left[LEFT_VEL] += 2.0 * (landing_of(hit, parameters)[0] + 0.2 - x)
    (far, _), _ = corrected(np.array([left, hit]), np.array([parameters, parameters]))
    (short, _), _ = corrected(np.array([hit, hit]), np.array([nearer, nearer]))

    assert y == pytest.approx(landing_of(hit, parameters)[1], abs=0.01)
    np.testing.assert_allclose(far, short, atol=1e-3)  # the faster ball is also a little higher over the net
    assert np.abs(far).max() > 0.01


def landing_of(hit, parameters):
    left = (tuple(hit[at : at + 3]) for at in (LEFT_POS, LEFT_VEL, LEFT_SPIN))
    return landing_and_clearance(*left, air_of(parameters, SIMPLE))


def test_only_a_contact_too_soon_after_the_bounce_is_delayed():
    late, soon, parameters = make_hit(0), make_hit(0), make_parameters(0)
    soon[CONTACT] = soon[BOUNCE] + SOONEST - 0.02
    (unchanged, delayed), _ = corrected(np.array([late, soon]), np.array([parameters, parameters]))
    by_pos, by_vel, later = np.empty((GOALS, 7)), np.empty((GOALS, 7)), np.empty((BACK, 7))
    hit_sensitivity(CHAIN, soon, rubber_of(parameters), air_of(parameters, SIMPLE), by_pos, by_vel)
    back_through_drives(by_pos[5], by_vel[5], soon[MOMENT], history_of(), later)

    assert (later * delayed).sum() > 0.0
    assert (later * delayed).sum() > (later * unchanged).sum()


@pytest.mark.parametrize(("faster", "is_low"), [(0.0, True), (6.0, False)])
@pytest.mark.parametrize("seed", [0, 2, 3])  # with 1 the racket points down too much to clear the net
def test_the_goals_are_target_racket_centre_and_height_over_the_net_if_too_low(seed, faster, is_low):
    hit, parameters = make_hit(seed), make_parameters(seed)
    hit[JOINT_VEL] += faster  # the rail towards the net
    leave(hit, parameters)
    by_pos, by_vel, changes = np.empty((GOALS, 7)), np.empty((GOALS, 7)), np.empty((GOALS, BACK, 7))
    x, y, side, up, over, _ = hit_sensitivity(
        CHAIN, hit, rubber_of(parameters), air_of(parameters, SIMPLE), by_pos, by_vel
    )
    history = history_of(late=round(parameters[RallyParameter.ACTION_LATENCY] / H))
    for goal in range(GOALS):
        back_through_drives(by_pos[goal], by_vel[goal], hit[MOMENT], history, changes[goal])
    target = np.clip(
        parameters[[RallyParameter.TARGET_X, RallyParameter.TARGET_Y]],
        [0.40, 0.30 - 0.7625],
        [1.37 - 0.30, 0.7625 - 0.30],
    )
    miss = target - [x, y]
    miss *= min(1.0, LARGEST_MISS / np.linalg.norm(miss))
    wanted = np.array([*miss, -side, -up, min(MARGIN - over, LARGEST_SHORTFALL)])
    goals = 5 if is_low else 4
    flat = changes[:goals].reshape(goals, -1)
    expected = flat.T @ np.linalg.solve(flat @ flat.T + LEVENBERG * np.eye(goals), wanted[:goals])
    found, _ = corrected(hit[None], parameters[None])

    assert (over < MARGIN) == is_low
    np.testing.assert_allclose(found[0].ravel(), expected / (1.0 + expected @ expected / TRUST**2), atol=1e-9)
    if is_low:
        assert (changes[4] * found[0]).sum() > 0
