"""Regions of grids, beside SciPy's."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import ndimage

from wholearm.figures.map_lines import choose_tints, find_room, split


@pytest.mark.parametrize("seed", range(6))
def test_parts_and_their_rooms_are_those_of_scipy(seed: int) -> None:
    rng = np.random.default_rng(seed)
    field = ndimage.gaussian_filter(rng.normal(size=(40, 50)), rng.uniform(0.5, 4.0))
    cell = np.digitize(field, np.quantile(field, [0.2, 0.5, 0.8])) - 1
    step, parts = rng.uniform(0.2, 3.0, 2), list(split(cell))
    expected = []
    for k in range(3):
        number, count = ndimage.label(cell == k)
        expected += [(k, number == n + 1) for n in range(count)]
    assert [k for k, _ in parts] == [k for k, _ in expected]
    for (_, region), (_, other) in zip(parts, expected, strict=True):
        np.testing.assert_array_equal(region, other)
        room = ndimage.distance_transform_edt(np.pad(other, 1), sampling=step)[1:-1, 1:-1]
        row, column, found = find_room(region, step)
        assert found == pytest.approx(room.max()) == pytest.approx(room[row, column])


def test_neighbours_have_tints_of_their_own() -> None:
    cell = np.array([[0, 0, 1], [2, -1, 1], [2, 3, 3]])
    tints = choose_tints(cell, 3)
    assert all(tints[a] != tints[b] for a, b in ((0, 1), (0, 2), (1, 3), (2, 3)))
    assert set(tints.tolist()) <= {0, 1, 2}
