"""Every route of up to six phases, to see what the search for routes leaves out.

``python -m wholearm.benchmark.enumeration RECORDS.jsonl [--unsolved] [-o FILE.jsonl]`` takes the
queries of `benchmark.queries` from its file of records, or those of them that the search has not
solved. For each it looks at all sequences of phases that the map has, along borders, passed or with
stops, and through cells, also from where cells have been left: no rule of thumb says which way to
go, and none is left out for what it costs. As all links begin and end at rest, they are planned
once, and a shortest path over them stands for all sequences. It goes on until a route is found
where the search found none, or until nothing can be faster than the search's answer, for as long as
a query may last. Lines of JSON are added to the file; queries that are there already are left out.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

from ..planning.options import PlanOptions
from ..planning.result import Plan
from ..problem.definition import Problem
from ..search.chart import Chart
from ..search.find import Route
from ..search.goals import is_at
from ..search.joining import join_route
from ..search.links import Link
from ..search.measure import Measured
from ..search.places import Key, Place, make_place
from ..search.polishing import Polisher
from .queries import Outcome, Query, draw_query, read_records

PHASES = 6
"""Most phases of a route."""
HOPEFUL = 0.5
"""Share of the time of straight ways that plans through cells take at least, where not planned."""
END: Key = ((), 0, 0)
"""Stands for the goal, which nothing leads on from."""
FASTER = 0.99
"""Share of the search's answer below which a route counts as faster."""


class Label(NamedTuple):
    """The cheapest way to a place with a number of phases: what it costs, and its last link."""

    cost: float
    link: Link | None
    before: tuple[int, Key] | None


@dataclass
class Graph:
    """All links from a start to a goal, within so many phases.

    Attributes
    ----------
    chart : Chart
    start : Place
    links : dict
        Links from each place, by its key, and the keys of where they stop.
    failed : set of Link
        Those that have no plan.
    """

    chart: Chart
    start: Place
    links: dict[Key, list[tuple[Link, Key]]] = field(default_factory=dict)
    failed: set[Link] = field(default_factory=set)

    def weigh(self, link: Link) -> float:
        """What a link costs, or may cost at least while it is not planned [s]."""
        known = self.chart.measured.get(link)
        if link in self.failed or isinstance(known, str):
            return math.inf
        if isinstance(known, Measured):
            return known.duration
        return HOPEFUL * link.duration if link.in_cell else link.duration

    def find_best(self) -> Route | None:
        """The route that may be the cheapest of all; None where none is left."""
        start = self.start.key
        labels: list[dict[Key, Label]] = [{start: Label(0.0, None, None)}]
        labels += [{} for _ in range(PHASES)]
        for count, own in enumerate(labels):
            for key, label in list(own.items()):
                for link, stop in self.links.get(key, ()):
                    after, cost = count + len(link.steps), label.cost + self.weigh(link)
                    if after > PHASES or not cost < math.inf:
                        continue
                    known = labels[after].get(stop)
                    if known is None or cost < known.cost:
                        labels[after][stop] = Label(cost, link, (count, key))
        found = [(own[END].cost, count) for count, own in enumerate(labels) if END in own]
        if not found:
            return None
        links, at = list[Link](), (min(found)[1], END)
        while (label := labels[at[0]][at[1]]).link is not None:
            links.append(label.link)
            assert label.before is not None
            at = label.before
        return Route(tuple(links[::-1]))


def build_graph(problem: Problem, chart: Chart, until: float) -> tuple[Graph, bool]:
    """All links within reach, and whether that was all, before a processor time `until` [s]."""
    goal = problem.goals[0]
    graph = Graph(chart, make_place(problem.scene, problem.start))
    reached, waiting = {graph.start.key: 0}, [graph.start]
    while waiting:
        if time.process_time() > until:
            return graph, False
        place = waiting.pop(0)
        count, found = reached[place.key], list(_list_links(chart, place, problem))
        ends = [END if is_at(link.stop, goal) else link.stop.key for link in found]
        graph.links[place.key] = list(zip(found, ends, strict=True))
        for link, stop in graph.links[place.key]:
            after = count + len(link.steps)
            if stop != END and after < reached.get(stop, PHASES + 1):
                reached[stop] = after
                if after < PHASES:
                    waiting.append(link.stop)
    return graph, True


def _list_links(chart: Chart, place: Place, problem: Problem) -> Iterator[Link]:
    goal = problem.goals[0]
    every = [link for _, link in chart.list_along(place, goal)]
    every += [*chart.cross_cells(place), *chart.end_in_cell(place, goal)]
    if not place.landed:
        for index, (border, _) in enumerate(chart.follow(place)):
            every += chart.release(border, index)
    every += chart.land_at(every, goal)
    yield from (link for link in every if isinstance(link, Link))


def enumerate_routes(
    problem: Problem, chart: Chart, enough: float, seconds: float
) -> dict[str, Any]:
    """Look for a route that takes less than `enough` [s], infinite for any.

    Returns
    -------
    dict
        What was looked at, whether that was all, and the best route, if there is one.
    """
    options, started = PlanOptions(), time.process_time()
    graph, complete = build_graph(problem, chart, started + seconds)
    record: dict[str, Any] = {
        "places": len(graph.links),
        "links": sum(map(len, graph.links.values())),
        "planned": 0,
        "exhausted": False,
        "best": None,
    }
    while time.process_time() < started + seconds:
        route = graph.find_best()
        if route is None or sum(map(graph.weigh, route.links)) >= enough:
            record["exhausted"] = complete
            break
        new = [own for own in route.links if own.in_cell and own not in chart.measured]
        for link in new:
            chart.measured[link] = Polisher(problem, chart, options).measure(link)
            record["planned"] += 1
        if new:
            continue
        plan, failed = _plan_route(problem, chart, route, options)
        if plan is None:
            graph.failed.add(failed)
        else:
            record["best"] = plan.duration
            record["route"] = [
                [*phase.formation.names, str(phase.until)] for phase in plan.problem.phases
            ]
            enough = min(enough, plan.duration)
    return record


def _plan_route(
    problem: Problem, chart: Chart, route: Route, options: PlanOptions
) -> tuple[Plan | None, Link]:
    """The plan of a route; without one, the first link that has none after those before."""
    for count in (len(route.links), *range(1, len(route.links))):
        known = [(own, chart.measured.get(own)) for own in route.links[:count]]
        links = [(own, [way] if isinstance(way, Measured) else []) for own, way in known]
        plan = join_route(problem, links, options, chart.joined, lambda _: None)
        if isinstance(plan, Plan):
            if count == len(route.links):
                return plan, route.links[-1]
        elif count < len(route.links):
            return None, route.links[count - 1]
    return None, route.links[-1]


def run_query(
    query: Query, outcome: Outcome, charts: dict[str, Chart], seconds: float
) -> dict[str, Any]:
    """Look at every route of a query, of which is known what came of its search."""
    problem = draw_query(query)
    chart = charts.setdefault(problem.name, Chart(problem, PlanOptions().uniqueness_margin))
    record: dict[str, Any] = {"query": query.number, "scene": problem.name}
    record |= {"search": outcome.kind, "duration": outcome.duration, "phases": outcome.phases}
    enough = FASTER * outcome.duration if outcome.kind == "solved" else math.inf
    started = time.process_time()
    record |= enumerate_routes(problem, chart, enough, seconds)
    return record | {"enumerated": round(time.process_time() - started, 2)}


def summarise(outcomes: Sequence[Outcome], records: Sequence[dict[str, Any]]) -> str:
    """Of how many queries that a route of up to six phases solves the search has an answer.

    Parameters
    ----------
    outcomes : sequence of Outcome
        What came of all searches.
    records : sequence of dict
        What came of looking at every route, of some of them.
    """
    short = [own for own in outcomes if own.kind == "solved" and own.phases <= PHASES]
    missed = [own for own in records if own["search"] != "solved" and own["best"] is not None]
    shorter = [own for own in records if own["phases"] > PHASES and own["best"] is not None]
    faster = [own for own in records if own["search"] == "solved" and own["best"] is not None]
    known = len(short) + len(shorter)
    both = known + len(missed)
    share = 100 * known / both if both else math.nan
    open_ones = [own["query"] for own in records if not own["exhausted"] and own["best"] is None]
    lines = [
        f"{len(outcomes)} queries, {both} of which a route of up to {PHASES} phases is known for: "
        f"the search has solved {known}, {share:.1f} %.",
        f"{len(records)} enumerated, {len(records) - len(open_ones)} of them to the end; "
        f"{len(faster)} answers with a faster route.",
    ]
    lines += [f"missed: {own['query']} ({own['scene']}), {own['best']:.4f} s" for own in missed]
    lines += [
        f"faster: {own['query']} ({own['scene']}), {own['best']:.4f} s, not {own['duration']:.4f} s"
        for own in faster
    ]
    lines += [f"not to the end: {', '.join(map(str, open_ones))}"] if open_ones else []
    return "\n".join(lines)


def main() -> int:
    """Add a line for each query to a file, and print a summary."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("records", type=Path, help="what came of searches")
    parser.add_argument("--unsolved", action="store_true", help="only what these have not solved")
    parser.add_argument("--first", type=int, default=0, help="the first query that is looked at")
    parser.add_argument("--step", type=int, default=1, help="from one to the next")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--problems", type=Path, default=Path("problems"), help="folder of scenes")
    parser.add_argument("--seconds", type=float, default=60.0, help="most, for each query")
    parser.add_argument("-o", "--output", type=Path, default=Path("enumeration.jsonl"))
    options = parser.parse_args()
    outcomes = read_records(options.records, options.seed)
    text = options.output.read_text(encoding="utf-8") if options.output.exists() else ""
    records = [json.loads(line) for line in text.splitlines()]
    known, charts = {own["query"] for own in records}, dict[str, Chart]()
    asked = [
        number
        for number, own in sorted(outcomes.items())
        if not (options.unsolved and own.kind == "solved")
    ]
    for number in asked[options.first :: options.step]:
        if number in known:
            continue
        query = Query(options.seed, number, options.problems)
        records.append(run_query(query, outcomes[number], charts, options.seconds))
        line = json.dumps(records[-1])
        print(line, flush=True)
        with options.output.open("a", encoding="utf-8") as stream:
            stream.write(f"{line}\n")
    print(summarise(list(outcomes.values()), records))
    return 0


if __name__ == "__main__":
    sys.exit(main())
