"""How well camera and estimator know the ball, now: its position, velocity and trajectory state, and at what cost.

    python -m benchmarks.estimator --json

A policy plays valid ``paper`` rallies, so that balls bounce and are hit; every control step the estimate for that very
moment, a camera's latency ahead of its newest shot, is compared with the truth. The plain baseline on the same shots
is numerical differentiation over a sliding window (the paper's), extrapolated linearly. Beside it stands a quadratic
fitted to the same window, which is told the touches and the gross errors that the estimator found.
The cost is the environment's speed with and without: short slices of both take turns.
"""

import argparse
import json
import time
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from benchmarks.env import ACTIONS, RALLIES, SLICE, SPREAD, MemoryRallies, seconds_of
from common.env.rally_env import EnvConfig, RallyEnv
from common.jit import kernel
from common.physics.constants import GRID_STEP
from common.policy.weights import load_policy
from common.rally.camera import FILM, FIRST_SHOT, READ, SHOT, SHOTS
from common.rally.estimator import TOUCH, estimate_at
from common.rally.launch import draw_rallies
from common.rally.noise import PROFILES
from common.rally.play import Rallies

Array = npt.NDArray[np.float64]

LATENCY = 0.025  # [s] of every rally's camera
POLICY = Path(__file__).parents[1] / "assets" / "policies" / "default"
PHASES = ("before_bounce", "after_bounce", "after_hit")


class Errors(NamedTuple):
    """One row an estimate; nan where a method has too few shots."""

    position: Array  # (n,) [m]
    velocity: Array  # (n,) [m/s]


@dataclass(frozen=True, slots=True)
class Watched:
    """What one run compared, one row a control step of a rally."""

    estimator: Errors
    differentiation: Errors
    quadratic: Errors
    state: npt.NDArray[np.int64]  # (n,) the true trajectory state 0..3
    estimated_state: npt.NDArray[np.int64]  # (n,)


@kernel
def _estimates_now(rallies: Rallies, out: Array) -> None:
    for b in range(out.shape[0]):
        pos, vel, state = estimate_at(rallies.eyes[b, FILM:], rallies.clock[b] * GRID_STEP)
        for k in range(3):
            out[b, k], out[b, 3 + k] = pos[k], vel[k]
        out[b, 6] = state


def differentiated(times: Array, positions: Array, now: Array) -> Array:
    """Return the mean of the windows' difference quotients, extrapolated linearly (B, 6); nan for fewer than two shots.

    Args:
        times: Of each window's shots [s since launch] (B, W), newest last; nan where there is none.
        positions: (B, W, 3) [m].
        now: The moment asked for (B,).
    """
    rows = np.arange(len(times))
    first = np.argmax(np.isfinite(times), axis=1)
    span = times[:, -1] - times[rows, first]
    with np.errstate(invalid="ignore", divide="ignore"):
        velocity = (positions[:, -1] - positions[rows, first]) / span[:, None]
    return np.hstack([positions[:, -1] + velocity * (now - times[:, -1])[:, None], velocity])


def quadratic_fit(times: Array, positions: Array, now: Array) -> Array:
    """Return the windows' least-squares quadratics at ``now`` (B, 6); nan for fewer than four shots."""
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
    """Return each ball's newest shots that have arrived (B, W), (B, W, 3), and which of them the estimator believed."""
    read = rallies.eyes[:, READ].astype(np.int64)
    film = rallies.eyes[:, FIRST_SHOT:FILM].reshape(len(read), SHOTS, SHOT)
    index = read[:, None] - length + np.arange(length)
    shots = film[np.arange(len(read))[:, None], index % SHOTS]
    times = np.where(index >= 0, shots[:, :, 0], np.nan)
    return times, shots[:, :, 1:4], shots[:, :, 4] > 0.0


def errors(found: Array, truth: Array) -> Errors:
    """Return how far estimates (n, 6) are from the truth (n, 6)."""
    off = found - truth
    return Errors(np.linalg.norm(off[:, :3], axis=1), np.linalg.norm(off[:, 3:6], axis=1))


def watch(envs: int, rallies: int, window: int, seed: int, noise: str, policy_folder: Path) -> Watched:
    """Play ``rallies`` rallies and compare at every control step."""
    policy = load_policy(policy_folder)
    config = EnvConfig.model_validate(
        {
            "perception": "full",
            "noise": noise,
            "foresee": 0.0,
            "go_on": 0.0,
            "observation": policy.contract.observation_options,
            "control_rate_hz": policy.contract.control_rate_hz,
        }
    )
    env = RallyEnv(envs, config, MemoryRallies(draw_rallies(rallies, seed=seed, noise=noise)), stage=3)
    env.noise = env.noise._replace(observation_latency=(LATENCY, LATENCY))
    obs, played = env.reset(), 0
    rows: list[tuple[Array, ...]] = []
    found = np.empty((envs, 7))
    while played < rallies:
        step = env.step(policy.act(obs))
        obs, played = step.obs, played + len(step.finished.rows)
        now: Array = env.rallies.clock * np.float64(GRID_STEP)
        _estimates_now(env.rallies, found)
        times, positions, believed = windows(env.rallies, window)
        plain = differentiated(times, positions, now)
        since_touch = believed & (times > env.rallies.eyes[:, FILM + TOUCH, None])
        fitted = quadratic_fit(np.where(since_touch, times, np.nan), positions, now)
        keep = env.validated & (env.rallies.clock > 0)
        state_now: Array = (env.rallies.state[:, None] // 2).astype(np.float64)
        every = (found, plain, fitted, env.rallies.ball[:, :6], state_now)
        rows.append(tuple(part[keep].copy() for part in every))
    estimated, plain, fitted, truth, state = (np.concatenate(part) for part in zip(*rows, strict=True))
    return Watched(
        errors(estimated[:, :6], truth),
        errors(plain, truth),
        errors(fitted, truth),
        state[:, 0].astype(np.int64),
        estimated[:, 6].astype(np.int64),
    )


def summary(watched: Watched) -> dict[str, float | int]:
    """Return the figures of a comparison, by name."""
    ours, plain, fitted = watched.estimator, watched.differentiation, watched.quadratic
    both = np.isfinite(plain.position)
    by_position = float(np.median(plain.position[both]) / np.median(ours.position[both]))
    by_velocity = float(np.median(plain.velocity[both]) / np.median(ours.velocity[both]))
    figures: dict[str, float | int] = {
        "estimates": len(watched.state),
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
        "state_accuracy": round(float(np.mean(watched.state == watched.estimated_state)), 4),
    }
    for phase, name in enumerate(PHASES):
        rows = watched.state == phase if phase < 2 else watched.state >= 2
        figures[f"estimates_{name}"] = int(rows.sum())
        if rows.any():
            figures[f"position_error_mm_median_{name}"] = round(
                1e3 * float(np.median(ours.position[rows])), 3
            )
            figures[f"velocity_error_median_{name}"] = round(float(np.median(ours.velocity[rows])), 4)
    return figures


def throughput_share(envs: int, noise: str, seconds: float, seed: int) -> float:
    """Return the environment's speed with perception full by that with cheap: the median of paired slices."""
    block = draw_rallies(RALLIES, seed=seed, noise=noise)
    cheap, full = (
        RallyEnv(
            envs,
            EnvConfig.model_validate({"noise": noise, "perception": perception}),
            MemoryRallies(block),
            threads=1,
        )
        for perception in ("cheap", "full")
    )
    rng = np.random.default_rng(seed)
    spread = SPREAD * rng.standard_normal((ACTIONS, envs, 7))
    actions = np.clip(cheap.home_action + spread, -1.0, 1.0).astype(np.float32)
    for env in (cheap, full):
        env.reset()
        seconds_of(env.step, actions)  # compiles, and spreads the rallies over their phases
    shares: list[float] = []
    start = time.perf_counter()
    while time.perf_counter() - start < seconds:
        part = actions[(np.arange(SLICE) + SLICE * len(shares)) % ACTIONS]
        order = (cheap, full) if len(shares) % 2 == 0 else (full, cheap)
        taken = {env: seconds_of(env.step, part) for env in order}
        shares.append(taken[cheap] / taken[full])
    return float(np.median(shares))


def parse(arguments: list[str] | None = None) -> argparse.Namespace:
    """Return the command line's options."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.estimator",
        description="Measure the estimator on a simulated camera against the truth, and what it costs.",
        formatter_class=argparse.ArgumentDefaultsHelpFormatter,
    )
    parser.add_argument("--rallies", type=int, default=2000, metavar="N", help="rallies to watch, 1 or more")
    parser.add_argument("--envs", type=int, default=512, metavar="B", help="robots in the batch, 1 or more")
    parser.add_argument("--window", type=int, default=12, metavar="W", help="shots of the baselines, 4 to 15")
    parser.add_argument("--noise", choices=PROFILES, default="standard", help="what differs between rallies")
    parser.add_argument("--seconds", type=float, default=10.0, metavar="S", help="how long to time, > 0")
    parser.add_argument("--seed", type=int, default=0, metavar="N", help="of rallies and actions, 0 or more")
    parser.add_argument("--policy", type=Path, default=POLICY, metavar="FOLDER", help="who plays the rallies")
    parser.add_argument("--json", action="store_true", help="print one JSON object as the last line")
    options = parser.parse_args(arguments)
    for name, low, high in (("rallies", 1, None), ("envs", 1, None), ("window", 4, 15), ("seed", 0, None)):
        value = getattr(options, name)
        if value < low or (high is not None and value > high):
            parser.error(f"--{name}: got {value}; allowed: {low} {f'to {high}' if high else 'or more'}")
    if not options.seconds > 0.0:
        parser.error(f"--seconds: got {options.seconds}; allowed: more than 0")
    return options


def main() -> None:
    """Measure and print."""
    options = parse()
    started = time.monotonic()
    watched = watch(
        options.envs, options.rallies, options.window, options.seed, options.noise, options.policy
    )
    share = throughput_share(options.envs, options.noise, options.seconds, options.seed)
    figures = summary(watched) | {
        "throughput_share": round(share, 4),
        "window": options.window,
        "rallies": options.rallies,
        "envs": options.envs,
        "noise": options.noise,
        "launch": "paper",
        "latency_ms": 1e3 * LATENCY,
        "seconds": round(time.monotonic() - started, 2),
    }
    if options.json:
        print(json.dumps(figures))
    else:
        print("\n".join(f"{name:>45}  {value}" for name, value in figures.items()))


if __name__ == "__main__":
    main()
