"""Accuracy of the camera filter at the present moment, and its cost: position, velocity, trajectory state.

    python -m benchmarks.camera_filter --json

A policy plays valid ``paper`` rallies, so balls bounce and are hit. At every control step the estimate for that moment,
the camera's latency after its newest detection, is compared with the truth. One baseline on the same detections is
numerical differentiation over a sliding window (the paper's), extrapolated linearly. The other is a quadratic fitted to
the same window, which gets the touches and gross errors that the filter found.
The cost is the environment's speed with and without camera and filter. Short slices of both alternate.
"""

import json
import sys
import time
from dataclasses import dataclass
from threading import Event
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from pydantic import Field

from benchmarks.env import ACTIONS, RALLIES, SPREAD, MemoryRallies, play, slices
from benchmarks.paired import paired
from benchmarks.settings import BenchmarkConfig, run
from common.env.rally_env import RallyEnv
from common.jit import kernel
from common.perception.camera import DETECTION, DETECTION_BUFFER, DETECTIONS, FIRST_DETECTION, READ
from common.perception.camera_filter import TOUCH, estimate_at
from common.physics.constants import GRID_STEP
from common.policy.box import policy_folder
from common.policy.folder import Policy, load_policy
from common.rally.state import Rallies
from common.task.config import Randomization, TaskConfig
from common.task.experience import MATCH
from common.task.launch import draw_rallies

Array = npt.NDArray[np.float64]

LATENCY = 0.025  # [s] of every rally's camera
PHASES = ("before_bounce", "after_bounce", "after_hit")


class Errors(NamedTuple):
    """One row an estimate; nan where a method has too few detections."""

    position: Array  # (n,) [m]
    velocity: Array  # (n,) [m/s]


@dataclass(frozen=True, slots=True)
class Comparison:
    """Errors of one run, one row a control step of a rally."""

    camera_filter: Errors
    differentiation: Errors
    quadratic: Errors
    state: npt.NDArray[np.int64]  # (n,) the true trajectory state 0..3
    estimated_state: npt.NDArray[np.int64]  # (n,)


@kernel
def _estimates_now(rallies: Rallies, out: Array) -> None:
    for b in range(out.shape[0]):
        pos, vel, state = estimate_at(
            rallies.camera_state[b, DETECTION_BUFFER:], rallies.clock[b] * GRID_STEP
        )
        for k in range(3):
            out[b, k], out[b, 3 + k] = pos[k], vel[k]
        out[b, 6] = state


def differentiated(times: Array, positions: Array, now: Array) -> Array:
    """Return the windows' difference quotients, extrapolated linearly (B, 6); nan for fewer than two detections.

    Args:
        times: Of each window's detections [s since launch] (B, W), newest last; nan for a missing one.
        positions: (B, W, 3) [m].
        now: Moment of the estimate (B,).
    """
    rows = np.arange(len(times))
    first = np.argmax(np.isfinite(times), axis=1)
    span = times[:, -1] - times[rows, first]
    with np.errstate(invalid="ignore", divide="ignore"):
        velocity = (positions[:, -1] - positions[rows, first]) / span[:, None]
    return np.hstack([positions[:, -1] + velocity * (now - times[:, -1])[:, None], velocity])


def quadratic_fit(times: Array, positions: Array, now: Array) -> Array:
    """Return the windows' least-squares quadratics at ``now`` (B, 6); nan for fewer than four detections."""
    out = np.full((len(times), 6), np.nan)
    for b in range(len(times)):
        good = np.isfinite(times[b])
        if good.sum() < 4:
            continue
        t = times[b, good] - now[b]
        power = np.stack([np.ones_like(t), t, t * t], axis=1)
        fit = np.linalg.lstsq(power, positions[b, good], rcond=None)[0]
        out[b, :3], out[b, 3:] = fit[0], fit[1]
    return out


def windows(rallies: Rallies, length: int) -> tuple[Array, Array, npt.NDArray[np.bool_]]:
    """Return times (B, W) and positions (B, W, 3) of each ball's newest detections, and which the filter accepted."""
    read = rallies.camera_state[:, READ].astype(np.int64)
    buffer = rallies.camera_state[:, FIRST_DETECTION:DETECTION_BUFFER].reshape(
        len(read), DETECTIONS, DETECTION
    )
    index = read[:, None] - length + np.arange(length)
    detections = buffer[np.arange(len(read))[:, None], index % DETECTIONS]
    times = np.where(index >= 0, detections[:, :, 0], np.nan)
    return times, detections[:, :, 1:4], detections[:, :, 4] > 0.0


def errors(found: Array, truth: Array) -> Errors:
    """Return the errors of estimates (n, 6) against the truth (n, 6)."""
    off = found - truth
    return Errors(np.linalg.norm(off[:, :3], axis=1), np.linalg.norm(off[:, 3:6], axis=1))


def compare(config: "CameraFilterConfig", policy: Policy) -> Comparison:
    """Play the rallies, and compare at every control step."""
    envs, rallies = config.envs, config.rallies
    task = TaskConfig.model_validate(
        {
            "perception": "full",
            "randomization": config.randomization,
            "observation": policy.contract.task.observation,
            "control_rate_hz": policy.contract.task.control_rate_hz,
        }
    )
    drawn = TaskConfig.model_validate({"randomization": config.randomization})
    source = MemoryRallies(draw_rallies(rallies, drawn, seed=config.seed))
    env = RallyEnv(envs, task, source, stage=3, experience=MATCH)
    # one latency for all rallies, instead of the profile's range
    env._profile = env._profile._replace(observation_latency=(LATENCY, LATENCY))
    obs, played = env.reset(), 0
    rows: list[tuple[Array, ...]] = []
    found = np.empty((envs, 7))
    while played < rallies:
        step = env.step(policy.act(obs))
        obs, played = step.obs, played + len(step.finished.rows)
        now: Array = env.rallies.clock * np.float64(GRID_STEP)
        _estimates_now(env.rallies, found)
        times, positions, accepted = windows(env.rallies, config.window)
        plain = differentiated(times, positions, now)
        since_touch = accepted & (times > env.rallies.camera_state[:, DETECTION_BUFFER + TOUCH, None])
        fitted = quadratic_fit(np.where(since_touch, times, np.nan), positions, now)
        keep = env.validated & (env.rallies.clock > 0)
        state_now: Array = (env.rallies.state[:, None] // 2).astype(np.float64)
        every = (found, plain, fitted, env.rallies.ball[:, :6], state_now)
        rows.append(tuple(part[keep].copy() for part in every))
    estimated, plain, fitted, truth, state = (np.concatenate(part) for part in zip(*rows, strict=True))
    return Comparison(
        errors(estimated[:, :6], truth),
        errors(plain, truth),
        errors(fitted, truth),
        state[:, 0].astype(np.int64),
        estimated[:, 6].astype(np.int64),
    )


def summary(compared: Comparison) -> dict[str, float | int]:
    """Return the figures of a comparison by name."""
    ours, plain, fitted = compared.camera_filter, compared.differentiation, compared.quadratic
    both = np.isfinite(plain.position)
    by_position = float(np.median(plain.position[both]) / np.median(ours.position[both]))
    by_velocity = float(np.median(plain.velocity[both]) / np.median(ours.velocity[both]))
    figures: dict[str, float | int] = {
        "estimates": len(compared.state),
        "position_error_mm_median": round(1e3 * float(np.median(ours.position)), 3),
        "position_error_mm_p90": round(1e3 * float(np.quantile(ours.position, 0.9)), 3),
        "velocity_error_median": round(float(np.median(ours.velocity)), 4),
        "velocity_error_p90": round(float(np.quantile(ours.velocity, 0.9)), 4),
        "ratio_to_differentiation": round(min(by_position, by_velocity), 3),
        "ratio_to_differentiation_position": round(by_position, 3),
        "ratio_to_differentiation_velocity": round(by_velocity, 3),
        "differentiation_position_error_mm_median": round(1e3 * float(np.median(plain.position[both])), 3),
        "differentiation_velocity_error_median": round(float(np.median(plain.velocity[both])), 4),
        "quadratic_position_error_mm_median": round(1e3 * float(np.nanmedian(fitted.position)), 3),
        "quadratic_velocity_error_median": round(float(np.nanmedian(fitted.velocity)), 4),
        "state_accuracy": round(float(np.mean(compared.state == compared.estimated_state)), 4),
    }
    for phase, name in enumerate(PHASES):
        rows = compared.state == phase if phase < 2 else compared.state >= 2
        figures[f"estimates_{name}"] = int(rows.sum())
        if rows.any():
            figures[f"position_error_mm_median_{name}"] = round(
                1e3 * float(np.median(ours.position[rows])), 3
            )
            figures[f"velocity_error_median_{name}"] = round(float(np.median(ours.velocity[rows])), 4)
    return figures


def throughput_share(envs: int, randomization: Randomization, seconds: float, seed: int) -> float:
    """Return the environment's speed with camera and filter / its speed without them: the median of paired slices."""
    plain = TaskConfig.model_validate({"randomization": randomization})
    block = draw_rallies(RALLIES, plain, seed=seed)
    cheap, full = (
        RallyEnv(envs, plain.model_copy(update={"perception": perception}), MemoryRallies(block), threads=1)
        for perception in ("cheap", "full")
    )
    rng = np.random.default_rng(seed)
    spread = SPREAD * rng.standard_normal((ACTIONS, envs, 7))
    actions = np.clip(cheap.home_action + spread, -1.0, 1.0).astype(np.float32)
    for env in (cheap, full):
        env.reset()
        play(env.step, actions)  # compiles, and spreads the rallies over their phases
    return paired(slices(full.step, actions), slices(cheap.step, actions), seconds).share


class CameraFilterConfig(BenchmarkConfig):
    """Measure the errors of the camera filter on a simulated camera, and its cost."""

    rallies: int = Field(2000, ge=1, description="rallies to play")
    envs: int = Field(512, ge=1, le=65536, description="robots in the batch")
    window: int = Field(12, ge=4, le=15, description="detections of the baselines")
    randomization: Randomization = Field("standard", description="profile of what differs between rallies")
    seconds: float = Field(
        10.0, gt=0, description="duration of the speed measurement", json_schema_extra={"unit": "s"}
    )
    seed: int = Field(0, ge=0, lt=2**63, description="of rallies and actions")
    policy: str = Field(
        "default", description="a policy of the box, or a policy folder; it plays the rallies"
    )


def main(config: CameraFilterConfig, _stop: Event) -> int:
    """Measure and print."""
    started = time.monotonic()
    compared = compare(config, load_policy(policy_folder(config.policy)))
    share = throughput_share(config.envs, config.randomization, config.seconds, config.seed)
    figures = summary(compared) | {
        "throughput_share": round(share, 4),
        "window": config.window,
        "rallies": config.rallies,
        "envs": config.envs,
        "randomization": config.randomization,
        "launch": "paper",
        "latency_ms": 1e3 * LATENCY,
        "seconds": round(time.monotonic() - started, 2),
    }
    if config.json_line:
        print(json.dumps(figures))
    else:
        print("\n".join(f"{name:>45}  {value}" for name, value in figures.items()))
    return 0


if __name__ == "__main__":
    sys.exit(run("camera_filter", CameraFilterConfig, main))
