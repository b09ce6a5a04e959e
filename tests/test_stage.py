from __future__ import annotations

import numpy as np

from test_time_layout import random_points


def test_breaks_and_places_follow_the_shares_of_the_intervals() -> None:
    part = random_points(np.random.default_rng(1), 3, 3, 4)._replace(
        fractions=np.array([0.5, 0.2, 0.3])
    )
    np.testing.assert_allclose(part.breaks, [0.0, 0.5, 0.7, 1.0], atol=1e-13)
    places = part.places(np.array([0.0, 0.5, 1.0]))
    expected = [[0.0, 0.25, 0.5], [0.5, 0.6, 0.7], [0.7, 0.85, 1.0]]
    np.testing.assert_allclose(places, expected, atol=1e-13)


def test_the_last_break_is_exactly_the_end() -> None:
    # Shares of a tenth do not add up to one in binary.
    part = random_points(np.random.default_rng(2), 10, 2, 3)
    assert np.cumsum(part.fractions)[-1] != 1.0
    assert part.breaks[-1] == 1.0
