"""A contact-implicit transcription: which contacts press and which way they slide is not given.

Implicit Euler steps of a free length, with complementarity of gaps and normal forces, and Coulomb
friction of contacts and joints by the rates lambda of Stewart and Trinkle; after Posa, Cantu and
Tedrake (2014). All products are at most delta, which is made smaller step by step. Each setting is
a random start.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import casadi as ca
import numpy as np

from ...common.arrays import Array, Expression
from ...results.torque import TorqueProfile
from .instances import Instance
from .opti import TUNED
from .plant import NO_PLAN, OPTIMUM, PeerPlan, list_stretches

STEPS = 16
"""Steps of a phase."""
RELAXED = (1.0, 1e-1, 1e-2, 1e-3, 1e-4)
"""Largest products, in the scene's units, from first to last."""
ITERATIONS = 100
"""Largest number of iterations for each of them."""
STARTS = 50
"""Number of random starts."""


def build_implicit(instance: Instance, setting: str) -> Callable[[], PeerPlan]:
    """Transcribe a phase; the setting is the number of the start."""
    opti, curve = ca.Opti(), instance.curve
    scene, n_c = curve.formation.scene, curve.formation.n_contacts
    scales, rows = scene.scales, n_c + 2
    z, v = opti.variable(5, STEPS + 1), opti.variable(5, STEPS + 1)
    c_n, tau = opti.variable(n_c, STEPS), opti.variable(2, STEPS)
    ahead, back = opti.variable(rows, STEPS), opti.variable(rows, STEPS)
    rate, duration = opti.variable(rows, STEPS), opti.variable()
    delta = opti.parameter()
    h = scales.time * duration / STEPS
    step, units = _build_step(instance), _units(instance)
    limit = ca.DM(scene.torque_limit) / scales.torque
    for k in range(STEPS):
        own = z[:, k + 1] * units, v[:, k + 1] * units / scales.time
        given = c_n[:, k], tau[:, k], ahead[:, k], back[:, k]
        acceleration, gap, slip, cone = step(*own, *given)
        opti.subject_to(z[:, k + 1] == z[:, k] + h / scales.time * v[:, k + 1])
        opti.subject_to(v[:, k + 1] == v[:, k] + h * acceleration * scales.time / units)
        free = cone - ahead[:, k] - back[:, k]
        pairs = [(gap, c_n[:, k]), (free, rate[:, k])]
        pairs += [(rate[:, k] + slip, ahead[:, k]), (rate[:, k] - slip, back[:, k])]
        for one, other in pairs:
            opti.subject_to(one >= 0)
            opti.subject_to(other >= 0)
            opti.subject_to(one * other <= delta)
        opti.subject_to((-limit <= tau[:, k]) <= limit)
    opti.subject_to(z[:, 0] == ca.DM(curve.start) / units)
    opti.subject_to(z[:, -1] == ca.DM(curve.end) / units)
    opti.subject_to(ca.horzcat(v[:, 0], v[:, -1]) == 0)
    opti.subject_to((0.05 <= duration) <= 50)
    opti.minimize(duration)
    _guess(opti, instance, int(setting), z, duration, (c_n, tau, ahead, back, rate))
    ipopt = {**TUNED, "max_iter": ITERATIONS}
    opti.solver("ipopt", {"print_time": False, "expand": True, "ipopt": ipopt})

    def run() -> PeerPlan:
        status = ""
        for relaxed in RELAXED:
            opti.set_value(delta, relaxed)
            try:
                opti.solve()
            except RuntimeError:
                pass
            status = opti.stats()["return_status"]
            if status not in (OPTIMUM, "Solved_To_Acceptable_Level"):
                break
            status = OPTIMUM
            opti.set_initial(opti.x, opti.value(opti.x))
        value = opti.debug.value
        total = float(value(duration)) * scales.time
        found = np.asarray(value(z)) * np.array(units)
        return _join(instance, status, total, found, np.asarray(value(tau)).T * scales.torque)

    return run


def _units(instance: Instance) -> Expression:
    length = instance.problem.scene.scales.length
    return ca.DM([length, length, 1.0, 1.0, 1.0])


def _build_step(instance: Instance) -> Expression:
    """CasADi function of a state and scaled forces: z'', scaled gaps, slips and friction bounds."""
    formation = instance.curve.formation
    scene, n_c = formation.scene, formation.n_contacts
    scales = scene.scales
    z, v = ca.SX.sym("z", 5), ca.SX.sym("v", 5)
    c_n, tau = ca.SX.sym("c_n", n_c), ca.SX.sym("tau", 2)
    ahead, back = ca.SX.sym("ahead", n_c + 2), ca.SX.sym("back", n_c + 2)
    gap, A, _, A_t = formation.build_constraints(z, v)
    rub = ahead - back
    applied = ca.DM(scene.applied_force) - ca.DM(scene.viscous) * v
    applied += scales.force * (A.T @ c_n + A_t.T @ rub[:n_c])
    applied += scales.torque * ca.vertcat(0, 0, 0, tau + rub[n_c:])
    slip = ca.vertcat(A_t @ v / scales.speed, v[3:] * scales.time)
    cone = ca.vertcat(ca.DM(formation.friction) * c_n, ca.DM(scene.dry[3:]) / scales.torque)
    found = [applied / ca.DM(scene.mass_diagonal), gap / scales.length, slip, cone]
    return ca.Function("step", [z, v, c_n, tau, ahead, back], found)


def _guess(
    opti: Any, instance: Instance, seed: int, z: Expression, duration: Expression, others: Any
) -> None:
    """A random start: a bent line from start to end, a duration and forces."""
    random = np.random.default_rng(seed)
    units = np.array(_units(instance))[:, 0]
    ends = instance.curve.start / units, instance.curve.end / units
    x = np.linspace(0.0, 1.0, STEPS + 1)
    bend = 0.2 * random.normal(size=5)[:, None] * np.sin(np.pi * x)
    opti.set_initial(z, np.linspace(*ends, STEPS + 1).T + bend)
    opti.set_initial(duration, random.uniform(1.0, 6.0))
    for forces in others:
        opti.set_initial(forces, random.uniform(0.0, 2.0, forces.shape))


def _join(instance: Instance, status: str, total: float, z: Array, tau: Array) -> PeerPlan:
    """The plan with constant torques in each step, and when it passes the reversals."""
    if not total > 0:
        return NO_PLAN._replace(status=status)
    nodes, marks = np.linspace(0.0, total, STEPS + 1), []
    for stretch in list_stretches(instance.curve)[:-1]:
        gone = z[stretch.progress] - stretch.target
        marks.append(float(nodes[int(np.argmax(gone * gone[0] <= 0))]))
    rows = np.repeat(nodes, 2)[1:-1], np.repeat(tau, 2, axis=0)
    return PeerPlan(status, total, TorqueProfile.join_rows(*rows), tuple(marks))
