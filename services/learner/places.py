"""Who an actor is that comes with nothing but the run's name: the learner gives it a number and the run's settings.

So a hundred actors are a hundred equal processes, such as the replicas of one Deployment.
"""

import logging
import re
from collections.abc import Iterable, Set
from itertools import count
from pathlib import Path
from typing import Any, Final, NamedTuple

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


class Held(NamedTuple):
    """A number that was given."""

    number: int
    end: float  # [s] by then its actor has shown its token, or the number is free again


class Places:
    """The numbers of the actors: two that live never have the same one, since it decides their balls and their noise.

    A learner that was restarted knows the numbers of names that end with theirs.

    Args:
        remembered: The names of actors that may live, whose tokens have yet to come: those of a checkpoint. Their
            numbers are held as if they had just been given.
        now: [s]
    """

    def __init__(self, remembered: Iterable[str] = (), now: float = 0.0) -> None:
        self._given: dict[str, Held] = {}  # by the actor's name, the oldest first
        for name in remembered:
            if (number := number_in(name)) is not None:
                self._given[name] = Held(number, now + HELD_S)

    def give(self, name: str, present: Set[str], now: float) -> tuple[str, int]:
        """Return name and number for an actor that joins at ``now`` [s].

        It is the number at the end of its name, such as a certificate's; else, or where another actor has that one, the
        lowest that is free. A name that joins again keeps its number.

        Args:
            name: Its name, or "".
            present: The names of the actors that live.
            now: [s]
        """
        self._given = {who: held for who, held in self._given.items() if who in present or held.end > now}
        if name in self._given:
            number = self._given.pop(name).number
        else:
            starting = [who for who in self._given if who not in present]
            if len(starting) >= MOST_HELD:
                del self._given[starting[0]]
            taken = {held.number for held in self._given.values()}
            unknown = present - self._given.keys() - {name}
            taken |= {own for other in unknown if (own := number_in(other)) is not None}
            wish = number_in(name)
            free = (k for k in count() if k not in taken and (name or str(k) not in present))
            number = next(free) if wish is None or wish in taken else wish
            if wish not in (None, number):
                log.warning("actor=%s gets the number %d: another actor has %d", name, number, wish)
        name = name or str(number)
        self._given[name] = Held(number, now + HELD_S)
        return name, number


def number_in(name: str) -> int | None:
    """Return the number at the end of a name, or None."""
    found = _NUMBER.search(name)
    return int(found[0]) if found else None


class Registrar:
    """Answers actors that want to join.

    Args:
        config: Of the learner.
        file: The run's settings file; its table of actors is theirs too.
        transport: The hub, or a connection to one.
        member: The learner as a member of its run.
        places: The numbers that are taken.
    """

    def __init__(
        self, config: LearnerConfig, file: Path, transport: Transport, member: Member, places: Places
    ) -> None:
        self._member, self._places = member, places
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
