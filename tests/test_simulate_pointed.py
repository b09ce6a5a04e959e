"""The simulation of phases that end and begin where a vertex is at a pointed tip."""

from __future__ import annotations

import tomllib

import numpy as np
import pytest

from crossing import HEXAGON
from planned import CosineMotion, choose_squeeze, join
from wholearm.path import trace_phases
from wholearm.problem import Problem, build_problem
from wholearm.simulation.simulate import simulate


def slide_to_the_tip(until: str) -> Problem:
    """The hexagon slides until v5 is at the pointed tip of a short finger 2, and back."""
    table = tomllib.loads(HEXAGON.read_text(encoding="utf-8"))
    for key, length in ("1", 0.18), ("2", 0.057):
        table["fingers"][key] |= {"length": length, "radius": 0.0}
    table["start"]["x"] = -0.03
    contacts = ["v0-palm", "v1-palm", "v3-finger1", "v5-finger2"]
    ends: list[object] = [until, {"x": -0.025}]
    return build_problem(table | {"phases": [{"contacts": contacts, "until": u} for u in ends]})


@pytest.mark.parametrize("until", ["e4-tip2", "e5-tip2"])
def test_a_pointed_tip_gains_either_edge_at_a_vertex(until: str) -> None:
    """Both edges touch the tip there, and the motion back opens both."""
    problem = slide_to_the_tip(until)
    curves = trace_phases(problem)
    # Finger 2 holds v5 in reach on both sides of the place above its joint.
    corner = np.array([curves[0].end[0] - 0.05, 0.0433]) - problem.scene.fingers[1].base
    assert np.hypot(*corner) == pytest.approx(0.057, rel=1e-9)
    motions = [CosineMotion(c, 0.4, choose_squeeze(c, 0.4, 0.2, 2.0)) for c in curves]
    simulation = simulate(problem, join([motion.fit(20, 7) for motion in motions]), times=[0.2])
    assert simulation.outcome.reached
    halfway = motions[0].evaluate(np.array([0.2])).z[0]
    np.testing.assert_allclose(simulation.at(0.2)[:5], halfway, atol=1e-9)
    first = simulation.z[simulation.phase == 0][-1]
    np.testing.assert_allclose(first, curves[0].end, atol=1e-9)
    np.testing.assert_allclose(simulation.z[-1], curves[1].end, atol=1e-9)
