"""`targets.json` of a run: where the /metrics of its services are, for Prometheus' file discovery.

The heartbeats tell the ports, so a service that had to take another port, or came back at another one, is found too.
"""

import json
import logging
import socket
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

from common.comms.messages import Status
from common.service.whole_file import write_whole

log = logging.getLogger(__name__)


def ports_of(statuses: Iterable[Status], names: Iterable[str]) -> dict[tuple[str, str], int]:
    """Return the metrics port by role and id, in the order of ``names``, such as ``actor-0``.

    Services of other hosts, whose names are not among them, are left out: their address is not known here.
    """
    heard = {f"{s.role}-{s.id}": s for s in statuses if s.gauges.get("metrics_port")}
    return {
        (heard[name].role, heard[name].id): int(heard[name].gauges["metrics_port"])
        for name in names
        if name in heard
    }


def target_groups(run: str, host: str, ports: Mapping[tuple[str, str], int]) -> list[dict[str, object]]:
    """Return the content of the file: one group with an address and three labels for each service."""
    return [
        {"targets": [f"{host}:{port}"], "labels": {"run": run, "role": role, "id": id_}}
        for (role, id_), port in ports.items()
    ]


def reachable(host: str) -> str:
    """Return the address at which others find what is served at ``host`` of this machine."""
    found = socket.gethostname() if host in ("0.0.0.0", "::", "") else host
    return f"[{found}]" if ":" in found else found


class TargetsFile:
    """Keeps the file as the heartbeats are, and removes it at the end: nobody misses a run that is done.

    Args:
        path: The file.
        run: Name of the run.
        host: Address that the services serve at.
    """

    def __init__(self, path: Path, run: str, host: str) -> None:
        self._path, self._run, self._host = path, run, reachable(host)
        self._written: dict[tuple[str, str], int] = {}
        self._has_failed = False  # the last write

    def update(self, statuses: Iterable[Status], names: Sequence[str]) -> None:
        """Write the file if a port is new. A disk that is full costs one line in the log, and is tried again."""
        ports = ports_of(statuses, names)
        if ports == self._written:
            return
        try:
            write_whole(self._path, json.dumps(target_groups(self._run, self._host, ports), indent=1) + "\n")
        except OSError as error:
            if not self._has_failed:
                log.error("can't write file=%s reason=%s", self._path, error.strerror)
            self._has_failed = True
            return
        self._written, self._has_failed = ports, False
        at = " ".join(f"{role}-{id_}={port}" for (role, id_), port in ports.items())
        level = logging.INFO if len(ports) == len(names) else logging.DEBUG  # one line when all have come
        log.log(level, "metrics host=%s %s; for Prometheus: file=%s", self._host, at, self._path)

    def close(self) -> None:
        """Remove the file."""
        self._path.unlink(missing_ok=True)
