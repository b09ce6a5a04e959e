"""Planning phases in the time domain: stages, first guess, NLP, and limits between points.

Phases that pass smoothly into one another are one NLP. It starts from the phases' outlines, with
the directions of friction that these have. Where the solution would rather slide the other way (a
sense of friction is active over a stretch), the stage is split and the NLP solved again. Limits are
looked at between points and tightened there by what they miss.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from .collocation import Scheme, radau
from .errors import InfeasibleError, SolverError
from .model import Array
from .options import Objective, PlanOptions
from .phaseplan import PhasePlan
from .problem import Phase, Problem
from .stage import Stage, StagePoints
from .staging import outline_stages, revise
from .timemotion import StageMotion, Start, TimeMotion
from .timenlp import TimeNLP, bound_unknowns, build_time_nlp

MISS = 5e-7
"""Largest miss of a limit between points [N or N m]."""
ROUNDS = 12
"""Most times that limits are tightened."""
REVISIONS = 2
"""Most times that directions of friction are revised."""
LOOKS = 25
"""Places per interval at which limits are looked at."""
_OVER = 1.5
"""How much more than the miss a limit is tightened."""
_ITERATIONS = 150
"""Most iterations of Ipopt for one solve."""
_PACES = (2.0, 4.0, 1.0, 8.0)
"""Guessed durations to try, in units of that of a fall."""
_TRIAL = 80
"""The same when other directions of friction are tried."""
_DEARER = 0.01
"""How much dearer, relatively, a plan may get by tightening before it is solved from scratch."""
_MU = 1e-2
"""Multipliers of the first guess."""


@dataclass
class _Effort:
    """What solving has cost so far."""

    iterations: int = 0
    solves: int = 0
    build_time: float = 0.0
    solve_time: float = 0.0


class _Solution(NamedTuple):
    points: tuple[StagePoints, ...]
    cost: float
    status: str
    success: bool


class _Limits(NamedTuple):
    """Limits of one stage, interval by interval, tightened so that they hold between points.

    Attributes
    ----------
    floor : ndarray, shape (K, n_c), [N]
        What c_n has to exceed.
    cap : ndarray, shape (K, 2), [N m]
        What tau must not exceed.
    """

    floor: Array
    cap: Array

    @staticmethod
    def plain(problem: Problem, stage: Stage, scheme: Scheme) -> _Limits:
        """The problem's own limits."""
        count = (len(stage.z) - 1) // scheme.degree
        floor = np.full((count, stage.formation.n_contacts), problem.epsilon)
        return _Limits(floor, np.tile(problem.scene.torque_limit, (count, 1)))

    def tighten(self, problem: Problem, motion: StageMotion, margin: float) -> float:
        """Tighten in place by what the motion misses between points; returns the largest miss."""
        count = motion.intervals
        places = np.arange(count)[:, None] + np.linspace(1e-9, 1 - 1e-9, LOOKS)
        samples = motion.evaluate(places.ravel() * motion.duration / count)
        short = problem.epsilon + margin - samples.c_n.reshape(count, LOOKS, -1).min(axis=1)
        over = np.abs(samples.tau).reshape(count, LOOKS, 2).max(axis=1)
        over = over - problem.scene.torque_limit
        self.floor[:] += _OVER * np.maximum(short, 0.0)
        self.cap[:] -= _OVER * np.maximum(over, 0.0)
        return float(max(short.max(), over.max()))


def plan_phases(
    problem: Problem,
    phases: Sequence[Phase],
    z: Array,
    options: PlanOptions,
    duration: float | None = None,
) -> list[PhasePlan[TimeMotion]]:
    """Plan phases that are joined smoothly, from rest at `z` to rest.

    Parameters
    ----------
    problem : Problem
    phases : sequence of Phase
        All but the last one end smoothly.
    z : ndarray, shape (5,)
    options : PlanOptions
    duration : float, optional, [s]
        Longest duration of all these phases, for the objective `margin`.

    Raises
    ------
    InputError
        If a phase's contacts do not touch or its end cannot be reached.
    InfeasibleError, SolverError
        If there is no plan.
    """
    scheme = radau(options.degree)
    cost = _Effort()
    for pace in _PACES:
        stages = outline_stages(problem, phases, z, scheme, options.time_intervals, pace)
        best = _solve(problem, stages, scheme, options, duration, cost, _ITERATIONS)
        if best.success:
            break
    for _ in range(REVISIONS):
        revised = revise(stages, best.points, scheme)
        if revised is None:
            break
        other = _solve(problem, revised, scheme, options, duration, cost, _TRIAL)
        if not other.success or (best.success and other.cost > best.cost - 1e-7 * abs(best.cost)):
            break
        stages, best = revised, other
    if not best.success:
        raise _explain(problem, phases, stages, best)
    motions = _make_motions(stages, best.points, scheme, Start(z, np.zeros(5)))
    plans = [_summarise(problem, motion, options, best) for motion in motions.values()]
    plans[0] = plans[0]._replace(
        iterations=cost.iterations,
        solves=cost.solves,
        build_time=cost.build_time,
        solve_time=cost.solve_time,
    )
    return plans


def _first_points(stage: Stage, scheme: Scheme) -> StagePoints:
    if stage.known is not None:
        return stage.known
    count, n_c = len(stage.z) - 1, stage.formation.n_contacts
    steps = (np.arange(count // scheme.degree)[:, None] + scheme.points).ravel()
    t = np.append(0.0, steps) * stage.duration * scheme.degree / count
    v = np.gradient(stage.z, t, axis=0)[1:]
    nothing = np.zeros((count, 5))
    return StagePoints(
        stage.duration, stage.z[1:], v, nothing, np.ones((count, n_c)), np.zeros((count, 2))
    )


def _solve(
    problem: Problem,
    stages: Sequence[Stage],
    scheme: Scheme,
    options: PlanOptions,
    duration: float | None,
    cost: _Effort,
    max_iter: int,
) -> _Solution:
    """Solve for given stages, until limits hold between points too."""
    z = stages[0].z[0]
    start = (z, np.zeros(5))
    points = [_first_points(stage, scheme) for stage in stages]
    limits = [_Limits.plain(problem, stage, scheme) for stage in stages]
    margin = 0.0
    with_margin = options.goal is Objective.MARGIN
    nlp: TimeNLP | None = None
    solution = _Solution(tuple(points), np.inf, "", False)
    multipliers: dict[str, Array] = {}
    for _ in range(ROUNDS):
        if nlp is None:
            nlp = build_time_nlp(stages, scheme, start, options.goal, options.time_weight, max_iter)
            cost.build_time += nlp.build_time
            low, high = bound_unknowns(stages, int(with_margin))
        rows_high = nlp.high.copy()
        if with_margin:
            rows_high[-1] = np.inf if duration is None else duration
        begin = np.concatenate([part.pack() for part in points])
        result = nlp.solver(
            x0=np.append(begin, [margin] * with_margin),
            p=np.concatenate([np.append(one.floor, one.cap) for one in limits]),
            lbx=low,
            ubx=high,
            lbg=nlp.low,
            ubg=rows_high,
            **(multipliers or _first_multipliers(nlp, low, high)),
        )
        stats = nlp.solver.stats()
        cost.iterations += stats["iter_count"]
        cost.solves += 1
        cost.solve_time += stats["t_wall_total"]
        worse = float(result["f"]) - solution.cost > _DEARER * abs(solution.cost)
        if multipliers and solution.success and (worse or not stats["success"]):
            # From where it was the solver can lose its way; from scratch it often does not.
            solution, multipliers = solution._replace(success=False), {}
            continue
        x = result["x"].full()[:, 0]
        multipliers = {f"{key}0": result[key].full()[:, 0] for key in ("lam_x", "lam_g")}
        margin = float(x[-1]) if with_margin else 0.0
        points = _split(stages, x)
        solution = _Solution(
            tuple(points), float(result["f"]), stats["return_status"], stats["success"]
        )
        if not solution.success:
            return solution
        more = _find_broken_limits(stages, points, scheme, start)
        if more is not None:
            stages, nlp, multipliers = more, None, {}
            continue
        motions = _make_stage_motions(stages, points, scheme, Start(*start))
        worst = 0.0
        for motion, one in zip(motions, limits, strict=True):
            worst = max(worst, one.tighten(problem, motion, margin))
        if worst <= MISS:
            return solution
    status = f"limits are still missed by {worst:.2g} N between points"
    return solution._replace(status=status, success=False)


def _first_multipliers(nlp: TimeNLP, low: Array, high: Array) -> dict[str, Array]:
    """Multipliers of one size for all inequalities."""
    bounded = np.isfinite(high).astype(float) - np.isfinite(low)
    return {"lam_x0": _MU * bounded, "lam_g0": np.where(nlp.high > nlp.low, -_MU, 0.0)}


def _split(stages: Sequence[Stage], x: Array) -> list[StagePoints]:
    points, position = [], 0
    for stage in stages:
        n_c = stage.formation.n_contacts
        size = 1 + (len(stage.z) - 1) * (17 + n_c)
        points.append(StagePoints.unpack(x[position : position + size], n_c))
        position += size
    return points


def _make_stage_motions(
    stages: Sequence[Stage], points: Sequence[StagePoints], scheme: Scheme, start: Start
) -> list[StageMotion]:
    motions = []
    for stage, part in zip(stages, points, strict=True):
        motions.append(StageMotion(stage.formation, stage.directions, scheme, start, part))
        start = Start(part.z[-1], part.v[-1])
    return motions


def _make_motions(
    stages: Sequence[Stage], points: Sequence[StagePoints], scheme: Scheme, start: Start
) -> dict[int, TimeMotion]:
    """Motion of each phase, by index."""
    parts = _make_stage_motions(stages, points, scheme, start)
    motions = {}
    for index in dict.fromkeys(stage.phase for stage in stages):
        mine = [part for part, stage in zip(parts, stages, strict=True) if stage.phase == index]
        motions[index] = TimeMotion(mine)
    return motions


def _find_broken_limits(
    stages: Sequence[Stage],
    points: Sequence[StagePoints],
    scheme: Scheme,
    start: tuple[Array, Array],
) -> list[Stage] | None:
    """Stages that also watch the limits which the solution breaks, or None if it breaks none."""
    changed, found = [], False
    rho = stages[0].formation.scene.polygon.gyration_radius
    for stage, part in zip(stages, points, strict=True):
        values = stage.formation.evaluate_limits(part.z)
        broken = set(np.flatnonzero(values.min(axis=0) < -1e-6 * rho).tolist())
        new = broken - set(stage.watched)
        found = found or bool(new)
        changed.append(replace(stage, watched=tuple(sorted({*stage.watched, *new}))))
    return changed if found else None


def _summarise(
    problem: Problem, motion: TimeMotion, options: PlanOptions, solution: _Solution
) -> PhasePlan[TimeMotion]:
    torque = motion.torque
    value = {
        Objective.TIME: motion.duration,
        Objective.EFFORT: options.time_weight * motion.duration + torque.integrate_squares(),
        Objective.MARGIN: problem.epsilon - solution.cost,
    }[options.goal]
    return PhasePlan(motion, torque, value, 0, 0, 0.0, 0.0)


def _explain(
    problem: Problem, phases: Sequence[Phase], stages: Sequence[Stage], solution: _Solution
) -> InfeasibleError | SolverError:
    """Say what the solver's last point misses, the worst first."""
    numbers = " and ".join(str(phase.number) for phase in phases)
    misses = []
    start = 0.0
    for stage, part in zip(stages, solution.points, strict=True):
        times = start + (np.arange(len(part.z)) + 1) / len(part.z) * part.duration
        start += part.duration
        names = [
            f"c_n of {name} >= epsilon = {problem.epsilon:g} N" for name in stage.formation.names
        ]
        names += [
            f"torque limit of finger {k + 1} = {finger.torque_limit:g} N m"
            for k, finger in enumerate(problem.scene.fingers)
        ]
        units = ["N"] * stage.formation.n_contacts + ["N m"] * 2
        over = np.abs(part.tau) - problem.scene.torque_limit
        short = np.hstack([problem.epsilon - part.c_n, over])
        for row, name in enumerate(names):
            worst = int(short[:, row].argmax())
            if short[worst, row] > 1e-4:
                misses.append(
                    (
                        float(short[worst, row]),
                        f"{name} is {short[worst, row]:.3g} {units[row]} short at "
                        f"t = {times[worst]:.4f} s, phase {stage.phase + 1}",
                    )
                )
    stopped = f"no plan for phases {numbers}: Ipopt stopped with {solution.status}"
    if not misses:
        return SolverError(f"{stopped}; try other time_intervals")
    ranked = "; ".join(text for _, text in sorted(misses, reverse=True))
    return InfeasibleError(f"{stopped}; at its last point {ranked}")
