from __future__ import annotations

import casadi as ca
import numpy as np
import pytest

from wholearm.common.batch import FEW, SIZE, SOME, Batch


def build_function() -> ca.Function:
    """(x, y) -> (outer product with a structural shape of its own, a sum)."""
    x, y = ca.SX.sym("x", 3), ca.SX.sym("y", 2)
    return ca.Function("f", [x, y], [ca.mtimes(x, y.T) + 1, ca.sin(ca.sum1(x)) * y[0]])


@pytest.mark.parametrize(
    "count", [0, 1, FEW, FEW + 1, SOME, SOME + 1, SIZE - 1, SIZE, SIZE + 1, 3 * SIZE + 5]
)
def test_batches_agree_with_single_calls(count: int) -> None:
    rng = np.random.default_rng(count)
    function = build_function()
    x, y = rng.uniform(-1, 1, (count, 3)), rng.uniform(-1, 1, (count, 2))
    outer, total = Batch(function)(x, y)
    assert outer.shape == (count, 3, 2) and total.shape == (count, 1, 1)
    for k in range(count):
        one, other = function(x[k], y[k])
        np.testing.assert_array_equal(outer[k], one.full())
        np.testing.assert_array_equal(total[k], other.full())


def test_results_survive_the_next_call() -> None:
    batch = Batch(build_function())
    first = batch(np.ones((2, 3)), np.ones((2, 2)))[0]
    kept = first.copy()
    batch(np.zeros((2, 3)), np.zeros((2, 2)))
    np.testing.assert_array_equal(first, kept)


def test_strided_arguments() -> None:
    rng = np.random.default_rng(3)
    wide = rng.uniform(-1, 1, (10, 6))
    batch = Batch(build_function())
    found = batch(wide[::2, ::2], wide[::-2, 4:])
    expected = batch(wide[::2, ::2].copy(), wide[::-2, 4:].copy())
    for one, other in zip(found, expected, strict=True):
        np.testing.assert_array_equal(one, other)
