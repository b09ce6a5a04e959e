"""The contact-formation map as a figure; nothing is shown and no global state is touched."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.colors import ListedColormap
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.patheffects import withStroke

from ..common.arrays import Array
from ..common.sharing import exclusive
from ..contacts.closing import Flags
from ..mapping.formation_list import trace_problem
from ..mapping.formation_map import CROSSED, Border, FormationMap
from ..results.adopt import Moved, adopt_motion
from ..results.trajectory import Trajectory
from .map_lines import (
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
from .style import STYLE, write_title

SIZE = (11.0, 7.9)  # in
_BOX = (0.75, 1.0, 9.4, 6.2)  # axes: left, bottom, width, height [in]
_ASIDE = 2.6  # offset of directed lines from the border [points]
_ARROW = 8.0  # length of the arrows inside cells [points]
_DISC = 16.0  # room for the number of a phase [points]
_LETTER, _HEIGHT = 4.4, 9.0  # size of a letter of a label [points]


@exclusive
def draw_map(chart: FormationMap, plan: Trajectory | Moved | None = None) -> Figure:
    """Draw a contact-formation map.

    Parameters
    ----------
    plan  its path is drawn over the map, phase by phase; by default that of the problem's own
          phases, as far as geometry alone gives it

    Returns
    -------
    Figure  with one axes: x [mm] and phi [deg]
    """
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=SIZE)
        FigureCanvasAgg(figure)
        left, bottom, width, height = _BOX
        place: Any = (left / SIZE[0], bottom / SIZE[1], width / SIZE[0], height / SIZE[1])
        axes = figure.add_axes(place)
        x, phi = 1e3 * chart.x, np.degrees(chart.phi)
        axes.set(xlim=(x[0], x[-1]), ylim=(phi[0], phi[-1]))
        axes.set(xlabel="$x$ of the centroid [mm]", ylabel=r"orientation $\phi$ [deg]")
        _draw_cells(axes, chart, x, phi)
        path = None if plan is None else adopt_motion(chart.problem, plan)[1]
        paths = trace_problem(chart.problem) if path is None else trace_plan(path)
        boxes = _draw_labels(axes, chart, x, phi, paths)
        _draw_directions(axes, chart, boxes)
        _draw_borders(axes, chart.borders)
        flush = [c for c in chart.crossings if len(c.flush) >= 2]
        points = _to_axes(np.array([c.point for c in flush]).reshape(-1, 2))
        axes.plot(*points.T, "o", ms=3.6, mfc=INK, mec="white", mew=0.5, zorder=6, ls="none")
        _draw_paths(axes, paths)
        ambiguous = chart.ambiguous.any() or any(border.ambiguous.any() for border in chart.borders)
        _draw_legend(figure, bool(paths), bool((chart.cell == CROSSED).any()), bool(ambiguous))
        _name_palm_lines(axes, chart)
        problem = chart.problem
        limits = " and ".join(dict.fromkeys(f"{v:g}" for v in problem.scene.torque_limit))
        title = f"{problem.name}  \u00b7  contact formations with palm and both fingers touching"
        text = f"{title}  \u00b7  \u03b5 = {problem.epsilon:g} N, |\u03c4| \u2264 {limits} N m"
        write_title(figure, text)
    return figure


def _to_axes(points: Array) -> Array:
    """From m and rad to the units of the axes, mm and deg."""
    return np.column_stack([1e3 * points[:, 0], np.degrees(points[:, 1])])


def _points_per_unit(axes: Axes) -> Array:
    """Printer's points per mm and per deg."""
    spans = [np.ptp(axes.get_xlim()), np.ptp(axes.get_ylim())]
    return np.asarray(72.0 * np.array(_BOX[2:]) / np.array(spans))


def _draw_cells(axes: Axes, chart: FormationMap, x: Array, phi: Array) -> None:
    tints = choose_tints(chart.cell, len(TINTS))
    shown = np.where(chart.cell >= 0, tints[chart.cell], -1)
    look: Any = {"shading": "nearest", "rasterized": True, "zorder": 0}
    shown = np.ma.masked_less(shown, 0)
    axes.pcolormesh(x, phi, shown, cmap=ListedColormap(TINTS), vmin=0, vmax=len(TINTS), **look)
    crossed = chart.cell == CROSSED
    for region, (face, edge, hatch) in (
        ((chart.cell < 0) & ~crossed, LOST),
        (crossed, CROSSED_LOOK),
    ):
        if region.any():
            field = axes.contourf(
                x, phi, region.astype(float), [0.5, 1.5], colors=[face], hatches=[hatch], zorder=0.5
            )
            field.set(edgecolor=edge, linewidth=0.0)
    for name, code in UNREACHED.items():
        if (chart.cell == code).any():
            _write_inside(axes, name, chart.cell == code, x, phi, color="#666666", italic=True)


def _draw_directions(axes: Axes, chart: FormationMap, boxes: Sequence[Array]) -> None:
    """Small arrows towards which a quasistatic motion inside a cell is possible."""
    places = _to_axes(chart.places)
    free = np.ones(len(places), dtype=bool)
    for low, high in boxes:
        free &= ~((places > low) & (places < high)).all(axis=1)
    places, possible = places[free], chart.possible[free]
    ways = np.array([[1.0, 0.0], [-1.0, 0.0], [0.0, 1.0], [0.0, -1.0]])
    for k, way in enumerate(ways):
        mine = places[possible[:, k]]
        gap = 1.2 * way / _points_per_unit(axes)
        look: Any = {"units": "inches", "scale_units": "inches", "scale": 72 / _ARROW, "zorder": 2}
        look |= {"width": 0.95 / 72, "headwidth": 4.2, "headlength": 4.2, "headaxislength": 3.8}
        u, v = np.broadcast_to(way[:, None], (2, len(mine)))
        axes.quiver(*(mine + gap).T, u, v, color=FREE, **look)
    axes.plot(*places[chart.ambiguous[free]].T, "x", ms=3.5, color=AMBIGUOUS, zorder=2)


def _draw_borders(axes: Axes, borders: Sequence[Border]) -> None:
    scale = _points_per_unit(axes)
    passing = [_to_axes(b.points) for b in borders if b.flush is None]
    flush = [b for b in borders if b.flush is not None]
    lines = LineCollection(passing, colors=LINE, linewidths=0.7, linestyles=(0, (1, 1.6)), zorder=3)
    axes.add_collection(lines)
    every = [_to_axes(b.points) for b in flush]
    axes.add_collection(LineCollection(every, colors=LINE, linewidths=0.9, zorder=3))
    for colour, way, name in ((FORTH, 1.0, "forth"), (BACK, -1.0, "back")):
        strips = [
            shift((points * scale)[run], way * _ASIDE)
            for border, points in zip(flush, every, strict=True)
            for run in find_runs(getattr(border, name))
        ]
        lines = LineCollection(
            [strip / scale for strip in strips], colors=colour, linewidths=1.3, zorder=4
        )
        axes.add_collection(lines)
        heads = [head / scale for strip in strips for head in place_heads(strip, way)]
        axes.add_collection(PolyCollection(heads, facecolors=colour, linewidths=0, zorder=5))
    runs = [
        points[run]
        for border, points in zip(flush, every, strict=True)
        for run in find_runs(border.ambiguous)
    ]
    dots: Any = {"linestyles": (0, (1.5, 1.5)), "linewidths": 2.2, "zorder": 4}
    axes.add_collection(LineCollection(runs, colors=AMBIGUOUS, **dots))


def _draw_labels(
    axes: Axes, chart: FormationMap, x: Array, phi: Array, paths: Sequence[Array]
) -> list[Array]:
    """Name the cells; returns the corners (low, high) of what was written over, each (2, 2)."""
    boxes = []
    cell, scale = chart.cell.copy(), _points_per_unit(axes)
    for points in map(_to_axes, paths):
        # Labels keep clear of the plan and the numbers on it.
        far = (np.subtract.outer(x, points[:, 0]) * scale[0])[None] ** 2
        far = far + (np.subtract.outer(phi, points[:, 1]) * scale[1])[:, None] ** 2
        cell[far.min(axis=2) < 8.0**2] = -9
    for index, region in split(cell):
        text = " | ".join(map(shorten, chart.formations[index]))
        box = _write_inside(axes, text, region, x, phi)
        boxes += [] if box is None else [box]
    return boxes


def _write_inside(
    axes: Axes,
    text: str,
    region: Flags,
    x: Array,
    phi: Array,
    color: str = INK,
    italic: bool = False,
) -> Array | None:
    """Write in the widest place of a region, if there is room; returns the text's corners."""
    scale = _points_per_unit(axes)
    step = np.array([phi[1] - phi[0], x[1] - x[0]]) * scale[::-1]
    flat = np.array([_HEIGHT / 2 + 2.0, _LETTER * len(text) / 2 + 1.0])
    # Measured in half labels, the room around a place is the largest label that fits.
    tried = ((find_room(region, step / half), half, turn) for half, turn in _turn(flat))
    found = next((own for own in tried if own[0][2] >= 1.15), None)
    if found is None:
        return None
    (row, column, _), half, turn = found
    look: Any = {"ha": "center", "va": "center", "fontsize": 7.6, "color": color, "zorder": 7}
    look |= {"path_effects": [withStroke(linewidth=2.2, foreground="white")]}
    look |= {"style": "italic" if italic else "normal", "rotation": turn}
    axes.text(x[column], phi[row], text, **look)
    place, size = np.array([x[column], phi[row]]), (half[::-1] + 3.0) / scale
    return np.stack([place - size, place + size])


def _turn(half: Array) -> tuple[tuple[Array, float], tuple[Array, float]]:
    """Half of a label as it is, and upright, with the angle [deg]: cells of discs are narrow."""
    return (half, 0.0), (half[::-1], 90.0)


def _draw_paths(axes: Axes, paths: Sequence[Array]) -> None:
    scale, every = _points_per_unit(axes), [_to_axes(path) for path in paths]
    corners = scale * np.array([axes.get_xlim(), axes.get_ylim()]).T
    places = place_discs([points * scale for points in every], _DISC, *corners) / scale
    for number, (points, middle) in enumerate(zip(every, places, strict=True), start=1):
        axes.plot(*points.T, color=INK, lw=5.0, alpha=0.42, solid_capstyle="round", zorder=3.5)
        ends = np.array([find_middle(points * scale) / scale, middle])
        axes.plot(*ends.T, color=INK, lw=0.8, zorder=8.5)
        look: Any = {"ha": "center", "va": "center", "fontsize": 8.0, "color": "white"}
        look |= {"fontweight": "bold", "zorder": 9}
        look["bbox"] = {"boxstyle": "circle,pad=0.22", "fc": INK, "ec": "white", "lw": 0.8}
        axes.text(float(middle[0]), float(middle[1]), str(number), **look)


def _name_palm_lines(axes: Axes, chart: FormationMap) -> None:
    right = axes.get_xlim()[1]
    look: Any = {"va": "center", "fontsize": 7.6}
    for angle, edge in name_palm_lines(chart.borders).items():
        place, text = (right, np.degrees(angle)), f"edge {edge} on\nthe palm"
        axes.annotate(text, place, (4, 0), textcoords="offset points", **look)


def _patch(look: tuple[str, str, str], label: str) -> Patch:
    face, edge, hatch = look
    return Patch(fc=face, ec=edge, hatch=hatch, lw=0, label=label)


def _draw_legend(figure: Figure, with_path: bool, crossed: bool, ambiguous: bool) -> None:
    arrow: Any = {"marker": ">", "ms": 5, "lw": 1.4}
    line = partial(Line2D, [], [])
    handles: list[Any] = [
        line(color=FORTH, label="quasistatic motion possible, +x or +\u03c6", **arrow),
        line(color=BACK, label="possible, \u2212x or \u2212\u03c6", **arrow),
        line(color=LINE, lw=0.9, label="border: an edge flush, four contacts"),
        line(color=LINE, lw=0.7, ls=(0, (1, 1.6)), label="side of the link gives way to its tip"),
        line(color=INK, marker="o", ms=4, ls="none", label="crossing: five contacts"),
        line(color=FREE, marker="$\u2194$", ms=8, ls="none", label="possible ways inside a cell"),
        _patch(LOST, "cannot be reached"),
    ]
    if crossed:
        handles.append(_patch(CROSSED_LOOK, "the fingers would overlap"))
    if ambiguous:
        look: Any = {"marker": "x", "ms": 4, "lw": 2.2, "ls": (0, (1.5, 1.5))}
        handles.append(line(color=AMBIGUOUS, label="contact forces would not be unique", **look))
    if with_path:
        handles.insert(6, line(color=INK, lw=5, alpha=0.42, label="plan, by phase"))
    note = (
        "Cells: what touches the palm | finger 1 (right) | finger 2 (left); "
        "v vertex, e edge touched by the tip, * vertex on the tip's arc"
    )
    figure.text(0.2 / SIZE[0], 1 - 0.38 / SIZE[1], note, va="top", fontsize=8.5)
    figure.legend(
        handles=handles, loc="lower center", ncols=4, bbox_to_anchor=(0.5, 0.004), fontsize=8.0
    )
