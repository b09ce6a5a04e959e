"""How cost and memory grow with intervals, phases and vertices, with exponents.

Each size is measured in a process of its own. The exponent is the slope of a straight line through
the larger half of the sizes on logarithmic axes, where what does not grow no longer counts.
"""

from __future__ import annotations

import csv
import io
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import NullFormatter

from ..common.files import require_writable, together, write_text
from ..figures.plots import save
from ..geometry.path_guess import load
from ..mapping.formation_map import build_map
from ..planning.plan import solve
from ..problem.read import build_problem, read_problem
from .alone import measure_alone
from .report import finish_axes, stamp
from .stress.scenes import name_first

SIZES = {
    "intervals": (50, 100, 200, 400, 800, 1600, 3200),
    "phases": (3, 6, 12, 25, 50),
    "vertices": (6, 12, 25, 50, 100),
}
"""Sizes by what grows."""
WORK = {
    "intervals": ("least time", "margin"),
    "phases": ("least time",),
    "vertices": ("reading", "map"),
}
"""Kinds of work that are measured for each."""
RADIUS = 0.05
"""Radius of the regular polygons [m]."""
TURNS = (0.04, 0.045)
"""Places between which the phases go back and forth [m]."""
FIELDS = {"seconds": "processor time [s]", "memory": "rise of memory [MB]"}
"""Quantities that are drawn, and their labels."""
_LOOKS = {
    "least time": ("#0072B2", "o"),
    "margin": ("#D55E00", "s"),
    "reading": ("#009E73", "^"),
    "map": ("#CC79A7", "D"),
}


class Point(NamedTuple):
    """One measurement.

    Attributes
    ----------
    grows, work : str
        What grows, and what is done.
    size : int
    seconds : float, [s]
        Processor time.
    memory : float, [MB]
        By which the peak of memory rose.
    """

    grows: str
    work: str
    size: int
    seconds: float
    memory: float


def run_work(table: dict[str, Any], grows: str, work: str, size: int) -> None:
    """Do one piece of work on the problem of a table, made as large as is asked."""
    (first, *_) = table["phases"]
    if grows == "vertices":
        angles = 2 * np.pi * np.arange(size) / size
        corners = RADIUS * np.column_stack([np.cos(angles), np.sin(angles)])
        table = {**table, "object": {**table["object"], "vertices": corners.tolist()}}
        table |= {"start": {"flush": 0, "x": 0.0}, "fingers_collide": False}
        end = {"x": -0.01}
        phase = {"contacts": name_first(table), "until": end}
        problem = build_problem({**table, "phases": [phase]})
        if work == "map":
            build_map(problem)
        return
    if grows == "phases":
        ends = [{"x": TURNS[k % 2]} for k in range(size)]
        phases = [{"contacts": first["contacts"], "until": end} for end in ends]
        solve(build_problem({**table, "phases": phases}), replay=False)
        return
    problem = build_problem({**table, "phases": [first]})
    goal = "margin" if work == "margin" else "time"
    duration = 0.4 if work == "margin" else None
    solve(problem, goal, intervals=size, replay=False, duration=duration)


def list_work() -> list[tuple[str, str, int]]:
    """Everything that is measured: what grows, what is done, and the size."""
    return [
        (grows, work, size)
        for grows, sizes in SIZES.items()
        for work in WORK[grows]
        for size in sizes
    ]


def measure_growth(
    table: dict[str, Any], progress: Callable[[str], None] | None = None
) -> list[Point]:
    """Measure every work at every size."""
    points = []
    for grows, work, size in list_work():
        if progress is not None:
            progress(f"{work} with {size} {grows}")
        cost = measure_alone(run_work, table, grows, work, size)
        points.append(Point(grows, work, size, cost.seconds, cost.memory))
    return points


def fit_exponent(sizes: Sequence[float], costs: Sequence[float]) -> float:
    """The p of cost ~ size^p, by least squares through the larger half of the sizes."""
    half = len(sizes) // 2
    x, y = (np.log(np.asarray(part, dtype=float)[half:]) for part in (sizes, costs))
    return float(np.polyfit(x, y, 1)[0])


def format_growth(points: Sequence[Point]) -> str:
    """Tables with the exponents as Markdown."""
    lines = ["# How cost and memory grow", "", stamp(), ""]
    lines += ["Processor time and rise of the peak memory, each in a process of its own.", ""]
    for grows, sizes in SIZES.items():
        lines += [f"## {grows.capitalize()}", ""]
        lines += [f"| work | {' | '.join(map(str, sizes))} | exponent |"]
        lines += ["|---|" + "---:|" * (len(sizes) + 1)]
        for work in WORK[grows]:
            own = [point for point in points if (point.grows, point.work) == (grows, work)]
            for unit, values in (
                ("s", [point.seconds for point in own]),
                ("MB", [point.memory for point in own]),
            ):
                shown = [f"{value:.3g}" for value in values] + [""] * (len(sizes) - len(values))
                exponent = fit_exponent(
                    [point.size for point in own], [max(value, 1e-3) for value in values]
                )
                lines.append(f"| {work} [{unit}] | {' | '.join(shown)} | {exponent:.2f} |")
        lines.append("")
    return "\n".join(lines)


def draw_growth(points: Sequence[Point]) -> Figure:
    """Cost above, memory below, over what grows, on logarithmic axes."""
    figure = Figure(figsize=(10.0, 6.4), layout="constrained")
    FigureCanvasAgg(figure)
    grid = figure.subplots(2, len(SIZES), squeeze=False)
    for column, grows in zip(grid.T, SIZES, strict=True):
        for axes, (field, label) in zip(column, FIELDS.items(), strict=True):
            for work in WORK[grows]:
                own = [point for point in points if (point.grows, point.work) == (grows, work)]
                sizes = [point.size for point in own]
                values = [max(getattr(point, field), 1e-3) for point in own]
                colour, marker = _LOOKS[work]
                name = f"{work}, exponent {fit_exponent(sizes, values):.2f}"
                axes.loglog(sizes, values, color=colour, marker=marker, label=name)
            axes.set_xticks(SIZES[grows], map(str, SIZES[grows]))
            low, high = (np.log10(limit) for limit in axes.get_ylim())
            axes.set_ylim(10.0 ** np.floor(low), 10.0 ** np.ceil(high))
            for axis in (axes.xaxis, axes.yaxis):
                axis.set_minor_formatter(NullFormatter())
            axes.set_xlabel(f"{grows} [-]")
            axes.set_ylabel(label)
            finish_axes(axes, fontsize=8)
    return figure


def run_growth(path: str, output: str, progress: Callable[[str], None] | None = None) -> list[str]:
    """Measure growth of a problem's work; returns the paths of the table and the figure."""
    paths = [str(Path(output) / f"bench_growth.{ending}") for ending in ("md", "csv", "png")]
    for each in paths:
        require_writable(each)
    load(path)
    points = measure_growth(dict(read_problem(path).table), progress)
    stream = io.StringIO()
    csv.writer(stream, lineterminator="\n").writerows([Point._fields, *points])
    with together():
        for each, text in zip(paths, (format_growth(points), stream.getvalue()), strict=False):
            write_text(each, text)
        save(draw_growth(points), paths[2])
    return paths
