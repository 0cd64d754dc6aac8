"""Preparing a run: its settings, its folder, its ports, and the processes that it needs."""

import errno
import itertools
import socket
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, replace
from datetime import datetime
from threading import Event

from pydantic import ValidationError

from common.comms.certificates import checked, missing
from common.comms.keys import Keys
from common.comms.roles import OPERATOR_NAME, name_of
from common.comms.transport import Transport
from common.comms.zenoh_config import ZenohConfig
from common.comms.zenoh_transport import open_zenoh
from common.errors import ConfigError, ReportedError
from common.service.config import save_settings, to_tables
from common.service.config_sources import read_toml
from common.service.endpoint import PORTS_TRIED
from common.service.run_folder import LOCKS, RUNS, RunFolder, newest_run
from common.service.table import whole_rows
from deploy.config import SECTION, DeployConfig
from deploy.supervisor import Spec
from deploy.topology import ROLES, Role
from deploy.topology import role as role_named
from services.learner.budget import ENDING_S, Budget


class RunFailedError(ReportedError):
    """A process that the run needs has failed: one line with the last line of its log."""


class UnusableSettingsError(RunFailedError, ConfigError):
    """It has failed because of its settings."""


@dataclass(frozen=True, slots=True)
class PreparedRun:
    """A run that can start: its folder holds its settings, and this process has locked it."""

    name: str
    config: DeployConfig
    folder: RunFolder
    link: ZenohConfig  # how this process reaches the learner

    def last_epoch(self) -> dict[str, str]:
        """Return the last row of the run's metrics.csv; {} before anything is trained."""
        return last_epoch(self.folder)

    def newest_checkpoint(self) -> str:
        """Return the name of the newest checkpoint, or ""."""
        return newest_checkpoint(self.folder)

    def spent(self) -> str:
        """Return the limit that a resumed run had reached before, such as "10 of 10 minutes", or ""."""
        return self.spent_by(self.last_epoch()) if self.config.resume else ""

    def spent_by(self, last: Mapping[str, str]) -> str:
        """Return the limit that the run reached with its epoch ``last``, a row of metrics.csv, or ""."""
        if not last:
            return ""
        budget = Budget(self.config.learner.curriculum.frames, self.config.frames, self.config.minutes)
        return budget.spent(int(float(last["frames"] or 0)), float(last["seconds"] or 0), ENDING_S)

    def specs(self) -> list[Spec]:
        """Return the processes of the run: its topology, as one function."""
        config = self.config
        file = str(self.folder.config)
        ports = iter(metrics_ports(config))

        def service(role: Role, index: int, *more: str) -> Spec:
            arguments = role.arguments(str(index), file, str(next(ports)), *more)
            return Spec(f"{role.name}-{index}", role.name, arguments, restart=True)

        def resumed() -> tuple[str, ...]:
            """Return the flag to go on from the newest checkpoint, if there is one."""
            return ("--resume",) if self.newest_checkpoint() else ()

        # The learner holds the run's state: the run ends when it is done. A run that was stopped before its first
        # checkpoint starts from the beginning.
        learner, *workers = ROLES
        keeper = service(learner, 0, *(resumed() if config.resume else ()))
        if config.learners > 1:
            _module, *flags = keeper.arguments
            group = ("deploy.learners", str(config.learners), str(self.folder.logs))
            keeper = replace(keeper, arguments=(*group, *flags), has_children=True)
        found = [replace(keeper, keeps_run=True, again=resumed, made=self.newest_checkpoint)]
        found += [service(role, i) for role in workers for i in range(role.count(config))]
        return found

    def actor(self, number: int) -> Spec:
        """Return one more actor than the settings have; it serves its metrics at the next free port."""
        port = str(self.config.metrics_port)
        arguments = role_named("actor").arguments(str(number), str(self.folder.config), port)
        return Spec(f"actor-{number}", "actor", arguments, restart=True)


def last_epoch(folder: RunFolder) -> dict[str, str]:
    """Return the last row of a run's metrics.csv; {} before anything is trained."""
    rows = whole_rows(folder.metrics)
    return rows[-1] if rows and {"epoch", "frames", "seconds"} <= rows[-1].keys() else {}


def newest_checkpoint(folder: RunFolder) -> str:
    """Return the name of a run's newest checkpoint, or ""."""
    return max((path.name for path in folder.checkpoints.glob("*.safetensors")), default="")


def metrics_ports(config: DeployConfig) -> list[int]:
    """Return a port of /metrics for each process: learner, evaluator, generators, actors; 0 is any free one.

    They are the first free ones from ``metrics_port`` on. A service whose port is taken meanwhile takes the next.

    Raises:
        ConfigError: The address can't be used, or there are not enough free ports.
    """
    count = sum(role.count(config) for role in ROLES)
    if not config.metrics_port:
        return [0] * count
    ports = range(config.metrics_port, min(config.metrics_port + count + PORTS_TRIED, 65536))
    free = list(itertools.islice((port for port in ports if is_free(config.metrics_host, port)), count))
    if len(free) < count:
        raise ConfigError(
            f"metrics_port {config.metrics_port}: {len(free)} ports from there to {ports[-1]} are free; "
            f"the run needs {count}; allowed: another port, or 0 for any that are free"
        )
    return free


def is_free(host: str, port: int) -> bool:
    """Return whether a port can be served now. Raises ConfigError if nothing can be served at ``host``."""
    try:
        family = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0][0]
        with socket.socket(family) as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)  # as the server does
            probe.bind((host, port))
    except OSError as error:
        if error.errno == errno.EADDRINUSE:
            return False
        raise ConfigError(
            f"metrics_host {host}, port {port}: {error.strerror}; allowed: an address of this machine, and a port "
            "that may be served"
        ) from None
    return True


def free_port() -> int:
    """Return a free port on the loopback interface."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def free_endpoint(kind: str = "tcp") -> str:
    """Return a free endpoint on the loopback interface."""
    return f"{kind}/127.0.0.1:{free_port()}"


@contextmanager
def prepared(config: DeployConfig) -> Iterator[PreparedRun]:
    """Yield a run that can start; no other process can run it meanwhile.

    A resumed run whose new settings don't fit, and which fails before it has trained anything, keeps its old ones. A
    new run that fails so is not the newest, and its name is free again.
    """
    if config.run:
        check_name(config)  # first: a live run would fail the other checks too, but this error says more
    metrics_ports(config)  # raises before anything is written
    # A new endpoint each time unless one is set: the old one may be taken.
    link = link_to_learner(config, config.endpoint or free_endpoint("tls" if config.tls else "tcp"))
    check_certificates(config)
    name = config.run or new_name(datetime.now().strftime("%Y%m%d-%H%M%S"))
    folder = RunFolder.of(name)
    with folder.held_by("deploy.local"):
        folder.check_free_of("learner")  # one that was started by hand, or is left of an earlier run
        # Of a life that was killed: while they are there, `topspin scale` promises what nobody reads
        folder.targets.unlink(missing_ok=True)
        folder.wanted_actors.unlink(missing_ok=True)
        before, trained = read_toml(folder.config) if config.resume else {}, last_epoch(folder)
        newest = newest_run()
        write(config, name, folder, link.endpoint)
        try:
            yield PreparedRun(name, config, folder, link)
        except RunFailedError:
            if before and last_epoch(folder) == trained:
                save_settings(folder.config, before)
            if newest and not has_trained(folder):
                RunFolder.of(newest).point_latest_here()
            raise


def check_name(config: DeployConfig) -> None:
    """Raise an error if the run's name can't be used, or if the run exists or is alive."""
    Keys(config.run)  # refuses a name that can't be part of a key; any other name can be a folder's
    folder = RunFolder.of(config.run)
    for holder in LOCKS:
        folder.check_free_of(holder)
    if not config.resume and has_trained(folder):
        raise ConfigError(
            f"run {config.run!r} exists already in {folder.root}: go on with --resume, or choose another --run"
        )


def has_trained(folder: RunFolder) -> bool:
    """Return whether a run has trained: one that failed before its first batch has settings and logs, and no more."""
    return bool(last_epoch(folder) or newest_checkpoint(folder))


def new_name(stem: str) -> str:
    """Return the name of a new run whose folder is now made: ``stem``, or ``stem-2`` and so on where it is taken."""
    RUNS.mkdir(parents=True, exist_ok=True)
    for number in itertools.count(1):
        name = stem if number == 1 else f"{stem}-{number}"
        try:
            (RUNS / name).mkdir()  # the first of several processes gets it
        except FileExistsError:
            continue
        return name
    raise AssertionError("unreachable")


def write(config: DeployConfig, name: str, folder: RunFolder, endpoint: str) -> None:
    """Create a run's folder, with its settings in config.toml."""
    folder.create()
    tables = to_tables(config, SECTION)
    save_settings(folder.config, tables | {"run": name, "endpoint": endpoint})
    folder.point_latest_here()


def certificate_names(config: DeployConfig) -> tuple[str, ...]:
    """Return the names of the certificates that a run needs: of its services, and of this process."""
    services = [name_of(role.name, str(i)) for role in ROLES for i in range(role.count(config))]
    services += [name_of("learner", str(rank)) for rank in range(1, config.learners)]
    return (*services, OPERATOR_NAME)


def check_certificates(config: DeployConfig) -> None:
    """Raise an error that names the certificates that a run lacks or can't use; nothing without TLS."""
    if not config.tls:
        return
    if found := missing(config.tls, certificate_names(config)):
        names = ",".join(found)
        raise ConfigError(
            f"--tls {config.tls} has no certificate of {names}; make them with: topspin certs --out {config.tls} "
            f"--add {names}"
        )
    for name in certificate_names(config):
        checked(config.tls, name)


def open_link(run: PreparedRun, stop: Event) -> Transport:
    """Return a connection to a run's learner, as its operator."""
    return open_zenoh(run.link, stop, name=OPERATOR_NAME, run=run.name)


def link_to_learner(config: DeployConfig, endpoint: str) -> ZenohConfig:
    """Return how this process reaches the learner: as its services do.

    Raises:
        ConfigError: TLS needs a folder of certificates, and an endpoint tls/...
    """
    try:
        return ZenohConfig(
            endpoint=endpoint,
            tls=config.tls,
            connect_timeout_s=config.connect_timeout_s,
        )
    except ValidationError as error:
        raise ConfigError(error.errors()[0]["msg"].removeprefix("Value error, ")) from None
