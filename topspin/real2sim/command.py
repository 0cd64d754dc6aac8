"""The command line: `topspin real2sim --data PATH`."""

# ruff: noqa: PLC0415 - what a command runs on is imported after its flags are read: --help answers at once
from collections.abc import Sequence
from threading import Event
from typing import Final

from common.errors import ConfigError
from common.service.config import load
from common.service.log import set_up_logging
from topspin.real2sim.config import Real2SimConfig

PROG: Final = "topspin real2sim"


def main(argv: Sequence[str], stop: Event) -> int:
    """Play, measure, print, and write the requested files; return the exit status."""
    config = load(Real2SimConfig, argv, prog=PROG, section="real2sim")
    set_up_logging(config.log_level, "real2sim")
    if not config.data:
        raise ConfigError(f"no recordings to play; give some with {PROG} --data FILE_OR_FOLDER")
    from topspin.real2sim.play import run

    return run(config, stop)
