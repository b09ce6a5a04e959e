"""Iterations and times of NLP solves, recorded by the solver and charged to phases."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import astuple, dataclass
from operator import add


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
