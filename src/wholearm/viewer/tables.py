"""Phases of a motion, and what its state and forces are on both sides of where they join."""

from __future__ import annotations

import math

import numpy as np

from ..common.document import fixed
from ..problem.definition import Problem
from ..results.trajectory import Trajectory

PHASE_HEADS = ("phase", "contacts", "until", "end", "duration [s]", "least c_n [N]", "of")
JOINT_HEADS = (
    "after phase", "contacts: c_n before \u2192 after [N]", "t [s]", "x [mm]", "phi [deg]",
    "speed before [m/s]", "after", "tau1 before [N m]", "after", "tau2 before", "after",
)  # fmt: skip


def list_phases(problem: Problem, trajectory: Trajectory) -> list[list[str]]:
    """A row for each phase that the motion enters, under `PHASE_HEADS`."""
    rows = []
    for index in np.unique(trajectory.phase):
        phase, own = problem.phases[index], trajectory.phase == index
        t, c_n = trajectory.t[own], trajectory.c_n[own]
        least, name = math.nan, ""
        if np.isfinite(c_n).any():
            least = float(np.nanmin(c_n))
            name = trajectory.contacts[int(np.nanargmin(c_n)) % c_n.shape[1]]
        contacts = " ".join(contact.name for contact in phase.formation.contacts)
        figures = [f"{t[-1] - t[0]:.6f}", f"{least:{fixed(problem.epsilon or 0.05)}}", name]
        rows.append([str(index + 1), contacts, str(phase.until), phase.end.value, *figures])
    return rows


def list_joints(trajectory: Trajectory) -> list[list[str]]:
    """A row for each place where a phase passes into the next one, under `JOINT_HEADS`."""
    rows, planar = [], np.hypot(*trajectory.q_dot[:, :2].T)
    force = fixed(min(float(np.nanmax(trajectory.c_n, initial=0.0)), 10.0), 5)
    speed = fixed(min(float(planar.max()), 0.5), 4)
    torque = fixed(min(float(np.abs(trajectory.tau).max()), 2.0), 5)
    for after in np.flatnonzero(np.diff(trajectory.phase)) + 1:
        sides = (after - 1, after)
        before, later = (trajectory.c_n[k] for k in sides)
        forces = [
            f"{name}: {_show(before[k], force)} \u2192 {_show(later[k], force)}"
            for k, name in enumerate(trajectory.contacts)
            if math.isfinite(before[k]) or math.isfinite(later[k])
        ]
        x, _, phi = trajectory.q[after]
        place = [f"{trajectory.t[after]:.6f}", f"{1e3 * x:z.3f}", f"{math.degrees(phi):z.3f}"]
        speeds = [f"{planar[k]:{speed}}" for k in sides]
        torques = [f"{trajectory.tau[k, j]:{torque}}" for j in (0, 1) for k in sides]
        number = str(trajectory.phase[after - 1] + 1)
        rows.append([number, ", ".join(forces), *place, *speeds, *torques])
    return rows


def _show(value: float, form: str) -> str:
    return f"{value:{form}}" if math.isfinite(value) else "none"
