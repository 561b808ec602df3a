"""The reverse chains, from noise to actions, as functions of a predictor.

A predictor is whatever tells the noise in an action, or the direction in which to move it: the
gradient of a critic or a network alike. Where it is differentiable, so is the chain, through all of
its steps.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, Literal

import torch
from torch import Tensor

from torchrl_aca import functional as F
from torchrl_aca.schedule import NoiseSchedule

__all__ = [
    "StepRunner",
    "check_levels",
    "denoise",
    "inference_levels",
    "langevin",
    "posterior_step",
    "tiles",
]

Variance = Literal["posterior", "beta"]


def inference_levels(num_levels: int, num_steps: int) -> list[int]:
    """The levels that a chain of ``num_steps`` visits: densely at the bottom, sparsely at the top.

    Level ``k`` of ``S`` is ``1 + (T - 1) ((k - 1) / (S - 1))^4``, rounded, or the next free one
    where that is taken. The low levels decide the action: the stride of the guidance falls with the
    level, and the last strides leave the spread of the candidates. At the high levels the clip
    decides the clean estimate, whatever the stride: with the cosine and the vp schedule, not with
    the linear one, for which explicit levels are better.

    Args:
        num_levels: number ``T`` of noise levels.
        num_steps: number ``S`` of steps, from 2 to ``T``; ``T`` itself gives the whole chain.

    Raises:
        ValueError: if ``num_steps`` is not one of those.

    Examples:
        >>> inference_levels(20, 10)
        [1, 2, 3, 4, 5, 6, 7, 8, 13, 20]
    """
    if num_steps == num_levels:
        return list(range(1, num_levels + 1))
    if not isinstance(num_steps, int) or not 2 <= num_steps < num_levels:
        raise ValueError(f"Expected a number of steps from 2 to {num_levels}, got {num_steps!r}.")
    grid = torch.linspace(0, 1, num_steps, dtype=torch.float64)
    levels = (1 + (num_levels - 1) * grid**4).round().long()
    return torch.maximum(levels, torch.arange(1, num_steps + 1)).tolist()


def check_levels(levels: Sequence[int], num_levels: int) -> list[int]:
    """The levels of a chain, as given.

    Args:
        levels: rising integers from 1 to ``T``, both included: the last step ends at the clean
            action, and the first starts from standard normal noise.
        num_levels: number ``T`` of noise levels.

    Raises:
        ValueError: if they are not.
    """
    given = list(levels)
    whole = [int(level) for level in given]
    rising = whole == given and whole == sorted(set(whole))
    if len(given) < 2 or not rising or (given[0], given[-1]) != (1, num_levels):
        raise ValueError(
            f"Expected inference_levels as rising integers from 1 to {num_levels}, both included, "
            f"such as [1, 2, 3, {num_levels}]; got {given}."
        )
    return whole


# --- the chains -----------------------------------------------------------------------------------


def _call(function: Callable, *arguments: Any) -> Tensor:
    return function(*arguments)


def denoise(
    predict_noise: Callable[[Tensor, Tensor], Tensor],
    schedule: NoiseSchedule,
    noise: Tensor,
    *,
    clip: bool | float = True,
    clip_step: bool | float = False,
    variance: Variance = "posterior",
    initial_scale: float = 1.0,
    predict_last: bool = True,
    keep_path: bool = False,
    tile_rows: int | None = None,
    run: Callable[..., Tensor] = _call,
) -> Tensor:
    """Denoise ``a_S`` to ``a_0`` by the posterior of DDPM (Ho et al. 2020, algorithm 2).

    On a schedule of fewer levels (:meth:`NoiseSchedule.restrict`) the steps are those of DDIM with
    ``eta = 1`` (Song et al. 2021, eq. 12 and 16).

    Args:
        predict_noise: ``(action, level) -> eps_hat``; ``level`` is an integer tensor of shape
            ``()``, one of ``schedule.noise_levels``.
        schedule: the constants of the ``S`` levels that the chain visits.
        noise: standard normal draws of shape ``(S + 1, *batch, A)``: row 0 is the chain's start,
            row ``k`` belongs to the ``k``-th step. The last row is multiplied by zero.

    Keyword Args:
        clip: see :func:`posterior_step`. Default: True.
        clip_step: clip the action after each step to [-1, 1], or to [-c, c] for a number ``c``.
            Default: False.
        variance: see :func:`posterior_step`. Default: ``"posterior"``.
        initial_scale: the chain starts from so many times ``noise[0]``. Default: 1.
        predict_last: ask for the noise in the step from level 1 as well. Where it is zero there, as
            guidance is by a factor ``sigma_1 = 0``, that need not be asked. Default: True.
        keep_path: give every step, ``a_S .. a_0``, in the shape of ``noise``. Default: False.
        tile_rows: see :func:`tiles`; the first dimension of ``batch`` holds the candidates.
            Default: all at once.
        run: calls a step with its arguments; a :class:`StepRunner` to compile it.

    Returns:
        ``a_0`` of shape ``(*batch, A)``.
    """
    constants = schedule, clip, clip_step, variance
    *rows, last = torch.arange(schedule.num_steps, 0, -1, device=noise.device)
    steps = [partial(run, _denoise_step, predict_noise, *constants, row) for row in rows]
    if predict_last:
        steps.append(partial(run, _denoise_step, predict_noise, *constants, last))
    else:
        steps.append(partial(_denoise_step, _no_noise, *constants, last))
    return _walk(steps, initial_scale, noise, keep_path, tile_rows)


def langevin(
    gradient: Callable[[Tensor, Tensor], Tensor],
    noise: Tensor,
    step_size: float | Sequence[float] | Tensor,
    *,
    levels: Tensor | None = None,
    guidance_weight: float | Tensor = 1.0,
    clip: bool | float = False,
    initial_scale: float = 1.0,
    keep_path: bool = False,
    tile_rows: int | None = None,
    run: Callable[..., Tensor] = _call,
) -> Tensor:
    """Langevin steps ``a + eps_k/2 w g(a) + sqrt(eps_k) z`` along a gradient.

    Args:
        gradient: ``(action, level) -> g``; ``level`` is an integer tensor of shape ``()``.
        noise: as in :func:`denoise`; every step adds its row.
        step_size: ``eps``, one number, or one of shape ``(S,)`` for each step, first to last.

    Keyword Args:
        levels: the noise level of each step, integers of shape ``(S,)``, first to last; annealed
            Langevin dynamics. Default: ``S .. 1``, for a gradient that does not read it.
        guidance_weight: ``w``. Default: 1.
        clip: clip the action after each step to [-1, 1], or to [-c, c] for a number ``c``.
            Default: False.
        initial_scale: as in :func:`denoise`.
        keep_path: as in :func:`denoise`.
        tile_rows: as in :func:`denoise`.
        run: as in :func:`denoise`.

    Returns:
        The action after the last step, shape ``(*batch, A)``.
    """
    sizes = torch.as_tensor(step_size, dtype=torch.float64, device=noise.device)
    sizes = sizes.expand(len(noise) - 1)
    if levels is None:
        levels = torch.arange(len(sizes), 0, -1, device=noise.device)
    steps = [
        partial(run, _langevin_step, gradient, guidance_weight, clip, eps, level)
        for eps, level in zip(sizes, levels, strict=True)
    ]
    return _walk(steps, initial_scale, noise, keep_path, tile_rows)


def _walk(
    steps: Sequence[Callable[[Tensor, Tensor], Tensor]],
    initial_scale: float,
    noise: Tensor,
    keep_path: bool,
    tile_rows: int | None,
) -> Tensor:
    """Take the steps ``(action, noise) -> action`` one after the other, tile by tile."""
    ends = []
    for tile in tiles(noise, tile_rows, dim=1):
        path = [initial_scale * tile[0]]
        for step, step_noise in zip(steps, tile[1:], strict=True):
            path.append(step(path[-1], step_noise))
        ends.append(torch.stack(path) if keep_path else path[-1])
    return torch.cat(ends, dim=1 if keep_path else 0)


# --- their steps ----------------------------------------------------------------------------------


def posterior_step(
    schedule: NoiseSchedule,
    noisy_action: Tensor,
    predicted_noise: Tensor,
    noise: Tensor,
    row: Tensor,
    clip: bool | float = True,
    variance: Variance = "posterior",
) -> Tensor:
    """One step of the reverse chain, ``a_t -> a_{t-1}`` (Definition 1 of the paper).

    Args:
        schedule: the constants.
        noisy_action: ``a_t`` of shape ``(*batch, A)``.
        predicted_noise: ``eps_hat``, same shape.
        noise: standard normal draws, broadcastable to that shape.
        row: which of the schedule's levels, counted from 1, ``a_t`` is at: an integer tensor of
            shape ``(*batch,)`` or ``()``.
        clip: clip the clean estimate to [-1, 1] (official code) or leave it (paper's text); a
            number ``c`` clips to [-c, c].
        variance: of the noise that is added: the ``"posterior"`` variance, or ``"beta"`` for
            ``beta_t``. The step from level 1 adds none in either case.

    Returns:
        ``a_{t-1}`` of shape ``(*batch, A)``.
    """
    noise_variance = schedule.posterior_variance
    if variance == "beta":
        noise_variance = schedule.betas * (noise_variance > 0)
    coef1, coef2, alpha_cumprod, noise_variance = (
        schedule.at(constants, row, noisy_action.dtype)
        for constants in (
            schedule.posterior_mean_coef1,
            schedule.posterior_mean_coef2,
            schedule.alphas_cumprod,
            noise_variance,
        )
    )
    # 1. clean estimate   2. its box   3. posterior mean   4. noise
    clean = F.predict_clean(noisy_action, predicted_noise, alpha_cumprod)
    clean = _clipped(clean, clip)
    return F.posterior_mean(clean, noisy_action, coef1, coef2) + noise_variance.sqrt() * noise


def _denoise_step(
    predict_noise: Callable[[Tensor, Tensor], Tensor],
    schedule: NoiseSchedule,
    clip: bool | float,
    clip_step: bool | float,
    variance: Variance,
    row: Tensor,
    action: Tensor,
    noise: Tensor,
) -> Tensor:
    """One step; which is a tensor, so that one compiled step serves them all."""
    level = schedule.noise_levels.index_select(0, row.reshape(-1) - 1).reshape(row.shape)
    predicted_noise = predict_noise(action, level)
    action = posterior_step(schedule, action, predicted_noise, noise, row, clip, variance)
    return _clipped(action, clip_step)


def _no_noise(action: Tensor, level: Tensor) -> Tensor:
    return torch.zeros_like(action)


def _langevin_step(
    gradient: Callable[[Tensor, Tensor], Tensor],
    guidance_weight: float | Tensor,
    clip: bool | float,
    step_size: Tensor,
    level: Tensor,
    action: Tensor,
    noise: Tensor,
) -> Tensor:
    here = gradient(action, level)
    action = F.langevin_step(action, here, guidance_weight, step_size, noise)
    return _clipped(action, clip)


def _clipped(action: Tensor, clip: bool | float) -> Tensor:
    return action.clamp(-float(clip), float(clip)) if clip else action


# --- how they run ---------------------------------------------------------------------------------


def tiles(rows: Tensor, tile_rows: int | None, dim: int) -> tuple[Tensor, ...]:
    """Split rows of shape ``(..., N, *batch, A)`` by their candidates, which lie along ``dim``.

    On a CPU a tile of ``tile_rows`` rows, at least one candidate of every state, keeps its
    activations in the cache, and bounds the memory. Elsewhere, and in a graph that would unroll the
    tiles, all go at once.
    """
    if tile_rows is None or rows.device.type != "cpu" or torch.compiler.is_compiling():
        return (rows,)
    num_states = rows.shape[dim + 1 : -1].numel()
    return rows.split(max(tile_rows // max(num_states, 1), 1), dim)


class StepRunner:
    """Calls functions of tensors through ``torch.compile``, each compiled at its first call.

    Args:
        compiled: False calls them as they are.
    """

    def __init__(self, compiled: bool) -> None:
        self.compiled = compiled
        self._functions: dict[Callable, Callable] = {}

    def __call__(self, function: Callable, *arguments: Any) -> Tensor:
        """``function(*arguments)``."""
        if not self.compiled or torch.compiler.is_compiling():
            return function(*arguments)
        if function not in self._functions:
            self._functions[function] = torch.compile(function, dynamic=True)
        # Dynamic, and on copies: acting, targets and evaluation differ in rows, and code compiled
        # for a view depends on the tensor behind it. Each would be compiled anew.
        copies = [a.clone() if isinstance(a, Tensor) else a for a in arguments]
        return self._functions[function](*copies)

    def __getstate__(self) -> dict[str, Any]:
        """Copies and workers compile for themselves: compiled code does not travel."""
        return {**self.__dict__, "_functions": {}}
