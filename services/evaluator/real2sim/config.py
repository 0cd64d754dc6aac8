"""Settings of `python -m services.evaluator real2sim`."""

from typing import Literal

from pydantic import Field

from services.evaluator.filming import FilmConfig
from services.evaluator.match import DEFAULT_ENVS, Environments


class Real2SimConfig(FilmConfig):
    """Play recordings of real balls with a policy, which sees them through a simulated camera and an estimator.

    Recordings are states just after a stroke (DeepMind's JSON, CSV) or tracks (HDF5 of a ball gun, CSV), which are
    fitted first; docs/real2sim.md has formats and frames. Played is whatever flies towards the robot, crosses the net
    and touches its court first (valid_share); the rates are over these.
    """

    data: str = Field("", description="recordings: a .json, .hdf5, .csv file, or a folder of them")
    policy: str = Field(
        "",
        description="policy folder; empty: assets/policies/default if it is there, else the latest run's best",
    )
    mode: Literal["launch", "kinematic"] = Field(
        "launch",
        description="launch: balls fly as our physics has it, with the recorded or fitted spin; kinematic: a track "
        "drives its ball until the racket touches it",
    )
    perception: Literal["full", "cheap"] = Field(
        "full",
        description="what is seen of the ball: an estimate from a simulated camera, or its true state, late and noisy",
    )
    noise: Literal["off", "standard", "hard"] = Field(
        "standard",
        description="what differs from rally to rally; the air is the recording's: nominal, or fitted",
    )
    rallies: int = Field(
        0, ge=0, le=1_000_000, description="recordings to play, taken evenly from all; 0: every one"
    )
    turn: bool = Field(
        False, description="turn states that fly away from the robot by half a turn, instead of dropping them"
    )
    seed: int = Field(0, ge=0, lt=2**63, description="the same balls with other targets, tables and noise")
    envs: Environments = DEFAULT_ENVS
    out: str = Field("", description="folder for a report with tables, plots and a film; empty: none")
    shown: int = Field(6, ge=0, le=60, description="recordings that the report draws one by one")
    video: str = Field(
        "",
        pattern=r"^$|\.mp4$",
        description="film to write, H.264; empty: rallies.mp4 in --out, if that is given",
    )
    film_rallies: int = Field(6, ge=0, le=200, description="rallies to film; 0: no film")
    slow: float = Field(
        0.5, ge=0.05, le=1, description="speed of the film; 0.5 is twice slower than real time"
    )
    json_line: bool = Field(
        False, alias="json", description="print the measures as one JSON object, last line"
    )
    log_level: Literal["debug", "info", "warning", "error"] = Field(
        "info", description="least severe lines logged"
    )
