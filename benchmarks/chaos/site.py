"""The run under test, and the hosts, links and routers around it.

The run is `python -m deploy.local` with its folder on a file system of its own. Three more actors are outside of it,
as on other hosts: ``far`` in a network namespace, ``slow`` behind a wire that can be made slow, ``routed`` behind a
router.
"""

import os
import shutil
import signal
import struct
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

import psutil

from benchmarks.chaos.slow_wire import SlowWire
from benchmarks.chaos.tail import Tail
from benchmarks.hosts import ip, system
from common.errors import ReportedError
from deploy.prepare import free_port

RUN: Final = "chaos"
ROOT: Final = Path(__file__).parents[2]
CLOCK: Final = Path(__file__).with_name("clock")
WATCHDOG_S: Final = 10.0
CHECKPOINT_S: Final = 3.0
MAX_LAG: Final = 2
DISK_MIB: Final = 64
NETWORK: Final = ("--network.units", "32,16")
SMALL: Final = (
    *NETWORK,
    *("--actor.envs", "16", "--actor.horizon", "16"),
    *("--learner.ppo.minibatch", "256", "--learner.ppo.refit-frames", "1"),
    *("--learner.curriculum.stage-1", "150000", "--learner.curriculum.stage-2", "150000"),
    *("--learner.curriculum.stage-3", str(10**12)),
    *("--evaluator.rallies", "20", "--evaluator.envs", "10", "--evaluator.interval-s", "2"),
)
FAR_LINK: Final = f"10.213.{os.getpid() % 256}"  # begin of the addresses of the far host's cable


@dataclass(slots=True)
class Outsider:
    """An actor outside of the run's supervisor."""

    command: list[str]
    process: subprocess.Popen[bytes]
    restarts: int = 0


@dataclass(slots=True)
class Site:
    """Everything that runs.

    Args:
        folder: For all files.
    """

    folder: Path
    skipped: dict[str, str] = field(default_factory=dict)  # kinds of fault that can't be made here, and why
    outsiders: dict[str, Outsider] = field(default_factory=dict)
    endpoint: str = ""
    routed: str = ""  # endpoint of the router
    wire: SlowWire | None = None
    router: subprocess.Popen[bytes] | None = None
    _namespace: str = ""
    _deploy: subprocess.Popen[bytes] | None = None
    _has_disk: bool = False
    _tails: dict[str, Tail] = field(default_factory=dict)

    @property
    def work(self) -> Path:
        """The working folder of the run, on its own file system where that is allowed."""
        return self.folder / "work"

    @property
    def run(self) -> Path:
        """The run folder."""
        return self.work / "runs" / RUN

    @property
    def history(self) -> Path:
        """The histories: not on the disk that gets full."""
        return self.folder / "history"

    @property
    def cable(self) -> str:
        """The near end of the far host's cable."""
        return f"{self._namespace}a"

    @property
    def learner_log(self) -> Path:
        """The log of all lives of the learner."""
        return self.run / "logs" / "learner-0.log"

    # ---- building

    def build(self, seed: int) -> None:
        """Start everything; ends when the run has trained something."""
        for path in (self.work, self.history):
            path.mkdir(parents=True)
        self.set_clock(0.0)
        self._mount()
        host = self._join_far_host()
        port, slow_port, router_port = free_port(), free_port(), free_port()
        self.endpoint, self.routed = f"tcp/{host}:{port}", f"tcp/127.0.0.1:{router_port}"
        flags = [
            *("--run", RUN, "--actors", "2", "--panel", "off", "--endpoint", self.endpoint),
            *("--seed", str(seed), "--watchdog-s", f"{WATCHDOG_S:g}"),
            *("--learner.checkpoint-interval-s", f"{CHECKPOINT_S:g}", "--learner.intake.max-lag", str(MAX_LAG)),
            *("--actor.history", str(self.history), "--learner.history", str(self.history)),
            *SMALL,
        ]  # fmt: skip
        self._deploy = self.start("deploy", [sys.executable, "-m", "deploy.local", *flags])
        self.wait_for(lambda: self.last_epoch() > 0, 90.0, "the first epoch")
        self.wire = SlowWire(slow_port, host, port)
        self.start_router()
        places = {"slow": f"tcp/127.0.0.1:{slow_port}", "routed": self.routed}
        if self._namespace:
            places["far"] = self.endpoint
        for index, (name, endpoint) in enumerate(places.items(), start=2):
            inside = ["ip", "netns", "exec", self._namespace] if name == "far" else []
            command = [*inside, *self.actor(name, index, endpoint)]
            self.outsiders[name] = Outsider(command, self.start(name, command))
        self.wait_for(
            lambda: all(self.has_played(name) for name in self.outsiders), 90.0, "the outside actors"
        )

    def actor(self, name: str, index: int, endpoint: str, *more: str) -> list[str]:
        """Return the command of an actor outside of the run's supervisor. It ends when this process ends."""
        config = str(self.run / "config.toml")
        flags = ["--config", config, "--id", name, "--index", str(index), "--endpoint", endpoint, *more]
        return [sys.executable, "-m", "deploy.child", "services.actor", *flags]

    def start(self, name: str, command: Sequence[str]) -> subprocess.Popen[bytes]:
        """Start a process whose output goes to FOLDER/NAME.log."""
        environment = os.environ | {
            "PYTHONPATH": f"{CLOCK}{os.pathsep}{ROOT}",
            "CHAOS_CLOCK": str(self._clock_file),
            "OMP_NUM_THREADS": "1",
            "PYTHONUNBUFFERED": "1",
        }
        with (self.folder / f"{name}.log").open("ab") as log:
            return subprocess.Popen(
                command,
                cwd=self.work,
                stdin=subprocess.PIPE,
                stdout=log,
                stderr=subprocess.STDOUT,
                env=environment,
                start_new_session=True,
            )

    def start_router(self) -> None:
        """Start the router between ``routed`` and the hub."""
        flags = ["--endpoint", self.routed, "--peers", self.endpoint, "--metrics-port", "0"]
        self.router = self.start("router", [sys.executable, "-m", "deploy.child", "deploy.router", *flags])

    def peer(self, kind: str) -> list[str]:
        """Return the command of a peer of `benchmarks.chaos.peers`."""
        return [sys.executable, "-m", "benchmarks.chaos.peers", kind, RUN, self.endpoint]

    def keep_up(self) -> None:
        """Start outside actors again that have ended, and say so if the run itself has."""
        if self._deploy is not None and self._deploy.poll() is not None:
            log = (self.folder / "deploy.log").read_text(errors="replace").strip().splitlines()
            raise ReportedError(f"the run ended: {log[-1] if log else 'without a word'}")
        for name, outsider in self.outsiders.items():
            if outsider.process.poll() is not None:
                _close_pipe(outsider.process)
                outsider.process = self.start(name, outsider.command)
                outsider.restarts += 1

    def wait_for(self, condition: Callable[[], bool], timeout_s: float, what: str) -> None:
        """Wait until ``condition()`` is true."""
        deadline = time.monotonic() + timeout_s
        while not condition():
            self.keep_up()
            if time.monotonic() > deadline:
                raise ReportedError(f"waited {timeout_s:.0f} s for {what}: see {self.folder}")
            time.sleep(0.1)

    # ---- looking

    def last_epoch(self) -> float:
        """Return when the newest epoch was trained [s], in any life of the learner; 0: none yet."""
        return max(
            (event["t"] for event in self._events("learner-0") if event["event"] == "trained"), default=0.0
        )

    def has_played(self, actor: str) -> bool:
        """Return whether an actor has played in any of its lives."""
        return any(event["event"] == "played" for event in self._events(f"actor-{actor}"))

    def process(self, role: str, id_: str = "0") -> psutil.Process | None:
        """Return a process of the run, or None while it is away."""
        for child in self._children():
            if f"{role}-{id_}" == self._name(child):
                return child
        return None

    def _children(self) -> list[psutil.Process]:
        if self._deploy is None:
            return []
        with suppress(psutil.NoSuchProcess):
            return list(psutil.Process(self._deploy.pid).children())
        return []

    def _name(self, process: psutil.Process) -> str:
        """Return a process's name: from its flags, or, for a spare actor that took a place, from its history."""
        with suppress(psutil.NoSuchProcess):
            flags = process.cmdline()
            if "--id" in flags:
                role = next(flag for flag in flags if flag.startswith("services.")).removeprefix("services.")
                return f"{role}-{flags[flags.index('--id') + 1]}"
            for file in self.history.glob("actor-*.jsonl"):
                if any(
                    e["event"] == "start" and e["process"] == process.pid for e in self._events(file.stem)
                ):
                    return file.stem
        return ""

    def _events(self, name: str) -> list[dict[str, Any]]:
        """Return the events of a history so far; only what is new is read."""
        tail = self._tails.setdefault(name, Tail(self.history / f"{name}.jsonl"))
        return tail.events()

    # ---- what faults change

    @property
    def _clock_file(self) -> Path:
        return self.folder / "clock"

    def set_clock(self, offset_s: float) -> None:
        """Let the wall clock of every process differ from the true one by ``offset_s`` [s]."""
        with self._clock_file.open("r+b" if self._clock_file.exists() else "wb") as file:
            file.write(struct.pack("d", offset_s))

    def fill_disk(self) -> None:
        """Leave no space in the run's file system."""
        with (self.work / "ballast").open("wb") as file, suppress(OSError):
            while True:
                os.write(file.fileno(), bytes(65_536))

    def free_disk(self) -> None:
        """Give the space back."""
        (self.work / "ballast").unlink(missing_ok=True)

    def set_cable(self, is_in: bool) -> None:
        """Take the far host's cable out, or put it in."""
        ip("link", "set", self.cable, "up" if is_in else "down")

    # ---- the end

    def end(self) -> None:
        """Stop the outside actors, then the run, as a user would."""
        for outsider in self.outsiders.values():
            outsider.process.terminate()
        for outsider in self.outsiders.values():
            with suppress(subprocess.TimeoutExpired):
                outsider.process.wait(15.0)
        if self._deploy is not None and self._deploy.poll() is None:
            self._deploy.send_signal(signal.SIGINT)
            self._deploy.wait(90.0)

    def tear_down(self) -> None:
        """End whatever is left, and give back what the machine lent."""
        for process in (*(o.process for o in self.outsiders.values()), self._deploy, self.router):
            if process is not None:
                with suppress(ProcessLookupError):
                    process.kill()
                process.wait()
                _close_pipe(process)
        if self.wire is not None:
            self.wire.close()
        if self._namespace:
            with suppress(ReportedError):
                ip("link", "del", self.cable)
            ip("netns", "del", self._namespace)
        if self._has_disk:
            shutil.copytree(self.run / "logs", self.folder / "logs", dirs_exist_ok=True)
            subprocess.run(["umount", "--lazy", str(self.work)], check=False)

    # ---- privileges

    def _mount(self) -> None:
        try:
            system("mount", "-t", "tmpfs", "-o", f"size={DISK_MIB}m", "topspin-chaos", str(self.work))
            self._has_disk = True
        except ReportedError as error:
            self.skipped["disk_full"] = str(error)

    def _join_far_host(self) -> str:
        """Make a network namespace with a cable to it; return the address that the hub listens at."""
        name = f"chaos{os.getpid() % 100_000}"
        try:
            ip("netns", "add", name)
        except ReportedError as error:
            self.skipped["link_cut"] = self.skipped["pause_remote"] = str(error)
            return "127.0.0.1"
        self._namespace = name
        inside = ("netns", "exec", name, "ip")
        ip("link", "add", self.cable, "type", "veth", "peer", "name", f"{name}b")
        ip("link", "set", f"{name}b", "netns", name)
        ip("addr", "add", f"{FAR_LINK}.1/24", "dev", self.cable)
        ip("link", "set", self.cable, "up")
        ip(*inside, "addr", "add", f"{FAR_LINK}.2/24", "dev", f"{name}b")
        ip(*inside, "link", "set", f"{name}b", "up")
        ip(*inside, "link", "set", "lo", "up")
        return f"{FAR_LINK}.1"


def _close_pipe(process: subprocess.Popen[bytes]) -> None:
    if process.stdin is not None:
        process.stdin.close()
