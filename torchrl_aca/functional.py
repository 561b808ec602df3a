"""The equations of ACA, one pure function each: tensors in, tensors out.

Notation, the paper's: ``s`` state, ``a_0`` clean action, ``a_t`` action at noise level ``t`` in
``1..T``, ``A`` action dimension, ``alpha_bar_t`` = ``alphas_cumprod``, ``sigma_t`` = posterior
standard deviation, ``w`` = guidance weight. Actions here are always in critic units, [-1, 1].
"Paper" is *Actor-Critic without Actor*, arXiv 2509.21022.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

__all__ = [
    "add_noise",
    "candidate_spread",
    "cosine_betas",
    "entropy_std",
    "guidance_gain",
    "guidance_step",
    "guided_noise",
    "langevin_step",
    "linear_betas",
    "noise_level_target",
    "normalize_gradient",
    "posterior_mean",
    "predict_clean",
    "select_best",
    "sinusoidal_embedding",
    "soft_value",
    "surrogate_entropy",
    "vp_betas",
]


# --- noise schedules ------------------------------------------------------------------------------


def cosine_betas(num_steps: int, offset: float = 0.008, beta_max: float = 0.999) -> Tensor:
    """Cosine schedule (Nichol & Dhariwal 2021, eq. 17); ACA's own with ``num_steps=20``.

    ``beta_t = min(1 - g(t) / g(t - 1), beta_max)`` with
    ``g(t) = cos^2((t / T + offset) / (1 + offset) pi / 2)``.

    Returns:
        Float64 tensor of shape ``(num_steps,)``; entry ``k - 1`` belongs to noise level ``k``.
    """
    grid = torch.arange(num_steps + 1, dtype=torch.float64) / num_steps
    g = torch.cos((grid + offset) / (1 + offset) * math.pi / 2) ** 2
    return (1 - g[1:] / g[:-1]).clamp(max=beta_max)


def linear_betas(
    num_steps: int, beta_start: float = 1e-4, beta_end: float = 0.02, scale: float = 1.0
) -> Tensor:
    """Linear schedule (Ho et al. 2020): ``scale * linspace(beta_start, beta_end, num_steps)``."""
    return scale * torch.linspace(beta_start, beta_end, num_steps, dtype=torch.float64)


def vp_betas(num_steps: int, beta_min: float = 0.1, beta_max: float = 10.0) -> Tensor:
    """Variance-preserving schedule (Song et al. 2021), discretised as in Diffusion-QL.

    ``beta_t = 1 - exp(-beta_min / T - (beta_max - beta_min) (2t - 1) / (2 T^2))``.
    """
    t = torch.arange(1, num_steps + 1, dtype=torch.float64)
    rate = beta_min / num_steps + (beta_max - beta_min) * (2 * t - 1) / (2 * num_steps**2)
    return 1 - torch.exp(-rate)


# --- forward and reverse diffusion ----------------------------------------------------------------


def add_noise(action: Tensor, noise: Tensor, alpha_cumprod: Tensor) -> Tensor:
    """Forward process: ``a_t = sqrt(alpha_bar_t) a_0 + sqrt(1 - alpha_bar_t) eps``."""
    return alpha_cumprod.sqrt() * action + (1 - alpha_cumprod).sqrt() * noise


def guided_noise(gradient: Tensor, guidance_weight: float | Tensor, sigma: Tensor) -> Tensor:
    """The noise that the critic predicts, ``-w sigma_t grad_a Q(s, a_t, t)`` (Definition 1)."""
    return -guidance_weight * sigma * gradient


def normalize_gradient(gradient: Tensor, eps: float = 1e-8) -> Tensor:
    """Unit-length gradient over the action dimensions: ``g / (||g||_2 + eps)`` (appendix)."""
    return gradient / (torch.linalg.vector_norm(gradient, dim=-1, keepdim=True) + eps)


def predict_clean(noisy_action: Tensor, noise: Tensor, alpha_cumprod: Tensor) -> Tensor:
    """Clean estimate: ``a_0 = a_t / sqrt(alpha_bar_t) - sqrt(1 / alpha_bar_t - 1) eps_hat``."""
    return noisy_action / alpha_cumprod.sqrt() - (1 / alpha_cumprod - 1).sqrt() * noise


def posterior_mean(clean: Tensor, noisy_action: Tensor, coef1: Tensor, coef2: Tensor) -> Tensor:
    """Mean of ``q(a_{t-1} | a_t, a_0) = c1_t a_0 + c2_t a_t`` (Ho et al. 2020, eq. 7)."""
    return coef1 * clean + coef2 * noisy_action


def langevin_step(
    action: Tensor,
    gradient: Tensor,
    guidance_weight: float | Tensor,
    step_size: Tensor,
    noise: Tensor,
) -> Tensor:
    """Langevin step ``a + eps/2 w grad_a Q(s, a) + sqrt(eps) z`` (paper, Langevin appendix)."""
    return action + step_size / 2 * guidance_weight * gradient + step_size.sqrt() * noise


# --- critic ---------------------------------------------------------------------------------------


def sinusoidal_embedding(noise_level: Tensor, dim: int) -> Tensor:
    """Sinusoidal features of the raw noise level.

    ``[sin(t f_j)]_j, [cos(t f_j)]_j`` with ``f_j = 10000^(-2j / dim)``, ``j = 0..dim/2 - 1``, all
    divided by ``sqrt(dim)`` as the official code does.

    Args:
        noise_level: floating-point levels of any shape ``(*,)``.
        dim: even number of features.

    Returns:
        Tensor of shape ``(*, dim)``.
    """
    exponent = torch.arange(dim // 2, device=noise_level.device, dtype=noise_level.dtype)
    angle = noise_level.unsqueeze(-1) * 10000.0 ** (-2 * exponent / dim)
    return torch.cat([angle.sin(), angle.cos()], dim=-1) / math.sqrt(dim)


def noise_level_target(clean_value: Tensor, kind: str) -> Tensor:
    """Regression target of the noise-level loss, from ``Q(s, a_0, 0)`` of shape ``(*batch, E)``.

    ``"self"``: each critic's own value (paper, critic objective); ``"mean"``: the mean over the
    critics (official code). The caller stops the gradient.
    """
    if kind == "self":
        return clean_value
    return clean_value.mean(-1, keepdim=True).expand_as(clean_value)


# --- acting ---------------------------------------------------------------------------------------


def select_best(candidates: Tensor, values: Tensor) -> Tensor:
    """Best of N: the candidate whose smallest critic value is largest; the first of equals.

    Args:
        candidates: actions of shape ``(N, *batch, A)``.
        values: critic values of shape ``(N, *batch, E)``.

    Returns:
        Tensor of shape ``(*batch, A)``.
    """
    best = values.amin(-1).argmax(0)
    return candidates.take_along_dim(best[None, ..., None], dim=0).squeeze(0)


def soft_value(values: Tensor, temperature: float) -> Tensor:
    """``tau log mean_n exp(V_n / tau)``: from the mean over the candidates to their best.

    ``V_n`` is the smallest critic's value. The mean for ``tau -> inf``, the maximum for
    ``tau -> 0`` (mellowmax, Asadi & Littman 2017); precise at both ends.

    Args:
        values: critic values of shape ``(N, *batch, E)``.
        temperature: ``tau`` above 0, in units of the values.

    Returns:
        Tensor of shape ``(*batch,)``.
    """
    lowest = values.amin(-1)
    highest = lowest.amax(0)
    # expm1 and log1p, as for a large tau all exponentials round to 1 and the mean would be lost.
    excess = ((lowest - highest) / temperature).expm1().mean(0)
    return highest + temperature * excess.log1p()


def surrogate_entropy(log_alpha: Tensor, action_dim: int, noise_scale: float = 0.1) -> Tensor:
    """Entropy of the exploration noise ``N(0, (noise_scale * alpha)^2 I)``, in nats.

    ``H = A/2 log(2 pi e (noise_scale * alpha)^2)``. It depends on no data: alpha follows an
    open-loop schedule towards ``noise_scale * alpha = exp(H_target / A) / sqrt(2 pi e)``.
    """
    return action_dim * (0.5 * math.log(2 * math.pi * math.e) + math.log(noise_scale) + log_alpha)


# --- a guidance weight that tunes itself ----------------------------------------------------------


def entropy_std(entropy: Tensor, action_dim: int) -> Tensor:
    """Standard deviation of the Gaussian ``N(0, std^2 I)`` of an entropy in nats.

    ``exp(H / A) / sqrt(2 pi e)``, where :func:`surrogate_entropy` leads the exploration noise too.
    """
    return (entropy / action_dim).exp() / math.sqrt(2 * math.pi * math.e)


def candidate_spread(candidates: Tensor) -> Tensor:
    """Standard deviation of a state's candidates, by the mean of the variances over dimensions.

    Args:
        candidates: actions of shape ``(N, *batch, A)``, two or more for each state.

    Returns:
        Tensor of shape ``(*batch,)``. Dimensions in which all candidates lie on the border of the
        box count with zero.
    """
    return candidates.var(0).mean(-1).sqrt()


def guidance_gain(values: Tensor, log_ratio: float) -> Tensor:
    """How fast the candidates' value rises with ``log w``, in standard deviations of that value.

    ``g_s = (mean of V over the first half - over the second) / log_ratio / sigma``, where ``V`` is
    the smallest critic's value and ``sigma^2`` its variance among a state's candidates, averaged
    over the states. The factor of the rewards cancels.

    Args:
        values: critic values at level 0 of shape ``(N, *batch, E)``; the second half of the ``N``
            comes from chains with a guidance weight ``exp(log_ratio)`` times smaller. States with
            NaN, as terminal ones may have, have a gain of NaN and no part in the scale.
        log_ratio: see ``values``.

    Returns:
        Tensor of shape ``(*batch,)``, whose mean is the derivative.
    """
    lowest = values.amin(-1)
    more, less = lowest.tensor_split(2)
    scale = lowest.var(0).nanmean().sqrt()
    return (more.mean(0) - less.mean(0)) / (log_ratio * scale + torch.finfo(scale.dtype).tiny)


def guidance_step(spread: Tensor, target: Tensor, gain: Tensor) -> Tensor:
    """Direction of ``log w``: ``min(log(spread / target), gain)``, cut to [-1, 1].

    The first is SAC's rule for its temperature, with the spread in the place of the entropy. The
    second stops it where a larger weight no longer raises the value.

    Args:
        spread: of the candidates, shape ``()``.
        target: of the spread, shape ``()``.
        gain: mean of :func:`guidance_gain`, shape ``()``.
    """
    return torch.minimum((spread / target).log(), gain).clamp(-1, 1)
