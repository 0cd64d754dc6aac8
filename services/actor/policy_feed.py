"""The policies of an actor: which learner it follows, and how it gets that learner's newest one."""

import logging
from typing import Final

from common.comms.codec import DecodeError, decode
from common.comms.keys import rank_of
from common.comms.messages import PolicySnapshot, StageChange, Verdict, VerdictKind
from common.comms.transport import Flow, PendingReply, Reply, Transport
from common.policy.contract import PolicyError
from common.service.history import History
from common.service.member import LEARNER_ID, Member
from common.service.metrics import Metrics
from services.actor.config import ActorConfig
from services.actor.following import Following, adopted, noted, objection
from services.actor.outbox import Outbox
from services.actor.player import Player

log = logging.getLogger(__name__)

ASK_AGAIN_S: Final = 1.0  # pause between requests for the policy
ANSWER_S: Final = 5.0  # limit of one request


class PolicyFeed:
    """Gives an actor's player the newest policy of the learner that the actor follows.

    A policy comes as a broadcast. If the actor may have missed one, it asks the learner.

    Args:
        config: Settings of the actor.
        transport: Connection to the hub.
        member: The actor's membership; counts refused messages.
        player: Gets the policies.
        history: Records them.
        metrics: Receives version and stage.
    """

    def __init__(
        self,
        config: ActorConfig,
        transport: Transport,
        member: Member,
        player: Player,
        history: History,
        metrics: Metrics,
    ) -> None:
        self._config, self._transport, self._member = config, transport, member
        self._player, self._history, self._metrics = player, history, metrics
        self._key = member.keys.policy()
        self.rank: int | None = None  # of the learner that takes this actor's rollouts; None: no policy yet
        self.misfit = ""  # why the learner's policy, or this actor's contract, is refused
        self._following = Following()
        self._is_doubted = False  # whether the policy is not the learner's, though it has its generation
        self._may_have_missed = False  # a policy may be missed while the link is down or the mailbox is full
        self._asked: PendingReply | None = None
        self._next_ask = 0.0
        self._policies = transport.subscribe(self._key, capacity=1)
        self._stages = transport.subscribe(member.keys.stage(), capacity=64)
        member.watch("stage", self._stages)
        self._learners = transport.watch_alive(member.keys.every_life_of("learner", LEARNER_ID))
        self._reconnects = transport.reconnect_count

    @property
    def has_learner(self) -> bool:
        """Whether a learner of the run lives."""
        return bool(self._following.standing)

    def objection(self, generation: int) -> str:
        """Return why the learner of this generation is not followed, or ""."""
        return objection(self._following, generation)

    def note_learners(self) -> bool:
        """Record which learners live, and return whether one came."""
        has_come = False
        for event in self._learners.poll():
            try:
                generation = self._member.keys.member(event.key).incarnation
            except ValueError as error:  # KeyPartError, or digits that are no number
                self._member.refuse("alive", error)
                continue
            self._following = noted(self._following, generation, event.alive)
            if event.alive:
                log.info("learner found generation=%d", generation)
                self._may_have_missed = has_come = True
            else:
                log.warning("learner gone generation=%d", generation)
        return has_come

    def take(self, now: float, outbox: Outbox) -> bool:
        """Give the player what has come, ask for what may be missed, and return whether a policy is new.

        Args:
            now: Time [s].
            outbox: Its credits say which version the learner has.
        """
        is_new = any([self._adopt(sample.payload) for sample in self._policies.poll()])
        for sample in self._stages.poll():
            try:
                change = decode(sample.payload, StageChange)
            except DecodeError as error:
                self._member.refuse("stage", error)
                continue
            if self._player.snapshot is None or change.number > self._player.snapshot.stage_number:
                self._may_have_missed = True
        if self._transport.reconnect_count != self._reconnects:
            self._reconnects = self._transport.reconnect_count
            self._may_have_missed = True
        if self._asked is not None and (outcome := self._asked.poll()) is not None:
            self._asked = None
            if isinstance(outcome, Reply):
                self._may_have_missed = False
                is_new |= self._adopt(outcome.payload, is_answer=True)
        if self._asked is None and now >= self._next_ask and self._is_behind(outbox):
            self._next_ask = now + ASK_AGAIN_S
            self._asked = self._transport.request(self._key, b"", ANSWER_S, Flow.POLICY)
        return is_new

    def heed(self, verdict: Verdict, reported: tuple[int, int]) -> None:
        """Take what the answer to a report says about the actor's policy and contract.

        Args:
            verdict: The followed learner's answer.
            reported: Generation and version of the policy in the report.
        """
        generation, version = reported
        if verdict.generation == generation and verdict.version < version and not self._is_doubted:
            self._is_doubted = True
            log.warning(
                "policy version=%d is not from the learner, whose newest is %d; asking the learner for it",
                version,
                verdict.version,
            )
        is_misfit = verdict.kind in (VerdictKind.WRONG_CONTRACT, VerdictKind.WRONG_RUN)
        self.misfit = f"a learner that takes its rollouts: {verdict.reason}" if is_misfit else ""

    def _is_behind(self, outbox: Outbox) -> bool:
        """Return whether the learner is known to have another policy."""
        snapshot = self._player.snapshot
        if snapshot is None or self._may_have_missed or self._is_doubted:
            return True
        if outbox.generation not in (0, snapshot.generation):
            return True
        return outbox.generation != 0 and snapshot.version < outbox.credit_version

    def _adopt(self, payload: bytes, is_answer: bool = False) -> bool:
        """Play the policy in a message if it is a newer one of the followed learner, and return whether it is.

        Args:
            payload: The message.
            is_answer: Whether the learner answered with it. Then it may also replace one that is doubted.
        """
        mine = self._player.snapshot
        try:
            snapshot = decode(payload, PolicySnapshot)
            may_go_back = is_answer and self._is_doubted
            if (
                mine is not None
                and snapshot.generation == mine.generation
                and snapshot.version <= mine.version
                and not may_go_back
            ):
                return False
            if fault := self.objection(snapshot.generation):
                self._member.refuse("policy", fault)
                return False
            self.rank = rank_of(self._config.id, snapshot.ranks)
            self._player.adopt(snapshot)
        except (DecodeError, PolicyError) as error:
            self._member.refuse("policy", error)
            if isinstance(error, PolicyError) and mine is None:
                self.misfit = f"a policy that it can play: {error}"
            return False
        self.misfit, self._is_doubted = "", False
        self._following = adopted(self._following, snapshot.generation)
        self._note(mine, snapshot)
        return True

    def _note(self, mine: PolicySnapshot | None, snapshot: PolicySnapshot) -> None:
        """Record a policy that is played from now on."""
        generation, version, stage = snapshot.generation, snapshot.version, snapshot.stage
        number = snapshot.stage_number
        self._history.note("policy", generation=generation, version=version, stage_number=number)
        self._metrics.set("topspin_policy_version", version)
        self._metrics.set("topspin_stage", stage)
        if mine is None or (mine.stage_number, mine.generation) != (number, generation):
            log.info("policy received generation=%d version=%d stage=%d", generation, version, stage)
