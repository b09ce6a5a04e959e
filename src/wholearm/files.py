"""Output files that appear whole or not at all."""

from __future__ import annotations

import os
from collections.abc import Callable
from typing import BinaryIO

from .errors import InputError


def require_writable(path: str | os.PathLike[str]) -> None:
    """Check, before long work, that a file can be written at `path`.

    Raises
    ------
    InputError
        If it is a folder, or its folder does not exist or cannot be written to.
    """
    target = os.fspath(path)
    folder = os.path.dirname(os.path.realpath(target))
    if os.path.isdir(target):
        raise InputError(target, "", "cannot be written: is a folder")
    if not os.path.isdir(folder):
        raise InputError(target, "", f"cannot be written: {folder} is not a folder")
    if not os.access(folder, os.W_OK) and not _is_special(target):
        raise InputError(target, "", f"cannot be written: no permission in {folder}")


def write_whole(path: str | os.PathLike[str], write: Callable[[BinaryIO], object]) -> None:
    """Write a file through a temporary one beside it, renamed when complete.

    Parameters
    ----------
    path : path-like
        Where the file is to appear; an existing file is replaced, and what is not a file (a
        device, a pipe) is written to.
    write : callable
        Receives the open binary file.

    Raises
    ------
    InputError
        If the file cannot be written.
    """
    target = os.fspath(path)
    try:
        if _is_special(target):
            with open(target, "wb") as stream:
                write(stream)
        else:
            _replace(os.path.realpath(target), write)
    except OSError as error:
        raise InputError(target, "", f"cannot be written: {error.strerror}") from None


def _is_special(target: str) -> bool:
    return os.path.exists(target) and not os.path.isfile(target) and not os.path.isdir(target)


def _replace(target: str, write: Callable[[BinaryIO], object]) -> None:
    folder, name = os.path.split(target)
    part = os.path.join(folder, f".{name}.{os.getpid()}.part")
    try:
        with open(part, "xb") as stream:
            write(stream)
        os.replace(part, target)
    finally:
        if os.path.exists(part):
            os.unlink(part)
