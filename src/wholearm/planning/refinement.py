"""Refinement of the solution of a transcription: solve, check between nodes, adapt, solve again.

Both transcriptions (`path_domain.path_plan`, `time_domain.solution`) are refined by this loop. Each
solve starts from the last solution. After it limits are checked once between the nodes; then the
mesh is adapted, or limits are tightened by their violations. Violation and error of each iterate
are in the statistics of the phase (`meta.iterates`).
"""

from __future__ import annotations

import math
from typing import Protocol, Self, TypeVar

from ..common.errors import SolverError
from .nlp import IterateRecord, SolverStatistics, add_cost

SOLVES = 40  # most of one refinement


class Iterate(Protocol):
    """A mesh of a transcription, with the solution on it or the point to start from."""

    @property
    def violation(self) -> float:
        """The largest violation of limits between nodes, over the allowed one."""

    @property
    def error(self) -> float:
        """Estimated relative error of the objective."""

    def solve(self) -> Self:
        """Solve on this mesh; SolverError without a solution."""

    def adapt(self) -> Self | None:
        """The next iterate, on another mesh or with tighter limits; None if none is needed."""

    def restart(self) -> Self | None:
        """The next iterate after one without a solution; None if there is none."""


I = TypeVar("I", bound=Iterate)  # noqa: E741


def refine(first: I, accuracy: float = 0.0, solves: int = SOLVES) -> I:
    """The first solution without violations and with an error below `accuracy`, or the best one.

    SolverError, of the first failed mesh, if no solution keeps the limits between nodes.
    """
    iterate: I | None = first
    best: I | None = None
    failure: SolverError | None = None
    violation = float("inf")
    for _ in range(solves):
        if iterate is None:
            break
        try:
            iterate = iterate.solve()
        except SolverError as error:
            failure = failure or error
            if best is not None:
                return best
            iterate = iterate.restart()
            continue
        violation = iterate.violation
        record = IterateRecord(violation, iterate.error if violation <= 1 else math.nan)
        add_cost(SolverStatistics(iterates=(record,)))
        if violation <= 1 and (best is None or record.error <= best.error):
            best = iterate
            if record.error <= accuracy:
                return best
        iterate = iterate.adapt()
    if best is None:
        raise failure or SolverError(
            f"limits are still missed by {violation:.2g} times what is allowed between nodes after "
            "all solves; plan with more intervals"
        )
    return best
