"""How much a run may train, counted through all its restarts."""

import math
from dataclasses import dataclass
from typing import Final

from pydantic import BaseModel, ConfigDict, Field

ENDING_S: Final = 1.0  # a run with less time left than this has ended: its last dataset arrived too late

NOTHING_LEFT: Final = (
    "nothing is left to train: %s are trained, through all restarts; raise --minutes or --frames (0: no limit), "
    "or --%scurriculum.stage-3"
)
"""Log line of a resumed run whose budget is spent: the spent limit, and the prefix of the curriculum's flag."""


class BudgetConfig(BaseModel):
    """When a run stops before the end of its curriculum."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    minutes: float = Field(
        0.0,
        ge=0,
        description="stop this long after the first trained batch, counted through restarts; 0: the whole curriculum",
        json_schema_extra={"unit": "min"},
    )
    frames: int = Field(
        0,
        ge=0,
        description="stop after this many trained frames, counted through restarts; 0: the whole curriculum",
    )


@dataclass(frozen=True, slots=True)
class Budget:
    """The limits that end a run."""

    curriculum: int | None  # frames of all its stages; None: no limit
    frames: int  # 0: no limit
    minutes: float  # since the first trained batch; 0: no limit

    def spent(self, frames: int, seconds: float, slack_s: float = 0.0) -> str:
        """Return the limit that is reached, such as "10 of 10 minutes", or "".

        Args:
            frames: Trained so far.
            seconds: Since the first trained batch [s].
            slack_s: The minutes count as reached this long before their end [s].
        """
        limits = (
            ("frames", frames, self.frames or math.inf, 0.0),
            (
                "frames of the curriculum",
                frames,
                math.inf if self.curriculum is None else self.curriculum,
                0.0,
            ),
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
