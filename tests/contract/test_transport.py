"""What every transport promises, held against both: within one process, and over Zenoh on loopback."""

import os
import signal
import socket
import threading
import time
from collections.abc import Callable, Iterator
from multiprocessing import get_context
from multiprocessing.synchronize import Event

import pytest

from common.comms.memory_transport import MemoryBroker
from common.comms.transport import (
    AliveEvent,
    Flow,
    NoReply,
    Reply,
    Request,
    Server,
    Transport,
    TransportError,
)
from common.comms.zenoh_config import ZenohConfig
from common.comms.zenoh_transport import open_zenoh

RUN = "topspin/v1/contract"
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


@pytest.fixture(params=[MemoryNet, ZenohNet], ids=["memory", "zenoh"])
def net(request) -> Iterator[MemoryNet]:
    net = request.param()
    yield net
    for transport in reversed(net.opened):
        assert transport.close()


def until(claim: Callable[[], bool], within_s: float = 5.0) -> None:
    """Return as soon as ``claim`` holds; fail if it doesn't in time."""
    deadline = time.monotonic() + within_s
    while not claim():
        assert time.monotonic() < deadline, "did not come true in time"
        time.sleep(0.002)


def subscribed(publisher: Transport, key: str) -> None:
    """Return when a put on ``key`` reaches its subscriber: declarations travel on their own."""
    until(lambda: publisher.matching(key, Flow.STATUS))


def taken(server: Server) -> Request:
    request = server.poll(timeout_s=5.0)
    assert request is not None, "no request came"
    return request


def answered(asker: Transport, server: Server, key: str) -> None:
    """Return when requests on ``key`` reach ``server``."""

    def comes_through() -> bool:
        pending = asker.request(key, b"probe", 2.0, Flow.CONTROL)
        request = server.poll(timeout_s=0.2)
        if request is not None:
            request.reply(b"")
        return isinstance(pending.wait(), Reply)

    until(comes_through)


def test_a_put_reaches_the_hub_and_other_clients(net):
    hub, sender, receiver = net.hub(), net.client(), net.client()
    inboxes = [transport.subscribe(f"{RUN}/rally/*", capacity=8) for transport in (hub, receiver)]
    subscribed(sender, f"{RUN}/rally/0")

    def put_reaches_all() -> bool:
        sender.publish(f"{RUN}/rally/0", b"ping", Flow.RALLY)
        return all(inbox.wait(0.05) for inbox in inboxes)

    until(put_reaches_all)

    for inbox in inboxes:
        sample = inbox.poll()[0]
        assert (sample.key, sample.payload) == (f"{RUN}/rally/0", b"ping")


def test_with_a_capacity_of_one_the_latest_wins_and_the_rest_is_counted(net):
    hub, actor = net.hub(), net.client()
    inbox = actor.subscribe(f"{RUN}/policy", capacity=1)
    subscribed(hub, f"{RUN}/policy")

    for version in range(20):
        hub.publish(f"{RUN}/policy", b"%d" % version, Flow.POLICY)
    until(lambda: inbox.dropped == 19)

    assert [sample.payload for sample in inbox.poll()] == [b"19"]
    assert inbox.poll() == []


def test_a_full_subscription_drops_the_oldest_counts_them_and_keeps_the_order(net):
    hub, actor = net.hub(), net.client()
    inbox = actor.subscribe(f"{RUN}/status/a", capacity=10)
    subscribed(hub, f"{RUN}/status/a")

    # Hints may be lost on a crowded way, and then the mailbox never sees them: so until enough have come.
    published = 0
    while inbox.dropped < 100 and published < 20_000:
        hub.publish(f"{RUN}/status/a", b"%d" % published, Flow.STAGE)
        published += 1
        time.sleep(0.0005)
    last = -1
    while last != inbox.dropped:  # those under way
        last = inbox.dropped
        time.sleep(0.2)
    kept = [int(sample.payload) for sample in inbox.poll()]

    assert len(kept) == 10
    assert kept == sorted(set(kept))
    assert 100 <= inbox.dropped <= published - 10
    assert kept[0] >= inbox.dropped  # the oldest went, and every one that went was counted


def test_a_subscription_that_was_closed_gets_nothing_more(net):
    hub, actor = net.hub(), net.client()
    inbox = actor.subscribe(f"{RUN}/stage", capacity=10)
    subscribed(hub, f"{RUN}/stage")

    inbox.close()

    until(lambda: not hub.matching(f"{RUN}/stage", Flow.STATUS))


def test_a_publisher_can_tell_whether_somebody_listens(net):
    net.hub()
    generator, actor = net.client(), net.client()
    key = f"{RUN}/rally/0"
    assert not generator.matching(key, Flow.RALLY)

    inbox = actor.subscribe(f"{RUN}/rally/*", capacity=1)

    until(lambda: generator.matching(key, Flow.RALLY))
    inbox.close()
    until(lambda: not generator.matching(key, Flow.RALLY))


def test_a_late_joiner_gets_what_it_missed_by_asking_the_same_key(net):
    hub = net.hub()
    server = hub.serve(f"{RUN}/policy", capacity=8)
    hub.publish(f"{RUN}/policy", b"version 7", Flow.POLICY)
    actor = net.client()

    pending = actor.request(f"{RUN}/policy", b"", 5.0, Flow.POLICY)
    taken(server).reply(b"version 7")

    assert pending.wait() == Reply(b"version 7")


def test_an_answer_may_be_given_long_after_the_request_was_taken(net):
    hub, actor = net.hub(), net.client()
    server = hub.serve(f"{RUN}/rollout", capacity=8)
    pending = actor.request(f"{RUN}/rollout", b"rollout", 5.0, Flow.ROLLOUT)
    request = taken(server)
    assert (request.key, request.payload) == (f"{RUN}/rollout", b"rollout")

    assert server.poll(timeout_s=0.05) is None
    assert pending.poll() is None
    request.reply(b"accepted")

    assert pending.wait() == Reply(b"accepted")
    assert pending.poll() == Reply(b"accepted")


def test_two_requests_under_way_are_answered_in_any_order(net):
    hub, actor = net.hub(), net.client()
    server = hub.serve(f"{RUN}/rollout", capacity=8)
    pending = {name: actor.request(f"{RUN}/rollout", name, 5.0, Flow.ROLLOUT) for name in (b"one", b"two")}

    requests = [taken(server), taken(server)]
    for request in sorted(requests, key=lambda request: request.payload, reverse=True):
        request.reply(request.payload + b" accepted")

    assert {name: reply.wait() for name, reply in pending.items()} == {
        b"one": Reply(b"one accepted"),
        b"two": Reply(b"two accepted"),
    }


def test_large_payloads_arrive_whole_in_both_directions(net):
    hub, actor = net.hub(), net.client()
    server = hub.serve(f"{RUN}/rollout", capacity=8)
    payload = os.urandom(LIMIT - 4096)

    pending = actor.request(f"{RUN}/rollout", payload, 5.0, Flow.ROLLOUT)
    request = taken(server)
    request.reply(request.payload)

    assert pending.wait() == Reply(payload)


def test_a_request_without_an_answer_ends_at_its_deadline_and_a_late_answer_changes_nothing(net):
    hub, actor = net.hub(), net.client()
    server = hub.serve(f"{RUN}/rollout", capacity=8)
    started = time.monotonic()
    pending = actor.request(f"{RUN}/rollout", b"", 0.3, Flow.ROLLOUT)
    request = taken(server)

    assert pending.wait() is NoReply.TIMEOUT
    assert 0.25 < time.monotonic() - started < 2.0
    request.reply(b"too late")
    assert pending.poll() is NoReply.TIMEOUT


def test_a_request_to_nobody_ends_at_once(net):
    net.hub()
    actor = net.client()
    started = time.monotonic()

    assert actor.request(f"{RUN}/rollout", b"", 5.0, Flow.ROLLOUT).wait() is NoReply.NO_SERVER
    assert time.monotonic() - started < 2.0


def test_a_refused_request_ends_at_once_and_only_once(net):
    hub, actor = net.hub(), net.client()
    server = hub.serve(f"{RUN}/ctl/actor/0", capacity=8)
    pending = actor.request(f"{RUN}/ctl/actor/0", b"", 5.0, Flow.CONTROL)
    request = taken(server)

    request.refuse()

    assert pending.wait() is NoReply.NO_SERVER
    with pytest.raises(TransportError, match="has been answered before"):
        request.reply(b"")


def test_a_full_server_turns_requests_away_at_once_and_counts_them(net):
    hub, actor = net.hub(), net.client()
    server = hub.serve(f"{RUN}/rollout", capacity=2)
    answered(actor, server, f"{RUN}/rollout")

    pending = [actor.request(f"{RUN}/rollout", b"%d" % i, 5.0, Flow.ROLLOUT) for i in range(5)]
    until(lambda: server.dropped == 3)
    for _ in range(2):
        taken(server).reply(b"accepted")

    outcomes = [reply.wait() for reply in pending]
    assert outcomes.count(Reply(b"accepted")) == 2
    assert outcomes.count(NoReply.NO_SERVER) == 3


def test_a_server_that_closes_ends_the_requests_that_wait_in_it(net):
    hub, actor = net.hub(), net.client()
    server = hub.serve(f"{RUN}/rollout", capacity=8)
    answered(actor, server, f"{RUN}/rollout")
    hub.wait(0.0)
    pending = actor.request(f"{RUN}/rollout", b"", 5.0, Flow.ROLLOUT)
    assert hub.wait(5.0), "no request came"

    server.close()

    assert pending.wait() is NoReply.NO_SERVER


def test_clients_serve_each_other_through_the_hub(net):
    net.hub()
    generator, actor = net.client(), net.client()
    server = generator.serve(f"{RUN}/rally/0", capacity=8)

    answered(actor, server, f"{RUN}/rally/0")


def test_after_a_restart_of_the_hub_everything_is_declared_again_and_the_gap_is_told(net):
    hub, actor = net.hub(), net.client()
    inbox = actor.subscribe(f"{RUN}/policy", capacity=4)
    control = actor.serve(f"{RUN}/ctl/actor/0", capacity=4)
    actor.declare_alive(f"{RUN}/alive/actor/0/1")
    until(lambda: actor.connected)
    assert actor.reconnect_count == 0

    hub.close()
    until(lambda: not actor.connected)
    actor.publish(f"{RUN}/status/actor/0", b"into the void", Flow.STATUS)
    assert actor.request(f"{RUN}/rollout", b"", 5.0, Flow.ROLLOUT).wait() is NoReply.NO_SERVER
    hub = net.hub()

    until(lambda: actor.connected)
    until(lambda: actor.reconnect_count == 1)
    watch = hub.watch_alive(f"{RUN}/alive/**")
    until(lambda: watch.poll() == [AliveEvent(f"{RUN}/alive/actor/0/1", alive=True)])
    subscribed(hub, f"{RUN}/policy")
    hub.publish(f"{RUN}/policy", b"again", Flow.POLICY)
    assert inbox.wait(5.0)
    answered(hub, control, f"{RUN}/ctl/actor/0")


def test_a_request_under_way_ends_when_its_server_dies(net):
    hub, actor = net.hub(), net.client()
    server = hub.serve(f"{RUN}/rollout", capacity=8)
    pending = actor.request(f"{RUN}/rollout", b"", 5.0, Flow.ROLLOUT)
    taken(server)
    started = time.monotonic()

    hub.close()

    assert pending.wait() is NoReply.NO_SERVER
    assert time.monotonic() - started < 2.0


def test_tokens_come_into_sight_and_go_with_their_transport(net):
    hub, actor = net.hub(), net.client()
    watch = hub.watch_alive(f"{RUN}/alive/**")
    token = actor.declare_alive(f"{RUN}/alive/actor/0/1")
    actor.declare_alive(f"{RUN}/alive/actor/0/2")
    seen: list[AliveEvent] = []

    def saw(count: int) -> bool:
        seen.extend(watch.poll())
        return len(seen) == count

    until(lambda: saw(2))
    token.close()
    until(lambda: saw(3))
    actor.close()
    until(lambda: saw(4))

    assert [event.key[-1] for event in seen] == ["1", "2", "1", "2"]
    assert [event.alive for event in seen] == [True, True, False, False]


def test_a_watch_starts_with_the_tokens_that_are_there_and_leaves_out_its_own(net):
    net.hub()
    actor, late = net.client(), net.client()
    actor.declare_alive(f"{RUN}/alive/actor/0/1")
    late.declare_alive(f"{RUN}/alive/evaluator/0/1")

    watch = late.watch_alive(f"{RUN}/alive/**")

    assert watch.wait(5.0)
    until(lambda: watch.poll() == [AliveEvent(f"{RUN}/alive/actor/0/1", alive=True)])


def test_without_the_hub_a_client_sees_everybody_go_and_come_back(net):
    hub, actor, other = net.hub(), net.client(), net.client()
    watch = actor.watch_alive(f"{RUN}/alive/**")
    other.declare_alive(f"{RUN}/alive/actor/1/1")
    until(lambda: watch.poll() == [AliveEvent(f"{RUN}/alive/actor/1/1", alive=True)])

    hub.close()
    until(lambda: watch.poll() == [AliveEvent(f"{RUN}/alive/actor/1/1", alive=False)])
    net.hub()

    until(lambda: watch.poll() == [AliveEvent(f"{RUN}/alive/actor/1/1", alive=True)])


def test_an_oversize_message_is_refused_by_the_sender_because_no_receiver_would_tell(net):
    net.hub()
    actor = net.client()

    with pytest.raises(TransportError, match=r"of 1048577 bytes on .*/rollout is over the limit of 1048576"):
        actor.request(f"{RUN}/rollout", bytes(LIMIT + 1), 1.0, Flow.ROLLOUT)
    with pytest.raises(TransportError, match="is over the limit"):
        actor.publish(f"{RUN}/policy", bytes(LIMIT + 1), Flow.POLICY)


def test_waiting_ends_with_any_arrival_even_one_before_the_wait(net):
    hub, actor = net.hub(), net.client()
    inbox = actor.subscribe(f"{RUN}/stage", capacity=4)
    subscribed(hub, f"{RUN}/stage")
    until(lambda: not actor.wait(0.05))

    hub.publish(f"{RUN}/stage", b"", Flow.STAGE)
    assert inbox.wait(5.0)

    assert actor.wait(5.0)
    assert not actor.wait(0.01)


def test_a_mailbox_needs_room_for_one(net):
    with pytest.raises(TransportError, match="capacity 0 of a mailbox; allowed: 1 and above"):
        net.hub().subscribe(f"{RUN}/stage", capacity=0)


def test_a_closed_transport_says_so_and_closing_is_quick_and_may_be_repeated(net):
    hub = net.hub()
    actor = net.client()
    actor.subscribe(f"{RUN}/policy", capacity=1)
    hub.serve(f"{RUN}/rollout", capacity=1)
    started = time.monotonic()

    assert actor.close()
    assert hub.close()
    assert actor.close()

    assert time.monotonic() - started < 2.0
    assert not actor.connected
    for use in (
        lambda: actor.publish(f"{RUN}/policy", b"", Flow.POLICY),
        lambda: actor.request(f"{RUN}/policy", b"", 1.0, Flow.POLICY),
        lambda: actor.subscribe(f"{RUN}/policy", 1),
    ):
        with pytest.raises(TransportError, match="transport is closed"):
            use()


def test_what_was_sent_just_before_closing_arrives(net):
    hub, actor = net.hub(), net.client()
    inbox = hub.subscribe(f"{RUN}/status/actor/0", capacity=4)
    subscribed(actor, f"{RUN}/status/actor/0")

    actor.publish(f"{RUN}/status/actor/0", b"bye", Flow.STATUS)
    actor.close()

    assert inbox.wait(5.0)


def test_a_second_hub_at_the_same_place_is_refused(net):
    net.hub()

    with pytest.raises(
        TransportError, match=r"has a hub already|can't listen at tcp/127.0.0.1:\d+: .*in use"
    ):
        net.hub()


def test_a_client_without_a_hub_gives_up_at_its_deadline(net):
    with pytest.raises(TransportError, match=r"has no hub|no hub answered at tcp/127.0.0.1:\d+ in 1 s"):
        net.client()


def test_a_cut_link_is_felt_on_both_sides_and_mends():
    broker = MemoryBroker()
    hub, actor = broker.open(hub=True), broker.open()
    server = hub.serve("a/b", capacity=1)
    pending = actor.request("a/b", b"", 5.0, Flow.ROLLOUT)
    taken(server)

    broker.cut(actor)

    assert pending.poll() is NoReply.NO_SERVER
    assert not actor.connected
    assert hub.connected
    broker.mend(actor)
    assert actor.connected
    assert actor.reconnect_count == 1


def test_a_client_that_is_told_to_stop_gives_up_waiting_for_its_hub():
    stop = threading.Event()
    stop.set()

    with pytest.raises(TransportError, match="asked to stop while waiting for the hub at tcp/"):
        open_zenoh(ZenohConfig(endpoint=f"tcp/127.0.0.1:{free_port()}"), stop)


def test_the_clients_of_a_hub_that_starts_late_find_it():
    config = ZenohConfig(endpoint=f"tcp/127.0.0.1:{free_port()}", connect_timeout_s=10.0)
    opened: list[Transport] = []
    waiting = threading.Thread(target=lambda: opened.append(open_zenoh(config)))
    waiting.start()

    hub = open_zenoh(config.model_copy(update={"mode": "hub"}))
    waiting.join(10.0)

    assert opened[0].connected
    assert opened[0].close()
    assert hub.close()


def test_a_session_that_a_fork_inherited_is_refused():
    hub = open_zenoh(ZenohConfig(mode="hub", endpoint=f"tcp/127.0.0.1:{free_port()}"))
    hub._process += 1

    with pytest.raises(TransportError, match="does not survive a fork"):
        hub.publish(f"{RUN}/policy", b"", Flow.POLICY)

    hub._process -= 1
    assert hub.close()


def be_a_hub(endpoint: str, serving: Event) -> None:
    hub = open_zenoh(ZenohConfig(mode="hub", endpoint=endpoint))
    server = hub.serve(f"{RUN}/rollout", capacity=8)
    serving.set()
    while True:
        if (request := server.poll(timeout_s=1.0)) is not None:
            request.reply(b"accepted")


def test_a_hung_hub_holds_nobody_up_beyond_the_deadline():
    context, endpoint = get_context("spawn"), f"tcp/127.0.0.1:{free_port()}"
    serving = context.Event()
    process = context.Process(target=be_a_hub, args=(endpoint, serving), daemon=True)
    process.start()
    assert serving.wait(20.0)
    actor = open_zenoh(ZenohConfig(endpoint=endpoint))
    assert actor.request(f"{RUN}/rollout", b"", 5.0, Flow.ROLLOUT).wait() == Reply(b"accepted")
    os.kill(process.pid, signal.SIGSTOP)
    started = time.monotonic()

    outcome = actor.request(f"{RUN}/rollout", b"", 0.5, Flow.ROLLOUT).wait()
    actor.publish(f"{RUN}/status/actor/0", b"", Flow.STATUS)
    actor.close(timeout_s=1.0)

    assert outcome is NoReply.TIMEOUT
    assert time.monotonic() - started < 3.0
    process.kill()
    process.join(5.0)


def leave_without_closing(endpoint: str) -> None:
    hub = open_zenoh(ZenohConfig(mode="hub", endpoint=endpoint))
    client = open_zenoh(ZenohConfig(endpoint=endpoint))
    hub.serve(f"{RUN}/**", capacity=1)
    client.subscribe(f"{RUN}/**", capacity=1)
    client.watch_alive(f"{RUN}/**")
    client.request(f"{RUN}/rollout", b"", 60.0, Flow.ROLLOUT)
    raise SystemExit(7)


def test_a_process_that_forgets_to_close_still_exits():
    process = get_context("spawn").Process(
        target=leave_without_closing, args=(f"tcp/127.0.0.1:{free_port()}",)
    )
    process.start()
    process.join(20.0)

    assert process.exitcode == 7
