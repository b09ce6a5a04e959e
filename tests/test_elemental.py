from __future__ import annotations

from dataclasses import replace
from typing import Any

import casadi as ca
import numpy as np
import pytest

from plane import (
    SQUARE,
    cross,
    make_formation,
    make_scene,
    nearest_on_segment,
    place_corners,
    place_tips,
    point_to_segment,
    rotate,
)
from tipping import roll
from wholearm.common.arrays import Array
from wholearm.common.errors import InputError
from wholearm.contacts.cones import find_weakest, force_limit_rows, slip_margins
from wholearm.contacts.elemental import Contact, build_features, candidate_contacts, parse_contact
from wholearm.contacts.formation import Formation, build_slip
from wholearm.scene.model import Friction, Scene

KITE = [[-0.04, -0.03], [0.02, -0.035], [0.045, 0.01], [0.0, 0.05], [-0.045, 0.02]]
NAMES = ["v3-palm", "v2-finger1", "v4-finger2", "e1-tip1", "e3-tip2", "v2-tip1", "v4-tip2"]
STEP = 1e-6
# Central differences: rounding 1e-16 / STEP, truncation STEP^2.
DIFFERENCE = 1e-9


@pytest.fixture(scope="module")
def scene() -> Scene:
    return make_scene(KITE)


def configurations(seed: int, count: int = 20) -> Array:
    """Random z, on no contact's manifold."""
    rng = np.random.default_rng(seed)
    low, high = [-0.1, 0.02, -3.0, 0.3, 0.3], [0.1, 0.15, 3.0, 2.8, 2.8]
    return np.asarray(rng.uniform(low, high, (count, 5)))


def measure_gap(scene: Scene, contact: Contact, z: Array) -> tuple[float, Array, Array]:
    """Signed gap, closest point of the object, and normal into it, by plain geometry."""
    corners = place_corners(scene, z)
    corner = corners[contact.index]
    if contact.finger is None:
        return float(corner[1]), corner, np.array([0.0, 1.0])
    link = scene.fingers[contact.finger]
    base, tip = np.asarray(link.base), place_tips(scene, contact.finger, z[3 + contact.finger])
    if contact.surface == "finger":
        axis = (tip - base) / link.length
        normal = np.array([-axis[1], axis[0]]) * (1 if contact.finger == 0 else -1)
        # Far ends, so that the foot of the perpendicular is on the segment.
        distance = float(point_to_segment(corner, base - 9 * axis, tip + 9 * axis))
        side = np.sign(normal @ (corner - base))
        return float(side * distance - link.radius), corner, normal
    if contact.feature == "e":
        after = corners[(contact.index + 1) % len(corners)]
        run = after - corner
        normal = np.array([-run[1], run[0]]) / np.hypot(*run)
        point = nearest_on_segment(tip, corner - 9 * run, after + 9 * run)
        side = np.sign(cross(run, corner - tip))
        return float(side * np.hypot(*(tip - point)) - link.radius), point, normal
    away = corner - tip
    return float(np.hypot(*away) - link.radius), corner, away / np.hypot(*away)


@pytest.mark.parametrize("name", NAMES)
def test_gap_is_the_distance_measured(scene: Scene, name: str) -> None:
    formation = make_formation(scene, name)
    z = configurations(1)
    gaps = formation.evaluate(z, z).C[:, 0]
    measured = [measure_gap(scene, formation.contacts[0], point)[0] for point in z]
    np.testing.assert_allclose(gaps, measured, atol=1e-14)
    assert {-1.0, 1.0} >= set(np.sign(gaps)) and np.ptp(gaps) > 0.01


@pytest.mark.parametrize("name", NAMES)
def test_rows_are_the_derivatives_of_the_gap(scene: Scene, name: str) -> None:
    formation = make_formation(scene, name)
    z = configurations(2)
    A = formation.evaluate(z, z).A[:, 0]
    for k, unit in enumerate(STEP * np.eye(5)):
        rise = formation.evaluate(z + unit, z).C - formation.evaluate(z - unit, z).C
        np.testing.assert_allclose(A[:, k], rise[:, 0] / (2 * STEP), atol=DIFFERENCE)


@pytest.mark.parametrize("name", NAMES)
def test_velocities_at_the_contact_point(scene: Scene, name: str) -> None:
    """A v and A_t v are the relative velocity of two material points, differenced in time."""
    formation = make_formation(scene, name)
    contact = formation.contacts[0]
    rng = np.random.default_rng(3)
    for z in configurations(3, 8):
        gap, _, normal = measure_gap(scene, contact, z)
        z[:2] -= gap * normal
        gap, point, normal = measure_gap(scene, contact, z)
        assert abs(gap) < 1e-15
        v = rng.uniform(-1, 1, 5)
        on_object = rotate(-z[2], point - z[:2])

        def separate(
            moved: Array, point: Array = point, start: Array = z, body: Array = on_object
        ) -> Array:
            world = moved[:2] + rotate(moved[2], body)
            if contact.finger is None:
                return np.asarray(world - point)
            base = np.asarray(scene.fingers[contact.finger].base)
            k = 3 + contact.finger
            return np.asarray(world - base - rotate(moved[k] - start[k], point - base))

        velocity = (separate(z + STEP * v) - separate(z - STEP * v)) / (2 * STEP)
        kinematics = formation.evaluate(z[None], v[None])
        tangent = np.array([normal[1], -normal[0]])
        assert kinematics.A[0, 0] @ v == pytest.approx(normal @ velocity, abs=DIFFERENCE)
        assert kinematics.A_t[0, 0] @ v == pytest.approx(tangent @ velocity, abs=DIFFERENCE)


@pytest.mark.parametrize("name", NAMES)
def test_second_derivative_term(scene: Scene, name: str) -> None:
    formation = make_formation(scene, name)
    z = configurations(5)
    v = np.random.default_rng(5).uniform(-1, 1, z.shape)
    rise = formation.evaluate(z + STEP * v, v).A - formation.evaluate(z - STEP * v, v).A
    expected = np.einsum("nij,nj->ni", rise / (2 * STEP), v)
    np.testing.assert_allclose(formation.evaluate(z, v).A_dot_v, expected, atol=DIFFERENCE)


def test_names_round_trip(scene: Scene) -> None:
    contacts = [c for part in (None, 0, 1) for c in candidate_contacts(scene, part)]
    assert len(set(contacts)) == 5 + 2 * 15
    assert [parse_contact(contact.name, scene) for contact in contacts] == contacts
    assert [str(contact) for contact in contacts] == [contact.name for contact in contacts]


@pytest.mark.parametrize(
    "name",
    [
        *("v5-palm", "e5-tip1", "e0-palm", "e1-finger1", "v1-finger3", "v1-tip0", "v1", "x1-palm"),
        *("v1-palm1", "v-1-palm", "V1-palm", " v1-palm", "v1-palm\n", "v\u0661-palm", "v01-palm"),
        *("v1-finger", "", None, 7, ["v1-palm"], True),
    ],
)
def test_bad_name_lists_what_is_allowed(scene: Scene, name: Any) -> None:
    with pytest.raises(InputError, match="allowed are vN-palm") as caught:
        parse_contact(name, scene)
    assert repr(name) in caught.value.problem and "0 to 4" in caught.value.problem


def test_pointed_tip_has_no_arc() -> None:
    pointed = make_scene(KITE, radius=0.0)
    assert len(candidate_contacts(pointed, 0)) == 10
    with pytest.raises(InputError, match=r"fingers\.1\.radius is 0"):
        parse_contact("v1-tip1", pointed)


@pytest.mark.parametrize("name", NAMES)
def test_slip_coordinate_integrates_the_sliding_velocity(scene: Scene, name: str) -> None:
    """Where a contact touches, the gradient of its slip is A_t, by derivative and difference."""
    formation = make_formation(scene, name)
    slip, z_symbol = build_slip(formation.contacts[0], scene), build_features(scene).z
    function = ca.Function("slip", [z_symbol], [slip, ca.jacobian(slip, z_symbol)])
    rng = np.random.default_rng(6)
    for z in configurations(6, 8):
        gap, _, normal = measure_gap(scene, formation.contacts[0], z)
        z[:2] -= gap * normal
        v = rng.uniform(-1, 1, 5)
        A_t = formation.evaluate(z[None], v[None]).A_t[0]
        np.testing.assert_allclose(function(z)[1].full(), A_t, atol=1e-14)
        rise = float(function(z + STEP * v)[0] - function(z - STEP * v)[0])
        # On a tip's arc truncation is (STEP / radius)^2.
        assert rise / (2 * STEP) == pytest.approx(A_t[0] @ v, abs=(STEP / 0.005) ** 2)


@pytest.fixture
def formation() -> Formation:
    scene = replace(make_scene(SQUARE), friction=Friction(0.5, 0.2, 0.3))
    return roll(make_formation(scene, "v0-finger2 v1-palm v2-finger1"), "v1-palm", "v2-finger1")


def test_margin_to_slipping(formation: Formation) -> None:
    c_n, c_t = np.array([[1.0, 2.0, 3.0]]), np.array([[9.0, -0.7, 0.8]])
    np.testing.assert_allclose(slip_margins(formation, c_n, c_t), [[0.3, -0.2]])


def test_what_gives_way_first(formation: Formation) -> None:
    H = force_limit_rows(formation)
    row, c_n, c_t = find_weakest(formation, H @ [1.0, 2.0, 3.0, 0.7, -0.9])
    assert (row, c_n) == (2, 3.0) and c_t == pytest.approx(-0.9)
    row, c_n, c_t = find_weakest(formation, H @ [1.0, 2.0, 3.0, 1.2, 0.1])
    assert (row, c_n) == (1, 2.0) and c_t == pytest.approx(1.2)
    # A contact that pulls has no cone to be in.
    assert find_weakest(formation, H @ [1.0, 2.0, -0.1, 0.0, 0.0]) == (2, -0.1, None)
