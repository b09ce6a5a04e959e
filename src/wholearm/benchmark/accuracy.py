"""How far plans in the time domain are from their best, beside what they estimate themselves.

``python -m wholearm.benchmark.accuracy [--problems problems] [--output results]`` plans shipped
problems for two objectives and accuracies. What each block of phases has lost is what it gains on
four times the intervals, in the same contact modes and with the same end; that is about 15/16 of
all that it may gain, as errors go with the square of the length of intervals.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from ..common.files import write_text
from ..geometry.path_guess import load
from ..geometry.tracing import trace_phases
from ..planning.block_plan import BlockPlan
from ..planning.blocks import plan_blocks
from ..planning.options import PlanOptions
from ..planning.time_domain.enforcing import enforce_between
from ..planning.time_domain.own_units import unit_of
from ..planning.time_domain.refinement import bisect_intervals
from ..planning.time_domain.search import Search
from ..planning.time_domain.stage import Stage
from ..problem.definition import Problem
from .report import stamp

PROBLEMS = ("square", "triangle", "heptagon", "hexagon")
OBJECTIVES = ("time", "effort")
"""Not `margin`: of that only one phase decides, which seldom is planned over time."""
ACCURACIES = (1e-3, 1e-4)
HALVINGS = 2
"""How often the intervals of a plan are halved to see what it has lost."""
HEAD = (
    "# Plans in the time domain: estimated errors and true ones",
    "",
    stamp(),
    "",
    "Relative to the objective of a block of phases: what its plan estimates, and what it gains on",
    "four times the intervals.",
    "",
    "| problem | objective | accuracy | phases | intervals | estimate | gain | ratio |",
    "|---|---|---:|---|---:|---:|---:|---:|",
)


class Loss(NamedTuple):
    """What a block of phases has lost.

    Attributes
    ----------
    phases : str
        Their numbers.
    intervals : int
    estimate, gain : float
        What is lost as the plan estimates it, and what is gained on finer intervals.
    """

    phases: str
    intervals: int
    estimate: float
    gain: float


def measure_losses(problem: Problem, objective: str, accuracy: float) -> Iterator[Loss]:
    """What each block in the time domain has lost, but for those with impacts."""
    options = PlanOptions(objective=objective, accuracy=accuracy)
    planning = plan_blocks(problem, trace_phases(problem), options, lambda _: None)
    for block in planning.blocks:
        stages = [own for plan in block.plans for own in plan.stages if isinstance(own, Stage)]
        if stages and not any(stage.ends_in_impact for stage in stages):
            count = sum(stage.intervals for stage in stages)
            numbers = ", ".join(str(phase.number) for phase in block.phases)
            gain = _find_gain(problem, options, block, stages)
            yield Loss(numbers, count, block.plans[0].error, gain)


def _find_gain(
    problem: Problem, options: PlanOptions, block: BlockPlan, stages: list[Stage]
) -> float:
    """What a block gains on finer intervals, over its objective."""
    values = [plan.value for plan in block.plans]
    # With a given number of intervals none are halved for the accuracy.
    fixed = replace(options, time_intervals=sum(stage.intervals for stage in stages))
    search = Search.of(problem, fixed, block.duration)
    last = replace(stages[-1], stop=stages[-1].guess.nodes[-1, 0])
    every = [np.full(stage.intervals, HALVINGS) for stage in stages]
    finer = bisect_intervals([*stages[:-1], last], search.scheme, every)
    found = enforce_between(search, search.solve(finer))
    if not found.success:
        return float("nan")
    unit = unit_of(options.goal, problem.scene.scales)
    return float(1 - unit * found.cost / sum(values))


def main() -> int:
    """Write the table and print its lines."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--problems", type=Path, default=Path("problems"), help="folder of scenes")
    parser.add_argument("--output", type=Path, default=Path("results"))
    options = parser.parse_args()
    lines = [*HEAD]
    for name in PROBLEMS:
        problem = load(str(options.problems / f"{name}.toml"))
        for objective in OBJECTIVES:
            for accuracy in ACCURACIES:
                for loss in measure_losses(problem, objective, accuracy):
                    ratio = f"{loss.estimate / loss.gain:.1f}" if loss.gain > 1e-9 else ""
                    cells = name, objective, f"{accuracy:g}", loss.phases, loss.intervals
                    sizes = f"{loss.estimate:.1e}", f"{loss.gain:.1e}", ratio
                    lines.append(f"| {' | '.join(map(str, (*cells, *sizes)))} |")
                    print(lines[-1], flush=True)
    write_text(str(options.output / "bench_accuracy.md"), "\n".join(lines) + "\n")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
