"""Settings of the report."""

from typing import ClassVar, Literal

from pydantic import Field

from common.evaluation.config import MatchConfig


class ReportConfig(MatchConfig):
    """Compare runs: play their policies on the same rallies, and write a report with tables and plots.

    The report is report.md, report.html (one file with its pictures) and results.json.
    """

    often: ClassVar = {
        "The runs": ("runs", "policy"),
        "The report": ("out", "note"),
        "The rallies": ("rallies", "launch", "rounds_too", "seed", "envs", "randomization"),
    }

    runs: tuple[str, ...] = Field(
        (), description="runs, by name under runs/ or by folder; RUN... means the same"
    )
    out: str = Field("runs/report", min_length=1, description="folder of the report")
    note: str = Field("", description="text file whose paragraphs are at the top of the report")
    policy: Literal["best", "latest"] = Field("best", description="which of a run's policies is played")
    rounds_too: bool = Field(
        False, description="also play five rallies per episode, to measure how long rallies last"
    )
