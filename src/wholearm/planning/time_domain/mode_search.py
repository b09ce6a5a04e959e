"""Local search for contact modes: each neighbouring mode sequence is solved, the better kept.

A mode has a sign for each contact and joint of a stage: its sliding direction or rotation, or 0 if
it rolls. Where the modes of successive stages differ, rates are zero in between (`link`).
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
from .time_nlp import least_senses, new_rows, stops

LEAST_INTERVALS = 3  # fewest intervals of a stage
WORTH = 1e-4  # least relative gain of a move; dropping a vanished stage may cost as much
PATIENCE = 50  # most solver iterations for one of them


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


def in_mode(stage: Stage, mode: Mode) -> Stage:
    """A stage in another mode, with its tangential forces."""
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
    """Stages with ends that follow from their modes and phases."""
    linked, joints = list[Stage](), ("joint 1", "joint 2")
    for stage, coming in zip(stages, [*stages[1:], None], strict=True):
        last = coming is None or coming.phase != stage.phase
        until, impact = stage.goal if last else None, last and stage.impact
        guess, count = stage.guess, coming.formation.n_constraints if coming and impact else 0
        if len(guess.impulses) != count:
            guess = guess._replace(impulses=np.zeros(count))
        opens = bool(linked) and linked[-1].phase != stage.phase
        stage = replace(stage, guess=guess, until=until, ends_in_impact=impact, opens=opens)
        turns, growing, gained = tuple[int, ...](), tuple[int, ...](), None
        fading = tuple[tuple[int, float], ...]()
        if linked and not (linked[-1].ends_in_impact or linked[-1].rests):
            contacts = linked[-1].formation.contacts
            growing = tuple(k for k, c in enumerate(stage.formation.contacts) if c not in contacts)
        if coming is not None and not impact:
            names = (*stage.formation.names, *joints)
            after = dict(zip((*coming.formation.names, *joints), mode_of(coming), strict=True))
            rows = enumerate(zip(names, mode_of(stage), strict=True))
            turns = tuple(k for k, (name, sign) in rows if sign * after.get(name, 0.0) < 0)
            fading = find_passing(stage, coming)
            fresh = new_rows(stage.formation, coming.formation)
            gained = coming.formation if fresh else None
        stage = replace(stage, gained=gained, growing=growing, fading=fading, turns=turns)
        if rests := coming is None or (last and stops(stage)):
            fading = ()  # other torques begin after a pause
        linked.append(replace(stage, rests=rests, fading=fading))
    return linked


def find_passing(stage: Stage, coming: Stage) -> tuple[tuple[int, float], ...]:
    """`Stage.fading`: contacts that the next stage releases, with 0, or lets slide, with a sign."""
    formation, passing = stage.formation, list[tuple[int, float]]()
    renamed = list_renamed(formation.scene, formation.contacts, coming.formation.contacts)
    for k, contact in enumerate(formation.contacts):
        if contact in renamed:
            continue
        if contact not in coming.formation.contacts:
            passing.append((k, 0.0))
        elif contact in formation.rolling and contact not in coming.formation.rolling:
            row = coming.formation.contacts.index(contact)
            passing.append((k, float(coming.directions.Xi[row])))
    return tuple(passing)


def drop_stops(stages: Sequence[Stage]) -> list[Stage]:
    """Stages without brief ones that end, or begin, where the motion stops within a phase.

    Torques that may not step do not pause there, and those held over periods only for whole ones:
    phase 9 of query 28 starts with a stage of 0.1 ms.
    """
    left, fastest = list(stages), max(np.abs(stage.guess.nodes[:, 1]).max() for stage in stages)
    for k in reversed(range(len(stages) - 1)):
        pair = left[k : k + 2]
        times = [stage.guess.duration for stage in pair]
        still = np.abs(pair[0].guess.nodes[-1, 1]).max() < 1e-3 * fastest
        # Phase 4 of query 26 goes back for a third of its time before it goes on: that stays.
        if still and pair[0].phase == pair[1].phase and min(times) < 0.05 * max(times):
            left = drop(left, k + times.index(min(times))) or left
    return link(merge(left))


def adapt_ends(stages: Sequence[Stage], search: TimeSearch) -> list[Stage]:
    """Stages that begin from rest, and come to rest, in modes that continuous torques allow.

    Where statics exclude a mode, the first or last interval gets the nearest one that is possible:
    phase 3 of query 18 begins with a contact that rolls, and ends with one that slides back.
    """
    begins, adapted = True, list[Stage]()
    for stage in stages:
        pieces = [stage]
        if begins and (mode := _find_nearest(stage, search, 0)):
            pieces = split(stage, search.scheme, 0, 1, mode)
        last = pieces[-1]
        if last.rests and (mode := _find_nearest(last, search, -1)):
            pieces[-1:] = split(last, search.scheme, last.intervals - 1, last.intervals, mode)
        adapted += pieces
        begins = stage.rests
    return link(merge(adapted))


def _find_nearest(stage: Stage, search: TimeSearch, node: int) -> Mode | None:
    """Another mode for the start (`node` 0) or end (-1) of a stage, nearest to its own.

    None if it may keep that, with one degree of freedom, or without a mode that is possible.
    """
    mode = mode_of(stage)
    possible = _list_possible(stage, search, node)
    differing = [(sum(map(ne, signs, mode)), -margin, signs) for margin, signs in possible]
    count, _, nearest = min(differing, default=(0, 0.0, mode))
    return nearest if count else None


def _list_possible(stage: Stage, search: TimeSearch, node: int) -> list[tuple[float, Mode]]:
    """Modes that continuous torques allow at the start (`node` 0) or end (-1), with margins."""
    own, epsilon = search.problem.phases[stage.phase].formation, search.problem.epsilon
    z, held = stage.guess.nodes[node, 0], None
    if own.n_constraints >= 4:
        return []
    if node:
        touching = make_formation(own.scene, stage.ending.contacts)
        held = Statics(touching, z).torque_polygon(epsilon)
    turns = mode_of(stage)[-2:]
    possible = list[tuple[float, Mode]]()
    for margin, signs in Statics(own, z).list_continuous(epsilon, held) or ():
        # A joint that does not turn at first may turn later: phase 15 of query 28.
        joints = (sign or turn for sign, turn in zip(signs[-2:], turns, strict=True))
        possible.append((margin, (*signs[:-2], *joints)))
    return possible


def change_ends(stages: Sequence[Stage], search: TimeSearch) -> Iterator[list[Stage]]:
    """Stages with another mode in the first or last interval of a motion from rest to rest.

    The modes are those that continuous torques allow there. First come those in which a contact
    rolls, the one first that slides most slowly: with continuous torques it may not slide at all.
    The others follow by the number of signs that differ, and by their margins.
    """
    begins, changed = True, list[tuple[int, float, list[Stage]]]()
    for k, stage in enumerate(stages):
        last, mode = stage.intervals - 1, mode_of(stage)
        for node, first in [(0, 0)] * begins + [(-1, last)] * stage.rests:
            part = stage.guess
            rates = np.abs(stage.measure_senses(part.z[first], part.v[first])).max(axis=0)
            for margin, signs in _list_possible(stage, search, node):
                rows = [row for row, pair in enumerate(zip(signs, mode, strict=True)) if ne(*pair)]
                if not rows:
                    continue
                rolls = not any(signs[row] for row in rows)
                rank = (0, rates[rows].max() / rates.max()) if rolls else (len(rows), -margin)
                pieces = split(stage, search.scheme, first, first + 1, signs)
                changed.append((*rank, link(merge([*stages[:k], *pieces, *stages[k + 1 :]]))))
        begins = stage.rests
    yield from (others for *_, others in sorted(changed, key=itemgetter(0, 1)))


def divide(
    stage: Stage, scheme: Scheme, edges: Sequence[float], modes: Sequence[Mode]
) -> Iterator[Stage]:
    """Pieces of a stage between `edges`, shares of it, with a mode each, to be linked."""
    for (begin, stop), mode in zip(pairwise(edges), modes, strict=True):
        count = max(LEAST_INTERVALS, round((stop - begin) * stage.intervals))
        guess = resample(stage.guess, scheme, np.linspace(begin, stop, count + 1))
        yield in_mode(replace(stage, guess=guess), mode)


def split(stage: Stage, scheme: Scheme, begin: int, stop: int, mode: Mode) -> list[Stage]:
    """Pieces of a stage with intervals `begin` to `stop` in another mode, to be linked."""
    edges, modes = [0, begin, stop, stage.intervals], [mode_of(stage), mode, mode_of(stage)]
    pieces = list[Stage]()
    for (first, last), signs in zip(pairwise(edges), modes, strict=True):
        if first == last:
            continue
        breaks = stage.guess.breaks[first : last + 1]
        while len(breaks) - 1 < LEAST_INTERVALS:
            breaks = np.sort(np.append(breaks, (breaks[1:] + breaks[:-1]) / 2))
        guess = resample(stage.guess, scheme, breaks)
        pieces.append(in_mode(replace(stage, guess=guess), signs))
    return pieces


def merge(stages: Sequence[Stage]) -> list[Stage]:
    """Stages with successive ones of the same mode and phase merged."""
    merged: list[Stage] = [stages[0]]
    for stage in stages[1:]:
        before = merged[-1]
        if (before.phase, mode_of(before)) != (stage.phase, mode_of(stage)):
            merged.append(stage)
            continue
        monitored = tuple(sorted({*before.monitored, *stage.monitored}))
        guess = _join(before.guess, stage.guess)
        merged[-1] = replace(stage, guess=guess, monitored=monitored)
    return merged


def release_earlier(stages: Sequence[Stage]) -> Iterator[list[Stage]]:
    """Stages with the last, but not only, one of a phase that ends by a release in the next phase.

    Case: without it the plan of `heptagon.toml` takes 0.8 % longer.
    """
    triples = zip(stages, stages[1:], stages[2:], strict=False)
    for k, (before, stage, coming) in enumerate(triples, start=1):
        names, left = stage.formation.names, coming.formation.names
        if before.phase != stage.phase or coming.phase == stage.phase or stage.goal is not None:
            continue
        if set(left) < set(names) and not coming.formation.rolling:
            rows, (Xi, sigma) = [names.index(name) for name in left], stage.directions
            guess = stage.guess._replace(forces=stage.guess.forces[..., rows])
            moved = replace(coming, directions=Directions(Xi[rows], sigma), guess=guess)
            yield link(merge([*stages[:k], moved, *stages[k + 1 :]]))


def drop(stages: Sequence[Stage], index: int) -> list[Stage] | None:
    """Stages without one of them, or None if it is all that its phase has.

    They begin where the first one does. Case: new polygon 23 with periods of 2 ms, phase 9.
    """
    gone, left = stages[index], [*stages[:index], *stages[index + 1 :]]
    if all(other.phase != gone.phase for other in left):
        return None
    return left if index else [left[0].begin_at(*gone.guess.nodes[0]), *left[1:]]


def _join(first: StagePoints, second: StagePoints) -> StagePoints:
    """Two successive parts of one stage as one."""
    first = first._replace(nodes=first.nodes[:-1], impulses=first.impulses[:0])
    return StagePoints(*map(np.concatenate, zip(first, second, strict=True)))


def improve(search: TimeSearch, solution: TimeSolution) -> TimeSolution:
    """Change the modes of a solution while that decreases the cost."""
    seen = {sign_sequence(solution.stages)}
    waiting, tried, lost = list_neighbours(search, solution), 1, 0
    recent = set[tuple[object, ...]]()
    while waiting and tried < 12 and lost < 3:  # sequences, and failures since the last gain
        moved = waiting.pop(0)
        signs = sign_sequence(moved)
        # A vanished stage may have gained by the intervals of its neighbours alone.
        if signs in seen and (signs in recent or len(moved) >= len(solution.stages)):
            continue
        seen.add(signs)
        recent.add(signs)
        tried += 1
        other = search.solve(moved, most=PATIENCE)
        search.tried.sequences += 1
        if not other.success:
            lost += 1
            continue
        least = WORTH if len(moved) >= len(solution.stages) else -WORTH
        if solution.cost - other.cost > least * abs(solution.cost):
            solution, waiting, lost = other, list_neighbours(search, other), 0
            recent = set()
        elif _rolls(moved) > _rolls(solution.stages):
            # No better by itself, but it tells which way its contacts would slide.
            waiting = [*list_neighbours(search, other, leaning=True), *waiting]
    search.tried.complete = all(sign_sequence(moved) in seen for moved in waiting)
    return solution


def list_as_good(
    search: TimeSearch, solution: TimeSolution, sequences: Iterable[list[Stage]]
) -> Iterator[TimeSolution]:
    """Solutions in other modes that cost no more."""
    for stages in sequences:
        other = search.solve(stages, most=PATIENCE)
        if other.success and other.cost - solution.cost < WORTH * abs(solution.cost):
            yield other


def drop_gone(search: TimeSearch, solution: TimeSolution) -> TimeSolution:
    """Leave out stages that have vanished on finer intervals: their replays diverge."""
    other = next(list_as_good(search, solution, list_dropped(solution.stages)), None)
    return drop_gone(search, other) if other else solution


def _rolls(stages: list[Stage]) -> int:
    return sum(stage.formation.n_rolling for stage in stages)


class ModeRun(NamedTuple):
    """Consecutive intervals of a stage in which a rate or a friction force is at its limit."""

    row: int  # of (contacts, joints)
    begin: int  # begin, stop: its intervals
    stop: int
    sign: float  # direction in which a rolling contact would slide; 0 at a least rate
    share: float  # [s]: its duration


def list_neighbours(
    search: TimeSearch, solution: TimeSolution, leaning: bool = False
) -> list[list[Stage]]:
    """Mode sequences one move away from that of a solution, the most promising first.

    `leaning`: only contacts at their cones count. Contacts that a phase has rolling have to roll.
    """
    stages, scheme, epsilon = solution.stages, search.scheme, search.problem.epsilon
    formations = [search.problem.phases[stage.phase].formation for stage in stages]
    pairs = zip(stages, formations, strict=True)
    slides = [_find_leaning(stage, scheme, own, epsilon) for stage, own in pairs]

    def turn(index: int, run: ModeRun) -> list[Stage] | None:
        """Another mode over a run: rolling if possible, else reversed."""
        signs = [run.sign] if run.sign else [0.0, -mode_of(stages[index])[run.row]]
        stage, n_c = stages[index], stages[index].formation.n_contacts
        following = [k for k, other in enumerate(stages) if other.phase > stage.phase][:1]
        for k in following if run.row < n_c else ():
            # A contact that rolls from the next phase on slides until this one ends.
            rolls = set(formations[k].rolling) - set(formations[index].rolling)
            if stage.formation.contacts[run.row] in rolls:
                signs = [sign for sign in signs if sign]
        pieces = [_change(stages, index, run, sign, scheme) for sign in signs]
        replacement = next((piece for piece in pieces if piece is not None), None)
        return replacement and link(merge([*stages[:index], *replacement, *stages[index + 1 :]]))

    def turn_each(runs: list[tuple[int, ModeRun]]) -> list[list[Stage]]:
        """In whole stages that are mostly one run, then in single runs."""
        whole = [
            (k, run._replace(begin=0, stop=stages[k].intervals))
            for k, run in runs
            if 2 * run.share > stages[k].guess.duration
        ]
        order = (sorted(group, key=lambda pair: -pair[1].share) for group in (whole, runs))
        return [moved for group in order for pair in group if (moved := turn(*pair))]

    if leaning:
        return turn_each([(k, run) for k, runs in enumerate(slides) for run in runs])
    moves = [*list_dropped(stages), *release_earlier(stages)]
    savings = [solution.price_friction(k) / abs(solution.cost) for k in range(len(stages))]
    for slow in (True, False):
        runs = list[tuple[int, ModeRun]]()
        for k, stage in enumerate(stages):
            for run in _find_held(stage, scheme, slow):
                # Rolling, if the contact can, has to promise a gain.
                places, row = slice(run.begin, run.stop), run.row
                middle = stage.guess.z[(run.begin + run.stop) // 2, 0]
                rolls = can_roll(stage.formation, middle, row)
                if not rolls or savings[k][places, :, row].clip(min=0.0).sum() > WORTH:
                    runs.append((k, run))
            runs += [(k, run) for run in slides[k]]
        moves += turn_each(runs)
    return moves


def list_dropped(stages: Sequence[Stage]) -> Iterator[list[Stage]]:
    """The stages without all vanished ones, and without each of these."""
    # By the mean duration of intervals, in the scene's unit.
    gone = [k for k, stage in enumerate(stages) if stage.guess.duration < 2e-4 * stage.intervals]
    for group in [gone, *([k] for k in gone)] if len(gone) > 1 else [[k] for k in gone]:
        left: list[Stage] | None = list(stages)
        for index in reversed(group):
            left = drop(left, index) if left else None
        if left:
            yield link(merge(left))


def can_roll(formation: Formation, z: Array, row: int) -> bool:
    """Whether a row is a contact that may roll by itself, with friction and freedoms left."""
    if row >= formation.n_contacts or formation.n_constraints >= 4:
        return False
    return bool(len(find_tied(formation, z, row)) == 1 and formation.friction[row] > 0)


def _change(
    stages: Sequence[Stage], index: int, run: ModeRun, sign: float, scheme: Scheme
) -> list[Stage] | None:
    """Pieces of a stage with another direction over a run, or None if that cannot be."""
    stage = stages[index]
    middle = stage.guess.z[(run.begin + run.stop) // 2, 0]
    if sign == 0 and not can_roll(stage.formation, middle, run.row):
        return None
    rows, signs = find_tied(stage.formation, middle, run.row), mode_of(stage)
    turned = sign * signs[rows[0]]
    mode = tuple((turned * s or sign) if k in rows else s for k, s in enumerate(signs))
    # Where the neighbour has that mode already, the instant between them is optimal.
    at_start, at_end = run.begin == 0, run.stop == stage.intervals
    if not (at_start and at_end):
        near = [stages[index - 1]] if at_start and index else []
        near += [stages[index + 1]] if at_end and index + 1 < len(stages) else []
        if any(other.phase == stage.phase and mode_of(other) == mode for other in near):
            return None
    return split(stage, scheme, run.begin, run.stop, mode)


def _find_held(stage: Stage, scheme: Scheme, slow: bool) -> list[ModeRun]:
    """Runs over which a least rate is active.

    A polynomial touches its bound at few points of an interval, so whole intervals count that touch
    it and are `slow` throughout, or else those that touch it twice.
    """
    formation, part = stage.formation, stage.guess
    z, v = part.z.reshape(-1, 5), part.v.reshape(-1, 5)
    senses = stage.measure_senses(z, v)
    fast = np.abs(v[:, 2:]).max()
    least = least_senses(stage, stage.guess.places(scheme.points))
    least = 1.01 * least.reshape(-1, least.shape[-1])
    touches = senses < least + 1e-6 * fast  # of the largest rate
    touches &= (np.abs(senses).max(axis=1) > 1e-3 * fast)[:, None]
    shape = (stage.intervals, scheme.degree, -1)
    count = touches.reshape(shape).sum(axis=1)
    near = (senses < least + 1e-2 * fast).reshape(shape).all(axis=1)
    held = np.repeat(near & (count > 0) if slow else count > 1, scheme.degree, axis=0)
    held[:, np.delete(np.arange(formation.n_contacts), formation.rubbing_rows)] = False
    columns = enumerate(held.T)
    return [run for row, flags in columns for run in _find_run(flags, stage, scheme, row)]


def _find_leaning(stage: Stage, scheme: Scheme, own: Formation, epsilon: float) -> list[ModeRun]:
    """Runs over which a contact that need not roll is at one side of its cone."""
    formation, n_c = stage.formation, stage.formation.n_contacts
    runs = []
    for k, row in enumerate(formation.rolling_rows):
        if formation.contacts[row] in own.rolling:
            continue
        c_n = stage.guess.forces[..., row].ravel()
        c_t = stage.guess.forces[..., n_c + k].ravel()
        mu = formation.friction[row]
        rounding = 1e-4 * mu * c_n
        near = mu * (c_n - epsilon) - np.abs(c_t) < rounding  # about to slide
        for sign in (1.0, -1.0):
            # Friction pushes against sliding. At c_n = epsilon its sign is that of rounding: both
            # directions count (goal 45).
            runs += _find_run(near & (sign * c_t < rounding), stage, scheme, row, sign)
    return runs


def _find_run(
    flags: Flags, stage: Stage, scheme: Scheme, row: int, sign: float = 0.0
) -> list[ModeRun]:
    """The longest run of True at the points, (K d,), of a row, if it is an interval long."""
    runs, breaks = find_runs(flags, scheme.degree), stage.guess.breaks
    if not runs:
        return []
    run = max(runs, key=lambda run: run.stop - run.start)
    begin, stop = run.start // scheme.degree, -(-run.stop // scheme.degree)
    share = float(breaks[stop] - breaks[begin]) * stage.guess.duration
    return [ModeRun(row, begin, stop, sign, share)]
