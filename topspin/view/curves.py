"""The curves of a running training, from its folder."""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from common.service.run_folder import RunFolder
from topspin.report.collect import evaluation_curve, training_curve

Array = npt.NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Curves:
    """A run's evaluations so far."""

    minutes: Array  # (n,) of training
    return_rate: Array  # (n,) [%]
    catch_rate: Array  # (n,) [%]
    landing_error: Array  # (n,) [cm] nan where nothing landed
    frames: float  # trained so far
    stage: int  # curriculum stage; 0 before the first epoch


def read_curves(folder: RunFolder) -> Curves:
    """Return the curves of a run's folder; empty ones before its first evaluation."""
    training = training_curve(folder.metrics)
    curve = evaluation_curve(folder.evaluations, training)
    frames = float(training.frames[-1]) if training is not None else 0.0
    stage = int(training.stages[-1]) if training is not None else 0
    if curve is None:
        none = np.empty(0)
        return Curves(none, none, none, none, frames, stage)
    values = curve.values
    return Curves(
        curve.minutes,
        100.0 * values["return_rate"],
        100.0 * values["catch_rate"],
        100.0 * values["target_error_mean"],
        frames,
        stage,
    )
