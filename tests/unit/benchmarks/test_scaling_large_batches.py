"""Frames to the goal by the size of datasets: the fit finds a law that made the points."""

import numpy as np
import pytest

from benchmarks.scaling.large_batches import Point, fit, read
from common.errors import ReportedError

SIZES = (4096, 8192, 32768, 131072, 524288)
FILE = (
    '{"return_rate": 0.81, "target_error": 0.31, '
    '"points": [{"dataset": 8192, "minibatch": 2048, "frames": %s, "limit": 60000000, "seed": 0}]}'
)


def points_of(least, noise, factors=(1.0,)):
    return [
        Point(
            dataset=size,
            minibatch=2048,
            frames=round(factor * least * (1 + size / noise)),
            limit=60_000_000,
            seed=seed,
        )
        for size in SIZES
        for seed, factor in enumerate(factors)
    ]


@pytest.mark.parametrize(("least", "noise"), [(8e6, 60_000.0), (2e6, 3000.0), (3e7, 2e6)])
def test_the_fit_finds_the_law_that_made_the_points(least, noise):
    law = fit(points_of(least, noise))

    assert law.least == pytest.approx(least, rel=1e-3)
    assert law.noise == pytest.approx(noise, rel=1e-3)
    assert law.spread < 1e-4


def test_seeds_that_scatter_alike_leave_the_law_and_are_its_spread():
    law = fit(points_of(8e6, 60_000.0, factors=(np.exp(-0.2), np.exp(0.2))))

    assert law.least == pytest.approx(8e6, rel=1e-3)
    assert law.noise == pytest.approx(60_000.0, rel=1e-3)
    assert law.spread == pytest.approx(0.2 * np.sqrt(10 / 8), rel=1e-3)  # 10 points less 2 fitted numbers


def test_twice_the_noise_size_needs_three_times_the_least_frames():
    law = fit(points_of(8e6, 60_000.0))

    assert law.frames(120_000) == pytest.approx(2.4e7, rel=1e-3)
    assert law.frames(1) == pytest.approx(8e6, rel=1e-3)


def test_frames_that_do_not_grow_give_a_noise_size_far_above_the_datasets():
    law = fit(
        [Point(dataset=size, minibatch=2048, frames=9_000_000, limit=60_000_000, seed=0) for size in SIZES]
    )

    assert law.noise > 100 * max(SIZES)
    assert law.frames(max(SIZES)) == pytest.approx(9e6, rel=0.01)


def test_trainings_that_missed_the_goal_are_counted_and_left_out():
    missed = [
        Point(dataset=524288, minibatch=2048, frames=None, limit=60_000_000, seed=7),
        Point(dataset=2**21, minibatch=2048, frames=None, limit=60_000_000, seed=8),
    ]
    law = fit([*points_of(8e6, 60_000.0), *missed])

    assert (law.reached, law.missed) == (5, 2)
    assert law.least == pytest.approx(8e6, rel=1e-3)
    assert [law.is_extrapolated(size) for size in (2048, 4096, 524288, 2**21)] == [True, False, False, True]


def test_one_size_of_datasets_gives_no_law():
    points = [
        Point(dataset=8192, minibatch=2048, frames=9_000_000, limit=60_000_000, seed=seed)
        for seed in range(3)
    ]

    with pytest.raises(
        ReportedError, match=r"^trainings that reached the goal have 1 sizes of datasets; allowed: two"
    ):
        fit(points)


def test_no_file_is_no_points(tmp_path):
    assert read(tmp_path / "large_batches.json") is None


def test_a_file_of_trainings_is_read(tmp_path):
    file = tmp_path / "large_batches.json"
    file.write_text(FILE % 9_000_000)

    assert read(file).points == (
        Point(dataset=8192, minibatch=2048, frames=9_000_000, limit=60_000_000, seed=0),
    )


@pytest.mark.parametrize(
    ("text", "fault"),
    [
        ("[", "Invalid JSON"),
        (FILE % 0, "points.0.frames: Input should be greater than 0"),
        (FILE % '"many"', "points.0.frames: Input should be a valid integer"),
        ('{"points": []}', "return_rate: Field required"),
    ],
)
def test_another_file_is_refused_in_one_line_with_an_example(tmp_path, text, fault):
    file = tmp_path / "large_batches.json"
    file.write_text(text)

    with pytest.raises(ReportedError) as refused:
        read(file)

    line = str(refused.value)
    assert line.startswith(f"{file}: {fault}")
    assert 'allowed: {"return_rate": 0.81' in line
    assert "\n" not in line
