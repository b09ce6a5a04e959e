"""The map of contact formations as a drawing in a page."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np

from ..common.arrays import Array
from ..contacts.closing import Flags
from ..figures.map_lines import (
    find_middle,
    name_palm_lines,
    place_discs,
    place_heads,
    shift,
    shorten,
)
from ..figures.map_style import (
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
)
from ..figures.regions import choose_tints, find_room, find_runs
from ..mapping.formation_map import CROSSED, FormationMap
from .paper import BOX, SHEET, Paper, choose_ticks, write_line, write_path, write_region, write_text

_ASIDE = 3.0
"""Offset of directed lines from the border."""
_ARROW = 8.0
"""Length of the arrows inside cells."""
_LETTER, _HEIGHT = 6.2, 13.0
"""Size of a letter of a label."""
_DISC = 18.0
"""Room for the number of a phase."""
_CLEAR = 9.0
"""Distance of labels from the plan."""


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
    chart : FormationMap
    paths : sequence of ndarray, shape (n, 2), [m, rad]
        The plan's, by phase.
    parts : sequence of (int, ndarray of bool)
        What can be clicked: parts of cells, each with its formation, on the chart's grid;
    lines : sequence of ndarray, shape (n, 2), [m, rad]
        then borders,
    points : ndarray, shape (n, 2), [m, rad]
        and crossings. These have the class "hit" and stand in this order.
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
            *(f'<polyline class="hit" points="{write_line(paper.place(own))}"/>' for own in lines),
            *_draw_crossings(paper, points),
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
    if chart.ambiguous.any() or any(own.ambiguous.any() for own in chart.borders):
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
    lines = [paper.place(own) for own in paths]
    corners = np.array([BOX[:2], np.add(BOX[:2], BOX[2:])])
    places = place_discs(lines, _DISC, *corners)
    for number, (own, (x, y)) in enumerate(zip(lines, places, strict=True), start=1):
        leader = np.array([find_middle(own), [x, y]])
        yield f'<path stroke="{INK}" d="{write_path([leader])}"/>'
        yield f'<circle cx="{x:.1f}" cy="{SHEET[1] - y:.1f}" r="8" class="disc"/>'
        yield write_text(str(number), (x, y - 4), ' class="number"')


def _write_labels(
    chart: FormationMap,
    paper: Paper,
    paths: Sequence[Array],
    parts: Sequence[tuple[int, Flags]],
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


def _draw_crossings(paper: Paper, points: Array) -> Iterable[str]:
    for x, y in paper.place(points):
        yield f'<circle class="hit" cx="{x:.1f}" cy="{SHEET[1] - y:.1f}" r="3.4" fill="{INK}"/>'


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
