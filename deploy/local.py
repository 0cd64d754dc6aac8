"""`python -m deploy.local`, and `topspin train`: a whole run on this machine."""

# ruff: noqa: PLC0415 - what a run needs is imported after its flags are read: --help answers at once

import os
import sys
from collections.abc import Sequence
from threading import Event
from typing import Final

from common.service.process import run_service
from deploy.config import settings

PROG: Final = "python -m deploy.local"


def main(argv: Sequence[str], stop: Event, prog: str = PROG) -> int:
    """Run from the command line; return the exit status."""
    config = settings(argv, prog)
    from common.service.log import set_up_logging
    from deploy.prepare import prepared
    from deploy.run import run_prepared

    set_up_logging("info", "deploy")
    with prepared(config) as run:
        return run_prepared(run, stop, prog)


if __name__ == "__main__":
    os.environ.setdefault("PYTHONUNBUFFERED", "1")
    sys.exit(run_service(PROG, lambda stop: main(sys.argv[1:], stop)))
