"""The checker of histories: what every service wrote about each rollout, compared.

It shares no code with the services. A rollout is named by its actor, the actor's life and its number. The histories are
files of lines (`common.service.history`); the rules are in `RULES`.

A learner's life goes on from a checkpoint. What an earlier life trained after that checkpoint was rolled back: it is in
no weights. *Kept* are the epochs that no later life rolled back.
"""

import json
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

MOST_IN_FLIGHT: Final = 2  # rollouts that an actor may have numbered and not yet settled

Name = tuple[str, int, int]  # actor, life, number
Event = Mapping[str, Any]

RULES: Final[Mapping[str, str]] = {
    "trained_twice": "no rollout is in two kept epochs, or twice in one life of a learner",
    "unasked": "what is trained was accepted by that life, or waited in the checkpoint that it started from",
    "invented": "what is trained was played",
    "accepted_and_gone": "what a life accepted is trained, lost for a stated reason, kept by its last checkpoint, or "
    "the life was killed",
    "unsettled": "what an actor played has a last verdict or was dropped; a killed one leaves at most 2",
    "verdict_unfounded": "an actor's verdict is one that a learner gave",
    "gap": "an actor's numbers are 0, 1, 2, ...",
    "stale": "no rollout is trained that is more than max_lag versions old",
    "version_back": "versions and stages go forward in each life of a learner, and in what an actor plays of it",
    "life_back": "each life of the learner has a higher generation, and starts at a version that an earlier one saved",
    "ledger": "the last learner's ledger balances, and counts as trained what is in kept epochs",
    "died_unasked": "a life without its last line was ended by the schedule",
}


NOT_ACCOUNTED: Final = (
    "accepted_and_gone",
    "unsettled",
    "gap",
    "verdict_unfounded",
    "ledger",
    "died_unasked",
)
"""Rules whose violation means that the fate of a rollout is not known."""


@dataclass(frozen=True, slots=True)
class Violation:
    """A rule that did not hold."""

    rule: str
    text: str


@dataclass(slots=True)
class ActorLife:
    """What one life of an actor wrote."""

    actor: str
    life: int
    played: dict[int, Event] = field(default_factory=dict)
    verdicts: dict[int, Event] = field(default_factory=dict)
    dropped: set[int] = field(default_factory=set)
    policies: list[Event] = field(default_factory=list)
    numbers: list[int] = field(default_factory=list)
    is_whole: bool = False  # its last line is there


@dataclass(slots=True)
class LearnerLife:
    """What one life of the learner wrote."""

    start: Event
    accepted: set[Name] = field(default_factory=set)
    given: set[tuple[Name, str]] = field(default_factory=set)
    epochs: list[Event] = field(default_factory=list)
    saved: list[Event] = field(default_factory=list)
    end: Event | None = None

    @property
    def generation(self) -> int:
        """Its number."""
        return int(self.start["generation"])


@dataclass(frozen=True, slots=True)
class Result:
    """What the histories say."""

    violations: tuple[Violation, ...]
    counts: Mapping[str, int]
    epoch_times: tuple[float, ...]  # [s] of all lives, in order
    starts: tuple[float, ...]  # [s] of the learner's lives

    def count_of(self, *rules: str) -> int:
        """Return how often these rules did not hold."""
        return sum(violation.rule in rules for violation in self.violations)


def check(folder: Path, max_lag: int, ended_actors: Mapping[str, int], ended_learners: int) -> Result:
    """Return what the histories in a folder say.

    Args:
        folder: With NAME.jsonl of every actor and of every learner.
        max_lag: Versions that a trained rollout may be old.
        ended_actors: How often the schedule ended each actor.
        ended_learners: How often it ended the learner, or one of the learners that train together.
    """
    actors = [life for file in sorted(folder.glob("actor-*.jsonl")) for life in actor_lives(lines(file))]
    return judge(actors, learners_of(folder), max_lag, ended_actors, ended_learners)


def learners_of(folder: Path) -> list[LearnerLife]:
    """Return the learner's lives; those of a group are one learner's."""
    return group_lives([learner_lives(lines(file)) for file in sorted(folder.glob("learner-*.jsonl"))])


def lines(file: Path) -> Iterator[Event]:
    """Yield the events of a file; one without its line end was being written when the process ended."""
    if not file.exists():
        return
    for line in file.read_text(encoding="utf-8").splitlines(keepends=True):
        if line.endswith("\n"):
            yield json.loads(line)


def actor_lives(events: Iterable[Event]) -> list[ActorLife]:
    """Return the lives in an actor's file."""
    lives: list[ActorLife] = []
    for event in events:
        kind = event["event"]
        if kind == "start":
            lives.append(ActorLife(event["actor"], event["incarnation"]))
            continue
        life = lives[-1]
        if kind == "played":
            life.numbers.append(event["number"])
            life.played[event["number"]] = event
        elif kind == "verdict":
            life.verdicts[event["number"]] = event
        elif kind == "dropped":
            life.dropped.add(event["number"])
        elif kind == "policy":
            life.policies.append(event)
        elif kind == "end":
            life.is_whole = True
    return lives


def learner_lives(events: Iterable[Event]) -> list[LearnerLife]:
    """Return the lives in the learner's file."""
    lives: list[LearnerLife] = []
    for event in events:
        kind = event["event"]
        if kind == "start":
            lives.append(LearnerLife(event, set(names(event["waiting"]))))
            continue
        life = lives[-1]
        if kind == "verdict":
            name = _name(event["rollout"])
            life.given.add((name, event["kind"]))
            if event["kind"] == "accepted":
                life.accepted.add(name)
        elif kind == "trained":
            life.epochs.append(event)
        elif kind == "saved":
            life.saved.append(event)
        elif kind == "end":
            life.end = event
    return lives


def group_lives(ranks: Sequence[Sequence[LearnerLife]]) -> list[LearnerLife]:
    """Return the lives of a group of learners, by generation: what its ranks wrote, taken as one learner's.

    Args:
        ranks: The lives of each rank; the first one leads.
    """
    if len(ranks) < 2:
        return [life for lives in ranks for life in lives]
    by_generation: dict[int, list[LearnerLife]] = {}
    for lives in ranks:
        for life in lives:
            by_generation.setdefault(life.generation, []).append(life)
    return [_together(by_generation[life.generation], len(ranks)) for life in ranks[0]]


def _together(parts: Sequence[LearnerLife], ranks: int) -> LearnerLife:
    """Return one life of a group from the parts of its ranks; it has ended in order if all of them have."""
    epochs: dict[int, dict[str, Any]] = {}
    for part in parts:
        for epoch in part.epochs:
            whole = epochs.setdefault(epoch["version"], {**epoch, "rollouts": [], "lost": []})
            for key in ("rollouts", "lost"):
                whole[key] = [*whole[key], *epoch[key]]
    leader = parts[0]
    saved = [dict(event) for event in leader.saved]
    for part in parts[1:]:
        for event in part.saved[-1:] if saved else ():
            saved[-1]["waiting"] = [*saved[-1]["waiting"], *event["waiting"]]
    ends = [part.end for part in parts if part.end is not None]
    are_whole = len(ends) == ranks
    sums = {key: sum(end[key] for end in ends) for key in ("trained", "balance")} if are_whole else {}
    return LearnerLife(
        start=leader.start,
        accepted=set[Name]().union(*(part.accepted for part in parts)),
        given=set[tuple[Name, str]]().union(*(part.given for part in parts)),
        epochs=[epochs[version] for version in sorted(epochs)],
        saved=list(saved),
        end={**ends[0], **sums} if are_whole else None,
    )


def judge(
    actors: Sequence[ActorLife],
    learners: Sequence[LearnerLife],
    max_lag: int,
    ended_actors: Mapping[str, int],
    ended_learners: int,
) -> Result:
    """Return what all lives together say. Arguments as for `check`."""
    kept = kept_epochs(learners)
    found = [
        *training_faults(actors, learners, kept, max_lag),
        *acceptance_faults(learners),
        *actor_faults(actors, learners),
        *order_faults(learners),
        *ending_faults(actors, learners, ended_actors, ended_learners),
    ]
    if learners and learners[-1].end is not None:
        end, trained = learners[-1].end, sum(len(epoch["rollouts"]) for epoch in kept)
        if end["balance"] != 0 or end["trained"] != trained:
            text = f"balance {end['balance']}, trained {end['trained']}; the histories have {trained}"
            found.append(Violation("ledger", text))
    counts = Counter(
        played=sum(len(life.played) for life in actors),
        trained=sum(len(epoch["rollouts"]) for epoch in kept),
        rolled_back=sum(len(epoch["rollouts"]) for life in learners for epoch in life.epochs)
        - sum(len(epoch["rollouts"]) for epoch in kept),
        lost=sum(len(epoch["lost"]) for life in learners for epoch in life.epochs),
        dropped=sum(len(life.dropped) for life in actors),
        refused=sum(event["kind"] != "accepted" for life in actors for event in life.verdicts.values()),
        died_with_actor=sum(len(unsettled(life)) for life in actors if not life.is_whole),
        actor_lives=len(actors),
        learner_lives=len(learners),
        epochs=len(kept),
    )
    times = [epoch["t"] for life in learners for epoch in life.epochs]
    return Result(tuple(found), counts, tuple(times), tuple(life.start["t"] for life in learners))


def kept_epochs(learners: Sequence[LearnerLife]) -> list[Event]:
    """Return the epochs that no later life rolled back, in order."""
    kept: list[Event] = []
    for life in learners:
        kept = [epoch for epoch in kept if epoch["version"] <= life.start["version"]]
        kept += life.epochs
    return kept


def training_faults(
    actors: Sequence[ActorLife], learners: Sequence[LearnerLife], kept: Sequence[Event], max_lag: int
) -> Iterator[Violation]:
    """Yield what was trained and should not have been."""
    played = {(life.actor, life.life, n): event for life in actors for n, event in life.played.items()}
    groups = [("kept epochs", kept)]
    groups += [(f"generation {life.generation}", life.epochs) for life in learners]
    twice: set[Name] = set()
    for where, epochs in groups:
        seen = Counter(name for epoch in epochs for name in names(epoch["rollouts"]))
        for name, count in seen.items():
            if count > 1 and name not in twice:
                twice.add(name)
                yield Violation("trained_twice", f"{name} {count} times in {where}")
    for life in learners:
        for epoch in life.epochs:
            for name in names(epoch["rollouts"]):
                if name not in life.accepted:
                    yield Violation("unasked", f"{name} in epoch {epoch['epoch']}")
                if name not in played:
                    yield Violation("invented", f"{name} in epoch {epoch['epoch']}")
                elif (lag := epoch["version"] - 1 - played[name]["version"]) > max_lag:
                    yield Violation("stale", f"{name} is {lag} versions old; allowed: {max_lag}")


def acceptance_faults(learners: Sequence[LearnerLife]) -> Iterator[Violation]:
    """Yield what was accepted and is gone. What a killed life accepted may be gone with it."""
    for life in learners:
        if life.end is None:
            continue
        settled = {name for epoch in life.epochs for name in names([*epoch["rollouts"], *epoch["lost"]])}
        settled |= {name for saved in life.saved[-1:] for name in names(saved["waiting"])}
        for name in sorted(life.accepted - settled):
            yield Violation("accepted_and_gone", f"{name} of generation {life.generation}")


def actor_faults(actors: Sequence[ActorLife], learners: Sequence[LearnerLife]) -> Iterator[Violation]:
    """Yield what an actor's history lacks, or has that no learner's explains."""
    given: dict[int, set[tuple[Name, str]]] = {}
    so_far: set[tuple[Name, str]] = set()  # a later life repeats the verdict of an earlier one
    for learner in learners:
        so_far = so_far | learner.given
        given[learner.generation] = so_far
    for life in actors:
        who = f"{life.actor}, life {life.life}"
        if life.numbers != list(range(len(life.numbers))):
            yield Violation("gap", f"{who}: {len(life.numbers)} numbers up to {max(life.numbers)}")
        open_ones = unsettled(life)
        if len(open_ones) > (0 if life.is_whole else MOST_IN_FLIGHT):
            yield Violation("unsettled", f"{who}: {open_ones}")
        for number, verdict in life.verdicts.items():
            name = (life.actor, life.life, number)
            if (name, verdict["kind"]) not in given.get(verdict["generation"], set()):
                yield Violation("verdict_unfounded", f"{name} {verdict['kind']} by {verdict['generation']}")
        newest: dict[int, tuple[int, int]] = {}
        for policy in life.policies:
            now = (policy["version"], policy["stage_number"])
            before = newest.get(policy["generation"], now)
            if now[0] < before[0] or now[1] < before[1]:
                yield Violation("version_back", f"{who}: {now} after {before}")
            newest[policy["generation"]] = now


def order_faults(learners: Sequence[LearnerLife]) -> Iterator[Violation]:
    """Yield what went back in the learner's lives."""
    for life in learners:
        before = life.start
        for epoch in life.epochs:
            if epoch["version"] != before["version"] + 1 or epoch["stage_number"] < before["stage_number"]:
                at, was = ((e["version"], e["stage_number"]) for e in (epoch, before))
                yield Violation("version_back", f"generation {life.generation}: {at} after {was}")
            before = epoch
    reached = {0}
    for index, life in enumerate(learners):
        if index and life.generation <= learners[index - 1].generation:
            yield Violation("life_back", f"{life.generation} after {learners[index - 1].generation}")
        if index and life.start["version"] not in reached:
            yield Violation("life_back", f"generation {life.generation} starts at {life.start['version']}")
        reached |= {epoch["version"] for epoch in life.epochs}


def ending_faults(
    actors: Sequence[ActorLife],
    learners: Sequence[LearnerLife],
    ended_actors: Mapping[str, int],
    ended_learners: int,
) -> Iterator[Violation]:
    """Yield the services that ended more often without a last line than they were ended."""
    for actor, count in sorted(Counter(life.actor for life in actors if not life.is_whole).items()):
        if count > ended_actors.get(actor, 0):
            yield Violation("died_unasked", f"actor {actor}: {count} of {ended_actors.get(actor, 0)}")
    if (count := sum(life.end is None for life in learners)) > ended_learners:
        yield Violation("died_unasked", f"learner: {count} of {ended_learners}")


def unsettled(life: ActorLife) -> list[int]:
    """Return the rollouts of a life that have no last verdict and were not dropped."""
    return sorted(life.played.keys() - life.verdicts.keys() - life.dropped)


def names(values: Iterable[Sequence[Any]]) -> Iterator[Name]:
    """Yield rollouts' names from JSON."""
    return map(_name, values)


def _name(value: Sequence[Any]) -> Name:
    actor, life, number = value
    return str(actor), int(life), int(number)
