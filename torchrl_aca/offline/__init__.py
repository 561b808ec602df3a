"""Offline data: one form on disk, importers, replay. Knows no algorithm."""

from torchrl_aca.offline.dataset import OfflineDataset, returns_to_go
from torchrl_aca.offline.errors import DatasetError
from torchrl_aca.offline.writer import DatasetWriter

__all__ = [
    "DatasetError",
    "DatasetWriter",
    "OfflineDataset",
    "returns_to_go",
]
