from __future__ import annotations

import math
from itertools import pairwise
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy.integrate import quad

from wholearm.common.arrays import Array
from wholearm.geometry.curve import Curve, Segment
from wholearm.planning.path_domain.elements import (
    DEGREE,
    FROM_REST,
    INSIDE,
    TO_REST,
    Elements,
    Profile,
    find_basis,
    lay_out,
)
from wholearm.planning.path_domain.path_mesh import Mesh
from wholearm.planning.path_domain.path_motion import PathMotion

SEEDS = range(4)


def stub_curve(length: float, breaks: list[float]) -> Curve:
    ends = [0.0, *breaks, length]
    stub: Any = SimpleNamespace(
        length=length,
        segments=tuple(Segment(a, b, np.ones(4), np.ones(2)) for a, b in pairwise(ends)),
        formation=SimpleNamespace(names=("v0-palm",)),
    )
    curve: Curve = stub
    return curve


def random_motion(seed: int) -> PathMotion:
    """From rest to rest over a random grid, with a jump of a where two segments meet."""
    rng = np.random.default_rng(seed)
    length, break_at = rng.uniform(0.02, 0.5), rng.uniform(0.2, 0.8)
    curve = stub_curve(length, [break_at * length])
    grid = Mesh().make_grid(curve, 6)
    x = grid.s / length
    waves = rng.uniform(-0.4, 0.4, 2)
    a = (1 - 2 * x) * (1 + waves[0] * np.sin(5 * x)) + 0.3 * waves[1] * grid.segment
    a = rng.uniform(0.5, 20.0) * (a - grid.integrate(a)[-1] / (2 * length))
    b = grid.integrate(a)
    b[-1] = 0.0
    assert (b[1:-1] > 0).all()
    return PathMotion(curve, grid, Profile(a, b, rng.uniform(0, 1, len(a))))


def acceleration(motion: PathMotion, element: int, s: Array) -> Array:
    """S'' at places of an element, by an interpolation of its own."""
    grid = motion.grid
    start, stop = grid.edges[element]
    share = np.clip((s - start) / (stop - start), 0.0, 1.0)
    kind = int(grid.kinds[element])
    y = {INSIDE: share, FROM_REST: np.sqrt(share), TO_REST: np.sqrt(1 - share)}[kind]
    nodes = find_basis().y[kind]
    own = motion.profile.a[element * (DEGREE + 1) : (element + 1) * (DEGREE + 1)]
    return np.polyval(np.polyfit(nodes, own, DEGREE), y)


@pytest.mark.parametrize("seed", SEEDS)
def test_motion_integrates_its_acceleration(seed: int) -> None:
    """S'' is that of the elements, s' its integral over time, and s that of s'."""
    motion = random_motion(seed)
    length, nodes, weights = motion.curve.length, *np.polynomial.legendre.leggauss(20)
    speed, place = 0.0, 0.0
    for k in motion.grid.nonempty.tolist():
        start, stop = motion.times[k], motion.times[k + 1]
        t = start + (1 + nodes) / 2 * (stop - start)
        s, _, here = motion.locate(t)
        expected = acceleration(motion, k // (DEGREE + 1), s)
        scale = np.abs(motion.profile.a).max()
        np.testing.assert_allclose(here.a, expected, rtol=0, atol=1e-9 * scale)
        place += (stop - start) / 2 * float(weights @ np.sqrt(here.b))
        speed += (stop - start) / 2 * float(weights @ here.a)
        assert place == pytest.approx(motion.grid.s[k + 1], abs=1e-10 * length)
        top = math.sqrt(motion.profile.b.max())
        assert speed == pytest.approx(math.sqrt(motion.profile.b[k + 1]), abs=1e-9 * top)


@pytest.mark.parametrize("seed", SEEDS)
def test_b_between_nodes_is_the_integral_of_a(seed: int) -> None:
    motion = random_motion(seed)
    grid, fractions = motion.grid, np.linspace(0.0, 1.0, 5)
    b = Elements(grid, motion.profile).at(fractions).b.reshape(-1, 5)
    for row, k in zip(b, grid.nonempty.tolist(), strict=True):
        start, step = grid.s[k], grid.steps[k]
        for fraction, value in zip(fractions[1:], row[1:], strict=True):
            rise = quad(
                lambda u, k=k, s=start, h=step * fraction: (
                    2 * h * float(acceleration(motion, k // (DEGREE + 1), np.array(s + h * u)))
                ),
                0,
                1,
            )[0]
            assert value - row[0] == pytest.approx(rise, abs=1e-7 * motion.profile.b.max())


@pytest.mark.parametrize("seed", SEEDS)
def test_profile_holds_the_derivatives_of_s(seed: int) -> None:
    motion = random_motion(seed)
    rng = np.random.default_rng(100 + seed)
    k = rng.choice(motion.grid.nonempty, 40)
    start, stop = motion.times[k], motion.times[k + 1]
    t = start + rng.uniform(0.2, 0.8, 40) * (stop - start)
    # Inside an interval s is smooth; the step trades 1e-16 / h^2 against h^2.
    h = 0.02 * (stop - start)
    before, (s, segment, here), after = (motion.locate(t + d) for d in (-h, 0 * h, h))
    speed, fastest = (after[0] - before[0]) / (2 * h), np.sqrt(motion.profile.b.max())
    np.testing.assert_allclose(np.sqrt(here.b), speed, rtol=0, atol=2e-4 * fastest)
    bend = (after[0] - 2 * s + before[0]) / h**2
    np.testing.assert_allclose(here.a, bend, rtol=0, atol=2e-4 * np.abs(motion.profile.a).max())
    np.testing.assert_array_equal(segment, motion.grid.segment[k])


@pytest.mark.parametrize("seed", SEEDS)
def test_nodes_are_passed_at_their_times(seed: int) -> None:
    motion = random_motion(seed)
    s, segment, here = motion.locate(motion.times[1:-1])
    # Slow ends: a time known to 1e-16 fixes s to the square root of nothing worse than this.
    np.testing.assert_allclose(s, motion.grid.s[1:-1], rtol=1e-12)
    later = np.append(motion.grid.steps[1:] > 0, True)[:-1]
    np.testing.assert_array_equal(segment[later], motion.grid.segment[1:-1][later])
    np.testing.assert_allclose(here.b, motion.profile.b[1:-1], rtol=1e-10)


@pytest.mark.parametrize("seed", SEEDS)
def test_rest_at_both_ends_and_beyond(seed: int) -> None:
    motion = random_motion(seed)
    s, _, here = motion.locate(np.array([-1.0, 0.0, motion.duration, motion.duration + 1.0]))
    length = motion.curve.length
    np.testing.assert_allclose(s, [0, 0, length, length], rtol=0, atol=1e-13 * length)
    np.testing.assert_allclose(here.b, 0.0, atol=1e-12 * motion.profile.b.max())
    ends = motion.profile.a[[0, 0, -1, -1]]
    np.testing.assert_allclose(here.a, ends, rtol=1e-9)


def test_interval_of_length_zero_takes_no_time_and_jumps() -> None:
    motion = random_motion(0)
    (gap,) = np.flatnonzero(np.diff(motion.grid.segment))
    assert motion.grid.steps[gap] == 0.0 and motion.times[gap] == motion.times[gap + 1]
    instant = 1e-9 * motion.duration
    _, segment, here = motion.locate(motion.times[gap] + np.array([-instant, instant]))
    assert segment.tolist() == [0, 1]
    np.testing.assert_allclose(here.a, motion.profile.a[[gap, gap + 1]], rtol=1e-6)
    assert abs(here.a[1] - here.a[0]) > 1e-3 * abs(here.a[0])
    np.testing.assert_allclose(here.lam, motion.profile.lam[[gap, gap + 1]], rtol=1e-5)


def test_a_stall_is_seen() -> None:
    """The speed all but vanishes in the middle of an element, though not at its nodes."""
    edges = np.array([[0.0, 0.4], [0.4, 0.6], [0.6, 1.0]])
    grid = lay_out(edges, np.zeros(3, dtype=np.int64), (True, True))
    dip = np.where((grid.s >= 0.4) & (grid.s <= 0.6), 0.9, 0.0)
    y = np.clip((grid.s - 0.4) / 0.2, 0.0, 1.0)
    b = np.where(dip > 0, (y - 0.3) ** 2 + 1e-12, grid.s * (1 - grid.s))
    a = np.where(dip > 0, (y - 0.3) / 0.2, 0.5 - grid.s)
    smooth = np.where(dip > 0, 0.24, b)
    stalled, moving = (
        PathMotion(stub_curve(1.0, []), grid, Profile(own_a, own_b, own_a))
        for own_a, own_b in ((a, b), (np.where(dip > 0, 0.0, a), smooth))
    )
    assert stalled.stalls and not moving.stalls


@pytest.mark.parametrize("elements", [6, 7, 37])
@pytest.mark.parametrize("breaks", [[], [0.4], [0.01, 0.02], [0.3, 0.300001, 0.9], [1 - 1e-6]])
def test_grid_has_its_elements_and_breaks(elements: int, breaks: list[float]) -> None:
    length = 0.037
    curve = stub_curve(length, [length * part for part in breaks])
    switches = length * np.array([0.123, 0.777])
    grid = Mesh(switches).make_grid(curve, elements)
    assert len(grid.s) == len(grid.segment) == elements * (DEGREE + 1)
    assert grid.s[0] == 0.0 and grid.s[-1] == length
    assert (np.diff(grid.s) >= 0).all() and (np.diff(grid.segment) >= 0).all()
    # Of length zero are exactly the intervals between elements.
    gaps = np.flatnonzero(np.diff(grid.s) == 0)
    np.testing.assert_array_equal(gaps, DEGREE + (DEGREE + 1) * np.arange(elements - 1))
    assert set(switches) <= set(grid.edges[:, 0])
    for index, segment in enumerate(curve.segments):
        mine = grid.s[grid.segment == index]
        assert len(mine) >= 2 and mine[0] == segment.start and mine[-1] == segment.stop
    assert grid.kinds.tolist() == [FROM_REST, *[INSIDE] * (elements - 2), TO_REST]


def test_grid_is_fine_towards_the_ends_or_where_it_is_asked_to_be() -> None:
    grid = Mesh().make_grid(stub_curve(1.0, []), 20)
    # Even in the angle of s = (1 - cos) / 2.
    np.testing.assert_allclose(grid.edges[:, 0], (1 - np.cos(np.pi * np.arange(20) / 20)) / 2)
    weighted = Mesh(np.array([0.5]), np.array([1.0, 3.0])).make_grid(stub_curve(1.0, []), 20)
    assert (weighted.edges[:, 1] <= 0.5).sum() == 5
