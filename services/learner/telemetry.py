"""The learner's metrics and heartbeat, from an epoch's stats, the ledger and the intake."""

from collections.abc import Iterable, Mapping
from typing import Final

from common.comms.messages import FATES, VerdictKind
from common.service.metrics import Metrics
from common.task.reward import TERMS
from common.task.states import Outcome
from services.learner.epoch_stats import EpochStats, Progress
from services.learner.intake import Intake
from services.learner.ledger import Ledger

_MEMBERS: Final = ("generator", "actor", "evaluator")


def begin(metrics: Metrics) -> None:
    """Export 0 for every label that counts: from nothing to 1 is no rise for Prometheus."""
    for verdict in set(VerdictKind) - {VerdictKind.CREDITS, VerdictKind.LIFE_ENDED}:
        metrics.inc("topspin_rollouts_received_total", 0.0, verdict=verdict.value)
    for outcome in Outcome:
        if outcome is not Outcome.NONE:
            metrics.inc("topspin_outcomes_total", 0.0, outcome=outcome.name.lower())
    metrics.inc("topspin_phase_seconds_total", 0.0, phase="update")


def epoch_gauges(stats: EpochStats, frames_per_s: float) -> dict[str, float]:
    """Return an epoch's figures as the heartbeat shows them."""
    play, update = stats.play, stats.update
    return {
        "frames_per_s": frames_per_s,
        "catch_rate": play.catch_rate,
        "return_rate": play.return_rate,
        "target_error": play.target_error,
        "reward": play.mean_return,
        "lag": stats.lag,
        "kl": update.kl,
        "learning_rate": update.learning_rate,
        "explained_variance": update.explained_variance,
    }


def measure_epoch(metrics: Metrics, stats: EpochStats, frames_per_s: float, update_s: float) -> None:
    """Put an epoch into the metrics.

    Args:
        metrics: Written.
        stats: The epoch's.
        frames_per_s: Trained since the last epoch.
        update_s: Duration of the update [s].
    """
    play, update, progress = stats.play, stats.update, stats.progress
    metrics.inc("topspin_frames_total", stats.frames)
    metrics.inc("topspin_episodes_total", int(play.outcomes.sum()))
    measure_update(metrics, update_s)
    for outcome in Outcome:
        if outcome is not Outcome.NONE and play.outcomes[outcome]:
            count = int(play.outcomes[outcome])
            metrics.inc("topspin_outcomes_total", count, outcome=outcome.name.lower())
    for name, value in {
        "topspin_frames_per_second": frames_per_s,
        "topspin_catch_rate": play.catch_rate,
        "topspin_over_rate": play.over_rate,
        "topspin_return_rate": play.return_rate,
        "topspin_target_error_meters": play.target_error,
        "topspin_episode_reward": play.mean_return,
        "topspin_policy_version": progress.version,
        "topspin_policy_lag": stats.lag,
        "topspin_stage": progress.stage,
        "topspin_epoch": progress.epoch,
        "topspin_learning_rate": update.learning_rate,
        "topspin_kl": update.kl,
        "topspin_clip_fraction": update.clip_fraction,
        "topspin_entropy": update.entropy,
        "topspin_policy_loss": update.policy_loss,
        "topspin_correction_loss": update.correction_loss,
        "topspin_value_loss": update.value_loss,
        "topspin_explained_variance": update.explained_variance,
        "topspin_gradient_norm": update.gradient_norm,
    }.items():
        metrics.set(name, value)
    for name, term in zip(TERMS, play.reward_terms, strict=True):
        metrics.set("topspin_reward_per_frame", float(term), term=name)


def measure_update(metrics: Metrics, update_s: float) -> None:
    """Put the duration of an update [s] into the metrics, also of a learner that does not lead."""
    metrics.inc("topspin_phase_seconds_total", update_s, phase="update")
    metrics.observe("topspin_update_seconds", update_s)


def fates(ledger: Ledger) -> dict[str, int]:
    """Return the ledger's counts by fate."""
    counts: dict[str, int] = {name: getattr(ledger, name) for name in FATES if name != "refused"}
    return {name: sum(ledger.refused.values()) if name == "refused" else counts[name] for name in FATES}


def measure_state(metrics: Metrics, ledger: Ledger, intake: Intake, alive: Iterable[str]) -> None:
    """Put ledger, queue and membership into the metrics; ``alive`` holds the role of each live service."""
    for fate, count in fates(ledger).items():
        metrics.set("topspin_ledger_rollouts", count, fate=fate)
    metrics.set("topspin_queue_depth", intake.queued)
    metrics.set("topspin_rollout_gaps", intake.gaps())
    metrics.set("topspin_misfit_actors", len(intake.misfits))
    roles = list(alive)
    for role in _MEMBERS:
        metrics.set("topspin_alive", roles.count(role), service=role)


def heartbeat(
    progress: Progress,
    curriculum: int,
    seconds: float,
    counts: Mapping[str, int],
    queued: int,
    last: Mapping[str, float],
) -> tuple[dict[str, float], dict[str, float]]:
    """Return counters and gauges of the learner's heartbeat.

    Args:
        progress: Of training.
        curriculum: Frames of the whole curriculum; 0: its stages are shares of the run's frames.
        seconds: Training time, through restarts [s].
        counts: The ledger of all actors, by fate.
        queued: Rollouts that wait for an update.
        last: ``epoch_gauges`` of the newest epoch.
    """
    counters = {"frames": float(progress.frames)} | {k: float(v) for k, v in counts.items()}
    gauges = {
        "epoch": progress.epoch,
        "curriculum_frames": curriculum,
        "version": progress.version,
        "stage": progress.stage,
        "queued": queued,
        "seconds": seconds,
        **last,
    }
    return counters, gauges
