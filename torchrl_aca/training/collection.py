"""Experience: checked batches from a collector, the frames and the returns of the episodes."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torchrl.collectors import BaseCollector, Collector
from torchrl.envs import GymWrapper

from torchrl_aca.errors import RunError
from torchrl_aca.training.acceleration import WARMUP
from torchrl_aca.training.config import Collector as CollectorSettings
from torchrl_aca.training.env_state import EnvState
from torchrl_aca.training.randomness import RandomState


class BadDataError(RunError):
    """An environment has given NaN or infinity; nothing of that batch was kept."""


class Collection:
    """Iterates over batches of experience of shape (num_envs, steps), without an end.

    Each batch is checked for NaN, and counted, before it is handed over. The policy's weights are
    brought to the collector after the body of the loop. The states of the environments are part of
    the collection's own: where they cannot be saved, a resumed run begins new episodes.

    Attributes:
        frames: Environment steps made, over all environments, warm-up included.
        episodes: Returns of the episodes under way and of the latest that have ended.
        savable: Whether the environments' states can be saved.
    """

    def __init__(
        self,
        env: GymWrapper,
        policy: TensorDictModuleBase,
        settings: CollectorSettings,
        device: torch.device | str = "cpu",
        captured: bool = False,
    ) -> None:
        """Takes what acts on what.

        Args:
            env: Environments made by `make_vector_env`.
            policy: Maps observations to actions.
            settings: Frames of a batch, frames before the first update, and who acts meanwhile.
            device: Device of the policy.
            captured: Whether the policy acts through a CUDA graph.
        """
        self.env, self.policy, self.device, self.captured = env, policy, device, captured
        self.settings = settings
        self.frames = 0
        self.episodes = EpisodeTracker(env.batch_size.numel())
        self.savable = True
        self._collector: BaseCollector | None = None

    def __iter__(self) -> Iterator[TensorDictBase]:
        """Collects; what is restored must be restored before."""
        for data in self._batches():
            check_finite(data, self.frames)
            self.frames += data.numel()
            self.episodes.add(data)
            yield data

    def _batches(self) -> Iterator[TensorDictBase]:
        self._collector = self._build()
        for data in self._collector:
            yield data
            self._collector.update_policy_weights_()

    def _build(self) -> BaseCollector:
        random = RandomState().state_dict() if self.frames else None
        random_frames = self.settings.warmup_frames if self.settings.warmup == "random" else 0
        collector = self._make_collector(max(0, random_frames - self.frames))
        if random:  # building draws random numbers: a run that goes on has drawn them before
            RandomState().load_state_dict(random)
        return collector

    def _make_collector(self, random_frames: int) -> BaseCollector:
        return Collector(
            self.env,
            self.policy,
            frames_per_batch=self.settings.frames_per_batch,
            init_random_frames=random_frames,
            total_frames=-1,
            policy_device=self.device,
            env_device="cpu",
            storing_device="cpu",
            cudagraph_policy={"warmup": WARMUP} if self.captured else False,
            auto_register_policy_transforms=False,  # these policies are feed-forward
        )

    def close(self) -> None:
        """Ends the collector and its environments."""
        if self._collector is not None:
            self._collector.shutdown()

    def why_unsavable(self) -> str | None:
        """Tries to save the environments, and returns why their episodes cannot go on, if so."""
        state = EnvState(self.env)
        try:
            state.state_dict()
        except Exception as error:  # environments are foreign code
            self.savable = False
            return f"{type(error).__name__}: {error}"
        return None if state.is_exact else "it is not MuJoCo's, or has wrappers"

    def state_dict(self) -> dict[str, Any]:
        """Returns frames, episodes, and the states of the environments where they can be saved."""
        return {
            "frames": self.frames,
            "episodes": self.episodes.state_dict(),
            "env": EnvState(self.env).state_dict() if self.savable else None,
        }

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Restores what `state_dict` returned; new episodes where their state was not saved."""
        self.frames = state_dict["frames"]
        self.episodes.load_state_dict(state_dict["episodes"])
        state = EnvState(self.env)
        if state_dict["env"] is not None:
            state.load_state_dict(state_dict["env"], in_episode=self.frames > 0)
        if state_dict["env"] is None or not state.is_exact:
            self.episodes.reset()


class EpisodeTracker:
    """Sums rewards per environment and keeps the returns of the latest finished episodes."""

    def __init__(self, num_envs: int, window: int = 20) -> None:
        """Tracks `num_envs` environments and averages over the last `window` episodes."""
        self.returns = torch.zeros(num_envs, dtype=torch.float64)
        self.lengths = torch.zeros(num_envs, dtype=torch.int64)
        self.finished = 0
        self.latest: deque[tuple[float, int]] = deque(maxlen=window)

    def add(self, data: TensorDictBase) -> None:
        """Adds collected data of shape (num_envs, steps)."""
        rewards, dones = data["next", "reward"].squeeze(-1), data["next", "done"].squeeze(-1)
        for reward, done in zip(rewards.unbind(-1), dones.unbind(-1), strict=True):
            self.returns += reward
            self.lengths += 1
            if done.any():
                ended = zip(self.returns[done].tolist(), self.lengths[done].tolist(), strict=True)
                self.latest.extend(ended)
                self.finished += int(done.sum())
                self.returns[done], self.lengths[done] = 0, 0

    def metrics(self) -> dict[str, float]:
        """Returns the mean return and length of the latest training episodes, and their count."""
        metrics = {"train_episodes": float(self.finished)}
        if self.latest:
            returns, lengths = zip(*self.latest, strict=True)
            metrics["train_return"] = sum(returns) / len(returns)
            metrics["train_episode_length"] = sum(lengths) / len(lengths)
        return metrics

    def reset(self) -> None:
        """Forgets the unfinished episodes, for environments that start afresh."""
        self.returns.zero_()
        self.lengths.zero_()

    def state_dict(self) -> dict[str, Any]:
        """Returns the running sums and the latest episodes."""
        return {
            "returns": self.returns.clone(),
            "lengths": self.lengths.clone(),
            "finished": self.finished,
            "latest": list(self.latest),
        }

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Restores what `state_dict` returned."""
        self.returns.copy_(state_dict["returns"])
        self.lengths.copy_(state_dict["lengths"])
        self.finished = state_dict["finished"]
        self.latest.clear()
        self.latest.extend(state_dict["latest"])


def check_finite(data: TensorDictBase, frames: int) -> None:
    """Raises `BadDataError` if collected data hold NaN or infinity.

    Args:
        data: What was collected after `frames` frames.
        frames: For the message.
    """
    for key in (("next", "observation"), ("next", "reward"), "action"):
        if not data[key].isfinite().all():
            name = key if isinstance(key, str) else ".".join(key)
            raise BadDataError(
                f"the environment gave a NaN or infinite {name!r} after {frames} frames; expected "
                "finite numbers. These transitions were not stored. Look at the environment's "
                "reward and physics, or at the learning rate if the actions blew up first."
            )
