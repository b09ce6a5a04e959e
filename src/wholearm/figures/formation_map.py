"""The contact-formation map as a figure; nothing is shown and no global state is touched."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import LineCollection
from matplotlib.colors import ListedColormap
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.patheffects import withStroke
from scipy import ndimage

from ..common.arrays import Array
from ..common.sharing import exclusive
from ..contacts.closing import Flags, Numbers
from ..contacts.elemental import Contact
from ..mapping.formation_map import CROSSED, Border, FormationMap
from ..mapping.route import trace_problem
from ..results.trajectory import Trajectory
from .style import STYLE

SIZE = (11.0, 7.9)  # in
_BOX = (0.75, 1.0, 9.4, 6.2)  # axes: left, bottom, width, height [in]
_INK, _LINE, _FAINT = "#222222", "#9aa1ab", "#c3c8d0"
_LOST = ("#ececec", "#b8b8b8", "////")  # face, lines and hatch
_AMBIGUOUS = "#AA3377"
_CROSSED = ("#f6e3ee", "#CC79A7", "\\\\\\\\")
_UNREACHED = {
    "finger 1 too short": -1,
    "finger 2 too short": -2,
    "joint 1 in or above the object": -3,
    "joint 2 in or above the object": -4,
    "fingers overlap": CROSSED,
}
_FORTH, _BACK, _FREE = "#0072B2", "#D55E00", "#7a838f"
_TINTS = ("#f3f6fb", "#fbf6ea", "#eef7f0", "#f9eff4", "#f4f1fb", "#eef6f8", "#f7f7ee")
_ASIDE = 2.6
"""Offset of directed lines from the border [points]."""
_SPACING = 42.0
"""Distance between arrow heads on a directed line [points]."""
_ARROW = 8.0
"""Length of the arrows inside cells [points]."""
_LETTER, _HEIGHT = 4.4, 9.0
"""Size of a letter of a label [points]."""


@exclusive
def draw_map(chart: FormationMap, plan: Trajectory | None = None) -> Figure:
    """Draw a contact-formation map.

    Parameters
    ----------
    chart : FormationMap
    plan : Trajectory, optional
        Its path is drawn over the map, phase by phase; by default that of the problem's own
        phases, as far as geometry alone gives it.

    Returns
    -------
    Figure
        With one axes: x [mm] and phi [deg].
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
        paths = trace_problem(chart.problem) if plan is None else trace_plan(plan)
        boxes = _draw_labels(axes, chart, x, phi, paths)
        _draw_directions(axes, chart, boxes)
        _draw_borders(axes, chart.borders)
        flush = [c for c in chart.crossings if len(c.flush) >= 2]
        points = _to_axes(np.array([c.point for c in flush]).reshape(-1, 2))
        axes.plot(*points.T, "o", ms=3.6, mfc=_INK, mec="white", mew=0.5, zorder=6, ls="none")
        _draw_paths(axes, paths)
        _draw_legend(figure, bool(paths), bool((chart.cell == CROSSED).any()), _is_ambiguous(chart))
        _name_palm_lines(axes, chart)
        problem = chart.problem
        limits = " and ".join(dict.fromkeys(f"{v:g}" for v in problem.scene.torque_limit))
        title = f"{problem.name}  \u00b7  contact formations with palm and both fingers touching"
        text = f"{title}  \u00b7  \u03b5 = {problem.epsilon:g} N, |\u03c4| \u2264 {limits} N m"
        look: Any = {"fontsize": 10.5, "fontweight": "bold", "parse_math": False}
        figure.text(0.2 / SIZE[0], 1 - 0.12 / SIZE[1], text, va="top", **look)
    return figure


def trace_plan(plan: Trajectory) -> list[Array]:
    """Path of each phase of a trajectory, (n, 2) [m, rad]."""
    return [plan.q[plan.phase == k][:, [0, 2]] for k in np.unique(plan.phase)]


def _to_axes(points: Array) -> Array:
    """From m and rad to the units of the axes, mm and deg."""
    return np.column_stack([1e3 * points[:, 0], np.degrees(points[:, 1])])


def _points_per_unit(axes: Axes) -> Array:
    """Printer's points per mm and per deg."""
    spans = [np.ptp(axes.get_xlim()), np.ptp(axes.get_ylim())]
    return np.asarray(72.0 * np.array(_BOX[2:]) / np.array(spans))


def _draw_cells(axes: Axes, chart: FormationMap, x: Array, phi: Array) -> None:
    tints = _choose_tints(chart.cell)
    shown = np.where(chart.cell >= 0, tints[chart.cell], -1)
    look: Any = {"shading": "nearest", "rasterized": True, "zorder": 0}
    shown = np.ma.masked_less(shown, 0)
    axes.pcolormesh(x, phi, shown, cmap=ListedColormap(_TINTS), vmin=0, vmax=len(_TINTS), **look)
    crossed = chart.cell == CROSSED
    for region, (face, edge, hatch) in (
        ((chart.cell < 0) & ~crossed, _LOST),
        (crossed, _CROSSED),
    ):
        if region.any():
            field = axes.contourf(
                x, phi, region.astype(float), [0.5, 1.5], colors=[face], hatches=[hatch], zorder=0.5
            )
            field.set(edgecolor=edge, linewidth=0.0)
    for name, code in _UNREACHED.items():
        _write_inside(axes, name, chart.cell == code, x, phi, color="#666666", italic=True)


def _choose_tints(cell: Numbers) -> Numbers:
    """A tint for each cell, different from its neighbours' as far as there are enough."""
    count = int(cell.max()) + 1
    touching = np.zeros((count, count), dtype=bool)
    for one, other in ((cell[1:], cell[:-1]), (cell[:, 1:], cell[:, :-1])):
        both = (one >= 0) & (other >= 0) & (one != other)
        touching[one[both], other[both]] = touching[other[both], one[both]] = True
    tints = np.full(count, -1)
    for k in np.argsort(-touching.sum(axis=1), kind="stable"):
        used = set(tints[touching[k]].tolist())
        fresh = [tint for tint in range(len(_TINTS)) if tint not in used]
        tints[k] = fresh[0] if fresh else 0
    return tints


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
        axes.quiver(*(mine + gap).T, u, v, color=_FREE, **look)
    axes.plot(*places[chart.ambiguous[free]].T, "x", ms=3.5, color=_AMBIGUOUS, zorder=2)


def _draw_borders(axes: Axes, borders: Sequence[Border]) -> None:
    scale = _points_per_unit(axes)
    passing = [_to_axes(b.points) for b in borders if b.flush is None]
    flush = [b for b in borders if b.flush is not None]
    lines = LineCollection(
        passing, colors=_LINE, linewidths=0.7, linestyles=(0, (1, 1.6)), zorder=3
    )
    axes.add_collection(lines)
    every = [_to_axes(b.points) for b in flush]
    axes.add_collection(LineCollection(every, colors=_LINE, linewidths=0.9, zorder=3))
    for colour, way, name in ((_FORTH, 1.0, "forth"), (_BACK, -1.0, "back")):
        strips, heads = [], []
        for border, points in zip(flush, every, strict=True):
            flat = points * scale
            for run in _find_runs(getattr(border, name)):
                if run.stop - run.start > 1:
                    shifted = _shift(flat[run], way * _ASIDE)
                    strips.append(shifted / scale)
                    heads += _place_heads(shifted, way)
        axes.add_collection(LineCollection(strips, colors=colour, linewidths=1.3, zorder=4))
        _draw_heads(axes, heads, colour)
    runs = [
        points[run]
        for border, points in zip(flush, every, strict=True)
        for run in _find_runs(border.ambiguous)
        if run.stop - run.start > 1
    ]
    dots: Any = {"linestyles": (0, (1.5, 1.5)), "linewidths": 2.2, "zorder": 4}
    axes.add_collection(LineCollection(runs, colors=_AMBIGUOUS, **dots))


def _find_runs(flags: Flags) -> list[slice]:
    """Stretches of True."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], flags.astype(int), [0]])))
    return [slice(a, b) for a, b in zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True)]


def _shift(points: Array, distance: float) -> Array:
    """A polyline moved to its right, in points."""
    run = np.gradient(points, axis=0)
    run /= np.maximum(np.hypot(*run.T), 1e-12)[:, None]
    return np.asarray(points + distance * np.column_stack([run[:, 1], -run[:, 0]]))


def _place_heads(points: Array, way: float) -> list[tuple[Array, float]]:
    """Places and headings [rad] of arrow heads on a polyline, in points."""
    steps = np.hypot(*np.diff(points, axis=0).T)
    s = np.concatenate([[0.0], steps.cumsum()])
    count = int(s[-1] // _SPACING) + (s[-1] > 12.0)
    heads = []
    for place in (np.arange(count) + 0.5) * s[-1] / max(count, 1):
        here = np.array([np.interp(place, s, column) for column in points.T])
        k = min(int(np.searchsorted(s, place)), len(s) - 1)
        run = way * (points[k] - points[k - 1])
        heads.append((here, float(np.arctan2(run[1], run[0]))))
    return heads


def _draw_heads(axes: Axes, heads: Sequence[tuple[Array, float]], colour: str) -> None:
    scale = _points_per_unit(axes)
    for place, heading in heads:
        turn = np.array([[np.cos(heading), -np.sin(heading)], [np.sin(heading), np.cos(heading)]])
        head = place + np.array([[3.4, 0.0], [-2.6, 2.5], [-2.6, -2.5]]) @ turn.T
        axes.fill(*(head / scale).T, color=colour, linewidth=0, zorder=5)


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
    for index, contacts in enumerate(chart.formations):
        regions, count = ndimage.label(cell == index)
        text = " | ".join(_shorten(contact) for contact in contacts)
        for number in range(1, count + 1):
            box = _write_inside(axes, text, regions == number, x, phi)
            boxes += [] if box is None else [box]
    return boxes


def _shorten(contact: Contact) -> str:
    rounded = contact.surface == "tip" and contact.feature == "v"
    return f"{contact.corner}{'*' if rounded else ''}"


def _write_inside(
    axes: Axes,
    text: str,
    region: Flags,
    x: Array,
    phi: Array,
    color: str = _INK,
    italic: bool = False,
) -> Array | None:
    """Write in the widest place of a region, if there is room; returns the text's corners."""
    scale = _points_per_unit(axes)
    step = np.array([phi[1] - phi[0], x[1] - x[0]]) * scale[::-1]
    half = np.array([_HEIGHT / 2 + 2.0, _LETTER * len(text) / 2 + 1.0])
    # Measured in half labels, the room around a place is the largest label that fits.
    padded = np.pad(region, 1)
    room = ndimage.distance_transform_edt(padded, sampling=step / half)[1:-1, 1:-1]
    row, column = np.unravel_index(int(room.argmax()), room.shape)
    if room[row, column] < 1.15:
        return None
    look: Any = {"ha": "center", "va": "center", "fontsize": 7.6, "color": color, "zorder": 7}
    look |= {"path_effects": [withStroke(linewidth=2.2, foreground="white")]}
    look |= {"style": "italic" if italic else "normal"}
    axes.text(x[column], phi[row], text, **look)
    place, size = np.array([x[column], phi[row]]), (half[::-1] + 3.0) / scale
    return np.stack([place - size, place + size])


def _draw_paths(axes: Axes, paths: Sequence[Array]) -> None:
    for number, path in enumerate(paths, start=1):
        points = _to_axes(path)
        axes.plot(*points.T, color=_INK, lw=5.0, alpha=0.42, solid_capstyle="round", zorder=3.5)
        flat = points * _points_per_unit(axes)
        s = np.concatenate([[0.0], np.hypot(*np.diff(flat, axis=0).T).cumsum()])
        middle = [np.interp(s[-1] / 2, s, column) for column in points.T]
        look: Any = {"ha": "center", "va": "center", "fontsize": 8.0, "color": "white"}
        look |= {"fontweight": "bold", "zorder": 9}
        look["bbox"] = {"boxstyle": "circle,pad=0.22", "fc": _INK, "ec": "white", "lw": 0.8}
        axes.text(float(middle[0]), float(middle[1]), str(number), **look)


def _name_palm_lines(axes: Axes, chart: FormationMap) -> None:
    found = {}
    for border in chart.borders:
        if border.along == "x":
            found[float(np.degrees(border.points[0, 1]))] = border.contacts[0].index
    right = axes.get_xlim()[1]
    for angle, edge in found.items():
        text = f"edge {edge} on\nthe palm"
        axes.annotate(
            text, (right, angle), (4, 0), textcoords="offset points", va="center", fontsize=7.6
        )


def _patch(look: tuple[str, str, str], label: str) -> Patch:
    face, edge, hatch = look
    return Patch(fc=face, ec=edge, hatch=hatch, lw=0, label=label)


def _is_ambiguous(chart: FormationMap) -> bool:
    """Whether friction lets other contact forces be possible somewhere."""
    return bool(chart.ambiguous.any() or any(own.ambiguous.any() for own in chart.borders))


def _draw_legend(figure: Figure, with_path: bool, crossed: bool, ambiguous: bool) -> None:
    arrow: Any = {"marker": ">", "ms": 5, "lw": 1.4}
    line = partial(Line2D, [], [])
    handles: list[Any] = [
        line(color=_FORTH, label="quasistatic motion possible, +x or +\u03c6", **arrow),
        line(color=_BACK, label="possible, \u2212x or \u2212\u03c6", **arrow),
        line(color=_LINE, lw=0.9, label="border: an edge flush, four contacts"),
        line(color=_LINE, lw=0.7, ls=(0, (1, 1.6)), label="side of the link gives way to its tip"),
        line(color=_INK, marker="o", ms=4, ls="none", label="crossing: five contacts"),
        line(color=_FREE, marker="$\u2194$", ms=8, ls="none", label="possible ways inside a cell"),
        _patch(_LOST, "cannot be reached"),
    ]
    if crossed:
        handles.append(_patch(_CROSSED, "the fingers would overlap"))
    if ambiguous:
        look: Any = {"marker": "x", "ms": 4, "lw": 2.2, "ls": (0, (1.5, 1.5))}
        handles.append(line(color=_AMBIGUOUS, label="contact forces would not be unique", **look))
    if with_path:
        handles.insert(6, line(color=_INK, lw=5, alpha=0.42, label="plan, by phase"))
    note = (
        "Cells: what touches the palm | finger 1 (right) | finger 2 (left); "
        "v vertex, e edge touched by the tip, * vertex on the tip's arc"
    )
    figure.text(0.2 / SIZE[0], 1 - 0.38 / SIZE[1], note, va="top", fontsize=8.5)
    figure.legend(
        handles=handles, loc="lower center", ncols=4, bbox_to_anchor=(0.5, 0.004), fontsize=8.0
    )
