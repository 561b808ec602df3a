"""Methods of which there is more than one reading."""

from __future__ import annotations

from torchrl_aca.training.config import Section


class Variant(Section):
    """The section `variant`: whose code the settings are from."""

    name: str
