from __future__ import annotations

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest

from crossing import measure_centres, place_links
from plane import SQUARE, make_finger, make_formation, make_scene
from wholearm.common.arrays import Array
from wholearm.contacts.elemental import build_features
from wholearm.contacts.links import FINGERS_TOUCH, build_finger_gap, evaluate_finger_gap
from wholearm.scene.model import Scene

ROUNDING = 1e-15
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
