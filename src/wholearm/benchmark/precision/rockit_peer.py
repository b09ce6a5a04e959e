"""A peer: rockit, an optimal-control layer on CasADi's `Opti`, with its direct collocation."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import casadi as ca
import numpy as np

from ...common.arrays import Array, Expression
from .instances import Instance
from .opti import TUNED
from .plant import (
    PeerPlan,
    build_plant,
    count_intervals,
    join_pieces,
    list_stretches,
    sample_slow_motion,
)

DEGREE = 3
"""Degree of the Radau collocation."""


def build_rockit(instance: Instance, setting: str) -> Callable[[], PeerPlan]:
    """A stage for every stretch, with torques that are linear in each interval.

    Contact forces follow from state and torques, and are bounded at the collocation points. The
    slow motion is the first guess.
    """
    import rockit

    curve, ocp = instance.curve, rockit.Ocp()
    plant, stretches = build_plant(curve.formation), list_stretches(curve)
    counts = count_intervals(stretches, int(setting))
    guesses = sample_slow_motion(instance, [count + 1 for count in counts])
    limit = ca.DM(curve.formation.scene.torque_limit)
    z_before, v_before = ca.DM(curve.start), ca.DM.zeros(5)
    stages: list[tuple[Any, Any]] = []
    for stretch, count, (t, guess) in zip(stretches, counts, guesses, strict=True):
        stage = ocp.stage(t0=0, T=rockit.FreeTime(float(t[-1])))
        z, v, tau = stage.state(5), stage.state(5), stage.control(2, order=1)
        c_n, part = stage.algebraic(curve.formation.n_contacts), stretch.part
        acceleration, missed = plant(z, v, tau, c_n, part.Xi, part.sigma)
        stage.set_der(z, v)
        stage.set_der(v, acceleration)
        stage.add_alg(missed)
        stage.subject_to(c_n >= instance.problem.epsilon, grid="integrator_roots")
        stage.subject_to((-limit <= tau) <= limit)
        stage.subject_to(stage.T >= 1e-3)
        stage.subject_to(stage.at_tf(z)[stretch.progress] == stretch.target)
        ocp.subject_to(stage.at_t0(z) == z_before)
        ocp.subject_to(stage.at_t0(v) == v_before)
        z_before, v_before = stage.at_tf(z), stage.at_tf(v)
        for symbol, values in ((z, guess.z), (v, guess.z_dot), (tau, guess.tau)):
            stage.set_initial(symbol, _interpolate(t / t[-1], values, stage.t / stage.T))
        stage.add_objective(stage.T)
        stage.method(rockit.DirectCollocation(N=count, M=1, degree=DEGREE, scheme="radau"))
        stages.append((stage, tau))
    ocp.subject_to(v_before[stretches[-1].progress] == 0)
    ocp.solver("ipopt", {"expand": True, "print_time": False, "ipopt": TUNED})
    ocp.method(rockit.DirectMethod())
    # Asking for these has everything transcribed.
    ocp.placeholders_transcribed  # noqa: B018

    def run() -> PeerPlan:
        try:
            found = ocp.solve()
        except RuntimeError:
            found = ocp.non_converged_solution
        spans = [float(found(stage).value(stage.T)) for stage, _ in stages]
        rows = [np.asarray(found(stage).sample(tau, grid="control")[1]) for stage, tau in stages]
        status = str(found.stats["return_status"])
        return join_pieces(status, spans, rows)

    return run


def _interpolate(grid: Array, values: Array, place: Expression) -> Expression:
    """Linear interpolation of rows of values, rockit's way to take a first guess over time."""
    return ca.interpolant("guess", "linear", [grid], values.ravel())(place)
