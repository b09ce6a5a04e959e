"""The NLP over time: collocation, its kernels, and their assembly."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from typing import Any

import casadi as ca
import numpy as np
import pytest

from plane import make_formation, measure_gaps, measure_slip, unbalance
from planned import CosineMotion
from rows import each
from scenes import roll, turning
from shipped import HEPTAGON
from timed import Sampler, drive, landing
from wholearm import Formation, Objective, Scene, load
from wholearm.common.arrays import Array, Expression
from wholearm.common.sharing import Batch
from wholearm.geometry.curve import Curve, tangent_basis
from wholearm.geometry.path_guess import list_ends
from wholearm.geometry.tracing import trace_phases
from wholearm.mechanics.dynamics import Directions, close_contacts, metric_weights, split_forces
from wholearm.planning.nlp import Columns, Kernel, NlpRows, build_kernel, build_solver
from wholearm.planning.time_domain import time_nlp
from wholearm.planning.time_domain.stage import (
    LimitViolations,
    Scheme,
    Stage,
    bernstein,
    fit_controls,
    make_scheme,
)
from wholearm.results.trajectory import Samples


def test_bounds_are_kept_exactly() -> None:
    """Least x^2 + y^2 with x + y >= 1 and x >= 0.8."""
    x = ca.SX.sym("x", 2)
    nlp = {"x": x, "f": ca.dot(x, x), "g": x[0] + x[1]}
    solver = build_solver("toy", nlp, 1e-9, max_iter=50)
    answer = solver(lbx=[0.8, -ca.inf], lbg=1.0, ubg=ca.inf, x0=[3.0, 3.0])
    assert answer["success"]
    # The barrier keeps inequalities strictly; relaxed bounds would be missed by 1e-8.
    assert float(answer["x"][0]) >= 0.8 and float(answer["g"]) >= 1.0
    assert answer["x"].full()[:, 0] == pytest.approx([0.8, 0.2], abs=1e-7)


@each("count", [0, 1, 5, 6, 20, 21, 63, 64, 65, 197])
def test_batches_agree_with_single_calls(count: int) -> None:
    """Also of arrays with strides, and results outlive the next call."""
    rng, symbols = np.random.default_rng(count), (ca.SX.sym("x", 3), ca.SX.sym("y", 2))
    product, total = ca.mtimes(symbols[0], symbols[1].T), ca.sin(ca.sum1(symbols[0]))
    function = ca.Function("f", symbols, [product + 1, total * symbols[1][0]])
    wide = rng.uniform(-1, 1, (2 * count, 6))
    batch, x, y = Batch(function), wide[::2, ::2], wide[::-2, 4:]
    outer, total = batch(x, y)
    batch(0 * x, 0 * y)
    assert outer.shape == (count, 3, 2) and total.shape == (count, 1, 1)
    for k in range(count):
        one, other = function(x[k], y[k])
        np.testing.assert_array_equal(outer[k], one.full())
        np.testing.assert_array_equal(total[k], other.full())


@each("degree", range(1, 7))
@each("name", ["radau", "legendre"])
def test_schemes_are_those_of_radau_and_gauss(name: str, degree: int) -> None:
    """Butcher's conditions B(order) and C(degree), of which there is one solution for each name."""
    scheme = make_scheme(name, degree)
    assert scheme.order == {"radau": 2 * degree - 1, "legendre": 2 * degree}[name]
    assert (scheme.weights[-1] > 0).all() and (np.diff(scheme.points) > 0).all()
    # The inverse of the powers has a condition number of up to 1e5.
    for p in range(scheme.order):
        assert scheme.weights[-1] @ scheme.points**p == pytest.approx(1 / (p + 1), abs=1e-10)
    over = scheme.weights[-1] @ scheme.points**scheme.order - 1 / (scheme.order + 1)
    assert abs(over) > 1e-8
    for power in range(degree):
        exact = scheme.points ** (power + 1) / (power + 1)
        error = scheme.weights[:degree] @ scheme.points**power - exact
        assert np.abs(error).max() < 1e-10
    assert scheme.has_end == (name == "radau")
    if scheme.has_end:
        assert scheme.points[-1] == pytest.approx(1.0, abs=1e-14)
    assert len(scheme.weights) == degree + (not scheme.has_end)


STEP = 1e-4
"""Of central differences along a motion; what they leave out is of the size of its square."""
CONTACTS = {
    "v1-palm": ["", "v1-palm"],
    "v1-palm v3-finger1": ["", "v3-finger1"],
    "v1-palm v4-finger1 v6-finger2": ["", "v1-palm v6-finger2"],
    "v0-palm v1-palm v3-finger1 v6-finger2": [""],
    "v0-palm v1-palm v2-finger1 v3-finger1 v5-finger2": [""],
}
"""One to five contacts, all of them sliding or some of them rolling."""
FORMATIONS = [
    roll(make_formation(landing().scene, names), *rolls.split())
    for names, choices in CONTACTS.items()
    for rolls in choices
]
every = pytest.mark.parametrize(
    "formation",
    FORMATIONS,
    ids=lambda f: " ".join(c.name + " rolls" * (c in f.rolling) for c in f.contacts),
)


def call(kernel: Kernel, x: list[Array], *p: Array) -> Array:
    given = np.concatenate([np.zeros(0), *p])
    return np.asarray(kernel.function(np.concatenate(x), given).full()[:, 0])


def draw(rng: np.random.Generator) -> tuple[Array, Array, Array]:
    """Random z near the heptagon's start, w and u; contacts do not have to be closed."""
    z = landing().start + 0.05 * rng.normal(size=5) * [0.2, 0.2, 1, 1, 1]
    return z, 0.3 * rng.normal(size=5), rng.normal(size=5)


def constraints(formation: Formation, z: Array, w: Array, u: Array) -> tuple[Array, Array]:
    """First and second derivatives of the gaps, and v_t and its derivative where contacts roll."""
    rolling = list(formation.rolling_rows)

    def move(s: float) -> tuple[Array, Array]:
        return z + s * w + s**2 / 2 * u, w + s * u

    before, here, after = (measure_gaps(formation, move(k * STEP)[0]) for k in (-1, 0, 1))
    slip = [measure_slip(formation, *move(k * STEP))[rolling] for k in (-1, 0, 1)]
    first = np.append((after - before) / (2 * STEP), slip[1])
    second = np.append((after - 2 * here + before) / STEP**2, (slip[2] - slip[0]) / (2 * STEP))
    return first, second


@every
def test_points_have_newton_and_euler_and_closed_contacts(formation: Formation) -> None:
    rng = np.random.default_rng(formation.n_constraints)
    n_c, n_p = formation.n_contacts, formation.n_constraints
    for _ in range(3):
        z, v, a = draw(rng)
        forces, tau = rng.normal(size=n_p), rng.normal(size=(3, 2))
        shares, sizes = rng.uniform(0.1, 0.3, 3), [n_p, n_p, n_p, 5]
        Xi, sigma = rng.choice([-1.0, 1.0], n_c), rng.choice([-1.0, 1.0], 2)
        first, least = (z + 0.02 * rng.normal(size=5) if formation.rolling else z[:0]), 0.3
        x = [z, v, a, forces, tau.ravel(), first]
        y = call(time_nlp.point_kernel(formation, 3), x, Xi, sigma, shares, np.full(n_c, least))
        gaps, rates, bends, balance, senses = np.split(y, np.cumsum(sizes))
        np.testing.assert_allclose(gaps[:n_c], measure_gaps(formation, z), atol=1e-13)
        expected = constraints(formation, z, v, a)
        for got, one, size in zip((rates, bends), expected, (1e-7, 1e-5), strict=True):
            np.testing.assert_allclose(got, one, atol=size)
        now = shares @ tau
        c_n, c_t = split_forces(formation, forces, Xi)
        row = Samples(z, v, a, now, c_n, c_t)
        missing, size_of = unbalance(formation, row, sigma)
        # The kernel's rows are masses times accelerations less forces.
        np.testing.assert_allclose(balance, -missing, atol=1e-12 * size_of.max())
        slip = measure_slip(formation, z, v)
        sliding = [k for k in range(n_c) if k not in formation.rolling_rows]
        np.testing.assert_allclose(senses, (Xi * slip - least)[sliding], atol=1e-12)


@every
def test_rolling_contacts_keep_what_has_rolled_by(formation: Formation) -> None:
    rng = np.random.default_rng(3)
    n_c = formation.n_contacts
    z, w, _ = draw(rng)
    first = draw(rng)[0] if formation.rolling else z[:0]
    y = call(time_nlp.end_kernel(formation), [z, w, first])
    assert y.shape == (2 * formation.n_constraints,)
    np.testing.assert_allclose(y[:n_c], measure_gaps(formation, z), atol=1e-13)
    rates, _ = constraints(formation, z, w, 0 * w)
    np.testing.assert_allclose(y[formation.n_constraints :], rates, atol=1e-7)
    if formation.rolling:
        # Sliding velocities add up to the slip coordinates' change, along any path.
        places, weights = np.polynomial.legendre.leggauss(12)
        run = z - first
        rows = list(formation.rolling_rows)
        speeds = [measure_slip(formation, first + (s + 1) / 2 * run, run)[rows] for s in places]
        expected = weights / 2 @ np.array(speeds)
        np.testing.assert_allclose(y[n_c : formation.n_constraints], expected, atol=1e-12)


PHASE = 3
"""Of the heptagon, without a reversal."""
SCHEMES = [("radau", 2), ("radau", 3), ("legendre", 2), ("legendre", 3)]
DURATION = 0.06


@cache
def curve() -> Curve:
    return trace_phases(load(str(HEPTAGON)))[PHASE]


@cache
def drive_from_rest(contacts: int) -> tuple[Formation, Directions, Sampler]:
    """A motion under torques that are linear in time, by plain Newton and Euler."""
    formation, segment = curve().formation, curve().segments[0]
    start = CosineMotion(curve(), 0.2, 15.0).evaluate(np.zeros(1))
    formation = Formation(formation.scene, formation.contacts[:contacts])
    directions = Directions(segment.Xi[:contacts], segment.sigma)
    tau = np.stack([start.tau[0], 0.9 * start.tau[0]])
    return formation, directions, drive(formation, start.z[0], tau, directions, DURATION)


@cache
def driven(name: str, degree: int, count: int, contacts: int = 4) -> Stage:
    formation, directions, sample = drive_from_rest(contacts)
    return Stage(PHASE, formation, directions, sample(make_scheme(name, degree), count))


def build_nlp(
    stages: list[Stage], scheme: Scheme, objective: Objective = Objective.TIME, weight: float = 3.0
) -> time_nlp.TimeNLP:
    return time_nlp.build_time_nlp(stages, scheme, time_nlp.Target(objective, 0.05, weight), 1)


def evaluate_at(nlp: time_nlp.TimeNLP, part: str, x: Array) -> Array:
    values: Any = nlp.solver.function.get_function(part)(x, [])
    return np.asarray(values.full()[:, 0])


def packed(nlp: time_nlp.TimeNLP, stages: list[Stage], margin: float = 0.0) -> Array:
    return time_nlp.pack([stage.guess for stage in stages], nlp.layouts, margin)


def misses(nlp: time_nlp.TimeNLP, x: Array) -> tuple[Array, Array]:
    """What equations and inequalities miss; inequalities are negative where they hold."""
    low, high = nlp.rows.bounds
    values = evaluate_at(nlp, "nlp_g", x)
    miss = np.maximum(low - values, values - high)
    return np.where(low == high, np.abs(miss), 0.0), np.where(low == high, -np.inf, miss)


def collocation(name: str, degree: int, count: int, contacts: int) -> tuple[Array, Array]:
    """What collocation misses at inner points and at the ends of intervals."""
    scheme, stage = make_scheme(name, degree), driven(name, degree, count, contacts)
    nlp = build_nlp([stage], scheme)
    equations, _ = misses(nlp, packed(nlp, [stage]))
    rows = nlp.rows_of[0]
    own = equations[rows.states]
    assert own.shape == (count, 2, degree + (not scheme.has_end), 5 - stage.formation.n_constraints)
    # Everything else holds at once but rest at the end: contacts, balances, contacts at the ends.
    # The reference differentiates contacts by differences over a microsecond.
    rest = 5 - stage.formation.n_constraints
    assert np.delete(equations, rows.states)[:-rest].max() < 1e-7
    return own[:, :, :-1].max(), own[:, :, -1].max()


@pytest.mark.parametrize(
    "name, degree, contacts", [*((*scheme, 4) for scheme in SCHEMES), ("radau", 3, 3)]
)
def test_a_known_motion_satisfies_the_equations_to_the_schemes_order(
    name: str, degree: int, contacts: int
) -> None:
    scheme = make_scheme(name, degree)
    # Three contacts let the object go astray ever faster, so intervals have to be shorter, but
    # not so short that the reference's own 1e-11 counts.
    short = (8, 16) if scheme.order == 6 else (16, 32)
    counts = short if contacts == 3 else (4, 8) if degree == 2 else (2, 4)
    coarse, fine = (collocation(name, degree, count, contacts) for count in counts)
    inner, ends = np.log2(np.array(coarse) / np.array(fine))
    # To inner points integrals are exact for degree d - 1, to the end for that of the order.
    assert inner == pytest.approx(degree + 1, abs=0.4)
    assert ends == pytest.approx(scheme.order + 1, abs=0.5)
    assert max(fine) < 1e-3


@pytest.mark.parametrize("name, degree", SCHEMES)
def test_a_known_motion_keeps_the_limits(name: str, degree: int) -> None:
    scheme, stage = make_scheme(name, degree), driven(name, degree, 8)
    nlp = build_nlp([stage], scheme)
    x = packed(nlp, [stage])
    (low_x, high_x), (low, _) = time_nlp.find_bounds(
        nlp, [stage], scheme, [LimitViolations.none(stage)]
    )
    nlp.rows.bounds[0][:] = low
    _, inequalities = misses(nlp, x)
    # Slip and joint speeds start from nothing.
    assert inequalities.max() < 1e-9 and (x > low_x - 1e-9).all() and (x < high_x + 1e-9).all()


@pytest.mark.parametrize("row", range(6))
def test_friction_the_wrong_way_breaks_a_limit(row: int) -> None:
    scheme, stage = make_scheme("radau", 3), driven("radau", 3, 8)
    signs = np.concatenate(stage.directions)
    signs[row] *= -1
    wrong = replace(stage, directions=Directions(signs[:4], signs[4:]))
    nlp = build_nlp([wrong], scheme)
    x = packed(nlp, [wrong])
    (low, high), _ = time_nlp.find_bounds(nlp, [wrong], scheme, [LimitViolations.none(wrong)])
    worst = max(misses(nlp, x)[1].max(), (low - x).max(), (x - high).max())
    assert worst > 0.02


@pytest.mark.parametrize("objective", [Objective.TIME, Objective.EFFORT, Objective.MARGIN])
def test_what_is_made_least(objective: Objective) -> None:
    scheme, stage = make_scheme("radau", 3), driven("radau", 3, 8)
    nlp = build_nlp([stage], scheme, objective)
    cost = evaluate_at(nlp, "nlp_f", packed(nlp, [stage], 0.7))[0]
    first, last = stage.guess.tau[0, 0], stage.guess.tau[-1, 1]
    squares = DURATION / 3 * (first @ first + first @ last + last @ last)
    least = {"time": DURATION, "effort": squares + 3.0 * DURATION, "margin": -0.7}
    assert cost == pytest.approx(least[objective.value], rel=1e-12)


@pytest.mark.parametrize("name", ["radau", "legendre"])
def test_the_margin_raises_what_forces_have_to_exceed(name: str) -> None:
    scheme, stage = make_scheme(name, 3), driven(name, 3, 8)
    nlp = build_nlp([stage], scheme, Objective.MARGIN)
    (low_x, _), (low, _) = time_nlp.find_bounds(nlp, [stage], scheme, [LimitViolations.none(stage)])
    assert not np.isfinite(low_x[nlp.layouts[0].forces]).any()
    # The polynomial through the points may pass a little below them at the ends of an interval.
    room = stage.guess.forces.min() - 0.05
    for extra, kept in ((0.9 * room, True), (1.02 * room, False)):
        values = evaluate_at(nlp, "nlp_g", packed(nlp, [stage], extra))
        (rows,) = nlp.rows_of
        pressed = [part.indices for part in rows.parts if part.on_rows and part.side < 4]
        assert bool(min((values - low)[part].min() for part in pressed) > 0) is kept


UNKNOWNS = 11
CLOSE = 1e-12


def make_kernels() -> tuple[Kernel, Kernel, Kernel]:
    """Two outputs of three unknowns; a share of the cost; and one that is linear in x."""
    three, two, one = (Columns(x=size).make_symbols() for size in (3, 2, 2))
    x, a, b = three.x, two.x, one.x
    single, pair, none = (Columns(p=size).make_symbols() for size in (1, 2, 1))
    p, q = single.p, pair.p
    y = ca.vertcat(ca.sin(x[0]) * x[1] + p * x[2] ** 2, ca.exp(x[2]) * x[0] - x[1])
    return (
        build_kernel(three, single, y=y),
        build_kernel(two, pair, y=q[0] * a[0] * a[1] + q[1] * a[0] ** 4),
        build_kernel(one, none, y=none.p * b[0] - b[1]),
    )


def make_nlp(seed: int) -> tuple[Any, Expression, Expression, Expression]:
    """An NLP of copies of kernels, and the same one written row by row: x, f and g."""
    rng = np.random.default_rng(seed)
    pair, share, line = make_kernels()
    rows, cost = NlpRows(), rng.normal(size=UNKNOWNS)

    def choose(count: int, width: int) -> Any:
        # Copies share unknowns, but none has one twice.
        return np.array([rng.choice(UNKNOWNS, width, replace=False) for _ in range(count)])

    copies = []
    for kernel, count, width, given in ((pair, 4, 3, 1), (share, 5, 2, 2), (line, 3, 2, 1)):
        columns, parameters = choose(count, width), rng.normal(size=(count, given))
        own = rows.add_copies(kernel, {"x": columns}, {"p": parameters}, cost=kernel is share)
        copies.append((kernel, columns, own, parameters))
        # Linear rows are among them; one has no entries.
        linear = rows.linear(2)
    columns, values = choose(1, 3), rng.normal(size=3)
    rows.add_entries(linear[0], columns, values)
    x = ca.MX.sym("x", UNKNOWNS)
    f, g = ca.dot(ca.DM(cost), x), [ca.MX(0.0)] * 17
    for column, value in zip(columns[0], values, strict=True):
        g[int(linear[0])] += value * x[int(column)]
    for kernel, table, own, parameters in copies:
        for k, entry in enumerate(table):
            y = kernel.function(x[entry.tolist()], ca.DM(parameters[k]))
            if not own.size:
                f += y
            for i, row in enumerate(own[k]):
                g[row] = y[i]
    return rows.assemble(cost, np.zeros(0, dtype=np.int64)), x, f, ca.vertcat(*g)


def evaluate(inputs: list[Expression], output: Expression, *values: Array) -> Array:
    return np.asarray(ca.Function("f", inputs, [output])(*values).full())


@pytest.mark.parametrize("seed", range(4))
def test_values_and_derivatives_are_those_of_the_same_nlp_in_one_piece(seed: int) -> None:
    built, x, f, g = make_nlp(seed)
    rng = np.random.default_rng(100 + seed)
    lam_f, lam_g = ca.MX.sym("lam_f"), ca.MX.sym("lam_g", g.numel())
    at, on_f, on_g = rng.normal(size=UNKNOWNS), rng.normal(size=1), rng.normal(size=g.numel())
    nlp, derivatives = built
    for own, expected in ((nlp["f"], f), (nlp["g"], g)):
        got = evaluate([nlp["x"], nlp["p"]], own, at, np.zeros(0))
        np.testing.assert_allclose(got, evaluate([x], expected, at), atol=CLOSE)
    again, jacobian = derivatives["jac_g"](at, [])
    np.testing.assert_allclose(again.full(), evaluate([x], g, at), atol=CLOSE)
    np.testing.assert_allclose(jacobian.full(), evaluate([x], ca.jacobian(g, x), at), atol=CLOSE)
    hessian = derivatives["hess_lag"](at, [], on_f, on_g)
    full = ca.hessian(lam_f * f + ca.dot(lam_g, g), x)[0]
    expected = evaluate([x, lam_f, lam_g], full, at, on_f, on_g)
    np.testing.assert_allclose(hessian.full(), np.triu(expected), atol=CLOSE)
    # Several copies meet in some entry, which adds up.
    assert np.abs(expected).max() > 0.1


@pytest.mark.parametrize("count", [2, 3, 5])
def test_polynomials_lie_between_their_control_points(count: int) -> None:
    rng, places = np.random.default_rng(count), np.linspace(0.0, 1.0, 41)
    controls = rng.uniform(-1.0, 1.0, (count, 2))
    values = bernstein(places, count) @ controls
    assert (values <= controls.max(axis=0) + 1e-14).all()
    assert (values >= controls.min(axis=0) - 1e-14).all()
    np.testing.assert_allclose(values[[0, -1]], controls[[0, -1]], atol=1e-13)
    # Of their degree they are: their control points follow from as many values.
    at = np.sort(rng.uniform(0.0, 1.0, count))
    fitted = fit_controls(at, bernstein(at, count) @ controls, count)
    np.testing.assert_allclose(fitted, controls, atol=1e-6)


@pytest.mark.parametrize("rolls", [(), ("v4-finger1",)])
def test_impacts_balance_the_momentum_of_every_body(rolls: tuple[str, ...]) -> None:
    rng = np.random.default_rng(9)
    scene = landing().scene
    before = make_formation(scene, "v1-palm v3-finger1 v6-finger2")
    after = roll(make_formation(scene, "v1-palm v4-finger1 v6-finger2"), *rolls)
    # An impact is over at once: what has no impulse is left out of the balance.
    bare = [replace(link, viscous=0.0, dry=0.0) for link in scene.fingers]
    still = Scene(scene.polygon, (bare[0], bare[1]), scene.friction, 0.0)
    n_p, n_c = after.n_constraints, after.n_contacts
    assert time_nlp.find_released(before, after) == [1]
    for _ in range(3):
        z, v_after, v_before = draw(rng)
        impulses, Xi = rng.normal(size=n_p), rng.choice([-1.0, 1.0], n_c)
        x = [v_after, v_before, z, impulses]
        y = call(time_nlp.impact_kernel(before, after), x, Xi)
        jump, held, leaving, cones = np.split(y, np.cumsum([5, n_p, 1]))
        p_n, p_t = split_forces(after, impulses, Xi)
        row = Samples(z, v_before, v_after - v_before, np.zeros(2), p_n, p_t)
        missing, _ = unbalance(replace(after, scene=still), row, np.ones(2))
        np.testing.assert_allclose(jump, -missing, atol=1e-13 * np.abs(missing).max())
        rates, _ = constraints(after, z, v_after, 0 * z)
        np.testing.assert_allclose(held, rates, atol=1e-6)
        opening, _ = constraints(Formation(scene, before.contacts[1:2]), z, v_after, 0 * z)
        np.testing.assert_allclose(leaving, opening, atol=1e-6)
        rows = list(after.rolling_rows)
        grip = after.friction[rows] * p_n[rows]
        np.testing.assert_allclose(cones, [*(grip - p_t[rows]), *(grip + p_t[rows])], atol=1e-14)


@pytest.mark.parametrize("contacts", [4, 3])
def test_the_tangent_basis_is_what_contacts_leave_free(contacts: int) -> None:
    stage = driven("radau", 3, 8, contacts)
    z, formation = stage.guess.nodes[0, 0], stage.formation
    N = tangent_basis(formation, z)
    assert N.shape == (5, 5 - contacts)
    P = formation.evaluate(z[None], np.zeros((1, 5))).P[0]
    # Along the columns of N over the metric contacts stay closed; N^T are coordinates along them.
    metric = metric_weights(formation.scene)[:, None] / formation.scene.polygon.gyration_radius**2
    np.testing.assert_allclose(P @ (N / metric), 0.0, atol=1e-13)
    np.testing.assert_allclose(N.T @ (N / metric), np.eye(5 - contacts), atol=1e-13)


def test_a_contact_is_gained_where_the_motion_ends() -> None:
    """A pointed tip comes to a vertex along the edge, or turns onto it with its link."""
    problem = turning()
    (phase,), start = problem.phases, problem.start
    slip, rows = phase.formation.evaluate_slip(start[None])[0], list[int | None]()
    for ending in list_ends(phase):
        z = close_contacts(ending.formation, start, slip, (), ending.active)
        assert z is not None
        rows.append(time_nlp.find_range_end(phase.formation, phase.until, z))
        gap = phase.formation.add(phase.until.contact).evaluate(z[None], z[None]).C[0, -1]
        assert abs(gap) < 1e-9
    assert rows == [0, None]
    assert "runs off edge 4" in phase.formation.limits[0].text
