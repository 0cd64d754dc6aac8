"""Commands as a user types them, each in its own folder, and their outputs."""

import contextlib
import json
import os
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path

import psutil

ROOT = Path(__file__).parents[2]
TINY = [
    *("--network.units", "32,16"),
    *("--actor.envs", "32", "--actor.horizon", "16"),
    *("--learner.ppo.minibatch", "256", "--learner.ppo.refit-frames", "1"),
    *("--evaluator.rallies", "20", "--evaluator.envs", "10", "--evaluator.interval-s", "1"),
    *("--final-rallies", "40", "--panel", "off", "--json"),
]
DATASET = 2 * 32 * 16  # frames of a dataset of two such actors
STAGES = [
    *("--learner.curriculum.stage-1", str(3 * DATASET), "--learner.curriculum.stage-2", str(2 * DATASET)),
]


@dataclass
class Command:
    """A running command; its outputs go to files."""

    process: subprocess.Popen
    out: Path
    err: Path

    def wait(self, timeout_s):
        """Return status, standard output and standard error."""
        try:
            status = self.process.wait(timeout_s)
        except subprocess.TimeoutExpired:
            raise AssertionError(f"not done within {timeout_s} s: {self.err.read_text()}") from None
        return status, self.out.read_text(), self.err.read_text()


@contextlib.contextmanager
def running(folder, module, *arguments, environ=(), before=None):
    """Yield `python -m module arguments`, run in ``folder``; it is killed if it still runs at the end.

    Args:
        folder: Where.
        module: What.
        arguments: Its flags.
        environ: More variables of its environment.
        before: Called in the new process before the program starts.
    """
    name = f"{module}-{time.monotonic_ns()}"
    out, err = folder / f"{name}.out", folder / f"{name}.err"
    environment = {k: v for k, v in os.environ.items() if not k.startswith("TOPSPIN_")}
    environment |= {"PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"} | dict(environ)
    with out.open("w") as out_file, err.open("w") as err_file:
        process = subprocess.Popen(
            [sys.executable, "-m", module, *map(str, arguments)],
            cwd=folder,
            env=environment,
            stdin=subprocess.DEVNULL,
            stdout=out_file,
            stderr=err_file,
            preexec_fn=before,  # noqa: PLW1509 - tests start processes from one thread
        )
    try:
        yield Command(process, out, err)
    finally:
        if process.poll() is None:
            process.kill()
            process.wait()


def run(folder, module, *arguments, timeout_s=90, **how):
    with running(folder, module, *arguments, **how) as command:
        return command.wait(timeout_s)


def last_json(text):
    return json.loads(text.strip().splitlines()[-1])


def processes_in(folder):
    """Return the Python processes that work in ``folder``, after a wait for those that are ending."""
    deadline = time.monotonic() + 15
    while True:
        found = []
        for process in psutil.process_iter():
            with contextlib.suppress(psutil.Error, OSError):
                if process.status() != psutil.STATUS_ZOMBIE and Path(process.cwd()) == folder:
                    found.append(process)
        if not found or time.monotonic() > deadline:
            return found
        time.sleep(0.1)


def children_of(folder, role):
    """Return the processes of a role that work in ``folder``, by process id."""
    found = {}
    for process in psutil.process_iter():
        with contextlib.suppress(psutil.Error, OSError):
            if Path(process.cwd()) == folder and f"services.{role}" in process.cmdline():
                found[process.pid] = process
    return found
