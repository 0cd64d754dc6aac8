"""The numbers of one service, and their registry. No other file imports Prometheus' client."""

import time
from collections.abc import Callable, Iterator, Mapping
from functools import partial
from types import MappingProxyType
from typing import Final, TypeVar

from prometheus_client import (
    CollectorRegistry,
    Counter,
    Gauge,
    GCCollector,
    Histogram,
    ProcessCollector,
    generate_latest,
)
from prometheus_client.metrics_core import Metric as Family

from common.errors import ReportedError
from common.service.endpoint import Endpoint, Health
from common.service.metric_table import METRICS

# Latencies from a tenth of a millisecond to a minute.
_SECONDS_BUCKETS: Final = (1e-4, 3e-4, 1e-3, 3e-3, 0.01, 0.03, 0.1, 0.3, 1.0, 3.0, 10.0, 30.0, 60.0)


_Kind = TypeVar("_Kind", Counter, Gauge, Histogram)


class MetricsError(ReportedError, RuntimeError):
    """A metric that isn't in the table."""


_KINDS: Final[Mapping[str, Callable[..., Counter | Gauge | Histogram]]] = MappingProxyType(
    {
        "counter": Counter,
        "gauge": Gauge,
        "histogram": partial(Histogram, buckets=_SECONDS_BUCKETS),
    }
)


class Metrics:
    """The numbers of one service, in a registry of its own: several services may share a process.

    A gauge is exported from its first value on: 0 would look like one.

    Args:
        role: The service's role: selects the rows of the table.
        id_: Its name among the services of its role.
        run: Its run.
    """

    def __init__(self, role: str, id_: str, run: str = "default") -> None:
        self._role = role
        self._labels = {"run": run, "role": role, "id": id_}
        self._registry = CollectorRegistry()
        ProcessCollector(registry=self._registry)
        GCCollector(self._registry)
        self._instruments: dict[str, Counter | Gauge | Histogram] = {}
        self._unset: set[str] = set()  # gauges that have had no value
        self._followed: dict[tuple[object, ...], float] = {}
        self._endpoint: Endpoint | None = None
        self.health = Health()
        for metric in METRICS.values():
            if role not in metric.roles:
                continue
            text = f"{metric.help} [{metric.unit}]"
            is_gauge = metric.kind == "gauge"
            self._instruments[metric.name] = _KINDS[metric.kind](
                metric.name, text, metric.labels, registry=None if is_gauge else self._registry
            )
            if is_gauge:
                self._unset.add(metric.name)
        self.set("topspin_process_up", 1.0)
        self.set("topspin_heartbeat_time_seconds", time.time())

    @property
    def port(self) -> int:
        """The port that is served; 0: none."""
        return self._endpoint.port if self._endpoint else 0

    def set(self, name: str, value: float, **labels: str) -> None:
        """Set a gauge. Raises MetricsError for a name, kind or label that this role doesn't have."""
        self._instrument(name, Gauge, labels).set(value)
        if name in self._unset:
            self._unset.remove(name)
            self._registry.register(self._instruments[name])

    def inc(self, name: str, amount: float = 1.0, **labels: str) -> None:
        """Raise a counter; otherwise as `set`."""
        self._instrument(name, Counter, labels).inc(amount)

    def follow(self, name: str, total: float, **labels: str) -> None:
        """Raise a counter to a total that is counted elsewhere and never shrinks; otherwise as `set`."""
        key = (name, *sorted(labels.items()))
        self.inc(name, total - self._followed.get(key, 0.0), **labels)
        self._followed[key] = total

    def observe(self, name: str, value: float, **labels: str) -> None:
        """Add a value to a histogram; otherwise as `set`."""
        self._instrument(name, Histogram, labels).observe(value)

    def value(self, name: str, **labels: str) -> float | None:
        """Return the value of a counter or gauge, or None if it was never set."""
        return self._registry.get_sample_value(name, labels)

    def serve(self, port: int, host: str = "127.0.0.1") -> int:
        """Return the port at which HTTP serves /metrics, /healthz and /readyz from now on.

        Args:
            port: The first one to try: the next free one is taken. 0: any free one.
            host: Address to listen at.

        Raises:
            PortError: The address can't be used, or all of many ports are taken.
        """
        self._endpoint = Endpoint(host, port, self.text, self.health)
        return self._endpoint.port

    def text(self) -> bytes:
        """Return all samples in Prometheus' text format, each with `OWN_LABELS`."""
        return generate_latest(_Labelled(self._registry, self._labels))

    def close(self) -> None:
        """Stop serving; may be called twice."""
        if self._endpoint is not None:
            self._endpoint.close()
        self._endpoint = None

    def _instrument(self, name: str, kind: type[_Kind], labels: Mapping[str, str]) -> _Kind:
        instrument = self._instruments.get(name)
        if instrument is None:
            raise MetricsError(
                f"the {self._role} has no metric {name!r}: the table in common/service/metric_table.py has all"
            )
        if not isinstance(instrument, kind):
            raise MetricsError(f"{name} is a {METRICS[name].kind}, not a {kind.__name__.lower()}")
        wanted = METRICS[name].labels
        if labels.keys() != set(wanted):
            raise MetricsError(f"{name} with labels {sorted(labels)}; allowed: {sorted(wanted)}")
        return instrument.labels(**labels) if labels else instrument


class _Labelled(CollectorRegistry):
    """A registry's samples with more labels, and without the times of creation, which nothing here reads."""

    def __init__(self, registry: CollectorRegistry, labels: Mapping[str, str]) -> None:
        super().__init__()
        self._source, self._labels = registry, labels

    def collect(self) -> Iterator[Family]:
        for family in self._source.collect():
            copy = Family(family.name, family.documentation, family.type, family.unit)
            copy.samples = [
                sample._replace(labels={**self._labels, **sample.labels})
                for sample in family.samples
                if not sample.name.endswith("_created")
            ]
            yield copy
