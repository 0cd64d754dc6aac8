"""`python -m services.evaluator play`: measure a policy on fixed rallies, and film the first of them."""

import time
from collections.abc import Sequence
from pathlib import Path
from threading import Event
from typing import Final, Literal

from pydantic import Field

from common.config import load
from common.env.rally_env import EnvConfig
from common.log import set_up_logging
from common.policy.weights import load_policy
from common.process import DONE
from common.rally.launch_presets import PresetName
from common.render.film import check_tools
from common.render.rally_recorder import record
from common.run_folder import LATEST, RunFolder
from services.evaluator import once
from services.evaluator.filming import FilmConfig, film
from services.evaluator.match import DEFAULT_ENVS, Environments, evaluation_rallies

PROG: Final = "python -m services.evaluator play"
SHIPPED_POLICY: Final = Path("assets/policies/default")


class PlayConfig(FilmConfig):
    """Measure a policy on fixed rallies and film the first of them."""

    policy: str = Field(
        "", description=f"policy folder; empty: {SHIPPED_POLICY} if it is there, else the latest run's best"
    )
    video: str = Field("runs/play.mp4", pattern=r"\.mp4$", description="film to write, H.264")
    rallies: int = Field(2000, ge=1, le=1_000_000, description="rallies to measure on")
    film_rallies: int = Field(8, ge=0, le=200, description="rallies to film, the first ones; 0: no film")
    launch: PresetName = Field("paper", description="launch preset")
    noise: Literal["off", "standard", "hard"] = Field("standard", description="noise profile")
    rounds: int = Field(1, ge=1, le=1000, description="rallies an episode plays while they are returned")
    seed: int = Field(20260, ge=0, lt=2**63, description="of the rallies")
    envs: Environments = DEFAULT_ENVS
    json_line: bool = Field(
        False, alias="json", description="print the measures as one JSON object, last line"
    )
    log_level: Literal["debug", "info", "warning", "error"] = Field(
        "info", description="least severe lines logged"
    )
    env: EnvConfig = EnvConfig()


def main(argv: Sequence[str], stop: Event) -> int:
    """Measure and film; return the exit status."""

    def breathe() -> None:
        once.check(stop)

    config = load(
        PlayConfig, argv, prog=PROG, section="play", elsewhere=once.given_elsewhere, set_by=once.SET_BY
    )
    set_up_logging(config.log_level, "evaluator")
    started = time.monotonic()
    folder = policy_folder(config.policy)
    policy = load_policy(folder)
    if config.film_rallies:
        check_tools()
    env = once.task_of(policy.contract, config.env, config.noise, config.rounds)
    found = once.measure(policy, folder, env, config, breathe)
    if config.film_rallies:
        found["video"] = config.video
        rallies = evaluation_rallies(
            config.film_rallies, config.launch, config.noise, config.seed, env.flight
        )
        note = f"{config.launch} balls, noise {config.noise}"
        # once more, from home: a match keeps no flights
        film(Path(config.video), record(policy.act, rallies, env), config, note, breathe)
    found["seconds"] = round(time.monotonic() - started, 2)
    once.print_measures(found, config.json_line)
    return DONE


def policy_folder(given: str) -> Path:
    """Return the folder of the policy that is meant: the one given, the shipped one, or the latest run's best."""
    if given:
        return Path(given)
    return SHIPPED_POLICY if SHIPPED_POLICY.exists() else RunFolder.of(LATEST).best_policy
