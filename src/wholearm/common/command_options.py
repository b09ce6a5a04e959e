"""Tables of command-line options: flags, what they are, default and range, one to a line.

A table reads like the help that it becomes, as with docopt. Two spaces or more end the flags, and
lines that begin with spaces go on with the text::

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

from __future__ import annotations

import argparse
import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from .fields import BOOLEAN, TEXT, Field, FieldKind, Range, choice

_OFF = "False: "
_NUMBER = r"-?\d[\w.+-]*?"
_TEXT = re.compile(
    rf"(.*?)(?: = (\S+))?(?: in ({_NUMBER})\.\.({_NUMBER}))?(?: among (\S+))?", re.DOTALL
)


@dataclass(frozen=True)
class Option:
    """An option of a command, or a file that it takes."""

    field: Field
    flags: Sequence[str]  # the name alone where it is a file
    metavar: str | None = None
    nargs: str | None = None  # {"*", "+", "?", None}

    def add(self, parser: argparse.ArgumentParser) -> None:
        """Give it to a parser, with its default behind its text."""
        field, more = self.field, dict[str, Any]()
        if field.kind is BOOLEAN:
            more = {"action": f"store_{str(not field.default).lower()}", "dest": field.name}
        else:
            more = {"metavar": self.metavar, "nargs": self.nargs}
            more |= {"type": field.kind.parse} if isinstance(field.kind, Range) else {}
            if self.flags[0].startswith("-"):
                required = field.text.endswith("(required)")
                more |= {"default": field.default, "required": required}
            if self.nargs == "?" and "enum" in field.kind.schema:
                more["choices"] = field.kind.schema["enum"]
                if self.flags[0].startswith("-"):
                    # It may be left out before a file, too: the caller puts the first word in.
                    more |= {"nargs": None, "metavar": f"[{self.metavar}]"}
            elif self.nargs == "?" and isinstance(field.kind, Range):
                more["const"] = 1.0
        default = "" if field.kind is BOOLEAN or field.default == [] else field.describe_default()
        text = field.text.removeprefix(_OFF) + (default and f" ({default})")
        parser.add_argument(*self.flags, help=text, **more)


def read_options(table: str) -> list[Option]:
    """Options of a table."""
    rows: list[list[str]] = []
    for line in table.strip().splitlines():
        if line.startswith(" "):
            rows[-1].append(line.strip())
        else:
            rows.append(re.split(r" {2,}", line, maxsplit=1))
    return [_read_option(usage, " ".join(rest)) for usage, *rest in rows]


def _read_option(usage: str, rest: str) -> Option:
    found = _TEXT.fullmatch(rest)
    assert found is not None
    text, default, low, high, words = found.groups()
    optional, several = usage.endswith("]"), usage.rstrip("]").endswith("...")
    parts = usage.removeprefix("[").rstrip("]").removesuffix("...").split()
    flags = [part for part in parts if part.startswith("-")] or parts[:1]
    metavar = " ".join(parts[len(flags) :]).removeprefix("[") or None
    name = flags[-1].lstrip("-").replace("-", "_")
    kind: FieldKind | Range = TEXT
    given: Any = [] if several else default
    if low:
        read = float if re.search(r"[.e]", low) else int
        kind = Range(read(low), read(high))
        given = None if default is None else kind.parse(default)
    elif words:
        kind = choice(*words.split("|"))
    elif metavar is None and flags[0].startswith("-"):
        kind, given = BOOLEAN, name.startswith("no_")
        name = name.removeprefix("no_")
        text = f"{_OFF if given else ''}{text}"
    nargs = ("*" if optional else "+") if several else "?" if optional else None
    return Option(Field(name, text, kind, default=given), flags, metavar, nargs)
