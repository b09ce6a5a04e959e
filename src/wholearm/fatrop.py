"""fatrop, an interior-point solver for staged NLPs: optional, for small dense stages often faster.

What an NLP has to provide, with stages k = 0 .. N of states x_k and controls u_k:

- the unknowns x_0, u_0, x_1, u_1, .. x_N, u_N, in this order; every stage has an unknown;
- its rows stage by stage: first x_k+1 - F(x_k, u_k) = 0, one for each state of the next stage, in
  the order of these states and with a coefficient of exactly 1; then the rows that depend on
  x_k and u_k only, equations and inequalities in any order. Stage N has only the latter;
- an objective that is a sum of functions of one (x_k, u_k) each: its Hessian outside of the
  stages' blocks is dropped without a word;
- bounds that say the same row by row: the rows that are `equations` get equal bounds, others not;
- expressions that are finite for *all* unknowns. fatrop keeps bounds at its solution, not on the
  way, and goes on for ever once a Hessian is not a number. So not sqrt(b), but
  sqrt(fmax(b, least));
- unknowns scaled to about 1.

It starts from x0 alone: it has no use for multipliers. Bounds have to go through `keep_bounds`, or
they are missed by some 1e-8.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import casadi as ca
import numpy as np

from .contact import Expression
from .model import Array

_OPTIONS = {
    "print_level": 0,
    # The complementarity left at the end is of this size per row, and adds up over the rows.
    "tolerance": 1e-9,
    # Without multipliers a start is only as good as the barrier is low.
    "mu_init": 1e-5,
    "bound_push": 1e-8,
    "mu_superlinear_decrease_power": 1.2,
    "max_iter": 300,
}
_RELAXED = 1e-8
"""By how much fatrop relaxes bounds, relative to the larger of 1 and theirs; it is no option."""
_STATUS = (
    "solved",
    "too many iterations",
    "too small a step",
    "an acceptable point",
    "a locally infeasible point",
    "a feasible point",
    "diverging iterates",
    "no step",
    "an invalid option",
    "an internal error",
)


class Stages(NamedTuple):
    """Sizes of the stages k = 0 .. N.

    Attributes
    ----------
    states, controls : sequence of int
        How many unknowns x_k and u_k.
    rows : sequence of int
        How many rows depend on stage k alone.
    equations : sequence of bool
        For every row of the NLP, whether it is an equation.
    """

    states: Sequence[int]
    controls: Sequence[int]
    rows: Sequence[int]
    equations: Sequence[bool]


def build_solver(
    name: str, nlp: dict[str, Expression], stages: Stages, **options: Any
) -> Expression:
    """Return a CasADi function that solves a staged NLP with fatrop.

    Parameters
    ----------
    name : str
    nlp : dict
        Expressions of x, p, f and g; see the module for what they have to be.
    stages : Stages
    **options
        fatrop's, over those that all NLPs share.
    """
    casadi_options = {
        "fatrop": _OPTIONS | options,
        "structure_detection": "manual",
        "N": len(stages.states) - 1,
        "nx": list(stages.states),
        "nu": list(stages.controls),
        "ng": list(stages.rows),
        "equality": list(stages.equations),
        "print_time": False,
        "record_time": True,
        "calc_lam_p": False,
        "show_eval_warnings": False,
        "error_on_fail": False,
    }
    return ca.nlpsol(name, "fatrop", nlp, casadi_options)


def keep_bounds(low: Array, high: Array) -> tuple[Array, Array]:
    """Bounds that fatrop relaxes to `low` and `high`; equal ones stay."""
    loose = low < high

    def inset(bound: Array) -> Array:
        return np.where(loose & np.isfinite(bound), _RELAXED * np.maximum(1.0, np.abs(bound)), 0.0)

    return low + inset(low), high - inset(high)


def read_stats(solver: Expression) -> dict[str, Any]:
    """Statistics of the last solve, under the names that Ipopt's have."""
    stats: dict[str, Any] = solver.stats()
    return stats | {"return_status": describe_status(solver)}


def describe_status(solver: Expression) -> str:
    """Say in words how the last solve ended."""
    flag = solver.stats()["fatrop"]["return_flag"]
    return _STATUS[flag] if 0 <= flag < len(_STATUS) else f"status {flag}"
