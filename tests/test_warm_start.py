from __future__ import annotations

from dataclasses import replace
from functools import lru_cache

import numpy as np
import pytest

from timed import landing
from wholearm.geometry.tracing import trace_phases
from wholearm.planning.options import PlanOptions
from wholearm.planning.time_domain.collocation import make_scheme
from wholearm.planning.time_domain.nlp_layout import pack
from wholearm.planning.time_domain.search import TimeSearch, TimeSolution, carry_multipliers
from wholearm.planning.time_domain.stage import Stage
from wholearm.planning.time_domain.time_mesh import bisect_intervals
from wholearm.planning.time_domain.time_plan import try_phases
from wholearm.planning.time_domain.units import in_own_units
from wholearm.problem.definition import Problem

SCHEME = make_scheme("radau", 3)


def search_for(objective: str) -> TimeSearch:
    return TimeSearch.of(landing(), PlanOptions(objective=objective))


@lru_cache(maxsize=2)
def coarse(objective: str) -> TimeSolution:
    """The heptagon's landing on few intervals, with limits at the points alone."""
    problem = landing()
    start = trace_phases(problem)[-1].end
    options = PlanOptions(objective=objective, time_intervals=8)
    begun = try_phases(problem, problem.phases[4:], start, options, further=9)
    assert begun is not None and isinstance(begun[0].solution, TimeSolution)
    return begun[0].solution


def replace_scene(stages: list[Stage], problem: Problem) -> list[Stage]:
    """The same stages on the formations of another scene."""
    return [replace(stage, formation=problem.phases[stage.phase].formation) for stage in stages]


def test_multipliers_are_shared_among_the_intervals_that_replace_one() -> None:
    solution = coarse("time")
    marked = [(np.arange(stage.intervals) + 1) % 2 for stage in solution.stages]
    stages = bisect_intervals(solution.stages, SCHEME, marked)
    search = search_for("time")
    nlp = search.build(stages)
    rng = np.random.default_rng(2)
    given = {key: rng.normal(size=len(table)) for key, table in solution.multipliers.items()}
    carried = carry_multipliers(given, solution.nlp, nlp, SCHEME, solution.stages, stages)
    assert len(carried["lam_g0"]) == len(nlp.rows.bounds[0])
    for k, own in enumerate(marked):
        parent = np.repeat(np.arange(len(own)), 1 + own)
        for layouts, key, name in (
            ((solution.nlp.layouts, nlp.layouts), "lam_x0", "forces"),
            ((solution.nlp.layouts, nlp.layouts), "lam_x0", "tau"),
            ((solution.nlp.rows_of, nlp.rows_of), "lam_g0", "points"),
        ):
            old, new = (getattr(part[k], name) for part in layouts)
            before, after = given[key][old], carried[key][new]
            total = np.zeros_like(before)
            np.add.at(total, parent, after)
            np.testing.assert_allclose(total, before, rtol=1e-12)


@pytest.mark.parametrize("contact", ["palm", "finger1", "finger2"])
def test_friction_is_worth_what_a_little_less_of_it_saves(contact: str) -> None:
    """By the envelope theorem: as much as the Lagrangian falls, all else as it is."""
    solution, share = coarse("effort"), 1e-3
    mu = getattr(landing().scene.friction, contact)
    other = landing().with_({f"friction_{contact}": (1 - share) * mu})
    least = PlanOptions(objective="effort")
    values = list[float]()
    for problem in (landing(), other):
        stages = replace_scene(solution.stages, in_own_units(problem))
        nlp = TimeSearch.of(problem, least).build(stages)
        x = pack([stage.guess for stage in stages], nlp.layouts, 0.0)
        g = nlp.solver.function.get_function("nlp_g")(x, [])
        values.append(float(solution.multipliers["lam_g0"] @ g.full()[:, 0]))
    own = [
        solution.price_friction(k)[..., [n.endswith(contact) for n in stage.formation.names]].sum()
        for k, stage in enumerate(solution.stages)
    ]
    # The other way is less by twice of all there is.
    assert values[0] - values[1] == pytest.approx(share / 2 * sum(own), rel=1e-6, abs=1e-12)


def test_multipliers_of_a_solution_are_those_of_its_limits() -> None:
    solution = coarse("time")
    pressing = 0
    for stage, layout in zip(solution.stages, solution.nlp.layouts, strict=True):
        lam, c_n = solution.multipliers["lam_x0"][layout.forces], stage.guess.forces
        # A bound pushes only where it is reached, to the tolerance of the solver.
        least = in_own_units(landing()).epsilon
        assert (np.abs(lam * (c_n - least)) < 1e-6).all() and lam.max() < 1e-7
        pressing += int((lam < -1e-6).sum())
    assert pressing > 10
