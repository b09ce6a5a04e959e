"""Random straight legs through cells of the map, planned or refused, and how long that takes.

``python -m wholearm.benchmark.legs [--legs 200] [--seed 0] [--objective all] [--jobs 2]`` prints a
line for each leg and a table. A leg slides along the palm and then goes through one to three cells,
from rest to rest; the map lists its phases. Plans are verified by replay and an independent
residual, refusals are looked at by linear programmes of their own (`benchmark.stress.refusals`).
"""

from __future__ import annotations

import argparse
import sys
import time
import tomllib
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from ..common.errors import InfeasibleError, InputError, SolverError, WholearmError
from ..mapping.route import format_route, list_formations
from ..planning.options import CHOICES
from ..planning.plan import solve
from ..problem.definition import Problem
from ..problem.read import build_problem, read_problem
from ..verification.verify import verify
from .stress.plan_check import check_plan
from .stress.refusals import judge
from .stress.scenes import Table
from .stress.workers import run_tasks

PROBLEMS = ("heptagon", "hexagon", "square", "triangle")
"""Shipped problems whose scenes and starts are taken in turn."""
TRIES = 200
"""Most routes that are drawn for one leg."""
SLIDE = (0.1, 2.5)
"""Least and longest slide at first, over the radius of gyration."""
CELL = ((-0.6, 1.0), (0.05, 0.5))
"""What one cell adds to x, over the radius of gyration, and takes from phi [rad]."""
SLOW = 5.0
"""Processor time [s] from which on an answer counts as slow."""
BOUND = 300.0
"""Most processor time [s] of one leg with the second look at it."""
ITERATIONS = "Maximum_Iterations_Exceeded"
"""What no answer may say: a limit of iterations is no reason."""

Stops = list[tuple[float, float]]


class Leg(NamedTuple):
    """A leg as a problem.

    Attributes
    ----------
    name : str
        Of the scene.
    problem : Problem
    stops : list of (float, float)
        Where its phases stop, (x, phi) [m, rad].
    """

    name: str
    problem: Problem
    stops: Stops


class Outcome(NamedTuple):
    """What came of a leg.

    Attributes
    ----------
    kind : str
        One of `KINDS`.
    reason : str
        Kind of the argument of a refusal; empty for plans.
    text : str
    seconds : float
        Processor time of the answer.
    """

    kind: str
    reason: str
    text: str
    seconds: float


KINDS = (
    "planned",
    "refused, confirmed",
    "refused, open",
    "refused, close",
    "refused, refuted",
    "no answer",
    "iteration limit",
    "plan that fails",
    "traceback",
)
"""How a leg may end; the last five, and a limit of iterations above all, should be none."""


def draw_leg(seed: int, number: int, folder: Path) -> Leg | None:
    """Draw a leg of a shipped scene; None if no route of `TRIES` can be listed."""
    rng = np.random.default_rng([seed, number])
    name = PROBLEMS[number % len(PROBLEMS)]
    table: Table = dict(read_problem(str(folder / f"{name}.toml")).table)
    base = build_problem(table)
    size, (x0, phi0) = base.scene.scales.length, base.start[[0, 2]].tolist()
    for _ in range(TRIES):
        x, phi = x0 - size * rng.uniform(*SLIDE), phi0
        poses = [(x0, phi0), (x, phi)]
        for _ in range(int(rng.integers(1, 4))):
            x, phi = x + size * rng.uniform(*CELL[0]), phi - rng.uniform(*CELL[1])
            poses.append((x, phi))
        try:
            route = list_formations(base, *poses)
            phases = tomllib.loads(format_route(route))["phases"]
            problem = _leave_open(build_problem({**table, "phases": phases}))
        except InputError:
            continue
        if any(phase.formation.n_constraints == 3 for phase in problem.phases):
            stops = [(float(part.stop[0]), float(part.stop[1])) for part in route]
            return Leg(name, problem, stops)
    return None


def _leave_open(problem: Problem) -> Problem:
    """The problem with ends that the planner chooses: what a refusal says holds for all places."""
    phases = (replace(own, until=replace(own.until, pins=())) for own in problem.phases)
    return replace(problem, phases=tuple(phases))


def run_leg(leg: Leg, objective: str) -> Outcome:
    """Plan a leg, and look again at what is said of it."""
    started = time.process_time()

    def spent() -> float:
        return time.process_time() - started

    try:
        plan = solve(leg.problem, objective)
    except WholearmError as error:
        seconds, text = spent(), str(error)
        if ITERATIONS in text:
            return Outcome("iteration limit", "", text, seconds)
        if isinstance(error, SolverError) or not isinstance(error, InfeasibleError | InputError):
            return Outcome("no answer", type(error).__name__, text, seconds)
        verdict = judge(leg.problem, error, leg.stops, objective)
        said = f"{text} [{verdict.kind}: {verdict.reason}]"
        return Outcome(f"refused, {verdict.kind}", name_argument(text), said, seconds)
    except Exception as error:
        return Outcome("traceback", "", repr(error), spent())
    seconds = spent()
    failures = [*verify(leg.problem, plan).failures, *check_plan(leg.problem, plan.trajectory)]
    if failures:
        return Outcome("plan that fails", "", failures[0], seconds)
    return Outcome("planned", "", f"{plan.value:.6g}", seconds)


def name_argument(text: str) -> str:
    """Which argument a refusal gives."""
    if "no motion begins" in text:
        return "rest at the start"
    if "comes to rest" in text:
        return "rest at the end"
    return "least shortfalls" if " short at " in text else "other"


class Task(NamedTuple):
    """A leg to be drawn and run."""

    seed: int
    number: int
    objective: str
    folder: Path


def run_task(task: Task) -> tuple[str, Outcome] | None:
    """Draw a leg and run it: the name of its scene and what came of it; None without a route."""
    leg = draw_leg(task.seed, task.number, task.folder)
    return None if leg is None else (leg.name, run_leg(leg, task.objective))


def run_legs(tasks: Sequence[Task], jobs: int, say: Callable[[str], object]) -> list[Outcome]:
    """Run legs in worker processes, with a line for each to `say`."""
    outcomes = []
    for answer in run_tasks(run_task, tasks, jobs, BOUND):
        task: Task = answer.task
        at = f"{task.number} {task.objective}"
        if answer.ended != "done":
            kind = "traceback" if answer.ended == "raised" else "no answer"
            found = "", Outcome(kind, answer.ended, str(answer.result), answer.seconds)
        elif answer.result is None:
            say(f"{at} no route")
            continue
        else:
            found = answer.result
        name, outcome = found
        outcomes.append(outcome)
        kind = f"{outcome.kind}, {outcome.reason}" if outcome.reason else outcome.kind
        say(f"{at} {name} {outcome.seconds:.1f} s {kind}: {outcome.text}")
    return outcomes


def summarise(outcomes: Sequence[Outcome]) -> str:
    """A table of how legs ended, and of times."""
    kinds = Counter(outcome.kind for outcome in outcomes)
    lines = []
    for kind in KINDS:
        reasons = Counter(o.reason for o in outcomes if o.kind == kind and o.reason)
        parts = ", ".join(f"{reason} {n}" for reason, n in reasons.most_common())
        lines.append(f"{kind:20} {kinds[kind]:5d}" + (f"  ({parts})" if parts else ""))
    for name, begins in (("plans", "planned"), ("refusals", "refused"), ("all", "")):
        times = [o.seconds for o in outcomes if o.kind.startswith(begins)]
        if times:
            middle, most = np.percentile(times, [50, 95])
            slow = sum(seconds > SLOW for seconds in times)
            figures = f"median {middle:.2f} s, 95 % {most:.2f} s, {slow} over {SLOW:g} s"
            lines.append(f"time of {name}: {figures}")
    return "\n".join(lines)


def main() -> int:
    """Print a line for each leg and a table; the exit status is 1 if any ended as none should."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--legs", type=int, default=200)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--first", type=int, default=0, help="number of the first leg")
    parser.add_argument("--objective", choices=(*CHOICES, "all"), default="time")
    parser.add_argument("--problems", type=Path, default=Path("problems"), help="folder of scenes")
    parser.add_argument("--jobs", type=int, default=1, help="worker processes")
    options = parser.parse_args()

    def say(line: str) -> None:
        print(line, flush=True)

    every = CHOICES if options.objective == "all" else (options.objective,)
    numbers = range(options.first, options.first + options.legs)
    tasks = [Task(options.seed, n, goal, options.problems) for n in numbers for goal in every]
    outcomes = run_legs(tasks, options.jobs, say)
    print(summarise(outcomes))
    return int(any(outcome.kind in KINDS[4:] for outcome in outcomes))


if __name__ == "__main__":
    sys.exit(main())
