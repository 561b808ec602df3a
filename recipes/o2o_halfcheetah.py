"""Online learning with offline data on MuJoCo: section 4.2 of the ACA paper.

    python recipes/o2o_halfcheetah.py dataset=datasets/halfcheetah-medium_replay algo=aca seed=1
    python recipes/o2o_halfcheetah.py dataset=datasets/halfcheetah-medium_replay algo=rlpd utd=20
    python recipes/o2o_halfcheetah.py dataset=datasets/halfcheetah-medium_replay algo=wsrl
    python recipes/o2o_halfcheetah.py --config-name o2o_quickstart
    python recipes/o2o_halfcheetah.py resume=runs/<directory>

Each minibatch of the online phase is partly from a fixed data set. A run has up to three phases: an
offline one on the data set alone, which ACA and RLPD do not have, a warm-up without updates, and an
online one. `pretrained=RUN_DIR` takes the first from another run. Every key is in
`configs/o2o_halfcheetah.yaml`, what each method does in `configs/phases/`.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import hydra
from omegaconf import DictConfig

import renderer  # noqa: F401
import resolvers  # noqa: F401
from agents import configured, make_agent
from agents.pretrained import require_offline_phase, start_from
from data.config import OfflineToOnlineConfig
from data.offline import (
    generate_missing,
    load_offline_data,
    make_mixture,
    offline_facts,
    task_scores,
)
from torchrl_aca.offline.scores import normalized_score
from torchrl_aca.training.acceleration import capture
from torchrl_aca.training.envs import make_vector_env
from torchrl_aca.training.evaluation import evaluate, make_eval_env, report_extras
from torchrl_aca.training.launch import launch, make_device
from torchrl_aca.training.logging import require_wandb_login
from torchrl_aca.training.randomness import seed_everything
from torchrl_aca.training.run import Run
from torchrl_aca.training.workers import make_collection


def train(cfg: DictConfig, checkpoint: dict[str, Any] | None = None) -> Path:
    """Trains one agent, from the start or from a checkpoint, and returns the run directory."""
    cfg = configured(cfg, OfflineToOnlineConfig)
    require_wandb_login(cfg.logger)
    generate_missing(cfg)
    device = make_device(cfg)
    seed_everything(cfg.seed)

    env = make_vector_env(cfg.env, cfg.collector.num_envs, cfg.seed)
    eval_env = make_eval_env(cfg.env, cfg.eval)
    agent = make_agent(cfg, env, device)
    require_offline_phase(cfg, agent)
    dataset, scores = load_offline_data(cfg, env), task_scores(cfg)
    buffer = make_mixture(cfg, dataset, agent)
    collection = make_collection(cfg, env, agent.policy, device)
    facts = {
        **offline_facts(dataset, buffer),
        "updates per online frame": f"{cfg.optim.utd_ratio:g}",
    }

    pretrained = 0
    if cfg.pretrained is not None and checkpoint is None:
        pretrained = cfg.optim.offline_updates = start_from(cfg, agent, facts)

    evaluated = capture(agent.policy, cfg.cudagraphs)

    def evaluation(watch: Callable[[int], None]) -> dict[str, float]:
        result = evaluate(evaluated, eval_env, cfg.eval.seed, device, watch)
        if scores:
            result["normalized_score"] = normalized_score(result["return_mean"], scores)
        return result

    with Run(
        cfg,
        agent,
        buffer,
        collection,
        evaluation,
        checkpoint,
        device=device,
        script=__file__,
        facts=facts,
        pretrained=pretrained,
    ) as run:
        buffer.offline_fraction = 1.0
        for batch in run.offline_phase(buffer):
            run.add(agent.offline_update(batch))
        buffer.offline_fraction = cfg.offline_fraction
        for data in collection:  # of shape (num_envs, steps)
            if len(rows := agent.rows_of(data)):
                buffer.extend(rows)
            for batch in run.due(buffer):
                run.add(agent.update(batch))
            if run.end_iteration():
                break
    if run.completed:
        report_extras(cfg, run.dir, agent.policy, eval_env, device)
    return run.dir


@hydra.main(version_base="1.3", config_path="configs", config_name="o2o_halfcheetah")
def main(cfg: DictConfig) -> None:
    launch(train, cfg)


if __name__ == "__main__":
    main()
