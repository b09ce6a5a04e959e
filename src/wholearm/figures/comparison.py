"""Force margins of several plans or replays, one above the other."""

from __future__ import annotations

from typing import Any

import matplotlib
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from ..common.errors import SimulationError
from ..common.sharing import exclusive
from ..comparison.side_by_side import Comparison, Contender
from ..results.trajectory import Trajectory
from .curves import draw_margins, draw_phases
from .style import INK, STYLE, choose_styles, list_contacts, unit_of, write_title

_WIDTH, _HEIGHT = 10.0, 2.7
"""Width of the figure, and height of a panel with what is written above it [in]."""
_LEFT, _RIGHT, _BOTTOM, _ABOVE, _TOP, _LINE = 0.80, 1.30, 0.40, 0.25, 0.35, 0.25
"""Room at the left and right of all, below and above a panel, above all, and for a line [in]."""


@exclusive
def draw_comparison(comparison: Comparison) -> Figure:
    """Draw c_n - epsilon of every contact over time: a panel for each plan, on one scale of time.

    Replays are drawn; where nothing has moved a panel says so.
    """
    shown = [(contender, _find_motion(contender)) for contender in comparison.contenders]
    motions = [motion for _, motion in shown if motion is not None]
    styles = choose_styles(tuple(dict.fromkeys(name for own in motions for name in own.contacts)))
    longest = max((motion.duration for motion in motions), default=1.0)
    height = _TOP + len(motions) * (_HEIGHT + _BOTTOM) + len(shown) * _LINE + 0.15
    covered = np.concatenate(
        [np.zeros(1), *(own.c_n.ravel() - comparison.epsilon for own in motions)]
    )
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(_WIDTH, height))
        FigureCanvasAgg(figure)
        high = height - _TOP
        for own, motion in shown:
            high -= _LINE
            look: Any = {"fontsize": 9, "color": INK, "parse_math": False, "va": "bottom"}
            figure.text(_LEFT / _WIDTH, high / height, _describe(own), **look)
            if motion is None:
                continue
            high -= _HEIGHT
            place = np.array([_LEFT, high, _WIDTH - _LEFT - _RIGHT, _HEIGHT - _ABOVE])
            left, bottom, wide, tall = place / [_WIDTH, height, _WIDTH, height]
            axes = figure.add_axes((left, bottom, wide, tall))
            draw_margins(axes, motion, comparison.epsilon, styles, covered)
            axes.set_xlim(0.0, longest)
            draw_phases(axes, motion.phase_starts, span=longest)
            list_contacts(axes, 72 * (_HEIGHT - _ABOVE))
            axes.set_ylabel(f"$c_n - \\varepsilon$ {unit_of(axes)}")
            axes.set_xlabel("time $t$ [s]" if motion is motions[-1] else "")
            high -= _BOTTOM
        title = f"{comparison.name}  \u00b7  force margins  \u00b7  \u03b5 = "
        write_title(figure, f"{title}{comparison.epsilon:g} N")
    return figure


def _find_motion(own: Contender) -> Trajectory | None:
    """The replayed motion; None if there is none."""
    if own.report is None:
        return None
    try:
        return own.report.trajectory
    except SimulationError:
        return None


def _describe(own: Contender) -> str:
    parts = [own.name, own.verdict if own.ok else f"{own.verdict}: {own.reason}"]
    parts += [f"{own.duration:.4g} s"] if own.ok else []
    return "  \u00b7  ".join(parts)
