from __future__ import annotations

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest

from crossing import measure_centres, place_links
from plane import (
    SQUARE,
    convex_polygon,
    finger_gap,
    make_finger,
    make_formation,
    make_scene,
    rotate,
)
from wholearm.common.arrays import Array
from wholearm.contacts.contact_limits import (
    FINGERS_TOUCH,
    build_apart,
    build_finger_gap,
    evaluate_finger_gap,
)
from wholearm.contacts.elemental import build_features, parse_contact
from wholearm.contacts.formation import Formation
from wholearm.scene.model import Scene

ROUNDING = 1e-15


def random_scene(rng: np.random.Generator, radius: float, count: int = 5) -> Scene:
    """One link whose length is between a part and twice of the object's size."""
    length = rng.uniform(0.03, 0.2)
    scene = make_scene(convex_polygon(rng, count), length=length, radius=radius, base=0.05)
    return replace(scene, fingers_collide=False)


def link_gaps(scene: Scene, finger: int, z: Array) -> Array:
    return finger_gap(scene, z[:, :3], finger, z[:, 3 + finger])


def approach(rng: np.random.Generator, scene: Scene, finger: int) -> Array:
    """A place where a corner or an edge is within 2 mm of some point of a link's outline."""
    link, phi = scene.fingers[finger], rng.uniform(-np.pi, np.pi)
    corners = rotate(phi, scene.polygon.vertices)
    one, other = corners[[k := int(rng.integers(len(corners))), k - 1]]
    on_edge = one + np.clip(rng.uniform(-0.5, 1.0), 0, 1) * (other - one)
    away = np.arctan2(*-on_edge[::-1]) + rng.uniform(-0.5, 0.5)
    share = np.clip(rng.uniform(-0.5, 1.5), 0, 1)
    lean = np.pi / 2 if 0 < share < 1 else rng.uniform(np.pi / 2, np.pi)
    angle = away + rng.choice([-1, 1]) * lean + (np.pi if share == 1 else 0.0)
    on_axis = np.asarray(link.base) + share * link.length * np.array([np.cos(angle), np.sin(angle)])
    heading = np.array([np.cos(away), np.sin(away)])
    at = on_axis + (link.radius + rng.uniform(-2e-3, 4e-3)) * heading - on_edge
    return np.array([*at, phi, angle, angle])


def limits_of(formation: Formation, finger: int, values: Array) -> dict[str, float]:
    """Values of the limits that are about one finger and the object."""
    words = f"finger {finger + 1}"
    return {
        limit.text: value
        for limit, value in zip(formation.limits, values.tolist(), strict=True)
        if words in limit.text
    }


@pytest.mark.parametrize("finger", [0, 1])
@pytest.mark.parametrize("radius", [0.0, 0.004, 0.02])
def test_a_free_link_and_the_object_overlap_where_a_limit_says_so(
    radius: float, finger: int
) -> None:
    """At random all around each other: limits are positive if, and only if, the bodies are apart.

    The object is pushed to within a few millimetres of the link, the distances of which are
    measured by plain geometry.
    """
    rng = np.random.default_rng([finger, int(1e3 * radius)])
    broken: set[str] = set()
    seen = {True: 0, False: 0}
    for _ in range(3):
        scene = random_scene(rng, radius, int(rng.integers(3, 9)))
        formation = make_formation(scene, "v0-palm")
        z = np.array([approach(rng, scene, finger) for _ in range(250)])
        values = formation.evaluate_limits(z)
        for gap, row in zip(link_gaps(scene, finger, z), values, strict=True):
            limits = limits_of(formation, finger, row)
            text = min(limits, key=limits.__getitem__)
            least = limits[text]
            assert least > 0 if gap > ROUNDING else least < 0, (text, gap, least)
            seen[gap > ROUNDING] += 1
            broken |= {text.split(maxsplit=1)[1] for text, value in limits.items() if value < 0}
    assert min(seen.values()) > 100
    name = f"finger {finger + 1}"
    expected = {f"touches {part}{name}" for part in ("", "the far side of ", "the tip of ")}
    assert broken == expected | {f"touches the joint of {name}"}


def hold(rng: np.random.Generator, scene: Scene, name: str) -> Array:
    """A place where a contact of a link touches, the object turned by any angle."""
    contact = parse_contact(name, scene)
    assert contact.finger is not None
    link, (angle, phi) = scene.fingers[contact.finger], rng.uniform(-np.pi, np.pi, 2)
    axis = np.array([np.cos(angle), np.sin(angle)])
    corners = rotate(phi, scene.polygon.vertices)
    one, other = corners[[contact.index, (contact.index + 1) % len(corners)]]
    share, normal, on_body = 1.0, rotate(rng.uniform(-np.pi / 2, np.pi / 2), axis), one
    if contact.surface == "finger":
        share = rng.uniform(0.02, 0.98)
        normal = rotate(np.pi / 2 if contact.finger == 0 else -np.pi / 2, axis)
    elif contact.feature == "e":
        normal = rotate(np.pi / 2, other - one) / np.hypot(*(other - one))
        on_body = one + rng.uniform(0.02, 0.98) * (other - one)
    at = np.asarray(link.base) + share * link.length * axis + link.radius * normal - on_body
    return np.array([*at, phi, angle, angle])


@pytest.mark.parametrize("name", ["v1-finger1", "v1-finger2", "e1-tip1", "e1-tip2", "v1-tip2"])
@pytest.mark.parametrize("radius", [0.0, 0.004, 0.02])
def test_a_link_that_touches_overlaps_elsewhere_where_a_limit_says_so(
    radius: float, name: str
) -> None:
    if radius == 0 and name.startswith("v1-tip"):
        return  # A pointed tip has no arc.
    finger = int(name[-1]) - 1
    rng = np.random.default_rng([finger, int(1e3 * radius), len(name)])
    seen = {True: 0, False: 0}
    for _ in range(3):
        scene = random_scene(rng, radius, int(rng.integers(3, 9)))
        formation = make_formation(scene, name)
        z = np.array([hold(rng, scene, name) for _ in range(56)])
        assert np.abs(formation.evaluate(z, z).C).max() < 1e-14
        # A little smaller, the object touches nothing where it only touched.
        body = replace(scene.polygon, points=(1 - 1e-6) * scene.polygon.vertices)
        smaller = replace(scene, polygon=body)
        every = zip(z, formation.evaluate_limits(z), link_gaps(smaller, finger, z), strict=True)
        for place, values, gap in every:
            least = min(limits_of(formation, finger, values).values())
            clear = bool(gap > (-1e-7 if radius else 0.0))
            assert clear or least < 1e-7, (place, least, gap)
            # An object behind a pointed link, which has no thickness, overlaps nothing.
            thick = radius > 0 or name.startswith("e")
            assert not (clear and thick and least < -2e-3), (place, least)
            seen[clear] += 1
    assert min(seen.values()) > 10


@pytest.mark.parametrize("radius", [0.0, 0.01])
def test_the_gap_of_link_and_object_is_the_distance_measured(radius: float) -> None:
    rng = np.random.default_rng(int(1e3 * radius))
    for finger in (0, 1):
        scene = random_scene(rng, radius, 6)
        function = ca.Function("apart", [build_features(scene).z], [build_apart(scene, finger)])
        z = np.array([approach(rng, scene, finger) for _ in range(100)])
        z[:, :2] += rng.uniform(-0.01, 0.01, (100, 2))
        measured = link_gaps(scene, finger, z)
        # As far inside as the link's middle, the distance measured ends.
        outside = measured > -radius + 1e-9
        found = function(z.T).full()[0]
        np.testing.assert_allclose(found[outside], measured[outside], atol=1e-14)
        assert (found[~outside] <= 0).all() and outside.sum() > 30 and (~outside).sum() > 5


COUNT = 400


def random_hands(seed: int, count: int = 12) -> list[Scene]:
    """Hands whose links differ in base, length and radius."""
    rng = np.random.default_rng(seed)
    hands = []
    for _ in range(count):
        right = make_finger([rng.uniform(0.01, 0.1), rng.uniform(-0.05, 0.02)])
        left = make_finger([rng.uniform(-0.1, -0.01), rng.uniform(-0.05, 0.02)])
        fingers = [
            replace(f, length=rng.uniform(0.05, 0.25), radius=rng.choice([0.0, 0.004, 0.02]))
            for f in (right, left)
        ]
        hands.append(replace(make_scene(SQUARE), fingers=(fingers[0], fingers[1])))
    return hands


def random_angles(seed: int, count: int = COUNT) -> Array:
    z = np.zeros((count, 5))
    z[:, 3:] = np.random.default_rng(seed).uniform(-np.pi, np.pi, (count, 2))
    return z


@pytest.mark.parametrize("seed", range(3))
def test_apart_the_gap_is_the_distance_less_both_radii(seed: int) -> None:
    seen = np.zeros(2, dtype=int)
    for scene in random_hands(seed):
        z = random_angles(seed)
        distance, crossed = measure_centres(scene, z)
        gap = evaluate_finger_gap(scene, z) + sum(link.radius for link in scene.fingers)
        np.testing.assert_allclose(gap[~crossed], distance[~crossed], atol=1e-14)
        assert (gap[crossed] <= ROUNDING).all()
        seen += [crossed.sum(), (~crossed).sum()]
    assert seen.min() > 100


@pytest.mark.parametrize("seed", range(2))
def test_apart_the_gap_is_the_least_distance_of_sampled_points(seed: int) -> None:
    share = np.linspace(0.0, 1.0, 201)[:, None]
    for scene in random_hands(seed, 4):
        z = random_angles(seed, 25)
        for gap, one, other in zip(
            evaluate_finger_gap(scene, z), *place_links(scene, z), strict=True
        ):
            points = [ends[0] + share * (ends[1] - ends[0]) for ends in (one, other)]
            least = np.linalg.norm(points[0][:, None] - points[1], axis=2).min()
            least -= sum(link.radius for link in scene.fingers)
            # Samples are a hundredth of a link apart at most: no nearer than the links themselves.
            spacing = max(link.length for link in scene.fingers) / 200
            assert max(gap, -sum(f.radius for f in scene.fingers)) <= least + 1e-14
            assert least <= max(gap, -sum(f.radius for f in scene.fingers)) + spacing


@pytest.mark.parametrize("seed", range(2))
def test_crossed_the_gap_is_minus_the_least_push_that_parts(seed: int) -> None:
    """The separation along 3600 directions, the largest of which is the gap."""
    angles = np.linspace(0.0, 2 * np.pi, 3600, endpoint=False)
    directions = np.column_stack([np.cos(angles), np.sin(angles)])
    deep = 0
    for scene in random_hands(seed, 6):
        z = random_angles(seed + 10, 60)
        one, other = place_links(scene, z)
        apart = (other @ directions.T).min(axis=1) - (one @ directions.T).max(axis=1)
        gap = evaluate_finger_gap(scene, z)
        expected = apart.max(axis=1) - sum(link.radius for link in scene.fingers)
        assert (gap >= expected - 1e-14).all()
        reach = sum(link.length for link in scene.fingers) + 0.3
        np.testing.assert_allclose(gap, expected, atol=reach * np.pi / 3600)
        deep += int((apart.max(axis=1) < -0.01).sum())
    assert deep > 10


def test_apart_the_gradient_is_that_of_differences_and_continuous() -> None:
    scene, step = make_scene(SQUARE, lengths=(0.18, 0.13)), 1e-6
    z = random_angles(3)
    z = z[evaluate_finger_gap(scene, z) > 1e-3]
    features = build_features(scene)
    gradient = ca.Function("g", [features.z], [ca.jacobian(build_finger_gap(scene), features.z)])
    values = gradient(z.T).full().reshape(1, -1, 5)[0]
    for k, unit in enumerate(step * np.eye(5)):
        rise = evaluate_finger_gap(scene, z + unit) - evaluate_finger_gap(scene, z - unit)
        # Where the nearest points pass an end of a link the second derivative steps.
        np.testing.assert_allclose(values[:, k], rise / (2 * step), atol=1e-4 * 0.18)
    assert np.abs(values[:, :3]).max() == 0


@pytest.mark.parametrize("seed", range(2))
def test_the_gap_is_the_same_mirrored(seed: int) -> None:
    """Mirroring swaps the fingers."""
    for scene in random_hands(seed):
        right, left = (
            replace(link, base=np.asarray(link.base) * [-1.0, 1.0]) for link in scene.fingers[::-1]
        )
        z = random_angles(seed, 50)
        swapped = np.hstack([z[:, :3], np.pi - z[:, [4, 3]]])
        gaps = evaluate_finger_gap(replace(scene, fingers=(right, left)), swapped)
        np.testing.assert_allclose(gaps, evaluate_finger_gap(scene, z), atol=1e-13)


def test_ends_that_coincide_touch() -> None:
    """Two pointed links that meet at their tips."""
    scene = make_scene(SQUARE, base=0.06, depth=0.0, length=0.1, radius=0.0)
    z = np.zeros((1, 5))
    z[0, 3:] = np.arccos(-0.6), np.arccos(0.6)
    assert evaluate_finger_gap(scene, z) == pytest.approx(0.0, abs=1e-14)
    features = build_features(scene)
    hessian, gradient = ca.hessian(build_finger_gap(scene), features.z)
    values = ca.Function("h", [features.z], [hessian, gradient])(z[0])
    assert all(np.isfinite(value.full()).all() for value in values)


def test_the_gap_is_a_limit_of_every_formation() -> None:
    scene = make_scene(SQUARE)
    for names in ("v0-palm v1-palm", "v0-palm v2-finger1 e3-tip2"):
        formation = make_formation(scene, names)
        (index,) = [k for k, e in enumerate(formation.limits) if e.text == FINGERS_TOUCH]
        assert formation.limits[index].gained is None
        z = random_angles(5, 20)
        values = formation.evaluate_limits(z)[:, index]
        np.testing.assert_allclose(values, evaluate_finger_gap(scene, z), atol=ROUNDING)


def test_fingers_in_different_planes_pass_each_other() -> None:
    scene = replace(make_scene(SQUARE), fingers_collide=False)
    formation = make_formation(scene, "v0-palm v1-palm")
    assert FINGERS_TOUCH not in [limit.text for limit in formation.limits]
