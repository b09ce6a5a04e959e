"""Errors, with the exit status of the command line; checks of numbers and vectors."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from numbers import Real
from typing import TYPE_CHECKING, Any, NamedTuple

if TYPE_CHECKING:
    from numpy.typing import ArrayLike

    from .arrays import Array


class Parameter(NamedTuple):
    """A number that sets limits; another value may make a motion feasible."""

    name: str
    value: float  # current value
    unit: str
    sign: int  # 1 if limits relax as it grows, -1 if as it falls (not below zero)
    key: str = ""  # its key for `Problem.with_`; `duration` is an option
    mirrored: str = ""  # key of the number with the opposite value: the other finger's base

    @property
    def is_speed(self) -> bool:
        """Whether it is a speed, whose square enters the limits."""
        return self.unit == "rad/s"


class Change(NamedTuple):
    """A parameter and another value, with which a plan was found."""

    parameter: Parameter
    value: float

    @property
    def values(self) -> dict[str, float]:
        """Changed keys and values, arguments of `Problem.with_`."""
        parameter = self.parameter
        mirrored = {parameter.mirrored: -self.value} if parameter.mirrored else {}
        return {parameter.key: self.value} | mirrored

    @property
    def relative(self) -> float:
        """Size of the change over the larger of the two values."""
        before, after = self.parameter.value, self.value
        return abs(after - before) / max(abs(before), abs(after), 1e-300)

    def __str__(self) -> str:
        parameter = self.parameter
        value = f"{self.value:g} {parameter.unit}".rstrip()
        return f"{parameter.name} = {value} instead of {parameter.value:g}"


class LimitPlace(NamedTuple):
    """A place of a motion."""

    phase: int  # number of the phase
    time: float  # [s]: from the start of the first phase without a plan
    text: str  # phase and time in words, or the pose


class Shortfall(NamedTuple):
    """A violated limit of the motion with the least violation."""

    kind: str  # limited quantity: `press` (normal force), `cone`, `torque`, `speed`
    part: str  # its contact or finger
    limit: str  # the limit in words, with its value
    amount: float  # largest violation
    unit: str
    place: LimitPlace  # where the violation is largest
    share: float  # the amount over the scale of such limits; shortfalls are sorted by it

    def __str__(self) -> str:
        return f"{self.limit} is {self.amount:.3g} {self.unit} short at {self.place.text}"


class WholearmError(Exception):
    """Base of all errors of this package."""

    exit_status = 1  # of the command line: 1 if the task cannot be done, 2 if the input is bad
    phases: Sequence[int] = ()  # numbers of the phases that have no plan together, if known
    phase: int | None = None  # number of the phase that was simulated

    def to_dict(self) -> dict[str, Any]:
        """Text, exit status and further attributes, as values for JSON."""
        from .document import to_plain  # imports NumPy, which raising an error does not need

        names = "source", "key", "phases", "phase", "shortfalls", "changes"
        extra = {name: getattr(self, name, None) for name in names}
        extra = {name: value for name, value in extra.items() if value}
        values: dict[str, Any] = to_plain({"error": str(self), "status": self.exit_status} | extra)
        return values


class InputError(WholearmError):
    """Malformed input: names the file, the key, the value and the allowed values.

    Parameters
    ----------
    source   file (or other origin) of the input
    key      dotted key, array or column at fault; empty for the input as a whole
    problem  the value and the allowed values
    """

    exit_status = 2

    def __init__(self, source: str, key: str, problem: str) -> None:
        self.source = source
        self.key = key
        self.problem = problem
        text = ": ".join(part for part in (source, key, problem) if part)
        # One line without control characters, its middle left out beyond 1000 characters.
        text = "".join(c if c.isprintable() else ascii(c)[1:-1] for c in text)
        super().__init__(text if len(text) <= 1000 else f"{text[:500]} ... {text[-500:]}")

    def __reduce__(self) -> tuple[type[InputError], tuple[str, str, str]]:
        return type(self), (self.source, self.key, self.problem)


@contextmanager
def name_source(source: str = "", prefix: str = "") -> Iterator[None]:
    """Add source and key prefix to an `InputError` without source from inside the block."""
    try:
        yield
    except InputError as error:
        if error.source or not (source or prefix):
            raise
        # Files write booleans in lower case.
        text = re.sub("^(True|False)(?= )", lambda word: word[0].lower(), error.problem)
        raise InputError(source, prefix + error.key, text if source else error.problem) from None


@contextmanager
def name_file(path: object, key: str = "", failure: str = "cannot be read") -> Iterator[None]:
    """Turn an `OSError` from inside the block into an `InputError` with file and reason."""
    try:
        yield
    except OSError as error:
        raise InputError(str(path), key, f"{failure}: {error.strerror or error}") from None


class InfeasibleError(WholearmError):
    """No motion satisfies the constraints; the message names constraint, phase and place.

    Attributes
    ----------
    shortfalls  violated limits of the motion with the least violation, the worst first
    changes     changes of a single parameter with which a plan was found
    motion      that motion (elastic solution) of the phases without a plan, if there is one
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
    """A plan was found, but its replay in the simulator violates limits."""


class SolverError(WholearmError):
    """The solver did not converge, and did not detect infeasibility."""


class JammingError(WholearmError):
    """Jamming: with friction the reduced inertia is not positive; no forward dynamics."""

    changes: tuple[Change, ...] = ()  # of one coefficient of friction, with which a plan was found


class AmbiguityError(JammingError):
    """Contact forces are not unique, or the uniqueness margin is too small."""


class SimulationError(WholearmError):
    """The forward simulation failed (step size underflow, inconsistent start)."""


def round_outwards(value: float, sign: int) -> float:
    """Round to three significant digits, up for the sign 1 and down for -1."""
    if value == 0 or not math.isfinite(value):
        return value
    exponent = 2 - math.floor(math.log10(abs(value)))
    # Values with three digits stay as they are, despite rounding errors.
    scaled = round(value * 10.0**exponent, 6)
    return float(f"{math.ceil(scaled) if sign > 0 else math.floor(scaled)}e{-exponent}")


def describe_changes(changes: Sequence[Change]) -> str:
    """All changes in one line."""
    if not changes:
        return "no single limit makes it feasible"
    return f"feasible with {', or '.join(map(str, changes))}"


def name_phases(phases: Sequence[int], what: str = "") -> str:
    """Numbers of phases for messages, with the predicate `what`: "phases 2 to 4 are ..."."""
    first, *others = phases
    if not others:
        return f"phase {first} is {what}" if what else f"phase {first}"
    several = f"phases {first} {'and' if len(others) == 1 else 'to'} {others[-1]}"
    return f"{several} are {what}" if what else several


def require_number(
    value: object, key: str, *, positive: bool = False, nonnegative: bool = False
) -> float:
    """Return `value` as a finite float, or raise `InputError` naming `key`."""
    allowed = "a positive number" if positive else "a number >= 0" if nonnegative else "a number"
    real = isinstance(value, Real)
    try:
        result = float(value) if real and not isinstance(value, bool) else math.nan  # type: ignore[arg-type]
    except OverflowError:
        result = math.inf
    if not math.isfinite(result):
        raise InputError("", key, f"{value!r} is not {allowed} (finite)")
    if (positive and result <= 0) or (nonnegative and result < 0):
        raise InputError("", key, f"{value!r} is not {allowed}")
    return result


def suggest(name: str, candidates: Iterable[str]) -> str:
    """Hint with the closest of the allowed names; empty if none is close."""
    from difflib import get_close_matches

    matches = get_close_matches(name, list(candidates), 1, 0.5)
    return f"did you mean {matches[0]!r}? " if matches else ""


def read_fraction(value: str, key: str) -> float:
    """Fraction of a text such as "10 %", or raise `InputError` naming `key`."""
    number, sign, suffix = value.partition("%")
    fraction = math.nan
    with suppress(ValueError):
        fraction = float(number) / 100 if sign and not suffix.strip() else math.nan
    if not 1e-4 <= fraction <= 1:
        raise InputError("", key, f'{value!r} given; allowed as a share is "0.01 %" to "100 %"')
    return fraction


def require_vector(value: object, key: str, size: int) -> Array:
    """Return `value` as a read-only float array of `size` finite numbers, or raise `InputError`."""
    import numpy as np

    value = value.tolist() if isinstance(value, np.ndarray) else value
    if not isinstance(value, list | tuple) or len(value) != size:
        raise InputError("", key, f"{value!r} is not a list of {size} numbers")
    return frozen([require_number(item, key) for item in value])


def require_array(value: object, key: str, *shape: int, kind: type | None = float) -> Array:
    """Return `value` as an array of a shape (-1: any size) and kind, or raise `InputError`."""
    import numpy as np

    try:
        array = np.asarray(value, dtype=kind)
    except (TypeError, ValueError):
        raise InputError("", key, f"{value!r} is no array of numbers") from None
    pairs = zip(shape, array.shape, strict=False)
    if array.ndim != len(shape) or not all(size in (-1, n) for size, n in pairs):
        text = ", ".join(str(n) if n >= 0 else "any" for n in shape)
        raise InputError("", key, f"shape {array.shape} given, ({text}) needed")
    return array


def frozen(value: ArrayLike) -> Array:
    """Return a read-only float array."""
    import numpy as np

    array = np.array(value, dtype=float)
    array.setflags(write=False)
    return array
