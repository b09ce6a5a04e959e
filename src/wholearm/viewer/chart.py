"""The map of contact formations as a picture, and what can be clicked on it."""

from __future__ import annotations

import io
import math
from collections.abc import Iterable
from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes

from ..common.arrays import Array
from ..common.sharing import exclusive
from ..contacts.elemental import Contact
from ..figures.formation_map import draw_map
from ..figures.style import STYLE
from ..mapping.formation_map import Border, Crossing, FormationMap
from ..results.trajectory import Trajectory
from ..search.times import time_borders

_RESOLUTION = 130
"""Of the picture [dots per inch]."""
_MOST = 40
"""Points of a line that is clicked; more cannot be told apart."""


@exclusive
def describe_map(
    chart: FormationMap, plan: Trajectory | None = None
) -> tuple[bytes, dict[str, Any]]:
    """Draw a map, as PNG, and list its borders and crossings with what is to be known of them.

    Places are fractions of the picture, from its upper left corner.
    """
    figure = draw_map(chart, plan)
    with matplotlib.rc_context(STYLE):
        stream = io.BytesIO()
        figure.savefig(stream, format="png", dpi=_RESOLUTION)
    axes = figure.axes[0]
    held = [border for border in chart.borders if border.flush is not None]
    times = time_borders(chart.problem, held)
    borders = [
        {"points": _place(axes, border.points), "text": _describe_border(border, own)}
        for border, own in zip(held, times, strict=True)
    ]
    crossings = [
        {"point": _place(axes, own.point[None])[0], "text": _describe_crossing(own)}
        for own in chart.crossings
    ]
    return stream.getvalue(), {"borders": borders, "crossings": crossings}


def _place(axes: Axes, points: Array) -> list[list[float]]:
    """Fractions of the picture of points (x, phi), shape (n, 2) [m, rad]."""
    few = np.linspace(0, len(points) - 1, min(len(points), _MOST)).round().astype(int)
    values = np.column_stack([1e3 * points[few, 0], np.degrees(points[few, 1])])
    shares = axes.figure.transFigure.inverted().transform(axes.transData.transform(values))
    return [[round(float(x), 5), round(float(1.0 - y), 5)] for x, y in shares]


def _list(contacts: Iterable[Contact]) -> str:
    return " ".join(contact.name for contact in contacts)


def _describe_border(border: Border, times: Array) -> str:
    """Contacts of a border, where it runs, and what motions along it are possible each way."""
    ways = zip(("increasing", "decreasing"), (border.forth, border.back), times, strict=True)
    possible = [
        f"{border.along} {way}: {_name_share(share.mean())}, {_name_time(time)}"
        for way, share, time in ways
    ]
    (x, phi), (x_end, phi_end) = border.points[0], border.points[-1]
    return (
        f"{_list(border.contacts)}: x {1e3 * x:.1f} to {1e3 * x_end:.1f} mm, phi "
        f"{math.degrees(phi):.1f} to {math.degrees(phi_end):.1f} deg; {'; '.join(possible)}"
    )


def _name_share(share: float) -> str:
    """Where along a border slow motions are possible."""
    where = "all along" if share == 1 else "on parts" if share > 0 else "nowhere"
    return f"slow motions {where}"


def _name_time(time: float) -> str:
    """How long the fastest motion from one end to the other takes."""
    return (
        f"from rest to rest about {time:.3f} s" if math.isfinite(time) else "none from end to end"
    )


def _describe_crossing(crossing: Crossing) -> str:
    x, phi = crossing.point
    return f"{_list(crossing.contacts)} at x = {1e3 * x:.2f} mm, phi = {math.degrees(phi):.2f} deg"
