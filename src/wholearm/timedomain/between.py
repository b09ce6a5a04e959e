"""What a motion in the time domain misses between its collocation points."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from ..cones import hold_least, slip_margins
from ..minima import find_least
from ..model import Array
from ..trajectory import Samples
from .stage import Stage
from .timemotion import StageMotion
from .timenlp import TimeNLP

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


class Look(NamedTuple):
    """A stage at `LOOKS` places of each of its K intervals, one after the other.

    Attributes
    ----------
    places : ndarray, shape (K LOOKS,)
        Shares of the duration.
    samples : Samples
        Motion and forces there.
    limits : ndarray, shape (K LOOKS, n_limits), [m]
        Values of every limit of the formation.
    """

    places: Array
    samples: Samples
    limits: Array


def look_between(stage: Stage, motion: StageMotion) -> Look:
    """Look at a stage between its points."""
    places = stage.guess.places(np.linspace(1e-9, 1 - 1e-9, LOOKS)).ravel()
    samples = motion.evaluate(places * motion.duration)
    return Look(places, samples, stage.formation.evaluate_limits(samples.z))


def find_misses(stage: Stage, look: Look, epsilon: float, margin: float = 0.0) -> Limits:
    """By how much limits are missed in each interval, at worst.

    Parameters
    ----------
    epsilon, margin : float
        Least c_n, and what c_n but no friction cone has to exceed it by.
    """
    samples = look.samples
    grip = slip_margins(stage.formation, samples.c_n - epsilon, samples.c_t)
    clear = stage.clearance / 2 * np.isin(stage.watched, stage.released)
    later = (not stage.opens) | (look.places > 1 / 2)
    tables = (
        samples.c_n - (epsilon + margin),
        grip,
        look.limits[:, list(stage.watched)] - np.outer(later, clear),
    )
    shape = (stage.intervals, LOOKS)
    slack = (find_least(table.reshape(*shape, table.shape[1])) for table in tables)
    return Limits(*(np.maximum(-part, 0.0) for part in slack))


def watch_missed(stages: Sequence[Stage], looks: Sequence[Look]) -> list[Stage] | None:
    """Stages that also watch the limits which are broken between points; None if none is."""
    changed = []
    for stage, look in zip(stages, looks, strict=True):
        values = look.limits.reshape(stage.intervals, LOOKS, -1)
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
