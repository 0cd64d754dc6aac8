"""Transports of both kinds for the contract tests, and waits on what they do."""

import socket
import time
from collections.abc import Callable

from common.comms.memory_transport import MemoryBroker
from common.comms.transport import Flow, Reply, Request, Server, Transport
from common.comms.zenoh_config import ZenohConfig
from common.comms.zenoh_transport import open_zenoh

RUN = "topspin/v3/contract"
LIMIT = 1024 * 1024


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


class MemoryNet:
    def __init__(self) -> None:
        self._broker = MemoryBroker()
        self.opened: list[Transport] = []

    def hub(self) -> Transport:
        return self._keep(self._broker.open(hub=True, max_message_bytes=LIMIT))

    def client(self) -> Transport:
        return self._keep(self._broker.open(max_message_bytes=LIMIT))

    def _keep(self, transport: Transport) -> Transport:
        self.opened.append(transport)
        return transport


class ZenohNet(MemoryNet):
    def __init__(self) -> None:
        super().__init__()
        self._endpoint = f"tcp/127.0.0.1:{free_port()}"

    def hub(self) -> Transport:
        return self._keep(open_zenoh(ZenohConfig(mode="hub", endpoint=self._endpoint, max_message_mib=1)))

    def client(self) -> Transport:
        config = ZenohConfig(endpoint=self._endpoint, connect_timeout_s=1.0, max_message_mib=1)
        return self._keep(open_zenoh(config))


def until(claim: Callable[[], bool], within_s: float = 5.0) -> None:
    """Return as soon as ``claim`` holds. Fail if it does not hold in time."""
    deadline = time.monotonic() + within_s
    while not claim():
        assert time.monotonic() < deadline, "did not come true in time"
        time.sleep(0.002)


def subscribed(publisher: Transport, key: str) -> None:
    """Return when a put on ``key`` reaches its subscriber. Its declaration takes time to arrive."""
    until(lambda: publisher.matching(key, Flow.STATUS))


def taken(server: Server) -> Request:
    request = server.poll(timeout_s=5.0)
    assert request is not None, "no request came"
    return request


def answered(client: Transport, server: Server, key: str) -> None:
    """Return when requests on ``key`` reach ``server``."""

    def is_answered() -> bool:
        pending = client.request(key, b"probe", 2.0, Flow.CONTROL)
        request = server.poll(timeout_s=0.2)
        if request is not None:
            request.reply(b"")
        return isinstance(pending.wait(), Reply)

    until(is_answered)
