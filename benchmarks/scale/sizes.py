"""Where the bytes of a rollout and of a policy go."""

import dataclasses
from typing import Any, Final

import numpy as np

from benchmarks.play import STAGE, make_player, make_training
from common.comms.codec import encode
from common.comms.messages import PolicySnapshot, Rollout
from common.policy.contract import contract_hash, training_hash
from common.policy.weights import pack
from common.task.config import TaskConfig
from common.task.experience import ExperienceConfig
from services.learner.config import PPOConfig
from services.learner.training import Training

OBSERVATIONS: Final = ("obs", "last_obs", "final_obs")
ACTING: Final = ("trunk.", "mean.", "log_std")  # parameters that an actor needs


def played(training: Training, envs: int, seed: int) -> Rollout:
    """Return a rollout of stage 3, as an actor with so many environments plays it."""
    return make_player(training, envs, seed).play("benchmark", 1, 0)


def policy_snapshot(training: Training) -> PolicySnapshot:
    """Return what the learner broadcasts."""
    task, network, moments = TaskConfig(), training.network_config, training.obs_moments
    return PolicySnapshot(
        run="scale",
        generation=1,
        version=1,
        stage_number=0,
        stage=STAGE,
        epoch=0,
        frames=0,
        contract_hash=contract_hash(task, network),
        training_hash=training_hash(task, network, ExperienceConfig()),
        weights=pack(training.network),
        obs_mean=np.asarray(moments.mean),
        obs_var=np.asarray(moments.var),
        obs_count=moments.count,
    )


def array_bytes(value: Any) -> int:
    """Return the bytes of all arrays in a field."""
    if isinstance(value, np.ndarray):
        return value.nbytes
    if dataclasses.is_dataclass(value):
        return sum(array_bytes(getattr(value, field.name)) for field in dataclasses.fields(value))
    return 0


def rollout_sizes(rollout: Rollout) -> dict[str, Any]:
    """Return what each field of a rollout's message costs a frame, and what float16 observations would save.

    The error of float16 is that of a normalised observation: in standard deviations of what the rollout observed.
    """
    frames, total = rollout.rewards.size, len(encode(rollout))
    fields = {field.name: array_bytes(getattr(rollout, field.name)) for field in dataclasses.fields(rollout)}
    fields["rest"] = total - sum(fields.values())
    observed = sum(fields[name] for name in OBSERVATIONS)
    obs = rollout.obs.reshape(-1, rollout.obs.shape[-1]).astype(np.float64)
    error = np.abs(obs.astype(np.float16).astype(np.float64) - obs) / obs.std(axis=0).clip(min=0.1)
    return {
        "bytes_per_frame": round(total / frames, 1),
        "bytes_per_frame_by_field": {
            name: round(size / frames, 2)
            for name, size in sorted(fields.items(), key=lambda item: -item[1])
            if size
        },
        "bytes_per_frame_with_float16_observations": round((total - observed / 2) / frames, 1),
        "float16_observations_share": round(1.0 - observed / 2 / total, 4),
        "float16_error_std_max": float(f"{error.max():.3g}"),
        "float16_error_std_mean": float(f"{error.mean():.3g}"),
    }


def policy_sizes(training: Training) -> dict[str, Any]:
    """Return the size of a policy's message, in bfloat16 too, and without what only the critic has."""
    snapshot = policy_snapshot(training)
    total, weights = len(encode(snapshot)), len(snapshot.weights)
    numbers = {name: value.numel() for name, value in training.network.state_dict().items()}
    acting = sum(count for name, count in numbers.items() if name.startswith(ACTING))
    return {
        "policy_bytes": total,
        "policy_bytes_bfloat16": total - 2 * sum(numbers.values()),
        "policy_bytes_without_critic": total - 4 * (sum(numbers.values()) - acting),
        "policy_bytes_of_weights": weights,
    }


def new_training() -> Training:
    """Return a training of the default task and network."""
    return make_training(PPOConfig(), 0)
