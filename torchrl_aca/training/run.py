"""A run: its counters, phases and randomness, its directory and log, and how it ends."""

from __future__ import annotations

import json
import shlex
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from types import TracebackType
from typing import Any, Literal

import torch
from omegaconf import OmegaConf
from tensordict import TensorDictBase

from torchrl_aca.errors import RunError
from torchrl_aca.replay import write_back
from torchrl_aca.training.agent import Agent
from torchrl_aca.training.checkpoint import Counters, list_checkpoints, save_checkpoint
from torchrl_aca.training.collection import BadDataError, Collection
from torchrl_aca.training.config import RunConfig, override
from torchrl_aca.training.due import has_reached, is_better, passed, updates_due
from torchrl_aca.training.files import write_text
from torchrl_aca.training.logging import MetricMeans, RunLogger
from torchrl_aca.training.parts import check_needs, check_savable, make_parts, restore_parts
from torchrl_aca.training.policy import (
    best_return,
    drop_newer_policies,
    policy_path,
    save_policy,
)
from torchrl_aca.training.pretrained import save_pretrained
from torchrl_aca.training.progress import Pace, ProgressBar
from torchrl_aca.training.report import plot_curve, versions, write_card
from torchrl_aca.training.run_dir import DONE, lock, make_run_dir, require_newest
from torchrl_aca.training.signals import StopSignal

Metrics = Mapping[str, float]


class _Stopped(Exception):
    """Leaves the loops after a signal in a phase that has no end of an iteration."""


class Run:
    """Keeps the books of a training loop; a context manager. One process at a time has a directory.

    Entering it evaluates the untrained policy, leaving it writes the last checkpoint, the card and
    the curve. A run that was stopped in any phase goes on there, on a CPU bit for bit.

    Attributes:
        dir: The run directory.
        counters: Updates of both phases, and seconds.
        completed: Whether all updates were made.
    """

    def __init__(
        self,
        cfg: RunConfig,
        agent: Agent,
        buffer: Any,
        collection: Collection,
        evaluate: Callable[[Callable[[int], None]], Metrics],
        checkpoint: dict[str, Any] | None = None,
        *,
        device: torch.device | str = "cpu",
        script: str = "",
        facts: Mapping[str, object] | None = None,
        pretrained: int = 0,
    ) -> None:
        """Opens a new run directory, or the one in `cfg.resume`.

        Args:
            cfg: The whole configuration.
            agent: What is trained.
            buffer: A plain replay buffer, or a mixture that saves itself; `sample()` gives a batch.
            collection: Where experience comes from.
            evaluate: Evaluates the policy; takes what is to be told after each step.
            checkpoint: What `read_checkpoint` returned, to go on from.
            device: Where batches go.
            script: The recipe that can go on with the run.
            facts: More rows for the card.
            pretrained: Offline updates that the agent of a new run has had in another one.

        Raises:
            RunError: If the checkpoint does not fit or needs no more updates; if a new run's
                directory holds a run, another process is at work in it, or has gone on with it
                since its checkpoint was read; or if the state of a part cannot be saved.
        """
        self.cfg, self.agent, self.collection = cfg, agent, collection
        self.counters = Counters(offline_updates=pretrained)
        self.means, self.completed = MetricMeans(), False
        self.script, self.facts = script, facts or {}
        self._evaluate, self._device = evaluate, device
        check_needs(cfg, agent, buffer)
        self.parts = make_parts(agent, buffer, collection, self.means, self.counters)
        if checkpoint is not None:
            restore_parts(self.parts, checkpoint, cfg, collection)
        self._unsavable = collection.why_unsavable()  # from here on it is known not to try
        check_savable(self.parts)
        task = cfg.env.name.split(":")[-1].replace("/", "-")
        name = f"{task}-{cfg.algo.name}-s{cfg.seed}"
        resumed = checkpoint is not None
        self.dir = Path(cfg.resume or "") if resumed else make_run_dir(cfg.run_dir, name)
        self._lock = lock(self.dir)
        try:
            self._open(resumed)
        except OSError as error:
            self._lock.release()
            raise RunError(f"{self.dir} cannot be written: {error}. Mend that.") from error
        except BaseException:
            self._lock.release()
            raise

    # --- beginning --------------------------------------------------------------------------------

    def _open(self, resumed: bool) -> None:
        """Writes what describes the run, and opens its log."""
        counters, cfg = self.counters, self.cfg
        if resumed:
            require_newest(self.dir, counters.total)
        (self.dir / DONE).unlink(missing_ok=True)
        for left in (self.dir / "checkpoints").glob("*.tmp"):  # by a process that was killed
            left.unlink()
        if resumed:
            drop_newer_policies(self.dir / "checkpoints", counters.total)
        else:
            made_with = versions() | {"parameters": self.agent.num_parameters}
            write_text(self.dir / "versions.json", json.dumps(made_with, indent=2) + "\n")
        # The run as it is now: a resume may have changed the number of updates or the logger.
        self.config = {**cfg.model_dump(), "resume": None}
        write_text(self.dir / "config.yaml", OmegaConf.to_yaml(OmegaConf.create(self.config)))
        self._saved: tuple[int, int] | None = None  # the latest checkpoint of this session
        self._best = best_return(self.dir / "checkpoints") if resumed else None
        self.logger = RunLogger(self.dir, self.config, self._axes() if resumed else None)
        total = cfg.optim.offline_updates + cfg.optim.total_updates
        self.bar = ProgressBar(total, counters.total)
        self._signal = StopSignal(self.bar.write)
        self._since = counters.updates
        self._lap = (time.perf_counter(), counters.total, self.collection.frames)
        for line in (f"run directory: {self.dir}", *self._outlook()):
            self.bar.write(line)

    def _outlook(self) -> Iterator[str]:
        """What the user will wait for before the first update shows, and what will not be saved."""
        settings, optim = self.cfg.collector, self.cfg.optim
        if why := self._unsavable:
            yield (
                f"the state of {self.cfg.env.name} cannot be saved ({why}): a resumed run begins "
                "new episodes"
            )
        if (left := optim.offline_updates - self.counters.offline_updates) > 0:
            yield f"the first {left} updates are made on the data set alone"
        if self.collection.frames < settings.warmup_frames:
            who = "random actions" if settings.warmup == "random" else "actions of the policy"
            yield f"the first {settings.warmup_frames} frames are {who}, without updates"

    def __enter__(self) -> Run:
        """Starts to listen for signals; evaluates the policy that a new run begins with."""
        self._signal.__enter__()
        try:
            if not self.logger.tables["eval"].rows:
                self.log_evaluation()
        except BaseException as error:  # Python leaves only what it has entered
            self.__exit__(type(error), error, error.__traceback__)
            raise
        return self

    # --- the loop ---------------------------------------------------------------------------------

    @property
    def stopping(self) -> bool:
        """Whether a signal asks to stop."""
        return self._signal.received is not None

    def offline_phase(self, buffer: Any) -> Iterator[TensorDictBase]:
        """Yields the batches of the offline phase that are left; none for a method without one."""
        counters, last = self.counters, self.cfg.optim.offline_updates
        while counters.offline_updates < last:
            since = counters.offline_updates
            yield buffer.sample().to(self._device)
            counters.offline_updates += 1
            self._book(since, counters.offline_updates, counters.offline_updates == last, last)
            if self.stopping:
                raise _Stopped

    def due(self, buffer: Any) -> Iterator[TensorDictBase]:
        """Yields a batch for each update that the frames so far call for.

        They wait for the first row of experience, where a method keeps rows back. What the method
        rewrites in a batch goes back to its rows afterwards.
        """
        self._since = self.counters.updates
        due = updates_due(self.cfg, self.collection.frames)
        if not len(getattr(buffer, "online", buffer)):
            return
        while self.counters.updates < due:
            batch = buffer.sample().to(self._device)
            yield batch
            if self.agent.rewrites:
                write_back(buffer, batch, self.agent.rewrites)
            self.counters.updates += 1

    def add(self, metrics: TensorDictBase) -> None:
        """Takes the metrics of an update."""
        self.means.add(metrics)

    def end_iteration(self) -> bool:
        """Logs, evaluates and saves what is due, and tells whether to leave the loop."""
        cfg, updates = self.cfg, self.counters.updates
        self.completed = updates >= cfg.optim.total_updates
        self._book(self._since, updates, self.completed)
        rows = self.logger.tables["eval"].rows
        if passed(cfg.eval.interval, self._since, updates):
            self.completed |= has_reached(rows, cfg.eval.stop_return)
        return self.completed or self.stopping

    def _book(self, since: int, now: int, last: bool, last_offline: int | None = None) -> None:
        """What is due after the updates from `since` to `now` of a phase, which may be its last."""
        cfg = self.cfg
        if passed(cfg.logger.interval, since, now) or now == last_offline:
            self.log_metrics()
        if passed(cfg.eval.interval, since, now) or last:
            self.log_evaluation()
        if now == last_offline:  # before the checkpoint, after which the phase is not made again
            with self._writing():
                save_pretrained(self.dir, self.parts, self.config, self.facts)
        if passed(cfg.checkpoint.interval, since, now) or now == last_offline:
            self.save()
        if now == last_offline:  # another phase, another speed
            self.bar.pace = Pace(self.counters.total)
        warmed_up = last_offline is not None or self.counters.updates
        frames = f"{self.collection.frames}/{cfg.collector.warmup_frames} frames"
        self.bar.advance(self.counters.total, "train" if warmed_up else f"warm-up {frames}")

    # --- what it leaves ---------------------------------------------------------------------------

    def _axes(self) -> dict[str, int]:
        """Where the run is, as the first columns of its tables."""
        axes = {"updates": self.counters.updates, "frames": self.collection.frames}
        if self.cfg.optim.offline_updates:
            axes["offline_updates"] = self.counters.offline_updates
        return axes

    def log_metrics(self) -> None:
        """Adds a row of training metrics, with the time and the speed."""
        values = {**self.collection.episodes.metrics(), **self.means.pop(), **self._speed()}
        self._log("metrics", values)
        self.bar.show_metrics(self.counters.total, self.collection.frames, values)

    def log_evaluation(self) -> None:
        """Evaluates the policy and adds a row of the results."""
        self._signal.activity = "evaluation"
        values = self._evaluate(lambda step: self.bar.describe(f"evaluation, step {step}"))
        self._signal.activity = "iteration"
        self._log("eval", values)
        best = max(float(row["return_mean"]) for row in self.logger.tables["eval"].rows)
        self.bar.show_evaluation(self.counters.total, self.collection.frames, values, best)
        if self.cfg.checkpoint.keep_best and is_better(values["return_mean"], self._best):
            self._best = values["return_mean"]
            self._save_policy("best", {**self._axes(), **values})

    def _log(self, table: str, values: Metrics) -> None:
        with self._writing():
            self.logger.log(table, self._axes(), self.counters.total, values)

    def _speed(self) -> dict[str, float]:
        then, updates, frames = self._lap
        now = time.perf_counter()
        self._lap = (now, self.counters.total, self.collection.frames)
        self.counters.seconds += now - then
        return {
            "seconds": self.counters.seconds,
            "frames_per_second": (self.collection.frames - frames) / (now - then),
            "updates_per_second": (self.counters.total - updates) / (now - then),
        }

    def save(self) -> Path:
        """Writes a checkpoint of all parts."""
        directory, keep_last = self.dir / "checkpoints", self.cfg.checkpoint.keep_last
        updates = self.counters.total
        self._save_policy(updates)  # first, so that no checkpoint is without one
        with self._writing():
            path = save_checkpoint(directory, self.parts, self.config, updates, keep_last)
        self._saved = (updates, self.collection.frames)
        return path

    @contextmanager
    def _writing(self) -> Iterator[None]:
        """Tells of a full or broken disk in one message."""
        try:
            yield
        except OSError as error:
            whole = list_checkpoints(self.dir / "checkpoints")
            go_on = f"; then go on with {override('resume', self.dir)}" if whole else ""
            raise RunError(f"{self.dir} cannot be written: {error}. Make room{go_on}.") from error

    def _save_policy(
        self, which: int | Literal["best"], evaluation: Mapping[str, float] | None = None
    ) -> None:
        """Writes the policy for `load_policy`, if the agent tells how it is built."""
        agent, path = self.agent, policy_path(self.dir / "checkpoints", which)
        if agent.policy_builder is not None:
            made = self.config, self.counters.total, evaluation
            with self._writing():
                save_policy(path, agent.policy_builder, agent.policy, *made)

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> bool:
        """Writes the last checkpoint, the card and the curve, and closes the log."""
        try:
            if error is None or isinstance(error, _Stopped):
                self._finish()
            elif isinstance(error, BadDataError):
                self.collection.savable = False  # the environments cannot be trusted any more
                raise RunError(
                    f"{self.cfg.env.name}: {error} What came before is in {self.save()}."
                ) from None
        except KeyboardInterrupt as second:
            error = second
            raise
        finally:
            try:
                if isinstance(error, KeyboardInterrupt) and not (self.dir / DONE).exists():
                    self._tell_stop("at once", "go on from the newest checkpoint")
            finally:
                self._signal.__exit__()
                self.bar.close()
                self.logger.close()
                self.collection.close()
                self._lock.release()
        return isinstance(error, _Stopped)

    def _finish(self) -> None:
        self._speed()
        if self._saved != (self.counters.total, self.collection.frames):
            self.save()
        rows = self.logger.tables["eval"].rows
        title = f"{self.cfg.algo.name} on {self.cfg.env.name}"
        with self._writing():
            if self.completed:  # at once after the checkpoint: a kill from here costs no update
                write_text(self.dir / DONE, f"{self.counters.updates}\n")
            write_card(self.dir, self.config, self._axes(), rows, self.counters.seconds, self.facts)
            plot_curve(self.dir, title, rows)
        if self.completed:
            before, after = (float(row["return_mean"]) for row in (rows[0], rows[-1]))
            self.bar.write(f"mean evaluation return: before {before:.1f}, after {after:.1f}")
        else:
            self._tell_stop(f"by {self._signal.received or 'the loop'}", "go on")

    def _tell_stop(self, how: str, next_step: str) -> None:
        command = shlex.join(["python", self.script, override("resume", self.dir)])
        self.bar.write(
            f"stopped {how} after {self.counters.total} updates; {next_step} with: {command}"
        )
