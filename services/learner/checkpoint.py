"""Checkpoints: one safetensors file with everything a resumed run needs, replaced in one step.

Tensors: network, Adam's moments, observation and value moments, the shuffle's random state. The rest, `Progress` and
what the service adds (stage log, ledger), is JSON in the file's metadata.
"""

import json
import os
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from safetensors import SafetensorError, safe_open
from safetensors.numpy import save_file

from common.errors import ReportedError
from common.policy.contract import PolicyError
from common.policy.normalizer import Moments
from common.policy.weights import load_state, state_tensors
from services.learner.divergence import Health
from services.learner.epoch_stats import Progress
from services.learner.training import Training

FORMAT = 2
SUFFIX = ".safetensors"
KEPT = 3  # newest checkpoints kept in a run
GOOD = "good"  # subfolder with the last good checkpoint, for a run that diverges

_NETWORK, _AVERAGE, _ADAM = "network.", "average.", "adam."
_MOMENTS = ("obs_moments", "value_moments")


class CheckpointError(ReportedError, ValueError):
    """A checkpoint that can't be resumed from: one line with the file and the fault."""


@dataclass(frozen=True, slots=True)
class Extras:
    """What the service keeps with the training state."""

    run: str
    generation: int
    stage_log: list[dict[str, Any]]
    accounts: list[dict[str, Any]]  # the fate of every rollout: ledger.AccountSnapshot
    trained_seconds: float  # since the first trained batch, through restarts


def save(folder: Path, training: Training, extras: Extras) -> Path:
    """Write ``folder``/VERSION.safetensors and return it; a crash at any moment leaves whole files only."""
    tensors: dict[str, npt.NDArray[Any]] = {
        _NETWORK + name: value for name, value in state_tensors(training.network).items()
    }
    tensors |= {_AVERAGE + name: value for name, value in state_tensors(training.average).items()}
    names = [name for name, _ in training.network.named_parameters()]
    state = training.optimizer.state_dict()["state"]
    for index, name in enumerate(names):
        for key, value in state.get(index, {}).items():
            tensors[f"{_ADAM}{name}.{key}"] = value.detach().numpy().copy()
    for which in _MOMENTS:
        moments: Moments = getattr(training, which)
        tensors[f"{which}.mean"], tensors[f"{which}.var"] = np.array(moments.mean), np.array(moments.var)
        tensors[f"{which}.count"] = np.array(moments.count, np.int64)
    tensors["shuffle"] = training.generator.get_state().numpy().copy()
    about = {"format": FORMAT, "progress": asdict(training.progress), "extras": asdict(extras)}
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / f"{training.progress.version:08d}{SUFFIX}"
    part = path.with_suffix(".part")
    save_file(tensors, part, metadata={"topspin": json.dumps(about)})
    with part.open("rb") as file:
        os.fsync(file.fileno())
    os.replace(part, path)
    for stale in folder.glob("*.part"):  # of a process that ended within a save
        stale.unlink(missing_ok=True)
    for old in checkpoints(folder)[:-KEPT]:
        old.unlink(missing_ok=True)
    return path


def keep(path: Path, folder: Path) -> None:
    """Make ``path`` the only checkpoint in ``folder``, by a hard link instead of a copy."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / path.name).unlink(missing_ok=True)
    os.link(path, folder / path.name)
    for old in checkpoints(folder):
        if old.name != path.name:
            old.unlink(missing_ok=True)


def checkpoints(folder: Path) -> list[Path]:
    """Return a run's checkpoints, oldest first."""
    return sorted(folder.glob(f"*{SUFFIX}"))


def newest(folder: Path) -> Path:
    """Return a run's newest checkpoint; raises CheckpointError where there is none."""
    files = checkpoints(folder)
    if not files:
        raise CheckpointError(f"nothing to resume in {folder}: no checkpoint there; start without --resume")
    return files[-1]


def restore(path: Path, training: Training) -> Extras:
    """Load a checkpoint into ``training`` and return the service's extras.

    Raises:
        CheckpointError: The file is missing, damaged, or of another network; ``training`` may be half changed.
    """
    try:
        with safe_open(path, framework="numpy") as file:
            about = json.loads((file.metadata() or {})["topspin"])
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
    except FileNotFoundError:
        raise CheckpointError(f"no checkpoint {path}") from None
    except (SafetensorError, OSError, ValueError, KeyError) as error:
        raise CheckpointError(f"checkpoint {path} is not readable: {error}") from None
    if about.get("format") != FORMAT:
        raise CheckpointError(f"checkpoint {path} has format {about.get('format')!r}; allowed is {FORMAT}")
    try:
        load_state(training.network, _under(_NETWORK, tensors))
        load_state(training.average, _under(_AVERAGE, tensors))
        training.optimizer.load_state_dict(_adam_state(training, _under(_ADAM, tensors)))
        for which in _MOMENTS:
            mean, var, count = (tensors[f"{which}.{part}"] for part in ("mean", "var", "count"))
            setattr(training, which, Moments(mean, var, int(count)))
        training.generator.set_state(torch.from_numpy(np.array(tensors["shuffle"])))
        progress = about["progress"]
        training.progress = Progress(**progress | {"health": Health(**progress["health"])})
        return Extras(**about["extras"])
    except (PolicyError, KeyError, TypeError, RuntimeError) as error:
        raise CheckpointError(f"checkpoint {path} doesn't fit this configuration: {error}") from None


def _under(prefix: str, tensors: dict[str, npt.NDArray[Any]]) -> dict[str, npt.NDArray[Any]]:
    return {name.removeprefix(prefix): value for name, value in tensors.items() if name.startswith(prefix)}


def _adam_state(training: Training, tensors: dict[str, npt.NDArray[Any]]) -> dict[str, Any]:
    """Return the optimiser's state_dict from tensors named PARAMETER.KEY."""
    result: dict[str, Any] = training.optimizer.state_dict()
    result["state"] = {}
    for index, (name, _) in enumerate(training.network.named_parameters()):
        state = _under(f"{name}.", tensors)
        if state:
            result["state"][index] = {key: torch.from_numpy(np.array(value)) for key, value in state.items()}
    return result
