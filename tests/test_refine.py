from __future__ import annotations

from dataclasses import dataclass, replace

import pytest

from wholearm import SolverError
from wholearm.planning.refinement import SOLVES, refine


@dataclass(frozen=True)
class Halving:
    """A problem whose errors halve with every solve; it has no solution on the first meshes."""

    unsolved: int = 0  # meshes without a solution
    gone: int = 99  # solves after which there is none any more
    least: int = 99  # solves after which nothing is left to adapt
    mesh: int = 0
    solves: int = 0

    @property
    def error(self) -> float:
        return 2.0**-self.solves

    @property
    def violation(self) -> float:
        return 8.0 * 2.0**-self.solves

    def solve(self) -> Halving:
        if self.mesh < self.unsolved or self.solves >= self.gone:
            raise SolverError(f"no solution on mesh {self.mesh}")
        return replace(self, solves=self.solves + 1)

    def adapt(self) -> Halving | None:
        return self if self.solves < self.least else None

    def restart(self) -> Halving | None:
        return replace(self, mesh=self.mesh + 1, solves=0) if self.mesh < 2 else None


def refined(accuracy: float, **changes: int) -> Halving:
    return refine(Halving(**changes), accuracy)


def test_refinement_ends_below_the_accuracy_without_violations() -> None:
    assert refined(0.1).solves == 4
    # Below the accuracy at once, but not without violations.
    assert refined(1.0).solves == 3
    assert refined(1e-9, least=5).solves == 5
    assert refined(0.0).solves == SOLVES


def test_what_was_found_is_kept_where_the_next_one_has_no_solution() -> None:
    assert refined(0.0, gone=6).solves == 6


def test_finer_meshes_are_tried_until_there_is_a_solution() -> None:
    assert refined(0.1, unsolved=2).mesh == 2
    with pytest.raises(SolverError, match="no solution on mesh 0"):
        refined(0.1, unsolved=3)
    with pytest.raises(SolverError, match="missed by 2 times what is allowed between nodes"):
        refined(0.1, least=2)
