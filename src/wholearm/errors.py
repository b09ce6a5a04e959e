"""What can go wrong, by the exit status that the command line gives it."""

from __future__ import annotations


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
        super().__init__(": ".join(part for part in (source, key, problem) if part))

    def __reduce__(self) -> tuple[type[InputError], tuple[str, str, str]]:
        return type(self), (self.source, self.key, self.problem)


class InfeasibleError(WholearmError):
    """No motion satisfies the constraints; the message names constraint, phase and place."""


class ReplayError(WholearmError):
    """A plan was found, but does not hold when it is replayed in the simulator."""


class SolverError(WholearmError):
    """The solver stopped without an answer although the problem was not shown infeasible."""


class JammingError(WholearmError):
    """Friction makes the reduced inertia vanish or turn negative: no forward dynamics."""


class SimulationError(WholearmError):
    """The forward simulation cannot go on (step size underflow, inconsistent start)."""
