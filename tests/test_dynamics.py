from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from functools import cache
from itertools import pairwise, permutations, product
from pathlib import Path

import numpy as np
import pytest

import plane
from independent import balances, collide
from planned import forward
from resting import list_others, rest_margin
from scenes import box, read_lines, roll, tipped
from shipped import BOX, FOLDER, HEPTAGON, IMPACTS, plan_of, problem_of, verified
from timed import landing, plan_landing
from wholearm import Formation, InputError, PlanOptions, TorqueProfile, verify
from wholearm import solve as plan
from wholearm.common.arrays import Array
from wholearm.common.errors import AmbiguityError, InfeasibleError
from wholearm.contacts.closing import close_finger
from wholearm.contacts.formation import CurvePoint
from wholearm.geometry.curve import Curve
from wholearm.geometry.tracing import trace_phases
from wholearm.mechanics.dynamics import LAMBDA, Directions, inverse, reduced_inertia
from wholearm.mechanics.impact import Impact, ViolationKind, compute_impact, solve_impulses
from wholearm.mechanics.statics import Statics, pushes_one_way
from wholearm.mechanics.uniqueness import find_minors
from wholearm.planning.blocks import ImpactSequence
from wholearm.planning.path_domain.path_plan import Task, plan_curves
from wholearm.planning.time_domain.stage import in_scene_units, unit_lengths
from wholearm.planning.time_domain.time_plan import plan_phases
from wholearm.problem.read import build_problem, read_problem
from wholearm.results.trajectory import Samples
from wholearm.scene.model import Friction, Scene
from wholearm.simulation import complementarity
from wholearm.verification.verify import find_stuck, find_uniqueness_margin, reduce_to_first_joint

State = tuple[Formation, Array, Array, Directions]
"""A formation, a configuration and a velocity that keep its contacts, and the signs of sliding."""


def sliding_states(curves: tuple[Curve, ...], count: int = 4) -> Iterator[State]:
    """Random places of every segment of every curve, at a speed along it."""
    rng = np.random.default_rng(11)
    for curve in curves:
        for segment in curve.segments:
            for part in rng.uniform(0.02, 0.98, count):
                s = segment.start + part * (segment.stop - segment.start)
                point = curve.evaluate(np.array([s]))
                v = rng.uniform(0.1, 0.5) * point.z_s[0]
                yield curve.formation, point.z[0], v, Directions(segment.Xi, segment.sigma)


def every_state(curves: tuple[Curve, ...]) -> Iterator[State]:
    """Those, and some of a curve's contacts, one of which may roll, with a velocity left free."""
    yield from sliding_states(curves)
    for whole, z, _, _ in sliding_states(curves, 1):
        scene, every = whole.scene, whole.contacts
        fewer = [Formation(scene, every[:count]) for count in (1, 2, 3)]
        for kept, rolls in (((1, 2, 3), 1), ((0, 2, 3), 2), ((1, 2, 3), 3)):
            fewer.append(Formation(scene, tuple(every[k] for k in kept), (every[rolls],)))
        for formation in fewer:
            kinematics = formation.evaluate(z[None], z[None])
            v = 0.3 * np.linalg.svd(kinematics.P[0])[2][-1]
            slip = kinematics.A_t[0] @ v
            directions = Directions(np.sign(slip), np.sign(v[3:]))
            if np.abs(np.delete(slip, formation.rolling_rows)).min() < 1e-9:
                continue  # The other vertex of a flush edge does not slide either: it has no sign.
            one_freedom = formation.n_constraints == 4
            if one_freedom and abs(reduced_inertia(formation, kinematics, directions)[0]) <= 0.05:
                continue
            yield formation, z, v, directions


def test_three_routes_agree(curves: tuple[Curve, ...]) -> None:
    """Inverse and forward dynamics, and the paper's scalar equation of joint 1."""
    rng = np.random.default_rng(18)
    for formation, z, v, directions in every_state(curves):
        if formation.n_constraints != 4:
            continue
        kinematics = formation.evaluate(z[None], v[None])
        z_s, speed = v / np.linalg.norm(v), np.array([np.linalg.norm(v)])
        z_ss = np.linalg.lstsq(kinematics.P[0], -kinematics.P_dot_v[0] / speed**2)[0]
        motion = rng.uniform(-2, 2, 1), speed**2, rng.uniform(1, 5, 1)
        point = CurvePoint(z[None], z_s[None], z_ss[None], kinematics)
        forces = inverse(formation, point, directions)
        assert np.linalg.norm(forces.of_c[0, :, LAMBDA]) == pytest.approx(1.0, abs=1e-12)
        tau, c = forces.tau(*motion)[0], forces.c(*motion)[0]
        acceleration, found = forward(formation, z, v, tau, directions)
        size, expected = 1 + np.abs(c).max(), z_s * motion[0] + z_ss * motion[1]
        np.testing.assert_allclose(found, c, atol=1e-9 * size)
        np.testing.assert_allclose(acceleration, expected, atol=1e-8 * size)
        if reduced_inertia(formation, kinematics, directions)[0] > 0 and abs(v[3]) > 1e-3:
            Phi_1, Phi_2, Phi_3 = reduce_to_first_joint(formation, z, v[3], tau, directions)
            theta_1_ddot = -(Phi_2 * v[3] + Phi_3) / Phi_1
            assert theta_1_ddot == pytest.approx(expected[3], abs=1e-7 * size)


def test_every_body_obeys_newton_and_euler_and_contacts_are_kept(curves: tuple[Curve, ...]) -> None:
    rng, h = np.random.default_rng(16), 2e-5
    for formation, z, v, directions in every_state(curves):
        tau, n_c, rolls = rng.uniform(-1, 1, 2), formation.n_contacts, list(formation.rolling_rows)
        z_ddot, c = forward(formation, z, v, tau, directions)
        assert c.shape == (formation.n_constraints,)
        slip = plane.measure_slip(formation, z, v)
        assert (np.abs(slip[rolls]) < 1e-14).all()
        c_t = -formation.friction * np.sign(slip) * c[:n_c]
        c_t[rolls] = c[n_c:]
        residual, _ = plane.unbalance(
            formation, Samples(z, v, z_ddot, tau, c[:n_c], c_t), np.sign(v[3:])
        )
        assert np.abs(residual).max() < 1e-12 * (1 + np.abs(c).max())
        # Gap and slip coordinates keep their values to second order: rounding 1e-17 over h^2, and
        # their fourth derivatives times h^2.
        path = np.array([z + k * v + k**2 / 2 * z_ddot for k in (-h, 0.0, h)])
        held = np.hstack([formation.evaluate(path, path).C, formation.evaluate_slip(path)])
        size = 1 + np.abs(z_ddot).max()
        np.testing.assert_allclose((held[0] - 2 * held[1] + held[2]) / h**2, 0, atol=1e-6 * size)


def test_symmetric_squeeze_by_hand() -> None:
    """Links lean inwards on a square's upper corners, where their forces have the arms' length."""
    scene = plane.make_scene(friction=0.0)
    q = np.array([0.0, 0.03, 0.0])
    z = np.array([*q, close_finger(scene, q, 0), close_finger(scene, q, 1)])
    formation = plane.make_formation(scene, "v0-palm v1-palm v2-finger1 v3-finger2")
    still = Directions(np.ones(4), np.zeros(2))
    z_ddot, c_n = forward(formation, z, np.zeros(5), np.array([0.3, -0.3]), still)
    np.testing.assert_allclose(z_ddot, 0.0, atol=1e-10)
    arm = np.array([0.03, 0.06]) - np.asarray(scene.fingers[0].base)
    press = 0.3 / np.sqrt(arm @ arm - 0.005**2)
    # The right link's normal is its axis turned left, so its upward part is cos(theta_1).
    up = press * np.cos(z[3])
    weight = scene.polygon.mass * scene.gravity
    np.testing.assert_allclose(c_n[2:], press, rtol=1e-12)
    np.testing.assert_allclose(c_n[:2], (weight - 2 * up) / 2, rtol=1e-11)


def test_reduced_inertia_has_the_sign_of_the_mass_along_motion(curves: tuple[Curve, ...]) -> None:
    """It vanishes where z_s^T M5 w does, w the vector that no contact force acts on."""
    for formation, z, v, directions in sliding_states(curves, 2):
        kinematics = formation.evaluate(z[None], v[None])
        ratio = reduced_inertia(formation, kinematics, directions)[0]
        slip = (formation.friction * directions.Xi)[:, None]
        G = (kinematics.A - slip * kinematics.A_t)[0]
        mass, free = formation.scene.mass_diagonal, plane.find_null_vector(kinematics.A[0])
        idle = plane.find_null_vector(G)
        expected = (free * mass) @ idle / ((free * mass) @ free)
        assert ratio == pytest.approx(expected, rel=1e-9)


def test_the_squeeze_keeps_its_sense_along_a_curve() -> None:
    """Here the null vector passes from pressing more to pressing less on the way."""
    text = """
        epsilon = 50.0
        object.mass = 490.0
        object.vertices = [[-0.3, -4.5], [4.2, -1.7], [2.9, 3.5], [-2.4, 3.9], [-4.4, -1.1]]
        fingers.1 = {base = [5.14, -0.92], length = 20.0, radius = 0.66, inertia = 50.0,
            torque_limit = 2e5}
        fingers.2 = {base = [-3.36, -0.53], length = 20.0, radius = 0.35, inertia = 50.0,
            torque_limit = 2e5}
        friction = {palm = 0.087, finger1 = 0.126, finger2 = 0.02}
        start = {flush = 1, x = -3.02}
        phases = [{contacts = ["v1-palm", "v2-palm", "v3-finger1", "v1-finger2"],
            until = {x = -7.6}}]
    """
    (curve,) = trace_phases(read_lines(text))
    (part,) = curve.segments
    place = curve.evaluate(np.linspace(0.0, curve.length, 300))
    null = inverse(curve.formation, place, Directions(part.Xi, part.sigma)).of_c[..., LAMBDA]
    pressing = null.sum(axis=1)
    assert pressing.min() < 0.0 < pressing.max()
    assert np.abs(np.diff(null, axis=0)).max() < 0.05


MASS = 0.2


@cache
def chain_of(path: Path) -> ImpactSequence:
    """Two of the four impacts are possible with a rough right finger, and none without."""
    problem = problem_of(path)
    return ImpactSequence(problem.phases, trace_phases(problem))


def check_momenta(impact: Impact, z: Array, before: Array) -> None:
    """Momentum of each body changes by the impulses at its contact points."""
    formation = impact.formation
    A, A_t = plane.stack_rows(formation, z)
    slide = formation.friction * np.sign(plane.measure_slip(formation, z, impact.v))
    impulse = impact.p @ (A - slide[:, None] * A_t)
    change = formation.scene.mass_diagonal * (impact.v - before)
    np.testing.assert_allclose(change, impulse, rtol=0, atol=1e-12)


def test_each_body_takes_its_impulses_as_complementarity_says() -> None:
    rough = chain_of(IMPACTS)
    for chain in (rough, chain_of(HEPTAGON)):
        for join, (one, other) in zip(chain.impacts, pairwise(chain.curves), strict=True):
            z, v = other.start, one.evaluate(np.array([one.length])).z_s[0]
            before, after = one.formation, other.formation
            impact = compute_impact(before, after, z, v)
            np.testing.assert_array_equal(impact.v, join.impact.v)
            check_momenta(impact, z, v)
            # Every contact is kept afterwards, and one arrives before.
            steps = 1e-6 * np.array([impact.v, v])
            kept, arriving = plane.measure_gaps(after, z + steps) - plane.measure_gaps(
                after, z - steps
            )
            assert np.abs(kept).max() < 1e-14 and arriving.min() < -1e-7
            # Moreau's law, which assumes neither what presses nor what slides which way.
            released = [c for c in before.contacts if c not in after.contacts]
            collision = collide(Formation(after.scene, (*after.contacts, *released)), z, v)
            assert impact.possible == (chain is rough and join in rough.impacts[:2])
            rates, parting = np.split(collision.rates, [after.n_contacts])
            if impact.possible:
                np.testing.assert_allclose(collision.v, impact.v, rtol=0, atol=1e-12)
                np.testing.assert_allclose(collision.normal[:-1], impact.p, rtol=0, atol=1e-12)
                assert (parting > 0.1).all()
            else:
                # What would have to pull is let go.
                assert rates[after.names.index(impact.least_impulse[0])] > 0.01
                assert not np.allclose(collision.v, impact.v, atol=0.1)


def test_what_would_have_to_pull_is_named() -> None:
    tipping = chain_of(HEPTAGON)
    impact = tipping.impacts[0].impact
    assert impact.least_impulse == ("v1-palm", float(impact.p[1]))
    first = impact.violations[0]
    assert (first.kind, first.name, first.value) == (ViolationKind.PULL, *impact.least_impulse)
    assert tipping.impacts[0].reason == "impulse on v1-palm would be -0.0414 N s per m/s"
    assert first.describe() == "impulse on v1-palm would be -0.0414 N s"


def test_random_impacts_never_gain_energy() -> None:
    rng = np.random.default_rng(5)
    scene = plane.make_scene(friction=0.3)
    names = ["v0-palm", "v1-palm", "v2-finger1", "v3-finger2"]
    formations = [plane.make_formation(scene, " ".join(three)) for three in permutations(names, 3)]
    possible = 0
    for number in range(200):
        formation = formations[number % len(formations)]
        z = np.array([0.0, 0.03, 0.0, 1.2, 1.9]) + rng.normal(scale=0.02, size=5)
        v = rng.normal(size=5) * [0.3, 0.3, 3.0, 3.0, 3.0]
        impact = compute_impact(formation, formation, z, v)
        sound = not {h.kind for h in impact.violations} & {ViolationKind.JAM, ViolationKind.HELD}
        if sound:
            check_momenta(impact, z, v)
            slips = plane.measure_slip(formation, z, impact.v)
            assert (impact.Xi * slips >= -1e-9).all()
        else:
            # No directions of sliding agree with the velocities that they lead to.
            at = formation.evaluate(z[None], v[None])
            for Xi in map(np.array, product((1.0, -1.0), repeat=3)):
                G = at.A[0] - (formation.friction * Xi)[:, None] * at.A_t[0]
                after, _ = solve_impulses(scene.mass_diagonal, at.A[0], G, v)
                jams = reduced_inertia(formation, at, Directions(Xi, np.ones(2)))[0] <= 0
                assert jams or (Xi * (at.A_t[0] @ after) < 0).any()
        if sound and impact.p.min() >= 0:
            possible += 1
            assert impact.v**2 @ scene.mass_diagonal <= v**2 @ scene.mass_diagonal
    assert possible > 5


# A square that comes down on its right lower corner, r away from its centroid: one impulse.


def drop(v: Array, friction: float, lean: float = 0.3) -> tuple[Impact, Array, Scene]:
    """Impact of corner 1 on the palm, and r; the square is turned by `lean`."""
    scene, r = plane.make_scene(friction=friction), plane.rotate(lean, [0.03, -0.03])
    formation = plane.make_formation(scene, "v1-palm")
    z = np.array([0.0, -r[1], lean, 0.5, 2.6])
    assert abs(plane.measure_gaps(formation, z)[0]) < 1e-13
    return compute_impact(formation, formation, z, v), r, scene


@pytest.mark.parametrize("friction", [0.0, 0.2, 0.5])
@pytest.mark.parametrize("slide", [-2.0, 2.0])
def test_a_corner_dropped_on_the_palm(friction: float, slide: float) -> None:
    v = np.array([slide, -0.4, 1.5, 0.0, 0.0])
    impact, r, scene = drop(v, friction)
    inertia = scene.mass_diagonal[2]
    way = np.sign(slide)
    # The impulse (-mu way p, p) at r stops the corner's fall v_y + r_x omega.
    fall = v[1] + r[0] * v[2]
    p = -fall / (1 / MASS + r[0] * (r[0] + friction * way * r[1]) / inertia)
    assert p > 0 and impact.possible
    assert impact.least_impulse[0] == "v1-palm" and impact.least_impulse[1] == pytest.approx(p)
    spin = v[2] + (r[0] * p + r[1] * friction * way * p) / inertia
    expected = [v[0] - friction * way * p / MASS, v[1] + p / MASS, spin, 0.0, 0.0]
    np.testing.assert_allclose(impact.v, expected, rtol=0, atol=1e-12)


def test_friction_that_would_hold_is_no_sliding() -> None:
    v = np.array([0.01, -0.4, 0.0, 0.0, 0.0])
    impact, _, _ = drop(v, 0.8, lean=0.7)
    assert not impact.possible
    assert impact.violations[0].describe() == "friction would hold v1-palm"
    collision = collide(impact.formation, np.array([0.0, 0.0, 0.7, 0.5, 2.6]), v)
    assert abs(collision.slips[0]) < 1e-12 and collision.normal[0] > 0


@pytest.mark.parametrize("friction", [0.3, 3.0])
def test_a_corner_that_rolls(friction: float) -> None:
    """It is caught like a hinge if friction can hold it: angular momentum about it is kept."""
    v, lean = np.array([0.2, -0.4, 0.0, 0.0, 0.0]), 0.7
    _, r, scene = drop(v, friction, lean)
    sliding = plane.make_formation(scene, "v1-palm")
    rolling = Formation(scene, sliding.contacts, sliding.contacts)
    z = np.array([0.0, -r[1], lean, 0.5, 2.6])
    impact = compute_impact(sliding, rolling, z, v)
    inertia = scene.mass_diagonal[2]
    spin = -MASS * float(plane.cross(r, v[:2])) / (inertia + MASS * r @ r)
    expected = np.array([spin * r[1], -spin * r[0], spin, 0.0, 0.0])
    np.testing.assert_allclose(impact.v, expected, rtol=0, atol=1e-12)
    tangential, normal = MASS * (expected[:2] - v[:2])
    np.testing.assert_allclose(impact.p, [normal, tangential], rtol=0, atol=1e-12)
    beyond = abs(tangential) - friction * normal
    assert impact.possible == (beyond <= 0) == (friction == 3.0)
    collision = collide(sliding, z, v)
    if impact.possible:
        np.testing.assert_allclose(collision.v, impact.v, rtol=0, atol=1e-12)
    else:
        assert abs(collision.slips[0]) > 1e-3
        text = f"v1-palm would slip, {beyond:.3g} N s beyond its friction cone"
        assert impact.violations[0].describe() == text


def test_jamming_is_named() -> None:
    """As Painleve's rod: r_x (r_x + mu r_y) / inertia below -1 / mass."""
    impact, r, scene = drop(np.array([2.0, -0.4, 0.0, 0.0, 0.0]), 10.0, lean=0.3)
    inertia = scene.mass_diagonal[2]
    ratio = 1 + r[0] * 10.0 * r[1] / inertia / (1 / MASS + r[0] ** 2 / inertia)
    assert ratio < 0 and impact.violations[0].kind is ViolationKind.JAM
    assert impact.violations[0].value == pytest.approx(ratio)
    assert impact.violations[0].describe().startswith("v1-palm would jam, with -")
    assert np.isnan(impact.v).all() and np.isnan(impact.p).all()


def test_what_touches_must_not_be_driven_into() -> None:
    """A square flush on the palm cannot turn about its right corner into the palm."""
    scene = plane.make_scene(plane.SQUARE)
    both = ("v0-palm v1-palm", "v1-palm")
    flush, corner = (plane.make_formation(scene, names) for names in both)
    z = np.array([0.0, 0.03, 0.0, 0.5, 2.6])
    for spin in (-2.0, 2.0):
        v = np.array([0.5, -0.03 * spin, spin, 0.0, 0.0])
        impact = compute_impact(flush, corner, z, v)
        rate = float(plane.measure_gaps(flush, z + 1e-6 * impact.v)[0]) / 1e-6
        closing = [h for h in impact.violations if h.kind is ViolationKind.CLOSING]
        assert impact.possible == (spin < 0) == (rate > 0)
        if spin > 0:
            # Given up by name, or found among the formation's limits.
            assert [h.value for h in closing] == pytest.approx([rate], rel=1e-4)
            assert closing[0].describe().startswith("v0-palm would not part, at ")
            again = compute_impact(corner, corner, z, v)
            assert again.violations[0].describe() == "v0 touches the palm, at 0.12 m/s"


# Curves that impacts join.


def test_paces_make_the_speed_continuous() -> None:
    """A velocity of z_s on one curve becomes z_s on the next."""
    part = chain_of(IMPACTS).split()[0]
    curves = part.continuous_curves
    assert curves[0].speed_ratio == 1.0
    for join, (before, after) in zip(part.impacts, pairwise(curves), strict=True):
        v = before.evaluate(np.array([before.length])).z_s[0]
        v_after = after.evaluate(np.zeros(1)).z_s[0]
        impulses = before.speed_ratio * join.impact.p
        check_momenta(replace(join.impact, v=v_after, p=impulses), before.end, v)


def test_a_curve_at_another_pace() -> None:
    curve = chain_of(IMPACTS).curves[2]
    fast = curve.with_speed_ratio(2.5)
    assert fast.length == pytest.approx(curve.length / 2.5, rel=1e-13)
    np.testing.assert_allclose(fast.end, curve.end, rtol=0, atol=1e-14)
    assert [g.stop for g in fast.segments] == pytest.approx([g.stop / 2.5 for g in curve.segments])
    s, h = np.linspace(0.1, 0.9, 9) * fast.length, 1e-5 * fast.length
    before, here, after = (fast.evaluate(s + k * h) for k in (-1, 0, 1))
    scale = 2.5 / curve.formation.scene.polygon.gyration_radius
    np.testing.assert_allclose((after.z - before.z) / (2 * h), here.z_s, atol=1e-6 * scale)
    np.testing.assert_allclose((after.z_s - before.z_s) / (2 * h), here.z_ss, atol=1e-5 * scale**2)
    assert fast.with_speed_ratio(1.0).length == pytest.approx(curve.length, rel=1e-13)


@pytest.mark.parametrize("skew", [0.0, 1.0])
def test_positive_semidefinite_problems_are_solved(skew: float) -> None:
    # With degenerate solutions, singular matrices and ties, as contacts of flush edges make them.
    rng = np.random.default_rng(3)
    for _ in range(150):
        n = int(rng.integers(1, 13))
        root = rng.normal(size=(n, int(rng.integers(1, n + 1))))
        turn = skew * rng.normal(size=(n, n))
        M = root @ root.T + turn - turn.T
        z = np.maximum(rng.normal(size=n), 0)
        w = np.where(z > 0, 0.0, np.maximum(rng.normal(size=n), 0))
        found, residual = complementarity.solve_lcp(M, w - M @ z)
        slack, rounding = M @ (found - z) + w, 1e-9 * np.abs(M).sum()
        assert residual < rounding
        assert found.min() >= 0 and slack.min() >= -rounding
        assert np.minimum(found, slack) == pytest.approx(0.0, abs=rounding)


def test_ties_do_not_cycle() -> None:
    # Every row falls as much as every other.
    n = 8
    M = np.ones((n, n)) + np.triu(np.ones((n, n)), 1)
    _, residual = complementarity.solve_lcp(M, -np.ones(n))
    assert residual < 1e-12


def draw(rng: np.random.Generator, mu: float) -> complementarity.ContactProblem:
    """Three contacts, the first two of which may stick, and a joint, on five coordinates."""
    A, A_t = rng.normal(size=(2, 3, 5))
    G, T = A.copy(), np.vstack([A_t[:2], np.eye(5)[3]])
    G[2] -= mu * rng.choice([-1.0, 1.0]) * A_t[2]
    lift, (b_n, b_t) = rng.uniform(0.5, 2.0, 5), rng.normal(size=(2, 3))
    bounds = np.array([mu, mu, 0.0]), np.array([0.0, 0.0, 0.3])
    return complementarity.ContactProblem(lift, A, G, b_n, T, b_t, np.array([0, 1, -1]), *bounds)


def check(p: complementarity.ContactProblem, answer: complementarity.ContactSolution) -> None:
    """Coulomb's law and complementarity, from the forces alone."""
    change = p.inverse_mass * (p.G.T @ answer.c_n + p.T.T @ answer.f)
    r_n, r_t = p.b_n + p.A @ change, p.b_t + p.T @ change
    assert answer.c_n.min() >= 0 and r_n.min() > -1e-9
    assert answer.c_n * r_n == pytest.approx(np.zeros(3), abs=1e-8)
    most = p.bound + p.mu * np.append(answer.c_n[:2], 0.0)
    assert (np.abs(answer.f) <= most + 1e-9).all()
    for force, rate, bound in zip(answer.f, r_t, most, strict=True):
        assert abs(rate) < 1e-8 or force == pytest.approx(-bound * np.sign(rate), abs=1e-8)


def test_lemke_finds_one_of_all_answers() -> None:
    rng = np.random.default_rng(5)
    for _ in range(40):
        problem = draw(rng, 0.15)
        one, every = complementarity.solve_problem(problem), complementarity.list_solutions(problem)
        assert one is not None and every
        check(problem, one)
        for answer in every:
            check(problem, answer)
        assert min(np.abs(one.change - a.change).max() for a in every) < 1e-8


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


@pytest.mark.parametrize("index, share", [(0, 0.9), (2, 0.4)])
def test_forces_are_unique_where_all_minors_are_positive(index: int, share: float) -> None:
    """The box on palms of other friction, in the middle of a phase."""
    for mu in (0.1, 0.3, 0.5):
        curve = trace_phases(problem_of(BOX).with_(friction_palm=mu))[index]
        formation, Xi = curve.formation, curve.segments[-1].Xi
        kinematics = curve.evaluate(np.array([share * curve.length])).kinematics
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
    scene = plane.make_scene([[-0.05, -1e-4], [0.05, -1e-4], [0.05, 1e-4], [-0.05, 1e-4]], base=0.6)
    for slope, mu in product((0.4, 1.0, 1.3), (0.5, 2.0)):
        other = Scene(scene.polygon, scene.fingers, Friction(mu, 0.1, 0.1))
        formation = plane.make_formation(other, "v1-palm")
        arm, height = plane.rotate(-slope, [0.05, -1e-4])
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
        plan_curves(Task(trace_phases(rough)[:1], rough.epsilon, PlanOptions(), (1,)), False)
    with pytest.raises(InputError, match=r"uniqueness_margin: 1\.0 given; allowed"):
        plan(rough, uniqueness_margin=1.0)


def test_replays_tell_the_uniqueness_margin_of_each_phase() -> None:
    report = verified(BOX)
    minors = [phase.uniqueness_margin for phase in report.phases]
    assert report.ok and all(minor is not None and 0.1 < minor.value < 1 for minor in minors)
    planned = [own["value"] for own in tipped().meta["uniqueness_margins"]]
    found = [minor.value for minor in minors if minor is not None]
    np.testing.assert_allclose(found, planned, atol=5e-3)
    strict = verify(box(), tipped(), uniqueness_margin=0.9)
    assert not strict.ok and strict.failures[0].startswith("ambiguous: ")
    for phase, least in zip(box().phases, planned, strict=True):
        rows, within = np.flatnonzero(tipped().phase == phase.index), tipped().c_t.copy()
        within[rows[[0, 80]]] *= 0.5  # in their cones: at rest that is indeterminate
        other = replace(tipped(), c_t=within)
        margins = [find_uniqueness_margin(phase, other, part) for part in (rows[:80], rows[80:])]
        assert margins[0] and margins[1] and margins[0].value >= least > margins[1].value


@pytest.mark.parametrize("path", [BOX, IMPACTS], ids=lambda path: path.stem)
def test_torques_that_friction_can_hold_are_those_of_the_linear_programme(path: Path) -> None:
    problem = problem_of(path)
    rng, scene = np.random.default_rng(5), problem.scene
    for curve in trace_phases(problem)[::2]:
        static = Statics(curve.formation, curve.start).torque_polygon()
        tau = rng.uniform(-1.0, 1.0, (12, 2)) * scene.torque_limit
        for own, beyond in zip(tau, static.measure(tau), strict=True):
            if abs(beyond) > 1e-4 * scene.scales.torque:
                assert balances(curve.formation, curve.start, own) == (beyond < 0)
                assert beyond > 0 or not static.is_empty(np.abs(own))
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
    wedged = find_stuck(problem, phase, replace(plan, torque=torque), 1e-9)
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


def test_a_finger_that_would_have_to_pull_is_named() -> None:
    """All contacts of the flip would have to press with twenty times the weight."""
    problem = landing()
    start = trace_phases(problem)[-1].end
    feeble = problem.with_(epsilon=40.0)
    with pytest.raises(InfeasibleError, match="no motion begins in any contact mode: c_n of v"):
        plan_phases(feeble, feeble.phases[4:], start, COARSE, thorough=False)
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
        plan_phases(problem, problem.phases, problem.start, COARSE, thorough=False)
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
    own, scaled = in_scene_units(problem), z / unit_lengths(problem.scene.scales)
    while high - low > 1e-3:
        middle = (low + high) / 2
        held = Statics(own.phases[phase].formation, scaled).find_block(middle, ends)
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
    assert abs(other.gap[0]) < 1e-9 and rest_margin(problem.scene, lifted, 1e3, z) < 0.0
