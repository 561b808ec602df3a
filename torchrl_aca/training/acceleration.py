"""What compiling and CUDA graphs do to the parts of an update, and to a policy."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import CudaGraphModule

Step = Callable[[TensorDictBase], TensorDictBase | None]
WARMUP = 5  # calls before a graph is captured: what they compile must not be recorded


def compiled(function: Callable[..., Any], enabled: bool) -> Callable[..., Any]:
    """Returns `function`, compiled at its first call where that is enabled."""
    return torch.compile(function) if enabled else function


def capture(step: Step, enabled: bool) -> Step:
    """Returns `step`, captured as a CUDA graph where that is enabled.

    The first calls run as they are; from then on a call copies the batch to where the graph reads
    it and replays the recorded kernels. On a machine without CUDA calls pass through.

    Args:
        step: A function of a batch of fixed shape, such as a policy, without decisions that depend
            on values, whose result is detached.
        enabled: Whether to capture.
    """
    return CudaGraphModule(step, in_keys=[], out_keys=[], warmup=WARMUP) if enabled else step


def make_adam(
    parameters: Iterable[torch.nn.Parameter], lr: float, cudagraphs: bool
) -> torch.optim.Adam:
    """Builds Adam in its fused form; for a CUDA graph, with a learning rate that can change."""
    parameters = list(parameters)
    if cudagraphs and parameters[0].is_cuda:
        rate = torch.tensor(lr, device=parameters[0].device)
        adam = torch.optim.Adam(parameters, lr=rate, fused=True, capturable=True)
        adam.register_load_state_dict_post_hook(_rates_to_device)
        return adam
    return torch.optim.Adam(parameters, lr=lr, fused=True)


def _rates_to_device(optimizer: torch.optim.Optimizer) -> None:
    """A checkpoint holds the rates on the CPU, from where a graph would take them as constants."""
    for group in optimizer.param_groups:
        group["lr"] = group["lr"].to(group["params"][0].device)


def descend(losses: TensorDictBase, name: str, optimizer: torch.optim.Optimizer) -> TensorDictBase:
    """Takes a step of `optimizer` down `losses[name]` and returns the losses, detached."""
    losses[name].backward()
    optimizer.step()
    optimizer.zero_grad()
    return losses.detach()
