"""Measured contacts compared with the racket's law (samples copied by hand). Skipped where the samples are missing."""

from pathlib import Path

import numpy as np
import pytest

from common.physics.constants import INVERTED
from common.physics.racket_bounce import racket_bounce

RECORDINGS = Path(__file__).resolve().parents[4] / "shared" / "data" / "racket_contacts"

pytestmark = pytest.mark.skipif(
    not RECORDINGS.is_dir(),
    reason=f"no samples in {RECORDINGS}, which were copied from the papers that constants.py names for rubbers",
)


def read_rows(name: str) -> np.ndarray:
    rows = np.genfromtxt(RECORDINGS / name, delimiter=",", skip_header=2, comments="#")
    rows = rows[~np.isnan(rows).any(axis=1)]
    assert len(rows) >= 16
    return rows


def predicted(
    vel: np.ndarray, spin: np.ndarray, normal: tuple[float, float, float]
) -> tuple[np.ndarray, ...]:
    after = [
        racket_bounce(tuple(map(float, v)), tuple(map(float, w)), normal, (0.0, 0.0, 0.0), INVERTED)
        for v, w in zip(vel, spin, strict=True)
    ]
    return np.array([v for v, _ in after]), np.array([w for _, w in after])


def median_distance(a: np.ndarray, b: np.ndarray) -> float:
    return float(np.median(np.linalg.norm(a - b, axis=1)))


def test_a_still_inverted_racket_is_predicted_within_the_spread_of_its_own_measurements():
    """Gossard 2026, racket 1, in its plane: z is the normal; the errors of its own fits: 0.44 m/s and 15 rad/s."""
    rows = read_rows("gossard_racket01_sample.csv")
    zero = np.zeros(len(rows))
    _, wy_in, wy_out, vx_in, vz_in, vx_out, vz_out = rows.T
    vel, spin = predicted(
        np.stack([vx_in, zero, vz_in], 1), np.stack([zero, wy_in, zero], 1), (0.0, 0.0, 1.0)
    )

    assert median_distance(vel, np.stack([vx_out, zero, vz_out], 1)) <= 0.45
    assert median_distance(spin, np.stack([zero, wy_out, zero], 1)) <= 16.0


def test_contacts_of_matches_are_predicted_within_the_spread_of_their_own_fit():
    """Conti et al. 2026: relative, racket frame, x is the normal; the errors of their fits: 0.79 m/s and 34 rad/s."""
    rows = read_rows("sony_racket_contacts_sample.csv")
    vel, spin = predicted(rows[:, 1:4], rows[:, 4:7], (1.0, 0.0, 0.0))

    assert median_distance(vel, rows[:, 7:10]) <= 0.8
    assert median_distance(spin, rows[:, 10:13]) <= 35.0
