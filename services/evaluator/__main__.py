"""Run the evaluator: `python -m services.evaluator`; with --policy it plays once and ends.

`play`, `pictures`, `real2sim`, `report` and `ship` as first argument are commands of their own, with their own --help.
"""

import os
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from threading import Event
from typing import Final

from common.config import first_look, load
from common.connection import connected
from common.log import set_up_logging
from common.policy.weights import load_policy
from common.process import DONE, run_service
from common.service_config import new_incarnation
from services.evaluator import once, pictures, play, ship
from services.evaluator.config import EvaluatorConfig
from services.evaluator.real2sim import command as real2sim
from services.evaluator.report import command as report
from services.evaluator.service import EvaluatorService

PROG = "python -m services.evaluator"


SUBCOMMANDS: Final[dict[str, Callable[[Sequence[str], Event], int]]] = {
    "play": play.main,
    "pictures": pictures.main,
    "real2sim": real2sim.main,
    "report": report.main,
    "ship": ship.main,
}


def settings(argv: Sequence[str]) -> EvaluatorConfig:
    """Return the evaluator's settings; with a policy the task is the contract's, and what would set it is refused."""
    asked, _ = first_look(EvaluatorConfig, ("policy",), argv, prog=PROG, section="evaluator")
    elsewhere = once.given_elsewhere if asked.policy else lambda _: {}
    return load(
        EvaluatorConfig, argv, prog=PROG, section="evaluator", elsewhere=elsewhere, set_by=once.SET_BY
    )


def main(stop: Event) -> int:
    """Run the service until it is done or asked to stop, or a command; return the exit status."""
    if len(sys.argv) > 1 and sys.argv[1] in SUBCOMMANDS:
        return SUBCOMMANDS[sys.argv[1]](sys.argv[2:], stop)
    config = settings(sys.argv[1:])
    if config.policy:
        set_up_logging(config.log_level, "evaluator")
        folder = Path(config.policy)
        policy = load_policy(folder)
        contract = policy.contract.expecting(config.spin_expected)
        env = once.task_of(contract, config.env, config.noise, config.rounds)
        found = once.measure(policy, folder, env, config, lambda: once.check(stop))
        once.print_measures(found, config.json_line)
        return DONE
    os.nice(config.niceness)
    with connected("evaluator", config, stop) as (transport, metrics):
        EvaluatorService(config, transport, metrics, new_incarnation()).run(stop)
    return DONE


if __name__ == "__main__":
    sys.exit(run_service(PROG, main))
