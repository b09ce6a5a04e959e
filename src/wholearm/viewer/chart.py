"""The map of contact formations as SVG, with the cells, borders and crossings to click."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from html import escape
from typing import Any, NamedTuple

import numpy as np

from ..common.arrays import Array
from ..common.sharing import exclusive
from ..contacts.closing import Flags, close_fingers
from ..contacts.elemental import Contact
from ..figures.map_lines import (
    AMBIGUOUS,
    BACK,
    CROSSED_LOOK,
    FORTH,
    FREE,
    INK,
    LINE,
    LOST,
    TINTS,
    UNREACHED,
    choose_tints,
    find_middle,
    find_room,
    find_runs,
    name_palm_lines,
    place_discs,
    place_heads,
    shift,
    shorten,
    split,
    trace_plan,
)
from ..mapping.formation_list import trace_problem
from ..mapping.formation_map import CROSSED, Border, FormationMap
from ..results.trajectory import Trajectory
from ..search.times import time_borders
from .motion_data import count_places, describe_hand

SHEET = (1000.0, 620.0)
"""Width and height of the drawing, in its own units; texts are 11 of these high."""
BOX = (58.0, 44.0, 868.0, 566.0)  # the axes: left, bottom, width, height
_ASIDE = 3.0  # offset of directed lines from the border
_ARROW = 8.0  # length of the arrows inside cells
_LETTER, _HEIGHT = 6.2, 13.0  # size of a letter of a label
_DISC = 18.0  # room for the number of a phase
_CLEAR = 9.0  # distance of labels from the plan
_MOST = 40  # points of a line that is clicked; more cannot be told apart


class MapChart(NamedTuple):
    """A map in a page."""

    drawing: str  # drawing, legend: SVG, and the HTML of what it means
    legend: str
    # under "hand" the hand and the object; under "places", in the order in which the drawing has
    # them, for each thing that can be clicked its `contacts`, a `text` and its poses `z`; under
    # "axes" where the drawing has which x [mm] and phi [deg]
    places: dict[str, Any]


@exclusive
def describe_map(chart: FormationMap, plan: Trajectory | None = None) -> MapChart:
    """Draw a map with a plan, or the problem's own phases, and list what can be clicked on it."""
    scene = chart.problem.scene
    paths = trace_problem(chart.problem) if plan is None else trace_plan(plan)
    parts = list(split(chart.cell))
    step = np.array([np.ptp(chart.phi) / len(chart.phi), np.ptp(chart.x) / len(chart.x)])
    rooms = [find_room(region, step / np.ptp(chart.x)) for _, region in parts]
    middles = np.array([[chart.x[column], chart.phi[row]] for row, column, _ in rooms])
    poses = close_fingers(scene, *middles.T).z
    cells = [
        _describe(
            chart.formations[index],
            f"a cell, two freedoms; its middle is at {_name_place(point)}",
            z[None],
        )
        for (index, _), point, z in zip(parts, middles, poses, strict=True)
    ]
    held = [border for border in chart.borders if border.flush is not None]
    counts = [len(border.points) for border in held]
    few = [np.unique(np.linspace(0, n - 1, _MOST).round().astype(int)) for n in counts]
    times = time_borders(chart.problem, held)
    borders = [
        _describe(border.contacts, _describe_border(border, own), border.z[rows])
        for border, own, rows in zip(held, times, few, strict=True)
    ]
    crossings = [
        _describe(
            crossing.contacts, f"a crossing at {_name_place(crossing.point)}", crossing.z[None]
        )
        for crossing in chart.crossings
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
    return MapChart(drawing, draw_legend(chart, bool(paths)), places)


def _describe(contacts: Iterable[Contact], text: str, z: Array) -> dict[str, Any]:
    names = [contact.name for contact in contacts]
    return {"contacts": names, "text": text, "z": z}


def _name_place(point: Array) -> str:
    x, phi = point
    return f"x = {1e3 * x:.2f} mm, phi = {math.degrees(phi):.2f} deg"


def _describe_border(border: Border, times: Array) -> str:
    """Where a border runs, and what motions along it are possible each way."""
    ways = zip(("increasing", "decreasing"), (border.forth, border.back), times, strict=True)
    possible = []
    for way, flags, time in ways:
        where = "all along" if flags.all() else "on parts" if flags.any() else "nowhere"
        possible.append(f"{border.along} {way}: {_name_time(time)}, slow motions {where}")
    (x, phi), (x_end, phi_end) = border.points[0], border.points[-1]
    return (
        f"a border, one freedom, x {1e3 * x:.1f} to {1e3 * x_end:.1f} mm, phi "
        f"{math.degrees(phi):.1f} to {math.degrees(phi_end):.1f} deg; {'; '.join(possible)}"
    )


def _name_time(time: float) -> str:
    """How long the fastest motion from one end to the other takes."""
    return f"least time about {time:.3f} s" if math.isfinite(time) else "no motion from end to end"


def draw_map(
    chart: FormationMap,
    paths: Sequence[Array],
    parts: Sequence[tuple[int, Flags]],
    lines: Sequence[Array],
    points: Array,
) -> str:
    """Draw a map.

    Parameters
    ----------
    paths : (n, 2) [m, rad]   the plan's, by phase
    parts                     what can be clicked: parts of cells, each with its formation, on the
                              chart's grid;
    lines : (n, 2) [m, rad]   then borders,
    points : (n, 2) [m, rad]  and crossings. These have the class "hit" and stand in this order.
    """
    corners = np.array([[chart.x[0], chart.phi[0]], [chart.x[-1], chart.phi[-1]]])
    paper = Paper(*np.column_stack([1e3 * corners[:, 0], np.degrees(corners[:, 1])]))
    left, bottom, width, height = BOX
    clip = f'<rect x="{left}" y="{SHEET[1] - bottom - height}" width="{width}" height="{height}"'
    return "".join(
        [
            f'<svg viewBox="0 0 {SHEET[0]:.0f} {SHEET[1]:.0f}" role="img" '
            'aria-label="map of contact formations">',
            f'<defs>{_hatch("lost", LOST)}{_hatch("crossed", CROSSED_LOOK)}<clipPath id="axes">',
            f'{clip}/></clipPath></defs><g clip-path="url(#axes)">',
            *_draw_cells(chart, paper, parts),
            *_draw_directions(chart, paper),
            *_draw_borders(chart, paper),
            *_draw_paths(paper, paths),
            *_write_labels(chart, paper, paths, parts),
            *(f'<polyline class="hit" points="{_join(paper.place(line))}"/>' for line in lines),
            *(
                f'<circle class="hit" cx="{x:.1f}" cy="{SHEET[1] - y:.1f}" r="3.4" fill="{INK}"/>'
                for x, y in paper.place(points)
            ),
            *_number_paths(paper, paths),
            f'</g>{clip} fill="none" stroke="{INK}" stroke-width="0.8"/>',
            *_draw_axes(chart, paper),
            "</svg>",
        ]
    )


def draw_legend(chart: FormationMap, with_path: bool) -> str:
    """What lines and colours of a map mean."""
    arrow = '<path d="M20 1l6 4l-6 4z" stroke="none" fill="{0}"/>'
    entries = [
        (f"{_swatch(FORTH)}{arrow.format(FORTH)}", "slow motion possible, +x or +\u03c6"),
        (f"{_swatch(BACK)}{arrow.format(BACK)}", "possible, \u2212x or \u2212\u03c6"),
        (_swatch(LINE), "border: an edge flush, four contacts"),
        (_swatch(LINE, dashes="2 3"), "the side of a link gives way to its tip"),
        (f'<circle cx="13" cy="5" r="3" fill="{INK}"/>', "crossing: five contacts"),
        (_swatch(FREE) + arrow.format(FREE), "possible ways inside a cell"),
        ('<rect width="26" height="10" fill="url(#lost)"/>', "cannot be reached"),
    ]
    if (chart.cell == CROSSED).any():
        entries.append(('<rect width="26" height="10" fill="url(#crossed)"/>', "fingers overlap"))
    if chart.ambiguous.any() or any(border.ambiguous.any() for border in chart.borders):
        text = "contact forces would not be unique"
        entries.append((_swatch(AMBIGUOUS, dashes="3 3"), text))
    if with_path:
        entries.append((_swatch(INK, width=6, more=' opacity="0.4"'), "plan, by phase"))
    items = (f'<span><svg viewBox="0 0 26 10">{own}</svg> {text}</span>' for own, text in entries)
    note = "cells: what touches the palm | finger 1 (right) | finger 2 (left); "
    note += "v vertex, e edge touched by the tip, * vertex on the tip's arc"
    return f'<div class="legend">{"".join(items)}<span>{note}</span></div>'


def _swatch(colour: str, width: float = 2.0, dashes: str = "", more: str = "") -> str:
    dashed = f' stroke-dasharray="{dashes}"' if dashes else ""
    return f'<path d="M0 5h26" stroke="{colour}" stroke-width="{width}"{dashed}{more}/>'


def _hatch(name: str, look: tuple[str, str, str]) -> str:
    face, edge, hatch = look
    way = 45 if hatch.startswith("/") else -45
    return (
        f'<pattern id="{name}" width="6" height="6" patternUnits="userSpaceOnUse" '
        f'patternTransform="rotate({way})"><rect width="6" height="6" fill="{face}"/>'
        f'<path d="M0 0v6" stroke="{edge}" stroke-width="2"/></pattern>'
    )


def _grid(chart: FormationMap, paper: Paper) -> tuple[Array, Array]:
    """Places of the columns and rows of the chart's grid."""
    x = paper.place(np.column_stack([chart.x, np.zeros_like(chart.x)]))[:, 0]
    y = paper.place(np.column_stack([np.zeros_like(chart.phi), chart.phi]))[:, 1]
    return x, y


def _draw_cells(
    chart: FormationMap, paper: Paper, parts: Sequence[tuple[int, Flags]]
) -> Iterable[str]:
    x, y = _grid(chart, paper)
    tints = choose_tints(chart.cell, len(TINTS))
    for index, region in parts:
        colour = TINTS[tints[index]]
        yield f'<path class="hit cell" fill="{colour}" d="{write_region(region, x, y)}"/>'
    lost = (chart.cell < 0) & (chart.cell != CROSSED)
    for name, region in (("lost", lost), ("crossed", chart.cell == CROSSED)):
        if region.any():
            yield f'<path fill="url(#{name})" d="{write_region(region, x, y)}"/>'


def _draw_directions(chart: FormationMap, paper: Paper) -> Iterable[str]:
    """Small arrows towards which a quasistatic motion inside a cell is possible."""
    places, lines = paper.place(chart.places), []
    for k, way in enumerate(np.array([[1.0, 0.0], [-1.0, 0.0], [0.0, 1.0], [0.0, -1.0]])):
        aside = way[::-1]
        for place in places[chart.possible[:, k]]:
            end = place + (1.5 + _ARROW) * way
            barbs = [end - 3.0 * way + side * 2.0 * aside for side in (1.0, -1.0)]
            lines += [np.array([place + 1.5 * way, end]), np.array([barbs[0], end, barbs[1]])]
    yield f'<path fill="none" stroke="{FREE}" d="{write_path(lines)}"/>'
    cross = 2.5 * np.array([[[1.0, 1.0], [-1.0, -1.0]], [[1.0, -1.0], [-1.0, 1.0]]])
    lines = [own + place for place in places[chart.ambiguous] for own in cross]
    yield f'<path fill="none" stroke="{AMBIGUOUS}" d="{write_path(lines)}"/>'


def _draw_borders(chart: FormationMap, paper: Paper) -> Iterable[str]:
    line = '<path fill="none" stroke="{}" stroke-width="{}"{} d="{}"/>'
    passing = [paper.place(own.points) for own in chart.borders if own.flush is None]
    yield line.format(LINE, 0.8, ' stroke-dasharray="1 2"', write_path(passing))
    flush = [own for own in chart.borders if own.flush is not None]
    every = [paper.place(own.points) for own in flush]
    yield line.format(LINE, 1.0, "", write_path(every))
    for colour, way, name in ((FORTH, 1.0, "forth"), (BACK, -1.0, "back")):
        strips = [
            shift(points[run], way * _ASIDE)
            for border, points in zip(flush, every, strict=True)
            for run in find_runs(getattr(border, name))
        ]
        yield line.format(colour, 1.5, "", write_path(strips))
        heads = [head for strip in strips for head in place_heads(strip, way)]
        yield f'<path fill="{colour}" d="{write_path(heads, closed=True)}"/>'
    runs = [
        points[run]
        for border, points in zip(flush, every, strict=True)
        for run in find_runs(border.ambiguous)
    ]
    yield line.format(AMBIGUOUS, 2.4, ' stroke-dasharray="2 3"', write_path(runs))


def _draw_paths(paper: Paper, paths: Sequence[Array]) -> Iterable[str]:
    look = f'stroke="{INK}" stroke-width="6" stroke-linecap="round" opacity="0.4"'
    for own in paths:
        yield f'<path fill="none" {look} d="{write_path([paper.place(own)])}"/>'


def _number_paths(paper: Paper, paths: Sequence[Array]) -> Iterable[str]:
    lines = [paper.place(path) for path in paths]
    corners = np.array([BOX[:2], np.add(BOX[:2], BOX[2:])])
    places = place_discs(lines, _DISC, *corners)
    for number, (own, (x, y)) in enumerate(zip(lines, places, strict=True), start=1):
        leader = np.array([find_middle(own), [x, y]])
        yield f'<path stroke="{INK}" d="{write_path([leader])}"/>'
        yield f'<circle cx="{x:.1f}" cy="{SHEET[1] - y:.1f}" r="8" class="disc"/>'
        yield write_text(str(number), (x, y - 4), ' class="number"')


def _write_labels(
    chart: FormationMap, paper: Paper, paths: Sequence[Array], parts: Sequence[tuple[int, Flags]]
) -> Iterable[str]:
    x, y = _grid(chart, paper)
    clear = np.ones(chart.cell.shape, dtype=bool)
    for own in map(paper.place, paths):
        far = np.subtract.outer(x, own[:, 0])[None] ** 2
        far = far + np.subtract.outer(y, own[:, 1])[:, None] ** 2
        clear &= far.min(axis=2) > _CLEAR**2
    named = [(" | ".join(map(shorten, chart.formations[k])), "", own) for k, own in parts]
    lost = [(text, " lost", chart.cell == code) for text, code in UNREACHED.items()]
    for text, look, region in named + lost:
        free = region & clear
        half = np.array([_HEIGHT / 2 + 2.0, _LETTER * len(text) / 2 + 1.0])
        if not free.any():
            continue
        row, column, room = find_room(free, np.array([y[1] - y[0], x[1] - x[0]]) / half)
        if room >= 1.15:
            yield write_text(text, (x[column], y[row] - 4.0), f' class="name{look}"')


def _draw_axes(chart: FormationMap, paper: Paper) -> Iterable[str]:
    left, bottom, width, height = BOX
    ticks = []
    for value in choose_ticks(paper.low[0], paper.high[0], 9):
        place = left + (value - paper.low[0]) * paper.scale[0]
        yield write_text(f"{value:g}", (place, bottom - 15), ' text-anchor="middle"')
        ticks.append(np.array([[place, bottom], [place, bottom - 4.0]]))
    for value in choose_ticks(paper.low[1], paper.high[1], 9):
        place = bottom + (value - paper.low[1]) * paper.scale[1]
        yield write_text(f"{value:g}", (left - 7, place - 4), ' text-anchor="end"')
        ticks.append(np.array([[left, place], [left - 4.0, place]]))
    yield f'<path stroke="{INK}" d="{write_path(ticks)}"/>'
    middle = (left + width / 2, bottom - 33)
    yield write_text("x of the centroid [mm]", middle, ' text-anchor="middle"')
    x, y = 12, SHEET[1] - bottom - height / 2
    yield f'<text x="{x}" y="{y}" transform="rotate(-90 {x} {y})" text-anchor="middle">'
    yield "orientation \u03c6 [deg]</text>"
    for angle, edge in name_palm_lines(chart.borders).items():
        place = float(paper.place(np.array([[0.0, angle]]))[0, 1])
        if bottom <= place <= bottom + height:
            yield write_text(f"edge {edge} on", (left + width + 5, place + 2))
            yield write_text("the palm", (left + width + 5, place - 10))


class Paper(NamedTuple):
    """What part of the plane the axes show."""

    low: Array  # low, high (2,) [mm, deg]:
    high: Array

    @property
    def scale(self) -> Array:
        """Units of the drawing per mm and per deg, shape (2,)."""
        return np.array(BOX[2:]) / (self.high - self.low)

    def place(self, points: Array) -> Array:
        """Places, shape (n, 2), of points (x, phi) [m, rad], the second coordinate upwards."""
        values = np.column_stack([1e3 * points[:, 0], np.degrees(points[:, 1])])
        return np.asarray(np.array(BOX[:2]) + (values - self.low) * self.scale)


def turn(points: Array) -> Array:
    """The same places with the second coordinate downwards, as SVG has it."""
    return np.column_stack([points[:, 0], SHEET[1] - points[:, 1]])


def write_path(lines: Iterable[Array], closed: bool = False) -> str:
    """What a path of polylines, each of shape (n, 2), draws."""
    return "".join(f"M{_join(line)}{'z' if closed else ''}" for line in lines)


def write_text(text: str, place: Iterable[float], look: str = "") -> str:
    """A text at a place, the second coordinate upwards."""
    x, y = place
    return f'<text x="{x:.1f}" y="{SHEET[1] - y:.1f}"{look}>{escape(text)}</text>'


def write_region(region: Flags, x: Array, y: Array) -> str:
    """The path around the places of a grid in a region, row by row; `x` and `y` are even."""
    step, height = x[1] - x[0], y[1] - y[0]
    edges = np.diff(np.pad(region.astype(int), ((0, 0), (1, 1))), axis=1)
    (rows, starts), stops = np.nonzero(edges == 1), np.nonzero(edges == -1)[1]
    lefts, widths = x[0] + (starts - 0.5) * step, (stops - starts) * step
    return "".join(
        f"M{left:.1f} {SHEET[1] - y[row] - height / 2:.1f}h{width:.1f}v{height:.1f}h{-width:.1f}z"
        for row, left, width in zip(rows.tolist(), lefts.tolist(), widths.tolist(), strict=True)
    )


def choose_ticks(low: float, high: float, most: int) -> list[float]:
    """Round values between two, at most so many."""
    power = 10.0 ** math.floor(math.log10((high - low) / most))
    step = next(k * power for k in (1, 2, 5, 10) if k * power * most >= high - low)
    return [k * step for k in range(math.ceil(low / step), math.floor(high / step) + 1)]


def _join(line: Array) -> str:
    return " ".join(f"{x:.1f},{y:.1f}" for x, y in turn(line).tolist())
