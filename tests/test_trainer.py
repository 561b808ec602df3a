"""ACA in TorchRL's Trainer: the official order of steps, a whole training, and its state."""

from __future__ import annotations

from copy import deepcopy
from types import SimpleNamespace

import pytest
import torch
from torchrl.collectors import Collector
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
from torchrl.envs import GymEnv
from torchrl.objectives import SoftUpdate
from torchrl.trainers import ReplayBufferTrainer, TargetNetUpdaterHook, Trainer

from loss_cases import make_data, make_loss
from torchrl_aca import ACALoss, CriticGuidedDenoisingActor, NoiseLevelCritic, NoiseSchedule
from torchrl_aca.trainer import ACAOptimizationStepper


def optimisers(loss: ACALoss) -> tuple[torch.optim.Optimizer, torch.optim.Optimizer]:
    critic = torch.optim.Adam(loss.qvalue_network.parameters(), lr=1e-2)
    return critic, torch.optim.Adam([loss.log_alpha], lr=3e-2)


def trainer_of(loss: ACALoss, clip_norm=None, clip_grad_norm=True) -> SimpleNamespace:
    return SimpleNamespace(loss_module=loss, clip_norm=clip_norm, clip_grad_norm=clip_grad_norm)


def test_the_steps_are_those_of_the_official_code_in_its_order():
    torch.manual_seed(0)
    loss = make_loss()
    by_hand = deepcopy(loss)
    stepper = ACAOptimizationStepper(*optimisers(loss), noise_level_interval=2, alpha_interval=3)
    critic, alpha = optimisers(by_hand)
    batches = [make_data(6, draws=True) for _ in range(4)]
    for number, batch in enumerate(batches):
        metrics = stepper.step(trainer_of(loss), batch)
        for name, every, optimizer in (
            ("qvalue", 1, critic),
            ("noise_level", 2, critic),
            ("alpha", 3, alpha),
        ):
            if number % every == 0:
                optimizer.zero_grad()
                by_hand.zero_grad()
                by_hand(batch)[f"loss_{name}"].backward()
                optimizer.step()
        for mine, other in zip(loss.parameters(), by_hand.parameters(), strict=True):
            torch.testing.assert_close(mine, other)
        assert {"loss_qvalue", "loss_noise_level", "loss_alpha"} <= set(metrics.keys())
        assert not any(value.requires_grad for value in metrics.values())


def test_a_restored_stepper_goes_on_with_its_count_and_optimisers():
    torch.manual_seed(0)
    loss = make_loss()
    stepper = ACAOptimizationStepper(*optimisers(loss), alpha_interval=3)
    batches = [make_data(6, draws=True) for _ in range(5)]
    for batch in batches[:2]:
        stepper.step(trainer_of(loss), batch)
    other = deepcopy(loss)
    resumed = ACAOptimizationStepper(*optimisers(other), alpha_interval=3)
    resumed.load_state_dict(deepcopy(stepper.state_dict()))
    for batch in batches[2:]:
        metrics = stepper.step(trainer_of(loss), batch)
        again = resumed.step(trainer_of(other), batch)
        assert metrics.keys() == again.keys() and (metrics == again).all()
    for mine, theirs in zip(loss.parameters(), other.parameters(), strict=True):
        assert torch.equal(mine, theirs)


def test_a_guidance_weight_that_tunes_itself_moves():
    torch.manual_seed(0)
    loss = make_loss(guidance_weight="auto", num_target_candidates=4)
    before = loss.guidance_weight.clone()
    stepper = ACAOptimizationStepper(*optimisers(loss))
    metrics = stepper.step(trainer_of(loss), make_data(6))
    assert loss.actor_network.guidance_weight != before
    assert metrics["guidance_weight"] == loss.guidance_weight.float()


@pytest.mark.parametrize("by_norm", [True, False])
def test_the_trainers_clip_norm_bounds_each_step(by_norm):
    torch.manual_seed(0)
    loss, bound = make_loss(), 1e-3
    before = [param.detach().clone() for param in loss.qvalue_network.parameters()]
    critic = torch.optim.SGD(loss.qvalue_network.parameters(), lr=1.0)
    alpha = torch.optim.SGD([loss.log_alpha], lr=1.0)
    stepper = ACAOptimizationStepper(critic, alpha)
    stepper.updates = 1  # an update without a noise-level step
    stepper.step(trainer_of(loss, bound, by_norm), make_data(6, draws=True))
    after = loss.qvalue_network.parameters()
    moved = torch.cat([(a - b).flatten() for a, b in zip(after, before, strict=True)]).abs()
    size = moved.norm() if by_norm else moved.max()
    torch.testing.assert_close(size.detach(), torch.tensor(bound), rtol=1e-3, atol=0.0)


@pytest.mark.parametrize("name", ["noise_level_interval", "alpha_interval"])
def test_an_interval_below_one_is_told(name):
    with pytest.raises(ValueError, match=f"{name}.*0"):
        ACAOptimizationStepper(*optimisers(make_loss()), **{name: 0})


def test_a_trainer_trains_with_it():
    torch.manual_seed(0)
    env = GymEnv("Pendulum-v1")
    critic = NoiseLevelCritic(observation_dim=3, action_dim=1, num_steps=4, num_cells=(16, 16))
    actor = CriticGuidedDenoisingActor(
        critic, NoiseSchedule.cosine(4), spec=env.action_spec_unbatched, num_candidates=2
    )
    loss = ACALoss(actor)
    before = [param.clone() for param in loss.parameters()]
    targets = loss.target_qvalue_network_params.clone()
    stepper = ACAOptimizationStepper(*optimisers(loss))
    trainer = Trainer(
        collector=Collector(
            env,
            actor,
            frames_per_batch=20,
            total_frames=60,
            auto_register_policy_transforms=False,
        ),
        total_frames=60,
        frame_skip=1,
        optim_steps_per_batch=2,
        loss_module=loss,
        optimization_stepper=stepper,
        progress_bar=False,
    )
    buffer = TensorDictReplayBuffer(storage=LazyTensorStorage(100), batch_size=8)
    ReplayBufferTrainer(buffer, batch_size=8, flatten_tensordicts=True).register(trainer)
    TargetNetUpdaterHook(SoftUpdate(loss, tau=0.1)).register(trainer, "target_net_updater")
    trainer.train()
    assert stepper.updates == 6
    assert not any(torch.equal(a, b) for a, b in zip(before, loss.parameters(), strict=True))
    moved = loss.target_qvalue_network_params.flatten_keys()
    assert any(not torch.equal(moved[k], v) for k, v in targets.flatten_keys().items())
