"""Numbers that differ from rally to rally do not depend on each other: all pairs, over 4,000 rallies."""

from functools import cache
from itertools import combinations

import numpy as np
import pytest

from common.env.rally_env import draw_robot
from common.task.config import TaskConfig
from common.task.launch import Purpose, draw_rallies
from common.task.randomization import PROFILES, RALLY_PARAMETERS, RallyParameter, draw_parameters

RALLIES = 4000
# A correlation of 4,000 independent pairs has a standard error of 0.016. One of 1,400 pairs exceeds 5 of them once in
# 1,200 sets of seeds, and the seeds here are always the same.
LARGEST = 5.0 / RALLIES**0.5
NOT_ALWAYS_DRAWN = (RallyParameter.BURST_START, RallyParameter.BURST_END, RallyParameter.KIND)


@cache
def drawn_numbers() -> dict[str, np.ndarray]:
    """Return all that is drawn for a rally of profile ``hard``, by name, (RALLIES,) each.

    The launches are not validated: among valid ones position, velocity and air depend on each other.
    """
    block = draw_rallies(RALLIES, TaskConfig(randomization="hard"), seed=1, purpose=Purpose.FALLBACK)
    profile = PROFILES["hard"]._replace(racket_friction=1.0)  # a rubber that slides
    parameters = np.empty((RALLIES, RALLY_PARAMETERS))
    for seed, launch, row in zip(block.seeds, block.launches, parameters, strict=True):
        draw_parameters(seed, launch[9], launch[10], launch[11], profile, row)
    gains, offset = np.empty((RALLIES, 3, 7)), np.empty((RALLIES, 7))
    _, continues, ends = draw_robot(block.seeds, profile, 0.5, 0.1, gains, offset)
    found = {f"launch {k}": block.launches[:, k] for k in range(9)}
    found |= {p.name: parameters[:, p] for p in RallyParameter if p not in NOT_ALWAYS_DRAWN}
    found |= {f"gain {g} of joint {j}": gains[:, g, j] for g in range(3) for j in range(7)}
    found |= {f"start of joint {j}": offset[:, j] for j in range(7)}
    return found | {"continues": continues, "ends at the hit": ends}


def correlated(values: dict[str, np.ndarray]) -> list[tuple[str, str, float]]:
    """Return the pairs of numbers that are correlated. Lift depends on the launch: slow backspin may have more."""
    names, matrix = list(values), np.corrcoef(np.array(list(values.values())))
    pairs = combinations(range(len(names)), 2)
    return [
        (names[i], names[j], matrix[i, j])
        for i, j in pairs
        if not abs(matrix[i, j]) < LARGEST
        and not (names[i].startswith("launch") and names[j] == RallyParameter.LIFT.name)
    ]


def test_no_two_numbers_of_a_rally_are_correlated():
    assert correlated(drawn_numbers()) == []


def test_the_size_of_a_number_says_nothing_about_the_size_of_another():
    """Distances from the mean: they show a dependence that a correlation does not, such as y = |x|.

    The three components of a spin share its length.
    """
    spin = ("launch 6", "launch 7", "launch 8")
    sizes = {name: np.abs(x - x.mean()) for name, x in drawn_numbers().items()}

    assert [pair for pair in correlated(sizes) if not set(pair[:2]) <= set(spin)] == []


@pytest.mark.parametrize("name", ["TABLE_RESTITUTION0", "RACKET_ALPHA", "gain 0 of joint 0"])
def test_a_number_is_not_correlated_with_that_of_the_next_rally(name):
    x = drawn_numbers()[name]

    assert abs(np.corrcoef(x[1:], x[:-1])[0, 1]) < LARGEST
