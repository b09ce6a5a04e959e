"""The map of contact formations in a page, and what can be clicked on it."""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import Any, NamedTuple

import numpy as np

from ..common.arrays import Array
from ..common.sharing import exclusive
from ..contacts.closing import close_fingers
from ..contacts.elemental import Contact
from ..figures.map_lines import trace_plan
from ..figures.regions import find_room, split
from ..mapping.formation_map import Border, Crossing, FormationMap
from ..mapping.route import trace_problem
from ..results.trajectory import Trajectory
from ..search.times import time_borders
from .map_drawing import draw_legend, draw_map
from .motion import count_places, describe_hand
from .paper import BOX, SHEET

_MOST = 40
"""Points of a line that is clicked; more cannot be told apart."""


class Chart(NamedTuple):
    """A map in a page.

    Attributes
    ----------
    drawing, legend : str
        SVG, and the HTML of what it means.
    places : dict
        Under "hand" the hand and the object; under "places", in the order in which the drawing
        has them, for each thing that can be clicked its `contacts`, a `text` and its poses `z`;
        under "axes" where the drawing has which x [mm] and phi [deg].
    """

    drawing: str
    legend: str
    places: dict[str, Any]


@exclusive
def describe_map(chart: FormationMap, plan: Trajectory | None = None) -> Chart:
    """Draw a map with a plan, or the problem's own phases, and list what can be clicked on it."""
    scene = chart.problem.scene
    paths = trace_problem(chart.problem) if plan is None else trace_plan(plan)
    parts = list(split(chart.cell))
    step = np.array([np.ptp(chart.phi) / len(chart.phi), np.ptp(chart.x) / len(chart.x)])
    rooms = [find_room(region, step / np.ptp(chart.x)) for _, region in parts]
    middles = np.array([[chart.x[column], chart.phi[row]] for row, column, _ in rooms])
    poses = close_fingers(scene, *middles.T).z
    cells = [
        _describe(chart.formations[index], _describe_cell(point), z[None])
        for (index, _), point, z in zip(parts, middles, poses, strict=True)
    ]
    held = [border for border in chart.borders if border.flush is not None]
    few = [
        np.unique(np.linspace(0, len(own.points) - 1, _MOST).round().astype(int)) for own in held
    ]
    times = time_borders(chart.problem, held)
    borders = [
        _describe(border.contacts, _describe_border(border, own), border.z[rows])
        for border, own, rows in zip(held, times, few, strict=True)
    ]
    crossings = [
        _describe(own.contacts, _describe_crossing(own), own.z[None]) for own in chart.crossings
    ]
    drawing = draw_map(
        chart,
        paths,
        parts,
        [border.points[rows] for border, rows in zip(held, few, strict=True)],
        np.array([own.point for own in chart.crossings]).reshape(-1, 2),
    )
    every = cells + borders + crossings
    for own in every:
        own["z"] = np.round(own["z"], count_places(scene)).tolist()
    for own in cells:
        own["wide"] = True
    low, high = ([1e3 * float(chart.x[k]), math.degrees(chart.phi[k])] for k in (0, -1))
    axes = {"low": low, "high": high, "box": BOX, "tall": SHEET[1]}
    places = {"hand": describe_hand(scene), "places": every, "axes": axes}
    return Chart(drawing, draw_legend(chart, bool(paths)), places)


def _describe(contacts: Iterable[Contact], text: str, z: Array) -> dict[str, Any]:
    names = [contact.name for contact in contacts]
    return {"contacts": names, "text": text, "z": z}


def _name_place(point: Array) -> str:
    x, phi = point
    return f"x = {1e3 * x:.2f} mm, phi = {math.degrees(phi):.2f} deg"


def _describe_cell(point: Array) -> str:
    return f"a cell, two freedoms; its middle is at {_name_place(point)}"


def _describe_border(border: Border, times: Array) -> str:
    """Where a border runs, and what motions along it are possible each way."""
    ways = zip(("increasing", "decreasing"), (border.forth, border.back), times, strict=True)
    possible = [
        f"{border.along} {way}: {_name_time(time)}, slow motions {_name_share(share.mean())}"
        for way, share, time in ways
    ]
    (x, phi), (x_end, phi_end) = border.points[0], border.points[-1]
    return (
        f"a border, one freedom, x {1e3 * x:.1f} to {1e3 * x_end:.1f} mm, phi "
        f"{math.degrees(phi):.1f} to {math.degrees(phi_end):.1f} deg; {'; '.join(possible)}"
    )


def _name_share(share: float) -> str:
    """Where along a border slow motions are possible."""
    return "all along" if share == 1 else "on parts" if share > 0 else "nowhere"


def _name_time(time: float) -> str:
    """How long the fastest motion from one end to the other takes."""
    return f"least time about {time:.3f} s" if math.isfinite(time) else "no motion from end to end"


def _describe_crossing(crossing: Crossing) -> str:
    return f"a crossing at {_name_place(crossing.point)}"
