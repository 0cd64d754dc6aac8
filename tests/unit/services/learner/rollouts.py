"""Rollouts for the learner's tests, with defaults."""

import numpy as np

from common.comms.messages import Episodes, Rollout

OBS, ACTIONS, TERMS = 37, 7, 8
STEPS, ENVS = 16, 8
ROLLOUT_FRAMES = STEPS * ENVS


def make_rollout(seed=0, steps=STEPS, envs=ENVS, obs_size=OBS, **changes):
    """Return a rollout of random numbers: its content is meaningless, its form is valid."""
    rng = np.random.default_rng(seed)
    ends = rng.uniform(size=(steps, envs))
    truncated = ends > 0.97
    episodes = 5
    values = {
        "run": "r",
        "generation": 1,
        "version": 0,
        "stage_number": 0,
        "actor": "0",
        "incarnation": 1,
        "sequence": seed,
        "training_hash": "c",
        "obs": rng.normal(size=(steps, envs, obs_size)).astype(np.float32),
        "actions": rng.normal(size=(steps, envs, ACTIONS)).astype(np.float32) * 0.2,
        "log_mu": rng.normal(size=(steps, envs)).astype(np.float32),
        "rewards": rng.normal(size=(steps, envs)).astype(np.float32),
        "terminated": ends < 0.03,
        "truncated": truncated,
        "final_obs": rng.normal(size=(int(truncated.sum()), obs_size)).astype(np.float32),
        "final_index": np.flatnonzero(truncated).astype(np.int32),
        "last_obs": rng.normal(size=(envs, obs_size)).astype(np.float32),
        "episodes": Episodes(
            outcome=np.array([1, 1, 2, 10, 9], np.uint8),
            target_error=np.array([0.2, 0.4, np.nan, np.nan, np.nan], np.float32),
            caught=np.array([True, True, True, False, False]),
            over=np.array([True, True, False, False, False]),
            landed=np.array([True, True, False, False, False]),
            unvalidated=np.array([False, True, False, False, False]),
            returns=np.ones(episodes, np.float32),
        ),
        "reward_terms": np.arange(TERMS, dtype=np.float32),
        "corrections": np.zeros((steps, envs, ACTIONS), np.float32),
    }
    return Rollout(**(values | changes))
