"""`topspin play`: measure a policy on fixed rallies, and then film the first of them."""

# ruff: noqa: PLC0415 - what a command runs on is imported after its flags are read: --help answers at once

import sys
import time
from collections.abc import Sequence
from pathlib import Path
from threading import Event
from typing import ClassVar, Final

from pydantic import Field

from common.errors import ReportedError
from common.evaluation.config import MatchConfig
from common.service.config import load
from common.service.log import set_up_logging
from common.service.process import DONE
from common.service.settings import LogLevel
from topspin.render.config import FilmConfig

PROG: Final = "topspin play"


class PlayConfig(MatchConfig, FilmConfig):
    """Measure a policy on fixed rallies, and film the first of them.

    Robot, rubber, control rate and observation are those of the policy's contract.
    """

    often: ClassVar = {
        "What plays": ("policy",),
        "The rallies": ("rallies", "launch", "rounds", "randomization"),
        "The film": ("video", "film_rallies", "camera", "slow", "slow_at_hit"),
        "The result": ("json",),
    }

    policy: str = Field("default", description="a policy of the box, or a policy folder")
    video: str = Field("runs/play.mp4", pattern=r"\.mp4$", description="film to write, H.264")
    film_rallies: int = Field(8, ge=0, le=200, description="rallies to film, the first ones; 0: no film")
    json_line: bool = Field(
        False, alias="json", description="print the measures as one JSON object, last line"
    )
    log_level: LogLevel = Field("info", description="least severe lines logged")


def main(argv: Sequence[str], stop: Event) -> int:
    """Measure and film; return the exit status."""
    config = load(PlayConfig, argv, prog=PROG, section="play")
    set_up_logging(config.log_level, "play")
    from common.evaluation.evaluate import check, measure
    from common.evaluation.match import evaluation_rallies, match_task
    from common.evaluation.printed import print_measures
    from common.evaluation.rally_recorder import record_rallies
    from common.policy.box import policy_folder
    from common.policy.folder import load_policy
    from topspin.progress import rallies_left
    from topspin.render.film import check_tools, film
    from topspin.render.score_card import score_card

    started = time.monotonic()
    folder = policy_folder(config.policy)
    policy = load_policy(folder)
    if config.film_rallies:
        check_tools(Path(config.video))

    def on_tick() -> None:
        check(stop)

    with rallies_left(config.rallies) as on_left:
        found = measure(policy, folder, config, on_tick, on_left)
    if config.film_rallies:
        found["video"] = config.video
        if not config.json_line:
            print_measures(found, as_json=False)  # the numbers first: a film takes minutes
        task = match_task(policy.contract, config, config.expected_spin)
        rallies = evaluation_rallies(config.film_rallies, task, config.seed)
        note = f"{config.launch} balls, randomization {config.randomization}"
        # played once more, from home: a match keeps no flights
        records = record_rallies(policy.act, rallies, task, on_tick)
        try:
            film(Path(config.video), records, config, note, on_tick, score_card(found, config.policy))
        except ReportedError:
            if config.json_line:  # the measures are there, if no film is
                del found["video"]
                print_measures(found, as_json=True)
            raise
    found["seconds"] = round(time.monotonic() - started, 2)
    if config.json_line or not config.film_rallies:
        print_measures(found, config.json_line)
    else:
        sys.stdout.write(f"film of {config.film_rallies} rallies in {config.video}\n")
    return DONE
