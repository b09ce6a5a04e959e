"""What solving costs, counted where it is done and booked to the phase that it is done for.

Plans are found by way of others: of least time, with stops, on finer intervals, for advice. Counted
by the solver itself, nothing is left out or counted twice.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass, fields


@dataclass(frozen=True)
class SolverStatistics:
    """What solving has cost."""

    iterations: int = 0  # of Ipopt
    solves: int = 0  # how often it ran
    # build_time, solve_time [s]: of building NLPs that were not at hand yet, and of Ipopt
    build_time: float = 0.0
    solve_time: float = 0.0

    def __add__(self, other: SolverStatistics) -> SolverStatistics:
        names = [field.name for field in fields(self)]
        return SolverStatistics(*(getattr(self, name) + getattr(other, name) for name in names))


class Ledger:
    """Costs by the number of the phase that they were for; 0 stands for none in particular."""

    def __init__(self, outer: Ledger | None) -> None:
        self._outer = outer
        self._entries: dict[int, SolverStatistics] = {}

    def of(self, phase: int) -> SolverStatistics:
        """What a phase has cost."""
        return self._entries.get(phase, SolverStatistics())

    def add(self, phase: int, cost: SolverStatistics) -> None:
        """Book a cost here, and in the ledger that was open before."""
        self._entries[phase] = self.of(phase) + cost
        if self._outer is not None:
            self._outer.add(phase, cost)


_LEDGER: ContextVar[Ledger | None] = ContextVar("ledger", default=None)
_PHASE: ContextVar[int] = ContextVar("phase", default=0)


@contextmanager
def open_ledger(apart: bool = False) -> Iterator[Ledger]:
    """Collect what solving costs inside the block; `apart`, in no ledger that was open before."""
    ledger = Ledger(None if apart else _LEDGER.get())
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
