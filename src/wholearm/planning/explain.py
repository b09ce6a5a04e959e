"""Diagnosis of phases without a plan: elastic mode, then one relaxation at a time.

With soft limits the shortfalls of the motion of least violation are ranked. Then each limit alone
is relaxed by as little as the others allow. Its value is rounded outwards and confirmed by a plan:
only changes with which there is a plan are advised.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from contextlib import AbstractContextManager, suppress
from contextvars import ContextVar
from dataclasses import replace
from functools import partial
from itertools import groupby
from operator import attrgetter, itemgetter
from typing import Any, TypeVar

import numpy as np

from ..common.arrays import Array
from ..common.errors import (
    Change,
    InfeasibleError,
    InputError,
    JammingError,
    LimitPlace,
    Parameter,
    Shortfall,
    SolverError,
    WholearmError,
    describe_changes,
    name_phases,
    round_outwards,
)
from ..contacts.formation import Formation
from ..geometry.curve import Curve, describe_pose
from ..geometry.path_guess import count_freedoms
from ..geometry.tracing import find_headings, trace_curve
from ..mechanics.limits import EPSILON, PRESS, LimitSet, make_limits
from ..mechanics.statics import Statics, pushes_one_way
from ..problem.definition import Phase, Problem, Until
from ..results.trajectory import Trajectory
from ..scene.model import Scales, Scene
from .dwell import require_hold
from .nlp import collect_costs, setting
from .options import PlanOptions
from .path_domain.path_data import fit_torque
from .path_domain.path_plan import PathIterate, Pins, Task, plan_curves, require_unique
from .phase_plan import Piece, Plans, assemble_motions, runs_along_curves
from .time_domain.guesses import PathMargin
from .time_domain.solution import TimeSearch
from .time_domain.stage import Stage, bernstein, make_formation, to_si
from .time_domain.time_motion import make_phase_motions

ADVICE = 100  # solver iterations after which no change is tried for phases over time
HALVINGS = 6  # most bisections between values with and without a plan
FRICTION = "friction"  # prefix of the keys of frictions
_unadvised: ContextVar[bool] = ContextVar("_unadvised", default=False)
Replan = Callable[[Parameter, float], object]  # plans with another value of a parameter, or raises
E = TypeVar("E", InfeasibleError, JammingError)


def unadvised() -> AbstractContextManager[None]:
    """Context in which errors have no advice: no changes are looked for."""
    return setting(_unadvised, True)


def advise(
    error: E,
    parameters: Iterable[Parameter],
    list_values: Callable[[Parameter], Sequence[float] | None],
    replan: Replan | None,
    max_iter: float = math.inf,
) -> E:
    """Add to an error the changes of a single parameter with which there is a plan.

    `list_values` is that of `find_changes`, or returns None if it cannot decide. Without `replan`,
    and after `max_iter` solver iterations, no change is looked for.
    """
    if replan is None or _unadvised.get():
        return error
    undecided = list[Parameter]()
    with collect_costs() as costs:

        def is_over(parameter: Parameter) -> bool:
            exhausted = sum(cost.iterations for cost in costs.values()) > max_iter
            undecided.extend([parameter] * exhausted)
            return exhausted

        def list_candidates(parameter: Parameter) -> Sequence[float]:
            values = None if is_over(parameter) else list_values(parameter)
            undecided.extend([parameter] * (values is None))
            return values or ()

        def can_plan(parameter: Parameter, value: float) -> bool:
            if is_over(parameter):
                return False
            try:
                replan(parameter, value)
            except (InfeasibleError, SolverError, JammingError, InputError):
                return False
            return True

        error.changes = tuple(find_changes(parameters, list_candidates, can_plan))
    advice = describe_changes(error.changes)
    if undecided and not error.changes:
        advice = "no single limit was found that makes it feasible"
    error.args = (f"{error}; {advice}",)
    return error


def find_changes(
    parameters: Iterable[Parameter],
    list_values: Callable[[Parameter], Sequence[float]],
    can_plan: Callable[[Parameter, float], bool],
) -> list[Change]:
    """Changes of a single parameter with which there is a plan, to values rounded outwards.

    `list_values` returns a value without a plan, or NaN, then candidates in their order.
    """
    changes = []
    for parameter in parameters:
        sign, (infeasible, *values) = parameter.sign, list_values(parameter) or (math.nan,)
        for value in dict.fromkeys(round_outwards(candidate, sign) for candidate in values):
            if value < 0:
                break
            if value == parameter.value or not can_plan(parameter, value):
                infeasible = value
                continue
            # The least change that allows a plan, by bisection.
            for _ in range(HALVINGS):
                middle = round_outwards((value + infeasible) / 2, sign)
                if not abs(value - infeasible) > 0.02 * value or middle in (value, infeasible):
                    break
                feasible = can_plan(parameter, middle)
                value, infeasible = (middle, infeasible) if feasible else (value, middle)
            changes.append(Change(parameter, value))
            break
    return changes


def list_beyond(parameter: Parameter, limit: float) -> list[float]:
    """Candidates from `limit` on, the least change with which limits hold at the nodes.

    Plans satisfy limits between nodes, too.
    """
    fractions = (0.0, 0.005, 0.015, 0.05, 0.15, 0.5)
    return [math.nan, *(limit * (1 + parameter.sign * fraction) for fraction in fractions)]


def change_scene(scene: Scene, key: str, value: float) -> Scene:
    """The scene with another value of a parameter, such as `fingers.1.torque_limit`."""
    part, *names = key.split(".")
    if part == FRICTION:
        return replace(scene, friction=replace(scene.friction, **{names[0]: value}))
    change: Any = {names[1]: value}
    fingers = dict(zip("12", scene.fingers, strict=True))
    fingers[names[0]] = replace(fingers[names[0]], **change)
    return replace(scene, fingers=(fingers["1"], fingers["2"]))


def change_curve(curve: Curve, key: str, value: float) -> Curve:
    """The curve with another parameter of the hand."""
    scene = change_scene(curve.formation.scene, key, value)
    return replace(curve, formation=replace(curve.formation, scene=scene))


def change_limit(problem: Problem, key: str, value: float) -> Problem:
    """The problem with another value of a parameter of its limits."""
    if key == EPSILON:
        return replace(problem, epsilon=value)
    return replace(problem, scene=change_scene(problem.scene, key, value))


def find_shortfalls(
    limits: LimitSet, values: Array, places: Sequence[LimitPlace]
) -> list[Shortfall]:
    """Largest violation of each limit and its place, from values of the rows, (n, m)."""
    shortfalls = []
    for limit, amount, k in limits.list_violated(values, 1e-4):  # least violation that counts
        kind, part, share = limit.kind, limit.part, amount / limit.scale
        shortfalls.append(Shortfall(kind, part, limit.text, amount, limit.unit, places[k], share))
    return shortfalls


def rank(
    phases: Sequence[int], shortfalls: Iterable[Shortfall], motion: Trajectory | None
) -> InfeasibleError:
    """The error for phases with a motion of least violation; the worst shortfall comes first."""
    ranked = sorted(shortfalls, key=lambda shortfall: -shortfall.share)
    text = f"{name_phases(phases, 'infeasible')}: {'; '.join(map(str, ranked))}"
    return InfeasibleError(text, ranked, (), motion)


def explain_curves(task: Task, status: str) -> WholearmError:
    """The error for phases along curves without a plan, with changes that allow one.

    It names torque rate limits, or the shortfalls of the elastic problem. `status` says how the
    solver ended.
    """
    if task.is_held:
        return _explain_rate_limits(task, status)
    try:
        elastic = PathIterate.elastic(task).solve()
    except SolverError:
        return SolverError(status)
    data, parts = elastic.data, elastic.parts
    pieces, shortfalls, trajectory = list[Piece](), list[Shortfall](), None
    for part, motion, phase in zip(parts, elastic.motions, task.phases, strict=True):
        suffix = f", phase {phase}" if len(parts) > 1 else ""
        nodes = zip(motion.times.tolist(), part.curve.evaluate(part.grid.s).z, strict=True)
        places = [
            LimitPlace(phase, t, f"t = {t:.4f} s ({describe_pose(z)}){suffix}") for t, z in nodes
        ]
        values = part.evaluate(part.nodes, motion.profile)
        shortfalls += find_shortfalls(part.limits, values, places)
    if not shortfalls:
        text = f"{status} although limits can be kept; try other --intervals or --accuracy"
        return SolverError(text)
    parameters = [*data.speeds.parameters, *data.limits.parameters]
    if len(parts) == 1:
        # With several phases velocities after impacts depend on friction, too.
        parameters += list_frictions(data.curve.formation)

    def list_values(parameter: Parameter) -> Sequence[float]:
        if parameter.key.startswith(FRICTION):
            return list_frictions_to_try(parameter)
        least = _find_least(task, parameter)
        return () if least is None else list_beyond(parameter, least)

    with suppress(SolverError):  # the motion stalls
        for part, motion in zip(parts, elastic.motions, strict=True):
            pieces.append((motion, fit_torque(part, motion), part.curve.formation))
        trajectory = assemble_motions(pieces, 201, status="misses limits least")
    error = rank(task.phases, shortfalls, trajectory)
    return advise(error, parameters, list_values, partial(_replan_task, task))


def _change_task(task: Task, parameter: Parameter, value: float) -> Task:
    """The task on the same curves with another value of a parameter."""
    if parameter.key == EPSILON:
        return replace(task, epsilon=value)
    return replace(task, curves=[change_curve(c, parameter.key, value) for c in task.curves])


def _find_least(task: Task, parameter: Parameter) -> float | None:
    """Value of a parameter nearest to its own with which a speed sweep finds a motion, to 0.3 %.

    By bisection, up to a thousand times its value or down to zero; None if there is none.
    """
    increases = parameter.sign > 0
    infeasible, least = parameter.value, 1e3 * parameter.value if increases else 0.0
    if _change_task(task, parameter, least).find_fastest() is None:
        return None
    while abs(least - infeasible) > 0.003 * max(least, 0.01 * infeasible):
        middle = math.sqrt(infeasible * least) if increases else (infeasible + least) / 2
        feasible = _change_task(task, parameter, middle).find_fastest() is not None
        least, infeasible = (middle, infeasible) if feasible else (least, middle)
    return least


def _replan_task(task: Task, parameter: Parameter, value: float) -> object:
    """Plan along the same curves with another value of a parameter, at low accuracy.

    Friction is that of other phases, too: it must neither jam these nor leave their contact forces
    ambiguous. More of another limit allows them more.
    """
    if parameter.key.startswith(FRICTION) and task.others:
        curves = [change_curve(curve, parameter.key, value) for curve in task.others.values()]
        others = replace(task, curves=curves, phases=[*task.others], references=())
        for curve, number in zip(curves, others.phases, strict=True):
            require_unique(curve, task.options.uniqueness_margin, number)
        others.lay_out()
    task = _change_task(task, parameter, value)
    if task.find_fastest() is None:
        raise SolverError("no motion keeps the limits")
    task = replace(task, options=task.options.roughen(), references=())
    return plan_curves(task, explained=False)


def list_frictions(formation: Formation) -> list[Parameter]:
    """Friction coefficients of a formation: to lower, and where a contact rolls also to raise."""
    parts = dict.fromkeys(contact.finger for contact in formation.contacts)
    rolling_parts = {contact.finger for contact in formation.rolling}
    frictions = []
    for finger in parts:
        name = "palm" if finger is None else f"finger {finger + 1}"
        key, value = f"{FRICTION}.{name.replace(' ', '')}", formation.scene.friction.of(finger)
        signs = (-1, 1) if finger in rolling_parts else (-1,)
        frictions += [Parameter(f"friction of {name}", value, "", sign, key) for sign in signs]
    return frictions


def list_frictions_to_try(parameter: Parameter) -> tuple[float, float]:
    """The coefficient, without a plan, and zero or a high coefficient."""
    return parameter.value, 0.0 if parameter.sign < 0 else 4.0 * parameter.value


def explain_jam(task: Task, jam: JammingError) -> JammingError:
    """Add to an error the single lower frictions with which a phase has a plan."""
    parameters = [p for p in list_frictions(task.curves[0].formation) if p.sign < 0]
    return advise(jam, parameters, list_frictions_to_try, partial(_replan_task, task))


def _explain_rate_limits(task: Task, reason: str) -> WholearmError:
    """The error for phases without a plan under rate limits and lag.

    If there is no plan with unlimited rates either, it is the error of these. Otherwise larger
    limits are tried.
    """
    scene = task.curves[0].formation.scene
    parts = task.lay_out()

    def plan(scene: Scene, pins: Pins = (None, None), explained: bool = True) -> Scene:
        curves = [replace(c, formation=replace(c.formation, scene=scene)) for c in task.curves]
        plan_curves(replace(task, curves=curves, references=(), pins=pins), explained)
        return scene

    try:
        require_hold(parts[0], task.phases[0], 0)
        require_hold(parts[-1], task.phases[-1], -1)
        plan(scene.quicken(math.inf))
    except WholearmError as error:
        return error
    for factor in (2.0, 10.0, 100.0):
        with suppress(WholearmError):
            relaxed = plan(scene.quicken(factor), task.pins, explained=False)
            return refuse_motors(scene, relaxed, task.phases, reason)
    return refuse_motors(scene, None, task.phases, reason)


# Keys of motors and control periods: unit, and sign of a change that allows faster torque changes
MOTORS = {"torque_rate_limit": ("N m/s", 1), "actuator_lag": ("s", -1), "control_period": ("s", -1)}


def _list_motors(scene: Scene) -> list[tuple[str, float]]:
    """Keys and values of all limits of torque changes."""
    *keys, period = MOTORS
    limits = [(key, getattr(finger, key)) for key in keys for finger in scene.fingers]
    return [*limits, (period, scene.control_period)]


def refuse_motors(
    scene: Scene, relaxed: Scene | None, phases: Sequence[int], reason: str = "", attempt: str = ""
) -> InfeasibleError:
    """The error for phases without a plan under motor limits or control periods.

    There is a plan in the scene `relaxed`; None: only with free torques, and none with `attempt`.
    """
    changes = dict[Change, None]()
    pairs = zip(_list_motors(scene), _list_motors(relaxed or scene), strict=True)
    for (key, value), (_, other) in pairs:
        if value != other:
            unit, sign = MOTORS[key]
            change = Change(Parameter(key, value, unit, sign, key), round_outwards(other, sign))
            changes[change] = None
    text = f"{name_phases(phases, 'infeasible')}: torques may not change as quickly as they would "
    advice = f"feasible with {' and '.join(map(str, changes))}"
    free = "a plan was found with free torques" + f", and none with {attempt}" * bool(attempt)
    text += f"have to; {advice if changes else free}"
    text += f"; {reason}" * bool(reason)
    return InfeasibleError(text, changes=changes if len(changes) == 1 else ())


def refuse(search: TimeSearch, stages: Sequence[Stage], replan: Replan | None) -> None:
    """Raise an InfeasibleError if no motion can begin from rest, or come to rest at the end.

    The end counts if it is a single point, as of one phase with one degree of freedom. `replan` is
    that of `advise`.
    """
    problem, phases = search.source, search.phases
    epsilon, last, phase = search.problem.epsilon, stages[-1], phases[0]
    single = len(phases) == 1 and not phase.until.is_release
    fixed_end = single and count_freedoms(last.formation, last.guess.nodes[-1, 0]) == 1
    for stage, node in [(stages[0], 0), *[(last, -1)] * fixed_end]:
        statics = Statics(stage.formation, stage.guess.nodes[node, 0])
        if blocked := statics.find_block(epsilon, ends=node == -1):
            break
    else:
        first, text = stages[0].formation, ""
        names = " ".join(first.names)
        z = np.concatenate([stage.guess.z.reshape(-1, 5) for stage in stages])
        if single and [contact.finger for contact in first.contacts] == [None, None]:
            text = f"no finger drives the object on {names}, and it stays at rest; add a contact "
            text += "with a finger"
        elif single and first.n_constraints <= 2 and pushes_one_way(first, z):
            text = f"{names} can only push the object one way, with whatever friction, so that it "
            where = describe_pose(to_si(last, problem).guess.nodes[-1, 0])
            text += f"does not come to rest at its end, {where}"
        if text:
            raise InfeasibleError(f"phase {phase.number} is infeasible: {text}")
        return
    where = describe_pose(to_si(stage, problem).guess.nodes[node, 0])
    fails = "no motion comes to rest" if node else "no motion begins"
    place = "at its end" if node else "from rest at its start"
    text = f"phase {phase.number} is infeasible: {place}, {where}, {fails} in any contact mode"
    shortfalls = list[Shortfall]()
    if blocked.contact:
        contact, share = blocked.contact, blocked.shortfall
        amount = share * problem.scene.scales.force
        limit = f"c_n of {contact} >= epsilon = {problem.epsilon:g} N"
        text += f": {limit} is {amount:.3g} N short at best"
        limit_place = LimitPlace(phase.number, math.nan, where)
        shortfalls.append(Shortfall(PRESS, contact, limit, amount, "N", limit_place, share))
    else:
        text += " within the torque limits"

    def list_values(parameter: Parameter) -> Sequence[float]:
        if parameter.is_speed:
            return ()
        if parameter.key == EPSILON:
            value = statics.find_epsilon(node == -1)
        else:
            value = statics.find_torque_limit(epsilon, _find_finger(parameter), node == -1)
        unit = _unit_of(parameter, problem.scene.scales)
        return list_beyond(parameter, unit * value) if value else ()

    parameters = make_limits(phase.formation, problem.epsilon).parameters
    raise advise(InfeasibleError(text, shortfalls), parameters, list_values, replan, ADVICE)


def require_hold_at_ends(search: TimeSearch, stages: Sequence[Stage]) -> None:
    """Raise an InfeasibleError if no continuous torques hold the object at both ends of phases.

    The end counts if it is a single point; a motion with such torques has to reach it.
    """
    problem, phases = search.source, search.phases
    ends = [(phases[0], to_si(stages[0], problem), 0)]
    if stages[-1].formation.n_constraints == 4 or phases[-1].until.pins:
        ends.append((phases[-1], to_si(stages[-1], problem), -1))
    may_not = "torques may not step (torque_rate_limit, actuator_lag)"
    for phase, stage, node in ends:
        formation = stage.formation
        at_rest = stage.ending if node else formation
        z, limit = stage.guess.nodes[node, 0], problem.scene.torque_limit
        static = Statics(make_formation(formation.scene, at_rest.contacts), z).torque_polygon()
        moving = Statics(phase.formation, z)
        text = f"phase {phase.number} is infeasible: {may_not}"
        where = f"{'end' if node else 'start'}, {describe_pose(z)}"
        names, advice = " ".join(at_rest.names), "or leave out torque_rate_limit and actuator_lag"
        if static.is_empty(limit):
            size = "however large" if static.is_empty(np.full(2, np.inf)) else "within their limits"
            raise InfeasibleError(
                f"{text}, so that they have to hold the object at rest at its {where}; {names} "
                f"with their friction can be held there by no torques, {size}; end the phase where "
                f"they can (wholearm predict shows where), {advice}"
            )
        if node == 0 and moving.list_continuous(problem.epsilon) == []:
            raise InfeasibleError(
                f"{text}, and no motion begins without a step at its {where}: c_n >= "
                f"{problem.epsilon:g} N on {names} and the torque limits exclude balance on the "
                "verge of all; leave out torque_rate_limit and actuator_lag"
            )
        if at_rest is not formation and moving.list_continuous(problem.epsilon, static) == []:
            raise InfeasibleError(
                f"{text}, and none that bring it to rest at its {where}, and keep c_n >= "
                f"{problem.epsilon:g} N until then, hold the object there on {names}; end it "
                f"elsewhere{_find_holds(phase, at_rest, z, problem.epsilon)}, {advice}"
            )


def _find_holds(phase: Phase, at_rest: Formation, z: Array, epsilon: float) -> str:
    """Text with the ends of a phase along a curve through z, (5,), where torques can hold."""
    places = list[float]()
    for heading in find_headings(at_rest, z) if at_rest.n_constraints == 4 else ():
        curve = trace_curve(at_rest, z, heading, Until())
        for end in curve.evaluate(np.linspace(0.0, curve.length, 25)).z:
            static = Statics(at_rest, end).torque_polygon()
            if Statics(phase.formation, end).list_continuous(epsilon, static):
                places.append(1e3 * end[0])
    return f" (they can for x of {min(places):.3g} to {max(places):.3g} mm)" if places else ""


def refuse_paths(search: TimeSearch, margins: Sequence[PathMargin]) -> None:
    """Raise an InfeasibleError with the critical limit if every path violates a limit."""
    number = search.phases[0].number
    if not margins or (best := max(margins, key=lambda margin: margin.value)).value > -0.02:
        return
    limit, violation = best.limit, -best.value
    place = LimitPlace(number, math.nan, "the best of them")
    kind, part, amount = limit.kind, limit.part, violation * limit.scale
    shortfall = Shortfall(kind, part, limit.text, amount, limit.unit, place, violation)
    text = f"phase {number} is infeasible along all straight paths to its ends, at any speed: "
    raise InfeasibleError(f"{text}{shortfall}", [shortfall])


def explain_stages(
    search: TimeSearch,
    infeasible: Sequence[list[Stage]],
    replan: Replan | None,
    violations: Sequence[Shortfall] = (),
) -> InfeasibleError | SolverError:
    """The error for phases over time without a plan, with changes that allow one.

    `infeasible` are elastic solutions that violate limits, from different guesses. Without any,
    `violations` are those where the last elastic solve stopped. `replan` is that of `advise`.
    """
    problem, phases, numbers = search.source, search.phases, search.numbers
    if not infeasible:
        names = " and ".join(" ".join(phase.formation.names) for phase in phases)
        where = f"no plan for {name_phases(numbers)} ({names}, until {phases[-1].until})"
        text = f"{where}: the solver found neither a plan nor a motion that misses limits least"
        if violations:
            worst = max(violations, key=attrgetter("share"))
            text += f"; where it stopped, {worst}"
        over_time = search.options.transcription == "time" and not problem.scene.control_period
        if over_time and runs_along_curves(phases, PlanOptions()):
            return SolverError(f"{text}; leave out --transcription time, which plans along curves")
        return SolverError(f"{text}; try another number of intervals per phase (--time-intervals)")

    pairs = [(stages, list_shortfalls(search, stages)) for stages in infeasible]
    best, shortfalls = min(pairs, key=lambda pair: sum(shortfall.amount for shortfall in pair[1]))
    stages = [to_si(stage, problem) for stage in best]

    def list_values(parameter: Parameter) -> Sequence[float] | None:
        # The limit has to be active; epsilon counts if all normal forces are positive.
        if parameter.key == EPSILON:
            pressing = (shortfall for shortfall in shortfalls if shortfall.kind == PRESS)
            active = all(shortfall.amount < parameter.value for shortfall in pressing)
        else:
            parts = [stage.guess for stage in stages]
            tables = (part.v[..., 3:] if parameter.is_speed else part.tau for part in parts)
            peak = max(float(np.abs(table[..., _find_finger(parameter)]).max()) for table in tables)
            active = peak > 0.98 * parameter.value  # share of a limit above which it is active
        if not active:
            return None
        solution = search.soften(parameter).solve(best)
        # A limit that may be tighter does not conflict with the others.
        if not solution.success or solution.cost < 0.0:
            return None
        unit = _unit_of(parameter, problem.scene.scales)
        return list_beyond(parameter, parameter.value + parameter.sign * unit * solution.cost)

    motions = zip(make_phase_motions(stages, search.scheme), phases, strict=True)
    pieces = ((motion, motion.torque, phase.formation) for motion, phase in motions)
    trajectory = assemble_motions(pieces, 201, status="misses limits least")
    parameters = make_limits(phases[0].formation, problem.epsilon).parameters
    error = rank(numbers, shortfalls, trajectory)
    return advise(error, parameters, list_values, replan, ADVICE)


def list_shortfalls(search: TimeSearch, stages: Sequence[Stage]) -> list[Shortfall]:
    """Largest violation of each limit by stages in the scene's units, in SI units.

    Checked at the collocation points, torques also at the ends of intervals.
    """
    problem, scheme = search.source, search.scheme
    worst, start_time = dict[str, Shortfall](), 0.0
    indices = np.array([0, *range(scheme.degree), scheme.degree - 1])
    x = np.concatenate([[0.0], scheme.points, [1.0]])
    for stage in (to_si(stage, problem) for stage in stages):
        limits, part = make_limits(stage.formation, problem.epsilon), stage.guess
        tau = bernstein(x, part.tau.shape[1]) @ part.tau
        y = np.concatenate([part.forces[:, indices], tau, part.v[:, indices, 3:]], axis=2)
        middles = start_time + np.cumsum(part.h) - part.h / 2
        number, times = stage.phase + 1, np.repeat(middles, len(indices)).tolist()
        places = [LimitPlace(number, t, f"t = {t:.4f} s, phase {number}") for t in times]
        values = (y @ limits.rows.T).reshape(-1, len(limits.low))
        for new in find_shortfalls(limits, values, places):
            worst[new.limit] = max(worst.get(new.limit, new), new, key=lambda s: s.amount)
        start_time += part.duration
    return list(worst.values())


def _find_finger(parameter: Parameter) -> int:
    """Index of the finger whose limit a parameter is."""
    return int(parameter.key.split(".")[1]) - 1


def _unit_of(parameter: Parameter, scales: Scales) -> float:
    """The scene's unit of a parameter in SI units."""
    return {"N": scales.force, "N m": scales.torque, "rad/s": 1 / scales.time}[parameter.unit]


def explain_motors(
    scene: Scene, block: Sequence[Phase], free: Plans, error: WholearmError
) -> WholearmError:
    """The error for phases under motor limits; `free` are their plans with free torques, if any."""
    settings = list[str]()
    for key, group in groupby(_list_motors(scene), key=itemgetter(0)):
        texts = dict.fromkeys(f"{value:g}" for _, value in group if 0 < value < math.inf)
        if texts:
            settings.append(f"{key} = {' and '.join(texts)} {MOTORS[key][0]}")
    if not settings:
        return error
    keys, where = " and ".join(settings), name_phases([phase.number for phase in block])
    if isinstance(error, InfeasibleError):
        where += f" ({'; '.join(' '.join(phase.formation.names) for phase in block)})"
    time = sum(plan.motion.duration for plan in free)
    text = f"without {keys} there is a plan of about {time:.2g} s for {where}; with that, {error}"
    error.args = (text if free else f"{error}; so it is without {keys}",)
    return error
