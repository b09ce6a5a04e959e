"""Tables of a problem file: conversion from a problem, changes by name, output as TOML."""

from __future__ import annotations

import copy
import json
import math
import os
import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from typing import TYPE_CHECKING, Any

import numpy as np

from ..common.document import to_plain
from ..common.errors import InputError, suggest
from ..common.fields import Field, keys_of
from ..common.files import require_ending, write_text
from ..contacts.closing import close_finger, place_flush
from ..scene.model import Polygon, Scene

if TYPE_CHECKING:
    from .definition import Phase, Problem, Until


DIGITS = 9  # decimals of an angle in degrees of a printed phase
REQUIRED_KEYS = {"settle_gap": "settle", "control_hold": "control_period"}
"""Keys of a file, and the keys without which they have no effect."""
_STEP = re.compile(r"([^.\[\]]+)|\[([1-9][0-9]*)\]")


def change_table(
    table: Mapping[str, Any], changes: Mapping[str, Any], names: Mapping[str, Sequence[str]]
) -> dict[str, Any]:
    """Copy of the nested tables of a problem file with other values.

    `changes` are by short name (`names`, see `name_keys`), or by a dotted key as in messages, such
    as ``phases[2].until``; None removes a key. InputError if a name is unknown, or a part of a
    dotted key is not a table.
    """
    changed: dict[str, Any] = copy.deepcopy(dict(table))
    owners = dict[str, str]()  # name that changes each key
    for name, value in changes.items():
        is_dotted = "." in name or "[" in name
        if not is_dotted and name not in names:
            allowed = f"allowed are {', '.join(sorted(names))}"
            raise InputError("", name, f"unknown name; {suggest(name, names)}{allowed}")
        as_table = name == "friction" and isinstance(value, Mapping)
        for key in (name,) if is_dotted or as_table else names[name]:
            if (other := owners.setdefault(key, name)) != name:
                raise InputError("", name, f"changes the same number as {other} does; give one")
            _set(changed, key, to_plain(value, finite=False))
    return changed


def _set(table: dict[str, Any], key: str, value: object) -> None:
    """Set a dotted key; None removes it."""
    if _STEP.sub("", key).strip("."):
        raise InputError("", key, "is no key such as phases[2].until; entries count from 1")
    steps = [word or int(number) - 1 for word, number in _STEP.findall(key)]
    place: Any = table
    for step in steps[:-1]:
        place = _enter(place, step, key)
    last = steps[-1] if steps else key
    if isinstance(last, int):
        _enter(place, last, key)
        place[last] = value
    elif not isinstance(place, dict):
        raise InputError("", key, f"{place!r} is not a table")
    elif value is None:
        place.pop(last, None)
    else:
        place[last] = value


def _enter(place: Any, step: str | int, key: str) -> Any:
    if isinstance(step, int):
        if not isinstance(place, list) or step >= len(place):
            count = len(place) if isinstance(place, list) else 0
            raise InputError("", key, f"there is no number {step + 1}; the list has {count}")
    elif not isinstance(place, dict) or step not in place:
        keys = list(place) if isinstance(place, dict) else ["no table"]
        keys_text = f"what is there: {', '.join(keys)}"
        raise InputError("", key, f"there is no {step!r}; {suggest(step, keys)}{keys_text}")
    return place[step]


def write_table(problem: Problem) -> Mapping[str, Any]:
    """The nested tables of a problem file, without defaults.

    Empty if the start is not an edge flush on the palm with both fingers closed: files describe
    only such starts.
    """
    start = _find_start(problem)
    if start is None:
        return {}
    table: dict[str, Any] = {
        key: value
        for key, value, field in _list_values(("", problem))
        if field.required or value != field.default_value
    }
    table |= {"object": {}, "fingers": {"1": {}, "2": {}}, "friction": {}, "start": start}
    if problem.uncertainty is not None:
        table["uncertainty"] = to_plain(problem.uncertainty)
    goals = [
        {"flush": goal.flush, "phi_deg": goal.phi and to_degrees(goal.phi), "x": goal.x}
        for goal in problem.goals
    ]
    goals = [{k: to_plain(goal[k]) for k in goal if goal[k] is not None} for goal in goals]
    if goals:
        table["goal"] = goals[0] if len(goals) == 1 else goals
    elif problem.phases:
        table["phases"] = [describe_phase(phase) for phase in problem.phases]
    for key, value, field in _list_values(*_list_parts(problem.scene)):
        if field.required or value != field.default_value:
            _set(table, key, value)
    for key, parent in REQUIRED_KEYS.items():
        if key in table:
            table.setdefault(parent, 0.0)
    return table


def to_degrees(angle: float, digits: int = 15) -> float:
    """An angle [rad] in degrees, with the fewest decimals (<= `digits`) that are converted back."""
    rounded = [round(math.degrees(angle), count) for count in range(6, digits + 1)]
    return next((value for value in rounded if math.radians(value) == angle), rounded[-1])


def describe_scene(scene: Scene) -> dict[str, Any]:
    """Values of a scene by the dotted keys of a problem file; None for omitted keys."""
    return {key: value for key, value, _ in _list_values(*_list_parts(scene))}


def _list_parts(scene: Scene) -> list[tuple[str, object]]:
    """Pairs of the prefix of the keys and a part of the scene."""
    fingers = [(f"{finger.name}.", finger) for finger in scene.fingers]
    return [("object.", scene.polygon), ("friction.", scene.friction), *fingers, ("", scene)]


def _list_values(*parts: tuple[str, object]) -> Iterator[tuple[str, Any, Field]]:
    """Dotted keys, values and declarations of parts of a problem."""
    for prefix, part in parts:
        for attribute, field in keys_of(part).items():
            value = to_plain(getattr(part, attribute))
            if attribute == "inertia" and isinstance(part, Polygon):
                value = None if value == part.uniform_inertia else value
            yield f"{prefix}{field.name}", value, field


def _find_start(problem: Problem) -> dict[str, Any] | None:
    """The table of the start; None if no edge is flush on the palm or a finger is not closed."""
    q, scene = problem.start[:3], problem.scene
    units = np.array([scene.scales.length, scene.scales.length, 1.0])
    for edge in range(scene.polygon.n_vertices):
        if (np.abs(place_flush(scene, edge, float(q[0])) - q) <= 1e-12 * units).all():
            with suppress(InputError):
                closed = [close_finger(scene, q, finger) for finger in (0, 1)]
                if np.abs(problem.start[3:] - closed).max() <= 1e-9:
                    return {"flush": edge, "x": float(q[0])}
    return None


def describe_phase(phase: Phase, digits: int = 15) -> dict[str, Any]:
    """Table of a phase in a file, with angles of at most `digits` decimals."""
    contacts, rolling = phase.formation.contacts, phase.formation.rolling
    entry: dict[str, Any] = {"contacts": [c.name + " rolling" * (c in rolling) for c in contacts]}
    if not phase.until.is_release:
        entry["until"] = write_until(phase.until, digits)
    if phase.settle is not None:
        entry["settle"] = phase.settle
    if phase.guess:
        entry["guess"] = []
        for mode in phase.guess:
            signs = "".join("-0+"[round(sign) + 1] for sign in mode.signs)
            place = {"t": mode.t, "x": mode.x, "phi_deg": to_degrees(mode.phi, digits)}
            entry["guess"].append(place | {"signs": f"{signs[:-2]} {signs[-2:]}"})
    return entry if phase.end.value == "rest" else entry | {"end": phase.end.value}


def write_until(until: Until, digits: int) -> Any:
    """Value of `until` in a file: the name of a contact, or a table."""
    if until.contact is not None and not until.pins:
        return until.contact.name
    table: dict[str, Any] = {} if until.contact is None else {"contact": until.contact.name}
    for row, value in until.poses:
        table["phi_deg" if row else "x"] = (to_degrees(value, digits) if row else value) + 0.0
    return table


def format_until(until: Until) -> str:
    """Value of `until` as text of a problem file."""
    return _write(write_until(until, DIGITS))


def save_problem(problem: Problem, path: str | os.PathLike[str]) -> None:
    """Write a problem to a ``.toml`` file, from which it can be loaded.

    InputError if the file cannot be written, or no file can describe the start: no edge is flush
    on the palm, or a finger does not touch.
    """
    require_ending(path, ".toml")
    if not problem.table:
        text = "the problem starts with no edge on the palm, or a finger open, which no file says"
        raise InputError(str(path), "start", text)
    write_text(path, write_toml(problem.table))


def write_toml(table: Mapping[str, Any], prefix: str = "") -> str:
    """Nested tables as TOML: values first, then tables, then lists of tables."""
    values, tables = [], []
    for key, value in table.items():
        full_key = f"{prefix}{_quote(key)}"
        if isinstance(value, Mapping):
            tables.append(f"\n[{full_key}]\n{write_toml(value, f'{full_key}.')}")
        elif isinstance(value, list) and value and all(isinstance(v, Mapping) for v in value):
            for entry in value:
                lines = (f"{_quote(name)} = {_write(item)}\n" for name, item in entry.items())
                tables.append(f"\n[[{full_key}]]\n{''.join(lines)}")
        else:
            values.append(f"{_quote(key)} = {_write(value)}\n")
    return "".join(values + tables)


def _quote(key: str) -> str:
    return key if re.fullmatch(r"[A-Za-z0-9_-]+", key) else json.dumps(key, ensure_ascii=False)


def _write(value: Any) -> str:
    """A value as TOML; numbers with all digits."""
    if isinstance(value, Mapping):
        return "{ " + ", ".join(f"{_quote(k)} = {_write(v)}" for k, v in value.items()) + " }"
    if isinstance(value, list | tuple) and value and isinstance(value[0], Mapping):
        return "[\n" + "".join(f"    {_write(item)},\n" for item in value) + "]"
    if isinstance(value, list | tuple):
        return "[" + ", ".join(map(_write, value)) + "]"
    if isinstance(value, str | bool):
        # TOML allows DEL in strings only escaped.
        return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")
    return repr(value)
