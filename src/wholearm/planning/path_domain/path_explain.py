"""Diagnosis of infeasible phases along curves: elastic mode, then one relaxation at a time.

All limits are made soft and their shortfalls ranked. Then each limit alone is relaxed as little as
the others allow, and a plan with that limit is made: only what was planned is advised.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial

import numpy as np

from ...common.arrays import Array
from ...common.errors import (
    InfeasibleError,
    JammingError,
    LimitPlace,
    Parameter,
    Shortfall,
    SolverError,
    WholearmError,
)
from ...contacts.formation import Formation
from ...geometry.curve import Curve, describe_pose
from ...mechanics.limits import EPSILON
from ...results.trajectory import Trajectory
from ..advice import (
    advise,
    assemble_least,
    bracket,
    change_scene,
    describe_shortfalls,
    list_shortfalls,
    name_phases,
    rank_shortfalls,
    succeeds,
)
from ..options import Objective
from .elements import Profile
from .junction import require_hold
from .path_data import PhaseData, cut, join
from .path_motion import PathMotion, fit_torque
from .path_nlp import (
    LimitShape,
    Relaxation,
    Tightening,
    Units,
    build_path_nlp,
    make_bounds,
    pack,
    parameters,
    unpack,
)
from .path_plan import Task, plan_curves

_TRIED = (2.0, 10.0, 100.0)  # factors on torque rate limits with which plans are tried
_ROUGH = 4.0  # largest factor on the friction of a rolling contact
_TORQUE = 15.0  # unit of shortfalls of torques, over the scene's torque: as bad as one of its force
_FORCE = 5.0  # largest unit of force when a limit is relaxed, over the scene's
FRICTION = "friction"  # beginning of the keys of frictions
# Plans the phases along curves with a least normal force [N]; raises if there is no plan.
Replan = Callable[[Sequence[Curve], float], object]


def explain(
    parts: Sequence[PhaseData],
    profile: Profile,
    units: Units,
    phases: Sequence[int],
    stopped: str,
    replan: Replan,
) -> InfeasibleError | SolverError:
    """The error for phases without a plan, with what would change that.

    Parameters
    ----------
    profile  a guess of the motion through all of them
    phases   their numbers
    stopped  how the solver ended, in words
    """
    data = join(parts)
    scales = data.curve.formation.scene.scales
    units = units._replace(torque=np.full(2, _TORQUE * scales.torque))
    elastic = _solve_elastic(data, profile, units)
    if elastic is None:
        return SolverError(stopped)
    shortfalls = [
        short
        for part, each, phase in zip(parts, cut(parts, elastic), phases, strict=True)
        for short in _list_shortfalls(part, each, phase, len(phases) > 1)
    ]
    if not shortfalls:
        text = f"{stopped} although limits can be kept; try other --intervals or --accuracy"
        return SolverError(text)
    # In units of a slow motion, or of an absurd epsilon, the regularization would outweigh what is
    # relaxed: units of a fall, and of forces that a hand may have.
    fall = float(np.sqrt(float(data.grid.s[-1]) / scales.acceleration))
    largest = _FORCE * scales.force
    units = units._replace(time=min(units.time, fall), force=min(units.force, largest))
    may_change = [*data.speeds.parameters, *data.limits.parameters]
    if len(parts) == 1:
        # Velocities after impacts between phases would depend on friction too.
        may_change += list_frictions(data.curve.formation)
    curves = [part.curve for part in parts]

    def find_value(parameter: Parameter) -> float | None:
        if parameter.key.startswith(FRICTION):
            return _search_friction(parameter, partial(change, parameter))
        return _relax(data, elastic, units, parameter)

    def change(parameter: Parameter, value: float) -> object:
        return _replan_with(curves, data.epsilon, replan, parameter, value)

    ranked = rank_shortfalls(shortfalls)
    text = f"{name_phases(phases, 'infeasible')}: {describe_shortfalls(ranked)}"
    advice = advise(text, may_change, find_value, change)
    motion = _make_trajectory(parts, cut(parts, elastic))
    return InfeasibleError(advice.text, ranked, advice.changes, motion)


def _make_trajectory(parts: Sequence[PhaseData], profiles: Sequence[Profile]) -> Trajectory | None:
    """The motion with the least shortfalls; None if it stalls."""
    pairs = zip(parts, profiles, strict=True)
    motions = [PathMotion(part.curve, part.grid, profile) for part, profile in pairs]
    try:
        torques = [fit_torque(*pair)[0] for pair in zip(parts, motions, strict=True)]
    except SolverError:
        return None
    return assemble_least(motions, torques, [part.curve.formation for part in parts])


def explain_jam(curve: Curve, epsilon: float, jam: JammingError, replan: Replan) -> JammingError:
    """Add to an error which single friction would let a phase be planned."""

    def find_value(parameter: Parameter) -> float | None:
        lower = parameter.sign < 0
        return _search_friction(parameter, partial(change, parameter)) if lower else None

    def change(parameter: Parameter, value: float) -> object:
        return _replan_with([curve], epsilon, replan, parameter, value)

    advice = advise(str(jam), list_frictions(curve.formation), find_value, change)
    error = type(jam)(advice.text)
    error.changes = advice.changes
    return error


def _replan_with(
    curves: Sequence[Curve], epsilon: float, replan: Replan, parameter: Parameter, value: float
) -> object:
    if parameter.key == EPSILON:
        return replan(curves, value)
    return replan([change_curve(curve, parameter.key, value) for curve in curves], epsilon)


def change_curve(curve: Curve, key: str, value: float) -> Curve:
    """The curve with another parameter of the hand."""
    scene = change_scene(curve.formation.scene, key, value)
    return replace(curve, formation=replace(curve.formation, scene=scene))


def list_frictions(formation: Formation) -> list[Parameter]:
    """Friction of what is touched: to be lowered, and where a contact rolls to be raised."""
    parts = dict.fromkeys(contact.finger for contact in formation.contacts)
    rolls = {contact.finger for contact in formation.rolling}
    frictions = []
    for finger in parts:
        name = "palm" if finger is None else f"finger {finger + 1}"
        key, value = f"{FRICTION}.{name.replace(' ', '')}", formation.scene.friction.of(finger)
        signs = (-1, 1) if finger in rolls else (-1,)
        frictions += [Parameter(f"friction of {name}", value, "", sign, key) for sign in signs]
    return frictions


def _search_friction(parameter: Parameter, plan: Callable[[float], object]) -> float | None:
    """A lower or higher coefficient with which there is a plan."""
    farthest = 0.0 if parameter.sign < 0 else _ROUGH * parameter.value
    return bracket(parameter, farthest, lambda value: succeeds(partial(plan, value)))


def _solve_elastic(data: PhaseData, profile: Profile, units: Units) -> Profile | None:
    """The motion with the least shortfalls when every limit is soft."""
    short = data.limits.fold(-data.slack(data.nodes, profile))
    short = np.maximum(short, 0.0) + 0.05 * data.limits.scales
    solution = _solve_soft(data, profile, units, short / units.of(data.limits), None)
    return solution[0] if solution else None


def _relax(data: PhaseData, profile: Profile, units: Units, parameter: Parameter) -> float | None:
    """The value at which one parameter just lets all others be kept, if there is one."""
    step = units.force if parameter.unit == "N" else parameter.value
    short = data.limits.fold(-data.slack(data.nodes, profile)).max(axis=0)
    weights = step * data.limits.weigh(parameter)
    needed = np.divide(short, weights, out=np.zeros_like(short), where=weights > 0)
    relaxation = Relaxation(parameter, step)
    start = max(1.0, 1.5 * float(needed.max()))
    solution = _solve_soft(data, profile, units, start, relaxation)
    return relaxation.move(solution[1]) if solution else None


def _solve_soft(
    data: PhaseData,
    profile: Profile,
    units: Units,
    extra: float | Array,
    relaxation: Relaxation | None,
) -> tuple[Profile, float] | None:
    """Solve with soft limits, from a profile and the relaxation `extra` there."""
    goal = Objective.RELAX if relaxation else Objective.ELASTIC
    nlp = build_path_nlp(LimitShape.of(data.limits), len(data.grid.s) - 1, goal)
    result = nlp.solver(
        x0=pack(nlp, profile, units, extra),
        p=parameters(nlp, data, units, 1.0, relaxation),
        **make_bounds(nlp, data, units, Tightening.none(data, None), relaxation),
    )
    if not nlp.solver.stats()["success"]:
        return None
    return unpack(nlp, data.grid, result["x"].full()[:, 0], units)


def _list_shortfalls(
    data: PhaseData, profile: Profile, phase: int, several: bool
) -> list[Shortfall]:
    times = PathMotion(data.curve, data.grid, profile).times
    z = data.curve.evaluate(data.grid.s).z

    def locate(node: int) -> LimitPlace:
        text = f"t = {times[node]:.4f} s ({describe_pose(z[node])})"
        return LimitPlace(phase, float(times[node]), text + (f", phase {phase}" if several else ""))

    return list_shortfalls(data.limits, data.evaluate(data.nodes, profile), locate)


def explain_rate_limits(task: Task, parts: Sequence[PhaseData], reason: str) -> WholearmError:
    """The error for phases without a plan under rate limits and lags.

    It is that of unlimited rates if there is no plan with these either. Otherwise larger limits
    are tried.
    """
    rest = task.epsilon, task.options, task.phases, task.duration
    try:
        require_hold(parts[0], task.phases[0], 0)
        require_hold(parts[-1], task.phases[-1], -1)
        plan_curves([_raise_rate_limits(curve, np.inf) for curve in task.curves], *rest)
    except WholearmError as error:
        return error
    for factor in _TRIED:
        try:
            curves = [_raise_rate_limits(curve, factor) for curve in task.curves]
            plan_curves(curves, *rest, False, task.pins)
        except WholearmError:
            continue
        change = f"feasible with motors {factor:g} times as quick"
        break
    else:
        change = "a plan was found for motors without limits"
    text = (
        "torques may not change as quickly as they would have to (torque_rate_limit, actuator_lag)"
    )
    return InfeasibleError(f"{name_phases(task.phases, 'infeasible')}: {text}; {change}; {reason}")


def _raise_rate_limits(curve: Curve, factor: float) -> Curve:
    """The curve in a scene with torque rate limits and 1 / lags times a factor."""
    scene = curve.formation.scene
    right, left = (
        replace(
            finger,
            torque_rate_limit=finger.torque_rate_limit * factor,
            actuator_lag=finger.actuator_lag / factor,
        )
        for finger in scene.fingers
    )
    scene = replace(scene, fingers=(right, left))
    return replace(curve, formation=replace(curve.formation, scene=scene))
