"""Which runs are one experiment, and what to call it: those that differ in nothing but their seed."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from services.evaluator.report.collect import Run

BOOKKEEPING: Final = frozenset(
    {
        "run", "seed", "id", "index", "folder", "resume", "minutes", "frames", "panel", "evaluate", "final_rallies",
        "endpoint", "peers", "connect_timeout_s", "lease_s", "max_message_mib", "mode",
        "tls_ca", "tls_certificate", "tls_key", "metrics_port", "metrics_host",
        "log_level", "status_interval_s", "silence_warning_s", "checkpoint_interval_s", "niceness",
    }
)  # fmt: skip
"""Settings that name a run, or say how it is watched or reached: no experiment differs in them."""

OBSERVER: Final = "evaluator"  # measures a run, and doesn't change it
STAGES: Final = {1: "stages 1+2+3", 2: "stages 2+3", 3: "stage 3 only"}


@dataclass(frozen=True, slots=True)
class Group:
    """Runs of one experiment, which differ in nothing but their seed."""

    label: str  # short, what tells it from the other groups
    description: str  # whole
    runs: tuple[Run, ...]


def leaves(settings: Mapping[str, Any], parent: str = "") -> Iterator[tuple[str, Any]]:
    """Return every setting with its dotted path."""
    for name, value in settings.items():
        if isinstance(value, Mapping):
            yield from leaves(value, f"{parent}{name}.")
        else:
            yield f"{parent}{name}", value


USUAL: Final = ["estimated spin", "prediction", "sample age"]
SPINS: Final[Mapping[str, list[str]]] = {"hidden": [], "estimated": ["estimated spin"], "true": ["true spin"]}


def experiment(settings: Mapping[str, Any]) -> dict[str, Any]:
    """Return the settings of a run that make the experiment, by dotted path.

    What was asked of ``deploy.local`` for a service counts as it came to be, in the service's own table.
    """
    every = dict(leaves(settings))
    return {
        path: value
        for path, value in every.items()
        if OBSERVER not in path.split(".")[:2]
        and path.split(".")[-1] not in BOOKKEEPING
        and not (path.startswith("local.") and path.removeprefix("local.") in every)
    }


def description(settings: Mapping[str, Any]) -> tuple[tuple[str, str], ...]:
    """Return what a person calls the experiment: curriculum, teacher, collisions, observation, critic, whole and short.

    What is usual is short for nothing.
    """
    learner = settings.get("learner", {})
    env = learner.get("env", {})
    seen = env.get("observation", {})
    first = learner.get("curriculum", {}).get("first_stage", 1)
    stages = STAGES.get(first, f"from stage {first}")
    collision = f"{env.get('collision', 'tailored')} collisions"
    more = [f"history {seen['history']}"] if seen.get("history", 0) else []
    more += SPINS[seen.get("spin", "hidden")]
    more += ["prediction"] if seen.get("prediction", False) else []
    more += ["sample age"] if seen.get("age", False) else []
    filtered = seen.get("ball", "sampled") == "filtered"
    own = "37 numbers, ball filtered" if filtered else "37 numbers"
    if more == USUAL:
        told = "ball filtered" if filtered else ""
    else:
        told = " + ".join([own, *more] if filtered or not more else more)
    critic = seen.get("critic", "policy")
    teacher = env.get("teacher", {})
    taught = f"taught by {Path(teacher['policy']).name}" if teacher.get("policy") else ""
    taught += " with notes" if taught and teacher.get("notes") else ""
    return (
        (stages, stages),
        (taught, taught),
        (collision, "" if collision == "tailored collisions" else collision),
        (" + ".join([f"sees {own}", *more]), told),
        ("critic sees the truth", "")
        if critic == "privileged"
        else ("critic sees what the policy does", "critic sees no more"),
    )


def group(runs: Sequence[Run]) -> tuple[Group, ...]:
    """Return the runs by experiment, in the order they were given."""
    together: dict[str, list[Run]] = {}
    for run in runs:
        together.setdefault(repr(sorted(experiment(run.settings).items())), []).append(run)
    members = list(together.values())
    parts = [description(of_one[0].settings) for of_one in members]
    extras = _extras([experiment(of_one[0].settings) for of_one in members], parts)
    groups = []
    for of_one, part, extra in zip(members, parts, extras, strict=True):
        varies = [k for k in range(len(part)) if k == 0 or len({other[k] for other in parts}) > 1]
        label = ", ".join([part[k][1] for k in varies if part[k][1]] + extra)
        groups.append(Group(label, ", ".join([whole for whole, _ in part if whole] + extra), tuple(of_one)))
    return tuple(groups)


def _extras(
    experiments: Sequence[Mapping[str, Any]], parts: Sequence[tuple[tuple[str, str], ...]]
) -> list[list[str]]:
    """Return what to add to the names of experiments that have the same one: the settings that differ."""
    extras = []
    for own, name in zip(experiments, parts, strict=True):
        namesakes = [other for other, theirs in zip(experiments, parts, strict=True) if theirs == name]
        paths = {path for other in namesakes for path in other.keys() | own.keys()}
        differing = sorted(path for path in paths if len({repr(other.get(path)) for other in namesakes}) > 1)
        shown: dict[str, str] = {}  # a shared setting stands in several sections: once is enough
        for path in differing:
            last = path.split(".")[-1].replace("_", " ")
            shown.setdefault(last, f"{last} {own.get(path, 'unset')}")
        extras.append(list(shown.values()))
    return extras
