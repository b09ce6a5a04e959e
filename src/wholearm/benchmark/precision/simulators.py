"""Simulators that are compared: ours, SciPy's, CasADi's, and full coordinates after Baumgarte.

All but ours are told when directions reverse, from the reference, and start anew there and where
the torques step.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import casadi as ca
import numpy as np

from ...common.arrays import Array, Expression
from ...mechanics.dynamics import build_forward
from ...simulation.simulate import simulate
from ..baseline_simulation import evaluate_piece, solve_motion
from .plant import build_plant
from .reference import Course, Span

PULL = 20.0
"""Rate at which Baumgarte's gaps close [1/s]."""

Rates = Callable[[float, Array], Array]
Runner = Callable[[], Array]
"""Gives the state (z, z') at the end of a course, shape (10,)."""


class Simulator(NamedTuple):
    """A simulator.

    Attributes
    ----------
    settings : str
        What it is told besides the tolerance.
    build : callable
        Takes a course and a tolerance; gives what runs it.
    """

    settings: str
    build: Callable[[Course, float], Runner]


def build_own(course: Course, tolerance: float) -> Runner:
    """Our simulator; what it keeps of a formation is built by a first run."""

    def run() -> Array:
        found = simulate(course.problem, course.torque, tolerance=tolerance)
        return np.append(found.z[-1], found.z_dot[-1])

    run()
    return run


def build_scipy(
    course: Course, tolerance: float, method: str, callback: Callable[..., Any]
) -> Runner:
    """SciPy's `solve_ivp` on some kind of callbacks, with the same relative and absolute tolerance.

    Radau and LSODA get the Jacobian from callbacks that have one.
    """
    from scipy.integrate import solve_ivp

    choose = callback(course)

    def run() -> Array:
        state = np.append(course.problem.start, np.zeros(5))
        for span in course.spans:
            rates, jacobian = choose(span)
            given = {"jac": jacobian} if jacobian and method != "DOP853" else {}
            found = solve_ivp(
                rates,
                (span.start, span.stop),
                state,
                method=method,
                rtol=tolerance,
                atol=tolerance,
                **given,
            )
            if found.status:
                raise RuntimeError(found.message)
            state = found.y[:, -1]
        return np.asarray(state)

    return run


def call_numpy(course: Course, pull: float = 0.0) -> Callable[[Span], tuple[Rates, None]]:
    """Plain NumPy: one linear system in every call."""
    scene, torque = course.problem.scene, course.torque
    contacts = course.problem.phases[0].formation.contacts

    def choose(span: Span) -> tuple[Rates, None]:
        def rates(t: float, y: Array) -> Array:
            tau = evaluate_piece(torque, span.piece, t)
            found = solve_motion(scene, contacts, y[:5], y[5:], tau, span.Xi, span.sigma, pull)
            return np.concatenate([y[5:], found[0]])

        return rates, None

    return choose


def call_casadi(course: Course) -> Callable[[Span], tuple[Rates, Rates]]:
    """CasADi functions of the same equations and their Jacobian, with buffers that stay."""
    t, y, p, ode, _ = write_rates(course)
    plain = ca.Function("rates", [t, y, p], [ode])
    bent = ca.Function("jacobian", [t, y, p], [ca.densify(ca.jacobian(ode, y))])
    given = _Buffered(plain), _Buffered(bent)

    def choose(span: Span) -> tuple[Rates, Rates]:
        for function in given:
            function.p[:] = pack_span(course, span)
        return given[0], given[1]

    return choose


class _Buffered:
    """A CasADi function of t, y and p that is called without making arrays for its arguments."""

    def __init__(self, function: Expression) -> None:
        self.buffer, self.call = function.buffer()
        self.t, self.y = np.zeros(1), np.zeros(10)
        self.p, self.out = np.zeros(function.numel_in(2)), np.zeros(function.size_out(0), order="F")
        for index, array in enumerate((self.t, self.y, self.p)):
            self.buffer.set_arg(index, array.data)
        self.buffer.set_res(0, self.out.reshape(-1, order="F").data)
        self.column = function.size2_out(0) == 1

    def __call__(self, t: float, y: Array) -> Array:
        self.t[0], self.y[:] = t, y
        self.call()
        return self.out[:, 0].copy() if self.column else self.out.copy()


def write_rates(course: Course) -> tuple[Any, ...]:
    """The right-hand side and contact forces, as expressions of t, y and `pack_span`'s numbers."""
    formation = course.problem.phases[0].formation
    n_c, terms = formation.n_contacts, course.torque.coefficients.shape[2]
    t, y = ca.SX.sym("t"), ca.SX.sym("y", 10)
    Xi, sigma = ca.SX.sym("Xi", n_c), ca.SX.sym("sigma", 2)
    flat, piece = ca.SX.sym("flat", 2 * terms), ca.SX.sym("piece", 2)
    p = ca.vertcat(Xi, sigma, flat, piece)
    found = build_forward(formation)(y[:5], y[5:], _write_torque(t, flat, piece), Xi, sigma)
    return t, y, p, ca.vertcat(y[5:], found[0]), found[1]


def _write_torque(t: Expression, flat: Expression, piece: Expression) -> Expression:
    """The torques of a piece, whose coefficients come column by column."""
    x = (2 * t - piece[0] - piece[1]) / (piece[1] - piece[0])
    coefficients = ca.reshape(flat, 2, -1)
    return ca.vertcat(*(ca.polyval(coefficients[k, ::-1].T, x) for k in range(2)))


def pack_span(course: Course, span: Span) -> Array:
    """Parameters of the right-hand side on a stretch."""
    coefficients = course.torque.coefficients[span.piece]
    ends = course.torque.breaks[span.piece : span.piece + 2]
    return np.concatenate([span.Xi, span.sigma, coefficients.ravel("F"), ends])


def build_sundials(course: Course, tolerance: float, name: str, **options: Any) -> Runner:
    """CasADi's interface to cvodes, or to idas with the contact forces as algebraic unknowns.

    All stretches are one call, by `mapaccum`.
    """
    t, y, p, ode, _ = write_rates(course)
    ends, x = ca.SX.sym("ends", 2), ca.SX.sym("x")
    half, now = (ends[1] - ends[0]) / 2, (ends[0] + ends[1] + x * (ends[1] - ends[0])) / 2
    system = {"x": y, "t": x, "p": ca.vertcat(p, ends)}
    if name == "idas":
        system["z"] = c_n = ca.SX.sym("c_n", course.problem.phases[0].formation.n_contacts)
        acceleration, missed = _write_dae(course, y, p, t, c_n)
        system["alg"] = ca.substitute(missed, t, now)
        ode = ca.vertcat(y[5:], acceleration)
    system["ode"] = half * ca.substitute(ode, t, now)
    given = {"abstol": tolerance, "reltol": tolerance, "max_num_steps": 100000, **options}
    step = ca.integrator("step", name, system, -1.0, 1.0, given)
    count = len(course.spans)
    chain = step.mapaccum(count)
    columns = [[*pack_span(course, span), span.start, span.stop] for span in course.spans]
    parameters = ca.DM(np.array(columns).T)
    start = ca.DM(np.append(course.problem.start, np.zeros(5)))
    guess = {"z0": ca.DM.ones(system["z"].shape[0], count)} if "z" in system else {}

    def run() -> Array:
        found = chain(x0=start, p=parameters, **guess)["xf"]
        return np.asarray(found[:, -1].full()[:, 0])

    return run


def _write_dae(course: Course, y: Expression, p: Expression, t: Expression, c_n: Expression) -> Any:
    """Accelerations, and what A z'' + A' z' misses, with the contact forces as unknowns."""
    formation = course.problem.phases[0].formation
    sizes = np.cumsum([0, formation.n_contacts, 2, 2 * course.torque.coefficients.shape[2], 2])
    Xi, sigma, flat, piece = ca.vertsplit(p, sizes.tolist())
    return build_plant(formation)(y[:5], y[5:], _write_torque(t, flat, piece), c_n, Xi, sigma)


def _scipy(method: str, callback: Callable[..., Any]) -> Callable[[Course, float], Runner]:
    return partial(build_scipy, method=method, callback=callback)


_SAME = "rtol = atol = tolerance"
_TUNED = f"{_SAME}; CasADi function with buffers that stay"
SIMULATORS = {
    "wholearm": Simulator("events, contact forces and energies included", build_own),
    **{
        f"{method}, NumPy": Simulator(_SAME, _scipy(method, call_numpy))
        for method in ("DOP853", "Radau", "LSODA")
    },
    **{
        f"{method}, CasADi": Simulator(
            _TUNED + (", analytic Jacobian" if method != "DOP853" else ""),
            _scipy(method, call_casadi),
        )
        for method in ("DOP853", "Radau", "LSODA")
    },
    "cvodes": Simulator(
        "abstol = reltol = tolerance; Adams, functional iteration; all stretches in one call",
        partial(
            build_sundials,
            name="cvodes",
            linear_multistep_method="adams",
            nonlinear_solver_iteration="functional",
        ),
    ),
    "idas": Simulator(
        "abstol = reltol = tolerance; contact forces algebraic and without error test; "
        "all stretches in one call",
        partial(build_sundials, name="idas", suppress_algebraic=True),
    ),
    "Baumgarte": Simulator(
        f"DOP853, NumPy, {_SAME}; C'' + 2 p C' + p^2 C = 0, p = {PULL:g}/s",
        _scipy("DOP853", partial(call_numpy, pull=PULL)),
    ),
}
"""Simulators by name."""
