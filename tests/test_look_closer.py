from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from planned import plan
from wholearm.results.torque import TorqueProfile
from wholearm.simulation.simulate import simulate
from wholearm.verification.verdict import Allowance
from wholearm.verification.verify import choose_times, verify


def test_rows_of_a_plan_and_both_ends_of_phases_are_looked_at() -> None:
    problem, trajectory = plan()
    times = choose_times(problem, trajectory.torque, trajectory)
    assert np.isin(times, trajectory.t).all()
    assert np.isin(trajectory.phase_starts[:-1], times).all() and trajectory.t[-1] in times
    even = choose_times(problem, trajectory.torque, None)
    np.testing.assert_allclose(even[[0, -1]], trajectory.torque.breaks[[0, -1]])


def wiggle(torque: TorqueProfile, piece: int, size: float) -> TorqueProfile:
    """Torques with a wiggle in one piece that vanishes at both of its ends and in its middle."""
    coefficients = np.pad(torque.coefficients, ((0, 0), (0, 0), (0, 3)))
    coefficients[piece, 0, [1, 3]] += size * np.array([1.0, -1.0])
    return replace(torque, coefficients=coefficients)


@pytest.mark.parametrize(("piece", "size"), [(11, 0.08), (67, -0.08)])
def test_a_dip_between_instants_is_found(piece: int, size: float) -> None:
    """The lowest dip of all, by a thousandth of epsilon lower than allowed, and then higher."""
    problem, trajectory = plan()
    torque = wiggle(trajectory.torque, piece, size)
    start, stop = torque.breaks[piece : piece + 2]
    fine = simulate(problem, torque, times=np.linspace(start, stop, 400))
    least = np.nanmin(fine.c_n)
    lowest = int(np.where(np.isnan(fine.c_n), np.inf, fine.c_n).min(axis=1).argmin())
    assert least > 0.0 and start < fine.t[lowest] < stop
    rounding = Allowance().measure_stray(problem) - Allowance().stray * problem.epsilon
    for more, fails in (1e-3, True), (-1e-3, False):
        epsilon = (least + rounding) / (1 - Allowance().stray - more)
        texts = verify(problem.with_(epsilon=epsilon), torque).warnings
        assert any(" falls to " in text for text in texts) is fails
