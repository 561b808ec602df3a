"""The typed configuration: what every recipe has, and how a mistake is told."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from typing import Annotated, Any, Literal, NoReturn, TypeVar

from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import MissingMandatoryValue, OmegaConfBaseException
from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator
from pydantic_core import ErrorDetails, PydanticCustomError

from torchrl_aca.errors import RunError

Count = Annotated[int, Field(ge=1, le=10**12)]
Seed = Annotated[int, Field(ge=0, lt=2**32 - 10**6)]  # of NumPy's range, with room for the copies
Positive = Annotated[float, Field(gt=0)]
NonNegative = Annotated[float, Field(ge=0)]
Share = Annotated[float, Field(ge=0, le=1)]
Text = Annotated[str, Field(min_length=1)]
Device = Annotated[str, Field(pattern=r"^(auto|cpu|cuda(:\d+)?)$")]
Threads = Annotated[int, Field(ge=1, le=4096)] | None
Activation = Literal["Mish", "ReLU", "GELU"]
Widths = Annotated[list[Annotated[int, Field(ge=1, le=10**5)]], Field(min_length=1)]


class Section(BaseModel):
    """A part of a configuration: nothing but what it declares, no text for a number, no NaN."""

    model_config = ConfigDict(extra="forbid", strict=True, allow_inf_nan=False)

    def refuse(self, key: str, expected: str) -> NoReturn:
        """Reports a value that fits its own type but not the others, for use in validators."""
        value: Any = self
        for name in key.split("."):
            value = getattr(value, name)
        details = {"key": key, "value": value, "expected": expected}
        raise PydanticCustomError("misfit", "Input should be {expected}", details)


class Wrapper(Section):
    """A wrapper around an environment; every other key is a keyword of its class."""

    model_config = ConfigDict(extra="allow")

    name: Text


class Env(Section):
    """The task."""

    name: Text
    kwargs: dict[str, Any] | None = None
    wrappers: list[Wrapper] = []


class Algo(Section):
    """The method."""

    name: str


class Collector(Section):
    """How experience is collected."""

    num_envs: Annotated[int, Field(ge=1, le=10**4)]
    frames_per_batch: Count
    warmup_frames: Count
    warmup: Literal["random", "policy"]
    backend: Literal["direct", "multi_process", "ray"] = "direct"
    num_workers: Count = 1
    max_restarts: Annotated[int, Field(ge=0)] = 3

    @model_validator(mode="after")
    def _workers(self) -> Collector:
        if self.backend == "direct" and self.num_workers > 1:
            self.refuse("num_workers", "1, or another collector.backend than direct")
        if self.num_envs % self.num_workers:
            self.refuse("num_workers", f"a divisor of collector.num_envs ({self.num_envs})")
        return self


class Buffer(Section):
    """Where experience is kept."""

    capacity: Count


class Optim(Section):
    """What every method's updates have."""

    total_updates: Count
    offline_updates: Annotated[int, Field(ge=0)] = 0
    # Below the bound, a run would collect for ever before its first update.
    utd_ratio: Annotated[float, Field(ge=1e-4, le=1e4)]
    batch_size: Count
    gamma: Annotated[float, Field(gt=0, le=1)]
    tau: Annotated[float, Field(gt=0, le=1)]


class Eval(Section):
    """When and how the policy is evaluated."""

    interval: Count
    episodes: Annotated[int, Field(ge=1, le=10**4)]
    seed: Seed
    random: bool
    draws: Literal["fresh", "fixed"]
    max_steps: Count | None
    stop_return: float | None


class Checkpoint(Section):
    """When the state is saved."""

    interval: Count
    keep_last: Count
    keep_best: bool = True  # runs from before it was a key resume


class Logger(Section):
    """Where numbers go besides the CSV files."""

    backend: Literal["csv", "wandb", "tensorboard", "none"]
    interval: Count
    project: str
    wandb_mode: Literal["online", "offline"]


class Video(Section):
    """Whether the trained policy is filmed."""

    enabled: bool


class RunConfig(Section):
    """What every training recipe has; a method adds its own section and its own `optim`."""

    seed: Seed
    device: Device
    num_threads: Threads
    compile: bool
    matmul_precision: Literal["highest", "high", "medium"]
    cudagraphs: bool
    run_dir: Text | None
    existing: Literal["fail", "resume"] = "fail"  # checkpoints of before have no such key
    resume: Text | None
    env: Env
    algo: Algo
    collector: Collector
    buffer: Buffer
    optim: Optim
    eval: Eval
    checkpoint: Checkpoint
    logger: Logger
    video: Video

    @model_validator(mode="after")
    def _sizes(self) -> RunConfig:
        batch, frames = self.optim.batch_size, self.collector.frames_per_batch
        if self.buffer.capacity < batch:
            self.refuse("buffer.capacity", f"at least optim.batch_size ({batch})")
        if self.collector.warmup_frames < batch:
            self.refuse("collector.warmup_frames", f"at least optim.batch_size ({batch})")
        if frames % self.collector.num_envs:
            envs = self.collector.num_envs
            self.refuse("collector.frames_per_batch", f"a multiple of collector.num_envs ({envs})")
        if self.collector.warmup_frames % frames:
            expected = f"a multiple of collector.frames_per_batch ({frames})"
            self.refuse("collector.warmup_frames", expected)
        first, last = self.seed, self.seed + self.collector.num_envs - 1
        if self.eval.seed <= last and self.eval.seed + self.eval.episodes > first:
            self.refuse("eval.seed", f"seeds apart from the training's {first} to {last}")
        return self


def is_number(value: Any) -> bool:
    """Whether a value is a finite number; true and false are none."""
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)


Schema = TypeVar("Schema", bound=Section)


def checked(schema: type[Schema], cfg: DictConfig | dict[str, Any]) -> Schema:
    """Returns a composed configuration as an instance of `schema`.

    Raises:
        RunError: Naming each wrong key, what was expected and what was got.
    """
    try:
        values = OmegaConf.to_container(OmegaConf.create(cfg), resolve=True, throw_on_missing=True)
    except MissingMandatoryValue as error:
        key = error.full_key
        raise RunError(f"{key}=???: expected a value. Set it with {key}=... .") from None
    except OmegaConfBaseException as error:
        raise RunError(f"the configuration is incomplete: {str(error).splitlines()[0]}.") from None
    try:
        return schema.model_validate(values)
    except ValidationError as error:
        told = dict.fromkeys(_told(each, values) for each in error.errors())
        raise RunError("\n       ".join(told)) from None


def override(key: str, value: object) -> str:
    """`key=value` as Hydra reads it from a command: a text, whatever it looks like.

    But for `${`, which begins an interpolation in quotes as well.
    """
    text = str(value)
    plain = re.fullmatch(r"[A-Za-z][\w.+@-]*|[\w.+@-]*/[\w./+@-]*", text, re.ASCII)
    if plain and text.lower() not in ("null", "true", "false", "inf", "nan"):
        return f"{key}={text}"
    # Within quotes a backslash is one, but for those in front of a quote.
    escaped = re.sub(r'(\\*)("|$)', lambda m: 2 * m[1] + m[2].replace('"', '\\"'), text)
    return f'{key}="{escaped}"'


def _told(error: ErrorDetails, values: Any) -> str:
    """One mistake in one sentence: key, got, expected."""
    context = error.get("ctx", {})
    place = _place(error["loc"], values)
    key = ".".join([*place, context["key"]] if "key" in context else place)
    value = context.get("value", error["input"])
    if error["type"] == "missing":
        key = ".".join([*place, str(error["loc"][-1])])
        return f"{key} is missing from the configuration. Give it with {key}=... ."
    if error["type"] == "extra_forbidden":
        return f"{key}={value!r}: there is no such key. Leave it out, or correct its name."
    if error["type"] in ("model_type", "model_attributes_type"):
        return f"{key}={value!r}: expected a section with keys of its own, as {key}.KEY=... ."
    expected = re.sub(r"^Input should be |^List should have | after validation.*", "", error["msg"])
    return f"{key}={value!r}: expected {expected}. Set it with {key}=... ."


def _place(location: Sequence[int | str], values: Any) -> list[str]:
    """The keys of a mistake's place, which also tells which of several types was tried."""
    place = []
    for part in location:
        entries = dict(enumerate(values)) if isinstance(values, list) else values
        if isinstance(entries, dict) and part in entries:
            values = entries[part]
            place.append(str(part))
    return place
