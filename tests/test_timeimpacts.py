from __future__ import annotations

import tomllib
from functools import lru_cache
from typing import Any

import numpy as np
import pytest

from conftest import HEPTAGON
from plane import measure_gaps
from timed import fastest
from wholearm.curve import metric_weights
from wholearm.formation import Formation
from wholearm.impact import strike
from wholearm.model import Array
from wholearm.outline import load
from wholearm.plan import solve
from wholearm.problem import Problem, build_problem
from wholearm.trajectory import Samples, Trajectory
from wholearm.verify import verify

IMPACTS = HEPTAGON.with_name("heptagon_impact.toml")
STOPS = [3, 4]
"""Phases whose end cannot be passed at speed."""


@lru_cache(maxsize=1)
def problem() -> Problem:
    return load(str(IMPACTS))


@lru_cache(maxsize=4)
def planned(objective: str) -> Trajectory:
    """Plans on few intervals, whose replay is a test of its own."""
    intervals = 16 if objective == "time" else 6
    options: dict[str, Any] = {"time_intervals": intervals, "replay": False}
    return solve(problem(), objective, transcription="time", **options)


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
    within, along = planned("time"), fastest(IMPACTS)
    # The planner along curves passes impacts by a condition on speeds alone.
    assert 0 < within.duration / along.duration - 1 < 3e-3
    np.testing.assert_allclose(
        within.meta["phase_durations"], along.meta["phase_durations"], rtol=5e-3
    )
    report = verify(problem(), within)
    assert report.ok, report.to_text()
    impulses = [phase.impact.impulse for phase in report.phases if phase.impact is not None]
    assert len(impulses) == 2 and min(impulses) > 0


def test_transitions_agree_with_those_along_the_curves() -> None:
    rows, others = (plan.meta["transitions"] for plan in (planned("time"), fastest(IMPACTS)))
    assert [row["phase"] for row in rows] == [1, 2, *STOPS]
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
    plan = planned(objective)
    metric = metric_weights(problem().scene)
    for k, row in enumerate(plan.meta["transitions"][:2]):
        before, after = (phase.formation for phase in problem().phases[k : k + 2])
        end, start = ends_of(plan, k)
        z, v, v_next = end.z[0], end.z_dot[0], start.z_dot[0]
        np.testing.assert_allclose(start.z[0], z, rtol=0, atol=1e-7)
        p = find_impulses(after, z, v, v_next)
        assert p.min() > 0
        speed = np.sqrt(metric @ v**2)
        assert speed > 0.1 and row["speed"] == pytest.approx(speed)
        assert p.min() == pytest.approx(row["least_impulse"] * speed, rel=1e-4)
        assert np.sqrt(metric @ v_next**2) == pytest.approx(row["velocity_ratio"] * speed, rel=1e-5)
        np.testing.assert_allclose(v_next, strike(before, after, z, v).v, rtol=0, atol=1e-5)
        # The contacts of the next formation neither part nor press into one another.
        assert np.abs(measure_gaps(after, z)).max() < 1e-8
        assert np.abs(after.evaluate(z[None], v_next[None]).A[0] @ v_next).max() < 1e-5
        energies = [0.5 * problem().scene.mass_diagonal @ u**2 for u in (v, v_next)]
        assert energies[1] < energies[0]


@pytest.mark.parametrize("objective", ["time", "effort"])
def test_it_stops_where_no_impact_is_possible(objective: str) -> None:
    plan = planned(objective)
    for row in plan.meta["transitions"][2:]:
        assert not row["possible"] and row["speed"] == 0.0
        assert row["reason"].startswith("impulse on v") and row["reason"].endswith("per m/s")
        for samples in ends_of(plan, row["phase"] - 1):
            assert np.abs(samples.z_dot).max() < 1e-5


def test_least_effort_with_impacts_is_near_that_along_the_curves() -> None:
    within, along = planned("effort"), solve(problem(), "effort", intervals=40)
    # Torques that are linear in an eighth of a phase cannot be as gentle.
    assert 0 < within.meta["value"] / along.meta["value"] - 1 < 1e-2
    report = verify(problem(), within)
    assert report.ok, report.to_text()


def test_an_impact_that_is_not_possible_next_to_a_landing_is_a_stop() -> None:
    path = HEPTAGON.with_name("heptagon.toml")
    table: dict[str, Any] = tomllib.loads(path.read_text(encoding="utf-8"))
    options: dict[str, Any] = {"time_intervals": 8, "replay": False}
    stopped = solve(build_problem(table), **options)
    table["phases"][3]["end"] = "impact"
    struck = solve(build_problem(table), **options)
    (row,) = struck.meta["transitions"]
    assert (row["phase"], row["possible"], row["gained"]) == (4, False, "v4-finger1")
    assert row["least_impulse"] < 0 and row["least_impulse_contact"] in row["reason"]
    # Phase 4 is planned in the time domain then, and what follows is what it was.
    got, expected = struck.meta["phase_durations"], stopped.meta["phase_durations"]
    np.testing.assert_allclose(got[:3], expected[:3], rtol=1e-9)
    assert 0 < got[3] / expected[3] - 1 < 1e-2
    np.testing.assert_allclose(got[4:], expected[4:], rtol=1e-3)
