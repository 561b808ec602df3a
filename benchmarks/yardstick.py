"""The straightforward way to sample target actions and to update, to measure the package against.

Two critics, each a plain MLP on the concatenation of observation, action and level features;
PyTorch's own Mish; the gradient by `torch.autograd.grad` of the sum; all rows at once.
"""

from __future__ import annotations

import copy
from itertools import chain, pairwise

import torch
from tensordict import TensorDict
from torch import Tensor, nn

from torchrl_aca import NoiseSchedule
from torchrl_aca.chain import posterior_step
from torchrl_aca.functional import sinusoidal_embedding


class PlainCritic(nn.Module):
    """One critic Q(s, a_t, t) as most would write it first."""

    def __init__(self, observation_dim: int, action_dim: int, width: int = 256) -> None:
        super().__init__()
        self.level = nn.Sequential(nn.Linear(16, 32), nn.Mish(), nn.Linear(32, 16))
        sizes = [observation_dim + action_dim + 16, width, width, width]
        layers = [(nn.Linear(i, o), nn.Mish()) for i, o in pairwise(sizes)]
        self.net = nn.Sequential(*chain(*layers), nn.Linear(width, 1))

    def forward(self, observation: Tensor, action: Tensor, level: Tensor) -> Tensor:
        features = self.level(sinusoidal_embedding(level.to(action.dtype), 16))
        return self.net(torch.cat([observation, action, features], -1)).squeeze(-1)


class PlainAgent:
    """Best of N by guided denoising on two `PlainCritic`s, and their update."""

    def __init__(self, observation_dim: int, action_dim: int, num_steps: int = 20) -> None:
        self.critics = nn.ModuleList(PlainCritic(observation_dim, action_dim) for _ in range(2))
        self.targets = copy.deepcopy(self.critics)
        self.optimizer = torch.optim.Adam(self.critics.parameters(), lr=1e-3)
        self.schedule, self.action_dim = NoiseSchedule.cosine(num_steps), action_dim

    def sample(self, observation: Tensor, num_candidates: int) -> Tensor:
        """Actions of shape (B, A) for observations of shape (B, O)."""
        rows = observation.repeat(num_candidates, 1)
        action = torch.randn(len(rows), self.action_dim)
        for level in range(self.schedule.num_steps, 0, -1):
            action = self._step(rows, action, torch.tensor(level))
        clean = torch.zeros(len(rows), dtype=torch.long)
        with torch.no_grad():
            values = torch.stack([critic(rows, action, clean) for critic in self.critics])
        best = values.amin(0).view(num_candidates, -1).argmax(0)
        candidates = action.view(num_candidates, len(observation), -1)
        return candidates[best, torch.arange(len(observation))]

    def _step(self, rows: Tensor, action: Tensor, level: Tensor) -> Tensor:
        action = action.detach().requires_grad_()
        levels = level.expand(len(rows))
        with torch.enable_grad():
            total = sum(critic(rows, action, levels).sum() for critic in self.critics)
            (gradient,) = torch.autograd.grad(total, action)
        with torch.no_grad():
            gradient = gradient / (gradient.norm(dim=-1, keepdim=True) + 1e-8)
            sigma = self.schedule.posterior_variance[level - 1].sqrt().to(action.dtype)
            predicted_noise = -50.0 * sigma * gradient
            noise = torch.randn_like(action)
            return posterior_step(self.schedule, action, predicted_noise, noise, level)

    def update(self, batch: TensorDict, num_candidates: int) -> None:
        """A TD step, a noise-level step and a step of the target critics."""
        clean = torch.zeros(len(batch), dtype=torch.long)
        following = batch["next", "observation"]
        with torch.no_grad():
            action = self.sample(following, num_candidates)
            value = torch.stack([q(following, action, clean) for q in self.targets]).amin(0)
            alive = 1 - batch["next", "terminated"].squeeze(-1).float()
            target = 0.2 * batch["next", "reward"].squeeze(-1) + 0.99 * alive * value
        self._regress(batch, batch["action"], clean, target)

        level = torch.randint(1, self.schedule.num_steps + 1, (len(batch),))
        noisy = self.schedule.add_noise(batch["action"], torch.randn_like(batch["action"]), level)
        with torch.no_grad():
            values = [q(batch["observation"], batch["action"], clean) for q in self.critics]
        self._regress(batch, noisy, level, torch.stack(values).mean(0))
        with torch.no_grad():
            for old, new in zip(self.targets.parameters(), self.critics.parameters(), strict=True):
                old.lerp_(new, 0.005)

    def _regress(self, batch: TensorDict, action: Tensor, level: Tensor, target: Tensor) -> None:
        values = [critic(batch["observation"], action, level) for critic in self.critics]
        self.optimizer.zero_grad()
        sum((value - target).square().mean() for value in values).backward()
        self.optimizer.step()
