from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np

from shipped import SQUARE, problem_of
from wholearm.contacts.closing import contact_table
from wholearm.contacts.explicit import measure_gap, place
from wholearm.mapping.borders import label_cells
from wholearm.search.places import RoadmapPlace, list_formations_at, make_place, unit_steps
from wholearm.search.roadmap import BESIDE, Rays, shoot

PARTS = 50


@cache
def around_the_start() -> tuple[RoadmapPlace, Rays]:
    problem = problem_of(SQUARE)
    own = make_place(problem.scene, problem.start)
    return own, shoot([own], problem.epsilon)


def test_rays_stay_in_a_cell_of_the_place_until_a_contact_is_gained() -> None:
    own, rays = around_the_start()
    scene, table = own.scene, contact_table(own.scene)
    cells = [cell.contacts for cell in list_formations_at(own, 3)]
    assert len(np.unique(rays.gained)) > 1
    for label, gained in zip(rays.labels, rays.gained, strict=True):
        assert tuple(table[k] for k in label) in cells
        assert table[gained] not in own.contacts
    parts = np.arange(1, PARTS + 1) / PARTS
    poses = rays.starts[:, None] + parts[:, None] * rays.runs[:, None]
    labels = label_cells(scene, *poses.reshape(-1, 2).T)[:, [0, 2, 4]]
    assert (labels.reshape(len(poses), -1, 3) == rays.labels[:, None]).all()


def test_rays_end_right_before_what_they_gain_touches() -> None:
    own, rays = around_the_start()
    scene = own.scene
    before = measure_gap(scene, rays.gained, place(scene, rays.labels, rays.ends))
    assert (before > 0).all()
    lengths = np.linalg.norm(rays.runs / unit_steps(scene), axis=1)[:, None]
    ends = rays.ends + BESIDE * rays.runs / lengths
    assert (measure_gap(scene, rays.gained, place(scene, rays.labels, ends)) < 0).all()


def test_each_place_has_the_rays_that_it_has_alone() -> None:
    own, rays = around_the_start()
    epsilon = problem_of(SQUARE).epsilon
    both = shoot([own, own], epsilon)
    for source in (0, 1):
        mine = both.pick(both.sources == source)
        np.testing.assert_array_equal(mine.gained, rays.gained)
        np.testing.assert_allclose(mine.ends, rays.ends, rtol=1e-12)


def test_more_to_press_leaves_fewer_rays() -> None:
    own, rays = around_the_start()
    fewer = shoot([own], 4 * problem_of(SQUARE).epsilon)
    assert len(fewer.gained) < len(rays.gained)


def test_places_without_a_cell_have_no_rays() -> None:
    own, _ = around_the_start()
    epsilon = problem_of(SQUARE).epsilon
    assert not len(shoot([replace(own, contacts=own.contacts[:1])], epsilon).gained)
    assert not len(shoot([replace(own, contacts=())], epsilon).gained)
