"""Hand and object at an instant, to scale."""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import pairwise
from typing import Any, NamedTuple

import casadi as ca
import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Polygon as Outline
from matplotlib.patches import Rectangle

from ..common.arrays import Array
from ..common.sharing import exclusive
from ..contacts.elemental import build_features, build_geometry, parse_contact
from ..results.trajectory import Trajectory
from ..scene.model import Finger, Scene
from .data import choose_snapshots
from .style import FINGERS, INK, STRIP, Sheet, Styles, write

_CAPTION = 0.42
"""Height of the caption of a snapshot [in]."""
_ROOM = 1.38
"""Width that a snapshot needs for its caption, on average [in]."""


def draw_snapshot(
    axes: Axes, scene: Scene, z: Array, contacts: Sequence[str], styles: Styles
) -> list[Artist]:
    """Draw palm, links, object with numbered vertices, and contacts, to scale.

    The configuration `z` has shape (5,) [m, m, rad, rad, rad]; the axes lose their frame, and
    their unit is 1 m. Returns palm, link 1, link 2, object, and one marker per contact.
    """
    axes.set_axis_off()
    axes.set_aspect("equal", adjustable="datalim")
    vertices = place_vertices(scene, z)
    bases = [np.asarray(finger.base)[0] for finger in scene.fingers]
    ends = np.concatenate([bases, vertices[vertices[:, 1] < scene.touching, 0]])
    palm = Rectangle((ends.min(), -0.004), np.ptp(ends), 0.004, fc=INK, linewidth=0, zorder=1)
    artists: list[Artist] = [axes.add_patch(palm)]
    for finger, angle, (line, face) in zip(scene.fingers, z[3:], FINGERS, strict=True):
        link = Outline(trace_link(finger, angle), fc=face, ec=line, linewidth=0.9, zorder=2)
        artists.append(axes.add_patch(link))
        axes.plot(*np.asarray(finger.base), "o", ms=3.2, mfc="white", mec=line, mew=0.9, zorder=3)
    body = Outline(vertices, fc="#fbf3df", ec=INK, linewidth=1.1, zorder=4)
    artists.append(axes.add_patch(body))
    for index, vertex in enumerate(vertices):
        inwards = 8.5 * (z[:2] - vertex) / np.hypot(*(z[:2] - vertex))
        write(axes, str(index), vertex, inwards, va="center", fontsize=8, color="#555555")
    for name, point in zip(contacts, place_contacts(scene, z, contacts), strict=True):
        face, _, marker = styles[name]
        look: Any = {"mfc": face, "mec": "white", "mew": 0.9, "zorder": 6, "label": name}
        artists += axes.plot(*point, marker, ms=6.5, **look)
    axes.autoscale_view()
    return artists


def place_vertices(scene: Scene, z: Array) -> Array:
    """World positions of the object's vertices, shape (n_v, 2) [m]."""
    c, s = math.cos(z[2]), math.sin(z[2])
    return np.asarray(z[:2] + scene.polygon.vertices @ np.array([[c, s], [-s, c]]))


@exclusive
def place_contacts(scene: Scene, z: Array, contacts: Sequence[str]) -> Array:
    """World positions of contacts, shape (n_c, 2) [m]."""
    points = [build_geometry(parse_contact(name, scene), scene).point for name in contacts]
    function = ca.Function("points", [build_features(scene).z], [ca.horzcat(*points)])
    return np.asarray(function(z).full().T)


def trace_link(finger: Finger, angle: float) -> Array:
    """Outline of a link, a capsule, shape (n, 2) [m]."""
    base, axis = np.asarray(finger.base), np.array([math.cos(angle), math.sin(angle)])
    half = np.linspace(angle - np.pi / 2, angle + np.pi / 2, 25)
    turns = np.concatenate([half, np.pi + half])
    centres = np.repeat([base + finger.length * axis, base], len(half), axis=0)
    return np.asarray(centres + finger.radius * np.column_stack([np.cos(turns), np.sin(turns)]))


class Strip(NamedTuple):
    """Snapshots side by side, in as many rows as they need, all at one scale.

    Attributes
    ----------
    rows : tuple of tuple of int
        Samples of the trajectory, from left to right.
    boxes : dict of int to ndarray, shape (2, 2), [m]
        Lower left and upper right corner of what is seen at each.
    low, high : float, [m]
        Lower and upper end of every picture.
    scale : float, [in/m]
    """

    rows: tuple[tuple[int, ...], ...]
    boxes: dict[int, Array]
    low: float
    high: float
    scale: float

    @property
    def height(self) -> float:
        """Of all rows with their captions [in]."""
        return len(self.rows) * (self.scale * (self.high - self.low) + _CAPTION)


def lay_out_strip(trajectory: Trajectory, scene: Scene, width: float) -> Strip:
    """Choose the snapshots of a strip that is `width` wide [in]."""
    chosen = [int(row) for row in choose_snapshots(trajectory)]
    lines = math.ceil(len(chosen) / max(2, int(width / _ROOM)))
    cuts = np.linspace(0, len(chosen), lines + 1).round().astype(int)
    rows = tuple(tuple(chosen[a:b]) for a, b in pairwise(cuts))
    boxes = {row: _measure(scene, trajectory.z[row]) for row in chosen}
    low = min(float(box[0, 1]) for box in boxes.values())
    high = max(float(box[1, 1]) for box in boxes.values())
    widest = [
        (width - 0.12 * max(1, len(row) - 1)) / sum(np.ptp(boxes[k][:, 0]) for k in row)
        for row in rows
    ]
    return Strip(rows, boxes, low, high, min(*widest, STRIP / (high - low)))


def draw_strip(
    figure: Figure,
    sheet: Sheet,
    top: float,
    strip: Strip,
    trajectory: Trajectory,
    scene: Scene,
    styles: Styles,
) -> None:
    """Draw the snapshots of a strip whose upper end is at `top` [in]."""
    room, last = sheet.width - 0.3, strip.rows[-1][-1]
    height = strip.scale * (strip.high - strip.low)
    for line, row in enumerate(strip.rows):
        bottom = top - (line + 1) * height - line * _CAPTION
        widths = [strip.scale * float(np.ptp(strip.boxes[k][:, 0])) for k in row]
        left, space = 0.15, (room - sum(widths)) / max(1, len(row) - 1)
        for k, width in zip(row, widths, strict=True):
            axes = figure.add_axes(sheet.inset(left, bottom, width, height))
            _draw_sample(axes, trajectory, k, k == last, scene, styles)
            axes.set(xlim=strip.boxes[k][:, 0], ylim=(strip.low, strip.high))
            left += width + space
    _draw_scale(figure.axes[0], strip)


def _draw_sample(
    axes: Axes, trajectory: Trajectory, row: int, end: bool, scene: Scene, styles: Styles
) -> None:
    """Draw hand and object at a sample, with its time and phase below."""
    own = trajectory.motions[trajectory.phase[row]].contacts
    # What does not press at this instant is left out, unless no force is known.
    known = dict(zip(trajectory.contacts, np.isfinite(trajectory.c_n[row]), strict=True))
    names = [name for name in trajectory.contacts if name in own]
    names = [name for name in names if known[name]] or names
    draw_snapshot(axes, scene, trajectory.z[row], names, styles)
    place = "end" if end else f"phase {trajectory.phase[row] + 1}"
    caption = f"{trajectory.t[row]:.3f} s\n{place}"
    write(axes, caption, (0.5, 0), (0, -3), xycoords="axes fraction", va="top")


def _draw_scale(axes: Axes, strip: Strip) -> None:
    """Draw a bar of a round length, about a quarter of an inch long, into the first snapshot."""
    start = strip.boxes[strip.rows[0][0]][0, 0]
    power = 10.0 ** math.floor(math.log10(0.5 / strip.scale))
    length = next(k * power for k in (5.0, 2.0, 1.0) if k * power <= 0.5 / strip.scale)
    level = strip.high - 0.03 / strip.scale
    axes.plot([start, start + length], [level] * 2, color=INK, linewidth=2.0)
    text = f"{1e3 * length:g} mm" if length < 1 else f"{length:g} m"
    write(axes, text, (start, level), (0, -4), va="top", ha="left", fontsize=8)


def _measure(scene: Scene, z: Array) -> Array:
    """Corners of the box around hand and object, shape (2, 2) [m]."""
    links = [trace_link(f, float(a)) for f, a in zip(scene.fingers, z[3:], strict=True)]
    every = np.concatenate([place_vertices(scene, z), *links])
    return np.array([every.min(axis=0) - 0.004, every.max(axis=0) + 0.004])
