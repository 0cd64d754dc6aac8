"""What holds in every state. A state from which no step leads on must be one in which both actors have played all."""

import pickle
from collections import Counter
from collections.abc import Callable, Mapping
from typing import Final

from benchmarks.exchange.model import ACTORS, INTAKE, Actor, Bounds, State
from services.learner.intake import Intake


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
    return 0 <= intake._credits._promised <= len(ACTORS) * INTAKE.window and intake.queued <= ahead + len(
        ACTORS
    )


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
