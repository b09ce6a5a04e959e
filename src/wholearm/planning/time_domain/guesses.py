"""Initial guesses of phases that are one NLP: one ordered list, each with its name.

A guess follows a path from geometry alone, from rest to rest in time, or a plan. Contact modes are
those of the path, or those of a motion with smoothed friction, tanh(rate / onset) in place of the
sign (friction homotopy), which needs no modes and is split into stages by the signs of its rates. A
contact whose rate rests for a while with smoothed friction, so that this is not all used, rolls.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import combinations, groupby, islice, pairwise
from operator import attrgetter, truediv
from typing import Any, NamedTuple

import numpy as np

from ...common.arrays import Array, find_runs, interpolate
from ...common.errors import InputError
from ...contacts.contact_limits import list_renamed
from ...contacts.formation import CurvePoint, Formation
from ...geometry.curve import describe_pose, find_tied, tangent_basis
from ...geometry.path_guess import PathGuess, connect, find_end, guess_phase, is_inside, list_ends
from ...mechanics.dynamics import (
    ONE,
    A,
    B,
    Directions,
    close_contacts,
    force_rows,
    inverse,
    metric_weights,
)
from ...mechanics.limits import SPEED, MotionLimit, make_limits
from ...mechanics.path_limits import find_slack_rows, find_value_rows
from ...problem.definition import End, Phase, Problem
from ...results.trajectory import Motion
from ..path_domain.path_motion import PathMotion
from ..phase_plan import PhasePlan
from .mode_search import (
    LEAST_INTERVALS,
    can_roll,
    divide,
    drop,
    in_mode,
    link,
    merge,
    mode_of,
    release_earlier,
)
from .solution import TimeSearch, TimeSolution
from .stage import Scheme, Stage, StagePoints, unit_lengths, unit_points

NEAREST = "a motion to the nearest end of the phase"
GIVEN = "the contact modes that the problem gives"
LONGER = f"{NEAREST}, 4 times as long as a fall over that height"  # two routes are from it
SURE = 1e-3  # margin above which a motion keeps its limits
FALLS = 2.0  # guessed duration, over that of a fall over the path's length
AT_REST = 1e-4  # speed that counts as a stop, in the scene's own units
BRIEF = 0.05  # least duration of a piece over that of its stage
MOST = 8  # most pieces of a stage
_LIGHT = 0.5  # normal forces of an initial guess, over the weight of the object
_Change = tuple[float, dict[int, float]]  # place, share of a stage, and new signs of rows


class Guess(NamedTuple):
    """An initial guess."""

    name: str
    stages: list[Stage]
    homotopy: bool = False  # whether its modes come from the friction homotopy
    before: TimeSolution | None = None  # solution that the stages are from

    def end_at(self, z: Array, problem: Problem) -> Guess:
        """The same with a given end, shape (5,).

        Given are the coordinates that determine z well, those of the object first, whatever rolls
        in the end: the largest margin of `hexagon.toml` may end in a mode without freedoms.
        """
        N = tangent_basis(problem.phases[self.stages[-1].phase].formation, z)
        choices = [list(rows) for rows in combinations((0, 2, 1, 3, 4), N.shape[1])]
        sizes = np.array([abs(np.linalg.det(N[rows])) for rows in choices])
        pinned, stop = choices[int(np.argmax(sizes > 0.1 * sizes.max()))], np.full(5, np.nan)
        stop[pinned] = z[pinned]
        return self._replace(stages=[replace(stage, stop=stop) for stage in self.stages])

    @property
    def rests(self) -> bool:
        """Whether it is from rest to rest."""
        ends = self.stages[0].guess.nodes[0, 1], self.stages[-1].guess.nodes[-1, 1]
        return float(np.abs(ends).max()) < AT_REST

    def from_rest(self) -> Guess:
        """The same with a start at rest: plans of a block without stops pass there at speed."""
        first, *others = self.stages
        if np.abs(first.guess.nodes[0, 1]).max() < 1e-9:  # rounding
            return self
        return self._replace(stages=[first.begin_at(first.guess.nodes[0, 0], np.zeros(5)), *others])

    def by_homotopy(self) -> Guess:
        """The same path, in the modes of the friction homotopy."""
        name = f"{self.name} with friction that sets in gradually"
        return self._replace(name=name, homotopy=True)


@dataclass(frozen=True, eq=False)
class Guesses:
    """The guesses of a search's phases in their order, each made when it is its turn."""

    search: TimeSearch
    z: Array  # (5,): start

    @cached_property
    def nearest(self) -> Guess:
        """To the nearest end of each phase."""
        return Guess(NEAREST, self._guess())

    def list_given(self) -> list[Guess]:
        """In the contact modes and through the poses that the phases give; none if one has none.

        The motion is a cubic spline in time through the poses.
        """
        if not all(phase.guess for phase in self.search.phases):
            return []
        from scipy.interpolate import CubicSpline  # its import takes 0.3 s

        scales, t, z = self.search.source.scene.scales, [0.0], [self.z]
        for phase in self.search.phases:
            start, slip = t[-1], phase.formation.evaluate_slip(z[-1][None])[0]
            for mode in phase.guess or ():
                place = z[-1].copy()
                place[[0, 2]] = mode.x, mode.phi
                # With one freedom both may not agree to the last digit.
                free = phase.formation.n_constraints <= 3
                pins = ((0, mode.x), (2, mode.phi)) if free else ()
                closed = close_contacts(phase.formation, place, slip, pins)
                if closed is None:
                    text = f"the contacts do not close at {describe_pose(place)}"
                    raise InputError("", f"phases[{phase.number}].guess", text)
                t.append(start + mode.t)
                z.append(closed)
        own_t, own_z = np.array(t) / scales.time, np.array(z) / unit_lengths(scales)
        path = CubicSpline(own_t, own_z, bc_type="clamped")
        # Phase 19 of query 62 has no solution in given modes on the usual intervals.
        finer = (1,) if self.search.options.time_intervals else (1, 2)
        return [Guess(GIVEN, self._follow_given(path, factor)) for factor in finer]

    def _follow_given(self, path: Callable[..., Any], finer: int) -> list[Stage]:
        """Stages in given modes along a path z(t) in own units, on more intervals than usual."""
        scales, scheme = self.search.source.scene.scales, self.search.scheme
        stages, begin = list[Stage](), 0.0
        for stage, phase in zip(join_modes(self.nearest.stages), self.search.phases, strict=True):
            modes, intervals = phase.guess or (), finer * stage.intervals
            span = modes[-1].t / scales.time

            def follow(share: Array, begin: float = begin, span: float = span) -> list[Array]:
                return [path(begin + share * span, order) for order in range(3)]

            points = _add_forces(stage.formation, stage.directions, scheme, intervals, span, follow)
            lasts = [list(group)[-1] for _, group in groupby(modes, key=attrgetter("signs"))]
            edges = [0.0, *(mode.t / modes[-1].t for mode in lasts)]
            signs = [mode.signs for mode in lasts]
            stages += divide(replace(stage, guess=points), scheme, edges, signs)
            begin += span
        return self._leave_room(link(merge(stages)))

    def along(self, plans: Sequence[PhasePlan[Motion]]) -> Guess:
        """Along plans of the phases on their curves, or over time with other torques."""
        if over_time := list_stages(plans):
            problem = self.search.problem
            for k in reversed(range(len(over_time))):
                # Torques that may not step release a contact at the end of its phase.
                own = problem.phases[over_time[k].phase].formation.contacts
                if over_time[k].formation.contacts != own:
                    over_time = drop(over_time, k) or over_time
            over_time = link([stage.move_to(problem.scene) for stage in over_time])
            return self.resume("the plan with free torques", over_time)
        units, scheme = unit_points(self.search.source.scene.scales), self.search.scheme
        controls, stages = np.linspace(0.0, 1.0, scheme.controls), list[Stage]()
        for stage, plan in zip(join_modes(self.nearest.stages), plans, strict=True):
            motion = plan.motion
            assert isinstance(motion, PathMotion)
            rolling = list(stage.formation.rolling_rows)
            for start, stop, directions in motion.spans:
                span = stop - start
                count = max(LEAST_INTERVALS, round(span / motion.duration * stage.intervals))
                if period := self.search.source.scene.control_period:
                    count = max(count, math.ceil(span / period))
                breaks = np.linspace(0.0, 1.0, count + 1)
                inner = (breaks[:-1, None] + x / count for x in (scheme.points, controls))
                points, between, ends = (
                    [
                        samples.reshape(*x.shape, -1)
                        for samples in motion.evaluate(start + span * x.ravel())
                    ]
                    for x in (*inner, breaks)
                )
                z, v, a, _, c_n, c_t = points
                h, nodes = np.full(count, span / count), np.stack(ends[:2], axis=1)
                c = np.concatenate([c_n, c_t[..., rolling]], axis=2)
                part = StagePoints(h, nodes, z, v, a, c, between[3], np.zeros(0))
                signs = np.concatenate(directions)
                signs[rolling] = 0.0
                guess = StagePoints(*map(truediv, part, units))
                stages.append(in_mode(replace(stage, guess=guess), tuple(signs.tolist())))
        return Guess("the plan along curves", self._leave_room(link(stages)))

    def without_stops(self, plans: Sequence[PhasePlan[Motion]]) -> Guess:
        """Along plans of the phases, each of them from rest to rest."""
        stages = list[Stage]()
        for own, plan in zip(join_modes(self.nearest.stages), plans, strict=True):
            given: Any = {"phase": own.phase, "goal": own.goal, "released": own.released}
            for stage in list_stages([plan]):
                monitored = tuple(sorted({*stage.monitored, *own.released}))
                stages.append(replace(stage, monitored=monitored, **given))
        # From the limits themselves the solver takes longer.
        slower = [stage.stretch(1.05) for stage in link(stages)]
        return self.resume("a motion with stops between the phases", slower)

    def straight(self, goal: Array) -> Guess | None:
        """Straight to an end of a single phase with two freedoms, in the modes of that path."""
        outline = self._connect(goal) if self._is_planar() else None
        margin = find_margin(outline, self.search.source.epsilon, paced=True) if outline else None
        if not outline or not margin or margin.value <= -0.3:  # not near a motion
            return None
        return self._follow("a motion straight to the end", outline, margin.profile)

    @cached_property
    def paths(self) -> list[tuple[PathMargin, PathGuess]]:
        """Straight paths to the ends of a single phase, those first that keep limits most."""
        goals = self._list_goals() if self._is_planar() else []
        outlines = [guess for goal in goals if (guess := self._connect(goal))]
        margins = [find_margin(outline, self.search.source.epsilon) for outline in outlines]

        def rank(path: tuple[PathMargin, PathGuess]) -> tuple[float, float]:
            """Feasible paths by their length, others by their margin."""
            (margin, *_), outline = path
            return (-SURE, outline.length) if margin > SURE else (-margin, 0.0)

        pairs = zip(margins, outlines, strict=True)
        return sorted(((margin, path) for margin, path in pairs if margin), key=rank)

    def to_others(self, least: float = -math.inf) -> Iterator[Guess]:
        """Along the first of these paths, and the one of the largest margin, with margins above."""
        name = "a motion straight to another end"
        best = int(np.argmax([margin.value for margin, _ in self.paths] or [0.0]))
        # No plan is found from the first of them in scene 327 of the stress study, seed 1128.
        pairs = enumerate(self.paths)
        others = [path for k, path in pairs if (k < 3 or k == best) and path[0].value > least]
        return (self._follow(name, outline) for _, outline in others)

    def _is_planar(self) -> bool:
        """Whether there is a single phase, with two freedoms, that does not end by a release."""
        phase, *others = self.search.phases
        free = tangent_basis(phase.formation, self.z).shape[1]
        return free == 2 and not (others or phase.until.is_release)

    def _connect(self, goal: Array) -> PathGuess | None:
        """The straight path to an end; None if it is obstructed."""
        formation = self.search.phases[0].formation
        outline = connect(formation, self.z, goal)
        moves = np.diff(outline.z, axis=0).any(axis=1).all()
        free = formation.evaluate_limits(outline.z).min() > -formation.scene.touching
        return outline if moves and free else None

    def _follow(self, name: str, outline: PathGuess, profile: PathSpeed | None = None) -> Guess:
        """Along a path in its modes."""
        return Guess(name, self._guess(pieces=split_path(outline), profile=profile))

    def resume(self, name: str, stages: Sequence[Stage]) -> Guess:
        """From a solution with nearly the same start."""
        first, *others = stages
        start = self.nearest.stages[0].guess.nodes[0, 0]
        begun = first.begin_at(start, first.guess.nodes[0, 1])
        return Guess(name, self._leave_room([begun, *others]))

    def every(self, goal: Array | None = None) -> Iterator[Guess]:
        """All in their order; `goal`: the end of the first, straight one, or that of pins."""
        given = goal is not None
        if not given and self._is_planar() and self.search.phases[0].until.pins:
            goal = find_end(self.search.phases[0], self.z)
        straight = None if goal is None else self.straight(goal)
        if straight is not None:
            yield straight
        yield self.nearest
        # Case: phases 5 and 6 of `heptagon.toml` with friction 0.06.
        name = "a motion that releases a contact earlier"
        yield from (Guess(name, stages) for stages in release_earlier(self.nearest.stages))
        yield self.nearest.by_homotopy()
        if given:
            # Case: phase 5 of the route of query 172, which has a plan from there alone.
            yield from islice(self.to_others(SURE), 1)
        else:
            yield from self.to_others()
            yield Guess(LONGER, self._guess(falls=2 * FALLS))

    def on_finer_intervals(self) -> Iterator[Guess]:
        """The longest of them on twice as many intervals, unless their number is given.

        Case: scene 486 of the stress study, seed 1128.
        """
        if self.search.options.time_intervals is None:
            name = f"{LONGER}, on twice as many intervals"
            yield Guess(name, self._guess(falls=2 * FALLS, finer=2))

    def _list_goals(self) -> list[Array]:
        """Ends of a phase: the nearest, (5,), and others on both sides of it."""
        (phase,) = self.search.phases
        formation, nearest = phase.formation, find_end(phase, self.z)
        metric = np.sqrt(metric_weights(formation.scene))
        step = 0.15 * float(np.linalg.norm((nearest - self.z) * metric))  # over that path
        slip, ends = formation.evaluate_slip(self.z[None])[0], list_ends(phase)
        N = tangent_basis(formation, nearest) * metric[2] / metric[:, None] ** 2

        def project(guess: Array, last: Array, step: float) -> Array | None:
            for end in ends:
                goal = close_contacts(end.formation, guess, slip, end.fixed, end.active)
                if goal is None or not is_inside(end.formation, goal):
                    continue
                if 0.2 * step < np.linalg.norm((goal - last) * metric) < 5 * step:
                    return goal
            return None

        goals, sides = [nearest], list[Array]()
        for secant in (*N.T, *-N.T):
            last, length = nearest, step
            for _ in range(12):  # most ends on either side of the nearest one
                goal = project(last + length * secant, last, length)
                if goal is None:
                    break
                if last is nearest:
                    # Directions across the ends lead back to the same.
                    if any((goal - nearest) @ (side - nearest) > 0 for side in sides):
                        break
                    sides.append(goal)
                goals.append(goal)
                secant = (goal - last) * metric
                secant = secant / np.linalg.norm(secant) / metric
                last, length = goal, 1.2 * length  # ratio of successive distances
        return goals

    def _guess(self, **path: Any) -> list[Stage]:
        return self._leave_room(guess_stages(self.search, self.z, **path))

    def _leave_room(self, stages: list[Stage]) -> list[Stage]:
        """The stages, with an end clear of the contact that ends what follows: goal 50."""
        if self.search.to_go is None:
            return stages
        last, contact = stages[-1], self.search.to_go.phase.until.contact
        rows = [k for k, limit in enumerate(last.formation.limits) if limit.gains(contact)]
        monitored = tuple(sorted({*last.monitored, *rows}))
        return [*stages[:-1], replace(last, apart=tuple(rows), monitored=monitored)]


def list_stages(plans: Sequence[PhasePlan[Motion]]) -> list[Stage]:
    """The stages of plans over time, in the scene's own units."""
    return [stage for plan in plans for stage in plan.stages if isinstance(stage, Stage)]


class PathSpeed(NamedTuple):
    """Speed profile along a path."""

    t: Array  # (n,) [s]
    s: Array  # (n,): share of the length
    v: Array  # (n,) [1/s]: its rate, piecewise linear in time
    forces: Array  # (n - 1, n_c + R): in the intervals, over the weight of the object

    def evaluate(self, passed: Array) -> tuple[Array, Array, Array]:
        """Share of the length at shares of the time, and its derivatives by these."""
        total = self.t[-1]
        k = np.clip(np.searchsorted(self.t, passed * total) - 1, 0, len(self.forces) - 1)
        begin, since = self.v[k], passed * total - self.t[k]
        gain = (np.diff(self.v) / np.diff(self.t))[k]
        place = self.s[k] + since * (begin + gain * since / 2)
        return place, total * (begin + gain * since), total**2 * gain


class PathMargin(NamedTuple):
    """Largest uniform margin of limits along a path at any speed, and the critical limit."""

    value: float
    limit: MotionLimit  # that with the largest sum of multipliers
    profile: PathSpeed | None  # a fast one with nearly that margin


def find_margin(outline: PathGuess, epsilon: float, paced: bool = False) -> PathMargin | None:
    """Largest margin along a path, by a linear programme; if `paced` also a speed profile.

    Unknowns are the squared speed b at the nodes, and the margin. Friction is against the path;
    viscous friction and limits of speeds are neglected.
    """
    from scipy.optimize import linprog

    formation, scene = outline.formation, outline.formation.scene
    dz, middles = np.diff(outline.z, axis=0), (outline.z[1:] + outline.z[:-1]) / 2
    runs = np.sqrt(dz**2 @ metric_weights(scene))[:, None]
    z_s, m = dz / runs, len(dz)
    z_ss = np.gradient(z_s, np.cumsum(runs) - runs[:, 0] / 2, axis=0)
    point = CurvePoint(middles, z_s, z_ss, formation.evaluate(middles, z_s))
    forces = inverse(formation, point, Directions.of(point.kinematics, z_s))
    limits = make_limits(formation, epsilon).without(SPEED)
    slack = find_slack_rows(limits, find_value_rows(limits, forces, z_s[:, 3:]))
    # In the intervals, s'' and s'^2 of b over the scene's squared speed; the margin is the last.
    nodes, size = scene.scales.speed**2 * np.eye(m + 1, m + 2), m + 2
    motion = np.stack([np.diff(nodes, axis=0) / (2 * runs), (nodes[1:] + nodes[:-1]) / 2], axis=1)
    rows = -(slack[..., [A, B]] @ motion)
    rows[..., -1] = 1.0
    inequalities = rows.reshape(-1, size), slack[..., ONE].ravel()
    inside = [(0.0, 0.0), *[(0.0, 9.0)] * (m - 1), (0.0, 0.0)]  # the largest b

    def maximise(gain: Array, least: float | None) -> Any:
        every = [*inside, (least, 1.0)]
        return linprog(-gain, *inequalities, bounds=every, method="highs")

    answer = maximise(np.eye(size)[-1], None)
    if answer.status != 0:
        return None
    shares = np.abs(answer.ineqlin.marginals).reshape(m, -1).sum(axis=0)
    totals = np.bincount(limits.owners[limits.sides[0]], shares)
    margin, profile = float(answer.x[-1]), None
    # A fast one may lose half of a positive margin, and a little of a negative one.
    speeds, least = np.where(np.arange(size) <= m, 1.0, 0.0), min(0.5 * margin, margin - 0.02)
    fast = maximise(speeds, least) if paced else None
    if fast is not None and fast.status == 0:
        v = scene.scales.speed * np.sqrt(np.maximum(fast.x[: m + 1], 0.0))
        slow = 0.02 * scene.scales.speed  # least sum of speeds at both ends of a piece
        t = np.append(0.0, np.cumsum(2 * runs[:, 0] / np.maximum(v[1:] + v[:-1], slow)))
        length = np.append(0.0, np.cumsum(runs))
        moving = np.einsum("nci,ni->nc", forces.of_c[..., [A, B]], motion @ fast.x)
        c = forces.of_c[..., ONE] + moving
        profile = PathSpeed(t, length / length[-1], v / length[-1], c / scene.scales.force)
    return PathMargin(margin, limits.limits[int(totals.argmax())], profile)


def split_path(outline: PathGuess) -> list[PathGuess]:
    """A path as pieces between reversals, of which no two coincide: there motion would stop.

    By signs along the motion, as of the homotopy, goal 52 takes 0.6 % longer.
    """
    z, formation = outline.z, outline.formation
    steps, middles = np.diff(z, axis=0), (z[1:] + z[:-1]) / 2
    slip = np.einsum("nij,nj->ni", formation.evaluate(middles, steps).A_t, steps)
    rates = np.hstack([slip, steps[:, 3:]])
    signs = np.where(rates < 0, -1.0, 1.0)
    signs[:, list(formation.rolling_rows)] = 1.0
    cuts = [0]
    for k in range(1, len(signs)):
        if (signs[k] != signs[cuts[-1]]).any():
            if k - cuts[-1] < 2:  # fewest steps of a piece
                signs[cuts[-1] : k] = signs[k]
            else:
                cuts.append(k)
    if len(signs) - cuts[-1] < 2 and len(cuts) > 1:
        signs[cuts.pop() :] = signs[cuts[-1]]
    stretches, part = list[PathGuess](), z[:1]
    for begin, stop in pairwise([*cuts, len(signs)]):
        stretch_signs, part = signs[begin].copy(), np.concatenate([part, z[begin + 1 : stop]])
        turning = list[tuple[int, ...]]()
        if stop < len(signs):
            # Tied rows together, in order of time.
            turns = np.flatnonzero(stretch_signs != signs[stop]).tolist()
            tied = (find_tied(formation, z[stop], row) for row in turns)
            before, after = rates[stop - 1 : stop + 1]
            share = np.full(len(before), 0.5)
            np.divide(before, before - after, out=share, where=before * after < 0)
            groups = {tuple(sorted({*rows} & {*turns})) for rows in tied}
            turning = sorted(groups, key=lambda group: (share[group[0]], group))
        # The reversals are within the steps before and after the cut.
        places = stop - 0.5 + (np.arange(len(turning)) + 1) / (len(turning) + 1)
        for rows, place in zip(turning, places, strict=True):
            k = int(place)
            end = z[k] + (place - k) * (z[k + 1] - z[k]) if len(turning) > 1 else z[stop]
            if len(part) == 1:
                part = np.stack([part[0], (part[0] + end) / 2])
            stretches.append(_make_stretch(formation, np.vstack([part, end]), stretch_signs, rows))
            stretch_signs[list(rows)] *= -1
            part = end[None]
    stretches.append(_make_stretch(formation, np.vstack([part, z[-1:]]), stretch_signs, ()))
    return stretches


def _make_stretch(formation: Formation, z: Array, signs: Array, rows: Sequence[int]) -> PathGuess:
    Xi, sigma = np.split(signs.copy(), [formation.n_contacts])
    return PathGuess(formation, z, Directions(Xi, sigma), tuple(rows))


def find_modes(search: TimeSearch, stages: Sequence[Stage]) -> TimeSolution:
    """Solution by friction homotopy, with stages in its modes."""
    stages = link(join_modes(stages))
    solution: TimeSolution | None = None
    for onset in (0.1, 0.03):  # in the scene's unit
        solution = search.solve([replace(stage, onset=onset) for stage in stages], solution, 50)
        if not solution.success:
            return solution
        stages = solution.stages
    assert solution is not None
    pieces = [split_by_signs(stage, search.scheme) for stage in stages]
    if not all(pieces):
        status = "with friction that sets in gradually things turn too often"
        return solution._replace(status=status, success=False)
    exact = [replace(piece, onset=0.0) for parts in pieces for piece in parts]
    return solution._replace(stages=link(merge(exact)))


def join_modes(stages: Sequence[Stage]) -> list[Stage]:
    """One stage for each phase, in the mode of its first one."""
    modes = [mode_of(next(s for s in stages if s.phase == stage.phase)) for stage in stages]
    return merge([in_mode(*pair) for pair in zip(stages, modes, strict=True)])


def split_by_signs(stage: Stage, scheme: Scheme) -> list[Stage]:
    """Pieces of a stage in the modes of its rates, which have to be linked; none if too many."""
    signs, changes = _find_changes(stage, scheme)
    if len(changes) >= MOST:
        return []
    # Changes that coincide are moved apart: otherwise the motion would have to stop.
    widths = np.diff([0.0, *(place for place, _ in changes), 1.0])
    widths = np.maximum(widths, min(BRIEF / 2, 0.5 / len(widths)))
    edges = [0.0, *np.cumsum(widths / widths.sum())[:-1].tolist(), 1.0]
    modes = [tuple(signs)]
    for _, new in changes:
        modes.append(tuple(new.get(row, sign) for row, sign in enumerate(modes[-1])))
    return [*divide(stage, scheme, edges, modes)]


def _find_changes(stage: Stage, scheme: Scheme) -> tuple[list[float], list[_Change]]:
    """Initial signs of rates, (n_c + 2,), and their changes in order of time.

    Signs that hold for less than a brief time are those before.
    """
    part, formation = stage.guess, stage.formation
    places, z = part.places(scheme.points).ravel(), part.z.reshape(-1, 5)
    rates = stage.measure_senses(z, part.v.reshape(-1, 5)) * np.concatenate(stage.directions)
    sizes = np.abs(rates).max(axis=1)
    # Signs of other rates, and all where nothing moves, are undetermined.
    clear = (np.abs(rates) > 1e-5 * sizes[:, None]) & (sizes > 1e-4 * sizes.max())[:, None]
    first, every = np.array(mode_of(stage)), list[tuple[float, int, float]]()
    for row, rate in enumerate(rates.T):
        points = np.flatnonzero(clear[:, row])
        if not len(points) or first[row] == 0:
            continue
        signs = np.sign(rate)
        if stage.onset and can_roll(formation, z[len(z) // 2], row):
            rests = np.abs(np.tanh(rate / stage.onset)) < 0.2  # little friction is used
            for run in find_runs(rests):
                if places[run.stop - 1] - places[run.start] > 0.1:  # long enough to roll
                    signs[run] = 0.0
        runs = [(0.0, float(signs[points[0]]))]
        for i, j in pairwise(points.tolist()):
            if signs[i] != signs[j]:
                share = rate[i] / (rate[i] - rate[j]) if rate[i] * rate[j] < 0 else 0.5
                runs.append((float(places[i] + share * (places[j] - places[i])), float(signs[j])))
        while len(runs) > 1:
            lasts = np.diff([place for place, _ in runs] + [1.0])
            if lasts.min() >= BRIEF:
                break
            k = int(lasts.argmin())
            runs = [(0.0, runs[1][1]), *runs[2:]] if k == 0 else runs[:k] + runs[k + 1 :]
            runs = [run for n, run in enumerate(runs) if not n or run[1] != runs[n - 1][1]]
        first[row] = runs[0][1]
        every += [(place, row, sign) for place, sign in runs[1:]]
    changes, near = list[_Change](), 2 * float(np.diff(places).max())
    for place, row, sign in sorted(every):
        before, rows = changes[-1] if changes else (-1.0, {})
        tied = find_tied(formation, z[int(np.abs(places - place).argmin())], row)
        if place - before < near and row not in rows and set(rows) & set(tied):
            rows[row] = sign
        else:
            changes.append((place, {row: sign}))
    # Where all rates reverse near each other the motion stops: that is one change (goal 53).
    joined, count = list[_Change](), int(np.count_nonzero(first))
    while changes:
        close = [change for change in changes if change[0] < changes[0][0] + near]
        rows = {row: sign for _, turns in close for row, sign in turns.items()}
        if len(rows) == sum(len(turns) for _, turns in close) == count:
            joined.append((close[len(close) // 2][0], rows))
            changes = changes[len(close) :]
        else:
            joined.append(changes.pop(0))
    return first.tolist(), joined


def guess_stages(
    search: TimeSearch,
    z: Array,
    pieces: Sequence[PathGuess] | None = None,
    profile: PathSpeed | None = None,
    falls: float = FALLS,
    finer: int = 1,
) -> list[Stage]:
    """Stages of phases in one NLP, with an initial guess, in the scene's own units.

    The guessed duration is `falls` times that of a fall over the length of the initial paths, and
    there are `finer` times as many intervals as usual. A single phase may follow the pieces of a
    given one, with its speed profile.
    """
    scene, phases, options = search.source.scene, search.phases, search.options
    parts = list[tuple[Phase, PathGuess]]()  # in own units
    for k, phase in enumerate(phases):
        outlines = list(pieces or guess_phase(phase, z, phases[k + 1 :]))
        if parts and parts[-1][0].end is End.SMOOTH:
            outlines = [*_turn_first(outlines[0], parts[-1][1]), *outlines[1:]]
        z, scaled = outlines[-1].z[-1], search.problem.phases[phase.index]
        for piece in outlines:
            own_z = piece.z / unit_lengths(scene.scales)
            parts.append((scaled, replace(piece, formation=scaled.formation, z=own_z)))
    lengths = np.array([outline.length for _, outline in parts])
    ends = np.concatenate([[0.0], np.cumsum(lengths)]) / lengths.sum()
    # The path parameter of the guess is (1 - cos) / 2 over all stages.
    total = falls * float(np.sqrt(lengths.sum()))
    clock = np.arccos(1 - 2 * np.clip(ends, 0.0, 1.0)) / np.pi
    if profile is not None:
        total = float(profile.t[-1]) / scene.scales.time
        clock = np.interp(ends, profile.s, profile.t / profile.t[-1])
    stages: list[Stage] = []
    released: tuple[int, ...] = ()
    for k, (phase, outline) in enumerate(parts):
        ahead = None
        if phase.until.value is not None:
            start = next(other.z[0] for owner, other in parts if owner is phase)
            row, value = phase.until.lead(start, 1.0).poses[0]
            ahead = row, value, 1.0 if value > start[row] else -1.0
        whole = lengths[[owner is phase for owner, _ in parts]].sum()
        intervals = finer * (options.time_intervals or 10)  # of a phase to start with
        count = max(LEAST_INTERVALS, round(lengths[k] / whole * intervals))
        along = clock[k : k + 2], ends[k : k + 2], total, profile
        guess = _guess(outline, search.scheme, count, *along)
        # Limits near zero along the path, and that of the phase's end.
        near = phase.formation.evaluate_limits(outline.z).min(axis=0) < 0.02
        near |= [limit.gains(phase.until.contact) for limit in phase.formation.limits]
        before = parts[k - 1][0]
        opens = k > 0 and before is not phase
        if opens:
            touching = np.abs(phase.formation.evaluate_limits(outline.z[:1])[0]) < 1e-5  # closed
            contacts = before.formation.contacts, phase.formation.contacts
            renamed = list_renamed(scene, *contacts)
            closed, limits = np.flatnonzero(touching).tolist(), phase.formation.limits
            released = tuple(row for row in closed if limits[row].gained not in renamed)
        stages.append(
            Stage(
                phase.index,
                phase.formation,
                outline.directions,
                guess,
                goal=None if phase.until.is_release else phase.until,
                impact=phase.end is End.IMPACT and phase is not parts[-1][0],
                monitored=tuple(sorted({*np.flatnonzero(near).tolist(), *released})),
                released=released,
                opening=None if opens and before.end is End.IMPACT else options.opening,
                clearance=options.clearance,
                ahead=ahead,
            )
        )
    return link(stages)


def _guess(
    outline: PathGuess,
    scheme: Scheme,
    count: int,
    clock: Array,
    ends: Array,
    total: float,
    profile: PathSpeed | None,
) -> StagePoints:
    """Motion along an initial path, with normal forces nearest to equal ones without a profile.

    `clock` and `ends` are shares of the time `total` [s] and length of all stages at both ends.
    """
    formation = outline.formation
    knots = np.linspace(0.0, 1.0, len(outline.z))
    slopes = np.gradient(outline.z, knots, axis=0)
    bends = np.gradient(slopes, knots, axis=0)
    breaks = np.linspace(0.0, 1.0, count + 1)

    def follow(share: Array) -> tuple[Array, Array, Array]:
        passed = clock[0] + share * (clock[1] - clock[0])
        span, turn = max(ends[1] - ends[0], 1e-12), np.pi * passed
        place, rate, gain = (
            ((1 - np.cos(turn)) / 2, np.pi / 2 * np.sin(turn), np.pi**2 / 2 * np.cos(turn))
            if profile is None
            else profile.evaluate(passed)
        )
        place = (place - ends[0]) / span
        rate, gain = rate[..., None] / (span * total), gain[..., None] / (span * total**2)
        tables = outline.z, slopes, bends
        z, slope, bend = (interpolate(place, knots, table) for table in tables)
        return z, slope * rate, slope * gain + bend * rate**2

    duration, c = total * (clock[1] - clock[0]), None
    if profile is not None:
        at = breaks[:-1, None] + scheme.points / count
        passed = clock[0] + at.ravel() * (clock[1] - clock[0])
        indices = np.searchsorted(profile.t / profile.t[-1], passed) - 1
        c = profile.forces[np.clip(indices, 0, len(profile.forces) - 1)]
    return _add_forces(formation, outline.directions, scheme, count, duration, follow, c)


def _add_forces(
    formation: Formation,
    directions: Directions,
    scheme: Scheme,
    count: int,
    duration: float,
    follow: Callable[[Array], Sequence[Array]],
    c: Array | None = None,
) -> StagePoints:
    """A motion on `count` equal intervals, with forces `c`, (count d, n_c + R), and torques.

    `follow` takes shares of the `duration` and gives z, z' and z''. Without `c`, normal forces are
    those nearest to equal ones.
    """
    scene, breaks = formation.scene, np.linspace(0.0, 1.0, count + 1)
    z, v, a = follow(breaks[:-1, None] + scheme.points / count)
    # G^T c + S tau is what the equations of motion need.
    flat = [table.reshape(-1, 5) for table in (z, v, a)]
    G = force_rows(formation, formation.evaluate(*flat[:2]), directions)
    applied = scene.applied_force - scene.dry * np.append(np.zeros(3), directions.sigma)
    needed = scene.mass_diagonal * flat[2] + scene.viscous * flat[1] - applied
    if c is None:
        c = np.zeros((len(G), formation.n_constraints))
        c[:, : formation.n_contacts] = _LIGHT
        missing = needed[:, :3] - np.einsum("nij,ni->nj", G[:, :, :3], c)
        pairs = zip(G[:, :, :3], missing, strict=True)
        c += [np.linalg.lstsq(rows.T, short, rcond=1e-6)[0] for rows, short in pairs]
        c_n = c[:, : formation.n_contacts]
        c_n[:] = np.clip(c_n, 0.1 * _LIGHT, 20.0)
    # Torques of the motion, within limits, at about as many points as they have control points.
    tau = needed[:, 3:] - np.einsum("nij,ni->nj", G[:, :, 3:], c)
    limit = 0.9 * scene.torque_limit
    tau = np.clip(tau, -limit, limit).reshape(*z.shape[:2], 2)
    tau = tau[:, np.linspace(0, scheme.degree - 1, scheme.controls).round().astype(int)]
    h, nodes = np.full(count, duration / count), np.stack(follow(breaks)[:2], axis=1)
    return StagePoints(h, nodes, z, v, a, c.reshape(*z.shape[:2], -1), tau, np.zeros(0))


def _turn_first(outline: PathGuess, before: PathGuess) -> list[PathGuess]:
    """Split a path so that it starts in the sliding directions of the one before.

    Velocities are continuous, so that other directions need reversals along the path. Without it
    `heptagon.toml` takes half as long again to plan, and keeps less of a margin.
    """
    # Rolling contacts have no direction to keep.
    slides = np.delete(np.arange(before.formation.n_contacts), before.formation.rolling_rows)
    directions = {before.formation.names[k]: before.directions.Xi[k] for k in slides}
    outline_signs, formation = np.concatenate(outline.directions), outline.formation
    n_c = formation.n_contacts
    signs = outline_signs.copy()
    signs[n_c:] = before.directions.sigma
    for k in range(n_c):
        if k not in formation.rolling_rows:
            together = [formation.names[i] for i in formation.turn_with(k)]
            signs[k] = next((directions[name] for name in together if name in directions), signs[k])
    differing = np.flatnonzero(signs != outline_signs).tolist()
    turns = list(dict.fromkeys(formation.turn_with(k) for k in differing))
    pieces = []
    cuts = np.linspace(0, len(outline.z) - 1, len(turns) + 2).astype(int)
    for k, (begin, stop) in enumerate(pairwise(cuts)):
        turn = turns[k] if k < len(turns) else outline.turns
        pieces.append(_make_stretch(formation, outline.z[begin : stop + 1], signs, turn))
        if k < len(turns):
            signs[list(turns[k])] = outline_signs[list(turns[k])]
    return pieces
