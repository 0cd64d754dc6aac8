"""Recorded balls as rallies: a state, or the launch fitted to a track, simulated again.

A recording gives the launch. The other parameters (target, table, rubber, the camera's noise) are drawn from the
rally's seed, and the seed from the recording's name. So a recording is the same rally in every process, whatever else
is played. A name that an earlier file has too gets its file's name in front, and is then another rally. The result has
the form of a generator's block, so every player of rallies can play it.
"""

import hashlib
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np
import numpy.typing as npt

from common.jit import kernel
from common.physics import touch
from common.physics.flight import FULL, Air
from common.physics.fly import NO_ROBOT, RobotPath, fly_to_touch
from common.physics.touch import Touch
from common.physics.vec import vec_at
from common.task.config import Randomization
from common.task.counter_rng import bits
from common.task.launch import (
    DRAG_FACTOR,
    KIND,
    LAUNCH_SIZE,
    LIFT_FACTOR,
    LONGEST_FLIGHT,
    POSITION,
    SPIN,
    VELOCITY,
    Purpose,
    RallyBlock,
    Seeds,
    is_valid,
)
from common.task.launch_presets import SERVE, Kind
from common.task.randomization import PROFILES, RandomizationProfile, air_factors, table_of
from topspin.real2sim.formats.tracks import Array, RecordingError, States

if TYPE_CHECKING:  # the fit needs scipy, an extra; states do not
    from topspin.real2sim.fit.identify import Fit

Flags = npt.NDArray[np.bool_]
Integers = npt.NDArray[np.int64]

RECORDED = int(Kind.RECORDED)  # kernels take plain integers
IN_TABLE = -1  # in place of a touch: the ball starts in the table or the net
TOUCHES: Final = {
    IN_TABLE: "starts in the table or the net",
    int(Touch.NONE): "touches nothing",
    int(Touch.OPPONENT_COURT): "bounces on the opponent's court and is no serve",
    int(Touch.NET): "touches the net",
    int(Touch.EDGE): "touches an edge of the table",
    int(Touch.FLOOR): "misses the table",
    int(Touch.OUT): "misses the table",
}
"""Why a recorded ball is no valid rally, by what it touches first."""


@dataclass(frozen=True, slots=True)
class RecordedRallies:
    """Recorded balls as launches, one row each.

    Attributes:
        ids: Names of the recordings.
        labels: Kind of each ball.
        launches: (n, 12) position, velocity, spin, drag factor, lift factor, kind.
        seeds: (n,) of the other parameters of each rally.
        touched: (n,) what the ball touches first (``touch.Touch``), or ``IN_TABLE``; of a serve: after its bounce on
            the server's own court.
        paths: (n, m, 7) that the balls follow until they are hit, as ``step.snap_to_recorded_track``; None: physics
            moves them.
        players: Who played each ball; empty if unknown.
    """

    ids: tuple[str, ...]
    labels: tuple[str, ...]
    launches: Array
    seeds: Seeds
    touched: Integers
    paths: Array | None = None
    players: tuple[str, ...] = ()

    @property
    def valid(self) -> Flags:
        """Return which cross the net untouched and touch the robot's court first, or are a valid serve (n,)."""
        valid: Flags = self.touched == touch.ROBOT_COURT
        return valid

    @property
    def invalid(self) -> dict[str, int]:
        """Return why others are not valid: how many by what they touch."""
        counts = Counter(TOUCHES[int(what)] for what in self.touched[~self.valid])
        return dict(sorted(counts.items()))

    def block(self) -> RallyBlock:
        """Return the valid ones as a generator's block, to be played like any other.

        Raises:
            RecordingError: There is none.
        """
        if not self.valid.any():
            reasons = "; ".join(f"{reason}: {count}" for reason, count in self.invalid.items())
            raise RecordingError(
                f"got {len(self.ids)} recorded balls, none of which crosses the net and touches the robot's court "
                f"first, or is a serve ({reasons}); allowed: one or more that does"
            )
        paths = None if self.paths is None else self.paths[self.valid]
        return RallyBlock(self.launches[self.valid], self.seeds[self.valid], len(self.ids), paths)


@kernel
def _classify(
    launches: Array,
    seeds: Seeds,
    profile: RandomizationProfile,
    model: int,
    no_robot: RobotPath,
    touched: Integers,
) -> None:
    """Write what each launch touches first (a serve: after its own court), and its kind."""
    for k in range(launches.shape[0]):
        row = launches[k]
        pos, vel, spin = (row[0], row[1], row[2]), (row[3], row[4], row[5]), (row[6], row[7], row[8])
        air, table = Air(row[DRAG_FACTOR], row[LIFT_FACTOR], model), table_of(profile, seeds[k])
        row[KIND] = RECORDED
        if is_valid(pos, vel, spin, air, False, table, no_robot):
            touched[k] = touch.ROBOT_COURT
        elif is_valid(pos, vel, spin, air, True, table, no_robot):
            row[KIND], touched[k] = SERVE, touch.ROBOT_COURT
        elif touch.table_gap(pos)[0] <= 0.0 or touch.net_gap(pos)[0] <= 0.0:
            touched[k] = IN_TABLE
        else:
            touched[k] = fly_to_touch(pos, vel, spin, LONGEST_FLIGHT, air, no_robot)[3]


def seed_of(name: str, seed: int = 0) -> np.uint64:
    """Return the seed of a recording's rally: a function of its name and of the run's ``seed``."""
    digest = hashlib.blake2b(name.encode(), digest_size=8).digest()
    drawn = bits(np.array([seed], np.uint64)[0] ^ np.frombuffer(digest, "<u8")[0], int(Purpose.RECORDED), 0)
    return np.uint64((int(drawn) >> 2) | (int(Purpose.RECORDED) << 62))


def _recorded(
    ids: Sequence[str],
    labels: Sequence[str],
    players: Sequence[str],
    launches: Array,
    seeds: Seeds,
    flight: int,
    randomization: Randomization,
) -> RecordedRallies:
    touched = np.zeros(len(launches), np.int64)
    _classify(launches, seeds, PROFILES[randomization], flight, NO_ROBOT, touched)
    return RecordedRallies(tuple(ids), tuple(labels), launches, seeds, touched, None, tuple(players))


def of_states(
    states: States,
    *,
    seed: int = 0,
    air: Randomization = "standard",
    randomization: Randomization = "standard",
    flight: int = FULL,
) -> RecordedRallies:
    """Return recorded states as rallies; the air, which a state does not contain, is drawn from each rally's seed.

    Args:
        states: In the world frame.
        seed: Of the run, 0 .. 2^64 - 1: another seed plays the same balls to other targets.
        air: Profile, which decides the spread of drag and lift.
        randomization: Profile under which they are played; a serve's first bounce depends on its tables.
        flight: ``flight.SIMPLE`` or ``flight.FULL``.
    """
    profile = PROFILES[air]
    launches = np.empty((len(states), LAUNCH_SIZE))
    launches[:, POSITION], launches[:, VELOCITY], launches[:, SPIN] = (
        states.positions,
        states.velocities,
        states.spins,
    )
    seeds = np.array([seed_of(name, seed) for name in states.ids], np.uint64)
    for row, rally in zip(launches, seeds, strict=True):
        velocity, spin = vec_at(row, VELOCITY.start), vec_at(row, SPIN.start)
        row[DRAG_FACTOR], row[LIFT_FACTOR] = air_factors(velocity, spin, profile, rally)
    return _recorded(states.ids, states.labels, states.players, launches, seeds, flight, randomization)


def of_fits(
    fits: Sequence["Fit"],
    labels: Sequence[str] = (),
    players: Sequence[str] = (),
    *,
    seed: int = 0,
    randomization: Randomization = "standard",
) -> RecordedRallies:
    """Return fitted tracks as rallies: launched where the recording begins, in the air that was fitted.

    Args:
        fits: All of one flight model, with drag and lift.
        labels: Kind of each ball; none by default.
        players: Who played each ball; none by default.
        seed: Of the run, 0 .. 2^64 - 1.
        randomization: Profile under which they are played; a serve's first bounce depends on its tables.
    """
    flights = {fitted.options.flight for fitted in fits}
    if len(flights) != 1:
        raise RecordingError(
            f"got fits of {len(flights)} flight models; allowed: one or more fits of one model"
        )
    launches = np.stack([np.append(fitted.launch, RECORDED) for fitted in fits])
    seeds = np.array([seed_of(fitted.id, seed) for fitted in fits], np.uint64)
    return _recorded(
        [fitted.id for fitted in fits],
        labels or [""] * len(fits),
        players or [""] * len(fits),
        launches,
        seeds,
        flights.pop(),
        randomization,
    )
