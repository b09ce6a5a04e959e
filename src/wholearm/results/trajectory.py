"""A motion with its forces, planned or replayed, at any instant."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import compress
from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import ArrayLike

from ..common.arrays import Array, Flags, Numbers, sort_unique
from ..common.document import Drawn, restore
from ..common.errors import InputError, name_source, require_array
from ..common.files import read_arrays, require_ending, write_text, write_whole
from .torque import MAX_NUMBER, TorqueProfile, format_rows, place_rows

ROLLS = "rolls"  # mode of a contact that rolls; one that slides has the sign of its direction
_PARTS = slice(3), slice(3, 5)  # of z: q and theta


class ModeSpan(NamedTuple):
    """A stretch of a phase in which every contact keeps its mode."""

    start: float  # start, stop [s]: from the start of the phase
    stop: float
    contacts: Mapping[str, str]  # ``"+"``, ``"-"`` or ``"rolls"`` by the name of the contact
    joints: tuple[str, ...]  # direction of each joint, ``"+"`` or ``"-"``


class Samples(NamedTuple):
    """A motion at n instants, on one contact formation."""

    z: Array  # z, z_dot, z_ddot (n, 5): degrees of freedom (q, theta) and their derivatives
    z_dot: Array
    z_ddot: Array
    tau: Array  # (n, 2) [N m]
    c_n: Array  # c_n, c_t (n, n_c) [N]: in the order of the formation's contacts
    c_t: Array

    def expand(self, names: Sequence[str], contacts: Sequence[str]) -> Samples:
        """The forces of `names` contacts in the columns of all `contacts`, NaN in the others."""
        forces = np.full((2, len(self.z), len(contacts)), np.nan)
        forces[:, :, [contacts.index(name) for name in names]] = self.c_n, self.c_t
        return Samples(*self[:4], *forces)


class Motion(Protocol):
    """One phase of a trajectory as a function of time."""

    @property
    def duration(self) -> float:
        """Duration of the phase [s]."""

    @property
    def contacts(self) -> tuple[str, ...]:
        """Names of the phase's contacts."""

    def evaluate(self, t: Array) -> Samples:
        """Samples at times `t` from the start of the phase, shape (n,) [s]."""


class _Columns:
    """Some columns of an array of a trajectory."""

    def __init__(self, name: str, columns: slice) -> None:
        self.name, self.columns = name, columns

    def __get__(self, owner: Trajectory, _: type) -> Array:
        return np.asarray(getattr(owner, self.name)[:, self.columns])


@dataclass(frozen=True, eq=False, repr=False)
class Trajectory(Drawn):
    """A planned motion: samples for files and plots, motions for any instant."""

    # (n,) [s]: even in each phase of a plan; a time is repeated where torques and forces step:
    # between phases, at the start of a dwell, between held torques, and anywhere in a replay
    t: Array
    z: Array  # z, z_dot, z_ddot (n, 5): degrees of freedom (q, theta) and their derivatives
    z_dot: Array
    z_ddot: Array
    tau: Array  # (n, 2) [N m]
    contacts: tuple[str, ...]  # every contact of the plan
    # (n, m) [N]: NaN if a contact is not in the formation, and at rest, where it is indeterminate
    c_n: Array
    c_t: Array
    phase: Numbers  # (n,): index of the phase, from 0
    torque: TorqueProfile  # exact between samples, with every step at a break
    # one per phase. Planned ones satisfy the equations of motion at any instant, those of a loaded
    # plan with interpolated z and z'; all others interpolate the samples.
    motions: tuple[Motion, ...]
    meta: Mapping[str, Any]  # status, epsilon, the problem, and all further values of a plan

    # q: pose of the centroid, (n, 3) [m, m, rad]; theta: joint angles, (n, 2) [rad]
    q, theta = (_Columns("z", part) for part in _PARTS)
    q_dot, theta_dot = (_Columns("z_dot", part) for part in _PARTS)
    q_ddot, theta_ddot = (_Columns("z_ddot", part) for part in _PARTS)

    @property
    def headline(self) -> str:
        """Phases and duration, in a line."""
        count = len(self.motions)
        return f"{count} phase{'s' if count > 1 else ''}, {self.duration:.6g} s"

    @property
    def duration(self) -> float:
        """Duration of the motion [s]."""
        return float(self.t[-1])

    @property
    def phase_starts(self) -> Array:
        """Start of each phase, and end of the last one, shape (n_phases + 1,) [s]."""
        first = np.flatnonzero(np.diff(self.phase, prepend=-1))
        return np.append(self.t[first], self.t[-1])

    @property
    def held(self) -> Flags:
        """Whether rows are at rest, without known forces, shape (n,)."""
        return np.asarray(np.isnan(self.c_n).all(axis=1))

    @property
    def rolling(self) -> Flags:
        """Whether contacts roll, shape (n, m), by the phases and modes in `meta`."""
        mask, starts = np.zeros(self.c_t.shape, dtype=bool), self.phase_starts
        for index, names in enumerate(self.meta.get("rolling", [])):
            mask[self.phase == index] = [name in names for name in self.contacts]
        for index, modes in enumerate(self.meta.get("modes", [])):
            for mode in modes:
                elapsed = np.where(self.phase == index, self.t - starts[index], np.nan)
                rows = (elapsed >= mode["start"]) & (elapsed <= mode["stop"])
                mask[rows] |= [mode["contacts"].get(name) == "rolls" for name in self.contacts]
        return mask

    @property
    def least_forces(self) -> list[tuple[float, str]]:
        """The least c_n [N] of each phase and its contact: of a plan's replay, else of the samples.

        NaN and no contact if no forces are known.
        """
        forces = []
        for index in range(len(self.motions)):
            c_n = self.c_n[self.phase == index]
            least = int(np.where(np.isnan(c_n), np.inf, c_n).argmin())
            value = float(c_n.flat[least])
            forces.append((value, self.contacts[least % c_n.shape[1]] if value == value else ""))
        for index, phase in enumerate((self.meta.get("replay") or {}).get("phases", ())):
            if stored := phase.get("least_c_n"):
                forces[index] = stored["value"], stored["contact"]
        return forces

    @property
    def largest_torques(self) -> list[float]:
        """The largest torque of a joint in each phase [N m], at and between samples."""
        breaks = self.torque.breaks
        phase_index = np.searchsorted(self.phase_starts[1:-1], (breaks[1:] + breaks[:-1]) / 2)
        peaks = self.torque.peaks.max(axis=1)
        return [float(peaks[phase_index == index].max()) for index in range(len(self.motions))]

    def at(self, t: ArrayLike) -> Samples:
        """The motion at some times, shape (n,) or a number [s], each field of shape (n, ...).

        At a phase boundary values are those of the later phase. Contacts are all those of the
        trajectory; forces are NaN if a contact is not in the formation.

        InputError if one of the times is outside the trajectory.
        """
        times, starts = require_array(np.atleast_1d(t), "t", -1), self.phase_starts
        inside = (times >= starts[0]) & (times <= starts[-1])
        if not inside.all():
            time = times[~inside][0]
            raise InputError("", "t", f"{time} s is outside the trajectory, 0 to {starts[-1]} s")
        phase_index = np.searchsorted(starts[1:-1], times, side="right")
        widths = 5, 5, 5, 2, len(self.contacts), len(self.contacts)
        fields = Samples(*(np.empty((len(times), width)) for width in widths))
        for index in sorted(set(phase_index.tolist())):
            motion, rows = self.motions[index], phase_index == index
            part = motion.evaluate(times[rows] - starts[index])
            part = part.expand(motion.contacts, self.contacts)
            for table, values in zip(fields, part, strict=True):
                table[rows] = values
        return fields

    def find_steps(self) -> Numbers:
        """Rows before which forces step, shape (k,).

        At a new phase, a step of the torques, and a reversal of sliding. Steps of torques below a
        tenth of the largest are too small for figures. Those of held torques are left out: lines
        are upright there.
        """
        torque, t, held = self.torque, self.t, self.torque.held_steps

        def is_apart(times: Array, others: Array) -> Flags:
            distances = np.abs(times[:, None] - others)
            return np.asarray(distances.min(axis=1, initial=np.inf) > 1e-9 * self.duration)

        stepping = np.abs(torque.jumps).max(axis=1) > 0.1 * np.abs(torque.coefficients).max()
        # At a repeated time the step is between the two rows.
        repeated = np.flatnonzero(np.diff(t) == 0) + 1
        single = torque.breaks[1:-1][stepping]
        single = single[is_apart(single, np.concatenate([self.phase_starts, t[repeated], held]))]
        steps = np.searchsorted(t, single, side="right")
        repeated = repeated[is_apart(t[repeated], held)]
        phases = np.append(np.flatnonzero(np.diff(self.phase)) + 1, repeated)
        # Friction passes zero without a step if a contact rolls, and together with c_n.
        friction = np.where(self.rolling, 0.0, self.c_t * self.c_n)
        reversals = np.flatnonzero((friction[1:] * friction[:-1] < 0).any(axis=1)) + 1
        rows = sort_unique(np.concatenate([steps, phases, reversals]))
        # Torques may extend beyond a motion that has failed.
        return rows[rows < len(t)]

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the trajectory to a ``.npz`` file.

        InputError if the file cannot be written.
        """
        require_ending(path, ".npz")
        arrays: dict[str, Any] = {name: getattr(self, name) for name in _ARRAYS}
        arrays["contacts"] = np.array(self.contacts)
        arrays["torque_breaks"] = self.torque.breaks
        arrays["torque_coefficients"] = self.torque.coefficients
        arrays["meta"] = np.array(json.dumps(dict(self.meta)))
        write_whole(path, lambda stream: np.savez(stream, **arrays))

    def save_torques(self, path: str | os.PathLike[str]) -> None:
        """Write the torques as CSV; see `results.adopt.save`."""
        require_ending(path, ".csv")
        write_text(path, format_rows(place_rows(self.torque)))


@dataclass(frozen=True, eq=False)
class SampledMotion:
    """A phase interpolated between samples: quintic in time for z, linear for forces."""

    t: Array
    contacts: tuple[str, ...]
    samples: Samples
    torque: TorqueProfile  # of the whole trajectory

    @property
    def duration(self) -> float:
        """Duration of the phase [s]."""
        return float(self.t[-1] - self.t[0])

    def evaluate(self, t: Array) -> Samples:
        """Samples at times `t` from the start of the phase, shape (n,) [s]."""
        samples, k = self.samples, self.locate(t)
        h, elapsed = self.t[k + 1] - self.t[k], np.asarray(t) - (self.t[k] - self.t[0])
        z, z_dot, z_ddot = interpolate_quintic(h, elapsed, samples[:3], k)
        x, (first, last) = (elapsed / h)[:, None], self.t[[0, -1]]
        forces = [(1 - x) * f[k] + x * f[k + 1] for f in (samples.c_n, samples.c_t)]
        # Breaks at both ends of the phase have rounding errors.
        rounding = 8 * np.spacing(last)
        tau = self.torque.at(np.clip(first + np.asarray(t), first + rounding, last - rounding))
        return Samples(z, z_dot, z_ddot, tau, *forces)

    def locate(self, t: Array) -> Numbers:
        """The sample before each of the times `t` from the start of the phase."""
        k = np.searchsorted(self.t - self.t[0], t, side="right") - 1
        return np.clip(k, 0, len(self.t) - 2)


def interpolate_quintic(
    h: Array, elapsed: Array, knots: Sequence[Array], left: Numbers
) -> tuple[Array, Array, Array]:
    """Quintic through z, z' and z'' at two knots, with its first two derivatives.

    Parameters
    ----------
    h, elapsed : (n,) [s]  time between the two knots, and since the first of them
    knots : (m, 5)     z, z' and z'' at all knots
    left : (n,)        the first of the two knots
    """
    h, x = h[:, None], (elapsed / h)[:, None]
    z, v, a = knots
    z0, v0, a0 = z[left], h * v[left], h**2 * a[left]
    rise = z[left + 1] - z0 - v0 - a0 / 2
    speed = h * v[left + 1] - v0 - a0
    jump = h**2 * a[left + 1] - a0
    c3 = 10 * rise - 4 * speed + jump / 2
    c4 = -15 * rise + 7 * speed - jump
    c5 = 6 * rise - 3 * speed + jump / 2
    return (
        z0 + x * (v0 + x * (a0 / 2 + x * (c3 + x * (c4 + x * c5)))),
        (v0 + x * (a0 + x * (3 * c3 + x * (4 * c4 + x * 5 * c5)))) / h,
        (a0 + x * (6 * c3 + x * (12 * c4 + x * 20 * c5))) / h**2,
    )


def sample_phases(
    t: Array, phase: Numbers, samples: Samples, contacts: tuple[str, ...], torque: TorqueProfile
) -> tuple[SampledMotion, ...]:
    """The motion of each phase, from all samples of a trajectory."""
    motions = []
    for index in sort_unique(phase):
        rows = phase == index
        parts = [values[rows] for values in samples]
        present = ~np.isnan(parts[4]).all(axis=0)
        part = Samples(*parts[:4], *(forces[:, present] for forces in parts[4:]))
        motions.append(SampledMotion(t[rows], tuple(compress(contacts, present)), part, torque))
    return tuple(motions)


_ARRAYS = {
    "t": (), "q": (3,), "theta": (2,), "q_dot": (3,), "theta_dot": (2,), "q_ddot": (3,),
    "theta_ddot": (2,), "tau": (2,), "c_n": (-1,), "c_t": (-1,), "phase": (),
}  # fmt: skip


def load_trajectory(path: str | os.PathLike[str]) -> Trajectory:
    """Read a trajectory file.

    InputError if the file cannot be read, or an array is missing or of the wrong shape.
    """
    source = str(path)
    if source.lower().endswith(".csv"):
        text = "torques alone given; a motion is needed (.npz), which verify -o FILE.npz writes"
        raise InputError(source, "", text)
    extra = {"contacts": (), "torque_breaks": (), "torque_coefficients": (2, -1)}
    arrays = read_arrays(path, (*_ARRAYS, *extra, "meta"))
    missing = next((name for name in (*_ARRAYS, *extra, "meta") if name not in arrays), None)
    if missing:
        is_policy = str(arrays.get("meta")).startswith('{"policy"')
        text = "; this is a policy, and a plan is needed" if is_policy else ""
        raise InputError(source, missing, f"array is missing{text}")
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
    rolling = meta.get("rolling", [])
    if not isinstance(rolling, list) or not all(isinstance(names, list) for names in rolling):
        raise InputError(source, "meta.rolling", "is not a list of names for each phase")
    try:
        restore(tuple[tuple[ModeSpan, ...], ...], meta.get("modes", []))
    except (AttributeError, KeyError, TypeError, ValueError):
        text = "is not a list of spans with start, stop, contacts and joints for each phase"
        raise InputError(source, "meta.modes", text) from None
    contacts = tuple(str(name) for name in arrays["contacts"])
    pairs = ((arrays[f"q{dots}"], arrays[f"theta{dots}"]) for dots in ("", "_dot", "_ddot"))
    samples = Samples(*map(np.hstack, pairs), *(arrays[name] for name in ("tau", "c_n", "c_t")))
    with name_source(source, "torque_"):
        torque = TorqueProfile(arrays["torque_breaks"], arrays["torque_coefficients"]).check()
    motions = sample_phases(arrays["t"], arrays["phase"], samples, contacts, torque)
    columns = samples._asdict() | {"t": arrays["t"], "phase": arrays["phase"]}
    return Trajectory(**columns, contacts=contacts, torque=torque, motions=motions, meta=meta)


def _check_shape(source: str, name: str, arrays: Mapping[str, Any], tail: tuple[int, ...]) -> None:
    array = arrays[name]
    rows = arrays["t"].size if name in _ARRAYS else -1
    expected = rows, *((arrays["contacts"].size,) if name in ("c_n", "c_t") else tail)
    with name_source(source):
        require_array(array, name, *expected, kind=None)
    if name == "contacts":
        if array.dtype.kind != "U":
            raise InputError(source, name, "does not hold text")
    elif array.dtype.kind not in ("iu" if name == "phase" else "iuf"):
        needed = "integers" if name == "phase" else "numbers"
        raise InputError(source, name, f"holds {array.dtype}; {needed} are needed")
    elif np.isinf(array).any() or (name not in ("c_n", "c_t") and np.isnan(array).any()):
        raise InputError(source, name, "holds numbers that are not finite")
    # Problems have no larger distances or angles.
    largest = 1e6 if name in ("q", "theta") else MAX_NUMBER
    if name != "contacts" and (np.abs(array.astype(float)) > largest).any():
        raise InputError(source, name, f"holds numbers beyond {largest:g}, the largest allowed")


def _check_order(source: str, arrays: Mapping[str, Any]) -> None:
    """Check that phases follow one another, and that time increases within each."""
    phase, t = arrays["phase"], arrays["t"]
    rises = np.diff(phase)
    in_order = len(phase) and phase[0] == 0 and ((rises == 0) | (rises == 1)).all()
    if not in_order or np.bincount(phase.astype(int)).min() < 2:
        raise InputError(source, "phase", "must count up from 0, with two or more rows to a phase")
    steps, same_phase = np.diff(t), np.diff(phase) == 0
    repeats = same_phase & (steps == 0)
    # A repeated time is a step of forces, which cannot be at the end of a phase.
    last = np.append(same_phase[1:], False)
    if t[0] != 0 or (steps < 0).any() or (repeats & (np.append(repeats[1:], False) | ~last)).any():
        text = "must start at 0 and increase within each phase, a time given twice being a step"
        raise InputError(source, "t", text)
