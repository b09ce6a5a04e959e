"""The 10 % procedure on a whole problem, phase after phase."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from ..common.arrays import Array
from ..common.errors import InputError, name_source
from ..common.require import require_number
from ..common.sharing import exclusive
from ..mechanics.metric import metric_weights
from ..problem.check import require_phases
from ..problem.definition import End, Phase, Problem
from ..quasistatic.predict import SQUEEZE, find_torques
from ..quasistatic.road import Road, make_road
from ..results.torque import TorqueProfile
from ..verification.instants import answer
from ..verification.verify import verify
from .phase import PhaseTuning, tune_phase
from .trial import Bench, Outcome, Sight
from .tuned import Tuned

SHARE = 0.5
"""Which of the raises that reach the end is taken, from the first, 0, to the last, 1."""
DWELL = 1e-5
"""How much later than its end the torques of a phase step to those of the next, over the scene's
time: not before, whatever the rounding."""


@exclusive
def tune(
    problem: Problem,
    *,
    squeeze: float = SQUEEZE,
    share: float = SHARE,
    progress: Callable[[str], None] | None = None,
) -> Tuned:
    """Find torques by steps of 10 % from quasistatic ones, phase by phase.

    Parameters
    ----------
    problem : Problem
    squeeze : float
        How hard quasistatic torques squeeze, from 0 to 1; see `predict`.
    share : float
        Which of the raises between the first that reaches the end of a phase, 0, and the last that
        keeps every contact, 1, is taken.
    progress : callable, optional
        Receives a line for each phase.

    Raises
    ------
    InputError
        If a phase cannot be carried out geometrically, or a number is out of its range.
    """
    require_phases(problem)
    for key, value in (("squeeze", squeeze), ("share", share)):
        if not 0 <= require_number(value, key) <= 1:
            raise InputError("", key, f"{value!r} given; allowed are 0 to 1")
    found: list[PhaseTuning] = []
    z = problem.start
    with name_source(problem.source):
        for phase in problem.phases:
            if progress is not None:
                progress(f"tuning phase {phase.number} of {len(problem.phases)}")
            found.append(_tune(problem, phase, z, squeeze, share))
            if not found[-1].steps:
                break
            z = found[-1].outcome.z
    torque = join(found, DWELL * problem.scene.scales.time)
    whole = len(found) == len(problem.phases) and bool(found[-1].steps)
    report = verify(problem, torque) if torque is not None and whole else None
    return Tuned(problem.name, problem.epsilon, tuple(found), torque, report)


def join(found: Sequence[PhaseTuning], dwell: float) -> TorqueProfile | None:
    """The torques of phases one after the other, each a `dwell` [s] longer; None without any."""
    starts, rows, now = list[float](), list[Array](), 0.0
    for own in found:
        for start, tau in own.steps:
            starts.append(now + start)
            rows.append(tau)
        now += own.outcome.time + dwell if own.steps else 0.0
    if not rows:
        return None
    return TorqueProfile(np.array([*starts, now]), np.array(rows)[..., None])


def _tune(problem: Problem, phase: Phase, z: Array, squeeze: float, share: float) -> PhaseTuning:
    """Tune one phase from rest at `z`."""

    def give_up(reason: str) -> PhaseTuning:
        outcome = Outcome(Sight.HELD, reason, 0.0, 0.0, np.inf, z)
        return PhaseTuning(phase.number, 0, np.full(2, np.nan), 0, 0, (), outcome, 0, reason)

    if phase.end is not End.REST:
        return give_up(f"passes into the next one in motion (end = {phase.end.value!r})")
    road = make_road(phase, z, problem.phases[phase.index + 1 :])
    if road is None:
        return give_up("has not one or two freedoms")
    torques = find_torques(road, problem.epsilon, squeeze)
    if torques is None:
        return give_up("has no quasistatic torques all along")
    tau, bench = torques.tau[0], Bench(problem, phase, z)
    first = find_acting(road, tau)
    tuned = tune_phase(bench, phase.number, tau, first, share)
    if tuned.steps:
        return tuned
    other = tune_phase(bench, phase.number, tau, 3 - first, share)
    return other if other.steps else replace(tuned, simulations=bench.simulations)


def find_acting(road: Road, tau: Array) -> int:
    """The finger, 1 or 2, whose torque sets the object in motion when it is raised by a share."""
    formation, way = road.phase.formation, road.z_s[0]
    signs = np.concatenate([road.directions.Xi[0], road.directions.sigma[0]])
    instant = answer(formation, road.z[0], np.zeros(5), signs)
    assert instant is not None
    ahead = metric_weights(formation.scene) * way @ instant.acceleration
    return int((ahead[1:] * tau).argmax()) + 1
