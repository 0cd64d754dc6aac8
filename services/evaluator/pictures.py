"""`python -m services.evaluator pictures`: stills of a policy's best rally, for the README."""

import logging
from collections.abc import Sequence
from pathlib import Path
from threading import Event
from typing import Final, Literal

from pydantic import BaseModel, ConfigDict, Field

from common.config import load
from common.env.rally_env import EnvConfig
from common.log import set_up_logging
from common.policy.weights import load_policy
from common.process import DONE
from common.rally.launch_presets import PresetName
from common.render.rally_recorder import record
from common.render.stills import rally_picture, rally_strip, save_png, showpiece
from services.evaluator.match import evaluation_rallies
from services.evaluator.once import task_of
from services.evaluator.play import SHIPPED_POLICY, policy_folder

log = logging.getLogger(__name__)

PROG: Final = "python -m services.evaluator pictures"
SIZE: Final = (1280, 720)  # [pixels]
STRIP_SIZE: Final = (312, 240)  # [pixels] of each part


class PicturesConfig(BaseModel):
    """Draw stills of a policy's best rally among the first fixed ones."""

    model_config = ConfigDict(frozen=True, extra="forbid", populate_by_name=True)

    policy: str = Field(
        "", description=f"policy folder; empty: {SHIPPED_POLICY} if it is there, else the latest run's best"
    )
    out: str = Field("docs/pictures", description="folder to write rally.png and strip.png into")
    rallies: int = Field(40, ge=1, le=1000, description="rallies to choose from")
    launch: PresetName = Field("paper", description="launch preset")
    noise: Literal["off", "standard", "hard"] = Field("standard", description="noise profile")
    seed: int = Field(20260, ge=0, lt=2**63, description="of the rallies")
    camera: Literal["side", "behind", "target", "follow"] = Field("side", description="where it is seen from")
    log_level: Literal["debug", "info", "warning", "error"] = Field(
        "info", description="least severe lines logged"
    )


def main(argv: Sequence[str], stop: Event) -> int:
    """Draw the pictures; return the exit status."""
    config = load(PicturesConfig, argv, prog=PROG, section="pictures")
    set_up_logging(config.log_level, "evaluator")
    policy = load_policy(policy_folder(config.policy))
    env = task_of(policy.contract, EnvConfig(), config.noise, rounds=1)
    rallies = evaluation_rallies(config.rallies, config.launch, config.noise, config.seed, env.flight)
    rally = showpiece(record(policy.act, rallies, env))
    for name, picture in (
        ("rally.png", rally_picture(rally, config.camera, *SIZE)),
        ("strip.png", rally_strip(rally, *STRIP_SIZE)),
    ):
        path = Path(config.out) / name
        save_png(path, picture)
        log.info("drawn file=%s bytes=%d outcome=%s", path, path.stat().st_size, rally.outcome.name.lower())
    return DONE
