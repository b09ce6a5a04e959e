"""Where a replay is looked at: few instants at first, and more where something seems to dip."""

from __future__ import annotations

import numpy as np

from ..common.arrays import Array
from ..contacts.links import evaluate_finger_gap
from ..problem.definition import Problem
from ..results.torque import TorqueProfile
from ..results.trajectory import Trajectory
from ..simulation.events import Simulation
from ..simulation.simulate import Closer
from .margins import SHORTEST, fit_parabolas, list_normal_forces, list_slips

PARTS = 40
"""Least number of parts of a phase at whose ends it is looked at."""
ROWS = 20
"""About how many rows of each phase of a trajectory its replay is compared with."""
POINTS = 8
"""Instants around what seems to be a dip."""
LOOKS = 3
"""How often what the looks before leave open is looked at closer."""
WORTH = 1e-7
"""How far below all that is known a dip has to seem, relative to the scene's force or length."""


def choose_times(torque: TorqueProfile, starts: Array, plan: Trajectory | None = None) -> Array:
    """Instants to look at first: inside long pieces of torques, and rows of a plan.

    Parameters
    ----------
    torque : TorqueProfile
    starts : ndarray, shape (n_phases + 1,), [s]
        About when phases start, and when the last one ends.
    plan : Trajectory, optional
    """
    rows = [np.zeros(0)]
    for index in range(len(plan.motions) if plan is not None else 0):
        assert plan is not None
        own = np.flatnonzero(plan.phase == index)
        rows.append(plan.t[own[np.linspace(0, len(own) - 1, ROWS + 1).astype(int)]])
    times, breaks, widths = np.concatenate(rows), torque.breaks, np.diff(torque.breaks)
    owner = np.searchsorted(starts, (breaks[1:] + breaks[:-1]) / 2, side="right") - 1
    longest = np.diff(starts)[np.clip(owner, 0, len(starts) - 2)] / PARTS
    counts = np.ceil(widths / longest - 1e-9).astype(int) - 1
    piece = np.repeat(np.arange(len(counts)), counts)
    share = np.arange(1, len(piece) + 1) - (np.cumsum(counts) - counts)[piece]
    return np.append(times, breaks[piece] + widths[piece] * share / (counts + 1)[piece])


def make_closer(problem: Problem, breaks: Array) -> Closer:
    """What looks closer at a replay where a force, a margin to slipping or a gap seems to dip.

    Parameters
    ----------
    problem : Problem
    breaks : ndarray, [s]
        Those of its torques.
    """
    scales = problem.scene.scales
    shortest = SHORTEST * scales.time

    def look(simulation: Simulation, looks: int) -> Array:
        times, glimpses = [np.zeros(0)], simulation.glimpses
        for phase in problem.phases[: int(simulation.phase[-1]) + 1] if looks < LOOKS else ():
            rows = np.flatnonzero(simulation.phase == phase.index)
            t = simulation.t[rows]
            for name, values in list_normal_forces(problem, simulation, phase, rows).items():
                here, c_n = t, values
                if not looks:
                    own = glimpses.phase == phase.index
                    here = np.append(t, glimpses.t[own])
                    c_n = np.append(c_n, glimpses.c_n[own, simulation.contacts.index(name)])
                    order = np.argsort(here, kind="stable")
                    here, c_n = here[order], c_n[order]
                times += _surround(here, c_n, breaks, shortest, WORTH * scales.force)
            # These have no jumps, and kinks at most.
            for values in list_slips(simulation, phase, rows).values():
                times += _surround(t, values, t[:1], shortest, WORTH * scales.force)
            if problem.scene.fingers_collide:
                gaps = evaluate_finger_gap(problem.scene, simulation.z[rows])
                times += _surround(t, gaps, t[:1], shortest, WORTH * scales.length)
        return np.concatenate(times)

    return look


def _surround(t: Array, values: Array, breaks: Array, shortest: float, worth: float) -> list[Array]:
    """Instants around places where a sampled function seems to dip below all of its samples."""
    found = fit_parabolas(t, values, breaks, shortest)
    low = np.flatnonzero(found.lowest < np.nanmin(values, initial=np.inf) - worth)
    return [np.linspace(found.start[k], found.stop[k], POINTS + 2)[1:-1] for k in low]
