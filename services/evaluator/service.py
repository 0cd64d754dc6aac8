"""The evaluator's shell: follows a run, plays fixed rallies with its newest policy, keeps the best."""

import logging
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from threading import Event
from typing import Any, Final

from common.comms.codec import DecodeError, decode
from common.comms.messages import AVERAGE, PolicySnapshot
from common.comms.transport import Flow, PendingReply, Reply, Transport
from common.evaluation.match import evaluation_rallies, play_match
from common.evaluation.measures import measures
from common.evaluation.robot_measures import robot_part
from common.policy.contract import PolicyError, contract_hash, contract_of
from common.policy.folder import Policy, load_policy, save_policy
from common.policy.normalizer import Moments
from common.policy.weights import install, new_network
from common.service.member import Member
from common.service.metrics import Metrics
from common.service.run_folder import RunFolder
from common.service.table import Table
from common.task.observation import critic_layout
from services.evaluator.best import is_comparable, match_of, score
from services.evaluator.config import EvaluatorConfig

log = logging.getLogger(__name__)

IDLE_WAIT_S: Final = 0.2
QUIET_AFTER_S: Final = (
    60.0  # without a new policy: then the learner is asked less often, since a policy has 0.4 to 2 MB
)
QUIET_PAUSE_S: Final = 5.0
ANSWER_S: Final = 5.0  # limit for the learner's answer with the policy
_RATES: Final = (
    *("catch_rate", "over_rate", "return_rate", "return_after_catch"),
    *("target_error_mean", "target_error_median"),
)
CURVE: Final = ("version", "frames", "stage", "seconds", *_RATES, "rallies")


class _StopRequested(Exception):  # noqa: N818 - not an error
    """A stop was requested within a match."""


class EvaluatorService:
    """Follows one run.

    Args:
        config: Settings.
        transport: Connection to the hub.
        metrics: Receives the service's numbers.
        incarnation: Number of this life of the service.
        clock: Returns seconds.
    """

    def __init__(
        self,
        config: EvaluatorConfig,
        transport: Transport,
        metrics: Metrics,
        incarnation: int,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._config, self._transport, self._metrics, self._clock = config, transport, metrics, clock
        self._member = Member("evaluator", config, transport, metrics, incarnation)
        self._network = new_network(config.network, config.task.observation)
        self._contract_hash = contract_hash(config.task, config.network)
        self._folder = RunFolder.of(config.run, config.folder)
        self._folder.report.mkdir(parents=True, exist_ok=True)
        self._curve = Table(self._folder.evaluations, CURVE)
        self._task = config.task.model_copy(update={"rounds": config.rounds})
        self._rallies = evaluation_rallies(config.rallies, self._task, config.seed)
        self._played = (-1, -1)
        self._best = self._best_so_far()
        self._stop = Event()
        self._born = clock()
        self._next_play = self._born
        self._newest = self._born  # [s] time of the last new policy
        self._asked: PendingReply | None = None
        self._last: dict[str, float] = {}
        self.evaluations = 0
        self._member.join()

    @property
    def state(self) -> str:
        """State in the heartbeat: waiting or playing."""
        return self._member.state

    def run(self, stop: Event) -> None:
        """Evaluate until ``stop`` is set or a drain is requested."""
        self._stop = stop
        try:
            while not stop.is_set() and not self._member.is_draining:
                self.step()
                self._transport.wait(IDLE_WAIT_S)
        except _StopRequested:
            log.info("stopped within a match, which is not counted")
        self._member.leave()

    def step(self) -> None:
        """Request the policy when it is due, and evaluate it when it has arrived and is trained."""
        self._member.answer_control()
        now = self._clock()
        self._member.note_link(now)
        if self._asked is None and now >= self._next_play:
            # Usually the running mean of the weights: no actor plays it, so it is requested and not broadcast.
            self._asked = self._transport.request(self._member.keys.policy(), AVERAGE, ANSWER_S, Flow.POLICY)
        answer = self._asked.poll() if self._asked else None
        if answer is not None:
            self._asked = None
            self._next_play = now + (IDLE_WAIT_S if now - self._newest < QUIET_AFTER_S else QUIET_PAUSE_S)
            snapshot = self._read(answer.payload) if isinstance(answer, Reply) else None
            if snapshot and (snapshot.generation, snapshot.version) != self._played:
                self._take(snapshot)
        self._beat()

    def _beat(self) -> None:
        if self._member.is_due(self._clock()):
            self._member.beat({"evaluations": self.evaluations}, self._last)

    def _on_tick(self) -> None:
        """Answer requests within a match, which takes longer than a caller waits."""
        self._member.answer_control()
        self._beat()
        if self._stop.is_set() or self._member.is_draining:
            raise _StopRequested

    def _best_so_far(self) -> tuple[int, float] | None:
        """Return the score of the best policy of an earlier process, if it was measured in the same match."""
        try:
            contract = load_policy(self._folder.best_policy).contract
            if not is_comparable(contract, self._config):
                return None
            return score(contract.stage, dict(contract.measures))
        except (PolicyError, KeyError):
            return None

    def _read(self, payload: bytes) -> PolicySnapshot | None:
        try:
            return decode(payload, PolicySnapshot)
        except DecodeError as error:
            self._member.refuse("policy", error)
            return None

    def _take(self, snapshot: PolicySnapshot) -> None:
        """Evaluate a policy that is new, unless it is of another task or not trained yet."""
        moments = self._installed(snapshot)
        # Before its first update a run has no policy worth keeping, and actors and learner need the cores
        if moments is not None and not snapshot.frames:
            return
        self._played = (snapshot.generation, snapshot.version)
        if moments is not None:
            self._member.state = "playing"
            self._evaluate(snapshot, moments)
            self._member.state = "waiting"
        self._newest = self._clock()
        self._next_play = self._newest + self._config.interval_s

    def _installed(self, snapshot: PolicySnapshot) -> Moments | None:
        """Return the moments of a policy whose weights the network has now, or None if it is refused."""
        try:
            layout = critic_layout(self._config.task.observation)
            return install(self._network, snapshot, layout, self._contract_hash, "evaluator")
        except PolicyError as error:
            self._member.refuse("policy", error)
            return None

    def _evaluate(self, snapshot: PolicySnapshot, moments: Moments) -> None:
        config, started = self._config, self._clock()
        contract = contract_of(
            config.task,
            config.experience,
            config.network,
            run=snapshot.run,
            generation=snapshot.generation,
            version=snapshot.version,
            stage=snapshot.stage,
            frames=snapshot.frames,
        )
        policy = Policy(self._network, moments, contract)
        played = play_match(policy, self._rallies, self._task, config.envs, self._on_tick)
        found, robot = measures(played), robot_part(played.robot, self._task.robot)
        self.evaluations += 1
        seconds = self._clock() - started
        measured = contract.model_copy(update={"measures": found | robot | {"match": match_of(config)}})
        policy = replace(policy, contract=measured)
        if config.keep_policies:  # before its row: whoever reads the curve finds the policy
            self._save(policy, self._folder.evaluated_policy(snapshot.version))
        self._report(snapshot, found, seconds)
        reached = score(snapshot.stage, found)
        is_better = self._best is None or reached > self._best
        if is_better and self._save(policy, self._folder.best_policy):
            self._best = reached

    def _save(self, policy: Policy, folder: Path) -> bool:
        """Write a policy, and return whether that succeeded: on a full disk the evaluations go on."""
        try:
            save_policy(folder, policy.network, policy.moments, policy.contract)
        except OSError as error:
            log.error("can't write policy=%s reason=%s", folder, error.strerror)
            return False
        return True

    def _report(self, snapshot: PolicySnapshot, found: dict[str, Any], seconds: float) -> None:
        """Write an evaluation to log, curve, heartbeat and metrics."""
        log.info(
            "evaluated version=%d frames=%d stage=%d catch=%.3f return=%.3f error=%s seconds=%.1f",
            snapshot.version,
            snapshot.frames,
            snapshot.stage,
            found["catch_rate"],
            found["return_rate"],
            found["target_error_mean"],
            seconds,
        )
        where = {"version": snapshot.version, "frames": snapshot.frames, "stage": snapshot.stage}
        self._curve.append(found | where | {"seconds": round(self._clock() - self._born, 1)})
        self._last = {name: float(found[name]) for name in _RATES if found.get(name) is not None}
        self._last |= {"frames": float(snapshot.frames), "stage": float(snapshot.stage)}
        for metric, name in (
            ("topspin_catch_rate", "catch_rate"),
            ("topspin_over_rate", "over_rate"),
            ("topspin_return_rate", "return_rate"),
            ("topspin_target_error_meters", "target_error_mean"),
        ):
            if found[name] is not None:
                self._metrics.set(metric, found[name])
        self._metrics.set("topspin_policy_version", snapshot.version)
        self._metrics.inc("topspin_phase_seconds_total", seconds, phase="evaluate")
        self._metrics.inc("topspin_episodes_total", found["rallies"])
