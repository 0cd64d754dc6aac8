"""PufferLib: PuffeRL on our batch as one native environment, with our trunk and Adam.

It has no normaliser, so the policy has one of its own, whose moments are those of the datasets so far.
"""

import os
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import pufferlib
import torch
from pufferlib import pufferl
from torch import Tensor, nn
from torch.distributions import Normal

from benchmarks.peers import task
from common.policy.normalizer import Moments, scale_of


class Envs(pufferlib.PufferEnv):
    """Our vector environment as its native one."""

    def __init__(self) -> None:
        self._envs = task.make_envs()
        self.single_observation_space = self._envs.single_observation_space
        self.single_action_space = self._envs.single_action_space
        self.num_agents = task.ENVS
        super().__init__()

    def reset(self, seed: int | None = None) -> Any:
        """Begin."""
        self.observations[:] = self._envs.reset(seed=seed)[0]
        return self.observations, []

    def step(self, actions: Any) -> Any:
        """Play a control step."""
        obs, rewards, terminated, truncated, _ = self._envs.step(actions)
        self.observations[:], self.rewards[:] = obs, rewards * task.REWARD_SCALE
        self.terminals[:], self.truncations[:] = terminated, truncated
        return self.observations, self.rewards, self.terminals, self.truncations, []

    def close(self) -> None:
        """Close."""


class Policy(nn.Module):
    """Our trunk with its heads: a Gaussian and a value."""

    def __init__(self) -> None:
        super().__init__()
        self.trunk = task.make_trunk()
        self.mean, self.value, self.log_std = task.make_heads(self.trunk)
        self.moments = Moments.initial(task.OBS)

    def deterministic(self) -> task.Normalized:
        """Return observations -> mean actions."""
        return self._normalized(nn.Sequential(self.trunk, self.mean))

    def _normalized(self, after: nn.Module) -> task.Normalized:
        mean, scale = torch.from_numpy(self.moments.mean), torch.from_numpy(scale_of(self.moments))
        return task.Normalized(mean, scale, task.OBS_CLIP, after)

    def forward_eval(self, obs: Tensor, state: Any = None) -> tuple[Normal, Tensor]:
        """Return the actions' distribution and the values (N, 1)."""
        hidden = self._normalized(self.trunk)(obs)
        mean = self.mean(hidden)
        return Normal(mean, self.log_std.exp().expand_as(mean), validate_args=False), self.value(hidden)

    forward = forward_eval


def main() -> None:
    """Train."""
    asked = task.order()
    recorder, envs, policy = task.Recorder(asked), Envs(), Policy()
    with TemporaryDirectory() as folder:
        config = {
            **{"env": "topspin", "seed": asked.seed, "device": "cpu", "cpu_offload": False, "use_rnn": False},
            **{"torch_deterministic": False, "compile": False, "precision": "float32", "data_dir": folder},
            **{"optimizer": "adam", "learning_rate": task.LEARNING_RATE, "anneal_lr": False},
            **{"adam_beta1": 0.9, "adam_beta2": 0.999, "adam_eps": 1e-8},
            **{"total_timesteps": 10**9, "batch_size": task.FRAMES, "bptt_horizon": task.HORIZON},
            **{"minibatch_size": task.MINIBATCH, "max_minibatch_size": task.MINIBATCH},
            **{"update_epochs": task.PASSES, "gamma": task.GAMMA, "gae_lambda": task.GAE_LAMBDA},
            **{"clip_coef": task.CLIP, "vf_clip_coef": 1e9, "vf_coef": 1.0, "ent_coef": 0.0},
            **{"max_grad_norm": task.GRADIENT_NORM, "checkpoint_interval": 10**9},
            **{"prio_alpha": 0.8, "prio_beta0": 0.2, "vtrace_rho_clip": 1.0, "vtrace_c_clip": 1.0},
        }
        trainer = pufferl.PuffeRL(config, envs, policy)
        trainer.print_dashboard = lambda *_, **__: None  # it costs a third of a second each time
        is_over = False
        while not is_over:
            trainer.evaluate()
            trainer.train()
            seen = trainer.observations.numpy().reshape(-1, task.OBS)
            policy.moments = policy.moments.merged(Moments.of(np.asarray(seen, np.float64)))
            is_over = recorder.note(trainer.global_step, policy.deterministic)
        os._exit(0)  # its threads that watch the machine do not end


if __name__ == "__main__":
    main()
