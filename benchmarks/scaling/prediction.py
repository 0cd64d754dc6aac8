"""The best split of so many cores into actors and learners, and what bounds it."""

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from typing import Final

from benchmarks.scaling.costs import Costs, Line, Network, gather_s, sum_s
from benchmarks.scaling.large_batches import FramesToGoal
from benchmarks.scaling.plan import Plan, available_cores
from benchmarks.scaling.simulate import SMALL_EXCHANGES, VALUE_BYTES, Result, simulate
from common.errors import ReportedError
from services.actor.config import ENVS, FEWEST_ENVS
from services.learner.config import PPOConfig

RANKS: Final = (1, 2, 3, 4, 6, 8, 12, 16, 24, 32, 48, 64)
SHARES: Final = (1.0, 0.75, 0.5, 0.35, 0.25, 0.15, 0.1)  # of the cores that learners leave, as actors
FEW_CORES: Final = 8  # up to here every number of actors is tried
SIZES: Final = (4, 8, 16, 32, 64, 128, 256)  # environments of an actor, where the size of a dataset counts
FEWEST, MOST = 6, 40  # splits that are simulated shortly: those that the estimate puts first
EVENTS_OF_SEARCH: Final = 4000  # cores times these splits: a large fleet takes a second each
FINALISTS: Final = 4  # splits that are simulated for longer: the best of those
SHORT, LONG = (3, 4), (8, 24)  # datasets of a simulation: before its measurement, and in it
EVENTS_OF_RUN: Final = 6000  # datasets of a large fleet are many events each, and are all alike
TWICE: Final = 2.0

# Which costs are whose. Every cost is one part's; shares of background load and sizes are nobody's
PARTS: Final[dict[str, tuple[str, ...]]] = {
    "actors": ("play_s", "adopt_s"),
    "learner": ("reading", "step", "whole_frame_s", "publish_s"),
    "hub and messages": ("send", "opening", "hub", "hub_policy_byte_s", "latency_s"),
    "all-reduce": ("exchange",),
    "start-up": ("start_s",),
}
LEARNING: Final = "learning with large datasets"


@dataclass(frozen=True, slots=True)
class Setting:
    """What a prediction depends on, besides the split."""

    costs: Costs
    network: Network
    law: FramesToGoal | None = None  # None: no trainings were measured
    learner_frames_per_s: float = 0.0  # of a learner on an accelerator; 0: learners are on the cores


@dataclass(frozen=True, slots=True)
class Prediction:
    """One number of cores."""

    plan: Plan
    result: Result
    start_s: float
    minutes: float | None  # to the goal; None: unknown
    is_extrapolated: bool  # no training was measured with datasets of this size
    bound: str  # the part whose doubled speed helps most
    gains: dict[str, float]  # by part: how many times as fast the run is, if the part is twice as fast
    bytes_per_s: float  # of rollouts at the hub


def predict(cores: int, setting: Setting) -> Prediction:
    """Return the best split of so many cores that was found, and its bound."""
    plan = best(cores, setting)
    result = simulated(plan, setting)
    gains = gains_of(plan, result, setting)
    law = setting.law
    return Prediction(
        plan,
        result,
        start_s(plan, setting.costs),
        duration(plan, setting, result.frames_per_s) / 60.0 if law else None,
        law is not None and law.is_extrapolated(plan.dataset),
        max(gains, key=lambda part: gains[part]),
        gains,
        result.frames_per_s / plan.rollout * setting.costs.rollout.of(plan.rollout),
    )


def best(cores: int, setting: Setting) -> Plan:
    """Return the split with the shortest way to the goal, of those that are looked at.

    A formula says which ones are simulated shortly, and these which ones for longer.

    Raises:
        ReportedError: There is no split.
    """

    def first(plans: Iterable[Plan], count: int, rate: Callable[[Plan], float]) -> list[Plan]:
        return sorted(plans, key=lambda plan: duration(plan, setting, rate(plan)))[:count]

    most = max(FEWEST, min(MOST, EVENTS_OF_SEARCH // max(cores, 1)))
    plans = first(candidates(cores, setting), most, lambda plan: estimate(plan, setting))
    if not plans:
        raise ReportedError(f"{cores} cores are too few for an actor, a learner and what runs beside them")
    plans = first(plans, FINALISTS, lambda plan: simulated(plan, setting, SHORT).frames_per_s)
    return first(plans, 1, lambda plan: simulated(plan, setting).frames_per_s)[0]


def gains_of(plan: Plan, result: Result, setting: Setting) -> dict[str, float]:
    """Return how many times as fast a run is if a part is twice as fast, by part that it has."""
    now, gains = duration(plan, setting, result.frames_per_s), {}
    for part in (*PARTS, LEARNING):
        faster_plan, faster = twice_as_fast(part, plan, setting)
        if (faster_plan, faster) == (plan, setting):
            continue
        is_same_run = part in ("start-up", LEARNING)
        rate = result.frames_per_s if is_same_run else simulated(faster_plan, faster).frames_per_s
        gains[part] = now / duration(plan, faster, rate)
    return gains


def simulated(plan: Plan, setting: Setting, length: tuple[int, int] = LONG) -> Result:
    """Return what a plan does; a large fleet for fewer datasets."""
    most = max(SHORT[1], EVENTS_OF_RUN // (plan.actors + 20 * plan.learners))
    warm_up, datasets = length
    return simulate(
        plan, setting.costs, setting.network, max(SHORT[0], min(warm_up, most // 2)), min(datasets, most)
    )


def candidates(cores: int, setting: Setting) -> Iterator[Plan]:
    """Yield the splits that are looked at.

    Without a law of learning, actors have the environments that the program gives them: larger datasets always make
    more frames, so a search among them would only find the largest.
    """
    on_cores = not setting.learner_frames_per_s
    for ranks in RANKS if on_cores else (1,):
        left = cores - ranks
        if ranks > max(cores // 2, 1):
            continue
        counts = {max(1, round(share * left)) for share in SHARES}
        if cores <= FEW_CORES:  # also more processes than cores: they share what others leave
            counts = set(range(1, cores + 2))
        for actors in sorted(counts):
            for envs in SIZES if setting.law else (max(FEWEST_ENVS, ENVS // actors),):
                if actors < ranks:
                    continue
                plan = Plan(
                    cores=cores,
                    actors=actors,
                    learners=ranks,
                    envs=envs,
                    learner_frames_per_s=setting.learner_frames_per_s,
                    passes=PPOConfig().mini_epochs,
                )
                if _leaves_cores(plan, setting.costs):
                    yield plan


def _leaves_cores(plan: Plan, costs: Costs) -> bool:
    try:
        return available_cores(plan, costs) > 0
    except ReportedError:
        return False


def estimate(plan: Plan, setting: Setting) -> float:
    """Return frames/s by the busiest part alone: a dataset takes as long as the part that is slowest with it."""
    costs, network, frames = setting.costs, setting.network, plan.dataset
    size = costs.rollout.of(plan.rollout)
    play = costs.playing(plan.envs) + costs.send.of(size) + costs.adopt_s
    part = -(-plan.actors // plan.learners)  # rollouts of the rank with most
    opening = part * costs.opening.of(plan.rollout)
    steps = plan.passes * plan.steps
    update = part * costs.reading.of(plan.rollout) + costs.whole_frame_s * frames
    update += steps * costs.step.of(plan.passes * part * plan.rollout / steps)
    if plan.learner_frames_per_s:
        update = frames / plan.learner_frames_per_s
    training = opening + update + costs.publish_s
    small = gather_s(costs, network, plan.learners, 0.0)
    exchanging = steps * sum_s(costs, network, plan.learners, costs.gradient_bytes)
    exchanging += (SMALL_EXCHANGES + plan.passes) * small
    exchanging += gather_s(costs, network, plan.learners, frames * VALUE_BYTES)
    hub = plan.actors * (costs.hub.of(size) + costs.policy_bytes * costs.hub_policy_byte_s)
    link = (
        plan.actors * max(size, costs.policy_bytes) * network.remote_share(plan.cores) / network.bytes_per_s
    )
    work = plan.actors * play + plan.learners * training + hub
    cores = available_cores(plan, costs)
    slowdown = costs.slowdown if plan.actors + plan.learners >= plan.cores else 1.0
    return frames / max(slowdown * play, slowdown * training + exchanging, hub, link, slowdown * work / cores)


def start_s(plan: Plan, costs: Costs) -> float:
    """Return the time from the start of the processes to the first rollout [s]: all start at once, and share the cores.

    Generators start sooner than the others, and the evaluator gives way.
    """
    return costs.start_s * max(1.0, (plan.actors + plan.learners) / plan.cores)


def duration(plan: Plan, setting: Setting, frames_per_s: float) -> float:
    """Return the time to the goal [s]; of a frame, where nothing is known about the goal."""
    if setting.law is None:
        return 1.0 / frames_per_s
    return start_s(plan, setting.costs) + setting.law.frames(plan.dataset) / frames_per_s


def twice_as_fast(part: str, plan: Plan, setting: Setting) -> tuple[Plan, Setting]:
    """Return what is left of a plan's setting if one part is twice as fast; the same where it changes nothing."""
    if part == LEARNING:
        if setting.law is None:
            return plan, setting
        return plan, replace(setting, law=replace(setting.law, noise=TWICE * setting.law.noise))
    if (part == "all-reduce" and plan.learners == 1) or (part == "start-up" and setting.law is None):
        return plan, setting
    costs = {name: _halved(getattr(setting.costs, name)) for name in PARTS[part]}
    setting = replace(setting, costs=setting.costs.model_copy(update=costs))
    if part == "learner":
        plan = replace(plan, learner_frames_per_s=TWICE * plan.learner_frames_per_s)
    link = setting.network
    if part == "hub and messages" or (part == "all-reduce" and plan.learners > link.host_cores):
        faster = link.model_copy(
            update={"bytes_per_s": TWICE * link.bytes_per_s, "latency_s": link.latency_s / TWICE}
        )
        setting = replace(setting, network=faster)
    return plan, setting


def _halved(cost: float | Line | dict[int, float]) -> float | Line | dict[int, float]:
    if isinstance(cost, Line):
        return cost.times(1.0 / TWICE)
    if isinstance(cost, dict):
        return {size: seconds / TWICE for size, seconds in cost.items()}
    return cost / TWICE
