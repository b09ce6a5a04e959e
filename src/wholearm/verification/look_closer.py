"""Where a replay is looked at: few instants at first, and more where something seems to dip."""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from ..common.arrays import Array
from ..contacts.links import evaluate_finger_gap
from ..problem.definition import Phase, Problem
from ..results.torque import TorqueProfile
from ..results.trajectory import Trajectory
from ..simulation.events import Glimpses, Simulation
from ..simulation.simulate import Closer
from .margins import SHORTEST, fit_parabolas, list_normal_forces, list_slips

ROWS = 20
"""About how many rows of each phase of a trajectory its replay is compared with; without one, about
how many even parts of each phase are looked at."""
POINTS = 8
"""Instants around what seems to be a dip."""
LOOKS = 3
"""How often what the looks before leave open is looked at closer."""
WORTH = 1e-7
"""How far below all that is known a dip has to seem, relative to the scene's force or length."""

Dips = list[tuple[float, float]]
"""Where something seems to dip, from start to end [s]."""


def choose_times(problem: Problem, torque: TorqueProfile, plan: Trajectory | None) -> Array:
    """Instants to look at first: rows of a plan, or even ones; steps show what is in between."""
    if plan is None:
        return np.linspace(torque.breaks[0], torque.breaks[-1], ROWS * len(problem.phases) + 1)
    owned = (np.flatnonzero(plan.phase == index) for index in range(len(plan.motions)))
    picked = (own[np.linspace(0, len(own) - 1, ROWS + 1).astype(int)] for own in owned)
    return np.concatenate([plan.t[rows] for rows in picked])


class Series(NamedTuple):
    """What a replay has shown in a phase of a force, a margin or a gap.

    Attributes
    ----------
    name : str
    t, values : ndarray, shape (n,), [s], [N or m]
        At recorded instants.
    more_t, more : ndarray, shape (k,)
        By glimpses, in any order.
    breaks : ndarray, [s]
        Where it may have a kink.
    shortest : float, [s]
        Interval below which it may jump.
    worth : float, [N or m]
        How far below the least value a dip has to seem.
    """

    name: str
    t: Array
    values: Array
    more_t: Array
    more: Array
    breaks: Array
    shortest: float
    worth: float

    def find_dips(self) -> Dips:
        """Places where it seems to be lower than anywhere recorded, with and without glimpses."""
        t, values = np.append(self.t, self.more_t), np.append(self.values, self.more)
        order = np.argsort(t, kind="stable")
        return [*self._fit(t[order], values[order]), *self._fit(self.t, self.values)]

    def narrow(self, dip: tuple[float, float]) -> Dips:
        """Places within a dip where it still seems so by what is recorded."""
        within = slice(*np.searchsorted(self.t, [dip[0], np.nextafter(dip[1], np.inf)]))
        return self._fit(self.t[within], self.values[within])

    def _fit(self, t: Array, values: Array) -> Dips:
        found = fit_parabolas(t, values, self.breaks, self.shortest)
        least = np.nanmin(self.values, initial=np.inf) - self.worth
        low = np.flatnonzero(found.lowest < least).tolist()
        return [(float(found.start[k]), float(found.stop[k])) for k in low]


def make_closer(problem: Problem, breaks: Array) -> Closer:
    """What looks closer at a replay where a force, a margin to slipping or a gap seems to dip.

    Parameters
    ----------
    problem : Problem
    breaks : ndarray, [s]
        Those of its torques.
    """
    left: dict[tuple[int, str], Dips] = {}

    def look(simulation: Simulation, glimpses: Glimpses, looks: int) -> Array:
        before, phases = left.copy(), problem.phases[: int(simulation.phase[-1]) + 1]
        left.clear()
        for phase in phases if looks < LOOKS else ():
            if looks and not any(index == phase.index for index, _ in before):
                continue
            for one in _list_series(problem, simulation, glimpses, phase, breaks):
                key = phase.index, one.name
                known = before.get(key, [])
                dips = [d for dip in known for d in one.narrow(dip)] if looks else one.find_dips()
                left.update({key: dips} if dips else {})
        every = [np.linspace(*dip, POINTS + 2)[1:-1] for dips in left.values() for dip in dips]
        return np.concatenate([np.zeros(0), *every])

    return look


def _list_series(
    problem: Problem, simulation: Simulation, glimpses: Glimpses, phase: Phase, breaks: Array
) -> Iterator[Series]:
    """All that may dip in a phase; margins and gaps have no jumps, and hardly a kink."""
    scales, rows = problem.scene.scales, np.flatnonzero(simulation.phase == phase.index)
    t, none, shortest = simulation.t[rows], np.zeros(0), SHORTEST * scales.time
    own = np.flatnonzero(glimpses.phase == phase.index)
    worth = WORTH * scales.force
    for name, values in list_normal_forces(problem, simulation, phase, rows).items():
        more = glimpses.c_n[own, simulation.contacts.index(name)]
        yield Series(name, t, values, glimpses.t[own], more, breaks, shortest, worth)
    for name, values in list_slips(simulation, phase, rows).items():
        yield Series(f"{name} rolling", t, values, none, none, t[:1], shortest, worth)
    if problem.scene.fingers_collide:
        gaps = evaluate_finger_gap(problem.scene, simulation.z[rows])
        yield Series("gap", t, gaps, none, none, t[:1], shortest, WORTH * scales.length)
