"""The paper's scalar equation of motion (Eqs. 6-16) along a replay.

With four constraints the velocities are multiples of theta_1', and eliminating everything else
leaves Phi_1 theta_1'' + Phi_2 theta_1' + Phi_3 = 0. It is set up from the formation alone, and so
checks the accelerations of the simulator by another route.
"""

from __future__ import annotations

import numpy as np

from ..common.arrays import Array
from ..contacts.formation import Formation
from ..mechanics.dynamics import Directions, force_rows
from ..problem.definition import Problem
from ..results.report import ReducedState
from ..simulation.events import Simulation

_OTHERS = [0, 1, 2, 4]  # degrees of freedom that are eliminated: q and theta_2


def list_reduced_states(problem: Problem, simulation: Simulation) -> tuple[ReducedState, ...]:
    """The scalar equation at a few instants of every phase with four constraints.

    At each instant theta_1 turns and every contact that the formation lets slide does so.
    """
    states = []
    for index in range(int(simulation.phase[-1]) + 1):
        formation, rows = problem.phases[index].formation, np.flatnonzero(simulation.phase == index)
        if formation.n_constraints != 4:
            continue
        z, v = simulation.z[rows], simulation.z_dot[rows]
        slip = formation.evaluate(z, v).A_t @ v[:, :, None]
        sliding = [k for k in range(formation.n_contacts) if k not in formation.rolling_rows]
        scales = problem.scene.scales
        speeds = np.hstack([slip[:, sliding, 0], scales.length * v[:, 3:]])
        moving = rows[np.abs(speeds).min(axis=1) > 1e-4 * scales.speed]
        chosen = np.unique(np.linspace(0, len(moving) - 1, 5).round().astype(int))
        for row in moving[chosen] if len(moving) else ():
            states.append(_reduce_row(formation, simulation, int(row)))
    return tuple(states)


def _reduce_row(formation: Formation, simulation: Simulation, row: int) -> ReducedState:
    z, v = simulation.z[row], simulation.z_dot[row]
    slip = formation.evaluate(z[None], v[None]).A_t[0] @ v
    directions = Directions(np.sign(slip), np.sign(v[3:]))
    Phi = reduce_to_first_joint(formation, z, v[3], simulation.tau[row], directions)
    time, phase = float(simulation.t[row]), int(simulation.phase[row]) + 1
    return ReducedState(time, phase, *Phi, float(v[3]), float(simulation.z_ddot[row, 3]))


def reduce_to_first_joint(
    formation: Formation, z: Array, theta_1_dot: float, tau: Array, directions: Directions
) -> tuple[float, float, float]:
    """Phi_1 [kg m^2], Phi_2 [N m s] and Phi_3 [N m] of a formation with four constraints.

    Eqs. (6)-(9) give (q', theta_2') = -P_AI^+ P_AII theta_1'. The equations of q and theta_2 give
    the contact forces, and that of theta_1 becomes the scalar equation. The pseudoinverse keeps the
    formula defined where P_AI is singular; where that is because theta_1 is stationary, the motion
    is not a multiple of theta_1' and no such formula describes it.

    Parameters
    ----------
    z : (5,)
    theta_1_dot : [rad/s]
    tau : (2,) [N m]
    directions             signs of friction
    """
    scene = formation.scene
    P = formation.evaluate(z[None], np.zeros((1, 5))).P[0]
    P_AI_inverse, P_AII = np.linalg.pinv(P[:, _OTHERS]), P[:, 3]

    def extend(right: Array, first: float) -> Array:
        full = np.empty(5)
        full[_OTHERS] = P_AI_inverse @ (right - P_AII * first)
        full[3] = first
        return full

    slope = extend(np.zeros(4), 1.0)
    kinematics = formation.evaluate(z[None], slope[None])
    bend = extend(-kinematics.P_dot_v[0], 0.0)
    G = force_rows(formation, kinematics, directions)[0]
    dry = scene.dry * np.array([0.0, 0.0, 0.0, *directions.sigma])
    resting = dry - scene.applied_force - np.array([0.0, 0.0, 0.0, *tau])
    # Rows of each term of M5 z'' + b - g - S tau = G^T c; the others' rows solve for c.
    eliminate = G[:, 3] @ np.linalg.inv(G[:, _OTHERS].T)
    mass = scene.mass_diagonal
    terms = mass * slope, mass * bend * theta_1_dot + scene.viscous * slope, resting
    Phi_1, Phi_2, Phi_3 = (float(term[3] - eliminate @ term[_OTHERS]) for term in terms)
    return Phi_1, Phi_2, Phi_3
