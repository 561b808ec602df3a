"""All that only a GPU shows, in one command: `make gpu`, or `python benchmarks/gpu.py`.

Runs the tests that need CUDA, times acting and updates (eager, compiled, captured as CUDA graphs),
and trains for a few minutes. Writes speed.md and the run's files to `--out`. It takes the Python,
the torch (>= 2.8) and the TorchRL (>= 0.14) that it is called with, and installs nothing. Needs
`recipes/` and `benchmarks/` on Python's path, as `make gpu` sees to.
"""

from __future__ import annotations

import argparse
import os
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path

import torch
from torch.utils.benchmark import Timer

from recipe import configure, make_recipe_agent, random_batch
from torchrl_aca.training.acceleration import capture
from torchrl_aca.training.envs import make_vector_env
from torchrl_aca.training.report import versions

ROOT = Path(__file__).resolve().parents[1]
VARIANTS = {
    "eager": ["compile=false", "cudagraphs=false"],
    "compiled": ["compile=true", "cudagraphs=false"],
    "captured": ["compile=true", "cudagraphs=true"],
}
TASKS = ("halfcheetah", "humanoid")
KEPT = ("config.yaml", "eval.csv", "metrics.csv", "versions.json", "card.md", "curve.png")


@dataclass(frozen=True)
class Case:
    """What is timed."""

    task: str
    num_candidates: int  # N of the target; acting has 32
    variant: str

    def overrides(self) -> list[str]:
        sizes = [f"env={self.task}", f"aca.num_target_candidates={self.num_candidates}"]
        return [*sizes, *VARIANTS[self.variant]]


def seconds_of(call: Callable[[], object], seconds: float) -> float:
    """The median time of a call, the device's work included, from calls in so many seconds."""
    timer = Timer("call()", globals={"call": call}, num_threads=torch.get_num_threads())
    return timer.blocked_autorange(min_run_time=seconds).median


def measure(case: Case, device: torch.device, seconds: float) -> tuple[float, float]:
    """Seconds of acting in five environments, and of an update, after compiling and capturing."""
    torch._dynamo.reset()
    cfg = configure(*case.overrides())
    env = make_vector_env(cfg.env.name, cfg.collector.num_envs, 0)
    agent = make_recipe_agent(cfg, env, device)
    sizes = (
        spec.shape[-1] for spec in (env.observation_spec["observation"], env.action_spec_unbatched)
    )
    batch = random_batch(*sizes, cfg.optim.batch_size).to(device)
    state = env.reset().to(device)
    policy = capture(agent.policy, cfg.cudagraphs)

    @torch.no_grad()
    def act() -> None:
        policy(state)

    for _ in range(12):  # six updates of each kind: one more than a graph's warm-up
        act()
        agent.update(batch)
    return seconds_of(act, seconds), seconds_of(lambda: agent.update(batch), seconds)


def table(device: torch.device, cases: Sequence[Case], seconds: float) -> Iterator[str]:
    """Yields the lines of the speed table as they are measured; a case that fails is told."""
    yield "| task | N of the target | variant | acting, 5 x 32 | update | updates/s |"
    yield "|---|--:|---|--:|--:|--:|"
    for case in cases:
        start = f"| {case.task} | {case.num_candidates} | {case.variant} |"
        try:
            acting, update = measure(case, device, seconds)
        except Exception as error:  # a defect of one variant must not hide the others
            first, *_ = [*str(error).splitlines(), ""]
            yield f"{start} failed: {type(error).__name__}: {first} | | |"
            continue
        yield f"{start} {1e3 * acting:.2f} ms | {1e3 * update:.2f} ms | {1 / update:.0f} |"


def run_tests() -> int:
    """The tests marked `gpu`; returns pytest's exit status. They compile, so on several cores."""
    command = [sys.executable, "-m", "pytest", "-m", "gpu", "-q"]
    if find_spec("xdist"):
        command += ["-n", str(min(os.cpu_count() or 1, 12))]
    return subprocess.run(command, cwd=ROOT, check=False).returncode


def train(out: Path, device: torch.device, updates: int) -> int:
    """A short training with `--config-name fast`; keeps its files in `out`."""
    with_graphs = ["cudagraphs=true"] if device.type == "cuda" else []
    run_dir = out / "run"
    shutil.rmtree(run_dir, ignore_errors=True)
    command = [sys.executable, "recipes/online_mujoco.py", "--config-name", "fast"]
    settings = [
        f"device={device.type}",
        f"run_dir={run_dir.resolve()}",
        f"optim.total_updates={updates}",
        f"eval.interval={max(updates // 4, 1)}",
        f"logger.interval={max(updates // 8, 1)}",
    ]
    status = subprocess.run([*command, *settings, *with_graphs], cwd=ROOT, check=False).returncode
    for path in run_dir.iterdir() if run_dir.is_dir() else ():
        if path.is_dir():
            shutil.rmtree(path)
        elif path.name not in KEPT:
            path.unlink()
    return status


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--out", type=Path, default=Path("results/gpu"))
    parser.add_argument("--device", default="cuda", help="cpu tries the script out")
    parser.add_argument("--candidates", nargs="+", type=int, default=[1, 4, 32])
    parser.add_argument("--tasks", nargs="+", default=TASKS)
    parser.add_argument("--variants", nargs="+", default=VARIANTS)
    parser.add_argument("--seconds", type=float, default=2.0, help="of each measurement")
    parser.add_argument("--updates", type=int, default=10000, help="of the training; 0: none")
    parser.add_argument("--no-tests", action="store_true")
    args = parser.parse_args(arguments)
    if args.device == "cuda" and not torch.cuda.is_available():
        sys.exit("error: expected a CUDA device, found none. Use a machine with one.")
    device = torch.device(args.device)
    status = 0 if args.no_tests else run_tests()
    cases = [
        Case(task, num_candidates, variant)
        for task in args.tasks
        for num_candidates in args.candidates
        for variant in args.variants
    ]
    args.out.mkdir(parents=True, exist_ok=True)
    facts = [f"- {name}: {value}" for name, value in versions().items() if value is not None]
    with open(args.out / "speed.md", "w") as file:
        lines = ["# Speed on a GPU", "", "Written by `make gpu`: medians.", "", *facts, ""]
        file.write("\n".join(lines) + "\n")
        for line in table(device, cases, args.seconds):
            print(line, flush=True)
            file.write(line + "\n")
            file.flush()
    if args.updates:
        status = train(args.out, device, args.updates) or status
    return status


if __name__ == "__main__":
    sys.exit(main())
