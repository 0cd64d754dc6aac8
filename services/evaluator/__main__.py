"""Run the evaluator: `python -m services.evaluator`; with --policy it plays once and ends; `report RUN...` compares."""

import json
import os
import sys
import time
from pathlib import Path
from threading import Event
from typing import Any

from common.config import load
from common.connection import connected
from common.log import set_up_logging
from common.policy.weights import load_policy
from common.process import DONE, run_service
from common.service_config import new_incarnation
from services.evaluator.breakdown import breakdown, survival, table
from services.evaluator.config import EvaluatorConfig
from services.evaluator.match import evaluation_rallies, play_match
from services.evaluator.measures import measures
from services.evaluator.report.command import main as report
from services.evaluator.service import EvaluatorService

PROG = "python -m services.evaluator"


def main(stop: Event) -> int:
    """Run the service until it is done or asked to stop; return the exit status."""
    if sys.argv[1:2] == ["report"]:
        report(sys.argv[2:], stop)
        return DONE
    config = load(EvaluatorConfig, sys.argv[1:], prog=PROG, section="evaluator")
    if config.policy:
        set_up_logging(config.log_level, "evaluator")
        play_once(config)
        return DONE
    os.nice(config.niceness)
    with connected("evaluator", config, stop) as (transport, metrics):
        EvaluatorService(config, transport, metrics, new_incarnation()).run(stop)
    return DONE


def play_once(config: EvaluatorConfig) -> None:
    """Play a policy from a folder and print the measures; the last line is JSON if asked for."""
    started = time.monotonic()
    policy = load_policy(Path(config.policy))
    contract = policy.contract
    env = config.env.model_copy(
        update={
            "noise": config.noise,
            "rounds": config.rounds,
            "control_rate_hz": contract.control_rate_hz,
            "robot": contract.robot,
            "observation": contract.observation_options,
        }
    )
    rallies = evaluation_rallies(config.rallies, config.launch, config.noise, config.seed, env.flight)
    played = play_match(policy, rallies, env, config.envs)
    found = measures(played) | survival(played)
    by = breakdown(played)
    about: dict[str, Any] = {
        "launch": config.launch,
        "noise": config.noise,
        "rounds": config.rounds,
        "seed": config.seed,
    }
    about |= {"policy": config.policy, "seconds": round(time.monotonic() - started, 2)}
    if config.json_line:
        sys.stdout.write(json.dumps(found | about | {"by": by}) + "\n")
        return
    for name, value in (found | about).items():
        sys.stdout.write(f"{name:>24}  {value}\n")
    sys.stdout.write("\n".join(table(by)) + "\n")


if __name__ == "__main__":
    sys.exit(run_service(PROG, main))
