"""What a policy keeps in reserve where the ranges of numbers are known."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import wholearm
from shipped import HEPTAGON, problem_of
from wholearm.common.errors import InputError
from wholearm.geometry.tracing import trace_phase
from wholearm.mechanics.dynamics import build_forward
from wholearm.policy.corners import list_scenes
from wholearm.policy.make import find_widest, make_policy
from wholearm.policy.range_margins import find_within, retime_within
from wholearm.problem.definition import Problem
from wholearm.results.trajectory import Trajectory
from wholearm.robustness.error_model import Uncertainty
from wholearm.robustness.sample_run import make_trial

RANGES = {"mass": 0.1, "inertia": 0.1, "friction": 0.2, "start_x": 5e-4} | dict.fromkeys(
    ("geometry", "gain", "delay"), 0.0
)


@pytest.fixture(scope="module")
def problem() -> Problem:
    """The first slide of the heptagon."""
    whole = problem_of(HEPTAGON)
    return whole.with_({"phases": list(whole.table["phases"][:1]), "uncertainty": RANGES})


@pytest.fixture(scope="module")
def plan(problem: Problem) -> Trajectory:
    return wholearm.solve(problem, replay=False).trajectory


def test_limits_are_the_forces_in_the_worst_corner(problem: Problem) -> None:
    widths = {"mass": 0.1, "inertia": 0.1} | {
        f"friction_{part}": 0.2 for part in ("palm", "finger1", "finger2")
    }
    curve = trace_phase(problem.phases[0], problem.start, ())
    s = curve.length * np.array([0.1, 0.2, 0.3])
    within = find_within(curve, s, np.zeros(3), widths, problem.epsilon)
    a, b, squeeze = np.array([3.0, 0.0, -4.0]), np.array([0.1, 0.2, 0.1]), np.full(3, 2.0)
    known = np.column_stack([np.ones(3), b, np.sqrt(b), a, squeeze])
    tau = np.einsum("nfq,nq->nf", within.torque, known)
    point, part = curve.evaluate(s), curve.segments[0]
    assert part.stop > s[-1]
    z_dot, signs = (
        point.z_s * np.sqrt(b)[:, None],
        [np.tile(own, (3, 1)).T for own in (part.Xi, part.sigma)],
    )
    least, scenes = np.full((3, 4), np.inf), list_scenes(problem.scene, widths)
    assert len(scenes) == 32
    for scene in scenes:
        forward = build_forward(replace(curve.formation, scene=scene)).map(3)
        least = np.minimum(least, forward(point.z.T, z_dot.T, tau.T, *signs)[1].full().T)
    rows, _, _ = within.at((a, b, squeeze))
    found = np.einsum("nmq,nq->nm", rows.slack[:, :4], known)
    assert found == pytest.approx(least, abs=1e-9)
    # Other rows are of corners that are worst at other squeezes.
    others = np.einsum("nmq,nq->nm", rows.slack[:, : rows.presses], known)
    assert (others.reshape(3, -1, 4) > least[:, None] - 1e-9).all()


def test_contacts_are_kept_in_corners_of_the_ranges(problem: Problem, plan: Trajectory) -> None:
    policy = make_policy(problem, plan)
    assert policy.about["phases"][0]["share"] == 1.0
    assert policy.duration < 1.3 * plan.duration
    trial = make_trial(problem, plan, Uncertainty(RANGES, None), None, policy)
    # The start is before that of the policy's table.
    off = {"mass": 0.1, "inertia": -0.1, "friction_palm": -0.2, "friction_finger1": 0.2}
    record = trial.change(off | {"start_x": 5e-4})
    assert record["reached"] and record["kept"], (record["lost"], record["time"])


def test_ranges_that_are_too_wide_are_kept_in_part(problem: Problem, plan: Trajectory) -> None:
    curve = trace_phase(problem.phases[0], problem.start, ())
    s = np.linspace(0.0, curve.length, 11)
    b = 0.05 * (4 * s * (curve.length - s) / curve.length**2)
    motion = np.gradient(b, s) / 2, b, np.ones(11)
    found, share = retime_within(curve, s, motion, {"mass": 0.5, "friction_palm": 1.0}, 0.2)
    assert 0.0 < share < 1.0 and found is not None
    assert (found[1].run(0.0) <= b + 1e-12).all()
    with pytest.raises(InputError, match="uncertainty: is missing"):
        find_widest(replace(problem, uncertainty=None), plan, 0.0)


def test_geometry_and_gains_count_to_first_order(problem: Problem) -> None:
    curve = trace_phase(problem.phases[0], problem.start, ())
    s, motion = np.array([0.1 * curve.length]), (np.ones(1), np.full(1, 0.1), np.full(1, 2.0))
    known = np.array([1.0, 0.1, np.sqrt(0.1), 1.0, 2.0])

    def measure(widths: dict[str, float]) -> np.ndarray:
        rows, _, _ = find_within(curve, s, np.zeros(1), widths, 0.05).at(motion)
        return np.asarray(rows.slack[0, :4] @ known)

    # Forces are affine in torques: what a gain takes away is in proportion to it.
    exact, off = measure({}), measure({"gain1": 0.02})
    assert (off < exact).all()
    assert exact - measure({"gain1": 0.01}) == pytest.approx((exact - off) / 2, abs=1e-12)
    both = exact - measure({"gain1": 0.02, "base1_x": 2e-4})
    assert both == pytest.approx(2 * exact - off - measure({"base1_x": 2e-4}), abs=1e-9)
