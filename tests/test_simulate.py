"""The simulator: replays, its order, impacts, and the same in other units and numberings."""

from __future__ import annotations

import dataclasses
import math
import subprocess
import sys
from collections.abc import Callable
from functools import cache, lru_cache

import casadi as ca
import numpy as np
import pytest

from independent import balances, integrate_phase
from planned import (
    SQUEEZES,
    CosineMotion,
    DepartingMotion,
    brake_less,
    change,
    choose_squeeze,
    fit,
    forward,
    plan,
    plan_landing,
)
from pushing import pushed, rocking
from retelling import RETELLINGS, Retelling
from rows import each
from scenes import constant, hexagon, measure_fingers, slid
from shipped import HEPTAGON, IMPACTS, part_of, plan_of, problem_of, verified
from wholearm import Formation, Phase, Problem, TorqueProfile, Until, simulate, verify
from wholearm.common.arrays import Array, find_root
from wholearm.common.errors import InputError, JammingError, SimulationError
from wholearm.contacts.elemental import parse_contact
from wholearm.geometry.tracing import trace_phases
from wholearm.mechanics.dynamics import Directions
from wholearm.mechanics.impact import compute_impact
from wholearm.simulation import system
from wholearm.simulation.events import Event, EventKind, OutcomeKind, Simulation
from wholearm.simulation.modes import Collapse, Rest
from wholearm.simulation.prescribed import Replay


def pick(index: int) -> tuple[Problem, CosineMotion]:
    """One phase of the heptagon as a problem of its own, and its motion."""
    problem, trajectory = plan()
    motion = trajectory.motions[index]
    assert isinstance(motion, CosineMotion)
    return part_of(problem, index, index + 1), motion


def test_imports_nothing_of_the_planner() -> None:
    code = "import sys, wholearm.simulation.simulate; print(*sys.modules)"
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    loaded = set(run.stdout.split())
    assert not [name for name in loaded if name.startswith("wholearm.planning")]
    assert not [name for name in loaded if name.startswith("wholearm.geometry")]
    assert not loaded & {"scipy", "matplotlib"}


def test_follows_the_plan() -> None:
    problem, trajectory = plan()
    simulation = simulate(problem, trajectory.torque, times=trajectory.t)
    assert simulation.outcome.kind is OutcomeKind.GOAL_REACHED
    for index, motion in enumerate(trajectory.motions):
        rows = simulation.phase == index
        end = motion.evaluate(np.array([motion.duration])).z[0]
        # Both are solutions to about 1e-12; the interpolated torques add 1e-11.
        assert np.allclose(simulation.z[rows][-1], end, atol=1e-9, rtol=0)
        names = [simulation.contacts.index(name) for name in motion.contacts]
        start = trajectory.phase_starts[index]
        here = np.flatnonzero(rows & ~np.isnan(simulation.c_n).all(axis=1))
        # Leave out the instants at which forces jump.
        near = np.abs(simulation.t[here, None] - start - motion.turns).min(axis=1) < 1e-6  # type: ignore[attr-defined]
        here = here[~near]
        samples = motion.evaluate(simulation.t[here] - start)
        assert np.allclose(simulation.c_n[np.ix_(here, names)], samples.c_n, atol=1e-6, rtol=0)
        assert np.allclose(simulation.c_t[np.ix_(here, names)], samples.c_t, atol=1e-6, rtol=0)
        assert np.allclose(simulation.z_ddot[here], samples.z_ddot, atol=1e-6, rtol=0)
    energies = simulation.energies
    assert np.abs(energies.residual).max() < 1e-9 * energies.work[-1]
    arrivals = simulation.find(EventKind.ARRIVAL)
    assert [event.phase for event in arrivals] == [0, 1, 2, 3, 4]
    assert all(abs(event.value) < 1e-4 for event in arrivals)
    boundaries = trajectory.phase_starts[1:]
    assert np.allclose([event.time for event in arrivals], boundaries, atol=1e-5, rtol=0)


@pytest.mark.parametrize("index", [0, 2, 4])
def test_finds_the_reversals_of_the_curve(index: int) -> None:
    problem, motion = pick(index)
    simulation = simulate(problem, fit(motion, 40, 7))
    reversals = simulation.find(EventKind.REVERSAL)
    assert [e.time for e in reversals] == pytest.approx(list(motion.turns[1:-1]), abs=1e-9)


def test_a_reversal_next_to_a_stop_turns_all_that_slides() -> None:
    """A speed of rounding against the plan: where it ends, forces are those from rest."""
    # A contact that hardly slides there has no event of its own.
    problem, motion = pick(0)
    turn, scales = float(motion.turns[1]), problem.scene.scales
    sample = motion.evaluate(np.array([turn + 1e-7]))
    tangent = sample.z_dot[0] / np.linalg.norm(sample.z_dot[0])
    torque = constant(sample.tau[0], 1.0)
    replay = Replay(problem, torque, 1e-9, np.array([math.inf]), minima=False)
    replay.enter(problem.phases[0], None)
    replay.y[:10] = [*sample.z[0], *(-1e-8 * scales.speed * tangent)]
    assert replay.go_on() is None
    after = motion.curve.segments[1]
    assert replay.signs == pytest.approx([*after.Xi, *after.sigma])


@pytest.mark.parametrize("late", [-4e-7, 4e-7])
def test_a_torque_step_belongs_to_its_reversal(late: float) -> None:
    problem, motion = pick(0)
    exact = fit(motion, 40, 7)
    turn = motion.turns[1]
    moved = np.where(np.abs(exact.breaks - turn) < 1e-12, turn + late, exact.breaks)
    torque = TorqueProfile(moved, exact.coefficients)
    wanted = turn + late / 2
    simulation = simulate(problem, torque, times=[wanted])
    assert simulation.outcome.reached
    (reversal,) = simulation.find(EventKind.REVERSAL)
    (step,) = simulation.find(EventKind.TORQUE_STEP)
    assert step.time == turn + late
    # The wrong torques act for 0.4 us at about 1 m/s^2.
    assert reversal.time == pytest.approx(turn, abs=1e-5)
    t = simulation.t[~np.isnan(simulation.c_n).all(axis=1)]
    between = sorted([reversal.time, step.time])
    assert not ((t > between[0]) & (t < between[1])).any()
    assert np.isfinite(simulation.at(wanted)).all()


def test_error_follows_tolerance() -> None:
    problem, motion = pick(1)
    torque = fit(motion, 1, 24)
    times = np.array([0.15, 0.3, 0.37])
    reference = simulate(problem, torque, tolerance=1e-13, times=times)
    errors = []
    for tolerance in (1e-4, 1e-6, 1e-8, 1e-10):
        simulation = simulate(problem, torque, tolerance=tolerance, times=times)
        error = max(np.abs(simulation.at(t) - reference.at(t)).max() for t in times)
        # The local error is controlled; a few steps add up.
        assert error < 20 * tolerance
        errors.append(error)
    assert errors == sorted(errors, reverse=True)
    assert errors[-1] < 1e-10


def test_sticks_without_torques() -> None:
    problem, _ = plan()
    simulation = simulate(problem, constant((0.0, 0.0)), times=[0.1])
    assert simulation.outcome.kind is OutcomeKind.GOAL_MISSED
    assert "short of v3-finger1" in simulation.outcome.text
    assert [e.kind for e in simulation.events] == [EventKind.STICK, EventKind.END]
    assert np.isnan(simulation.c_n).all()
    assert np.abs(simulation.z - problem.start).max() < 1e-15
    assert simulation.missed_by == pytest.approx(simulation.events[-1].value)


def test_starts_when_a_ramp_overcomes_friction() -> None:
    problem, motion = pick(1)
    tau = motion.evaluate(np.array([0.0])).tau[0]
    rise = np.stack([tau / 2, tau / 2], axis=1)[None]
    simulation = simulate(problem, TorqueProfile(np.array([0.0, 0.4]), rise))
    start = simulation.find(EventKind.START)[0].time
    segment = motion.curve.segments[0]

    def acceleration(t: float) -> float:
        directions = Directions(segment.Xi, segment.sigma)
        z_ddot, _ = forward(
            problem.phases[0].formation, problem.start, np.zeros(5), tau * t / 0.4, directions
        )
        return float(z_ddot @ motion.evaluate(np.array([0.0])).z_ddot[0])

    assert 0.05 < start < 0.4
    assert acceleration(start - 1e-6) < 0 < acceleration(start + 1e-6)


@pytest.mark.parametrize("bend", [0.0, 0.004])
def test_balance_is_lost_where_no_forces_are_left(bend: float) -> None:
    problem, _ = plan()
    formation, z = problem.phases[0].formation, problem.start
    opening = np.array([-1.0, 1.0])
    coefficients = np.outer(opening, [0.01, 0.01 + bend, 0.0, -bend])
    lost = Rest(formation, z).wait(coefficients, -1.0)
    assert isinstance(lost, Collapse) and -0.1 < lost.x < 0.1
    for x, holds in ((lost.x - 1e-4, True), (lost.x + 1e-4, False)):
        tau = coefficients @ x ** np.arange(4)
        assert balances(formation, z, tau) == holds


def test_torque_steps_are_recorded_twice() -> None:
    problem, motion = pick(1)
    torque = fit(motion, 40, 7)

    def kick(starts: Array, c: Array) -> Array:
        c[starts >= 0.2 - 1e-12, :, 0] += [0.01, -0.01]
        return c

    stepped = change(torque, kick)
    simulation = simulate(problem, stepped)
    (event,) = simulation.find(EventKind.TORQUE_STEP)
    rows = np.flatnonzero(simulation.t == event.time)
    assert len(rows) == 2
    before, after = rows
    assert simulation.tau[after] - simulation.tau[before] == pytest.approx([0.01, -0.01])
    assert np.array_equal(simulation.z[before], simulation.z[after])
    assert np.array_equal(simulation.z_dot[before], simulation.z_dot[after])
    assert np.nanmax(np.abs(simulation.c_n[after] - simulation.c_n[before])) > 1e-3


def test_contact_is_lost_when_the_squeeze_fades() -> None:
    problem, motion = pick(1)
    fading = dataclasses.replace(motion, fade=1.0)
    torque = fit(fading, 40, 7)
    simulation = simulate(problem, torque, tolerance=1e-11)
    assert simulation.outcome.kind is OutcomeKind.CONTACT_LOST
    event = simulation.events[-1]
    assert event.kind is EventKind.CONTACT_LOST
    lost = problem.phases[0].formation.names.index(event.contact)
    # Inverse dynamics know the place; the interpolated torques are good to about 1e-11.
    c_n = fading.evaluate(np.array([event.time])).c_n[0]
    assert abs(c_n[lost]) < 1e-8
    assert (np.delete(c_n, lost) > 0.01).all()
    segment = motion.curve.segments[0]
    state, directions = np.append(problem.start, np.zeros(5)), Directions(segment.Xi, segment.sigma)
    run = integrate_phase(problem, 0, torque, state, directions, (0.0, 0.4), accuracy=1e-11)
    assert run.lost == lost
    # SciPy finds an event on its interpolant, which is less accurate than its steps.
    assert event.time == pytest.approx(run.t, abs=1e-7)
    assert simulation.outcome.text == (
        f"c_n of {event.contact} falls to zero at t = {event.time:.5g} s, phase 1"
    )


def test_overshoot_arrives_at_a_speed() -> None:
    problem, trajectory = plan()
    simulation = simulate(problem, change(trajectory.torque, brake_less))
    event = simulation.find(EventKind.ARRIVAL)[0]
    last = int(np.flatnonzero(simulation.phase == 0)[-1])
    assert event.time == simulation.t[last] < 0.395
    gained = problem.phases[0].until.contact
    assert gained is not None
    formation = Formation(problem.scene, (gained,))
    z, z_dot = simulation.z[last], simulation.z_dot[last]
    kinematics = formation.evaluate(z[None], z_dot[None])
    assert abs(kinematics.C[0, 0]) < 1e-15
    assert event.value == pytest.approx(-kinematics.A[0, 0] @ z_dot, rel=1e-9)
    assert event.value > 1e-3
    # The arrival is plastic: all kinetic energy is lost.
    energies = simulation.energies
    kinetic = 0.5 * z_dot**2 @ problem.scene.mass_diagonal
    assert energies.impact[last + 1] == pytest.approx(kinetic, rel=1e-9)
    assert not simulation.z_dot[last + 1].any()
    assert np.abs(energies.residual).max() < 1e-9 * energies.work.max()


def test_another_limit_ends_the_motion() -> None:
    problem, motion = pick(1)
    phase = Phase(0, problem.phases[0].formation, Until(coordinate="x", value=-1.0))
    aimless = dataclasses.replace(problem, phases=(phase,))
    tau = motion.evaluate(np.array([0.0])).tau[0]
    simulation = simulate(aimless, constant(tau, 2.0))
    assert simulation.outcome.kind is OutcomeKind.LIMIT_REACHED
    assert "v6 touches finger 2" in simulation.outcome.text
    assert np.abs(simulation.z[-1] - motion.curve.end).max() < 1e-7


@pytest.mark.parametrize("solid", [True, False])
def test_fingers_that_touch_end_the_motion(solid: bool) -> None:
    """The hexagon's plan replayed by a hand with a longer left finger."""
    problem = part_of(hexagon(solid=solid), 0, 3)
    simulation = simulate(problem, slid().trajectory.torque)
    gaps = measure_fingers(problem.scene, simulation.z)
    if not solid:
        assert simulation.outcome.reached and gaps.min() < -1e-4
        return
    assert simulation.outcome.kind is OutcomeKind.LIMIT_REACHED
    assert simulation.outcome.text.startswith("finger 1 touches finger 2 at t = ")
    assert simulation.outcome.text.endswith("phase 3")
    assert abs(gaps[-1]) < 2e-6 and gaps[:-1].min() > -1e-9


def test_jamming_is_an_error_that_names_phase_and_time() -> None:
    problem, motion = pick(2)
    # On this much friction the phase starts, and jams on the way.
    rough = problem.with_(friction_palm=0.4, friction_finger2=2.0)
    curve = dataclasses.replace(motion.curve, formation=rough.phases[0].formation)
    torque = fit(CosineMotion(curve, motion.duration, 0.3), 40, 7)
    place = r"v6-finger2 jams at t = 0\.1\d+ s, phase 1: friction"
    with pytest.raises(JammingError, match=place) as caught:
        simulate(rough, torque)
    assert caught.value.phase == 1


def test_a_jammed_formation_at_rest() -> None:
    problem, motion = pick(1)
    rough = problem.with_(friction=1.5)
    rest = Rest(rough.phases[0].formation, rough.start)
    assert max(way.response.ratio for way in rest.sliding) < 0
    simulation = simulate(rough, constant((0.0, 0.0)))
    assert simulation.outcome.kind is OutcomeKind.GOAL_MISSED
    assert np.abs(simulation.z - rough.start).max() < 1e-15
    # Torques that nothing balances have no motion to go with either.
    tau = motion.evaluate(np.array([0.0])).tau[0]
    with pytest.raises(JammingError, match="jams at rest at t = 0 s, phase 1"):
        simulate(rough, constant(tau))


def test_formation_that_does_not_close_is_an_error() -> None:
    problem, _ = plan()
    wrong = dataclasses.replace(problem, start=problem.start + np.eye(5)[1])
    with pytest.raises(SimulationError, match="does not touch at t = 0 s, phase 1"):
        simulate(wrong, constant((0.0, 0.0)))


@pytest.mark.parametrize("tolerance", [0.0, -1e-9, math.nan, 1.0])
def test_bad_tolerance(tolerance: float) -> None:
    problem, trajectory = plan()
    with pytest.raises(InputError, match="tolerance"):
        simulate(problem, trajectory.torque, tolerance=tolerance)


def test_order_on_a_known_solution() -> None:
    """Two unknowns that move, and the integral of the rate of half the square of the first."""
    y, t, h = ca.SX.sym("y", 3), ca.SX.sym("t"), ca.SX.sym("h")

    def rate(state: ca.SX, time: ca.SX) -> ca.SX:
        assert state.shape == (2, 1)
        return ca.vertcat(state[1], -state[0], state[0] * state[1]) * ca.cos(time)

    step = ca.Function("step", [y, t, h], [system.build_step(rate, y, t, h, 2)[0]])
    errors = []
    for count in (8, 16):
        state = np.array([0.0, 1.0, 0.0])
        for k in range(count):
            state = step(state, 3 * k / count, 3 / count).full()[:, 0]
        exact = np.sin(np.sin(3.0)), np.cos(np.sin(3.0)), np.sin(np.sin(3.0)) ** 2 / 2
        errors.append(np.abs(state - exact).max())
    assert np.log2(errors[0] / errors[1]) > 7.5


def test_error_estimate_bounds_the_error() -> None:
    y, t, h = ca.SX.sym("y", 1), ca.SX.sym("t"), ca.SX.sym("h")
    end, fifth, third = system.build_step(lambda s, _: -s, y, t, h, 1)
    tolerance = 1e-6
    error = system.build_error(fifth, third, y, 1.0, tolerance)
    step = ca.Function("step", [y, t, h], [end, error])
    for length in (0.2, 0.5, 1.0):
        state, estimate = (float(value) for value in step(1.0, 0.0, length))
        assert abs(state - np.exp(-length)) < float(estimate) * 2 * tolerance


@each("power", [1, 3, 5])
@each("root", [1e-7, 3e-4, 0.7])
def test_events_are_located_at_multiple_roots(power: int, root: float) -> None:
    # A joint that starts without acceleration turns back like t^3.
    def fall(x: float) -> float:
        return 1e-6 * math.copysign(abs(root - x) ** power, root - x)

    found = find_root(fall, 0.0, 1.0, x_tolerance=1e-12)
    # The bracket is at most 1e-12 wide at the end.
    assert found == pytest.approx(root, abs=1e-12)


@lru_cache(maxsize=4)
def bumping(speed: float, beyond: float = 0.0) -> tuple[Problem, TorqueProfile]:
    """The heptagon with low friction runs into its second formation at a speed along the curve."""
    # The torques go on for a distance `beyond` the impact [m], and then step.
    problem = problem_of(HEPTAGON).with_({"phases[1].end": "impact"})
    problem = dataclasses.replace(problem, phases=problem.phases[:2])
    curve = trace_phases(problem)[0]
    # Beyond, a motion that slows; otherwise as slow a start as the speed allows.
    duration = (1.2 if beyond else 2.0) * curve.length / max(speed, 0.1)
    tries = (
        DepartingMotion(curve, duration, float(squeeze), place=curve.length + beyond, speed=speed)
        for squeeze in SQUEEZES
    )
    t = np.linspace(0.0, duration, 101)
    motion = next(motion for motion in tries if motion.evaluate(t).c_n.min() > 0.1)
    torque = fit(motion, 60, 7)
    after = TorqueProfile(np.array([0.0, 0.01]), np.array([[[1.0], [-1.0]]]))
    return problem, TorqueProfile.chain([torque, after]) if beyond else torque


def test_replays_the_plan_through_its_impacts() -> None:
    planned = plan_of(IMPACTS)
    replayed = simulate(problem_of(IMPACTS), planned.torque, times=planned.t)
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
    last = int(np.flatnonzero(simulation.phase == 0)[-1])
    assert simulation.z_dot[last].any() and not simulation.z_dot[last + 1].any()


def test_a_step_of_the_torques_just_before_a_planned_stop_is_not_its_end() -> None:
    """Hardly any way is left there, but it takes longer than what rounding makes of a time."""
    problem = bumping(1e-5)[0]
    curve, scales = trace_phases(problem)[0], problem.scene.scales
    motion = CosineMotion(curve, 0.5, choose_squeeze(curve, 0.5, 0.2, 2.0))
    before = 0.5 * (1 - 2 / np.pi * np.sqrt(1e-5 * scales.length / curve.length))
    assert motion.law(np.array([before]))[0][0] > curve.length - 2e-5 * scales.length
    torque = fit(motion, 20, 7, np.sort([*motion.turns, before]))
    steps = torque.coefficients.copy()
    steps[torque.breaks[:-1] >= before, :, 0] += 1e-7 * scales.torque
    simulation = simulate(problem, TorqueProfile(torque.breaks, steps))
    arrival = simulation.find(EventKind.ARRIVAL)[0]
    assert arrival.time - before > 0.9 * (0.5 - before)


@pytest.mark.parametrize("scale", [1.002, 1.01])
def test_an_impact_that_comes_early(scale: float) -> None:
    """With torques that are a little off at the end of the first phase."""
    problem, planned = problem_of(IMPACTS), plan_of(IMPACTS)
    ends = planned.phase_starts[1]

    def edit(starts: Array, c: Array) -> Array:
        c[(starts > 0.8 * ends) & (starts < ends - 1e-12)] *= scale
        return c

    simulation = simulate(problem, change(planned.torque, edit))
    first = simulation.find(EventKind.IMPACT)[0]
    assert 2e-6 < ends - first.time < 5e-3
    last = int(np.flatnonzero(simulation.phase == 0)[-1])
    after = last + 1
    before, formation = (p.formation for p in problem.phases[:2])
    impact = compute_impact(before, formation, simulation.z[after], simulation.z_dot[last])
    np.testing.assert_allclose(simulation.z_dot[after], impact.v, rtol=0, atol=1e-9)
    assert np.abs(simulation.energies.residual).max() < 1e-8 * simulation.energies.work.max()


@pytest.mark.parametrize("scale", [1 - 4e-6, 1 + 2e-6, 1 + 4e-6])
def test_a_reversal_next_to_its_torque_step(scale: float) -> None:
    """Torques that are a little off move it before or behind the step; no contact parts."""
    problem, torque = problem_of(IMPACTS), plan_of(IMPACTS).torque
    simulation = simulate(problem, change(torque, lambda _, c: scale * c))
    assert simulation.outcome.kind is OutcomeKind.GOAL_REACHED, simulation.outcome.text
    loss = np.nanmin(simulation.c_n) - problem.epsilon
    assert loss > -1e-3 * problem.scene.scales.force


@pytest.mark.parametrize(
    "names, kind, text",
    [
        ("v0-palm v5-finger2 v3-finger1", OutcomeKind.HELD, "friction would hold v3-finger1"),
        ("v0-palm v1-palm v3-finger1", OutcomeKind.LIMIT_REACHED, "v5-finger2 would not part, at"),
        ("v1-palm v2-finger1 v3-finger1", OutcomeKind.CONTACT_LOST, "impulse on v2-finger1 would"),
    ],
)
def test_other_formations_that_an_impact_cannot_reach(
    names: str, kind: OutcomeKind, text: str
) -> None:
    problem = problem_of(IMPACTS)
    contacts = tuple(parse_contact(name, problem.scene) for name in names.split())
    following = Phase(1, Formation(problem.scene, contacts), problem.phases[1].until)
    passing = dataclasses.replace(problem, phases=(problem.phases[0], following))
    simulation = simulate(passing, plan_of(IMPACTS).torque)
    assert simulation.outcome.kind is kind
    (event,) = simulation.find(EventKind.IMPACT)
    assert simulation.outcome.text.startswith(text)
    assert simulation.outcome.text.endswith(f" in the impact at t = {event.time:.5g} s, phase 1")


def test_verify_reports_the_impacts() -> None:
    report = verified(IMPACTS)
    assert report.ok and report.failures == ()
    assert [phase.end for phase in report.phases] == [*4 * ["impact"], "rest"]
    rows = plan_of(IMPACTS).meta["transitions"]
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


Told = tuple[Problem, TorqueProfile]


def box() -> Told:
    """A box that is pushed, sticks and slips, beside a finger that swings."""
    return pushed(), rocking()


def landing() -> Told:
    """A release and a landing in which a vertex sticks twice."""
    problem, trajectory = plan_landing(squeeze=3.0)
    return problem, trajectory.torque


def slide() -> Told:
    """The first phases of the heptagon on four contacts."""
    problem, trajectory = plan()
    return dataclasses.replace(problem, phases=problem.phases[:2]), trajectory.torque


@cache
def begin(make: Callable[[], Told]) -> tuple[Told, Simulation]:
    """A problem with its torques, and what becomes of it as it is told first."""
    problem, torque = make()
    return (problem, torque), simulate(problem, torque, tolerance=1e-11)


@pytest.mark.parametrize("telling", RETELLINGS, ids=lambda telling: telling.name)
@pytest.mark.parametrize("make", [box, landing, slide])
def test_answers_agree(make: Callable[[], Told], telling: Retelling) -> None:
    (problem, torque), first = begin(make)
    told = telling.apply(problem)
    other = simulate(told, telling.tell_torque(torque), tolerance=1e-11)
    assert other.outcome.kind is first.outcome.kind

    def tell(event: Event) -> tuple[str, str]:
        name = event.contact
        if name.startswith("joint"):
            name = f"joint {3 - int(name[-1])}" if telling.mirrored else name
        elif name:
            name = telling.rename(parse_contact(name, problem.scene), told.scene).name
        return event.kind.value, name

    names = [tell(event) for event in first.events if event.contact[:1] in ("", "v", "j")]
    # Events of one instant have no order.
    assert sorted(names) == sorted((event.kind.value, event.contact) for event in other.events)
    times = telling.units.time * np.sort([event.time for event in first.events])
    assert np.sort([event.time for event in other.events]) == pytest.approx(times, rel=1e-8)
    length = told.scene.scales.length
    ends = telling.tell(np.append(first.z[-1], first.z_dot[-1]))[:5]
    assert np.abs((other.z[-1] - ends) / [length, length, 1.0, 1.0, 1.0]).max() < 1e-8
    assert other.steps == pytest.approx(first.steps, abs=3)
    assert np.abs(other.energies.residual).max() < 1e-9 * np.abs(other.energies.work).max()
