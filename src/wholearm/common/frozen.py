"""Frozen dataclasses and named tuples that are cheap to define.

`dataclasses.dataclass` writes and compiles five methods for each class, and `typing.NamedTuple`
compiles each annotation, which takes longer than all else that importing this package does. Here
dataclasses share one set of methods, and annotations are left as they are.
"""

from __future__ import annotations

from collections import namedtuple
from dataclasses import MISSING, Field, FrozenInstanceError
from dataclasses import dataclass as _collect
from inspect import Parameter, Signature
from operator import attrgetter
from reprlib import recursive_repr
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from dataclasses import dataclass as dataclass
    from typing import NamedTuple as NamedTuple
else:

    class _Making(type):
        """The type of `NamedTuple`: a class that has it as its base is made a named tuple."""

        def __new__(cls, name, bases, body):
            if not bases:
                return super().__new__(cls, name, bases, body)
            names = body["__annotations__"]
            given = [body.pop(field) for field in names if field in body]
            made = namedtuple(name, names, defaults=given, module=body["__module__"])
            for key, value in body.items():
                setattr(made, key, value)
            return made

    class NamedTuple(metaclass=_Making):
        """Base of named tuples."""

    def dataclass(*, frozen, eq=True):
        """Make a class a frozen dataclass; without `eq`, objects are equal to themselves only."""
        if not frozen:
            raise ValueError("a class that is not frozen needs methods of its own")

        def make(cls):
            for method in _METHODS + _COMPARISONS * eq:
                if method.__name__ not in vars(cls):
                    setattr(cls, method.__name__, method)
            cls.__signature__ = _Signed()
            cls = _collect(init=False, repr=False, eq=False)(cls)
            fields = cls.__dataclass_fields__.values()
            cls._compared = attrgetter(*(f.name for f in fields if f.compare))
            return cls

        return make


def __init__(self: Any, *args: Any, **values: Any) -> None:  # noqa: N807
    kind = type(self)
    fields: dict[str, Field[Any]] = self.__dataclass_fields__
    names = kind.__match_args__
    if len(args) > len(names):
        raise TypeError(f"{kind.__name__} takes {len(names)} values; {len(args)} are given")
    if values:
        for name in values:
            if name not in names[len(args) :]:
                raise TypeError(f"{kind.__name__} takes no {name!r}, or has it twice")
    values.update(zip(names, args, strict=False))
    if len(values) < len(fields):
        for name in fields.keys() - values.keys():
            field = fields[name]
            if field.default_factory is not MISSING:
                values[name] = field.default_factory()
            elif field.default is not MISSING:
                values[name] = field.default
            elif field.init:
                raise TypeError(f"{kind.__name__} needs {name!r}")
    self.__dict__.update(values)
    if hasattr(self, "__post_init__"):
        self.__post_init__()


def __setattr__(self: object, name: str, value: object) -> None:  # noqa: N807
    raise FrozenInstanceError(f"cannot assign to field {name!r}")


def __delattr__(self: object, name: str) -> None:  # noqa: N807
    raise FrozenInstanceError(f"cannot delete field {name!r}")


@recursive_repr()
def __repr__(self: Any) -> str:  # noqa: N807
    fields = self.__dataclass_fields__.values()
    shown = [f"{f.name}={getattr(self, f.name)!r}" for f in fields if f.repr]
    return f"{type(self).__qualname__}({', '.join(shown)})"


def __eq__(self: Any, other: Any) -> bool:  # noqa: N807
    if type(self) is not type(other):
        return NotImplemented
    return bool(self._compared(self) == other._compared(other))


def __hash__(self: Any) -> int:  # noqa: N807
    return hash(self._compared(self))


_METHODS = [__init__, __setattr__, __delattr__, __repr__]
_COMPARISONS = [__eq__, __hash__]


class _Signed:
    """The signature of a class, for those who ask for help."""

    def __get__(self, instance: object, owner: Any) -> Signature:
        fields = owner.__dataclass_fields__
        return Signature([_describe(fields[name]) for name in owner.__match_args__])


def _describe(field: Field[Any]) -> Parameter:
    given = field.default
    if field.default_factory is not MISSING:
        given = field.default_factory
    default = Parameter.empty if given is MISSING else given
    kind = Parameter.POSITIONAL_OR_KEYWORD
    return Parameter(field.name, kind, default=default, annotation=field.type)
