"""Settings of `topspin real2sim`."""

from typing import ClassVar, Literal

from pydantic import Field

from common.evaluation.config import DEFAULT_ENVS, Environments, MatchSpin
from common.service.settings import LogLevel
from common.task.config import Perception, PlayConditions
from topspin.render.config import FilmConfig


class Real2SimConfig(FilmConfig, PlayConditions):
    """Play recordings of real balls with a policy, which observes them through a simulated camera and its filter.

    Recordings are states just after a stroke (DeepMind's JSON, CSV) or tracks (HDF5 of a ball gun, CSV), which are
    fitted first. A recording is played if it flies towards the robot, crosses the net and touches the robot's court
    first (valid_share); the rates are over these. Formats and frames: docs/real2sim.md.
    """

    often: ClassVar = {
        "What plays": ("policy", "expected_spin", "perception"),
        "The recordings": ("data", "mode", "turn", "randomization", "seed"),
        "The result": ("out", "json"),
    }

    data: str = Field("", description="recordings: a .json, .hdf5, .csv file, or a folder of them")
    policy: str = Field("default", description="a policy of the box, or a policy folder")
    mode: Literal["launch", "kinematic"] = Field(
        "launch",
        description="launch: simulated balls, with the recorded or fitted spin; kinematic: a track drives its "
        "ball until the racket touches it",
    )
    perception: Perception = Field(
        "full",
        description="how the robot observes the ball: full: estimate of a filter from a camera's detections; "
        "cheap: its true state with delay and noise",
    )
    expected_spin: MatchSpin = "contract"
    rallies: int = Field(
        0, ge=0, le=1_000_000, description="recordings to play, spread evenly over all; 0: every one"
    )
    turn: bool = Field(
        False,
        description="rotate states that fly away from the robot by 180 degrees, instead of dropping them",
    )
    strict: bool = Field(
        False, description="stop at the first file of a folder that can't be used, instead of skipping it"
    )
    seed: int = Field(
        0, ge=0, lt=2**63, description="seed of the rest: the same balls with other targets, tables and noise"
    )
    envs: Environments = DEFAULT_ENVS
    out: str = Field("", description="folder for a report with tables, plots and a film; empty: none")
    shown: int = Field(6, ge=0, le=60, description="recordings that the report draws singly")
    video: str = Field(
        "",
        pattern=r"^$|\.mp4$",
        description="film to write, H.264; empty: rallies.mp4 in --out, if --out is set",
    )
    film_rallies: int = Field(6, ge=0, le=200, description="rallies to film; 0: no film")
    slow: float = Field(
        0.5, ge=0.05, le=1, description="speed of the film; 0.5 is twice slower than real time"
    )
    json_line: bool = Field(
        False, alias="json", description="print the measures as one JSON object, last line"
    )
    log_level: LogLevel = Field("info", description="lowest level that is logged")
