"""Run the evaluator: `python -m services.evaluator`; with --policy it plays once and ends.

`play` and `pictures` as first argument are commands of their own, with their own --help.
"""

import os
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from threading import Event
from typing import Final

from common.config import load
from common.connection import connected
from common.log import set_up_logging
from common.policy.weights import load_policy
from common.process import DONE, run_service
from common.service_config import new_incarnation
from services.evaluator import pictures, play
from services.evaluator.config import EvaluatorConfig
from services.evaluator.match import evaluation_rallies, play_match
from services.evaluator.measures import measures
from services.evaluator.service import EvaluatorService

PROG = "python -m services.evaluator"
SUBCOMMANDS: Final[dict[str, Callable[[Sequence[str], Event], int]]] = {
    "play": play.main,
    "pictures": pictures.main,
}


def main(stop: Event) -> int:
    """Run the service until it is done or asked to stop, or a command; return the exit status."""
    if len(sys.argv) > 1 and sys.argv[1] in SUBCOMMANDS:
        return SUBCOMMANDS[sys.argv[1]](sys.argv[2:], stop)
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
    env = play.task_of(policy.contract, config.env, config.noise, config.rounds)
    rallies = evaluation_rallies(config.rallies, config.launch, config.noise, config.seed, env.flight)
    found = measures(play_match(policy, rallies, env, config.envs))
    about = {
        "launch": config.launch,
        "noise": config.noise,
        "rounds": config.rounds,
        "seed": config.seed,
        "policy": config.policy,
        "seconds": round(time.monotonic() - started, 2),
    }
    play.print_measures(found | about, config.json_line)


if __name__ == "__main__":
    sys.exit(run_service(PROG, main))
