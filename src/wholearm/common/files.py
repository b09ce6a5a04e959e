"""Atomic writing of output files; reading of JSON and of array archives."""

from __future__ import annotations

import json
import os
import threading
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from functools import cache
from pathlib import Path
from typing import Any, BinaryIO

from .errors import InputError, name_file
from .signals import defer_signals, register_cleanup

READ: set[str] = set()  # resolved paths of the files that the command being run reads
MAX_BYTES = 2**28  # largest array that is read [byte]: a million rows of everything take less


def require_writable(path: str | os.PathLike[str]) -> None:
    """Raise an `InputError` if no file can be written at `path`; called before long tasks."""
    target, resolved = os.fspath(path), os.path.realpath(path)
    folder = os.path.dirname(resolved)
    if resolved in READ:
        raise InputError(target, "", "cannot be written: this command reads it")
    if os.path.isdir(target):
        raise InputError(target, "", "cannot be written: is a folder")
    if not os.path.isdir(folder):
        reason = f"{folder} is not a folder" if os.path.exists(folder) else f"no folder {folder}"
        raise InputError(target, "", f"cannot be written: {reason}")
    if not os.access(folder, os.W_OK) and not _is_special(target):
        raise InputError(target, "", f"cannot be written: no permission in {folder}")


def require_ending(path: str | os.PathLike[str], *allowed: str) -> str:
    """The extension of a file name in lower case, or an `InputError` if it is not allowed.

    Devices and pipes need none.
    """
    ending = os.path.splitext(path)[1].lower()
    if ending not in allowed and not _is_special(os.fspath(path)):
        text = f"ending {ending!r} given; allowed: {', '.join(allowed)}"
        raise InputError(os.fspath(path), "", text)
    return ending


def write_whole(path: str | os.PathLike[str], write: Callable[[BinaryIO], object]) -> None:
    """Write a file atomically: a temporary file beside it is renamed when complete.

    An existing file is replaced; devices and pipes are written to. `InputError` if it fails.
    """
    target, staged = os.fspath(path), _staged.get()
    if staged is None:
        # Outside of a group the file is a group of its own.
        with together():
            return write_whole(path, write)
    with name_file(target, failure="cannot be written"):
        if _is_special(target):
            with open(target, "wb") as stream:
                write(stream)
            return
        folder, name = os.path.split(os.path.realpath(target))
        part = os.path.join(folder, f".{name}.{os.getpid()}.{threading.get_ident()}.part")
        _parts.add(part)
        try:
            with open(part, "xb") as stream:
                write(stream)
        except BaseException:
            _remove(part)
            raise
        staged.append((part, target))


@contextmanager
def together() -> Iterator[None]:
    """Context in which files are written as a group: all appear at its end, or none."""
    staged: list[tuple[str, str]] = []
    token = _staged.set(staged)
    try:
        yield
        with defer_signals():
            for part, target in staged:
                with name_file(target, failure="cannot be written"):
                    os.replace(part, os.path.realpath(target))
    finally:
        _staged.reset(token)
        for part, _ in staged:
            _remove(part)


def write_text(path: str | os.PathLike[str], text: str) -> None:
    """Write a text file atomically; see `write_whole`."""
    write_whole(path, lambda stream: stream.write(text.encode()))


def read_json(path: str) -> Any:
    """Contents of a JSON file of stored answers; an `InputError` if it cannot be read."""
    try:
        return json.loads(Path(path).read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or "no JSON"
        text = f"cannot be read: {reason}; --update writes it anew"
        raise InputError(path, "", text) from None


def number_same(names: Sequence[str], form: str = "{}_{}") -> list[str]:
    """The names; if two are equal, all are numbered by the format `form`."""
    same = len({*names}) < len(names)
    return [form.format(name, k) if same else name for k, name in enumerate(names, start=1)]


def make_folder(path: str, key: str = "") -> None:
    """Create a folder if it does not exist; an `InputError` names the key if that fails."""
    with name_file(path, key, "cannot be made"):
        os.makedirs(path, exist_ok=True)


@cache
def digest_package() -> str:
    """A digest of the source code of the package."""
    import hashlib

    folder, digest = Path(__file__).parents[1], hashlib.sha256()
    for path in sorted(folder.rglob("*.py")):
        digest.update(str(path.relative_to(folder)).encode() + path.read_bytes())
    return digest.hexdigest()


def _is_special(target: str) -> bool:
    return os.path.exists(target) and not os.path.isfile(target) and not os.path.isdir(target)


def _remove(part: str) -> None:
    if os.path.exists(part):
        os.unlink(part)
    _parts.discard(part)


_parts: set[str] = set()  # existing temporary files


_staged: ContextVar[list[tuple[str, str]] | None] = ContextVar("staged", default=None)
"""Temporary files and their targets, inside `together`."""


register_cleanup(lambda: deque(map(_remove, tuple(_parts)), maxlen=0))


def read_arrays(path: str | os.PathLike[str], names: Iterable[str]) -> dict[str, Any]:
    """Read the named arrays of an archive (NPZ), without those that it lacks.

    Nothing is unpickled. An `InputError` if the file cannot be read, is no archive of arrays, or
    is damaged.
    """
    # Imported only by commands that read archives.
    import zipfile
    import zlib

    import numpy as np

    source, arrays = str(path), dict[str, Any]()
    try:
        with name_file(path), open(path, "rb") as stream:
            if stream.read(6) == b"\x93NUMPY":
                raise InputError(source, "", "is not a trajectory file: one array, no archive")
            with zipfile.ZipFile(stream) as archive:
                members = {info.filename: info for info in archive.infolist()}
                for name in names:
                    info = members.get(f"{name}.npy")
                    if info is None:
                        continue
                    if info.file_size > MAX_BYTES:
                        problem = f"holds {info.file_size} bytes; allowed are up to {MAX_BYTES}"
                        raise InputError(source, name, problem)
                    try:
                        with archive.open(info) as member:
                            arrays[name] = np.lib.format.read_array(member, allow_pickle=False)
                    except (ValueError, OverflowError, MemoryError) as error:
                        text = f"is no array of numbers or text: {error}"
                        raise InputError(source, name, text) from None
    except (ValueError, EOFError, MemoryError, RuntimeError, zipfile.BadZipFile, zlib.error) as e:
        raise InputError(source, "", f"is not a trajectory file: {e}") from None
    return arrays
