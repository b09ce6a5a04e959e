from __future__ import annotations

import numpy as np
import pytest

from wholearm.benchmark.stress.scenes import random_route, random_scene
from wholearm.contacts.formation import find_touching
from wholearm.problem.read import build_problem


@pytest.mark.parametrize("seed", range(4))
def test_scene_starts_with_closed_fingers(seed: int) -> None:
    problem = build_problem(random_scene(np.random.default_rng(seed)))
    assert set(find_touching(problem.scene, problem.start)) == set(problem.contacts)
    assert 3 <= problem.scene.polygon.n_vertices <= 12


def test_the_same_generator_gives_the_same_scene_and_route() -> None:
    tables, routes = [], []
    for _ in range(2):
        rng = np.random.default_rng([7, 3])
        tables.append(random_scene(rng))
        routes.append(random_route(rng, build_problem(tables[-1])))
    assert tables[0] == tables[1] and routes[0] == routes[1]
    start = build_problem(tables[0]).start
    assert len(routes[0]) >= 2 and routes[0][0] == (start[0], start[2])


def test_scenes_span_sizes_masses_and_kinds_of_fingers() -> None:
    tables = [random_scene(np.random.default_rng(seed)) for seed in range(16)]
    thin = [table["fingers"]["1"]["radius"] == 0.0 for table in tables]
    assert 2 < sum(thin) < 14
    masses = np.log10([table["object"]["mass"] for table in tables])
    sizes = np.log10([build_problem(table).scene.scales.length for table in tables])
    assert np.ptp(masses) > 4 and np.ptp(sizes) > 2
    counts = {len(table["object"]["vertices"]) for table in tables}
    assert len(counts) >= 6
