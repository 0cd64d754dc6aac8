"""The actor's shell: receives policies and rallies, plays, and sends rollouts until each has its verdict."""

import logging
import os
import time
from threading import Event
from typing import Final

from common.comms.transport import Transport
from common.errors import ReportedError
from common.service.history import History
from common.service.member import Member
from common.service.metrics import Metrics
from common.task.counter_rng import Stream, bits
from services.actor import outbox as box
from services.actor.config import IDLE_WAIT_S, ActorConfig
from services.actor.delivery import Delivery
from services.actor.following import no_learner
from services.actor.player import Player
from services.actor.policy_feed import PolicyFeed
from services.actor.rally_buffer import RallyBuffer
from services.actor.rally_feed import RallyFeed, StopRequested

log = logging.getLogger(__name__)

MOST_REASONS: Final = 16  # of waiting, that the log names while an actor is idle


class LifeEndedError(ReportedError):
    """The learner has closed this life's account, such as after a day without a link: only a new life is heard."""


class ActorService:
    """One actor.

    Args:
        config: Settings.
        transport: Connection to the hub.
        metrics: Receives the service's numbers.
        incarnation: Number of this life of the service.
    """

    def __init__(self, config: ActorConfig, transport: Transport, metrics: Metrics, incarnation: int) -> None:
        self._config, self._transport, self._metrics = config, transport, metrics
        self._member = Member("actor", config, transport, metrics, incarnation)
        self._history = History(config.history, f"actor-{config.id}")
        self._history.note("start", actor=config.id, incarnation=incarnation, process=os.getpid())
        self._stop = Event()
        self._feed = RallyFeed(config, transport, self._member, self._is_stopping)
        seed = int(bits(config.seed, Stream.RESET, config.number)) >> 1
        envs = config.env_count
        self._buffer = RallyBuffer(envs, config.task, seed, self._refill)
        self._player = Player(
            config.task,
            config.experience,
            config.network,
            self._buffer,
            envs,
            config.horizon,
            seed,
            note=self._buffer.note,
        )
        self._policies = PolicyFeed(config, transport, self._member, self._player, self._history, metrics)
        self._delivery = Delivery(
            config, transport, self._member, self._player, self._policies, self._history, metrics
        )
        self._ready: float | None = None  # [s] time of the first policy
        self._frames = 0
        self._rally_gaps = 0  # batches that were lost on their way
        self._idle_since: float | None = None
        self._told: set[str] = set()  # what it waits for, said since it is idle
        self._member.join()

    @property
    def state(self) -> str:
        """State in the heartbeat: waiting, playing or draining."""
        return self._member.state

    @property
    def counts(self) -> box.Counts:
        """The actor's side of the ledger."""
        return self._delivery.outbox.counts

    @property
    def frames(self) -> int:
        """Control steps played, over all environments."""
        return self._frames

    @property
    def drained(self) -> bool:
        """Whether a drain was requested and every rollout has its verdict."""
        return self._member.is_draining and not self._delivery.outbox.flights

    def step(self, now: float) -> float:
        """Do what is due, play one rollout if the learner needs one, and return how long to wait [s].

        Raises:
            LifeEndedError: The learner hears only a new life of this actor.
        """
        self._member.answer_control()
        self._member.note_link(now)
        delivery = self._delivery
        has_come = self._policies.note_learners()
        if self._policies.take(now, delivery.outbox) or has_come:
            # The learner needs new rollouts of a new version
            delivery.report_at_once()
        delivery.take_verdicts(now)
        if delivery.life_ended:
            raise LifeEndedError(delivery.life_ended)
        delivery.drop_old(now)
        delivery.send(now)
        reason = self._idle_reason(now)
        if not reason:
            self._idle_since = None
            self._member.state = "playing"
            self._play()
            delivery.send(time.monotonic())
        else:
            self._wait_for(reason, now)
        if self._member.is_due(now):
            self._beat()
        return IDLE_WAIT_S if reason else 0.0

    def run(self, stop: Event) -> None:
        """Work until ``stop`` is set or a drain is done, then send the last report."""
        self._stop = stop
        try:
            while not stop.is_set() and not self.drained:
                wait = self.step(time.monotonic())
                if wait > 0:
                    self._transport.wait(wait)
        except StopRequested:
            log.info("stopped within a rollout, which is not sent")
        except LifeEndedError:
            self.leave()
            raise
        self.leave()

    def leave(self) -> None:
        """Wait up to 2 s for a verdict on every rollout, and report to the learner that no more rollouts follow."""
        self._delivery.end()
        self._beat()
        self._member.leave()
        self._history.note("end", in_flight=[flight.sequence for flight in self._delivery.outbox.flights])
        self._history.close()

    # ---- what to do

    def _idle_reason(self, now: float) -> str:
        snapshot = self._player.snapshot
        if self._member.is_draining:
            return "the last verdicts"
        if not self._transport.connected:
            return f"the link to the hub at {self._config.endpoint}"
        if not self._policies.has_learner:
            return no_learner(self._config.run, bool(self._config.tls))
        if snapshot is None:
            return self._policies.misfit or f"a policy from the learner on {self._member.keys.policy()}"
        self._ready = now if self._ready is None else self._ready
        is_patient = self._feed.asks or now - self._ready < self._config.rally_wait_s
        if (
            self._frames == 0 and is_patient and self._buffer.room > 0
        ):  # start with a full stock of valid rallies
            self._refill()
            if self._buffer.room > 0:
                return f"rallies of shard {self._feed.shard} from a generator"
        reason = box.idle_reason(self._delivery.outbox, snapshot.generation, snapshot.version)
        return (self._policies.misfit or reason) if reason else ""

    def _play(self) -> None:
        rollout = self._player.play(
            self._config.id, self._member.incarnation, self._delivery.outbox.next_sequence
        )
        played = time.monotonic()
        self._history.note(
            "played", number=rollout.sequence, generation=rollout.generation, version=rollout.version
        )
        self._delivery.offer(rollout, played)
        self._frames += rollout.rewards.size
        self._metrics.inc("topspin_frames_total", rollout.rewards.size)
        self._metrics.inc("topspin_episodes_total", len(rollout.episodes.outcome))
        for phase, seconds in rollout.seconds.items():
            self._metrics.inc("topspin_phase_seconds_total", seconds, phase=phase)
        self._metrics.inc("topspin_phase_seconds_total", time.monotonic() - played, phase="encode")
        self._feed.note_underruns(self._buffer)

    def _is_stopping(self) -> bool:
        return self._stop.is_set()

    def _refill(self) -> None:
        self._feed.refill(self._buffer)

    def _wait_for(self, reason: str, now: float) -> None:
        self._member.state = "draining" if self._member.is_draining else "waiting"
        if self._idle_since is None:
            self._idle_since = now
            self._told.clear()
        is_news = reason not in self._told and len(self._told) < MOST_REASONS
        if is_news and now - self._idle_since > self._config.silence_warning_s:
            self._told.add(reason)
            log.warning("waiting for=%r seconds=%.0f", reason, now - self._idle_since)
        self._delivery.report_if_due(now)

    # ---- numbers

    def _beat(self) -> None:
        counts, rallies = self.counts, self._buffer.counts
        snapshot = self._player.snapshot
        m = self._metrics
        m.set("topspin_rollouts_in_flight", counts.in_flight)
        m.set("topspin_rally_buffer_depth", len(self._buffer))
        m.follow("topspin_rallies_consumed_total", rallies.consumed)
        m.follow("topspin_rally_underruns_total", rallies.underruns)
        # A batch that this actor's own mailbox let go is seen as a gap later
        self._rally_gaps = max(self._rally_gaps, rallies.gaps - self._feed.unneeded)
        m.follow("topspin_rally_gaps_total", self._rally_gaps)
        m.follow("topspin_rollouts_given_up_total", counts.dropped)
        counters = {
            "frames": self._frames,
            "published": counts.published,
            "accepted": counts.accepted,
            "refused": sum(counts.refused.values()),
            "dropped": counts.dropped,
            "rallies_received": rallies.received,
            "rallies_consumed": rallies.consumed,
            "rallies_overflowed": rallies.overflowed,
            "rally_underruns": rallies.underruns,
            "rally_gaps": self._rally_gaps,
        }
        gauges = {
            "in_flight": counts.in_flight,
            "buffer": len(self._buffer),
            "version": snapshot.version if snapshot else -1,
            "stage": snapshot.stage if snapshot else 0,
        }
        self._member.beat(counters, gauges)
