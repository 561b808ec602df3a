"""DIPO against NumPy: the action gradient, the target, the imitation, and what is detached."""

from __future__ import annotations

import numpy as np
import pytest
import torch

import oracle
from torchrl_aca.baselines.dipo import improve_actions
from torchrl_aca.chain import StepRunner

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
