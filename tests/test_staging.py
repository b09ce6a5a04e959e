from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest

from plane import measure_gaps
from timed import landing
from wholearm.geometry.path_guess import guess_phase
from wholearm.geometry.tracing import trace_phases
from wholearm.planning.time_domain.collocation import make_scheme
from wholearm.planning.time_domain.stage import Stage
from wholearm.planning.time_domain.stage_modes import LEAST_INTERVALS
from wholearm.planning.time_domain.stages import guess_stages

SCHEME = make_scheme("radau", 3)


@pytest.fixture(scope="module")
def stages() -> list[Stage]:
    """Of the flip's last formation and the landing."""
    problem = landing()
    start = trace_phases(problem)[-1].end
    return guess_stages(problem, problem.phases[4:], start, SCHEME, 12, 2.0)


def test_directions_change_where_a_stage_says_that_they_turn(stages: list[Stage]) -> None:
    for before, after in pairwise(stages):
        signs = np.concatenate(before.directions)
        names = [*before.formation.names, "joint 1", "joint 2"]
        turned = {names[row] for row in before.turns}
        known = dict(zip(names, signs, strict=True))
        names = [*after.formation.names, "joint 1", "joint 2"]
        for name, sign in zip(names, np.concatenate(after.directions), strict=True):
            assert (sign != known.get(name, sign)) == (name in turned)
    assert stages[-1].turns == ()


def test_guesses_follow_the_outlines_in_one_sweep(stages: list[Stage]) -> None:
    parts = [stage.guess for stage in stages]
    for stage, part in zip(stages, parts, strict=True):
        assert stage.intervals >= LEAST_INTERVALS
        np.testing.assert_allclose(part.fractions, 1 / stage.intervals)
        # Points on straight lines between 25 closed configurations, in radii of gyration.
        gaps = [measure_gaps(stage.formation, z) for z in part.z.reshape(-1, 5)]
        assert np.abs(gaps).max() < 3e-3
        np.testing.assert_allclose(part.nodes[1:, 0], part.z[:, -1], atol=1e-12)
        assert part.forces[..., : stage.formation.n_contacts].min() > 0
        limits = stage.formation.scene.torque_limit
        assert (np.abs(part.tau) < limits).all()
        # Velocities are the slope of what is guessed.
        t = part.duration * part.places(SCHEME.points)
        step = np.diff(part.z[:, :2], axis=1)[:, 0] / np.diff(t[:, :2], axis=1)
        middle = (part.v[:, 0] + part.v[:, 1]) / 2
        assert np.abs(step - middle).max() < 0.15 * np.abs(part.v).max()
    for before, after in pairwise(parts):
        np.testing.assert_allclose(before.nodes[-1, 0], after.nodes[0, 0], atol=1e-12)
    for node in (parts[0].nodes[0, 1], parts[-1].nodes[-1, 1]):
        np.testing.assert_allclose(node, 0.0, atol=1e-12)


@pytest.mark.parametrize("pace", [1.0, 4.0])
def test_the_duration_is_that_of_a_fall_times_the_pace(pace: float) -> None:
    problem = landing()
    start, phases = trace_phases(problem)[-1].end, problem.phases[4:]
    stages = guess_stages(problem, phases, start, SCHEME, 12, pace)
    z, length = start, 0.0
    for phase in phases:
        for outline in guess_phase(phase, z):
            length += outline.length
            z = outline.z[-1]
    whole = sum(stage.guess.duration for stage in stages) * problem.scene.scales.time
    # The outline that is split leaves out nothing but the rounding of its length.
    assert whole == pytest.approx(pace * np.sqrt(length / 9.81), rel=1e-3)
