"""Figures of results: comparisons, predictions, studies of robustness, sweeps, searches.

A sweep is a curve over one parameter, contours over two, small multiples beyond. Points without a
plan have the colour of their reason. Only contour lines are interpolated.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from itertools import cycle, groupby
from textwrap import fill
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.contour import ContourSet
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Polygon, Rectangle
from matplotlib.patheffects import withStroke
from matplotlib.ticker import FuncFormatter, LogLocator, MaxNLocator, NullFormatter

from ..common.arrays import Array
from ..common.document import show
from ..common.errors import InputError
from ..common.sharing import exclusive
from ..planning.options import Objective
from ..verification.newton_euler import place_object
from . import style
from .plots import draw_margins, draw_phases, trace_link

if TYPE_CHECKING:
    from ..analysis.comparison import Comparison
    from ..analysis.robustness import Robustness
    from ..analysis.slow_speeds import PhasePrediction, Prediction
    from ..design.hand import Design
    from ..design.sensitivities import Sensitivities
    from ..design.sweep import Sweep

MOST = 24  # largest number of panels, and of lines of a panel
LABELLED = 0.08  # least fraction of the points of a panel with which their reason is written
LEVELS = 8  # largest number of contour lines, which are the ticks of the colour bar
# White with a dark edge, to be seen on any colour.
CONTOUR: Any = {"color": "white", "linewidth": 0.9}
CONTOUR["path_effects"] = [withStroke(linewidth=1.9, foreground=style.INK)]
Row = dict[str, Any]  # of a sweep
Lines = Mapping[str, Sequence[Row]]  # rows by common values of other parameters
_DOT = "  \u00b7  "  # between the parts of a title
_KINDS = (
    ("goal reached, contacts kept", style.PALETTE[2], "o"),
    ("goal reached, a contact lost", style.PALETTE[0], "s"),
    ("goal missed", style.PALETTE[6], "x"),
)
"""Outcomes of samples, with colour and mark."""


@exclusive
def draw_comparison(comparison: Comparison) -> Figure:
    """Draw c_n - epsilon of every contact over time: a panel for each plan, on one scale of time.

    Replays are drawn. Those that have not moved have no panel, but their verdict.
    """
    replays = [(contender, contender.replayed) for contender in comparison.contenders]
    motions = [motion for _, motion in replays if motion is not None]
    names = dict.fromkeys(name for motion in motions for name in motion.contacts)
    styles = style.choose_styles(tuple(names))
    longest = max((motion.duration for motion in motions), default=1.0)
    # Height of a panel, and of a line of text above it, and room at both sides [in].
    height, line, left, right = 2.45, 0.25, 0.8, 1.3
    top = 0.5 + len(motions) * (height + line + 0.4) + len(replays) * line
    all_margins = np.concatenate([[0.0], *(m.c_n.ravel() - comparison.epsilon for m in motions)])
    with style.open_figure(10.0, top) as figure:
        title = f"{comparison.name}{_DOT}force margins{_DOT}\u03b5 = {comparison.epsilon:g} N"
        style.write_title(figure, title)
        look: Any = {"fontsize": 9, "color": style.INK, "parse_math": False, "va": "bottom"}
        look["transform"] = figure.dpi_scale_trans
        top -= 0.35
        for contender, motion in replays:
            top -= line
            result = f"{contender.duration:.4g} s" if contender.ok else contender.reason
            separator = _DOT if contender.ok else ": "
            heading = f"{contender.name}{_DOT}{contender.verdict}{separator}{result}"
            figure.text(left, top, heading, **look)
            if motion is None:
                continue
            top -= height + line
            axes = style.inset(figure, left, top, 10.0 - left - right, height)
            top -= 0.4
            draw_margins(axes, motion, comparison.epsilon, styles, all_margins)
            axes.set_xlim(0.0, longest)
            draw_phases(axes, motion.phase_starts, span=longest)
            style.list_contacts(axes, 72 * height)
            axes.set_ylabel(f"$c_n - \\varepsilon$ {style.unit_of(axes)}")
            axes.set_xlabel("time $t$ [s]" if motion is motions[-1] else "")
    return figure


@exclusive
def draw_prediction(prediction: Prediction) -> Figure:
    """Draw the least normal force over speed: a panel for each phase, a line for each motion."""
    phases = [phase for phase in prediction.phases if phase.curves is not None]
    columns = min(3, max(len(phases), 2))
    rows = max(math.ceil(len(phases) / columns), 1)
    # Size of a panel with texts and margins, and these margins [in].
    (width, height), (left, right, bottom, top) = (3.7, 2.85), (0.62, 0.15, 0.50, 0.80)
    scales = [_measure_force(phase, prediction.epsilon) for phase in phases]
    prefix, factor = style.choose_prefix(2.2 * max(scales, default=prediction.epsilon))
    with style.open_figure(columns * width, rows * height + 0.45) as figure:
        for k, phase in enumerate(phases):
            row, column = divmod(k, columns)
            corner = column * width + left, (rows - 1 - row) * height + bottom
            axes = style.inset(figure, *corner, width - left - right, height - bottom - top)
            _draw_phase(axes, phase, prediction.epsilon)
            axes.yaxis.set_major_formatter(FuncFormatter(lambda force, _: f"{factor * force:g}"))
            axes.set_ylabel(f"least $c_n$ [{prefix}N]" if column == 0 else "")
            axes.set_xlabel("speed along the phase [m/s]" if k >= len(phases) - columns else "")
        name = f"{prediction.name}{_DOT}quasistatic motions at speed"
        style.write_title(figure, f"{name}{_DOT}\u03b5 = {prediction.epsilon:g} N", left=0.15)
    return figure


def _measure_force(phase: PhasePrediction, epsilon: float) -> float:
    """The largest of the forces at the least speeds that motions have [N], at least epsilon."""
    assert phase.curves is not None
    forces = phase.curves.force.values()
    return max([epsilon, *(float(finite[0]) for f in forces if len(finite := f[np.isfinite(f)]))])


def _draw_phase(axes: Axes, phase: PhasePrediction, epsilon: float) -> None:
    """Curves of one phase with their limit speeds, and above them the limits that are violated."""
    curves = phase.curves
    assert curves is not None
    low, high = _measure_force(phase, epsilon) * np.array([-0.35, 2.2])
    axes.axhspan(0.0, epsilon, color=style.LOW, linewidth=0, zorder=1)
    axes.axhspan(low, 0.0, color=style.LOST, linewidth=0, zorder=1)
    axes.axhline(epsilon, color="black", linewidth=1.0, zorder=2)
    caption: Any = {"xycoords": "axes fraction", "ha": "left", "va": "bottom"}
    for k, survival in enumerate(phase.survivals):
        colour, (dash, _) = style.PALETTE[k], style.LINES[k % 3]
        look: Any = {"color": colour, "linestyle": dash, "linewidth": 1.9}
        # Where the force breaks off the curve falls through the lower edge.
        force = np.maximum(curves.force[survival.motion], 2 * low)
        axes.plot(curves.speed, force, zorder=3 + k, **look)
        if survival.speed:
            axes.plot(survival.speed, epsilon, "o", color=colour, markersize=5, zorder=6)
        again = "never" if survival.again is None else f"only from {survival.again:.3g} m/s on"
        speed = f"{survival.speed:.3g} m/s" if survival.speed else again
        failure = f"{speed}: {survival.first.name}"
        failure = "keeps \u03b5 at any speed" if survival.speed is None else failure
        text = f"{survival.motion}, {failure}"
        caption["fontsize"] = 7.5 * min(1.0, 54 / len(text))  # to be no wider than the panel
        style.write(axes, text, (0, 1), (0, 29 - 12 * k), color=colour, **caption)
    if not any(np.isfinite(force).any() for force in curves.force.values()):
        middle: Any = {"transform": axes.transAxes, "ha": "center", "va": "center", "zorder": 7}
        axes.text(0.5, 0.8, "no slow motion keeps its limits", color=style.INK, **middle)
    title = f"phase {phase.number}, until {phase.until}"
    caption |= {"fontsize": 9 * min(1.0, 38 / len(title)), "fontweight": "bold"}
    style.write(axes, title, (0, 1), (0, 41), color=style.INK, **caption)
    axes.set(xscale="log", xlim=(curves.speed[0], curves.speed[-1]), ylim=(low, high))
    # Ticks are as dense as their labels allow: a digit is 5.7 points wide.
    ends = np.log10(curves.speed[[0, -1]])
    digits = max(len(f"{10.0 ** math.floor(end):g}".replace(".", "")) for end in ends)
    label = (5.7 * digits + 6.0) * axes.figure.dpi / 72 / axes.bbox.width * np.ptp(ends)  # decades
    ticks = (1.0, 2.0, 3.0, 5.0) if label < 0.17 else (1.0, 2.0, 5.0) if label < 0.3 else (1.0,)
    axes.xaxis.set_major_locator(LogLocator(subs=ticks))
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
    """Index of the outcome of a sample: kept, reached, missed."""
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
        body = Polygon(1e3 * place_object(scene, path[-1:])[0], fill=False, ec=colour)
        axes.add_patch(body).set(linewidth=0.5, alpha=0.35, zorder=2)
    ends = place_object(scene, nominal[[0, -1]])
    for corners, dash in zip(ends, ((0, (4, 2)), "-"), strict=True):
        body = Polygon(1e3 * corners, fill=False, ec=style.INK, linestyle=dash)
        axes.add_patch(body).set(linewidth=1.2, zorder=5)
    axes.plot(*(1e3 * nominal[:, :2].T), color=style.INK, linewidth=1.6, zorder=4)
    axes.autoscale_view()
    (left, right), (low, high) = axes.get_xlim(), axes.get_ylim()
    depth = 1e3 * style.PALM * scene.scales.length
    axes.add_patch(Rectangle((left, -depth), right - left, depth, fc=style.INK, lw=0, zorder=1))
    axes.set(xlim=(left, right), ylim=(low, high), xlabel="x [mm]", ylabel="y [mm]")
    axes.set_title("centroid's paths, poses at the start (dashed) and the end", fontsize=9)


def _draw_ends(axes: Axes, study: Robustness) -> None:
    records = [record for record in study.records if "distance" in record]
    uncertainty, scene = study.trial.uncertainty, study.trial.problem.scene
    goal = 1e3 * uncertainty.find_distance(scene), math.degrees(uncertainty.angle)
    deviations = [(1e3 * record["distance"], math.degrees(record["angle"])) for record in records]
    floor = 1e-4  # [mm] and [deg]: lesser ones are drawn so
    places = np.maximum(np.array(deviations).reshape(-1, 2), floor)
    kinds = np.array([find_kind(record) for record in records])
    for kind, (label, colour, marker) in enumerate(_KINDS):
        points = places[kinds == kind]
        text = f"{label}: {len(points)} of {len(study.records)}"
        axes.plot(*points.T, marker, ms=3.5, color=colour, alpha=0.7, label=text, mew=0.9)
    axes.set(xscale="log", yscale="log")
    points_all = np.vstack([places, goal])
    # Whole powers of ten, so that both ends of an axis have a number.
    low = 0.8 * 10 ** np.floor(np.log10(points_all.min(axis=0)))
    high = 1.25 * 10 ** np.ceil(np.log10(points_all.max(axis=0)))
    axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]))
    notes = [f" (at least {floor:g})" * (min(column) <= floor) for column in points_all.T.tolist()]
    axes.set_xlabel(f"distance from the goal [mm]{notes[0]}")
    axes.set_ylabel(f"angle from the goal [deg]{notes[1]}")
    axes.axvline(goal[0], color=style.INK, linewidth=0.8, linestyle=(0, (1, 2)))
    axes.axhline(goal[1], color=style.INK, linewidth=0.8, linestyle=(0, (1, 2)))
    axes.legend(loc="upper center", bbox_to_anchor=(0.5, -0.13), ncols=2, fontsize=8)
    absent = len(study.records) - len(records)
    title = f"ends of {len(records)} samples" + (f"; {absent} never started" if absent else "")
    axes.set_title(title, fontsize=9)


def choose_axes(
    vary: Mapping[str, Sequence[Any]], samples: int, problems: int
) -> tuple[list[str], list[str]]:
    """Names of the parameters on axes, and of those with one line or panel for each value.

    InputError if a grid has more than three parameters, or there are too many panels.
    """
    varied = [name for name, values in vary.items() if len(values) > 1]
    numeric = [k for k in varied if all(type(v) in (int, float) for v in vary[k])]
    if not numeric or (len(numeric) > 3 and not samples):
        text = f"drawn are 1 to 3 parameters with several numbers, and not {len(numeric)}"
        raise InputError("", "--figure", f"{text}; --samples may have any number")
    axes = numeric if samples else numeric[:2]
    fixed = [] if samples else [name for name in varied if name not in axes]
    if max(len(axes), problems * math.prod(len(vary[name]) for name in fixed)) > MOST:
        raise InputError("", "--figure", f"more than {MOST} panels or lines; vary fewer values")
    return axes, fixed


def draw_sweep(sweep: Sweep) -> Figure:
    """Draw the values over the parameters, and the reasons of missing ones.

    Over one parameter, problems and words are lines; over two they are panels. Samples have a panel
    for each parameter.

    InputError as `choose_axes`.
    """
    names, fixed = choose_axes(sweep.vary, sweep.samples, len(sweep.problems))
    lines = dict[str, list[Row]]()
    for row in sweep.rows:
        parts = [row["problem"]] if len(sweep.problems) > 1 else []
        parts += [f"{name} = {show(row[name], '.6g')}" for name in fixed]
        lines.setdefault(", ".join(parts), []).append(row)
    contours = len(names) == 2 and not sweep.samples
    panels = [{name: rows} for name, rows in lines.items()] if contours else [lines for _ in names]
    reasons = sweep.reasons
    crosses = not contours and (len(lines) > 1 or sweep.samples > 0)
    # Crosses have other colours than the curves beside them.
    palette = np.roll(style.PALETTE, -len(lines) * crosses).tolist()
    colours = dict(zip(reasons, cycle(palette), strict=False))
    columns = 2 if len(panels) == 4 else min(3, len(panels))
    height = 1.2 + 3.0 * math.ceil(len(panels) / columns) + 0.17 * min(len(reasons), 8)
    with style.open_figure(10.0 if columns > 1 else 7.0, height, layout="constrained") as figure:
        grid = figure.subplots(math.ceil(len(panels) / columns), columns, squeeze=False)
        for k, (axes, panel) in enumerate(zip(grid.flat, panels, strict=False)):
            if contours:
                ((title, rows),) = panel.items()
                axes.set_title(title, fontsize=9, parse_math=False)
                mesh = _draw_plane(axes, sweep, names, rows, colours)
            else:
                _draw_lines(axes, sweep, names[k], panel, colours)
            # Few labels with few digits do not overlap.
            axes.locator_params(axis="x", nbins=6)
            axes.ticklabel_format(axis="x", scilimits=(-2, 4))
        for axes in grid.flat[len(panels) :]:
            axes.remove()
        if contours and sweep.ok:
            look: Any = {"label": sweep.label, "ticks": MaxNLocator(LEVELS)}
            bar = figure.colorbar(mesh, ax=list(grid.flat[: len(panels)]), **look)
            contours_drawn = [contour for axes in grid.flat for contour in axes.findobj(ContourSet)]
            if any(len(line) for contour in contours_drawn for line in contour.get_paths()):
                bar.ax.grid(axis="y", **CONTOUR)
        keys = list[Line2D]()
        for reason, count in [*reasons.items()][:8]:
            look = {"color": colours[reason] if crosses else _lighten(colours[reason])}
            look |= {"marker": "sx"[crosses], "label": fill(f"{reason}: {count}", 110)}
            keys.append(Line2D([], [], linestyle="", **look))
        if keys:
            look = {"loc": "outside lower left", "alignment": "left", "fontsize": 8}
            figure.legend(handles=keys, title="points without a plan, by reason", **look)
        figure.suptitle(", ".join(sweep.problems), fontsize=10, parse_math=False)
    return figure


def _lighten(colour: str) -> tuple[float, float, float]:
    red, green, blue = (0.7 + 0.3 * int(colour[k : k + 2], 16) / 255 for k in (1, 3, 5))
    return red, green, blue


def _values(rows: Sequence[Row]) -> tuple[Array, list[str]]:
    """Values of rows, NaN without a plan, and reasons, empty with a plan."""
    values = np.array([row["value"] for row in rows], dtype=float)
    return values, [row.get("reason", "") for row in rows]


def _cell_edges(places: Array) -> Array:
    """Borders of cells around places, half way between them."""
    return np.concatenate([places[:1], (places[1:] + places[:-1]) / 2, places[-1:]])


def _write(axes: Axes, reason: str, colour: str, x: float, y: float, transform: Any) -> None:
    box = {"facecolor": _lighten(colour), "linewidth": 0, "pad": 1.5}
    look: Any = {"ha": "center", "va": "center", "fontsize": 7.5, "color": style.INK, "bbox": box}
    text = fill(reason if len(reason) <= 60 else f"{reason[:57]}...", 18)
    axes.text(x, y, text, transform=transform, parse_math=False, **look)


def _draw_lines(
    axes: Axes, sweep: Sweep, name: str, lines: Lines, colours: Mapping[str, str]
) -> None:
    """Values over one parameter.

    A single curve has bands in the colour of the reason where it has no value. Several lines, and
    samples, have a row of crosses each, in a band below all values.
    """
    axes.set(xlabel=sweep.titles[name], ylabel=sweep.label)
    axes.grid(color=style.GRID, linewidth=0.4)
    single, transform = len(lines) == 1 and not sweep.samples, axes.get_xaxis_transform()
    height = min(0.05, 0.4 / len(lines))  # height of a row of crosses, over that of the axes
    for number, (label, rows) in enumerate(lines.items()):
        rows = sorted(rows, key=lambda row: row[name])
        x = np.array([row[name] for row in rows], dtype=float)
        (values, reasons), (dash, marker) = _values(rows), style.LINES[number % len(style.LINES)]
        look: Any = {"color": style.PALETTE[number % len(style.PALETTE)], "marker": marker, "ms": 3}
        axes.plot(x, values, linestyle="" if sweep.samples else dash, label=label, **look)
        height_of_row, borders, first = height * (number + 0.5), _cell_edges(x), 0
        if len(lines) > 1 and any(reasons):
            axes.plot(-0.02, height_of_row, transform=axes.transAxes, clip_on=False, **look)
        for reason, group in groupby(reasons):
            last = first + len(list(group))
            left, right, colour = borders[first], borders[last], colours.get(reason, "")
            if reason and single:
                axes.axvspan(left, right, color=_lighten(colour), linewidth=0, zorder=1)
                if last - first > LABELLED * len(rows):
                    _write(axes, reason, colour, (left + right) / 2, 0.5, transform)
            elif reason:
                places = np.full(last - first, height_of_row)
                axes.plot(x[first:last], places, "x", color=colour, transform=transform)
            first = last
    if not sweep.ok:
        axes.set(yticks=[], ylabel="")
    if not single and sweep.reasons:
        bottom, top = axes.get_ylim()
        low = top - (top - bottom) / (1 - height * len(lines))
        axes.set(yticks=[y for y in axes.get_yticks() if bottom <= y <= top], ylim=(low, top))
        axes.axhspan(low, bottom, color=style.BAND, linewidth=0, zorder=1)
    if len(lines) > 1:
        axes.legend(fontsize=8)


def _draw_plane(
    axes: Axes, sweep: Sweep, names: Sequence[str], rows: Sequence[Row], colours: Mapping[str, str]
) -> Any:
    """Values over two parameters as cells, with contour lines, and regions without a plan."""
    axes.set(xlabel=sweep.titles[names[0]], ylabel=sweep.titles[names[1]])
    x, y = (np.sort(np.array(sweep.vary[name], dtype=float)) for name in names)
    values, reasons = _values(sorted(rows, key=lambda row: [row[name] for name in names]))
    values, all_values = values.reshape(len(x), len(y)).T, _values(sweep.rows)[0]
    low, high = (np.nanmin(all_values), np.nanmax(all_values)) if sweep.ok else (0.0, 1.0)
    look = "viridis" if sweep.objective is Objective.MARGIN else "viridis_r"
    borders = _cell_edges(x), _cell_edges(y)
    mesh = axes.pcolormesh(*borders, values, vmin=low, vmax=high, cmap=look)
    if np.isfinite(values).sum() > 3 and np.nanmax(values) > np.nanmin(values):
        levels, masked = MaxNLocator(LEVELS).tick_values(low, high), np.ma.masked_invalid(values)
        # Lines that are bent would be filled with the colour.
        axes.contour(x, y, masked, levels).set(**CONTOUR, facecolor="none")
    shades, reason_grid = np.zeros((*values.shape, 4)), np.array(reasons).reshape(len(x), len(y)).T
    for reason, colour in colours.items():
        mask = reason_grid == reason
        shades[mask] = *_lighten(colour), 1.0
        if mask.mean() > LABELLED and mask.any(axis=0).mean() > 0.35:  # wide enough
            below, left = np.nonzero(mask)
            # Cells at the edges are halves: their middles differ from the values.
            x_mid, y_mid = (
                (edges[k] + edges[k + 1]).mean() / 2
                for edges, k in zip(borders, (left, below), strict=True)
            )
            _write(axes, reason, colour, x_mid, y_mid, axes.transData)
    axes.pcolormesh(*borders, shades)
    return mesh


@exclusive
def draw_sensitivities(result: Sensitivities) -> Figure:
    """Draw the effects of 1 % more of each number, by parts of the plan, the largest first."""
    rows = [row for row in result.rows if row.percent]
    titles, count = [f"{row.name} = {row.given:.4g} {row.unit}" for row in rows], range(len(rows))
    height, left = 0.24 * len(rows), 0.4 + 0.075 * max(map(len, titles), default=0)
    with style.open_figure(style.WIDTH, height + 1.1) as figure:
        axes = style.inset(figure, left, 0.6, style.WIDTH - left - 2.2, height)
        # Lines at the outermost ends of bars need a margin, which bars without a width take away.
        axes.use_sticky_edges = False
        effects = 0.01 * np.array([[row.given * slope for slope in row.phases] for row in rows])
        for k, (part, bars) in enumerate(zip(result.parts, effects.T, strict=True)):
            offsets = np.where(effects[:, :k] * bars[:, None] > 0, effects[:, :k], 0.0).sum(axis=1)
            colour = style.PALETTE[k % len(style.PALETTE)]
            axes.barh(count, bars, 0.7, offsets, color=colour, label=f"phase {part}")
        axes.barh(count, 0.0, 0.84, [row.percent for row in rows], edgecolor=style.INK, lw=1.6)
        for k, row in enumerate(rows):
            text = row.limit + " (one-sided)" * bool(row.note)
            axes.text(1.02, k, text, transform=axes.get_yaxis_transform(), va="center", fontsize=8)
        axes.axvline(0.0, color=style.INK, linewidth=0.8)
        axes.set_yticks(count, titles)
        label = f"1 % more changes the {result.objective} [{result.unit}]; line: in all"
        axes.set(ylim=(len(rows) - 0.4, -0.6), xlabel=label)
        axes.legend(loc="lower right", fontsize=8)
        style.write_title(figure, result.document.head)
        return figure


@exclusive
def draw_search(result: Design) -> Figure:
    """Draw costs and numbers of all evaluated hands, with lines for the best so far."""
    from ..design.hand import COST_TOLERANCE

    choices, width = result.aim.choices, style.WIDTH - 3.4
    with style.open_figure(style.WIDTH, 3.1 + len(choices)) as figure:
        tall = float(figure.get_size_inches()[1])
        first = style.inset(figure, 1.2, tall - 2.4, width, 2.0)
        others = [style.inset(figure, 1.2, tall - 3.4 - k, width, 0.8) for k in range(len(choices))]
        starts = sorted({hand.start for hand in result.hands})
        # Hands with much larger costs are drawn on the upper edge.
        costs_of_plans = [hand.cost for hand in result.hands if not hand.reason]
        low, high = np.quantile(costs_of_plans, [0.0, 0.95], method="higher")
        pad = max(0.1 * (high - low), COST_TOLERANCE * abs(low), 1e-9)
        low, high = low - pad, high + pad / 2
        for start, colour in zip(starts, style.PALETTE * len(starts), strict=False):
            hands = [hand for hand in result.hands if hand.start == start]
            costs, number = np.array([hand.cost for hand in hands]), 1 + np.arange(len(hands))
            best, failed = np.fmin.accumulate(costs), number[np.isnan(costs)]
            # The best hand so far. Values of hands without a plan are NaN.
            leader = np.maximum.accumulate(np.where(costs <= best, number - 1, 0))
            values = np.array([result.aim.find(hand) for hand in hands]).T + 0 * costs
            columns, label = [np.minimum(costs, high), *values], f"start {start}"
            for axes, column in zip([first, *others], columns, strict=True):
                axes.plot(number, column, ".", color=colour, alpha=0.4, clip_on=False)
                axes.step(number, column[leader], color=colour, where="post", label=label)
            transform = first.get_xaxis_transform()
            first.plot(failed, 0 * failed + 0.03, "x", color=colour, transform=transform)
        first.set(ylim=(low, high), ylabel=result.label)
        first.legend(bbox_to_anchor=(1.01, 1.0), loc="upper left")
        for axes, choice in zip(others, choices, strict=True):
            pad = 0.05 * (choice.high - choice.low)
            axes.set_ylim(choice.low - pad, choice.high + pad)
            title = choice.parameter.title
            axes.text(1.02, 0.5, title, transform=axes.transAxes, va="center")
        for axes in (first, *others):
            axes.sharex(others[-1])
            axes.tick_params(labelbottom=axes is others[-1])
            axes.ticklabel_format(axis="y", useOffset=False)
        others[-1].locator_params(axis="x", integer=True, min_n_ticks=1)
        others[-1].set_xlabel("hands tried; x: no plan; on the upper edge: more")
        ends = [f"{p.problem.name}{_DOT}{p.value:.6g} {p.unit}" for p in result.plans]
        style.write_title(figure, ", ".join(ends))
        return figure
