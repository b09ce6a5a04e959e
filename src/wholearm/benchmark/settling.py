"""Whole plans with their ends of phases held, in a free simulation by the clock.

``python -m wholearm.benchmark.settling problems/*.toml [--output results]`` plans every problem of
least time as it is and with `settle`, for a tenth longer, simulates both from the exact start and
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
from ..mechanics.arrival import Standstill, find_opening
from ..planning.plan import solve
from ..planning.result import Plan
from ..planning.settling import list_touching
from ..problem.definition import Problem
from ..problem.read import place_start, read_problem
from .report import stamp

LONGER = 0.099
"""By how much plans are made longer, over their duration, where no `--settle` is given."""
SHARES = ((1, 2.0), (2, 2.0), (2, 3.5))
"""Ways to share the time: for how many of the contacts that are gained first how much more."""
STOP = 0.06
"""Time for an end where nothing has to close, over that for a contact."""
RESTS = 1e-3
"""Speed that is rest, over the largest of the plan."""
OFF = 1e-4
"""By how much starts are moved [m]."""
HEAD = (
    "# Plans whose phases are held at their ends",
    "",
    stamp(),
    "",
    "Distance of the object's pose from the plan's at the end of the whole, simulated by the clock",
    "without telling which contacts hold; `short` and `ahead` start 0.1 mm off. Of three ways to",
    "share the time that is shown which serves the short start best.",
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
    edge = problem.table["start"]["flush"]
    start = place_start(problem.scene, edge, float(problem.start[0]) + off) if off else None
    away = simulate_free(problem, plan.trajectory, start=start).z[-1] - last
    return End(1e3 * float(np.hypot(away[0], away[1])), float(np.degrees(abs(away[2]))))


def share_time(plan: Plan, few: int, more: float) -> dict[str, float]:
    """For how long ends may be held for the whole to be longer by `LONGER`, as changes [s].

    The first contacts that are gained are as far off as the start, or farther: the first `few` have
    `more` times the time of those after them.
    """
    shares: dict[int, float] = {}
    trajectory, problem, gained = plan.trajectory, plan.problem, 0
    fast = RESTS * float(np.abs(trajectory.z_dot).max())
    for phase in problem.phases:
        last = int(np.flatnonzero(trajectory.phase == phase.index)[-1])
        if np.abs(trajectory.z_dot[last]).max() >= fast:
            continue
        touching = list_touching(problem, phase)
        place = Standstill(trajectory.z[last], phase.formation, phase.until.contact, touching)
        closes = find_opening(place) is not None
        shares[phase.number] = (more if gained < few else 1.0) if closes else STOP
        gained += closes
    unit = LONGER * plan.duration / sum(shares.values())
    return {f"phases[{number}].settle": share * unit for number, share in shares.items()}


def list_rows(problem: Problem, settle: float | None) -> list[str]:
    """The rows of a problem in the table: without `settle`, and with it.

    Without a `settle` that is the way to share the time that serves the short start best.
    """
    plain = solve(problem)
    way = float(np.sign(plain.trajectory.q[len(plain.trajectory.t) // 50, 0] - problem.start[0]))
    given = [{"settle": settle}] if settle else [share_time(plain, *own) for own in SHARES]
    held = [solve(problem.with_(changes)) for changes in given]
    best = min(held, key=lambda plan: max(measure_end(plan, -way * OFF)))
    return [_format(plan, plan.duration / plain.duration - 1, way) for plan in (plain, best)]


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
    parser.add_argument("--settle", type=float, help="for how long ends are held [s]")
    parser.add_argument("--output", type=Path, default=Path("results"))
    options = parser.parse_args(arguments)
    lines = [*HEAD]
    for path in options.problems:
        for row in list_rows(read_problem(str(path)), options.settle):
            lines.append(row)
            print(row, flush=True)
    write_text(str(options.output / "bench_settling.md"), "\n".join(lines) + "\n")
    return 0


if __name__ == "__main__":
    main()
