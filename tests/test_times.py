from __future__ import annotations

import math

import numpy as np
import pytest

from shipped import HEPTAGON, problem_of
from wholearm.geometry.curve import Curve
from wholearm.geometry.tracing import trace_curve, trace_phases
from wholearm.mapping.formation_map import Border
from wholearm.planning.lower_bound.lower_bound import look_along
from wholearm.planning.lower_bound.sweep import NoMotionError
from wholearm.problem.definition import Until
from wholearm.search.links import cut_curve
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
    times = time_borders(problem, [make_border(curve) for curve in curves])
    # Twelve points and twenty-four intervals leave an error of a few in a hundred.
    assert times == pytest.approx(np.array(expected), rel=0.04)
    assert np.isfinite(times[:, 0]).all()
