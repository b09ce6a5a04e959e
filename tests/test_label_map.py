from __future__ import annotations

import numpy as np

from plane import convex_polygon, make_scene
from wholearm.mapping.borders import NOWHERE, label_cells
from wholearm.search.roadmap import map_labels


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


def test_labels_are_found_in_the_list() -> None:
    grid = map_labels(make_scene())
    assert grid.find(grid.labels[[3, 1]]).tolist() == [3, 1]
    assert grid.find(np.array([[10**6, 0, 0]])).tolist() == [-1]
