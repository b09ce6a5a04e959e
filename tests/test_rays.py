from __future__ import annotations

import math
import warnings
from functools import cache

import numpy as np
import pytest

from shipped import HEPTAGON, SQUARE, problem_of
from wholearm.contacts.closing import contact_table, first_contact
from wholearm.contacts.explicit import measure_gap, place
from wholearm.geometry.curve import Curve
from wholearm.geometry.tracing import trace_curve, trace_phases
from wholearm.mapping.borders import label_cells
from wholearm.mapping.formation_map import Border
from wholearm.planning.lower_bound.lower_bound import look_along
from wholearm.planning.lower_bound.speed_sweep import NoMotionError
from wholearm.problem.definition import Until
from wholearm.search import times
from wholearm.search.cell_paths import can_set_out, time_ways
from wholearm.search.edges import cut_curve
from wholearm.search.places import RoadmapPlace, list_formations_at, make_place, unit_steps
from wholearm.search.roadmap import BESIDE, Rays, shoot
from wholearm.search.times import time_borders

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
    poses = rays.starts[:, None] + parts[:, None] * rays.ways[:, None]
    labels = label_cells(scene, *poses.reshape(-1, 2).T)[:, [0, 2, 4]]
    assert (labels.reshape(len(poses), -1, 3) == rays.labels[:, None]).all()


def test_rays_end_right_before_what_they_gain_touches() -> None:
    own, rays = around_the_start()
    scene = own.scene
    before = measure_gap(scene, rays.gained, place(scene, rays.labels, rays.ends))
    assert (before > 0).all()
    lengths = np.linalg.norm(rays.ways / unit_steps(scene), axis=1)[:, None]
    ends = rays.ends + BESIDE * rays.ways / lengths
    assert (measure_gap(scene, rays.gained, place(scene, rays.labels, ends)) < 0).all()


def test_no_way_is_faster_with_more_to_press() -> None:
    own, rays = around_the_start()
    epsilon = problem_of(SQUARE).epsilon
    times, harder = (
        time_ways(own.scene, least, rays.labels, rays.starts, rays.ends)
        for least in (epsilon, 4 * epsilon)
    )
    assert np.isfinite(times).any() and (harder >= times * (1 - 1e-12)).all()
    one = time_ways(own.scene, epsilon, rays.labels[:1], rays.starts[:1], rays.ends[:1])
    assert one[0] == pytest.approx(times[0], rel=1e-9)


def test_only_ways_that_can_be_set_out_on_have_times() -> None:
    own, rays = around_the_start()
    epsilon = problem_of(SQUARE).epsilon
    times = time_ways(own.scene, epsilon, rays.labels, rays.starts, rays.ends)
    assert can_set_out(own.scene, epsilon, rays.labels, rays.starts, rays.ways).all()
    assert np.isfinite(times).any()
    assert not can_set_out(own.scene, 1e3, rays.labels, rays.starts, rays.ways).any()
    assert np.isinf(time_ways(own.scene, 1e3, rays.labels, rays.starts, rays.ends)).all()


def test_ways_beyond_the_reach_of_a_tip_have_no_time() -> None:
    own, rays = around_the_start()
    labels, epsilon = rays.labels.copy(), problem_of(SQUARE).epsilon
    labels[:, 1] = first_contact(own.scene, 0) + own.scene.polygon.n_vertices
    far = rays.starts + np.array([1.0, 0.0])
    assert np.isinf(time_ways(own.scene, epsilon, labels, rays.starts, far)).all()
    assert not can_set_out(own.scene, epsilon, labels, far, rays.ways).any()


def look(curve: Curve, epsilon: float) -> float:
    try:
        return look_along((curve,), epsilon, 100)
    except NoMotionError:
        return math.inf


def make_border(curve: Curve) -> Border:
    z = curve.evaluate(np.linspace(0, curve.length, 12)).z
    still = np.zeros(len(z), dtype=bool)
    return Border(curve.formation.contacts, (None, 0), "x", z[:, [0, 2]], z, still, still, still)


def test_times_of_borders_are_those_of_sweeps_along_traced_curves() -> None:
    problem = problem_of(HEPTAGON)
    curves = trace_phases(problem)
    expected = []
    for forth in curves:
        way = -forth.evaluate(np.array([forth.length])).z_s[0]
        back = cut_curve(trace_curve(forth.formation, forth.end, way, Until()), forth.length)
        expected.append([look(own, problem.epsilon) for own in (forth, back)])
    found = time_borders(problem, [make_border(curve) for curve in curves])
    # Twelve points and twenty-four intervals leave an error of a few in a hundred.
    assert found == pytest.approx(np.array(expected), rel=0.04)
    assert np.isfinite(found[:, 0]).all()


def test_borders_with_ambiguous_forces_are_not_passed(monkeypatch: pytest.MonkeyPatch) -> None:
    """With or without viscous friction, and without a warning."""
    problem = problem_of(HEPTAGON)
    (curve,) = trace_phases(problem)[:1]
    monkeypatch.setattr(times, "UNIQUENESS_MARGIN", 1.1)
    for own in (problem, problem.with_(viscous=0.0)):
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            assert np.isinf(time_borders(own, [make_border(curve)])).all()
