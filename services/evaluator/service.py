"""The evaluator's shell: follows a run, plays fixed rallies with its newest policy, keeps the best."""

import csv
import logging
import time
from collections.abc import Callable
from threading import Event
from typing import Any

from pydantic import ValidationError

from common.comms.codec import DecodeError, decode, decode_one_of, encode
from common.comms.keys import Keys
from common.comms.messages import AVERAGE, Command, Control, ControlReply, PolicySnapshot, Status
from common.comms.transport import Flow, PendingReply, Reply, Transport
from common.env.rally_env import EnvConfig
from common.metrics import Metrics
from common.policy.weights import (
    Contract,
    Policy,
    PolicyError,
    contract_of,
    install,
    load_policy,
    new_network,
    save_policy,
    task_hash,
)
from common.rally.observation import critic_layout
from common.run_folder import RunFolder
from services.evaluator.config import EvaluatorConfig
from services.evaluator.match import TRAINING_ONLY, evaluation_rallies, play_match
from services.evaluator.measures import measures

log = logging.getLogger(__name__)

IDLE_WAIT_S = 0.2
ANSWER_S = 5.0  # for the learner to answer with the policy
CURVE = (
    "version",
    "frames",
    "stage",
    "seconds",
    "catch_rate",
    "over_rate",
    "return_rate",
    "return_after_catch",
    "target_error_mean",
    "target_error_median",
    "rallies",
)


class _AskedToStop(Exception):  # noqa: N818 - not an error
    """A stop came within a match."""


def score(stage: int, found: dict[str, Any]) -> tuple[int, float]:
    """Return what "best" compares: a later stage first, then what the stage is for.

    Stages 1 and 2: the catch rate. Stage 3: the return rate less the landing error, a centimetre for a percent: by the
    return rate alone a policy that aims at the middle of the table would be kept.
    """
    if stage < 3:
        return stage, found["catch_rate"] or 0.0
    error = found["target_error_mean"]
    return stage, (found["return_rate"] or 0.0) - (error if error is not None else 1.0)


def match_of(config: EvaluatorConfig) -> dict[str, Any]:
    """Return what is played, as it stands with a policy's measures."""
    return {
        "rallies": config.rallies,
        "launch": config.launch,
        "noise": config.noise,
        "rounds": config.rounds,
    }


def _match_in(contract: Contract) -> dict[str, Any]:
    """Return the match that a contract's measures are of; contracts of earlier releases say it in other places."""
    rallies = contract.measures.get("rallies")
    earlier = {"rallies": rallies, "launch": contract.launch, "noise": contract.noise, "rounds": 1}
    found: dict[str, Any] = contract.measures.get("match", earlier)
    return found


def measured_alike(contract: Contract, config: EvaluatorConfig) -> bool:
    """Return whether a policy was measured as ``config`` asks for: as many balls of the same kind, in the same task."""
    irrelevant = {"reward", "noise", "rounds", *TRAINING_ONLY}  # a match has its own, or none
    try:
        theirs = EnvConfig.model_validate(contract.env)
    except ValidationError:
        return False
    return _match_in(contract) == match_of(config) and (
        theirs.model_dump(exclude=irrelevant) == config.env.model_dump(exclude=irrelevant)
    )


class EvaluatorService:
    """Follows one run.

    Args:
        config: Settings.
        transport: Connection to the hub.
        metrics: Where its numbers go.
        incarnation: Of this life.
        clock: Seconds.
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
        self._network = new_network(config.network, config.env.observation)
        self._contract_hash = task_hash(config.network, config.env.model_dump(mode="json"), config.launch)
        self._incarnation = incarnation
        self._keys = keys = Keys(config.run)
        self._control = transport.serve(keys.ctl("evaluator", config.id), capacity=16)
        self._alive = transport.declare_alive(keys.alive("evaluator", config.id, incarnation))
        self._folder = RunFolder.of(config.run, config.folder)
        self._folder.report.mkdir(parents=True, exist_ok=True)
        self._rallies = evaluation_rallies(
            config.rallies, config.launch, config.noise, config.seed, config.env.flight
        )
        self._played = (-1, -1)
        self._best = self._best_so_far()
        self._stop = Event()
        self._born = clock()
        self._next_play = self._born
        self._next_status = 0.0
        self._asked: PendingReply | None = None
        self._last: dict[str, float] = {}
        self._stopping = False
        self.evaluations = 0
        self.state = "waiting"

    def run(self, stop: Event) -> None:
        """Evaluate until ``stop`` is set or a stop is asked for."""
        self._stop = stop
        try:
            while not stop.is_set() and not self._stopping:
                self.step()
                self._transport.wait(IDLE_WAIT_S)
        except _AskedToStop:
            log.info("stopped within a match, which counts for nothing")
        self._alive.close()

    def step(self) -> None:
        """Ask for the policy if it is time, and evaluate it once it has come."""
        self._obey()
        now = self._clock()
        if self._asked is None and now >= self._next_play:
            # The running mean of the weights, which nobody plays while training: so it isn't broadcast, but asked for.
            self._asked = self._transport.request(self._keys.policy(), AVERAGE, ANSWER_S, Flow.POLICY)
        outcome = self._asked.poll() if self._asked else None
        if outcome is not None:
            self._asked = None
            self._next_play = now + IDLE_WAIT_S
            snapshot = self._read(outcome.payload) if isinstance(outcome, Reply) else None
            if snapshot and (snapshot.generation, snapshot.version) != self._played:
                self._played = (snapshot.generation, snapshot.version)
                self.state = "playing"
                self._evaluate(snapshot)
                self._next_play = self._clock() + self._config.interval_s
                self.state = "waiting"
        self._beat()

    def _beat(self) -> None:
        now = self._clock()
        if now >= self._next_status:
            self._next_status = now + self._config.status_interval_s
            self._publish_status()

    def _breathe(self) -> None:
        """Stay answerable within a match, which takes longer than anybody would wait."""
        self._obey()
        self._beat()
        if self._stop.is_set() or self._stopping:
            raise _AskedToStop

    def _best_so_far(self) -> tuple[int, float] | None:
        """Return the score of the best policy that an earlier life kept, if it was measured as we measure."""
        try:
            contract = load_policy(self._folder.best_policy).contract
            if not measured_alike(contract, self._config):
                return None
            return score(contract.stage, dict(contract.measures))
        except (PolicyError, KeyError):
            return None

    def _obey(self) -> None:
        while (request := self._control.poll()) is not None:
            try:
                command = decode_one_of(request.payload, (Control,)).command
            except DecodeError as error:
                self._refused("control", error)
                request.refuse()
                continue
            self._stopping |= command in (Command.STOP, Command.DRAIN)
            request.reply(encode(ControlReply(True, self.state, "")))

    def _read(self, payload: bytes) -> PolicySnapshot | None:
        try:
            return decode(payload, PolicySnapshot)
        except DecodeError as error:
            self._refused("policy", error)
            return None

    def _refused(self, kind: str, reason: object) -> None:
        self._metrics.inc("topspin_messages_refused_total", 1.0, kind=kind)
        log.warning("message refused kind=%s reason=%s", kind, reason)

    def _evaluate(self, snapshot: PolicySnapshot) -> None:
        started = self._clock()
        try:
            layout = critic_layout(self._config.env.observation)
            moments = install(self._network, snapshot, layout, self._contract_hash, "evaluator")
        except PolicyError as error:
            self._refused("policy", error)
            return
        contract = self._contract(snapshot)
        policy = Policy(self._network, moments, contract)
        env = self._config.env.model_copy(update={"noise": self._config.noise, "rounds": self._config.rounds})
        found = measures(play_match(policy, self._rallies, env, self._config.envs, self._breathe))
        self.evaluations += 1
        seconds = self._clock() - started
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
        self._append(found | where | {"seconds": round(self._clock() - self._born, 1)})
        self._last = {name: float(found[name]) for name in CURVE[4:10] if found.get(name) is not None}
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
        reached = score(snapshot.stage, found)
        if self._best is None or reached > self._best:
            self._best = reached
            save_policy(
                self._folder.best_policy,
                policy.network,
                policy.moments,
                contract.model_copy(update={"measures": found | {"match": match_of(self._config)}}),
            )

    def _contract(self, snapshot: PolicySnapshot) -> Contract:
        config = self._config
        return contract_of(
            config.env,
            config.network,
            config.launch,
            run=snapshot.run,
            generation=snapshot.generation,
            version=snapshot.version,
            stage=snapshot.stage,
            frames=snapshot.frames,
        )

    def _append(self, values: dict[str, Any]) -> None:
        path = self._folder.evaluations
        is_new = not path.exists()
        with path.open("a", newline="") as file:
            writer = csv.DictWriter(file, fieldnames=CURVE, extrasaction="ignore")
            if is_new:
                writer.writeheader()
            writer.writerow(values)

    def _publish_status(self) -> None:
        m = self._metrics
        m.follow("topspin_reconnects_total", self._transport.reconnect_count)
        m.follow("topspin_messages_dropped_total", self._control.dropped, key="control")
        status = Status(
            role="evaluator",
            id=self._config.id,
            incarnation=self._incarnation,
            time=time.time(),
            state=self.state,
            counters={"evaluations": float(self.evaluations)},
            gauges=self._last,
        )
        self._transport.publish(self._keys.status("evaluator", self._config.id), encode(status), Flow.STATUS)
