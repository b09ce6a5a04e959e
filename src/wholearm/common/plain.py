"""Values in plain containers, as JSON has them, and back."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import fields, is_dataclass
from enum import Enum
from typing import Any, get_args, get_origin, get_type_hints

import numpy as np


def plain(value: Any) -> Any:
    """`value` in plain containers for JSON, with None for NaN and infinity.

    Of named tuples and dataclasses the properties that they name as `derived`, and all fields but
    those that a `repr` leaves out.
    """
    names = [own.name for own in fields(value) if own.repr] if is_dataclass(value) else ()
    if names := [*getattr(value, "derived", ()), *(names or getattr(value, "_fields", ()))]:
        value = {name: getattr(value, name) for name in names}
    elif isinstance(value, np.ndarray | np.generic):
        value = value.tolist()
    elif isinstance(value, Enum):
        value = value.value
    if isinstance(value, Mapping):
        return {key: plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [plain(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def restore(kind: Any, value: Any) -> Any:
    """The value of a type that `plain` has been given: None stands for a float that is NaN.

    Types are named tuples, dataclasses, numbers, text, and tuples, mappings and optional ones of
    these. What is missing is as by default; what a type has `derived` is left out.

    Raises
    ------
    TypeError, ValueError, AttributeError  if it is none of this type
    """
    origin, parts = get_origin(kind), get_args(kind)
    if type(None) in parts:
        return None if value is None else restore(parts[0], value)
    if origin is tuple:
        kinds = parts[:1] * len(value) if Ellipsis in parts else parts
        return tuple(restore(own, item) for own, item in zip(kinds, value, strict=True))
    if origin is Mapping:
        return {str(key): restore(parts[1], item) for key, item in value.items()}
    if hasattr(kind, "_fields") or is_dataclass(kind):
        hints, left = get_type_hints(kind), getattr(kind, "derived", ())
        return kind(**{k: restore(hints.get(k), v) for k, v in value.items() if k not in left})
    if kind is float and value is None:
        return math.nan
    return kind(value)
