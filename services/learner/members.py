"""Who lives in a run, as its learner sees it: services by their liveliness tokens, and other learners among them."""

import logging
import time
from collections.abc import Callable
from typing import Final

from common.comms.transport import Transport
from common.errors import ReportedError
from common.service.member import Member
from services.learner.config import LearnerConfig
from services.learner.generation import yields
from services.learner.group import Group
from services.learner.intake import Intake

log = logging.getLogger(__name__)

IDLE_WAIT_S: Final = 0.2  # any arrival ends the wait
NAMES_LOGGED: Final = 5  # of services that joined or left together
TOKENS_ARRIVE_S: Final = 0.5  # longest time that the tokens of others take to arrive through a router


class LearnerAliveError(ReportedError):
    """The run has another learner."""


class Members:
    """The services of a run whose tokens stand.

    Args:
        config: Of the learner.
        transport: The hub, or a connection to one.
        member: The learner as a member of its run.
        intake: Is told which actors live, of this rank's.
        group: Which rank of the group the learner is.
        clock: Returns seconds.
    """

    def __init__(
        self,
        config: LearnerConfig,
        transport: Transport,
        member: Member,
        intake: Intake,
        group: Group,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._config, self._transport, self._member = config, transport, member
        self._generation, self._intake, self._group, self._clock = (
            *(member.incarnation, intake, group),
            clock,
        )
        self._tokens = transport.watch_alive(member.keys.every_alive())
        self._alive: set[tuple[str, str, int]] = set()
        self._joined: float | None = None  # [s] time of the learner's own token
        self._rivals: set[int] = set()  # generations of other learners whose tokens stand

    @property
    def roles(self) -> list[str]:
        """The role of each service that lives, without the learner's."""
        return [role for role, _, _ in self._alive]

    @property
    def actors(self) -> set[str]:
        """The names of the actors that live."""
        return {id_ for role, id_, _ in self._alive if role == "actor"}

    def join(self) -> None:
        """Wait for the end of an earlier learner, whose token may stand for a moment after its death, then join.

        Raises:
            LearnerAliveError: It lives on.
        """
        started = self._clock()
        while True:
            self.follow()
            waited = self._clock() - started
            patience = (
                2.0 * self._config.lease_s if self._rivals else TOKENS_ARRIVE_S * self._may_be_elsewhere
            )
            if waited >= patience:
                break
            self._transport.wait(IDLE_WAIT_S)
        if self._rivals:
            raise LearnerAliveError(self._rival_text(max(self._rivals)))
        self._member.join()
        self._joined = self._clock()

    def follow(self) -> None:
        """Record which services have joined or gone, and log it: one line however many they are."""
        changes: dict[bool, list[str]] = {True: [], False: []}
        for event in self._tokens.poll():
            try:
                member = self._member.keys.member(event.key)
            except ValueError as error:  # KeyPartError, or digits that are no number
                self._member.refuse("alive", error)
                continue
            if member.role == "learner":
                self._meet(member.incarnation, event.alive)
                continue
            life = (member.role, member.id, member.incarnation)
            changes[event.alive].append(f"{member.role}/{member.id}")
            (self._alive.add if event.alive else self._alive.discard)(life)
            if member.role == "actor" and self._group.owns(member.id):
                (self._intake.seen if event.alive else self._intake.gone)(member.id, member.incarnation)
        for is_alive, names in changes.items():
            if names:
                text = ", ".join(names[:NAMES_LOGGED]) + (" and others" if len(names) > NAMES_LOGGED else "")
                log.info(
                    "%s=%d %s; alive=%d", "joined" if is_alive else "gone", len(names), text, len(self._alive)
                )

    def _meet(self, generation: int, is_alive: bool) -> None:
        """Note that the token of another learner of this run stands, or has ended; those of one group are no rivals."""
        if generation == self._generation:
            return
        (self._rivals.add if is_alive else self._rivals.discard)(generation)
        if not is_alive or self._joined is None:
            return
        text = self._rival_text(generation)
        # A hub that starts sees no token before its own, and the others wait for its token
        settling_s = 2.0 * TOKENS_ARRIVE_S * self._may_be_elsewhere
        if yields(self._generation, generation, self._clock() - self._joined, settling_s):
            raise LearnerAliveError(text)
        log.error("%s; this one goes on, since it was first", text)

    @property
    def _may_be_elsewhere(self) -> bool:
        """Whether another learner may be at the same hub, or at one that is connected with it."""
        return self._config.mode == "client" or bool(self._config.peers)

    def _rival_text(self, generation: int) -> str:
        return (
            f"run {self._config.run!r} has another learner, generation {generation}, at the same hub: "
            "end it first, or choose another --run"
        )
