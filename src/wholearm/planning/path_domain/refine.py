"""Mesh refinement of the path-domain NLP: solve, estimate the error, adapt the mesh, solve again.

First solutions start from the minimum-time speed profile, with multipliers near the central path.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from ...common.arrays import Array
from ...mechanics.path_limits import PathLimits
from ..lower_bound.speed_sweep import SweepMode
from ..options import Objective
from ..phase_plan import PhasePlan
from .elements import (
    DEGREE,
    FROM_REST,
    INSIDE,
    TO_REST,
    Elements,
    Grid,
    Profile,
    find_basis,
    follow,
)
from .first_guess import guess
from .interpolation import fit_torque
from .path_data import PhaseData, cut
from .path_mesh import MOST, SHIFTED, SLOW_MOST, Mesh, adapt
from .path_motion import PathMotion
from .path_nlp import PathNLP, Tightening, Units, make_bounds, pack, parameters, unpack
from .rate_terms import find_rate_switches, ramp_up
from .speed_profile import Fastest, find_fastest
from .task import EARLY, Task
from .terms import LEAST_B
from .violations import Misses, PathSolution, anticipate, price

_COLD_MU = 1e-7  # initial barrier parameter: complementarity of the multipliers
_COLD_INSIDE = 1e-2  # larger slacks count as this one [units of the NLP]
_FAR_MU, _FAR_INSIDE = 1e-2, 1e-3  # the same two without a speed profile
_DAMPING = 1e-10  # of normal equations with dependent rows, over their mean diagonal
_PICARD = 2  # Picard iterations between speeds and vertices
_WILD = 10.0  # s'' over its median above which a vertex is of nearly parallel limits
_NODES = DEGREE + 1
_MU, _INSIDE = 1e-6, 1e-4  # least initial complementarity, and its least slack, under rate limits
_SHARE = 0.5  # share of the accuracy for shifted switches
# Share of the accuracy for missed limits, to first order: efforts have other errors.
_DEAR = {Objective.TIME: 1.0, Objective.MARGIN: 1.0, Objective.EFFORT: 0.2}
_LIKELY = 0.2  # share of that beyond which the elements are doubled, not only moved
_LONGER = 0.2  # most that the NLP's duration may be allowed to be longer, relatively
_SETTLED = 0.1  # share of the accuracy below which switches are not looked for again
_UNLIMITED_TIGHTENING = 1e-2  # of limits in a plan without rate limits, over their scales
_FIRST_TIGHTENINGS = (5e-4, 5e-5)  # the same with rate limits; the second for a high accuracy
_RATE_TIGHTENING = 10.0  # of rates and commands, over that
Plans = list[PhasePlan[PathMotion]]


@dataclass(frozen=True)
class Iterate:
    """A mesh with its NLP, and the solution on it or the point to start from."""

    task: Task
    elements: int  # of each phase
    meshes: tuple[Mesh, ...]
    parts: list[PhaseData]
    data: PhaseData  # all phases as one
    nlp: PathNLP
    units: Units
    solution: PathSolution  # the last one, or the point to start from
    tightening: Tightening  # of the limits for that
    fastest: Fastest | None  # minimum-time speed profile, near which plans are looked for
    duration: float | None  # [s]: bound in the NLP, raised by the error of its quadrature
    shift: float = np.inf  # estimated distance of switches from breaks, over the curve's length
    interior: Iterate | None = None  # under rate limits: strictly feasible, to restart from

    @staticmethod
    def begin(task: Task, refinement: int) -> Iterate:
        """Initial guess on elements that end at reversals alone, or from an unlimited plan."""
        ramped = Iterate._add_ramps(task, refinement) if task.is_held else None
        if ramped is not None:
            return ramped
        layout = task.lay_out(tuple(Mesh() for _ in task.curves), refinement * task.elements)
        data, nlp = layout[3:]
        profile, units = guess(data, task.options.time_weight)
        sweeps = task.options.goal is not Objective.EFFORT and not data.grid.held
        fastest = find_fastest(data, task.duration) if sweeps else None
        start = PathSolution(profile, 0.0, balance(nlp, data, units, profile))
        none = Tightening.none(data, task.duration)
        profiled = fastest if isinstance(fastest, Fastest) else None
        first = Iterate(task, *layout, units, start, none, profiled, task.duration)
        if fastest is None:
            return first
        # Where it is not the duration that limits a margin, switches are not looked for.
        meshes = task.place_breaks(fastest.switches)
        return first._restart(meshes, refinement * task.elements, np.inf if profiled else 0.0)

    @staticmethod
    def _add_ramps(task: Task, refinement: int) -> Iterate | None:
        """Initial guess under rate limits: a plan without them, with ramps for torque steps."""
        unlimited = Iterate.begin(replace(task, unlimited=True, pins=(None, None)), refinement)
        plan = unlimited.tighten_all(_UNLIMITED_TIGHTENING).solve()
        if isinstance(plan, str):
            return None
        duration = sum(motion.duration for motion in plan.motions)
        ramped = ramp_up(plan.data, plan.solution.profile, duration, task.pins)
        if ramped is None:
            return None
        starts = np.cumsum([0.0, *(curve.length for curve in task.curves)])
        breaks = [mesh.breaks + start for mesh, start in zip(plan.meshes, starts, strict=False)]
        meshes = task.place_breaks(ramped.find_breaks(np.concatenate(breaks)))
        layout = task.lay_out(meshes, refinement * task.elements)
        data, nlp = layout[3:]
        profile = ramped.guess(plan.data.grid, plan.solution.profile, data.grid)
        multipliers = plan.move_multipliers(nlp, data)
        multipliers = center(nlp, data, plan.units, profile, multipliers, task)
        start, none = PathSolution(profile, 0.0, multipliers), Tightening.none(data, task.duration)
        return Iterate(task, *layout, plan.units, start, none, None, task.duration)

    def tighten_all(self, share: float) -> Iterate:
        """The iterate with all limits tightened, so that its solution is strictly feasible."""
        tight, scale = self.tightening, 1 - _RATE_TIGHTENING * share
        limits = tight.limits + share * self.data.spans
        tight = tight._replace(limits=limits, motors=tight.motors * scale)
        return replace(self, tightening=tight)

    def refit(self) -> Iterate:
        """The iterate on a mesh for its solution, with limits as they are."""
        meshes = tuple(
            Mesh.of(part.curve, find_rate_switches(part, motion.profile), True)
            for part, motion in zip(self.parts, self.motions, strict=True)
        )
        return replace(self, interior=self)._restart(meshes, self.elements, 0.0)

    def _restart(self, meshes: tuple[Mesh, ...], elements: int, shift: float) -> Iterate:
        """Start on other meshes, from the minimum-time speed profile or else from this iterate."""
        task, source, allowed = self.task, self.interior or self, self.allowed
        layout = task.lay_out(meshes, elements)
        data, nlp = layout[3:]
        tightening = Tightening.none(data, allowed)
        if self.fastest is None:
            profile = Elements(source.data.grid, source.solution.profile).move(data.grid)
            multipliers = source.move_multipliers(nlp, data)
            if data.grid.held:
                profile = follow(data.grid, profile.a, profile.lam)
                multipliers = center(nlp, data, self.units, profile, multipliers, task)
            start = source.solution._replace(profile=profile, multipliers=multipliers)
        else:
            start, vertices = start_at(nlp, data, self.units, self.fastest)
            if task.options.accuracy >= EARLY:
                tightening = anticipate(data, start._replace(profile=vertices), tightening)
        first = Iterate(task, *layout, self.units, start, tightening, self.fastest, allowed)
        return replace(first, shift=shift, interior=self.interior)

    def move_multipliers(self, nlp: PathNLP, data: PhaseData) -> dict[str, Array]:
        """Multipliers of the solution on another grid of the same curves."""
        old = self.solution.multipliers
        return move_multipliers(self.nlp, nlp, old, self.data.grid, data.grid)

    @cached_property
    def motions(self) -> list[PathMotion]:
        """The motion of each phase."""
        pairs = zip(self.parts, cut(self.parts, self.solution.profile), strict=True)
        return [PathMotion(part.curve, part.grid, profile) for part, profile in pairs]

    @cached_property
    def misses(self) -> Misses:
        """Violations of limits between nodes."""
        return Misses.of(self.data, self.solution, self.motions, self.task.duration)

    @property
    def value(self) -> float:
        """Scale of the cost's error."""
        if self.task.options.goal is Objective.MARGIN:
            return max(abs(self.task.epsilon + self.solution.margin) / self.units.force, 1e-9)
        return max(abs(self.solution.cost), 1e-9)

    @cached_property
    def due(self) -> Array:
        """Relative cost at each node of tightening limits by their violations."""
        missed = self.misses.short, self.misses.speeding, self.misses.hurry
        return self._price(*map(self.data.spread_to_nodes, missed))

    @cached_property
    def paid(self) -> Array:
        """Relative cost at each node of the tightening so far."""
        tight = self.tightening
        return self._price(tight.missed, 1 - tight.speed_share, 1 - tight.motors)

    @cached_property
    def wasted(self) -> Array:
        """Relative cost at each node of tightening limits more than needed."""
        spare = np.minimum(self.tightening.missed, self.misses.find_spare(self.data))
        return self._price(spare, np.zeros(len(spare)), np.zeros((len(spare), 2, 2)))

    def _price(self, *tightened: Array) -> Array:
        costs = price(self.nlp, self.data, self.units, self.solution, *tightened)
        return np.asarray(costs / self.value)

    @property
    def allowed(self) -> float | None:
        """Bound of the NLP's duration with which the motion's is the allowed one [s]."""
        wanted, duration = self.task.duration, self.solution.duration
        if not wanted or not duration:
            return wanted
        total = sum(motion.duration for motion in self.motions)
        return wanted * (1 + min(max(duration / total - 1, 0.0), _LONGER))

    @property
    def unspent(self) -> float:
        """Relative gain of using the time that is left, to first order."""
        if self.task.duration is None:
            return 0.0
        left = self.task.duration - sum(motion.duration for motion in self.motions)
        each = float(self.solution.multipliers["lam_g0"][self.nlp.columns.g["duration"]].sum())
        return max(each, 0.0) * max(left, 0.0) / self.units.time / self.value

    @property
    def merit(self) -> float:
        """Estimated cost once limits hold between nodes."""
        return self.solution.cost + self.value * float(self.due.sum())

    @property
    def is_kept(self) -> bool:
        """Whether some motion is known to keep limits at nodes, or negative margins would do."""
        if self.fastest is not None or self.task.options.goal is Objective.MARGIN:
            return True
        return bool(self.data.slack(self.data.nodes, self.solution.profile).min() >= 0)

    @property
    def violation_at_nodes(self) -> float:
        """Largest violation at nodes, over the scales: within ranges, by signs of no row."""
        margin = self.solution.margin
        slack = self.data.slack(self.data.nodes, self.solution.profile, margin)
        return -float((slack / self.data.spans).min())

    @property
    def is_split(self) -> bool:
        """Whether elements end where the plan switches."""
        return any(len(mesh.breaks) for mesh in self.meshes)

    def solve(self) -> Iterate | str:
        """Solve on this mesh; why the solver ended if there is no solution."""
        nlp, data, units, start, task = self.nlp, self.data, self.units, self.solution, self.task
        bounds = make_bounds(nlp, data, units, self.tightening, start=task.start, pins=task.pins)
        if (bounds["lbg"] > bounds["ubg"]).any():
            return "limits that hold between the nodes too leave nothing"
        result = nlp.solver(
            x0=pack(nlp, start.profile, units, start.margin, data.grid.sizes),
            p=parameters(nlp, data, units, task.options.time_weight),
            **bounds,
            **start.multipliers,
        )
        stats = nlp.solver.stats()
        if not stats["success"]:
            return f"Ipopt stopped with {stats['return_status']}"
        profile, margin = unpack(nlp, data.grid, result["x"].full()[:, 0], units)
        multipliers = {f"{key}0": result[key].full()[:, 0] for key in ("lam_x", "lam_g")}
        duration = float(result["g"][-1]) * units.time if self.tightening.duration else 0.0
        solution = PathSolution(profile, margin, multipliers, float(result["f"]), duration)
        return replace(self, solution=solution)

    def solve_first(self) -> Iterator[Iterate | str]:
        """First solutions; under rate limits also on a mesh for one with tighter limits."""
        if self.data.grid.held:
            accurate, first = self.task.options.accuracy < EARLY, self
            for share in _FIRST_TIGHTENINGS[: 1 + accurate]:
                interior = first.tighten_all(share).solve()
                if isinstance(interior, str):
                    break
                first = interior.refit()
            if first is not self:
                yield first.solve()
        yield self.solve()

    def tighten(self, ease: bool) -> Iterate:
        """The iterate with limits tightened by their violations, eased first where too tight."""
        tight = self.tightening
        tight = tight.ease(self.misses.find_spare(self.data)) if ease else tight
        return replace(self, tightening=self.misses.tighten(self.data, tight, self.solution))

    def adapt(self, dearer: bool = False) -> tuple[Iterate, Iterate | None]:
        """The iterate with its shift, and one on a better mesh; None if this one will do.

        Parameters
        ----------
        dearer  whether tightening limits has cost more than the accuracy
        """
        task, most = self.task, self.task.options.accuracy
        prices = self.due + self.paid - self.wasted
        shares = np.split(prices, np.cumsum([len(part.grid.s) for part in self.parts])[:-1])
        most_elements = SLOW_MOST if self.data.grid.held and most >= EARLY else MOST
        coarse = self.elements < most_elements and task.options.intervals is None
        allowed = _DEAR[task.options.goal] * most
        dear = dearer or bool(prices.sum() > allowed)
        # Converged switches need not be looked for. Where much is violated they are not better
        # known than by a sweep.
        settled = SHIFTED * self.shift < _SETTLED * most
        settled = settled or self.data.grid.held or (self.fastest is not None and dear and coarse)
        goal, margin = None if settled else task.options.goal, self.solution.margin
        phases = zip(self.parts, self.motions, shares, self.meshes, strict=True)
        better = [
            adapt(goal, part, motion.profile, margin, share, mesh)
            for part, motion, share, mesh in phases
        ]
        shift = self.shift if settled else max(each.shift for each in better)
        moved = SHIFTED * shift > _SHARE * most and not self.data.grid.held
        # Violations say little before elements end at switches.
        dear = dear and coarse and (dearer or self.is_split or not np.isinf(shift))
        if not (moved or dear):
            if self.unspent <= _SHARE * most:
                return replace(self, shift=shift), None
            longer = self.tightening._replace(duration=self.allowed)
            return self, replace(self, tightening=longer, duration=self.allowed, shift=shift)
        expected = sum(each.price for each in better)
        double = (dearer and coarse) or (dear and expected > _LIKELY * allowed)
        meshes = tuple(each.mesh for each in better)
        return self, self._restart(meshes, self.elements * (2 if double else 1), shift)

    def summarise(self) -> Plans:
        """The plan of each phase."""
        options = self.task.options
        error = float(self.paid.sum() + SHIFTED * min(self.shift, 1.0) + self.unspent)
        plans: Plans = []
        for part, motion in zip(self.parts, self.motions, strict=True):
            torque, squares = fit_torque(part, motion)
            value = {
                Objective.TIME: motion.duration,
                Objective.EFFORT: squares + options.time_weight * motion.duration,
                Objective.MARGIN: self.task.epsilon + self.solution.margin,
            }[options.goal]
            plans.append(PhasePlan(motion, torque, value, error=error))
        return plans


def center(
    nlp: PathNLP,
    data: PhaseData,
    units: Units,
    profile: Profile,
    multipliers: dict[str, Array],
    task: Task,
) -> dict[str, Array]:
    """Multipliers of a strictly feasible motion, raised to those of a small complementarity."""
    bounds = make_bounds(nlp, data, units, Tightening.none(data, task.duration), pins=task.pins)
    x = pack(nlp, profile, units, 0.0, data.grid.sizes)
    p = parameters(nlp, data, units, task.options.time_weight)
    g = nlp.solver.function.get_function("nlp_g")(x, p).full()[:, 0]
    centered = {}
    for key, here in (("x", x), ("g", g)):
        low, high, old = bounds[f"lb{key}"], bounds[f"ub{key}"], multipliers[f"lam_{key}0"]
        slack = np.maximum(high - here, _INSIDE), np.maximum(here - low, _INSIDE)
        push = _MU / slack[0] - _MU / slack[1]
        weak = (low < high) & (np.abs(old) < np.abs(push))
        centered[f"lam_{key}0"] = np.where(weak, push, old)
    return centered


def move_multipliers(
    before: PathNLP, after: PathNLP, multipliers: dict[str, Array], old: Grid, new: Grid
) -> dict[str, Array]:
    """Interpolate multipliers from one grid to another of the same curves."""

    def interpolate(table: Array, weights: tuple[Array, Array] | None = None) -> Array:
        first, last = weights or (np.ones(len(old.s)), np.ones(len(new.s)))
        columns = [last * old.interpolate(column / first, new) for column in table.T]
        return np.column_stack(columns) if columns else np.zeros((len(new.s), 0))

    on_g, rows, weights = multipliers["lam_g0"], before.columns.g, (old.weights, new.weights)
    table = np.zeros(before.free.shape)
    table[before.free] = multipliers["lam_x0"]
    table[:, 0] /= old.sizes
    blocks = {name: on_g[rows[name]] for name in rows.sizes}
    blocks["links"] = blocks["links"] / old.link_sizes
    for name in ("links", "chain"):
        if rows.sizes[name]:
            blocks[name] = interpolate(np.append(blocks[name], 0.0)[:, None])[:-1, 0]
    limits = blocks["limits"].reshape(len(old.s), -1)
    blocks["limits"] = interpolate(limits, weights).ravel()
    for name in ("rates", "commands"):
        if rows.sizes[name]:
            blocks[name] = interpolate(blocks[name].reshape(-1, len(old.s)).T, weights).ravel("F")
    if rows.sizes["joins"]:
        joins = blocks["joins"].reshape(-1, len(old.edges) - 1)
        places = new.edges[1:, 0], old.edges[1:, 0]
        blocks["joins"] = np.concatenate([np.interp(*places, values) for values in joins])
    for name, size in after.columns.g.sizes.items():
        if name in ("rates", "commands", "joins", "begins") and not rows.sizes[name]:
            blocks[name] = np.zeros(size)
    blocks["links"] = blocks["links"] * new.link_sizes
    table = interpolate(table, weights)
    table[:, 0] *= new.sizes
    return {"lam_x0": table[after.free], "lam_g0": after.columns.g.join(**blocks)}


def balance(nlp: PathNLP, data: PhaseData, units: Units, profile: Profile) -> dict[str, Array]:
    """Multipliers with which a feasible motion is near the central path."""
    slack = data.slack(data.nodes, profile) / units.of(data.limits)[data.limits.sides[0]]
    on_b = -_FAR_MU / np.maximum(profile.b / units.profile[0], _FAR_INSIDE)
    return _join(nlp, data, _FAR_MU / np.maximum(slack, _FAR_INSIDE), on_b)


def start_at(
    nlp: PathNLP, data: PhaseData, units: Units, fastest: Fastest
) -> tuple[PathSolution, Profile]:
    """Start near the minimum-time profile with estimated multipliers, and that profile itself.

    The profile is at vertices of the polygon of s'' and internal force that limits allow.
    """
    sides = data.find_limits(data.nodes, fastest.margin)
    vertices = _Vertices.at(data.grid, sides, fastest)
    rows = data.limits.sides[0]
    scale = data.spans / units.of(data.limits)[rows]
    on_links, kept = _find_multipliers(nlp, data, units, vertices)
    rate = 1.0
    if nlp.objective is Objective.MARGIN:
        presses = np.isin(rows[vertices.sides], nlp.shape.presses) & ~vertices.held[:, None]
        # Slope of the margin over the duration.
        rate = 1 / max(float((kept * presses).sum()), _COLD_MU)
    on_links, kept = rate * on_links, np.maximum(rate * kept, _COLD_MU / _COLD_INSIDE)
    (a, b, lam), slack = vertices.profile, _COLD_MU / kept / scale[vertices.sides]
    inner_a, inner_lam = sides.meet(b, vertices.sides, slack)
    stay = vertices.held | ~(np.isfinite(inner_a) & np.isfinite(inner_lam))
    moved = Profile(np.where(stay, a, inner_a), b, np.where(stay, lam, inner_lam))
    on_sides = _COLD_MU / np.maximum(sides.find_slack(*moved) * scale, _COLD_INSIDE)
    free = np.flatnonzero(~vertices.held)
    on_sides[free[:, None], vertices.sides[free]] = kept[free]
    on_b = -_COLD_MU / np.maximum(moved.b / units.profile[0], _COLD_INSIDE)
    on_b[vertices.held] += kept[vertices.held, 0]
    multipliers = _join(nlp, data, on_sides, on_b, on_links, rate)
    return PathSolution(moved, fastest.margin, multipliers), vertices.profile


def _join(
    nlp: PathNLP,
    data: PhaseData,
    on_sides: Array,
    on_b: Array,
    on_links: Array | float = 0.0,
    rate: float = 0.0,
) -> dict[str, Array]:
    """Multipliers of the NLP from those of sides, (n, n_sides), b, links and duration."""
    (rows, signs, _), sizes = data.limits.sides, nlp.columns.g.sizes
    on_rows = np.zeros((len(on_sides), nlp.shape.rows))
    for side, row in enumerate(rows.tolist()):
        on_rows[:, row] -= signs[side] * on_sides[:, side]
    on_x = np.zeros(nlp.free.shape)
    on_x[:, 0] = on_b
    # The chain's multiplier at a node is the sum of those of normal forces from there on.
    chain = -1 - np.cumsum(on_rows[:, list(nlp.shape.presses)].sum(axis=1))[:-1]
    on_g = nlp.columns.g.join(
        links=on_links + np.zeros(sizes["links"]),
        chain=chain[: sizes["chain"]],
        limits=on_rows.ravel(),
        duration=np.full(sizes["duration"], rate),
        **{name: np.zeros(sizes[name]) for name in ("rates", "commands", "joins", "begins")},
    )
    return {"lam_x0": on_x[nlp.free], "lam_g0": on_g}


class _Vertices(NamedTuple):
    """A motion at vertices of the polygon of s'' and internal force that limits allow."""

    profile: Profile
    sides: NDArray[np.int64]  # (n, 2): which meet there
    held: NDArray[np.bool_]  # (n,): where a speed limit is active instead
    jumps: NDArray[np.int64]  # elements after which s'' jumps from its largest to its least

    @staticmethod
    def at(grid: Grid, sides: PathLimits, fastest: Fastest) -> _Vertices:
        """The vertices of a minimum-time profile.

        Speeds are integrated forwards where s'' is the largest, and backwards where the least.
        """
        modes = fastest.find_modes(grid.edges.mean(axis=1))
        of_nodes = np.repeat(modes, _NODES)
        runs = np.split(np.arange(len(of_nodes)), np.flatnonzero(np.diff(of_nodes)) + 1)
        held, pushed = of_nodes == SweepMode.HELD, of_nodes == SweepMode.PUSH
        wanted = np.interp(grid.s, (fastest.s[1:] + fastest.s[:-1]) / 2, fastest.slopes)
        b, rows = np.interp(grid.s, fastest.s, fastest.b), sides.eliminate()
        for _ in range(_PICARD):
            most, least = (_find_pairs(sides, rows, b, largest) for largest in (True, False))
            (high, press), (low, other) = (sides.meet(b, pair) for pair in (most, least))
            with np.errstate(divide="ignore", invalid="ignore"):
                share = np.nan_to_num(np.clip((wanted - low) / (high - low), 0.0, 1.0))
            a = np.where(held, wanted, np.where(pushed, high, low))
            between = share * press + (1 - share) * other
            lam = np.where(held, between, np.where(pushed, press, other))
            # Rows within ranges may coincide, and then meet nowhere: no vertex either.
            wild = ~(np.abs(a) <= _WILD * np.median(np.abs(fastest.slopes))) | ~np.isfinite(lam)
            if wild.any() and not wild.all():
                a = np.where(wild, wanted, a)
                lam[wild] = np.interp(grid.s[wild], grid.s[~wild], lam[~wild])
            rise = grid.integrate(a)
            for run in runs:
                end = run[0] if pushed[run[0]] else run[-1]
                if not held[run[0]]:
                    b[run] = np.maximum(b[end] + rise[run] - rise[end], 0.0)
        jumps = np.flatnonzero((modes[:-1] == SweepMode.PUSH) & (modes[1:] == SweepMode.BRAKE))
        pair = np.where(pushed[:, None], most, least)
        return _Vertices(Profile(a, b, lam), pair, held, jumps)


def _find_pairs(sides: PathLimits, rows: PathLimits, b: Array, largest: bool) -> NDArray[np.int64]:
    """The sides that meet at the largest or least s'' of each node, shape (n, 2).

    Other sides may take over at element ends: there those of the next node inside are taken.
    """
    row = rows.extreme(b, largest).row.reshape(-1, _NODES)
    row[:, 0], row[:, -1] = row[:, 1], row[:, -2]
    return sides.pair(row.ravel())


def _find_multipliers(
    nlp: PathNLP, data: PhaseData, units: Units, vertices: _Vertices
) -> tuple[Array, Array]:
    """Least-squares multipliers of the links, (N,), and of the sides that meet, (n, 2).

    From stationarity of the duration, with the Jacobian of the NLP. Where a speed limit is active,
    its multiplier is in the first column.
    """
    (a, b, lam), grid, g = vertices.profile, data.grid, nlp.columns.g
    # The duration has no slope at rest, nor without acceleration there.
    a, b = a.copy(), np.maximum(b, LEAST_B * units.profile[0])
    a[[0, -1]] = np.maximum(np.abs(a[[0, -1]]), LEAST_B * units.profile[1]) * [1.0, -1.0]
    x, p = pack(nlp, Profile(a, b, lam), units, 0.0, grid.sizes), parameters(nlp, data, units, 0.0)
    table = np.full(nlp.free.shape, -1)
    table[nlp.free] = np.arange(len(x))
    unknowns = table[:, :3][table[:, :3] >= 0].tolist()
    rows, signs, _ = data.limits.sides
    # Where s'' jumps the duration does not depend on the speed.
    links = np.delete(np.arange(len(grid.steps)), vertices.jumps * _NODES + DEGREE)
    free = np.flatnonzero(~vertices.held)
    limits = g["limits"].start + free[:, None] * nlp.shape.rows + rows[vertices.sides[free]]
    jacobian = nlp.solver.function.get_function("nlp_jac_g")(x, p)[1]
    bounds = ca.DM.eye(len(x))[table[vertices.held, 0].tolist(), :]
    active = ca.vertcat(jacobian[[*links.tolist(), *limits.ravel().tolist()], :], bounds)
    slope = _find_slopes(grid, vertices.profile, units)[table[:, :3] >= 0]
    active = active[:, unknowns]
    squares = active @ active.T
    damping = _DAMPING * float(ca.trace(squares)) / squares.shape[0]
    solved = ca.solve(squares + damping * ca.DM.eye(squares.shape[0]), active @ slope, "ldl")
    on_links, on_limits, on_b = np.split(-solved.full()[:, 0], np.cumsum([len(links), limits.size]))
    every_link, kept = np.zeros(len(grid.steps)), np.zeros((len(b), 2))
    every_link[links], kept[vertices.held, 0] = on_links, on_b
    kept[free] = -signs[vertices.sides[free]] * on_limits.reshape(-1, 2)
    return every_link, kept


def _find_slopes(grid: Grid, profile: Profile, units: Units) -> Array:
    """Gradient of the NLP's duration at each node over b, s'' and internal force, (n, 3)."""
    basis, count = find_basis(), len(grid.kinds)
    b, a = profile.b / units.profile[0], profile.a / units.profile[1]
    weights = basis.weights * np.diff(grid.edges) / units.length
    y = np.where((grid.kinds == INSIDE)[:, None], 0.5, basis.y[grid.kinds])
    slope = np.zeros((count, 3, _NODES))
    slope[:, 0] = -weights * y * np.maximum(b, LEAST_B).reshape(count, -1) ** -1.5
    for e, node, kind in ((0, 0, FROM_REST), (-1, DEGREE, TO_REST)):
        if grid.kinds[e] == kind:
            end = a[node if e == 0 else -1]
            per_weight = (2 * (grid.edges[e, 1] - grid.edges[e, 0]) / units.length) ** -0.5
            slope[e, 0, node] = 0.0
            slope[e, 1, node] = -np.sign(end) * weights[e, node] * per_weight * abs(end) ** -1.5
    return slope.transpose(0, 2, 1).reshape(-1, 3)
