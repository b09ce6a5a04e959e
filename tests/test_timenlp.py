from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from plane import with_speed_limit
from planned import CosineMotion
from wholearm.collocation import Scheme, radau
from wholearm.curve import Curve
from wholearm.dynamics import Directions
from wholearm.model import Array
from wholearm.options import Objective
from wholearm.problem import Problem
from wholearm.stage import Stage, StagePoints
from wholearm.timenlp import LONGEST, SHORTEST, TimeNLP, bound_unknowns, build_time_nlp

EXACT = 1e-12
"""What rounding leaves of equations whose terms are about one."""
PHASE = 3
"""Of the heptagon, without a reversal."""


@pytest.fixture(scope="module")
def motion(curves: tuple[Curve, ...]) -> CosineMotion:
    """A phase from rest to rest along its curve, with forces inside their limits."""
    return CosineMotion(curves[PHASE], 0.2, 15.0)


def sample(motion: CosineMotion, scheme: Scheme, count: int) -> StagePoints:
    t = (np.arange(count)[:, None] + scheme.points).ravel() * motion.duration / count
    z, v, a, tau, c_n, _ = motion.evaluate(t)
    return StagePoints(motion.duration, z, v, a, c_n, tau)


def make_stage(problem: Problem, motion: CosineMotion, points: StagePoints) -> Stage:
    curve = motion.curve
    segment = curve.segments[0]
    z = np.vstack([curve.evaluate(np.zeros(1)).z, points.z])
    directions = Directions(segment.Xi, segment.sigma)
    until = problem.phases[PHASE].until
    return Stage(PHASE, curve.formation, directions, z, motion.duration, until)


def build(stages: list[Stage], scheme: Scheme, objective: Objective = Objective.TIME) -> TimeNLP:
    return build_time_nlp(stages, scheme, (stages[0].z[0], np.zeros(5)), objective, 3.0, 1)


def plain_limits(problem: Problem, stages: list[Stage], scheme: Scheme) -> Array:
    """Parameters of the NLP: epsilon and torque limit in each interval."""
    parts = []
    for stage in stages:
        count = (len(stage.z) - 1) // scheme.degree
        parts.append(np.full(stage.formation.n_contacts * count, problem.epsilon))
        parts.append(np.tile(problem.scene.torque_limit, count))
    return np.concatenate(parts)


def call(nlp: TimeNLP, part: str, x: Array, p: Array) -> Array:
    values: Any = nlp.solver.get_function(part)(x, p)
    return np.asarray(values.full()[:, 0])


def split_rows(nlp: TimeNLP, values: Array) -> tuple[Array, Array]:
    """What equations and inequalities miss, each negative or zero where it holds."""
    equal = nlp.low == nlp.high
    miss = np.maximum(nlp.low - values, values - nlp.high)
    return np.abs(values - nlp.low)[equal], miss[~equal]


def residuals(problem: Problem, motion: CosineMotion, degree: int, count: int) -> Array:
    scheme = radau(degree)
    points = sample(motion, scheme, count)
    stage = make_stage(problem, motion, points)
    nlp = build([stage], scheme)
    values = call(nlp, "nlp_g", points.pack(), plain_limits(problem, [stage], scheme))
    equations, inequalities = split_rows(nlp, values)
    # With friction's senses, c_n and torques inside their limits the motion is feasible.
    assert inequalities.max() < EXACT
    return equations


@pytest.mark.parametrize("degree", [2, 3, 4])
def test_an_exact_motion_satisfies_the_equations_to_the_schemes_order(
    heptagon: Problem, motion: CosineMotion, degree: int
) -> None:
    coarse, fine = (residuals(heptagon, motion, degree, count) for count in (8, 16))
    slope = np.log2(coarse.max() / fine.max())
    # Integrals to the inner points are exact for degree d - 1, so each interval misses h^(d+1).
    assert slope == pytest.approx(degree + 1, abs=0.35)
    assert fine.max() < 2e-3 * 0.02 ** (degree - 2)


@pytest.mark.parametrize("degree", [2, 3])
def test_an_exact_motion_satisfies_contacts_and_balance_at_once(
    heptagon: Problem, motion: CosineMotion, degree: int
) -> None:
    count = 6
    equations = residuals(heptagon, motion, degree, count)
    # Gaps, their two derivatives and five balances at every point; the end's gap; rest.
    exact = count * degree * (3 * 4 + 5) + 1 + 1
    assert (equations < EXACT).sum() >= exact
    # One freedom: position and velocity are collocated along one direction.
    assert len(equations) == exact + 2 * count * degree


@pytest.mark.parametrize(
    "change, least",
    [
        ("tau", 0.5),
        ("c_n", 0.1),
        ("z", 1e-3),
        ("v", 1e-3),
        ("a", 1e-3),
    ],
)
def test_every_unknown_matters(
    heptagon: Problem, motion: CosineMotion, change: str, least: float
) -> None:
    scheme = radau(3)
    points = sample(motion, scheme, 8)
    stage = make_stage(heptagon, motion, points)
    nlp, p = build([stage], scheme), plain_limits(heptagon, [stage], scheme)
    off = points._replace(**{change: getattr(points, change) + 1.0})
    equations, _ = split_rows(nlp, call(nlp, "nlp_g", off.pack(), p))
    assert equations.max() > least


def test_friction_the_wrong_way_breaks_a_limit(heptagon: Problem, motion: CosineMotion) -> None:
    scheme = radau(3)
    points = sample(motion, scheme, 8)
    stage = make_stage(heptagon, motion, points)
    for row in range(6):
        signs = np.concatenate(stage.directions)
        signs[row] *= -1
        wrong = replace(stage, directions=Directions(signs[:4], signs[4:]))
        nlp = build([wrong], scheme)
        values = call(nlp, "nlp_g", points.pack(), plain_limits(heptagon, [wrong], scheme))
        # Rates are in rad/s and about one in the middle of the motion.
        assert split_rows(nlp, values)[1].max() > 0.1


@pytest.mark.parametrize("limit", ["floor", "cap"])
def test_tightened_limits_are_missed_by_as_much(
    heptagon: Problem, motion: CosineMotion, limit: str
) -> None:
    scheme, count = radau(3), 8
    points = sample(motion, scheme, count)
    stage = make_stage(heptagon, motion, points)
    nlp = build([stage], scheme)
    floor = np.full((count, 4), heptagon.epsilon)
    cap = np.tile(heptagon.scene.torque_limit, (count, 1))
    if limit == "floor":
        floor[3, 1] = points.c_n[9:12, 1].min() + 0.25
    else:
        cap[3, 1] = np.abs(points.tau[9:12, 1]).max() - 0.25
    values = call(nlp, "nlp_g", points.pack(), np.append(floor, cap))
    # Polynomials through the points may pass a little below or above them between.
    assert split_rows(nlp, values)[1].max() == pytest.approx(0.25, abs=0.05)


@pytest.mark.parametrize("objective", [Objective.TIME, Objective.EFFORT, Objective.MARGIN])
def test_what_is_made_least(heptagon: Problem, motion: CosineMotion, objective: Objective) -> None:
    scheme = radau(3)
    points = sample(motion, scheme, 16)
    stage = make_stage(heptagon, motion, points)
    nlp = build([stage], scheme, objective)
    x = np.append(points.pack(), [0.7] * (objective is Objective.MARGIN))
    cost = call(nlp, "nlp_f", x, plain_limits(heptagon, [stage], scheme))[0]
    squares = motion.fit(40, 8).integrate_squares()
    least = {
        Objective.TIME: motion.duration,
        Objective.EFFORT: squares + 3.0 * motion.duration,
        Objective.MARGIN: -0.7,
    }
    # Quadrature of a smooth function over 16 intervals, of order five.
    assert cost == pytest.approx(least[objective], rel=1e-7)


def test_the_margin_raises_what_forces_have_to_exceed(
    heptagon: Problem, motion: CosineMotion
) -> None:
    scheme = radau(3)
    points = sample(motion, scheme, 16)
    stage = make_stage(heptagon, motion, points)
    nlp = build([stage], scheme, Objective.MARGIN)
    p = plain_limits(heptagon, [stage], scheme)
    room = points.c_n.min() - heptagon.epsilon
    for extra, kept in ((0.98 * room, True), (1.02 * room, False)):
        values = call(nlp, "nlp_g", np.append(points.pack(), extra), p)
        assert bool(split_rows(nlp, values)[1].max() < EXACT) is kept


def test_stages_that_follow_share_their_state(heptagon: Problem, motion: CosineMotion) -> None:
    scheme, count = radau(3), 8
    points = sample(motion, scheme, 2 * count)
    whole = make_stage(heptagon, motion, points)
    half = count * scheme.degree
    cut = [
        StagePoints(motion.duration / 2, *(table[part] for table in points[1:]))
        for part in (slice(None, half), slice(half, None))
    ]
    first = replace(whole, z=whole.z[: half + 1], duration=cut[0].duration, until=None)
    second = replace(whole, z=whole.z[half:], duration=cut[1].duration)
    stages = [first, second]
    nlp, p = build(stages, scheme), plain_limits(heptagon, stages, scheme)
    x = np.concatenate([part.pack() for part in cut])
    together, _ = split_rows(nlp, call(nlp, "nlp_g", x, p))
    one = build([whole], scheme)
    values = call(one, "nlp_g", points.pack(), plain_limits(heptagon, [whole], scheme))
    apart, _ = split_rows(one, values)
    assert len(together) == len(apart)
    assert together.max() == pytest.approx(apart.max(), rel=1e-6)
    late = cut[1]._replace(z=cut[1].z + 1e-3)
    moved = np.concatenate([cut[0].pack(), late.pack()])
    assert split_rows(nlp, call(nlp, "nlp_g", moved, p))[0].max() > 1e-3


@pytest.mark.parametrize("n_c, count", [(4, 6), (3, 12), (1, 2), (5, 1)])
def test_points_are_packed_and_unpacked(n_c: int, count: int) -> None:
    rng = np.random.default_rng(n_c)
    widths = (5, 5, 5, n_c, 2)
    points = StagePoints(0.3, *(rng.normal(size=(count, width)) for width in widths))
    x = points.pack()
    assert x.shape == (1 + count * (17 + n_c),) and x[0] == 0.3
    again = StagePoints.unpack(x, n_c)
    assert again.duration == 0.3
    for given, got in zip(points[1:], again[1:], strict=True):
        np.testing.assert_array_equal(given, got)


@pytest.mark.parametrize("extra", [0, 1])
def test_durations_and_joint_speeds_are_bounded(
    heptagon: Problem, motion: CosineMotion, curves: tuple[Curve, ...], extra: int
) -> None:
    scheme = radau(3)
    points = sample(motion, scheme, 4)
    free = make_stage(heptagon, motion, points)
    slow = replace(free, formation=with_speed_limit(curves[PHASE], (3.0, 7.0)).formation)
    low, high = bound_unknowns([free, slow], extra)
    size = len(points.pack())
    assert low.shape == high.shape == (2 * size + extra,)
    for k, limit in enumerate([np.array([np.inf, np.inf]), np.array([3.0, 7.0])]):
        mine = slice(k * size, (k + 1) * size)
        least, most = (StagePoints.unpack(bound[mine], 4) for bound in (low, high))
        assert (least.duration, most.duration) == (SHORTEST, LONGEST)
        np.testing.assert_array_equal(most.v[:, 3:], np.tile(limit, (12, 1)))
        np.testing.assert_array_equal(least.v, -most.v)
        others = np.concatenate(
            [most.z, most.v[:, :3], most.a, most.c_n, most.tau, -least.z, -least.c_n], axis=1
        )
        assert np.isposinf(others).all()
    assert not np.isfinite(low[2 * size :]).any() and not np.isfinite(high[2 * size :]).any()
