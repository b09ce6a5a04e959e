"""Multipliers to start from: of one size, or those of a solution on other intervals."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ...common.arrays import Array
from .assembly import Indices
from .collocation import Scheme
from .equations import StageRows
from .motors import MotorRows
from .nlp import TimeNLP
from .stage import Stage, StagePoints

FIRST_SIZE = 1e-2
"""Multipliers of a first guess."""

Multipliers = dict[str, Array]
"""Of the unknowns' bounds, `lam_x0`, and of the rows, `lam_g0`."""


def first_multipliers(
    bounds: Sequence[Array], row_bounds: Sequence[Array], size: float = FIRST_SIZE
) -> Multipliers:
    """Multipliers of one size for all inequalities.

    Parameters
    ----------
    bounds, row_bounds : two arrays each
        Lower and upper bounds of unknowns and rows.
    size : float
    """
    (low, high), (low_g, high_g) = bounds, row_bounds
    bounded = np.isfinite(high).astype(float) - np.isfinite(low)
    return {"lam_x0": size * bounded, "lam_g0": np.where(high_g > low_g, -size, 0.0)}


def carry_multipliers(
    multipliers: Multipliers,
    old: TimeNLP,
    new: TimeNLP,
    scheme: Scheme,
    old_stages: Sequence[Stage],
    new_stages: Sequence[Stage],
) -> Multipliers:
    """Multipliers of the same stages on other intervals.

    What is said at points goes with the length of an interval, as the sum over time matters. Those
    of collocation are costates, which are continuous.
    """
    on_x, on_g = multipliers["lam_x0"], multipliers["lam_g0"]
    lam_x, lam_g = np.zeros(new.layouts[-1].stop), np.zeros(len(new.rows.bounds[0]))
    once = [_list_once(nlp) for nlp in (new, old)]
    if len(once[0]) == len(once[1]):
        lam_g[once[0]] = on_g[once[1]]
    for k, (before, after) in enumerate(zip(old_stages, new_stages, strict=True)):
        part, finer = before.guess, after.guess
        middles = finer.breaks[:-1] + finer.fractions / 2
        parent = np.searchsorted(part.breaks, middles, side="right") - 1
        share = finer.fractions / part.fractions[parent]
        for name in ("tau", "v", "forces"):
            mine, theirs = getattr(new.layouts[k], name), getattr(old.layouts[k], name)
            values = on_x[theirs[parent]]
            lam_x[mine] = values * share.reshape(-1, *[1] * (values.ndim - 1))
        rows, known = new.rows_of[k], old.rows_of[k]
        for mine, theirs in zip(rows.even, known.even, strict=True):
            values = on_g[theirs[parent]]
            lam_g[mine] = values * share.reshape(-1, *[1] * (values.ndim - 1))
        if rows.motors is not None and known.motors is not None:
            _carry_motors(lam_g, on_g, (known.motors, rows.motors), (part, finer), parent)
        costate = find_costate(known, on_g, scheme)[parent]
        places = (finer.places(scheme.points) - part.breaks[parent, None]) / part.fractions[
            parent, None
        ]
        moved = np.stack(
            [scheme.interpolate(x) @ own for x, own in zip(places, costate, strict=True)]
        )
        along = np.einsum("kdf,ksjd->ksjf", rows.bases, moved * scheme.weights[:, None])
        lam_g[rows.states] = np.linalg.pinv(scheme.rungs.T) @ along
    return {"lam_x0": lam_x, "lam_g0": lam_g}


def find_costate(rows: StageRows, on_g: Array, scheme: Scheme) -> Array:
    """What z and z' at the points are worth, by the multipliers of rows, shape (K, 2, d, 5)."""
    shares = scheme.rungs.T @ on_g[rows.states] / scheme.weights[:, None]
    return np.asarray(np.einsum("kdf,ksjf->ksjd", rows.bases, shares))


def _carry_motors(
    lam_g: Array,
    on_g: Array,
    rows: tuple[MotorRows, MotorRows],
    parts: tuple[StagePoints, StagePoints],
    parent: Indices,
) -> None:
    """Multipliers of rates and commands, and of torques that go on: their costate."""
    known, own = rows
    lam_g[own.rates], lam_g[own.commands] = on_g[known.rates[parent]], on_g[known.commands[parent]]
    old, new = (part.breaks[1:-1] for part in parts)
    if len(old):
        for joint in range(2):
            lam_g[own.joins[:, joint]] = np.interp(new, old, on_g[known.joins[:, joint]])


def _list_once(nlp: TimeNLP) -> Indices:
    """Rows that are there once, and not in each interval."""
    own = [part.ravel() for r in nlp.rows_of for part in (*r.even, r.states, r.shares)]
    slow = [r.motors for r in nlp.rows_of if r.motors is not None]
    own += [part.ravel() for m in slow for part in (m.joins, m.rates, m.commands)]
    return np.delete(np.arange(len(nlp.rows.bounds[0])), np.concatenate(own))
