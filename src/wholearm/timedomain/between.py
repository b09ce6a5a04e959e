"""What a motion in the time domain misses between its collocation points."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from ..cones import hold_least, slip_margins
from ..minima import find_least
from ..model import Array
from .stage import Stage
from .timemotion import StageMotion
from .timenlp import CLEAR, TimeNLP

MISS = 2.5e-7
"""Largest miss of a force limit between points, over the weight of the object."""
GRAZE = 3e-7
"""Deepest overlap between points, over the radius of gyration."""
LOOKS = 25
"""Places per interval at which limits are looked at."""
_OVER = 1.5
"""How much more than the miss a limit is tightened."""


class Limits(NamedTuple):
    """Amounts by which limits of one stage are missed or raised, never negative.

    Attributes
    ----------
    c_n : ndarray, shape (K, n_c)
    cone : ndarray, shape (K, R)
    gap : ndarray, shape (K, n_watched)
    """

    c_n: Array
    cone: Array
    gap: Array

    @staticmethod
    def none(stage: Stage) -> Limits:
        """Nothing is raised."""
        formation = stage.formation
        widths = (formation.n_contacts, formation.n_rolling, len(stage.watched))
        return Limits(*(np.zeros((stage.intervals, width)) for width in widths))

    def raised(self, misses: Limits) -> Limits:
        """Raised by somewhat more than the misses."""
        return Limits(*(own + _OVER * miss for own, miss in zip(self, misses, strict=True)))

    @property
    def worst(self) -> float:
        """The largest, over what is allowed."""
        allowed = (MISS, MISS, GRAZE)
        return max(float(t.max(initial=0.0)) / a for t, a in zip(self, allowed, strict=True))


def find_misses(stage: Stage, motion: StageMotion, epsilon: float, margin: float = 0.0) -> Limits:
    """By how much limits are missed in each interval, at worst.

    Parameters
    ----------
    epsilon, margin : float
        Least c_n, and what c_n but no friction cone has to exceed it by.
    """
    formation, inner = stage.formation, np.linspace(1e-9, 1 - 1e-9, LOOKS)
    places = stage.guess.places(inner).ravel()
    samples = motion.evaluate(places * motion.duration)
    grip = slip_margins(formation, samples.c_n - epsilon, samples.c_t)
    gaps = formation.evaluate_limits(samples.z)[:, list(stage.watched)]
    clear = CLEAR / 2 * np.isin(stage.watched, stage.released)
    later = (not stage.opens) | (places > 1 / 2)
    tables = (
        samples.c_n - (epsilon + margin),
        grip,
        gaps - np.outer(later, clear),
    )
    shape = (stage.intervals, LOOKS)
    slack = (find_least(table.reshape(*shape, table.shape[1])) for table in tables)
    return Limits(*(np.maximum(-part, 0.0) for part in slack))


def watch_missed(stages: Sequence[Stage], motions: Sequence[StageMotion]) -> list[Stage] | None:
    """Stages that also watch the limits which are broken between points; None if none is."""
    changed, places = [], np.linspace(0.0, 1.0, LOOKS)
    for stage, motion in zip(stages, motions, strict=True):
        z = motion.evaluate(stage.guess.places(places).ravel() * motion.duration).z
        values = stage.formation.evaluate_limits(z).reshape(stage.intervals, LOOKS, -1)
        deepest = -GRAZE * stage.formation.scene.scales.length
        broken = np.flatnonzero(find_least(values).min(axis=0) < deepest).tolist()
        changed.append(replace(stage, watched=tuple(sorted({*stage.watched, *broken}))))
    news = [one.watched != other.watched for one, other in zip(changed, stages, strict=True)]
    return changed if any(news) else None


def raise_bounds(
    nlp: TimeNLP, stages: Sequence[Stage], limits: Sequence[Limits], epsilon: float, low_x: Array
) -> tuple[Array, Array]:
    """Bounds of the NLP's rows; raises those of its unknowns in `low_x` in place.

    Parameters
    ----------
    epsilon : float
        Least c_n.
    """
    low, high = nlp.rows.bounds
    for k, (stage, raised) in enumerate(zip(stages, limits, strict=True)):
        formation, own = stage.formation, nlp.rows_of[k]
        floor = epsilon + raised.c_n
        c_n = nlp.layouts[k].forces[:, :, : formation.n_contacts]
        # Where rows hold c_n at the points too, its own bounds must not.
        if own.limits.presses.shape[1] <= 2:
            low_x[c_n] = floor[:, None]
        low[own.limits.presses] = floor[:, None]
        cushion = hold_least(formation, epsilon)[formation.n_contacts :]
        low[own.limits.cones] = cushion + np.tile(raised.cone, 2)[:, None]
        low[own.watches] += raised.gap[:, None]
    return low, high
