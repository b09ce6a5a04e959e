"""Phases of a motion, and what its state and forces are on both sides of where they join."""

from __future__ import annotations

import math

import numpy as np

from ..common.document import Table, fixed, show
from ..problem.definition import Problem
from ..results.trajectory import Trajectory


def list_phases(problem: Problem, trajectory: Trajectory) -> Table:
    """A row for each phase that the motion enters."""
    rows = []
    for index in np.unique(trajectory.phase):
        phase, own = problem.phases[index], trajectory.phase == index
        t, c_n = trajectory.t[own], trajectory.c_n[own]
        least, name = math.nan, ""
        if np.isfinite(c_n).any():
            least = float(np.nanmin(c_n))
            name = trajectory.contacts[int(np.nanargmin(c_n)) % c_n.shape[1]]
        contacts = " ".join(contact.name for contact in phase.formation.contacts)
        text = contacts, str(phase.until), phase.end.value
        rows.append((index + 1, *text, t[-1] - t[0], least, name))
    force = fixed(problem.epsilon or 0.05)
    heads = ["phase:d", "contacts", "until", "end", "duration [s]:.6f", f"least c_n [N]:{force}"]
    return Table([*heads, "of"], rows)


def list_joints(trajectory: Trajectory) -> Table:
    """A row for each place where a phase passes into the next one."""
    rows, planar = [], np.hypot(*trajectory.q_dot[:, :2].T)
    force = fixed(min(float(np.nanmax(trajectory.c_n, initial=0.0)), 10.0), 5)
    speed = fixed(min(float(planar.max()), 0.5), 4)
    torque = fixed(min(float(np.abs(trajectory.tau).max()), 2.0), 5)
    for after in np.flatnonzero(np.diff(trajectory.phase)) + 1:
        sides = [after - 1, after]
        forces = [
            f"{name}: {show(before, force)} \u2192 {show(later, force)}"
            for name, before, later in zip(trajectory.contacts, *trajectory.c_n[sides], strict=True)
            if math.isfinite(before) or math.isfinite(later)
        ]
        x, _, phi = trajectory.q[after]
        place = trajectory.t[after], x, phi
        torques = trajectory.tau[sides].T.ravel()
        number = trajectory.phase[after - 1] + 1
        rows.append((number, ", ".join(forces), *place, *planar[sides], *torques))
    heads = ["after phase:d", "c_n before \u2192 after [N]", "t [s]:.6f", "x [mm]:z.3f"]
    heads += ["phi [deg]:z.3f", f"speed before [m/s]:{speed}", f"after:{speed}"]
    heads += [f"tau1 before [N m]:{torque}", f"after:{torque}"]
    return Table([*heads, f"tau2 before:{torque}", f"after:{torque}"], rows)
