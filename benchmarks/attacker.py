"""A hostile peer: Zenoh itself, without the checks and filters of our transport, and messages that nothing checks."""

import dataclasses
import json
import os
import struct
import zlib
from dataclasses import dataclass, field
from typing import Any, Final

import msgpack
import numpy as np
import zenoh
from zenoh.handlers import Callback

from common.comms.budgets import BUDGETS, KIB
from common.comms.certificates import files_of
from common.comms.codec import MAGIC, encode
from common.comms.keys import ROLES, Keys
from common.comms.messages import ActorReport, Episodes, PolicySnapshot, Rollout
from common.comms.zenoh_config import Security, ZenohConfig, session_settings
from common.task.reward import TERMS

OWN: Final = "9"  # id of the hostile actor
NAME: Final = f"actor-{OWN}"
VICTIM: Final = "0"
ASK_S: Final = 5.0
OPEN_S: Final = 2.0


@dataclass(slots=True)
class Attacker:
    """A hostile peer."""

    session: zenoh.Session
    config: ZenohConfig
    keys: Keys
    policy: PolicySnapshot  # of the learner
    kept: list[Any] = field(default_factory=list)  # declarations that stand until the attack ends

    def ask(self, key: str, payload: bytes, times: int = 1) -> None:
        """Send a request again and again, without waiting for answers."""
        for _ in range(times):
            self.session.get(key, Callback(_ignore, indirect=False), payload=payload, timeout=ASK_S)

    def put(self, key: str, payload: bytes, times: int = 1) -> None:
        """Publish again and again."""
        for _ in range(times):
            self.session.put(key, payload)

    def everywhere(self, payload: bytes) -> None:
        """Send a payload in every way on every kind of key."""
        for key in self.all_keys():
            self.put(key, payload)
            self.ask(key, payload)

    def all_keys(self) -> tuple[str, ...]:
        """Return one key of each kind, for the own id and for the victim's."""
        keys, ids = self.keys, (OWN, VICTIM)
        return (
            *(keys.policy(), keys.stage(), keys.rally(0)),
            *(key for i in ids for key in (keys.rollout(i), keys.report(i))),
            *(key for role in ROLES for i in ids for key in (keys.ctl(role, i), keys.status(role, i))),
        )

    def rollout(self, steps: int = 4, envs: int = 4, **changes: Any) -> Rollout:
        """Return a rollout that the learner takes, except for ``changes``."""
        policy, size = self.policy, self.policy.obs_mean.size
        empty = np.zeros(0, np.float32)
        flags = np.zeros(0, bool)
        rollout = Rollout(
            run=policy.run,
            generation=policy.generation,
            version=policy.version,
            stage_number=policy.stage_number,
            actor=OWN,
            incarnation=1,
            sequence=0,
            training_hash=policy.training_hash,
            obs=np.zeros((steps, envs, size), np.float32),
            actions=np.zeros((steps, envs, 7), np.float32),
            log_mu=np.zeros((steps, envs), np.float32),
            rewards=np.zeros((steps, envs), np.float32),
            terminated=np.zeros((steps, envs), bool),
            truncated=np.zeros((steps, envs), bool),
            final_obs=np.zeros((0, size), np.float32),
            final_index=np.zeros(0, np.int32),
            last_obs=np.zeros((envs, size), np.float32),
            episodes=Episodes(np.zeros(0, np.uint8), empty, flags, flags, flags, flags, empty),
            reward_terms=np.zeros(len(TERMS), np.float32),
            corrections=np.zeros((steps, envs, 7), np.float32),
        )
        return dataclasses.replace(rollout, **changes)

    def report(self, **changes: Any) -> ActorReport:
        """Return the report of an actor that waits for credits."""
        report = ActorReport(
            *(self.policy.run, OWN, 1, 0, 0, (), (), 0, ()),
            leaving=False,
            training_hash=self.policy.training_hash,
        )
        return dataclasses.replace(report, **changes)


def _ignore(_reply: zenoh.Reply) -> None:
    """Take no notice of an answer."""


def sealed(body: bytes) -> bytes:
    """Return the bytes of a message with any body."""
    return struct.pack("<4sII", MAGIC, zlib.crc32(body), len(body)) + body


def raw(kind: type, **fields: Any) -> bytes:
    """Return a message of a kind with any fields."""
    version: int = getattr(kind, "VERSION")  # noqa: B009 - a class variable of every message
    return sealed(msgpack.packb([kind.__name__, version, fields]))


def over(kind: type) -> bytes:
    """Return random bytes, a little more than a kind of message may have."""
    return os.urandom(BUDGETS[kind.__name__].bytes + KIB)


def nested(depth: int) -> bytes:
    """Return an array in an array in an array ..."""
    return sealed(b"\x91" * depth + b"\x90")


def wrong_types(kind: type) -> bytes:
    """Return a message whose every field is a list of an empty map."""
    return raw(kind, **{slot.name: [{}] for slot in dataclasses.fields(kind)})


def status_fields() -> dict[str, Any]:
    """Return the fields of a heartbeat as they are packed."""
    return {
        "role": "actor",
        "id": OWN,
        "incarnation": 1,
        "time": 0.0,
        "state": "x",
        "counters": {},
        "gauges": {},
    }


def fields_of(message: Any, **changes: Any) -> dict[str, Any]:
    """Return the fields of a message as they are packed, with any values in their place."""
    fields: dict[str, Any] = msgpack.unpackb(encode(message)[12:])[2]
    return fields | changes


def open_session(
    config: ZenohConfig, name: str = "", attempt_s: float = OPEN_S, **changes: object
) -> zenoh.Session:
    """Return a raw session.

    Args:
        config: Where the hub is.
        name: Of its certificate, with TLS; it is not checked before.
        attempt_s: Longest time to connect [s].
        changes: Zenoh's settings of ``transport/link/tls`` to replace; None removes one.

    Raises:
        zenoh.ZError: There is no link.
    """
    security = Security(files_of(config.tls, name)) if config.tls else None
    settings = session_settings(config, attempt_s, security)
    if changes:
        tls = settings["transport/link/tls"] | changes
        settings["transport/link/tls"] = {key: value for key, value in tls.items() if value is not None}
    own = zenoh.Config()
    for path, value in settings.items():
        own.insert_json5(path, json.dumps(value))
    return zenoh.open(own)
