"""The contact-formation map as a figure; nothing is shown and no global state is touched.

In its SVG the elements that can be clicked in a page have ids ``place-k``: parts of cells in the
order of `split_regions`, then borders with an edge flush, then crossings.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import partial
from itertools import count
from typing import Any

import numpy as np
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch, PathPatch
from matplotlib.path import Path
from matplotlib.patheffects import withStroke

from ..common.arrays import Array, Flags, Numbers, find_runs, interpolate
from ..common.sharing import exclusive
from ..mapping.formation_list import trace_problem
from ..mapping.formation_map import CROSSED, FormationMap
from ..results.adopt import MotionLike, require_motion
from ..results.trajectory import Trajectory
from .style import INK, add_line, inset, open_figure, write, write_title

SIZE = (11.0, 7.9)  # in
BOX = (1.0, 1.0, 9.15, 6.2)  # axes: left, bottom, width, height [in]
PLACE = "place-"
_LINE, _FREE, _AMBIGUOUS = "#9aa1ab", "#7a838f", "#AA3377"
_FORTH, _BACK = "#0072B2", "#D55E00"
_LOST: Any = {"fc": "#ececec", "ec": "#b8b8b8", "hatch": "////", "lw": 0.0}
_OVERLAP: Any = {"fc": "#f6e3ee", "ec": "#CC79A7", "hatch": "\\\\\\\\", "lw": 0.0}
_TINTS = ("#f3f6fb", "#fbf6ea", "#eef7f0", "#f9eff4", "#f4f1fb", "#eef6f8", "#f7f7ee")
_PASSING: Any = {"lw": 0.7, "ls": (0, (1, 1.6))}
_DOTTED: Any = {"lw": 2.2, "ls": (0, (1.5, 1.5))}
_PLAN: Any = {"color": INK, "lw": 5.0, "alpha": 0.42, "solid_capstyle": "round"}
# Corners of arrow heads of directed lines, and of arrows inside cells [points].
_HEAD = np.array([[3.4, 0.0], [-2.6, 2.5], [-2.6, -2.5]])
_ARROW = np.array(
    [[1.2, 0.5], [5.4, 0.5], [5.2, 2.0], [9.2, 0.0], [5.2, -2.0], [5.4, -0.5], [1.2, -0.5]]
)


@exclusive
def draw_map(chart: FormationMap, plan: Trajectory | MotionLike | None = None) -> Figure:
    """Draw a contact-formation map.

    The path of `plan` is drawn over the map, phase by phase; by default that of the problem's
    phases, as far as geometry determines it. The figure has one axes: x [mm] and phi [deg].
    """
    problem = chart.problem
    paths = trace_problem(problem) if plan is None else []
    if plan is not None:
        motion = require_motion(plan)
        paths = [motion.q[motion.phase == k][:, [0, 2]] for k in np.unique(motion.phase)]
    with open_figure(*SIZE) as figure:
        drawing = _Drawing(figure, chart, paths)
        drawing.draw_cells()
        drawing.draw_directions(drawing.draw_labels())
        drawing.draw_borders()
        drawing.draw_paths()
        drawing.draw_legend()
        limits = " and ".join(dict.fromkeys(f"{v:g}" for v in problem.scene.torque_limit))
        title = f"{problem.name}  \u00b7  contact formations with palm and both fingers touching"
        text = f"{title}  \u00b7  \u03b5 = {problem.epsilon:g} N, |\u03c4| \u2264 {limits} N m"
        write_title(figure, text)
    return figure


class _Drawing:
    """A map on axes in mm and deg."""

    def __init__(self, figure: Figure, chart: FormationMap, paths: Sequence[Array]) -> None:
        self.figure, self.chart, self.paths = figure, chart, [_to_axes(path) for path in paths]
        self.x, self.phi = 1e3 * chart.x, np.degrees(chart.phi)
        self.axes = inset(figure, *BOX)
        self.axes.set(xlim=self.x[[0, -1]], xlabel="x of the centroid [mm]")
        self.axes.set(ylim=self.phi[[0, -1]], ylabel="orientation \u03c6 [deg]")
        # Points per mm and per deg.
        self.scale = 72.0 * np.array(BOX[2:]) / [np.ptp(self.x), np.ptp(self.phi)]
        self.parts = list(split_regions(chart.cell))
        self.gids = (f"{PLACE}{k}" for k in count())

    def draw_cells(self) -> None:
        """Fill the cells, in tints that differ from their neighbours', and hatch the rest."""
        cell = self.chart.cell
        size = int(cell.max()) + 1
        touching = np.zeros((size, size), dtype=bool)
        for one, other in ((cell[1:], cell[:-1]), (cell[:, 1:], cell[:, :-1])):
            both = (one >= 0) & (other >= 0) & (one != other)
            touching[one[both], other[both]] = touching[other[both], one[both]] = True
        tints = np.full(size, -1)
        for k in np.argsort(-touching.sum(axis=1), kind="stable"):
            used_tints = set(tints[touching[k]].tolist())
            tints[k] = next((tint for tint in range(len(_TINTS)) if tint not in used_tints), 0)
        for index, region in self.parts:
            face, gid = _TINTS[tints[index]], next(self.gids)
            self._add(self._outline(region), fc=face, lw=0, aa=False, gid=gid, zorder=0)
        for region, look in (((cell < 0) & (cell != CROSSED), _LOST), (cell == CROSSED, _OVERLAP)):
            if region.any():
                self._add(self._outline(region), zorder=0.5, **look)

    def _outline(self, region: Flags) -> Array:
        """Rectangles around the places of the grid in a region, shape (n, 4, 2): runs of rows."""
        edges = np.diff(np.pad(region.astype(int), ((0, 0), (1, 1))), axis=1)
        rows, first = np.nonzero(edges == 1)
        columns = np.stack([first, np.nonzero(edges == -1)[1]])[[0, 1, 1, 0]] - 0.5
        lines = rows + np.array([-0.5, -0.5, 0.5, 0.5])[:, None]
        step = np.array([self.x[1] - self.x[0], self.phi[1] - self.phi[0]])
        return np.asarray(np.stack([columns, lines]).T * step + [self.x[0], self.phi[0]])

    def _add(self, polygons: Array, **look: Any) -> None:
        """Draw polygons of n corners, shape (m, n, 2), as one."""
        self.axes.add_artist(PathPatch(Path.make_compound_path_from_polys(polygons), **look))

    def _add_lines(self, lines: Sequence[Array], color: str, **look: Any) -> None:
        self.axes.add_artist(LineCollection(lines, colors=color, **look))

    def _write(self, place: Array, text: str, **look: Any) -> None:
        self.axes.text(float(place[0]), float(place[1]), text, ha="center", va="center", **look)

    def draw_labels(self) -> list[Array]:
        """Name the cells; returns the corners (low, high) of the texts, each (2, 2)."""
        clear = np.ones(self.chart.cell.shape, dtype=bool)
        for path in self.paths:
            dx = (np.subtract.outer(self.x, path[:, 0]) * self.scale[0]) ** 2
            dy = (np.subtract.outer(self.phi, path[:, 1]) * self.scale[1]) ** 2
            # 8 points from the plan.
            clear &= (dx[None] + dy[:, None]).min(axis=2) > 64.0
        # A star: the vertex is on the tip's arc.
        names = [
            " | ".join(f"{c.corner}{'*' * (c.surface == 'tip' and c.feature == 'v')}" for c in each)
            for each in self.chart.formations
        ]
        boxes = [self._write_inside(names[k], region & clear) for k, region in self.parts]
        look: Any = {"color": "#666666", "style": "italic"}
        texts = ["joint 2 in or above the object", "joint 1 in or above the object"]
        texts += ["finger 2 too short", "finger 1 too short"]
        for name, code in [*zip(texts, range(-4, 0), strict=True), ("fingers overlap", CROSSED)]:
            self._write_inside(name, self.chart.cell == code, **look)
        return [box for box in boxes if box is not None]

    def _write_inside(self, text: str, region: Flags, **look: Any) -> Array | None:
        """Write in the widest place of a region, if there is room; returns the text's corners."""
        if not region.any():
            return None
        step = np.array([self.phi[1] - self.phi[0], self.x[1] - self.x[0]]) * self.scale[::-1]
        label = np.array([6.5, 2.2 * len(text) + 1.0])  # a letter is 4.4 points wide
        # Measured in half labels, the room around a place is the largest label that fits. In narrow
        # cells, as of discs, the label is upright.
        for half, angle in ((label, 0), (label[::-1], 90)):
            row, column, room = find_room(region, step / half)
            if room >= 1.15:
                place = np.array([self.x[column], self.phi[row]])
                size = (half[::-1] + 3) / self.scale
                style: Any = {"fontsize": 7.6, "color": INK, "zorder": 7, "rotation": angle} | look
                # Over lines, arrows and hatching.
                style["path_effects"] = [withStroke(linewidth=2.2, foreground="white")]
                self._write(place, text, **style)
                return np.stack([place - size, place + size])
        return None

    def draw_directions(self, boxes: Sequence[Array]) -> None:
        """Small arrows in directions in which a quasistatic motion inside a cell is possible."""
        places = _to_axes(self.chart.places)
        free = np.ones(len(places), dtype=bool)
        for low, high in boxes:
            free &= ~((places > low) & (places < high)).all(axis=1)
        for k, direction in enumerate(np.array([[1.0, 0.0], [-1.0, 0.0], [0.0, 1.0], [0.0, -1.0]])):
            arrow = _ARROW @ np.array([direction, direction[::-1]]) / self.scale
            starts = places[free & self.chart.possible[:, k], None]
            self._add(starts + arrow, fc=_FREE, lw=0, zorder=2)
        crosses = places[free & self.chart.ambiguous]
        add_line(self.axes, crosses, marker="x", ms=3.5, ls="none", color=_AMBIGUOUS, zorder=2)

    def draw_borders(self) -> None:
        """Borders, lines beside them where motions are possible, and crossings.

        Texts beside the axes name the edge that lies on the palm.
        """
        flush = [border for border in self.chart.borders if border.flush is not None]
        passing = [_to_axes(border.points) for border in self.chart.borders if border.flush is None]
        lines = [_to_axes(border.points) for border in flush]
        self._add_lines(passing, _LINE, zorder=3, **_PASSING)
        self._add_lines(lines, _LINE, lw=0.9, zorder=3)

        def cut(borders: Sequence[Array], name: str) -> Iterator[Array]:
            for border, points in zip(flush, borders, strict=True):
                yield from (points[run] for run in find_runs(getattr(border, name), min_length=2))

        for colour, sign, name in ((_FORTH, 1.0, "forth"), (_BACK, -1.0, "back")):
            # 2.6 points beside the border.
            strips = [offset_line(run * self.scale, sign * 2.6) for run in cut(lines, name)]
            self._add_lines([strip / self.scale for strip in strips], colour, lw=1.3, zorder=4)
            heads = np.concatenate([np.empty((0, 3, 2)), *(place_heads(s, sign) for s in strips)])
            self._add(heads / self.scale, fc=colour, lw=0, zorder=5)
        self._add_lines(list(cut(lines, "ambiguous")), _AMBIGUOUS, zorder=4, **_DOTTED)
        for points in lines:
            add_line(self.axes, points, lw=9, alpha=0.0, zorder=5.5, gid=next(self.gids))
        dot: Any = {"marker": "o", "mfc": INK, "mec": "white", "mew": 0.5, "ls": "none"}
        for crossing in self.chart.crossings:
            # The dot is small if only a contact changes its name on a border.
            size = 3.6 if len(crossing.flush) >= 2 else 2.4
            point, gid = _to_axes(crossing.point[None]), next(self.gids)
            add_line(self.axes, point, ms=size, zorder=6, gid=gid, **dot)
        look: Any = {"ha": "left", "va": "center", "fontsize": 7.6}
        edges = {b.points[0, 1]: b.contacts[0].index for b in self.chart.borders if b.along == "x"}
        for angle, edge in edges.items():
            place = self.x[-1], np.degrees(angle)
            write(self.axes, f"edge {edge} on\nthe palm", place, (4, 0), **look)

    def draw_paths(self) -> None:
        """The plan, each phase in the window with its number on or beside it."""
        corners = np.array([[self.x[0], self.phi[0]], [self.x[-1], self.phi[-1]]]) * self.scale
        window = tuple(corners.ravel().tolist())
        clipped = (Path(path * self.scale).cleaned(clip=window).vertices for path in self.paths)
        # The last vertex is that of the code STOP.
        pieces = ((number, np.array(line)[:-1]) for number, line in enumerate(clipped, start=1))
        lines = {number: line for number, line in pieces if len(line)}
        look: Any = {"fontsize": 8.0, "color": "white", "fontweight": "bold", "zorder": 9}
        look["bbox"] = {"boxstyle": "circle,pad=0.22", "fc": INK, "ec": "white", "lw": 0.8}
        places = place_discs([*lines.values()], 16.0, *corners)
        for (number, line), place in zip(lines.items(), places, strict=True):
            add_line(self.axes, line / self.scale, zorder=3.5, **_PLAN)
            leader = np.array([find_middle(line), place]) / self.scale
            add_line(self.axes, leader, color=INK, lw=0.8, zorder=8.5)
            self._write(leader[1], str(number), **look)

    def draw_legend(self) -> None:
        """Legend of lines and colours."""
        arrow: Any = {"marker": ">", "ms": 5, "lw": 1.4}
        line, chart = partial(Line2D, [], []), self.chart
        handles: list[Any] = [
            line(color=_FORTH, label="quasistatic motion possible, +x or +\u03c6", **arrow),
            line(color=_BACK, label="possible, \u2212x or \u2212\u03c6", **arrow),
            line(color=_LINE, lw=0.9, label="border: an edge flush, four contacts"),
            line(color=_LINE, label="side of the link gives way to its tip", **_PASSING),
            line(color=INK, marker="o", ms=4, ls="none", label="crossing: five contacts"),
            line(color=_FREE, marker=">", ms=4, lw=1, label="possible ways inside a cell"),
        ]
        if self.paths:
            handles.append(line(label="plan, by phase", **_PLAN))
        handles.append(Patch(label="cannot be reached", **_LOST))
        if (chart.cell == CROSSED).any():
            handles.append(Patch(label="the fingers would overlap", **_OVERLAP))
        if chart.ambiguous.any() or any(border.ambiguous.any() for border in chart.borders):
            look = {"color": _AMBIGUOUS, "marker": "x", "ms": 4, **_DOTTED}
            handles.append(line(label="contact forces would not be unique", **look))
        note = (
            "Cells: what touches the palm | finger 1 (right) | finger 2 (left); "
            "v vertex, e edge touched by the tip, * vertex on the tip's arc"
        )
        self.figure.text(0.2 / SIZE[0], 1 - 0.38 / SIZE[1], note, va="top", fontsize=8.5)
        look = {"loc": "lower center", "ncols": 4, "bbox_to_anchor": (0.5, 0.004), "fontsize": 8.0}
        self.figure.legend(handles=handles, **look)


def _to_axes(points: Array) -> Array:
    """From m and rad to the units of the axes, mm and deg."""
    return np.column_stack([1e3 * points[:, 0], np.degrees(points[:, 1])])


def _head(run: Array) -> Array:
    """Unit vectors along `run`, (n, 2); zero vectors stay zero."""
    return np.asarray(run / np.maximum(np.hypot(*run.T), 1e-12)[:, None])


def offset_line(points: Array, distance: float) -> Array:
    """A polyline with an offset to its right, with the second coordinate upwards."""
    run = _head(np.gradient(points, axis=0))
    return np.asarray(points + distance * np.column_stack([run[:, 1], -run[:, 0]]))


def _measure(points: Array) -> Array:
    """Arc lengths of a polyline at its points, shape (n,)."""
    return np.append(0.0, np.hypot(*np.diff(points, axis=0).T).cumsum())


def find_middle(points: Array, fraction: float = 0.5) -> Array:
    """The place at a fraction of the length of a polyline, shape (2,)."""
    s = _measure(points)
    return interpolate(fraction * s[-1], s, points)


def place_heads(points: Array, direction: float) -> Array:
    """Corners of arrow heads on a polyline, one every 42 points, shape (n, 3, 2)."""
    s = _measure(points)
    number = int(s[-1] // 42.0) + int(s[-1] > 12.0)
    places = (np.arange(number) + 0.5) * s[-1] / max(number, 1)
    k = np.searchsorted(s, places)
    run = _head(direction * (points[k] - points[k - 1]))
    frame = np.stack([run, np.column_stack([-run[:, 1], run[:, 0]])], axis=1)
    return np.asarray(interpolate(places, s, points)[:, None] + _HEAD @ frame)


def place_discs(paths: Sequence[Array], size: float, low: Array, high: Array) -> Array:
    """Places without overlap for the numbers of paths, on them or beside them, shape (m, 2).

    Paths, (n, 2), the diameter `size` of the discs, and the corners `low` and `high` of the paper,
    (2,), are in units of the paper.
    """
    angles = np.pi / 8 * (np.arange(16) + 4)
    ring = np.column_stack([np.cos(angles), np.sin(angles)])
    offsets = np.concatenate([radius * size * ring for radius in (1.0, 1.6, 2.3, 3.2, 4.2)])
    discs = np.empty((0, 2))
    for path in paths:
        on_path = [find_middle(path, fraction) for fraction in (0.5, 0.4, 0.6, 0.3, 0.7, 0.2, 0.8)]
        candidates = np.concatenate([on_path, on_path[0] + offsets])
        clear = np.hypot(*(candidates[:, None] - discs[None]).transpose(2, 0, 1)) >= size
        inside = ((candidates >= low + size / 2) & (candidates <= high - size / 2)).all(axis=1)
        discs = np.vstack([discs, candidates[(clear.all(axis=1) & inside).argmax()]])
    return discs


def split_regions(cell: Numbers) -> Iterator[tuple[int, Flags]]:
    """Connected regions (4-neighbourhood) of a grid with equal cells, each with its cell.

    `cell` has the number of the cell at each place, or a negative one. Regions are in the order of
    cells, from below.
    """
    from scipy.ndimage import label

    for index in range(int(cell.max()) + 1):
        regions, count = label(cell == index)
        yield from ((index, regions == k) for k in range(1, count + 1))


def find_room(region: Flags, step: Array) -> tuple[int, int, float]:
    """Centre of the largest inscribed circle of a region: row, column, and radius.

    `step` are the distances of rows and of columns, shape (2,). Places beyond the grid are outside
    of the region.
    """
    from scipy.ndimage import distance_transform_edt, find_objects

    (box,) = find_objects(region.astype(int))
    room = distance_transform_edt(np.pad(region[box], 1), sampling=step)[1:-1, 1:-1]
    row, column = np.unravel_index(int(room.argmax()), room.shape)
    place = int(row) + box[0].start, int(column) + box[1].start
    return *place, float(room[row, column])
