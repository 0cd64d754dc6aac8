"""`python -m benchmarks.chaos.peers KIND RUN ENDPOINT`: a bad peer as a process of its own."""

import os
import random
import signal
import sys
import time
from collections.abc import Callable, Mapping
from typing import Final

from benchmarks.attacker import open_session
from common.comms.keys import Keys
from common.comms.transport import Flow
from common.comms.zenoh_config import ZenohConfig
from common.comms.zenoh_transport import open_zenoh

REQUESTS = 100
LARGEST = 65_536  # bytes of garbage


def hung_reader(run: str, endpoint: str) -> None:
    """Ask for many policies, and hang."""
    transport = open_zenoh(ZenohConfig(endpoint=endpoint))
    pending = [transport.request(Keys(run).policy(), b"", 60.0, Flow.POLICY) for _ in range(REQUESTS)]
    time.sleep(0.2)
    os.kill(os.getpid(), signal.SIGSTOP)
    pending.clear()  # they are kept until here


def garbage(run: str, endpoint: str) -> None:
    """Publish on every key, and ask on every key, with bytes that are no messages."""
    keys = Keys(run)
    dice = random.Random(os.getpid())
    session = open_session(ZenohConfig(endpoint=endpoint))
    told = [
        keys.policy(),
        keys.stage(),
        keys.rally(0),
        keys.status("learner", "0"),
        keys.status("actor", "0"),
    ]
    asked = [
        keys.rollout("0"),
        keys.report("0"),
        keys.ctl("learner", "0"),
        keys.ctl("actor", "0"),
        keys.policy(),
    ]
    while True:
        payload = dice.randbytes(dice.choice((0, 1, 100, 5_000, LARGEST)))
        session.put(dice.choice(told), payload)
        session.get(dice.choice(asked), lambda reply: None, payload=payload, timeout=1.0)
        time.sleep(0.001)


PEERS: Final[Mapping[str, Callable[..., None]]] = {
    "hung_reader": hung_reader,
    "garbage": garbage,
}

if __name__ == "__main__":
    PEERS[sys.argv[1]](*sys.argv[2:])
