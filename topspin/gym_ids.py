"""The Gymnasium ids of the environments."""

from typing import Final

import gymnasium

ENV_ID: Final = "topspin/Rally-v0"


def register_envs() -> None:
    """Register the ids, once."""
    if ENV_ID not in gymnasium.registry:
        gymnasium.register(
            ENV_ID,
            entry_point="topspin.gym:RallyGymEnv",
            vector_entry_point="topspin.gym_vector:RallyVectorEnv",
        )
