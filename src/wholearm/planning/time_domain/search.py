"""Solution of the time-domain NLP of stages by Ipopt, with warm starts on refined intervals."""

from __future__ import annotations

import math
import operator
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np

from ...common.arrays import Array
from ...common.errors import Parameter
from ...geometry.arcs import CostToGo
from ...problem.definition import Problem
from ..options import Objective, PlanOptions
from .stage import (
    LimitMisses,
    Scheme,
    Stage,
    in_own_units,
    make_scheme,
    monitor,
    scale_options,
    unit_lengths,
    unit_of,
    with_controls,
)
from .time_nlp import (
    MARGIN,
    Target,
    TimeNLP,
    build_time_nlp,
    find_bounds,
    pack,
    unpack,
)

FIRST_SIZE = 1e-2  # multipliers of a first guess
Multipliers = dict[str, Array]  # of the unknowns' bounds, `lam_x0`, and of the rows, `lam_g0`
_ITERATIONS = {Objective.ELASTIC: 90, Objective.RELAX: 50}  # most of one solve, else 150


@dataclass
class Tried:
    """Statistics of a mode search."""

    sequences: int = 1  # of modes that were tried
    complete: bool = True  # whether none was left


class Price(NamedTuple):
    """Linear cost of the end of stages: `gradient` @ (z - `origin`), both of shape (5,)."""

    gradient: Array
    origin: Array


class TimeSolution(NamedTuple):
    """Stages with the solution as their guess."""

    stages: list[Stage]
    cost: float  # objective
    margin: float  # least c_n over epsilon, if that is an unknown
    status: str  # how the solver ended, in words
    success: bool
    nlp: TimeNLP
    multipliers: Multipliers
    error: float = math.nan  # estimated gain of better torques, over the cost; not always known
    free: TimeSolution | None = None  # with free torques, where they are held over control periods

    @property
    def end(self) -> Array:
        """Where the stages end, shape (5,)."""
        return np.asarray(self.stages[-1].guess.nodes[-1, 0])

    def price_friction(self, k: int) -> Array:
        """First-order saving by full friction the other way at the points of a stage, (K, d, n_c).

        For a contact held at its least rate this bounds what rolling saves.
        """
        stage = self.stages[k]
        formation, part = stage.formation, stage.guess
        A_t = formation.evaluate(part.z.reshape(-1, 5), part.v.reshape(-1, 5)).A_t
        lam = self.multipliers["lam_g0"][self.nlp.rows_of[k].balance].reshape(-1, 5)
        c_n = part.forces[..., : formation.n_contacts]
        price = np.einsum("nij,nj->ni", A_t, lam).reshape(c_n.shape)
        return np.asarray(2 * price * stage.directions.Xi * formation.friction * c_n)


@dataclass
class TimeSearch:
    """Data common to all solves for a plan, in the scene's own units, and their statistics."""

    problem: Problem
    options: PlanOptions
    scheme: Scheme
    duration: float | None  # longest duration, for the objective `margin`
    goal: Objective
    relaxation: Parameter | None = None  # the relaxed limit, for the objective `relax`
    to_go: Callable[[Array], tuple[float, Array]] | None = None  # cost-to-go and its gradient at z
    price: Price | None = None
    ample: float = math.inf  # normal force at which the objective `margin` saturates
    only_begins: bool = False  # whether plans may miss limits between points
    tried: Tried = field(default_factory=Tried)  # shared by all searches for one plan

    @staticmethod
    def of(
        problem: Problem,
        options: PlanOptions,
        duration: float | None = None,
        to_go: CostToGo | None = None,
        ample: float = math.inf,
        only_begins: bool = False,
    ) -> TimeSearch:
        """A search with the arguments of `plan_phases`, in SI units."""
        scales = problem.scene.scales
        lengths, unit = unit_lengths(scales), unit_of(options.goal, scales)

        def expand(z: Array) -> tuple[float, Array]:
            assert to_go is not None
            value, gradient = to_go.expand(z * lengths)
            return value / unit, gradient * lengths / unit

        return TimeSearch(
            in_own_units(problem),
            scale_options(options, scales),
            make_scheme(options.scheme, options.degree, options.degree),
            None if duration is None else duration / scales.time,
            options.goal,
            to_go=expand if to_go else None,
            ample=ample / scales.force,
            only_begins=only_begins,
        )

    def aiming(self, goal: Objective, relaxation: Parameter | None = None) -> TimeSearch:
        """The same search with another objective.

        Soft limits go with linear torques: others might keep them at the points alone.
        """
        name, degree = self.scheme.name, self.scheme.degree
        linear = goal in (Objective.ELASTIC, Objective.RELAX)
        scheme = make_scheme(name, degree, 2 if linear else degree)
        other = replace(self, duration=None, to_go=None, price=None)
        return replace(other, goal=goal, relaxation=relaxation, scheme=scheme)

    def wait(self, iterations: int) -> int:
        """Most solver iterations: more with rate-limited torques."""
        return iterations * (2 if self.problem.scene.has_slow_motors else 1)

    def charge(self, z: Array) -> float:
        """Price of an end at `z`, shape (5,)."""
        return float(self.price.gradient @ (z - self.price.origin)) if self.price else 0.0

    def has_ample(self, solution: TimeSolution) -> bool:
        """Whether the objective `margin` is saturated."""
        return self.goal is Objective.MARGIN and solution.margin > self.most_margin

    @property
    def most_margin(self) -> float:
        """Margin at which the objective saturates."""
        return self.ample - self.problem.epsilon

    def solve(
        self,
        stages: list[Stage],
        before: TimeSolution | None = None,
        most: int = 150,
        raised: Sequence[LimitMisses] | None = None,
    ) -> TimeSolution:
        """Solve from the stages' guesses in at most `most` iterations, with `raised` limits.

        Without these, formation limits violated at the points are added, and the NLP is solved
        again.
        """
        controls = self.scheme.controls
        if stages[0].guess.tau.shape[1] != controls:
            stages = [replace(s, guess=with_controls(s.guess, controls)) for s in stages]
        margin = before.margin if before else 0.0
        if raised and before and all(map(operator.is_, stages, before.stages)):
            return self.run(before.nlp, stages, raised, before.multipliers, margin)
        depth = 1e-6 * self.problem.scene.polygon.gyration_radius  # least violation that counts
        while True:
            limits = raised or [LimitMisses.none(stage) for stage in stages]
            solution = self.run(self.build(stages, most), stages, limits, None, margin)
            if raised or not solution.success:
                return solution
            tables = [
                s.formation.evaluate_limits(s.guess.z.reshape(-1, 5)) for s in solution.stages
            ]
            stages = monitor(solution.stages, [table.min(axis=0) for table in tables], depth)
            if stages is solution.stages:
                return solution

    def build(self, stages: Sequence[Stage], most: int = 150) -> TimeNLP:
        """Build the NLP."""
        gradient = self.price.gradient if self.price else None
        target = Target(
            self.goal, self.problem.epsilon, self.options.time_weight, self.relaxation, gradient
        )
        return build_time_nlp(stages, self.scheme, target, _ITERATIONS.get(self.goal, most))

    def run(
        self,
        nlp: TimeNLP,
        stages: Sequence[Stage],
        limits: Sequence[LimitMisses],
        multipliers: Multipliers | None,
        margin: float,
    ) -> TimeSolution:
        """Run the solver once."""
        (low, high), (low_g, high_g) = find_bounds(nlp, stages, self.scheme, limits)
        if self.duration is not None and nlp.duration_row >= 0:
            high_g[nlp.duration_row] = self.duration
        if self.goal is Objective.MARGIN:
            # Solving for more than the saturated margin takes long.
            high[nlp.layouts[-1].nodes[-1, MARGIN]] = 1.1 * self.most_margin
        if (low > high).any():
            status = "limits that hold between points too leave nothing"
            return TimeSolution(list(stages), np.inf, 0.0, status, False, nlp, {})
        solver = nlp.solver
        if not multipliers:
            # Of one size for all inequalities.
            bounded = np.isfinite(high).astype(float) - np.isfinite(low)
            on_rows = np.where(high_g > low_g, -FIRST_SIZE, 0.0)
            multipliers = {"lam_x0": FIRST_SIZE * bounded, "lam_g0": on_rows}
            solver = nlp.first_solver
        result = solver(
            x0=pack([stage.guess for stage in stages], nlp.layouts, margin),
            lbx=low,
            ubx=high,
            lbg=low_g,
            ubg=high_g,
            **multipliers,
        )
        stats = solver.stats()
        x, cost = result["x"].full()[:, 0], float(result["f"])
        cost -= float(self.price.gradient @ self.price.origin) if self.price else 0.0
        return TimeSolution(
            [
                replace(stage, guess=part)
                for stage, part in zip(stages, unpack(x, nlp.layouts), strict=True)
            ],
            cost,
            -cost if self.goal is Objective.MARGIN else 0.0,
            f"Ipopt stopped with {stats['return_status']}",
            stats["success"],
            nlp,
            {f"{key}0": result[key].full()[:, 0] for key in ("lam_x", "lam_g")},
        )
