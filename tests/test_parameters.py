"""Parameter counts: the numbers of the paper's table, and the page that shows them."""

from __future__ import annotations

from pathlib import Path

import pytest

from agents import AGENTS
from parameters import PAPER, main, table

PAGE = Path(__file__).parents[1] / "docs" / "rivals.md"


@pytest.fixture(scope="module")
def rows() -> dict[str, list[str]]:
    """The cells of each method's row."""
    lines = [line.strip("|").split("|") for line in table("humanoid").splitlines()[2:]]
    return {name.strip(): [cell.strip() for cell in cells] for name, *cells in lines}


def test_an_unknown_task_is_told(monkeypatch, capsys):
    monkeypatch.setattr("sys.argv", ["parameters.py", "nosuch"])
    with pytest.raises(SystemExit):
        main()
    assert "invalid choice: 'nosuch'" in capsys.readouterr().err


def test_every_ratio_of_the_papers_table_is_reproduced(rows):
    assert rows.keys() == set(AGENTS)
    compared = [name for name in rows if name in PAPER]
    assert {"aca", "qsm", "qvpo", "sac", "sdac"} <= set(compared)
    for name in compared:
        assert rows[name][1] == rows[name][2] == f"{PAPER[name]:.3f}"


def test_with_targets_the_advantage_shrinks(rows):
    held = {name: int(cells[3].replace(",", "")) for name, cells in rows.items()}
    assert held["sac"] == 702_244 + 2 * 232_705 and held["sdac"] == 2 * 707_395
    assert held["aca"] == 2 * 475_746 and rows["aca"][4] == "0.815"


def test_the_page_shows_what_the_command_prints():
    text = PAGE.read_text()
    assert all(line in text for line in table("humanoid").splitlines())
