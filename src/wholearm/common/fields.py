"""Input values: name, unit, scale, range, default and text of each, declared once.

A dataclass declares its keys by the decorator `declare`. The declared fields (`keys_of`) determine
the reader of problem files with its messages, ranges relative to the scene, the JSON Schema, names
of `Problem.with_`, the writer, options of the command line with their help, and tables of keys.
"""

from __future__ import annotations

import argparse
import dataclasses
import math
import re
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import MISSING, dataclass, replace
from functools import partial
from numbers import Real
from typing import Any, NamedTuple, TypeVar

from .errors import InputError, require_number, require_vector

T = TypeVar("T")
REQUIRED: Any = object()  # default of a value that is required
Schema = Mapping[str, Any]  # JSON Schema of a value


@dataclass(frozen=True)
class FieldKind:
    """Kind of a value: its reader, which takes value and key and raises, and its schema."""

    read: Callable[[Any, str], Any]
    schema: Schema


@dataclass(frozen=True)
class Range:
    """Interval of numbers [low, high]; of integers if `low` is an integer."""

    low: float  # low, high: as multiples of the scale, if there is one
    high: float
    scale: Callable[[Any, Any], float | None] | None = None  # of scene and owner; None: no range
    scale_name: str = ""  # the scale in messages; ``{time}`` is replaced by the scene's time

    @property
    def is_integer(self) -> bool:
        """Whether only whole numbers are allowed."""
        return isinstance(self.low, int)

    def describe(self, time: str = "the scene's time") -> str:
        """The range in words."""
        low, high = (f"{end}" if self.is_integer else f"{end:g}" for end in (self.low, self.high))
        text = f"{'whole numbers from ' if self.is_integer else ''}{low} to {high}"
        return f"{text} {self.scale_name.format(time=time)}".rstrip()

    def find_fault(self, value: object) -> str:
        """Message about a value that is not allowed; empty if it is allowed."""
        kinds = (int,) if self.is_integer else (int, float)
        is_number = isinstance(value, kinds) and not isinstance(value, bool)
        if is_number and self.low <= value <= self.high:  # type: ignore[operator]
            return ""
        return f"{value!r} given; allowed are {self.describe()}"

    def read(self, raw: Any, key: str) -> Any:
        """The value as int or float, or an `InputError` that names `key`."""
        value = _unbox(raw)
        if text := self.find_fault(value):
            raise InputError("", key, text)
        return value if self.is_integer else float(value)

    def parse(self, text: str) -> Any:
        """The value of a command-line option."""
        value: Any = text
        with suppress(ValueError):
            value = int(text) if self.is_integer else float(text)
        if fault := self.find_fault(value):
            raise argparse.ArgumentTypeError(fault)
        return value

    def check(
        self, key: str, values: Any, unit: str = "", scene: Any = None, owner: Any = None
    ) -> None:
        """Raise an `InputError` that names `key` if a number (or one of several) is out of range.

        0 and infinity stand for "none" and are in every range; the kind decides on them.
        """
        scale = 1.0 if self.scale is None else self.scale(scene, owner)
        if scale is None:
            return
        low, high = self.low * scale, self.high * scale
        is_sequence = hasattr(values, "__len__") and not isinstance(values, str)
        for value in values if is_sequence else (values,):
            in_use = isinstance(value, Real) and value and math.isfinite(value)
            # In other units, rounding of the scale may move a number at its bound past it.
            slack = 1e-12 * abs(value) if in_use and self.scale is not None else 0.0
            if in_use and not low - slack <= value <= high + slack:
                # The scene's units may not be computable with such a number.
                time = f"{scene.scales.time:.3g} s" if "{time}" in self.scale_name else ""
                meaning = f" ({self.describe(time)})" if self.scale_name else ""
                text = f"{low:.3g} to {high:.3g} {unit}".rstrip()
                raise InputError("", key, f"{value:g} given; allowed are {text}{meaning}")


def _unbox(value: Any) -> Any:
    """A scalar of NumPy, which is no int and no bool, as one of Python; others as they are."""
    is_scalar = hasattr(value, "item") and not hasattr(value, "__len__")
    return value.item() if is_scalar else value


def choice(*words: str) -> FieldKind:
    """One of several words, or the enumeration member with this value."""

    def read(value: Any, key: str) -> Any:
        word = getattr(value, "value", value)
        if not isinstance(word, str) or word not in words:
            allowed = " and ".join(map(repr, words)) if len(words) == 2 else str(words)[1:-1]
            raise InputError("", key, f"{value!r} given; allowed are {allowed}")
        return value

    return FieldKind(read, {"enum": list(words)})


def _read_type(kind: type, text: str) -> Callable[[Any, str], Any]:
    """Reader of values of one type; messages are the value followed by `text`."""

    def read(value: Any, key: str) -> Any:
        value = _unbox(value)
        if not isinstance(value, kind):
            raise InputError("", key, f"{value!r} {text}")
        return value

    return read


def refer(name: str) -> Schema:
    """Reference to a named schema."""
    return {"$ref": f"#/definitions/{name}"}


def unread(schema: Schema) -> FieldKind:
    """Values that another function reads: the schema alone."""
    return FieldKind(lambda value, _: value, schema)


SHARE = Range(0.0, 1.0)
SEED = Range(0, 2**63)  # of random numbers
NUMBER = FieldKind(require_number, {"type": "number"})
POSITIVE = FieldKind(
    partial(require_number, positive=True), {"type": "number", "exclusiveMinimum": 0}
)
NONNEGATIVE = FieldKind(partial(require_number, nonnegative=True), {"type": "number", "minimum": 0})
COEFFICIENT = FieldKind(NONNEGATIVE.read, refer("coefficient"))
POINT = FieldKind(partial(require_vector, size=2), refer("point"))
BOOLEAN = FieldKind(_read_type(bool, "given; allowed are true and false"), {"type": "boolean"})
TEXT = FieldKind(_read_type(str, "is not a string"), {"type": "string"})


@dataclass(frozen=True)
class Field:
    """An input value."""

    name: str
    text: str = ""  # description, with the unit in brackets
    kind: FieldKind | Range = NUMBER
    scale: str = ""  # attribute of `Scales`: its unit of the scene
    ranges: tuple[Range, ...] = ()  # allowed ranges, relative to the scene
    default: Any = REQUIRED  # REQUIRED if there is none
    attribute: str = ""  # attribute of the dataclass, if it differs from the name

    @property
    def required(self) -> bool:
        """Whether the value is required."""
        return self.default is REQUIRED

    @property
    def unit(self) -> str:
        """The unit; empty where there is none."""
        match = re.search(r"\[([^\]]*)\]", self.text)
        return match[1] if match else ""

    @property
    def default_value(self) -> Any:
        """The default; None if there is none, or if it cannot be written (infinity)."""
        absent = self.required or self.default == math.inf
        return None if absent else getattr(self.default, "value", self.default)

    @property
    def schema(self) -> dict[str, Any]:
        """JSON Schema of the value; keys of files have one, options do not."""
        assert isinstance(self.kind, FieldKind)
        annotations = {"default": self.default_value, "description": self.text}
        return {**self.kind.schema} | {k: v for k, v in annotations.items() if v not in (None, "")}

    def describe_default(self) -> str:
        """The default as text; empty if there is none."""
        value = self.default_value
        if isinstance(value, bool):
            return str(value).lower()
        if isinstance(value, float):
            return re.sub(r"e([+-])0*", lambda match: f"e{match[1]}".replace("+", ""), f"{value:g}")
        return "" if value is None else str(value)

    def explain(self) -> str:
        """The text, with range and default."""
        allowed = [each.describe() for each in (self.kind, *self.ranges) if isinstance(each, Range)]
        default = f"default {self.describe_default()}" if self.describe_default() else ""
        notes = "; ".join(filter(None, (*allowed, default)))
        return self.text + (notes and f" ({notes})")

    def read(self, value: Any, key: str) -> Any:
        """The value, checked by its kind; raises an `InputError` that names `key`."""
        if self.default is None and value is None:
            return None
        if self.default == math.inf and value == math.inf:
            return math.inf
        return self.kind.read(value, key)

    def check(self, value: Any, key: str, scene: Any, owner: Any = None) -> None:
        """Raise an `InputError` if a value is out of a range relative to the scene."""
        for bounds in self.ranges:
            bounds.check(key, value, self.unit, scene, owner)


def key(
    name: str,
    text: str = "",
    kind: FieldKind | Range = NUMBER,
    scale: str = "",
    *ranges: Range,
    **settings: Any,
) -> Field:
    """A `Field`, with its ranges as positional arguments."""
    return Field(name, text, kind, scale, ranges, **settings)


def name_fields(*fields: Field) -> dict[str, Field]:
    """Fields by name."""
    return {field.name: field for field in fields}


def declare(*fields: Field) -> Callable[[type[T]], type[T]]:
    """Declare fields of a dataclass as keys of a file or as options.

    Defaults of the dataclass take precedence. The keys are appended to its docstring.
    """

    def describe(owner: type[T]) -> type[T]:
        defaults = {field.name: field.default for field in dataclasses.fields(owner)}  # type: ignore[arg-type]
        keys = {}
        for field in fields:
            attribute = field.attribute or field.name
            default = defaults[attribute]
            keys[attribute] = field if default is MISSING else replace(field, default=default)
        lines = [f"    {k}\n        {field.explain()}" for k, field in keys.items() if field.text]
        owner.__doc__ = "\n".join([owner.__doc__ or "", "    Keys", "    ----", *lines, ""])
        owner.__keys__ = keys  # type: ignore[attr-defined]
        return owner

    return describe


def keys_of(owner: Any) -> dict[str, Field]:
    """The declared fields of a dataclass, or of an object of one, by attribute."""
    fields: dict[str, Field] = owner.__keys__
    return fields


def read_keys(owner: Any, prefix: str = "") -> None:
    """Check the declared fields of a frozen dataclass, and store the values that were read."""
    for attribute, field in keys_of(owner).items():
        value = field.read(getattr(owner, attribute), f"{prefix}{field.name}")
        object.__setattr__(owner, attribute, value)


def collect_keys(owner: type, table: Mapping[str, Any]) -> dict[str, Any]:
    """Values of a table, or their defaults, by attribute."""
    fields = keys_of(owner).items()
    return {
        name: table.get(field.name, field.default)
        for name, field in fields
        if field.name in table or not field.required
    }


_NUMBER = r"-?\d[\w.+-]*?"
_TEXT = re.compile(
    rf"(.*?)(?: = (\S+))?(?: in ({_NUMBER})\.\.({_NUMBER}))?(?: among (\S+))?", re.DOTALL
)


class Option(NamedTuple):
    """An option or a file argument of a command."""

    field: Field
    flags: Sequence[str]  # the name alone if it is a file
    arguments: Mapping[str, Any]  # of `ArgumentParser.add_argument`


def read_options(table: str) -> list[Option]:
    """Options of a table with one line each: flags, description, default and range.

    The table is written like the help text, as with docopt. Two spaces or more end the flags;
    lines that begin with spaces continue the description::

        [files PLAN ...]    none, one or more files
        [topic]             one of these words, or none among model|map
        -o --output FILE    figure to write (required)
        --stops N           how often it may stop = 0 in 0..7
        --scheme NAME       of the points = radau among radau|legendre
        --robust [FACTOR]   without a factor, 1 = 0 in 0.0..1000
        --simulate [free]   the first of these words if it is left out among told|free
        --brake             without the name of a value, a range or words: a switch
        --no-replay         a switch that is on
    """
    lines = re.sub(r"\n +", " ", table.strip()).splitlines()
    return [_read_option(*re.split(r" {2,}", line, maxsplit=1)) for line in lines]


def _read_option(usage: str, description: str = "") -> Option:
    match = _TEXT.fullmatch(description)
    assert match is not None
    text, default, low, high, words = match.groups()
    optional, repeated = usage.endswith("]"), usage.rstrip("]").endswith("...")
    parts = usage.removeprefix("[").rstrip("]").removesuffix("...").split()
    flags = [part for part in parts if part.startswith("-")]
    is_file, flags = not flags, flags or parts[:1]
    metavar = " ".join(parts[len(flags) :]).removeprefix("[") or None
    name = flags[-1].lstrip("-").replace("-", "_")
    kind: FieldKind | Range = TEXT
    field_default: Any = [] if repeated else default
    nargs = ("*" if optional else "+") if repeated else "?" if optional else None
    settings: dict[str, Any] = {"metavar": metavar, "nargs": nargs}
    if low:
        number = float if re.search(r"[.e]", low) else int
        kind = Range(number(low), number(high))
        field_default = None if default is None else kind.parse(default)
        settings |= {"type": kind.parse} | ({"const": 1.0} if nargs == "?" else {})
    elif words:
        kind = choice(*words.split("|"))
        if optional:
            settings["choices"] = words.split("|")
            if not is_file:
                # The word is optional before a file, too: the caller inserts the first one.
                settings |= {"nargs": None, "metavar": f"[{metavar}]"}
    elif metavar is None and not is_file:
        kind, field_default = BOOLEAN, name.startswith("no_")
        name = name.removeprefix("no_")
        settings = {"action": f"store_{str(not field_default).lower()}", "dest": name}
    if not is_file:
        settings |= {"default": field_default, "required": text.endswith("(required)")}
    inverted = kind is BOOLEAN and field_default
    field = Field(name, f"False: {text}" if inverted else text, kind, default=field_default)
    default_text = "" if kind is BOOLEAN or repeated else field.describe_default()
    settings["help"] = text + (default_text and f" ({default_text})")
    return Option(field, flags, settings)
