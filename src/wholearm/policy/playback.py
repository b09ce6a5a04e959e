"""Policies: torques as a function of joint angles and speeds, for a control loop at 1 kHz."""

from __future__ import annotations

import json
import math
import os
from collections.abc import Mapping, Sequence
from itertools import chain
from typing import Any

import numpy as np

from ..common.arrays import Array
from ..common.document import Document, Result, Table
from ..common.errors import InputError, name_source, require_number, require_vector
from ..common.files import read_arrays, require_ending, write_whole
from .curve_law import CurveLaw, ForceFilter, Law, LoopSettings, TimeLaw

FORMAT = 1  # Version of the files
KINDS: Mapping[str, Mapping[str, tuple[int | str, ...]]] = {
    "curve": {
        "s": ("n",), "theta": ("n", 2), "b": ("n",), "levels": ("n - 1", 2, "any", 5),
        "torque": ("n - 1", 2, 2, 5), "push": (2,), "passes": (1,),
        "forces": ("n - 1", 2, "any", 5), "keeps": (1,), "starts": ("any",),
    },
    "motion": {
        "starts": ("any",), "step": (1,), "theta": ("n", 2), "rates": ("n", 2), "tau": ("n", 2),
        "gain": ("n", 2, 4), "push": (2,), "still": (1,), "ways": ("any", 2), "approach": (2,),
    },
}  # fmt: skip
"""Arrays of laws along a curve and over time, and their shapes; n is the number of places."""


class Policy(Result):
    """Joint torques as a function of joint angles, speeds and, where measured, normal forces.

    Parameters
    ----------
    tables  arrays of each law; see `CurveLaw` and `TimeLaw`
    about   name of the problem, duration, phases
    laws    number of laws that are carried out, by default all; the next one holds the end
    sensor  whether simulations provide normal forces

    Attributes
    ----------
    laws  one for each phase, or for phases that pass into one another in motion

    Notes
    -----
    Call `step` once per period, right after measuring. Apply its torques `delay` later, for one
    period. It takes some 20 us, allocates little, and uses neither CasADi nor arrays. One policy
    carries out one motion at a time::

        policy = Policy.load("policy.npz")
        policy.reset()
        while True:
            set_torques(*policy.step(read_angles(), read_speeds()))
            wait_for_next_period()

    It switches phases by the motion of the joints. At the end it holds the last torques.
    """

    def __init__(
        self,
        tables: Sequence[Mapping[str, Any]],
        settings: LoopSettings,
        about: Mapping[str, Any] | None = None,
        laws: int | None = None,
        sensor: bool = False,
    ) -> None:
        self.tables, self.settings, self.about = tuple(tables), settings, dict(about or {})
        self.laws = list[Law]()
        for arrays in reversed(self.tables):
            kind = CurveLaw if "s" in arrays else TimeLaw
            self.laws.insert(0, kind(arrays, settings, self.laws[0] if self.laws else None))
        self.sensor = sensor
        self.last = len(self.laws) - 1 if laws is None else laws - 1
        counts = [len(law.starts) for law in self.laws[: self.last + 1]]
        self.firsts = [1 + sum(counts[:k]) for k in range(len(counts))]
        # Laws along curves with known contacts use measured forces.
        contacts = dict[str, None]()
        phases = self.about.get("phases", [])
        for arrays, law, first in zip(self.tables, self.laws, self.firsts, strict=False):
            entries = phases[first - 1 : first - 1 + len(law.starts)]
            names = [list(entry.get("reserves", {})) for entry in entries]
            sizes = {len(contact_names) for contact_names in names}
            if isinstance(law, CurveLaw) and sizes == {arrays["forces"].shape[2]}:
                delay, gained = self.settings.delay / self.settings.period, entries[-1]["gained"]
                law.filter = ForceFilter(names, gained, arrays["forces"], delay)
                contacts.update(dict.fromkeys(chain(*names, [gained] if gained else [])))
        self.contacts = list(contacts)
        self.reset()

    @property
    def headline(self) -> str:
        """Name, phases and duration, in a line."""
        return f"{self.about.get('name', '')!r}, {self.count} phases, {self.duration:.6g} s"

    @property
    def document(self) -> Document:
        """Durations of phases, their robustness margins and ranges."""
        phases, rows, lines = self.about.get("phases", []), [], []
        for phase in phases:
            # Errors of a phase of microseconds, and with them the margin, may be tiny.
            reserves = phase.get("reserves", {}).items()
            kept = [
                f"{level:.2f} {name}" if level > -10 else f"<-10 {name}" for name, level in reserves
            ]
            share = phase["share"] if kept else ""
            rows.append([phase["number"], phase["plan"], phase["duration"], share, ", ".join(kept)])
        heads = ["phase:d", "plan [s]:.6f", "policy [s]:.6f", "reserve:.2f"]
        parts = {phase["number"]: phase["share"] for phase in phases if "reserves" in phase}
        if "ranges" in self.about and parts:
            text = f"contacts are kept within {self.about['reserve']:g} times the plan's ranges"
            short = [f"{part:.2f} of them in phase {k}" for k, part in parts.items() if part < 1]
            lines.append(", ".join([text, *short]))
        if largest := self.about.get("largest"):
            text = f"a policy exists for ranges {min(largest.values()):.3g} times as wide as the "
            factors = ", ".join(f"{factor:.3g}" for factor in largest.values())
            lines.append(f"{text}plan's (by phase: {factors})")
        lines += self.about.get("warnings", [])
        return Document("", parts=[Table([*heads, "least reserve of each contact"], rows), *lines])

    @property
    def values(self) -> dict[str, Any]:
        """The entries of `about` without the problem."""
        return {key: value for key, value in self.about.items() if key != "problem"}

    @property
    def count(self) -> int:
        """Number of phases."""
        return sum(len(law.starts) for law in self.laws[: self.last + 1])

    def require_count(self, count: int, of: str) -> None:
        """InputError if its number of phases is not `count`, that of a problem or plan (`of`)."""
        if self.count != count:
            text = f"{self.count} given; the {of} has {count}"
            raise InputError("", "phases of the policy", text)

    @property
    def phase(self) -> int:
        """Number of the present phase, from 1."""
        return self.firsts[self.index] + self.laws[self.index].passed

    @property
    def duration(self) -> float:
        """Nominal duration [s]."""
        return float(self.about.get("duration", 0.0))

    @property
    def resting(self) -> list[int]:
        """Numbers of the phases that begin at rest, in the plan as well."""
        stops = {entry["number"] for entry in self.about.get("phases", []) if entry.get("stops")}
        pairs = zip(self.firsts[1:], self.laws, strict=False)
        return [1, *(k for k, before in pairs if not before.passes and k - 1 not in stops)]

    def reset(self, phase: int = 1) -> None:
        """Restart at a phase, at rest.

        Unless an impact leads into it, a later phase starts with the end of the one before, at
        which the contact is closed.

        InputError if there is no such phase, or the one before passes into it in motion.
        """
        if phase not in self.firsts:
            allowed = f"allowed are {', '.join(map(str, self.firsts))}"
            raise InputError("", "phase", f"{phase} given; the policy can begin with: {allowed}")
        index = self.firsts.index(phase)
        closes = index > 0 and not self.laws[index - 1].passes
        self.index = index - closes
        self.laws[self.index].begin(at_end=closes)

    def step(
        self,
        theta: Sequence[float],
        theta_dot: Sequence[float],
        forces: Mapping[str, float] | None = None,
    ) -> tuple[float, float]:
        """Torques for the present measurement [N m].

        Parameters
        ----------
        theta, theta_dot : [rad, rad/s]  of finger 1, the right one, and finger 2
        forces  measured normal forces [N] by names of contacts (`v3-finger1`): 0 of open ones,
                missing or NaN without a sensor. They correct internal forces along curves and show
                gained contacts.

        InputError, and no change of the policy, if an angle or a speed is not finite.
        """
        for name, values in (("theta", theta), ("theta_dot", theta_dot)):
            if len(values) != 2 or not all(map(math.isfinite, values)):
                text = ", ".join(f"{value:g}" for value in values)
                raise InputError("", name, f"{text} given; two finite numbers are needed")
        law = self.laws[self.index]
        tau = law.step(theta, theta_dot, forces)
        if law.finished and self.index < self.last:
            self.index += 1
            law = self.laws[self.index]
            law.begin()
            tau = law.step(theta, theta_dot, forces)
        return tau

    def with_(self, **changes: Any) -> Policy:
        """The policy with another `period`, `delay` or other values of `LoopSettings`."""
        settings = self.settings._replace(**changes)
        return Policy(self.tables, settings, self.about, self.last + 1, self.sensor)

    def with_sensor(self, sensor: bool = True) -> Policy:
        """The policy with a sensor of normal forces in simulations, or without."""
        return Policy(self.tables, self.settings, self.about, self.last + 1, sensor)

    def cut(self, last: int) -> Policy:
        """The policy of the phases up to the `last`, with those that it passes into in motion."""
        count = sum(first <= last for first in self.firsts)
        return Policy(self.tables, self.settings, self.about, count, self.sensor)

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the policy to a ``.npz`` file.

        InputError if the file has another ending or cannot be written.
        """
        require_ending(path, ".npz")
        kinds = ["curve" if "s" in arrays else "motion" for arrays in self.tables]
        meta = {"policy": FORMAT, "kinds": kinds, "pace": self.settings._asdict()}
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

        InputError if the file cannot be read or is no policy.
        """
        with name_source(str(path)):
            meta = _read_meta(read_arrays(path, ["meta"]))
            kinds = list(enumerate(meta["kinds"], start=1))
            names = [f"{name}_{number}" for number, kind in kinds for name in KINDS[kind]]
            arrays = read_arrays(path, names)
            tables = [_read_tables(arrays, number, KINDS[kind]) for number, kind in kinds]
        return Policy(tables, meta["pace"], meta.get("about", {}))


def _read_meta(arrays: Mapping[str, Any]) -> dict[str, Any]:
    try:
        meta = dict(json.loads(str(arrays["meta"])))
        pace, kinds = meta["pace"], meta["kinds"]
        valid = meta["policy"] == FORMAT and set(pace) == set(LoopSettings._fields)
        valid = valid and isinstance(kinds, list) and set(kinds) <= set(KINDS)
        valid = valid and 1 <= len(kinds) <= 1000 and isinstance(meta.get("about", {}), dict)
    except (KeyError, TypeError, ValueError, RecursionError):
        valid = False
    if not valid:
        raise InputError("", "meta", "is not that of a policy; `wholearm policy` writes them")
    with name_source(prefix="meta.pace."):
        limit1, limit2 = require_vector(pace.pop("limit"), "limit", 2).tolist()
        pace = {key: require_number(value, key, nonnegative=True) for key, value in pace.items()}
        for key, value in (("limit", min(limit1, limit2)), ("period", pace["period"])):
            require_number(value, key, positive=True)
    return meta | {"pace": LoopSettings(**pace, limit=(limit1, limit2))}


def _read_tables(
    arrays: Mapping[str, Any], number: int, shapes: Mapping[str, tuple[int | str, ...]]
) -> dict[str, Any]:
    """Checked tables of a law."""
    tables, count = dict[str, Any](), len(np.atleast_1d(arrays.get(f"theta_{number}", 0.0)))
    sizes: dict[int | str, int] = {"n": count, "n - 1": count - 1}
    for name, shape in shapes.items():
        key, expected = f"{name}_{number}", [sizes.get(n, n) for n in shape]
        if key not in arrays:
            raise InputError("", key, "array is missing")
        array = tables[name] = arrays[key]
        fits = array.dtype.kind == "f" and array.ndim == len(shape)
        if not fits or any(w not in (n, "any") for w, n in zip(expected, array.shape, strict=True)):
            text = f"{array.dtype} of shape {array.shape} given, numbers of shape "
            raise InputError("", key, f"{text}({', '.join(map(str, expected))}) needed")
        if not np.isfinite(array).all():
            raise InputError("", key, "holds numbers that are not finite")
    if count < 2:
        raise InputError("", f"theta_{number}", "has less than two places")
    axis = "s" if "s" in tables else "starts"
    if not (np.diff(tables[axis]) > 0).all() or not len(tables[axis]):
        raise InputError("", f"{axis}_{number}", "does not increase")
    if "step" in tables and tables["step"][0] <= 0:
        raise InputError("", f"step_{number}", "is not positive")
    return tables


class ClosedLoop:
    """Feedback of a simulation; a `simulation.run.Law`.

    Parameters
    ----------
    policy       copied, so that several loops may run
    phase        number of the phase to begin with
    delay : [s]  of the torques; the policy's if left out
    gains        applied torques over those of the policy

    Attributes
    ----------
    began  when each phase began, by its number [s]
    """

    def __init__(
        self,
        policy: Policy,
        phase: int = 1,
        delay: float | None = None,
        gains: tuple[float, float] = (1.0, 1.0),
    ) -> None:
        self.policy, self.gains, self.first = policy.with_(), gains, phase
        self.period = policy.settings.period
        self.delay = policy.settings.delay if delay is None else delay
        self.phase_starts: dict[int, float] = {}
        self.policy.reset(phase)

    @property
    def over(self) -> bool:
        """Whether the last phase is over."""
        last = self.policy.last
        return self.policy.index == last and self.policy.laws[last].finished

    def find_limit(self, last: int) -> float:
        """Time limit of a simulation of the phases up to `last` [s]: twice their duration."""
        phases = self.policy.about["phases"][self.first - 1 : last]
        return 2 * (0.05 + sum(float(phase["duration"]) for phase in phases))

    def held(
        self, t: float, theta: Array, theta_dot: Array, forces: Mapping[str, float]
    ) -> tuple[float, float]:
        """Torques for a state [N m]; method of `simulation.run.Law`."""
        measured: dict[str, float] | None = None
        if self.policy.sensor and t > 0.0:
            measured = {name: forces.get(name, 0.0) for name in self.policy.contacts}
        torque1, torque2 = self.policy.step(theta.tolist(), theta_dot.tolist(), measured)
        # A phase may be shorter than a period.
        for number in range(self.first + len(self.phase_starts), self.policy.phase + 1):
            self.phase_starts[number] = t
        return torque1 * self.gains[0], torque2 * self.gains[1]
