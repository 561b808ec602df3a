"""The small agents and batches that the tests of the loss share."""

from __future__ import annotations

import torch
from tensordict import TensorDict
from torchrl.objectives import SoftUpdate

from torchrl_aca import ACALoss, CriticGuidedDenoisingActor, NoiseLevelCritic, NoiseSchedule

OBSERVATION_DIM, ACTION_DIM, NUM_STEPS = 3, 2, 4


def make_actor(critic=None, *, first_level=1, **kwargs):
    if critic is None:
        critic = NoiseLevelCritic(
            OBSERVATION_DIM,
            ACTION_DIM,
            num_steps=NUM_STEPS,
            num_cells=(16, 16),
            first_level=first_level,
        )
    kwargs = {"num_candidates": 3, **kwargs}
    return CriticGuidedDenoisingActor(critic, NoiseSchedule.cosine(NUM_STEPS), **kwargs)


def make_loss(actor=None, **kwargs):
    """A loss whose targets differ from the online parameters, so that a mix-up shows."""
    loss = ACALoss(actor or make_actor(), **kwargs)
    if loss.delay_qvalue:
        SoftUpdate(loss, tau=0.1)
        for param in loss.target_qvalue_network_params.values(True, True):
            param.data.add_(0.1 * torch.randn_like(param))
    return loss


def make_data(*batch, terminated=False, draws=False):
    """Random transitions of batch shape ``batch``; with ``draws``, nothing is left to chance."""
    flag = torch.full((*batch, 1), terminated)
    following = {
        "observation": torch.randn(*batch, OBSERVATION_DIM),
        "reward": torch.randn(*batch, 1),
        "done": flag,
        "terminated": flag.clone(),
    }
    data = TensorDict(
        observation=torch.randn(*batch, OBSERVATION_DIM),
        action=torch.rand(*batch, ACTION_DIM) * 2 - 1,
        next=TensorDict(following, batch_size=batch),
        batch_size=batch,
    )
    if draws:
        data["noise_level"] = torch.randint(1, NUM_STEPS + 1, batch)
        data["noise"] = torch.randn(*batch, ACTION_DIM)
        data["next_action"] = torch.rand(*batch, ACTION_DIM) * 2 - 1
    return data


def total(losses):
    """The paper's summed objective."""
    return sum(value for key, value in losses.items() if key.startswith("loss_"))


def set_constant(loss, online, target):
    """Make every online value equal to ``online`` and every target value to ``target``."""
    for params, value in (
        (loss.qvalue_network_params, online),
        (loss.target_qvalue_network_params, target),
    ):
        params["value", "weight"].data.zero_()
        params["value", "bias"].data.fill_(value)
