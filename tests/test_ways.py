from __future__ import annotations

import numpy as np
import pytest

from shipped import SQUARE, problem_of
from test_rays import around_the_start
from wholearm.contacts.closing import first_contact
from wholearm.search.cell_paths import can_start, time_paths


def test_no_way_is_faster_with_more_to_press() -> None:
    own, rays = around_the_start()
    epsilon = problem_of(SQUARE).epsilon
    times, harder = (
        time_paths(own.scene, least, rays.labels, rays.starts, rays.ends)
        for least in (epsilon, 4 * epsilon)
    )
    assert np.isfinite(times).any() and (harder >= times * (1 - 1e-12)).all()
    one = time_paths(own.scene, epsilon, rays.labels[:1], rays.starts[:1], rays.ends[:1])
    assert one[0] == pytest.approx(times[0], rel=1e-9)


def test_only_ways_that_can_be_set_out_on_have_times() -> None:
    own, rays = around_the_start()
    epsilon = problem_of(SQUARE).epsilon
    times = time_paths(own.scene, epsilon, rays.labels, rays.starts, rays.ends)
    assert can_start(own.scene, epsilon, rays.labels, rays.starts, rays.runs).all()
    assert np.isfinite(times).any()
    assert not can_start(own.scene, 1e3, rays.labels, rays.starts, rays.runs).any()
    assert np.isinf(time_paths(own.scene, 1e3, rays.labels, rays.starts, rays.ends)).all()


def test_ways_beyond_the_reach_of_a_tip_have_no_time() -> None:
    own, rays = around_the_start()
    labels, epsilon = rays.labels.copy(), problem_of(SQUARE).epsilon
    labels[:, 1] = first_contact(own.scene, 0) + own.scene.polygon.n_vertices
    far = rays.starts + np.array([1.0, 0.0])
    assert np.isinf(time_paths(own.scene, epsilon, labels, rays.starts, far)).all()
    assert not can_start(own.scene, epsilon, labels, far, rays.runs).any()
