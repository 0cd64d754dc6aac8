"""One ball as the robot observes it: camera filter, flight filter and observation, without any check of its input."""

import math

import numpy as np
import numpy.typing as npt

from common.perception.camera_filter import ESTIMATE, add_detection, begin_filter, estimate_at, is_guess
from common.perception.flight_track import COMING, SERVED
from common.rally.observer import BallSample, Observer
from topspin.robot.contract import RobotContract

Array = npt.NDArray[np.float64]
Position = tuple[float, float, float]


class BallTracker:
    """Follows the balls of one opponent, as a simulated robot with perception ``full`` does.

    Args:
        contract: Of the policy.
    """

    def __init__(self, contract: RobotContract) -> None:
        self._filters = contract.filters
        self._observer = Observer(
            contract.options,
            contract.kinematics.chain(),
            contract.filters.position_noise,
            contract.filters.velocity_noise,
        )
        self._row = np.zeros(ESTIMATE)
        self.begin((1.0, 0.0))

    def begin(self, target: tuple[float, float], *, served: bool = False) -> None:
        """Begin a new ball of the same opponent: see ``Controller.begin``."""
        self._observer.begin(target)
        self._served = served
        self._first = math.nan
        self._sample: BallSample | None = None
        self.newest = -math.inf  # [s] stamp of the newest detection or sample

    def add(self, moment: float, pos: Position) -> None:
        """Add a camera's detection, newer than the one before. It takes the place of a sample that was given."""
        noise = self._filters.camera_noise
        self._sample = None
        if math.isnan(self._first):
            begin_filter(self._row, moment, pos, noise, SERVED if self._served else COMING)
            self._first = moment
        else:
            add_detection(self._row, moment, pos, noise)
        self.newest = moment

    def replace(self, sample: BallSample) -> None:
        """Replace the camera filter by a sample of the robot's own perception."""
        self._sample = sample
        self.newest = sample.moment

    def sample_at(self, now: float) -> BallSample | None:
        """Return what the policy observes as measured; None before the first detection."""
        if self._sample is not None or math.isinf(self.newest):
            return self._sample
        moment = max(now - self._filters.observed_ago, self._first)
        pos, vel, state = estimate_at(self._row, moment)
        return BallSample(pos, vel, int(state), moment, bool(is_guess(self._row)))

    def observe(
        self, now: float, joint_pos: Array, joint_vel: Array, sample: BallSample
    ) -> npt.NDArray[np.float32]:
        """Return the observation (D,) of a control step.

        Raises:
            ValueError: The sample is not finite.
        """
        return self._observer.observe(now, joint_pos, joint_vel, sample)
