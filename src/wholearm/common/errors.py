"""What can go wrong, by the exit status that the command line gives it."""

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
    """A number that sets limits, and may be changed to let a motion be planned."""

    name: str
    value: float  # as it is
    unit: str
    sign: int  # 1 if limits give way as it grows, -1 if as it falls (not below zero)
    key: str = ""  # key of it in a problem, for `Problem.with_`; `duration` is an option
    mirrored: str = ""  # key of what has minus this value, such as the base of the other finger

    @property
    def is_speed(self) -> bool:
        """Whether it is a speed, of which motions know the square."""
        return self.unit == "rad/s"


class Change(NamedTuple):
    """A parameter and another value of it that a plan was found with."""

    parameter: Parameter
    value: float

    @property
    def values(self) -> dict[str, float]:
        """What changes, as `Problem.with_` takes it."""
        parameter = self.parameter
        mirrored = {parameter.mirrored: -self.value} if parameter.mirrored else {}
        return {parameter.key: self.value} | mirrored

    @property
    def relative(self) -> float:
        """How large the change is, over the value or what it becomes."""
        before, after = self.parameter.value, self.value
        return abs(after - before) / max(abs(before), abs(after), 1e-300)

    def __str__(self) -> str:
        parameter = self.parameter
        value = f"{self.value:g} {parameter.unit}".rstrip()
        return f"{parameter.name} = {value} instead of {parameter.value:g}"


class LimitPlace(NamedTuple):
    """Where in a motion something is."""

    phase: int  # number of the phase
    time: float  # [s]: from the start of the first of the phases that have no plan
    text: str  # both in words, or the pose


class Shortfall(NamedTuple):
    """A limit that cannot be kept."""

    kind: str  # what it limits: `press`, `cone`, `torque`, `speed`
    part: str  # the contact or finger concerned
    limit: str  # the limit in words, with its value
    amount: float  # by how much it is missed at worst
    unit: str
    place: LimitPlace  # where that is
    share: float  # the amount over what is much for such a limit, which shortfalls are ranked by

    def __str__(self) -> str:
        return f"{self.limit} is {self.amount:.3g} {self.unit} short at {self.place.text}"


class WholearmError(Exception):
    """Base of every error that this package raises on purpose."""

    exit_status = 1  # of the command line: 1 if the task cannot be done, 2 if the input is bad
    phases: Sequence[int] = ()  # numbers of those that have no plan together, where that is known
    phase: int | None = None  # number of the phase that was simulated

    def to_dict(self) -> dict[str, Any]:
        """Text and exit status, with whatever else the error knows, as plain values for JSON."""
        from .document import plain  # of errors alone it is too much to import

        names = "source", "key", "phases", "phase", "shortfalls", "changes"
        known = {name: getattr(self, name, None) for name in names}
        known = {name: value for name, value in known.items() if value}
        values: dict[str, Any] = plain({"error": str(self), "status": self.exit_status} | known)
        return values


class InputError(WholearmError):
    """Malformed input: names the file, the key, what was given and what is allowed.

    Parameters
    ----------
    source   file (or other origin) of the input
    key      dotted key, array or column at fault; empty for the input as a whole
    problem  what was given and what is allowed
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
    """Give source and prefix of the key to an `InputError` from inside that has no source."""
    try:
        yield
    except InputError as error:
        if error.source or not (source or prefix):
            raise
        # Booleans of files are no Python.
        text = re.sub("^(True|False)(?= )", lambda word: word[0].lower(), error.problem)
        raise InputError(source, prefix + error.key, text if source else error.problem) from None


@contextmanager
def name_file(path: object, key: str = "", failure: str = "cannot be read") -> Iterator[None]:
    """Make an `InputError` of an `OSError` from inside the block: the file, what fails and why."""
    try:
        yield
    except OSError as error:
        raise InputError(str(path), key, f"{failure}: {error.strerror or error}") from None


class InfeasibleError(WholearmError):
    """No motion satisfies the constraints; the message names constraint, phase and place.

    Attributes
    ----------
    shortfalls  what the motion that misses limits least is short of, the worst first
    changes     changes of a single parameter with which a plan was found
    motion      that motion, of the phases without a plan, where there is one
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


class JammingError(WholearmError):
    """Friction makes the reduced inertia vanish or turn negative: no forward dynamics."""

    changes: tuple[Change, ...] = ()  # of one coefficient of friction, with which a plan was found


class AmbiguityError(JammingError):
    """Friction lets other contact forces than the planned ones be possible, or nearly so."""


class SimulationError(WholearmError):
    """The forward simulation cannot go on (step size underflow, inconsistent start)."""


def round_outwards(value: float, sign: int) -> float:
    """Round to three significant digits, up for the sign 1 and down for -1."""
    if value == 0 or not math.isfinite(value):
        return value
    place = 2 - math.floor(math.log10(abs(value)))
    # Values of so few digits stay, whatever their last bits are.
    scaled = round(value * 10.0**place, 6)
    return float(f"{math.ceil(scaled) if sign > 0 else math.floor(scaled)}e{-place}")


def describe_changes(changes: Sequence[Change]) -> str:
    """All changes in one line."""
    if not changes:
        return "no single limit makes it feasible"
    return f"feasible with {', or '.join(map(str, changes))}"


def name_phases(phases: Sequence[int], what: str = "") -> str:
    """One phase or several, for messages, and that they are `what`."""
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


def suggest(name: str, known: Iterable[str]) -> str:
    """The name that is meant, as the first words of a hint; empty where none is near."""
    from difflib import get_close_matches

    near = get_close_matches(name, list(known), 1, 0.5)
    return f"did you mean {near[0]!r}? " if near else ""


def read_share(value: str, key: str) -> float:
    """What a text such as "10 %" says, as a fraction, or raise `InputError` naming `key`."""
    number, sign, rest = value.partition("%")
    share = math.nan
    with suppress(ValueError):
        share = float(number) / 100 if sign and not rest.strip() else math.nan
    if not 1e-4 <= share <= 1:
        raise InputError("", key, f'{value!r} given; allowed as a share is "0.01 %" to "100 %"')
    return share


def require_vector(value: object, key: str, size: int) -> Array:
    """Return `value` as a read-only float array of `size` finite numbers, or raise `InputError`."""
    import numpy as np

    if not isinstance(value, list | tuple | np.ndarray) or len(value) != size:
        raise InputError("", key, f"{value!r} is not a list of {size} numbers")
    return frozen([require_number(item, key) for item in value])


def frozen(value: ArrayLike) -> Array:
    """Return a read-only float array."""
    import numpy as np

    array = np.array(value, dtype=float)
    array.setflags(write=False)
    return array
