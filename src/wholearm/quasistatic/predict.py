"""Whether quasistatic motions keep every contact, and up to which speed that lasts."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from ..common.errors import InfeasibleError, name_source
from ..common.fields import SHARE
from ..common.require import require_number
from ..common.sharing import exclusive
from ..geometry.path_guess import find_end
from ..mechanics.dynamics import split_forces
from ..mechanics.limits import CONE, PRESS
from ..problem.check import require_phases
from ..problem.definition import End, Phase, Problem
from ..results.torque import TorqueProfile
from .prediction import (
    Curves,
    PhasePrediction,
    Place,
    Prediction,
    QuasistaticTorques,
    Survival,
    Weakest,
)
from .road import Road, make_road
from .survival import Break, Least, Look, Pace, find_break, look_along, look_under

SQUEEZE = 0.5
"""How hard quasistatic torques squeeze: as hard as needs be at 0, as contacts press most at 1."""
OWN = "own torques"
"""Name of the motion under the torques of the quasistatic one."""
_SPEEDS = 61
"""Speeds of a curve."""
_SHOWN = 1.4
"""Largest speed of curves over the largest at which something breaks; its cube for the least."""
_ROWS = 8
"""Every so many places of a phase quasistatic torques are kept."""


@exclusive
def predict(
    problem: Problem,
    *,
    squeeze: float = SQUEEZE,
    progress: Callable[[str], None] | None = None,
) -> Prediction:
    """Predict quasistatic motions along the phases of a problem, and at which speed they break.

    Parameters
    ----------
    problem : Problem
    squeeze : float
        How hard quasistatic torques squeeze, from 0, the least torques that keep epsilon, to 1,
        those with which what presses least in the phase presses most. They are the least torques
        that keep a normal force that far between.
    progress : callable
        Told which phase is looked at.

    Raises
    ------
    InputError
        If the phases cannot be carried out geometrically, or a number is out of its range.
    """
    require_phases(problem)
    share = SHARE.read(squeeze, "squeeze")
    found: list[PhasePrediction] = []
    z, moving = problem.start, False
    with name_source(problem.source):
        for phase in problem.phases:
            if progress is not None:
                progress(f"predicting phase {phase.number} of {len(problem.phases)}")
            later = problem.phases[phase.index + 1 :]
            road = make_road(phase, z, later)
            rests = not moving, phase.end is End.REST
            found.append(_predict_phase(problem, phase, road, rests, share))
            z = find_end(phase, z, later) if road is None else road.z[-1]
            moving = phase.end is not End.REST
    return Prediction(problem.name, problem.epsilon, tuple(found))


def make_torques(prediction: Prediction, speed: float) -> TorqueProfile:
    """Quasistatic torques of all phases over time, as if each were run through at a mean speed.

    They balance friction, and set nothing in motion: hand tuning starts from there.

    Parameters
    ----------
    prediction : Prediction
    speed : float, [m/s]
        Along the phases.

    Raises
    ------
    InfeasibleError
        If a phase has no quasistatic torques.
    """
    speed, start = require_number(speed, "speed", positive=True), 0.0
    times, rows = [], []
    for phase in prediction.phases:
        if phase.torques is None:
            raise InfeasibleError(
                f"no quasistatic torques to write: phase {phase.number} is not kept all along"
            )
        times.append(start + phase.torques.s / speed)
        rows.append(phase.torques.tau)
        start = float(times[-1][-1])
    t, tau = np.concatenate(times), np.vstack(rows)
    # Where a direction reverses and where phases meet the torques step.
    kept = np.append(True, np.diff(t) > 0) | np.append(np.diff(t) > 0, True)
    return TorqueProfile.join_rows(t[kept], tau[kept])


def _predict_phase(
    problem: Problem, phase: Phase, road: Road | None, rests: tuple[bool, bool], share: float
) -> PhasePrediction:
    names, until = phase.formation.names, str(phase.until)
    if road is None:
        return PhasePrediction(phase.number, names, until, "left out", math.nan)
    paced = ("moving", "to rest", "from rest", "rest to rest")[2 * rests[0] + rests[1]]
    looks = {
        "steady": (look_along(road, Pace.steady(road)), road.length),
        paced: (look_along(road, pace := Pace.between(road, rests)), pace.way),
    }
    torques = find_torques(road, problem.epsilon, share)
    if torques is not None:
        looks[OWN] = (look_under(road, torques.tau), road.length)
    unit = problem.scene.scales.speed
    survivals = tuple(
        _survive(road, name, look, way, problem.epsilon, unit)
        for name, (look, way) in looks.items()
    )
    zero = np.zeros_like(road.s)
    grasp = road.squeezing.find_best(zero, zero)
    held = (grasp.least >= problem.epsilon) & (road.inertia > 0)
    return PhasePrediction(
        number=phase.number,
        contacts=names,
        until=until,
        path="line" if road.curve is None else "curve",
        length=road.length,
        slow=_name(road, looks["steady"][0](0.0)),
        kept=_list_stretches(road, held),
        survivals=survivals,
        torques=None if torques is None else _thin_out(road, torques),
        curves=_draw(survivals, looks, unit),
    )


def find_torques(road: Road, epsilon: float, share: float) -> QuasistaticTorques | None:
    """Torques that balance a quasistatic motion at all places of a road; None if some have none.

    Parameters
    ----------
    road : Road
    epsilon : float, [N]
    share : float
        How hard they squeeze; see `predict`.
    """
    zero = np.zeros_like(road.s)
    best = road.squeezing.find_best(zero, zero)
    if not (best.least >= epsilon).all() or not (road.inertia > 0).all():
        return None
    wanted = epsilon + share * float(best.least.min() - epsilon)
    low, high = road.squeezing.find_span(zero, zero, wanted)
    forces, size = road.forces, (road.forces.Tl**2).sum(axis=1)
    with np.errstate(divide="ignore", invalid="ignore"):
        lightest = -(forces.T0 * forces.Tl).sum(axis=1) / size
    # At the largest least force the span is one point, but for rounding.
    middle = np.where(low <= high, np.clip(lightest, low, high), best.squeeze)
    squeeze = np.where(size > 0, middle, 0.0)
    c = forces.c(zero, zero, squeeze)
    c_n, _ = split_forces(road.phase.formation, c, road.directions.Xi)
    return QuasistaticTorques(road.s, road.z, forces.tau(zero, zero, squeeze), c_n)


def _thin_out(road: Road, torques: QuasistaticTorques) -> QuasistaticTorques:
    """Fewer places, with both ends and both sides of every reversal."""
    ends = np.diff(road.s) == 0
    kept = np.append(True, ends) | np.append(ends, True)
    kept[::_ROWS] = True
    return QuasistaticTorques(*(part[kept] for part in torques))


def _survive(
    road: Road, name: str, look: Look, way: float, epsilon: float, unit: float
) -> Survival:
    thin = find_break(look, epsilon, unit)
    lost = find_break(look, 0.0, unit, thin.speed if math.isfinite(thin.speed) else 0.0)
    speed = None if math.isinf(thin.speed) else thin.speed
    return Survival(
        motion=name,
        speed=speed,
        duration=way / speed if speed else None,
        lost=None if math.isinf(lost.speed) else lost.speed,
        again=_find_again(thin),
        first=_name(road, thin.least),
    )


def _find_again(found: Break) -> float | None:
    return found.again if found.speed == 0 and math.isfinite(found.again) else None


def _name(road: Road, least: Least) -> Weakest:
    limits = [road.squeezing.limits.limits[k] for k in least.limits]
    contacts = dict.fromkeys(limit.part for limit in limits if limit.kind in (PRESS, CONE))
    kinds = dict.fromkeys(limit.kind for limit in limits if limit.kind not in (PRESS, CONE))
    others = (
        f"{kind} of {' and '.join(dict.fromkeys(own.part for own in limits if own.kind == kind))}"
        for kind in kinds
    )
    force = least.force if math.isfinite(least.force) else None
    return Weakest(tuple(contacts), tuple(others), _place(road, least.place), force)


def _place(road: Road, row: int) -> Place:
    return Place(float(road.s[row]), float(road.z[row, 0]), float(road.z[row, 2]))


def _list_stretches(road: Road, held: NDArray[np.bool_]) -> tuple[tuple[Place, Place], ...]:
    """Stretches of places that are held, by both of their ends."""
    steps = np.flatnonzero(np.diff(np.concatenate([[0], held.astype(int), [0]])))
    pairs = steps.reshape(-1, 2)
    return tuple((_place(road, a), _place(road, b - 1)) for a, b in pairs.tolist())


def _draw(
    survivals: tuple[Survival, ...], looks: dict[str, tuple[Look, float]], unit: float
) -> Curves:
    """Least forces over speed, about those at which something breaks."""
    every = [speed for own in survivals for speed in (own.speed, own.lost, own.again) if speed]
    ends = (min(every) / _SHOWN**3, _SHOWN * max(every)) if every else (0.1 * unit, 10 * unit)
    speeds = np.geomspace(*ends, _SPEEDS)
    forces = {
        name: np.array([look(speed).force for speed in speeds.tolist()])
        for name, (look, _) in looks.items()
    }
    return Curves(speeds, forces)
