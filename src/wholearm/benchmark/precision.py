"""Run time against error, of planners and simulators, with public tools beside them.

Methods run on phases of one freedom, on four sliding contacts. Planners are ours along curves,
toppra (minimum-time parametrisation, with the internal force eliminated from the limits) and yapss
(pseudospectral collocation). All simulators but ours are told when directions reverse, from the
reference, and are restarted there and where the torques step. Plans are replayed open loop from
rest by the equations of the reference; lost contacts pull by what is measured.

The reference solves the Newton-Euler equations of object and fingers, with contacts that are points
with normals of rigid bodies (`verification.newton_euler`), together with the contact conditions as
one linear system. Nothing is shared with the package's own contacts and dynamics; friction keeps
the directions that it is given. They are integrated by SciPy's DOP853 from step to step of the
torques, in double precision. Directions reverse where the sliding velocity vanishes.
"""

from __future__ import annotations

import argparse
import math
import time
import warnings
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import lru_cache, partial
from importlib.util import find_spec
from itertools import chain, pairwise, product
from pathlib import Path
from timeit import Timer
from typing import TYPE_CHECKING, Any, NamedTuple

import casadi as ca
import numpy as np
from scipy.integrate import solve_ivp
from scipy.stats import gmean

from ..common.arrays import Array, Expression, Numbers
from ..common.document import Table
from ..common.errors import InputError
from ..contacts.formation import Formation
from ..figures.style import GRID, PALETTE, open_figure
from ..geometry.curve import Curve, Segment, directions_of
from ..geometry.tracing import trace_phases
from ..mechanics.dynamics import ONE, A, B, build_force_rows, inverse
from ..mechanics.limits import make_limits
from ..mechanics.path_limits import PathLimits
from ..planning.lower_bound import bound_least_time
from ..planning.options import Objective, PlanOptions
from ..planning.path_domain.path_data import prepare
from ..planning.path_domain.path_mesh import make_grid
from ..planning.path_domain.path_motion import NODES, PathMotion, Profile, lay_out
from ..planning.path_domain.path_plan import LimitShape, Task, build_path_nlp, guess, plan_curves
from ..problem.definition import End, Problem
from ..problem.read import read_problem
from ..results.torque import TorqueProfile
from ..simulation.simulate import simulate
from ..verification.newton_euler import locate
from .refusals import slides
from .study import Case, Findings, Row, Study, group

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

SHIFT = 0.01  # shift of the geometric means [s]
SOLVED = "solved"
SIMULATION = FEW, MANY = "simulation, few pieces", "simulation, many pieces"
"""Studies of simulators: torques in a few long pieces, and planned torques in eighty."""
PLANNING = LEAST_TIME, NO_DRAG = "least time", "least time without viscous friction"
"""Studies of planners: all phases, and the same without viscous friction."""


class Instance(NamedTuple):
    """One phase from rest to rest."""

    name: str  # of the file, and the number of the phase
    problem: Problem  # of that phase alone
    curve: Curve


@lru_cache(maxsize=4)
def list_instances(paths: tuple[str, ...], drag: bool = True) -> tuple[Instance, ...]:
    """First phases of problem files that are curves of four sliding contacts: what peers know.

    Those that files share are there once. Without `drag` joints have no viscous friction.
    """
    instances: dict[object, Instance] = {}
    for path in paths:
        problem = read_problem(path)
        problem = problem if drag else problem.with_(viscous=0.0)
        scene = problem.scene
        for phase, curve in zip(problem.phases, trace_phases(problem), strict=False):
            if phase.formation.rolling:
                break
            single = replace(phase, index=0, end=End.REST)
            alone = replace(problem, start=curve.start, phases=(single,))
            places = np.round(np.append(curve.start, curve.end), 9) + 0.0
            limits = (problem.epsilon, *scene.torque_limit, *scene.speed_limit)
            same = scene.equations, limits, phase.formation.names, tuple(places)
            name = f"{Path(path).stem} {phase.number}"
            instances.setdefault(same, Instance(name, alone, curve))
    return tuple(instances.values())


Plan = TorqueProfile | str
"""The torques that a planner has found for one phase, or why it has not."""


def make_slow_motion(instance: Instance, intervals: int, share: float = 1.0) -> PathMotion:
    """The motion that the planner guesses first, with a share of its squared speed."""
    curve = instance.curve
    grid = make_grid(curve, np.zeros(0), intervals + len(curve.segments))
    data = prepare(curve, instance.problem.epsilon, grid, 0)
    profile, _ = guess(data)
    slow = profile._replace(a=share * profile.a, b=share * profile.b)
    return PathMotion(curve, data.grid, slow)


def find_reversals(motion: PathMotion) -> Array:
    """Times at which the stretches of a motion begin and the last one ends [s]."""
    last = np.flatnonzero(np.diff(motion.grid.segment, append=-1))
    return np.append(0.0, motion.times[last])


class Method(NamedTuple):
    """A planner or a simulator."""

    settings: str  # what it is told besides the setting
    # takes a phase or a course, and a setting; gives what solves it
    build: Callable[[Any, str], Callable[[], Any]]
    choices: dict[str, tuple[str, ...]]  # settings that are measured, by study
    module: str = ""  # what has to be installed, if anything


def run_setting(instance: Instance, study: str, method: str, setting: str) -> Row:
    """Run one setting of one method on one phase; nothing of a simulator without a course.

    `build` and `solve` are the times that takes [s], `errors` that of the state at the end, or of
    the phase time and as of `check_plan`.
    """
    subject = instance if study in PLANNING else make_course(instance, study)
    if subject is None:
        return {}
    own, least = METHODS[method], find_least_time(instance) if study in PLANNING else math.nan
    if own.module:
        # No timing is to include the import.
        __import__(own.module)
    with warnings.catch_warnings():
        # Warnings of peers are not ours.
        warnings.simplefilter("ignore")
        built, run = _time(partial(own.build, subject, setting))
        took, answer = _time(run)
    if isinstance(subject, Course):
        errors = [measure_error(subject.problem, answer, subject.end)]
        outcome = SOLVED if np.isfinite(errors[0]) else "no finite state"
    else:
        *checked, outcome = check_plan(instance, answer)
        late = math.nan if isinstance(answer, str) else answer.duration / least - 1
        errors = [late, *checked]
    return {"build": built, "solve": took, "errors": errors, "outcome": outcome}


def _time(work: Callable[[], Any]) -> tuple[float, Any]:
    """Mean processor time of as many runs as take 0.2 s, one at least [s], and the last answer.

    Other work on the machine hardly changes it.
    """
    answers = deque[Any](maxlen=1)
    timer = Timer(lambda: answers.append(work()), timer=time.process_time)
    count, seconds = timer.autorange()
    return seconds / count, answers[0]


def find_mean(seconds: Sequence[float]) -> float:
    """Shifted geometric mean [s]."""
    return float(gmean(np.array(seconds) + SHIFT)) - SHIFT


def solve_motion(
    formation: Formation, z: Array, z_dot: Array, tau: Array, Xi: Array, sigma: Array
) -> tuple[Array, Array]:
    """Accelerations z'', shape (5,), and c_n, shape (n_c,) [N], from one linear system.

    The unknowns are those of Eqs. (1) and (2) with the friction of Eq. (3) put in, together with
    the contact conditions differentiated twice: rates of their rows by complex steps.
    """
    tiny, scene = 1e-30, formation.scene  # [s]
    ahead = (z + 1j * tiny * z_dot)[None]
    touches = [locate(scene, name, ahead) for name in formation.names]
    rows = np.array([touch.normal[0] for touch in touches])
    slide = np.array([touch.friction * touch.tangent[0].real for touch in touches])
    friction = scene.viscous * z_dot + scene.dry * np.append(np.zeros(3), sigma)
    force = scene.applied_force + np.append(np.zeros(3), tau) - friction
    count = len(rows)
    matrix = np.zeros((5 + count, 5 + count))
    matrix[range(5), range(5)] = scene.mass_diagonal
    matrix[:5, 5:], matrix[5:, :5] = (Xi[:, None] * slide - rows.real).T, rows.real
    solution = np.linalg.solve(matrix, np.append(force, -rows.imag @ z_dot / tiny))
    return np.asarray(solution[:5]), np.asarray(solution[5:])


class Course(NamedTuple):
    """One phase with torques, and where it gets to."""

    problem: Problem  # of that phase alone
    torque: TorqueProfile
    stretches: list[Array]  # as of `integrate`
    end: Array  # (10,): state (z, z') when the torques end


def measure_error(problem: Problem, state: Array, exact: Array) -> float:
    """Largest difference of two states (z, z'), relative to length and time of the scene."""
    scales = problem.scene.scales
    unit = np.array([scales.length, scales.length, 1.0, 1.0, 1.0])
    return float(np.abs((state - exact) / np.append(unit, unit / scales.time)).max())


def integrate(
    problem: Problem, torque: TorqueProfile, curve: Curve, tolerance: float
) -> tuple[Array, list[Array], float]:
    """State at the end of torques, the stretches on the way there, and the least c_n of all steps.

    A stretch is in one piece of the torques, without a reversal: Xi, sigma, coefficients of its
    torques column by column, and its ends. Contacts stay closed: those that are lost pull.
    """

    def solve(t: float, y: Array, part: Segment, own: TorqueProfile) -> tuple[Array, Array]:
        tau = own.at(np.array([t]))[0]
        return solve_motion(curve.formation, y[:5], y[5:], tau, part.Xi, part.sigma)

    def rates(t: float, y: Array, *at: Any) -> Array:
        return np.concatenate([y[5:], solve(t, y, *at)[0]])

    parts, t = [*curve.segments], float(torque.breaks[0])
    y, stretches, least = np.append(problem.start, np.zeros(5)), list[Array](), np.inf
    for stop in torque.breaks[1:]:
        while t < stop:
            part, profile = at = parts[0], torque.cut(t, stop)
            events = [_find_reversal(curve.formation, *parts[:2])] if len(parts) > 1 else []
            options: Any = {"events": events, "rtol": tolerance, "atol": tolerance}
            run = solve_ivp(rates, (t, stop), y, "DOP853", args=at, **options)
            forces = (solve(*state, *at)[1] for state in zip(run.t, run.y.T, strict=True))
            least = min(least, *map(np.min, forces))
            start, t, y = t, float(run.t[-1]), run.y[:, -1]
            own = profile.cut(start, t).coefficients[0].ravel("F")
            stretches.append(np.concatenate([part.Xi, part.sigma, own, [start, t]]))
            parts = parts[1:] if run.status == 1 else parts
    return y, stretches, float(least)


def _find_reversal(formation: Formation, before: Segment, after: Segment) -> Any:
    """Event at which the rate vanishes whose direction differs in two segments."""
    directions = np.append(before.Xi, before.sigma)
    row = int(np.flatnonzero(directions * np.append(after.Xi, after.sigma) < 0)[0])

    def rate(_: float, y: Array, *__: Any) -> float:
        return float(slides(formation, y[None, :5], y[None, 5:])[0, row])

    rate.terminal, rate.direction = True, -directions[row]  # type: ignore[attr-defined]
    return rate


TOLERANCES = {
    FEW: ("0.0001", *(f"1e-{k:02}" for k in range(6, 14))),
    MANY: ("1e-06", "1e-09", "1e-12"),
}


def build_own(course: Course, setting: str) -> Callable[[], Array]:
    """Our simulator, for the state (z, z') at the end of a course, shape (10,).

    What it keeps of a formation is built by a first run.
    """

    def run() -> Array:
        simulation = simulate(course.problem, course.torque, tolerance=float(setting))
        return np.append(simulation.z[-1], simulation.z_dot[-1])

    run()
    return run


def build_cvodes(course: Course, setting: str) -> Callable[[], Array]:
    """CasADi's interface to cvodes; all stretches are one call, by `mapaccum`."""
    formation = course.problem.phases[0].formation
    n_c, terms = formation.n_contacts, course.torque.coefficients.shape[2]
    sizes = {"x": 1, "y": 10, "Xi": n_c, "sigma": 2, "flat": 2 * terms, "ends": 2}
    x, y, Xi, sigma, flat, ends = (ca.SX.sym(name, size) for name, size in sizes.items())
    # Coefficients come column by column.
    tau = ca.reshape(flat, 2, -1) @ x ** ca.DM(range(terms))
    # Accelerations of the contacts are affine in the forces, and have to vanish.
    plant, c_n = build_plant(formation), ca.SX.sym("c_n", n_c)
    of_forces, apart = ca.linear_coeff(plant(y[:5], y[5:], tau, c_n, Xi, sigma)[1], c_n)
    forces = -ca.solve(of_forces, apart)
    rates = ca.vertcat(y[5:], plant(y[:5], y[5:], tau, forces, Xi, sigma)[0])
    half = (ends[1] - ends[0]) / 2
    system = {"x": y, "t": x, "p": ca.vertcat(Xi, sigma, flat, ends), "ode": half * rates}
    options: dict[str, Any] = dict.fromkeys(("abstol", "reltol"), float(setting))
    options |= {"linear_multistep_method": "adams", "nonlinear_solver_iteration": "functional"}
    options["max_num_steps"] = 100000
    step = ca.integrator("step", "cvodes", system, -1.0, 1.0, options)
    chain = step.mapaccum(len(course.stretches))
    start, parameters = np.append(course.problem.start, np.zeros(5)), np.array(course.stretches).T

    def run() -> Array:
        states = chain(x0=start, p=parameters)["xf"]
        return np.asarray(states[:, -1].full()[:, 0])

    return run


SIMULATORS = {
    "wholearm": Method("events, contact forces and energies included", build_own, TOLERANCES),
    "cvodes": Method(
        "abstol = reltol = tolerance; Adams, functional iteration; all stretches in one call",
        build_cvodes,
        TOLERANCES,
    ),
}


@lru_cache(maxsize=64)
def make_course(instance: Instance, study: str) -> Course | None:
    """The course of a phase: of 95 % of its last stretch, as just before a stop all is ill-posed.

    None if the slow motion would lose a contact.
    """
    problem, curve = instance.problem, instance.curve
    if study == FEW:
        motion, degree = make_slow_motion(instance, 2, 0.3), 14
    else:
        task = Task((curve,), problem.epsilon, PlanOptions(), (1,))
        motion, degree = plan_curves(task)[0].motion, 6
    if motion.evaluate(np.linspace(0.0, motion.duration, 201)).c_n.min() <= 0:
        return None
    marks = find_reversals(motion)
    stop = marks[-2] + 0.95 * (marks[-1] - marks[-2])
    breaks = motion.times[np.append(motion.grid.steps > 0, True)]
    breaks = np.append(breaks[breaks < stop], stop)
    torque = TorqueProfile.fit(breaks, lambda t: motion.evaluate(t).tau, degree)
    # The smallest tolerance that SciPy takes.
    end, stretches, _ = integrate(problem, torque, curve, 2.3e-14)
    return Course(problem, torque, stretches, end)


def check_plan(instance: Instance, plan: Plan) -> tuple[float, float, str]:
    """Error of the replayed end state, worst violation, and `SOLVED` or why the plan is none.

    The violation is of c_n >= epsilon, over the scene's force, or of a torque limit, over it.
    """
    if isinstance(plan, str):
        return math.nan, math.nan, plan
    problem, curve = instance.problem, instance.curve
    state, _, least = integrate(problem, plan, curve, 1e-10)
    end = measure_error(problem, state, np.append(curve.end, np.zeros(5)))
    excess = float((plan.peaks / problem.scene.torque_limit).max()) - 1
    violation = max(0.0, excess, (problem.epsilon - least) / problem.scene.scales.force)
    tests = (
        (least > 0, "a contact is lost between nodes"),
        (end <= 1e-2, "the replay ends elsewhere"),
        (excess <= 1e-2, "a torque limit is missed between nodes"),
    )
    outcome = next((text for holds, text in tests if not holds), SOLVED)
    return end, violation, outcome


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


@lru_cache(maxsize=64)
def find_least_time(instance: Instance) -> float:
    """Lower bound of the least time by a sweep over speeds, which shares nothing with NLPs [s]."""
    bound = bound_least_time((instance.curve,), instance.problem.epsilon)
    assert bound is not None, "phases of four sliding contacts have one"
    return bound.value


def _build_on_curve(instance: Instance, setting: str) -> Callable[[], Plan]:
    """Ours along the curve; its NLP is built anew."""
    curve, epsilon = instance.curve, instance.problem.epsilon
    options = PlanOptions(accuracy=float(setting))
    build_path_nlp.cache_clear()
    data = prepare(curve, epsilon, make_grid(curve, np.zeros(0), 10), 1)
    build_path_nlp(LimitShape.of(data), len(data.grid.steps), Objective.TIME)
    return lambda: plan_curves(Task((curve,), epsilon, options, (1,)))[0].torque


def _limit(instance: Instance, s: Array, owner: Numbers) -> PathLimits:
    """Limits at places of a curve, whose segments are `owner`."""
    curve, point = instance.curve, instance.curve.evaluate(s)
    forces = inverse(curve.formation, point, directions_of(curve, owner))
    limits = make_limits(curve.formation, instance.problem.epsilon)
    return PathLimits.of(limits, forces, point.z_s[:, 3:])


def build_toppra(instance: Instance, setting: str) -> Callable[[], Plan]:
    """Limits on a grid that is fine towards the ends, kept at both ends of every interval."""
    import toppra
    from toppra.constraint import DiscretizationType, LinearConstraint
    from toppra.constraint.linear_constraint import canlinear_colloc_to_interpolate

    toppra.setup_logging("ERROR")
    length = instance.curve.length
    apart = 1e-7 * length  # of grid points from a reversal between them
    grid = length * (1 - np.cos(np.linspace(0.0, np.pi, int(setting) + 1))) / 2
    stops = [part.stop for part in instance.curve.segments[:-1]]
    for stop in stops:
        far = grid[np.abs(grid - stop) > 4 * apart]
        grid = np.sort([*far, stop - apart, stop + apart])
    rows = _limit(instance, grid, np.searchsorted(stops, grid)).eliminate().rows
    constant, a, b = (rows[:, rows[..., A].any(axis=0), column] for column in (ONE, A, B))
    below, zero = -np.eye(a.shape[1]), np.zeros(a.shape[1])

    # The parameters of the limits, with the internal force eliminated, are those of the grid.
    limits, columns = LinearConstraint(), (a, b, constant, below, zero, None, None, grid)
    limits.identical = True
    limits.set_discretization_type(DiscretizationType.Interpolation)
    parameters = canlinear_colloc_to_interpolate(*columns, identical=True)
    limits.compute_constraint_params = lambda *_: parameters
    path = toppra.SplineInterpolator(grid, grid[:, None])
    options = {"solver_wrapper": "seidel", "parametrizer": "ParametrizeConstAccel"}
    planner = toppra.algorithm.TOPPRA([limits], path, gridpoints=grid, **options)

    def run() -> Plan:
        _, speeds, _ = planner.compute_parameterization(0.0, 0.0)
        if speeds is None or not np.isfinite(speeds).all():
            return "no feasible parametrisation"
        return _make_plan(instance, grid, np.asarray(speeds))

    return run


def _make_plan(instance: Instance, grid: Array, speeds: Array) -> TorqueProfile:
    """Torques by inverse dynamics, with the internal force linear between grid points.

    The two points beside a reversal become one, with a step of the torques.
    """
    stops = np.array([part.stop for part in instance.curve.segments[:-1]])
    later = np.searchsorted(grid, stops)
    grid, speeds = grid.copy(), speeds.copy()
    grid[later], speeds[later] = stops, (speeds[later - 1] + speeds[later]) / 2
    grid, speeds = (np.delete(part, later - 1) for part in (grid, speeds))
    steps, b = np.diff(grid), speeds**2
    a, owner = np.diff(b) / (2 * steps), np.searchsorted(stops, (grid[1:] + grid[:-1]) / 2)
    ends = [
        np.mean(_limit(instance, grid[p], owner).find_internal_force_range(a, b[p]), axis=0)
        for p in (slice(-1), slice(1, None))
    ]
    elements = lay_out(np.column_stack([grid[:-1], grid[1:]]), owner, (True, True))
    each = np.repeat(np.arange(len(steps)), NODES)
    part = (elements.s - grid[each]) / steps[each]
    internal = ends[0][each] * (1 - part) + ends[1][each] * part
    profile = Profile(a[each], np.interp(elements.s, grid, b), internal)
    motion = PathMotion(instance.curve, elements, profile)
    breaks = np.append(motion.times[::NODES], motion.duration)
    return TorqueProfile.fit(breaks, lambda t: motion.evaluate(t).tau, 4)


def build_yapss(instance: Instance, setting: str) -> Callable[[], Plan]:
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
    ocp.spectral_method, ipopt = "lg", ocp.ipopt_options
    ipopt.print_level, ipopt.sb, ipopt.max_iter = 0, "yes", 1000
    ipopt.tol, ipopt.bound_relax_factor, ipopt.mu_strategy = 1e-8, 0.0, "adaptive"
    return lambda: _read(ocp.solve())


def _write_functions(ocp: Any, instance: Instance) -> None:
    """Objective, dynamics and the links of phases, traced by yapss with CasADi's symbols."""
    from yapss.math.wrapper import SXW

    curve, plant = instance.curve, build_plant(instance.curve.formation)

    def objective(arg: Any) -> None:
        arg.objective = arg.phase[len(curve.segments) - 1].final_time

    def continuous(arg: Any) -> None:
        for index in arg.phase_list:
            phase, part = arg.phase[index], curve.segments[index]
            # CasADi symbols in wrappers.
            symbols = [*phase.state, *phase.control]
            x = ca.vertcat(*((x if hasattr(x, "_value") else x.item())._value for x in symbols))
            parts = ca.vertsplit(x, [0, 5, 10, 12, len(symbols)])
            acceleration, missed = map(ca.vertsplit, plant(*parts, part.Xi, part.sigma))
            phase.dynamics[:] = (*phase.state[5:], *map(SXW, acceleration))
            phase.path[:] = tuple(map(SXW, missed))

    def discrete(arg: Any) -> None:
        links = list[Any]()
        for before, after in pairwise(arg.phase):
            links.append(after.initial_time - before.final_time)
            links += [*(after.initial_state - before.final_state)]
        arg.discrete = links

    ocp.functions.objective, ocp.functions.continuous = objective, continuous
    if len(curve.segments) > 1:
        ocp.functions.discrete = discrete


def _read(solution: Any) -> Plan:
    """The torques linear between collocation points: their polynomials swing wide in between."""
    if solution.nlp_info.ipopt_status != 0:
        return str(solution.nlp_info.ipopt_status_message)
    rows = []
    for phase in solution.phase:
        tau = np.asarray(phase.control)[:2].T
        t = [phase.initial_time, *np.ravel(phase.time_c), phase.final_time]
        rows.append(np.column_stack([t, np.vstack([tau[:1], tau, tau[-1:]])]))
    return TorqueProfile.join_rows(np.concatenate(rows))


_CURVE = ("1e-2", "1e-3", "1e-4", "1e-5", "1e-6")
PLANNERS = {
    "wholearm, curve": Method(
        "accuracy; limits tightened between nodes included",
        _build_on_curve,
        {LEAST_TIME: _CURVE, NO_DRAG: _CURVE},
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


METHODS = SIMULATORS | PLANNERS  # all methods by name, in the order of the tables
MARKERS = "osD^"  # markers of the methods of a panel


INTRODUCTION = f"""\
Times are those of the processor in one thread; what takes less than 0.2 s is averaged over that
time. Means are geometric ones, shifted by {1e3 * SHIFT:g} ms, over the phases of all problems, each
with the setting that reaches the error soonest; what does not reach it counts with the time limit.

Phases whose slow motion would lose a contact have no few pieces of torque, and where a method was
not run on a phase, ours does not count there either.

Errors of states are relative to the scene's length and time. A plan counts as solved if its
torques, replayed open loop by other equations than its own, keep every contact and end within 1e-2
of the end. Its three errors are those of the phase time, against the lower bound of `solve
--certify`, of the replayed end state, and the worst violation between nodes, over the object's
weight or the torque limit."""


TARGETS = dict.fromkeys(SIMULATION, (1e-6, 1e-9, 1e-11)) | dict.fromkeys(
    PLANNING, (1e-2, 1e-3, 1e-4)
)
"""Errors at which run times are compared, by study."""


def _find_times(rows: Sequence[Row], target: float, count: int | None) -> dict[str, float]:
    """Least times in which a method reaches an error on each phase [s]; infinite without any.

    With planners the time to build counts; `count` of their errors have to be small, or all.
    """
    times: dict[str, float] = {}
    for row in rows:
        error = max(map(abs, row["errors"][:count]))
        took = row["solve"] + (row["build"] if row["study"] in PLANNING else 0.0)
        reached = took if row["outcome"] == SOLVED and error <= target else math.inf
        times[row["phase"]] = min(times.get(row["phase"], math.inf), reached)
    return times


def _format_targets(
    rows: Sequence[Row], study: str, title: str, count: int | None, limit: float
) -> list[str | Table]:
    """Times to reach errors, and how many times as long as ours that is."""
    groups, table = group(rows, "method"), []
    own = groups.get("wholearm, curve" if study in PLANNING else "wholearm")
    if own is None:
        return []
    for method, mine in groups.items():
        cells: list[Any] = [method]
        for target in TARGETS[study]:
            times, ours = (_find_times(part, target, count) for part in (mine, own))
            names = times.keys() & ours.keys()
            reached = sum(math.isfinite(times[name]) for name in names)
            mean, least = (
                find_mean([min(part[name], limit) for name in names] or [math.nan])
                for part in (times, ours)
            )
            shown = (mean, mean / least) if reached else (None, None)
            cells += [shown[0], f"{reached} of {len(names)}", shown[1]]
        table.append(cells)
    heads = [(f"{t:g} [s]:.4f", "reached", "times ours:.2g") for t in TARGETS[study]]
    title = f"## {study[0].upper()}{study[1:]}{title}"
    return [title, Table(["method", *chain(*heads)], table)]


def _draw_study(axes: Axes, rows: Sequence[Row], study: str) -> None:
    """One panel; hollow markers are settings with which some phases are not solved."""
    planning = study in PLANNING
    for index, (method, mine) in enumerate(group(rows, "method").items()):
        points, hollow = list[tuple[float, float]](), list[tuple[float, float]]()
        for phases in group(mine, "setting").values():
            finite_rows = [row for row in phases if np.isfinite(row["errors"][0])]
            if 2 * len(finite_rows) < len(phases):
                continue
            error = float(np.median([abs(row["errors"][0]) for row in finite_rows]))
            seconds = find_mean([row["solve"] + planning * row["build"] for row in finite_rows])
            points.append((max(error, 1e-16), seconds))
            hollow += points[-1:] * any(row["outcome"] != SOLVED for row in phases)
        look: Any = {"color": PALETTE[index], "marker": MARKERS[index], "markersize": 5}
        axes.loglog(*np.reshape(points, (-1, 2)).T, label=method, **look)
        look |= {"markerfacecolor": "white", "linestyle": "", "zorder": 3}
        axes.loglog(*np.reshape(hollow, (-1, 2)).T, **look)
    axes.set_title(f"{study[0].upper()}{study[1:]}")
    what = "relative error of the phase time" if planning else "error of z and z' in scene units"
    axes.set_xlabel(f"{what}, median over phases [-]")
    axes.set_ylabel(f"{'build and solve' if planning else 'run'} time, mean over phases [s]")
    axes.grid(True, which="major", color=GRID, linewidth=0.6)
    if axes.lines:
        axes.legend(fontsize=8, ncols=2)


class Precision(Study):
    """Every setting of every method on every phase of four sliding contacts."""

    name, title, timed = "precision", "Run time against error, with peers", True
    keys = ("study", "phase", "method", "setting")
    columns = (*keys, "build", "solve", "errors", "outcome")
    shipped = True
    allowed = 60.0
    options = """\
--peers NAME ...  measure these methods only, by the names that the table has (all)
--limit S         processor time that one setting may take on one phase [s] = 60.0 in 1e-3..1e6
"""

    def list_cases(self, options: argparse.Namespace) -> Iterator[Case]:
        """Study, phase, method, setting, and the files that phases are from."""
        self.allowed = options.limit
        files = tuple(map(str, sorted(Path(options.problems).glob("*.toml"))))
        if not files:
            text = f"{options.problems} has no problem files (*.toml)"
            raise InputError("", "--problems", text)
        for method in options.peers:
            if method not in METHODS:
                text = f"{method!r} given; allowed are {'; '.join(METHODS)}"
                raise InputError("", "--peers", text)
        for study, (method, peer) in product(SIMULATION + PLANNING, METHODS.items()):
            asked = method in (options.peers or METHODS)
            is_installed = not peer.module or find_spec(peer.module)
            if asked and study in peer.choices and is_installed:
                phases = [instance.name for instance in list_instances(files, study != NO_DRAG)]
                yield from product([study], phases, [method], peer.choices[study], [files])

    def limit(self, case: Case) -> float:
        """The time allowed, and that of the reference."""
        return self.allowed + 120.0

    def run(self, case: Case) -> Row:
        """Measure one setting."""
        study, name, method, setting, files = case
        instances = list_instances(files, study != NO_DRAG)
        instance = next(instance for instance in instances if instance.name == name)
        return run_setting(instance, study, method, setting)

    def report(self, rows: Sequence[Row], options: argparse.Namespace) -> Findings:
        """All tables."""
        measured = group((row for row in rows if "errors" in row), "study")
        parts: list[str | Table] = [INTRODUCTION]
        counts = {", by the error of the phase time": 1, ", by all three errors": None}
        for study in SIMULATION + PLANNING:
            for title, count in counts.items() if study in PLANNING else [("", None)]:
                mine = measured.get(study, [])
                parts += _format_targets(mine, study, title, count, options.limit)
        table = [(name, method.settings) for name, method in METHODS.items()]
        return [*parts, "## Settings", Table(["method", "settings"], table)], []

    def draw(self, rows: Sequence[Row]) -> Figure:
        """Mean run time over the error that half of the phases keep, one line for each method."""
        measured = group((row for row in rows if "errors" in row), "study")
        with open_figure(11.0, 9.0, layout="constrained") as figure:
            for axes, study in zip(figure.subplots(2, 2).flat, PLANNING + SIMULATION, strict=True):
                _draw_study(axes, measured.get(study, []), study)
        return figure


STUDY = Precision()
