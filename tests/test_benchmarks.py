"""The benchmarks compare like with like, and their report divides what it should."""

from __future__ import annotations

import re

import pytest
import torch

import gpu
from report import loop_overhead, table
from torchrl_aca import CriticGuidedDenoisingActor, NoiseLevelCritic, NoiseSchedule
from torchrl_aca.interop import load_official
from yardstick import PlainAgent


def official(critic) -> dict:
    """Parameters of a `PlainCritic` in the official code's names and layout."""
    layers = [m for m in critic.modules() if isinstance(m, torch.nn.Linear)]
    names = ["linear", *(f"linear_{i}" for i in range(1, len(layers)))]
    arrays = {}
    for name, layer in zip(names, layers, strict=True):
        arrays[f"{name}.w"] = layer.weight.detach().T.numpy()
        arrays[f"{name}.b"] = layer.bias.detach().numpy()
    return arrays


def test_the_yardstick_samples_what_the_actor_samples(monkeypatch):
    num_steps, num_candidates, batch, action_dim = 4, 3, 5, 2
    plain = PlainAgent(7, action_dim, num_steps)
    critic = NoiseLevelCritic(7, action_dim, num_steps=num_steps)
    load_official(critic, *map(official, plain.critics))
    schedule = NoiseSchedule.cosine(num_steps)
    actor = CriticGuidedDenoisingActor(critic, schedule, num_candidates=num_candidates)

    observation = torch.randn(batch, 7)
    noise = torch.randn(num_steps + 1, num_candidates, batch, action_dim)
    draws = iter(noise.flatten(1, 2))
    monkeypatch.setattr(torch, "randn", lambda *shape: next(draws))
    monkeypatch.setattr(torch, "randn_like", lambda like: next(draws))
    action = plain.sample(observation, num_candidates)
    expected = actor.select(observation, actor.denoise(observation, noise))
    torch.testing.assert_close(action, expected, rtol=0, atol=1e-4)


def test_the_report_divides_by_yardstick_and_roofline():
    def result(case, variant, rows, flops, seconds):
        info = {"case": case, "variant": variant, "rows": rows, "flops": flops}
        return {"extra_info": info, "stats": {"median": seconds}}

    text = table(
        [
            result("product", "roofline", 1024, 100e9, 1.0),  # 100 GFLOP/s
            result("chain", "yardstick", 1024, 200e9, 8.0),  # 25 GFLOP/s
            result("chain", "compiled", 1024, 200e9, 2.5),  # 80 GFLOP/s
        ]
    )
    assert "| chain | compiled | 2500.0 ms |  |  |" in table(
        [result("chain", "compiled", 1024, 200e9, 2.5)]
    )
    assert "| product | roofline | 1000.0 ms |  | 100 GFLOP/s |" in text
    assert "| chain | yardstick | 8000.0 ms | 1.00 | 25% |" in text
    assert "| chain | compiled | 2500.0 ms | 3.20 | 80% |" in text


def test_the_report_tells_what_the_loop_costs():
    def part(name, seconds, variant="compiled"):
        info = {"case": f"iteration, fast: {name}", "variant": variant}
        return {"extra_info": info, "stats": {"median": seconds}}

    results = [part("whole", 0.1), part("acting, 5 states x 32", 0.03), part("update", 0.06)]
    assert "iteration, fast (compiled)" in loop_overhead(results)
    assert "takes 10.0 of 100.0 ms, 10%" in loop_overhead(results)
    assert loop_overhead([part("update", 0.06), part("whole", 0.1)]) == ""


def test_the_gpu_command_times_what_works_and_tells_what_does_not(tmp_path, monkeypatch):
    torch.set_num_threads(1)
    arguments = ["--device", "cpu", "--no-tests", "--updates", "0", "--seconds", "0.1"]
    cases = ["--tasks", "inverted_pendulum", "--candidates", "1", "--variants", "eager", "broken"]
    monkeypatch.setitem(gpu.VARIANTS, "broken", ["device=nonsense"])
    assert gpu.main([*arguments, *cases, "--out", str(tmp_path)]) == 0
    *_, works, fails = (tmp_path / "speed.md").read_text().splitlines()
    assert re.fullmatch(
        r"\| inverted_pendulum \| 1 \| eager \| \d+\.\d\d ms \| \d+\.\d\d ms \| \d+ \|", works
    )
    assert fails.startswith(
        "| inverted_pendulum | 1 | broken | failed: RunError: device='nonsense'"
    )


@pytest.mark.skipif(torch.cuda.is_available(), reason="a GPU would be used")
def test_without_a_gpu_the_command_says_so(tmp_path):
    with pytest.raises(SystemExit, match="expected a CUDA device, found none"):
        gpu.main(["--out", str(tmp_path)])
