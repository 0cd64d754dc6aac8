"""What a service's process keeps open while it runs: its log, its /metrics, its link to the hub."""

import logging
from collections.abc import Iterator
from contextlib import closing, contextmanager
from threading import Event

from common.comms.roles import name_of
from common.comms.transport import Transport
from common.comms.zenoh_transport import open_zenoh
from common.service.log import set_up_logging
from common.service.metrics import Metrics
from common.service.settings import ServiceConfig

log = logging.getLogger(__name__)


@contextmanager
def connected(role: str, config: ServiceConfig, stop: Event) -> Iterator[tuple[Transport, Metrics]]:
    """Yield a service's transport and metrics; both are closed at the end, also after an error.

    Args:
        role: The service's role, in its log lines and metrics.
        config: Where the hub is, and where metrics are served.
        stop: Ends the wait for a hub.
    """
    set_up_logging(config.log_level, f"{role}/{config.id}")
    with closing(Metrics(role, config.id, config.run)) as metrics:
        port = metrics.serve(config.metrics_port, config.metrics_host)
        log.info("serving metrics url=http://%s:%d/metrics", config.metrics_host, port)
        name = name_of(role, config.id)
        with closing(open_zenoh(config, stop, name=name, run=config.run)) as transport:
            yield transport, metrics
