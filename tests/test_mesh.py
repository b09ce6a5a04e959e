from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from timed import plan_landing, stages_of, tables
from wholearm.common.arrays import Array
from wholearm.planning.time_domain.collocation import Scheme, make_scheme
from wholearm.planning.time_domain.stage import Stage, StagePoints
from wholearm.planning.time_domain.time_mesh import (
    AT_ONCE,
    DEFECT,
    bisect,
    count_halvings,
    monitor_violated,
    resample,
)
from wholearm.planning.time_domain.time_motion import StageMotion

SCHEMES = [("radau", 2), ("radau", 4), ("legendre", 3)]


class Course:
    """Polynomials of a scheme's degree in each interval: z and v of d, z'' and forces of d - 1.

    One polynomial over all intervals, so that any others give the same one back.
    """

    def __init__(self, degree: int) -> None:
        rng = np.random.default_rng(degree)
        self.z, self.v = rng.normal(size=(2, degree + 1, 5))
        self.a, self.forces = rng.normal(size=(degree, 5)), rng.normal(size=(degree, 3))
        self.tau = rng.normal(size=(2, 2))

    def at(self, name: str, places: Array) -> Array:
        table = getattr(self, name)
        return np.asarray(places[..., None] ** np.arange(len(table)) @ table)

    def sample(self, scheme: Scheme, breaks: Array) -> StagePoints:
        fractions = np.diff(breaks)
        t = breaks[:-1, None] + fractions[:, None] * scheme.points
        ends = np.stack([breaks[:-1], breaks[1:]], axis=1)
        return StagePoints(
            0.3,
            fractions,
            np.stack([self.at("z", breaks), self.at("v", breaks)], axis=1),
            self.at("z", t),
            self.at("v", t),
            self.at("a", t),
            self.at("forces", t),
            self.at("tau", ends),
            np.array([1.0, 2.0]),
        )


def check(got: StagePoints, expected: StagePoints) -> None:
    for one, other in zip(tables(got), tables(expected), strict=True):
        # Rounding, which inverting powers enlarges.
        np.testing.assert_allclose(one, other, atol=1e-11)


def random_breaks(rng: np.random.Generator, count: int) -> Array:
    return np.array([0.0, *np.sort(rng.uniform(0.05, 0.95, count - 1)), 1.0])


@pytest.mark.parametrize("name, degree", SCHEMES)
def test_polynomials_of_the_degree_are_carried_over_exactly(name: str, degree: int) -> None:
    scheme, course = make_scheme(name, degree), Course(degree)
    rng = np.random.default_rng(degree)
    old = random_breaks(rng, 4)
    new = np.sort(np.append(old, rng.uniform(0, 1, 5)))
    check(resample(course.sample(scheme, old), scheme, new), course.sample(scheme, new))


@pytest.mark.parametrize("name, degree", SCHEMES)
def test_part_of_a_stage_is_cut_out(name: str, degree: int) -> None:
    scheme, course = make_scheme(name, degree), Course(degree)
    part = course.sample(scheme, np.array([0.0, 0.2, 0.5, 1.0]))
    breaks = np.array([0.0, 0.25, 1.0])
    got = resample(part, scheme, breaks, 0.2, 0.5)
    own = course.sample(scheme, 0.2 + 0.3 * breaks)
    check(got, own._replace(duration=0.09, fractions=np.diff(breaks), impulses=np.zeros(0)))
    # What ends the stage is left only to its last part.
    last = resample(part, scheme, breaks, 0.5, 1.0)
    np.testing.assert_array_equal(last.impulses, part.impulses)


@pytest.mark.parametrize("name, degree", SCHEMES)
def test_halved_intervals_hold_the_same_motion(name: str, degree: int) -> None:
    scheme = make_scheme(name, degree)
    rng = np.random.default_rng(degree + 10)
    breaks = random_breaks(rng, 4)
    part = Course(degree).sample(scheme, breaks)
    # Torques and motions that step or bend from interval to interval, unlike one polynomial.
    part = part._replace(tau=rng.normal(size=(4, 2, 2)), forces=rng.normal(size=part.forces.shape))
    finer = bisect(part, scheme, np.array([1, 0, 2, 0]))
    widths = np.diff(breaks)
    halves = [*[widths[0] / 2] * 2, widths[1], *[widths[2] / 4] * 4, widths[3]]
    np.testing.assert_allclose(finer.fractions, halves, atol=1e-13)
    assert finer.duration == part.duration
    owners = [(0, 0), (0, 1), (1, 0), *[(2, k) for k in range(4)], (3, 0)]
    for k, (parent, inside) in enumerate(owners):
        width = finer.fractions[k] / widths[parent]
        start = inside * width
        table = scheme.interpolate(start + width * scheme.points)
        np.testing.assert_allclose(finer.forces[k], table @ part.forces[parent], atol=1e-11)
        ends = np.array([[1 - start, start], [1 - start - width, start + width]])
        np.testing.assert_allclose(finer.tau[k], ends @ part.tau[parent], atol=1e-12)


def make_stages(motions: list[StageMotion]) -> list[Stage]:
    return [Stage(0, motion.formation, motion.directions, motion.points) for motion in motions]


@pytest.fixture(scope="module")
def stages() -> list[Stage]:
    """Those of the landing; every direction of friction is that of the motion."""
    return make_stages(stages_of(plan_landing(time_intervals=6)))


@pytest.mark.parametrize("name, degree", [("radau", 2), ("radau", 3), ("legendre", 3)])
def test_defects_that_shrink_with_the_order_need_one_round(name: str, degree: int) -> None:
    scheme = make_scheme(name, degree)
    rng = np.random.default_rng(1)
    sizes = DEFECT * 10 ** rng.uniform(-3, 3, 40)
    defects = sizes[:, None, None] * rng.uniform(-1, 1, (40, 2, 5))
    defects[:, 1, 2] = -sizes
    times = count_halvings(np.zeros(40), defects, scheme)
    left = sizes * 0.5 ** (scheme.order * times)
    assert (left <= DEFECT)[times < AT_ONCE].all()
    # Once less would not have done.
    assert (left * 2**scheme.order > DEFECT)[times > 0].all()
    assert set(times[sizes < DEFECT].tolist()) == {0}


def test_limits_that_are_broken_are_watched_from_then_on(stages: list[Stage]) -> None:
    monitored = monitor_violated(stages) or stages
    # What is broken already, by less than counts, changes nothing the second time.
    assert monitor_violated(monitored) is None
    low = monitored[-1]
    sunk = low.guess.z.copy()
    sunk[2, 1, 1] -= 0.001
    guess = low.guess._replace(z=sunk)
    changed = monitor_violated([*monitored[:-1], replace(low, guess=guess)])
    assert changed is not None
    more = set(changed[-1].monitored) - set(low.monitored)
    values = low.formation.evaluate_limits(sunk[2, 1][None])[0]
    assert more and all(values[k] < -1e-9 for k in more)
    assert [stage.monitored for stage in changed[:-1]] == [
        stage.monitored for stage in monitored[:-1]
    ]
