"""All panels of the dashboard in one table, and the Grafana dashboard that is made from it."""

from dataclasses import dataclass
from itertools import count
from typing import Any, Final

from common.service.metric_table import METRICS
from deploy.manifests.alarms import LEADER

RUN: Final = '{run="$run"}'
COLUMNS: Final = 24  # of Grafana's grid
HEIGHT: Final = 7
UPDATE: Final = ',phase="update"'


@dataclass(frozen=True, slots=True)
class Query:
    """A curve, or one for each series."""

    expression: str  # PromQL; $run is the chosen run
    legend: str = ""


@dataclass(frozen=True, slots=True)
class Panel:
    """One diagram."""

    title: str
    unit: str  # Grafana's name of it
    queries: tuple[Query, ...]


@dataclass(frozen=True, slots=True)
class Row:
    """Panels beside each other, under one title."""

    title: str
    panels: tuple[Panel, ...]


def _by(metric: str, role: str, more: str = "") -> str:
    who = LEADER if role == "learner" else f'role="{role}"'
    return f'{metric}{{run="$run",{who}{more}}}'


_SERVICE: Final = "{{role}}-{{id}}"

ROWS: Final = (
    Row(
        "How well it plays",
        (
            Panel(
                "Returned and caught, evaluation",
                "percentunit",
                (
                    Query(_by("topspin_return_rate", "evaluator"), "returned"),
                    Query(_by("topspin_catch_rate", "evaluator"), "caught"),
                ),
            ),
            Panel(
                "Returned and caught, training (with noise)",
                "percentunit",
                (
                    Query(_by("topspin_return_rate", "learner"), "returned"),
                    Query(_by("topspin_catch_rate", "learner"), "caught"),
                ),
            ),
            Panel(
                "Distance to the target",
                "m",
                (Query(f"topspin_target_error_meters{RUN}", "{{role}}"),),
            ),
            Panel(
                "Reward of an episode, stage",
                "short",
                (
                    Query(_by("topspin_episode_reward", "learner"), "reward"),
                    Query(_by("topspin_stage", "learner"), "stage"),
                ),
            ),
        ),
    ),
    Row(
        "How fast it trains",
        (
            Panel(
                "Frames trained",
                "short",
                (Query(f"rate({_by('topspin_frames_total', 'learner')}[1m])", "frames/s"),),
            ),
            Panel(
                "Where the learner's time goes",
                "percentunit",
                (
                    Query(f"rate({_by('topspin_phase_seconds_total', 'learner')}[1m])", "{{phase}}"),
                    Query(
                        f"1 - rate({_by('topspin_phase_seconds_total', 'learner', UPDATE)}[1m])",
                        "waits for data",
                    ),
                ),
            ),
            Panel(
                "Where the actors' time goes",
                "percentunit",
                (
                    Query(
                        f"avg by (phase) (rate({_by('topspin_phase_seconds_total', 'actor')}[1m]))",
                        "{{phase}}",
                    ),
                ),
            ),
            Panel("Live services", "short", (Query(f"topspin_alive{RUN}", "{{service}}"),)),
        ),
    ),
    Row(
        "How it learns",
        (
            Panel("KL", "short", (Query(f"topspin_kl{RUN}", "KL [nat]"),)),
            Panel("Learning rate", "sci", (Query(f"topspin_learning_rate{RUN}", "learning rate"),)),
            Panel("Entropy", "short", (Query(f"topspin_entropy{RUN}", "entropy [nat]"),)),
            Panel(
                "Explained variance, clipped",
                "percentunit",
                (
                    Query(f"topspin_explained_variance{RUN}", "explained variance"),
                    Query(f"topspin_clip_fraction{RUN}", "clipped"),
                ),
            ),
        ),
    ),
    Row(
        "Rollouts and rallies",
        (
            Panel(
                "Rollouts received, by verdict",
                "short",
                (Query(f"sum by (verdict) (rate(topspin_rollouts_received_total{RUN}[1m]))", "{{verdict}}"),),
            ),
            Panel(
                "Lost, refused, dropped",
                "short",
                (Query('topspin_ledger_rollouts{run="$run",fate=~"lost|refused|dropped"}', "{{fate}}"),),
            ),
            Panel(
                "Lag and queue",
                "short",
                (
                    Query(f"topspin_policy_lag{RUN}", "lag [versions]"),
                    Query(f"topspin_queue_depth{RUN}", "queue [rollouts]"),
                ),
            ),
            Panel(
                "Rallies in stock, and random launches",
                "short",
                (
                    Query(f"topspin_rally_buffer_depth{RUN}", "stock of actor {{id}}"),
                    Query(
                        f"rate(topspin_rally_underruns_total{RUN}[1m])", "random launches/s of actor {{id}}"
                    ),
                ),
            ),
        ),
    ),
    Row(
        "Processes",
        (
            Panel("CPU", "percentunit", (Query(f"rate(process_cpu_seconds_total{RUN}[1m])", _SERVICE),)),
            Panel("Memory", "bytes", (Query(f"process_resident_memory_bytes{RUN}", _SERVICE),)),
            Panel(
                "Time of an update, 99 of 100 are faster",
                "s",
                (Query(f"histogram_quantile(0.99, rate(topspin_update_seconds_bucket{RUN}[5m]))", "update"),),
            ),
            Panel(
                "Age of heartbeat and checkpoint",
                "s",
                (
                    Query(f"time() - topspin_heartbeat_time_seconds{RUN}", _SERVICE),
                    Query(f"time() - topspin_checkpoint_time_seconds{RUN}", "checkpoint"),
                ),
            ),
        ),
    ),
)


def expressions() -> tuple[str, ...]:
    """Return the PromQL of every panel."""
    return tuple(query.expression for row in ROWS for panel in row.panels for query in panel.queries)


def dashboard() -> dict[str, Any]:
    """Return the dashboard as Grafana imports it."""
    panels: list[dict[str, Any]] = []
    ids, y = count(1), 0
    for row in ROWS:
        place = {"h": 1, "w": COLUMNS, "x": 0, "y": y}
        panels.append({"id": next(ids), "type": "row", "title": row.title, "gridPos": place, "panels": []})
        width = COLUMNS // len(row.panels)
        for column, panel in enumerate(row.panels):
            place = {"h": HEIGHT, "w": width, "x": column * width, "y": y + 1}
            panels.append(_panel(panel, next(ids), place))
        y += 1 + HEIGHT
    return {
        "title": "Topspin",
        "uid": "topspin",
        "schemaVersion": 39,
        "tags": ["topspin"],
        "timezone": "browser",
        "refresh": "10s",
        "time": {"from": "now-1h", "to": "now"},
        "templating": {"list": [_source_variable(), _run_variable()]},
        "panels": panels,
    }


_SOURCE: Final = {"type": "prometheus", "uid": "${source}"}


def _panel(panel: Panel, id_: int, place: dict[str, int]) -> dict[str, Any]:
    targets = [
        {
            "refId": chr(ord("A") + i),
            "datasource": _SOURCE,
            "expr": query.expression,
            "legendFormat": query.legend,
        }
        for i, query in enumerate(panel.queries)
    ]
    return {
        "id": id_,
        "type": "timeseries",
        "title": panel.title,
        "description": _description(panel),
        "datasource": _SOURCE,
        "gridPos": place,
        "fieldConfig": {"defaults": {"unit": panel.unit}, "overrides": []},
        "targets": targets,
    }


def _description(panel: Panel) -> str:
    """Return what the metrics of a panel are, as their table says it."""
    text = " ".join(query.expression for query in panel.queries)
    return "\n".join(f"{name}: {metric.help}" for name, metric in METRICS.items() if name in text)


def _source_variable() -> dict[str, Any]:
    return {"name": "source", "label": "Prometheus", "type": "datasource", "query": "prometheus"}


def _run_variable() -> dict[str, Any]:
    query = 'label_values(topspin_process_up{role="learner"}, run)'
    return {
        "name": "run",
        "label": "Run",
        "type": "query",
        "datasource": _SOURCE,
        "definition": query,
        "query": {"query": query, "refId": "run"},
        "refresh": 2,
        "sort": 2,
    }
