"""Regression of costs: sizes, iterations and evaluations of each plan against stored counts.

Sizes of the first NLP of every block of phases are the same on every machine. Iterations of the
solver, evaluations in the replay and panels of the traced curves depend on rounding: they may grow
within a band. Measured over five kernels of OpenBLAS, five seeds of changes in the last bits and
NumPy 2.1 to 2.5, iterations differ by 1 %, evaluations by 0.5 %, and panels by one.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

from ..common.errors import InputError
from ..common.files import read_json, require_writable, write_text
from ..geometry.tracing import load, trace_phases
from ..planning.nlp import IpoptRun, record_runs
from ..planning.plan import solve
from ..problem.definition import Problem
from ..simulation.simulate import simulate
from ..simulation.stepper import NODES
from .study import Case, Row, Study

BANDS = {"iterations": 1.25, "evaluations of the replay": 1.1, "panels of curves": 1.25}
"""Largest ratio to the stored counts of those in which rounding has a part; others may not grow."""

Counts = dict[str, int]


class Guard(Study):
    """Counts of today against stored ones."""

    name, title, keeps = "guard", "Counts against stored ones", False
    stored = ("--counts", "results/bench_guard.json")
    options = "problems FILE ...  problem files (TOML)\n"

    def list_cases(self, options: argparse.Namespace) -> Iterator[Case]:
        """The problems."""
        if not options.update:
            read_stored(options.counts)
        require_writable(options.counts)
        for path in options.problems:
            load(path)
            yield (path,)

    def run(self, case: Case) -> Row:
        """Count one."""
        return {"counts": count(load(case[0]))}

    def report(self, rows: Sequence[Row], options: argparse.Namespace) -> tuple[str, list[str]]:
        """What has grown."""
        new_counts: dict[str, Counts] = {Path(row["case"][0]).stem: row["counts"] for row in rows}
        stored_counts = read_stored(options.counts) if Path(options.counts).exists() else {}
        if options.update:
            stored_counts |= new_counts
            write_text(options.counts, json.dumps(stored_counts, indent=2, sort_keys=True) + "\n")
        grown = []
        for name, counts in new_counts.items():
            if name in stored_counts:
                grown += compare(name, counts, stored_counts[name])
            else:
                grown.append(f"{name}: no counts are stored; --update stores them")
        return "" if grown else f"{len(rows)} problems: no count has grown", grown


STUDY = Guard()


def count(problem: Problem) -> Counts:
    """Plan a problem for least time, replay the plan, and count what that takes.

    Returns
    -------
    dict  by names such as "phase 5-6 of 6: rows"; `BANDS` has those that rounding has a part in
    """
    firsts: dict[str, IpoptRun] = {}
    block, first = "", 0

    with record_runs() as runs:

        def note(text: str) -> None:
            nonlocal block, first
            if block and len(runs) > first:
                firsts.setdefault(block, runs[first])
            block, first = text.removesuffix(": time"), len(runs)

        plan = solve(problem, replay=False, progress=note).trajectory
        note("")
    sizes = {
        f"{name}: {size}": getattr(run, size.replace(" ", "_"))
        for name, run in firsts.items()
        for size in ("unknowns", "rows", "jacobian nonzeros", "hessian nonzeros")
    }
    replay = simulate(problem, plan.torque)
    return sizes | {
        "panels of curves": sum(len(curve.panels) for curve in trace_phases(problem)),
        "iterations": sum(run.iterations for run in runs),
        "evaluations of the replay": len(NODES) * (replay.steps + replay.rejected),
    }


def compare(name: str, found: Counts, stored: Counts) -> list[str]:
    """What has grown over the stored counts of a problem, or is no longer there."""
    texts = [f"{name}: {key} is not counted any more" for key in stored if key not in found]
    for key, value in found.items():
        if key not in stored:
            texts.append(f"{name}: {key} = {value} is new; --update stores it")
        elif value > (most := stored[key] * BANDS.get(key, 1.0)):
            room = f" (allowed: {most:.0f})" if key in BANDS else ""
            texts.append(f"{name}: {key} has grown from {stored[key]} to {value}{room}")
    return texts


def read_stored(path: str) -> dict[str, Counts]:
    """The stored counts by problem.

    Raises
    ------
    InputError  if the file cannot be read, or is not a table of whole numbers
    """
    table = read_json(path)
    rows = table.values() if isinstance(table, Mapping) else [None]
    numbers = [n for row in rows for n in (row.values() if isinstance(row, Mapping) else [None])]
    if not all(type(number) is int for number in numbers):
        raise InputError(path, "", "holds other things than whole numbers by problem and count")
    return dict(table)
