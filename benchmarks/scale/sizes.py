"""Where the bytes of a rollout and of a policy go."""

import dataclasses
from typing import Any, Final

import numpy as np

from benchmarks.play import STAGE, make_player, make_training
from common.comms.codec import encode
from common.comms.messages import PolicySnapshot, Rollout
from common.comms.wire import slots_of
from common.policy.contract import contract_hash, training_hash
from common.policy.network_pass import DTYPES
from common.policy.weights import pack
from common.task.config import TaskConfig
from common.task.experience import ExperienceConfig
from services.learner.config import PPOConfig
from services.learner.training import Training

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
        weights=pack(training.network, training.compute.precision),
        obs_mean=np.asarray(moments.mean),
        obs_var=np.asarray(moments.var),
        obs_count=moments.count,
    )


def array_bytes(message: Any) -> dict[str, int]:
    """Return the bytes of the arrays in each field of a message, as they travel."""
    found = {}
    for slot in slots_of(type(message)):
        value = getattr(message, slot.name)
        if isinstance(value, np.ndarray):
            found[slot.name] = value.size * np.dtype(slot.wire.sent or slot.wire.dtype).itemsize
        elif dataclasses.is_dataclass(value):
            found[slot.name] = sum(array_bytes(value).values())
    return found


def rollout_sizes(rollout: Rollout) -> dict[str, Any]:
    """Return what each field of a rollout's message costs a frame, and what observations lose as float16.

    The error is that of a normalised observation: in standard deviations of what the rollout observed.
    """
    frames, total = rollout.rewards.size, len(encode(rollout))
    fields = array_bytes(rollout)
    fields["rest"] = total - sum(fields.values())
    obs = rollout.obs.reshape(-1, rollout.obs.shape[-1]).astype(np.float64)
    error = np.abs(obs.astype(np.float16).astype(np.float64) - obs) / obs.std(axis=0).clip(min=0.1)
    return {
        "bytes_per_frame": round(total / frames, 1),
        "bytes_per_frame_by_field": {
            name: round(size / frames, 2)
            for name, size in sorted(fields.items(), key=lambda item: -item[1])
            if size
        },
        "float16_error_std_max": float(f"{error.max():.3g}"),
        "float16_error_std_mean": float(f"{error.mean():.3g}"),
    }


def policy_sizes(training: Training) -> dict[str, Any]:
    """Return the size of a policy's message as it is broadcast, in full precision, and without the critic's part."""
    network, snapshot = training.network, policy_snapshot(training)
    total, matrix = len(encode(snapshot)), DTYPES[training.compute.precision].itemsize
    acting = sum(
        value.numel() * (matrix if value.ndim > 1 else 4)
        for name, value in network.state_dict().items()
        if name.startswith(ACTING)
    )
    return {
        "policy_bytes": total,
        "policy_bytes_float32": total - len(snapshot.weights) + len(pack(network)),
        "policy_bytes_without_critic": total - len(snapshot.weights) + acting,
        "policy_bytes_of_weights": len(snapshot.weights),
    }


def new_training() -> Training:
    """Return a training of the default task and network."""
    return make_training(PPOConfig(), 0)
