"""Where the jobs of a study run: engines that exist, and one process for each job.

A process of its own, and not a call in a worker: a job that is killed takes nobody along, no state
of torch is left for the next one, and what runs is the command that one would type.
"""

from __future__ import annotations

import os
import subprocess
from collections.abc import Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor, as_completed
from pathlib import Path
from types import ModuleType
from typing import Any

from studies.jobs import Job, Local, Ray, StudyConfig, Submitit, study_dir
from torchrl_aca.errors import require
from torchrl_aca.training.files import write_text
from torchrl_aca.training.signals import STOPPED, StopSignal, run_command

RECIPES = Path(__file__).parents[1]
Results = Iterator[tuple[Job, int]]  # each job with its exit status, as they end


def launch_jobs(cfg: StudyConfig, jobs: Sequence[Job], stop: StopSignal) -> Results:
    """Runs jobs and yields each with its exit status; nothing where they go on without us."""
    # Where a worker finds this module.
    paths = [str(RECIPES), os.environ.get("PYTHONPATH", "")]
    os.environ["PYTHONPATH"] = os.pathsep.join(filter(None, paths))
    if isinstance(cfg.launcher, Local):
        return run_local(cfg.launcher, jobs, cfg.threads, stop)
    if isinstance(cfg.launcher, Submitit):
        return submit(cfg.launcher, jobs, cfg.threads, study_dir(cfg) / "submitit")
    return run_ray(cfg.launcher, jobs, cfg.threads, stop)


def run_job(job: Job, threads: int, stop: StopSignal | None = None) -> int:
    """Runs a job's command to its end and returns its exit status."""
    stop = stop or StopSignal()
    if stop.received:
        return STOPPED
    job.dir.mkdir(parents=True, exist_ok=True)
    job.exit_status.unlink(missing_ok=True)
    with open(job.output, "a") as output:
        code = run_command(
            job.command,
            stop,
            stdout=output,
            stderr=subprocess.STDOUT,
            env={**os.environ, "OMP_NUM_THREADS": str(threads)},
        )
    write_text(job.exit_status, f"{code}\n")
    return code


def run_local(settings: Local, jobs: Sequence[Job], threads: int, stop: StopSignal) -> Results:
    """On this machine; a signal is passed on to the jobs, which save, a second Ctrl-C as well."""
    num_jobs = settings.jobs or max(1, _num_cores() // threads)
    with ThreadPoolExecutor(num_jobs) as pool:
        yield from _ended({pool.submit(run_job, job, threads, stop): job for job in jobs})


def _num_cores() -> int:
    """The processors that this process may use, where the system tells, or all."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def _ended(futures: dict[Future[int], Job]) -> Results:
    for future in as_completed(futures):
        yield futures[future], future.result()


class SubmittedJob:
    """A job in submitit's process; when its time is over it is told to save, and comes again."""

    def __init__(self, job: Job, threads: int) -> None:
        self.job, self.threads = job, threads

    def __call__(self) -> int:
        self.stop = StopSignal()  # not entered: the signals of this process are submitit's
        with ThreadPoolExecutor(1) as pool:
            self.future = pool.submit(run_job, self.job, self.threads, self.stop)
            return self.future.result()

    def checkpoint(self) -> Any:
        """Called by submitit, in its handler of the signal."""
        self.stop.received = "SIGUSR2"
        self.future.result()
        submission = require(
            "submitit.helpers", "launcher=submitit", "distributed"
        ).DelayedSubmission
        return submission(SubmittedJob(self.job, self.threads))


def submit(settings: Submitit, jobs: Sequence[Job], threads: int, folder: Path) -> Results:
    """Hands the jobs to submitit and leaves; `status=true` tells how far they are."""
    executor = require("submitit", "launcher=submitit", "distributed").AutoExecutor(
        folder, cluster=settings.cluster
    )
    executor.update_parameters(timeout_min=settings.timeout_min, cpus_per_task=threads)
    executor.update_parameters(**settings.parameters or {})
    with executor.batch():
        for job in jobs:
            executor.submit(SubmittedJob(job, threads))
    return iter(())


class FailedJobError(Exception):
    """What Ray has to see in order to try a job again."""


def _run_or_raise(job: Job, threads: int) -> int:
    if code := run_job(job, threads):
        raise FailedJobError(code)
    return code


def run_ray(settings: Ray, jobs: Sequence[Job], threads: int, stop: StopSignal) -> Results:
    """On Ray; a job that fails or is killed is tried again, and goes on from its checkpoint."""
    ray = require("ray", "launcher=ray", "distributed")
    environment = {"env_vars": {"PYTHONPATH": os.environ["PYTHONPATH"]}}
    ray.init(address=settings.address, runtime_env=environment, log_to_driver=False)
    retries = {"max_retries": settings.retries, "retry_exceptions": [FailedJobError]}
    remote = ray.remote(num_cpus=threads, **retries)(_run_or_raise)
    left = {remote.remote(job, threads): job for job in jobs}
    while left:
        ended, _ = ray.wait(list(left), timeout=0.5)
        for reference in ended:
            yield left.pop(reference), _code_of(ray, reference)
        if stop.received:
            for reference in left:
                ray.cancel(reference)
            break
    ray.shutdown()


def _code_of(ray: ModuleType, reference: Any) -> int:
    try:
        return ray.get(reference)
    except FailedJobError as error:  # Ray's own error is one of this class as well
        return int(getattr(error, "cause", error).args[0])
    except ray.exceptions.RayError:
        return 1
