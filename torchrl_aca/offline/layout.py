"""The canonical form on disk: which files a data set has, and what their bytes mean.

A data set is a directory with one raw file per key, laid out as `TensorDict.memmap` does it, and
`metadata.json`. `TensorDict.load_memmap` reads it too.
"""

from __future__ import annotations

import hashlib
from math import prod
from pathlib import Path

import torch
from tensordict.utils import NestedKey

FORMAT = "torchrl-aca dataset 1"
METADATA_FILE = "metadata.json"


def row_layout(
    observation_dim: int, action_dim: int
) -> dict[NestedKey, tuple[tuple[int, ...], torch.dtype]]:
    """Returns the shape of one row and the dtype for each key of a data set."""
    return {
        "observation": ((observation_dim,), torch.float32),
        "action": ((action_dim,), torch.float32),
        ("next", "observation"): ((observation_dim,), torch.float32),
        ("next", "reward"): ((1,), torch.float32),
        ("next", "done"): ((1,), torch.bool),
        ("next", "terminated"): ((1,), torch.bool),
        ("next", "truncated"): ((1,), torch.bool),
        "episode": ((), torch.int64),
    }


def file_name(key: NestedKey) -> str:
    """Returns the file of a key, relative to the data set's directory."""
    return ("/".join(key) if isinstance(key, tuple) else key) + ".memmap"


def dotted(key: NestedKey) -> str:
    """Returns a key as messages show it, such as "next.reward"."""
    return ".".join(key) if isinstance(key, tuple) else key


def row_bytes(shape: tuple[int, ...], dtype: torch.dtype) -> int:
    """Returns the size of one row of a key in its file."""
    return prod(shape) * dtype.itemsize


def sha256(path: Path) -> str:
    """Returns the SHA-256 of a file in hexadecimal digits, reading it piece by piece."""
    digest = hashlib.sha256()
    with open(path, "rb") as file:
        while piece := file.read(1 << 20):
            digest.update(piece)
    return digest.hexdigest()
