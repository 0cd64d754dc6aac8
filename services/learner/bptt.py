"""Backpropagation through time, through kinematics and drives: train actions whose effect is observed later.

Imitation takes the student's observations as given. But the student observes its own arm, and the arm's position
depends on earlier actions. So a policy without memory is a recurrent network whose state is the robot. The steps are
replayed in order, as recorded, plus the change that other actions would have made to the joints:

    d(t + 1) = f(x(t) + d(t), a'(t)) - f(x(t), a(t)),     a'(t) = a(t) + mu(o(x(t) + d(t))) - mu_then(t)

with joints x and actions a as recorded, f the drives (``differentiable_arm``), mu the policy's mean, and mu_then that
mean at the start of the update. The action noise stays as recorded. d is zero at the start of an update, and the
gradient of every later step's loss reaches back through it (Werbos 1990, "Backpropagation through time"). The
teacher's actions stay as recorded: the next epoch records new ones.
"""

from dataclasses import dataclass

import torch
from torch import Tensor

from common.policy.actor_critic import ActorCritic
from common.policy.normalizer import CLIP, Moments, scale_of
from services.learner.differentiable_arm import ARM_OBS, DOF, ArmModel, robot_observation

KEPT = 0.98  # share of a gradient that passes one step back, so that limits and feedback do not make it grow


@dataclass(frozen=True, slots=True)
class ArmRollout:
    """The arms' motion in a dataset of N frames."""

    arm: ArmModel
    rows: tuple[Tensor, ...]  # for each rollout (T, B): indices of its frames in the order of play
    before: Tensor  # (N, 14) joint positions and velocities
    after: Tensor  # (N, 14) one control step later, by the model of the drives
    goes_on: Tensor  # (N, 1) 1 where the next frame is of the same rally, else 0
    mean: Tensor  # (ARM_OBS,) mean that normalised an observation's first numbers
    scale: Tensor  # (ARM_OBS,)

    @classmethod
    @torch.no_grad()
    def of(
        cls,
        arm: ArmModel,
        rows: tuple[Tensor, ...],
        before: Tensor,
        actions: Tensor,
        ended: Tensor,
        moments: Moments,
    ) -> "ArmRollout":
        """Return the motion from ``before`` (N, 14), ``actions`` (N, A), ``ended`` (N,) and normaliser moments."""
        after = torch.cat(arm.step(before[:, :DOF], before[:, DOF:], actions), -1)
        mean, scale = (torch.from_numpy(x[:ARM_OBS]).float() for x in (moments.mean, scale_of(moments)))
        return cls(arm, rows, before, after, (~ended).float()[:, None], mean, scale)

    def batches(self, size: int, generator: torch.Generator) -> list[Tensor]:
        """Return all frames in batches (T, b) of about ``size``, each of whole columns of a rollout, shuffled."""
        found = []
        for rows in self.rows:
            steps, columns = rows.shape
            order = torch.randperm(columns, generator=generator)
            found += [rows[:, some] for some in torch.split(order, max(1, size // steps))]
        return [found[k] for k in torch.randperm(len(found), generator=generator)]


def replayed(
    network: ActorCritic, obs: Tensor, actions: Tensor, mean_prox: Tensor, motion: ArmRollout, rows: Tensor
) -> tuple[Tensor, Tensor]:
    """Return mean actions (T b, A) and values (T b,) of frames ``rows`` (T, b), each arm replayed step by step.

    Args:
        network: Policy and critic.
        obs: (N, D) normalised.
        actions: (N, A).
        mean_prox: (N, A) the network's means at the start of the update.
        motion: The arms' motion.
        rows: (T, b) frames in the order of play, one column for each robot.
    """
    deviation = torch.zeros(rows.shape[1], 2 * DOF)
    means, values = [], []
    for now in rows:
        joints = motion.before[now] + deviation
        pos, vel = joints[:, :DOF], joints[:, DOF:]
        robot = ((robot_observation(pos, vel) - motion.mean) / motion.scale).clamp(-CLIP, CLIP)
        mean, value = network(torch.cat((robot, obs[now, ARM_OBS:]), -1))
        mean = mean.float()
        means.append(mean)
        values.append(value.float())
        replayed_joints = torch.cat(motion.arm.step(pos, vel, actions[now] + mean - mean_prox[now]), -1)
        deviation = (replayed_joints - motion.after[now]) * motion.goes_on[now]
        deviation = KEPT * deviation + (1.0 - KEPT) * deviation.detach()
    return torch.cat(means), torch.cat(values)
