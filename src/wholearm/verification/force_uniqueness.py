"""Uniqueness margin of contact forces (P-matrix), and static indeterminacy of a start."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from ..contacts.formation import Formation, Kinematics
from ..mechanics.statics import SURE, Statics
from ..mechanics.uniqueness import find_minors
from ..problem.definition import Phase, Problem
from ..results.report import UniquenessMargin
from ..results.torque import TorqueProfile
from ..results.trajectory import Trajectory
from ..simulation.events import EventKind, Simulation
from .verdict import measure_speed

PLACES = 33
"""Instants of a phase at which uniqueness margins are looked at, and at which torques are."""


def find_uniqueness_margin(
    phase: Phase, motion: Trajectory | Simulation, rows: NDArray[np.int64]
) -> UniquenessMargin | None:
    """The least uniqueness margin in a phase; None if nothing moved.

    Tangential forces tell which way a contact slides; one that leans on no side of its cone sticks.

    Parameters
    ----------
    rows  its rows in the phase
    """
    formation, rows = phase.formation, rows[:: -(-len(rows) // PLACES)]
    columns = [motion.contacts.index(name) for name in formation.names]
    determined = ~np.isnan(motion.c_n[rows][:, columns]).any(axis=1)
    rows = rows[determined]
    if not len(rows):
        return None
    c_n, c_t = (forces[rows][:, columns] for forces in (motion.c_n, motion.c_t))
    slides = np.abs(c_t) >= (1 - 1e-6) * formation.friction * np.abs(c_n)
    Xi = -np.sign(c_t * c_n)
    kinematics = formation.evaluate(motion.z[rows], motion.z_dot[rows])
    margins = []
    for pattern in np.unique(slides, axis=0):
        rows_of = np.flatnonzero((slides == pattern).all(axis=1))
        part = Kinematics(*(array[rows_of] for array in kinematics))
        sticking = tuple(np.flatnonzero(~pattern).tolist())
        ratio, names, row = find_minors(formation, part, Xi[rows_of], sticking).find_least()
        margins.append(UniquenessMargin(ratio, names, float(motion.t[rows[rows_of[row]]])))
    return min(margins)


def find_departure(simulation: Simulation, torque: TorqueProfile, index: int) -> float:
    """Last break of the torques before a phase starts to move, -inf if it does not [s]."""
    starts = [e.time for e in simulation.find(EventKind.START) if e.phase == index]
    breaks = [b for b in torque.breaks.tolist() if starts and b <= starts[0]]
    return max(breaks, default=-math.inf)


def find_wedged(
    problem: Problem,
    phase: Phase,
    motion: Trajectory | Simulation,
    rows: NDArray[np.int64],
    slow: float,
    start: float = -np.inf,
) -> float | None:
    """Time for which friction may hold a phase that begins at rest (static indeterminacy) [s].

    Until no contact forces within their cones, of all contacts that touch, balance torques and
    gravity: see `mechanics.statics`. None if the phase does not begin at rest.

    Parameters
    ----------
    rows         its rows in the phase
    slow         speed that passes for rest, relative to the scene's
    start : [s]  since when the phase is to move, if its rows begin with the time for which it is
                 held
    """
    scene, contacts = problem.scene, phase.formation.contacts
    if phase.index:
        if measure_speed(scene, motion.z_dot[rows[0]]) > slow * scene.scales.speed:
            return None
        contacts += problem.phases[phase.index - 1].formation.contacts
    touching = Formation(scene, tuple(dict.fromkeys(contacts)))
    static = Statics(touching, motion.z[rows[0]]).torque_polygon()
    start, stop = max(start, float(motion.t[rows[0]])), float(motion.t[rows[-1]])
    t = np.linspace(start, stop, 4 * PLACES)
    # At its end the torques are those of the next phase.
    beyond = static.measure(motion.torque.at(t[:-1])) - SURE * scene.scales.torque
    free = np.flatnonzero(beyond > 0)
    if not len(free):
        return float(stop - start)
    if free[0] == 0:
        return 0.0
    before, after = beyond[free[0] - 1], beyond[free[0]]
    return float((free[0] - after / (after - before)) * (t[1] - t[0]))
