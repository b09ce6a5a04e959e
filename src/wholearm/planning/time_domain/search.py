"""Solving for stages: one NLP after another, until limits hold between points too."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...common.arrays import Array
from ...common.shortfalls import Parameter
from ...geometry.cost_to_go import CostToGo
from ...problem.definition import Problem
from ..options import Objective, PlanOptions
from ..phase_plan import Tried
from .between import Limits, check_between, find_misses, monitor_missed, raise_bounds
from .collocation import Scheme, make_scheme
from .layout import MARGIN, pack, unpack
from .limits import Target, price_sides
from .motion import StageMotion, make_motions
from .nlp import TimeNLP, bound_unknowns, build_time_nlp
from .own_units import in_own_units, scale_options, unit_lengths, unit_of
from .refinement import (
    adopt,
    bisect_intervals,
    cap_halvings,
    count_halvings,
    monitor_violated,
    settle,
)
from .stage import Stage
from .warm_start import FIRST_SIZE, Multipliers, carry_multipliers, first_multipliers

ROUNDS = 24
"""Most times that limits are tightened."""
REFINEMENTS = 8
"""Most times that intervals are halved because of misses."""
MOST = 64
"""Intervals of each phase from which on none is halved."""
_PATIENCE = 80
"""Most iterations of one solve on finer intervals, that starts from a solution."""
_ITERATIONS = {Objective.ELASTIC: 90, Objective.RELAX: 90}
"""Most iterations of one solve, if not 150."""
_CAP = 1.1
"""Largest margin that is looked for, over the one from which on more decides nothing."""
_DEARER = 0.2
"""Largest relative cost increase accepted from tightening."""
_COARSE = 0.1
"""Largest relative cost increase accepted from finer intervals."""


class Price(NamedTuple):
    """What the end of stages costs: `gradient` @ (z - `origin`), both of shape (5,)."""

    gradient: Array
    origin: Array


class Solution(NamedTuple):
    """Stages with what the solver found as their guess.

    Attributes
    ----------
    stages : list of Stage
    cost : float
        Objective.
    margin : float
        Least c_n over epsilon, if that is an unknown.
    status : str
        How it ended, in words.
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
    def end(self) -> Array:
        """Where the stages end, shape (5,)."""
        return np.asarray(self.stages[-1].guess.nodes[-1, 0])

    def price_friction(self, k: int) -> Array:
        """What friction at full strength the other way would save to first order, (K, d, n_c).

        Of each contact of stage `k`, at every point; for one that its sense holds back, this bounds
        what it saves to let it roll.
        """
        stage = self.stages[k]
        formation, part = stage.formation, stage.guess
        A_t = formation.evaluate(part.z.reshape(-1, 5), part.v.reshape(-1, 5)).A_t
        pull = self.multipliers["lam_g0"][self.nlp.rows_of[k].balance].reshape(-1, 5)
        c_n = part.forces[..., : formation.n_contacts]
        price = np.einsum("nij,nj->ni", A_t, pull).reshape(c_n.shape)
        return np.asarray(2 * price * stage.directions.Xi * formation.friction * c_n)

    @property
    def is_lost(self) -> bool:
        """Whether it was one on coarse intervals, and did not hold on finer ones."""
        return not self.success and not self.status.startswith("Ipopt")

    @property
    def monitored(self) -> list[tuple[int, ...]]:
        """Limits that each stage monitors."""
        return [stage.monitored for stage in self.stages]


@dataclass
class Search:
    """A search for a plan: what stays the same from solve to solve, and what it has cost.

    It works in the scene's own units.

    Attributes
    ----------
    problem : Problem
    options : PlanOptions
    scheme : Scheme
    duration : float or None
        Longest duration, for the objective `margin`.
    goal : Objective
    relaxation : Parameter or None
        What gives way, for the objective `relax`.
    to_go : callable or None
        What follows costs from where stages end, and its gradient, each by the objective.
    price : Price or None
    ample : float
        Least normal force from which on more decides nothing, for the objective `margin`.
    tried : Tried
        Shared by all searches for one plan.
    """

    problem: Problem
    options: PlanOptions
    scheme: Scheme
    duration: float | None
    goal: Objective
    relaxation: Parameter | None = None
    to_go: Callable[[Array], tuple[float, Array]] | None = None
    price: Price | None = None
    ample: float = math.inf
    tried: Tried = field(default_factory=Tried)

    @staticmethod
    def of(
        problem: Problem,
        options: PlanOptions,
        duration: float | None = None,
        to_go: CostToGo | None = None,
        ample: float = math.inf,
    ) -> Search:
        """A search for what `plan_phases` is given, in SI units."""
        scales = problem.scene.scales
        lengths, unit = unit_lengths(scales), unit_of(options.goal, scales)

        def expand(z: Array) -> tuple[float, Array]:
            assert to_go is not None
            value, gradient = to_go.expand(z * lengths)
            return value / unit, gradient * lengths / unit

        return Search(
            in_own_units(problem),
            scale_options(options, scales),
            make_scheme(options.scheme, options.degree),
            None if duration is None else duration / scales.time,
            options.goal,
            to_go=expand if to_go else None,
            ample=ample / scales.force,
        )

    def aiming(self, goal: Objective, relaxation: Parameter | None = None) -> Search:
        """The same search with another objective."""
        return replace(
            self, goal=goal, relaxation=relaxation, duration=None, to_go=None, price=None
        )

    def charge(self, z: Array) -> float:
        """What it costs to end at `z`, shape (5,)."""
        return float(self.price.gradient @ (z - self.price.origin)) if self.price else 0.0

    def has_ample(self, solution: Solution) -> bool:
        """Whether c_n is as large as another phase allows anyway, for the objective `margin`."""
        return self.goal is Objective.MARGIN and solution.margin > self.most_margin

    @property
    def most_margin(self) -> float:
        """What c_n has over epsilon where it is ample."""
        return self.ample - self.problem.epsilon

    def solve(
        self,
        stages: list[Stage],
        before: Solution | None = None,
        most: int = 150,
    ) -> Solution:
        """Solve from the stages' guesses, until no limit is broken at the points.

        Parameters
        ----------
        most : int
            Most iterations.
        """
        while True:
            nlp = self.build(stages, most)
            multipliers = None
            if before is not None and before.monitored == [stage.monitored for stage in stages]:
                multipliers = carry_multipliers(
                    before.multipliers, before.nlp, nlp, self.scheme, before.stages, stages
                )
            plain = [Limits.none(stage) for stage in stages]
            margin = before.margin if before else 0.0
            solution = self.run(nlp, stages, plain, multipliers, margin)
            monitoring = monitor_violated(solution.stages) if solution.success else None
            if monitoring is None:
                return solution
            stages = monitoring

    def build(self, stages: Sequence[Stage], most: int = 150) -> TimeNLP:
        """Build the NLP."""
        gradient = self.price.gradient if self.price else None
        target = Target(
            self.goal, self.problem.epsilon, self.options.time_weight, self.relaxation, gradient
        )
        most = _ITERATIONS.get(self.goal, most)
        return build_time_nlp(stages, self.scheme, target, most)

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
        low_g, high_g = raise_bounds(nlp, stages, limits, (low, high))
        if self.duration is not None and nlp.duration_row >= 0:
            high_g[nlp.duration_row] = self.duration
        if self.goal is Objective.MARGIN:
            # Beyond what is ample there is nothing to look for, and it takes long.
            high[nlp.layouts[-1].nodes[-1, MARGIN]] = _CAP * self.most_margin
        if (low > high).any():
            status = "limits that hold between points too leave nothing"
            return Solution(list(stages), np.inf, 0.0, status, False, nlp, {})
        solver = nlp.first_solver if multipliers is None else nlp.solver
        result = solver(
            x0=pack([stage.guess for stage in stages], nlp.layouts, margin),
            lbx=low,
            ubx=high,
            lbg=low_g,
            ubg=high_g,
            **(multipliers or first_multipliers((low, high), (low_g, high_g), FIRST_SIZE)),
        )
        stats = solver.stats()
        self.tried.iterations += stats["iter_count"]
        x, cost = result["x"].full()[:, 0], float(result["f"])
        cost -= float(self.price.gradient @ self.price.origin) if self.price else 0.0
        return Solution(
            adopt(stages, unpack(x, nlp.layouts)),
            cost,
            -cost if self.goal is Objective.MARGIN else 0.0,
            f"Ipopt stopped with {stats['return_status']}",
            stats["success"],
            nlp,
            {f"{key}0": result[key].full()[:, 0] for key in ("lam_x", "lam_g")},
        )

    def price_misses(self, solution: Solution, misses: Sequence[Limits]) -> list[Array]:
        """What raising limits by their misses would cost in each interval, over the cost, (K,)."""
        on_x, on_g = (np.abs(solution.multipliers[key]) for key in ("lam_x0", "lam_g0"))
        prices = []
        for k, miss in enumerate(misses):
            layout, rows = solution.nlp.layouts[k], solution.nlp.rows_of[k].limits
            price = price_sides(rows, layout, on_x, on_g)
            spans = rows.limits.scales[rows.limits.sides[0]]
            cost = (price * miss.held * spans).sum(axis=1)
            prices.append(np.asarray(cost / max(abs(solution.cost), 1e-300)))
        return prices

    def _choose_halvings(
        self, solution: Solution, motions: Sequence[StageMotion], misses: Sequence[Limits]
    ) -> list[NDArray[np.int64]]:
        """How often to halve each interval for what its misses cost; none if there are many."""
        most = MOST * len({stage.phase for stage in solution.stages})
        if sum(stage.intervals for stage in solution.stages) >= most:
            return []
        prices = self.price_misses(solution, misses)
        times = [
            count_halvings(price, motion.defects, self.scheme)
            for price, motion in zip(prices, motions, strict=True)
        ]
        return cap_halvings(times, most)

    def enforce_between(self, solution: Solution) -> Solution:
        """Go on from a solution until limits hold between points too."""
        refined, first = 0, solution.cost
        limits = [Limits.none(stage) for stage in solution.stages]
        for _ in range(ROUNDS):
            motions = make_motions(solution.stages, self.scheme)
            checks = [
                check_between(stage, motion)
                for stage, motion in zip(solution.stages, motions, strict=True)
            ]
            monitoring = monitor_missed(solution.stages, checks)
            if monitoring is not None:
                solution = self.solve(monitoring, solution)
                if not solution.success:
                    return solution
                limits = [Limits.none(stage) for stage in solution.stages]
                continue
            misses = [
                find_misses(stage, check, self.problem.epsilon, solution.margin)
                for stage, check in zip(solution.stages, checks, strict=True)
            ]
            worst = max(miss.worst for miss in misses)
            halved = refined < REFINEMENTS
            times = self._choose_halvings(solution, motions, misses) if halved else []
            if any(mine.any() for mine in times):
                refined += 1
                finer = self.solve(
                    bisect_intervals(solution.stages, self.scheme, times), solution, most=_PATIENCE
                )
                if finer.success:
                    if finer.cost - first > _COARSE * abs(first):
                        status = "a plan on finer intervals is much dearer"
                        return finer._replace(status=status, success=False)
                    solution = finer
                    limits = [Limits.none(stage) for stage in solution.stages]
                    continue
                # What finer intervals do not lead to now they will not lead to later.
                refined = REFINEMENTS
            if any(stage.adapts for stage in solution.stages):
                solution = self.solve(settle(solution.stages), solution)
                if not solution.success:
                    return solution
                continue
            if worst <= 1:
                return solution
            limits = [raised.raised(miss) for raised, miss in zip(limits, misses, strict=True)]
            tighter = self.run(
                solution.nlp, solution.stages, limits, solution.multipliers, solution.margin
            )
            if not tighter.success:
                tighter = self._halve_missed(solution, misses)
                limits = [Limits.none(stage) for stage in tighter.stages]
            if not tighter.success:
                return tighter
            if tighter.cost - solution.cost > _DEARER * abs(solution.cost):
                status = "a plan that keeps limits between points is much dearer"
                return tighter._replace(status=status, success=False)
            solution = tighter
        status = f"limits are still missed {worst:.2g} times what is allowed between points"
        return solution._replace(status=status, success=False)

    def _halve_missed(self, solution: Solution, misses: Sequence[Limits]) -> Solution:
        """Go on from a plan with twice the intervals where it misses limits, which then is less."""
        times = [miss.list_missed().astype(np.int64) for miss in misses]
        return self.solve(bisect_intervals(solution.stages, self.scheme, times), solution)
