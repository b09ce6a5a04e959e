from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest

from plane import make_formation
from timed import landing, tables
from tipping import roll
from wholearm.common.arrays import Array
from wholearm.contacts.formation import Formation
from wholearm.mechanics.dynamics import Directions, split_forces
from wholearm.planning.time_domain.collocation import make_scheme
from wholearm.planning.time_domain.mode_search import (
    StageMode,
    in_mode,
    link,
    list_moves,
    merge,
    mode_of,
    split,
)
from wholearm.planning.time_domain.nlp_layout import (
    MARGIN,
    STATE,
    StageLayout,
    V,
    Z,
    lay_out,
    pack,
    unpack,
)
from wholearm.planning.time_domain.stage import Stage, StagePoints, resample

SCHEMES = [("radau", 2), ("radau", 3), ("legendre", 2), ("legendre", 4)]


def random_points(
    rng: np.random.Generator, count: int, degree: int, n_f: int, n_p: int = 0
) -> StagePoints:
    table = (count, degree)
    return StagePoints(
        float(rng.uniform(0.1, 0.4)),
        np.full(count, 1 / count),
        rng.normal(size=(count + 1, 2, 5)),
        rng.normal(size=(*table, 5)),
        rng.normal(size=(*table, 5)),
        rng.normal(size=(*table, 5)),
        rng.normal(size=(*table, n_f)),
        rng.normal(size=(count, 2, 2)),
        rng.normal(size=n_p),
    )


def make_stages(name: str, degree: int, ends_in_impact: bool) -> list[Stage]:
    """Three stages on different formations, one with a rolling contact."""
    rng = np.random.default_rng(degree)
    scene = landing().scene
    formations = [
        make_formation(scene, "v1-palm v3-finger1 v4-finger1 v6-finger2"),
        roll(make_formation(scene, "v1-palm v4-finger1"), "v1-palm"),
        make_formation(scene, "v1-palm"),
    ]
    stages = []
    for k, (formation, count) in enumerate(zip(formations, (3, 4, 5), strict=True)):
        hits = ends_in_impact and k == 0
        n_p = formations[1].n_constraints if hits else 0
        guess = random_points(rng, count, degree, formation.n_constraints, n_p)
        if make_scheme(name, degree).ends:
            # The last point of an interval and the node after it are one instant.
            guess.nodes[1:] = np.stack([guess.z[:, -1], guess.v[:, -1]], axis=1)
        directions = Directions(np.ones(formation.n_contacts), np.ones(2))
        stages.append(Stage(k, formation, directions, guess, ends_in_impact=hits))
    return stages


def owners(layouts: Sequence[StageLayout]) -> Array:
    """How often each unknown occurs in the layouts, but for ends of intervals that are points'."""
    counts = np.zeros(layouts[-1].stop)
    for layout in layouts:
        last = np.concatenate([layout.z[:, -1], layout.v[:, -1]], axis=1)
        own = ~np.isin(layout.nodes, last)
        assert own[1:, :STATE].all() or not own[1:, :STATE].any()
        tables = [*(getattr(layout, n) for n in ("h", "tau", "z", "v", "a", "forces"))]
        for table in (layout.nodes[own], *tables, layout.short, layout.impulses):
            np.add.at(counts, table.ravel().astype(int), 1)
    return counts


@pytest.mark.parametrize("elastic", [False, True])
@pytest.mark.parametrize("with_margin", [False, True])
@pytest.mark.parametrize("ends_in_impact", [False, True])
@pytest.mark.parametrize("name, degree", SCHEMES)
def test_every_unknown_has_one_place(
    name: str, degree: int, ends_in_impact: bool, with_margin: bool, elastic: bool
) -> None:
    scheme = make_scheme(name, degree)
    layouts = lay_out(
        make_stages(name, degree, ends_in_impact),
        scheme,
        with_margin,
        [6, 5, 3] if elastic else None,
    )
    np.testing.assert_array_equal(owners(layouts), 1.0)
    assert layouts[0].nodes.shape == (4, 11 if with_margin else 10)
    assert [len(layout.impulses) for layout in layouts] == [3 if ends_in_impact else 0, 0, 0]
    assert [layout.short.shape[1] for layout in layouts] == ([6, 5, 3] if elastic else [0] * 3)


@pytest.mark.parametrize("with_margin", [False, True])
@pytest.mark.parametrize("ends_in_impact", [False, True])
@pytest.mark.parametrize("name, degree", SCHEMES)
def test_points_are_packed_and_unpacked(
    name: str, degree: int, ends_in_impact: bool, with_margin: bool
) -> None:
    stages = make_stages(name, degree, ends_in_impact)
    layouts = lay_out(stages, make_scheme(name, degree), with_margin)
    given = [stage.guess for stage in stages]
    x = pack(given, layouts, 0.7)
    assert x.shape == (layouts[-1].stop,)
    for one, other in zip(given, unpack(x, layouts), strict=True):
        for mine, yours in zip(tables(one), tables(other), strict=True):
            # Shares are multiplied by the duration and divided by their sum.
            np.testing.assert_allclose(yours, mine, rtol=1e-14)
    for part, layout in zip(given, layouts, strict=True):
        np.testing.assert_array_equal(x[layout.h], part.duration * part.fractions)
        np.testing.assert_array_equal(x[layout.nodes[:, Z]], part.nodes[:, 0])
        np.testing.assert_array_equal(x[layout.nodes[:, V]], part.nodes[:, 1])
        np.testing.assert_array_equal(x[layout.a], part.a)
        if with_margin:
            np.testing.assert_array_equal(x[layout.nodes[:, MARGIN]], 0.7)


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


THREE = "v1-palm v4-finger1 v6-finger2"


def smooth(part: StagePoints, v: Array | None = None) -> StagePoints:
    """The part with a motion that is one cubic in time, which any intervals carry exactly."""

    def follow(share: Array) -> Array:
        return np.asarray(np.stack([(k + 1) * share + share**3 for k in range(5)], axis=-1))

    places, breaks = part.places(SCHEME.points), part.breaks
    rates = [follow(places), follow(breaks)] if v is None else [v, follow(breaks)]
    nodes = np.stack([follow(breaks), rates[1]], axis=1)
    return part._replace(nodes=nodes, z=follow(places), v=rates[0])


def cubic_stage(**fields: object) -> Stage:
    stage = make_stage(THREE, **fields)  # type: ignore[arg-type]
    return replace(stage, guess=smooth(stage.guess))


def sample(stages: list[Stage], count: int = 41) -> tuple[float, Array]:
    """The duration of stages, and z at shares of it, shape (count, 5)."""
    total = sum(stage.guess.duration for stage in stages)
    passed, rows = 0.0, []
    shares = np.linspace(0.0, 1.0, count)
    for stage in stages:
        length = stage.guess.duration / total
        last = stage is stages[-1]
        mine = shares[(shares >= passed - 1e-9) & ((shares < passed + length - 1e-9) | last)]
        breaks = np.unique(np.clip(np.concatenate([[0.0, 1.0], (mine - passed) / length]), 0, 1))
        part = resample(stage.guess, SCHEME, breaks)
        where = np.searchsorted(part.breaks, np.clip((mine - passed) / length, 0, 1) - 1e-9)
        rows.append(part.nodes[where, 0])
        passed += length
    return float(total), np.concatenate(rows)


def assert_same_motion(before: list[Stage], after: list[Stage]) -> None:
    (total, z), (other, moved) = sample(before), sample(after)
    assert other == pytest.approx(total, rel=1e-12)
    assert len(z) == len(moved) == 41
    np.testing.assert_allclose(moved, z, atol=1e-9)


@pytest.mark.parametrize("begin, stop", [(0, 2), (2, 4), (5, 8), (0, 8)])
def test_splitting_and_replacing_keep_the_motion(begin: int, stop: int) -> None:
    stage = cubic_stage()
    pieces = split(stage, SCHEME, begin, stop, turned(stage, 0))
    assert_same_motion([stage], pieces)
    assert_same_motion([stage], [in_mode(stage, turned(stage, 1))])
    modes = [mode_of(piece) for piece in pieces]
    assert modes.count(turned(stage, 0)) == 1
    assert set(modes) <= {mode_of(stage), turned(stage, 0)}


def test_merging_keeps_the_motion() -> None:
    stage = cubic_stage()
    pieces = [in_mode(p, mode_of(stage)) for p in split(stage, SCHEME, 2, 5, turned(stage, 0))]
    merged = merge(pieces)
    assert len(merged) == 1
    assert_same_motion([stage], merged)


def own_formations(stages: list[Stage]) -> list[Formation]:
    return [make_stage(THREE).formation for _ in stages]


def hold_back(stage: Stage, joint: int, begin: int, stop: int) -> Stage:
    """The stage with contacts and joints that move, and a joint held back over intervals."""
    v = np.full_like(stage.guess.v, 1.0)
    v[begin:stop, :, 3 + joint] = 0.0
    # A polynomial that is held back touches the least rate in places only.
    v[begin:stop, 0, 3 + joint] = 5e-3
    formation = stage.formation
    z = np.broadcast_to(stage.guess.z[0, 0], stage.guess.z.shape)
    A_t = formation.evaluate(z.reshape(-1, 5), v.reshape(-1, 5)).A_t
    slip = np.einsum("nij,nj->ni", A_t, v.reshape(-1, 5))
    # What slides does so the way it is said to, all along.
    Xi = np.sign(slip[-1])
    directions = stage.directions._replace(Xi=Xi)
    return replace(stage, directions=directions, guess=stage.guess._replace(z=z.copy(), v=v))


@pytest.mark.parametrize("begin, stop", [(2, 4), (1, 7)])
@pytest.mark.parametrize("joint", [0, 1])
def test_a_joint_that_is_held_back_is_let_turn_the_other_way(
    joint: int, begin: int, stop: int
) -> None:
    stage = hold_back(make_stage(THREE), joint, begin, stop)
    found = list(list_moves([stage], SCHEME, own_formations([stage]), 0.05))
    row = stage.formation.n_contacts + joint
    ways = [[mode_of(part).signs[row] for part in stages] for stages in found]
    # Over the stretch alone; over all of the stage too where it is most of it.
    assert [1.0, -1.0, 1.0] in ways
    assert ([-1.0] in ways) == (stop - begin > 4)
    # Joints do not roll.
    assert all(0.0 not in way for way in ways)


def test_what_is_held_back_on_both_sides_of_a_change_turns_on_both() -> None:
    """On one side alone it would have to come to rest where the stages meet."""
    first, last = hold_back(make_stage(THREE), 0, 5, 8), hold_back(make_stage(THREE), 0, 0, 3)
    slid = mode_of(last).changed((0,), -mode_of(last).signs[0])
    last = replace(last, directions=in_mode(last, slid).directions)
    row = first.formation.n_contacts

    def list_signs(stages: list[Stage]) -> list[list[float]]:
        moves = list_moves(stages, SCHEME, own_formations(stages), 0.05)
        return [[mode_of(part).signs[row] for part in own] for own in moves]

    signs = list_signs([first, last])
    assert signs[0] == [1.0, -1.0, -1.0, 1.0]
    assert [1.0, -1.0, 1.0] in signs
    # It may be at rest where phases meet.
    assert [1.0, -1.0, -1.0, 1.0] not in list_signs([first, replace(last, phase=first.phase + 1)])


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_what_leans_on_its_cone_is_let_slide_that_way(sign: float) -> None:
    sliding = hold_back(make_stage(THREE), 0, 0, 0)
    stage = in_mode(sliding, mode_of(sliding).changed((0,), 0.0))
    forces = np.full_like(stage.guess.forces, 1.0)
    forces[..., -1] = 0.0
    # Friction of 0.1 times (1 - 0.05), against sliding.
    forces[2:4, :, -1] = -sign * 0.095
    stage = replace(stage, guess=stage.guess._replace(forces=forces))
    (found,) = list_moves([stage], SCHEME, own_formations([stage]), 0.05, leaning=True)
    assert [mode_of(part).signs[0] for part in found] == [0.0, sign, 0.0]
    # What its phase asks to roll goes on rolling.
    assert not list(list_moves([stage], SCHEME, [stage.formation], 0.05, leaning=True))


def test_what_the_next_phase_lets_roll_slides_until_then() -> None:
    """Where it comes to rest its phase ends, so it does not roll before."""
    held = hold_back(make_stage(THREE), 0, 0, 0)
    formation = held.formation
    v = held.guess.v.copy()
    A_t = formation.evaluate(held.guess.z.reshape(-1, 5), v.reshape(-1, 5)).A_t.reshape(
        *v.shape[:2], -1, 5
    )
    # Without what slides the first contact, it stands still over some intervals.
    row = A_t[2:5, :, 0]
    slip = np.einsum("kdi,kdi->kd", row, v[2:5]) / np.einsum("kdi,kdi->kd", row, row)
    v[2:5] -= slip[..., None] * row
    held = replace(held, guess=held.guess._replace(v=v))
    rolling = in_mode(held, mode_of(held).changed((0,), 0.0))
    later = replace(rolling, phase=held.phase + 1)
    for own, rolls in (([formation, rolling.formation], False), ([formation] * 2, True)):
        found = list(list_moves(link([held, later]), SCHEME, own, 0.05))
        parts = [part for stages in found for part in stages if part.phase == held.phase]
        signs = {mode_of(part).signs[0] for part in parts}
        assert (0.0 in signs) == rolls
        # Turning is then what is left.
        assert (-mode_of(held).signs[0] in signs) != rolls
