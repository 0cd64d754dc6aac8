"""A recording as a path: followed until the racket touches the ball, and without effect where physics is right."""

import numpy as np
import pytest

from common.evaluation.rally_recorder import record_rallies
from common.physics import touch
from common.physics.constants import GRID_STEP
from common.physics.flight import FULL
from common.physics.fly import NO_ROBOT
from common.rally.state import NO_SAMPLE, SAMPLE
from common.rally.step import snap_to_recorded_track
from common.task.config import TaskConfig
from common.task.launch import KIND, RallyBlock, draw_rallies
from common.task.launch_presets import Kind
from common.task.states import State
from tests.unit.topspin.real2sim.flights import TABLE, launch_of, seen
from tests.unit.topspin.render.recorded import wave
from topspin.real2sim.fit.identify import fit
from topspin.real2sim.fit.predict import predict, touch_down
from topspin.real2sim.kinematic import driven, first_touch, path_of
from topspin.real2sim.replay import of_fits

CONFIG = TaskConfig(randomization="standard", carry_over=0.0, perception="full")
LAUNCH = launch_of(spin=(3.0, -45.0, 5.0))


def own_paths(rallies):
    """Return the paths (n, m, 7) of rallies as they were played."""
    paths = np.full((len(rallies), max(len(rally.time) for rally in rallies), SAMPLE), NO_SAMPLE)
    for path, rally in zip(paths, rallies, strict=True):
        path[: len(rally.time)] = np.column_stack([rally.ball_pos, rally.ball_vel, rally.state])
    return paths


def test_a_rally_driven_by_its_own_path_is_the_same_rally_bit_for_bit():
    block = draw_rallies(12, seed=3)
    free = record_rallies(wave, block, CONFIG)
    again = record_rallies(wave, RallyBlock(block.launches, block.seeds, 12, own_paths(free)), CONFIG)

    assert {rally.outcome.name for rally in free} > {"MISS"}  # some are hit, and there the path ends
    for one, other in zip(free, again, strict=True):
        assert one.outcome == other.outcome
        for name in ("ball_pos", "ball_vel", "ball_spin", "state", "joints", "measurement", "detections"):
            np.testing.assert_array_equal(getattr(one, name), getattr(other, name))


def test_a_driven_ball_follows_the_recording_and_not_physics():
    block = draw_rallies(3, seed=3)
    paths = own_paths(record_rallies(wave, block, CONFIG))
    paths[:, :, 1] += 0.02  # the whole recording, 20 mm to the left
    bounced = [int(np.flatnonzero(path[:, 6] != 0)[0]) for path in paths]
    moved = record_rallies(wave, RallyBlock(block.launches, block.seeds, 3, paths), CONFIG)

    for rally, path, step in zip(moved, paths, bounced, strict=True):
        np.testing.assert_array_equal(rally.ball_pos[1 : step - 1], path[1 : step - 1, :3])


def test_a_ball_without_a_path_flies_freely_among_driven_ones():
    block = draw_rallies(2, seed=3)
    free = record_rallies(wave, block, CONFIG)
    paths = own_paths(free)
    paths[0] = NO_SAMPLE
    again = record_rallies(wave, RallyBlock(block.launches, block.seeds, 2, paths), CONFIG)

    for one, other in zip(free, again, strict=True):
        np.testing.assert_array_equal(one.ball_pos, other.ball_pos)


@pytest.mark.parametrize(
    ("state", "step", "kept"),
    [
        (State.TAU_01, 3, True),
        (State.TAU_01, 5, False),  # the recording has bounced, the ball has not
        (State.TAU_1, 4, False),  # and the opposite
        (State.TAU_12, 5, True),
        (State.TAU_2, 6, False),  # hit
        (State.TAU_23, 6, False),
        (State.TAU_12, 7, False),  # the recording is over
        (State.TAU_12, 9, False),
    ],
)
def test_a_path_drives_the_ball_until_the_hit_and_while_it_agrees_on_the_bounce(state, step, kept):
    path = np.full((9, SAMPLE), 0.5)
    path[:, 6] = [0, 0, 0, 0, 0, 1, 1, NO_SAMPLE, NO_SAMPLE]
    pos, vel = snap_to_recorded_track(path, step, int(state), (0.0, 0.0, 0.1), (-5.0, 0.0, 0.0))

    assert (pos == (0.5, 0.5, 0.5)) == (vel == (0.5, 0.5, 0.5)) == kept


def test_a_noisy_track_gives_a_path_nearer_to_the_ball_than_its_samples():
    track = seen(LAUNCH, noise=2e-3)
    path = path_of(track, fit(track))
    n, bounce = len(path), int(np.flatnonzero(path[:, 6])[0])
    truth, velocities = np.empty((n, 3)), np.empty((n, 3))
    predict(LAUNCH, TABLE, FULL, GRID_STEP * np.arange(n), truth, velocities)
    off = np.abs(np.arange(n) - bounce) > 1  # in the bounce's own step the two balls differ

    assert n == int(track.times[-1] / GRID_STEP + 1e-9) + 1
    assert bounce == np.ceil(touch_down(LAUNCH, FULL, 1.0)[0] / GRID_STEP)
    assert np.sqrt(np.mean((path[:, :3] - truth) ** 2)) < 1e-3
    assert np.sqrt(np.mean((path[:, 3:6] - velocities)[off] ** 2)) < 0.06


def test_a_path_follows_a_recording_that_no_model_explains():
    track = seen(LAUNCH, noise=0.5e-3)
    bent = track.positions + 0.03 * np.sin(9.0 * track.times)[:, None] ** 2 * np.array([0.0, 1.0, 0.0])
    fitted = fit(type(track)("bent", track.times, bent))
    path = path_of(type(track)("bent", track.times, bent), fitted)
    at = np.interp(track.times, GRID_STEP * np.arange(len(path)), path[:, 1])

    assert fitted.rms > 3e-3
    assert np.sqrt(np.mean((at - bent[:, 1]) ** 2)) < 0.5 * fitted.rms


def test_one_wrong_sample_does_not_bend_the_path():
    track = seen(LAUNCH, noise=1e-3)
    wrong = track.positions.copy()
    wrong[40] += [0.0, 0.1, 0.0]
    fitted = fit(track)

    straight, bent = path_of(track, fitted), path_of(type(track)("wrong", track.times, wrong), fitted)

    assert np.abs(straight - bent)[:, :3].max() < 1e-3


def test_a_driven_rallys_validity_is_its_paths():
    tracks = [seen(LAUNCH, noise=1e-3), seen(launch_of(vel=(-8.5, 0.0, 2.0)), duration=0.25)]
    fits = [fit(track) for track in tracks]
    found = driven(of_fits(fits), tracks, fits)

    assert found.valid.tolist() == [True, False]  # the second flies over the table
    assert found.block().path_rows == found.paths.shape[1]
    np.testing.assert_array_equal(found.launches[:, :6], found.paths[:, 0, :6])
    np.testing.assert_array_equal(
        found.launches[:, 6:], [[*fitted.launch[6:], int(Kind.RECORDED)] for fitted in fits]
    )


def test_a_serves_path_has_three_parts_and_is_valid():
    served = launch_of(pos=(1.5, 0.2, 0.25), vel=(-5.2, -0.2, -2.0), spin=(0.0, 40.0, 10.0))
    track = seen(served, noise=1e-3)
    fits = [fit(track)]
    found = driven(of_fits(fits), [track], fits)
    stages = found.paths[0, :, 6]

    assert found.valid.tolist() == [True]
    assert found.launches[0, KIND] == Kind.SERVE
    assert list(dict.fromkeys(stages.tolist())) == [4.0, 0.0, 1.0]
    rallies = record_rallies(wave, found.block(), CONFIG)
    first = int(np.flatnonzero(stages == 0.0)[0])
    np.testing.assert_array_equal(rallies[0].ball_pos[1 : first - 1], found.paths[0, 1 : first - 1, :3])
    np.testing.assert_array_equal(
        rallies[0].ball_pos[first + 2 : first + 40], found.paths[0, first + 2 : first + 40, :3]
    )


def test_a_driven_balls_first_touch_is_its_paths():
    grid = GRID_STEP * np.arange(100)
    low, pos, vel = launch_of(vel=(-5.0, 0.0, 0.9)), np.empty((100, 3)), np.empty((100, 3))
    predict(low, np.empty(0), FULL, grid, pos, vel)
    path = np.column_stack([pos, vel, np.zeros(100)])

    def touched(path):
        return first_touch(np.append(LAUNCH, int(Kind.RECORDED)), path, FULL, tuple(TABLE), NO_ROBOT)

    assert touched(np.zeros((0, SAMPLE))) == touch.ROBOT_COURT
    assert touched(path) == touch.NET


def test_recorded_tracks_need_tailored_collisions():
    block = draw_rallies(1, seed=3)
    original = CONFIG.model_copy(update={"collision": "original"})

    with pytest.raises(
        ValueError, match="recorded tracks under collision 'original'; allowed: collision 'tailored'"
    ):
        record_rallies(wave, RallyBlock(block.launches, block.seeds, 1, np.zeros((1, 5, SAMPLE))), original)
