"""Promises of every transport about messages: within one process, and over Zenoh on loopback."""

import os
import time

import pytest

from common.comms.transport import Flow, NoReply, Reply, TransportError
from tests.contract.transports import LIMIT, RUN, answered, subscribed, taken, until


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

    # Hints may be lost on a crowded link, and then the mailbox never gets them: publish until enough arrived
    published = 0
    while inbox.dropped < 100 and published < 20_000:
        hub.publish(f"{RUN}/status/a", b"%d" % published, Flow.STAGE)
        published += 1
        time.sleep(0.0005)
    last = -1
    while last != inbox.dropped:  # messages in transit
        last = inbox.dropped
        time.sleep(0.2)
    kept = [int(sample.payload) for sample in inbox.poll()]

    assert len(kept) == 10
    assert kept == sorted(set(kept))
    assert 100 <= inbox.dropped <= published - 10
    assert kept[0] >= inbox.dropped  # the oldest were dropped, and each of them was counted


def test_a_subscription_that_was_closed_gets_nothing_more(net):
    hub, actor = net.hub(), net.client()
    inbox = actor.subscribe(f"{RUN}/stage", capacity=10)
    subscribed(hub, f"{RUN}/stage")

    inbox.close()

    until(lambda: not hub.matching(f"{RUN}/stage", Flow.STATUS))


def test_a_publisher_can_see_whether_there_is_a_subscriber(net):
    net.hub()
    generator, actor = net.client(), net.client()
    key = f"{RUN}/rally/0"
    assert not generator.matching(key, Flow.RALLY)

    inbox = actor.subscribe(f"{RUN}/rally/*", capacity=1)

    until(lambda: generator.matching(key, Flow.RALLY))
    inbox.close()
    until(lambda: not generator.matching(key, Flow.RALLY))


def test_a_client_that_joins_late_requests_the_value_on_the_same_key(net):
    hub = net.hub()
    server = hub.serve(f"{RUN}/policy", capacity=8)
    hub.publish(f"{RUN}/policy", b"version 7", Flow.POLICY)
    actor = net.client()

    pending = actor.request(f"{RUN}/policy", b"", 5.0, Flow.POLICY)
    taken(server).reply(b"version 7")

    assert pending.wait() == Reply(b"version 7")


def test_an_answer_may_come_long_after_the_request_was_taken(net):
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


def test_two_requests_in_flight_are_answered_in_any_order(net):
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


def test_a_request_without_a_server_ends_at_once(net):
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
    with pytest.raises(TransportError, match="was answered before; allowed: one answer"):
        request.reply(b"")


def test_a_full_server_refuses_requests_at_once_and_counts_them(net):
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


def test_an_oversize_message_is_refused_by_the_sender_because_no_receiver_would_answer(net):
    net.hub()
    actor = net.client()

    with pytest.raises(TransportError, match=r"of 1048577 bytes on .*/rollout is over the limit of 1048576"):
        actor.request(f"{RUN}/rollout", bytes(LIMIT + 1), 1.0, Flow.ROLLOUT)
    with pytest.raises(TransportError, match="is over the limit"):
        actor.publish(f"{RUN}/policy", bytes(LIMIT + 1), Flow.POLICY)


def test_a_wait_ends_with_any_arrival_even_one_before_the_wait(net):
    hub, actor = net.hub(), net.client()
    inbox = actor.subscribe(f"{RUN}/stage", capacity=4)
    subscribed(hub, f"{RUN}/stage")
    until(lambda: not actor.wait(0.05))

    hub.publish(f"{RUN}/stage", b"", Flow.STAGE)
    assert inbox.wait(5.0)

    assert actor.wait(5.0)
    assert not actor.wait(0.01)


def test_requests_that_were_left_waiting_end_the_next_wait(net):
    hub, client = net.hub(), net.client()
    server = hub.serve(f"{RUN}/ctl/learner/0", capacity=8)
    answered(client, server, f"{RUN}/ctl/learner/0")
    pending = [client.request(f"{RUN}/ctl/learner/0", b"", 5.0, Flow.CONTROL) for _ in range(3)]
    taken = []

    def take_one():
        for request in server.waiting(1):
            taken.append(request)
            request.reply(b"")

    until(lambda: (take_one(), taken)[1])
    while len(taken) < 3:
        assert hub.wait(5.0)  # and no new arrival ends it
        take_one()

    assert all(isinstance(request.wait(), Reply) for request in pending)


def test_a_mailbox_needs_room_for_one(net):
    with pytest.raises(ValueError, match="capacity 0 of a mailbox; allowed: 1 or more"):
        net.hub().subscribe(f"{RUN}/stage", capacity=0)


def test_a_closed_transport_raises_and_closing_is_quick_and_repeatable(net):
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


def test_a_message_sent_just_before_closing_arrives(net):
    hub, actor = net.hub(), net.client()
    inbox = hub.subscribe(f"{RUN}/status/actor/0", capacity=4)
    subscribed(actor, f"{RUN}/status/actor/0")

    actor.publish(f"{RUN}/status/actor/0", b"bye", Flow.STATUS)
    actor.close()

    assert inbox.wait(5.0)
