"""Whole plans with all numbers off at once: open loop by the clock, and with a policy.

``python -m wholearm.benchmark.whole_plans problems/heptagon.toml --samples 1000`` plans each
problem as fast as possible, once with its ends held (`settle`) for torques by the clock, and once
for a policy. It counts samples of the usual ranges (masses 5 %, friction 10 %, geometry and start
0.2 mm, torques 1 %, sampled at 1 kHz, up to 1 ms late) that reach their goal within 1 mm and 1
degree, and those that keep all contacts too, free of assumptions. Nothing is designed with these
samples. They are kept in OUTPUT, one by one: the same command goes on where it was stopped.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

from ..common.files import write_text
from ..planning.plan import solve
from ..policy.make import make_policy
from ..policy.policy import Policy
from ..problem.definition import Problem
from ..problem.read import read_problem
from ..results.trajectory import Trajectory
from ..robustness.study import Robustness, assess_robustness, use_processes
from ..robustness.uncertainty import Uncertainty
from .report import stamp

SETTLE = "10 %"
"""How much longer the plans by the clock are."""
SEED = 20260
"""Of the samples."""
HEAD = (
    "# Whole plans with all numbers off at once",
    "",
    stamp(),
    "",
    "Half widths: mass and inertia 5 %, friction 10 %, lengths, bases and the start 0.2 mm,",
    "torques 1 %; sampled and held at 1 kHz, 0 to 1 ms late. Goals are reached within 1 mm and 1",
    f"degree. By the clock ends of phases are held, {SETTLE} longer than the plan. Intervals are",
    "Wilson's, of 95 %.",
    "",
    "| problem | torques | plan [s] | carried out [s] | goal reached | and contacts kept "
    "| lost first |",
    "|---|---|---:|---:|---|---|---|",
)


def list_rows(path: Path, run: Callable[..., Robustness]) -> list[str]:
    """The rows of a problem in the table: by the clock, and with a policy."""
    problem = read_problem(str(path))
    plan = solve(problem, replay=False).trajectory
    held_problem = problem.with_(settle=SETTLE)
    held = solve(held_problem, replay=False).trajectory
    policy = make_policy(problem, plan, planner=lambda own: solve(own, replay=False).trajectory)
    cases: list[tuple[str, Problem, Trajectory, Policy | None, float]] = [
        ("by the clock", held_problem, held, None, held.duration),
        ("policy", problem, plan, policy, policy.duration),
    ]
    rows = []
    for name, own, trajectory, law, duration in cases:
        found = run(own, trajectory, f"{path.stem}_{name.split()[-1]}", law)
        longer = f"{duration:.4f} ({duration / plan.duration - 1:+.1%})"
        lost = next(iter(found.first_lost.items()), None)
        cells = [problem.name, name, f"{plan.duration:.4f}", longer]
        cells += [str(found.reached), str(found.kept)]
        cells.append("-" if lost is None else f"{lost[0]}: {lost[1]}")
        rows.append(f"| {' | '.join(cells)} |")
        print(rows[-1], flush=True)
    return rows


def main(arguments: Sequence[str] | None = None) -> int:
    """Write the table and print its lines."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("problems", nargs="+", type=Path, help="problem files")
    parser.add_argument("--samples", type=int, default=1000)
    parser.add_argument("--seed", type=int, default=SEED)
    parser.add_argument("--jobs", type=int, help="worker processes (default: all cores)")
    parser.add_argument("--output", type=Path, default=Path("results"))
    options = parser.parse_args(arguments)

    def run(problem: Problem, plan: Trajectory, name: str, policy: Policy | None) -> Robustness:
        return assess_robustness(
            problem,
            plan,
            samples=options.samples,
            seed=options.seed,
            uncertainty=Uncertainty(),
            policy=policy,
            path=options.output / f"bench_whole_{name}.jsonl",
            start=partial(use_processes, options.jobs),
        )

    lines = [*HEAD]
    for path in options.problems:
        lines += list_rows(path, run)
        write_text(str(options.output / "bench_whole_plans.md"), "\n".join(lines) + "\n")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
