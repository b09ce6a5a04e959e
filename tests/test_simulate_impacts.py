"""The simulation of phases that end with an impact."""

from __future__ import annotations

import copy
import dataclasses
import tomllib
from functools import lru_cache
from typing import Any

import numpy as np
import pytest

from plane import stack_rows
from planned import SQUEEZES, CosineMotion, DepartingMotion, change, choose_squeeze, fit
from shipped import HEPTAGON, IMPACTS, plan_of, problem_of
from wholearm.common.arrays import Array
from wholearm.contacts.elemental import parse_contact
from wholearm.contacts.formation import Formation
from wholearm.geometry.tracing import trace_phases
from wholearm.mechanics.impact import compute_impact
from wholearm.problem.definition import Phase, Problem
from wholearm.problem.read import build_problem
from wholearm.results.torque import TorqueProfile
from wholearm.results.trajectory import Trajectory
from wholearm.simulation.events import EventKind, OutcomeKind, Simulation
from wholearm.simulation.simulate import simulate
from wholearm.verification.verify import verify


@pytest.fixture(scope="module")
def problem() -> Problem:
    return problem_of(IMPACTS)


@pytest.fixture(scope="module")
def planned() -> Trajectory:
    return plan_of(IMPACTS)


@pytest.fixture(scope="module")
def replayed(problem: Problem, planned: Trajectory) -> Simulation:
    return simulate(problem, planned.torque, times=planned.t)


@lru_cache(maxsize=4)
def bumping(speed: float, beyond: float = 0.0) -> tuple[Problem, TorqueProfile]:
    """The heptagon with low friction runs into its second formation at a speed along the curve.

    The torques go on for a distance `beyond` the impact [m], and then step.
    """
    table: dict[str, Any] = copy.deepcopy(tomllib.loads(HEPTAGON.read_text(encoding="utf-8")))
    table["phases"] = table["phases"][:2]
    table["phases"][0]["end"] = "impact"
    problem = build_problem(table)
    curve = trace_phases(problem)[0]
    # Beyond, a motion that slows; otherwise as slow a start as the speed allows.
    duration = (1.2 if beyond else 2.0) * curve.length / max(speed, 0.1)
    tries = (
        DepartingMotion(curve, duration, float(squeeze), place=curve.length + beyond, speed=speed)
        for squeeze in SQUEEZES
    )
    t = np.linspace(0.0, duration, 101)
    motion = next(motion for motion in tries if motion.evaluate(t).c_n.min() > 0.1)
    torque = motion.fit(60, 7)
    after = TorqueProfile(np.array([0.0, 0.01]), np.array([[[1.0], [-1.0]]]))
    return problem, TorqueProfile.chain([torque, after]) if beyond else torque


def joints(simulation: Simulation, index: int) -> tuple[int, int]:
    """Rows just before and after the end of a phase."""
    last = int(np.flatnonzero(simulation.phase == index)[-1])
    return last, last + 1


def test_replays_the_plan_through_its_impacts(
    problem: Problem, planned: Trajectory, replayed: Simulation
) -> None:
    assert replayed.outcome.kind is OutcomeKind.GOAL_REACHED
    impacts = replayed.find(EventKind.IMPACT)
    assert [event.phase for event in impacts] == [0, 1]
    np.testing.assert_allclose(
        [event.time for event in impacts], planned.phase_starts[1:3], rtol=0, atol=1e-8
    )
    for index, motion in enumerate(planned.motions):
        start, stop = motion.evaluate(np.array([0.0, motion.duration])).z_dot
        rows = np.flatnonzero(replayed.phase == index)
        np.testing.assert_allclose(replayed.z_dot[rows[0]], start, rtol=0, atol=1e-7)
        np.testing.assert_allclose(replayed.z_dot[rows[-1]], stop, rtol=0, atol=1e-4)


def test_momentum_is_that_of_the_impulses(problem: Problem, replayed: Simulation) -> None:
    """The jump lies in the span of the pushes, with friction against sliding."""
    for event in replayed.find(EventKind.IMPACT):
        last, first = joints(replayed, event.phase)
        formation = problem.phases[event.phase + 1].formation
        N, T = stack_rows(formation, replayed.z[first])
        slips = np.sign(T @ replayed.z_dot[first])
        pushes = N - (formation.friction * slips)[:, None] * T
        body, fingers = problem.scene.polygon, problem.scene.fingers
        assert body.inertia is not None
        mass = np.array([body.mass, body.mass, body.inertia, *(f.inertia for f in fingers)])
        jump = mass * (replayed.z_dot[first] - replayed.z_dot[last])
        p, residual, *_ = np.linalg.lstsq(pushes.T, jump, rcond=None)
        assert residual.max() < 1e-12 * (jump @ jump)
        assert p.min() == pytest.approx(event.value, rel=1e-6)
        assert p.min() > 0


def test_contacts_stay_closed_after_an_impact(problem: Problem, replayed: Simulation) -> None:
    for index in (1, 2):
        rows = replayed.phase == index
        formation = problem.phases[index].formation
        kinematics = formation.evaluate(replayed.z[rows], replayed.z_dot[rows])
        assert np.abs(kinematics.C).max() < 1e-15
        assert np.abs(np.einsum("nij,nj->ni", kinematics.A, replayed.z_dot[rows])).max() < 1e-13
    # The contact given up opens.
    start = replayed.t[replayed.phase == 1][0]
    gone = problem.phases[0].formation.evaluate(replayed.z, replayed.z_dot).C[:, 2]
    later = (replayed.t > start + 1e-4) & (replayed.phase == 1)
    assert (gone[later] > 0).all() and gone[replayed.phase == 1].min() > -1e-12


@pytest.mark.parametrize("speed", [0.05, 0.3])
def test_an_impulse_that_pulls_is_a_lost_contact(speed: float) -> None:
    problem, torque = bumping(speed)
    simulation = simulate(problem, torque)
    assert simulation.outcome.kind is OutcomeKind.CONTACT_LOST
    (impact,) = simulation.find(EventKind.IMPACT)
    assert impact.time == pytest.approx(torque.duration, abs=1e-6) and impact.phase == 0
    assert impact.contact == "v1-palm"
    assert impact.value == pytest.approx(-0.0413993711 * speed, rel=1e-5)
    assert simulation.outcome.text == (
        f"impulse on v1-palm would be {impact.value:.3g} N s in the impact "
        f"at t = {impact.time:.5g} s, phase 1"
    )
    report = verify(problem, torque)
    assert not report.ok and report.exit_status == 1
    assert report.failures == (simulation.outcome.text,)
    (phase,) = report.phases
    assert phase.impact is not None and phase.impact.contact == "v1-palm"
    assert phase.impact.impulse == pytest.approx(impact.value, rel=1e-6)


def test_next_to_no_speed_is_a_stop() -> None:
    """By rounding a planned stop arrives with some."""
    problem, torque = bumping(1e-5)
    simulation = simulate(problem, torque)
    assert not simulation.find(EventKind.IMPACT)
    assert simulation.phase[-1] == 1 and simulation.find(EventKind.ARRIVAL)
    last, first = joints(simulation, 0)
    assert simulation.z_dot[last].any() and not simulation.z_dot[first].any()


def test_a_step_of_the_torques_just_before_a_planned_stop_is_not_its_end() -> None:
    """Hardly any way is left there, but it takes longer than what rounding makes of a time."""
    problem = bumping(1e-5)[0]
    curve, scales = trace_phases(problem)[0], problem.scene.scales
    motion = CosineMotion(curve, 0.5, choose_squeeze(curve, 0.5, 0.2, 2.0))
    before = 0.5 * (1 - 2 / np.pi * np.sqrt(1e-5 * scales.length / curve.length))
    assert motion.law(np.array([before]))[0][0] > curve.length - 2e-5 * scales.length
    torque = fit(motion, np.sort([*motion.turns, before]), 20, 7)
    steps = torque.coefficients.copy()
    steps[torque.breaks[:-1] >= before, :, 0] += 1e-7 * scales.torque
    simulation = simulate(problem, TorqueProfile(torque.breaks, steps))
    arrival = simulation.find(EventKind.ARRIVAL)[0]
    assert arrival.time - before > 0.9 * (0.5 - before)


@pytest.mark.parametrize("scale", [1.002, 1.01])
def test_an_impact_that_comes_early(problem: Problem, planned: Trajectory, scale: float) -> None:
    """With torques that are a little off at the end of the first phase."""
    ends = planned.phase_starts[1]

    def edit(starts: Array, c: Array) -> Array:
        c[(starts > 0.8 * ends) & (starts < ends - 1e-12)] *= scale
        return c

    simulation = simulate(problem, change(planned.torque, edit))
    first = simulation.find(EventKind.IMPACT)[0]
    assert 2e-6 < ends - first.time < 5e-3
    last, after = joints(simulation, 0)
    before, formation = (p.formation for p in problem.phases[:2])
    impact = compute_impact(before, formation, simulation.z[after], simulation.z_dot[last])
    np.testing.assert_allclose(simulation.z_dot[after], impact.v, rtol=0, atol=1e-9)
    assert np.abs(simulation.energies.residual).max() < 1e-8 * simulation.energies.work.max()


@pytest.mark.parametrize(
    "names, kind, text",
    [
        ("v0-palm v5-finger2 v3-finger1", OutcomeKind.HELD, "friction would hold v3-finger1"),
        ("v0-palm v1-palm v3-finger1", OutcomeKind.LIMIT_REACHED, "v5-finger2 would not part, at"),
        ("v1-palm v2-finger1 v3-finger1", OutcomeKind.CONTACT_LOST, "impulse on v2-finger1 would"),
    ],
)
def test_other_formations_that_an_impact_cannot_reach(
    problem: Problem, planned: Trajectory, names: str, kind: OutcomeKind, text: str
) -> None:
    contacts = tuple(parse_contact(name, problem.scene) for name in names.split())
    following = Phase(1, Formation(problem.scene, contacts), problem.phases[1].until)
    passing = dataclasses.replace(problem, phases=(problem.phases[0], following))
    simulation = simulate(passing, planned.torque)
    assert simulation.outcome.kind is kind
    (event,) = simulation.find(EventKind.IMPACT)
    assert simulation.outcome.text.startswith(text)
    assert simulation.outcome.text.endswith(f" in the impact at t = {event.time:.5g} s, phase 1")


def test_verify_reports_the_impacts(problem: Problem, planned: Trajectory) -> None:
    report = verify(problem, planned)
    assert report.ok and report.failures == ()
    assert [phase.end for phase in report.phases] == [*4 * ["impact"], "rest"]
    rows = planned.meta["transitions"]
    for phase, row in zip(report.phases[:2], rows[:2], strict=True):
        assert phase.impact is not None and phase.impact.contact == row["least_impulse_contact"]
        assert phase.impact.impulse == pytest.approx(row["least_impulse"] * row["speed"], rel=1e-6)
        assert phase.arrival_rate is not None and phase.arrival_rate > 0.1
    assert [phase.impact for phase in report.phases[2:]] == [None] * 3
    for phase in report.phases:
        assert phase.end_deviation is not None
        # What is asked of every phase: 1e-5.
        assert max(phase.end_deviation.position, phase.end_deviation.angle) < 1e-7
    text = report.to_text()
    assert "least impulse [N s]  on" in text
    assert report.to_dict()["phases"][0]["impact"]["contact"] == "v1-palm"
    assert report.to_dict()["phases"][2]["impact"] is None
    assert report.energy.impact > 0.1 and report.energy.relative < 1e-9
