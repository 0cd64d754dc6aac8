"""`topspin release`: put a policy into the box, common/policies/NAME, with its measures."""

# ruff: noqa: PLC0415 - what a command runs on is imported after its flags are read: --help answers at once

import json
import logging
import sys
from collections.abc import Sequence
from pathlib import Path
from threading import Event
from typing import Any, ClassVar, Final

from pydantic import BaseModel, ConfigDict, Field

from common.errors import ConfigError
from common.evaluation.config import DEFAULT_ENVS, SEED, Environments, MatchConfig, MatchSpin
from common.policy.box import BOX, policy_folder
from common.service.config import load
from common.service.log import set_up_logging
from common.service.process import DONE

log = logging.getLogger(__name__)

PROG: Final = "topspin release"

EXAMS: Final[dict[str, dict[str, Any]]] = {
    "paper": {"launch": "paper", "rounds": 1},
    "strong": {"launch": "strong", "rounds": 1},
    "match": {"launch": "match", "rounds": 1},
    "serve": {"launch": "serve", "rounds": 1},
    "elite": {"launch": "elite", "rounds": 1},
    "recovering": {"launch": "paper", "rounds": 5},
}
"""What a policy in the box is measured on: each kind of ball, and five balls in a row without a reset of the robot."""


class ReleaseConfig(BaseModel):
    """Measure a policy on every exam and put it, with the measures in its contract, into the box."""

    model_config = ConfigDict(frozen=True, extra="forbid")
    often: ClassVar = {
        "The policy": ("policy", "name", "replace", "box"),
        "The exams": ("rallies", "seed", "envs", "expected_spin"),
    }

    policy: str = Field(
        "runs/latest/policy/best",
        description="policy folder; several, separated by commas: the mean of their weights, for policies that were "
        "trained on from one",
    )
    name: str = Field(pattern=r"^[a-z0-9][a-z0-9_-]*$", description="name in the box")
    replace: bool = Field(False, description="replace the policy of this name")
    rallies: int = Field(2000, ge=1, le=1_000_000, description="rallies of each exam")
    seed: int = Field(SEED, ge=0, lt=2**63, description="of the rallies")
    envs: Environments = DEFAULT_ENVS
    expected_spin: MatchSpin = "contract"
    box: str = Field(str(BOX), description="folder of the box")


def main(argv: Sequence[str], stop: Event) -> int:
    """Measure and write; return the exit status."""
    config = load(ReleaseConfig, argv, prog=PROG, section="release")
    set_up_logging("info", "release")
    from common.evaluation.evaluate import check, measure
    from common.policy.folder import load_policy, mean_policy, save_policy
    from topspin.report.provenance import commit_of

    target = Path(config.box) / config.name
    if target.exists() and not config.replace:
        raise ConfigError(f"{target} exists; allowed: another --name, or --replace")
    names = [name.strip() for name in config.policy.split(",")]
    if not all(names):
        raise ConfigError(
            f"--policy {config.policy!r} has an empty name; allowed: policies, separated by commas"
        )
    policies = [load_policy(policy_folder(name)) for name in names]
    policy = mean_policy(policies) if len(policies) > 1 else policies[0]
    contract = policy.contract.expecting(config.expected_spin)
    found: dict[str, Any] = {}
    for name, conditions in EXAMS.items():
        exam = MatchConfig(
            rallies=config.rallies,
            seed=config.seed,
            envs=config.envs,
            expected_spin=config.expected_spin,
            **conditions,
        )
        found[name] = measure(policy, Path(config.policy), exam, lambda: check(stop))
        for unwanted in ("by", "policy"):
            found[name].pop(unwanted)
        log.info(
            "measured exam=%s return=%s after_catch=%s error=%s",
            name,
            found[name]["return_rate"],
            found[name]["return_after_catch"],
            found[name]["target_error_mean"],
        )
    made_with = policy.contract.made_with | {"commit": commit_of(Path(__file__).parent) or "unknown"}
    if contract != policy.contract:
        made_with["trained_with_expected_spin"] = policy.contract.task.observation.expected_spin
    contract = contract.model_copy(update={"measures": found, "made_with": made_with})
    save_policy(target, policy.network, policy.moments, contract)
    sys.stdout.write(json.dumps({"policy": str(target), "measures": found}) + "\n")
    return DONE
