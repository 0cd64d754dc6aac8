"""Who an actor is that comes with nothing but the run's name: the learner gives it a number and the run's settings.

So a hundred actors are a hundred equal processes, such as the replicas of one Deployment.
"""

import logging
import re
from collections.abc import Set
from pathlib import Path
from typing import Any, Final

import tomli_w

from common.comms.codec import DecodeError, decode, encode
from common.comms.messages import JoinRequest, Place
from common.comms.transport import Transport
from common.service.config_sources import read_toml
from common.service.member import Member
from common.service.settings import from_learner
from services.learner.config import LearnerConfig

log = logging.getLogger(__name__)

HELD_S: Final = 60.0  # time for an actor to show its token, after which its number may be given again
MOST_HELD: Final = (
    1000  # then the one that is held longest is given again: requests cost an open hub no memory
)
MAILBOX: Final = 256  # requests that wait
ANSWERED_AT_ONCE: Final = 16
_NUMBER: Final = re.compile(r"[0-9]{1,6}$")


class Places:
    """The numbers that are given and not used yet."""

    def __init__(self) -> None:
        self._held: dict[int, float] = {}  # end of each one's time [s], the soonest first

    def give(self, name: str, present: Set[str], now: float) -> tuple[str, int]:
        """Return name and number for an actor that joins at ``now`` [s]: the lowest number that is free.

        Args:
            name: Its name, or "". A name with a number at its end, such as a certificate's, has that number.
            present: The names of the actors that live.
            now: [s]
        """
        self._held = {number: end for number, end in self._held.items() if end > now}
        if found := _NUMBER.search(name):
            return name, int(found[0])
        taken = {int(found[0]) for other in present if (found := _NUMBER.search(other))}
        number = 0
        while number in taken or number in self._held:
            number += 1
        if len(self._held) >= MOST_HELD:
            number = next(iter(self._held))
            del self._held[number]
        self._held[number] = now + HELD_S
        return name or str(number), number


class Registrar:
    """Answers actors that want to join.

    Args:
        config: Of the learner.
        file: The run's settings file; its table of actors is theirs too.
        transport: The hub, or a connection to one.
        member: The learner as a member of its run.
    """

    def __init__(self, config: LearnerConfig, file: Path, transport: Transport, member: Member) -> None:
        self._member, self._places = member, Places()
        self._settings = tomli_w.dumps(settings_for_actors(config, file)).encode()
        self._requests = transport.serve(member.keys.join(), capacity=MAILBOX)
        member.watch("join", self._requests)

    def answer(self, present: Set[str], now: float) -> None:
        """Answer the requests that wait, a bounded number at a time.

        Args:
            present: The names of the actors that live.
            now: [s]
        """
        for request in self._requests.waiting(ANSWERED_AT_ONCE):
            try:
                name = decode(request.payload, JoinRequest).actor
            except DecodeError as error:
                self._member.refuse("join", error)
                request.refuse()
                continue
            actor, index = self._places.give(name, present, now)
            log.info("place given actor=%s index=%d", actor, index)
            request.reply(encode(Place(actor=actor, index=index, settings=self._settings)))


def settings_for_actors(config: LearnerConfig, file: Path) -> dict[str, Any]:
    """Return the settings that an actor of this run needs, as tables of a settings file."""
    own = read_toml(file).get("actor", {}) if file.exists() else {}
    return from_learner({**config.model_dump(mode="json", exclude_none=True), "actor": own})
