"""A policy on disk: a folder with safetensors weights and a contract.

``weights.safetensors`` holds network and observation moments. ``contract.json`` names each input and
output with its unit, and says how the policy was trained.
"""

import copy
import hashlib
import json
import os
import shutil
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt
import torch
from pydantic import ValidationError
from safetensors import SafetensorError
from safetensors.numpy import load as load_tensors
from safetensors.numpy import save as save_tensors

from common.policy.actor_critic import ActorCritic
from common.policy.contract import CONTRACT_FILE, WEIGHTS_FILE, Contract, PolicyError, described, same_numbers
from common.policy.normalizer import Moments, normalize
from common.policy.weights import load_state, new_network, observation_moments, state_tensors
from common.service.whole_file import write_whole
from common.task.observation import ACTION, ACTION_SIZE, offsets, policy_layout, size

_ACTING: Final = ("trunk.", "mean.", "log_std")  # the policy's parameters; the others are the critic's
_OBS_MEAN, _OBS_VAR, _OBS_COUNT = "obs_moments.mean", "obs_moments.var", "obs_moments.count"
_MOMENTS: Final = (_OBS_MEAN, _OBS_VAR, _OBS_COUNT)
_OWN_CONTRACT, _REPLACED = "contract", "replaces"  # texts that the weights carry


@dataclass(frozen=True, slots=True)
class Policy:
    """A policy to play: network, frozen normaliser and contract. The critic of a policy from a folder is all zeros."""

    network: ActorCritic
    moments: Moments
    contract: Contract

    def act(self, obs: npt.NDArray[np.float32]) -> npt.NDArray[np.float32]:
        """Return the deterministic actions (B, 7) for raw observations (B, D); only the policy's part is used.

        Raises:
            ValueError: There are too few numbers, or one is not finite; the text names it.
        """
        width = self.network.obs_size
        if obs.ndim != 2 or obs.shape[1] < width:
            raise ValueError(
                f"obs has shape {obs.shape}; allowed: (B, {width}), as an environment gives it with "
                "observation=policy.contract.task.observation"
            )
        if not np.isfinite(obs[:, :width]).all():
            raise ValueError(self._not_finite(obs[:, :width]))
        with torch.inference_mode():
            mean = self.network.act(torch.from_numpy(normalize(obs[:, :width], self.moments.first(width))))
        actions: npt.NDArray[np.float32] = mean.numpy()
        return actions

    def _not_finite(self, obs: npt.NDArray[np.float32]) -> str:
        """Return what is wrong with observations (B, D): the first number that is not finite, by name."""
        row, column = np.argwhere(~np.isfinite(obs))[0]
        parts = offsets(policy_layout(self.contract.task.observation))
        name, part = next((n, p) for n, p in parts.items() if p.start <= column < p.stop)
        return f"observation {row}: {name}[{column - part.start}] is {obs[row, column]}; allowed: a finite number"


def save_policy(folder: Path, network: ActorCritic, moments: Moments, contract: Contract) -> None:
    """Write a policy, without its critic; a reader gets the old one or the new one, never a mixture.

    The folder holds two plain files, and each is replaced in one step: first the weights, then the contract. The
    weights carry a copy of the contract, and a digest of the contract file that it replaces. So `load_policy` finds
    the right contract also where the writer is between the two files, or was killed there.
    """
    _make_plain(folder)
    tensors: dict[str, npt.NDArray[Any]] = {
        name: value for name, value in state_tensors(network).items() if name.startswith(_ACTING)
    }
    acting = moments.first(network.obs_size)
    tensors[_OBS_MEAN], tensors[_OBS_VAR] = acting.mean, acting.var
    tensors[_OBS_COUNT] = np.array(acting.count, np.int64)
    text = contract.model_dump_json(indent=2) + "\n"
    file = folder / CONTRACT_FILE
    replaced = _digest(file.read_bytes()) if file.exists() else ""
    weights = save_tensors(tensors, metadata={_OWN_CONTRACT: text, _REPLACED: replaced})
    write_whole(folder / WEIGHTS_FILE, weights)
    write_whole(file, text)


def _make_plain(folder: Path) -> None:
    """Make a policy folder; where it is a link, as in earlier releases, what it points to takes its place."""
    if folder.is_symlink():
        target = folder.parent / os.readlink(folder)
        folder.unlink()
        if target.parent == folder.parent and target.is_dir():
            target.rename(folder)
        for old in folder.parent.glob(f".{folder.name}-*"):
            shutil.rmtree(old, ignore_errors=True)
    folder.mkdir(parents=True, exist_ok=True)


def load_policy(folder: Path) -> Policy:
    """Return the policy in ``folder``; raises PolicyError with one line where it can't be used."""
    weights_file, contract_file = folder / WEIGHTS_FILE, folder / CONTRACT_FILE
    try:
        weights, text = _read_both(weights_file, contract_file)
        tensors = load_tensors(weights)
        carried = _metadata(weights)
    except OSError as error:
        raise PolicyError(
            f"no policy in {folder}: {error.strerror} ({Path(error.filename or '').name}); "
            f"wanted is a folder with {WEIGHTS_FILE} and {CONTRACT_FILE}"
        ) from None
    except (SafetensorError, ValueError, KeyError) as error:  # KeyError: a dtype that numpy lacks
        raise PolicyError(f"{weights_file} is not readable as safetensors: {error}") from None
    if carried.get(_REPLACED) == _digest(text):  # the writer has not replaced the contract yet
        text = carried.get(_OWN_CONTRACT, "").encode()
    contract = _judged(text, contract_file)
    options = contract.task.observation
    layout = policy_layout(options)
    if not (
        same_numbers(contract.observation, described(layout))
        and same_numbers(contract.action, described(ACTION))
    ):
        raise PolicyError(
            f"{contract_file}: its observation or action layout is not this version's "
            f"({size(layout)} and {ACTION_SIZE} numbers, see common/task/observation.py)"
        )
    for name in _MOMENTS:
        if name not in tensors:
            raise PolicyError(f"{weights_file} lacks {name!r}")
    network = new_network(contract.network, options.model_copy(update={"critic": "policy"}))
    blank = {
        name: np.zeros_like(value)
        for name, value in state_tensors(network).items()
        if not name.startswith(_ACTING)
    }
    try:
        moments = observation_moments(tensors[_OBS_MEAN], tensors[_OBS_VAR], tensors[_OBS_COUNT], layout)
        load_state(network, blank | {name: value for name, value in tensors.items() if name not in _MOMENTS})
    except PolicyError as error:
        raise PolicyError(f"{weights_file}: {error}") from None
    return Policy(network, moments, contract)


def _read_both(weights_file: Path, contract_file: Path) -> tuple[bytes, bytes]:
    """Return the bytes of both files; the weights were the same before and after the contract was read."""
    weights = weights_file.read_bytes()
    while True:
        text = contract_file.read_bytes()
        before, weights = weights, weights_file.read_bytes()
        if weights == before:
            return weights, text


def _metadata(weights: bytes) -> dict[str, str]:
    """Return the texts that a safetensors file carries; {} where it has none."""
    length = int.from_bytes(weights[:8], "little")
    return dict(json.loads(weights[8 : 8 + length]).get("__metadata__") or {})


def _judged(text: bytes, file: Path) -> Contract:
    """Return a contract; raises PolicyError with file, field, value and what is allowed."""
    try:
        return Contract.model_validate_json(text.decode("utf-8-sig"))
    except UnicodeDecodeError as error:
        raise PolicyError(f"{file} is not text in UTF-8: {error.reason} at byte {error.start}") from None
    except ValidationError as error:
        first = error.errors()[0]
        where = ".".join(str(part) for part in first["loc"])
        got = f", got {first['input']!r:.100}" if where and first["type"] != "missing" else ""
        raise PolicyError(f"{file}: {where or 'file'}: {first['msg']}{got}") from None


def _digest(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()


def _shape(contract: Contract) -> dict[str, Any]:
    """Return what must be equal in the contracts of policies that are averaged."""
    return {
        "observation": contract.task.observation.model_dump(exclude={"critic"}),
        "network": contract.network,
        "control_rate_hz": contract.task.control_rate_hz,
        "robot": contract.task.robot,
        "rubber": contract.task.rubber,
    }


def mean_policy(policies: Sequence[Policy]) -> Policy:
    """Return the policy with the mean of several policies' weights and observation moments: a model soup.

    The mean of policies that were trained from the same one, in different ways, is often better than each of them
    (Wortsman et al. 2022). It has the first one's contract, with the largest number of frames. ``made_with`` lists the
    policies.

    Raises:
        PolicyError: They differ in observation, network, control rate, robot or rubber.
    """
    first = policies[0].contract
    for policy in policies[1:]:
        theirs, ours = (_shape(contract) for contract in (policy.contract, first))
        for name, wanted in ours.items():
            if theirs[name] != wanted:
                raise PolicyError(f"no mean of policies that differ in {name}: {wanted} and {theirs[name]}")
    share = 1.0 / len(policies)
    states = [policy.network.state_dict() for policy in policies]
    network = copy.deepcopy(policies[0].network)
    network.load_state_dict({name: sum(state[name] for state in states) * share for name in states[0]})
    moments = Moments(
        sum((policy.moments.mean for policy in policies), np.zeros(())) * share,
        sum((policy.moments.var for policy in policies), np.zeros(())) * share,
        policies[0].moments.count,
    )
    parts = [
        f"{p.contract.run} {p.contract.frames} frames, launch {p.contract.task.launch}" for p in policies
    ]
    contract = first.model_copy(
        update={
            "frames": max(policy.contract.frames for policy in policies),
            "made_with": first.made_with | {"mean_of": "; ".join(parts)},
        }
    )
    return Policy(network, moments, contract)
