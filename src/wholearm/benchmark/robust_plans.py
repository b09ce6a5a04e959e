"""What plans within ranges cost, and what they bear that planning has not seen.

``python -m wholearm.benchmark.robust_plans problems/heptagon_four_contacts.toml --samples 200``
plans each problem without ranges, within them, and without them but with a larger epsilon that
takes as long. It lists the times, the least normal force in the corner scenes of the ranges (at the
same places and speeds, under the same torques), and how wide ranges may be. Of the first problem
it counts, phase by phase, samples that reach their goal and keep all contacts, free of
assumptions: torques by the clock, and by policies that keep to the ranges. The start is off in the
first phase alone: where the others start, contacts hold the object. Samples are of a seed that no
design has seen.
"""

from __future__ import annotations

import argparse
import re
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
from itertools import product
from pathlib import Path
from typing import NamedTuple

import numpy as np

from ..common.errors import InfeasibleError
from ..common.files import write_text
from ..geometry.path_guess import load
from ..mechanics.dynamics import build_forward
from ..planning.plan import solve, solve_with
from ..planning.result import Plan
from ..policy.make import make_policy
from ..policy.policy import Policy
from ..policy.widest import find_widest
from ..problem.definition import Problem
from ..results.trajectory import Trajectory
from ..robustness.study import assess_robustness, use_processes
from ..robustness.uncertainty import Uncertainty, change_problem
from .report import stamp

RANGES = {
    "mass": 0.1,
    "inertia": 0.1,
    "friction": 0.2,
    "start_x": 5e-4,
    "geometry": 0.0,
    "gain": 0.0,
    "delay": 0.0,
}
"""Half widths of the ranges."""
SCENES = {"mass": 0.1, "inertia": 0.1} | {
    f"friction_{part}": 0.2 for part in ("palm", "finger1", "finger2")
}
"""Those of them whose corners are other scenes at the same place."""
PLACES = 101
"""Instants of a phase at which corners are looked at."""
SEED = 2024


def plan_three(problem: Problem) -> dict[str, Plan]:
    """Plans without ranges, within them, and with an epsilon that takes as long."""
    robust = solve(problem, robust=1.0, largest=True)
    plans = {"nominal": solve(problem), "robust": robust}
    low, high = problem.epsilon, 16 * problem.epsilon
    for _ in range(8):
        middle = (low + high) / 2
        try:
            quicker = solve(problem.with_(epsilon=middle), replay=False).value < robust.value
        except InfeasibleError:
            quicker = False
        low, high = (middle, high) if quicker else (low, middle)
    plans[f"epsilon = {low:.3g} N"] = solve(problem.with_(epsilon=low))
    return plans


def find_least_in_corners(problem: Problem, plan: Plan) -> float:
    """The least normal force of a plan in all corner scenes of the ranges [N]."""
    least = np.inf
    for phase, motion in zip(problem.phases, plan.trajectory.motions, strict=True):
        own = motion.evaluate(np.linspace(0.0, motion.duration, PLACES)[1:-1])
        Xi, sigma = -np.sign(own.c_t), np.sign(own.z_dot[:, 3:])
        for signs in product((-1, 1), repeat=len(SCENES)):
            pairs = zip(SCENES.items(), signs, strict=True)
            scene = change_problem(problem, {name: k * w for (name, w), k in pairs}).scene
            forward = build_forward(replace(phase.formation, scene=scene)).map(len(Xi))
            c = forward(own.z.T, own.z_dot.T, own.tau.T, Xi.T, sigma.T)[1].full()
            least = min(least, float(c[: phase.formation.n_contacts].min()))
    return least


def measure_planning(plan: Plan) -> float:
    """Processor time of planning again, without a look at wider ranges [s]."""
    started = time.process_time()
    solve_with(plan.problem, replace(plan.options, largest=False))
    return time.process_time() - started


def list_times(problem: Problem, plans: Mapping[str, Plan]) -> Iterator[str]:
    """Rows of the first table."""
    for name, plan in plans.items():
        ratio = plan.value / plans["nominal"].value - 1
        widest = "-"
        if plan.ranges is not None and plan.ranges.largest is not None:
            each = ", ".join("-" if own is None else f"{own:.2f}" for own in plan.ranges.phases)
            widest = f"{plan.ranges.largest:.2f} ({each})"
        corner = "-"
        if not any(phase.formation.rolling for phase in problem.phases):
            corner = f"{find_least_in_corners(problem, plan):+.3f}"
        cells = problem.name, name, f"{plan.duration:.4f}", f"{100 * ratio:+.1f} %", corner
        yield f"| {' | '.join((*cells, f'{measure_planning(plan):.2f}', widest))} |"


def make_policies(problem: Problem, plans: Mapping[str, Plan]) -> list[tuple[str, str, Policy]]:
    """Policies with what they are called and the plan they are of."""
    found = []
    for name in ("robust", "nominal"):
        policy = make_policy(problem, plans[name].trajectory, planner=plan_anew)
        found.append((f"{name}, policy", name, policy))
    # Without ranges the reserve is what usual errors take away.
    own = problem.with_(uncertainty=None)
    plain = make_policy(own, plans["nominal"].trajectory, planner=plan_anew)
    return [*found, ("nominal, policy that knows no ranges", "nominal", plain)]


def plan_anew(problem: Problem) -> Trajectory:
    """A plan of other phases or limits, as `wholearm policy` makes them."""
    return solve(problem, replay=False).trajectory


def list_policies(
    plans: Mapping[str, Plan], policies: Sequence[tuple[str, str, Policy]]
) -> Iterator[str]:
    """Rows of the first table for policies of its first problem."""
    for text, name, policy in policies:
        plan, least = plans[name], plans["nominal"].value
        cells = [plan.problem.name, text, f"{policy.duration:.4f}"]
        cells += [f"{100 * (policy.duration / least - 1):+.1f} %", "-"]
        started = time.process_time()
        make_policy(plan.problem, plan.trajectory)
        cells.append(f"{time.process_time() - started:.2f}")
        widest = "-"
        if "knows no" not in text:
            each = find_widest(plan.problem, plan.trajectory, policy.pace.delay).values()
            widest = f"{min(each):.2f} ({', '.join(f'{own:.2f}' for own in each)})"
        yield f"| {' | '.join((*cells, widest))} |"


class Count(NamedTuple):
    """Samples of a phase and of a whole plan, processes, and the folder of records, if any."""

    samples: int
    whole: int
    jobs: int
    records: Path | None


def list_samples(
    problem: Problem, plan: Plan, name: str, policy: Policy | None, count: Count
) -> Iterator[str]:
    """Rows of the second table: of each phase, and with a policy of the whole plan."""
    whole = [] if policy is None else [None]
    for phase in [*(own.number for own in problem.phases), *whole]:
        samples = count.whole if phase is None else count.samples
        ranges = RANGES | ({} if phase in (None, 1) else {"start_x": 0.0})
        text = "all" if phase is None else str(phase)
        file = "_".join(re.findall(r"\w+", f"{name} {text} {samples}")) + ".jsonl"
        found = assess_robustness(
            problem,
            plan.trajectory,
            samples=samples,
            seed=SEED,
            uncertainty=Uncertainty(ranges, None),
            phase=phase,
            policy=policy,
            path=None if count.records is None else count.records / file,
            start=partial(use_processes, count.jobs),
        )
        first = next(iter(found.first_lost.items()), None)
        lost = "-" if first is None else f"{first[0]}: {first[1]}"
        cells = name, text, str(found.reached), str(found.kept), lost
        yield f"| {' | '.join(cells)} |"


def main() -> int:
    """Write the tables and print their rows."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("problems", nargs="+", type=Path, help="problem files")
    text = "of each phase by the policy of the robust plan"
    parser.add_argument("--samples", type=int, default=200, help=text)
    text = "of the whole plan by the policy of the robust plan"
    parser.add_argument("--whole", type=int, default=200, help=text)
    text = "of each phase otherwise, and of the whole plan"
    parser.add_argument("--compared", type=int, default=50, help=text)
    parser.add_argument("--jobs", type=int, default=1)
    text = "folder of records: what was interrupted goes on where it was"
    parser.add_argument("--records", type=Path, help=text)
    parser.add_argument("--output", type=Path, default=Path("results"))
    options = parser.parse_args()
    radii = ", ".join(f"{name} {width:g}" for name, width in RANGES.items() if width)
    lines = ["# Plans within ranges", "", stamp(), "", f"Ranges: {radii} (relative, m)."]
    lines += ["", "| problem | plan | time [s] | longer by | least c_n in corners [N] |"]
    lines[-1] += " processor [s] | widest (each phase) |"
    lines += ["|---|---|---:|---:|---:|---:|---|"]
    first: tuple[Problem, dict[str, Plan]] | None = None

    def add(row: str) -> None:
        lines.append(row)
        print(row, flush=True)

    for path in options.problems:
        problem = load(str(path)).with_(uncertainty=RANGES)
        plans = plan_three(problem)
        first = first or (problem, plans)
        for row in list_times(problem, plans):
            add(row)
    assert first is not None
    problem, plans = first
    policies = make_policies(problem, plans)
    for row in list_policies(plans, policies):
        add(row)
    lines += ["", f"{problem.name}: samples of each phase from rest, and of the whole plan"]
    lines[-1] += f", seed {SEED}"
    lines += ["", "| plan | phase | goal reached | and contacts kept | lost first |"]
    lines += ["|---|---:|---|---|---|"]
    many = Count(options.samples, options.whole, options.jobs, options.records)
    few = many._replace(samples=options.compared, whole=options.compared)
    for k, (text, name, policy) in enumerate(policies):
        count = many if k == 0 else few
        for row in list_samples(problem, plans[name], text, policy, count):
            add(row)
    for name, plan in plans.items():
        for row in list_samples(problem, plan, name, None, few):
            add(row)
    write_text(str(options.output / "bench_robust.md"), "\n".join(lines) + "\n")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
