"""`topspin pictures`: stills of a policy's best rally, for the README."""

# ruff: noqa: PLC0415 - what a command runs on is imported after its flags are read: --help answers at once

import logging
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from threading import Event
from typing import ClassVar, Final, Literal

from pydantic import Field

from common.evaluation.config import RalliesConfig
from common.service.config import load
from common.service.log import set_up_logging
from common.service.process import DONE
from common.service.settings import LogLevel
from topspin.render.config import Camera

log = logging.getLogger(__name__)

PROG: Final = "topspin pictures"
SIZE: Final = (1280, 720)  # [pixels]
STRIP_SIZE: Final = (312, 240)  # [pixels] of each part


class PicturesConfig(RalliesConfig):
    """Draw stills of a policy's best rally among the first fixed ones."""

    often: ClassVar = {
        "What is drawn": ("policy", "out", "camera"),
        "The rallies": ("rallies", "launch", "randomization", "seed"),
    }

    policy: str = Field("default", description="a policy of the box, or a policy folder")
    out: str = Field("docs/pictures", description="folder to write rally.png and strip.png into")
    rallies: int = Field(40, ge=1, le=1000, description="rallies to choose from")
    rounds: Literal[1] = Field(1, description="a still is of one ball, which the robot awaits at home")
    camera: Camera = Field("side", description="place of the camera")
    log_level: LogLevel = Field("info", description="least severe lines logged")


def main(argv: Sequence[str], stop: Event) -> int:
    """Draw the pictures; return the exit status."""
    config = load(PicturesConfig, argv, prog=PROG, section="pictures")
    set_up_logging(config.log_level, "pictures")
    from common.evaluation.evaluate import check
    from common.evaluation.match import evaluation_rallies, match_task
    from common.evaluation.rally_recorder import record_rallies
    from common.policy.box import policy_folder
    from common.policy.folder import load_policy
    from topspin.render.stills import rally_picture, rally_strip, save_png, showpiece

    policy = load_policy(policy_folder(config.policy))
    task = match_task(policy.contract, config, config.expected_spin)
    rallies = evaluation_rallies(config.rallies, task, config.seed)
    rally = showpiece(record_rallies(policy.act, rallies, task, partial(check, stop)))
    for name, picture in (
        ("rally.png", rally_picture(rally, config.camera, *SIZE)),
        ("strip.png", rally_strip(rally, *STRIP_SIZE)),
    ):
        path = Path(config.out) / name
        save_png(path, picture)
        log.info("drawn file=%s bytes=%d outcome=%s", path, path.stat().st_size, rally.outcome.name.lower())
    return DONE
