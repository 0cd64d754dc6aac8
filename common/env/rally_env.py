"""The vectorised rally environment: one call plays B robots and B balls for one control step."""

from dataclasses import dataclass
from typing import Protocol

import numpy as np
import numpy.typing as npt

from common.env.contacts import Contacts, TailoredContacts
from common.env.mujoco_ball import RobotAndBall
from common.env.mujoco_contacts import MujocoContacts
from common.env.robot import RobotBatch
from common.jit import kernel
from common.perception.flight_track import POSTERIOR_MILD, PRIOR_MILD, new_tracks
from common.rally.observe import observation_flags, observe
from common.rally.state import NO_SAMPLE, RING, Rallies, RobotMotion, Rules, allocate
from common.rally.step import launch_rallies
from common.task.config import TaskConfig
from common.task.counter_rng import Stream, between, uniform
from common.task.experience import ExperienceConfig
from common.task.observation import ACTION_SIZE, ObservationConfig, critic_layout, policy_layout, size
from common.task.randomization import RallyParameter, RandomizationProfile, profile_of
from common.task.reward import reward_table
from common.task.states import Outcome, transition_table

Array = npt.NDArray[np.float64]
Floats = npt.NDArray[np.float32]
Flags = npt.NDArray[np.bool_]
Rows = npt.NDArray[np.int64]

_GAINS, _RESET = int(Stream.GAINS), int(Stream.RESET)
_NO_ROWS = np.zeros(0, np.int64)


class RallySource(Protocol):
    """Where the environment gets its rallies."""

    def take(self, rows: Rows) -> "Launches":
        """Return a launch for each of the environments ``rows`` (n,). Never blocks."""


@dataclass(frozen=True, slots=True)
class Launches:
    """Rallies to play, as generated."""

    launches: Array  # (n, 12) position, velocity, spin, drag factor, lift factor, kind
    seeds: npt.NDArray[np.uint64]  # (n,)
    validated: Flags  # (n,) False: a launch that was not validated; all rates leave it out
    # (n, path_rows, 7) recorded tracks that drive the balls (``step.snap_to_recorded_track``); None: physics alone
    paths: Array | None = None
    # (n,) the first balls of unknown opponents: what was learnt of the one before is forgotten; None: no such ball
    strangers: Flags | None = None


@dataclass(frozen=True, slots=True)
class FinishedRallies:
    """Rallies that ended in this step, one row each."""

    rows: Rows  # (n,) which environment
    seeds: npt.NDArray[np.uint64]  # (n,)
    outcomes: npt.NDArray[np.uint8]  # (n,) states.Outcome
    landings: Floats  # (n, 2) [m] where on the opponent's court; nan where nothing landed
    landing_errors: Floats  # (n,) [m] their distance to the target
    caught: Flags  # (n,)
    over: Flags  # (n,)
    validated: Flags  # (n,)
    returns: Floats  # (n,) undiscounted reward of the rally
    lengths: npt.NDArray[np.int32]  # (n,) control steps
    parameters: Array  # (n, 16) randomization.RallyParameter
    rounds: npt.NDArray[np.int32]  # (n,) which rally of its episode: 1 for the first


@dataclass(frozen=True, slots=True)
class EnvStep:
    """The result of one control step. Environments that ended are already reset, unless they begin late."""

    obs: Floats  # (B, D) observation.critic_layout of the next step: after a reset the new episode's first
    reward: Floats  # (B,)
    terminated: Flags  # (B,) the rally ended by its rules: the value of what follows is 0
    truncated: Flags  # (B,) the time limit cut the rally: bootstrap from final_obs
    ended: Rows  # (n,) rows with terminated or truncated
    final_obs: Floats  # (n, D) the last observation of each of ``ended``
    terms: Array  # (B, 8) reward.TERMS
    finished: FinishedRallies


@kernel
def draw_robot(
    seeds: npt.NDArray[np.uint64],
    profile: RandomizationProfile,
    carry_over: float,
    spread: float,
    gains: Array,
    offset: Array,
) -> tuple[Flags, Array, Array]:
    """Draw drives (n, 3, 7) and start poses (n, 7) from the rallies' seeds.

    Returns:
        Which robots start where they are (n,), and two uniform numbers in [0, 1). They decide whether an episode
        continues after a return (n,) and whether it ends at the hit (n,).
    """
    count = seeds.shape[0]
    stays, continues, ends = np.empty(count, np.bool_), np.empty(count), np.empty(count)
    low, high = profile.gain_factor
    for k in range(seeds.shape[0]):
        stays[k] = uniform(seeds[k], _RESET, 0) < carry_over
        continues[k] = uniform(seeds[k], _RESET, 1)
        ends[k] = uniform(seeds[k], _RESET, 2 + offset.shape[1])
        for j in range(7):
            offset[k, j] = between(-spread, spread, seeds[k], _RESET, 2 + j)
            for g in range(3):
                gains[k, g, j] = between(low, high, seeds[k], _GAINS, 7 * g + j)
    return stays, continues, ends


class RallyEnv:
    """B robots, each playing rallies from a source.

    Args:
        count: B.
        task: The task.
        source: Where rallies come from.
        stage: Curriculum stage 1..3: the column of the reward table.
        experience: When episodes end or continue; ``experience.MATCH`` for a match.
        threads: MuJoCo threads.
        path_rows: Samples of a recorded track that drives a ball until it is hit. 0: physics alone moves the balls.
        extra_observation: Options of a second observation of the same rallies (``observe_extra``), such as a teacher's.
            Its history is not longer than the task's.
        keeps_hits: Whether ``rallies.hit`` is written.
        profile: Ranges of what differs from rally to rally; None: those that the task names.
        begins_late: Whether an environment that ended begins its next episode in place of its next control step. That
            step ignores its action and pays nothing; its robot holds its last target.
    """

    def __init__(  # noqa: PLR0913  # options by name
        self,
        count: int,
        task: TaskConfig,
        source: RallySource,
        stage: int = 1,
        *,
        experience: ExperienceConfig = ExperienceConfig(),
        threads: int = 1,
        path_rows: int = 0,
        extra_observation: ObservationConfig | None = None,
        keeps_hits: bool = False,
        profile: RandomizationProfile | None = None,
        begins_late: bool = False,
    ) -> None:
        if path_rows and task.collision == "original":
            raise ValueError("recorded tracks under collision 'original'; allowed: collision 'tailored'")
        self.count = count
        self.task = task
        self.experience = experience
        self._contacts = self._make_contacts(threads)
        self.robot = self._contacts.robot
        self._profile = profile or profile_of(task.randomization, task.rubber)
        self.home_action: Floats = self.robot.home_action.astype(np.float32)
        self._source = source
        self._flags = observation_flags(task.observation)
        self._extra_observation = extra_observation
        self._rallies, self._step = allocate(
            count,
            task.observation.history,
            has_camera=task.perception == "full",
            tracks=self._new_tracks(),
            keeps_hits=keeps_hits,
            path_rows=path_rows,
        )
        self._validated = np.zeros(count, np.bool_)
        self._returns = np.zeros(count)
        self._lengths = np.zeros(count, np.int32)
        self._rounds = np.zeros(count, np.int32)
        self._all = np.arange(count)
        self._begins_late = begins_late
        self._waiting = _NO_ROWS  # ended, and begin in the next step
        self._obs = np.zeros((count, size(critic_layout(task.observation))), np.float32)
        self._rewards = reward_table()
        self._started = False
        self.set_stage(stage)

    def set_stage(self, stage: int) -> None:
        """Use the reward of another stage from the next step on."""
        if stage not in (1, 2, 3):
            raise ValueError(f"stage {stage!r}: allowed are 1, 2, 3")
        task, reward = self.task, self.task.reward
        self.stage = stage
        self._rules = Rules(
            transitions=transition_table(),
            rewards=np.ascontiguousarray(self._rewards[stage - 1]),
            landing_scale=reward.landing_scale,
            landing_bonus=reward.landing_bonus if stage == 3 else 0.0,
            landing_bonus_scale=reward.landing_bonus_scale,
            rate_scale=reward.reference_rate_hz / task.control_rate_hz,
            torque_weight=reward.torque,
            torque_limit=self.robot.torque_limit,
            jitter_weight=reward.jitter,
            collision_weight=reward.collision,
            grid_steps=task.grid_steps,
            time_limit=task.time_limit_s,
            flight_model=int(task.flight_model),
            chain=self.robot.chain,
        )

    @property
    def leads_home(self) -> bool:
        """Whether a policy learns now, in stage 3, to go home after its hits."""
        return self.experience.leads_home and self.stage == 3

    @property
    def validated(self) -> Flags:
        """Which environments play a validated rally (B,)."""
        return self._validated.copy()

    @property
    def rallies(self) -> Rallies:
        """The rallies in play, for rendering and tests. Read only."""
        return self._rallies

    @property
    def motion(self) -> RobotMotion:
        """The robots' motion in the last control step."""
        return self._contacts.motion

    def reset(self, rows: Rows | None = None, keeps_opponents: bool = False) -> Floats:
        """Start environments again, robots at home; return all observations (B, D).

        Args:
            rows: Which; the others go on. None: all of them.
            keeps_opponents: Whether what is known of their opponents' spin stays.
        """
        if rows is None or not self._started:
            rows = self._all
        self._started = False
        self._waiting = np.setdiff1d(self._waiting, rows)
        if len(self._rallies.track) and not keeps_opponents:
            self._rallies.track[rows] = self._new_tracks()[rows]
        self.robot.go_home(rows, np.zeros((rows.size, ACTION_SIZE)))
        self._rallies.last_action[rows] = self.robot.home_action
        self._begin(rows, np.zeros(rows.size, np.bool_))
        self._started = True
        self._observe(rows)
        return self._obs.copy()

    def step(self, actions: npt.ArrayLike) -> EnvStep:
        """Play one control step with ``actions`` (B, 7). Values beyond [-1, 1] are clipped."""
        if not self._started:
            raise RuntimeError("step() before reset(): call reset() first")
        clipped: Array = np.clip(np.asarray(actions, np.float64), -1.0, 1.0)
        if clipped.shape != (self.count, ACTION_SIZE):
            raise ValueError(f"actions of shape {clipped.shape}: allowed is {(self.count, ACTION_SIZE)}")
        if not np.isfinite(clipped).all():
            raise ValueError(
                f"actions of rows {np.flatnonzero(~np.isfinite(clipped).all(axis=1))} aren't finite"
            )
        begins = self._waiting
        if begins.size:
            clipped[begins] = self._rallies.last_action[begins]
        learnt = self._rallies.track[begins] if len(self._rallies.track) else None
        self._contacts.step(self._rallies, clipped, self._rules, self._profile, self._step)
        if begins.size:
            self._forget_step(begins, learnt)
        # The rally continues with the robot at home, but its result says nothing about the policy.
        self._validated[self.robot.faulty] = False
        self._returns += self._step.reward
        self._lengths += 1
        self._observe(self._all)

        outcome = self._step.outcome
        over = np.flatnonzero(outcome)
        continues = (outcome[over] == Outcome.RETURNED) & (self._rallies.rounds_left[over] > 1)
        ended = over[~continues]
        truncated = outcome == Outcome.TIME_OUT
        terminated = np.zeros(self.count, np.bool_)
        terminated[ended] = True
        terminated &= ~truncated
        final_obs = self._obs[ended]
        finished = self._finish(over)
        same_episode = np.zeros(begins.size, np.bool_)
        if self._begins_late:
            self._waiting, over, continues = ended, over[continues], continues[continues]
        begins, same_episode = np.append(begins, over), np.append(same_episode, continues)
        if begins.size:
            self._begin(begins, same_episode)
            self._observe(begins)
        return EnvStep(
            obs=self._obs.copy(),
            reward=self._step.reward.astype(np.float32),
            terminated=terminated,
            truncated=truncated,
            ended=ended,
            final_obs=final_obs,
            terms=self._step.terms.copy(),
            finished=finished,
        )

    def observe_extra(self) -> Floats:
        """Return the second observation (B, D): ``observation.policy_layout`` of its options."""
        if self._extra_observation is None:
            raise RuntimeError(
                "observe_extra() without extra_observation: give its options to the constructor"
            )
        extra = np.empty((self.count, size(policy_layout(self._extra_observation))), np.float32)
        flags = observation_flags(self._extra_observation)._replace(is_privileged=False)
        observe(
            self._rallies,
            self._all,
            self.robot.joint_pos,
            self.robot.joint_vel,
            self.robot.chain,
            flags,
            extra,
        )
        return extra

    def _forget_step(self, rows: Rows, learnt: Array | None) -> None:
        """Take back what a control step did to rallies ``rows`` that were over before it.

        Args:
            rows: (n,).
            learnt: Their flight filters before it (n, TRACK); None: no observation needs the filter.
        """
        self._step.outcome[rows] = 0
        self._step.reward[rows] = 0.0
        self._step.terms[rows] = 0.0
        if learnt is not None:
            self._rallies.track[rows] = learnt

    def _make_contacts(self, threads: int) -> Contacts:
        task = self.task
        if task.collision == "original":
            robot = RobotAndBall(
                self.count, task.robot, task.control_rate_hz, int(task.flight_model), threads
            )
            return MujocoContacts(robot)
        return TailoredContacts(RobotBatch(self.count, task.robot, task.control_rate_hz, threads=threads))

    def _new_tracks(self) -> Array:
        """Return a track for each ball, or none where no observation needs the flight filter."""
        options, extra = self.task.observation, self._extra_observation
        is_tracked = options.is_tracked or (extra is not None and extra.is_tracked)
        return new_tracks(self.count if is_tracked else 0, options.expected_spin)

    def _observe(self, rows: Rows) -> None:
        """Write the observations of ``rows``."""
        robot = self.robot
        observe(self._rallies, rows, robot.joint_pos, robot.joint_vel, robot.chain, self._flags, self._obs)

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
            parameters=r.parameters[rows],
            rounds=self._rounds[rows],
        )

    def _begin(self, rows: Rows, same_episode: Flags) -> None:
        """Launch the next rallies on ``rows``. Where ``same_episode`` the robot starts where it is.

        In another episode it starts there in a share ``carry_over`` of those after a stroke that was played to its end.
        """
        new = self._source.take(rows)
        # The stroke of a rally that ended at its hit is not finished: no robot meets its next ball in mid-swing.
        is_cut = self._rallies.ends_at_hit[rows] & self._rallies.caught[rows]
        path = self._rallies.true_sample_ring[:, RING:]
        path[rows] = NO_SAMPLE if new.paths is None else new.paths
        if new.strangers is not None and len(self._rallies.track):
            unknown = rows[new.strangers]
            self._rallies.track[unknown, POSTERIOR_MILD] = self._rallies.track[unknown, PRIOR_MILD]
        launch_rallies(self._rallies, rows, new.launches, new.seeds, self._profile)
        self._validated[rows] = new.validated
        self._returns[rows] = 0.0
        self._lengths[rows] = 0
        self._rounds[rows] = np.where(same_episode, self._rounds[rows] + 1, 1)
        gains, offset = np.empty((rows.size, 3, ACTION_SIZE)), np.empty((rows.size, ACTION_SIZE))
        task, experience = self.task, self.experience
        stays, continues, ends = draw_robot(
            new.seeds, self._profile, task.carry_over, task.reset_spread, gains, offset
        )
        self.robot.set_gains(rows, gains, self._rallies.parameters[rows, RallyParameter.ACTION_LATENCY])
        leaves = ~(stays & self._started & ~is_cut) & ~same_episode
        home = rows[leaves]
        if home.size:
            self.robot.go_home(home, offset[leaves])
            self._rallies.last_action[home] = self.robot.home_action
        rounds = np.where(task.rounds > 1, task.rounds, 1 + (continues < experience.continue_share))
        left = np.where(same_episode, self._rallies.rounds_left[rows] - 1, rounds)
        self._rallies.rounds_left[rows] = left
        self._rallies.ends_at_hit[rows] = (left == 1) & (ends < experience.end_at_hit_share)
        self._contacts.launch(self._rallies, rows)
