"""Recorded balls as rallies: a state, or the launch fitted to a track, flown again under the project's physics.

A recording gives the launch; all that a rally draws besides (target, table, rubber, the camera's noise) comes from
the rally's seed, and that from the recording's name: the same recording is the same rally in every process, and
in whichever file and order it was found. What is made of a recording is what a generator makes of a draw, so whoever
plays rallies can play these.
"""

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from common.jit import kernel
from common.physics.flight import SIMPLE
from common.physics.fly import NO_ROBOT
from common.rally.draws import Stream, between, bits
from common.rally.launch import (
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
from common.rally.noise import PROFILES
from common.real2sim.tracks import Array, RecordingError, States

if TYPE_CHECKING:  # the fit needs scipy, an extra: states go without
    from common.real2sim.identify import Fit

Flags = npt.NDArray[np.bool_]


@dataclass(frozen=True, slots=True)
class RecordedRallies:
    """Recorded balls as launches, one row each.

    Attributes:
        ids: Of the recordings.
        labels: What is known about each.
        launches: (n, 11) position, velocity, spin, drag factor, lift factor.
        seeds: (n,) what the rest of each rally is drawn from.
        valid: (n,) whether it crosses the net untouched and touches the robot's court first.
        paths: (n, m, 7) that the balls keep to until they are hit, as ``play.keep_to_path``; None: they
            fly as physics has it.
    """

    ids: tuple[str, ...]
    labels: tuple[str, ...]
    launches: Array
    seeds: Seeds
    valid: Flags
    paths: Array | None = None

    def block(self) -> RallyBlock:
        """Return the valid ones as a generator's block, to be played like any.

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
def _all_valid(launches: Array, model: int, no_robot: Array, valid: Flags) -> None:
    for k in range(launches.shape[0]):
        row = launches[k]
        valid[k] = is_valid(
            (row[0], row[1], row[2]),
            (row[3], row[4], row[5]),
            (row[6], row[7], row[8]),
            row[9],
            row[10],
            model,
            no_robot,
        )


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
    states: States, *, seed: int = 0, noise: str = "standard", flight: int = SIMPLE
) -> RecordedRallies:
    """Return recorded states as rallies; the air, which a state doesn't tell, is drawn from each rally's seed.

    Args:
        states: In the world frame.
        seed: Of the run, 0 .. 2^64 - 1: another one plays the same balls to other targets.
        noise: A key of ``noise.PROFILES``: how far drag and lift are drawn from nominal.
        flight: ``flight.SIMPLE`` or ``flight.FULL``.
    """
    profile = PROFILES[noise]
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
        fits: Of one flight model and with all of the air.
        labels: What is known about each; none by default.
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
