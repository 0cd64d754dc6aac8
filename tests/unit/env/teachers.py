"""Teachers for the tests: random policies in complete folders."""

from pathlib import Path

import numpy as np

from common.policy.config import NetworkConfig
from common.policy.contract import contract_of
from common.policy.folder import save_policy
from common.policy.normalizer import Moments
from common.policy.weights import new_network
from common.task.config import TaskConfig
from common.task.experience import ExperienceConfig, TeacherConfig
from common.task.observation import policy_layout, size

NETWORK = NetworkConfig(units=(16, 8))


def write_teacher(folder: Path, **settings) -> TeacherConfig:
    """Write a random policy for a task with these settings, and return it as the teacher of the first five epochs."""
    task = TaskConfig(**settings)
    width = size(policy_layout(task.observation))
    network = new_network(NETWORK, task.observation.model_copy(update={"critic": "policy"}))
    moments = Moments(np.zeros(width), np.full(width, 4.0), 10)
    contract = contract_of(
        task, ExperienceConfig(), NETWORK, run="t", generation=1, version=1, stage=3, frames=1
    )
    save_policy(folder, network, moments, contract)
    return TeacherConfig(policy=str(folder), epochs=5)
