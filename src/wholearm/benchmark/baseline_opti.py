"""The baseline of the benchmark: a plain time-domain transcription, as a tutorial would write it.

All of z, z', c_n and tau are unknowns at the nodes of a uniform grid in time, the equations of
motion are collocated by the trapezoidal rule, contacts are kept by A z'' + A' z' = 0 at every node,
and the whole is handed to Ipopt through CasADi's `Opti` with a straight line as first guess. A
phase is split where a direction reverses, each stretch with a duration of its own.
"""

from __future__ import annotations

import time
from typing import Any, NamedTuple

import casadi as ca
import numpy as np

from ..common.arrays import Expression
from ..contacts.formation import Formation
from ..geometry.curve import Curve, Segment
from ..results.torque import TorqueProfile
from ..solvers.ipopt import STOPPED

IPOPT = {
    "print_level": 0,
    "sb": "yes",
    "tol": 1e-8,
    "bound_relax_factor": 0.0,
    "max_iter": 1000,
}
"""Options of the solver."""


class BaselineResult(NamedTuple):
    """What the baseline found for one phase.

    Attributes
    ----------
    status : str
        Ipopt's.
    duration : float, [s]
    torque : TorqueProfile
        Linear between nodes.
    build_time, solve_time : float, [s]
    iterations : int
    """

    status: str
    duration: float
    torque: TorqueProfile
    build_time: float
    solve_time: float
    iterations: int


def plan_with_opti(curve: Curve, epsilon: float, intervals: int) -> BaselineResult:
    """Find the least time of one phase on about `intervals` intervals."""
    started = time.perf_counter()
    opti = ca.Opti()
    scene = curve.formation.scene
    limit = ca.DM(scene.torque_limit)
    ends = curve.evaluate(np.array([0.0, *(part.stop for part in curve.segments)])).z
    turn = abs(ends[-1] - ends[0])
    progress = 2 if turn[2] > 1e-6 else 0
    durations, torques = [], []
    z_before, v_before = ca.DM(ends[0]), ca.DM.zeros(5)
    for index, part in enumerate(curve.segments):
        count = max(4, round(intervals * (part.stop - part.start) / curve.length))
        z, v = opti.variable(5, count + 1), opti.variable(5, count + 1)
        c_n, tau = opti.variable(curve.formation.n_contacts, count + 1), opti.variable(2, count + 1)
        duration = opti.variable()
        durations.append(duration)
        torques.append(tau)
        _collocate(opti, curve.formation, part, duration / count, z, v, c_n, tau)
        opti.subject_to(z[:, 0] == z_before)
        opti.subject_to(v[:, 0] == v_before)
        opti.subject_to(z[progress, -1] == ends[index + 1][progress])
        opti.subject_to(ca.vec(c_n) >= epsilon)
        for finger in range(2):
            opti.subject_to(opti.bounded(-limit[finger], tau[finger, :], limit[finger]))
        opti.subject_to(duration >= 1e-3)
        z_before, v_before = z[:, -1], v[:, -1]
        share = (part.stop - part.start) / curve.length
        opti.set_initial(z, np.linspace(ends[index], ends[index + 1], count + 1).T)
        opti.set_initial(duration, 0.5 * share)
        opti.set_initial(c_n, 1.0)
    opti.subject_to(v_before[progress] == 0)
    total = sum(durations)
    opti.minimize(total)
    opti.solver("ipopt", {"print_time": False, "record_time": True, "ipopt": IPOPT})
    built = time.perf_counter()
    try:
        opti.solve()
    except RuntimeError:
        pass
    solved = time.perf_counter()
    stats, value = opti.stats(), opti.debug.value
    if stats["return_status"] == STOPPED:
        raise KeyboardInterrupt
    times, start = [], 0.0
    for duration, tau in zip(durations, torques, strict=True):
        stop = start + float(value(duration))
        times.append(np.linspace(start, stop, tau.shape[1]))
        start = stop
    rows = np.concatenate([value(tau).T for tau in torques])
    return BaselineResult(
        stats["return_status"],
        float(value(total)),
        TorqueProfile.join_rows(np.concatenate(times), rows),
        built - started,
        solved - built,
        stats["iter_count"],
    )


def _collocate(
    opti: Any,
    formation: Formation,
    part: Segment,
    step: Expression,
    z: Expression,
    v: Expression,
    c_n: Expression,
    tau: Expression,
) -> None:
    """Equations of motion at every node of a stretch, and the trapezoidal rule between them."""
    scene, count = formation.scene, z.shape[1] - 1
    signs = ca.DM(formation.friction * part.Xi)
    dry = ca.DM(scene.dry) * ca.DM([0, 0, 0, *part.sigma])
    accelerations = []
    for k in range(count + 1):
        _, A, A_t, A_dot_v = formation.function(z[:, k], v[:, k])
        G = A - ca.diag(signs) @ A_t
        applied = ca.DM(scene.applied_force) + ca.vertcat(0, 0, 0, tau[:, k])
        friction = ca.DM(scene.viscous) * v[:, k] + dry
        accelerations.append((applied - friction + G.T @ c_n[:, k]) / ca.DM(scene.mass_diagonal))
        opti.subject_to(A @ accelerations[-1] + A_dot_v == 0)
    for k in range(count):
        opti.subject_to(z[:, k + 1] == z[:, k] + step / 2 * (v[:, k] + v[:, k + 1]))
        mean = (accelerations[k] + accelerations[k + 1]) / 2
        opti.subject_to(v[:, k + 1] == v[:, k] + step * mean)
