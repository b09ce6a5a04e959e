"""How cost and memory grow with intervals, phases and vertices, with exponents.

Each size is measured in a new process. The exponent is the slope of a straight line through the
larger half of the sizes on logarithmic axes, where constant costs are negligible.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Iterator, Sequence
from itertools import product
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import NullFormatter

from ..common.document import Table
from ..figures.style import GRID, PALETTE, open_figure
from ..geometry.tracing import load
from ..mapping.formation_map import build_map
from ..planning.plan import solve
from ..problem.read import build_problem, read_problem, require_phases
from .scenes import name_first
from .study import Case, Findings, Row, Study, group

WORK = {
    "intervals": (("least time", "margin"), (50, 100, 200, 400, 800, 1600, 3200)),
    "phases": (("least time",), (3, 6, 12, 25, 50)),
    "vertices": (("reading", "map"), (6, 12, 25, 50, 100)),
}
"""Varied quantity, kinds of work, and sizes."""
FIELDS = {"seconds": ("s", "processor time [s]"), "memory": ("MB", "rise of memory [MB]")}
"""Quantities that are measured, their units and labels."""


class Growth(Study):
    """Cost of work on one problem, by size."""

    name, title, timed = "growth", "How cost and memory grow", True
    isolated = True
    keys = ("problem", "grows", "work", "size")
    columns = (*keys[1:], "seconds", "memory")
    options = "problem  problem file (TOML) whose first phase is made larger\n"

    def list_cases(self, options: argparse.Namespace) -> Iterator[Case]:
        """Problem, varied quantity, work and size."""
        require_phases(load(options.problem))
        self.run((options.problem, "intervals", "least time", 50))
        for grows, (works, sizes) in WORK.items():
            yield from product([options.problem], [grows], works, sizes)

    def run(self, case: Case) -> Row:
        """Do one piece of work."""
        path, grows, work, size = case
        run_work(dict(read_problem(path).table), grows, work, size)
        return {}

    def report(self, rows: Sequence[Row], options: argparse.Namespace) -> Findings:
        """Tables with the exponents."""
        text = "Processor time and rise of the peak memory, each in a process of its own."
        parts: list[str | Table] = [text]
        for grows, (works, sizes) in WORK.items():
            table = []
            for work, (field, (unit, _)) in product(works, FIELDS.items()):
                costs = dict(zip(*select(rows, grows, work, field), strict=True))
                exponent = fit_exponent([*costs], [*costs.values()])
                table.append((f"{work} [{unit}]", *map(costs.get, sizes), exponent))
            heads = ["work", *(f"{size}:.3g" for size in sizes), "exponent:.2f"]
            parts += [f"## {grows.capitalize()}", Table(heads, table)]
        return parts, []

    def draw(self, rows: Sequence[Row]) -> Figure:
        """Cost above, memory below, over what grows, on logarithmic axes."""
        with open_figure(10.0, 6.4, layout="constrained") as figure:
            grid = figure.subplots(2, len(WORK), squeeze=False)
            for column, (grows, (works, ticks)) in zip(grid.T, WORK.items(), strict=True):
                for axes, (field, (_, label)) in zip(column, FIELDS.items(), strict=True):
                    for work, colour, marker in zip(works, PALETTE, "os", strict=False):
                        sizes, values = select(rows, grows, work, field)
                        name = f"{work}, exponent {fit_exponent(sizes, values):.2f}"
                        axes.loglog(sizes, values, color=colour, marker=marker, label=name)
                    axes.set_xticks(ticks, map(str, ticks))
                    low, high = (np.log10(limit) for limit in axes.get_ylim())
                    axes.set_ylim(10.0 ** np.floor(low), 10.0 ** np.ceil(high))
                    for axis in (axes.xaxis, axes.yaxis):
                        axis.set_minor_formatter(NullFormatter())
                    axes.set_xlabel(f"{grows} [-]")
                    axes.set_ylabel(label)
                    axes.grid(True, which="major", color=GRID, linewidth=0.6)
                    axes.legend(fontsize=8)
        return figure


STUDY = Growth()


def select(rows: Sequence[Row], grows: str, work: str, field: str) -> tuple[list[int], list[float]]:
    """Sizes and costs of some work; costs are at least 1e-3."""
    selected = group(rows, "grows", "work").get((grows, work), [])
    return [row["size"] for row in selected], [max(row[field], 1e-3) for row in selected]


def run_work(table: dict[str, Any], grows: str, work: str, size: int) -> None:
    """Do one piece of work on the problem of a table with a given size."""
    (first, *_) = table["phases"]
    if grows == "vertices":
        angles = 2 * np.pi * np.arange(size) / size
        corners = 0.05 * np.column_stack([np.cos(angles), np.sin(angles)])
        table = {**table, "object": {**table["object"], "vertices": corners.tolist()}}
        table |= {"start": {"flush": 0, "x": 0.0}, "fingers_collide": False}
        phase = {"contacts": name_first(table), "until": {"x": -0.01}}
        problem = build_problem({**table, "phases": [phase]})
        if work == "map":
            build_map(problem)
        return
    if grows == "phases":
        ends = [{"x": (0.04, 0.045)[k % 2]} for k in range(size)]
        phases = [{"contacts": first["contacts"], "until": end} for end in ends]
        solve(build_problem({**table, "phases": phases}), replay=False)
        return
    problem = build_problem({**table, "phases": [first]})
    goal: dict[str, Any] = {"objective": "margin", "duration": 0.4} if work == "margin" else {}
    solve(problem, intervals=size, replay=False, **goal)


def fit_exponent(sizes: Sequence[float], costs: Sequence[float]) -> float:
    """The p of cost ~ size^p, by least squares through the larger half; NaN for one size."""
    half = min(len(sizes) // 2, len(sizes) - 2)
    if half < 0:
        return math.nan
    x, y = (np.log(np.asarray(part, dtype=float)[half:]) for part in (sizes, costs))
    return float(np.polyfit(x, y, 1)[0])
