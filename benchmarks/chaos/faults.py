"""How each kind of fault is made, and how it is lifted."""

import os
import random
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from typing import Final

import psutil

from benchmarks.chaos.schedule import Fault
from benchmarks.chaos.site import RUN, SMALL, Site

HUNG_S: Final = 60.0  # longest wait for the watchdog
BACK_S: Final = 60.0  # longest wait for a process to be there

Lift = Callable[[], None]


def _nothing() -> None:
    """Lift a fault that is over at once."""


@dataclass(frozen=True, slots=True)
class Made:
    """A fault that was made.

    Args:
        lift: Undoes it.
        ended: The service whose life it ended, as its history is called, or "".
    """

    lift: Lift = _nothing
    ended: str = ""


def make(site: Site, fault: Fault) -> Made:
    """Make a fault; return how it is lifted."""
    return MAKERS[fault.kind.name](site, fault)


def _found(site: Site, role: str, id_: str = "0") -> psutil.Process:
    found: list[psutil.Process] = []

    def look() -> bool:
        process = site.process(role, id_)
        if process is not None:
            found.append(process)
        return process is not None

    site.wait_for(look, BACK_S, f"{role}-{id_} to be back")
    return found[0]


def _one_actor(fault: Fault) -> str:
    return str(int(fault.dice * 2))


def _kill(role: str) -> Callable[[Site, Fault], Made]:
    def made(site: Site, fault: Fault) -> Made:
        id_ = _one_actor(fault) if role == "actor" else "0"
        _found(site, role, id_).kill()
        return Made(ended=f"{role}-{id_}")

    return made


def _stop(role: str) -> Callable[[Site, Fault], Made]:
    """Stop a process: the watchdog ends it."""

    def made(site: Site, fault: Fault) -> Made:
        id_ = _one_actor(fault) if role == "actor" else "0"
        process = _found(site, role, id_)
        process.suspend()
        site.wait_for(lambda: not _is_there(process), HUNG_S, f"the watchdog to end {role}-{id_}")
        return Made(ended=f"{role}-{id_}")

    return made


def _is_there(process: psutil.Process) -> bool:
    with suppress(psutil.NoSuchProcess):
        return bool(process.is_running() and process.status() != psutil.STATUS_ZOMBIE)
    return False


def _pause_remote(site: Site, fault: Fault) -> Made:
    process = site.outsiders["far"].process
    process.send_signal(signal.SIGSTOP)
    return Made(lambda: process.send_signal(signal.SIGCONT))


def _disk_full(site: Site, fault: Fault) -> Made:
    site.fill_disk()
    return Made(site.free_disk)


def _damaged_checkpoint(site: Site, fault: Fault) -> Made:
    learner = _found(site, "learner")
    learner.suspend()  # it must not write another one meanwhile
    newest = max((site.run / "checkpoints").glob("*.safetensors"))
    dice = random.Random(fault.dice)
    with newest.open("r+b") as file:
        for _ in range(16):
            file.seek(dice.randrange(newest.stat().st_size))
            file.write(dice.randbytes(4))
    learner.kill()
    return Made(ended="learner-0")


def _link_cut(site: Site, fault: Fault) -> Made:
    site.set_cable(False)
    return Made(lambda: site.set_cable(True))


def _slow_link(site: Site, fault: Fault) -> Made:
    wire = site.wire
    assert wire is not None

    def fast() -> None:
        wire.is_slow = False

    wire.is_slow = True
    return Made(fast)


def _router_kill(site: Site, fault: Fault) -> Made:
    router = site.router
    assert router is not None
    router.kill()
    router.wait()
    return Made(site.start_router)


def _clock_jump(site: Site, fault: Fault) -> Made:
    site.set_clock((2.0 * fault.dice - 1.0) * 7200.0)
    return Made()


def _peer(kind: str, command: Callable[[Site], list[str]]) -> Callable[[Site, Fault], Made]:
    """Start a bad peer, which is ended when the fault is lifted."""

    def made(site: Site, fault: Fault) -> Made:
        process = site.start(kind, command(site))

        def end() -> None:
            with suppress(ProcessLookupError):
                os.killpg(process.pid, signal.SIGKILL)
            process.wait()
            if process.stdin is not None:
                process.stdin.close()

        # a peer counts as a fault only once it has begun
        deadline = time.monotonic() + 20.0
        while process.poll() is None and time.monotonic() < deadline and _threads(process) < 2:
            time.sleep(0.1)
        return Made(end)

    return made


def _threads(process: subprocess.Popen[bytes]) -> int:
    """Return how many threads a process has: more than one once Zenoh runs."""
    with suppress(psutil.NoSuchProcess):
        return int(psutil.Process(process.pid).num_threads())
    return 0


def _wrong_actor(site: Site) -> list[str]:
    return site.actor("wrong", 0, site.endpoint, "--network.units", "16,16", "--history", "")


def _second_learner(site: Site) -> list[str]:
    flags = [flag.replace("--learner.", "--") for flag in SMALL]
    kept: list[str] = []
    for name, value in zip(flags[::2], flags[1::2], strict=True):
        if not name.startswith(("--actor.", "--evaluator.")):
            kept += [name, value]
    more = ["--run", RUN, "--mode", "client", "--endpoint", site.endpoint]
    folder = str(site.folder / f"second-{time.monotonic_ns()}")
    return [sys.executable, "-m", "deploy.child", "services.learner", *more, "--folder", folder, *kept]


MAKERS: Final[Mapping[str, Callable[[Site, Fault], Made]]] = {
    "kill_actor": _kill("actor"),
    "kill_generator": _kill("generator"),
    "kill_evaluator": _kill("evaluator"),
    "kill_learner": _kill("learner"),
    "stop_actor": _stop("actor"),
    "stop_generator": _stop("generator"),
    "stop_evaluator": _stop("evaluator"),
    "stop_learner": _stop("learner"),
    "pause_remote": _pause_remote,
    "disk_full": _disk_full,
    "damaged_checkpoint": _damaged_checkpoint,
    "link_cut": _link_cut,
    "slow_link": _slow_link,
    "router_kill": _router_kill,
    "wrong_contract": _peer("wrong", _wrong_actor),
    "second_learner": _peer("second", _second_learner),
    "clock_jump": _clock_jump,
    "hung_reader": _peer("hung", lambda site: site.peer("hung_reader")),
    "garbage": _peer("garbage", lambda site: site.peer("garbage")),
}
