"""A plain time-domain transcription, as a tutorial would write it, with CasADi's `Opti`.

All of z, z', c_n and tau are unknowns at the nodes of a uniform grid in time, the equations of
motion are collocated by the trapezoidal rule, contacts are kept by A z'' + A' z' = 0 at every node,
and the whole is handed to Ipopt with a straight line as first guess. A phase is split where a
direction reverses, each stretch with a duration of its own.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import casadi as ca
import numpy as np

from ...common.arrays import Expression
from ...solvers.ipopt import STOPPED
from .instances import Instance
from .plant import (
    PeerPlan,
    Stretch,
    build_plant,
    count_intervals,
    join_pieces,
    list_stretches,
    sample_slow_motion,
)

IPOPT = {
    "print_level": 0,
    "sb": "yes",
    "tol": 1e-8,
    "bound_relax_factor": 0.0,
    "max_iter": 1000,
}
"""Options of the solver."""
TUNED = {**IPOPT, "mu_strategy": "adaptive"}
"""Options of Ipopt for peers that are tuned."""


def build_opti(
    instance: Instance, setting: str, expand: bool = False, tuned: bool = False
) -> Callable[[], PeerPlan]:
    """Transcribe a phase on about as many intervals as the setting says.

    With `expand` CasADi's functions are expanded. If `tuned`, the slow motion is the first guess
    and Ipopt chooses its barrier parameter adaptively.
    """
    opti, curve = ca.Opti(), instance.curve
    scene, n_c = curve.formation.scene, curve.formation.n_contacts
    limit, plant = ca.DM(scene.torque_limit), build_plant(curve.formation)
    stretches = list_stretches(curve)
    z_before, v_before = ca.DM(curve.start), ca.DM.zeros(5)
    places = curve.evaluate(np.array([0.0, *(stretch.part.stop for stretch in stretches)])).z
    durations, torques = [], []
    counts = count_intervals(stretches, int(setting))
    guesses = sample_slow_motion(instance, [count + 1 for count in counts]) if tuned else []
    for index, (stretch, count) in enumerate(zip(stretches, counts, strict=True)):
        z, v = opti.variable(5, count + 1), opti.variable(5, count + 1)
        c_n, tau = opti.variable(n_c, count + 1), opti.variable(2, count + 1)
        duration = opti.variable()
        durations.append(duration)
        torques.append(tau)
        _collocate(opti, plant, stretch, duration / count, z, v, c_n, tau)
        opti.subject_to(z[:, 0] == z_before)
        opti.subject_to(v[:, 0] == v_before)
        opti.subject_to(z[stretch.progress, -1] == stretch.target)
        opti.subject_to(ca.vec(c_n) >= instance.problem.epsilon)
        for finger in range(2):
            opti.subject_to(opti.bounded(-limit[finger], tau[finger, :], limit[finger]))
        opti.subject_to(duration >= 1e-3)
        z_before, v_before = z[:, -1], v[:, -1]
        opti.set_initial(z, np.linspace(places[index], places[index + 1], count + 1).T)
        opti.set_initial(duration, 0.5 * stretch.share)
        opti.set_initial(c_n, 1.0)
        if tuned:
            t, guess = guesses[index]
            opti.set_initial(duration, float(t[-1]))
            given = (z, guess.z), (v, guess.z_dot), (tau, guess.tau), (c_n, guess.c_n)
            for symbol, values in given:
                opti.set_initial(symbol, values.T)
    opti.subject_to(v_before[stretches[-1].progress] == 0)
    opti.minimize(sum(durations))
    ipopt = TUNED if tuned else IPOPT
    opti.solver("ipopt", {"print_time": False, "expand": expand, "ipopt": ipopt})

    def run() -> PeerPlan:
        try:
            opti.solve()
        except RuntimeError:
            pass
        status, value = opti.stats()["return_status"], opti.debug.value
        if status == STOPPED:
            raise KeyboardInterrupt
        spans = [float(value(duration)) for duration in durations]
        rows = [np.asarray(value(tau)).T for tau in torques]
        return join_pieces(status, spans, rows)

    return run


def _collocate(
    opti: Any,
    plant: Expression,
    stretch: Stretch,
    step: Expression,
    z: Expression,
    v: Expression,
    c_n: Expression,
    tau: Expression,
) -> None:
    """Equations of motion at every node of a stretch, and the trapezoidal rule between them."""
    count, part = z.shape[1] - 1, stretch.part
    accelerations = []
    for k in range(count + 1):
        acceleration, missed = plant(z[:, k], v[:, k], tau[:, k], c_n[:, k], part.Xi, part.sigma)
        accelerations.append(acceleration)
        opti.subject_to(missed == 0)
    for k in range(count):
        opti.subject_to(z[:, k + 1] == z[:, k] + step / 2 * (v[:, k] + v[:, k + 1]))
        mean = (accelerations[k] + accelerations[k + 1]) / 2
        opti.subject_to(v[:, k + 1] == v[:, k] + step * mean)
