from __future__ import annotations

import numpy as np
import pytest

from wholearm.benchmark.stress.newton import clearances, separate
from wholearm.problem.definition import Problem
from wholearm.results.trajectory import Trajectory

SQUARE = np.array([[[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]]])


@pytest.mark.parametrize(
    ("segment", "apart"),
    [
        ([[2.0, 0.5], [3.0, 0.5]], 1.0),
        ([[2.0, 2.0], [3.0, 2.0]], np.sqrt(2.0)),
        ([[-1.0, 1.2], [2.0, 1.2]], 0.2),
        ([[-1.0, 0.9], [2.0, 0.9]], -0.1),
        ([[0.95, 0.5], [3.0, 0.5]], -0.05),
        ([[0.5, 0.5], [0.5, 5.0]], -0.5),
    ],
)
def test_distance_of_a_segment_and_a_square(segment: list[list[float]], apart: float) -> None:
    assert separate(SQUARE, np.array([segment]))[0] == pytest.approx(apart)
    assert separate(np.array([segment]), SQUARE)[0] == pytest.approx(apart)


def test_crossing_segments_overlap() -> None:
    one, other = np.array([[[0.0, 0.0], [2.0, 0.0]]]), np.array([[[1.0, -0.25], [1.0, 3.0]]])
    assert separate(one, other)[0] == pytest.approx(-0.25)


def test_a_plan_touches_and_does_not_overlap(heptagon: Problem, trajectory: Trajectory) -> None:
    apart = clearances(heptagon.scene, trajectory.z)
    for pair in ("object and palm", "object and finger 1", "object and finger 2"):
        assert np.abs(apart[pair]).max() < 1e-12
    deeper = trajectory.z + np.array([0.0, -0.001, 0.0, 0.0, 0.0])
    assert clearances(heptagon.scene, deeper)["object and palm"].min() == pytest.approx(-0.001)
