"""What every loss of the package must do, whatever its method: TorchRL's contract, and ours."""

from __future__ import annotations

import copy
import pickle
import warnings
from functools import partial

import pytest
import torch
from tensordict import TensorDict
from torch import nn
from torchrl.modules import ValueOperator
from torchrl.objectives import HardUpdate, SoftUpdate

from loss_cases import (
    ACTION_DIM,
    CASES,
    LANGEVIN,
    OBSERVATION_DIM,
    make_actor,
    make_diffusion_policy,
    make_policy,
)
from torchrl_aca import ACALoss
from torchrl_aca.baselines import (
    DACERLoss,
    DiffusionPolicyLoss,
    DIPOLoss,
    EnsembleMLP,
    EnsembleSACLoss,
    QSMLoss,
    QVPOLoss,
    SDACLoss,
    TwinCritic,
    dacer,
)
from torchrl_aca.baselines.gmm import fit_gmm
from torchrl_aca.tuning import OpenLoopAlpha

NEXT_KEYS = ("reward", "done", "terminated")
COPIES = {"deepcopy": copy.deepcopy, "pickle": lambda loss: pickle.loads(pickle.dumps(loss))}
CRITICS, TARGETS = "qvalue_network_params", "target_qvalue_network_params"


@pytest.fixture(params=CASES)
def case(request):
    return CASES[request.param]


def seeded(function, *arguments, seed=5):
    """``function(*arguments)``, on a copy of its data, from the same draws each time."""
    torch.manual_seed(seed)
    return function(*[a.clone() if isinstance(a, TensorDict) else a for a in arguments])


def total(case, losses):
    return sum(losses[key] for key in case.losses)


def next_key(key):
    return ("next", key) if isinstance(key, str) else ("next", *key)


def assert_tied(loss):
    """``qvalue_network`` holds the loss's parameters and buffers, and each is listed once."""
    network, params = loss.qvalue_network, loss.qvalue_network_params
    assert {id(p) for p in network.parameters()} == {id(p) for p in params.parameters()}
    assert {b.data_ptr() for b in network.buffers()} == {b.data_ptr() for b in params.buffers()}
    for named in (loss.named_parameters, loss.named_buffers):
        tensors = [tensor.data_ptr() for _, tensor in named()]
        assert len(tensors) == len(set(tensors))
    if hasattr(loss, "average_actor_network"):
        average, targets = loss.average_actor_network, loss.target_policy_network_params
        tied = {p.data_ptr() for p in average.network.parameters()}
        assert tied == {p.data_ptr() for p in targets.values(True, True)}
        assert average.critic is network and average.log_alpha is loss.actor_network.log_alpha
    if isinstance(loss, ACALoss):
        actor = loss.actor_network
        assert actor.critic is network and actor.log_alpha is loss.log_alpha
        assert actor.guidance_weight is loss.guidance_weight
    if isinstance(loss, DiffusionPolicyLoss):
        actor, params = loss.actor_network, loss.policy_network_params
        assert actor.critic is network and actor.network is loss.policy_network
        assert {id(p) for p in actor.network.parameters()} == {id(p) for p in params.parameters()}
        assert actor.log_alpha is getattr(loss, "log_alpha", actor.log_alpha)
        if loss.average_policy:
            average = {p.data_ptr() for p in loss.average_actor_network.network.parameters()}
            targets = loss.target_policy_network_params.values(True, True)
            assert average == {p.data_ptr() for p in targets}


# --- what it reads and writes ---------------------------------------------------------------------


def test_forward_gives_losses_and_metrics_and_leaves_every_given_value_as_it_was(case):
    loss, data = case.make(), case.data(6)
    before = data.clone()
    out = loss(data)
    assert set(out.keys()) == set(loss.out_keys) == case.losses | case.metrics
    for key, value in out.items():
        assert value.shape == () and value.requires_grad == (key in case.losses)
    assert set(data.keys(True, True)) - set(before.keys(True, True)) == case.written
    assert (data.select(*before.keys(True, True)) == before).all()


def test_each_loss_alone_equals_its_share_of_forward(case):
    loss, data = case.make(), case.data(6)
    whole = seeded(loss, data)
    torch.manual_seed(5)
    alone = TensorDict()
    for part in case.parts:
        alone.update(getattr(loss, part)(data))
    torch.testing.assert_close(alone, whole, rtol=0, atol=0)


def test_no_gradient_reaches_a_target_and_each_parameter_has_one(case):
    loss = case.make()
    total(case, loss(case.data(30))).backward()
    assert all(p.grad is not None and p.grad.abs().sum() > 0 for p in loss.parameters())
    targets = list(getattr(loss, TARGETS).values(True, True))
    assert targets and all(not p.requires_grad and p.grad is None for p in targets)


@pytest.mark.parametrize("batch", [(6,), (2, 3)])
def test_reductions_agree_with_one_another(case, batch):
    loss, data, out = case.make(), case.data(*batch), {}
    for reduction in ("none", "mean", "sum"):
        loss.reduction, loss.out_keys = reduction, None
        out[reduction] = seeded(loss, data)
    assert out["none"].batch_size == batch and set(out["none"].keys()) == case.losses
    for key in case.losses:
        assert out["none"][key].shape == batch
        torch.testing.assert_close(out["none"][key].mean(), out["mean"][key])
        # ACA's and SDAC's loss of alpha depends on no row.
        rows = 1 if key == "loss_alpha" and isinstance(loss, OpenLoopAlpha) else 6
        torch.testing.assert_close(out["sum"][key], rows * out["mean"][key])


@pytest.mark.parametrize("key", [("collector", "mask"), "valid", ("deep", "valid"), None], ids=str)
def test_masked_rows_count_for_nothing(case, key):
    loss, data = case.make(reduction="none"), case.data(6)
    rows = seeded(loss, data)
    loss.reduction, loss.loss_mask_key = "mean", key
    valid = torch.tensor([True, False, True, True, False, True])
    data[key or ("collector", "mask")] = valid  # with None, masks are switched off
    if key:
        data["next", "reward"][~valid] = 1e6
    out = seeded(loss, data)
    for name in case.losses:
        torch.testing.assert_close(out[name], rows[name][valid if key else ...].mean())


# --- keys -----------------------------------------------------------------------------------------

KEYS = [(name, key) for name in CASES for key in vars(CASES[name].make().tensor_keys)]


@pytest.mark.parametrize("new", ["other", ("deep", "other")], ids=["flat", "nested"])
@pytest.mark.parametrize(("name", "key"), [pair for pair in KEYS if "state_action" not in pair[1]])
def test_set_keys_renames_what_is_read_and_written(name, key, new):
    case = CASES[name]
    loss, data = case.make(), case.data(6)
    if key == "priority_weight":
        data["priority_weight"] = torch.rand(6)
    expected, old = seeded(loss, data), getattr(loss.tensor_keys, key)
    loss.set_keys(**{key: new})
    source, target = (next_key(old), next_key(new)) if key in NEXT_KEYS else (old, new)
    if source in data.keys(True):
        data.rename_key_(source, target)
    assert old not in data.keys(True) or key == "value"
    torch.manual_seed(5)
    torch.testing.assert_close(loss(data), expected, rtol=0, atol=0)
    if old in case.written:
        assert data[new].shape == (6,) and old not in data
    if key in NEXT_KEYS:
        assert target in loss.in_keys


def test_set_keys_refuses_an_unknown_key_and_none_restores_a_default(case):
    loss = case.make()
    with pytest.raises(ValueError, match="unknown_key"):
        loss.set_keys(unknown_key="other")
    loss.set_keys(reward="other")
    loss.set_keys(reward=None)
    assert loss.tensor_keys.reward == "reward"


def test_keys_of_states_and_actions_are_those_of_the_networks_and_may_be_nested(case):
    state, action = ("agent", "state"), ("agent", "act")
    expected_loss, data = seeded(case.make), case.data(6)
    expected = seeded(expected_loss, data)
    loss = seeded(lambda: case.make(state=state, action=action))
    data.rename_key_("action", action)
    data.rename_key_("observation", state)
    data.rename_key_(("next", "observation"), next_key(state))
    torch.testing.assert_close(seeded(loss, data), expected)
    assert {state, action, next_key(state)} <= set(loss.in_keys)


def as_kwargs(loss, data):
    return {k if isinstance(k, str) else "_".join(k): data[k] for k in loss.in_keys}


@pytest.mark.parametrize("reduction", ["mean", "none"])
def test_keyword_arguments_give_what_a_tensordict_gives(case, reduction):
    loss, data = case.make(reduction=reduction), case.data(6)
    loss.set_keys(reward=("deep", "reward"))
    data.rename_key_(("next", "reward"), ("next", "deep", "reward"))
    expected = seeded(loss, data.select(*loss.in_keys))
    values = seeded(lambda: loss(**as_kwargs(loss, data)))
    for key, value in zip(loss.out_keys, values, strict=True):
        torch.testing.assert_close(value, expected[key], rtol=0, atol=0)


def test_select_out_keys_leaves_the_chosen_ones(case):
    loss, data = case.make(), case.data(6)
    expected = seeded(loss, data.select(*loss.in_keys))
    chosen = "loss_qvalue", min(case.metrics)
    loss.select_out_keys(*chosen)
    values = seeded(lambda: loss(**as_kwargs(loss, data)))
    assert values == tuple(expected[key] for key in chosen)


IN_KEYS = [(name, key) for name in CASES for key in CASES[name].make().in_keys]


@pytest.mark.parametrize(("name", "key"), IN_KEYS, ids=str)
def test_a_missing_entry_is_named(name, key):
    case = CASES[name]
    with pytest.raises(KeyError, match=key if isinstance(key, str) else key[-1]):
        case.make()(case.data(2).exclude(key))


# --- parameters -----------------------------------------------------------------------------------


def test_networks_and_loss_share_each_parameter_once(case):
    assert_tied(case.make())


@pytest.mark.parametrize("duplicate", COPIES.values(), ids=COPIES)
def test_a_copy_is_equal_and_of_its_own(case, duplicate):
    loss, data = case.make(), case.data(6)
    clone, expected = duplicate(loss), seeded(loss, data)
    torch.testing.assert_close(seeded(clone, data), expected, rtol=0, atol=0)
    for tensor in (*clone.parameters(), *clone.buffers()):
        tensor.data.mul_(1.5)
    torch.testing.assert_close(seeded(loss, data), expected, rtol=0, atol=0)
    assert (seeded(clone, data)["loss_qvalue"] - expected["loss_qvalue"]).abs() > 1e-3
    assert_tied(loss)
    assert_tied(clone)


def test_a_state_dict_carries_the_loss_over(case):
    loss, other, data = case.make(), case.make(), case.data(6)
    expected = seeded(loss, data)
    assert not torch.equal(seeded(other, data)["loss_qvalue"], expected["loss_qvalue"])
    other.load_state_dict(loss.state_dict(), strict=True)
    torch.testing.assert_close(seeded(other, data), expected, rtol=0, atol=0)
    assert_tied(other)


def test_casts_keep_the_sharing_and_reach_all_parameters(case):
    loss = case.make()
    parameters = {id(p) for p in loss.parameters()}
    for dtype in (torch.float32, torch.float64):
        loss.to(dtype)
        assert {p.dtype for p in loss.parameters()} == {dtype}
        assert {id(p) for p in loss.parameters()} == parameters
        assert_tied(loss)
    data = case.data(6).apply(lambda x: x.double() if x.is_floating_point() else x)
    assert loss(data)["loss_qvalue"].dtype == torch.float64


@pytest.mark.parametrize("updater", [lambda loss: SoftUpdate(loss, tau=0.25), HardUpdate])
def test_target_updaters_move_the_targets(case, updater):
    loss = case.make()
    updater = updater(loss)
    if isinstance(updater, HardUpdate):
        updater.value_network_update_interval = 0
    start = getattr(loss, TARGETS).clone()
    for param in loss.parameters():
        param.data.add_(1.0)
    torch.testing.assert_close(getattr(loss, TARGETS).data, start.data)
    updater.step()
    share = 0.25 if isinstance(updater, SoftUpdate) else 1.0
    torch.testing.assert_close(getattr(loss, TARGETS).data, (start + share).data)


def test_a_loss_warns_until_its_targets_have_an_updater(case):
    loss = case.make()
    loss._has_update_associated["qvalue_network"] = False
    with pytest.warns(UserWarning, match="No target network updater"):
        loss(case.data(3))
    SoftUpdate(loss, tau=0.1)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        loss(case.data(3))


# --- exceptions -----------------------------------------------------------------------------------


@pytest.mark.parametrize("call", [1, 2], ids=["target", "online"])
@pytest.mark.parametrize("error", [RuntimeError, KeyboardInterrupt])
def test_an_exception_leaves_the_critics_on_their_own_parameters(case, call, error, monkeypatch):
    loss, data = case.make(), case.data(6)
    expected, ids = seeded(loss, data), [id(p) for p in loss.qvalue_network.parameters()]
    critics, calls = loss.qvalue_network, []
    method = "encode" if hasattr(critics, "encode") else "forward"
    original = getattr(critics, method)

    def failing(*arguments):
        calls.append(arguments)
        if len(calls) == call:
            raise error("in the middle of a loss")
        return original(*arguments)

    with monkeypatch.context() as patch, pytest.raises(error, match="in the middle"):
        patch.setattr(critics, method, failing)
        loss(data.clone())
    assert [id(p) for p in critics.parameters()] == ids
    assert_tied(loss)
    torch.testing.assert_close(seeded(loss, data), expected, rtol=0, atol=0)


# --- critics with buffers -------------------------------------------------------------------------


class ShiftedCritic(nn.Module):
    """A critic for ACA whose values are shifted by a buffer."""

    def __init__(self):
        super().__init__()
        self.net = nn.Linear(OBSERVATION_DIM + ACTION_DIM, 2)
        self.register_buffer("shift", torch.zeros(2))

    def forward(self, observation, action, noise_level):
        return self.net(torch.cat([observation, action], -1)) + self.shift


class ShiftedEnsemble(EnsembleMLP):
    """A stack for RLPD whose values are shifted by a buffer."""

    def __init__(self):
        super().__init__(OBSERVATION_DIM + ACTION_DIM, 4, num_cells=(6,), dtype=torch.float64)
        self.register_buffer("shift", torch.zeros(4, dtype=torch.float64))

    def forward(self, *inputs):
        return super().forward(*inputs) + self.shift


class ShiftedTwin(TwinCritic):
    """Critics of a diffusion policy whose values are shifted by a buffer."""

    def __init__(self, *sizes, **kwargs):
        super().__init__(*sizes, **kwargs)
        self.register_buffer("shift", torch.zeros(2, dtype=torch.float64))

    def evaluate(self, features, action):
        values = super().evaluate(features, action)
        if self.num_outputs == 1:
            return values + self.shift
        return values + self.shift[:, None] * values.new_tensor([1.0, 0.0])  # of DACER the means


DIFFUSION = {
    "dacer": DACERLoss,
    "dipo": DIPOLoss,
    "qsm": QSMLoss,
    "qvpo": QVPOLoss,
    "sdac": SDACLoss,
}


def make_shifted(name):
    if name == "aca":
        return ACALoss(make_actor(ShiftedCritic(), action_dim=ACTION_DIM))
    if name in DIFFUSION:
        critic = ShiftedTwin(
            OBSERVATION_DIM,
            ACTION_DIM,
            num_outputs=2 if name == "dacer" else 1,
            num_cells=(6,),
            dtype=torch.float64,
        )
        chain = LANGEVIN if name == "qsm" else None
        num_candidates = 1 if name in ("dacer", "dipo") else 3
        policy = make_diffusion_policy(critic=critic, chain=chain, num_candidates=num_candidates)
        return DIFFUSION[name](policy, reward_scale=1.0)
    critics = ValueOperator(ShiftedEnsemble(), in_keys=["observation", "action"])
    return EnsembleSACLoss(make_policy(), critics)


def shift_of(loss):
    (shift,) = loss.qvalue_network.buffers()
    return shift


@pytest.mark.parametrize("name", ["aca", "rlpd"])
def test_buffers_stay_tied_through_casts_and_copies(name):
    loss = make_shifted(name)
    assert_tied(loss)
    assert_tied(loss.to(torch.float32).to(torch.float64))
    assert_tied(copy.deepcopy(loss))
    assert shift_of(loss).dtype == torch.float64


@pytest.mark.parametrize("cast", [False, True])
@pytest.mark.parametrize("name", ["aca", "rlpd"])
def test_targets_take_over_the_online_buffers(name, cast):
    loss = make_shifted(name)
    updater = SoftUpdate(loss, tau=0.1)
    data = CASES[name].data(6)
    if cast:
        loss = loss.to(torch.float64)
        data = data.apply(lambda x: x.double() if x.is_floating_point() else x)
    before = seeded(loss, data)
    shift_of(loss).fill_(10.0)
    updater.step()  # moves parameters alone
    after = seeded(loss, data)
    alive = 1 - data["next", "terminated"].double().mean()
    gain = after["target_value"] - before["target_value"]
    assert gain.item() == pytest.approx(0.99 * 10 * alive.item(), rel=1e-4)
    assert (after["pred_value"] - before["pred_value"]).item() == pytest.approx(10, rel=1e-4)


def test_batch_norm_of_a_critic_counts_online_rows_and_serves_the_targets():
    class Normalised(ShiftedCritic):
        def __init__(self):
            super().__init__()
            self.norm = nn.BatchNorm1d(OBSERVATION_DIM, momentum=None)

        def forward(self, observation, action, noise_level):
            return super().forward(self.norm(observation), action, noise_level)

    critic, data = Normalised(), CASES["aca"].data(64)
    loss = ACALoss(make_actor(critic, action_dim=ACTION_DIM))
    SoftUpdate(loss, tau=0.1)
    critic.train()
    loss.qvalue_loss(data)
    critic.eval()
    torch.testing.assert_close(critic.norm.running_mean, data["observation"].mean(0))
    loss.qvalue_loss(data)
    target = loss.target_qvalue_network_params["module", "norm", "running_mean"]
    assert torch.equal(target, critic.norm.running_mean)


# --- compilation ----------------------------------------------------------------------------------


COMPILED = [("aca", ("noise", "noise_level", "next_action")), *((name, ()) for name in CASES)]


@pytest.mark.parametrize(("name", "given"), COMPILED)
def test_compiled_losses_equal_eager_ones(name, given, monkeypatch):
    # A graph holds each iteration of DACER's mixture: few of them are compiled in seconds.
    few = partial(fit_gmm, num_iterations=3, num_start_iterations=2)
    monkeypatch.setattr(dacer, "fit_gmm", few)
    torch.compiler.reset()  # the losses share code of TorchRL's, which recompiles a few times only
    case = CASES[name]
    loss, data = case.make(), case.data(4)
    data = data.exclude(*{"noise", "noise_level", "next_action"}.difference(given))
    results = []
    for function in (loss, torch.compile(loss, fullgraph=True, backend="aot_eager")):
        loss.zero_grad(set_to_none=True)
        out = seeded(function, data)
        total(case, out).backward()
        results.append((out, [param.grad.clone() for param in loss.parameters()]))
    torch.testing.assert_close(*results)
