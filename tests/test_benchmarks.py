"""The benchmarks compare like with like, and their report divides what it should."""

from __future__ import annotations

import re

import pytest
import torch
from torchrl.objectives import SoftUpdate

import gpu
from recipe import random_batch
from report import loop_overhead, table
from torchrl_aca import ACALoss, CriticGuidedDenoisingActor, NoiseLevelCritic, NoiseSchedule
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


def test_the_yardstick_updates_as_the_loss_does(monkeypatch):
    plain = PlainAgent(7, 2, 4)
    plain.critics.double(), plain.targets.double()
    critic = NoiseLevelCritic(7, 2, num_steps=4, dtype=torch.float64)
    load_official(critic, *map(official, plain.critics))
    loss = ACALoss(CriticGuidedDenoisingActor(critic, NoiseSchedule.cosine(4)))
    loss.make_value_estimator(gamma=0.99)
    updater = SoftUpdate(loss, tau=0.005)
    optimizer = torch.optim.Adam(critic.parameters(), lr=1e-3)
    batch = random_batch(7, 2, 8).apply(lambda x: x.double() if x.is_floating_point() else x)
    batch["next", "terminated"][:3] = True
    action, noise = torch.randn(2, 8, 2, dtype=torch.float64)
    draws = {"next_action": action, "noise": noise, "noise_level": torch.randint(1, 5, (8,))}
    monkeypatch.setattr(plain, "sample", lambda observation, num: action)
    monkeypatch.setattr(torch, "randint", lambda *_: draws["noise_level"])
    monkeypatch.setattr(torch, "randn_like", lambda like: noise)
    for _ in range(3):
        plain.update(batch, 1)
        data = batch.copy().update(draws)
        for name in ("qvalue", "noise_level"):
            getattr(loss, f"{name}_loss")(data)[f"loss_{name}"].backward()
            optimizer.step()
            optimizer.zero_grad()
        updater.step()
    expected = NoiseLevelCritic(7, 2, num_steps=4, dtype=torch.float64)
    for params, networks in (
        (critic.state_dict(), plain.critics),
        (targets_of(loss), plain.targets),
    ):
        load_official(expected, *map(official, networks))
        for name, value in expected.state_dict().items():
            torch.testing.assert_close(params[name], value, rtol=0, atol=1e-7)


def targets_of(loss) -> dict[str, torch.Tensor]:
    return dict(loss.target_qvalue_network_params.flatten_keys(".").items())


def test_the_report_divides_by_yardstick_and_roofline():
    def result(case, variant, rows, flops, seconds):
        info = {"case": case, "variant": variant, "rows": rows, "flops": flops}
        return {"extra_info": {**info, "product_rows": rows}, "stats": {"median": seconds}}

    text = table(
        [
            result("product", "roofline", 1024, 100e9, 1.0),  # 100 GFLOP/s
            result("small product", "roofline", 256, 50e9, 1.0),  # 50 GFLOP/s
            result("small chain", "compiled", 256, 40e9, 1.0),
            result("other chain", "compiled", 512, 40e9, 1.0),
            result("chain", "yardstick", 1024, 200e9, 8.0),  # 25 GFLOP/s
            result("chain", "compiled", 1024, 200e9, 2.5),  # 80 GFLOP/s
        ]
    )
    assert "| chain | compiled | 2500.0 ms |  |  |" in table(
        [result("chain", "compiled", 1024, 200e9, 2.5)]
    )
    assert "| product | roofline | 1000.0 ms |  | 100 GFLOP/s |" in text
    assert "| chain | yardstick | 8000.0 ms | 1.00 | 25% |" in text
    assert "| small chain | compiled | 1000.0 ms |  | 80% |" in text
    assert "| other chain | compiled | 1000.0 ms |  |  |" in text  # nothing to compare with
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
    cases = [
        "--tasks",
        "inverted_pendulum",
        "--candidates",
        "1",
        "--variants",
        "eager",
        "broken",
        "silent",
    ]
    monkeypatch.setitem(gpu.VARIANTS, "broken", ["device=nonsense"])
    monkeypatch.setitem(gpu.VARIANTS, "silent", [])
    measure = gpu.measure

    def measure_or_fail(case, *how):
        assert case.variant != "silent"
        return measure(case, *how)

    monkeypatch.setattr(gpu, "measure", measure_or_fail)
    assert gpu.main([*arguments, *cases, "--out", str(tmp_path)]) == 0
    *_, works, fails, silent = (tmp_path / "speed.md").read_text().splitlines()
    assert re.fullmatch(
        r"\| inverted_pendulum \| 1 \| eager \| \d+\.\d\d ms \| \d+\.\d\d ms \| \d+ \|", works
    )
    assert fails.startswith(
        "| inverted_pendulum | 1 | broken | failed: RunError: device='nonsense'"
    )
    assert silent.startswith("| inverted_pendulum | 1 | silent | failed: AssertionError: ")


@pytest.mark.skipif(torch.cuda.is_available(), reason="a GPU would be used")
def test_without_a_gpu_the_command_says_so(tmp_path):
    with pytest.raises(SystemExit, match="expected a CUDA device, found none"):
        gpu.main(["--out", str(tmp_path)])
