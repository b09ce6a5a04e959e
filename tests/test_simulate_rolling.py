from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.optimize import brentq

from plane import make_formation, make_scene, measure_slip, place_corners
from tipping import POINTS, box, constant, falling, ramp, roll, tip, tipped
from wholearm.common.arrays import Array
from wholearm.contacts.closing import close_finger, place_flush
from wholearm.problem.definition import End, Phase, Problem, Until
from wholearm.scene.model import Friction, Scene
from wholearm.simulation.events import EventKind, OutcomeKind
from wholearm.simulation.simulate import project_velocity, simulate


def test_replay_keeps_the_vertex_where_it_is() -> None:
    plan = tipped()
    simulation = simulate(box(), plan.torque, tolerance=1e-10, times=plan.t)
    assert simulation.outcome.reached and not simulation.find(EventKind.SLIP)
    rows = simulation.phase == 1
    corners = np.array([place_corners(box().scene, z)[1] for z in simulation.z[rows]])
    # Neither drift nor a jump on entering the phase.
    assert np.ptp(corners[:, 0]) < 1e-14 and np.abs(corners[:, 1]).max() < 1e-14
    assert simulation.energies.residual == pytest.approx(0.0, abs=1e-9)
    last = np.abs(simulation.z[-1] - plan.z[-1])
    assert last.max() < 1e-7


def fall(mu: float, lean: float) -> tuple[float, float, float]:
    """When and how far a box that falls from rest about its vertex has leant when that slips.

    Returns the time [s], the lean [rad] and the tangential force [N] from the conservation of
    energy: l is the distance of the centroid from the vertex.
    """
    body = make_scene(POINTS).polygon
    assert body.inertia is not None
    length = float(np.hypot(*body.vertices[1]))
    about = body.inertia + body.mass * length**2
    pull = body.mass * 9.81 * length / about

    def forces(angle: float) -> tuple[float, float]:
        turning, rate = pull * np.sin(angle), 2 * pull * (np.cos(lean) - np.cos(angle))
        side = length * (turning * np.cos(angle) - rate * np.sin(angle))
        up = -length * (turning * np.sin(angle) + rate * np.cos(angle))
        return body.mass * (9.81 + up), body.mass * side

    def margin(angle: float) -> float:
        c_n, c_t = forces(angle)
        return mu * c_n - abs(c_t)

    grid = np.linspace(lean, 1.5, 2000)
    slips = int(np.argmax([margin(angle) < 0 for angle in grid]))
    end = brentq(margin, grid[slips - 1], grid[slips], xtol=1e-14)

    def slowness(u: float) -> float:
        # The angle is lean + u^2: the rate at rest is a square root.
        angle = lean + u**2
        if u == 0:
            return float(2 / np.sqrt(2 * pull * np.sin(lean)))
        return float(2 * u / np.sqrt(2 * pull * (np.cos(lean) - np.cos(angle))))

    time = quad(slowness, 0, np.sqrt(end - lean), epsabs=1e-13, epsrel=1e-12)[0]
    return time, end, forces(end)[1]


@pytest.mark.parametrize("mu, sign", [(0.25, 1.0), (0.36, 1.0), (0.6, -1.0)])
def test_a_falling_box_slips_when_its_friction_cone_is_left(mu: float, sign: float) -> None:
    """Closed form; on rough ground the vertex slips forwards, on smooth ground backwards."""
    problem = falling(mu, 0.2)
    time, lean, c_t = fall(mu, 0.2)
    assert np.sign(c_t) == sign
    simulation = simulate(problem, constant((-0.01, 0.01), 2.0), tolerance=1e-12)
    assert simulation.outcome.kind is OutcomeKind.SLIPS
    event = simulation.events[-1]
    assert event.kind is EventKind.SLIP and event.contact == "v1-palm"
    assert event.time == pytest.approx(time, abs=1e-9)
    assert problem.start[2] - simulation.z[-1, 2] == pytest.approx(lean - 0.2, abs=1e-9)
    assert simulation.c_t[-1, 0] == pytest.approx(c_t, abs=1e-8)
    bound = mu * simulation.c_n[-1, 0]
    assert simulation.outcome.text == (
        f"v1-palm slips: |c_t| = {abs(c_t):.5g} N reaches mu c_n = {bound:.5g} N "
        f"at t = {time:.5g} s, phase 1"
    )
    corner = np.array([place_corners(problem.scene, z)[1] for z in simulation.z])
    assert np.abs(corner - corner[0]).max() < 1e-14


def test_a_box_cannot_start_to_roll_without_enough_friction() -> None:
    """From rest: c_t / c_n is known, and friction below that lets the vertex slip at once."""
    about = falling(1.0, 0.2)
    start = simulate(about, constant((-0.01, 0.01), 0.01))
    row = int(np.flatnonzero(~np.isnan(start.c_n[:, 0]))[0])
    needed = float(start.c_t[row, 0] / start.c_n[row, 0])
    assert 0.1 < needed < 0.4
    enough = simulate(falling(1.01 * needed, 0.2), constant((-0.01, 0.01), 0.01))
    assert enough.outcome.kind is OutcomeKind.GOAL_MISSED and enough.find(EventKind.START)
    short = simulate(falling(0.99 * needed, 0.2), constant((-0.01, 0.01), 0.01))
    assert short.outcome.kind is OutcomeKind.SLIPS and not short.find(EventKind.START)
    assert "exceeds mu c_n" in short.outcome.text and short.events[-1].time == 0.0


def pushed(mu: float) -> tuple[Problem, Array]:
    """A box that finger 1 pushes to the left while vertex 0 holds it; finger 2 is far off."""
    scene = make_scene([[-0.03, -0.03], [0.03, -0.03], [0.03, 0.03], [-0.03, 0.03]], base=0.1)
    left = dataclasses.replace(scene.fingers[1], base=[-0.5, -0.01], viscous=0.0, dry=0.0)
    friction = Friction(mu, 0.1, 0.1)
    scene = Scene(scene.polygon, (scene.fingers[0], left), friction)
    q = place_flush(scene, 0, 0.0)
    z = np.array([*q, close_finger(scene, q, 0), np.pi / 2])
    formation = roll(make_formation(scene, "v0-palm v1-palm v2-finger1"), "v0-palm")
    phase = Phase(0, formation, Until(coordinate="x", value=-0.2))
    return Problem("pushed box", scene, 0.0, z, (phase,)), z


def test_a_rising_push_slips_a_box_when_statics_say_so() -> None:
    """The box does not move until then, so its forces follow from the torque by statics."""
    mu, rate = 0.3, 0.2
    problem, z = pushed(mu)
    scene = problem.scene
    corner = place_corners(scene, z)[2]
    run = np.sqrt(np.sum((corner - scene.fingers[0].base) ** 2) - scene.fingers[0].radius ** 2)
    n = np.array([-np.sin(z[3]), np.cos(z[3])])
    weight = scene.polygon.mass * scene.gravity
    # For a push f: f n_x + c_t = 0; both upward forces carry the weight less f n_y; moments about
    # vertex 0. All are linear in f, and so is the margin mu c_n + c_t.
    lever, high = 0.06, 0.06

    def margin(f: float) -> float:
        right = weight / 2 - (lever * n[1] - high * n[0]) * f / lever
        left = weight - f * n[1] - right
        assert right > 0
        return float(mu * left - abs(f * n[0]))

    push = margin(0.0) / (margin(0.0) - margin(1.0))
    torque = ramp((0.0, 0.001), (rate, 0.0), 3.0)
    simulation = simulate(problem, torque, tolerance=1e-11)
    assert simulation.outcome.kind is OutcomeKind.SLIPS
    assert simulation.events[-1].contact == "v0-palm"
    assert simulation.events[-1].time == pytest.approx(push * run / rate, rel=1e-9)
    np.testing.assert_allclose(simulation.z[-1, :4], z[:4], atol=1e-14)


def test_entering_a_rolling_formation_at_speed_is_a_plastic_impact() -> None:
    """The impulse acts along the constraints alone, and the vertex stops."""
    curve = tip()
    formation = curve.formation
    z = curve.evaluate(np.array([0.4 * curve.length])).z[0]
    v = np.random.default_rng(3).uniform(-1, 1, 5)
    kept = project_velocity(formation, z, v)
    assert np.abs(measure_slip(formation, z, kept)[0]) < 1e-14
    P = formation.evaluate(z[None], v[None]).P[0]
    mass = formation.scene.mass_diagonal
    impulse = mass * (kept - v)
    assert np.linalg.lstsq(P.T, impulse)[1] == pytest.approx(0.0, abs=1e-20)
    lost = 0.5 * mass @ (v**2 - kept**2)
    assert lost == pytest.approx(0.5 * mass @ (v - kept) ** 2) and lost > 0


def test_a_sliding_vertex_is_stopped_where_the_next_phase_lets_it_roll() -> None:
    """What the impact takes is the difference of both kinetic energies; the cone then decides."""
    problem = falling(0.1, 0.2)
    scene, (last,) = problem.scene, problem.phases
    slides = dataclasses.replace(last.formation, rolling=())
    until = Until(coordinate="phi", value=float(problem.start[2]) - 0.4)
    phases = Phase(0, slides, until, End.SMOOTH), dataclasses.replace(last, index=1)
    two = dataclasses.replace(problem, phases=phases)
    simulation = simulate(two, constant((-0.01, 0.01), 1.0), tolerance=1e-11)
    before = int(np.flatnonzero(simulation.phase == 0)[-1])
    z, v = simulation.z[before], simulation.z_dot[before]
    assert measure_slip(slides, z, v)[0] < -0.1
    after = simulation.z_dot[before + 1]
    assert abs(measure_slip(slides, z, after)[0]) < 1e-14
    lost = 0.5 * scene.mass_diagonal @ (v**2 - after**2)
    assert simulation.energies.impact[-1] == pytest.approx(lost) and lost > 1e-4
    assert simulation.energies.residual == pytest.approx(0.0, abs=1e-9)
    assert simulation.outcome.kind is OutcomeKind.SLIPS and simulation.events[-1].phase == 1
    assert simulation.events[-1].time == simulation.t[before]
