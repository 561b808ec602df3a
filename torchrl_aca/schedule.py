"""The noise schedule of the diffusion process that ACA's chain reverses."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch
from torch import Tensor, nn

from torchrl_aca import functional as F

__all__ = ["NoiseSchedule"]


class NoiseSchedule(nn.Module):
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

    def _apply(self, fn: Callable, recurse: bool = True) -> NoiseSchedule:
        """Follow device moves, ignore casts: the chain divides by numbers as small as 1e-3."""
        exact = dict(self.named_buffers())
        super()._apply(fn, recurse)
        for name, moved in list(self.named_buffers()):
            self._buffers[name] = exact[name].to(moved.device)
        return self


def _positive(num_steps: int) -> int:
    if not isinstance(num_steps, int) or num_steps < 1:
        raise ValueError(f"num_steps must be a positive integer, got {num_steps!r}.")
    return num_steps
