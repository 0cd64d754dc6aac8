"""A service as a member of its run: liveliness token, heartbeat, control requests, refused messages.

Every service has one. The heartbeat is a `Status`. The token shows that the service is alive; it
disappears when the process ends.
"""

import logging
import math
import time
from collections.abc import Mapping
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Final, Protocol

from common.comms.budgets import one_line
from common.comms.codec import DecodeError, decode, encode
from common.comms.keys import Keys
from common.comms.messages import Command, Control, ControlReply, Status
from common.comms.transport import AliveToken, Flow, Transport
from common.service.metrics import Metrics
from common.service.settings import ServiceConfig

log = logging.getLogger(__name__)

LEARNER_ID: Final = "0"  # of the learner that keeps the run; others of its group are 1, 2, ...
REFUSED_KINDS: Final = MappingProxyType(
    {
        "learner": ("control", "alive", "contract", "join", "report", "rollout"),
        "actor": ("control", "alive", "policy", "rally", "stage", "verdict"),
        "generator": ("control", "request"),
        "evaluator": ("control", "policy"),
    }
)
"""What each role may refuse. Its counters begin at 0: from nothing to 1 is no rise for Prometheus."""
REFUSALS_LOGGED: Final = 20  # lines a minute for each kind of refused message; all are counted
CONTROL_MAILBOX: Final = 16  # commands that wait
ON_AN_OPEN_HUB: Final = "commands need TLS (--tls): on an open hub anybody could send them"


class Drops(Protocol):
    """A server or subscription that counts what it dropped."""

    @property
    def dropped(self) -> int:
        """Messages that a full mailbox dropped."""


@dataclass(slots=True)
class RefusalLog:
    """Which reasons of one kind of refused message have been logged in the last minute.

    A peer that sends many bad messages must not fill the log.
    """

    since: float = -math.inf  # [s] start of the minute
    logged: set[str] = field(default_factory=set)

    def line(self, reason: str, now: float) -> str:
        """Return what to log about a refusal, or ""."""
        if now - self.since >= 60.0:
            self.since = now
            self.logged.clear()
        if reason in self.logged or len(self.logged) >= REFUSALS_LOGGED:
            return ""
        self.logged.add(reason)
        if len(self.logged) == REFUSALS_LOGGED:
            return f"{reason}; further ones in this minute are only counted"
        return reason


class Member:
    """One life of a service.

    Args:
        role: generator, actor, learner or evaluator.
        config: Run, name, and time between heartbeats.
        transport: Connection to the hub.
        metrics: Receives the service's numbers.
        incarnation: Number of this life of the service.
        id: Name among those of its role; default: the config's.
    """

    def __init__(
        self,
        role: str,
        config: ServiceConfig,
        transport: Transport,
        metrics: Metrics,
        incarnation: int,
        *,
        id: str = "",
    ) -> None:
        self.role, self.id, self.incarnation = role, id or config.id, incarnation
        self.keys = Keys(config.run)
        self.state = "waiting"
        self.is_draining = False  # a drain was requested: finish the work in progress, then end
        self._transport, self._metrics = transport, metrics
        self._interval_s, self._next_status = config.status_interval_s, 0.0
        self._control = transport.serve(self.keys.ctl(role, self.id), capacity=CONTROL_MAILBOX)
        self._mailboxes: dict[str, tuple[Drops, ...]] = {"control": (self._control,)}
        self._token: AliveToken | None = None
        self._refusals: dict[str, RefusalLog] = {}
        self._link_lost: float | None = None  # [s]
        self._endpoint, self._takes_commands = config.endpoint, bool(config.tls)
        for kind in REFUSED_KINDS[role]:
            metrics.inc("topspin_messages_refused_total", 0.0, kind=kind)

    def join(self) -> None:
        """Declare the liveliness token: the service can answer now."""
        key = self.keys.alive(self.role, self.id, self.incarnation)
        self._token = self._transport.declare_alive(key)
        self._metrics.health.has_joined = True

    def watch(self, name: str, *mailboxes: Drops) -> None:
        """Count what these mailboxes drop under ``name``."""
        self._mailboxes[name] = mailboxes

    def answer_control(self) -> None:
        """Answer the commands that wait. Without TLS nobody knows who sent them, and they are refused."""
        self._metrics.health.turn()  # every main loop comes by here, also within an update or a match
        for request in self._control.waiting(CONTROL_MAILBOX):
            try:
                message = decode(request.payload, Control)
            except DecodeError as error:
                self.refuse("control", error)
                request.refuse()
                continue
            if not self._takes_commands:
                self.refuse("control", ON_AN_OPEN_HUB)
                request.reply(encode(ControlReply(False, self.state, ON_AN_OPEN_HUB)))
                continue
            self.is_draining |= message.command is Command.DRAIN
            log.info("command received command=%s", message.command.value)
            request.reply(encode(ControlReply(True, self.state, "")))

    def refuse(self, kind: str, reason: object) -> None:
        """Count a message that can't be used, and log the reason unless it was logged in the last minute."""
        self._metrics.inc("topspin_messages_refused_total", 1.0, kind=kind)
        text = one_line(str(reason))
        line = self._refusals.setdefault(kind, RefusalLog()).line(text, time.monotonic())
        if line:
            log.warning("message refused kind=%s reason=%s", kind, line)

    def note_link(self, now: float) -> None:
        """Log when the link to the hub is lost, and when it is back."""
        self._metrics.health.is_linked = self._transport.connected
        if self._transport.connected == (self._link_lost is None):
            return
        if self._link_lost is None:
            self._link_lost = now
            log.warning("link to the hub lost endpoint=%s", self._endpoint)
        else:
            log.info(
                "link to the hub is back endpoint=%s after_s=%.1f", self._endpoint, now - self._link_lost
            )
            self._link_lost = None

    def is_due(self, now: float) -> bool:
        """Return whether a heartbeat is due at ``now`` [s], and count it as sent if so."""
        if now < self._next_status:
            return False
        self._next_status = now + self._interval_s
        return True

    def beat(self, counters: Mapping[str, float], gauges: Mapping[str, float]) -> None:
        """Publish a heartbeat with these numbers; gauges that are not finite are left out."""
        self._metrics.set("topspin_heartbeat_time_seconds", time.time())
        self._metrics.follow("topspin_reconnects_total", self._transport.reconnect_count)
        for name, mailboxes in self._mailboxes.items():
            dropped = sum(mailbox.dropped for mailbox in mailboxes)
            self._metrics.follow("topspin_messages_dropped_total", dropped, key=name)
        numbers = {**gauges, "metrics_port": self._metrics.port} if self._metrics.port else gauges
        status = Status(
            role=self.role,
            id=self.id,
            incarnation=self.incarnation,
            time=time.time(),
            state=self.state,
            counters={name: float(value) for name, value in counters.items()},
            gauges={name: float(value) for name, value in numbers.items() if math.isfinite(value)},
        )
        self._transport.publish(self.keys.status(self.role, self.id), encode(status), Flow.STATUS)

    def leave(self) -> None:
        """Withdraw the liveliness token."""
        self._metrics.health.has_joined = False
        if self._token is not None:
            self._token.close()
