"""PPO in one file, as a bare reference: one process, plain torch, our network, our batch. Nothing overlaps.

python -m benchmarks.peers.single_file FOLDER --seconds 60
"""

import math

import numpy as np
import torch
from torch import Tensor, nn

from benchmarks.peers import task
from common.policy.normalizer import Moments, normalize, scale_of


class Agent(nn.Module):
    """Mean action and value on one trunk, and a standard deviation that depends on nothing."""

    def __init__(self) -> None:
        super().__init__()
        self.trunk = task.make_trunk()
        self.mean, self.value, self.log_std = task.make_heads(self.trunk)

    def forward(self, obs: Tensor) -> tuple[Tensor, Tensor]:
        """Return means (N, 7) and values (N,) for normalised observations (N, D)."""
        hidden = self.trunk(obs)
        return self.mean(hidden), self.value(hidden).squeeze(-1)

    def log_prob(self, actions: Tensor, mean: Tensor) -> Tensor:
        """Return the actions' log-probabilities (N,), up to a constant."""
        return (-0.5 * ((actions - mean) / self.log_std.exp()) ** 2 - self.log_std).sum(-1)


def advantages(rewards: Tensor, values: Tensor, cuts: Tensor, bootstrap: Tensor) -> Tensor:
    """Return generalized advantage estimates (T, B).

    Args:
        rewards: (T, B).
        values: (T + 1, B).
        cuts: (T, B) whether an episode ended with the step.
        bootstrap: (T, B) value of the last observation where a time limit cut the episode, 0 elsewhere.
    """
    result, trace = torch.zeros_like(rewards), torch.zeros_like(rewards[0])
    for t in reversed(range(len(rewards))):
        goes_on = 1.0 - cuts[t]
        error = rewards[t] + task.GAMMA * (goes_on * values[t + 1] + bootstrap[t]) - values[t]
        trace = error + task.GAMMA * task.GAE_LAMBDA * goes_on * trace
        result[t] = trace
    return result


def main() -> None:  # noqa: PLR0915  # the whole algorithm, in the order in which it happens
    """Train."""
    asked = task.order()
    recorder, envs, agent = task.Recorder(asked), task.make_envs(), Agent()
    optimizer = torch.optim.Adam(agent.parameters(), lr=task.LEARNING_RATE, fused=True)
    moments, rate, frames = Moments.initial(task.OBS), task.LEARNING_RATE, 0
    shape = (task.HORIZON, task.ENVS)
    raw, _ = envs.reset(seed=asked.seed)

    def policy() -> task.Normalized:
        acting = nn.Sequential(agent.trunk, agent.mean)
        mean, scale = torch.from_numpy(moments.mean), torch.from_numpy(scale_of(moments))
        return task.Normalized(mean, scale, task.OBS_CLIP, acting)

    while not (frames and recorder.note(frames, policy)):
        seen, actions = torch.zeros(*shape, task.OBS), torch.zeros(*shape, task.ACTIONS)
        values, means = torch.zeros(task.HORIZON + 1, task.ENVS), torch.zeros(*shape, task.ACTIONS)
        rewards, cuts, bootstrap = (torch.zeros(shape) for _ in range(3))
        observed = []
        with torch.no_grad():
            for t in range(task.HORIZON):
                observed.append(raw)
                seen[t] = torch.from_numpy(normalize(raw, moments))
                means[t], values[t] = agent(seen[t])
                actions[t] = means[t] + agent.log_std.exp() * torch.randn_like(means[t])
                raw, reward, terminated, truncated, infos = envs.step(actions[t].numpy())
                rewards[t] = torch.from_numpy(reward) * task.REWARD_SCALE
                cuts[t] = torch.from_numpy(terminated | truncated)
                for row in truncated.nonzero()[0]:
                    last = normalize(infos["final_obs"][row][None], moments)
                    bootstrap[t, row] = agent(torch.from_numpy(last))[1][0]
            values[-1] = agent(torch.from_numpy(normalize(raw, moments)))[1]
            old_std = agent.log_std.exp()
            old_log_prob = agent.log_prob(actions, means).flatten()
        gained = advantages(rewards, values, cuts, bootstrap)
        targets = (gained + values[:-1]).flatten()
        gained = ((gained - gained.mean()) / (gained.std() + 1e-8)).flatten()
        x, a, m = seen.flatten(0, 1), actions.flatten(0, 1), means.flatten(0, 1)
        for _ in range(task.PASSES):
            moved = 0.0
            for batch in torch.randperm(task.FRAMES).view(-1, task.MINIBATCH):
                mean, value = agent(x[batch])
                ratio = (agent.log_prob(a[batch], mean) - old_log_prob[batch]).exp()
                clipped = ratio.clamp(1 - task.CLIP, 1 + task.CLIP)
                loss = -torch.min(ratio * gained[batch], clipped * gained[batch]).mean()
                loss = loss + 0.5 * (value - targets[batch]).square().mean()
                optimizer.zero_grad()
                loss.backward()
                nn.utils.clip_grad_norm_(agent.parameters(), task.GRADIENT_NORM)
                optimizer.step()
                with torch.no_grad():
                    std = agent.log_std.exp()
                    spread = (old_std**2 + (m[batch] - mean) ** 2) / (2.0 * std**2)
                    moved += float((std.log() - old_std.log() + spread - 0.5).sum(-1).mean())
            moved *= task.MINIBATCH / task.FRAMES
            rate *= 1 / 1.5 if moved > 2.0 * task.TARGET_KL else 1.5 if moved < 0.5 * task.TARGET_KL else 1.0
            rate = min(max(rate, 2e-5), 1e-3)
            optimizer.param_groups[0]["lr"] = rate
        if not math.isfinite(moved):
            raise FloatingPointError("training has diverged")
        moments = moments.merged(Moments.of(np.concatenate(observed)))
        frames += task.FRAMES


if __name__ == "__main__":
    main()
