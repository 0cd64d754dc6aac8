"""A policy that says what it would have done in another's place, and what is worth writing down.

A pupil that sees the ball as it is now, and remembers nothing, can't tell how it spins: that shows in how the flight
bends. But it sees its own arm, and before the stroke two of its joints are free. So where notes are asked for, the
teacher says to hold them, until shortly before the stroke, where the ball was and how it flew as the pupil saw it
first: writing is a function of the ball, holding one of the joints, and reading is up to the pupil.
"""

from pathlib import Path
from typing import Final, NamedTuple

import numpy as np
import numpy.typing as npt

from common.env.rally_env import EnvConfig, RallyEnv
from common.env.robot import JOINTS
from common.physics.constants import GRID_STEP, TABLE_HALF_LENGTH
from common.policy.weights import Policy, PolicyError, load_policy
from common.rally.observation import (
    OBSERVATION,
    ObservationConfig,
    offsets,
    policy_layout,
)

Floats = npt.NDArray[np.float32]

_AT = offsets(OBSERVATION)
_TARGET = _AT["target"]
COMING = _AT["continuous_state"].start  # tau_01: launched, and not seen to have bounced
_MIDDLE = np.array([0.5 * TABLE_HALF_LENGTH, 0.0], np.float32)


class Note(NamedTuple):
    """What a joint holds: home + gain (number - middle) [half-range]."""

    joint: int
    number: int  # of the observation
    middle: float
    gain: float


NOTES: Final = (
    Note(JOINTS.index("roll"), _AT["ball_vel"].start + 1, 0.0, 0.22),  # y [m/s]: sidespin bends it
    Note(JOINTS.index("wrist"), _AT["ball_pos"].start + 2, 0.48, 0.8),  # z [m]: topspin makes it fall
)
"""Of fast joints, which a stroke needs last. Balls as they are launched take up a third to all of their range."""

NOTE_JOINTS: Final = [note.joint for note in NOTES]

FIRST_SEEN: Final = 0.05  # [s] after the launch notes are written
STROKE: Final = 0.24  # [s] before a ball is met the joints are wanted for it
_LARGEST: Final = 0.95  # [half-range]


class Teacher:
    """A policy that looks on while another plays.

    Args:
        policy: It, read from its folder.
        towards_middle: Share of the way to the middle of the opponent's court by which targets are moved for it.
        notes: Whether it has its pupil take notes.
    """

    def __init__(self, policy: Policy, towards_middle: float = 0.0, notes: bool = False) -> None:
        self._policy, self._towards_middle = policy, towards_middle
        self._has_notes_taken = notes
        self._notes = np.zeros(len(NOTES), np.float32)  # (B, notes) from the first rallies on
        self._seen_at = offsets(policy_layout(self.sees))

    @property
    def sees(self) -> ObservationConfig:
        """What it must be shown: the environment's onlooker."""
        return self._policy.contract.observation_options

    def advice(self, env: RallyEnv, shown: Floats) -> Floats:
        """Return what it would do now (B, 7), within [-1, 1].

        Args:
            env: The rallies; the same from call to call, a control step on.
            shown: What the pupil sees of them (B, D).
        """
        seen = env.look_on()
        seen[:, _TARGET] += self._towards_middle * (_MIDDLE - seen[:, _TARGET])
        advice = np.clip(self._policy.act(seen), -1.0, 1.0)
        if self._has_notes_taken:
            self._dictate(env, shown, seen[:, self._seen_at["meeting_in"].start], advice)
        return advice

    def _dictate(self, env: RallyEnv, shown: Floats, meeting_in: Floats, advice: Floats) -> None:
        """Put into ``advice`` what joints that are still free should hold."""
        numbers = shown[:, [note.number for note in NOTES]]
        is_new = env.rallies.clock * GRID_STEP < FIRST_SEEN
        self._notes = np.where(is_new[:, None], numbers, self._notes)
        is_free = (meeting_in > STROKE) & (shown[:, COMING] > 0.5)
        for k, note in enumerate(NOTES):
            held = env.home_action[note.joint] + note.gain * (self._notes[:, k] - note.middle)
            advice[:, note.joint] = np.where(is_free, held.clip(-_LARGEST, _LARGEST), advice[:, note.joint])


def teacher_of(task: EnvConfig) -> Teacher | None:
    """Return a task's teacher, or None where it has none. What spins it is told to expect is the task's.

    Raises:
        PolicyError: It can't be read, or couldn't play the task itself.
    """
    if not task.teacher.policy:
        return None
    policy = load_policy(Path(task.teacher.policy))
    contract, history = policy.contract, policy.contract.observation_options.history
    for name, theirs, ours in (
        ("control_rate_hz", contract.control_rate_hz, task.control_rate_hz),
        ("robot", contract.robot, task.robot),
        ("observation.history", history, task.observation.history),
    ):
        if theirs != ours:
            raise PolicyError(
                f"teacher {task.teacher.policy}: {name} is {theirs}; allowed is the task's, {ours}"
            )
    if task.teacher.notes and not contract.observation_options.prediction:
        raise PolicyError(
            f"teacher {task.teacher.policy}: observation.prediction is False; allowed with teacher.notes is True: "
            "joints are free until it knows a ball is about to be met"
        )
    return Teacher(policy, task.teacher.towards_middle, task.teacher.notes)
