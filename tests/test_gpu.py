"""What must hold on a GPU; each is run on the CPU as well, up to the kernels that only CUDA has."""

from __future__ import annotations

import pytest
import torch

from agents import configured, make_agent
from loss_cases import make_actor, make_data, make_loss
from online_mujoco import train
from recipe_cases import TINY, batch_of, composed, rows_of
from torchrl_aca.training import load_policy
from torchrl_aca.training.acceleration import capture, descend, make_adam
from torchrl_aca.training.envs import make_vector_env
from torchrl_aca.training.evaluation import evaluation_mode
from torchrl_aca.training.resume import resumed_config

NO_CUDA = pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device")
DEVICES = ["cpu", pytest.param("cuda", marks=[pytest.mark.gpu, NO_CUDA])]
TOLERANCE = {"rtol": 1e-3, "atol": 1e-4}  # of float32 products summed in another order


@pytest.fixture(params=DEVICES)
def device(request):
    return torch.device(request.param)


def test_the_actor_acts_as_on_the_cpu(device):
    torch.manual_seed(0)
    actor = make_actor(deterministic_draws="fixed")
    observation, noise = torch.randn(7, 3), torch.randn(5, 3, 7, 2)
    candidates = actor.denoise(observation, noise)
    best = actor.select(observation, candidates)
    actor = actor.to(device)
    observation, noise = observation.to(device), noise.to(device)
    moved = actor.denoise(observation, noise)
    assert moved.device.type == device.type
    torch.testing.assert_close(moved.cpu(), candidates, **TOLERANCE)
    chosen = actor.select(observation, candidates.to(device))
    torch.testing.assert_close(chosen.cpu(), best, **TOLERANCE)
    action = actor.sample(observation, [7])
    assert action.device.type == device.type and action.isfinite().all()


def test_losses_and_gradients_are_those_of_the_cpu(device):
    torch.manual_seed(0)
    loss, data = make_loss(), make_data(16, draws=True)

    def values_and_gradients(data):
        out = loss(data)
        total = sum(value for name, value in out.items() if name.startswith("loss_"))
        params = [p for p in loss.parameters() if p.requires_grad]
        return [total, *torch.autograd.grad(total, params, allow_unused=True)]

    expected = values_and_gradients(data)
    loss.to(device)
    for value, wanted in zip(values_and_gradients(data.to(device)), expected, strict=True):
        assert (value is None) == (wanted is None)
        if wanted is not None:
            assert value.device.type == device.type
            torch.testing.assert_close(value.cpu(), wanted, **TOLERANCE)


def steps_of(device, captured: bool, updates: int = 12):
    """TD and noise-level steps on given draws, the metrics of each, and the parameters after."""
    torch.manual_seed(0)
    loss = make_loss().to(device)
    optimizer = make_adam(loss.qvalue_network.parameters(), 1e-2, cudagraphs=captured)
    steps = [
        capture(lambda batch: descend(loss.qvalue_loss(batch), "loss_qvalue", optimizer), captured),
        capture(
            lambda batch: descend(loss.noise_level_loss(batch), "loss_noise_level", optimizer),
            captured,
        ),
    ]
    metrics = []
    for number in range(updates):
        torch.manual_seed(number)
        batch = make_data(16, draws=True).to(device)
        for group in optimizer.param_groups:  # the rate changes between replays
            rate = 1e-2 / (1 + number)
            group["lr"] = group["lr"].fill_(rate) if torch.is_tensor(group["lr"]) else rate
        metrics += [step(batch).clone() for step in steps]
    return metrics, [param.detach().clone() for param in loss.qvalue_network.parameters()]


@pytest.mark.gpu
@NO_CUDA
def test_captured_steps_are_those_that_run_as_they_are():
    """More calls than the warm-up, so that most of them replay the graph."""
    plain, captured = (steps_of(torch.device("cuda"), captured) for captured in (False, True))
    for one, two in zip(plain[0], captured[0], strict=True):
        for name, value in one.items():
            torch.testing.assert_close(two[name], value, **TOLERANCE)
    for one, two in zip(plain[1], captured[1], strict=True):
        torch.testing.assert_close(two, one, **TOLERANCE)


def agent_on_gpu(algo: str, *switches: str):
    cfg = configured(composed(*TINY[algo], "env=inverted_pendulum", "device=cuda", *switches))
    return make_agent(cfg, make_vector_env(cfg.env.name, 1, 0), torch.device("cuda"))


@pytest.mark.parametrize("algo", TINY)
@pytest.mark.parametrize(
    "switches", [[], ["compile=true"], ["compile=true", "cudagraphs=true"]], ids=str
)
@pytest.mark.gpu
@NO_CUDA
def test_updates_of_every_method_are_finite_and_move_the_parameters(algo, switches):
    agent = agent_on_gpu(algo, *switches)
    before = [param.detach().clone() for param in agent.state["loss"].parameters()]
    for number in range(14):
        batch = agent.offline_rows_of(batch_of(number, 16)).to("cuda")
        metrics = agent.update(batch)
        assert all(value.isfinite().all() for value in metrics.values())
    after = list(agent.state["loss"].parameters())
    assert any(not torch.equal(one, two) for one, two in zip(before, after, strict=True))


@pytest.mark.parametrize("algo", TINY)
@pytest.mark.gpu
@NO_CUDA
def test_a_captured_policy_acts_as_the_plain_one(algo):
    """In more calls than the warm-up, from the same seed each."""
    agent = agent_on_gpu(algo)
    captured = capture(agent.policy, True)
    with evaluation_mode(0):
        for number in range(12):
            states = batch_of(number, 16).select("observation").to("cuda")
            torch.manual_seed(number)
            expected = agent.policy(states.copy())["action"].clone()
            torch.manual_seed(number)
            torch.testing.assert_close(captured(states)["action"], expected, **TOLERANCE)


def trains_stops_and_goes_on(run_dir, *settings):
    """A run of 60 updates in two parts; returns its policy."""
    settings = [*settings, f"run_dir={run_dir}"]
    train(composed(*settings, "optim.total_updates=30"))
    more = "optim.total_updates=60"
    train(*resumed_config(composed(f"resume={run_dir}", more), [more]))
    assert rows_of(run_dir / "eval.csv")[-1]["updates"] == "60"
    return load_policy(run_dir)


def test_a_run_trains_stops_and_goes_on_and_its_policy_is_loaded_on_the_cpu(device, tmp_path):
    policy = trains_stops_and_goes_on(tmp_path / "run", *TINY["aca"], f"device={device.type}")
    assert {param.device.type for param in policy.parameters()} == {"cpu"}


@pytest.mark.parametrize("algo", TINY)
@pytest.mark.gpu
@NO_CUDA
def test_a_run_of_every_method_with_graphs_goes_on(algo, tmp_path):
    policy = trains_stops_and_goes_on(
        tmp_path / "run", *TINY[algo], "device=cuda", "cudagraphs=true"
    )
    assert all(param.isfinite().all() for param in policy.parameters())
