"""One ball after the other, played by the newest policy: each is simulated whole, and then shown."""

import os
from dataclasses import dataclass
from pathlib import Path
from typing import Final, Literal

import numpy as np

from common.evaluation.match import match_task
from common.evaluation.rally_recorder import RecordedRally, record_rallies
from common.policy.box import names, policy_folder
from common.policy.contract import WEIGHTS_FILE
from common.policy.folder import Policy, load_policy
from common.service.run_folder import RunFolder
from common.task.config import PresetName, RobotName, TaskConfig
from common.task.launch import Purpose, RallyBlock, draw_rallies
from topspin.view.config import ViewConfig
from topspin.view.words import Playing

RobotChoice = RobotName | Literal["contract"]
BLOCK: Final = 64  # balls drawn at once
YOUR_BALL: Final = "your ball"
DEFAULT: Final = "default"  # policy


@dataclass(frozen=True, slots=True)
class Choice:
    """What a person can change while the page runs."""

    policy: str  # a name of the box, a policy folder, or the run that is followed
    launch: PresetName
    robot: RobotChoice  # contract: the policy's own


@dataclass(frozen=True, slots=True)
class _Loaded:
    """A choice, made."""

    choice: Choice
    policy: Policy
    task: TaskConfig
    label: str  # of the policy, for people
    stamp: tuple[int, int]  # of its file


class Game:
    """Plays balls with the policy, the robot and the balls that are chosen.

    Args:
        config: The page's settings.
        run: A run whose newest policy is followed; None: the policy of the choice.

    Raises:
        PolicyError: There is no such policy, or it can't be read.
    """

    def __init__(self, config: ViewConfig, run: RunFolder | None = None) -> None:
        self._config, self._run = config, run
        first = f"run {run.root.name}" if run is not None else config.policy or DEFAULT
        self.policies = tuple(dict.fromkeys((first, *names())))  # to choose from
        self.choose(Choice(first, config.launch, config.robot))

    @property
    def choice(self) -> Choice:
        """What is chosen."""
        return self._loaded.choice

    @property
    def task(self) -> TaskConfig:
        """The task under the page's conditions."""
        return self._loaded.task

    def playing(self, balls: str = "") -> Playing:
        """Return who plays what; ``balls``: another name than the preset's."""
        loaded = self._loaded
        trained_on = loaded.policy.contract.task.robot
        return Playing(loaded.label, loaded.task.robot, trained_on, balls or loaded.choice.launch)

    def choose(self, choice: Choice) -> None:
        """Play on with another policy, robot or kind of ball, from the preset's first ball on.

        Raises:
            PolicyError: There is no such policy, or it can't be read; the game goes on as before.
        """
        self._loaded = self._load(choice)
        self._row = -1  # of the ball in play
        self._rallies = self._draw(0)

    def follow(self) -> bool:
        """Load a run's policy again if its file has changed, and return whether it has; raises PolicyError."""
        loaded = self._loaded
        if self._run is None or loaded.choice.policy != self.policies[0]:
            return False
        if _stamp(self._run.latest_policy) == loaded.stamp:
            return False
        self._loaded = self._load(loaded.choice)
        return True

    def next_ball(self) -> RecordedRally:
        """Play the next ball of the preset."""
        self._row += 1
        block, row = divmod(self._row, BLOCK)
        if row == 0:
            self._rallies = self._draw(block)
        return self.play(self._rallies.of(np.array([row])))

    def play(self, ball: RallyBlock) -> RecordedRally:
        """Play one ball; the robot starts near home."""
        return record_rallies(self._loaded.policy.act, ball, self._loaded.task)[0]

    def _draw(self, block: int) -> RallyBlock:
        seed, purpose = self._config.seed, Purpose.EVALUATION
        return draw_rallies(BLOCK, self._loaded.task, seed=seed, block=block, purpose=purpose)

    def _load(self, choice: Choice) -> _Loaded:
        is_followed = self._run is not None and choice.policy == self.policies[0]
        folder = (
            self._run.latest_policy if self._run is not None and is_followed else policy_folder(choice.policy)
        )
        stamp = _stamp(folder)  # before the policy is read: a later one is then loaded again
        policy = load_policy(folder)
        contract = policy.contract
        task = match_task(contract, self._config, self._config.expected_spin)
        robot = contract.task.robot if choice.robot == "contract" else choice.robot
        task = task.model_copy(update={"launch": choice.launch, "robot": robot})
        label = f"{choice.policy}, {contract.frames / 1e6:.1f} M frames" if is_followed else choice.policy
        return _Loaded(choice, policy, task, label, stamp)


def _stamp(folder: Path) -> tuple[int, int]:
    """Return what changes when a folder's policy is replaced; zeros where there is none."""
    try:
        found = os.stat(folder / WEIGHTS_FILE)
    except OSError:
        return 0, 0
    return found.st_mtime_ns, found.st_ino
