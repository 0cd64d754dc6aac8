"""The fixture that runs a test on every transport."""

from collections.abc import Iterator

import pytest

from tests.contract.transports import MemoryNet, ZenohNet


@pytest.fixture(params=[MemoryNet, ZenohNet], ids=["memory", "zenoh"])
def net(request) -> Iterator[MemoryNet]:
    net = request.param()
    yield net
    for transport in reversed(net.opened):
        assert transport.close()
