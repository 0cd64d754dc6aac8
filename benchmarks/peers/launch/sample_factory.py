"""Sample Factory: APPO with two processes that sample and learn at the same time, with our trunk and its normaliser.

Its environments are two batches of 128, double-buffered: while the policy computes for one, the other is stepped.
"""

import os
import sys
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import torch
from sample_factory.algo.runners.runner import AlgoObserver
from sample_factory.algo.utils.context import global_model_factory
from sample_factory.cfg.arguments import parse_full_cfg, parse_sf_args
from sample_factory.envs.env_utils import register_env
from sample_factory.model.actor_critic import default_make_actor_critic_func
from sample_factory.model.encoder import Encoder
from sample_factory.train import make_runner
from torch import Tensor, nn

from benchmarks.peers import task

SPLITS = 2


def forwarded(wrapper: Any, name: str) -> Any:
    """Return an attribute of a wrapper's environment: it was made for Gymnasium before 1.0, which forwarded them."""
    if name.startswith("_"):
        raise AttributeError(name)
    return getattr(wrapper.env, name)


setattr(gymnasium.Wrapper, "__getattr__", forwarded)  # noqa: B010


class Envs(gymnasium.Env[Any, Any]):
    """Our vector environment as one of its batched ones."""

    def __init__(self) -> None:
        self._envs = task.make_envs(threads=1, count=task.ENVS // SPLITS)
        self.observation_space = self._envs.single_observation_space
        self.action_space = self._envs.single_action_space
        self.num_agents, self.is_multiagent = task.ENVS // SPLITS, True

    def reset(self, seed: int | None = None, options: Any = None) -> Any:
        """Begin."""
        return self._envs.reset(seed=seed)[0], {}

    def step(self, actions: Any) -> Any:
        """Play a control step."""
        obs, rewards, terminated, truncated, _ = self._envs.step(np.asarray(actions))
        return obs, rewards.astype(np.float32), terminated, truncated, {}

    def close(self) -> None:
        """Close."""


class Trunk(Encoder):
    """Our hidden layers."""

    def __init__(self, cfg: Any, obs_space: Any) -> None:
        super().__init__(cfg)
        self.trunk = task.make_trunk()

    def forward(self, obs: dict[str, Tensor]) -> Tensor:
        """Return the last hidden layer (N, 32)."""
        hidden: Tensor = self.trunk(obs["obs"])
        return hidden

    def get_out_size(self) -> int:
        """Return its width."""
        return self.trunk.out_features


def make_model(cfg: Any, obs_space: Any, action_space: Any) -> Any:
    """Return its model, started as ours."""
    model = default_make_actor_critic_func(cfg, obs_space, action_space)
    task.start_layer(model.action_parameterization.distribution_linear, 0.01, task.HOME)
    task.start_layer(model.critic_linear, 1.0)
    return model


def make_env(*_: Any, **__: Any) -> Envs:
    """Return a batch of environments."""
    return Envs()


class Observer(AlgoObserver):
    """Notes the progress after each training step."""

    def __init__(self, recorder: task.Recorder, checkpoints: Path) -> None:
        self._recorder, self._checkpoints = recorder, checkpoints

    def on_training_step(self, runner: Any, training_iteration_since_resume: int) -> None:
        """Note it; end all processes when time is up."""
        frames = runner.env_steps.get(0, 0)
        if frames and self._recorder.note(frames, self._policy):
            os._exit(0)  # its other processes are ended from outside

    def _policy(self) -> task.Normalized | None:
        """Return the policy of the newest checkpoint, None before the first: the learner is another process."""
        files = sorted(self._checkpoints.glob("checkpoint_*.pth"), key=lambda file: file.stat().st_mtime)
        if not files:
            return None
        newest = files[-1]
        state = torch.load(newest, weights_only=False)["model"]
        trunk, mean = task.make_trunk(), nn.Linear(32, task.ACTIONS)
        prefix = "encoder.trunk."
        trunk.load_state_dict({k.removeprefix(prefix): v for k, v in state.items() if k.startswith(prefix)})
        prefix = "action_parameterization.distribution_linear."
        mean.load_state_dict({k.removeprefix(prefix): v for k, v in state.items() if k.startswith(prefix)})
        moments = "obs_normalizer.running_mean_std.running_mean_std.obs.running_"
        scale = torch.sqrt(state[f"{moments}var"] + 1e-5)
        return task.Normalized(state[f"{moments}mean"], scale, task.OBS_CLIP, nn.Sequential(trunk, mean))


def main() -> None:
    """Train."""
    asked = task.order()
    register_env("topspin", make_env)
    factory = global_model_factory()
    factory.register_encoder_factory(Trunk)
    factory.register_actor_critic_factory(make_model)
    options = {
        **{"algo": "APPO", "env": "topspin", "experiment": "run", "train_dir": asked.folder, "device": "cpu"},
        **{"seed": asked.seed, "async_rl": True, "serial_mode": False, "batched_sampling": True},
        **{"num_workers": 1, "num_envs_per_worker": SPLITS, "worker_num_splits": SPLITS},
        **{"rollout": task.HORIZON, "batch_size": task.MINIBATCH, "num_epochs": task.PASSES},
        **{
            "num_batches_per_epoch": task.FRAMES // task.MINIBATCH,
            "use_rnn": False,
            "decoder_mlp_layers": "",
        },
        **{"gamma": task.GAMMA, "gae_lambda": task.GAE_LAMBDA, "ppo_clip_ratio": task.CLIP},
        **{"reward_scale": task.REWARD_SCALE, "reward_clip": 1000.0, "normalize_returns": True},
        **{"learning_rate": task.LEARNING_RATE, "lr_schedule": "kl_adaptive_epoch"},
        **{"lr_schedule_kl_threshold": task.TARGET_KL, "lr_adaptive_min": 2e-5, "lr_adaptive_max": 1e-3},
        **{"max_grad_norm": task.GRADIENT_NORM, "exploration_loss_coeff": 0.0, "value_loss_coeff": 1.0},
        **{"adaptive_stddev": False, "initial_stddev": float(np.exp(task.LOG_STD))},
        **{"continuous_tanh_scale": 0.0, "policy_initialization": "torch_default", "with_vtrace": False},
        **{"shuffle_minibatches": True, "save_every_sec": int(task.SNAPSHOT_S / 2), "with_wandb": False},
        **{"train_for_env_steps": 10**10, "use_env_info_cache": False, "log_to_file": False},
        **{"save_best_after": 10**12, "force_envs_single_thread": True, "actor_critic_share_weights": True},
    }
    flags = [f"--{name}={value}" for name, value in options.items() if name != "decoder_mlp_layers"]
    parser, _ = parse_sf_args(flags)
    cfg = parse_full_cfg(parser, flags)
    cfg, runner = make_runner(cfg)
    checkpoints = asked.folder / "run" / "checkpoint_p0"
    runner.register_observer(Observer(task.Recorder(asked), checkpoints))
    runner.init()
    sys.exit(int(runner.run()))


if __name__ == "__main__":
    main()
