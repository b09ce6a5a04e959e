from __future__ import annotations

import math

import numpy as np
import pytest

from wholearm.verification.margins import find_lowest


def test_least_of_a_parabola_is_exact() -> None:
    t = np.array([0.0, 0.4, 1.0])
    least, time = find_lowest(t, (t - 0.55) ** 2 + 0.2, t[[0, -1]])
    assert least == pytest.approx(0.2, abs=1e-15)
    assert time == pytest.approx(0.55, abs=1e-15)


def test_no_parabola_crosses_a_kink_or_a_jump() -> None:
    flat_then_steep = np.array([0.05, 0.05, 0.05, 1.0, 2.0])
    t = np.array([0.0, 0.1, 0.2, 0.3, 0.4])
    assert find_lowest(t, flat_then_steep, np.array([0.0, 0.2, 0.4]))[0] == 0.05
    t = np.array([0.0, 0.1, 0.1, 0.2, 0.3])
    values = np.array([1.0, 1.0, 0.2, 0.3, 0.5])
    # Inside the second stretch the parabola through its three points has its least at its start.
    assert find_lowest(t, values, np.array([0.0, 0.3]))[0] == pytest.approx(0.2, abs=0.01)
    assert all(math.isnan(x) for x in find_lowest(t, np.full(5, np.nan), t))
