"""Trajectories in ``.npz`` files, checked when they are read."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from typing import Any

import numpy as np

from ..common.errors import InputError
from ..common.files import read_arrays, require_ending, write_whole
from ..common.plain import restore
from .plan_record import ModeSpan
from .sampled import sample_phases
from .torque import MOST, TorqueProfile
from .trajectory import Trajectory

_ARRAYS = {
    "t": (), "q": (3,), "theta": (2,), "q_dot": (3,), "theta_dot": (2,), "q_ddot": (3,),
    "theta_ddot": (2,), "tau": (2,), "c_n": (-1,), "c_t": (-1,), "phase": (),
}  # fmt: skip
_FARTHEST = 1e6
"""Largest coordinate [m or rad]: nothing in a problem is farther away or turned more."""


def write_trajectory(trajectory: Trajectory, path: str | os.PathLike[str]) -> None:
    """Write a trajectory; see `Trajectory.save`."""
    require_ending(path, ".npz")
    arrays: dict[str, Any] = {name: getattr(trajectory, name) for name in _ARRAYS}
    arrays["contacts"] = np.array(trajectory.contacts)
    arrays["torque_breaks"] = trajectory.torque.breaks
    arrays["torque_coefficients"] = trajectory.torque.coefficients
    arrays["meta"] = np.array(json.dumps(dict(trajectory.meta)))
    write_whole(path, lambda stream: np.savez(stream, **arrays))


def load_trajectory(path: str | os.PathLike[str]) -> Trajectory:
    """Read a trajectory file.

    Raises
    ------
    InputError  if the file cannot be read, or an array is missing or of the wrong shape
    """
    source = str(path)
    extra = {"contacts": (), "torque_breaks": (), "torque_coefficients": (2, -1)}
    arrays = read_arrays(path, (*_ARRAYS, *extra, "meta"))
    for name in (*_ARRAYS, *extra, "meta"):
        if name not in arrays:
            raise InputError(source, name, "array is missing")
    for name, shape in (_ARRAYS | extra).items():
        _check_shape(source, name, arrays, shape)
    _check_order(source, arrays)
    try:
        meta = json.loads(str(arrays["meta"]))
    except ValueError as error:
        raise InputError(source, "meta", f"is not JSON: {error}") from None
    except RecursionError:
        raise InputError(source, "meta", "is nested too deeply") from None
    if not isinstance(meta, dict):
        raise InputError(source, "meta", "is not a JSON object")
    named = meta.get("rolling", [])
    if not isinstance(named, list) or not all(isinstance(names, list) for names in named):
        raise InputError(source, "meta.rolling", "is not a list of names for each phase")
    try:
        restore(tuple[tuple[ModeSpan, ...], ...], meta.get("modes", []))
    except (AttributeError, KeyError, TypeError, ValueError):
        text = "is not a list of spans with start, stop, contacts and joints for each phase"
        raise InputError(source, "meta.modes", text) from None
    contacts = tuple(str(name) for name in arrays["contacts"])
    known = {name: arrays[name] for name in _ARRAYS}
    torque = TorqueProfile(arrays["torque_breaks"], arrays["torque_coefficients"])
    motions = sample_phases(known, contacts)
    return Trajectory(**known, contacts=contacts, torque=torque, motions=motions, meta=meta)


def _check_shape(source: str, name: str, arrays: Mapping[str, Any], tail: tuple[int, ...]) -> None:
    array = arrays[name]
    rows = arrays["t"].size if name in _ARRAYS else array.shape[0] if array.ndim else 1
    widths = (arrays["contacts"].size,) if name in ("c_n", "c_t") else tail
    fits = array.ndim == 1 + len(widths) and array.shape[0] == rows
    fits = fits and all(w in (-1, n) for w, n in zip(widths, array.shape[1:], strict=True))
    if not fits:
        needed = ", ".join(str(n) if n >= 0 else "any" for n in (rows, *widths))
        raise InputError(source, name, f"shape {array.shape} given, ({needed}) needed")
    if name == "contacts":
        if array.dtype.kind != "U":
            raise InputError(source, name, "does not hold text")
    elif array.dtype.kind not in ("iu" if name == "phase" else "iuf"):
        raise InputError(source, name, f"holds {array.dtype}; numbers are needed")
    elif np.isinf(array).any() or (name not in ("c_n", "c_t") and np.isnan(array).any()):
        raise InputError(source, name, "holds numbers that are not finite")
    most = _FARTHEST if name in ("q", "theta") else MOST
    if name != "contacts" and (np.abs(array.astype(float)) > most).any():
        raise InputError(source, name, f"holds numbers beyond {most:g}, the largest allowed")


def _check_order(source: str, arrays: Mapping[str, Any]) -> None:
    """Check that phases follow one another, and that time increases within each."""
    phase, t = arrays["phase"], arrays["t"]
    rises = np.diff(phase)
    in_order = len(phase) and phase[0] == 0 and ((rises == 0) | (rises == 1)).all()
    if not in_order or np.bincount(phase.astype(int)).min() < 2:
        raise InputError(source, "phase", "must count up from 0, with two or more rows to a phase")
    steps, inside = np.diff(t), np.diff(phase) == 0
    stays = inside & (steps == 0)
    # Forces step where a time is given twice, which is not at the end of a phase.
    last = np.append(inside[1:], False)
    if t[0] != 0 or (steps < 0).any() or (stays & (np.append(stays[1:], False) | ~last)).any():
        text = "must start at 0 and increase within each phase, a time given twice being a step"
        raise InputError(source, "t", text)
    breaks = arrays["torque_breaks"]
    if len(breaks) < 2 or (np.diff(breaks) <= 0).any():
        raise InputError(source, "torque_breaks", "must be two or more, and increase")
    if len(arrays["torque_coefficients"]) != len(breaks) - 1:
        given, needed = len(arrays["torque_coefficients"]), len(breaks) - 1
        raise InputError(source, "torque_coefficients", f"{given} pieces given, {needed} needed")
