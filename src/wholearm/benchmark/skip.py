"""What each part of the model costs: the same phases with it and without it.

A part that a scene does not have adds no unknowns and no rows, and its code is not run.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from statistics import median
from typing import Any, NamedTuple

import numpy as np

from ..common.files import make_folder, require_writable, write_text
from ..geometry.path_guess import load
from ..geometry.tracing import trace_phases
from ..planning.plan import solve
from ..problem.definition import End, Problem, Until
from ..problem.read import build_problem
from ..solvers.ipopt import record_runs
from .alone import measure_alone
from .report import stamp

REPEATS = 3
"""Runs of which the medians are taken."""
PUSHED = 0.03
"""Place that the object is pushed to by one finger or by both [m]."""
AWAY = np.array([0.0, 0.0, 0.0, 0.0, 0.6])
"""Change of the start that turns an idle finger away [m, rad]."""
HEAD = (
    "# What each part costs",
    "",
    stamp(),
    "",
    "The same phases without a part of the model and with it. Sizes are those of the first NLP,",
    "times those of the processor, as medians of fresh processes; building is all but the solver.",
    "",
    "| part | unknowns without | with | rows without | with | building without [ms] | with "
    "| solving without [ms] | with |",
    "|---|---:|---:|---:|---:|---:|---:|---:|---:|",
)


class Case(NamedTuple):
    """A problem to plan, and how.

    Attributes
    ----------
    problem : Problem
    options : dict
        Of `solve`.
    draw : bool
        Whether the plan is drawn as well.
    """

    problem: Problem
    options: dict[str, Any]
    draw: bool = False


@dataclass(frozen=True)
class Pair:
    """A part of the model, and the same phases without it and with it."""

    part: str
    without: Case
    having: Case


class Expense(NamedTuple):
    """What a plan takes: sizes of its first NLP, and processor time outside and inside the solver.

    Attributes
    ----------
    unknowns, rows : int
    building, solving : float, [s]
    """

    unknowns: int
    rows: int
    building: float
    solving: float


def list_pairs(folder: str, **options: Any) -> list[Pair]:
    """Every part with two problems made of those in a folder; `options` are those of `solve`."""
    whole, box, joined = (
        load(str(Path(folder) / f"{name}.toml"))
        for name in ("heptagon_four_contacts", "box_rolling", "heptagon_impact")
    )
    slide = build_problem({**whole.table, "phases": whole.table["phases"][:1]}, whole.source)
    tip = _pick(box, 1, 2)
    path, over_time = options, options | {"transcription": "time"}
    pairs = [
        Pair(f"{part}, {where}", Case(slide.with_(absent), own), Case(slide.with_(present), own))
        for where, own in (("along curves", path), ("over time", over_time))
        for part, absent, present in (
            ("friction of contacts", {"friction": 0.0}, {}),
            ("friction of joints", {"viscous": 0.0, "dry": 0.0}, {}),
            ("speed limits that never bind", {}, {"speed_limit": 1e3}),
            ("torque limits that bind", {"torque_limit": 20.0}, {}),
        )
    ]
    (phase,) = tip.phases
    sliding = replace(phase, formation=replace(phase.formation, rolling=()))
    slipping = replace(tip, phases=(sliding,))
    both = replace(slide, phases=(replace(slide.phases[0], until=Until(None, "x", PUSHED)),))
    held = both.phases[0].formation
    alone = replace(both.phases[0], formation=replace(held, contacts=held.contacts[:-1]))
    idle = replace(both, start=both.start + AWAY, phases=(alone,))
    run = _pick(joined, 0, 2)
    stop = replace(run, phases=(replace(run.phases[0], end=End.REST), *run.phases[1:]))
    return [
        *pairs,
        Pair("a rolling contact, over time", Case(slipping, over_time), Case(tip, over_time)),
        Pair("a second freedom", Case(tip, path), Case(slipping, path)),
        Pair("a transition at speed", Case(stop, path), Case(run, path)),
        Pair("an idle finger, over time", Case(both, over_time), Case(idle, over_time)),
        Pair("a figure", Case(slide, path), Case(slide, path, draw=True)),
    ]


def _pick(problem: Problem, first: int, stop: int) -> Problem:
    """Some phases of a problem, the last of which ends at rest."""
    start = trace_phases(problem)[first - 1].end if first else problem.start
    phases = [replace(phase, index=k) for k, phase in enumerate(problem.phases[first:stop])]
    phases[-1] = replace(phases[-1], end=End.REST)
    return replace(problem, start=start, phases=tuple(phases))


def spend(case: Case) -> Expense:
    """Plan a case and say what that takes."""
    started = time.process_time()
    with record_runs() as runs:
        plan = solve(case.problem, replay=False, **case.options)
    if case.draw:
        from ..figures.plots import force_margins

        force_margins(plan).canvas.draw()
    whole, solving = time.process_time() - started, sum(run.seconds for run in runs)
    return Expense(runs[0].unknowns, runs[0].rows, whole - solving, solving)


def run_skip(folder: str, output: str, progress: Callable[[str], None] | None = None) -> str:
    """Measure every part in fresh processes and write a table; returns the path of its file."""
    make_folder(output)
    path = str(Path(output) / "bench_skip.md")
    require_writable(path)
    lines = [*HEAD]
    for pair in list_pairs(folder):
        if progress is not None:
            progress(pair.part)
        cells = []
        for case in (pair.without, pair.having):
            runs = [measure_alone(spend, case).answer for _ in range(REPEATS)]
            cells.append(Expense(*(median(column) for column in zip(*runs, strict=True))))
        lines.append(format_pair(pair.part, *cells))
    write_text(path, "\n".join(lines) + "\n")
    return path


def format_pair(part: str, without: Expense, having: Expense) -> str:
    """One row of the table."""
    sizes = zip(without[:2], having[:2], strict=True)
    times = zip(without[2:], having[2:], strict=True)
    cells = [f"{one:.0f} | {other:.0f}" for one, other in sizes]
    cells += [f"{1e3 * one:.0f} | {1e3 * other:.0f}" for one, other in times]
    return f"| {part} | {' | '.join(cells)} |"
