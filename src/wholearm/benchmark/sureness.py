"""Whether contact forces of plans are the only ones, and whether the plans surely leave rest.

``python -m wholearm.benchmark.sureness problems/*.toml [--output results]`` plans every problem for
every objective, and lists for each phase the least principal minor of its contact problem over that
without friction, with its contacts and its place, and for how long friction can hold everything at
rest at its start.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from ..common.files import write_text
from ..geometry.curve import describe_pose
from ..geometry.path_guess import load
from ..planning.options import CHOICES
from ..planning.plan import solve
from ..planning.result import Plan
from .report import stamp

HEAD = (
    "# Contact forces that are the only ones, and starts that are sure",
    "",
    stamp(),
    "",
    "| problem | objective | phase | least minor | of | at | wedged [ms] |",
    "|---|---|---:|---:|---|---|---:|",
)


def list_rows(name: str, plan: Plan) -> Iterator[str]:
    """The rows of a plan in the table."""
    for phase in plan.phases:
        margin = phase.uniqueness_margin
        if margin is None:
            continue
        row = int(np.searchsorted(plan.trajectory.t, margin.time))
        where = f"t = {margin.time:.4f} s, {describe_pose(plan.trajectory.z[row])}"
        wedged = "-" if phase.wedged is None else f"{1e3 * phase.wedged:.1f}"
        cells = name, plan.options.goal.value, phase.number, f"{margin.value:.4f}"
        yield f"| {' | '.join(map(str, (*cells, margin.contacts, where, wedged)))} |"


def main() -> int:
    """Write the table and print its lines."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("problems", nargs="+", type=Path, help="problem files")
    parser.add_argument("--output", type=Path, default=Path("results"))
    options = parser.parse_args()
    lines = [*HEAD]
    for path in options.problems:
        for objective in CHOICES:
            for row in list_rows(path.stem, solve(load(str(path)), objective)):
                lines.append(row)
                print(row, flush=True)
    write_text(str(options.output / "bench_sureness.md"), "\n".join(lines) + "\n")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
