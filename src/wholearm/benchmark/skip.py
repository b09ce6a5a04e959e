"""Cost of each part of the model: the same phases with and without it.

A part absent from a scene adds no unknowns and no rows, and its code does not run.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import partial
from itertools import chain, product
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np

from ..common.document import Table
from ..geometry.tracing import load, trace_phases
from ..planning.nlp import collect_costs
from ..planning.options import PlanOptions
from ..planning.plan import solve
from ..planning.time_domain.time_plan import plan_phases
from ..problem.definition import End, Problem, Until
from ..problem.read import build_problem
from .study import Case, Findings, Row, Study, group

COLUMNS = {"unknowns": "", "rows": "", "building": " [ms]", "solving": " [ms]"}  # units of tables


class Skip(Study):
    """Plans without a part of the model and with it."""

    name, title, timed = "skip", "What each part costs", True
    isolated = needs_problems = True
    keys = ("problems", "part", "having")

    def list_cases(self, options: argparse.Namespace) -> Iterator[Case]:
        """Each part, without and with it, several times."""
        parts = list_pairs(options.problems)
        return product([options.problems], parts, (False, True), range(3))

    def run(self, case: Case) -> Row:
        """Plan once."""
        folder, part, included, _ = case
        return list_pairs(folder)[part][included]()

    def report(self, rows: Sequence[Row], options: argparse.Namespace) -> Findings:
        """Sizes, and medians of times."""
        text = (
            "The same phases without a part of the model and with it. Sizes are those of the first "
            "NLP, times those of the processor, as medians of fresh processes; building is all but "
            "the solver."
        )
        groups = group(rows, "part", "having")
        columns = [*product(COLUMNS, (False, True))]
        table = [
            [part, *(median(row[name] for row in groups[part, having]) for name, having in columns)]
            for part in group(rows, "part")
        ]
        heads = [(f"{name} without{unit}:.0f", f"with{unit}:.0f") for name, unit in COLUMNS.items()]
        return [text, Table(["part", *chain(*heads)], table)], []


STUDY = Skip()


def list_pairs(folder: str, **options: Any) -> dict[str, tuple[partial[Row], partial[Row]]]:
    """Calls of `spend` without and with each part of the model, by the part's name.

    Problems derive from those in `folder`; `options` are those of `solve`.
    """
    base, box, impacts = (
        load(str(Path(folder) / f"{name}.toml"))
        for name in ("heptagon_four_contacts", "box_rolling", "heptagon_impact")
    )
    slide = build_problem({**base.table, "phases": base.table["phases"][:1]}, base.source)
    tip = _pick(box, 1, 2)
    path, over_time = options, options | {"transcription": "time"}
    problems = {
        f"{part}, {where}": (slide.with_(absent), slide.with_(present), settings)
        for where, settings in (("along curves", path), ("over time", over_time))
        for part, absent, present in (
            ("friction of contacts", {"friction": 0.0}, {}),
            ("friction of joints", {"viscous": 0.0, "dry": 0.0}, {}),
            ("speed limits that never bind", {}, {"speed_limit": 1e3}),
            ("torque limits that bind", {"torque_limit": 20.0}, {}),
        )
    }
    (phase,) = tip.phases
    sliding = replace(phase, formation=replace(phase.formation, rolling=()))
    slipping = replace(tip, phases=(sliding,))
    both = replace(slide, phases=(replace(slide.phases[0], until=Until(None, "x", 0.03)),))
    formation = both.phases[0].formation
    single = replace(both.phases[0], formation=replace(formation, contacts=formation.contacts[:-1]))
    # The idle finger is turned away.
    idle = replace(both, start=both.start + np.array([0, 0, 0, 0, 0.6]), phases=(single,))
    run = _pick(impacts, 0, 2)
    stop = replace(run, phases=(replace(run.phases[0], end=End.REST), *run.phases[1:]))
    problems |= {
        "a rolling contact, over time": (slipping, tip, over_time),
        "a second freedom": (tip, slipping, path),
        "a transition at speed": (stop, run, path),
        "an idle finger, over time": (both, idle, over_time),
        "a figure": (slide, slide, path),
    }
    return {
        part: (partial(spend, one, settings), partial(spend, other, settings, part == "a figure"))
        for part, (one, other, settings) in problems.items()
    }


def _pick(problem: Problem, first: int, stop: int) -> Problem:
    """A range of phases of a problem; the last one ends at rest."""
    start = trace_phases(problem)[first - 1].end if first else problem.start
    phases = [replace(phase, index=k) for k, phase in enumerate(problem.phases[first:stop])]
    phases[-1] = replace(phases[-1], end=End.REST)
    return replace(problem, start=start, phases=tuple(phases))


def spend(problem: Problem, options: dict[str, Any], draw: bool = False) -> Row:
    """Sizes of the first NLP of a plan, and processor time outside and inside the solver [s].

    Time includes planning, with options of `solve`, and drawing the plan if `draw`.
    """
    started = time.process_time()
    with collect_costs() as costs:
        if options.get("transcription") == "time":
            # Not from the plan along curves, which solves other NLPs.
            plan_phases(problem, problem.phases, problem.start, PlanOptions(**options))
        else:
            solution = solve(problem, replay=False, **options)
    if draw:
        from ..figures.plots import force_margins

        force_margins(solution).canvas.draw()
    total, solving = time.process_time() - started, sum(run.seconds for run in costs.runs)
    sizes = costs.runs[0].unknowns, costs.runs[0].rows
    return dict(zip(COLUMNS, (*sizes, total - solving, solving), strict=True))
