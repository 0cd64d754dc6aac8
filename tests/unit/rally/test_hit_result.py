"""The result of a hit and its derivatives, each against a slow reference."""

import numpy as np
import pytest

from common.physics.flight import SIMPLE
from common.rally.hit_correction import GOALS, JOINT_POS, JOINT_VEL, PACE, PLACE_WEIGHT, hit_sensitivity
from common.robot.chain_of import chain_of
from common.task.randomization import air_of, rubber_of
from tests.unit.rally.hits import flown, make_hit, make_parameters, result_of

CHAIN = chain_of("rails")


@pytest.mark.parametrize("seed", range(6))
def test_a_hits_result_is_that_of_small_steps(seed):
    hit, parameters = make_hit(seed), make_parameters(seed)
    result = result_of(hit, parameters) / [1, 1, PLACE_WEIGHT, PLACE_WEIGHT, 1, PACE]

    np.testing.assert_allclose(result, flown(hit, parameters), atol=0.004)  # the reference's own step: 3 mm


@pytest.mark.parametrize("off", [-0.004, 0.004])
@pytest.mark.parametrize("seed", range(6))
def test_the_contact_is_shifted_to_the_time_at_which_ball_and_racket_meet(seed, off):
    """One step along the first velocities. A racket that turns during it causes a small error."""
    hit, parameters = make_hit(seed, off=off), make_parameters(seed)
    result = result_of(hit, parameters) / [1, 1, PLACE_WEIGHT, PLACE_WEIGHT, 1, PACE]

    np.testing.assert_allclose(result, flown(hit, parameters), atol=0.008)


@pytest.mark.parametrize("seed", range(6))
def test_the_sensitivities_agree_with_central_differences(seed):
    hit, parameters = make_hit(seed), make_parameters(seed)
    by_pos, by_vel = np.empty((GOALS, 7)), np.empty((GOALS, 7))
    result = hit_sensitivity(CHAIN, hit, rubber_of(parameters), air_of(parameters, SIMPLE), by_pos, by_vel)
    central = np.empty((2, GOALS, 7))
    for which, (column, step) in enumerate(((JOINT_POS, 2e-4), (JOINT_VEL, 2e-3))):
        for joint in range(7):
            sides = []
            for sign in (1, -1):
                moved = hit.copy()
                moved[column + joint] += sign * step
                sides.append(result_of(moved, parameters))
            central[which, :, joint] = (sides[0] - sides[1]) / (2 * step)

    np.testing.assert_array_equal(result, result_of(hit, parameters))
    for found, expected in zip((by_pos, by_vel), central, strict=True):
        scale = np.abs(expected).max(axis=1, keepdims=True)
        # forward differences have an error of first order: 0.08 % measured
        assert (np.abs(found - expected) <= 0.002 * scale + 1e-9).all()
