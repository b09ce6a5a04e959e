"""Records of a study that are kept as they come, so that it can go on where it was stopped."""

from __future__ import annotations

import json
import os
from collections.abc import Callable
from typing import Any

from .errors import InputError


class Journal:
    """A file of one JSON object per line, begun by a line that says what the study is.

    Parameters
    ----------
    path : str
    stamp : dict
        What the records belong to; those of another stamp are dropped.
    fresh : bool
        Drop all records that are there.
    again : bool
        Drop those with findings, so that their tasks are run again.

    Raises
    ------
    InputError
        If the file cannot be written.
    """

    def __init__(
        self, path: str, stamp: dict[str, Any], fresh: bool = False, again: bool = False
    ) -> None:
        self.path = path
        self.records: list[dict[str, Any]] = [] if fresh else _read(path, stamp)
        if again:
            self.records = [record for record in self.records if not record.get("findings")]
        try:
            # Written anew, so that what an interrupt left of a last line is gone.
            with open(f"{path}.part", "w", encoding="utf-8") as stream:
                for line in (stamp, *self.records):
                    stream.write(json.dumps(line) + "\n")
            os.replace(f"{path}.part", path)
        except OSError as error:
            raise InputError(path, "", f"cannot be written: {error.strerror}") from None

    def add(self, record: dict[str, Any]) -> None:
        """Keep a record."""
        self.records.append(record)
        with open(self.path, "a", encoding="utf-8") as stream:
            stream.write(json.dumps(record) + "\n")

    def done(self, key: str, name: Callable[[Any], Any] = lambda value: value) -> set[Any]:
        """The tasks that have a record under `key`."""
        return {name(record[key]) for record in self.records if key in record}


def _read(path: str, stamp: dict[str, Any]) -> list[dict[str, Any]]:
    try:
        with open(path, encoding="utf-8") as stream:
            lines = stream.read().split("\n")
    except (OSError, UnicodeDecodeError):
        return []
    records = []
    for line in lines:
        try:
            record = json.loads(line)
        except json.JSONDecodeError:
            continue
        if isinstance(record, dict):
            records.append(record)
    return records[1:] if records and records[0] == json.loads(json.dumps(stamp)) else []
