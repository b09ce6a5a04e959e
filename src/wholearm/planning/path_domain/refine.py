"""Solving along curves on a mesh, and what a solution says of a better mesh."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...common.arrays import Array
from ..lower_bound.rows import PathLimitRows
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
from .rate_switches import find_motor_switches, ramp_up
from .speed_profile import Fastest, find_fastest
from .switches import LimitSides
from .task import EARLY, Task
from .terms import LEAST_B
from .violations import Misses, PathSolution, anticipate, price

_COLD_MU = 1e-7
"""Complementarity of the multipliers: the barrier parameter to start from."""
_COLD_INSIDE = 1e-2
"""Largest slack of a limit that is kept with none, in the units of the NLP; others count as it."""
_FAR_MU, _FAR_INSIDE = 1e-2, 1e-3
"""The same two where nothing is known of a solution."""
_PLAIN = 1e-10
"""What is added to the squares of rows that may depend on each other, over the mean of all."""
_PICARD = 2
"""Rounds in which speeds and corners are made to agree."""
_WILD = 10.0
"""How much larger than usual s'' is in a corner of limits that hardly cross there."""
_NODES = DEGREE + 1
_MU, _INSIDE = 1e-6, 1e-4
"""Least complementarity to start slow motors from, and the least slack that it is for."""
_SHARE = 0.5
"""Share of the accuracy that is allowed for shifted switches."""
_DEAR = {Objective.TIME: 1.0, Objective.MARGIN: 1.0, Objective.EFFORT: 0.2}
"""Share of the accuracy that missed limits may cost by first order: efforts have other errors."""
_LIKELY = 0.2
"""Share of that which as many elements, placed better, may be likely to cost."""
_LONGER = 0.2
"""Most that the NLP's duration may be allowed to be longer, relatively."""
_SETTLED = 0.1
"""Share of the accuracy below which switches are not looked for again."""
_FIRST_EASE = 1e-2
"""By how much limits are tightened for a plan of quick motors, over what is much for each."""
_EASE = 5e-4
"""The same for a first plan of slow ones."""
_FINELY = 10.0
"""Over how much less for a second one, where a high accuracy is asked for."""
_EASIER = 10.0
"""By how much more rates and commands are."""
Plans = list[PhasePlan[PathMotion]]


@dataclass(frozen=True)
class Round:
    """A mesh, and what is known on it."""

    task: Task
    elements: int  # of each phase
    meshes: tuple[Mesh, ...]
    parts: list[PhaseData]
    data: PhaseData  # all phases as one
    nlp: PathNLP
    units: Units
    solution: PathSolution  # the last one, or where to start
    tightening: Tightening  # by how much limits are tightened for that
    fastest: Fastest | None  # the motion of a sweep, near which plans are looked for
    # [s]: what the NLP may take for the duration, which is longer than allowed if it errs so
    duration: float | None
    # how far switches seem to be from the mesh's breaks, over the curve's length
    shift: float = np.inf
    # what other meshes start from with slow motors: a solution inside the limits
    eased: Round | None = None

    @staticmethod
    def begin(task: Task, finer: int) -> Round:
        """A first guess on elements that know of nothing but reversals, or a quick plan's."""
        quick = Round._slow_down(task, finer) if task.is_held else None
        if quick is not None:
            return quick
        meshes = tuple(Mesh() for _ in task.curves)
        elements, parts, data, nlp = task.lay_out(meshes, finer * task.elements)
        profile, units = guess(data, task.options.time_weight)
        sought = task.options.goal is not Objective.EFFORT and not data.grid.held
        found = find_fastest(data, task.duration) if sought else None
        fastest = found if isinstance(found, Fastest) else None
        multipliers = balance(nlp, data, units, profile)
        start, none = PathSolution(profile, 0.0, multipliers), Tightening.none(data, task.duration)
        known = elements, meshes, parts, data, nlp, units, start, none
        begun = Round(task, *known, fastest, task.duration)
        if found is None:
            return begun
        # Where it is not the duration that limits a margin, switches are not looked for.
        shift = np.inf if fastest else 0.0
        meshes = task.place_breaks(found.switches)
        return begun._restart(meshes, finer * task.elements, shift)

    @staticmethod
    def _slow_down(task: Task, finer: int) -> Round | None:
        """A first guess for slow motors from a plan of quick ones, if they are not too slow."""
        begun = Round.begin(replace(task, quick=True, pins=(None, None)), finer)
        quick = begun.ease_in(_FIRST_EASE).solve()
        if isinstance(quick, str):
            return None
        lasts = sum(motion.duration for motion in quick.motions)
        ramped = ramp_up(quick.data, quick.solution.profile, lasts, task.pins)
        if ramped is None:
            return None
        starts = np.cumsum([0.0, *(curve.length for curve in task.curves)])
        places = np.concatenate(
            [mesh.breaks + start for mesh, start in zip(quick.meshes, starts, strict=False)]
        )
        meshes = task.place_breaks(ramped.find_breaks(places))
        elements, parts, data, nlp = task.lay_out(meshes, finer * task.elements)
        profile = ramped.guess(quick.data.grid, quick.solution.profile, data.grid)
        old = quick.solution.multipliers
        multipliers = move_multipliers(quick.nlp, nlp, old, quick.data.grid, data.grid)
        none = Tightening.none(data, task.duration)
        multipliers = center(nlp, data, quick.units, profile, multipliers, task)
        start = PathSolution(profile, 0.0, multipliers)
        known = elements, meshes, parts, data, nlp, quick.units, start, none
        return Round(task, *known, None, task.duration)

    def ease_in(self, share: float) -> Round:
        """The round with limits that are tightened a little, which later ones start inside of."""
        tight = self.tightening
        limits, motors = (
            tight.limits + share * self.data.spans,
            tight.motors * (1 - _EASIER * share),
        )
        return replace(self, tightening=tight._replace(limits=limits, motors=motors))

    def refit(self) -> Round:
        """The round on a mesh for its solution, with limits as they are."""
        pairs = zip(self.parts, self.motions, strict=True)
        meshes = tuple(
            Mesh.of(part.curve, find_motor_switches(part, motion.profile), True)
            for part, motion in pairs
        )
        return replace(self, eased=self)._restart(meshes, self.elements, 0.0)

    def _restart(self, meshes: tuple[Mesh, ...], elements: int, shift: float) -> Round:
        """Start on other meshes, from the fastest motion if that is known, or from this one."""
        task, source = self.task, self.eased or self
        solution = source.solution
        elements, parts, data, nlp = task.lay_out(meshes, elements)
        allowed = self.allowed
        tightening = Tightening.none(data, allowed)
        if self.fastest is None:
            old, new = source.data.grid, data.grid
            profile = Elements(old, solution.profile).move(new)
            multipliers = move_multipliers(source.nlp, nlp, solution.multipliers, old, new)
            if new.held:
                profile = follow(new, profile.a, profile.squeeze)
                multipliers = center(nlp, data, self.units, profile, multipliers, task)
            start = solution._replace(profile=profile, multipliers=multipliers)
        else:
            start, corners = start_at(nlp, data, self.units, self.fastest)
            if task.options.accuracy >= EARLY:
                tightening = anticipate(data, start._replace(profile=corners), tightening)
        known = elements, meshes, parts, data, nlp, self.units, start, tightening
        return Round(task, *known, self.fastest, allowed, shift, self.eased)

    @cached_property
    def motions(self) -> list[PathMotion]:
        """The motion of each phase."""
        pairs = zip(self.parts, cut(self.parts, self.solution.profile), strict=True)
        return [PathMotion(part.curve, part.grid, own) for part, own in pairs]

    @cached_property
    def misses(self) -> Misses:
        """What limits miss between nodes."""
        return Misses.of(self.data, self.solution, self.motions, self.task.duration)

    @property
    def value(self) -> float:
        """What errors of the cost are relative to."""
        if self.task.options.goal is Objective.MARGIN:
            return max(abs(self.task.epsilon + self.solution.margin) / self.units.force, 1e-9)
        return max(abs(self.solution.cost), 1e-9)

    @cached_property
    def due(self) -> Array:
        """What tightening limits by what they miss would cost at each node, relatively."""
        missed = self.misses.short, self.misses.speeding, self.misses.hurry
        short, speeding, hurry = (self.data.spread_to_nodes(part) for part in missed)
        return self._price((short, speeding, hurry))

    @cached_property
    def paid(self) -> Array:
        """What having tightened them costs at each node, relatively."""
        tight = self.tightening
        return self._price((tight.missed, 1 - tight.speed_share, 1 - tight.motors))

    @cached_property
    def wasted(self) -> Array:
        """What it costs at each node that limits are tightened more than they need, relatively."""
        spare = np.minimum(self.tightening.missed, self.misses.find_spare(self.data))
        return self._price((spare, np.zeros(len(spare)), np.zeros((len(spare), 2, 2))))

    def _price(self, tightened: tuple[Array, Array, Array]) -> Array:
        found = price(self.nlp, self.data, self.units, self.solution, tightened)
        return np.asarray(found / self.value)

    @property
    def allowed(self) -> float | None:
        """What the NLP may take for the duration so that it is the one that is allowed [s]."""
        wanted, lasts = self.task.duration, self.solution.lasts
        if not wanted or not lasts:
            return wanted
        total = sum(motion.duration for motion in self.motions)
        return wanted * (1 + min(max(lasts / total - 1, 0.0), _LONGER))

    @property
    def unspent(self) -> float:
        """What the time that is left would gain, to first order, relatively."""
        if self.task.duration is None:
            return 0.0
        left = self.task.duration - sum(motion.duration for motion in self.motions)
        each = float(self.solution.multipliers["lam_g0"][self.nlp.columns.g["duration"]].sum())
        return max(each, 0.0) * max(left, 0.0) / self.units.time / self.value

    @property
    def merit(self) -> float:
        """What the cost is likely to be once limits hold between nodes."""
        return self.solution.cost + self.value * float(self.due.sum())

    def keep_before(self, better: Round) -> Round:
        """The round, as another one with breaks at its switches has turned out to be no better.

        What its own breaks lose by being elsewhere is no more than the two differ by.
        """
        differ = abs(better.merit - self.merit) / self.value
        return replace(self, shift=min(better.shift, differ / SHIFTED))

    @property
    def is_kept(self) -> bool:
        """Whether a motion is known that keeps limits at nodes, or negative margins would do."""
        if self.fastest is not None or self.task.options.goal is Objective.MARGIN:
            return True
        return bool(self.data.slack(self.data.nodes, self.solution.profile).min() >= 0)

    @property
    def is_split(self) -> bool:
        """Whether elements end where the plan switches."""
        return any(len(mesh.breaks) for mesh in self.meshes)

    def solve(self) -> Round | str:
        """Solve on this mesh; in words how the solver ended if there is no solution."""
        weight = self.task.options.time_weight
        given = self.nlp, self.data, self.units, self.tightening, self.solution, weight
        found = solve(*given, self.task)
        return found if isinstance(found, str) else replace(self, solution=found)

    def solve_first(self) -> Iterator[Round | str]:
        """First solutions; with slow motors also on a mesh for one with tighter limits."""
        if self.data.grid.held:
            finely = self.task.options.accuracy < EARLY
            begun = self
            for share in (_EASE, _EASE / _FINELY)[: 1 + finely]:
                eased = begun.ease_in(share).solve()
                if isinstance(eased, str):
                    break
                begun = eased.refit()
            if begun is not self:
                yield begun.solve()
        yield self.solve()

    def tighten(self, ease: bool) -> Round:
        """The round with limits tightened by what they miss, and to `ease` no more than needed."""
        tight = self.tightening
        tight = tight.ease(self.misses.find_spare(self.data)) if ease else tight
        return replace(self, tightening=self.misses.tighten(self.data, tight, self.solution))

    def adapt(self, dearer: bool = False) -> tuple[Round, Round | None]:
        """The round with its shift, and a better one to go on from; None if this one will do.

        Parameters
        ----------
        dearer  whether tightening limits has turned out to be dearer than it may be
        """
        task, most = self.task, self.task.options.accuracy
        prices = self.due + self.paid - self.wasted
        shares = np.split(prices, np.cumsum([len(part.grid.s) for part in self.parts])[:-1])
        most_elements = SLOW_MOST if self.data.grid.held and most >= EARLY else MOST
        coarse = self.elements < most_elements and task.options.intervals is None
        enough = _DEAR[task.options.goal] * most
        dear = dearer or bool(prices.sum() > enough)
        # Once switches have settled they need not be looked for, and where much is missed they are
        # not better known than by a sweep.
        settled = SHIFTED * self.shift < _SETTLED * most
        settled = settled or self.data.grid.held or (self.fastest is not None and dear and coarse)
        goal = None if settled else task.options.goal
        found = [
            adapt(goal, part, motion.profile, self.solution.margin, share, mesh)
            for part, motion, share, mesh in zip(
                self.parts, self.motions, shares, self.meshes, strict=True
            )
        ]
        shift = self.shift if settled else max(better.shift for better in found)
        moved = SHIFTED * shift > _SHARE * most
        # What is missed where elements do not end at switches yet says little.
        begun = dearer or self.is_split or not np.isinf(shift)
        moved = moved and not self.data.grid.held
        dear = dear and begun and coarse
        if not (moved or dear):
            if self.unspent <= _SHARE * most:
                return replace(self, shift=shift), None
            longer = self.tightening._replace(duration=self.allowed)
            return self, replace(self, tightening=longer, duration=self.allowed, shift=shift)
        more = (dearer and coarse) or (
            dear and sum(better.price for better in found) > _LIKELY * enough
        )
        meshes = tuple(better.mesh for better in found)
        return self, self._restart(meshes, self.elements * (2 if more else 1), shift)

    def summarise(self) -> Plans:
        """The plan of each phase."""
        options = self.task.options
        plans: Plans = []
        for part, motion in zip(self.parts, self.motions, strict=True):
            torque, squares = fit_torque(part, motion)
            value = {
                Objective.TIME: motion.duration,
                Objective.EFFORT: squares + options.time_weight * motion.duration,
                Objective.MARGIN: self.task.epsilon + self.solution.margin,
            }[options.goal]
            error = float(self.paid.sum() + SHIFTED * min(self.shift, 1.0) + self.unspent)
            plans.append(PhasePlan(motion, torque, value, error=error))
        return plans


def solve(
    nlp: PathNLP,
    data: PhaseData,
    units: Units,
    tightening: Tightening,
    start: PathSolution,
    time_weight: float,
    task: Task,
) -> PathSolution | str:
    """Solve once; the solution, or in words how the solver ended."""
    bounds = make_bounds(nlp, data, units, tightening, start=task.start, pins=task.pins)
    if (bounds["lbg"] > bounds["ubg"]).any():
        return "limits that hold between the nodes too leave nothing"
    result = nlp.solver(
        x0=pack(nlp, start.profile, units, start.margin, data.grid.sizes),
        p=parameters(nlp, data, units, time_weight),
        **bounds,
        **start.multipliers,
    )
    stats = nlp.solver.stats()
    if not stats["success"]:
        return f"Ipopt stopped with {stats['return_status']}"
    profile, margin = unpack(nlp, data.grid, result["x"].full()[:, 0], units)
    multipliers = {f"{key}0": result[key].full()[:, 0] for key in ("lam_x", "lam_g")}
    lasts = float(result["g"][-1]) * units.time if tightening.duration else 0.0
    return PathSolution(profile, margin, multipliers, float(result["f"]), lasts)


def center(
    nlp: PathNLP,
    data: PhaseData,
    units: Units,
    profile: Profile,
    multipliers: dict[str, Array],
    task: Task,
) -> dict[str, Array]:
    """Multipliers with which a motion inside its limits is near the central path.

    At least those of a small complementarity.
    """
    bounds = make_bounds(nlp, data, units, Tightening.none(data, task.duration), pins=task.pins)
    x = pack(nlp, profile, units, 0.0, data.grid.sizes)
    p = parameters(nlp, data, units, task.options.time_weight)
    g = nlp.solver.function.get_function("nlp_g")(x, p).full()[:, 0]
    found = {}
    for key, here in (("x", x), ("g", g)):
        low, high, known = bounds[f"lb{key}"], bounds[f"ub{key}"], multipliers[f"lam_{key}0"]
        slack = np.maximum(high - here, _INSIDE), np.maximum(here - low, _INSIDE)
        push = _MU / slack[0] - _MU / slack[1]
        weak = (low < high) & (np.abs(known) < np.abs(push))
        found[f"lam_{key}0"] = np.where(weak, push, known)
    return found


def move_multipliers(
    before: PathNLP, after: PathNLP, multipliers: dict[str, Array], old: Grid, new: Grid
) -> dict[str, Array]:
    """Interpolate multipliers from one grid to another of the same curves."""

    def interpolate(table: Array, weights: tuple[Array, Array] | None = None) -> Array:
        first, last = weights or (np.ones(len(old.s)), np.ones(len(new.s)))
        columns = [last * old.interpolate(column / first, new) for column in table.T]
        return np.column_stack(columns) if columns else np.zeros((len(new.s), 0))

    on_x, on_g, rows = multipliers["lam_x0"], multipliers["lam_g0"], before.columns.g
    weights = old.weights, new.weights
    table = np.zeros(before.free.shape)
    table[before.free] = on_x
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
        blocks["joins"] = np.concatenate([np.interp(*places, own) for own in joins])
    for name, size in after.columns.g.sizes.items():
        if name in ("rates", "commands", "joins", "begins") and not rows.sizes[name]:
            blocks[name] = np.zeros(size)
    blocks["links"] = blocks["links"] * new.link_sizes
    table = interpolate(table, weights)
    table[:, 0] *= new.sizes
    return {"lam_x0": table[after.free], "lam_g0": after.columns.g.join(**blocks)}


def balance(nlp: PathNLP, data: PhaseData, units: Units, profile: Profile) -> dict[str, Array]:
    """Multipliers with which any motion is near the central path, if it keeps limits at all."""
    slack = data.slack(data.nodes, profile) / units.of(data.limits)[data.limits.sides[0]]
    on_b = -_FAR_MU / np.maximum(profile.b / units.profile[0], _FAR_INSIDE)
    return _join(nlp, data, _FAR_MU / np.maximum(slack, _FAR_INSIDE), on_b)


def start_at(
    nlp: PathNLP, data: PhaseData, units: Units, found: Fastest
) -> tuple[PathSolution, Profile]:
    """A motion near a fastest one on the grid of `data`, with multipliers near those of a plan.

    And that in the corners themselves.
    """
    sides = LimitSides.of(data, data.nodes, found.margin)
    corners = _Corners.at(data.grid, sides, found)
    rows = data.limits.sides[0]
    scale = data.spans / units.of(data.limits)[rows]
    on_links, kept = _find_multipliers(data.grid, sides, corners, scale, units)
    rate = 1.0
    if nlp.objective is Objective.MARGIN:
        presses = np.isin(rows[corners.sides], nlp.shape.presses) & ~corners.held[:, None]
        # So much does the margin change with the duration.
        rate = 1 / max(float((kept * presses).sum()), _COLD_MU)
    on_links, kept = rate * on_links, np.maximum(rate * kept, _COLD_MU / _COLD_INSIDE)
    moved = corners.move_inside(sides, _COLD_MU / kept / scale[corners.sides])
    on_sides = _COLD_MU / np.maximum(sides.find_slack(moved) * scale, _COLD_INSIDE)
    free = np.flatnonzero(~corners.held)
    on_sides[free[:, None], corners.sides[free]] = kept[free]
    on_b = -_COLD_MU / np.maximum(moved.b / units.profile[0], _COLD_INSIDE)
    on_b[corners.held] += kept[corners.held, 0]
    multipliers = _join(nlp, data, on_sides, on_b, on_links, rate)
    return PathSolution(moved, found.margin, multipliers), corners.profile


def _join(
    nlp: PathNLP,
    data: PhaseData,
    on_sides: Array,
    on_b: Array,
    on_links: Array | float = 0.0,
    rate: float = 0.0,
) -> dict[str, Array]:
    """The NLP's multipliers from those of sides, (n, n_sides), of b, of links and the duration."""
    (rows, signs, _), sizes = data.limits.sides, nlp.columns.g.sizes
    on_rows = np.zeros((len(on_sides), nlp.shape.rows))
    for side, row in enumerate(rows.tolist()):
        on_rows[:, row] -= signs[side] * on_sides[:, side]
    on_x = np.zeros(nlp.free.shape)
    on_x[:, 0] = on_b
    # The margin at each node is held by what presses from there on.
    chain = -1 - np.cumsum(on_rows[:, list(nlp.shape.presses)].sum(axis=1))[:-1]
    on_g = nlp.columns.g.join(
        links=on_links + np.zeros(sizes["links"]),
        chain=chain[: sizes["chain"]],
        limits=on_rows.ravel(),
        duration=np.full(sizes["duration"], rate),
        **{name: np.zeros(sizes[name]) for name in ("rates", "commands", "joins", "begins")},
    )
    return {"lam_x0": on_x[nlp.free], "lam_g0": on_g}


class _Corners(NamedTuple):
    """A motion in corners of limits."""

    profile: Profile
    sides: NDArray[np.int64]  # (n, 2): which meet there
    held: NDArray[np.bool_]  # (n,): where it is the speed that has a limit instead
    jumps: NDArray[np.int64]  # elements after which s'' jumps from its largest to its least

    @staticmethod
    def at(grid: Grid, sides: LimitSides, found: Fastest) -> _Corners:
        """The corners that a fastest motion is in.

        Speeds are integrated forwards where it has the largest s'', and backwards where the least.
        """
        modes = found.find_modes(grid.edges.mean(axis=1))
        of_nodes = np.repeat(modes, _NODES)
        runs = np.split(np.arange(len(of_nodes)), np.flatnonzero(np.diff(of_nodes)) + 1)
        held, pushed = of_nodes == SweepMode.HELD, of_nodes == SweepMode.PUSH
        wanted = np.interp(grid.s, (found.s[1:] + found.s[:-1]) / 2, found.slopes)
        b, rows = np.interp(grid.s, found.s, found.b), sides.eliminate()
        for _ in range(_PICARD):
            most, least = (_find_pairs(sides, rows, b, largest) for largest in (True, False))
            (high, press), (low, other) = (sides.meet(b, pair) for pair in (most, least))
            with np.errstate(divide="ignore", invalid="ignore"):
                share = np.nan_to_num(np.clip((wanted - low) / (high - low), 0.0, 1.0))
            a = np.where(held, wanted, np.where(pushed, high, low))
            between = share * press + (1 - share) * other
            squeeze = np.where(held, between, np.where(pushed, press, other))
            # Rows within ranges may coincide, and then meet nowhere: those are no corner either.
            wild = ~(np.abs(a) <= _WILD * np.median(np.abs(found.slopes))) | ~np.isfinite(squeeze)
            if wild.any() and not wild.all():
                a = np.where(wild, wanted, a)
                squeeze[wild] = np.interp(grid.s[wild], grid.s[~wild], squeeze[~wild])
            rise = grid.integrate(a)
            for run in runs:
                end = run[0] if pushed[run[0]] else run[-1]
                if not held[run[0]]:
                    b[run] = np.maximum(b[end] + rise[run] - rise[end], 0.0)
        jumps = np.flatnonzero((modes[:-1] == SweepMode.PUSH) & (modes[1:] == SweepMode.BRAKE))
        pair = np.where(pushed[:, None], most, least)
        return _Corners(Profile(a, b, squeeze), pair, held, jumps)

    def move_inside(self, sides: LimitSides, slack: Array) -> Profile:
        """The motion with some slack of the sides that meet, shape (n, 2)."""
        a, b, squeeze = self.profile
        inner_a, inner_squeeze = sides.meet(b, self.sides, slack)
        stay = self.held | ~(np.isfinite(inner_a) & np.isfinite(inner_squeeze))
        return Profile(np.where(stay, a, inner_a), b, np.where(stay, squeeze, inner_squeeze))


def _find_pairs(
    sides: LimitSides, rows: PathLimitRows, b: Array, largest: bool
) -> NDArray[np.int64]:
    """The sides that meet at the largest or the least s'' of each node, shape (n, 2).

    Where elements meet other sides may take over. There those that meet at the next node inside do.
    """
    row = rows.extreme(b, largest).row.reshape(-1, _NODES)
    row[:, 0], row[:, -1] = row[:, 1], row[:, -2]
    return sides.pair(row.ravel())


def _find_multipliers(
    grid: Grid, sides: LimitSides, corners: _Corners, scale: Array, units: Units
) -> tuple[Array, Array]:
    """Multipliers of the links, shape (N,), and of the sides that meet, shape (n, 2).

    Of a speed limit instead of the first of them where there is one. The duration is stationary
    with them but for what no multipliers can balance. Unknowns and rows are put together by
    elements, of which only neighbours have to do with each other.
    """
    own, across = _list_rows(grid, sides, corners, scale, units)
    slope = _find_slopes(grid, corners.profile, units)
    ahead = np.concatenate([own[1:], np.zeros_like(own[:1])])
    squares = own @ own.transpose(0, 2, 1) + across @ across.transpose(0, 2, 1)
    squares += _PLAIN * np.trace(squares, axis1=1, axis2=2).mean() * np.eye(own.shape[1])
    beside = across @ ahead.transpose(0, 2, 1)
    pull = -(own @ slope[..., None])
    pull[:-1] -= across[:-1] @ slope[1:, :, None]
    for e in range(len(own) - 1):
        solved = np.linalg.solve(squares[e], np.hstack([beside[e], pull[e]]))
        squares[e + 1] -= beside[e].T @ solved[:, :-1]
        pull[e + 1] -= beside[e].T @ solved[:, -1:]
        beside[e], pull[e] = solved[:, :-1], solved[:, -1:]
    pull[-1] = np.linalg.solve(squares[-1], pull[-1])
    for e in reversed(range(len(own) - 1)):
        pull[e] -= beside[e] @ pull[e + 1]
    found = pull[..., 0]
    on_sides = -found[:, _NODES:].reshape(-1, 2, _NODES).transpose(0, 2, 1)
    return found[:, :_NODES].ravel()[:-1], on_sides.reshape(-1, 2)


def _list_rows(
    grid: Grid, sides: LimitSides, corners: _Corners, scale: Array, units: Units
) -> tuple[Array, Array]:
    """Rows of each element, and what they are of the next one's unknowns, (E, 3 p + 3, 3 p + 3).

    Unknowns are b, a and the squeeze at its nodes; rows are the links to each next node and the
    sides that meet at its nodes.
    """
    count, inner = len(grid.kinds), np.arange(DEGREE)
    lengths = np.diff(grid.edges) / units.length
    own = np.zeros((count, 3 * _NODES, 3 * _NODES))
    across = np.zeros_like(own)
    own[:, inner, inner], own[:, inner, inner + 1] = -1.0, 1.0
    own[:, :DEGREE, _NODES : 2 * _NODES] = -lengths[..., None] * find_basis().links[grid.kinds]
    own[:-1, DEGREE, DEGREE], across[:-1, DEGREE, 0] = -1.0, 1.0
    # Where s'' jumps the duration does not depend on the speed.
    own[corners.jumps, DEGREE], across[corners.jumps, DEGREE] = 0.0, 0.0
    k = np.arange(len(grid.s))[:, None]
    speed = np.sqrt(np.maximum(corners.profile.b, LEAST_B * units.profile[0]))[:, None]
    of_b = (sides.bend + sides.drag / (2 * speed))[k, corners.sides]
    parts = np.stack([of_b, sides.rate[k, corners.sides], sides.press[k, corners.sides]], axis=-1)
    parts *= scale[corners.sides][..., None] * units.profile
    parts[corners.held] = 0.0
    parts[corners.held, 0, 0] = -1.0
    parts = parts.reshape(count, _NODES, 2, 3)
    node = np.arange(_NODES)
    for side in range(2):
        for unknown in range(3):
            rows, columns = node + (1 + side) * _NODES, node + unknown * _NODES
            own[:, rows, columns] = parts[:, :, side, unknown]
    own[0, :, 0] = own[-1, :, DEGREE] = 0.0
    return own, across


def _find_slopes(grid: Grid, profile: Profile, units: Units) -> Array:
    """How the duration depends on b and a at the nodes of each element, (E, 3 p + 3).

    Of the quadrature of `terms`.
    """
    basis, count = find_basis(), len(grid.kinds)
    b, a = (profile.b / units.profile[0], profile.a / units.profile[1])
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
    return slope.reshape(count, -1)
