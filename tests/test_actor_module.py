"""The actor as a module: what it owns, casts, moves, copies, tiles, compiles; in collectors."""

from __future__ import annotations

import copy
import pickle

import pytest
import torch
from torch import nn
from torchrl.collectors import Collector, MultiSyncCollector
from torchrl.data import Bounded
from torchrl.envs.utils import ExplorationType
from torchrl.testing.mocking_classes import ContinuousActionVecMockEnv

from actor_cases import (
    ACTION,
    BATCH,
    CANDIDATES,
    DETERMINISTIC,
    OBS,
    T,
    act,
    make_actor,
    make_critic,
    observe,
)
from torchrl_aca import NoiseLevelCriticBase, NoiseSchedule

# --- the module -----------------------------------------------------------------------------------


def test_the_actor_owns_no_network():
    critic = make_critic()
    actor = make_actor(critic)
    assert actor.critic is critic
    own = {name for name, _ in actor.named_parameters() if not name.startswith("critic.")}
    assert own == {"log_alpha"} and actor.log_alpha.shape == ()
    networks = {f"critic.{key}" for key in critic.state_dict()}
    assert set(actor.state_dict()) == {"log_alpha", "guidance_weight", *networks}


def test_the_guidance_weight_is_a_number_to_set_and_part_of_the_state():
    actor, held = make_actor(guidance_weight=0.3), observe(BATCH)
    buffer = actor.guidance_weight
    actor.guidance_weight = 7
    assert actor.guidance_weight is buffer and buffer == 7
    other = make_actor(actor.critic)
    other.load_state_dict(actor.state_dict())
    assert other.guidance_weight == 7
    assert torch.equal(act(other, held, seed=0), act(actor, held, seed=0))
    other.guidance_weight = 0.0
    assert not torch.equal(act(other, held, seed=0), act(actor, held, seed=0))
    for wrong in (-1, torch.tensor(-1.0)):
        with pytest.raises(ValueError, match="guidance_weight >= 0, got guidance_weight=-1"):
            actor.guidance_weight = wrong
    actor.guidance_weight = torch.tensor(3.0)
    assert actor.guidance_weight is buffer and buffer == 3 and buffer.dtype == torch.float64


@pytest.mark.parametrize("name", ["in_keys", "out_keys"])
def test_one_key_instead_of_a_list_is_told(name):
    with pytest.raises(ValueError, match=f"Expected {name} as a list of keys, such as .'act'."):
        make_actor(**{name: "act"})


def test_casts_round_no_guidance_weight():
    actor = make_actor(guidance_weight=0.1).half().double()
    assert actor.guidance_weight.item() == 0.1


def test_casts_reach_all_but_the_schedule():
    actor = make_actor(spec=Bounded(-0.4, 0.4, shape=(ACTION,))).double()
    with DETERMINISTIC:
        assert act(actor, observe(BATCH)).dtype == torch.float64
    assert act(actor, observe(BATCH)).dtype == torch.float64
    assert {p.dtype for p in actor.parameters()} == {torch.float64}
    assert actor.float().schedule.betas.dtype == torch.float64


def test_moves_reach_everything():
    actor = make_actor(spec=Bounded(-0.4, 0.4, shape=(ACTION,))).to("meta")
    assert {t.device.type for t in [*actor.parameters(), *actor.buffers()]} == {"meta"}
    td = actor(observe(BATCH).to("meta"))
    assert td["action"].device.type == "meta"


@pytest.mark.parametrize("duplicate", [copy.deepcopy, lambda a: pickle.loads(pickle.dumps(a))])
def test_copies_act_alike_and_share_nothing(duplicate):
    actor, td = make_actor(spec=Bounded(-0.4, 0.4, shape=(ACTION,))), observe(BATCH)
    copied = duplicate(actor)
    assert copied.critic is not actor.critic
    with DETERMINISTIC:
        assert torch.equal(act(copied, td), act(actor, td))
    assert torch.equal(act(copied, td, seed=0), act(actor, td, seed=0))
    nn.init.zeros_(copied.log_alpha)
    assert actor.log_alpha != 0


@pytest.mark.parametrize("activation", [nn.Mish, nn.ReLU, nn.GELU, nn.SiLU, nn.Tanh, nn.ELU])
@pytest.mark.parametrize(("dtype", "tolerance"), [(torch.float64, 1e-10), (torch.float32, 1e-4)])
def test_the_written_out_gradient_gives_the_generic_chain(
    activation, dtype, tolerance, monkeypatch
):
    critic = make_critic(activation=activation, dtype=dtype)
    actor = make_actor(critic, guidance_weight=1.0)
    observation = torch.randn(BATCH, OBS, dtype=dtype)
    noise = torch.randn(T + 1, CANDIDATES, BATCH, ACTION, dtype=dtype)
    fast = actor.denoise(observation, noise)
    generic = NoiseLevelCriticBase._action_gradient.__get__(critic)
    monkeypatch.setattr(critic, "_action_gradient", generic, raising=True)
    torch.testing.assert_close(fast, actor.denoise(observation, noise), rtol=0, atol=tolerance)


@pytest.mark.parametrize("tile_rows", [1, 2 * BATCH, 10_000])
def test_tiles_change_no_result(tile_rows):
    critic = make_critic(dtype=torch.float64)
    observation = torch.randn(BATCH, OBS, dtype=torch.float64)
    noise = torch.randn(T + 1, CANDIDATES, BATCH, ACTION, dtype=torch.float64)
    whole, tiled = make_actor(critic), make_actor(critic, tile_rows=tile_rows)
    candidates = whole.denoise(observation, noise)
    torch.testing.assert_close(tiled.denoise(observation, noise), candidates, rtol=0, atol=1e-12)
    chosen = whole.select(observation, candidates)
    assert torch.equal(tiled.select(observation, candidates), chosen)


def test_compiles_without_a_graph_break():
    actor, td = make_actor(make_critic(num_steps=2), NoiseSchedule.cosine(2)), observe(BATCH)
    compiled = torch.compile(actor, fullgraph=True, backend="aot_eager")
    with DETERMINISTIC:
        torch.testing.assert_close(act(compiled, td), act(actor, td), rtol=0, atol=1e-5)
    assert act(compiled, td).shape == (BATCH, ACTION)  # with fresh draws it compiles as well


def test_one_compiled_step_serves_acting_targets_and_evaluation(monkeypatch):
    torch._dynamo.reset()
    compiled = []

    def counting_backend(graph, inputs):
        compiled.append(graph)
        return graph.forward

    torch_compile = torch.compile
    monkeypatch.setattr(
        torch, "compile", lambda f, **kwargs: torch_compile(f, backend=counting_backend, **kwargs)
    )
    actor = make_actor(compile_step=True, num_candidates=32, tile_rows=64)
    for num_states, num_candidates in [(5, 32), (50, 32), (10, 32), (16, 8), (5, 4)]:
        observation = torch.randn(num_states, OBS)
        actor.sample(observation, [num_states], num_candidates=num_candidates)
        with torch.no_grad(), DETERMINISTIC:
            act(actor, observe(num_states))
    # A step and a choice; tiles of one candidate have versions of their own: 50 states fill one.
    assert len(compiled) == 4


def test_a_compiled_step_acts_alike_at_every_level_and_stays_behind_in_copies(monkeypatch):
    compiled_steps = []

    def compile_without_codegen(function, **kwargs):
        compiled_steps.append(function)
        return torch_compile(function, backend="aot_eager", fullgraph=True, **kwargs)

    torch_compile = torch.compile
    monkeypatch.setattr(torch, "compile", compile_without_codegen)
    critic, td = make_critic(), observe(BATCH)
    plain, compiled = make_actor(critic), make_actor(critic, compile_step=True)
    for seed in (0, 1):
        expected = act(plain, td, seed)
        torch.testing.assert_close(act(compiled, td, seed), expected, rtol=0, atol=1e-5)
    assert len(compiled_steps) == 2  # the step, and the choice among the candidates
    for copied in (copy.deepcopy(compiled), pickle.loads(pickle.dumps(compiled))):
        torch.testing.assert_close(act(copied, td, seed=1), expected, rtol=0, atol=1e-5)
    assert len(compiled_steps) == 6


# --- collectors -----------------------------------------------------------------------------------


def collecting_actor():
    env = ContinuousActionVecMockEnv()
    (size,) = env.observation_spec["observation"].shape
    critic = make_critic(size, env.action_spec.shape[-1], num_steps=2)
    return make_actor(critic, NoiseSchedule.cosine(2), spec=env.action_spec)


def test_collects_in_process():
    actor = collecting_actor()
    collector = Collector(
        ContinuousActionVecMockEnv(),
        actor,
        frames_per_batch=8,
        total_frames=16,
        auto_register_policy_transforms=False,
    )
    batches = list(collector)
    collector.shutdown()
    assert [batch.shape for batch in batches] == [(8,)] * 2
    assert all(actor.spec["action"].shape == batch["action"].shape[1:] for batch in batches)
    assert not batches[0]["action"].requires_grad


@pytest.fixture
def collect_from_spawned_worker():
    """An endless iterator of batches that the actor collects in a process of its own."""
    collectors = []

    def start(actor, **kwargs):
        collector = MultiSyncCollector(
            [ContinuousActionVecMockEnv], actor, frames_per_batch=8,
            auto_register_policy_transforms=False, **kwargs,
        )  # fmt: skip
        collectors.append(collector)
        return collector, iter(collector)

    yield start
    for collector in collectors:
        collector.shutdown()


def test_a_spawned_worker_acts_as_the_learner_before_and_after_an_update(
    collect_from_spawned_worker,
):
    actor = collecting_actor()
    kind = ExplorationType.DETERMINISTIC
    collector, batches = collect_from_spawned_worker(actor, exploration_type=kind)

    def learners_action(batch):
        return actor.sample(batch["observation"], batch.shape, deterministic=True)

    first = next(batches).clone()
    # The worker need not round as this process does (3e-5 has been seen).
    torch.testing.assert_close(first["action"], learners_action(first), rtol=0, atol=1e-3)
    with torch.no_grad():
        actor.critic.value.weight.neg_()
    collector.update_policy_weights_()
    next(batches)  # may have begun before the update
    later = next(batches).clone()
    torch.testing.assert_close(later["action"], learners_action(later), rtol=0, atol=1e-3)
    assert not torch.allclose(first["action"], learners_action(first), atol=1e-2)


def test_what_is_set_reaches_a_spawned_worker(collect_from_spawned_worker):
    actor = collecting_actor()
    collector, batches = collect_from_spawned_worker(actor)
    assert not actor.spec["action"].is_in(next(batches)["action"])  # loud exploration noise
    with torch.no_grad():
        actor.log_alpha.fill_(-30.0)
    collector.update_policy_weights_()
    next(batches)  # may have begun before the update
    assert actor.spec["action"].is_in(next(batches)["action"])


def test_the_guidance_weight_reaches_a_spawned_worker(collect_from_spawned_worker):
    actor = collecting_actor()
    kind = ExplorationType.DETERMINISTIC
    collector, batches = collect_from_spawned_worker(actor, exploration_type=kind)
    next(batches)
    actor.guidance_weight = 0.0
    collector.update_policy_weights_()
    next(batches)  # may have begun before the update
    batch = next(batches).clone()
    unguided = actor.sample(batch["observation"], batch.shape, deterministic=True)
    torch.testing.assert_close(batch["action"], unguided, rtol=0, atol=1e-3)
