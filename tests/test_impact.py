from __future__ import annotations

from dataclasses import replace
from itertools import permutations, product
from pathlib import Path

import numpy as np
import pytest

from moreau import collide
from plane import SQUARE, cross, make_formation, make_scene, measure_gaps, measure_slip, touch
from shipped import HEPTAGON, IMPACTS
from wholearm.common.arrays import Array
from wholearm.contacts.formation import Formation
from wholearm.geometry.path_guess import load
from wholearm.geometry.tracing import trace_phases
from wholearm.mechanics.impact import Impact, ViolationKind, compute_impact, solve_impulses
from wholearm.planning.path_domain.impact_sequence import ImpactSequence, make_sequence
from wholearm.scene.model import Friction, Scene

MASS = 0.2


def chain_of(path: Path) -> ImpactSequence:
    problem = load(str(path))
    return make_sequence(problem.phases, trace_phases(problem))


@pytest.fixture(scope="module")
def rough() -> ImpactSequence:
    """With a rough right finger: two impacts that are possible, and two that are not."""
    return chain_of(IMPACTS)


@pytest.fixture(scope="module")
def tipping() -> ImpactSequence:
    """With four that are not."""
    return chain_of(HEPTAGON)


def arrivals(chain: ImpactSequence) -> list[tuple[Formation, Formation, Array, Array]]:
    """Formations before and after every impact, configuration, and velocity before."""
    found = []
    for before, after in zip(chain.curves[:-1], chain.curves[1:], strict=True):
        point = before.evaluate(np.array([before.length]))
        found.append((before.formation, after.formation, after.start, point.z_s[0]))
    return found


def frictionless(formation: Formation) -> Formation:
    scene = formation.scene
    smooth = Scene(scene.polygon, scene.fingers, Friction(0.0, 0.0, 0.0), scene.gravity)
    return Formation(smooth, formation.contacts)


def check_momenta(impact: Impact, z: Array, before: Array) -> None:
    """Momentum of each body changes by the impulses at its contact points."""
    formation = impact.formation
    scene, change = formation.scene, impact.v - before
    body = scene.polygon
    assert body.inertia is not None
    push, turn = np.zeros(2), 0.0
    joints = np.zeros(2)
    for k, (contact, point, n) in enumerate(
        zip(formation.contacts, *touch(formation, z), strict=True)
    ):
        along = np.array([n[1], -n[0]])
        slip = float(measure_slip(formation, z, impact.v)[k])
        impulse = impact.p[k] * (n - formation.friction[k] * np.sign(slip) * along)
        push += impulse
        turn += float(cross(point - z[:2], impulse))
        if contact.finger is not None:
            base = np.asarray(scene.fingers[contact.finger].base)
            joints[contact.finger] -= float(cross(point - base, impulse))
    np.testing.assert_allclose(body.mass * change[:2], push, rtol=0, atol=1e-12)
    assert body.inertia * change[2] == pytest.approx(turn, abs=1e-12)
    inertias = np.array([finger.inertia for finger in scene.fingers])
    np.testing.assert_allclose(inertias * change[3:], joints, rtol=0, atol=1e-12)


def energy_of(scene: Scene, v: Array) -> float:
    return float(0.5 * v**2 @ scene.mass_diagonal)


def test_each_body_takes_its_impulses(rough: ImpactSequence, tipping: ImpactSequence) -> None:
    for chain in (rough, tipping):
        for join, (before, after, z, v) in zip(chain.impacts, arrivals(chain), strict=True):
            impact = compute_impact(before, after, z, v)
            np.testing.assert_array_equal(impact.v, join.impact.v)
            check_momenta(impact, z, v)


def test_every_contact_is_kept_afterwards(rough: ImpactSequence) -> None:
    for before, after, z, v in arrivals(rough):
        v_after, h = compute_impact(before, after, z, v).v, 1e-6
        rates = (measure_gaps(after, z + h * v_after) - measure_gaps(after, z - h * v_after)) / h
        assert np.abs(rates).max() < 1e-8
        arriving = measure_gaps(after, z + h * v) - measure_gaps(after, z - h * v)
        assert arriving.min() < -0.1 * h


@pytest.mark.parametrize("index", range(4))
def test_complementarity_gives_the_same(
    rough: ImpactSequence, tipping: ImpactSequence, index: int
) -> None:
    """Moreau's law, which assumes neither what presses nor what slides which way."""
    for chain in (rough, tipping):
        before, after, z, v = arrivals(chain)[index]
        released = [c for c in before.contacts if c not in after.contacts]
        every = Formation(after.scene, (*after.contacts, *released))
        collision, impact = collide(every, z, v), compute_impact(before, after, z, v)
        assert impact.possible == (chain is rough and index < 2)
        kept, parting = np.split(collision.rates, [after.n_contacts])
        if impact.possible:
            np.testing.assert_allclose(collision.v, impact.v, rtol=0, atol=1e-12)
            np.testing.assert_allclose(collision.normal[:-1], impact.p, rtol=0, atol=1e-12)
            assert (parting > 0.1).all()
        else:
            # What would have to pull is let go.
            assert kept[after.names.index(impact.least[0])] > 0.01
            assert not np.allclose(collision.v, impact.v, atol=0.1)


def test_what_would_have_to_pull_is_named(tipping: ImpactSequence) -> None:
    impact = tipping.impacts[0].impact
    assert impact.least == ("v1-palm", float(impact.p[1]))
    first = impact.violations[0]
    assert (first.kind, first.name, first.value) == (ViolationKind.PULL, *impact.least)
    assert tipping.impacts[0].reason == "impulse on v1-palm would be -0.0414 N s per m/s"
    assert first.describe() == "impulse on v1-palm would be -0.0414 N s"


def test_energy_goes_into_the_jump_and_into_sliding(
    rough: ImpactSequence, tipping: ImpactSequence
) -> None:
    for chain in (rough, tipping):
        for before, after, z, v in arrivals(chain):
            impact = compute_impact(before, after, z, v)
            jump = energy_of(after.scene, impact.v - v)
            slid = after.friction * impact.p @ np.abs(measure_slip(after, z, impact.v))
            lost = energy_of(after.scene, v) - energy_of(after.scene, impact.v)
            assert lost == pytest.approx(jump + slid, rel=1e-9)
            assert lost > 0 or not impact.possible


def test_random_impacts_never_gain_energy() -> None:
    rng = np.random.default_rng(5)
    scene = make_scene(SQUARE, friction=0.3)
    names = ["v0-palm", "v1-palm", "v2-finger1", "v3-finger2"]
    formations = [make_formation(scene, " ".join(three)) for three in permutations(names, 3)]
    possible = 0
    for number in range(200):
        formation = formations[number % len(formations)]
        z = np.array([0.0, 0.03, 0.0, 1.2, 1.9]) + rng.normal(scale=0.02, size=5)
        v = rng.normal(size=5) * [0.3, 0.3, 3.0, 3.0, 3.0]
        impact = compute_impact(formation, formation, z, v)
        sound = not {h.kind for h in impact.violations} & {ViolationKind.JAM, ViolationKind.HELD}
        if sound:
            check_momenta(impact, z, v)
            slips = measure_slip(formation, z, impact.v)
            assert (impact.Xi * slips >= -1e-9).all()
        if sound and impact.p.min() >= 0:
            possible += 1
            assert energy_of(scene, impact.v) <= energy_of(scene, v)
    assert possible > 5


def test_without_friction_it_is_the_nearest_velocity(rough: ImpactSequence) -> None:
    rng = np.random.default_rng(8)
    for before, after, z, v in arrivals(rough):
        impact = compute_impact(before, frictionless(after), z, v)
        A = after.evaluate(z[None], v[None]).A[0]
        tangents = np.linalg.svd(A)[2][len(A) :].T
        root = np.sqrt(after.scene.mass_diagonal)
        nearest = tangents @ np.linalg.lstsq(root[:, None] * tangents, root * v, rcond=None)[0]
        np.testing.assert_allclose(impact.v, nearest, rtol=0, atol=1e-12)
        least = energy_of(after.scene, impact.v - v)
        for _ in range(20):
            other = impact.v + tangents @ rng.normal(size=tangents.shape[1])
            assert energy_of(after.scene, other - v) > least


# A square that comes down on its right lower corner, r away from its centroid: one impulse.


def drop(v: Array, friction: float, lean: float = 0.3) -> tuple[Impact, Array, Scene]:
    """Impact of corner 1 on the palm, and r; the square is turned by `lean`."""
    scene = make_scene(SQUARE, friction=friction)
    c, s = np.cos(lean), np.sin(lean)
    r = np.array([0.03 * c + 0.03 * s, 0.03 * s - 0.03 * c])
    formation = make_formation(scene, "v1-palm")
    z = np.array([0.0, -r[1], lean, 0.5, 2.6])
    assert abs(measure_gaps(formation, z)[0]) < 1e-13
    return compute_impact(formation, formation, z, v), r, scene


@pytest.mark.parametrize("friction", [0.0, 0.2, 0.5])
@pytest.mark.parametrize("slide", [-2.0, 2.0])
def test_a_corner_dropped_on_the_palm(friction: float, slide: float) -> None:
    v = np.array([slide, -0.4, 1.5, 0.0, 0.0])
    impact, r, scene = drop(v, friction)
    inertia = scene.polygon.inertia
    assert inertia is not None and scene.polygon.mass == pytest.approx(MASS)
    way = np.sign(slide)
    # The impulse (-mu way p, p) at r stops the corner's fall v_y + r_x omega.
    fall = v[1] + r[0] * v[2]
    p = -fall / (1 / MASS + r[0] * (r[0] + friction * way * r[1]) / inertia)
    assert p > 0 and impact.possible
    assert impact.least[0] == "v1-palm" and impact.least[1] == pytest.approx(p)
    spin = v[2] + (r[0] * p + r[1] * friction * way * p) / inertia
    expected = [v[0] - friction * way * p / MASS, v[1] + p / MASS, spin, 0.0, 0.0]
    np.testing.assert_allclose(impact.v, expected, rtol=0, atol=1e-12)


def test_friction_that_would_hold_is_no_sliding() -> None:
    impact, _, _ = drop(np.array([0.01, -0.4, 0.0, 0.0, 0.0]), 0.8, lean=0.7)
    assert not impact.possible
    assert impact.violations[0].describe() == "friction would hold v1-palm"
    formation, z = impact.formation, np.array([0.0, 0.0, 0.7, 0.5, 2.6])
    collision = collide(formation, z, np.array([0.01, -0.4, 0.0, 0.0, 0.0]))
    assert abs(collision.slips[0]) < 1e-12 and collision.normal[0] > 0


@pytest.mark.parametrize("friction", [0.3, 3.0])
def test_a_corner_that_rolls(friction: float) -> None:
    """It is caught like a hinge if friction can hold it: angular momentum about it is kept."""
    v, lean = np.array([0.2, -0.4, 0.0, 0.0, 0.0]), 0.7
    _, r, scene = drop(v, friction, lean)
    sliding = make_formation(scene, "v1-palm")
    rolling = Formation(scene, sliding.contacts, sliding.contacts)
    z = np.array([0.0, -r[1], lean, 0.5, 2.6])
    impact = compute_impact(sliding, rolling, z, v)
    inertia = scene.polygon.inertia
    assert inertia is not None
    spin = -MASS * float(cross(r, v[:2])) / (inertia + MASS * r @ r)
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
    assert scene.polygon.inertia is not None
    ratio = 1 + r[0] * 10.0 * r[1] / scene.polygon.inertia / (
        1 / MASS + r[0] ** 2 / scene.polygon.inertia
    )
    assert ratio < 0 and impact.violations[0].kind is ViolationKind.JAM
    assert impact.violations[0].value == pytest.approx(ratio)
    assert impact.violations[0].describe().startswith("v1-palm would jam, with -")
    assert np.isnan(impact.v).all() and np.isnan(impact.p).all()


def test_what_touches_must_not_be_driven_into() -> None:
    """A square flush on the palm cannot turn about its right corner into the palm."""
    scene = make_scene(SQUARE)
    flush, corner = make_formation(scene, "v0-palm v1-palm"), make_formation(scene, "v1-palm")
    z = np.array([0.0, 0.03, 0.0, 0.5, 2.6])
    for spin in (-2.0, 2.0):
        impact = compute_impact(flush, corner, z, np.array([0.5, -0.03 * spin, spin, 0.0, 0.0]))
        rate = float(measure_gaps(flush, z + 1e-6 * impact.v)[0]) / 1e-6
        closing = [h for h in impact.violations if h.kind is ViolationKind.CLOSING]
        assert impact.possible == (spin < 0) == (rate > 0)
        if spin > 0:
            # Given up by name, or found among the formation's limits.
            assert [h.value for h in closing] == pytest.approx([rate], rel=1e-4)
            assert closing[0].describe().startswith("v0-palm would not part, at ")
            again = compute_impact(corner, corner, z, np.array([0.5, -0.03 * spin, spin, 0.0, 0.0]))
            assert again.violations[0].describe() == "v0 touches the palm, at 0.12 m/s"


def test_the_sliding_directions_are_found_among_all(rough: ImpactSequence) -> None:
    """Every choice by brute force: the one taken is consistent, and no other one only presses."""
    for before, after, z, v in arrivals(rough):
        A, A_t = (part[0] for part in after.evaluate(z[None], v[None])[1:3])
        found = []
        for signs in product((1.0, -1.0), repeat=4):
            G = A - (after.friction * np.array(signs))[:, None] * A_t
            v_after, p = solve_impulses(after.scene.mass_diagonal, A, G, v)
            if (np.array(signs) * (A_t @ v_after) >= 0).all():
                found.append((signs, p))
        impact = compute_impact(before, after, z, v)
        assert tuple(impact.Xi) in [signs for signs, _ in found]
        assert len([p for _, p in found if p.min() >= 0]) == impact.possible


# Curves that impacts join.


def test_paces_make_the_speed_continuous(rough: ImpactSequence) -> None:
    """A velocity of z_s on one curve becomes z_s on the next."""
    part = rough.split()[0]
    continuous_curves = part.continuous_curves
    assert continuous_curves[0].speed_ratio == 1.0
    for join, before, after in zip(
        part.impacts, continuous_curves[:-1], continuous_curves[1:], strict=True
    ):
        v = before.evaluate(np.array([before.length])).z_s[0]
        v_after = after.evaluate(np.zeros(1)).z_s[0]
        check_momenta(
            replace(join.impact, v=v_after, p=before.speed_ratio * join.impact.p), before.end, v
        )


def test_a_curve_at_another_pace(rough: ImpactSequence) -> None:
    curve = rough.curves[2]
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
