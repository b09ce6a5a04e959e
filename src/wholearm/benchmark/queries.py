"""Seeded queries from pose to pose: which are solved, how fast, and how near to the bound.

``python -m wholearm.benchmark.queries [--queries 250] [--seed 0] [--cores 2] [--jobs 1]
[--records FILE.jsonl] [-o FILE.md]`` prints a line for each query and a table. With a file of
records the study goes on where it was stopped. A query is asked on so many `cores`, or several at
once on one core each, as `jobs`. Times by the wall clock are of use with one job, on a machine that
does nothing else; the processor's are those of the process that asks. A query has a start and a
goal, each an edge on the palm and an x at which both fingers close on the object, drawn at random
for the shipped scenes and for random polygons in the hexagon's hand. Each query is asked twice:
first of a scene that nothing is known of, then for a goal a little further on, with what is known.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from ..common.errors import InfeasibleError, InputError, WholearmError
from ..common.files import write_whole
from ..problem.definition import Problem
from ..problem.goal import Goal
from ..problem.read import build_problem, place_start, read_problem
from ..search.route import find_route, forget_charts
from ..verification.verify import verify
from .stress.scenes import Table
from .stress.workers import run_tasks

SHIPPED = ("heptagon", "hexagon", "square", "triangle")
POLYGONS = 5
"""Random polygons, in the hexagon's hand."""
RADIUS = 0.05
"""Of the circle that their vertices are near [m]."""
ACROSS = 3.0
"""Largest x of a start or a goal, over the radius of gyration."""
BOUND = 90.0
"""Most processor time of a query [s]."""
SECOND = 0.1
"""How far the second query starts from the first one, over the radius of gyration."""


class Query(NamedTuple):
    """A query by its number and the folder of the shipped problems, and its cores."""

    seed: int
    number: int
    folder: Path
    cores: int = 1


class Spent(NamedTuple):
    """Time that a query takes, by the wall clock and of its own process [s]."""

    wall: float
    processor: float


NOT_ASKED = Spent(np.nan, np.nan)


class Stopwatch:
    """Time since it was made."""

    def __init__(self) -> None:
        self._wall, self._processor = time.perf_counter(), time.process_time()

    def read(self) -> Spent:
        """What has been spent since [s]."""
        return Spent(time.perf_counter() - self._wall, time.process_time() - self._processor)


class Outcome(NamedTuple):
    """What came of a query.

    Attributes
    ----------
    scene : str
    kind : {"solved", "blocked", "no answer", "plan that fails"}
    first, second : Spent
        By the query, and by the second one; NaN where it is not asked.
    gap : float
        Of routes along borders alone, NaN for others.
    duration : float
        Of the plan [s]; NaN where there is none.
    phases : int
    text : str
    """

    scene: str
    kind: str
    first: Spent
    second: Spent = NOT_ASKED
    gap: float = np.nan
    duration: float = np.nan
    phases: int = 0
    text: str = ""


def draw_scene(seed: int, number: int, folder: Path) -> Table:
    """The table of the scene of a query, without start or phases of its own."""
    kinds = len(SHIPPED) + POLYGONS
    kind = number % kinds
    name = SHIPPED[kind] if kind < len(SHIPPED) else "hexagon"
    table = dict(read_problem(str(folder / f"{name}.toml")).table)
    table.pop("phases")
    if kind >= len(SHIPPED):
        rng = np.random.default_rng([seed, 1000 + kind])
        count = int(rng.integers(3, 8))
        angles = 2 * np.pi * (np.arange(count) + rng.uniform(-0.25, 0.25, count)) / count
        corners = RADIUS * np.column_stack([np.cos(angles), np.sin(angles)])
        table["object"] = {"vertices": corners.round(4).tolist(), "mass": 0.2}
        table["name"] = f"polygon {kind - len(SHIPPED) + 1}"
    else:
        table["name"] = name
    return table


def draw_query(query: Query) -> Problem:
    """The problem of a query."""
    rng = np.random.default_rng([query.seed, query.number])
    table = draw_scene(query.seed, query.number, query.folder)
    first = _draw_pose(rng, table)
    while (last := _draw_pose(rng, table)) == first:
        pass
    return build_problem({**table, "start": first, "goal": last})


def _draw_pose(rng: np.random.Generator, table: Table) -> dict[str, float]:
    count = len(table["object"]["vertices"])
    scene = build_problem(table).scene
    size = scene.scales.length
    while True:
        edge, x = int(rng.integers(count)), round(size * rng.uniform(-ACROSS, ACROSS), 4)
        try:
            place_start(scene, edge, x)
            build_problem({**table, "start": {"flush": edge, "x": x}})
        except InputError:
            continue
        return {"flush": edge, "x": x}


def run_query(query: Query) -> Outcome:
    """Ask a query, and a second one on the same map."""
    problem = draw_query(query)
    forget_charts()
    name = f"{problem.name}: {problem.table['start']} to {problem.goals[0]}"
    spent = Stopwatch()
    try:
        answer = find_route(problem, jobs=query.cores)
    except WholearmError as error:
        kind = "blocked" if isinstance(error, InfeasibleError) else "no answer"
        return Outcome(name, kind, spent.read(), text=str(error))
    first = spent.read()
    failures = verify(answer.problem, answer.plan).failures
    if failures:
        return Outcome(name, "plan that fails", first, text=failures[0])
    return Outcome(
        name,
        "solved",
        first,
        _ask_again(problem, query.cores),
        np.nan if answer.gap is None else answer.gap,
        answer.plan.duration,
        len(answer.problem.phases),
    )


def _ask_again(problem: Problem, cores: int) -> Spent:
    """Time of a query to nearly the same goal, with what is known of the scene."""
    goal, step = problem.goals[0], SECOND * problem.scene.scales.length
    assert goal.x is not None
    table = {**problem.table, "goal": Goal(flush=goal.flush, x=goal.x + step).to_table()}
    spent = Stopwatch()
    try:
        find_route(build_problem(table), jobs=cores)
    except WholearmError:
        return NOT_ASKED
    return spent.read()


def summarise(outcomes: Sequence[Outcome]) -> str:
    """Tables of what came of queries, and of the times."""
    kinds = Counter(own.kind for own in outcomes)
    lines = ["| queries | " + " | ".join(kinds) + " |", "|---|" + "---|" * len(kinds)]
    lines.append(f"| {len(outcomes)} | " + " | ".join(str(n) for n in kinds.values()) + " |")
    lines += ["", "| time | median [s] | 95 % [s] | most [s] | processor, median [s] |"]
    lines += ["|---|---|---|---|---|"]
    solved = [own for own in outcomes if own.kind == "solved"]
    again = [own for own in solved if own.second.wall == own.second.wall]
    rows = [
        ("all", [own.first for own in outcomes]),
        ("solved", [own.first for own in solved]),
        ("blocked", [own.first for own in outcomes if own.kind == "blocked"]),
        ("second query", [own.second for own in again]),
    ]
    for name, spent in rows:
        if spent:
            middle, most, last = np.percentile([own.wall for own in spent], [50, 95, 100])
            processor = np.median([own.processor for own in spent])
            lines.append(f"| {name} | {middle:.2f} | {most:.2f} | {last:.2f} | {processor:.2f} |")
    ratios = [own.second.wall / own.first.wall for own in again]
    gaps = [own.gap for own in solved if own.gap == own.gap]
    if ratios:
        lines += ["", f"Second over first query: median {np.median(ratios):.3f}."]
    if gaps:
        text = f"Gap of {len(gaps)} routes along borders alone: at most {100 * max(gaps):.2g} %"
        lines.append(f"{text}, median {100 * float(np.median(gaps)):.2g} %.")
    return "\n".join(lines)


def read_records(path: Path | None, seed: int) -> dict[int, Outcome]:
    """What is known of queries, by their numbers, from a file of records."""
    if path is None or not path.exists():
        return {}
    lines = (json.loads(line) for line in path.read_text(encoding="utf-8").splitlines())
    return {own["number"]: _revive(own["outcome"]) for own in lines if own["seed"] == seed}


def _revive(values: list[Any]) -> Outcome:
    scene, kind, first, second, *others = values
    return Outcome(scene, kind, Spent(*first), Spent(*second), *others)


def _keep(path: Path | None, query: Query, outcome: Outcome) -> None:
    """Add a query to a file of records, and print a line about it."""
    first, second = outcome.first, outcome.second
    line = f"{query.number} {outcome.scene}: {outcome.kind}, {first.wall:.2f} s, then"
    text = outcome.text[:160] or f"{outcome.duration:.6f} s, {outcome.phases} phases"
    print(f"{line} {second.wall:.2f} s: {text}", flush=True)
    if path is not None:
        record = {"seed": query.seed, "number": query.number, "outcome": list(outcome)}
        with path.open("a", encoding="utf-8") as stream:
            stream.write(f"{json.dumps(record)}\n")


def _ask(queries: Sequence[Query], jobs: int) -> Iterator[tuple[Query, Outcome]]:
    """Ask queries, one after the other or, bounded in time, in processes of their own."""
    if jobs == 1:
        yield from ((query, run_query(query)) for query in queries)
        return
    for answer in run_tasks(run_query, queries, jobs, 2 * BOUND):
        if answer.ended == "done":
            yield answer.task, answer.result
        else:
            yield answer.task, Outcome("", "no answer", NOT_ASKED, text=str(answer.result)[-300:])


def main() -> int:
    """Print a line for each query and tables; the exit status is 1 if a plan fails."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--queries", type=int, default=250)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--first", type=int, default=0, help="number of the first query")
    parser.add_argument("--problems", type=Path, default=Path("problems"), help="folder of scenes")
    parser.add_argument("--cores", type=int, default=1, help="of each query, one after the other")
    parser.add_argument("--jobs", type=int, default=1, help="queries at once")
    parser.add_argument("--records", type=Path, help="JSON lines that the study goes on with")
    parser.add_argument("-o", "--output", type=Path, help="file for the tables")
    options = parser.parse_args()
    numbers = range(options.first, options.first + options.queries)
    known = read_records(options.records, options.seed)
    outcomes = {number: known[number] for number in numbers if number in known}
    cores = options.cores if options.jobs == 1 else 1
    tasks = [
        Query(options.seed, own, options.problems, cores) for own in numbers if own not in known
    ]
    for query, own in _ask(tasks, options.jobs):
        outcomes[query.number] = own
        _keep(options.records, query, own)
    tables = summarise(list(outcomes.values()))
    print(tables)
    if options.output is not None:
        heading = f"# From pose to pose: {len(outcomes)} queries, seed {options.seed}\n\n"
        write_whole(options.output, lambda stream: stream.write(f"{heading}{tables}\n".encode()))
    return int(any(own.kind == "plan that fails" for own in outcomes.values()))


if __name__ == "__main__":
    sys.exit(main())
