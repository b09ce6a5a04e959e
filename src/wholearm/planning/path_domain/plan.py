"""Planning one-freedom phases: first guess, NLP, and limits that hold between nodes too.

The NLP of `nlp` keeps the limits at its nodes. Once it is solved, nodes are redistributed towards
where limits are missed most between them (where the plan switches from one to another). Then
limits are tightened by what they miss and the NLP is solved again from where it was, until nothing
misses more than `MISS`.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from ...common.arrays import Array
from ...common.errors import InfeasibleError, JammingError, SolverError, WholearmError
from ...geometry.curve import Curve
from ..options import Objective, PlanOptions
from ..phase_plan import PhasePlan
from .data import PhaseData, cut, fit_torque, join, name_phases, prepare
from .motion import Grid, PathMotion, Profile, make_grid, redistribute_nodes
from .nlp import (
    PathNLP,
    Tightening,
    Units,
    build_path_nlp,
    first_multipliers,
    make_bounds,
    move_multipliers,
    pack,
    parameters,
    unpack,
)

MISS = 2.5e-7
"""Largest miss of a limit between nodes.

Over the scene's force for contact forces, relative for torques, the square of speeds and time.
"""
ROUNDS = 40
"""Most times that the NLP is solved for one phase."""
_COARSE = 1.5e-4
"""Miss, over the typical force or torque, above which the grid is drawn together."""
_FAST = 1e-2
"""The same for the square of a speed limit, relatively."""
_LEVER = 30.0
"""Lever at which the typical force makes the typical torque, in radii of gyration."""
_FINER = (1, 2, 4)
"""Intervals to try, over those that are asked for."""
_SLOW = -12
"""Height of the slowest guess, as a power of two times that of a fall."""
_QUICK = 30.0
"""How much faster, squared, than the torque limits alone allow a guess may be."""
_FIRM = 40.0
"""Largest range of the squeeze that a guess is amid, over the scene's force or the least of it."""
_LIGHT = 0.5
"""Least unit of force, over the scene's: where forces are next to nothing they do not count."""
_OVER = 1.05
"""How much more than the miss a limit is tightened."""


class _Solution(NamedTuple):
    profile: Profile
    margin: float
    multipliers: dict[str, Array]
    iterations: int
    seconds: float


class _StoppedError(Exception):
    """The solver has stopped without an answer."""


class _StuckError(SolverError):
    """A solve that failed, with the phases that it failed for."""

    def __init__(self, parts: Sequence[PhaseData], message: str) -> None:
        self.parts = parts
        super().__init__(message)


class _TightError(_StuckError):
    """Limits can be kept at the nodes, but not between them on so coarse a grid."""


def plan_path(
    curve: Curve,
    epsilon: float,
    options: PlanOptions,
    phase: int,
    duration: float | None = None,
) -> PhasePlan[PathMotion]:
    """Plan one phase along a curve, from rest to rest; see `plan_curves`."""
    return plan_curves((curve,), epsilon, options, (phase,), duration)[0]


def plan_curves(
    curves: Sequence[Curve],
    epsilon: float,
    options: PlanOptions,
    phases: Sequence[int],
    duration: float | None = None,
    explained: bool = True,
) -> list[PhasePlan[PathMotion]]:
    """Plan phases along curves that are run through one after the other, from rest to rest.

    Parameters
    ----------
    curves : sequence of Curve
        At such paces that the speed is the same on both sides of where two of them meet.
    epsilon : float, [N]
        Least normal force.
    options : PlanOptions
    phases : sequence of int
        The phases' numbers, for messages.
    duration : float, optional, [s]
        Longest duration of all, for the objective `margin`.
    explained : bool
        Whether to find out why there is no plan, which takes longer than planning.

    Raises
    ------
    InfeasibleError
        If no motion keeps the limits; names what is short, where and by how much, and each single
        limit with which there would be a plan.
    JammingError
        If friction jams a formation somewhere on its curve.
    SolverError
        If the solver stops without an answer.
    """
    where = name_phases(phases)

    def replan(changed: Sequence[Curve], least: float) -> object:
        return _plan(changed, least, options, phases, duration)

    try:
        plans = _plan_finer(curves, epsilon, options, phases, duration)
    except JammingError as jam:
        if not explained or len(curves) > 1:
            raise
        from .explain import explain_jam

        raise explain_jam(curves[0], epsilon, jam, replan) from None
    except _StuckError as stuck:
        if not explained:
            raise
        from .explain import explain

        late = _explain_duration(curves, epsilon, options, phases, duration)
        raise late or explain(
            stuck.parts,
            *guess_slowly(join(stuck.parts)),
            phases,
            str(stuck),
            replan,
        ) from None
    if options.goal is Objective.MARGIN and plans[0].value < epsilon - MISS * _force_of(curves[0]):
        late = _explain_duration(curves, epsilon, options, phases, duration)
        raise late or SolverError(f"{where}: the margin found is below epsilon")
    return plans


def _explain_duration(
    curves: Sequence[Curve],
    epsilon: float,
    options: PlanOptions,
    phases: Sequence[int],
    duration: float | None,
) -> InfeasibleError | None:
    """Say so if the duration is shorter than the least time, and which one would do."""
    from ..advice import Limit, describe_changes, find_changes

    if duration is None:
        return None
    fastest = replace(options, objective=Objective.TIME, duration=None)
    try:
        least = sum(plan.value for plan in _plan(curves, epsilon, fastest, phases, None))
    except WholearmError:
        return None
    if least <= duration:
        return None

    def can_plan(_: int, value: float) -> bool:
        try:
            return _plan(curves, epsilon, options, phases, value)[0].value >= epsilon
        except SolverError:
            return False

    changes = find_changes([Limit("duration", duration, "s", 1)], lambda _: least, can_plan)
    return InfeasibleError(
        f"{name_phases(phases, 'infeasible')}: duration = {duration:g} s is "
        f"{least - duration:.3g} s shorter than the least time; {describe_changes(changes)}"
    )


def _plan_finer(
    curves: Sequence[Curve],
    epsilon: float,
    options: PlanOptions,
    phases: Sequence[int],
    duration: float | None,
) -> list[PhasePlan[PathMotion]]:
    """Plan, on a finer grid where limits that hold between the nodes leave nothing."""
    least = epsilon - MISS * _force_of(curves[0])
    for finer in _FINER:
        try:
            own = replace(options, intervals=finer * options.intervals)
            plans = _plan(curves, epsilon, own, phases, duration)
            below = options.goal is Objective.MARGIN and plans[0].value < least
            if not below or finer == _FINER[-1]:
                return plans
        except _TightError as error:
            tight = error
    raise tight


def _plan(
    curves: Sequence[Curve],
    epsilon: float,
    options: PlanOptions,
    phases: Sequence[int],
    duration: float | None,
) -> list[PhasePlan[PathMotion]]:
    def prepare_all(grids: Iterable[Grid]) -> list[PhaseData]:
        given = zip(curves, grids, phases, strict=True)
        return [prepare(curve, epsilon, grid, phase) for curve, grid, phase in given]

    parts = prepare_all(make_grid(curve, options.intervals) for curve in curves)
    data = join(parts)
    first, intervals = curves[0].formation, len(data.grid.steps)
    nlp = build_path_nlp(first.n_contacts, intervals, options.goal, first.n_rolling)
    profile, units = guess(data, options.time_weight)
    tightening = Tightening.none(data, duration)
    solution = _Solution(profile, 0.0, first_multipliers(nlp, data, profile, units), 0, 0.0)
    for solves in range(1, ROUNDS + 1):
        try:
            solution = _solve(nlp, data, units, tightening, solution, options.time_weight)
        except _StoppedError as stop:
            kind = _StuckError if solves == 1 else _TightError
            raise kind(parts, f"{name_phases(phases)}: {stop}") from None
        profile, margin = solution.profile, solution.margin
        motions = [
            PathMotion(part.curve, part.grid, own)
            for part, own in zip(parts, cut(parts, profile), strict=True)
        ]
        short, speeding = data.misses(profile, margin)
        total = sum(motion.duration for motion in motions)
        late = max(0.0, total / duration - 1) if duration else 0.0
        if max((short / data.spans).max(), speeding.max(), late) <= MISS:
            break
        coarse = _weigh(data, short, speeding, units)
        if solves == 1 and coarse.max() > 1:
            old = data.grid
            shares = np.split(coarse, np.cumsum([len(part.nonempty) for part in parts])[:-1])
            parts = prepare_all(
                redistribute_nodes(part.grid, part.nonempty, share)
                for part, share in zip(parts, shares, strict=True)
            )
            data = join(parts)
            solution = solution._replace(
                profile=Profile(*(np.interp(data.grid.s, old.s, part) for part in profile)),
                multipliers=move_multipliers(nlp, solution.multipliers, old, data.grid),
            )
        else:
            reach = data.spread_to_nodes(data.slack_at_neighbours(profile, margin, short))
            short, speeding = data.spread_to_nodes(short), data.spread_to_nodes(speeding)
            tightening = tightening.by(reach, _OVER * short, _OVER * speeding, _OVER * late)
    else:
        worst = int((short / data.spans).max(axis=0).argmax())
        unit = "N" if worst < len(data.least) else "N m"
        missed = f"limits are still missed by {short[:, worst].max():.2g} {unit} between nodes"
        if (short / data.spans).max() <= MISS:
            over = max(speeding.max(), late)
            missed = f"the speed limit or the duration is still exceeded by {over:.2g} of it"
        missed = f"after {ROUNDS} solves {missed}; plan with more intervals"
        raise _TightError(parts, f"{name_phases(phases)}: {missed}")
    plans: list[PhasePlan[PathMotion]] = []
    for part, motion in zip(parts, motions, strict=True):
        torque, squares = fit_torque(part, motion)
        value = {
            Objective.TIME: motion.duration,
            Objective.EFFORT: squares + options.time_weight * motion.duration,
            Objective.MARGIN: epsilon + margin,
        }[options.goal]
        costs = (0, 0, 0.0, 0.0)
        if not plans:
            costs = (solution.iterations, solves, nlp.build_time, solution.seconds)
        plans.append(PhasePlan(motion, torque, value, *costs))
    return plans


def _weigh(data: PhaseData, short: Array, speeding: Array, units: Units) -> Array:
    """How much each solid interval misses of what draws the grid together, shape (n_solid,)."""
    count, lever = len(data.least), _LEVER * data.curve.formation.scene.scales.length
    held, torque = short[:, :count].max(axis=1), short[:, count:].max(axis=1)
    forces = np.maximum(held, torque / lever) / (_COARSE * units.force)
    return np.asarray(np.maximum(forces, speeding / _FAST))


def _solve(
    nlp: PathNLP,
    data: PhaseData,
    units: Units,
    tightening: Tightening,
    start: _Solution,
    time_weight: float,
) -> _Solution:
    bounds = make_bounds(nlp, data, units, tightening)
    if (bounds["lbg"] > bounds["ubg"]).any():
        raise _StoppedError("limits that hold between the nodes too leave nothing")
    result = nlp.solver(
        x0=pack(nlp, start.profile, units, start.margin),
        p=parameters(nlp, data, units, time_weight),
        **bounds,
        **start.multipliers,
    )
    stats = nlp.solver.stats()
    if not stats["success"]:
        raise _StoppedError(f"Ipopt stopped with {stats['return_status']}")
    profile, margin = unpack(nlp, data.grid, result["x"].full()[:, 0], units)
    multipliers = {f"{key}0": result[key].full()[:, 0] for key in ("lam_x", "lam_g")}
    iterations = start.iterations + stats["iter_count"]
    seconds = start.seconds + stats["t_wall_total"]
    return _Solution(profile, margin, multipliers, iterations, seconds)


def guess(data: PhaseData, time_weight: float = 0.0) -> tuple[Profile, Units]:
    """Guess a motion: b a parabola in s as high as limits allow, the squeeze amid its range.

    Where limits forbid even a slow one, it is as quick as a fall: a plan, if there is one, is not
    slow, and in units of a slow one the costs that choose among equals would weigh too much.
    """
    b_max = data.largest_b(data.nodes)
    fall = _fall(data)

    def possible(height: float) -> bool:
        low, high = _squeeze_range(data, height)
        b = _parabola(data, height)[1]
        return bool((low <= high).all() and (b <= b_max).all())

    # Bisection over heights from 2^-12 to 2^8 times that of a fall over this length.
    low_power, high_power = float(_SLOW), 8.0
    for _ in range(7):
        power = (low_power + high_power) / 2
        if possible(fall * 2**power):
            low_power = power
        else:
            high_power = power
    none = low_power == _SLOW
    return _guess_at(data, 0.7 * fall * (1.0 if none else 2**low_power), time_weight)


def guess_slowly(data: PhaseData) -> tuple[Profile, Units]:
    """Guess a slow motion, whatever limits say."""
    return _guess_at(data, 0.7 * _fall(data) * 2.0**_SLOW)


def _force_of(curve: Curve) -> float:
    return curve.formation.scene.scales.force


def _fall(data: PhaseData) -> float:
    """The b of a fall over the length of the curve, or of what joints may do [m^2/s^2]."""
    length, forces = float(data.grid.s[-1]), data.nodes.forces
    fall = 2 * data.curve.formation.scene.scales.acceleration * length

    def usual(coefficients: Array) -> float:
        """Where this coefficient alone would take a joint to its torque limit."""
        return 1 / max(float((np.abs(coefficients) / data.torque_limit).max(axis=1).mean()), 1e-100)

    b_max = data.largest_b(data.nodes)
    inertia, drag = 2 * length * usual(forces.Ta), usual(forces.Tv) ** 2
    return min(fall, _QUICK * min(inertia, drag, _find_median(b_max)))


def _find_median(values: Array) -> float:
    """Median, the upper one of two; that of numpy takes 10 ms to import what it needs."""
    middle = values.size // 2
    return float(np.partition(values.ravel(), middle)[middle])


def _parabola(data: PhaseData, height: float) -> tuple[Array, Array]:
    """The a and b of a parabola in s of this height."""
    length = data.grid.s[-1]
    x = data.grid.s / length
    return height * 2 * (1 - 2 * x) / length, height * 4 * x * (1 - x)


def _squeeze_range(data: PhaseData, height: float) -> tuple[Array, Array]:
    """Least and largest squeeze that limits allow at each node."""
    a, b = _parabola(data, height)
    slack = data.slack(data.nodes, Profile(a, b, np.zeros_like(a)))
    forces = data.nodes.forces
    rate = np.hstack([forces.Cl, forces.Tl, -forces.Tl])
    with np.errstate(divide="ignore", invalid="ignore"):
        bound = -slack / rate
    low = np.where(rate > 0, bound, -np.inf).max(axis=1)
    high = np.where(rate < 0, bound, np.inf).min(axis=1)
    return low, high


def _guess_at(data: PhaseData, height: float, time_weight: float = 0.0) -> tuple[Profile, Units]:
    low, high = _squeeze_range(data, height)
    weight = data.curve.formation.scene.scales.force
    open_ = np.isfinite(low + high) & (low <= high)
    press = float(np.abs(np.where(open_, (low + high) / 2, 0.0)).mean())
    # A strong hand could press far harder than any motion needs.
    high = np.minimum(high, low + _FIRM * np.maximum(weight, np.abs(low)))
    middle = np.where(open_, (low + high) / 2, 0.0)
    length = float(data.grid.s[-1])
    duration = np.pi / 2 * length / np.sqrt(height)
    force = max(_LIGHT * weight, data.epsilon, float(np.abs(middle).mean()))
    profile = Profile(*_parabola(data, height), middle)
    torque = data.torque_limit
    squares = np.minimum(np.abs(data.nodes.forces.tau(*profile)), torque) ** 2
    power = time_weight + float(squares.sum(axis=1).mean())
    return profile, Units(length, 0.6 * duration, force, torque, power, max(force, press))
