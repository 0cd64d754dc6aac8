"""The controller of a robot: measurements in, joint targets out, at the control rate of a policy."""

import logging
import math
import time
from collections import Counter, deque
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
import numpy.typing as npt

from common.physics.chain import JOINTS
from common.rally.observer import STATES, BallSample
from topspin.robot.contract import POLICY_FILE, RobotContract, read_contract
from topspin.robot.faults import AHEAD, MAX_AGE, Fault, Found, Limits, check_clock, check_numbers, check_stamp
from topspin.robot.made_up_ball import detections
from topspin.robot.network import Network
from topspin.robot.tracker import BallTracker, Position

log = logging.getLogger(__name__)

Array = npt.NDArray[np.float64]
Numbers = Sequence[float] | Array

MAX_HELD: Final = 3  # control steps for which the last good joint measurement stands in for bad ones
MAX_WAITING: Final = 256  # detections that wait for the next control step; a camera of 200 Hz sends 4


@dataclass(frozen=True, slots=True)
class Command:
    """What the robot should do now."""

    positions: Array  # (7,) joint targets [m, rad], in the joints' ranges, always finite
    # False: the targets of the step before, since there is no ball, or nothing that can be believed
    is_new: bool


class Controller:
    """Plays with an exported policy. It is for one thread; ``load`` makes it.

    Args:
        contract: Of the policy.
        network: The policy.
    """

    def __init__(self, contract: RobotContract, network: Network) -> None:
        self.contract = contract
        self.faults: Counter[Fault] = Counter()
        self.last_fault = ""  # the sentence of the last bad measurement
        self._network = network
        self._tracker = BallTracker(contract)
        self._middle, self._half_range = contract.of_joints("middle"), contract.of_joints("half_range")
        self._ball_pos = self._limits("ball_pos", Fault.BALL_NOT_FINITE, Fault.BALL_OUT_OF_RANGE)
        self._ball_vel = self._limits("ball_vel", Fault.BALL_NOT_FINITE, Fault.BALL_OUT_OF_RANGE)
        self._joint_pos = self._limits("joint_pos", Fault.JOINTS_NOT_FINITE, Fault.JOINTS_OUT_OF_RANGE)
        self._joint_vel = self._limits("joint_vel", Fault.JOINTS_NOT_FINITE, Fault.JOINTS_OUT_OF_RANGE)
        self._waiting: deque[tuple[float, Position] | BallSample] = deque(maxlen=MAX_WAITING)
        self._begun: tuple[tuple[float, float], bool] | None = None
        self._joints: tuple[Array, Array] | None = None
        self._held = 0
        self.now = -math.inf  # [s] time of the last step
        self._positions: Array | None = None

    def _limits(self, name: str, not_finite: Fault, out_of_range: Fault) -> Limits:
        return Limits(name, *self.contract.range_of(name), not_finite, out_of_range)

    def warm_up(self) -> float:
        """Compile every kernel and run the network, on a made-up ball; return the time it took [s].

        The first time on a computer it takes half a minute, because numba compiles. The result is kept on the disk, so
        later it takes a second. ``load`` calls it. Nothing of the made-up ball stays in the controller.
        """
        started = time.perf_counter()
        tracker, home = BallTracker(self.contract), self.contract.of_joints("home")
        for moment, pos in detections(0.3):
            tracker.add(moment, pos)
            sample = tracker.sample_at(moment)
            if sample is not None:
                self._network.act(tracker.observe(moment, home, np.zeros(JOINTS), sample)[None])
        return time.perf_counter() - started

    def begin(self, target: tuple[float, float], *, served: bool = False, new_opponent: bool = False) -> None:
        """Begin a new ball. Detections of earlier balls are forgotten.

        Args:
            target: Where to return it [m]: x in 0..1.37, y in -0.76..0.76.
            served: The opponent serves, so the ball bounces on the opponent's court first.
            new_opponent: Forget what earlier balls said about the opponent's spin (``expected_spin`` learnt).

        Raises:
            ValueError: ``target`` is not on the opponent's court.
        """
        x, y = (float(value) for value in target)
        if not (0.0 <= x <= 1.37 and -0.7625 <= y <= 0.7625):  # false for nan too
            raise ValueError(f"target ({x:g}, {y:g}); allowed: x in 0..1.37 and y in -0.76..0.76 [m]")
        if new_opponent:
            self._tracker = BallTracker(self.contract)
        self._begun = (x, y), served
        self._tracker.begin((x, y), served=served)
        self._waiting.clear()

    def see(self, moment: float, position: Numbers) -> None:
        """Give a camera's detection of the ball. The next ``step`` uses it.

        Args:
            moment: When the picture was taken, on the clock of ``step`` [s].
            position: In the world frame (3,) [m].
        """
        x, y, z = position
        self._waiting.append((float(moment), (float(x), float(y), float(z))))

    def measure(self, sample: BallSample | None) -> None:
        """Give a sample of the robot's own perception, with velocity and state, instead of camera detections.

        None: it has no new sample, and nothing changes.
        """
        if sample is not None:
            self._waiting.append(sample)

    def step(self, now: float, joint_pos: Numbers, joint_vel: Numbers) -> Command:
        """Return the joint targets of a control step. Call it at ``contract.control_rate_hz``.

        Bad numbers are counted in ``faults`` and change no target: the last good joints stand in for three steps, a bad
        detection counts as lost, and in all other cases the last targets stay.

        Args:
            now: Time now [s], on the clock of ``see``.
            joint_pos: Positions of the joints, in the contract's order (7,) [m, rad].
            joint_vel: Their velocities (7,) [m/s, rad/s].

        Raises:
            ValueError: The joints of the first step are bad, so that no target is known which is safe.
        """
        clock = check_clock(now, self.now)
        if math.isfinite(now):
            self.now = now  # a clock that was set back costs one step, not all until it catches up
        is_measured = self._take_joints(joint_pos, joint_vel)
        if clock is not None:
            self._count(clock)
            return self._hold()
        if self._tracker.newest > now + AHEAD:  # the clock was set back: no later stamp would be newer
            self._begin_again()
        self._take_balls(now)
        sample = self._tracker.sample_at(now)
        if not is_measured or sample is None or now - self._tracker.newest > MAX_AGE or self._joints is None:
            return self._hold()
        return self._act(now, *self._joints, sample)

    def _act(self, now: float, joint_pos: Array, joint_vel: Array, sample: BallSample) -> Command:
        try:
            obs = self._tracker.observe(now, joint_pos, joint_vel, sample)
        except ValueError as error:  # the camera filter's estimate is not finite
            return self._restart(Found(Fault.OBSERVATION_NOT_FINITE, str(error)))
        if not np.isfinite(obs).all():
            first = int(np.flatnonzero(~np.isfinite(obs))[0])
            return self._restart(Found(Fault.OBSERVATION_NOT_FINITE, f"observation[{first}] is {obs[first]}"))
        action = self._network.act(obs[None])[0].astype(np.float64)
        if not np.isfinite(action).all():
            self._count(Found(Fault.ACTION_NOT_FINITE, f"the network's action is {action.tolist()}"))
            return self._hold()
        self._positions = self._middle + self._half_range * np.clip(action, -1.0, 1.0)
        return Command(self._positions.copy(), is_new=True)

    def _take_joints(self, joint_pos: Numbers, joint_vel: Numbers) -> bool:
        """Keep the joints' measurement if it is good; return whether one is known that is fresh enough to act on."""
        found = check_numbers(joint_pos, JOINTS, self._joint_pos) or check_numbers(
            joint_vel, JOINTS, self._joint_vel
        )
        if found is None:
            self._joints = np.array(joint_pos, np.float64), np.array(joint_vel, np.float64)
            self._held = 0
            return True
        self._count(found)
        if self._joints is None:
            raise ValueError(f"{found.text}; the first step needs the joints where they are")
        self._held += 1
        return self._held <= MAX_HELD

    def _take_balls(self, now: float) -> None:
        """Pass what was detected since the last step to the tracker, without what is wrong."""
        while self._waiting:
            ball = self._waiting.popleft()
            if self._begun is None:
                # The camera sees a ball that nobody plays, or the program has forgotten to begin
                early = "a ball before begin(target); allowed: one after it"
                self._count(Found(Fault.BALL_BEFORE_BEGIN, early))
                continue
            if isinstance(ball, BallSample):
                found = check_stamp(ball.moment, self._tracker.newest, now) or self._check_sample(ball)
                if found is None:
                    self._tracker.replace(ball)
            else:
                found = check_numbers(ball[1], 3, self._ball_pos) or check_stamp(
                    ball[0], self._tracker.newest, now
                )
                if found is None:
                    self._tracker.add(*ball)
            if found is not None:
                self._count(found)

    def _check_sample(self, ball: BallSample) -> Found | None:
        found = check_numbers(ball.pos, 3, self._ball_pos) or check_numbers(ball.vel, 3, self._ball_vel)
        if found is None and ball.state not in STATES:
            allowed = ", ".join(map(str, STATES))
            found = Found(Fault.BALL_OUT_OF_RANGE, f"ball state is {ball.state}; allowed: {allowed}")
        return found

    def _restart(self, found: Found) -> Command:
        """Forget a ball, and what is known of the opponent: numbers that are not finite may be in both."""
        self._count(found)
        self._tracker = BallTracker(self.contract)
        self._begin_again()
        return self._hold()

    def _begin_again(self) -> None:
        """Forget what was measured of the ball that is played."""
        if self._begun is not None:
            target, served = self._begun
            self._tracker.begin(target, served=served)

    def _hold(self) -> Command:
        """Return the last targets; before the first, where the robot stands."""
        if self._positions is None:
            joints = self._middle if self._joints is None else self._joints[0]
            offset = np.clip(joints - self._middle, -self._half_range, self._half_range)
            self._positions = self._middle + offset
        return Command(self._positions.copy(), is_new=False)

    def _count(self, found: Found) -> None:
        if not self.faults[found.fault]:
            log.warning("bad measurement kind=%s: %s (later ones are only counted)", found.fault, found.text)
        self.faults[found.fault] += 1
        self.last_fault = found.text


def load(folder: str | Path) -> Controller:
    """Return the controller of an exported folder, warm: its first step takes as long as any other.

    Raises:
        ExportError: The folder can't be used; the text says why.
    """
    path = Path(folder)
    contract = read_contract(path)
    controller = Controller(contract, Network(path / POLICY_FILE, contract.size))
    controller.warm_up()
    return controller
