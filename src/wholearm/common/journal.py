"""Journal of a study: one JSON record per line, kept as they come, to resume from."""

from __future__ import annotations

import json
import os
import stat
from typing import Any, BinaryIO

from .document import describe_differences, find_differences
from .errors import InputError, name_file
from .signals import held

try:
    import fcntl
except ImportError:  # not on Windows
    fcntl = None  # type: ignore[assignment]


class Journal:
    """A file of one JSON object per line, begun by a line that says what the study is.

    Nothing in the file is lost unless that is asked for. While the journal exists nobody else can
    have one of the same file. Only a regular file has records: `os.devnull` stands for none. The
    `stamp` is what the records belong to, its `study` their kind. A `fresh` file is begun anew,
    whatever it holds; with `again`, records with findings are dropped, so that their tasks are run
    again. Where the stamp has a `source` records of another one are none.

    InputError if the file holds something else, another study of the same kind included, or is
    being written by another run, or cannot be written.
    """

    def __init__(
        self, path: str, stamp: dict[str, Any], fresh: bool = False, again: bool = False
    ) -> None:
        self.path, self._stamp = path, json.loads(json.dumps(stamp))
        self.records: list[dict[str, Any]] = []
        try:
            self._stream: BinaryIO = open(path, "ab+", buffering=0)
            try:
                if stat.S_ISREG(os.fstat(self._stream.fileno()).st_mode):
                    if fcntl is not None:
                        # Keeps others from the file until it is closed, or this process ends.
                        fcntl.flock(self._stream.fileno(), fcntl.LOCK_EX | fcntl.LOCK_NB)
                    self._stream.seek(0)
                    self._begin(b"" if fresh else self._stream.read(), again)
            except BaseException:
                self.close()
                raise
        except BlockingIOError:
            text = "another run is writing to it; wait for its end, or choose another with -o"
            raise InputError(path, "", text) from None
        except OSError as error:
            raise InputError(path, "", f"cannot be written: {error.strerror}") from None

    def __enter__(self) -> Journal:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Let others have the file."""
        self._stream.close()

    def add(self, record: dict[str, Any]) -> None:
        """Keep a record; an `InputError` if it cannot be written."""
        self.records.append(record)
        with name_file(self.path, failure="cannot be written"):
            self._write((json.dumps(record) + "\n").encode())

    def _begin(self, given: bytes, again: bool) -> None:
        """Take the records that are there, and leave whole lines, begun by the stamp."""
        head = (json.dumps(self._stamp) + "\n").encode()
        whole, other, kind = head, _parse(given.split(b"\n", 1)[0]), self._stamp["study"]
        if other.get("study") == kind and other.get("source") != self._stamp.get("source"):
            given = b""
        # Half of the first line is what a full disk leaves.
        if not head.startswith(given):
            differences = find_differences(other, self._stamp)
            if text := describe_differences(differences, "in the file", "now"):
                same = other.get("study") == kind
                what = f"another study: {text}" if same else f"no {kind} study"
                text = f"holds {what}; --fresh begins anew, or choose another with -o"
                raise InputError(self.path, "", text)
            first, *lines = given[: given.rfind(b"\n") + 1].splitlines(keepends=True)
            entries = [(line, _parse(line)) for line in lines]
            kept = [entry for entry in entries if not (again and entry[1].get("findings"))]
            self.records = [record for _, record in kept if record]
            whole = b"".join([first, *(line for line, _ in kept)])
        with held():
            if given.startswith(whole):
                self._stream.truncate(len(whole))
            else:
                self._stream.truncate(0)
                self._write(whole)

    def _write(self, line: bytes) -> None:
        left = memoryview(line)
        while left:
            left = left[self._stream.write(left) :]


def _parse(line: bytes) -> dict[str, Any]:
    """The record of a line; empty if it is none."""
    try:
        record = json.loads(line)
    except ValueError:
        return {}
    return record if isinstance(record, dict) else {}
