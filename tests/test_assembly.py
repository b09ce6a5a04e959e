from __future__ import annotations

from typing import Any

import casadi as ca
import numpy as np
import pytest

from wholearm.common.arrays import Array, Expression
from wholearm.planning.time_domain.assembly import (
    Block,
    Kernel,
    Triplets,
    assemble_nlp,
    build_kernel,
)

SIZE = 11
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
        return np.array([rng.choice(SIZE, width, replace=False) for _ in range(count)])

    blocks = [
        Block(pair, choose(4, 3), rows[0], rng.normal(size=(4, 1))),
        Block(share, choose(5, 2), np.zeros((5, 0), dtype=np.int64), rng.normal(size=(5, 2))),
        Block(line, choose(3, 2), rows[1], rng.normal(size=(3, 1))),
    ]
    # The last linear row has no entries.
    columns = np.concatenate([rng.choice(SIZE, 3, replace=False) for _ in range(3)])
    entries = Triplets(np.repeat(linear[:3], 3), columns, rng.normal(size=9))
    cost = rng.normal(size=SIZE)
    built = assemble_nlp(SIZE, entries, linear, blocks, cost)
    x = ca.MX.sym("x", SIZE)
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
    at, on_f, on_g = rng.normal(size=SIZE), rng.normal(size=1), rng.normal(size=g.numel())
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
