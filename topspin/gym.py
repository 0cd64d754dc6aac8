"""The rally environment for Gymnasium, ``topspin/Rally-v0``.

    import gymnasium
    import topspin

    env = gymnasium.make("topspin/Rally-v0", randomization="off", stage=3)
    envs = gymnasium.make_vec("topspin/Rally-v0", num_envs=512)

The vector environment is the batch itself (one call steps all robots), not copies of the single one: ``gym_vector``.

Observations are the policy's: the simulator's truth, which only our critic observes, is left out whatever the settings
say. Every rally is an episode that is played to its end, unless ``end_at_hit_share`` or ``continue_share`` is given.
"""

import difflib
from collections.abc import Mapping
from typing import Any, Final, NoReturn, TypeVar, cast

import gymnasium
import numpy as np
import numpy.typing as npt
from gymnasium import spaces
from pydantic import BaseModel, ValidationError

from common.env.local_rallies import LocalRallies
from common.env.rally_env import FinishedRallies, RallyEnv
from common.task.config import TaskConfig
from common.task.experience import ExperienceConfig
from common.task.observation import ACTION, PAPER_OBSERVATION, Part, policy_layout
from topspin.render.gl import Image
from topspin.render.live import LiveDrawing

Floats = npt.NDArray[np.float32]
Flags = npt.NDArray[np.bool_]

_Model = TypeVar("_Model", bound=BaseModel)
_EPISODES: Final = ("end_at_hit_share", "continue_share")


def _box(layout: tuple[Part, ...]) -> spaces.Box:
    """Return a layout's space: its parts' ranges."""
    sizes = [part.size for part in layout]
    low = np.repeat([part.low for part in layout], sizes).astype(np.float32)
    high = np.repeat([part.high for part in layout], sizes).astype(np.float32)
    return spaces.Box(low, high, dtype=np.float32)


ACTION_SPACE = _box(ACTION)
OF_BATCH: Final = ("threads", "autoreset_mode")
DEFAULTS: Final[Mapping[str, Any]] = {
    "observation": PAPER_OBSERVATION,
    "end_at_hit_share": 0.0,
    "continue_share": 0.0,
}
"""Where this environment differs from the one that our actors play."""


def _of_settings(model: type[_Model], given: dict[str, Any]) -> _Model:
    """Return settings; raises ValueError with one line: the name, the value, and what is allowed."""
    try:
        return model(**given)
    except ValidationError as error:
        first = error.errors()[0]
        name = ".".join(str(part) for part in first["loc"])
        if first["type"] == "extra_forbidden":
            *parents, unknown = name.split(".")
            inner: type[BaseModel] = TaskConfig
            for parent in parents:
                inner = cast(type[BaseModel], inner.model_fields[parent].annotation)
            known = tuple(inner.model_fields) if parents else (*TaskConfig.model_fields, *_EPISODES)
            if unknown in OF_BATCH:
                raise ValueError(f"{name!r} is an argument of make_vec alone") from None
            nearest = difflib.get_close_matches(unknown, known, n=1, cutoff=0.7)
            hint = f"did you mean {nearest[0]!r}?" if nearest else f"allowed: {', '.join(known)}"
            raise ValueError(f"unknown setting {name!r}; {hint}") from None
        if not name:  # settings that do not fit each other
            raise ValueError(first["msg"].removeprefix("Value error, ")) from None
        raise ValueError(f"{name} = {first['input']!r}; {first['msg']}") from None


def check_choices(render_mode: str | None, modes: list[str], stage: int) -> None:
    """Raise ValueError for a render mode or a stage that there is not."""
    if render_mode is not None and render_mode not in modes:
        allowed = ", ".join(("None", *map(repr, modes)))
        raise ValueError(
            f"render_mode {render_mode!r}; allowed: {allowed} (films: topspin play --video FILE)"
        )
    if not isinstance(stage, int | np.integer) or stage not in (1, 2, 3):
        raise ValueError(f"stage {stage!r}; allowed: 1, 2, 3")


class RallyBatch:
    """A batch of environments with rallies of its own.

    Args:
        count: B.
        stage: Curriculum stage 1..3.
        settings: Fields of ``TaskConfig``, ``end_at_hit_share`` and ``continue_share``, over ``DEFAULTS``.
        options: More arguments of ``RallyEnv``.
    """

    def __init__(self, count: int, stage: int, settings: dict[str, Any], **options: Any) -> None:
        self._count, self._stage, self._options = count, stage, options
        given = {**DEFAULTS, **settings}
        episodes = {name: given.pop(name) for name in _EPISODES}
        self._experience = _of_settings(ExperienceConfig, {"leads_home": False, **episodes})
        task = _of_settings(TaskConfig, given)
        observation = task.observation.model_copy(update={"critic": "policy"})
        self.task = task.model_copy(update={"observation": observation})
        self.observation_space = _box(policy_layout(observation))
        self.env: RallyEnv | None = None

    def begin(self, seed: int) -> Floats:
        """Return the first observations of a sequence of episodes that the seed alone decides."""
        source = LocalRallies(seed, self.task)
        self.env = RallyEnv(
            self._count, self.task, source, self._stage, experience=self._experience, **self._options
        )
        return self.env.reset()

    def __deepcopy__(self, memo: dict[int, Any]) -> NoReturn:
        """Refuse: the simulator's state is not Python's."""
        raise TypeError(
            "an environment can't be copied; make another with the same settings, and reset it with the same seed"
        )

    @property
    def started(self) -> RallyEnv:
        """The environments; raises before the first reset."""
        if self.env is None:
            raise gymnasium.error.ResetNeeded("step() before reset(): call reset() first")
        return self.env


def within(obs: Floats, space: spaces.Box) -> Floats:
    """Return observations clipped to their stated ranges: a blow can throw a ball beyond them."""
    clipped: Floats = np.clip(obs, space.low, space.high)
    return clipped


def warn_of_rendering() -> None:
    """Warn that there is no picture."""
    gymnasium.logger.warn("render() without a render_mode returns None; films: topspin play --video FILE")


def fresh_seed(random: np.random.Generator) -> int:
    """Return a seed of a sequence of episodes."""
    return int(random.integers(2**63))


def facts(finished: FinishedRallies) -> dict[str, npt.NDArray[Any]]:
    """Return what Gymnasium's users may want to know of rallies that ended."""
    return {
        "outcome": finished.outcomes.astype(np.int64),
        "caught": finished.caught,
        "over": finished.over,
        "landing_error": finished.landing_errors,
    }


class RallyGymEnv(gymnasium.Env[Any, Any]):
    """One robot, one ball.

    Args:
        stage: Curriculum stage 1..3, the reward's column.
        render_mode: ``rgb_array``: ``render()`` returns a picture (540, 960, 3); ``human``: each step is shown in a
            window, in real time; None: nothing is drawn.
        settings: Fields of ``TaskConfig`` and ``ExperienceConfig``, over ``DEFAULTS``: ``launch="strong"``,
            ``randomization="off"``, ``control_rate_hz=200`` ...
    """

    metadata = {  # noqa: RUF012  # Gymnasium's own name and form
        "render_modes": ["human", "rgb_array"],
        "render_fps": 50,  # an environment has its own control rate
    }

    def __init__(self, stage: int = 3, render_mode: str | None = None, **settings: Any) -> None:
        check_choices(render_mode, self.metadata["render_modes"], stage)
        self.render_mode = render_mode
        self._batch = RallyBatch(1, stage, settings)
        self.metadata = {**self.metadata, "render_fps": self._batch.task.control_rate_hz}
        task = self._batch.task
        self._drawing = (
            LiveDrawing(render_mode, task.robot, 1.0 / task.control_rate_hz)
            if render_mode is not None
            else None
        )
        self.observation_space, self.action_space = self._batch.observation_space, ACTION_SPACE
        self._next_obs: Floats | None = None

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Floats, dict[str, Any]]:
        """Begin an episode: with a seed, everything starts again; without one, the opponent stays the same."""
        super().reset(seed=seed)
        if seed is not None or self._batch.env is None:
            obs = self._batch.begin(fresh_seed(self.np_random))
        elif self._next_obs is None:  # in the middle of an episode
            obs = self._batch.env.reset(keeps_opponents=True)
        else:
            obs = self._next_obs
        self._next_obs = None
        if self._drawing is not None:
            self._drawing.show(self._batch.started)
        return within(obs[0], self._batch.observation_space), {}

    def render(self) -> Image | None:
        """Return a picture (540, 960, 3) of the last step with ``rgb_array``; None otherwise.

        At the end of an episode it is the picture before the last step: the environment has begun the next one.
        """
        if self._drawing is None:
            warn_of_rendering()
            return None
        return self._drawing.picture()

    def close(self) -> None:
        """Close the window, and free the graphics memory."""
        if self._drawing is not None:
            self._drawing.close()

    def step(self, action: Floats) -> tuple[Floats, float, bool, bool, dict[str, Any]]:
        """Play one control step."""
        if self._next_obs is not None:
            raise gymnasium.error.ResetNeeded("step() after the episode's end: call reset() first")
        if np.shape(action) != ACTION_SPACE.shape:
            raise ValueError(f"action of shape {np.shape(action)}; allowed: {ACTION_SPACE.shape}")
        step = self._batch.started.step(np.asarray(action)[None])
        obs = step.obs
        if step.ended.size:
            self._next_obs, obs = step.obs, step.final_obs
        elif self._drawing is not None:
            self._drawing.show(self._batch.started)
        # An episode may go on after a rally: as in the vector environment, the facts are those of its last one
        of_last = facts(step.finished) if step.ended.size else {}
        info = {name: values[0] for name, values in of_last.items() if values.size}
        return (
            within(obs[0], self._batch.observation_space),
            float(step.reward[0]),
            bool(step.terminated[0]),
            bool(step.truncated[0]),
            info,
        )
