from __future__ import annotations

import math

import pytest

from wholearm.robustness.sampling import Z, count_share


@pytest.mark.parametrize("count, total", [(1, 7), (50, 100), (998, 1000)])
def test_ends_of_the_interval_are_as_unlikely_as_it_says(count: int, total: int) -> None:
    """Wilson's definition: the share is Z standard deviations off at both ends."""
    share = count_share(count, total)
    for p in (share.low, share.high):
        assert abs(share.value - p) == pytest.approx(Z * math.sqrt(p * (1 - p) / total), rel=1e-9)
    assert share.low < share.value < share.high


def test_none_and_all_have_one_open_end() -> None:
    none, every = count_share(0, 20), count_share(20, 20)
    # (1 - p)^n = ... is replaced by the normal law: p = Z^2 / (n + Z^2).
    assert (none.low, none.high) == pytest.approx((0.0, Z**2 / (20 + Z**2)), rel=1e-12)
    assert (every.low, every.high) == pytest.approx((1 - Z**2 / (20 + Z**2), 1.0), rel=1e-12)
    assert str(every) == "100.0 % (20 of 20, 95 %: 83.9 to 100.0 %)"


def test_nothing_says_nothing() -> None:
    share = count_share(0, 0)
    assert math.isnan(share.value) and (share.low, share.high) == (0.0, 1.0)
    assert str(share) == "none"
