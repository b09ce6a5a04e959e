"""Nonlinear programmes: named blocks, assembly from kernels, Ipopt, and solver statistics.

An NLP over time is assembled, with its derivatives, from linear rows and from copies of kernels. A
kernel is an expression with derivatives, built once for all formations with the same equations.
Its copies have different unknowns and parameters. All NLPs have the same Ipopt options. Signals
interrupt Ipopt, and its runs are recorded.
"""

from __future__ import annotations

import time
from collections import defaultdict
from collections.abc import Iterator, Mapping
from contextlib import AbstractContextManager, contextmanager
from contextvars import ContextVar
from dataclasses import astuple, dataclass
from functools import cached_property
from operator import add
from types import SimpleNamespace
from typing import Any, NamedTuple, TypeVar

import casadi as ca
import numpy as np

from ..common.arrays import Array, Expression, Numbers
from ..common.sharing import stored
from ..common.signals import beat, check
from ..contacts.formation import Formation

_T = TypeVar("_T")
Indices = Numbers
Symbols = SimpleNamespace  # columns of symbols by the names of `columns`
INTERRUPTED = "User_Requested_Stop"  # status of a solver after an interrupt only
_IPOPT_OPTIONS = {
    "print_level": 0,
    "sb": "yes",
    "tol": 1e-8,
    # The default relaxes every bound by 1e-8: success would not imply that limits hold.
    "bound_relax_factor": 0.0,
    "fast_step_computation": "yes",
    # Fixed ordering: the automatic one can differ between machines, and is slow on long grids.
    "mumps_permuting_scaling": 0,
    "mumps_pivot_order": 0,
    # Few iterations from a previous solution.
    "mu_strategy": "adaptive",
    "warm_start_init_point": "yes",
}


class Columns:
    """Named successive blocks of a vector, by their sizes."""

    def __init__(self, **sizes: int) -> None:
        self.sizes = sizes
        ends = np.cumsum([0, *sizes.values()]).tolist()
        self.slices = dict(zip(sizes, map(slice, ends[:-1], ends[1:]), strict=True))
        self.count: int = ends[-1]

    def __getitem__(self, name: str) -> slice:
        return self.slices[name]

    def make_symbols(self, **expressions: Expression) -> Symbols:
        """Columns of symbols, or given `expressions`, of each block; `stack` has all in one."""
        symbols = {name: ca.SX.sym(name, size) for name, size in self.sizes.items()} | expressions
        return SimpleNamespace(**symbols, columns=self, stack=self.write(**symbols))

    def write(self, **blocks: Expression) -> Expression:
        """One column of expressions, block by block."""
        self._check({name: int(block.numel()) for name, block in blocks.items()})
        return ca.vertcat(ca.SX(0, 1), *(ca.vec(blocks[name]) for name in self.sizes))

    def join(self, **blocks: Any) -> Any:
        """Concatenate arrays of all blocks, broadcast in other axes, to shape (..., count)."""
        tables = {name: np.asarray(block) for name, block in blocks.items()}
        self._check({name: table.shape[-1] for name, table in tables.items()})
        shape = np.broadcast_shapes(*(table.shape[:-1] for table in tables.values()))
        parts = [np.broadcast_to(tables[name], (*shape, self.sizes[name])) for name in self.sizes]
        return np.concatenate(parts or [np.zeros(0)], axis=-1)

    def _check(self, sizes: dict[str, int]) -> None:
        if sizes != self.sizes:
            raise ValueError(f"columns {sizes} are given where {self.sizes} are declared")


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


def build_kernel(x: Symbols, p: Symbols | None = None, **y: Expression) -> Kernel:
    """Build the kernel of named SX expressions `y` of symbols."""
    p = Columns().make_symbols() if p is None else p
    columns = Columns(**{name: int(block.numel()) for name, block in y.items()})
    value = ca.densify(columns.write(**y))
    lam = ca.SX.sym("lam", columns.count)
    J = ca.jacobian(value, x.stack)
    H = ca.triu(ca.hessian(ca.dot(lam, value), x.stack)[0])

    def list_entries(matrix: Expression) -> Expression:
        return ca.vertcat(*matrix.nonzeros()) if matrix.nnz() else ca.SX(0, 1)

    return Kernel(
        ca.Function("value", [x.stack, p.stack], [value]),
        ca.Function("jacobian", [x.stack, p.stack], [list_entries(J)]),
        ca.Function("hessian", [x.stack, p.stack, lam], [list_entries(H)]),
        np.array(J.sparsity().get_triplet(), dtype=np.int64),
        np.array(H.sparsity().get_triplet(), dtype=np.int64),
        x.columns,
        p.columns,
        columns,
    )


def _identify(*args: Any) -> tuple[Any, ...]:
    return tuple(arg.equations if isinstance(arg, Formation) else arg for arg in args)


cached_kernel = stored(_identify, max_size=64)
"""Decorator: caches kernels, each for all formations with the same equations."""


class _Block(NamedTuple):
    """Copies of a kernel."""

    kernel: Kernel
    columns: Indices  # (n, n_x): unknowns of each copy, without repetition
    rows: Indices  # (n, n_y): constraints of each copy; (n, 0) if y is part of the cost
    parameters: Array  # (n, n_p)


class NlpRows:
    """Constraints with bounds, in the order in which they are added, and terms of the cost."""

    def __init__(self) -> None:
        self._blocks: list[_Block] = []
        self._count = 0
        self._low: list[Array] = []
        self._high: list[Array] = []
        self._linear: list[Indices] = []
        self._entries: list[tuple[Array, Array, Array]] = []

    def _add_rows(self, *shape: int, low: Any, high: Any) -> Indices:
        rows = self._count + np.arange(int(np.prod(shape))).reshape(shape)
        self._count += rows.size
        for bounds, bound in ((self._low, low), (self._high, high)):
            bounds.append(np.broadcast_to(np.asarray(bound, dtype=float), shape).ravel())
        return rows

    def linear(self, *shape: int, low: Any = 0.0, high: Any = 0.0) -> Indices:
        """Linear rows without entries, with given bounds (default: equal to zero)."""
        rows = self._add_rows(*shape, low=low, high=high)
        self._linear.append(rows.ravel())
        return rows

    def add_entries(self, rows: Any, columns: Any, values: Any) -> None:
        """Add entries to linear rows; the arguments are broadcast."""
        parts = np.broadcast_arrays(rows, columns, np.asarray(values, dtype=float))
        self._entries.append((parts[0].ravel(), parts[1].ravel(), parts[2].ravel()))

    def add_equal(self, columns: Any, others: Any, scale: Any = 1.0) -> Indices:
        """Add rows scale (x[columns] - x[others]) = 0, of the shape of `columns`."""
        rows = self.linear(*np.shape(columns))
        self.add_entries(rows, columns, scale)
        self.add_entries(rows, others, -np.asarray(scale))
        return rows

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

        One copy per element of all axes but the last; blocks are broadcast. Returns the rows, with
        given bounds (default: equal to zero).
        """
        columns = kernel.x.join(**x)
        shape, count = columns.shape[:-1], columns[..., 0].size
        indices = self._add_rows(*shape, 0 if cost else kernel.y.count, low=low, high=high)
        parameters = np.broadcast_to(kernel.p.join(**p or {}), (*shape, kernel.p.count))
        columns, rows = columns.reshape(count, -1), indices.reshape(count, -1)
        if cost or rows.size:
            self._blocks.append(_Block(kernel, columns, rows, parameters.reshape(count, -1)))
        return indices

    @property
    def bounds(self) -> tuple[Array, Array]:
        """Lower and upper bounds of all rows."""
        return np.concatenate(self._low), np.concatenate(self._high)

    def assemble(
        self, cost: Array, priced: Indices
    ) -> tuple[dict[str, Expression], dict[str, Expression]]:
        """Expressions of x, p, f and g with a linear cost, (n,), and `jac_g` and `hess_lag`.

        p are cost coefficients of the unknowns `priced`. Other rows belong to copies of kernels.
        """
        size, blocks, empty = len(cost), self._blocks, [np.zeros(0, dtype=np.int64)]
        linear = np.concatenate(self._linear or empty)
        row, column, value = (
            np.concatenate([part[k] for part in self._entries] or empty) for k in range(3)
        )
        x, p, lam_f = ca.MX.sym("x", size), ca.MX.sym("p", len(priced)), ca.MX.sym("lam_f")
        order = np.argsort(
            np.concatenate([linear, *(b.rows.ravel() for b in blocks)]), kind="stable"
        )
        lam_g = ca.MX.sym("lam_g", len(order))
        linear_index = np.full(len(order), -1)
        linear_index[linear] = np.arange(len(linear))
        entries = linear_index[row].tolist(), column.tolist(), ca.DM(value)
        parts = [ca.DM.triplet(*entries, len(linear), size) @ x]
        f = ca.dot(ca.DM(cost), x) + ca.dot(p, x[priced.tolist()])
        jac_rows, jac_columns, jac = [row], [column], [ca.MX(ca.DM(value))]
        hess_index, hess = [], []
        for kernel, columns, rows, parameters in blocks:
            count, values = len(columns), ca.DM(parameters.T)
            x_copies = _select(x, columns)
            y = kernel.function.map(count)(x_copies, values)
            lam = ca.repmat(lam_f, 1, count)
            if rows.size:
                parts.append(ca.vec(y))
                lam = _select(lam_g, rows)
                i, j = kernel.jacobian_at
                jac_rows.append(rows[:, i].ravel())
                jac_columns.append(columns[:, j].ravel())
                jac.append(ca.vec(kernel.jacobian.map(count)(x_copies, values)))
            else:
                f += ca.sum2(y)
            pairs = columns[:, kernel.hessian_at]
            hess_index.append((pairs.max(axis=1) * size + pairs.min(axis=1)).ravel())
            hess.append(ca.vec(kernel.hessian.map(count)(x_copies, values, lam)))
        g = ca.vertcat(*parts)[order.tolist()]
        jac_row, jac_column = np.concatenate(jac_rows), np.concatenate(jac_columns)
        sort = np.lexsort((jac_row, jac_column))
        pattern = ca.Sparsity.triplet(
            len(order), size, jac_row[sort].tolist(), jac_column[sort].tolist()
        )
        jacobian = ca.MX(pattern, ca.vertcat(*jac)[sort.tolist()])
        unique, owner = np.unique(np.concatenate(hess_index or empty), return_inverse=True)
        ones = owner.tolist(), list(range(len(owner))), ca.DM.ones(len(owner))
        gather = ca.DM.triplet(*ones, len(unique), len(owner))
        pattern = ca.Sparsity.triplet(
            size, size, (unique % size).tolist(), (unique // size).tolist()
        )
        hessian = ca.MX(pattern, gather @ ca.vertcat(ca.MX(0, 1), *hess))
        return {"x": x, "p": p, "f": f, "g": g}, {
            "jac_g": ca.Function("jac_g", [x, p], [g, jacobian]),
            "hess_lag": ca.Function("hess_lag", [x, p, lam_f, lam_g], [hessian]),
        }


def _select(x: Expression, columns: Indices) -> Expression:
    return ca.reshape(x[columns.ravel().tolist()], columns.shape[1], columns.shape[0])


def build_solver(
    name: str,
    nlp: dict[str, Expression],
    push: float,
    derivatives: dict[str, Expression] | None = None,
    **options: Any,
) -> Solver:
    """An Ipopt solver of an NLP.

    Parameters
    ----------
    nlp          expressions of x, p, f and g
    push         minimum distance of the initial point from bounds; small for a warm start
    derivatives  functions `jac_g` and `hess_lag`; by default CasADi derives them
    **options    of Ipopt, in addition to those of all NLPs
    """
    kinds = ("bound_push", "bound_frac", "slack_bound_push", "slack_bound_frac", "mult_bound_push")
    pushes = {f"warm_start_{kind}": push for kind in kinds}
    casadi_options = {
        "ipopt": _IPOPT_OPTIONS | pushes | options,
        "print_time": False,
        "record_time": True,
        # Multipliers of parameters and their gradient take time and are not used.
        "calc_lam_p": False,
        "no_nlp_grad": True,
        "show_eval_warnings": False,
        "error_on_fail": False,
        **(derivatives or {}),
    }
    start_time = time.perf_counter()
    solver = Solver(ca.nlpsol(name, "ipopt", nlp, casadi_options))
    add_cost(SolverStatistics(build_time=time.perf_counter() - start_time))
    return solver


class IpoptRun(NamedTuple):
    """One run of a solver."""

    unknowns: int
    rows: int
    jacobian_nonzeros: int  # of the rows
    hessian_nonzeros: int  # of the upper triangle of the Lagrangian's Hessian
    iterations: int
    seconds: float  # [s]: processor time


class Solver:
    """An NLP solver that raises KeyboardInterrupt; CasADi would report a failure instead."""

    def __init__(self, function: Expression) -> None:
        self.function = function

    def __call__(self, **arguments: Any) -> dict[str, Expression]:
        """Solve; inputs and outputs of a CasADi NLP solver, with `success` and `status`.

        Raises KeyboardInterrupt after a signal, `OutOfTime` after the time limit.
        """
        beat()
        # CasADi reads lists three times as fast as arrays.
        lists = {k: v.tolist() if isinstance(v, np.ndarray) else v for k, v in arguments.items()}
        result: dict[str, Expression] = self.function(**lists)
        stats = self.function.stats()
        # Statistics of an interrupted solver may be missing.
        count, *times = (
            stats.get(key, 0) for key in ("iter_count", "t_wall_total", "t_proc_total")
        )
        interrupted = stats["return_status"] == INTERRUPTED
        runs = [] if interrupted else [IpoptRun(*self._sizes, count, times[1])]
        add_cost(SolverStatistics(solves=1, iterations=count, solve_time=times[0]), *runs)
        check()
        if interrupted:
            raise KeyboardInterrupt
        return result | {"success": stats["success"], "status": stats["return_status"]}

    @cached_property
    def _sizes(self) -> tuple[int, int, int, int]:
        """Unknowns, rows, and nonzeros of Jacobian and Hessian, as in `IpoptRun`."""
        jacobian, hessian = map(self.function.get_function, ("nlp_jac_g", "nlp_hess_l"))
        sizes = self.function.size1_in("x0"), self.function.size1_in("lbg")
        return *sizes, jacobian.nnz_out(jacobian.n_out() - 1), hessian.nnz_out(0)


class IterateRecord(NamedTuple):
    """An iterate of a refinement."""

    violation: float  # the largest violation of limits between nodes, over the allowed one
    error: float  # estimated relative error of the objective; NaN where limits are missed


@dataclass(frozen=True)
class SolverStatistics:
    """Cost of solving, and convergence of refinements."""

    iterations: int = 0  # of Ipopt
    solves: int = 0  # number of runs of Ipopt
    build_time: float = 0.0  # [s]: of NLPs that were not in the cache
    solve_time: float = 0.0  # [s]: of Ipopt
    iterates: tuple[IterateRecord, ...] = ()

    def __add__(self, other: SolverStatistics) -> SolverStatistics:
        return SolverStatistics(*map(add, astuple(self), astuple(other)))


class Costs(defaultdict[int, SolverStatistics]):
    """Costs by phase number, 0 for those of no phase; `runs` of all solvers."""

    def __init__(self) -> None:
        super().__init__(SolverStatistics)
        self.runs = list[IpoptRun]()


_RECORDS: ContextVar[tuple[Costs, ...]] = ContextVar("ledgers", default=())  # active
_PHASE: ContextVar[int] = ContextVar("phase", default=0)


@contextmanager
def setting(variable: ContextVar[_T], value: _T) -> Iterator[None]:
    """Set a variable inside the block."""
    token = variable.set(value)
    try:
        yield
    finally:
        variable.reset(token)


@contextmanager
def collect_costs() -> Iterator[Costs]:
    """Record the cost of solving inside the block."""
    record = Costs()
    with setting(_RECORDS, (*_RECORDS.get(), record)):
        yield record


def assign_costs(phase: int) -> AbstractContextManager[None]:
    """Assign the cost of solving inside the block to a phase, by its number."""
    return setting(_PHASE, phase)


def add_cost(cost: SolverStatistics, *runs: IpoptRun) -> None:
    """Add a cost, and the runs that caused it, to all active records."""
    for record in _RECORDS.get():
        record[_PHASE.get()] += cost
        record.runs.extend(runs)
