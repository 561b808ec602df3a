"""Rows of transitions: where they come from, what they look like, which data set they are."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.utils import NestedKey
from torchrl.data import RandomSampler, ReplayBuffer, TensorStorage

__all__ = ["Layout", "fingerprint", "layout_of", "require_layout", "require_plain", "rows_of"]

BLOCK = 100_000  # rows that a fingerprint reads at a time
Layout = dict[NestedKey, tuple[torch.dtype, tuple[int, ...], torch.device]]


def rows_of(offline: TensorDictBase | ReplayBuffer | None) -> TensorDictBase:
    """The rows of an offline half, not copied; none at all for None.

    Raises:
        ValueError: if it is neither a TensorDict nor a buffer whose storage can be read directly.
    """
    if offline is None:
        return TensorDict({}, batch_size=[0])
    if isinstance(offline, ReplayBuffer):
        require_plain(offline, "offline")
        return offline.storage[:]
    if not isinstance(offline, TensorDictBase):
        raise ValueError(
            "offline must be a TensorDict of transitions or a ReplayBuffer that holds them, got "
            f"{type(offline).__name__}."
        )
    return offline


def require_plain(buffer: ReplayBuffer, name: str) -> None:
    """Refuse what reading and writing rows in the storage, and drawing uniformly, pass over.

    Raises:
        ValueError: naming the sampler, storage or transform.
    """
    sampler, storage = buffer.sampler, buffer.storage
    if not isinstance(sampler, RandomSampler):
        raise ValueError(
            f"The {name} buffer must have TorchRL's uniform RandomSampler, got "
            f"{type(sampler).__name__}: its order, priorities or slices would be passed over. "
            "Use TensorDictReplayBuffer(storage=LazyTensorStorage(n))."
        )
    if not isinstance(storage, TensorStorage) or storage.ndim != 1:
        raise ValueError(
            f"The {name} buffer must have a TensorStorage with ndim=1, such as "
            f"LazyTensorStorage(n), got {type(storage).__name__} with ndim={storage.ndim}."
        )
    if len(buffer.transform):
        raise ValueError(
            f"The {name} buffer must have no transform, got {buffer.transform}: rows are read from "
            "the storage and written to it, past the transform. Apply it to the data before, or to "
            "the batch that is sampled."
        )


def layout_of(rows: TensorDictBase, keys: Sequence[NestedKey], name: str) -> Layout:
    """Dtype, shape without the batch dimension, and device of each key.

    Raises:
        ValueError: if there is not one batch dimension, or no tensor under a key.
    """
    if rows.ndim != 1:
        raise ValueError(
            f"{name} must have one batch dimension, got batch size {tuple(rows.batch_size)}. "
            "Flatten with reshape(-1)."
        )
    layout: Layout = {}
    for key in keys:
        value = rows.get(key, None)
        if not isinstance(value, torch.Tensor):
            raise ValueError(
                f"{name} must have a tensor under {key!r}, got {type(value).__name__}; it has "
                f"{list(rows.keys(True, True))}. Choose with keys=[...] what both halves have."
            )
        layout[key] = (value.dtype, tuple(value.shape[1:]), value.device)
    return layout


def require_layout(got: Layout, expected: Layout, name: str, one_device: bool = True) -> None:
    """Compare the layout of rows with that of the rows that they will be mixed with.

    Args:
        got: of the rows.
        expected: of those that they will be mixed with.
        name: what the rows are.
        one_device: compare the devices as well.

    Raises:
        ValueError: naming the first key that differs.
    """
    for key, entry in expected.items():
        if got[key][:2] != entry[:2] or (one_device and got[key] != entry):
            raise ValueError(
                f"{name} must have the layout of the rows that it is mixed with: for {key!r} "
                f"expected {_describe(*entry)}, got {_describe(*got[key])}. Convert one of the "
                "two; for float64 observations put DoubleToFloat on the environment."
            )


def _describe(dtype: torch.dtype, shape: tuple[int, ...], device: torch.device) -> str:
    return f"{dtype} of shape ({', '.join(map(str, ('n', *shape)))}) on {device}"


def fingerprint(rows: TensorDictBase, keys: Sequence[NestedKey]) -> str:
    """SHA-256 of all rows, which are read once, a block at a time."""
    digest = hashlib.sha256()
    for key in keys if len(rows) else ():
        column = rows.get(key)
        digest.update(f"{key} {column.dtype} {tuple(column.shape)}".encode())
        for block in column.split(BLOCK):
            values = block.cpu().contiguous().flatten().view(torch.uint8)
            digest.update(memoryview(values.numpy()))
    return digest.hexdigest()
