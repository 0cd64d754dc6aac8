"""Scripted balls and a robot that moves as given, for the tests of rules, reward and randomization.

Without drag and lift a ball flies on a parabola, so the time and place of a touch can be computed by hand.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from common.physics.flight import SIMPLE
from common.rally.state import Rallies, RobotMotion, Rules, Step, allocate
from common.rally.step import launch_rallies, play_step
from common.robot.chain_of import chain_of
from common.task.config import PAPER_REWARD, RewardConfig
from common.task.launch_presets import Kind
from common.task.randomization import PROFILES, RallyParameter, RandomizationProfile
from common.task.reward import reward_table
from common.task.states import Outcome, State, transition_table

Array = npt.NDArray[np.float64]

CONTROL_PERIOD = 0.020  # [s]
SUBSTEPS = 5
HOME = (0.0, 0.0, 0.0, 1.0, 1.0, 1.1, 0.0)
"""The racket's face is vertical at x = -1.077, y = 0, z = 0.226 and points to the opponent."""
AWAY = (-0.75, -0.9, 0.0, -1.5, 0.0, 0.0, 0.0)
"""The arm leans back from the far corner of its rails: nothing but the beam (z < 0.15) is near the table."""
TORQUE_LIMIT = np.array([400.0, 300.0, 24.0, 24.0, 12.0, 6.0, 3.0])


@dataclass(frozen=True, slots=True)
class Played:
    """Result of a scripted rally. Rows are control steps."""

    outcome: Outcome
    states: list[State]  # at the end of each step
    balls: Array  # (n, 9)
    measurement: Array  # (n, 8) the robot's measurement of the ball, and its time stamp
    terms: Array  # (n, 8) reward.TERMS
    rewards: Array  # (n,)
    impulses: Array  # (n, 6)
    caught: bool
    over: bool
    landing_error: float


def make_rules(
    stage: int = 1, rate_scale: float = 1.0, time_limit: float = 2.5, reward: RewardConfig = PAPER_REWARD
) -> Rules:
    return Rules(
        transitions=transition_table(),
        rewards=np.ascontiguousarray(reward_table()[stage - 1]),
        landing_scale=reward.landing_scale,
        landing_bonus=reward.landing_bonus if stage == 3 else 0.0,
        landing_bonus_scale=reward.landing_bonus_scale,
        rate_scale=rate_scale,
        torque_weight=reward.torque,
        torque_limit=TORQUE_LIMIT,
        jitter_weight=reward.jitter,
        collision_weight=reward.collision,
        grid_steps=4,
        time_limit=time_limit,
        flight_model=SIMPLE,
        chain=chain_of("rails"),
    )


def make_motion(before: Sequence[float], after: Sequence[float]) -> RobotMotion:
    """Return one control step of a robot that moves uniformly between two poses, without force or contact."""
    share = np.arange(1, SUBSTEPS + 1)[:, None] / SUBSTEPS
    start = np.array(before)
    return RobotMotion(
        start_pos=start[None],
        joint_pos=(start + share * (np.array(after) - start))[None],
        torque=np.zeros((1, SUBSTEPS, 7)),
        contact=np.zeros((1, SUBSTEPS, 8))[
            ..., :4
        ],  # of MuJoCo's records too: kernels are compiled for it once
        step=CONTROL_PERIOD / SUBSTEPS,
    )


def make_launch(
    pos: Sequence[float],
    vel: Sequence[float],
    spin: Sequence[float] = (0.0, 0.0, 0.0),
    drag: float = 0.0,
    lift: float = 0.0,
    kind: int = Kind.PAPER,
) -> Array:
    return np.array([*pos, *vel, *spin, drag, lift, kind])


def begin(
    launch: Array,
    state: State = State.TAU_01,
    target: tuple[float, float] | None = None,
    seed: int = 1,
    profile: RandomizationProfile = PROFILES["off"],
) -> tuple[Rallies, Step]:
    """Return one rally in play, in ``state``."""
    rallies, step = allocate(1)
    launch_rallies(rallies, np.array([0]), launch[None], np.array([seed], np.uint64), profile)
    rallies.state[0] = state
    if target is not None:
        rallies.parameters[0, [RallyParameter.TARGET_X, RallyParameter.TARGET_Y]] = target
    return rallies, step


def play_ball(
    pos: Sequence[float],
    vel: Sequence[float],
    spin: Sequence[float] = (0.0, 0.0, 0.0),
    *,
    state: State = State.TAU_01,
    joints: Sequence[float] = AWAY,
    rates: Sequence[float] = (0.0,) * 7,
    drag: float = 0.0,
    lift: float = 0.0,
    target: tuple[float, float] | None = None,
    rules: Rules | None = None,
    seed: int = 1,
    profile: RandomizationProfile = PROFILES["off"],
    steps: int = 150,
    ends_at_hit: bool = False,
) -> Played:
    """Play a ball until its rally ends, for at most ``steps`` control steps.

    Args:
        pos: Ball's position [m].
        vel: Ball's velocity [m/s].
        spin: Ball's spin [rad/s].
        state: The rally's state at the beginning.
        joints: Joint positions at the beginning.
        rates: Joint velocities, constant.
        drag: Drag factor [-].
        lift: Lift factor [-].
        target: Target [m]; None: the target of the seed.
        rules: ``make_rules()`` by default.
        seed: Seed of the rally.
        profile: Randomization.
        steps: Most control steps.
        ends_at_hit: Whether the flight after the hit is simulated to its landing at once.
    """
    rules = rules or make_rules()
    rallies, step = begin(make_launch(pos, vel, spin, drag, lift), state, target, seed, profile)
    rallies.ends_at_hit[0] = ends_at_hit
    states, balls, measured, terms, rewards, impulses = [], [], [], [], [], []
    for k in range(steps):
        before, after = (np.array(joints) + t * CONTROL_PERIOD * np.array(rates) for t in (k, k + 1))
        play_step(rallies, make_motion(before, after), np.zeros((1, 7)), rules, profile, step)
        states.append(State(int(rallies.state[0])))
        balls.append(rallies.ball[0].copy())
        measured.append(rallies.measurement[0].copy())
        terms.append(step.terms[0].copy())
        rewards.append(step.reward[0])
        impulses.append(step.impulse[0].copy())
        if step.outcome[0]:
            break
    return Played(
        outcome=Outcome(int(step.outcome[0])),
        states=states,
        balls=np.array(balls),
        measurement=np.array(measured),
        terms=np.array(terms),
        rewards=np.array(rewards),
        impulses=np.array(impulses),
        caught=bool(rallies.caught[0]),
        over=bool(rallies.over[0]),
        landing_error=float(rallies.landing_error[0]),
    )
