"""`python -m deploy.local`: a whole run on this machine; spawns every process and watches them."""

import json
import logging
import os
import socket
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import closing, contextmanager, nullcontext
from datetime import datetime
from pathlib import Path
from threading import Event
from typing import Any

from rich.console import Console
from rich.live import Live

from common.comms.codec import DecodeError, decode
from common.comms.keys import Keys
from common.comms.messages import Status
from common.comms.transport import Transport, TransportError
from common.comms.zenoh_config import ZenohConfig
from common.comms.zenoh_transport import open_zenoh
from common.config import ConfigError, first_look, load, read_toml, record
from common.errors import ReportedError
from common.log import set_up_logging
from common.policy.weights import load_policy
from common.process import DONE, INTERRUPTED, run_service
from common.run_folder import LATEST, LOCKS, RUNS, RunFolder, whole_rows
from deploy.config import (
    DeployConfig,
    given_elsewhere,
    service_sections,
    shared_again,
    shared_out,
    way_to_hub,
)
from deploy.panel import STALE_S, View, clock, render, time_left_s
from deploy.processes import Family, Spec
from services.learner.budget import ENDING_S, NOTHING_LEFT, Budget

log = logging.getLogger(__name__)

PROG = "python -m deploy.local"
WATCH_S = 0.25
LINE_INTERVAL_S = 15.0  # between progress lines when there is no terminal
LEARNER_PATIENCE_S = 30.0  # it writes a checkpoint
WORKER_PATIENCE_S = 12.0  # an actor finishes its rollout and waits for the last verdicts
LEARNER = "learner-0"
LOG_FILE = "deploy.log"


class RunFailedError(ReportedError):
    """A process that the run can't do without has failed: one line with the last of its log."""


class _Ended(Event):
    """Set when a stop is asked for, or when a run is over before it began."""

    def __init__(self, stop: Event, family: Family) -> None:
        super().__init__()
        self._asked, self._family = stop, family

    def is_set(self) -> bool:
        return self._asked.is_set() or self._family.status_of(LEARNER) is not None


def specs(config: DeployConfig, config_file: Path) -> list[Spec]:
    """Return the processes of a run: the topology, as one function."""

    def service(role: str, index: int, *more: str) -> Spec:
        arguments = ("--config", str(config_file), "--id", str(index), "--metrics-port", str(next(ports)))
        # The learner holds the run's state: its death ends the run, and --resume goes on.
        return Spec(
            f"{role}-{index}", role, (f"services.{role}", *arguments, *more), restart=role != "learner"
        )

    ports = iter(metrics_ports(config))
    # A run that was stopped before its first checkpoint begins anew.
    resumes = config.resume and any((config_file.parent / "checkpoints").glob("*.safetensors"))
    family = [service("learner", 0, *(("--resume",) if resumes else ()))]
    if config.evaluate:
        family.append(service("evaluator", 0))
    family += [service("generator", i, "--index", str(i)) for i in range(config.generators)]
    family += [service("actor", i, "--index", str(i)) for i in range(config.actors)]
    return family


def metrics_ports(config: DeployConfig) -> list[int]:
    """Return the port of each process's /metrics: learner, evaluator, generators, actors; 0 is any free one."""
    count = 1 + config.evaluate + config.generators + config.actors
    return [config.metrics_port + i if config.metrics_port else 0 for i in range(count)]


def free_endpoint() -> str:
    """Return a free endpoint on the loopback interface."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return f"tcp/127.0.0.1:{probe.getsockname()[1]}"


def settings(argv: Sequence[str]) -> DeployConfig:
    """Return the settings of a run; a resumed one has those of its config.toml, but for the flags given now."""
    asked, given = first_look(
        DeployConfig, ("run", "resume"), argv, prog=PROG, section="local", elsewhere=given_elsewhere
    )
    if not asked.resume:
        if asked.run == LATEST:
            raise ConfigError(f"run {LATEST!r} is the name of the newest run; choose another --run")
        return load(DeployConfig, argv, prog=PROG, section="local", elsewhere=given_elsewhere)
    if not asked.run:
        newest = f": the newest run is {os.readlink(RUNS / LATEST)}" if (RUNS / LATEST).is_symlink() else ""
        raise ConfigError(f"--resume needs --run NAME{newest}")
    name = os.readlink(RUNS / LATEST) if asked.run == LATEST else asked.run
    file = RunFolder.of(name).config
    if not file.exists():
        raise ConfigError(f"run {name!r} can't be resumed: there is no {file}")
    if "local" not in read_toml(file):
        raise ConfigError(
            f"run {name!r} was started service by service: {file} has no table [local]; go on with: "
            f"python -m services.learner --run {name} --resume"
        )
    resumed = load(DeployConfig, argv, prog=PROG, section="local", elsewhere=given_elsewhere, recorded=file)
    before = load(DeployConfig, (), prog=PROG, section="local", environ={}, recorded=file)
    return shared_again(resumed, before, given).model_copy(update={"run": name})


@contextmanager
def prepared(config: DeployConfig) -> Iterator[tuple[str, RunFolder, Path]]:
    """Yield name, folder and configuration file of a run, all of it written; nobody else can run it meanwhile.

    A run that goes on with settings that don't fit, and fails before it has trained anything, keeps its own.
    """
    run = config.run or datetime.now().strftime("%Y%m%d-%H%M%S")
    Keys(run)  # refuses a name that can't stand in a key, and so none that can't be a folder's
    folder = RunFolder.of(run)
    for holder in LOCKS:  # one that is alive exists, and has its ports: the lesser news
        folder.check_free_of(holder)
    if folder.config.exists() and not config.resume:
        raise ConfigError(
            f"run {run!r} exists already in {folder.root}: go on with --resume, or choose another --run"
        )
    check_ports(config)
    # A new endpoint each time unless one was asked for: the old one may be taken.
    link = way_to_hub(config, config.endpoint or free_endpoint())
    with folder.held_by("deploy.local"):
        folder.check_free_of("learner")  # one started by hand, or one that an earlier run has left to finish
        before, trained = read_toml(folder.config) if config.resume else {}, last_epoch(folder)
        write(config, run, folder, link.endpoint)
        try:
            yield run, folder, folder.config
        except RunFailedError:
            if before and last_epoch(folder) == trained:
                record(folder.config, before)
            raise


def write(config: DeployConfig, run: str, folder: RunFolder, endpoint: str) -> None:
    """Make a run's folder with the settings of every process.

    What each actor gets is theirs alone: a run that goes on with more of them shares out anew.
    """
    folder.create()
    sections: dict[str, Any] = service_sections(shared_out(config), run, endpoint, str(folder.root))
    local = config.model_dump(mode="json", by_alias=True, exclude={"resume"}) | {"run": run}
    record(folder.config, {"local": local} | sections)
    folder.point_latest_here()


def check_ports(config: DeployConfig) -> None:
    """Raise ConfigError naming the first port of /metrics that is taken: a service would die of it again and again."""
    for port in filter(None, metrics_ports(config)):
        with socket.socket() as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)  # as the server does
            try:
                probe.bind(("127.0.0.1", port))
            except OSError as error:
                raise ConfigError(
                    f"port {port} can't be had: {error.strerror}; --metrics-port {config.metrics_port} needs "
                    f"{len(metrics_ports(config))} free ports from there on"
                ) from None


def outcome(run: str, folder: RunFolder, learner: Status | None) -> dict[str, Any]:
    """Return where a run stands, from what it wrote; the account of its rollouts is the learner's last word."""
    contract = load_policy(folder.latest_policy).contract
    counters = learner.counters if learner else {}
    fates = ("published", "trained", "refused", "dropped", "in_flight", "lost")
    return {
        "run": run,
        "policy": str(folder.latest_policy),
        "frames": contract.frames,
        "stage": contract.stage,
        "seconds": trained_seconds(folder),
        "ledger": {name: int(counters[name]) for name in fates if name in counters},
    }


def last_epoch(folder: RunFolder) -> dict[str, str]:
    """Return the last row of a run's metrics.csv; {} before anything is trained."""
    rows = whole_rows(folder.metrics)
    return rows[-1] if rows else {}


def trained_seconds(folder: RunFolder) -> float:
    """Return the time from the first trained batch to the last, through restarts [s]."""
    return round(float(last_epoch(folder).get("seconds", 0.0)), 1)


def spent(config: DeployConfig, folder: RunFolder) -> str:
    """Return the limit that a run had reached before, such as "10 of 10 minutes", or ""."""
    last = last_epoch(folder)
    if not (config.resume and last):
        return ""
    budget = Budget(config.learner.curriculum.epochs, config.frames, config.minutes)
    return budget.spent(int(last["epoch"]), int(last["frames"]), float(last["seconds"]), ENDING_S)


def final_measures(folder: RunFolder, config: DeployConfig, stop: Event) -> dict[str, Any]:
    """Return the measures of the final policy, played in a process of their own; {} if asked to stop meanwhile."""
    rallies, policy = str(config.final_rallies), str(folder.latest_policy)
    arguments = (
        "services.evaluator",
        "--config",
        str(folder.config),
        "--policy",
        policy,
        "--rallies",
        rallies,
    )
    spec = Spec(
        "evaluation", "evaluator", (*arguments, "--json", "--launch", "paper", "--noise", "standard"), False
    )
    log.info("measuring the final policy rallies=%s", rallies)
    family = Family([spec], folder.logs)
    try:
        while (status := family.status_of(spec.name)) is None and not stop.is_set():
            time.sleep(0.05)
    finally:
        family.stop([spec.name], 0.0)
    if stop.is_set():
        return {}
    if status != DONE:
        raise RunFailedError(
            f"the final evaluation ended with status {status}: {family.last_line(spec.name)}"
        )
    measured: dict[str, Any] = json.loads(family.last_line(spec.name))
    for detail in ("policy", "by", "by_round"):
        measured.pop(detail, None)
    measured["evaluation_seconds"] = measured.pop("seconds")
    return measured


class Watcher:
    """Follows the heartbeats of a run and shows them, as a panel or as lines.

    Args:
        view: What is shown.
        transport: Connection to the hub.
    """

    def __init__(self, view: View, transport: Transport) -> None:
        self._view = view
        self._statuses = transport.subscribe(Keys(view.run).every_status(), capacity=4096)
        self._next_line = 0.0

    def look(self, now: float) -> None:
        """Take in what has arrived."""
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
        alive = sum(now - heard < STALE_S for heard in self._view.heard.values())
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


def watch(
    config: DeployConfig, view: View, transport: Transport, watcher: Watcher, family: Family, stop: Event
) -> None:
    """Keep the processes and show how they do, until the learner ends or ``stop`` is set."""
    console = Console(stderr=True)
    has_panel = config.panel == "on" or (config.panel == "auto" and console.is_terminal)
    log_file = RunFolder.of(view.run).logs / LOG_FILE
    with Live(console=console, auto_refresh=False) if has_panel else nullcontext() as live:
        set_up_logging(
            "info", "deploy", log_file
        )  # to the stderr of now, which a panel has put its own hand on
        while not stop.is_set() and family.status_of(LEARNER) is None:
            now = time.monotonic()
            family.watch(now)
            watcher.look(now)
            view.restarts = {name: child.restarts for name, child in family.children.items()}
            if name := family.hopeless():
                raise RunFailedError(f"{name} can't use its settings: {family.last_line(name)}")
            if live is not None:
                live.update(render(view, now), refresh=True)
            else:
                watcher.line(now)
            transport.wait(WATCH_S)
            stop.wait(0.05)  # heartbeats of many services must not keep us busy
    set_up_logging("info", "deploy", log_file)


def end(family: Family, stop: Event) -> None:
    """End all processes; a run that was interrupted lets its actors meet a learner with what they have under way."""
    workers = [name for name in family.children if name != LEARNER]
    if stop.is_set():
        family.stop(workers, WORKER_PATIENCE_S)
    family.stop([LEARNER], LEARNER_PATIENCE_S)
    family.stop(workers, WORKER_PATIENCE_S)


def run(config: DeployConfig, stop: Event) -> int:
    """Run it all; return the exit status: 0 only if the learner did its work."""
    with prepared(config) as (name, folder, config_file):
        return run_prepared(config, name, folder, config_file, stop)


def run_prepared(config: DeployConfig, name: str, folder: RunFolder, config_file: Path, stop: Event) -> int:
    """Run what `prepared` gave; return the exit status."""
    set_up_logging("info", "deploy", folder.logs / LOG_FILE)
    endpoint = load_endpoint(config_file)
    log.info("run=%s folder=%s endpoint=%s actors=%d", name, folder.root, endpoint, config.actors)
    if done := spent(config, folder):  # and so the learner ends at once, and its policy is measured
        log.warning(NOTHING_LEFT, done, "learner.")
    view = View(name, minutes=config.minutes, frames=config.frames)
    family = Family(specs(config, config_file), folder.logs)
    try:
        transport = connect(way_to_hub(config, endpoint), stop, family)
        if transport is not None:
            with closing(transport):
                watcher = Watcher(view, transport)
                watch(config, view, transport, watcher, family, stop)
                end(family, stop)
                watcher.look(time.monotonic())  # the learner's last word
    finally:
        end(family, stop)
    status = family.status_of(LEARNER)
    if stop.is_set() and not folder.latest_policy.exists():
        log.warning("stopped before anything was learned; begin with: %s --run %s --resume", PROG, name)
        return INTERRUPTED
    if status != DONE:
        raise RunFailedError(f"the learner ended with status {status}: {family.last_line(LEARNER)}")
    line = outcome(name, folder, view.statuses.get(("learner", "0")))
    if config.evaluate and not stop.is_set():
        line |= final_measures(folder, config, stop)
    sys.stdout.write(json.dumps(line) + "\n")
    if stop.is_set():
        log.warning("stopped before its end; go on with: %s --run %s --resume", PROG, name)
        return INTERRUPTED
    return DONE


def connect(link: ZenohConfig, stop: Event, family: Family) -> Transport | None:
    """Return a connection to the learner, or None if it ended, or a stop was asked for, before it listened."""
    ended = _Ended(stop, family)
    try:
        return open_zenoh(link, ended)
    except TransportError:
        if ended.is_set():
            return None
        raise


def load_endpoint(config_file: Path) -> str:
    """Return the endpoint that the run's configuration names."""
    found: str = read_toml(config_file)["learner"]["endpoint"]
    return found


def main(stop: Event) -> int:
    """Run from the command line; return the exit status."""
    config = settings(sys.argv[1:])
    set_up_logging("info", "deploy")
    return run(config, stop)


if __name__ == "__main__":
    os.environ.setdefault("PYTHONUNBUFFERED", "1")
    sys.exit(run_service(PROG, main))
