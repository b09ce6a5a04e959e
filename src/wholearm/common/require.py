"""Numbers and vectors as they are given, checked."""

from __future__ import annotations

import math
from numbers import Real
from typing import TYPE_CHECKING

from .errors import InputError

if TYPE_CHECKING:
    from numpy.typing import ArrayLike

    from .arrays import Array


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


def read_share(value: str, key: str) -> float:
    """What a text such as "10 %" says, as a fraction, or raise `InputError` naming `key`."""
    number, sign, rest = value.partition("%")
    try:
        share = float(number) / 100 if sign and not rest.strip() else math.nan
    except ValueError:
        share = math.nan
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
