"""The notebook: its cells run one after the other, with few updates; no outputs are committed."""

from __future__ import annotations

import json
from pathlib import Path

import matplotlib

NOTEBOOK = Path(__file__).parents[1] / "notebooks" / "aca_in_five_minutes.ipynb"
CELLS = json.loads(NOTEBOOK.read_text())["cells"]


def test_the_cells_run_in_order(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    matplotlib.use("agg")
    code = "\n".join("".join(cell["source"]) for cell in CELLS if cell["cell_type"] == "code")
    assert code.count("UPDATES = 2000") == 1
    names = {"__name__": "__notebook__"}
    exec(compile(code.replace("UPDATES = 2000", "UPDATES = 12"), NOTEBOOK.name, "exec"), names)
    assert [updates for updates, _ in names["curve"]] == [0, 2, 4, 6, 8, 10, 12]
    assert names["values"].shape == (21, 101)  # levels, forces
    assert names["path"].shape == (21, 32, 1, 1) and names["path"][-1].abs().max() <= 1
    names["film"].save(tmp_path / "film.gif", writer="pillow", dpi=20)
    assert (tmp_path / "film.gif").stat().st_size > 0


def test_it_is_committed_without_outputs():
    assert all(not cell.get("outputs") for cell in CELLS)
