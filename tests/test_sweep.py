"""Least times of many ways at once, against closed forms."""

from __future__ import annotations

import numpy as np
import pytest

from wholearm.planning.lower_bound.rows import PathLimitRows
from wholearm.search.travel_times import find_durations

LENGTH, COUNT = 2.0, 64


def push() -> tuple[PathLimitRows, tuple[np.ndarray, np.ndarray]]:
    """|s''| <= 1 along a way."""
    shape = (1, COUNT, 2)
    a = np.broadcast_to([1.0, -1.0], shape).copy()
    rows = PathLimitRows(
        a, np.zeros(shape), np.zeros(shape), np.ones(shape), np.full((1, COUNT), np.inf)
    )
    return rows, (np.full(COUNT, LENGTH / COUNT), np.full(COUNT, 0.5))


def test_half_the_way_is_for_speeding_up_and_half_for_braking() -> None:
    rows, grid = push()
    # With s'' the same in each interval this motion is on the grid, where intervals are even.
    assert find_durations(rows, *grid)[0] == pytest.approx(2 * np.sqrt(LENGTH), rel=1e-9)


def test_where_nothing_limits_the_speed_there_is_still_a_time() -> None:
    rows, grid = push()
    rows.a[0, COUNT // 2] = 0.0
    least = find_durations(rows, *grid)[0]
    # To and from the middle it speeds up and brakes as before, at most.
    assert 0.9 * 2 * np.sqrt(LENGTH) < least < 2 * np.sqrt(LENGTH) * (1 + 1e-9)


@pytest.mark.filterwarnings("error")
def test_a_closed_place_lets_no_viscous_motion_pass() -> None:
    rows, grid = push()
    closed = slice(0, COUNT // 4)
    rows.a[0, closed], rows.one[0, closed] = 0.0, -1.0
    rows.v[:] = -0.1
    assert find_durations(rows, *grid)[0] == np.inf
