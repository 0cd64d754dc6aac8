"""Playing a fixed set of rallies with a deterministic policy, every one to its end."""

from collections.abc import Callable, Mapping
from typing import Annotated, Any, Final, Literal

import numpy as np
import numpy.typing as npt
from pydantic import Field

from common.env.rally_env import EnvConfig, FinishedRallies, Launches, RallyEnv, TeacherConfig
from common.physics.flight import FULL, SIMPLE
from common.policy.weights import Policy
from common.rally.launch import Purpose, RallyBlock, draw_rallies
from common.rally.noise import Condition
from common.rally.observation import Expectation
from common.rally.play import NO_SAMPLE
from common.rally.undisturbed import undisturbed
from services.evaluator.measures import Played

DEFAULT_ENVS = 250
EPISODES_EACH = 4  # whole ones that an environment has rallies for
TRAINING_ONLY: Final[Mapping[str, Any]] = {
    "go_on": 0.0,
    "foresee": 0.0,
    "hindsight": False,
    "teacher": TeacherConfig(),
}
"""What only training asks for has no place in a match: every flight is played to its end, and nobody is taught."""

# Settings of every command that plays a match
Environments = Annotated[
    int,
    Field(
        ge=1,
        le=65536,
        description="environments played together; each meets rallies / envs balls of the same other side",
    ),
]
PolicyExpectation = Annotated[
    Expectation | Literal["contract"],
    Field(
        description="how fast the robot of --policy expects balls to spin (env.observation.spin_expected), whatever it "
        "was trained with; contract: as the policy's says"
    ),
]


class FixedRallies:
    """A source that deals each rally of a set once, in order, and filler once they are dealt.

    Filler keeps environments busy while the last rallies of the set are still in play; it is not validated, so it
    is in no rate. Waiting for the set instead of counting to n leaves no bias towards rallies that end early.
    """

    def __init__(self, rallies: RallyBlock, filler: RallyBlock) -> None:
        self._rallies = rallies
        self._filler = filler
        self._dealt = 0
        self._filled = 0

    def take(self, count: int) -> Launches:
        """Return the next ``count`` launches."""
        fresh = min(count, len(self._rallies.seeds) - self._dealt)
        rows = slice(self._dealt, self._dealt + fresh)
        extra = (self._filled + np.arange(count - fresh)) % len(self._filler.seeds)
        self._dealt += fresh
        self._filled += count - fresh
        paths = None
        if self._rallies.paths is not None:  # filler flies freely: its paths end before they begin
            paths = np.full((count, *self._rallies.paths.shape[1:]), NO_SAMPLE)
            paths[:fresh] = self._rallies.paths[rows]
        return Launches(
            np.concatenate((self._rallies.launches[rows], self._filler.launches[extra])),
            np.concatenate((self._rallies.seeds[rows], self._filler.seeds[extra])),
            np.arange(count) < fresh,
            paths,
        )


def evaluation_rallies(count: int, launch: str, noise: str, seed: int, flight: str = "simple") -> RallyBlock:
    """Return the fixed rallies of an evaluation: the same for everyone who asks, and nobody trains on them."""
    model = SIMPLE if flight == "simple" else FULL
    return draw_rallies(count, seed=seed, preset=launch, noise=noise, purpose=Purpose.EVALUATION, model=model)


def environments(rallies: int, most: int, rounds: int) -> int:
    """Return how many environments share a match's rallies: no more than there are balls for.

    Where episodes go on, each needs room for many, or the set would be dealt as first balls alone.
    """
    room = rallies // (EPISODES_EACH * rounds) if rounds > 1 else rallies
    return min(most, max(1, room))


def play_match(
    policy: Policy,
    rallies: RallyBlock,
    config: EnvConfig,
    envs: int = DEFAULT_ENVS,
    breathe: Callable[[], None] = lambda: None,
) -> Played:
    """Return what ``policy`` made of ``rallies``, without exploration noise, in the order they ended.

    Args:
        policy: Who plays.
        rallies: What is played, each once.
        config: The task.
        envs: Environments played together, at most.
        breathe: Called between control steps, so that the caller can look after other things, or raise.

    A rally in which the simulation failed is left out: there are fewer rows then.
    """
    envs = environments(len(rallies.seeds), envs, config.rounds)
    filler = draw_rallies(64, seed=0, noise=config.noise, purpose=Purpose.FALLBACK)
    task = config.model_copy(update=dict(TRAINING_ONLY))
    env = RallyEnv(envs, task, FixedRallies(rallies, filler), stage=3, path_rows=rallies.path_rows)
    obs = env.reset()
    ended: list[FinishedRallies] = []
    left = len(rallies.seeds)
    while left > 0:
        breathe()
        step = env.step(policy.act(obs))
        obs = step.obs
        if step.finished.rows.size:
            ended.append(step.finished)
            # By seed: a rally that a fault of the simulation ended is over too, though it is in no rate.
            left -= int(np.isin(step.finished.seeds, rallies.seeds).sum())

    def rated(name: str) -> npt.NDArray[Any]:
        return np.concatenate([getattr(f, name)[f.validated] for f in ended])

    seeds, conditions = rated("seeds"), rated("conditions")
    launches = launches_of(seeds, rallies)
    model = SIMPLE if config.flight == "simple" else FULL
    bounces, arrivals = undisturbed(launches, conditions, model)
    return Played(
        seeds=seeds,
        outcomes=rated("outcomes"),
        landing_errors=rated("landing_errors"),
        caught=rated("caught"),
        over=rated("over"),
        returns=rated("returns"),
        rounds=rated("rounds"),
        launches=launches,
        landings=rated("landings"),
        targets=conditions[:, [Condition.TARGET_X, Condition.TARGET_Y]],
        bounces=bounces[:, :2],
        arrivals=arrivals,
    )


def launches_of(seeds: npt.NDArray[np.uint64], rallies: RallyBlock) -> npt.NDArray[np.float64]:
    """Return the launches (n, 11) of the rallies with these seeds (n,), all of which ``rallies`` must hold."""
    order = np.argsort(rallies.seeds)
    return rallies.launches[order[np.searchsorted(rallies.seeds, seeds, sorter=order)]]
