"""The command line: `topspin report RUN... [--NAME VALUE ...]`."""

# ruff: noqa: PLC0415 - what a command runs on is imported after its flags are read: --help answers at once

import json
import logging
import sys
from collections.abc import Sequence
from pathlib import Path
from threading import Event
from types import ModuleType
from typing import Final

from common.errors import ConfigError, ReportedError
from common.service.config import load
from common.service.config_help import settings_of
from common.service.config_sources import BOOLEANS
from common.service.log import set_up_logging
from common.service.process import DONE
from common.service.whole_file import make_writable
from topspin.report.config import ReportConfig

log = logging.getLogger(__name__)

PROG: Final = "topspin report RUN..."


def settings(argv: Sequence[str]) -> ReportConfig:
    """Return the settings; words that are neither flags nor values of flags are runs."""
    known, runs, flags = settings_of(ReportConfig), list[str](), list[str]()
    words = list(argv)
    while words:
        word = words.pop(0)
        if not word.startswith("-"):
            runs.append(word)
            continue
        flags.append(word)
        setting = known.get(word.removeprefix("--").replace("-", "_"))
        is_switch = setting is not None and setting.is_switch
        takes_value = word == "--config" or (setting is not None and not is_switch)
        if words and (takes_value or (is_switch and words[0] in BOOLEANS)):
            flags.append(words.pop(0))
    if runs:
        flags += ["--runs", json.dumps(runs)]
    config = load(ReportConfig, flags, prog=PROG, section="report")
    if not config.runs:
        raise ConfigError("no run to report on; give one, as in: topspin report latest")
    return config


def main(argv: Sequence[str], stop: Event) -> int:
    """Write a report, print its files, and return the exit status."""
    config = settings(argv)
    set_up_logging("info", "report")
    from common.evaluation.evaluate import check
    from topspin.report.collect import find, read
    from topspin.report.results import results

    figures, page = _drawing()  # fails before hours of play, not after
    page.note(config.note)
    folders = list(
        dict.fromkeys(find(run).root for run in config.runs)
    )  # each once, even if it is given under two names
    runs = [read(str(folder), config.policy) for folder in folders]

    out = Path(config.out)
    make_folder(out)
    found = results(runs, config, lambda: check(stop))
    for line in found.missing:
        log.warning("missing or unequal %s", line)
    try:
        page.write_numbers(found, out)  # first: they took hours
        page.write(found, figures.draw(found, out), out)
    except OSError as error:
        raise ReportedError(f"can't write the report to {out}: {error.strerror}") from error
    sys.stdout.write(f"{out / 'report.md'}\n{out / 'report.html'}\n{out / 'results.json'}\n")
    return DONE


def make_folder(out: Path) -> None:
    """Make the folder of a report, before hours of play. Raises ConfigError if nothing can be written there."""
    try:
        make_writable(out)
    except OSError as error:
        raise ConfigError(
            f"out = {str(out)!r}: {error.strerror}; allowed: a folder that can be written"
        ) from None


def _drawing() -> tuple[ModuleType, ModuleType]:
    """Return the modules for plots and page; raises ReportedError where their libraries aren't installed."""
    try:
        from topspin.report import figures, page
    except ModuleNotFoundError as error:
        raise ReportedError(f"a report needs {error.name}: pip install -e '.[report]'") from None
    return figures, page
