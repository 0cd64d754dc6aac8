"""RLlib: PPO with two processes that sample, and our trunk for policy and value.

Our vector environment is its vector entry point, which wants AutoresetMode.NEXT_STEP.
"""

import logging
import os
from typing import Any

os.environ.setdefault("RAY_agent_register_timeout_ms", "120000")  # a busy machine starts its agents late

import ray
import torch
from gymnasium.vector import AutoresetMode
from ray.rllib.algorithms.ppo import PPOConfig
from ray.rllib.core.columns import Columns
from ray.rllib.core.rl_module.apis.value_function_api import ValueFunctionAPI
from ray.rllib.core.rl_module.rl_module import RLModuleSpec
from ray.rllib.core.rl_module.torch import TorchRLModule
from ray.tune.registry import register_env
from torch import Tensor, nn

from benchmarks.peers import task
from common.policy.normalizer import SMALLEST_VARIANCE

RUNNERS = 2


class Module(TorchRLModule, ValueFunctionAPI):
    """Our trunk with its heads, behind a normaliser that learns from the datasets."""

    def setup(self) -> None:
        """Make the layers."""
        self.trunk = task.make_trunk()
        self.mean, self.value, self.log_std = task.make_heads(self.trunk)
        self.moments = nn.BatchNorm1d(task.OBS, affine=False, momentum=None)  # counts all data alike
        self.moments.eval()

    def hidden(self, obs: Tensor) -> Tensor:
        """Return the last hidden layer (N, 32)."""
        mean, scale = self.norm()
        hidden: Tensor = self.trunk(torch.clamp((obs - mean) / scale, -task.OBS_CLIP, task.OBS_CLIP))
        return hidden

    def norm(self) -> tuple[Tensor, Tensor]:
        """Return the observations' means, and what deviations from them are divided by (D,)."""
        mean, variance = self.moments.running_mean, self.moments.running_var
        if mean is None or variance is None:
            raise RuntimeError("a normaliser without moments")
        return mean, torch.sqrt(variance.clamp(min=SMALLEST_VARIANCE))

    def _forward(self, batch: dict[str, Any], **_: Any) -> dict[str, Any]:
        mean = self.mean(self.hidden(batch[Columns.OBS]))
        return {Columns.ACTION_DIST_INPUTS: torch.cat((mean, self.log_std.expand_as(mean)), dim=-1)}

    def _forward_train(self, batch: dict[str, Any], **_: Any) -> dict[str, Any]:
        self.moments.train()
        self.moments(batch[Columns.OBS])
        self.moments.eval()
        return self._forward(batch)

    def compute_values(self, batch: dict[str, Any], embeddings: Any = None) -> Tensor:
        """Return values (N,)."""
        values: Tensor = self.value(self.hidden(batch[Columns.OBS])).squeeze(-1)
        return values


def acting(module: Module) -> task.Normalized:
    """Return its deterministic policy."""
    mean, scale = module.norm()
    return task.Normalized(mean, scale, task.OBS_CLIP, nn.Sequential(module.trunk, module.mean))


def make_envs(context: Any) -> Any:
    """Return the batch of one process."""
    return task.make_envs(AutoresetMode.NEXT_STEP, threads=1, count=context["num_envs"])


def main() -> None:
    """Train."""
    asked = task.order()
    recorder = task.Recorder(asked)
    ray.init(num_cpus=task.CORES + RUNNERS, include_dashboard=False, logging_level=logging.ERROR)
    register_env("topspin", make_envs)
    envs = task.make_envs(count=1)
    config = (
        PPOConfig()
        .environment(
            "topspin", observation_space=envs.single_observation_space, action_space=envs.single_action_space
        )
        .env_runners(
            num_env_runners=RUNNERS,
            num_envs_per_env_runner=task.ENVS // RUNNERS,
            gym_env_vectorize_mode="vector_entry_point",
            rollout_fragment_length=task.HORIZON,
        )
        .training(
            train_batch_size_per_learner=task.FRAMES,
            minibatch_size=task.MINIBATCH,
            num_epochs=task.PASSES,
            gamma=task.GAMMA,
            lambda_=task.GAE_LAMBDA,
            clip_param=task.CLIP,
            lr=task.LEARNING_RATE,
            grad_clip=task.GRADIENT_NORM,
            use_kl_loss=False,
            entropy_coeff=0.0,
            vf_loss_coeff=0.5,
            vf_clip_param=1e9,
        )
        .rl_module(rl_module_spec=RLModuleSpec(module_class=Module))
        .debugging(seed=asked.seed, log_level="ERROR")
        .reporting(min_time_s_per_iteration=0)
    )
    trainer = config.build_algo()
    frames, is_over = 0, False
    while not is_over:
        result = trainer.train()
        frames = int(result["env_runners"]["num_env_steps_sampled_lifetime"])
        module = trainer.learner_group._learner.module["default_policy"].unwrapped()
        is_over = recorder.note(frames, lambda: acting(module))  # noqa: B023  # called at once
    trainer.stop()
    ray.shutdown()


if __name__ == "__main__":
    main()
