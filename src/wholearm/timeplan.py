"""Planning phases in the time domain: stages, first guess, NLP, and limits between points.

Phases that pass into one another in motion are one NLP. It starts from the phases' outlines, with
the directions of friction that these have, on few intervals; these are then halved, each time
starting from the solution before. Where the solution would rather slide the other way (a sense of
friction is at its least over a stretch), the stage is split and the NLP solved again. Limits are
looked at between points: intervals that miss them by much are halved, and what is then left is
added to the limits.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from .between import Limits, find_misses, raise_bounds
from .collocation import Scheme, make_scheme
from .errors import InfeasibleError, SolverError
from .model import Array
from .options import Objective, PlanOptions
from .phaseplan import PhasePlan
from .problem import Phase, Problem
from .revising import adopt, halve, turn_friction, watch_broken
from .stage import Stage
from .staging import outline_stages
from .timelayout import pack, unpack
from .timemotion import StageMotion, TimeMotion
from .timenlp import TimeNLP, bound_unknowns, build_time_nlp
from .warmstart import Multipliers, carry_multipliers, first_multipliers

ROUNDS = 12
"""Most times that limits are tightened."""
REFINEMENTS = 1
"""Most times that intervals are halved because of misses."""
REVISIONS = 2
"""Most times that directions of friction are revised."""
FIRST = 8
"""Most intervals of a phase to start with."""
_ITERATIONS = 150
"""Most iterations of one solve."""
_PACES = (2.0, 4.0, 1.0, 8.0)
"""Guessed durations to try, in units of that of a fall."""
_DEARER = 0.01
"""How much dearer, relatively, a plan may get by tightening before it is solved from scratch."""


@dataclass
class Effort:
    """What solving has cost so far."""

    iterations: int = 0
    solves: int = 0
    build_time: float = 0.0
    solve_time: float = 0.0


class Solution(NamedTuple):
    """Stages with what the solver found as their guess.

    Attributes
    ----------
    stages : list of Stage
    cost : float
        Objective.
    margin : float, [N]
        Least c_n over epsilon, if that is an unknown.
    status : str
        The solver's word for how it ended.
    success : bool
    nlp : TimeNLP
        What was solved.
    multipliers : dict
        What it ended with.
    """

    stages: list[Stage]
    cost: float
    margin: float
    status: str
    success: bool
    nlp: TimeNLP
    multipliers: Multipliers

    @property
    def watched(self) -> list[tuple[int, ...]]:
        """Limits that each stage watches."""
        return [stage.watched for stage in self.stages]


@dataclass
class _Search:
    """A search for a plan: what stays the same from solve to solve, and what it has cost."""

    problem: Problem
    options: PlanOptions
    scheme: Scheme
    duration: float | None
    effort: Effort = field(default_factory=Effort)

    @property
    def with_margin(self) -> bool:
        return self.options.goal is Objective.MARGIN

    def solve(self, stages: list[Stage], before: Solution | None = None) -> Solution:
        """Solve from the stages' guesses, until no limit is broken at the points."""
        while True:
            nlp = self.build(stages)
            multipliers = None
            if before is not None and before.watched == [stage.watched for stage in stages]:
                multipliers = carry_multipliers(
                    before.multipliers, before.nlp, nlp, before.stages, stages
                )
            plain = [Limits.none(stage) for stage in stages]
            margin = before.margin if before else 0.0
            solution = self.run(nlp, stages, plain, multipliers, margin)
            watching = watch_broken(solution.stages) if solution.success else None
            if watching is None:
                return solution
            stages = watching

    def build(self, stages: Sequence[Stage]) -> TimeNLP:
        """Build the NLP."""
        options = self.options
        nlp = build_time_nlp(stages, self.scheme, options.goal, options.time_weight, _ITERATIONS)
        self.effort.build_time += nlp.build_time
        return nlp

    def run(
        self,
        nlp: TimeNLP,
        stages: Sequence[Stage],
        limits: Sequence[Limits],
        multipliers: Multipliers | None,
        margin: float,
    ) -> Solution:
        """Run the solver once."""
        low, high = bound_unknowns(nlp, stages, self.scheme)
        low_g, high_g = raise_bounds(nlp, stages, limits, self.problem.epsilon, low)
        if self.duration is not None and nlp.lasts >= 0:
            high_g[nlp.lasts] = self.duration
        result = nlp.solver(
            x0=pack([stage.guess for stage in stages], nlp.layouts, margin),
            lbx=low,
            ubx=high,
            lbg=low_g,
            ubg=high_g,
            **(multipliers or first_multipliers((low, high), (low_g, high_g))),
        )
        stats = nlp.solver.stats()
        self.effort.iterations += stats["iter_count"]
        self.effort.solves += 1
        self.effort.solve_time += stats["t_wall_total"]
        x, cost = result["x"].full()[:, 0], float(result["f"])
        return Solution(
            adopt(stages, unpack(stages, x, nlp.layouts)),
            cost,
            -cost if self.with_margin else 0.0,
            stats["return_status"],
            stats["success"],
            nlp,
            {f"{key}0": result[key].full()[:, 0] for key in ("lam_x", "lam_g")},
        )

    def hold(self, solution: Solution) -> Solution:
        """Go on from a solution until limits hold between points too."""
        refined = 0
        limits = [Limits.none(stage) for stage in solution.stages]
        for _ in range(ROUNDS):
            motions = make_motions(solution.stages, self.scheme)
            misses = [
                find_misses(stage, motion, self.problem.epsilon, solution.margin)
                for stage, motion in zip(solution.stages, motions, strict=True)
            ]
            worst = max(miss.worst for miss in misses)
            if worst <= 1:
                return solution
            marked = [miss.coarse for miss in misses]
            if refined < REFINEMENTS and any(mine.any() for mine in marked):
                refined += 1
                finer = self.solve(halve(solution.stages, self.scheme, marked), solution)
                if finer.success:
                    solution = finer
                    limits = [Limits.none(stage) for stage in solution.stages]
                    continue
            limits = [raised.raised(miss) for raised, miss in zip(limits, misses, strict=True)]
            tighter = self.run(
                solution.nlp, solution.stages, limits, solution.multipliers, solution.margin
            )
            dearer = tighter.cost - solution.cost > _DEARER * abs(solution.cost)
            if not tighter.success or dearer:
                return tighter._replace(success=False)
            solution = tighter
        status = f"limits are still missed {worst:.2g} times what is allowed between points"
        return solution._replace(status=status, success=False)


def plan_phases(
    problem: Problem,
    phases: Sequence[Phase],
    z: Array,
    options: PlanOptions,
    duration: float | None = None,
) -> list[PhasePlan[TimeMotion]]:
    """Plan phases that are one NLP, from rest at `z` to rest.

    Parameters
    ----------
    problem : Problem
    phases : sequence of Phase
        All but the last one end in motion.
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
    scheme = make_scheme(options.scheme, options.degree)
    search = _Search(problem, options, scheme, duration)
    solution = _search(search, phases, z)
    if not solution.success:
        raise _explain(problem, phases, solution)
    motions = make_motions(solution.stages, scheme)
    plans = []
    for phase in phases:
        own = [m for m, s in zip(motions, solution.stages, strict=True) if s.phase == phase.index]
        plans.append(_summarise(problem, TimeMotion(own), options, solution))
    effort = search.effort
    plans[0] = plans[0]._replace(
        iterations=effort.iterations,
        solves=effort.solves,
        build_time=effort.build_time,
        solve_time=effort.solve_time,
    )
    return plans


def _search(search: _Search, phases: Sequence[Phase], z: Array) -> Solution:
    """Try guesses and numbers of intervals until a solution holds."""
    wanted = search.options.time_intervals or _choose_intervals(phases)
    halvings = max(0, math.ceil(math.log2(wanted / FIRST)))
    failed: Solution | None = None
    for times in dict.fromkeys((halvings, 0)):
        for pace in _PACES:
            first = math.ceil(wanted / 2**times)
            stages = outline_stages(search.problem, phases, z, search.scheme, first, pace)
            solution = search.solve(stages)
            if solution.success:
                solution = _improve(search, solution, times)
            if solution.success:
                return solution
            failed = failed or solution
    assert failed is not None
    return failed


def _choose_intervals(phases: Sequence[Phase]) -> int:
    """Intervals of each phase: a phase with one freedom has fewer unknowns in each."""
    return 32 if len(phases) == 1 and phases[0].formation.n_constraints == 4 else 16


def _improve(search: _Search, solution: Solution, halvings: int) -> Solution:
    """Revise friction, halve all intervals, and make limits hold in between."""
    for _ in range(REVISIONS):
        turned = turn_friction(solution.stages, search.scheme)
        other = search.solve(turned) if turned is not None else None
        if other is None or not other.success or not other.cost < solution.cost:
            break
        solution = other
    for _ in range(halvings):
        if not solution.success:
            return solution
        every = [np.ones(stage.intervals, dtype=bool) for stage in solution.stages]
        solution = search.solve(halve(solution.stages, search.scheme, every), solution)
    return search.hold(solution) if solution.success else solution


def make_motions(stages: Sequence[Stage], scheme: Scheme) -> list[StageMotion]:
    """The stages' guesses as functions of time."""
    motions = []
    slip, phase = np.zeros(0), -1
    for stage in stages:
        if stage.phase != phase:
            slip, phase = stage.formation.evaluate_slip(stage.guess.nodes[0, :1])[0], stage.phase
        motions.append(StageMotion(stage.formation, stage.directions, scheme, stage.guess, slip))
    return motions


def _summarise(
    problem: Problem, motion: TimeMotion, options: PlanOptions, solution: Solution
) -> PhasePlan[TimeMotion]:
    torque = motion.torque
    value = {
        Objective.TIME: motion.duration,
        Objective.EFFORT: options.time_weight * motion.duration + torque.integrate_squares(),
        Objective.MARGIN: problem.epsilon + solution.margin,
    }[options.goal]
    return PhasePlan(motion, torque, value, 0, 0, 0.0, 0.0)


def _explain(
    problem: Problem, phases: Sequence[Phase], solution: Solution
) -> InfeasibleError | SolverError:
    numbers = " and ".join(str(phase.number) for phase in phases)
    return SolverError(f"no plan for phases {numbers}: {solution.status}")
