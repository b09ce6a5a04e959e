"""Solving for stages: one NLP after another, until no limit is broken at the points."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np

from ...common.arrays import Array
from ...common.shortfalls import Parameter
from ...geometry.cost_to_go import CostToGo
from ...problem.definition import Problem
from ..options import Objective, PlanOptions
from ..phase_plan import Tried
from .assembly import Indices
from .collocation import Scheme, make_scheme
from .equations import StageRows
from .intersample import IntersampleLimits, raise_bounds
from .nlp_layout import MARGIN, pack, unpack
from .stage import Stage, StagePoints
from .time_limits import Target
from .time_mesh import adopt, monitor_violated, with_controls
from .time_nlp import TimeNLP, bound_unknowns, build_time_nlp
from .time_rate_limits import MotorRows
from .units import in_own_units, scale_options, unit_lengths, unit_of

FIRST_SIZE = 1e-2  # multipliers of a first guess
Multipliers = dict[str, Array]  # of the unknowns' bounds, `lam_x0`, and of the rows, `lam_g0`
_ITERATIONS = {Objective.ELASTIC: 90, Objective.RELAX: 50}
"""Most iterations of one solve, if not 150."""
_SLOWER = 2  # factor on the most iterations of one solve, where rates of torques are limited
_CAP = 1.1  # largest margin that is looked for, over the one from which on more decides nothing


class Price(NamedTuple):
    """What the end of stages costs: `gradient` @ (z - `origin`), both of shape (5,)."""

    gradient: Array
    origin: Array


class TimeSolution(NamedTuple):
    """Stages with what the solver found as their guess."""

    stages: list[Stage]
    cost: float  # objective
    margin: float  # least c_n over epsilon, if that is an unknown
    status: str  # how it ended, in words
    success: bool
    nlp: TimeNLP  # what was solved
    multipliers: Multipliers  # what it ended with
    # estimate of what better torques would gain, over the cost; not known of all
    error: float = math.nan
    # what it has come from, with torques that are not held over control periods
    free: TimeSolution | None = None

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
class TimeSearch:
    """A search for a plan: what stays the same from solve to solve, and what it has cost.

    It works in the scene's own units.
    """

    problem: Problem
    options: PlanOptions
    scheme: Scheme
    duration: float | None  # longest duration, for the objective `margin`
    goal: Objective
    relaxation: Parameter | None = None  # what gives way, for the objective `relax`
    # what follows costs from where stages end, and its gradient, each by the objective
    to_go: Callable[[Array], tuple[float, Array]] | None = None
    price: Price | None = None
    # least normal force from which on more decides nothing, for the objective `margin`
    ample: float = math.inf
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
        """A search for what `plan_phases` is given, in SI units."""
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

        Where limits give way torques are linear: others might keep them at the points alone.
        """
        name, degree = self.scheme.name, self.scheme.degree
        straight = goal in (Objective.ELASTIC, Objective.RELAX)
        scheme = make_scheme(name, degree, 2 if straight else degree)
        own = replace(self, goal=goal, relaxation=relaxation, scheme=scheme)
        return replace(own, duration=None, to_go=None, price=None)

    def wait(self, iterations: int) -> int:
        """Iterations to wait for the solver: where rates of torques are limited it takes more."""
        return iterations * (_SLOWER if self.problem.scene.has_slow_motors else 1)

    def charge(self, z: Array) -> float:
        """What it costs to end at `z`, shape (5,)."""
        return float(self.price.gradient @ (z - self.price.origin)) if self.price else 0.0

    def has_ample(self, solution: TimeSolution) -> bool:
        """Whether c_n is as large as another phase allows anyway, for the objective `margin`."""
        return self.goal is Objective.MARGIN and solution.margin > self.most_margin

    @property
    def most_margin(self) -> float:
        """What c_n has over epsilon where it is ample."""
        return self.ample - self.problem.epsilon

    def solve(
        self, stages: list[Stage], before: TimeSolution | None = None, most: int = 150
    ) -> TimeSolution:
        """Solve from the stages' guesses, until no limit is broken at the points.

        Parameters
        ----------
        most  most iterations
        """
        controls = self.scheme.controls
        if stages[0].guess.tau.shape[1] != controls:
            stages = [replace(own, guess=with_controls(own.guess, controls)) for own in stages]
        while True:
            nlp = self.build(stages, most)
            multipliers = None
            if before is not None and before.monitored == [stage.monitored for stage in stages]:
                multipliers = carry_multipliers(
                    before.multipliers, before.nlp, nlp, self.scheme, before.stages, stages
                )
            plain = [IntersampleLimits.none(stage) for stage in stages]
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
        limits: Sequence[IntersampleLimits],
        multipliers: Multipliers | None,
        margin: float,
    ) -> TimeSolution:
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
            return TimeSolution(list(stages), np.inf, 0.0, status, False, nlp, {})
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
        return TimeSolution(
            adopt(stages, unpack(x, nlp.layouts)),
            cost,
            -cost if self.goal is Objective.MARGIN else 0.0,
            f"Ipopt stopped with {stats['return_status']}",
            stats["success"],
            nlp,
            {f"{key}0": result[key].full()[:, 0] for key in ("lam_x", "lam_g")},
        )


def first_multipliers(
    bounds: Sequence[Array], row_bounds: Sequence[Array], size: float = FIRST_SIZE
) -> Multipliers:
    """Multipliers of one size for all inequalities.

    Parameters
    ----------
    bounds, row_bounds  lower and upper bounds of unknowns and rows
    """
    (low, high), (low_g, high_g) = bounds, row_bounds
    bounded = np.isfinite(high).astype(float) - np.isfinite(low)
    return {"lam_x0": size * bounded, "lam_g0": np.where(high_g > low_g, -size, 0.0)}


def carry_multipliers(
    multipliers: Multipliers,
    old: TimeNLP,
    new: TimeNLP,
    scheme: Scheme,
    old_stages: Sequence[Stage],
    new_stages: Sequence[Stage],
) -> Multipliers:
    """Multipliers of the same stages on other intervals.

    What is said at points goes with the length of an interval, as the sum over time matters. Those
    of collocation are costates, which are continuous.
    """
    on_x, on_g = multipliers["lam_x0"], multipliers["lam_g0"]
    lam_x, lam_g = np.zeros(new.layouts[-1].stop), np.zeros(len(new.rows.bounds[0]))
    once = [_list_once(nlp) for nlp in (new, old)]
    if len(once[0]) == len(once[1]):
        lam_g[once[0]] = on_g[once[1]]
    for k, (before, after) in enumerate(zip(old_stages, new_stages, strict=True)):
        part, finer = before.guess, after.guess
        middles = finer.breaks[:-1] + finer.fractions / 2
        parent = np.searchsorted(part.breaks, middles, side="right") - 1
        share = finer.fractions / part.fractions[parent]
        for name in ("tau", "v", "forces"):
            mine, theirs = getattr(new.layouts[k], name), getattr(old.layouts[k], name)
            values = on_x[theirs[parent]]
            lam_x[mine] = values * share.reshape(-1, *[1] * (values.ndim - 1))
        rows, known = new.rows_of[k], old.rows_of[k]
        for mine, theirs in zip(rows.even, known.even, strict=True):
            values = on_g[theirs[parent]]
            lam_g[mine] = values * share.reshape(-1, *[1] * (values.ndim - 1))
        if rows.motors is not None and known.motors is not None:
            _carry_motors(lam_g, on_g, (known.motors, rows.motors), (part, finer), parent)
        costate = find_costate(known, on_g, scheme)[parent]
        places = (finer.places(scheme.points) - part.breaks[parent, None]) / part.fractions[
            parent, None
        ]
        moved = np.stack(
            [scheme.interpolate(x) @ own for x, own in zip(places, costate, strict=True)]
        )
        along = np.einsum("kdf,ksjd->ksjf", rows.bases, moved * scheme.weights[:, None])
        lam_g[rows.states] = np.linalg.pinv(scheme.rungs.T) @ along
    return {"lam_x0": lam_x, "lam_g0": lam_g}


def find_costate(rows: StageRows, on_g: Array, scheme: Scheme) -> Array:
    """What z and z' at the points are worth, by the multipliers of rows, shape (K, 2, d, 5)."""
    shares = scheme.rungs.T @ on_g[rows.states] / scheme.weights[:, None]
    return np.asarray(np.einsum("kdf,ksjf->ksjd", rows.bases, shares))


def _carry_motors(
    lam_g: Array,
    on_g: Array,
    rows: tuple[MotorRows, MotorRows],
    parts: tuple[StagePoints, StagePoints],
    parent: Indices,
) -> None:
    """Multipliers of rates and commands, and of torques that go on: their costate."""
    known, own = rows
    lam_g[own.rates], lam_g[own.commands] = on_g[known.rates[parent]], on_g[known.commands[parent]]
    old, new = (part.breaks[1:-1] for part in parts)
    if len(old):
        for joint in range(2):
            lam_g[own.joins[:, joint]] = np.interp(new, old, on_g[known.joins[:, joint]])


def _list_once(nlp: TimeNLP) -> Indices:
    """Rows that are there once, and not in each interval."""
    own = [part.ravel() for r in nlp.rows_of for part in (*r.even, r.states, r.shares)]
    slow = [r.motors for r in nlp.rows_of if r.motors is not None]
    own += [part.ravel() for m in slow for part in (m.joins, m.rates, m.commands)]
    return np.delete(np.arange(len(nlp.rows.bounds[0])), np.concatenate(own))
