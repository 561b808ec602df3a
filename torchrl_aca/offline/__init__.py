"""Offline data: one form on disk, writing, checks, importers. Knows no algorithm."""

from torchrl_aca.errors import DatasetError
from torchrl_aca.offline.bounds import return_bounds
from torchrl_aca.offline.dataset import OfflineDataset, returns_to_go
from torchrl_aca.offline.from_d4rl import import_d4rl
from torchrl_aca.offline.from_minari import import_minari
from torchrl_aca.offline.registry import register_datasets
from torchrl_aca.offline.scores import reference_scores
from torchrl_aca.offline.writer import DatasetWriter

__all__ = [
    "DatasetError",
    "DatasetWriter",
    "OfflineDataset",
    "import_d4rl",
    "import_minari",
    "reference_scores",
    "register_datasets",
    "return_bounds",
    "returns_to_go",
]
