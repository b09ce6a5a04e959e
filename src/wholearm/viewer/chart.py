"""The figure of a map of contact formations in a page, with what a click on it tells."""

from __future__ import annotations

import io
import math
from collections.abc import Iterable
from typing import Any

import matplotlib
import numpy as np

from ..common.arrays import Array
from ..common.sharing import exclusive
from ..contacts.closing import close_fingers
from ..contacts.elemental import Contact
from ..figures.map_figure import BOX, PLACE, SIZE, draw_map, find_room, split
from ..figures.style import STYLE
from ..mapping.formation_map import Border, FormationMap
from ..results.trajectory import Trajectory
from ..search.times import time_borders
from .motion_data import count_places, describe_hand

_MOST = 40  # points of a border; more cannot be told apart by clicks


@exclusive
def describe_map(chart: FormationMap, plan: Trajectory | None = None) -> tuple[str, dict[str, Any]]:
    """A map with a plan, or the problem's own phases, as SVG, and what can be clicked on it.

    Returns
    -------
    drawing  with the ids of `figures.map_figure`
    places   under "hand" the hand and the object; under "places", by their numbers in these ids,
             `contacts`, a `text` and the poses `z` of what can be clicked; under "axes" where the
             drawing has which x [mm] and phi [deg]
    """
    scene, stream = chart.problem.scene, io.StringIO()
    with matplotlib.rc_context(STYLE | {"svg.fonttype": "none"}):
        draw_map(chart, plan).savefig(stream, format="svg", metadata={"Date": None})
    drawing = stream.getvalue()
    # Of the file only the drawing, and its style for nothing else in the page.
    drawing = drawing[drawing.index("<svg") :].replace("*{", ".map *{")
    parts = list(split(chart.cell))
    step = np.array([np.ptp(chart.phi) / len(chart.phi), np.ptp(chart.x) / len(chart.x)])
    rooms = [find_room(region, step / np.ptp(chart.x)) for _, region in parts]
    middles = np.array([[chart.x[column], chart.phi[row]] for row, column, _ in rooms])
    poses = close_fingers(scene, *middles.T).z

    def describe(contacts: Iterable[Contact], text: str, z: Array) -> dict[str, Any]:
        names, values = [c.name for c in contacts], np.round(z, count_places(scene)).tolist()
        return {"contacts": names, "text": text, "z": values}

    places = []
    for (index, _), point, z in zip(parts, middles, poses, strict=True):
        text = f"a cell, two freedoms; its middle is at {_name_place(point)}"
        places.append(describe(chart.formations[index], text, z[None]) | {"wide": True})
    flush = [border for border in chart.borders if border.flush is not None]
    for border, times in zip(flush, time_borders(chart.problem, flush), strict=True):
        rows = np.unique(np.linspace(0, len(border.z) - 1, _MOST).round().astype(int))
        places.append(describe(border.contacts, _describe_border(border, times), border.z[rows]))
    for crossing in chart.crossings:
        text = f"a crossing at {_name_place(crossing.point)}"
        places.append(describe(crossing.contacts, text, crossing.z[None]))
    low, high = ([1e3 * float(chart.x[k]), math.degrees(chart.phi[k])] for k in (0, -1))
    axes = {"low": low, "high": high, "box": [72 * v for v in BOX], "tall": 72 * SIZE[1]}
    return drawing, {"id": PLACE, "hand": describe_hand(scene), "places": places, "axes": axes}


def _name_place(point: Array) -> str:
    x, phi = point
    return f"x = {1e3 * x:.2f} mm, phi = {math.degrees(phi):.2f} deg"


def _describe_border(border: Border, times: Array) -> str:
    """Where a border runs, and what motions along it are possible each way."""
    ways = zip(("increasing", "decreasing"), (border.forth, border.back), times, strict=True)
    possible = []
    for way, flags, time in ways:
        where = "all along" if flags.all() else "on parts" if flags.any() else "nowhere"
        least = f"least time about {time:.3f} s"
        told = least if math.isfinite(time) else "no motion from end to end"
        possible.append(f"{border.along} {way}: {told}, slow motions {where}")
    (x, phi), (x_end, phi_end) = border.points[0], border.points[-1]
    return (
        f"a border, one freedom, x {1e3 * x:.1f} to {1e3 * x_end:.1f} mm, phi "
        f"{math.degrees(phi):.1f} to {math.degrees(phi_end):.1f} deg; {'; '.join(possible)}"
    )
