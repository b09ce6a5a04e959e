"""The figure of a study of run time against error."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from ...figures.style import PALETTE
from ..report import finish_axes
from .planning import LEAST_TIME, NO_DRAG
from .report import Medians, group_settings, list_methods
from .runs import SOLVED, Run, find_mean, find_medians
from .simulation import FEW, MANY

MARKERS = "osD^vP*Xdh<>"
"""Markers of the methods of a panel."""
SMALLEST = 1e-16
"""Error that is drawn for none at all."""


def draw_runs(runs: Sequence[Run]) -> Figure:
    """Mean run time over the error that half of the phases keep, one line for each method."""
    medians = find_medians(runs)
    with matplotlib.rc_context({"font.size": 9.0}):
        figure = Figure(figsize=(11.0, 9.0), layout="constrained")
        FigureCanvasAgg(figure)
        studies = (LEAST_TIME, NO_DRAG, FEW, MANY)
        for axes, study in zip(figure.subplots(2, 2).flat, studies, strict=True):
            _draw_study(axes, medians, study)
    return figure


def _draw_study(axes: Axes, medians: Medians, study: str) -> None:
    """One panel; hollow markers are settings with which some phases are not solved."""
    planning = study in (LEAST_TIME, NO_DRAG)
    for index, method in enumerate(list_methods(medians, study)):
        points, full = [], []
        for group in group_settings(medians, study, method).values():
            found = [own for own in group if np.isfinite(own.errors[0])]
            if 2 * len(found) < len(group):
                continue
            error = float(np.median([abs(own.errors[0]) for own in found]))
            seconds = find_mean([own.solve + planning * own.build for own in found])
            points.append((max(error, SMALLEST), seconds))
            full.append(all(own.outcome == SOLVED for own in group))
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
    axes.set_title(study[0].upper() + study[1:])
    what = "relative error of the phase time" if planning else "error of z and z' in scene units"
    axes.set_xlabel(f"{what}, median over phases [-]")
    axes.set_ylabel(f"{'build and solve' if planning else 'run'} time, mean over phases [s]")
    if axes.lines:
        finish_axes(axes, fontsize=8, ncols=2)
