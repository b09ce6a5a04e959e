"""What is known of a scene, kept in a folder from one command to the next."""

from __future__ import annotations

import hashlib
import pickle
import sys
from pathlib import Path

import casadi as ca
import numpy as np

from .. import __version__
from ..common.errors import InputError
from ..common.files import write_whole
from .chart import Chart

LARGEST = 200_000_000
"""Most bytes that a chart is written with."""
_RECURSION = 20_000
"""Depth of recursion that pickling a chart may take."""


def require_folder(folder: Path) -> None:
    """Check that charts can be kept in a folder, which is made if it is not there.

    Raises
    ------
    InputError
        If not.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError("", "--cache", f"{folder}: {error.strerror}") from None


def load_chart(folder: Path, key: str) -> Chart | None:
    """The chart of a scene, by the key of this; None where there is none, or the file is damaged.

    Files are pickles, which can do anything when they are read: a folder that others write to is
    not safe.
    """
    try:
        written = _name(folder, key).read_bytes()
        digest, body = written[:32], written[32:]
        if hashlib.sha256(body).digest() != digest:
            return None
        chart = pickle.loads(body)
    except Exception:
        # A file of whatever kind that cannot be read is one that is not there.
        return None
    return chart if isinstance(chart, Chart) else None


def store_chart(folder: Path, key: str, chart: Chart) -> None:
    """Write the chart of a scene, in place of what was there; the last one who writes it wins."""
    deepest = sys.getrecursionlimit()
    sys.setrecursionlimit(max(deepest, _RECURSION))
    try:
        body = pickle.dumps(chart, protocol=pickle.HIGHEST_PROTOCOL)
    finally:
        sys.setrecursionlimit(deepest)
    if len(body) <= LARGEST:
        digest = hashlib.sha256(body).digest()
        write_whole(_name(folder, key), lambda stream: stream.write(digest + body))


def _name(folder: Path, key: str) -> Path:
    """The file of a scene: another one for other versions."""
    versions = f"{__version__} {ca.__version__} {np.__version__} {sys.version}"
    return folder / f"{hashlib.sha256(f'{versions} {key}'.encode()).hexdigest()[:32]}.chart"
