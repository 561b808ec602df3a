"""The commands of an installed package: each runs a script of this folder, as it stands."""

from __future__ import annotations

import os
import sys
from pathlib import Path

FOLDER = Path(__file__).resolve().parent


def train() -> None:
    _run("online_mujoco.py")


def train_offline_to_online() -> None:
    _run("o2o_halfcheetah.py")


def evaluate() -> None:
    _run("evaluate.py")


def study() -> None:
    _run("study.py")


def make_dataset() -> None:
    _run("make_dataset.py")


def import_dataset() -> None:
    _run("import_dataset.py")


def bandit() -> None:
    _run("bandit_2d.py")


def _run(script: str) -> None:
    """Goes on as the script: the same process, with its signals and its exit status."""
    os.execv(sys.executable, [sys.executable, str(FOLDER / script), *sys.argv[1:]])
