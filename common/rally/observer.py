"""The observation of a real robot: what a policy observes, from what the robot measures, without a simulator.

```python
observer = Observer(policy.contract.task.observation, chain)
observer.begin(target)  # for each ball
while playing:  # at the policy's control rate
    obs = observer.observe(now, joint_pos, joint_vel, ball)
    action = policy.act(obs[None])[0]
```
"""

from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt

from common.perception.flight_track import SERVED, new_tracks
from common.physics.chain import JOINTS, Chain
from common.rally.observe import observation_flags, observe
from common.rally.sensing import update_flight_filter
from common.rally.state import allocate
from common.task.observation import ObservationConfig, policy_layout, size
from common.task.randomization import PROFILES, RallyParameter

Floats = npt.NDArray[np.float32]

STATES: Final = (0, 1, 2, 3, int(SERVED))  # of a sample's ball


@dataclass(frozen=True, slots=True)
class BallSample:
    """A measurement of the ball in the world frame, from ``camera_filter`` or from the robot's own perception."""

    pos: tuple[float, float, float]  # m
    vel: tuple[float, float, float]  # m/s
    # 0 coming, 1 bounced on the robot's court, 2 hit, 3 landed, 4 served and not yet bounced on the server's own court
    state: int
    moment: float  # [s] time stamp, on the robot's clock
    is_guess: bool = False  # the camera filter has too few detections yet: ``camera_filter.is_guess``


def check_finite(name: str, values: npt.ArrayLike, size: int) -> None:
    """Raise ValueError unless ``values`` are ``size`` finite numbers; its text names the first that is not."""
    numbers = np.asarray(values, np.float64).ravel()
    if numbers.size != size:
        raise ValueError(f"{name} has {numbers.size} numbers; allowed: {size}")
    for k in np.flatnonzero(~np.isfinite(numbers)):
        raise ValueError(f"{name}[{k}] is {numbers[k]}; allowed: a finite number")


class Observer:
    """Makes one robot's observations.

    Args:
        options: What the policy observes: ``contract.task.observation``.
        chain: Of the robot.
        position_noise: Standard deviation of a sample's position per axis [m]; default: randomization `standard`.
        velocity_noise: Standard deviation of its velocity per axis [m/s].

    Raises:
        ValueError: The policy observes the ball's true spin, which no robot can measure.
    """

    def __init__(
        self,
        options: ObservationConfig,
        chain: Chain,
        position_noise: float = PROFILES["standard"].position_noise,
        velocity_noise: float = PROFILES["standard"].velocity_noise,
    ) -> None:
        if options.spin == "true":
            raise ValueError(
                "spin 'true' can't be measured; allowed: a policy with spin 'estimated' or 'hidden'"
            )
        self._options, self._chain = options, chain
        self._noise = position_noise, velocity_noise
        tracks = new_tracks(1 if options.is_tracked else 0, options.expected_spin)
        self._rally, _ = allocate(1, options.history, tracks=tracks)
        self._flags = observation_flags(options)._replace(is_privileged=False)
        self._is_first = True

    def begin(self, target: tuple[float, float]) -> None:
        """Begin a new ball of the same opponent. ``target`` is where to return it [m]: x in 0..1.37, y in -0.76..0.76.

        With ``expected_spin`` learnt the observer keeps what it has learnt about the opponent's spin. Make a new
        Observer for a new opponent. Raises ValueError for a target that is not finite.
        """
        check_finite("target", target, 2)
        self._rally.parameters[0, [RallyParameter.TARGET_X, RallyParameter.TARGET_Y]] = target
        self._is_first = True

    def observe(
        self, now: float, joint_pos: npt.ArrayLike, joint_vel: npt.ArrayLike, ball: BallSample
    ) -> Floats:
        """Return the observation (D,) of a control step.

        Args:
            now: Time now on the clock of ``ball.moment`` [s].
            joint_pos: (7,) from the robot's base to its racket [m, rad].
            joint_vel: (7,) [m/s, rad/s].
            ball: The newest sample; if there is no new one, the last sample again.

        Raises:
            ValueError: A number is not finite, is missing, or is no trajectory state. Nothing has changed then.
        """
        if ball is None:
            raise ValueError(
                "ball is None; allowed: the newest sample. Before the first one there is nothing to observe"
            )
        check_finite("now", now, 1)
        check_finite("joint_pos", joint_pos, JOINTS)
        check_finite("joint_vel", joint_vel, JOINTS)
        check_finite("ball.pos", ball.pos, 3)
        check_finite("ball.vel", ball.vel, 3)
        check_finite("ball.moment", ball.moment, 1)
        if ball.state not in STATES:
            raise ValueError(f"ball.state is {ball.state}; allowed: {', '.join(map(str, STATES))}")
        rally = self._rally
        measurement, history = rally.measurement[0], rally.measurement_history[0]
        history[1:] = history[:-1].copy()
        history[:1] = measurement[:6]
        # The stamp is relative to the rally's clock, which stays at 0: now
        measurement[:] = [*ball.pos, *ball.vel, ball.state, ball.moment - now]
        if self._is_first:
            history[:] = measurement[:6]
        if self._options.is_tracked:
            update_flight_filter(
                rally.track[0], measurement, ball.moment, now, self._is_first, ball.is_guess, *self._noise
            )
        self._is_first = False
        obs = np.empty((1, size(policy_layout(self._options))), np.float32)
        observe(
            rally,
            np.zeros(1, np.int64),
            np.array(joint_pos, np.float64).reshape(1, JOINTS),
            np.array(joint_vel, np.float64).reshape(1, JOINTS),
            self._chain,
            self._flags,
            obs,
        )
        own: Floats = obs[0]
        return own
