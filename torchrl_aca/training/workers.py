"""Collection in other processes, through TorchRL's own collectors, on one machine or on Ray."""

from __future__ import annotations

import signal
import warnings
from collections.abc import Callable, Iterator
from functools import partial
from typing import Any

import numpy as np
import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torchrl.collectors import Collector
from torchrl.envs import GymWrapper

from torchrl_aca.errors import RunError
from torchrl_aca.training.collection import Collection
from torchrl_aca.training.config import Env, RunConfig
from torchrl_aca.training.envs import make_vector_env
from torchrl_aca.training.randomness import seed_everything

NO_END = 10**12  # frames: Ray's collector takes -1 for none at all


def make_collection(
    cfg: RunConfig, env: GymWrapper, policy: TensorDictModuleBase, device: torch.device
) -> Collection:
    """Returns what collects experience as `cfg.collector.backend` says.

    Args:
        cfg: The configuration.
        env: Environments made by `make_vector_env`; workers have others of their own.
        policy: Maps observations to actions.
        device: Device of the policy.

    Raises:
        RunError: If Ray is missing, or has fewer processors than workers.
    """
    if cfg.collector.backend == "direct":
        return Collection(env, policy, cfg.collector, device, cfg.cudagraphs)
    return WorkerCollection(cfg, env, policy, device)


class WorkerCollection(Collection):
    """Collection by several workers, each with as many of the environments, in step.

    A batch is that of all workers, in their order, made with the weights of after the last update.
    If a worker dies, what it had of its batch is lost, and all workers are replaced: their
    environments begin new episodes. So they do when a run is resumed.
    """

    def __init__(
        self,
        cfg: RunConfig,
        env: GymWrapper,
        policy: TensorDictModuleBase,
        device: torch.device | str = "cpu",
    ) -> None:
        """See `make_collection`."""
        super().__init__(env, policy, cfg.collector, device)
        self.savable = False
        self._task, self._seed, self._restarts = cfg.env, cfg.seed, 0
        if cfg.collector.backend == "ray":
            start_ray(cfg.collector.num_workers)

    def why_unsavable(self) -> str:
        """Says why episodes do not go on."""
        return "it is in other processes"

    def _batches(self) -> Iterator[TensorDictBase]:
        while True:
            try:
                self._collector = self._build()
                for data in self._collector:  # which brings the weights over before each batch
                    yield data.reshape(-1, data.shape[-1])  # (workers, environments, steps)
            except Exception as error:  # which one depends on when a worker dies, and of what
                self._restart(error)

    def _restart(self, error: Exception) -> None:
        """Makes ready for new workers, or raises `RunError` if that has been done too often."""
        most = self.settings.max_restarts
        why = f"a worker failed after {self.frames} frames ({type(error).__name__}: {error})"
        if self._restarts >= most:
            raise RunError(
                f"{why}; all workers had been replaced {self._restarts} times before, and "
                f"collector.max_restarts={most}. collector.backend=direct shows an environment's "
                "own error."
            ) from error
        self._restarts += 1
        warnings.warn(f"{why}; replacing all workers, {self._restarts} of {most}", stacklevel=2)
        self.episodes.reset()
        self.close()

    def _make_collector(self, random_frames: int) -> Collector:
        settings, threads = self.settings, torch.get_num_threads()
        ray = settings.backend == "ray"
        collector = Collector(
            self._env_makers(),
            self.policy,
            backend="ray" if ray else "process",
            sync=True,
            frames_per_batch=settings.frames_per_batch,
            init_random_frames=random_frames,
            total_frames=NO_END,
            backend_options=self._ray_options() if ray else self._process_options(),
        )
        torch.set_num_threads(threads)  # TorchRL takes one away for each process
        collector.update_policy_weights_(self.policy)  # else Ray warns, and processes do not end
        return collector

    def _env_makers(self) -> list[Callable[[], GymWrapper]]:
        """One for each worker; other random numbers after a restart than before it."""
        number = self.settings.num_workers
        state = np.random.SeedSequence([self._seed, self.frames, self._restarts])
        seeds = state.generate_state(number)
        size = self.settings.num_envs // number
        return [partial(make_worker_env, self._task, size, int(seed)) for seed in seeds]

    def _process_options(self) -> dict[str, Any]:
        return {
            "update_at_each_batch": True,  # after a look whether all live: a dead one never answers
            "policy_device": self.device,
            "env_device": "cpu",
            "storing_device": "cpu",
            "auto_register_policy_transforms": False,
        }

    def _ray_options(self) -> dict[str, Any]:
        kwargs = {"auto_register_policy_transforms": False}
        return {
            "update_after_each_batch": True,
            "remote_configs": {"num_cpus": 1},
            "collector_kwargs": kwargs,
        }

    def close(self) -> None:
        """Ends the workers, the dead ones as well."""
        if self._collector is None:
            return
        schemes = getattr(self._collector, "_weight_sync_schemes", None) or {}
        try:
            self._collector.shutdown()
        except Exception as error:  # of a worker that is dead already
            warnings.warn(f"while ending the workers: {error}", stacklevel=2)
        for scheme in schemes.values():
            scheme.shutdown()
        self._collector = None


def make_worker_env(task: str | Env, num_envs: int, seed: int) -> GymWrapper:
    """Builds a worker's environments, in the worker: its draws are seeded as well.

    Ctrl-C goes to all processes of a terminal. The run's own ends the workers when it has saved.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    seed_everything(seed)
    return make_vector_env(task, num_envs, seed % 2**31)


def start_ray(num_workers: int) -> None:
    """Joins the Ray cluster of RAY_ADDRESS, or starts one here; it would wait for processors.

    Raises:
        RunError: If Ray is missing, or has fewer processors than workers.
    """
    try:
        import ray
    except ImportError as error:
        raise RunError(
            "collector.backend=ray needs Ray: pip install 'torchrl-aca[distributed]', or take "
            "collector.backend=multi_process on one machine."
        ) from error
    if not ray.is_initialized():
        ray.init(log_to_driver=False)
    if (there := ray.cluster_resources().get("CPU", 0)) < num_workers:
        raise RunError(
            f"collector.num_workers={num_workers}: expected at most the {there:g} processors of "
            "the Ray cluster. Take fewer, or a larger cluster with RAY_ADDRESS."
        )
