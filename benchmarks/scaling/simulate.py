"""A training run in virtual time: the program's own pacing, with measured costs in place of the work.

Outbox, intake with its credits, and the turns of a group are the real ones: an actor here plays when the real one would
play, and its rollout gets the verdict that the real one would get. Only the work is a number, and the network a delay.

The hub forwards one message after the other on a thread of its own. A learner serves its actors between rollouts that
it reads and between gradient steps, as the real one does.
"""

from collections import deque
from collections.abc import Generator
from dataclasses import dataclass, field
from functools import partial
from typing import Final, cast

import numpy as np

from benchmarks.scaling.costs import Costs, Network, gather_s, sum_s
from benchmarks.scaling.hub import Hub
from benchmarks.scaling.machine import Machine, Process, Script, Wait, Work
from benchmarks.scaling.plan import Plan, available_cores
from common.comms.keys import rank_of
from common.comms.messages import ActorReport, Rollout, Verdict
from common.errors import ReportedError
from services.actor import outbox as box
from services.actor.config import OutboxConfig
from services.learner.admission import Header, LearnerState
from services.learner.config import IntakeConfig
from services.learner.intake import Intake, Queued
from services.learner.turns import Rank, parts, taken

# Pauses of services whose modules import torch; a test compares them
REPORT_INTERVAL_S: Final = 0.25  # services.actor.delivery
TURN_WAIT_S: Final = 0.02  # services.learner.service
RECOUNT_S: Final = 0.5  # services.learner.lockstep

ROW_BYTES: Final = 8.0 * 9  # of a rank in a turn
# Exchanges of an epoch that carry few numbers: the leader's decision about a checkpoint. Each pass has one more.
SMALL_EXCHANGES: Final = 1
VALUE_BYTES: Final = 8.0  # value and advantage of a frame, which every rank gets of all frames
LONGEST_S: Final = 600.0  # virtual time without a dataset after which the run hangs

RUN, HASH, LIFE = "run", "hash", 1
CONTENT: Final = cast(Rollout, "content")  # the intake reads no array of a rollout


@dataclass(frozen=True, slots=True)
class Result:
    """What a run does once it is under way."""

    frames_per_s: float
    actor_busy: float  # share of the time in which an actor has work; mean over actors
    learner_busy: (
        float  # share of the time in which the leading learner trains, and does not wait for rollouts
    )
    exchange: float  # share of the time in which all learners wait for numbers under way
    hub_busy: float  # share of the time in which the hub has work
    cores_used: float  # by learners, actors and the hub
    lag: float  # versions, mean over rollouts
    refused: int  # rollouts that were not accepted, or lost
    datasets: int  # that were measured


@dataclass(slots=True, eq=False)
class _Actor:
    name: str
    rank: int
    outbox: box.Outbox = field(default_factory=lambda: box.Outbox(OutboxConfig()))
    version: int = -1  # that it plays
    newest: int = -1  # that has arrived
    answers: deque[tuple[int, Verdict]] = field(
        default_factory=deque
    )  # by number of the rollout; -1: a report
    is_reporting: bool = False
    next_report: float = 0.0  # [s]
    report_after_s: float = REPORT_INTERVAL_S
    process: Process | None = None


@dataclass(slots=True, eq=False)
class _Learner:
    number: int
    intake: Intake
    mail: deque[tuple[_Actor, Header | ActorReport]] = field(default_factory=deque)
    counted: tuple[int, int] = (0, 0)
    next_count: float = 0.0  # [s]
    process: Process | None = None


@dataclass(slots=True, eq=False)
class _Meeting:
    """Ranks that wait for each other."""

    rows: dict[int, Rank] = field(default_factory=dict)
    came: int = 0
    is_over: bool = False


def simulate(
    plan: Plan, costs: Costs, network: Network | None = None, warm_up: int = 8, datasets: int = 24
) -> Result:
    """Return what a run does after its first ``warm_up`` datasets, over the next ``datasets``."""
    return _Run(plan, costs, network or Network()).measured(warm_up, datasets)


def _state(version: int) -> LearnerState:
    return LearnerState(RUN, 1, version, 0, 3, HASH)


class _Run:
    def __init__(self, plan: Plan, costs: Costs, network: Network) -> None:
        self.plan, self.costs, self.network = plan, costs, network
        self.machine = Machine(available_cores(plan, costs), costs.slowdown)
        self.hub = Hub(self.machine, network, network.remote_share(plan.cores), costs.latency_s)
        self.bytes = costs.rollout.of(plan.rollout)
        intake = IntakeConfig().for_actors(plan.actors)
        self.learners = [_Learner(rank, Intake(intake, _state(0))) for rank in range(plan.learners)]
        self.actors = [_Actor(str(i), rank_of(str(i), plan.learners)) for i in range(plan.actors)]
        self.meeting = _Meeting()
        self.finished: list[tuple[float, int]] = []  # [s], frames of each dataset
        self.lags: list[float] = []
        self.training = self.exchanging = 0.0  # [s]
        self.refused = 0
        for learner in self.learners:
            learner.process = self.machine.start(self._learner(learner))
        for actor in self.actors:
            actor.process = self.machine.start(self._actor(actor))

    def measured(self, warm_up: int, datasets: int) -> Result:
        self._until(warm_up)
        start, before, refused = self.machine.now, self._busy(), self.refused
        training, exchanging, used = self.training, self.exchanging, self.machine.used
        self._until(warm_up + datasets)
        span = self.machine.now - start
        playing, hub = (now - then for now, then in zip(self._busy(), before, strict=True))
        return Result(
            frames_per_s=sum(frames for _, frames in self.finished[warm_up:]) / span,
            actor_busy=playing / span / self.plan.actors,
            learner_busy=(self.training - training) / span,
            exchange=(self.exchanging - exchanging) / span,
            hub_busy=hub / span,
            cores_used=(self.machine.used - used) / span,
            lag=float(np.mean(self.lags[warm_up:])),
            refused=self.refused - refused,
            datasets=datasets,
        )

    def _until(self, datasets: int) -> None:
        def is_over() -> bool:
            newest = self.finished[-1][0] if self.finished else 0.0
            if self.machine.now - newest > LONGEST_S:
                raise ReportedError(
                    f"{self.plan} trains nothing: a dataset takes more than {LONGEST_S:.0f} s"
                )
            return len(self.finished) >= datasets

        self.machine.run(is_over)

    def _busy(self) -> tuple[float, float]:
        now = self.machine.now
        playing = sum(actor.process.busy(now) for actor in self.actors if actor.process)
        return playing, self.hub.busy

    # ---- messages

    def _to_learner(self, actor: _Actor, content: Header | ActorReport) -> None:
        """Send a rollout or a report to the actor's learner; the hub sends it on where that is another process."""
        learner = self.learners[actor.rank]
        size = self.bytes if isinstance(content, Header) else 0.0
        onward = size * self.costs.hub_policy_byte_s if learner.number else 0.0

        def delivered() -> None:
            learner.mail.append((actor, content))
            self._wake(learner)

        self.hub.takes(size, self.costs.hub.of(size) + onward, delivered)

    def _answer(self, actor: _Actor, number: int, verdict: Verdict) -> None:
        def delivered() -> None:
            actor.answers.append((number, verdict))
            self._wake(actor)

        self.hub.later(delivered)

    def _publish(self, version: int) -> None:
        size = self.costs.policy_bytes
        for actor in self.actors:
            self.hub.sends(size, size * self.costs.hub_policy_byte_s, partial(self._adopt, actor, version))

    def _adopt(self, actor: _Actor, version: int) -> None:
        actor.newest = version
        self._wake(actor)

    def _wake(self, one: _Actor | _Learner) -> None:
        if one.process is not None:
            self.machine.wake(one.process)

    # ---- actors (services.actor.service, .policy_feed, .delivery)

    def _actor(self, actor: _Actor) -> Script:
        play = self.costs.playing(self.plan.envs) + self.costs.send.of(self.bytes)
        while True:
            while actor.version < actor.newest:
                newest = actor.newest
                yield Work(self.costs.adopt_s)
                actor.version, actor.next_report = newest, 0.0
            self._take_answers(actor)
            now = self.machine.now
            if actor.version >= 0 and not box.idle_reason(actor.outbox, 1, actor.version):
                version, number = actor.version, actor.outbox.next_sequence
                yield Work(play)
                now = self.machine.now
                actor.outbox = box.sent(box.offer(actor.outbox, b"", now), number)
                self._to_learner(actor, Header(RUN, 1, version, 0, actor.name, LIFE, number, HASH))
                continue
            if actor.version >= 0 and not actor.is_reporting and now >= actor.next_report:
                self._report(actor)
            if actor.version >= actor.newest and not actor.answers:
                yield Wait() if actor.is_reporting or actor.version < 0 else Wait(actor.next_report)

    def _take_answers(self, actor: _Actor) -> None:
        while actor.answers:
            number, verdict = actor.answers.popleft()
            if number >= 0:
                actor.outbox = box.answered(actor.outbox, number, verdict, self.machine.now)
            else:
                actor.is_reporting = False
                actor.outbox = box.credited(actor.outbox, verdict)
                actor.report_after_s = verdict.report_after_s

    def _report(self, actor: _Actor) -> None:
        told = box.report(
            actor.outbox,
            run=RUN,
            actor=actor.name,
            incarnation=LIFE,
            version=actor.version,
            training_hash=HASH,
        )
        actor.is_reporting = True
        actor.next_report = self.machine.now + actor.report_after_s
        self._to_learner(actor, told)

    # ---- learners (services.learner.service, follower, lockstep)

    def _learner(self, learner: _Learner) -> Script:
        if learner.number == 0:
            self._publish(0)
        while True:
            yield from self._serve(learner)
            dataset = yield from self._turn(learner)
            if dataset is not None:
                yield from self._epoch(learner, dataset)
            elif not learner.mail:
                is_alone = self.plan.learners == 1
                yield Wait() if is_alone else Wait(self.machine.now + TURN_WAIT_S)

    def _serve(self, learner: _Learner) -> Script:
        for _ in range(len(learner.mail)):
            actor, content = learner.mail.popleft()
            if isinstance(content, ActorReport):
                self._answer(actor, -1, learner.intake.report(content, self.machine.now))
                continue
            yield Work(self.costs.opening.of(self.plan.rollout))
            verdict = learner.intake.arrive(content, CONTENT, self.machine.now)
            self.refused += verdict.kind.value != "accepted"
            self._answer(actor, content.sequence, verdict)

    def _turn(self, learner: _Learner) -> Generator[Work | Wait, None, tuple[Queued, ...] | None]:
        """Return this rank's rollouts of the next dataset, or None: too few wait."""
        intake, now, plan = learner.intake, self.machine.now, self.plan
        if now >= learner.next_count:
            learner.counted, learner.next_count = intake.contributors(now), now + RECOUNT_S
        meeting = self.meeting
        meeting.rows[learner.number] = Rank(intake.queued, *learner.counted, 0)
        seconds = gather_s(self.costs, self.network, plan.learners, plan.learners * ROW_BYTES)
        yield from self._meet(learner, seconds, serves=True)
        ranks = [meeting.rows[number] for number in range(plan.learners)]
        intake.part = parts(ranks, plan.actors)[learner.number]
        counts = taken(ranks, plan.actors)
        return intake.take(counts[learner.number]) if any(counts) else None

    def _epoch(self, learner: _Learner, dataset: tuple[Queued, ...]) -> Script:
        costs, plan, started = self.costs, self.plan, self.machine.now
        on_cores = not plan.learner_frames_per_s
        for _ in dataset:
            yield Work(costs.reading.of(plan.rollout) if on_cores else 0.0)
            yield from self._serve(learner)
        small = gather_s(costs, self.network, plan.learners, 0.0)
        values = gather_s(costs, self.network, plan.learners, plan.dataset * VALUE_BYTES)
        yield from self._meet(learner, (SMALL_EXCHANGES + plan.passes) * small + values)
        steps = plan.passes * plan.steps
        rows = plan.passes * len(dataset) * plan.rollout / steps
        step = costs.step.of(rows) + costs.whole_frame_s * plan.dataset / steps
        if not on_cores:
            step = plan.dataset / plan.learner_frames_per_s / steps
        summing = sum_s(costs, self.network, plan.learners, costs.gradient_bytes)
        for _ in range(steps):
            yield Work(step)
            yield from self._meet(learner, summing)
            yield from self._serve(learner)
        version = learner.intake.learner.version
        if learner.number == 0:
            yield Work(costs.publish_s)
            self._note(dataset, version, started)
        self.refused += len(learner.intake.finish_update(_state(version + 1)))
        if learner.number == 0:
            self._publish(version + 1)

    def _note(self, dataset: tuple[Queued, ...], version: int, started: float) -> None:
        self.finished.append((self.machine.now, self.plan.dataset))
        self.training += self.machine.now - started
        self.lags.append(
            float(np.mean([version - entry.header.version for entry in dataset])) if dataset else 0.0
        )

    def _meet(self, learner: _Learner, seconds: float, serves: bool = False) -> Script:
        """Wait until all ranks have come, and ``seconds`` more [s]."""
        if self.plan.learners == 1:
            return
        meeting = self.meeting
        meeting.came += 1
        if meeting.came == self.plan.learners:
            self.meeting = _Meeting()
            self.exchanging += seconds

            def over() -> None:
                meeting.is_over = True
                for one in self.learners:
                    self._wake(one)

            self.machine.at(self.machine.now + seconds, over)
        while not meeting.is_over:
            if serves and learner.mail:
                yield from self._serve(learner)
            else:
                yield Wait()
