"""The expressions of the planning NLP of one-freedom phases.

On a curve z(s) everything is affine in a = s'', b = s'^2 and the squeeze lambda, but for viscous
friction (`mechanics.dynamics.PathForces`). The unknowns are a_k, b_k and lambda_k at the nodes s_k
of `elements`: inside each, a and lambda are polynomials, and b' = 2 a (dash: d/ds) is exact,

    b_k+1 = b_k + h sum of links_kj a_j over the nodes j of the element of length h,
    low <= rows (c, tau, theta') <= high at every node (`mechanics.limits`),
    T = sum of h weights_k / sqrt(b_k) (next to rest as said in `_find_paces`).

Where two elements meet, b is the same and a and lambda may jump, unless motors are slow
(`motor_terms`).

The least margin, and the relaxation of a limit, have an unknown at every node with m_k+1 = m_k. A
column through all rows would make building the Jacobian quadratic in the number of nodes.
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

CHAINED = (Objective.MARGIN, Objective.RELAX)
"""Objectives with one more unknown, which every node has a copy of."""
SOFT = (Objective.ELASTIC, Objective.RELAX)
"""Objectives for which limits give way, so that each side of a limit has a row of its own."""
LEAST_B = 1e-8
"""Least s'' at rest, in units of the typical one, and least b far away from it; next to rest b goes
with the way. Keeps the square root differentiable."""
_CALM = 1e-6  # weight of the squeeze against the objective: picks one among equally good ones
_ROUGH = 0.1
"""Weight of the highest polynomial of a and lambda in each element: rules out that they bend at a
single node towards other limits than around it. It falls fast where the plan is smooth."""
_EVEN = 1e-4  # weight of changes of a from node to node where limits give way
_STIFF = 1e3
"""The same, over that, where limits give way, for s'' that is not linear in an element, or next to
rest not constant."""


class LimitShape(NamedTuple):
    """What an NLP has to know of limits, whatever they are of."""

    rows: int  # number m of rows
    # row and sign of each side, in the order of `LimitSet.sides`
    sides: tuple[tuple[int, float], ...]
    # presses, torques, fast: rows of the least normal forces and of the torques, and those that
    # know of the speed
    presses: tuple[int, ...]
    torques: tuple[int, ...]
    fast: tuple[int, ...]
    motors: MotorShape = UNLIMITED

    @staticmethod
    def of(limits: LimitSet, motors: MotorShape = UNLIMITED) -> LimitShape:
        """The shape of a set of limits."""
        rows, signs, _ = limits.sides
        known = [part.any(axis=1) for part in limits.columns[1:]]
        drags = np.array([limits.limits[k].drags for k in limits.owners])
        return LimitShape(
            len(limits.low),
            tuple(zip(rows.tolist(), signs.tolist(), strict=True)),
            tuple(limits.of(PRESS).tolist()),
            tuple(limits.of(TORQUE).tolist()),
            tuple(np.flatnonzero(known[0] | known[1] | drags).tolist()),
            motors,
        )


class NLPColumns(NamedTuple):
    """What the vectors of an NLP consist of."""

    # unknowns of each node: b over its size (none at the two ends), a, squeeze, and what the
    # objective adds: shortfalls of the limits for `elastic`, the least margin, or the relaxation
    # for `relax`
    node: Columns
    # the speeds at the `ends`; the `steps`; the `weight` of time; what the unit of squeeze counts
    # for where it is kept `calm`; column by column, coefficients of the limits at the nodes but for
    # the constant ones, which are part of the bounds; for `effort` and slow motors the constant
    # torques; for `effort` the weight of each joint; for `relax` by how much each limit gives way
    # with the relaxation, and b's coefficients in the speed limit; for slow motors one over their
    # largest rates, their lags, the bends of elements and the `sizes` of b
    p: Columns
    # the N of b' = 2 a; those that `chain` the margin or the relaxation; node by node the `limits`,
    # side by side where they are soft, and the speed for `relax`; the `duration` for `margin`; the
    # rows of motors
    g: Columns


def list_columns(shape: LimitShape, intervals: int, objective: Objective) -> NLPColumns:
    """List what the vectors of an NLP consist of."""
    n, m, relax = intervals + 1, shape.rows, objective is Objective.RELAX
    chained, fast = objective in CHAINED, len(shape.fast)
    extra = m if objective is Objective.ELASTIC else int(chained)
    p = {"ends": 2, "steps": intervals, "weight": 1, "calm": 1, "a": n * m, "b": n * m}
    p |= {"squeeze": n * m, "speed": n * fast}
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
    return NLPColumns(Columns(b=1, a=1, squeeze=1, extra=extra), Columns(**p), Columns(**g))


def write_terms(shape: LimitShape, intervals: int, objective: Objective) -> dict[str, Expression]:
    """Write the NLP for every phase with limits of a shape; see `NLPColumns` for its vectors.

    Returns
    -------
    dict  expressions of x, p, f and g
    """
    n, columns = intervals + 1, list_columns(shape, intervals, objective)
    given = columns.p.make_symbols()
    b_inner, a, squeeze = ca.SX.sym("b", n - 2), ca.SX.sym("a", n), ca.SX.sym("squeeze", n)
    extra, h, ends = (
        ca.SX.sym("extra", n, columns.node.sizes["extra"]),
        given.steps,
        given.ends,
    )
    # Where motors are slow, b next to rest is many orders of magnitude below what it is elsewhere.
    bends, sizes = (given.bends.T, given.sizes) if shape.motors.slow else (None, ca.DM.ones(n))
    b = ca.vertcat(ends[0] ** 2, b_inner * sizes[1:-1], ends[1] ** 2)
    speed = ca.vertcat(ends[0], ca.sqrt(b[1:-1]), ends[1])
    largest = ca.fmax(sizes[1:], sizes[:-1])
    lengths, paces = _find_lengths(h), _find_paces(a, speed, h, bends)
    times = ca.vec(ca.DM(find_basis().weights) @ lengths / paces)
    values = _write_values(shape, given, (a, b, squeeze, speed))
    torques = values[:, list(shape.torques)]
    if objective is Objective.EFFORT or shape.motors.slow:
        torques += ca.reshape(given.torque, n, 2)
    # What is relaxed has to be as little as possible, whatever the motion is like.
    share = 1e-3 if objective is Objective.RELAX else 1.0
    squeezed, node_weights = given.calm * squeeze, ca.vertcat(0, h) + ca.vertcat(h, 0)
    node_costs = share * _CALM * node_weights * squeezed**2
    rough = _find_bends(a, DEGREE) + _find_bends(squeezed, DEGREE)
    if objective is Objective.ELASTIC:
        # Limits that give way would otherwise be spared by motions that turn back between nodes.
        slopes, bends = _find_bends(a, 1), _find_bends(a, 2)
        rough += _STIFF * ca.horzcat(slopes[0], bends[1:-1], slopes[-1])
        node_costs[:-1] += _EVEN * (a[1:] - a[:-1]) ** 2
    node_costs[0] += share * _ROUGH * ca.sum2(lengths * rough)
    if objective is Objective.TIME:
        node_costs += times
    elif objective is Objective.EFFORT:
        node_costs += times * (torques**2 @ given.joints + given.weight)
    elif objective is Objective.MARGIN:
        node_costs[0] -= extra[0]
    elif objective is Objective.ELASTIC:
        # Every node counts alike: where intervals are short, being short must not be cheap.
        node_costs += ca.sum2(extra) / n
        node_costs += 1e-4 * times
    else:
        node_costs[0] += extra[0]
        node_costs += 1e-5 * times
    nodes = ca.horzcat(ca.vertcat(0, b_inner, 0), a, squeeze, extra).T
    chained, late = objective in CHAINED, objective is Objective.MARGIN
    rows = _write_limits(shape, objective, given, values, extra, b)
    return {
        "x": ca.vertcat(nodes[1:, 0], ca.vec(nodes[:, 1:-1]), nodes[1:, -1]),
        "p": given.every,
        "f": ca.sum1(node_costs),
        "g": columns.g.write(
            links=(b[1:] - b[:-1] - _write_rises(a, h, bends)) / largest,
            chain=extra[1:] - extra[:-1] if chained else ca.SX(0, 1),
            limits=rows.T,
            duration=ca.sum1(times) if late else ca.SX(0, 1),
            **write_motor_rows(shape.motors, given, torques, a, paces, lengths),
        ),
    }


def _find_lengths(h: Expression) -> Expression:
    """Length of each element, shape (1, E)."""
    return ca.sum1(ca.reshape(ca.vertcat(h, 0), DEGREE + 1, -1))


def _write_rises(a: Expression, h: Expression, bends: Expression | None) -> Expression:
    """By how much b rises from each node to the next, shape (N,); `bends` where motors are slow."""
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
    """How fast the local variable is at each node, times the element's length, (p + 1, E)."""
    basis, held = find_basis(), bends is not None
    lengths = _find_lengths(h)
    count = lengths.numel()
    paces = ca.reshape(speed, DEGREE + 1, -1)
    if bends is not None:
        c = ca.repmat(bends[1:-1], DEGREE + 1, 1)
        paces[:, 1:-1] /= 1 - c + 2 * c * ca.repmat(ca.DM(basis.y[INSIDE]), 1, count - 2)
    slopes = find_first_slopes(a) if held else (a[0], a[-1])
    # Next to rest the speed is a power of the local variable but for a factor that is smooth.
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


def _write_values(shape: LimitShape, given: Symbols, motion: tuple[Expression, ...]) -> Expression:
    """What limits are of, but for the constant part, shape (n, m)."""
    a, b, squeeze, speed = motion
    n, m, fast = a.numel(), shape.rows, list(shape.fast)

    def scale(name: str, column: Expression, count: int) -> Expression:
        return ca.reshape(getattr(given, name), n, count) * ca.repmat(column, 1, count)

    values = scale("a", a, m) + scale("b", b, m) + scale("squeeze", squeeze, m)
    values[:, fast] += scale("speed", speed, len(fast))
    return values


def _write_limits(
    shape: LimitShape,
    objective: Objective,
    given: Symbols,
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
    short = extra @ given.gives.T if relax else extra
    rows = [values[:, row] + sign * short[:, row] for row, sign in shape.sides]
    if relax:
        rows.append(given.rates * b - short[:, shape.rows])
    return ca.horzcat(*rows)
