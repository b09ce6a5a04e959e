"""Problems as they are, but for rounding noise and for numbers that are a little different."""

from __future__ import annotations

import time
from typing import Any

import numpy as np

from ...common.errors import WholearmError
from ...geometry.path_guess import check_phases
from ...planning.plan import solve
from ...problem.read import build_problem, read_problem
from ...verification.verify import verify
from ..changes import change_numbers
from .plan_check import check_plan
from .plans import SAME, Finding, _fail, add_noise

SEEDS = 8
"""Times that noise is added to the masses."""
CHANGES = 20
"""Times that masses, friction, drag and torque limits are changed."""
SPREAD = 0.1
"""Largest relative change."""


def list_trials(paths: list[str]) -> list[tuple[str, str, str, int]]:
    """Every (problem file, objective, what is done, number) of this part of the study.

    All problems come once before any comes again.
    """
    return [
        (path, objective, what, number)
        for number in range(max(SEEDS, CHANGES))
        for what, count in (("noise", SEEDS), ("change", CHANGES))
        if number < count
        for path in paths
        for objective in ("time", "effort", "margin")
    ]


def run_trial(task: tuple[str, str, str, int]) -> dict[str, Any]:
    """Plan, replay and check one trial, and return what came of it as plain data."""
    path, objective, what, number = task
    started, value = time.process_time(), None
    given, rng = read_problem(path), np.random.default_rng(number)
    findings: list[Finding] = []
    try:
        if what == "noise":
            problem = build_problem(add_noise(dict(given.table), rng), path)
        else:
            problem = given.with_(change_numbers(given.table, SPREAD, rng))
        check_phases(problem)
        plan = solve(problem, objective)
        value = plan.value
        report = verify(problem, plan)
        findings += [Finding("plan refuted by replay", text) for text in report.failures[:1]]
        wrong = check_plan(problem, plan.trajectory)
        findings += [Finding("plan refuted by residual", "; ".join(wrong[:3]))] if wrong else []
    except WholearmError as error:
        findings.append(Finding("no plan for a shipped problem", str(error)))
    except Exception as error:
        findings += _fail(error).findings
    return {
        "problem": list(task),
        "value": value,
        "findings": [list(finding) for finding in findings],
        "seconds": round(time.process_time() - started, 3),
    }


def compare_values(records: list[dict[str, Any]]) -> list[Finding]:
    """Optima of one problem and objective that differ under noise."""
    groups: dict[tuple[str, str], list[float]] = {}
    for record in records:
        path, objective, what, _ = record["problem"]
        if what == "noise" and record["value"] is not None:
            groups.setdefault((path, objective), []).append(record["value"])
    findings = []
    for (path, objective), values in groups.items():
        apart = (max(values) - min(values)) / max(map(abs, values))
        if apart > SAME:
            text = f"{path}, {objective}: {min(values):.9g} to {max(values):.9g}, {apart:.2g} apart"
            findings.append(Finding("optimum that differs under noise", text))
    return findings
