from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import wholearm.planning.time_domain.attempts as attempts
import wholearm.planning.time_domain.mode_search as mode_search
from plane import make_formation, measure_gaps, measure_slip
from thrown import parting, raised
from timed import instants, landing, plan_landing, total
from tipping import roll, tilting
from wholearm.contacts.formation import find_touching
from wholearm.geometry.tracing import trace_phases
from wholearm.mechanics.dynamics import Directions
from wholearm.planning.options import PlanOptions
from wholearm.planning.plan import solve
from wholearm.planning.time_domain.enforcing import MOST
from wholearm.planning.time_domain.mode_search import improve
from wholearm.planning.time_domain.modes import in_mode, link, mode_of, sign_sequence, split
from wholearm.planning.time_domain.motion import TimeMotion
from wholearm.planning.time_domain.moves import WORTH
from wholearm.planning.time_domain.plan import plan_phases
from wholearm.planning.time_domain.search import Search, Solution
from wholearm.planning.time_domain.stage import Stage
from wholearm.planning.time_domain.staging import guess_stages
from wholearm.problem.definition import End, Problem, Until
from wholearm.verification.verdict import DEPARTURE
from wholearm.verification.verify import verify

OPTIONS = PlanOptions(time_intervals=10)


def outlined(problem: Problem, count: int = 10) -> tuple[Search, list[Stage]]:
    search = Search.of(problem, OPTIONS)
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


def test_a_joint_that_is_guessed_the_wrong_way_is_corrected() -> None:
    search, stages = outlined(raised())
    right = improve(search, search.solve(stages))
    wrong = search.solve(turn_joint(stages, 1))
    assert right.success and wrong.success
    corrected = improve(search, wrong)
    assert corrected.cost < 0.9 * wrong.cost
    # Whichever way was guessed, what is found is the same.
    assert corrected.cost == pytest.approx(right.cost, rel=WORTH)
    assert sign_sequence(corrected.stages) == sign_sequence(right.stages)


def test_plans_are_the_same_whichever_way_a_joint_is_guessed(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    problem = raised()

    def guess_wrong(*given: object, **named: object) -> list[Stage]:
        return turn_joint(guess_stages(*given, **named), 1)  # type: ignore[arg-type]

    (right,) = plan_phases(problem, problem.phases, problem.start, OPTIONS)
    monkeypatch.setattr(attempts, "guess_stages", guess_wrong)
    (plan,) = plan_phases(problem, problem.phases, problem.start, OPTIONS)
    assert plan.sequences > 1
    assert plan.motion.duration == pytest.approx(right.motion.duration, rel=1e-3)
    for stage in plan.motion.stages:
        samples = stage.evaluate(instants(stage, 12))
        slip = measure_slip(stage.formation, samples.z, samples.z_dot)
        joints = samples.z_dot[:, 3:]
        assert (slip * stage.directions.Xi).min() > -1e-4 * np.abs(slip).max()
        assert (joints * stage.directions.sigma).min() > -1e-4 * np.abs(joints).max()


def test_rolling_for_a_while_is_found_where_it_is_the_best_of_all_sequences() -> None:
    # The box turns over one vertex one way, so that only its own mode is in question.
    search, (stage,) = outlined(tilting(), 16)
    modes = [mode_of(stage).changed((0,), sign) for sign in (-1.0, 0.0)]
    guesses = [[in_mode(stage, mode)] for mode in modes]
    guesses.append(split(in_mode(stage, modes[1]), search.scheme, 8, 16, modes[0]))
    slides, rolls, both = (search.solve(link(guess)) for guess in guesses)
    # Sliding throughout and rolling throughout are possible; doing both in turn is quicker.
    assert slides.success and rolls.success and both.success
    assert both.cost < (1 - WORTH) * min(slides.cost, rolls.cost)
    found = improve(search, slides)
    palm = [mode_of(part).signs[0] for part in found.stages]
    assert {*palm} == {0.0, -1.0}
    assert found.cost < (1 - WORTH) * min(slides.cost, rolls.cost)
    # It rolls for a while, and leans on its cone less epsilon at most.
    rolling = found.stages[palm.index(0.0)]
    assert rolling.guess.duration > 0.1 * found.cost
    c_n, c_t = rolling.guess.forces[..., 0], rolling.guess.forces[..., -1]
    mu = rolling.formation.friction[0]
    assert (mu * (c_n - search.problem.epsilon) - np.abs(c_t)).min() > -1e-6


def test_a_stage_of_no_length_that_gains_by_its_intervals_alone_is_dropped(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    search, stages = outlined(raised(), 4)
    first = search.solve(stages)
    (stage,) = first.stages
    pieces = link(split(stage, search.scheme, 0, 1, mode_of(stage).changed((1,), 0.0)))
    split_up = search.solve(pieces)
    # Rolling shrinks to the shortest that is allowed, and all that follows is one stage less.
    assert split_up.stages[0].guess.duration < 1e-4
    assert split_up.cost < (1 - WORTH) * first.cost
    list_all = mode_search.list_neighbours

    def list_pieces(search: Search, solution: Solution, leaning: bool = False) -> list[list[Stage]]:
        return [pieces] if solution is first else list_all(search, solution, leaning)

    monkeypatch.setattr(mode_search, "list_neighbours", list_pieces)
    found = improve(search, first)
    assert sign_sequence(found.stages) == sign_sequence(first.stages)
    assert found.cost == pytest.approx(split_up.cost, rel=WORTH)


def test_stages_dropped_one_way_or_another_are_solved_for_once(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    search, stages = outlined(raised(), 4)
    (stage,) = stages
    solution = search.solve(link(split(stage, search.scheme, 0, 2, mode_of(stage))))
    assert len(solution.stages) == 2
    # The same single stage twice, the wrong way round: no better than the two.
    moves = [turn_joint(stages, 1), turn_joint(stages, 1)]
    monkeypatch.setattr(mode_search, "list_neighbours", lambda *given, **named: list(moves))
    known = search.tried.sequences
    assert improve(search, solution) is solution
    assert search.tried.sequences == known + 1


def test_rounding_of_masses_decides_nothing() -> None:
    problem = landing()
    noisy = problem.with_(mass=problem.scene.polygon.mass * (1 + 2.04e-10))
    start = trace_phases(problem)[-1].end
    plans = plan_phases(noisy, noisy.phases[4:], start, PlanOptions(time_intervals=6))
    assert total(plans) == pytest.approx(total(plan_landing(time_intervals=6)), rel=1e-7)


def test_a_first_phase_lets_go_what_touches_at_the_start() -> None:
    problem = parting()
    (phase,) = problem.phases
    touching = find_touching(problem.scene, problem.start)
    (left,) = {c.name for c in touching} - set(phase.formation.names)
    plan = solve(problem, transcription="time", time_intervals=8).trajectory
    report = verify(problem, plan)
    assert report.ok, report.to_text()
    motion = plan.motions[0]
    samples = motion.evaluate(np.linspace(0.0, motion.duration, 50))
    gap = measure_gaps(make_formation(problem.scene, left), samples.z)[:, 0]
    assert abs(gap[0]) < 1e-9
    # It opens at once and does not touch again [m].
    assert (gap[1:] > 1e-6).all()


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
    assert sum(len(stage.points.fractions) for stage in stages) <= 2 * MOST
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
