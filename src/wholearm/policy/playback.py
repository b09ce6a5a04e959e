"""Torques as a function of joint angles and speeds, phase by phase, for a control loop at 1 kHz."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping, Sequence
from itertools import pairwise
from typing import Any

import numpy as np

from ..common.document import Document, Result, Table
from ..common.errors import InputError, require_number
from ..common.files import read_arrays, require_ending, write_whole
from .curve_law import CurveLaw, LoopSettings, MotionLaw, Sensing

FORMAT = 1  # Version of the files
CURVE = {
    "s": (-1,), "theta": (-1, 2), "b": (-1,), "levels": (-1, 2, -1, 5), "torque": (-1, 2, 2, 5),
    "push": (2,), "passes": (1,), "arrival": (-1, 5), "forces": (-1, 2, -1, 5),
    "keeps": (1,),
}  # fmt: skip
"""Arrays of a phase along a curve and their shapes; -1 is any."""
MOTION = {
    "starts": (-1,), "step": (1,), "theta": (-1, 2), "rates": (-1, 2), "tau": (-1, 2),
    "gain": (-1, 2, 4), "push": (2,), "still": (1,), "ways": (-1, 2),
}  # fmt: skip
"""Arrays of phases that are followed over time."""
LATER = ("arrival", "ways", "forces", "keeps")
"""Arrays that earlier versions did not write; empty ones stand for them."""
KINDS: Mapping[str, Mapping[str, tuple[int, ...]]] = {"curve": CURVE, "motion": MOTION}
Law = CurveLaw | MotionLaw


class Policy(Result):
    """Torques as a function of what a hand can measure.

    Parameters
    ----------
    tables  of each law; see `CurveLaw` and `MotionLaw`
    about   what the policy is of: name of the problem, duration, contacts that end phases
    laws    how many of the laws are carried out; all if left out. One more says how the end is
            held.
    sensor  whether simulations hand it normal forces

    Attributes
    ----------
    laws  one for each phase, or for phases that pass into one another in motion

    Notes
    -----
    Call `step` once in a period, as soon as angles and speeds are measured; its torques are right
    if they hold from `curve_law.delay` later until the next ones do. It takes some 20 us, allocates
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
        tables: Sequence[Mapping[str, Any]],
        pace: LoopSettings,
        about: Mapping[str, Any] | None = None,
        laws: int | None = None,
        sensor: bool = False,
    ) -> None:
        self.tables, self.pace, self.about = tuple(tables), pace, dict(about or {})
        self.laws = tuple(
            CurveLaw(own, pace) if "s" in own else MotionLaw(own, pace) for own in self.tables
        )
        for law, after in pairwise(self.laws):
            if isinstance(law, CurveLaw) and isinstance(after, CurveLaw):
                law.lead_to(after)
        self.sensor = sensor
        self.last = len(self.laws) - 1 if laws is None else laws - 1
        counts = [law.count for law in self.laws[: self.last + 1]]
        self.firsts = [1 + sum(counts[:k]) for k in range(len(counts))]
        self.contacts = self._listen()
        self.reset()

    def _listen(self) -> list[str]:
        """Let laws use measured forces as far as it is known of which contacts; names of these."""
        found = dict[str, None]()
        phases = self.about.get("phases", [])
        for own, law, first in zip(self.tables, self.laws, self.firsts, strict=False):
            table, about = own.get("forces"), phases[first - 1] if first <= len(phases) else {}
            names, gained = list(about.get("reserves", {})), about.get("gained", "")
            if isinstance(law, CurveLaw) and table is not None and len(names) == table.shape[2]:
                late = self.pace.delay / self.pace.period
                law.sensing = Sensing(names, gained, table, late)
                found.update(dict.fromkeys([*names, gained] if gained else names))
        return list(found)

    @property
    def headline(self) -> str:
        """Name, phases and duration, in a line."""
        return f"{self.about.get('name', '')!r}, {self.count} phases, {self.duration:.6g} s"

    @property
    def document(self) -> Document:
        """How long the phases take, what reserve they keep, and within which ranges."""
        phases, rows, lines = self.about.get("phases", []), [], []
        for own in phases:
            kept = [f"{level:.2f} {name}" for name, level in own.get("reserves", {}).items()]
            share = own["share"] if kept else ""
            rows.append([own["number"], own["plan"], own["duration"], share, ", ".join(kept)])
        heads = ["phase:d", "plan [s]:.6f", "policy [s]:.6f", "reserve:.2f"]
        parts = {own["number"]: own["share"] for own in phases if "reserves" in own}
        if "ranges" in self.about and parts:
            text = f"contacts are kept within {self.about['reserve']:g} times the plan's ranges"
            short = [f"{part:.2f} of them in phase {k}" for k, part in parts.items() if part < 1]
            lines.append(", ".join([text, *short]))
        if largest := self.about.get("largest"):
            text = f"a policy exists for ranges {min(largest.values()):.3g} times as wide as the "
            factors = ", ".join(f"{factor:.3g}" for factor in largest.values())
            lines.append(f"{text}plan's (by phase: {factors})")
        return Document("", parts=[Table([*heads, "least of each contact"], rows), *lines])

    @property
    def values(self) -> dict[str, Any]:
        """What the policy is of, but for the problem, as plain values."""
        return {key: value for key, value in self.about.items() if key != "problem"}

    @property
    def count(self) -> int:
        """Number of phases."""
        return sum(law.count for law in self.laws[: self.last + 1])

    @property
    def phase(self) -> int:
        """Number of the present phase, from 1."""
        return self.firsts[self.index] + self.laws[self.index].passed

    @property
    def duration(self) -> float:
        """How long the motion takes where nothing is off [s]."""
        return float(self.about.get("duration", 0.0))

    @property
    def resting(self) -> list[int]:
        """Numbers of the phases that begin at rest."""
        pairs = zip(self.firsts[1:], self.laws, strict=False)
        return [1, *(first for first, before in pairs if not before.passes)]

    def reset(self, phase: int = 1) -> None:
        """Begin anew with the phase of a number, at rest.

        What is before the first phase has no torques. Before another one the contact that it
        starts with is closed, as at the end of the phase before, unless that comes by an impact.

        Raises
        ------
        InputError  if there is no such phase, or the one before passes into it in motion
        """
        if phase not in self.firsts:
            allowed = f"allowed are {', '.join(map(str, self.firsts))}"
            raise InputError("", "phase", f"{phase} given; the policy can begin with: {allowed}")
        own = self.firsts.index(phase)
        closes = own > 0 and not self.laws[own - 1].passes
        self.index = own - closes
        self.laws[self.index].begin(at_end=closes)

    def step(
        self,
        theta: Sequence[float],
        theta_dot: Sequence[float],
        forces: Mapping[str, float] | None = None,
    ) -> tuple[float, float]:
        """Torques for what is measured now [N m].

        Parameters
        ----------
        theta, theta_dot : [rad, rad/s]  of finger 1, the right one, and finger 2
        forces  normal forces when angles and speeds are measured [N], by names of contacts as in
                plans (`v3-finger1`); those that do not touch have 0, those without a sensor are
                left out or are NaN. With them squeezes follow what contacts along curves press
                with, and phases end when their gained contact presses.
        """
        law = self.laws[self.index]
        tau = law.step(theta, theta_dot, forces)
        if law.over and self.index < self.last:
            self.index += 1
            law = self.laws[self.index]
            law.begin()
            tau = law.step(theta, theta_dot, forces)
        return tau

    def with_(self, **changes: Any) -> Policy:
        """The policy with another `period`, `delay` or other values of `LoopSettings`."""
        pace = self.pace._replace(**changes)
        return Policy(self.tables, pace, self.about, self.last + 1, self.sensor)

    def with_sensor(self, sensor: bool = True) -> Policy:
        """The policy with a sensor of normal forces in simulations, or without."""
        return Policy(self.tables, self.pace, self.about, self.last + 1, sensor)

    def cut(self, last: int) -> Policy:
        """The policy of the phases up to the `last`, with those that it passes into in motion."""
        kept = sum(first <= last for first in self.firsts)
        return Policy(self.tables, self.pace, self.about, kept, self.sensor)

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the policy to a ``.npz`` file.

        Raises
        ------
        InputError  if the file has another ending or cannot be written
        """
        require_ending(path, ".npz")
        kinds = ["curve" if "s" in own else "motion" for own in self.tables]
        meta = {"policy": FORMAT, "kinds": kinds, "pace": self.pace._asdict()}
        arrays = {
            f"{name}_{number}": tables[name]
            for number, (kind, tables) in enumerate(zip(kinds, self.tables, strict=True), start=1)
            for name in KINDS[kind]
        }
        arrays["meta"] = np.array(json.dumps({**meta, "about": self.about}))
        write_whole(path, lambda stream: np.savez(stream, **arrays))

    @staticmethod
    def load(path: str | os.PathLike[str]) -> Policy:
        """Read a policy.

        Raises
        ------
        InputError  if the file cannot be read or is no policy
        """
        source = str(path)
        meta = _read_meta(source, read_arrays(path, ["meta"]))
        kinds = list(enumerate(meta["kinds"], start=1))
        names = [f"{name}_{number}" for number, kind in kinds for name in KINDS[kind]]
        arrays = read_arrays(path, names)
        tables = [_pick(source, arrays, number, KINDS[kind]) for number, kind in kinds]
        return Policy(tables, LoopSettings(**meta["pace"]), meta.get("about", {}))


def _read_meta(source: str, arrays: Mapping[str, Any]) -> dict[str, Any]:
    try:
        meta = json.loads(str(arrays["meta"]))
        known = meta["policy"] == FORMAT and set(meta["pace"]) == set(LoopSettings._fields)
        known = known and isinstance(meta["kinds"], list) and set(meta["kinds"]) <= set(KINDS)
        known = known and 1 <= len(meta["kinds"]) <= 1000
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


def _pick(
    source: str, arrays: Mapping[str, Any], number: int, shapes: Mapping[str, tuple[int, ...]]
) -> dict[str, Any]:
    """Tables of a law, checked."""
    found = {}
    for name, shape in shapes.items():
        key = f"{name}_{number}"
        if key not in arrays and name in LATER:
            found[name] = np.zeros([max(n, 0) for n in shape])
            continue
        if key not in arrays:
            raise InputError(source, key, "array is missing")
        array = arrays[key]
        fits = array.dtype.kind == "f" and array.ndim == len(shape) and np.isfinite(array).all()
        if not fits or any(w not in (-1, n) for w, n in zip(shape, array.shape, strict=True)):
            needed = ", ".join("any" if n < 0 else str(n) for n in shape)
            text = f"{array.dtype} of shape {array.shape} given, numbers of shape ({needed}) needed"
            raise InputError(source, key, text)
        found[name] = array
    _check_lengths(source, number, found)
    return found


def _check_lengths(source: str, number: int, tables: Mapping[str, Any]) -> None:
    """Check that a law's tables have as many places as one another, in order."""
    axis, spans = ("s", ("levels", "torque")) if "s" in tables else ("starts", ())
    others = ("theta", "b") if "s" in tables else ("theta", "rates", "tau", "gain")
    count = len(tables[others[0]])
    lengths = [len(tables[name]) for name in others] + [len(tables[name]) + 1 for name in spans]
    lengths += [len(tables["forces"]) + 1] if spans and len(tables["forces"]) else []
    if count < 2 or set(lengths) != {count} or (spans and len(tables["s"]) != count):
        raise InputError(source, f"{others[0]}_{number}", "has not as many places as other arrays")
    if not (np.diff(tables[axis]) > 0).all() or not len(tables[axis]):
        raise InputError(source, f"{axis}_{number}", "does not increase")
    if not spans and tables["step"][0] <= 0:
        raise InputError(source, f"step_{number}", "is not positive")
