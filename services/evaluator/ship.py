"""`python -m services.evaluator ship`: put a policy in the box, assets/policies/NAME, with what it measures."""

import json
import logging
import sys
from collections.abc import Sequence
from pathlib import Path
from threading import Event
from typing import Any, Final

from pydantic import BaseModel, ConfigDict, Field

from common.config import load
from common.env.rally_env import EnvConfig
from common.log import set_up_logging
from common.policy.weights import load_policy, mean_policy, write_policy
from common.process import DONE
from services.evaluator import once
from services.evaluator.match import DEFAULT_ENVS, Environments, PolicyExpectation
from services.evaluator.report.origin import commit_of

log = logging.getLogger(__name__)

PROG: Final = "python -m services.evaluator ship"
BOX: Final = Path("assets/policies")

EXAMS: Final[dict[str, dict[str, Any]]] = {
    "paper": {"launch": "paper", "rounds": 1},
    "strong": {"launch": "strong", "rounds": 1},
    "recovering": {"launch": "paper", "rounds": 5},
}
"""What a policy in the box is measured on: the paper's balls, balls with up to 300 rad/s of spin, and five balls in
a row without a reset of the robot between them."""


class ShipConfig(BaseModel):
    """Measure a policy on every exam and put it, with the figures in its contract, into assets/policies."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    policy: str = Field(
        "runs/latest/policy/best",
        description="policy folder; several, separated by commas: the mean of their weights, for policies that set out "
        "from one",
    )
    name: str = Field("default", pattern=r"^[a-z0-9][a-z0-9_-]*$", description="name in the box")
    rallies: int = Field(2000, ge=1, le=1_000_000, description="rallies of each exam")
    seed: int = Field(20260, ge=0, lt=2**63, description="of the rallies")
    envs: Environments = DEFAULT_ENVS
    spin_expected: PolicyExpectation = "contract"


class _Exam(BaseModel):
    """One exam's settings, as ``once.MatchSettings`` wants them."""

    rallies: int
    launch: str
    noise: str = "standard"
    rounds: int
    seed: int
    envs: int


def main(argv: Sequence[str], stop: Event) -> int:
    """Measure and write; return the exit status."""
    config = load(ShipConfig, argv, prog=PROG, section="ship")
    set_up_logging("info", "evaluator")
    policies = [load_policy(Path(folder)) for folder in config.policy.split(",")]
    policy = mean_policy(policies) if len(policies) > 1 else policies[0]
    contract = policy.contract.expecting(config.spin_expected)
    found: dict[str, Any] = {}
    for name, what in EXAMS.items():
        exam = _Exam(rallies=config.rallies, seed=config.seed, envs=config.envs, **what)
        env = once.task_of(contract, EnvConfig(), exam.noise, exam.rounds)
        found[name] = once.measure(policy, Path(config.policy), env, exam, lambda: once.check(stop))
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
    contract = contract.model_copy(update={"measures": found, "made_with": made_with})
    target = BOX / config.name
    write_policy(target, policy.network, policy.moments, contract)
    sys.stdout.write(json.dumps({"policy": str(target), "measures": found}) + "\n")
    return DONE
