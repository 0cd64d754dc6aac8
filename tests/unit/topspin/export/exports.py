"""Small policies, and their export."""

from pathlib import Path

import numpy as np

from common.policy.config import NetworkConfig
from common.policy.contract import contract_of
from common.policy.folder import Policy
from common.policy.normalizer import Moments
from common.policy.weights import new_network
from common.task.config import TaskConfig
from common.task.experience import ExperienceConfig
from common.task.observation import PAPER_OBSERVATION, policy_layout, size
from topspin.export.folder import export_policy

ROOT = Path(__file__).parents[4]


def small_policy(**observation):
    """Return an untrained policy of the paper's 37 numbers, whose actions meet their limits."""
    options = PAPER_OBSERVATION.model_copy(update=observation)
    task, network_config = TaskConfig(observation=options), NetworkConfig(units=(16, 8))
    network, width = new_network(network_config, options), size(policy_layout(options))
    network.mean.weight.data.mul_(100.0)
    rng = np.random.default_rng(1)
    moments = Moments(rng.normal(size=width), rng.uniform(0.0, 2.0, width), 100)
    where = {"generation": 1, "version": 2, "stage": 3, "frames": 4}
    contract = contract_of(task, ExperienceConfig(), network_config, run="night", **where)
    return Policy(network, moments, contract)


def export(policy, out, name):
    return export_policy(policy, name, out)
