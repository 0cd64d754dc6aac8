"""`topspin scale`: more or fewer actors for a run that is running on this machine."""

# ruff: noqa: PLC0415 - what a command runs on is imported after its flags are read: --help answers at once

import sys
from collections.abc import Sequence
from threading import Event
from typing import ClassVar, Final

from pydantic import BaseModel, ConfigDict, Field

from common.service.config import load
from common.service.process import DONE
from common.service.settings import MOST_ACTORS

PROG: Final = "topspin scale"


class ScaleConfig(BaseModel):
    """Start or end actors of a running training; those that end first get their last verdicts.

    Each actor plays as many environments as before, and a dataset stays as large, so more actors make it sooner. The
    number holds until the run ends: a run that is resumed has the actors of its settings.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")
    often: ClassVar = {"The run": ("run", "actors")}

    run: str = Field("latest", description="its name; latest: the newest run")
    actors: int = Field(ge=1, le=MOST_ACTORS, description="actors that it shall have")


def main(argv: Sequence[str], stop: Event) -> int:
    """Ask, and return the exit status."""
    del stop  # it takes no time
    config = load(ScaleConfig, argv, prog=PROG, section="scale")
    from common.service.run_folder import RunFolder
    from deploy.scaling import ask

    folder = RunFolder.of(config.run)
    ask(folder, config.actors)
    sys.stdout.write(
        f"run {folder.root.name}: {config.actors} actors from now on; its panel and log show them\n"
    )
    return DONE
