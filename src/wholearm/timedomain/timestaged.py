"""The time-domain NLP in the order of stages that fatrop asks for.

Each node is a stage: its states are z, w and T, its controls what follows up to the next node. The
rows that define the next node's states come first in a stage, then all that depend on it alone.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np

from ..contact import Expression
from ..fatrop import Stages, build_solver, keep_bounds, read_stats
from ..model import Array
from .blocknlp import Indices, Triplets, assemble_nlp
from .timelayout import StageLayout
from .timerows import Rows


@dataclass(frozen=True, eq=False)
class StagedSolver:
    """fatrop on the reordered rows, called like the NLP's own solver.

    Attributes
    ----------
    solver : casadi.Function
    order : ndarray of int
        The NLP's row behind each row.
    """

    solver: Expression
    order: Indices

    def __call__(
        self, x0: Array, lbx: Array, ubx: Array, lbg: Array, ubg: Array, **_: Any
    ) -> dict[str, Expression]:
        """Solve; multipliers to start from are ignored, as fatrop has no use for them."""
        lbx, ubx = keep_bounds(lbx, ubx)
        lbg, ubg = keep_bounds(lbg, ubg)
        result = self.solver(x0=x0, lbx=lbx, ubx=ubx, lbg=lbg[self.order], ubg=ubg[self.order])
        lam_g = np.empty(len(self.order))
        lam_g[self.order] = result["lam_g"].full()[:, 0]
        return {**result, "lam_g": ca.DM(lam_g)}

    def stats(self) -> dict[str, Any]:
        """Statistics of the last solve, under the names that Ipopt's have."""
        return read_stats(self.solver)


def build_staged_solver(
    rows: Rows, layouts: Sequence[StageLayout], cost: Array, max_iter: int
) -> StagedSolver:
    """Reorder rows by stages and build the solver.

    Parameters
    ----------
    rows : Rows
    layouts : sequence of StageLayout
    cost : ndarray
        Linear part of the cost.
    max_iter : int
    """
    nodes = np.concatenate([layout.nodes for layout in layouts])
    owner = np.searchsorted(nodes[:, 0], np.arange(len(cost)), side="right") - 1
    low, high = rows.bounds
    first, last = _span(rows, len(low))
    begins, links = owner[first], owner[last] > owner[first]
    # What defines a state follows the order of the states, whose column is the row's last.
    order = np.lexsort((np.where(links, last, np.arange(len(low))), ~links, begins))
    position = np.empty_like(order)
    position[order] = np.arange(len(order))
    triplets = rows.triplets
    built = assemble_nlp(
        len(cost),
        Triplets(position[triplets.rows], triplets.columns, triplets.values),
        position[rows.linear_rows],
        [block._replace(rows=position[block.rows]) for block in rows.blocks],
        cost,
    )
    count = len(nodes)
    states = [nodes.shape[1]] * count
    sizes = np.bincount(owner, minlength=count) - nodes.shape[1]
    alone = np.bincount(begins[~links], minlength=count)
    equations = (low == high)[order]
    stages = Stages(states, sizes.tolist(), alone.tolist(), equations.tolist())
    # Guesses are rougher here than along curves.
    rough = {"mu_init": 1e-2, "bound_push": 1e-2, "tolerance": 1e-8}
    solver = build_solver("time_nlp", built.nlp, stages, max_iter=max_iter, **rough)
    return StagedSolver(solver, order)


def _span(rows: Rows, count: int) -> tuple[Indices, Indices]:
    """First and last unknown that each row depends on."""
    first, last = np.full(count, np.iinfo(np.int64).max), np.full(count, -1)
    triplets = rows.triplets
    np.minimum.at(first, triplets.rows, triplets.columns)
    np.maximum.at(last, triplets.rows, triplets.columns)
    for block in rows.blocks:
        i, j = block.kernel.jacobian_at
        if block.rows.size:
            np.minimum.at(first, block.rows[:, i], block.columns[:, j])
            np.maximum.at(last, block.rows[:, i], block.columns[:, j])
    return first, last
