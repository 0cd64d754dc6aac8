"""A policy's contract: what its weights expect and where they come from. Also the hashes that services compare."""

import hashlib
import json
from importlib.metadata import version as package_version
from typing import Any, Final, Literal, Self

from pydantic import BaseModel, ConfigDict, Field

from common.errors import ConfigError, ReportedError
from common.policy.config import NetworkConfig
from common.task.config import TaskConfig
from common.task.experience import ExperienceConfig
from common.task.observation import ACTION, ExpectedSpin, ObservationConfig, Part, policy_layout

FORMAT: Final = 2
WEIGHTS_FILE, CONTRACT_FILE = "weights.safetensors", "contract.json"  # of a policy folder


class PolicyError(ReportedError, ValueError):
    """A policy that can't be read or doesn't fit: one line with what was given and what is allowed."""


class NoPolicyError(PolicyError, ConfigError):
    """A policy that a setting names, and that is not there."""


class Contract(BaseModel):
    """What a policy's weights expect, and where they come from."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    format: Literal[2] = FORMAT
    observation: tuple[
        dict[str, Any], ...
    ]  # each part's name, size, unit and range: policy_layout of the task
    action: tuple[dict[str, Any], ...]
    task: TaskConfig  # in which it was trained
    experience: ExperienceConfig  # how training played the task
    network: NetworkConfig
    run: str
    generation: int = Field(ge=0)
    version: int = Field(ge=0)
    stage: int = Field(ge=1, le=3)
    frames: int = Field(ge=0)
    measures: dict[str, Any] = {}
    made_with: dict[str, str] = {}

    @property
    def is_end_to_end(self) -> bool:
        """Whether the policy goes from measurements to actions by itself, as the table of Hu et al. uses the word.

        A policy that is fed a prediction of the trajectory, a filtered ball, or an estimated or true spin is not.
        """
        observation = self.task.observation
        return not observation.is_tracked and observation.spin == "hidden"

    def expecting(self, spin: ExpectedSpin | Literal["contract"]) -> Self:
        """Return the contract with another expected spin than in training; ``contract`` returns it as it is.

        Raises:
            PolicyError: The policy observes nothing that depends on it.
        """
        if spin == "contract":
            return self
        if not self.task.observation.is_tracked:
            raise PolicyError(
                f"expected_spin {spin!r} for a policy without a flight filter; allowed: 'contract'"
            )
        observation = self.task.observation.model_copy(update={"expected_spin": spin})
        return self.model_copy(update={"task": self.task.model_copy(update={"observation": observation})})


def described(layout: tuple[Part, ...]) -> tuple[dict[str, Any], ...]:
    """Return a layout as a contract holds it."""
    return tuple(part._asdict() for part in layout)


def same_numbers(one: tuple[dict[str, Any], ...], other: tuple[dict[str, Any], ...]) -> bool:
    """Return whether two described layouts hold the same numbers in the same order; their texts may differ."""
    names = ("name", "size", "unit")
    return [[part.get(k) for k in names] for part in one] == [[part.get(k) for k in names] for part in other]


def contract_of(
    task: TaskConfig, experience: ExperienceConfig, network: NetworkConfig, *, run: str, **where: int
) -> Contract:
    """Return the contract of a policy that is trained now.

    Args:
        task: The task.
        experience: How training plays it.
        network: The network's shape.
        run: Name of the run.
        where: generation, version, stage and frames.
    """
    return Contract(
        observation=described(policy_layout(task.observation)),
        action=described(ACTION),
        task=task,
        experience=experience,
        network=network,
        run=run,
        made_with={name: package_version(name) for name in ("topspin", "mujoco", "torch", "numpy")},
        **where,
    )


def contract_hash(task: TaskConfig, network: NetworkConfig) -> str:
    """Return a hash of task and network: what a policy's weights mean. The evaluator checks it."""
    return _digest(task, network)


def training_hash(task: TaskConfig, network: NetworkConfig, experience: ExperienceConfig) -> str:
    """Return a hash of task, network and experience: what a rollout means. Learner and actors check it."""
    return _digest(task, network, experience)


def _digest(*settings: BaseModel) -> str:
    values = [model.model_dump(mode="json") for model in settings]
    layouts = [[(part.name, part.size) for part in layout] for layout in (_PAPER_LAYOUT, ACTION)]
    return hashlib.sha256(json.dumps([values, layouts], sort_keys=True).encode()).hexdigest()[:16]


_PAPER_LAYOUT: Final = policy_layout(ObservationConfig())
