"""Whole plans with their ends of phases held, in a free simulation by the clock.

``python -m wholearm.benchmark.settling problems/*.toml [--output results]`` plans every problem of
least time as it is and with `settle`, a tenth longer, simulates both from the exact start and
from starts that are 0.1 mm to either side, without telling which contacts hold, and lists how far
the object's pose ends from where it was planned to.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from ..common.files import write_text
from ..free_simulation.simulate import simulate_free
from ..planning.plan import solve
from ..planning.result import Plan
from ..planning.shares import move_start
from ..problem.definition import Problem
from ..problem.read import read_problem
from .report import stamp

LONGER = "10 %"
"""By how much plans are made longer, where no `--settle` is given."""
OFF = 1e-4
"""By how much starts are moved [m]."""
HEAD = (
    "# Plans whose phases are held at their ends",
    "",
    stamp(),
    "",
    "Distance of the object's pose from the plan's at the end of the whole, simulated by the clock",
    "without telling which contacts hold; `short` and `ahead` start 0.1 mm off.",
    "",
    "| problem | settle of each phase [ms] | time [s] | longer | exact [mm] | [deg] "
    "| short [mm] | [deg] | ahead [mm] | [deg] |",
    "|---|---|---:|---:|---:|---:|---:|---:|---:|---:|",
)


class End(NamedTuple):
    """How far the object ends from the plan [mm], and by how much it is turned [degrees]."""

    position: float
    angle: float


def measure_end(plan: Plan, off: float) -> End:
    """Simulate a whole plan from a start that is moved by `off` [m] along the palm."""
    problem, last = plan.problem, plan.trajectory.z[-1]
    away = simulate_free(problem, plan.trajectory, start=move_start(problem, off)).z[-1] - last
    return End(1e3 * float(np.hypot(away[0], away[1])), float(np.degrees(abs(away[2]))))


def list_rows(problem: Problem, settle: float | str) -> list[str]:
    """The rows of a problem in the table: without `settle`, and with it."""
    plain = solve(problem)
    way = float(np.sign(plain.trajectory.q[len(plain.trajectory.t) // 50, 0] - problem.start[0]))
    held = solve(problem.with_(settle=settle))
    return [_format(plan, plan.duration / plain.duration - 1, way) for plan in (plain, held)]


def _format(plan: Plan, longer: float, way: float) -> str:
    ends = [measure_end(plan, off) for off in (0.0, -way * OFF, way * OFF)]
    times = [own.settling.duration if own.settling else 0.0 for own in plan.phases]
    cells = [", ".join(f"{1e3 * time:.3g}" for time in times) if any(times) else "-"]
    cells += [f"{plan.duration:.4f}", f"{longer:.1%}"]
    cells += [f"{value:.1e}" for end in ends for value in end]
    return f"| {plan.problem.name} | {' | '.join(cells)} |"


def main(arguments: Sequence[str] | None = None) -> int:
    """Write the table and print its lines."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("problems", nargs="+", type=Path, help="problem files")
    parser.add_argument("--settle", help="for how long ends are held [s], or a share as in '10 %%'")
    parser.add_argument("--output", type=Path, default=Path("results"))
    options = parser.parse_args(arguments)
    settle = LONGER if options.settle is None else options.settle
    settle = settle if "%" in settle else float(settle)
    lines = [*HEAD]
    for path in options.problems:
        for row in list_rows(read_problem(str(path)), settle):
            lines.append(row)
            print(row, flush=True)
    write_text(str(options.output / "bench_settling.md"), "\n".join(lines) + "\n")
    return 0


if __name__ == "__main__":
    main()
