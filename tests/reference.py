"""What the tests against reference numbers share: the recording, and the official update."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from tensordict import TensorDict
from torchrl.objectives import SoftUpdate

from torchrl_aca import ACALoss, CriticGuidedDenoisingActor, NoiseLevelCritic, NoiseSchedule
from torchrl_aca.interop import load_official, to_official

CRITICS = ("q1", "q2")
TARGETS = ("target_q1", "target_q2")


def load_recording():
    """The arrays recorded from the official implementation; `data/README.md` describes them."""
    with np.load(Path(__file__).parent / "data/aca_update.npz") as file:
        return {key: file[key] for key in file.files}


def subtree(recording, prefix):
    """The arrays below ``prefix/``, floating ones in float64."""
    arrays = {k[len(prefix) + 1 :]: v for k, v in recording.items() if k.startswith(prefix + "/")}
    return {k: v.astype(float) if v.dtype.kind == "f" else v for k, v in arrays.items()}


def assert_within(actual, expected, tolerance, what):
    error = np.max(np.abs(actual - expected))
    assert error < tolerance, f"{what}: worst absolute error {error:.2e}, allowed {tolerance:.0e}"


def make_critic(members, action_dim, num_steps, first_level, dtype):
    """A critic with the sizes and the parameters of ``members``, named as in the official code."""
    biases = [len(members[0][key]) for key in members[0] if key.endswith(".b")]
    embedding_dim, hidden = biases[1], biases[2:-1]
    critic = NoiseLevelCritic(
        len(members[0]["linear_2.w"]) - action_dim - embedding_dim,
        action_dim,
        num_steps=num_steps,
        num_cells=hidden,
        embedding_dim=embedding_dim,
        first_level=first_level,
        dtype=dtype,
    )
    return load_official(critic, *members)


class OfficialAgent:
    """The official update, composed of the package's and of TorchRL's parts."""

    def __init__(
        self, critics, targets, log_alpha, action_dim, num_steps, *,
        first_level=0, dtype=torch.float64, noise_level_target="mean", **actor_kwargs,
    ):  # fmt: skip
        self.dtype, self.first_level = dtype, first_level
        sizes = (action_dim, num_steps, first_level, dtype)
        self.critic = make_critic(critics, *sizes)
        schedule = NoiseSchedule.cosine(num_steps)
        self.actor = CriticGuidedDenoisingActor(self.critic, schedule, **actor_kwargs)
        self.actor.log_alpha.data.fill_(log_alpha)
        self.loss = ACALoss(self.actor, noise_level_target=noise_level_target)
        # TorchRL would keep a Python float in float32.
        self.loss.make_value_estimator(gamma=np.float64(0.99))
        self.updater = SoftUpdate(self.loss, tau=0.005)
        initial_targets = TensorDict.from_module(make_critic(targets, *sizes))
        self.loss.target_qvalue_network_params.data.update_(initial_targets.data)
        self.critic_optimizer = torch.optim.Adam(self.critic.parameters(), lr=1e-3)
        self.alpha_optimizer = torch.optim.Adam([self.actor.log_alpha], lr=3e-2)

    def tensor(self, array):
        tensor = torch.as_tensor(array)
        return tensor.to(self.dtype) if tensor.is_floating_point() else tensor

    @torch.no_grad()
    def greedy_action(self, obs, draws):
        """Best of the candidates that the given draws lead to."""
        obs = self.tensor(obs)
        noise = np.concatenate([draws["initial_noise"][None], draws["step_noise"]])
        return self.actor.select(obs, self.actor.denoise(obs, self.tensor(noise)))

    @torch.no_grad()
    def action(self, obs, draws):
        """The greedy action with exploration noise."""
        scale = self.actor.exploration_noise * self.actor.log_alpha.exp()
        return self.greedy_action(obs, draws) + scale * self.tensor(draws["exploration_noise"])

    def data(self, batch, draws):
        """The batch and its draws as the loss takes them."""
        size, t = [len(batch["obs"])], self.tensor
        done = t(batch["done"]).bool().view(-1, 1)
        following = {"observation": t(batch["next_obs"]), "reward": t(batch["reward"]).view(-1, 1)}
        following |= {"done": done, "terminated": done}
        return TensorDict(
            observation=t(batch["obs"]),
            action=t(batch["action"]),
            next_action=self.action(batch["next_obs"], draws),
            # `t` counts the noisy levels from `first_level`, as the oracle and the recording do.
            noise_level=torch.as_tensor(draws["t"]).long() + 1 - self.first_level,
            noise=t(draws["noise"]),
            next=TensorDict(following, batch_size=size),
            batch_size=size,
        )

    def update(self, batch, draws, i):
        """Update ``i``; returns the sums over the critics of the two losses."""
        data = self.data(batch, draws)
        td = self.loss.qvalue_loss(data)["loss_qvalue"]
        self.step(self.critic_optimizer, td)
        noisy = self.loss.noise_level_loss(data)["loss_noise_level"]
        if i % 2 == 0:
            self.step(self.critic_optimizer, noisy)
        self.updater.step()
        if i % 250 == 0:
            self.step(self.alpha_optimizer, self.loss.alpha_loss()["loss_alpha"])
        return {"td": td.item(), "noise_level": noisy.item()}

    @staticmethod
    def step(optimizer, loss):
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()

    def critics(self):
        return to_official(self.critic)

    @torch.no_grad()
    def targets(self):
        with self.loss.target_qvalue_network_params.to_module(self.critic):
            return to_official(self.critic)

    def gradients(self):
        """The gradients of the critics, named and shaped as their parameters."""
        params = TensorDict.from_module(self.critic)
        with params.apply(lambda p: p.grad).to_module(self.critic):
            return to_official(self.critic)
