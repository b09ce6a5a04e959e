"""The simulation of motions that begin where more touches than the formation has."""

from __future__ import annotations

import tomllib

import numpy as np
import pytest

from crossing import make_way
from plane import make_formation
from planned import CosineMotion, choose_squeeze, join
from shipped import HEXAGON
from wholearm.geometry.tracing import trace_phases
from wholearm.problem.definition import Problem
from wholearm.problem.read import build_problem
from wholearm.simulation.simulate import simulate
from wholearm.simulation.start_modes import StartDeparture, Touching
from wholearm.simulation.sticking import find_rest


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


@pytest.mark.parametrize("until", ["e4-tip2", "e5-tip2"])
def test_two_freedoms_start_from_a_pointed_tip(until: str) -> None:
    """Finger 2 pushes v5 to the right, off its tip or away from it, while finger 1 swings."""
    problem = slide_to_the_tip(until)
    formation = make_formation(problem.scene, "v0-palm v1-palm v5-finger2")
    curve = trace_phases(problem)[0]
    z = curve.end - np.array([0.0, 0.0, 0.0, 0.3, 0.0])
    rest = find_rest(formation, z)
    assert rest.near.sum() == 2  # the end of the link, and an edge at its tip
    back, onwards = (sign * (curve.end - curve.start) for sign in (-1e-3, 1e-3))
    touching = Touching(formation, z, rest.near)
    (edge,) = touching.kinked
    assert formation.limits[edge].text.endswith("touches the tip of finger 2")
    # Along the line of the link the edge parts from the tip both ways.
    assert touching.opens(back) and touching.opens(onwards)
    departs = rest.wait(np.array([[-0.05], [-0.2]]), -1.0)
    right = until == "e5-tip2"
    assert (isinstance(departs, StartDeparture) and departs.heading[0] > 0) == right


def test_a_link_that_is_free_may_graze_what_starts_to_move() -> None:
    """Links of a plan may close by the little that its nodes do not see, but not press."""
    problem = make_way(solid=True)
    rest = find_rest(problem.phases[0].formation, problem.start)
    assert rest.near.sum() == 1  # v3 on finger 1
    tau = np.array([-0.287, -0.98])
    way = next(way for way in rest.sliding if way.moves(tau))
    touch = make_formation(problem.scene, "v3-finger1")
    A = touch.evaluate(problem.start[None], np.zeros((1, 5))).A[0, 0]
    lever = A[3] / problem.scene.fingers[0].inertia
    opens = A @ way.depart(-1.0, tau).heading * way.drive(tau)
    # The torque of finger 1 with which the gap has no acceleration.
    even = tau - np.array([opens / lever, 0.0])
    for closing, starts in (-1e-3, True), (2e-5, True), (1.0, False):
        load = even - np.array([closing / lever, 0.0])
        begun = rest.wait(load[:, None], -1.0)
        assert (isinstance(begun, StartDeparture) and begun.x == -1.0) == starts


def test_a_pointed_tip_on_an_edge_turns_onto_it_with_its_link() -> None:
    """v0 comes to the link where the edge lies flush on it, far from where the tip is at v0."""
    fingers = {
        "1": {"base": [0.565, 0.047], "length": 0.64, "torque_limit": 2.7},
        "2": {"base": [-0.218, -0.12], "length": 0.525, "torque_limit": 0.7},
    }
    same = {"radius": 0.0, "inertia": 1e-4, "viscous": 0.0, "dry": 0.0}
    corners = [[-0.252, 0.033], [0.098, -0.235], [0.154, 0.202]]
    phase = {"contacts": ["v0-palm", "v1-palm", "v2-finger1", "e2-tip2"], "until": "v0-finger2"}
    table = {
        "name": "flush",
        "epsilon": 0.007,
        "object": {"vertices": corners, "mass": 0.1},
        "fingers": {key: finger | same for key, finger in fingers.items()},
        "friction": {"palm": 0.009, "finger1": 0.08, "finger2": 0.04},
        "start": {"flush": 0, "x": 0.316},
        "phases": [phase],
    }
    problem = build_problem(table)
    curve = trace_phases(problem)[0]
    motion = CosineMotion(curve, 0.4, choose_squeeze(curve, 0.4, 0.2, 2.0))
    simulation = simulate(problem, join([motion.fit(20, 7)]))
    assert simulation.outcome.reached
    x, y, phi, _, theta = simulation.z[-1]
    c, s = np.cos(phi), np.sin(phi)
    vertex = [x, y] + np.array([[c, -s], [s, c]]) @ problem.scene.polygon.vertices[0]
    along = np.array([np.cos(theta), np.sin(theta)])
    arm = vertex - problem.scene.fingers[1].base
    assert along[0] * arm[1] - along[1] * arm[0] == pytest.approx(0.0, abs=1e-8)
    assert 0.525 - along @ arm > 0.3
