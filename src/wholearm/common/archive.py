"""Arrays from a ``.npz`` file that anybody may have written."""

from __future__ import annotations

import os
import zipfile
import zlib
from collections.abc import Iterable
from typing import Any, BinaryIO

import numpy as np

from .errors import InputError

LARGEST = 2**28
"""Largest array that is read [byte]: a million rows of everything take less."""


def read_arrays(path: str | os.PathLike[str], names: Iterable[str]) -> dict[str, Any]:
    """Read the named arrays of an archive, as far as it has them.

    Nothing is unpickled, and no array takes more memory than its bytes in the file.

    Raises
    ------
    InputError
        If the file cannot be read, is no archive of arrays, or claims what it does not hold.
    """
    source = str(path)
    try:
        with open(path, "rb") as stream:
            if stream.read(6) == b"\x93NUMPY":
                raise InputError(source, "", "is not a trajectory file: one array, no archive")
            stream.seek(0)
            return _read_archive(source, stream, names)
    except OSError as error:
        raise InputError(source, "", f"cannot be read: {error.strerror or error}") from None
    except (
        ValueError,
        EOFError,
        MemoryError,
        RuntimeError,
        zipfile.BadZipFile,
        zlib.error,
    ) as error:
        raise InputError(source, "", f"is not a trajectory file: {error}") from None


def _read_archive(source: str, stream: BinaryIO, names: Iterable[str]) -> dict[str, Any]:
    arrays = {}
    with zipfile.ZipFile(stream) as archive:
        known = {info.filename: info for info in archive.infolist()}
        for name in names:
            info = known.get(f"{name}.npy")
            if info is None:
                continue
            if info.file_size > LARGEST:
                problem = f"holds {info.file_size} bytes; allowed are up to {LARGEST}"
                raise InputError(source, name, problem)
            with archive.open(info) as member:
                content = member.read()
            arrays[name] = _read_array(source, name, content)
    return arrays


def _read_array(source: str, name: str, content: bytes) -> Any:
    """The array whose ``.npy`` file has the given bytes."""
    import io

    stream = io.BytesIO(content)
    shape, _, kind = _read_header(stream)
    if kind.hasobject:
        raise InputError(source, name, "holds Python objects; numbers or text are needed")
    count = 1
    for size in shape:
        count *= size
    claimed, given = count * kind.itemsize, len(content) - stream.tell()
    if min(shape, default=0) < 0 or claimed != given:
        raise InputError(source, name, f"claims {claimed} bytes of {shape} and holds {given}")
    stream.seek(0)
    return np.lib.format.read_array(stream, allow_pickle=False)


def _read_header(stream: BinaryIO) -> tuple[tuple[int, ...], bool, Any]:
    version = np.lib.format.read_magic(stream)
    if version == (1, 0):
        return np.lib.format.read_array_header_1_0(stream)
    if version == (2, 0):
        return np.lib.format.read_array_header_2_0(stream)
    raise ValueError(f"version {version} of the array format is unknown")
