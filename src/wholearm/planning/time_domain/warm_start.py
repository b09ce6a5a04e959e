"""Multipliers to start from: of one size, or those of a solution on other intervals."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ...common.arrays import Array
from .nlp import TimeNLP
from .stage import Stage

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
    old_stages: Sequence[Stage],
    new_stages: Sequence[Stage],
) -> Multipliers:
    """Multipliers of the same stages on other intervals.

    Those of inequalities go with the length of an interval, as their sum over time matters.
    """
    on_x, on_g = multipliers["lam_x0"], multipliers["lam_g0"]
    lam_x, lam_g = np.zeros(new.layouts[-1].stop), np.zeros(len(new.rows.bounds[0]))
    for k, (before, after) in enumerate(zip(old_stages, new_stages, strict=True)):
        part, finer = before.guess, after.guess
        middles = finer.breaks[:-1] + finer.fractions / 2
        parent = np.searchsorted(part.breaks, middles, side="right") - 1
        share = finer.fractions / part.fractions[parent]
        for name in ("tau", "v", "forces"):
            mine, theirs = getattr(new.layouts[k], name), getattr(old.layouts[k], name)
            values = on_x[theirs[parent]]
            lam_x[mine] = values * share.reshape(-1, *[1] * (values.ndim - 1))
        for mine, theirs in zip(new.rows_of[k].groups, old.rows_of[k].groups, strict=True):
            values = on_g[theirs[parent]]
            lam_g[mine] = values * share.reshape(-1, *[1] * (values.ndim - 1))
    return {"lam_x0": lam_x, "lam_g0": lam_g}
