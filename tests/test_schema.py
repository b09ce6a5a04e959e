"""The JSON Schema of problem files says what their reader says."""

from __future__ import annotations

import copy
import json
import re
import tomllib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from shipped import FOLDER, HEPTAGON
from wholearm.cli.command import main
from wholearm.common.errors import InputError
from wholearm.problem.keys import TOP, build_schema, write_page
from wholearm.problem.read import build_problem

jsonschema = pytest.importorskip("jsonschema")
SCHEMA = build_schema()
TABLE = tomllib.loads(HEPTAGON.read_text(encoding="utf-8")) | {"uncertainty": {"mass": 0.1}}
PARTS = SCHEMA["properties"]
TABLES: dict[str, tuple[dict[str, Any], Callable[[Any], Any]]] = {
    "": (SCHEMA, lambda table: table),
    "object": (PARTS["object"], lambda table: table["object"]),
    "fingers": (PARTS["fingers"], lambda table: table["fingers"]),
    "fingers.1": (SCHEMA["definitions"]["finger"], lambda table: table["fingers"]["1"]),
    "friction": (PARTS["friction"], lambda table: table["friction"]),
    "uncertainty": (PARTS["uncertainty"], lambda table: table["uncertainty"]),
    "start": (PARTS["start"], lambda table: table["start"]),
    "phases[1]": (PARTS["phases"]["items"], lambda table: table["phases"][0]),
}


@pytest.mark.parametrize("where", TABLES)
def test_keys_are_those_that_the_reader_allows(where: str) -> None:
    part, find = TABLES[where]
    table = copy.deepcopy(TABLE)
    find(table)["surely_unknown"] = 1
    with pytest.raises(InputError, match="unknown key") as caught:
        build_problem(table)
    (allowed,) = re.findall(r"allowed are (.*)", str(caught.value))
    assert sorted(part["properties"]) == allowed.split(", ")
    # Each key that is left out is missed if the schema requires it, and only then.
    for key in part["properties"]:
        table = copy.deepcopy(TABLE)
        find(table).pop(key, None)
        # Only a phase with a smooth end may lack `until`; this one ends at rest.
        if key in part["required"] or key == "until":
            with pytest.raises(jsonschema.ValidationError):
                jsonschema.validate(table, SCHEMA)
            with pytest.raises(InputError, match="is missing"):
                build_problem(table)
        else:
            build_problem(table)


@pytest.mark.parametrize("path", sorted(FOLDER.glob("*.toml")), ids=lambda path: path.stem)
def test_shipped_problems_are_valid(path: Path) -> None:
    jsonschema.validate(tomllib.loads(path.read_text(encoding="utf-8")), SCHEMA)


@pytest.mark.parametrize(
    ("where", "key", "value"),
    [
        ("", "epsilon", -1.0),
        ("", "surely_unknown", 1),
        ("object", "vertices", [[0.0, 0.0], [1.0, 0.0]]),
        ("fingers.1", "length", "long"),
        ("friction", "palm", 11.0),
        ("uncertainty", "gain", 1.0),
        ("start", "flush", 0.5),
        ("phases[1]", "end", "soft"),
        ("phases[1]", "until", {"y": 1.0}),
        ("phases[1]", "contacts", ["v0-wall"]),
    ],
)
def test_what_the_schema_refuses_the_reader_refuses(where: str, key: str, value: object) -> None:
    table = copy.deepcopy(TABLE)
    TABLES[where][1](table)[key] = value
    with pytest.raises(jsonschema.ValidationError):
        jsonschema.validate(table, SCHEMA)
    with pytest.raises(InputError):
        build_problem(table)


def test_the_command_prints_it(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    assert main(["schema"]) == 0
    assert json.loads(capsys.readouterr().out) == SCHEMA
    assert main(["schema", "-o", str(tmp_path / "schema.json")]) == 0
    assert json.loads((tmp_path / "schema.json").read_text(encoding="utf-8")) == SCHEMA
    capsys.readouterr()
    assert main(["schema", "--table"]) == 0
    assert capsys.readouterr().out == write_page()
    assert all(f"| `{key}` |" in write_page() for key, own in TOP.items() if own.text)
