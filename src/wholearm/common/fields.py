"""Values that a user may give: name, unit, scale, range, default and text, declared once for each.

A dataclass declares its keys by the decorator `declare`. From what `keys_of` lists follow the
reader of problem files with its messages, ranges relative to the scene, the JSON Schema, the names
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
REQUIRED: Any = object()  # default of what has to be given
Schema = Mapping[str, Any]  # JSON Schema of a value


@dataclass(frozen=True)
class FieldKind:
    """What a value may be: its reader, which takes value and key and raises, and its schema."""

    read: Callable[[Any, str], Any]
    schema: Schema


@dataclass(frozen=True)
class Range:
    """Numbers from `low` to `high`, both included; whole ones only if `low` is an integer."""

    low: float  # low, high: as multiples of the scale, where there is one
    high: float
    scale: Callable[[Any, Any], float | None] | None = None  # of scene and owner; None: no range
    of: str = ""  # what messages call the scale; ``{time}`` stands for the scene's time

    @property
    def whole(self) -> bool:
        """Whether only whole numbers are allowed."""
        return isinstance(self.low, int)

    def describe(self, time: str = "the scene's time") -> str:
        """The range in words."""
        low, high = (f"{end}" if self.whole else f"{end:g}" for end in (self.low, self.high))
        text = f"{'whole numbers from ' if self.whole else ''}{low} to {high}"
        return f"{text} {self.of.format(time=time)}".rstrip()

    def find_fault(self, given: object) -> str:
        """What is wrong with a value; empty if nothing is."""
        kinds = (int,) if self.whole else (int, float)
        is_number = isinstance(given, kinds) and not isinstance(given, bool)
        if is_number and self.low <= given <= self.high:  # type: ignore[operator]
            return ""
        return f"{given!r} given; allowed are {self.describe()}"

    def read(self, given: Any, key: str) -> Any:
        """The value as int or float, or an `InputError` that names `key`."""
        # Numbers of NumPy are no int.
        value = given.item() if isinstance(given, Real) and hasattr(given, "item") else given
        if text := self.find_fault(value):
            raise InputError("", key, text)
        return value if self.whole else float(value)

    def parse(self, text: str) -> Any:
        """The value of a command-line option."""
        value: Any = text
        with suppress(ValueError):
            value = int(text) if self.whole else float(text)
        if wrong := self.find_fault(value):
            raise argparse.ArgumentTypeError(wrong)
        return value

    def check(
        self, key: str, given: Any, unit: str = "", scene: Any = None, owner: Any = None
    ) -> None:
        """Raise an `InputError` that names `key` if a number, or one of several, is out of range.

        What stands for none, 0 or infinity, is in every range: the kind says whether it is allowed.
        """
        scale = 1.0 if self.scale is None else self.scale(scene, owner)
        if scale is None:
            return
        low, high = self.low * scale, self.high * scale
        several = hasattr(given, "__len__") and not isinstance(given, str)
        for value in given if several else (given,):
            counts = isinstance(value, Real) and value and math.isfinite(value)
            # A scale is rounded: in other units a number at its bound may be past it by that.
            slack = 1e-12 * abs(value) if counts and self.scale is not None else 0.0
            if counts and not low - slack <= value <= high + slack:
                # Units of a scene with such a number may not exist.
                time = f"{scene.scales.time:.3g} s" if "{time}" in self.of else ""
                what = f" ({self.describe(time)})" if self.of else ""
                text = f"{low:.3g} to {high:.3g} {unit}".rstrip()
                raise InputError("", key, f"{value:g} given; allowed are {text}{what}")


def choice(*words: str) -> FieldKind:
    """One of several words, or the member of an enumeration that has it."""

    def read(given: Any, key: str) -> Any:
        if getattr(given, "value", given) not in words:
            allowed = " and ".join(map(repr, words)) if len(words) == 2 else str(words)[1:-1]
            raise InputError("", key, f"{given!r} given; allowed are {allowed}")
        return given

    return FieldKind(read, {"enum": list(words)})


def _read_type(kind: type, text: str) -> Callable[[Any, str], Any]:
    """Reader of values of one type; `text` follows a value that is of another one."""

    def read(given: Any, key: str) -> Any:
        if not isinstance(given, kind):
            raise InputError("", key, f"{given!r} {text}")
        return given

    return read


def refer(name: str) -> Schema:
    """The schema that has a name."""
    return {"$ref": f"#/definitions/{name}"}


def leave(schema: Schema) -> FieldKind:
    """What has a reader of its own."""
    return FieldKind(lambda value, _: value, schema)


SHARE = Range(0.0, 1.0)
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
    """A value that a user may give."""

    name: str
    text: str = ""  # what it is, with its unit in brackets
    kind: FieldKind | Range = NUMBER
    scale: str = ""  # unit of the scene, of `Scales`, that it counts in
    ranges: tuple[Range, ...] = ()  # which it has to be in, relative to the scene
    default: Any = REQUIRED  # REQUIRED where a value has to be given
    attribute: str = ""  # of the dataclass that keeps it, if it is not the name

    @property
    def required(self) -> bool:
        """Whether a value has to be given."""
        return self.default is REQUIRED

    @property
    def unit(self) -> str:
        """The unit; empty where there is none."""
        match = re.search(r"\[([^\]]*)\]", self.text)
        return match[1] if match else ""

    @property
    def shown_default(self) -> Any:
        """The default, if it is a value that could be given, or None."""
        left_out = self.required or self.default == math.inf
        return None if left_out else getattr(self.default, "value", self.default)

    @property
    def schema(self) -> dict[str, Any]:
        """The value's JSON Schema; only keys of files have one, and no options."""
        assert isinstance(self.kind, FieldKind)
        annotations = {"default": self.shown_default, "description": self.text}
        return {**self.kind.schema} | {k: v for k, v in annotations.items() if v not in (None, "")}

    def describe_default(self) -> str:
        """The default as it is shown to a user; empty where there is none."""
        value = self.shown_default
        if isinstance(value, bool):
            return str(value).lower()
        if isinstance(value, float):
            return re.sub(r"e([+-])0*", lambda match: f"e{match[1]}".replace("+", ""), f"{value:g}")
        return "" if value is None else str(value)

    def explain(self) -> str:
        """The text, with range and default."""
        allowed = [each.describe() for each in (self.kind, *self.ranges) if isinstance(each, Range)]
        default = f"default {self.describe_default()}" if self.describe_default() else ""
        more = "; ".join(filter(None, (*allowed, default)))
        return self.text + (more and f" ({more})")

    def read(self, given: Any, key: str) -> Any:
        """The value, if it is of its kind; raises an `InputError` that names `key`."""
        if self.default is None and given is None:
            return None
        if self.default == math.inf and given == math.inf:
            return math.inf
        return self.kind.read(given, key)

    def check(self, given: Any, key: str, scene: Any, owner: Any = None) -> None:
        """Raise an `InputError` if a value is out of a range relative to the scene."""
        for field in self.ranges:
            field.check(key, given, self.unit, scene, owner)


def key(
    name: str,
    text: str = "",
    kind: FieldKind | Range = NUMBER,
    scale: str = "",
    *ranges: Range,
    **more: Any,
) -> Field:
    """A `Field` with its ranges one after the other."""
    return Field(name, text, kind, scale, ranges, **more)


def name_fields(*fields: Field) -> dict[str, Field]:
    """Fields by name."""
    return {field.name: field for field in fields}


def declare(*fields: Field) -> Callable[[type[T]], type[T]]:
    """Say which fields of a dataclass are keys of a file or options, and what they are.

    Their defaults are those of the dataclass, where it has any, and its docstring lists them.
    """

    def describe(owner: type[T]) -> type[T]:
        defaults = {field.name: field.default for field in dataclasses.fields(owner)}  # type: ignore[arg-type]
        keys = {}
        for field in fields:
            attribute = field.attribute or field.name
            default = defaults[attribute]
            keys[attribute] = field if default is MISSING else replace(field, default=default)
        lines = [f"    {k}\n        {one.explain()}" for k, one in keys.items() if one.text]
        owner.__doc__ = "\n".join([owner.__doc__ or "", "    Keys", "    ----", *lines, ""])
        owner.__keys__ = keys  # type: ignore[attr-defined]
        return owner

    return describe


def keys_of(owner: Any) -> dict[str, Field]:
    """The declared fields of a dataclass, or of an object of one, by attribute."""
    fields: dict[str, Field] = owner.__keys__
    return fields


def read_keys(owner: Any, prefix: str = "") -> None:
    """Check the declared fields of a frozen dataclass, and keep them as they are read."""
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
    """An option of a command, or a file that it takes."""

    field: Field
    flags: Sequence[str]  # the name alone where it is a file
    arguments: Mapping[str, Any]  # of `ArgumentParser.add_argument`


def read_options(table: str) -> list[Option]:
    """Options of a table: flags, what they are, default and range, one to a line.

    A table reads like the help that it becomes, as with docopt. Two spaces or more end the flags,
    and lines that begin with spaces go on with the text::

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


def _read_option(usage: str, rest: str = "") -> Option:
    match = _TEXT.fullmatch(rest)
    assert match is not None
    text, default, low, high, words = match.groups()
    optional, several = usage.endswith("]"), usage.rstrip("]").endswith("...")
    parts = usage.removeprefix("[").rstrip("]").removesuffix("...").split()
    flags = [part for part in parts if part.startswith("-")]
    is_file, flags = not flags, flags or parts[:1]
    metavar = " ".join(parts[len(flags) :]).removeprefix("[") or None
    name = flags[-1].lstrip("-").replace("-", "_")
    kind: FieldKind | Range = TEXT
    field_default: Any = [] if several else default
    nargs = ("*" if optional else "+") if several else "?" if optional else None
    more: dict[str, Any] = {"metavar": metavar, "nargs": nargs}
    if low:
        read = float if re.search(r"[.e]", low) else int
        kind = Range(read(low), read(high))
        field_default = None if default is None else kind.parse(default)
        more |= {"type": kind.parse} | ({"const": 1.0} if nargs == "?" else {})
    elif words:
        kind = choice(*words.split("|"))
        if optional:
            more["choices"] = words.split("|")
            if not is_file:
                # It may be left out before a file, too: the caller puts the first word in.
                more |= {"nargs": None, "metavar": f"[{metavar}]"}
    elif metavar is None and not is_file:
        kind, field_default = BOOLEAN, name.startswith("no_")
        name = name.removeprefix("no_")
        more = {"action": f"store_{str(not field_default).lower()}", "dest": name}
    if not is_file:
        more |= {"default": field_default, "required": text.endswith("(required)")}
    off = kind is BOOLEAN and field_default
    field = Field(name, f"False: {text}" if off else text, kind, default=field_default)
    shown = "" if kind is BOOLEAN or several else field.describe_default()
    more["help"] = text + (shown and f" ({shown})")
    return Option(field, flags, more)
