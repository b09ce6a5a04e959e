"""Numbers of a problem that may be varied: names, values, units, ranges.

Names are the short ones of `Problem.with_`, and the dotted key of any number in a problem file,
such as ``phases[5].until.phi_deg``.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Mapping
from typing import Any, NamedTuple

from ..common.errors import InputError, suggest
from ..common.fields import POINT, Field
from ..problem.definition import Problem
from ..problem.read import FINGER, FRICTION, OBJECT, START, TOP, UNTIL, name_keys
from ..problem.table import describe_scene
from ..scene.model import CORNERS

_TABLES = {"object": OBJECT, "friction": FRICTION, "start": START}
_TABLES |= {f"fingers.{number}": FINGER for number in "12"}
_FIELDS = {f"{part}.{key}": field for part, keys in _TABLES.items() for key, field in keys.items()}
_SINGLE = ("epsilon", "gravity", "settle", "settle_gap", "control_period")
_FIELDS |= {name: TOP[name] for name in _SINGLE}
_SKIPPED = re.compile(r"\.flush$|\.guess\[|^uncertainty")  # whole numbers, and what moves no plan


class Parameter(NamedTuple):
    """A number of a problem, or one that several keys share."""

    name: str
    keys: tuple[str, ...]  # dotted keys of a problem file
    value: float  # NaN where the problem leaves it out, or its keys differ
    unit: str
    scale: float = 1.0  # the scene's unit of such numbers

    @property
    def title(self) -> str:
        """Name and unit."""
        return f"{self.name} [{self.unit}]" if self.unit else self.name


def list_parameters(problem: Problem) -> list[Parameter]:
    """Every number of a problem once, by its shortest name; none that it leaves out."""
    chosen = dict[str, Parameter]()
    for parameter in _find_every(problem).values():
        key = parameter.keys[0]
        left_out = not parameter.value and key in _FIELDS and _FIELDS[key].default == 0
        if len(parameter.keys) == 1 and math.isfinite(parameter.value) and not left_out:
            chosen.setdefault(key, parameter)
    return [*chosen.values()]


def find_parameter(problem: Problem, name: str, label: str = "") -> Parameter:
    """The parameter that a name stands for; `label` is the option that it is from.

    InputError if the problem has none of this name; tells the nearest one.
    """
    every = _find_every(problem)
    if name in every:
        return every[name]
    shown = [p.name for p in list_parameters(problem) if not p.name.startswith("object.")]
    text = f"no number of this problem has that name; {suggest(name, every)}it has "
    raise InputError(problem.source, f"{label} {name}".strip(), text + ", ".join(shown))


def require_allowed(problem: Problem, name: str, value: Any, label: str) -> None:
    """Raise an `InputError` if no file may have a value; what cannot be reached with it may be."""
    try:
        problem.with_({name: value})
    except InputError as error:
        keys = name, *name_keys().get(name, ())
        if any(key.partition("[")[0] == error.key.partition("[")[0] for key in keys):
            raise InputError(error.source, f"{label} {name}", error.problem) from None


def _find_every(problem: Problem) -> dict[str, Parameter]:
    """All parameters by their names, short ones first."""
    scene, scales = problem.scene, problem.scene.scales
    numbers = dict(_list_numbers(describe_scene(scene) | {"object.inertia": scene.polygon.inertia}))
    numbers |= dict(_list_numbers(problem.table))
    every = dict[str, Parameter]()
    short = {name: keys for name, keys in name_keys().items() if _find_field(keys[0])}
    for name, keys in (short | {key: (key,) for key in numbers}).items():
        field, values = _find_field(keys[0]), {numbers.get(key, math.nan) for key in keys}
        whole = field is None or (field.kind in (POINT, CORNERS) and "[" not in keys[0])
        if _SKIPPED.search(keys[0]) or (whole and keys[0] not in numbers):
            continue
        unit = (field.unit, getattr(scales, field.scale or "_", 1.0)) if field else ("", 1.0)
        value = values.pop() if len(values) == 1 else math.nan
        every[name] = Parameter(name, keys, value, *unit)
    return every


def _find_field(key: str) -> Field | None:
    """The declaration of a dotted key."""
    of_end, of_scene = key.rpartition("until.")[2], key.partition("[")[0]
    return UNTIL.get(of_end) if of_end != key else _FIELDS.get(of_scene)


def _list_numbers(value: Any, key: str = "") -> Iterator[tuple[str, float]]:
    """Dotted keys of all numbers in nested tables."""
    if isinstance(value, Mapping):
        for name, item in value.items():
            yield from _list_numbers(item, f"{key}.{name}" if key else str(name))
    elif isinstance(value, list):
        for k, item in enumerate(value, start=1):
            yield from _list_numbers(item, f"{key}[{k}]")
    elif isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value):
        yield key, float(value)
