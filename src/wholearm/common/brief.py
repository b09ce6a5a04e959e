"""Results in one line, and as a picture where notebooks ask for one."""

from __future__ import annotations

import io
from html import escape
from importlib import import_module
from typing import Any

LONGEST = 100
"""Characters of a line."""


def write_brief(result: Any) -> str:
    """The `repr` of a result: its class and its `headline`."""
    line = f"{type(result).__name__}({result.headline})"
    return line if len(line) <= LONGEST else f"{line[: LONGEST - 4]}...)"


def draw_html(result: Any) -> str:
    """The picture of a motion or a map, as SVG under its line, for notebooks."""
    name, function = ("formation_map", "draw_map")
    if not hasattr(result, "crossings"):
        name, function = ("plots", "force_margins")
    # Figures stand on everything else, so that nothing loads them before it is drawn.
    figure = getattr(import_module(f"wholearm.figures.{name}"), function)(result)
    stream = io.StringIO()
    figure.savefig(stream, format="svg")
    picture = stream.getvalue()
    return f"<p>{escape(repr(result))}</p>{picture[picture.index('<svg') :]}"
