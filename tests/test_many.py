from __future__ import annotations

import numpy as np

from shipped import HEPTAGON, chart, problem_of
from wholearm.contacts.closing import contact_table, evaluate_each, group_alike
from wholearm.contacts.formation import Formation


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


def test_groups_have_the_friction_of_all_their_formations() -> None:
    scene = problem_of(HEPTAGON).with_(friction_palm=0.1, friction_finger1=0.2).scene
    table = contact_table(scene)
    names = ("v0-palm", "v1-palm", "v2-finger1", "v5-finger2")
    others = ("v1-palm", "v1-finger1", "v2-finger1", "v5-finger2")
    by_name = {contact.name: k for k, contact in enumerate(table)}
    labels = np.array([[by_name[name] for name in own] for own in (names, others, names)])
    groups = list(group_alike(scene, labels))
    assert sorted(rows.tolist() for _, rows in groups) == [
        [False, True, False],
        [True, False, True],
    ]
    for formation, rows in groups:
        for label in labels[rows]:
            own = Formation(scene, tuple(table[k] for k in label.tolist()))
            np.testing.assert_array_equal(formation.friction, own.friction)
