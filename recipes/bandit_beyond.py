"""What ACA's paper leaves open, on its 2D bandit: a guidance weight that tunes itself, soft values.

    python recipes/bandit_beyond.py
    python recipes/bandit_beyond.py seeds=[0] "ablation.training={beyond.reward_scale: [1.0]}"

Two tables:

- guidance.csv: the weight at which `guidance_weight="auto"` ends, for each combination of the
  configuration and each seed, beside the best one of a sweep on the very same critic, by the mean
  reward; the reported rewards are of fresh samples;
- soft.csv: of the first combination, the soft value of N candidates by the trained critic at level
  0, by the known reward of the same candidates, and by that of many candidates.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import hydra
import torch
from omegaconf import DictConfig
from tensordict import TensorDict, TensorDictBase
from torchrl import logger as torchrl_logger
from tqdm import tqdm

from bandit import tables
from bandit.config import BeyondConfig, variants
from bandit.env import reward
from bandit.guided import draw, measure, sweep, train
from bandit.launch import launch
from bandit.tables import Row
from torchrl_aca import ACALoss, CriticGuidedDenoisingActor
from torchrl_aca import functional as F


def train_auto(cfg: BeyondConfig, seed: int) -> CriticGuidedDenoisingActor:
    """Trains ACA while its guidance weight tunes itself, beginning at that of the collector."""
    settings = cfg.beyond
    shape = [settings.num_states]  # all alike: there is nothing to observe
    following = TensorDict(observation=torch.zeros(*shape, 1), batch_size=shape)
    states = TensorDict(action=torch.zeros(*shape, 2), next=following, batch_size=shape)

    def tune(loss: ACALoss, batch: TensorDictBase, updates: int) -> None:
        if updates % settings.interval == 0:
            data = states.copy()
            loss.sample_next_action(data)
            loss.step_guidance_weight(data)

    return train(
        cfg,
        "aca",
        seed,
        tune,
        guidance_weight="auto",
        guidance_weight_lr=settings.guidance_weight_lr,
        num_target_candidates=settings.num_candidates,
        reward_scale=settings.reward_scale,
    )


def guidance_row(cfg: BeyondConfig, actor: CriticGuidedDenoisingActor) -> Row:
    """The automatic weight beside the sweep's best; leaves the actor with the automatic one."""
    weights = {"auto": float(actor.guidance_weight)}
    sweep(cfg, actor)
    weights["best"] = float(actor.guidance_weight)
    row: Row = {}
    for name, weight in reversed(weights.items()):
        actor.guidance_weight = weight
        measured = measure(draw(actor, cfg.report.num_samples))
        row |= {f"{name} w": weight}
        row |= {f"{name} {key}": measured[key] for key in ("reward_mean", "sum")}
    return row


@torch.no_grad()
def soft_rows(cfg: BeyondConfig, actor: CriticGuidedDenoisingActor) -> Iterator[Row]:
    """Soft values of the actor's candidates, one row for each temperature."""
    settings, num_states = cfg.beyond, cfg.beyond.num_states
    features = actor.encode(torch.zeros(num_states, 1), [num_states])
    draws = actor.draws(num_states, settings.num_proposals)
    candidates = actor.propose(features, draws[:-1])
    known = settings.reward_scale * reward(candidates)[..., None]
    learnt = actor.values(features, candidates)
    for temperature in settings.temperatures:
        values = {
            "critic": F.soft_value(learnt, temperature),
            "reward": F.soft_value(known, temperature),
            "reward, all candidates at once": F.soft_value(known.flatten(0, 1), temperature),
        }
        yield {"tau": temperature, **{name: v.mean().item() for name, v in values.items()}}


def study(cfg: BeyondConfig, run_dir: Path) -> None:
    """Trains once for each combination and seed; writes and prints the two tables."""
    torch.set_num_threads(cfg.num_threads)
    torchrl_logger.setLevel("WARNING")  # its notes about storages would break the progress bar
    guidance, soft = [], []
    for index, (changed, variant) in enumerate(tqdm(variants(cfg), unit="combination")):
        for seed in cfg.seeds:
            actor = train_auto(variant, seed)
            guidance.append({**changed, "seed": seed, **guidance_row(variant, actor)})
            if index == 0:
                soft += [{"seed": seed, **row} for row in soft_rows(variant, actor)]
    for name, rows in (("guidance", guidance), ("soft", soft)):
        tables.write_csv(run_dir / f"{name}.csv", rows)
        print(tables.as_text(rows), end="\n\n")


@hydra.main(version_base="1.3", config_path="configs", config_name="bandit_beyond")
def main(composed: DictConfig) -> None:
    """Runs the study."""
    launch(composed, BeyondConfig, "bandit_beyond", study)


if __name__ == "__main__":
    main()
