"""The guidance weight that tunes itself: its sign, where it settles, what it does not depend on."""

from __future__ import annotations

import copy
import math

import pytest
import torch
from torch import nn

from loss_cases import make_actor, make_data, make_loss
from torchrl_aca import ACALoss, CriticGuidedDenoisingActor, NoiseLevelCriticBase, NoiseSchedule
from torchrl_aca import functional as F

NUM_STEPS, STEP_SIZE, STATES = 20, 0.02, 64


class Quadratic(NoiseLevelCriticBase):
    """``Q = -curvature |a|^2 / 2`` at every level."""

    action_dim = 2

    def __init__(self, curvature: float = 1.0) -> None:
        super().__init__()
        self.curvature = nn.Parameter(torch.tensor(curvature))

    def encode(self, *observations):
        return observations[0]

    def _evaluate(self, features, action, index):
        return -self.curvature / 2 * action.square().sum(-1, keepdim=True)


def quadratic_loss(weight, curvature=1.0, sampler="langevin", unit=False, **kwargs):
    """An automatic loss with a linear chain: ``a <- (1 - eps w k / 2) a + sqrt(eps) z``."""
    actor = CriticGuidedDenoisingActor(
        Quadratic(curvature), NoiseSchedule.cosine(NUM_STEPS), guidance_weight=weight,
        num_candidates=16, normalize_gradient=unit, sampler=sampler, langevin_step_size=STEP_SIZE,
    )  # fmt: skip
    return ACALoss(actor, guidance_weight="auto", guidance_weight_lr=0.1, **kwargs)


def variance(weight, curvature=1.0):
    """Of that chain's end, by its own recursion from a standard normal start."""
    factor = (1 - STEP_SIZE * weight * curvature / 2) ** 2
    end = factor**NUM_STEPS
    return end + STEP_SIZE * (1 - end) / (1 - factor)


def tune(loss, num_updates):
    """Metrics of the last of so many steps."""
    for _ in range(num_updates):
        data = make_data(STATES)
        loss.sample_next_action(data)
        metrics = loss.step_guidance_weight(data)
    return metrics


# --- the rule -------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("spread", "gain", "step"),
    [
        (0.2, 3.0, math.log(2)),  # too wide, and more guidance helps
        (0.2, 0.1, 0.1),  # too wide, but it hardly helps
        (0.2, -0.4, -0.4),  # too wide because the chain overshoots
        (0.08, 3.0, math.log(0.8)),  # too narrow
        (0.0, 3.0, -1.0),  # all candidates at one place
        (10.0, 7.0, 1.0),
    ],
)
def test_the_step_by_hand(spread, gain, step):
    actual = F.guidance_step(*(torch.tensor(x) for x in (spread, 0.1, gain)))
    assert actual.item() == pytest.approx(step)


def test_the_std_of_an_entropy_by_hand():
    # A Gaussian of std s has H = A (log s + log(2 pi e) / 2); so -0.9 a dimension
    # are s = 0.40657 / 4.13273.
    assert F.entropy_std(torch.tensor(-5.4), 6).item() == pytest.approx(0.09838, abs=1e-5)
    std = F.entropy_std(F.surrogate_entropy(torch.tensor(1.3), 4), 4)
    assert std.item() == pytest.approx(0.1 * math.exp(1.3))


def test_the_spread_by_hand():
    candidates = torch.tensor([[[0.0, 1.0]], [[2.0, 1.0]], [[4.0, 1.0]]])
    assert F.candidate_spread(candidates).tolist() == pytest.approx([math.sqrt((4 + 0) / 2)])


def test_the_gain_by_hand_and_whatever_the_factor_of_the_rewards():
    values = torch.tensor(
        [[[5.0, 7.0]], [[3.0, 4.0]], [[9.0, 1.0]], [[2.0, 3.0]]]
    )  # minima 5 3 1 2
    gain = F.guidance_gain(values, 0.5)
    assert gain.tolist() == pytest.approx([(4.0 - 1.5) / (0.5 * math.sqrt(8.75 / 3))])
    torch.testing.assert_close(F.guidance_gain(1000 * values, 0.5), gain)
    assert F.guidance_gain(torch.ones_like(values), 0.5).item() == 0


# --- where it settles -----------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("weight", "std", "target", "direction"),
    [
        (2.0, 0.85, 0.3, 1),  # too wide
        (29.0, 0.20, 0.3, -1),  # too narrow
        (180.0, 0.24, 0.2, -1),  # too wide, but by overshooting
    ],
)
def test_too_wide_a_spread_raises_the_weight_unless_the_chain_overshoots(
    weight, std, target, direction
):
    assert variance(weight) ** 0.5 == pytest.approx(std, abs=0.005)
    loss = quadratic_loss(weight, target_spread=target)
    tune(loss, 1)
    assert (float(loss.actor_network.guidance_weight) - weight) * direction > 0


@pytest.mark.parametrize("start", [3.0, 30.0, 150.0])
def test_the_spread_of_a_linear_chain_settles_at_its_target(start):
    target = 0.2
    low, high = 1.0, 1 / STEP_SIZE  # here the variance falls from 1 to its least
    for _ in range(60):
        middle = (low + high) / 2
        low, high = (middle, high) if variance(middle) > target**2 else (low, middle)
    torch.manual_seed(0)
    loss = quadratic_loss(start, target_spread=target)
    metrics = tune(loss, 100)
    assert float(loss.actor_network.guidance_weight) == pytest.approx(low, rel=0.1)
    assert metrics["candidate_spread"].item() == pytest.approx(target, rel=0.08)
    assert metrics["guidance_weight"].item() == pytest.approx(loss.guidance_weight.item())


@pytest.mark.parametrize("start", [5.0, 50.0, 500.0])
def test_a_spread_out_of_reach_does_not_drive_the_weight_away(start):
    """With a unit gradient the spread is never below about 0.11, which it has at w = 15 to 20."""
    torch.manual_seed(0)
    loss = quadratic_loss(start, sampler="denoising", unit=True, target_spread=0.01)
    tune(loss, 100)
    assert 12 < float(loss.actor_network.guidance_weight) < 25


def test_without_normalisation_the_policy_does_not_depend_on_the_scale_of_the_rewards():
    weights, spreads = [], []
    for curvature in (0.1, 1.0, 10.0):
        torch.manual_seed(0)
        metrics = tune(quadratic_loss(20.0, curvature, target_spread=0.2), 120)
        weights.append(metrics["guidance_weight"].item() * curvature)
        spreads.append(metrics["candidate_spread"].item())
    assert weights == pytest.approx([weights[1]] * 3, rel=0.05)
    assert spreads == pytest.approx([0.2] * 3, rel=0.08)


# --- its state ------------------------------------------------------------------------------------


def auto_loss(**kwargs):
    return make_loss(make_actor(guidance_weight=7.0), guidance_weight="auto", **kwargs)


def test_a_restored_loss_goes_on_as_if_never_stopped():
    loss, other = auto_loss(), auto_loss()
    tune(loss, 3)
    other.load_state_dict(copy.deepcopy(loss.state_dict()))
    weights = []
    for one in (loss, other):
        torch.manual_seed(1)
        tune(one, 3)
        weights.append(float(one.actor_network.guidance_weight))
    assert weights[0] == weights[1] != 7.0


def test_a_copy_moves_its_own_weight_and_its_actor_follows():
    loss = auto_loss()
    clone = copy.deepcopy(loss)
    tune(clone, 2)
    assert loss.actor_network.guidance_weight == 7
    assert clone.actor_network.guidance_weight is clone.guidance_weight
    assert clone.guidance_weight != 7


@pytest.mark.parametrize("weight", [3.0, torch.tensor(3.0)])
def test_a_weight_given_to_the_loss_is_the_actors(weight):
    loss = auto_loss()
    loss.guidance_weight = weight
    assert loss.guidance_weight is loss.actor_network.guidance_weight
    assert loss.guidance_weight == 3


def test_compiled_chains_follow_the_weight_without_being_compiled_anew():
    loss, compilations = auto_loss(), []

    def backend(graph, inputs):
        compilations.append(graph)
        return graph.forward

    torch._dynamo.reset()
    actor = loss.actor_network
    act = torch.compile(actor.denoise, backend=backend)
    observation, noise = torch.randn(4, 3), torch.randn(5, 3, 4, 2)
    for weight in (7.0, 70.0, 3.0):
        actor.guidance_weight = weight
        torch.testing.assert_close(act(observation, noise), actor.denoise(observation, noise))
    assert len(compilations) == 1


def test_acting_uses_the_weight_itself_and_only_the_target_looks_about(monkeypatch):
    loss, seen = auto_loss(), []
    actor = loss.actor_network
    propose = actor.propose

    def record(features, noise, guidance_weight=None):
        seen.append(guidance_weight)
        return propose(features, noise, guidance_weight)

    monkeypatch.setattr(actor, "propose", record)
    data = make_data(4)
    actor(data.select("observation"))
    loss.sample_next_action(data)
    assert seen[0] is None
    assert [float(w) for w in seen[1:]] == pytest.approx([7 * math.exp(0.1), 7 * math.exp(-0.1)])


def test_a_fixed_weight_stays_and_what_auto_needs_is_told():
    loss, data = make_loss(), make_data(4)
    loss.sample_next_action(data)
    assert data.get("candidate_spread", None) is None
    with pytest.raises(KeyError, match="candidate_spread"):
        loss.step_guidance_weight(data)
    with pytest.raises(ValueError, match="Expected num_target_candidates >= 2, got"):
        auto_loss(num_target_candidates=1)
    with pytest.raises(ValueError, match="guidance_weight_of_the_actor > 0"):
        ACALoss(make_actor(guidance_weight=0.0), guidance_weight="auto")
    with pytest.raises(ValueError, match="Expected guidance_weight to be one of"):
        make_loss(guidance_weight="automatic")


def test_nan_in_terminal_states_moves_no_weight():
    loss, data = make_loss(guidance_weight="auto", num_target_candidates=4), make_data(6)
    data["next", "terminated"][2] = data["next", "done"][2] = True
    data["next", "observation"][2] = torch.nan
    assert loss.qvalue_loss(data)["loss_qvalue"].isfinite()
    keys = loss.tensor_keys
    spread, gain = data[keys.candidate_spread], data[keys.guidance_gain]
    assert spread.isnan().tolist() == gain.isnan().tolist() == [False, False, True] + 3 * [False]
    alone = data[[0, 1, 3, 4, 5]]
    other = copy.deepcopy(loss)
    for each, rows in ((loss, data), (other, alone)):
        each.step_guidance_weight(rows)
    weight = loss.actor_network.guidance_weight
    assert weight != 50 and weight == other.actor_network.guidance_weight
    before = weight.item()
    loss.step_guidance_weight(data[[2]])  # nothing to go by
    assert weight.item() == before
