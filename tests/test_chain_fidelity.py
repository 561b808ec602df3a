"""The comparison of short chains with the whole one: its measures, its spacings, its command."""

from __future__ import annotations

from types import SimpleNamespace

import pytest
import torch
from tensordict import TensorDict

import chain_fidelity
from fidelity.measures import border_shares, energy_distance_test, spread
from fidelity.spacings import PACKAGE, SPACINGS, levels_of
from online_mujoco import train
from recipe_cases import TINY, composed, rows_of
from torchrl_aca import CriticGuidedDenoisingActor, NoiseLevelCritic, NoiseSchedule
from torchrl_aca.chain import check_levels, inference_levels
from torchrl_aca.errors import RunError
from torchrl_aca.replay import BufferState, make_replay_buffer


def test_energy_distance_by_hand():
    # 2 E|X - Y| - E|X - X'| - E|Y - Y'| = 2 * 2 - 1/2 - 1/2
    samples, others = torch.tensor([[0.0], [1.0]]), torch.tensor([[2.0], [3.0]])
    distance, p = energy_distance_test(samples, others, 99, torch.Generator().manual_seed(0))
    assert distance == pytest.approx(3.0)
    assert p > 0.1  # a third of the shuffles of four points separate them as well


def test_the_test_tells_a_shift_from_none():
    generator = torch.Generator().manual_seed(1)
    samples, others = torch.randn(2, 300, 2, generator=generator)
    _, same = energy_distance_test(samples, others, 199, generator)
    _, apart = energy_distance_test(samples, others + 0.4, 199, generator)
    assert same > 0.05 and apart == pytest.approx(1 / 200)


def test_the_spread_is_over_the_candidates():
    # Deviations of (0, 2) and (1, 1): sqrt 2 and 0.
    assert spread(torch.tensor([[0.0, 1.0], [2.0, 1.0]])) == pytest.approx(2**0.5 / 2)


def test_shares_at_the_border_by_hand():
    torch.manual_seed(0)
    critic = NoiseLevelCritic(3, 2, num_steps=4, num_cells=(8,))
    states, schedule = torch.zeros(5, 3), NoiseSchedule.cosine(4)
    strong = CriticGuidedDenoisingActor(critic, schedule, guidance_weight=1e6)
    assert border_shares(strong, states, 6)[1:] == [1.0, 1.0, 1.0]  # level 1 has no posterior noise
    idle = CriticGuidedDenoisingActor(critic, schedule, guidance_weight=0.0)
    torch.manual_seed(1)
    shares = border_shares(idle, states, 6)
    torch.manual_seed(1)
    path = idle.trajectory(states, torch.randn(5, 6, 5, 2))
    beyond = [(path[4 - k].abs() > schedule.alphas_cumprod[k - 1].sqrt()) for k in (1, 2, 3, 4)]
    assert shares == pytest.approx([float(b.double().mean()) for b in beyond])


def test_the_measures_of_a_chain_by_hand(monkeypatch):
    """The critic's value is the action itself, in one dimension."""
    monkeypatch.setattr(chain_fidelity, "PERMUTATIONS", 199)
    critic = SimpleNamespace(evaluate=lambda features, actions, level: actions)
    actor = SimpleNamespace(encode=lambda states, batch: None, critic=critic)
    states = torch.zeros(1, 3), torch.zeros(2, 3)
    drawn = torch.randn(2, 60, 2, 1, generator=torch.Generator().manual_seed(0))
    moved = torch.stack([drawn[1, :, 0], drawn[1, :, 1] + 3], 1)  # in the second state alone
    reference = torch.tensor([0.0, 2.0]).reshape(2, 1, 1), drawn[0]
    samples = torch.tensor([1.0, 5.0]).reshape(2, 1, 1), moved
    found = chain_fidelity.compare(actor, states, reference, samples)
    root = 2**0.5  # the standard deviation of 0 and 2
    expected = {
        "value": 3.0,
        "value_spread": root,
        "value_difference": (3 - 1) / root,
        "std": 2 * root,
        "std_ratio": 2.0,
        "rejected": 0.5,
    }
    assert {name: found[name] for name in expected} == pytest.approx(expected)
    assert found["energy_distance"] > 0.5


@pytest.mark.parametrize("raw", [False, True])
def test_a_chain_has_the_gradients_that_are_asked_for(raw):
    critic, schedule = NoiseLevelCritic(3, 2, num_steps=4), NoiseSchedule.cosine(4)
    actor = CriticGuidedDenoisingActor(critic, schedule, guidance_weight=7.0)
    made = chain_fidelity._Chain(actor, [1, 2, 4], SimpleNamespace(raw_gradient=raw)).actor
    assert (made.normalize_gradient, float(made.guidance_weight)) == (not raw, 7.0)
    assert made.inference_levels == [1, 2, 4]


def test_the_newest_states_of_a_full_buffer_and_of_a_mixture():
    buffer = make_replay_buffer(4, 2)
    state = BufferState(buffer, ["observation"])
    with pytest.raises(RunError, match="without a frame has no states"):
        chain_fidelity.newest_states(state.state_dict(), 2)
    for number in range(6):
        buffer.extend(TensorDict(observation=torch.full((1, 1), number), batch_size=[1]))
        newest = chain_fidelity.newest_states({"online": state.state_dict()}, 2)
        assert newest.flatten().tolist() == [number - 1, number][-1 - number :]


@pytest.mark.parametrize("spacing", [PACKAGE, *SPACINGS])
@pytest.mark.parametrize("kind", ["cosine", "linear", "vp"])
def test_every_spacing_rises_from_1_to_the_top(spacing, kind):
    for num_levels in (5, 20, 100):
        schedule = getattr(NoiseSchedule, kind)(num_levels)
        for num_steps in (2, 4, num_levels - 1, num_levels):
            levels = levels_of(spacing, schedule, num_steps)
            assert check_levels(levels, num_levels) == levels and len(levels) == num_steps


def test_the_spacings_are_what_their_names_say():
    schedule = NoiseSchedule.cosine(21)
    assert levels_of("even", schedule, 5) == [1, 6, 11, 16, 21]
    assert levels_of("quadratic", schedule, 5) == [1, 2, 6, 12, 21]  # 1 + 20 (k / 4)^2
    assert levels_of("geometric", NoiseSchedule.cosine(16), 5) == [1, 2, 4, 8, 16]
    assert levels_of("low", schedule, 5) == [1, 2, 4, 10, 21]  # 1 + 9 (k / 3)^3, and the top
    assert levels_of(PACKAGE, schedule, 5) == inference_levels(21, 5)


@pytest.mark.parametrize("raw", [False, True])
def test_the_command_compares_chains_on_the_checkpoints_of_a_run(
    raw, tmp_path, capsys, monkeypatch
):
    monkeypatch.setattr(chain_fidelity, "TEST_SAMPLES", 100)
    run_dir = tmp_path / "run"
    train(composed(*TINY["aca"], "aca.num_steps=5", f"run_dir={run_dir}", "checkpoint.keep_last=9"))
    sizes = ["--states", "6", "--tested-states", "2", "--steps", "3", "9"]
    options = ["--raw-gradient"] if raw else []
    updates = ["--updates", "25", "60"]
    out = tmp_path / "out"
    chain_fidelity.main([str(run_dir), *updates, *sizes, *options, "--out", str(out)])
    rows = rows_of(out / "fidelity.csv")
    assert [row["spacing"] for row in rows] == 2 * ["all", PACKAGE, *SPACINGS]  # none of 9 of 5
    assert [row["gradients"] for row in rows] == 2 * ["4", *["2"] * (1 + len(SPACINGS))]
    assert {row["normalized"] for row in rows} == {str(not raw)}
    assert all(0.5 < float(row["std_ratio"]) < 2 for row in rows if row["spacing"] == "all")
    levels = [row["level"] for row in rows_of(out / "border.csv")]
    assert levels == 2 * ["1", "2", "3", "4", "5"]
    assert (out / "fidelity.png").stat().st_size > 0
    assert "| all | 4 | 1 2 3 4 5 |" in capsys.readouterr().out
    with pytest.raises(SystemExit, match="expected a checkpoint of 7 updates, found those of"):
        chain_fidelity.main([str(run_dir), "--updates", "7", "--out", str(out)])


def test_a_method_without_a_guided_chain_is_told(tmp_path):
    run_dir = tmp_path / "run"
    train(composed(*TINY["sac"], f"run_dir={run_dir}"))
    with pytest.raises(SystemExit, match="algo=sac has no chain to shorten"):
        chain_fidelity.main([str(run_dir), "--out", str(tmp_path / "out")])


def test_a_wrong_path_leaves_the_tables_of_before(tmp_path):
    (tmp_path / "border.csv").write_text("old")
    with pytest.raises(SystemExit, match="error: .*expected a run directory with checkpoints"):
        chain_fidelity.main([str(tmp_path / "nowhere"), "--out", str(tmp_path)])
    assert (tmp_path / "border.csv").read_text() == "old"
