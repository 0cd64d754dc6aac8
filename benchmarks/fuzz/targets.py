"""What reads bytes of others: one table."""

import json
import tempfile
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any, Final

import numpy as np

from benchmarks.fuzz.message_examples import EXAMPLES
from common.comms.codec import DecodeError, decode, encode
from common.comms.messages import MESSAGES
from common.errors import ConfigError
from common.policy.config import NetworkConfig
from common.policy.contract import CONTRACT_FILE, WEIGHTS_FILE, PolicyError, contract_of
from common.policy.folder import load_policy, save_policy
from common.service.config import save_settings, to_tables
from common.service.config_sources import read_toml
from common.service.table import Table, whole_rows
from common.task.config import TaskConfig
from common.task.experience import ExperienceConfig
from deploy.config import SECTION, DeployConfig
from services.learner import checkpoint
from services.learner.admission import open_rollout
from services.learner.checkpoint import CheckpointError, Extras
from services.learner.config import CurriculumConfig, PPOConfig
from services.learner.curriculum import StageLengths
from services.learner.training import Training
from topspin.real2sim.formats.recordings import load
from topspin.real2sim.formats.tracks import RecordingError

LIMIT_BYTES: Final = 1 << 20
SMALL: Final = NetworkConfig(units=(4, 4))


@dataclass(frozen=True, slots=True)
class Target:
    """Something that reads bytes.

    Args:
        name: As it is printed.
        examples: Valid inputs, from which others are made.
        read: Reads an input.
        refusals: The errors by which it refuses. Any other is a fault.
    """

    name: str
    examples: tuple[bytes, ...]
    read: Callable[[bytes], object]
    refusals: tuple[type[Exception], ...]

    def run(self, data: bytes) -> bool:
        """Return whether an input is read, and not refused."""
        try:
            self.read(data)
        except self.refusals:
            return False
        return True


@cache
def _folder() -> Path:
    """Return a folder of this process, in memory where the system has one there."""
    memory = Path("/dev/shm")
    return Path(tempfile.mkdtemp(prefix="topspin-fuzz-", dir=memory if memory.is_dir() else None))


def _file(name: str, read: Callable[[Path], object]) -> Callable[[bytes], object]:
    """Return a reader of bytes that gets them as a file with this name."""

    def act(data: bytes) -> object:
        path = _folder() / name
        path.parent.mkdir(exist_ok=True)
        path.write_bytes(data)
        return read(path)

    return act


def _decoder(kind: type[Any]) -> Target:
    examples = tuple(encode(example) for example in EXAMPLES if type(example) is kind)
    return Target(f"message {kind.__name__}", examples, lambda data: decode(data, kind), (DecodeError,))


def _admission() -> Target:
    examples = tuple(encode(example) for example in EXAMPLES)
    return Target("rollout at the learner", examples, lambda data: open_rollout(data, LIMIT_BYTES, 5), ())


def _training() -> Training:
    home, observation = np.zeros(7, np.float32), TaskConfig().observation
    return Training(PPOConfig(), SMALL, StageLengths(CurriculumConfig()), home, 0, observation=observation)


def _policy() -> tuple[Target, Target]:
    training = _training()
    contract = contract_of(
        TaskConfig(), ExperienceConfig(), SMALL, run="r", generation=1, version=1, stage=1, frames=1
    )
    folder = _folder() / "policy"
    save_policy(folder, training.network, training.obs_moments, contract)
    files = {name: (folder / name).read_bytes() for name in (WEIGHTS_FILE, CONTRACT_FILE)}

    def reader(name: str) -> Callable[[bytes], object]:
        def act(data: bytes) -> object:
            for other, content in files.items():
                (folder / other).write_bytes(data if other == name else content)
            return load_policy(folder)

        return act

    return (
        Target("policy weights", (files[WEIGHTS_FILE],), reader(WEIGHTS_FILE), (PolicyError,)),
        Target("policy contract", (files[CONTRACT_FILE],), reader(CONTRACT_FILE), (PolicyError,)),
    )


def _checkpoint() -> Target:
    training = _training()
    extras = Extras("r", 5, [], [], 1.5, closed=(("a", 3),), queue=(b"one",))
    path = checkpoint.save(_folder() / "checkpoints", training, extras)
    read = _file("one.safetensors", lambda file: checkpoint.restore(file, training))
    return Target("checkpoint", (path.read_bytes(),), read, (CheckpointError,))


def _settings() -> Target:
    path = _folder() / "example.toml"
    save_settings(path, to_tables(DeployConfig(run="r"), SECTION))
    return Target("config.toml", (path.read_bytes(),), _file("config.toml", read_toml), (ConfigError,))


def _curve() -> Target:
    path = _folder() / "example.csv"
    path.unlink(missing_ok=True)
    table = Table(path, ("epoch", "loss"))
    for epoch in range(4):
        table.append({"epoch": epoch, "loss": 0.5})
    return Target("metrics.csv", (path.read_bytes(),), _file("metrics.csv", whole_rows), ())


CSV_TRACK: Final = "track,time,x,y,z\n" + "".join(
    f"a,{0.01 * n:.3f},{1.4 - 0.05 * n:.3f},0.1,{0.3 + 0.03 * n - 0.0005 * n * n:.4f}\n" for n in range(30)
)
CSV_STATE: Final = "time,x,y,z,vx,vy,vz,wx,wy,wz\n0,1.4,0.1,0.3,-5,0.1,1.5,10,200,0\n"
FRAME: Final = """axes = ["x", "y", "z"]
origin = [0.0, 0.0, 0.0]
length_unit = "m"
rate_hz = 100
velocity_delay_s = 0.01
kind = "track"
label = "spin"
"""
STATE_VALUES: Final = (0.1, 1.4, 0.3, 0.1, -5.0, 1.5, 10.0, 200.0, 0.0)
STATE_NAMES: Final = tuple(f"{what}_{axis}" for what in ("pos", "vel", "w_vel") for axis in "xyz")
JSON_STATES: Final = json.dumps(
    [{"id": 1, "player": "a", **dict(zip(STATE_NAMES, STATE_VALUES, strict=True))}]
)


def _recordings() -> tuple[Target, ...]:
    def frame(data: bytes) -> object:
        (_folder() / "framed.csv").write_text(CSV_TRACK)
        (_folder() / "framed.toml").write_bytes(data)
        return load(_folder() / "framed.csv")

    tables = tuple(text.encode() for text in (CSV_TRACK, CSV_STATE))
    return (
        Target("recording .csv", tables, _file("track.csv", load), (RecordingError,)),
        Target("recording .json", (JSON_STATES.encode(), b"[]"), _file("state.json", load), (RecordingError,)),
        Target("recording .toml", (FRAME.encode(),), frame, (RecordingError,)),
    )  # fmt: skip


@cache
def targets() -> Mapping[str, Target]:
    """Return every target by name."""
    found = (
        *(_decoder(kind) for kind in sorted(MESSAGES, key=lambda kind: kind.__name__)),
        _admission(),
        *_policy(),
        _checkpoint(),
        _settings(),
        _curve(),
        *_recordings(),
    )
    return {target.name: target for target in found}
