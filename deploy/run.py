"""A whole run on this machine: starts every process, watches them, and measures the final policy."""

import json
import logging
import sys
import time
from contextlib import ExitStack, closing
from threading import Event
from typing import Final

from rich.console import Console
from rich.live import Live

from common.comms.messages import Status
from common.comms.roles import name_of
from common.comms.transport import Transport, TransportError
from common.service.log import set_up_logging
from common.service.process import BAD_CONFIG, DONE, INTERRUPTED
from common.service.table import whole_rows
from common.service.whole_file import write_whole
from deploy.history import points_of
from deploy.panel import View, render
from deploy.prepare import PreparedRun, RunFailedError, UnusableSettingsError, open_link
from deploy.scaling import changes, wanted
from deploy.supervisor import Supervisor
from deploy.targets import TargetsFile
from deploy.topology import ROLES
from deploy.topology import role as role_named
from deploy.watchdog import Watchdog
from deploy.watcher import Watcher
from services.learner.budget import NOTHING_LEFT

log = logging.getLogger(__name__)

WATCH_S: Final = 0.25
LEARNER: Final = "learner-0"
LOG_FILE: Final = "deploy.log"


class _Ended(Event):
    """Set when a stop is requested, or when the learner has ended before it listened."""

    def __init__(self, stop: Event, supervisor: Supervisor) -> None:
        super().__init__()
        self._stop, self._supervisor = stop, supervisor

    def is_set(self) -> bool:
        self._supervisor.watch(time.monotonic())
        return self._stop.is_set() or self._supervisor.has_ended(LEARNER)


def shows_panel(wanted: str, console: Console) -> bool:
    """Return whether the panel can be shown, and is wanted; lines of progress are logged where it is not."""
    if console.is_dumb_terminal:  # it can't move its cursor
        return False
    # The person's environment may call a file a terminal, or a terminal a file
    is_terminal = console.file.isatty() and console.is_terminal and console.is_interactive
    return wanted == "on" or (wanted == "auto" and is_terminal)


def watch(
    run: PreparedRun, view: View, transport: Transport, watcher: Watcher, supervisor: Supervisor, stop: Event
) -> None:
    """Keep the processes alive and show their state, until the learner ends or ``stop`` is set."""
    console = Console(stderr=True)
    has_panel = shows_panel(run.config.panel, console)
    log_file = run.folder.logs / LOG_FILE
    with ExitStack() as stack:
        live = stack.enter_context(Live(console=console, auto_refresh=False)) if has_panel else None
        # a panel has replaced stderr: log to the new one
        set_up_logging("info", "deploy", log_file)
        watchdog = Watchdog(LEARNER, run.config.watchdog_s)
        targets = stack.enter_context(
            closing(TargetsFile(run.folder.targets, run.name, run.config.metrics_host))
        )
        # The supervisor has a group of learners as one child
        followers = [name_of("learner", str(rank)) for rank in range(1, run.config.learners)]
        while not stop.is_set() and not supervisor.has_ended(LEARNER):
            now = time.monotonic()
            supervisor.watch(now)
            scale(run, view, supervisor)
            watcher.look(now)
            targets.update(view.statuses.values(), [*supervisor.children, *followers])
            end_hung(watchdog, supervisor, view, now)
            view.restarts = {name: child.restarts for name, child in supervisor.children.items()}
            if name := supervisor.has_bad_config():
                raise UnusableSettingsError(f"{name} can't use its settings: {supervisor.last_line(name)}")
            if live is not None:
                live.update(render(view, now), refresh=True)
            else:
                watcher.line(now)
            transport.wait(WATCH_S)
            stop.wait(0.05)  # heartbeats of many services must not keep this loop busy
    set_up_logging("info", "deploy", log_file)


def scale(run: PreparedRun, view: View, supervisor: Supervisor) -> None:
    """Start and end actors until there are as many as `topspin scale` asks for."""
    for name in supervisor.forget_retired():
        view.forget("actor", name.removeprefix("actor-"))
        log.info("actor has ended name=%s", name)
    actors = wanted(run.folder)
    if actors is None:
        return
    present = {
        int(name.removeprefix("actor-")): child
        for name, child in supervisor.children.items()
        if child.spec.role == "actor"
    }
    more, fewer = changes(present, actors)
    for number in more:
        log.info("one more actor name=actor-%d", number)
        supervisor.add(run.actor(number))
    for number in fewer:
        if present[number].spec.restart:
            log.info("an actor shall end name=actor-%d", number)
        supervisor.retire(f"actor-{number}")


def end_hung(watchdog: Watchdog, supervisor: Supervisor, view: View, now: float) -> None:
    """Kill the processes that hang; the supervisor starts them again."""
    running = [
        (name, child.process.pid, child.started)
        for name, child in supervisor.children.items()
        if child.process.poll() is None
    ]
    heard = {f"{role}-{id_}": when for (role, id_), when in view.heard.items()}
    for name in watchdog.look(running, heard, now):
        log.warning(
            "process hangs name=%s: no heartbeat and no CPU time for %.0f s; killing it",
            name,
            watchdog.limit_s,
        )
        supervisor.kill(name)


def end(supervisor: Supervisor, workers_first: bool) -> None:
    """End all processes. In an interrupted run the workers end first, while the learner still answers."""
    workers = [name for name in supervisor.children if name != LEARNER]
    patience_s = max(role.grace_s for role in ROLES if role.name != "learner")
    if workers_first:
        supervisor.stop(workers, patience_s)
    supervisor.stop([LEARNER], role_named("learner").grace_s)
    supervisor.stop(workers, patience_s)


def run_prepared(run: PreparedRun, stop: Event, prog: str) -> int:
    """Run a prepared run; return the exit status: 0 only if the learner finished."""
    config, folder = run.config, run.folder
    set_up_logging("info", "deploy", folder.logs / LOG_FILE)
    log.info(
        "run=%s folder=%s endpoint=%s actors=%d", run.name, folder.root, run.link.endpoint, config.actors
    )
    if done := run.spent():  # the learner then ends at once, and its policy is measured
        log.warning(NOTHING_LEFT, done, "learner.")
    view = View(
        run.name,
        minutes=config.minutes,
        frames=config.frames,
        folder=str(folder.root),
        metrics_host=config.metrics_host,
        history=points_of(whole_rows(folder.metrics)),
    )
    supervisor = Supervisor(run.specs(), folder.logs)
    try:
        transport = connect(run, stop, supervisor)
        if transport is not None:
            with closing(transport):
                watcher = Watcher(view, transport)
                watch(run, view, transport, watcher, supervisor, stop)
                end(supervisor, stop.is_set())
                watcher.look(time.monotonic())  # the learner's last heartbeat
    finally:
        end(supervisor, stop.is_set())
    return conclude(run, supervisor, view.statuses.get(("learner", "0")), stop, prog)


def conclude(run: PreparedRun, supervisor: Supervisor, learner: Status | None, stop: Event, prog: str) -> int:
    """Measure the final policy, print the run's result and how to go on, and return the exit status."""
    again = f"{prog} --run {run.name} --resume"
    status = supervisor.status_of(LEARNER)
    if stop.is_set() and not run.folder.latest_policy.exists():
        log.warning("stopped before anything was learned; start again with: %s", again)
        return INTERRUPTED
    if status != DONE:
        advice = f"; go on with: {again}" if run.newest_checkpoint() else ""
        kind = UnusableSettingsError if status == BAD_CONFIG else RunFailedError
        raise kind(f"the learner ended with status {status}: {supervisor.last_line(LEARNER)}{advice}")
    # Torch is imported now: at the start of a run it would take the cores from the first batch
    from deploy.summary import final_measures, next_commands, run_summary, table  # noqa: PLC0415

    line = run_summary(run, learner)
    if run.config.evaluate and not stop.is_set():
        line |= final_measures(run, stop)
    text = json.dumps(line) + "\n"
    write_whole(run.folder.final, text)
    sys.stdout.write(text if run.config.json_line else table(line, run.folder) + next_commands(run, prog))
    if stop.is_set():
        log.warning("stopped before its end; go on with: %s", again)
        return INTERRUPTED
    return DONE


def connect(run: PreparedRun, stop: Event, supervisor: Supervisor) -> Transport | None:
    """Return a connection to the learner, or None if it ended, or a stop was requested, before it listened."""
    ended = _Ended(stop, supervisor)
    try:
        return open_link(run, ended)
    except TransportError:
        if ended.is_set():
            return None
        raise
