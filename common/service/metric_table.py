"""All metrics of all services in one table.

`topspin.reference` writes it as the page docs/reference/metrics.md, and alarms and panels are checked against it.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Final, Literal

_G, _A, _L, _E = "generator", "actor", "learner", "evaluator"
_R: Final = "router"
_ALL: Final = (_G, _A, _L, _E)


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
        raise ValueError("a metric stands twice in the table")
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


def markdown() -> str:
    """Return the table as a document."""
    lines = [
        "# Metrics",
        "",
        "Every service serves these at `/metrics` in Prometheus' text format. Each sample also has the labels "
        f"{', '.join(f'`{label}`' for label in OWN_LABELS)} of its service. A gauge is exported from its first value "
        "on. `process_*` (memory, CPU time, open files) and `python_gc_*` are of Prometheus' client.",
        "Generated by `python -m topspin.reference` from `common/service/metric_table.py`.",
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
