from __future__ import annotations

import re
from dataclasses import replace
from itertools import product
from pathlib import Path

import numpy as np
import pytest

from wholearm.common.arrays import Array
from wholearm.common.errors import InputError
from wholearm.contacts.formation import Formation
from wholearm.geometry.curve import Curve, border
from wholearm.geometry.path_guess import load
from wholearm.geometry.tracing import trace_phases
from wholearm.mechanics.dynamics import build_forward, inverse
from wholearm.mechanics.metric import metric_weights
from wholearm.planning.options import PlanOptions
from wholearm.planning.path_domain.motion import PathMotion, directions_of
from wholearm.planning.path_domain.plan import plan_path
from wholearm.planning.robust.sensitivities import find_force_slopes
from wholearm.problem.definition import Problem
from wholearm.problem.uncertainty import NAMES, PARAMETERS
from wholearm.robustness.uncertainty import change_problem

FOLDER = Path(__file__).parents[1] / "problems"
EPSILON = 0.05
RADII = {"mass": 0.02, "friction_palm": 0.02, "friction_finger1": 0.02, "friction_finger2": 0.02}


@pytest.fixture(scope="module")
def problem() -> Problem:
    return load(str(FOLDER / "heptagon_four_contacts.toml"))


@pytest.fixture(scope="module")
def curve(problem: Problem) -> Curve:
    return trace_phases(problem)[0]


@pytest.fixture(scope="module")
def rolling() -> tuple[Problem, Curve]:
    problem = load(str(FOLDER / "box_rolling.toml"))
    curves = (own for own in trace_phases(problem) if own.formation.rolling)
    return problem, next(curves)


def replace_nearby(formation: Formation, z: Array, tangent: Array) -> tuple[Array, Array]:
    """The nearest configuration on a changed formation's curve, and the tangent there."""
    metric = metric_weights(formation.scene)
    found, slip = z.copy(), formation.evaluate_slip(z[None])[0]
    for _ in range(8):
        own = formation.evaluate(found[None], z[None])
        off = np.concatenate([own.C[0], formation.evaluate_slip(found[None])[0] - slip])
        right = np.append(-off, -(metric * tangent) @ (found - z))
        found = found + np.linalg.solve(border(own.P, tangent * metric)[0], right)
    P = formation.evaluate(found[None], z[None]).P
    there = np.linalg.solve(border(P, tangent * metric)[0], np.eye(5)[4])
    size = np.sqrt((tangent**2 @ metric) / (there**2 @ metric))
    return found, there * size


def solve_forces(
    problem: Problem, curve: Curve, s: float, name: str, change: float, motion: tuple[float, ...]
) -> Array:
    """Contact forces in the scene whose number is off, at the same s, s' and torques."""
    point, motion_at = curve.evaluate(np.array([s])), [np.array([own]) for own in motion]
    segment = np.searchsorted([own.stop for own in curve.segments][:-1], [s])
    directions = directions_of(curve, segment)
    forces = inverse(curve.formation, *point[:3], directions, point.kinematics)
    tau, z, tangent = forces.tau(*motion_at)[0], point.z[0], point.z_s[0]
    formation = curve.formation
    if name.startswith("gain"):
        tau[int(name[-1]) - 1] *= 1 + change
    elif name == "start_x":
        size = np.sqrt(tangent[:3] ** 2 @ metric_weights(formation.scene)[:3])
        moved = curve.evaluate(np.array([s + change / size]))
        z, tangent = moved.z[0], moved.z_s[0]
    else:
        formation = replace(formation, scene=change_problem(problem, {name: change}).scene)
        z, tangent = replace_nearby(formation, z, tangent)
    v = tangent * np.sqrt(motion[1])
    found = build_forward(formation)(z, v, tau, directions.Xi[0], directions.sigma[0])
    return np.asarray(found[1].full()[:, 0])


@pytest.mark.parametrize("which", ["sliding", "rolling"])
def test_slopes_are_those_of_the_whole_solve(
    which: str, problem: Problem, curve: Curve, rolling: tuple[Problem, Curve]
) -> None:
    own, way = (problem, curve) if which == "sliding" else rolling
    names = [name for name in NAMES if name != "delay"]
    if which == "rolling":
        # Slip coordinates count from the joint, which is another question.
        names = [name for name in names if not name.startswith("base")]
    s, motion = 0.4 * way.length, (2.0, 0.1, 3.0)
    point = way.evaluate(np.array([s]))
    segment = np.searchsorted([part.stop for part in way.segments][:-1], [s])
    directions = directions_of(way, segment)
    forces = inverse(way.formation, *point[:3], directions, point.kinematics)
    slopes = find_force_slopes(way.formation, point, directions, forces, names)[0]
    columns = np.array([1.0, *motion, np.sqrt(motion[1])])
    units = {parameter.name: parameter.unit for parameter in PARAMETERS}
    for k, name in enumerate(names):
        step = 1e-6 if units[name] else 1e-5
        ends = [solve_forces(own, way, s, name, sign * step, motion) for sign in (-1, 1)]
        expected = (ends[1] - ends[0]) / (2 * step)
        np.testing.assert_allclose(slopes[:, k] @ columns, expected, rtol=1e-5, atol=1e-5)


def find_least_in_corners(problem: Problem, motion: PathMotion) -> Array:
    """The least c_n of each contact over all corners of `RADII`, at instants of a motion."""
    t = np.linspace(0.0, motion.duration, 22)[1:-1]
    samples, (_, segment, _) = motion.evaluate(t), motion.locate(t)
    own = directions_of(motion.curve, segment)
    least = np.full(samples.c_n.shape, np.inf)
    for signs in product((-1, 1), repeat=len(RADII)):
        changes = {name: sign * RADII[name] for name, sign in zip(RADII, signs, strict=True)}
        scene = change_problem(problem, changes).scene
        forward = build_forward(replace(motion.curve.formation, scene=scene))
        given = samples.z.T, samples.z_dot.T, samples.tau.T, own.Xi.T, own.sigma.T
        c = forward.map(len(t))(*given)[1].full().T
        least = np.minimum(least, c[:, : len(samples.c_n[0])])
    return least


def test_a_robust_plan_keeps_epsilon_in_every_corner(problem: Problem, curve: Curve) -> None:
    options = PlanOptions(ranges=RADII, accuracy=1e-3)
    robust = plan_path(curve, EPSILON, options, 1)
    plain = plan_path(curve, EPSILON, replace(options, ranges={}), 1)
    # What two percent change to second order is a hundredth of what they change to first.
    swing = EPSILON - find_least_in_corners(problem, plain.motion).min()
    assert swing > 0.01
    assert find_least_in_corners(problem, robust.motion).min() > EPSILON - 0.03 * swing
    # A plan that touches its limits somewhere gives away nothing.
    assert find_least_in_corners(problem, robust.motion).min() < EPSILON + 0.03 * swing
    assert plain.value < robust.value < 1.1 * plain.value


def test_no_ranges_cost_nothing(curve: Curve) -> None:
    tiny = PlanOptions(ranges=dict.fromkeys(RADII, 1e-9), accuracy=1e-3)
    plain = plan_path(curve, EPSILON, replace(tiny, ranges={}), 1)
    assert plan_path(curve, EPSILON, tiny, 1).value == pytest.approx(plain.value, rel=2e-3)


@pytest.mark.parametrize(
    "given, text",
    [
        ({"robust": -1.0}, "robust: -1.0 is not a number >= 0"),
        ({"robust": 10.0}, "robust: 10 makes the range of friction_palm 1; a relative range is"),
        ({"robust": 1.0, "certify": True}, "certify: does not go with robust"),
        ({"largest": True}, "largest: is for robust plans only"),
    ],
)
def test_options_that_make_no_sense_are_refused(given: dict[str, float], text: str) -> None:
    with pytest.raises(InputError, match=re.escape(text)):
        PlanOptions(**given).scale_ranges({})  # type: ignore[arg-type]
