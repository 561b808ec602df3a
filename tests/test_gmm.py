"""Mixtures of Gaussians against expectation maximisation written out in NumPy."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from torchrl_aca.baselines.gmm import GaussianMixture, fit_gmm, gmm_entropy, responsibilities

LOADING = 1e-6


def oracle_start(samples, num_components, num_iterations):
    """k-means from far-apart samples, sample by sample; which centre each belongs to."""
    centres = [max(samples, key=lambda s: np.sum((s - samples.mean(0)) ** 2))]
    while len(centres) < num_components:
        centres.append(max(samples, key=lambda s: min(np.sum((s - c) ** 2) for c in centres)))
    for _ in range(num_iterations + 1):
        nearest = np.array([np.argmin([np.sum((s - c) ** 2) for c in centres]) for s in samples])
        centres = [samples[nearest == k].mean(0) for k in range(num_components)]
    return np.eye(num_components)[nearest]


def oracle_mixture(samples, given):
    """Weights, means and covariances of samples that belong to each component by shares."""
    weights = given.sum(0) / len(samples)
    means = [np.average(samples, axis=0, weights=g) for g in given.T]
    covariances = [
        np.cov(samples.T, aweights=g, ddof=0).reshape(2 * samples.shape[1:])
        + LOADING * np.eye(samples.shape[1])
        for g in given.T
    ]
    return weights, np.stack(means), np.stack(covariances)


def oracle_responsibilities(samples, weights, means, covariances):
    shares = []
    for sample in samples:
        densities = [
            w * np.exp(-(sample - m) @ np.linalg.inv(c) @ (sample - m) / 2)
            / np.sqrt(np.linalg.det(2 * np.pi * c))
            for w, m, c in zip(weights, means, covariances, strict=True)
        ]  # fmt: skip
        shares.append(np.array(densities) / sum(densities))
    return np.array(shares)


def oracle_entropy(weights, covariances):
    gaussians = [np.log(np.linalg.det(2 * np.pi * np.e * c)) / 2 for c in covariances]
    return sum(w * (g - np.log(w)) for w, g in zip(weights, gaussians, strict=True))


def clusters(num=90, action_dim=2, seed=0):
    """Samples around three overlapping centres, float64."""
    rng = np.random.default_rng(seed)
    centres = rng.normal(size=(3, action_dim))
    return centres[np.arange(num) % 3] + 0.4 * rng.normal(size=(num, action_dim))


@pytest.mark.parametrize("action_dim", [1, 2, 5])
def test_fit_is_expectation_maximisation(action_dim):
    sets = np.stack([clusters(action_dim=action_dim, seed=seed) for seed in range(4)])
    fitted = fit_gmm(torch.from_numpy(sets), 3, num_iterations=7, num_start_iterations=2)
    for number, samples in enumerate(sets):
        mixture = oracle_mixture(samples, oracle_start(samples, 3, 2))
        for _ in range(7):
            mixture = oracle_mixture(samples, oracle_responsibilities(samples, *mixture))
        for got, expected in zip(fitted, mixture, strict=True):
            np.testing.assert_allclose(got[number], expected, rtol=1e-6, atol=1e-9)
        entropy = gmm_entropy(GaussianMixture(*(part[number] for part in fitted)))
        assert entropy.item() == pytest.approx(oracle_entropy(mixture[0], mixture[2]), rel=1e-6)


def test_responsibilities_are_the_posterior():
    samples = clusters()
    mixture = oracle_mixture(samples, oracle_start(samples, 3, 2))
    parts = GaussianMixture(*map(torch.from_numpy, mixture))
    expected = oracle_responsibilities(samples, *mixture)
    actual = responsibilities(torch.from_numpy(samples), parts)
    np.testing.assert_allclose(actual, expected, rtol=1e-9, atol=1e-12)


def test_far_apart_gaussians_are_found_with_their_entropy():
    torch.manual_seed(0)
    centres, std = torch.tensor([[0.0, 0.0], [9.0, 0.0], [0.0, 9.0]]), 0.5
    share = torch.tensor([0.5, 0.3, 0.2])
    samples = centres[torch.multinomial(share, 5000, replacement=True)]
    mixture = fit_gmm(samples + std * torch.randn(5000, 2), 3)
    order = mixture.weights.argsort(descending=True)
    torch.testing.assert_close(mixture.weights[order], share, atol=0.02, rtol=0)
    torch.testing.assert_close(mixture.means[order], centres, atol=0.08, rtol=0)
    exact = -(share * share.log()).sum() + math.log(2 * math.pi * math.e * std**2)
    assert gmm_entropy(mixture).item() == pytest.approx(exact.item(), abs=0.05)


def test_entropy_follows_the_scale_and_not_the_place():
    samples = torch.from_numpy(clusters())
    entropy = gmm_entropy(fit_gmm(samples, loading=1e-12))
    larger = gmm_entropy(fit_gmm(3 * samples + 7, loading=1e-12))
    assert (larger - entropy).item() == pytest.approx(2 * math.log(3), abs=1e-6)


@pytest.mark.parametrize("samples", [torch.ones(20, 3), torch.full((20, 3), 1e3)])
def test_equal_samples_have_the_entropy_of_the_loading(samples):
    entropy = gmm_entropy(fit_gmm(samples))
    assert entropy.isfinite()
    assert entropy.item() == pytest.approx(1.5 * math.log(2 * math.pi * math.e * LOADING), abs=0.5)


def test_more_states_at_a_time_change_nothing():
    sets = torch.stack([torch.from_numpy(clusters(seed=seed)) for seed in range(6)])
    whole = fit_gmm(sets.view(2, 3, 90, 2))
    assert whole.weights.shape == (2, 3, 3) and gmm_entropy(whole).shape == (2, 3)
    for number, samples in enumerate(sets):
        alone = fit_gmm(samples)
        for got, expected in zip(whole, alone, strict=True):
            torch.testing.assert_close(got.flatten(0, 1)[number], expected)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"num_components": 0}, "num_components >= 1, got num_components=0"),
        ({"num_components": 91}, "num_samples >= 91, got num_samples=90"),
        ({"num_iterations": 0}, "num_iterations >= 1"),
        ({"loading": 0.0}, "loading > 0"),
    ],
)
def test_numbers_out_of_range_are_refused(changes, message):
    with pytest.raises(ValueError, match=message):
        fit_gmm(torch.from_numpy(clusters()), **changes)
