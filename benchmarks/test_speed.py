"""Speed of the chain, of acting and of an update, for `make bench`.

THREADS sets torch's threads (default: all cores). Everything is compared inside one run: with the
matrix-product roofline of the machine at that moment and with the yardstick. Nothing is asserted.
"""

from __future__ import annotations

import os
from collections.abc import Callable

import pytest
import torch
from tensordict import TensorDict

from recipe import configure, make_recipe_agent, random_batch
from torchrl_aca import CriticGuidedDenoisingActor, NoiseLevelCritic, NoiseSchedule
from torchrl_aca.training.envs import make_vector_env
from yardstick import PlainAgent

SIZES = {"HalfCheetah": (17, 6), "Humanoid": (376, 17)}
BATCH, WIDTH, NUM_STEPS = 256, 256, 20
TILE_ROWS = 1024  # the actor's default
VARIANTS = ("yardstick", "eager", "compiled")
torch.set_num_threads(int(os.environ.get("THREADS", os.cpu_count() or 1)))


def flops(rows: int, action_dim: int) -> float:
    """Matrix products that a chain needs: two critics, forward and back, of the action's share.

    The last step is not among them: it is not guided.
    """
    per_step = 2 * 2 * 2 * rows * (action_dim * WIDTH + 2 * WIDTH * WIDTH + WIDTH)
    return (NUM_STEPS - 1) * per_step


def make_actor(
    size: str, variant: str, num_candidates: int, **options: int
) -> CriticGuidedDenoisingActor:
    torch._dynamo.reset()  # it compiles a method for a few objects only, and then no more
    return CriticGuidedDenoisingActor(
        NoiseLevelCritic(*SIZES[size]),
        NoiseSchedule.cosine(NUM_STEPS),
        num_candidates=num_candidates,
        compile_step=variant == "compiled",
        **options,
    )


def make_batch(size: str) -> TensorDict:
    return random_batch(*SIZES[size], BATCH)


def measure(
    benchmark,
    call,
    rows: int,
    case: str,
    variant: str,
    work: float,
    tile_rows: int = TILE_ROWS,
    comparable: bool = True,
) -> None:
    """Times `call` after two warm-up rounds, which compile it where it is compiled.

    Its share of the roofline is of the product that has as many rows as are taken at once; there is
    none where it is not `comparable` with that.
    """
    threads = torch.get_num_threads()
    info = {"case": case, "variant": variant, "rows": rows, "flops": work, "threads": threads}
    product_rows = min(rows, tile_rows) if comparable else None
    benchmark.extra_info.update(info, product_rows=product_rows)
    rounds = 3 if rows > 4096 else 10
    benchmark.pedantic(call, rounds=rounds, warmup_rounds=2, iterations=1)


@pytest.mark.parametrize("rows", [32, 160, 256, 1024])
def test_roofline(benchmark, rows):
    x, weight = torch.randn(2, rows, WIDTH), torch.randn(2, WIDTH, WIDTH)
    work = 20 * 2 * 2 * rows * WIDTH * WIDTH

    def products():
        for _ in range(20):
            x @ weight

    measure(benchmark, products, rows, f"matrix product, 2 x {rows} rows", "roofline", work)


@pytest.mark.parametrize("variant", VARIANTS)
@pytest.mark.parametrize("size", SIZES)
def test_denoising_step(benchmark, size, variant):
    """One guided step of a tile; for this package with the states' features and the last step."""
    observation_dim, action_dim = SIZES[size]
    observation, noise = torch.randn(BATCH, observation_dim), torch.randn(3, 4, BATCH, action_dim)
    if variant == "yardstick":
        plain = PlainAgent(*SIZES[size], NUM_STEPS)
        rows = observation.repeat(4, 1)

        def call():
            plain._step(rows, noise[0].flatten(0, 1), torch.tensor(NUM_STEPS))
    else:
        actor = make_actor(size, variant, 4, num_inference_steps=2)

        def call():
            with torch.no_grad():
                actor.denoise(observation, noise)

    work = flops(4 * BATCH, action_dim) / (NUM_STEPS - 1)
    measure(benchmark, call, 4 * BATCH, f"{size}: denoising step, 1024 rows", variant, work)


def sampling(benchmark, size: str, num_states: int, num_candidates: int, variant: str, case: str):
    observation = torch.randn(num_states, SIZES[size][0])
    if variant == "yardstick":
        plain = PlainAgent(*SIZES[size], NUM_STEPS)

        def call():
            plain.sample(observation, num_candidates)
    else:
        actor = make_actor(size, variant, num_candidates)

        def call():
            actor.sample(observation, [num_states])

    rows = num_states * num_candidates
    measure(benchmark, call, rows, case, variant, flops(rows, SIZES[size][1]))


@pytest.mark.parametrize("variant", VARIANTS)
@pytest.mark.parametrize("num_candidates", [1, 4, 32, 128])
@pytest.mark.parametrize("size", SIZES)
def test_target_actions(benchmark, size, num_candidates, variant):
    if num_candidates == 128 and variant != "compiled":
        pytest.skip("four times the case with 32 candidates, and as slow")
    case = f"{size}: target actions, {BATCH} states x {num_candidates}"
    sampling(benchmark, size, BATCH, num_candidates, variant, case)


@pytest.mark.parametrize("variant", VARIANTS)
@pytest.mark.parametrize(("num_states", "num_candidates"), [(5, 32), (1, 32), (1, 1)])
def test_acting(benchmark, num_states, num_candidates, variant):
    case = f"HalfCheetah: acting, {num_states} states x {num_candidates}"
    sampling(benchmark, "HalfCheetah", num_states, num_candidates, variant, case)


@pytest.mark.parametrize("precision", ["highest", "medium"])
@pytest.mark.parametrize("num_candidates", [1, 32])
def test_precision(benchmark, num_candidates, precision):
    observation = torch.randn(BATCH, SIZES["HalfCheetah"][0])
    actor = make_actor("HalfCheetah", "compiled", num_candidates)
    rows = BATCH * num_candidates
    case = f"HalfCheetah: target actions, {BATCH} states x {num_candidates}, precision {precision}"
    torch.set_float32_matmul_precision(precision)
    try:
        measure(
            benchmark,
            lambda: actor.sample(observation, [BATCH]),
            rows,
            case,
            "compiled",
            flops(rows, 6),
            comparable=precision == "highest",
        )
    finally:
        torch.set_float32_matmul_precision("highest")


@pytest.mark.parametrize("tile_rows", [256, 512, 1024, 2048, 8192])
def test_tiles(benchmark, tile_rows):
    observation = torch.randn(BATCH, SIZES["HalfCheetah"][0])
    actor = make_actor("HalfCheetah", "compiled", 32, tile_rows=tile_rows)
    case = f"HalfCheetah: target actions, {BATCH} states x 32, tiles of {tile_rows} rows"
    measure(
        benchmark,
        lambda: actor.sample(observation, [BATCH]),
        BATCH * 32,
        case,
        "compiled",
        flops(BATCH * 32, 6),
        tile_rows=tile_rows,
    )


@pytest.mark.parametrize("variant", VARIANTS)
@pytest.mark.parametrize("num_candidates", [1, 4, 32, 128])
@pytest.mark.parametrize("size", SIZES)
def test_update(benchmark, size, num_candidates, variant):
    """TD step, noise-level step, target step: an update of the recipe, and the yardstick's."""
    if num_candidates == 128 and variant != "compiled":
        pytest.skip("four times the case with 32 candidates, and as slow")
    batch = make_batch(size)
    if variant == "yardstick":
        plain = PlainAgent(*SIZES[size], NUM_STEPS)

        def call():
            plain.update(batch, num_candidates)
    else:
        call = recipe_update(
            size,
            batch,
            f"aca.num_target_candidates={num_candidates}",
            f"compile={variant == 'compiled'}",
        )

    rows = BATCH * num_candidates
    case = f"{size}: update, {num_candidates} target candidates"
    measure(benchmark, call, rows, case, variant, flops(rows, SIZES[size][1]))


@pytest.mark.parametrize("num_levels", [20, 10, 8, 6])
@pytest.mark.parametrize("num_candidates", [1, 4])
def test_update_by_a_short_chain(benchmark, num_candidates, num_levels):
    """The same update with a chain that visits fewer levels."""
    call = recipe_update(
        "HalfCheetah",
        make_batch("HalfCheetah"),
        f"aca.num_target_candidates={num_candidates}",
        f"aca.num_inference_steps={num_levels}",
        "compile=true",
    )
    rows = BATCH * num_candidates
    case = f"HalfCheetah: update, {num_candidates} target candidates, chain of {num_levels} levels"
    work = flops(rows, SIZES["HalfCheetah"][1]) * (num_levels - 1) / (NUM_STEPS - 1)
    measure(benchmark, call, rows, case, "compiled", work)


def recipe_update(size: str, batch: TensorDict, *overrides: str) -> Callable[[], object]:
    """An update of the recipe, with both steps each time, as the yardstick's has them."""
    torch._dynamo.reset()
    cfg = configure(f"env={size.lower()}", "aca.noise_level_interval=1", *overrides)
    agent = make_recipe_agent(cfg, make_vector_env(cfg.env.name, 1, seed=0))
    return lambda: agent.update(batch)
