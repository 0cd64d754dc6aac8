"""How long a policy takes from the learner's hub to each of many subscribers."""

import multiprocessing
import struct
import threading
import time
from contextlib import ExitStack, closing
from multiprocessing.connection import Connection
from threading import Event
from typing import Any, Final

import numpy as np

from benchmarks.scale.sizes import new_training, policy_snapshot
from common.comms.codec import encode
from common.comms.keys import Keys
from common.comms.transport import Flow, Transport
from common.comms.zenoh_config import ZenohConfig
from common.comms.zenoh_transport import open_zenoh
from common.errors import ReportedError
from common.evaluation.evaluate import check
from deploy.prepare import free_endpoint

RUN: Final = "broadcast"
STAMP: Final = struct.Struct(
    "<qq"
)  # number, and when it was sent [ns]; one clock for all processes of a machine
READY_S: Final = 240.0  # a busy machine takes long to import torch in each process


def listen(endpoint: str, count: int, pipe: Connection) -> None:
    """Be a process of subscribers: send the delays of all policies that came, by number, at the end of the pipe."""
    delays: list[list[tuple[int, float]]] = [[] for _ in range(count)]
    over = Event()

    def follow(transport: Transport, found: list[tuple[int, float]]) -> None:
        subscription = transport.subscribe(Keys(RUN).policy(), capacity=64)
        while not over.is_set():
            transport.wait(0.5)
            now = time.monotonic_ns()
            for sample in subscription.poll():
                number, sent = STAMP.unpack_from(sample.payload)
                found.append((number, 1e-6 * (now - sent)))

    with ExitStack() as stack:
        for found in delays:
            transport = stack.enter_context(closing(open_zenoh(ZenohConfig(endpoint=endpoint), Event())))
            threading.Thread(target=follow, args=(transport, found), daemon=True).start()
        while pipe.recv():  # how many have one, so that the sender knows when to begin
            pipe.send(sum(bool(found) for found in delays))
        over.set()
        pipe.send([delay for found in delays for delay in found])


def measure(subscribers: int, processes: int, policies: int, pause_s: float, stop: Event) -> dict[str, Any]:
    """Return the delays [ms] of ``policies`` broadcasts, one every ``pause_s`` [s]."""
    context = multiprocessing.get_context("spawn")
    endpoint, blob = free_endpoint(), encode(policy_snapshot(new_training()))
    key, pipes, children = Keys(RUN).policy(), [], []
    with closing(open_zenoh(ZenohConfig(endpoint=endpoint, mode="hub"), stop)) as hub:
        try:
            for _ in range(processes):
                ours, theirs = context.Pipe()
                child = context.Process(
                    target=listen, args=(endpoint, subscribers // processes, theirs), daemon=True
                )
                child.start()
                pipes.append(ours)
                children.append(child)
            deadline = time.monotonic() + READY_S
            while True:
                hub.publish(key, STAMP.pack(-1, time.monotonic_ns()), Flow.POLICY)
                time.sleep(0.2)
                check(stop)
                for pipe in pipes:
                    pipe.send(True)
                if sum(pipe.recv() for pipe in pipes) == processes * (subscribers // processes):
                    break
                if time.monotonic() > deadline:
                    raise ReportedError(f"subscribers are not ready within {READY_S:.0f} s")
            for number in range(policies):
                check(stop)
                hub.publish(key, STAMP.pack(number, time.monotonic_ns()) + blob, Flow.POLICY)
                time.sleep(pause_s)
            time.sleep(2.0)
            for pipe in pipes:
                pipe.send(False)
            found = [delay for pipe in pipes for number, delay in pipe.recv() if number >= 0]
        finally:
            for child in children:
                child.join(10.0)
                child.kill()
    delays = np.array(found)
    expected = policies * processes * (subscribers // processes)
    return {
        "subscribers": processes * (subscribers // processes),
        "broadcast_ms_p50": round(float(np.percentile(delays, 50)), 2),
        "broadcast_ms_p99": round(float(np.percentile(delays, 99)), 2),
        "broadcast_ms_max": round(float(delays.max()), 2),
        "broadcast_lost": expected - len(delays),
        "broadcasts": policies,
        "broadcast_pause_s": pause_s,
    }
