"""Training that starts from a trained policy instead of from new weights: which policies fit, and what is taken over.

The policy brings network, action noise and observation moments, and acts from the first frame on. Its critic is not in
its folder. So a new one learns first, as after a stage change, and an adaptive learning rate starts at its lower bound.
"""

from collections.abc import Iterator
from typing import TYPE_CHECKING, Any, Final

from common.policy.box import policy_folder
from common.policy.contract import Contract, PolicyError
from common.policy.folder import Policy, load_policy

if TYPE_CHECKING:
    from services.learner.config import LearnerConfig

MAY_DIFFER: Final = frozenset({"critic", "expected_spin"})
"""Parts of the observation that a policy's weights do not depend on."""


def start_policy(config: "LearnerConfig") -> Policy | None:
    """Return the policy that a new run starts from, or None without one.

    Raises:
        PolicyError: It can't be read, or is not of this run's network, observation or control rate, or the run would
            start in an earlier stage than the policy was in.
    """
    if not config.start_policy or config.resume:  # a checkpoint has everything
        return None
    policy = load_policy(policy_folder(config.start_policy))
    wrong = [f"{name} {own} (allowed: {theirs})" for name, own, theirs in misfits(config, policy.contract)]
    if wrong:
        raise PolicyError(f"start_policy {config.start_policy} does not fit this run: {'; '.join(wrong)}")
    return policy


def misfits(config: "LearnerConfig", contract: Contract) -> Iterator[tuple[str, str, str]]:
    """Yield each setting that must be another for a policy: its name, the run's value, and the policy's."""
    theirs, own = contract.task, config.task
    if config.network.units != contract.network.units:
        yield "network.units", _text(config.network.units), _text(contract.network.units)
    for name in (field for field in type(own.observation).model_fields if field not in MAY_DIFFER):
        ours, wanted = getattr(own.observation, name), getattr(theirs.observation, name)
        if ours != wanted:
            yield f"task.observation.{name}", _text(ours), _text(wanted)
    if own.control_rate_hz != theirs.control_rate_hz:
        yield "task.control_rate_hz", f"{own.control_rate_hz:g}", f"{theirs.control_rate_hz:g}"
    if config.curriculum.first_stage < contract.stage:
        yield "curriculum.first_stage", str(config.curriculum.first_stage), f"{contract.stage} or later"


def _text(value: Any) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    return ",".join(map(str, value)) if isinstance(value, tuple | list) else str(value)
