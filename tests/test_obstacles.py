from __future__ import annotations

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest

from plane import convex_polygon, finger_gap, make_formation, make_scene, rotate
from wholearm.common.arrays import Array
from wholearm.contacts.elemental import build_features, parse_contact
from wholearm.contacts.formation import Formation
from wholearm.contacts.obstacles import build_apart
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
