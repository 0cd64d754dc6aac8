"""The recursion from a contact back through the drives, against a simulation of the drives."""

import numpy as np
import pytest

from common.rally.hit_correction import BACK, back_through_drives
from tests.unit.rally.hits import DRIVES, FRICTION, SUBSTEPS, H, history_of


def driven(targets, joint, limited, late, moment, held=0.0) -> tuple[float, float]:
    """Return a joint's position and velocity at ``moment`` of the last control step; targets (steps,) in [-1, 1].

    A drive at its force limit (1) pushes with a constant force, one at its voltage limit (2) with one that falls with
    the speed. Its target has no effect.
    """
    inertia, stiffness, damping, half_range, back_emf = DRIVES[:, joint]
    friction = FRICTION[joint]
    given = np.repeat(targets, SUBSTEPS) * half_range
    acting = np.concatenate([np.full(late, held), given])
    q, v = 0.1, -0.3
    last = int(moment / H)
    for n in range((len(targets) - 1) * SUBSTEPS + last + 1):
        before = q
        if limited[n]:
            falling = back_emf if limited[n] == 2 else 0.0
            v = (inertia * v + H * 2.0) / (inertia + H * (friction + falling))
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
    """Also for a latency that is longer than a control step."""
    rng = np.random.default_rng(0)
    targets = rng.uniform(-1, 1, (BACK, 7))
    is_limited = rng.uniform(size=(BACK, SUBSTEPS, 7)) < limited_share
    limited = np.where(is_limited, rng.integers(1, 3, (BACK, SUBSTEPS, 7)), 0)
    by_pos, by_vel, newest = rng.normal(size=7), rng.normal(size=7), 4
    ring = np.roll(limited, newest + 1, axis=0)
    out = np.empty((BACK, 7))
    back_through_drives(by_pos, by_vel, moment, history_of(ring, newest, late=late), out)
    expected = np.empty((BACK, 7))
    for joint in range(7):
        flags = limited[:, :, joint].ravel()
        for back in range(BACK):
            ends = []
            for change in (0.5, -0.5):  # the drives are linear: any step is exact
                changed = targets[:, joint].copy()
                changed[BACK - 1 - back] += change
                ends.append(
                    np.dot(
                        [by_pos[joint], by_vel[joint]],
                        driven(changed, joint, flags, late, min(moment, 0.0199999)),
                    )
                )
            expected[back, joint] = ends[0] - ends[1]

    np.testing.assert_allclose(out, expected, atol=1e-3 * np.abs(expected).max())


def test_a_drive_at_its_force_limit_does_not_depend_on_its_target():
    limited = np.zeros((BACK, SUBSTEPS, 7), np.int8)
    limited[:, :, 2] = 1
    out = np.empty((BACK, 7))
    back_through_drives(np.ones(7), np.ones(7), 0.0133, history_of(limited, newest=0), out)

    assert (out[:, 2] == 0.0).all()
    assert (np.abs(out[:, [0, 1, 3, 4, 5, 6]]).max(axis=0) > 0).all()


@pytest.mark.parametrize("late", [0, 3])
def test_the_recursion_ends_where_the_rally_begins(late):
    whole, cut = np.empty((BACK, 7)), np.empty((BACK, 7))
    back_through_drives(np.ones(7), np.ones(7), 0.0133, history_of(newest=0, late=late), whole)
    back_through_drives(np.ones(7), np.ones(7), 0.0133, history_of(newest=0, steps=4, late=late), cut)

    np.testing.assert_array_equal(cut[:4], whole[:4])
    np.testing.assert_array_equal(cut[4:], 0.0)
