"""Borders passed one after the other without a stop where they meet.

At a crossing two borders share no velocity, so that the motion goes on at speed with an impact, if
the law of plastic impacts lets it. Where one contact is only renamed borders go on along the same
tangent. Either is known from the curves alone, and the speed after is in proportion to that before.
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
    """Borders that are followed whole and left in motion, and one after them."""

    steps: tuple[EdgeStep, ...]  # phases along those that are followed whole
    borders: tuple[BorderEdge, ...]  # these, and the last one
    # speed ratios of all borders, with which the speed is the same on both sides of a join
    ratios: tuple[float, ...]

    @classmethod
    def of(cls, border: BorderEdge) -> Chain:
        """A border that others may follow."""
        return cls((), (border,), (1.0,))

    def can_enter(self, formation: Formation) -> bool:
        """Whether a formation keeps what is gained at the end, and nothing touches that did not."""
        last = self.borders[-1]
        contacts, held = set(formation.contacts), set(last.formation.contacts)
        return last.gained in contacts and contacts <= {*held, last.gained}

    def extend(self, following: BorderEdge) -> Chain | None:
        """The chain with another border passed into in motion; None where that is not possible."""
        last, gained = self.borders[-1], self.borders[-1].gained
        if not self.can_enter(following.formation):
            return None
        ends = (End.SMOOTH, End.IMPACT) if _goes_on(last, following) else (End.IMPACT,)
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


def _goes_on(before: BorderEdge, after: BorderEdge) -> bool:
    """Whether a border goes on about along the tangent of the one before."""
    metric, ends = metric_weights(after.formation.scene), np.array([before.curve.length, 0.0])
    (v,), (heading,) = (
        own.curve.interpolate(s[None])[1] for own, s in zip((before, after), ends, strict=True)
    )
    return bool(v * metric @ heading > 1 - 2 * BEND)
