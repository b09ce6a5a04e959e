"""Figures of plans and replays: snapshots of hand and object, force margins, and joint torques.

Functions return figures or the artists they drew; nothing is shown and no global state is touched.
"""

from __future__ import annotations

import os
import textwrap
from typing import TYPE_CHECKING, Any

import matplotlib
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from ..common.errors import InputError
from ..common.files import write_whole
from ..common.require import require_number
from ..common.sharing import exclusive
from ..contacts.links import evaluate_finger_gap
from ..problem.read import read_own_problem
from ..results.narrow import Torques, narrow
from ..results.trajectory import Trajectory
from ..scene.model import Scene
from .curves import draw_cones, draw_margins, draw_phases, draw_simulation, draw_torques
from .snapshots import draw_snapshot, draw_strip, place_contacts, place_vertices, trace_link
from .style import SIZE, STYLE, choose_styles, inset

if TYPE_CHECKING:
    from ..simulation.events import Simulation

_FORMATS: dict[str, dict[str, Any]] = {
    ".png": {"Software": None}, ".pdf": {"CreationDate": None}, ".svg": {"Date": None},
}  # fmt: skip
_LEFT, _RIGHT, _BOTTOM = 0.80, 1.30, 0.55  # margins [in]; parts of the figure [in]:
_TORQUES, _CONES, _GAP, _CAPTION = 1.75, 0.85, 0.22, 0.77


@exclusive
def force_margins(what: Torques, *, simulation: Simulation | None = None) -> Figure:
    """Draw a motion: snapshots, the force margin of every contact, and the torques.

    Parameters
    ----------
    what : Plan, Simulation, Report or Trajectory
        Planned, replayed or loaded; its `meta` must hold the problem's tables.
    simulation : Simulation, optional
        A replay of the same torques, drawn over it with dotted lines; its contacts must be those of
        the trajectory, in that order.

    Returns
    -------
    Figure
        Axes in the order: snapshots from left to right, margins, torques, and the friction cones
        if a contact rolls.

    Raises
    ------
    InputError
        If its `meta` lacks the problem, or torques alone are given.
    """
    _, trajectory = narrow(what)
    if trajectory is None:
        raise InputError("", "", "torques alone have no motion to draw; simulate them")
    meta = trajectory.meta
    problem = read_own_problem(meta)
    epsilon = require_number(meta.get("epsilon", problem.epsilon), "meta.epsilon")
    styles = choose_styles(trajectory.contacts)
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=SIZE)
        FigureCanvasAgg(figure)
        low = _BOTTOM + _TORQUES + _GAP
        rolls = bool(trajectory.rolling.any())
        cones_at, low = low, low + (_CONES + _GAP if rolls else 0.0)
        high = draw_strip(figure, trajectory, problem.scene, styles) - _CAPTION
        width = SIZE[0] - _LEFT - _RIGHT
        margins = figure.add_axes(inset(_LEFT, low, width, high - low))
        torques = figure.add_axes(inset(_LEFT, _BOTTOM, width, _TORQUES), sharex=margins)
        covered = None if simulation is None else simulation.c_n - epsilon
        draw_margins(margins, trajectory, epsilon, styles, covered)
        draw_torques(torques, trajectory.torque, problem.scene.torque_limit)
        if simulation is not None:
            draw_simulation(margins, torques, simulation, epsilon)
        panels = [margins, torques]
        if rolls:
            panels.append(figure.add_axes(inset(_LEFT, cones_at, width, _CONES), sharex=margins))
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
    with matplotlib.rc_context(STYLE):
        write_whole(path, lambda stream: figure.savefig(stream, **options))


def _title(trajectory: Trajectory, scene: Scene, epsilon: float) -> str:
    parts = [textwrap.shorten(str(trajectory.meta.get("name", "")), 36, placeholder="\u2026")]
    known = trajectory.meta.get("objective")
    parts.append(f"objective {known}" if known else str(trajectory.meta.get("status", "")))
    parts += [f"duration {trajectory.duration:.4g} s", f"\u03b5 = {epsilon:g} N"]
    if scene.fingers_collide:
        gap = 1e3 * float(evaluate_finger_gap(scene, trajectory.z).min())
        parts.append(f"finger gap \u2265 {gap:.3g} mm".replace("-", "\u2212"))
    return "  \u00b7  ".join(filter(None, parts))


__all__ = [
    "choose_styles",
    "draw_cones",
    "draw_margins",
    "draw_phases",
    "draw_simulation",
    "draw_snapshot",
    "draw_torques",
    "force_margins",
    "place_contacts",
    "place_vertices",
    "require_format",
    "save",
    "trace_link",
]
