"""What a message costs the hub and its sender: CPU time of a real hub, with clients in another process."""

import multiprocessing
import time
from contextlib import ExitStack, closing
from multiprocessing.connection import Connection
from threading import Event
from typing import Any, Final

from benchmarks.scaling.costs import Line
from common.comms.keys import Keys
from common.comms.transport import Flow, Reply
from common.comms.zenoh_config import ZenohConfig
from common.comms.zenoh_transport import open_zenoh
from common.errors import ReportedError
from deploy.prepare import free_endpoint

KEYS: Final = Keys("messages")
ANSWER: Final = b"0" * 200  # about a verdict's bytes
SUBSCRIBERS: Final = 4
REQUEST_S: Final = 10.0
READY_S: Final = 60.0
MOST: Final = 200  # requests, or policies, of one measurement


def measure(sizes: tuple[int, int], policy_bytes: int, seconds: float) -> dict[str, Any]:
    """Return the costs of messages.

    Args:
        sizes: Bytes of a small and of a large rollout.
        policy_bytes: Bytes of a policy.
        seconds: Of each of three measurements; at most `MOST` messages.
    """
    context = multiprocessing.get_context("spawn")
    endpoint = free_endpoint()
    with closing(open_zenoh(ZenohConfig(endpoint=endpoint, mode="hub"), Event())) as hub:
        pipe, theirs = context.Pipe()
        client = context.Process(target=_client, args=(endpoint, theirs), daemon=True)
        client.start()
        theirs.close()
        try:
            server = hub.serve(KEYS.every_rollout(), capacity=64)
            _received(pipe)
            taken, sent, one_way = [], [], []
            for size in (sizes[0], *sizes):  # the first warms up
                pipe.send((size, seconds))
                before = time.process_time()
                while not pipe.poll():
                    hub.wait(0.05)
                    for request in server.waiting(64):
                        request.reply(ANSWER)
                used = time.process_time() - before
                count, client_s, wall_s = _received(pipe)
                taken.append((size, used / count))
                sent.append((size, client_s / count))
                one_way.append(wall_s / count / 2)
            policy = bytes(policy_bytes)
            pipe.send(None)
            _received(pipe)
            before, started, count = time.process_time(), time.perf_counter(), 0
            while count < MOST and time.perf_counter() - started < seconds:
                hub.publish(KEYS.policy(), policy, Flow.POLICY)
                count += 1
                time.sleep(0.02)
            used = time.process_time() - before
        finally:
            pipe.close()
            client.join(10.0)
            client.kill()
    return {
        "hub": Line.through(*taken[1:]),
        "send": Line.through(*sent[1:]),
        "latency_s": one_way[1],
        "hub_policy_byte_s": used / (count * SUBSCRIBERS * policy_bytes),
    }


def _received(pipe: Connection) -> Any:
    if not pipe.poll(READY_S):
        raise ReportedError(f"the clients of the hub are silent for {READY_S:.0f} s")
    return pipe.recv()


def _client(endpoint: str, pipe: Connection) -> None:
    """Send requests of each size that is asked for, one after the other, and subscribe to policies at the end."""
    with ExitStack() as stack:
        sessions = [
            stack.enter_context(closing(open_zenoh(ZenohConfig(endpoint=endpoint), Event())))
            for _ in range(SUBSCRIBERS)
        ]
        pipe.send(True)
        while (asked := pipe.recv()) is not None:
            size, seconds = asked
            payload, key = bytes(size), KEYS.rollout("a0")
            count, cpu, started = 0, time.process_time(), time.perf_counter()
            while count < MOST and time.perf_counter() - started < seconds:
                outcome = sessions[0].request(key, payload, REQUEST_S, Flow.ROLLOUT).wait()
                count += isinstance(outcome, Reply)
            pipe.send((count, time.process_time() - cpu, time.perf_counter() - started))
        subscriptions = [session.subscribe(KEYS.policy(), capacity=1) for session in sessions]
        time.sleep(0.5)  # until the hub knows them
        pipe.send(len(subscriptions))
        while True:  # until the other end is closed
            try:
                pipe.recv()
            except EOFError:
                return
