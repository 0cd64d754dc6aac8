"""All metrics of all services in one table, and their registry. No other file imports Prometheus' client.

`topspin.reference` writes the table as the page docs/reference/metrics.md.
"""

import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import partial
from types import MappingProxyType
from typing import Final, Literal, TypeVar

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

_G, _A, _L, _E = "generator", "actor", "learner", "evaluator"
_R: Final = "router"
_ALL: Final = (_G, _A, _L, _E)

# Latencies from a tenth of a millisecond to a minute.
_SECONDS_BUCKETS: Final = (1e-4, 3e-4, 1e-3, 3e-3, 0.01, 0.03, 0.1, 0.3, 1.0, 3.0, 10.0, 30.0, 60.0)


_Kind = TypeVar("_Kind", Counter, Gauge, Histogram)


class MetricsError(ReportedError, RuntimeError):
    """A metric that isn't in the table."""


@dataclass(frozen=True, slots=True)
class Metric:
    """One exported number. ``unit`` "1" is a plain number, "share" one from 0 to 1."""

    name: str
    kind: Literal["counter", "gauge", "histogram"]
    unit: str
    help: str
    roles: tuple[str, ...]
    labels: tuple[str, ...] = ()


def _table(*rows: Metric) -> Mapping[str, Metric]:
    table = {row.name: row for row in rows}
    if len(table) != len(rows):
        raise MetricsError("a metric stands twice in the table")
    return MappingProxyType(table)


OWN_LABELS: Final = ("run", "role", "id")
"""Labels that every sample has, whoever scrapes it: the run, and the service in it."""

METRICS: Final = _table(
    Metric("topspin_process_up", "gauge", "1", "Always 1: the service answers", (*_ALL, _R)),
    Metric(
        "topspin_heartbeat_time_seconds",
        "gauge",
        "s since 1970",
        "Time of the newest heartbeat; before the first one, start of the service",
        (*_ALL, _R),
    ),
    Metric("topspin_alive", "gauge", "services", "Live services", (_L,), ("service",)),
    Metric("topspin_reconnects_total", "counter", "1", "Reconnections to the hub", _ALL),
    Metric(
        "topspin_phase_seconds_total",
        "counter",
        "s",
        "Time in each phase of the loop",
        (_A, _L, _E),
        ("phase",),
    ),
    Metric("topspin_bytes_sent_total", "counter", "bytes", "Size of rollouts sent, with retries", (_A,)),
    Metric(
        "topspin_bytes_received_total", "counter", "bytes", "Size of rollouts received, with retries", (_L,)
    ),
    Metric(
        "topspin_messages_refused_total",
        "counter",
        "messages",
        "Messages that could not be used",
        _ALL,
        ("kind",),
    ),
    Metric(
        "topspin_messages_dropped_total",
        "counter",
        "messages",
        "Messages that a full mailbox dropped",
        _ALL,
        ("key",),
    ),
    # rallies
    Metric("topspin_rallies_drawn_total", "counter", "rallies", "Launches drawn", (_G,)),
    Metric("topspin_rallies_valid_total", "counter", "rallies", "Launches that are valid rallies", (_G,)),
    Metric(
        "topspin_rallies_valid_share", "gauge", "share", "Share of the drawn launches that are valid", (_G,)
    ),
    Metric("topspin_rallies_published_total", "counter", "rallies", "Rallies published", (_G,)),
    Metric("topspin_rallies_consumed_total", "counter", "rallies", "Rallies played", (_A,)),
    Metric(
        "topspin_rally_underruns_total",
        "counter",
        "rallies",
        "Random launches because no rally was in stock",
        (_A,),
    ),
    Metric("topspin_rally_gaps_total", "counter", "batches", "Rally batches that did not arrive", (_A,)),
    Metric("topspin_rally_buffer_depth", "gauge", "rallies", "Rallies in stock", (_A,)),
    # play
    Metric("topspin_frames_total", "counter", "frames", "Control steps played or trained", (_A, _L)),
    Metric(
        "topspin_frames_per_second", "gauge", "frames/s", "Frames trained per second, newest epoch", (_L,)
    ),
    Metric("topspin_episodes_total", "counter", "episodes", "Episodes ended", (_A, _L, _E)),
    Metric(
        "topspin_outcomes_total", "counter", "episodes", "Episodes by how they ended", (_L,), ("outcome",)
    ),
    Metric(
        "topspin_catch_rate", "gauge", "share", "Share of valid rallies with a legal racket contact", (_L, _E)
    ),
    Metric(
        "topspin_over_rate",
        "gauge",
        "share",
        "Share of valid rallies in which the ball crosses the net",
        (_L, _E),
    ),
    Metric("topspin_return_rate", "gauge", "share", "Share of valid rallies with a legal landing", (_L, _E)),
    Metric("topspin_target_error_meters", "gauge", "m", "Mean distance of landings to the target", (_L, _E)),
    Metric("topspin_episode_reward", "gauge", "reward", "Mean reward of an episode", (_L,)),
    Metric("topspin_reward_per_frame", "gauge", "reward", "Mean of each reward term", (_L,), ("term",)),
    # policy and curriculum
    Metric("topspin_policy_version", "gauge", "1", "Version published, played or rated", (_A, _L, _E)),
    Metric("topspin_policy_lag", "gauge", "versions", "Mean lag of the newest dataset", (_L,)),
    Metric("topspin_stage", "gauge", "1", "Stage of the curriculum", (_A, _L)),
    Metric("topspin_epoch", "gauge", "epochs", "Datasets trained", (_L,)),
    Metric("topspin_rollbacks_total", "counter", "1", "Returns to a good checkpoint after divergence", (_L,)),
    Metric(
        "topspin_checkpoint_time_seconds",
        "gauge",
        "s since 1970",
        "Time of the newest checkpoint; before the first one, start of the learner",
        (_L,),
    ),
    Metric("topspin_failed_saves_total", "counter", "1", "Checkpoints that could not be written", (_L,)),
    # rollouts
    Metric("topspin_rollouts_published_total", "counter", "rollouts", "Rollouts numbered", (_A,)),
    Metric(
        "topspin_rollouts_accepted_total",
        "counter",
        "rollouts",
        "Rollouts whose final verdict is accepted",
        (_A,),
    ),
    Metric(
        "topspin_rollouts_refused_total",
        "counter",
        "rollouts",
        "Rollouts whose final verdict is another one",
        (_A,),
        ("reason",),
    ),
    Metric("topspin_rollouts_given_up_total", "counter", "rollouts", "Rollouts dropped as too old", (_A,)),
    Metric("topspin_rollouts_retried_total", "counter", "tries", "Sent again under the same number", (_A,)),
    Metric("topspin_rollouts_in_flight", "gauge", "rollouts", "Rollouts without a final verdict", (_A,)),
    Metric(
        "topspin_rollouts_received_total",
        "counter",
        "rollouts",
        "Rollouts received, by verdict",
        (_L,),
        ("verdict",),
    ),
    Metric(
        "topspin_rollout_gaps", "gauge", "rollouts", "Missing numbers below the highest that arrived", (_L,)
    ),
    Metric(
        "topspin_ledger_rollouts",
        "gauge",
        "rollouts",
        "Where rollouts are: published = trained + refused + dropped + in_flight + lost",
        (_L,),
        ("fate",),
    ),
    Metric(
        "topspin_misfit_actors", "gauge", "services", "Live actors whose contract is not the learner's", (_L,)
    ),
    Metric("topspin_queue_depth", "gauge", "rollouts", "Rollouts that wait for an update", (_L,)),
    # the update
    Metric("topspin_learning_rate", "gauge", "1", "Learning rate of Adam", (_L,)),
    Metric("topspin_kl", "gauge", "nat", "Divergence from the policy before the update", (_L,)),
    Metric("topspin_clip_fraction", "gauge", "share", "Samples whose ratio was clipped", (_L,)),
    Metric("topspin_entropy", "gauge", "nat", "Entropy of the action distribution", (_L,)),
    Metric("topspin_policy_loss", "gauge", "1", "Loss of the policy", (_L,)),
    Metric(
        "topspin_correction_loss",
        "gauge",
        "1",
        "Loss of the mean actions against the corrected ones",
        (_L,),
    ),
    Metric("topspin_value_loss", "gauge", "1", "Loss of the value, normalised", (_L,)),
    Metric(
        "topspin_explained_variance",
        "gauge",
        "share",
        "Explained variance of the returns by the value",
        (_L,),
    ),
    Metric("topspin_gradient_norm", "gauge", "1", "Norm of the gradient before clipping", (_L,)),
    Metric("topspin_update_seconds", "histogram", "s", "Time of one update", (_L,)),
)

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
                f"the {self._role} has no metric {name!r}: the table in common/service/metrics.py has all"
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


def markdown() -> str:
    """Return the table as a document."""
    lines = [
        "# Metrics",
        "",
        "Every service serves these at `/metrics` in Prometheus' text format. Each sample also has the labels "
        f"{', '.join(f'`{label}`' for label in OWN_LABELS)} of its service. A gauge is exported from its first value "
        "on. `process_*` (memory, CPU time, open files) and `python_gc_*` are of Prometheus' client.",
        "Generated by `python -m topspin.reference` from `common/service/metrics.py`.",
        "",
        "| name | kind | unit | labels | services | what it is |",
        "|---|---|---|---|---|---|",
    ]
    for metric in METRICS.values():
        labels, roles = ", ".join(metric.labels), ", ".join(metric.roles)
        lines.append(
            f"| `{metric.name}` | {metric.kind} | {metric.unit} | {labels} | {roles} | {metric.help} |"
        )
    return "\n".join(lines) + "\n"
