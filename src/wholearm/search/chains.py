"""Chains of borders that are passed without a stop.

At a crossing a motion passes on with a plastic impact, or smoothly where a contact is only renamed
and the tangent continues. The ratio of speeds before and after follows from the curves alone.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..contacts.formation import Formation
from ..mechanics.metric import metric_weights
from ..planning.path_domain.impact_sequence import BEND, compute_curve_impact
from ..problem.definition import End, Phase, Until
from .edges import Blocked, BorderEdge, EdgeStep, Link, link_along

LONGEST = 6  # Most borders that are passed in one go


@dataclass(frozen=True, eq=False)
class Chain:
    """Borders that are followed to their ends in motion, and one after them."""

    steps: tuple[EdgeStep, ...]  # phases along those that are followed whole
    borders: tuple[BorderEdge, ...]  # these, and the last one
    ratios: tuple[float, ...]  # speed ratios of all borders: the speed is continuous

    @classmethod
    def of(cls, border: BorderEdge) -> Chain:
        """A chain of one border."""
        return cls((), (border,), (1.0,))

    def can_enter(self, formation: Formation) -> bool:
        """Whether a formation keeps the gained contact and has no others that are new."""
        last = self.borders[-1]
        contacts, held = set(formation.contacts), set(last.formation.contacts)
        return last.gained in contacts and contacts <= {*held, last.gained}

    def extend(self, following: BorderEdge) -> Chain | None:
        """The chain with another border entered in motion; None if impossible."""
        last, gained = self.borders[-1], self.borders[-1].gained
        if not self.can_enter(following.formation):
            return None
        (v,) = last.curve.interpolate(np.array([last.curve.length]))[1]
        (heading,) = following.curve.interpolate(np.zeros(1))[1]
        continues = v * metric_weights(last.formation.scene) @ heading > 1 - 2 * BEND
        ends = (End.SMOOTH, End.IMPACT) if continues else (End.IMPACT,)
        for end in ends:
            phase = Phase(0, last.formation, Until(contact=gained), end)
            join = compute_curve_impact(phase, last.curve, following.curve)
            if join.possible and np.isfinite(join.ratio):
                return Chain(
                    (*self.steps, EdgeStep(last.formation.contacts, phase.until, end)),
                    (*self.borders, following),
                    (*self.ratios, self.ratios[-1] * join.ratio),
                )
        return None

    def link(self, step: EdgeStep, last: BorderEdge) -> Link | Blocked:
        """The link along the chain, at rest at the end of the last border or of a part of it."""
        borders, steps = (*self.borders[:-1], last), (*self.steps, step)
        return link_along(borders, self.ratios, steps, last.stop)

    def link_whole(self) -> Link | Blocked | None:
        """The link along all of it; None where the last border ends at an obstacle."""
        last = self.borders[-1]
        if last.gained is None:
            return None
        step = EdgeStep(last.formation.contacts, Until(contact=last.gained))
        return self.link(step, last)
