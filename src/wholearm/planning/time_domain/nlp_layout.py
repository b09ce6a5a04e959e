"""Indices of the unknowns of the time-domain NLP, interval by interval, and its rows."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from ...common.arrays import Array, Expression
from ..columns import Columns
from .collocation import Scheme
from .stage import Stage, StagePoints

Indices = NDArray[np.int64]
Z, V = slice(0, 5), slice(5, 10)
"""Slices of a node's unknowns: z and z'. With a margin, that follows."""
STATE, MARGIN = 10, 10


@dataclass(frozen=True, eq=False)
class StageLayout:
    """Indices of one stage's unknowns."""

    nodes: Indices  # (K + 1, n): z and z' at the ends of intervals, and a margin if there is one
    h: Indices  # (K,): durations of the intervals
    tau: Indices  # (K, 2 m): control points of the torques in each interval, one after the other
    z: Indices  # z, v, a (K, d, 5): z, z' and z'' at the collocation points
    v: Indices
    a: Indices
    forces: Indices  # (K, d, n_f)
    short: Indices  # (K, n) or (K, 0): shortfalls of limits in each interval
    impulses: Indices  # of the impact that leads to the next stage, if one does
    begin: (
        Indices  # begin, finish: forces at rest at both ends of the motion, of continuous torques
    )
    finish: Indices

    @property
    def stop(self) -> int:
        """Past its last unknown."""
        return 1 + max(int(part.max(initial=-1)) for part in vars(self).values())


def lay_out(
    stages: Sequence[Stage],
    scheme: Scheme,
    with_margin: bool = False,
    shortfalls: Sequence[int] | None = None,
    held: bool = False,
) -> list[StageLayout]:
    """Indices of the unknowns of successive stages.

    `shortfalls` are numbers of them in each interval of a stage; `held`: torques hold both ends.
    """
    layouts: list[StageLayout] = []
    stop, d = 0, scheme.degree
    for k, (stage, coming) in enumerate(zip(stages, [*stages[1:], None], strict=True)):
        point = Columns(z=5, v=5, a=5, forces=stage.formation.n_constraints)
        end, short = (0 if scheme.ends else STATE), shortfalls[k] if shortfalls else 0
        sizes = {"h": 1, "tau": 2 * scheme.controls, "points": d * point.count}
        interval = Columns(**sizes, end=end, short=short, m=int(with_margin))
        begin = stop + np.arange(point.sizes["forces"] * (held and not layouts))
        first = stop + len(begin) + np.arange(STATE + with_margin)
        starts = first[-1] + 1 + interval.count * np.arange(stage.intervals)
        own = {
            name: starts[:, None] + np.arange(part.start, part.stop)
            for name, part in interval.slices.items()
        }
        points = own["points"].reshape(stage.intervals, d, point.count)
        at = {name: points[..., part] for name, part in point.slices.items()}
        ends = points[:, -1, :STATE] if scheme.ends else own["end"]
        nodes = np.vstack([first, np.hstack([ends, own["m"]])])
        stop = int(first[-1]) + 1 + interval.count * stage.intervals
        ends_in_impact = coming is not None and stage.ends_in_impact
        extra = coming.formation.n_constraints if coming is not None and ends_in_impact else 0
        layouts.append(
            StageLayout(
                nodes=nodes,
                h=own["h"][:, 0],
                tau=own["tau"],
                **at,
                short=own["short"],
                impulses=stop + np.arange(extra),
                begin=begin,
                finish=stop + np.arange(point.sizes["forces"] * (held and coming is None)),
            )
        )
        stop += extra + len(layouts[-1].finish)
    return layouts


def pack(points: Sequence[StagePoints], layouts: Sequence[StageLayout], margin: float) -> Array:
    """Unknowns as one vector."""
    x = np.zeros(layouts[-1].stop)
    for part, layout in zip(points, layouts, strict=True):
        x[layout.z], x[layout.v], x[layout.a] = part.z, part.v, part.a
        x[layout.forces], x[layout.tau] = part.forces, part.tau.reshape(len(part.tau), -1)
        x[layout.h], x[layout.short] = part.duration * part.fractions, 1.0
        x[layout.nodes[:, Z]], x[layout.nodes[:, V]] = part.nodes[:, 0], part.nodes[:, 1]
        x[layout.nodes[:, MARGIN:]] = margin
        x[layout.impulses] = part.impulses
        x[layout.begin] = part.forces[0, 0, : len(layout.begin)]
        x[layout.finish] = part.forces[-1, -1, : len(layout.finish)]
    return x


def unpack(x: Array, layouts: Sequence[StageLayout]) -> list[StagePoints]:
    """What `pack` put together."""
    parts = []
    for own in layouts:
        duration = float(x[own.h].sum())
        nodes = x[own.nodes[:, :STATE]].reshape(-1, 2, 5)
        z, v, a, forces = (x[part] for part in (own.z, own.v, own.a, own.forces))
        tau = x[own.tau].reshape(len(own.tau), -1, 2)
        fractions, impulses = x[own.h] / duration, x[own.impulses]
        parts.append(StagePoints(duration, fractions, nodes, z, v, a, forces, tau, impulses))
    return parts


class NlpRows:
    """Constraints in the order in which they are added, with their bounds."""

    def __init__(self) -> None:
        self.blocks: list[Block] = []
        self._count = 0
        self._low: list[Array] = []
        self._high: list[Array] = []
        self._linear: list[Indices] = []
        self._entries: list[tuple[Array, Array, Array]] = []

    def __getstate__(self) -> dict[str, Any]:
        # Which rows there are, and their bounds: kernels belong to CasADi.
        return self.__dict__ | {"blocks": [], "_entries": []}

    def nonlinear(self, *shape: int, low: Any = 0.0, high: Any = 0.0) -> Indices:
        """Rows of a kernel, equal to zero unless bounds are given."""
        own = self._count + np.arange(int(np.prod(shape))).reshape(shape)
        self._count += own.size
        for bounds, given in ((self._low, low), (self._high, high)):
            bounds.append(np.broadcast_to(np.asarray(given, dtype=float), shape).ravel())
        return own

    def linear(self, *shape: int, low: Any = 0.0, high: Any = 0.0) -> Indices:
        """Rows that are sums of unknowns, equal to zero unless bounds are given."""
        own = self.nonlinear(*shape, low=low, high=high)
        self._linear.append(own.ravel())
        return own

    def add_entries(self, rows: Any, columns: Any, values: Any) -> None:
        """Add entries to linear rows; the three are broadcast against one another."""
        parts = np.broadcast_arrays(rows, columns, np.asarray(values, dtype=float))
        self._entries.append((parts[0].ravel(), parts[1].ravel(), parts[2].ravel()))

    def add_copies(
        self, kernel: Kernel, columns: Indices, rows: Indices, parameters: Array | None = None
    ) -> None:
        """Say which rows are copies of a kernel, one for all but the last axis of `columns`."""
        table = columns.reshape(-1, columns.shape[-1])
        given = np.zeros((len(table), 0)) if parameters is None else parameters
        own = rows.reshape(len(table), -1)
        self.blocks.append(Block(kernel, table, own, given.reshape(len(table), -1)))

    def add_cost(self, kernel: Kernel, columns: Indices, parameters: Array | None = None) -> None:
        """Add copies of a kernel to the cost."""
        self.add_copies(kernel, columns, np.zeros((len(columns), 0), dtype=np.int64), parameters)

    @property
    def bounds(self) -> tuple[Array, Array]:
        """Lower and upper bounds of all rows."""
        return np.concatenate(self._low), np.concatenate(self._high)

    @property
    def linear_rows(self) -> Indices:
        """Which rows are linear."""
        return np.concatenate(self._linear)

    @property
    def triplets(self) -> Triplets:
        """Entries of the linear rows."""
        return Triplets(*(np.concatenate(part) for part in zip(*self._entries, strict=True)))


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
