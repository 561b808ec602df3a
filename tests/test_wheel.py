"""What an installed package brings: every module, the recipes' configuration, its commands."""

from __future__ import annotations

import os
import subprocess
import sys
from importlib import import_module
from pathlib import Path

import pytest

from test_packaging import ROOT, tomllib

PYPROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())
SETUPTOOLS = PYPROJECT["tool"]["setuptools"]
RECIPES = ROOT / SETUPTOOLS["package-dir"]["torchrl_aca_recipes"]


def package_of(folder: Path) -> str:
    parts = folder.relative_to(ROOT).parts
    return ".".join(("torchrl_aca_recipes", *parts[1:]) if parts[0] == RECIPES.name else parts)


def test_every_folder_with_code_is_a_package_of_the_wheel():
    folders = {
        file.parent for top in ("torchrl_aca", RECIPES.name) for file in (ROOT / top).rglob("*.py")
    }
    assert {package_of(folder) for folder in folders} == set(SETUPTOOLS["packages"])


def test_every_configuration_is_in_the_wheel():
    globs = SETUPTOOLS["package-data"]["torchrl_aca_recipes"]
    packed = {file for glob in globs for file in RECIPES.glob(glob)}
    assert packed == set(RECIPES.rglob("*.yaml"))


@pytest.mark.parametrize("command", PYPROJECT["project"]["scripts"])
def test_each_command_runs_a_script_of_the_recipes(command, monkeypatch):
    module, _, function = PYPROJECT["project"]["scripts"][command].partition(":")
    entry_points = import_module(module.rpartition(".")[2])
    ran = []
    monkeypatch.setattr(entry_points.os, "execv", lambda program, arguments: ran.extend(arguments))
    monkeypatch.setattr(sys, "argv", [command, "seed=1"])
    getattr(entry_points, function)()
    assert ran[0] == sys.executable and ran[2:] == ["seed=1"]
    assert Path(ran[1]).parent == RECIPES and Path(ran[1]).is_file()


def test_an_installed_command_finds_its_configuration(tmp_path):
    (tmp_path / "torchrl_aca_recipes").symlink_to(RECIPES)
    code = "from torchrl_aca_recipes.entry_points import train; train()"
    done = subprocess.run(
        [sys.executable, "-c", code, "env=hopper", "--cfg", "job", "--package", "env"],
        cwd=tmp_path,
        env={**os.environ, "PYTHONPATH": f"{tmp_path}{os.pathsep}{ROOT}"},
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    assert "name: Hopper-v4" in done.stdout
