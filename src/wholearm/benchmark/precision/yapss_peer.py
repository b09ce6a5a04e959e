"""A peer: yapss, pseudospectral collocation with derivatives by CasADi and its own Ipopt."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import casadi as ca
import numpy as np

from ...results.torque import TorqueProfile
from .instances import Instance
from .plant import (
    NO_PLAN,
    OPTIMUM,
    PeerPlan,
    build_plant,
    count_intervals,
    list_stretches,
    sample_slow_motion,
)

IPOPT = {
    "print_level": 0,
    "sb": "yes",
    "tol": 1e-8,
    "bound_relax_factor": 0.0,
    "max_iter": 1000,
    "mu_strategy": "adaptive",
}
POINTS = 2
"""Collocation points of a segment."""


def build_yapss(instance: Instance, setting: str) -> Callable[[], PeerPlan]:
    """A phase for every stretch, with contact forces among the controls, on Legendre-Gauss points.

    The slow motion is the first guess.
    """
    import yapss

    curve, stretches = instance.curve, list_stretches(instance.curve)
    counts = count_intervals(stretches, int(setting))
    guesses = sample_slow_motion(instance, [POINTS * count + 1 for count in counts])
    n_c, k = curve.formation.n_contacts, len(stretches)
    ocp = yapss.Problem(
        name="phase", nx=k * [10], nu=k * [2 + n_c], nh=k * [n_c], nq=k * [0], nd=11 * (k - 1)
    )
    _write_functions(ocp, instance)
    limit = curve.formation.scene.torque_limit
    for index, (stretch, count) in enumerate(zip(stretches, counts, strict=True)):
        bounds, guess = ocp.bounds.phase[index], ocp.guess.phase[index]
        bounds.control.lower[:] = [*-limit, *n_c * [instance.problem.epsilon]]
        bounds.control.upper[:2] = limit
        bounds.path.lower[:] = bounds.path.upper[:] = 0.0
        bounds.duration.lower = 1e-3
        ends = bounds.final_state
        ends.lower[stretch.progress] = ends.upper[stretch.progress] = stretch.target
        t, slow = guesses[index]
        before = sum(float(given[0][-1]) for given in guesses[:index])
        guess.time = t + before
        guess.state = np.hstack([slow.z, slow.z_dot]).T
        guess.control = np.hstack([slow.tau, slow.c_n]).T
        ocp.mesh.phase[index].collocation_points = count * [POINTS]
        ocp.mesh.phase[index].fraction = count * [1 / count]
    first, last = ocp.bounds.phase[0], ocp.bounds.phase[k - 1]
    first.initial_time.lower = first.initial_time.upper = 0.0
    first.initial_state.lower[:] = first.initial_state.upper[:] = [*curve.start, *5 * [0.0]]
    still = 5 + stretches[-1].progress
    last.final_state.lower[still] = last.final_state.upper[still] = 0.0
    ocp.bounds.discrete.lower[:] = ocp.bounds.discrete.upper[:] = 0.0
    ocp.derivatives.method, ocp.derivatives.order = "auto", "second"
    ocp.spectral_method = "lg"
    for name, value in IPOPT.items():
        setattr(ocp.ipopt_options, name, value)

    def run() -> PeerPlan:
        return _read(ocp.solve())

    return run


def _write_functions(ocp: Any, instance: Instance) -> None:
    """Objective, dynamics and the links of phases, traced by yapss with CasADi's symbols."""
    from yapss.math.wrapper import SXW

    curve, plant = instance.curve, build_plant(instance.curve.formation)

    def objective(arg: Any) -> None:
        arg.objective = arg.phase[len(curve.segments) - 1].final_time

    def continuous(arg: Any) -> None:
        for index in arg.phase_list:
            phase, part = arg.phase[index], curve.segments[index]
            state, control = ([_strip(x) for x in own] for own in (phase.state, phase.control))
            z, v = ca.vertcat(*state[:5]), ca.vertcat(*state[5:])
            tau, c_n = ca.vertcat(*control[:2]), ca.vertcat(*control[2:])
            acceleration, missed = plant(z, v, tau, c_n, part.Xi, part.sigma)
            rates = [*phase.state[5:], *(SXW(x) for x in ca.vertsplit(acceleration))]
            phase.dynamics[:] = tuple(rates)
            phase.path[:] = tuple(SXW(x) for x in ca.vertsplit(missed))

    def discrete(arg: Any) -> None:
        links = []
        for before, after in zip(arg.phase, arg.phase[1:], strict=False):
            links += [after.initial_time - before.final_time]
            links += [*(after.initial_state - before.final_state)]
        arg.discrete = links

    ocp.functions.objective, ocp.functions.continuous = objective, continuous
    if len(curve.segments) > 1:
        ocp.functions.discrete = discrete


def _strip(symbol: Any) -> Any:
    """The CasADi symbol in a wrapper."""
    return symbol._value if hasattr(symbol, "_value") else symbol.item()._value


def _read(solution: Any) -> PeerPlan:
    """The torques linear between collocation points: their polynomials swing wide in between."""
    status = solution.nlp_info.ipopt_status
    if status != 0:
        return NO_PLAN._replace(status=str(solution.nlp_info.ipopt_status_message))
    times, rows, marks = [], [], []
    for phase in solution.phase:
        tau = np.asarray(phase.control)[:2].T
        times.append([phase.initial_time, *np.ravel(phase.time_c), phase.final_time])
        rows.append(np.vstack([tau[:1], tau, tau[-1:]]))
        marks.append(float(phase.final_time))
    torque = TorqueProfile.join_rows(np.concatenate(times), np.concatenate(rows))
    return PeerPlan(OPTIMUM, marks[-1], torque, tuple(marks[:-1]))
