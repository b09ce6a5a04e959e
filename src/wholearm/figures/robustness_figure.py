"""The nominal motion with its noisy copies, and how far each ends from the goal."""

from __future__ import annotations

import math
from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.patches import Polygon as Outline
from matplotlib.patches import Rectangle

from ..robustness.sampling import Robustness
from .snapshots import place_vertices, trace_link
from .style import FINGERS, INK, PALETTE, PALM, STYLE

_KINDS = (
    ("contacts kept too", PALETTE[2], "o"),
    ("goal reached", PALETTE[0], "s"),
    ("goal missed", PALETTE[6], "x"),
)
"""What becomes of a sample, its colour and its mark."""
_LEAST = 1e-4  # what lesser distances [mm] and angles [deg] are drawn as


def draw_robustness(study: Robustness) -> Figure:
    """Draw paths and ends of the samples beside the nominal motion.

    Returns
    -------
    Figure  axes in the order: hand and paths of the centroid, to scale; distances and angles from
            the goal
    """
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(10.0, 4.6), layout="constrained")
        FigureCanvasAgg(figure)
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
    for finger, angle, (line, face) in zip(scene.fingers, nominal[-1, 3:], FINGERS, strict=True):
        outline = 1e3 * trace_link(finger, float(angle))
        axes.add_patch(Outline(outline, fc=face, ec=line, linewidth=0.9, zorder=1))
    copies = [record for record in study.records if "path" in record]
    for record in sorted(copies, key=find_kind):
        path = np.array(record["path"])
        colour = _KINDS[find_kind(record)][1]
        axes.plot(*(1e3 * path[:, :2].T), color=colour, linewidth=0.6, alpha=0.5, zorder=3)
        body = Outline(1e3 * place_vertices(scene, path[-1]), fill=False, ec=colour)
        axes.add_patch(body).set(linewidth=0.5, alpha=0.35, zorder=2)
    for z, dash in ((nominal[0], (0, (4, 2))), (nominal[-1], "-")):
        body = Outline(1e3 * place_vertices(scene, z), fill=False, ec=INK, linestyle=dash)
        axes.add_patch(body).set(linewidth=1.2, zorder=5)
    axes.plot(*(1e3 * nominal[:, :2].T), color=INK, linewidth=1.6, zorder=4)
    axes.autoscale_view()
    (left, right), (low, high) = axes.get_xlim(), axes.get_ylim()
    deep = 1e3 * PALM * scene.scales.length
    axes.add_patch(Rectangle((left, -deep), right - left, deep, fc=INK, linewidth=0, zorder=1))
    axes.set(xlim=(left, right), ylim=(low, high), xlabel="x [mm]", ylabel="y [mm]")
    axes.set_title("centroid's paths, poses at the start (dashed) and the end", fontsize=9)


def _draw_ends(axes: Axes, study: Robustness) -> None:
    records = [record for record in study.records if "distance" in record]
    known = study.trial.uncertainty
    goal = 1e3 * known.find_distance(study.trial.problem.scene), math.degrees(known.angle)
    given = [(1e3 * own["distance"], math.degrees(own["angle"])) for own in records]
    places = np.maximum(np.array(given).reshape(-1, 2), _LEAST)
    kinds = np.array([find_kind(record) for record in records])
    for kind, (label, colour, marker) in enumerate(_KINDS):
        own = places[kinds == kind]
        text = f"{label}: {len(own)}"
        axes.plot(*own.T, marker, ms=3.5, color=colour, alpha=0.7, label=text, mew=0.9)
    axes.set(xscale="log", yscale="log")
    around = np.vstack([places, goal])
    # Whole powers of ten, so that both ends of an axis have a number.
    low = 0.8 * 10 ** np.floor(np.log10(around.min(axis=0)))
    high = 1.25 * 10 ** np.ceil(np.log10(around.max(axis=0)))
    axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]))
    least = [f" (at least {_LEAST:g})" if min(own) <= _LEAST else "" for own in around.T.tolist()]
    axes.set_xlabel(f"distance from the goal [mm]{least[0]}")
    axes.set_ylabel(f"angle from the goal [deg]{least[1]}")
    axes.axvline(goal[0], color=INK, linewidth=0.8, linestyle=(0, (1, 2)))
    axes.axhline(goal[1], color=INK, linewidth=0.8, linestyle=(0, (1, 2)))
    axes.legend(loc="upper center", bbox_to_anchor=(0.5, -0.13), ncols=3, fontsize=8)
    beyond = len(study.records) - len(records)
    title = f"ends of {len(records)} samples" + (f"; {beyond} never started" if beyond else "")
    axes.set_title(title, fontsize=9)
