"""An actor's player and its first policy, in memory: what benchmarks of actor and learner measure with."""

import numpy as np

from benchmarks.env import RALLIES, MemoryRallies
from common.comms.messages import PolicySnapshot
from common.env.robot import home_action
from common.policy.config import NetworkConfig
from common.policy.contract import contract_hash, training_hash
from common.policy.weights import pack
from common.task.config import TaskConfig
from common.task.experience import ExperienceConfig
from common.task.launch import draw_rallies
from services.actor.player import Player
from services.learner.compute import compute_of
from services.learner.config import CurriculumConfig, Device, PPOConfig
from services.learner.curriculum import StageLengths
from services.learner.group import ALONE, Group
from services.learner.training import Training

HORIZON = 32  # control steps of a rollout


STAGE = 3  # the stage that a run spends most of its frames in


def make_training(ppo: PPOConfig, seed: int, group: Group = ALONE, device: Device = "cpu") -> Training:
    """Return a new training of the default task and network."""
    task = TaskConfig()
    curriculum = CurriculumConfig(first_stage=STAGE)
    home = home_action(task.robot)
    training = Training(
        *(ppo, NetworkConfig(), StageLengths(curriculum), home, seed),
        observation=task.observation,
        compute=compute_of(ppo, device),
    )
    training.group = group
    return training


def make_player(training: Training, envs: int, seed: int) -> Player:
    """Return a player with the policy of a training of ``make_training``."""
    task, experience, network = TaskConfig(), ExperienceConfig(), training.network_config
    source = MemoryRallies(draw_rallies(RALLIES, task, seed=seed))
    player = Player(task, experience, network, source, envs, HORIZON, seed)
    moments = training.obs_moments
    player.adopt(
        PolicySnapshot(
            run="benchmark",
            generation=1,
            version=training.progress.version,
            stage=STAGE,
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
