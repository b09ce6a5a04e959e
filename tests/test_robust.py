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
from wholearm.geometry.curve import Curve, directions_of
from wholearm.geometry.path_guess import load
from wholearm.geometry.tracing import trace_phases
from wholearm.mechanics.dynamics import (
    Directions,
    build_forward,
    inverse,
    metric_weights,
    stack_motion,
)
from wholearm.mechanics.statics import find_static_torques
from wholearm.planning.options import PlanOptions
from wholearm.planning.path_domain.path_plan import plan_path
from wholearm.planning.phase_plan import PhasePlan
from wholearm.planning.range_cost import find_widest
from wholearm.planning.robust.robust_rows import Guide, list_holds, measure_holds
from wholearm.planning.time_domain.time_plan import plan_phases
from wholearm.problem.definition import Problem
from wholearm.problem.uncertainty import NAMES, PARAMETERS
from wholearm.results.trajectory import Motion, Samples
from wholearm.robustness.error_model import change_problem
from wholearm.sensitivity.slopes import find_force_slopes, find_slopes_at

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


def replace_nearby(formation: Formation, z: Array, v: Array) -> tuple[Array, Array]:
    """The nearest configuration of a changed formation, and the nearest velocity there."""
    root = np.sqrt(metric_weights(formation.scene))
    found, slip = z.copy(), formation.evaluate_slip(z[None])[0]
    for _ in range(8):
        own = formation.evaluate(found[None], z[None])
        off = np.concatenate([own.C[0], formation.evaluate_slip(found[None])[0] - slip])
        P = own.P[0]
        found = z + np.linalg.pinv(P / root) @ (P @ (found - z) - off) / root
    P = formation.evaluate(found[None], z[None]).P[0]
    return found, v - np.linalg.pinv(P / root) @ (P @ v) / root


State = tuple[Array, Array, Array, Directions]
"""Configuration, velocity, torques, and directions of friction."""


def solve_forces(
    problem: Problem, formation: Formation, state: State, name: str, change: float
) -> Array:
    """Contact forces in the scene whose number is off, at the same place, velocity and torques."""
    z, v, tau, directions = state
    tau = tau.copy()
    if name.startswith("gain"):
        tau[int(name[-1]) - 1] *= 1 + change
    else:
        formation = replace(formation, scene=change_problem(problem, {name: change}).scene)
        z, v = replace_nearby(formation, z, v)
    found = build_forward(formation)(z, v, tau, directions.Xi, directions.sigma)
    return np.asarray(found[1].full()[:, 0])


def require_slopes(
    problem: Problem, formation: Formation, state: State, names: list[str], slopes: Array
) -> None:
    """Require slopes, shape (n_c + R, len(names)), to be those of differences."""
    units = {parameter.name: parameter.unit for parameter in PARAMETERS}
    for k, name in enumerate(names):
        step = 1e-6 if units[name] else 1e-5
        given = problem, formation, state, name
        ends = [solve_forces(*given, sign * step) for sign in (-1, 1)]
        expected = (ends[1] - ends[0]) / (2 * step)
        np.testing.assert_allclose(slopes[:, k], expected, rtol=1e-5, atol=1e-5, err_msg=name)


OFF = [name for name in NAMES if name not in ("delay", "start_x")]


@pytest.mark.parametrize("which", ["sliding", "rolling"])
def test_slopes_along_curves_are_those_of_the_whole_solve(
    which: str, problem: Problem, curve: Curve, rolling: tuple[Problem, Curve]
) -> None:
    own, way = (problem, curve) if which == "sliding" else rolling
    # Slip coordinates count from the joint, which is another question.
    names = [name for name in OFF if which == "sliding" or not name.startswith("base")]
    s, (a, b, squeeze) = 0.4 * way.length, np.array([[2.0], [0.1], [3.0]])
    point = way.evaluate(np.array([s]))
    segment = np.searchsorted([part.stop for part in way.segments][:-1], [s])
    directions = directions_of(way, segment)
    forces = inverse(way.formation, *point[:3], directions, point.kinematics)
    table = find_force_slopes(way.formation, point, directions, forces, [*names, "start_x"])[0]
    slopes = table @ stack_motion(a, b, squeeze)[0]
    tau, here = forces.tau(a, b, squeeze)[0], Directions(directions.Xi[0], directions.sigma[0])
    state = point.z[0], point.z_s[0] * np.sqrt(b), tau, here
    require_slopes(own, way.formation, state, names, slopes)
    size = np.sqrt(point.z_s[0, :3] ** 2 @ metric_weights(own.scene)[:3])
    step, ends = 1e-6, []
    for sign in (-1, 1):
        moved = way.evaluate(np.array([s + sign * step / size]))
        other = moved.z[0], moved.z_s[0] * np.sqrt(b), tau, here
        ends.append(solve_forces(own, way.formation, other, "mass", 0.0))
    np.testing.assert_allclose(slopes[:, -1], (ends[1] - ends[0]) / (2 * step), rtol=1e-5)


def test_slopes_with_two_freedoms_are_those_of_the_whole_solve(problem: Problem) -> None:
    contacts = [problem.phases[0].formation.contacts[k] for k in (1, 2, 3)]
    formation, z = Formation(problem.scene, tuple(contacts)), problem.start
    kinematics = formation.evaluate(z[None], z[None])
    v = np.linalg.svd(kinematics.P[0])[2][3:].T @ [0.2, -0.5]
    here = Directions(np.sign(kinematics.A_t[0] @ v), np.sign(v[3:]))
    tau = np.array([0.7, -0.9])
    found = build_forward(formation)(z, v, tau, here.Xi, here.sigma)
    z_ddot, c = (part.full()[:, 0] for part in found[:2])
    samples = Samples(*(part[None] for part in (z, v, z_ddot, tau, c, -0.1 * here.Xi * c)))
    rows = Directions(here.Xi[None], here.sigma[None])
    slopes = find_slopes_at(formation, samples, rows, OFF)[0]
    require_slopes(problem, formation, (z, v, tau, here), OFF, slopes)
    along = find_slopes_at(formation, samples, rows, ["start_x"])[0, :, 0]
    assert np.isfinite(along).all() and np.abs(along).max() > 1.0


def find_least_in_corners(problem: Problem, formation: Formation, motion: Motion) -> Array:
    """The least c_n of each contact over all corners of `RADII`, at instants of a motion."""
    samples = motion.evaluate(np.linspace(0.0, motion.duration, 22)[1:-1])
    least = np.full(samples.c_n.shape, np.inf)
    Xi, sigma = -np.sign(samples.c_t), np.sign(samples.z_dot[:, 3:])
    for signs in product((-1, 1), repeat=len(RADII)):
        changes = {name: sign * RADII[name] for name, sign in zip(RADII, signs, strict=True)}
        scene = change_problem(problem, changes).scene
        forward = build_forward(replace(formation, scene=scene)).map(len(Xi))
        given = samples.z.T, samples.z_dot.T, samples.tau.T, Xi.T, sigma.T
        least = np.minimum(least, forward(*given)[1].full().T)
    return least


@pytest.mark.parametrize("transcription", ["auto", "time"])
def test_a_robust_plan_keeps_epsilon_in_every_corner(
    transcription: str, problem: Problem, curve: Curve
) -> None:
    options = PlanOptions(ranges=RADII, accuracy=1e-3)
    own: tuple[PhasePlan[Motion], ...]
    if transcription == "auto":
        own = tuple(plan_path(curve, EPSILON, replace(options, ranges=r), 1) for r in (RADII, {}))
    else:
        timed = replace(options, transcription="time", mode_search=False, time_intervals=4)
        given = problem, problem.phases[:1], problem.start
        own = tuple(plan_phases(*given, replace(timed, ranges=r))[0] for r in (RADII, {}))
    formation = problem.phases[0].formation
    robust, plain = (find_least_in_corners(problem, formation, plan.motion).min() for plan in own)
    # What two percent change to second order is a hundredth of what they change to first.
    swing = EPSILON - plain
    assert swing > 0.01
    assert robust > EPSILON - 0.03 * swing
    # A plan that touches its limits somewhere gives away little.
    assert robust < EPSILON + 0.5 * swing
    assert own[1].value < own[0].value < 1.1 * own[1].value


@pytest.mark.parametrize(
    "given, text",
    [
        ({"robust": -1.0}, "robust: -1.0 given; allowed are 0 to 1000"),
        ({"robust": 10.0}, "robust: 10 makes the range of friction_palm 1; a relative range is"),
        ({"robust": 1.0, "certify": True}, "certify: does not go with robust"),
        ({"largest": True}, "largest: is for robust plans only"),
    ],
)
def test_options_that_make_no_sense_are_refused(given: dict[str, float], text: str) -> None:
    with pytest.raises(InputError, match=re.escape(text)):
        PlanOptions(**given).scale_ranges({})  # type: ignore[arg-type]


def test_what_friction_may_hold_grows_with_the_ranges(problem: Problem) -> None:
    formation, tau = problem.phases[0].formation, np.array([0.05, -0.02])
    ranges = {"friction_palm": 0.3, "friction_finger1": 0.3, "mass": 0.1, "gain2": 0.05}
    exact = find_static_torques(formation, problem.start).measure(tau[None])[0]
    assert measure_holds(list_holds(formation, problem.start, {}), tau) == pytest.approx(exact)
    rng, within = np.random.default_rng(3), list_holds(formation, problem.start, ranges)
    for tau in rng.uniform(-1.0, 1.0, (20, 2)):
        least = measure_holds(within, tau)
        for _ in range(5):
            own = {name: width * rng.uniform(-1, 1) for name, width in ranges.items()}
            scene = change_problem(problem, own).scene
            static = find_static_torques(replace(formation, scene=scene), problem.start)
            assert static.measure((tau * [1.0, 1 + own["gain2"]])[None])[0] >= least - 1e-9


def test_the_widest_ranges_are_the_same_by_whatever_they_are_measured(curve: Curve) -> None:
    plain = plan_path(curve, EPSILON, PlanOptions(accuracy=1e-2), 1).motion
    guides, found = [Guide(plain.grid.s, *plain.profile)], []
    for unit in (12.0, 15.0):

        def scale(factor: float, unit: float = unit) -> PlanOptions:
            ranges = {name: unit * factor * radius for name, radius in RADII.items()}
            return PlanOptions(ranges=ranges, accuracy=1e-2)

        found.append(unit * find_widest([curve], EPSILON, scale, [1], guides, 45.0 / unit))
    assert 2.0 < found[0] < 45.0
    assert found[1] == pytest.approx(found[0], rel=0.03)
