"""Float64 numbers for tests that compare with what was worked out by hand."""

from __future__ import annotations

import torch

TENSORS = {"dtype": torch.float64}


def tensor(*values):
    return torch.tensor(values, **TENSORS)


def close(actual, expected, atol=1e-12):
    torch.testing.assert_close(actual, expected, rtol=0, atol=atol)
