"""Straight paths through cells, borders passed without a stop, and parts of traced curves."""

from __future__ import annotations

import math
from functools import cache

import numpy as np
import pytest

from shipped import HEPTAGON, IMPACTS, LANDING, SQUARE, problem_of, solved
from wholearm.contacts.closing import contact_table, measure_gap, place
from wholearm.contacts.formation import Formation
from wholearm.geometry.arcs import find_on, join, take
from wholearm.geometry.curve import Curve
from wholearm.geometry.tracing import trace_curve, trace_phases
from wholearm.mapping.borders import label_cells
from wholearm.mapping.formation_map import Border
from wholearm.planning.lower_bound.lower_bound import look_along
from wholearm.planning.lower_bound.speed_sweep import NoMotionError
from wholearm.problem.definition import End, Until
from wholearm.problem.goal import Goal
from wholearm.search.border_limits import estimate_duration, find_border_limits
from wholearm.search.edges import Link, cut_curve, time_parts
from wholearm.search.places import RoadmapPlace, is_at, list_formations_at, make_place, unit_steps
from wholearm.search.roadmap import BESIDE, Rays, Roadmap, can_start, shoot, time_paths
from wholearm.search.times import time_borders

PARTS = 50


@cache
def around_the_start() -> tuple[RoadmapPlace, Rays]:
    problem = problem_of(SQUARE)
    own = make_place(problem.scene, problem.start)
    return own, shoot([own], problem.epsilon)


def test_rays_stay_in_a_cell_of_the_place_until_a_contact_is_gained() -> None:
    own, rays = around_the_start()
    scene, table = own.scene, contact_table(own.scene)
    cells = [cell.contacts for cell in list_formations_at(own, 3)]
    assert len(np.unique(rays.gained)) > 1
    for label, gained in zip(rays.labels, rays.gained, strict=True):
        assert tuple(table[k] for k in label) in cells
        assert table[gained] not in own.contacts
    parts = np.arange(1, PARTS + 1) / PARTS
    poses = rays.starts[:, None] + parts[:, None] * rays.runs[:, None]
    labels = label_cells(scene, *poses.reshape(-1, 2).T)[:, [0, 2, 4]]
    assert (labels.reshape(len(poses), -1, 3) == rays.labels[:, None]).all()


def test_rays_end_right_before_what_they_gain_touches() -> None:
    own, rays = around_the_start()
    scene = own.scene
    before = measure_gap(scene, rays.gained, place(scene, rays.labels, rays.ends))
    assert (before > 0).all()
    lengths = np.linalg.norm(rays.runs / unit_steps(scene), axis=1)[:, None]
    ends = rays.ends + BESIDE * rays.runs / lengths
    assert (measure_gap(scene, rays.gained, place(scene, rays.labels, ends)) < 0).all()


def test_no_way_is_faster_with_more_to_press() -> None:
    own, rays = around_the_start()
    epsilon = problem_of(SQUARE).epsilon
    times, harder = (
        time_paths(own.scene, least, rays.labels, rays.starts, rays.ends)
        for least in (epsilon, 4 * epsilon)
    )
    assert np.isfinite(times).any() and (harder >= times * (1 - 1e-12)).all()
    one = time_paths(own.scene, epsilon, rays.labels[:1], rays.starts[:1], rays.ends[:1])
    assert one[0] == pytest.approx(times[0], rel=1e-9)


def test_only_ways_that_can_be_set_out_on_have_times() -> None:
    own, rays = around_the_start()
    epsilon = problem_of(SQUARE).epsilon
    times = time_paths(own.scene, epsilon, rays.labels, rays.starts, rays.ends)
    assert can_start(own.scene, epsilon, rays.labels, rays.starts, rays.runs).all()
    assert np.isfinite(times).any()
    assert not can_start(own.scene, 1e3, rays.labels, rays.starts, rays.runs).any()
    assert np.isinf(time_paths(own.scene, 1e3, rays.labels, rays.starts, rays.ends)).all()


def look(curve: Curve, epsilon: float) -> float:
    try:
        return look_along((curve,), epsilon, 100)
    except NoMotionError:
        return math.inf


def make_border(curve: Curve) -> Border:
    z = curve.evaluate(np.linspace(0, curve.length, 12)).z
    still = np.zeros(len(z), dtype=bool)
    return Border(curve.formation.contacts, (None, 0), "x", z[:, [0, 2]], z, still, still, still)


def test_times_of_borders_are_those_of_sweeps_along_traced_curves() -> None:
    problem = problem_of(HEPTAGON)
    curves = trace_phases(problem)
    expected = []
    for forth in curves:
        way = -forth.evaluate(np.array([forth.length])).z_s[0]
        back = cut_curve(trace_curve(forth.formation, forth.end, way, Until()), forth.length)
        expected.append([look(own, problem.epsilon) for own in (forth, back)])
    found = time_borders(problem, [make_border(curve) for curve in curves])
    # Twelve points and twenty-four intervals leave an error of a few in a hundred.
    assert found == pytest.approx(np.array(expected), rel=0.04)
    assert np.isfinite(found[:, 0]).all()


def test_a_chain_of_impacts_is_bounded_as_its_plan_takes() -> None:
    problem = problem_of(IMPACTS)
    chart, phases = Roadmap(problem, 0.1), problem.phases[:3]
    until = [str(phase.until) for phase in phases]
    (own,) = (
        link
        for chain, link in chart.pass_on(make_place(problem.scene, problem.start))
        if isinstance(link, Link) and [str(step.until) for step in link.steps] == until
    )
    assert [step.end for step in own.steps] == [End.IMPACT, End.IMPACT, End.REST]
    took = sum(motion.duration for motion in solved(IMPACTS).trajectory.motions[:3])
    assert own.bound <= took * (1 + 1e-6)
    assert own.duration == pytest.approx(took, rel=1e-2)
    # A stop at each crossing takes longer, by what the plan says that the impacts save.
    alone, place = 0.0, make_place(problem.scene, problem.start)
    for phase in phases:
        (link,) = (
            link
            for border, link in chart.follow(place)
            if isinstance(link, Link)
            and set(border.formation.contacts) == set(phase.formation.contacts)
            and link.steps[0].until == phase.until
        )
        alone, place = alone + link.duration, link.stop
    assert alone > 1.2 * own.duration


def test_no_chain_leads_through_an_impact_that_is_not_possible() -> None:
    problem = problem_of(HEPTAGON)
    chart = Roadmap(problem, 0.1)
    place = make_place(problem.scene, problem.start)
    # With little friction there the impact onto v3-finger1 would tip edge 0 off the palm.
    assert [
        chain for chain, _ in chart.pass_on(place) if str(chain.steps[0].until) == "v3-finger1"
    ] == []


def test_chains_are_followed_a_border_at_a_time_to_where_all_of_them_lead() -> None:
    problem, goal = problem_of(IMPACTS), Goal(flush=1)
    chart = Roadmap(problem, 0.1)
    place = make_place(problem.scene, problem.start)
    waiting, steps = list(chart.set_out(place, goal)), set()
    while waiting:
        own = waiting.pop()
        if isinstance(own.link, Link):
            steps.add(own.link.steps)
            waiting += chart.go_on(own.chain, goal) if own.whole else []
    every = [link for _, link in chart.list_along(place, goal) if isinstance(link, Link)]
    assert steps == {link.steps for link in every} and len(steps) > 3


def test_parts_of_a_border_take_as_long_together_as_one_by_one() -> None:
    problem = problem_of(IMPACTS)
    chart, shares = Roadmap(problem, 0.1), np.array([0.2, 0.5, 0.8])
    for border in chart.trace(make_place(problem.scene, problem.start)):
        times = time_parts(border, shares)
        for share, took in zip(shares, times, strict=True):
            part = cut_curve(border.curve, share * border.curve.length)
            limits = find_border_limits(part, *chart.terms)
            alone = limits.closed or limits.begins or limits.ends or estimate_duration([limits])
            assert np.isfinite(took) == (not isinstance(alone, str))
            assert isinstance(alone, str) or took == pytest.approx(alone, rel=0.02)


def test_a_landing_is_led_to_where_the_goal_is() -> None:
    problem, goal = problem_of(LANDING), Goal(flush=1, x=0.022)
    chart, curves = Roadmap(problem, 0.1), trace_phases(problem)
    place = make_place(problem.scene, curves[3].end)
    contacts = set(problem.phases[4].formation.contacts)
    ((index, border),) = (
        (k, own)
        for k, (own, _) in enumerate(chart.follow(place))
        if set(own.formation.contacts) == contacts
    )
    landings = chart.land_at(chart.release(border, index), goal)
    assert landings
    for link in landings:
        assert is_at(link.stop, goal) and str(link.steps[-1].until) == "v2-palm at x = 0.022 m"
        assert [step.end for step in link.steps] == [End.SMOOTH, End.REST]
        gaps = Formation(problem.scene, link.stop.contacts).evaluate(*[link.stop.z[None]] * 2).C
        assert np.abs(gaps).max() < 1e-8 * problem.scene.scales.length
    assert chart.land_at(chart.release(border, index), Goal(flush=1)) == []


CURVES = trace_phases(problem_of(HEPTAGON))


def whole_of(curve: Curve) -> Curve:
    """The curve through a place inside another one, as it is traced both ways from there."""
    at = curve.evaluate(np.array([0.4 * curve.length]))
    back, forth = (
        trace_curve(curve.formation, at.z[0], sign * at.z_s[0], Until()) for sign in (-1, 1)
    )
    return join(back, forth)


@pytest.mark.parametrize("index", [0, 1])
def test_parts_of_a_joined_curve_are_what_is_traced_from_there(index: int) -> None:
    whole = whole_of(CURVES[index])
    length = whole.formation.scene.scales.length
    for share in (0.0, 0.3, 0.7, 1.0):
        s = share * whole.length
        at = whole.evaluate(np.array([s]))
        for stop, sign in ((whole.length, 1), (0.0, -1)):
            if abs(stop - s) < 0.1 * whole.length:
                continue
            part = take(whole, s, stop)
            traced = trace_curve(whole.formation, at.z[0], sign * at.z_s[0], Until())
            # Panels are resolved to 1e-13, and ends are as sharp as limits are met, to 3e-10.
            assert part.length == pytest.approx(traced.length, abs=1e-9 * length)
            places = np.linspace(0, 1, 50) * min(part.length, traced.length)
            own, other = part.evaluate(places), traced.evaluate(places)
            np.testing.assert_allclose(own.z, other.z, atol=1e-11)
            np.testing.assert_allclose(own.z_s, other.z_s, atol=1e-10)
            np.testing.assert_allclose(part.start, at.z[0], atol=1e-12)
            assert len(part.segments) == len(traced.segments)
            for mine, theirs in zip(part.segments, traced.segments, strict=True):
                assert mine.stop == pytest.approx(theirs.stop, abs=1e-8 * length)
                np.testing.assert_array_equal(mine.Xi, theirs.Xi)
                np.testing.assert_array_equal(mine.sigma, theirs.sigma)


def test_places_on_a_curve_are_found_and_others_are_not() -> None:
    curve = CURVES[0]
    length = curve.formation.scene.scales.length
    for s in np.array([0.0, 0.123, 0.77, 1.0]) * curve.length:
        z = curve.evaluate(np.array([s])).z[0]
        found = find_on(curve, z)
        assert found is not None and found == pytest.approx(s, abs=1e-10 * length)
        assert find_on(curve, z + 1e-6 * length * np.array([0, 1, 0, 0, 0])) is None
    beyond = curve.end + 1e-3 * length * curve.evaluate(np.array([curve.length])).z_s[0]
    assert find_on(curve, beyond) is None
