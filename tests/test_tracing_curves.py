from __future__ import annotations

from dataclasses import replace
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.optimize import brentq

import plane
import shipped
from scenes import hexagon, measure_fingers, roll, tip
from shipped import problem_of
from toys import plan_path
from wholearm import InputError, Phase, PlanOptions, Problem, Scene, Until, place_start
from wholearm.common.arrays import Array
from wholearm.contacts.closing import close_finger, place_flush
from wholearm.contacts.elemental import parse_contact
from wholearm.contacts.formation import Formation, find_touching
from wholearm.geometry.curve import Curve
from wholearm.geometry.path_guess import N_POINTS, PathGuess, guess_phase
from wholearm.geometry.tracing import EndDistance, trace_curve, trace_phase, trace_phases
from wholearm.mechanics.dynamics import close_contacts, metric_weights
from wholearm.planning.time_domain.time_plan import plan_phases

NEVER = Until(coordinate="x", value=9.0)


def make_problem(scene: Scene, flush: int, x: float, *phases: tuple[str, Any]) -> Problem:
    """The problem of a scene, through the same reader as a file's."""
    bare = Problem("hand", scene, 0.05, place_start(scene, flush=flush, x=x), ())
    return bare.with_({"phases": [{"contacts": c.split(), "until": until} for c, until in phases]})


@pytest.fixture(scope="module")
def stationary(heptagon: Problem) -> Curve:
    """A flip during which joint 1 stops and turns back: P_AI is singular there."""
    scene = plane.make_scene(np.asarray(heptagon.scene.polygon.points), base=0.12, length=0.25)
    scene = replace(scene, fingers_collide=False)
    slide = "v1-palm v2-palm v4-finger1 v6-finger2", "v0-finger2"
    flip = "v1-palm v4-finger1 v0-finger2 v6-finger2", "v3-finger1"
    return trace_phases(make_problem(scene, 1, -0.02, slide, flip))[1]


@pytest.fixture(scope="module")
def every_curve(curves: tuple[Curve, ...], stationary: Curve) -> tuple[Curve, ...]:
    return (*curves, stationary)


def unit_tangent(formation: Formation, z: Array) -> Array:
    """Null vector of A by its signed minors, of length 1 in the metric of arc length."""
    null = plane.find_null_vector(formation.evaluate(z[None], z[None]).A[0])
    return np.asarray(null / np.sqrt(null**2 @ metric_weights(formation.scene)))


def headings(formation: Formation, z: Array) -> tuple[Array, Array]:
    tangent = unit_tangent(formation, z)
    return tangent, -tangent


def test_a_box_tips_about_the_vertex_that_rolls() -> None:
    """Its centroid runs on a circle, and every point of the curve has the vertex in one place."""
    curve = tip()
    z = curve.evaluate(interior(curve, 40)).z
    corners = plane.place_corners(curve.formation.scene, z)[:, 1]
    place = plane.place_corners(curve.formation.scene, curve.start)[1]
    np.testing.assert_allclose(corners, np.broadcast_to(place, corners.shape), atol=1e-13)
    assert np.ptp(z[:, 2]) > 1.4
    assert curve.reached and curve.end[2] == pytest.approx(-np.pi / 2, abs=1e-12)
    for segment in curve.segments:
        assert segment.Xi[0] == 0 and (np.abs(segment.Xi[1:]) == 1).all()


def test_a_tip_rolls_on_an_edge() -> None:
    """What it goes along the edge is what it turns on its radius, against the object."""
    scene = plane.make_scene(plane.SQUARE, base=0.08, depth=0.0, lengths=(0.04, 0.15), radius=0.01)
    q = np.array([0.03, -plane.rotate(-0.2, plane.SQUARE)[:, 1].min(), -0.2])
    z = np.array([*q, close_finger(scene, q, 0), close_finger(scene, q, 1)])
    formation = roll(plane.make_formation(scene, "v1-palm e1-tip1 v3-finger2"), "e1-tip1")
    weights = np.sqrt(metric_weights(scene))
    heading = np.linalg.svd(formation.evaluate(z[None], z[None]).P[0] / weights)[2][-1] / weights
    curve = trace_curve(formation, z, heading, NEVER)
    places = np.linspace(0, curve.length, 30)
    z = curve.evaluate(places).z
    corners = plane.place_corners(scene, z)
    run = corners[:, 2] - corners[:, 1]
    tips = plane.place_tips(scene, 0, z[:, 3])
    along = ((tips - corners[:, 1]) * run).sum(axis=1) / np.hypot(*run.T)
    turned = 0.01 * (z[:, 3] - z[:, 2])
    np.testing.assert_allclose(np.diff(along), np.diff(turned), atol=1e-14)
    assert np.ptp(along) > 0.002


def interior(curve: Curve, count: int) -> Array:
    """Places off the nodes and off the ends."""
    return curve.length * (np.arange(count) + 0.5) / count


def test_contacts_stay_closed(every_curve: tuple[Curve, ...]) -> None:
    for curve in every_curve:
        z, z_s = curve.evaluate(interior(curve, 300))[:2]
        kinematics = curve.formation.evaluate(z, z_s)
        assert np.abs(kinematics.C).max() < 1e-12
        assert np.abs(np.einsum("nij,nj->ni", kinematics.A, z_s)).max() < 1e-12
        np.testing.assert_allclose(z_s**2 @ metric_weights(curve.formation.scene), 1, atol=1e-14)
        check_clear(curve)


def test_curve_equals_an_integration_of_its_tangent(every_curve: tuple[Curve, ...]) -> None:
    """Arc length and place, against an eighth-order Runge-Kutta method on the tangent field."""
    for curve in every_curve:
        s = interior(curve, 7)
        sign = np.sign(unit_tangent(curve.formation, curve.start) @ curve.evaluate(s[:1]).z_s[0])

        def slope(_: float, z: Array, curve: Curve = curve, sign: float = sign) -> Array:
            return np.asarray(sign * unit_tangent(curve.formation, z))

        span, accuracy = (0, curve.length), {"rtol": 1e-13, "atol": 1e-15}
        reference = solve_ivp(slope, span, curve.start, "DOP853", t_eval=s, **accuracy)
        np.testing.assert_allclose(curve.evaluate(s).z, reference.y.T, rtol=0, atol=1e-10)


@pytest.mark.parametrize("missed", [0.0, 1e-8, -1e-8])
def test_a_curve_begins_where_one_before_ends_up_to_a_tolerance(
    heptagon: Problem, curves: tuple[Curve, ...], missed: float
) -> None:
    """The contact that is given up there opens, though closing the others presses it in [m]."""
    before, (phase, *later) = curves[3], heptagon.phases[4:]
    (z,) = before.interpolate(np.array([before.length - missed]))[0]
    curve, exact = (trace_phase(phase, start, later) for start in (z, before.end))
    assert curve.length == pytest.approx(exact.length, rel=1e-5)


def test_tangent_and_curvature_are_derivatives(every_curve: tuple[Curve, ...]) -> None:
    for curve in every_curve:
        h = 1e-5 * curve.length
        s = interior(curve, 40)
        before, here, after = (curve.evaluate(s + k * h) for k in (-1, 0, 1))
        scale = 1 / curve.formation.scene.polygon.gyration_radius
        # Rounding 1e-16 over h, and h^2 times third derivatives, which grow like scale^3.
        slope, bend = (after.z - before.z) / (2 * h), (after.z_s - before.z_s) / (2 * h)
        np.testing.assert_allclose(slope, here.z_s, atol=1e-7 * scale)
        np.testing.assert_allclose(bend, here.z_ss, atol=1e-6 * scale**2)
        along = (here.z_s * here.z_ss) @ metric_weights(curve.formation.scene)
        assert np.abs(along).max() < 1e-12


def test_joint_1_is_stationary_where_P_AI_is_singular(stationary: Curve) -> None:
    parts = pairwise(stationary.segments)
    borders = [part.stop for part, after in parts if part.sigma[0] != after.sigma[0]]
    assert len(borders) == 1
    z, z_s = stationary.evaluate(np.array(borders))[:2]
    P_AI = stationary.formation.evaluate(z, z_s).A[0][:, [0, 1, 2, 4]]
    assert abs(z_s[0, 3]) < 1e-10
    assert np.linalg.svd(P_AI)[1][-1] < 1e-12


def test_segments_split_exactly_where_something_reverses(every_curve: tuple[Curve, ...]) -> None:
    reversals = 0
    for curve in every_curve:
        segments = curve.segments
        assert segments[0].start == 0.0 and segments[-1].stop == curve.length
        for segment in segments:
            inner = np.linspace(segment.start, segment.stop, 402)[1:-1]
            signs = np.sign(curve.sliding(inner))
            assert (signs == [*segment.Xi, *segment.sigma]).all()
        for segment, after in pairwise(segments):
            assert segment.stop == after.start
            rates = curve.sliding(np.array([segment.stop]))[0]
            one, two = ([*part.Xi, *part.sigma] for part in (segment, after))
            changed = np.flatnonzero(np.array(one) != two)
            assert len(changed) == 1
            # The unit of a rate is one: arc length per arc length.
            assert abs(rates[changed[0]]) < 1e-12
            reversals += 1
    assert reversals >= 4


def test_until_is_reached_exactly(heptagon: Problem, curves: tuple[Curve, ...]) -> None:
    start = heptagon.start
    for phase, curve in zip(heptagon.phases, curves, strict=True):
        assert curve.reached
        np.testing.assert_allclose(curve.start, start, rtol=0, atol=1e-14)
        start, until = curve.end, phase.until
        if until.contact is not None:
            gap = EndDistance(heptagon.scene, until, curve.start).measure
            assert abs(gap(curve.end[None])[0]) < 1e-12
            assert until.contact in find_touching(heptagon.scene, curve.end)
        else:
            assert curve.end[2] == pytest.approx(until.value, abs=1e-13)
    assert curves[0].start[0] - curves[2].end[0] == pytest.approx(0.109, abs=5e-4)
    turned = curves[2].end[2] - curves[4].end[2]
    assert np.degrees(turned) == pytest.approx(48, abs=0.05)


def check_clear(curve: Curve) -> None:
    scene = curve.formation.scene
    z, z_s = curve.evaluate(np.linspace(0, curve.length, 40))[:2]
    assert np.abs(curve.formation.evaluate(z, z_s).C).max() < 1e-12
    assert plane.place_corners(scene, z)[..., 1].min() > -1e-12
    for finger in (0, 1):
        assert plane.finger_gap(scene, z[:, :3], finger, z[:, 3 + finger]).min() > -1e-11


SIDE_REACH = float(np.sqrt(0.1**2 + 0.005**2 - 0.07**2))
"""How far left of its joint a corner 0.07 m above it is when it comes to the tip of 0.1 m."""


def tip_place(height: float) -> float:
    """X of a square which a link of 0.075 m touches with its tip, so high above its joint."""
    return float(0.045 - np.sqrt(0.075**2 - height**2))


LEFT_V3 = "v0-palm v1-palm v3-finger2"


@pytest.mark.parametrize(
    "length, contact, goal, text, x",
    [
        # Corner 2 at (x + 0.03, 0.06); the joint at (0.08, -0.01).
        (0.1, "v2-finger1", -0.05, "v2 runs off finger 1 at its tip", 0.05 - SIDE_REACH),
        (0.2, "v2-finger1", 0.09, "v1 touches finger 1", 0.045),
        (0.075, "e1-tip1", 0.05, "the tip of finger 1 runs off edge 1 at v2", tip_place(0.07)),
        (0.075, "e1-tip1", -0.05, "the tip of finger 1 runs off edge 1 at v1", tip_place(0.01)),
    ],
)
def test_early_ending_says_what_and_where(
    length: float, contact: str, goal: float, text: str, x: float
) -> None:
    """A square slides on the palm; where it must stop is worked out by hand."""
    scene = replace(plane.make_scene(plane.SQUARE, lengths=(length, 0.25)), fingers_collide=False)
    problem = make_problem(scene, 0, 0.0, (f"{LEFT_V3} {contact}", {"x": goal}))
    with pytest.raises(InputError) as caught:
        trace_phases(problem)
    assert caught.value.key == "phases[1].until"
    assert f"x = {goal:g} m is never reached" in caught.value.problem
    assert f"{text} at x = {1e3 * x:.4g} mm, phi = " in caught.value.problem

    formation, z = problem.phases[0].formation, problem.start
    ends = [trace_curve(formation, z, heading, NEVER) for heading in headings(formation, z)]
    (curve,) = [own for own in ends if (own.end[0] - z[0]) * goal > 0]
    assert not curve.reached and curve.ending.startswith(text)
    assert curve.end[0] == pytest.approx(x, abs=1e-12)


@pytest.mark.parametrize(
    "length, contact, until, follower",
    [
        (0.1, "v2-finger1", "v2-tip1", "edge 1 turns onto the tip of finger 1"),
        (0.075, "e1-tip1", "v2-tip1", "v2 leaves the tip of finger 1 for the side of the link"),
    ],
)
def test_a_tip_is_reached_and_gone_round(
    length: float, contact: str, until: str, follower: str
) -> None:
    """From the side or an edge onto the tip's arc, and on until the arc ends."""
    scene = replace(plane.make_scene(plane.SQUARE, lengths=(length, 0.25)), fingers_collide=False)
    problem = make_problem(scene, 0, 0.0, (f"{LEFT_V3} {contact}", until))
    (first,) = trace_phases(problem)
    assert (first.reached and until in first.ending) or "runs off" in first.ending
    names = f"{LEFT_V3} {until}"
    second = plane.make_formation(scene, names)
    assert set(second.contacts) <= set(find_touching(scene, first.end))
    onward = first.evaluate(np.array([first.length])).z_s[0]
    assert follower in trace_curve(second, first.end, onward, NEVER).ending


@pytest.mark.parametrize("seed", range(4))
def test_random_hands_give_valid_curves(seed: int) -> None:
    """Traced to whatever ends them, both ways: closed, clear, and ended by a limit at zero."""
    rng = np.random.default_rng(seed)
    traced = 0
    for _ in range(6):
        lengths = rng.uniform(0.06, 0.25), rng.uniform(0.06, 0.25)
        points = plane.convex_polygon(rng, int(rng.integers(3, 8)))
        radius = float(rng.choice([0.0, 0.004, 0.012]))
        scene = plane.make_scene(points, lengths=lengths, radius=radius, base=0.11, depth=-0.015)
        q = place_flush(scene, int(rng.integers(len(points))), rng.uniform(-0.04, 0.04))
        try:
            z = np.array([*q, close_finger(scene, q, 0), close_finger(scene, q, 1)])
        except InputError:
            continue
        # Hands that are crossed from the start are for fingers that pass each other.
        scene = replace(scene, fingers_collide=bool(measure_fingers(scene, z[None])[0] > 0))
        formation = Formation(scene, find_touching(scene, z))
        if formation.n_contacts != 4:
            continue
        for heading in headings(formation, z):
            curve = trace_curve(formation, z, heading, NEVER)
            assert not curve.reached and curve.length > 0
            check_clear(curve)
            if scene.fingers_collide:
                along = curve.evaluate(np.linspace(0.0, curve.length, 40)).z
                assert measure_fingers(scene, along).min() > -1e-9
            limits = formation.evaluate_limits(curve.end[None])[0]
            ended = [k for k, limit in enumerate(formation.limits) if limit.text in curve.ending]
            assert len(ended) == 1 and abs(limits[ended[0]]) < 1e-12
            assert limits.min() > -1e-11
            traced += 1
    assert traced > 0


def test_fingers_that_touch_end_a_curve() -> None:
    """Halfway through the hexagon's slide."""
    problem = hexagon()
    with pytest.raises(InputError, match=r"one way finger 1 touches finger 2 at x = 1\.05. mm"):
        trace_phases(problem)
    passing = trace_phases(hexagon(solid=False))
    s = np.linspace(0.0, passing[2].length, 50)
    assert measure_fingers(problem.scene, passing[2].evaluate(s).z).min() < -1e-4
    phase, start = problem.phases[2], passing[2].start
    curve = trace_curve(phase.formation, start, passing[2].panels[0].z_s[0], phase.until)
    assert not curve.reached and curve.ending.startswith("finger 1 touches finger 2 at x = ")
    s = np.linspace(0.0, curve.length, 50)
    gaps = measure_fingers(problem.scene, curve.evaluate(s).z)
    assert gaps[-1] == pytest.approx(0.0, abs=1e-9) and (gaps[:-1] > 0).all()


@pytest.mark.parametrize("least", [-1e-7, 1e-7])
def test_fingers_that_graze_are_noticed(least: float) -> None:
    """The gap dips to just below, and just above, zero while the tip passes the other link."""
    phase = 2
    free = trace_phases(hexagon(solid=False))[phase]
    z = free.evaluate(np.linspace(0.0, free.length, 20001)).z

    def dip(length: float) -> float:
        return float(measure_fingers(hexagon((0.18, length), solid=False).scene, z).min()) - least

    length = float(brentq(dip, 0.17, 0.18, xtol=1e-13))
    problem = hexagon((0.18, length))
    formation, until = problem.phases[phase].formation, problem.phases[phase].until
    curve = trace_curve(formation, z[0], free.panels[0].z_s[0], until)
    assert curve.reached == (least > 0)
    assert curve.reached or curve.ending.startswith("finger 1 touches finger 2 at x = ")


LANDING = "v1-palm v4-finger1 v6-finger2"
CLOSED = 1e-9
"""Gap [m] that counts as closed: what a trajectory file promises."""


@pytest.fixture(scope="module")
def flipping() -> Problem:
    return problem_of(shipped.LANDING)


@pytest.fixture(scope="module")
def outlines(flipping: Problem) -> list[list[PathGuess]]:
    parts, z = [], flipping.start
    for phase in flipping.phases:
        parts.append(guess_phase(phase, z, flipping.phases[phase.index + 1 :]))
        z = parts[-1][-1].z[-1]
    return parts


@pytest.fixture(scope="module")
def released(outlines: list[list[PathGuess]]) -> Array:
    """Where the landing is guessed to start."""
    return np.asarray(outlines[-1][0].z[0])


def test_outlines_are_closed_at_every_point_and_end_where_their_phase_does(
    flipping: Problem, outlines: list[list[PathGuess]]
) -> None:
    for phase, parts in zip(flipping.phases, outlines, strict=True):
        for part in parts:
            assert len(part.z) == N_POINTS
            assert np.abs(plane.measure_gaps(part.formation, part.z)).max() < CLOSED
            assert part.formation.evaluate_limits(part.z).min() > -CLOSED
        if not phase.until.is_release:
            distance = EndDistance(flipping.scene, phase.until, parts[0].z[0])
            assert abs(distance.measure(parts[-1].z[-1:])[0]) < CLOSED


@pytest.mark.parametrize(
    "names, until, key, reason",
    [
        (LANDING, Until(None, "x", 2.0), "until", "x = 2 m cannot be reached with these contacts"),
        (LANDING, Until(None, "phi", 2.0), "until", "cannot be reached"),
        (LANDING, "v5-palm", "until", "v5-palm cannot be reached .* v. touches the palm first"),
        (LANDING, Until(), "until", "is missing"),
        ("v1-palm v4-finger1 v5-finger2", "v2-palm", "contacts", "v5-finger2 does not touch"),
        ("v1-palm v4-finger1", "v2-palm", "contacts", None),
    ],
)
def test_phases_that_cannot_be_are_named(
    flipping: Problem, released: Array, names: str, until: Until | str, key: str, reason: str | None
) -> None:
    if isinstance(until, str):
        until = Until(parse_contact(until, flipping.scene))
    phase = Phase(5, plane.make_formation(flipping.scene, names), until)
    if reason is None:
        assert guess_phase(phase, released)
        return
    with pytest.raises(InputError, match=reason) as caught:
        guess_phase(phase, released)
    assert caught.value.key == f"phases[6].{key}" and caught.value.exit_status == 2


def test_five_contacts_leave_nothing_to_plan(flipping: Problem, curves: tuple[Curve, ...]) -> None:
    first = flipping.phases[0]
    assert first.until.contact is not None
    held = Formation(flipping.scene, (*first.formation.contacts, first.until.contact))
    with pytest.raises(InputError, match="leave no freedom") as caught:
        guess_phase(Phase(1, held, flipping.phases[1].until), curves[0].end)
    assert caught.value.key == "phases[2].contacts"


def test_an_end_is_found_where_the_nearest_one_breaks_a_limit() -> None:
    """v0 is lifted until edge 0 is flush on finger 2, while v1 stays on the link's side."""
    problem = problem_of(shipped.HEXAGON)
    start, scene = trace_phases(problem)[4].end, problem.scene
    formation = plane.make_formation(scene, "v1-palm v3-finger1 v0-finger2")
    until = parse_contact("v1-finger2", scene)
    ending = Formation(scene, (*formation.contacts, until))
    nearest = close_contacts(ending, start, np.zeros(0))
    assert nearest is not None and ending.evaluate_limits(nearest[None]).min() < -CLOSED
    (part,) = guess_phase(Phase(5, formation, Until(until)), start)
    assert np.abs(plane.measure_gaps(ending, part.z[-1])).max() < CLOSED
    assert formation.evaluate_limits(part.z).min() > -CLOSED
    # Edge 0 leaves the palm by the angle between finger 2 and the left end of the palm.
    np.testing.assert_allclose(part.z[-1, 2], part.z[-1, 4] - np.pi, atol=1e-9)


def test_a_flush_edge_that_turns_is_planned_in_the_time_domain_too() -> None:
    square = problem_of(shipped.SQUARE)
    curves, options = trace_phases(square), PlanOptions(time_intervals=6)
    curve = curves[2]
    turning = [part.Xi for part in curve.segments]
    assert len(turning) == 2 and (turning[0] != turning[1]).tolist() == [False, True, True, False]
    exact = plan_path(curve, square.epsilon, options, 3, None).motion.duration
    (plan,) = plan_phases(square, square.phases[2:3], curves[1].end, options)
    # Torques that are linear in each interval come a little behind the true least time.
    assert exact * (1 - 1e-4) < plan.motion.duration < 1.02 * exact
