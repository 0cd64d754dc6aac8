"""Outbox and intake on a network that delays, repeats and loses messages, with actors and learners that die."""

import dataclasses
from collections import Counter
from collections.abc import Iterator

import pytest
from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, invariant, precondition, rule

from common.comms.messages import ActorReport, Verdict, VerdictKind
from services.actor import outbox as ob
from services.actor.config import OutboxConfig
from services.actor.outbox import Outbox
from services.learner.admission import Header, LearnerState
from services.learner.config import IntakeConfig
from services.learner.intake import Intake, Queued
from services.learner.ledger import AccountSnapshot, Ledger
from tests.unit.services.accounting import LEARNER_STATE, ROLLOUT, make_header, take_dataset

OUTBOX = OutboxConfig(retry_first_s=1.0, retry_max_s=4.0, give_up_s=30.0)
INTAKE = IntakeConfig(dataset_rollouts=2, max_lag=1, queue_rollouts=3)

Key = tuple[str, int, int]  # actor, incarnation, sequence


def key_of(header: Header) -> Key:
    return header.actor, header.incarnation, header.sequence


@dataclasses.dataclass
class Actor:
    """One life of an actor; ``headers`` represent its rollouts."""

    name: str
    incarnation: int
    outbox: Outbox = dataclasses.field(default_factory=lambda: Outbox(OUTBOX))
    headers: dict[int, Header] = dataclasses.field(default_factory=dict)
    accepted: set[int] = dataclasses.field(default_factory=set)

    def hear(self, sequence: int, verdict: Verdict, now: float) -> None:
        flying = {flight.sequence for flight in self.outbox.flights}
        before = self.outbox.accepted
        self.outbox = ob.answered(self.outbox, sequence, verdict, now)
        if self.outbox.accepted > before:
            assert sequence in flying
            assert sequence not in self.accepted
            self.accepted.add(sequence)

    def report(self) -> ActorReport:
        return ob.report(
            self.outbox,
            run="night",
            actor=self.name,
            incarnation=self.incarnation,
            version=0,
            training_hash=LEARNER_STATE.training_hash,
        )


@dataclasses.dataclass(frozen=True)
class Checkpoint:
    """A state that a learner can start from, and the true fates at that time."""

    learner: LearnerState
    accounts: tuple[AccountSnapshot, ...]
    trained: frozenset[Key]
    judged: dict[Key, VerdictKind]
    queue: tuple[Queued, ...] = ()  # kept at a planned stop


class World(RuleBasedStateMachine):
    def __init__(self) -> None:
        super().__init__()
        self.now = 0.0
        self.intake: Intake | None = Intake(INTAKE, LEARNER_STATE)
        self.generations = 1
        self.dataset: tuple[Queued, ...] = ()  # of the update that is running
        self.trained: set[Key] = set()  # by this learner and those it was restored from
        self.judged: dict[Key, VerdictKind] = {}  # final verdicts given, likewise
        self.checkpoint = Checkpoint(LEARNER_STATE, (), frozenset(), {})
        self.actors = [Actor("a", 1), Actor("b", 1)]
        self.dead: list[Actor] = []
        self.requests: list[tuple[Actor, int]] = []  # may be delivered late or twice
        self.replies: list[tuple[Actor, int, Verdict]] = []
        self.reports: list[ActorReport] = []
        self.out_of_sight: set[tuple[str, int]] = set()  # lives whose token is gone for this learner

    # ---- actors

    @rule(which=st.integers(0, 1), lag=st.integers(0, 3), stale=st.booleans())
    def publish(self, which: int, lag: int, stale: bool) -> None:
        actor = self.actors[which]
        if len(actor.outbox.flights) == OUTBOX.window:
            return
        learner = self.checkpoint.learner if self.intake is None else self.intake.learner
        sequence = actor.outbox.next_sequence
        actor.headers[sequence] = make_header(
            sequence,
            actor=actor.name,
            incarnation=actor.incarnation,
            generation=learner.generation,
            version=max(0, learner.version - lag),
            stage_number=learner.stage_number - stale,
        )
        actor.outbox = ob.offer(actor.outbox, b"", self.now)

    @rule(which=st.integers(0, 1), wait=st.floats(0, 10))
    def send(self, which: int, wait: float) -> None:
        self.now += wait
        actor = self.actors[which]
        for flight in ob.due(actor.outbox, self.now):
            actor.outbox = ob.sent(actor.outbox, flight.sequence)
            self.requests.append((actor, flight.sequence))

    @rule(which=st.integers(0, 1))
    def time_out(self, which: int) -> None:
        actor = self.actors[which]
        for flight in actor.outbox.flights:
            if flight.under_way:
                actor.outbox = ob.unanswered(actor.outbox, flight.sequence, self.now)

    @rule(which=st.integers(0, 1))
    def give_up(self, which: int) -> None:
        self.actors[which].outbox = ob.expired(self.actors[which].outbox, self.now)

    @rule(which=st.integers(0, 1), chance=st.integers(0, 3))
    def restart_actor(self, which: int, chance: int) -> None:
        if chance:
            return
        actor = self.actors[which]
        self.dead.append(actor)
        self.actors[which] = Actor(actor.name, actor.incarnation + 1)
        self.lose_token(actor)

    @rule(which=st.integers(0, 1))
    def cut_off(self, which: int) -> None:
        self.lose_token(self.actors[which])

    @rule(which=st.integers(0, 1))
    def return_token(self, which: int) -> None:
        life = self.actors[which].name, self.actors[which].incarnation
        if self.intake is not None:
            self.intake.seen(*life)
            self.out_of_sight.discard(life)

    def lose_token(self, actor: Actor) -> None:
        if self.intake is not None:
            self.intake.gone(actor.name, actor.incarnation)
            self.out_of_sight.add((actor.name, actor.incarnation))

    @rule(which=st.integers(0, 1))
    def write_report(self, which: int) -> None:
        self.reports.append(self.actors[which].report())

    # ---- the network

    @rule(which=st.integers(0, 1), answered=st.booleans())
    def round_trip(self, which: int, answered: bool) -> None:
        """Everything succeeds except perhaps the answer: random steps alone rarely reach this."""
        self.publish(which, lag=0, stale=False)
        self.send(which, wait=5.0)
        while self.requests and self.intake is not None:
            self.deliver(0, repeat=False)
            self.answer(-1, arrives=answered)
        if not answered:
            self.time_out(which)

    @precondition(lambda self: self.requests)
    @rule(pick=st.integers(0, 50), repeat=st.booleans())
    def deliver(self, pick: int, repeat: bool) -> None:
        index = pick % len(self.requests)
        actor, sequence = self.requests[index] if repeat else self.requests.pop(index)
        if self.intake is None:
            return
        header = actor.headers[sequence]
        verdict = self.intake.arrive(header, ROLLOUT, self.now)
        self.judge(key_of(header), verdict)
        self.replies.append((actor, sequence, verdict))

    @precondition(lambda self: self.replies)
    @rule(pick=st.integers(0, 50), arrives=st.booleans())
    def answer(self, pick: int, arrives: bool) -> None:
        actor, sequence, verdict = self.replies.pop(pick % len(self.replies))
        if arrives and self.intake is not None and verdict.generation == self.intake.learner.generation:
            actor.hear(sequence, verdict, self.now)
        elif arrives:  # the token of the learner that answered is gone
            actor.outbox = ob.unanswered(actor.outbox, sequence, self.now)

    @precondition(lambda self: bool(self.reports) and self.intake is not None)
    @rule(pick=st.integers(0, 50), repeat=st.booleans())
    def deliver_report(self, pick: int, repeat: bool) -> None:
        index = pick % len(self.reports)
        report = self.reports[index] if repeat else self.reports.pop(index)
        verdict = self.intake.report(report, self.now)
        for actor in self.actors:
            if (actor.name, actor.incarnation) == (report.actor, report.incarnation):
                actor.outbox = ob.credited(actor.outbox, verdict)

    def judge(self, key: Key, verdict: Verdict) -> None:
        """Compare a verdict with the recorded one."""
        if verdict.first in ob.FINAL_VERDICTS:
            if key in self.judged:
                assert verdict.first is self.judged[key]
                assert verdict.kind is VerdictKind.DUPLICATE
            elif verdict.kind is not VerdictKind.DUPLICATE:  # otherwise the actor's report has settled it
                self.judged[key] = verdict.first

    # ---- the learner

    @precondition(lambda self: self.intake is not None)
    @rule()
    def start_update(self) -> None:
        if self.dataset:
            return
        self.dataset = take_dataset(self.intake)
        for entry in self.dataset:
            assert key_of(entry.header) not in self.trained, "trained twice"
            assert self.intake.learner.version - entry.header.version <= INTAKE.max_lag
            assert self.intake.learner.stage_number == entry.header.stage_number

    @precondition(lambda self: self.intake is not None and bool(self.dataset))
    @rule(next_stage=st.booleans())
    def end_update(self, next_stage: bool) -> None:
        self.trained.update(key_of(entry.header) for entry in self.dataset)
        old = self.intake.learner
        stage_number = old.stage_number + next_stage
        self.intake.finish_update(
            dataclasses.replace(old, version=old.version + 1, stage_number=stage_number)
        )
        self.dataset = ()

    @precondition(lambda self: self.intake is not None)
    @rule()
    def save(self) -> None:
        self.checkpoint = Checkpoint(
            self.intake.learner, self.intake.snapshots(), frozenset(self.trained), dict(self.judged)
        )

    @rule(chance=st.integers(0, 3))
    def kill_learner(self, chance: int) -> None:
        if chance == 0:
            self.intake, self.dataset = None, ()

    @precondition(lambda self: self.intake is not None and not self.dataset)
    @rule(chance=st.integers(0, 3))
    def stop_learner_as_planned(self, chance: int) -> None:
        if chance == 0:
            self.save()
            self.checkpoint = dataclasses.replace(self.checkpoint, queue=self.intake.waiting)
            self.intake = None

    @precondition(lambda self: self.intake is None)
    @rule()
    def restart_learner(self) -> None:
        self.generations += 1
        learner = dataclasses.replace(self.checkpoint.learner, generation=self.generations)
        self.intake = Intake(INTAKE, learner, self.checkpoint.accounts, self.checkpoint.queue)
        self.out_of_sight = set()
        self.trained = set(self.checkpoint.trained)
        self.judged = dict(self.checkpoint.judged)

    # ---- claims

    @invariant()
    def the_actors_counts_balance(self) -> None:
        for actor in self.actors + self.dead:
            counts = actor.outbox.counts
            assert counts.balance == 0
            assert counts.in_flight <= OUTBOX.window
            assert counts.refused.keys() <= ob.FINAL_VERDICTS - {VerdictKind.ACCEPTED}

    @invariant()
    def the_learners_ledger_balances(self) -> None:
        if self.intake is None:
            return
        ledgers = self.intake.ledgers()
        for ledger in ledgers.values():
            assert ledger.balance == 0
            assert min(ledger.trained, ledger.dropped, ledger.in_flight, ledger.lost) >= 0
        assert self.intake.total() == sum(ledgers.values(), Ledger())
        assert self.intake.total().trained == len(self.trained)
        assert self.intake.gaps() == sum(account.gaps for account in self.intake._accounts._accounts.values())
        assert self.intake._credits._promised == sum(self.intake._credits._holders.values())

    @invariant()
    def of_actors_without_token_only_queued_rollouts_are_in_flight(self) -> None:
        if self.intake is None:
            return
        came = Counter(key_of(entry.header)[:2] for entry in (*self.intake._queue, *self.dataset))
        for life in self.out_of_sight:
            assert self.intake.ledgers()[life].in_flight == came[life]

    def teardown(self) -> None:
        """When all tokens are present and after two reports each, the learner's ledger equals the true fates."""
        if self.intake is None:
            self.restart_learner()
        for which, actor in enumerate(self.actors):
            self.return_token(which)
            for _ in range(2):
                actor.outbox = ob.credited(actor.outbox, self.intake.report(actor.report(), self.now))
            ledger = self.intake.ledgers()[actor.name, actor.incarnation]
            fates = Counter(self.true_fates(actor))
            assert ledger.published == actor.outbox.next_sequence
            for name in ("trained", "dropped", "in_flight", "lost"):
                assert getattr(ledger, name) == fates.pop(name, 0), name
            assert dict(ledger.refused) == dict(fates)

    def true_fates(self, actor: Actor) -> Iterator[str]:
        queued = {key_of(entry.header) for entry in (*self.intake._queue, *self.dataset)}
        flying = {flight.sequence for flight in actor.outbox.flights}
        refused = {refusal.sequence: refusal.kind for refusal in actor.outbox.refused}
        for sequence in range(actor.outbox.next_sequence):
            key = (actor.name, actor.incarnation, sequence)
            verdict = self.judged.get(key)
            if key in self.trained:
                yield "trained"
            elif key in queued:
                yield "in_flight"
            elif verdict is not None:
                yield "lost" if verdict is VerdictKind.ACCEPTED else verdict
            elif sequence in flying:
                yield "in_flight"
            elif sequence in actor.outbox.dropped:
                yield "dropped"
            else:
                yield refused.get(sequence, "lost")


World.TestCase.settings = settings(max_examples=150, stateful_step_count=60, deadline=None)
TestExactlyOnce = World.TestCase


@pytest.mark.parametrize("max_lag", [0, 1, 2])
@pytest.mark.parametrize("actors", [1, 3])
def test_paced_actors_fill_every_dataset_without_a_refusal_and_within_the_lag(max_lag, actors):
    """No deadlock: an actor that may not publish only reports, and every dataset is still completed."""
    intake = Intake(IntakeConfig(dataset_rollouts=5, max_lag=max_lag), LEARNER_STATE)
    crew = [Actor(f"actor-{i}", 1) for i in range(actors)]
    lags: list[int] = []
    now = 0.0
    for _ in range(400):
        now += 1.0
        for actor in crew:
            play(actor, intake, now)
        dataset = take_dataset(intake)
        lags += [intake.learner.version - entry.header.version for entry in dataset]
        for actor in crew:  # the update runs meanwhile
            play(actor, intake, now)
        if dataset:
            intake.finish_update(dataclasses.replace(intake.learner, version=intake.learner.version + 1))

    total = sum(intake.ledgers().values(), Ledger())
    assert intake.learner.version > LEARNER_STATE.version + 50
    assert total.refused == {}
    assert total.lost == 0
    assert max(lags) <= min(max_lag, 1)


def play(actor: Actor, intake: Intake, now: float) -> None:
    """One turn of an actor that always has the newest policy: publish if it may, else report."""
    learner = intake.learner
    if ob.idle_reason(actor.outbox, learner.generation, learner.version):
        actor.outbox = ob.credited(actor.outbox, intake.report(actor.report(), now))
        return
    sequence = actor.outbox.next_sequence
    header = make_header(sequence, actor=actor.name, version=learner.version)
    actor.outbox = ob.sent(ob.offer(actor.outbox, b"", now), sequence)
    actor.hear(sequence, intake.arrive(header, ROLLOUT, now), now)


def test_a_silent_actors_credits_do_not_block_a_synchronous_run():
    intake = Intake(IntakeConfig(dataset_rollouts=4, max_lag=0, credit_patience_s=30.0), LEARNER_STATE)
    silent, eager = Actor("silent", 1), Actor("eager", 1)
    intake.report(silent.report(), now=0.0)

    for second in range(60):
        play(eager, intake, float(second))

    assert len(take_dataset(intake)) == 4
