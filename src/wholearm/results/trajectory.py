"""A motion with its forces, planned or replayed, at any instant."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..common.arrays import Array
from ..common.document import Drawn
from ..common.files import require_ending, write_text
from .torque import TorqueProfile


class Samples(NamedTuple):
    """A motion at n instants, on one contact formation."""

    z: Array  # z, z_dot, z_ddot (n, 5): degrees of freedom (q, theta) and their derivatives
    z_dot: Array
    z_ddot: Array
    tau: Array  # (n, 2) [N m]
    c_n: Array  # c_n, c_t (n, n_c) [N]: in the order of the formation's contacts
    c_t: Array


class Motion(Protocol):
    """One phase of a trajectory as a function of time."""

    @property
    def duration(self) -> float:
        """How long the phase lasts [s]."""

    @property
    def contacts(self) -> tuple[str, ...]:
        """Names of the phase's contacts."""

    def evaluate(self, t: Array) -> Samples:
        """Samples at times `t` from the start of the phase, shape (n,) [s]."""


@dataclass(frozen=True, eq=False, repr=False)
class Trajectory(Drawn):
    """A planned motion: samples for files and plots, motions for any instant."""

    # (n,) [s]: even within each phase of a plan; a phase boundary is there twice, since torques and
    # forces step, and so is where a phase is at its end and is held there. In a replay any other
    # step is, too.
    t: Array
    q: Array  # q, theta (n, 3) and (n, 2) [m, m, rad] and [rad]:
    theta: Array
    # q_dot, theta_dot, q_ddot, theta_ddot: first and second derivatives with respect to time
    q_dot: Array
    theta_dot: Array
    q_ddot: Array
    theta_ddot: Array
    tau: Array  # (n, 2) [N m]
    contacts: tuple[str, ...]  # every contact of the plan
    # c_n, c_t (n, m) [N]: naN where a contact is not in the formation, or at rest, where forces are
    # not determined
    c_n: Array
    c_t: Array
    phase: NDArray[np.int64]  # (n,): index of the phase, from 0
    # the torques at any instant, exact between samples, with every step at a break
    torque: TorqueProfile
    # one per phase. Those of a planned trajectory satisfy the equations of motion at any instant;
    # those of a loaded one interpolate the samples.
    motions: tuple[Motion, ...]
    # status, epsilon and the problem, and of a plan everything else that `Plan` says
    meta: Mapping[str, Any]

    @property
    def headline(self) -> str:
        """Phases and duration, in a line."""
        count = len(self.motions)
        return f"{count} phase{'s' if count > 1 else ''}, {self.duration:.6g} s"

    @property
    def duration(self) -> float:
        """How long the motion lasts [s]."""
        return float(self.t[-1])

    @property
    def phase_starts(self) -> Array:
        """When each phase starts, and when the last one ends, shape (n_phases + 1,) [s]."""
        first = np.flatnonzero(np.diff(self.phase, prepend=-1))
        return np.append(self.t[first], self.t[-1])

    @property
    def held(self) -> NDArray[np.bool_]:
        """Where everything waits at rest, and no forces are known, shape (n,)."""
        return np.asarray(np.isnan(self.c_n).all(axis=1))

    @property
    def rolling(self) -> NDArray[np.bool_]:
        """Which contacts roll, shape (n, m), as `meta` names them by phases and modes."""
        mask = np.zeros(self.c_t.shape, dtype=bool)
        for index, names in enumerate(self.meta.get("rolling", [])):
            mask[self.phase == index] = [name in names for name in self.contacts]
        starts = self.phase_starts
        for index, modes in enumerate(self.meta.get("modes", [])):
            for mode in modes:
                passed = self.t - starts[index]
                rows = (self.phase == index) & (passed >= mode["start"]) & (passed <= mode["stop"])
                rolls = [mode["contacts"].get(name) == "rolls" for name in self.contacts]
                mask[rows] |= rolls
        return mask

    @property
    def z(self) -> Array:
        """Degrees of freedom (q, theta), shape (n, 5)."""
        return np.hstack([self.q, self.theta])

    @property
    def z_dot(self) -> Array:
        """Velocities (q', theta'), shape (n, 5)."""
        return np.hstack([self.q_dot, self.theta_dot])

    @property
    def z_ddot(self) -> Array:
        """Accelerations (q'', theta''), shape (n, 5)."""
        return np.hstack([self.q_ddot, self.theta_ddot])

    def at(self, t: ArrayLike) -> Samples:
        """The motion at some times, shape (n,) or a number [s], each field of shape (n, ...).

        At a phase boundary the later phase answers. The contacts are all of the trajectory's;
        forces are NaN where a contact is not in the formation.

        Raises
        ------
        ValueError  if one of the times is outside the trajectory
        """
        times, starts = np.atleast_1d(np.asarray(t, dtype=float)), self.phase_starts
        inside = (times >= starts[0]) & (times <= starts[-1])
        if not inside.all():
            wrong = times[~inside][0]
            raise ValueError(f"t = {wrong} s is outside the trajectory, 0 to {starts[-1]} s")
        owner = np.searchsorted(starts, times, side="right") - 1
        owner = np.minimum(owner, len(self.motions) - 1)
        n, m = len(times), len(self.contacts)
        fields = Samples(*(np.full((n, width), np.nan) for width in (5, 5, 5, 2, m, m)))
        for index in sorted(set(owner.tolist())):
            motion, rows = self.motions[index], np.flatnonzero(owner == index)
            part = motion.evaluate(times[rows] - starts[index])
            own = [self.contacts.index(name) for name in motion.contacts]
            for k, (whole, values) in enumerate(zip(fields, part, strict=True)):
                columns = slice(None) if k < 4 else own
                whole[rows[:, None], np.arange(whole.shape[1])[columns]] = values
        return fields

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the trajectory to a ``.npz`` file.

        Raises
        ------
        InputError  if the file cannot be written
        """
        from .trajectory_file import write_trajectory

        write_trajectory(self, path)

    def save_torques(self, path: str | os.PathLike[str]) -> None:
        """Write the torques as CSV, ``t,tau1,tau2``, a repeated time being a step.

        Rows are as dense as the torques are bent; `planning.table_check` also replays them.

        Raises
        ------
        InputError  if the file cannot be written
        """
        from .torque import format_rows, place_rows

        require_ending(path, ".csv")
        write_text(path, format_rows(place_rows(self.torque)))


def assemble(
    motions: Sequence[Motion], torque: TorqueProfile, meta: Mapping[str, Any], samples: int
) -> Trajectory:
    """Sample motions that follow one another, `samples` rows to a phase and two to its held end."""
    from .dwell_record import SettledMotion

    contacts = tuple(dict.fromkeys(name for motion in motions for name in motion.contacts))
    rows, times, forces, start = [], [], [], 0.0
    for motion in motions:
        if isinstance(motion, SettledMotion):
            local, row = motion.sample(samples)
        else:
            local = np.linspace(0.0, motion.duration, samples)
            row = motion.evaluate(local)
        wide = np.full((2, len(local), len(contacts)), np.nan)
        wide[:, :, [contacts.index(name) for name in motion.contacts]] = row.c_n, row.c_t
        rows.append(row)
        times.append(start + local)
        forces.append(wide)
        start += motion.duration
    z, z_dot, z_ddot, tau = (np.concatenate([row[k] for row in rows]) for k in range(4))
    c_n, c_t = np.concatenate(forces, axis=1)
    return Trajectory(
        t=np.concatenate(times),
        q=z[:, :3],
        theta=z[:, 3:],
        q_dot=z_dot[:, :3],
        theta_dot=z_dot[:, 3:],
        q_ddot=z_ddot[:, :3],
        theta_ddot=z_ddot[:, 3:],
        tau=tau,
        contacts=contacts,
        c_n=c_n,
        c_t=c_t,
        phase=np.repeat(np.arange(len(motions)), [len(row.z) for row in rows]),
        torque=torque,
        motions=tuple(motions),
        meta=dict(meta),
    )
