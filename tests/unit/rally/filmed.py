"""Balls filmed by the simulated camera, with the truth beside them, for the tests of camera and estimator."""

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from common.jit import kernel
from common.physics.constants import GRID_STEP
from common.physics.fly import NO_ROBOT, fly_step
from common.physics.table_bounce import table_bounce
from common.physics.touch import NONE, OPPONENT_COURT, ROBOT_COURT
from common.rally.camera import FILM, READ, SHOT, TAKEN, begin_film, film_flight, shot_row
from common.rally.draws import Stream, between
from common.rally.estimator import ESTIMATE, begin_estimate, estimate_at, take_shot
from common.rally.launch import draw_rallies
from common.rally.noise import CONDITIONS, PROFILES, NoiseProfile, draw_conditions

Array = npt.NDArray[np.float64]
CONTROL_STEPS = 50  # watched: 1 s
_RESET = int(Stream.RESET)


class Filmed(NamedTuple):
    """One row a rally, one column a control step; nan after a rally's end."""

    truth: Array  # (n, CONTROL_STEPS, 7) position, velocity, state 0..3
    estimate: Array  # (n, CONTROL_STEPS, 7) for the same moment
    shots: Array  # (n, 250, 5) every shot kept


@kernel
def film_rally(
    record: Array,
    seed: int,
    noise: NoiseProfile,
    latency: float,
    hit: bool,
    no_robot: Array,
    truth: Array,
    estimate: Array,
    kept: Array,
) -> None:
    """Fly a rally past no robot; a quarter of a second after its bounce a blow sends it back, if ``hit``."""
    condition = np.empty(CONDITIONS)
    draw_conditions(seed, record[9], record[10], noise, condition)
    film, row = np.zeros(FILM), np.zeros(ESTIMATE)
    pos, vel = (record[0], record[1], record[2]), (record[3], record[4], record[5])
    spin = (record[6], record[7], record[8])
    begin_film(film, seed, pos, noise)
    state, blow = 0, 1.0e9
    for step in range(truth.shape[0]):
        for sub in range(4):
            start, rest = (4 * step + sub) * GRID_STEP, GRID_STEP
            while rest > 0.0:
                since = start + GRID_STEP - rest
                h = min(rest, max(blow - since, 0.0)) if state == 1 else rest
                p0, v0 = pos, vel
                pos, vel, flown, what, normal = fly_step(
                    pos, vel, spin, h, condition[0], condition[1], 0, no_robot, 0.0, 1.0, 0.0
                )
                film_flight(film, seed, condition, noise, since, p0, v0, flown, pos, vel)
                rest -= flown
                if what == ROBOT_COURT and state == 0:
                    vel, spin = table_bounce(vel, spin, normal, condition[2], condition[3])
                    state = 1
                    if hit:
                        blow = since + flown + between(0.15, 0.3, seed, _RESET, 0)
                elif what == OPPONENT_COURT and state == 2:
                    vel, spin = table_bounce(vel, spin, normal, condition[2], condition[3])
                    state = 3
                elif what != NONE:
                    return
                elif state == 1 and rest > 0.0:
                    vel = (
                        between(4.0, 7.0, seed, _RESET, 1),
                        between(-1.5, 1.5, seed, _RESET, 2),
                        between(0.5, 3.0, seed, _RESET, 3),
                    )
                    spin = (0.0, -between(0.0, 100.0, seed, _RESET, 4), 0.0)
                    state = 2
        now = 4 * (step + 1) * GRID_STEP
        while film[READ] < film[TAKEN]:
            shot = shot_row(film, int(film[READ]))
            place = (shot[1], shot[2], shot[3])
            if film[READ] == 0.0:
                begin_estimate(row, shot[0], place, noise.camera_noise)
                shot[4] = 1.0
            elif shot[0] + latency > now + 1e-9:
                break
            elif take_shot(row, shot[0], place, noise.camera_noise):
                shot[4] = 1.0
            kept[int(film[READ])] = shot
            film[READ] += 1.0
        seen, speed, seen_state = estimate_at(row, now)
        for k in range(3):
            truth[step, k], truth[step, 3 + k] = pos[k], vel[k]
            estimate[step, k], estimate[step, 3 + k] = seen[k], speed[k]
        truth[step, 6], estimate[step, 6] = state, seen_state


@kernel
def _film_all(
    records: Array,
    seeds: npt.NDArray[np.uint64],
    noise: NoiseProfile,
    latency: float,
    hit: bool,
    no_robot: Array,
    truth: Array,
    estimate: Array,
    kept: Array,
) -> None:
    for k in range(records.shape[0]):
        film_rally(records[k], seeds[k], noise, latency, hit, no_robot, truth[k], estimate[k], kept[k])


def filmed_rallies(
    rallies: int,
    *,
    noise: NoiseProfile = PROFILES["standard"],
    latency: float = 0.025,
    seed: int = 0,
    preset: str = "paper",
    hit: bool = True,
) -> Filmed:
    """Return valid rallies as they were, and as they were estimated."""
    block = draw_rallies(rallies, seed=seed, preset=preset)
    filmed = Filmed(
        np.full((rallies, CONTROL_STEPS, 7), np.nan),
        np.full((rallies, CONTROL_STEPS, 7), np.nan),
        np.full((rallies, 250, SHOT), np.nan),
    )
    _film_all(block.launches, block.seeds, noise, latency, hit, NO_ROBOT, *filmed)
    return filmed


def off_by(filmed: Filmed) -> tuple[Array, Array, Array, Array]:
    """Return errors of position [m] and velocity [m/s], true and estimated state: (m,) control steps watched."""
    watched = np.isfinite(filmed.truth[:, :, 0])
    truth, estimate = filmed.truth[watched], filmed.estimate[watched]
    off = np.abs(estimate - truth)
    return (
        np.linalg.norm(off[:, :3], axis=1),
        np.linalg.norm(off[:, 3:6], axis=1),
        truth[:, 6],
        estimate[:, 6],
    )
