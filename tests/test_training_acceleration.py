"""`compile` and `cudagraphs`: what they change on a CPU, which is nothing but the speed."""

from __future__ import annotations

import warnings

import pytest
import torch
import torch._inductor.config
from tensordict import TensorDict

from agents import configured, make_agent
from online_mujoco import train
from recipe_cases import TINY, composed
from torchrl_aca.errors import RunError
from torchrl_aca.training.acceleration import capture, compiled, make_adam
from torchrl_aca.training.envs import make_vector_env

without_cuda = pytest.mark.skipif(torch.cuda.is_available(), reason="a GPU captures these steps")


def batch_of(seed: int, size: int = 16) -> TensorDict:
    generator = torch.Generator().manual_seed(seed)
    terminated = torch.rand(size, 1, generator=generator) < 0.1
    return TensorDict(
        observation=torch.randn(size, 4, generator=generator),
        action=6 * torch.rand(size, 1, generator=generator) - 3,
        next=TensorDict(
            observation=torch.randn(size, 4, generator=generator),
            reward=torch.randn(size, 1, generator=generator),
            done=terminated,
            terminated=terminated,
            batch_size=[size],
        ),
        batch_size=[size],
    )


# With a chain, and with it steps that are captured or compiled apart from the losses.
CHAINS = ["aca", "dacer", "dipo", "qsm", "qvpo", "sdac"]


def updated(algo: str, *overrides: str, updates: int = 5):
    """The metrics of a fresh agent's first updates, and its state afterwards."""
    cfg = configured(composed(*TINY[algo], "env=inverted_pendulum", *overrides))
    env = make_vector_env(cfg.env.name, 1, 0)
    torch.manual_seed(0)
    agent = make_agent(cfg, env, torch.device("cpu"))
    torch.manual_seed(1)
    metrics = [agent.update(batch_of(number)).to_dict() for number in range(updates)]
    return metrics, agent.state["loss"].state_dict()


def test_without_the_switches_functions_stay_what_they_are():
    def step(batch):
        return batch

    assert capture(step, False) is step
    assert compiled(step, False) is step


@without_cuda
def test_without_cuda_a_captured_step_runs_as_it_is():
    with pytest.warns(UserWarning, match="(?i)cuda"):
        step = capture(lambda batch: batch.apply(lambda value: 2 * value), True)
    for number in range(10):  # more than the warm-up
        batch = TensorDict(value=torch.full((3,), float(number)), batch_size=[3])
        assert torch.equal(step(batch)["value"], torch.full((3,), 2.0 * number))


@without_cuda
@pytest.mark.parametrize("algo", CHAINS)
def test_cudagraphs_on_a_cpu_change_no_update(algo):
    plain, plain_state = updated(algo)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        captured, captured_state = updated(algo, "cudagraphs=true")
    assert [sorted(each) for each in plain] == [sorted(each) for each in captured]
    for one, two in zip(plain, captured, strict=True):
        assert all(torch.equal(one[name], two[name]) for name in one)
    for name, value in plain_state.items():
        assert torch.equal(value, captured_state[name]), name


def test_the_recipe_refuses_cudagraphs_on_a_cpu(tmp_path):
    cfg = composed(*TINY["aca"], "cudagraphs=true", f"run_dir={tmp_path / 'here'}")
    with pytest.raises(RunError, match="cudagraphs=true: expected device=cuda, got cpu"):
        train(cfg)
    assert not (tmp_path / "here").exists()


@pytest.mark.slow
@pytest.mark.parametrize("algo", CHAINS)
def test_compiled_losses_are_those_of_plain_ones(algo, tmp_path, monkeypatch):
    monkeypatch.setenv("TORCHINDUCTOR_CACHE_DIR", str(tmp_path))
    plain, _ = updated(algo, updates=3)
    # Compiled code has random numbers of its own, unless it is told to draw torch's.
    with torch._inductor.config.patch(fallback_random=True):
        quick, _ = updated(algo, "compile=true", updates=3)
    for one, two in zip(plain, quick, strict=True):
        assert one.keys() == two.keys()
        for name in one:
            torch.testing.assert_close(two[name], one[name], rtol=1e-4, atol=1e-4)


def test_adam_steps_as_the_formula_says():
    """Two steps of Kingma and Ba's algorithm 1, on one number, in floats of Python."""
    parameter = torch.nn.Parameter(torch.tensor([1.0]))
    optimizer = make_adam([parameter], 0.1, cudagraphs=False)
    value, first, second = 1.0, 0.0, 0.0
    for step, gradient in enumerate((0.5, -2.0), start=1):
        parameter.grad = torch.tensor([gradient])
        optimizer.step()
        first = 0.9 * first + 0.1 * gradient
        second = 0.999 * second + 0.001 * gradient**2
        unbiased = first / (1 - 0.9**step), second / (1 - 0.999**step)
        value -= 0.1 * unbiased[0] / (unbiased[1] ** 0.5 + 1e-8)
        assert parameter.item() == pytest.approx(value, rel=1e-5)
