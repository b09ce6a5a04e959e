"""Planning phases in the time domain: stages, first guess, NLP, and limits between points.

Phases that pass smoothly into one another are one NLP. It starts from the phases' outlines, with
the directions of friction that these have. Where the solution would rather slide the other way (a
sense of friction is active over a stretch), the stage is split and the NLP solved again. Limits are
looked at between points and tightened there by what they miss.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from .collocation import Scheme, radau
from .dynamics import Directions
from .errors import InfeasibleError, SolverError
from .formation import Formation
from .model import Array
from .options import Objective, PlanOptions
from .outline import Outline, outline_phase
from .phaseplan import PhasePlan
from .problem import End, Phase, Problem
from .timemotion import StageMotion, Start, TimeMotion
from .timenlp import SLIDING, Stage, StagePoints, TimeNLP, bound_unknowns, build_time_nlp

MISS = 5e-7
"""Largest miss of a limit between points [N or N m]."""
ROUNDS = 12
"""Most times that limits are tightened."""
REVISIONS = 2
"""Most times that directions of friction are revised."""
LOOKS = 12
"""Places per interval at which limits are looked at."""
_OVER = 1.5
"""How much more than the miss a limit is tightened."""
_ITERATIONS = 150
"""Most iterations of Ipopt for one solve."""
_PACES = (2.0, 4.0, 1.0, 8.0)
"""Guessed durations to try, in units of that of a fall."""
_TRIAL = 80
"""The same when other directions of friction are tried."""
_MU = 1e-2
"""Multipliers of the first guess."""
_STALLED = 1e-6
"""Rate over the largest one at which a direction of friction counts as held back."""
_LEAST_INTERVALS = 3


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
    plans = [_summarise(motion, options, best) for motion in motions.values()]
    plans[0] = plans[0]._replace(
        iterations=cost.iterations,
        solves=cost.solves,
        build_time=cost.build_time,
        solve_time=cost.solve_time,
    )
    return plans


def outline_stages(
    problem: Problem,
    phases: Sequence[Phase],
    z: Array,
    scheme: Scheme,
    intervals: int,
    pace: float,
) -> list[Stage]:
    """Stages of phases that are joined smoothly, with a first guess.

    The guessed duration is `pace` times that of a fall over the length of the outlines.
    """
    parts: list[tuple[Phase, Outline, bool]] = []
    for phase in phases:
        outlines = outline_phase(problem, phase, z)
        if parts:
            outlines = [*_turn_first(outlines[0], parts[-1][1]), *outlines[1:]]
        parts += [(phase, outline, outline is outlines[-1]) for outline in outlines]
        z = outlines[-1].z[-1]
    lengths = np.array([outline.length for _, outline, _ in parts])
    gravity = problem.scene.gravity or 9.81
    total = pace * float(np.sqrt(lengths.sum() / gravity))
    ends = np.concatenate([[0.0], np.cumsum(lengths)]) / lengths.sum()
    # The guess runs as (1 - cos) over all stages, so each has its own share of the time.
    clock = np.arccos(1 - 2 * np.clip(ends, 0.0, 1.0)) / np.pi
    longest = {phase.index: lengths[[p is phase for p, _, _ in parts]].sum() for phase in phases}
    stages: list[Stage] = []
    for k, (phase, outline, last) in enumerate(parts):
        share = lengths[k] / longest[phase.index]
        count = max(_LEAST_INTERVALS, round(share * intervals))
        inner = (np.arange(count)[:, None] + scheme.points).ravel() / count
        times = clock[k] + np.append(0.0, inner) * (clock[k + 1] - clock[k])
        place = ((1 - np.cos(np.pi * times)) / 2 - ends[k]) / max(ends[k + 1] - ends[k], 1e-12)
        knots = np.linspace(0.0, 1.0, len(outline.z))
        guess = np.column_stack([np.interp(place, knots, column) for column in outline.z.T])
        stages.append(
            Stage(
                phase.index,
                phase.formation,
                outline.directions,
                guess,
                total * float(clock[k + 1] - clock[k]),
                until=phase.until if last and not phase.until.is_release else None,
                turns=outline.turns,
                gained=_gains(problem, phase) if last else None,
                watched=_choose_watched(phase, outline),
                follows=k > 0 and parts[k - 1][0] is not phase,
            )
        )
    return stages


def _turn_first(outline: Outline, before: Outline) -> list[Outline]:
    """Split an outline so that it starts with the directions of the one that it goes on from.

    Velocities are continuous, so what slides the other way in the outline has to turn on the way.
    """
    names = before.formation.names
    known = dict(zip(names, before.directions.Xi, strict=True))
    own = np.concatenate(outline.directions)
    n_c = outline.formation.n_contacts
    signs = own.copy()
    signs[n_c:] = before.directions.sigma
    for k, name in enumerate(outline.formation.names):
        signs[k] = known.get(name, signs[k])
    turns = np.flatnonzero(signs != own).tolist()
    pieces = []
    cuts = np.linspace(0, len(outline.z) - 1, len(turns) + 2).astype(int)
    for k, (begin, stop) in enumerate(pairwise(cuts)):
        turn = (turns[k],) if k < len(turns) else outline.turns
        directions = Directions(signs[:n_c].copy(), signs[n_c:].copy())
        z = outline.z[begin : stop + 1]
        pieces.append(replace(outline, z=z, directions=directions, turns=turn))
        if k < len(turns):
            signs[turns[k]] = own[turns[k]]
    return pieces


def _gains(problem: Problem, phase: Phase) -> Formation | None:
    """The next phase's formation, if this phase gains a contact of it softly."""
    if phase.end is End.REST or phase.until.contact is None:
        return None
    return problem.phases[phase.index + 1].formation


def _choose_watched(phase: Phase, outline: Outline) -> tuple[int, ...]:
    """Limits that are near zero along the outline but for the phase's own end."""
    values = outline.formation.evaluate_limits(outline.z)
    near = values.min(axis=0) < 0.02 * outline.formation.scene.polygon.gyration_radius
    gained = [limit.gained == phase.until.contact for limit in outline.formation.limits]
    mine = np.array(gained) & (phase.until.contact is not None)
    return tuple(np.flatnonzero(near | mine).tolist())


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
        if not stats["success"] and solution.success and multipliers:
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
    return solution._replace(status=f"limits are still missed by {worst:.2g} N between points")


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


def revise(
    stages: Sequence[Stage], points: Sequence[StagePoints], scheme: Scheme
) -> list[Stage] | None:
    """Stages with a direction of friction turned where the solution holds it back, or None."""
    for k, (stage, part) in enumerate(zip(stages, points, strict=True)):
        kinematics = stage.formation.evaluate(part.z, part.v)
        slip = np.einsum("nij,nj->ni", kinematics.A_t, part.v)
        rho = stage.formation.scene.polygon.gyration_radius
        signs = np.concatenate(stage.directions)
        senses = np.hstack([slip / rho, part.v[:, 3:]]) * signs
        fast = np.abs(part.v[:, 2:]).max()
        held = senses < 1.01 * SLIDING + _STALLED * fast
        held &= (np.abs(senses).max(axis=1) > 1e-3 * fast)[:, None]
        # What turns at an end of the stage has both its directions already.
        turning = set(stage.turns) | (set(stages[k - 1].turns) if k else set())
        held[:, sorted(turning)] = False
        runs = [(_longest_run(column), row) for row, column in enumerate(held.T)]
        (first, last), row = max(runs, key=lambda run: run[0][1] - run[0][0])
        if last - first < scheme.degree:
            continue
        turned = signs.copy()
        turned[row] *= -1
        other = Directions(turned[: len(signs) - 2], turned[len(signs) - 2 :])
        cuts = [0, first // scheme.degree, -(-last // scheme.degree), len(part.z) // scheme.degree]
        pieces: list[Stage] = []
        for piece in range(3):
            begin, stop = cuts[piece], cuts[piece + 1]
            if stop <= begin:
                continue
            known = _cut(part, stage.z[0], begin, stop, scheme)
            pieces.append(
                replace(
                    stage,
                    directions=other if piece == 1 else stage.directions,
                    z=np.vstack([known[0], known[1].z]),
                    duration=known[1].duration,
                    until=None,
                    gained=None,
                    turns=(row,),
                    follows=stage.follows and not pieces,
                    known=known[1],
                )
            )
        pieces[-1] = replace(pieces[-1], until=stage.until, gained=stage.gained, turns=stage.turns)
        return [*stages[:k], *pieces, *stages[k + 1 :]]
    return None


def _longest_run(flags: Array) -> tuple[int, int]:
    """First and past-the-last index of the longest run of True."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], flags.astype(int), [0]])))
    starts, stops = edges[::2], edges[1::2]
    if not len(starts):
        return 0, 0
    best = int((stops - starts).argmax())
    return int(starts[best]), int(stops[best])


def _cut(
    part: StagePoints, first: Array, begin: int, stop: int, scheme: Scheme
) -> tuple[Array, StagePoints]:
    """A solution from interval `begin` to `stop`, on at least the least number of intervals.

    Returns z at its start and the points.
    """
    count = max(_LEAST_INTERVALS, stop - begin)
    total = len(part.z) // scheme.degree
    given = np.append(0.0, (np.arange(total)[:, None] + scheme.points).ravel())
    wanted = begin + (np.arange(count)[:, None] + scheme.points).ravel() * (stop - begin) / count
    z = np.vstack([first, part.z])

    def pick(table: Array) -> Array:
        table = table if len(table) == len(given) else np.vstack([table[:1], table])
        return np.column_stack([np.interp(wanted, given, column) for column in table.T])

    start = np.array([np.interp(begin, given, column) for column in z.T])
    duration = part.duration * (stop - begin) / total
    tables = (part.v, part.a, part.c_n, part.tau)
    return start, StagePoints(duration, pick(z), *(pick(table) for table in tables))


def _summarise(
    motion: TimeMotion, options: PlanOptions, solution: _Solution
) -> PhasePlan[TimeMotion]:
    torque = motion.torque
    value = {
        Objective.TIME: motion.duration,
        Objective.EFFORT: options.time_weight * motion.duration + torque.integrate_squares(),
        Objective.MARGIN: -solution.cost,
    }[options.goal]
    return PhasePlan(motion, torque, value, 0, 0, 0.0, 0.0)


def _explain(
    problem: Problem, phases: Sequence[Phase], stages: Sequence[Stage], solution: _Solution
) -> InfeasibleError | SolverError:
    numbers = ", ".join(str(phase.number) for phase in phases)
    return SolverError(f"phases {numbers}: Ipopt stopped with {solution.status}")
