"""Limits along a curve as what they are of speed, acceleration and squeeze."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from ..common.arrays import Array
from .dynamics import PathForces
from .limits import LimitSet


class SideTerms(NamedTuple):
    """Slack of one-sided limits at n places, rest + b bend + s' drag + a rate + squeeze press.

    With b = s'^2 and a = s''; each of shape (n, n_sides), over what is much for a side.
    """

    rest: Array
    bend: Array
    drag: Array
    rate: Array
    press: Array

    @staticmethod
    def of(limits: LimitSet, forces: PathForces, rates: Array) -> SideTerms:
        """The sides of some limits.

        Parameters
        ----------
        limits : LimitSet
        forces : PathForces
            At n places.
        rates : ndarray, shape (n, 2)
            d theta / ds there.
        """
        of_c, of_tau, of_rates = (part.T for part in limits.columns)
        rows, signs, bounds = limits.sides
        scale = signs / limits.scales[rows]

        def measure(values: Array) -> Array:
            return np.asarray(values[:, rows] * scale)

        return SideTerms(
            measure(forces.C0 @ of_c + forces.T0 @ of_tau) - bounds * scale,
            measure(forces.Cb @ of_c + forces.Tb @ of_tau),
            measure(forces.Cv @ of_c + forces.Tv @ of_tau + rates @ of_rates),
            measure(forces.Ca @ of_c + forces.Ta @ of_tau),
            measure(forces.Cl @ of_c + forces.Tl @ of_tau),
        )

    def pick(self, rows: Any) -> SideTerms:
        """Some of the places."""
        return SideTerms(*(part[rows] for part in self))

    def at(self, a: Array, b: Array) -> Array:
        """The slack without squeeze, for accelerations and squares of speeds of shape (n,)."""
        a, b = a[:, None], b[:, None]
        return np.asarray(self.rest + self.bend * b + self.drag * np.sqrt(b) + self.rate * a)
