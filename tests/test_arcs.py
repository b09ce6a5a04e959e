"""Curves that are traced once: parts of them are what tracing from there finds."""

from __future__ import annotations

import numpy as np
import pytest

from shipped import HEPTAGON, problem_of
from wholearm.geometry.arcs import find_on, join, take
from wholearm.geometry.curve import Curve
from wholearm.geometry.tracing import trace_curve, trace_phases
from wholearm.problem.definition import Until

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


def test_one_way_alone_is_run_from_its_end() -> None:
    curve = CURVES[0]
    alone = join(curve, None)
    np.testing.assert_allclose(alone.start, curve.end, atol=1e-12)
    np.testing.assert_allclose(alone.end, curve.start, atol=1e-12)
    assert join(None, curve) is curve
