"""Every state that two actors and a learner can reach together, within bounds, visited once.

    python -m benchmarks.exchange --json

The parts are the real ones: `services.actor.outbox` and `services.learner.intake`. Around them is a model of the rest:
a network that delays, repeats, reorders and loses messages; a learner that trains, changes its stage, saves, dies and
goes on from its checkpoint. In each state that is reached, every invariant of `INVARIANTS` is checked. A state from
which no step leads on must be one in which both actors have played all that the bounds allow.
"""

import copyreg
import pickle
import sys
import time
from collections import Counter, deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from threading import Event
from types import MappingProxyType
from typing import Any, Final, cast

from pydantic import Field

from benchmarks.settings import BenchmarkConfig, print_figures, run
from common.comms.messages import Rollout, Verdict
from common.errors import ReportedError
from common.evaluation.evaluate import check
from common.service.process import DONE
from services.actor import outbox as box
from services.actor.outbox import Outbox, OutboxConfig
from services.learner.admission import Header, LearnerState
from services.learner.intake import Intake, IntakeConfig

ACTORS: Final = ("a", "b")
LIFE: Final = 1
HASH: Final = "training"
INTAKE: Final = IntakeConfig(dataset_rollouts=2, max_lag=1, target_lag=1, queue_rollouts=4, window=2)
NEW_OUTBOX: Final = Outbox(OutboxConfig())
STAGE_LENGTH: Final = 2  # versions of one stage
CONTENT: Final = cast(Rollout, "content")  # no code under test reads it
PROGRESS_S: Final = 5.0

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
    dataset = intake.take_dataset()
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


# ---- what holds in every state


def _once(state: State, intake: Intake) -> bool:
    return max(Counter(state.trained).values(), default=0) <= 1


def _played(state: State, intake: Intake) -> bool:
    return all(number < _of(state, name).outbox.next_sequence for name, number in state.trained)


def _balances(state: State, intake: Intake) -> bool:
    return intake.total().balance == 0 and all(actor.outbox.counts.balance == 0 for actor in state.actors)


def _agrees(state: State, intake: Intake) -> bool:
    """Both sides count as accepted what this learner accepted, once the actor knows."""
    for index, actor in enumerate(state.actors):
        given = {number for _, (name, number) in state.accepted if name == ACTORS[index]}
        if actor.outbox.accepted > len(given):
            return False
    return True


def _trained_as_recorded(state: State, intake: Intake) -> bool:
    return intake.total().trained == len(state.trained)


def _credits(state: State, intake: Intake) -> bool:
    """No more is promised and waiting than the learner trains within its lag, and nobody holds more than a window."""
    ahead = min(INTAKE.lag_aimed_at + 1, state.learner.datasets_left) * INTAKE.dataset_rollouts
    return 0 <= intake._promised <= len(ACTORS) * INTAKE.window and intake.queued <= ahead + len(ACTORS)


def _of(state: State, name: str) -> Actor:
    return state.actors[ACTORS.index(name)]


INVARIANTS: Final[Mapping[str, Callable[[State, Intake], bool]]] = {
    "no rollout is in two kept epochs": _once,
    "what is trained was played": _played,
    "both ledgers balance": _balances,
    "an actor counts as accepted only what a learner accepted": _agrees,
    "the ledger counts as trained what is in kept epochs": _trained_as_recorded,
    "credits stay within the windows, the queue within the lag": _credits,
}


def faults(state: State) -> list[str]:
    """Return the invariants that do not hold in a state."""
    intake: Intake = pickle.loads(state.intake)
    return [name for name, holds in INVARIANTS.items() if not holds(state, intake)]


def is_stuck(state: State, bounds: Bounds) -> bool:
    """Return whether a state without a next step is one in which somebody waits for ever."""
    played_all = all(actor.outbox.next_sequence >= bounds.rollouts for actor in state.actors)
    return not played_all or any(actor.outbox.flights for actor in state.actors)


@dataclass(slots=True)
class Search:
    """What a search has found."""

    states: int = 0
    steps: int = 0
    ends: int = 0
    depth: int = 0
    is_whole: bool = True
    kinds: Counter[str] = field(default_factory=Counter)
    broken: list[tuple[str, tuple[str, ...]]] = field(default_factory=list)  # invariant, and the path to it


def explore(bounds: Bounds, most: int, stop: Event | None = None) -> Search:
    """Visit every state within the bounds, nearest first, but at most ``most``."""
    first = first_state()
    came: dict[State, tuple[State, str] | None] = {first: None}
    waiting = deque([(first, 0)])
    found = Search()
    told = time.monotonic()
    while waiting:
        state, depth = waiting.popleft()
        next_ones = [(name, after) for name, after in steps(state, bounds) if after != state]
        _note(found, state, depth, next_ones, bounds, came)
        for name, after in next_ones:
            if after in came:
                continue
            if len(came) >= most:
                found.is_whole = False
                break
            came[after] = (state, name)
            waiting.append((after, depth + 1))
        if stop is not None:
            check(stop)
            if time.monotonic() - told > PROGRESS_S:
                told = time.monotonic()
                print(f"states={found.states} waiting={len(waiting)} depth={depth}", file=sys.stderr)
    return found


def _note(
    found: Search,
    state: State,
    depth: int,
    next_ones: Sequence[tuple[str, State]],
    bounds: Bounds,
    came: Mapping[State, tuple[State, str] | None],
) -> None:
    """Count a state, and check it."""
    found.states += 1
    found.depth = max(found.depth, depth)
    found.steps += len(next_ones)
    found.kinds.update(name for name, _ in next_ones)
    broken = faults(state)
    if not next_ones:
        found.ends += 1
        if is_stuck(state, bounds):
            broken.append("nobody waits for ever")
    found.broken += [(fault, path_to(state, came)) for fault in broken]


def path_to(state: State, came: Mapping[State, tuple[State, str] | None]) -> tuple[str, ...]:
    """Return the steps that lead to a state."""
    names: list[str] = []
    while (before := came[state]) is not None:
        state, name = before
        names.append(name)
    return tuple(reversed(names))


class ExchangeConfig(BenchmarkConfig):
    """Visit every state of the exchange of rollouts, credits, generations and stages within bounds."""

    rollouts: int = Field(2, ge=1, le=8, description="that each of two actors plays")
    losses: int = Field(1, ge=0, le=4, description="messages that are lost or late, on one path")
    repeats: int = Field(1, ge=0, le=4, description="messages that arrive twice, on one path")
    deaths: int = Field(1, ge=0, le=4, description="deaths of the learner, on one path")
    states: int = Field(200_000, ge=1, description="states that are visited at most")


def main(config: ExchangeConfig, stop: Event) -> int:
    """Search and print; a broken invariant ends with its shortest path."""
    bounds = Bounds(config.rollouts, config.losses, config.repeats, config.deaths)
    found = explore(bounds, config.states, stop)
    print_figures(
        {
            "states": found.states,
            "steps": found.steps,
            "ends": found.ends,
            "depth": found.depth,
            "whole": found.is_whole,
            "invariants": len(INVARIANTS) + 1,
            "broken": len(found.broken),
            "steps_by_kind": dict(found.kinds),
        },
        config.json_line,
    )
    if found.broken:
        invariant, path = min(found.broken, key=lambda one: len(one[1]))
        raise ReportedError(f"not true: {invariant}; shortest path: {', '.join(path)}")
    return DONE


if __name__ == "__main__":
    sys.exit(run("exchange", ExchangeConfig, main))
