"""The configuration of `o2o_halfcheetah.py`, for the script and for studies of it."""

from __future__ import annotations

from fractions import Fraction
from typing import Annotated, Any

from pydantic import Field, model_validator

from agents import AGENTS
from torchrl_aca.training.config import Count, RunConfig, Share, is_number


class OfflineToOnlineConfig(RunConfig):
    """`o2o_halfcheetah.yaml`."""

    dataset: str | None
    generate: dict[str, Any] | None
    offline_updates: Annotated[int, Field(ge=0, le=10**12)]
    pretrained: str | None
    offline_fraction: Share
    utd: Annotated[float, Field(ge=1e-4, le=1e4)]
    online_frames: Count

    @model_validator(mode="after")
    def _method(self) -> OfflineToOnlineConfig:
        if not AGENTS[self.algo.name].mixes:
            able = sorted(name for name, method in AGENTS.items() if method.mixes)
            self.refuse("algo.name", f"one of {able}, as it changes the rows of its buffer")
        return self

    @model_validator(mode="before")
    @classmethod
    def _length(cls, values: dict[str, Any]) -> dict[str, Any]:
        """`optim.total_updates: null` means as many as the online frames call for."""
        ratio, frames = values.get("utd"), values.get("online_frames")
        if values["optim"]["total_updates"] is None and is_number(ratio) and is_number(frames):
            values["optim"]["total_updates"] = int(frames * Fraction(str(ratio)))
        return values
