"""An NLP assembled from linear rows and from copies of kernels, with its derivatives.

A kernel is an expression with derivatives that is built once, for all formations with the same
equations. Its copies have other unknowns and parameters.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import wraps
from typing import Any, NamedTuple, TypeVar

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from ...common.arrays import Array, Expression
from ...contacts.formation import Formation
from ..columns import Columns, Symbols

Indices = NDArray[np.int64]
_K = TypeVar("_K")


@dataclass(frozen=True, eq=False)
class Kernel:
    """An expression y(x, p) with derivatives, as CasADi functions of (x, p) and multipliers."""

    function: Expression  # (x, p) -> y
    jacobian: Expression  # (x, p) -> the entries dy_i / dx_j at `jacobian_at`
    hessian: Expression  # (x, p, lam) -> entries of the Hessian of lam^T y at `hessian_at`, i <= j
    jacobian_at: Indices  # jacobian_at, hessian_at (2, n): row and column of each entry
    hessian_at: Indices
    x: Columns  # named blocks of x, p and y
    p: Columns
    y: Columns

    @property
    def outputs(self) -> int:
        """Number of rows of y."""
        return self.y.count


def build_kernel(x: Symbols, p: Symbols | None = None, **y: Expression) -> Kernel:
    """Build the kernel of named SX expressions `y` of symbols."""
    p = Columns().make_symbols() if p is None else p
    columns = Columns(**{name: int(block.numel()) for name, block in y.items()})
    value = ca.densify(columns.write(**y))
    lam = ca.SX.sym("lam", columns.count)
    J = ca.jacobian(value, x.every)
    H = ca.triu(ca.hessian(ca.dot(lam, value), x.every)[0])

    def list_entries(matrix: Expression) -> Expression:
        return ca.vertcat(*matrix.nonzeros()) if matrix.nnz() else ca.SX(0, 1)

    return Kernel(
        ca.Function("value", [x.every, p.every], [value]),
        ca.Function("jacobian", [x.every, p.every], [list_entries(J)]),
        ca.Function("hessian", [x.every, p.every, lam], [list_entries(H)]),
        np.array(J.sparsity().get_triplet(), dtype=np.int64),
        np.array(H.sparsity().get_triplet(), dtype=np.int64),
        x.columns,
        p.columns,
        columns,
    )


def share(size: int) -> Callable[[Callable[..., _K]], Callable[..., _K]]:
    """Keep the last `size` kernels, each for all formations with the same equations."""

    def decorate(build: Callable[..., _K]) -> Callable[..., _K]:
        kept = dict[tuple[Any, ...], _K]()

        @wraps(build)
        def find(*args: Any) -> _K:
            key = tuple(arg.equations if isinstance(arg, Formation) else arg for arg in args)
            # The latest are last.
            kept[key] = kept.pop(key) if key in kept else build(*args)
            if len(kept) > size:
                del kept[next(iter(kept))]
            return kept[key]

        return find

    return decorate


class _Block(NamedTuple):
    """Copies of a kernel."""

    kernel: Kernel
    columns: Indices  # (n, n_x): the unknowns that are each copy's x, no one twice
    rows: Indices  # (n, n_y): the constraints that are its y; shape (n, 0) if y is part of the cost
    parameters: Array  # (n, n_p)


class NlpRows:
    """Constraints in the order in which they are added, with their bounds, and shares of a cost."""

    def __init__(self) -> None:
        self._blocks: list[_Block] = []
        self._count = 0
        self._low: list[Array] = []
        self._high: list[Array] = []
        self._linear: list[Indices] = []
        self._entries: list[tuple[Array, Array, Array]] = []

    def __getstate__(self) -> dict[str, Any]:
        # Which rows there are, and their bounds: kernels belong to CasADi.
        return self.__dict__ | {"_blocks": [], "_entries": []}

    def _add_rows(self, *shape: int, low: Any, high: Any) -> Indices:
        own = self._count + np.arange(int(np.prod(shape))).reshape(shape)
        self._count += own.size
        for bounds, given in ((self._low, low), (self._high, high)):
            bounds.append(np.broadcast_to(np.asarray(given, dtype=float), shape).ravel())
        return own

    def linear(self, *shape: int, low: Any = 0.0, high: Any = 0.0) -> Indices:
        """Rows that are sums of unknowns, equal to zero unless bounds are given."""
        own = self._add_rows(*shape, low=low, high=high)
        self._linear.append(own.ravel())
        return own

    def add_entries(self, rows: Any, columns: Any, values: Any) -> None:
        """Add entries to linear rows; the three are broadcast against one another."""
        parts = np.broadcast_arrays(rows, columns, np.asarray(values, dtype=float))
        self._entries.append((parts[0].ravel(), parts[1].ravel(), parts[2].ravel()))

    def add_equal(self, columns: Any, others: Any, scale: Any = 1.0) -> Indices:
        """Add rows by which unknowns, times a scale, are those of others; shape of `columns`."""
        own = self.linear(*np.shape(columns))
        self.add_entries(own, columns, scale)
        self.add_entries(own, others, -np.asarray(scale))
        return own

    def add_copies(
        self,
        kernel: Kernel,
        x: Mapping[str, Any],
        p: Mapping[str, Any] | None = None,
        *,
        low: Any = 0.0,
        high: Any = 0.0,
        cost: bool = False,
    ) -> Indices:
        """Add copies of a kernel with blocks of unknowns `x` and parameters `p` as rows or a cost.

        One for all but the last axis of the blocks, which are broadcast. Returns the rows, equal to
        zero unless bounds are given.
        """
        columns = kernel.x.join(**x)
        shape, count = columns.shape[:-1], columns[..., 0].size
        own = self._add_rows(*shape, 0 if cost else kernel.outputs, low=low, high=high)
        given = np.broadcast_to(kernel.p.join(**p or {}), (*shape, kernel.p.count))
        columns, rows = columns.reshape(count, -1), own.reshape(count, -1)
        if cost or rows.size:
            self._blocks.append(_Block(kernel, columns, rows, given.reshape(count, -1)))
        return own

    @property
    def bounds(self) -> tuple[Array, Array]:
        """Lower and upper bounds of all rows."""
        return np.concatenate(self._low), np.concatenate(self._high)

    def assemble(self, cost: Array) -> tuple[dict[str, Expression], dict[str, Expression]]:
        """Expressions of x, f and g with a linear cost, (n,), and `jac_g` and `hess_lag`.

        All rows that are not linear belong to one copy of a kernel.
        """
        size, blocks, none = len(cost), self._blocks, [np.zeros(0, dtype=np.int64)]
        linear = np.concatenate(self._linear or none)
        row, column, value = (
            np.concatenate([part[k] for part in self._entries] or none) for k in range(3)
        )
        x, p, lam_f = ca.MX.sym("x", size), ca.MX.sym("p", 0), ca.MX.sym("lam_f")
        order = np.argsort(
            np.concatenate([linear, *(b.rows.ravel() for b in blocks)]), kind="stable"
        )
        lam_g = ca.MX.sym("lam_g", len(order))
        place = np.full(len(order), -1)
        place[linear] = np.arange(len(linear))
        entries = place[row].tolist(), column.tolist(), ca.DM(value)
        parts = [ca.DM.triplet(*entries, len(linear), size) @ x]
        f = ca.dot(ca.DM(cost), x)
        jac_rows, jac_columns, jac = [row], [column], [ca.MX(ca.DM(value))]
        places, hess = [], []
        for kernel, columns, rows, parameters in blocks:
            count, given = len(columns), ca.DM(parameters.T)
            here = _select(x, columns)
            y = kernel.function.map(count)(here, given)
            lam = ca.repmat(lam_f, 1, count)
            if rows.size:
                parts.append(ca.vec(y))
                lam = _select(lam_g, rows)
                i, j = kernel.jacobian_at
                jac_rows.append(rows[:, i].ravel())
                jac_columns.append(columns[:, j].ravel())
                jac.append(ca.vec(kernel.jacobian.map(count)(here, given)))
            else:
                f += ca.sum2(y)
            ends = columns[:, kernel.hessian_at]
            places.append((ends.max(axis=1) * size + ends.min(axis=1)).ravel())
            hess.append(ca.vec(kernel.hessian.map(count)(here, given, lam)))
        g = ca.vertcat(*parts)[order.tolist()]
        jac_row, jac_column = np.concatenate(jac_rows), np.concatenate(jac_columns)
        sort = np.lexsort((jac_row, jac_column))
        pattern = ca.Sparsity.triplet(
            len(order), size, jac_row[sort].tolist(), jac_column[sort].tolist()
        )
        jacobian = ca.MX(pattern, ca.vertcat(*jac)[sort.tolist()])
        unique, owner = np.unique(np.concatenate(places or none), return_inverse=True)
        ones = owner.tolist(), list(range(len(owner))), ca.DM.ones(len(owner))
        gather = ca.DM.triplet(*ones, len(unique), len(owner))
        pattern = ca.Sparsity.triplet(
            size, size, (unique % size).tolist(), (unique // size).tolist()
        )
        hessian = ca.MX(pattern, gather @ ca.vertcat(ca.MX(0, 1), *hess))
        return {"x": x, "f": f, "g": g}, {
            "jac_g": ca.Function("jac_g", [x, p], [g, jacobian]),
            "hess_lag": ca.Function("hess_lag", [x, p, lam_f, lam_g], [hessian]),
        }


def _select(x: Expression, columns: Indices) -> Expression:
    return ca.reshape(x[columns.ravel().tolist()], columns.shape[1], columns.shape[0])
