"""Imported by the commands: what their configuration files call, for `--help` and for directories.

`--help` shows the configuration as it is written, with comments.
"""

from __future__ import annotations

import hashlib
from pathlib import Path

from omegaconf import OmegaConf

CONFIGS = Path(__file__).resolve().parent / "configs"


def commented(*names: str) -> str:
    """The text of files in `configs`, for a template of Hydra's help, where "$" has a meaning."""
    files = [CONFIGS / f"{name}.yaml" for name in dict.fromkeys(names)]
    return "\n".join(f"# --- {file.name}\n{file.read_text()}" for file in files).replace("$", "$$")


def file_name(text: str) -> str:
    """A name for a directory: the two ends of a long text, and a number that tells it apart."""
    content = text.encode()
    if len(content) <= 250:  # file systems take 255 bytes
        return text
    start, end = (part.decode(errors="ignore") for part in (content[:120], content[-100:]))
    return f"{start}-{hashlib.sha256(content).hexdigest()[:12]}-{end}"


OmegaConf.register_new_resolver("commented", commented, replace=True)
OmegaConf.register_new_resolver("file_name", file_name, replace=True)
