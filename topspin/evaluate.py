"""`topspin evaluate`: measure a policy on fixed rallies."""

# ruff: noqa: PLC0415 - what a command runs on is imported after its flags are read: --help answers at once

from collections.abc import Sequence
from threading import Event
from typing import ClassVar, Final

from pydantic import Field

from common.evaluation.config import MatchConfig
from common.service.config import load
from common.service.log import set_up_logging
from common.service.process import DONE
from common.service.settings import LogLevel

PROG: Final = "topspin evaluate"


class EvaluateConfig(MatchConfig):
    """Measure a policy on fixed rallies, without exploration noise, every rally to its end.

    Robot, rubber, control rate and observation are those of the policy's contract.
    """

    often: ClassVar = {
        "The policy": ("policy", "expected_spin"),
        "The rallies": ("rallies", "launch", "rounds", "randomization", "perception", "collision", "seed"),
        "The result": ("json",),
    }

    policy: str = Field("default", description="a policy of the box, or a policy folder")
    json_line: bool = Field(
        False, alias="json", description="print the measures as one JSON object, last line"
    )
    log_level: LogLevel = Field("info", description="least severe lines logged")


def main(argv: Sequence[str], stop: Event) -> int:
    """Measure and print; return the exit status."""
    config = load(EvaluateConfig, argv, prog=PROG, section="evaluate")
    set_up_logging(config.log_level, "evaluate")
    from common.evaluation.evaluate import check, measure
    from common.evaluation.printed import print_measures
    from common.policy.box import policy_folder
    from common.policy.folder import load_policy
    from topspin.progress import rallies_left

    folder = policy_folder(config.policy)
    with rallies_left(config.rallies) as on_left:
        found = measure(load_policy(folder), folder, config, lambda: check(stop), on_left)
    print_measures(found, config.json_line)
    return DONE
