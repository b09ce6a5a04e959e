"""Planners that are compared: both domains of ours, toppra and yapss.

toppra: minimum-time parametrisation, with the internal force eliminated from the limits. yapss:
pseudospectral collocation.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import lru_cache, partial
from itertools import pairwise
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from ...common.arrays import Array, Expression
from ...contacts.formation import Formation
from ...geometry.curve import directions_of
from ...mechanics.dynamics import ONE, A, B, PathForces, build_force_rows, inverse
from ...mechanics.limits import make_limits
from ...mechanics.path_limits import PathLimits
from ...planning.lower_bound import bound_least_time
from ...planning.options import Objective, PlanOptions
from ...planning.path_domain.path_data import prepare
from ...planning.path_domain.path_mesh import make_grid
from ...planning.path_domain.path_nlp import LimitShape, build_path_nlp
from ...planning.path_domain.path_plan import plan_path
from ...planning.time_domain.time_plan import plan_phases
from ...results.torque import TorqueProfile
from .simulators import (
    NO_PLAN,
    OPTIMUM,
    Instance,
    Median,
    Method,
    PeerPlan,
    check_plan,
    find_reversals,
    make_slow_motion,
    measure,
    pick,
)

LEAST_TIME, NO_DRAG = "least time", "least time without viscous friction"
"""Studies: all phases, and the same without viscous friction."""


def build_plant(formation: Formation) -> Expression:
    """CasADi function (z, z', tau, c_n, Xi, sigma) -> (z'', A z'' + A' z')."""
    scene, n_c = formation.scene, formation.n_contacts
    z, v, c_n = ca.SX.sym("z", 5), ca.SX.sym("v", 5), ca.SX.sym("c_n", n_c)
    tau, Xi, sigma = ca.SX.sym("tau", 2), ca.SX.sym("Xi", n_c), ca.SX.sym("sigma", 2)
    _, P, P_dot_v, A_t = formation.build_constraints(z, v)
    friction = ca.DM(scene.viscous) * v + ca.DM(scene.dry) * ca.vertcat(0, 0, 0, sigma)
    applied = ca.DM(scene.applied_force) + ca.vertcat(0, 0, 0, tau) - friction
    G = build_force_rows(formation, P, A_t, Xi)
    acceleration = (applied + G.T @ c_n) / ca.DM(scene.mass_diagonal)
    missed = P @ acceleration + P_dot_v
    return ca.Function("plant", [z, v, tau, c_n, Xi, sigma], [acceleration, missed])


def run_planner(study: str, name: str, method: str, setting: str, files: tuple[str, ...]) -> Median:
    """Run one setting of one planner on one phase, and check its plans."""
    instance = pick(name, files, study != NO_DRAG)
    if module := PLANNERS[method].module:
        # No timing is to include the import.
        __import__(module)
    least = find_least_time(instance)

    def judge(plan: PeerPlan) -> tuple[tuple[float, ...], str]:
        end, violation, outcome = check_plan(instance, plan)
        error = plan.duration / least - 1 if plan.status == OPTIMUM else math.nan
        return (error, end, violation), outcome

    return measure(partial(PLANNERS[method].build, instance, setting), judge)


@lru_cache(maxsize=64)
def find_least_time(instance: Instance) -> float:
    """Lower bound of the least time by a sweep over speeds, which shares nothing with the NLP [s].

    That of a fine plan where there is none.
    """
    curve, epsilon = instance.curve, instance.problem.epsilon
    bound = bound_least_time((curve,), epsilon)
    if bound is not None:
        return bound.value
    return plan_path(curve, epsilon, PlanOptions(accuracy=1e-7), 1).motion.duration


def _build_on_curve(instance: Instance, setting: str) -> Callable[[], PeerPlan]:
    """Ours along the curve; its NLP is built anew."""
    curve, epsilon = instance.curve, instance.problem.epsilon
    options = PlanOptions(accuracy=float(setting))
    build_path_nlp.cache_clear()
    data = prepare(curve, epsilon, make_grid(curve, np.zeros(0), 10), 1)
    build_path_nlp(LimitShape.of(data.limits), len(data.grid.steps), Objective.TIME)

    def run() -> PeerPlan:
        plan = plan_path(curve, epsilon, options, 1)
        return PeerPlan(OPTIMUM, plan.motion.duration, plan.torque)

    return run


def _build_over_time(instance: Instance, setting: str) -> Callable[[], PeerPlan]:
    """Ours over time; a setting is the number of intervals, and the degree."""
    intervals, degree = map(int, setting.split(" x "))
    options = PlanOptions(time_intervals=intervals, degree=degree, transcription="time")
    problem = instance.problem

    def run() -> PeerPlan:
        (plan,) = plan_phases(problem, problem.phases, problem.start, options)
        return PeerPlan(OPTIMUM, plan.motion.duration, plan.torque)

    return run


def _limit(instance: Instance, s: Array, owner: NDArray[np.int64]) -> tuple[PathForces, PathLimits]:
    """Forces and limits at places of a curve, whose segments are `owner`."""
    curve, point = instance.curve, instance.curve.evaluate(s)
    forces = inverse(curve.formation, *point[:3], directions_of(curve, owner))
    limits = make_limits(curve.formation, instance.problem.epsilon)
    return forces, PathLimits.of(limits, forces, point.z_s[:, 3:])


def build_toppra(instance: Instance, setting: str) -> Callable[[], PeerPlan]:
    """Limits on a grid that is fine towards the ends, kept at both ends of every interval."""
    import toppra
    from toppra.constraint import DiscretizationType, LinearConstraint
    from toppra.constraint.linear_constraint import canlinear_colloc_to_interpolate

    toppra.setup_logging("ERROR")
    length = instance.curve.length
    apart = 1e-7 * length  # of grid points from a reversal between them
    grid = length * (1 - np.cos(np.linspace(0.0, np.pi, int(setting) + 1))) / 2
    for part in instance.curve.segments[:-1]:
        near = np.abs(grid - part.stop) > 4 * apart
        grid = np.append(grid[near], part.stop + apart * np.array([-1.0, 1.0]))
        grid.sort()
    stops = [part.stop for part in instance.curve.segments[:-1]]
    _, limits = _limit(instance, grid, np.searchsorted(stops, grid))
    rows = limits.eliminate().rows
    constant, a, b = (rows[:, rows[..., A].any(axis=0), column] for column in (ONE, A, B))
    below, zero = -np.eye(a.shape[1]), np.zeros(a.shape[1])

    class Limits(LinearConstraint):  # type: ignore[misc]
        """Limits with the internal force eliminated."""

        def __init__(self) -> None:
            super().__init__()
            self.identical = True
            self.set_discretization_type(DiscretizationType.Interpolation)

        def compute_constraint_params(self, *_: Any) -> Any:
            return canlinear_colloc_to_interpolate(
                a, b, constant, below, zero, None, None, grid, identical=True
            )

    path = toppra.SplineInterpolator(grid, grid[:, None])
    planner = toppra.algorithm.TOPPRA(
        [Limits()],
        path,
        gridpoints=grid,
        solver_wrapper="seidel",
        parametrizer="ParametrizeConstAccel",
    )

    def run() -> PeerPlan:
        _, speeds, _ = planner.compute_parameterization(0.0, 0.0)
        if speeds is None or not np.isfinite(speeds).all():
            return NO_PLAN._replace(status="no feasible parametrisation")
        return _make_plan(instance, grid, np.asarray(speeds))

    return run


def _make_plan(instance: Instance, grid: Array, speeds: Array) -> PeerPlan:
    """Torques by inverse dynamics, with the internal force linear between grid points.

    The two points beside a reversal become one, with a step of the torques.
    """
    stops = np.array([part.stop for part in instance.curve.segments[:-1]])
    for stop in stops:
        k = int(np.searchsorted(grid, stop)) - 1
        speed = (speeds[k] + speeds[k + 1]) / 2
        grid, speeds = (
            np.concatenate([part[:k], [middle], part[k + 2 :]])
            for part, middle in ((grid, stop), (speeds, speed))
        )
    steps, b = np.diff(grid), speeds**2
    a = np.diff(b) / (2 * steps)
    times = np.append(0.0, np.cumsum(2 * steps / (speeds[1:] + speeds[:-1])))
    owner = np.searchsorted(stops, (grid[1:] + grid[:-1]) / 2)
    ends = [
        np.mean(_limit(instance, grid[p], owner)[1].find_internal_force_range(a, b[p]), axis=0)
        for p in (slice(-1), slice(1, None))
    ]

    def torque(t: Array) -> Array:
        k = np.clip(np.searchsorted(times, t, side="right") - 1, 0, len(a) - 1)
        local = t - times[k]
        run = np.clip(local * (speeds[k] + a[k] * local / 2), 0.0, steps[k])
        part = run / steps[k]
        internal = ends[0][k] * (1 - part) + ends[1][k] * part
        forces, _ = _limit(instance, grid[k] + run, owner[k])
        return forces.tau(a[k], (speeds[k] + a[k] * local) ** 2, internal)

    profile = TorqueProfile.fit(times, torque, 4)
    return PeerPlan(OPTIMUM, float(times[-1]), profile)


def build_yapss(instance: Instance, setting: str) -> Callable[[], PeerPlan]:
    """A phase for every stretch, with contact forces among the controls, on Legendre-Gauss points.

    The slow motion is the first guess.
    """
    import yapss

    curve, slow = instance.curve, make_slow_motion(instance, 5)
    n_c, k = curve.formation.n_contacts, len(curve.segments)
    s = np.array([0.0, *(part.stop for part in curve.segments)])
    counts = [max(4, round(int(setting) * share)) for share in np.diff(s) / curve.length]
    ends = curve.evaluate(s).z
    # The coordinate that runs along the phase: x, or phi where the object turns.
    progress = 2 if abs(ends[-1] - ends[0])[2] > 1e-6 else 0
    ocp = yapss.Problem(
        name="phase", nx=k * [10], nu=k * [2 + n_c], nh=k * [n_c], nq=k * [0], nd=11 * (k - 1)
    )
    _write_functions(ocp, instance)
    limit = curve.formation.scene.torque_limit
    marks = pairwise(find_reversals(slow))
    for index, (count, (start, stop)) in enumerate(zip(counts, marks, strict=True)):
        bounds, guess = ocp.bounds.phase[index], ocp.guess.phase[index]
        bounds.control.lower[:] = [*-limit, *n_c * [instance.problem.epsilon]]
        bounds.control.upper[:2] = limit
        bounds.path.lower[:] = bounds.path.upper[:] = 0.0
        bounds.duration.lower = 1e-3
        last = bounds.final_state
        last.lower[progress] = last.upper[progress] = ends[index + 1, progress]
        guess.time = np.linspace(start, stop, 2 * count + 1)
        # The ends of a stretch are evaluated within it.
        inset = 1e-9 * (stop - start)
        samples = slow.evaluate(np.clip(guess.time, start + inset, stop - inset))
        guess.state = np.hstack([samples.z, samples.z_dot]).T
        guess.control = np.hstack([samples.tau, samples.c_n]).T
        ocp.mesh.phase[index].collocation_points = count * [2]
        ocp.mesh.phase[index].fraction = count * [1 / count]
    first, last = ocp.bounds.phase[0], ocp.bounds.phase[k - 1].final_state
    first.initial_time.lower = first.initial_time.upper = 0.0
    first.initial_state.lower[:] = first.initial_state.upper[:] = [*curve.start, *5 * [0.0]]
    last.lower[5 + progress] = last.upper[5 + progress] = 0.0
    ocp.bounds.discrete.lower[:] = ocp.bounds.discrete.upper[:] = 0.0
    ocp.derivatives.method, ocp.derivatives.order = "auto", "second"
    ocp.spectral_method = "lg"
    for name, value in {
        "print_level": 0, "sb": "yes", "tol": 1e-8, "bound_relax_factor": 0.0, "max_iter": 1000,
        "mu_strategy": "adaptive",
    }.items():  # fmt: skip
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
    times, rows = [], []
    for phase in solution.phase:
        tau = np.asarray(phase.control)[:2].T
        times.append([phase.initial_time, *np.ravel(phase.time_c), phase.final_time])
        rows.append(np.vstack([tau[:1], tau, tau[-1:]]))
    torque = TorqueProfile.join_rows(np.concatenate(times), np.concatenate(rows))
    return PeerPlan(OPTIMUM, float(times[-1][-1]), torque)


_CURVE = ("1e-2", "1e-3", "1e-4", "1e-5", "1e-6")
PLANNERS = {
    "wholearm, curve": Method(
        "accuracy; limits tightened between nodes included",
        _build_on_curve,
        {LEAST_TIME: _CURVE, NO_DRAG: _CURVE},
    ),
    "wholearm, time": Method(
        "Radau, intervals x degree; linear torques, refinement included",
        _build_over_time,
        {LEAST_TIME: ("8 x 3", "16 x 3", "32 x 3", "16 x 2", "16 x 4")},
    ),
    "yapss": Method(
        "two Legendre-Gauss points a segment, automatic second derivatives; adaptive barrier, the "
        "slow motion",
        build_yapss,
        {LEAST_TIME: ("20", "40", "80", "160")},
        "yapss",
    ),
    "toppra": Method(
        "Seidel, limits at both ends of intervals, squeeze eliminated after Fourier and Motzkin",
        build_toppra,
        {NO_DRAG: ("50", "100", "200", "400", "800", "1600", "3200")},
        "toppra",
    ),
}
"""Planners by name."""
