"""`python -m benchmarks.chaos.peers KIND RUN ENDPOINT [LISTEN]`: a bad peer, or a router, as a process of its own."""

import json
import os
import random
import signal
import sys
import time
from collections.abc import Callable, Mapping
from typing import Final

import zenoh

from common.comms.keys import Keys
from common.comms.transport import Flow
from common.comms.zenoh_config import ZenohConfig
from common.comms.zenoh_transport import open_zenoh

REQUESTS = 100
LARGEST = 65_536  # bytes of garbage


def hung_reader(run: str, endpoint: str) -> None:
    """Ask for many policies, and hang."""
    transport = open_zenoh(ZenohConfig(endpoint=endpoint))
    asked = [transport.request(Keys(run).policy(), b"", 60.0, Flow.POLICY) for _ in range(REQUESTS)]
    time.sleep(0.2)
    os.kill(os.getpid(), signal.SIGSTOP)
    print(len(asked))


def garbage(run: str, endpoint: str) -> None:
    """Publish on every key, and ask on every key, with bytes that are no messages."""
    keys = Keys(run)
    dice = random.Random(os.getpid())
    session = zenoh.open(client(endpoint))
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


def router(run: str, endpoint: str, listen: str) -> None:
    """Be a router between clients and the hub."""
    settings = {
        "mode": "router",
        "listen/endpoints": [listen],
        "connect/endpoints": [endpoint],
        "connect/exit_on_failure": False,
        "connect/timeout_ms": -1,
        "connect/retry": {"period_init_ms": 200, "period_max_ms": 1000, "period_increase_factor": 1.5},
        "scouting/multicast/enabled": False,
        "scouting/gossip/enabled": False,
        "transport/link/tx/lease": 3000,
    }
    with zenoh.open(configured(settings)):
        signal.pause()


def client(endpoint: str) -> zenoh.Config:
    """Return the settings of a plain client."""
    return configured(
        {"mode": "client", "connect/endpoints": [endpoint], "scouting/multicast/enabled": False}
    )


def configured(settings: dict[str, object]) -> zenoh.Config:
    """Return Zenoh's configuration with these settings."""
    config = zenoh.Config()
    for path, value in settings.items():
        config.insert_json5(path, json.dumps(value))
    return config


PEERS: Final[Mapping[str, Callable[..., None]]] = {
    "hung_reader": hung_reader,
    "garbage": garbage,
    "router": router,
}

if __name__ == "__main__":
    PEERS[sys.argv[1]](*sys.argv[2:])
