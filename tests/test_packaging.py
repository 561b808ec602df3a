"""Promises of the package as a whole: what it needs, who imports whom, which versions it names."""

from __future__ import annotations

import ast
import re
import subprocess
import sys
from importlib.util import resolve_name
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

import torchrl_aca

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

ROOT = Path(__file__).parents[1]
PACKAGE = "torchrl_aca"
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]

# What each module of the core may import from the package.
ALLOWED = {
    "activations": set(),
    "functional": set(),
    "checks": set(),
    "errors": set(),
    "stacked": set(),
    "exact": set(),
    "schedule": {"checks", "exact", "functional"},
    "chain": {"checks", "functional", "schedule"},
    "chain_policy": {"checks", "chain"},
    "critic": {"activations", "checks", "functional", "stacked"},
    "custom_critic": {"checks", "functional", "critic"},
    "actor": {
        "checks",
        "functional",
        "schedule",
        "chain",
        "chain_policy",
        "critic",
        "custom_critic",
        "exact",
    },
    "langevin_actor": {"checks", "schedule", "chain", "critic", "actor"},
    "td_loss": {"checks", "functional"},
    "tuning": {"checks", "functional"},
    "loss": {
        "checks",
        "functional",
        "schedule",
        "chain",
        "critic",
        "custom_critic",
        "actor",
        "td_loss",
        "tuning",
    },
    "interop": {"functional", "critic"},
    "trainer": {"checks"},
    "make": {"checks", "schedule", "critic", "actor", "loss"},
}
# What each room may import besides itself.
ROOMS = {
    "baselines": {
        "activations",
        "checks",
        "functional",
        "stacked",
        "schedule",
        "chain",
        "chain_policy",
        "td_loss",
        "tuning",
    },
    "replay": {"checks", "errors"},
    "offline": {"checks", "errors", "replay"},
    "training": {"checks", "errors", "replay"},
}
OPTIONAL = [
    "gymnasium",
    "h5py",
    "hydra",
    "imageio",
    "matplotlib",
    "minari",
    "omegaconf",
    "pydantic",
    "ray",
    "scipy",
    "tensorboard",
    "tqdm",
    "wandb",
]


def test_core_imports_without_the_extras() -> None:
    """Hides the extras from the import system, as if they had never been installed."""
    script = f"""
import sys
from importlib.machinery import PathFinder

find_spec = PathFinder.find_spec
def find_installed(name, path=None, target=None):
    return None if name.partition(".")[0] in {OPTIONAL} else find_spec(name, path, target)
PathFinder.find_spec = find_installed

try:
    import gymnasium
except ModuleNotFoundError:
    import {PACKAGE}, {PACKAGE}.baselines, {PACKAGE}.offline, {PACKAGE}.replay
    assert {PACKAGE}.__all__
else:
    sys.exit("the extras were not hidden")
"""
    run = subprocess.run([sys.executable, "-c", script], cwd=ROOT, capture_output=True, text=True)
    assert run.returncode == 0, run.stderr


def imported_modules(path: Path) -> set[str]:
    """Absolute dotted names of everything that a file imports, in whatever scope."""
    package = ".".join(path.relative_to(ROOT).parent.parts)
    names: set[str] = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            names.update(alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            base = resolve_name("." * node.level + (node.module or ""), package)
            names.update(f"{base}.{alias.name}" for alias in node.names)
    return names


def imported_parts(path: Path) -> set[str]:
    """The parts of the package that a file imports: `torchrl_aca.actor.X` counts as `actor`."""
    names = (name.split(".") for name in imported_modules(path))
    return {name[1] if len(name) > 1 else "" for name in names if name[0] == PACKAGE}


@pytest.mark.parametrize("module", ALLOWED)
def test_core_imports_point_one_way(module: str) -> None:
    forbidden = imported_parts(ROOT / PACKAGE / f"{module}.py") - ALLOWED[module]
    assert not forbidden, f"{module}.py imports {sorted(forbidden)}"


def test_init_exposes_the_core_alone() -> None:
    assert imported_parts(ROOT / PACKAGE / "__init__.py") <= set(ALLOWED)


def test_every_core_file_has_a_rule() -> None:
    files = {path.stem for path in (ROOT / PACKAGE).glob("*.py")}
    assert files == {*ALLOWED, "__init__"}


@pytest.mark.parametrize("room", ROOMS)
def test_rooms_stand_where_the_design_has_them(room: str) -> None:
    files = sorted((ROOT / PACKAGE / room).rglob("*.py"))
    assert len(files) > 1
    for path in files:
        assert imported_parts(path) <= ROOMS[room] | {room}, path.name


def test_every_room_has_a_rule() -> None:
    rooms = {path.name for path in (ROOT / PACKAGE).iterdir() if (path / "__init__.py").exists()}
    assert rooms == set(ROOMS)


def test_no_script_imports_a_script() -> None:
    files = (ROOT / "recipes").glob("*.py")
    scripts = {file.stem for file in files if "__main__" in file.read_text()}
    assert len(scripts) > 4
    for path in (ROOT / "recipes").rglob("*.py"):
        imported = {name.split(".")[0] for name in imported_modules(path)}
        assert not imported & scripts, path


def test_nothing_patches_the_search_path() -> None:
    here = Path(__file__)
    for folder in ("tests", "benchmarks", "recipes"):
        for path in (ROOT / folder).rglob("*.py"):
            if path != here:
                assert not re.search(r"sys\.path|syspath", path.read_text()), path


def test_package_never_imports_recipes() -> None:
    for path in (ROOT / PACKAGE).rglob("*.py"):
        assert not any(name.split(".")[0] == "recipes" for name in imported_modules(path)), path


def pins() -> dict[str, str]:
    """The exact version that constraints.txt gives for each distribution."""
    lines = (ROOT / "constraints.txt").read_text().splitlines()
    pairs = (line.split("==") for line in lines if line and not line.startswith("#"))
    return {canonicalize_name(name): version for name, version in pairs}


EXTRAS = PROJECT["optional-dependencies"]
PINNED_EXTRAS = ("recipes", "offline", "docs", "dev")
REQUIREMENTS = [
    requirement
    for group in (PROJECT["dependencies"], *(EXTRAS[extra] for extra in PINNED_EXTRAS))
    for requirement in map(Requirement, group)
    # The pins are those of Python 3.11: what only older versions need has none.
    if requirement.marker is None or requirement.marker.evaluate({"python_version": "3.11"})
]


@pytest.mark.parametrize("requirement", REQUIREMENTS, ids=str)
def test_direct_dependency_is_pinned_within_its_range(requirement: Requirement) -> None:
    pin = pins()[canonicalize_name(requirement.name)]
    assert requirement.specifier.contains(pin, prereleases=True)


def test_extra_all_names_every_extra_that_goes_with_the_others() -> None:
    (everything,) = EXTRAS["all"]
    assert Requirement(everything).extras == set(EXTRAS) - {"all", "dmc"}


def test_citation_names_this_version() -> None:
    citation = (ROOT / "CITATION.cff").read_text()
    assert re.findall(r"^version: (.+)$", citation, re.M) == [torchrl_aca.__version__]
