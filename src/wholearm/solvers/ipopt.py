"""Ipopt with the options of all NLPs of this package; it stops on signals and records its runs."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import astuple, dataclass
from operator import add
from typing import Any, NamedTuple

import casadi as ca
import numpy as np

from ..common.arrays import Expression
from ..common.signals import beat, check

STOPPED = "User_Requested_Stop"  # status of a solver after an interrupt, and of no other
_OPTIONS = {
    "print_level": 0,
    "sb": "yes",
    "tol": 1e-8,
    # The default relaxes every bound by 1e-8, so that limits would be missed with success.
    "bound_relax_factor": 0.0,
    "fast_step_computation": "yes",
    # A fixed ordering: the automatic one can differ between machines, and is slow on long grids.
    "mumps_permuting_scaling": 0,
    "mumps_pivot_order": 0,
    # Starting from a solution then takes few iterations.
    "mu_strategy": "adaptive",
    "warm_start_init_point": "yes",
}


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
    push         distance of an initial point from its bounds; small to start at a solution
    derivatives  functions that CasADi would derive otherwise: `jac_g` and `hess_lag`
    **options    of Ipopt, over those that all NLPs share
    """
    kinds = ("bound_push", "bound_frac", "slack_bound_push", "slack_bound_frac", "mult_bound_push")
    pushes = {f"warm_start_{kind}": push for kind in kinds}
    casadi_options = {
        "ipopt": _OPTIONS | pushes | options,
        "print_time": False,
        "record_time": True,
        # Neither multipliers of parameters nor their gradient are used, and both cost.
        "calc_lam_p": False,
        "no_nlp_grad": True,
        "show_eval_warnings": False,
        "error_on_fail": False,
        **(derivatives or {}),
    }
    started = time.perf_counter()
    solver = Solver(ca.nlpsol(name, "ipopt", nlp, casadi_options))
    book(SolverStatistics(build_time=time.perf_counter() - started))
    return solver


class IpoptRun(NamedTuple):
    """One run of a solver."""

    unknowns: int
    rows: int
    jacobian_nonzeros: int  # of the rows
    hessian_nonzeros: int  # of the upper triangle of the Lagrangian's Hessian
    iterations: int
    seconds: float  # [s]: processor time


_RECORDS: list[list[IpoptRun]] = []


@contextmanager
def record_runs() -> Iterator[list[IpoptRun]]:
    """Collect the runs of all solvers until the end of a `with` statement."""
    runs: list[IpoptRun] = []
    _RECORDS.append(runs)
    try:
        yield runs
    finally:
        # `list.remove` would take any record with the same runs.
        _RECORDS[:] = [own for own in _RECORDS if own is not runs]


class Solver:
    """An NLP solver that an interrupt ends: CasADi would stop it and go on as if it had failed."""

    def __init__(self, function: Expression) -> None:
        self.function = function

    def __call__(self, **arguments: Any) -> dict[str, Expression]:
        """Solve; inputs and outputs are those of a CasADi NLP solver.

        Raises
        ------
        KeyboardInterrupt  if a signal stopped the solver, or the time is over (`OutOfTime`)
        """
        beat()
        # CasADi takes lists in three times as fast as arrays.
        lists = {k: v.tolist() if isinstance(v, np.ndarray) else v for k, v in arguments.items()}
        result: dict[str, Expression] = self.function(**lists)
        stats = self.function.stats()
        # A solver that was stopped does not always say what it has done.
        cost = stats.get("iter_count", 0), stats.get("t_wall_total", 0.0)
        book(SolverStatistics(solves=1, iterations=cost[0], solve_time=cost[1]))
        for runs in _RECORDS:
            runs.append(self._describe_run(stats))
        check()
        if stats["return_status"] == STOPPED:
            raise KeyboardInterrupt
        return result

    def stats(self) -> dict[str, Any]:
        """Statistics of the last call."""
        statistics: dict[str, Any] = self.function.stats()
        return statistics

    def _describe_run(self, stats: dict[str, Any]) -> IpoptRun:
        jacobian, hessian = map(self.function.get_function, ("nlp_jac_g", "nlp_hess_l"))
        return IpoptRun(
            self.function.size1_in("x0"),
            self.function.size1_in("lbg"),
            jacobian.nnz_out(jacobian.n_out() - 1),
            hessian.nnz_out(0),
            stats["iter_count"],
            stats["t_proc_total"],
        )


@dataclass(frozen=True)
class SolverStatistics:
    """Cost of solving."""

    iterations: int = 0  # of Ipopt
    solves: int = 0  # how often it ran
    build_time: float = 0.0  # [s]: of NLPs that were not cached
    solve_time: float = 0.0  # [s]: of Ipopt

    def __add__(self, other: SolverStatistics) -> SolverStatistics:
        return SolverStatistics(*map(add, astuple(self), astuple(other)))


class Ledger:
    """Costs by the number of the phase that they were for; 0 stands for none in particular."""

    def __init__(self, outer: Ledger | None) -> None:
        self._outer = outer
        self._entries: dict[int, SolverStatistics] = {}

    def of(self, phase: int) -> SolverStatistics:
        """Cost of a phase."""
        return self._entries.get(phase, SolverStatistics())

    def add(self, phase: int, cost: SolverStatistics) -> None:
        """Book a cost here, and in the ledger that was open before."""
        self._entries[phase] = self.of(phase) + cost
        if self._outer is not None:
            self._outer.add(phase, cost)


_LEDGER: ContextVar[Ledger | None] = ContextVar("ledger", default=None)


_PHASE: ContextVar[int] = ContextVar("phase", default=0)


@contextmanager
def open_ledger() -> Iterator[Ledger]:
    """Collect what solving costs inside the block."""
    ledger = Ledger(_LEDGER.get())
    token = _LEDGER.set(ledger)
    try:
        yield ledger
    finally:
        _LEDGER.reset(token)


@contextmanager
def charge(phase: int) -> Iterator[None]:
    """Book what solving costs inside the block to a phase, by its number."""
    token = _PHASE.set(phase)
    try:
        yield
    finally:
        _PHASE.reset(token)


def book(cost: SolverStatistics) -> None:
    """Add a cost to the ledger that is open, if one is."""
    ledger = _LEDGER.get()
    if ledger is not None:
        ledger.add(_PHASE.get(), cost)
