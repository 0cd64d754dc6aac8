"""The score: how the balls shown so far ended."""

from collections.abc import Mapping
from dataclasses import dataclass, field

from common.evaluation.rally_recorder import RecordedRally
from common.task.states import Outcome


@dataclass(frozen=True, slots=True)
class Score:
    """Balls by outcome, and the landing errors of those that landed."""

    counts: Mapping[Outcome, int] = field(default_factory=dict)
    caught: int = 0  # the racket touched the ball legally
    error_sum: float = 0.0  # [m]

    @property
    def balls(self) -> int:
        """How many balls."""
        return sum(self.counts.values())

    @property
    def returned(self) -> int:
        """How many were returned."""
        return self.counts.get(Outcome.RETURNED, 0)

    @property
    def return_rate(self) -> float:
        """Share of balls that were returned; nan before the first."""
        return self.returned / self.balls if self.balls else float("nan")

    @property
    def catch_rate(self) -> float:
        """Share of balls that the racket touched legally; nan before the first."""
        return self.caught / self.balls if self.balls else float("nan")

    @property
    def landing_error(self) -> float:
        """Mean distance of returned balls to their target [m]; nan before the first."""
        return self.error_sum / self.returned if self.returned else float("nan")

    def with_rally(self, rally: RecordedRally) -> "Score":
        """Return the score with one more ball."""
        counts = {**self.counts, rally.outcome: self.counts.get(rally.outcome, 0) + 1}
        error = rally.landing_error if rally.outcome == Outcome.RETURNED else 0.0
        return Score(counts, self.caught + int(2 in rally.state), self.error_sum + error)

    def by_outcome(self) -> list[tuple[Outcome, int]]:
        """Return the outcomes that occurred with their counts: returned first, then the frequent ones."""
        return sorted(self.counts.items(), key=lambda item: (item[0] != Outcome.RETURNED, -item[1], item[0]))
