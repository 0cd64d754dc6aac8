"""How much a run may train, and when it has: counted through all its restarts."""

import math
from dataclasses import dataclass
from typing import Final

ENDING_S: Final = 1.0  # a run that has less left than this has ended: its last dataset came too late

NOTHING_LEFT: Final = (
    "nothing is left to train: %s are trained, through all restarts; give --minutes or --frames more (0: no limit), "
    "or --%scurriculum.stage-3"
)
"""The log's line about a run that goes on though its budget is spent: what is, and how the curriculum's flag begins."""


@dataclass(frozen=True, slots=True)
class Budget:
    """What ends a run."""

    datasets: int  # of the whole curriculum
    frames: int  # 0: no limit
    minutes: float  # since the first trained batch; 0: no limit

    def spent(self, datasets: int, frames: int, seconds: float, slack_s: float = 0.0) -> str:
        """Return the limit that is reached, such as "10 of 10 minutes", or "".

        Args:
            datasets: Trained.
            frames: Trained.
            seconds: Since the first trained batch [s].
            slack_s: What may be missing of the minutes [s].
        """
        limits = (
            ("datasets", datasets, self.datasets, 0.0),
            ("frames", frames, self.frames or math.inf, 0.0),
            ("minutes", seconds / 60.0, self.minutes or math.inf, slack_s / 60.0),
        )
        return next(
            (
                f"{_written(done)} of {_written(limit)} {name}"
                for name, done, limit, slack in limits
                if done + slack >= limit
            ),
            "",
        )


def _written(value: float) -> str:
    return f"{round(value, 2):,.15g}"
