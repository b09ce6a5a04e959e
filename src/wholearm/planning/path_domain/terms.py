"""Expressions of the planning NLP in the path domain: direct collocation along a curve.

On a curve z(s) everything is affine in a = s'', b = s'^2 and the internal force lambda, but for
viscous friction (`PathForces`). Unknowns are a_k, b_k and lambda_k at the nodes s_k of `elements`.
Inside each, a and lambda are polynomials, and b' = 2 a (dash: d/ds) is exact,

    b_k+1 = b_k + h sum of links_kj a_j over the nodes j of the element of length h,
    low <= rows (c, tau, theta') <= high at every node (`mechanics.limits`),
    T = sum of h weights_k / sqrt(b_k) (next to rest as in `_find_paces`).

b is continuous where two elements meet; a and lambda may step, unless torques are rate-limited
(`rate_terms`). The least margin, and the relaxation of a limit, have a copy at every node with
m_k+1 = m_k: a dense column would make building the Jacobian quadratic in the number of nodes.
"""

from __future__ import annotations

from typing import NamedTuple

import casadi as ca
import numpy as np

from ...common.arrays import Expression
from ...mechanics.limits import PRESS, TORQUE, LimitSet
from ..columns import Columns, Symbols
from ..options import Objective
from .elements import DEGREE, FROM_REST, INSIDE, POWERS, SIGNS, find_basis
from .rate_terms import UNLIMITED, MotorShape, find_first_slopes, list_kinds, write_motor_rows

CHAINED = (Objective.MARGIN, Objective.RELAX)  # with one more unknown, copied at every node
SOFT = (Objective.ELASTIC, Objective.RELAX)  # with a row for each side of the soft limits
LEAST_B = 1e-8  # least |s''| at rest and b elsewhere, over typical ones: sqrt(b) is differentiable
_CALM = 1e-6  # regularization by lambda^2: selects among equally good plans
_ROUGH = 0.1  # regularization by the highest Legendre coefficients: no oscillation within elements
_EVEN = 1e-4  # regularization by changes of a between nodes, in elastic mode
_STIFF = 1e3  # `_ROUGH` for nonlinear s'', next to rest nonconstant, in elastic mode, over that


class LimitShape(NamedTuple):
    """Structure of the limits that an NLP is built for."""

    rows: int  # number m of rows
    sides: tuple[tuple[int, float], ...]  # row and sign of each, in the order of `LimitSet.sides`
    presses: tuple[int, ...]  # rows of the least normal forces
    torques: tuple[int, ...]  # rows of the torques
    fast: tuple[int, ...]  # rows that depend on s'
    motors: MotorShape = UNLIMITED

    @staticmethod
    def of(limits: LimitSet, motors: MotorShape = UNLIMITED) -> LimitShape:
        """The shape of a set of limits."""
        rows, signs, _ = limits.sides
        of_tau, of_rates = (part.any(axis=1) for part in limits.columns[1:])
        drags = np.array([limits.limits[k].drags for k in limits.owners])
        return LimitShape(
            len(limits.low),
            tuple(zip(rows.tolist(), signs.tolist(), strict=True)),
            tuple(limits.of(PRESS).tolist()),
            tuple(limits.of(TORQUE).tolist()),
            tuple(np.flatnonzero(of_tau | of_rates | drags).tolist()),
            motors,
        )


class NLPColumns(NamedTuple):
    """Blocks of the vectors of an NLP."""

    # unknowns of each node: b over its size (none at the two ends), a, internal force, and `extra`:
    # shortfalls for `elastic`, the least margin, or the relaxation for `relax`
    node: Columns
    # speeds at the `ends`, `steps`, `weight` of time, unit of internal force in the regularization;
    # coefficients of the limits at the nodes, column by column (the constant ones are part of the
    # bounds); constant torques and weights of joints for `effort`; how limits and b's one give way
    # for `relax`; 1 / rate limits, lags, bends of elements and `sizes` of b for rate limits
    p: Columns
    # b' = 2 a; the `chain` of the margin or the relaxation; node by node the `limits`, side by side
    # where they are soft, and the speed for `relax`; the `duration` for `margin`; rate limits
    g: Columns


def list_columns(shape: LimitShape, intervals: int, objective: Objective) -> NLPColumns:
    """The blocks of the vectors of an NLP."""
    n, m, relax = intervals + 1, shape.rows, objective is Objective.RELAX
    chained = objective in CHAINED
    extra = m if objective is Objective.ELASTIC else int(chained)
    p = {"ends": 2, "steps": intervals, "weight": 1, "calm": 1, "a": n * m, "b": n * m}
    p |= {"lam": n * m, "speed": n * len(shape.fast)}
    if objective is Objective.EFFORT or shape.motors.slow:
        p |= {"torque": n * 2}
    if objective is Objective.EFFORT:
        p |= {"joints": 2}
    elif relax:
        p |= {"gives": m + 1, "rates": n}
    if shape.motors.slow:
        p |= {"quick": len(shape.motors.rates), "lags": len(shape.motors.commands)}
        p |= {"bends": n // (DEGREE + 1), "sizes": n}
    rows = (len(shape.sides) if objective in SOFT else m) + relax
    g = {"links": intervals, "chain": intervals * chained, "limits": n * rows}
    g |= {"duration": int(objective is Objective.MARGIN)} | shape.motors.list_sizes(intervals)
    return NLPColumns(Columns(b=1, a=1, lam=1, extra=extra), Columns(**p), Columns(**g))


def write_terms(shape: LimitShape, intervals: int, objective: Objective) -> dict[str, Expression]:
    """Write the NLP for every phase with limits of a shape; see `NLPColumns` for its vectors.

    Returns
    -------
    dict  expressions of x, p, f and g
    """
    n, columns = intervals + 1, list_columns(shape, intervals, objective)
    symbols = columns.p.make_symbols()
    b_inner, a, lam = ca.SX.sym("b", n - 2), ca.SX.sym("a", n), ca.SX.sym("lam", n)
    extra = ca.SX.sym("extra", n, columns.node.sizes["extra"])
    h, ends, fast = symbols.steps, symbols.ends, list(shape.fast)
    # Under rate limits b is scaled: next to rest it is many orders of magnitude smaller.
    bends, sizes = (symbols.bends.T, symbols.sizes) if shape.motors.slow else (None, ca.DM.ones(n))
    b = ca.vertcat(ends[0] ** 2, b_inner * sizes[1:-1], ends[1] ** 2)
    speed = ca.vertcat(ends[0], ca.sqrt(b[1:-1]), ends[1])
    largest = ca.fmax(sizes[1:], sizes[:-1])
    lengths, paces = _find_lengths(h), _find_paces(a, speed, h, bends)
    times = ca.vec(ca.DM(find_basis().weights) @ lengths / paces)

    def scale(name: str, column: Expression) -> Expression:
        table = ca.reshape(getattr(symbols, name), n, -1)
        return table * ca.repmat(column, 1, table.shape[1])

    # Limits but for their constant part, which is in the bounds.
    values = scale("a", a) + scale("b", b) + scale("lam", lam)
    values[:, fast] += scale("speed", speed)
    torques = values[:, list(shape.torques)]
    if objective is Objective.EFFORT or shape.motors.slow:
        torques += ca.reshape(symbols.torque, n, 2)
    # The relaxation has to outweigh the regularization.
    share = 1e-3 if objective is Objective.RELAX else 1.0
    scaled_lam, node_weights = symbols.calm * lam, ca.vertcat(0, h) + ca.vertcat(h, 0)
    node_costs = share * _CALM * node_weights * scaled_lam**2
    rough = _find_bends(a, DEGREE) + _find_bends(scaled_lam, DEGREE)
    if objective is Objective.ELASTIC:
        # Soft limits would otherwise be avoided by motions that reverse between nodes.
        slopes, bends = _find_bends(a, 1), _find_bends(a, 2)
        rough += _STIFF * ca.horzcat(slopes[0], bends[1:-1], slopes[-1])
        node_costs[:-1] += _EVEN * (a[1:] - a[:-1]) ** 2
    node_costs[0] += share * _ROUGH * ca.sum2(lengths * rough)
    if objective is Objective.TIME:
        node_costs += times
    elif objective is Objective.EFFORT:
        node_costs += times * (torques**2 @ symbols.joints + symbols.weight)
    elif objective is Objective.MARGIN:
        node_costs[0] -= extra[0]
    elif objective is Objective.ELASTIC:
        # Not weighted by lengths, or shortfalls at short intervals would be cheap.
        node_costs += ca.sum2(extra) / n + 1e-4 * times
    else:
        node_costs[0] += extra[0]
        node_costs += 1e-5 * times
    nodes = ca.horzcat(ca.vertcat(0, b_inner, 0), a, lam, extra).T
    chained, late = objective in CHAINED, objective is Objective.MARGIN
    rows = _write_limits(shape, objective, symbols, values, extra, b)
    return {
        "x": ca.vertcat(nodes[1:, 0], ca.vec(nodes[:, 1:-1]), nodes[1:, -1]),
        "p": symbols.every,
        "f": ca.sum1(node_costs),
        "g": columns.g.write(
            links=(b[1:] - b[:-1] - _write_rises(a, h, bends)) / largest,
            chain=extra[1:] - extra[:-1] if chained else ca.SX(0, 1),
            limits=rows.T,
            duration=ca.sum1(times) if late else ca.SX(0, 1),
            **write_motor_rows(shape.motors, symbols, torques, a, paces, lengths),
        ),
    }


def _find_lengths(h: Expression) -> Expression:
    """Length of each element, shape (1, E)."""
    return ca.sum1(ca.reshape(ca.vertcat(h, 0), DEGREE + 1, -1))


def _write_rises(a: Expression, h: Expression, bends: Expression | None) -> Expression:
    """Rise of b from each node to the next, shape (N,); with `bends` under rate limits."""
    table, lengths = ca.reshape(a, DEGREE + 1, -1), _find_lengths(h)
    count = lengths.numel()
    links, kinds = find_basis().links, list_kinds(count, bends is not None)
    rises = ca.horzcat(*(ca.DM(links[kind]) @ table[:, k] for k, kind in enumerate(kinds)))
    if bends is not None:
        inner = ca.DM(links[FROM_REST] - links[INSIDE]) @ table[:, 1:-1]
        rises[:, 1:-1] += inner * ca.repmat(bends[1:-1], DEGREE, 1)
    rises = rises * ca.repmat(lengths, DEGREE, 1)
    return ca.vec(ca.vertcat(rises, ca.SX(1, count)))[:-1]


def _find_paces(
    a: Expression, speed: Expression, h: Expression, bends: Expression | None
) -> Expression:
    """Rate dy/dt of the local variable at each node, times the element's length, (p + 1, E)."""
    basis, held = find_basis(), bends is not None
    lengths = _find_lengths(h)
    count = lengths.numel()
    paces = ca.reshape(speed, DEGREE + 1, -1)
    if bends is not None:
        c = ca.repmat(bends[1:-1], DEGREE + 1, 1)
        paces[:, 1:-1] /= 1 - c + 2 * c * ca.repmat(ca.DM(basis.y[INSIDE]), 1, count - 2)
    slopes = find_first_slopes(a) if held else (a[0], a[-1])
    # Next to rest the speed is a power of the local variable times a smooth factor.
    for e, kind in ((0, list_kinds(count, held)[0]), (count - 1, list_kinds(count, held)[-1])):
        rest, power = 0 if SIGNS[kind] > 0 else DEGREE, int(POWERS[kind])
        for j, y in enumerate(basis.y[kind].tolist()):
            growth = SIGNS[kind] * slopes[0 if e == 0 else 1]
            start = ca.sqrt((1.5 if held else 2) * lengths[e] * growth)
            paces[j, e] = (start if j == rest else paces[j, e] / y ** (power - 1)) / power
    return paces


def _find_bends(values: Expression, degree: int) -> Expression:
    """Sum of the squared Legendre coefficients of each element from a degree on, shape (1, E)."""
    modes = ca.DM(find_basis().modes[degree:]) @ ca.reshape(values, DEGREE + 1, -1)
    return ca.sum1(modes**2)


def _write_limits(
    shape: LimitShape,
    objective: Objective,
    symbols: Symbols,
    values: Expression,
    extra: Expression,
    b: Expression,
) -> Expression:
    """The rows of the limits at the nodes, shape (n, m) or (n, n_sides), and one for the speed."""
    if objective is Objective.MARGIN:
        raised = np.isin(np.arange(shape.rows), shape.presses).astype(float)
        return values - extra @ ca.DM(raised).T
    if objective not in SOFT:
        return values
    relax = objective is Objective.RELAX
    short = extra @ symbols.gives.T if relax else extra
    rows = [values[:, row] + sign * short[:, row] for row, sign in shape.sides]
    if relax:
        rows.append(symbols.rates * b - short[:, shape.rows])
    return ca.horzcat(*rows)
