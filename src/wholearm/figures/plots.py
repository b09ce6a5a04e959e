"""Figures of plans and replays: snapshots of hand and object, force margins, and joint torques.

Functions return figures or draw on axes; nothing is shown and no global state is touched.
"""

from __future__ import annotations

import math
import os
import textwrap
from collections.abc import Iterable, Sequence
from itertools import pairwise
from typing import TYPE_CHECKING, Any, NamedTuple

import matplotlib
import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Polygon, Rectangle
from matplotlib.patheffects import withStroke
from matplotlib.scale import SymmetricalLogTransform
from matplotlib.ticker import FixedLocator, FuncFormatter, NullLocator
from numpy.typing import ArrayLike

from ..common.arrays import Array, Numbers
from ..common.document import fixed
from ..common.errors import InputError, require_number
from ..common.files import require_ending, write_whole
from ..common.sharing import exclusive
from ..contacts.elemental import parse_contact
from ..problem.read import read_stored_problem
from ..results.adopt import Torques, split_torques
from ..results.torque import TorqueProfile
from ..results.trajectory import Trajectory
from ..scene.model import Finger, Scene
from ..verification.newton_euler import locate, place_object
from ..verification.verify import find_finger_gap
from . import style
from .style import Styles

if TYPE_CHECKING:
    from ..simulation.events import Simulation


NUMBER = 8.0  # size of the numbers at vertices [points]
CAPTION, BAR = 0.42, 0.2  # height of a snapshot's caption, and of the bar that gives the scale [in]
# Style of simulated curves; that of the torque of finger 2 has longer gaps.
SIMULATED: Any = {"color": "black", "linestyle": (0, (1, 2)), "linewidth": 1.0, "zorder": 5}


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
        look: Any = {"mfc": face, "mec": "white", "mew": 0.9, "zorder": 6, "clip_on": False}
        point = locate(scene, name, z[None]).point
        artists += axes.plot(*point.T, marker, ms=6.5, label=name, **look)
    axes.set(xlim=box[:, 0], ylim=box[:, 1])
    scale = measure_scale(axes)
    corners = [parse_contact(name, scene) for name in contacts]
    first = [corner.index for corner in corners if corner.feature == "v"]
    look = {"va": "center", "fontsize": NUMBER, "color": "#555555", "zorder": 5.5}
    look["path_effects"] = [withStroke(linewidth=1.5, foreground="white", alpha=0.7)]
    for index, shift in choose_numbers(scale * vertices, first, 0.0).items():
        style.write(axes, str(index), vertices[index], shift, **look)
    return artists


def draw_palm(axes: Axes, scene: Scene, left: float, right: float) -> Artist:
    """Draw the palm between two x [m]."""
    depth = style.PALM * scene.scales.length
    palm = Rectangle((left, -depth), right - left, depth, fc=style.INK, linewidth=0, zorder=1)
    return axes.add_patch(palm)


def draw_bodies(axes: Axes, scene: Scene, z: Array, **look: Any) -> list[Artist]:
    """Draw both links and the object."""
    shapes = [trace_link(f, angle) for f, angle in zip(scene.fingers, z[3:].tolist(), strict=True)]
    shapes += [*place_object(scene, z[None])]
    artists: list[Artist] = []
    looks = (*((*colours, 0.9, 2) for colours in style.FINGERS), (style.INK, style.BODY, 1.1, 4))
    for points, (line, face, width, order) in zip(shapes, looks, strict=True):
        options: dict[str, Any] = {"fc": face, "ec": line, "lw": width, "zorder": order} | look
        artists.append(axes.add_artist(Polygon(points, **options)))
    return artists


def draw_joints(axes: Axes, scene: Scene) -> list[Artist]:
    """Draw the joints of both fingers."""
    look: Any = {"marker": "o", "ms": 3.2, "mfc": "white", "mew": 0.9, "zorder": 3}
    look["clip_on"] = False  # whole at the edge, too
    rows = zip(scene.fingers, style.FINGERS, strict=True)
    return [style.add_line(axes, np.array([f.base]), mec=line, **look) for f, (line, _) in rows]


def measure_scale(axes: Axes) -> float:
    """Printer's points per unit of axes with one scale."""
    axes.apply_aspect()
    ends = axes.transData.transform([[0.0, 0.0], [1.0, 0.0]])
    return 72 / axes.figure.dpi * float(np.ptp(ends[:, 0]))


def choose_numbers(
    vertices: Array, first: Sequence[int] = (), lowest: float = -math.inf
) -> dict[int, Array]:
    """Positions of the numbers of vertices of a polygon, relative to each vertex, (2,).

    All vertices have one if there is room, or every second, fifth, tenth, ... one, and those of
    `first` before others. A number is inside, or outside of an object with up to 5 vertices, which
    may be thin, and its middle at `lowest` or above. Vertices, (n, 2), and heights are in points.
    """
    count = len(vertices)
    along = np.roll(vertices, -1, axis=0) - vertices
    along /= np.hypot(*along.T)[:, None]
    inwards = along - np.roll(along, 1, axis=0)
    sharpness = np.hypot(*inwards.T)  # 2 cos(half the angle at the vertex)
    sine = np.sqrt(np.maximum(1 - sharpness**2 / 4, 1e-3))
    shifts = (np.clip(5.5 / sine, 8.5, 14.0) / sharpness)[:, None] * inwards

    def place_numbers(indices: Iterable[int]) -> dict[int, Array]:
        """Positions of chosen vertices, without those that would overlap the ones before."""
        numbers: dict[int, Array] = {}
        for index in indices:
            for shift in (shifts[index], -shifts[index])[: 1 + (count <= 5)]:
                place = vertices[index] + shift
                apart = [
                    np.abs(vertices[k] + other_shift - place)
                    > NUMBER * np.array([0.34 * (len(str(index)) + len(str(k))) + 0.3, 1.2])
                    for k, other_shift in numbers.items()
                ]
                if all(axis.any() for axis in apart) and place[1] > lowest:
                    numbers[index] = shift
                    break
        return numbers

    steps = (k * 10**n for n in range(4) for k in (1, 2, 5))
    # Empty if even the first number would be too low.
    fitting = (
        indices
        for step in steps
        if len(place_numbers(indices := range(0, count, step))) == len(indices)
    )
    chosen = next(fitting, range(0))
    return dict(sorted(place_numbers(dict.fromkeys([*first, *chosen])).items()))


def trace_link(finger: Finger, angle: float) -> Array:
    """Outline of a link, a capsule, shape (n, 2) [m]."""
    base, axis = np.asarray(finger.base), np.array([math.cos(angle), math.sin(angle)])
    half = np.linspace(angle - np.pi / 2, angle + np.pi / 2, 25)
    angles = np.concatenate([half, np.pi + half])
    centres = np.repeat([base + finger.length * axis, base], len(half), axis=0)
    return np.asarray(centres + finger.radius * np.column_stack([np.cos(angles), np.sin(angles)]))


def choose_snapshots(trajectory: Trajectory) -> Numbers:
    """Rows of the trajectory to draw: phase boundaries and, if few, instants between them."""
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
    """Layout of snapshots side by side, in one or more rows, all at one scale."""

    rows: tuple[tuple[int, ...], ...]  # samples of the trajectory, from left to right
    boxes: dict[int, Array]  # (2, 2) [m]: lower left and upper right corner of each picture
    low: float  # low, high [m]: lower and upper end of every picture
    high: float
    scale: float  # [in/m]

    @property
    def height(self) -> float:
        """Height of all rows with their captions and the bar above them [in]."""
        return BAR + len(self.rows) * (self.scale * (self.high - self.low) + CAPTION)


def lay_out_strip(trajectory: Trajectory, scene: Scene, width: float, slim: bool) -> Strip:
    """Choose the snapshots of a strip that is `width` wide [in], three rows of them at most.

    A caption needs 1.38 in, or 0.78 in a slim figure, on average.
    """
    columns = max(2, int(width / (0.78 if slim else 1.38)))
    every = choose_snapshots(trajectory)
    kept = np.linspace(0, len(every) - 1, min(len(every), 3 * columns)).round().astype(int)
    chosen = [int(row) for row in every[kept]]
    lines = math.ceil(len(chosen) / columns)
    cuts = np.linspace(0, len(chosen), lines + 1).round().astype(int)
    rows = tuple(tuple(chosen[a:b]) for a, b in pairwise(cuts))
    pad = style.PALM * scene.scales.length * np.array([[-1.0], [1.0]])
    boxes = {row: measure_box(scene, trajectory.z[[row]]) + pad for row in chosen}
    low = min(float(box[0, 1]) for box in boxes.values())
    high = max(float(box[1, 1]) for box in boxes.values())
    scales = [
        (width - 0.12 * max(1, len(row) - 1)) / sum(np.ptp(boxes[k][:, 0]) for k in row)
        for row in rows
    ]
    return Strip(rows, boxes, low, high, min(*scales, 1.75 / (high - low)))


def draw_strip(
    figure: Figure, top: float, strip: Strip, trajectory: Trajectory, scene: Scene, styles: Styles
) -> None:
    """Draw the snapshots of a strip whose upper end is at `top` [in], with times and phases."""
    room, last = figure.get_figwidth() - 0.3, strip.rows[-1][-1]
    height = strip.scale * (strip.high - strip.low)
    form = fixed(min(trajectory.duration, 0.9))
    # The bar of the scale has a round length, about a quarter of an inch.
    power = 10.0 ** math.floor(math.log10(0.5 / strip.scale))
    length = next(k * power for k in (5.0, 2.0, 1.0) if k * power <= 0.5 / strip.scale)
    ends, inches = [0.2, 0.2 + strip.scale * length], figure.dpi_scale_trans
    figure.add_artist(
        Line2D(ends, [top - 0.06] * 2, color=style.INK, linewidth=2.0, transform=inches)
    )
    text = f"{1e3 * length:g} mm" if length < 1 else f"{length:g} m"
    figure.text(ends[1] + 0.06, top - 0.06, text, va="center", fontsize=8, transform=inches)
    for line, row in enumerate(strip.rows, start=1):
        bottom = top - BAR - line * height - (line - 1) * CAPTION
        widths = [strip.scale * float(np.ptp(strip.boxes[k][:, 0])) for k in row]
        left, space = 0.15, (room - sum(widths)) / max(1, len(row) - 1)
        for k, width in zip(row, widths, strict=True):
            axes = style.inset(figure, left, bottom, width, height)
            box = np.column_stack([strip.boxes[k][:, 0], [strip.low, strip.high]])
            contacts = trajectory.motions[trajectory.phase[k]].contacts
            # Contacts that do not press at this instant are left out, unless no force is known.
            presses = dict(zip(trajectory.contacts, np.isfinite(trajectory.c_n[k]), strict=True))
            names = [name for name in trajectory.contacts if name in contacts]
            names = [name for name in names if presses[name]] or names
            draw_snapshot(axes, scene, trajectory.z[k], names, styles, box)
            place = "end" if k == last else f"phase {trajectory.phase[k] + 1}"
            caption = f"{trajectory.t[k]:{form}} s\n{place}"
            style.write(axes, caption, (0.5, 0), (0, -3), xycoords="axes fraction", va="top")
            left += width + space


def measure_box(scene: Scene, z: Array) -> Array:
    """Corners of the box around hand and object at configurations, (n, 5); shape (2, 2) [m]."""
    shapes = [*place_object(scene, z)]
    for finger, angles in zip(scene.fingers, z[:, 3:].T, strict=True):
        shapes += [trace_link(finger, angle) for angle in angles.tolist()]
    points = np.concatenate(shapes)
    return np.array([points.min(axis=0), points.max(axis=0)])


def draw_margins(
    axes: Axes, trajectory: Trajectory, epsilon: float, styles: Styles, further: ArrayLike = ()
) -> None:
    """Draw c_n - epsilon [N] of every contact over time, on a scale that is linear near zero.

    Lines are labelled with the names of contacts and broken where forces step. Contacts that never
    press have none. The scale covers `further` margins [N], of any shape, too.
    """
    steps, margins = trajectory.find_steps(), trajectory.c_n - epsilon
    t = np.insert(trajectory.t, np.repeat(steps, 2), np.repeat(trajectory.t[steps], 2))
    for index in np.flatnonzero(np.isfinite(margins).any(axis=0)):
        name = trajectory.contacts[index]
        # If margins coincide, the earlier, wider line is visible beside the later one.
        rank = index / max(1, len(trajectory.contacts) - 1)
        colour, line, _ = styles[name]
        look: Any = {"color": colour, "linestyle": line, "linewidth": 3.4 - 2.0 * rank}
        # Up to a step the line keeps its last value.
        ends = np.column_stack([margins[steps - 1, index], np.full(len(steps), np.nan)]).ravel()
        values = np.insert(margins[:, index], np.repeat(steps, 2), ends)
        axes.plot(t, values, zorder=3 + rank, label=name, **look)
    axes.axhline(0.0, color="black", linewidth=1.3, zorder=2.5)
    scale_margins(axes, np.append(margins, further), epsilon)


def scale_margins(axes: Axes, margins: Array, epsilon: float) -> None:
    """Set a scale that is linear within a hundredth of the largest margin, ticks and limits."""
    # At rest no force is known.
    largest, smallest = (float(f.reduce(margins, None, initial=0.0)) for f in (np.fmax, np.fmin))
    reach = max(largest, -smallest, 2 * epsilon) or 1.0
    linear = 10.0 ** (round(math.log10(reach)) - 2)
    transform = SymmetricalLogTransform(10, linear, 1.0)
    ends = transform.transform(np.array([min(smallest, -epsilon), max(largest, 2 * linear)]))
    pad = np.ptp(ends) * np.array([-0.1, 0.05])
    low, high = (float(end) for end in transform.inverted().transform(ends + pad))
    axes.set_yscale("symlog", linthresh=linear, linscale=1.0)
    axes.set_ylim(low, high)
    prefix, factor = style.choose_prefix(reach)
    unit, bound = f"[{prefix}N]", f"linear to {factor * linear:g}"
    axes.set_ylabel(f"force margin $c_n - \\varepsilon$ {unit}, {bound}")
    axes.axhspan(-epsilon, 0.0, color=style.LOW, linewidth=0, zorder=1.5)
    axes.axhspan(low, -epsilon, color=style.LOST, linewidth=0, zorder=1.5)
    look: Any = {"xycoords": "axes fraction", "ha": "left", "fontsize": 8, "color": "#7a2a12"}
    style.write(axes, "contact lost, $c_n < 0$", (0, 0), (4, 3), **look)
    decades = linear * 10.0 ** np.arange(math.ceil(math.log10(reach / linear)) + 1)
    points = 72 / axes.figure.dpi * axes.bbox.height / np.ptp(ends)
    for digits in ([1, 2, 5], [1]):
        ticks = np.unique([0.0, linear / 2, *np.outer(digits, decades).flat])
        ticks = np.concatenate([-ticks[:0:-1], ticks])
        ticks = ticks[(ticks >= low) & (ticks <= high)]
        # Only powers of ten have a label if labels of 9 points would overlap.
        if points * np.diff(transform.transform(ticks)).min() >= 9:
            break
    axes.yaxis.set_major_locator(FixedLocator(ticks.tolist()))
    axes.yaxis.set_minor_locator(NullLocator())
    axes.grid(axis="y", color=style.GRID, linewidth=0.4)
    _scale_ticks(axes, factor)


def _scale_ticks(axes: Axes, factor: float) -> None:
    """Write the values at the ticks times a factor."""
    scaled = FuncFormatter(lambda y, _: f"{factor * y:.6g}".replace("-", "\u2212"))
    axes.yaxis.set_major_formatter(scaled)


def draw_cones(
    axes: Axes, trajectory: Trajectory, scene: Scene, styles: Styles, simulation: Simulation | None
) -> None:
    """Draw c_t / (mu c_n) of every contact while it rolls; at +1 and -1 it would slip."""
    fingers = [parse_contact(name, scene).finger for name in trajectory.contacts]
    mu = np.array([scene.friction.of(finger) for finger in fingers])
    ratios = trajectory.c_t / np.where(trajectory.rolling, mu * trajectory.c_n, np.nan)
    steps = trajectory.find_steps()
    t = np.insert(trajectory.t, steps, np.nan)
    for index in np.flatnonzero(trajectory.rolling.any(axis=0)):
        name = trajectory.contacts[index]
        look: Any = {"color": styles[name].colour, "linestyle": styles[name].line, "zorder": 3}
        values = np.insert(ratios[:, index], steps, np.nan)
        axes.plot(t, values, linewidth=1.8, label=name, **look)
    for edge in (-1.0, 1.0):
        axes.axhline(edge, color="black", linewidth=1.0, zorder=2)
        axes.axhspan(edge, 1.25 * edge, color=style.LOST, linewidth=0, zorder=1.5)
    axes.axhline(0.0, color=style.GRID, linewidth=0.5, zorder=1.6)
    axes.set(ylim=(-1.25, 1.25), yticks=[-1, 0, 1], ylabel="rolling\n$c_t / (\\mu c_n)$")
    if simulation is not None:
        first = np.flatnonzero(np.diff(trajectory.phase, prepend=-1))
        rolls = trajectory.rolling[first][simulation.phase]
        values = simulation.c_t / np.where(rolls, mu * simulation.c_n, np.nan)
        axes.plot(simulation.t, values, **SIMULATED)


def draw_torques(axes: Axes, torque: TorqueProfile, limits: Array) -> None:
    """Draw the torques of both joints, with every step upright, and `limits`, shape (2,) [N m]."""
    # Both ends of every piece, and enough places between them for a smooth curve.
    pieces, _, order = torque.coefficients.shape
    x = np.linspace(-1.0, 1.0, 2 if order <= 2 else max(order, math.ceil(2000 / pieces)))
    middle, half = (torque.breaks[1:] + torque.breaks[:-1]) / 2, np.diff(torque.breaks) / 2
    tau = torque.at_places(x).transpose(0, 2, 1).reshape(-1, 2)
    t = (middle[:, None] + half[:, None] * x).ravel()
    for index, (colour, _) in enumerate(style.FINGERS):
        look: Any = {"color": colour, "linewidth": 2.2 - 0.8 * index, "zorder": 3 + index}
        axes.plot(t, tau[:, index], label=f"finger {index + 1}", **look)
    for index, (colour, _) in enumerate(style.FINGERS):
        # Dashes that alternate keep both limits visible where they are equal.
        look = {"color": colour, "linewidth": 1.0, "linestyle": (6 * index, (5, 7)), "zorder": 2}
        axes.axhline(limits[index], label=None if index else "limits", **look)
        axes.axhline(-limits[index], **look)
    axes.axhline(0.0, color=style.GRID, linewidth=0.5, zorder=1.6)
    reach = 1.12 * max(float(limits.max()), float(np.abs(tau).max()))
    prefix, factor = style.choose_prefix(reach)
    axes.set(ylim=(-reach, reach), ylabel=f"joint torque $\\tau$ [{prefix}N m]")
    _scale_ticks(axes, factor)


def draw_motion(panels: Sequence[Axes], trajectory: Trajectory) -> None:
    """Draw place, angles and joint speeds over time on three axes."""
    t = trajectory.t
    looks: Any = ((0, "x", "#0072B2", "-"), (0, "y", "#E69F00", (0, (5, 1.5))))
    looks += ((1, "phi", "#0072B2", "-."),)
    pose = np.column_stack([1e3 * trajectory.q[:, :2], np.degrees(trajectory.q[:, 2])])
    for (panel, name, colour, line), values in zip(looks, pose.T, strict=True):
        panels[panel].plot(t, values, color=colour, linestyle=line, label=name)
    for axes, label in zip(panels, ("place [mm]", "angle [deg]", "speed [rad/s]"), strict=True):
        axes.set_ylabel(label)
    for index, (colour, _) in enumerate(style.FINGERS):
        look: Any = {"color": colour, "linewidth": 2.2 - 0.8 * index}
        look["label"] = f"finger {index + 1}"
        panels[1].plot(t, np.degrees(trajectory.theta[:, index]), **look)
        panels[2].plot(t, trajectory.theta_dot[:, index], **look)
    for axes in panels:
        axes.grid(axis="y", color=style.GRID, linewidth=0.4)


def draw_simulation(margins: Axes, torques: Axes, simulation: Simulation, epsilon: float) -> None:
    """Draw simulated margins and torques over the planned ones."""
    t = simulation.t
    gaps = np.flatnonzero((np.diff(t) <= 0) | (np.diff(simulation.phase) != 0)) + 1
    c_n = np.insert(simulation.c_n, gaps, np.nan, axis=0)
    margins.plot(np.insert(t, gaps, np.nan), c_n - epsilon, **SIMULATED)[0].set_label("simulated")
    sparse = {"linestyle": (0, (3, 5)), "linewidth": 0.9}
    for index, look in enumerate((SIMULATED, SIMULATED | sparse)):
        label = f"simulated {index + 1}"
        torques.plot(t, simulation.tau[:, index], label=label, **look)


def draw_phases(
    axes: Axes, starts: Array, *, labels: bool = True, span: float | None = None
) -> None:
    """Shade every other phase and write each one's number above it, if there is room.

    Numbers of phases that are too short for them are above the axes in two rows.

    `starts` are those of phases, and the last end, (n_phases + 1,) [s]; the axes cover `span` [s],
    or the phases, and have their final size, on which the room depends.
    """
    points = axes.bbox.width / axes.figure.dpi * 72 / (span or starts[-1] - starts[0])
    row_ends = [-math.inf, -math.inf]  # where each row of numbers ends [points]
    for index, (start, end) in enumerate(pairwise(starts)):
        colour = "white" if index % 2 else style.BAND
        axes.axvspan(start, end, facecolor=colour, linewidth=0, zorder=0.5)
        middle, text = points * (start + end) / 2, f"phase {index + 1}"
        if 6.5 * len(text) >= points * (end - start):
            text = str(index + 1)
        half = 3.2 * len(text)
        row = next((k for k, stop in enumerate(row_ends) if stop < middle - half), None)
        if not labels or row is None:
            continue
        row_ends[row] = middle + half
        place, units = ((start + end) / 2, 1.0), ("data", "axes fraction")
        style.write(axes, text, place, (0, 4 + 10 * row), xycoords=units)


_FORMATS: dict[str, dict[str, Any]] = {
    ".png": {"Software": None}, ".pdf": {"CreationDate": None}, ".svg": {"Date": None},
}  # fmt: skip


@exclusive
def force_margins(
    what: Torques,
    *,
    simulation: Simulation | None = None,
    width: float = style.WIDTH,
    motion: bool = False,
) -> Figure:
    """Draw a motion: snapshots, the force margin of every contact, and the torques.

    Parameters
    ----------
    what          planned, replayed or loaded; its `meta` must hold the problem's tables
    simulation    a replay of the same torques and contacts, drawn over it with dotted lines
    width : [in]  of the figure, 3 to 40. Below 7 legends are at the foot.
    motion        whether to draw the object's pose, and the joints' angles and speeds, too

    Axes are in the order: snapshots, margins, torques, cones, place, angles, joint speeds.

    InputError if its `meta` lacks the problem, torques alone are given, or the width is out of its
    range.
    """
    _, trajectory = split_torques(what)
    if trajectory is None:
        raise InputError("", "", "torques alone have no motion to draw; simulate them")
    width = style.WIDTHS.read(width, "width")
    meta = trajectory.meta
    problem = read_stored_problem(meta)
    epsilon = require_number(meta.get("epsilon", problem.epsilon), "meta.epsilon")
    scene, styles = problem.scene, style.choose_styles(trajectory.contacts)
    parts = [textwrap.shorten(str(meta.get("name", "")), 36, placeholder="\u2026")]
    objective = meta.get("objective")
    parts.append(f"objective {objective}" if objective else str(meta.get("status", "")))
    parts += [f"duration {trajectory.duration:.4g} s", f"\u03b5 = {epsilon:g} N"]
    if scene.fingers_collide:
        gap = find_finger_gap(scene, trajectory).least
        # Gaps below 1 nm are rounding errors.
        text = f"{round(1e3 * gap, 6) + 0.0:.3g} mm" if gap < 0.9995 else f"{gap:.3g} m"
        parts.append(f"finger gap \u2265 {text}".replace("-", "\u2212"))
    # From the foot of the figure to its title, in inches. A slim one has its legend at the foot.
    rolls, slim, line = bool(trajectory.rolling.any()), width < 7.0, 0.17
    strip = lay_out_strip(trajectory, scene, width - 0.3, slim)
    columns = max(1, int((width - 0.3) / 1.05))
    keys = len(trajectory.contacts) + 3 + 3 * motion + (simulation is not None)
    foot = 0.55 + (line * math.ceil(keys / columns) + 0.1 if slim else 0.0)
    scale = 0.65 if slim else 1.0
    sizes = [1.2 * scale] * 3 * motion + [1.75 * scale] + [0.85] * rolls + [3.6 * scale]
    size_of_title, separator = (8.5, " \u00b7 ") if slim else (10.5, "  \u00b7  ")
    heading = separator.join(part.replace(" ", "\u00a0") for part in parts if part)
    letters = max(24, int(11.5 * width * 10.5 / size_of_title))
    title = textwrap.wrap(heading, letters) + textwrap.wrap(str(meta.get("outcome", "")), letters)
    left, spacing = 0.8, 0.22
    top = foot + sum(sizes) + spacing * (len(sizes) - 1) + 0.3 + strip.height
    with style.open_figure(width, top + 0.4 + line * (len(title) - 1)) as figure:
        draw_strip(figure, top, strip, trajectory, scene, styles)
        panel_width, low, places = width - left - (0.12 if slim else 1.3), foot, []
        for size in sizes:
            places.append((left, low, panel_width, size))
            low += size + spacing
        margins = style.inset(figure, *places[-1])
        torques, *others = (
            style.inset(figure, *place, sharex=margins)
            for place in [places[3 * motion], *places[-2:][:rolls], *places[2::-1][: 3 * motion]]
        )
        panels = [margins, torques, *others]
        # Last forces of a replay that ends at a step of the torques are those after the step.
        last = getattr(what, "c_n", trajectory.c_n)[-1] - epsilon
        further = last if simulation is None else np.append(simulation.c_n - epsilon, last)
        draw_margins(margins, trajectory, epsilon, styles, further)
        for k in np.flatnonzero(last < -epsilon):
            look: Any = {"color": styles[trajectory.contacts[k]].colour, "clip_on": False}
            margins.plot(trajectory.duration, last[k], "x", zorder=6, **look)
        draw_torques(torques, trajectory.torque, scene.torque_limit)
        if simulation is not None:
            draw_simulation(margins, torques, simulation, epsilon)
        if rolls:
            draw_cones(others[0], trajectory, scene, styles, simulation)
        if motion:
            draw_motion(others[-3:], trajectory)
        lowest = others[-1] if motion else torques
        for axes in panels:
            draw_phases(axes, trajectory.phase_starts, labels=axes is margins)
            if axes is not lowest:
                axes.tick_params(labelbottom=False)
            if not slim:
                style.list_contacts(axes, 72 * axes.get_position().height * figure.get_figheight())
        if slim:
            legend: dict[str, Any] = {}
            for axes, name in ((margins, "margin"), (torques, "torque")):
                axes.set_ylabel(f"{name} {style.unit_of(axes)}")
                lines, labels = axes.get_legend_handles_labels()
                legend |= zip(labels, lines, strict=True)
            for line_2d in [line_2d for axes in others[-3:-1] * motion for line_2d in axes.lines]:
                legend.setdefault(str(line_2d.get_label()), line_2d)
            look = {"loc": "lower left", "bbox_to_anchor": (0.02, 0.005), "fontsize": 8}
            look |= {"ncols": columns, "columnspacing": 1.0}
            figure.legend([*legend.values()], [*legend], **look)
        lowest.set(xlabel="time $t$ [s]", xlim=(0.0, trajectory.duration))
        figure.align_ylabels(panels)
        style.write_title(figure, "\n".join(title), size_of_title)
    return figure


@exclusive
def save(figure: Figure, path: str | os.PathLike[str], *, resolution: int = 180) -> None:
    """Write a figure as PNG, PDF or SVG, by the ending of `path`; equal figures, equal bytes.

    `resolution` is that of PNG [dots per inch].

    Raises `InputError` if the ending is another one, or the file cannot be written.
    """
    ending = require_ending(path, *_FORMATS)
    # A device or a pipe gets a PNG.
    kind = ending if ending in _FORMATS else ".png"
    options: Any = {"format": kind[1:], "metadata": _FORMATS[kind], "dpi": resolution}
    with matplotlib.rc_context(style.STYLE):
        write_whole(path, lambda stream: figure.savefig(stream, **options))
