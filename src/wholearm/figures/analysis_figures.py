"""Figures of comparisons, predictions and studies of robustness."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Polygon, Rectangle
from matplotlib.ticker import FuncFormatter, LogLocator, MaxNLocator, NullFormatter

from ..common.sharing import exclusive
from . import style
from .plots import draw_margins, draw_phases
from .snapshots import place_vertices, trace_link

if TYPE_CHECKING:
    from ..analysis.comparison import Comparison
    from ..analysis.robustness import Robustness
    from ..analysis.slow_speeds import PhasePrediction, Prediction

_DOT = "  \u00b7  "  # between the parts of a title
_KINDS = (
    ("contacts kept too", style.PALETTE[2], "o"),
    ("goal reached", style.PALETTE[0], "s"),
    ("goal missed", style.PALETTE[6], "x"),
)
"""What becomes of a sample, its colour and its mark."""


@exclusive
def draw_comparison(comparison: Comparison) -> Figure:
    """Draw c_n - epsilon of every contact over time: a panel for each plan, on one scale of time.

    Replays are drawn; where nothing has moved a panel says so.
    """
    shown = [(contender, contender.replayed) for contender in comparison.contenders]
    motions = [motion for _, motion in shown if motion is not None]
    names = dict.fromkeys(name for motion in motions for name in motion.contacts)
    styles = style.choose_styles(tuple(names))
    longest = max((motion.duration for motion in motions), default=1.0)
    # Height of a panel, and of a line of text above it, and room at both sides [in].
    tall, line, left, right = 2.45, 0.25, 0.8, 1.3
    high = 0.5 + len(motions) * (tall + line + 0.4) + len(shown) * line
    covered = np.concatenate([[0.0], *(m.c_n.ravel() - comparison.epsilon for m in motions)])
    with style.open_figure(10.0, high) as figure:
        title = f"{comparison.name}{_DOT}force margins{_DOT}\u03b5 = {comparison.epsilon:g} N"
        style.write_title(figure, title)
        look: Any = {"fontsize": 9, "color": style.INK, "parse_math": False, "va": "bottom"}
        look["transform"] = figure.dpi_scale_trans
        high -= 0.35
        for contender, motion in shown:
            high -= line
            what = f"{contender.duration:.4g} s" if contender.ok else contender.reason
            between = _DOT if contender.ok else ": "
            heading = f"{contender.name}{_DOT}{contender.verdict}{between}{what}"
            figure.text(left, high, heading, **look)
            if motion is None:
                continue
            high -= tall + line
            axes = style.inset(figure, left, high, 10.0 - left - right, tall)
            high -= 0.4
            draw_margins(axes, motion, comparison.epsilon, styles, covered)
            axes.set_xlim(0.0, longest)
            draw_phases(axes, motion.phase_starts, span=longest)
            style.list_contacts(axes, 72 * tall)
            axes.set_ylabel(f"$c_n - \\varepsilon$ {style.unit_of(axes)}")
            axes.set_xlabel("time $t$ [s]" if motion is motions[-1] else "")
    return figure


@exclusive
def draw_prediction(prediction: Prediction) -> Figure:
    """Draw the least normal force over speed: a panel for each phase, a line for each motion."""
    phases = [phase for phase in prediction.phases if phase.curves is not None]
    columns = min(3, max(len(phases), 2))
    rows = max(math.ceil(len(phases) / columns), 1)
    # Size of a panel with what is written about it, and the room that this takes [in].
    (wide, tall), (left, right, bottom, top) = (3.7, 2.85), (0.62, 0.15, 0.50, 0.80)
    with style.open_figure(columns * wide, rows * tall + 0.45) as figure:
        for k, phase in enumerate(phases):
            row, column = divmod(k, columns)
            corner = column * wide + left, (rows - 1 - row) * tall + bottom
            axes = style.inset(figure, *corner, wide - left - right, tall - bottom - top)
            _draw_phase(axes, phase, prediction.epsilon)
            axes.set_ylabel("least $c_n$ [N]" if column == 0 else "")
            axes.set_xlabel("speed along the phase [m/s]" if k >= len(phases) - columns else "")
        name = f"{prediction.name}{_DOT}quasistatic motions at speed"
        style.write_title(figure, f"{name}{_DOT}\u03b5 = {prediction.epsilon:g} N", left=0.15)
    return figure


def _draw_phase(axes: Axes, phase: PhasePrediction, epsilon: float) -> None:
    """The lines of one phase, with where they break, and above them what breaks."""
    curves = phase.curves
    assert curves is not None
    rest = max([epsilon, *(float(force[0]) for force in curves.force.values())])
    low, high = -0.35 * rest, 2.2 * rest
    axes.axhspan(0.0, epsilon, color=style.LOW, linewidth=0, zorder=1)
    axes.axhspan(low, 0.0, color=style.LOST, linewidth=0, zorder=1)
    axes.axhline(epsilon, color="black", linewidth=1.0, zorder=2)
    above: Any = {"xycoords": "axes fraction", "ha": "left", "va": "bottom", "fontsize": 7.5}
    for k, survival in enumerate(phase.survivals):
        colour, (dash, _) = style.PALETTE[k], style.LINES[k % 3]
        look: Any = {"color": colour, "linestyle": dash, "linewidth": 1.9}
        force = curves.force[survival.motion]
        axes.plot(curves.speed, np.where(np.isfinite(force), force, np.nan), zorder=3 + k, **look)
        if survival.speed:
            axes.plot(survival.speed, epsilon, "o", color=colour, markersize=5, zorder=6)
        again = "never" if survival.again is None else f"only from {survival.again:.3g} m/s on"
        speed = f"{survival.speed:.3g} m/s" if survival.speed else again
        failure = f"{speed}: {survival.first.name}"
        failure = "keeps \u03b5 at any speed" if survival.speed is None else failure
        text = f"{survival.motion}, {failure}"
        style.write(axes, text, (0, 1), (0, 29 - 12 * k), color=colour, **above)
    if not any(np.isfinite(force).any() for force in curves.force.values()):
        middle: Any = {"transform": axes.transAxes, "ha": "center", "va": "center", "zorder": 7}
        axes.text(0.5, 0.8, "no slow motion keeps its limits", color=style.INK, **middle)
    title = f"phase {phase.number}, until {phase.until}"
    above |= {"fontsize": 9, "fontweight": "bold"}
    style.write(axes, title, (0, 1), (0, 41), color=style.INK, **above)
    axes.set(xscale="log", xlim=(curves.speed[0], curves.speed[-1]), ylim=(low, high))
    wide = curves.speed[-1] > 20.0 * curves.speed[0]
    axes.xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0) if wide else (1.0, 2.0, 3.0, 5.0)))
    axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axes.xaxis.set_minor_formatter(NullFormatter())
    axes.yaxis.set_major_locator(MaxNLocator(5))
    axes.grid(color=style.GRID, linewidth=0.4)


@exclusive
def draw_robustness(study: Robustness) -> Figure:
    """Draw paths and ends of the samples beside the nominal motion.

    Axes are in the order: hand and paths of the centroid, to scale; distances and angles from the
    goal.
    """
    with style.open_figure(10.0, 4.6, layout="constrained") as figure:
        motion, ends = figure.subplots(1, 2, width_ratios=(1.5, 1.0))
        _draw_motion(motion, study)
        _draw_ends(ends, study)
    return figure


def find_kind(record: dict[str, Any]) -> int:
    """Index of what has become of a sample: kept, reached, missed."""
    return 0 if record["reached"] and record["kept"] else 1 if record["reached"] else 2


def _draw_motion(axes: Axes, study: Robustness) -> None:
    scene, nominal = study.trial.problem.scene, np.array(study.nominal["path"])
    axes.set_aspect("equal", adjustable="box")
    for finger, angle, (line, face) in zip(
        scene.fingers, nominal[-1, 3:], style.FINGERS, strict=True
    ):
        outline = 1e3 * trace_link(finger, float(angle))
        axes.add_patch(Polygon(outline, fc=face, ec=line, linewidth=0.9, zorder=1))
    copies = [record for record in study.records if "path" in record]
    for record in sorted(copies, key=find_kind):
        path = np.array(record["path"])
        colour = _KINDS[find_kind(record)][1]
        axes.plot(*(1e3 * path[:, :2].T), color=colour, linewidth=0.6, alpha=0.5, zorder=3)
        body = Polygon(1e3 * place_vertices(scene, path[-1]), fill=False, ec=colour)
        axes.add_patch(body).set(linewidth=0.5, alpha=0.35, zorder=2)
    for z, dash in ((nominal[0], (0, (4, 2))), (nominal[-1], "-")):
        body = Polygon(1e3 * place_vertices(scene, z), fill=False, ec=style.INK, linestyle=dash)
        axes.add_patch(body).set(linewidth=1.2, zorder=5)
    axes.plot(*(1e3 * nominal[:, :2].T), color=style.INK, linewidth=1.6, zorder=4)
    axes.autoscale_view()
    (left, right), (low, high) = axes.get_xlim(), axes.get_ylim()
    deep = 1e3 * style.PALM * scene.scales.length
    axes.add_patch(Rectangle((left, -deep), right - left, deep, fc=style.INK, lw=0, zorder=1))
    axes.set(xlim=(left, right), ylim=(low, high), xlabel="x [mm]", ylabel="y [mm]")
    axes.set_title("centroid's paths, poses at the start (dashed) and the end", fontsize=9)


def _draw_ends(axes: Axes, study: Robustness) -> None:
    records = [record for record in study.records if "distance" in record]
    uncertainty = study.trial.uncertainty
    goal = (
        1e3 * uncertainty.find_distance(study.trial.problem.scene),
        math.degrees(uncertainty.angle),
    )
    deviations = [(1e3 * record["distance"], math.degrees(record["angle"])) for record in records]
    least = 1e-4  # [mm] and [deg]: lesser ones are drawn so
    places = np.maximum(np.array(deviations).reshape(-1, 2), least)
    kinds = np.array([find_kind(record) for record in records])
    for kind, (label, colour, marker) in enumerate(_KINDS):
        points = places[kinds == kind]
        text = f"{label}: {len(points)}"
        axes.plot(*points.T, marker, ms=3.5, color=colour, alpha=0.7, label=text, mew=0.9)
    axes.set(xscale="log", yscale="log")
    around = np.vstack([places, goal])
    # Whole powers of ten, so that both ends of an axis have a number.
    low = 0.8 * 10 ** np.floor(np.log10(around.min(axis=0)))
    high = 1.25 * 10 ** np.ceil(np.log10(around.max(axis=0)))
    axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]))
    notes = [f" (at least {least:g})" * (min(column) <= least) for column in around.T.tolist()]
    axes.set_xlabel(f"distance from the goal [mm]{notes[0]}")
    axes.set_ylabel(f"angle from the goal [deg]{notes[1]}")
    axes.axvline(goal[0], color=style.INK, linewidth=0.8, linestyle=(0, (1, 2)))
    axes.axhline(goal[1], color=style.INK, linewidth=0.8, linestyle=(0, (1, 2)))
    axes.legend(loc="upper center", bbox_to_anchor=(0.5, -0.13), ncols=3, fontsize=8)
    beyond = len(study.records) - len(records)
    title = f"ends of {len(records)} samples" + (f"; {beyond} never started" if beyond else "")
    axes.set_title(title, fontsize=9)
