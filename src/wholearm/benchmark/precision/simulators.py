"""Phases that methods run on, their timing, simulators, their reference, and the check of plans.

Phases have one freedom, on four sliding contacts. All simulators but ours are told when directions
reverse, from the reference, and are restarted there and where the torques step. Plans are replayed
open loop from rest by the equations of the reference; lost contacts pull by what is measured.

The reference solves the Newton-Euler equations of object and fingers, with contacts that are points
with normals of rigid bodies (`verification.newton_euler`), together with the contact conditions as
one linear system. Nothing is shared with the package's own contacts and dynamics; friction keeps
the directions that it is given. They are integrated by SciPy's DOP853 from step to step of the
torques, in double precision. Directions reverse where the sliding velocity vanishes.
"""

from __future__ import annotations

import math
import statistics
import time
import warnings
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import lru_cache, partial
from importlib.util import find_spec
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import casadi as ca
import numpy as np
from scipy.integrate import solve_ivp

from ...common.arrays import Array
from ...contacts.elemental import Contact
from ...contacts.formation import Formation
from ...geometry.curve import Curve, Segment
from ...geometry.tracing import trace_phases
from ...mechanics.dynamics import build_forward
from ...planning.options import PlanOptions
from ...planning.path_domain.first_guess import guess
from ...planning.path_domain.path_data import prepare
from ...planning.path_domain.path_mesh import make_grid
from ...planning.path_domain.path_motion import PathMotion
from ...planning.path_domain.path_plan import plan_path
from ...problem.definition import End, Problem
from ...problem.read import read_problem
from ...results.torque import TorqueProfile
from ...scene.model import Scene
from ...simulation.simulate import simulate
from ...verification.newton_euler import locate

REPEATS = 3  # largest number of runs that a median is of
BUDGET = 0.3  # time after which a run is not repeated any more [s]
SHIFT = 0.01  # shift of the geometric means [s]
SHORT = 0.05  # time up to which something is done several times over, in about this time [s]
SOLVED = "solved"

_Answer = TypeVar("_Answer")


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


def pick(name: str, paths: tuple[str, ...], drag: bool = True) -> Instance:
    """The phase of a name, of problem files."""
    return next(instance for instance in list_instances(paths, drag) if instance.name == name)


OPTIMUM = "Solve_Succeeded"  # Ipopt's status of a solution


class PeerPlan(NamedTuple):
    """What a planner has found for one phase."""

    status: str  # `OPTIMUM`, or why there is no plan
    duration: float  # [s]
    torque: TorqueProfile


NO_PLAN = PeerPlan("", 1.0, TorqueProfile(np.array([0.0, 1.0]), np.zeros((1, 2, 1))))
"""What there is where nothing was found."""


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

    @property
    def is_installed(self) -> bool:
        """Whether there is what it needs."""
        return not self.module or find_spec(self.module) is not None


class Median(NamedTuple):
    """The runs of one setting: medians of their times [s], and the worst of the rest."""

    build: float  # build, solve [s]: time to build, and to simulate or solve
    solve: float
    # of the state, relative to the scene; of plans those of the phase time, of the replayed end
    # state, and the worst violation of a limit between nodes
    errors: tuple[float, ...]
    outcome: str = SOLVED  # `SOLVED`, or what failed


def measure(
    build: Callable[[], Callable[[], _Answer]],
    judge: Callable[[_Answer], tuple[tuple[float, ...], str]],
) -> Median:
    """Build and run as often as the time allows; `judge` gives the errors and the outcome."""
    builds, solves, answers = [], [], []
    with warnings.catch_warnings():
        # Warnings of peers are not ours.
        warnings.simplefilter("ignore")
        began = time.process_time()
        for _ in range(REPEATS):
            built, run = _time(build)
            took, answer = _time(run)
            builds.append(built)
            solves.append(took)
            answers.append(answer)
            if time.process_time() - began > BUDGET:
                break
    errors, outcomes = zip(*map(judge, answers), strict=True)
    worst = tuple(max(column, key=abs) for column in zip(*errors, strict=True))
    outcome = next((outcome for outcome in outcomes if outcome != SOLVED), SOLVED)
    return Median(statistics.median(builds), statistics.median(solves), worst, outcome)


def _time(work: Callable[[], _Answer]) -> tuple[float, _Answer]:
    """Processor time that something takes [s], and its answer.

    Other work on the machine hardly changes it. What is too short for its clock is done several
    times over.
    """
    wall, processor = time.perf_counter(), time.process_time()
    answer = work()
    wall, processor = time.perf_counter() - wall, time.process_time() - processor
    if wall > SHORT:
        return processor, answer
    count = math.ceil(SHORT / max(wall, SHORT / 200))
    processor = time.process_time()
    for _ in range(count):
        work()
    return (time.process_time() - processor) / count, answer


def find_mean(seconds: Sequence[float]) -> float:
    """Shifted geometric mean [s]."""
    logs = [math.log(value + SHIFT) for value in seconds]
    return math.exp(math.fsum(logs) / len(logs)) - SHIFT


def solve_motion(
    scene: Scene,
    contacts: Sequence[Contact],
    z: Array,
    z_dot: Array,
    tau: Array,
    Xi: Array,
    sigma: Array,
) -> tuple[Array, Array]:
    """Accelerations z'', shape (5,), and c_n, shape (n_c,) [N], from one linear system.

    The unknowns are those of Eqs. (1) and (2) with the friction of Eq. (3) put in, together with
    the contact conditions differentiated twice: rates of their rows by complex steps.
    """
    tiny = 1e-30  # [s]
    ahead = (z + 1j * tiny * z_dot)[None]
    touches = [locate(scene, contact.name, ahead) for contact in contacts]
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


class Span(NamedTuple):
    """A stretch of time within one piece of the torques, without a reversal."""

    start: float  # start, stop [s]:
    stop: float
    piece: int  # of the torques
    Xi: Array  # Xi, sigma (n_c,) and (2,): directions of sliding and of the joints
    sigma: Array


class Course(NamedTuple):
    """One phase with torques, and where it gets to."""

    problem: Problem  # of that phase alone
    torque: TorqueProfile
    spans: tuple[Span, ...]
    end: Array  # (10,): state (z, z') when the torques end


def measure_error(problem: Problem, state: Array, exact: Array) -> float:
    """Largest difference of two states (z, z'), relative to length and time of the scene."""
    scales = problem.scene.scales
    unit = np.array([scales.length, scales.length, 1.0, 1.0, 1.0])
    return float(np.abs((state - exact) / np.append(unit, unit / scales.time)).max())


def integrate(
    problem: Problem, torque: TorqueProfile, curve: Curve, reversals: int, tolerance: float
) -> tuple[Array, tuple[Span, ...], float]:
    """State at the end of torques, the stretches on the way there, and the least c_n of all steps.

    Contacts stay closed: those that are lost pull.
    """
    contacts, parts = problem.phases[0].formation.contacts, [*curve.segments[: reversals + 1]]
    y, spans, least = np.append(problem.start, np.zeros(5)), list[Span](), np.inf
    for piece, (t, stop) in enumerate(pairwise(torque.breaks)):
        own = torque.cut(t, stop)
        while t < stop:
            part = parts[0]

            def solve(
                t: float, y: Array, part: Segment = part, own: TorqueProfile = own
            ) -> tuple[Array, Array]:
                tau = own.at(np.array([t]))[0]
                return solve_motion(problem.scene, contacts, y[:5], y[5:], tau, part.Xi, part.sigma)

            def rates(t: float, y: Array, solve: Any = solve) -> Array:
                return np.concatenate([y[5:], solve(t, y)[0]])

            events = [_find_reversal(curve.formation, *parts[:2])] if len(parts) > 1 else []
            options: dict[str, Any] = {"rtol": tolerance, "atol": tolerance, "events": events}
            run = solve_ivp(rates, (t, stop), y, "DOP853", **options)
            least = min([least, *(solve(*at)[1].min() for at in zip(run.t, run.y.T, strict=True))])
            start, t, y = t, float(run.t[-1]), run.y[:, -1]
            spans.append(Span(start, t, piece, part.Xi, part.sigma))
            parts = parts[1:] if run.status == 1 else parts
    return y, tuple(spans), float(least)


def _find_reversal(formation: Formation, before: Segment, after: Segment) -> Any:
    """Event at which the rate vanishes whose direction differs in two segments."""
    directions = np.append(before.Xi, before.sigma)
    row = int(np.flatnonzero(directions * np.append(after.Xi, after.sigma) < 0)[0])

    def rate(_: float, y: Array) -> float:
        if row >= len(before.Xi):
            return float(y[8 + row - len(before.Xi)])
        touch = locate(formation.scene, formation.contacts[row].name, y[None, :5])
        return float(touch.tangent[0] @ y[5:])

    rate.terminal, rate.direction = True, -directions[row]  # type: ignore[attr-defined]
    return rate


FEW, MANY = "simulation, few pieces", "simulation, many pieces"
"""Studies: torques in a few long pieces, and planned torques in eighty."""
TOLERANCES = {
    FEW: ("0.0001", *(f"1e-{k:02}" for k in range(6, 14))),
    MANY: ("1e-06", "1e-09", "1e-12"),
}
"""Tolerances of each study."""

Runner = Callable[[], Array]
"""Gives the state (z, z') at the end of a course, shape (10,)."""


def build_own(course: Course, setting: str) -> Runner:
    """Our simulator; what it keeps of a formation is built by a first run."""
    tolerance = float(setting)

    def run() -> Array:
        simulation = simulate(course.problem, course.torque, tolerance=tolerance)
        return np.append(simulation.z[-1], simulation.z_dot[-1])

    run()
    return run


def build_cvodes(course: Course, setting: str) -> Runner:
    """CasADi's interface to cvodes; all stretches are one call, by `mapaccum`."""
    tolerance, torque = float(setting), course.torque
    formation = course.problem.phases[0].formation
    n_c, terms = formation.n_contacts, torque.coefficients.shape[2]
    x, y, Xi, sigma = (ca.SX.sym(name, n) for name, n in zip("xyXs", (1, 10, n_c, 2), strict=True))
    flat, piece, ends = ca.SX.sym("flat", 2 * terms), ca.SX.sym("piece", 2), ca.SX.sym("ends", 2)
    half, t = (ends[1] - ends[0]) / 2, (ends[0] + ends[1] + x * (ends[1] - ends[0])) / 2
    place = (2 * t - piece[0] - piece[1]) / (piece[1] - piece[0])
    # Coefficients come column by column.
    powers = ca.reshape(flat, 2, -1)[:, ::-1]
    tau = ca.vertcat(*(ca.polyval(powers[k, :].T, place) for k in range(2)))
    rates = ca.vertcat(y[5:], build_forward(formation)(y[:5], y[5:], tau, Xi, sigma)[0])
    system = {"x": y, "t": x, "p": ca.vertcat(Xi, sigma, flat, piece, ends), "ode": half * rates}
    options: dict[str, Any] = {"abstol": tolerance, "reltol": tolerance, "max_num_steps": 100000}
    options |= {"linear_multistep_method": "adams", "nonlinear_solver_iteration": "functional"}
    step = ca.integrator("step", "cvodes", system, -1.0, 1.0, options)
    chain = step.mapaccum(len(course.spans))
    columns = []
    for own in course.spans:
        known = torque.coefficients[own.piece].ravel("F"), torque.breaks[own.piece : own.piece + 2]
        columns.append(np.concatenate([own.Xi, own.sigma, *known, [own.start, own.stop]]))
    start, parameters = np.append(course.problem.start, np.zeros(5)), np.array(columns).T

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
"""Simulators by name."""


def run_simulator(
    study: str, name: str, method: str, setting: str, files: tuple[str, ...]
) -> Median | None:
    """Run one setting of one simulator on one phase; None if the phase has no course."""
    course = make_course(pick(name, files), study)
    if course is None:
        return None

    def judge(state: Array) -> tuple[tuple[float, ...], str]:
        error = measure_error(course.problem, state, course.end)
        return (error,), SOLVED if np.isfinite(error) else "no finite state"

    return measure(partial(SIMULATORS[method].build, course, setting), judge)


@lru_cache(maxsize=64)
def make_course(instance: Instance, study: str) -> Course | None:
    """The course of a phase: of 95 % of its last stretch, as just before a stop all is ill-posed.

    None if the slow motion would lose a contact.
    """
    problem, curve = instance.problem, instance.curve
    if study == FEW:
        motion, degree = make_slow_motion(instance, 2, 0.3), 14
    else:
        motion, degree = plan_path(curve, problem.epsilon, PlanOptions(), 1).motion, 6
    looks = np.linspace(0.0, motion.duration, 201)
    if motion.evaluate(looks).c_n.min() <= 0:
        return None
    marks = find_reversals(motion)
    stop = marks[-2] + 0.95 * (marks[-1] - marks[-2])
    breaks = motion.times[np.append(motion.grid.steps > 0, True)]
    breaks = np.append(breaks[breaks < stop], stop)
    torque = TorqueProfile.fit(breaks, lambda t: motion.evaluate(t).tau, degree)
    # The smallest tolerance that SciPy takes.
    end, spans, _ = integrate(problem, torque, curve, len(marks) - 2, 2.3e-14)
    return Course(problem, torque, spans, end)


class ReferenceCheck(NamedTuple):
    """What a replay has shown."""

    end: float  # error of the end state, relative to the scene
    # worst violation of c_n >= epsilon, over the scene's force, or of a torque limit, over it
    violation: float
    outcome: str  # `SOLVED`, or why the plan is none


def check_plan(instance: Instance, plan: PeerPlan) -> ReferenceCheck:
    """Replay a plan."""
    if plan.status != OPTIMUM:
        return ReferenceCheck(math.nan, math.nan, plan.status)
    problem, curve = instance.problem, instance.curve
    reversals = len(curve.segments) - 1
    state, _, least = integrate(problem, plan.torque, curve, reversals, 1e-10)
    end = measure_error(problem, state, np.append(curve.end, np.zeros(5)))
    limit = problem.scene.torque_limit
    places = np.cos(np.linspace(0.0, np.pi, 9))
    excess = float((np.abs(plan.torque.at_places(places)) / limit[:, None] - 1).max())
    missing = (problem.epsilon - least) / problem.scene.scales.force
    violation = max(0.0, excess, missing)
    tests = (
        (least > 0, "a contact is lost between nodes"),
        (end <= 1e-2, "the replay ends elsewhere"),
        (excess <= 1e-2, "a torque limit is missed between nodes"),
    )
    outcome = next((text for holds, text in tests if not holds), SOLVED)
    return ReferenceCheck(end, violation, outcome)
