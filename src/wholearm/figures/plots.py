"""Figures of plans and replays: snapshots of hand and object, force margins, and joint torques.

Functions return figures or the artists they drew; nothing is shown and no global state is touched.
"""

from __future__ import annotations

import math
import os
import textwrap
from typing import TYPE_CHECKING, Any

import matplotlib
from matplotlib.figure import Figure

from ..common.errors import InputError, require_number
from ..common.files import write_whole
from ..common.sharing import exclusive
from ..contacts.contact_limits import evaluate_finger_gap
from ..problem.read import read_own_problem
from ..results.adopt import Torques, narrow
from .curves import (
    draw_cones,
    draw_margins,
    draw_motion,
    draw_phases,
    draw_simulation,
    draw_torques,
)
from .snapshots import draw_strip, lay_out_strip
from .style import (
    STYLE,
    WIDTH,
    WIDTHS,
    choose_styles,
    inset,
    list_contacts,
    open_figure,
    unit_of,
    write_title,
)

if TYPE_CHECKING:
    from ..simulation.events import Simulation

_FORMATS: dict[str, dict[str, Any]] = {
    ".png": {"Software": None}, ".pdf": {"CreationDate": None}, ".svg": {"Date": None},
}  # fmt: skip


@exclusive
def force_margins(
    what: Torques,
    *,
    simulation: Simulation | None = None,
    width: float = WIDTH,
    motion: bool = False,
) -> Figure:
    """Draw a motion: snapshots, the force margin of every contact, and the torques.

    Parameters
    ----------
    what          planned, replayed or loaded; its `meta` must hold the problem's tables
    simulation    a replay of the same torques, drawn over it with dotted lines; its contacts must
                  be those of the trajectory, in that order
    width : [in]  of the figure, 3 to 40. Below 7 legends stand at the foot.
    motion        whether to draw the object's pose, and the joints' angles and speeds, too

    Returns
    -------
    Figure  axes in the order: snapshots from left to right, margins, torques, the friction cones if
            a contact rolls, and pose, angles and speeds

    Raises
    ------
    InputError  if its `meta` lacks the problem, torques alone are given, or the width is out of its
                range
    """
    _, trajectory = narrow(what)
    if trajectory is None:
        raise InputError("", "", "torques alone have no motion to draw; simulate them")
    width = WIDTHS.read(width, "width")
    meta = trajectory.meta
    problem = read_own_problem(meta)
    epsilon = require_number(meta.get("epsilon", problem.epsilon), "meta.epsilon")
    scene, styles = problem.scene, choose_styles(trajectory.contacts)
    parts = [textwrap.shorten(str(meta.get("name", "")), 36, placeholder="\u2026")]
    known = meta.get("objective")
    parts.append(f"objective {known}" if known else str(meta.get("status", "")))
    parts += [f"duration {trajectory.duration:.4g} s", f"\u03b5 = {epsilon:g} N"]
    if scene.fingers_collide:
        least = float(evaluate_finger_gap(scene, trajectory.z).min())
        text = f"{1e3 * least:.3g} mm" if least < 0.9995 else f"{least:.3g} m"
        parts.append(f"finger gap \u2265 {text}".replace("-", "\u2212"))
    # From the foot of the figure to its title, in inches. A slim one has its legend at the foot.
    rolls, slim, line = bool(trajectory.rolling.any()), width < 7.0, 0.17
    strip = lay_out_strip(trajectory, scene, width - 0.3, slim)
    columns = max(1, int((width - 0.3) / 1.05))
    keys = len(trajectory.contacts) + 3 + (simulation is not None)
    foot = 0.55 + (line * math.ceil(keys / columns) + 0.1 if slim else 0.0)
    share = 0.65 if slim else 1.0
    sizes = [1.2 * share] * 3 * motion + [1.75 * share] + [0.85] * rolls + [3.6 * share]
    size_of_title, between = (8.5, " \u00b7 ") if slim else (10.5, "  \u00b7  ")
    whole = between.join(part.replace(" ", "\u00a0") for part in parts if part)
    title = textwrap.wrap(whole, max(24, int(11.5 * width * 10.5 / size_of_title)))
    left, gap = 0.8, 0.22
    top = foot + sum(sizes) + gap * (len(sizes) - 1) + 0.3 + strip.height
    with open_figure(width, top + 0.4 + line * (len(title) - 1)) as figure:
        draw_strip(figure, top, strip, trajectory, scene, styles)
        wide, low, places = width - left - (0.12 if slim else 1.3), foot, []
        for size in sizes:
            places.append((left, low, wide, size))
            low += size + gap
        margins = inset(figure, *places[-1])
        torques, *others = (
            inset(figure, *place, sharex=margins)
            for place in [places[3 * motion], *places[-2:][:rolls], *places[2::-1][: 3 * motion]]
        )
        panels = [margins, torques, *others]
        covered = None if simulation is None else simulation.c_n - epsilon
        draw_margins(margins, trajectory, epsilon, styles, covered)
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
                list_contacts(axes, 72 * axes.get_position().height * figure.get_figheight())
        if slim:
            legend: dict[str, Any] = {}
            for axes, name in ((margins, "margin"), (torques, "torque")):
                axes.set_ylabel(f"{name} {unit_of(axes)}")
                lines, labels = axes.get_legend_handles_labels()
                legend |= zip(labels, lines, strict=True)
            look: Any = {"loc": "lower left", "bbox_to_anchor": (0.02, 0.005), "fontsize": 8}
            look |= {"ncols": columns, "columnspacing": 1.0}
            figure.legend([*legend.values()], [*legend], **look)
        lowest.set(xlabel="time $t$ [s]", xlim=(0.0, trajectory.duration))
        figure.align_ylabels(panels)
        write_title(figure, "\n".join(title), size_of_title)
    return figure


def require_format(path: str | os.PathLike[str]) -> str:
    """Return the ending of `path`, or raise `InputError` if it is none of .png, .pdf and .svg."""
    ending = os.path.splitext(path)[1].lower()
    if ending not in _FORMATS:
        raise InputError(str(path), "", f"ending {ending!r} given; allowed: {', '.join(_FORMATS)}")
    return ending


@exclusive
def save(figure: Figure, path: str | os.PathLike[str], *, resolution: int = 180) -> None:
    """Write a figure as PNG, PDF or SVG, by the ending of `path`; equal figures, equal bytes.

    `resolution` is that of PNG [dots per inch].

    Raises `InputError` if the ending is another one, or the file cannot be written.
    """
    ending = require_format(path)
    options: Any = {"format": ending[1:], "metadata": _FORMATS[ending], "dpi": resolution}
    with matplotlib.rc_context(STYLE):
        write_whole(path, lambda stream: figure.savefig(stream, **options))
