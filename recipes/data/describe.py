"""What a user wants to see of a data set."""

from __future__ import annotations

from torchrl_aca.offline import OfflineDataset


def summary(dataset: OfflineDataset) -> str:
    """Size, returns and normalised score in a few lines."""
    metadata = dataset.metadata
    text = (
        f"{dataset.path}: {metadata['transitions']} transitions in {metadata['episodes']} episodes"
    )
    if returns := metadata["returns"]:
        text += (
            f"\nreturns: mean {returns['mean']:.1f}, std {returns['std']:.1f}, "
            f"range {returns['min']:.1f} to {returns['max']:.1f}"
        )
        if metadata["reference_scores"]:
            text += (
                f"\nnormalised score of the mean: {dataset.normalized_score(returns['mean']):.1f}"
            )
    return text
