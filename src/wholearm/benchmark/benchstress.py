"""Plans of problems that are a little different: whether they are found, and hold in simulation."""

from __future__ import annotations

import copy
import time
from collections.abc import Mapping
from typing import Any

import numpy as np

from ..errors import WholearmError
from ..plan import solve
from ..problem import Problem, build_problem
from ..verify import verify
from .benchreport import Row

TRIALS = 12
SPREADS = (0.01, 0.1, 0.2)
"""Largest relative change of each number."""
_FINGER = ("inertia", "viscous", "dry", "torque_limit")


def measure_stress(problem: Problem) -> list[Row]:
    """Plan and verify with mass, friction, inertias, drag and torque limits changed at random.

    Objectives take turns. The error is the share of trials without a plan that holds.
    """
    rows: list[Row] = []
    for spread in SPREADS if problem.table else ():
        random = np.random.default_rng(0)
        started, failures = time.perf_counter(), []
        for trial in range(TRIALS):
            goal = ("time", "effort", "margin")[trial % 3]
            changed = _change(problem.table, spread, random)
            try:
                other = build_problem(changed, problem.source)
                report = verify(other, solve(other, goal))
                failures += [f"{goal}: {text}" for text in report.failures[:1]]
            except WholearmError as error:
                failures.append(f"{goal}: {error}")
        seconds = (time.perf_counter() - started) / TRIALS
        note = f"{TRIALS - len(failures)} of {TRIALS} planned and verified"
        setting = f"up to {spread:.0%}"
        share = len(failures) / TRIALS
        text = "; ".join([note, *failures[:1]])
        rows.append(Row("stress", "other masses and forces", setting, seconds, share, text))
    return rows


def _change(table: Mapping[str, Any], spread: float, random: np.random.Generator) -> dict[str, Any]:
    """The table of a problem file with numbers changed by up to `spread`."""
    changed = copy.deepcopy(dict(table))

    def factor() -> float:
        return 1 + spread * float(random.uniform(-1, 1))

    changed["object"]["mass"] *= factor()
    for finger in changed["fingers"].values():
        for key in _FINGER:
            if key in finger:
                finger[key] *= factor()
    for part in changed["friction"]:
        changed["friction"][part] *= factor()
    return changed
