"""Problem files in TOML, written from the tables of a problem."""

from __future__ import annotations

import json
import os
import re
from collections.abc import Mapping
from typing import Any

from ..common.errors import InputError
from ..common.files import require_ending, write_text
from .definition import Problem


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
        name = key if re.fullmatch(r"[A-Za-z0-9_-]+", key) else json.dumps(key)
        full = f"{where}{name}"
        if isinstance(value, Mapping):
            inner.append(f"\n[{full}]\n{write_toml(value, f'{full}.')}")
        elif key in ("phases", "goal") and isinstance(value, list):
            for entry in value:
                lines = (f"{name} = {_write(item)}\n" for name, item in entry.items())
                inner.append(f"\n[[{full}]]\n{''.join(lines)}")
        else:
            plain.append(f"{name} = {_write(value)}\n")
    return "".join(plain + inner)


def _write(value: Any) -> str:
    """A value, with all digits of a number."""
    if isinstance(value, Mapping):
        return "{ " + ", ".join(f"{key} = {_write(own)}" for key, own in value.items()) + " }"
    if isinstance(value, list | tuple):
        return "[" + ", ".join(map(_write, value)) + "]"
    return json.dumps(value) if isinstance(value, str | bool) else repr(value)
