"""The score card that a film ends with."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from common.task.states import Outcome
from topspin.render.overlay import OUTCOME_WORDS, ScoreCard


def score_card(found: Mapping[str, Any], policy: str) -> ScoreCard:
    """Return a film's score card: the measures of the whole match."""
    error = found["target_error_mean"]
    rows = (
        ("returned", f"{100 * found['return_rate']:.1f} %"),
        ("caught", f"{100 * found['catch_rate']:.1f} %"),
        ("mean distance to the target", f"{100 * error:.0f} cm" if error is not None else "–"),
    )
    counts = {Outcome[name.upper()]: count for name, count in found["outcomes"].items()}
    ordered = sorted(counts.items(), key=lambda item: (item[0] != Outcome.RETURNED, -item[1]))
    bars = tuple((OUTCOME_WORDS[outcome], count, outcome == Outcome.RETURNED) for outcome, count in ordered)
    title = f"{Path(policy).name}: {found['rallies']:,} {found['launch']} balls"
    return ScoreCard(title, rows, bars)
