from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import cache, lru_cache
from typing import Any

import numpy as np
import pytest

import wholearm.planning.time_domain.guesses as guesses
import wholearm.planning.time_domain.mode_search as mode_search
from plane import finger_gap, make_formation, measure_slip
from scenes import heave, make_way, measure_fingers, raised, roll, tilting
from timed import instants, landing, plan_landing, stages_of, tables
from wholearm import End, Formation, Objective, PlanOptions, Problem, Trajectory, Until, verify
from wholearm.common.arrays import Array
from wholearm.mechanics.dynamics import Directions, split_forces
from wholearm.mechanics.limits import CONE, PRESS, make_limits
from wholearm.planning.plan import solve
from wholearm.planning.time_domain.collocation import make_scheme
from wholearm.planning.time_domain.guesses import guess_stages
from wholearm.planning.time_domain.mode_search import (
    WORTH,
    StageMode,
    improve,
    in_mode,
    link,
    list_moves,
    merge,
    mode_of,
    split,
)
from wholearm.planning.time_domain.refinement import (
    SETTINGS,
    check_between,
    find_misses,
    measure_misses,
)
from wholearm.planning.time_domain.search import TimeSearch, TimeSolution
from wholearm.planning.time_domain.stage import LimitMisses, Stage, StagePoints, resample
from wholearm.planning.time_domain.time_motion import StageMotion, TimeMotion
from wholearm.planning.time_domain.time_nlp import (
    MARGIN,
    STATE,
    StageLayout,
    Target,
    V,
    Z,
    lay_out,
    pack,
    unpack,
)
from wholearm.planning.time_domain.time_plan import plan_phases
from wholearm.verification.verdict import DEPARTURE

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


@pytest.mark.parametrize("objective", [Objective.TIME, Objective.MARGIN, Objective.ELASTIC])
@pytest.mark.parametrize("ends_in_impact", [False, True])
@pytest.mark.parametrize("name, degree", SCHEMES)
def test_every_unknown_has_one_place(
    name: str, degree: int, ends_in_impact: bool, objective: Objective
) -> None:
    scheme, stages = make_scheme(name, degree), make_stages(name, degree, ends_in_impact)
    layouts = lay_out(stages, scheme, Target(objective, 0.05))
    np.testing.assert_array_equal(owners(layouts), 1.0)
    assert layouts[0].nodes.shape == (4, 10 + (objective is Objective.MARGIN))
    assert [len(layout.impulses) for layout in layouts] == [3 if ends_in_impact else 0, 0, 0]
    # Normal forces, friction cones and two torques may be short.
    short = [6, 5, 3] if objective is Objective.ELASTIC else [0, 0, 0]
    assert [layout.short.shape[1] for layout in layouts] == short


@pytest.mark.parametrize("with_margin", [False, True])
@pytest.mark.parametrize("ends_in_impact", [False, True])
@pytest.mark.parametrize("name, degree", SCHEMES)
def test_points_are_packed_and_unpacked(
    name: str, degree: int, ends_in_impact: bool, with_margin: bool
) -> None:
    stages = make_stages(name, degree, ends_in_impact)
    objective = Objective.MARGIN if with_margin else Objective.TIME
    layouts = lay_out(stages, make_scheme(name, degree), Target(objective, 0.05))
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


EPSILON = 0.05


def as_stage(motion: StageMotion, **fields: object) -> Stage:
    stage = Stage(0, motion.formation, motion.directions, motion.points)
    return replace(stage, **fields)  # type: ignore[arg-type]


def in_newtons(stage: Stage, misses: LimitMisses, kind: str) -> Array:
    """Misses of one kind of limits of forces, shape (K, n)."""
    limits = make_limits(stage.formation, EPSILON)
    return (
        misses.held[:, np.isin(limits.sides[0], limits.of(kind))]
        * stage.formation.scene.scales.force
    )


def check(stage: Stage, motion: StageMotion, *least: float) -> LimitMisses:
    return find_misses(stage, check_between(stage, motion), *least)


@lru_cache(maxsize=1)
def landed() -> list[StageMotion]:
    return stages_of(plan_landing(time_intervals=6))


@lru_cache(maxsize=1)
def heaved() -> StageMotion:
    """The first phase of a plan with a rolling contact."""
    problem, _ = heave()
    plans = plan_phases(problem, problem.phases, problem.start, PlanOptions(time_intervals=6))
    return plans[0].motion.stages[0]


def test_a_plan_keeps_limits_between_points_too() -> None:
    """It would not on so few intervals, were limits not tightened there."""
    for motion in landed():
        stage, size = as_stage(motion), motion.formation.scene.scales.force
        misses = check(stage, motion, EPSILON)
        assert misses.held.shape == (stage.intervals, motion.formation.n_contacts + 4)
        assert measure_misses(misses).max() <= 1
        assert motion.evaluate(instants(motion, 41)).c_n.min() > EPSILON - 2 * SETTINGS.miss * size


def test_forces_are_missed_by_what_their_least_value_lacks() -> None:
    inside = np.linspace(1e-9, 1 - 1e-9, 401)
    for motion in landed():
        stage = as_stage(motion)
        t = motion.duration * motion.points.places(inside).ravel()
        dense = motion.evaluate(t).c_n.reshape(stage.intervals, 401, -1)
        asked = float(np.median(dense))
        misses = check(stage, motion, asked)
        expected = np.maximum(asked - dense.min(axis=1), 0.0)
        # Parabolas through 25 checks, of forces that are smooth inside an interval.
        pressed = in_newtons(stage, misses, PRESS)
        np.testing.assert_allclose(pressed, expected, atol=1e-3 * np.ptp(dense))
        assert measure_misses(misses).max() == pytest.approx(misses.held.max() / SETTINGS.miss)
        # A margin asks for as much as a larger epsilon.
        same = check(stage, motion, EPSILON, asked - EPSILON)
        again = in_newtons(stage, same, PRESS)
        np.testing.assert_allclose(again, pressed, atol=1e-12 * asked)


def test_cones_are_missed_by_what_epsilon_takes_from_them_but_the_margin_does_not() -> None:
    motion = heaved()
    stage = as_stage(motion)
    row = motion.formation.rolling_rows[0]
    mu = motion.formation.friction[row]
    dense = motion.evaluate(instants(motion, 200))
    grip = mu * dense.c_n[:, row] - np.abs(dense.c_t[:, row])
    least = grip.reshape(stage.intervals, 200).min(axis=1)
    assert not in_newtons(stage, check(stage, motion, EPSILON), CONE).any()
    large = 1.0 + least.min() / mu
    misses = in_newtons(stage, check(stage, motion, large), CONE).max(axis=1)
    np.testing.assert_allclose(misses, np.maximum(mu * large - least, 0), atol=0.02)
    assert misses.max() > 1.0
    assert not in_newtons(stage, check(stage, motion, EPSILON, large), CONE).any()


@lru_cache(maxsize=1)
def make_way_twice() -> tuple[Trajectory, Trajectory]:
    """Plans of least effort with fingers that pass each other, and with solid ones."""
    options: dict[str, Any] = {"time_intervals": 8, "replay": False}
    passing, solid = (
        solve(make_way(solid), "effort", **options).trajectory for solid in (False, True)
    )
    return passing, solid


def test_the_links_are_kept_apart_between_points_too() -> None:
    """Left alone, finger 1 would let the other link swing through it."""
    passing, solid = make_way_twice()
    scene = make_way(solid=True).scene
    least = []
    for plan in (passing, solid):
        (motion,) = plan.motions
        z = motion.evaluate(np.linspace(0.0, motion.duration, 4001)).z
        least.append(float(measure_fingers(scene, z).min()))
        for k in (0, 1):
            assert finger_gap(scene, z[::20, :3], k, z[::20, 3 + k]).min() > -2e-8
    assert least[0] < -5e-3 and least[1] > -2e-8
    # With less that is allowed effort is larger, to the accuracy of plans.
    assert solid.meta["value"] > (1 - 1e-4) * passing.meta["value"]


OPTIONS = PlanOptions(time_intervals=10)


def outlined(problem: Problem, count: int = 10) -> tuple[TimeSearch, list[Stage]]:
    search = TimeSearch.of(problem, OPTIONS)
    start = problem.start
    return search, guess_stages(problem, problem.phases, start, search.scheme, count, 2.0)


def turn_joint(stages: list[Stage], joint: int) -> list[Stage]:
    """The same stages with a joint that turns the other way."""
    turned = []
    for stage in stages:
        sigma = stage.directions.sigma.copy()
        sigma[joint] *= -1
        turned.append(replace(stage, directions=Directions(stage.directions.Xi, sigma)))
    return link(turned)


@cache
def alphabet() -> dict[str, Stage]:
    """A stage in several modes, by name: sequences below are words of these; "r" rolls."""
    (stage,) = outlined(raised(), 4)[1]
    signs = {"a": (1, -1, -1), "b": (1, 1, -1), "c": (1, -1, 1), "d": (1, 1, 1), "r": (0, -1, -1)}
    return {
        name: in_mode(stage, StageMode((float(palm), 1.0, 1.0, float(one), float(two))))
        for name, (palm, one, two) in signs.items()
    }


def word_of(stages: list[Stage]) -> str:
    names = {mode_of(stage): name for name, stage in alphabet().items()}
    return "".join(names[mode_of(stage)] for stage in stages)


class Priced(TimeSearch):
    """A search whose solves cost what a table says, and fail for sequences that it leaves out."""

    costs: Mapping[str, float]
    asked: list[str]

    def solve(
        self,
        stages: list[Stage],
        before: TimeSolution | None = None,
        most: int = 0,
        raised: Any = None,
    ) -> TimeSolution:
        self.asked.append(word_of(stages))
        return self.answer(stages, self.costs.get(self.asked[-1], math.inf))

    def answer(self, stages: list[Stage], cost: float) -> TimeSolution:
        return TimeSolution(stages, cost, 0.0, "", math.isfinite(cost), None, {})  # type: ignore[arg-type]


LESS, MORE = 1 - 2 * WORTH, 1 + 2 * WORTH


@pytest.mark.parametrize(
    ("begin", "costs", "moves", "asked", "found"),
    [
        pytest.param(
            "a", {"b": 0.9, "c": 0.8}, {"a": "b d", "b": "a c"}, "b c", "c", id="down, step by step"
        ),
        pytest.param("a", {"b": LESS}, {"a": "b"}, "b", "b", id="worth it"),
        pytest.param("a", {"b": 1 - WORTH / 2}, {"a": "b"}, "b", "a", id="not worth it"),
        pytest.param("ab", {"b": 1 + WORTH / 2}, {"ab": "b"}, "b", "b", id="one stage less"),
        pytest.param("ab", {"b": MORE}, {"ab": "b"}, "b", "ab", id="one stage less, but dearer"),
        # A stage of no length gains by the intervals beside it; then there is one stage less.
        pytest.param(
            "a", {"ba": 0.9, "a": 0.9}, {"a": "ba", "ba": "a"}, "ba a", "a", id="of no length"
        ),
        pytest.param("ab", {"c": 2.0}, {"ab": "c c"}, "c", "ab", id="the same one twice"),
        pytest.param(
            "a", {"r": 1.1, "b": 0.9}, {"a": "r", "r*": "b"}, "r b", "b", id="leans where it rolls"
        ),
        pytest.param("a", {"d": 0.5}, {"a": "b c bc d"}, "b c bc", "a", id="lost three times"),
        pytest.param(
            "a",
            {"d": 0.5, "cd": 0.4},
            {"a": "b c d", "d": "bc bd cd"},
            "b c d bc bd cd",
            "cd",
            id="lost, and again after a gain",
        ),
    ],
)
def test_modes_change_for_as_long_as_that_gains(
    monkeypatch: pytest.MonkeyPatch,
    begin: str,
    costs: dict[str, float],
    moves: dict[str, str],
    asked: str,
    found: str,
) -> None:
    """Which sequences are solved for, in which order, and what is kept; the first one costs 1.

    Moves from what rolls and is no better are those of contacts that lean, "r*".
    """
    own = Priced(**vars(outlined(raised(), 4)[0]))
    own.costs, own.asked = costs, []

    def list_moves(
        search: TimeSearch, solution: TimeSolution, leaning: bool = False
    ) -> list[list[Stage]]:
        words = moves.get(word_of(solution.stages) + "*" * leaning, "").split()
        return [[alphabet()[name] for name in word] for word in words]

    monkeypatch.setattr(mode_search, "list_neighbours", list_moves)
    best = improve(own, own.answer([alphabet()[name] for name in begin], 1.0))
    assert own.asked == asked.split() and word_of(best.stages) == found
    assert own.tried.sequences == 1 + len(own.asked)
    assert own.tried.complete == ({*moves.get(found, "").split()} <= {begin, *own.asked})


def test_plans_are_the_same_whichever_way_a_joint_is_guessed(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    problem = raised()

    def guess_wrong(*given: object, **named: object) -> list[Stage]:
        return turn_joint(guess_stages(*given, **named), 1)  # type: ignore[arg-type]

    (right,) = plan_phases(problem, problem.phases, problem.start, OPTIONS)
    monkeypatch.setattr(guesses, "guess_stages", guess_wrong)
    (plan,) = plan_phases(problem, problem.phases, problem.start, OPTIONS)
    assert plan.motion.duration == pytest.approx(right.motion.duration, rel=1e-3)
    for stage in plan.motion.stages:
        samples = stage.evaluate(instants(stage, 12))
        slip = measure_slip(stage.formation, samples.z, samples.z_dot)
        joints = samples.z_dot[:, 3:]
        assert (slip * stage.directions.Xi).min() > -1e-4 * np.abs(slip).max()
        assert (joints * stage.directions.sigma).min() > -1e-4 * np.abs(joints).max()


def test_what_may_slide_or_roll_is_faster_than_what_has_to_roll() -> None:
    """Rolling throughout is one of its motions, with one freedom: the bound is along a curve."""
    problem = tilting()
    (phase,) = problem.phases
    rolls = replace(phase, formation=roll(phase.formation, "v1-palm"))
    bound = solve(replace(problem, phases=(rolls,)), intervals=10, replay=False).trajectory
    plan = solve(problem, time_intervals=6, replay=False).trajectory
    assert plan.duration < 0.95 * bound.duration
    report = verify(problem, plan)
    assert report.ok, report.to_text()


def test_a_contact_slides_in_one_phase_and_rolls_in_the_next() -> None:
    sliding = tilting()
    (phase,) = sliding.phases
    rolling = roll(phase.formation, "v1-palm")
    first = replace(phase, until=Until(), end=End.SMOOTH)
    last = replace(phase, index=1, formation=rolling)
    problem = replace(sliding, phases=(first, last))
    plan = solve(problem, time_intervals=5, replay=False).trajectory
    report = verify(problem, plan)
    assert report.ok, report.to_text()
    assert report.phases[0].until == "change of v1-palm"
    ends = np.cumsum([motion.duration for motion in plan.motions])
    # How late a contact comes to rest, or slips, is an error of its speed over what slows it down,
    # or of its force over how fast that grows: no more than a replay may depart.
    assert report.phases[0].arrival == pytest.approx(ends[0], abs=DEPARTURE * ends[1])
    # No interval is halved for ever, and neither phase shrinks to nothing.
    motions = [motion for motion in plan.motions if isinstance(motion, TimeMotion)]
    stages = [stage for motion in motions for stage in motion.stages]
    assert sum(len(stage.points.fractions) for stage in stages) <= 2 * SETTINGS.intervals
    assert min(motion.duration for motion in plan.motions) > 0.1 * plan.duration
    # What rolls does so all along; what slides has friction against its motion.
    for motion, rolls in zip(motions, (False, True), strict=True):
        for stage in motion.stages:
            samples = stage.evaluate(instants(stage, 12))
            slip = measure_slip(stage.formation, samples.z, samples.z_dot)[:, 0]
            mu = stage.formation.friction[0]
            share = samples.c_t[:, 0] / (mu * samples.c_n[:, 0])
            assert bool(stage.formation.rolling) == rolls
            if rolls:
                assert np.abs(slip).max() < 1e-9 and np.abs(share).max() < 1.0
            else:
                Xi = stage.directions.Xi[0]
                assert mu > 0 and (slip * Xi).min() > -1e-4 * np.abs(slip).max()
                np.testing.assert_allclose(share, -Xi, rtol=1e-9)
