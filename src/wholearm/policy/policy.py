"""Torques as a function of joint angles and speeds, phase by phase, for a control loop at 1 kHz."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from ..common.archive import read_arrays
from ..common.errors import InputError
from ..common.files import require_ending, write_whole
from ..common.require import require_number
from .curve_law import CurveLaw, Pace

FORMAT = 1
"""Version of the files."""
TABLES = {
    "s": (-1,), "theta": (-1, 2), "b": (-1,), "levels": (-1, 2, -1, 5), "torque": (-1, 2, 2, 5),
    "push": (2,),
}  # fmt: skip
"""Arrays of a phase and their shapes; -1 is any."""


class Policy:
    """Torques as a function of what a hand can measure.

    Parameters
    ----------
    phases : sequence of mapping
        Tables of each phase; see `CurveLaw`.
    pace : Pace
    about : mapping, optional
        What the policy is of: name of the problem, duration, contacts that end phases.

    Attributes
    ----------
    phase : int
        Number of the present phase, from 1.
    laws : tuple of CurveLaw

    Notes
    -----
    Call `step` once in a period, as soon as angles and speeds are measured; its torques are right
    if they hold from `pace.delay` later until the next ones do. It takes some 30 us, allocates
    little, and uses neither CasADi nor arrays. One policy carries out one motion at a time::

        policy = Policy.load("policy.npz")
        policy.reset()
        while True:
            set_torques(*policy.step(read_angles(), read_speeds()))
            wait_for_next_period()

    It goes on from phase to phase by what the joints do, and in the end holds its last torques.
    """

    def __init__(
        self,
        phases: Sequence[Mapping[str, Any]],
        pace: Pace,
        about: Mapping[str, Any] | None = None,
    ) -> None:
        self.tables, self.pace, self.about = tuple(phases), pace, dict(about or {})
        self.laws = tuple(CurveLaw(tables, pace) for tables in self.tables)
        self.reset()

    @property
    def duration(self) -> float:
        """How long the motion takes where nothing is off [s]."""
        return float(self.about.get("duration", 0.0))

    def reset(self, phase: int = 1) -> None:
        """Begin anew with the phase of a number, at rest.

        What is before the first phase has no torques. Before another one the contact that it
        starts with is closed, as at the end of the phase before.

        Raises
        ------
        InputError
            If there is no such phase.
        """
        if not 1 <= phase <= len(self.laws):
            allowed = f"the policy has phases 1 to {len(self.laws)}"
            raise InputError("", "phase", f"{phase} given; {allowed}")
        self.phase = max(phase - 1, 1)
        self.laws[self.phase - 1].begin(at_end=phase > 1)

    def step(
        self,
        theta: Sequence[float],
        theta_dot: Sequence[float],
        forces: Mapping[str, float] | None = None,
    ) -> tuple[float, float]:
        """Torques for what is measured now [N m].

        Parameters
        ----------
        theta, theta_dot : sequence of two float, [rad, rad/s]
            Of finger 1, the right one, and finger 2.
        forces : mapping of str to float, optional
            Normal forces by name of the contact, as far as they are measured [N].
        """
        law = self.laws[self.phase - 1]
        tau = law.step(theta, theta_dot, forces)
        if law.over and self.phase < len(self.laws):
            self.phase += 1
            law = self.laws[self.phase - 1]
            law.begin()
            tau = law.step(theta, theta_dot, forces)
        return tau

    def with_(self, **changes: Any) -> Policy:
        """The policy with another `period`, `delay` or other values of `Pace`."""
        return Policy(self.tables, self.pace._replace(**changes), self.about)

    def cut(self, last: int) -> Policy:
        """The policy of the phases up to the `last`."""
        return Policy(self.tables[:last], self.pace, self.about)

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the policy to a ``.npz`` file.

        Raises
        ------
        InputError
            If the file has another ending or cannot be written.
        """
        require_ending(path, ".npz")
        meta = {"policy": FORMAT, "phases": len(self.tables), "pace": self.pace._asdict()}
        arrays = {
            f"{name}_{number}": tables[name]
            for number, tables in enumerate(self.tables, start=1)
            for name in TABLES
        }
        arrays["meta"] = np.array(json.dumps({**meta, "about": self.about}))
        write_whole(path, lambda stream: np.savez(stream, **arrays))

    @staticmethod
    def load(path: str | os.PathLike[str]) -> Policy:
        """Read a policy.

        Raises
        ------
        InputError
            If the file cannot be read or is no policy.
        """
        source = str(path)
        meta = _read_meta(source, read_arrays(path, ["meta"]))
        numbers = range(1, meta["phases"] + 1)
        names = [f"{name}_{number}" for number in numbers for name in TABLES]
        arrays = read_arrays(path, names)
        phases = [_pick(source, arrays, number) for number in numbers]
        return Policy(phases, Pace(**meta["pace"]), meta.get("about", {}))


def _read_meta(source: str, arrays: Mapping[str, Any]) -> dict[str, Any]:
    try:
        meta = json.loads(str(arrays["meta"]))
        known = meta["policy"] == FORMAT and set(meta["pace"]) == set(Pace._fields)
        known = known and isinstance(meta["phases"], int) and 1 <= meta["phases"] <= 1000
        known = known and isinstance(meta.get("about", {}), dict)
    except (KeyError, TypeError, ValueError, RecursionError):
        known = False
    if not known:
        raise InputError(source, "meta", "is not that of a policy; `wholearm policy` writes them")
    pace = meta["pace"]
    try:
        one, two = pace.pop("limit")
        for key in pace:
            pace[key] = require_number(pace[key], key, nonnegative=True)
        pace["limit"] = (
            require_number(one, "limit", positive=True),
            require_number(two, "limit", positive=True),
        )
        require_number(pace["period"], "period", positive=True)
    except (TypeError, ValueError):
        raise InputError(source, "meta.pace.limit", "is not two numbers") from None
    except InputError as error:
        raise InputError(source, f"meta.pace.{error.key}", error.problem) from None
    return dict(meta)


def _pick(source: str, arrays: Mapping[str, Any], number: int) -> dict[str, Any]:
    """Tables of a phase, checked."""
    found = {}
    for name, shape in TABLES.items():
        key = f"{name}_{number}"
        if key not in arrays:
            raise InputError(source, key, "array is missing")
        array = arrays[key]
        fits = array.dtype.kind == "f" and array.ndim == len(shape) and np.isfinite(array).all()
        if not fits or any(w not in (-1, n) for w, n in zip(shape, array.shape, strict=True)):
            needed = ", ".join("any" if n < 0 else str(n) for n in shape)
            text = f"{array.dtype} of shape {array.shape} given, numbers of shape ({needed}) needed"
            raise InputError(source, key, text)
        found[name] = array
    count = len(found["s"])
    lengths = [len(found[name]) for name in ("theta", "b", "levels", "torque")]
    if count < 2 or lengths != [count, count, count - 1, count - 1]:
        raise InputError(source, f"s_{number}", "has not as many places as the other arrays")
    if not (np.diff(found["s"]) > 0).all():
        raise InputError(source, f"s_{number}", "does not increase")
    return found
