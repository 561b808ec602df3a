"""Batches with exact shares of offline and online rows."""

from __future__ import annotations

from collections.abc import Sequence
from fractions import Fraction
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.utils import NestedKey, unravel_key
from torchrl.data import ReplayBuffer

from torchrl_aca.checks import check_at_least
from torchrl_aca.replay.buffer import BufferState
from torchrl_aca.replay.rows import (
    Layout,
    fingerprint,
    layout_of,
    require_layout,
    require_plain,
    rows_of,
)

__all__ = ["MixedReplayBuffer"]

N_STEPS = "steps_to_next_obs"  # what TorchRL's MultiStepTransform adds, and value estimators need


class MixedReplayBuffer:
    """Draws each batch from a fixed offline data set and a growing online buffer, in exact shares.

    The offline share of a batch of B rows is ``offline_fraction * B``, rounded to the nearest
    integer, halves up: 128 of 256 at 0.5, and 128 of 255. The fraction is taken as the decimal
    number that Python prints, so 0.29 of 50 rows is 14.5 and gives 15. A fraction of 0 needs no
    offline data, a fraction of 1 no online data. Rows are drawn uniformly with replacement, with
    a generator that belongs to the mixture alone: the global random stream stays as it is. This
    is the minibatch of RLPD (Ball et al. 2023, arXiv 2302.02948, algorithm 1).

    **One call of** :meth:`sample` **is one gradient step's batch.** The offline rows come first.
    So with several gradient steps per environment step, call it once for each: the slices of one
    big batch would be all offline first and all online later.

    **Rewards** are stored and returned as they came, in both halves. Scale them once, where the
    batch is used: ``ACALoss(reward_scale=...)`` does it, or multiply ``batch["next", "reward"]``.
    Buffers with a transform of their own are refused, because a transform of one half alone makes
    the two unequal.

    TorchRL's own classes cannot give this through their public interface (0.14.1).
    ``OfflineToOnlineReplayBuffer`` has exact shares, but draws from the global stream, answers an
    empty online half with an all-offline batch, mixes float32 and float64 into float64, and has
    no ``state_dict``. ``ReplayBufferEnsemble`` has equal shares only, or random ones.

    Args:
        offline: transitions of batch size (N,), in memory or memory-mapped, or a ``ReplayBuffer``
            that holds them. They are only read. None is allowed with ``offline_fraction=0``.
        online: a ``ReplayBuffer`` with a ``LazyTensorStorage`` or another ``TensorStorage``, and a
            uniform sampler; it may be empty. Prioritised replay is refused.
        offline_fraction: share of the offline rows in each batch, in [0, 1].
        batch_size: B, the rows of a batch.
        keys: what is stored and returned, each the key of a tensor. None means all keys of the
            offline half, without the ``index`` that ``TensorDictReplayBuffer`` adds.
        seed: seed of the mixture's own generator.

    Attributes:
        online: the online buffer.
        keys: the keys of each batch.
        batch_size: the default of :meth:`sample`.

    Raises:
        ValueError: if a half has other keys, dtypes, shapes or devices than the other, has a
            sampler, a storage or a transform that cannot be honoured here, or if a number is out
            of range. An online half that is empty is checked when data arrives.

    Examples:
        >>> from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
        >>> from torchrl_aca.replay import MixedReplayBuffer
        >>> online = TensorDictReplayBuffer(storage=LazyTensorStorage(1000))
        >>> buffer = MixedReplayBuffer(data, online, offline_fraction=0.25, batch_size=8, seed=1)
        >>> indices = buffer.extend(data[:3])
        >>> buffer.num_offline(8), buffer.sample().batch_size
        (2, torch.Size([8]))
    """

    def __init__(
        self,
        offline: TensorDictBase | ReplayBuffer | None,
        online: ReplayBuffer,
        *,
        offline_fraction: float = 0.5,
        batch_size: int = 256,
        keys: Sequence[NestedKey] | None = None,
        seed: int = 0,
    ) -> None:
        check_at_least(1, batch_size=batch_size)
        if offline is None and (offline_fraction or keys is None):
            raise ValueError(
                "offline=None needs offline_fraction=0 and keys=[...], got "
                f"offline_fraction={offline_fraction} and keys={keys}. Pass the offline data."
            )
        require_plain(online, "online")
        self.online, self.batch_size = online, batch_size
        self.offline_fraction = offline_fraction
        self._generator = torch.Generator().manual_seed(seed)
        self._offline = rows_of(offline)
        if keys is None:
            keys = [key for key in self._offline.keys(True, True) if key != "index"]
        self.keys = [unravel_key(key) for key in keys]
        self._layout: Layout | None = None  # without offline data, the first online rows set it
        if offline is not None:
            self._check(self._offline, "The offline half")
        self._online_is_checked = False
        self._fingerprint = fingerprint(self._offline, self.keys)
        self._check_online()

    def __len__(self) -> int:
        """The rows of both halves."""
        return len(self._offline) + len(self.online)

    @property
    def offline_fraction(self) -> float:
        """Share of the offline rows in a batch; it may change between two batches.

        Raises:
            ValueError: if it is set to a number outside [0, 1].
        """
        return float(self._fraction)

    @offline_fraction.setter
    def offline_fraction(self, value: float) -> None:
        if not 0 <= value <= 1:
            raise ValueError(f"Expected offline_fraction in [0, 1], got {value}.")
        self._fraction = Fraction(str(value))

    def num_offline(self, batch_size: int) -> int:
        """Number of offline rows in a batch of ``batch_size``; they are its first rows."""
        return int(self._fraction * batch_size + Fraction(1, 2))

    def sample(self, batch_size: int | None = None) -> TensorDictBase:
        """Draw the batch of one gradient step.

        Args:
            batch_size: B; None means the constructor's.

        Returns:
            Rows in new memory, of batch size (B,): ``num_offline(B)`` offline ones, then the
            online ones.

        Raises:
            ValueError: if a half that rows are due from is empty.
        """
        size = self.batch_size if batch_size is None else batch_size
        check_at_least(1, batch_size=size)
        self._check_online()
        num_offline = self.num_offline(size)
        drawn = []
        if num_offline:
            drawn.append((self._offline, self._draw(len(self._offline), num_offline, "offline")))
        if num_online := size - num_offline:
            index = self._draw(len(self.online), num_online, "online")
            drawn.append((self.online.storage[:], index))
        batch = TensorDict({}, batch_size=[size])
        for key in self.keys:
            halves = [(rows.get(key), index) for rows, index in drawn]
            batch.set(key, torch.cat([v.index_select(0, i.to(v.device)) for v, i in halves]))
        return batch

    def _draw(self, rows: int, count: int, half: str) -> torch.Tensor:
        if rows == 0:
            raise ValueError(
                f"Expected {count} {half} rows in a batch, got an empty {half} half. Add data to "
                "it first, or choose an offline_fraction that does not need it."
            )
        return torch.randint(rows, (count,), generator=self._generator)

    def extend(self, data: TensorDictBase) -> torch.Tensor:
        """Add rows of batch size (n,) to the online half; keys that are not learnt from are left.

        Returns:
            The places of the rows in the online storage, (n,).

        Raises:
            ValueError: if a key, dtype, shape or device differs from the offline half's.
        """
        self._check(data, "The data to add")
        return self.online.extend(data.select(*self.keys))

    def add(self, data: TensorDictBase) -> int:
        """Add one transition, of batch size (), to the online half, as :meth:`extend` does."""
        self._check(data.unsqueeze(0), "The data to add")
        return self.online.add(data.select(*self.keys))

    def _check_online(self) -> None:
        """Check once the rows that reached the online buffer by another way than `extend`."""
        if not self._online_is_checked and len(self.online):
            self._check(self.online.storage[:1], "The online half")
            self._online_is_checked = True

    def _check(self, rows: TensorDictBase, name: str) -> None:
        if N_STEPS not in self.keys and rows.get(N_STEPS, None) is not None:
            raise ValueError(
                f"{name} has {N_STEPS!r}, so its rewards are sums over several steps, but the "
                f"mixture's keys are {self.keys}. Give the offline half the same n-step return and "
                "key, or leave MultiStepTransform out."
            )
        layout = layout_of(rows, self.keys, name)
        self._layout = self._layout or layout
        # On its own, the online half may lie on another device than what is added to it.
        require_layout(layout, self._layout, name, one_device=len(self._offline) > 0)

    def state_dict(self) -> dict[str, Any]:
        """Return the generator's state, the online rows and a fingerprint of the offline data.

        The offline rows are not in it: they do not change, and may be many. The rows of a full
        online buffer share its memory, so write or copy them before the next :meth:`extend`.
        """
        return {
            "generator": self._generator.get_state(),
            "built_from": self._built_from(),
            "offline_fraction": self.offline_fraction,
            "online": BufferState(self.online, self.keys).state_dict(),
        }

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Restore what :meth:`state_dict` returned; the next batches are those that were due.

        Raises:
            ValueError: if batch size, offline data, keys or capacity are not the state's.
        """
        for name, got in self._built_from().items():
            if (expected := state_dict["built_from"][name]) != got:
                raise ValueError(
                    f"The state belongs to another mixture: expected {name} {expected}, got {got}. "
                    "Build the mixture as it was when the state was saved."
                )
        self.offline_fraction = state_dict["offline_fraction"]
        BufferState(self.online, self.keys).load_state_dict(state_dict["online"])
        self._generator.set_state(state_dict["generator"])

    def _built_from(self) -> dict[str, Any]:
        """What a state does not hold, but is good for alone."""
        return {
            "batch_size": self.batch_size,
            "online capacity": self.online.storage.max_size,
            "keys": self.keys,
            "offline rows": len(self._offline),
            "offline fingerprint": self._fingerprint,
        }

    def dumps(self, path: str | Path) -> None:
        """Write :meth:`state_dict` into a directory, which is made where there is none."""
        directory = Path(path)
        directory.mkdir(parents=True, exist_ok=True)
        torch.save(self.state_dict(), directory / "mixture.pt")

    def loads(self, path: str | Path) -> None:
        """Restore what :meth:`dumps` wrote into a directory."""
        self.load_state_dict(torch.load(Path(path) / "mixture.pt", weights_only=True))
