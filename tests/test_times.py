from __future__ import annotations

import math
import warnings

import numpy as np
import pytest

from shipped import HEPTAGON, problem_of
from wholearm.geometry.curve import Curve
from wholearm.geometry.tracing import trace_curve, trace_phases
from wholearm.mapping.formation_map import Border
from wholearm.planning.lower_bound.lower_bound import look_along
from wholearm.planning.lower_bound.speed_sweep import NoMotionError
from wholearm.problem.definition import Until
from wholearm.search import times
from wholearm.search.edges import cut_curve
from wholearm.search.times import time_borders


def look(curve: Curve, epsilon: float) -> float:
    try:
        return look_along((curve,), epsilon, 100)
    except NoMotionError:
        return math.inf


def make_border(curve: Curve) -> Border:
    z = curve.evaluate(np.linspace(0, curve.length, 12)).z
    still = np.zeros(len(z), dtype=bool)
    return Border(curve.formation.contacts, (None, 0), "x", z[:, [0, 2]], z, still, still, still)


def test_times_of_borders_are_those_of_sweeps_along_traced_curves() -> None:
    problem = problem_of(HEPTAGON)
    curves = trace_phases(problem)
    expected = []
    for forth in curves:
        way = -forth.evaluate(np.array([forth.length])).z_s[0]
        back = cut_curve(trace_curve(forth.formation, forth.end, way, Until()), forth.length)
        expected.append([look(own, problem.epsilon) for own in (forth, back)])
    found = time_borders(problem, [make_border(curve) for curve in curves])
    # Twelve points and twenty-four intervals leave an error of a few in a hundred.
    assert found == pytest.approx(np.array(expected), rel=0.04)
    assert np.isfinite(found[:, 0]).all()


def test_borders_with_ambiguous_forces_are_not_passed(monkeypatch: pytest.MonkeyPatch) -> None:
    """With or without viscous friction, and without a warning."""
    problem = problem_of(HEPTAGON)
    (curve,) = trace_phases(problem)[:1]
    monkeypatch.setattr(times, "UNIQUENESS_MARGIN", 1.1)
    for own in (problem, problem.with_(viscous=0.0)):
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            assert np.isinf(time_borders(own, [make_border(curve)])).all()
