"""The table of a problem file: changed by name, in step with its problem, written as TOML."""

from __future__ import annotations

import copy
import json
import math
import os
import re
from collections.abc import Iterator, Mapping, Sequence
from difflib import get_close_matches
from typing import TYPE_CHECKING, Any

import numpy as np

from ..common.errors import InputError
from ..common.fields import Field, keys_of
from ..common.files import require_ending, write_text
from ..contacts.closing import close_finger, place_flush
from ..scene.model import Polygon, Scene
from .goal import match_goals

if TYPE_CHECKING:
    from .definition import Phase, Problem, Until


SAME = 9  # decimals of an angle in degrees that are no rounding
_STEP = re.compile(r"([^.\[\]]+)|\[([1-9][0-9]*)\]")


def change_table(
    table: Mapping[str, Any], changes: Mapping[str, Any], names: Mapping[str, Sequence[str]]
) -> dict[str, Any]:
    """Return a copy of `table` with other values.

    Parameters
    ----------
    table    the nested tables of a problem file
    changes  new values by short name, or by a dotted key as messages write it, such as
             ``phases[2].until``. None removes a key.
    names    short names and their dotted keys, see `name_keys`

    Raises
    ------
    InputError  if a name is unknown, or a dotted key leads through something that is no table
    """
    changed: dict[str, Any] = copy.deepcopy(dict(table))
    for name, value in changes.items():
        dotted = "." in name or "[" in name
        if not dotted and name not in names:
            near = get_close_matches(name, names, 1, 0.5)
            hint = f"did you mean {near[0]!r}? " if near else ""
            text = f"unknown name; {hint}allowed are {', '.join(sorted(names))}"
            raise InputError("", name, text)
        whole = name == "friction" and isinstance(value, Mapping)
        for key in (name,) if dotted or whole else names[name]:
            _set(changed, key, _to_plain(value))
    return changed


def _set(table: dict[str, Any], key: str, value: object) -> None:
    """Set a dotted key; None removes it."""
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
        known = ", ".join(place) if isinstance(place, dict) else "no table"
        raise InputError("", key, f"there is no {step!r}; what is there: {known}")
    return place[step]


def _to_plain(value: Any) -> Any:
    """Numbers, text, lists and tables as a file has them."""
    if isinstance(value, np.ndarray | np.generic):
        return value.tolist()
    if isinstance(value, Mapping):
        return {str(key): _to_plain(item) for key, item in value.items()}
    return [_to_plain(item) for item in value] if isinstance(value, list | tuple) else value


def match_table(problem: Problem) -> Mapping[str, Any]:
    """Return the problem's table with everything that differs from the problem written into it.

    Empty where there is none, or where the start is no edge flush on the palm with both fingers
    closed, which is all that a file can say.
    """
    table = problem.table
    if not table:
        return table
    known = _list_values(("", problem), *_list_parts(problem.scene))
    differing = {key: value for key, value, own in known if not _agrees(table, key, value, own)}
    if problem.uncertainty != table.get("uncertainty"):
        differing["uncertainty"] = _to_plain(problem.uncertainty)
    start = _match_start(table["start"], problem)
    if start is None:
        return {}
    phases = [_match_phase(table.get("phases", []), phase) for phase in problem.phases]
    goals = match_goals(problem.goals, table) if problem.goals else None
    same = start is table["start"] and phases == table.get("phases", [])
    if not differing and same and goals == table.get("goal"):
        return table
    changed = copy.deepcopy({**table, "start": start, "phases": phases})
    _set(changed, "goal", goals)
    for key, value in differing.items():
        _set(changed, key, value)
    return changed


def write_table(problem: Problem) -> Mapping[str, Any]:
    """The table of a problem that has none; empty where no file can say its start."""
    start = _match_start({"flush": 0, "x": None}, problem)
    if start is None:
        return {}
    table: dict[str, Any] = {
        key: value
        for key, value, own in _list_values(("", problem))
        if own.required or value != own.shown_default
    }
    phases = [_match_phase([], phase) for phase in problem.phases]
    table |= {"object": {}, "fingers": {"1": {}, "2": {}}, "friction": {}}
    table |= {"start": start, "phases": phases}
    if problem.uncertainty is not None:
        table["uncertainty"] = _to_plain(problem.uncertainty)
    if problem.goals:
        table["goal"] = match_goals(problem.goals, {})
    for key, value in describe_scene(problem.scene).items():
        _set(table, key, value)
    return table


def describe_scene(scene: Scene) -> dict[str, Any]:
    """Values of a scene by the dotted keys of a problem file; None for what is left out there."""
    return {key: value for key, value, _ in _list_values(*_list_parts(scene))}


def _list_parts(scene: Scene) -> list[tuple[str, object]]:
    """Parts of a scene after the prefixes of their keys."""
    fingers = [(f"{finger.name}.", finger) for finger in scene.fingers]
    return [("object.", scene.polygon), ("friction.", scene.friction), *fingers, ("", scene)]


def _list_values(*parts: tuple[str, object]) -> Iterator[tuple[str, Any, Field]]:
    """Dotted keys, values and declarations of parts of a problem."""
    for prefix, part in parts:
        for attribute, own in keys_of(part).items():
            value = _to_plain(getattr(part, attribute))
            if attribute == "inertia" and isinstance(part, Polygon):
                value = None if value == part.uniform_inertia else value
            yield f"{prefix}{own.name}", None if value == math.inf else value, own


def _agrees(table: Mapping[str, Any], key: str, value: object, own: Field) -> bool:
    """Whether a table has a value, or leaves out a default."""
    *path, last = key.split(".")
    place: Any = table
    for step in path:
        place = place[step]
    if key == "object.inertia" and value is None and last in place:
        uniform = Polygon(place["vertices"], place["mass"]).inertia
        return bool(place[last] == uniform)
    return bool(place.get(last, own.shown_default) == value)


def _match_start(start: Mapping[str, Any], problem: Problem) -> Mapping[str, Any] | None:
    """The table of the start, or None if no edge is flush there or a finger is not closed."""
    q, scene = problem.start[:3], problem.scene
    try:
        closed = [close_finger(scene, q, finger) for finger in (0, 1)]
    except InputError:
        return None
    if np.abs(problem.start[3:] - closed).max() > 1e-9:
        return None
    edges = [start["flush"], *range(scene.polygon.n_vertices)]
    for edge in edges:
        flush = edge < scene.polygon.n_vertices and place_flush(scene, edge, float(q[0]))
        if flush is not False and np.abs(flush - q).max() <= 1e-12 * scene.scales.length:
            same = edge == start["flush"] and q[0] == start["x"]
            return start if same else {"flush": edge, "x": float(q[0])}
    return None


def _match_phase(entries: Sequence[Mapping[str, Any]], phase: Phase) -> Mapping[str, Any]:
    """The entry that says what a phase is, or a new one."""
    own = describe_phase(phase)
    for entry in (*entries[phase.index : phase.index + 1], *entries):
        same = _is_same(entry.get("until"), own.get("until"))
        same = same and all(entry.get(key) == own.get(key) for key in ("contacts", "settle"))
        if same and entry.get("end", "rest") == phase.end.value:
            return entry
    return own


def describe_phase(phase: Phase, digits: int | None = None) -> dict[str, Any]:
    """A phase as an entry of a file, with angles rounded to so many decimals."""
    own: dict[str, Any] = {"contacts": name_contacts(phase)}
    if not phase.until.is_release:
        own["until"] = write_until(phase.until, digits)
    if phase.settle is not None:
        own["settle"] = phase.settle
    return own if phase.end.value == "rest" else own | {"end": phase.end.value}


def write_until(until: Until, digits: int | None = None) -> Any:
    """What ends a phase, as its file has it: a name, or a table, with rounded angles if asked."""
    if until.contact is not None and not until.pins:
        return until.contact.name
    own: dict[str, Any] = {} if until.contact is None else {"contact": until.contact.name}
    for row, value in until.poses:
        angle = math.degrees(value)
        angle = angle if digits is None else round(angle, digits)
        own["phi_deg" if row else "x"] = angle + 0.0 if row else value + 0.0
    return own


def format_until(until: Until) -> str:
    """The value of `until` in a problem file, to read."""
    return _write(write_until(until, SAME))


def _is_same(given: Any, own: Any) -> bool:
    """Whether an `until` says the same as another one, in the same order."""
    if not isinstance(given, Mapping) or not isinstance(own, Mapping):
        return bool(given == own)
    # An angle of a file is known in radians, to whose rounding its degrees are the same.
    return list(given) == list(own) and all(
        math.radians(value) == math.radians(own[key]) if key == "phi_deg" else value == own[key]
        for key, value in given.items()
    )


def name_contacts(phase: Phase) -> list[str]:
    """Contacts of a phase as its file names them."""
    rolling = phase.formation.rolling
    return [c.name + (" rolling" if c in rolling else "") for c in phase.formation.contacts]


def save_problem(problem: Problem, path: str | os.PathLike[str]) -> None:
    """Write a problem to a ``.toml`` file, which loads as the same.

    Raises
    ------
    InputError  if the file cannot be written, or the problem starts where no file can say: with no
                edge flush on the palm, or a finger that does not touch
    """
    require_ending(path, ".toml")
    if not problem.table:
        text = "the problem starts with no edge on the palm, or a finger open, which no file says"
        raise InputError(str(path), "start", text)
    write_text(path, write_toml(problem.table))


def write_toml(table: Mapping[str, Any], where: str = "") -> str:
    """Nested tables as TOML: values first, then tables, then lists of tables."""
    plain, inner = [], []
    for key, value in table.items():
        full = f"{where}{_quote(key)}"
        if isinstance(value, Mapping):
            inner.append(f"\n[{full}]\n{write_toml(value, f'{full}.')}")
        elif isinstance(value, list) and value and all(isinstance(v, Mapping) for v in value):
            for entry in value:
                lines = (f"{_quote(name)} = {_write(item)}\n" for name, item in entry.items())
                inner.append(f"\n[[{full}]]\n{''.join(lines)}")
        else:
            plain.append(f"{_quote(key)} = {_write(value)}\n")
    return "".join(plain + inner)


def _quote(key: str) -> str:
    return key if re.fullmatch(r"[A-Za-z0-9_-]+", key) else json.dumps(key, ensure_ascii=False)


def _write(value: Any) -> str:
    """A value, with all digits of a number."""
    if isinstance(value, Mapping):
        return "{ " + ", ".join(f"{_quote(k)} = {_write(v)}" for k, v in value.items()) + " }"
    if isinstance(value, list | tuple):
        return "[" + ", ".join(map(_write, value)) + "]"
    return json.dumps(value, ensure_ascii=False) if isinstance(value, str | bool) else repr(value)
