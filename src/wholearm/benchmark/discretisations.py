"""How far answers depend on the discretisation of the time domain.

``python -m wholearm.benchmark.discretisations problems/heptagon.toml ...`` plans every objective
with seven numbers of intervals, two degrees and both schemes, prints a line for each plan and says
how far the values of one problem and objective lie apart.
"""

from __future__ import annotations

import argparse
import itertools
import math
import sys
import time
from collections.abc import Callable, Sequence
from typing import NamedTuple

from ..common.errors import InfeasibleError, ReplayError, SolverError
from ..planning.options import CHOICES
from ..planning.plan import solve
from ..problem.definition import Problem
from ..problem.read import read_problem

INTERVALS = (8, 10, 12, 16, 20, 30, 40)
DEGREES = (3, 4)
SCHEMES = ("radau", "legendre")
WIDE = 5e-4
"""Largest difference from the best value, over that value, which passes."""


class Spread(NamedTuple):
    """How far the values of one problem and objective lie apart.

    Attributes
    ----------
    best : float
        Least duration or effort, or largest margin; nan without a plan.
    width : float
        Largest difference from it, over its size; infinite if a discretisation finds no plan.
    lost : int
        Discretisations without a plan.
    """

    best: float
    width: float
    lost: int


def plan_each(
    problem: Problem,
    objective: str,
    say: Callable[[str], object],
    intervals: Sequence[int] = INTERVALS,
    degrees: Sequence[int] = DEGREES,
) -> list[float | None]:
    """Values with every discretisation, `solve`'s own replay included; None without a plan."""
    values: list[float | None] = []
    for count, degree, scheme in itertools.product(intervals, degrees, SCHEMES):
        started = time.process_time()
        try:
            plan = solve(
                problem, objective, time_intervals=count, degree=degree, scheme=scheme, samples=2
            )
            values.append(plan.value)
            text = f"{values[-1]:.8g}"
        except (InfeasibleError, SolverError, ReplayError) as error:
            values.append(None)
            text = str(error)
        seconds = time.process_time() - started
        say(f"{problem.name} {objective} {count} {degree} {scheme} {seconds:.1f} s {text}")
    return values


def measure_spread(values: Sequence[float | None], objective: str) -> Spread:
    """How far values lie apart, None among them for those without a plan."""
    found = [value for value in values if value is not None]
    if not found:
        return Spread(math.nan, math.inf, len(values))
    best = max(found) if objective == "margin" else min(found)
    width = max(abs(value - best) for value in found) / abs(best)
    lost = len(values) - len(found)
    return Spread(best, math.inf if lost else width, lost)


def main() -> int:
    """Print every plan and a table; the exit status is 1 if values lie too far apart."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("problems", nargs="+", metavar="FILE")
    parser.add_argument("--objective", choices=CHOICES, nargs="+", default=CHOICES)
    options = parser.parse_args()
    wide, lines = False, []
    for path, objective in itertools.product(options.problems, options.objective):
        values = plan_each(read_problem(path), objective, lambda line: print(line, flush=True))
        spread = measure_spread(values, objective)
        wide |= not spread.width <= WIDE
        figures = f"best {spread.best:.8g}, width {spread.width:.1e}, {spread.lost} without a plan"
        lines.append(f"{path} {objective}: {figures}")
    print("\n".join(lines))
    return int(wide)


if __name__ == "__main__":
    sys.exit(main())
