"""Experience of the bandit: random actions, or those that a policy draws itself."""

from __future__ import annotations

from tensordict.nn import TensorDictModuleBase
from torchrl.collectors import Collector

from bandit.config import BanditConfig
from bandit.env import TwoDBandit


def make_collector(cfg: BanditConfig, policy: TensorDictModuleBase) -> Collector:
    """Batches of `collector.frames_per_batch` actions, `collector.frames` in all."""
    settings = cfg.collector
    uniform = cfg.data == "uniform"
    return Collector(
        TwoDBandit(settings.frames_per_batch, settings.half_width),
        policy,
        frames_per_batch=settings.frames_per_batch,
        total_frames=settings.frames,
        init_random_frames=settings.frames if uniform else settings.warmup_frames,
        auto_register_policy_transforms=False,
    )
