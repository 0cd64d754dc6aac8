"""Which runs are one experiment, and its name: runs that differ only in their seed."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from services.actor.config import env_count
from services.learner.config import LAST_STAGE, minibatch_of
from topspin.report.collect import Run

BOOKKEEPING: Final = frozenset(
    {
        *("run", "recipe", "seed", "minutes", "frames", "panel", "evaluate", "final_rallies", "metrics_port"),
        *("silence_warning_s", "checkpoint_interval_s", "writers", "device", "watchdog_s"),
        *("learner.history", "actor.history"),  # task.observation.history is another thing
        *("endpoint", "peers", "connect_timeout_s", "lease_s", "max_message_mib"),
        *("tls", "metrics_host", "log_level", "status_interval_s"),
    }
)
"""Settings that name, monitor or connect a run, by name or path: they do not distinguish experiments."""

EVALUATOR: Final = "evaluator"  # measures a run without changing it


@dataclass(frozen=True, slots=True)
class Group:
    """Runs of one experiment, which differ only in their seed."""

    label: str  # short: the difference from the other groups
    description: str  # in full
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
    """Return the settings of a run that define the experiment, by dotted path.

    Of actors and their environments it is the product that counts: 2 actors of 128 make the datasets of one of 256.
    A minibatch is that of these datasets.
    """
    found = {
        path: value
        for path, value in leaves(settings)
        if path.split(".")[0] != EVALUATOR and not BOOKKEEPING & {path, path.split(".")[-1]}
    }
    if "actors" in found:
        actors, rollouts = found["actors"], found.get("learner.intake.dataset_rollouts")
        envs = env_count(found.get("actor.envs", 0), actors)
        if not rollouts:
            del found["actors"]
            found.pop("actor.envs", None)
            found["environments"] = actors * envs
        if "learner.ppo.minibatch" in found:
            dataset = (rollouts or actors) * envs * found["actor.horizon"]
            found["learner.ppo.minibatch"] = minibatch_of(found["learner.ppo.minibatch"], dataset)
    return found


def stages_of(runs: Sequence[Run]) -> str:
    """Return the stages that were trained, such as "stages 1+2"; without a record, those that the settings name."""
    reached = sorted({stage for run in runs if run.training for stage in run.training.reached})
    if not reached:
        first = runs[0].settings.get("learner", {}).get("curriculum", {}).get("first_stage", 1)
        reached = list(range(first, LAST_STAGE + 1))
    return f"stages {'+'.join(map(str, reached))}" if len(reached) > 1 else f"stage {reached[0]} only"


def description(settings: Mapping[str, Any], stages: str) -> tuple[tuple[str, str], ...]:
    """Return the experiment's names: stages, teacher, contacts, observation, critic; each long and short.

    The short name of a default is empty.
    """
    task, experience = settings.get("task", {}), settings.get("experience", {})
    observation = task.get("observation", {})
    collision = f"{task.get('collision', 'tailored')} collisions"
    more = [f"history {observation['history']}"] if observation.get("history", 0) else []
    more += SPINS[observation.get("spin", "hidden")]
    more += ["prediction"] if observation.get("prediction", False) else []
    more += ["sample age"] if observation.get("age", False) else []
    filtered = observation.get("ball", "sampled") == "filtered"
    own = "37 numbers, ball filtered" if filtered else "37 numbers"
    if more == USUAL:
        short = "ball filtered" if filtered else ""
    else:
        short = " + ".join([own, *more] if filtered or not more else more)
    critic = observation.get("critic", "policy")
    teacher = experience.get("teacher", {})
    distilled = f"distilled from {Path(teacher['policy']).name}" if teacher.get("policy") else ""
    return (
        (stages, stages),
        (distilled, distilled),
        (collision, "" if collision == "tailored collisions" else collision),
        (" + ".join([f"observes {own}", *more]), short),
        ("critic observes the truth", "")
        if critic == "privileged"
        else ("critic observes what the policy does", "critic observes no more"),
    )


def group(runs: Sequence[Run]) -> tuple[Group, ...]:
    """Return the runs by experiment, in the order in which they were given."""
    by_experiment: dict[str, list[Run]] = {}
    for run in runs:
        by_experiment.setdefault(repr(sorted(experiment(run.settings).items())), []).append(run)
    members = list(by_experiment.values())
    parts = [description(of_one[0].settings, stages_of(of_one)) for of_one in members]
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
    """Return additions to the names of experiments that have the same name: the settings that differ."""
    extras = []
    for own, name in zip(experiments, parts, strict=True):
        same_name = [other for other, theirs in zip(experiments, parts, strict=True) if theirs == name]
        paths = {path for other in same_name for path in other.keys() | own.keys()}
        differing = sorted(path for path in paths if len({repr(other.get(path)) for other in same_name}) > 1)
        shown: dict[str, str] = {}
        for path in differing:
            last = path.split(".")[-1].replace("_", " ")
            shown.setdefault(last, f"{last} {own.get(path, 'unset')}")
        extras.append(list(shown.values()))
    return extras
