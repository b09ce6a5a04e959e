from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from plane import make_formation
from test_time_layout import random_points
from timed import landing
from wholearm.contacts.formation import Formation
from wholearm.mechanics.dynamics import Directions, split_forces
from wholearm.planning.time_domain.collocation import make_scheme
from wholearm.planning.time_domain.stage import Stage
from wholearm.planning.time_domain.stage_modes import (
    LEAST_INTERVALS,
    StageMode,
    drop,
    in_mode,
    link,
    merge,
    mode_of,
    release_earlier,
    sign_sequence,
    split,
)
from wholearm.problem.definition import Until

SCHEME = make_scheme("radau", 3)


def make_stage(names: str, count: int = 8, phase: int = 0, **fields: object) -> Stage:
    formation = make_formation(landing().scene, names)
    rng = np.random.default_rng(count)
    guess = random_points(rng, count, 3, formation.n_constraints)
    directions = Directions(np.ones(formation.n_contacts), np.ones(2))
    return Stage(phase, formation, directions, guess, **fields)  # type: ignore[arg-type]


def turned(stage: Stage, *rows: int) -> StageMode:
    return mode_of(stage).changed(rows, -1.0)


def test_what_rolls_keeps_the_friction_that_it_has() -> None:
    stage = make_stage("v1-palm v4-finger1 v6-finger2")
    rolling = in_mode(stage, mode_of(stage).changed((1,), 0.0))
    assert rolling.formation.rolling == (stage.formation.contacts[1],)
    before = split_forces(stage.formation, stage.guess.forces, stage.directions.Xi)
    after = split_forces(rolling.formation, rolling.guess.forces, rolling.directions.Xi)
    for one, other in zip(before, after, strict=True):
        np.testing.assert_array_equal(one, other)
    # And back again, with kernels that are known.
    again = in_mode(rolling, mode_of(stage))
    np.testing.assert_array_equal(again.guess.forces, stage.guess.forces)
    assert in_mode(again, mode_of(rolling)).formation is rolling.formation


@pytest.mark.parametrize("begin, stop", [(0, 2), (2, 4), (5, 8), (0, 8)])
def test_pieces_of_a_stage_are_linked(begin: int, stop: int) -> None:
    until = Until(coordinate="x", value=0.1)
    stage = make_stage("v1-palm v4-finger1 v6-finger2", until=until, opens=True)
    pieces = link(split(stage, SCHEME, begin, stop, turned(stage, 0)))
    ends = sorted({0, begin, stop, 8})
    assert len(pieces) == len(ends) - 1
    for piece, start, end in zip(pieces, ends[:-1], ends[1:], strict=True):
        assert piece.directions.Xi[0] == (-1.0 if start == begin else 1.0)
        share = stage.guess.fractions[start:end].sum()
        assert piece.guess.duration == pytest.approx(share * stage.guess.duration, rel=1e-12)
        assert piece.intervals >= LEAST_INTERVALS
        # Between two pieces the contact comes to rest; the last one ends as the whole did.
        assert piece.turns == (() if end == 8 else (0,))
        assert (piece.until is until) == (end == 8) and piece.opens == (start == 0)


def test_what_rolls_next_comes_to_rest_and_what_slides_on_starts_from_it() -> None:
    stage = make_stage("v1-palm v4-finger1 v6-finger2")
    first, middle, last = link(split(stage, SCHEME, 3, 6, mode_of(stage).changed((0,), 0.0)))
    assert first.gained is middle.formation and first.turns == ()
    assert middle.gained is None and middle.turns == () and last.gained is None


def test_merging_undoes_splitting() -> None:
    stage = make_stage("v1-palm v4-finger1 v6-finger2", 9)
    pieces = split(stage, SCHEME, 3, 6, turned(stage, 0))
    (whole,) = merge([in_mode(piece, mode_of(stage)) for piece in pieces])
    assert whole.guess.duration == pytest.approx(stage.guess.duration, rel=1e-12)
    np.testing.assert_allclose(whole.guess.fractions, stage.guess.fractions, rtol=1e-12)
    assert len(merge(pieces)) == 3
    # Phases stay apart.
    assert len(merge([stage, replace(stage, phase=1)])) == 2
    assert sign_sequence(pieces) != sign_sequence([whole])


def test_a_stage_that_is_dropped_leaves_its_duties_to_its_neighbours() -> None:
    stage = make_stage("v1-palm v4-finger1 v6-finger2", opens=True, until=Until(coordinate="x"))
    first, last = split(stage, SCHEME, 0, 4, turned(stage, 0))
    assert first.opens and first.until is None and last.until is not None
    (left,) = drop([first, last], 0) or [first]
    assert left.opens and left.until is last.until
    (left,) = drop([first, last], 1) or [first]
    assert left.opens and left.until is last.until and left.directions is first.directions
    assert drop([first, replace(last, phase=1)], 0) is None


def test_releasing_earlier_hands_a_stage_to_the_next_phase() -> None:
    names = "v1-palm v3-finger1 v4-finger1 v6-finger2"
    before, holding = make_stage(names), make_stage(names, 5)
    free = make_stage("v1-palm v4-finger1 v6-finger2", 6, phase=1, opens=True)
    stages = release_earlier([before, holding, free], 1)
    assert stages is not None
    assert [stage.phase for stage in stages] == [0, 1, 1]
    assert [stage.opens for stage in stages] == [False, True, False]
    moved = stages[1]
    assert moved.formation is free.formation
    np.testing.assert_array_equal(moved.guess.forces, holding.guess.forces[..., [0, 2, 3]])
    # A phase keeps one stage at least, and what is gained cannot be held before.
    assert release_earlier([before, holding, free], 0) is None
    assert release_earlier([before, free], 0) is None
    assert release_earlier([before, replace(holding, until=Until()), free], 1) is None


def test_formations_in_other_modes_are_of_the_same_scene() -> None:
    stage = make_stage("v1-palm v4-finger1")
    rolling = in_mode(stage, StageMode((0.0, 1.0, 1.0, 1.0)))
    assert isinstance(rolling.formation, Formation)
    assert rolling.formation.scene is stage.formation.scene
