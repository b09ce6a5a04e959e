"""Impacts of plans over time and along curves."""

from __future__ import annotations

import copy
import tomllib
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest

from once import once
from plane import measure_gaps
from shipped import HEPTAGON, IMPACTS, LANDING, plan_of, problem_of
from wholearm import End, Formation, Plan, Problem, verify
from wholearm.common.arrays import Array
from wholearm.geometry.tracing import trace_phases
from wholearm.mechanics.dynamics import metric_weights
from wholearm.mechanics.impact import compute_impact
from wholearm.planning.plan import solve
from wholearm.problem.read import build_problem
from wholearm.results.trajectory import Samples, Trajectory

PARTS = {"time": (0, 2), "effort": (1, 4)}
"""Phases that are planned: one impact; another, and a stop where no impact is possible."""


@cache
def problem(objective: str) -> Problem:
    first, last = PARTS[objective]
    whole = problem_of(IMPACTS)
    phases = [replace(phase, index=k) for k, phase in enumerate(whole.phases[first:last])]
    phases[-1] = replace(phases[-1], end=End.REST)
    start = trace_phases(whole)[first - 1].end if first else whole.start
    return replace(whole, start=start, phases=tuple(phases))


@once
def solved(objective: str) -> Plan:
    """Plans on few intervals, whose replay is a test of its own."""
    options: dict[str, Any] = {"time_intervals": 4, "replay": False}
    return solve(problem(objective), objective, transcription="time", **options)


def planned(objective: str) -> Trajectory:
    return solved(objective).trajectory


@cache
def along(objective: str) -> Trajectory:
    return solve(problem(objective), objective, intervals=80, replay=False).trajectory


def ends_of(trajectory: Trajectory, phase: int) -> tuple[Samples, Samples]:
    """The last sample of a phase and the first one of the next."""
    before, after = trajectory.motions[phase], trajectory.motions[phase + 1]
    return before.evaluate(np.array([before.duration])), after.evaluate(np.zeros(1))


def find_impulses(formation: Formation, z: Array, v: Array, v_next: Array) -> Array:
    """Impulses on sliding contacts that explain a jump of z', by least squares: M5 dv = G^T p."""
    kinematics = formation.evaluate(z[None], v_next[None])
    slip = kinematics.A_t[0] @ v_next
    G = kinematics.A[0] - (formation.friction * np.sign(slip))[:, None] * kinematics.A_t[0]
    right = formation.scene.mass_diagonal * (v_next - v)
    p, *_ = np.linalg.lstsq(G.T, right, rcond=None)
    np.testing.assert_allclose(G.T @ p, right, rtol=0, atol=1e-6 * np.abs(right).max())
    return np.asarray(p)


def test_least_times_with_impacts_agree_with_those_along_the_curves() -> None:
    within, expected = planned("time"), along("time").meta["phase_durations"]
    # The planner along curves passes impacts by a condition on speeds alone.
    # Either is good to the accuracy that is asked for, 1e-4.
    assert -1e-4 < within.duration / sum(expected) - 1 < 3e-3
    np.testing.assert_allclose(within.meta["phase_durations"], expected, rtol=5e-3)
    report = verify(problem("time"), within)
    assert report.ok, report.to_text()
    impulses = [phase.impact.impulse for phase in report.phases if phase.impact is not None]
    assert len(impulses) == 1 and min(impulses) > 0


@pytest.mark.parametrize("objective", ["time", "effort"])
def test_transitions_agree_with_those_along_the_curves(objective: str) -> None:
    rows, others = (plan(objective).meta["transitions"] for plan in (planned, along))
    assert [row["phase"] for row in rows] == list(range(1, len(problem(objective).phases)))
    for row, other in zip(rows, others, strict=True):
        for key in ("phase", "gained", "possible", "least_impulse_contact"):
            assert row[key] == other[key]
        assert abs(row["velocity_ratio"]) == pytest.approx(abs(other["velocity_ratio"]), rel=1e-5)
        assert row["least_impulse"] == pytest.approx(other["least_impulse"], rel=1e-4)
        assert row["speed"] == pytest.approx(other["speed"], rel=1e-2)
        if row["possible"]:
            # Both find it as the difference of two plans, each a bit slower than possible.
            assert row["saves"] == pytest.approx(other["saves"], rel=2e-2)
        else:
            assert row["saves"] is None and row["reason"] == other["reason"]


@pytest.mark.parametrize("objective", ["time", "effort"])
def test_velocities_jump_by_the_impact_law(objective: str) -> None:
    plan, own = planned(objective), problem(objective)
    metric = metric_weights(own.scene)
    for k, row in enumerate(plan.meta["transitions"]):
        if not row["possible"]:
            continue
        before, after = (phase.formation for phase in own.phases[k : k + 2])
        end, start = ends_of(plan, k)
        z, v, v_next = end.z[0], end.z_dot[0], start.z_dot[0]
        np.testing.assert_allclose(start.z[0], z, rtol=0, atol=1e-7)
        p = find_impulses(after, z, v, v_next)
        assert p.min() > 0
        speed = np.sqrt(metric @ v**2)
        assert speed > 0.1 and row["speed"] == pytest.approx(speed)
        assert p.min() == pytest.approx(row["least_impulse"] * speed, rel=1e-4)
        assert np.sqrt(metric @ v_next**2) == pytest.approx(row["velocity_ratio"] * speed, rel=1e-5)
        np.testing.assert_allclose(v_next, compute_impact(before, after, z, v).v, rtol=0, atol=1e-5)
        # The contacts of the next formation neither part nor press into one another.
        assert np.abs(measure_gaps(after, z)).max() < 1e-8
        assert np.abs(after.evaluate(z[None], v_next[None]).A[0] @ v_next).max() < 1e-5
        energies = [0.5 * own.scene.mass_diagonal @ u**2 for u in (v, v_next)]
        assert energies[1] < energies[0]


def test_least_effort_with_impacts_is_near_that_along_the_curves() -> None:
    within = planned("effort")
    # Torques that are linear in a sixth of a phase cannot be as gentle.
    assert -1e-4 < within.meta["value"] / along("effort").meta["value"] - 1 < 1e-2
    report = verify(problem("effort"), within)
    assert report.ok, report.to_text()


def test_an_impact_that_is_not_possible_next_to_a_landing_is_a_stop() -> None:
    """The heptagon's landing and the phase before it."""
    whole, expected = problem_of(LANDING), plan_of(LANDING).meta["phase_durations"][3:]
    phases = [replace(phase, index=k) for k, phase in enumerate(whole.phases[3:])]
    phases[0] = replace(phases[0], end=End.IMPACT)
    one = replace(whole, start=trace_phases(whole)[2].end, phases=tuple(phases))
    struck = solve(one, time_intervals=6, replay=False)
    (row,) = struck.meta["transitions"]
    assert (row["phase"], row["possible"], row["gained"]) == (1, False, "v4-finger1")
    assert row["least_impulse"] < 0 and row["least_impulse_contact"] in row["reason"]
    # That phase is planned in the time domain then, and what follows is what it was.
    got = struck.meta["phase_durations"]
    assert -1e-4 < got[0] / expected[0] - 1 < 1e-2
    assert sum(got[1:]) == pytest.approx(sum(expected[1:]), rel=1e-3)


OBJECTIVES = ["time", "effort", "margin"]


@pytest.fixture(scope="module")
def passing() -> Problem:
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


@pytest.mark.parametrize("objective", OBJECTIVES)
def test_velocities_of_sequences_jump_by_the_impact_law(
    passing: Problem, plans: dict[str, Trajectory], objective: str
) -> None:
    trajectory = plans[objective]
    for k, row in enumerate(trajectory.meta["transitions"][:2]):
        before, after = (phase.formation for phase in passing.phases[k : k + 2])
        end, start = ends_of(trajectory, k)
        impact = compute_impact(before, after, end.z[0], end.z_dot[0])
        np.testing.assert_allclose(start.z, end.z, rtol=0, atol=1e-12)
        np.testing.assert_allclose(start.z_dot[0], impact.v, rtol=0, atol=1e-9)
        assert impact.p.min() > 0
        speed = np.sqrt(end.z_dot[0] ** 2 @ metric_weights(passing.scene))
        assert row["speed"] == pytest.approx(speed) and speed > 0.1
        name, impulse = impact.least
        assert name == row["least_impulse_contact"]
        assert impulse == pytest.approx(row["least_impulse"] * speed)
        later = np.sqrt(start.z_dot[0] ** 2 @ metric_weights(passing.scene))
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
