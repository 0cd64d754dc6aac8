"""The rally environment for Gymnasium's vector interface: one batch, in which one call steps all robots.

    envs = gymnasium.make_vec("topspin/Rally-v0", num_envs=512, threads=2)
    envs = gymnasium.make_vec("topspin/Rally-v0", num_envs=512, autoreset_mode=AutoresetMode.NEXT_STEP)

An episode that ended begins again

- in the same step (``SAME_STEP``, the default): the observation is the next episode's first, the last one is
  ``infos["final_obs"]``, and the rally's facts are ``infos["final_info"]``;
- in the next step (``NEXT_STEP``): the observation is the episode's last, and the facts are in ``infos``. The next step
  ignores this environment's action, returns the next episode's first observation, and pays nothing.
"""

from collections.abc import Sequence
from typing import Any, Final

import gymnasium
import numpy as np
import numpy.typing as npt
from gymnasium.vector import AutoresetMode, VectorEnv

from common.env.rally_env import EnvStep
from topspin.gym import (
    ACTION_SPACE,
    Flags,
    Floats,
    RallyBatch,
    check_choices,
    facts,
    fresh_seed,
    warn_of_rendering,
    within,
)

AUTORESET: Final = (AutoresetMode.SAME_STEP, AutoresetMode.NEXT_STEP)


class RallyVectorEnv(VectorEnv[Any, Any, Any]):
    """A batch of robots in one simulation call.

    Args:
        num_envs: How many.
        stage: Curriculum stage 1..3, the reward's column.
        render_mode: None: pictures are those of one environment, and films those of recorded rallies.
        threads: Of MuJoCo. The robots are divided among them; no result depends on how many there are.
        autoreset_mode: ``AutoresetMode.SAME_STEP`` or ``NEXT_STEP``, or its value: when an ended episode begins again.
        settings: As for ``RallyGymEnv``.
    """

    metadata = {  # noqa: RUF012  # Gymnasium's own name and form
        "render_modes": [],
        "render_fps": 50,
        "autoreset_mode": AutoresetMode.SAME_STEP,
    }

    def __init__(
        self,
        num_envs: int = 1,
        stage: int = 3,
        render_mode: str | None = None,
        threads: int = 1,
        autoreset_mode: AutoresetMode | str = AutoresetMode.SAME_STEP,
        **settings: Any,
    ) -> None:
        check_choices(render_mode, self.metadata["render_modes"], stage)
        for name, count in (("num_envs", num_envs), ("threads", threads)):
            if not isinstance(count, int | np.integer) or count < 1:
                raise ValueError(f"{name} {count!r}; allowed: a whole number from 1")
        if autoreset_mode not in (*AUTORESET, *(mode.value for mode in AUTORESET)):
            raise ValueError(f"autoreset_mode {autoreset_mode}; allowed: {', '.join(map(str, AUTORESET))}")
        self._mode = AutoresetMode(autoreset_mode)
        self.num_envs = num_envs
        self._batch = RallyBatch(
            num_envs, stage, settings, threads=threads, begins_late=self._mode == AutoresetMode.NEXT_STEP
        )
        self.metadata = {
            **self.metadata,
            "render_fps": self._batch.task.control_rate_hz,
            "autoreset_mode": self._mode,
        }
        self.single_observation_space, self.single_action_space = self._batch.observation_space, ACTION_SPACE
        self.observation_space = gymnasium.vector.utils.batch_space(self.single_observation_space, num_envs)
        self.action_space = gymnasium.vector.utils.batch_space(ACTION_SPACE, num_envs)
        self.render_mode = render_mode

    def reset(
        self,
        *,
        seed: int | Sequence[int] | None = None,
        options: dict[str, Any] | None = None,
    ) -> tuple[Floats, dict[str, Any]]:
        """Begin episodes.

        Args:
            seed: Decides all episodes from here on; a list of one for each environment is one seed, together.
            options: ``reset_mask`` (B,) bool: which environments begin a new episode; the others go on.
        """
        one = None if seed is None else self._one_seed(seed)
        mask = (options or {}).get("reset_mask")
        rows = None if mask is None else self._rows_of(mask, one)
        super().reset(seed=one)
        if one is not None or self._batch.env is None:
            obs = self._batch.begin(fresh_seed(self.np_random))
        else:
            obs = self._batch.env.reset(rows)
        return within(obs, self._batch.observation_space), {}

    def render(self) -> None:
        """Warn: there is no picture."""
        warn_of_rendering()

    def _one_seed(self, seed: int | Sequence[int]) -> int:
        """Return one seed for a seed, or for one of each environment."""
        if isinstance(seed, int | np.integer):
            return int(seed)
        seeds = list(seed)
        if len(seeds) != self.num_envs or not all(isinstance(s, int | np.integer) and s >= 0 for s in seeds):
            raise ValueError(f"seed {seed!r}; allowed: a whole number from 0, or {self.num_envs} of them")
        return int(np.random.SeedSequence(seeds).generate_state(1)[0])

    def _rows_of(self, mask: Any, seed: int | None) -> npt.NDArray[np.intp]:
        """Return the rows of a reset mask."""
        given = np.asarray(mask)
        if given.shape != (self.num_envs,) or given.dtype != np.bool_ or not given.any():
            raise ValueError(
                f"reset_mask of shape {given.shape} and {given.dtype}, {np.count_nonzero(given)} set; "
                f"allowed: ({self.num_envs},) bool, at least one set"
            )
        if seed is not None and not given.all():
            raise ValueError(
                "seed with a reset_mask; allowed: one of them, since a seed decides all episodes"
            )
        if self._batch.env is None and not given.all():
            raise gymnasium.error.ResetNeeded("reset_mask before reset(): reset all environments first")
        return np.flatnonzero(given)

    def step(self, actions: Floats) -> tuple[Floats, npt.NDArray[Any], Flags, Flags, dict[str, Any]]:
        """Play one control step with every robot."""
        step = self._batch.started.step(actions)
        rewards = step.reward.astype(np.float64)
        obs = within(step.obs, self._batch.observation_space)
        return obs, rewards, step.terminated, step.truncated, self._infos(step)

    def _infos(self, step: EnvStep) -> dict[str, Any]:
        """Return what Gymnasium wants to know of the episodes that ended in a step."""
        if not step.ended.size:
            return {}
        ended = np.zeros(self.num_envs, np.bool_)
        ended[step.ended] = True
        if self._mode == AutoresetMode.NEXT_STEP:
            return self._facts(step, ended)
        final_obs = np.full(self.num_envs, None, dtype=object)
        for row, obs in zip(step.ended, within(step.final_obs, self._batch.observation_space), strict=True):
            final_obs[row] = obs
        return {
            "final_obs": final_obs,
            "_final_obs": ended,
            "final_info": self._facts(step, ended),
            "_final_info": ended.copy(),
        }

    def _facts(self, step: EnvStep, ended: Flags) -> dict[str, Any]:
        """Return each fact as (B,), with its mask: Gymnasium's form of a batch of dicts."""
        info: dict[str, Any] = {}
        last = ended[step.finished.rows]  # others go on over a return
        for name, values in facts(step.finished).items():
            column = np.zeros(self.num_envs, values.dtype)
            column[step.finished.rows[last]] = values[last]
            info[name], info[f"_{name}"] = column, ended.copy()
        return info
