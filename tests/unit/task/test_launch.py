"""Launches: what a preset draws, which launches are valid, and that a block is a function of its arguments."""

import numpy as np
import pytest

from common.physics import touch
from common.physics.flight import FULL, Air
from common.physics.fly import NO_ROBOT, fly_to_touch
from common.physics.table_bounce import table_bounce
from common.physics.vec import Vec
from common.task.config import TaskConfig
from common.task.launch import (
    DRAG_FACTOR,
    KIND,
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
from common.task.launch_presets import KINDS, PRESETS, Kind, score_factor
from common.task.randomization import PROFILES, RallyParameter, draw_parameters

NOMINAL_AIR = Air(1.0, 1.0, FULL)
TABLE = (0.97, 0.25)

every_preset = pytest.mark.parametrize("preset", PRESETS)


def fly(row: Array, seed: np.uint64) -> tuple[tuple[Vec, Vec, float, int, Vec], ...]:
    """Return the flight to the first touch; of a serve the flight to the next one too, from the rally's own table."""
    position, velocity, spin = (tuple(map(float, row[part])) for part in (POSITION, VELOCITY, SPIN))
    air = Air(row[DRAG_FACTOR], row[LIFT_FACTOR], FULL)
    first = fly_to_touch(position, velocity, spin, 2.0, air, NO_ROBOT)
    if row[KIND] != Kind.SERVE:
        return (first,)
    parameters = np.empty(len(RallyParameter))
    draw_parameters(seed, 1.0, 1.0, 0.0, PROFILES["standard"], parameters)
    velocity, spin = table_bounce(first[1], spin, first[4], *parameters[[2, 3]])
    return first, fly_to_touch(first[0], velocity, spin, 2.0, air, NO_ROBOT)


def quantities(rows: Array) -> Array:
    """Return x, y, z, speed, elevation, azimuth, topspin, corkscrew and sidespin of launches (9, n)."""
    (vx, vy, vz), (wx, wy, wz) = rows[:, VELOCITY].T, rows[:, SPIN].T
    flat = np.hypot(vx, vy)
    forward = np.stack((vx, vy)) / flat
    return np.stack(
        (
            *rows[:, POSITION].T,
            np.hypot(flat, vz),
            np.arctan2(vz, flat),
            np.arctan2(vy, -vx),
            forward[0] * wy - forward[1] * wx,
            forward[0] * wx + forward[1] * wy,
            wz,
        )
    )


def ranks(values: Array) -> Array:
    return values.argsort(axis=1).argsort(axis=1)


def expect_same_bits(a: RallyBlock, b: RallyBlock) -> None:
    assert a.launches.tobytes() == b.launches.tobytes()
    assert a.seeds.tobytes() == b.seeds.tobytes()
    assert a.drawn == b.drawn


@every_preset
def test_every_rally_crosses_the_net_and_touches_the_robots_court_first_or_as_a_serve_second(preset):
    block = draw_rallies(300, TaskConfig(launch=preset), seed=1)
    flights = [fly(row, seed) for row, seed in zip(block.launches, block.seeds, strict=True)]

    assert np.all(block.launches[:, 0] > 0.0)
    for *first, last in flights:
        assert [touched for _, _, _, touched, _ in first] == [touch.OPPONENT_COURT] * len(first)
        assert last[3] == touch.ROBOT_COURT
        assert last[0][0] < 0.0
        assert abs(last[0][1]) <= 0.7625


@every_preset
@pytest.mark.parametrize("profile", PROFILES)
def test_every_launch_lies_within_its_kinds_ranges(preset, profile):
    rows = draw_rallies(500, TaskConfig(launch=preset, randomization=profile), seed=3).launches
    air = PROFILES[profile]

    for kind, share in enumerate(PRESETS[preset]):
        own = rows[rows[:, KIND] == kind]
        assert len(own) / 500 == pytest.approx(share, abs=0.07)  # three standard errors
        for column, curve in enumerate(KINDS[kind].position):
            assert np.all((own[:, column] >= min(curve)) & (own[:, column] <= max(curve)))
    assert np.all((rows[:, DRAG_FACTOR] >= air.drag_factor[0]) & (rows[:, DRAG_FACTOR] <= air.drag_factor[1]))
    assert np.all(rows[:, LIFT_FACTOR] >= air.lift_factor[0])
    assert np.all(rows[:, LIFT_FACTOR] <= air.lift_factor[1] + air.backspin_lift)


def test_slow_backspin_has_lift_factors_up_to_1_8_and_other_balls_to_1_2():
    rows = draw_rallies(20_000, TaskConfig(launch="match"), seed=12).launches
    topspin, rate = quantities(rows)[6], np.linalg.norm(rows[:, SPIN], axis=1)
    slowness = 0.02 * rate / np.linalg.norm(rows[:, VELOCITY], axis=1)
    lift = rows[:, LIFT_FACTOR]
    is_slow = (topspin < -0.95 * rate) & (slowness > 0.5)

    assert is_slow.sum() > 200
    assert 1.7 < lift[is_slow].max() <= 1.8
    assert np.median(lift[is_slow]) == pytest.approx(1.3, abs=0.07)  # recorded balls need 1.24 in the median
    assert lift[(topspin > 0.0) | (slowness < 0.25)].max() <= 1.2


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


# Facts about 610 strokes of elite and professional players, at the moment of the stroke: percentiles 5, 25, 50, 75, 95
PLAYERS = [
    (0.99, 1.32, 1.59, 1.97, 2.63),  # x [m]
    (-0.64, -0.30, -0.04, 0.31, 0.65),  # y
    (0.07, 0.17, 0.21, 0.26, 0.34),  # z
    (5.3, 6.7, 10.4, 15.3, 20.2),  # speed [m/s]
    (1.2, 6.1, 9.7, 14.6, 23.6),  # elevation [deg]
    (-23.0, -7.7, 1.7, 10.5, 20.6),  # azimuth [deg]
    (-269.0, -104.0, 287.0, 480.0, 750.0),  # topspin [rad/s]
    (-86.0, -25.0, 0.5, 26.0, 91.0),  # corkscrew
    (-122.0, -31.0, 25.0, 92.0, 220.0),  # sidespin
]
PLAYERS_RANK_CORRELATIONS = {
    (3, 0): 0.59,
    (3, 2): 0.53,
    (3, 4): -0.70,
    (3, 6): 0.78,
    (6, 0): 0.52,
    (6, 2): 0.34,
    (6, 4): -0.39,
    (2, 4): -0.66,
    (1, 5): -0.79,
}


def test_valid_rallies_of_preset_match_are_distributed_as_players_strokes():
    found = quantities(draw_rallies(8000, TaskConfig(launch="match"), seed=5).launches)
    found[4:6] = np.rad2deg(found[4:6])
    correlation = np.corrcoef(ranks(found))

    for values, wanted in zip(found, PLAYERS, strict=True):
        reached = np.percentile(values, [5, 25, 50, 75, 95])
        np.testing.assert_allclose(reached, wanted, atol=0.05 * (wanted[-1] - wanted[0]))
    for (one, other), rank in PLAYERS_RANK_CORRELATIONS.items():
        assert correlation[one, other] == pytest.approx(rank, abs=0.08)


def test_preset_elite_has_the_fast_and_spinning_strokes_of_preset_match():
    found = quantities(draw_rallies(500, TaskConfig(launch="elite"), seed=5).launches)
    spin = np.linalg.norm(found[6:], axis=0)

    assert found[3].min() >= 15.0
    assert found[3].max() <= 20.0
    assert spin.min() >= 600.0
    assert np.mean(found[6] > 500.0) > 0.9  # topspin


def test_correlations_that_no_distribution_has_are_an_error():
    with pytest.raises(ValueError, match="fit no joint distribution"):
        score_factor({("x", "y"): 0.9, ("y", "z"): 0.9, ("x", "z"): -0.9})


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
        kind = int(row[KIND])
        position, velocity, spin, drag, lift = launch(KINDS[kind], PROFILES["standard"], seed)

        assert np.array([*position, *velocity, *spin, drag, lift, kind]).tobytes() == row.tobytes()


def test_a_rally_flies_again_bit_for_bit_from_its_stored_row():
    block = draw_rallies(50, TaskConfig(launch="all"), seed=10)
    stored = np.frombuffer(block.launches.tobytes()).reshape(block.launches.shape)

    for again, row, seed in zip(stored, block.launches, block.seeds, strict=True):
        assert fly(again, seed) == fly(row, seed)


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

    assert not is_valid(inside, (-6.0, 0.0, 2.0), (1.0, 0.0, 0.0), NOMINAL_AIR, False, TABLE, NO_ROBOT)


def test_a_ball_that_touches_the_net_is_not_valid():
    over, net = ((0.5, 0.0, z) for z in (0.28, 0.20))

    assert is_valid(over, (-6.0, 0.0, 0.0), (1.0, 0.0, 0.0), NOMINAL_AIR, False, TABLE, NO_ROBOT)
    assert not is_valid(net, (-6.0, 0.0, 0.0), (1.0, 0.0, 0.0), NOMINAL_AIR, False, TABLE, NO_ROBOT)


def test_a_serve_is_valid_only_if_it_bounces_on_both_courts_in_their_order():
    serve = ((1.5, 0.2, 0.25), (-5.2, -0.2, -2.0), (0.0, 40.0, 10.0))
    too_fast = (serve[0], (-9.0, -0.2, -2.0), serve[2])  # its second bounce is beyond the robot's court
    rally = ((1.2, 0.1, 0.25), (-5.2, -0.3, 1.5), (0.0, -90.0, 20.0))

    assert is_valid(*serve, NOMINAL_AIR, True, TABLE, NO_ROBOT)
    assert not is_valid(*serve, NOMINAL_AIR, False, TABLE, NO_ROBOT)
    assert not is_valid(*too_fast, NOMINAL_AIR, True, TABLE, NO_ROBOT)
    assert is_valid(*rally, NOMINAL_AIR, False, TABLE, NO_ROBOT)
    assert not is_valid(*rally, NOMINAL_AIR, True, TABLE, NO_ROBOT)


def test_a_preset_without_valid_launches_is_an_error_not_an_endless_loop(monkeypatch):
    short = KINDS[0]._replace(velocity=((-0.1,) * 7, (0.0,) * 7, (0.0,) * 7))
    monkeypatch.setattr("common.task.launch.KINDS", (short, *KINDS[1:]))

    with pytest.raises(
        ValueError, match="launch preset 'paper': 0 valid rallies in 2000 candidates, wanted 2"
    ):
        draw_rallies(2, seed=1)
