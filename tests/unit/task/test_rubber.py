"""The racket's rubber is a setting of the task: its ranges, its friction, and how it returns spin."""

from typing import get_args

import numpy as np
import pytest
from pydantic import ValidationError

from common.physics.constants import RUBBERS
from common.policy.box import policy_folder
from common.policy.config import NetworkConfig
from common.policy.contract import contract_hash
from common.policy.folder import load_policy
from common.task.config import RubberName, TaskConfig
from common.task.randomization import (
    PROFILES,
    RALLY_PARAMETERS,
    RallyParameter,
    RandomizationProfile,
    draw_parameters,
    profile_of,
    rubber_of,
)
from common.task.states import State
from tests.unit.env.rallies import QUIET, make_env
from tests.unit.rally.scripted import HOME, play_ball

RACKET = slice(RallyParameter.RACKET_RESTITUTION0, RallyParameter.RACKET_SPIN_LOSS + 1)
every_rubber = pytest.mark.parametrize("rubber", get_args(RubberName))
every_profile = pytest.mark.parametrize("name", PROFILES)


def drawn(profile: RandomizationProfile, seeds: int = 500) -> np.ndarray:
    rows = np.empty((seeds, RALLY_PARAMETERS))
    for seed in range(seeds):
        draw_parameters(np.uint64(seed), 1.0, 1.0, 0.0, profile, rows[seed])
    return rows


def test_every_published_rubber_is_a_setting():
    assert set(get_args(RubberName)) == set(RUBBERS)


@every_profile
def test_inverted_rubber_has_the_bits_of_the_profile(name):
    assert TaskConfig().rubber == "inverted"
    assert profile_of(name) == profile_of(name, "inverted") == PROFILES[name]


@every_rubber
def test_without_randomization_a_rally_has_the_published_rubber(rubber):
    row = drawn(profile_of("off", rubber), 1)[0]

    np.testing.assert_allclose(rubber_of(row), RUBBERS[rubber], rtol=1e-12)


def test_the_ranges_of_another_rubber_are_as_wide_in_percent():
    """Long pips: 0.749, 0.0073 s/m and 0.30, where inverted rubber has 0.878, 0.020 s/m and 0.70."""
    rows = drawn(profile_of("standard", "long_pips"), 2000)[:, RACKET]
    low, high = (
        np.array([0.85 / 0.878 * 0.749, 0.015 / 0.020 * 0.0073, 0.64 / 0.70 * 0.30, 0.0]),
        np.array([0.93 / 0.878 * 0.749, 0.023 / 0.020 * 0.0073, 0.76 / 0.70 * 0.30, 0.25]),
    )

    np.testing.assert_allclose(rows.min(axis=0), low, atol=0.01 * (high - low).max())
    np.testing.assert_allclose(rows.max(axis=0), high, atol=0.01 * (high - low).max())


@every_rubber
@every_profile
def test_no_rubber_creates_energy_or_has_a_negative_parameter(name, rubber):
    """Above alpha = 4/5 a contact would add energy."""
    rows = drawn(profile_of(name, rubber))

    assert rows[:, RACKET].min() >= 0.0
    assert rows[:, RallyParameter.RACKET_RESTITUTION0].max() < 1.0
    assert rows[:, RallyParameter.RACKET_ALPHA].max() <= 0.8


@pytest.mark.parametrize(("name", "factor"), [("off", 0.0), ("standard", 0.2), ("hard", 0.4)])
def test_the_friction_of_anti_spin_varies_as_the_tables_does(name, factor):
    friction = drawn(profile_of(name, "anti_spin"), 2000)[:, RallyParameter.RACKET_FRICTION]

    np.testing.assert_allclose(friction.min(), 0.189 * (1 - factor), atol=0.001)
    np.testing.assert_allclose(friction.max(), 0.189 * (1 + factor), atol=0.001)


@every_profile
def test_inverted_rubber_never_slides(name):
    assert np.all(np.isinf(drawn(profile_of(name))[:, RallyParameter.RACKET_FRICTION]))


def returned_topspin(rubber: str) -> float:
    """Return the spin about y after a racket at rest has returned a ball of 8 m/s with a topspin of 600 rad/s."""
    played = play_ball(
        (-0.75, 0, 0.23),
        (-8, 0, 0.5),
        (0, -600, 0),
        state=State.TAU_12,
        joints=HOME,
        profile=profile_of("off", rubber),
        steps=3,
    )
    assert played.caught
    return float(played.balls[-1, 7])


def test_anti_spin_returns_spin_that_inverted_rubber_turns_round():
    """Anti-spin slides: J/m = 0.189 (1 + 0.533) 8 m/s = 2.318 m/s, and 3/2r = 75 1/m makes 173.8 rad/s of it.

    The face is tilted by 2 degrees."""
    assert returned_topspin("inverted") > 0.0
    assert returned_topspin("anti_spin") == pytest.approx(-600.0 + 173.8, abs=0.5)


@pytest.mark.parametrize(("rubber", "friction"), [("inverted", np.inf), ("anti_spin", 0.189)])
def test_an_environment_plays_with_the_tasks_rubber(rubber, friction):
    env = make_env(2, task=QUIET.model_copy(update={"rubber": rubber}))
    env.reset()

    np.testing.assert_array_equal(env.rallies.parameters[:, RallyParameter.RACKET_FRICTION], [friction] * 2)


def test_a_rubber_that_is_not_published_is_refused():
    with pytest.raises(ValidationError, match=r"rubber\n.*'inverted', 'short_pips'.*'anti_spin'"):
        TaskConfig.model_validate({"rubber": "sandpaper"})


def test_mujocos_contacts_have_no_rubber_to_select():
    with pytest.raises(
        ValidationError, match=r"rubber anti_spin with collision original.*allowed: collision tailored"
    ):
        TaskConfig(rubber="anti_spin", collision="original")


def test_another_rubber_is_another_contract():
    network = NetworkConfig()

    assert contract_hash(TaskConfig(rubber="anti_spin"), network) != contract_hash(TaskConfig(), network)


@pytest.mark.parametrize("policy", ["default", "paper"])
def test_the_policies_of_the_box_were_trained_with_inverted_rubber(policy):
    """Their contracts were written before there was a choice."""
    assert load_policy(policy_folder(policy)).contract.task.rubber == "inverted"
