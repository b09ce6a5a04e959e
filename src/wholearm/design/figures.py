"""Figures of sensitivities, and of the search for the best hand."""

from __future__ import annotations

import numpy as np
from matplotlib.figure import Figure

from ..common.sharing import exclusive
from ..figures.style import INK, PALETTE, WIDTH, inset, open_figure, write_title
from .hand import Design
from .sensitivities import Sensitivities


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
