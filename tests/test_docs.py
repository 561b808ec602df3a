"""Promises of README and docs: code runs, links lead somewhere, commands and names are real."""

from __future__ import annotations

import csv
import doctest
import importlib
import pkgutil
import re
import shlex
import subprocess
import sys
from functools import cache
from pathlib import Path

import pytest
import torch
import yaml
from hydra import compose, initialize_config_dir
from omegaconf import DictConfig, OmegaConf
from tensordict import TensorDict
from torchrl.objectives import SoftUpdate

import torchrl_aca
from agents import AGENTS, without_methods
from online_mujoco import train
from recipe_cases import TINY_SIZES

ROOT = Path(__file__).parents[1]
DOCS = ROOT / "docs"
CONFIGS = ROOT / "recipes" / "configs"
PAGES = [ROOT / "README.md", *(p for p in sorted(DOCS.rglob("*.md")) if "_build" not in p.parts)]
BLOCK = re.compile(r"(?:<!-- needs: (\S+) -->\n)?^```python(.*)\n((?:.*\n)*?)^```$", re.MULTILINE)
RECIPES = "online_mujoco|o2o_halfcheetah|evaluate|make_dataset|import_dataset|study"
COMMAND = re.compile(rf"python recipes/({RECIPES})\.py((?:\\\n|[^\n`#])*)")


def name_of(page: Path) -> str:
    return str(page.relative_to(ROOT))


def blocks(page: Path):
    """(line, module that it needs or "", code) of each Python block."""
    text = page.read_text()
    for match in BLOCK.finditer(text):
        needs, mark, code = match.groups()
        assert not mark, f"{name_of(page)}: a block marked {mark!r} would not be run"
        yield text[: match.start(3)].count("\n"), needs, code


# --- code -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("page", [p for p in PAGES if any(blocks(p))], ids=name_of)
def test_blocks_run_in_order(page, tmp_path, monkeypatch, request):
    monkeypatch.chdir(tmp_path)
    if 'load_policy("runs/' in page.read_text():
        (tmp_path / "runs").symlink_to(request.getfixturevalue("runs")["aca"].parent)
    namespace = {"__name__": "__docs__"}
    left_out = []
    for line, needs, code in blocks(page):
        if needs and not can_import(needs):
            left_out.append(f"block at line {line} needs {needs}, which does not load here")
            continue
        # The line numbers of an error are those of the page.
        exec(compile("\n" * line + code, name_of(page), "exec"), namespace)
    if left_out:
        pytest.skip("all other blocks ran; " + "; ".join(left_out))


def can_import(module: str) -> bool:
    try:
        importlib.import_module(module)
    except ImportError:
        return False
    return True


def docstrings() -> list[doctest.DocTest]:
    names = [m.name for m in pkgutil.walk_packages(torchrl_aca.__path__, "torchrl_aca.")]
    finder = doctest.DocTestFinder(exclude_empty=True)
    modules = map(importlib.import_module, names)
    return [test for module in modules for test in finder.find(module) if test.examples]


@pytest.mark.parametrize("example", docstrings(), ids=lambda example: example.name)
def test_docstring_examples(example):
    draws = {"observation": torch.zeros(4, 3), "action": torch.zeros(4, 2)}
    flags = {key: torch.zeros(4, 1, dtype=torch.bool) for key in ("done", "terminated")}
    following = {"observation": torch.zeros(4, 3), "reward": torch.zeros(4, 1), **flags}
    data = TensorDict({**draws, "next": following}, batch_size=[4])
    public = {name: getattr(torchrl_aca, name) for name in torchrl_aca.__all__}
    known = {"torch": torch, "TensorDict": TensorDict, "SoftUpdate": SoftUpdate, "data": data}
    example.globs.update(**public, **known)
    assert doctest.DocTestRunner().run(example).failed == 0


# --- links, tests and commands that pages name ----------------------------------------------------


@pytest.mark.parametrize("page", PAGES, ids=name_of)
def test_relative_links_lead_to_files(page):
    text = re.sub(r"```.*?```", "", page.read_text(), flags=re.DOTALL)
    links = re.findall(r"\]\(([^)\s]+)\)|src=\"([^\"]+)\"", text)
    targets = [(a or b).split("#")[0] for a, b in links]
    relative = [t for t in targets if t and not re.match(r"[a-z]+:", t)]
    assert [t for t in relative if not (page.parent / t).exists()] == []


@pytest.mark.parametrize("page", PAGES, ids=name_of)
def test_named_tests_exist(page):
    for file, test in re.findall(r"(tests/\w+\.py)::(\w+)", page.read_text()):
        assert re.search(rf"^def {test}\(", (ROOT / file).read_text(), re.MULTILINE), (file, test)


def commands():
    for page in PAGES:
        for match in COMMAND.finditer(page.read_text()):
            recipe, arguments = match.groups()
            yield page, recipe, shlex.split(arguments.replace("\\\n", " "))


@pytest.mark.parametrize(
    ("name", "arguments"),
    [pytest.param(r, a, id=f"{name_of(p)}: {r} {' '.join(a)}") for p, r, a in commands()],
)
def test_commands_compose(name, arguments):
    if "--config-name" in arguments:
        at = arguments.index("--config-name")
        name = arguments[at + 1]
        del arguments[at : at + 2]
    if "--multirun" in arguments:  # the first of its jobs
        arguments = [a.partition(",")[0] for a in arguments if a != "--multirun"]
    overrides = [a for a in arguments if "<" not in a and "..." not in a and a != "--help"]
    assert composed(*overrides, name=name)


# --- names ----------------------------------------------------------------------------------------


@cache
def composed(*overrides: str, name: str = "online_mujoco") -> DictConfig:
    with initialize_config_dir(str(CONFIGS), version_base="1.3"):
        return compose(name, overrides=list(overrides))


def flat(node: DictConfig, prefix: str = "") -> dict[str, object]:
    out = {}
    for key, value in node.items():
        name = f"{prefix}{key}"
        out.update(flat(value, f"{name}.") if isinstance(value, DictConfig) else {name: value})
    return out


def table_rows(page: str, section: str = "") -> list[list[str]]:
    text = (DOCS / page).read_text()
    if section:
        text = re.split(rf"^##+ {re.escape(section)}$", text, flags=re.MULTILINE)[1]
        text = re.split("^##+ ", text, flags=re.MULTILINE)[0]
    lines = [line for line in text.splitlines() if line.startswith("| `")]
    return [[cell.strip() for cell in line.strip("|").split(" | ")] for line in lines]


def test_config_page_has_every_key_with_its_default():
    names = [*dict.fromkeys(["aca", "sac", "rlpd", *AGENTS])]  # the page's order
    files = {file.stem for file in (CONFIGS / "algo").glob("*.yaml")}
    assert files == {*names, "rlpd_wsrl"}  # which is a variant of RLPD
    configs = [flat(composed(f"algo={name}")) for name in names]
    documented: dict[str, list[object]] = {}
    for key, default, *_ in table_rows("config.md"):
        documented.setdefault(key.strip("`"), []).append(yaml.safe_load(default.strip("`")))
    assert documented.keys() == set().union(*configs)
    for key, values in documented.items():
        configured = [plain(config[key]) for config in configs if key in config]
        assert all(value in configured for value in values), (key, values, configured)
        assert configured[0] == values[0], (key, values, configured)


def documented(section: str) -> dict[str, object]:
    rows = table_rows("config_offline.md", section)
    return {key.strip("`"): yaml.safe_load(default.strip("`")) for key, default, *_ in rows}


def different(config: DictConfig, base: DictConfig) -> dict[str, object]:
    usual = flat(base)
    return {
        key: plain(value)
        for key, value in flat(config).items()
        if key not in usual or value != usual[key]
    }


def test_offline_config_page_has_every_key_with_its_default():
    o2o = different(composed(name="o2o_halfcheetah"), composed())
    assert documented("`o2o_halfcheetah.py`") == o2o
    sac = different(composed(name="dataset_sac"), composed("algo=sac"))
    assert documented("The SAC run behind `medium` and `medium_replay`") == sac
    # A task's file may hold settings of other methods than the SAC that makes the data.
    own = without_methods(composed("tier=random", name="make_dataset"), ["sac"])
    generator = {key: plain(value) for key, value in flat(own).items()}
    assert documented("`make_dataset.py`") == {**generator, "tier": "???"}
    required = ["source=x", "format=d4rl", "path=y"]
    importer = {k: plain(v) for k, v in flat(composed(*required, name="import_dataset")).items()}
    unset = dict.fromkeys(("source", "format", "path"), "???")
    assert documented("`import_dataset.py`") == {**importer, **unset}


def test_the_page_of_evaluate_has_every_key_with_its_default():
    keys = {key: plain(value) for key, value in flat(composed("run=x", name="evaluate")).items()}
    rows = table_rows("howto/use_policy.md")
    told = {key.strip("`"): yaml.safe_load(default.strip("`")) for key, default, *_ in rows}
    assert told == {**keys, "run": "???"}


@pytest.mark.parametrize(
    ("section", "algo", "variant"),
    [
        ("DACER", "dacer", "dacer_sdac_repo"),
        ("DIPO", "dipo", "dipo_sdac_repo"),
        ("RLPD", "rlpd", "wsrl"),
        ("QSM", "qsm", "qsm_authors"),
        ("QVPO", "qvpo", "qvpo_sdac_repo"),
    ],
)
def test_config_page_has_both_variants(section, algo, variant):
    variants = flat(composed(f"algo={algo}")), flat(composed(f"algo={algo}", f"variant={variant}"))
    rows = {key.strip("`"): values for key, *values, _ in table_rows("config.md", section)}
    assert rows
    differing = {key for key, value in variants[0].items() if value != variants[1][key]}
    assert differing - {"variant.name"} <= rows.keys()
    for key, values in rows.items():
        documented = [yaml.safe_load(value.strip("`")) for value in values]
        assert documented == [plain(variant[key]) for variant in variants], key


def plain(value: object) -> object:
    return OmegaConf.to_container(value) if OmegaConf.is_config(value) else value


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    """Directories of tiny runs, by algorithm."""
    folder = tmp_path_factory.mktemp("runs")
    sizes = {name: TINY_SIZES[name] for name in AGENTS}
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        return {
            algorithm: train(
                composed(
                    f"algo={algorithm}",
                    "env=reacher",
                    f"run_dir={folder / algorithm}",
                    "collector.warmup_frames=250",
                    "optim.batch_size=8",
                    "optim.total_updates=2",
                    "logger.interval=1",
                    "eval.episodes=1",
                    *overrides,
                )
            )
            for algorithm, overrides in sizes.items()
        }


def test_metrics_page_has_exactly_what_is_written(runs):
    critic = torchrl_aca.NoiseLevelCritic(3, 2, num_cells=(8,))
    actor = torchrl_aca.CriticGuidedDenoisingActor(critic, torchrl_aca.NoiseSchedule.cosine(20))
    loss = torchrl_aca.ACALoss(actor)
    written = {*loss.out_keys, loss.tensor_keys.priority}
    tuned = torchrl_aca.ACALoss(actor, guidance_weight="auto")
    following = TensorDict(observation=torch.zeros(2, 3), batch_size=[2])
    data = TensorDict(action=torch.zeros(2, 2), next=following, batch_size=[2])
    tuned.sample_next_action(data)
    written |= set(tuned.step_guidance_weight(data).keys())
    for run_dir in runs.values():
        for table in ("metrics.csv", "eval.csv"):
            with open(run_dir / table, newline="") as file:
                written |= set(csv.DictReader(file).fieldnames)
    assert written == {row[0].strip("`") for row in table_rows("howto/metrics.md")}


def test_a_run_leaves_the_files_and_the_state_that_the_pages_name(runs):
    named = {row[0].strip("`") for row in table_rows("quickstart.md")}
    assert {path.name for path in runs["aca"].iterdir()} == {name.rstrip("/") for name in named}
    (checkpoint,) = (runs["aca"] / "checkpoints").glob("checkpoint_*.pt")
    assert "agent.loss" in torch.load(checkpoint, weights_only=True)["parts"]


def test_every_method_has_a_page_with_its_command():
    pages = {path.stem for path in (DOCS / "methods").glob("*.md")}
    assert pages == set(AGENTS)
    for name in AGENTS:
        text = (DOCS / "methods" / f"{name}.md").read_text()
        assert f"algo={name}" in text and "arameters on Humanoid-v4" in text, name
        assert {"## Differences", "## Results"} <= set(text.splitlines()), name
        assert f"methods/{name}" in (DOCS / "index.md").read_text()


def test_formulas_need_no_network(tmp_path):
    """A script that has to be fetched would leave raw TeX on the page without a network."""
    pytest.importorskip("sphinx")
    source, built = tmp_path / "source", tmp_path / "html"
    source.mkdir()
    (source / "index.md").write_text("# A page\n\nAn action $a_0$.\n")
    call = [sys.executable, "-m", "sphinx", "-q", "-W", "-c", str(DOCS), str(source), str(built)]
    subprocess.run(call, check=True)
    scripts = re.findall(r'<script[^>]* src="([^"?]+)', (built / "index.html").read_text())
    assert any("mathjax" in script for script in scripts)
    assert [script for script in scripts if not (built / script).is_file()] == []


def test_commands_of_benchmarks_find_the_recipes():
    for page in [*PAGES, *sorted((ROOT / "results").glob("*.md"))]:
        for before, script in re.findall(r"(\S*) ?python benchmarks/(\w+\.py)", page.read_text()):
            assert (ROOT / "benchmarks" / script).exists()
            assert before.lstrip("`(") == "PYTHONPATH=recipes", f"{name_of(page)}: {script}"
