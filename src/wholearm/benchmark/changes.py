"""Plans of problems that are a little different: whether they are found, and hold in simulation."""

from __future__ import annotations

import time
from collections.abc import Mapping
from typing import Any

import numpy as np

from ..common.errors import WholearmError
from ..planning.plan import solve
from ..problem.definition import Problem
from ..verification.verify import verify
from .report import Row

TRIALS = 12
CHANGES = (0.01, 0.1, 0.2)
"""Largest relative change of each number."""
_FINGER = ("inertia", "viscous", "dry", "torque_limit")


def measure_stress(problem: Problem) -> list[Row]:
    """Plan and verify with mass, friction, inertias, drag and torque limits changed at random.

    Objectives take turns. The error is the share of trials without a plan that holds.
    """
    rows: list[Row] = []
    for largest in CHANGES if problem.table else ():
        random = np.random.default_rng(0)
        started, failures = time.perf_counter(), []
        for trial in range(TRIALS):
            goal = ("time", "effort", "margin")[trial % 3]
            changes = change_numbers(problem.table, largest, random)
            try:
                other = problem.with_(changes)
                report = verify(other, solve(other, goal))
                failures += [f"{goal}: {text}" for text in report.failures[:1]]
            except WholearmError as error:
                failures.append(f"{goal}: {error}")
        seconds = (time.perf_counter() - started) / TRIALS
        note = f"{TRIALS - len(failures)} of {TRIALS} planned and verified"
        setting = f"up to {largest:.0%}"
        share = len(failures) / TRIALS
        text = "; ".join([note, *failures[:1]])
        rows.append(Row("stress", "other masses and forces", setting, seconds, share, text))
    return rows


def change_numbers(
    table: Mapping[str, Any], largest: float, random: np.random.Generator
) -> dict[str, Any]:
    """Numbers of a problem file changed by up to `largest`, by their dotted keys."""
    keys = ["object.mass"]
    for number, finger in table["fingers"].items():
        keys += [f"fingers.{number}.{key}" for key in _FINGER if key in finger]
    keys += [f"friction.{part}" for part in table["friction"]]
    changed = {}
    for key in keys:
        place: Any = table
        for step in key.split("."):
            place = place[step]
        changed[key] = place * (1 + largest * float(random.uniform(-1, 1)))
    return changed
