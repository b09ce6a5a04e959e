from __future__ import annotations

import numpy as np
import pytest

from shipped import HEPTAGON
from wholearm.benchmark.stress.event_tracing import follow, resample, slides
from wholearm.geometry.curve import Curve
from wholearm.geometry.path_guess import load
from wholearm.geometry.tracing import trace_phases
from wholearm.problem.definition import Problem


@pytest.mark.parametrize("index", [1, 3])
def test_small_steps_end_where_the_curve_does(
    heptagon: Problem, curves: tuple[Curve, ...], index: int
) -> None:
    phase = heptagon.phases[index]
    start = curves[index].evaluate(np.zeros(1)).z[0]
    ways = follow(heptagon.scene, phase, start)
    (reached,) = (way for way in ways if way.reached)
    assert np.abs(reached.z[-1] - curves[index].end).max() < 1e-5
    assert {way.ending for way in ways if not way.reached} <= {
        "object and palm",
        "object and finger 1",
        "object and finger 2",
    }


def test_rolling_keeps_its_place() -> None:
    problem = load(str(HEPTAGON.with_name("box_rolling.toml")))
    first, second = trace_phases(problem)[:2]
    ways = follow(problem.scene, problem.phases[1], first.end)
    (reached,) = (way for way in ways if way.reached)
    assert np.abs(reached.z[-1] - second.end).max() < 1e-4


def test_places_where_a_contact_turns_are_on_the_grid(
    heptagon: Problem, curves: tuple[Curve, ...]
) -> None:
    phase, curve = heptagon.phases[2], curves[2]
    start = curve.evaluate(np.zeros(1)).z[0]
    (reached,) = (way for way in follow(heptagon.scene, phase, start) if way.reached)
    s, z, z_s = resample(heptagon.scene, phase, reached, 20)
    turns = [part.start for part in curve.segments[1:]]
    assert turns, "this phase is here for its reversal"
    for turn in turns:
        assert np.abs(s - turn).min() < 1e-3 * curve.length
    rates = slides(heptagon.scene, phase, z, z_s)
    assert (np.abs(rates[s == s[np.abs(s - turns[0]).argmin()]]).min()) < 1e-4
