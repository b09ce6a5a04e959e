"""NLPs whose nodes form a chain, copied into the stages that fatrop asks for.

Rows and costs of such an NLP belong to a node or link two neighbours. Stage k gets the unknowns of
node k as its states and, as its controls, copies of those of node k + 1: what links the two then
depends on stage k alone, and x_k+1 - u_k = 0 ties the copies. Both NLPs have the same solutions.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from ..contact import Expression
from ..fatrop import Stages, build_solver, keep_bounds, read_stats
from ..model import Array

_Numbers = NDArray[np.int64]
_COPY = -1


class Links(NamedTuple):
    """Rows or costs that belong to an interval.

    Attributes
    ----------
    values : casadi.SX, shape (n,)
        The i-th depends on the nodes interval[i] and interval[i] + 1.
    interval : ndarray of int, shape (n,)
    """

    values: Expression
    interval: _Numbers


class Chain(NamedTuple):
    """An NLP over a chain of nodes 0 .. N.

    Attributes
    ----------
    x, p : casadi.SX
        Unknowns and parameters.
    node : ndarray of int, shape (n_x,)
        The node of each unknown, never decreasing.
    links : Links
        Equations; they are the first rows of the NLP.
    rows : casadi.SX, shape (N + 1, n)
        Rows of the nodes, inequalities; they follow node by node.
    link_costs : casadi.SX, shape (N,)
    node_costs : casadi.SX, shape (N + 1,)
        The objective is the sum of all.
    """

    x: Expression
    p: Expression
    node: _Numbers
    links: Links
    rows: Expression
    link_costs: Expression
    node_costs: Expression


@dataclass(frozen=True, eq=False)
class StagedSolver:
    """fatrop on the staged copy of an NLP, called like the NLP's own solver.

    Attributes
    ----------
    solver : casadi.Function
        Of the staged copy.
    unknowns : ndarray of int
        The NLP's unknown behind each unknown of the copy.
    states : ndarray of bool
        Which of these are not copies.
    rows : ndarray of int
        The NLP's row behind each row of the copy, -1 where it ties a copy.
    """

    solver: Expression
    unknowns: _Numbers
    states: NDArray[np.bool_]
    rows: _Numbers

    def __call__(
        self, x0: Array, p: Array, lbx: Array, ubx: Array, lbg: Array, ubg: Array, **_: Any
    ) -> dict[str, Expression]:
        """Solve; multipliers to start from are ignored, as fatrop has no use for them."""
        lbx, ubx = keep_bounds(lbx, ubx)
        lbg, ubg = keep_bounds(lbg, ubg)
        result = self.solver(
            x0=x0[self.unknowns],
            p=p,
            lbx=np.where(self.states, lbx[self.unknowns], -np.inf),
            ubx=np.where(self.states, ubx[self.unknowns], np.inf),
            lbg=np.append(lbg, 0.0)[self.rows],
            ubg=np.append(ubg, 0.0)[self.rows],
        )
        own = self.rows != _COPY
        lam_g = np.zeros(len(lbg))
        lam_g[self.rows[own]] = result["lam_g"].full()[own, 0]
        return {
            "x": ca.DM(result["x"].full()[self.states]),
            "f": result["f"],
            "lam_x": ca.DM(result["lam_x"].full()[self.states]),
            "lam_g": ca.DM(lam_g),
        }

    def stats(self) -> dict[str, Any]:
        """Statistics of the last solve, under the names that Ipopt's have."""
        return read_stats(self.solver)


def stage(name: str, chain: Chain, **options: Any) -> StagedSolver:
    """Copy an NLP into stages and build its solver.

    Parameters
    ----------
    name : str
    chain : Chain
    **options
        fatrop's.
    """
    last, per_node = int(chain.node[-1]), chain.rows.size2()
    copied = np.flatnonzero(chain.node > 0)
    copies = ca.SX.sym("copies", len(copied))
    tied = _with_copies(chain, chain.links, copied, copies)
    costs = _with_copies(chain, Links(chain.link_costs, np.arange(last)), copied, copies)

    own = [np.flatnonzero(chain.node == k) for k in range(last + 1)]
    start = np.searchsorted(copied, [mine[0] for mine in own[1:]])
    x, unknowns, states, rows, origin = [], [], [], [], []
    linked = [np.flatnonzero(chain.links.interval == k) for k in range(last)]
    for k, mine in enumerate(own):
        x.append(chain.x[mine.tolist()])
        unknowns.append(mine)
        states.append(np.ones(len(mine), dtype=bool))
        if k < last:
            after = own[k + 1]
            copy = copies[int(start[k]) : int(start[k]) + len(after)]
            x.append(copy)
            unknowns.append(after)
            states.append(np.zeros(len(after), dtype=bool))
            rows += [chain.x[after.tolist()] - copy, tied[linked[k].tolist()]]
            origin += [np.full(len(after), _COPY), linked[k]]
        rows.append(chain.rows[k, :].T)
        origin.append(len(chain.links.interval) + per_node * k + np.arange(per_node))
    nlp = {
        "x": ca.vertcat(*x),
        "p": chain.p,
        "f": ca.sum1(costs) + ca.sum1(chain.node_costs),
        "g": ca.vertcat(*rows),
    }
    rows_of = np.concatenate(origin)
    sizes = _sizes(own, linked, per_node, rows_of < len(chain.links.interval))
    return StagedSolver(
        build_solver(name, nlp, sizes, **options),
        np.concatenate(unknowns),
        np.concatenate(states),
        rows_of,
    )


def _sizes(
    own: Sequence[_Numbers], linked: Sequence[_Numbers], per_node: int, equations: NDArray[np.bool_]
) -> Stages:
    states = [len(mine) for mine in own]
    rows = [per_node + len(mine) for mine in linked]
    return Stages(states, [*states[1:], 0], [*rows, per_node], equations.tolist())


def _with_copies(chain: Chain, links: Links, copied: _Numbers, copies: Expression) -> Expression:
    """What links nodes, with the later one of each two replaced by its copy."""
    values = ca.SX(links.values)
    for parity in (0, 1):
        # Where the earlier node has this parity, the later one has the other.
        later = np.flatnonzero(chain.node[copied] % 2 != parity)
        mine = np.flatnonzero(links.interval % 2 == parity).tolist()
        if mine:
            before = chain.x[copied[later].tolist()]
            values[mine] = ca.substitute(values[mine], before, copies[later.tolist()])
    return values
