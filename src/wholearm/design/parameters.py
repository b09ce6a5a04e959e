"""Numbers of a problem that may be varied: names, values, units, ranges.

Names are the short ones of `Problem.with_`, `base1_x` and the like for the coordinates of joints,
and the dotted key of any number in a problem file, such as ``phases[5].until.phi_deg``.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from difflib import get_close_matches
from typing import Any, NamedTuple

from ..common.errors import InputError
from ..common.fields import POINT
from ..problem.definition import Problem
from ..problem.read import FINGER, FRICTION, OBJECT, START, TOP, UNTIL, name_keys
from ..problem.table import describe_scene
from ..scene.model import CORNERS

_FIELDS = {f"object.{name}": field for name, field in OBJECT.items()}
_FIELDS |= {f"friction.{name}": field for name, field in FRICTION.items()}
_FIELDS |= {f"start.{name}": field for name, field in START.items()}
_FIELDS |= {f"fingers.{k}.{name}": field for k in "12" for name, field in FINGER.items()}
_FIELDS |= {name: TOP[name] for name in ("epsilon", "gravity", "settle", "settle_gap")}
_FIELDS["control_period"] = TOP["control_period"]
_SKIPPED = ("start.flush", "goal", "uncertainty", "guess")  # whole numbers, and no part of a hand


class Parameter(NamedTuple):
    """A number of a problem, or one that several keys share."""

    name: str
    keys: tuple[str, ...]  # dotted keys of a problem file
    value: float  # NaN where the problem leaves it out, or its keys differ
    unit: str

    @property
    def title(self) -> str:
        """Name and unit."""
        return f"{self.name} [{self.unit}]" if self.unit else self.name

    def set(self, problem: Problem, value: float) -> Problem:
        """The problem with another value; raises like `Problem.with_`."""
        return vary(problem, {self: value})


class Interval(NamedTuple):
    """A parameter with the range that it is varied in."""

    parameter: Parameter
    low: float
    high: float


def vary(problem: Problem, values: Mapping[Parameter, float]) -> Problem:
    """The problem with other values of parameters; raises like `Problem.with_`."""
    return problem.with_({key: value for p, value in values.items() for key in p.keys})


def list_parameters(problem: Problem) -> list[Parameter]:
    """Every number of a problem once, by its shortest name; none that it leaves out."""
    chosen = dict[str, Parameter]()
    for parameter in _find_every(problem).values():
        key = parameter.keys[0]
        left_out = not parameter.value and _FIELDS[key].default == 0 if key in _FIELDS else False
        if len(parameter.keys) == 1 and math.isfinite(parameter.value) and not left_out:
            chosen.setdefault(key, parameter)
    return [*chosen.values()]


def find_parameter(problem: Problem, name: str, label: str = "") -> Parameter:
    """The parameter that a name stands for.

    Raises
    ------
    InputError  if the problem has none of this name; tells the nearest one. `label` is the option
                that it is from.
    """
    every = _find_every(problem)
    if name in every:
        return every[name]
    near = get_close_matches(name, every, 1, 0.5)
    hint = f"did you mean {near[0]!r}? " if near else ""
    shown = [p.name for p in list_parameters(problem) if not p.name.startswith("object.")]
    text = f"no number of this problem has that name; {hint}it has {', '.join(shown)}"
    raise InputError(problem.source, f"{label} {name}".strip(), text)


def read_interval(problem: Problem, text: str, label: str) -> Interval:
    """The range of a parameter from ``NAME=LOW:HIGH``, within what a file may have.

    Raises
    ------
    InputError  if the name is unknown, LOW is not below HIGH, or a file may not have one of them
    """
    name, _, numbers = text.partition("=")
    try:
        low, high = map(float, numbers.split(":"))
    except ValueError:
        raise InputError("", label, f"{text!r} given; allowed is NAME=LOW:HIGH") from None
    if not -math.inf < low < high < math.inf:
        raise InputError("", f"{label} {name}", f"{numbers} given; LOW has to be below HIGH")
    parameter = find_parameter(problem, name, label)
    for end in (low, high):
        require_allowed(problem, parameter, end, label)
    return Interval(parameter, low, high)


def require_allowed(problem: Problem, parameter: Parameter, value: float, label: str) -> None:
    """Raise an `InputError` if no file may have a value; what cannot be reached with it may be."""
    try:
        parameter.set(problem, value)
    except InputError as error:
        if any(key.partition("[")[0] == error.key.partition("[")[0] for key in parameter.keys):
            raise InputError(error.source, f"{label} {parameter.name}", error.problem) from None


def _find_every(problem: Problem) -> dict[str, Parameter]:
    """All parameters by their names, short ones first."""
    scene = describe_scene(problem.scene) | {"object.inertia": problem.scene.polygon.inertia}
    numbers = dict(_list_numbers(scene)) | dict(_list_numbers(problem.table))
    every = list[Parameter]()
    for name, keys in name_keys().items():
        field = _FIELDS.get(keys[0])
        if field is None or keys[0].endswith(_SKIPPED) or field.kind is CORNERS:
            continue
        if field.kind is POINT:
            for k, axis in enumerate("xy", start=1):
                key = f"{keys[0]}[{k}]"
                every.append(Parameter(f"{name}_{axis}", (key,), numbers[key], field.unit))
            continue
        values = {numbers.get(key, math.nan) for key in keys}
        value = values.pop() if len(values) == 1 else math.nan
        every.append(Parameter(name, keys, value, field.unit))
    for key, value in numbers.items():
        of_end = UNTIL.get(key.rpartition("until.")[2])
        field = of_end or _FIELDS.get(key.partition("[")[0])
        every.append(Parameter(key, (key,), value, field.unit if field else ""))
    return {parameter.name: parameter for parameter in every}


def _list_numbers(value: Any, key: str = "") -> Iterator[tuple[str, float]]:
    """Dotted keys of all numbers in nested tables."""
    if isinstance(value, Mapping):
        for name, item in value.items():
            inner = f"{key}.{name}" if key else str(name)
            if not inner.endswith(_SKIPPED):
                yield from _list_numbers(item, inner)
    elif isinstance(value, list):
        for k, item in enumerate(value, start=1):
            yield from _list_numbers(item, f"{key}[{k}]")
    elif isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value):
        yield key, float(value)
