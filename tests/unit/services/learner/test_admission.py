"""What makes the content of a rollout unusable."""

import numpy as np
import pytest

from services.learner.admission import content_fault
from tests.unit.services.learner.rollouts import make_rollout


def made(name: str, value: float):
    """Return a rollout with one number of ``name`` replaced."""
    rollout = make_rollout(1, truncated=np.eye(16, 8, dtype=bool))
    rollout = make_rollout(
        1,
        truncated=rollout.truncated,
        final_obs=np.zeros((8, 37), np.float32),
        final_index=np.flatnonzero(rollout.truncated).astype(np.int32),
    )
    array = getattr(rollout, name).copy()
    array.flat[-1] = value
    return make_rollout(1, **{"truncated": rollout.truncated, "final_obs": rollout.final_obs,
                              "final_index": rollout.final_index, name: array})  # fmt: skip


@pytest.mark.parametrize(
    ("name", "largest"),
    [("obs", 1e4), ("last_obs", 1e4), ("final_obs", 1e4), ("actions", 1e3), ("rewards", 1e5)],
)
@pytest.mark.parametrize("sign", [-1, 1])
def test_an_extreme_number_makes_a_rollout_invalid(name, largest, sign):
    assert content_fault(made(name, sign * 0.99 * largest), 37) == ""
    assert content_fault(made(name, sign * 1.01 * largest), 37).startswith(f"{name} of ")


def test_a_rollout_of_another_observation_is_invalid():
    assert content_fault(make_rollout(), 54) == "37 observations; allowed: 54"


def test_a_rollout_with_other_reward_terms_is_invalid():
    assert (
        content_fault(make_rollout(reward_terms=np.zeros(7, np.float32)), 37) == "7 reward terms; allowed: 8"
    )
