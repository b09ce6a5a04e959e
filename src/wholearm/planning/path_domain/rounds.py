"""Solving along curves on a mesh, and what a solution says of a better mesh."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from ...common.arrays import Array
from ..options import Objective
from ..phase_plan import PhasePlan
from .data import PhaseData, cut
from .elements import Elements, follow
from .fastest import Fastest, find_fastest
from .first_guess import guess
from .fitting import fit_torque
from .mesh import MOST, SHIFTED, SLOW_MOST, Mesh, adapt
from .misses import Misses, PathSolution, anticipate, price
from .motion import PathMotion
from .motor_switches import find_motor_switches
from .nlp import PathNLP, Tightening, Units
from .ramps import ramp_up
from .solving import center, move_multipliers, solve
from .start import balance, start_at
from .task import EARLY, Task

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
    """A mesh, and what is known on it.

    Attributes
    ----------
    task : Task
    elements : int
        Of each phase.
    meshes : tuple of Mesh
    parts : list of PhaseData
    data : PhaseData
        All phases as one.
    nlp : PathNLP
    units : Units
    solution : PathSolution
        The last one, or where to start.
    tightening : Tightening
        By how much limits are tightened for that.
    fastest : Fastest or None
        The motion of a sweep, near which plans are looked for.
    duration : float or None, [s]
        What the NLP may take for the duration, which is longer than allowed if it errs so.
    shift : float
        How far switches seem to be from the mesh's breaks, over the curve's length.
    eased : Round or None
        What other meshes start from with slow motors: a solution inside the limits.
    """

    task: Task
    elements: int
    meshes: tuple[Mesh, ...]
    parts: list[PhaseData]
    data: PhaseData
    nlp: PathNLP
    units: Units
    solution: PathSolution
    tightening: Tightening
    fastest: Fastest | None
    duration: float | None
    shift: float = np.inf
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
        dearer : bool
            Whether tightening limits has turned out to be dearer than it may be.
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
