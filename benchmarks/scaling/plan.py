"""What a run is made of: processes on so many cores."""

from dataclasses import dataclass

from benchmarks.scaling.costs import HORIZON, Costs
from common.errors import ReportedError
from services.learner.config import PPOConfig, minibatch_of


@dataclass(frozen=True, slots=True)
class Plan:
    """A run on so many cores. Every process has one thread that computes."""

    cores: float
    actors: int
    learners: int = 1  # ranks of the group
    envs: int = 256  # environments of each actor
    minibatch: int = 0  # frames, over all ranks; 0: as the learner has by default
    evaluates: bool = True
    learner_frames_per_s: float = (
        0.0  # of one learner on an accelerator, from memory; 0: learners are on the cores
    )
    passes: int = PPOConfig().mini_epochs

    @property
    def rollout(self) -> int:
        """Frames of a rollout."""
        return HORIZON * self.envs

    @property
    def dataset(self) -> int:
        """Frames of a dataset: one rollout of each actor."""
        return self.actors * self.rollout

    @property
    def steps(self) -> int:
        """Gradient steps of a pass; a small remainder makes none (`ppo.minibatches`)."""
        size = minibatch_of(self.minibatch, self.dataset)
        whole, rest = divmod(self.dataset, size)
        return whole + (rest >= max(1, min(size, self.dataset) // 2))


def available_cores(plan: Plan, costs: Costs) -> float:
    """Return the cores that generators and evaluator leave.

    Raises:
        ReportedError: They leave none.
    """
    others = plan.actors * costs.generator_share + plan.evaluates * costs.evaluator_share
    if others >= plan.cores:
        raise ReportedError(
            f"{plan.cores:g} cores for {plan.actors} actors: generators and evaluator need {others:.2f} of them"
        )
    return plan.cores - others
