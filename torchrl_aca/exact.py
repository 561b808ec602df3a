"""Buffers that keep their dtype where a module is cast."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any

from torch import nn

__all__ = ["ExactBuffers"]


class ExactBuffers(nn.Module):
    """A module some of whose buffers follow device moves and ignore casts.

    They are numbers like 1e-3 that a chain divides by, or that follow a float exactly.
    """

    def exact_buffers(self) -> Iterable[str]:
        """Names of these buffers: all of the module's own, unless a subclass names some."""
        return list(self._buffers)

    def _apply(self, fn: Callable, recurse: bool = True) -> Any:
        exact = {name: self.get_buffer(name) for name in self.exact_buffers()}
        super()._apply(fn, recurse)
        for name, buffer in exact.items():
            self._buffers[name] = buffer.to(self.get_buffer(name).device)
        return self
