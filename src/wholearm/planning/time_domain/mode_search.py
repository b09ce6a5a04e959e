"""Local search for contact modes: neighbouring mode sequences are solved, better ones accepted.

A mode has a sign for each contact and joint of a stage: the sliding or turning direction, or 0 if
it rolls. Rates whose sign differs in successive stages are zero between them (`link`).
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from itertools import pairwise
from operator import itemgetter, ne
from typing import NamedTuple

import numpy as np

from ...common.arrays import Array, Flags, find_runs
from ...contacts.contact_limits import list_renamed
from ...contacts.formation import Formation
from ...geometry.curve import find_tied
from ...mechanics.dynamics import Directions, split_forces
from ...mechanics.statics import Statics
from .solution import TimeSearch, TimeSolution
from .stage import Scheme, Stage, StagePoints, make_formation, resample
from .time_nlp import all_rates_vanish, least_rates, new_rows

MIN_INTERVALS = 3  # fewest intervals of a stage
MIN_GAIN = 1e-4  # least relative gain of a neighbour; a vanished stage is dropped at this loss
MAX_ITER = 50  # most solver iterations for a neighbour

Mode = tuple[float, ...]
"""Contact mode of a stage: signs of the rates of (contacts, joints); zero for rolling contacts."""


def mode_of(stage: Stage) -> Mode:
    """The mode of a stage."""
    signs = np.concatenate(stage.directions)
    signs[list(stage.formation.rolling_rows)] = 0.0
    return tuple(signs.tolist())


def sign_sequence(stages: Sequence[Stage]) -> tuple[tuple[int, Mode], ...]:
    """Phase and mode of each stage."""
    return tuple((stage.phase, mode_of(stage)) for stage in stages)


def with_mode(stage: Stage, mode: Mode) -> Stage:
    """Copy of a stage in another mode, with the forces of that mode."""
    if mode == mode_of(stage):
        return stage
    formation, part = stage.formation, stage.guess
    n_c = formation.n_contacts
    signs = np.array(mode)
    rows = tuple(k for k in range(n_c) if signs[k] == 0)
    directions = Directions(np.where(signs[:n_c] == 0, 1.0, signs[:n_c]), signs[n_c:])
    if rows != formation.rolling_rows:
        c_n, c_t = split_forces(formation, part.forces, stage.directions.Xi)
        part = part._replace(forces=np.concatenate([c_n, c_t[..., list(rows)]], axis=-1))
        rolling = tuple(formation.contacts[k] for k in rows)
        formation = make_formation(formation.scene, formation.contacts, rolling)
    return replace(stage, formation=formation, directions=directions, guess=part)


def link(stages: Sequence[Stage]) -> list[Stage]:
    """Stages with end conditions that follow from their modes and phases."""
    linked, joints = list[Stage](), ("joint 1", "joint 2")
    for stage, next_stage in zip(stages, [*stages[1:], None], strict=True):
        last = next_stage is None or next_stage.phase != stage.phase
        until, impact = stage.goal if last else None, last and stage.impact
        guess, n = stage.guess, next_stage.formation.n_constraints if next_stage and impact else 0
        if len(guess.impulses) != n:
            guess = guess._replace(impulses=np.zeros(n))
        opens = bool(linked) and linked[-1].phase != stage.phase
        stage = replace(stage, guess=guess, until=until, ends_in_impact=impact, opens=opens)
        reversals, new, next_formation = tuple[int, ...](), tuple[int, ...](), None
        ending = tuple[tuple[int, float], ...]()
        if linked and not (linked[-1].ends_in_impact or linked[-1].ends_at_rest):
            contacts = linked[-1].formation.contacts
            new = tuple(k for k, c in enumerate(stage.formation.contacts) if c not in contacts)
        if next_stage is not None and not impact:
            names = (*stage.formation.names, *joints)
            next_names = (*next_stage.formation.names, *joints)
            signs = dict(zip(next_names, mode_of(next_stage), strict=True))
            pairs = enumerate(zip(names, mode_of(stage), strict=True))
            reversals = tuple(k for k, (name, sign) in pairs if sign * signs.get(name, 0.0) < 0)
            ending = find_ending_constraints(stage, next_stage)
            rows = new_rows(stage.formation, next_stage.formation)
            next_formation = next_stage.formation if rows else None
        stage = replace(stage, next_formation=next_formation, new_contacts=new, reversals=reversals)
        if at_rest := next_stage is None or (last and all_rates_vanish(stage)):
            ending = ()  # torques may change in the pause
        linked.append(replace(stage, ends_at_rest=at_rest, ending_constraints=ending))
    return linked


def find_ending_constraints(stage: Stage, next_stage: Stage) -> tuple[tuple[int, float], ...]:
    """`Stage.ending_constraints`: contacts released, with 0, or starting to slide, with a sign."""
    formation, ending = stage.formation, list[tuple[int, float]]()
    renamed = list_renamed(formation.scene, formation.contacts, next_stage.formation.contacts)
    for k, contact in enumerate(formation.contacts):
        if contact in renamed:
            continue
        if contact not in next_stage.formation.contacts:
            ending.append((k, 0.0))
        elif contact in formation.rolling and contact not in next_stage.formation.rolling:
            row = next_stage.formation.contacts.index(contact)
            ending.append((k, float(next_stage.directions.Xi[row])))
    return tuple(ending)


def drop_stops(stages: Sequence[Stage]) -> list[Stage]:
    """Stages without brief ones next to a stop of the motion within a phase.

    Continuous or sampled torques cannot pause there. Case: phase 9 of query 28 starts with a stage
    of 0.1 ms.
    """
    remaining, max_rate = list(stages), max(np.abs(s.guess.nodes[:, 1]).max() for s in stages)
    for k in reversed(range(len(stages) - 1)):
        pair = remaining[k : k + 2]
        times = [stage.guess.duration for stage in pair]
        at_rest = np.abs(pair[0].guess.nodes[-1, 1]).max() < 1e-3 * max_rate
        # Phase 4 of query 26 moves back for a third of its time: that stage stays.
        if at_rest and pair[0].phase == pair[1].phase and min(times) < 0.05 * max(times):
            remaining = drop(remaining, k + times.index(min(times))) or remaining
    return link(merge(remaining))


def adapt_ends(stages: Sequence[Stage], search: TimeSearch) -> list[Stage]:
    """Stages whose modes next to rest are statically feasible with continuous torques.

    If statics exclude a mode, the first or last interval gets the nearest feasible one. Case: phase
    3 of query 18 begins with a rolling contact, and ends with one that slides back.
    """
    starts_at_rest, adapted = True, list[Stage]()
    for stage in stages:
        pieces = [stage]
        if starts_at_rest and (mode := _find_nearest(stage, search, 0)):
            pieces = split(stage, search.scheme, 0, 1, mode)
        last = pieces[-1]
        if last.ends_at_rest and (mode := _find_nearest(last, search, -1)):
            pieces[-1:] = split(last, search.scheme, last.intervals - 1, last.intervals, mode)
        adapted += pieces
        starts_at_rest = stage.ends_at_rest
    return link(merge(adapted))


def _find_nearest(stage: Stage, search: TimeSearch, node: int) -> Mode | None:
    """Feasible mode for the start (`node` 0) or end (-1) of a stage, nearest to its present mode.

    None if the present mode is feasible, if no mode is, or with one degree of freedom.
    """
    mode = mode_of(stage)
    modes = _list_end_modes(stage, search, node)
    ranked = [(sum(map(ne, signs, mode)), -margin, signs) for margin, signs in modes]
    count, _, nearest = min(ranked, default=(0, 0.0, mode))
    return nearest if count else None


def _list_end_modes(stage: Stage, search: TimeSearch, node: int) -> list[tuple[float, Mode]]:
    """Modes that continuous torques allow at the start (`node` 0) or end (-1), with margins."""
    formation, epsilon = search.problem.phases[stage.phase].formation, search.problem.epsilon
    z, polygon = stage.guess.nodes[node, 0], None
    if formation.n_constraints >= 4:
        return []
    if node:
        at_rest = make_formation(formation.scene, stage.ending.contacts)
        polygon = Statics(at_rest, z).torque_polygon(epsilon)
    rotations = mode_of(stage)[-2:]
    modes = list[tuple[float, Mode]]()
    for margin, signs in Statics(formation, z).list_continuous(epsilon, polygon) or ():
        # A joint at rest at first may turn later: phase 15 of query 28.
        joints = (sign or rotation for sign, rotation in zip(signs[-2:], rotations, strict=True))
        modes.append((margin, (*signs[:-2], *joints)))
    return modes


def change_ends(stages: Sequence[Stage], search: TimeSearch) -> Iterator[list[Stage]]:
    """Stages with another mode in the first or last interval of a motion from rest to rest.

    Modes are those that continuous torques allow there. Modes with a rolling contact come first,
    the slowest contact before others, as it may not slide with continuous torques. The others are
    sorted by the number of different signs and by their margins.
    """
    starts_at_rest, candidates = True, list[tuple[int, float, list[Stage]]]()
    for k, stage in enumerate(stages):
        last, mode = stage.intervals - 1, mode_of(stage)
        for node, first in [(0, 0)] * starts_at_rest + [(-1, last)] * stage.ends_at_rest:
            part = stage.guess
            rates = np.abs(stage.measure_rates(part.z[first], part.v[first])).max(axis=0)
            for margin, signs in _list_end_modes(stage, search, node):
                rows = [row for row, pair in enumerate(zip(signs, mode, strict=True)) if ne(*pair)]
                if not rows:
                    continue
                rolls = not any(signs[row] for row in rows)
                rank = (0, rates[rows].max() / rates.max()) if rolls else (len(rows), -margin)
                pieces = split(stage, search.scheme, first, first + 1, signs)
                candidates.append((*rank, link(merge([*stages[:k], *pieces, *stages[k + 1 :]]))))
        starts_at_rest = stage.ends_at_rest
    yield from (candidate for *_, candidate in sorted(candidates, key=itemgetter(0, 1)))


def divide(
    stage: Stage, scheme: Scheme, edges: Sequence[float], modes: Sequence[Mode]
) -> Iterator[Stage]:
    """Pieces of a stage between `edges`, fractions of it, with a mode each; not linked."""
    for (begin, stop), mode in zip(pairwise(edges), modes, strict=True):
        count = max(MIN_INTERVALS, round((stop - begin) * stage.intervals))
        guess = resample(stage.guess, scheme, np.linspace(begin, stop, count + 1))
        yield with_mode(replace(stage, guess=guess), mode)


def split(stage: Stage, scheme: Scheme, begin: int, stop: int, mode: Mode) -> list[Stage]:
    """Pieces of a stage with intervals `begin` to `stop` in another mode; not linked."""
    edges, modes = [0, begin, stop, stage.intervals], [mode_of(stage), mode, mode_of(stage)]
    pieces = list[Stage]()
    for (first, last), signs in zip(pairwise(edges), modes, strict=True):
        if first == last:
            continue
        breaks = stage.guess.breaks[first : last + 1]
        while len(breaks) - 1 < MIN_INTERVALS:
            breaks = np.sort(np.append(breaks, (breaks[1:] + breaks[:-1]) / 2))
        guess = resample(stage.guess, scheme, breaks)
        pieces.append(with_mode(replace(stage, guess=guess), signs))
    return pieces


def merge(stages: Sequence[Stage]) -> list[Stage]:
    """Stages, with successive ones of the same mode and phase merged."""
    merged: list[Stage] = [stages[0]]
    for stage in stages[1:]:
        previous = merged[-1]
        if (previous.phase, mode_of(previous)) != (stage.phase, mode_of(stage)):
            merged.append(stage)
            continue
        monitored = tuple(sorted({*previous.monitored, *stage.monitored}))
        guess = _join(previous.guess, stage.guess)
        merged[-1] = replace(stage, guess=guess, monitored=monitored)
    return merged


def release_earlier(stages: Sequence[Stage]) -> Iterator[list[Stage]]:
    """Sequences in which the last of several stages before a release belongs to the next phase.

    Case: without it the plan of `heptagon.toml` takes 0.8 % longer.
    """
    triples = zip(stages, stages[1:], stages[2:], strict=False)
    for k, (first, stage, next_stage) in enumerate(triples, start=1):
        names, remaining = stage.formation.names, next_stage.formation.names
        if first.phase != stage.phase or next_stage.phase == stage.phase or stage.goal is not None:
            continue
        if set(remaining) < set(names) and not next_stage.formation.rolling:
            rows, (Xi, sigma) = [names.index(name) for name in remaining], stage.directions
            guess = stage.guess._replace(forces=stage.guess.forces[..., rows])
            released = replace(next_stage, directions=Directions(Xi[rows], sigma), guess=guess)
            yield link(merge([*stages[:k], released, *stages[k + 1 :]]))


def drop(stages: Sequence[Stage], index: int) -> list[Stage] | None:
    """Stages without one of them, with the same initial state; None if its phase has no other.

    Case: new polygon 23 with periods of 2 ms, phase 9.
    """
    dropped, remaining = stages[index], [*stages[:index], *stages[index + 1 :]]
    if all(other.phase != dropped.phase for other in remaining):
        return None
    return remaining if index else [remaining[0].begin_at(*dropped.guess.nodes[0]), *remaining[1:]]


def _join(first: StagePoints, second: StagePoints) -> StagePoints:
    """Points of two successive parts of a stage as one."""
    first = first._replace(nodes=first.nodes[:-1], impulses=first.impulses[:0])
    return StagePoints(*map(np.concatenate, zip(first, second, strict=True)))


def improve(search: TimeSearch, solution: TimeSolution) -> TimeSolution:
    """Local search: solution in the modes of the best sequence found."""
    visited = {sign_sequence(solution.stages)}
    queue, attempts, failures = list_neighbours(search, solution), 1, 0
    recent = set[tuple[object, ...]]()
    while queue and attempts < 12 and failures < 3:  # sequences, and failures since the last gain
        neighbour = queue.pop(0)
        sequence = sign_sequence(neighbour)
        # The cost of a vanished stage may differ by the intervals of its neighbours only.
        if sequence in visited and (sequence in recent or len(neighbour) >= len(solution.stages)):
            continue
        visited.add(sequence)
        recent.add(sequence)
        attempts += 1
        other = search.solve(neighbour, max_iter=MAX_ITER)
        search.statistics.sequences += 1
        if not other.success:
            failures += 1
            continue
        gain = MIN_GAIN if len(neighbour) >= len(solution.stages) else -MIN_GAIN
        if solution.cost - other.cost > gain * abs(solution.cost):
            solution, queue, failures = other, list_neighbours(search, other), 0
            recent = set()
        elif _count_rolling(neighbour) > _count_rolling(solution.stages):
            # The signs of its friction forces give further neighbours.
            queue = [*list_neighbours(search, other, at_cones=True), *queue]
    search.statistics.complete = all(sign_sequence(neighbour) in visited for neighbour in queue)
    return solution


def list_equivalent(
    search: TimeSearch, solution: TimeSolution, sequences: Iterable[list[Stage]]
) -> Iterator[TimeSolution]:
    """Solutions of mode sequences whose cost is not higher, but for `MIN_GAIN`."""
    for stages in sequences:
        other = search.solve(stages, max_iter=MAX_ITER)
        if other.success and other.cost - solution.cost < MIN_GAIN * abs(solution.cost):
            yield other


def drop_vanished(search: TimeSearch, solution: TimeSolution) -> TimeSolution:
    """Solution without stages that vanish on finer intervals, as their replays diverge."""
    other = next(list_equivalent(search, solution, list_dropped(solution.stages)), None)
    return drop_vanished(search, other) if other else solution


def _count_rolling(stages: list[Stage]) -> int:
    return sum(stage.formation.n_rolling for stage in stages)


class ModeRun(NamedTuple):
    """Consecutive intervals of a stage in which a rate or a friction force is at its limit."""

    row: int  # of (contacts, joints)
    begin: int  # begin, stop: its intervals
    stop: int
    sign: float  # direction in which a rolling contact would slide; 0 at a least rate
    duration: float  # [s]: its duration


def list_neighbours(
    search: TimeSearch, solution: TimeSolution, at_cones: bool = False
) -> list[list[Stage]]:
    """Mode sequences that differ from a solution's by one change, the most promising first.

    `at_cones`: only of contacts at their cones. Contacts that roll by the problem do not change.
    """
    stages, scheme, epsilon = solution.stages, search.scheme, search.problem.epsilon
    formations = [search.problem.phases[stage.phase].formation for stage in stages]
    pairs = zip(stages, formations, strict=True)
    cone_runs = [_find_slips(stage, scheme, formation, epsilon) for stage, formation in pairs]

    def change(index: int, run: ModeRun) -> list[Stage] | None:
        """The stages with another mode over a run: rolling if possible, else reversed."""
        signs = [run.sign] if run.sign else [0.0, -mode_of(stages[index])[run.row]]
        stage, n_c = stages[index], stages[index].formation.n_contacts
        following = [k for k, other in enumerate(stages) if other.phase > stage.phase][:1]
        for k in following if run.row < n_c else ():
            # A contact that starts to roll in the next phase slides until the end of this one.
            rolling = set(formations[k].rolling) - set(formations[index].rolling)
            if stage.formation.contacts[run.row] in rolling:
                signs = [sign for sign in signs if sign]
        pieces = [_change_run(stages, index, run, sign, scheme) for sign in signs]
        replacement = next((piece for piece in pieces if piece is not None), None)
        return replacement and link(merge([*stages[:index], *replacement, *stages[index + 1 :]]))

    def change_each(runs: list[tuple[int, ModeRun]]) -> list[list[Stage]]:
        """Changes of whole stages that are mostly one run, then of single runs."""
        extended = [
            (k, run._replace(begin=0, stop=stages[k].intervals))
            for k, run in runs
            if 2 * run.duration > stages[k].guess.duration
        ]
        groups = (sorted(group, key=lambda pair: -pair[1].duration) for group in (extended, runs))
        return [neighbour for group in groups for pair in group if (neighbour := change(*pair))]

    if at_cones:
        return change_each([(k, run) for k, runs in enumerate(cone_runs) for run in runs])
    neighbours = [*list_dropped(stages), *release_earlier(stages)]
    savings = [solution.price_friction(k) / abs(solution.cost) for k in range(len(stages))]
    for slow in (True, False):
        runs = list[tuple[int, ModeRun]]()
        for k, stage in enumerate(stages):
            for run in _find_least_rate_runs(stage, scheme, slow):
                # If the contact can roll, the estimated gain decides.
                intervals, row = slice(run.begin, run.stop), run.row
                middle = stage.guess.z[(run.begin + run.stop) // 2, 0]
                rolling = can_roll(stage.formation, middle, row)
                if not rolling or savings[k][intervals, :, row].clip(min=0.0).sum() > MIN_GAIN:
                    runs.append((k, run))
            runs += [(k, run) for run in cone_runs[k]]
        neighbours += change_each(runs)
    return neighbours


def list_dropped(stages: Sequence[Stage]) -> Iterator[list[Stage]]:
    """The stages without all vanished ones, then without each single one of these."""
    # Vanished by the mean duration of intervals, in the scene's unit.
    empty = [k for k, stage in enumerate(stages) if stage.guess.duration < 2e-4 * stage.intervals]
    for group in [empty, *([k] for k in empty)] if len(empty) > 1 else [[k] for k in empty]:
        remaining: list[Stage] | None = list(stages)
        for index in reversed(group):
            remaining = drop(remaining, index) if remaining else None
        if remaining:
            yield link(merge(remaining))


def can_roll(formation: Formation, z: Array, row: int) -> bool:
    """Whether a row is an untied contact with friction, and freedoms remain if it rolls."""
    if row >= formation.n_contacts or formation.n_constraints >= 4:
        return False
    return bool(len(find_tied(formation, z, row)) == 1 and formation.friction[row] > 0)


def _change_run(
    stages: Sequence[Stage], index: int, run: ModeRun, sign: float, scheme: Scheme
) -> list[Stage] | None:
    """Pieces of a stage with another sign over a run; None if the contact cannot have it."""
    stage = stages[index]
    middle = stage.guess.z[(run.begin + run.stop) // 2, 0]
    if sign == 0 and not can_roll(stage.formation, middle, run.row):
        return None
    rows, signs = find_tied(stage.formation, middle, run.row), mode_of(stage)
    relative = sign * signs[rows[0]]
    mode = tuple((relative * s or sign) if k in rows else s for k, s in enumerate(signs))
    # If the adjacent stage has that mode already, the instant between them is optimal.
    at_start, at_end = run.begin == 0, run.stop == stage.intervals
    if not (at_start and at_end):
        adjacent = [stages[index - 1]] if at_start and index else []
        adjacent += [stages[index + 1]] if at_end and index + 1 < len(stages) else []
        if any(other.phase == stage.phase and mode_of(other) == mode for other in adjacent):
            return None
    return split(stage, scheme, run.begin, run.stop, mode)


def _find_least_rate_runs(stage: Stage, scheme: Scheme, slow: bool) -> list[ModeRun]:
    """Runs of intervals over which a least rate is active.

    A polynomial touches its bound at few points of an interval. `slow`: intervals with one such
    point and a low rate throughout; otherwise intervals with two.
    """
    formation, part = stage.formation, stage.guess
    z, v = part.z.reshape(-1, 5), part.v.reshape(-1, 5)
    rates = stage.measure_rates(z, v)
    max_rate = np.abs(v[:, 2:]).max()
    min_rates = least_rates(stage, stage.guess.places(scheme.points))
    min_rates = 1.01 * min_rates.reshape(-1, min_rates.shape[-1])
    active = rates < min_rates + 1e-6 * max_rate  # of the largest rate
    active &= (np.abs(rates).max(axis=1) > 1e-3 * max_rate)[:, None]
    shape = (stage.intervals, scheme.degree, -1)
    count = active.reshape(shape).sum(axis=1)
    close = (rates < min_rates + 1e-2 * max_rate).reshape(shape).all(axis=1)
    mask = np.repeat(close & (count > 0) if slow else count > 1, scheme.degree, axis=0)
    mask[:, np.delete(np.arange(formation.n_contacts), formation.rubbing_rows)] = False
    runs = (_find_run(flags, stage, scheme, row) for row, flags in enumerate(mask.T))
    return [run for group in runs for run in group]


def _find_slips(stage: Stage, scheme: Scheme, nominal: Formation, epsilon: float) -> list[ModeRun]:
    """Runs of intervals over which a contact that need not roll is at one edge of its cone."""
    formation, n_c = stage.formation, stage.formation.n_contacts
    runs = []
    for k, row in enumerate(formation.rolling_rows):
        if formation.contacts[row] in nominal.rolling:
            continue
        c_n = stage.guess.forces[..., row].ravel()
        c_t = stage.guess.forces[..., n_c + k].ravel()
        mu = formation.friction[row]
        rounding = 1e-4 * mu * c_n
        at_cone = mu * (c_n - epsilon) - np.abs(c_t) < rounding  # about to slide
        for sign in (1.0, -1.0):
            # Friction opposes sliding. At c_n = epsilon its sign is rounding: both directions count
            # (goal 45).
            runs += _find_run(at_cone & (sign * c_t < rounding), stage, scheme, row, sign)
    return runs


def _find_run(
    flags: Flags, stage: Stage, scheme: Scheme, row: int, sign: float = 0.0
) -> list[ModeRun]:
    """The longest run of True at the points, (K d,), of a row, if as long as an interval."""
    runs, breaks = find_runs(flags, scheme.degree), stage.guess.breaks
    if not runs:
        return []
    run = max(runs, key=lambda run: run.stop - run.start)
    begin, stop = run.start // scheme.degree, -(-run.stop // scheme.degree)
    duration = float(breaks[stop] - breaks[begin]) * stage.guess.duration
    return [ModeRun(row, begin, stop, sign, duration)]
