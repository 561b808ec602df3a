"""The noise schedule of the diffusion process that ACA's chain reverses."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from torchrl_aca import functional as F
from torchrl_aca.exact import ExactBuffers

__all__ = ["NoiseSchedule", "VarianceExplodingSchedule"]


class NoiseSchedule(ExactBuffers):
    """Constants of a discrete diffusion process with ``T`` noise levels.

    Every attribute listed below is a buffer of shape ``(T,)``, float64 but for the levels; row
    ``k - 1`` belongs to noise level ``k`` (level 0 is the clean action and has no row). The
    constants follow device moves but keep float64 when the module is cast, and are not part of the
    ``state_dict``.

    Args:
        betas: variances ``beta_1..beta_T`` of the forward process, each in (0, 1).
        noise_levels: the level that each row belongs to, where they are not ``1..T``; what
            :meth:`restrict` gives.

    Attributes:
        noise_levels: integers, ``1..T`` unless the schedule is a restricted one.
        betas: ``beta_t``.
        alphas: ``1 - beta_t``.
        alphas_cumprod: ``alpha_bar_t``, the product of the alphas up to ``t``.
        alphas_cumprod_prev: ``alpha_bar_{t-1}``, with ``alpha_bar_0 = 1``.
        posterior_variance: ``sigma_t^2 = beta_t (1 - alpha_bar_{t-1}) / (1 - alpha_bar_t)``; 0 at
            ``t = 1``, which is why the last denoising step is neither guided nor noisy.
        posterior_mean_coef1: weight of ``a_0`` in the posterior mean.
        posterior_mean_coef2: weight of ``a_t`` in the posterior mean.

    Raises:
        ValueError: if ``betas`` is not a vector of numbers in (0, 1).

    Examples:
        >>> schedule = NoiseSchedule.cosine(20)
        >>> schedule.num_steps
        20
        >>> noisy = schedule.add_noise(torch.zeros(5, 3), torch.randn(5, 3), torch.tensor(20))
    """

    noise_levels: Tensor
    betas: Tensor
    alphas: Tensor
    alphas_cumprod: Tensor
    alphas_cumprod_prev: Tensor
    posterior_variance: Tensor
    posterior_mean_coef1: Tensor
    posterior_mean_coef2: Tensor

    def __init__(self, betas: Tensor, noise_levels: Tensor | None = None) -> None:
        super().__init__()
        betas = torch.as_tensor(betas, dtype=torch.float64)
        if betas.ndim != 1 or not len(betas) or not bool(((betas > 0) & (betas < 1)).all()):
            raise ValueError(
                "NoiseSchedule expects betas as a non-empty vector of numbers in (0, 1), "
                f"got shape {tuple(betas.shape)} with values {betas.tolist()}."
            )
        alphas = 1 - betas
        cumprod = alphas.cumprod(0)
        previous = torch.cat([torch.ones_like(cumprod[:1]), cumprod[:-1]])
        if noise_levels is None:
            noise_levels = torch.arange(1, len(betas) + 1, device=betas.device)
        constants = {
            "noise_levels": noise_levels,
            "betas": betas,
            "alphas": alphas,
            "alphas_cumprod": cumprod,
            "alphas_cumprod_prev": previous,
            "posterior_variance": betas * (1 - previous) / (1 - cumprod),
            "posterior_mean_coef1": betas * previous.sqrt() / (1 - cumprod),
            "posterior_mean_coef2": (1 - previous) * alphas.sqrt() / (1 - cumprod),
        }
        for name, value in constants.items():
            self.register_buffer(name, value, persistent=False)

    @classmethod
    def cosine(cls, num_steps: int) -> NoiseSchedule:
        """The schedule of the official ACA code (there with ``num_steps=20``)."""
        return cls(F.cosine_betas(_positive(num_steps)))

    @classmethod
    def linear(
        cls, num_steps: int, beta_start: float = 1e-4, beta_end: float = 0.02, scale: float = 1.0
    ) -> NoiseSchedule:
        """Equally spaced betas; the defaults are those of DDPM."""
        return cls(F.linear_betas(_positive(num_steps), beta_start, beta_end, scale))

    @classmethod
    def vp(cls, num_steps: int) -> NoiseSchedule:
        """The variance-preserving schedule of Diffusion-QL."""
        return cls(F.vp_betas(_positive(num_steps)))

    @property
    def num_steps(self) -> int:
        """Number ``T`` of noise levels."""
        return len(self.betas)

    def restrict(self, levels: Sequence[int]) -> NoiseSchedule:
        """The schedule of a chain that visits only some of the levels.

        They keep their ``alpha_bar``, so ``beta_i = 1 - alpha_bar(t_i) / alpha_bar(t_{i-1})``; with
        all of them it is the schedule itself.

        Args:
            levels: rising levels, from ``1..T``.
        """
        if list(levels) == self.noise_levels.tolist():
            return self
        rows = torch.tensor(levels, device=self.betas.device) - 1
        cumprod = self.alphas_cumprod[rows]
        previous = torch.cat([torch.ones_like(cumprod[:1]), cumprod[:-1]])
        return NoiseSchedule(1 - cumprod / previous, self.noise_levels[rows])

    def add_noise(self, action: Tensor, noise: Tensor, noise_level: Tensor) -> Tensor:
        """Noise ``action`` to ``noise_level``.

        Args:
            action: clean actions ``a_0`` of shape ``(*batch, A)``.
            noise: standard normal draws of the same shape.
            noise_level: integers in ``1..T`` of shape ``(*batch,)`` or ``()``.

        Returns:
            ``a_t`` of shape ``(*batch, A)``.
        """
        return F.add_noise(action, noise, self.at(self.alphas_cumprod, noise_level, action.dtype))

    @staticmethod
    def at(constants: Tensor, noise_level: Tensor, dtype: torch.dtype) -> Tensor:
        """Rows of one of the constants, shape ``(*noise_level.shape, 1)``, to go with actions."""
        rows = constants.index_select(0, noise_level.reshape(-1) - 1)
        return rows.to(dtype).reshape(*noise_level.shape, 1)


class VarianceExplodingSchedule(ExactBuffers):
    """Noise that is added to an action without shrinking it: ``a_k = a_0 + sigma_k eps``.

    ``sigma_k = sigma_min (sigma_max / sigma_min)^(k / T)`` for the levels ``k = 0..T`` (Song &
    Ermon 2019). Level 0 stands for the clean action: in annealed Langevin dynamics it is visited
    last, with the noise of ``sigma_min``, but regression takes it as clean.

    Args:
        num_steps: number ``T`` of noisy levels.
        sigma_min: standard deviation at level 0, in critic units.
        sigma_max: standard deviation at level ``T``.

    Attributes:
        sigmas: float64 buffer of shape ``(T + 1,)``; row ``k`` belongs to level ``k``. It follows
            device moves, keeps float64 when cast and is not part of the ``state_dict``.

    Raises:
        ValueError: if ``num_steps`` is no positive integer, or not ``0 < sigma_min < sigma_max``.
    """

    sigmas: Tensor

    def __init__(self, num_steps: int, sigma_min: float = 1e-3, sigma_max: float = 0.1) -> None:
        super().__init__()
        if not 0 < sigma_min < sigma_max:
            raise ValueError(
                "VarianceExplodingSchedule expects 0 < sigma_min < sigma_max, "
                f"got sigma_min={sigma_min} and sigma_max={sigma_max}."
            )
        grid = torch.arange(_positive(num_steps) + 1, dtype=torch.float64) / num_steps
        self.register_buffer("sigmas", sigma_min * (sigma_max / sigma_min) ** grid, False)

    @property
    def num_steps(self) -> int:
        """Number ``T`` of noisy levels."""
        return len(self.sigmas) - 1

    def restrict(self, levels: Sequence[int]) -> VarianceExplodingSchedule:
        """The schedule itself, for all levels ``1..T``; a ValueError for fewer."""
        if list(levels) != list(range(1, self.num_steps + 1)):
            raise ValueError(
                f"Annealed Langevin dynamics visits every level, got {list(levels)}. Leave "
                "num_inference_steps and inference_levels out."
            )
        return self

    def add_noise(self, action: Tensor, noise: Tensor, noise_level: Tensor) -> Tensor:
        """As :meth:`NoiseSchedule.add_noise`."""
        sigma = self.sigmas[noise_level].to(action.dtype).unsqueeze(-1)
        return action + sigma * noise


def _positive(num_steps: int) -> int:
    if not isinstance(num_steps, int) or num_steps < 1:
        raise ValueError(f"num_steps must be a positive integer, got {num_steps!r}.")
    return num_steps
