"""The typed form of `bandit_2d.yaml`, and the variants that an ablation asks for."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from itertools import product
from typing import Annotated, Any, Literal, TypeVar

from omegaconf import OmegaConf
from pydantic import BeforeValidator, Field, model_validator
from pydantic_core import PydanticCustomError

from bandit.tables import METHODS, Row
from torchrl_aca import NoiseSchedule
from torchrl_aca.training.config import (
    Count,
    NonNegative,
    Positive,
    Section,
    Seed,
    Widths,
    checked,
)

Method = Literal[tuple(METHODS)]
GUIDED = ("aca", "diffusion_q", "langevin_q", "nclql")
RIVALS = ("sdac", "qsm", "dacer", "dipo")
Processes = Annotated[int, Field(ge=1, le=4096)]


def _methods(value: Any) -> Any:
    return list(METHODS) if value == "all" else value


def _clip(value: Any) -> Any:
    is_number = isinstance(value, int | float) and not isinstance(value, bool)
    if value is False or (is_number and 0 < value < math.inf):
        return value
    raise PydanticCustomError("clip", "Input should be false, or a number above 0")


Clip = Annotated[Any, BeforeValidator(_clip)]


class Sampling(Section):
    """Settings of the trained actor, with the values to combine."""

    clip_denoised: Annotated[list[Clip], Field(min_length=1)] = []
    normalize_gradient: Annotated[list[bool], Field(min_length=1)] = []
    langevin_step_size: Annotated[list[Positive], Field(min_length=1)] = []


class Ablation(Section):
    """What to combine; keys of the configuration are changed before the training."""

    training: dict[str, Annotated[list[Any], Field(min_length=1)]]
    sampling: Sampling

    def wanted(self) -> bool:
        """Whether there is anything to combine."""
        return bool(self.training or self.sampling.model_fields_set)

    def samplings(self) -> list[Row]:
        """Every combination of the actor's settings."""
        return combinations(self.sampling.model_dump(exclude_unset=True))


class Collector(Section):
    """How the actions are collected that the critic learns from."""

    half_width: Positive
    frames: Count
    frames_per_batch: Count
    warmup_frames: Annotated[int, Field(ge=0)]
    guidance_weight: dict[Literal[GUIDED], NonNegative]


class Critic(Section):
    """The size of the critics."""

    num_critics: Annotated[int, Field(ge=1, le=1000)]
    num_cells: Widths


class Optim(Section):
    """The regression."""

    updates_per_batch: Count
    batch_size: Count
    lr: Positive


class LinearBetas(Section):
    """The betas of the linear schedule."""

    beta_start: Annotated[float, Field(gt=0, lt=1)]
    beta_end: Annotated[float, Field(gt=0, lt=1)]


class Chain(Section):
    """How samples are drawn."""

    num_steps: Annotated[int, Field(ge=1, le=1000)]
    schedule: Literal["linear", "cosine", "vp"]
    linear: LinearBetas
    clip_denoised: Clip
    normalize_gradient: bool
    langevin_step_size: Positive

    def make_schedule(self, name: str) -> NoiseSchedule:
        """The schedule of that name; the linear one has the betas given here."""
        settings = self.linear.model_dump() if name == "linear" else {}
        return getattr(NoiseSchedule, name)(self.num_steps, **settings)


class Rival(Section):
    """A diffusion policy, and how it is trained."""

    schedule: Literal["linear", "cosine", "vp"]
    clip_denoised: Clip
    num_cells: Widths
    lr: Positive  # of the policy; the critic's is that of all methods
    tau: Annotated[float, Field(gt=0, le=1)]
    updates_per_batch: Count
    actor_interval: Count
    exploration_noise: NonNegative
    loss: dict[str, Any]  # arguments of the method's loss
    chosen: Annotated[dict[str, Any], Field(max_length=1)]  # one more, chosen by reward; or none


class Sweep(Section):
    """The guidance weights to choose from."""

    weights: Annotated[list[NonNegative], Field(min_length=1)]
    num_samples: Count


class Report(Section):
    """The reported numbers."""

    num_samples: Count


class BanditConfig(Section):
    """`bandit_2d.yaml`."""

    methods: Annotated[list[Method], Field(min_length=1), BeforeValidator(_methods)]
    seeds: Annotated[list[Seed], Field(min_length=1)]
    num_workers: Processes
    num_threads: Processes
    run_dir: str | None
    figures: bool
    ablation: Ablation
    data: Literal["online", "uniform"]
    collector: Collector
    critic: Critic
    optim: Optim
    chain: Chain
    rivals: dict[Literal[RIVALS], Rival]
    sweep: Sweep
    report: Report

    @model_validator(mode="after")
    def _frames(self) -> BanditConfig:
        size = self.collector.frames_per_batch
        if self.collector.frames % size:
            self.refuse("collector.frames", f"a multiple of collector.frames_per_batch ({size})")
        if missing := set(self.methods) & set(GUIDED) - self.collector.guidance_weight.keys():
            self.refuse("collector.guidance_weight", f"a weight for {sorted(missing)} as well")
        if missing := set(self.methods) & set(RIVALS) - self.rivals.keys():
            self.refuse("rivals", f"settings of {sorted(missing)} as well")
        return self

    @model_validator(mode="after")
    def _each_once(self) -> BanditConfig:
        for name in ("methods", "seeds"):
            values = getattr(self, name)
            if len(set(values)) < len(values):
                self.refuse(name, "each of them once")
        return self

    @model_validator(mode="after")
    def _ablation_fits(self) -> BanditConfig:
        if not self.ablation.wanted():
            return self
        if rivals := set(self.methods) & set(RIVALS):
            self.refuse(
                "methods", f"an ablation of guided samplers alone, without {sorted(rivals)}"
            )
        if "nclql" in self.methods and "chain.schedule" in self.ablation.training:
            self.refuse(
                "methods", "no 'nclql', which does not see the chain.schedule of the ablation"
            )
        return self


class Beyond(Section):
    """What `bandit_beyond.yaml` adds."""

    reward_scale: Positive
    interval: Count
    guidance_weight_lr: Positive
    num_states: Count
    num_candidates: Annotated[int, Field(ge=2, le=10**4)]
    num_proposals: Count
    temperatures: Annotated[list[Positive], Field(min_length=1)]


class BeyondConfig(BanditConfig):
    """`bandit_beyond.yaml`."""

    methods: Annotated[list[Literal["aca"]], Field(min_length=1)]
    beyond: Beyond


Config = TypeVar("Config", bound=BanditConfig)


def combinations(options: Mapping[str, Sequence[Any]]) -> list[Row]:
    """Every way to choose one value for each key; the empty choice where there are no keys."""
    return [dict(zip(options, values, strict=True)) for values in product(*options.values())]


def variants(cfg: Config) -> list[tuple[Row, Config]]:
    """Every combination of `ablation.training`, with the configuration that has it.

    Raises:
        RunError: If a key is none of the configuration's, or a value does not fit.
    """
    made = []
    for changed in combinations(cfg.ablation.training):
        variant = OmegaConf.create(cfg.model_dump(exclude_unset=True))
        for key, value in changed.items():
            OmegaConf.update(variant, key, value)
        made.append((changed, checked(type(cfg), variant)))
    return made
