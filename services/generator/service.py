"""The generator's shell: publishes batches of valid rallies at a bounded rate, and answers requests by index."""

import logging
import time
from threading import Event
from typing import Final

from common.comms.codec import DecodeError, decode, encode
from common.comms.messages import RallyBatch, RallyRequest
from common.comms.transport import Flow, Request, Transport
from common.service.member import Member
from common.service.metrics import Metrics
from common.task.launch import draw_rallies
from services.generator.config import GeneratorConfig
from services.generator.pace import Pace, shards_of

log = logging.getLogger(__name__)

IDLE_WAIT_S: Final = 0.2  # without subscribers
LIVE_BLOCKS: Final = 2**20  # block numbers for the published stream of one incarnation


class GeneratorService:
    """One generator.

    Args:
        config: Settings.
        transport: Connection to the hub.
        metrics: Receives the service's numbers.
        incarnation: Number of this life of the service. Published streams of different lives share no rally.
    """

    def __init__(
        self, config: GeneratorConfig, transport: Transport, metrics: Metrics, incarnation: int
    ) -> None:
        self._config, self._transport, self._metrics = config, transport, metrics
        self._member = Member("generator", config, transport, metrics, incarnation)
        self._member.state = "idle"
        self._shards = shards_of(config.index, config.generators, config.shard_count)
        keys = self._member.keys
        self._requests = [transport.serve(keys.rally(shard), capacity=64) for shard in self._shards]
        self._member.watch("request", *self._requests)
        self._pace = {shard: Pace(config.rate_hz, config.batch) for shard in self._shards}
        self._sequence = dict.fromkeys(self._shards, 0)
        self._drawn = self._valid = self._published = 0
        self._member.join()

    @property
    def state(self) -> str:
        """State in the heartbeat: idle or publishing."""
        return self._member.state

    def step(self, now: float) -> float:
        """Answer, publish what is due, and return how long to wait [s]."""
        self._answer()
        self._member.note_link(now)
        wait = IDLE_WAIT_S
        self._member.state = "idle"
        for shard in self._shards:
            if not self._transport.matching(self._member.keys.rally(shard), Flow.RALLY):
                self._pace[shard].idle(now)
                continue
            self._member.state = "publishing"
            if self._pace[shard].due(now):
                self._publish(shard)
            wait = min(wait, self._pace[shard].wait(now))
        if self._member.is_due(now):
            counters = {"published": self._published, "drawn": self._drawn, "valid": self._valid}
            self._member.beat(counters, {})
        return wait

    def run(self, stop: Event) -> None:
        """Work until ``stop`` is set or a drain is requested."""
        task = self._config.task
        log.info(
            "generating launch=%s randomization=%s shards=%s", task.launch, task.randomization, self._shards
        )
        while not stop.is_set() and not self._member.is_draining:
            wait = self.step(time.monotonic())
            if wait > 0:
                self._transport.wait(wait)
        self._member.leave()

    def _answer(self) -> None:
        for server in self._requests:
            while (request := server.poll()) is not None:
                try:
                    wanted = decode(request.payload, RallyRequest)
                except DecodeError as error:
                    self._refuse(request, error)
                    continue
                if wanted.shard not in self._shards:
                    self._refuse(request, f"shard {wanted.shard}; allowed: {self._shards}")
                    continue
                request.reply(encode(self._batch(wanted.shard, wanted.block, wanted.block)))
        self._member.answer_control()

    def _refuse(self, request: Request, reason: object) -> None:
        self._member.refuse("request", f"key={request.key} {reason}")
        request.refuse()

    def _publish(self, shard: int) -> None:
        sequence = self._sequence[shard]
        self._sequence[shard] = sequence + 1
        batch = self._batch(shard, self._member.incarnation * LIVE_BLOCKS % 2**62 + sequence, sequence)
        self._transport.publish(self._member.keys.rally(shard), encode(batch), Flow.RALLY)
        self._published += len(batch.seeds)
        self._metrics.inc("topspin_rallies_published_total", len(batch.seeds))

    def _batch(self, shard: int, block: int, sequence: int) -> RallyBatch:
        config, task = self._config, self._config.task
        rallies = draw_rallies(config.batch, task, seed=config.seed, shard=shard, block=block)
        self._drawn += rallies.drawn
        self._valid += len(rallies.seeds)
        self._metrics.inc("topspin_rallies_drawn_total", rallies.drawn)
        self._metrics.inc("topspin_rallies_valid_total", len(rallies.seeds))
        self._metrics.set("topspin_rallies_valid_share", self._valid / self._drawn)
        return RallyBatch(
            source=config.id,
            incarnation=self._member.incarnation,
            sequence=sequence,
            shard=shard,
            block=block,
            rallies=rallies.launches,
            seeds=rallies.seeds,
            candidates=rallies.drawn,
            launch=task.launch,
            randomization=task.randomization,
        )
