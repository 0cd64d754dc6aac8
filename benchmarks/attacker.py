"""A session that sends what it likes: Zenoh itself, without the checks and filters of our transport."""

import json
from typing import Final

import zenoh

from common.comms.certificates import files_of
from common.comms.zenoh_config import Security, ZenohConfig, session_settings

OPEN_S: Final = 2.0


def open_session(
    config: ZenohConfig, name: str = "", attempt_s: float = OPEN_S, **changes: object
) -> zenoh.Session:
    """Return a raw session.

    Args:
        config: Where the hub is.
        name: Of its certificate, with TLS; it is not checked before.
        attempt_s: Longest time to connect [s].
        changes: Zenoh's settings of ``transport/link/tls`` to replace; None removes one.

    Raises:
        zenoh.ZError: There is no link.
    """
    security = Security(files_of(config.tls, name)) if config.tls else None
    settings = session_settings(config, attempt_s, security)
    if changes:
        tls = settings["transport/link/tls"] | changes
        settings["transport/link/tls"] = {key: value for key, value in tls.items() if value is not None}
    own = zenoh.Config()
    for path, value in settings.items():
        own.insert_json5(path, json.dumps(value))
    return zenoh.open(own)
