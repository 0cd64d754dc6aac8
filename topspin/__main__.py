"""The `topspin` command: one program with a subcommand for each thing that people do."""

import difflib
import os
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from threading import Event
from typing import Final

from common.errors import ConfigError, HelpRequest
from common.service.process import run_service

# A command imports what it needs when it runs: `topspin --help` answers at once.
# ruff: noqa: PLC0415

Main = Callable[[Sequence[str], Event], int]


def _train(argv: Sequence[str], stop: Event) -> int:
    from deploy.local import main

    os.environ.setdefault("PYTHONUNBUFFERED", "1")
    return main(argv, stop, prog="topspin train")


def _scale(argv: Sequence[str], stop: Event) -> int:
    from topspin.scale import main

    return main(argv, stop)


def _play(argv: Sequence[str], stop: Event) -> int:
    from topspin.play import main

    return main(argv, stop)


def _view(argv: Sequence[str], stop: Event) -> int:
    from topspin.view.command import main

    return main(argv, stop)


def _evaluate(argv: Sequence[str], stop: Event) -> int:
    from topspin.evaluate import main

    return main(argv, stop)


def _report(argv: Sequence[str], stop: Event) -> int:
    from topspin.report.command import main

    return main(argv, stop)


def _real2sim(argv: Sequence[str], stop: Event) -> int:
    from topspin.real2sim.command import main

    return main(argv, stop)


def _pictures(argv: Sequence[str], stop: Event) -> int:
    from topspin.pictures import main

    return main(argv, stop)


def _certs(argv: Sequence[str], stop: Event) -> int:
    from topspin.certs import main

    return main(argv, stop)


def _release(argv: Sequence[str], stop: Event) -> int:
    from topspin.release import main

    return main(argv, stop)


def _export(argv: Sequence[str], stop: Event) -> int:
    from topspin.export.command import main

    return main(argv, stop)


@dataclass(frozen=True, slots=True)
class Command:
    """A subcommand."""

    main: Main
    purpose: str


COMMANDS: Final[dict[str, Command]] = {
    "train": Command(_train, "train a policy: a whole run on this machine"),
    "scale": Command(_scale, "give a running training more or fewer actors"),
    "play": Command(_play, "measure a policy and film it"),
    "evaluate": Command(_evaluate, "measure a policy on fixed rallies"),
    "view": Command(_view, "show a policy at play: a live page in 3-D in a browser"),
    "report": Command(_report, "compare runs: tables and plots beside the paper's"),
    "real2sim": Command(_real2sim, "play recordings of real balls"),
    "pictures": Command(_pictures, "draw stills of a policy's best rally"),
    "export": Command(_export, "write a policy as a folder for a robot: ONNX, contract, wheel"),
    "certs": Command(_certs, "make certificates, with which a run is encrypted and roles hold"),
    "release": Command(_release, "put a policy into the box, with its measures"),
}


def usage() -> str:
    """Return the text of `topspin --help`."""
    width = max(map(len, COMMANDS))
    lines = [
        "usage: topspin COMMAND [--NAME VALUE ...]",
        "",
        "Train a table-tennis robot to return spinning balls, and see how good it is.",
        "",
        "Commands:",
        *(f"  {name:{width}}  {command.purpose}" for name, command in COMMANDS.items()),
        "",
        "topspin COMMAND --help    the settings that people change",
        "topspin --version         the version",
        "",
        "Services of a run, one process each: python -m services.{learner,actor,",
        "generator,evaluator} --help",
    ]
    return "\n".join(lines) + "\n"


def dispatch(argv: Sequence[str], stop: Event) -> int:
    """Run a subcommand; return the exit status."""
    name = argv[0] if argv else "--help"
    if name in ("-h", "--help", "help"):
        raise HelpRequest(usage())
    if name == "--version":
        from importlib.metadata import version

        raise HelpRequest(f"topspin {version('topspin')}\n")
    if name not in COMMANDS:
        nearest = difflib.get_close_matches(name, COMMANDS, n=1, cutoff=0.5)
        hint = f"did you mean {nearest[0]!r}?" if nearest else f"allowed: {', '.join(COMMANDS)}"
        raise ConfigError(f"unknown command {name!r}; {hint}")
    return COMMANDS[name].main(argv[1:], stop)


def main() -> int:
    """Run the command line; return the exit status."""
    argv = sys.argv[1:]
    prog = f"topspin {argv[0]}" if argv and argv[0] in COMMANDS else "topspin"
    return run_service(prog, lambda stop: dispatch(argv, stop))


if __name__ == "__main__":
    sys.exit(main())
