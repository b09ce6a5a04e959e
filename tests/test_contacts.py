from __future__ import annotations

import gc
from dataclasses import replace
from typing import Any

import casadi as ca
import numpy as np
import pytest

import plane
from rows import each
from shipped import HEPTAGON, chart, problem_of
from wholearm import InputError, Scene
from wholearm.common.arrays import Array, Numbers
from wholearm.contacts import closing, elemental
from wholearm.contacts.formation import Formation, find_touching
from wholearm.mapping.borders import label_cells
from wholearm.verification.newton_euler import locate

KITE = [[-0.04, -0.03], [0.02, -0.035], [0.045, 0.01], [0.0, 0.05], [-0.045, 0.02]]
NAMES = ["v3-palm", "v2-finger1", "v4-finger2", "e1-tip1", "e3-tip2", "v2-tip1", "v4-tip2"]
STEP = 1e-6


@pytest.fixture(scope="module")
def scene() -> Scene:
    return plane.make_scene(KITE)


def configurations(seed: int, count: int = 20) -> Array:
    """Random z, on no contact's manifold."""
    rng = np.random.default_rng(seed)
    low, high = [-0.1, 0.02, -3.0, 0.3, 0.3], [0.1, 0.15, 3.0, 2.8, 2.8]
    return np.asarray(rng.uniform(low, high, (count, 5)))


def test_gaps_and_rows_are_those_of_rigid_bodies(scene: Scene) -> None:
    """Points and normals of bodies give the Jacobians of the C-functions."""
    contacts = tuple(c for part in (None, 0, 1) for c in elemental.candidate_contacts(scene, part))
    z = configurations(1)
    rows = Formation(scene, contacts).evaluate(z, z)
    for k, contact in enumerate(contacts):
        touch = locate(scene, contact.name, z)
        np.testing.assert_allclose(touch.gap, rows.C[:, k], atol=1e-14)
        np.testing.assert_allclose(touch.normal, rows.A[:, k], atol=1e-14)
        np.testing.assert_allclose(touch.tangent, rows.A_t[:, k], atol=1e-14)


def test_names_round_trip(scene: Scene) -> None:
    contacts = [c for part in (None, 0, 1) for c in elemental.candidate_contacts(scene, part)]
    assert len(set(contacts)) == 5 + 2 * 15
    assert [elemental.parse_contact(contact.name, scene) for contact in contacts] == contacts
    assert [str(contact) for contact in contacts] == [contact.name for contact in contacts]


@each(
    "name",
    [
        *("v5-palm", "e5-tip1", "e0-palm", "e1-finger1", "v1-finger3", "v1-tip0", "v1", "x1-palm"),
        *("v1-palm1", "v-1-palm", "V1-palm", " v1-palm", "v1-palm\n", "v\u0661-palm", "v01-palm"),
        *("v1-finger", "", None, 7, ["v1-palm"], True),
    ],
)
def test_bad_name_lists_what_is_allowed(scene: Scene, name: Any) -> None:
    with pytest.raises(InputError, match="allowed are vN-palm") as caught:
        elemental.parse_contact(name, scene)
    assert repr(name) in caught.value.problem and "0 to 4" in caught.value.problem


def test_pointed_tip_has_no_arc() -> None:
    pointed = plane.make_scene(KITE, radius=0.0)
    assert len(elemental.candidate_contacts(pointed, 0)) == 10
    with pytest.raises(InputError, match=r"fingers\.1\.radius is 0"):
        elemental.parse_contact("v1-tip1", pointed)


@each("name", NAMES)
def test_slip_coordinate_integrates_the_sliding_velocity(scene: Scene, name: str) -> None:
    """Where a contact touches, the gradient of its slip is A_t, by derivative and difference."""
    formation = plane.make_formation(scene, name)
    features = elemental.build_features(scene)
    slip, z_symbol = features.pairs[formation.contacts[0]].slip, features.z
    function = ca.Function("slip", [z_symbol], [slip, ca.jacobian(slip, z_symbol)])
    rng = np.random.default_rng(6)
    for z in configurations(6, 8):
        touch = locate(scene, name, z[None])
        z[:2] -= touch.gap[0] * touch.normal[0, :2]
        v = rng.uniform(-1, 1, 5)
        A_t = formation.evaluate(z[None], v[None]).A_t[0]
        np.testing.assert_allclose(function(z)[1].full(), A_t, atol=1e-14)
        rise = float(function(z + STEP * v)[0] - function(z - STEP * v)[0])
        # On a tip's arc truncation is (STEP / radius)^2.
        assert rise / (2 * STEP) == pytest.approx(A_t[0] @ v, abs=(STEP / 0.005) ** 2)


# Distances of metres-sized coordinates in double precision.
ROUNDING = 1e-14


@pytest.mark.parametrize("radius", [0.0, 0.005, 0.02])
@pytest.mark.parametrize("length", [0.06, 0.1, 0.2])
def test_closing_stops_at_the_first_touch(radius: float, length: float) -> None:
    """Swept from outside, the capsule is clear of the object up to the angle and touches there."""
    rng = np.random.default_rng([int(1e3 * radius), int(1e3 * length)])
    for trial in range(25):
        points = plane.convex_polygon(rng, int(rng.integers(3, 8)))
        scene = plane.make_scene(points, length=length, radius=radius, base=0.13, depth=-0.025)
        # Above the palm, between the joints or beyond them.
        phi = rng.uniform(-np.pi, np.pi)
        lowest = plane.rotate(phi, scene.polygon.vertices)[:, 1].min()
        q = np.array([rng.uniform(-0.09, 0.09), rng.uniform(0.0, 0.02) - lowest, phi])
        finger = trial % 2
        try:
            angle = closing.close_finger(scene, q, finger)
        except InputError as error:
            assert "too short" in error.problem
            angles = np.linspace(-np.pi, np.pi, 1500)
            assert (plane.finger_gap(scene, q, finger, angles) > 0).all()
            continue
        assert plane.is_first_touch(scene, q, finger, angle)


@pytest.mark.parametrize("finger", [0, 1])
def test_closing_starts_from_straight_down(finger: int) -> None:
    """An object outside the hand and below the joint is met before the finger points outwards."""
    scene = plane.make_scene(plane.SQUARE, base=0.05, depth=0.12, length=0.1)
    q = np.array([0.12 if finger == 0 else -0.12, 0.03, 0.0])
    angle = closing.close_finger(scene, q, finger)
    assert plane.is_first_touch(scene, q, finger, angle)
    assert abs(angle - (-np.pi / 2 if finger == 0 else 3 * np.pi / 2)) < np.pi / 4


@each(
    "depth, x, y, names",
    [
        (0.0, 0.045, 0.05, {"v1-finger1", "v2-finger1"}),
        (0.0, 0.07, 0.155, {"e0-tip1"}),
        (0.0, 0.05 - np.sqrt(0.5) * 0.005, 0.15 + np.sqrt(0.5) * 0.005, {"v1-tip1"}),
        # Vertex 1 lies on the line of the link's side, before the joint.
        (0.05, 0.045, 0.03, {"v2-finger1"}),
    ],
)
def test_touching_names_the_kind(depth: float, x: float, y: float, names: set[str]) -> None:
    """A square beside an upright link, or above its tip."""
    scene = plane.make_scene(base=0.08, depth=depth, length=0.12)
    touching = find_touching(scene, np.array([x, y, 0.0, np.pi / 2, np.pi / 2]))
    assert {contact.name for contact in touching if contact.finger == 0} == names


@pytest.mark.parametrize("base", [[0.0, 0.03], [0.0, -0.004], [0.029, 0.03], [0.034, 0.03]])
def test_joint_inside_the_object(base: list[float]) -> None:
    """Also where only the rounded end of the link reaches into it."""
    scene = plane.make_scene(plane.SQUARE)
    scene = replace(scene, fingers=(replace(scene.fingers[0], base=base), scene.fingers[1]))
    with pytest.raises(InputError, match="inside the object") as caught:
        closing.close_finger(scene, np.array([0.0, 0.03, 0.0]), 0)
    assert caught.value.key == "fingers.1.base"


@each("seed", range(5))
def test_flush_edge_lies_on_the_palm(seed: int) -> None:
    rng = np.random.default_rng(seed)
    scene = plane.make_scene(plane.convex_polygon(rng, 6))
    for edge in range(6):
        x = rng.uniform(-1, 1)
        q = closing.place_flush(scene, edge, x)
        heights = plane.place_corners(scene, q)[:, 1]
        assert q[0] == x and -np.pi < q[2] <= np.pi
        np.testing.assert_allclose(heights[[edge, (edge + 1) % 6]], 0.0, atol=ROUNDING)
        assert heights.min() > -ROUNDING


@each("name", ["v0-palm", "v2-finger1", "v3-finger2", "e1-tip1", "e3-tip2", "v2-tip1", "v2-tip2"])
def test_a_rolling_contact_adds_its_tangential_row(name: str) -> None:
    scene = plane.make_scene(plane.SQUARE)
    sliding = plane.make_formation(scene, f"v1-palm {name} v0-finger2")
    formation = Formation(scene, sliding.contacts, (elemental.parse_contact(name, scene),))
    assert (formation.n_contacts, formation.n_rolling, formation.n_constraints) == (3, 1, 4)
    assert formation.rolling_rows == (1,) and formation.contacts == sliding.contacts
    assert formation.sliding_friction == pytest.approx([0.1, 0.0, 0.1])
    z, v = configurations(8), 1e-6
    speed = np.random.default_rng(8).uniform(-1, 1, z.shape)
    here = formation.evaluate(z, speed)
    np.testing.assert_array_equal(here.P, np.concatenate([here.A, here.A_t[:, 1:2]], axis=1))
    ahead, behind = (formation.evaluate(z + step * speed, speed).P for step in (v, -v))
    expected = np.einsum("nij,nj->ni", (ahead - behind) / (2 * v), speed)
    np.testing.assert_allclose(here.P_dot_v, expected, atol=1e-8)


def test_only_contacts_roll() -> None:
    contacts = plane.make_formation(
        plane.make_scene(plane.SQUARE), "v0-palm v1-palm v2-palm"
    ).contacts
    with pytest.raises(ValueError, match="v2-palm roll, which are no contacts"):
        Formation(plane.make_scene(plane.SQUARE), contacts[:2], contacts[1:])


UPRIGHT = np.pi / 2
WIDE = plane.make_scene(plane.SQUARE, base=0.08, depth=0.0, length=0.12)
TALL = plane.make_scene(plane.SQUARE, base=0.08, depth=0.0, length=0.06)
SHORT = plane.make_scene(plane.SQUARE, base=0.08, depth=0.0, length=0.02)
STANDING = np.array([0.045, 0.03, 0.0, UPRIGHT, UPRIGHT])
LEFT = np.array([-0.045, 0.03, 0.0, UPRIGHT, UPRIGHT])


@each(
    "scene, names, z, text, clear",
    [
        (WIDE, "v0-palm v1-finger1", STANDING, "v1 touches the palm", 0.0),
        (WIDE, "v0-palm v1-finger1", STANDING, "v2 touches finger 1", 0.0),
        (WIDE, "v0-palm v1-finger1", STANDING, "v1 runs off finger 1 at its base", 0.0),
        (WIDE, "v0-palm v0-finger2", LEFT, "v3 touches finger 2", 0.0),
        (WIDE, "v0-palm v0-finger2", LEFT, "v0 runs off finger 2 at its base", 0.0),
        (TALL, "v0-palm v2-finger1", STANDING, "v2 runs off finger 1 at its tip", 0.0),
        (TALL, "v0-palm v2-finger1", STANDING, "v1 touches finger 1", 0.0),
        (WIDE, "v0-palm v1-palm", STANDING, "v1 touches finger 1", 0.0),
        (SHORT, "v0-palm v1-palm", STANDING, "e1 touches the tip of finger 1", 0.0),
        (SHORT, "v0-palm e1-tip1", STANDING, "v1 touches finger 1", 0.0),
        (SHORT, "v0-palm v1-finger1", STANDING, "e1 touches the tip of finger 1", 0.0),
        (WIDE, "v0-palm v1-palm", STANDING, "v2 touches the palm", 0.06),
        (WIDE, "v0-palm v2-finger1", STANDING, "v0 touches finger 1", 0.06),
        (WIDE, "v0-palm v2-finger1", STANDING, "v2 runs off finger 1 at its base", 0.06),
        (WIDE, "v0-palm v2-finger1", STANDING, "v2 runs off finger 1 at its tip", 0.06),
        (WIDE, "v0-palm v1-palm", STANDING, "v0 touches finger 2", 0.09),
        (SHORT, "v0-palm e1-tip1", STANDING, "the tip of finger 1 runs off edge 1 at v1", 0.02),
        (SHORT, "v0-palm e1-tip1", STANDING, "the tip of finger 1 runs off edge 1 at v2", 0.04),
    ],
)
def test_limits_are_clearances(scene: Scene, names: str, z: Array, text: str, clear: float) -> None:
    """The square stands on the palm beside an upright link."""
    formation = plane.make_formation(scene, names)
    texts = [limit.text for limit in formation.limits]
    assert len(set(texts)) == len(texts)
    limit = formation.evaluate_limits(z[None])[0, texts.index(text)]
    assert limit == pytest.approx(clear, abs=ROUNDING)


@each(
    "names, text, gained",
    [
        ("v2-finger1", "v2 runs off finger 1 at its tip", "v2-tip1"),
        ("v2-finger1", "v2 runs off finger 1 at its base", None),
        ("e1-tip2", "the tip of finger 2 runs off edge 1 at v1", "v1-tip2"),
        ("e3-tip2", "the tip of finger 2 runs off edge 3 at v0", "v0-tip2"),
        ("v0-tip1", "v0 leaves the tip of finger 1 for the side of the link", "v0-finger1"),
        ("v0-tip1", "v0 leaves the tip of finger 1 for the far side of the link", None),
        ("e3-tip2", "v3 touches the far side of finger 2", None),
        ("e3-tip2", "e3 touches the joint of finger 2", None),
        ("v0-tip1", "edge 3 turns onto the tip of finger 1", "e3-tip1"),
        ("v0-tip1", "edge 0 turns onto the tip of finger 1", "e0-tip1"),
        ("v2-finger1", "v3 touches finger 1", "v3-finger1"),
    ],
)
def test_limit_knows_what_is_gained(names: str, text: str, gained: str | None) -> None:
    limits = {limit.text: limit.gained for limit in plane.make_formation(WIDE, names).limits}
    assert limits[text] == (elemental.parse_contact(gained, WIDE) if gained else None)


@pytest.mark.parametrize("finger", [0, 1])
def test_object_may_hang_over_the_back_of_a_tip(finger: int) -> None:
    """The tip holds the lower edge; its outer end hangs lower than the tip, behind the link."""
    scene = plane.make_scene(plane.SQUARE, length=0.1)
    side = 1 if finger == 0 else -1
    angles = np.array([np.pi / 2 - 0.9, np.pi / 2 + 0.9])
    angles[finger] = np.pi / 2
    normal = plane.rotate(-0.3 * side, [0.0, 1.0])
    centre = plane.place_tips(scene, finger, angles[finger]) + (0.005 + 0.03) * normal
    z = np.array([*centre, -0.3 * side, *angles])
    hanging = plane.place_corners(scene, z)[1 if finger == 0 else 0]
    assert hanging[1] < plane.place_tips(scene, finger, angles[finger])[1]
    assert plane.finger_gap(scene, z[:3], finger, angles[finger])[0] == pytest.approx(
        0.0, abs=1e-13
    )
    formation = plane.make_formation(scene, f"e0-tip{finger + 1}")
    assert (formation.evaluate_limits(z[None])[0] > 0.01).all()


def test_a_joint_right_above_the_object_is_refused() -> None:
    """A link closes from pointing down, which overlaps an object below its joint."""
    flat = [[-0.12, 0.0], [0.12, 0.0], [0.12, 0.02], [-0.12, 0.02]]
    scene = plane.make_scene(flat, base=0.08, depth=0.05)
    for x in (0.0, 0.05):
        with pytest.raises(InputError, match="right above it") as caught:
            closing.close_finger(scene, np.array([x, 0.01, 0.0]), 0)
        assert caught.value.key == "fingers.1.base"
    beside = closing.close_finger(scene, np.array([-0.06, 0.01, 0.0]), 0)
    assert abs(plane.finger_gap(scene, np.array([-0.06, 0.01, 0.0]), 0, beside)[0]) < 1e-12


def test_limits_outlive_the_scene_that_built_them() -> None:
    corners = [[0.0, 0.0], [0.083, 0.0], [0.0, 0.071]]  # no other test's
    first, second = (
        plane.make_formation(plane.make_scene(corners), "v1-finger1 v2-finger2") for _ in range(2)
    )
    assert len(first.limits) == len(second.limits) > 0
    del first
    gc.collect()
    values = ca.vertcat(*(limit.value for limit in second.limits))
    function = ca.Function("limits", [elemental.build_features(second.scene).z], [values])
    assert np.isfinite(np.array(function(np.ones(5)))).all()


def close(radius: float) -> tuple[Scene, Numbers, Array, Array]:
    """A hand with links that are just long enough: labels, poses, and the hand closed there."""
    scene = plane.make_scene(lengths=(0.11, 0.09), radius=radius)
    rng = np.random.default_rng(3)
    x, phi = rng.uniform(-0.06, 0.06, 400), rng.uniform(-4, 4, 400)
    labels = label_cells(scene, np.column_stack([x, phi]))
    usable = (labels >= 0).all(axis=1)
    assert usable.mean() > 0.25
    labels, x, phi = labels[usable], x[usable], phi[usable]
    return scene, labels, np.column_stack([x, phi]), closing.close_fingers(scene, x, phi).z


@pytest.mark.parametrize(("radius", "kinds"), [(0.01, {0, 1, 2}), (0.0, {0, 1})])
def test_known_contacts_are_where_closing_fingers_come_to_touch(
    radius: float, kinds: set[int]
) -> None:
    scene, labels, poses, z = close(radius)
    for finger in (0, 1):
        found = (labels[:, 1 + finger] - closing.first_contact(scene, finger)) // 4
        assert set(found.tolist()) == kinds
    # Joint angles lose digits where a link is stretched towards what it touches.
    np.testing.assert_allclose(closing.place_at(scene, labels, poses), z, atol=1e-10)


def test_rates_are_those_of_contacts_that_stay_closed() -> None:
    scene, labels, poses, _ = close(0.01)
    ways = np.random.default_rng(4).normal(size=poses.shape) * [0.03, 1.0]
    z, z_u, z_uu, _ = closing.evaluate_path(scene, labels, poses, ways)
    # Steps with errors of truncation and rounding below the tolerances.
    (left, right), (before, after) = (
        [closing.place_at(scene, labels, poses + side * step * ways) for side in (-1, 1)]
        for step in (1e-5, 1e-4)
    )
    # Away from where a link is stretched, where derivatives grow.
    mild = np.abs(z_uu).max(axis=1) < 30
    assert mild.mean() > 0.8
    np.testing.assert_allclose(z_u[mild], (right - left)[mild] / 2e-5, atol=1e-6)
    bent = (after - 2 * z + before)[mild] / 1e-4**2
    np.testing.assert_allclose(z_uu[mild], bent, atol=1e-3)


def test_rows_are_those_of_each_formation() -> None:
    scene = problem_of(HEPTAGON).scene
    table = closing.contact_table(scene)
    borders = [own for own in chart().borders if own.flush is not None][::30]
    labels = np.array([[table.index(contact) for contact in own.contacts] for own in borders])
    z = np.array([own.z[len(own.z) // 2] for own in borders])
    v = np.random.default_rng(5).normal(size=z.shape)
    found = closing.evaluate_each(scene, labels, z, v)
    for k, border in enumerate(borders):
        expected = Formation(scene, border.contacts).evaluate(z[k : k + 1], v[k : k + 1])
        for one, other in zip(found, expected, strict=True):
            # Formations' own expressions share parts, which costs the last bits.
            np.testing.assert_allclose(one[k], other[0], rtol=1e-12, atol=1e-12)
