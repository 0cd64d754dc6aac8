"""How an actor that was given no number gets one, and its settings, from the learner of its run."""

import logging
import time
import tomllib
from collections.abc import Sequence
from contextlib import closing
from pathlib import Path
from tempfile import NamedTemporaryFile
from threading import Event
from typing import Any, Final

import tomli_w

from common.comms.codec import DecodeError, decode, encode
from common.comms.keys import Keys
from common.comms.messages import JoinRequest, Place
from common.comms.roles import name_of
from common.comms.transport import Flow, Reply, Transport
from common.comms.zenoh_transport import open_zenoh
from common.errors import ReportedError
from common.service.config import load
from common.service.log import set_up_logging
from common.service.settings import from_learner
from services.actor.config import ActorConfig

log = logging.getLogger(__name__)

NOT_GIVEN: Final = "0"  # the default of --id
REQUEST_S: Final = 5.0
PAUSE_S: Final = 0.5
SAY_AGAIN_S: Final = 10.0


class NoPlaceError(ReportedError):
    """The actor was stopped before a learner gave it a place, or the place can't be used."""


def joined(config: ActorConfig, argv: Sequence[str], prog: str, stop: Event) -> ActorConfig:
    """Return the settings of an actor that the learner has given its place.

    Args:
        config: Where the learner is.
        argv: The actor's flags: they go before the learner's settings.
        prog: How the actor is called.
        stop: Ends the wait for a learner.

    Raises:
        NoPlaceError: A stop was requested before a learner answered, or the answer can't be used.
    """
    set_up_logging(config.log_level, "actor/-")
    link = open_zenoh(config, stop, name=name_of("actor", config.id), run=config.run)
    with closing(link) as transport:
        # With TLS the hub knows it by its certificate's name, so it keeps that
        name = config.id if config.tls or config.id != NOT_GIVEN else ""
        place = ask(transport, Keys(config.run), name, stop)
    with NamedTemporaryFile(suffix=".toml") as file:
        file.write(tomli_w.dumps(settings_of(place)).encode())
        file.flush()
        flags = (*argv, "--id", place.actor, "--index", str(place.index))
        return load(ActorConfig, flags, prog=prog, section="actor", recorded=Path(file.name))


def ask(transport: Transport, keys: Keys, name: str, stop: Event) -> Place:
    """Return a place in the run; wait until there is a learner that gives one."""
    request = encode(JoinRequest(actor=name))
    started = time.monotonic()
    said = started
    while not stop.is_set():
        answer = transport.request(keys.join(), request, REQUEST_S, Flow.CONTROL).wait()
        if isinstance(answer, Reply):
            try:
                return decode(answer.payload, Place)
            except DecodeError as error:
                raise NoPlaceError(
                    f"run {keys.run!r} gives no place that this release can read: {error}"
                ) from None
        now = time.monotonic()
        if now - said >= SAY_AGAIN_S:
            said = now
            log.warning(
                "waiting for='a learner of run %s that gives a number' seconds=%.0f", keys.run, now - started
            )
        stop.wait(PAUSE_S)
    raise NoPlaceError(f"stopped before a learner of run {keys.run!r} gave this actor a number")


def settings_of(place: Place) -> dict[str, Any]:
    """Return the settings that come with a place, as tables of a settings file. Raises NoPlaceError."""
    try:
        return from_learner(tomllib.loads(place.settings.decode()))
    except (ValueError, RecursionError) as error:
        raise NoPlaceError(f"the learner's settings are not TOML: {error}") from None
