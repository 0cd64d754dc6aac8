"""A service as a member of its run."""

import math
import re
from pathlib import Path

import pytest

from common.comms.codec import decode, encode
from common.comms.keys import Keys
from common.comms.memory_transport import MemoryBroker
from common.comms.messages import Command, Control, ControlReply, Status
from common.comms.transport import Flow
from common.service.member import REFUSED_KINDS, Member
from common.service.metrics import Metrics
from common.service.settings import ServiceConfig


@pytest.mark.parametrize("tls", [True, False])
def test_a_service_drains_on_command_only_where_the_hub_knows_who_commands(tls):
    secured = {"endpoint": "tls/hall:7447", "tls": "certs"} if tls else {}
    broker, config = MemoryBroker(), ServiceConfig(run="r", id="3", **secured)
    hub, operator = broker.open(hub=True), broker.open()
    member = Member("actor", config, hub, Metrics("actor", "3"), 1)
    pending = operator.request(Keys("r").ctl("actor", "3"), encode(Control(Command.DRAIN)), 5.0, Flow.CONTROL)
    member.answer_control()
    reply = decode(pending.wait().payload, ControlReply)

    assert (member.is_draining, reply.ok) == (tls, tls)
    assert reply.reason == (
        "" if tls else "commands need TLS (--tls): on an open hub anybody could send them"
    )


def test_a_heartbeat_leaves_out_what_no_reader_takes():
    broker, config = MemoryBroker(), ServiceConfig(run="r", id="0")
    hub, panel = broker.open(hub=True), broker.open()
    heard = panel.subscribe(Keys("r").status("learner", "0"), capacity=4)
    Member("learner", config, hub, Metrics("learner", "0"), 1).beat(
        {}, {"kl": math.inf, "lag": math.nan, "a": 1.0}
    )
    (sample,) = heard.poll()

    assert dict(decode(sample.payload, Status).gauges) == {"a": 1.0}


@pytest.mark.parametrize("role", REFUSED_KINDS)
def test_every_kind_that_a_service_refuses_counts_from_0(role):
    sources = (Path(__file__).parents[3] / "services" / role).glob("*.py")
    refused = {
        kind for path in sources for kind in re.findall(r'member\.refuse\(\s*"(\w+)"', path.read_text())
    }

    assert refused | {"control"} == set(REFUSED_KINDS[role])
