"""The generator's shell: publishes batches of valid rallies at a bounded rate, and answers requests by index."""

import logging
import time
from threading import Event

from common.comms.codec import DecodeError, decode, encode
from common.comms.keys import Keys
from common.comms.messages import Command, Control, ControlReply, RallyBatch, RallyRequest, Status
from common.comms.transport import Flow, Request, Transport
from common.metrics import Metrics
from common.physics.flight import FULL, SIMPLE
from common.rally.launch import draw_rallies
from services.generator.config import GeneratorConfig
from services.generator.pace import Pace, shards_of

log = logging.getLogger(__name__)

IDLE_WAIT_S = 0.2  # with nobody subscribed
LIVE_BLOCKS = 2**20  # blocks a published stream of one incarnation may number


class GeneratorService:
    """One generator.

    Args:
        config: Settings.
        transport: Connection to the hub.
        metrics: Where its numbers go.
        incarnation: Of this life: published streams of different lives share no rally.
    """

    def __init__(
        self, config: GeneratorConfig, transport: Transport, metrics: Metrics, incarnation: int
    ) -> None:
        self._config = config
        self._transport = transport
        self._metrics = metrics
        self._incarnation = incarnation
        keys = Keys(config.run)
        self._keys = keys
        self._shards = shards_of(config.index, config.of, config.shards)
        self._requests = [transport.serve(keys.rally(shard), capacity=64) for shard in self._shards]
        self._control = transport.serve(keys.ctl("generator", config.id), capacity=16)
        self._alive = transport.declare_alive(keys.alive("generator", config.id, incarnation))
        self._pace = {shard: Pace(config.rate_hz, config.batch) for shard in self._shards}
        self._sequence = dict.fromkeys(self._shards, 0)
        self._paused = self._stopping = False
        self._next_status = 0.0
        self._drawn = self._valid = self._published = 0
        self.state = "idle"

    def step(self, now: float) -> float:
        """Answer, publish what is due, and return how long there is nothing to do [s]."""
        self._answer()
        wait = IDLE_WAIT_S
        self.state = "paused" if self._paused else "idle"
        for shard in self._shards:
            if self._paused or not self._transport.matching(self._keys.rally(shard), Flow.RALLY):
                self._pace[shard].idle(now)
                continue
            self.state = "publishing"
            if self._pace[shard].due(now):
                self._publish(shard)
            wait = min(wait, self._pace[shard].wait(now))
        if now >= self._next_status:
            self._next_status = now + self._config.status_interval_s
            self._report()
        return wait

    def run(self, stop: Event) -> None:
        """Work until ``stop`` is set."""
        log.info(
            "generating launch=%s noise=%s shards=%s", self._config.launch, self._config.noise, self._shards
        )
        while not stop.is_set() and not self._stopping:
            wait = self.step(time.monotonic())
            if wait > 0:
                self._transport.wait(wait)
        self._alive.close()

    def _answer(self) -> None:
        for server in self._requests:
            while (request := server.poll()) is not None:
                try:
                    wanted = decode(request.payload, RallyRequest)
                except DecodeError as error:
                    self._refuse(request, error)
                    continue
                if wanted.shard not in self._shards:
                    self._refuse(request, f"shard {wanted.shard}; this generator serves {self._shards}")
                    continue
                request.reply(encode(self._batch(wanted.shard, wanted.block, wanted.block)))
        while (request := self._control.poll()) is not None:
            try:
                command = decode(request.payload, Control).command
            except DecodeError as error:
                self._refuse(request, error)
                continue
            self._paused = command is Command.PAUSE or (self._paused and command is not Command.RESUME)
            self._stopping |= command in (Command.STOP, Command.DRAIN)
            request.reply(encode(ControlReply(True, self.state, "")))

    def _refuse(self, request: Request, reason: object) -> None:
        log.warning("request refused key=%s reason=%s", request.key, reason)
        self._metrics.inc("topspin_messages_refused_total", 1.0, kind="request")
        request.refuse()

    def _publish(self, shard: int) -> None:
        sequence = self._sequence[shard]
        self._sequence[shard] = sequence + 1
        batch = self._batch(shard, self._incarnation * LIVE_BLOCKS % 2**62 + sequence, sequence)
        self._transport.publish(self._keys.rally(shard), encode(batch), Flow.RALLY)
        self._published += len(batch.seeds)
        self._metrics.inc("topspin_rallies_published_total", len(batch.seeds))

    def _batch(self, shard: int, block: int, sequence: int) -> RallyBatch:
        config = self._config
        rallies = draw_rallies(
            config.batch,
            seed=config.seed,
            shard=shard,
            block=block,
            preset=config.launch,
            noise=config.noise,
            model=SIMPLE if config.flight == "simple" else FULL,
        )
        self._drawn += rallies.drawn
        self._valid += len(rallies.seeds)
        self._metrics.inc("topspin_rallies_drawn_total", rallies.drawn)
        self._metrics.inc("topspin_rallies_valid_total", len(rallies.seeds))
        self._metrics.set("topspin_rallies_valid_share", self._valid / self._drawn)
        return RallyBatch(
            source=config.id,
            incarnation=self._incarnation,
            sequence=sequence,
            shard=shard,
            block=block,
            rallies=rallies.launches,
            seeds=rallies.seeds,
            candidates=rallies.drawn,
            preset=config.launch,
            noise=config.noise,
        )

    def _report(self) -> None:
        self._metrics.follow("topspin_reconnects_total", self._transport.reconnect_count)
        for name, mailboxes in (("request", self._requests), ("control", [self._control])):
            dropped = sum(mailbox.dropped for mailbox in mailboxes)
            self._metrics.follow("topspin_messages_dropped_total", dropped, key=name)
        status = Status(
            role="generator",
            id=self._config.id,
            incarnation=self._incarnation,
            time=time.time(),
            state=self.state,
            counters={
                "published": float(self._published),
                "drawn": float(self._drawn),
                "valid": float(self._valid),
            },
            gauges={},
        )
        self._transport.publish(self._keys.status("generator", self._config.id), encode(status), Flow.STATUS)
