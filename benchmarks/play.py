"""An actor's player and its first policy, in memory: what benchmarks of actor and learner measure with."""

import numpy as np

from benchmarks.env import MemoryRallies
from common.comms.messages import PolicySnapshot
from common.policy.actor_critic import NetworkConfig
from common.policy.contract import contract_hash, training_hash
from common.policy.weights import pack
from common.task.config import TaskConfig
from common.task.experience import ExperienceConfig
from common.task.launch import draw_rallies
from services.actor.player import Player
from services.learner.training import Training

RALLIES = 20_000  # drawn before the measurement, and repeated
HORIZON = 32  # control steps of a rollout


def make_player(training: Training, network: NetworkConfig, stage: int, envs: int, seed: int) -> Player:
    """Return a player with the policy of ``training``."""
    task, experience = TaskConfig(), ExperienceConfig()
    source = MemoryRallies(draw_rallies(RALLIES, task, seed=seed))
    player = Player(task, experience, network, source, envs, HORIZON, seed)
    moments = training.obs_moments
    player.adopt(
        PolicySnapshot(
            run="benchmark",
            generation=1,
            version=training.progress.version,
            stage=stage,
            stage_number=0,
            epoch=0,
            frames=0,
            contract_hash=contract_hash(task, network),
            training_hash=training_hash(task, network, experience),
            weights=pack(training.network),
            obs_mean=np.asarray(moments.mean),
            obs_var=np.asarray(moments.var),
            obs_count=moments.count,
        )
    )
    return player
