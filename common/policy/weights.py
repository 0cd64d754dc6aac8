"""A policy on disk and on the wire: safetensors weights and a contract that says what they expect.

A policy folder holds ``weights.safetensors`` (network and observation moments) and ``contract.json`` (what goes in
and comes out, by name and unit, and how the policy came about). Nothing is pickled.
"""

import copy
import hashlib
import json
import os
import shutil
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib.metadata import version as package_version
from pathlib import Path
from typing import Any, Literal, Self

import numpy as np
import numpy.typing as npt
import torch
from pydantic import BaseModel, ConfigDict, ValidationError
from safetensors import SafetensorError
from safetensors.numpy import load as load_tensors
from safetensors.numpy import save as save_tensors

from common.comms.messages import PolicySnapshot
from common.errors import ReportedError
from common.policy.actor_critic import ActorCritic, NetworkConfig
from common.policy.normalizer import Moments, normalize
from common.rally.observation import (
    ACTION,
    ACTION_SIZE,
    OBSERVATION,
    PAPER_OBSERVATION,
    Expectation,
    ObservationConfig,
    Part,
    critic_layout,
    policy_layout,
    size,
)

WEIGHTS_FILE, CONTRACT_FILE = "weights.safetensors", "contract.json"
_ACTING = ("trunk.", "mean.", "log_sigma")  # the policy's parameters; the others are the critic's
_OBS_MEAN, _OBS_VAR, _OBS_COUNT = "obs_moments.mean", "obs_moments.var", "obs_moments.count"
_MOMENTS = (_OBS_MEAN, _OBS_VAR, _OBS_COUNT)
# What contracts must agree in for a mean of their policies' weights
_SHAPE = {"observation", "action", "network", "control_rate_hz", "robot"}


class PolicyError(ReportedError, ValueError):
    """A policy that can't be read or doesn't fit: one line that names what was got and what is allowed."""


class Contract(BaseModel):
    """What a policy's weights expect, and where they come from."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    format: int = 1
    observation: tuple[dict[str, Any], ...]
    action: tuple[dict[str, Any], ...]
    observation_options: ObservationConfig = ObservationConfig()
    network: NetworkConfig
    control_rate_hz: float
    robot: str
    launch: str
    noise: str
    env: dict[str, Any] = {}  # every setting of the task it was trained in
    run: str
    generation: int
    version: int
    stage: int
    frames: int
    measures: dict[str, Any] = {}
    made_with: dict[str, str] = {}

    def expecting(self, spins: Expectation | Literal["contract"]) -> Self:
        """Return the contract with other spins expected, whatever the policy was trained with; or as it is."""
        if spins == "contract":
            return self
        options = self.observation_options.model_copy(update={"spin_expected": spins})
        return self.model_copy(update={"observation_options": options})


def _described(layout: tuple[Part, ...]) -> tuple[dict[str, Any], ...]:
    return tuple(part._asdict() for part in layout)


ACTION_CONTRACT = _described(ACTION)


def observation_contract(config: ObservationConfig) -> tuple[dict[str, Any], ...]:
    """Return what a policy with these options sees, for its contract."""
    return _described(policy_layout(config))


def contract_of(task: BaseModel, network: NetworkConfig, launch: str, *, run: str, **where: int) -> Contract:
    """Return the contract of a policy that is trained now.

    Args:
        task: The environment's settings (``EnvConfig``).
        network: The network's.
        launch: Preset of the rallies.
        run: Name of the run.
        where: generation, version, stage and frames.
    """
    env = task.model_dump(mode="json")
    options = ObservationConfig.model_validate(env["observation"])
    return Contract(
        observation=observation_contract(options),
        observation_options=options,
        action=ACTION_CONTRACT,
        network=network,
        control_rate_hz=env["control_rate_hz"],
        robot=env["robot"],
        launch=launch,
        noise=env["noise"],
        env=env,
        run=run,
        made_with={name: package_version(name) for name in ("topspin", "mujoco", "torch", "numpy")},
        **where,
    )


def task_hash(network: NetworkConfig, env: Mapping[str, Any], launch: str) -> str:
    """Return a hash of all that a learner and its actors must agree on: layouts, network, task and launches."""
    task = {
        "observation": _described(OBSERVATION),
        "action": ACTION_CONTRACT,
        "network": network.model_dump(mode="json"),
        "env": dict(env),
        "launch": launch,
    }
    return hashlib.sha256(json.dumps(task, sort_keys=True).encode()).hexdigest()[:16]


def state_tensors(network: ActorCritic) -> dict[str, npt.NDArray[np.float32]]:
    """Return the network's parameters by name, as copies."""
    return {name: value.detach().numpy().copy() for name, value in network.state_dict().items()}


def pack(network: ActorCritic) -> bytes:
    """Return the network's parameters as a safetensors blob."""
    return save_tensors(state_tensors(network))


def unpack(network: ActorCritic, blob: bytes) -> None:
    """Load a blob of ``pack`` into ``network``; raises PolicyError where it doesn't fit."""
    try:
        tensors = load_tensors(blob)
    except (SafetensorError, ValueError, KeyError) as error:  # KeyError: a dtype that numpy lacks
        raise PolicyError(f"weights are not readable as safetensors: {error}") from None
    load_state(network, tensors)


def load_state(network: ActorCritic, tensors: Mapping[str, npt.NDArray[Any]]) -> None:
    """Load parameters by name; raises PolicyError naming the first that is missing, unknown or misshapen."""
    own = network.state_dict()
    for name in own.keys() - tensors.keys():
        raise PolicyError(f"weights lack {name!r}; the network has {', '.join(sorted(own))}")
    for name, value in tensors.items():
        if name not in own:
            raise PolicyError(f"weights hold unknown {name!r}; the network has {', '.join(sorted(own))}")
        if tuple(own[name].shape) != value.shape:
            raise PolicyError(
                f"weights {name!r} have shape {value.shape}; allowed is {tuple(own[name].shape)}"
            )
        if not np.isfinite(value).all():
            raise PolicyError(f"weights {name!r} are not finite")
    network.load_state_dict({name: torch.from_numpy(np.array(value)) for name, value in tensors.items()})


def observation_moments(
    mean: npt.NDArray[np.float64],
    var: npt.NDArray[np.float64],
    count: int,
    layout: tuple[Part, ...],
) -> Moments:
    """Return the moments that came with a policy; raises PolicyError if they are not those of ``layout``."""
    allowed = (size(layout),)
    if not mean.shape == var.shape == allowed:
        raise PolicyError(f"observation moments of shapes {mean.shape} and {var.shape}; allowed is {allowed}")
    return Moments(mean, var, count)


def install(
    network: ActorCritic, snapshot: PolicySnapshot, layout: tuple[Part, ...], contract_hash: str, who: str
) -> Moments:
    """Load a policy that came over the wire into ``network``, and return its normaliser's moments.

    Args:
        network: Written.
        snapshot: What came.
        layout: What its critic sees.
        contract_hash: ``task_hash`` of the one who installs it.
        who: That is, for people: "actor".

    Raises:
        PolicyError: It is of another task or doesn't fit; ``network`` is as it was.
    """
    if snapshot.contract_hash != contract_hash:
        raise PolicyError(
            f"policy has contract {snapshot.contract_hash}, this {who} has {contract_hash}: "
            "start both with the same network, env and launch settings"
        )
    moments = observation_moments(snapshot.obs_mean, snapshot.obs_var, snapshot.obs_count, layout)
    unpack(network, snapshot.weights)
    return moments


@dataclass(frozen=True, slots=True)
class Policy:
    """A policy to play: network, frozen normaliser and contract. Read from a folder, its critic is a blank."""

    network: ActorCritic
    moments: Moments
    contract: Contract

    def act(self, obs: npt.NDArray[np.float32]) -> npt.NDArray[np.float32]:
        """Return the deterministic actions (B, 7) for raw observations (B, D); only the policy's part is looked at."""
        seen = self.network.obs_size
        with torch.inference_mode():
            mean = self.network.act(torch.from_numpy(normalize(obs[:, :seen], self.moments.first(seen))))
        actions: npt.NDArray[np.float32] = mean.numpy()
        return actions


def write_policy(folder: Path, network: ActorCritic, moments: Moments, contract: Contract) -> None:
    """Write the two files of a policy into ``folder``, which nobody reads yet: what acts, and not the critic."""
    folder.mkdir(parents=True, exist_ok=True)
    tensors: dict[str, npt.NDArray[Any]] = {
        name: value for name, value in state_tensors(network).items() if name.startswith(_ACTING)
    }
    seen = moments.first(network.obs_size)
    tensors[_OBS_MEAN], tensors[_OBS_VAR] = seen.mean, seen.var
    tensors[_OBS_COUNT] = np.array(seen.count, np.int64)
    (folder / WEIGHTS_FILE).write_bytes(save_tensors(tensors))
    (folder / CONTRACT_FILE).write_text(contract.model_dump_json(indent=2) + "\n")


def save_policy(folder: Path, network: ActorCritic, moments: Moments, contract: Contract) -> None:
    """Write a policy folder; whoever reads it sees the old one or the new one, never a mixture.

    The folder is a symbolic link that is replaced in one step. The folder before stays until the next save, for those
    who are reading it; older ones go.
    """
    folder.parent.mkdir(parents=True, exist_ok=True)
    fresh = Path(tempfile.mkdtemp(prefix=f".{folder.name}-", dir=folder.parent))
    fresh.chmod(0o755)
    write_policy(fresh, network, moments, contract)
    for path in fresh.iterdir():
        with path.open("rb") as file:
            os.fsync(file.fileno())
    old = folder.parent / os.readlink(folder) if folder.is_symlink() else None
    link = folder.parent / f"{fresh.name}.link"
    link.symlink_to(fresh.name)
    os.replace(link, folder)
    for other in folder.parent.glob(f".{folder.name}-*"):
        if other not in (fresh, old):
            shutil.rmtree(other, ignore_errors=True)


def load_policy(folder: Path) -> Policy:
    """Return the policy in ``folder``; raises PolicyError with one line where it can't be used."""
    folder = Path(os.path.realpath(folder))
    try:
        contract = Contract.model_validate_json((folder / CONTRACT_FILE).read_text())
        tensors = load_tensors((folder / WEIGHTS_FILE).read_bytes())
    except OSError as error:
        raise PolicyError(
            f"no policy in {folder}: {error.strerror} ({Path(error.filename or '').name}); "
            f"wanted is a folder with {WEIGHTS_FILE} and {CONTRACT_FILE}"
        ) from None
    except ValidationError as error:
        first = error.errors()[0]
        where = ".".join(str(part) for part in first["loc"])
        raise PolicyError(f"{folder / CONTRACT_FILE}: {where or 'file'}: {first['msg']}") from None
    except (SafetensorError, ValueError, KeyError) as error:
        raise PolicyError(f"{folder / WEIGHTS_FILE} is not readable as safetensors: {error}") from None
    options = contract.observation_options
    expected = json.loads(json.dumps([observation_contract(options), ACTION_CONTRACT]))
    found = json.loads(json.dumps([contract.observation, contract.action]))
    if found != expected:
        raise PolicyError(
            f"{folder / CONTRACT_FILE}: its observation or action layout is not this version's "
            f"({size(policy_layout(options))} and {ACTION_SIZE} numbers, see common/rally/observation.py)"
        )
    for name in _MOMENTS:
        if name not in tensors:
            raise PolicyError(f"{folder / WEIGHTS_FILE} lacks {name!r}")
    moments = observation_moments(
        tensors[_OBS_MEAN], tensors[_OBS_VAR], int(tensors[_OBS_COUNT]), policy_layout(options)
    )
    network = new_network(contract.network, options.model_copy(update={"critic": "policy"}))
    blank = {
        name: np.zeros_like(value)
        for name, value in state_tensors(network).items()
        if not name.startswith(_ACTING)
    }
    load_state(network, blank | {name: value for name, value in tensors.items() if name not in _MOMENTS})
    return Policy(network, moments, contract)


def mean_policy(policies: Sequence[Policy]) -> Policy:
    """Return the policy with the mean of several ones' weights and observation moments: a model soup.

    Of policies that set out from one, along different ways, the mean is often better than each (Wortsman et al. 2022).
    It has the first one's contract, with the most frames of all; ``made_with`` says what it is the mean of.

    Raises:
        PolicyError: They differ in what they see or in their network.
    """
    first = policies[0].contract
    for policy in policies[1:]:
        theirs, ours = (c.model_dump(include=_SHAPE) for c in (policy.contract, first))
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
    parts = [f"{p.contract.run} {p.contract.frames} frames, launch {p.contract.launch}" for p in policies]
    contract = first.model_copy(
        update={
            "frames": max(policy.contract.frames for policy in policies),
            "made_with": first.made_with | {"mean_of": "; ".join(parts)},
        }
    )
    return Policy(network, moments, contract)


def new_network(
    config: NetworkConfig,
    observation: ObservationConfig = PAPER_OBSERVATION,
    home_action: npt.NDArray[np.float32] | None = None,
) -> ActorCritic:
    """Return a fresh network for what policy and critic see."""
    home = np.zeros(ACTION_SIZE, np.float32) if home_action is None else home_action
    own, all_ = size(policy_layout(observation)), size(critic_layout(observation))
    return ActorCritic(own, ACTION_SIZE, config, home, all_ - own)
