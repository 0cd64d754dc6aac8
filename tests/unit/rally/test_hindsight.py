"""Corrections: the result of a hit, its derivatives and the least change, each against a slow reference."""

import numpy as np
import pytest

from common.physics.arm import point_velocity, racket_motion, racket_pose
from common.physics.constants import BALL_RADIUS, NET_HEIGHT, TABLE_HALF_LENGTH, TABLE_HALF_WIDTH
from common.physics.flight import SIMPLE, flight_step
from common.physics.racket_bounce import racket_bounce
from common.physics.touch import racket_gap
from common.rally.hindsight import (
    BACK,
    BALL_POS,
    BALL_SPIN,
    BALL_VEL,
    BOUNCE,
    CONTACT,
    EDGE,
    FRESH,
    GOALS,
    HIT,
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
    NEAREST,
    PACE,
    PLACE_WEIGHT,
    SOONEST,
    STEP,
    TRUST,
    back_through_drives,
    corrections,
    flies_to,
    hit_result,
    hit_sensitivity,
    least_change,
    note_leaving,
)
from common.rally.noise import CONDITIONS, PROFILES, Condition, draw_conditions
from tests.unit.rally.scripted import HOME

SUBSTEPS, H = 5, 0.004
# inertia, k_p, k_v, joint damping, half-range: some like the robot's
DRIVES = np.array(
    [
        [12.0, 10.0, 0.5, 0.4, 0.2, 0.02, 0.001],
        [8000.0, 5000.0, 200.0, 500.0, 200.0, 80.0, 40.0],
        [600.0, 400.0, 8.0, 20.0, 8.0, 3.0, 1.5],
        [60.0, 90.0, 1.6, 1.6, 0.8, 0.4, 0.2],
        [0.5, 0.9, 2.9, 1.7, 2.4, 2.1, 2.9],
    ]
)


def make_condition(seed=0) -> np.ndarray:
    condition = np.empty(CONDITIONS)
    draw_conditions(np.uint64(seed), 1.0, 1.0, PROFILES["standard"], condition)
    return condition


def make_hit(seed=0, step=30, off=0.0) -> np.ndarray:
    """Return a stroke (HIT,) that sends the ball towards the opponent's court, ``off`` [m] before they meet."""
    rng = np.random.default_rng(seed)
    q = np.array(HOME) + 0.05 * rng.uniform(-1, 1, 7)
    q[5] -= 0.15  # the face looks up a little
    rates = np.array([1.5, 0.2, 0.3, 1.0, 1.0, 2.0, 0.5]) * rng.uniform(0.5, 1.0, 7)
    pose = racket_pose(tuple(q))
    place = 0.03 * rng.uniform(-1, 1, 2)
    hit = np.zeros(HIT)
    hit[BALL_POS : BALL_POS + 3] = (
        np.array(pose.centre)
        + (0.0065 + BALL_RADIUS + off) * np.array(pose.normal)
        + place[0] * np.array(pose.side)
        + place[1] * np.array(pose.up)
    )
    hit[BALL_VEL : BALL_VEL + 3] = rng.uniform([-4, -0.5, -1], [-2.5, 0.5, 1])
    hit[BALL_SPIN : BALL_SPIN + 3] = rng.uniform(-60, 60, 3)
    hit[JOINT_POS : JOINT_POS + 7], hit[JOINT_VEL : JOINT_VEL + 7] = q, rates
    hit[MOMENT], hit[STEP], hit[FRESH] = 0.0133, step, 1.0
    hit[BOUNCE], hit[CONTACT] = 0.2, 0.4
    leave(hit, make_condition(seed))
    return hit


def leave(hit, condition) -> None:
    """Write the ball as it leaves by our racket's law."""
    pos, vel, spin, _, _ = bounced(hit, condition)
    note_leaving(hit, pos, vel, spin)


def result_of(hit, condition) -> np.ndarray:
    parts = [tuple(hit[a:b]) for a, b in ((9, 16), (16, 23), (0, 3), (3, 6), (6, 9))]
    return np.array(hit_result(*parts, condition, SIMPLE))


def bounced(hit, condition) -> tuple:
    """Return the ball as it leaves, its place on the racket (2) and the contact's delay, slowly."""
    q, qd = hit[JOINT_POS : JOINT_POS + 7].copy(), tuple(hit[JOINT_VEL : JOINT_VEL + 7])
    pos, vel, spin = (hit[k : k + 3].copy() for k in (BALL_POS, BALL_VEL, BALL_SPIN))
    # Both move on evenly until they meet: bisection in time
    low, high = -0.003, 0.003
    for _ in range(60):
        middle = 0.5 * (low + high)
        gap, _ = racket_gap(tuple(pos + middle * vel), racket_pose(tuple(q + middle * np.array(qd))))
        low, high = (middle, high) if gap > 0 else (low, middle)
    q, pos = q + low * np.array(qd), pos + low * vel
    pose = racket_pose(tuple(q))
    _, normal = racket_gap(tuple(pos), pose)
    racket_vel, racket_spin = racket_motion(tuple(q), qd)
    surface_vel = point_velocity(
        pose.centre, racket_vel, racket_spin, tuple(pos - BALL_RADIUS * np.array(normal))
    )
    place = [np.dot(pos - pose.centre, axis) for axis in (pose.side, pose.up)]
    v, w = racket_bounce(tuple(vel), tuple(spin), normal, surface_vel, *condition[4:8], np.inf)
    return tuple(pos), v, w, place, low


def flown(hit, condition) -> np.ndarray:
    """Return a hit's landing x, y, place on the racket (2), height over the net and delay, slowly."""
    p, v, w, place, later = bounced(hit, condition)
    landing, over, is_down = (np.nan, np.nan), -1.0, False
    for _ in range(6000):
        before = p
        p, v = flight_step(p, v, w, 0.0005, condition[0], condition[1], SIMPLE)
        if before[0] < 0 <= p[0]:
            over = p[2] - NET_HEIGHT - BALL_RADIUS
        if not is_down and p[2] < BALL_RADIUS and v[2] < 0:
            landing, is_down = p[:2], True
        if is_down and (p[0] > 0 or p[2] < -0.7):
            break
    return np.array([*landing, *place, over, later])


@pytest.mark.parametrize("seed", range(6))
def test_a_hits_result_is_what_small_steps_come_to(seed):
    hit, condition = make_hit(seed), make_condition(seed)
    result = result_of(hit, condition) / [1, 1, PLACE_WEIGHT, PLACE_WEIGHT, 1, PACE]

    np.testing.assert_allclose(result, flown(hit, condition), atol=0.004)  # the reference's own step: 3 mm


@pytest.mark.parametrize("off", [-0.004, 0.004])
@pytest.mark.parametrize("seed", range(6))
def test_a_ball_a_little_off_the_racket_is_taken_to_where_they_meet(seed, off):
    """Once, along both velocities at first: a racket that turns meanwhile costs a little."""
    hit, condition = make_hit(seed, off=off), make_condition(seed)
    result = result_of(hit, condition) / [1, 1, PLACE_WEIGHT, PLACE_WEIGHT, 1, PACE]

    np.testing.assert_allclose(result, flown(hit, condition), atol=0.008)


@pytest.mark.parametrize("seed", range(6))
def test_the_sensitivities_are_central_differences(seed):
    hit, condition = make_hit(seed), make_condition(seed)
    by_pos, by_vel = np.empty((GOALS, 7)), np.empty((GOALS, 7))
    result = hit_sensitivity(hit, condition, SIMPLE, by_pos, by_vel)
    central = np.empty((2, GOALS, 7))
    for which, (column, step) in enumerate(((JOINT_POS, 2e-4), (JOINT_VEL, 2e-3))):
        for joint in range(7):
            sides = []
            for sign in (1, -1):
                moved = hit.copy()
                moved[column + joint] += sign * step
                sides.append(result_of(moved, condition))
            central[which, :, joint] = (sides[0] - sides[1]) / (2 * step)

    np.testing.assert_array_equal(result, result_of(hit, condition))
    for found, expected in zip((by_pos, by_vel), central, strict=True):
        scale = np.abs(expected).max(axis=1, keepdims=True)
        assert (
            np.abs(found - expected) <= 0.002 * scale + 1e-9
        ).all()  # forward: first order; measured 0.08 %


def driven(targets, joint, limited, late, moment, held=0.0) -> tuple[float, float]:
    """Return a joint's position and velocity at ``moment`` of the last control step; targets (steps,) in [-1, 1].

    A drive at its limit pushes with a constant force, whatever its target.
    """
    inertia, stiffness, damping, friction, half_range = DRIVES[:, joint]
    told = np.repeat(targets, SUBSTEPS) * half_range
    acting = np.concatenate([np.full(late, held), told])
    q, v = 0.1, -0.3
    last = int(moment / H)
    for n in range((len(targets) - 1) * SUBSTEPS + last + 1):
        before = q
        if limited[n]:
            v = (inertia * v + H * 2.0) / (inertia + H * friction)
        else:
            v = (inertia * v + H * stiffness * (acting[n] - q)) / (inertia + H * (friction + damping))
        q += H * v
    return before + (moment - last * H) * v, v


@pytest.mark.parametrize("late", [0, 2, 5, 7])
@pytest.mark.parametrize("limited_share", [0.0, 0.3])
@pytest.mark.parametrize("moment", [0.0005, 0.0133, 0.02])
def test_the_recursion_back_through_the_drives_is_the_derivative_of_their_simulation(
    late, limited_share, moment
):
    """Also where the latency is longer than a control step."""
    rng = np.random.default_rng(0)
    targets = rng.uniform(-1, 1, (BACK, 7))
    limited = rng.uniform(size=(BACK, SUBSTEPS, 7)) < limited_share
    by_pos, by_vel, newest = rng.normal(size=7), rng.normal(size=7), 4
    ring = np.roll(limited, newest + 1, axis=0)
    out = np.empty((BACK, 7))
    back_through_drives(by_pos, by_vel, moment, ring, newest, BACK, late, DRIVES, H, out)
    expected = np.empty((BACK, 7))
    for joint in range(7):
        flags = limited[:, :, joint].ravel()
        for back in range(BACK):
            ends = []
            for change in (0.5, -0.5):  # the drives are linear: any step will do
                told = targets[:, joint].copy()
                told[BACK - 1 - back] += change
                ends.append(
                    np.dot(
                        [by_pos[joint], by_vel[joint]],
                        driven(told, joint, flags, late, min(moment, 0.0199999)),
                    )
                )
            expected[back, joint] = ends[0] - ends[1]

    np.testing.assert_allclose(out, expected, atol=1e-3 * np.abs(expected).max())


def test_a_drive_at_its_limit_feels_no_target():
    limited = np.zeros((BACK, SUBSTEPS, 7), np.bool_)
    limited[:, :, 2] = True
    out = np.empty((BACK, 7))
    back_through_drives(np.ones(7), np.ones(7), 0.0133, limited, 0, BACK, 0, DRIVES, H, out)

    assert (out[:, 2] == 0.0).all()
    assert (np.abs(out[:, [0, 1, 3, 4, 5, 6]]).max(axis=0) > 0).all()


@pytest.mark.parametrize("late", [0, 3])
def test_the_recursion_ends_where_the_rally_begins(late):
    limited = np.zeros((BACK, SUBSTEPS, 7), np.bool_)
    whole, cut = np.empty((BACK, 7)), np.empty((BACK, 7))
    back_through_drives(np.ones(7), np.ones(7), 0.0133, limited, 0, BACK, late, DRIVES, H, whole)
    back_through_drives(np.ones(7), np.ones(7), 0.0133, limited, 0, 4, late, DRIVES, H, cut)

    np.testing.assert_array_equal(cut[:4], whole[:4])
    np.testing.assert_array_equal(cut[4:], 0.0)


@pytest.mark.parametrize("met", [[], [4], [4, 5]])
def test_the_least_change_is_the_ridge_solution_and_a_large_one_counts_less(met):
    """Goals that are met already are rows of zeros, and don't count."""
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
    # of least norm: nothing in it leaves the result as it is
    beside = expected - flat.T @ np.linalg.lstsq(flat.T, expected)[0]
    assert np.abs(beside).max() < 1e-12


def test_no_change_is_larger_than_half_the_trust():
    rng = np.random.default_rng(0)
    out = np.empty((BACK, 7))

    for size in (0.1, 1.0, 10.0, 100.0):
        assert least_change(rng.normal(size=(GOALS, BACK, 7)), np.full(GOALS, size), out)
        assert np.linalg.norm(out) <= 0.5 * TRUST + 1e-12


def corrected(hits, conditions=None) -> tuple[np.ndarray, np.ndarray]:
    """Return corrections (B, BACK, 7), 7 where nothing was written, and how far back they reach (B,)."""
    count = len(hits)
    if conditions is None:
        conditions = np.array([make_condition(b) for b in range(count)])
    out, steps = np.full((count, BACK, 7), 7.0), np.full(count, -1)
    limited = np.zeros((count, BACK, SUBSTEPS, 7), np.bool_)
    corrections(hits, conditions, SIMPLE, limited, 3, DRIVES, H, out, steps)
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
def test_what_isnt_finite_never_leaves(column, wrong):
    hits = np.array([make_hit(0), make_hit(1), make_hit(2)])
    whole, _ = corrected(hits)
    hits[1, column] = wrong
    found, steps = corrected(hits)

    assert np.isfinite(found).all()
    assert np.abs(found[steps > 0]).max() <= TRUST
    np.testing.assert_array_equal(found[[0, 2]], whole[[0, 2]])


def test_a_correction_goes_by_where_the_ball_went_whatever_our_racket_would_have_done():
    """A ball that left as if it should land .2 m farther: as if the target were .2 m nearer."""
    hit, condition = make_hit(0), make_condition(0)
    condition[[Condition.TARGET_X, Condition.TARGET_Y]] = 0.8, 0.0
    nearer = condition.copy()
    nearer[Condition.TARGET_X] -= 0.2
    left = hit.copy()
    for _ in range(20):  # Newton's way to the speed that does it
        x, y, _ = landing_of(left, condition)
        left[LEFT_VEL] += 2.0 * (landing_of(hit, condition)[0] + 0.2 - x)
    (far, _), _ = corrected(np.array([left, hit]), np.array([condition, condition]))
    (short, _), _ = corrected(np.array([hit, hit]), np.array([nearer, nearer]))

    assert y == pytest.approx(landing_of(hit, condition)[1], abs=0.01)
    np.testing.assert_allclose(far, short, atol=1e-3)  # the faster ball is a little higher over the net, too
    assert np.abs(far).max() > 0.01


def landing_of(hit, condition):
    left = (tuple(hit[at : at + 3]) for at in (LEFT_POS, LEFT_VEL, LEFT_SPIN))
    return flies_to(*left, condition, SIMPLE)


def test_a_contact_too_soon_after_the_bounce_is_to_come_later_and_only_that():
    late, soon, condition = make_hit(0), make_hit(0), make_condition(0)
    soon[CONTACT] = soon[BOUNCE] + SOONEST - 0.02
    (as_it_was, delayed), _ = corrected(np.array([late, soon]), np.array([condition, condition]))
    by_pos, by_vel, later = np.empty((GOALS, 7)), np.empty((GOALS, 7)), np.empty((BACK, 7))
    hit_sensitivity(soon, condition, SIMPLE, by_pos, by_vel)
    free = np.zeros((BACK, SUBSTEPS, 7), np.bool_)
    back_through_drives(by_pos[5], by_vel[5], soon[MOMENT], free, 3, BACK, 0, DRIVES, H, later)

    assert (later * delayed).sum() > 0.0
    assert (later * delayed).sum() > (later * as_it_was).sum()


@pytest.mark.parametrize(("faster", "is_low"), [(0.0, True), (6.0, False)])
@pytest.mark.parametrize("seed", [0, 2, 3])  # 1 looks down too much to clear the net
def test_a_correction_asks_for_target_centre_and_where_it_lacks_height_over_the_net(seed, faster, is_low):
    hit, condition = make_hit(seed), make_condition(seed)
    hit[JOINT_VEL] += faster  # the rail towards the net
    leave(hit, condition)
    by_pos, by_vel, changes = np.empty((GOALS, 7)), np.empty((GOALS, 7)), np.empty((GOALS, BACK, 7))
    x, y, side, up, over, _ = hit_sensitivity(hit, condition, SIMPLE, by_pos, by_vel)
    free, late = np.zeros((BACK, SUBSTEPS, 7), np.bool_), round(condition[Condition.ACTION_LATENCY] / H)
    for goal in range(GOALS):
        back_through_drives(
            by_pos[goal], by_vel[goal], hit[MOMENT], free, 3, BACK, late, DRIVES, H, changes[goal]
        )
    target = np.clip(
        condition[[Condition.TARGET_X, Condition.TARGET_Y]],
        [NEAREST, EDGE - TABLE_HALF_WIDTH],
        [TABLE_HALF_LENGTH - EDGE, TABLE_HALF_WIDTH - EDGE],
    )
    miss = target - [x, y]
    miss *= min(1.0, LARGEST_MISS / np.linalg.norm(miss))
    wanted = np.array([*miss, -side, -up, min(MARGIN - over, LARGEST_SHORTFALL)])
    goals = 5 if is_low else 4
    flat = changes[:goals].reshape(goals, -1)
    expected = flat.T @ np.linalg.solve(flat @ flat.T + LEVENBERG * np.eye(goals), wanted[:goals])
    found, _ = corrected(hit[None], condition[None])

    assert (over < MARGIN) == is_low
    np.testing.assert_allclose(found[0].ravel(), expected / (1.0 + expected @ expected / TRUST**2), atol=1e-9)
    if is_low:
        assert (changes[4] * found[0]).sum() > 0
