"""Float64 numbers for tests that compare with what was worked out by hand."""

from __future__ import annotations

from functools import partial

import torch

TENSORS = {"dtype": torch.float64}
assert_close = partial(torch.testing.assert_close, rtol=0, atol=1e-12)


def tensor(*values):
    return torch.tensor(values, **TENSORS)
