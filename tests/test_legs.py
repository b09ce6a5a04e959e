from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest

from plane import convex_polygon, make_scene
from wholearm.common.arrays import Array
from wholearm.common.errors import InputError
from wholearm.contacts.closing import close_fingers, contact_table
from wholearm.contacts.formation import Formation
from wholearm.mapping.borders import NOWHERE, flush_track, label_cells
from wholearm.mapping.legs import describe_miss, find_miss, split_leg, tolerance
from wholearm.problem.definition import Problem
from wholearm.search.roadmap import map_labels

PHI = np.radians(-35.0)


def on_border(problem: Problem, phi: float) -> Array:
    """Where edge 6 lies flush on finger 2 with vertex 1 on the palm, as in the flip's plan."""
    track = flush_track(problem.scene, 1, 6, 1, np.array([phi]))
    return np.array(track.pose(track.places)).ravel()


@pytest.mark.parametrize("back", [False, True])
def test_leg_through_cells_changes_one_contact_at_a_time(heptagon: Problem, back: bool) -> None:
    scene = heptagon.scene
    ends = [np.array([0.02, 0.3]), np.array([-0.08, -0.8])]
    start, stop = ends[::-1] if back else ends
    parts = split_leg(scene, start, stop)
    assert len(parts) == 7
    np.testing.assert_array_equal(parts[0].start, start)
    np.testing.assert_allclose(parts[-1].stop, stop, atol=1e-12)
    assert parts[-1].gained == () and parts[-1].coordinate == 0
    for one, two in pairwise(parts):
        np.testing.assert_allclose(one.stop, two.start, atol=1e-12)
        assert set(two.contacts) - set(one.contacts) == set(one.gained)
        z = close_fingers(scene, *one.stop[:, None]).z
        both = Formation(scene, tuple({*one.contacts, *two.contacts}))
        assert np.abs(both.evaluate(z, z).C).max() < 1e-9
    for part in parts:
        middle = (part.start + part.stop) / 2
        label = label_cells(scene, *middle[:, None])[0]
        table = contact_table(scene)
        assert part.contacts == tuple(table[i] for i in label if i != NOWHERE)


def test_leg_follows_a_border_that_both_ends_are_near(heptagon: Problem) -> None:
    near = tolerance(heptagon.scene)
    for share in (0.0, 0.9, -0.9):
        ends = [on_border(heptagon, phi) + share * near for phi in (PHI, PHI + 0.15)]
        (part,) = split_leg(heptagon.scene, *ends)
        assert len(part.contacts) == 4 and part.coordinate == 1
        for place, end in ((part.start, ends[0]), (part.stop, ends[1])):
            np.testing.assert_allclose(place, on_border(heptagon, place[1]), atol=1e-12)
            assert (np.abs(place - end) < near).all()


def beside_border(problem: Problem, bulge: float) -> tuple[Array, Array]:
    """A leg whose ends are three times the tolerance off a border that bulges by so many times."""
    near = tolerance(problem.scene)[0]
    for span in np.linspace(0.1, 0.6, 400):
        start, stop = on_border(problem, PHI), on_border(problem, PHI + span)
        away = ((start + stop) / 2 - on_border(problem, PHI + span / 2))[0]
        if abs(away) > bulge * near:
            break
    aside = np.array([-np.sign(away) * 3.0 * near, 0.0])
    return start + aside, stop + aside


@pytest.mark.parametrize("bulge, crosses", [(4.0, False), (9.0, True)])
def test_straight_leg_beside_a_curved_border(
    heptagon: Problem, bulge: float, crosses: bool
) -> None:
    """Where it is less than the tolerance beyond the border, it stays in its cell."""
    scene, leg = heptagon.scene, beside_border(heptagon, bulge)
    on_finger_2 = label_cells(scene, *np.linspace(*leg, 300).T)[:, 4]
    assert (np.diff(on_finger_2) != 0).sum() == 2
    parts = split_leg(scene, *leg)
    touched = [next(c for c in part.contacts if c.finger == 1) for part in parts]
    changes = sum(one != two for one, two in pairwise(touched))
    assert changes == (2 if crosses else 0)
    assert touched[0] == touched[-1] == contact_table(scene)[on_finger_2[0]]


def test_a_crossing_is_named_by_its_contacts(heptagon: Problem) -> None:
    phi, x = heptagon.scene.polygon.flush_angle(0), -0.06368782401
    words = r"crossing of borders at x = -63.69 mm.*, of v1-palm, v3-finger1, v0-finger2, v0-palm"
    with pytest.raises(InputError, match=words):
        split_leg(heptagon.scene, np.array([x - 0.01, phi - 0.1]), np.array([x + 0.01, phi + 0.1]))


def test_near_miss_names_the_border_and_its_distance(heptagon: Problem) -> None:
    scene, near = heptagon.scene, tolerance(heptagon.scene)
    aside = np.array([near[0], 0.0])
    start, stop = (on_border(heptagon, phi) + 2.0 * aside for phi in (PHI, PHI + 0.2))
    miss = find_miss(scene, start, stop)
    assert miss is not None and miss.track.flush == (1, 6)
    assert 1.0 < miss.off <= 2.0
    text = describe_miss(scene, miss)
    assert (
        "e6 flush on finger 2" in text
        and " up to -" in text
        and "mm in x" in text
        and "0.5 deg" in text
    )
    assert find_miss(scene, start + 10 * aside, stop + 10 * aside) is None
    phi = scene.polygon.flush_angle(0) + 3 * near[1]
    palm = find_miss(scene, np.array([0.045, phi]), np.array([0.0, phi]))
    assert palm is not None and "e0 flush on the palm, is up to -1.5 deg" in describe_miss(
        scene, palm
    )


def test_places_of_the_grid_have_their_labels_however_often_the_object_has_turned() -> None:
    rng = np.random.default_rng(1)
    scene = make_scene(convex_polygon(rng, 5))
    grid = map_labels(scene)
    poses = np.column_stack([rng.uniform(-0.3, 0.3, 200), rng.uniform(-9, 9, 200)])
    count = np.rint((poses - [grid.least, 0.0]) / grid.steps)
    nearest = [grid.least, 0.0] + count * grid.steps
    labels = label_cells(scene, *nearest.T)[:, [0, 2, 4]]
    seen = grid.labels[grid.look_up(poses)]
    assert (seen == labels).all()
    assert (labels != NOWHERE).any() and (labels == NOWHERE).any()


def test_nothing_touches_beyond_the_reach_of_a_finger() -> None:
    scene = make_scene()
    grid = map_labels(scene)
    for x in (-2.0, 2.0):
        assert (grid.labels[grid.look_up(np.array([x, 0.3]))] == NOWHERE).all()
