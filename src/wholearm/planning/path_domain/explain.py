"""Why phases along curves have no plan, and which single limit would have to give way.

All limits are made soft and their shortfalls ranked. Then each limit alone is relaxed as little as
the others allow, and a plan with that limit is asked for: only what was planned is advised.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from ...common.arrays import Array
from ...common.errors import InfeasibleError, JammingError, SolverError
from ...contacts.cones import hold_least, name_holds
from ...contacts.formation import Formation
from ...geometry.curve import Curve, describe_pose
from ..advice import Limit, Shortfall, bracket, describe_changes, find_changes, rank_shortfalls
from ..options import Objective
from .data import PhaseData, Relaxation, cut, join, name_phases
from .motion import PathMotion, Profile
from .nlp import Tightening, Units, build_path_nlp, make_bounds, pack, parameters, unpack

_SHORT = 5e-5
"""Least shortfall that counts, over the scene's force or the torque limit."""
_ROUGH = 4.0
"""How much rougher a rolling contact may be made."""
_TORQUE = 15.0
"""Unit of the torques' shortfalls, over the scene's torque: as bad as one of its force."""
_FORCE = 5.0
"""Largest unit of force when a limit is relaxed, over the scene's."""

Replan = Callable[[Sequence[Curve], float], object]
"""Plans the phases along curves with a least normal force [N]; raises if there is no plan."""


class _Candidate(NamedTuple):
    """A limit that may give way, and what the NLP's relaxation is to it, if there is one."""

    limit: Limit
    relaxation: Relaxation | None
    key: str
    finger: int | None

    def value(self, relaxed: float, units: Units) -> float:
        """The limit when relaxed so far."""
        if self.key == "epsilon":
            return self.limit.value - relaxed * units.force
        power = 1.0 if self.key == "torque_limit" else 0.5
        return float(self.limit.value * (1 + relaxed) ** power)

    def apply(self, parts: Sequence[PhaseData], value: float) -> tuple[list[Curve], float]:
        """Curves and epsilon with another value of the limit."""
        curves = [part.curve for part in parts]
        if self.relaxation is None:
            changed = [with_friction(curve, self.key, value) for curve in curves]
            return changed, parts[0].epsilon
        if self.finger is None:
            return curves, value
        changed = [with_limit(curve, self.finger, self.key, value) for curve in curves]
        return changed, parts[0].epsilon


def explain(
    parts: Sequence[PhaseData],
    profile: Profile,
    units: Units,
    phases: Sequence[int],
    stopped: str,
    replan: Replan,
) -> InfeasibleError | SolverError:
    """Say why phases have no plan and what would change that.

    Parameters
    ----------
    parts : sequence of PhaseData
    profile : Profile
        A guess of the motion through all of them.
    units : Units
    phases : sequence of int
        Their numbers.
    stopped : str
        How the solver ended, in words.
    replan : callable
    """
    data = join(parts)
    torque = _TORQUE * data.curve.formation.scene.scales.torque
    units = units._replace(torque=np.full(2, torque))
    elastic = _solve_elastic(data, profile, units)
    if elastic is None:
        return SolverError(stopped)
    shortfalls = [
        short
        for part, own, phase in zip(parts, cut(parts, elastic), phases, strict=True)
        for short in _list_shortfalls(part, own, f", phase {phase}" if len(phases) > 1 else "")
    ]
    if not shortfalls:
        return SolverError(f"{stopped} although limits can be kept")
    units = _quicken(data, units)
    candidates = _list_candidates(data, units)
    if len(parts) == 1:
        # Where impacts join phases, their velocities depend on friction too.
        candidates += _list_frictions(data.curve.formation)

    def find_least(index: int) -> float | None:
        limit, relaxation = candidates[index].limit, candidates[index].relaxation
        if relaxation is not None:
            return _relax(data, elastic, units, candidates[index], relaxation)
        farthest = 0.0 if limit.sign < 0 else _ROUGH * limit.value
        return bracket(limit, farthest, partial(can_plan, index))

    def can_plan(index: int, value: float) -> bool:
        return _succeeds(replan, *candidates[index].apply(parts, value))

    limits = [candidate.limit for candidate in candidates]
    changes = find_changes(limits, find_least, can_plan)
    return InfeasibleError(
        f"{name_phases(phases, 'infeasible')}: {rank_shortfalls(shortfalls)}; "
        f"{describe_changes(changes)}"
    )


def explain_jam(curve: Curve, epsilon: float, jam: JammingError, replan: Replan) -> JammingError:
    """Add to an error which single friction would let a phase be planned."""
    candidates = _list_frictions(curve.formation)

    def can_plan(index: int, value: float) -> bool:
        return _succeeds(replan, [with_friction(curve, candidates[index].key, value)], epsilon)

    def find_least(index: int) -> float | None:
        limit = candidates[index].limit
        return bracket(limit, 0.0, partial(can_plan, index)) if limit.sign < 0 else None

    changes = find_changes([candidate.limit for candidate in candidates], find_least, can_plan)
    return JammingError(f"{jam}; {describe_changes(changes)}")


def _succeeds(replan: Replan, curves: Sequence[Curve], epsilon: float) -> bool:
    try:
        replan(curves, epsilon)
    except (InfeasibleError, SolverError, JammingError):
        return False
    return True


def _quicken(data: PhaseData, units: Units) -> Units:
    """Units for motions as quick as a fall, with forces that a hand may have.

    In units of a slow motion, or of an absurd epsilon, the small costs that choose among equals
    would outweigh what is relaxed.
    """
    length, scales = float(data.grid.s[-1]), data.curve.formation.scene.scales
    pace = float(np.sqrt(length / scales.acceleration))
    return units._replace(time=min(units.time, pace), force=min(units.force, _FORCE * scales.force))


def _solve_elastic(data: PhaseData, profile: Profile, units: Units) -> Profile | None:
    """The motion with the least shortfalls when every limit is soft."""
    formation = data.curve.formation
    intervals, n_c = len(data.grid.s) - 1, formation.n_contacts
    nlp = build_path_nlp(n_c, intervals, Objective.ELASTIC, formation.n_rolling)
    short = np.maximum(_shortfalls(data, profile), 0.0) + 0.05 * data.spans[:-2]
    result = nlp.solver(
        x0=pack(nlp, profile, units, 0.0, short),
        p=parameters(nlp, data, units, 1.0),
        **make_bounds(nlp, data, units, Tightening.none(data, None)),
    )
    if not nlp.solver.stats()["success"]:
        return None
    return unpack(nlp, data.grid, result["x"].full()[:, 0], units)[0]


def _shortfalls(data: PhaseData, profile: Profile) -> Array:
    """By how much H c and tau miss their limits at the nodes, shape (n, n_h + 2) [N, N m]."""
    slack = data.slack(data.nodes, profile)
    held, torque = slack[:, :-4], np.minimum(slack[:, -4:-2], slack[:, -2:])
    return -np.hstack([held, torque])


def _list_shortfalls(data: PhaseData, profile: Profile, suffix: str) -> list[Shortfall]:
    short = _shortfalls(data, profile)
    names = name_holds(data.curve.formation, data.epsilon)
    units = ["N"] * len(names) + ["N m"] * 2
    names += [f"torque limit of finger {i + 1} = {data.torque_limit[i]:g} N m" for i in range(2)]
    times = PathMotion(data.curve, data.grid, profile).times
    z = data.curve.evaluate(data.grid.s).z
    found = []
    for row, (name, unit) in enumerate(zip(names, units, strict=True)):
        worst = int(short[:, row].argmax())
        if short[worst, row] > _SHORT * data.spans[row]:
            where = f"t = {times[worst]:.4f} s ({describe_pose(z[worst])}){suffix}"
            share = float(short[worst, row] / data.spans[row])
            found.append(Shortfall(name, float(short[worst, row]), unit, where, share))
    return found


def _list_candidates(data: PhaseData, units: Units) -> list[_Candidate]:
    """Torque limits, speed limits if there are any, and epsilon."""
    formation, scene = data.curve.formation, data.curve.formation.scene
    n_h = len(data.least)
    unit = np.eye(n_h + 3)
    found = []
    for i in range(2):
        torque, speed = float(scene.torque_limit[i]), float(scene.speed_limit[i])
        limit = Limit(f"torque limit of finger {i + 1}", torque, "N m", 1)
        found.append(_Candidate(limit, Relaxation(torque * unit[n_h + i]), "torque_limit", i))
        if np.isfinite(speed):
            limit = Limit(f"speed limit of finger {i + 1}", speed, "rad/s", 1)
            found.append(_Candidate(limit, Relaxation(unit[-1], i), "speed_limit", i))
    limit = Limit("epsilon", data.epsilon, "N", -1)
    every = np.append(units.force * hold_least(formation, 1.0), np.zeros(3))
    return [*found, _Candidate(limit, Relaxation(every), "epsilon", None)]


def _list_frictions(formation: Formation) -> list[_Candidate]:
    """Friction of what is touched: to be lowered, and where a contact rolls to be raised."""
    parts = dict.fromkeys(contact.finger for contact in formation.contacts)
    rolls = {contact.finger for contact in formation.rolling}
    found = []
    for finger in parts:
        name = "palm" if finger is None else f"finger {finger + 1}"
        key = name.replace(" ", "")
        value = formation.scene.friction.of(finger)
        for sign in (-1, 1) if finger in rolls else (-1,):
            limit = Limit(f"friction of {name}", value, "", sign)
            found.append(_Candidate(limit, None, key, finger))
    return found


def _relax(
    data: PhaseData,
    profile: Profile,
    units: Units,
    candidate: _Candidate,
    relaxation: Relaxation,
) -> float | None:
    """The value at which one limit just lets all others be kept, if there is one."""
    formation = data.curve.formation
    intervals, n_c = len(data.grid.s) - 1, formation.n_contacts
    nlp = build_path_nlp(n_c, intervals, Objective.RELAX, formation.n_rolling)
    short, weights = _shortfalls(data, profile).max(axis=0), relaxation.weights[:-1]
    needed = np.divide(short, weights, out=np.zeros_like(short), where=weights > 0)
    result = nlp.solver(
        x0=pack(nlp, profile, units, max(1.0, 1.5 * float(needed.max()))),
        p=parameters(nlp, data, units, 1.0, relaxation),
        **make_bounds(nlp, data, units, Tightening.none(data, None), relaxation),
    )
    if not nlp.solver.stats()["success"]:
        return None
    relaxed = unpack(nlp, data.grid, result["x"].full()[:, 0], units)[1]
    return candidate.value(relaxed, units)


def with_friction(curve: Curve, part: str, value: float) -> Curve:
    """The curve with another coefficient of friction of `palm`, `finger1` or `finger2`."""
    scene, change = curve.formation.scene, {part: value}
    other = replace(scene, friction=replace(scene.friction, **change))
    return replace(curve, formation=replace(curve.formation, scene=other))


def with_limit(curve: Curve, finger: int, key: str, value: float) -> Curve:
    """The curve with another `torque_limit` or `speed_limit` of one finger."""
    scene = curve.formation.scene
    change: Any = {key: value}
    right, left = (
        replace(link, **change) if index == finger else link
        for index, link in enumerate(scene.fingers)
    )
    other = replace(scene, fingers=(right, left))
    return replace(curve, formation=replace(curve.formation, scene=other))
