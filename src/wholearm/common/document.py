"""Reports as data: a title with a verdict, lines and tables, rendered as text, HTML, JSON."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import fields, is_dataclass
from enum import Enum
from html import escape
from importlib import import_module
from itertools import groupby
from typing import Any, NamedTuple, get_args, get_origin, get_type_hints

import numpy as np


def to_plain(value: Any, finite: bool = True) -> Any:
    """`value` as dicts, lists, numbers and text for JSON; if `finite`, NaN and infinity are None.

    Named tuples and dataclasses become dicts of the properties listed in their `derived` and of
    the fields that their `repr` shows.
    """
    names = [field.name for field in fields(value) if field.repr] if is_dataclass(value) else ()
    if names := [*getattr(value, "derived", ()), *(names or getattr(value, "_fields", ()))]:
        value = {name: getattr(value, name) for name in names}
    elif isinstance(value, np.ndarray | np.generic):
        value = value.tolist()
    elif isinstance(value, Enum):
        value = value.value
    if isinstance(value, Mapping):
        return {key: to_plain(item, finite) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [to_plain(item, finite) for item in value]
    return None if finite and isinstance(value, float) and not math.isfinite(value) else value


def restore(kind: Any, value: Any) -> Any:
    """Inverse of `to_plain`: the value of type `kind`. None for a float is NaN.

    Types are named tuples, dataclasses, numbers, text, and tuples, mappings and optional ones of
    these. Missing fields have their defaults; `derived` properties are skipped.

    TypeError, ValueError, AttributeError if the value is not of this type.
    """
    origin, parts = get_origin(kind), get_args(kind)
    if type(None) in parts:
        return None if value is None else restore(parts[0], value)
    if origin is tuple:
        kinds = parts[:1] * len(value) if Ellipsis in parts else parts
        return tuple(restore(item_kind, item) for item_kind, item in zip(kinds, value, strict=True))
    if origin is Mapping:
        return {str(key): restore(parts[1], item) for key, item in value.items()}
    if hasattr(kind, "_fields") or is_dataclass(kind):
        hints, derived = get_type_hints(kind), getattr(kind, "derived", ())
        return kind(**{k: restore(hints.get(k), v) for k, v in value.items() if k not in derived})
    if kind is float and value is None:
        return math.nan
    return kind(value)


SCALES = {"mm": 1e3, "mm/s": 1e3, "ms": 1e3, "deg": 180 / math.pi, "%": 1e2}
"""Factors from SI units to the unit of a column."""


class Table(NamedTuple):
    """Rows of values under columns."""

    # ``"name [unit]:format"``: numbers in SI units, written in that unit (`SCALES`) and format,
    # flush right. Without a format cells are text, flush left.
    columns: Sequence[str]
    rows: Sequence[Sequence[Any]]  # numbers, several for one cell, or text; None and NaN: a dash
    title: str = ""
    max_rows: int | None = None  # most rows that are rendered as text; the others are counted

    @staticmethod
    def of(items: Iterable[Any], columns: Mapping[str, str], title: str = "") -> Table:
        """A row for each item: the values of its attributes, such as ``a.b``, by their columns.

        If a is None, the value is None.
        """
        rows = [[_find(item, name) for name in columns] for item in items]
        return Table(list(columns.values()), rows, title)

    @property
    def heads(self) -> list[str]:
        """Names of the columns, with units."""
        parts = [column.rpartition(":") for column in self.columns]
        return [name if colon else text for name, colon, text in parts]

    @property
    def formats(self) -> list[str]:
        """Formats of the columns, empty for text."""
        return [column.rpartition(":")[2] if ":" in column else "" for column in self.columns]

    @property
    def cells(self) -> list[list[str]]:
        """The rows as text."""
        scales = [SCALES.get(head.rpartition("[")[2].rstrip("]"), 1.0) for head in self.heads]
        columns = self.formats, scales
        return [list(map(show, row, *columns)) for row in self.rows]

    def to_text(self) -> str:
        """Aligned columns under their names."""
        formats, lines = self.formats, [self.heads, *self.cells[: self.max_rows]]
        widths = [max(map(len, column)) for column in zip(*lines, strict=True)]
        aligned = [f"{'>' if f else '<'}{width}" for f, width in zip(formats, widths, strict=True)]
        text = [self.title] if self.title else []
        text += ["  ".join(map(format, line, aligned)).rstrip() for line in lines]
        n_hidden = len(self.rows) - len(self.rows[: self.max_rows])
        return "\n".join([*text, *([f"... and {n_hidden} more, see --json"] if n_hidden else [])])

    def to_html(self) -> str:
        """The table as HTML; cells of text have the class ``text``."""
        styles = ["" if form else ' class="text"' for form in self.formats]
        table = ""
        for kind, line in [("th", self.heads), *(("td", line) for line in self.cells)]:
            pairs = zip(styles, line, strict=True)
            cells = "".join(f"<{kind}{style}>{escape(cell)}</{kind}>" for style, cell in pairs)
            table += f"<tr>{cells}</tr>"
        title = f"<caption>{escape(self.title)}</caption>" if self.title else ""
        return f'<div class="scroll"><table>{title}{table}</table></div>'

    def to_markdown(self) -> str:
        """The table as Markdown."""
        rule = ["---:" if form else "---" for form in self.formats]
        lines = [[cell.replace("|", "\\|") for cell in line] for line in (self.heads, *self.cells)]
        lines.insert(1, rule)
        return "\n".join(f"| {' | '.join(line)} |" for line in lines)


class Document(NamedTuple):
    """Text of a result: title, verdict, reason, lines and tables."""

    title: str
    verdict: str = ""  # one word, "ok" or other; empty where nothing is judged
    reason: str = ""  # a sentence
    parts: Sequence[str | Table] = ()  # lines and tables; empty ones are left out

    @property
    def head(self) -> str:
        """Title, verdict and reason, in a line."""
        return ": ".join(filter(None, (self.title, self.verdict, self.reason)))

    @property
    def contents(self) -> list[str | Table]:
        """The parts that are not empty."""
        return [part for part in self.parts if (part.rows if isinstance(part, Table) else part)]

    def to_text(self) -> str:
        """Lines of text, with an empty line above and below each table."""
        parts = [self.head, *self.contents] if self.head else self.contents
        blocks = list[str]()
        for is_text, group in groupby(parts, lambda part: isinstance(part, str)):
            texts = [part if isinstance(part, str) else part.to_text() for part in group]
            blocks += ["\n".join(texts)] if is_text else texts
        return "\n\n".join(blocks)

    def to_markdown(self) -> str:
        """A page of Markdown."""
        blocks = (part if isinstance(part, str) else part.to_markdown() for part in self.contents)
        return "\n\n".join([f"# {self.title}", *blocks]) + "\n"

    def to_html(self) -> str:
        """Paragraphs and tables of HTML; the head has class ``ok`` or ``bad`` by the verdict."""
        style = {"": "", "ok": ' class="ok"'}.get(self.verdict, ' class="bad"')
        parts = [f"<p{style}>{escape(self.head)}</p>"] if self.head else []
        parts += [
            f"<p>{escape(part)}</p>" if isinstance(part, str) else part.to_html()
            for part in self.contents
        ]
        return "\n".join(parts)


def format_csv(rows: Iterable[Mapping[str, Any]], heads: Iterable[str]) -> str:
    """Rows as CSV under the column names `heads`, with all digits."""
    stream = io.StringIO()
    writer = csv.DictWriter(stream, list(heads), extrasaction="ignore", lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    return stream.getvalue()


def write_svg(figure: Any) -> str:
    """A figure as an SVG element, without the XML declaration."""
    stream = io.StringIO()
    figure.savefig(stream, format="svg", metadata={"Date": None})
    text = stream.getvalue()
    return text[text.index("<svg") :]


class Brief:
    """Mixin: the `repr` is one line."""

    @property
    def headline(self) -> str:
        """Description in one line."""
        raise NotImplementedError

    def __repr__(self) -> str:
        line = f"{type(self).__name__}({self.headline})"
        return line if len(line) <= 100 else f"{line[:96]}...)"


class Drawn(Brief):
    """Mixin of motions and maps: notebooks show a figure (SVG) under the `repr`."""

    drawing_function = "plots", "force_margins"  # module and function of `figures`

    def _repr_html_(self) -> str:
        # Figures import the other packages, and are imported only when they are drawn.
        module = import_module(f"wholearm.figures.{self.drawing_function[0]}")
        figure = getattr(module, self.drawing_function[1])(self)
        return f"<p>{escape(repr(self))}</p>{write_svg(figure)}"


class Result(Brief):
    """Base of results: rendered as text, HTML and JSON from their `document`."""

    derived: tuple[str, ...] = ()  # properties that `to_plain` adds to the fields

    @property
    def document(self) -> Document:
        """The result as a document."""
        raise NotImplementedError

    @property
    def values(self) -> Any:
        """Object that `to_dict` converts."""
        return self

    @property
    def ok(self) -> bool:
        """Whether all checks passed."""
        return True

    @property
    def exit_status(self) -> int:
        """Exit status of the command line: 0 or 1."""
        return 0 if self.ok else 1

    @property
    def headline(self) -> str:
        """Description in one line."""
        return self.document.head

    def judge(self, name: str, reason: str, parts: Sequence[str | Table]) -> Document:
        """The document with the verdict "ok" or "FAILED"."""
        return Document(name, "ok" if self.ok else "FAILED", reason, parts)

    def to_text(self) -> str:
        """Lines of text and aligned tables."""
        return self.document.to_text()

    def to_dict(self) -> dict[str, Any]:
        """Values for JSON, with None for NaN and infinity (`to_plain`)."""
        values: dict[str, Any] = to_plain(self.values)
        return values

    def _repr_html_(self) -> str:
        return self.document.to_html()


def _find(item: Any, name: str) -> Any:
    for part in name.split("."):
        item = None if item is None else getattr(item, part)
    return item


def show(value: Any, form: str, scale: float = 1.0) -> str:
    """A value as text: numbers times a scale in a format, a dash for None and NaN."""
    if isinstance(value, str | bool):
        return str(value).lower() if isinstance(value, bool) else value
    if isinstance(value, tuple | list | np.ndarray):
        return " ".join(show(entry, form, scale) for entry in value)
    if value is None or math.isnan(value):
        return "-"
    return format(value if scale == 1.0 else scale * value, form)


def fixed(size: float, digits: int = 3) -> str:
    """Format specifier with `digits` significant digits at this size, without negative zero."""
    decimals = digits - 1 - math.floor(math.log10(size)) if size > 0 else digits
    return f"z.{min(max(decimals, 0), 15)}f"


class Difference(NamedTuple):
    """A key with its two values as text; `nothing` where a table lacks the key."""

    key: str
    one: str
    other: str


def find_differences(
    one: Any, other: Any, ignored: tuple[str, ...] = (), key: str = ""
) -> Iterator[Difference]:
    """The keys in which two nested tables of mappings and lists differ, in their order.

    Names in `ignored` are skipped at any depth, or at the top level only if they begin with a dot.
    `key` is the key of the tables themselves.
    """
    if isinstance(one, Mapping) and isinstance(other, Mapping):
        for name in dict.fromkeys([*one, *other]):
            if name in ignored or (not key and f".{name}" in ignored):
                continue
            inner = f"{key}.{name}" if key else str(name)
            yield from find_differences(one.get(name), other.get(name), ignored, inner)
    elif isinstance(one, list | tuple) and isinstance(other, list | tuple):
        if len(one) != len(other):
            yield Difference(key, f"{len(one)} entries", f"{len(other)}")
            return
        for k, pair in enumerate(zip(one, other, strict=True), start=1):
            yield from find_differences(*pair, ignored, f"{key}[{k}]")
    elif one != other:
        yield Difference(key, _write(one), _write(other))


def _write(value: Any) -> str:
    text = f"{value:.12g}" if isinstance(value, float) else repr(value)
    text = "nothing" if value is None else text
    return text if len(text) <= 40 else f"{text[:37]}..."


def describe_differences(differences: Iterable[Difference], one: str, other: str) -> str:
    """The first three differences in words; `one` and `other` name the two tables."""
    texts = [f"{d.key} ({d.one} {one}, {d.other} {other})" for d in differences]
    more = [f"and {len(texts) - 3} more"] if texts[3:] else []
    return ", ".join(texts[:3] + more)
