from __future__ import annotations

import numpy as np
import pytest

from plane import make_scene
from shipped import HEPTAGON, chart, problem_of
from wholearm.common.arrays import Array
from wholearm.contacts.closing import (
    Numbers,
    close_fingers,
    contact_table,
    evaluate_contacts,
    evaluate_each,
    first_contact,
    measure_gap,
    move,
    place,
)
from wholearm.contacts.formation import Formation
from wholearm.mapping.borders import label_cells
from wholearm.scene.model import Scene

COUNT = 400


def close(radius: float) -> tuple[Scene, Numbers, Array, Array]:
    """A hand with links that are just long enough: labels, poses, and the hand closed there."""
    scene = make_scene(lengths=(0.11, 0.09), radius=radius)
    rng = np.random.default_rng(3)
    x, phi = rng.uniform(-0.06, 0.06, COUNT), rng.uniform(-4, 4, COUNT)
    labels = label_cells(scene, x, phi)[:, [0, 2, 4]]
    usable = (labels >= 0).all(axis=1)
    assert usable.sum() > COUNT / 4
    return (
        scene,
        labels[usable],
        np.column_stack([x, phi])[usable],
        close_fingers(scene, x[usable], phi[usable]).z,
    )


@pytest.mark.parametrize(("radius", "kinds"), [(0.01, {0, 1, 2}), (0.0, {0, 1})])
def test_known_contacts_are_where_closing_fingers_come_to_touch(
    radius: float, kinds: set[int]
) -> None:
    scene, labels, poses, z = close(radius)
    for finger in (0, 1):
        found = (labels[:, 1 + finger] - first_contact(scene, finger)) // 4
        assert set(found.tolist()) == kinds
    # Joint angles lose digits where a link is stretched towards what it touches.
    np.testing.assert_allclose(place(scene, labels, poses), z, atol=1e-10)


def test_rates_are_those_of_contacts_that_stay_closed() -> None:
    scene, labels, poses, _ = close(0.01)
    ways = np.random.default_rng(4).normal(size=poses.shape) * [0.03, 1.0]
    at, step = move(scene, labels, poses, ways), 1e-5
    left, right = (place(scene, labels, poses + side * step * ways) for side in (-1, 1))
    # Away from where a link is stretched, where derivatives grow.
    mild = np.abs(at.z_uu).max(axis=1) < 30
    assert mild.mean() > 0.8
    np.testing.assert_allclose(at.z_u[mild], (right - left)[mild] / (2 * step), atol=1e-6)
    bent = (right - 2 * at.z + left)[mild] / step**2
    np.testing.assert_allclose(at.z_uu[mild], bent, atol=1e-3)


def test_rows_are_those_of_formations() -> None:
    scene, labels, poses, _ = close(0.01)
    ways = np.random.default_rng(5).normal(size=poses.shape) * [0.03, 1.0]
    at = move(scene, labels, poses, ways)
    for label in np.unique(labels, axis=0)[::8]:
        mine = (labels == label).all(axis=1)
        every = evaluate_contacts(scene, label.tolist(), at.z[mine], at.z_u[mine])
        own = at.kinematics
        for part, other in (
            (own.A, every.A),
            (own.A_t, every.A_t),
            (own.P_dot_v, every.P_dot_v),
            (own.C, every.C),
        ):
            np.testing.assert_allclose(part[mine], other, rtol=1e-9, atol=1e-10)


def test_gaps_are_those_of_formations() -> None:
    scene, _, _, z = close(0.01)
    contacts = np.random.default_rng(6).integers(0, len(contact_table(scene)), len(z))
    gaps = measure_gap(scene, contacts, z)
    for index in np.unique(contacts):
        mine = contacts == index
        own = evaluate_contacts(scene, [int(index)], z[mine]).C[:, 0]
        np.testing.assert_allclose(gaps[mine], own, atol=1e-14)


def test_rows_are_those_of_each_formation() -> None:
    scene = problem_of(HEPTAGON).scene
    table = contact_table(scene)
    borders = [own for own in chart().borders if own.flush is not None][::30]
    labels = np.array([[table.index(contact) for contact in own.contacts] for own in borders])
    z = np.array([own.z[len(own.z) // 2] for own in borders])
    v = np.random.default_rng(5).normal(size=z.shape)
    found = evaluate_each(scene, labels, z, v)
    for k, border in enumerate(borders):
        expected = Formation(scene, border.contacts).evaluate(z[k : k + 1], v[k : k + 1])
        for one, other in zip(found, expected, strict=True):
            # Formations' own expressions share parts, which costs the last bits.
            np.testing.assert_allclose(one[k], other[0], rtol=1e-12, atol=1e-12)
