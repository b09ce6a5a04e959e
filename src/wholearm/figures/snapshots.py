"""Hand and object at an instant, to scale."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Polygon as Outline
from matplotlib.patches import Rectangle
from matplotlib.patheffects import withStroke

from ..common.arrays import Array, Numbers
from ..common.document import fixed
from ..contacts.elemental import parse_contact
from ..results.trajectory import Trajectory
from ..scene.model import Finger, Scene
from ..verification.newton_euler import locate, place_object
from .style import BODY, FINGERS, INK, PALM, Styles, add_line, inset, write

NUMBER = 8.0  # size of the numbers at vertices [points]
CAPTION, BAR = 0.42, 0.2  # height of a snapshot's caption, and of the bar that gives the scale [in]


def draw_snapshot(
    axes: Axes, scene: Scene, z: Array, contacts: Sequence[str], styles: Styles, box: Array
) -> list[Artist]:
    """Draw palm, links, object with numbered vertices, and contacts, on axes in m without a frame.

    They show a configuration, z (5,), within `box`: lower left and upper right corner, (2, 2) [m].
    Returns palm, link 1, link 2, object, and one marker per contact.
    """
    axes.set_axis_off()
    axes.set_aspect("equal", adjustable="datalim")
    (vertices,) = place_object(scene, z[None])
    bases = [np.asarray(finger.base)[0] for finger in scene.fingers]
    ends = np.concatenate([bases, vertices[vertices[:, 1] < scene.touching, 0]])
    artists = [draw_palm(axes, scene, ends.min(), ends.max()), *draw_bodies(axes, scene, z)]
    draw_joints(axes, scene)
    for name in contacts:
        face, _, marker = styles[name]
        look: Any = {"mfc": face, "mec": "white", "mew": 0.9, "zorder": 6, "label": name}
        artists += axes.plot(*locate(scene, name, z[None]).point.T, marker, ms=6.5, **look)
    axes.set(xlim=box[:, 0], ylim=box[:, 1])
    scale = measure_scale(axes)
    corners = [parse_contact(name, scene) for name in contacts]
    first = [corner.index for corner in corners if corner.feature == "v"]
    style: Any = {"va": "center", "fontsize": NUMBER, "color": "#555555", "zorder": 5.5}
    style["path_effects"] = [withStroke(linewidth=1.5, foreground="white", alpha=0.7)]
    for index, shift in choose_numbers(scale * vertices, first, 0.0).items():
        write(axes, str(index), vertices[index], shift, **style)
    return artists


def draw_palm(axes: Axes, scene: Scene, left: float, right: float) -> Artist:
    """Draw the palm between two x [m]."""
    deep = PALM * scene.scales.length
    palm = Rectangle((left, -deep), right - left, deep, fc=INK, linewidth=0, zorder=1)
    return axes.add_patch(palm)


def draw_bodies(axes: Axes, scene: Scene, z: Array, **look: Any) -> list[Artist]:
    """Draw both links and the object."""
    shapes = [trace_link(f, angle) for f, angle in zip(scene.fingers, z[3:].tolist(), strict=True)]
    shapes += [*place_object(scene, z[None])]
    artists: list[Artist] = []
    looks = (*((*colours, 0.9, 2) for colours in FINGERS), (INK, BODY, 1.1, 4))
    for points, (line, face, wide, above) in zip(shapes, looks, strict=True):
        style: dict[str, Any] = {"fc": face, "ec": line, "lw": wide, "zorder": above} | look
        artists.append(axes.add_artist(Outline(points, **style)))
    return artists


def draw_joints(axes: Axes, scene: Scene) -> list[Artist]:
    """Draw the joints of both fingers."""
    look: Any = {"marker": "o", "ms": 3.2, "mfc": "white", "mew": 0.9, "zorder": 3}
    rows = zip(scene.fingers, FINGERS, strict=True)
    return [add_line(axes, np.array([f.base]), mec=line, **look) for f, (line, _) in rows]


def measure_scale(axes: Axes) -> float:
    """Printer's points per unit of axes with one scale."""
    axes.apply_aspect()
    ends = axes.transData.transform([[0.0, 0.0], [1.0, 0.0]])
    return 72 / axes.figure.dpi * float(np.ptp(ends[:, 0]))


def choose_numbers(
    vertices: Array, first: Sequence[int] = (), lowest: float = -math.inf
) -> dict[int, Array]:
    """Choose which vertices of a polygon are numbered, and where the numbers stand.

    All of them where there is room, or every second, fifth, tenth, ... one, and those of `first`
    before others. A number stands inside, or outside of an object with up to 5 vertices, which may
    be thin, and its middle at `lowest` or above. Vertices, (n, 2), and heights are in points.
    Returned is where the middle of each number is, from its vertex, (2,); it turns with the object.
    """
    count = len(vertices)
    along = np.roll(vertices, -1, axis=0) - vertices
    along /= np.hypot(*along.T)[:, None]
    inwards = along - np.roll(along, 1, axis=0)
    sharp = np.hypot(*inwards.T)  # 2 cos(half the angle at the vertex)
    blunt = np.sqrt(np.maximum(1 - sharp**2 / 4, 1e-3))
    shifts = (np.clip(5.5 / blunt, 8.5, 14.0) / sharp)[:, None] * inwards

    def put(chosen: Iterable[int]) -> dict[int, Array]:
        """Those of the chosen that stand clear of the ones before."""
        numbers: dict[int, Array] = {}
        for index in chosen:
            for shift in (shifts[index], -shifts[index])[: 1 + (count <= 5)]:
                place = vertices[index] + shift
                far = [
                    np.abs(vertices[k] + other_shift - place)
                    > NUMBER * np.array([0.34 * (len(str(index)) + len(str(k))), 1.2])
                    for k, other_shift in numbers.items()
                ]
                if all(apart.any() for apart in far) and place[1] > lowest:
                    numbers[index] = shift
                    break
        return numbers

    steps = (k * 10**n for n in range(4) for k in (1, 2, 5))
    # None of them where even the first number would stand too low.
    fitting = (
        indices for step in steps if len(put(indices := range(0, count, step))) == len(indices)
    )
    every = next(fitting, range(0))
    return dict(sorted(put(dict.fromkeys([*first, *every])).items()))


def turn(z: Array, points: Array) -> Array:
    """World positions of points of the object, shape (n, 2) [m]."""
    c, s = math.cos(z[2]), math.sin(z[2])
    return np.asarray(z[:2] + points @ np.array([[c, s], [-s, c]]))


def trace_link(finger: Finger, angle: float) -> Array:
    """Outline of a link, a capsule, shape (n, 2) [m]."""
    base, axis = np.asarray(finger.base), np.array([math.cos(angle), math.sin(angle)])
    half = np.linspace(angle - np.pi / 2, angle + np.pi / 2, 25)
    turns = np.concatenate([half, np.pi + half])
    centres = np.repeat([base + finger.length * axis, base], len(half), axis=0)
    return np.asarray(centres + finger.radius * np.column_stack([np.cos(turns), np.sin(turns)]))


def choose_snapshots(trajectory: Trajectory) -> Numbers:
    """Rows of the trajectory to draw: phase boundaries, and instants between if they are few."""
    starts = trajectory.phase_starts
    parts = np.ones(len(starts) - 1, dtype=int)
    while parts.sum() + 1 < 6:
        parts[np.argmax(np.diff(starts) / parts)] += 1
    rows = [0, len(trajectory.t) - 1]
    for k, (start, end) in enumerate(pairwise(starts)):
        phase_rows = np.flatnonzero(trajectory.phase == k)
        for t in np.linspace(start, end, parts[k] + 1)[:-1]:
            rows.append(phase_rows[np.abs(trajectory.t[phase_rows] - t).argmin()])
    return np.unique(rows)


class Strip(NamedTuple):
    """Snapshots side by side, in as many rows as they need, all at one scale."""

    rows: tuple[tuple[int, ...], ...]  # samples of the trajectory, from left to right
    boxes: dict[int, Array]  # (2, 2) [m]: lower left and upper right corner of what is seen at each
    low: float  # low, high [m]: lower and upper end of every picture
    high: float
    scale: float  # [in/m]

    @property
    def height(self) -> float:
        """Of all rows with their captions and the bar above them [in]."""
        return BAR + len(self.rows) * (self.scale * (self.high - self.low) + CAPTION)


def lay_out_strip(trajectory: Trajectory, scene: Scene, width: float, slim: bool) -> Strip:
    """Choose the snapshots of a strip that is `width` wide [in], three rows of them at most.

    A caption needs 1.38 in, or 0.78 in a slim figure, on average.
    """
    every, wide = choose_snapshots(trajectory), max(2, int(width / (0.78 if slim else 1.38)))
    kept = np.linspace(0, len(every) - 1, min(len(every), 3 * wide)).round().astype(int)
    chosen = [int(row) for row in every[kept]]
    lines = math.ceil(len(chosen) / wide)
    cuts = np.linspace(0, len(chosen), lines + 1).round().astype(int)
    rows = tuple(tuple(chosen[a:b]) for a, b in pairwise(cuts))
    pad = PALM * scene.scales.length * np.array([[-1.0], [1.0]])
    boxes = {row: measure_box(scene, trajectory.z[[row]]) + pad for row in chosen}
    low = min(float(box[0, 1]) for box in boxes.values())
    high = max(float(box[1, 1]) for box in boxes.values())
    widest = [
        (width - 0.12 * max(1, len(row) - 1)) / sum(np.ptp(boxes[k][:, 0]) for k in row)
        for row in rows
    ]
    return Strip(rows, boxes, low, high, min(*widest, 1.75 / (high - low)))


def draw_strip(
    figure: Figure, top: float, strip: Strip, trajectory: Trajectory, scene: Scene, styles: Styles
) -> None:
    """Draw the snapshots of a strip whose upper end is at `top` [in], with times and phases."""
    room, last = figure.get_figwidth() - 0.3, strip.rows[-1][-1]
    height = strip.scale * (strip.high - strip.low)
    form = fixed(min(trajectory.duration, 0.9))
    # A bar of a round length, about a quarter of an inch long, gives the scale.
    power = 10.0 ** math.floor(math.log10(0.5 / strip.scale))
    length = next(k * power for k in (5.0, 2.0, 1.0) if k * power <= 0.5 / strip.scale)
    ends, inches = [0.2, 0.2 + strip.scale * length], figure.dpi_scale_trans
    figure.add_artist(Line2D(ends, [top - 0.06] * 2, color=INK, linewidth=2.0, transform=inches))
    text = f"{1e3 * length:g} mm" if length < 1 else f"{length:g} m"
    figure.text(ends[1] + 0.06, top - 0.06, text, va="center", fontsize=8, transform=inches)
    for line, row in enumerate(strip.rows, start=1):
        bottom = top - BAR - line * height - (line - 1) * CAPTION
        widths = [strip.scale * float(np.ptp(strip.boxes[k][:, 0])) for k in row]
        left, space = 0.15, (room - sum(widths)) / max(1, len(row) - 1)
        for k, width in zip(row, widths, strict=True):
            axes = inset(figure, left, bottom, width, height)
            box = np.column_stack([strip.boxes[k][:, 0], [strip.low, strip.high]])
            contacts = trajectory.motions[trajectory.phase[k]].contacts
            # What does not press at this instant is left out, unless no force is known.
            presses = dict(zip(trajectory.contacts, np.isfinite(trajectory.c_n[k]), strict=True))
            names = [name for name in trajectory.contacts if name in contacts]
            names = [name for name in names if presses[name]] or names
            draw_snapshot(axes, scene, trajectory.z[k], names, styles, box)
            place = "end" if k == last else f"phase {trajectory.phase[k] + 1}"
            caption = f"{trajectory.t[k]:{form}} s\n{place}"
            write(axes, caption, (0.5, 0), (0, -3), xycoords="axes fraction", va="top")
            left += width + space


def measure_box(scene: Scene, z: Array) -> Array:
    """Corners of the box around hand and object at configurations, (n, 5); shape (2, 2) [m]."""
    every = [*place_object(scene, z)]
    for finger, angles in zip(scene.fingers, z[:, 3:].T, strict=True):
        every += [trace_link(finger, angle) for angle in angles.tolist()]
    points = np.concatenate(every)
    return np.array([points.min(axis=0), points.max(axis=0)])
