"""What `compile` and `cudagraphs` of a configuration do to the parts of an update."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any

import torch
from omegaconf import DictConfig
from tensordict import TensorDictBase
from tensordict.nn import CudaGraphModule

Step = Callable[[TensorDictBase], TensorDictBase | None]


def compiled(function: Callable[..., Any], cfg: DictConfig) -> Callable[..., Any]:
    """Returns `function`, compiled at its first call where `cfg.compile` asks for it."""
    return torch.compile(function) if cfg.compile else function


def capture(step: Step, cfg: DictConfig) -> Step:
    """Returns `step`, captured as a CUDA graph where `cfg.cudagraphs` asks for it.

    The first calls run as they are; from then on a call copies the batch to where the graph reads
    it and replays the recorded kernels. On a machine without CUDA calls pass through.

    Args:
        step: A function of a batch of fixed shape, without decisions that depend on values, whose
            result is detached.
        cfg: A recipe's configuration.
    """
    return CudaGraphModule(step, in_keys=[], out_keys=[], warmup=5) if cfg.cudagraphs else step


def make_adam(
    parameters: Iterable[torch.nn.Parameter], lr: float, cfg: DictConfig
) -> torch.optim.Adam:
    """Builds Adam in its fused form; for a CUDA graph, with a learning rate that can change."""
    parameters = list(parameters)
    if cfg.cudagraphs and parameters[0].is_cuda:
        rate = torch.tensor(lr, device=parameters[0].device)
        return torch.optim.Adam(parameters, lr=rate, fused=True, capturable=True)
    return torch.optim.Adam(parameters, lr=lr, fused=True)
