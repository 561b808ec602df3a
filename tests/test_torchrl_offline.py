"""What TorchRL 0.14.1 does with offline data: each test is a row of docs/torchrl_offline.md.

The tests assert what happens today. One that fails says that TorchRL has changed.
"""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import nn
from torch.distributions import Independent, Uniform
from torchrl.data import (
    Bounded,
    LazyTensorStorage,
    MultiStep,
    OfflineToOnlineReplayBuffer,
    ReplayBuffer,
    ReplayBufferEnsemble,
    TensorDictReplayBuffer,
)
from torchrl.envs import GymEnv
from torchrl.modules import NormalParamExtractor, ProbabilisticActor, TanhNormal, ValueOperator
from torchrl.objectives import CQLLoss, REDQLoss


def ones(*shape: int) -> np.ndarray:
    return np.ones(shape, dtype=np.float32)


def filled(kind: type[ReplayBuffer], value: float, dtype: torch.dtype = torch.float32):
    buffer = kind(storage=LazyTensorStorage(10))
    buffer.extend(rows(value, dtype))
    return buffer


def rows(value: float, dtype: torch.dtype = torch.float32) -> TensorDict:
    return TensorDict({"observation": torch.full((10, 2), value, dtype=dtype)}, batch_size=[10])


# --- data sets ------------------------------------------------------------------------------------


def test_minari_experience_replay_returns_zeros(tmp_path, monkeypatch):
    minari = pytest.importorskip("minari")
    from gymnasium.spaces import Box
    from minari.data_collector import EpisodeBuffer
    from torchrl.data.datasets import MinariExperienceReplay

    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "minari"))
    monkeypatch.chdir(tmp_path)
    episodes = [
        EpisodeBuffer(
            id=number,
            observations=ones(6, 3),
            actions=ones(5, 2),
            rewards=ones(5),
            terminations=np.zeros(5, dtype=bool),
            truncations=np.arange(5) == 4,
        )
        for number in range(2)
    ]
    spaces = {"observation_space": Box(-1, 1, (3,)), "action_space": Box(-1, 1, (2,))}
    minari.create_dataset_from_buffers("toy/ones-v0", episodes, **spaces)
    stored = minari.load_dataset("toy/ones-v0")[0]
    data = MinariExperienceReplay(
        "toy/ones-v0", batch_size=8, root="torchrl", load_from_local_minari=True, download=False
    )
    assert (stored.observations == 1).all() and (stored.rewards == 1).all()
    for key in ("observation", "action", ("next", "observation"), ("next", "reward")):
        assert (data[:][key] == 0).all()


def test_d4rl_experience_replay_zeroes_the_observation_after_a_time_out(tmp_path, monkeypatch):
    h5py = pytest.importorskip("h5py")
    from torchrl.data.datasets import D4RLExperienceReplay
    from torchrl.data.datasets.d4rl_infos import D4RL_DATASETS

    with h5py.File(tmp_path / "toy.hdf5", "w") as file:  # D4RL's layout: two episodes of five steps
        for name, width in (("observations", 3), ("next_observations", 3), ("actions", 2)):
            file[name] = ones(10, width)
        file["rewards"] = ones(10)
        file["terminals"] = np.zeros(10, dtype=bool)
        file["timeouts"] = np.arange(10) % 5 == 4
    monkeypatch.setitem(D4RL_DATASETS, "toy", (tmp_path / "toy.hdf5").as_uri())
    root = str(Path(tmp_path, "d4rl"))
    data = D4RLExperienceReplay("toy", batch_size=4, direct_download=True, root=root)
    following = data[:]["next"]
    zeroed = (following["observation"] == 0).all(-1)
    assert zeroed.nonzero().flatten().tolist() == [4]
    assert following["truncated"][4] and not following["terminated"][4]
    assert len(data) == 9  # of 10


# --- mixtures -------------------------------------------------------------------------------------


def test_offline_to_online_replay_buffer_fails_with_the_index_of_its_own_data_sets():
    mixture = OfflineToOnlineReplayBuffer(
        filled(TensorDictReplayBuffer, 0.0), online_capacity=10, batch_size=8
    )
    mixture.extend(rows(1.0))
    with pytest.raises(KeyError, match="incompatible"):
        mixture.sample()


def test_offline_to_online_replay_buffer_hides_an_empty_half_and_mixes_dtypes():
    mixture = OfflineToOnlineReplayBuffer(
        filled(ReplayBuffer, 0.0), online_capacity=10, batch_size=8
    )
    assert (mixture.sample()["observation"] == 0).all()  # all offline: nothing is online yet
    mixture.extend(rows(1.0, torch.float64))
    assert mixture.sample()["observation"].dtype is torch.float64
    assert not hasattr(mixture, "state_dict")


def test_replay_buffer_ensemble_draws_one_sided_batches():
    ensemble = ReplayBufferEnsemble(
        filled(ReplayBuffer, 0.0), filled(ReplayBuffer, 1.0), p=[0.5, 0.5], batch_size=256
    )
    from_first = [int((ensemble.sample()["observation"][..., 0] == 0).sum()) for _ in range(100)]
    assert set(from_first) == {0, 128, 256}
    assert ensemble.sample().batch_size == (2, 128)


# --- rows -----------------------------------------------------------------------------------------


def test_multi_step_bootstraps_through_termination():
    ended = torch.tensor([False, False, False, True]).view(1, 4, 1)
    number = torch.arange(4.0).view(1, 4, 1)
    following = {"observation": number + 1, "reward": torch.ones(1, 4, 1)}
    flags = {"done": ended, "terminated": ended.clone(), "truncated": torch.zeros_like(ended)}
    mask = {"mask": torch.ones(1, 4, dtype=torch.bool)}
    content = {"observation": number, "next": {**following, **flags}, "collector": mask}
    data = MultiStep(gamma=0.5, n_steps=3)(TensorDict(content, batch_size=[1, 4]))
    reward, terminated = data["next", "reward"], data["next", "terminated"]
    assert reward.flatten().tolist() == [1.75, 1.75, 1.5, 1.0]
    assert data["next", "observation"].flatten().tolist() == [3, 4, 4, 4]
    assert terminated.flatten().tolist() == [False, False, False, True]  # expected F, T, T, T
    value = 100
    target = reward + data["gamma"].view_as(reward) * value * ~terminated
    # The second and the third window end with the episode: 1.75 and 1.5 would be right.
    assert target.flatten().tolist() == [14.25, 14.25, 26.5, 1.0]


def test_gym_env_with_num_envs_loses_the_last_observation():
    env = GymEnv("Pendulum-v1", num_envs=2)
    env.set_seed(0)
    last = env.rollout(200, break_when_any_done=False)[:, -1]["next"]
    env.close()
    assert last["truncated"].all() and not last["terminated"].any()
    assert (last["observation"] == 0).all()  # expected cosine, sine and velocity


# --- losses ---------------------------------------------------------------------------------------


class BoxUniform(Independent):
    def __init__(self, low, high):
        super().__init__(Uniform(low, high), 1)


class UniformPolicy(nn.Module):
    def forward(self, observation):
        bound = torch.ones(*observation.shape[:-1], 2)
        return -bound, bound


class LinearCritic(nn.Module):
    def __init__(self):
        super().__init__()
        self.linear = nn.Linear(5, 1)

    def forward(self, observation, action):
        return self.linear(torch.cat([observation, action], -1))


def cql_loss(**kwargs) -> CQLLoss:
    policy = ProbabilisticActor(
        TensorDictModule(UniformPolicy(), in_keys=["observation"], out_keys=["low", "high"]),
        in_keys=["low", "high"],
        distribution_class=BoxUniform,
    )
    critic = ValueOperator(LinearCritic(), in_keys=["observation", "action"])
    return CQLLoss(policy, critic, action_spec=Bounded(-1, 1, (2,)), num_random=10, **kwargs)


def batch() -> TensorDict:
    flag = torch.zeros(64, 1, dtype=torch.bool)
    following = {"observation": torch.randn(64, 3), "reward": torch.randn(64, 1)}
    return TensorDict(
        {
            "observation": torch.randn(64, 3),
            "action": torch.rand(64, 2) * 2 - 1,
            "next": {**following, "done": flag, "terminated": flag},
        },
        batch_size=[64],
    )


def test_cql_loss_has_log_sum_exps_of_three_terms():
    """For a critic of zero and a uniform policy each of the terms is -log((1/2)^2).

    So the regulariser of a critic is the logarithm of the number of terms plus 2 log 2.
    """
    loss = cql_loss()
    for parameter in loss.parameters():
        parameter.data.zero_()
    per_critic = loss(batch())["loss_cql"].item() / 2
    assert math.isclose(per_critic, math.log(3) + 2 * math.log(2), rel_tol=1e-5)  # expected 30


def test_cql_loss_with_lagrange_pulls_the_critic_the_wrong_way():
    """The multiplier's loss should not reach the critic; it takes away half of the regulariser."""
    loss = cql_loss(with_lagrange=True)
    losses = loss(batch())
    weights = [p for name, p in loss.named_parameters() if name.startswith("qvalue_network_params")]
    regulariser = torch.autograd.grad(losses["loss_cql"], weights, retain_graph=True)
    multiplier = torch.autograd.grad(losses["loss_alpha_prime"], weights)
    for pull, push in zip(regulariser, multiplier, strict=True):
        torch.testing.assert_close(push, -0.5 * pull)


@pytest.mark.parametrize(
    ("bounds", "expected"), [({}, 0.1), ({"min_alpha": 0.0, "max_alpha": math.inf}, math.exp(-5))]
)
def test_redq_loss_clamps_alpha(bounds, expected):
    network = nn.Sequential(nn.Linear(3, 4), NormalParamExtractor())
    policy = ProbabilisticActor(
        TensorDictModule(network, in_keys=["observation"], out_keys=["loc", "scale"]),
        in_keys=["loc", "scale"],
        spec=Bounded(-1, 1, (2,)),
        distribution_class=TanhNormal,
    )
    critic = ValueOperator(nn.Bilinear(3, 2, 1), in_keys=["observation", "action"])
    loss = REDQLoss(policy, critic, **bounds)
    loss.log_alpha.data.fill_(-5.0)
    assert loss.alpha.item() == pytest.approx(expected, abs=1e-5)
