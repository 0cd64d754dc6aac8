"""Stable-Baselines3: PPO with our trunk for policy and value, its VecNormalize for observations and rewards."""

from typing import Any

import numpy as np
import torch
from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from stable_baselines3.common.vec_env import VecEnv, VecNormalize
from torch import Tensor, nn

from benchmarks.peers import task


class Envs(VecEnv):
    """Our vector environment as its VecEnv."""

    def __init__(self, seed: int) -> None:
        self._envs, self._first_seed = task.make_envs(), seed
        super().__init__(task.ENVS, self._envs.single_observation_space, self._envs.single_action_space)

    def reset(self) -> Any:
        """Begin."""
        return self._envs.reset(seed=self._first_seed)[0]

    def step_async(self, actions: Any) -> None:
        """Take actions (B, 7)."""
        self._actions = actions

    def step_wait(self) -> Any:
        """Play a control step."""
        obs, rewards, terminated, truncated, infos = self._envs.step(self._actions)
        rows: list[dict[str, Any]] = [{} for _ in range(self.num_envs)]
        for row in np.flatnonzero(terminated | truncated):
            rows[row] = {
                "terminal_observation": infos["final_obs"][row],
                "TimeLimit.truncated": truncated[row],
            }
        return obs, rewards.astype(np.float32), terminated | truncated, rows

    def close(self) -> None:
        """Close."""

    def env_is_wrapped(self, wrapper_class: Any, indices: Any = None) -> list[bool]:
        """Return that no environment is wrapped."""
        return [False] * self.num_envs

    def env_method(self, method_name: str, *args: Any, indices: Any = None, **kwargs: Any) -> Any:
        """Refuse."""
        raise NotImplementedError(method_name)

    def get_attr(self, attr_name: str, indices: Any = None) -> Any:
        """Return an attribute, once for each environment."""
        return [getattr(self._envs, attr_name)] * self.num_envs

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
        """Refuse."""
        raise NotImplementedError(attr_name)


class Trunk(BaseFeaturesExtractor):
    """Our hidden layers."""

    def __init__(self, observation_space: Any) -> None:
        trunk = task.make_trunk()
        super().__init__(observation_space, trunk.out_features)
        self.trunk = trunk

    def forward(self, obs: Tensor) -> Tensor:
        """Return the last hidden layer (N, 32)."""
        hidden: Tensor = self.trunk(obs)
        return hidden


class Progress(BaseCallback):
    """Notes the progress before each rollout, which is after each update."""

    def __init__(self, recorder: task.Recorder, envs: VecNormalize) -> None:
        super().__init__()
        self._recorder, self._envs, self._is_over = recorder, envs, False

    def _on_rollout_start(self) -> None:
        if self.num_timesteps:
            self._is_over = self._recorder.note(self.num_timesteps, self._policy)

    def _on_step(self) -> bool:
        return not self._is_over

    def _policy(self) -> task.Normalized:
        moments, policy = self._envs.obs_rms, self.model.policy
        scale = torch.sqrt(torch.from_numpy(moments.var) + self._envs.epsilon)
        acting = nn.Sequential(policy.features_extractor.trunk, policy.action_net)
        return task.Normalized(torch.from_numpy(moments.mean), scale, task.OBS_CLIP, acting)


def main() -> None:
    """Train."""
    asked = task.order()
    envs = VecNormalize(Envs(asked.seed), gamma=task.GAMMA, clip_obs=task.OBS_CLIP)
    model = PPO(
        "MlpPolicy",
        envs,
        learning_rate=task.LEARNING_RATE,
        n_steps=task.HORIZON,
        batch_size=task.MINIBATCH,
        n_epochs=task.PASSES,
        gamma=task.GAMMA,
        gae_lambda=task.GAE_LAMBDA,
        clip_range=task.CLIP,
        max_grad_norm=task.GRADIENT_NORM,
        policy_kwargs={
            "features_extractor_class": Trunk,
            "net_arch": [],
            "log_std_init": task.LOG_STD,
            "ortho_init": False,
        },
        seed=asked.seed,
        device="cpu",
    )
    task.start_layer(model.policy.action_net, 0.01, task.HOME)
    task.start_layer(model.policy.value_net, 1.0)
    model.learn(10**12, callback=Progress(task.Recorder(asked), envs))


if __name__ == "__main__":
    main()
