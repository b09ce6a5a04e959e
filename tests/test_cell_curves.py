from __future__ import annotations

from functools import cache

import numpy as np
import pytest

from shipped import HEPTAGON
from wholearm.benchmark.stress import cell_curves
from wholearm.benchmark.stress.cell_curves import best_end, find_best, list_ends
from wholearm.benchmark.stress.slow_motion import slow_margin
from wholearm.common.arrays import Array
from wholearm.geometry.tracing import trace_phases
from wholearm.problem.definition import Problem
from wholearm.problem.read import build_problem, read_problem


@cache
def tipping() -> Problem:
    """The heptagon tips over its left vertex; to do so, it has to slide."""
    table = dict(read_problem(str(HEPTAGON)).table)
    contacts = ["v0-palm", "v2-finger1", "v5-finger2"]
    return build_problem({**table, "phases": [{"contacts": contacts, "until": {"phi_deg": 9.5}}]})


def _ends() -> Array:
    problem = tipping()
    start = problem.start
    stop = float(start[0]), float(start[2]) + 0.2
    return list_ends(problem.scene, problem.phases[0], start, stop)


def test_ends_are_where_the_phase_ends() -> None:
    (phase,), ends = tipping().phases, _ends()
    assert len(ends) > 5 and np.ptp(ends[:, 0]) > 0.01
    assert np.degrees(ends[:, 2]) == pytest.approx(9.5, abs=1e-6)
    assert np.abs(phase.formation.evaluate(ends, ends).C).max() < 1e-9


def test_ends_are_found_though_a_joint_turns_far_on_the_way() -> None:
    """Where the vertex in the corner leaves it, the finger turns by 76 degrees."""
    table = dict(read_problem(str(HEPTAGON.with_name("triangle.toml"))).table)
    flush, corner = ["v0-palm", "v1-palm"], ["v1-finger1", "v0-finger2"]
    phases = [
        {"contacts": [*flush, "v1-finger1", "v2-finger2"], "until": "v0-finger2"},
        {"contacts": [*flush, *corner], "until": {"x": 0.0373}},
        {"contacts": ["v1-palm", *corner], "until": "v2-finger1"},
    ]
    problem = build_problem({**table, "phases": phases})
    start, stop = trace_phases(problem)[1].end, (0.02953, -0.22767)
    ends = list_ends(problem.scene, problem.phases[2], start, stop)
    assert len(ends) > 5 and np.abs(ends[0, [0, 2]] - stop).max() < 1e-3
    assert ends[0, 3] - start[3] > 1.3


def test_the_best_curve_is_one_that_a_slow_motion_can_take() -> None:
    problem = tipping()
    (phase,), scene = problem.phases, problem.scene
    best = find_best(scene, phase, problem.epsilon, problem.start, _ends())
    assert best.margin > 1e-3 and best.curves > 0
    assert np.abs(phase.formation.evaluate(best.z, best.z).C).max() < 1e-9
    assert np.degrees(best.z[-1, 2]) == pytest.approx(9.5, abs=1e-6)
    assert slow_margin(scene, phase, problem.epsilon, best.z, np.gradient(best.z, axis=0))[0] > 0


def test_no_curve_takes_a_hand_that_is_too_weak(monkeypatch: pytest.MonkeyPatch) -> None:
    for name, few in (("DRAWN", 40), ("TRIED", 5), ("BENT", (2, 3))):
        monkeypatch.setattr(cell_curves, name, few)
    weak = tipping().with_({f"fingers.{k}.torque_limit": 0.01 for k in (1, 2)})
    (phase,), ends = weak.phases, _ends()[:1]
    best = find_best(weak.scene, phase, weak.epsilon, weak.start, ends)
    assert max(best.margin, best.loose) < -0.1 and best.curves > 5
    assert best_end(weak.scene, phase, 20.0, ends) < 0.0
