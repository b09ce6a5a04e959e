"""Tables of a benchmark, and what figures of benchmarks share."""

from __future__ import annotations

import csv
import io
import os
import platform
from collections.abc import Sequence
from typing import Any, NamedTuple

import casadi as ca
import numpy as np
from matplotlib.axes import Axes

from .. import __version__
from ..common.files import together, write_text


class Row(NamedTuple):
    """One measurement: what was run, with which setting, how long it took and how wrong it was."""

    study: str
    method: str
    setting: str
    seconds: float
    error: float | None
    note: str = ""


def write_results(name: str, rows: Sequence[Row], stem: str) -> list[str]:
    """Write all measurements as Markdown and CSV; return the files' paths."""
    paths = [f"{stem}.{ending}" for ending in ("md", "csv")]
    with together():
        write_text(paths[0], format_markdown(name, rows))
        write_text(paths[1], format_csv(rows))
    return paths


def stamp() -> str:
    """Versions and cores that a table is stamped with."""
    return (
        f"wholearm {__version__}, casadi {ca.__version__}, numpy {np.__version__}, "
        f"Python {platform.python_version()}, {os.cpu_count()} cores"
    )


def format_markdown(name: str, rows: Sequence[Row]) -> str:
    """Tables of all studies as Markdown, stamped with versions."""
    lines = [f"# What planning takes: {name}", "", stamp(), ""]
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


def finish_axes(axes: Axes, **legend: Any) -> None:
    """Give axes a grid, no frame and a legend."""
    axes.grid(True, which="major", color="#c4c9d0", linewidth=0.6)
    axes.spines[["top", "right"]].set_visible(False)
    axes.legend(frameon=False, **legend)
