"""The search for the modes of stages: moves, each solved, until none makes the plan better."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...common.arrays import Array
from ...contacts.formation import Formation
from ...geometry.curve import find_tied
from .collocation import Scheme
from .equations import least_senses
from .search import TimeSearch, TimeSolution
from .stage import Stage
from .stage_modes import drop, link, merge, mode_of, release_earlier, sign_sequence, split

_STALLED = 1e-6  # rate over the largest one at which a direction of friction counts as held back
_SLOW = 1e-2  # rate over the largest one below which what is held back stays in all of an interval
_LEANS = 1e-4
"""Margin to the friction cone over mu c_n at which a rolling contact counts as leaning on it."""
WORTH = 1e-4
"""Least gain of a move over the cost; dropping what has shrunk to nothing may cost as much."""
_GONE = 2e-4
"""Mean duration of an interval, in the scene's unit of time, below which its stage counts as shrunk
to nothing."""
MOST = 12  # most sequences of modes to try from one start
LOST = 3  # sequences that led to nothing since the last gain after which no more are tried
PATIENCE = 50  # most iterations of one of them


def improve(search: TimeSearch, solution: TimeSolution) -> TimeSolution:
    """Change the modes of a solution for as long as that makes it better."""
    known = {sign_sequence(solution.stages)}
    waiting, tried, lost = list_neighbours(search, solution), 1, 0
    beside = set[tuple[object, ...]]()
    while waiting and tried < MOST and lost < LOST:
        moved = waiting.pop(0)
        signs = sign_sequence(moved)
        # A stage that has shrunk to nothing may have gained by the intervals beside it alone.
        if signs in known and (signs in beside or len(moved) >= len(solution.stages)):
            continue
        known.add(signs)
        beside.add(signs)
        tried += 1
        other = search.solve(moved, most=PATIENCE)
        search.tried.sequences += 1
        if not other.success:
            lost += 1
            continue
        gain = solution.cost - other.cost
        least = WORTH if len(moved) >= len(solution.stages) else -WORTH
        if gain > least * abs(solution.cost):
            solution, waiting, lost = other, list_neighbours(search, other), 0
            beside = set()
        elif _rolls(moved) > _rolls(solution.stages):
            # No better by itself, but it tells which way its contacts would slide.
            waiting = [*list_neighbours(search, other, leaning=True), *waiting]
    search.tried.complete = all(sign_sequence(moved) in known for moved in waiting)
    return solution


def drop_gone(search: TimeSearch, solution: TimeSolution) -> TimeSolution:
    """Leave out stages that have shrunk to nothing on finer intervals: replays of them diverge."""
    for moved in list_dropped(solution.stages):
        other = search.solve(moved, most=PATIENCE)
        if other.success and other.cost - solution.cost < WORTH * abs(solution.cost):
            return drop_gone(search, other)
    return solution


def list_neighbours(
    search: TimeSearch, solution: TimeSolution, leaning: bool = False
) -> list[list[Stage]]:
    """Sequences of stages that one move leads to from those of a solution."""
    own = [search.problem.phases[stage.phase].formation for stage in solution.stages]
    worth = [solution.price_friction(k) / abs(solution.cost) for k in range(len(own))]
    given = (solution.stages, search.scheme, own, search.problem.epsilon, leaning)
    return list(list_moves(*given, savings=worth))


def _rolls(stages: list[Stage]) -> int:
    return sum(stage.formation.n_rolling for stage in stages)


class ModeRun(NamedTuple):
    """A stretch of a stage over which something is at its limit."""

    row: int  # of (contacts, joints)
    begin: int  # begin, stop: its intervals
    stop: int
    # direction, of a rolling contact that leans on its cone, in which it would slide; 0 for one
    # that its least rate holds back
    sign: float
    share: float  # [s]: how long it lasts


def list_moves(
    stages: Sequence[Stage],
    scheme: Scheme,
    own: Sequence[Formation],
    epsilon: float,
    leaning: bool = False,
    savings: Sequence[Array] = (),
) -> Iterator[list[Stage]]:
    """Sequences of stages that a solution asks for, the most promising ones first.

    Parameters
    ----------
    stages                 with the solution as guesses
    own                    the formation that each stage's phase asks for: what rolls there has to
    leaning                whether only contacts count that lean on their cones
    savings : (K, d, n_c)  what friction the other way is worth in each stage over the cost, if that
                           is known
    """
    if leaning:
        runs = [
            (run, k)
            for k, stage in enumerate(stages)
            for run in _find_leaning(stage, scheme, own[k], epsilon)
        ]
        yield from _apply(stages, scheme, own, runs)
        return
    yield from list_dropped(stages)
    for index in range(len(stages)):
        left = release_earlier(stages, index)
        if left is not None:
            yield link(merge(left))
    for slow in (True, False):
        runs = list[tuple[ModeRun, int]]()
        for index, stage in enumerate(stages):
            held = _find_held(stage, scheme, slow)
            if savings:
                held = [run for run in held if _pays(run, stage, savings[index])]
            leaning_too = _find_leaning(stage, scheme, own[index], epsilon)
            runs += [(run, index) for run in [*held, *leaning_too]]
        yield from _apply(stages, scheme, own, runs)


def list_dropped(stages: Sequence[Stage]) -> Iterator[list[Stage]]:
    """The stages without one that has shrunk to nothing, for each of these."""
    for index, stage in enumerate(stages):
        if stage.guess.duration < _GONE * stage.intervals:
            left = drop(stages, index)
            if left is not None:
                yield link(merge(left))


def _apply(
    stages: Sequence[Stage],
    scheme: Scheme,
    own: Sequence[Formation],
    runs: list[tuple[ModeRun, int]],
) -> Iterator[list[Stage]]:
    """Stages in which what is at its limit over a run moves in another way.

    First over runs that go on from one stage to the next: changed in one of them alone, what is
    held back there would have to turn where the stages meet. Then over whole stages.
    """
    wide = [
        [(run._replace(begin=0, stop=stages[k].intervals), k)]
        for run, k in runs
        if _is_most(run, stages[k])
    ]
    across, single = _list_across(stages, runs), [[own] for own in runs]
    for group in (across, wide, single):
        group.sort(key=lambda found: -sum(run.share for run, _ in found))
    for found in [*across, *wide, *single]:
        pieces = [_turn(stages, index, run, own, scheme) for run, index in found]
        first, last = found[0][1], found[-1][1]
        if None not in pieces:
            own_stages = (stage for piece in pieces for stage in piece or ())
            yield link(merge([*stages[:first], *own_stages, *stages[last + 1 :]]))


def _list_across(
    stages: Sequence[Stage], runs: Sequence[tuple[ModeRun, int]]
) -> list[list[tuple[ModeRun, int]]]:
    """Runs of one thing that meet where stages of a phase do, without other runs beside them."""
    known = {(k, run.row, run.sign, _sign(stages[k], run)): run for run, k in runs}
    found = []
    for (k, row, sign, way), run in known.items():
        chain = [(run, k)]
        while (own := chain[-1])[0].stop == stages[own[1]].intervals:
            after = known.get((own[1] + 1, row, sign, way))
            if after is None or after.begin or stages[own[1] + 1].phase != stages[k].phase:
                break
            chain.append((after, own[1] + 1))
        if len(chain) > 1:
            found.append(chain)
    return found


def _sign(stage: Stage, run: ModeRun) -> float:
    """Which way what is at its limit moves in a stage."""
    return float(mode_of(stage).signs[run.row])


def _turn(
    stages: Sequence[Stage], index: int, run: ModeRun, own: Sequence[Formation], scheme: Scheme
) -> list[Stage] | None:
    """Pieces of a stage in which what is at its limit over a run moves in another way, if any."""
    signs = [run.sign] if run.sign else [0.0, -_sign(stages[index], run)]
    if _comes_to_rest(stages, index, own, run.row):
        signs = [sign for sign in signs if sign]
    pieces = [_change(stages, index, run, sign, scheme) for sign in signs]
    # What can roll turns by rolling first.
    return next((piece for piece in pieces if piece is not None), None)


def _pays(run: ModeRun, stage: Stage, savings: Array) -> bool:
    """Whether what is held back in a run might gain by rolling there, if it can."""
    if not _can_roll(stage, run):
        return True
    return float(savings[run.begin : run.stop, :, run.row].clip(min=0.0).sum()) > WORTH


def _can_roll(stage: Stage, run: ModeRun) -> bool:
    """Whether what is held back in a run may roll: by itself, with friction and freedoms left."""
    formation = stage.formation
    if run.row >= formation.n_contacts or formation.n_constraints >= 4:
        return False
    middle = stage.guess.z[(run.begin + run.stop) // 2, 0]
    alone = len(find_tied(formation, middle, run.row)) == 1
    return bool(alone and formation.friction[run.row] > 0)


def _comes_to_rest(stages: Sequence[Stage], index: int, own: Sequence[Formation], row: int) -> bool:
    """Whether a contact slides until its phase ends, since the next phase lets it roll."""
    stage = stages[index]
    last = max(k for k, other in enumerate(stages) if other.phase == stage.phase)
    if row >= stage.formation.n_contacts or last + 1 == len(stages):
        return False
    return stage.formation.contacts[row] in set(own[last + 1].rolling) - set(own[index].rolling)


def _is_most(run: ModeRun, stage: Stage) -> bool:
    """Whether a run is more than half of its stage."""
    return 2 * run.share > stage.guess.duration


def _change(
    stages: Sequence[Stage], index: int, run: ModeRun, sign: float, scheme: Scheme
) -> list[Stage] | None:
    """Pieces of a stage with another direction in a run, or None if that cannot be."""
    stage, formation = stages[index], stages[index].formation
    middle = stage.guess.z[(run.begin + run.stop) // 2, 0]
    rows = find_tied(formation, middle, run.row)
    if sign == 0 and not _can_roll(stage, run):
        return None
    mode = mode_of(stage).changed(rows, sign)
    # Where the neighbour is in that mode already, the place between them has been chosen.
    at_start, at_end = run.begin == 0, run.stop == stage.intervals
    if not (at_start and at_end):
        near = [stages[index - 1]] if at_start and index else []
        near += [stages[index + 1]] if at_end and index + 1 < len(stages) else []
        if any(other.phase == stage.phase and mode_of(other) == mode for other in near):
            return None
    return split(stage, scheme, run.begin, run.stop, mode)


def _find_held(stage: Stage, scheme: Scheme, slow: bool) -> list[ModeRun]:
    """Stretches over which a least rate holds something back.

    A polynomial that is held back touches the least rate at few points of an interval, so whole
    intervals count that touch it and are `slow` throughout, or else those that touch it twice.
    """
    formation, part = stage.formation, stage.guess
    z, v = part.z.reshape(-1, 5), part.v.reshape(-1, 5)
    senses = stage.measure_senses(z, v)
    fast = np.abs(v[:, 2:]).max()
    least = least_senses(stage, stage.guess.places(scheme.points))
    least = 1.01 * least.reshape(-1, least.shape[-1])
    touches = senses < least + _STALLED * fast
    touches &= (np.abs(senses).max(axis=1) > 1e-3 * fast)[:, None]
    shape = (stage.intervals, scheme.degree, -1)
    count = touches.reshape(shape).sum(axis=1)
    near = (senses < least + _SLOW * fast).reshape(shape).all(axis=1)
    held = np.repeat(near & (count > 0) if slow else count > 1, scheme.degree, axis=0)
    held[:, np.delete(np.arange(formation.n_contacts), formation.rubbing_rows)] = False
    return _find_runs(held, stage, scheme, np.zeros(held.shape[1]))


def _find_leaning(stage: Stage, scheme: Scheme, own: Formation, epsilon: float) -> list[ModeRun]:
    """Stretches over which a contact that need not roll leans on one side of its cone."""
    formation, n_c = stage.formation, stage.formation.n_contacts
    runs = []
    for k, row in enumerate(formation.rolling_rows):
        if formation.contacts[row] in own.rolling:
            continue
        c_n = stage.guess.forces[..., row].ravel()
        c_t = stage.guess.forces[..., n_c + k].ravel()
        mu = formation.friction[row]
        near = mu * (c_n - epsilon) - np.abs(c_t) < _LEANS * mu * c_n
        for sign in (1.0, -1.0):
            leaning = np.zeros((len(c_n), n_c + 2), dtype=bool)
            # Friction pushes against sliding.
            leaning[:, row] = near & (sign * c_t < 0)
            runs += _find_runs(leaning, stage, scheme, np.full(n_c + 2, sign))
    return runs


def _find_runs(
    flags: NDArray[np.bool_], stage: Stage, scheme: Scheme, signs: Array
) -> list[ModeRun]:
    """Longest run of True in each column, of shape (K d, n), if it is an interval long."""
    found = []
    for row, column in enumerate(flags.T):
        edges = np.flatnonzero(np.diff(np.concatenate([[0], column.astype(int), [0]])))
        runs = list(zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True))
        if not runs:
            continue
        first, last = max(runs, key=lambda run: run[1] - run[0])
        if last - first < scheme.degree:
            continue
        begin, stop = first // scheme.degree, -(-last // scheme.degree)
        breaks = stage.guess.breaks
        share = float(breaks[stop] - breaks[begin]) * stage.guess.duration
        found.append(ModeRun(row, begin, stop, float(signs[row]), share))
    return found
