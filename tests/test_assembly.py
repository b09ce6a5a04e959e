from __future__ import annotations

from typing import Any

import casadi as ca
import numpy as np
import pytest

from wholearm.common.arrays import Array, Expression
from wholearm.common.batch import FEW, SIZE, SOME, Batch
from wholearm.planning.columns import Columns
from wholearm.planning.time_domain.nlp_layout import (
    Block,
    Kernel,
    Triplets,
    assemble_nlp,
    build_kernel,
)
from wholearm.solvers.ipopt import build_solver, record_runs

UNKNOWNS = 11
CLOSE = 1e-12
"""What rounding leaves of sums of terms that are about one."""


def make_kernels() -> tuple[Kernel, Kernel, Kernel]:
    """Two outputs of three unknowns; a share of the cost; and one that is linear in x."""
    x, p = ca.SX.sym("x", 3), ca.SX.sym("p", 1)
    y = ca.vertcat(ca.sin(x[0]) * x[1] + p * x[2] ** 2, ca.exp(x[2]) * x[0] - x[1])
    a, q = ca.SX.sym("a", 2), ca.SX.sym("q", 2)
    b, none = ca.SX.sym("b", 2), ca.SX.sym("r", 1)
    return (
        build_kernel(x, p, y),
        build_kernel(a, q, q[0] * a[0] * a[1] + q[1] * a[0] ** 4),
        build_kernel(b, none, none * b[0] - b[1]),
    )


def make_nlp(seed: int) -> tuple[Any, Expression, Expression, Expression]:
    """An NLP of blocks, and the same one written row by row: x, f and g."""
    rng = np.random.default_rng(seed)
    pair, share, line = make_kernels()
    order = rng.permutation(15)
    rows = order[:8].reshape(4, 2), order[8:11].reshape(3, 1)
    linear = np.sort(order[11:])

    def choose(count: int, width: int) -> Any:
        # Copies share unknowns, but none has one twice.
        return np.array([rng.choice(UNKNOWNS, width, replace=False) for _ in range(count)])

    blocks = [
        Block(pair, choose(4, 3), rows[0], rng.normal(size=(4, 1))),
        Block(share, choose(5, 2), np.zeros((5, 0), dtype=np.int64), rng.normal(size=(5, 2))),
        Block(line, choose(3, 2), rows[1], rng.normal(size=(3, 1))),
    ]
    # The last linear row has no entries.
    columns = np.concatenate([rng.choice(UNKNOWNS, 3, replace=False) for _ in range(3)])
    entries = Triplets(np.repeat(linear[:3], 3), columns, rng.normal(size=9))
    cost = rng.normal(size=UNKNOWNS)
    built = assemble_nlp(UNKNOWNS, entries, linear, blocks, cost)
    x = ca.MX.sym("x", UNKNOWNS)
    f, g = ca.dot(ca.DM(cost), x), [ca.MX(0.0)] * 15
    for row, column, value in zip(*entries, strict=True):
        g[row] = g[row] + value * x[int(column)]
    for block in blocks:
        for k, own in enumerate(block.columns):
            y = block.kernel.function(x[own.tolist()], ca.DM(block.parameters[k]))
            if not block.rows.size:
                f += y
            for i, row in enumerate(block.rows[k]):
                g[row] = y[i]
    return built, x, f, ca.vertcat(*g)


def evaluate(inputs: list[Expression], output: Expression, *values: Array) -> Array:
    return np.asarray(ca.Function("f", inputs, [output])(*values).full())


@pytest.mark.parametrize("seed", range(4))
def test_values_and_derivatives_are_those_of_the_same_nlp_in_one_piece(seed: int) -> None:
    built, x, f, g = make_nlp(seed)
    rng = np.random.default_rng(100 + seed)
    lam_f, lam_g = ca.MX.sym("lam_f"), ca.MX.sym("lam_g", g.numel())
    at, on_f, on_g = rng.normal(size=UNKNOWNS), rng.normal(size=1), rng.normal(size=g.numel())
    nlp = built.nlp
    for own, expected in ((nlp["f"], f), (nlp["g"], g)):
        got = evaluate([nlp["x"]], own, at)
        np.testing.assert_allclose(got, evaluate([x], expected, at), atol=CLOSE)
    again, jacobian = built.derivatives["jac_g"](at, [])
    np.testing.assert_allclose(again.full(), evaluate([x], g, at), atol=CLOSE)
    np.testing.assert_allclose(jacobian.full(), evaluate([x], ca.jacobian(g, x), at), atol=CLOSE)
    hessian = built.derivatives["hess_lag"](at, [], on_f, on_g)
    full = ca.hessian(lam_f * f + ca.dot(lam_g, g), x)[0]
    expected = evaluate([x, lam_f, lam_g], full, at, on_f, on_g)
    np.testing.assert_allclose(hessian.full(), np.triu(expected), atol=CLOSE)
    # Several copies meet in some entry, which adds up.
    assert np.abs(expected).max() > 0.1


def test_the_solver_takes_the_derivatives_that_it_is_given() -> None:
    x = ca.SX.sym("x", 2)
    # Rosenbrock's valley, one share of the cost, on a circle.
    valley = build_kernel(x, ca.SX(0, 1), (1 - x[0]) ** 2 + 100 * (x[1] - x[0] ** 2) ** 2)
    circle = build_kernel(x, ca.SX(0, 1), ca.sumsqr(x))
    both, none = np.array([[0, 1]]), np.zeros((1, 0))
    blocks = [
        Block(valley, both, none.astype(np.int64), none),
        Block(circle, both, np.array([[0]]), none),
    ]
    nothing = np.zeros(0, dtype=np.int64)
    built = assemble_nlp(2, Triplets(nothing, nothing, np.zeros(0)), nothing, blocks, np.zeros(2))
    quiet = {"ipopt": {"print_level": 0, "sb": "yes"}, "print_time": False}
    solver = ca.nlpsol("solver", "ipopt", built.nlp, quiet | built.derivatives)
    result = solver(x0=[0.3, 0.3], lbg=-np.inf, ubg=1.0)["x"].full()[:, 0]
    # On the circle, by its angle.
    angle = np.linspace(0, np.pi / 2, 2_000_001)
    cost = (1 - np.cos(angle)) ** 2 + 100 * (np.sin(angle) - np.cos(angle) ** 2) ** 2
    best = angle[cost.argmin()]
    np.testing.assert_allclose(result, [np.cos(best), np.sin(best)], atol=2e-6)


@pytest.mark.parametrize("which", range(3))
def test_kernels_have_the_derivatives_of_their_expression(which: int) -> None:
    kernel = make_kernels()[which]
    rng = np.random.default_rng(which)
    n_x, n_p = (kernel.function.size1_in(i) for i in range(2))
    x, p, lam = rng.normal(size=n_x), rng.normal(size=n_p), rng.normal(size=kernel.outputs)
    steps = 1e-5 * np.eye(n_x)

    def dense(x: Array) -> Array:
        J = np.zeros((kernel.outputs, n_x))
        J[tuple(kernel.jacobian_at)] = kernel.jacobian(x, p).full()[:, 0]
        return J

    def value(x: Array) -> Array:
        return np.asarray(kernel.function(x, p).full()[:, 0])

    slopes = np.array([(value(x + h) - value(x - h)) / 2e-5 for h in steps]).T
    # Differences of second order, over steps of 1e-5.
    np.testing.assert_allclose(dense(x), slopes, atol=1e-8)
    H = np.zeros((n_x, n_x))
    H[tuple(kernel.hessian_at)] = kernel.hessian(x, p, lam).full()[:, 0]
    bend = np.array([lam @ (dense(x + h) - dense(x - h)) / 2e-5 for h in steps])
    np.testing.assert_allclose(H, np.triu(bend), atol=1e-8)


def build(max_iter: int) -> Expression:
    """Least x^2 + y^2 with x + y >= 1 and x >= 0.8."""
    x = ca.SX.sym("x", 2)
    nlp = {"x": x, "f": ca.dot(x, x), "g": x[0] + x[1]}
    return build_solver("toy", nlp, 1e-9, max_iter=max_iter)


@pytest.fixture(scope="module")
def solver() -> Expression:
    return build(50)


def solve(solver: Expression, **start: Expression) -> dict[str, Expression]:
    answer: dict[str, Expression] = solver(lbx=[0.8, -ca.inf], lbg=1.0, ubg=ca.inf, **start)
    assert solver.stats()["success"]
    return answer


def test_bounds_are_kept_exactly(solver: Expression) -> None:
    answer = solve(solver, x0=[3.0, 3.0])
    # The barrier keeps inequalities strictly; relaxed bounds would be missed by 1e-8.
    assert float(answer["x"][0]) >= 0.8
    assert float(answer["g"]) >= 1.0
    assert float(answer["x"][0]) == pytest.approx(0.8, abs=1e-7)
    assert float(answer["x"][1]) == pytest.approx(0.2, abs=1e-7)


def test_a_solution_is_kept_as_a_start(solver: Expression) -> None:
    """It is pushed from its bounds by as little as was asked for, and not by Ipopt's 1 %."""
    answer = solve(solver, x0=[3.0, 3.0])
    start = {"x0": answer["x"], "lam_x0": answer["lam_x"], "lam_g0": answer["lam_g"]}
    kept = build(0)(lbx=[0.8, -ca.inf], lbg=1.0, ubg=ca.inf, **start)
    assert float(ca.norm_inf(kept["x"] - answer["x"])) < 1e-8
    again = solve(solver, **start)
    assert float(again["f"]) == pytest.approx(0.8**2 + 0.2**2, abs=1e-7)


def test_failure_is_a_status_and_no_exception(solver: Expression) -> None:
    solver(x0=[3.0, 3.0], lbx=[0.8, 0.8], ubx=[0.9, 0.9], lbg=5.0, ubg=ca.inf)
    assert not solver.stats()["success"]


def test_runs_are_recorded_with_their_sizes(solver: Expression) -> None:
    with record_runs() as runs:
        solve(solver, x0=[3.0, 3.0])
        with record_runs() as inner:
            solve(solver, x0=[0.9, 0.9])
    solve(solver, x0=[3.0, 3.0])
    assert len(runs) == 2 and inner == runs[1:]
    for run in runs:
        assert (run.unknowns, run.rows) == (2, 1)
        # The row has both unknowns; the Hessian is diagonal.
        assert (run.jacobian_nonzeros, run.hessian_nonzeros) == (2, 2)
        assert run.iterations > 0 and run.seconds >= 0.0


def build_function() -> ca.Function:
    """(x, y) -> (outer product with a structural shape of its own, a sum)."""
    x, y = ca.SX.sym("x", 3), ca.SX.sym("y", 2)
    return ca.Function("f", [x, y], [ca.mtimes(x, y.T) + 1, ca.sin(ca.sum1(x)) * y[0]])


@pytest.mark.parametrize(
    "count", [0, 1, FEW, FEW + 1, SOME, SOME + 1, SIZE - 1, SIZE, SIZE + 1, 3 * SIZE + 5]
)
def test_batches_agree_with_single_calls(count: int) -> None:
    rng = np.random.default_rng(count)
    function = build_function()
    x, y = rng.uniform(-1, 1, (count, 3)), rng.uniform(-1, 1, (count, 2))
    outer, total = Batch(function)(x, y)
    assert outer.shape == (count, 3, 2) and total.shape == (count, 1, 1)
    for k in range(count):
        one, other = function(x[k], y[k])
        np.testing.assert_array_equal(outer[k], one.full())
        np.testing.assert_array_equal(total[k], other.full())


def test_results_survive_the_next_call() -> None:
    batch = Batch(build_function())
    first = batch(np.ones((2, 3)), np.ones((2, 2)))[0]
    kept = first.copy()
    batch(np.zeros((2, 3)), np.zeros((2, 2)))
    np.testing.assert_array_equal(first, kept)


def test_strided_arguments() -> None:
    rng = np.random.default_rng(3)
    wide = rng.uniform(-1, 1, (10, 6))
    batch = Batch(build_function())
    found = batch(wide[::2, ::2], wide[::-2, 4:])
    expected = batch(wide[::2, ::2].copy(), wide[::-2, 4:].copy())
    for one, other in zip(found, expected, strict=True):
        np.testing.assert_array_equal(one, other)


COLUMNS = Columns(z=5, h=1, tau=4)


def test_blocks_are_joined_by_name_whatever_their_order() -> None:
    tau, z = np.arange(24.0).reshape(2, 3, 4), np.arange(5.0)
    joined = COLUMNS.join(tau=tau, z=z, h=np.full((2, 1, 1), 7.0))
    assert joined.shape == (2, 3, 10)
    np.testing.assert_array_equal(joined[..., COLUMNS["tau"]], tau)
    np.testing.assert_array_equal(joined[1, 2, COLUMNS["z"]], z)
    assert (joined[..., COLUMNS["h"]] == 7.0).all()


def test_symbols_stand_where_numbers_do() -> None:
    x = COLUMNS.make_symbols()
    function = ca.Function("f", [x.every], [x.tau[1], x.h, x.z])
    given = COLUMNS.join(z=np.arange(5.0), h=[5.0], tau=6.0 + np.arange(4.0))
    second, h, z = (float(part[0]) for part in function(given))
    assert (second, h, z) == (7.0, 5.0, 0.0)


@pytest.mark.parametrize(
    "blocks",
    [
        {"z": np.zeros(5), "h": np.zeros(1)},
        {"z": np.zeros(5), "h": np.zeros(1), "tau": np.zeros(3)},
        {"z": np.zeros(5), "h": np.zeros(1), "torque": np.zeros(4)},
    ],
    ids=["missing", "too short", "another name"],
)
def test_what_was_not_declared_is_refused(blocks: dict[str, np.ndarray]) -> None:
    with pytest.raises(ValueError, match=r"are given where .* are declared"):
        COLUMNS.join(**blocks)
    with pytest.raises(ValueError, match=r"are given where .* are declared"):
        COLUMNS.write(**{name: ca.SX(block) for name, block in blocks.items()})
