"""Checkpoints: one safetensors file with everything a resumed run needs, replaced in one step.

Tensors: network, Adam's moments, observation and value moments, the shuffle's random state, and the rollouts that
wait at a planned stop. The rest, `Progress` and what the service adds (stage log, ledger), is JSON in the file's
metadata. Every tensor and the JSON have a checksum, so a damaged file is told from one of other settings.
"""

import json
import logging
import zlib
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from safetensors import SafetensorError, safe_open
from safetensors.numpy import save as save_tensors

from common.errors import ReportedError
from common.policy.contract import PolicyError
from common.policy.normalizer import Moments
from common.policy.weights import load_state, state_tensors
from common.service.whole_file import write_whole
from services.learner.divergence import Health
from services.learner.epoch_stats import Progress
from services.learner.training import Training

log = logging.getLogger(__name__)

FORMAT = 3
SUFFIX = ".safetensors"
KEPT = 3  # newest checkpoints kept in a run
GOOD = "good"  # subfolder with the last good checkpoint, for a run that diverges

_NETWORK, _AVERAGE, _ADAM, _QUEUE = "network.", "average.", "adam.", "queue."
_MOMENTS = ("obs_moments", "value_moments")


class CheckpointError(ReportedError, ValueError):
    """A checkpoint that can't be resumed from: one line with the file and the fault."""


class DamagedCheckpointError(CheckpointError):
    """A checkpoint whose bytes are not those that were written; an older one may be whole."""


@dataclass(frozen=True, slots=True)
class Extras:
    """What the service keeps with the training state."""

    run: str
    generation: int
    stage_log: list[dict[str, Any]]
    accounts: list[dict[str, Any]]  # the fate of every rollout: ledger.AccountSnapshot
    trained_seconds: float  # since the first trained batch, through restarts
    closed: tuple[tuple[str, int], ...] = ()  # lives of actors whose accounts are closed
    queue: tuple[bytes, ...] = ()  # encoded rollouts that wait for an update, at a planned stop


def save(folder: Path, training: Training, extras: Extras) -> Path:
    """Write ``folder``/VERSION.safetensors and return it; a crash at any moment leaves whole files only.

    Raises:
        OSError: It can't be written; the older ones are as they were.
    """
    tensors: dict[str, npt.NDArray[Any]] = {
        _NETWORK + name: value for name, value in state_tensors(training.network).items()
    }
    tensors |= {_AVERAGE + name: value for name, value in state_tensors(training.average).items()}
    names = [name for name, _ in training.network.named_parameters()]
    state = training.optimizer.state_dict()["state"]
    for index, name in enumerate(names):
        for key, value in state.get(index, {}).items():
            tensors[f"{_ADAM}{name}.{key}"] = value.detach().cpu().numpy().copy()
    for which in _MOMENTS:
        moments: Moments = getattr(training, which)
        tensors[f"{which}.mean"], tensors[f"{which}.var"] = np.array(moments.mean), np.array(moments.var)
        tensors[f"{which}.count"] = np.array(moments.count, np.int64)
    tensors["shuffle"] = training.generator.get_state().numpy().copy()
    for index, rollout in enumerate(extras.queue):
        tensors[f"{_QUEUE}{index:06d}"] = np.frombuffer(rollout, np.uint8)
    kept = asdict(extras)
    del kept["queue"]
    about = {
        "format": FORMAT,
        "progress": asdict(training.progress),
        "extras": kept,
        "checksums": {name: _checksum(value) for name, value in tensors.items()},
    }
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / f"{training.progress.version:08d}{SUFFIX}"
    text = json.dumps(about)
    write_whole(
        path, save_tensors(tensors, metadata={"topspin": text, "checksum": str(zlib.crc32(text.encode()))})
    )
    for stale in folder.glob("*.part"):  # of a process that ended within a save
        stale.unlink(missing_ok=True)
    for old in checkpoints(folder)[:-KEPT]:
        old.unlink(missing_ok=True)
    return path


def keep(path: Path, folder: Path) -> None:
    """Make a copy of ``path`` the only checkpoint in ``folder``."""
    folder.mkdir(parents=True, exist_ok=True)
    write_whole(folder / path.name, path.read_bytes())
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
        DamagedCheckpointError: The file is missing, unreadable or damaged; ``training`` is unchanged.
        CheckpointError: It is of another network; ``training`` may be half changed.
    """
    about, tensors = _read(path)
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
        queue = tuple(tensors[name].tobytes() for name in sorted(tensors) if name.startswith(_QUEUE))
        extras = Extras(**about["extras"], queue=queue)
        return replace(extras, closed=tuple((actor, life) for actor, life in extras.closed))
    except (PolicyError, KeyError, TypeError, RuntimeError) as error:
        raise CheckpointError(f"checkpoint {path} doesn't fit this configuration: {error}") from None


def restore_newest(folder: Path, training: Training) -> tuple[Path, Extras]:
    """Load a run's newest whole checkpoint into ``training``; return it with the service's extras.

    Raises:
        CheckpointError: There is none, all are damaged, or the newest whole one is of another network.
    """
    newest(folder)
    faults: list[str] = []
    for path in reversed(checkpoints(folder)):
        try:
            extras = restore(path, training)
        except DamagedCheckpointError as error:
            faults.append(str(error))
            continue
        for fault in faults:
            log.warning("%s; going on from file=%s, the newest whole one", fault, path)
        return path, extras
    raise CheckpointError(f"nothing to resume in {folder}: no whole checkpoint there; {'; '.join(faults)}")


def _read(path: Path) -> tuple[dict[str, Any], dict[str, npt.NDArray[Any]]]:
    """Return the JSON and the tensors of a checkpoint that are as they were written."""
    try:
        path.open("rb").close()  # safetensors has one error for all that can't be opened
    except OSError as error:
        raise DamagedCheckpointError(f"can't read checkpoint {path}: {error.strerror}") from None
    try:
        with safe_open(path, framework="numpy") as file:
            metadata: Mapping[str, str] = file.metadata() or {}
            about = json.loads(metadata["topspin"])
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
            found = about["format"]
    except (SafetensorError, OSError, ValueError, KeyError, TypeError) as error:
        raise DamagedCheckpointError(f"checkpoint {path} is not readable: {error}") from None
    if found != FORMAT:
        raise CheckpointError(f"checkpoint {path} has format {found!r}; allowed is {FORMAT}")
    if metadata.get("checksum") != str(zlib.crc32(metadata["topspin"].encode())):
        raise DamagedCheckpointError(f"checkpoint {path} is damaged: checksum of its description")
    checksums = about["checksums"]
    for name in sorted(checksums.keys() | tensors.keys()):
        if name not in tensors or checksums.get(name) != _checksum(tensors[name]):
            raise DamagedCheckpointError(f"checkpoint {path} is damaged: checksum of {name}")
    return about, tensors


def _checksum(value: npt.NDArray[Any]) -> int:
    return zlib.crc32(np.ascontiguousarray(value).tobytes())


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
