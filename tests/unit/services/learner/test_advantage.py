import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from services.learner.advantage import gae


def gae_by_definition(rewards, values, terminated, truncated, final_values, last_values, gamma, lam):
    """Schulman et al. 2016, eq. 11-16, one sum of (gamma lambda)^l delta_{t+l} per entry."""
    steps, count = rewards.shape
    result = np.zeros((steps, count))
    for b in range(count):
        for t in range(steps):
            weight = 1.0
            for k in range(t, steps):
                if terminated[k, b]:
                    following = 0.0
                elif truncated[k, b]:
                    following = final_values[k, b]
                else:
                    following = values[k + 1, b] if k + 1 < steps else last_values[b]
                result[t, b] += weight * (rewards[k, b] + gamma * following - values[k, b])
                if terminated[k, b] or truncated[k, b]:
                    break
                weight *= gamma * lam
    return result


@given(
    seed=st.integers(0, 10_000), steps=st.integers(1, 12), gamma=st.floats(0.5, 0.999), lam=st.floats(0, 1)
)
def test_gae_equals_its_definition(seed, steps, gamma, lam):
    rng = np.random.default_rng(seed)
    shape = (steps, 4)
    rewards, values, final_values = (rng.normal(size=shape).astype(np.float32) for _ in range(3))
    ends = rng.uniform(size=shape)
    arguments = (
        rewards,
        values,
        ends < 0.15,
        ends > 0.85,
        final_values,
        rng.normal(size=4).astype(np.float32),
        gamma,
        lam,
    )

    np.testing.assert_allclose(gae(*arguments), gae_by_definition(*arguments), rtol=1e-4, atol=1e-5)


def test_advantages_do_not_cross_the_end_of_an_episode():
    rewards = np.array([[1.0], [1.0], [100.0]], np.float32)
    values = np.zeros((3, 1), np.float32)
    end = np.array([[False], [True], [False]])
    none, zero = np.zeros((3, 1), bool), np.zeros((3, 1), np.float32)

    advantage = gae(rewards, values, end, none, zero, np.zeros(1, np.float32), 0.5, 1.0)

    np.testing.assert_allclose(advantage[:, 0], [1.5, 1.0, 100.0])


def test_a_truncated_episode_bootstraps_from_its_own_last_observation_not_from_the_next_episode():
    rewards, values = np.zeros((2, 1), np.float32), np.array([[0.0], [50.0]], np.float32)
    cut = np.array([[True], [False]])
    final = np.array([[8.0], [0.0]], np.float32)

    advantage = gae(rewards, values, np.zeros((2, 1), bool), cut, final, np.zeros(1, np.float32), 0.5, 0.9)

    assert advantage[0, 0] == 4.0
