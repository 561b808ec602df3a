"""Gaussian mixtures fitted to samples, many sets at a time, and the entropy that they tell.

DACER's temperature follows the entropy of its policy, whose density nobody knows: it is estimated
from samples. Its authors' code fits with scikit-learn, one state after the other.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from torchrl_aca.checks import check_above, check_at_least

__all__ = ["GaussianMixture", "fit_gmm", "gmm_entropy", "responsibilities"]


class GaussianMixture(NamedTuple):
    """Parameters of ``K`` Gaussians with full covariances, for each of a batch of sets.

    Attributes:
        weights: shape ``(*batch, K)``, summing to 1.
        means: shape ``(*batch, K, A)``.
        covariances: shape ``(*batch, K, A, A)``.
    """

    weights: Tensor
    means: Tensor
    covariances: Tensor


def fit_gmm(
    samples: Tensor,
    num_components: int = 3,
    *,
    num_iterations: int = 100,
    num_start_iterations: int = 10,
    loading: float = 1e-6,
) -> GaussianMixture:
    """Fit a mixture to each set of samples by expectation maximisation.

    The start is k-means from far-apart samples, so that the same samples give the same mixture. The
    number of iterations is fixed: no set waits for another.

    Args:
        samples: shape ``(*batch, n, A)``.
        num_components: number ``K`` of Gaussians, at most ``n``.

    Keyword Args:
        num_iterations: of expectation maximisation. Default: 100, at most as many as scikit-learn.
        num_start_iterations: of k-means. Default: 10.
        loading: added to the diagonal of each covariance, so that equal samples have one too.
            Default: 1e-6.

    Raises:
        ValueError: if a number is out of range.
    """
    check_at_least(1, num_components=num_components, num_iterations=num_iterations)
    check_at_least(0, num_start_iterations=num_start_iterations)
    check_above(0, loading=loading)
    check_at_least(num_components, num_samples=samples.shape[-2])
    centres = _far_apart(samples, num_components)
    for _ in range(num_start_iterations):
        centres = _maximise(samples, _nearest(samples, centres), loading).means
    mixture = _maximise(samples, _nearest(samples, centres), loading)
    for _ in range(num_iterations):
        mixture = _maximise(samples, responsibilities(samples, mixture), loading)
    return mixture


def gmm_entropy(mixture: GaussianMixture) -> Tensor:
    """DACER's estimate of a mixture's entropy in nats, an upper bound; shape ``(*batch,)``.

    ``H = -sum_k w_k log w_k + sum_k w_k (A/2 (1 + log 2 pi) + 1/2 log det C_k)``: exact where the
    Gaussians do not overlap.
    """
    weights, _, covariances = mixture
    action_dim = covariances.shape[-1]
    log_det = torch.linalg.slogdet(covariances).logabsdet
    of_gaussian = action_dim / 2 * (1 + math.log(2 * math.pi)) + log_det / 2
    return (torch.special.entr(weights) + weights * of_gaussian).sum(-1)


def responsibilities(samples: Tensor, mixture: GaussianMixture) -> Tensor:
    """``p(k | sample)`` under the mixture, shape ``(*batch, n, K)``."""
    weights, means, covariances = mixture
    factor = torch.linalg.cholesky_ex(covariances).L  # reads no value, as a check would
    offsets = (samples.unsqueeze(-3) - means.unsqueeze(-2)).mT  # (*batch, K, A, n)
    scaled = torch.linalg.solve_triangular(factor, offsets, upper=False)
    log_det = factor.diagonal(dim1=-2, dim2=-1).log().sum(-1)
    # The factor (2 pi)^(-A/2) is common to all Gaussians.
    log_density = -scaled.square().sum(-2) / 2 - log_det.unsqueeze(-1)
    return (log_density + weights.log().unsqueeze(-1)).mT.softmax(-1)


def _maximise(samples: Tensor, responsibility: Tensor, loading: float) -> GaussianMixture:
    """The mixture that explains samples of such responsibilities, ``(*batch, n, K)``, best."""
    # A Gaussian that no sample belongs to keeps a weight above zero, as in scikit-learn.
    counts = responsibility.sum(-2) + 10 * torch.finfo(samples.dtype).eps
    means = responsibility.mT @ samples / counts.unsqueeze(-1)
    offsets = samples.unsqueeze(-3) - means.unsqueeze(-2)  # (*batch, K, n, A)
    weighted = offsets * responsibility.mT.unsqueeze(-1)
    covariances = weighted.mT @ offsets / counts[..., None, None]
    diagonal = loading * torch.eye(samples.shape[-1], dtype=samples.dtype, device=samples.device)
    return GaussianMixture(counts / counts.sum(-1, keepdim=True), means, covariances + diagonal)


def _far_apart(samples: Tensor, num_centres: int) -> Tensor:
    """Samples far from one another, ``(*batch, K, A)``: the first is farthest from the mean."""
    distance = (samples - samples.mean(-2, keepdim=True)).square().sum(-1)
    centres = [_sample_at(samples, distance.argmax(-1))]
    distance = torch.full_like(distance, torch.inf)
    for _ in range(num_centres - 1):
        latest = (samples - centres[-1].unsqueeze(-2)).square().sum(-1)
        distance = torch.minimum(distance, latest)
        centres.append(_sample_at(samples, distance.argmax(-1)))
    return torch.stack(centres, -2)


def _sample_at(samples: Tensor, index: Tensor) -> Tensor:
    return samples.take_along_dim(index[..., None, None], -2).squeeze(-2)


def _nearest(samples: Tensor, centres: Tensor) -> Tensor:
    """Which centre each sample is nearest to, as responsibilities ``(*batch, n, K)``."""
    nearest = torch.cdist(samples, centres).argmin(-1)
    return torch.nn.functional.one_hot(nearest, centres.shape[-2]).to(samples.dtype)
