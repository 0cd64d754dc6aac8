"""rsl_rl: PPO with its adaptive learning rate and normaliser. Policy and value have a trunk of ours each."""

import math
from typing import Any

import torch
from rsl_rl.env import VecEnv
from rsl_rl.models import MLPModel
from rsl_rl.runners import OnPolicyRunner
from tensordict import TensorDict
from torch import Tensor, nn

from benchmarks.peers import task


class Envs(VecEnv):
    """Our vector environment as its VecEnv."""

    def __init__(self, seed: int) -> None:
        self._envs = task.make_envs()
        self._obs, _ = self._envs.reset(seed=seed)
        self.num_envs, self.num_actions, self.device = task.ENVS, task.ACTIONS, "cpu"
        self.cfg: dict[str, Any] = {}
        self.max_episode_length = round(task.TASK.time_limit_s * task.TASK.control_rate_hz)
        self.episode_length_buf = torch.zeros(task.ENVS, dtype=torch.long)

    def get_observations(self) -> TensorDict:
        """Return the present observations."""
        return TensorDict({"policy": torch.from_numpy(self._obs)}, batch_size=[self.num_envs])

    def step(self, actions: Tensor) -> tuple[TensorDict, Tensor, Tensor, dict[str, Any]]:
        """Play a control step."""
        self._obs, rewards, terminated, truncated, _ = self._envs.step(actions.numpy())
        scaled = torch.from_numpy(rewards).float() * task.REWARD_SCALE
        dones = torch.from_numpy(terminated | truncated).long()
        return self.get_observations(), scaled, dones, {"time_outs": torch.from_numpy(truncated)}


class Model(MLPModel):
    """Its model, with our trunk."""

    def __init__(self, obs: Any, obs_groups: Any, obs_set: str, output_dim: int, **options: Any) -> None:
        super().__init__(obs, obs_groups, obs_set, output_dim, **options)
        trunk = task.make_trunk()
        self.mlp = nn.Sequential(trunk, nn.Linear(trunk.out_features, output_dim))
        if obs_set == "actor":
            task.start_layer(self.mlp[1], 0.01, task.HOME)
        else:
            task.start_layer(self.mlp[1], 1.0)


def acting(actor: Model) -> task.Normalized:
    """Return its deterministic policy. Its normaliser does not clip."""
    moments = actor.obs_normalizer
    return task.Normalized(moments.mean, moments.std + moments.eps, math.inf, actor.mlp)


def main() -> None:
    """Train."""
    asked = task.order()
    recorder = task.Recorder(asked)
    std = float(torch.tensor(task.LOG_STD).exp())
    distribution = {"class_name": "GaussianDistribution", "init_std": std, "std_type": "log"}
    config = {
        "num_steps_per_env": task.HORIZON,
        "save_interval": 10**9,
        "check_for_nan": False,
        "obs_groups": {"actor": ["policy"], "critic": ["policy"]},
        "actor": {"class_name": Model, "obs_normalization": True, "distribution_cfg": distribution},
        "critic": {"class_name": Model, "obs_normalization": True},
        "algorithm": {
            "class_name": "PPO",
            "num_learning_epochs": task.PASSES,
            "num_mini_batches": task.FRAMES // task.MINIBATCH,
            "clip_param": task.CLIP,
            "gamma": task.GAMMA,
            "lam": task.GAE_LAMBDA,
            "entropy_coef": 0.0,
            "learning_rate": task.LEARNING_RATE,
            "max_grad_norm": task.GRADIENT_NORM,
            "schedule": "adaptive",
            "desired_kl": task.TARGET_KL,
        },
    }
    runner = OnPolicyRunner(Envs(asked.seed), config, device="cpu")
    frames = 0
    while True:
        runner.learn(1)
        frames += task.FRAMES
        if recorder.note(frames, lambda: acting(runner.alg.get_policy())):
            break


if __name__ == "__main__":
    main()
