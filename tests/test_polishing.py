from __future__ import annotations

import pytest

from wholearm.search.feasibility import Measured
from wholearm.search.refinement import FINEST, STEPS, Found, RefinedPath, ReleaseSearch


def plan_of(duration: float) -> Measured:
    return Measured(duration, (), [])


class Cell:
    """Ways that take longer away from a best place, and none beyond an end."""

    def __init__(self, best: int, end: int, moving: float | None = None, saved: float = 0) -> None:
        self.best, self.end, self.moving, self.saved = best, end, moving, saved
        self.tried: list[RefinedPath] = []

    def __call__(self, way: RefinedPath) -> Found:
        assert way not in self.tried
        self.tried.append(way)
        if way.move is None:
            return "no guess leads to a plan" if self.moving is None else plan_of(self.moving)
        if way.move < self.end:
            return "no guess leads to a plan"
        saved = 0.0 if way.straight else self.saved
        return plan_of(1 + FINEST * abs(way.move - self.best) - saved)

    def leave(self) -> list[Measured]:
        return ReleaseSearch(self, plan_of(1 + FINEST * abs(self.best))).run()


@pytest.mark.parametrize(("best", "end"), [(0, -1), (-7, -8), (5, -20), (-3, -3)])
def test_a_border_is_left_where_that_is_best(best: int, end: int) -> None:
    cell = Cell(best, end)
    found, *others = cell.leave()
    assert found.duration == pytest.approx(1, abs=1e-9)
    assert all(own.duration >= found.duration for own in others)
    assert RefinedPath(0) not in cell.tried


def test_a_border_that_no_other_place_is_better_for_may_be_left_in_motion() -> None:
    cell = Cell(-1, -20, moving=0.9)
    found, *others = cell.leave()
    assert cell.tried == [RefinedPath(-STEPS[0]), RefinedPath(STEPS[0]), RefinedPath(None)]
    assert found.duration == 0.9 and len(others) == 3
    # Where another place is better, that is gone on with.
    other = Cell(-7, -20, moving=0.9)
    assert other.leave()[0].duration == pytest.approx(1) and RefinedPath(None) not in other.tried


def test_another_guess_goes_on_from_the_best_place() -> None:
    cell = Cell(-4, -20, saved=0.3)
    assert cell.leave()[0].duration == pytest.approx(0.7)
    nearest = [way.move for way in cell.tried if not way.straight]
    assert nearest[0] == -4 and set(nearest[1:]) == {-4 + own for own in (-2, 2, -1, 1)}


def test_what_is_looked_at_first_may_be_at_hand() -> None:
    plain, ahead = Cell(-7, -8), Cell(-7, -8)
    leaving = ReleaseSearch(ahead, plan_of(1 + 7 * FINEST))
    leaving.prefetch(lambda tasks: [task() for task in tasks])
    assert leaving.run()[0] == plain.leave()[0]
    assert set(plain.tried) <= set(ahead.tried)
