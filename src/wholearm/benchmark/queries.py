"""Seeded queries from pose to pose: number solved, processor time, and gap to the bound.

Start and goal of a query are random: an edge on the palm and an x at which both fingers close on
the object, for the shipped scenes and for random polygons in the hexagon's hand. Each scene is
searched twice: first without a roadmap, then with it for a goal slightly farther on. `draw_leg`
draws routes that need no search.

With ``--ways`` the phases that `route` prints take the place of the goal (see README.md).
"""

from __future__ import annotations

import argparse
import math
import time
import tomllib
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from ..common.document import Table
from ..common.errors import InfeasibleError, InputError, WholearmError
from ..common.fields import choice
from ..mapping.formation_list import format_route, list_formations
from ..planning.options import PlanOptions
from ..planning.plan import plan_anew, solve
from ..problem.definition import Problem
from ..problem.read import build_problem, read_problem
from ..scene.model import Polygon
from ..search.find_route import Answer, find_route, forget_roadmaps
from ..verification.free import find_policy
from ..verification.verify import verify
from .study import Case, Findings, Row, Study, group

SHIPPED = ("heptagon", "hexagon", "square", "triangle")
SAME = 1e-4  # largest relative difference of equal values of plans
RATE = 250.0  # limit of torque rates over that of torques [1/s]
WAYS = ("printed", "time", "rates", "period", "dwell", "policy")


class Queries(Study):
    """Queries, second queries on the same map, and execution of routes."""

    name, title = "queries", "From pose to pose"
    needs_problems = seeded = True
    options = f"""\
--queries N   how many = 250 in 0..100000
--polygons N  how many more, each about a new polygon in a shipped hand = 0 in 0..100000
--objective NAME  of the plans: time, effort or margin = time
--ways WAY ...  carry routes out, too: {", ".join(WAYS)}
"""

    def list_cases(self, options: argparse.Namespace) -> Iterator[Case]:
        """Kind of problem, seed, number, folder of the problems, objective, and ways."""
        objective = PlanOptions(objective=options.objective).goal.value
        ways = tuple(choice(*WAYS).read(way, "--ways") for way in options.ways)
        settings = options.problems, objective, ways
        for name in SHIPPED:
            read_problem(Path(options.problems, f"{name}.toml"))
        for kind, count in (("query", options.queries), ("polygon", options.polygons)):
            yield from ((kind, options.seed, k, *settings) for k in range(count))

    def limit(self, case: Case) -> float:
        """Two searches, and the plans."""
        return 1800.0 if case[-1] else 600.0

    def run(self, case: Case) -> Row:
        """Solve a query, and a second one on the same map."""
        source, seed, number, folder, objective, ways = case
        problem = DRAW[source](seed, number, Path(folder))
        forget_roadmaps()
        row: Row = {"text": f"{problem.name}: {problem.table['start']} to {problem.goals[0]}"}
        started = time.process_time()
        try:
            answer = find_route(problem, objective)
        except WholearmError as error:
            kind = "blocked" if isinstance(error, InfeasibleError) else "no answer"
            return row | {"kind": kind, "why": str(error), "first": time.process_time() - started}
        row["first"] = time.process_time() - started
        row |= {"gap": answer.gap, "value": answer.plan.value, "phases": len(answer.plan.phases)}
        failures = verify(answer.problem, answer.plan).failures
        if failures:
            return row | {"kind": "plan that fails", "findings": list(failures[:1])}
        started = time.process_time()
        goal, step = problem.goals[0], 0.1 * problem.scene.scales.length
        next_goal = {"flush": goal.flush, "x": (goal.x or 0.0) + step}
        with suppress(WholearmError):
            find_route(problem.with_({"goal": next_goal}), objective)
            row["second"] = time.process_time() - started
        return row | {"kind": "solved"} | (_carry_out(problem, answer, ways) if ways else {})

    def report(self, rows: Sequence[Row], options: argparse.Namespace) -> Findings:
        """Outcomes and times."""
        groups, lines = {"all": rows, **group(rows, "kind")}, list[str]()
        times = {name: [row["first"] for row in members] for name, members in groups.items()}
        times["second query"] = [row["second"] for row in rows if "second" in row]
        table = [
            (name, len(elapsed), *np.percentile(elapsed, [50, 95, 100]))
            for name, elapsed in times.items()
            if elapsed
        ]
        heads = ["queries", "number:d", "processor time, median [s]:.2f", "95 %:.2f", "most:.2f"]
        ratios = [row["second"] / row["first"] for row in rows if "second" in row]
        gaps = [row["gap"] for row in rows if row.get("gap") is not None]
        if ratios:
            lines.append(f"Second over first: median {np.median(ratios):.3f}.")
        if gaps:
            text = f"Gap of {len(gaps)} routes along borders alone: at most {100 * max(gaps):.2g} %"
            lines.append(f"{text}, median {100 * np.median(gaps):.2g} %.")
        results = [row["ways"] for row in rows if "ways" in row]
        way_rows = [*filter(None, (_sum_up(way, results) for way in WAYS))]
        heads_of_ways = ["", "carried out", "objective off, median:.2g", "most:.2g"]
        heads_of_ways += ["time, median:.2f", "95 %:.2f"]
        refusals = [
            f"* {row['text']}, {way}: {part['why'][:300]}"
            for row in rows
            for way, part in row.get("ways", {}).items()
            if part.get("why")
        ]
        listing = ["Refused:", "\n".join(refusals)] if refusals else []
        parts: list[str | Table] = [Table(heads, table), "\n".join(lines)]
        parts += [Table(heads_of_ways, way_rows), *listing]
        return parts, [f"{row['text']}: {row['findings'][0]}" for row in rows if "findings" in row]


STUDY = Queries()


def _carry_out(problem: Problem, answer: Answer, ways: tuple[str, ...]) -> Row:
    """Printed phases of a route, planned and executed in the selected ways."""
    row: Row = {"ways": {}}
    table = {key: entry for key, entry in problem.table.items() if key != "goal"}
    objective, printed = answer.plan.options.goal.value, None
    limit = RATE * min(finger.torque_limit for finger in problem.scene.fingers)
    changes: dict[str, dict[str, Any]] = {
        "rates": {"torque_rate_limit": limit},
        "period": {"control_period": 2e-3},
        "dwell": {"settle": "10 %"},
    }

    for way in dict.fromkeys(["printed", *ways]):
        started = time.process_time()
        part: Row = {}
        try:
            if printed is None:
                printed = solve(build_problem(table | tomllib.loads(answer.to_text())), objective)
                part["off"] = printed.value / answer.plan.value - 1
            elif way == "policy":
                report = find_policy(printed.problem, printed.trajectory, planner=plan_anew)[1]
                part["why"] = "; ".join(report.failures)
            else:
                changed = printed.problem.with_(changes.get(way, {}))
                transcription = "time" if way == "time" else "auto"
                plan = solve(changed, objective, transcription=transcription)
                part["off"] = plan.value / printed.value - 1
        except WholearmError as error:
            part["why"] = str(error)
        row["ways"][way] = part | {"seconds": time.process_time() - started}
        if printed is None:
            return row | {"findings": [f"as printed: {part['why']}"]}
    if abs(deviation := row["ways"]["printed"]["off"]) > SAME:
        row["findings"] = [f"as printed: off by {deviation:.2g}"]
    return row


def _sum_up(way: str, solved: Sequence[Row]) -> list[Any] | None:
    """Row of a way: number of routes, deviations of the objective, relative times."""
    attempts = [ways for ways in solved if way in ways]
    completed = [ways for ways in attempts if not ways[way].get("why")]
    deviations = [ways[way]["off"] for ways in completed if "off" in ways[way]] or [math.nan]
    ratios = [ways[way]["seconds"] / ways["printed"]["seconds"] for ways in completed] or [math.nan]
    cells = np.median(deviations), max(deviations, key=abs), *np.percentile(ratios, [50, 95])
    return [way, f"{len(completed)} of {len(attempts)}", *cells] if attempts else None


def draw_query(seed: int, number: int, folder: Path) -> Problem:
    """The problem of a query: a shipped scene, or one of five random polygons in a shipped hand."""
    kind = number % (len(SHIPPED) + 5)
    name = SHIPPED[kind] if kind < len(SHIPPED) else "hexagon"
    table = {**read_problem(str(folder / f"{name}.toml")).table, "name": name}
    table.pop("phases")
    if kind >= len(SHIPPED):
        rng = np.random.default_rng([seed, 1000 + kind])
        table["object"] = {"vertices": _draw_corners(rng, int(rng.integers(3, 8))), "mass": 0.2}
        table["name"] = f"polygon {kind - len(SHIPPED) + 1}"
    return _draw_goal(np.random.default_rng([seed, number]), table)


def draw_polygon_query(seed: int, number: int, folder: Path) -> Problem:
    """Query with a new polygon of 3 to 8 corners in a shipped hand."""
    rng = np.random.default_rng([seed, number, 2])
    base = read_problem(str(folder / f"{('heptagon', 'hexagon', 'triangle')[number % 3]}.toml"))
    table = {key: entry for key, entry in base.table.items() if key != "phases"}
    corners = _draw_corners(rng, int(rng.integers(3, 9)))
    table["object"] = {"vertices": corners, "mass": base.scene.polygon.mass}
    parts = ("palm", "finger1", "finger2")
    table["friction"] = {part: round(float(rng.uniform(0.03, 0.15)), 3) for part in parts}
    table["name"] = f"new polygon {number + 1}"
    return _draw_goal(rng, table)


DRAW = {"query": draw_query, "polygon": draw_polygon_query}


def _draw_corners(rng: np.random.Generator, count: int) -> list[list[float]]:
    angles = 2 * np.pi * (np.arange(count) + rng.uniform(-0.25, 0.25, count)) / count
    corners = 0.05 * np.column_stack([np.cos(angles), np.sin(angles)])
    return [[float(x), float(y)] for x, y in corners.round(4)]


def _draw_goal(rng: np.random.Generator, table: dict[str, Any]) -> Problem:
    """A problem from one drawn pose to another."""
    first = _draw_pose(rng, table)
    while (last := _draw_pose(rng, table)) == first:
        pass
    return build_problem({**table, "start": first, "goal": last})


def _draw_pose(rng: np.random.Generator, table: dict[str, Any]) -> dict[str, float]:
    polygon = Polygon(*map(table["object"].get, ("vertices", "mass", "inertia")))
    count, size = polygon.n_vertices, polygon.gyration_radius
    while True:
        edge, x = int(rng.integers(count)), round(size * rng.uniform(-3.0, 3.0), 4)
        try:
            build_problem({**table, "start": {"flush": edge, "x": x}})
        except InputError:
            continue
        return {"flush": edge, "x": x}


def draw_leg(
    seed: int, number: int, folder: Path
) -> tuple[Problem, list[tuple[float, float]]] | None:
    """Draw a leg of a shipped scene, a slide and one to three cells, and ends of its phases.

    Ends are (x, phi) [m, rad]. None if none of 200 routes can be listed.
    """
    rng = np.random.default_rng([seed, number])
    base = read_problem(str(folder / f"{SHIPPED[number % len(SHIPPED)]}.toml"))
    size, (x0, phi0) = base.scene.scales.length, base.start[[0, 2]].tolist()
    for _ in range(200):
        x, phi = x0 - size * rng.uniform(0.1, 2.5), phi0
        poses = [(x0, phi0), (x, phi)]
        for _ in range(int(rng.integers(1, 4))):
            x, phi = x + size * rng.uniform(-0.6, 1.0), phi - rng.uniform(0.05, 0.5)
            poses.append((x, phi))
        try:
            route = list_formations(base, *poses)
            phases = tomllib.loads(format_route(route))["phases"]
            problem = build_problem({**base.table, "phases": phases})
        except InputError:
            continue
        # The planner chooses ends freely, so a refusal holds for all of them.
        open_ends = (replace(each, until=replace(each.until, pins=())) for each in problem.phases)
        problem = replace(problem, phases=tuple(open_ends))
        if any(phase.formation.n_constraints == 3 for phase in problem.phases):
            return problem, [(float(part.stop[0]), float(part.stop[1])) for part in route]
    return None
