"""The command line: `python -m services.evaluator report RUN... [--NAME VALUE ...]`."""

import json
import logging
import sys
from collections.abc import Sequence
from pathlib import Path
from threading import Event
from types import ModuleType

from common.config import ConfigError, load
from common.config_help import settings_of
from common.errors import ReportedError
from common.log import set_up_logging
from common.process import DONE
from services.evaluator.once import check
from services.evaluator.report.collect import find, read
from services.evaluator.report.config import ReportConfig
from services.evaluator.report.results import results

log = logging.getLogger(__name__)

PROG = "python -m services.evaluator report RUN..."


def settings(argv: Sequence[str]) -> ReportConfig:
    """Return the settings; words that are neither flags nor their values are runs."""
    known, runs, flags = settings_of(ReportConfig), list[str](), list[str]()
    words = list(argv)
    while words:
        word = words.pop(0)
        if not word.startswith("-"):
            runs.append(word)
            continue
        flags.append(word)
        setting = known.get(word.removeprefix("--").replace("-", "_"))
        takes_value = word == "--config" or (setting is not None and not setting.is_switch)
        if takes_value and words:
            flags.append(words.pop(0))
    if runs:
        flags += ["--runs", json.dumps(runs)]
    config = load(ReportConfig, flags, prog=PROG, section="report")
    if not config.runs:
        raise ConfigError("no run to report on; name some: python -m services.evaluator report latest")
    return config


def main(argv: Sequence[str], stop: Event) -> int:
    """Write a report, say where it is, and return the exit status."""
    config = settings(argv)
    set_up_logging("info", "report")
    figures, page = _drawing()  # before hours of play, not after
    page.note(config.note)
    folders = list(dict.fromkeys(find(run).root for run in config.runs))  # each once, whatever it was called
    runs = [read(str(folder), config.policy) for folder in folders]

    found = results(runs, config, lambda: check(stop))
    for line in found.missing:
        log.warning("missing or unequal %s", line)
    out = Path(config.out)
    try:
        out.mkdir(parents=True, exist_ok=True)
        page.write(found, figures.draw(found, out), out)
    except OSError as error:
        raise ReportedError(f"can't write the report to {out}: {error.strerror}") from error
    sys.stdout.write(f"{out / 'report.md'}\n{out / 'report.html'}\n{out / 'results.json'}\n")
    return DONE


def _drawing() -> tuple[ModuleType, ModuleType]:
    """Return what draws and what renders; raises ReportedError where their libraries aren't installed."""
    try:
        from services.evaluator.report import figures, page  # noqa: PLC0415 - an extra: the service goes without
    except ModuleNotFoundError as error:
        raise ReportedError(f"a report needs {error.name}: pip install -e '.[report]'") from None
    return figures, page
