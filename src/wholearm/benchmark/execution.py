"""Seeded routes, carried out in every way: as printed, over time, by limited motors, by a policy.

Routes are those of the queries study. The phases that `route` prints take the place of the goal;
they are planned as they are, over time, with limited rates, with control periods and with dwell,
and a policy is made of the plan and simulated without given contacts. Counted is what has a plan,
how far its objective is from that of the route, and the processor time over that of planning the
printed phases.
"""

from __future__ import annotations

import argparse
import time
import tomllib
from collections import Counter
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from ..common.errors import WholearmError
from ..common.fields import choice
from ..planning.options import PlanOptions
from ..planning.plan import solve
from ..planning.result import Plan
from ..policy.make import make_policy
from ..problem.definition import Problem
from ..problem.read import build_problem
from ..results.trajectory import Trajectory
from ..verification.free import verify_policy
from .queries import ask_route
from .study import Case, Row, Study, format_table

SAME = 1e-4  # relative difference of values of plans that count as the same
WAYS = ("printed", "time", "rates", "period", "dwell", "policy")
RATE = 250.0  # limit of torque rates over that of torques [1/s]


class Execution(Study):
    """Routes between poses, carried out in every way."""

    name, title = "execution", "Routes carried out in every way"
    shipped = seeded = True
    options = """\
--queries N   how many routes of the queries study = 100 in 0..100000
--polygons N  how many more, each about a new polygon in a shipped hand = 40 in 0..100000
--objective NAME  of the plans: time, effort or margin = time
--ways WAYS   of printed, time, rates, period, dwell and policy, with commas between (all)
"""

    def stamp(self, options: argparse.Namespace) -> dict[str, Any]:
        """Seed and what is asked."""
        return {key: getattr(options, key) for key in ("seed", "objective", "ways")}

    def list_cases(self, options: argparse.Namespace) -> Iterator[Case]:
        """What is drawn, its seed and number, folder of the problems, objective and ways."""
        objective = PlanOptions(objective=options.objective).goal.value
        ways = tuple(options.ways.split(",")) if options.ways else WAYS
        for way in ways:
            choice(*WAYS).read(way, "--ways")
        for kind, count in (("query", options.queries), ("polygon", options.polygons)):
            yield from (
                (kind, options.seed, k, options.problems, objective, ways) for k in range(count)
            )

    def limit(self, case: Case) -> float:
        """A search and the plans."""
        return 1800.0

    def run(self, case: Case) -> Row:
        """Find a route, and carry it out."""
        *route, ways = case
        objective = route[-1]
        problem, answer, row = ask_route(tuple(route))
        if answer is None:
            return row
        table = {key: entry for key, entry in problem.table.items() if key != "goal"}
        phases = tomllib.loads(answer.to_text())
        row |= {"kind": "solved", "phases": len(phases["phases"]), "ways": {}}
        printed: Plan | None = None
        for way in ("printed", *(way for way in ways if way != "printed")):
            started = time.process_time()
            part: Row = {}
            try:
                if printed is None:
                    printed = solve(build_problem(table | phases), objective)
                    part["off"] = printed.value / answer.plan.value - 1
                elif way == "policy":
                    policy = make_policy(printed.problem, printed.trajectory, planner=plan_anew)
                    report = verify_policy(printed.problem, printed.trajectory, policy)
                    part["why"] = "; ".join(report.failures)
                else:
                    transcription = "time" if way == "time" else "auto"
                    changed = vary(printed.problem, way)
                    plan = solve(changed, objective, transcription=transcription)
                    part["off"] = plan.value / printed.value - 1
            except WholearmError as error:
                part["why"] = str(error)
            row["ways"][way] = part | {"seconds": time.process_time() - started}
            if printed is None:
                return row | {"findings": [f"as printed: {part['why']}"]}
        if abs(off := row["ways"]["printed"]["off"]) > SAME:
            row["findings"] = [f"as printed: off by {off:.2g}"]
        return row

    def report(self, rows: Sequence[Row], options: argparse.Namespace) -> tuple[str, list[str]]:
        """How many routes are carried out in each way, and the most frequent refusals."""
        kinds = Counter(row["kind"] for row in rows)
        lines = format_table(["routes", *kinds], [(len(rows), *kinds.values())], 1 + len(kinds))
        solved = [row["ways"] for row in rows if "ways" in row]
        table, refusals = [], list[str]()
        for way in WAYS:
            parts = [ways[way] for ways in solved if way in ways]
            good = [part for part in parts if not part.get("why")]
            off = [part["off"] for part in good if "off" in part]
            ratios = [
                ways[way]["seconds"] / ways["printed"]["seconds"]
                for ways in solved
                if way in ways and not ways[way].get("why")
            ]
            if not parts:
                continue
            shown = ["-"] * 4
            if off:
                shown[:2] = [f"{value:.2g}" for value in (np.median(off), max(off, key=abs))]
            if ratios:
                shown[2:] = [f"{value:.2f}" for value in np.percentile(ratios, [50, 95])]
            table.append((way, f"{len(good)} of {len(parts)}", *shown))
        heads = ["", "carried out", "objective off: median", "most", "time: median", "95 %"]
        lines += ["", *format_table(heads, table)]
        for row in rows:
            for way, part in row.get("ways", {}).items():
                if part.get("why"):
                    refusals.append(f"* {row['text']}, {way}: {part['why'][:300]}")
        if refusals:
            lines += ["", "Refused:", "", *refusals]
        wrong = [row for row in rows if "findings" in row]
        return "\n".join(lines), [f"{row['text']}: {row['findings'][0]}" for row in wrong]


def plan_anew(problem: Problem) -> Trajectory:
    """What a policy plans anew, as the command `policy` does."""
    return solve(problem, replay=False).trajectory


def vary(problem: Problem, way: str) -> Problem:
    """A problem as it is carried out in a way."""
    limit = RATE * min(finger.torque_limit for finger in problem.scene.fingers)
    changes: dict[str, dict[str, Any]] = {
        "time": {},
        "rates": {"torque_rate_limit": limit},
        "period": {"control_period": 2e-3},
        "dwell": {"settle": "10 %"},
    }
    return problem.with_(changes[way])


STUDY = Execution()
