"""Refinement of direct collocation: solve, look between the nodes, adapt, solve again.

The one loop of all transcriptions. Each solve starts from the last solution. After it the plan is
looked at once: how far limits are violated between nodes, and what the discretization costs.
Adapting moves or halves intervals and tightens limits by their violations.
"""

from __future__ import annotations

from typing import Protocol, Self, TypeVar

from ..common.errors import SolverError

SOLVES = 40  # most of one refinement


class Transcription(Protocol):
    """A nonlinear programme on a mesh, with the point to start from or its solution."""

    @property
    def violation(self) -> float:
        """Largest violation of limits between nodes, over what is allowed."""

    @property
    def error(self) -> float:
        """Estimated relative error of the objective by mesh and tightening."""

    def solve(self) -> Self:
        """The same with its solution; raises a SolverError without one."""

    def adapt(self) -> Self | None:
        """The next one to solve, on a better mesh or with tightened limits; None for none."""

    def restart(self) -> Self | None:
        """The first one on a finer mesh, if this one has no solution; None on the finest."""


T = TypeVar("T", bound=Transcription)


def refine(first: T, accuracy: float) -> T:
    """The solution without violations whose estimated error is below the accuracy, or least.

    Raises
    ------
    SolverError  if no solution keeps the limits between nodes; it is that of the first mesh
    """
    iterate: T | None = first
    best: T | None = None
    failure: SolverError | None = None
    for _ in range(SOLVES):
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
        if iterate.violation <= 1 and (best is None or iterate.error < best.error):
            best = iterate
            if best.error <= accuracy:
                return best
        iterate = iterate.adapt()
    if best is None:
        raise failure or SolverError(
            "limits are still missed between nodes after all solves; plan with more intervals"
        )
    return best
