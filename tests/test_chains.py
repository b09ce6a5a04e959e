"""Borders passed without a stop: what is looked at is what planning them as one finds."""

from __future__ import annotations

import pickle

import numpy as np
import pytest

from shipped import HEPTAGON, IMPACTS, LANDING, problem_of, solved
from wholearm.contacts.formation import Formation
from wholearm.geometry.tracing import trace_phases
from wholearm.problem.definition import End
from wholearm.problem.goal import Goal
from wholearm.search.border_limits import estimate_duration, find_border_limits
from wholearm.search.edges import Link, cut_curve, time_parts
from wholearm.search.goals import is_at
from wholearm.search.places import make_place
from wholearm.search.roadmap import Roadmap


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


def test_a_border_is_kept_without_what_is_seen_of_it() -> None:
    problem = problem_of(IMPACTS)
    border = Roadmap(problem, 0.1).trace(make_place(problem.scene, problem.start))[0]
    seen = border.limits
    kept = pickle.loads(pickle.dumps(border))
    assert "limits" not in kept.__dict__
    np.testing.assert_allclose(kept.limits.rows.one, seen.rows.one, rtol=1e-9, atol=1e-12)


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
