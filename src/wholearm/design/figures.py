"""Figures of sweeps, of sensitivities, and of the search for the best hand.

A sweep is a curve over one parameter, contours over two, small multiples beyond. Points without a
plan have the colour of their reason. Nothing is interpolated but contour lines.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from itertools import groupby
from textwrap import fill
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Patch
from matplotlib.ticker import MaxNLocator

from ..common.arrays import Array
from ..common.errors import InputError
from ..common.sharing import exclusive
from ..figures.style import GRID, INK, LINES, PALETTE, WIDTH, inset, open_figure, write_title
from ..planning.options import Objective
from .sweep import Row, Sweep, show_value

if TYPE_CHECKING:
    from .hand import Design
    from .sensitivities import Sensitivities

MOST = 24  # panels, and lines of a panel
SHARE = 0.08  # of the points of a panel, from which their reason is written there
Lines = Mapping[str, Sequence[Row]]  # rows by what they have in common


def choose_axes(
    vary: Mapping[str, Sequence[Any]], samples: int, problems: int
) -> tuple[list[str], list[str]]:
    """Names of the parameters that are axes, and of those that lines or panels are for.

    InputError if a grid has more than three parameters, or there are too many panels.
    """
    several = [name for name, values in vary.items() if len(values) > 1]
    numeric = [k for k in several if all(type(v) in (int, float) for v in vary[k])]
    if not numeric or (len(numeric) > 3 and not samples):
        text = f"drawn are 1 to 3 parameters with several numbers, and not {len(numeric)}"
        raise InputError("", "--figure", f"{text}; --samples may have any number")
    shown = numeric if samples else numeric[:2]
    fixed = [] if samples else [name for name in several if name not in shown]
    if max(len(shown), problems * math.prod(len(vary[name]) for name in fixed)) > MOST:
        raise InputError("", "--figure", f"more than {MOST} panels or lines; vary fewer values")
    return shown, fixed


def draw_sweep(sweep: Sweep) -> Figure:
    """Draw the values over the parameters, and why there are none where there are none.

    Over one parameter, problems and words are lines; over two they are panels. Samples have a panel
    for each parameter.

    InputError as `choose_axes`.
    """
    shown, fixed = choose_axes(sweep.vary, sweep.samples, len(sweep.problems))
    lines = dict[str, list[Row]]()
    for row in sweep.rows:
        parts = [row["problem"]] if len(sweep.problems) > 1 else []
        parts += [f"{name} = {show_value(row[name])}" for name in fixed]
        lines.setdefault(", ".join(parts), []).append(row)
    contours = len(shown) == 2 and not sweep.samples
    panels = [{name: rows} for name, rows in lines.items()] if contours else [lines for _ in shown]
    reasons = sweep.reasons
    colours = {reason: PALETTE[k % len(PALETTE)] for k, reason in enumerate(reasons)}
    columns = 2 if len(panels) == 4 else min(3, len(panels))
    height = 1.2 + 3.0 * math.ceil(len(panels) / columns) + 0.17 * min(len(reasons), 8)
    with open_figure(10.0 if columns > 1 else 7.0, height, layout="constrained") as figure:
        grid = figure.subplots(math.ceil(len(panels) / columns), columns, squeeze=False)
        for k, (axes, panel) in enumerate(zip(grid.flat, panels, strict=False)):
            if contours:
                ((title, rows),) = panel.items()
                axes.set_title(title, fontsize=9, parse_math=False)
                mesh = _draw_plane(axes, sweep, shown, rows, colours)
            else:
                _draw_lines(axes, sweep, shown[k], panel, colours)
        for axes in grid.flat[len(panels) :]:
            axes.remove()
        if contours:
            figure.colorbar(mesh, ax=list(grid.flat[: len(panels)]), label=sweep.label)
        patches = [
            Patch(color=_pale(colours[reason]), label=fill(f"{reason}: {count}", 110))
            for reason, count in [*reasons.items()][:8]
        ]
        if patches:
            look: Any = {"loc": "outside lower left", "alignment": "left", "fontsize": 8}
            figure.legend(handles=patches, title="points without a plan, by reason", **look)
        figure.suptitle(", ".join(sweep.problems), fontsize=10, parse_math=False)
    return figure


def _pale(colour: str) -> tuple[float, float, float]:
    red, green, blue = (0.7 + 0.3 * int(colour[k : k + 2], 16) / 255 for k in (1, 3, 5))
    return red, green, blue


def _take(rows: Sequence[Row]) -> tuple[Array, list[str]]:
    """Values of rows, NaN without a plan, and reasons, empty with a plan."""
    values = np.array([row["value"] for row in rows], dtype=float)
    return values, [row.get("reason", "") for row in rows]


def _border(places: Array) -> Array:
    """Borders of cells around places, half way between them."""
    return np.concatenate([places[:1], (places[1:] + places[:-1]) / 2, places[-1:]])


def _write(axes: Axes, reason: str, colour: str, x: float, y: float, transform: Any) -> None:
    box = {"facecolor": _pale(colour), "linewidth": 0, "pad": 1.5}
    look: Any = {"ha": "center", "va": "center", "fontsize": 7.5, "color": INK, "bbox": box}
    text = fill(reason if len(reason) <= 60 else f"{reason[:57]}...", 18)
    axes.text(x, y, text, transform=transform, parse_math=False, **look)


def _draw_lines(
    axes: Axes, sweep: Sweep, name: str, lines: Lines, colours: Mapping[str, str]
) -> None:
    """Values over one parameter.

    Where a curve alone has no value, there is a band in the colour of the reason. Several lines,
    and samples, have a row of crosses each at the bottom.
    """
    axes.set(xlabel=sweep.titles[name], ylabel=sweep.label)
    axes.grid(color=GRID, linewidth=0.4)
    single, across = len(lines) == 1 and not sweep.samples, axes.get_xaxis_transform()
    for number, (label, rows) in enumerate(lines.items()):
        rows = sorted(rows, key=lambda row: row[name])
        x = np.array([row[name] for row in rows], dtype=float)
        (values, reasons), (dash, marker) = _take(rows), LINES[number % len(LINES)]
        look: Any = {"color": PALETTE[number % len(PALETTE)], "marker": marker, "markersize": 3.0}
        axes.plot(x, values, linestyle="" if sweep.samples else dash, label=label, **look)
        strip, borders, first = 0.05 * number + 0.025, _border(x), 0
        if len(lines) > 1 and any(reasons):
            axes.plot(0.0, strip, transform=axes.transAxes, clip_on=False, **look)
        for reason, group in groupby(reasons):
            last = first + len(list(group))
            left, right, colour = borders[first], borders[last], colours.get(reason, "")
            if reason and single:
                axes.axvspan(left, right, color=_pale(colour), linewidth=0, zorder=1)
                if last - first > SHARE * len(rows):
                    _write(axes, reason, colour, (left + right) / 2, 0.5, across)
            elif reason:
                places = np.full(last - first, strip)
                axes.plot(x[first:last], places, "x", color=colour, transform=across)
            first = last
    if not single:
        bottom, top = axes.get_ylim()
        axes.set_ylim(top - (top - bottom) / (1 - 0.05 * len(lines)), top)
    if len(lines) > 1:
        axes.legend(fontsize=8)


def _draw_plane(
    axes: Axes, sweep: Sweep, shown: Sequence[str], rows: Sequence[Row], colours: Mapping[str, str]
) -> Any:
    """Values over two parameters as cells, with contour lines, and regions without a plan."""
    axes.set(xlabel=sweep.titles[shown[0]], ylabel=sweep.titles[shown[1]])
    x, y = (np.sort(np.array(sweep.vary[name], dtype=float)) for name in shown)
    values, reasons = _take(sorted(rows, key=lambda row: [row[name] for name in shown]))
    values, every = values.reshape(len(x), len(y)).T, _take(sweep.rows)[0]
    low, high = (np.nanmin(every), np.nanmax(every)) if sweep.ok else (0.0, 1.0)
    look = "viridis" if sweep.objective is Objective.MARGIN else "viridis_r"
    mesh = axes.pcolormesh(_border(x), _border(y), values, vmin=low, vmax=high, cmap=look)
    if np.isfinite(values).sum() > 3 and np.nanmax(values) > np.nanmin(values):
        levels = MaxNLocator(8).tick_values(low, high)
        shown_values = np.ma.masked_invalid(values)
        lines = axes.contour(x, y, shown_values, levels, colors="white", linewidths=0.9)
        axes.clabel(lines, fontsize=7.5)
    shades, names = np.zeros((*values.shape, 4)), np.array(reasons).reshape(len(x), len(y)).T
    for reason, colour in colours.items():
        here = names == reason
        shades[here] = *_pale(colour), 1.0
        if here.mean() > SHARE and here.any(axis=0).mean() > 0.35:  # wide enough
            below, left = np.nonzero(here)
            _write(axes, reason, colour, x[left].mean(), y[below].mean(), axes.transData)
    axes.pcolormesh(_border(x), _border(y), shades)
    return mesh


@exclusive
def draw_sensitivities(result: Sensitivities) -> Figure:
    """Draw what 1 % more of each number changes, part by part of the plan, the largest first."""
    rows = [row for row in result.rows if row.percent]
    titles = [f"{row.name} = {row.given:.4g} {row.unit}" for row in rows]
    high, left = 0.24 * len(rows), 0.4 + 0.075 * max(map(len, titles), default=0)
    with open_figure(WIDTH, high + 1.1) as figure:
        axes, count = inset(figure, left, 0.6, WIDTH - left - 2.2, high), np.arange(len(rows))
        worth = 0.01 * np.array([[row.given * slope for slope in row.phases] for row in rows])
        for k, (part, bars) in enumerate(zip(result.parts, worth.T, strict=True)):
            before = np.where(worth[:, :k] * bars[:, None] > 0, worth[:, :k], 0.0).sum(axis=1)
            colour = PALETTE[k % len(PALETTE)]
            axes.barh(count, bars, 0.7, before, color=colour, label=f"phase {part}")
        axes.barh(count, 0.0, 0.84, [row.percent for row in rows], edgecolor=INK, linewidth=1.6)
        for k, row in enumerate(rows):
            text = row.limit + " (one-sided)" * bool(row.note)
            axes.text(1.02, k, text, transform=axes.get_yaxis_transform(), va="center", fontsize=8)
        axes.axvline(0.0, color=INK, linewidth=0.8)
        axes.set_yticks(count, titles)
        axes.set_ylim(len(rows) - 0.4, -0.6)
        axes.set_xlabel(f"1 % more changes the {result.objective} [{result.unit}]; line: in all")
        axes.legend(loc="lower right", fontsize=8)
        write_title(figure, result.document.head)
        return figure


@exclusive
def draw_search(result: Design) -> Figure:
    """Draw what is minimised and the numbers of all hands tried, with lines for the best so far."""
    choices, wide = result.aim.choices, WIDTH - 3.4
    with open_figure(WIDTH, 3.1 + len(choices)) as figure:
        tall = float(figure.get_size_inches()[1])
        first = inset(figure, 1.2, tall - 2.4, wide, 2.0)
        others = [inset(figure, 1.2, tall - 3.4 - k, wide, 0.8) for k in range(len(choices))]
        starts = sorted({hand.start for hand in result.hands})
        for start, colour in zip(starts, PALETTE * len(starts), strict=False):
            hands = [hand for hand in result.hands if hand.start == start]
            costs, number = np.array([hand.cost for hand in hands]), 1 + np.arange(len(hands))
            best, none = np.fmin.accumulate(costs), number[np.isnan(costs)]
            leads, values = costs <= best, np.array([result.aim.find(hand) for hand in hands])
            first.step(number, best, where="post", color=colour, label=f"start {start}")
            for axes, column in zip([first, *others], [costs, *values.T], strict=True):
                shown = ~np.isnan(costs)
                axes.plot(number[shown], column[shown], ".", color=colour, alpha=0.4)
                axes.step(number[leads], column[leads], where="post", color=colour)
            first.plot(
                none, 0 * none + 0.03, "x", color=colour, transform=first.get_xaxis_transform()
            )
        good = [hand.cost for hand in result.hands if not hand.reason]
        first.set_ylim(min(good) - 0.1 * np.ptp(good) - 1e-9, np.quantile(good, 0.95))
        first.set_ylabel(result.label)
        first.legend(bbox_to_anchor=(1.01, 1.0), loc="upper left")
        for axes, choice in zip(others, choices, strict=True):
            room = 0.05 * (choice.high - choice.low)
            axes.set_ylim(choice.low - room, choice.high + room)
            title = choice.parameter.title
            axes.text(1.02, 0.5, title, transform=axes.transAxes, va="center")
        for axes in (first, *others):
            axes.sharex(others[-1])
            axes.tick_params(labelbottom=axes is others[-1])
        others[-1].set_xlabel("hands tried; x: no plan")
        write_title(figure, ", ".join(plan.headline for plan in result.plans))
        return figure
