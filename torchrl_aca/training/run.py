"""A run: its directory, its log, its checkpoints, and how it ends."""

from __future__ import annotations

import json
import signal
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from types import FrameType
from typing import Any

from filelock import FileLock, Timeout
from omegaconf import DictConfig, OmegaConf
from tensordict import TensorDictBase

from torchrl_aca.training.agent import Stateful
from torchrl_aca.training.checkpoint import (
    Counters,
    list_checkpoints,
    save_checkpoint,
    updates_of,
)
from torchrl_aca.training.data import check_finite
from torchrl_aca.training.errors import RunError
from torchrl_aca.training.logging import ProgressBar, RunLogger
from torchrl_aca.training.report import plot_curve, versions, write_card

Metrics = Mapping[str, float]


def make_run_dir(cfg: DictConfig) -> Path:
    """Creates the directory of a new run.

    Raises:
        RunError: If `run_dir` already holds a run.
    """
    stamp = time.strftime("%Y%m%d-%H%M%S")
    name = f"{cfg.env.name.split(':')[-1]}-{cfg.algo.name}-s{cfg.seed}-{stamp}"
    run_dir = Path(cfg.run_dir or Path("runs") / name)
    if (run_dir / "config.yaml").exists():
        raise RunError(
            f"run_dir={run_dir} already holds a run; expected a new directory. Give another "
            f"run_dir, or go on with resume={run_dir}."
        )
    run_dir.mkdir(parents=True, exist_ok=True)
    return run_dir


def lock(run_dir: Path) -> FileLock:
    """Takes a run directory for this process; the system gives it back when the process ends.

    The file stays: to remove it would let two processes lock two files of one name.

    Raises:
        RunError: If another process has it.
    """
    found = FileLock(run_dir / ".lock")
    try:
        found.acquire(blocking=False)
    except Timeout:
        raise RunError(
            f"{run_dir}: another process is at work on this run. Wait for its end, or stop it with "
            "Ctrl-C first: it leaves a checkpoint."
        ) from None
    return found


def require_newest(run_dir: Path, updates: int) -> None:
    """Raises `RunError` if a checkpoint newer than the one just read has come meanwhile."""
    newest = list_checkpoints(run_dir / "checkpoints")[-1]
    if updates_of(newest) != updates:
        raise RunError(
            f"{run_dir} went on to {newest.name} while its checkpoint of {updates} updates was "
            "read. Resume it again."
        )


def has_reached(evaluations: Sequence[Mapping[str, Any]], stop_return: float | None) -> bool:
    """Tells whether the latest two evaluations have averaged `stop_return`."""
    latest = [float(row["return_mean"]) for row in evaluations[-2:]]
    return stop_return is not None and len(latest) == 2 and sum(latest) / 2 >= stop_return


class Run:
    """Keeps the books of a training loop; a context manager. One process at a time has a directory.

    Attributes:
        dir: The run directory.
        counters: Updates, frames and seconds; the loop counts the first two.
        stopping: Whether Ctrl-C or SIGTERM has arrived: leave the loop after this iteration.
    """

    def __init__(
        self,
        cfg: DictConfig,
        parts: Mapping[str, Stateful],
        counters: Counters,
        resumed: bool,
        script: str,
        facts: Mapping[str, object] | None = None,
    ) -> None:
        """Opens a new run directory, or the one in `cfg.resume`.

        Args:
            cfg: The whole configuration.
            parts: Everything that a checkpoint holds.
            counters: One of the parts.
            resumed: Whether the parts come from a checkpoint.
            script: The recipe that can go on with the run.
            facts: More rows for the card.

        Raises:
            RunError: If a new run's directory holds a run, another process is at work in it, or has
                gone on with it since its checkpoint was read.
        """
        self.dir = Path(cfg.resume) if resumed else make_run_dir(cfg)
        self.parts, self.counters, self.facts = parts, counters, facts or {}
        self.script = script
        self._lock = lock(self.dir)
        try:
            self._open(cfg, resumed)
        except BaseException:
            self._lock.release()
            raise

    def _open(self, cfg: DictConfig, resumed: bool) -> None:
        """Writes what describes the run, and opens its log."""
        if resumed:
            require_newest(self.dir, self.counters.updates)
        else:
            text = json.dumps(versions(), indent=2)
            (self.dir / "versions.json").write_text(text + "\n")
        # The run as it is now: a resume may have changed the number of updates or the logger.
        self.config = {**OmegaConf.to_container(cfg, resolve=True), "resume": None}
        (self.dir / "config.yaml").write_text(OmegaConf.to_yaml(self.config))
        self._saved: int | None = None  # frames at the latest checkpoint of this sitting
        updates = self.counters.updates
        self.logger = RunLogger(self.dir, self.config, updates if resumed else None)
        self.bar = ProgressBar(cfg.optim.total_updates, updates)
        self._signal = StopSignal()
        self._lap = (time.perf_counter(), updates, self.counters.frames)
        self.bar.write(f"run directory: {self.dir}")
        if self.counters.frames < (warmup := cfg.collector.init_random_frames):
            self.bar.write(f"the first {warmup} frames are random actions, without updates")

    def __enter__(self) -> Run:
        """Starts to listen for signals."""
        self._signal.__enter__()
        return self

    def __exit__(self, *exc_info: object) -> None:
        """Closes the log."""
        self._signal.__exit__(*exc_info)
        try:
            self.bar.close()
            self.logger.close()
        finally:
            self._lock.release()

    @property
    def stopping(self) -> bool:
        """Whether a signal asks to stop."""
        return self._signal.received is not None

    def check(self, data: TensorDictBase) -> None:
        """Raises `RunError` for NaN in collected data, after a checkpoint without that data."""
        try:
            check_finite(data, self.config["env"]["name"], self.counters.frames)
        except RunError as error:
            # The environments cannot be trusted any more: the resumed run begins new episodes.
            path = self.save(without=("env", "episodes"))
            raise RunError(f"{error} What came before is in {path}.") from None

    def log_metrics(self, values: Metrics) -> None:
        """Adds a row of training metrics, with the time and the speed."""
        values = {**values, **self._speed()}
        self.logger.log("metrics", self.counters.updates, self.counters.frames, values)
        self.bar.show_metrics(self.counters.updates, self.counters.frames, values)

    def log_evaluation(self, values: Metrics) -> None:
        """Adds a row of evaluation results."""
        self.logger.log("eval", self.counters.updates, self.counters.frames, values)
        self.bar.show_evaluation(self.counters.updates, self.counters.frames, values)

    def end_iteration(
        self, since: int, metrics: Callable[[], Metrics], evaluation: Callable[[], Metrics]
    ) -> bool:
        """Logs, evaluates and saves what is due, and tells whether all updates are made.

        Args:
            since: Updates that had been made before this iteration.
            metrics: Gives the training metrics; called when a row of them is due.
            evaluation: Evaluates the policy; called when that is due.
        """
        cfg = self.config
        last = self.counters.updates >= cfg["optim"]["total_updates"]
        if self.counters.passed(cfg["logger"]["interval"], since):
            self.log_metrics(metrics())
        if self.counters.passed(cfg["eval"]["interval"], since) or last:
            self.log_evaluation(evaluation())
            last = last or has_reached(self.logger.tables["eval"].rows, cfg["eval"]["stop_return"])
        if self.counters.passed(cfg["checkpoint"]["interval"], since):
            self.save()
        self.bar.advance(self.counters.updates)
        return last

    def _speed(self) -> dict[str, float]:
        then, updates, frames = self._lap
        now = time.perf_counter()
        self._lap = (now, self.counters.updates, self.counters.frames)
        self.counters.seconds += now - then
        return {
            "seconds": self.counters.seconds,
            "frames_per_second": (self.counters.frames - frames) / (now - then),
            "updates_per_second": (self.counters.updates - updates) / (now - then),
        }

    def save(self, without: tuple[str, ...] = ()) -> Path:
        """Writes a checkpoint of all parts but those named."""
        parts = {name: part for name, part in self.parts.items() if name not in without}
        keep_last = self.config["checkpoint"]["keep_last"]
        updates = self.counters.updates
        self._saved = self.counters.frames
        return save_checkpoint(self.dir / "checkpoints", parts, self.config, updates, keep_last)

    def finish(self, completed: bool) -> None:
        """Writes the last checkpoint, the card and the curve, and says how it went.

        Args:
            completed: Whether all updates were made; False after a signal.
        """
        self._speed()
        if self._saved != self.counters.frames:
            self.save()
        rows = self.logger.tables["eval"].rows
        title = f"{self.config['algo']['name']} on {self.config['env']['name']}"
        write_card(self.dir, self.config, rows, self.counters.seconds, self.facts)
        plot_curve(self.dir, title, rows)
        if completed:
            before, after = (float(row["return_mean"]) for row in (rows[0], rows[-1]))
            self.bar.write(f"mean evaluation return: before {before:.1f}, after {after:.1f}")
        else:
            self.bar.write(
                f"stopped by {self._signal.received} after {self.counters.updates} updates; "
                f"go on with: python {self.script} resume={self.dir}"
            )


class StopSignal:
    """Turns the first Ctrl-C or SIGTERM into a wish to stop; a second one stops at once."""

    SIGNALS = (signal.SIGINT, signal.SIGTERM)

    def __init__(self) -> None:
        """Does nothing until it is entered."""
        self.received: str | None = None

    def __enter__(self) -> StopSignal:
        """Installs the handlers."""
        self._previous = {number: signal.signal(number, self._handle) for number in self.SIGNALS}
        return self

    def __exit__(self, *exc_info: object) -> None:
        """Puts the earlier handlers back."""
        for number, handler in self._previous.items():
            signal.signal(number, handler)

    def _handle(self, number: int, frame: FrameType | None) -> None:
        self.received = signal.Signals(number).name
        for each, handler in self._previous.items():
            signal.signal(each, handler)
