"""A study: runs of several methods on several tasks with several seeds, from one command.

    python recipes/study.py study=tiny
    python recipes/study.py study=tiny status=true
    python recipes/study.py study=table2 launcher=submitit
    python recipes/study.py study=table2 launcher=ray

Each run is a directory below `runs/studies/<name>`, made by the recipe that the study names. The
same command again skips the finished ones and goes on with the others. Every key is in
`configs/study.yaml`.
"""

from __future__ import annotations

import hydra
from omegaconf import DictConfig

from data.offline import prepare_data
from studies.jobs import StudyConfig, make_jobs, study_dir, write_study
from studies.launchers import launch_jobs
from studies.status import last_line, state_of, status_table
from torchrl_aca.errors import DatasetError, RunError
from torchrl_aca.training.config import checked
from torchrl_aca.training.progress import say
from torchrl_aca.training.signals import STOPPED, StopSignal


def run(cfg: StudyConfig) -> int:
    """Runs what is left of a study and returns how many of its jobs have failed."""
    jobs = make_jobs(cfg)
    if cfg.status:
        print(status_table(jobs))
        return 0
    write_study(cfg)
    open_jobs = [job for job in jobs if state_of(job).name not in ("done", "running")]
    if cfg.study.recipe == "o2o_halfcheetah":
        for job in open_jobs:  # here, as two jobs would make the same data at the same time
            prepare_data(job.config)
    say(f"{study_dir(cfg)}: {len(open_jobs)} of {len(jobs)} jobs to do")
    failed = 0
    with StopSignal() as stop:
        stop.activity = "iteration of each job"
        for job, code in launch_jobs(cfg, open_jobs, stop):
            outcome = {0: "done", STOPPED: "stopped"}.get(code, f"failed with status {code}")
            why = f": {last_line(job)}" if code else ""
            say(f"{job.dir.name} {outcome}{why}")
            failed += code not in (0, STOPPED)
    say(status_table(jobs).splitlines()[-1])
    if stop.received:
        raise SystemExit(STOPPED)
    return failed


@hydra.main(version_base="1.3", config_path="configs", config_name="study")
def main(cfg: DictConfig) -> None:
    try:
        failed = run(checked(StudyConfig, cfg))
    except (DatasetError, RunError) as error:
        raise SystemExit(f"error: {error}") from None
    except KeyboardInterrupt:  # while data are made, or the second Ctrl-C
        raise SystemExit("stopped; the same command goes on") from None
    if failed:
        raise SystemExit(f"{failed} failed: output.txt of their directories says why")


if __name__ == "__main__":
    main()
