"""RLPD as the recipe makes it: who is trained when, on what, and what a checkpoint carries."""

from __future__ import annotations

import pytest
import torch
from torch import nn

from agents import configured
from agents.rlpd import make_rlpd
from recipe_cases import batch_of, composed
from torchrl_aca.training.envs import make_vector_env

INTERVAL, BATCH = 4, 16


@pytest.fixture(scope="module")
def make_agent():
    env = make_vector_env("InvertedPendulum-v4", 1, 0)  # 4 observations, an action in [-3, 3]

    def make(*overrides, seed=0):
        cfg = configured(composed("algo=rlpd", *overrides))
        torch.manual_seed(seed)
        return make_rlpd(cfg, env, torch.device("cpu"))

    return make


def small(variant):
    return [
        f"variant={variant}",
        "rlpd.num_cells=[16,16]",
        "rlpd.num_qvalue_nets=5",
        f"optim.utd_ratio={INTERVAL}",
    ]


def run(agent, updates, size=BATCH):
    metrics = []
    for i in updates:
        torch.manual_seed(i)  # what the loop's checkpoint restores
        metrics.append(agent.update(batch_of(i, size)))
    return metrics


def copies(module_or_params):
    return [param.detach().clone() for param in module_or_params]


def changed(before, after):
    return [not torch.equal(a, b) for a, b in zip(before, after, strict=True)]


@pytest.mark.parametrize("variant", ["rlpd", "wsrl"])
def test_every_update_trains_the_critics_and_every_fourth_the_actor(make_agent, variant):
    agent = make_agent(*small(variant))
    loss = agent.state["loss"]
    for i in range(1, 9):
        critics = copies(loss.qvalue_network_params.parameters())
        targets = copies(loss.target_qvalue_network_params.values(True, True))
        others = copies([loss.raw_alpha, *loss.actor_network.parameters()])
        (metrics,) = run(agent, [i])
        assert all(changed(critics, loss.qvalue_network_params.parameters()))
        assert all(changed(targets, loss.target_qvalue_network_params.values(True, True)))
        trained = changed(others, [loss.raw_alpha, *loss.actor_network.parameters()])
        assert all(trained) if i % INTERVAL == 0 else not any(trained)
        assert ("loss_actor" in metrics and "loss_alpha" in metrics) == (i % INTERVAL == 0)
        assert not any(value.requires_grad for value in metrics.values())


@pytest.mark.parametrize(("variant", "num_batches"), [("rlpd", 1), ("wsrl", INTERVAL)])
def test_the_actor_sees_the_last_batch_or_all_since_its_last_step(make_agent, variant, num_batches):
    agent = make_agent(*small(variant))
    seen = []
    network = agent.policy.module[0].module[0]
    network.register_forward_pre_hook(lambda _, inputs: seen.append(inputs[0]))
    run(agent, range(2 * INTERVAL))
    last = range(2 * INTERVAL - num_batches, 2 * INTERVAL)
    expected = torch.cat([batch_of(i, BATCH)["observation"] for i in last])
    torch.testing.assert_close(seen[-1], expected, rtol=0, atol=0)


def test_the_variants_differ_in_normalisation_and_initialisation(make_agent):
    for variant, actor_norms in (("rlpd", 0), ("wsrl", 2)):
        loss = make_agent(f"variant={variant}").state["loss"]
        norms = [m for m in loss.actor_network.modules() if isinstance(m, nn.LayerNorm)]
        assert len(norms) == actor_norms
        stacks = loss.qvalue_network_params["module", "layers"]
        hidden, gain = stacks["3", "weight"][7], 1.0 if variant == "rlpd" else 1e-2
        if variant == "rlpd":
            bound = (6 / 512) ** 0.5
            assert 0.99 * bound < hidden.abs().max() <= bound
        else:
            torch.testing.assert_close(hidden @ hidden.mT, gain**2 * torch.eye(256))
        linears = [m for m in loss.actor_network.modules() if isinstance(m, nn.Linear)]
        assert [tuple(m.weight.shape) for m in linears] == [(256, 4), (256, 256), (2, 256)]
        assert not any(m.bias.any() for m in linears)


def test_the_actor_steps_once_for_each_step_of_the_environment_or_for_each_update(make_agent):
    for ratio, updates, actor_steps in ((0.2, 3, 3), (1, 3, 3), (4, 8, 2)):
        sizes = [*small("rlpd")[:-1], f"optim.utd_ratio={ratio}"]
        metrics = run(make_agent(*sizes), range(updates))
        assert sum("loss_actor" in each for each in metrics) == actor_steps
