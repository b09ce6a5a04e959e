"""Limits missed by a motion in the time domain between its collocation points."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...common.arrays import Array, find_minima
from ...mechanics.limits import PRESS, LimitSet, make_limits
from ...results.trajectory import Samples
from .equations import SLIDING, find_relieved, least_senses
from .stage import Stage
from .time_motion import StageMotion

MISS = 2.5e-7  # largest miss of a force limit between points, over the weight of the object
GRAZE = 3e-7  # deepest overlap between points, over the radius of gyration
FALTER = 0.1  # largest miss of half of a least rate between points, over it: a replay might stick
CHECKS = 25  # places per interval at which limits are checked
_OVER = 1.5  # factor on the miss by which a limit is tightened at first
_AMPLE = 1e3  # slack, over what is much for a limit, of what does not count
_MOST = (_OVER, 4.0, 4.0)  # the same at most, of forces, gaps and rates


class IntersampleLimits(NamedTuple):
    """Nonnegative amounts by which limits of one stage are missed or raised."""

    held: Array  # (K, n_sides): of limits of forces, torques and speeds, over their scales
    gap: Array  # (K, n_monitored)
    sense: Array  # (K, n_c + 2): of the rates of contacts and joints; zero for rolling contacts

    @staticmethod
    def none(stage: Stage) -> IntersampleLimits:
        """Nothing is raised."""
        formation = stage.formation
        sides = len(make_limits(formation, 0.0).sides[0])
        widths = (sides, len(stage.monitored), formation.n_contacts + 2)
        return IntersampleLimits(*(np.zeros((stage.intervals, width)) for width in widths))

    @property
    def worst(self) -> float:
        """The largest, over its tolerance."""
        return float(self._over.max(initial=0.0))

    def list_missed(self) -> NDArray[np.bool_]:
        """Which intervals miss more than the tolerance, shape (K,)."""
        return np.asarray(self._over > 1.0)

    @property
    def _over(self) -> Array:
        """The largest of each interval, over its tolerance, shape (K,)."""
        allowed = (MISS, GRAZE, FALTER * SLIDING)
        parts = (t.max(axis=1, initial=0.0) / a for t, a in zip(self, allowed, strict=True))
        return np.asarray(np.max(list(parts), axis=0))


class Raised(NamedTuple):
    """Tightening of the limits of one stage."""

    limits: IntersampleLimits  # in all
    missed: IntersampleLimits  # misses before the last tightening
    added: IntersampleLimits  # the last tightening

    @staticmethod
    def none(stage: Stage) -> Raised:
        """Nothing is raised."""
        return Raised(*(3 * [IntersampleLimits.none(stage)]))

    def further(self, misses: IntersampleLimits) -> Raised:
        """Raised by the misses times a factor from the effect of the last time."""
        limits, added = list[Array](), list[Array]()
        for raised, before, last, miss, most in zip(*self, misses, _MOST, strict=True):
            # Reduction of the miss over the last tightening.
            share = np.divide(before - miss, last, out=np.ones_like(miss), where=last > 0)
            added.append(miss * np.clip(1 / np.maximum(share, 1 / most), _OVER, most))
            limits.append(raised + added[-1])
        return Raised(IntersampleLimits(*limits), misses, IntersampleLimits(*added))


class CheckPlaces(NamedTuple):
    """A stage at `CHECKS` places of each of its K intervals, one after the other."""

    places: Array  # (K CHECKS,): shares of the duration
    samples: Samples  # motion and forces there
    limits: Array  # (K CHECKS, n_limits) [m]: values of every limit of the formation


def check_between(stage: Stage, motion: StageMotion) -> CheckPlaces:
    """Motion, forces and limits of a stage at the checks between its points."""
    places = stage.guess.places(np.linspace(1e-9, 1 - 1e-9, CHECKS)).ravel()
    samples = motion.evaluate(places * motion.duration)
    return CheckPlaces(places, samples, stage.formation.evaluate_limits(samples.z))


def find_misses(
    stage: Stage,
    check: CheckPlaces,
    epsilon: float,
    margin: float = 0.0,
    deviations: Array | float = 0.0,
) -> IntersampleLimits:
    """Largest misses of limits in each interval.

    c_n, but not friction cones, have to exceed epsilon by `margin`, and each side its bound by
    `deviations` times its scale, shape (K CHECKS, n_sides).
    """
    samples, limits = check.samples, make_limits(stage.formation, epsilon)
    clear = stage.list_clearances(check.places, after=1 / 2) / 2
    # Misses at the start of a stage do not depend on it.
    values = check.limits[:, list(stage.monitored)]
    values = values - np.minimum(values[:1], 0.0)
    senses, formation = stage.measure_senses(samples.z, samples.z_dot), stage.formation
    # Only contacts with friction have a sliding direction.
    senses[:, np.delete(np.arange(formation.n_contacts), formation.rubbing_rows)] = 1.0
    relieved = np.repeat(np.where(find_relieved(stage, limits), _AMPLE, 0.0), CHECKS, axis=0)
    tables = (
        _find_slack(stage, limits, samples, margin) - deviations + relieved,
        values - clear,
        senses - 0.5 * least_senses(stage, check.places),
    )
    shape = (stage.intervals, CHECKS)
    slack = (find_minima(table.reshape(*shape, table.shape[1])) for table in tables)
    return IntersampleLimits(*(np.maximum(-part, 0.0) for part in slack))


def _find_slack(stage: Stage, limits: LimitSet, samples: Samples, margin: float) -> Array:
    """Slack of each side of the limits, over its scale, (n, n_sides); zero for torques alone."""
    c = [samples.c_n, samples.c_t[:, list(stage.formation.rolling_rows)]]
    values = np.hstack([*c, samples.tau, samples.z_dot[:, 3:]]) @ limits.rows.T
    values[:, limits.of(PRESS)] -= margin
    slack = limits.find_slack(values) / limits.scales[limits.sides[0]]
    of_c, _, of_rates = limits.columns
    bent = np.flatnonzero(of_c.any(axis=1) | of_rates.any(axis=1))
    slack[:, ~np.isin(limits.sides[0], bent)] = 0.0
    return slack
