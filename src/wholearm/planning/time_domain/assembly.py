"""NLPs assembled from repeated expressions with their derivatives.

Constraints of a discretized motion are copies of a few expressions (`Kernel`), each with its
columns and rows (`Block`). The Jacobian selects entries of those of the kernels, the Hessian sums.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from ...common.arrays import Array, Expression

Indices = NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class Kernel:
    """An expression y(x, p) with derivatives, as CasADi functions of (x, p) and multipliers."""

    function: Expression  # (x, p) -> y
    jacobian: Expression  # (x, p) -> the entries dy_i / dx_j at `jacobian_at`
    hessian: Expression  # (x, p, lam) -> entries of the Hessian of lam^T y at `hessian_at`, i <= j
    jacobian_at: Indices  # jacobian_at, hessian_at (2, n): row and column of each entry
    hessian_at: Indices

    @property
    def outputs(self) -> int:
        """Number of rows of y."""
        return int(self.function.size1_out(0))


def build_kernel(x: Expression, p: Expression, y: Expression) -> Kernel:
    """Build the kernel of an SX expression `y` of the symbols `x` and `p`, all column vectors."""
    y = ca.densify(y)
    lam = ca.SX.sym("lam", y.numel())
    J = ca.jacobian(y, x)
    H = ca.triu(ca.hessian(ca.dot(lam, y), x)[0])
    return Kernel(
        ca.Function("value", [x, p], [y]),
        ca.Function("jacobian", [x, p], [_entries(J)]),
        ca.Function("hessian", [x, p, lam], [_entries(H)]),
        np.array(J.sparsity().get_triplet(), dtype=np.int64),
        np.array(H.sparsity().get_triplet(), dtype=np.int64),
    )


def _entries(matrix: Expression) -> Expression:
    return ca.vertcat(*matrix.nonzeros()) if matrix.nnz() else ca.SX(0, 1)


class Block(NamedTuple):
    """Copies of a kernel."""

    kernel: Kernel
    columns: Indices  # (n, n_x): the unknowns that are each copy's x, no one twice
    rows: Indices  # (n, n_y): the constraints that are its y; shape (n, 0) if y is part of the cost
    parameters: Array  # (n, n_p)


class Triplets(NamedTuple):
    """Entries of a sparse matrix."""

    rows: Indices
    columns: Indices
    values: Array


class Assembled(NamedTuple):
    """An NLP ready for a solver."""

    nlp: dict[str, Expression]  # expressions of x, f and g
    derivatives: dict[str, Expression]  # `jac_g` and `hess_lag`, options of CasADi's solvers


def assemble_nlp(
    size: int, linear: Triplets, n_linear: Indices, blocks: Sequence[Block], cost: Array
) -> Assembled:
    """Assemble an NLP of `size` unknowns from linear rows, blocks, and a linear cost, (size,).

    `n_linear` are all linear rows; every other row belongs to one block.
    """
    x, p, lam_f = ca.MX.sym("x", size), ca.MX.sym("p", 0), ca.MX.sym("lam_f")
    rows_of = [n_linear] + [block.rows.ravel() for block in blocks]
    order = np.argsort(np.concatenate(rows_of), kind="stable")
    lam_g = ca.MX.sym("lam_g", len(order))
    inputs = [_select(x, block.columns) for block in blocks]
    given = [ca.DM(block.parameters.T) for block in blocks]
    values = [
        block.kernel.function.map(len(block.columns))(here, p_)
        for block, here, p_ in zip(blocks, inputs, given, strict=True)
    ]
    f = ca.dot(ca.DM(cost), x)
    position = np.full(len(order), -1)
    position[n_linear] = np.arange(len(n_linear))
    entries = position[linear.rows].tolist(), linear.columns.tolist(), ca.DM(linear.values)
    L = ca.DM.triplet(*entries, len(n_linear), size)
    parts = [L @ x]
    for block, value in zip(blocks, values, strict=True):
        if block.rows.size:
            parts.append(ca.vec(value))
        else:
            f += ca.sum2(value)
    g = ca.vertcat(*parts)[order.tolist()]
    jacobian = _assemble_jacobian(size, linear, blocks, inputs, given, len(order))
    hessian = _assemble_hessian(size, blocks, inputs, given, (lam_f, lam_g))
    return Assembled(
        {"x": x, "f": f, "g": g},
        {
            "jac_g": ca.Function("jac_g", [x, p], [g, jacobian]),
            "hess_lag": ca.Function("hess_lag", [x, p, lam_f, lam_g], [hessian]),
        },
    )


def _select(x: Expression, columns: Indices) -> Expression:
    return ca.reshape(x[columns.ravel().tolist()], columns.shape[1], columns.shape[0])


def _assemble_jacobian(
    size: int,
    linear: Triplets,
    blocks: Sequence[Block],
    inputs: Sequence[Expression],
    given: Sequence[Expression],
    n_rows: int,
) -> Expression:
    rows, columns, entries = [linear.rows], [linear.columns], [ca.MX(ca.DM(linear.values))]
    for block, here, p in zip(blocks, inputs, given, strict=True):
        if block.rows.size:
            i, j = block.kernel.jacobian_at
            rows.append(block.rows[:, i].ravel())
            columns.append(block.columns[:, j].ravel())
            entries.append(ca.vec(block.kernel.jacobian.map(len(block.columns))(here, p)))
    row, column = np.concatenate(rows), np.concatenate(columns)
    order = np.lexsort((row, column))
    pattern = ca.Sparsity.triplet(n_rows, size, row[order].tolist(), column[order].tolist())
    return ca.MX(pattern, ca.vertcat(*entries)[order.tolist()])


def _assemble_hessian(
    size: int,
    blocks: Sequence[Block],
    inputs: Sequence[Expression],
    given: Sequence[Expression],
    multipliers: tuple[Expression, Expression],
) -> Expression:
    lam_f, lam_g = multipliers
    places, entries = [], []
    for block, here, p in zip(blocks, inputs, given, strict=True):
        count = len(block.columns)
        lam = _select(lam_g, block.rows) if block.rows.size else ca.repmat(lam_f, 1, count)
        ends = block.columns[:, block.kernel.hessian_at]
        places.append((ends.max(axis=1) * size + ends.min(axis=1)).ravel())
        entries.append(ca.vec(block.kernel.hessian.map(count)(here, p, lam)))
    place = np.concatenate(places)
    unique, owner = np.unique(place, return_inverse=True)
    gather = ca.DM.triplet(
        owner.tolist(),
        np.arange(len(place)).tolist(),
        ca.DM.ones(len(place)),
        len(unique),
        len(place),
    )
    pattern = ca.Sparsity.triplet(size, size, (unique % size).tolist(), (unique // size).tolist())
    return ca.MX(pattern, gather @ ca.vertcat(*entries))
