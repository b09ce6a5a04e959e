from __future__ import annotations

import casadi as ca
import numpy as np

from wholearm.planning.time_domain.assembly import Kernel, build_kernel
from wholearm.planning.time_domain.nlp_layout import NlpRows


def product() -> Kernel:
    x, p = ca.SX.sym("x", 2), ca.SX.sym("p", 1)
    return build_kernel(x, p, x[0] * x[1] * p)


def test_rows_are_numbered_in_the_order_in_which_they_come() -> None:
    rows = NlpRows()
    first, second, third = rows.linear(2, 3), rows.nonlinear(4), rows.linear(1)
    np.testing.assert_array_equal(first, [[0, 1, 2], [3, 4, 5]])
    np.testing.assert_array_equal(second, [6, 7, 8, 9])
    np.testing.assert_array_equal(rows.linear_rows, [0, 1, 2, 3, 4, 5, 10])
    assert third.tolist() == [10]


def test_rows_are_equations_unless_bounds_are_given() -> None:
    rows = NlpRows()
    rows.linear(2)
    rows.nonlinear(2, 2, low=[[1.0, 2.0]], high=np.inf)
    rows.linear(2, low=[5.0, 6.0], high=7.0)
    low, high = rows.bounds
    np.testing.assert_array_equal(low, [0, 0, 1, 2, 1, 2, 5, 6])
    np.testing.assert_array_equal(high, [0, 0, *[np.inf] * 4, 7, 7])


def test_entries_are_spread_over_rows_and_columns() -> None:
    rows = NlpRows()
    own = rows.linear(2, 3)
    rows.add_entries(own, np.array([[7], [8]]), [1.0, 2.0, 3.0])
    rows.add_entries(own[1], 9, -1.0)
    dense = np.zeros((6, 10))
    np.add.at(dense, (rows.triplets.rows, rows.triplets.columns), rows.triplets.values)
    expected = np.zeros((6, 10))
    expected[:3, 7] = expected[3:, 8] = [1, 2, 3]
    expected[3:, 9] = -1
    np.testing.assert_array_equal(dense, expected)


def test_kernels_are_repeated_and_charged() -> None:
    rows, kernel = NlpRows(), product()
    columns, given = np.array([[0, 1], [2, 3]]), np.array([[2.0], [3.0]])
    own = rows.nonlinear(2, 1)
    rows.add_copies(kernel, columns, own, given)
    rows.add_cost(kernel, columns, given)
    rows.add_copies(kernel, columns[:1], rows.nonlinear(1, 1))
    repeated, charged, plain = rows.blocks
    np.testing.assert_array_equal(repeated.rows, own)
    np.testing.assert_array_equal(repeated.parameters, given)
    assert charged.rows.shape == (2, 0) and plain.parameters.shape == (1, 0)
    # What is charged is no constraint.
    assert len(rows.bounds[0]) == 3
