"""Registered environments, single and in batches, and random play."""

import gymnasium
import numpy as np

from topspin.gym_ids import ENV_ID


def make(**settings) -> gymnasium.Env:
    return gymnasium.make(ENV_ID, **settings)


def make_vec(num_envs: int = 8, **settings) -> gymnasium.vector.VectorEnv:
    return gymnasium.make_vec(ENV_ID, num_envs=num_envs, **settings)


def play(env: gymnasium.Env, steps: int, seed: int = 0) -> list[np.ndarray]:
    """Return the observations of random play, episode after episode."""
    env.action_space.seed(seed)
    obs, _ = env.reset(seed=seed)
    seen = [obs]
    for _ in range(steps):
        obs, _, terminated, truncated, _ = env.step(env.action_space.sample())
        seen.append(obs)
        if terminated or truncated:
            seen.append(env.reset()[0])
    return seen
