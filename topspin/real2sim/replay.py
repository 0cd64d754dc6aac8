"""Recorded balls as rallies: a state, or the launch fitted to a track, simulated again.

A recording gives the launch. The other parameters (target, table, rubber, the camera's noise) are drawn from the
rally's seed, and the seed from the recording's name. So a recording is the same rally in every process, in any file
and any order. The result has the form of a generator's block, so every player of rallies can play it.
"""

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from common.jit import kernel
from common.physics.flight import SIMPLE, Air
from common.physics.fly import NO_ROBOT, RobotPath
from common.task.config import Randomization
from common.task.counter_rng import Stream, between, bits
from common.task.launch import (
    DRAG_FACTOR,
    LAUNCH_SIZE,
    LIFT_FACTOR,
    POSITION,
    SPIN,
    VELOCITY,
    Purpose,
    RallyBlock,
    Seeds,
    is_valid,
)
from common.task.randomization import PROFILES
from topspin.real2sim.formats.tracks import Array, RecordingError, States

if TYPE_CHECKING:  # the fit needs scipy, an extra; states do not
    from topspin.real2sim.fit.identify import Fit

Flags = npt.NDArray[np.bool_]


@dataclass(frozen=True, slots=True)
class RecordedRallies:
    """Recorded balls as launches, one row each.

    Attributes:
        ids: Names of the recordings.
        labels: Kind of each ball.
        launches: (n, 11) position, velocity, spin, drag factor, lift factor.
        seeds: (n,) of the other parameters of each rally.
        valid: (n,) whether it crosses the net untouched and touches the robot's court first.
        paths: (n, m, 7) that the balls follow until they are hit, as ``step.snap_to_recorded_track``; None: physics
            moves them.
    """

    ids: tuple[str, ...]
    labels: tuple[str, ...]
    launches: Array
    seeds: Seeds
    valid: Flags
    paths: Array | None = None

    def block(self) -> RallyBlock:
        """Return the valid ones as a generator's block, to be played like any other.

        Raises:
            RecordingError: There is none.
        """
        if not self.valid.any():
            raise RecordingError(
                f"got {len(self.ids)} recorded balls, none of which crosses the net and touches the robot's court "
                "first; allowed: one or more that does"
            )
        paths = None if self.paths is None else self.paths[self.valid]
        return RallyBlock(self.launches[self.valid], self.seeds[self.valid], len(self.ids), paths)


@kernel
def _all_valid(launches: Array, model: int, no_robot: RobotPath, valid: Flags) -> None:
    for k in range(launches.shape[0]):
        row = launches[k]
        pos, vel, spin = (row[0], row[1], row[2]), (row[3], row[4], row[5]), (row[6], row[7], row[8])
        valid[k] = is_valid(pos, vel, spin, Air(row[9], row[10], model), no_robot)


def seed_of(name: str, seed: int = 0) -> np.uint64:
    """Return the seed of a recording's rally: a function of its name and of the run's ``seed``."""
    digest = hashlib.blake2b(name.encode(), digest_size=8).digest()
    drawn = bits(np.array([seed], np.uint64)[0] ^ np.frombuffer(digest, "<u8")[0], int(Purpose.RECORDED), 0)
    return np.uint64((int(drawn) >> 2) | (int(Purpose.RECORDED) << 62))


def _recorded(
    ids: Sequence[str], labels: Sequence[str], launches: Array, seeds: Seeds, flight: int
) -> RecordedRallies:
    valid = np.zeros(len(launches), np.bool_)
    _all_valid(launches, flight, NO_ROBOT, valid)
    return RecordedRallies(tuple(ids), tuple(labels), launches, seeds, valid)


def of_states(
    states: States, *, seed: int = 0, randomization: Randomization = "standard", flight: int = SIMPLE
) -> RecordedRallies:
    """Return recorded states as rallies; the air, which a state does not contain, is drawn from each rally's seed.

    Args:
        states: In the world frame.
        seed: Of the run, 0 .. 2^64 - 1: another seed plays the same balls to other targets.
        randomization: Profile, which decides the spread of drag and lift.
        flight: ``flight.SIMPLE`` or ``flight.FULL``.
    """
    profile = PROFILES[randomization]
    launches = np.empty((len(states), LAUNCH_SIZE))
    launches[:, POSITION], launches[:, VELOCITY], launches[:, SPIN] = (
        states.positions,
        states.velocities,
        states.spins,
    )
    seeds = np.array([seed_of(name, seed) for name in states.ids], np.uint64)
    for row, rally in zip(launches, seeds, strict=True):
        row[DRAG_FACTOR] = between(*profile.drag_factor, rally, Stream.LAUNCH, 9)
        row[LIFT_FACTOR] = between(*profile.lift_factor, rally, Stream.LAUNCH, 10)
    return _recorded(states.ids, states.labels, launches, seeds, flight)


def of_fits(fits: Sequence["Fit"], labels: Sequence[str] = (), *, seed: int = 0) -> RecordedRallies:
    """Return fitted tracks as rallies: launched where the recording begins, in the air that was fitted.

    Args:
        fits: All of one flight model, with drag and lift.
        labels: Kind of each ball; none by default.
        seed: Of the run, 0 .. 2^64 - 1.
    """
    flights = {fitted.options.flight for fitted in fits}
    if len(flights) != 1:
        raise RecordingError(
            f"got fits of {len(flights)} flight models; allowed: one or more fits of one model"
        )
    launches = np.stack([fitted.launch for fitted in fits])
    seeds = np.array([seed_of(fitted.id, seed) for fitted in fits], np.uint64)
    return _recorded(
        [fitted.id for fitted in fits],
        labels or [""] * len(fits),
        launches,
        seeds,
        flights.pop(),
    )
