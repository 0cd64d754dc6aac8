"""The vectorised rally environment: one call plays B robots and B balls for one control step."""

from dataclasses import dataclass
from typing import Literal, Protocol

import numpy as np
import numpy.typing as npt
from pydantic import BaseModel, ConfigDict, Field

from common.env.collision import Collision, TailoredCollision
from common.env.original_collision import OriginalCollision, RobotAndBall
from common.env.review import NO_LESSONS, Lessons, Review
from common.env.robot import RobotBatch, RobotPreset
from common.jit import kernel
from common.physics.constants import GRID_STEP
from common.physics.flight import FULL, SIMPLE
from common.rally import play
from common.rally.draws import Stream, between, uniform
from common.rally.noise import PROFILES, Condition, NoiseProfile
from common.rally.observation import ACTION_SIZE, ObservationConfig, critic_layout, policy_layout, size
from common.rally.prediction import new_tracks
from common.rally.reward import RewardConfig, reward_table
from common.rally.trajectory import Outcome, transition_table

Array = npt.NDArray[np.float64]
Floats = npt.NDArray[np.float32]
Flags = npt.NDArray[np.bool_]
Rows = npt.NDArray[np.int64]

_GAINS, _RESET = int(Stream.GAINS), int(Stream.RESET)


class TeacherConfig(BaseModel):
    """A policy that a new one learns from first, for as long as it says what it would have done itself.

    It may see more than its pupil: DAgger (Ross, Gordon, Bagnell 2011), with a teacher who looks at other numbers.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    policy: str = Field(
        "", description="policy folder, the same path for learner and actors; empty: no teacher"
    )
    epochs: int = Field(
        600,
        ge=1,
        description="first epochs of a run, in which the policy learns what the teacher would have done in its place; "
        "then from rewards, as without one",
        json_schema_extra={"unit": "datasets"},
    )
    towards_middle: float = Field(
        0.0,
        ge=0,
        lt=1,
        description="share of the way to the court's middle by which the targets shown to the teacher are moved: a "
        "pupil that sees less misses by more, and should aim farther inside",
    )
    notes: bool = Field(
        False,
        description="have a pupil without memory take notes: until the stroke, wrist and roll hold where the ball was "
        "and how it flew as it was first seen, by which it shows how it spins (teacher.py)",
    )
    through_arm: bool = Field(
        False,
        description="learn as well what to do now for the arm to tell later: a memory for a policy that has no other "
        "(gradients through kinematics and drives)",
    )
    log_sigma: float = Field(
        1.0,
        ge=-10,
        le=1,
        description="log of the action noise is at most this while it teaches: noise wipes out what an arm remembers",
    )

    def teaches(self, version: int) -> bool:
        """Return whether the policy of this version, one an epoch, is still being taught."""
        return bool(self.policy) and version < self.epochs


class EnvConfig(BaseModel):
    """The task: robot, rates, noise and reward."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    robot: RobotPreset = Field("rails", description="robot: ours, or the same slowed to the authors' limits")
    control_rate_hz: Literal[25, 50, 100, 200] = Field(
        50, description="control steps a second", json_schema_extra={"unit": "Hz"}
    )
    noise: Literal["off", "standard", "hard"] = Field(
        "standard", description="what differs from rally to rally"
    )
    perception: Literal["cheap", "full"] = Field(
        "cheap",
        description="what is seen of the ball: its true state, late and noisy, or an estimate from a simulated camera",
    )
    flight: Literal["simple", "full"] = Field("simple", description="aerodynamics of the ball")
    collision: Literal["tailored", "original"] = Field(
        "tailored",
        description="whose bounces: ours, exact and measured, or MuJoCo's own, half as fast",
    )
    time_limit_s: float = Field(
        2.5, gt=0.1, le=60, description="longest rally; cut, not lost", json_schema_extra={"unit": "s"}
    )
    carry_over: float = Field(
        0.5, ge=0, le=1, description="share of episodes that begin as the last stroke left the robot"
    )
    go_on: float = Field(
        0.1, ge=0, le=1, description="share of episodes that go on over a return into a next rally"
    )
    foresee: float = Field(
        0.8,
        ge=0,
        le=1,
        description="share of episodes that end once the ball is hit: its flight home is computed and paid at once",
    )
    hindsight: bool = Field(
        True, description="in stage 3, tell the learner what the last actions before a hit should have been"
    )
    teacher: TeacherConfig = TeacherConfig()
    rounds: int = Field(1, ge=1, le=1000, description="rallies an episode plays while they are returned")
    reset_spread: float = Field(
        0.1,
        ge=0,
        le=0.5,
        description="joints start at home plus up to this",
        json_schema_extra={"unit": "m, rad"},
    )
    reward: RewardConfig = RewardConfig()
    observation: ObservationConfig = ObservationConfig()


class RallySource(Protocol):
    """Where the environment gets its rallies."""

    def take(self, count: int) -> "Launches":
        """Return ``count`` launches; never blocks."""


@dataclass(frozen=True, slots=True)
class Launches:
    """Rallies to play, as generated."""

    records: Array  # (n, 11) position, velocity, spin, drag factor, lift factor
    seeds: npt.NDArray[np.uint64]  # (n,)
    validated: Flags  # (n,) False: a random launch that no generator flew; left out of all rates
    paths: Array | None = None  # (n, path_rows, 7) as play.keep_to_path, where the environment drives balls


@dataclass(frozen=True, slots=True)
class FinishedRallies:
    """Rallies that ended in this step, one row each."""

    rows: Rows  # (n,) which environment
    seeds: npt.NDArray[np.uint64]  # (n,)
    outcomes: npt.NDArray[np.uint8]  # (n,) trajectory.Outcome
    landings: Floats  # (n, 2) [m] where on the opponent's court; nan where nothing landed
    landing_errors: Floats  # (n,) [m] their distance to the target
    caught: Flags  # (n,)
    over: Flags  # (n,)
    validated: Flags  # (n,)
    returns: Floats  # (n,) undiscounted reward of the rally
    lengths: npt.NDArray[np.int32]  # (n,) control steps
    conditions: Array  # (n, 14) noise.Condition
    rounds: npt.NDArray[np.int32]  # (n,) which rally of its episode: 1 for the first


@dataclass(frozen=True, slots=True)
class EnvStep:
    """What one control step brought. Environments that ended are reset already."""

    obs: Floats  # (B, D) observation.critic_layout of the next step: after a reset the new episode's first
    reward: Floats  # (B,)
    terminated: Flags  # (B,) the rally ended by its rules: the value of what follows is 0
    truncated: Flags  # (B,) the time limit cut it: bootstrap from final_obs
    ended: Rows  # (n,) rows with terminated or truncated
    final_obs: Floats  # (n, D) the last observation of each of ``ended``
    terms: Array  # (B, 8) reward.TERMS
    finished: FinishedRallies
    lessons: Lessons  # what hits of this step say about the last actions


@kernel
def _draw_robot(
    seeds: npt.NDArray[np.uint64],
    noise: NoiseProfile,
    carry_over: float,
    spread: float,
    gains: Array,
    offset: Array,
) -> tuple[Flags, Array, Array]:
    """Draw drives (n, 3, 7) and start poses (n, 7) from the rallies' seeds.

    Returns:
        Which robots stay as they are (n,); numbers in [0, 1) that decide on going on over a return (n,) and on
        ending with the hit (n,).
    """
    count = seeds.shape[0]
    stay, go_on, ends = np.empty(count, np.bool_), np.empty(count), np.empty(count)
    low, high = noise.gain_factor
    for k in range(seeds.shape[0]):
        stay[k] = uniform(seeds[k], _RESET, 0) < carry_over
        go_on[k] = uniform(seeds[k], _RESET, 1)
        ends[k] = uniform(seeds[k], _RESET, 2 + offset.shape[1])
        for j in range(7):
            offset[k, j] = between(-spread, spread, seeds[k], _RESET, 2 + j)
            for g in range(3):
                gains[k, g, j] = between(low, high, seeds[k], _GAINS, 7 * g + j)
    return stay, go_on, ends


class RallyEnv:
    """B robots, each catching rallies from a source.

    Args:
        count: B.
        config: The task.
        source: Where rallies come from.
        stage: Curriculum stage 1..3, the reward's column.
        threads: MuJoCo threads.
        path_rows: Samples of a path that balls keep to until they are hit; 0: they fly as physics has it.
        onlooker: What somebody besides is told of the same rallies (``look_on``), of no more history than the policy.
    """

    def __init__(
        self,
        count: int,
        config: EnvConfig,
        source: RallySource,
        stage: int = 1,
        threads: int = 1,
        path_rows: int = 0,
        onlooker: ObservationConfig | None = None,
    ) -> None:
        if path_rows and config.collision == "original":
            raise ValueError("a path under collision 'original': allowed is 'tailored', or no path")
        self.count = count
        self.config = config
        self._flight_model = SIMPLE if config.flight == "simple" else FULL
        self._collision = self._make_collision(threads)
        self.robot = self._collision.robot
        self.noise = PROFILES[config.noise]
        self.home_action: Floats = self.robot.home_action.astype(np.float32)
        self._source = source
        self._review = self._make_review()
        self._told = play.told_by(config.observation)
        self._onlooker = onlooker
        self._rallies, self._step = play.allocate(
            count,
            config.observation.history,
            full=config.perception == "full",
            tracks=self._new_tracks(),
            reviewed=self._review is not None,
            path_rows=path_rows,
        )
        self._validated = np.zeros(count, np.bool_)
        self._returns = np.zeros(count)
        self._lengths = np.zeros(count, np.int32)
        self._rounds = np.zeros(count, np.int32)
        self._all = np.arange(count)
        self._obs = np.zeros((count, size(critic_layout(config.observation))), np.float32)
        self._rewards = reward_table(config.reward)
        self._started = False
        self.set_stage(stage)

    def set_stage(self, stage: int) -> None:
        """Pay by another column of R from the next step on."""
        if stage not in (1, 2, 3):
            raise ValueError(f"stage {stage!r}: allowed are 1, 2, 3")
        config = self.config
        self.stage = stage
        self._rules = play.Rules(
            transitions=transition_table(),
            rewards=np.ascontiguousarray(self._rewards[stage - 1]),
            landing_scale=config.reward.landing_scale,
            heading=config.reward.heading if stage == 3 else 0.0,
            heading_scale=config.reward.heading_scale,
            rate_scale=config.reward.reference_rate_hz / config.control_rate_hz,
            torque_weight=config.reward.torque,
            torque_limit=self.robot.torque_limit,
            jitter_weight=config.reward.jitter,
            collision_weight=config.reward.collision,
            grid_steps=round(1.0 / (config.control_rate_hz * GRID_STEP)),
            time_limit=config.time_limit_s,
            flight_model=self._flight_model,
        )

    @property
    def validated(self) -> Flags:
        """Which environments play a rally that a generator validated (B,)."""
        return self._validated.copy()

    @property
    def rallies(self) -> play.Rallies:
        """The rallies in play, for rendering and tests: read, don't write."""
        return self._rallies

    def reset(self) -> Floats:
        """Start every environment anew, robots at home, against strangers; return the first observations (B, D)."""
        self._started = False
        self._rallies.track[:] = self._new_tracks()  # nothing is known of the other side
        self.robot.go_home(self._all, np.zeros((self.count, ACTION_SIZE)))
        self._rallies.last_action[:] = self.robot.home_action
        self._begin(self._all, np.zeros(self.count, np.bool_))
        self._started = True
        self._observe(self._all)
        return self._obs.copy()

    def step(self, actions: npt.ArrayLike) -> EnvStep:
        """Play one control step with ``actions`` (B, 7); values beyond [-1, 1] are clipped."""
        if not self._started:
            raise RuntimeError("step() before reset(): call reset() first")
        clipped: Array = np.clip(np.asarray(actions, np.float64), -1.0, 1.0)
        if clipped.shape != (self.count, ACTION_SIZE):
            raise ValueError(f"actions of shape {clipped.shape}: allowed is {(self.count, ACTION_SIZE)}")
        if not np.isfinite(clipped).all():
            raise ValueError(
                f"actions of rows {np.flatnonzero(~np.isfinite(clipped).all(axis=1))} aren't finite"
            )
        self._collision.step(self._rallies, clipped, self._rules, self.noise, self._step)
        # The rally goes on with the robot at home, but says nothing about the policy.
        self._validated[self.robot.faulty] = False
        self._returns += self._step.reward
        self._lengths += 1
        self._observe(self._all)

        outcome = self._step.outcome
        over = np.flatnonzero(outcome)
        goes_on = (outcome[over] == Outcome.RETURNED) & (self._rallies.rounds_left[over] > 1)
        ended = over[~goes_on]
        truncated = outcome == Outcome.TIME_OUT
        terminated = np.zeros(self.count, np.bool_)
        terminated[ended] = True
        terminated &= ~truncated
        final_obs = self._obs[ended]
        lessons = NO_LESSONS
        if self._review is not None:
            lessons = self._review.look(self._rallies, self._collision.motion, self.stage == 3)
        finished = self._finish(over)
        if over.size:
            self._begin(over, goes_on)
            self._observe(over)
        return EnvStep(
            obs=self._obs.copy(),
            reward=self._step.reward.astype(np.float32),
            terminated=terminated,
            truncated=truncated,
            ended=ended,
            final_obs=final_obs,
            terms=self._step.terms.copy(),
            finished=finished,
            lessons=lessons,
        )

    def look_on(self) -> Floats:
        """Return what the onlooker sees now (B, D): ``observation.policy_layout`` of its options."""
        if self._onlooker is None:
            raise RuntimeError("look_on() without an onlooker: give one to the constructor")
        seen = np.empty((self.count, size(policy_layout(self._onlooker))), np.float32)
        told = play.told_by(self._onlooker)._replace(is_privileged=False)
        play.observe(self._rallies, self._all, self.robot.joint_pos, self.robot.joint_vel, told, seen)
        return seen

    def _make_collision(self, threads: int) -> Collision:
        preset, rate = self.config.robot, self.config.control_rate_hz
        if self.config.collision == "original":
            return OriginalCollision(RobotAndBall(self.count, preset, rate, self._flight_model, threads))
        return TailoredCollision(RobotBatch(self.count, preset, rate, threads=threads))

    def _new_tracks(self) -> Array:
        """Return a row for each ball, or none where nobody asks what its samples tell."""
        options = self.config.observation
        is_tracked = options.is_tracked or (self._onlooker is not None and self._onlooker.is_tracked)
        return new_tracks(self.count if is_tracked else 0, options.spin_expected)

    def _make_review(self) -> Review | None:
        """Return who corrects hits, if anybody does."""
        return Review(self.robot, self._flight_model) if self.config.hindsight else None

    def _observe(self, rows: Rows) -> None:
        """Write the observations of ``rows``."""
        robot = self.robot
        play.observe(self._rallies, rows, robot.joint_pos, robot.joint_vel, self._told, self._obs)

    def _finish(self, rows: Rows) -> FinishedRallies:
        r = self._rallies
        return FinishedRallies(
            rows=rows,
            seeds=r.seed[rows],
            outcomes=self._step.outcome[rows].astype(np.uint8),
            landings=r.landing[rows].astype(np.float32),
            landing_errors=r.landing_error[rows].astype(np.float32),
            caught=r.caught[rows],
            over=r.over[rows],
            validated=self._validated[rows],
            returns=self._returns[rows].astype(np.float32),
            lengths=self._lengths[rows],
            conditions=r.condition[rows],
            rounds=self._rounds[rows],
        )

    def _begin(self, rows: Rows, same_episode: Flags) -> None:
        """Launch the next rallies on ``rows``; where ``same_episode`` the robot goes on as it stands."""
        launches = self._source.take(rows.size)
        path = self._rallies.camera[:, play.RING :]
        path[rows] = play.NO_SAMPLE if launches.paths is None else launches.paths
        play.launch_rallies(self._rallies, rows, launches.records, launches.seeds, self.noise)
        self._validated[rows] = launches.validated
        self._returns[rows] = 0.0
        self._lengths[rows] = 0
        self._rounds[rows] = np.where(same_episode, self._rounds[rows] + 1, 1)
        gains, offset = np.empty((rows.size, 3, ACTION_SIZE)), np.empty((rows.size, ACTION_SIZE))
        config = self.config
        stay, go_on, ends = _draw_robot(
            launches.seeds, self.noise, config.carry_over, config.reset_spread, gains, offset
        )
        self.robot.set_gains(rows, gains, self._rallies.condition[rows, Condition.ACTION_LATENCY])
        leaves = ~(stay & self._started) & ~same_episode
        home = rows[leaves]
        if home.size:
            self.robot.go_home(home, offset[leaves])
            self._rallies.last_action[home] = self.robot.home_action
        rounds = np.where(config.rounds > 1, config.rounds, 1 + (go_on < config.go_on))
        left = np.where(same_episode, self._rallies.rounds_left[rows] - 1, rounds)
        self._rallies.rounds_left[rows] = left
        self._rallies.foreseen[rows] = (left == 1) & (ends < config.foresee)
        self._collision.launch(self._rallies, rows)
