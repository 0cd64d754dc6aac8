"""Playing the latest policy: one call returns one [T, B] block of experience. No messages are sent here."""

import time
from collections.abc import Callable
from types import MappingProxyType

import numpy as np
import numpy.typing as npt
import torch

from common.comms.messages import Episodes, PolicySnapshot, Rollout
from common.env.rally_env import FinishedRallies, RallyEnv, RallySource
from common.env.teacher import Teacher, teacher_of
from common.policy.actor_critic import log_prob
from common.policy.config import NetworkConfig
from common.policy.contract import PolicyError, training_hash
from common.policy.network_pass import NetworkPass, native_precision
from common.policy.normalizer import Moments, normalize
from common.policy.weights import install, new_network
from common.task.config import TaskConfig
from common.task.counter_rng import Stream, bits
from common.task.experience import ExperienceConfig
from common.task.observation import ACTION_SIZE, OBSERVATION, critic_layout, offsets, size
from common.task.reward import TERMS
from common.task.states import Outcome
from services.actor.way_home import way_home

Floats = npt.NDArray[np.float32]
Flags = npt.NDArray[np.bool_]

_STATE = offsets(OBSERVATION)["trajectory_state"].start


class Player:
    """B environments and a copy of the policy.

    Args:
        task: The task.
        experience: How training plays it.
        network: The network's shape, as the learner's.
        source: Gives the rallies.
        envs: B.
        horizon: T, control steps of one block.
        seed: Of the action noise; differs from actor to actor.
        clock: Returns seconds; measures the duration of each phase.
        note: Called with rallies that ended.
    """

    def __init__(
        self,
        task: TaskConfig,
        experience: ExperienceConfig,
        network: NetworkConfig,
        source: RallySource,
        envs: int,
        horizon: int,
        seed: int,
        clock: Callable[[], float] = time.perf_counter,
        note: Callable[[FinishedRallies], None] = lambda _: None,
    ) -> None:
        torch.set_num_threads(1)  # a second thread makes small products slower and uses the learner's core
        self._teacher: Teacher | None = None
        self._no_teacher: PolicyError | None = None
        try:
            self._teacher = teacher_of(task, experience.teacher)
        except PolicyError as error:  # only a policy that still learns from it needs it
            self._no_teacher = error
        extra = self._teacher.observation if self._teacher else None
        self.env = RallyEnv(envs, task, source, experience=experience, extra_observation=extra)
        self.training_hash = training_hash(task, network, experience)
        self.snapshot: PolicySnapshot | None = None
        self._obs_size = size(critic_layout(task.observation))
        self._network = new_network(network, task.observation)  # only its policy is used
        # The learner's default: then a rollout of the newest policy has the learner's own probabilities
        self._network_pass = NetworkPass(self._network, envs, native_precision())
        self._moments = Moments.initial(self._network.obs_size)
        self._noise = torch.Generator()
        self._seed = seed
        self._clock = clock
        self._note = note
        self._obs: Floats | None = None
        self._shape = (horizon, envs)

    def adopt(self, snapshot: PolicySnapshot) -> None:
        """Play ``snapshot`` from the next block on. Raises PolicyError if it does not fit."""
        layout = critic_layout(self.env.task.observation)
        moments = install(self._network, snapshot, layout, self.training_hash, "actor")
        self._network_pass.refresh()
        self._moments = moments.first(self._network.obs_size)
        if self.snapshot is None or self.snapshot.stage != snapshot.stage:
            self.env.set_stage(snapshot.stage)
        self.snapshot = snapshot

    def play(self, actor: str, incarnation: int, sequence: int) -> Rollout:
        """Return the next block, numbered and stamped. Environments continue where the last block ended.

        The action noise is a function of seed and sequence alone, so that a run can be repeated.

        Raises:
            PolicyError: The policy still learns from a teacher that can't be read.
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
        is_taught = self.env.experience.teacher.teaches(snapshot.version)
        if is_taught and self._no_teacher is not None:
            raise self._no_teacher
        teacher = self._teacher if is_taught else None
        terms = np.zeros(len(TERMS))
        inference = simulation = 0.0
        width = self._network.obs_size
        for t in range(steps):
            started = self._clock()
            obs[t] = self._obs
            with torch.inference_mode():
                mean = self._network_pass.act(
                    torch.from_numpy(normalize(self._obs[:, :width], self._moments))
                )
                noise = torch.randn(mean.shape, generator=self._noise)
                action = mean + self._network.log_std.exp() * noise
                log_mu[t] = log_prob(action, mean, self._network.log_std).numpy()
            actions[t] = action.numpy()
            acted = self._clock()
            self._advise(obs[t], actions[t], mean.numpy(), teacher, corrections[t])
            step = self.env.step(actions[t])
            self._obs = step.obs
            rewards[t], terminated[t], truncated[t] = step.reward, step.terminated, step.truncated
            terms += step.terms.sum(axis=0)
            cut = step.truncated[step.ended]
            if cut.any():
                final_obs.append(step.final_obs[cut])
                final_index.append((t * envs + step.ended[cut]).astype(np.int32))
            if step.finished.rows.size:
                finished.append(step.finished)
                self._note(step.finished)
            inference, simulation = inference + (acted - started), simulation + (self._clock() - acted)
        return Rollout(
            run=snapshot.run,
            generation=snapshot.generation,
            version=snapshot.version,
            stage_number=snapshot.stage_number,
            actor=actor,
            incarnation=incarnation,
            sequence=sequence,
            training_hash=self.training_hash,
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
            corrections=corrections,
            seconds=MappingProxyType({"inference": inference, "simulation": simulation}),
        )

    def _advise(
        self, obs: Floats, actions: Floats, mean: Floats, teacher: Teacher | None, out: Floats
    ) -> None:
        """Write how the actions of this control step should differ.

        Args:
            obs: What the policy observes (B, D). It shows a hit late, and only then is the robot led home: a policy
                that cannot know whether it has hit would begin to leave before.
            actions: To be played (B, 7).
            mean: Of the policy (B, 7).
            teacher: Whom the policy imitates; None: it learns from rewards.
            out: Zeros (B, 7); written: corrections of the actions by the teacher, of the mean after a hit.
        """
        has_hit, home = obs[:, _STATE] > 0.0, self.env.home_action
        if teacher:
            out[:] = teacher.advice(self.env) - actions
            out[has_hit] = home - actions[has_hit]  # a teacher may not have learnt the way home
        elif self.env.leads_home:
            out[has_hit] = way_home(mean[has_hit], home)


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
