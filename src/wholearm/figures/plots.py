"""Figures of a plan: snapshots of hand and object, force margins, and joint torques.

Functions return figures or the artists they drew; nothing is shown and no global state is touched.
"""

from __future__ import annotations

import math
import os
import textwrap
from collections.abc import Mapping, Sequence
from itertools import cycle, pairwise
from typing import TYPE_CHECKING, Any, NamedTuple

import casadi as ca
import matplotlib
import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Polygon as Outline
from matplotlib.patches import Rectangle
from matplotlib.scale import SymmetricalLogTransform
from matplotlib.ticker import FixedLocator, FuncFormatter, NullLocator

from ..common.arrays import Array
from ..common.errors import InputError
from ..common.files import write_whole
from ..common.require import require_number
from ..common.sharing import exclusive
from ..contacts.elemental import build_features, build_geometry, parse_contact
from ..contacts.links import evaluate_finger_gap
from ..problem.definition import Problem, build_problem
from ..results.torque import TorqueProfile
from ..results.trajectory import Trajectory
from ..scene.model import Finger, Scene
from .data import choose_snapshots, cone_shares, find_steps, sample_torques

if TYPE_CHECKING:
    from ..simulation.events import Simulation

SIZE = (10.0, 8.2)  # in
_FORMATS: dict[str, dict[str, Any]] = {
    ".png": {"Software": None}, ".pdf": {"CreationDate": None}, ".svg": {"Date": None},
}  # fmt: skip
# Okabe and Ito's colours without yellow and black, which here are Tol's wine and a grey.
_PALETTE = (
    "#0072B2", "#E69F00", "#009E73", "#CC79A7", "#882255", "#56B4E9", "#D55E00", "#777777",
)  # fmt: skip
_LINES: Any = (("-", "o"), ((0, (5, 1.5)), "s"), ((0, (1.5, 1)), "D"))  # and markers
_FINGERS = (("#444444", "#c4c4c4"), ("#999999", "#ececec"))  # line and face
_BAND, _LOW, _LOST, _INK, _GRID = "#eef1f5", "#fff4d9", "#f6d5cc", "#222222", "#c4c9d0"
_STYLE: Any = {
    "font.family": "sans-serif", "font.sans-serif": ["DejaVu Sans"], "font.size": 9.0,
    "axes.linewidth": 0.8, "axes.spines.top": False, "axes.spines.right": False,
    "lines.solid_capstyle": "butt", "lines.dash_capstyle": "butt", "path.simplify": False,
    "legend.frameon": False, "legend.fontsize": 9.0, "xtick.labelsize": 9.0,
    "ytick.labelsize": 9.0, "legend.handlelength": 1.6, "legend.borderpad": 0.0,
    "pdf.fonttype": 42, "svg.fonttype": "path", "svg.hashsalt": "wholearm",
}  # fmt: skip
_SIMULATED: Any = {"color": "black", "linestyle": (0, (1, 2)), "linewidth": 1.0, "zorder": 5}
_LEFT, _RIGHT, _BOTTOM, _TOP = 0.80, 1.30, 0.55, 0.40  # margins [in]; parts of the figure [in]:
_TORQUES, _CONES, _GAP, _CAPTION, _STRIP = 1.75, 0.85, 0.22, 0.77, 1.75


class ContactStyle(NamedTuple):
    """How one contact is drawn: alike in the snapshots and over time."""

    colour: str
    line: Any
    marker: str


Styles = Mapping[str, ContactStyle]


def read_own_problem(trajectory: Trajectory) -> Problem:
    """The problem that a trajectory carries along in its `meta`.

    Raises
    ------
    InputError
        If there is none, or it is malformed.
    """
    table = trajectory.meta.get("problem")
    if not isinstance(table, Mapping):
        raise InputError("", "meta.problem", "the trajectory does not hold its problem's tables")
    try:
        return build_problem(table)
    except InputError as error:
        raise InputError("", f"meta.problem.{error.key}", error.problem) from None


@exclusive
def force_margins(trajectory: Trajectory, *, simulation: Simulation | None = None) -> Figure:
    """Draw a plan: snapshots, the force margin of every contact, and the torques.

    Parameters
    ----------
    trajectory : Trajectory
        Planned or loaded; its `meta` must hold the problem's tables.
    simulation : Simulation, optional
        A replay of the same plan, drawn over it with dotted lines; its contacts must be those of
        the trajectory, in that order.

    Returns
    -------
    Figure
        Axes in the order: snapshots from left to right, margins, torques, and the friction cones
        if a contact rolls.

    Raises
    ------
    InputError
        If `trajectory.meta` lacks the problem.
    """
    meta, problem = trajectory.meta, read_own_problem(trajectory)
    epsilon = require_number(meta.get("epsilon", problem.epsilon), "meta.epsilon")
    styles = choose_styles(trajectory.contacts)
    with matplotlib.rc_context(_STYLE):
        figure = Figure(figsize=SIZE)
        FigureCanvasAgg(figure)
        low = _BOTTOM + _TORQUES + _GAP
        rolls = bool(trajectory.rolling.any())
        cones_at, low = low, low + (_CONES + _GAP if rolls else 0.0)
        high = _draw_strip(figure, trajectory, problem.scene, styles) - _CAPTION
        width = SIZE[0] - _LEFT - _RIGHT
        margins = figure.add_axes(_place(_LEFT, low, width, high - low))
        torques = figure.add_axes(_place(_LEFT, _BOTTOM, width, _TORQUES), sharex=margins)
        covered = None if simulation is None else simulation.c_n - epsilon
        draw_margins(margins, trajectory, epsilon, styles, covered)
        draw_torques(torques, trajectory.torque, problem.scene.torque_limit)
        if simulation is not None:
            draw_simulation(margins, torques, simulation, epsilon)
        panels = [margins, torques]
        if rolls:
            panels.append(figure.add_axes(_place(_LEFT, cones_at, width, _CONES), sharex=margins))
            draw_cones(panels[-1], trajectory, problem.scene, styles, simulation)
        for axes in panels:
            draw_phases(axes, trajectory.phase_starts, labels=axes is margins)
            spacing = 0.5 if len(trajectory.contacts) < 14 else 0.1
            axes.legend(loc="upper left", bbox_to_anchor=(1.01, 1.02), labelspacing=spacing)
        torques.set(xlabel="time $t$ [s]", xlim=(0.0, trajectory.duration))
        for axes in (margins, *panels[2:]):
            axes.tick_params(labelbottom=False)
        figure.align_ylabels(panels)
        look: Any = {"fontsize": 10.5, "fontweight": "bold", "parse_math": False}
        title = _title(trajectory, problem.scene, epsilon)
        figure.text(0.2 / SIZE[0], 1 - 0.12 / SIZE[1], title, va="top", **look)
    return figure


def require_format(path: str | os.PathLike[str]) -> str:
    """Return the ending of `path`, or raise `InputError` if it is none of .png, .pdf and .svg."""
    ending = os.path.splitext(path)[1].lower()
    if ending not in _FORMATS:
        raise InputError(str(path), "", f"ending {ending!r} given; allowed: {', '.join(_FORMATS)}")
    return ending


@exclusive
def save(figure: Figure, path: str | os.PathLike[str]) -> None:
    """Write a figure as PNG, PDF or SVG, by the ending of `path`; equal figures, equal bytes.

    Raises `InputError` if the ending is another one, or the file cannot be written.
    """
    ending = require_format(path)
    options: Any = {"format": ending[1:], "metadata": _FORMATS[ending], "dpi": 180}
    with matplotlib.rc_context(_STYLE):
        write_whole(path, lambda stream: figure.savefig(stream, **options))


def choose_styles(contacts: Sequence[str]) -> dict[str, ContactStyle]:
    """Give every contact its own combination of colour, line and marker."""
    looks = [ContactStyle(colour, *rest) for rest in _LINES for colour in _PALETTE]
    return dict(zip(contacts, cycle(looks), strict=False))


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
    palm = Rectangle((ends.min(), -0.004), np.ptp(ends), 0.004, fc=_INK, linewidth=0, zorder=1)
    artists: list[Artist] = [axes.add_patch(palm)]
    for finger, angle, (line, face) in zip(scene.fingers, z[3:], _FINGERS, strict=True):
        link = Outline(trace_link(finger, angle), fc=face, ec=line, linewidth=0.9, zorder=2)
        artists.append(axes.add_patch(link))
        axes.plot(*np.asarray(finger.base), "o", ms=3.2, mfc="white", mec=line, mew=0.9, zorder=3)
    body = Outline(vertices, fc="#fbf3df", ec=_INK, linewidth=1.1, zorder=4)
    artists.append(axes.add_patch(body))
    for index, vertex in enumerate(vertices):
        inwards = 8.5 * (z[:2] - vertex) / np.hypot(*(z[:2] - vertex))
        _write(axes, str(index), vertex, inwards, va="center", fontsize=8, color="#555555")
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


def draw_margins(
    axes: Axes, trajectory: Trajectory, epsilon: float, styles: Styles, covered: Array | None = None
) -> list[Line2D]:
    """Draw c_n - epsilon [N] of every contact over time, on a scale that is linear near zero.

    Returns one line per contact, labelled with its name and broken where forces step. The scale
    covers further margins `covered`, shape (n, m) [N], too.
    """
    steps, margins = find_steps(trajectory), trajectory.c_n - epsilon
    t = np.insert(trajectory.t, steps, np.nan)
    lines = []
    for index, name in enumerate(trajectory.contacts):
        # Where margins coincide the earlier, wider line stays visible beside the later one.
        rank = index / max(1, len(trajectory.contacts) - 1)
        colour, line, _ = styles[name]
        look: Any = {"color": colour, "linestyle": line, "linewidth": 3.4 - 2.0 * rank}
        values = np.insert(margins[:, index], steps, np.nan)
        lines += axes.plot(t, values, zorder=3 + rank, label=name, **look)
    axes.axhline(0.0, color="black", linewidth=1.3, zorder=2.5)
    _scale_margins(axes, np.vstack([margins, *([] if covered is None else [covered])]), epsilon)
    return lines


def _scale_margins(axes: Axes, margins: Array, epsilon: float) -> None:
    """Set a scale that is linear within a hundredth of the largest margin, ticks and limits."""
    largest, smallest = float(np.nanmax(margins)), float(np.nanmin(margins))
    reach = max(largest, -smallest, 2 * epsilon) or 1.0
    linear = 10.0 ** (round(math.log10(reach)) - 2)
    transform = SymmetricalLogTransform(10, linear, 1.0)
    ends = transform.transform(np.array([min(smallest, -epsilon), max(largest, 2 * linear)]))
    pad = np.ptp(ends) * np.array([-0.1, 0.05])
    low, high = (float(end) for end in transform.inverted().transform(ends + pad))
    axes.set_yscale("symlog", linthresh=linear, linscale=1.0)
    axes.set_ylim(low, high)
    axes.set_ylabel(f"force margin $c_n - \\varepsilon$ [N], linear to {linear:g}")
    axes.axhspan(-epsilon, 0.0, color=_LOW, linewidth=0, zorder=1.5)
    axes.axhspan(low, -epsilon, color=_LOST, linewidth=0, zorder=1.5)
    look: Any = {"xycoords": "axes fraction", "ha": "left", "fontsize": 8, "color": "#7a2a12"}
    _write(axes, "contact lost, $c_n < 0$", (0, 0), (4, 3), **look)
    decades = linear * 10.0 ** np.arange(math.ceil(math.log10(reach / linear)) + 1)
    positive = np.outer([1, 2, 5] if len(decades) < 5 else [1], decades)
    every = np.unique([0.0, linear / 2, *positive.flat])
    every = np.concatenate([-every[:0:-1], every])
    axes.yaxis.set_major_locator(FixedLocator(every[(every >= low) & (every <= high)].tolist()))
    axes.yaxis.set_minor_locator(NullLocator())
    axes.grid(axis="y", color=_GRID, linewidth=0.4)
    axes.yaxis.set_major_formatter(FuncFormatter(lambda y, _: f"{y:.6g}".replace("-", "\u2212")))


def draw_cones(
    axes: Axes,
    trajectory: Trajectory,
    scene: Scene,
    styles: Styles,
    simulation: Simulation | None = None,
) -> list[Line2D]:
    """Draw c_t / (mu c_n) of every contact while it rolls; at +1 and -1 it would slip.

    Returns one line per contact that rolls, labelled with its name.
    """
    fingers = [parse_contact(name, scene).finger for name in trajectory.contacts]
    mu = np.array([scene.friction.of(finger) for finger in fingers])
    shares = cone_shares(trajectory.rolling, mu, trajectory.c_n, trajectory.c_t)
    steps = find_steps(trajectory)
    t, lines = np.insert(trajectory.t, steps, np.nan), []
    for index in np.flatnonzero(trajectory.rolling.any(axis=0)):
        name = trajectory.contacts[index]
        look: Any = {"color": styles[name].colour, "linestyle": styles[name].line, "zorder": 3}
        values = np.insert(shares[:, index], steps, np.nan)
        lines += axes.plot(t, values, linewidth=1.8, label=name, **look)
    for edge in (-1.0, 1.0):
        axes.axhline(edge, color="black", linewidth=1.0, zorder=2)
        axes.axhspan(edge, 1.25 * edge, color=_LOST, linewidth=0, zorder=1.5)
    axes.axhline(0.0, color=_GRID, linewidth=0.5, zorder=1.6)
    axes.set(ylim=(-1.25, 1.25), yticks=[-1, 0, 1], ylabel="rolling\n$c_t / (\\mu c_n)$")
    if simulation is not None:
        first = np.flatnonzero(np.diff(trajectory.phase, prepend=-1))
        rolls = trajectory.rolling[first][simulation.phase]
        values = cone_shares(rolls, mu, simulation.c_n, simulation.c_t)
        axes.plot(simulation.t, values, **_SIMULATED)
    return lines


def draw_torques(axes: Axes, torque: TorqueProfile, limits: Array) -> list[Line2D]:
    """Draw the torques of both joints, with every step upright, and `limits`, shape (2,) [N m].

    Returns the lines of finger 1 and finger 2.
    """
    t, tau = sample_torques(torque)
    lines = []
    for index, (colour, _) in enumerate(_FINGERS):
        look: Any = {"color": colour, "linewidth": 2.2 - 0.8 * index, "zorder": 3 + index}
        lines += axes.plot(t, tau[:, index], label=f"finger {index + 1}", **look)
    for index, (colour, _) in enumerate(_FINGERS):
        # Dashes that alternate keep both limits visible where they are equal.
        look = {"color": colour, "linewidth": 1.0, "linestyle": (6 * index, (5, 7)), "zorder": 2}
        axes.axhline(limits[index], label=None if index else "limits", **look)
        axes.axhline(-limits[index], **look)
    axes.axhline(0.0, color=_GRID, linewidth=0.5, zorder=1.6)
    reach = 1.12 * max(float(limits.max()), float(np.abs(tau).max()))
    axes.set(ylim=(-reach, reach), ylabel="joint torque $\\tau$ [N m]")
    return lines


def draw_simulation(
    margins: Axes, torques: Axes, simulation: Simulation, epsilon: float
) -> list[Line2D]:
    """Draw simulated margins and torques over the planned ones; returns the lines."""
    t = simulation.t
    gaps = np.flatnonzero((np.diff(t) <= 0) | (np.diff(simulation.phase) != 0)) + 1
    c_n = np.insert(simulation.c_n, gaps, np.nan, axis=0)
    lines = margins.plot(np.insert(t, gaps, np.nan), c_n - epsilon, **_SIMULATED)
    lines += torques.plot(t, simulation.tau, **_SIMULATED)
    for line in (lines[0], lines[-1]):
        line.set_label("simulated")
    return lines


def draw_phases(axes: Axes, starts: Array, *, labels: bool = True) -> list[Artist]:
    """Shade every other phase and write each one's number above it, where there is room.

    `starts` holds when each phase starts and the last one ends, shape (n_phases + 1,) [s]. The axes
    must be at their final place, which decides what there is room for.
    """
    artists: list[Artist] = []
    points = axes.bbox.width / axes.figure.dpi * 72 / (starts[-1] - starts[0])
    for index, (start, end) in enumerate(pairwise(starts)):
        colour = "white" if index % 2 else _BAND
        artists.append(axes.axvspan(start, end, facecolor=colour, linewidth=0, zorder=0.5))
        for text in (f"phase {index + 1}", str(index + 1)) if labels else ():
            if 6.5 * len(text) < points * (end - start):
                place, units = ((start + end) / 2, 1.0), ("data", "axes fraction")
                artists.append(_write(axes, text, place, (0, 4), xycoords=units))
                break
    return artists


def _write(axes: Axes, text: str, place: Any, shift: Any, **look: Any) -> Artist:
    """Write `text` at a place, shifted by points."""
    options: Any = {"ha": "center", "fontsize": 9, "zorder": 5, "textcoords": "offset points"}
    return axes.annotate(text, tuple(place), tuple(shift), **(options | look))


def _draw_strip(figure: Figure, trajectory: Trajectory, scene: Scene, styles: Styles) -> float:
    """Draw the snapshots side by side at one scale; returns the strip's lower end [in]."""
    rows = choose_snapshots(trajectory)
    boxes = np.array([_measure(scene, trajectory.z[row]) for row in rows])
    widths = np.ptp(boxes[:, :, 0], axis=1)
    low, high = float(boxes[:, 0, 1].min()), float(boxes[:, 1, 1].max())
    left, room, spaces = 0.15, SIZE[0] - 0.3, max(1, len(rows) - 1)
    scale = min((room - 0.12 * spaces) / widths.sum(), _STRIP / (high - low))
    height = scale * (high - low)
    bottom = float(SIZE[1] - _TOP - height)
    for row, width, box in zip(rows, scale * widths, boxes, strict=True):
        axes = figure.add_axes(_place(left, bottom, width, height))
        own = trajectory.motions[trajectory.phase[row]].contacts
        names = [name for name in trajectory.contacts if name in own]
        draw_snapshot(axes, scene, trajectory.z[row], names, styles)
        axes.set(xlim=box[:, 0], ylim=(low, high))
        place = f"phase {trajectory.phase[row] + 1}" if row < rows[-1] else "end"
        caption = f"{trajectory.t[row]:.3f} s\n{place}"
        _write(axes, caption, (0.5, 0), (0, -3), xycoords="axes fraction", va="top")
        left += width + (room - scale * widths.sum()) / spaces
    first, start = figure.axes[0], boxes[0, 0, 0]
    first.plot([start, start + 0.05], [high - 0.003] * 2, color=_INK, linewidth=2.0)
    _write(first, "50 mm", (start + 0.025, high - 0.003), (0, -4), va="top", fontsize=8)
    return bottom


def _measure(scene: Scene, z: Array) -> Array:
    """Corners of the box around hand and object, shape (2, 2) [m]."""
    links = [trace_link(f, float(a)) for f, a in zip(scene.fingers, z[3:], strict=True)]
    every = np.concatenate([place_vertices(scene, z), *links])
    return np.array([every.min(axis=0) - 0.004, every.max(axis=0) + 0.004])


def _place(*inches: float) -> Any:
    """Left, bottom, width and height as fractions of the figure."""
    return tuple(np.array(inches) / (SIZE + SIZE))


def _title(trajectory: Trajectory, scene: Scene, epsilon: float) -> str:
    parts = [textwrap.shorten(str(trajectory.meta.get("name", "")), 36, placeholder="\u2026")]
    parts.append(f"objective {trajectory.meta.get('objective', 'unknown')}")
    parts += [f"duration {trajectory.duration:.4g} s", f"\u03b5 = {epsilon:g} N"]
    if scene.fingers_collide:
        gap = 1e3 * float(evaluate_finger_gap(scene, trajectory.z).min())
        parts.append(f"finger gap \u2265 {gap:.3g} mm".replace("-", "\u2212"))
    return "  \u00b7  ".join(filter(None, parts))
