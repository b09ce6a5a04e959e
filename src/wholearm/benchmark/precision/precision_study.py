"""``wholearm bench precision``: run time against error, of planners and simulators, as tables."""

from __future__ import annotations

import argparse
import math
from collections.abc import Iterator, Sequence
from itertools import product
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from ...common.errors import InputError
from ...figures.style import PALETTE
from ..study import Case, Row, Study, finish_axes, format_table
from .planners import LEAST_TIME, NO_DRAG, PLANNERS, run_planner
from .simulators import (
    BUDGET,
    FEW,
    MANY,
    REPEATS,
    SHIFT,
    SHORT,
    SIMULATORS,
    SOLVED,
    find_mean,
    list_instances,
    run_simulator,
)

METHODS = SIMULATORS | PLANNERS
"""All methods by name, in the order of the tables."""
SIMULATION, PLANNING = (FEW, MANY), (LEAST_TIME, NO_DRAG)
"""Studies of each part."""
MARKERS = "osD^vP*Xdh<>"  # markers of the methods of a panel


INTRODUCTION = f"""\
Times are medians of processor time over up to {REPEATS} runs (one where that takes over {BUDGET:g}
s) in one thread; what takes less than {SHORT:g} s is averaged over that time. Means are geometric
ones, shifted by {1e3 * SHIFT:g} ms, over the phases of all problems, each with the setting that
reaches the error soonest; what does not reach it counts with the time limit.

Phases whose slow motion would lose a contact have no few pieces of torque, and where a method was
not run on a phase, ours does not count there either.

Errors of states are relative to the scene's length and time. A plan counts as solved if its
torques, replayed open loop by other equations than its own, keep every contact and end within 1e-2
of the end. Its three errors are those of the phase time, against the lower bound of `solve
--certify`, of the replayed end state, and the worst violation between nodes, over the object's
weight or the torque limit.
"""


class PeerComparison(NamedTuple):
    """What one table compares."""

    study: str
    title: str
    ours: str  # method that others are compared with
    targets: tuple[float, ...]  # errors that run times are compared at
    building: bool  # whether the time to build counts
    errors: int | None  # how many of the errors have to be below a target; None for all


COMPARISONS = (
    *(PeerComparison(own, own, "wholearm", (1e-6, 1e-9, 1e-11), False, None) for own in SIMULATION),
    *(
        PeerComparison(own, f"{own}, {which}", "wholearm, curve", (1e-2, 1e-3, 1e-4), True, count)
        for own in PLANNING
        for count, which in ((1, "by the error of the phase time"), (None, "by all three errors"))
    ),
)
"""Tables of times at equal error."""


def find_times(
    rows: Sequence[Row], method: str, own: PeerComparison, target: float
) -> dict[str, float]:
    """Times in which a method reaches an error on each phase that it has runs on [s].

    Infinite where it does not.
    """
    times: dict[str, float] = {}
    for row in rows:
        if (row["study"], row["method"]) == (own.study, method):
            error = max(map(abs, row["errors"][: own.errors]))
            took = row["solve"] + own.building * row["build"]
            reached = took if row["outcome"] == SOLVED and error <= target else math.inf
            times[row["phase"]] = min(times.get(row["phase"], math.inf), reached)
    return times


def list_methods(rows: Sequence[Row], study: str) -> list[str]:
    """Methods that a study has runs of, in their order."""
    given = {row["method"] for row in rows if row["study"] == study}
    return [name for name in METHODS if name in given]


def _format_targets(rows: Sequence[Row], own: PeerComparison, limit: float) -> list[str]:
    """Times to reach errors, and how many times as long as ours that is."""
    methods, table = list_methods(rows, own.study), []
    if own.ours not in methods:
        return []
    for method in methods:
        cells = [method]
        for target in own.targets:
            times, ours = (find_times(rows, m, own, target) for m in (method, own.ours))
            names = times.keys() & ours.keys()
            reached = sum(math.isfinite(times[name]) for name in names)
            mean, least = (
                find_mean([min(part[name], limit) for name in names] or [math.nan])
                for part in (times, ours)
            )
            shown = (f"{mean:.4f}", f"{mean / least:.2g}") if reached else ("-", "-")
            cells += [shown[0], f"{reached} of {len(names)}", shown[1]]
        table.append(cells)
    heads = [head for t in own.targets for head in (f"{t:g} [s]", "reached", "times ours")]
    return [
        f"## {own.title[0].upper()}{own.title[1:]}",
        "",
        *format_table(["method", *heads], table),
        "",
    ]


def _draw_study(axes: Axes, rows: Sequence[Row], study: str) -> None:
    """One panel; hollow markers are settings with which some phases are not solved."""
    planning = study in PLANNING
    for index, method in enumerate(list_methods(rows, study)):
        points, full = [], []
        mine = [row for row in rows if (row["study"], row["method"]) == (study, method)]
        for setting in dict.fromkeys(row["setting"] for row in mine):
            group = [row for row in mine if row["setting"] == setting]
            found = [row for row in group if np.isfinite(row["errors"][0])]
            if 2 * len(found) < len(group):
                continue
            error = float(np.median([abs(row["errors"][0]) for row in found]))
            seconds = find_mean([row["solve"] + planning * row["build"] for row in found])
            points.append((max(error, 1e-16), seconds))
            full.append(all(row["outcome"] == SOLVED for row in group))
        if not points:
            continue
        look: Any = {"color": PALETTE[index % len(PALETTE)], "marker": MARKERS[index]}
        look |= {"linestyle": "-" if index < len(PALETTE) else "--", "markersize": 5}
        axes.plot(*zip(*points, strict=True), label=method, **look)
        hollow = [point for point, whole in zip(points, full, strict=True) if not whole]
        if hollow:
            look |= {"markerfacecolor": "white", "linestyle": "", "zorder": 3}
            axes.plot(*zip(*hollow, strict=True), **look)
    axes.set_xscale("log")
    axes.set_yscale("log")
    axes.set_title(f"{study[0].upper()}{study[1:]}")
    what = "relative error of the phase time" if planning else "error of z and z' in scene units"
    axes.set_xlabel(f"{what}, median over phases [-]")
    axes.set_ylabel(f"{'build and solve' if planning else 'run'} time, mean over phases [s]")
    if axes.lines:
        finish_axes(axes, fontsize=8, ncols=2)


class Precision(Study):
    """Every setting of every method on every phase of four sliding contacts."""

    name, title, timed = "precision", "Run time against error, with peers", True
    columns = ("study", "phase", "method", "setting", "build", "solve", "errors", "outcome")
    packages, shipped = ("toppra", "yapss"), True
    allowed = 60.0
    options = """\
--peers NAME ...  measure these methods only, by the names that the table has (all)
--limit S         processor time that one setting may take on one phase [s] = 60.0 in 1e-3..1e6
"""

    def list_cases(self, options: argparse.Namespace) -> Iterator[Case]:
        """Study, phase, method, setting, and the files that phases are from."""
        self.allowed = options.limit
        files = tuple(map(str, sorted(Path(options.problems).glob("*.toml"))))
        if not files:
            text = f"{options.problems} has no problem files (*.toml)"
            raise InputError("", "--problems", text)
        for method in options.peers:
            if method not in METHODS:
                text = f"{method!r} given; allowed are {'; '.join(METHODS)}"
                raise InputError("", "--peers", text)
        for study, (method, own) in product(SIMULATION + PLANNING, METHODS.items()):
            asked = method in (options.peers or METHODS)
            if asked and study in own.choices and own.is_installed:
                phases = [instance.name for instance in list_instances(files, study != NO_DRAG)]
                yield from product([study], phases, [method], own.choices[study], [files])

    def limit(self, case: Case) -> float:
        """The time allowed, and that of the reference."""
        return self.allowed + 120.0

    def run(self, case: Case) -> Row:
        """Measure one setting."""
        run = run_simulator if case[0] in SIMULATION else run_planner
        median = run(*case)
        row = dict(zip(self.columns[:4], case, strict=False))
        return row if median is None else row | median._asdict()

    def report(self, rows: Sequence[Row], options: argparse.Namespace) -> tuple[str, list[str]]:
        """All tables."""
        lines, measured = [INTRODUCTION], [row for row in rows if "errors" in row]
        for comparison in COMPARISONS:
            lines += _format_targets(measured, comparison, options.limit)
        table = [(name, own.settings) for name, own in METHODS.items()]
        lines += ["## Settings", "", *format_table(["method", "settings"], table, 2)]
        return "\n".join(lines), []

    def draw(self, rows: Sequence[Row]) -> Figure:
        """Mean run time over the error that half of the phases keep, one line for each method."""
        figure = Figure(figsize=(11.0, 9.0), layout="constrained")
        FigureCanvasAgg(figure)
        measured = [row for row in rows if "errors" in row]
        for axes, study in zip(figure.subplots(2, 2).flat, PLANNING + SIMULATION, strict=True):
            _draw_study(axes, measured, study)
        return figure


STUDY = Precision()
