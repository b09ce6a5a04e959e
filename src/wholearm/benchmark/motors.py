"""What limits of motors and controllers cost: limited rates of torques, and control periods.

``python -m wholearm.benchmark.motors problems/*.toml [--rates 100 500] [--periods 2 5] [--output
results]`` plans every problem for the least time with each of them, and verifies the plans: how
much longer they take than without, whether they hold, and the processor time of planning.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from ..common.errors import WholearmError
from ..common.files import write_text
from ..geometry.path_guess import load
from ..planning.plan import solve
from ..problem.definition import Problem
from ..scene.model import HOLDS
from ..verification.verify import verify
from .report import stamp

RATES = (50.0, 500.0, 5000.0)
"""Limits of the torques' rates [N m/s]."""
PERIODS = (1.0, 2.0, 5.0)
"""Control periods [ms]."""


def list_limits(
    problem: Problem, rates: Sequence[float], periods: Sequence[float], holds: Sequence[str]
) -> Iterator[tuple[str, Problem]]:
    """The problem with each of the limits, and what they are."""
    for rate in rates:
        yield f"{rate:g} N m/s", problem.with_(torque_rate_limit=rate)
    for hold in holds:
        for period in periods:
            changed = problem.with_(control_period=1e-3 * period, control_hold=hold)
            yield f"{hold} over {period:g} ms", changed


def measure(problem: Problem, plain: float, took: float) -> str:
    """Cells of a row: duration, over that without, what verifying shows, CPU over that without."""
    started = time.process_time()
    try:
        plan = solve(problem)
    except WholearmError as error:
        ratio = (time.process_time() - started) / took
        return f"- | - | {error} | {ratio:.1f}"
    ratio = (time.process_time() - started) / took
    found = verify(problem, plan)
    held = "holds" if found.ok else found.reason
    return f"{plan.duration:.5f} | {plan.duration / plain - 1:+.2%} | {held} | {ratio:.1f}"


def list_rows(path: Path, *limits: Sequence[Any]) -> Iterator[str]:
    """Rows of the table of one problem."""
    problem = load(str(path))
    solve(problem)
    started = time.process_time()
    plain = solve(problem).duration
    took = time.process_time() - started
    yield f"| {path.stem} | none | {plain:.5f} | | holds | 1 ({took:.2f} s) |"
    for name, changed in list_limits(problem, *limits):
        yield f"| {path.stem} | {name} | {measure(changed, plain, took)} |"


def main() -> int:
    """Write the table and print its lines."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("problems", type=Path, nargs="+", help="problem files")
    parser.add_argument("--rates", type=float, nargs="*", default=RATES, help="N m/s")
    parser.add_argument("--periods", type=float, nargs="*", default=PERIODS, help="ms")
    parser.add_argument("--holds", nargs="*", default=HOLDS, help="how torques are held")
    parser.add_argument("--output", type=Path, default=Path("results"))
    options = parser.parse_args()
    lines = ["# Limits of motors and controllers", "", stamp(), ""]
    lines += ["| problem | limit | duration [s] | longer | verified | CPU over that without |"]
    lines += ["|---|---|---:|---:|---|---:|"]
    for path in options.problems:
        for row in list_rows(path, options.rates, options.periods, options.holds):
            print(row, flush=True)
            lines.append(row)
    write_text(str(options.output / "bench_motors.md"), "\n".join(lines) + "\n")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
