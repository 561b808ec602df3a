"""Table of a benchmark run: `python benchmarks/report.py BENCHMARK.json results/speed.md`."""

from __future__ import annotations

import json
import sys
from pathlib import Path

from torchrl_aca.training.report import versions

HEADER = """# Speed

Written by `make bench`. Medians of one run; compare ratios, not times of different machines.

- *yardstick*: two plain MLPs on concatenated inputs, `torch.autograd.grad` of the sum, all rows at
  once (`benchmarks/yardstick.py`). *eager*, *compiled*: this package, `compile_step=False` and
  `True`.
- *yardstick / this*: how many times as fast as the yardstick in the same run.
- *of roofline*: matrix products of the chain, per second, over what a bare matrix product of as
  many rows as this package takes at once does in the same run, where one was timed. It counts the
  arithmetic that a chain needs, so an update, which also has two optimiser steps, cannot reach it.
  The last step of a chain needs none.
- *iteration*: five environments make a step and the recipe makes an update.

"""


def table(results: list[dict]) -> str:
    """One row per case and variant: time, ratio to the yardstick, share of the roofline."""
    rows = [(r["extra_info"], r["stats"]["median"]) for r in results]
    roofline = [row for row in rows if row[0]["variant"] == "roofline"]
    products = {info["rows"]: info["flops"] / seconds for info, seconds in roofline}
    seconds_of = {(info["case"], info["variant"]): seconds for info, seconds in rows}
    lines = [
        "| case | variant | median | yardstick / this | of roofline |",
        "|---|---|--:|--:|--:|",
    ]
    for info, seconds in rows:
        yardstick = seconds_of.get((info["case"], "yardstick"))
        peak = products.get(info.get("product_rows"))
        ratio = f"{yardstick / seconds:.2f}" if yardstick else ""
        share = f"{info['flops'] / seconds / peak:.0%}" if peak else ""
        if info["variant"] == "roofline":
            ratio, share = "", f"{products[info['rows']] / 1e9:.0f} GFLOP/s"
        time = f"{1e3 * seconds:.1f} ms"
        lines.append(f"| {info['case']} | {info['variant']} | {time} | {ratio} | {share} |")
    return "\n".join(lines)


def loop_overhead(results: list[dict]) -> str:
    """What the loop around acting and update costs; empty where no iteration was timed."""
    iterations: dict[tuple[str, str], dict[str, float]] = {}
    for result in results:
        info = result["extra_info"]
        settings, _, part = info["case"].partition(": ")
        if settings.startswith("iteration"):
            seconds = iterations.setdefault((settings, info["variant"]), {})
            seconds[part] = result["stats"]["median"]
    lines = []
    for (settings, variant), seconds in iterations.items():
        if {"whole", "acting, 5 states x 32", "update"} <= seconds.keys():
            whole = seconds["whole"]
            rest = whole - seconds["acting, 5 states x 32"] - seconds["update"]
            lines.append(
                f"- {settings} ({variant}): all that is neither acting nor the update takes "
                f"{1e3 * rest:.1f} of {1e3 * whole:.1f} ms, {rest / whole:.0%}.\n"
            )
    return "".join(lines)


def main(source: Path, output: Path) -> None:
    """Prints the table and writes it with the machine and the versions."""
    results = json.loads(source.read_text())["benchmarks"]
    machine = {**versions(), "threads": results[0]["extra_info"]["threads"]}
    facts = "".join(f"- {name}: {value}\n" for name, value in machine.items() if value is not None)
    text = f"{HEADER}{facts}\n{table(results)}\n\n{loop_overhead(results)}"
    output.write_text(text)
    print(text)


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
