"""How an actor that was given no number gets one, and its settings, from the learner of its run."""

import logging
import time
import tomllib
from collections.abc import Sequence
from pathlib import Path
from tempfile import NamedTemporaryFile
from threading import Event
from typing import Any, Final

import tomli_w

from common.comms.codec import DecodeError, decode, encode
from common.comms.keys import Keys
from common.comms.messages import JoinRequest, Place
from common.comms.transport import Flow, Reply, Transport
from common.errors import ReportedError
from common.service.config import load
from common.service.connection import connected
from common.service.metrics import Metrics
from common.service.settings import from_learner
from services.actor.config import ActorConfig
from services.actor.following import no_learner

log = logging.getLogger(__name__)

NOT_GIVEN: Final = "0"  # the default of --id
NEWCOMER: Final = "new"  # id of an actor that has none yet, in its log and metrics
REQUEST_S: Final = 5.0
PAUSE_S: Final = 0.5


class NoPlaceError(ReportedError):
    """The learner's answer can't be used."""


def joined(config: ActorConfig, argv: Sequence[str], prog: str, stop: Event) -> ActorConfig | None:
    """Return the settings of an actor that the learner has given its place; None: a stop was requested before.

    Args:
        config: Where the learner is.
        argv: The actor's flags: they go before the learner's settings.
        prog: How the actor is called.
        stop: Ends the wait for a learner.

    Raises:
        NoPlaceError: The answer can't be used.
    """
    # With TLS the hub knows it by its certificate's name, so it keeps that
    is_named = bool(config.tls) or config.id != NOT_GIVEN
    newcomer = config.model_copy(update={"id": config.id if is_named else NEWCOMER})
    with connected("actor", newcomer, stop) as (transport, metrics):
        place = ask(transport, config, config.id if is_named else "", stop, metrics)
    if place is None:
        return None
    with NamedTemporaryFile(suffix=".toml") as file:
        file.write(tomli_w.dumps(settings_of(place)).encode())
        file.flush()
        flags = (*argv, "--id", place.actor, "--index", str(place.index))
        return load(ActorConfig, flags, prog=prog, section="actor", beneath=Path(file.name))


def ask(transport: Transport, config: ActorConfig, name: str, stop: Event, metrics: Metrics) -> Place | None:
    """Return a place in the run; wait until a learner gives one. None: a stop was requested."""
    keys, request = Keys(config.run), encode(JoinRequest(actor=name))
    started, has_said = time.monotonic(), False
    while not stop.is_set():
        metrics.health.turn()
        answer = transport.request(keys.join(), request, REQUEST_S, Flow.CONTROL).wait()
        if isinstance(answer, Reply):
            try:
                return decode(answer.payload, Place)
            except DecodeError as error:
                raise NoPlaceError(
                    f"run {config.run!r} gives no place that this release can read: {error}"
                ) from None
        waited = time.monotonic() - started
        if waited > config.silence_warning_s and not has_said:
            has_said = True
            log.warning("waiting for=%r seconds=%.0f", no_learner(config.run, bool(config.tls)), waited)
        stop.wait(PAUSE_S)
    return None


def settings_of(place: Place) -> dict[str, Any]:
    """Return the settings that come with a place, as tables of a settings file. Raises NoPlaceError."""
    try:
        return from_learner(tomllib.loads(place.settings.decode()))
    except (ValueError, RecursionError) as error:
        raise NoPlaceError(f"the learner's settings are not TOML: {error}") from None
