from __future__ import annotations

import copy
import tomllib
from typing import Any

import numpy as np
import pytest

from plane import measure_gaps, measure_slip, unbalance
from shipped import HEPTAGON, IMPACTS, plan_of, problem_of
from wholearm.mechanics.dynamics import metric_weights
from wholearm.mechanics.impact import compute_impact
from wholearm.planning.plan import solve
from wholearm.problem.definition import Problem
from wholearm.problem.read import build_problem
from wholearm.results.trajectory import Samples, Trajectory

OBJECTIVES = ["time", "effort", "margin"]
LIMIT = 2.0


@pytest.fixture(scope="module")
def problem() -> Problem:
    return problem_of(IMPACTS)


@pytest.fixture(scope="module")
def plans() -> dict[str, Trajectory]:
    return {objective: plan_of(IMPACTS, objective) for objective in OBJECTIVES}


def edited(*stops: int) -> Problem:
    """The problem with a stop at the end of the given phases."""
    table: dict[str, Any] = copy.deepcopy(tomllib.loads(IMPACTS.read_text(encoding="utf-8")))
    for number in stops:
        table["phases"][number - 1]["end"] = "rest"
    return build_problem(table)


def ends_of(trajectory: Trajectory, phase: int) -> tuple[Samples, Samples]:
    """The last sample of a phase and the first one of the next."""
    before, after = trajectory.motions[phase], trajectory.motions[phase + 1]
    return before.evaluate(np.array([before.duration])), after.evaluate(np.zeros(1))


@pytest.mark.parametrize("objective", OBJECTIVES)
def test_velocities_jump_by_the_impact_law(
    problem: Problem, plans: dict[str, Trajectory], objective: str
) -> None:
    trajectory = plans[objective]
    for k, row in enumerate(trajectory.meta["transitions"][:2]):
        before, after = (phase.formation for phase in problem.phases[k : k + 2])
        end, start = ends_of(trajectory, k)
        impact = compute_impact(before, after, end.z[0], end.z_dot[0])
        np.testing.assert_allclose(start.z, end.z, rtol=0, atol=1e-12)
        np.testing.assert_allclose(start.z_dot[0], impact.v, rtol=0, atol=1e-9)
        assert impact.p.min() > 0
        speed = np.sqrt(end.z_dot[0] ** 2 @ metric_weights(problem.scene))
        assert row["speed"] == pytest.approx(speed) and speed > 0.1
        name, impulse = impact.least
        assert name == row["least_impulse_contact"]
        assert impulse == pytest.approx(row["least_impulse"] * speed)
        later = np.sqrt(start.z_dot[0] ** 2 @ metric_weights(problem.scene))
        assert row["velocity_ratio"] == pytest.approx(later / speed)


@pytest.mark.parametrize("objective", OBJECTIVES)
def test_it_stops_where_no_impact_is_possible(plans: dict[str, Trajectory], objective: str) -> None:
    trajectory = plans[objective]
    rows = trajectory.meta["transitions"]
    assert [(row["phase"], row["possible"]) for row in rows] == [
        (1, True), (2, True), (3, False), (4, False)
    ]  # fmt: skip
    for k, row in enumerate(rows[2:], start=2):
        for samples in ends_of(trajectory, k):
            assert np.abs(samples.z_dot).max() < 1e-6
        assert (row["speed"], row["saves"]) == (0.0, None)
        contact = row["least_impulse_contact"]
        assert row["reason"].startswith(f"impulse on {contact} would be -0.")
        assert row["reason"].endswith(" N s per m/s") and row["least_impulse"] < 0
    assert [row["reason"] for row in rows[:2]] == ["", ""]
    assert [row["gained"] for row in rows] == "v3-finger1 v6-finger2 v0-finger2 v4-finger1".split()


@pytest.mark.parametrize("objective", OBJECTIVES)
def test_every_sample_obeys_newton_and_euler(
    problem: Problem, plans: dict[str, Trajectory], objective: str
) -> None:
    trajectory = plans[objective]
    starts = trajectory.phase_starts
    for t in np.random.default_rng(1).uniform(0, trajectory.duration, 60):
        phase = int(np.searchsorted(starts, t, side="right")) - 1
        formation = problem.phases[phase].formation
        own = trajectory.motions[phase].evaluate(np.array([t - starts[phase]]))
        row = Samples(*(part[0] for part in own))
        residual, size = unbalance(formation, row, np.sign(row.z_dot[3:]))
        assert (np.abs(residual) < 1e-8 * size).all()
        assert np.abs(measure_gaps(formation, row.z)).max() < 1e-9
        slip = measure_slip(formation, row.z, row.z_dot)
        law = -formation.friction * np.sign(slip) * row.c_n
        moving = np.abs(slip) > 1e-9
        np.testing.assert_allclose(row.c_t[moving], law[moving], rtol=1e-12)
        assert row.c_n.min() >= problem.epsilon - 1e-6
        assert np.abs(row.tau).max() <= LIMIT + 1e-6


def test_what_an_impact_saves_is_what_a_stop_costs(plans: dict[str, Trajectory]) -> None:
    objective = "effort"
    value, row = plans[objective].meta["value"], plans[objective].meta["transitions"][0]
    stopped = solve(edited(row["phase"]), objective, replay=False)
    assert row["saves"] == pytest.approx(stopped.meta["value"] - value, abs=1e-9)
    assert row["saves"] > 0.01


def slide(*ends: float) -> Problem:
    """The heptagon slides to x [m] and on to others, joined smoothly."""
    table = tomllib.loads(HEPTAGON.read_text(encoding="utf-8"))
    contacts = table["phases"][0]["contacts"]
    phases = [{"contacts": contacts, "until": {"x": x}, "end": "smooth"} for x in ends]
    return build_problem(table | {"phases": [*phases[:-1], phases[-1] | {"end": "rest"}]})


def test_a_slide_that_goes_on_smoothly_is_as_fast_as_in_one_piece() -> None:
    whole, parts = (solve(slide(*ends), replay=False) for ends in ((0.02,), (0.035, 0.02)))
    assert parts.value == pytest.approx(whole.value, rel=1e-4)
    end, start = ends_of(parts.trajectory, 0)
    np.testing.assert_allclose(start.z_dot, end.z_dot, rtol=0, atol=1e-12)
    assert np.abs(end.z_dot).max() > 0.01
    assert parts.transitions == ()


def test_a_slide_that_turns_back_smoothly_stops_there() -> None:
    there, back = (solve(slide(*ends), replay=False) for ends in ((0.02,), (0.02, 0.03)))
    assert back.phases[0].value == pytest.approx(there.value, rel=1e-6)
    end, start = ends_of(back.trajectory, 0)
    assert max(np.abs(end.z_dot).max(), np.abs(start.z_dot).max()) < 1e-9
