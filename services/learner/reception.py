"""A learner's reception: who lives in the run, a verdict on every rollout, an answer to every report.

In a group of learners each rank has one, for the actors that are its own (`common.comms.keys.rank_of`).
"""

import time
from collections.abc import Callable, Iterable, Sequence
from typing import Final

from common.comms.codec import DecodeError, decode, encode
from common.comms.keys import KeyPartError
from common.comms.messages import ActorReport, Verdict
from common.comms.transport import Request, Transport
from common.service.history import History
from common.service.member import Member
from common.service.metrics import Metrics
from services.learner.admission import LearnerState, differs, open_rollout
from services.learner.checkpoint import Extras
from services.learner.config import LearnerConfig
from services.learner.group import Group
from services.learner.intake import Intake, Queued
from services.learner.ledger import AccountSnapshot
from services.learner.members import Members
from services.learner.training import Training

MAILBOX: Final = 256  # messages that it holds at least; a full one refuses them
SERVED_AT_ONCE: Final = 64  # messages of a kind read between two gradient steps


class Reception:
    """The side of a learner that its actors see.

    Args:
        config: Of the learner.
        group: Which rank of the group it is.
        transport: The hub, or a connection to one.
        member: The learner as a member of its run.
        metrics: Receives the service's numbers.
        history: Receives a line for each verdict.
        intake: Rollouts and accounts of this rank's actors.
        obs_size: Numbers of an observation.
        clock: Returns seconds.
    """

    def __init__(
        self,
        config: LearnerConfig,
        group: Group,
        transport: Transport,
        member: Member,
        metrics: Metrics,
        history: History,
        intake: Intake,
        obs_size: int,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._group, self._transport, self._member = group, transport, member
        self._metrics, self._history, self.intake, self._obs_size = metrics, history, intake, obs_size
        self._limit_bytes = config.max_message_mib * 2**20
        keys = member.keys
        # After a checkpoint every actor may have sent all that it may send
        capacity = max(MAILBOX, config.actors * (config.intake.window + 1))
        self._rollouts = transport.serve(keys.every_rollout(group.rank), capacity=capacity)
        self._reports = transport.serve(keys.every_report(group.rank), capacity=capacity)
        member.watch("rollout", self._rollouts)
        member.watch("report", self._reports)
        self.members = Members(config, transport, member, intake, group, clock)

    def serve(self, now: float) -> None:
        """Answer the messages that wait, a bounded number at a time.

        Args:
            now: The learner's clock [s].
        """
        self._member.note_link(now)
        self.members.follow()
        learner = self.intake.learner
        for misfit in self.intake.take_new_misfits():
            self._member.refuse(
                "contract",
                f"actor={misfit.actor} has training {misfit.training_hash or 'of an older release'}; allowed: "
                f"{learner.training_hash}: it gets no credits until [task], [network] and [experience] are the "
                "learner's",
            )
        for request in self._rollouts.waiting(SERVED_AT_ONCE):
            self._metrics.inc("topspin_bytes_received_total", len(request.payload))
            verdict = self._judge(request, now)
            self._metrics.inc("topspin_rollouts_received_total", 1.0, verdict=verdict.kind.value)
            request.reply(encode(verdict))
        for request in self._reports.waiting(SERVED_AT_ONCE):
            self._answer_report(request, now)
        self._member.answer_control()

    def _judge(self, request: Request, now: float) -> Verdict:
        """Return the verdict on a request with a rollout."""
        opened = open_rollout(request.payload, self._limit_bytes, self._obs_size)
        if opened is None:
            self._member.refuse("rollout", "unreadable")
            return self.intake.unreadable("not readable as a rollout of this release")
        header, rollout = opened
        if fault := self._sender_fault(request.key, header.actor):
            self._member.refuse("rollout", fault)
            return self.intake.unreadable(fault)
        if header.fault:
            self._member.refuse("rollout", f"actor={header.actor} {header.fault}")
        verdict = self.intake.arrive(header, rollout, now)
        self._history.note(
            "verdict",
            rollout=[*header.life, header.sequence],
            kind=verdict.kind.value,
            generation=verdict.generation,
        )
        return verdict

    def _answer_report(self, request: Request, now: float) -> None:
        try:
            report = decode(request.payload, ActorReport)
        except DecodeError as error:
            self._member.refuse("report", error)
            request.refuse()
            return
        if fault := self._sender_fault(request.key, report.actor):
            self._member.refuse("report", fault)
            request.refuse()
            return
        request.reply(encode(self.intake.report(report, now)))

    def _sender_fault(self, key: str, actor: str) -> str:
        """Return why a message can't be of the actor that it names, or is of another rank's actor, or ""."""
        try:
            if fault := differs("actor", actor, self._member.keys.sender(key)):
                return fault
        except KeyPartError as error:
            return str(error)
        # It may come while an actor knows only an earlier group, of another size. It is sent again.
        return differs(f"actor {actor} at the learner of rank", self._group.rank, self._group.rank_of(actor))


def new_intake(
    config: LearnerConfig, group: Group, learner: LearnerState, extras: Extras | None, obs_size: int
) -> Intake:
    """Return an intake with the accounts and the waiting rollouts of a checkpoint that are this rank's."""
    settings = config.intake.for_actors(config.actors)
    if extras is None:
        return Intake(settings, learner)
    opened = [open_rollout(payload, config.max_message_mib * 2**20, obs_size) for payload in extras.queue]
    queue = [Queued(found[0], found[1]) for found in opened if found is not None and found[1] is not None]
    accounts = [AccountSnapshot.from_json(values) for values in extras.accounts]
    return Intake(
        settings,
        learner,
        [account for account in accounts if group.owns(account.actor)],
        [entry for entry in queue if group.owns(entry.header.actor)],
        [life for life in extras.closed if group.owns(life[0])],
    )


def where(training: Training, generation: int) -> dict[str, int]:
    """Return what a history says of the training with each event."""
    progress = training.progress
    return {
        "generation": generation,
        "version": progress.version,
        "epoch": progress.epoch,
        "stage_number": progress.stage_number,
    }


def lives(entries: Iterable[Queued]) -> list[tuple[str, int, int]]:
    """Return the name of each rollout in a history: actor, incarnation, number."""
    return [(*entry.header.life, entry.header.sequence) for entry in entries]


def in_order(entries: Sequence[Queued]) -> list[Queued]:
    """Return the rollouts by actor and number, not by arrival: a run with one actor is then reproducible.

    So it is the same bit for bit on any network.
    """
    return sorted(entries, key=lambda entry: (entry.header.actor, entry.header.sequence))
