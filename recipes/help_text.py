"""Imported by the commands: `--help` shows their configuration as it is written, with comments."""

from __future__ import annotations

from pathlib import Path

from omegaconf import OmegaConf

CONFIGS = Path(__file__).resolve().parent / "configs"


def commented(*names: str) -> str:
    """The text of files in `configs`, for a template of Hydra's help, where "$" has a meaning."""
    files = [CONFIGS / f"{name}.yaml" for name in dict.fromkeys(names)]
    return "\n".join(f"# --- {file.name}\n{file.read_text()}" for file in files).replace("$", "$$")


OmegaConf.register_new_resolver("commented", commented, replace=True)
