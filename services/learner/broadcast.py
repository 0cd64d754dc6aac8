"""What the learner broadcasts, and answers on request: its newest policy and the stage changes so far."""

import logging
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

from common.comms.codec import encode
from common.comms.keys import Keys
from common.comms.messages import AVERAGE, PolicySnapshot, StageChange, StageLog
from common.comms.transport import Flow, Transport
from common.policy.actor_critic import ActorCritic
from common.policy.network_pass import Precision
from common.policy.weights import pack
from services.learner.config import EvaluatedWeights
from services.learner.training import Training

log = logging.getLogger(__name__)

MAILBOX: Final = 256  # requests that wait
ANSWERED_AT_ONCE: Final = 16  # requests answered between two gradient steps


@dataclass(frozen=True, slots=True)
class Identity:
    """The fields that identify the sender of policies and stage changes."""

    run: str
    generation: int  # number of this life of the learner
    contract_hash: str
    training_hash: str
    ranks: int = 1  # learners that train together


class Broadcast:
    """Publishes policies and stage changes, and answers requests for them.

    Args:
        transport: Connection to the hub.
        keys: The run's keys.
        training: Holds network, moments and progress.
        identity: Fields of every message.
        stages: Stage changes of earlier lives.
        evaluated: Which weights the evaluator gets.
    """

    def __init__(
        self,
        transport: Transport,
        keys: Keys,
        training: Training,
        identity: Identity,
        stages: Sequence[StageChange] = (),
        evaluated: EvaluatedWeights = "mean",
    ) -> None:
        self._evaluated: EvaluatedWeights = evaluated
        self._transport, self._keys, self._training, self._identity = transport, keys, training, identity
        self.stages = list(stages)
        self._blob = self._to_evaluate = b""
        self._policies = transport.serve(keys.policy(), capacity=MAILBOX)
        self._stage_log = transport.serve(keys.stage(), capacity=MAILBOX)
        if not self.stages:
            self.note_stage("start")

    def publish_policy(self) -> None:
        """Broadcast the newest version, with the weights in the precision that updates compute with."""
        network, precision = self._training.network, self._training.compute.precision
        self._blob = self._snapshot(network, precision)
        # The mean is made on request. The newest can't be: within an update the network is between two versions
        self._to_evaluate = b""
        if self._evaluated == "newest":
            self._to_evaluate = self._blob if precision == "float32" else self._snapshot(network)
        self._transport.publish(self._keys.policy(), self._blob, Flow.POLICY)

    def note_stage(self, reason: str) -> None:
        """Append the present stage to the stage log."""
        progress = self._training.progress
        change = StageChange(
            run=self._identity.run,
            generation=self._identity.generation,
            number=progress.stage_number,
            stage=progress.stage,
            frames=progress.frames,
            epoch=progress.epoch,
            reason=reason,
        )
        self.stages.append(change)
        log.info(
            "stage number=%d stage=%d frames=%d reason=%s", change.number, change.stage, change.frames, reason
        )

    def publish_stage(self) -> None:
        """Broadcast the newest stage change."""
        self._transport.publish(self._keys.stage(), encode(self.stages[-1]), Flow.STAGE)

    def answer(self) -> None:
        """Answer the requests that wait, a bounded number at a time."""
        for request in self._policies.waiting(ANSWERED_AT_ONCE):
            request.reply(self._evaluation() if request.payload == AVERAGE else self._blob)
        for request in self._stage_log.waiting(ANSWERED_AT_ONCE):
            request.reply(encode(StageLog(tuple(self.stages))))

    def _evaluation(self) -> bytes:
        """Return the newest version with the weights that are evaluated, in full precision: they may be kept."""
        if not self._to_evaluate:
            self._to_evaluate = self._snapshot(self._training.average)
        return self._to_evaluate

    def _snapshot(self, network: ActorCritic, precision: Precision = "float32") -> bytes:
        """Return the newest version with the weights of ``network``, encoded."""
        training, progress, identity = self._training, self._training.progress, self._identity
        return encode(
            PolicySnapshot(
                run=identity.run,
                generation=identity.generation,
                version=progress.version,
                stage_number=progress.stage_number,
                stage=progress.stage,
                epoch=progress.epoch,
                frames=progress.frames,
                contract_hash=identity.contract_hash,
                training_hash=identity.training_hash,
                weights=pack(network, precision),
                obs_mean=training.obs_moments.mean,
                obs_var=training.obs_moments.var,
                obs_count=training.obs_moments.count,
                ranks=identity.ranks,
            )
        )
