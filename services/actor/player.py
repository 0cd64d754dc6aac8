"""Playing the latest policy: one call makes one [T, B] block of experience. No clock, no network."""

import time
from collections.abc import Callable
from types import MappingProxyType

import numpy as np
import numpy.typing as npt
import torch

from common.comms.messages import Episodes, PolicySnapshot, Rollout
from common.env.rally_env import EnvConfig, FinishedRallies, RallyEnv, RallySource
from common.env.review import Lessons
from common.env.teacher import teacher_of
from common.policy.actor_critic import NetworkConfig, log_prob
from common.policy.normalizer import Moments, normalize
from common.policy.weights import install, new_network, task_hash
from common.rally.draws import Stream, bits
from common.rally.observation import ACTION_SIZE, critic_layout, size
from common.rally.reward import TERMS
from common.rally.trajectory import Outcome

Floats = npt.NDArray[np.float32]


class Player:
    """B environments and a copy of the policy.

    Args:
        config: The task.
        network: Network's shape, as the learner's.
        source: Where rallies come from.
        envs: B.
        horizon: T, control steps of one block.
        seed: Of the action noise; differs from actor to actor.
        launch: Preset of the rallies, part of what learner and actors agree on.
        clock: Seconds, for the time spent by phase.
    """

    def __init__(
        self,
        config: EnvConfig,
        network: NetworkConfig,
        source: RallySource,
        envs: int,
        horizon: int,
        seed: int,
        launch: str = "paper",
        clock: Callable[[], float] = time.perf_counter,
    ) -> None:
        torch.set_num_threads(1)  # a second thread makes small matrices slower, and takes the learner's core
        self._teacher = teacher_of(config)
        self.env = RallyEnv(envs, config, source, onlooker=self._teacher.sees if self._teacher else None)
        self.contract_hash = task_hash(network, config.model_dump(mode="json"), launch)
        self.snapshot: PolicySnapshot | None = None
        self._obs_size = size(critic_layout(config.observation))
        self._network = new_network(network, config.observation)  # of which the policy alone is asked
        self._moments = Moments.initial(self._network.obs_size)
        self._noise = torch.Generator()
        self._seed = seed
        self._clock = clock
        self._obs: Floats | None = None
        self._shape = (horizon, envs)

    def adopt(self, snapshot: PolicySnapshot) -> None:
        """Play by ``snapshot`` from the next block on; raises PolicyError if it is of another layout."""
        layout = critic_layout(self.env.config.observation)
        moments = install(self._network, snapshot, layout, self.contract_hash, "actor")
        self._moments = moments.first(self._network.obs_size)
        if self.snapshot is None or self.snapshot.stage != snapshot.stage:
            self.env.set_stage(snapshot.stage)
        self.snapshot = snapshot

    def play(self, actor: str, incarnation: int, sequence: int) -> Rollout:
        """Return the next block, numbered and stamped; environments go on where the last block left them.

        The action noise is a function of seed and sequence alone, so that a run can be repeated.
        """
        snapshot = self.snapshot
        if snapshot is None:
            raise RuntimeError("play() before adopt(): there is no policy yet")
        steps, envs = self._shape
        self._noise.manual_seed(int(bits(self._seed, Stream.RESET, sequence)) >> 1)
        if self._obs is None:
            self._obs = self.env.reset()
        obs = np.empty((steps, envs, self._obs_size), np.float32)
        actions = np.empty((steps, envs, ACTION_SIZE), np.float32)
        log_mu, rewards = (np.empty((steps, envs), np.float32) for _ in range(2))
        terminated, truncated = np.empty((steps, envs), np.bool_), np.empty((steps, envs), np.bool_)
        final_obs: list[Floats] = []
        final_index: list[npt.NDArray[np.int32]] = []
        finished: list[FinishedRallies] = []
        corrections = np.zeros((steps, envs, ACTION_SIZE), np.float32)
        teacher = self._teacher if self.env.config.teacher.teaches(snapshot.version) else None
        terms = np.zeros(len(TERMS))
        inference = simulation = 0.0
        seen = self._network.obs_size
        for t in range(steps):
            started = self._clock()
            obs[t] = self._obs
            with torch.inference_mode():
                mean = self._network.act(torch.from_numpy(normalize(self._obs[:, :seen], self._moments)))
                noise = torch.randn(mean.shape, generator=self._noise)
                action = mean + self._network.log_sigma.exp() * noise
                log_mu[t] = log_prob(action, mean, self._network.log_sigma).numpy()
            actions[t] = action.numpy()
            acted = self._clock()
            if teacher:
                corrections[t] = teacher.advice(self.env, self._obs) - actions[t]
            step = self.env.step(actions[t])
            self._obs = step.obs
            rewards[t], terminated[t], truncated[t] = step.reward, step.terminated, step.truncated
            terms += step.terms.sum(axis=0)
            if not teacher:
                correct(corrections, t, step.lessons)
            cut = step.truncated[step.ended]
            if cut.any():
                final_obs.append(step.final_obs[cut])
                final_index.append((t * envs + step.ended[cut]).astype(np.int32))
            if step.finished.rows.size:
                finished.append(step.finished)
            inference, simulation = inference + (acted - started), simulation + (self._clock() - acted)
        return Rollout(
            run=snapshot.run,
            generation=snapshot.generation,
            version=snapshot.version,
            stage_number=snapshot.stage_number,
            actor=actor,
            incarnation=incarnation,
            sequence=sequence,
            contract_hash=self.contract_hash,
            obs=obs,
            actions=actions,
            log_mu=log_mu,
            rewards=rewards,
            terminated=terminated,
            truncated=truncated,
            final_obs=np.concatenate(final_obs) if final_obs else np.zeros((0, self._obs_size), np.float32),
            final_index=np.concatenate(final_index) if final_index else np.zeros(0, np.int32),
            last_obs=self._obs.copy(),
            episodes=_episodes(finished),
            reward_terms=terms.astype(np.float32),
            # An action that was clipped is no basis for what a hit says; what a teacher says has none
            corrections=np.where((np.abs(actions) < 1.0) | bool(teacher), corrections, 0.0),
            seconds=MappingProxyType({"inference": inference, "simulation": simulation}),
        )


def correct(corrections: Floats, t: int, lessons: Lessons) -> None:
    """Write what hits of step ``t`` say of the block's last actions into ``corrections`` (T, B, 7).

    What reaches back beyond the block's beginning is lost: those frames are on their way.
    """
    for back in range(min(t + 1, lessons.corrections.shape[1])):
        reached = lessons.steps > back
        if not reached.any():
            return
        corrections[t - back, lessons.rows[reached]] = lessons.corrections[reached, back]


def _episodes(finished: list[FinishedRallies]) -> Episodes:
    """Return the wire's summary of the rallies that ended."""

    def column(name: str, dtype: npt.DTypeLike) -> npt.NDArray[np.generic]:
        parts = [np.asarray(getattr(f, name)) for f in finished]
        return np.concatenate(parts).astype(dtype) if parts else np.zeros(0, dtype)

    outcome = column("outcomes", np.uint8)
    return Episodes(
        outcome=outcome.astype(np.uint8),
        target_error=column("landing_errors", np.float32).astype(np.float32),
        caught=column("caught", np.bool_).astype(np.bool_),
        over=column("over", np.bool_).astype(np.bool_),
        landed=outcome == Outcome.RETURNED,
        unvalidated=~column("validated", np.bool_).astype(np.bool_),
        returns=column("returns", np.float32).astype(np.float32),
    )
