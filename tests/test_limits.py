"""Limits along paths and speed sweeps, against linear programmes and closed forms."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy.optimize import linprog

from plane import SQUARE, make_formation, make_scene, with_speed_limit
from rows import each
from scenes import roll
from shipped import BOX
from toys import plan_path
from wholearm import Finger, Objective, Polygon, Scene, load
from wholearm.common.arrays import Array, find_minima
from wholearm.common.errors import InfeasibleError, Parameter
from wholearm.contacts.closing import contact_table
from wholearm.contacts.formation import Formation
from wholearm.geometry.curve import Curve, directions_of
from wholearm.geometry.tracing import trace_phase, trace_phases
from wholearm.mechanics import limits as limits_module
from wholearm.mechanics import speed_sweep
from wholearm.mechanics.dynamics import LAMBDA, ONE, A, B, V, forward, inverse, stack_motion
from wholearm.mechanics.limits import CONE, PRESS, LimitSet, MotionLimit, make_limits
from wholearm.mechanics.path_limits import InternalForceLimits, PathLimits, find_speed_cap
from wholearm.planning.explain import change_limit, list_shortfalls
from wholearm.planning.lower_bound import bound_least_time, sweep_time
from wholearm.planning.options import PlanOptions
from wholearm.planning.path_domain.path_data import choose_sampling, prepare
from wholearm.planning.path_domain.path_motion import PathMotion
from wholearm.planning.time_domain.solution import SETTINGS, TimeSearch, find_violations, run_checks
from wholearm.planning.time_domain.stage import Stage
from wholearm.planning.time_domain.time_motion import StageMotion, TimeMotion
from wholearm.planning.time_domain.time_plan import plan_phases
from wholearm.policy import make
from wholearm.problem.definition import End, Phase, Problem, Until
from wholearm.scene.model import Friction
from wholearm.search.edges import BorderEdge, estimate_duration, time_parts
from wholearm.search.places import make_place
from wholearm.search.roadmap import time_paths

EPSILON = 0.05
DROOP = 4.0
"""By how much a motor's torque falls with its speed, in the scene's torque times its time."""


@pytest.fixture
def formation() -> Formation:
    scene = replace(make_scene(SQUARE), friction=Friction(0.5, 0.2, 0.3))
    right, left = scene.fingers
    scene = replace(scene, fingers=(replace(right, speed_limit=7.0), left))
    return roll(make_formation(scene, "v0-finger2 v1-palm v2-finger1"), "v1-palm", "v2-finger1")


def test_a_parameter_moves_the_bounds_of_its_limits_by_their_weight(formation: Formation) -> None:
    """The weight is the derivative of every bound, inwards or outwards, at a changed value."""
    limits = make_limits(formation, 0.1)
    rows, signs, bounds = limits.sides
    for parameter in limits.parameters:
        if parameter.key == "epsilon":
            other = make_limits(formation, 0.1 - 1e-3)
        else:
            _, finger, key = parameter.key.split(".")
            links, k = list(formation.scene.fingers), int(finger) - 1
            links[k] = replace(links[k], **{key: getattr(links[k], key) + 1e-3})
            scene = replace(formation.scene, fingers=(links[0], links[1]))
            other = make_limits(replace(formation, scene=scene), 0.1)
        rise = -signs * (other.sides[2] - bounds)
        np.testing.assert_allclose(rise, 1e-3 * limits.weigh(parameter.key)[rows], atol=1e-13)
        assert rise.max() > 1e-4


def test_forces_on_the_edge_of_the_limits_are_inside_the_cones(formation: Formation) -> None:
    """The limits are c_n >= epsilon and |c_t| <= mu (c_n - epsilon), for random forces."""
    rng = np.random.default_rng(2)
    limits = make_limits(formation, 0.1).only(PRESS, CONE)
    mu = np.array([0.5, 0.2])
    seen = set()
    for c in rng.uniform([0, 0, 0, -0.6, -0.3], [0.5, 2, 2, 0.6, 0.3], (300, 5)):
        inside = bool((c[:3] >= 0.1).all() and (np.abs(c[3:]) <= mu * (c[1:3] - 0.1)).all())
        values = limits.rows @ np.append(c, np.zeros(4))
        assert bool((limits.find_slack(values) >= 0).all()) == inside
        seen.add(inside)
    assert seen == {True, False}


def list_motors(formation: Formation, _: float) -> list[MotionLimit]:
    """A limit that the package does not have: |tau + k theta'| <= the torque limit."""
    scene, found = formation.scene, []
    for k, limit in enumerate(scene.torque_limit.tolist()):
        rows = np.zeros((1, formation.n_constraints + 4))
        rows[0, -4 + k], rows[0, -2 + k] = 1.0, DROOP * scene.scales.torque * scene.scales.time
        key = f"fingers.{k + 1}.torque_limit"
        parameter = Parameter(f"torque limit of finger {k + 1}", limit, "N m", 1, key)
        most, part = np.array([limit]), f"finger {k + 1}"
        what = ("motor", part, f"motor curve of {part}", "N m")
        found.append(MotionLimit(*what, rows, -most, most, limit, parameter, np.ones(1)))
    return found


@pytest.fixture
def motors(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Another limit, by nothing but another maker."""
    with monkeypatch.context() as patch:
        patch.setattr(limits_module, "MAKERS", [*limits_module.MAKERS, list_motors])
        yield


def strain(motion: PathMotion | TimeMotion, formation: Formation) -> Array:
    """|tau + k theta'| over the torque limits, shape (n, 2)."""
    samples = motion.evaluate(np.linspace(0.0, motion.duration, 2001))
    droop = DROOP * formation.scene.scales.torque * formation.scene.scales.time
    driven = samples.tau + droop * samples.z_dot[:, 3:]
    return np.asarray(np.abs(driven) / formation.scene.torque_limit)


PHASE = 1
COARSE = PlanOptions(time_intervals=6)


def test_another_limit_binds_along_a_curve(
    curves: tuple[Curve, ...], request: pytest.FixtureRequest
) -> None:
    curve, options = curves[PHASE], PlanOptions(intervals=40)
    plain = plan_path(curve, EPSILON, options, 2)
    request.getfixturevalue("motors")
    driven = plan_path(curve, EPSILON, options, 2)
    before, after = (strain(plan.motion, curve.formation).max() for plan in (plain, driven))
    assert before > 1.02 and 0.999 < after < 1 + 1e-6
    assert driven.value > 1.001 * plain.value
    # The check between nodes sees it where it was not kept.
    data = prepare(curve, EPSILON, plain.motion.grid, 2)
    short = data.limits.fold(data.find_violations(plain.motion.profile, 0.0)[0]).max(axis=0)
    (missed,) = {data.limits.limits[k].kind for k in data.limits.owners[short > 1e-6]}
    assert missed == "motor" and short.max() == pytest.approx(2.0 * (before - 1), rel=1e-2)


def test_another_limit_binds_over_time(
    heptagon: Problem, curves: tuple[Curve, ...], request: pytest.FixtureRequest
) -> None:
    phase, start = heptagon.phases[PHASE], curves[PHASE - 1].end
    (plain,) = plan_phases(heptagon, (phase,), start, COARSE)
    request.getfixturevalue("motors")
    (driven,) = plan_phases(heptagon, (phase,), start, COARSE)
    before, after = (strain(plan.motion, phase.formation).max() for plan in (plain, driven))
    assert before > 1.02 and 0.99 < after < 1 + 1e-6
    assert driven.value > 1.001 * plain.value
    worst = []
    for part in plain.motion.stages:
        stage = Stage(PHASE, part.formation, part.directions, part.points)
        violations = find_violations(stage, run_checks(stage, part), EPSILON)
        limits = make_limits(part.formation, EPSILON)
        of_motors = np.isin(limits.sides[0], limits.of("motor"))
        assert violations.sides[:, ~of_motors].max() < 2 * SETTINGS.violation
        worst.append(violations.sides[:, of_motors].max())
    assert max(worst) == pytest.approx(before - 1, rel=2e-2)


def test_a_contact_that_begins_to_slide_is_inside_its_cone_until_then() -> None:
    """Under rate limits, between the points too; the last force is one of sliding."""
    problem = load(str(BOX))
    start = trace_phase(problem.phases[0], problem.start).end
    (plan,) = plan_phases(problem, problem.phases[1:2], start, COARSE)
    part = plan.motion.stages[-1]
    assert isinstance(part, StageMotion)
    (row,), breaks = part.formation.rolling_rows, part.breaks
    samples = part.evaluate(np.linspace(breaks[-2], breaks[-1], 2001))
    used = np.abs(samples.c_t[:, row]) / samples.c_n[:, row]
    least = 0.9 * float(used.max())
    weak = problem.with_(friction_palm=least, torque_rate_limit=1e4)
    formation = replace(part.formation, scene=weak.scene)
    stage = Stage(1, formation, part.directions, part.points, ending_constraints=((row, 1.0),))
    held = find_violations(stage, run_checks(stage, part), EPSILON).sides[-1]
    limits = make_limits(formation, EPSILON)
    cones = np.isin(limits.sides[0], limits.of(CONE))
    short = (np.abs(samples.c_t[:, row]) - least * samples.c_n[:, row]).max()
    assert short > 0.0
    assert held[cones].max() * limits.side_scales[cones][0] == pytest.approx(short, rel=1e-3)


@pytest.mark.usefixtures("motors")
def test_another_limit_is_short_and_gives_way(heptagon: Problem, curves: tuple[Curve, ...]) -> None:
    """In both domains, by the parameter that it says it is set by."""
    weak, problem = (change_limit(heptagon, "fingers.1.torque_limit", low) for low in (0.2, 0.5))
    phases, start = problem.phases[3:4], curves[2].end
    with pytest.raises(InfeasibleError, match="motor curve of finger 1 is ") as caught:
        plan_path(trace_phases(weak)[3], EPSILON, PlanOptions(intervals=20), 4)
    advised = re.search("feasible with torque limit of finger 1 = (.*?) N m", str(caught.value))
    assert advised
    # Over time there are more motions than along the curve: what is advised is enough.
    allowed = 1.03 * float(advised[1])
    strong = change_limit(heptagon, "fingers.1.torque_limit", allowed)
    (kept,) = plan_phases(strong, strong.phases[3:4], start, COARSE)
    # What that motion is short of with the limits as they are: what was added to the torque.
    own = [stage for stage in kept.stages if isinstance(stage, Stage)]
    stages = [replace(stage, formation=phases[0].formation) for stage in own]
    search = TimeSearch(problem, COARSE)
    short = {one.limit: one.amount for one in list_shortfalls(search, stages)}
    torque = "torque limit of finger 1 = 0.5 N m"
    assert {torque, "motor curve of finger 1"} <= set(short)
    assert 0.0 < short[torque] < 1.1 * (allowed - 0.5)


def test_speed_limits_hold_between_collocation_points(
    heptagon: Problem, curves: tuple[Curve, ...]
) -> None:
    """As fast as along the curve, but no faster than allowed anywhere."""
    plain = plan_path(curves[PHASE], EPSILON, PlanOptions(intervals=40), 2)
    t = np.linspace(0.0, plain.motion.duration, 501)
    fastest = 0.6 * np.abs(plain.motion.evaluate(t).z_dot[:, 4]).max()
    problem = heptagon.with_(speed_limit2=fastest)
    curve = trace_phases(problem)[PHASE]
    along = plan_path(curve, EPSILON, PlanOptions(intervals=40), 2)
    start = curves[PHASE - 1].end
    (over,) = plan_phases(problem, problem.phases[PHASE : PHASE + 1], start, COARSE)
    t = np.linspace(0.0, over.motion.duration, 2001)
    rates = np.abs(over.motion.evaluate(t).z_dot[:, 4])
    assert 0.999 * fastest < rates.max() < fastest * (1 + 1e-6)
    assert over.value == pytest.approx(along.value, rel=0.02) and along.value > 1.02 * plain.value


def test_another_limit_is_kept_by_sweeps_search_and_policies(
    curves: tuple[Curve, ...], request: pytest.FixtureRequest
) -> None:
    curve = curves[PHASE]
    formation, place = curve.formation, make_place(curve.formation.scene, curve.start)
    pose = curve.evaluate(np.array([0.5 * curve.length])).z[:, [0, 2]]
    table = contact_table(place.scene)
    labels = np.array([[table.index(formation.contacts[k]) for k in (0, 2, 3)]])
    path = labels, pose + np.array([-0.008, 0.1]), pose + np.array([0.015, 0.23])

    def measure(epsilon: float) -> Array:
        border = BorderEdge(place, curve, EPSILON, 0.0)
        least = bound_least_time([curve], EPSILON)
        assert least is not None
        (part,), whole = time_parts(border, np.ones(1)), estimate_duration([border.limits], [1.0])
        of_border = whole, part
        of_cell = time_paths(formation.scene, epsilon, *path)[0]
        return np.array([least.value, sweep_time([curve], EPSILON, 50), *of_border, of_cell])

    plain = measure(EPSILON)
    s = np.linspace(0.2, 0.8, 7) * curve.length
    motion = np.full(7, 2.0), np.full(7, 0.5), np.full(7, 3.0)
    before = make.make_rows(curve, s, motion)
    request.getfixturevalue("motors")
    # Limits of cells are kept by scene and epsilon.
    driven = measure(EPSILON + 1e-9)
    assert np.isfinite(plain).all() and (driven > 1.001 * plain).all(), (plain, driven)
    # Policies: the limit is one of torques and speeds, at both ends.
    after, point = make.make_rows(curve, s, motion), curve.evaluate(s)
    rows = after.slack @ stack_motion(*motion)[..., None]
    droop = DROOP * formation.scene.scales.torque * formation.scene.scales.time
    tau = (after.torque @ stack_motion(*motion)[..., None])[..., 0]
    tau = tau + droop * point.z_s[:, 3:] * np.sqrt(0.5)
    assert after.slack.shape[1] == before.slack.shape[1] + 4
    for sign in (-1, 1):
        for line in (1 + sign * tau / formation.scene.torque_limit).T / make.SETTINGS.torque_margin:
            assert np.abs(rows[..., 0] - line[:, None]).max(axis=0).min() < 1e-12
    # Predictions: the internal force that presses most is less free.
    forces = inverse(formation, point, directions_of(curve, np.zeros(7, int)))
    fast = np.zeros(7), np.full(7, 4.0)
    assert fast[1].all()
    grasp = InternalForceLimits.of(formation, forces, point.z_s[:, 3:]).find_best(*fast)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(limits_module, "MAKERS", limits_module.MAKERS[:-1])
        free = InternalForceLimits.of(formation, forces, point.z_s[:, 3:]).find_best(*fast)
    assert (grasp.least < free.least - 1e-6).any() and (grasp.least <= free.least + 1e-12).all()


FREE = (None, None)


@pytest.mark.parametrize("phase", [0, 2])
def test_slack_is_that_of_the_motion(curves: tuple[Curve, ...], phase: int) -> None:
    """Contact forces by forward dynamics under the torques of the coefficients."""
    curve, rng, count = curves[phase], np.random.default_rng(phase), 40
    formation = with_speed_limit(curve, (3.0, 3.0)).formation
    s = rng.uniform(0, curve.length, count)
    point, segment = curve.evaluate(s), np.searchsorted([p.stop for p in curve.segments[:-1]], s)
    a, b, internal = (rng.uniform(*ends, count) for ends in ((-9, 9), (0, 2), (0, 5)))
    directions = directions_of(curve, segment)
    forces = inverse(formation, point, directions)
    tau, z_dot = forces.tau(a, b, internal), point.z_s * np.sqrt(b)[:, None]
    acceleration, c = forward(formation, formation.evaluate(point.z, z_dot), z_dot, tau, directions)
    z_ddot = point.z_s * a[:, None] + point.z_ss * b[:, None]
    np.testing.assert_allclose(acceleration, z_ddot, atol=1e-8)
    limits = make_limits(formation, EPSILON)
    values = np.hstack([c, tau, z_dot[:, 3:]]) @ limits.rows.T
    rows = limits.sides[0]
    slack = limits.find_slack(values) / limits.scales[rows]
    fast = np.isin(rows, limits.of("speed"))
    found = PathLimits.of(limits, forces, point.z_s[:, 3:])
    np.testing.assert_allclose(found.find_slack(a, b, internal), slack[:, ~fast], atol=1e-9)
    np.testing.assert_array_equal(b <= found.cap, (slack[:, fast] >= 0).all(axis=1))
    # At the places of the curve with half of its parameter.
    halved = found.scale(0.5)
    room = halved.find_slack(2 * a, 4 * b, internal)
    np.testing.assert_allclose(room, slack[:, ~fast], atol=1e-9)
    np.testing.assert_allclose(halved.cap, 4 * found.cap)


def test_a_limit_of_both_joint_speeds_bounds_the_speed() -> None:
    rows = np.array([[0.0, 0.0, 0.0, 1.0, -1.0]])
    both: Any = SimpleNamespace(rows=rows, low=np.array([-3.0]), high=np.array([2.0]))
    limits = LimitSet((both,))
    rates = np.array([[4.0, 2.0], [2.0, 5.0], [1.0, 1.0]])
    np.testing.assert_array_equal(find_speed_cap(limits, rates), [1.0, 1.0, np.inf])


def draw(rng: np.random.Generator, places: int, rows: int = 6) -> PathLimits:
    """Random limits, with room around rest."""
    table = rng.normal(size=(places, rows, 5))
    table[..., ONE] = rng.uniform(0.1, 1.0, (places, rows))
    table[:, 0, LAMBDA] = 0.0
    return PathLimits(table, np.full(places, np.inf))


def test_elimination_leaves_what_is_possible() -> None:
    limits, rng = draw(np.random.default_rng(4), 60), np.random.default_rng(5)
    left = limits.eliminate()
    a, b = rng.normal(size=60), rng.uniform(0, 2, 60)
    low, high = limits.find_internal_force_range(a, b)
    seen = set()
    for k, row in enumerate(limits.rows):
        fixed = row @ stack_motion(a[[k]], b[[k]], np.zeros(1))[0]
        found = linprog([1.0], A_ub=-row[:, [LAMBDA]], b_ub=fixed, bounds=[FREE])
        possible = found.status in (0, 3)
        motion = stack_motion(a[[k]], b[[k]], np.zeros(1))[0, :LAMBDA]
        assert bool((left.rows[k] @ motion >= 0).all()) == possible == bool(low[k] <= high[k])
        if found.status == 0:
            assert low[k] == pytest.approx(found.x[0], abs=1e-9)
        seen.add(possible)
    assert seen == {True, False}


@pytest.mark.parametrize("largest", [True, False])
def test_extremes_are_those_of_a_linear_programme(largest: bool) -> None:
    limits, b = draw(np.random.default_rng(6), 60), np.random.default_rng(7).uniform(0.01, 0.1, 60)
    left = limits.eliminate()
    found, step = left.extreme(b, largest), 1e-7
    slope = (left.extreme(b + step, largest).a - left.extreme(b - step, largest).a) / (2 * step)
    pairs = limits.pair(found.row)
    a, internal = limits.meet(b, pairs)
    checked = 0
    for k, row in enumerate(limits.rows):
        fixed = row[:, ONE] + row[:, B] * b[k] + row[:, V] * np.sqrt(b[k])
        sign = -1.0 if largest else 1.0
        best = linprog([sign, 0.0], A_ub=-row[:, [A, LAMBDA]], b_ub=fixed, bounds=[FREE, FREE])
        if best.status != 0:
            continue
        checked += 1
        assert found.a[k] == pytest.approx(best.x[0], abs=1e-8)
        assert found.slope[k] == pytest.approx(slope[k], rel=1e-5)
        assert a[k] == pytest.approx(best.x[0], abs=1e-7)
        # The first row alone, without lambda, leaves it a range.
        if 0 not in pairs[k]:
            assert internal[k] == pytest.approx(best.x[1], abs=1e-7)
        slack = limits.find_slack(a, b, internal)[k, pairs[k]]
        assert slack == pytest.approx([0.0, 0.0], abs=1e-8)
    assert checked > 20


@pytest.mark.parametrize("largest", [True, False])
def test_rows_that_say_the_same_are_told_apart_by_their_order(largest: bool) -> None:
    """Not by rounding: where a limit has no internal force, all its pairs are one."""
    rng, sign = np.random.default_rng(0), 1.0 if largest else -1.0
    a, b, v, one = (np.tile(rng.uniform(1, 2, (50, 1)), 3) for _ in range(4))
    noise = 1 + 1e-14 * rng.uniform(-1, 1, one.shape)
    # The last one is farther away by a millionth.
    farther = np.array([1.0, 1.0, 1.0 + 1e-6])
    for factor, first in ((farther, 0), (2 - farther, 2)):
        rows = np.stack([(one * noise + 5.0) * factor, -sign * a, -b, v], axis=-1)
        limits = PathLimits(rows, np.full(50, np.inf))
        np.testing.assert_array_equal(limits.extreme(np.ones(50), largest).row, first)


def solve_sweep(limits: PathLimits, steps: Array, part: Array, cap: Array) -> Array | None:
    """The largest b at all nodes at once, from rest to rest; no row has viscous terms."""
    count, rows, right = len(steps), [], []
    for k, table in enumerate(limits.rows):
        for one, a, b, *_ in table:
            row = np.zeros(count + 1)
            row[k] = (1 - part[k]) * b - a / (2 * steps[k])
            row[k + 1] = part[k] * b + a / (2 * steps[k])
            rows.append(-row)
            right.append(one)
    bounds = [(0, 0), *((0, None if np.isinf(most) else most) for most in cap[1:-1]), (0, 0)]
    found = linprog(-np.ones(count + 1), A_ub=rows, b_ub=right, bounds=bounds)
    return np.asarray(found.x) if found.status == 0 else None


def test_sweeps_are_solutions_of_a_linear_programme() -> None:
    """The set of feasible b is closed under maxima: one profile is largest at all nodes."""
    rng, count, solved = np.random.default_rng(8), 12, 0
    steps, _, part = speed_sweep.make_cosine_grid(count)
    every = []
    for _ in range(30):
        rows = rng.normal(size=(count, 5, 4)) * [0.0, 0.0, 0.3, 0.0]
        rows[..., ONE] = rng.uniform(0.3, 1.0, (count, 5))
        # With nearly no part of s'' two limits could trade b at one node for that at the next.
        rows[..., A] = rng.uniform(0.5, 1.5, (count, 5)) * [1.0, -1.0, 1.0, -1.0, 1.0]
        cap = np.array([np.inf, *rng.uniform(0.1, 1.0, count - 1), np.inf])
        limits = PathLimits(rows, np.full(count, np.inf))
        best = solve_sweep(limits, steps, part, cap)
        if best is None:
            continue
        found = speed_sweep.speed_sweep(limits, steps, part, cap)
        assert found.b == pytest.approx(best, abs=1e-8)
        every.append((rows, cap, found))
        solved += 1
    assert solved > 15
    # Together they are the same as one by one.
    rows, cap = (np.stack([case[k] for case in every]) for k in range(2))
    whole = speed_sweep.speed_sweep(PathLimits(rows, cap[:, 1:]), steps, part, cap)
    np.testing.assert_array_equal(whole.b, [case[2].b for case in every])
    np.testing.assert_array_equal(whole.modes, [case[2].modes for case in every])
    times = [float(speed_sweep.find_duration(case[2].b, steps)) for case in every]
    assert whole.find_durations(steps) == pytest.approx(times, rel=1e-12)


LENGTH, COUNT = 2.0, 64
STEPS, PART = np.full(COUNT, LENGTH / COUNT), np.full(COUNT, 0.5)


def push() -> PathLimits:
    """|s''| <= 1 along a path."""
    rows = np.zeros((COUNT, 2, 4))
    rows[..., ONE], rows[..., A] = 1.0, [1.0, -1.0]
    return PathLimits(rows, np.full(COUNT, np.inf))


def test_half_the_path_is_for_speeding_up_and_half_for_braking() -> None:
    found = speed_sweep.speed_sweep(push(), STEPS, PART)
    # With s'' the same in each interval this motion is on the grid, where intervals are even.
    assert speed_sweep.find_duration(found.b, STEPS) == pytest.approx(2 * np.sqrt(LENGTH), rel=1e-9)
    assert {*found.modes[: COUNT // 2 - 1]} == {speed_sweep.SweepMode.PUSH}
    assert {*found.modes[COUNT // 2 :]} == {speed_sweep.SweepMode.BRAKE}


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("drag", [0.0, 0.1])
def test_a_closed_place_lets_no_motion_pass(drag: float) -> None:
    limits, closed = push(), slice(0, COUNT // 4)
    limits.rows[..., V] = -drag
    limits.rows[closed, :, A], limits.rows[closed, :, ONE] = 0.0, -1.0
    both = PathLimits(np.stack([limits.rows, push().rows]), np.full((2, COUNT), np.inf))
    found = speed_sweep.speed_sweep(both, STEPS, PART, sweeps=2).find_durations(STEPS)
    assert found[0] == np.inf and np.isfinite(found[1])
    with pytest.raises(speed_sweep.NoMotionError):
        speed_sweep.speed_sweep(limits, STEPS, PART)


@pytest.mark.parametrize("cap", [3.0, 5.0])
def test_a_motion_has_to_be_as_fast_as_the_end_asks_for(cap: float) -> None:
    """At the end s'' is -2, so that rest is reached over 1 m from b = 4, which the cap forbids."""
    rows = np.zeros((2, 2, 4))
    rows[..., A], rows[..., ONE] = [1.0, -1.0], [[10.0, 10.0], [2.0, -2.0]]
    sweep = PathLimits(rows, np.full(2, cap)), np.ones(2), np.full(2, 0.5)
    if cap < 4.0:
        with pytest.raises(speed_sweep.NoMotionError):
            speed_sweep.speed_sweep(*sweep)
    else:
        assert speed_sweep.speed_sweep(*sweep).b == pytest.approx([0.0, 4.0, 0.0], abs=1e-12)


def test_a_costate_that_falls_where_nothing_bounds_the_speed_ends_the_refinement() -> None:
    """There is no bound then, on any grid: intervals there were split until they had no length."""
    corners = [[0.0, 0.0], [0.06, 0.0], [0.085, 0.05], [0.03, 0.095], [-0.015, 0.05]]
    link = Finger((0.08695, -0.01087), 0.1522, 0.005435, 0.00886, 0.017, 0.0163, 3.261)
    fingers = link, replace(link, base=(-0.08695, -0.01087))
    scene = Scene(Polygon(corners, 0.3), fingers, Friction(0.05, 0.05, 0.05))
    held = "v1-palm v2-finger1 v3-finger1"
    formations = [
        make_formation(scene, f"{held} {c}") for c in ("v4-finger2", "v4-tip2", "e4-tip2")
    ]
    gained = make_formation(scene, "v4-tip2 e4-tip2 v2-palm").contacts
    pose = [-0.02434246073883495, 0.044327913995052655, -0.15034739666181246]
    z = np.array([*pose, 2.305515746021695, 1.4168260217798154])
    path = list[Curve]()
    for formation, contact in zip(formations, gained, strict=True):
        path.append(trace_phase(Phase(0, formation, Until(contact=contact), End.SMOOTH), z))
        z = path[-1].end
    bound = bound_least_time(path, 0.075)
    assert bound is not None and 0.0 <= bound.value < 1.0


def test_a_margin_takes_the_duration_that_is_allowed(curves: tuple[Curve, ...]) -> None:
    least = bound_least_time([curves[0]], EPSILON)
    assert least is not None
    allowed = 1.5 * least.value
    plan = plan_path(curves[0], EPSILON, PlanOptions(Objective.MARGIN), 1, allowed)
    assert plan.value > EPSILON
    # With that margin no motion is faster.
    bound = bound_least_time([curves[0]], plan.value)
    assert bound is not None and bound.value == pytest.approx(allowed, rel=1e-3)


def test_a_margin_that_a_place_limits_does_not_grow_with_the_duration(
    curves: tuple[Curve, ...],
) -> None:
    """At the start of this phase no contact can press harder, however long a motion takes."""
    curve = curves[2]
    bound = bound_least_time([curve], EPSILON)
    assert bound is not None
    options = PlanOptions(Objective.MARGIN, intervals=40)
    durations = (np.array([2, 3, 500]) * bound.value).tolist()
    values = [plan_path(curve, EPSILON, options, 3, duration).value for duration in durations]
    np.testing.assert_allclose(values, values[0], rtol=5e-4)


@each("nodes", [11, 81])
@each("deepest", [3e-3, 0.01, 0.05])
def test_dips_next_to_rest_are_found(nodes: int, deepest: float) -> None:
    """Viscous friction goes with the root of the way: x - 2 sqrt(deepest x) is least there."""
    x = choose_sampling(nodes).checks
    values = x - 2 * np.sqrt(deepest * x)
    for sampled in (values, values[::-1]):
        least = find_minima(sampled[None, :, None])[0, 0]
        # A look next to the dip, and the parabola through it, miss little of it.
        assert least == pytest.approx(-deepest, rel=0.1)


def test_minima_between_samples_are_of_fourth_order() -> None:
    samples = np.exp(np.arange(25.0) / 9) - 2.9 * np.arange(25.0) / 9
    least = find_minima(samples[None, :, None])[0, 0]
    assert least == pytest.approx(2.9 * (1 - np.log(2.9)), abs=2e-6)  # theory 5e-7, parabolas 5e-5
