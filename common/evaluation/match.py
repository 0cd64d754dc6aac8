"""Playing a fixed set of rallies with a deterministic policy, every one to its end."""

from collections.abc import Callable
from typing import Any, Final, Protocol

import numpy as np
import numpy.typing as npt

from common.env.rally_env import FinishedRallies, Launches, RallyEnv, RallySource
from common.evaluation.config import DEFAULT_ENVS, MatchSpin
from common.evaluation.measures import MatchResult
from common.evaluation.opponents import FILLED, FilledDeck, OpponentRallies, in_equal_batches
from common.evaluation.robot_measures import RobotMonitor
from common.evaluation.unplayed_flight import unplayed_flight
from common.policy.contract import Contract
from common.task.config import PlayConditions, TaskConfig
from common.task.experience import MATCH
from common.task.launch import Purpose, RallyBlock, draw_rallies
from common.task.randomization import RallyParameter, RandomizationProfile

EPISODES_EACH: Final = 4  # each environment has rallies for at least so many whole episodes

# Settings of every command that plays a match


def match_task(
    contract: Contract, conditions: PlayConditions, expected_spin: MatchSpin = "contract"
) -> TaskConfig:
    """Return the task of a match: the contract's, under the match's conditions."""
    return contract.expecting(expected_spin).task.under(conditions)


class Acts(Protocol):
    """Something that plays: a policy."""

    def act(self, obs: npt.NDArray[np.float32]) -> npt.NDArray[np.float32]:
        """Return actions (B, 7) for observations (B, D)."""


class FixedRallies:
    """A source that gives each rally of a set once, in order, and then filler rallies.

    Filler rallies keep environments busy while the last rallies of the set are still in play. They are not validated,
    so no rate counts them. The match waits for the whole set. If it stopped after n rallies, rallies that end early
    would be counted too often.
    """

    def __init__(self, rallies: RallyBlock, filler: RallyBlock) -> None:
        self._rallies = rallies
        self._deck = FilledDeck(rallies, filler)
        self._dealt = 0

    def take(self, rows: npt.NDArray[np.int64]) -> Launches:
        """Return the next launches, one for each of the environments ``rows`` (n,)."""
        fresh = min(rows.size, len(self._rallies.seeds) - self._dealt)
        dealt = np.full(rows.size, FILLED)
        dealt[:fresh] = self._dealt + np.arange(fresh)
        self._dealt += fresh
        return self._deck.launches(dealt)


def evaluation_rallies(count: int, task: TaskConfig, seed: int) -> RallyBlock:
    """Return the fixed rallies of an evaluation: the same for every caller, and never used in training."""
    return draw_rallies(count, task, seed=seed, purpose=Purpose.EVALUATION)


def environments(rallies: int, most: int, rounds: int) -> int:
    """Return how many environments share a match's rallies: at most one per rally.

    With several rounds, each environment needs rallies for several episodes. Otherwise all balls of the set would be
    first balls.
    """
    room = rallies // (EPISODES_EACH * rounds) if rounds > 1 else rallies
    return min(most, max(1, room))


def play_match(
    policy: Acts,
    rallies: RallyBlock,
    task: TaskConfig,
    envs: int = DEFAULT_ENVS,
    on_tick: Callable[[], None] = lambda: None,
    opponents: npt.NDArray[np.int64] | None = None,
    profile: RandomizationProfile | None = None,
    on_left: Callable[[int], None] = lambda _left: None,
) -> MatchResult:
    """Return the result of ``rallies``, played without exploration noise, in the order in which they ended.

    Args:
        policy: The policy.
        rallies: The set, each played once.
        task: The task.
        envs: Environments played together, at most.
        on_tick: Called between control steps, so that the caller can do other work, or raise.
        opponents: (n,) number of each rally's opponent. One environment plays all balls of an opponent, in their order,
            and then knows nothing of the next one. With ``carry_over`` 0 and one round the result does not depend on
            ``envs``, and its rows have the order of ``rallies``. None: every environment has one opponent.
        profile: Ranges of what differs from rally to rally; None: those that the task names.
        on_left: Called with the number of rallies that have not ended yet, when some have.

    A rally in which the simulation failed is left out, so there may be fewer rows than rallies.
    """
    count = len(rallies.seeds) if opponents is None else len(np.unique(opponents))
    envs = environments(count, envs, task.rounds)
    plain = TaskConfig(randomization=task.randomization)
    filler = draw_rallies(64, plain, seed=0, purpose=Purpose.FALLBACK)
    source: RallySource = FixedRallies(rallies, filler)
    act: Callable[[npt.NDArray[np.float32]], npt.NDArray[np.float32]] = policy.act
    if opponents is not None:
        source, act = OpponentRallies(rallies, opponents, filler), in_equal_batches(policy.act)
    env = RallyEnv(
        envs,
        task,
        source,
        stage=3,
        experience=MATCH,
        path_rows=rallies.path_rows,
        keeps_hits=True,
        profile=profile,
    )
    monitor = RobotMonitor(env)
    obs = env.reset()
    ended: list[FinishedRallies] = []
    left = len(rallies.seeds)
    while left > 0:
        on_tick()
        actions = act(obs)
        step = env.step(actions)
        monitor.update(actions, step)
        obs = step.obs
        if step.finished.rows.size:
            ended.append(step.finished)
            # By seed: a rally that the simulation's failure ended is over too, but no rate counts it.
            left -= int(np.isin(step.finished.seeds, rallies.seeds).sum())
            on_left(left)

    def rated(name: str) -> npt.NDArray[Any]:
        return np.concatenate([getattr(f, name)[f.validated] for f in ended])

    seeds, parameters = rated("seeds"), rated("parameters")
    launches = launches_of(seeds, rallies)
    bounces, arrivals = unplayed_flight(launches, parameters, task.flight_model)
    played = MatchResult(
        seeds=seeds,
        outcomes=rated("outcomes"),
        landing_errors=rated("landing_errors"),
        caught=rated("caught"),
        over=rated("over"),
        returns=rated("returns"),
        rounds=rated("rounds"),
        launches=launches,
        landings=rated("landings"),
        targets=parameters[:, [RallyParameter.TARGET_X, RallyParameter.TARGET_Y]],
        bounces=bounces[:, :2],
        arrivals=arrivals,
        robot=monitor.record(),
    )
    return played if opponents is None else played.of(np.argsort(_rows_of(seeds, rallies)))


def _rows_of(seeds: npt.NDArray[np.uint64], rallies: RallyBlock) -> npt.NDArray[np.int64]:
    """Return which row of ``rallies`` each of these seeds (n,) is; it must hold all of them."""
    order = np.argsort(rallies.seeds)
    return order[np.searchsorted(rallies.seeds, seeds, sorter=order)]


def launches_of(seeds: npt.NDArray[np.uint64], rallies: RallyBlock) -> npt.NDArray[np.float64]:
    """Return the launches (n, 12) of the rallies with these seeds (n,), all of which ``rallies`` must hold."""
    return rallies.launches[_rows_of(seeds, rallies)]
