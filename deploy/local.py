"""`python -m deploy.local`: a whole run on this machine; spawns every process and watches them."""

import json
import logging
import os
import socket
import subprocess
import sys
import time
from datetime import datetime
from pathlib import Path
from threading import Event
from typing import Any

import tomli_w
from rich.console import Console
from rich.live import Live

from common.comms.codec import DecodeError, decode
from common.comms.keys import Keys
from common.comms.messages import Status
from common.comms.transport import Transport
from common.comms.zenoh_config import ZenohConfig
from common.comms.zenoh_transport import open_zenoh
from common.config import ConfigError, load
from common.log import set_up_logging
from common.process import DONE, FAILED, run_service
from common.run_folder import RunFolder
from deploy.config import DeployConfig, service_sections
from deploy.panel import View, clock, render, time_left_s
from deploy.processes import Family, Spec

log = logging.getLogger(__name__)

PROG = "python -m deploy.local"
WATCH_S = 0.25
LINE_INTERVAL_S = 15.0  # between progress lines when there is no terminal
LEARNER_PATIENCE_S = 30.0  # it writes a checkpoint
WORKER_PATIENCE_S = 8.0
ROLES = ("generator", "learner", "actor", "evaluator")


def specs(config: DeployConfig, config_file: Path) -> list[Spec]:
    """Return the processes of a run: the topology, as one function."""

    def service(role: str, index: int, *more: str) -> Spec:
        port = config.metrics_port + ports[role] + index if config.metrics_port else 0
        arguments = (
            f"services.{role}",
            "--config",
            str(config_file),
            "--id",
            str(index),
            "--metrics-port",
            str(port),
        )
        # The learner holds the run's state: its death ends the run, with its exit status, and --resume goes on.
        return Spec(f"{role}-{index}", role, (*arguments, *more), restart=role != "learner")

    ports = {"learner": 0, "evaluator": 1, "generator": 2, "actor": 2 + config.generators}
    family = [service("learner", 0, *(("--resume", "true") if config.resume else ()))]
    family += [service("generator", i, "--index", str(i)) for i in range(config.generators)]
    family += [service("actor", i, "--index", str(i)) for i in range(config.actors)]
    if config.evaluate:
        family.append(service("evaluator", 0))
    return family


def free_endpoint() -> str:
    """Return a free endpoint on the loopback interface."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return f"tcp/127.0.0.1:{probe.getsockname()[1]}"


def prepare(config: DeployConfig) -> tuple[str, RunFolder, Path]:
    """Return name, folder and configuration file of a run, all of it written."""
    run = config.run or datetime.now().strftime("%Y%m%d-%H%M%S")
    folder = RunFolder.of(run)
    if folder.config.exists() and not config.resume:
        raise ConfigError(
            f"run {run!r} exists already in {folder.root}: go on with --resume, or choose another --run"
        )
    if config.resume and not folder.config.exists():
        raise ConfigError(f"run {run!r} can't be resumed: there is no {folder.config}")
    folder.create()
    endpoint = config.endpoint or free_endpoint()
    sections: dict[str, Any] = service_sections(config, run, endpoint, str(folder.root))
    shared = config.model_dump(mode="json", exclude=set(ROLES))
    folder.config.write_text(tomli_w.dumps({"local": shared | {"run": run}} | sections))
    folder.point_latest_here()
    return run, folder, folder.config


def final_line(run: str, folder: RunFolder, config: DeployConfig, learner: Status | None) -> dict[str, Any]:
    """Return the run's last line: where it stands, and the measures of its final policy."""
    gauges = learner.gauges if learner else {}
    counters = learner.counters if learner else {}
    result: dict[str, Any] = {
        "run": run,
        "policy": str(folder.latest_policy),
        "frames": int(counters.get("frames", 0)),
        "stage": int(gauges.get("stage", 0)),
        "seconds": round(gauges.get("seconds", 0.0), 1),
        "ledger": {
            name: int(counters.get(name, 0))
            for name in ("published", "trained", "refused", "dropped", "in_flight", "lost")
        },
    }
    if config.evaluate:
        command = [sys.executable, "-m", "services.evaluator", "--config", str(folder.config)]
        command += [
            "--policy",
            str(folder.latest_policy),
            "--rallies",
            str(config.final_rallies),
            "--json",
            "true",
        ]
        command += ["--launch", "paper", "--noise", "standard"]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        if done.returncode != 0:
            raise RuntimeError(
                f"the final evaluation failed: {(done.stderr or done.stdout).strip().splitlines()[-1:]}"
            )
        measured = json.loads(done.stdout.strip().splitlines()[-1])
        measured.pop("policy", None)
        measured["evaluation_seconds"] = measured.pop("seconds")
        result |= measured
    return result


class Watcher:
    """Follows the heartbeats of a run and shows them, as a panel or as lines.

    Args:
        view: What is shown.
        transport: Connection to the hub.
        family: The processes.
    """

    def __init__(self, view: View, transport: Transport, family: Family) -> None:
        self._view, self._transport, self._family = view, transport, family
        self._statuses = transport.subscribe(Keys(view.run).every_status(), capacity=4096)
        self._next_line = 0.0

    def look(self, now: float) -> None:
        """Take in what has arrived."""
        self._family.watch(now)
        self._view.restarts = {name: child.restarts for name, child in self._family.children.items()}
        for sample in self._statuses.poll():
            try:
                self._view.hear(decode(sample.payload, Status), now)
            except DecodeError as error:
                log.warning("status refused reason=%s", error)

    def line(self, now: float) -> None:
        """Log one line of progress now and then."""
        learner = self._view.statuses.get(("learner", "0"))
        if now < self._next_line or learner is None:
            return
        self._next_line = now + LINE_INTERVAL_S
        g, c = learner.gauges, learner.counters
        measured = self._view.statuses.get(("evaluator", "0"))
        evaluated = measured.gauges if measured else {}
        alive = sum(now - heard < 5.0 for heard in self._view.heard.values())
        log.info(
            "progress stage=%d frames=%d frames_per_s=%.0f catch=%.3f return=%.3f error=%.2f reward=%.1f lag=%.2f "
            "evaluation_catch=%.3f evaluation_return=%.3f alive=%d left=%s",
            g.get("stage", 0),
            c.get("frames", 0),
            g.get("frames_per_s", 0),
            g.get("catch_rate", float("nan")),
            g.get("return_rate", float("nan")),
            g.get("target_error", float("nan")),
            g.get("reward", float("nan")),
            g.get("lag", float("nan")),
            evaluated.get("catch_rate", float("nan")),
            evaluated.get("return_rate", float("nan")),
            alive,
            clock(time_left_s(self._view)),
        )


def run(config: DeployConfig, stop: Event) -> int:
    """Run it all; return the exit status: 0 only if the learner did its work."""
    name, folder, config_file = prepare(config)
    endpoint = load_endpoint(config_file)
    log.info("run=%s folder=%s endpoint=%s actors=%d", name, folder.root, endpoint, config.actors)
    family = Family(specs(config, config_file), folder.logs)
    view = View(name, minutes=config.minutes, frames=config.frames)
    console = Console(stderr=True)
    has_panel = config.panel == "on" or (config.panel == "auto" and console.is_terminal)
    transport: Transport | None = None
    try:
        transport = open_zenoh(ZenohConfig(endpoint=endpoint, connect_timeout_s=60.0), stop)
        watcher = Watcher(view, transport, family)
        with Live(console=console, auto_refresh=False, transient=False, redirect_stderr=has_panel) as live:
            while not stop.is_set() and family.status_of("learner-0") is None:
                now = time.monotonic()
                watcher.look(now)
                if has_panel:
                    live.update(render(view, now), refresh=True)
                else:
                    watcher.line(now)
                transport.wait(WATCH_S)
                time.sleep(0.05)
            watcher.look(time.monotonic())
    finally:
        workers = [n for n in family.children if n != "learner-0"]
        if stop.is_set():  # actors first, so that what they have under way still meets a learner
            family.stop(workers, WORKER_PATIENCE_S)
        family.stop(["learner-0"], LEARNER_PATIENCE_S)
        family.stop(workers, WORKER_PATIENCE_S)
        if transport is not None:
            transport.close()
    status = family.status_of("learner-0")
    if status != 0:
        tail = (folder.logs / "learner-0.log").read_text(errors="replace").strip().splitlines()[-1:]
        log.error("the learner ended with status %s: %s", status, " ".join(tail))
        return FAILED
    sys.stdout.write(json.dumps(final_line(name, folder, config, view.statuses.get(("learner", "0")))) + "\n")
    return DONE


def load_endpoint(config_file: Path) -> str:
    """Return the endpoint that the run's configuration names."""
    import tomllib  # noqa: PLC0415

    found: str = tomllib.loads(config_file.read_text())["learner"]["endpoint"]
    return found


def main(stop: Event) -> int:
    """Run from the command line; return the exit status."""
    config = load(DeployConfig, sys.argv[1:], prog=PROG, section="local")
    set_up_logging("info", "deploy")
    return run(config, stop)


if __name__ == "__main__":
    os.environ.setdefault("PYTHONUNBUFFERED", "1")
    sys.exit(run_service(PROG, main))
