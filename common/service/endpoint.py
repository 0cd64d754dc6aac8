"""The HTTP port of a service: /metrics for Prometheus, /healthz and /readyz for whoever keeps it running.

====================  ===========================================================  ================================
path                  200                                                          503
====================  ===========================================================  ================================
/healthz              the main loop turned within the last `HANGS_AFTER_S`         it hangs, or has not begun yet
/readyz               the service has joined its run, and its link stands          it starts, ends or waits for a hub
====================  ===========================================================  ================================
"""

import errno
import socket
import time
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from socketserver import ThreadingMixIn
from threading import Thread
from types import MappingProxyType
from typing import Final
from wsgiref.simple_server import WSGIRequestHandler, WSGIServer, make_server
from wsgiref.types import StartResponse, WSGIEnvironment

from common.errors import ReportedError

FIRST_PORT: Final = 9100  # of a machine's services: the next ones take the next ports
PORTS_TRIED: Final = 1000  # as many as a run has actors
HANGS_AFTER_S: Final = 60.0  # far more than one turn of a main loop takes, such as a rollout
TEXT: Final = "text/plain; version=0.0.4; charset=utf-8"
_CLIENT_S: Final = 10.0  # [s] a client that sends no request is cut off


class PortError(ReportedError, RuntimeError):
    """No port can be served: one line with the address and the reason."""


@dataclass(slots=True)
class Health:
    """What a service's main loop says of itself. It is written there, and read by the threads of the HTTP port."""

    turned: float | None = None  # [s] time of the newest turn; None before the first
    has_joined: bool = False
    is_linked: bool = True

    def turn(self) -> None:
        """Note that the main loop turns."""
        self.turned = time.monotonic()

    def fault(self, now: float) -> str:
        """Return what is wrong with the main loop at ``now`` [s], or ""."""
        if self.turned is None:
            return "the main loop has not begun"
        silent_s = now - self.turned
        return f"the main loop has not turned for {silent_s:.0f} s" if silent_s > HANGS_AFTER_S else ""

    def unready(self) -> str:
        """Return why the service can't work yet, or ""."""
        if not self.has_joined:
            return "not a member of the run"
        return "" if self.is_linked else "no link to the hub"


class Endpoint:
    """The port while it is served, by a thread of its own.

    Args:
        host: Address to listen at.
        port: The first port to try: the next free one is taken. 0: any free one.
        metrics: Returns the text of /metrics.
        health: Answers the other two paths.

    Raises:
        PortError: The address can't be used, or every port that was tried is taken.
    """

    def __init__(self, host: str, port: int, metrics: Callable[[], bytes], health: Health) -> None:
        pages: Mapping[str, Callable[[], tuple[bool, bytes]]] = MappingProxyType(
            {
                "/metrics": lambda: (True, metrics()),
                "/healthz": lambda: _verdict(health.fault(time.monotonic())),
                "/readyz": lambda: _verdict(health.unready()),
            }
        )

        def answer(environ: WSGIEnvironment, start: StartResponse) -> Iterable[bytes]:
            page = pages.get(str(environ.get("PATH_INFO", "")))
            if page is None:
                start("404 Not Found", [("Content-Type", TEXT)])
                return [f"allowed: {', '.join(pages)}\n".encode()]
            is_well, body = page()
            start("200 OK" if is_well else "503 Service Unavailable", [("Content-Type", TEXT)])
            return [body]

        self._server = _listen(host, port, answer)
        self.port = int(self._server.server_port)
        self._thread = Thread(target=self._server.serve_forever, name="metrics", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Stop serving."""
        self._server.shutdown()
        self._server.server_close()
        self._thread.join()


class _Server(ThreadingMixIn, WSGIServer):
    daemon_threads = True


class _Handler(WSGIRequestHandler):
    timeout = _CLIENT_S

    def log_message(self, format: str, *args: object) -> None:
        """Log nothing: a request every few seconds is no event."""


def _verdict(fault: str) -> tuple[bool, bytes]:
    return not fault, f"{fault or 'ok'}\n".encode()


def _listen(host: str, first: int, answer: Callable[..., Iterable[bytes]]) -> WSGIServer:
    ports = range(first, min(first + PORTS_TRIED, 65536)) if first else range(1)
    try:
        family = socket.getaddrinfo(host, first, type=socket.SOCK_STREAM)[0][0]
        kind = type("Server", (_Server,), {"address_family": family})
        for port in ports:
            try:
                return make_server(host, port, answer, kind, handler_class=_Handler)
            except OSError as error:
                if error.errno != errno.EADDRINUSE:
                    raise
    except OSError as error:
        raise PortError(
            f"can't serve metrics at {host}:{first}: {error.strerror}; choose another metrics_host, or another "
            "metrics_port: 0 is any that is free"
        ) from error
    raise PortError(
        f"can't serve metrics at {host}: ports {ports[0]} to {ports[-1]} are taken; choose another metrics_port, "
        "or 0 for any that is free"
    )
