"""Teachers for the tests: policies that know nothing, but are whole."""

from pathlib import Path

import numpy as np

from common.env.rally_env import EnvConfig, TeacherConfig
from common.policy.actor_critic import NetworkConfig
from common.policy.normalizer import Moments
from common.policy.weights import contract_of, new_network, save_policy
from common.rally.observation import policy_layout, size

NETWORK = NetworkConfig(units=(16, 8))


def write_teacher(folder: Path, **task) -> TeacherConfig:
    """Write a random policy for a task with these settings; return who teaches the first five epochs by it."""
    env = EnvConfig(**task)
    width = size(policy_layout(env.observation))
    network = new_network(NETWORK, env.observation.model_copy(update={"critic": "policy"}))
    moments = Moments(np.zeros(width), np.full(width, 4.0), 10)
    contract = contract_of(env, NETWORK, "paper", run="t", generation=1, version=1, stage=3, frames=1)
    save_policy(folder, network, moments, contract)
    return TeacherConfig(policy=str(folder), epochs=5)
