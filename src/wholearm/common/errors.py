"""What can go wrong, by the exit status that the command line gives it."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from typing import Any

from .shortfalls import Change, Shortfall

LONGEST = 1000
"""Characters of a message beyond which its middle is left out."""


class WholearmError(Exception):
    """Base of every error that this package raises on purpose.

    Attributes
    ----------
    exit_status : int
        Exit status of the command line: 1 when the task cannot be done, 2 when the input is bad.
    """

    exit_status = 1


class InputError(WholearmError):
    """Malformed input: names the file, the key, what was given and what is allowed.

    Parameters
    ----------
    source : str
        File (or other origin) of the input.
    key : str
        Dotted key, array or column at fault; empty for the input as a whole.
    problem : str
        What was given and what is allowed.
    """

    exit_status = 2

    def __init__(self, source: str, key: str, problem: str) -> None:
        self.source = source
        self.key = key
        self.problem = problem
        text = ": ".join(part for part in (source, key, problem) if part)
        super().__init__(_to_line(text))

    def __reduce__(self) -> tuple[type[InputError], tuple[str, str, str]]:
        return type(self), (self.source, self.key, self.problem)


def _to_line(text: str) -> str:
    """One line without control characters, its middle left out where it is very long."""
    text = "".join(c if c.isprintable() else ascii(c)[1:-1] for c in text)
    return text if len(text) <= LONGEST else f"{text[: LONGEST // 2]} ... {text[-LONGEST // 2 :]}"


@contextmanager
def name_source(source: str) -> Iterator[None]:
    """Give the source to an `InputError` from inside the block that does not know its own."""
    try:
        yield
    except InputError as error:
        if error.source or not source:
            raise
        raise InputError(source, error.key, error.problem) from None


class InfeasibleError(WholearmError):
    """No motion satisfies the constraints; the message names constraint, phase and place.

    Attributes
    ----------
    shortfalls : tuple of Shortfall
        What the motion that misses limits least is short of, the worst first.
    changes : tuple of Change
        Changes of a single parameter with which a plan was found.
    motion : Trajectory or None
        That motion, of the phases without a plan, where there is one.
    """

    def __init__(
        self,
        text: str,
        shortfalls: Iterable[Shortfall] = (),
        changes: Iterable[Change] = (),
        motion: Any = None,
    ) -> None:
        super().__init__(text)
        self.shortfalls, self.changes = tuple(shortfalls), tuple(changes)
        self.motion = motion


class ReplayError(WholearmError):
    """A plan was found, but does not hold when it is replayed in the simulator."""


class SolverError(WholearmError):
    """The solver stopped without an answer although the problem was not shown infeasible."""


class _PhaseError(WholearmError):
    """An error that a simulation may end with.

    Attributes
    ----------
    phase : int or None
        Number of the phase that was simulated.
    """

    phase: int | None = None


class JammingError(_PhaseError):
    """Friction makes the reduced inertia vanish or turn negative: no forward dynamics.

    Attributes
    ----------
    changes : tuple of Change
        Changes of a single coefficient of friction with which a plan was found.
    """

    changes: tuple[Change, ...] = ()


class AmbiguityError(JammingError):
    """Friction lets other contact forces than the planned ones be possible, or nearly so."""


class SimulationError(_PhaseError):
    """The forward simulation cannot go on (step size underflow, inconsistent start)."""
