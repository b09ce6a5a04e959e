"""The expressions of the planning NLP of one-freedom phases.

On a curve z(s) everything is affine in a = s'', b = s'^2 and the squeeze lambda, but for viscous
friction (`mechanics.dynamics.PathForces`). At the nodes s_k of a grid the unknowns are a_k, b_k and
lambda_k; between two nodes a and lambda are linear in s, and b' = 2 a (dash: d/ds) is then exact:

    b_k+1 = b_k + (s_k+1 - s_k) (a_k + a_k+1),
    H c >= least,  |tau| <= limit at every node,
    T = sum of 2 (s_k+1 - s_k) / (sqrt(b_k) + sqrt(b_k+1)).

H c are the normal forces, and the friction cones of contacts that roll (`contacts.cones`).

Where a direction reverses, the grid has an interval of length zero: b is the same on its two sides,
a and lambda may jump.

The least margin, and the relaxation of a limit, have an unknown at every node with m_k+1 = m_k. A
column through all rows would make building the Jacobian quadratic in the number of nodes.
"""

from __future__ import annotations

import casadi as ca

from ...common.arrays import Expression
from ..options import Objective

CHAINED = (Objective.MARGIN, Objective.RELAX)
"""Objectives with one more unknown, which every node has a copy of."""
LEAST_B = 1e-8
"""Least b away from rest, in units of the typical one; keeps the square root differentiable."""
_CALM = 1e-4
"""Weight of the squeeze against the objective: picks one among equally good ones."""
_SMOOTH = 1e-5
"""Weight of changes of a and lambda: rules out ripple that the objective does not see."""


def count_extras(objective: Objective, n_held: int) -> int:
    """Unknowns per node besides b, a and squeeze: shortfalls, or the margin or relaxation."""
    return n_held + 2 if objective is Objective.ELASTIC else int(objective in CHAINED)


def write_terms(
    n_contacts: int, intervals: int, objective: Objective, n_rolling: int
) -> dict[str, Expression]:
    """Write the NLP for every phase of so many contacts, of which so many roll.

    The unknowns are (b, a, squeeze, extras) node by node, without b at the two ends. The extras
    are shortfalls for `elastic`, the least margin for `margin` and the relaxation for `relax`. The
    parameters are the speeds at the ends, the steps, the weight of time, what the unit of squeeze
    counts for where it is kept calm, and the coefficients of `PathForces` but for C0 and T0, which
    are part of the bounds; for `effort` also T0 and the weight of each joint's torque, for `relax`
    what the relaxation is worth for each limit, and b's coefficients in the speed limit. The rows
    are the N of b' = 2 a, those that chain the margin or the relaxation, and the changes of a over
    the first and the last interval; then node by node H c and tau, and the speed for `relax`; last
    T for `margin`.

    Parameters
    ----------
    n_contacts, intervals : int
    objective : Objective
    n_rolling : int

    Returns
    -------
    dict
        Expressions of x, p, f and g.
    """
    n, n_held = intervals + 1, n_contacts + 2 * n_rolling
    m = n_held + 2
    b_inner, ends = ca.SX.sym("b", n - 2), ca.SX.sym("ends", 2)
    a, squeeze = ca.SX.sym("a", n), ca.SX.sym("squeeze", n)
    extra = ca.SX.sym("extra", n, count_extras(objective, n_held))
    h = ca.SX.sym("h", intervals)
    weight, calm = ca.SX.sym("weight"), ca.SX.sym("calm")
    coefficients = [ca.SX.sym(name, n, m) for name in ("Pa", "Pb", "Pl")] + [ca.SX.sym("Tv", n, 2)]
    b = ca.vertcat(ends[0] ** 2, b_inner, ends[1] ** 2)
    speed = ca.vertcat(ends[0], ca.sqrt(b_inner), ends[1])

    def spread(column: Expression) -> Expression:
        return ca.repmat(column, 1, m)

    Pa, Pb, Pl, Tv = coefficients
    forces = Pa * spread(a) + Pb * spread(b) + Pl * spread(squeeze)
    held, tau = forces[:, :n_held], forces[:, n_held:] + Tv * ca.repmat(speed, 1, 2)
    interval_times = 2 * h / (speed[:-1] + speed[1:])
    node_weights = ca.vertcat(0, h) + ca.vertcat(h, 0)
    # What is relaxed has to be as little as possible, whatever the motion is like.
    share = 1e-3 if objective is Objective.RELAX else 1.0
    squeezed = calm * squeeze
    node_costs = share * _CALM * node_weights * squeezed**2
    link_costs = share * _SMOOTH * h * ((a[1:] - a[:-1]) ** 2 + (squeezed[1:] - squeezed[:-1]) ** 2)
    links = [b[1:] - b[:-1] - h * (a[1:] + a[:-1])]
    c_rows, tau_rows = held, tau
    last: tuple[Expression, ...] = ()
    if objective in CHAINED:
        links.append(extra[1:] - extra[:-1])
    if objective is Objective.TIME:
        link_costs += interval_times
    elif objective is Objective.EFFORT:
        # The bounds hold T0, so the full torque is passed as a parameter for the integrand only.
        T0, joints = ca.SX.sym("T0", n, 2), ca.SX.sym("joints", 2)
        coefficients += [T0, joints]
        full = tau + T0
        squares = full[:-1, :] ** 2 + full[:-1, :] * full[1:, :] + full[1:, :] ** 2
        link_costs += interval_times * (squares @ joints / 3 + weight)
    elif objective is Objective.MARGIN:
        c_rows = held - extra @ ca.horzcat(ca.DM.ones(1, n_contacts), ca.DM(1, 2 * n_rolling))
        node_costs[0] -= extra[0]
        last = (ca.sum1(interval_times),)
    elif objective is Objective.ELASTIC:
        # Every node counts alike: where intervals are short, being short must not be cheap.
        node_costs += ca.sum2(extra) / n
        link_costs += 1e-4 * interval_times
        short = extra
    else:
        weights, Rb = ca.SX.sym("worth", 1, m + 1), ca.SX.sym("Rb", n)
        coefficients += [weights, Rb]
        short = extra @ weights
        node_costs[0] += extra[0]
        link_costs += 1e-5 * interval_times
    if objective in (Objective.ELASTIC, Objective.RELAX):
        c_rows, easing = held + short[:, :n_held], short[:, n_held:m]
        tau_rows = ca.horzcat(tau + easing, tau - easing)
    if objective is Objective.RELAX:
        tau_rows = ca.horzcat(tau_rows, Rb * b - short[:, m])
    nodes = ca.horzcat(b, a, squeeze, extra).T
    rows = ca.horzcat(c_rows, tau_rows)
    return {
        "x": ca.vertcat(nodes[1:, 0], ca.vec(nodes[:, 1:-1]), nodes[1:, -1]),
        "p": ca.vertcat(ends, h, weight, calm, *(ca.vec(block) for block in coefficients)),
        "f": ca.sum1(link_costs) + ca.sum1(node_costs),
        "g": ca.vertcat(*links, a[1] - a[0], a[-1] - a[-2], ca.vec(rows.T), *last),
    }
