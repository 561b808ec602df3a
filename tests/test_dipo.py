"""DIPO against NumPy: the action gradient, the target, the imitation, and what is detached."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from torchrl.objectives import SoftUpdate

import oracle
import oracle_diffusion as numpy_of
from agents.dipo import cut_gradients
from loss_cases import HIGH, LOW, NUM_STEPS, make_dipo, make_dipo_data
from o2o_halfcheetah import train as train_with_data
from online_mujoco import train
from recipe_cases import TINY, batch_of, composed
from test_agents import built
from test_diffusion_losses import (
    BATCH,
    EXACT,
    array,
    assert_policy_loss,
    critics_of,
    make_data,
    noised,
    unit,
)
from torchrl_aca import NoiseSchedule
from torchrl_aca.baselines import DiffusionPolicy, DIPOLoss, NoiseNetwork, TwinCritic
from torchrl_aca.baselines.dipo import improve_actions
from torchrl_aca.chain import StepRunner
from torchrl_aca.errors import RunError
from torchrl_aca.training.checkpoint import read_checkpoint

# --- the action gradient --------------------------------------------------------------------------


def oracle_improve(gradient, action, num_steps, lr, max_norm):
    """Adam on minus the value, with the oracle's own step; a fresh state."""
    first = second = np.zeros_like(action)
    for step in range(1, num_steps + 1):
        slope = -gradient(action)
        slope = slope * min(1.0, max_norm / np.sqrt(np.sum(slope**2)))
        action, first, second = oracle.adam_step(action, slope, first, second, step, lr)
        action = np.clip(action, -1, 1)
    return action


def hills(action):
    """Gradient of a bumpy value, for tensors and arrays alike."""
    sin = torch.sin if isinstance(action, torch.Tensor) else np.sin
    return sin(5 * action) - 0.7 * action**2 + 0.2


@pytest.mark.parametrize("max_norm", [0.16, 1e3])
@pytest.mark.parametrize("shape", [(7, 3), (5, 1), (1, 2)])
def test_improved_actions_are_those_of_clipped_adam(shape, max_norm):
    action = torch.rand(shape, dtype=torch.float64) * 2 - 1
    improved = improve_actions(hills, action, num_steps=30, lr=0.03, max_norm=max_norm)
    expected = oracle_improve(hills, action.numpy(), 30, 0.03, max_norm)
    np.testing.assert_allclose(improved, expected, rtol=1e-9, atol=1e-12)


def test_one_step_moves_each_coordinate_by_the_rate_and_stays_in_the_box():
    action = torch.tensor([[0.0, 0.5], [0.99, -1.0]], dtype=torch.float64)
    slope = torch.tensor([[1.0, -2.0], [3.0, -4.0]], dtype=torch.float64)
    improved = improve_actions(lambda action: slope, action, num_steps=1, lr=0.05)
    expected = torch.tensor([[0.05, 0.45], [1.0, -1.0]], dtype=torch.float64)
    torch.testing.assert_close(improved, expected, atol=1e-6, rtol=0)


def test_the_length_of_the_whole_batch_is_cut():
    """Adam's moments see the cut: one large gradient, then small ones, move otherwise."""
    slopes = iter([torch.full((4, 2), 1e3).double(), *[torch.full((4, 2), 0.01).double()] * 4])
    uncut = iter([torch.full((4, 2), 1e3).double(), *[torch.full((4, 2), 0.01).double()] * 4])
    start = torch.full((4, 2), -0.5).double()
    cut = improve_actions(lambda action: next(slopes), start, num_steps=5)
    free = improve_actions(lambda action: next(uncut), start, num_steps=5, max_norm=1e9)
    # With the cut all gradients but the first are as they are, and the first is 0.16 / sqrt(8).
    first = 0.16 / 8**0.5
    expected = oracle_sum([first, *[0.01] * 4], 0.03) - 0.5
    torch.testing.assert_close(cut, torch.full((4, 2), expected).double(), rtol=1e-6, atol=0)
    assert (cut > free + 0.005).all()


def oracle_sum(slopes, lr):
    """How far Adam goes from zero with such gradients."""
    place = first = second = 0.0
    for step, slope in enumerate(slopes, 1):
        place, first, second = oracle.adam_step(place, -slope, first, second, step, lr)
    return place


def test_no_gradient_no_move():
    action = torch.rand(3, 2)
    assert torch.equal(improve_actions(torch.zeros_like, action), action)


def test_a_compiled_step_gives_the_same_actions():
    action = torch.rand(6, 2, dtype=torch.float64)
    expected = improve_actions(hills, action, num_steps=4)
    actual = improve_actions(hills, action, num_steps=4, run=StepRunner(compiled=True))
    torch.testing.assert_close(actual, expected)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"num_steps": 0}, "num_steps >= 1, got num_steps=0"),
        ({"lr": 0.0}, "lr > 0, got lr=0.0"),
        ({"max_norm": -1.0}, "max_norm > 0, got max_norm=-1.0"),
    ],
)
def test_numbers_out_of_range_are_refused(changes, message):
    with pytest.raises(ValueError, match=message):
        improve_actions(hills, torch.zeros(2, 1), **changes)


# --- the losses -----------------------------------------------------------------------------------


def data_of(loss):
    """Transitions with draws, and best actions apart from those that were taken."""
    data = make_data(loss)
    return data.set("best_action", make_dipo_data(BATCH)["best_action"])


def test_actions_climb_the_smaller_critic_of_the_oracle():
    loss = make_dipo(num_gradient_steps=6, action_lr=0.05, action_max_norm=0.4)
    data = data_of(loss)
    before, state = data.clone(), array(data["observation"])

    def gradient(action):
        return numpy_of.score_target(critics_of(loss), state, action, 1.0, "min")

    improved = loss.improve(data)
    expected = oracle_improve(gradient, array(unit(data["best_action"])), 6, 0.05, 0.4)
    np.testing.assert_allclose(array(unit(improved)), expected, rtol=1e-7, atol=1e-9)
    assert (data == before).all() and not improved.requires_grad
    assert all(p.grad is None for p in loss.parameters())


def test_improved_actions_are_worth_more_and_stay_within_the_bounds():
    loss = make_dipo(num_gradient_steps=30)
    data = data_of(loss)
    critic, state = loss.qvalue_network, data["observation"]
    before = critic(state, unit(data["best_action"])).amin(-1)
    for _ in range(5):
        data["best_action"] = loss.improve(data)
    assert (critic(state, unit(data["best_action"])).amin(-1) > before).all()
    assert ((data["best_action"] >= LOW) & (data["best_action"] <= HIGH)).all()


def test_the_policy_imitates_the_best_actions_as_in_the_oracle():
    loss = make_dipo()
    data = data_of(loss)
    best = array(unit(data["best_action"]))
    noisy, _ = noised(best, data, loss.actor_network.schedule)
    level = array(data["noise_level"]).astype(int)
    output, saved = numpy_of.policy(loss.policy_network, array(data["observation"]), noisy, level)
    expected, upstream = numpy_of.regression(output, array(data["noise"]), 0.5)
    out = loss.actor_loss(data)
    assert_policy_loss(loss, out["loss_actor"], saved, upstream, expected)
    moved = np.abs(best - array(unit(data["action"]))).mean()
    np.testing.assert_allclose(out["improvement"].item(), moved, **EXACT)


def test_without_a_best_action_the_action_taken_is_the_best():
    loss = make_dipo()
    data = data_of(loss)
    data["best_action"] = data["action"]
    expected = loss.actor_loss(data)["loss_actor"], loss.improve(data)
    data = data.exclude("best_action")
    torch.testing.assert_close((loss.actor_loss(data)["loss_actor"], loss.improve(data)), expected)


def test_the_target_is_of_the_policys_moving_average():
    loss, data = make_dipo(), make_dipo_data(BATCH)
    torch.manual_seed(3)
    expected = loss.qvalue_loss(data)["loss_qvalue"]
    torch.manual_seed(3)
    data["next_action"] = loss.average_actor_network.sample(data["next", "observation"])
    assert loss.qvalue_loss(data)["loss_qvalue"] == expected
    torch.manual_seed(3)
    data["next_action"] = loss.actor_network.sample(data["next", "observation"])
    assert (loss.qvalue_loss(data)["loss_qvalue"] - expected).abs() > 1e-6


@pytest.mark.parametrize(
    ("kwargs", "message"),
    [
        ({"num_gradient_steps": 0}, "num_gradient_steps >= 1"),
        ({"action_lr": 0.0}, "action_lr > 0"),
        ({"action_max_norm": 0.0}, "action_max_norm > 0"),
    ],
)
def test_settings_out_of_range_are_refused(kwargs, message):
    with pytest.raises(ValueError, match=message):
        DIPOLoss(make_dipo().actor_network, **kwargs)


def test_one_action_dimension_and_equal_critics():
    policy = DiffusionPolicy(
        NoiseNetwork(3, 1, num_steps=NUM_STEPS, num_cells=(6,), embedding="sinusoidal"),
        NoiseSchedule.cosine(NUM_STEPS),
        critic=TwinCritic(3, 1, num_cells=(6,)),
    )
    for param in policy.critic.parameters():
        param.data[1] = param.data[0]
    loss = DIPOLoss(policy)
    SoftUpdate(loss, tau=0.1)
    data = make_dipo_data(BATCH)
    data = data.apply(lambda x: x.float() if x.is_floating_point() else x)
    for key in ("action", "best_action"):
        data[key] = data[key][:, :1].clamp(-1, 1)
    assert all(value.isfinite() for value in loss(data).values())
    assert loss.improve(data).isfinite().all()


def test_an_update_reads_no_value_and_stays_on_its_device():
    """As a CUDA graph asks: on the device `meta`, which has no values, both would raise."""
    loss = DIPOLoss(make_dipo().actor_network.to("meta"))
    data = make_dipo_data(BATCH).to("meta")
    data["best_action"] = loss.improve(data)
    for name in ("qvalue", "actor"):
        getattr(loss, f"{name}_loss")(data)[f"loss_{name}"].backward()
    devices = {param.grad.device.type for param in loss.parameters() if param.requires_grad}
    assert devices == {"meta"} == {data["best_action"].device.type}


# --- the agent ------------------------------------------------------------------------------------


def test_each_network_has_its_gradient_cut_alone():
    stack = torch.nn.Parameter(torch.zeros(2, 3, 4)), torch.nn.Parameter(torch.zeros(2, 1, 4))
    optimizer = torch.optim.SGD(stack, lr=1.0)
    cut_gradients(optimizer, 2.0, stacked=True)
    long, short = torch.randn(16), 0.1 * torch.randn(16)
    for gradients in (torch.stack([long, short]), torch.stack([short, 9 * long])):
        stack[0].grad, stack[1].grad = gradients[:, :12].view(2, 3, 4), gradients[:, 12:, None].mT
        before = [param.detach().clone() for param in stack]
        optimizer.step()
        moved = [a - b for a, b in zip(before, stack, strict=True)]
        for member, gradient in enumerate(gradients):
            got = torch.cat([part[member].flatten() for part in moved])
            expected = gradient * min(1.0, 2.0 / gradient.norm().item())
            torch.testing.assert_close(got, expected)


def test_a_single_network_is_cut_as_a_whole():
    parameters = [torch.nn.Parameter(torch.zeros(3, 4)), torch.nn.Parameter(torch.zeros(3))]
    optimizer = torch.optim.SGD(parameters, lr=1.0)
    cut_gradients(optimizer, 0.5, stacked=False)
    for parameter in parameters:
        parameter.grad = torch.ones_like(parameter)
    optimizer.step()
    for parameter in parameters:
        torch.testing.assert_close(parameter.data, torch.full_like(parameter, -0.5 / 15**0.5))


def test_critics_are_followed_at_every_update_and_the_policy_at_every_second():
    agent = built("dipo")
    loss, moved = agent.state["loss"], []
    for number in range(4):
        before = {
            name: getattr(loss, f"target_{name}_params").clone()
            for name in ("qvalue_network", "policy_network")
        }
        agent.update(batch_of(number))
        for name, target in before.items():
            expected = target.lerp(getattr(loss, f"{name}_params").data, 0.005)
            after = getattr(loss, f"target_{name}_params")
            if (after == target).all():
                continue
            torch.testing.assert_close(after.data, expected.data)
            moved.append((number, name[:6]))
    assert moved == [(0, "qvalue"), (0, "policy"), (1, "qvalue"), (2, "qvalue"), (2, "policy"),
                     (3, "qvalue")]  # fmt: skip


def test_a_run_keeps_improved_actions_in_the_rows_that_it_sampled(tmp_path):
    run_dir = tmp_path / "run"
    train(composed(*TINY["dipo"], f"run_dir={run_dir}", "optim.total_updates=10"))
    rows = read_checkpoint(run_dir)["parts"]["buffer"]["rows"]
    moved = (rows["best_action"] - rows["action"]).abs().amax(-1)
    # Ten batches of 16 of some 250 rows; a step moves a coordinate about 0.03, and there are five.
    assert 80 < (moved > 0).sum() < 160
    assert moved.max() > 0.1


def test_a_mixture_is_refused_before_any_work(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    cfg = composed(
        "algo=dipo", "dataset=nowhere", "generate={tier: random}", name="o2o_halfcheetah"
    )
    with pytest.raises(
        RunError, match="algo.name='dipo': expected one of .'aca'.*changes the rows"
    ):
        train_with_data(cfg)
    assert not list(tmp_path.iterdir())
