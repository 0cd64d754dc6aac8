"""Backpropagation through the arm: what to do now for the arm to tell later.

Imitation takes what a pupil sees for given. But it sees its own arm, and where that is depends on what it did before:
a policy without memory is a recurrent network whose state is the robot. So its steps are played again, in order, as
they were but for the difference that other actions would have made to the joints:

    d(t + 1) = f(x(t) + d(t), a'(t)) - f(x(t), a(t)),     a'(t) = a(t) + mu(o(x(t) + d(t))) - mu_then(t)

with joints x and actions a as recorded, f the drives (``arm.py``), mu the policy's mean and mu_then that as the update
began; the noise stays. d is zero as an update begins, and the gradient of every later step's loss reaches back through
it (Werbos 1990, "Backpropagation through time"). What the teacher says stays as recorded: it is asked anew every epoch.
"""

from dataclasses import dataclass

import torch
from torch import Tensor

from common.policy.actor_critic import ActorCritic
from common.policy.normalizer import CLIP, Moments, scale_of
from services.learner.arm import DOF, SEEN, Arm, seen_of

KEPT = 0.98  # of a gradient, a step back: what drives at their limits and feedback do to it must not add up


@dataclass(frozen=True, slots=True)
class Motion:
    """What the arms of a dataset's N frames did."""

    arm: Arm
    rows: tuple[Tensor, ...]  # each (T, B): which frames followed each other, by rollout
    before: Tensor  # (N, 14) joint positions and velocities
    after: Tensor  # (N, 14) a control step later, by the drives
    goes_on: Tensor  # (N, 1) 1 where the next frame is the same rally's, else 0
    mean: Tensor  # (SEEN,) by which an observation's first numbers were normalised
    scale: Tensor  # (SEEN,)

    @classmethod
    @torch.no_grad()
    def of(
        cls,
        arm: Arm,
        rows: tuple[Tensor, ...],
        before: Tensor,
        actions: Tensor,
        ended: Tensor,
        moments: Moments,
    ) -> "Motion":
        """Return it, from ``before`` (N, 14), ``actions`` (N, A), ``ended`` (N,) and the normaliser's moments."""
        after = torch.cat(arm.step(before[:, :DOF], before[:, DOF:], actions), -1)
        mean, scale = (torch.from_numpy(x[:SEEN]).float() for x in (moments.mean, scale_of(moments)))
        return cls(arm, rows, before, after, (~ended).float()[:, None], mean, scale)

    def batches(self, size: int, generator: torch.Generator) -> list[Tensor]:
        """Return all frames in batches (T, b) of about ``size``, whole columns of a rollout each, shuffled."""
        found = []
        for rows in self.rows:
            steps, columns = rows.shape
            order = torch.randperm(columns, generator=generator)
            found += [rows[:, some] for some in torch.split(order, max(1, size // steps))]
        return [found[k] for k in torch.randperm(len(found), generator=generator)]


def replayed(
    network: ActorCritic, obs: Tensor, actions: Tensor, mean_prox: Tensor, motion: Motion, rows: Tensor
) -> tuple[Tensor, Tensor]:
    """Return mean actions (T b, A) and values (T b,) of frames ``rows`` (T, b), each step's arm led on from the last's.

    Args:
        network: Policy and critic.
        obs: (N, D) normalised.
        actions: (N, A).
        mean_prox: (N, A) what the network meant to do as the update began.
        motion: Of the arms.
        rows: (T, b) frames in the order of play, a column a robot.
    """
    apart = torch.zeros(rows.shape[1], 2 * DOF)
    means, values = [], []
    for now in rows:
        joints = motion.before[now] + apart
        pos, vel = joints[:, :DOF], joints[:, DOF:]
        robot = ((seen_of(pos, vel) - motion.mean) / motion.scale).clamp(-CLIP, CLIP)
        mean, value = network(torch.cat((robot, obs[now, SEEN:]), -1))
        mean = mean.float()
        means.append(mean)
        values.append(value.float())
        led = torch.cat(motion.arm.step(pos, vel, actions[now] + mean - mean_prox[now]), -1)
        apart = (led - motion.after[now]) * motion.goes_on[now]
        apart = KEPT * apart + (1.0 - KEPT) * apart.detach()
    return torch.cat(means), torch.cat(values)
