from __future__ import annotations

from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from held import balances
from plane import make_formation, make_scene, rotate
from shipped import BOX, FOLDER, HEPTAGON, IMPACTS, plan_of, problem_of
from timed import landing, plan_landing
from tipping import box, roll, tipped
from wholearm import InputError, solve, verify
from wholearm.benchmark.stress.slow_motion import list_others, rest_margin
from wholearm.common.arrays import Array
from wholearm.common.errors import AmbiguityError, InfeasibleError
from wholearm.contacts.formation import Formation
from wholearm.geometry.tracing import trace_phases
from wholearm.mechanics.statics import find_static_torques
from wholearm.mechanics.uniqueness import find_minors
from wholearm.planning.options import PlanOptions
from wholearm.planning.path_domain.path_plan import plan_curves
from wholearm.planning.time_domain.resting import find_block, list_ways, pushes_one_way
from wholearm.planning.time_domain.stage import in_own_units, scale_state
from wholearm.planning.time_domain.time_plan import plan_phases
from wholearm.problem.read import build_problem, read_problem
from wholearm.results.torque import TorqueProfile
from wholearm.scene.model import Friction, Scene
from wholearm.verification.force_uniqueness import find_wedged


def count_answers(K: Array, loads: Array) -> Array:
    """How many sets of contacts press, and leave the others apart: a = q + K c, for n loads q."""
    found = np.zeros(len(loads), dtype=int)
    for pressed in product((False, True), repeat=len(K)):
        own = np.array(pressed)
        c = np.zeros_like(loads)
        c[:, own] = -np.linalg.solve(K[np.ix_(own, own)], loads[:, own].T).T
        apart = loads + c @ K.T
        found += (c[:, own] > 0).all(axis=1) & (apart[:, ~own] > 0).all(axis=1)
    return found


def list_loads(K: Array, count: int) -> Array:
    """Loads that each set of contacts answers with forces and accelerations of many sizes."""
    rng, loads = np.random.default_rng(3), []
    for pressed in product((0.0, 1.0), repeat=len(K)):
        c, apart = 10.0 ** rng.uniform(-1, 1, (2, count, len(K)))
        loads.append(apart * np.diag(K) * (1 - np.array(pressed)) - (c * pressed) @ K.T)
    return np.concatenate(loads)


def box_at(mu: float, index: int, share: float) -> tuple[Formation, Any, Array]:
    """The box on a palm of friction mu in the middle of a phase, with its sliding directions."""
    problem = problem_of(BOX).with_(friction_palm=mu)
    curve = trace_phases(problem)[index]
    point = curve.evaluate(np.array([share * curve.length]))
    return curve.formation, point.kinematics, curve.segments[-1].Xi


@pytest.mark.parametrize("index", [0, 2])
def test_forces_are_unique_where_all_minors_are_positive(index: int) -> None:
    for mu in (0.1, 0.3, 0.5):
        formation, kinematics, Xi = box_at(mu, index, 0.9 if index == 0 else 0.4)
        A, A_t = kinematics.A[0], kinematics.A_t[0]
        weighted = A / formation.scene.mass_diagonal
        K, smooth = weighted @ (A - (formation.friction * Xi)[:, None] * A_t).T, weighted @ A.T
        ratio, names, _ = find_minors(formation, kinematics, Xi).find_least()
        answers = count_answers(K, list_loads(K, 100))
        assert (answers == 1).all() if ratio > 0 else (answers > 1).any()
        assert (ratio > 0) == (mu < 0.4)
        # The minor that is named is that of its contacts alone.
        own = [formation.names.index(name) for name in names.split(" with ")]
        expected = np.linalg.det(K[np.ix_(own, own)]) / np.linalg.det(smooth[np.ix_(own, own)])
        assert ratio == pytest.approx(expected, rel=1e-9)


def test_a_rod_on_the_palm_is_that_of_painleve() -> None:
    """Friction mu takes mu a h / (k^2 + a^2) from 1, a and h being the arms of both forces."""
    scene = make_scene([[-0.05, -1e-4], [0.05, -1e-4], [0.05, 1e-4], [-0.05, 1e-4]], base=0.6)
    for slope, mu in product((0.4, 1.0, 1.3), (0.5, 2.0)):
        other = Scene(scene.polygon, scene.fingers, Friction(mu, 0.1, 0.1))
        formation = make_formation(other, "v1-palm")
        arm, height = rotate(-slope, [0.05, -1e-4])
        z = np.array([[0.0, -height, -slope, 1.57, 1.57]])
        kinematics = formation.evaluate(z, np.zeros((1, 5)))
        loss = mu * arm * abs(height) / (scene.polygon.gyration_radius**2 + arm**2)
        found = [find_minors(formation, kinematics, np.array([Xi])).ratios[0] for Xi in (-1.0, 1.0)]
        # Sliding the other way friction helps, and the least is that of no contact, 1.
        assert sorted(found) == pytest.approx([1 - loss, 1.0], rel=1e-9)
        rolling = find_minors(roll(formation, "v1-palm"), kinematics, np.zeros(1))
        ratio, names, _ = rolling.find_least()
        assert ratio == pytest.approx(1 - loss, rel=1e-9) and names.startswith("v1-palm slipping")


def test_an_ambiguous_scene_is_refused_by_name() -> None:
    rough = problem_of(BOX).with_(friction_palm=0.5)
    with pytest.raises(AmbiguityError, match=r"phase 1: ambiguous: v0-palm with v0-finger2, uniq"):
        plan_curves(trace_phases(rough)[:1], rough.epsilon, PlanOptions(), (1,), explained=False)
    with pytest.raises(
        InputError, match=r"uniqueness_margin: 1 given; allowed are numbers below 1"
    ):
        solve(rough, uniqueness_margin=1.0)


def test_replays_tell_the_uniqueness_margin_of_each_phase() -> None:
    report = verify(box(), tipped())
    minors = [phase.uniqueness_margin for phase in report.phases]
    assert report.ok and all(minor is not None and 0.1 < minor.value < 1 for minor in minors)
    planned = [own["value"] for own in tipped().meta["uniqueness_margins"]]
    found = [minor.value for minor in minors if minor is not None]
    np.testing.assert_allclose(found, planned, atol=5e-3)
    strict = verify(box(), tipped(), uniqueness_margin=0.9)
    assert not strict.ok and strict.failures[0].startswith("ambiguous: ")


@pytest.mark.parametrize("path", [BOX, IMPACTS], ids=lambda path: path.stem)
def test_torques_that_friction_can_hold_are_those_of_the_linear_programme(path: Path) -> None:
    problem = problem_of(path)
    rng, scene = np.random.default_rng(5), problem.scene
    for curve in trace_phases(problem)[::2]:
        static = find_static_torques(curve.formation, curve.start)
        tau = rng.uniform(-1.0, 1.0, (12, 2)) * scene.torque_limit
        for own, beyond in zip(tau, static.measure(tau), strict=True):
            if abs(beyond) > 1e-4 * scene.scales.torque:
                assert balances(curve.formation, curve.start, own) == (beyond < 0)
                if beyond < 0:
                    assert not static.is_empty(np.abs(own))
        if abs(beyond := static.measure(np.zeros((1, 2)))[0]) > 1e-4 * scene.scales.torque:
            assert static.is_empty(np.zeros(2)) == (beyond > 0)


def test_a_wedged_start_lasts_until_nothing_balances_the_torques() -> None:
    """From torques that the linear programme balances straight to four times as much."""
    problem, plan = problem_of(BOX), plan_of(BOX)
    phase = problem.phases[-1]
    rows = np.flatnonzero(plan.phase == phase.index)
    first = last = plan.tau[rows[0]]
    duration = plan.t[rows[-1]] - plan.t[rows[0]]
    z = plan.z[rows[0]]
    while not balances(phase.formation, z, first):
        first, last = first / 2, first
    first = first / 2
    halves = (first + last) / 2, (last - first) / 2
    torque = TorqueProfile(plan.t[rows[[0, -1]]], np.stack(halves, axis=-1)[None])
    wedged = find_wedged(problem, phase, replace(plan, torque=torque), rows, 1e-9)
    assert wedged is not None and 0 < wedged < duration
    for share, held in ((0.0, True), (0.97, True), (1.03, False)):
        tau = first + share * wedged / duration * (last - first)
        assert balances(phase.formation, z, tau) == held


def test_plans_leave_rest_surely() -> None:
    """Where the largest margin of a phase is that of its start, too, friction could hold it."""
    problem, plan = problem_of(HEPTAGON), plan_of(HEPTAGON, "margin")
    assert plan.meta["wedged"] == [0.0] * 5
    for phase in problem.phases:
        row = int(np.flatnonzero(plan.phase == phase.index)[0])
        assert not balances(phase.formation, plan.z[row], plan.tau[row])


COARSE = PlanOptions(time_intervals=4)


@pytest.mark.parametrize("freedoms, count", [(1, 2), (2, 20)])
def test_every_way_to_set_things_in_motion_is_listed_once(freedoms: int, count: int) -> None:
    rng = np.random.default_rng(2)
    rates = rng.normal(size=(5, freedoms))
    ways = np.array(list_ways(rates))
    signs = np.sign(np.round(ways @ rates.T, 9))
    assert len(ways) == count == len(np.unique(signs, axis=0))
    # Any acceleration is of one of these ways.
    for way in rng.normal(size=(50, freedoms)):
        assert (np.sign(rates @ way) == signs).all(axis=1).sum() == 1


def test_what_limits_forbid_at_rest_is_refused_at_once() -> None:
    problem = landing()
    z = scale_state(problem.start, problem.scene.scales)
    formation = in_own_units(problem).phases[0].formation
    # Torques of 2 N m press a heptagon of 2 N with less than 100 N.
    blocked = find_block(formation, z, 50.0)
    assert blocked is not None and blocked.contact in formation.names and blocked.short > 1.0


def test_a_finger_that_would_have_to_pull_is_named() -> None:
    """All contacts of the flip would have to press with twenty times the weight."""
    problem = landing()
    start = trace_phases(problem)[-1].end
    feeble = problem.with_(epsilon=40.0)
    with pytest.raises(InfeasibleError, match="no motion begins in any contact mode: c_n of v"):
        plan_phases(feeble, feeble.phases[4:], start, COARSE, explained=False)
    assert plan_landing(time_intervals=6)


def test_one_contact_pushes_one_way_unless_the_centroid_passes_above_it() -> None:
    """About the vertex that touches it is weight alone that turns, whatever friction does."""
    table = dict(read_problem(str(FOLDER / "square.toml")).table)
    phase = {"contacts": ["v0-palm"], "until": {"phi_deg": 5.0}}
    problem = build_problem({**table, "phases": [phase]})
    vertex = problem.scene.polygon.vertices[0]
    upright = -np.pi / 2 - np.arctan2(vertex[1], vertex[0])
    for turns, one_way in (([0.1, 0.11], True), ([0.1, 0.0], False), ([0.1, -0.1], False)):
        z = np.repeat(problem.start[None], len(turns), axis=0)
        z[:, 2] = upright + np.array(turns)
        for friction in (0.1, 1.0):
            formation = problem.with_(friction=friction).phases[0].formation
            assert pushes_one_way(formation, z) == one_way
    with pytest.raises(InfeasibleError, match="v0-palm can only push the object one way"):
        plan_phases(problem, problem.phases, problem.start, COARSE, explained=False)
    assert not pushes_one_way(landing().phases[0].formation, landing().start[None])


@pytest.mark.parametrize("ends", [False, True])
@pytest.mark.parametrize("phase", [0, 3])
def test_planner_and_linear_programme_agree_on_what_rests(phase: int, ends: bool) -> None:
    """As epsilon grows, both find that nothing moves from the same value on."""
    problem = landing()
    curve = trace_phases(problem)[phase]
    z = curve.end if ends else curve.evaluate(np.zeros(1)).z[0]
    cell, scene = problem.phases[phase], problem.scene
    low, high = 0.0, 200.0
    own, scaled = in_own_units(problem), scale_state(z, problem.scene.scales)
    while high - low > 1e-3:
        middle = (low + high) / 2
        held = find_block(own.phases[phase].formation, scaled, middle, ends)
        low, high = (middle, high) if held is None else (low, middle)
    force = scene.scales.force
    assert rest_margin(scene, cell, force * (high + 0.01), z, ends) < 0.0
    assert rest_margin(scene, cell, force * (low - 0.01), z, ends) > -1e-9


def test_what_touches_and_is_none_of_the_contacts_may_only_open() -> None:
    problem = landing()
    phase, z = problem.phases[0], problem.start
    assert list_others(problem.scene, phase, z) == []
    fewer = Formation(problem.scene, phase.formation.contacts[1:])
    lifted = replace(phase, formation=fewer)
    (other,) = list_others(problem.scene, lifted, z)
    assert abs(other.gap[0]) < 1e-9
    assert rest_margin(problem.scene, lifted, 1e3, z) < 0.0
