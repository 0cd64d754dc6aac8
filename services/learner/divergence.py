"""Detection of divergence: the paper reports an "unexplained model failure", and a long run must survive one.

A stage's measure is the rate that it trains: balls caught in stages 1 and 2, balls returned in stage 3, as a running
mean over datasets with exploration noise. Training has diverged when it stays below a share of its best value in the
stage, or when updates are no longer finite. The learner then goes back to its last good checkpoint.
"""

from dataclasses import dataclass

import numpy as np

from services.learner.config import DivergenceConfig

NOT_FINITE = "parameters are not finite"
RUNNING = 0.2  # weight of the newest dataset in the running measure
GOOD_SHARE = 0.95  # of the stage's best rate: a checkpoint above it is good


@dataclass(frozen=True, slots=True)
class Health:
    """The history of a stage's measure; each stage starts a new one."""

    rate: float = float("nan")  # running
    best: float = 0.0  # highest running rate of the stage
    low_epochs: int = 0  # epochs in a row below the share

    @property
    def is_good(self) -> bool:
        """Whether a checkpoint of now is a good one."""
        return self.low_epochs == 0 and self.rate >= GOOD_SHARE * self.best


def running_mean(before: float, rate: float) -> float:
    """Return the running mean after a dataset's ``rate``; nan before: the first one; nan ``rate``: no change."""
    if np.isnan(before) or np.isnan(rate):
        return before if np.isnan(rate) else rate
    return (1 - RUNNING) * before + RUNNING * rate


def watched(health: Health, rate: float, config: DivergenceConfig) -> Health:
    """Return ``health`` after a dataset in which the stage's measure was ``rate`` (nan: no rally ended)."""
    if np.isnan(rate):
        return health
    running = running_mean(health.rate, rate)
    best = max(health.best, running)
    is_low = best >= config.least and running < config.collapse * best
    return Health(running, best, health.low_epochs + 1 if is_low else 0)


def divergence(health: Health, finite: bool, config: DivergenceConfig) -> str:
    """Return why training has diverged, or "".

    Args:
        health: After the newest dataset.
        finite: Whether all parameters are finite.
        config: The limits.
    """
    if not finite:
        return NOT_FINITE
    if health.low_epochs >= config.patience:
        return f"rate {health.rate:.3f} for {health.low_epochs} epochs, best was {health.best:.3f}"
    return ""
