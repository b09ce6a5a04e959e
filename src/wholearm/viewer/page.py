"""Pages in one file, which open without a network: text, tables, pictures and players."""

from __future__ import annotations

import json
from collections.abc import Iterable
from html import escape
from importlib import resources
from typing import Any


def build_page(title: str, parts: Iterable[str]) -> str:
    """A page of HTML with the style and the scripts that its parts need.

    Parameters
    ----------
    parts  as the other functions of this module make them
    """
    folder = resources.files(__package__)
    style, script = (folder.joinpath(f"viewer.{kind}").read_text("utf-8") for kind in ("css", "js"))
    head = '<meta charset="utf-8"><meta name="viewport" content="width=device-width">'
    head += f"<title>{escape(title)}</title><style>{style}</style>"
    body = "\n".join([f"<h1>{escape(title)}</h1>", *parts, f"<script>{script}</script>"])
    return f'<!DOCTYPE html>\n<html lang="en"><head>{head}</head><body>\n{body}\n</body></html>\n'


def fold(content: str, title: str) -> str:
    """HTML folded away under a title."""
    return f"<details><summary>{escape(title)}</summary>{content}</details>"


def write_player(motion: dict[str, Any]) -> str:
    """A motion to play; see `motion_data.describe_motion`."""
    return f'<div class="motion">{_embed(motion)}</div>'


def write_chart(drawing: str, places: dict[str, Any]) -> str:
    """A map whose places can be clicked; see `chart.describe_map`."""
    hint = "Click a cell, a border or a crossing to see what touches there."
    told = f'<div class="choice"><p>{hint}</p><div class="pose"></div></div>'
    wide = f'<div class="scroll"><div class="map">{drawing}</div></div>'
    return f'<div class="chart">{wide}{told}{_embed(places)}</div>'


def _embed(value: dict[str, Any]) -> str:
    """Plain values for a script; a name with a tag in it cannot end them."""
    text = json.dumps(value, separators=(",", ":"), allow_nan=False).replace("<", "\\u003c")
    return f'<script type="application/json">{text}</script>'
