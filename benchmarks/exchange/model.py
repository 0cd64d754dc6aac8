"""The model: a network that delays, repeats, reorders and loses messages, around the real outbox and intake.

The learner trains, changes its stage, saves, dies and goes on from its checkpoint.
"""

import copyreg
import pickle
from collections.abc import Iterator
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import Any, Final, cast

from common.comms.messages import Rollout, Verdict
from services.actor import outbox as box
from services.actor.config import OutboxConfig
from services.actor.outbox import Outbox
from services.learner.admission import Header, LearnerState
from services.learner.config import IntakeConfig
from services.learner.intake import Intake
from services.learner.turns import Rank, taken

ACTORS: Final = ("a", "b")
LIFE: Final = 1
HASH: Final = "training"
INTAKE: Final = IntakeConfig(dataset_rollouts=2, max_lag=1, target_lag=1, queue_rollouts=4, window=2)
NEW_OUTBOX: Final = Outbox(OutboxConfig())
STAGE_LENGTH: Final = 2  # versions of one stage
CONTENT: Final = cast(Rollout, "content")  # no code under test reads it

Name = tuple[str, int]  # actor, number


def _frozen(values: dict[Any, Any]) -> MappingProxyType[Any, Any]:
    return MappingProxyType(values)


copyreg.pickle(MappingProxyType, lambda values: (_frozen, (dict(values),)))  # a ledger holds one


@dataclass(frozen=True, slots=True)
class Bounds:
    """What a path may contain."""

    rollouts: int = 2  # of each actor
    losses: int = 1  # messages that are lost, or late beyond their time-out
    repeats: int = 1  # messages that arrive twice
    deaths: int = 1  # of the learner


@dataclass(frozen=True, slots=True)
class Message:
    """A message on its way: a rollout or a report to the learner, or its answer."""

    actor: str
    number: int  # of the rollout; -1: a report
    tries: int  # which try of it
    header: Header | None = None
    report: Any = None
    answer: Verdict | None = None


@dataclass(frozen=True, slots=True)
class Actor:
    """One actor: its outbox, the policy that it plays, and the report that is under way."""

    outbox: Outbox = NEW_OUTBOX
    generation: int = 1
    version: int = 0
    stage: int = 0
    headers: tuple[Header, ...] = ()
    report: int = 0  # which one is under way; 0: none
    is_current: bool = False  # nothing has changed since its last report was answered


@dataclass(frozen=True, slots=True)
class Saved:
    """A checkpoint."""

    state: LearnerState
    accounts: tuple[Any, ...]
    trained: tuple[Name, ...]


@dataclass(frozen=True, slots=True)
class State:
    """Everything. The learner's intake is kept as bytes: it changes in place."""

    intake: bytes
    learner: LearnerState
    trained: tuple[Name, ...] = ()  # kept: not rolled back
    accepted: frozenset[tuple[int, Name]] = frozenset()  # by generation
    saved: Saved | None = None
    actors: tuple[Actor, ...] = (Actor(), Actor())
    network: frozenset[Message] = frozenset()
    losses: int = 0
    repeats: int = 0
    deaths: int = 0


def first_state() -> State:
    """Return the state in which nothing has happened."""
    learner = LearnerState("run", 1, 0, 0, 1, HASH, STAGE_LENGTH)
    saved = Saved(learner, (), ())
    return State(pickle.dumps(Intake(INTAKE, learner)), learner, saved=saved)


def steps(state: State, bounds: Bounds) -> Iterator[tuple[str, State]]:
    """Yield every step that can come next, by name."""
    for index, actor in enumerate(state.actors):
        yield from _actor_steps(state, index, actor, bounds)
    for message in state.network:
        yield from _message_steps(state, message, bounds)
    yield from _learner_steps(state, bounds)


def _actor_steps(state: State, index: int, actor: Actor, bounds: Bounds) -> Iterator[tuple[str, State]]:
    name = ACTORS[index]
    learner = state.learner
    if (actor.generation, actor.version) != (learner.generation, learner.version):
        fresh = replace(
            actor,
            generation=learner.generation,
            version=learner.version,
            stage=learner.stage_number,
            is_current=False,
        )
        yield "adopt", _with_actor(state, index, fresh)
    waits = box.idle_reason(actor.outbox, actor.generation, actor.version)
    number = actor.outbox.next_sequence
    if not waits and number < bounds.rollouts:
        header = Header("run", actor.generation, actor.version, actor.stage, name, LIFE, number, HASH)
        outbox = box.sent(box.offer(actor.outbox, b"", 0.0), number)
        played = replace(actor, outbox=outbox, headers=(*actor.headers, header), is_current=False)
        sent = Message(name, number, 1, header)
        yield "play", replace(_with_actor(state, index, played), network=state.network | {sent})
    for flight in box.due(actor.outbox, 1e9):  # any pause between two tries may be over
        outbox = box.sent(actor.outbox, flight.sequence)
        again = Message(name, flight.sequence, flight.tries + 1, actor.headers[flight.sequence])
        moved = _with_actor(state, index, replace(actor, outbox=outbox))
        yield "send again", replace(moved, network=state.network | {again})
    if waits and not actor.report and not actor.is_current:
        report = box.report(
            actor.outbox, run="run", actor=name, incarnation=LIFE, version=actor.version, training_hash=HASH
        )
        late = [message.tries for message in state.network if (message.actor, message.number) == (name, -1)]
        asked = Message(name, -1, max(late, default=0) + 1, report=report)
        reporting = replace(actor, report=asked.tries)
        yield "report", replace(_with_actor(state, index, reporting), network=state.network | {asked})


def _message_steps(state: State, message: Message, bounds: Bounds) -> Iterator[tuple[str, State]]:
    gone = replace(state, network=state.network - {message})
    if state.losses < bounds.losses:
        late = _timed_out(replace(state, losses=state.losses + 1), message)
        if late is not None:
            yield "time out", late  # the message itself may still arrive
            yield "lose", replace(late, network=late.network - {message})
    yield "deliver", _delivered(gone, message)
    if state.repeats < bounds.repeats and message.answer is None:
        yield "deliver twice", _delivered(replace(state, repeats=state.repeats + 1), message)


def _timed_out(state: State, message: Message) -> State | None:
    """Return the state after the actor has given up this try, or None if it has already."""
    index = ACTORS.index(message.actor)
    actor = state.actors[index]
    if not _is_awaited(actor, message):
        return None
    if message.number < 0:
        return _with_actor(state, index, replace(actor, report=0))
    outbox = box.unanswered(actor.outbox, message.number, 0.0)
    return _with_actor(state, index, replace(actor, outbox=outbox))


def _is_awaited(actor: Actor, message: Message) -> bool:
    if message.number < 0:
        return message.tries == actor.report
    flights = actor.outbox.flights
    return any(f.sequence == message.number and f.under_way and f.tries == message.tries for f in flights)


def _delivered(state: State, message: Message) -> State:
    index = ACTORS.index(message.actor)
    actor = state.actors[index]
    if message.answer is None:
        intake: Intake = pickle.loads(state.intake)
        if message.header is not None:
            answer = intake.arrive(message.header, CONTENT, 0.0)
            if answer.kind.value == "accepted":
                name = (message.actor, message.number)
                state = replace(state, accepted=state.accepted | {(state.learner.generation, name)})
        else:
            answer = intake.report(message.report, 0.0)
        back = replace(message, header=None, report=None, answer=answer)
        return replace(state, intake=pickle.dumps(intake), network=state.network | {back})
    if not _is_awaited(actor, message):
        return state
    if message.number < 0:
        outbox = box.credited(actor.outbox, message.answer)
        return _with_actor(
            state, index, replace(actor, outbox=outbox, report=0, is_current=outbox == actor.outbox)
        )
    return _with_actor(
        state,
        index,
        replace(
            actor, outbox=box.answered(actor.outbox, message.number, message.answer, 0.0), is_current=False
        ),
    )


def _learner_steps(state: State, bounds: Bounds) -> Iterator[tuple[str, State]]:
    intake: Intake = pickle.loads(state.intake)
    rank = Rank(intake.queued, *intake.contributors(0.0), 0)
    (count,) = taken([rank], INTAKE.dataset_rollouts)
    dataset = intake.take(count) if count else ()
    learner = state.learner
    if dataset:
        version = learner.version + 1
        stage = min(version // STAGE_LENGTH, 2)
        left = STAGE_LENGTH - version % STAGE_LENGTH if stage < 2 else 2**31
        after = replace(learner, version=version, stage_number=stage, stage=stage + 1, datasets_left=left)
        intake.finish_update(after)
        names = tuple((entry.header.actor, entry.header.sequence) for entry in dataset)
        trained = (*state.trained, *names)
        actors = tuple(replace(actor, is_current=False) for actor in state.actors)
        yield (
            "train",
            replace(state, intake=pickle.dumps(intake), learner=after, trained=trained, actors=actors),
        )
        return
    if state.saved is None or state.saved.state.version != learner.version:
        saved = Saved(learner, intake.snapshots(), state.trained)
        yield "save", replace(state, saved=saved)
    if state.deaths < bounds.deaths and state.saved is not None:
        old = state.saved.state
        again = replace(old, generation=learner.generation + 1)
        fresh = Intake(INTAKE, again, state.saved.accounts)
        yield (
            "die and resume",
            replace(
                state,
                intake=pickle.dumps(fresh),
                learner=again,
                trained=state.saved.trained,
                deaths=state.deaths + 1,
                actors=tuple(_cut_off(actor) for actor in state.actors),
                network=frozenset(),
            ),
        )


def _cut_off(actor: Actor) -> Actor:
    """Return the actor after all that it asked was left without an answer."""
    outbox = actor.outbox
    for flight in outbox.flights:
        if flight.under_way:
            outbox = box.unanswered(outbox, flight.sequence, 0.0)
    return replace(actor, outbox=outbox, report=0, is_current=False)


def _with_actor(state: State, index: int, actor: Actor) -> State:
    actors = list(state.actors)
    actors[index] = actor
    return replace(state, actors=tuple(actors))
