"""What a policy sees, made of what a robot measures: the simulator's own observation, with no simulator about.

observer = Observer(policy.contract.observation_options)
observer.begin(target)  # for each ball
while ...:  # at the policy's control rate
obs = observer.observe(now, joint_pos, joint_vel, ball)
action = policy.act(obs[None])[0]
"""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from common.rally import play
from common.rally.noise import PROFILES, Condition
from common.rally.observation import ObservationConfig, policy_layout, size
from common.rally.prediction import new_tracks

Floats = npt.NDArray[np.float32]


@dataclass(frozen=True, slots=True)
class BallSample:
    """The ball as it was perceived, by ``estimator`` or whatever the robot has; world frame."""

    pos: tuple[float, float, float]  # m
    vel: tuple[float, float, float]  # m/s
    state: int  # 0 coming, 1 bounced on the robot's court, 2 hit, 3 landed
    moment: float  # [s] when it was there, on the robot's clock
    guessed: bool = False  # an estimate of too few shots to be followed yet: ``estimator.is_guess``


class Observer:
    """Makes one robot's observations.

    Args:
        options: What the policy sees: ``contract.observation_options``.
        position_noise: Sigma of a sample's position a axis [m]; by default what policies are trained with.
        velocity_noise: And of its velocity [m/s].

    Raises:
        ValueError: The policy was told the ball's true spin, which no robot can measure.
    """

    def __init__(
        self,
        options: ObservationConfig,
        position_noise: float = PROFILES["standard"].position_noise,
        velocity_noise: float = PROFILES["standard"].velocity_noise,
    ) -> None:
        if options.spin == "true":
            raise ValueError(
                "spin 'true' can't be measured; allowed: a policy with spin 'estimated' or 'hidden'"
            )
        self._options = options
        self._noise = position_noise, velocity_noise
        self._rally, _ = play.allocate(1, options.history, tracks=new_tracks(1, options.spin_expected))
        self._told = play.told_by(options)._replace(is_privileged=False)
        self._is_first = True

    def begin(self, target: tuple[float, float]) -> None:
        """Expect a new ball of the same other side, which is to land at ``target`` [m]: x in 0..1.37, y in -0.76..0.76.

        What was learnt of how that side spins is kept (``spin_expected`` learnt); another one wants another Observer.
        """
        self._rally.condition[0, [Condition.TARGET_X, Condition.TARGET_Y]] = target
        self._is_first = True

    def observe(
        self, now: float, joint_pos: npt.ArrayLike, joint_vel: npt.ArrayLike, ball: BallSample
    ) -> Floats:
        """Return the observation (D,) of a control step.

        Args:
            now: On the clock of ``ball.moment`` [s].
            joint_pos: (7,) ``observation.JOINT_RANGES``' order [m, rad].
            joint_vel: (7,) [m/s, rad/s].
            ball: The newest sample; the last one again, if none has come.
        """
        rally = self._rally
        seen, earlier = rally.seen[0], rally.earlier[0]
        earlier[1:] = earlier[:-1].copy()
        earlier[:1] = seen[:6]
        # ``seen`` holds when the sample was taken as the environment does, since the rally's clock stands at 0: now
        seen[:] = [*ball.pos, *ball.vel, ball.state, ball.moment - now]
        if self._is_first:
            earlier[:] = seen[:6]
        play.follow_flight(rally.track[0], seen, ball.moment, now, self._is_first, ball.guessed, *self._noise)
        self._is_first = False
        obs = np.empty((1, size(policy_layout(self._options))), np.float32)
        play.observe(
            rally,
            np.zeros(1, np.int64),
            np.array(joint_pos, np.float64).reshape(1, 7),
            np.array(joint_vel, np.float64).reshape(1, 7),
            self._told,
            obs,
        )
        own: Floats = obs[0]
        return own
