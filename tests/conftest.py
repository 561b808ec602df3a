from __future__ import annotations

import pytest
import torch


def pytest_configure() -> None:
    # The nets of the tests are small: more threads cost more than they bring.
    torch.set_num_threads(1)


@pytest.fixture(autouse=True)
def fixed_seed() -> None:
    torch.manual_seed(0)
