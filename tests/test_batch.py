from __future__ import annotations

import casadi as ca
import numpy as np
import pytest

from wholearm.common.batch import FEW, SIZE, SOME, Batch
from wholearm.planning.columns import Columns


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


COLUMNS = Columns(z=5, h=1, tau=4)


def test_blocks_are_joined_by_name_whatever_their_order() -> None:
    tau, z = np.arange(24.0).reshape(2, 3, 4), np.arange(5.0)
    joined = COLUMNS.join(tau=tau, z=z, h=np.full((2, 1, 1), 7.0))
    assert joined.shape == (2, 3, 10)
    np.testing.assert_array_equal(joined[..., COLUMNS["tau"]], tau)
    np.testing.assert_array_equal(joined[1, 2, COLUMNS["z"]], z)
    assert (joined[..., COLUMNS["h"]] == 7.0).all()


def test_symbols_stand_where_numbers_do() -> None:
    x = COLUMNS.make_symbols()
    function = ca.Function("f", [x.every], [x.tau[1], x.h, x.z])
    given = COLUMNS.join(z=np.arange(5.0), h=[5.0], tau=6.0 + np.arange(4.0))
    second, h, z = (float(part[0]) for part in function(given))
    assert (second, h, z) == (7.0, 5.0, 0.0)


@pytest.mark.parametrize(
    "blocks",
    [
        {"z": np.zeros(5), "h": np.zeros(1)},
        {"z": np.zeros(5), "h": np.zeros(1), "tau": np.zeros(3)},
        {"z": np.zeros(5), "h": np.zeros(1), "torque": np.zeros(4)},
    ],
    ids=["missing", "too short", "another name"],
)
def test_what_was_not_declared_is_refused(blocks: dict[str, np.ndarray]) -> None:
    with pytest.raises(ValueError, match=r"are given where .* are declared"):
        COLUMNS.join(**blocks)
    with pytest.raises(ValueError, match=r"are given where .* are declared"):
        COLUMNS.write(**{name: ca.SX(block) for name, block in blocks.items()})
