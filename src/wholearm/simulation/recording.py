"""A simulated motion as a trajectory."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..common.errors import SimulationError
from ..results.sampled import sample_phases
from ..results.trajectory import Trajectory
from .events import Simulation

REPLAYED = "replayed"
"""Status in the `meta` of such a trajectory."""


def make_trajectory(simulation: Simulation) -> Trajectory:
    """The motion of a simulation with every recorded instant, for files and figures.

    A phase that is entered in its last instant only is left out.

    Raises
    ------
    SimulationError
        If the simulation ended where it started, so that there is no motion.
    """
    rows, problem = _choose_rows(simulation), simulation.problem
    if not len(rows):
        raise SimulationError(f"there is no motion to keep: {simulation.outcome.text}")
    z, z_dot, z_ddot = (getattr(simulation, name)[rows] for name in ("z", "z_dot", "z_ddot"))
    arrays: dict[str, Any] = {
        name: getattr(simulation, name)[rows] for name in ("t", "tau", "c_n", "c_t", "phase")
    }
    arrays |= {"q": z[:, :3], "q_dot": z_dot[:, :3], "q_ddot": z_ddot[:, :3]}
    arrays |= {"theta": z[:, 3:], "theta_dot": z_dot[:, 3:], "theta_ddot": z_ddot[:, 3:]}
    motions = sample_phases(arrays, simulation.contacts)
    rolling = [phase.formation.rolling for phase in problem.phases[: len(motions)]]
    meta = {
        "status": REPLAYED,
        "outcome": simulation.outcome.text,
        "name": problem.name,
        "epsilon": problem.epsilon,
        "rolling": [[contact.name for contact in own] for own in rolling],
        "phase_durations": [motion.duration for motion in motions],
        "problem": problem.table,
    }
    return Trajectory(
        **arrays, contacts=simulation.contacts, torque=simulation.torque, motions=motions, meta=meta
    )


def _choose_rows(simulation: Simulation) -> NDArray[np.int64]:
    """Rows whose times increase in each phase, but for one repetition where forces step."""
    chosen: list[int] = []
    for index in range(int(simulation.phase[-1]) + 1):
        own = np.flatnonzero(simulation.phase == index)
        t = simulation.t[own]
        before, after = np.append(True, np.diff(t) > 0), np.append(np.diff(t) > 0, True)
        # At the end of a phase what comes before the last step stands for its last instant.
        kept = own[before | (after & (t < t[-1]))]
        if len(kept) < 2:
            break
        chosen += kept.tolist()
    return np.array(chosen, dtype=np.int64)
