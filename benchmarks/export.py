"""An exported policy against ours: the same observations and actions, the same returns, and its time on a robot.

    python -m benchmarks.export --json

A policy is exported, and its wheel is unpacked into an empty folder. Then

- rallies are played by our policy, and the wheel's source observes them from the camera's detections: observation and
  action are compared, number by number;
- the same rallies are played twice, by our policy, and by one controller for each environment, which gets detections
  and joints alone and sends joint targets (ONNX Runtime);
- a program with nothing but the wheel, numpy, numba, pydantic and ONNX Runtime times its control steps, and names the
  packages that it has imported.
"""

import json
import os
import subprocess
import sys
import tempfile
import zipfile
from collections.abc import Callable
from pathlib import Path
from threading import Event
from typing import Any, Final

import numpy as np
import numpy.typing as npt
from pydantic import Field

from benchmarks.settings import BenchmarkConfig, print_figures, run
from common.env.rally_env import RallyEnv
from common.evaluation.match import FixedRallies, evaluation_rallies
from common.perception.camera import DETECTION_BUFFER, READ, detection_row
from common.physics.constants import GRID_STEP
from common.policy.box import policy_folder
from common.policy.folder import Policy, load_policy
from common.task.config import PresetName, TaskConfig
from common.task.experience import MATCH
from common.task.launch import Purpose, RallyBlock, draw_rallies
from common.task.launch_presets import SERVE
from common.task.randomization import RallyParameter
from common.task.states import Outcome
from topspin.export.folder import export_policy
from topspin.robot.contract import POLICY_FILE, RobotContract
from topspin.robot.controller import Controller
from topspin.robot.network import Network
from topspin.robot.tracker import BallTracker

Array = npt.NDArray[np.float64]
Floats = npt.NDArray[np.float32]

GAP: Final = 2.0  # [s] between two balls on a robot's clock
FORBIDDEN: Final = ("torch", "mujoco", "topspin", "common", "gymnasium", "zenoh")  # on a robot

ON_A_ROBOT: Final = """
import json, os, sys, time
started = time.perf_counter()
import numpy as np
import topspin_robot
from topspin_robot.__main__ import time_steps
controller = topspin_robot.load(sys.argv[1])
ready = time.perf_counter() - started
first = max(time_steps(controller, 20, time.thread_time))
steps, scheduling = int(sys.argv[2]), "real time"
try:  # as a robot's control loop runs: other work on the machine does not interrupt it
    os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(50))
except (AttributeError, OSError):
    scheduling = "normal"
wall, own = (1e3 * np.array(time_steps(controller, steps, clock)) for clock in (time.perf_counter, time.thread_time))
packages = sorted({name.partition(".")[0] for name in sys.modules} - set(sys.stdlib_module_names))
print(json.dumps({
    "ready_s": ready, "first_ball_ms_max": 1e3 * first,
    "p50": np.percentile(wall, 50), "p99": np.percentile(wall, 99), "cpu_p99": np.percentile(own, 99),
    "scheduling": scheduling, "packages": [name for name in packages if not name.startswith("_")],
}))
"""


class Detections:
    """What the camera of one environment has detected and sent, ball by ball, on a clock that never goes back."""

    def __init__(self, env: RallyEnv, row: int) -> None:
        self._env, self._row = env, row
        self._start, self._read = 0.0, 0
        self._last = -GAP

    @property
    def now(self) -> float:
        """The robot's clock [s]."""
        return self._start + float(self._env.rallies.clock[self._row]) * GRID_STEP

    def begin(self) -> None:
        """Begin the next ball."""
        self._start, self._read = self._last + GAP, 0

    def new(self) -> list[tuple[float, tuple[float, float, float]]]:
        """Return the detections that have arrived since the last call: time stamp [s] and position [m]."""
        self._last = self.now
        buffer = self._env.rallies.camera_state[self._row, :DETECTION_BUFFER]
        first, self._read = self._read, int(buffer[READ])
        rows = [detection_row(buffer, k) for k in range(first, self._read)]
        return [(self._start + row[0], (row[1], row[2], row[3])) for row in rows]


def ball_of(env: RallyEnv, row: int) -> tuple[tuple[float, float], bool]:
    """Return an environment's target [m], and whether its ball is served."""
    parameters = env.rallies.parameters[row]
    target = float(parameters[RallyParameter.TARGET_X]), float(parameters[RallyParameter.TARGET_Y])
    return target, bool(parameters[RallyParameter.KIND] == SERVE)


class Trackers:
    """Observers of all environments, beside our policy that plays: how much do observations and actions differ?"""

    def __init__(self, env: RallyEnv, contract: RobotContract, network: Network, policy: Policy) -> None:
        self._env, self._network, self._policy = env, network, policy
        self._detections = [Detections(env, row) for row in range(env.count)]
        self._trackers = [BallTracker(contract) for _ in range(env.count)]
        self.compared, self.observation_error, self.action_error = 0, 0.0, 0.0

    def begin(self, rows: npt.NDArray[np.int64]) -> None:
        """Begin new balls."""
        for row in rows.tolist():
            target, served = ball_of(self._env, row)
            self._detections[row].begin()
            self._trackers[row].begin(target, served=served)

    def act(self, obs: Floats) -> Array:
        """Return our policy's actions, and compare."""
        env, ours = self._env, self._policy.act(obs)
        theirs = np.empty((env.count, self._policy.network.obs_size), np.float32)
        for row, tracker in enumerate(self._trackers):
            detections = self._detections[row]
            for moment, pos in detections.new():
                tracker.add(moment, pos)
            sample = tracker.sample_at(detections.now)
            if sample is None:
                raise RuntimeError(f"environment {row} plays a ball that its camera has not detected")
            theirs[row] = tracker.observe(
                detections.now, env.robot.joint_pos[row], env.robot.joint_vel[row], sample
            )
        known = obs[:, : theirs.shape[1]]
        # A spin of 300 rad/s has steps of 3e-5 in float32
        error = np.abs(theirs - known) / np.maximum(np.abs(known), 1.0)
        self.observation_error = max(self.observation_error, float(error.max()))
        difference = self._network.act(theirs) - np.clip(ours, -1.0, 1.0)
        self.action_error = max(self.action_error, float(np.abs(difference).max()))
        self.compared += env.count
        return ours.astype(np.float64)


class Controllers:
    """One controller for each environment. They get what a robot's camera and encoders measure, and nothing else."""

    def __init__(self, env: RallyEnv, contract: RobotContract, network: Network) -> None:
        self._env = env
        self._detections = [Detections(env, row) for row in range(env.count)]
        self.controllers = [Controller(contract, network) for _ in range(env.count)]
        self._middle, self._half_range = contract.of_joints("middle"), contract.of_joints("half_range")

    def begin(self, rows: npt.NDArray[np.int64]) -> None:
        """Begin new balls."""
        for row in rows.tolist():
            target, served = ball_of(self._env, row)
            self._detections[row].begin()
            self.controllers[row].begin(target, served=served)

    def act(self, _obs: Floats) -> Array:
        """Return the actions whose joint targets the controllers send."""
        robot, targets = self._env.robot, np.empty((self._env.count, 7))
        for row, controller in enumerate(self.controllers):
            detections = self._detections[row]
            for moment, pos in detections.new():
                controller.see(moment, pos)
            command = controller.step(detections.now, robot.joint_pos[row], robot.joint_vel[row])
            targets[row] = command.positions
        actions: Array = (targets - self._middle) / self._half_range
        return actions


class Ours:
    """Our policy on our observations."""

    def __init__(self, policy: Policy) -> None:
        self._policy = policy

    def begin(self, _rows: npt.NDArray[np.int64]) -> None:
        """A policy has no memory."""

    def act(self, obs: Floats) -> Array:
        """Return our policy's actions."""
        return self._policy.act(obs).astype(np.float64)


Player = Ours | Trackers | Controllers


def play(env: RallyEnv, player: Player, rallies: RallyBlock, is_done: Callable[[], bool]) -> float:
    """Return the share of ``rallies`` that was returned; play until all are over, or ``is_done``."""
    obs = env.reset()
    player.begin(np.arange(env.count))
    over, returned = 0, 0
    while over < len(rallies.seeds) and not is_done():
        step = env.step(player.act(obs))
        obs, finished = step.obs, step.finished
        own = np.isin(finished.seeds, rallies.seeds) & finished.validated
        over += int(own.sum())
        returned += int((finished.outcomes[own] == Outcome.RETURNED).sum())
        player.begin(finished.rows)
    return returned / max(over, 1)


def make_env(task: TaskConfig, rallies: RallyBlock, envs: int) -> RallyEnv:
    """Return an environment that plays each of ``rallies`` once."""
    filler = draw_rallies(64, TaskConfig(), seed=0, purpose=Purpose.FALLBACK)
    return RallyEnv(envs, task, FixedRallies(rallies, filler), stage=3, experience=MATCH)


def on_a_robot(folder: Path, steps: int) -> tuple[dict[str, Any], dict[str, Any]]:
    """Return what a program with the wheel alone measures: with cold kernels, and with those on the disk."""
    with tempfile.TemporaryDirectory() as target:
        with zipfile.ZipFile(next(folder.glob("*.whl"))) as wheel:
            wheel.extractall(target)
        found = []
        for count in (20, steps):
            done = subprocess.run(
                [sys.executable, "-c", ON_A_ROBOT, str(folder), str(count)],
                env={**os.environ, "PYTHONPATH": target},
                cwd=target,
                capture_output=True,
                text=True,
                check=True,
            )
            found.append(json.loads(done.stdout))
    return found[0], found[1]


class ExportBenchmark(BenchmarkConfig):
    """Compare an exported policy with ours: observations, actions, returns; and time it as a robot would run it."""

    policy: str = Field("default", description="a policy of the box, or a policy folder")
    observations: int = Field(10_000, ge=100, description="observations to compare")
    rallies: int = Field(1000, ge=1, description="rallies of each of the two matches")
    launch: PresetName = Field("paper", description="launch preset")
    steps: int = Field(20_000, ge=100, description="control steps to time")
    envs: int = Field(100, ge=1, description="environments played together")
    seed: int = Field(20260, ge=0, lt=2**63, description="of the rallies")


def main(config: ExportBenchmark, stop: Event) -> int:
    """Measure and print."""
    policy = load_policy(policy_folder(config.policy))
    task = policy.contract.task.model_copy(
        update={"perception": "full", "flight": "full", "launch": config.launch}
    )
    rallies = evaluation_rallies(config.rallies, task, config.seed)
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place) / "exported"
        contract, _ = export_policy(policy, "benchmark", folder)
        network = Network(folder / POLICY_FILE, contract.size)
        env = make_env(task, rallies, config.envs)
        trackers = Trackers(env, contract, network, policy)
        play(env, trackers, rallies, lambda: stop.is_set() or trackers.compared >= config.observations)
        ours = play(make_env(task, rallies, config.envs), Ours(policy), rallies, stop.is_set)
        env = make_env(task, rallies, config.envs)
        controllers = Controllers(env, contract, network)
        theirs = play(env, controllers, rallies, stop.is_set)
        cold, warm = on_a_robot(folder, config.steps)
    faults = sum(sum(c.faults.values()) for c in controllers.controllers)
    packages = warm["packages"]
    print_figures(
        {
            "policy": config.policy,
            "launch": config.launch,
            "parity_max": max(trackers.action_error, trackers.observation_error),
            "parity_actions": trackers.action_error,
            "parity_observations": trackers.observation_error,
            "observations": trackers.compared,
            "rallies": config.rallies,
            "return_rate_ours": round(ours, 4),
            "return_rate_exported": round(theirs, 4),
            "closed_loop_return_difference": round(100.0 * (theirs - ours), 2),
            "bad_measurements": faults,
            "scheduling": warm["scheduling"],
            "latency_ms_p50": round(warm["p50"], 3),
            "latency_ms_p99": round(warm["p99"], 3),
            "cpu_ms_p99": round(warm["cpu_p99"], 3),
            "first_ball_ms_max": round(warm["first_ball_ms_max"], 3),
            "ready_s_first_time": round(cold["ready_s"], 1),
            "ready_s": round(warm["ready_s"], 1),
            "torch_or_mujoco_imported": any(name in FORBIDDEN for name in packages),
            "packages_imported": packages,
        },
        config.json_line,
    )
    return 0


if __name__ == "__main__":
    sys.exit(run("export", ExportBenchmark, main))
