"""Initial guesses of the NLP of phases: one ordered list of named guesses.

A guess follows a geometric path from rest to rest, or a plan. Contact modes are those of the path,
or those of a motion with smoothed friction, tanh(rate / smoothing) in place of the sign (friction
homotopy). That motion has no modes, and is split into stages by the signs of its rates. A contact
rolls over intervals in which its rate and its smoothed friction are small.
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
    MIN_INTERVALS,
    can_roll,
    divide,
    drop,
    link,
    merge,
    mode_of,
    release_earlier,
    with_mode,
)
from .solution import TimeSearch, TimeSolution
from .stage import Scheme, Stage, StagePoints, unit_lengths, unit_points

NEAREST_END = "a motion to the nearest end of the phase"
PROBLEM_MODES = "the contact modes that the problem gives"
LONG_DURATION = f"{NEAREST_END}, 4 times as long as a fall over that height"  # of two routes
MIN_MARGIN = 1e-3  # margin above which a path counts as feasible
FALL_TIMES = 2.0  # guessed duration, over that of a free fall over the path's length
REST_SPEED = 1e-4  # speed that counts as a stop, in the scene's units
MIN_FRACTION = 0.05  # least duration of a piece over that of its stage
MAX_PIECES = 8  # most pieces of a stage
_GUESS_FORCE = 0.5  # normal forces of an initial guess, over the weight of the object
_Change = tuple[float, dict[int, float]]  # place, fraction of a stage, and new signs of rows


class Guess(NamedTuple):
    """An initial guess of an NLP."""

    name: str
    stages: list[Stage]
    homotopy: bool = False  # whether its modes come from the friction homotopy
    previous: TimeSolution | None = None  # solution whose stages these are

    def end_at(self, z: Array, problem: Problem) -> Guess:
        """Copy with a prescribed end `z`, shape (5,).

        As many coordinates are prescribed as determine z well, those of the object first. Rolling
        contacts do not reduce their number: the largest margin of `hexagon.toml` may end in a mode
        without freedoms.
        """
        N = tangent_basis(problem.phases[self.stages[-1].phase].formation, z)
        choices = [list(rows) for rows in combinations((0, 2, 1, 3, 4), N.shape[1])]
        sizes = np.array([abs(np.linalg.det(N[rows])) for rows in choices])
        fixed, end_pose = choices[int(np.argmax(sizes > 0.1 * sizes.max()))], np.full(5, np.nan)
        end_pose[fixed] = z[fixed]
        return self._replace(stages=[replace(stage, end_pose=end_pose) for stage in self.stages])

    @property
    def is_rest_to_rest(self) -> bool:
        """Whether it begins and ends at rest."""
        ends = self.stages[0].guess.nodes[0, 1], self.stages[-1].guess.nodes[-1, 1]
        return float(np.abs(ends).max()) < REST_SPEED

    def from_rest(self) -> Guess:
        """Copy that starts at rest, as plans of a block without stops may start in motion."""
        first, *others = self.stages
        if np.abs(first.guess.nodes[0, 1]).max() < 1e-9:  # rounding
            return self
        return self._replace(stages=[first.begin_at(first.guess.nodes[0, 0], np.zeros(5)), *others])

    def by_homotopy(self) -> Guess:
        """Copy to be solved in the modes of the friction homotopy."""
        name = f"{self.name}, by friction homotopy"
        return self._replace(name=name, homotopy=True)


@dataclass(frozen=True, eq=False)
class Guesses:
    """Guesses of a search's phases, evaluated lazily."""

    search: TimeSearch
    z: Array  # (5,): start

    @cached_property
    def nearest(self) -> Guess:
        """Motion to the nearest end of each phase."""
        return Guess(NEAREST_END, self._guess())

    def list_problem_guesses(self) -> list[Guess]:
        """Guesses with the contact modes and poses of the phases; none if one phase has none.

        The motion is a cubic spline in time through the poses.
        """
        if not all(phase.guess for phase in self.search.phases):
            return []
        from scipy.interpolate import CubicSpline  # its import takes 0.3 s

        scales, t, z = self.search.source.scene.scales, [0.0], [self.z]
        for phase in self.search.phases:
            start, slip = t[-1], phase.formation.evaluate_slip(z[-1][None])[0]
            for mode in phase.guess or ():
                pose = z[-1].copy()
                pose[[0, 2]] = mode.x, mode.phi
                # With one freedom x and phi may disagree in the last digits.
                free = phase.formation.n_constraints <= 3
                pins = ((0, mode.x), (2, mode.phi)) if free else ()
                closed = close_contacts(phase.formation, pose, slip, pins)
                if closed is None:
                    text = f"the contacts do not close at {describe_pose(pose)}"
                    raise InputError("", f"phases[{phase.number}].guess", text)
                t.append(start + mode.t)
                z.append(closed)
        scaled_t, scaled_z = np.array(t) / scales.time, np.array(z) / unit_lengths(scales)
        path = CubicSpline(scaled_t, scaled_z, bc_type="clamped")
        # Phase 19 of query 62 has no solution in these modes on the usual number of intervals.
        factors = (1,) if self.search.options.time_intervals else (1, 2)
        return [Guess(PROBLEM_MODES, self._follow_modes(path, factor)) for factor in factors]

    def _follow_modes(self, path: Callable[..., Any], factor: int) -> list[Stage]:
        """Stages in the problem's modes along z(t), on `factor` times as many intervals."""
        scales, scheme = self.search.source.scene.scales, self.search.scheme
        stages, begin = list[Stage](), 0.0
        for stage, phase in zip(join_modes(self.nearest.stages), self.search.phases, strict=True):
            modes, intervals = phase.guess or (), factor * stage.intervals
            span = modes[-1].t / scales.time

            def follow(fraction: Array, begin: float = begin, span: float = span) -> list[Array]:
                return [path(begin + fraction * span, order) for order in range(3)]

            points = _add_forces(stage.formation, stage.directions, scheme, intervals, span, follow)
            last_modes = [list(group)[-1] for _, group in groupby(modes, key=attrgetter("signs"))]
            edges = [0.0, *(mode.t / modes[-1].t for mode in last_modes)]
            signs = [mode.signs for mode in last_modes]
            stages += divide(replace(stage, guess=points), scheme, edges, signs)
            begin += span
        return self._keep_clear(link(merge(stages)))

    def from_plans(self, plans: Sequence[PhasePlan[Motion]]) -> Guess:
        """Guess along plans of the phases on curves, or over time with free torques."""
        if time_stages := list_stages(plans):
            problem = self.search.problem
            for k in reversed(range(len(time_stages))):
                # Continuous torques release a contact at the end of its phase.
                contacts = problem.phases[time_stages[k].phase].formation.contacts
                if time_stages[k].formation.contacts != contacts:
                    time_stages = drop(time_stages, k) or time_stages
            time_stages = link([stage.move_to(problem.scene) for stage in time_stages])
            return self.resume("the plan with free torques", time_stages)
        units, scheme = unit_points(self.search.source.scene.scales), self.search.scheme
        controls, stages = np.linspace(0.0, 1.0, scheme.controls), list[Stage]()
        for stage, plan in zip(join_modes(self.nearest.stages), plans, strict=True):
            motion = plan.motion
            assert isinstance(motion, PathMotion)
            rolling = list(stage.formation.rolling_rows)
            for start, stop, directions in motion.spans:
                duration = stop - start
                count = max(MIN_INTERVALS, round(duration / motion.duration * stage.intervals))
                if period := self.search.source.scene.control_period:
                    count = max(count, math.ceil(duration / period))
                breaks = np.linspace(0.0, 1.0, count + 1)
                grids = (breaks[:-1, None] + x / count for x in (scheme.points, controls))
                points, at_controls, ends = (
                    [
                        samples.reshape(*x.shape, -1)
                        for samples in motion.evaluate(start + duration * x.ravel())
                    ]
                    for x in (*grids, breaks)
                )
                z, v, a, _, c_n, c_t = points
                h, nodes = np.full(count, duration / count), np.stack(ends[:2], axis=1)
                c = np.concatenate([c_n, c_t[..., rolling]], axis=2)
                part = StagePoints(h, nodes, z, v, a, c, at_controls[3], np.zeros(0))
                signs = np.concatenate(directions)
                signs[rolling] = 0.0
                guess = StagePoints(*map(truediv, part, units))
                stages.append(with_mode(replace(stage, guess=guess), tuple(signs.tolist())))
        return Guess("the plan along curves", self._keep_clear(link(stages)))

    def without_stops(self, plans: Sequence[PhasePlan[Motion]]) -> Guess:
        """Guess along plans of the phases, each from rest to rest."""
        stages = list[Stage]()
        for base, plan in zip(join_modes(self.nearest.stages), plans, strict=True):
            fields: Any = {"phase": base.phase, "goal": base.goal, "released": base.released}
            for stage in list_stages([plan]):
                monitored = tuple(sorted({*stage.monitored, *base.released}))
                stages.append(replace(stage, monitored=monitored, **fields))
        # Without the stretch the plan of goal 1 takes 3.9 % longer.
        stretched = [stage.stretch(1.05) for stage in link(stages)]
        return self.resume("a motion with stops between the phases", stretched)

    def guess_straight(self, goal: Array) -> Guess | None:
        """Guess straight to an end of a single phase with two freedoms; None if infeasible."""
        path = self._connect(goal) if self._is_planar() else None
        margin = find_margin(path, self.search.source.epsilon, with_profile=True) if path else None
        if not path or not margin or margin.value <= -0.3:  # not near a motion
            return None
        return self._follow("a motion straight to the end", path, margin.profile)

    @cached_property
    def paths(self) -> list[tuple[PathMargin, PathGuess]]:
        """Straight paths to the ends of a single phase with their margins, feasible ones first."""
        goals = self._list_goals() if self._is_planar() else []
        paths = [guess for goal in goals if (guess := self._connect(goal))]
        margins = [find_margin(path, self.search.source.epsilon) for path in paths]

        def rank(pair: tuple[PathMargin, PathGuess]) -> tuple[float, float]:
            """Feasible paths by their length, others by their margin."""
            (margin, *_), path = pair
            return (-MIN_MARGIN, path.length) if margin > MIN_MARGIN else (-margin, 0.0)

        pairs = zip(margins, paths, strict=True)
        return sorted(((margin, path) for margin, path in pairs if margin), key=rank)

    def to_other_ends(self, least: float = -math.inf) -> Iterator[Guess]:
        """Guesses along the first paths and that of the largest margin, if above `least`."""
        name = "a motion straight to another end"
        best = int(np.argmax([margin.value for margin, _ in self.paths] or [0.0]))
        # No plan is found from the first of them in scene 327 of the stress study, seed 1128.
        pairs = enumerate(self.paths)
        candidates = [pair for k, pair in pairs if (k < 3 or k == best) and pair[0].value > least]
        return (self._follow(name, path) for _, path in candidates)

    def _is_planar(self) -> bool:
        """Whether there is a single phase with two freedoms that does not end by a release."""
        phase, *others = self.search.phases
        free = tangent_basis(phase.formation, self.z).shape[1]
        return free == 2 and not (others or phase.until.is_release)

    def _connect(self, goal: Array) -> PathGuess | None:
        """The straight path to an end; None if it is obstructed."""
        formation = self.search.phases[0].formation
        path = connect(formation, self.z, goal)
        distinct = np.diff(path.z, axis=0).any(axis=1).all()
        clear = formation.evaluate_limits(path.z).min() > -formation.scene.touching
        return path if distinct and clear else None

    def _follow(self, name: str, path: PathGuess, profile: PathSpeed | None = None) -> Guess:
        """Guess along a path in its modes."""
        return Guess(name, self._guess(pieces=split_path(path), profile=profile))

    def resume(self, name: str, stages: Sequence[Stage]) -> Guess:
        """Guess from the stages of a solution with nearly the same start."""
        first, *others = stages
        start = self.nearest.stages[0].guess.nodes[0, 0]
        start_stage = first.begin_at(start, first.guess.nodes[0, 1])
        return Guess(name, self._keep_clear([start_stage, *others]))

    def list_all(self, goal: Array | None = None) -> Iterator[Guess]:
        """All guesses in their order; the first goes straight to `goal`, (5,), or a pinned end."""
        has_goal = goal is not None
        if not has_goal and self._is_planar() and self.search.phases[0].until.pins:
            goal = find_end(self.search.phases[0], self.z)
        guess = None if goal is None else self.guess_straight(goal)
        if guess is not None:
            yield guess
        yield self.nearest
        # Case: phases 5 and 6 of `heptagon.toml` with friction 0.06.
        name = "a motion that releases a contact earlier"
        yield from (Guess(name, stages) for stages in release_earlier(self.nearest.stages))
        yield self.nearest.by_homotopy()
        if has_goal:
            # Case: phase 5 of the route of query 172, which has a plan from there alone.
            yield from islice(self.to_other_ends(MIN_MARGIN), 1)
        else:
            yield from self.to_other_ends()
            yield Guess(LONG_DURATION, self._guess(fall_times=2 * FALL_TIMES))

    def on_more_intervals(self) -> Iterator[Guess]:
        """Guess of long duration on twice as many intervals, unless their number is prescribed.

        Case: scene 486 of the stress study, seed 1128.
        """
        if self.search.options.time_intervals is None:
            name = f"{LONG_DURATION}, on twice as many intervals"
            yield Guess(name, self._guess(fall_times=2 * FALL_TIMES, factor=2))

    def _list_goals(self) -> list[Array]:
        """Ends of a phase, (5,) each: the nearest, and others on both sides of it."""
        (phase,) = self.search.phases
        formation, nearest = phase.formation, find_end(phase, self.z)
        metric = np.sqrt(metric_weights(formation.scene))
        step = 0.15 * float(np.linalg.norm((nearest - self.z) * metric))  # over that path
        slip, ends = formation.evaluate_slip(self.z[None])[0], list_ends(phase)
        N = tangent_basis(formation, nearest) * metric[2] / metric[:, None] ** 2

        def project(guess: Array, previous: Array, step: float) -> Array | None:
            for end in ends:
                goal = close_contacts(end.formation, guess, slip, end.fixed, end.active)
                if goal is None or not is_inside(end.formation, goal):
                    continue
                if 0.2 * step < np.linalg.norm((goal - previous) * metric) < 5 * step:
                    return goal
            return None

        goals, first_goals = [nearest], list[Array]()
        for secant in (*N.T, *-N.T):
            previous, length = nearest, step
            for _ in range(12):  # most ends on either side of the nearest one
                goal = project(previous + length * secant, previous, length)
                if goal is None:
                    break
                if previous is nearest:
                    # Other directions may give the same ends.
                    if any((goal - nearest) @ (first - nearest) > 0 for first in first_goals):
                        break
                    first_goals.append(goal)
                goals.append(goal)
                secant = (goal - previous) * metric
                secant = secant / np.linalg.norm(secant) / metric
                previous, length = goal, 1.2 * length  # ratio of successive distances
        return goals

    def _guess(self, **path: Any) -> list[Stage]:
        return self._keep_clear(guess_stages(self.search, self.z, **path))

    def _keep_clear(self, stages: list[Stage]) -> list[Stage]:
        """The stages, at the end clear of the contact gained by the next phase (goal 50)."""
        if self.search.cost_to_go is None:
            return stages
        last_stage, contact = stages[-1], self.search.cost_to_go.phase.until.contact
        rows = [k for k, limit in enumerate(last_stage.formation.limits) if limit.gains(contact)]
        monitored = tuple(sorted({*last_stage.monitored, *rows}))
        return [*stages[:-1], replace(last_stage, clear_at_end=tuple(rows), monitored=monitored)]


def list_stages(plans: Sequence[PhasePlan[Motion]]) -> list[Stage]:
    """The stages of plans over time, in the scene's units."""
    return [stage for plan in plans for stage in plan.stages if isinstance(stage, Stage)]


class PathSpeed(NamedTuple):
    """Speed profile along a path."""

    t: Array  # (n,) [s]
    s: Array  # (n,): fraction of the length
    v: Array  # (n,) [1/s]: its rate, piecewise linear in time
    forces: Array  # (n - 1, n_c + R): in the intervals, over the weight of the object

    def evaluate(self, fraction: Array) -> tuple[Array, Array, Array]:
        """Fraction of the length at fractions of the duration, and its two derivatives."""
        duration = self.t[-1]
        k = np.clip(np.searchsorted(self.t, fraction * duration) - 1, 0, len(self.forces) - 1)
        speed, elapsed = self.v[k], fraction * duration - self.t[k]
        acceleration = (np.diff(self.v) / np.diff(self.t))[k]
        s = self.s[k] + elapsed * (speed + acceleration * elapsed / 2)
        return s, duration * (speed + acceleration * elapsed), duration**2 * acceleration


class PathMargin(NamedTuple):
    """Largest uniform margin of limits along a path at any speed, and the critical limit."""

    value: float
    limit: MotionLimit  # with the largest sum of multipliers
    profile: PathSpeed | None  # of a fast motion with nearly that margin


def find_margin(path: PathGuess, epsilon: float, with_profile: bool = False) -> PathMargin | None:
    """Largest uniform margin of the limits along a path, as a linear programme; None without one.

    Unknowns are the squared speed b at the nodes, and the margin. Friction is opposite to the path;
    viscous friction and speed limits are neglected.
    """
    from scipy.optimize import linprog

    formation, scene = path.formation, path.formation.scene
    dz, middles = np.diff(path.z, axis=0), (path.z[1:] + path.z[:-1]) / 2
    steps = np.sqrt(dz**2 @ metric_weights(scene))[:, None]
    z_s, m = dz / steps, len(dz)
    z_ss = np.gradient(z_s, np.cumsum(steps) - steps[:, 0] / 2, axis=0)
    point = CurvePoint(middles, z_s, z_ss, formation.evaluate(middles, z_s))
    forces = inverse(formation, point, Directions.of(point.kinematics, z_s))
    limits = make_limits(formation, epsilon).without(SPEED)
    slack = find_slack_rows(limits, find_value_rows(limits, forces, z_s[:, 3:]))
    # Rows of s'' and s'^2 in the intervals, for b over the scene's squared speed and the margin.
    nodes, size = scene.scales.speed**2 * np.eye(m + 1, m + 2), m + 2
    motion = np.stack([np.diff(nodes, axis=0) / (2 * steps), (nodes[1:] + nodes[:-1]) / 2], axis=1)
    rows = -(slack[..., [A, B]] @ motion)
    rows[..., -1] = 1.0
    A_ub, b_ub = rows.reshape(-1, size), slack[..., ONE].ravel()
    speed_bounds = [(0.0, 0.0), *[(0.0, 9.0)] * (m - 1), (0.0, 0.0)]  # the largest b

    def maximise(objective: Array, min_margin: float | None) -> Any:
        bounds = [*speed_bounds, (min_margin, 1.0)]
        return linprog(-objective, A_ub, b_ub, bounds=bounds, method="highs")

    solution = maximise(np.eye(size)[-1], None)
    if solution.status != 0:
        return None
    multipliers = np.abs(solution.ineqlin.marginals).reshape(m, -1).sum(axis=0)
    sums = np.bincount(limits.owners[limits.sides[0]], multipliers)
    margin, profile = float(solution.x[-1]), None
    # A fast motion may lose half of a positive margin, and 0.02 of a negative one.
    speeds, min_margin = np.where(np.arange(size) <= m, 1.0, 0.0), min(0.5 * margin, margin - 0.02)
    fastest = maximise(speeds, min_margin) if with_profile else None
    if fastest is not None and fastest.status == 0:
        v = scene.scales.speed * np.sqrt(np.maximum(fastest.x[: m + 1], 0.0))
        floor = 0.02 * scene.scales.speed  # least sum of speeds at both ends of a piece
        t = np.append(0.0, np.cumsum(2 * steps[:, 0] / np.maximum(v[1:] + v[:-1], floor)))
        length = np.append(0.0, np.cumsum(steps))
        c_motion = np.einsum("nci,ni->nc", forces.of_c[..., [A, B]], motion @ fastest.x)
        c = forces.of_c[..., ONE] + c_motion
        profile = PathSpeed(t, length / length[-1], v / length[-1], c / scene.scales.force)
    return PathMargin(margin, limits.limits[int(sums.argmax())], profile)


def split_path(path: PathGuess) -> list[PathGuess]:
    """Pieces of a path between reversals; no two of these coincide, as the motion would stop there.

    Case: with the signs of rates along the motion, as in the homotopy, goal 52 takes 0.6 % longer.
    """
    z, formation = path.z, path.formation
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
    pieces, part = list[PathGuess](), z[:1]
    for begin, stop in pairwise([*cuts, len(signs)]):
        piece_signs, part = signs[begin].copy(), np.concatenate([part, z[begin + 1 : stop]])
        reversals = list[tuple[int, ...]]()
        if stop < len(signs):
            # Tied rows together, in order of time.
            changed = np.flatnonzero(piece_signs != signs[stop]).tolist()
            tied = (find_tied(formation, z[stop], row) for row in changed)
            rate, next_rate = rates[stop - 1 : stop + 1]
            crossing = np.full(len(rate), 0.5)
            np.divide(rate, rate - next_rate, out=crossing, where=rate * next_rate < 0)
            groups = {tuple(sorted({*rows} & {*changed})) for rows in tied}
            reversals = sorted(groups, key=lambda group: (crossing[group[0]], group))
        # The reversals are within the steps before and after the cut.
        places = stop - 0.5 + (np.arange(len(reversals)) + 1) / (len(reversals) + 1)
        for rows, place in zip(reversals, places, strict=True):
            k = int(place)
            end = z[k] + (place - k) * (z[k + 1] - z[k]) if len(reversals) > 1 else z[stop]
            if len(part) == 1:
                part = np.stack([part[0], (part[0] + end) / 2])
            pieces.append(_make_piece(formation, np.vstack([part, end]), piece_signs, rows))
            piece_signs[list(rows)] *= -1
            part = end[None]
    pieces.append(_make_piece(formation, np.vstack([part, z[-1:]]), piece_signs, ()))
    return pieces


def _make_piece(formation: Formation, z: Array, signs: Array, rows: Sequence[int]) -> PathGuess:
    Xi, sigma = np.split(signs.copy(), [formation.n_contacts])
    return PathGuess(formation, z, Directions(Xi, sigma), tuple(rows))


def find_modes(search: TimeSearch, stages: Sequence[Stage]) -> TimeSolution:
    """Solution by friction homotopy, with its stages split into modes."""
    stages = link(join_modes(stages))
    solution: TimeSolution | None = None
    for width in (0.1, 0.03):  # in the scene's unit
        solution = search.solve([replace(stage, smoothing=width) for stage in stages], solution, 50)
        if not solution.success:
            return solution
        stages = solution.stages
    assert solution is not None
    pieces = [split_by_signs(stage, search.scheme) for stage in stages]
    if not all(pieces):
        status = "the friction homotopy has too many reversals"
        return solution._replace(status=status, success=False)
    exact = [replace(piece, smoothing=0.0) for parts in pieces for piece in parts]
    return solution._replace(stages=link(merge(exact)))


def join_modes(stages: Sequence[Stage]) -> list[Stage]:
    """One stage for each phase, in the mode of the phase's first stage."""
    modes = [mode_of(next(s for s in stages if s.phase == stage.phase)) for stage in stages]
    return merge([with_mode(*pair) for pair in zip(stages, modes, strict=True)])


def split_by_signs(stage: Stage, scheme: Scheme) -> list[Stage]:
    """Pieces of a stage in the modes of its rates, not linked; an empty list if too many."""
    signs, changes = _find_changes(stage, scheme)
    if len(changes) >= MAX_PIECES:
        return []
    # Simultaneous changes are separated: otherwise the motion would have to stop.
    widths = np.diff([0.0, *(place for place, _ in changes), 1.0])
    widths = np.maximum(widths, min(MIN_FRACTION / 2, 0.5 / len(widths)))
    edges = [0.0, *np.cumsum(widths / widths.sum())[:-1].tolist(), 1.0]
    modes = [tuple(signs)]
    for _, new_signs in changes:
        modes.append(tuple(new_signs.get(row, sign) for row, sign in enumerate(modes[-1])))
    return [*divide(stage, scheme, edges, modes)]


def _find_changes(stage: Stage, scheme: Scheme) -> tuple[list[float], list[_Change]]:
    """Initial signs of rates, (n_c + 2,), and their changes in order of time.

    Signs that last less than `MIN_FRACTION` are replaced by those before.
    """
    part, formation = stage.guess, stage.formation
    places, z = part.places(scheme.points).ravel(), part.z.reshape(-1, 5)
    rates = stage.measure_rates(z, part.v.reshape(-1, 5)) * np.concatenate(stage.directions)
    sizes = np.abs(rates).max(axis=1)
    # Signs of smaller rates, and all signs at rest, are undetermined.
    determined = (np.abs(rates) > 1e-5 * sizes[:, None]) & (sizes > 1e-4 * sizes.max())[:, None]
    first, reversals = np.array(mode_of(stage)), list[tuple[float, int, float]]()
    for row, rate in enumerate(rates.T):
        points = np.flatnonzero(determined[:, row])
        if not len(points) or first[row] == 0:
            continue
        signs = np.sign(rate)
        if stage.smoothing and can_roll(formation, z[len(z) // 2], row):
            rolls = np.abs(np.tanh(rate / stage.smoothing)) < 0.2  # little friction is used
            for run in find_runs(rolls):
                if places[run.stop - 1] - places[run.start] > 0.1:  # long enough to roll
                    signs[run] = 0.0
        runs = [(0.0, float(signs[points[0]]))]
        for i, j in pairwise(points.tolist()):
            if signs[i] != signs[j]:
                ratio = rate[i] / (rate[i] - rate[j]) if rate[i] * rate[j] < 0 else 0.5
                runs.append((float(places[i] + ratio * (places[j] - places[i])), float(signs[j])))
        while len(runs) > 1:
            durations = np.diff([place for place, _ in runs] + [1.0])
            if durations.min() >= MIN_FRACTION:
                break
            k = int(durations.argmin())
            runs = [(0.0, runs[1][1]), *runs[2:]] if k == 0 else runs[:k] + runs[k + 1 :]
            runs = [run for n, run in enumerate(runs) if not n or run[1] != runs[n - 1][1]]
        first[row] = runs[0][1]
        reversals += [(place, row, sign) for place, sign in runs[1:]]
    changes, tolerance = list[_Change](), 2 * float(np.diff(places).max())
    for place, row, sign in sorted(reversals):
        previous, rows = changes[-1] if changes else (-1.0, {})
        tied = find_tied(formation, z[int(np.abs(places - place).argmin())], row)
        if place - previous < tolerance and row not in rows and set(rows) & set(tied):
            rows[row] = sign
        else:
            changes.append((place, {row: sign}))
    # Where all rates reverse at about the same time the motion stops: one change (goal 53).
    merged, count = list[_Change](), int(np.count_nonzero(first))
    while changes:
        simultaneous = [change for change in changes if change[0] < changes[0][0] + tolerance]
        rows = {row: sign for _, group in simultaneous for row, sign in group.items()}
        if len(rows) == sum(len(group) for _, group in simultaneous) == count:
            merged.append((simultaneous[len(simultaneous) // 2][0], rows))
            changes = changes[len(simultaneous) :]
        else:
            merged.append(changes.pop(0))
    return first.tolist(), merged


def guess_stages(
    search: TimeSearch,
    z: Array,
    pieces: Sequence[PathGuess] | None = None,
    profile: PathSpeed | None = None,
    fall_times: float = FALL_TIMES,
    factor: int = 1,
) -> list[Stage]:
    """Stages of phases in one NLP, with an initial guess, in the scene's units.

    The guessed duration is `fall_times` that of a fall over the length of the paths; there are
    `factor` times the usual number of intervals. A single phase may follow the `pieces` of another
    path, with its speed profile.
    """
    scene, phases, options = search.source.scene, search.phases, search.options
    parts = list[tuple[Phase, PathGuess]]()  # in the scene's units
    for k, phase in enumerate(phases):
        paths = list(pieces or guess_phase(phase, z, phases[k + 1 :]))
        if parts and parts[-1][0].end is End.SMOOTH:
            paths = [*_reverse_first(paths[0], parts[-1][1]), *paths[1:]]
        z, scaled = paths[-1].z[-1], search.problem.phases[phase.index]
        for piece in paths:
            scaled_z = piece.z / unit_lengths(scene.scales)
            parts.append((scaled, replace(piece, formation=scaled.formation, z=scaled_z)))
    lengths = np.array([path.length for _, path in parts])
    ends = np.concatenate([[0.0], np.cumsum(lengths)]) / lengths.sum()
    # The path parameter of the guess is (1 - cos) / 2 over all stages.
    duration = fall_times * float(np.sqrt(lengths.sum()))
    clock = np.arccos(1 - 2 * np.clip(ends, 0.0, 1.0)) / np.pi
    if profile is not None:
        duration = float(profile.t[-1]) / scene.scales.time
        clock = np.interp(ends, profile.s, profile.t / profile.t[-1])
    stages: list[Stage] = []
    released: tuple[int, ...] = ()
    for k, (phase, path) in enumerate(parts):
        approach = None
        if phase.until.value is not None:
            z_start = next(other.z[0] for owner, other in parts if owner is phase)
            row, value = phase.until.lead(z_start, 1.0).poses[0]
            approach = row, value, 1.0 if value > z_start[row] else -1.0
        phase_length = lengths[[owner is phase for owner, _ in parts]].sum()
        intervals = factor * (options.time_intervals or 10)  # of a phase to start with
        count = max(MIN_INTERVALS, round(lengths[k] / phase_length * intervals))
        times, places = clock[k : k + 2], ends[k : k + 2]
        guess = _guess(path, search.scheme, count, times, places, duration, profile)
        # Limits near zero along the path, and that of the phase's end.
        near_zero = phase.formation.evaluate_limits(path.z).min(axis=0) < 0.02
        near_zero |= [limit.gains(phase.until.contact) for limit in phase.formation.limits]
        previous = parts[k - 1][0]
        opens = k > 0 and previous is not phase
        if opens:
            touching = np.abs(phase.formation.evaluate_limits(path.z[:1])[0]) < 1e-5  # closed
            renamed = list_renamed(scene, previous.formation.contacts, phase.formation.contacts)
            closed, limits = np.flatnonzero(touching).tolist(), phase.formation.limits
            released = tuple(row for row in closed if limits[row].gained not in renamed)
        stages.append(
            Stage(
                phase.index,
                phase.formation,
                path.directions,
                guess,
                goal=None if phase.until.is_release else phase.until,
                impact=phase.end is End.IMPACT and phase is not parts[-1][0],
                monitored=tuple(sorted({*np.flatnonzero(near_zero).tolist(), *released})),
                released=released,
                opening=None if opens and previous.end is End.IMPACT else options.opening,
                clearance=options.clearance,
                approach=approach,
            )
        )
    return link(stages)


def _guess(
    path: PathGuess,
    scheme: Scheme,
    count: int,
    clock: Array,
    ends: Array,
    total: float,
    profile: PathSpeed | None,
) -> StagePoints:
    """Motion along a path; without a speed profile normal forces are about equal.

    `clock` and `ends` are fractions of time, of `total` [s] in all, and of length at both ends.
    """
    formation = path.formation
    knots = np.linspace(0.0, 1.0, len(path.z))
    slopes = np.gradient(path.z, knots, axis=0)
    curvatures = np.gradient(slopes, knots, axis=0)
    breaks = np.linspace(0.0, 1.0, count + 1)

    def follow(x: Array) -> tuple[Array, Array, Array]:
        fraction = clock[0] + x * (clock[1] - clock[0])
        span, angle = max(ends[1] - ends[0], 1e-12), np.pi * fraction
        place, ds, dds = (
            ((1 - np.cos(angle)) / 2, np.pi / 2 * np.sin(angle), np.pi**2 / 2 * np.cos(angle))
            if profile is None
            else profile.evaluate(fraction)
        )
        place = (place - ends[0]) / span
        ds, dds = ds[..., None] / (span * total), dds[..., None] / (span * total**2)
        tables = path.z, slopes, curvatures
        z, slope, curvature = (interpolate(place, knots, table) for table in tables)
        return z, slope * ds, slope * dds + curvature * ds**2

    duration, c = total * (clock[1] - clock[0]), None
    if profile is not None:
        times = breaks[:-1, None] + scheme.points / count
        fraction = clock[0] + times.ravel() * (clock[1] - clock[0])
        indices = np.searchsorted(profile.t / profile.t[-1], fraction) - 1
        c = profile.forces[np.clip(indices, 0, len(profile.forces) - 1)]
    return _add_forces(formation, path.directions, scheme, count, duration, follow, c)


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

    `follow` returns z, z' and z'' at fractions of the `duration`. Without `c` normal forces are
    those nearest to equal ones, by least squares.
    """
    scene, breaks = formation.scene, np.linspace(0.0, 1.0, count + 1)
    z, v, a = follow(breaks[:-1, None] + scheme.points / count)
    # G^T c + S tau = required, by the equations of motion.
    arrays = [table.reshape(-1, 5) for table in (z, v, a)]
    G = force_rows(formation, formation.evaluate(*arrays[:2]), directions)
    applied = scene.applied_force - scene.dry * np.append(np.zeros(3), directions.sigma)
    required = scene.mass_diagonal * arrays[2] + scene.viscous * arrays[1] - applied
    if c is None:
        c = np.zeros((len(G), formation.n_constraints))
        c[:, : formation.n_contacts] = _GUESS_FORCE
        remaining = required[:, :3] - np.einsum("nij,ni->nj", G[:, :, :3], c)
        pairs = zip(G[:, :, :3], remaining, strict=True)
        c += [np.linalg.lstsq(rows.T, force, rcond=1e-6)[0] for rows, force in pairs]
        c_n = c[:, : formation.n_contacts]
        c_n[:] = np.clip(c_n, 0.1 * _GUESS_FORCE, 20.0)
    # Torques of the motion, within limits, at about as many points as there are control points.
    tau = required[:, 3:] - np.einsum("nij,ni->nj", G[:, :, 3:], c)
    limit = 0.9 * scene.torque_limit
    tau = np.clip(tau, -limit, limit).reshape(*z.shape[:2], 2)
    tau = tau[:, np.linspace(0, scheme.degree - 1, scheme.controls).round().astype(int)]
    h, nodes = np.full(count, duration / count), np.stack(follow(breaks)[:2], axis=1)
    return StagePoints(h, nodes, z, v, a, c.reshape(*z.shape[:2], -1), tau, np.zeros(0))


def _reverse_first(path: PathGuess, previous: PathGuess) -> list[PathGuess]:
    """Pieces of a path that starts in the sliding directions of the previous one.

    Velocities are continuous, so that other directions need reversals along the path. Case: without
    them `heptagon.toml` takes half as long again to plan, with a smaller margin.
    """
    # Rolling contacts have no direction to keep.
    sliding = np.delete(np.arange(previous.formation.n_contacts), previous.formation.rolling_rows)
    directions = {previous.formation.names[k]: previous.directions.Xi[k] for k in sliding}
    path_signs, formation = np.concatenate(path.directions), path.formation
    n_c = formation.n_contacts
    signs = path_signs.copy()
    signs[n_c:] = previous.directions.sigma
    for k in range(n_c):
        if k not in formation.rolling_rows:
            tied = [formation.names[i] for i in formation.turn_with(k)]
            signs[k] = next((directions[name] for name in tied if name in directions), signs[k])
    differing = np.flatnonzero(signs != path_signs).tolist()
    reversals = list(dict.fromkeys(formation.turn_with(k) for k in differing))
    pieces = []
    cuts = np.linspace(0, len(path.z) - 1, len(reversals) + 2).astype(int)
    for k, (begin, stop) in enumerate(pairwise(cuts)):
        rows = reversals[k] if k < len(reversals) else path.reversals
        pieces.append(_make_piece(formation, path.z[begin : stop + 1], signs, rows))
        if k < len(reversals):
            signs[list(reversals[k])] = path_signs[list(reversals[k])]
    return pieces
