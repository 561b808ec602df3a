"""The algorithms that the recipes can train, by name, and what their configurations hold."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass
from typing import Any, TypeVar

import torch
from omegaconf import DictConfig, OmegaConf
from pydantic import create_model
from torchrl.envs import EnvBase

from agents.aca import ACAOptim, ACASettings, make_aca
from agents.cql import (
    CalQLSettings,
    CQLOptim,
    CQLSettings,
    WSRLSettings,
    make_calql,
    make_cql,
    make_wsrl,
)
from agents.dacer import DACEROptim, DACERSettings, make_dacer
from agents.diffusion import DiffusionOptim
from agents.dipo import DIPOOptim, DIPOSettings, make_dipo
from agents.iql import IQLOptim, IQLSettings, make_iql
from agents.nclql import NCLQLOptim, NCLQLSettings, make_nclql
from agents.qsm import QSMSettings, make_qsm
from agents.qvpo import QVPOSettings, make_qvpo
from agents.rlpd import RLPDOptim, RLPDSettings, make_rlpd
from agents.sac import SACOptim, SACSettings, make_sac
from agents.sdac import SDACOptim, SDACSettings, make_sdac
from agents.variant import Variant
from torchrl_aca.errors import RunError
from torchrl_aca.training.agent import Agent
from torchrl_aca.training.config import RunConfig, Section, checked


@dataclass(frozen=True)
class Method:
    """An algorithm.

    Attributes:
        make: Builds the agent from a typed configuration, an environment and a device.
        sections: The sections of a configuration that are the method's own, by name.
        starts_from: Other methods with the same offline phase, whose runs it can go on from.
        mixes: Whether its minibatches may hold rows of a data set.
    """

    make: Callable[[Any, EnvBase, torch.device], Agent]
    sections: Mapping[str, type[Section]]
    starts_from: tuple[str, ...] = ()
    mixes: bool = True


AGENTS = {
    "aca": Method(make_aca, {"aca": ACASettings, "optim": ACAOptim}),
    "dacer": Method(make_dacer, {"dacer": DACERSettings, "variant": Variant, "optim": DACEROptim}),
    "dipo": Method(
        make_dipo, {"dipo": DIPOSettings, "variant": Variant, "optim": DIPOOptim}, mixes=False
    ),
    "nclql": Method(make_nclql, {"nclql": NCLQLSettings, "optim": NCLQLOptim}),
    "qsm": Method(make_qsm, {"qsm": QSMSettings, "variant": Variant, "optim": DiffusionOptim}),
    "qvpo": Method(make_qvpo, {"qvpo": QVPOSettings, "variant": Variant, "optim": DiffusionOptim}),
    "rlpd": Method(make_rlpd, {"rlpd": RLPDSettings, "variant": Variant, "optim": RLPDOptim}),
    "sac": Method(make_sac, {"sac": SACSettings, "optim": SACOptim}),
    "sdac": Method(make_sdac, {"sdac": SDACSettings, "optim": SDACOptim}),
    "cql": Method(make_cql, {"cql": CQLSettings, "optim": CQLOptim}, ("wsrl",)),
    "calql": Method(make_calql, {"cql": CQLSettings, "calql": CalQLSettings, "optim": CQLOptim}),
    "wsrl": Method(
        make_wsrl, {"cql": CQLSettings, "wsrl": WSRLSettings, "optim": CQLOptim}, ("cql",)
    ),
    "iql": Method(make_iql, {"iql": IQLSettings, "optim": IQLOptim}),
}

Recipe = TypeVar("Recipe", bound=RunConfig)


def configured(cfg: DictConfig, recipe: type[Recipe] = RunConfig) -> Recipe:
    """Returns a composed configuration, checked against the recipe's schema and the method's.

    Raises:
        RunError: Naming each wrong key, what was expected and what was got.
    """
    name = OmegaConf.select(cfg, "algo.name")
    if name not in AGENTS:
        known = sorted(AGENTS)
        raise RunError(f"algo.name={name!r}: expected one of {known}. Set it with algo=... .")
    sections = AGENTS[name].sections
    if missing := sections.keys() - cfg.keys():
        raise RunError(
            f"algo.name={name}: the configuration has no section {sorted(missing)[0]!r}. Choose "
            f"the method with algo={name}, which brings its settings along."
        )
    fields: dict[str, Any] = {key: (schema, ...) for key, schema in sections.items()}
    schema = create_model(recipe.__name__, __base__=recipe, **fields)
    return checked(schema, without_methods(cfg, sections))


def without_methods(cfg: DictConfig, kept: Collection[str] = ()) -> DictConfig:
    """Returns a configuration without the methods' sections, but for those in `kept`.

    A task's file may hold settings of a method that is not the one that is trained.
    """
    others = {key for method in AGENTS.values() for key in method.sections} - set(kept)
    return OmegaConf.masked_copy(cfg, [key for key in cfg if key not in others])


def make_agent(cfg: RunConfig, env: EnvBase, device: torch.device) -> Agent:
    """Builds the agent; a value that one of its parts refuses is told in one message."""
    try:
        return AGENTS[cfg.algo.name].make(cfg, env, device)
    except ValueError as error:
        raise RunError(f"algo={cfg.algo.name} cannot be built: {error}") from error
