"""The study that looks at every route: its shortest path is the best of all sequences of links."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np
import pytest

from shipped import HEPTAGON, problem_of
from wholearm.benchmark.enumeration import END, PHASES, Graph, summarise
from wholearm.benchmark.queries import NOT_ASKED, Outcome
from wholearm.problem.definition import Until
from wholearm.search.chart import Chart
from wholearm.search.links import Link, Step
from wholearm.search.places import Key, Place

Links = dict[Key, list[tuple[Link, Key]]]


def draw(seed: int) -> Graph:
    """Eight places with random links of one to three phases between them, and to the goal."""
    rng, problem = np.random.default_rng(seed), problem_of(HEPTAGON)
    z = np.array(problem.start)
    places = [Place(problem.scene, z + 0.01 * k * np.eye(5)[0], ()) for k in range(8)]
    links: Links = {place.key: [] for place in places}
    for place in places:
        for stop in [*rng.choice(len(places), 2), None]:
            if stop is None and rng.random() < 0.6:
                continue
            there = place if stop is None else places[stop]
            steps = (Step((), Until()),) * int(rng.integers(1, 4))
            link = Link(place, there, steps, float(rng.uniform(0.1, 1.0)))
            links[place.key].append((link, END if stop is None else there.key))
    return Graph(Chart(problem, 0.1), places[0], links)


def list_sequences(graph: Graph, key: Key, count: int) -> Iterator[list[Link]]:
    for link, stop in graph.links.get(key, []):
        left = count - len(link.steps)
        if left >= 0 and stop == END:
            yield [link]
        elif left >= 0:
            yield from ([link, *rest] for rest in list_sequences(graph, stop, left))


@pytest.mark.parametrize("seed", range(5))
def test_the_best_route_is_that_of_all_sequences(seed: int) -> None:
    graph = draw(seed)
    costs = [sum(map(graph.weigh, own)) for own in list_sequences(graph, graph.start.key, PHASES)]
    best = graph.find_best()
    least = math.inf if best is None else best.duration
    assert least == pytest.approx(min(costs, default=math.inf))
    assert best is None or sum(len(link.steps) for link in best.links) <= PHASES
    # Without its first link the best is another one.
    if best is not None:
        graph.failed.add(best.links[0])
        other = graph.find_best()
        assert other is None or (best.links[0] not in other.links and other.duration >= least)


def test_the_share_counts_what_the_search_has_missed() -> None:
    solved = [Outcome("square", "solved", NOT_ASKED, duration=1.0, phases=k) for k in (2, 6, 7)]
    blocked = [Outcome("square", "blocked", NOT_ASKED)] * 2
    record = {"scene": "square", "exhausted": True, "best": None, "search": "blocked", "phases": 0}
    records = [record | {"query": 3}]
    # Longer than what is enumerated counts for neither.
    assert "known for: the search has solved 2, 100.0 %" in summarise([*solved, *blocked], records)
    records.append(record | {"query": 4, "best": 0.5})
    text = summarise([*solved, *blocked], records)
    assert "has solved 2, 66.7 %" in text and "missed: 4 (square), 0.5000 s" in text
    records.append(record | {"query": 5, "exhausted": False})
    assert "not to the end: 5" in summarise(solved, records)
