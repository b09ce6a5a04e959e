"""Hand and object at an instant, to scale."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

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
from .style import FINGERS, INK, SIZE, STRIP, TOP, Styles, inset, write


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


def draw_strip(figure: Figure, trajectory: Trajectory, scene: Scene, styles: Styles) -> float:
    """Draw the snapshots side by side at one scale; returns the strip's lower end [in]."""
    rows = choose_snapshots(trajectory)
    boxes = np.array([_measure(scene, trajectory.z[row]) for row in rows])
    widths = np.ptp(boxes[:, :, 0], axis=1)
    low, high = float(boxes[:, 0, 1].min()), float(boxes[:, 1, 1].max())
    left, room, spaces = 0.15, SIZE[0] - 0.3, max(1, len(rows) - 1)
    scale = min((room - 0.12 * spaces) / widths.sum(), STRIP / (high - low))
    height = scale * (high - low)
    bottom = float(SIZE[1] - TOP - height)
    for row, width, box in zip(rows, scale * widths, boxes, strict=True):
        axes = figure.add_axes(inset(left, bottom, width, height))
        own = trajectory.motions[trajectory.phase[row]].contacts
        # What does not press at this instant is left out, unless no force is known.
        known = dict(zip(trajectory.contacts, np.isfinite(trajectory.c_n[row]), strict=True))
        names = [name for name in trajectory.contacts if name in own]
        names = [name for name in names if known[name]] or names
        draw_snapshot(axes, scene, trajectory.z[row], names, styles)
        axes.set(xlim=box[:, 0], ylim=(low, high))
        place = f"phase {trajectory.phase[row] + 1}" if row < rows[-1] else "end"
        caption = f"{trajectory.t[row]:.3f} s\n{place}"
        write(axes, caption, (0.5, 0), (0, -3), xycoords="axes fraction", va="top")
        left += width + (room - scale * widths.sum()) / spaces
    first, start = figure.axes[0], boxes[0, 0, 0]
    first.plot([start, start + 0.05], [high - 0.003] * 2, color=INK, linewidth=2.0)
    write(first, "50 mm", (start + 0.025, high - 0.003), (0, -4), va="top", fontsize=8)
    return bottom


def _measure(scene: Scene, z: Array) -> Array:
    """Corners of the box around hand and object, shape (2, 2) [m]."""
    links = [trace_link(f, float(a)) for f, a in zip(scene.fingers, z[3:], strict=True)]
    every = np.concatenate([place_vertices(scene, z), *links])
    return np.array([every.min(axis=0) - 0.004, every.max(axis=0) + 0.004])
