"""Tables and the figure of a study of run time against error."""

from __future__ import annotations

import math
import platform
from collections.abc import Sequence
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from ...figures.style import PALETTE
from ..report import finish_axes, stamp
from .runs import BUDGET, LIMIT, REPEATS, SHIFT, SOLVED, Key, Median, Run, find_mean, find_medians
from .simulation import DRIFT, FEW, MANY
from .simulators import SIMULATORS

TARGETS = {FEW: (1e-6, 1e-9, 1e-11), MANY: (1e-6, 1e-9, 1e-11)}
"""Errors that run times are compared at, by study."""
PEERS = ("scipy",)
"""Distributions whose versions are stated."""

Medians = dict[Key, Median]


def format_report(runs: Sequence[Run], limit: float = LIMIT) -> str:
    """All tables as Markdown."""
    medians = find_medians(runs)
    lines = ["# Run time against error, with peers", "", stamp(), ""]
    lines += [f"{_name_processor()}; {', '.join(_list_versions())}.", ""]
    lines += [
        f"Medians of up to {REPEATS} runs (one where it takes over {BUDGET:g} s). Means are "
        f"geometric ones, shifted by {1e3 * SHIFT:g} ms, over the phases of all problems, each "
        "with the setting that reaches the error soonest; what does not reach it counts with the "
        f"time limit, {limit:g} s of processor time.",
        "",
    ]
    for study in (FEW, MANY):
        lines += _format_targets(medians, study, limit)
    lines += _format_drift(medians)
    lines += ["## Settings", "", "| method | settings |", "|---|---|"]
    lines += [f"| {name} | {own.settings} |" for name, own in SIMULATORS.items()]
    return "\n".join([*lines, ""])


def find_times(medians: Medians, study: str, method: str, target: float) -> list[float]:
    """Times in which a method reaches an error on each phase of a study, or infinity [s]."""
    names = dict.fromkeys(key[1] for key in medians if key[0] == study)
    found = []
    for name in names:
        own = [
            median.solve
            for key, median in medians.items()
            if (key[0], key[1], key[2]) == (study, name, method) and median.reaches(target)
        ]
        found.append(min(own, default=math.inf))
    return found


def _format_targets(medians: Medians, study: str, limit: float) -> list[str]:
    """Times to reach errors, and how many times as long as ours that is."""
    methods = list(dict.fromkeys(key[2] for key in medians if key[0] == study))
    if not methods:
        return []
    methods.sort(key=list(SIMULATORS).index)
    lines = [f"## {study[0].upper()}{study[1:]}", ""]
    heads = [f"{target:g} [s] | reached | times ours" for target in TARGETS[study]]
    lines += [f"| method | building [s] | {' | '.join(heads)} |"]
    lines += ["|---|---:|" + "---:|---:|---:|" * len(heads)]
    for method in methods:
        built = [own.build for key, own in medians.items() if (key[0], key[2]) == (study, method)]
        cells = [method, f"{find_mean([t for t in built if math.isfinite(t)] or [0.0]):.4f}"]
        for target in TARGETS[study]:
            times, ours = (find_times(medians, study, m, target) for m in (method, "wholearm"))
            mean, own = (find_mean([min(t, limit) for t in part]) for part in (times, ours))
            reached = sum(map(math.isfinite, times))
            cells += [f"{mean:.4f}", f"{reached} of {len(times)}", f"{mean / own:.1f}"]
        lines.append(f"| {' | '.join(cells)} |")
    return [*lines, ""]


def _format_drift(medians: Medians) -> list[str]:
    """The long swing: time, error of the state, drift of gaps and energy."""
    own = {key: median for key, median in medians.items() if key[0] == DRIFT}
    if not own:
        return []
    lines = [f"## {DRIFT[0].upper()}{DRIFT[1:]}", ""]
    lines += ["| method | tolerance | seconds | error of the state | gaps | energy | outcome |"]
    lines += ["|---|---:|---:|---:|---:|---:|---|"]
    for (_, _, method, setting), median in own.items():
        errors = " | ".join(f"{value:.1e}" for value in (*median.errors, *3 * (math.nan,))[:3])
        cells = f"{method} | {setting} | {median.solve:.4f} | {errors} | {median.outcome}"
        lines.append(f"| {cells} |")
    return [*lines, ""]


def draw_runs(runs: Sequence[Run]) -> Figure:
    """Mean run time over the error that half of the phases keep, one line for each method."""
    medians = find_medians(runs)
    with matplotlib.rc_context({"font.size": 9.0}):
        figure = Figure(figsize=(11.0, 5.0), layout="constrained")
        FigureCanvasAgg(figure)
        studies = (FEW, MANY)
        for axes, study in zip(figure.subplots(1, len(studies)), studies, strict=True):
            _draw_study(axes, medians, study)
    return figure


def _draw_study(axes: Axes, medians: Medians, study: str) -> None:
    own = {key: median for key, median in medians.items() if key[0] == study}
    methods = sorted({key[2] for key in own}, key=list(SIMULATORS).index)
    markers = "osD^vP*Xdh<>"
    for index, method in enumerate(methods):
        points = []
        for setting in dict.fromkeys(key[3] for key in own if key[2] == method):
            group = [m for key, m in own.items() if key[2:] == (method, setting)]
            solved = [m for m in group if m.outcome == SOLVED]
            if 2 * len(solved) >= len(group):
                error = float(np.median([m.errors[0] for m in solved]))
                points.append((max(error, 1e-16), find_mean([m.solve for m in solved])))
        look: Any = {"color": PALETTE[index % len(PALETTE)], "marker": markers[index]}
        look |= {"linestyle": "-" if index < len(PALETTE) else "--", "markersize": 4}
        if points:
            axes.plot(*zip(*points, strict=True), label=method, **look)
    axes.set_xscale("log")
    axes.set_yscale("log")
    axes.set_title(study[0].upper() + study[1:])
    axes.set_xlabel("median error of z and z', in the scene's units [-]")
    axes.set_ylabel("run time, mean over phases [s]")
    finish_axes(axes, fontsize=8, ncols=2)


def _name_processor() -> str:
    """Name of the processor."""
    path = Path("/proc/cpuinfo")
    lines = path.read_text().splitlines() if path.exists() else []
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.processor() or platform.machine()


def _list_versions() -> list[str]:
    """Versions of the peers that are installed."""
    found = []
    for name in PEERS:
        try:
            found.append(f"{name} {version(name)}")
        except PackageNotFoundError:
            found.append(f"{name} not installed")
    return found
