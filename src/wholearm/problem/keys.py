"""Keys of a problem file, table by table: names for `Problem.with_`, JSON Schema, and a page.

Most are declared where their values are kept, in `Polygon`, `Finger`, `Friction`, `Scene`,
`Problem`, `Phase` and `Goal`; what else a file has is declared here.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

from ..common.fields import (
    NONNEGATIVE,
    NUMBER,
    POINT,
    Field,
    key,
    keys_of,
    leave,
    name_fields,
    refer,
)
from ..scene.model import FRICTION as COEFFICIENTS
from ..scene.model import PLACE, Finger, Friction, Polygon, Scene
from .definition import CONTACT, Phase, Problem
from .goal import INDEX, Goal
from .uncertainty import GROUPS, LENGTH, PARAMETERS

Table = Mapping[str, Field]
"""Keys of a table by name."""


_WIDTHS = {
    field.name: replace(field, default=field.default * (LENGTH if field.unit == "m" else 1))
    for field in PARAMETERS
}
OBJECT, FINGER, FRICTION, PHASE, GOAL = (
    name_fields(*keys_of(field).values()) for field in (Polygon, Finger, Friction, Phase, Goal)
)
FINGERS = name_fields(
    key("1", "The right finger.", leave(refer("finger"))),
    key("2", "The left finger.", leave(refer("finger"))),
)
START = name_fields(
    key("flush", "The edge that lies on the palm; edge 0 runs from vertex 0 to vertex 1.", INDEX),
    key("x", "Of the centroid [m]; both fingers close on the object.", NUMBER, "length", PLACE),
)
UNTIL = name_fields(
    key("contact", "", leave(refer("contact"))), key("x", "[m]"), key("phi_deg", "[degrees]")
)
UNCERTAINTY = {name: _WIDTHS[names[0]] for name, names in GROUPS.items()} | _WIDTHS
_PARTS = name_fields(
    *map(key, ("object", "fingers", "friction", "start")),
    *(key(name, default=None) for name in ("uncertainty", "goal", "phases")),
)
TOP = name_fields(*keys_of(Problem).values(), *keys_of(Scene).values()) | _PARTS


def name_keys() -> dict[str, tuple[str, ...]]:
    """Short names for `Problem.with_` and the dotted keys that each stands for."""
    names: dict[str, tuple[str, ...]] = {key: (key,) for key in TOP}
    names |= {key: (f"object.{key}",) for key in OBJECT}
    names |= {key: (f"start.{key}",) for key in START}
    names |= {f"friction_{key}": (f"friction.{key}",) for key in FRICTION}
    names["friction"] = tuple(f"friction.{key}" for key in FRICTION)
    for finger, field in FINGER.items():
        name = f"finger_{finger}" if finger in OBJECT else finger
        names |= {f"{name}{number}": (f"fingers.{number}.{finger}",) for number in FINGERS}
        if field.kind is not POINT:
            names[name] = tuple(f"fingers.{number}.{finger}" for number in FINGERS)
    return names


def build_schema() -> dict[str, Any]:
    """The JSON Schema of problem files."""
    goal = {"oneOf": [{"required": ["flush"]}, {"required": ["phi_deg"]}]}
    until = {
        "type": "object",
        "additionalProperties": False,
        "minProperties": 1,
        "properties": _describe(UNTIL),
    }
    ends = [
        {"required": ["until"]},
        {"required": ["end"], "properties": {"end": {"const": "smooth"}}},
    ]
    phase = _describe_table(PHASE) | {"anyOf": ends}
    phase["properties"]["until"]["oneOf"] = [refer("contact"), until]
    goals = [refer("goal"), {"type": "array", "items": refer("goal")}]
    parts = {
        "object": _describe_table(OBJECT),
        "fingers": _describe_table(FINGERS),
        "friction": _describe_table(FRICTION, "Coefficients of friction with the object."),
        "start": _describe_table(START),
        "uncertainty": _describe_table(
            UNCERTAINTY, "Ranges of what is not known exactly, for robustness and solve --robust."
        ),
        "goal": {
            "description": "Where the object shall come to lie, in place of phases; several are "
            "visited in order.",
            "oneOf": goals,
        },
        "phases": {"type": "array", "items": phase},
    }
    whole = _describe_table(
        TOP,
        "A polygon, a hand of a palm and two fingers, a start, and the contact formations to go "
        "through. SI units.",
    )
    whole["properties"] |= parts
    definitions = {
        "contact": CONTACT,
        "goal": _describe_table(GOAL) | goal,
        "point": {"type": "array", "minItems": 2, "maxItems": 2, "items": {"type": "number"}},
        "coefficient": {**NONNEGATIVE.schema, "maximum": COEFFICIENTS.high},
        "finger": _describe_table(FINGER),
    }
    first = {"$schema": "http://json-schema.org/draft-07/schema#", "title": "wholearm problem"}
    return first | whole | {"definitions": definitions}


def _describe(table: Table) -> dict[str, Any]:
    return {name: field.schema for name, field in table.items()}


def _describe_table(table: Table, text: str = "") -> dict[str, Any]:
    """The schema of a table."""
    return {
        "type": "object",
        **({"description": text} if text else {}),
        "additionalProperties": False,
        "required": [name for name, field in table.items() if field.required],
        "properties": _describe(table),
    }


def write_page() -> str:
    """All keys of a problem file, as tables in Markdown."""
    tables = {
        "At the top": TOP,
        "`[object]`": OBJECT,
        "`[fingers.1]`, `[fingers.2]`": FINGER,
        "`[friction]`": FRICTION,
        "`[start]`": START,
        "`[uncertainty]`": UNCERTAINTY,
        "`[goal]`": GOAL,
        "`[[phases]]`": PHASE,
    }
    parts = []
    for title, table in tables.items():
        lines = [f"| {title} | unit | default | allowed | |", "|---|---|---|---|---|"]
        for name, field in table.items():
            if name not in _PARTS:
                text = re.sub(r" ?\[[^]]*\]", "", field.text)
                default = "required" if field.required else field.describe_default()
                allowed = ", ".join(filter(None, (one.describe() for one in field.ranges)))
                lines.append(f"| `{name}` | {field.unit} | {default} | {allowed} | {text} |")
        parts.append("\n".join(lines) + "\n")
    return "\n".join(parts)
