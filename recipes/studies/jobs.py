"""The jobs of a study: every task with every method and seed, each in a directory of its own."""

from __future__ import annotations

import sys
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import hydra
from filelock import FileLock
from hydra.core.global_hydra import GlobalHydra
from hydra.errors import HydraException
from omegaconf import DictConfig, OmegaConf
from pydantic import Field

from agents import configured
from data.config import OfflineToOnlineConfig
from torchrl_aca.errors import RunError
from torchrl_aca.training.config import Count, RunConfig, Section, Seed, override
from torchrl_aca.training.files import write_text
from torchrl_aca.training.resume import read_yaml

FOLDER = Path(__file__).parents[1]
PARTS = ("tasks", "methods")  # of a study, which may be run one by one

Name = Annotated[str, Field(pattern=r"^[\w.+-]+$")]  # a part of a directory's name
Overrides = dict[Name, list[str]]


class Study(Section):
    """`configs/study/<name>.yaml`; lists hold what one would type behind its recipe."""

    name: Name
    recipe: Literal["online_mujoco", "o2o_halfcheetah"] = "online_mujoco"
    config: str
    tasks: Annotated[Overrides, Field(min_length=1)]
    methods: Annotated[Overrides, Field(min_length=1)]
    seeds: Annotated[list[Seed], Field(min_length=1)]
    settings: list[str]


class Local(Section):
    """`configs/launcher/local.yaml`."""

    name: Literal["local"]
    jobs: Count | None


class Submitit(Section):
    """`configs/launcher/submitit.yaml`."""

    name: Literal["submitit"]
    cluster: Literal["slurm", "local"]
    timeout_min: Count
    parameters: dict[str, Any] | None


class Ray(Section):
    """`configs/launcher/ray.yaml`."""

    name: Literal["ray"]
    address: str | None
    retries: Annotated[int, Field(ge=0)]


class StudyConfig(Section):
    """`configs/study.yaml`."""

    study: Study
    launcher: Annotated[Local | Submitit | Ray, Field(discriminator="name")]
    dir: str | None
    threads: Annotated[int, Field(ge=1, le=4096)]
    status: bool


@dataclass(frozen=True)
class Job:
    """A run of a study.

    Attributes:
        method: The study's name of it.
        dir: The run directory, named by task, method and seed.
        script: The recipe that it runs.
        config: The configuration, which has where the run ends.
        overrides: What the command says.
    """

    method: str
    dir: Path
    script: Path
    config: RunConfig
    overrides: tuple[str, ...]

    @property
    def command(self) -> list[str]:
        """What one would type: typed again, it goes on with the run."""
        return [sys.executable, str(self.script), *self.overrides]

    @property
    def updates(self) -> int:
        """How many it makes, those of an offline phase included."""
        return self.config.optim.offline_updates + self.config.optim.total_updates

    @property
    def output(self) -> Path:
        """Where the command's output goes."""
        return self.dir / "output.txt"

    @property
    def exit_status(self) -> Path:
        """Where the command's exit status is once it has ended."""
        return self.dir / "exit_status"


def study_dir(cfg: StudyConfig) -> Path:
    """The directory of a study."""
    return Path(cfg.dir or f"runs/studies/{cfg.study.name}").resolve()


def make_jobs(cfg: StudyConfig) -> list[Job]:
    """The jobs, all seeds of one task and method before the next.

    Raises:
        RunError: If a setting of any of them is wrong, or two of them have one directory.
    """
    jobs = [
        job
        for task in cfg.study.tasks
        for method in cfg.study.methods
        for job in _jobs_of(cfg, task, method)
    ]
    for name, number in Counter(job.dir.name for job in jobs).items():
        if number > 1:
            raise RunError(
                f"study={cfg.study.name}: {number} jobs are named {name}; expected a directory for "
                "each. Give every seed once, and tasks and methods that are apart when joined."
            )
    return jobs


def _jobs_of(cfg: StudyConfig, task: str, method: str) -> Iterator[Job]:
    study = cfg.study
    schema = OfflineToOnlineConfig if study.recipe == "o2o_halfcheetah" else RunConfig
    chosen = [*study.tasks[task], *study.methods[method], *study.settings]
    try:
        composed = hydra.compose(study.config, [*chosen, f"num_threads={cfg.threads}"])
        config = configured(composed, schema)
    except (HydraException, RunError) as error:
        raise RunError(f"study={study.name}, {method} on {task}: {error}") from None
    folders = [word for folder in _config_dirs() for word in ("--config-dir", folder)]
    for seed in study.seeds:
        run_dir = study_dir(cfg) / f"{task}-{method}-s{seed}"
        overrides = (
            *folders,
            "--config-name",
            study.config,
            *chosen,
            f"num_threads={cfg.threads}",
            f"seed={seed}",
            override("run_dir", run_dir),
            "existing=resume",
        )
        yield Job(method, run_dir, FOLDER / f"{study.recipe}.py", config, overrides)


def _config_dirs() -> list[str]:
    """The folders that `--config-dir` has added to this command, which its jobs need as well."""
    entries = GlobalHydra.instance().config_loader().get_search_path().get_path()
    return [e.path.removeprefix("file://") for e in entries if e.provider == "command-line"]


def write_study(cfg: StudyConfig) -> None:
    """Keeps what the study is in its directory, with the tasks and methods of earlier calls.

    Raises:
        RunError: If the directory is that of another study, or cannot be read or written.
    """
    path, study = study_dir(cfg) / "study.yaml", OmegaConf.create(cfg.study.model_dump())
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with FileLock(path.with_name(".study.lock")):  # parts may be begun at the same time
            if path.exists():
                _add_earlier(study, path)
            write_text(path, OmegaConf.to_yaml(study))
    except OSError as error:
        raise RunError(f"dir={path.parent} cannot be used: {error}. Give another one.") from error


def _add_earlier(study: DictConfig, path: Path) -> None:
    """Adds what an earlier call has kept: a part of a study may be run on its own."""
    path.read_bytes()  # where that fails, the file need not be damaged
    found = read_yaml(path) or OmegaConf.create()
    if "name" not in found or not all(OmegaConf.is_dict(found.get(key)) for key in PARTS):
        raise RunError(
            f"{path} is damaged; expected name, tasks and methods of a study. Remove the file: the "
            "runs beside it stay, and this command writes it anew."
        )
    if found.name != study.name:
        raise RunError(f"dir={path.parent} holds the study {found.name}; expected a new directory.")
    for key in PARTS:
        study[key] = {**found[key], **study[key]}
