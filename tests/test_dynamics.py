from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest

from plane import SQUARE, make_formation, make_scene, measure_slip, unbalance
from pushed import forward
from wholearm.common.arrays import Array
from wholearm.contacts.closing import close_finger
from wholearm.contacts.formation import Formation
from wholearm.geometry.curve import Curve
from wholearm.geometry.tracing import trace_phases
from wholearm.mechanics.dynamics import (
    LAMBDA,
    Directions,
    build_forward,
    energy,
    inverse,
    reduced_inertia,
)
from wholearm.problem.read import build_problem
from wholearm.results.trajectory import Samples
from wholearm.scene.model import Friction, Scene
from wholearm.verification.minimal_coordinates import reduce_to_first_joint

FRICTIONLESS = Friction(0.0, 0.0, 0.0)


def states(curves: tuple[Curve, ...], count: int = 4) -> Iterator[tuple[Curve, float, Directions]]:
    """Random places of every segment of every curve, with the signs of motion along +s."""
    rng = np.random.default_rng(11)
    for curve in curves:
        for segment in curve.segments:
            for part in rng.uniform(0.02, 0.98, count):
                s = segment.start + part * (segment.stop - segment.start)
                yield curve, s, Directions(segment.Xi, segment.sigma)


def random_motion(rng: np.random.Generator) -> tuple[Array, Array, Array]:
    """Path acceleration, squared speed and squeeze, as arrays of one place."""
    return rng.uniform(-2, 2, 1), rng.uniform(0.01, 0.2, 1), rng.uniform(1, 5, 1)


def test_three_routes_agree(curves: tuple[Curve, ...]) -> None:
    rng = np.random.default_rng(12)
    for curve, s, directions in states(curves):
        z, z_s, z_ss = curve.evaluate(np.array([s]))[:3]
        a, b, squeeze = random_motion(rng)
        forces = inverse(curve.formation, z, z_s, z_ss, directions)
        tau, c_n = forces.tau(a, b, squeeze)[0], forces.c(a, b, squeeze)[0]
        v = z_s[0] * np.sqrt(b)
        z_ddot = z_s[0] * a + z_ss[0] * b

        acceleration, normal = forward(curve.formation, z[0], v, tau, directions)
        size = np.abs(z_ddot).max() + 1
        np.testing.assert_allclose(acceleration, z_ddot, rtol=0, atol=1e-10 * size)
        np.testing.assert_allclose(normal, c_n, rtol=0, atol=1e-10 * np.abs(c_n).max())

        Phi_1, Phi_2, Phi_3 = reduce_to_first_joint(curve.formation, z[0], v[3], tau, directions)
        assert -(Phi_2 * v[3] + Phi_3) / Phi_1 == pytest.approx(z_ddot[3], abs=1e-10 * size)


def newton_euler_residual(
    formation: Formation, z: Array, v: Array, z_ddot: Array, tau: Array, c: Array
) -> Array:
    """What is missing in each body's balance: 2 forces and 1 moment, and 2 joint moments."""
    n_c, rows = formation.n_contacts, list(formation.rolling_rows)
    slip = measure_slip(formation, z, v)
    assert (np.abs(slip[rows]) < 1e-14).all()
    c_t = -formation.friction * np.sign(slip) * c[:n_c]
    c_t[rows] = c[n_c:]
    samples = Samples(z, v, z_ddot, tau, c[:n_c], c_t)
    return np.asarray(unbalance(formation, samples, np.sign(v[3:]))[0])


def test_every_body_obeys_newton_and_euler(curves: tuple[Curve, ...]) -> None:
    rng = np.random.default_rng(13)
    for curve, s, directions in states(curves):
        z, z_s, _ = (part[0] for part in curve.evaluate(np.array([s]))[:3])
        v, tau = z_s * rng.uniform(0.1, 0.5), rng.uniform(-1, 1, 2)
        z_ddot, c_n = forward(curve.formation, z, v, tau, directions)
        residual = newton_euler_residual(curve.formation, z, v, z_ddot, tau, c_n)
        assert np.abs(residual).max() < 1e-12 * (1 + np.abs(c_n).max())


def test_accelerations_keep_the_contacts(curves: tuple[Curve, ...]) -> None:
    for curve, s, directions in states(curves, 2):
        z, z_s, _ = (part[0] for part in curve.evaluate(np.array([s]))[:3])
        v = 0.4 * z_s
        z_ddot, _ = forward(curve.formation, z, v, np.array([1.0, -1.0]), directions)
        h = 2e-5
        path = [z + k * v + k**2 / 2 * z_ddot for k in (-h, 0.0, h)]
        gaps = curve.formation.evaluate(np.array(path), np.zeros((3, 5))).C
        # Rounding 1e-17 over h^2; the gap's fourth derivative times h^2.
        np.testing.assert_allclose((gaps[0] - 2 * gaps[1] + gaps[2]) / h**2, 0.0, atol=1e-6)


def test_power_balance(curves: tuple[Curve, ...]) -> None:
    """d/dt energy = power of the torques - friction at joints and contacts."""
    rng = np.random.default_rng(14)
    for curve, s, directions in states(curves):
        formation, scene = curve.formation, curve.formation.scene
        z, z_s, _ = (part[0] for part in curve.evaluate(np.array([s]))[:3])
        v, tau = z_s * rng.uniform(0.1, 0.5), rng.uniform(-1, 1, 2)
        z_ddot, c_n = forward(formation, z, v, tau, directions)
        h = 1e-5
        before, after = (
            energy(formation, (z + k * v + k**2 / 2 * z_ddot)[None], (v + k * z_ddot)[None])[0]
            for k in (-h, h)
        )
        slip = formation.evaluate(z[None], v[None]).A_t[0] @ v
        lost = np.abs(slip) @ (formation.friction * c_n)
        lost += scene.viscous @ v**2 + scene.dry @ np.abs(v)
        power = tau @ v[3:] - lost
        assert (after - before) / (2 * h) == pytest.approx(power, abs=1e-8 * (1 + abs(power)))


def standing() -> tuple[Formation, Array]:
    """A square on the palm between two links that lean inwards on its upper corners."""
    scene = make_scene(SQUARE, base=0.08, depth=-0.01, friction=0.0)
    q = np.array([0.0, 0.03, 0.0])
    z = np.array([*q, close_finger(scene, q, 0), close_finger(scene, q, 1)])
    return make_formation(scene, "v0-palm v1-palm v2-finger1 v3-finger2"), z


def test_symmetric_squeeze_by_hand() -> None:
    """Equal torques hold the square; each link's force has the lever arm base to corner."""
    formation, z = standing()
    scene = formation.scene
    still = Directions(np.ones(4), np.zeros(2))
    tau = np.array([0.3, -0.3])
    z_ddot, c_n = forward(formation, z, np.zeros(5), tau, still)
    np.testing.assert_allclose(z_ddot, 0.0, atol=1e-10)
    arm = np.array([0.03, 0.06]) - np.asarray(scene.fingers[0].base)
    run = np.sqrt(arm @ arm - 0.005**2)
    press = 0.3 / run
    # The right link's normal is its axis turned left, so its upward part is cos(theta_1).
    up = press * np.cos(z[3])
    weight = scene.polygon.mass * scene.gravity
    np.testing.assert_allclose(c_n[2:], press, rtol=1e-12)
    np.testing.assert_allclose(c_n[:2], (weight - 2 * up) / 2, rtol=1e-11)


def test_without_friction_the_motion_follows_virtual_work(curves: tuple[Curve, ...]) -> None:
    """M_eff s'' + M_eff' s'^2 / 2 = tau . theta_s + g . z_s - viscous: no constraint forces."""
    rng = np.random.default_rng(15)
    for curve in curves:
        scene = replace(curve.formation.scene, friction=FRICTIONLESS)
        formation = Formation(scene, curve.formation.contacts)
        s, h = curve.length * rng.uniform(0.1, 0.9), 1e-6 * curve.length

        def inertia(s: float, curve: Curve = curve, scene: Scene = scene) -> float:
            return float(curve.evaluate(np.array([s])).z_s[0] ** 2 @ scene.mass_diagonal)

        z, z_s, z_ss = (part[0] for part in curve.evaluate(np.array([s]))[:3])
        speed, tau = 0.3, rng.uniform(-1, 1, 2)
        v = speed * z_s
        sigma = np.sign(v[3:])
        z_ddot, _ = forward(formation, z, v, tau, Directions(np.ones(4), sigma))
        drag = scene.viscous * v + scene.dry * np.sign(v)
        work = tau @ z_s[3:] + (scene.applied_force - drag) @ z_s
        slope = (inertia(s + h) - inertia(s - h)) / (2 * h)
        s_ddot = (work - slope / 2 * speed**2) / inertia(s)
        expected = z_s * s_ddot + z_ss * speed**2
        # The slope is a difference: rounding 1e-16 over h.
        np.testing.assert_allclose(z_ddot, expected, rtol=0, atol=1e-6 * np.abs(expected).max())


def test_squeeze_moves_no_body(curves: tuple[Curve, ...]) -> None:
    """The squeeze is a unit vector of c_n that leaves the object alone."""
    for curve, s, directions in states(curves, 2):
        point = curve.evaluate(np.array([s]))
        z, z_s, z_ss = point[:3]
        forces = inverse(curve.formation, z, z_s, z_ss, directions)
        assert np.linalg.norm(forces.of_c[0, :, LAMBDA]) == pytest.approx(1.0, abs=1e-12)
        a, b = np.array([0.5]), np.array([0.04])
        v, z_ddot = z_s[0] * 0.2, z_s[0] * 0.5 + z_ss[0] * 0.04
        for squeeze in (np.zeros(1), np.full(1, 3.0)):
            tau, c_n = forces.tau(a, b, squeeze)[0], forces.c(a, b, squeeze)[0]
            residual = newton_euler_residual(curve.formation, z[0], v, z_ddot, tau, c_n)
            assert np.abs(residual).max() < 1e-12 * (1 + np.abs(c_n).max())


def test_reduced_inertia_has_the_sign_of_the_mass_along_the_motion(
    curves: tuple[Curve, ...],
) -> None:
    """It vanishes where z_s^T M5 w does, w the vector that no contact force acts on."""
    for curve, s, directions in states(curves, 2):
        formation = curve.formation
        point = curve.evaluate(np.array([s]))
        ratio = reduced_inertia(formation, formation.evaluate(point.z, point.z), directions)[0]
        kinematics = formation.evaluate(point.z, point.z_s)
        slip = (formation.friction * directions.Xi)[:, None]
        G = (kinematics.A - slip * kinematics.A_t)[0]

        def null(matrix: Array) -> Array:
            minors = [(-1) ** k * np.linalg.det(np.delete(matrix, k, axis=1)) for k in range(5)]
            return np.array(minors)

        mass, free, idle = formation.scene.mass_diagonal, null(kinematics.A[0]), null(G)
        expected = (free * mass) @ idle / ((free * mass) @ free)
        assert ratio == pytest.approx(expected, rel=1e-9)


def test_forward_takes_any_number_of_contacts(curves: tuple[Curve, ...]) -> None:
    curve = curves[0]
    for count in (1, 2, 3):
        formation = Formation(curve.formation.scene, curve.formation.contacts[:count])
        z = curve.start
        A = formation.evaluate(z[None], z[None]).A[0]
        v = 0.1 * np.linalg.svd(A)[2][-1]
        slip = formation.evaluate(z[None], z[None]).A_t[0] @ v
        directions = Directions(np.sign(slip), np.sign(v[3:]))
        z_ddot, c_n = forward(formation, z, v, np.array([0.2, -0.1]), directions)
        residual = newton_euler_residual(formation, z, v, z_ddot, np.array([0.2, -0.1]), c_n)
        assert np.abs(residual).max() < 1e-12 * (1 + np.abs(c_n).max())


def rolling_states(
    curves: tuple[Curve, ...],
) -> Iterator[tuple[Formation, Array, Array, Directions]]:
    """Three of a curve's contacts, one of which rolls, with the velocity that is left free."""
    for curve, s, _ in states(curves, 1):
        scene, every = curve.formation.scene, curve.formation.contacts
        for kept, rolls in (((1, 2, 3), 1), ((0, 2, 3), 2), ((1, 2, 3), 3)):
            formation = Formation(scene, tuple(every[k] for k in kept), (every[rolls],))
            z = curve.evaluate(np.array([s])).z
            kinematics = formation.evaluate(z, z)
            v = 0.3 * np.linalg.svd(kinematics.P[0])[2][-1]
            slip = kinematics.A_t[0] @ v
            if np.abs(np.delete(slip, formation.rolling_rows)).min() < 1e-9:
                continue  # The other vertex of a flush edge does not slide either: it has no sign.
            yield formation, z[0], v, Directions(np.sign(slip), np.sign(v[3:]))


def test_rolling_contacts_obey_newton_and_euler(curves: tuple[Curve, ...]) -> None:
    rng = np.random.default_rng(16)
    h = 2e-5
    for formation, z, v, directions in rolling_states(curves):
        tau = rng.uniform(-1, 1, 2)
        kinematics = formation.evaluate(z[None], v[None])
        if reduced_inertia(formation, kinematics, directions)[0] <= 0.05:
            continue
        z_ddot, c = forward(formation, z, v, tau, directions)
        residual = newton_euler_residual(formation, z, v, z_ddot, tau, c)
        assert c.shape == (4,) and np.abs(residual).max() < 1e-12 * (1 + np.abs(c).max())
        # Gap and slip coordinates keep their values to second order.
        path = np.array([z + k * v + k**2 / 2 * z_ddot for k in (-h, 0.0, h)])
        held = np.hstack([formation.evaluate(path, path).C, formation.evaluate_slip(path)])
        size = 1 + np.abs(z_ddot).max()
        np.testing.assert_allclose((held[0] - 2 * held[1] + held[2]) / h**2, 0, atol=1e-6 * size)


def test_three_routes_agree_where_a_contact_rolls(curves: tuple[Curve, ...]) -> None:
    rng = np.random.default_rng(18)
    for formation, z, v, directions in rolling_states(curves):
        kinematics = formation.evaluate(z[None], v[None])
        if abs(reduced_inertia(formation, kinematics, directions)[0]) <= 0.05:
            continue
        z_s, speed = v / np.linalg.norm(v), float(np.linalg.norm(v))
        P = kinematics.P[0]
        z_ss = np.linalg.lstsq(P, -kinematics.P_dot_v[0] / speed**2)[0]
        a, _, squeeze = random_motion(rng)
        b = np.array([speed**2])
        forces = inverse(formation, z[None], z_s[None], z_ss[None], directions)
        tau, c = forces.tau(a, b, squeeze)[0], forces.c(a, b, squeeze)[0]
        acceleration, found, _ = build_forward(formation)(z, v, tau, *directions)
        size = 1 + np.abs(c).max()
        np.testing.assert_allclose(found.full()[:, 0], c, atol=1e-9 * size)
        expected = z_s * a + z_ss * b
        np.testing.assert_allclose(acceleration.full()[:, 0], expected, atol=1e-8 * size)
        if reduced_inertia(formation, kinematics, directions)[0] > 0 and abs(v[3]) > 1e-3:
            Phi_1, Phi_2, Phi_3 = reduce_to_first_joint(formation, z, v[3], tau, directions)
            theta_1_ddot = -(Phi_2 * v[3] + Phi_3) / Phi_1
            assert theta_1_ddot == pytest.approx(expected[3], abs=1e-7 * size)


def test_the_squeeze_keeps_its_sense_along_a_curve() -> None:
    """Here the null vector passes from pressing more to pressing less on the way."""
    finger = {"length": 20.0, "inertia": 50.0, "torque_limit": 2e5}
    problem = build_problem(
        {
            "epsilon": 50.0,
            "object": {
                "vertices": [[-0.3, -4.5], [4.2, -1.7], [2.9, 3.5], [-2.4, 3.9], [-4.4, -1.1]],
                "mass": 490.0,
            },
            "fingers": {
                "1": {"base": [5.14, -0.92], "radius": 0.66, **finger},
                "2": {"base": [-3.36, -0.53], "radius": 0.35, **finger},
            },
            "friction": {"palm": 0.087, "finger1": 0.126, "finger2": 0.02},
            "start": {"flush": 1, "x": -3.02},
            "phases": [
                {
                    "contacts": ["v1-palm", "v2-palm", "v3-finger1", "v1-finger2"],
                    "until": {"x": -7.6},
                }
            ],
        }
    )
    (curve,) = trace_phases(problem)
    (part,) = curve.segments
    place = curve.evaluate(np.linspace(0.0, curve.length, 300))
    null = inverse(curve.formation, *place[:3], Directions(part.Xi, part.sigma)).of_c[..., LAMBDA]
    pressing = null.sum(axis=1)
    assert pressing.min() < 0.0 < pressing.max()
    assert np.abs(np.diff(null, axis=0)).max() < 0.05
