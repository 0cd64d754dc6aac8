"""Launches: what a preset draws, which launches are valid, and that a block is a function of its arguments."""

import numpy as np
import pytest

from common.physics import touch
from common.physics.flight import SIMPLE, Air
from common.physics.fly import NO_ROBOT, fly_to_touch
from common.physics.vec import Vec
from common.task.config import TaskConfig
from common.task.launch import (
    DRAG_FACTOR,
    LIFT_FACTOR,
    POSITION,
    SPIN,
    VELOCITY,
    Array,
    Purpose,
    RallyBlock,
    draw_rallies,
    is_valid,
    launch,
)
from common.task.launch_presets import PRESETS
from common.task.randomization import PROFILES

NOMINAL_AIR = Air(1.0, 1.0, SIMPLE)

every_preset = pytest.mark.parametrize("preset", PRESETS)


def fly(row: Array) -> tuple[Vec, Vec, float, int, Vec]:
    position, velocity, spin = (tuple(map(float, row[part])) for part in (POSITION, VELOCITY, SPIN))
    return fly_to_touch(
        position, velocity, spin, 2.0, Air(row[DRAG_FACTOR], row[LIFT_FACTOR], SIMPLE), NO_ROBOT
    )


def expect_same_bits(a: RallyBlock, b: RallyBlock) -> None:
    assert a.launches.tobytes() == b.launches.tobytes()
    assert a.seeds.tobytes() == b.seeds.tobytes()
    assert a.drawn == b.drawn


@every_preset
def test_every_rally_crosses_the_net_and_touches_the_robots_court_first(preset):
    block = draw_rallies(300, TaskConfig(launch=preset), seed=1)
    touches = [fly(row) for row in block.launches]

    assert np.all(block.launches[:, 0] > 0.0)
    assert {what for _, _, _, what, _ in touches} == {touch.ROBOT_COURT}
    assert all(pos[0] < 0.0 and abs(pos[1]) <= 0.7625 for pos, *_ in touches)


@every_preset
@pytest.mark.parametrize("profile", PROFILES)
def test_every_launch_lies_within_its_presets_ranges(preset, profile):
    rows = draw_rallies(500, TaskConfig(launch=preset, randomization=profile), seed=2).launches
    ranges = PRESETS[preset]
    air = PROFILES[profile]

    for column, curve in enumerate(ranges.position):
        assert np.all((rows[:, column] >= min(curve)) & (rows[:, column] <= max(curve)))
    assert np.all((rows[:, DRAG_FACTOR] >= air.drag_factor[0]) & (rows[:, DRAG_FACTOR] <= air.drag_factor[1]))
    assert np.all((rows[:, LIFT_FACTOR] >= air.lift_factor[0]) & (rows[:, LIFT_FACTOR] <= air.lift_factor[1]))


@pytest.mark.parametrize(("preset", "most"), [("paper", 100.0), ("strong", 300.0)])
def test_paper_and_strong_launches_fill_their_velocity_ranges_with_spin_uniform_in_a_ball(preset, most):
    rows = draw_rallies(4000, TaskConfig(launch=preset), seed=3, purpose=Purpose.FALLBACK).launches
    spin_rate = np.linalg.norm(rows[:, SPIN], axis=1)

    np.testing.assert_allclose(rows[:, VELOCITY].min(0), [-8.0, -4.0, -1.0], atol=0.02)
    np.testing.assert_allclose(rows[:, VELOCITY].max(0), [-3.0, 4.0, 1.0], atol=0.02)
    assert spin_rate.max() <= most
    # P(|w| < q R) = q^3; 4,000 draws: three standard errors are 0.024
    assert np.mean(spin_rate < 0.5 * most) == pytest.approx(0.125, abs=0.024)
    np.testing.assert_allclose(rows[:, SPIN].mean(0), 0.0, atol=3 * most * np.sqrt(0.2 / 4000))


def test_half_of_the_mixed_balls_spin_like_paper_balls_and_half_like_strong_balls():
    rows = draw_rallies(4000, TaskConfig(launch="mixed"), seed=3, purpose=Purpose.FALLBACK).launches
    spin_rate = np.linalg.norm(rows[:, SPIN], axis=1)

    assert spin_rate.max() <= 300.0
    # below 100 rad/s: all of one half and 1 / 27 of the other; three standard errors are 0.024
    assert np.mean(spin_rate < 100.0) == pytest.approx(0.5 + 0.5 / 27, abs=0.024)
    assert np.mean(spin_rate < 50.0) == pytest.approx(0.5 / 8 + 0.5 / 216, abs=0.013)


@every_preset
def test_no_ball_is_launched_without_spin(preset):
    rows = draw_rallies(2000, TaskConfig(launch=preset), seed=4, purpose=Purpose.FALLBACK).launches

    assert np.linalg.norm(rows[:, SPIN], axis=1).min() > 0.1


def test_valid_rallies_of_preset_match_have_the_speeds_and_spins_of_recorded_human_strokes():
    """Of 609 strokes: median topspin per quartile of speed, and 5th, 50th, 95th percentiles of speed and topspin."""
    rows = draw_rallies(4000, TaskConfig(launch="match"), seed=5).launches
    speed = np.linalg.norm(rows[:, VELOCITY], axis=1)
    direction = rows[:, [3, 4]] / np.linalg.norm(rows[:, [3, 4]], axis=1, keepdims=True)
    topspin = direction[:, 0] * rows[:, 7] - direction[:, 1] * rows[:, 6]
    quartile = np.digitize(speed, [6.5, 10.2, 14.9])

    np.testing.assert_allclose(
        [np.median(topspin[quartile == k]) for k in range(4)], [-185, 176, 419, 577], atol=60
    )
    # random fast launches are invalid more often than a player's strokes, so valid ones are a little slower
    np.testing.assert_allclose(np.percentile(speed, [5, 50, 95]), [5.2, 10.2, 19.5], rtol=0.15)
    np.testing.assert_allclose(np.percentile(topspin, [5, 50, 95]), [-269, 288, 750], atol=60)
    assert np.corrcoef(speed, topspin)[0, 1] == pytest.approx(0.75, abs=0.05)


def test_about_29_percent_of_the_paper_launches_are_valid():
    assert 3000 / draw_rallies(3000, seed=6).drawn == pytest.approx(0.29, abs=0.03)


@every_preset
def test_a_block_is_a_function_of_its_arguments(preset):
    task = TaskConfig(launch=preset, randomization="hard")
    one, other = (draw_rallies(50, task, seed=2**64 - 1, shard=3, block=7) for _ in range(2))

    expect_same_bits(one, other)


@every_preset
def test_a_longer_block_begins_with_the_shorter_one(preset):
    short = draw_rallies(20, TaskConfig(launch=preset), seed=8)
    long = draw_rallies(50, TaskConfig(launch=preset), seed=8)

    assert long.launches[:20].tobytes() == short.launches.tobytes()
    assert long.seeds[:20].tobytes() == short.seeds.tobytes()


@every_preset
def test_a_launch_is_drawn_again_from_its_seed_bit_for_bit(preset):
    block = draw_rallies(50, TaskConfig(launch=preset), seed=9)
    for row, seed in zip(block.launches, block.seeds, strict=True):
        position, velocity, spin, drag, lift = launch(PRESETS[preset], PROFILES["standard"], seed)

        assert np.array([*position, *velocity, *spin, drag, lift]).tobytes() == row.tobytes()


def test_a_rally_flies_again_bit_for_bit_from_its_stored_row():
    rows = draw_rallies(50, TaskConfig(launch="match"), seed=10).launches
    stored = np.frombuffer(rows.tobytes()).reshape(rows.shape)

    assert [fly(row) for row in stored] == [fly(row) for row in rows]


@pytest.mark.parametrize("other", [{"seed": 2}, {"shard": 1}, {"block": 1}], ids=str)
def test_other_seeds_shards_and_blocks_share_no_rally(other):
    one = draw_rallies(500, seed=1)
    two = draw_rallies(500, **({"seed": 1} | other))

    assert not set(one.seeds) & set(two.seeds)


def test_rallies_of_different_purposes_are_never_the_same():
    """Each purpose has its own value of the seed's two top bits."""
    top_bits = {
        purpose: set((draw_rallies(200, seed=1, purpose=purpose).seeds >> np.uint64(62)).tolist())
        for purpose in Purpose
    }

    assert top_bits == {purpose: {int(purpose)} for purpose in Purpose}


def test_without_randomization_the_air_is_nominal():
    rows = draw_rallies(20, TaskConfig(randomization="off"), seed=11).launches

    assert np.all(rows[:, [DRAG_FACTOR, LIFT_FACTOR]] == 1.0)


def test_a_ball_that_starts_inside_the_net_is_not_valid():
    inside = (0.01, 0.0, 0.1)

    assert not is_valid(inside, (-6.0, 0.0, 2.0), (1.0, 0.0, 0.0), NOMINAL_AIR, NO_ROBOT)


def test_a_ball_that_touches_the_net_is_not_valid():
    over, net = ((0.5, 0.0, z) for z in (0.28, 0.20))

    assert is_valid(over, (-6.0, 0.0, 0.0), (1.0, 0.0, 0.0), NOMINAL_AIR, NO_ROBOT)
    assert not is_valid(net, (-6.0, 0.0, 0.0), (1.0, 0.0, 0.0), NOMINAL_AIR, NO_ROBOT)


def test_a_preset_without_valid_launches_is_an_error_not_an_endless_loop(monkeypatch):
    short = PRESETS["paper"]._replace(velocity=((-0.1,) * 7, (0.0,) * 7, (0.0,) * 7))
    monkeypatch.setattr("common.task.launch.PRESETS", {"paper": short})

    with pytest.raises(
        ValueError, match="launch preset 'paper': 0 valid rallies in 2000 candidates, wanted 2"
    ):
        draw_rallies(2, seed=1)
