"""Following a run by its heartbeats."""

import logging
from typing import Final

from common.comms.budgets import one_line
from common.comms.codec import DecodeError, decode
from common.comms.keys import KeyPartError, Keys
from common.comms.messages import Status
from common.comms.transport import Transport
from common.service.member import RefusalLog
from deploy.panel import STALE_S, View, clock, time_left_s, written

log = logging.getLogger(__name__)

LINE_INTERVAL_S: Final = 15.0  # between progress lines when there is no terminal


class Watcher:
    """Follows the heartbeats of a run, and logs lines of progress.

    Args:
        view: Updated; a panel shows it.
        transport: Connection to the hub.
    """

    def __init__(self, view: View, transport: Transport) -> None:
        self._view, self._keys = view, Keys(view.run)
        self._statuses = transport.subscribe(self._keys.every_status(), capacity=4096)
        self._refusals = RefusalLog()
        self._next_line = 0.0

    def look(self, now: float) -> None:
        """Read the heartbeats that have arrived."""
        for sample in self._statuses.poll():
            try:
                status = decode(sample.payload, Status)
                if sample.key != self._keys.status(status.role, status.id):
                    raise DecodeError(f"heartbeat of {status.role}/{status.id} on {sample.key}")
                self._view.hear(status, now)
            except (DecodeError, KeyPartError) as error:
                if line := self._refusals.line(one_line(str(error)), now):
                    log.warning("status refused reason=%s", line)

    def line(self, now: float) -> None:
        """Log a line of progress if one is due."""
        learner = self._view.statuses.get(("learner", "0"))
        if now < self._next_line or learner is None:
            return
        self._next_line = now + LINE_INTERVAL_S
        g, c = learner.gauges, learner.counters
        measured = self._view.statuses.get(("evaluator", "0"))
        evaluated = measured.gauges if measured else {}
        alive = sum(now - heard < STALE_S for heard in self._view.heard.values())
        log.info(
            "progress stage=%d frames=%d frames_per_s=%.0f catch=%s return=%s error=%s reward=%s lag=%s "
            "evaluation_catch=%s evaluation_return=%s alive=%d left=%s",
            g.get("stage", 0),
            c.get("frames", 0),
            g.get("frames_per_s", 0),
            written(g, "catch_rate", ".3f"),
            written(g, "return_rate", ".3f"),
            written(g, "target_error", ".2f"),
            written(g, "reward", ".1f"),
            written(g, "lag", ".2f"),
            written(evaluated, "catch_rate", ".3f"),
            written(evaluated, "return_rate", ".3f"),
            alive,
            clock(time_left_s(self._view)),
        )
