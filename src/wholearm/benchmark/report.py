"""Tables and the figure of a benchmark."""

from __future__ import annotations

import csv
import io
import os
import platform
from collections.abc import Sequence
from typing import Any, NamedTuple

import casadi as ca
import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from .. import __version__
from ..common.files import together, write_text
from ..figures.plots import save

_LOOKS = {
    "phase time": ("#0072B2", "o"),
    "simulated end": ("#009E73", "D"),
    "plain Opti": ("#D55E00", "s"),
}


class Row(NamedTuple):
    """One measurement: what was run, with which setting, how long it took and how wrong it was."""

    study: str
    method: str
    setting: str
    seconds: float
    error: float | None
    note: str = ""


def write_results(name: str, rows: Sequence[Row], stem: str) -> list[str]:
    """Write all measurements as Markdown, CSV and PNG; return the files' paths."""
    paths = [f"{stem}.{ending}" for ending in ("md", "csv", "png")]
    with together():
        write_text(paths[0], format_markdown(name, rows))
        write_text(paths[1], format_csv(rows))
        save(draw_run_times(rows), paths[2])
    return paths


def stamp() -> str:
    """Versions and cores that a table is stamped with."""
    return (
        f"wholearm {__version__}, casadi {ca.__version__}, numpy {np.__version__}, "
        f"Python {platform.python_version()}, {os.cpu_count()} cores"
    )


def format_markdown(name: str, rows: Sequence[Row]) -> str:
    """Tables of all studies as Markdown, stamped with versions."""
    lines = [f"# Run time against error: {name}", "", stamp(), ""]
    for study in dict.fromkeys(row.study for row in rows):
        lines += [f"## {study[0].upper()}{study[1:]}", ""]
        lines += ["| method | setting | seconds | error | note |", "|---|---:|---:|---:|---|"]
        for row in rows:
            if row.study == study:
                error = "" if row.error is None else f"{row.error:.2e}"
                lines.append(
                    f"| {row.method} | {row.setting} | {row.seconds:.4f} | {error} | {row.note} |"
                )
        lines.append("")
    return "\n".join(lines)


def format_csv(rows: Sequence[Row]) -> str:
    """All measurements as CSV."""
    stream = io.StringIO()
    writer = csv.writer(stream, lineterminator="\n")
    writer.writerow(Row._fields)
    writer.writerows(rows)
    return stream.getvalue()


def draw_run_times(rows: Sequence[Row]) -> Figure:
    """Run time of the planner against error on logarithmic axes."""
    with matplotlib.rc_context({"font.size": 10.0}):
        figure = Figure(figsize=(6.0, 4.4), layout="constrained")
        FigureCanvasAgg(figure)
        axes = figure.subplots()
        _draw_study(axes, rows, "planner: phase time", "path NLP", "phase time")
        _draw_study(axes, rows, "planner: simulated end", "path NLP", "simulated end")
        _draw_baseline(axes, rows)
        axes.set_title("Planning all phases, over the number of intervals")
        axes.set_xlabel("error of the phase time [-], of the simulated end [m, rad]")
        axes.set_xscale("log")
        axes.set_yscale("log")
        axes.set_ylabel("run time [s]")
        finish_axes(axes)
    return figure


def finish_axes(axes: Axes, **legend: Any) -> None:
    """Give axes a grid, no frame and a legend."""
    axes.grid(True, which="major", color="#c4c9d0", linewidth=0.6)
    axes.spines[["top", "right"]].set_visible(False)
    axes.legend(frameon=False, **legend)


def _draw_study(axes: Axes, rows: Sequence[Row], study: str, method: str, label: str) -> None:
    mine = [row for row in rows if row.study == study and row.method == method and row.error]
    points = [(row.error or 0.0, row.seconds) for row in mine]
    colour, marker = _LOOKS[label]
    axes.plot(*zip(*points, strict=True), color=colour, marker=marker, label=label)
    if label == "phase time":
        for row, point in zip(mine, points, strict=True):
            look: Any = {"textcoords": "offset points", "fontsize": 8}
            axes.annotate(row.setting, point, (4, 4), **look)


def _draw_baseline(axes: Axes, rows: Sequence[Row]) -> None:
    mine = [row for row in rows if row.study == "least time" and row.method == "plain Opti"]
    errors = [abs(row.error) for row in mine if row.error is not None]
    whole = [row.seconds for row in mine if row.setting == "all phases"]
    if errors and whole:
        colour, marker = _LOOKS["plain Opti"]
        axes.plot(
            [max(errors)], whole, color=colour, marker=marker, ls="", label="plain Opti, phase time"
        )
