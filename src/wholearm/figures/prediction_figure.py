"""The least normal force of slow motions over their speed, phase by phase."""

from __future__ import annotations

import math
from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, MaxNLocator, NullFormatter

from ..common.sharing import exclusive
from ..quasistatic.slow_speeds import PhasePrediction, Prediction, Survival
from .style import GRID, INK, LOST, LOW, PALETTE, STYLE, write_title

_COLUMNS = 3  # most panels side by side
_WIDTH, _HEIGHT = 3.7, 2.85  # of a panel with what is written about it [in]
_ROOM = (0.62, 0.15, 0.50, 0.80)  # room at the left, right, bottom and top of a panel [in]
_TOP = 0.45  # room above all panels [in]
_LOOKS: Any = ({"linestyle": "-"}, {"linestyle": (0, (5, 1.5))}, {"linestyle": (0, (1.5, 1))})
_WIDE = 20.0  # largest speed over the least from which on fewer speeds have labels
_REACH = 2.2  # largest force shown, over that near rest


@exclusive
def draw_prediction(prediction: Prediction) -> Figure:
    """Draw the least normal force over speed: a panel for each phase, a line for each motion."""
    phases = [phase for phase in prediction.phases if phase.curves is not None]
    columns = min(_COLUMNS, max(len(phases), 2))
    rows = max(math.ceil(len(phases) / columns), 1)
    width, height = columns * _WIDTH, rows * _HEIGHT + _TOP
    left, right, bottom, top = _ROOM
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(width, height))
        FigureCanvasAgg(figure)
        for k, phase in enumerate(phases):
            row, column = divmod(k, columns)
            corner = column * _WIDTH + left, height - _TOP - (row + 1) * _HEIGHT + bottom
            size = _WIDTH - left - right, _HEIGHT - bottom - top
            place = np.array([*corner, *size]) / [width, height, width, height]
            axes = figure.add_axes((place[0], place[1], place[2], place[3]))
            _draw_phase(axes, phase, prediction.epsilon)
            axes.set_ylabel("least $c_n$ [N]" if column == 0 else "")
            axes.set_xlabel("speed along the phase [m/s]" if k >= len(phases) - columns else "")
        name = f"{prediction.name}  \u00b7  quasistatic motions at speed"
        title = f"{name}  \u00b7  \u03b5 = {prediction.epsilon:g} N"
        write_title(figure, title, left=0.15)
    return figure


def _draw_phase(axes: Axes, phase: PhasePrediction, epsilon: float) -> None:
    """The lines of one phase, with where they break, and above them what breaks."""
    curves = phase.curves
    assert curves is not None
    rest = max([epsilon, *(float(force[0]) for force in curves.force.values())])
    low, high = -0.35 * rest, _REACH * rest
    axes.axhspan(0.0, epsilon, color=LOW, linewidth=0, zorder=1)
    axes.axhspan(low, 0.0, color=LOST, linewidth=0, zorder=1)
    axes.axhline(epsilon, color="black", linewidth=1.0, zorder=2)
    for k, own in enumerate(phase.survivals):
        look = {"color": PALETTE[k], "linewidth": 1.9, "zorder": 3 + k, **_LOOKS[k % 3]}
        force = curves.force[own.motion]
        axes.plot(curves.speed, np.where(np.isfinite(force), force, np.nan), **look)
        if own.speed:
            axes.plot(own.speed, epsilon, "o", color=PALETTE[k], markersize=5, zorder=6)
        _write(axes, k, own)
    if not any(np.isfinite(force).any() for force in curves.force.values()):
        middle: Any = {"transform": axes.transAxes, "ha": "center", "va": "center", "zorder": 7}
        axes.text(0.5, 0.5, "no slow motion keeps its limits", color=INK, **middle)
    title = f"phase {phase.number}, until {phase.until}"
    place: Any = {"xycoords": "axes fraction", "textcoords": "offset points", "va": "bottom"}
    axes.annotate(title, (0, 1), (0, 41), fontsize=9, fontweight="bold", color=INK, **place)
    axes.set(xscale="log", xlim=(curves.speed[0], curves.speed[-1]), ylim=(low, high))
    wide = curves.speed[-1] > _WIDE * curves.speed[0]
    axes.xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0) if wide else (1.0, 2.0, 3.0, 5.0)))
    axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axes.xaxis.set_minor_formatter(NullFormatter())
    axes.yaxis.set_major_locator(MaxNLocator(5))
    axes.grid(color=GRID, linewidth=0.4)


def _write(axes: Axes, k: int, own: Survival) -> None:
    """What gives way first in one motion, and at which speed."""
    if own.speed is None:
        what = "keeps \u03b5 at any speed"
    elif own.speed > 0:
        what = f"{own.speed:.3g} m/s: {own.first.name}"
    elif own.again is not None:
        what = f"only from {own.again:.3g} m/s on: {own.first.name}"
    else:
        what = f"never: {own.first.name}"
    text = f"{own.motion}, {what}"
    place: Any = {"xycoords": "axes fraction", "textcoords": "offset points", "va": "bottom"}
    axes.annotate(text, (0, 1), (0, 29 - 12 * k), fontsize=7.5, color=PALETTE[k], **place)
