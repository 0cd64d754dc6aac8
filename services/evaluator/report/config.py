"""Settings of the report."""

from typing import Literal

from pydantic import BaseModel, ConfigDict, Field

from common.rally.launch_presets import PresetName
from services.evaluator.match import DEFAULT_ENVS, Environments


class ReportConfig(BaseModel):
    """Compare runs: play their policies on the same rallies, write report.md and report.html with tables and plots."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    runs: tuple[str, ...] = Field(
        (), description="runs, by name under runs/ or by folder; RUN... is short for it"
    )
    out: str = Field("runs/report", min_length=1, description="folder of the report; made if it isn't there")
    note: str = Field(
        "", description="text file whose paragraphs stand at the top: what it comes to, in words"
    )
    rallies: int = Field(2000, ge=1, le=1_000_000, description="rallies that each policy plays")
    seed: int = Field(20260, ge=0, lt=2**63, description="of these rallies")
    launch: PresetName = Field("paper", description="launch preset")
    policy: Literal["best", "latest"] = Field("best", description="which of a run's policies plays")
    rounds_too: bool = Field(
        False, description="play once more with five rallies an episode: how long do rallies go on"
    )
    envs: Environments = DEFAULT_ENVS
